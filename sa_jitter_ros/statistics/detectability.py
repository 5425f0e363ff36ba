"""
Detectability: can an amplitude tell two machine states apart, given jitter and noise.

The monitored figure is the amplitude of one order of one average. In the second state the
component itself is larger (or smaller) by `amplitude_ratio`; noise is the same in both.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.statistics.distributions import is_number
from sa_jitter_ros.statistics.prediction import DeclaredModel, predict

Array = NDArray[Any]

_CURVE = np.concatenate([np.geomspace(1e-4, 0.02, 40), np.linspace(0.025, 0.995, 195)])


@dataclass(frozen=True)
class Detectability:
    """
    Receiver operating characteristic of each order.

    `threshold` (in units of the first state's component) and `detection` have shape (orders, k)
    for k values of `false_alarm`; `area` under the curve, shape (orders,), is 0.5 for states that
    look alike and 1 for states that never do.
    """

    order: Array
    false_alarm: Array
    threshold: Array
    detection: Array
    area: Array


def detectability(
    model: DeclaredModel, amplitude_ratio: float, false_alarm: ArrayLike,
) -> Detectability:
    """
    Return the probability of telling two states apart at given false alarm rates.

    The test is one-sided, towards the side of `amplitude_ratio`. Raises ParameterError for a
    negative or infinite ratio or a false alarm rate outside (0, 1).
    """
    rate = np.atleast_1d(np.asarray(false_alarm, float))
    if not (is_number(amplitude_ratio) and np.isfinite(amplitude_ratio)
            and amplitude_ratio >= 0.0):
        raise ParameterError(f'amplitude_ratio is {amplitude_ratio}: it must be finite and not '
                             'negative')
    if not np.all((rate > 0.0) & (rate < 1.0)):
        raise ParameterError(f'false_alarm rates {rate} must lie between 0 and 1, both excluded')
    first = predict(model).law
    second = predict(model, gain=amplitude_ratio).law
    above = amplitude_ratio >= 1.0
    grid = np.concatenate([rate, _CURVE])
    threshold = first.ppf(1.0 - grid if above else grid)
    below = second.cdf(threshold)
    detection = 1.0 - below if above else below
    curve = np.hstack([np.zeros((len(detection), 1)), detection[:, rate.size:],
                       np.ones((len(detection), 1))])
    steps = np.diff(np.concatenate([[0.0], _CURVE, [1.0]]))
    area = 0.5 * (curve[:, 1:] + curve[:, :-1]) @ steps
    return Detectability(np.asarray(model.orders), rate, threshold[:, :rate.size],
                         detection[:, :rate.size], area)
