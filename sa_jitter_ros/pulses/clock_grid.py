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
The tick of a slow clock that times the pulses, from the intervals of a few of them.

No shaft has equal intervals. If most are equal, a clock rounds them, and all are whole multiples
of its tick. `sa_jitter_ros.keyphasor_check.clock` finds those of fine clocks, from whole records.
"""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_FEWEST = 6  # intervals
_DIFFERENT = 0.5  # most of the intervals that differ from all others
LONGEST_TICK = 0.2  # of the median interval; what differs by more is no tick
_WHOLE = 0.02  # ticks by which an interval may differ from a whole number of them
_PARTS = 3  # of the smallest difference seen, that a tick may be
_STAMP = 2.5e-9  # s, rounding of time stamps


def clock_tick(intervals: FloatArray, latest: float) -> float:
    """
    Return the tick (s) whose multiples all intervals (n,) are, 0.0 without such a tick.

    `latest` is the latest time (s) from which they were computed: it tells their rounding.

    >>> clock_tick(np.array([0.25, 0.25, 0.26, 0.25, 0.25, 0.24, 0.26]), 10.0).__round__(9)
    0.01
    >>> clock_tick(np.array([0.25, 0.25, 0.253, 0.25, 0.25, 0.24, 0.251]), 10.0)
    0.0
    """
    rounding = _STAMP + 4.0 * float(np.spacing(abs(latest)))
    values = np.sort(intervals)
    last = np.append(np.diff(values) > rounding, True)
    if values.size < _FEWEST or np.count_nonzero(last) > _DIFFERENT * values.size:
        return 0.0
    values = values[last]
    steps = np.diff(values)
    if not steps.size:
        return 0.0
    smallest = float(steps.min())
    if not smallest <= LONGEST_TICK * float(np.median(intervals)):
        return 0.0
    for part in range(1, _PARTS + 1):
        tick = smallest / part
        ticks = np.rint((values - values[0]) / tick)
        tick = float((values - values[0]) @ ticks / (ticks @ ticks))
        slack = _WHOLE + values / tick * rounding / (values[-1] - values[0])
        if np.all(np.abs(values / tick - np.rint(values / tick)) <= slack):
            return tick
    return 0.0
