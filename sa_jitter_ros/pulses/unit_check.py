# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Pulse times that are not in seconds, not in order, or not on the clock of the vibration."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

_MUCH = 10.0  # pulses that span so many times the vibration are in another unit


def likely_mistake(pulses: NDArray[Any], start: float, end: float, rate: float) -> str:
    """
    Return what is probably wrong with pulse times that do not fit the vibration, '' if they fit.

    The vibration is sampled at `rate` (Hz) from `start` to `end` (s).

    >>> likely_mistake(np.arange(0.0, 4000.0, 40.0), 0.0, 4.0, 5e3)  # doctest: +ELLIPSIS
    'the pulses span 3960 s, the vibration spans 4 s: the pulse times look like milliseconds; ...'
    """
    times = pulses[np.isfinite(pulses)].astype(np.float64)
    if times.size < 2 or end <= start:
        return ''
    backwards = int(np.count_nonzero(np.diff(times) < 0.0))
    if 2 * backwards >= times.size:
        return (f'{backwards} of {times.size} pulse times are earlier than the one before: give '
                'them in order of time, numpy.sort(pulse_times)')
    duration, span = end - start, float(np.ptp(times))
    spans = f'the pulses span {span:.6g} s, the vibration spans {duration:.6g} s'
    if span > _MUCH * duration:
        units = {'sample indices': rate, 'milliseconds': 1e3, 'microseconds': 1e6}
        unit = min(units, key=lambda name: abs(math.log(span / (units[name] * duration))))
        if 0.5 < span / (units[unit] * duration) < 2.0:
            return (f'{spans}: the pulse times look like {unit}; divide them by '
                    f'{units[unit]:g} to have seconds')
        return f'{spans}: give pulse times in s, and sample_rate in Hz'
    if span * _MUCH**2 < duration:
        return f'{spans}: give pulse times in s, and sample_rate in Hz'
    if times.max() < start or times.min() > end:
        return (f'the pulses come from {times.min():.6g} s to {times.max():.6g} s, when there is '
                'no vibration: set start_time to the time of the first sample on the clock of the '
                'pulses')
    return ''
