# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The grid of a clock in pulse times: how it is found, and the error it implies for each pulse."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.pulses.clock_grid import find_grid
from scipy import special
from scipy.linalg import cho_solve_banded, cholesky_banded

#: Relative difference of rates below which two clocks count as one.
SAME_RATE = 0.01
#: Of a tick: what errors that a clock makes may be wrong by, and what none is seen below.
ROOM = 0.02
#: What the slope of errors over those of the smoothest motion on a grid may be off by.
SLOPE_OFF = 0.25
_STEPS = 3000
# Least difference of intervals, in parts of the largest; ticks by which equal ones differ.
_LEAST_GAP, _SAME = 1e-3, 0.05


@dataclass(frozen=True)
class Clock:
    """
    A clock of `rate` Hz (0 where there is none) with its standard error.

    Jitter that moves pulses over the ticks of a `dithered` one makes their errors independent.
    """

    rate: float
    standard_error: float
    dithered: bool = False

    def same_as(self, rate: float) -> bool:
        """Return whether it is a clock of this `rate`."""
        return abs(self.rate - rate) < SAME_RATE * rate

    def visible(self, declared: float) -> bool:
        """Return whether there is one whose tick is not lost in one of the `declared` rate."""
        return 0.0 < ROOM * self.rate < declared


NO_CLOCK = Clock(0.0, 0.0)


def find_clock(times: Array) -> Clock:
    """
    Find the clock whose ticks are all pulse `times` (n,) in s.

    A machine whose intervals never repeat to within the rounding of its clock shows no grid.
    """
    intervals = np.sort(np.diff(times))
    gaps = np.diff(intervals[intervals < 1.5 * np.median(intervals)])
    least = rounding(times)
    grid = find_grid(times, least, max(_LEAST_GAP * float(np.max(gaps, initial=0.0)), least))
    if grid is None or np.count_nonzero(gaps <= _SAME / grid[0]) < 0.5 * gaps.size:
        return NO_CLOCK
    return Clock(*grid)


def rounding(times: Array) -> float:
    """Return what the difference of two intervals of `times` may be wrong by, as numbers."""
    return 4.0 * float(np.spacing(np.max(np.abs(times))))


def coarsest_clock(times: Array) -> float | None:
    """Return the rate of the coarsest clock whose grid pulse times could lie on."""
    intervals = np.sort(np.diff(times))
    steps = np.diff(intervals)
    steps = steps[steps > rounding(times)]
    return float(1.0 / steps.min()) if steps.size else None


def smooth_on_grid(times: Array, clock_rate: float) -> Array:
    """
    Return the errors (n,) in s, less half a tick, of `times` rounded up to a clock.

    The true times are those of the smoothest motion that lies within one tick of the measured
    ones: the least sum of squared second differences under these bounds, by the alternating
    direction method of multipliers.
    """
    n = times.size
    if n < 3:
        return np.zeros(n)
    half, index = 0.5, np.arange(n)
    trend = np.polynomial.Polynomial.fit(index, times, 1)(index)
    middle = (times - trend) * clock_rate  # ticks; the true time lies within `half` of it
    penalty = _squared_second_difference(n)
    mass = 0.02
    factors = {}
    x, z, y = middle.copy(), middle.copy(), np.zeros(n)
    for step in range(_STEPS):
        if mass not in factors:
            matrix = penalty.copy()
            matrix[-1] += mass
            factors[mass] = cholesky_banded(matrix)
        x = cho_solve_banded((factors[mass], False), mass * (z - y))
        relaxed = 1.6 * x - 0.6 * z
        before = z
        z = np.clip(relaxed + y, middle - half, middle + half)
        y = y + relaxed - z
        primal, dual = np.max(np.abs(x - z)), np.max(np.abs(z - before))
        if primal < 1e-3 and dual < 1e-4:
            break
        if step % 50 == 49 and step < 1000:  # balance the two residuals
            factor = 2.0 if primal > 10.0 * dual else 0.5 if dual > 10.0 * primal else 1.0
            mass, y = mass * factor, y / factor
    true = np.clip(x, middle - half, middle + half)
    return np.asarray((middle - true) / clock_rate)


def placed_on_grid(errors: Array, clock_rate: float) -> tuple[Array, float]:
    """Return errors (n,) in s moved within half a tick where possible, and the RMS beyond it."""
    tick, errors = 1.0 / clock_rate, errors - np.median(errors)
    offsets = np.linspace(-tick, tick, 201)
    excess = np.maximum(np.abs(errors[None, :] + offsets[:, None]) - 0.5 * tick, 0.0)
    cost = np.mean(excess**2, axis=1)
    best = offsets[cost <= cost.min() + 1e-30].mean()
    return np.asarray(errors + best), float(np.sqrt(cost.min()))


def ticks_leave_room(errors: Sequence[Array], variance: float, clock_rate: float) -> bool:
    """
    Return whether a clock alone can make the pulse errors (pulse,) of some stretches, in s.

    `variance` is that of what the errors are wrong by.
    """
    beyond = np.mean([placed_on_grid(row, clock_rate)[1] ** 2 for row in errors])
    return bool(beyond < max(variance, (ROOM / clock_rate) ** 2))


def _log_likelihood(errors: Sequence[Array], variance: float, clock_rate: float) -> float:
    """
    Return how likely a clock makes the pulse errors (pulse,) of some stretches, in s.

    They are uniform over a tick, and wrong by normal errors of `variance`, as large as
    `ticks_leave_room` lets them be at least.
    """
    std = max(np.sqrt(variance) * clock_rate, ROOM)
    total = 0.0
    for row in errors:
        placed = clock_rate * np.abs(placed_on_grid(row, clock_rate)[0])
        total += float(np.sum(special.log_ndtr((0.5 - placed) / std)))
    return total


def sizes_within_ticks(left: Callable[[float], Sequence[Array]], tried: Array, variance: float,
                       clock_rate: float) -> tuple[Array, Array]:
    """
    Return those of the sizes `tried` beside which a clock alone can make the errors `left` by one.

    With them comes the probability of each, if all are as likely before. `left` gives errors
    (pulse,) of some stretches in s, and `variance` is that of what they are wrong by.
    """
    possible = tried[[ticks_leave_room(left(size), variance, clock_rate) for size in tried]]
    likely = np.array([_log_likelihood(left(size), variance, clock_rate) for size in possible])
    return possible, special.softmax(likely) if likely.size else likely


def within_half_tick(errors: Array, clock_rate: float) -> Array:
    """Return errors (n,) in s that a clock can make: beyond half a tick, whole ticks go."""
    tick = 1.0 / clock_rate
    placed, _ = placed_on_grid(errors, clock_rate)
    far = np.abs(placed) > 0.75 * tick
    return np.asarray(np.where(far, placed - tick * np.rint(placed / tick), placed))


def _squared_second_difference(n: int) -> Array:
    """Return D'D of the second difference, upper banded form (3, n)."""
    bands, difference = np.zeros((3, n)), np.array([1.0, -2.0, 1.0])
    for k in range(3):
        bands[2 - k, k:] = np.convolve(np.ones(n - 2), difference[:3 - k] * difference[k:])
    return bands
