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
Explanations of doubtful pulses: which of them are true, which are strays, and what is missing.

A *path* says of each of the latest pulses whether it is true, and how many teeth after the true
pulse before it. It costs as much as what it assumes is unlikely: a stray, missing pulses, a speed
that jumps, intervals that scatter, or a prediction that was worse than others so far. The paths
are extended pulse by pulse, the unlikely ones are dropped. What all likely paths have in common is
decided.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
import math
from math import log1p
from operator import itemgetter, mul
from typing import NamedTuple

# Logarithms of how unlikely they are: of a stray, e^6 or 400 to 1. Lower ones take a late pulse
# for a stray and a missing one, higher ones a stray for a true pulse of a shaft that jumps. That
# more are missing costs less, since what hid the first one (a gap, a threshold) hides those beside
# it. A jump costs more than a stray and a missing pulse together, so that it is rather a displaced
# pulse.
STRAY, MISSING, MORE_MISSING, JUMP = 6.0, 5.0, 1.5, 12.0
# More, of a speed that falls to a half, a third, ... at once: rather, pulses are missing.
FRACTION, _WHOLE = 48.0, 0.03
#: the most that it costs to leave the prediction that was the best one so far
OTHER = 4.0
#: intervals that tell the scatter as surely as it can be
CERTAIN = 1e6
#: intervals that predict the next one
REACH = 8
_NEAREST = 1e-3  # intervals from its place at which no average shows that a pulse is displaced
# Below a stray and a missing pulse, so that a tooth beside a gap remains a tooth.
BELIEVED = 3.0  # the most that a deviation within a given tolerance costs
# Odds of 55 to 1. A larger margin decides later, a smaller one more often wrongly.
MARGIN = 4.0  # paths that cost so much more than the best one are out of the question
# As much as a jump and the margin: the best path may yet need a jump that another one does not.
_DROPPED = 16.0
_MOST_PATHS = 48  # bounds time and memory where nothing is clear
_SLOWED = 4  # intervals that show that a shaft slows down
_STOPS = 0.05  # of the speed, or of its square, that must be left


class LevelPrediction(NamedTuple):
    """
    The next level as a sum of the latest ones, with these `weights`.

    It is `cost` less likely to be the best one. With `slopes` it follows a change of speed.
    """

    cost: float
    slopes: bool
    weights: tuple[float, ...]


#: before any is known to be better
SIMPLE = (LevelPrediction(0.0, False, (1.0,)), LevelPrediction(0.0, True, (-1.0, 2.0)))


class Step(NamedTuple):
    """
    What a path says of a pulse: the slots `passed` since the last true one, 0 for a stray.

    `level` is that of its interval (NaN for a stray), which is `off` from what is expected. With
    `jumps` no speed explains it.
    """

    passed: int
    level: float = math.nan
    off: float = 0.0
    jumps: bool = False


_STRAY = Step(0)
_Prediction = tuple[float, bool, float, int]  # cost, whether it slopes, level, and its number


class Path(NamedTuple):
    """
    An explanation: its `cost`, and a step for each pulse.

    `last` (s) is the last true pulse, at `slot`, `recent` are the levels of the last intervals.
    With `jumped` the speed is no longer that of earlier intervals. The prediction number `using`
    is used. `stray_at` (s) is the latest stray.
    """

    cost: float
    last: float
    slot: int
    recent: tuple[float, ...] = ()
    using: int = 0
    jumped: bool = False
    steps: tuple[Step, ...] = ()
    stray_at: float = -math.inf

    @property
    def passed(self) -> tuple[int, ...]:
        """Return the slots passed from the last true pulse to each, 0 for a stray."""
        return tuple(step.passed for step in self.steps)


@dataclass(frozen=True)
class PathRules:
    """
    What decides about paths.

    `widths` (slot,) are the teeth from each slot to the next, with what is known of uneven marks.
    `scatter` is that of the intervals, relative to 1; deviations within `given` (slot,) are
    believed. Up to `maximum_missing` pulses may be missing. `expected` is the
    level that earlier intervals predict (None: not known), and the clock moves a pulse by up to a
    `tick` of the interval. As many intervals as `degrees` show the scatter (Student's t: of a few,
    it may be too small). A stray costs `stray`, any interval `each`; `most` paths are kept.
    """

    widths: Sequence[float]
    scatter: float
    given: Sequence[float]
    maximum_missing: int
    expected: float | None
    predictions: Sequence[LevelPrediction] = SIMPLE
    tick: float = 0.0
    degrees: float = CERTAIN
    stray: float = STRAY
    each: float = 0.0
    most: int = _MOST_PATHS

    def extend(self, paths: list[Path], pulse: float, limit: float = math.inf) -> list[Path]:
        """Return the paths with one more pulse that cost up to `limit`, the most likely first."""
        found: list[Path] = []
        predicted: dict[tuple[tuple[float, ...], int], list[_Prediction]] = {}
        for path in paths:
            if path.cost + self.stray <= limit:
                _, last, slot, recent, using, jumped, steps, _ = path
                found.append(Path(path.cost + self.stray, last, slot, recent, using, jumped,
                                  (*steps, _STRAY), pulse))
            if pulse > path.last and path.cost + self.each <= limit:
                # Paths that differ in strays only expect the same.
                known = path.recent, path.using
                if known not in predicted:
                    predicted[known] = self._expected(*known)
                found += self._true(path, pulse, limit, predicted[known])
            if found:  # a path that costs more than those that are kept is not looked at
                found.sort(key=itemgetter(0))
                del found[self.most:]
                limit = min(limit, found[0].cost + _DROPPED,
                            found[-1].cost if len(found) == self.most else limit)
        return [path for path in found if path.cost <= limit]

    def _true(self, path: Path, pulse: float, limit: float, expected: list[_Prediction]
              ) -> list[Path]:
        """Return paths on which the next pulse (s) is true: those that cost up to `limit`."""
        before, last, slot, recent, chosen, jumped, steps, stray_at = path
        gap, width = pulse - last, 0.0
        found = []
        for passed in range(1, 2 + self.maximum_missing):
            if passed > 1 and before + MISSING + MORE_MISSING * (passed - 2) + self.each > limit:
                break
            width += self.widths[slot]
            slot = (slot + 1) % len(self.widths)
            level = math.log(gap / width)
            cost, off, using = self._deviation(path, expected, level, passed)
            jumps = cost == JUMP
            if passed > 1 and not jumps:
                cost += MISSING + MORE_MISSING * (passed - 2) + self._by_chance(path, gap / width)
            total = before + cost + self.each
            if (passed == 1 or not jumps) and total <= limit:
                taken = (*steps, Step(passed, level, off, jumps))
                if jumps:  # of the angle, and the speed stays as it was; or of the speed
                    found += [
                        Path(total, pulse, slot, recent, chosen, jumped, taken, stray_at),
                        Path(total + (FRACTION if is_multiple(off) else 0.0), pulse, slot,
                             (*recent[-1:], level), chosen, True, taken, stray_at)]
                else:
                    found.append(Path(total, pulse, slot, (*recent, *(level,) * passed)[-REACH:],
                                      using, jumped, taken, stray_at))
            if off < 0.0:
                break  # with more missing pulses it would be shorter still
        return found

    def _by_chance(self, path: Path, interval: float) -> float:
        """
        Return how unlikely it is that a stray comes so near to where a pulse is missing.

        Before the interval is known, a displaced pulse looks like that, and the others tell it.
        """
        if self.expected is None or path.stray_at <= path.last:
            return 0.0
        off = (path.stray_at - path.last) / interval
        return max(-math.log(2.0 * max(abs(off - max(round(off), 1)), _NEAREST)), 0.0)

    def _expected(self, recent: tuple[float, ...], using: int) -> list[_Prediction]:
        """Return cost, whether it slopes, expected level and number of the predictions."""
        found = []
        slows = len(recent) > _SLOWED and all(
            after > before for before, after in pairwise(recent[-1 - _SLOWED:]))
        for number, (cost, slopes, weights) in enumerate(self.predictions):
            size = len(weights)
            if size > len(recent):
                continue
            cost = 0.0 if number == using else cost
            found.append((cost, slopes, sum(map(mul, weights, recent[-size:])), number))
            if size == 2 and slows:
                found += [(cost, slopes, level, number)
                          for level in slowing(recent[-1], recent[-2])]
        return found

    def _deviation(self, path: Path, expected: list[_Prediction], level: float, passed: int
                   ) -> tuple[float, float, int]:
        """
        Return how unlikely a level is, its deviation from what is expected, and by which number.

        With missing pulses `level` is that of the mean of `passed` intervals; where the speed
        changes, it lies half way along them.
        """
        best, off, using = math.inf, 0.0, path.using
        half, tick = 0.5 * (passed - 1), self.tick / passed
        scatter, degrees = self.scatter, self.degrees
        for cost, slopes, each, number in expected:
            if cost >= best:
                continue
            apart = level - each
            if slopes and passed > 1:
                apart = min(apart, apart - half * (each - path.recent[-1]), key=abs)
            beyond = max(abs(apart) - tick, 0.0) / scatter
            if beyond:  # or NaN
                cost += 0.5 * (degrees + 1.0) * log1p(beyond * beyond / degrees)
            if cost < best:
                best, off, using = cost, apart, number
        off = math.expm1(off)
        given = off
        if self.expected is not None and not path.jumped:
            given = math.expm1(level - self.expected)
        best = min(best, JUMP) if expected else 0.0
        return min(best, BELIEVED) if abs(given) <= self.given[path.slot] else best, off, using


def slowing(level: float, before: float) -> list[float]:
    """
    Return the next level of a shaft that friction slows down: viscous, and dry.

    The one takes as much speed in each interval, the other as much of its square. Neither is
    expected where so little would be left that the shaft stops.

    >>> [round(math.exp(item), 3) for item in slowing(math.log(1.25), 0.0)]
    [1.667, 1.89]
    """
    ratio = math.exp(before - level)  # of the latest speed over the one before
    return [level + math.log(ratio) - math.log(2.0 * ratio**power - 1.0) / power
            for power in (1.0, 2.0) if 2.0 * ratio**power > 1.0 + _STOPS]


def is_multiple(off: float) -> bool:
    """Whether an interval that is longer by `off` of another one is two, three, ... of them."""
    times = 1.0 + off
    return times > 1.5 and abs(times / round(times) - 1.0) < _WHOLE


def likely(paths: list[Path]) -> list[Path]:
    """Return the paths that are not out of the question, of those sorted by cost."""
    return [path for path in paths if path.cost < paths[0].cost + MARGIN]
