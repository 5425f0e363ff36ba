"""
One trigger cycle in angle: order amplitudes of the cycle and its points of the waveform.

The cycle is `r` fundamental cycles long. Its order amplitudes are integrals over the whole trigger
cycle for any r (Camerini et al. 2019, Eq. 26 with N_i = r), taken on a grid of the trigger cycle
that is never coarser than the samples. The waveform has points at k/n of a fundamental cycle,
wherever those fall between the pulses: a fundamental cycle that straddles a pulse is exact.
"""

from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
import math

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.angle.laws import AngleLaw, cycle_times
from sa_jitter_ros.angle.resampling import interpolate, margin
from scipy.fft import next_fast_len

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

MAX_POINTS = 1 << 18  # of an automatically chosen grid; beyond it the waveform is low-passed


@dataclass(frozen=True)
class CycleSamples:
    """
    The samples of one trigger cycle, with what interpolation needs on either side.

    `samples` (sample, channel) of which the first is at `start_time` (s), at `rate` (Hz);
    `pulses` (s) are those that the angle law reads, the cycle begins at `pulses[first]`.
    """

    samples: FloatArray
    start_time: float
    rate: float
    pulses: FloatArray
    first: int

    @property
    def period(self) -> float:
        """Length of the trigger cycle in s."""
        return float(self.pulses[self.first + 1] - self.pulses[self.first])

    def at(self, law: AngleLaw, u: FloatArray, *, method: str, cutoff: float = 1.0) -> FloatArray:
        """Values (len(u), channel) at fractions `u` of the cycle."""
        positions = cycle_times(law, self.pulses - self.start_time, self.first, u) * self.rate
        # a pulse on the first or last sample may round to just outside it
        np.clip(positions, 0.0, len(self.samples) - 1, out=positions)
        return interpolate(self.samples, positions, method=method, cutoff=cutoff)


def grid_points(period: float, rate: float) -> int:
    """
    Points per trigger cycle of `period` s that keep up with samples at `rate` Hz.

    On a ladder of about 6 % steps, so that cycles of nearly one length share a grid.
    """
    needed = max(period * rate, 8.0)
    return math.ceil(math.pow(2.0, math.ceil(12.0 * math.log2(needed)) / 12.0))


def choose_samples_per_revolution(cycles: float, period: float, rate: float) -> int:
    """
    Waveform points per fundamental cycle that lose none of the samples' band.

    `cycles` is r. Where r is a ratio of small numbers the points fall on the same angles of every
    trigger cycle.
    """
    needed = 1.05 * period * rate / cycles
    share = Fraction(cycles).limit_denominator(512)
    step = share.denominator if abs(float(share) - cycles) < 1e-12 * cycles else 1
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
def _order_basis(points: int, cycles: float, orders: tuple[float, ...]) -> FloatArray:
    """
    Real and imaginary parts (points + 1, 2 len(orders)) that project a cycle on the orders.

    Trapezoidal weights, twice the mean of x exp(-j 2 pi g theta): peak amplitudes.
    """
    theta = cycles * np.arange(points + 1) / points
    weight = np.full(points + 1, 2.0 / points)
    weight[[0, -1]] /= 2.0
    basis = weight[:, None] * np.exp(-2j * np.pi * theta[:, None] * np.array(orders))
    return np.concatenate((basis.real, basis.imag), axis=1)


def project(grid: FloatArray, cycles: float, orders: tuple[float, ...], angle: float
            ) -> ComplexArray:
    """
    Complex peak amplitudes (channel, order) of one trigger cycle.

    `grid` (points + 1, channel) are its values at equal steps of angle, both ends included; it
    begins at `angle` (fundamental cycles), to which phases refer.
    """
    parts = grid.T @ _order_basis(len(grid) - 1, cycles, orders)
    amplitude = parts[:, :len(orders)] + 1j * parts[:, len(orders):]
    return np.asarray(amplitude * np.exp(-2j * np.pi * np.array(orders) * angle))


def first_point(angle: float, points: int) -> int:
    """Index of the first waveform point at or after an angle (fundamental cycles)."""
    return math.ceil(angle * points - 1e-6)


def on_grid(points: int, cycles: float) -> bool:
    """Whether the waveform's points fall on the same angles of every trigger cycle."""
    product = points * cycles
    return abs(product - round(product)) < 1e-9 * product and round(product) > 0
