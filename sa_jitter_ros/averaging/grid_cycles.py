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
Trigger cycles at equal steps of angle, and what several fits of them share.

All shafts that are corrected together, and all steps of a correction, see the same cycles. Their
spectra, and their few numbers in which orders up to some highest one are whole, are computed once.
"""

from functools import cached_property, lru_cache
from math import pi

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray
from sa_jitter_ros.arrays import ComplexArray, FloatArray
from sa_jitter_ros.averaging.spectral_lines import line_limit, peaks, spectrum
from sa_jitter_ros.pulses.resampling import FULL_BAND, interpolate
from scipy.fft import rfft

# Orders that need more cycles than these to be found are too weak to show the error of a pulse.
_SEARCHED_CYCLES = 32
# A trigger cycle is cut into panels with so many cycles of the highest order, in which polynomials
# of so many degrees hold all orders to rounding; worth it from so many samples per degree on.
# Lengths of panels are this factor apart, so that fits up to similar orders share them.
_PANEL_CYCLES, _PANEL_DEGREES, _LEAST_GAIN, _LENGTHS = 6.0, 44, 2, 2.0**0.125


class GridCycles:
    """
    Trigger cycles at equal steps of angle, `cycles`, as (cycle, sample, channel).

    They are numbers `numbers` (cycle,) from the first on, those of consecutive cycles if None; at
    a gap one cycle ends with a pulse and the next begins with another. `begins` (cycle,) are the
    places, among all `pulses`, of those with which the cycles begin. What is kept of them depends
    on no shaft.
    """

    def __init__(self, cycles: FloatArray, numbers: NDArray[np.int64] | None = None) -> None:
        self.cycles = np.asarray(cycles, np.float64)
        self.numbers = np.arange(len(self.cycles)) if numbers is None else numbers
        self.begins = np.arange(len(self.cycles))
        self.begins[1:] += np.cumsum(np.diff(self.numbers) > 1)
        self._compact: dict[int, FloatArray] = {}
        self._means: dict[int, FloatArray] = {}

    @property
    def pulses(self) -> int:
        """Return the number of pulses between which the cycles lie."""
        return int(self.begins[-1]) + 2

    @property
    def span(self) -> int:
        """Return the number of cycles with those at gaps."""
        return int(self.numbers[-1]) + 1

    @cached_property
    def samples(self) -> FloatArray:
        """Return the cycles as (sample, cycle, channel), in one piece."""
        return np.ascontiguousarray(self.cycles.transpose(1, 0, 2))

    @cached_property
    def size(self) -> FloatArray:
        """Return the root of the mean square of each channel (channel,)."""
        flat = self.cycles.reshape(-1, self.cycles.shape[2])
        return np.asarray(np.sqrt(np.einsum('nc,nc->c', flat, flat) / len(flat)))

    @cached_property
    def first(self) -> int:
        """Return the number of the first cycle in `spectra`."""
        return max(len(self.cycles) - _SEARCHED_CYCLES, 0) // 2

    @cached_property
    def spectra(self) -> ComplexArray:
        """Return the spectra, with a Hann window, of some cycles as (line, cycle, channel)."""
        part = self.cycles[self.first:self.first + _SEARCHED_CYCLES]
        count, points, channels = part.shape
        mean = part.reshape(-1, channels).mean(axis=0)
        window = np.sin(pi * np.arange(points) / points) ** 2
        spectra = np.empty((points // 2 + 1, count, channels), np.complex128)
        # A taper over the cycles keeps strong orders from showing at their neighbours.
        for number, share in enumerate(cycle_weights(count)):
            spectra[:, number] = rfft((part[number] - mean) * (share * window)[:, None], axis=0)
        return spectra

    def lines(self, top: float, errors: FloatArray, turns: float) -> tuple[FloatArray, FloatArray]:
        """
        Return the lines up to `top`, or more, that stand out in the spectrum of all cycles.

        Pulse `errors` (pulse,), in trigger cycles, are removed from the angle, which has so many
        `turns` of the shaft. Lines are in cycles in a trigger cycle, below 0.4 of the sampling
        rate, with their power (line,) over the noise around.
        """
        count, points, channels = self.cycles.shape
        most = 2 ** int(np.log2(max(FULL_BAND * points / top, 1.0)))  # the same for similar shafts
        together = max(number for number in range(1, most + 1) if points % number == 0)
        if together not in self._means:
            means = self.cycles.reshape(count, -1, together, channels).mean(axis=2)
            whole = np.zeros((self.span, *means.shape[1:]))
            whole[self.numbers] = means - means.mean(axis=(0, 1))
            self._means[together] = whole.reshape(-1, channels)
        flat = self._means[together]
        ends = np.stack((self.begins, self.begins + 1), axis=1)
        knots = self.numbers[:, None] + np.arange(2.0)
        place = np.interp(np.arange(len(flat)) * (self.span / len(flat)),
                          (knots + errors[ends]).ravel(), knots.ravel())
        flat = interpolate(flat, np.minimum(place * (len(flat) / self.span), len(flat) - 1.0))
        ratio, _ = spectrum(flat, turns, self.size)
        ratio = ratio[:int(FULL_BAND * len(flat))]
        bins, tops = peaks(ratio, line_limit(channels, len(ratio)))
        return tops / self.span, ratio[bins]

    def compact(self, rows: FloatArray, cycles: float) -> tuple[FloatArray, FloatArray]:
        """
        Return `rows` (sample, column) and samples (sample, cycle and channel) in fewer numbers.

        They keep the products of rows and samples, for rows that have no orders above `cycles` in
        a trigger cycle and vary slowly besides. Where that gains little both are as they were.
        """
        flat = self.samples.reshape(len(self.samples), -1)
        length = _PANEL_CYCLES * len(flat) / (cycles + _PANEL_CYCLES)
        length = int(_LENGTHS ** np.floor(np.log(length) / np.log(_LENGTHS)))
        # Without as many numbers as columns the columns would not be independent.
        enough = len(flat) // max(length, 1) * _PANEL_DEGREES >= rows.shape[1]
        if length < _LEAST_GAIN * _PANEL_DEGREES or not enough:
            return rows, flat
        if length not in self._compact:
            self._compact[length] = _in_panels(flat, length)
        return _in_panels(rows, length), self._compact[length]


def cycle_weights(count: int) -> FloatArray:
    """Return the weights of cycles with which strong orders do not show at their neighbours."""
    return np.asarray(np.sin(pi * (np.arange(count) + 0.5) / count) ** 2)


def _in_panels(rows: FloatArray, length: int) -> FloatArray:
    """Return rows (sample, column) in the basis of panels, the last ones as they are."""
    panels = _panels(length)
    whole = len(rows) // length
    inside = np.matmul(panels.T, rows[:whole * length].reshape(whole, length, -1))
    return np.concatenate((inside.reshape(whole * _PANEL_DEGREES, -1), rows[whole * length:]))


@lru_cache(maxsize=32)
def _panels(length: int) -> FloatArray:
    """Return an orthonormal basis (sample, degree) of polynomials in a panel."""
    x = np.linspace(-1.0, 1.0, length)
    return np.asarray(np.linalg.qr(legendre.legvander(x, _PANEL_DEGREES - 1))[0])
