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
One trigger cycle in angle: its order amplitudes and its points of the waveform.

The cycle is `r` fundamental cycles long. Its order amplitudes are integrals over the whole trigger
cycle for any r (Camerini et al. 2019, Eq. 26 with N_i = r), on a grid that is never coarser than
the samples. The points of the waveform are at k/n of a fundamental cycle and independent of the
pulses, so that a fundamental cycle with a pulse inside it is exact, too.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
import math

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.pulses.angle_law import AngleLaw, cycle_times, LINEAR_LAW
from sa_jitter_ros.pulses.resampling import interpolate, margin
from scipy.fft import next_fast_len

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

_MAX_POINTS = 1 << 18  # of an automatically chosen grid; beyond it the waveform is low-passed
_SMALL_NUMBER = 512  # denominator of r up to which all cycles have the same waveform points


@dataclass(frozen=True)
class CycleSamples:
    """
    The samples of one trigger cycle, and those on either side that interpolation needs.

    `samples` (sample, channel) at `rate` (Hz); the first is `lead` s after `start_time` (s). These
    are two numbers because their sum rounds by 0.1 us where times count from 1970. `pulses` (s)
    are those that the angle law uses; the cycle begins at `pulses[first]`. With a speed ripple
    inside the cycle the shaft passes the fraction u by `ripple` u (1 - u) s earlier than the angle
    law says.
    """

    samples: FloatArray
    start_time: float
    rate: float
    pulses: FloatArray
    first: int
    lead: float = 0.0
    ripple: float = 0.0

    @classmethod
    def cut(cls, samples: FloatArray, *, start_time: float, rate: float, pulses: FloatArray,
            first: int, margin: int, offset: int = 0, ripple: float = 0.0) -> 'CycleSamples':
        """
        Cut the cycle that begins at `pulses[first]` out of `samples` (sample, channel).

        The first sample is `offset` samples after `start_time` (s); `margin` samples are kept on
        either side of the cycle.
        """
        low, high = ((float(pulse) - start_time) * rate - offset
                     for pulse in pulses[first:first + 2])
        begin = max(math.floor(low) - margin, 0)
        return cls(samples[begin:math.ceil(high) + margin + 1], start_time, rate, pulses, first,
                   lead=(offset + begin) / rate, ripple=ripple)

    @property
    def period(self) -> float:
        """Length of the trigger cycle in s."""
        return float(self.pulses[self.first + 1] - self.pulses[self.first])

    def at(self, law: AngleLaw, u: FloatArray, *, method: str, cutoff: float = 1.0) -> FloatArray:
        """Return values (len(u), channel) at fractions `u` of the cycle."""
        pulses = (self.pulses - self.start_time) - self.lead
        times = cycle_times(law, pulses, self.first, u)
        if self.ripple:
            times = times - self.ripple * u * (1.0 - u)
        positions = times * self.rate
        # The position of a pulse on the first or last sample may round to just outside.
        np.clip(positions, 0.0, len(self.samples) - 1, out=positions)
        return interpolate(self.samples, positions, method=method, cutoff=cutoff)


def cycle_grid(cycles: Sequence[CycleSamples], *, method: str, law: AngleLaw = LINEAR_LAW,
               period: float | None = None) -> FloatArray:
    """
    Return samples (cycle, point, channel) of cycles at equal steps of angle, without their ends.

    There are as many points as a cycle of `period` (s) needs, the longest of the cycles if None.
    """
    longest = max(cycle.period for cycle in cycles) if period is None else period
    points = grid_points(longest, cycles[0].rate)
    u = np.arange(points) / points
    return np.stack([cycle.at(law, u, method=method) for cycle in cycles])


def grid_points(period: float, rate: float) -> int:
    """
    Return the points per trigger cycle of `period` s, at least one per sample at `rate` Hz.

    Numbers of points are in steps of about 6 %, so that cycles of similar length have one grid.

    >>> grid_points(0.04, 5000.0), grid_points(0.041, 5000.0), grid_points(0.043, 5000.0)
    (204, 216, 216)
    """
    needed = max(period * rate, 8.0)
    return math.ceil(math.pow(2.0, math.ceil(12.0 * math.log2(needed)) / 12.0))


@lru_cache(maxsize=64)
def exact_cycles(cycles: float) -> Fraction:
    """
    Return r as the exact fraction of its decimals, or of the numbers of teeth.

    Angles are multiples of r: with a rounded r they drift by a waveform point in some days.

    >>> exact_cycles(2.40789), exact_cycles(19 / 53)
    (Fraction(240789, 100000), Fraction(19, 53))
    """
    share = Fraction(cycles).limit_denominator(1_000_000)
    return share if abs(float(share) - cycles) <= 1e-14 * cycles else Fraction(cycles)


def choose_samples_per_revolution(cycles: float, period: float, rate: float) -> int:
    """
    Return the waveform points per fundamental cycle that keep the band of the samples.

    `cycles` is r. If r is a ratio of small numbers, the points are at the same angles of every
    trigger cycle.

    >>> choose_samples_per_revolution(1.0, 0.04, 5000.0)
    216
    """
    needed = 1.05 * period * rate / cycles
    step = exact_cycles(cycles).denominator
    if step > _SMALL_NUMBER:
        step = 1
    multiple = math.ceil(min(max(needed, 8.0), _MAX_POINTS) / step)
    return min(step * int(next_fast_len(multiple, real=True)), _MAX_POINTS)


def waveform_cutoff(points: int, cycles: float, period: float, rate: float) -> float:
    """Return the band of a waveform of so many `points`, as a fraction of that of the samples."""
    cutoff = points * cycles / (period * rate)
    if cutoff >= 1.0:
        return 1.0
    return float(2.0 ** (math.floor(16.0 * math.log2(cutoff)) / 16.0))


def needed_margin(method: str, cutoff: float) -> int:
    """Return how many samples are needed on either side of a cycle."""
    return max(margin(method), margin(method, cutoff=cutoff)) + 1


@lru_cache(maxsize=16)
def _order_basis(points: int, cycles: float, orders: tuple[float, ...]
                 ) -> tuple[ComplexArray, FloatArray, ComplexArray]:
    """
    Return exp(-j 2 pi g theta) on a grid of `points` steps as products of two short tables.

    The value at point k is `fine` (order, width) at k % width times `coarse` (2 orders, rows + 1)
    at k // width, whose halves are real and imaginary parts. The third value is that at the end.
    """
    width = math.isqrt(points)
    step = -2j * np.pi * cycles / points * np.array(orders)[:, None]
    coarse = np.exp(step * width * np.arange(points // width + 1))
    return (np.exp(step * np.arange(width)), np.concatenate((coarse.real, coarse.imag)),
            np.exp(step * points))


def project(grid: FloatArray, cycles: float, orders: tuple[float, ...], angle: Fraction | float
            ) -> ComplexArray:
    """
    Return the complex peak amplitudes (channel, order) of one trigger cycle.

    `grid` (points + 1, channel) are its values at equal steps of angle, both ends included. The
    cycle begins at `angle` (fundamental cycles); phases refer to angle 0. An amplitude is twice
    the mean of x exp(-j 2 pi g theta) by the trapezoidal rule.

    >>> theta = np.linspace(0.0, 1.0, 65)
    >>> wave = 3.0 * np.cos(2.0 * np.pi * 4.0 * theta)[:, None]
    >>> abs(project(wave, 1.0, (4.0, 5.0), 0)).round(6)
    array([[3., 0.]])
    """
    points, channels, count = len(grid) - 1, grid.shape[1], len(orders)
    fine, coarse, end = _order_basis(points, cycles, orders)
    width, rows = fine.shape[1], coarse.shape[1] - 1
    parts = coarse[:, :rows] @ grid[:rows * width].reshape(rows, width * channels)
    rest = grid[rows * width:points]
    sums = (parts[:count] + 1j * parts[count:]).reshape(count, width, channels)
    total = np.matmul(fine[:, None], sums)[:, 0] + (grid[-1] * end - grid[0]) / 2.0
    if len(rest):
        last = coarse[:count, rows:] + 1j * coarse[count:, rows:]
        total += last * (fine[:, :len(rest)] @ rest)
    whole = math.floor(angle)  # in which integer orders make whole turns
    turns = np.mod(orders, 1.0) * whole + np.array(orders) * float(angle - whole)
    return np.asarray(total.T * (2.0 / points * np.exp(-2j * np.pi * turns)))


def first_point(angle: Fraction, points: int) -> int:
    """Return the index of the first waveform point at or after an angle (fundamental cycles)."""
    return math.ceil(angle * points)


def on_grid(points: int, cycles: float) -> bool:
    """Whether the points of the waveform are at the same angles of every trigger cycle."""
    return (exact_cycles(cycles) * points).denominator == 1
