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
The clock that timed the pulses.

`find_clock` of the effects finds the grid where intervals repeat. Where they do not, because the
speed changes, the intervals still differ by multiples of the tick: by few ticks those that are
nearly equal, from which the tick follows step by step over longer and longer times.
"""

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.effects.lattice import Clock, find_clock

FloatArray = NDArray[np.float64]

_MOST = 4000
_LEAST_TICKS = 4.0  # in an interval
_FEWEST = 12
_EXACT = 0.02  # of a tick, beside the rounding of the times
_SMALL_GAPS = 12
_FEWEST_DECIMALS = 6
_PARTS = 40
_REPEATED = 0.5  # of the intervals


def clock_of(times: FloatArray, *, largest: float = 0.0) -> Clock:
    """
    Return the clock whose ticks all pulse `times` (n,) in s are; its rate is 0 where none is.

    `largest` is the largest time in s before any shift, which decides how times are rounded.

    >>> times = np.ceil(np.linspace(1.0, 3.0, 200) ** 2 * 51200.0) / 51200.0
    >>> round(clock_of(times).rate, 3)
    51200.0
    """
    times = np.unique(times[:_MOST])
    if times.size < _FEWEST:
        return Clock(0.0, 0.0)
    rounding = 4.0 * float(np.spacing(max(np.max(np.abs(times)), largest)))
    times = _repeating(times, rounding)
    found = find_clock(times)
    found = found if found.rate else _of_changing_speed(times, rounding)
    if is_decimal(found):  # a coarser grid may be behind the decimals
        coarser = _of_changing_speed(times, 1.0 / found.rate)
        found = coarser if coarser.rate else found
    if found.rate * rounding > 1.0:  # the last digit of the times themselves
        return Clock(0.0, 0.0)
    return found


def _repeating(times: FloatArray, rounding: float) -> FloatArray:
    """Return the pulses beside an interval that another one equals, if most have one."""
    intervals = np.diff(times)
    order = np.argsort(intervals)
    same = np.diff(intervals[order]) <= 2.0 * rounding
    repeated = np.zeros(intervals.size, np.bool_)
    repeated[order] = np.append(same, False) | np.append(False, same)
    if np.mean(repeated) < _REPEATED:
        return times
    return np.asarray(times[np.append(repeated, False) | np.append(False, repeated)])


def is_decimal(clock: Clock) -> bool:
    """Return whether a clock may be the last decimal of written times."""
    power = round(float(np.log10(clock.rate))) if clock.rate else 0
    return power >= _FEWEST_DECIMALS and abs(clock.rate / 10.0**power - 1.0) < 1e-6


def _of_changing_speed(times: FloatArray, rounding: float) -> Clock:
    none = Clock(0.0, 0.0)
    intervals = np.sort(np.diff(times))
    intervals = intervals[intervals < 1.5 * np.median(intervals)]
    gaps = np.sort(np.diff(intervals))
    gaps = gaps[gaps > 2.0 * rounding]
    if not gaps.size:
        return none
    gaps = gaps[np.append(True, np.diff(gaps) > 2.0 * rounding)][:_SMALL_GAPS]
    for part in range(1, _PARTS + 1):
        tick = _refined(gaps, float(gaps[0]) / part) or np.inf
        if np.all(np.abs(gaps / tick - np.rint(gaps / tick)) < 0.1 + 2.0 * rounding / tick) and (
                np.isfinite(tick)):
            break
    else:
        return none
    elapsed = times - times[0]
    for base in intervals - intervals[0], elapsed:
        refined = _refined(base[base > 0.0], tick)
        if refined is None:
            return none
        tick = refined
    ticks = np.rint(elapsed / tick)
    for part in range(_PARTS, 1, -1):  # rounded gaps may have given a part of the tick
        if np.all(ticks % part == 0.0):
            tick, ticks = tick * part, ticks / part
    scatter = float(np.std(elapsed - tick * ticks))
    if scatter > _EXACT * tick + rounding or scatter > 0.1 * tick:
        return none
    if tick > np.quantile(intervals, 0.1) / _LEAST_TICKS:
        return none
    return Clock(1.0 / tick, max(scatter, rounding) / float(ticks[-1]) / tick**2)


def _refined(lengths: FloatArray, tick: float) -> float | None:
    """Return the tick of which all lengths (n,) in s, the short ones first, are multiples."""
    count = 2
    while True:
        ticks = np.rint(lengths[:count] / tick)
        if ticks[-1] >= 1.0:
            if np.max(np.abs(lengths[:count] / tick - ticks)) > 0.35:
                return None
            tick = float(lengths[:count] @ ticks / (ticks @ ticks))
        if count >= lengths.size:
            return tick
        # By no more than doubles the length, so that the ticks in it are known.
        reach = int(np.searchsorted(lengths, 2.0 * lengths[count - 1]))
        count = min(max(reach, count + 1), lengths.size)
