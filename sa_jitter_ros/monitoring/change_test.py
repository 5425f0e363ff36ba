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
The sequential test of new values against the baseline, which they join while nothing changes.

Successive values may depend on each other, because a machine is not steady. Their scores are
predicted from the one before by the correlation that the baseline shows, and what the prediction
leaves is tested. If the sums of that over many values scatter more than those of independent
values, it is divided by so much: a change is as large as it is against what the machine does over
the time in which it would be found. What came since a change began is taken out of the baseline
again. A change ends when the scores are again those of the baseline rather than those of the
change.
"""

from collections.abc import Mapping
from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.arrays import Array, BoolArray, FloatArray
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.monitoring.evidence import below, ChangeEvidence, Kept, SIZES, threshold
from sa_jitter_ros.monitoring.speed_bin import SpeedBin

#: Values of a baseline from which on new ones can be tested.
LEAST_LEARNED = 8
# Correlation counts from so many standard errors on, and up to the largest. Scores show it so many
# values later: those of a sudden change, which are alike, are found before they count.
_SURE_CORRELATION, _LARGEST_CORRELATION, _DELAY = 2.0, 0.95, 16
# Values over which sums show slow unsteadiness, and for each of `SIZES` how many of these lengths
# count: to find a change takes the longer, the smaller it is.
_LENGTHS, _SLOW, _LEAST_BLOCKS = (32, 256), (2, 1, 2, 1, 0, 0), 4
# A change ends when its absence is more likely by this factor. Of a change that lasts, the latest
# values count most: so many of them.
_ENDS, _MEMORY = 1e4, 64.0
# Which scores each size takes: those of changes up, or down.
_WAY = [1 if size > 0.0 else 2 for size in SIZES]


@dataclass(frozen=True)
class Estimate:
    """
    Changes against the baseline, each an array (unit, quantity), NaN where none is known.

    `change` and `variance` are in the units of the values, as the `baseline` mean is; `noise` is
    the published variance in the baseline, `freedom` are the degrees of freedom of the variance,
    and `doubt` is how far the change may be due to the doubt that grew.
    """

    change: FloatArray
    variance: FloatArray
    baseline: FloatArray
    noise: FloatArray
    freedom: FloatArray
    doubt: FloatArray


def memory_of(values: FloatArray) -> float:
    """
    Return the correlation of successive values (value, quantity), the mean over the quantities.

    Of few values only all quantities together, which follow one load, show it. What their own
    mean takes from it is added (Marriott, Pope 1954). NaN are left out.

    >>> drawn = np.random.default_rng(1).standard_normal((13, 400))
    >>> abs(memory_of(drawn[1:] + drawn[:-1]) - 0.5) < 0.1  # neighbours share half
    True
    """
    count = len(values)
    known = np.ma.masked_invalid(values)
    found = known - known.mean(axis=0)
    found = np.ma.filled(found / found.std(axis=0), 0.0)  # of constant ones, too
    square = float((found**2).sum())
    lagged = float((found[1:] * found[:-1]).sum()) / square if square else 0.0
    mean = (lagged * count / (count - 1.0) + 1.0 / count) / (1.0 - 3.0 / count)
    return min(max(mean, 0.0), _LARGEST_CORRELATION)


class ChangeTest(Kept):
    """
    Baseline by bins of speed and test of quantities (unit, quantity); each unit is one machine.

    A bin learns `learning` values before it tests. Without a change a unit is found changed once
    in `scores_per_alarm` values of all its quantities on average. Successive values correlate by
    `memory` (of each unit, or of all) at least, as far as that is known beforehand. Raises
    ParameterError for `learning` below `LEAST_LEARNED`.
    """

    KEPT = ('active', 'size', 'begun', '_last', '_lagged', '_delayed', '_blocks', '_filled',
            '_level', '_farthest', '_gone')

    def __init__(self, shape: tuple[int, int], *, learning: int,
                 memory: float | FloatArray = 0.0) -> None:
        if learning < LEAST_LEARNED:
            raise ParameterError(f'learning is {learning} values: give at least {LEAST_LEARNED}')
        self.shape, self.learning, self.memory = shape, learning, memory
        self.evidence = ChangeEvidence(shape)
        self.bins: dict[int, SpeedBin] = {}
        self.active: BoolArray = np.zeros(shape, np.bool_)
        #: Index in `SIZES` of an active change, and mark of the value with which it began.
        self.size: NDArray[np.int64] = np.zeros(shape, np.int64)
        self.begun: FloatArray = np.full((2, len(SIZES), *shape), np.nan)
        self._last: FloatArray = np.full((3, *shape), np.nan)
        self._lagged: FloatArray = np.zeros((3, *shape))  # number, lagged, squared
        self._delayed: FloatArray = np.zeros((_DELAY, 3, *shape))  # and what joins them
        # Of each length: unfinished sum, and number and total of squared sums over the length.
        self._blocks: FloatArray = np.zeros((len(_LENGTHS), 3, *shape))
        self._filled: NDArray[np.int64] = np.zeros((len(_LENGTHS), *shape), np.int64)
        self._level: FloatArray = np.zeros(shape)  # mean score of an active change
        self._farthest: FloatArray = np.zeros(shape)
        self._gone: FloatArray = np.zeros(shape)

    def correlation(self) -> FloatArray:
        """Return how successive scores correlate (unit, quantity), `memory` where it is unsure."""
        count, lagged, squared = self._lagged
        found = lagged / np.where(squared > 0.0, squared, np.inf)
        unsure = found * np.sqrt(np.maximum(count, 1.0)) < _SURE_CORRELATION
        return np.maximum(np.where(unsure, 0.0, np.minimum(found, _LARGEST_CORRELATION)),
                          self.memory)

    def spread(self) -> FloatArray:
        """Return the variance of a mean over that of the mean of independent values."""
        correlation = self.correlation()
        return np.asarray((1.0 + correlation) / (1.0 - correlation))

    def update(self, key: int, values: FloatArray, noise: FloatArray, doubt: FloatArray,
               mark: tuple[float, float], scores_per_alarm: float
               ) -> tuple[BoolArray, BoolArray]:
        """
        Take the next values (unit, quantity) in the bin `key`; return what changed and what ended.

        `noise` and `doubt` are as in `SpeedBin.score`, NaN where not known; `mark` are two numbers
        that say when the values were.
        """
        place = self.bins.setdefault(key, SpeedBin(self.shape))
        spread = self.spread()
        scores, weights = place.score(values, noise, doubt, spread)
        known = np.isfinite(scores[0]) & (place.count >= LEAST_LEARNED)
        scores = np.where(known, scores, np.nan)
        innovations = self._innovations(scores)
        ready = known & (place.count >= self.learning - 0.5) & ~self.active
        place.learn(values, noise, doubt, weights, self.active)
        innovations = np.where(ready, innovations, np.nan)
        none = self.evidence.update(innovations[_WAY] / np.sqrt(self._slowness()))
        self._add_to_blocks(innovations[0])
        chosen = np.arange(len(SIZES))[:, None, None] == self.size
        none = np.where(self.active, ~chosen, none)
        began = ~none & np.isnan(self.begun[0])
        self.begun = np.where(none, np.nan, np.where(
            began, np.array(mark)[:, None, None, None], self.begun))
        fading = np.where(self.active & chosen, 1.0 - 1.0 / _MEMORY, 1.0)
        place.observe(values, none, fading)
        for other in self.bins.values():
            if other is not place:
                other.settle(none)
        ended = self._end(scores[0])
        return self._begin(threshold(scores_per_alarm)), ended

    def _innovations(self, scores: FloatArray) -> FloatArray:
        """Return what the score before does not predict, as standard normal scores."""
        correlation, last = self.correlation(), self._last
        pair, squared = scores[0] * last[0], 0.5 * (scores[0] ** 2 + last[0] ** 2)
        both = np.isfinite(pair) & ~self.active
        self._lagged = self._lagged + self._delayed[0]
        latest = np.where(both, np.stack((np.ones(self.shape), pair, squared)), 0.0)
        self._delayed = np.concatenate((self._delayed[1:], latest[None]))
        self._last = np.where(np.isfinite(scores), scores, last)
        return np.where(np.isfinite(last), (scores - correlation * last) / np.sqrt(
            1.0 - correlation**2), scores)

    def _slowness(self) -> FloatArray:
        """Return by how much sums of innovations scatter more than independent ones, by size."""
        found = np.ones((1 + len(_LENGTHS), *self.shape))
        for place, (_, number, total) in enumerate(self._blocks):
            ratio = total / np.maximum(number, 1.0)
            sure = ratio > 1.0 + _SURE_CORRELATION * np.sqrt(2.0 / np.maximum(number, 1.0))
            found[place + 1] = np.maximum(found[place], np.where(
                sure & (number >= _LEAST_BLOCKS), ratio, 1.0))
        return found[list(_SLOW)]

    def _add_to_blocks(self, innovations: FloatArray) -> None:
        """Add innovations (unit, quantity) to the sums over many, none where NaN."""
        known = np.isfinite(innovations)
        self._blocks[:, 0] += np.where(known, innovations, 0.0)
        self._filled += known
        for place, length in enumerate(_LENGTHS):
            full = self._filled[place] >= length
            if full.any():
                sums, number, total = self._blocks[place]
                total += np.where(full, sums**2 / length, 0.0)
                number += full
                sums[full] = 0.0
                self._filled[place][full] = 0

    def _begin(self, level: float) -> BoolArray:
        """Begin the changes whose evidence reaches a level."""
        changed = self.evidence.changed(level) & ~self.active
        if changed.any():
            self.size = np.where(changed, self.evidence.sums.argmax(axis=0), self.size)
            for place in self.bins.values():
                place.take_out(changed, self.size)
            self.evidence.forget(changed)
            self.active = self.active | changed
            size = np.array(SIZES)[self.size]
            for state in (self._level, self._farthest):
                state[changed] = size[changed]
            self._gone[changed] = 0.0
            self._delayed[:, :, changed] = 0.0
            self._blocks[:, 0, changed], self._filled[:, changed] = 0.0, 0
        return changed

    def _end(self, scores: FloatArray) -> BoolArray:
        """End the active changes that are gone; return which."""
        known = self.active & np.isfinite(scores)
        if not known.any():
            return np.zeros(self.shape, np.bool_)
        step = np.where(known, scores - self._level, 0.0) / _MEMORY
        self._level = self._level + step
        farther = known & (np.abs(self._level) > np.abs(self._farthest))
        self._farthest = np.where(farther, self._level, self._farthest)
        gain = 0.5 * self._farthest**2 - self._farthest * np.where(known, scores, 0.0)
        self._gone = np.where(
            known, np.maximum(self._gone + gain / self.spread(), 0.0), self._gone)
        ended = known & (self._gone > math.log(_ENDS))
        self.active = self.active & ~ended
        self.evidence.forget(ended)
        for place in self.bins.values():
            place.settle(np.broadcast_to(ended, place.before.shape[1:]))
        self.begun[:, :, ended] = np.nan
        return ended

    def estimate(self) -> Estimate:
        """Return the active changes, over all bins of speed."""
        spread = self.spread()
        total, weight, base, noise, doubt, freedom = (np.zeros(self.shape) for _ in range(6))
        for place in self.bins.values():
            change, variance, mean = place.change(self.size, spread)
            share = np.where(self.active & np.isfinite(change) & (variance > 0.0),
                             1.0 / variance, 0.0)
            weight += share
            total += share * np.nan_to_num(change)
            base += share * np.nan_to_num(mean)
            noise += share * np.nan_to_num(place.baseline().noise)
            doubt += share * place.excess_doubt()
            freedom = np.where(share > 0.0, np.maximum(freedom, place.count - 1.0), freedom)
        sure = np.where(weight > 0.0, weight, np.nan)
        return Estimate(total / sure, 1.0 / sure, base / sure, noise / sure, np.where(
            weight > 0.0, freedom, np.nan), doubt / sure)

    def state(self) -> dict[str, Array]:
        """Return what `restore` needs: arrays by names."""
        found = {**super().state(), 'bins': np.array(list(self.bins), np.int64)}
        for prefix, part in (('evidence', self.evidence), *(
                (f'bin{key}', place) for key, place in self.bins.items())):
            found |= {f'{prefix}.{name}': item for name, item in part.state().items()}
        return found

    def restore(self, state: Mapping[str, Array]) -> None:
        """Go on from a state."""
        super().restore(state)
        self.evidence.restore(below(state, 'evidence.'))
        self.bins = {key: SpeedBin(self.shape) for key in state['bins'].tolist()}
        for key, place in self.bins.items():
            place.restore(below(state, f'bin{key}.'))
