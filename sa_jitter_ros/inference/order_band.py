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
The vibration of a stretch up to an order of the shaft, read at any time.

A band that ends at one frequency holds more orders where the shaft is slow, which fold at the
steps of a trigger cycle, and fewer where it is fast. Where the speed changes, the vibration is
low-passed over an even time instead, in which the shaft turns at its mean speed.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.inference.timing_data import FEWEST
from sa_jitter_ros.pulses.resampling import FULL_BAND, interpolate
from scipy.fft import irfft, next_fast_len, rfft
from scipy.interpolate import CubicSpline

#: Lines of a trigger cycle beyond which nothing leaks into it; of the band, where the low pass
#: ends.
BEYOND_LINES, EDGE = 3.0, 1.15
# The band that is read ends so far above the highest declared order, or lines of a trigger cycle:
# what lies further away does not leak into a cycle.
_BEYOND = 6.0
_SAMPLES = 3.7  # in a period of the band's end


@dataclass(frozen=True)
class OrderBand:
    """
    Low-passed `samples` (sample, channel) of a stretch, the first at `start` (s).

    They are `rate` Hz apart, or at `even` places: positions in samples at some times (s).
    """

    samples: Array
    rate: float
    start: float
    even: tuple[Array, Array] | None = None

    @classmethod
    def below(cls, top: float, samples: Array, rate: float, start: float, times: Array
              ) -> 'OrderBand':
        """
        Return the band of samples up to `top` times the rate of the pulses at `times` (s).

        It rolls off above it.
        """
        period = float(np.diff(times).mean())
        index = np.arange(0, times.size, FEWEST)  # speeds that an even time follows
        index[-1] = times.size - 1
        pace = np.diff(times[index]) / np.diff(index) / period
        slow, fast = (float(pace.max()), 1.0 / float(pace.min())) if index.size > 3 else (1.0, 1.0)
        if max(slow, fast) < EDGE:  # all of the band stays below the low pass
            return cls(*_low_passed(samples, rate, top / period), start)
        time, turned = CubicSpline(period * index, times[index]), period * index[[0, -1]]
        low, low_rate = _low_passed(samples, rate, fast * top / period)
        end = start + (len(samples) - 1) / rate
        first, last = turned + (np.array([start, end]) - times[[0, -1]]) / time(turned, 1)
        dense = slow * low_rate
        even = first + np.arange(int((last - first) * dense) + 1) / dense
        at = np.asarray(np.maximum.accumulate(np.clip(time(even), start, end)))
        position = np.clip((at - start) * low_rate, 0.0, len(low) - 1.0)
        band, own_rate = _low_passed(interpolate(low, position), dense, top / period)
        places = np.asarray(np.arange(at.size) * (own_rate / dense))
        return cls(band, own_rate, start, (at, places))

    def at(self, place: Array) -> Array:
        """Return the vibration (..., channel) at times (...) in s."""
        position = (place - self.start) * self.rate if self.even is None else np.interp(
            place, *self.even)
        position = np.clip(position, 0.0, len(self.samples) - 1.0)
        return interpolate(self.samples, position.ravel()).reshape(*place.shape, -1)


def band_end(times: Array, sample_rate: float, cycle_length: float, orders: Sequence[float],
             wider: float) -> float:
    """
    Return the order at which the band of a fit ends.

    It is little beyond the highest order, or `wider` by this factor.
    """
    return min(wider * (max(orders) + max(_BEYOND, BEYOND_LINES / cycle_length)), max(
        max(orders), FULL_BAND * sample_rate * float(np.diff(times).mean()) / cycle_length))


def _low_passed(samples: Array, rate: float, top: float) -> tuple[Array, float]:
    """Return the samples up to 1.15 `top` (Hz) at a rate that the interpolator reads exactly."""
    count = len(samples)
    padded = next_fast_len(count + 200, real=True)
    spectrum = rfft(samples - samples.mean(axis=0), padded, axis=0)
    spectrum[int(EDGE * top / rate * padded):] = 0.0
    size = next_fast_len(min(round(padded * _SAMPLES * top / rate), padded), real=True)
    size = min(size, padded)
    found = irfft(spectrum[:size // 2 + 1], size, axis=0)[:int(count * size / padded)]
    return np.ascontiguousarray(found * (size / padded)), rate * size / padded
