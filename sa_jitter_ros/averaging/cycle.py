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
Trigger cycles in angle: their order amplitudes and their points of the waveform.

A cycle is `r` fundamental cycles long. Its order amplitudes are integrals over the whole trigger
cycle for any r (Camerini et al. 2019, Eq. 26 with N_i = r), on a grid that is never coarser than
the samples. The points of the waveform are at k/n of a fundamental cycle and independent of the
pulses, so that a fundamental cycle with a pulse inside it is exact, too. Consecutive cycles are
resampled and projected together.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import lru_cache
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.pulses.angle_law import AngleLaw, LINEAR_LAW, run_times
from sa_jitter_ros.pulses.resampling import interpolate, interpolate_between, margin
from scipy.fft import next_fast_len

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
ComplexArray = NDArray[np.complex128]

_MAX_POINTS = 1 << 18  # of an automatically chosen grid; beyond it the waveform is low-passed
_SMALL_NUMBER = 512  # denominator of r up to which all cycles have the same waveform points
_SMALL_GRID = 64  # points of a cycle up to which its amplitudes are one plain product
_LARGE = 1 << 61  # of what integers of 64 bits hold


@dataclass(frozen=True)
class CycleSamples:
    """
    The samples of consecutive trigger cycles, and those on either side that interpolation needs.

    `samples` (sample, channel) at `rate` (Hz); the first is `lead` s after `start_time` (s). These
    are two numbers because their sum rounds by 0.1 us where times count from 1970. `pulses` (s)
    are those that the angle law uses; the `count` cycles begin at `pulses[first]`. With a speed
    ripple inside the cycles the shaft passes the fraction u of one by `ripple` u (1 - u) s earlier
    than the angle law says.
    """

    samples: FloatArray
    start_time: float
    rate: float
    pulses: FloatArray
    first: int
    lead: float = 0.0
    ripple: float = 0.0
    count: int = 1

    @classmethod
    def cut(cls, samples: FloatArray, *, start_time: float, rate: float, pulses: FloatArray,
            first: int, margin: int, offset: int = 0, ripple: float = 0.0, count: int = 1
            ) -> 'CycleSamples':
        """
        Cut the cycles that begin at `pulses[first]` out of `samples` (sample, channel).

        The first sample is `offset` samples after `start_time` (s); `margin` samples are kept on
        either side of the cycles.
        """
        low, high = ((float(pulses[i]) - start_time) * rate - offset
                     for i in (first, first + count))
        begin = max(math.floor(low) - margin, 0)
        return cls(samples[begin:math.ceil(high) + margin + 1], start_time, rate, pulses, first,
                   lead=(offset + begin) / rate, ripple=ripple, count=count)

    @property
    def edges(self) -> FloatArray:
        """Return the pulses (s) between which the cycles lie."""
        return self.pulses[self.first:self.first + self.count + 1]

    @property
    def periods(self) -> FloatArray:
        """Return the lengths of the cycles in s."""
        edges = self.edges
        return edges[1:] - edges[:-1]

    def part(self, first: int, end: int) -> 'CycleSamples':
        """Return some of the cycles."""
        return replace(self, first=self.first + first, count=end - first)

    def at(self, law: AngleLaw, u: FloatArray, *, method: str, cutoff: float = 1.0) -> FloatArray:
        """
        Return values (point, channel) at fractions `u` of every cycle, cycle after cycle.

        `u` (u,) are the same in all cycles, or (cycle, u) those of each, of which NaN are left
        out.
        """
        pulses = (self.pulses - self.start_time) * self.rate
        # Positions in a cycle count from the sample in front of it, so that they do not depend on
        # the cycles that are resampled together.
        origins = np.floor(pulses[self.first:self.first + self.count])
        positions = run_times(law, pulses, self.first, origins, u)
        if self.ripple:
            positions = positions - self.rate * self.ripple * u * (1.0 - u)
        before = origins - self.first_index
        # The position of a pulse on the first or last sample may round to just outside.
        np.maximum(positions[0], -before[0], out=positions[0])
        np.minimum(positions[-1], len(self.samples) - 1.0 - before[-1], out=positions[-1])
        whole = np.floor(positions)
        fraction = positions - whole
        index = np.add(whole, before[:, None], out=whole)
        if u.ndim == 2:
            index, fraction = index[~np.isnan(u)], fraction[~np.isnan(u)]
        return interpolate_between(self.samples, index.ravel().astype(np.int32), fraction.ravel(),
                                   method=method, cutoff=cutoff)

    def end(self, *, method: str) -> FloatArray:
        """Return the values (channel,) at the last pulse."""
        pulse = (self.pulses[self.first + self.count] - self.start_time) * self.rate
        last = min(pulse - self.first_index, len(self.samples) - 1.0)
        return np.asarray(
            interpolate(self.samples, np.array([max(last, 0.0)]), method=method)[0])

    @property
    def first_index(self) -> int:
        """Return the samples from `start_time` to the first one."""
        return round(self.lead * self.rate)


def joined(runs: Sequence[CycleSamples]) -> list[CycleSamples]:
    """Return the same cycles with those together whose samples and pulses continue."""
    groups: list[list[CycleSamples]] = []
    for run in runs:
        if groups and _continues(groups[-1][-1], run):
            groups[-1].append(run)
        else:
            groups.append([run])
    return [_join(group) for group in groups]


def _continues(run: CycleSamples, following: CycleSamples) -> bool:
    begin = run.first_index
    return (run.start_time == following.start_time and run.rate == following.rate
            and not run.ripple and not following.ripple
            and run.samples.shape[1] == following.samples.shape[1]
            and run.edges[-1] == following.edges[0]
            and begin <= following.first_index <= begin + len(run.samples))


def _join(runs: Sequence[CycleSamples]) -> CycleSamples:
    first, last = runs[0], runs[-1]
    if first is last:
        return first
    parts, end = [first.samples], first.first_index + len(first.samples)
    for run in runs[1:]:
        begin = run.first_index
        parts.append(run.samples[end - begin:])
        end = max(end, begin + len(run.samples))
    pulses = np.concatenate([
        first.pulses[:first.first + 1], *(run.edges[1:] for run in runs),
        last.pulses[last.first + last.count + 1:]])
    return replace(first, samples=np.concatenate(parts), pulses=pulses,
                   count=sum(run.count for run in runs))


def cycle_grid(cycles: Sequence[CycleSamples], *, method: str, law: AngleLaw = LINEAR_LAW,
               period: float | None = None) -> FloatArray:
    """
    Return samples (cycle, point, channel) of cycles at equal steps of angle, without their ends.

    There are as many points as a cycle of `period` (s) needs, the longest of the cycles if None.
    """
    longest = max(cycle.periods.max() for cycle in cycles) if period is None else period
    points = next_fast_len(int(grid_points(longest, cycles[0].rate)), real=True)
    u = np.arange(points) / points
    return np.stack([cycle.at(law, u, method=method) for cycle in cycles])


def grid_points(periods: FloatArray | float, rate: float) -> IntArray:
    """
    Return the points per trigger cycle of `periods` s, at least one per sample at `rate` Hz.

    Numbers of points are in steps of about 6 %, so that cycles of similar length have one grid.

    >>> grid_points(np.array([0.04, 0.041, 0.043]), 5000.0)
    array([204, 216, 216])
    """
    needed = np.maximum(np.asarray(periods) * rate, 8.0)
    return np.ceil(np.exp2(np.ceil(12.0 * np.log2(needed)) / 12.0)).astype(np.int64)


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


def waveform_cutoff(points: int, cycles: float, periods: FloatArray | float, rate: float
                    ) -> FloatArray:
    """Return the band of a waveform of so many `points`, as a fraction of that of the samples."""
    cutoff = points * cycles / (np.asarray(periods) * rate)
    return np.where(cutoff < 1.0, np.exp2(np.floor(16.0 * np.log2(cutoff)) / 16.0), 1.0)


@lru_cache(maxsize=64)
def needed_margin(method: str, cutoff: float) -> int:
    """Return how many samples are needed on either side of a cycle."""
    return max(margin(method), margin(method, cutoff=cutoff)) + 1


@lru_cache(maxsize=16)
def _order_basis(points: int, cycles: float, orders: tuple[float, ...]
                 ) -> tuple[ComplexArray, FloatArray]:
    """
    Return exp(-j 2 pi g theta) on a grid of `points` steps as products of two short tables.

    The value at point k is `fine` (order, width) at k % width times `coarse` (2 orders, rows + 1)
    at k // width, whose halves are real and imaginary parts. For few points `fine` has all.
    """
    width = points if points <= _SMALL_GRID else math.isqrt(points)
    step = -2j * np.pi * cycles / points * np.array(orders)[:, None]
    coarse = np.exp(step * width * np.arange(points // width + 1))
    return np.exp(step * np.arange(width)), np.concatenate((coarse.real, coarse.imag))


class CycleProjection:
    """
    Order amplitudes of some consecutive trigger cycles, from pieces of their grid.

    The grid has `points` equal steps of angle in each of `count` cycles, which are `cycles`
    fundamental cycles long; the first is number `first_cycle` of those since angle 0, to which
    phases refer. An amplitude is twice the mean of x exp(-j 2 pi g theta) by the trapezoidal rule.
    """

    def __init__(self, points: int, cycles: float, orders: tuple[float, ...], *, first_cycle: int,
                 count: int) -> None:
        self._points, self._cycles, self._orders = points, cycles, orders
        self._fine, self._coarse = _order_basis(points, cycles, orders)
        whole, rest = multiples(exact_cycles(cycles), first_cycle, count)
        # In whole fundamental cycles integer orders make whole turns.
        self._turns = np.multiply.outer(whole[:-1], np.mod(orders, 1.0)) + np.multiply.outer(
            rest[:-1], orders)
        self._parts: FloatArray | None = None  # sums over the rows of the coarse table
        self._rest: ComplexArray | float = 0.0
        self._begins: FloatArray = np.empty(0)

    @property
    def step(self) -> int:
        """Return the points of which every piece but the last must be a multiple."""
        return int(self._fine.shape[1])

    def add(self, first: int, values: FloatArray) -> None:
        """Take the values (cycle, point, channel) of all cycles from point `first` on."""
        count, points, channels = values.shape
        lines, width = self._fine.shape
        if not first:
            self._begins = values[:, 0].copy()
        if width == self._points:
            flat = np.moveaxis(values, 1, 2).reshape(count * channels, points)
            parts = flat @ np.concatenate((self._fine.real, self._fine.imag)).T
            self._rest = (parts[:, :lines] + 1j * parts[:, lines:]).reshape(
                count, channels, lines)
            return
        row, rows = first // width, points // width
        if rows:
            parts = self._coarse[:, row:row + rows] @ values[:, :rows * width].reshape(
                count, rows, width * channels)
            self._parts = parts if self._parts is None else np.add(
                self._parts, parts, out=self._parts)
        if rows * width < points:
            last = self._coarse[:, row + rows]
            total = self._fine[:, :points - rows * width] @ values[:, rows * width:]
            self._rest = np.moveaxis((last[:lines] + 1j * last[lines:])[:, None] * total, 1, 2)

    def amplitudes(self, end: FloatArray) -> ComplexArray:
        """Return them (cycle, channel, order), given the very last value `end` (channel,)."""
        total: Any = self._rest
        if self._parts is not None:
            lines, width = self._fine.shape
            sums = self._parts[:, :lines] + 1j * self._parts[:, lines:]
            sums = sums.reshape(len(sums), lines, width, -1)
            total = total + np.moveaxis(np.matmul(self._fine[:, None], sums)[:, :, 0], 1, 2)
        ends = np.concatenate((self._begins, end[None]))
        turn = np.exp(-2j * np.pi * self._cycles * np.array(self._orders))
        total = total + (ends[1:, :, None] * turn - ends[:-1, :, None]) / 2.0
        return np.asarray(
            total * (2.0 / self._points * np.exp(-2j * np.pi * self._turns))[:, None])


def project(grid: FloatArray, cycles: float, orders: tuple[float, ...], *, first_cycle: int = 0,
            count: int = 1) -> ComplexArray:
    """
    Return the complex peak amplitudes (cycle, channel, order) of consecutive trigger cycles.

    `grid` (count x points + 1, channel) are the values of `count` cycles at equal steps of angle,
    and the last end; the other arguments are those of `CycleProjection`.

    >>> theta = np.linspace(0.0, 1.0, 65)
    >>> wave = 3.0 * np.cos(2.0 * np.pi * 4.0 * theta)[:, None]
    >>> abs(project(wave, 1.0, (4.0, 5.0))).round(6)
    array([[[3., 0.]]])
    """
    points = (len(grid) - 1) // count
    projection = CycleProjection(points, cycles, orders, first_cycle=first_cycle, count=count)
    projection.add(0, grid[:-1].reshape(count, points, -1))
    return projection.amplitudes(grid[-1])


def multiples(step: Fraction, first: int, count: int) -> tuple[IntArray, FloatArray]:
    """
    Return the whole and the rest of `first` to `first + count` times `step`, exact.

    >>> multiples(Fraction(5, 2), 3, 2)
    (array([ 7, 10, 12]), array([0.5, 0. , 0.5]))
    """
    number, divisor = step.numerator, step.denominator
    whole, rest = divmod(number * first, divisor)
    if rest + number * count >= _LARGE:
        pairs = [divmod(rest + number * i, divisor) for i in range(count + 1)]
        return (whole + np.array([pair[0] for pair in pairs]),
                np.array([pair[1] / divisor for pair in pairs]))
    total = rest + number * np.arange(count + 1)
    return whole + total // divisor, (total % divisor) / divisor


def first_points(cycles: float, points: int, first_cycle: int, count: int
                 ) -> tuple[IntArray, FloatArray]:
    """
    Return the first waveform point at or after the begin of each of consecutive cycles, and its u.

    The second array are the fractions of the trigger cycle from its begin to the point. Both have
    a last element more, for the cycle behind.
    """
    whole, rest = multiples(exact_cycles(cycles) * points, first_cycle, count)
    behind = rest > 0.0
    return whole + behind, np.where(behind, 1.0 - rest, 0.0) / (points * cycles)


@lru_cache(maxsize=64)
def on_grid(points: int, cycles: float) -> bool:
    """Whether the points of the waveform are at the same angles of every trigger cycle."""
    return (exact_cycles(cycles) * points).denominator == 1
