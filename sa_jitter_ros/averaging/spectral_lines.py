# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Lines of a spectrum: what stands out of the noise around it."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.averaging.noise import row_medians
from scipy.fft import rfft
from scipy.special import gammainccinv

#: A peak is a line where noise exceeds it once in so many spectra, by some margin for its floor.
FALSE = 1e-3
_MARGIN = 1.25
_ACCURACY = 1e-5  # of the RMS: amplitudes that resampling may make
_SKIRT = 24  # bins beside a line, of which the median is the floor; half an order is one, too


@lru_cache(maxsize=4)
def hann(count: int) -> FloatArray:
    """Return the periodic Hann window (count,)."""
    return np.hanning(count + 1)[:-1]


def spectrum(values: FloatArray, span: float, size: FloatArray) -> tuple[FloatArray, FloatArray]:
    """
    Return power over its floor, summed over channels, and power (bin,), of `values`.

    `values` (sample, channel) are `span` turns of a shaft, whose orders are no floor. That of a
    channel is at least the power of a line that resampling makes of a signal of the RMS `size`
    (channel,).
    """
    window = hann(len(values))
    lines = rfft(values.T * window)
    power = lines.real**2 + lines.imag**2
    ratio = np.zeros(power.shape[1])
    for channel, own in zip(power, size):
        floor = np.full(channel.size, max((0.5 * _ACCURACY * own * window.sum()) ** 2,
                                          np.finfo(np.float64).tiny))
        for reach in {max(int(span / 2), _SKIRT), _SKIRT}:
            np.maximum(floor, _medians(channel, reach), out=floor)
        ratio += channel * np.log(2.0) / floor
    return ratio, power.sum(axis=0)


def _medians(power: FloatArray, reach: int) -> FloatArray:
    """Return the median of the values up to `reach` bins away, between some bins linearly."""
    size, step = min(2 * reach, len(power)), max(1, reach // 2)
    medians = row_medians(np.lib.stride_tricks.sliding_window_view(power, size)[::step])
    inner = np.linspace(medians[:-1], medians[1:], step, endpoint=False, axis=1).ravel()
    return np.pad(inner, (size // 2, len(power) - size // 2 - inner.size), mode='constant',
                  constant_values=(medians[0], medians[-1]))


def line_limit(channels: int, bins: float) -> float:
    """Return the power over its floor, summed over channels, from which on a peak is a line."""
    return _MARGIN * float(gammainccinv(channels, FALSE / bins))


def peaks(ratio: FloatArray, limit: float) -> tuple[NDArray[np.intp], FloatArray]:
    """Return the bins where a `ratio` (bin,) has peaks above a limit, and their tops between."""
    inside = ratio[1:-1]
    place = 1 + np.flatnonzero((inside > ratio[:-2]) & (inside >= ratio[2:]) & (inside > limit))
    return place, place + top_between(np.log(ratio[place + np.array([[-1], [0], [1]])]))


def top_between(values: FloatArray) -> FloatArray:
    """Return where parabolas through three values (3, ...) have their top, from the middle one."""
    left, middle, right = values
    return np.asarray(0.5 * (left - right) / (left - 2.0 * middle + right))
