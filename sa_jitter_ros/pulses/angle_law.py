# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
Angle laws: the time at which the shaft has a given angle, from the pulse times.

An angle law takes the pulse times around a trigger cycle and returns the times at fractions `u` of
the cycle. The linear law (Camerini et al. 2019, Eq. 5) needs only the two pulses of the cycle, so
that a cycle can be averaged as soon as it ends, and it attenuates least under pulse jitter. The
quadratic law follows a constant acceleration (Potter 1990; Fyfe and Munck 1997), the spline a
smooth speed (Villa 2011). Both transfer more of the pulse jitter to the angle.

The `PulseWeights` of a law say how errors of the pulses act on the angle. With pulse errors eps_k
(fundamental cycles) the angle in cycle ``k`` is wrong by

    e_k(u) = sum_j h_j(u) eps_{k+j},    j = -before ... 1 + after.

``h_j`` is the response of the law to one late pulse among evenly spaced ones. The linear law and
the spline are linear in the pulse times, so that this is exact. For the quadratic law it holds up
to terms of the order eps^2 per trigger cycle. For the linear law it is Eq. 16 of Camerini et al.
2019.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import cast

import numpy as np
from sa_jitter_ros.arrays import Array, FloatArray
from sa_jitter_ros.errors import ParameterError, SignalError

#: ``covariance(u, v, lag)`` = Cov[e_k(u), e_{k+lag}(v)] in fundamental cycles squared.
Covariance = Callable[[Array, Array, int], Array]


@dataclass(frozen=True)
class PulseWeights:
    """
    The weights of the pulses that an angle law uses: the two of a cycle and some around it.

    There are `before` pulses in front of the two and `after` behind them. ``at(u)`` returns the
    weights at the positions `u` in the trigger cycle, shape ``(before + 2 + after, *u.shape)``,
    first pulse first. `near` is a similar law that uses fewer pulses.

    >>> weights = angle_law('quadratic').weights
    >>> weights.before, weights.pulses, weights.at(np.array([0.5])).ravel().tolist()
    (1, 3, [-0.125, 0.75, 0.375])
    """

    before: int
    after: int
    at: Callable[[Array], Array]
    near: 'PulseWeights | None' = None

    @property
    def pulses(self) -> int:
        """Return the number of pulses that act on a cycle."""
        return self.before + 2 + self.after

    def path(self, errors: Array, u: Array, cycles: int) -> Array:
        """
        Return the angle errors (..., cycles, u) that pulse errors cause in averages.

        `errors` (..., n) are those of all pulses that the law uses, n = cycles - 1 + pulses, or
        those of the cycles only, n = cycles + 1. In the latter case the pulses in front and behind
        have the errors of the first and of the last one.
        """
        windows = np.lib.stride_tricks.sliding_window_view(
            self.padded(errors, cycles), self.pulses, axis=-1)
        return np.asarray(windows @ self.at(u))

    def padded(self, errors: Array, cycles: int) -> Array:
        """Return the errors (..., n) of all pulses that the law uses, see `path`."""
        if errors.shape[-1] != cycles + 1:
            return errors
        widths = [(0, 0)] * (errors.ndim - 1) + [(self.before, self.after)]
        return np.pad(errors, widths, mode='edge')

    def covariance(self, autocovariance: Callable[[Array], Array]) -> Covariance:
        """Return the covariance of the angle error, from Cov[eps_k, eps_{k+i}] at lags i."""
        index = np.arange(self.pulses)

        def covariance(u: Array, v: Array, lag: int) -> Array:
            of_pulses = autocovariance(lag + index - index[:, None])
            return np.asarray(np.einsum(
                'i...,i...->...', self.at(u), np.tensordot(of_pulses, self.at(v), 1)))

        return covariance


@dataclass(frozen=True)
class AngleLaw:
    """
    An angle law and the pulses that it uses.

    `weights` say which pulses these are and how their errors act on the angle. Of a run of
    consecutive pulses the law uses those that exist. The first cycle of a run has no pulses in
    front; there the law uses `after_first` pulses behind it. `fraction_times(pulses, cycle, u)`
    returns the times (s) at the fractions `u` of the cycle between `pulses[cycle]` and
    `pulses[cycle + 1]`.
    """

    name: str
    weights: PulseWeights
    after_first: int
    fraction_times: Callable[[FloatArray, int, FloatArray], FloatArray]

    @property
    def before(self) -> int:
        """Return the number of pulses used in front of those of the cycle."""
        return self.weights.before

    @property
    def after(self) -> int:
        """Return the number of pulses used behind those of the cycle."""
        return self.weights.after


def _linear(pulses: FloatArray, cycle: int, u: FloatArray) -> FloatArray:
    start, end = pulses[cycle], pulses[cycle + 1]
    return np.asarray(start + (end - start) * u)


def _quadratic(pulses: FloatArray, cycle: int, u: FloatArray) -> FloatArray:
    """Constant acceleration over the cycle and the one before it (a first cycle: after it)."""
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
    if np.any(root <= 0.0):  # the parabola has its vertex in the cycle
        return _linear(pulses, cycle, u)
    return np.asarray(pulses[first] + 2.0 * theta / (speed + np.sqrt(root)))


def _through(values: Array) -> Callable[[Array], Array]:
    """Return the cubic spline through values (place, ...) at places 0, 1, ..."""
    from scipy.interpolate import CubicSpline  # which takes as long to load as all the rest
    return cast(Callable[[Array], Array], CubicSpline(np.arange(len(values)), values))


@lru_cache(maxsize=1)
def _unit_splines() -> Callable[[Array], Array]:
    return _through(np.eye(2 * _SIDE + 2))


def _spline(pulses: FloatArray, cycle: int, u: FloatArray) -> FloatArray:
    """Cubic spline through the given pulses: time as a smooth function of angle."""
    if len(pulses) < 4:
        return _quadratic(pulses, cycle, u)
    times = _through(pulses - pulses[cycle])(cycle + u)
    if np.any(np.diff(times) <= 0.0):
        return _linear(pulses, cycle, u)
    return np.asarray(pulses[cycle] + times)


def _linear_weights(u: Array) -> Array:
    return np.stack((1.0 - u, u))


def _quadratic_weights(u: Array) -> Array:
    """Lagrange polynomials: at evenly spaced pulses the inverse of the law has their slopes."""
    return np.stack((0.5 * u * (u - 1.0), 1.0 - u * u, 0.5 * u * (u + 1.0)))


_SIDE = 8  # pulses that the spline uses on either side


def _spline_weights(u: Array) -> Array:
    return np.moveaxis(_unit_splines()(_SIDE + u), -1, 0)


LINEAR = PulseWeights(0, 0, _linear_weights)
_QUADRATIC = PulseWeights(1, 0, _quadratic_weights)
_LAWS = {law.name: law for law in (
    AngleLaw('linear', LINEAR, 0, _linear),
    AngleLaw('quadratic', _QUADRATIC, 1, _quadratic),
    # A pulse j cycles away acts on the spline by 0.27^j: beyond eight pulses 3e-5 remain.
    AngleLaw('spline', PulseWeights(_SIDE, _SIDE, _spline_weights, near=_QUADRATIC), _SIDE,
             _spline))}
ANGLE_LAWS = tuple(_LAWS)
LINEAR_LAW = _LAWS['linear']


def angle_law(name: str) -> AngleLaw:
    """
    Return the angle law of a name in `ANGLE_LAWS`; raises `ParameterError` for an unknown one.

    >>> law = angle_law('linear')
    >>> law.name, law.before, law.after
    ('linear', 0, 0)
    """
    if name not in _LAWS:
        raise ParameterError(f'angle_law is {name!r}: give one of {", ".join(ANGLE_LAWS)}')
    return _LAWS[name]


def _not_increasing(pulses: FloatArray) -> SignalError:
    return SignalError(f'pulse times {pulses.tolist()} s do not increase: remove repeated and '
                       'misplaced pulses first, as PulseValidator does')


def cycle_times(law: AngleLaw, pulses: FloatArray, cycle: int, u: FloatArray) -> FloatArray:
    """
    Return the times (s) at fractions `u` of one trigger cycle in a run of pulses.

    Uses only as many pulses around the cycle as the law says, so that the result does not depend
    on the number of pulses given. Raises `SignalError` unless the pulse times increase.

    A shaft that slows down passes the middle of a revolution before half of its time:

    >>> pulses = np.array([0.0, 1.0, 2.1, 3.3])
    >>> [float(cycle_times(angle_law(name), pulses, 1, np.array([0.5])).round(4)[0])
    ...  for name in ANGLE_LAWS]
    [1.55, 1.5356, 1.5375]
    """
    first = max(cycle - law.before, 0)
    near = pulses[first:cycle + 2 + (law.after if cycle else law.after_first)]
    if not np.all(np.diff(near) > 0.0):
        raise _not_increasing(near)
    return law.fraction_times(near, cycle - first, u)


def run_lines(pulses: FloatArray, first: int, origins: FloatArray
              ) -> tuple[FloatArray, FloatArray]:
    """
    Return begin and length (cycle,) in s of consecutive cycles of the linear law.

    Arguments and error are those of `run_times`.
    """
    near = pulses[first:first + len(origins) + 1]
    periods = near[1:] - near[:-1]
    if not np.all(periods > 0.0):
        wrong = int(np.argmin(periods > 0.0))
        raise _not_increasing(near[wrong:wrong + 2])
    return near[:-1] - origins, periods


def run_times(law: AngleLaw, pulses: FloatArray, first: int, origins: FloatArray, u: FloatArray
              ) -> FloatArray:
    """
    Return the times (cycle, u) of consecutive cycles, as `cycle_times` does for one.

    The first begins at `pulses[first]`. Each has a number in `origins` (cycle,), from which its
    times count; they are as accurate as these are near. The fractions `u` are the same in all
    cycles, (u,), or those of each, (cycle, u). Raises `SignalError` unless the pulse times
    increase.
    """
    if law is LINEAR_LAW:
        begins, periods = run_lines(pulses, first, origins)
        return np.asarray(begins[:, None] + periods[:, None] * u)
    return np.stack([cycle_times(law, pulses - origin, first + k, u[k] if u.ndim == 2 else u)
                     for k, origin in enumerate(origins)])
