"""Mixtures of predictions: what to expect when one of several scenarios holds."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sa_jitter_ros.errors import ModelError
from sa_jitter_ros.statistics.amplitude_law import increasing_root, quantile_bracket
from sa_jitter_ros.statistics.moments import AverageMoments
from sa_jitter_ros.statistics.prediction import (
    AmplitudeDistribution,
    Prediction,
    prediction_of_law,
)

Array = NDArray[Any]


@dataclass(frozen=True)
class MixtureLaw:
    """The law of |X| when one of several equally likely laws holds, one entry per order."""

    laws: Sequence[AmplitudeDistribution] = field(repr=False)

    @cached_property
    def mean(self) -> Array:
        """Return E|X|."""
        return np.asarray(np.mean([law.mean for law in self.laws], axis=0))

    @cached_property
    def variance(self) -> Array:
        """Return Var|X|: the mean of the variances and the variance of the means."""
        return np.asarray(np.mean([law.variance for law in self.laws], axis=0)
                          + np.var([law.mean for law in self.laws], axis=0))

    def cdf(self, amplitude: ArrayLike) -> Array:
        """Return P(|X| <= amplitude), (orders, k) for amplitudes of shape (k,) or (orders, k)."""
        return np.asarray(np.mean([law.cdf(amplitude) for law in self.laws], axis=0))

    def ppf(self, probability: ArrayLike) -> Array:
        """
        Return quantiles of |X|, shape (orders, k) for k probabilities in (0, 1).

        Raises ParameterError for a probability outside (0, 1).
        """
        p, low, high = quantile_bracket(self.mean, self.variance, probability)
        return increasing_root(lambda y: self.cdf(y) - p, low, high)


def mixed(predictions: Sequence[Prediction]) -> Prediction:
    """
    Return the prediction for a model of which one of several equally likely variants holds.

    Raises ModelError for none, or for variants of different orders.
    """
    if not predictions or any(p.model.orders != predictions[0].model.orders for p in predictions):
        raise ModelError(f'{len(predictions)} variants cannot be mixed: give at least one, all of '
                         'the same orders')
    parts = [p.moments for p in predictions]
    mean = np.mean([m.mean for m in parts], axis=0)
    off = [m.mean - mean for m in parts]
    moments = AverageMoments(
        mean, np.mean([m.variance + np.abs(d) ** 2 for m, d in zip(parts, off)], axis=0),
        np.mean([m.pseudo_variance + d**2 for m, d in zip(parts, off)], axis=0))
    law = MixtureLaw([p.law for p in predictions])
    return prediction_of_law(predictions[0].model, moments, law)
