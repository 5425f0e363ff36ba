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
At what a machine operates: bins of speed and of the operating state, and that state over time.

The operating state is one number, as a torque or a power, by which the vibration of a sound
machine changes.
"""

from bisect import bisect_left, bisect_right
import math
import time

import numpy as np
from sa_jitter_ros.averaging.results import AverageHeader
from sa_jitter_ros.errors import MessageError

# Bins of speed side by side in the number of a bin; numbers below 2^53 are exact as floats.
_SPEEDS, _MOST_STATES = 1 << 21, 1 << 30
_MOST_VALUES = 1 << 17  # of the state that are remembered


class OperatingBins:
    """
    Bins of speed, of a relative width, and of the operating state; 0 is one bin for all states.

    The first speed and the first state are in the middle of bin 0.

    >>> bins = OperatingBins(0.05, 100.0)
    >>> [bins.key(*place) for place in ((16.6, 250.0), (16.7, 290.0), (17.4, 250.0))]
    [0, 0, 1]
    >>> bins.words(bins.key(16.6, 360.0))
    '16.6 Hz and state 350'
    """

    def __init__(self, speed_bin: float, state_bin: float) -> None:
        self._step, self._width = math.log1p(speed_bin), state_bin
        self.speed = self.state = math.nan  # in the middle of bin 0

    def key(self, speed: float, state: float = math.nan) -> int | None:
        """Return the number of a bin, None where speed or state are none."""
        if not (math.isfinite(speed) and speed > 0.0):
            return None
        if math.isnan(self.speed):
            self.speed = speed
        key = round(math.log(speed / self.speed) / self._step)
        if self._width:
            if not math.isfinite(state):
                return None
            if math.isnan(self.state):
                self.state = state
            place = round((state - self.state) / self._width)
            key = key + _SPEEDS * place if abs(place) < _MOST_STATES else _SPEEDS * _MOST_STATES
        return key

    def words(self, key: int) -> str:
        """Return the middle of a bin in words."""
        place = round(key / _SPEEDS)
        speed = self.speed * math.exp(self._step * (key - _SPEEDS * place))
        return f'{speed:.4g} Hz' + (
            f' and state {self.state + self._width * place:.4g}' if self._width else '')


class OperatingState:
    """
    The operating state over time, of which each average gets the mean.

    The times of values are those of the averages if they are `stamped`, else those at which they
    come. Without a value during an average, the latest one of at most `hold` s before counts.
    """

    def __init__(self, *, stamped: bool, hold: float = math.inf) -> None:
        self.stamped, self.hold = stamped, hold
        self._times: list[float] = []
        self._values: list[float] = []
        self._taken: dict[str, float] = {}  # when the latest average of a shaft came

    def add(self, value: float, at: float = math.nan) -> None:
        """Take a value, of the time `at` (s) if stamped; raises MessageError for NaN."""
        at = at if self.stamped else time.monotonic()
        if not math.isfinite(value + at):
            raise MessageError(f'state {value} at {at} s: publish finite numbers')
        if self._times and at < self._times[-1]:  # its source has begun again
            self._times, self._values = [], []
        self._times.append(at)
        self._values.append(value)
        if len(self._times) > 2 * _MOST_VALUES:
            self._times, self._values = (
                items[-_MOST_VALUES:] for items in (self._times, self._values))

    def of(self, shaft: str, header: AverageHeader) -> float:
        """Return the mean during an average of a shaft that came now, NaN where none is known."""
        start, end = header.start_time, header.end_time
        if not self.stamped:
            start, end = time.monotonic() - (end - start), time.monotonic()
            start = max(start, self._taken.get(shaft, -math.inf))
            self._taken[shaft] = end
        first, last = bisect_left(self._times, start), bisect_right(self._times, end)
        if first < last:
            return float(np.mean(self._values[first:last]))
        if last and start - self._times[last - 1] <= self.hold:
            return self._values[last - 1]
        return math.nan
