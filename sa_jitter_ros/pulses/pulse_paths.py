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
that jumps, or intervals that scatter. The paths are extended pulse by pulse, the unlikely ones are
dropped. What all likely paths have in common is decided.
"""

from collections.abc import Sequence
from dataclasses import dataclass
import math
from operator import itemgetter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

# Logarithms of how unlikely they are.
STRAY, MISSING, MORE_MISSING, JUMP = 6.0, 5.0, 1.5, 12.0
# More, of a speed that falls to a half, a third, ... at once: rather, pulses are missing.
FRACTION, _WHOLE = 48.0, 0.03
#: intervals that tell the scatter as surely as it can be
CERTAIN = 1e6
_NEAREST = 1e-3  # intervals from its place at which no average shows that a pulse is displaced
BELIEVED = 3.0  # the most that a deviation within a given tolerance costs
MARGIN = 4.0  # paths that cost so much more than the best one are out of the question
_DROPPED = 16.0
_MOST_PATHS, _MOST_OF_CHAIN = 48, 16
_FEW = 8
_CHAIN_COST = 6.0  # of an acceptable chain, for each pulse
#: cost of a stray among the first pulses of one mark, and of marks that may be uneven
STRAY_OF_ONE, STRAY_OF_MARKS = 8.0, 10.0
_LADDER = (0.002, 0.01, 0.05, 0.15)  # scatter that a chain is tried with
_REGULAR = 0.02
_SLOWED = 4  # intervals that show that a shaft slows down
_STOPS = 0.05  # of the speed, or of its square, that must be left
_LEAST = 1e-6  # of the longest interval; shorter ones are no pulses of one shaft


class Path(NamedTuple):
    """
    An explanation: `cost`, and of each pulse how many slots it is after the last true one.

    The mark of a stray is 0. `last` (s) is the last true pulse, at `slot` and `passed` teeth from
    where the path began, `level` and `before` those of the last two intervals (None: not known).
    With `jumped` the speed is no longer that of earlier intervals. `deviations` are those of the
    intervals of true pulses, 0 for strays; `levels` likewise. `stray_at` (s) is the latest stray.
    The last `slowed` intervals were each longer than the one before.
    """

    cost: float
    last: float
    slot: int
    passed: int
    level: float | None
    before: float | None
    jumped: bool = False
    marks: tuple[int, ...] = ()
    deviations: tuple[float, ...] = ()
    levels: tuple[float, ...] = ()
    stray_at: float = -math.inf
    slowed: int = 0

    def stray(self, pulse: float, cost: float) -> 'Path':
        """Return the path that takes the next pulse (s) for a stray."""
        return self._replace(cost=self.cost + cost, marks=(*self.marks, 0), stray_at=pulse,
                             deviations=(*self.deviations, 0.0), levels=(*self.levels, math.nan))


@dataclass(frozen=True)
class PathRules:
    """
    What decides about paths.

    `steps` (slot,) are the teeth from each slot to the next, `widths` (slot,) the same with what
    is known of uneven marks. `scatter` is that of the intervals, relative to 1; deviations within
    `given` (slot,) are believed. Up to `maximum_missing` pulses may be missing. `expected` is the
    level that earlier intervals predict (None: not known), and the clock moves a pulse by up to a
    `tick` of the interval. As many intervals as `told` show the scatter (Student's t: of a few,
    it may be too small). A stray costs `stray`, any interval `each`; `most` paths are kept.
    """

    steps: Sequence[int]
    widths: Sequence[float]
    scatter: float
    given: Sequence[float]
    maximum_missing: int
    expected: float | None
    tick: float = 0.0
    told: float = CERTAIN
    stray: float = STRAY
    each: float = 0.0
    most: int = _MOST_PATHS

    def extend(self, paths: list[Path], pulse: float) -> list[Path]:
        """Return the paths with one more pulse, the most likely first."""
        found = []
        for path in paths:
            found.append(path.stray(pulse, self.stray))
            found += self._true(path, pulse)
        found.sort(key=itemgetter(0))
        most = found[0].cost + _DROPPED
        return [path for path in found[:self.most] if path.cost <= most]

    def _true(self, path: Path, pulse: float) -> list[Path]:
        gap = pulse - path.last
        if gap <= 0.0:
            return []
        found: list[Path] = []
        width, passed, slot = 0.0, 0, path.slot
        for mark in range(1, 2 + self.maximum_missing):
            width += self.widths[slot]
            passed += self.steps[slot]
            slot = (slot + 1) % len(self.steps)
            level = math.log(gap / width)
            off = self._deviation(path, level, mark)
            beyond = max(abs(off) - self.tick / mark, 0.0)
            cost = min(0.5 * (self.told + 1.0) * math.log1p(
                (beyond / self.scatter)**2 / self.told), JUMP)
            if self._believed(path, level, off):
                cost = min(cost, BELIEVED)
            if mark > 1:
                if cost == JUMP:
                    if off < 0.0:
                        break
                    continue
                cost += MISSING + MORE_MISSING * (mark - 2) + self._by_chance(path, gap / width)
            if cost == JUMP:
                # The angle jumps, and the speed stays as it was; or the speed jumps.
                found.append(path._replace(
                    cost=path.cost + cost + self.each, last=pulse, slot=slot,
                    passed=path.passed + passed, marks=(*path.marks, mark),
                    deviations=(*path.deviations, off), levels=(*path.levels, level)))
            unlike = FRACTION if cost == JUMP and is_multiple(off) else 0.0
            found.append(path._replace(
                cost=path.cost + cost + unlike + self.each, last=pulse, slot=slot,
                passed=path.passed + passed, level=level, before=path.level,
                jumped=path.jumped or cost == JUMP, marks=(*path.marks, mark),
                deviations=(*path.deviations, off), levels=(*path.levels, level),
                slowed=path.slowed + 1 if path.level is not None and level > path.level else 0))
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

    def _believed(self, path: Path, level: float, off: float) -> bool:
        """Whether the deviation from what the intervals before all paths let expect is given."""
        if self.expected is not None and not path.jumped:
            off = math.expm1(level - self.expected)
        return abs(off) <= self.given[path.slot]

    def _deviation(self, path: Path, level: float, mark: int) -> float:
        """
        Return the deviation from the nearest of what the intervals before let expect.

        With missing pulses `level` is that of the mean of `mark` intervals; where the speed
        changes, it lies half way along them.
        """
        if path.level is None:
            return 0.0
        expected = [path.level]
        if self.expected is not None and not path.jumped:
            expected.append(self.expected)
        if path.before is not None:
            expected.append(2.0 * path.level - path.before)
            if path.slowed >= _SLOWED and path.level > path.before:
                expected += slowing(path.level, path.before)
        if mark > 1:
            half = 0.5 * (mark - 1)
            expected += [each + half * (each - path.level) for each in expected[1:]]
        return math.expm1(min((level - each for each in expected), key=abs))


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


def find_chain(pulses: FloatArray, scatter: float | None, *, stray: float = STRAY_OF_ONE
               ) -> tuple[IntArray, IntArray] | None:
    """
    Return which of the pulses (n,) follow each other regularly, and in how many intervals each.

    `scatter` is what earlier intervals had, None if it is not known. A stray costs `stray`. None
    without such a chain.

    >>> chain, steps = find_chain(np.array([0.0, 0.9, 1.0, 2.0, 3.0, 3.3, 5.0]), None)
    >>> chain.tolist(), steps.tolist()
    ([0, 2, 3, 4, 6], [1, 1, 1, 2])
    """
    intervals = np.diff(pulses)
    if intervals.size < 2 or not intervals.min() > _LEAST * intervals.max():
        return None
    levels = np.log(intervals)
    change = np.diff(levels)
    turn = np.append(change[0], np.diff(change))
    if np.all(np.minimum(np.abs(change), np.abs(turn)) <= _REGULAR):
        return np.arange(pulses.size), np.ones(intervals.size, np.int64)
    found, doubt = None, False
    for tried in _LADDER if scatter is None else (*_LADDER, scatter):
        # A wide normal distribution explains everything, but each interval with less density.
        each = math.log(tried / min(_LADDER)) if tried > min(_LADDER) else 0.0
        rules = PathRules((1,), (1.0,), tried, (0.0,), 1, None, stray=stray, each=each,
                          most=_MOST_OF_CHAIN)
        paths: list[Path] = []
        for number, pulse in enumerate(pulses.tolist()):
            paths = rules.extend(paths, pulse) if paths else []
            paths.append(Path(stray * number, pulse, 0, 0, None, None, False,
                              (0,) * number + (1,)))
        paths.sort(key=itemgetter(0))
        best = next((path for path in paths if _acceptable(path.marks)), None)
        if best is not None and (found is None or best.cost < found.cost):
            found = best
            doubt = best.cost > paths[0].cost + MARGIN
    if found is not None and not doubt and found.cost <= _CHAIN_COST * pulses.size:
        marks = np.array(found.marks, np.int64)
        true = np.flatnonzero(marks)
        return true, marks[true[1:]]
    return None


def _acceptable(marks: tuple[int, ...]) -> bool:
    """Whether enough pulses are true to call them a chain: of few all but one, of many a half."""
    true = sum(mark > 0 for mark in marks)
    least = len(marks) - (1 if len(marks) < 6 else 2)
    if len(marks) >= _FEW:
        least = (len(marks) + 1) // 2
    return true >= max(3, least) and bool(marks[-1] or marks[-2])
