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
The tick of the clock that times the pulses: of a slow one from a few intervals, else from all.

No shaft has equal intervals. If most of a few are equal, a clock rounds them, and all are whole
multiples of its tick. At a changing speed intervals still differ by multiples of the tick: by few
ticks those that are nearly equal, from which it follows step by step over longer and longer times.
"""

import numpy as np
from sa_jitter_ros.arrays import FloatArray

_FEWEST = 6  # intervals
_DIFFERENT = 0.5  # most of the intervals that differ from all others
LONGEST_TICK = 0.2  # of the median interval; what differs by more is no tick
_WHOLE = 0.02  # ticks by which an interval may differ from a whole number of them
_PARTS = 3  # of the smallest difference seen, that a tick may be
_STAMP = 2.5e-9  # s, rounding of time stamps
# Of a whole recording: smallest differences of intervals from which the tick follows, the most
# ticks in the smallest one, least ticks in an interval, and scatter in ticks.
_SMALL_GAPS, _MOST_TICKS, _LEAST_TICKS, _EXACT = 12, 40, 4.0, 0.02


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
    differ = np.diff(values) > rounding
    if values.size < _FEWEST or np.count_nonzero(differ) + 1 > _DIFFERENT * values.size:
        return 0.0
    values = values[np.append(differ, True)]
    smallest = float(np.diff(values).min(initial=np.inf))
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


def find_grid(times: FloatArray, rounding: float, least: float = 0.0
              ) -> tuple[float, float] | None:
    """
    Return the rate (Hz) of the coarsest grid of which all `times` (n,) are points; None for none.

    The second result is its standard error. The times are in s and ascend; `rounding` (s)
    is that of the difference of two intervals; differences of intervals up to `least` (s) are
    none.

    >>> times = np.ceil(np.linspace(1.0, 3.0, 200) ** 2 * 51200.0) / 51200.0
    >>> round(find_grid(times, 1e-14)[0], 3)
    51200.0
    """
    least = max(least, 2.0 * rounding)
    intervals = np.sort(np.diff(times))
    intervals = intervals[intervals < 1.5 * np.median(intervals)]
    gaps = np.sort(np.diff(intervals))
    gaps = gaps[gaps > least]
    if not gaps.size:
        return None
    gaps = gaps[np.append(True, np.diff(gaps) > least)][:_SMALL_GAPS]
    for part in range(1, _MOST_TICKS + 1):
        tick = _refined(gaps, float(gaps[0]) / part)
        if tick and np.all(np.abs(gaps / tick - np.rint(gaps / tick)) < (
                0.1 + least / tick)):
            break
    else:
        return None
    elapsed = times - times[0]
    for base in intervals - intervals[0], elapsed:
        tick = _refined(base[base > 0.0], tick)
        if not tick:
            return None
    ticks = np.rint(elapsed / tick)
    more = int(np.gcd.reduce(ticks.astype(np.int64)))  # rounded gaps may give a part of the tick
    centred = (ticks - ticks.mean()) / more
    power = float(centred @ centred)
    tick, ticks = float(elapsed @ centred) / power, ticks / more
    scatter = float(np.std(elapsed - tick * ticks))
    if scatter > min(_EXACT * tick + 0.5 * least, 0.1 * tick) or (
            tick > np.quantile(intervals, 0.1) / _LEAST_TICKS):
        return None
    # Rounding is no chance: it need not average out over the pulses.
    return 1.0 / tick, float(np.hypot(scatter / np.sqrt(power), rounding / ticks[-1])) / tick**2


def _refined(lengths: FloatArray, tick: float) -> float:
    """Return the tick of which all lengths (n,) in s, ascending, are multiples, 0.0 for none."""
    count = 2
    while True:
        ticks = np.rint(lengths[:count] / tick)
        if ticks[-1] >= 1.0:
            if np.max(np.abs(lengths[:count] / tick - ticks)) > 0.35:
                return 0.0
            tick = float(lengths[:count] @ ticks / (ticks @ ticks))
        if count >= lengths.size:
            return tick
        # By no more than doubles the length, so that the ticks in it are known.
        reach = int(np.searchsorted(lengths, 2.0 * lengths[count - 1]))
        count = min(max(reach, count + 1), lengths.size)
