"""
The law of the amplitude for averages of a few cycles, where no limit theorem holds: by sampling.

The draws are the same for every order and every call (fixed seed), so a prediction is a function
of its model. The mean square is not sampled: it is exact.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.statistics.angle_error import unit_nodes
from sa_jitter_ros.statistics.distributions import PulseErrorDistribution
from sa_jitter_ros.statistics.moments import AverageMoments
from sa_jitter_ros.statistics.pulse_weights import LINEAR, PulseWeights

Array = NDArray[Any]

_SEED = 20190215
_BUDGET = 3_000_000  # phasors in one law
_FEWEST, _MOST = 4096, 65536
_RULE = unit_nodes(12)


@dataclass(frozen=True)
class SampledLaw:
    """The law of |X| by sorted draws of shape (orders, n) and an exact mean square."""

    draws: Array = field(repr=False)
    mean_square: Array

    @property
    def variance(self) -> Array:
        """Return Var|X| of the draws."""
        return np.asarray(np.var(self.draws, axis=1, dtype=float))

    @property
    def mean(self) -> Array:
        """Return E|X|, so that mean^2 + variance = E|X|^2."""
        return np.asarray(np.sqrt(np.maximum(self.mean_square - self.variance, 0.0)))

    def cdf(self, amplitude: ArrayLike) -> Array:
        """Return P(|X| <= amplitude), (orders, k) for amplitudes of shape (k,) or (orders, k)."""
        y = np.atleast_2d(np.asarray(amplitude, float))
        y = np.broadcast_to(y, (self.draws.shape[0], y.shape[-1]))
        counts = [np.searchsorted(row, at, side='right') for row, at in zip(self.draws, y)]
        return np.asarray(np.array(counts) / self.draws.shape[1])

    def ppf(self, probability: ArrayLike) -> Array:
        """
        Return quantiles of |X|, shape (orders, k) for k probabilities in (0, 1).

        Raises ParameterError for a probability outside (0, 1).
        """
        p = require_probabilities(probability)
        position = p * (self.draws.shape[1] - 1)
        index = np.minimum(position.astype(int), self.draws.shape[1] - 2)
        part = position - index
        return np.asarray((1.0 - part) * self.draws[:, index] + part * self.draws[:, index + 1])


def sampled_law(
    frequencies: ArrayLike, distribution: PulseErrorDistribution, trigger_cycles: int,
    moments: AverageMoments, *, gain: ArrayLike = 1.0, line_variance: ArrayLike = 0.0,
    weights: PulseWeights = LINEAR,
) -> SampledLaw:
    """
    Return the law of the average of `trigger_cycles` cycles at the orders' `frequencies` in Hz.

    `moments` are the exact ones with gain and noise; `line_variance` is E|n|^2 of the noise;
    `weights` are those of the angle law.
    """
    f = np.asarray(frequencies, float)
    phasors = f.size * (trigger_cycles + 3) * (1 if weights is LINEAR else _RULE[0].size)
    count = int(np.clip(_BUDGET // phasors, _FEWEST, _MOST))
    rng = np.random.default_rng(_SEED)
    errors = distribution.draw(rng, (trigger_cycles + weights.pulses - 1, count))
    noise = rng.normal(0.0, np.sqrt(0.5), (2, count)).astype(np.float32)
    gains = np.broadcast_to(np.abs(np.asarray(gain)), f.shape)
    scales = np.broadcast_to(np.sqrt(np.asarray(line_variance, float)), f.shape)
    draws = np.empty((f.size, count), np.float32)
    for row, order, g, scale in zip(draws, f, gains, scales):
        real, imag = cycle_amplitudes((order * errors).astype(np.float32), weights)
        row[:] = np.hypot(g * real.mean(axis=0) + scale * noise[0],
                          g * imag.mean(axis=0) + scale * noise[1])
    draws.sort(axis=1)
    return SampledLaw(draws, moments.mean_square)


def cycle_amplitudes(errors: Array, weights: PulseWeights = LINEAR) -> tuple[Array, Array]:
    """
    Return real and imaginary part of int_0^1 exp(j 2 pi e_k(u)) du, cycles on axis 0.

    `errors` are pulse errors in cycles of the order, pulses on axis 0; the precision is theirs.
    """
    if weights is not LINEAR:
        u, w = (2.0 * np.pi * weights.at(_RULE[0])).astype(errors.dtype), _RULE[1]
        angles = [u.T @ errors[k:k + weights.pulses]
                  for k in range(len(errors) + 1 - weights.pulses)]
        return np.array([w @ np.cos(a) for a in angles]), np.array([w @ np.sin(a) for a in angles])
    middle = np.pi * (errors[1:] + errors[:-1])
    half = np.pi * np.diff(errors, axis=0)
    half[half == 0.0] = np.finfo(half.dtype).tiny
    gain = np.sin(half) / half
    return gain * np.cos(middle), gain * np.sin(middle)


def require_probabilities(probability: ArrayLike) -> Array:
    """Return probabilities of shape (k,); raise ParameterError for one outside (0, 1)."""
    p = np.atleast_1d(np.asarray(probability, float))
    if not np.all((p > 0.0) & (p < 1.0)):
        raise ParameterError(f'probabilities {p} must lie between 0 and 1, both excluded')
    return p
