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
The synchronous average of one shaft, cycle by cycle.

It takes the samples of consecutive trigger cycles and returns an average whenever one is due. The
settings limit its memory.
"""

from collections import deque
from collections.abc import Iterable
from fractions import Fraction
import math

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.averaging.average import Average, AverageSettings
from sa_jitter_ros.averaging.cycle import (choose_samples_per_revolution, CycleSamples,
                                           exact_cycles, first_point, grid_points,
                                           needed_margin, on_grid, project, waveform_cutoff)
from sa_jitter_ros.averaging.noise import radial_noise, without_leakage
from sa_jitter_ros.averaging.running_mean import (BlockMean, ExponentialMean, RunningMean,
                                                  SlidingMean)
from sa_jitter_ros.errors import SignalError
from sa_jitter_ros.pulses.angle_law import angle_law

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


class ShaftAverager:
    """Averages trigger cycles of one shaft: `update` per cycle, `reset` after an interruption."""

    def __init__(self, settings: AverageSettings, *, first_cycle: int = 0) -> None:
        self.settings = settings
        self._law = angle_law(settings.angle_law)
        self._cycle = first_cycle
        self._sequence = 0
        self._points = settings.samples_per_revolution
        self._start()

    def reset(self) -> bool:
        """Begin again at angle 0; return whether an unfinished average was lost."""
        lost = self.settings.averaging == 'block' and self._counted > 0
        self._cycle = 0
        self._start()
        return lost

    def finish(self) -> Average | None:
        """Return the average of the cycles of an unfinished block, None if there are none."""
        if self.settings.averaging != 'block' or not self._counted:
            return None
        average = self._result()
        self._start()
        return average

    def change(self, settings: AverageSettings) -> bool:
        """Continue at the same angle with other settings; return whether an average was lost."""
        lost = self.settings.averaging == 'block' and self._counted > 0
        if settings.cycle_length != self.settings.cycle_length:
            self._cycle = 0
        self.settings, self._law = settings, angle_law(settings.angle_law)
        self._points = settings.samples_per_revolution
        self._start()
        return lost

    def margin(self, period: float, rate: float) -> int:
        """Return the samples that a cycle of `period` s at `rate` Hz needs on either side."""
        points = self._points or self._chosen(period, rate)
        return needed_margin(self.settings.interpolation,
                             waveform_cutoff(points, self.settings.cycle_length, period, rate))

    def update(self, cycle: CycleSamples) -> Average | None:
        """
        Take the next trigger cycle; return an average when one is due.

        Raises `SignalError` if the shaft frequency is not below half the sampling rate.
        """
        settings = self.settings
        if settings.cycle_length / cycle.period >= cycle.rate / 2.0:
            raise SignalError(
                f'shaft frequency {settings.cycle_length / cycle.period:.6g} Hz is not below half '
                f'the sampling rate of {cycle.rate:.6g} Hz: check ratio and pulses_per_revolution')
        if not self._counted:
            self._choose_grid(cycle)
        angle = self._angle(self._cycle)
        grid, first, points = self._resample(cycle, angle)
        amplitudes = project(grid, settings.cycle_length, settings.orders, angle)
        amplitudes[:, self.beyond_nyquist(cycle.period, cycle.rate)] = np.nan
        if not self._counted:
            self._expect_from(angle)
        self._add_points(first, points, self._angle(self._cycle + 1))
        self._amplitude_mean.update(amplitudes)
        self._remember(amplitudes)
        self._pulses.append(float(cycle.pulses[cycle.first + 1]))
        if not self._counted:
            self._pulses.appendleft(float(cycle.pulses[cycle.first]))
        self._counted += 1
        self._cycle += 1
        if self._counted < settings.trigger_cycles:
            return None
        self._slide()
        average = self._result()
        if settings.averaging == 'block':
            self._start()
        return average

    def _angle(self, cycle: int) -> Fraction:
        """Return the angle (fundamental cycles) at which a trigger cycle begins."""
        return exact_cycles(self.settings.cycle_length) * cycle

    def beyond_nyquist(self, period: float, rate: float) -> NDArray[np.bool_]:
        """Return which orders are at or above half the sampling rate."""
        return np.asarray(np.array(self.settings.orders) * self.settings.cycle_length / period
                          >= rate / 2.0)

    # --- the grid ---

    def _chosen(self, period: float, rate: float) -> int:
        return choose_samples_per_revolution(self.settings.cycle_length, period, rate)

    def _choose_grid(self, cycle: CycleSamples) -> None:
        if self.settings.samples_per_revolution:
            return
        # Subscribers need one shape: the waveform keeps its length while it is neither coarser
        # than the samples nor more than twice as fine.
        needed = cycle.period * cycle.rate / self.settings.cycle_length
        if not needed <= self._points <= 2.2 * needed:
            self._points = self._chosen(cycle.period, cycle.rate)

    def _resample(self, cycle: CycleSamples, angle: Fraction
                  ) -> tuple[FloatArray, int, FloatArray]:
        """Return the grid of a cycle with both ends, its first waveform point, and its points."""
        r, n, method = self.settings.cycle_length, self._points, self.settings.interpolation
        cutoff = waveform_cutoff(n, r, cycle.period, cycle.rate)
        if on_grid(n, r) and cutoff == 1.0:
            count = round(n * r)
            grid = cycle.at(self._law, np.arange(count + 1) / count, method=method)
            return grid, first_point(angle, n), grid[:-1]
        count = grid_points(cycle.period, cycle.rate)
        grid = cycle.at(self._law, np.arange(count + 1) / count, method=method)
        first, end = first_point(angle, n), first_point(self._angle(self._cycle + 1), n)
        u = (np.arange(end - first, dtype=np.float64) + float(first - angle * n)) / (n * r)
        return grid, first, cycle.at(self._law, u, method=method, cutoff=cutoff)

    # --- the average in progress ---

    def _start(self) -> None:
        settings = self.settings
        self._counted = self._noise_due = 0
        self._noise: FloatArray = np.empty((0, 0))
        self._amplitude_mean = self._new_mean(settings.trigger_cycles)
        self._wave_mean = self._new_mean(max(settings.trigger_cycles * settings.cycle_length, 1.0))
        self._amplitudes: ComplexArray = np.empty((0, 0, 0), np.complex128)
        self._end = 0  # of those of cycles in `_amplitudes`
        self._pulses: deque[float] = deque(maxlen=settings.trigger_cycles + 1)
        self._wave: FloatArray = np.empty((0, 0))
        self._next_point = 0
        self._full = False  # the waveform has all points, but its end is not reached
        self._first_whole = 0

    def _remember(self, amplitudes: ComplexArray) -> None:
        """Append the amplitudes of a cycle to those of the window, in memory never reused."""
        if self._end == len(self._amplitudes):
            kept = min(self._counted, self.settings.trigger_cycles - 1)
            room = np.empty((max(2 * kept, 16), *amplitudes.shape), np.complex128)
            if kept:
                room[:kept] = self._amplitudes[self._end - kept:self._end]
            self._amplitudes, self._end = room, kept
        self._amplitudes[self._end] = amplitudes
        self._end += 1

    def _window(self) -> ComplexArray:
        """Return the amplitudes (cycle, channel, order) of the latest N_t cycles, read-only."""
        count = min(self._counted, self.settings.trigger_cycles)
        window = self._amplitudes[self._end - count:self._end]
        window.flags.writeable = False
        return window

    def _new_mean(self, cycles: float) -> RunningMean:
        if self.settings.averaging == 'exponential':
            return ExponentialMean(cycles)
        if self.settings.averaging == 'sliding':
            return SlidingMean()
        return BlockMean()

    def _expect_from(self, angle: Fraction) -> None:
        """Begin with the first fundamental cycle that is whole from this angle on."""
        self._next_point = math.ceil(angle) * self._points

    def _add_points(self, first: int, points: FloatArray, end: Fraction) -> None:
        """Put points into their fundamental cycle; add it to the mean if it is whole at `end`."""
        if len(self._wave) != self._points:
            self._wave = np.full((self._points, points.shape[1]), np.nan)
        if self._full:
            self._take_wave()
        whole = math.floor(end) * self._points
        points = points[max(self._next_point - first, 0):]
        while len(points):
            at = self._next_point % self._points
            count = min(len(points), self._points - at)
            self._wave[at:at + count] = points[:count]
            points = points[count:]
            self._next_point += count
            self._full = at + count == self._points
            if self._full and self._next_point <= whole:
                self._take_wave()

    def _take_wave(self) -> None:
        self._full = False
        if not self._wave_mean.count:
            self._first_whole = self._next_point // self._points - 1
        self._wave_mean.update(self._wave)
        if self.settings.averaging == 'sliding':  # which keeps the array
            self._wave = np.empty_like(self._wave)

    def _slide(self) -> None:
        """Drop the cycles that are no longer in a sliding window."""
        if not isinstance(self._wave_mean, SlidingMean):
            return
        assert isinstance(self._amplitude_mean, SlidingMean)
        self._amplitude_mean.forget(self._amplitude_mean.count - self.settings.trigger_cycles)
        whole = math.ceil(self._angle(self._cycle - self.settings.trigger_cycles))
        outside = min(max(whole - self._first_whole, 0), self._wave_mean.count)
        self._wave_mean.forget(outside)
        self._first_whole += outside

    def _result(self) -> Average:
        settings = self.settings
        shape = self._wave.shape
        count = self._wave_mean.count
        waveform, error = np.full(shape, np.nan), np.full(shape, np.nan)
        if count:
            waveform, error = self._wave_mean.mean, self._wave_mean.standard_error
        if settings.averaging == 'exponential':
            window = math.floor(self._angle(settings.trigger_cycles))
            count = min(count, max(window, 1))
        pulses, cycles = np.array(self._pulses), self._window()
        average = Average(
            start_time=self._pulses[0], end_time=self._pulses[-1], sequence=self._sequence,
            trigger_cycles=len(cycles), fundamental_cycles=count, discarded_cycles=0,
            trigger_speed=((pulses.size - 1) * settings.revolutions_per_trigger
                           / (self._pulses[-1] - self._pulses[0])),
            angle=np.arange(shape[0]) / max(shape[0], 1), waveform=waveform.T,
            standard_error=error.T, orders=np.array(settings.orders),
            amplitudes=self._amplitude_mean.mean, noise=self._estimated_noise(),
            first_angle=float(self._angle(self._cycle - len(cycles))), pulses=pulses,
            cycle_amplitudes=cycles)
        self._sequence += 1
        return average

    def _estimated_noise(self) -> FloatArray:
        """Return the noise of the mean; a sliding window renews it after every eighth of it."""
        if self._counted >= self._noise_due:
            orders, cycle_length = self.settings.orders, self.settings.cycle_length
            amplitudes = self._window()
            angles = cycle_length * (self._cycle - np.arange(len(amplitudes), 0, -1))
            self._noise = radial_noise(without_leakage(amplitudes, orders, cycle_length, angles))
            self._noise_due = self._counted + max(self.settings.trigger_cycles // 8, 1)
        return self._noise


def average_cycles(cycles: Iterable[CycleSamples], settings: AverageSettings, *,
                   first_cycle: int = 0) -> Average:
    """
    Return the block average of trigger cycles, as many as `settings.trigger_cycles`.

    `first_cycle` is the number of the first one; the angle is 0 where cycle 0 begins.

    >>> samples = np.cos(2.0 * np.pi * 4.0 * 25.0 * np.arange(2000) / 2e3)[:, None]
    >>> pulses = 0.02 + np.arange(11) / 25.0
    >>> cycles = [CycleSamples.cut(samples, start_time=0.0, rate=2e3, pulses=pulses, first=k,
    ...                            margin=20) for k in range(10)]
    >>> average = average_cycles(cycles, AverageSettings(trigger_cycles=10, orders=(4.0,)))
    >>> abs(average.amplitudes).round(3), average.fundamental_cycles
    (array([[1.]]), 10)
    """
    shaft = ShaftAverager(settings, first_cycle=first_cycle)
    average = None
    for cycle in cycles:
        average = shaft.update(cycle)
    assert average is not None
    return average
