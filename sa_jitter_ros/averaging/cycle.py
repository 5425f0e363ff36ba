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
pulses, so that a fundamental cycle with a pulse inside it is exact, too. The grid of the
amplitudes are these points wherever they will do (`CycleProjection`, `WaveformPoints`).
Consecutive cycles are resampled and projected together.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import lru_cache
import math
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.polynomial.legendre import leggauss
from numpy.typing import NDArray
from sa_jitter_ros.arrays import ComplexArray, FloatArray, IntArray
from sa_jitter_ros.inner_loops import add_products
from sa_jitter_ros.pulses.angle_law import AngleLaw, LINEAR_LAW, run_lines, run_times
from sa_jitter_ros.pulses.resampling import (
    impulse_response, interpolate_along, interpolate_between)
from scipy.fft import next_fast_len

_MAX_POINTS = 1 << 18  # of an automatically chosen grid; beyond it the waveform is low-passed
_SMALL_NUMBER = 512  # denominator of r up to which all cycles have the same waveform points
_COPIED = 1 << 15  # numbers from which on cycles of several arrays are not put together
_SMALL_GRID = 64  # points of a cycle up to which its amplitudes are one plain product
# Samples in front of a cycle where its positions begin, which are thus positive.
_AHEAD = 1 << 12
#: Points on either side of a pulse that have a share in the amplitudes of both cycles.
EDGE = 8
_BESIDE = 32  # samples on either side of a cycle that may lie in its averages
_EDGE_POWERS = 10  # of the polynomials through the shares: exact to 1e-8
_EDGE_PLACES = np.cos(np.pi * (np.arange(_EDGE_POWERS) + 0.5) / _EDGE_POWERS)
_EDGE_NODES = 96  # of the quadrature of the kernel, which has 8 turns: exact to rounding
_LARGE = 1 << 61  # of what integers of 64 bits hold


@dataclass(frozen=True)
class CycleSamples:
    """
    The samples of consecutive trigger cycles, and those on either side that interpolation needs.

    `samples` (sample, channel) at `rate` (Hz); the first is `first_index` samples after
    `start_time` (s). Their sum in s would round by 0.1 us where times count from 1970. `pulses`
    (s) are those that the angle law uses; the `count` cycles begin at `pulses[first]`. With a
    speed ripple inside the cycles the shaft passes the fraction u of one by `ripple` u (1 - u) s
    earlier than the angle law says; `ripple` is that of all cycles or (cycle,). The channels
    `lacking` (cycle,) samples in or beside a cycle have 0 in their place; empty if there are none.
    """

    samples: FloatArray
    start_time: float
    rate: float
    pulses: FloatArray
    first: int
    first_index: int = 0
    ripple: float | FloatArray = 0.0
    count: int = 1
    lacking: tuple[tuple[int, ...], ...] = ()

    @classmethod
    def cut(cls, samples: FloatArray, *, start_time: float, rate: float, pulses: FloatArray,
            first: int, margin: int, offset: int = 0, ripple: float | FloatArray = 0.0,
            count: int = 1) -> 'CycleSamples':
        """
        Cut the cycles that begin at `pulses[first]` out of `samples` (sample, channel).

        The first sample is `offset` samples after `start_time` (s); `margin` samples are kept on
        either side of the cycles.
        """
        low, high = ((float(pulses[i]) - start_time) * rate - offset
                     for i in (first, first + count))
        begin = max(math.floor(low) - margin, 0)
        return cls(samples[begin:math.ceil(high) + margin + 1], start_time, rate, pulses, first,
                   first_index=offset + begin, ripple=ripple, count=count)

    def without_gaps(self) -> 'CycleSamples':
        """Return the same cycles with 0 for NaN."""
        gaps = np.isnan(self.samples)
        if not gaps.any():
            return self
        at = (self.edges - self.start_time) * self.rate - self.first_index
        begins = np.maximum(np.floor(at[:-1]).astype(np.int64) - _BESIDE, 0)
        ends = np.ceil(at[1:]).astype(np.int64) + _BESIDE
        lacking = tuple(tuple(np.flatnonzero(gaps[begin:end].any(axis=0)).tolist())
                        for begin, end in zip(begins.tolist(), ends.tolist()))
        return replace(self, samples=np.where(gaps, 0.0, self.samples), lacking=lacking)

    @property
    def has_ripple(self) -> bool:
        """Whether the speed ripples inside a cycle."""
        return bool(self.ripple.any() if isinstance(self.ripple, np.ndarray) else self.ripple)

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
        return replace(self, first=self.first + first, count=end - first,
                       ripple=self.ripple[first:end] if isinstance(self.ripple, np.ndarray)
                       else self.ripple, lacking=self.lacking[first:end])

    def at(self, law: AngleLaw, u: FloatArray, *, method: str, cutoff: float = 1.0,
           ahead: FloatArray | float = 0.0, kept: NDArray[np.bool_] | None = None) -> FloatArray:
        """
        Return values (point, channel) at fractions `u` (u,) of every cycle, cycle after cycle.

        Each cycle begins with its fraction `ahead` (cycle,). Points may lie somewhat outside of
        the cycle. `kept` (cycle, u) are those that are wanted, None for all.
        """
        pulses = (self.pulses - self.start_time) * self.rate
        # Positions in a cycle count from a sample in front of it, so that they do not depend on
        # the cycles that are resampled together.
        origins = np.floor(pulses[self.first:self.first + self.count]) - _AHEAD
        first = (origins - self.first_index).astype(np.int32)
        if law is LINEAR_LAW and not self.has_ripple and kept is None:
            begins, periods = run_lines(pulses, self.first, origins)
            return interpolate_along(self.samples, first, begins + periods * ahead, periods, u,
                                     method=method, cutoff=cutoff)
        if isinstance(ahead, np.ndarray):
            u = ahead[:, None] + u
        positions = run_times(law, pulses, self.first, origins, u)
        if self.has_ripple:
            positions -= self.rate * np.reshape(self.ripple, (-1, 1)) * u * (1.0 - u)
        index = positions.astype(np.int32)
        fraction = np.subtract(positions, index, out=positions)
        index += first[:, None]
        if kept is not None:
            index, fraction = index[kept], fraction[kept]
        return interpolate_between(self.samples, index.ravel(), fraction.ravel(), method=method,
                                   cutoff=cutoff)

    def end(self, *, method: str) -> FloatArray:
        """Return the values (channel,) at the last pulse."""
        pulse = (self.pulses[self.first + self.count] - self.start_time) * self.rate
        origin = math.floor(pulse) - _AHEAD  # so that it rounds as the begin of the next cycle
        index = int(pulse - origin)
        return np.asarray(interpolate_between(
            self.samples, np.array([index + origin - self.first_index], np.int32),
            np.array([pulse - origin - index]), method=method)[0])


def joined_cycles(runs: Sequence[CycleSamples]) -> list[CycleSamples]:
    """Return the same cycles with those together whose samples and pulses continue."""
    groups: list[list[CycleSamples]] = []
    size = 0
    for run in runs:
        if groups and _continues(groups[-1][-1], run, size):
            groups[-1].append(run)
        else:
            groups.append([run])
            size = 0
        size += run.samples.size
    return [_join(group) for group in groups]


def _continues(run: CycleSamples, following: CycleSamples, size: int) -> bool:
    """Whether cycles continue a run of so many numbers, and are worth to be copied to it."""
    if size > _COPIED and run.samples.base is not following.samples.base:
        return False
    begin = run.first_index
    return (run.start_time == following.start_time and run.rate == following.rate
            and not run.has_ripple and not following.has_ripple
            and run.samples.shape[1] == following.samples.shape[1]
            and run.edges[-1] == following.edges[0]
            and begin <= following.first_index <= begin + len(run.samples))


def _join(runs: Sequence[CycleSamples]) -> CycleSamples:
    first, last = runs[0], runs[-1]
    if first is last:
        return first
    pulses = np.concatenate([
        first.pulses[:first.first + 1], *(run.edges[1:] for run in runs),
        last.pulses[last.first + last.count + 1:]])
    return replace(first, samples=_joined_samples(runs), pulses=pulses,
                   count=sum(run.count for run in runs))


def _joined_samples(runs: Sequence[CycleSamples]) -> FloatArray:
    """Return the samples of runs that continue, without a copy where they are of one array."""
    first, last = runs[0].samples, runs[-1].samples
    if first.base is not None and first.strides[0] and all(
            run.samples.base is first.base and run.samples.strides == first.strides
            for run in runs):
        begin, end = (item.__array_interface__['data'][0] for item in (first, last))
        count = (end - begin) // first.strides[0] + len(last)
        return as_strided(first, (count, first.shape[1]), first.strides)
    parts, end = [runs[0].samples], runs[0].first_index + len(runs[0].samples)
    for run in runs[1:]:
        begin = run.first_index
        parts.append(run.samples[end - begin:])
        end = max(end, begin + len(run.samples))
    return np.concatenate(parts)


def cycle_grid(cycles: Sequence[CycleSamples], *, method: str, law: AngleLaw = LINEAR_LAW,
               period: float | None = None) -> FloatArray:
    """
    Return samples (cycle, point, channel) of cycles at equal steps of angle, without their ends.

    There are as many points as a cycle of `period` (s) needs, the longest of the cycles if None.
    """
    longest = max(cycle.periods.max() for cycle in cycles) if period is None else period
    points = next_fast_len(int(grid_points(longest, cycles[0].rate)), real=True)
    u = np.arange(points) / points
    return np.concatenate([cycle.at(law, u, method=method).reshape(cycle.count, points, -1)
                           for cycle in cycles])


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

    The grid has `points` equal steps of angle in each cycle, which is `cycles` fundamental cycles
    long. An amplitude is twice the mean of x exp(-j 2 pi g theta).
    """

    def __init__(self, points: int, cycles: float, orders: tuple[float, ...]) -> None:
        self._points, self._cycles, self._orders = points, cycles, orders
        self._fine, self._coarse = _order_basis(points, cycles, orders)
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
            flat = np.swapaxes(values, 1, 2).reshape(count * channels, points)
            parts = flat @ np.concatenate((self._fine.real, self._fine.imag)).T
            self._rest = (parts[:, :lines] + 1j * parts[:, lines:]).reshape(
                count, channels, lines)
            return
        row, rows = first // width, points // width
        if rows:
            if self._parts is None:
                self._parts = np.zeros((count, len(self._coarse), width * channels))
            add_products(self._coarse[:, row:row + rows], values[:, :rows * width].reshape(
                count, rows, width * channels), self._parts)
        if rows * width < points:
            last = self._coarse[:, row + rows]
            total = self._fine[:, :points - rows * width] @ values[:, rows * width:]
            self._rest = np.swapaxes((last[:lines] + 1j * last[lines:])[:, None] * total, 1, 2)

    def sums(self) -> ComplexArray:
        """Sum over the points (cycle, channel, order), with angle 0 at the begin of each cycle."""
        total: Any = self._rest
        if self._parts is not None:
            lines, width = self._fine.shape
            parts = self._parts[:, :lines] + 1j * self._parts[:, lines:]
            parts = parts.reshape(len(parts), lines, width, -1)
            total = total + np.swapaxes(np.matmul(self._fine[:, None], parts)[:, :, 0], 1, 2)
        return np.asarray(total)

    def amplitudes(self, end: FloatArray, first_cycle: int = 0) -> ComplexArray:
        """
        Return them (cycle, channel, order) by the trapezoidal rule.

        The value at the end of the last cycle is `end` (channel,). The first cycle is number
        `first_cycle` of those since angle 0, to which phases refer.
        """
        count = len(self._begins)
        ends = np.concatenate((self._begins, end[None]))
        turn = np.exp(-2j * np.pi * self._cycles * np.array(self._orders))
        total = self.sums() + (ends[1:, :, None] * turn - ends[:-1, :, None]) / 2.0
        whole, rest = multiples(exact_cycles(self._cycles), first_cycle, count)
        turned = _turned(whole[:-1], rest[:-1], self._orders)
        return np.asarray(total * (2.0 / self._points * turned)[:, None])


def _turned(whole: IntArray, rest: FloatArray, orders: tuple[float, ...]) -> ComplexArray:
    """Return exp(-j 2 pi g theta) (cycle, order) at angles of `whole` + `rest` (cycle,)."""
    # In whole fundamental cycles integer orders make whole turns.
    return np.exp(-2j * np.pi * (np.multiply.outer(whole, np.mod(orders, 1.0))
                                 + np.multiply.outer(rest, orders)))


def amplitudes_of_one(cycles: float, orders: tuple[float, ...], first_cycle: int, count: int,
                      points: int = 0) -> ComplexArray:
    """
    Return the amplitudes (cycle, order) that a signal of 1 has in `count` cycles; of order 0, 2.

    They are those of the trapezoidal rule with so many `points`, or with 0 points of the integral.
    """
    angle = 2.0 * np.pi * cycles * np.array(orders)
    half = np.where(angle, angle, np.nan) / 2.0
    length = 1.0 / half if not points else 1.0 / (points * np.tan(half / points))
    in_one = np.where(angle, 1j * (np.exp(-1j * angle) - 1.0) * length, 2.0)
    whole, rest = multiples(exact_cycles(cycles), first_cycle, count)
    return np.asarray(in_one * _turned(whole[:-1], rest[:-1], orders))


@dataclass(frozen=True)
class WaveformPoints:
    """
    The points of the waveform in consecutive trigger cycles.

    There are `points` in a fundamental cycle and r (`cycles`) of these in a trigger cycle. The
    points are numbered from angle 0 on: `first` (cycle + 1,) are the first ones at or after the
    begin of each cycle and of the one behind, and `behind` (cycle + 1,) their distances from it in
    steps. No cycle has more than `most` points.

    The amplitudes of the cycles follow from these points and `EDGE` more on either side, which
    continue the angle law of the cycle: an amplitude is the integral of the band-limited function
    through all of them times exp(-j 2 pi g theta), from pulse to pulse. Inside of a cycle each
    point has the weight 1, beside a pulse a share of it.
    """

    points: int
    cycles: float
    first: IntArray
    behind: FloatArray
    most: int

    @classmethod
    def of(cls, points: int, cycles: float, first_cycle: int, count: int) -> 'WaveformPoints':
        """Return those of `count` cycles, of which the first is `first_cycle` since angle 0."""
        whole, rest = multiples(exact_cycles(cycles) * points, first_cycle, count)
        inside = rest > 0.0
        first = whole + inside
        return cls(points, cycles, first, np.where(inside, 1.0 - rest, 0.0),
                   int(np.diff(first).max()))

    @property
    def number(self) -> IntArray:
        """Return the number of points (cycle,) in each cycle."""
        return np.diff(self.first)

    def part(self, first: int, end: int) -> 'WaveformPoints':
        """Return those of some of the cycles."""
        return replace(self, first=self.first[first:end + 1], behind=self.behind[first:end + 1])

    @property
    def ahead(self) -> FloatArray:
        """Return the position u (cycle,) of the first point of each cycle."""
        return np.asarray(self.behind[:-1] / (self.points * self.cycles))

    def fractions(self, around: int = 0) -> FloatArray:
        """
        Return the positions u (point,) of the points, from the first one of each cycle on.

        In cycles with fewer points than others they go on behind the last one. There are `around`
        points more in front and behind.
        """
        return np.arange(-around, self.most + around) / (self.points * self.cycles)

    def sums(self, values: FloatArray, orders: tuple[float, ...]
             ) -> tuple[ComplexArray, FloatArray, FloatArray]:
        """
        Return what `amplitudes` needs of the values at `fractions(EDGE)`.

        That are sums (cycle, channel, order) of `most` points from the first one on, and the
        values (cycle, point, channel) around both ends of each cycle.
        """
        projection = CycleProjection(self.most, self.most / self.points, orders)
        projection.add(0, values[:, EDGE:EDGE + self.most])
        window = self.number[:, None] + np.arange(2 * EDGE)
        return (projection.sums(), values[:, :2 * EDGE].copy(),
                values[np.arange(len(values))[:, None], window])

    def amplitudes(self, sums: ComplexArray, begin: FloatArray, end: FloatArray,
                   orders: tuple[float, ...]) -> ComplexArray:
        """Return (cycle, channel, order) from the `sums` of all cycles."""
        number, step = self.number, -2j * np.pi / self.points * np.array(orders)
        # The last point of a cycle with fewer points belongs to the next one.
        beyond = end[:, EDGE] * (number < self.most)[:, None]
        total = sums - beyond[:, :, None] * np.exp(step * (self.most - 1))
        share = _edge_shares(self.points, orders, self.behind)
        total += np.swapaxes(share[1:] @ end, 1, 2) * np.exp(np.multiply.outer(number, step))[
            :, None]
        total -= np.swapaxes(share[:-1] @ begin, 1, 2)
        whole, rest = np.divmod(self.first[:-1], self.points)
        turned = _turned(whole, rest / self.points, orders)
        return np.asarray(total * (2.0 / (self.points * self.cycles) * turned)[:, None])


def _edge_shares(points: int, orders: tuple[float, ...], behind: FloatArray) -> ComplexArray:
    """
    Return the weights (pulse, order, point) that points around pulses add to the cycle before.

    The first point behind a pulse, by `behind` (pulse,) steps, is number `EDGE` of the points.
    """
    polynomials = _edge_polynomials(points, orders)
    powers = np.vander(2.0 * behind - 1.0, len(polynomials), increasing=True)
    return np.asarray((powers @ polynomials.reshape(len(polynomials), -1)).reshape(
        len(behind), len(orders), -1))


@lru_cache(maxsize=1)
def _edge_kernel() -> tuple[tuple[FloatArray, FloatArray], ...]:
    """Return places and weights (..., place) of the kernel's integrals from its begin on."""
    x, weight = leggauss(_EDGE_NODES)
    steps = np.arange(-EDGE, EDGE)  # from the first point behind the pulse
    found = []
    for end in (-steps - (_EDGE_PLACES[:, None] + 1.0) / 2.0, np.array(float(EDGE))):
        length = end[..., None] + EDGE
        place = length * (0.5 * (x + 1.0)) - EDGE
        found.append((place, 0.5 * length * weight * impulse_response(place)))
    return tuple(found)


@lru_cache(maxsize=16)
def _edge_polynomials(points: int, orders: tuple[float, ...]) -> ComplexArray:
    """Return `_edge_shares` as polynomials (power, order, point) of 2 behind - 1."""
    turn = 2.0 * np.pi / points * np.array(orders)
    part, whole = (
        np.einsum('...i,...io->...o', kernel, np.exp(-1j * np.multiply.outer(place, turn)))
        for place, kernel in _edge_kernel())
    before = part / whole
    before[:, :EDGE] -= 1.0
    shares = np.swapaxes(before, 1, 2) * np.exp(
        -1j * np.multiply.outer(turn, np.arange(-EDGE, EDGE)))
    flat = shares.reshape(_EDGE_POWERS, -1)
    return np.asarray(np.linalg.solve(np.vander(_EDGE_PLACES, increasing=True), flat)).reshape(
        shares.shape)


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


@lru_cache(maxsize=64)
def has_same_angles(points: int, cycles: float) -> bool:
    """Whether the points of the waveform are at the same angles of every trigger cycle."""
    return (exact_cycles(cycles) * points).denominator == 1
