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
From the sampled angle of a shaft, as joints of robots have it, to the times of virtual marks.

The angle may wrap or not. Around the crossing of a mark, a parabola through six samples gives its
time; what they leave is the noise of stamps and the quantisation of the angle, from which the
error of the pulses follows. No crossing is interpolated over a gap, a stop or a reversal.
"""

from dataclasses import dataclass
import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sa_jitter_ros.errors import ParameterError, SignalError

FloatArray = NDArray[np.float64]

_TURN = 2.0 * math.pi
_BEFORE, _AFTER = 3, 3  # samples around a crossing
_KEPT = 32  # samples before the next crossing
_GAP = 6.0  # usual intervals of samples without a sample
# Within so many seconds a shaft that turns passes this part of the pitch of its marks.
_STOPPED, _PROGRESS = 1.0, 0.02
_STEPS = 512  # steps of the angle, from which its resolution follows
_MULTIPLE, _MOST = 0.02, 0.9  # of a step; share of the steps that are multiples of the resolution
_MEMORY = 0.98  # weight of the errors before, at each crossing


@dataclass(frozen=True)
class AngleState:
    """
    Counts so far, and the errors of the latest pulses.

    `pulse_error_std` in s is the standard deviation of a pulse, made of `angle_resolution` in rad
    (0 if it is not seen) and of the rest, `stamp_noise_std` in s; NaN while unknown.
    """

    samples: int
    dropped: int
    pulses: int
    gaps: int
    stops: int
    reversals: int
    restarts: int
    pulse_error_std: float
    angle_resolution: float
    stamp_noise_std: float


class AngleCrossings:
    """
    Find when a sampled angle passes the marks of a virtual target, in blocks of any size.

    :param marks: number of marks on a revolution; one is at angle 0.
    :param time_tolerance: time (s) by which a sample may be early before a new run begins.
    :raises ParameterError: an option is out of range.

    A shaft at 20 Hz, sampled at 1 kHz with 12 bits a revolution:

    >>> time = np.arange(1000) / 1e3
    >>> angle = np.rint(20.0 * time * 4096) / 4096 * 2.0 * np.pi % (2.0 * np.pi)
    >>> crossings = AngleCrossings()
    >>> pulses = crossings.update(time, angle)
    >>> pulses.size, bool(abs(pulses - np.arange(1, 20) / 20.0).max() < 1e-5)
    (19, True)
    >>> round(crossings.state.angle_resolution * 4096 / (2.0 * np.pi), 3)
    1.0
    """

    def __init__(self, *, marks: int = 1, time_tolerance: float = 0.01) -> None:
        if marks != int(marks) or marks < 1:
            raise ParameterError(f'marks {marks} must be a whole number, 1 or more')
        if not 0.0 <= time_tolerance < np.inf:
            raise ParameterError(f'time_tolerance {time_tolerance} s must be finite and not '
                                 'negative')
        self._pitch = _TURN / int(marks)
        self._tolerance = time_tolerance
        self._samples = self._dropped = self._pulses = 0
        self._gaps = self._stops = self._reversals = self._restarts = 0
        self._unwrapped = False
        self._steps = np.empty(0)
        self._left = self._freedom = self._leverage = self._slowness = 0.0
        self._begin()

    def _begin(self) -> None:
        """Forget the samples: the next one begins a run."""
        self._time, self._angle = np.empty(0), np.empty(0)  # of the run, continuous
        self._raw = math.nan  # latest angle as it came
        self._direction = 0
        self._next = 0  # number of the next mark, in the direction
        self._standing = False
        self._moved, self._place = math.inf, math.nan  # when and where it last moved on
        self._interval = math.nan

    @property
    def state(self) -> AngleState:
        """Return the counts and errors so far."""
        resolution = self._resolution()
        error = noise = math.nan
        if self._freedom > 0.0:
            variance = self._left / self._freedom
            error = math.sqrt(variance * self._leverage)
            rounding = resolution * self._slowness / math.sqrt(12.0)
            noise = math.sqrt(max(variance - rounding**2, 0.0))
        return AngleState(self._samples, self._dropped, self._pulses, self._gaps, self._stops,
                          self._reversals, self._restarts, error, resolution, noise)

    def update(self, times: ArrayLike, angles: ArrayLike) -> FloatArray:
        """
        Take the next samples (n,) in s and rad, and return new pulse times (s).

        Samples that are not finite, or not later than the one before, are dropped and counted.

        :raises SignalError: the arrays are not one-dimensional, of one length and real.
        """
        time, angle = np.atleast_1d(np.asarray(times)), np.atleast_1d(np.asarray(angles))
        if time.shape != angle.shape or time.ndim != 1 or (
                time.dtype.kind not in 'fiu' or angle.dtype.kind not in 'fiu'):
            raise SignalError(f'times of shape {time.shape} and angles of shape {angle.shape}: '
                              'give as many times as angles, in s and rad')
        time, angle = time.astype(np.float64), angle.astype(np.float64)
        good = np.isfinite(time) & np.isfinite(angle)
        self._samples += time.size
        self._dropped += int(np.count_nonzero(~good))
        time, angle = time[good], angle[good]
        found = []
        while time.size:
            last = self._time[-1] if self._time.size else -math.inf
            reached = np.maximum.accumulate(np.append(last, time))[:-1]
            back = np.flatnonzero(time < reached - self._tolerance)
            stop = int(back[0]) if back.size else time.size
            later = time[:stop] > reached[:stop]
            self._dropped += int(np.count_nonzero(~later))
            found += self._take(time[:stop][later], angle[:stop][later])
            if back.size:
                self._restarts += 1
                self._begin()
            time, angle = time[stop:], angle[stop:]
        pulses = np.concatenate(found) if found else np.empty(0)
        self._pulses += pulses.size
        return pulses

    def _take(self, time: FloatArray, angle: FloatArray) -> list[FloatArray]:
        """Take samples in order of time; return pulse times, run by run."""
        found: list[FloatArray] = []
        while time.size:
            intervals = np.diff(time, prepend=self._time[-1:] if self._time.size else time[:1])
            if math.isnan(self._interval) and time.size + self._time.size > 2:
                known = np.diff(np.append(self._time, time))
                self._interval = float(np.median(known))
            gap = np.flatnonzero(intervals > _GAP * self._interval) if np.isfinite(
                self._interval) else np.empty(0, int)
            first = gap[gap > 0] if not self._time.size else gap
            stop = int(first[0]) if first.size else time.size
            if stop:
                self._append(time[:stop], angle[:stop])
                found += self._crossings()
            if first.size:
                self._gaps += 1
                interval = self._interval
                self._begin()
                self._interval = interval
            time, angle = time[stop:], angle[stop:]
        return found

    def _append(self, time: FloatArray, angle: FloatArray) -> None:
        """Make the angle continuous and add it to the run."""
        self._unwrapped |= bool(np.max(np.abs(angle)) > 1.01 * _TURN)
        steps = np.diff(angle, prepend=angle[0] if math.isnan(self._raw) else self._raw)
        if not self._unwrapped:
            steps -= _TURN * np.rint(steps / _TURN)
        start = self._angle[-1] if self._angle.size else angle[0]
        self._raw = float(angle[-1])
        self._time = np.append(self._time, time)
        self._angle = np.append(self._angle, start + np.cumsum(steps))
        moved = np.abs(steps[steps != 0.0])
        self._steps = np.append(self._steps, moved)[-_STEPS:]

    def _crossings(self) -> list[FloatArray]:
        """Return the pulse times of the marks that were passed; forget what is not needed."""
        found: list[FloatArray] = []
        if not self._direction:
            moved = self._angle - self._angle[0]
            if np.max(np.abs(moved)) < 0.5 * self._pitch:
                return found
            self._set_direction(1 if moved[np.argmax(np.abs(moved))] > 0.0 else -1)
        while True:
            turned = self._direction * self._angle
            reached = np.maximum.accumulate(turned)
            back = np.flatnonzero(reached - turned > 0.5 * self._pitch)
            stop = int(back[0]) if back.size else turned.size
            found.append(self._passed(reached[:stop], turned[:stop], ended=back.size > 0))
            self._watch_standstill(self._time[:stop], reached[:stop])
            if not back.size:
                break
            self._reversals += 1
            top = int(np.argmax(turned[:stop]))
            self._time, self._angle = self._time[top:], self._angle[top:]
            self._set_direction(-self._direction)
        needed = int(np.searchsorted(reached, self._next * self._pitch))
        keep = max(min(needed, reached.size) - _KEPT, 0)
        self._time, self._angle = self._time[keep:], self._angle[keep:]
        return found

    def _set_direction(self, direction: int) -> None:
        self._direction, self._moved, self._place = direction, float(self._time[0]), math.nan
        self._next = math.floor(direction * self._angle[0] / self._pitch) + 1

    def _watch_standstill(self, time: FloatArray, reached: FloatArray) -> None:
        """Count the times without progress, each once."""
        place = np.floor(reached / (_PROGRESS * self._pitch))
        before = self._place if np.isfinite(self._place) else place[0]
        on = np.flatnonzero(np.diff(np.maximum.accumulate(np.append(before, place))) > 0.0)
        moved = np.append(self._moved, time[on])
        long = np.diff(moved) > _STOPPED
        self._stops += int(np.count_nonzero(long)) - (self._standing and bool(long[:1].any()))
        if on.size:
            self._moved, self._place, self._standing = float(moved[-1]), float(place.max()), False
        if time[-1] - self._moved > _STOPPED and not self._standing:
            self._stops, self._standing = self._stops + 1, True

    def _passed(self, reached: FloatArray, turned: FloatArray, *, ended: bool) -> FloatArray:
        """Return when the next marks were passed, as far as the samples behind them are there."""
        known = reached.size - 1 if ended else reached.size - _AFTER
        if known < 1:
            return np.empty(0)
        last = math.floor(reached[known] / self._pitch)
        marks = np.arange(self._next, last + 1) * self._pitch
        self._next = max(self._next, last + 1)
        index = np.searchsorted(reached, marks)
        marks, index = marks[index > 0], index[index > 0]
        if not marks.size:
            return np.empty(0)
        low, high = turned[index - 1], turned[index]
        share = (marks - low) / np.where(high > low, high - low, 1.0)
        straight = self._time[index - 1] + np.clip(share, 0.0, 1.0) * (
            self._time[index] - self._time[index - 1])
        whole = (index >= _BEFORE) & (index + _AFTER <= reached.size)
        if whole.any():
            straight[whole] = self._fitted(index[whole], marks[whole], turned, straight[whole])
        return np.asarray(np.maximum.accumulate(straight))

    def _fitted(self, index: NDArray[Any], marks: FloatArray, turned: FloatArray,
                straight: FloatArray) -> FloatArray:
        """Return the times of marks by a parabola through the samples around each."""
        around = index[:, None] + np.arange(-_BEFORE, _AFTER)
        span = turned[around[:, -1]] - turned[around[:, 0]]
        moving = np.all(np.diff(turned[around], axis=1) > 0.0, axis=1)
        result = straight.copy()
        if not moving.any():
            return result
        around, marks, span = around[moving], marks[moving], span[moving]
        origin = straight[moving]
        x = (turned[around] - marks[:, None]) / span[:, None]
        y = self._time[around] - origin[:, None]
        powers = np.stack([np.ones_like(x), x, x**2], axis=2)
        inverse = np.linalg.pinv(powers)  # (crossing, power, sample)
        factors = np.einsum('ips,is->ip', inverse, y)
        left = y - np.einsum('isp,ip->is', powers, factors)
        result[moving] = origin + factors[:, 0]
        leverage = np.sum(inverse[:, 0] ** 2, axis=1)
        slowness = (y[:, -1] - y[:, 0]) / span  # s a rad
        for k in range(len(left)):  # a recursion over crossings, not over samples
            self._left = _MEMORY * self._left + float(left[k] @ left[k])
            self._freedom = _MEMORY * self._freedom + (_BEFORE + _AFTER - 3)
            weight = 1.0 / (1.0 + min(self._freedom / 3.0, 1.0 / (1.0 - _MEMORY)))
            self._leverage += weight * (float(leverage[k]) - self._leverage) if (
                self._leverage) else float(leverage[k])
            self._slowness += weight * (float(slowness[k]) - self._slowness) if (
                self._slowness) else float(slowness[k])
        return result

    def _resolution(self) -> float:
        """Return the step of which nearly all steps of the angle are multiples, 0 if none is."""
        if self._steps.size < 16:
            return 0.0
        differences = np.abs(np.subtract.outer(self._steps[-64:], self._steps[-64:]))
        least = np.append(self._steps, differences[differences > 0.0])
        step = float(least[least > 1e-9].min(initial=np.inf))
        if not np.isfinite(step):
            return 0.0
        multiples = self._steps / step
        return step if np.mean(np.abs(multiples - np.rint(multiples)) < _MULTIPLE) > _MOST else 0.0
