"""
Angle laws: when, inside a trigger cycle, the shaft stands at a given angle.

A law reads the pulse times around a trigger cycle and returns times for fractions `u` of the
cycle. The piecewise-linear law (Camerini et al. 2019, Eq. 5) needs the two pulses of the cycle
only, so a cycle is usable as soon as it ends, and attenuates least under pulse jitter. The
quadratic law follows a constant acceleration (Potter 1990; Fyfe and Munck 1997), the spline a
smooth speed (Villa 2008); both pay for it by passing on more of the pulse jitter.

Each law has its `PulseWeights`, which say how it passes the errors of its pulses on to the angle.
A law that reads pulses with the errors eps_k (fundamental cycles) reads cycle ``k`` at an angle
that is wrong by

    e_k(u) = sum_j h_j(u) eps_{k+j},    j = -before ... 1 + after,

``h_j`` being its cardinal functions: what it makes of one late pulse among even ones. The linear
law and the spline are linear in the pulse times, so for them this is exact; the quadratic law is
up to terms of the size eps/(trigger cycle) times eps. Eq. 16 of Camerini et al. 2019 for the
linear law.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.errors import ParameterError, SignalError
from scipy.interpolate import CubicSpline

Array = NDArray[Any]
FloatArray = NDArray[np.float64]
#: ``covariance(u, v, lag)`` = Cov[e_k(u), e_{k+lag}(v)] in fundamental cycles squared.
Covariance = Callable[[Array, Array, int], Array]


@dataclass(frozen=True)
class PulseWeights:
    """
    The weights of an angle law, which reads `before` and `after` pulses beside a cycle's own two.

    ``at(u)`` returns the weights of its pulses at the positions `u` in the trigger cycle, shape
    ``(before + 2 + after, *u.shape)``, first pulse first. `near` is a similar law that reads fewer
    pulses.
    """

    before: int
    after: int
    at: Callable[[Array], Array]
    near: 'PulseWeights | None' = None

    @property
    def pulses(self) -> int:
        """Return how many pulses a cycle depends on."""
        return self.before + 2 + self.after

    def path(self, errors: Array, u: Array, cycles: int) -> Array:
        """
        Return the angle errors (..., cycles, u) of averages with known pulse errors.

        `errors` (..., n) are those of all pulses that the law reads, n = cycles - 1 + pulses, or
        of the average's own, n = cycles + 1: then those beside err as the first and the last one.
        """
        windows = np.lib.stride_tricks.sliding_window_view(
            self.padded(errors, cycles), self.pulses, axis=-1)
        return np.asarray(windows @ self.at(u))

    def padded(self, errors: Array, cycles: int) -> Array:
        """Return the errors (..., n) of all pulses that the law reads, see `path`."""
        if errors.shape[-1] != cycles + 1:
            return errors
        beside = [(0, 0)] * (errors.ndim - 1) + [(self.before, self.after)]
        return np.pad(errors, beside, mode='edge')

    def covariance(self, autocovariance: Callable[[Array], Array]) -> Covariance:
        """Return the covariance of the angle for pulses with Cov[eps_k, eps_{k+i}] at lag i."""
        index = np.arange(self.pulses)

        def covariance(u: Array, v: Array, lag: int) -> Array:
            of_pulses = autocovariance(lag + index - index[:, None])
            return np.asarray(np.einsum(
                'i...,i...->...', self.at(u), np.tensordot(of_pulses, self.at(v), 1)))

        return covariance


@dataclass(frozen=True)
class AngleLaw:
    """
    An angle law and the pulses that it reads.

    `weights` say which pulses it reads and how it passes on their errors; it reads those that a
    run of consecutive pulses has, and `after_first` after a run's first cycle, which has none
    before. `fraction_times(pulses, cycle, u)` returns the times (s) at the fractions `u` of the
    cycle between `pulses[cycle]` and `pulses[cycle + 1]`.
    """

    name: str
    weights: PulseWeights
    after_first: int
    fraction_times: Callable[[FloatArray, int, FloatArray], FloatArray]

    @property
    def before(self) -> int:
        """Return how many pulses the law reads in front of a cycle's own two."""
        return self.weights.before

    @property
    def after(self) -> int:
        """Return how many pulses the law reads behind a cycle's own two."""
        return self.weights.after


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


def _linear_weights(u: Array) -> Array:
    return np.stack((1.0 - u, u))


def _quadratic_weights(u: Array) -> Array:
    """Lagrange's polynomials: the law's inverse has the same slopes at even pulses."""
    return np.stack((0.5 * u * (u - 1.0), 1.0 - u * u, 0.5 * u * (u + 1.0)))


_SIDE = 8  # pulses that the spline reads on either side
_UNIT_SPLINES = CubicSpline(np.arange(2 * _SIDE + 2), np.eye(2 * _SIDE + 2))


def _spline_weights(u: Array) -> Array:
    return np.moveaxis(_UNIT_SPLINES(_SIDE + u), -1, 0)


LINEAR = PulseWeights(0, 0, _linear_weights)
_QUADRATIC = PulseWeights(1, 0, _quadratic_weights)
_LAWS = {law.name: law for law in (
    AngleLaw('linear', LINEAR, 0, _linear),
    AngleLaw('quadratic', _QUADRATIC, 1, _quadratic),
    # A pulse j cycles away moves the spline by 0.27^j: eight leave 3e-5 of its error.
    AngleLaw('spline', PulseWeights(_SIDE, _SIDE, _spline_weights, near=_QUADRATIC), _SIDE,
             _spline))}
ANGLE_LAWS = tuple(_LAWS)


def angle_law(name: str) -> AngleLaw:
    """Law of that name; raises `ParameterError` for an unknown one."""
    if name not in _LAWS:
        raise ParameterError(f'angle_law is {name!r}: give one of {", ".join(ANGLE_LAWS)}')
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
