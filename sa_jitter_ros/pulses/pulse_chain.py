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
The first pulses of a shaft whose speed is not known: which of them follow each other.

The search over paths is done with several scatters of the intervals, from narrow to wide.
"""

from dataclasses import dataclass, replace
import math
from operator import itemgetter

import numpy as np
from sa_jitter_ros.arrays import FloatArray, IntArray
from sa_jitter_ros.pulses.pulse_paths import Path, PathRules, Step
from scipy.ndimage import median_filter

#: cost of a stray among the first pulses of one mark, and of marks that may be uneven
STRAY_OF_ONE, STRAY_OF_MARKS = 8.0, 10.0
_MOST_PATHS = 16
_FEW = 8
_CHAIN_COST = 6.0  # of an acceptable chain, for each pulse
_LADDER = (0.002, 0.01, 0.05, 0.15)  # scatter that a chain is tried with
_REGULAR = 0.02
_LEAST = 1e-6  # of the longest interval; shorter ones are no pulses of one shaft
#: pulses that show whether it is the speed that scatters
UNSTEADY = 56
_MOST_UNSTEADY = 0.45  # scatter of a speed; pulses that come at random have 1.3
_AROUND = 9  # intervals, of whose median one may differ by so many standard deviations
_OUTLYING = 4.0
_OPPOSED = 2.5  # variance of changes by that of levels: 2 of independent, 3 of displaced pulses
_SKEWED = 2.5  # deviations of the longest tenth by those of the shortest
_PRIOR = 0.01  # scatter where nothing tells it
_KEPT_SQUARE = 0.3685  # mean square of the smallest three quarters of normal variables
_STRAY = Step(0)


@dataclass(frozen=True)
class Chain:
    """
    Which of some pulses follow each other: their numbers (n,), and what lies between them (n-1,).

    `levels` are those of the intervals, NaN where a pulse may be displaced; `unsteady`: of a speed
    that changes from one interval to the next, so that all are true.
    """

    pulses: IntArray
    steps: IntArray
    levels: FloatArray
    unsteady: bool = False


def scatter_of(levels: FloatArray) -> float:
    """Return the robust scatter of levels (n,) about the better of two predictions."""
    changes = [np.diff(levels, order) for order in (1, 2)]
    squares = [item[np.isfinite(item)]**2 for item in changes]
    return math.sqrt(min(map(_mean_square, filter(np.size, squares)), default=_PRIOR**2))


def find_chain(pulses: FloatArray, scatter: float | None, *, stray: float = STRAY_OF_ONE
               ) -> Chain | None:
    """
    Return which of the pulses (n,) follow each other regularly, and in how many intervals each.

    `scatter` is what earlier intervals had, None if it is not known. A stray costs `stray`. None
    without such a chain.

    >>> chain = find_chain(np.array([0.0, 0.9, 1.0, 2.0, 3.0, 3.3, 5.0]), None)
    >>> chain.pulses.tolist(), chain.steps.tolist()
    ([0, 2, 3, 4, 6], [1, 1, 1, 2])
    """
    intervals = np.diff(pulses)
    if intervals.size < 2 or not intervals.min() > _LEAST * intervals.max():
        return None
    levels = np.log(intervals)
    change = np.diff(levels)
    turn = np.append(change[0], np.diff(change))
    every = Chain(np.arange(pulses.size), np.ones(intervals.size, np.int64), levels)
    if np.all(np.minimum(np.abs(change), np.abs(turn)) <= _REGULAR):
        return every
    unsteady = unsteadiness(levels)
    best, cheapest = _most_likely(
        pulses, scatter, stray, limit=math.inf if unsteady else _CHAIN_COST * pulses.size)
    # If both explanations take all pulses for true, the scatter of the speed is the better one.
    if unsteady and ((best is not None and set(best.passed) == {1})
                     or levels.size * (_each(unsteady) + 0.5) < cheapest):
        return replace(every, unsteady=True)
    if best is None or best.cost > _CHAIN_COST * pulses.size:
        return None
    passed = np.array(best.passed, np.int64)
    true = np.flatnonzero(passed)
    levels = np.array([best.steps[number].level for number in true[1:]])
    if best.steps[-1].jumps:
        levels[-1] = np.nan  # no pulse behind shows which end of this interval is displaced
    return Chain(true, passed[true[1:]], levels)


def _each(scatter: float) -> float:
    """Return what an interval costs: a wide distribution explains all, but with less density."""
    return max(math.log(scatter / min(_LADDER)), 0.0)


def _most_likely(pulses: FloatArray, scatter: float | None, stray: float, limit: float
                 ) -> tuple[Path | None, float]:
    """
    Return the most likely acceptable path of pulses (n,) that costs up to `limit`, None without.

    Beside it, the cost of the most likely path of all. A search ends where what is left of its
    paths cannot be the most likely one.
    """
    best, cheapest = None, math.inf
    for tried in reversed(_LADDER if scatter is None else (*_LADDER, scatter)):
        rules = PathRules((1.0,), tried, (0.0,), 1, None, stray=stray, each=_each(tried),
                          most=_MOST_PATHS)
        paths: list[Path] = []
        for number, pulse in enumerate(pulses.tolist()):
            behind = (pulses.size - 1 - number) * min(stray, rules.each)  # what they cost at least
            paths = rules.extend(paths, pulse, limit - behind)
            if stray * number <= limit - behind:
                paths.append(Path(stray * number, pulse, 0,
                                  steps=(*(_STRAY,) * number, Step(1))))
            if not paths:
                break
        paths.sort(key=itemgetter(0))
        cheapest = min([cheapest, *(path.cost for path in paths[:1])])
        found = next((path for path in paths if _acceptable(path.passed)), None)
        if found is not None and (best is None or found.cost < best.cost):
            best, limit = found, min(limit, found.cost)
    return best, cheapest


def unsteadiness(levels: FloatArray) -> float:
    """
    Return the scatter of levels (n,) if it is the speed that scatters, 0.0 if not.

    Neighbouring intervals are alike then, or independent of each other. Where a pulse is
    displaced, the one is longer by what the next is shorter. Missing pulses make intervals longer,
    strays make them shorter, and single ones by much.
    """
    if levels.size < UNSTEADY - 1:
        return 0.0
    off = levels - median_filter(levels, size=_AROUND, mode='mirror')
    scatter, change = float(levels.std()), float(np.diff(levels).std())
    low, middle, high = np.quantile(off, (0.1, 0.5, 0.9))
    skew = (high - middle) / max(middle - low, _LEAST)
    if (scatter < _MOST_UNSTEADY and 1.0 / _SKEWED < skew < _SKEWED
            and np.abs(off).max() < _OUTLYING * off.std()
            and change**2 < _OPPOSED * scatter**2):
        return min(scatter, change)
    return 0.0


def _acceptable(passed: tuple[int, ...]) -> bool:
    """Whether enough pulses are true to call them a chain: of few all but one, of many a half."""
    true = sum(slots > 0 for slots in passed)
    least = len(passed) - (1 if len(passed) < 6 else 2)
    if len(passed) >= _FEW:
        least = (len(passed) + 1) // 2
    return true >= max(3, least) and bool(passed[-1] or passed[-2])


def robust_square(squares: FloatArray) -> FloatArray:
    """Return the mean square (..., n) without the largest quarter: strays may have caused it."""
    count = squares.shape[-1]
    squares = np.sort(squares)
    kept = count - count // 4
    # Where most deviations are 0, as those of a slow clock, the largest ones tell the scatter.
    return np.asarray(np.maximum(squares[..., :kept].sum(axis=-1) / (kept * _KEPT_SQUARE),
                                 squares.sum(axis=-1) / (4.0 * count)))


def _mean_square(squares: FloatArray) -> float:
    mean = float(squares.mean())
    return min(float(robust_square(squares)), mean) if squares.size > 4 else mean
