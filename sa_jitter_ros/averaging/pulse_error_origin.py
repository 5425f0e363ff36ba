"""Whose error is it: does the tach time its pulses wrongly, or does the vibration side move."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.errors import SignalError

FloatArray = NDArray[np.float64]

_FEWEST_PULSES = 8
# Second differences of independent errors are correlated over two pulses; twice that to be safe.
_LAGS = 4


@dataclass(frozen=True)
class ErrorOrigin:
    """
    Regression of the pulse times' second differences on those of their recovered errors.

    `slope` 1 means that the tach is wrong, 0 that its pulses are right and the vibration side
    moves.
    """

    slope: float
    standard_error: float


def error_origin(pulse_times: FloatArray, errors: FloatArray) -> ErrorOrigin:
    """
    Tell where recovered `errors` (s) of pulses at the measured `pulse_times` (s) come from.

    An error of the tach is in the measured times too; a twist of the shaft or a delay of the
    vibration is not. Second differences take the speed and its drift out. The standard error
    allows for neighbours that are correlated (Newey and West 1987). Noise in the recovered errors
    pulls the slope down by its share of their variance. Raises `SignalError` for fewer than 8
    pulses, arrays that do not match, or errors that are all alike.
    """
    if pulse_times.shape != errors.shape or errors.ndim != 1 or len(errors) < _FEWEST_PULSES:
        raise SignalError(f'pulse times of shape {pulse_times.shape} with errors of shape '
                          f'{errors.shape}: give two equal series of {_FEWEST_PULSES} or more')
    x, y = np.diff(errors, 2), np.diff(pulse_times, 2)
    x, y = x - x.mean(), y - y.mean()
    power = float(x @ x)
    if not power > 0.0:
        raise SignalError('recovered errors do not vary: nothing was recovered')
    slope = float(x @ y) / power
    score = x * (y - slope * x)
    variance = float(score @ score)
    for lag in range(1, _LAGS + 1):
        variance += 2.0 * (1.0 - lag / (_LAGS + 1.0)) * float(score[lag:] @ score[:-lag])
    return ErrorOrigin(slope, float(np.sqrt(max(variance, 0.0))) / power)
