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
Standard errors of what is computed of a waveform, by the jackknife over parts of its cycles.

A statistic is computed again of the waveform without one part of the cycles, for each part in
turn, and the scatter of these values shows its standard error (delete-a-group jackknife; parts of
different size: Busing, Meijer, van der Leeden 1999). The parts are three: consecutive, so that
cycles that share a pulse stay together, and few, because of more parts the jackknife overestimates
the variance of a moment of high order of noise, four times for a kurtosis. Of three it is right
for the first and second order, and 1.25 times the variance for the fourth.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.averaging.running_mean import BlockMean

#: Parts of the cycles of an average.
PARTS = 3


@dataclass(frozen=True)
class WaveformParts:
    """
    Mean waveforms (part, channel, angle) of consecutive cycles of an average.

    `counts` (part,) is the number of fundamental cycles in each.
    """

    counts: Array
    waveforms: Array

    def without_one(self, waveform: Array) -> Array:
        """Return the waveforms (part, channel, angle) of all cycles but one part each."""
        share = (self.counts / (self.counts.sum() - self.counts))[:, None, None]
        return np.asarray(waveform + share * (waveform - self.waveforms))


def waveform_parts(means: Sequence[BlockMean]) -> WaveformParts | None:
    """
    Return `PARTS` parts of about equal size of consecutive `means` (angle, channel).

    None if there are fewer means, or a part stays empty because others hold most of the cycles.
    """
    ends = np.cumsum([mean.count for mean in means])
    if len(means) < PARTS:
        return None
    groups: list[BlockMean] = [BlockMean() for _ in range(PARTS)]
    places = np.minimum((ends - 0.5 * np.diff(ends, prepend=0)) * PARTS // ends[-1], PARTS - 1)
    for place, mean in zip(places.astype(int), means):
        groups[place].merge(mean)
    if not all(group.count for group in groups):
        return None
    return WaveformParts(np.array([group.count for group in groups], float),
                         np.array([group.mean.T for group in groups], order='C'))


def jackknife_variance(value: Array, without_one: Array, counts: Array) -> Array:
    """
    Return the variance of a `value` (...), from those (part, ...) without one part each.

    `counts` (part,) is the number of cycles in each part. For a mean of parts of equal size it is
    that of the mean:

    >>> data = np.array([1.0, 2.0, 6.0])
    >>> left = (data.sum() - data) / 2.0
    >>> float(jackknife_variance(data.mean(), left, np.ones(3)).round(6))
    2.333333
    >>> float((data.var(ddof=1) / 3.0).round(6))
    2.333333
    """
    times = (counts.sum() / counts).reshape(-1, *(1,) * np.ndim(value))
    parts = times * value - (times - 1.0) * without_one
    mean = np.sum(parts / times, axis=0)
    return np.asarray(np.mean((parts - mean) ** 2 / (times - 1.0), axis=0))
