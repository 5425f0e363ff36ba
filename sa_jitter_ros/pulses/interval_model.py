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
What the intervals of a shaft say about the next one: its expected length, and their scatter.

Intervals are compared by their logarithm (*level*), so that a constant acceleration in percent is
a straight line. Four predictions run beside each other: the last interval, the line through the
last two, the mean of the last eight and the line through these. A steady shaft with jitter is
predicted best by the mean, a run-up by a line. The one with the smallest errors is used. The
scatter of its errors gives the tolerance: narrow for a steady shaft, wide for an unsteady one.
"""

from collections import deque
from collections.abc import Sequence
from itertools import pairwise
import math
from math import expm1
from operator import mul

import numpy as np
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.pulses.clock_grid import clock_tick, LONGEST_TICK
from sa_jitter_ros.pulses.pulse_chain import robust_square
from sa_jitter_ros.pulses.pulse_paths import LevelPrediction, OTHER, REACH

_PLACE = np.arange(1, REACH + 1) - 0.5 * (REACH + 1)  # of the latest interval last
_LINE = 1.0 / REACH + _PLACE * 0.5 * (REACH + 1) / float(np.sum(_PLACE**2))
_WEIGHTS = ((1.0,), (-1.0, 2.0), (1.0 / REACH,) * REACH, tuple(_LINE.tolist()))
_LINES = _WEIGHTS[1::2]
_ALL_WEIGHTS = np.array([(0.0,) * (REACH - len(item)) + item for item in _WEIGHTS])
_LARGEST = 700.0  # whose exponential is finite
#: Standard deviations within which an interval is regular: one of 1e9 normal ones is not.
WIDTH = 6.0
_BELIEVED = 3.0  # standard deviations that a given tolerance stands for at least
_WIDEST = 0.45  # of an interval: from a half on a missing pulse looks like a late one
_UNSTEADY, _HIDING = 0.6, 0.15  # of a speed that scatters; and that hides a missing pulse
_NO_SHAFT = 0.2  # scatter of pulses that come at random: 0.3 and more
# What is assumed about the scatter before it is known, and how many intervals that counts for.
_PRIOR, _PRIOR_COUNT = 0.01, 0.05
_UNCERTAIN = 2.0  # of n intervals the scatter may be too small by a factor 1 + this / n
_MEMORY = 64.0  # intervals after which the scatter is forgotten
_WINDOW = 64  # intervals that show the tick of a clock
# Ticks by which an interval may differ from each prediction: a pulse is up to half a tick off, and
# as much again by half for the jitter of the shaft. Widths of marks are known to a tick.
_TICKS = tuple(0.75 * sum(abs(second - first) for first, second in pairwise(
    (0.0, 1.0, *(-item for item in reversed(weights)), 0.0))) for weights in _WEIGHTS)
# Fractions of a trigger cycle: smallest tolerance, displacement that no average shows, distance of
# two pulses of one mark. A pulse further off its expected time waits for the next one, which tells
# if it was a stray; the nearer one of two is the pulse.
_FLOOR, _HARMLESS, _SAME = 1e-3, 1e-3, 3e-3
# Of a trigger cycle: longest tick that a single step of equal intervals shows, and that a longer
# interval beside a shorter one shows. These two may differ by _OPPOSITE of their deviation.
_LONE_STEP, _LONE_PAIR, _OPPOSITE = 0.015, 0.006, 0.2
# A longer step is a tick if pulses stay so much later, or earlier, and such a step comes again, so
# many intervals later, with the same size: a displaced pulse comes back. As many of the latest
# _STEPS are compared as it takes until they would agree by chance once in 1000 times.
_APART, _STEPS, _BY_CHANCE = 3.0, 8, 1e-3


class IntervalModel:
    """
    Expected level of the next interval and the tolerance, both learnt from the intervals so far.

    `given` is the tolerance that the user gave, 0 to learn it. A trigger cycle has
    `pulses_per_trigger` intervals. The scatter is computed anew after every `block` intervals,
    whatever the size of the pieces in which they come. There are `marks` intervals a revolution.

    >>> model = IntervalModel(given=0.0, pulses_per_trigger=1, block=8)
    >>> model.start(0.0, scatter=0.01, count=20)
    >>> [round(off, 2) for off in model.deviations([0.0, math.log(1.1)])]
    [0.0, 0.1]
    >>> round(model.tolerance, 3)
    0.066
    """

    def __init__(self, *, given: float, pulses_per_trigger: int, block: int, marks: int = 1
                 ) -> None:
        self.given, self.block = given, block
        self._window, self._of_marks = max(_WINDOW, 3 * marks), float(marks > 1)
        self._floor = min(_FLOOR * pulses_per_trigger, 0.03)
        self._harmless, self._same = (
            min(share * pulses_per_trigger, 0.1) for share in (_HARMLESS, _SAME))
        self._cycle = pulses_per_trigger
        self._steps = deque[float](maxlen=_STEPS)  # sizes (s) of the latest ones in doubt
        self._stepped = -math.inf  # time (s) of the last of these
        self._before = np.arange(block) + np.arange(REACH)[:, None]  # levels that predict others
        self.start(0.0, scatter=_PRIOR, count=1)

    def start(self, level: float, *, scatter: float, count: int, intervals: Sequence[float] = (),
              unsteady: bool = False) -> None:
        """
        Begin with this level; `count` intervals had this scatter, relative to 1.

        `intervals` (k,) in s show the tick of a clock. If `unsteady`, the speed scatters so.
        """
        self.unsteady = unsteady
        self._levels = [level] * REACH
        self._variance = np.full(len(_WEIGHTS), scatter**2)
        #: so many intervals tell the scatter
        self.degrees = float(count)
        #: number of the prediction that is the best one
        self.chosen = 0
        self._settling = REACH
        self._intervals = deque(intervals, maxlen=self._window)
        #: of the clock, relative to the interval, 0 for none; and when it was seen (s)
        self.tick = self._latest = 0.0
        #: regular intervals since the beginning
        self.taken = 0
        self._set_tolerance()

    @property
    def room(self) -> int:
        """Return the number of intervals until the scatter is computed anew."""
        return self.block + REACH - len(self._levels)

    @property
    def irregular(self) -> bool:
        """Whether the intervals scatter so much that they are not those of a shaft."""
        return not self.given and self.scatter > (_UNSTEADY if self.unsteady else _NO_SHAFT)

    @property
    def has_tick(self) -> bool:
        """Whether the latest intervals are multiples of the tick of a clock."""
        return bool(self.tick or clock_tick(np.array(self._intervals), 0.0))

    @property
    def level(self) -> float:
        """Level of the last interval."""
        return self._levels[-1]

    @property
    def recent(self) -> tuple[float, ...]:
        """Levels of the last intervals."""
        return tuple(self._levels[-REACH:])

    @property
    def predictions(self) -> list[LevelPrediction]:
        """Return the predictions, each with how unlikely it is to be the best one."""
        variance = np.maximum(self._variance, (self._floor / WIDTH)**2)
        prices = np.minimum(OTHER, 0.5 * self.degrees * np.log(variance / variance.min()))
        if self._settling:
            prices[:] = 0.0
        return [LevelPrediction(float(price), weights in _LINES, weights)
                for price, weights in zip(prices, _WEIGHTS)]

    @property
    def expected(self) -> float:
        """Return the expected level of the next interval."""
        return _expected(_WEIGHTS[self.chosen], self._levels, len(self._levels))

    def deviations(self, levels: list[float]) -> list[float]:
        """Return by how much each of the next levels is off, relative to its interval."""
        every = self._levels + levels
        place = len(self._levels)
        # Until then it is not known which prediction is the best one.
        settled = len(every) if self.given else min(place + self._settling, len(every))
        found = [min((expm1(min(every[number] - _expected(weights, every, number), _LARGEST))
                      for weights in _WEIGHTS), key=abs) for number in range(place, settled)]
        weights = _WEIGHTS[self.chosen]
        return found + [expm1(min(every[number] - _expected(weights, every, number), _LARGEST))
                        for number in range(settled, len(every))]

    def accept(self, levels: list[float], intervals: Sequence[float] = ()) -> None:
        """Take the next regular levels, at most `room`, and their intervals in s."""
        self.taken += len(levels)
        self._levels += levels
        self._intervals.extend(intervals)
        self._settling = max(self._settling - len(levels), 0)
        if not self.room:
            self._learn()

    def jump(self, level: float) -> None:
        """Take a level that was not expected: the next ones may follow it."""
        self.accept([level])
        self._settling = REACH

    def explains(self, intervals: FloatArray, widths: FloatArray, latest: float) -> bool:
        """
        Whether a clock explains these doubtful intervals (n,) in s; the tolerance is wider then.

        They are from mark to mark, of relative `widths` (n,), and end at the time `latest` (s).
        """
        length = math.exp(self.expected)
        tick = clock_tick(np.array([*self._intervals, *intervals]), latest) / length
        off = intervals / length - widths  # a displaced pulse: one is longer, the other shorter
        opposite = abs(off.sum()) < _OPPOSITE * np.abs(off).max()
        # If all others are equal, a displaced pulse or a step of the time looks like a tick, too.
        if tick > (_LONE_PAIR if opposite else _LONE_STEP) * self._cycle and not clock_tick(
                np.array(self._intervals), latest):
            tick = 0.0
        tick = max(tick, self._recurring(off * length, length, latest) / length)
        if tick <= self.tick:
            return False
        before, self.tick, self._latest = self.tolerance, tick, latest
        self._set_tolerance()
        return self.tolerance > before

    def _recurring(self, off: FloatArray, length: float, latest: float) -> float:
        """
        Return the size (s) of a step that pulses take again and again, 0.0 for none.

        The doubtful intervals, of about this `length` (s), are `off` (n,) in s from what is
        expected.
        """
        size = abs(float(off[0]))
        if off.size < 2 or abs(off[1]) > _OPPOSITE * size or not (
                self.tolerance < size / length <= LONGEST_TICK) or (
                abs(latest - self._stepped) <= _APART * length):
            return 0.0
        self._steps.append(size)
        self._stepped = latest
        for count in range(2, len(self._steps) + 1):
            sizes = np.array(self._steps)[-count:]
            if (np.ptp(sizes) / sizes.mean())**(count - 1) < _BY_CHANCE:
                return float(sizes.mean())
        return 0.0

    def _learn(self) -> None:
        every, weight = np.array(self._levels), self.block / min(
            self.degrees + self.block, _MEMORY)
        off = np.expm1(every[REACH:] - _ALL_WEIGHTS @ every[self._before])
        square = robust_square(np.minimum(off * off, self.tolerance**2))
        self._variance += weight * (square - self._variance)
        self.degrees = min(self.degrees + self.block, _MEMORY)
        self.chosen = int(np.argmin(self._variance))
        del self._levels[:-REACH]
        if self.tick:  # the smallest so far; others may show that it is a fraction of that
            tick = clock_tick(np.array(self._intervals), self._latest) / math.exp(self.expected)
            self.tick = min(self.tick, tick or self.tick)
        self._set_tolerance()

    def _set_tolerance(self) -> None:
        total = _PRIOR_COUNT * _PRIOR**2 + self.degrees * float(self._variance[self.chosen])
        #: standard deviation of the error of a prediction, relative to the interval
        learnt = math.sqrt(total / (_PRIOR_COUNT + self.degrees)) * (
            1.0 + _UNCERTAIN / self.degrees)
        self.scatter = max(learnt, self._floor / WIDTH,
                           (_TICKS[self.chosen] + self._of_marks) * self.tick / WIDTH)
        if self.given:
            self.scatter = min(self.scatter, self.given / _BELIEVED)
        #: the speed scatters so much that a missing pulse does not show
        self.hides_missing = self.unsteady and self.scatter > _HIDING
        widest = WIDTH * self.scatter
        if not self.hides_missing:
            widest = min(widest, _WIDEST)
        #: a deviation up to this is regular
        self.tolerance = self.given or widest
        #: a deviation up to this passes without looking at the next pulse
        self.harmless = min(widest, self._harmless, self.tolerance)
        #: pulses nearer to each other are of one mark
        self.same = min(widest, self._same, self.tolerance)


def _expected(weights: tuple[float, ...], levels: list[float], place: int) -> float:
    """Return what is expected of the level at this place, from those before it."""
    total: float = sum(map(mul, weights, levels[place - len(weights):place]))
    return total
