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
Threshold crossings of a keyphasor waveform, and the state levels between which the threshold is.

The state levels are the modes of the lower and of the upper half of the amplitude histogram (as in
IEEE Std 181-2011), so that the length of a pulse and a few overshoots do not change them. A
crossing counts once the signal leaves a band around the threshold (Schmitt trigger).
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

__all__ = ['SchmittTrigger', 'StateLevels', 'state_levels']

FloatArray = npt.NDArray[np.float64]

_BINS = 100
# Difference of the means of both halves over the noise, which follows from the steps between
# samples. It is 1.6 (normal), 1.7 (uniform) or 2 (one bit) for white noise, but sqrt(n) for a
# square wave of n samples a period and 1.27/sin(pi/n) for a sine.
_CONTRAST = 2.4


@dataclass(frozen=True)
class StateLevels:
    """
    State levels of a piece of waveform, in the unit of the waveform.

    `significant` is True where samples change between two levels, False for a constant or white
    noise.
    """

    low: float
    high: float
    significant: bool

    @property
    def middle(self) -> float:
        """Return the level half way between the states."""
        return 0.5 * (self.low + self.high)

    @property
    def difference(self) -> float:
        """Return the difference of the two levels."""
        return self.high - self.low


def state_levels(samples: FloatArray) -> StateLevels:
    """
    Return the state levels of finite samples (n,).

    A level is the mean of the samples in the most frequent histogram bin.

    >>> state_levels(np.tile([0.0, 0.1, 5.0, 5.0, 0.0, 0.0], 20))
    StateLevels(low=0.0, high=5.0, significant=True)
    """
    low, high = (float(samples.min()), float(samples.max())) if samples.size else (0.0, 0.0)
    half = 0.5 * (low + high)
    upper = samples > half
    if samples.size < 3 or not low < half < high:
        return StateLevels(low, high, significant=False)
    contrast = float(samples[upper].mean() - samples[~upper].mean())
    noise = float(np.diff(samples).std()) / np.sqrt(2.0)
    counts, edges = np.histogram(samples, bins=_BINS, range=(low, high))
    # Of equally frequent bins the outer one is taken.
    lower_mode = int(np.argmax(counts[:_BINS // 2]))
    upper_mode = _BINS - 1 - int(np.argmax(counts[:_BINS // 2 - 1:-1]))
    low = _mean_between(samples, edges[lower_mode], edges[lower_mode + 1])
    high = _mean_between(samples, edges[upper_mode], edges[upper_mode + 1])
    # If the machine starts late in these samples, both modes are at its resting level.
    significant = contrast > _CONTRAST * noise and high - low > 0.5 * contrast
    return StateLevels(low, high, significant=bool(significant))


def _mean_between(samples: FloatArray, low: float, high: float) -> float:
    return float(samples[(samples >= low) & (samples <= high)].mean())


class SchmittTrigger:
    """
    Find the threshold crossings in a stream of blocks of finite samples of any size.

    :param interpolate: False puts a crossing on the first sample past the threshold.
    """

    def __init__(self, *, interpolate: bool) -> None:
        self._interpolate = interpolate
        self._previous: float | None = None
        self._high: bool | None = None
        self._crossing: float | None = None  # the last one, not yet confirmed

    def update(
        self, samples: FloatArray, index: int, threshold: float, band: float,
    ) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
        """
        Return the crossings that these samples (n,) confirm and which of them rise, (c,) each.

        `index` is that of the first sample in the stream. Crossings are given as such indices,
        fractional if interpolated. `band` is half the hysteresis, in the unit of the samples.
        Before the signal first leaves the band there are no crossings.
        """
        if self._previous is None:
            self._previous = float(samples[0])
        signal = np.concatenate(([self._previous], samples))
        above = signal >= threshold
        after = np.flatnonzero(above[1:] != above[:-1])  # first sample past the threshold
        positions = (index + after).astype(np.float64)
        if self._interpolate:
            before, past = signal[after], signal[after + 1]
            positions += (threshold - before) / (past - before) - 1.0
        high = samples >= threshold + band
        decided = np.flatnonzero(high | (samples < threshold - band))
        level = high[decided]
        if self._high is None and decided.size:
            self._high = bool(level[0])
        changes = np.flatnonzero(level != np.append(bool(self._high), level)[:-1])
        confirmed, rising = decided[changes], level[changes]
        # The last crossing before the decision has the direction of the change, even if noise
        # made the signal cross the threshold several times inside the band.
        last = np.searchsorted(after, confirmed, side='right') - 1
        unconfirmed = np.nan if self._crossing is None else self._crossing
        found = np.where(last >= 0, np.append(positions, unconfirmed)[last], unconfirmed)
        found = np.where(np.isnan(found), index + confirmed, found)
        if after.size:
            self._crossing = float(positions[-1])
        if decided.size:
            self._high = bool(level[-1])
            if not after.size or after[-1] <= decided[-1]:
                self._crossing = None
        self._previous = float(samples[-1])
        return found, rising
