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
Evidence that a series of scores, standard normal without a change, has changed, and when.

For each size of a change d (in standard deviations, up and down) the Shiryaev-Roberts statistic
grows with each score u by R <- (1 + R) exp(d u - d^2 / 2): the sum, over all times at which the
change may have begun, of the likelihood ratios. Without a change R minus the number of scores is a
martingale, and so is the mean of any number of them, however their scores depend on each other.
Therefore the mean over all sizes and all quantities reaches a level A after at least A scores on
average, without a correction for their number (Roberts 1966; Pollak 1985; as a mixture: Shin,
Ramdas, Rinaldo 2023, "E-detectors"). It is more by the overshoot over A, whose mean is known
(Siegmund 1985, "Sequential Analysis", Eq. 8.45), so that the rate of false alarms can be stated.
"""

from collections.abc import Mapping
from functools import lru_cache
import math
from typing import ClassVar

import numpy as np
from sa_jitter_ros.arrays import Array, BoolArray, FloatArray
from scipy.special import ndtr

#: Sizes of the changes that are looked for, in standard deviations of a score. Between two of them
#: a change is found with a third more scores than at the best size. Smaller changes take so many
#: scores that no baseline shows what the machine does over that time. The last two only tell when
#: a large change began: as evidence they would hang on the tails of the scores.
SIZES: tuple[float, ...] = (0.3, 1.0, -0.3, -1.0, 3.0, -3.0)
_TESTED = 4
_LARGEST = 1e250
_TERMS = 1 << 14  # the last one is below 1e-30 for the smallest size


@lru_cache(maxsize=1)
def overshoot() -> float:
    """
    Return E[exp(-overshoot)] of a sum of log likelihood ratios, the mean over the tested sizes.

    >>> round(overshoot(), 2)
    0.7
    """
    terms = np.arange(1.0, _TERMS)
    return float(np.mean([2.0 / size**2 * math.exp(-2.0 * float(np.sum(
        ndtr(-0.5 * abs(size) * np.sqrt(terms)) / terms))) for size in SIZES[:_TESTED]]))


def threshold(scores: float) -> float:
    """
    Return the level of the mean evidence that is reached once in so many scores without a change.

    >>> round(threshold(1e5) / 1e5, 2)
    0.7
    """
    return scores * overshoot()


class Kept:
    """Arrays that are kept in a file: the attributes in `KEPT`, without underscore."""

    KEPT: ClassVar[tuple[str, ...]] = ()

    def state(self) -> dict[str, Array]:
        """Return what `restore` needs: arrays by names."""
        return {name.lstrip('_'): getattr(self, name) for name in self.KEPT}

    def restore(self, state: Mapping[str, Array]) -> None:
        """Go on from a state."""
        for name in self.KEPT:
            setattr(self, name, state[name.lstrip('_')].copy())


def below(state: Mapping[str, Array], prefix: str) -> dict[str, Array]:
    """Return the arrays of a state whose names begin with a prefix, without it."""
    return {name.removeprefix(prefix): item for name, item in state.items()
            if name.startswith(prefix)}


class ChangeEvidence(Kept):
    """
    Evidence of changes of quantities, of one or more units that are judged apart.

    `ratios` (size, unit, quantity) are the Shiryaev-Roberts statistics of the tested sizes. `sums`
    of all sizes are the logarithms of the likelihood ratio since the most likely beginning of the
    change; where they are zero none has begun.
    """

    KEPT = ('ratios', 'sums', 'tested')

    def __init__(self, shape: tuple[int, int]) -> None:
        self.ratios: FloatArray = np.zeros((_TESTED, *shape))
        self.sums: FloatArray = np.zeros((len(SIZES), *shape))
        self.tested: BoolArray = np.zeros(shape, np.bool_)

    def update(self, scores: FloatArray) -> BoolArray:
        """
        Take the next scores (size, unit, quantity), NaN: none; return where no change has begun.

        Scores may be the same for all sizes, (unit, quantity). The result has the shape (size,
        unit, quantity).
        """
        sizes = np.array(SIZES)[:, None, None]
        scores = np.broadcast_to(scores, self.sums.shape)
        known = np.isfinite(scores)
        self.tested |= known[0]
        gain = sizes * np.where(known, scores, 0.0) - 0.5 * sizes**2
        ratios = np.minimum((1.0 + self.ratios) * np.exp(gain[:_TESTED]), _LARGEST)
        self.ratios = np.where(known[:_TESTED], ratios, self.ratios)
        self.sums = np.where(known, np.maximum(self.sums + gain, 0.0), self.sums)
        return np.asarray(self.sums == 0.0)

    def mean(self) -> FloatArray:
        """Return the mean evidence (unit,) over sizes and tested quantities."""
        count = np.maximum(self.tested.sum(axis=1), 1)
        return np.asarray(self.ratios.sum(axis=(0, 2)) / (_TESTED * count))

    def changed(self, level: float) -> BoolArray:
        """
        Return which quantities (unit, quantity) have changed: of the units that reach the `level`.

        They are those whose own evidence makes their unit reach it, and where only several do it
        together, the first of them.
        """
        own = self.ratios.mean(axis=0)
        alone = level * np.maximum(self.tested.sum(axis=1), 1)[:, None]
        least = np.minimum(alone, 0.5 * own.max(axis=1, keepdims=True))
        return np.asarray((self.mean() >= level)[:, None] & (own >= least))

    def forget(self, which: BoolArray) -> None:
        """Begin again for quantities (unit, quantity)."""
        self.ratios[:, which] = 0.0
        self.sums[:, which] = 0.0
