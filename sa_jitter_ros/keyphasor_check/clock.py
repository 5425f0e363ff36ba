# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The clock that timed the pulses, or the last decimal of their times."""

import numpy as np
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.effects.lattice import Clock, NO_CLOCK
from sa_jitter_ros.pulses.clock_grid import find_grid

_MOST = 4000
_FEWEST = 12
_DECIMALS = 1e6  # Hz; a power of ten from there on may be a decimal
#: steps of a float64 by which a difference of pulse times may be off
ROUNDING = 4.0


def find_clock(times: FloatArray, *, largest: float = 0.0) -> Clock:
    """
    Return the clock whose ticks all pulse `times` (n,) in s are; its rate is 0 where none is.

    `largest` is the largest time in s before any shift, which decides how times are rounded.

    >>> times = np.ceil(np.linspace(1.0, 3.0, 200) ** 2 * 51200.0) / 51200.0
    >>> round(find_clock(times).rate, 3)
    51200.0
    """
    times = np.unique(times[:_MOST])
    if times.size < _FEWEST:
        return NO_CLOCK
    rounding = ROUNDING * float(np.spacing(max(np.max(np.abs(times)), largest)))
    grid = find_grid(times, rounding)
    if grid is not None and is_decimal(grid[0]):  # a coarser one may be behind it
        grid = find_grid(times, rounding, 2.0 / grid[0]) or grid
    if grid is None or rounding * grid[0] > 1.0:  # the last digit of the times themselves
        return NO_CLOCK
    return Clock(*grid)


def is_decimal(rate: float) -> bool:
    """Return whether a clock of this rate in Hz may be the last decimal of written times."""
    power = 10.0 ** round(float(np.log10(rate))) if rate else 0.0
    return power >= _DECIMALS and abs(rate / power - 1.0) < 1e-6
