"""
One trigger cycle in angle: order amplitudes of the cycle and its points of the waveform.

The cycle is `r` fundamental cycles long. Its order amplitudes are integrals over the whole trigger
cycle for any r (Camerini et al. 2019, Eq. 26 with N_i = r), taken on a grid of the trigger cycle
that is never coarser than the samples. The waveform has points at k/n of a fundamental cycle,
wherever those fall between the pulses: a fundamental cycle that straddles a pulse is exact.
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

MAX_POINTS = 1 << 18  # of an automatically chosen grid; beyond it the waveform is low-passed
_SMALL_NUMBER = 512  # denominator of r up to which all cycles share the waveform's points


@dataclass(frozen=True)
class CycleSamples:
    """
    The samples of one trigger cycle, with what interpolation needs on either side.

    `samples` (sample, channel) of which the first is `lead` s after `start_time` (s), at `rate`
    (Hz); `pulses` (s) are those that the angle law reads, the cycle begins at `pulses[first]`.
    Since 1970 so many seconds have gone by that one sum of the two would round by 0.1 us. The
    speed may ripple inside the cycle: at the fraction u the shaft is `ripple` u (1 - u) s earlier
    than the angle law says.
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
        """Values (len(u), channel) at fractions `u` of the cycle."""
        pulses = (self.pulses - self.start_time) - self.lead
        times = cycle_times(law, pulses, self.first, u)
        if self.ripple:
            times = times - self.ripple * u * (1.0 - u)
        positions = times * self.rate
        # a pulse on the first or last sample may round to just outside it
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
    Points per trigger cycle of `period` s that keep up with samples at `rate` Hz.

    On a ladder of about 6 % steps, so that cycles of nearly one length share a grid.
    """
    needed = max(period * rate, 8.0)
    return math.ceil(math.pow(2.0, math.ceil(12.0 * math.log2(needed)) / 12.0))


@lru_cache(maxsize=64)
def exact_cycles(cycles: float) -> Fraction:
    """
    Return r as the fraction that its decimals, or the teeth of gears, mean.

    Angles are multiples of it: of a rounded r they would be off by a waveform point after days.
    """
    share = Fraction(cycles).limit_denominator(1_000_000)
    return share if abs(float(share) - cycles) <= 1e-14 * cycles else Fraction(cycles)


def choose_samples_per_revolution(cycles: float, period: float, rate: float) -> int:
    """
    Waveform points per fundamental cycle that lose none of the samples' band.

    `cycles` is r. Where r is a ratio of small numbers the points fall on the same angles of every
    trigger cycle.
    """
    needed = 1.05 * period * rate / cycles
    step = exact_cycles(cycles).denominator
    if step > _SMALL_NUMBER:
        step = 1
    multiple = math.ceil(min(max(needed, 8.0), MAX_POINTS) / step)
    return min(step * int(next_fast_len(multiple, real=True)), MAX_POINTS)


def waveform_cutoff(points: int, cycles: float, period: float, rate: float) -> float:
    """Band of a waveform of `points` per fundamental cycle, as a fraction of the samples' band."""
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
    Factors of exp(-j 2 pi g theta) on a grid of `points` steps, so that long cycles need no table.

    Point k has `fine` (order, width) at k % width times, at k // width, what the halves of
    `coarse` (2 orders, rows + 1) hold: real and imaginary parts. The last one is that of the end.
    """
    width = math.isqrt(points)
    step = -2j * np.pi * cycles / points * np.array(orders)[:, None]
    coarse = np.exp(step * width * np.arange(points // width + 1))
    return (np.exp(step * np.arange(width)), np.concatenate((coarse.real, coarse.imag)),
            np.exp(step * points))


def project(grid: FloatArray, cycles: float, orders: tuple[float, ...], angle: Fraction | float
            ) -> ComplexArray:
    """
    Complex peak amplitudes (channel, order) of one trigger cycle.

    `grid` (points + 1, channel) are its values at equal steps of angle, both ends included; it
    begins at `angle` (fundamental cycles), to which phases refer. Trapezoidal weights, twice the
    mean of x exp(-j 2 pi g theta).
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
    whole = math.floor(angle)  # of which integer orders make whole turns
    turns = np.mod(orders, 1.0) * whole + np.array(orders) * float(angle - whole)
    return np.asarray(total.T * (2.0 / points * np.exp(-2j * np.pi * turns)))


def first_point(angle: Fraction, points: int) -> int:
    """Index of the first waveform point at or after an angle (fundamental cycles)."""
    return math.ceil(angle * points)


def on_grid(points: int, cycles: float) -> bool:
    """Whether the waveform's points fall on the same angles of every trigger cycle."""
    return (exact_cycles(cycles) * points).denominator == 1
