"""
Angle laws: when, inside a trigger cycle, the shaft stands at a given angle.

A law reads the pulse times around a trigger cycle and returns times for fractions `u` of the
cycle. The piecewise-linear law (Camerini et al. 2019, Eq. 5) needs the two pulses of the cycle
only, so a cycle is usable as soon as it ends, and attenuates least under pulse jitter. The
quadratic law follows a constant acceleration (Potter 1990; Fyfe and Munck 1997), the spline a
smooth speed (Villa 2008); both pay for it by passing on more of the pulse jitter.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.errors import ParameterError, SignalError
from scipy.interpolate import CubicSpline

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class AngleLaw:
    """
    An angle law and the pulses that it reads.

    `before` and `after` are how many pulses it reads on either side of a trigger cycle's own two,
    where a run of consecutive pulses has them, `after_first` how many after a run's first cycle,
    which has none before. `fraction_times(pulses, cycle, u)` returns the times
    (s) at the fractions `u` of the cycle between `pulses[cycle]` and `pulses[cycle + 1]`.
    """

    name: str
    before: int
    after: int
    after_first: int
    fraction_times: Callable[[FloatArray, int, FloatArray], FloatArray]


def _linear(pulses: FloatArray, cycle: int, u: FloatArray) -> FloatArray:
    start, end = pulses[cycle], pulses[cycle + 1]
    return np.asarray(start + (end - start) * u)


def _quadratic(pulses: FloatArray, cycle: int, u: FloatArray) -> FloatArray:
    """Constant acceleration over the cycle and the one before; a first cycle, the one after."""
    if len(pulses) < 3:
        return _linear(pulses, cycle, u)
    first = cycle - 1 if cycle > 0 else cycle
    d0, d1 = np.diff(pulses[first:first + 3])
    # theta(t) through angles 0, 1, 2: theta = speed t + curve t^2, t from the first of the three
    curve = (d0 - d1) / (d0 * d1 * (d0 + d1))
    speed = 1.0 / d0 - curve * d0
    theta = u + (cycle - first)
    # the root that stays finite as the curvature vanishes
    root = speed * speed + 4.0 * curve * theta
    if np.any(root <= 0.0):  # the parabola turns round: the intervals differ too much for it
        return _linear(pulses, cycle, u)
    return np.asarray(pulses[first] + 2.0 * theta / (speed + np.sqrt(root)))


def _spline(pulses: FloatArray, cycle: int, u: FloatArray) -> FloatArray:
    """Cubic spline through the pulses at hand: time as a smooth function of angle."""
    if len(pulses) < 4:
        return _quadratic(pulses, cycle, u)
    times = CubicSpline(np.arange(len(pulses)), pulses - pulses[cycle])(cycle + u)
    if np.any(np.diff(times) <= 0.0):
        return _linear(pulses, cycle, u)
    return np.asarray(pulses[cycle] + times)


_LAWS = {law.name: law for law in (
    AngleLaw('linear', 0, 0, 0, _linear),
    AngleLaw('quadratic', 1, 0, 1, _quadratic),
    # A pulse j cycles away moves the spline by 0.27^j: eight leave 3e-5 of its error.
    AngleLaw('spline', 8, 8, 8, _spline))}
LAWS = tuple(_LAWS)


def angle_law(name: str) -> AngleLaw:
    """Law of that name; raises `ParameterError` for an unknown one."""
    if name not in _LAWS:
        raise ParameterError(f'angle_law is {name!r}: give one of {", ".join(LAWS)}')
    return _LAWS[name]


def cycle_times(law: AngleLaw, pulses: FloatArray, cycle: int, u: FloatArray) -> FloatArray:
    """
    Return the times (s) at fractions `u` of one trigger cycle in a run of pulses.

    Reads no more pulses around the cycle than the law says, so that the result does not depend on
    how much of the run is at hand. Raises `SignalError` unless the pulse times increase.
    """
    first = max(cycle - law.before, 0)
    near = pulses[first:cycle + 2 + (law.after if cycle else law.after_first)]
    if not np.all(np.diff(near) > 0.0):
        raise SignalError(f'pulse times {near.tolist()} do not increase: validate pulses first')
    return law.fraction_times(near, cycle - first, u)
