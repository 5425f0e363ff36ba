"""
Whose error is it: that of the pulses, or does the vibration move against them.

What earlier rounds know of each pulse is taken out of both.
"""

from dataclasses import dataclass

import numpy as np
from sa_jitter_ros.effects.evidence import Evidence
from scipy import stats

# Of the autocovariance at lags 0, 1 and 2, for the variance of second differences.
_SECOND_DIFFERENCE = (6.0, -8.0, 2.0)


@dataclass(frozen=True)
class SlopeTest:
    """
    Whose error is it: regression of the pulse times on the recovered errors, second differences.

    Slope 1, less what is known to move the vibration: the tach is wrong; the share that is known
    of the tach: the vibration side moves. `p_value` is that of the first; `decided` says whether
    the steady enough speed lets the slope tell the two apart.
    """

    slope: float
    standard_error: float
    p_value: float
    decided: bool
    tach_side: bool


def slope_test(evidence: Evidence) -> SlopeTest:
    """Regress the second differences of the pulse times on those of the recovered errors."""
    y = np.diff(evidence.errors, 2, axis=1)
    x = np.diff(evidence.times_left, 2, axis=1)
    if any(pulses.missing is not None and pulses.missing.any() for pulses in evidence.pulses):
        period = evidence.period
        x = (x + 0.5 * period) % period - 0.5 * period
    noise = 6.0 * float(np.nanmean(evidence.standard_errors**2))
    power = max(float(np.mean(y**2)) - noise, 1e-30)
    rows = np.mean(x * y, axis=1)
    slope = float(rows.mean()) / power
    left = x - slope * y
    error = float(np.sqrt(np.mean(left**2) / power / (y.size / 3.0)))
    lags = np.arange(3)
    moving = sum((effect.pulse_autocovariance(evidence.model, lags)
                  for effect in evidence.explained if effect.moves_vibration), np.zeros(3))
    of_tach = np.dot(evidence.expected_autocovariance(lags) - moving, _SECOND_DIFFERENCE) / power
    vibration_slope = float(np.clip(of_tach, 0.0, 1.0))
    tach_slope = max(1.0 - float(np.dot(moving, _SECOND_DIFFERENCE)) / power, vibration_slope)
    p_value = float(2.0 * stats.norm.sf(abs(slope - tach_slope) / max(error, 1e-12)))
    decided = tach_slope - vibration_slope > 4.0 * error
    tach_side = decided and slope > 0.5 * (tach_slope + vibration_slope)
    return SlopeTest(slope, error, p_value, decided, tach_side)


def require_tach_side(evidence: Evidence) -> str:
    """Say that the vibration side moves, where it does; '' where the pulses are wrong."""
    if evidence.against_reference:
        return ''
    test = slope_test(evidence)
    if test.decided and not test.tach_side:
        return (f'the pulse times do not move with the recovered errors: slope {test.slope:.2f} '
                f'+- {test.standard_error:.2f}')
    return ''
