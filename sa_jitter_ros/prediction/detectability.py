"""
Detectability: how probably one average shows a change of a component, given jitter and noise.

An alarm is raised when the amplitude of an order crosses a threshold that amplitudes of the
unchanged component cross with the false-alarm rate: above it for a change upwards, below it for
one downwards. The component alone changes; noise stays.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.prediction.prediction import DeclaredModel, predict

Array = NDArray[Any]


def detection_probability(
    model: DeclaredModel, changes: ArrayLike, false_alarm_rate: float,
) -> Array:
    """
    Return the probability, shape (orders, k), that one average shows each of k relative changes.

    A change of 0.1 makes the component 1.1 times as large. Raises ParameterError for a change
    that is not finite or below -1 and for a false-alarm rate outside (0, 1).
    """
    if not 0.0 < false_alarm_rate < 1.0:
        raise ParameterError(f'false_alarm_rate is {false_alarm_rate}: give a probability between '
                             '0 and 1, both excluded')
    ratios = 1.0 + np.atleast_1d(np.asarray(changes, float))
    if not np.all(np.isfinite(ratios) & (ratios >= 0.0)):
        raise ParameterError(f'change is {np.min(ratios) - 1.0:g}: give a finite relative change '
                             'of at least -1 (the component vanishes)')
    unchanged = predict(model).distribution
    low, high = np.hsplit(unchanged.ppf([false_alarm_rate, 1.0 - false_alarm_rate]), 2)
    detected = []
    for ratio in ratios:
        changed = predict(model, gain=ratio).distribution
        detected.append(1.0 - changed.cdf(high) if ratio >= 1.0 else changed.cdf(low))
    return np.hstack(detected)
