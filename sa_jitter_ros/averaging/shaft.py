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
The synchronous average of one shaft.

It takes the samples of consecutive trigger cycles and returns an average whenever one is due.
Cycles wait until there are enough to be resampled, projected and accumulated together, which costs
a fraction of the same for each of them. The settings limit its memory.
"""

from collections import deque
from collections.abc import Sequence
from fractions import Fraction
from itertools import pairwise
import math

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.arrays import ComplexArray, FloatArray
from sa_jitter_ros.averaging.amplitude_errors import Repeatability, waveform_error
from sa_jitter_ros.averaging.average import Average, AverageSettings
from sa_jitter_ros.averaging.cycle import (
    amplitudes_of_one, choose_samples_per_revolution, CycleProjection, CycleSamples, EDGE,
    exact_cycles, grid_points, has_same_angles, joined_cycles, waveform_cutoff, WaveformPoints)
from sa_jitter_ros.averaging.interpolator_gain import mean_gain, refused_orders
from sa_jitter_ros.averaging.jackknife import PARTS, waveform_parts
from sa_jitter_ros.averaging.noise import radial_noise, without_leakage
from sa_jitter_ros.averaging.rows import Rows
from sa_jitter_ros.averaging.running_mean import (BlockMean, ExponentialMean, PartsMean,
                                                  RunningMean, SlidingMean)
from sa_jitter_ros.errors import SignalError
from sa_jitter_ros.pulses.angle_law import angle_law, LINEAR_LAW
from sa_jitter_ros.pulses.resampling import gain_below_nyquist, margin

# Cycles from which on it is not known how many come.
_ALL_CYCLES = 1 << 40
#: Samples times channels that are averaged together.
TOGETHER = 1 << 20
# Numbers that are resampled, projected and averaged together, but not fewer positions.
_CACHED, _FEW = 1 << 17, 1 << 11
# Points of a trigger cycle beside which those around its ends cost little.
_LONG = 8 * EDGE
# Cycles that an order may be off a whole number of them: the mean leaks by as much of itself.
# Cycles of an order in an average from which on less than 0.2 % of it leaks to and fro.
_WHOLE, _SEPARATE = 1e-9, 10.0
# Pulses (s) of a trigger cycle, and its number since the angle was 0.
_PLACE = np.dtype([('begin', np.float64), ('end', np.float64), ('number', np.int64)])


class ShaftAverager:
    """Averages trigger cycles of one shaft: `update` with some, `reset` after an interruption."""

    def __init__(self, settings: AverageSettings, *, first_cycle: int = 0) -> None:
        self.settings = settings
        self._law = angle_law(settings.angle_law)
        self._cycle = self._next = first_cycle  # to be averaged, and to be taken
        self._sequence = 0
        self._points = settings.samples_per_revolution
        self._start()

    @property
    def room(self) -> int:
        """Trigger cycles up to the next average."""
        return max(self.settings.trigger_cycles - self._taken, 1)

    @property
    def _unfinished(self) -> bool:
        return self.settings.averaging == 'block' and self._taken > 0

    def reset(self) -> bool:
        """Begin again at angle 0; return whether an unfinished average was lost."""
        lost = self._unfinished
        self._cycle = self._next = 0
        self._start()
        return lost

    def skip(self, count: int) -> bool:
        """
        Leave out `count` trigger cycles that were discarded; the angle runs on over them.

        Returns False, and does nothing, if they are more than the average may lack.
        """
        most = self.settings.trigger_cycles
        numbers = [*self._places.items['number'].tolist(), *self._numbers_waiting,
                   self._next + count][-most:]
        if not self.settings.maximum_discarded or (
                _discarded(numbers) > self.settings.maximum_discarded * most):
            return False
        self._next += count
        return True

    def begin_later(self, count: int) -> bool:
        """
        Begin the unfinished block at a later cycle, so that `count` discarded ones may follow.

        Returns False, and does nothing, where it cannot: the cycles are known until they are
        averaged, which those of a large block are before it is full.
        """
        if self._counted or not self._unfinished:
            return False
        numbers = [*self._numbers_waiting, self._next + count]
        most = math.floor(self.settings.maximum_discarded * self.settings.trigger_cycles)
        first = next(k for k in range(len(numbers)) if _discarded(numbers[k:]) <= most)
        kept, ahead = [], first
        for number, run in self._waiting:
            if ahead < run.count:
                kept.append((number + ahead, run.part(ahead, run.count) if ahead else run))
            ahead = max(ahead - run.count, 0)
        if kept:
            self._start()
            for self._next, run in kept:
                self.update(run)
            self._next = numbers[-1]
        return bool(kept)

    def finish(self) -> Average | None:
        """Return the average of the cycles of an unfinished block, None if there are none."""
        if not self._unfinished:
            return None
        self._average_waiting()
        average = self._result()
        self._start()
        return average

    def change(self, settings: AverageSettings) -> bool:
        """Continue at the same angle with other settings; return whether an average was lost."""
        lost = self._unfinished
        if settings.cycle_length != self.settings.cycle_length:
            self._next = 0
        self._cycle = self._next
        self.settings, self._law = settings, angle_law(settings.angle_law)
        self._points = settings.samples_per_revolution
        self._start()
        return lost

    def margin(self, period: float, rate: float) -> int:
        """Return the samples that a cycle of `period` s at `rate` Hz needs on either side."""
        points = self._points or self._chosen(period, rate)
        cutoff = 1.0
        if points * self.settings.cycle_length < period * rate:
            cutoff = float(waveform_cutoff(points, self.settings.cycle_length, period, rate))
        edge = EDGE if self._needs_edges(points) and cutoff == 1.0 else 0
        method = self.settings.interpolation
        return max(margin(method), margin(method, cutoff=cutoff)) + 1 + edge

    def update(self, cycles: CycleSamples) -> Average | None:
        """
        Take the next trigger cycles, not more than `room`; return an average when one is due.

        Raises `SignalError`, and takes nothing, if the shaft frequency is not below half the
        sampling rate.
        """
        self._take(cycles)
        if self._taken < self.settings.trigger_cycles:
            if self._waiting_size >= TOGETHER:
                self._average_waiting()
            return None
        self._average_waiting()
        self._slide()
        average = self._result()
        if self.settings.averaging == 'block':
            self._start()
        return average

    def amplitudes(self, cycles: CycleSamples) -> ComplexArray:
        """
        Take cycles as `update` does; return what all make, (cycle, channel, order).

        They hold the loss by the interpolator.
        """
        self._take(cycles)
        self._average_waiting()
        return np.asarray(self._without_constant(self._amplitudes.items)
                          * self._gains.items[:, None])

    def _take(self, cycles: CycleSamples) -> None:
        """Let cycles wait; raise `SignalError`."""
        periods, edges = cycles.periods, cycles.edges
        if not periods.min() > self.shortest(cycles.rate):
            raise SignalError(
                f'shaft frequency {self.settings.cycle_length / periods.min():.6g} Hz is not '
                f'below half the sampling rate of {cycles.rate:.6g} Hz: check ratio and '
                'pulses_per_revolution')
        if not self._taken:
            self._choose_grid(float(periods[0]), cycles.rate)
        self._waiting.append((self._next, cycles))
        self._next += cycles.count
        self._taken += cycles.count
        # Not their samples, which depend on how the cycles were handed over.
        self._waiting_size += float(edges[-1] - edges[0]) * cycles.rate * cycles.samples.shape[1]

    def shortest(self, rate: float) -> float:
        """Return the period (s) of a trigger cycle that is too short for samples at `rate` Hz."""
        return 2.0 * self.settings.cycle_length / rate

    def _average_waiting(self) -> None:
        """Average the cycles that wait."""
        numbers = self._numbers_waiting
        for run in joined_cycles([run for _, run in self._waiting]):
            if numbers[0] != self._cycle:  # behind discarded ones
                self._cycle = numbers[0]
                self._full = False
                self._expect_from(self._angle(self._cycle))
            del numbers[:run.count]
            for part in self._alike(run):
                self._average(part)
        self._waiting.clear()
        self._waiting_size = 0.0

    @property
    def _numbers_waiting(self) -> list[int]:
        """Return the numbers of the cycles that wait."""
        return [number + k for number, run in self._waiting for k in range(run.count)]

    def _average(self, cycles: CycleSamples) -> None:
        """Average cycles that have grids of the same size."""
        count = cycles.count
        if not self._counted:
            self._expect_from(self._angle(self._cycle))
        self._rate = cycles.rate
        gains = gain_below_nyquist(self.settings.interpolation, np.multiply.outer(
            self.settings.cycle_length / cycles.periods, self.settings.orders) / self._rate)
        amplitudes = self._resample(cycles)
        amplitudes[..., :len(self.settings.orders)] *= (1.0 / gains)[:, None]
        # Real and imaginary parts have means of their own.
        self._amplitude_mean.update(np.ascontiguousarray(amplitudes).view(np.float64))
        places = np.empty(count, _PLACE)
        places['begin'], places['end'] = cycles.edges[:-1], cycles.edges[1:]
        places['number'] = np.arange(self._cycle, self._cycle + count)
        if not self._counted:
            self._amplitudes = Rows(np.empty((0, *amplitudes.shape[1:]), np.complex128))
        for latest, rows in ((self._amplitudes, amplitudes), (self._gains, gains),
                             (self._places, places)):
            latest.append(rows)
            latest.drop(max(len(latest) - self.settings.trigger_cycles, 0))
        self._counted += count
        self._cycle += count

    def _angle(self, cycle: int) -> Fraction:
        """Return the angle (fundamental cycles) at which a trigger cycle begins."""
        return exact_cycles(self.settings.cycle_length) * cycle

    # --- the grid ---

    def _chosen(self, period: float, rate: float) -> int:
        return choose_samples_per_revolution(self.settings.cycle_length, period, rate)

    def _choose_grid(self, period: float, rate: float) -> None:
        if self.settings.samples_per_revolution:
            return
        # Subscribers need one shape: the waveform keeps its length while it is neither coarser
        # than the samples nor more than twice as fine.
        needed = period * rate / self.settings.cycle_length
        if not needed <= self._points <= 2.2 * needed:
            self._points = self._chosen(period, rate)

    def _alike(self, cycles: CycleSamples) -> list[CycleSamples]:
        """Return parts whose cycles have grids of the same size and cut-off."""
        sizes = np.stack((self._grid_points(cycles), self._cutoff(cycles)))
        changes = np.flatnonzero(np.any(np.diff(sizes), axis=0)) + 1
        return [cycles.part(first, end) for first, end in pairwise(
            (0, *changes.tolist(), cycles.count))]

    def _grid_points(self, cycles: CycleSamples) -> NDArray[np.int64]:
        """Return the grid's points in each cycle, those of the waveform where these will do."""
        r, n = self.settings.cycle_length, self._points
        points = grid_points(cycles.periods, cycles.rate)
        if has_same_angles(n, r) or self._needs_edges(n):
            points = np.where(self._cutoff(cycles) == 1.0, round(n * r), points)
        return points

    def _needs_edges(self, points: int) -> bool:
        """
        Whether amplitudes come from `points` that are at other angles of every cycle.

        Short cycles have a grid of their own, and other angle laws, which end at the pulses.
        """
        r = self.settings.cycle_length
        return points * r >= _LONG and self._law is LINEAR_LAW and not has_same_angles(points, r)

    def _cutoff(self, cycles: CycleSamples) -> FloatArray:
        return waveform_cutoff(self._points, self.settings.cycle_length, cycles.periods,
                               cycles.rate)

    # --- the average in progress ---

    def _start(self) -> None:
        settings = self.settings
        self._taken = self._counted = self._noise_due = 0  # those that wait are not yet counted
        self._waiting: list[tuple[int, CycleSamples]] = []  # with the number of the first
        self._waiting_size = 0.0  # samples times channels
        self._noise: tuple[FloatArray, Repeatability] | None = None
        self._amplitude_mean = self._new_mean(settings.trigger_cycles)
        self._wave_mean = self._new_wave_mean()
        # The mean of the samples leaks into orders without whole cycles in a trigger cycle. Order
        # 0 and, as one more channel, a signal of 1 tell how much.
        self._turns = settings.cycle_length * np.array(settings.orders)
        leaking = np.abs(self._turns - np.rint(self._turns)) > _WHOLE
        self._orders = (*settings.orders, 0.0) if leaking.any() else settings.orders
        # Of the latest N_t cycles: amplitudes, and what the interpolator left of them before.
        self._amplitudes = Rows(np.empty(0))
        self._gains = Rows(np.empty((0, len(settings.orders))))
        self._places = Rows(np.empty(0, _PLACE))
        self._wave: FloatArray = np.empty((0, 0))
        self._next_point = 0
        self._full = False  # the waveform has all points, but its end is not reached
        self._whole: deque[int] = deque()  # numbers of the fundamental cycles in a sliding mean

    def _resample(self, cycles: CycleSamples) -> ComplexArray:
        """
        Add the points of the waveform, and return the amplitudes (cycle, channel, order).

        The grid is taken in pieces that stay in the cache until they are projected and averaged.
        """
        r, n, method = self.settings.cycle_length, self._points, self.settings.interpolation
        cutoff, size = float(self._cutoff(cycles)[0]), int(self._grid_points(cycles)[0])
        channels = cycles.samples.shape[1]
        if len(self._wave) != n:
            self._wave = np.full((n, channels), np.nan)
        points = WaveformPoints.of(n, r, self._cycle, cycles.count)
        if has_same_angles(n, r) and cutoff == 1.0:
            return self._resample_even(cycles, points)
        if self._needs_edges(n) and cutoff == 1.0:
            return self._resample_uneven(cycles, points)
        u = points.fractions()
        inside = np.arange(u.size) < points.number[:, None]
        self._add_points(points, cycles.at(
            self._law, u, method=method, cutoff=cutoff, ahead=points.ahead, kept=inside))
        return self._project(cycles, size)

    def _project(self, cycles: CycleSamples, size: int, every: FloatArray | None = None
                 ) -> ComplexArray:
        """Return the amplitudes from a grid of so many points, which is written to `every`."""
        count, channels = cycles.count, cycles.samples.shape[1]
        projection = CycleProjection(size, self.settings.cycle_length, self._orders)
        piece, u = size, np.arange(size) / size
        if self._law is LINEAR_LAW:  # others fit a cycle at once
            piece = max(max(_CACHED // channels, _FEW) // (count * projection.step), 1)
            piece *= projection.step
        for begin in range(0, size, piece):
            where = slice(begin, begin + piece)
            values = cycles.at(self._law, u[where], method=self.settings.interpolation).reshape(
                count, -1, channels)
            projection.add(begin, values)
            if every is not None:
                every[:, where] = values
        return self._with_one(projection.amplitudes(
            cycles.end(method=self.settings.interpolation), self._cycle), size)

    def _resample_even(self, cycles: CycleSamples, points: WaveformPoints) -> ComplexArray:
        """As `_resample`, with the points of the waveform at the same angles of every cycle."""
        every = np.empty((cycles.count, int(points.number[0]), cycles.samples.shape[1]))
        amplitudes = self._project(cycles, every.shape[1], every)
        self._add_points(points, every.reshape(-1, every.shape[2]))
        return amplitudes

    def _resample_uneven(self, cycles: CycleSamples, points: WaveformPoints) -> ComplexArray:
        """As `_resample`, with points at other angles of every cycle, some cycles at a time."""
        channels, begin = cycles.samples.shape[1], points.first - points.first[0]
        every = np.empty((int(begin[-1]), channels))
        piece = max(_CACHED // (channels * points.most), 1)
        sums = []
        for first in range(0, cycles.count, piece):
            end = min(first + piece, cycles.count)
            part = points.part(first, end)
            values = cycles.part(first, end).at(
                self._law, part.fractions(EDGE), ahead=part.ahead,
                method=self.settings.interpolation).reshape(end - first, -1, channels)
            sums.append(part.sums(values, self._orders))
            for k, wave in enumerate(values[:, EDGE:], first):
                every[begin[k]:begin[k + 1]] = wave[:begin[k + 1] - begin[k]]
        self._add_points(points, every)
        total, begins, ends = (np.concatenate(parts) for parts in zip(*sums))
        return self._with_one(points.amplitudes(total, begins, ends, self._orders), 0)

    def _with_one(self, amplitudes: ComplexArray, points: int) -> ComplexArray:
        """Return amplitudes with those of a signal of 1 as another channel, where it is needed."""
        if len(self._orders) == len(self.settings.orders):
            return amplitudes
        one = amplitudes_of_one(self.settings.cycle_length, self._orders, self._cycle,
                                len(amplitudes), points)
        return np.concatenate((amplitudes, one[:, None]), axis=1)

    def _without_constant(self, amplitudes: ComplexArray) -> ComplexArray:
        """
        Return amplitudes (..., channel, order) without what the mean of the samples adds.

        The mean is weighted by a Hann window, so that orders with other than whole cycles in the
        average do not leak into it, unless they have few.
        """
        if len(self._orders) == len(self.settings.orders):
            return amplitudes
        means = self._amplitudes.items[:, :-1, -1].real / 2.0
        mean = np.average(means, axis=0, weights=np.hanning(len(means) + 2)[1:-1])
        one = np.where(self._turns * len(means) < _SEPARATE, 0.0, amplitudes[..., -1:, :-1])
        return np.asarray(amplitudes[..., :-1, :-1] - mean[:, None] * one)

    def _new_mean(self, cycles: float) -> RunningMean:
        if self.settings.averaging == 'exponential':
            return ExponentialMean(cycles)
        if self.settings.averaging == 'sliding':
            return SlidingMean()
        return BlockMean()

    def _new_wave_mean(self) -> RunningMean:
        settings = self.settings
        cycles = max(settings.trigger_cycles * settings.cycle_length, 1.0)
        if settings.averaging != 'block':
            return self._new_mean(cycles)
        size = max(int(cycles / PARTS), 1) if cycles < _ALL_CYCLES else 1
        return PartsMean(size=size, least=PARTS)

    def _expect_from(self, angle: Fraction) -> None:
        """Begin with the first fundamental cycle that is whole from this angle on."""
        self._next_point = math.ceil(angle) * self._points

    def _add_points(self, of: WaveformPoints, points: FloatArray) -> None:
        """Put points into their fundamental cycles; add those that are whole at the end."""
        n, first = self._points, int(of.first[0])
        end = self._angle(self._cycle + len(of.number))
        if self._full:
            self._take_wave()
        whole = math.floor(end) * n
        points = points[max(self._next_point - first, 0):]
        while len(points):
            at = self._next_point % n
            cycles = 0 if at else min(len(points), whole - self._next_point) // n
            if cycles > 0:
                waves, points = points[:cycles * n], points[cycles * n:]
                self._next_point += cycles * n
                self._add_waves(waves.reshape(cycles, n, -1))
                continue
            count = min(len(points), n - at)
            self._wave[at:at + count] = points[:count]
            points = points[count:]
            self._next_point += count
            self._full = at + count == n
            if self._full and self._next_point <= whole:
                self._take_wave()

    def _take_wave(self) -> None:
        self._full = False
        self._add_waves(self._wave[None])
        if self.settings.averaging == 'sliding':  # which keeps the array
            self._wave = np.empty_like(self._wave)

    def _add_waves(self, waves: FloatArray) -> None:
        """Add whole fundamental cycles (cycle, angle, channel) to the mean."""
        if self.settings.averaging == 'sliding':
            end = self._next_point // self._points
            self._whole.extend(range(end - len(waves), end))
        self._wave_mean.update(waves)

    def _slide(self) -> None:
        """Drop the cycles that are no longer in a sliding window."""
        if not isinstance(self._wave_mean, SlidingMean):
            return
        assert isinstance(self._amplitude_mean, SlidingMean)
        self._amplitude_mean.forget(self._amplitude_mean.count - self.settings.trigger_cycles)
        whole = math.ceil(self._angle(int(self._places.items['number'][0])))
        while self._whole and self._whole[0] < whole:
            self._whole.popleft()
        self._wave_mean.forget(self._wave_mean.count - len(self._whole))

    def _result(self) -> Average:
        settings = self.settings
        shape = self._wave.shape
        count = self._wave_mean.count
        waveform, error, parts = np.full(shape, np.nan), np.full(shape, np.nan), None
        if count:
            total = self._wave_mean
            if isinstance(total, PartsMean):
                parts, total = waveform_parts(total.parts()), total.together()
            waveform, error = total.mean, total.standard_error
        if settings.averaging == 'exponential':
            window = math.floor(self._angle(settings.trigger_cycles))
            count = min(count, max(window, 1))
        pulses, used, seconds = self._edges()
        cycles, gains = self._without_constant(self._amplitudes.items), self._gains.items
        cycles.flags.writeable = False
        noise, scatter = self._estimated_noise(cycles)
        numbers, speed = self._places.items['number'], len(cycles) / seconds
        refused = refused_orders(settings.orders, gains, method=settings.interpolation,
                                 rate=self._rate, speed=settings.cycle_length * speed)
        gain = mean_gain(gains, settings.orders, refused)
        amplitudes = self._without_constant(self._amplitude_mean.mean.view(np.complex128))
        if refused:
            cycles, amplitudes = (np.where(np.isnan(gain), np.nan, item)
                                  for item in (cycles, amplitudes))
        error = waveform_error(waveform, error, count, scatter.jitter, settings.cycle_length)
        average = Average(
            start_time=float(pulses[0]), end_time=float(pulses[-1]), sequence=self._sequence,
            trigger_cycles=len(cycles), fundamental_cycles=count,
            discarded_cycles=int(numbers[-1] - numbers[0]) + 1 - numbers.size,
            trigger_speed=speed * settings.revolutions_per_trigger,
            angle=np.arange(shape[0]) / max(shape[0], 1), waveform=waveform.T,
            standard_error=error.T, orders=np.array(settings.orders),
            amplitudes=amplitudes, noise=noise / gain,
            first_angle=float(self._angle(int(numbers[0]))), pulses=pulses, used=used,
            cycle_numbers=numbers - numbers[0], cycle_amplitudes=cycles,
            amplitude_errors=scatter.errors(
                gain * amplitudes, settings.declared_jitter(1.0 / speed)).over(gain),
            parts=parts, gains=gains, refused=refused)
        self._sequence += 1
        return average

    def _edges(self) -> tuple[FloatArray, NDArray[np.bool_], float]:
        """Return the pulses (s), which of them begin a cycle, and the time of all cycles."""
        begins, ends = self._places.items['begin'], self._places.items['end']
        breaks = np.flatnonzero(begins[1:] != ends[:-1])
        pulses = np.insert(np.append(begins, ends[-1]), breaks + 1, ends[breaks])
        used = np.insert(np.append(np.ones(begins.size, np.bool_), False), breaks + 1, False)
        gaps = float(np.sum(begins[breaks + 1] - ends[breaks]))
        return pulses, used, float(pulses[-1] - pulses[0]) - gaps

    def _estimated_noise(self, cycles: ComplexArray) -> tuple[FloatArray, Repeatability]:
        """
        Return noise and repeatability of what the interpolator left of the `cycles`.

        A sliding window renews them after an eighth of it.
        """
        if self._noise is None or self._counted >= self._noise_due:
            orders, cycle_length = self.settings.orders, self.settings.cycle_length
            cycles = cycles * self._gains.items[:, None]
            clean = without_leakage(cycles, orders, cycle_length,
                                    cycle_length * self._places.items['number'])
            self._noise = radial_noise(clean), Repeatability.of(
                cycles, clean, np.array(orders), cycle_length=cycle_length)
            self._noise_due = self._counted + max(self.settings.trigger_cycles // 8, 1)
        return self._noise


def _discarded(numbers: Sequence[int]) -> int:
    """Return how many cycles lie between those of these ascending numbers."""
    return numbers[-1] - numbers[0] + 1 - len(numbers)
