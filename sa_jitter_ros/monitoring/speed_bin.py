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
The baseline of quantities in one bin of speed, and how far new values are from it.

A new value becomes a score that is standard normal while nothing changes. Its deviation from the
mean of n values is divided by their scatter s sqrt(1 + 1/n); this ratio has the t distribution
with n - 1 degrees of freedom, whatever mean and scatter are, and successive ones are independent
if each value joins the baseline (Hawkins 1987, "Self-starting CUSUM charts for location and
scale"). So what a short baseline does not know costs no false alarm. Then the skewness that the
baseline shows is taken out (cube root of Wilson and Hilferty 1931, of a gamma distribution).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.arrays import BoolArray, FloatArray
from sa_jitter_ros.monitoring.evidence import Kept, SIZES

# No value counts more than one so many standard deviations off, as a score and in the baseline: a
# single wild average is no change.
_LARGEST = 4.0
_CLIPPED_FROM = 8.0  # values
# Skewness counts beyond so many standard errors.
_SURE_SKEWNESS, _LARGEST_SKEWNESS = 2.0, 2.0
# Scatter below this fraction of a value is a rounding error.
_ROUNDING = 1e-6
# Share of a new value in the mean of published errors, and where these differ from the baseline's:
# at once, or in the mean.
_SHARE, _AT_ONCE, _IN_THE_MEAN = 1.0 / 16.0, 2.5, 1.1
_TINY = float(np.finfo(np.float64).tiny)


@dataclass(frozen=True)
class Moments:
    """
    What is known of values, each an array (..., unit, quantity).

    Their `count` (sum of weights), `mean`, `variance` and `skewness`; the means of their published
    `noise` variance and of their `doubt`. NaN where the values are too few.
    """

    count: FloatArray
    mean: FloatArray
    variance: FloatArray
    skewness: FloatArray
    noise: FloatArray
    doubt: FloatArray

    @classmethod
    def of(cls, sums: FloatArray, reference: FloatArray) -> 'Moments':
        """Return those of sums (row, ..., unit, quantity) of values without their reference."""
        count = sums[0]
        known = np.where(count > 1.5, count, np.nan)
        mean, square, cube, noise, doubt = sums[1:] / known
        variance = np.maximum(square - mean**2, 0.0)
        third = cube - 3.0 * mean * square + 2.0 * mean**3
        centre = mean + reference
        floor = (_ROUNDING * centre) ** 2 + _TINY
        skewness = (np.cbrt(third) / np.sqrt(np.maximum(variance, floor))) ** 3
        variance = np.maximum(variance * count / (known - 1.0), floor)
        return cls(count, centre, variance, skewness, noise, doubt)


def normal_scores(ratios: FloatArray, freedom: FloatArray | float) -> FloatArray:
    """
    Return values of the t distribution as values of the normal one (Wallace 1959).

    >>> from scipy import stats
    >>> t = np.array([-2.0, 0.5, 6.0])
    >>> bool(np.abs(normal_scores(t, 20.0) - stats.norm.isf(stats.t.sf(t, 20))).max() < 0.01)
    True
    """
    scale = (8.0 * freedom + 1.0) / (8.0 * freedom + 3.0)
    return np.asarray(np.sign(ratios) * scale * np.sqrt(
        freedom * np.log1p(ratios**2 / freedom)))


def without_skewness(scores: FloatArray, skewness: FloatArray) -> FloatArray:
    """
    Return normal scores for those, of zero mean and unit variance, of a gamma distribution.

    >>> from scipy import stats
    >>> gamma = np.array([1.0, 5.0, 15.0])  # of shape 5: skewness 2 / sqrt(5)
    >>> scores = without_skewness((gamma - 5.0) / np.sqrt(5.0), np.full(3, 2.0 / np.sqrt(5.0)))
    >>> bool(np.abs(scores - stats.norm.isf(stats.gamma.sf(gamma, 5.0))).max() < 0.05)
    True
    """
    skewed = np.abs(skewness) > 1e-6
    used = np.where(skewed, skewness, 1.0)
    cube = np.cbrt(np.maximum(1.0 + 0.5 * used * scores, 0.0))
    return np.where(skewed, 6.0 / used * (cube - 1.0) + used / 6.0, scores)


class SpeedBin(Kept):
    """
    The values of quantities (unit, quantity) in one bin of speed.

    `learned` (row, unit, quantity) are sums over the values of the baseline. `before` (row, size,
    unit, quantity) are those before the change of each size in `SIZES` that may have begun, and
    `since` (4, size, unit, quantity) the sums of the weights, of the weighted values and their
    squares since then, and of the squares of the weights.
    """

    KEPT = ('reference', 'recent', 'learned', 'before', 'since')

    def __init__(self, shape: tuple[int, int]) -> None:
        self.reference: FloatArray = np.full(shape, np.nan)
        self.recent: FloatArray = np.full((2, *shape), np.nan)  # noise, doubt
        self.learned: FloatArray = np.zeros((6, *shape))
        self.before: FloatArray = np.zeros((6, len(SIZES), *shape))
        self.since: FloatArray = np.zeros((4, len(SIZES), *shape))

    @property
    def count(self) -> FloatArray:
        """Return the number of values (unit, quantity) in the baseline."""
        return np.asarray(self.learned[0])

    def baseline(self) -> Moments:
        """Return what the baseline knows."""
        return Moments.of(self.learned, self.reference)

    def score(self, values: FloatArray, noise: FloatArray, doubt: FloatArray, spread: FloatArray
              ) -> tuple[FloatArray, FloatArray]:
        """
        Return the scores of values, and their weights as part of the baseline.

        `noise` is the published variance of the values, `doubt` how far each of them may be off
        for one reason that stays. What the noise is more than in the baseline widens the scatter.
        The scores are three: of the values as they are, of changes up, and of changes down, from
        whose deviation is taken what the doubt is more. `spread` is how many times the variance of
        a mean is that of the mean of independent values. Scores are NaN before the baseline has
        two values.
        """
        self.reference = np.where(np.isnan(self.reference), values, self.reference)
        known = self.baseline()
        now = np.stack((noise, doubt))
        step = np.where(np.isnan(self.recent), now, self.recent)
        self.recent = np.where(np.isnan(now), step, step + _SHARE * (now - step))
        usual = np.stack((known.noise, known.doubt))
        more = np.where(now > _AT_ONCE * usual, now, self.recent)
        more = np.nan_to_num(np.where(more > _IN_THE_MEAN * usual, more - usual, 0.0))
        deviation = np.broadcast_to(values - known.mean, (3, *values.shape))
        if more[1].any():
            deviation = deviation + np.stack((np.zeros(values.shape), -more[1], more[1]))
        variance = known.variance * (1.0 + spread / np.maximum(known.count, 1.0)) + more[0]
        scores = normal_scores(deviation / np.sqrt(variance), np.maximum(known.count - 1.0, 1.0))
        chance = _SURE_SKEWNESS * np.sqrt(6.0 / np.maximum(known.count, 1.0))
        skewness = np.sign(known.skewness) * np.clip(
            np.abs(known.skewness) - chance, 0.0, _LARGEST_SKEWNESS)
        scores = np.clip(without_skewness(scores, skewness), -_LARGEST, _LARGEST)
        weights = known.variance / (known.variance + more[0] + more[1] ** 2)
        return scores, np.where(np.isnan(weights), 1.0, weights)

    def learn(self, values: FloatArray, noise: FloatArray, doubt: FloatArray, weights: FloatArray,
              frozen: BoolArray) -> None:
        """Take values into the baseline, but none of the `frozen` quantities."""
        known = self.baseline()
        reach = np.where(known.count >= _CLIPPED_FROM,
                         _LARGEST * np.sqrt(known.variance), np.inf)
        centre = np.where(np.isnan(known.mean), values, known.mean)
        clipped = np.clip(values, centre - reach, centre + reach) - self.reference
        rows = np.stack((np.ones(values.shape), clipped, clipped**2, clipped**3,
                         np.nan_to_num(noise), np.nan_to_num(doubt)))
        self.learned = self.learned + np.where(
            np.isnan(values) | frozen, 0.0, np.nan_to_num(rows) * weights)

    def observe(self, values: FloatArray, none: BoolArray, fading: FloatArray) -> None:
        """
        Take values that may be changed; `none` (size, unit, quantity) is where no change began.

        The earlier values fade by a factor (size, unit, quantity).
        """
        self.settle(none)
        shifted = values - self.reference
        one = np.where(np.isnan(values), 0.0, 1.0)
        rows = np.nan_to_num(np.stack((one, shifted, shifted**2, one)))
        self.since[:3] *= fading
        self.since[3] *= fading**2
        self.since += np.where(none, 0.0, rows[:, None])

    def settle(self, none: BoolArray) -> None:
        """Make what is learned the state before a change where none has begun."""
        np.copyto(self.before, self.learned[:, None], where=none)
        np.copyto(self.since, 0.0, where=none)

    def take_out(self, changed: BoolArray, size: NDArray[np.int64]) -> None:
        """Take what came since the beginning of a change of a size out of the baseline."""
        before = np.take_along_axis(self.before, size[None, None], axis=1)[:, 0]
        self.learned = np.where(changed, before, self.learned)

    def change(self, size: NDArray[np.int64], spread: FloatArray) -> tuple[FloatArray, ...]:
        """
        Return mean change, its variance and the mean of the baseline, each (unit, quantity).

        It is the change of a size whose values are in `since`; NaN where there is none.
        """
        known = self.baseline()
        sums = np.take_along_axis(self.since, size[None, None], axis=1)[:, 0]
        count = np.where(sums[0] > 0.0, sums[0], np.nan)
        mean, square, weight = sums[1:] / count
        scatter = np.where(count > 3.5, (square - mean**2) * count / np.maximum(
            count - 1.0, 1.0), 0.0)
        scatter = np.maximum(scatter, known.variance)
        variance = spread * (
            scatter * weight / count + known.variance / np.maximum(known.count, 1.0))
        return mean + self.reference - known.mean, variance, known.mean

    def excess_doubt(self) -> FloatArray:
        """Return by how much the recent doubt is more than that of the baseline."""
        return np.asarray(np.maximum(
            np.nan_to_num(self.recent[1] - self.baseline().doubt), 0.0))
