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
Motion of the tach shaft: speed profile, random fluctuation and torsion, exactly invertible.

The angle is a chain of increasing functions, angle(t) = torsion(profile(warp(t))), each with an
exact derivative, so that the angle at any time and the time of any angle are exact to rounding.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.simulation.random_streams import SinusoidSum, ZERO

_MAX_FLUCTUATION = 0.9  # of the upper bound, which is about ten standard deviations
_MAX_TORSION = 0.5
_PICARD_STEPS = 6
_NEWTON_STEPS = 6


@dataclass(frozen=True)
class Torsion:
    """
    A torsional oscillation of the tach shaft: `amplitude` rad, `order` times a revolution.

    `phase` in rad, of a sine.
    """

    order: float
    amplitude: float
    phase: float = 0.0


@dataclass(frozen=True, eq=False)
class Motion:
    """
    Motion of the tach shaft: its angle at any time, and the time of any angle.

    Parameters
    ----------
    points
        Speed profile: times (s, from 0, increasing) and speeds (Hz, not negative), linear between
        them and constant after the last one. The last speed is also that before time 0.
    fluctuation
        Relative speed fluctuation as a function of time.
    torsion
        Torsional oscillations of the shaft.
    start_angle
        Angle at time 0, revolutions.

    Raises
    ------
    ParameterError
        If the profile is malformed or the shaft would turn backwards.

    Examples
    --------
    >>> motion = Motion(points=[(0.0, 10.0), (2.0, 20.0)])
    >>> motion.angle(np.array([0.0, 1.0, 2.0])), motion.speed(np.array([1.0]))
    (array([ 0. , 12.5, 30. ]), array([15.]))
    >>> motion.time_at(np.array([12.5, 40.0]))
    array([1. , 2.5])

    """

    points: Sequence[tuple[float, float]]
    fluctuation: SinusoidSum = ZERO
    torsion: Sequence[Torsion] = ()
    start_angle: float = 0.0
    _times: FloatArray = field(init=False, repr=False)
    _speeds: FloatArray = field(init=False, repr=False)
    _angles: FloatArray = field(init=False, repr=False)
    _warp: SinusoidSum = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Check that the shaft turns forwards, and integrate the profile."""
        points = np.array(self.points, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 2 or not np.isfinite(points).all():
            raise ParameterError(f'speed profile {self.points}: give pairs of time in s and '
                                 'speed in Hz')
        times, speeds = np.ascontiguousarray(points.T)
        if times[0] != 0 or (np.diff(times) <= 0).any():
            raise ParameterError(f'times {times.tolist()} of the speed profile: must increase '
                                 'from 0')
        if (speeds < 0).any() or speeds[-1] == 0:
            raise ParameterError(f'speeds {speeds.tolist()} Hz: must not be negative, nor the '
                                 'last one 0')
        if self.fluctuation.bound > _MAX_FLUCTUATION:
            raise ParameterError(
                f'speed fluctuation may reach {self.fluctuation.bound:.3g} of the speed: at most '
                f'{_MAX_FLUCTUATION}; lower its standard deviation')
        twist = sum(abs(item.order * item.amplitude) for item in self.torsion)
        if not twist <= _MAX_TORSION:
            raise ParameterError(f'torsion changes the speed by up to {twist:.3g} of its value: '
                                 f'at most {_MAX_TORSION}; lower order or amplitude')
        steps = np.diff(times) * (speeds[1:] + speeds[:-1]) / 2.0
        object.__setattr__(self, '_times', times)
        object.__setattr__(self, '_speeds', speeds)
        object.__setattr__(self, '_angles', np.concatenate([[0.0], np.cumsum(steps)]))
        object.__setattr__(self, '_warp', self.fluctuation.integral())

    @property
    def nominal_speed(self) -> float:
        """Return the speed that the profile ends with, Hz."""
        return float(self._speeds[-1])

    def angle(self, times: FloatArray) -> FloatArray:
        """Return the tach shaft's angle in revolutions."""
        return self._twisted(self._profile(self._warped(times)))

    def speed(self, times: FloatArray) -> FloatArray:
        """Return the tach shaft's speed in Hz: the exact derivative of the angle."""
        warped = self._warped(times)
        twist = self._twist_slope(self._profile(warped))
        return self._profile_speed(warped) * (1.0 + self.fluctuation.value(times)) * twist

    def time_at(self, angles: FloatArray) -> FloatArray:
        """Return the time at which the tach shaft has an angle (revolutions)."""
        if self.torsion:
            angles = _invert(self._twisted, self._twist_slope, angles)
        warped = self._profile_time(angles)
        if not self._warp.amplitudes.size:
            return warped
        return _invert(self._warped, lambda times: 1.0 + self.fluctuation.value(times), warped)

    def _warped(self, times: FloatArray) -> FloatArray:
        return times + self._warp.value(times) - self._warp.value(np.zeros(()))

    def _twisted(self, angles: FloatArray) -> FloatArray:
        return angles + sum(
            item.amplitude * np.sin(2.0 * np.pi * item.order * angles + item.phase)
            for item in self.torsion) / (2.0 * np.pi)

    def _twist_slope(self, angles: FloatArray) -> FloatArray:
        return np.ones_like(angles) + sum(
            item.amplitude * item.order * np.cos(2.0 * np.pi * item.order * angles + item.phase)
            for item in self.torsion)

    def _segment(self, values: FloatArray, starts: FloatArray) -> NDArray[np.intp]:
        return np.clip(np.searchsorted(starts, values, side='right') - 1, 0, starts.size - 1)

    def _profile_speed(self, times: FloatArray) -> FloatArray:
        return np.interp(times, self._times, self._speeds, left=self.nominal_speed)

    def _profile(self, times: FloatArray) -> FloatArray:
        at = self._segment(times, self._times)
        after = times - self._times[at]
        mean_speed = (self._speeds[at] + self._profile_speed(times)) / 2.0
        mean_speed = np.where(after < 0.0, self.nominal_speed, mean_speed)
        return np.asarray(self.start_angle + self._angles[at] + after * mean_speed)

    def _profile_time(self, angles: FloatArray) -> FloatArray:
        angles = angles - self.start_angle
        at = self._segment(angles, self._angles)
        begin, angle_behind = self._speeds[at], angles - self._angles[at]
        slopes = np.append(np.diff(self._speeds) / np.diff(self._times), 0.0)
        end = np.sqrt(np.maximum(begin**2 + 2.0 * slopes[at] * angle_behind, 0.0))
        mean_speed = np.where(angle_behind < 0.0, self.nominal_speed, (begin + end) / 2.0)
        seconds = angle_behind / np.where(angle_behind == 0.0, 1.0, mean_speed)
        return np.asarray(self._times[at] + seconds)


def _invert(function: Callable[[FloatArray], FloatArray],
            slope: Callable[[FloatArray], FloatArray], values: FloatArray) -> FloatArray:
    """
    Return the arguments at which a function with slopes of 0.5 to 1.5 has `values`.

    Steps of slope 1 at least halve the error, after which Newton's method converges. The number of
    steps is fixed, so that the result for a value does not depend on the other values.
    """
    places = np.array(values)
    for step in range(_PICARD_STEPS + _NEWTON_STEPS):
        error = function(places) - values
        places -= error if step < _PICARD_STEPS else error / slope(places)
    return places
