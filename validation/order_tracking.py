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
The full simulation of Section 4.1: a time signal, order tracking, the synchronous average.

The gearbox gives the vibration and the jittered pulses, the package's own averager resamples and
averages, and a Fourier line of the averaged waveform is the amplitude. A complex harmonic is two
channels, its cosine and its sine.
"""

from dataclasses import dataclass, replace
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.averaging.average import Average, AverageSettings
from sa_jitter_ros.averaging.cycle import CycleSamples
from sa_jitter_ros.averaging.shaft import ShaftAverager
from sa_jitter_ros.errors import SignalError
from sa_jitter_ros.simulation import Component, DeclaredJitter, Gearbox
from validation.results import Progress

Array = NDArray[Any]


@dataclass(frozen=True)
class HarmonicCase:
    """
    A signal of complex harmonics seen through a jittered keyphasor.

    `trigger_cycles` N_t, `cycle_length` r, `width` of the uniform pulse error in fundamental
    cycles, `harmonics` as (order, amplitude); the rest is Table 1: fundamental frequency and
    sampling rate in Hz, angular samples per revolution, interpolator.
    """

    trigger_cycles: int
    cycle_length: float
    width: float
    harmonics: tuple[tuple[float, float], ...] = ((1.0, 1.0),)
    fundamental: float = 16.0
    sample_rate: float = 2048.0
    samples_per_revolution: int = 256
    interpolation: str = 'band_limited'

    @property
    def trigger_period(self) -> float:
        """Return the length of a trigger cycle in s."""
        return self.cycle_length / self.fundamental

    def machine(self, seed: int) -> Gearbox:
        """Return the machine, whose pulse errors alone depend on the seed."""
        return Gearbox(
            components=[Component('target', order, (size, size), (0.0, -0.5 * math.pi))
                        for order, size in self.harmonics],
            sample_rate=self.sample_rate, shafts={'target': self.cycle_length},
            speed=((0.0, 1.0 / self.trigger_period),), seed=seed,
            effects=(DeclaredJitter('uniform', self.width / self.fundamental / math.sqrt(12.0)),))


@dataclass(frozen=True)
class Simulated:
    """
    Amplitudes of order 1 from full simulations, and the pulse errors behind them.

    `amplitudes` (n,) are those of the averaged waveform, over whole fundamental cycles, as in the
    paper; `order_amplitudes` (n,) those over whole trigger cycles; both complex. `errors`
    (n, trigger_cycles + 1) in fundamental cycles.
    """

    amplitudes: Array
    order_amplitudes: Array
    errors: Array


def simulate(case: HarmonicCase, count: int, *, seed: int, progress: Progress) -> Simulated:
    """Simulate, order-track and average `count` times with independent pulse errors."""
    period = case.trigger_period
    stop = (case.trigger_cycles + 1.0) * period
    vibration = case.machine(0).vibration(0, math.ceil(stop * case.sample_rate)).T
    settings = AverageSettings(
        cycle_length=case.cycle_length, trigger_cycles=case.trigger_cycles, orders=(1.0,),
        samples_per_revolution=case.samples_per_revolution, interpolation=case.interpolation)
    amplitudes, order_amplitudes = np.empty((2, count), complex)
    errors = np.empty((count, case.trigger_cycles + 1))
    for k in range(count):
        # the first pulse is due after a quarter of a trigger cycle
        pulses = case.machine(seed + k).pulses(0.0, stop - 0.25 * period)
        average = synchronous_average(vibration, case.sample_rate, pulses.times, settings)
        amplitudes[k] = _complex_harmonic(fourier_lines(average, [1]))
        order_amplitudes[k] = _complex_harmonic(average.amplitudes)
        errors[k] = pulses.errors * case.fundamental
        progress((k + 1.0) / count)
    return Simulated(amplitudes, order_amplitudes, errors)


def _complex_harmonic(peaks: Array) -> complex:
    """Return the amplitude of cosine + j sine from the peak amplitudes of both, shape (2, 1)."""
    return complex(0.5 * (peaks[0, 0] + 1j * peaks[1, 0]))


def as_in_table_1(case: HarmonicCase) -> HarmonicCase:
    """Return the case with the paper's sampling rate and interpolator."""
    return replace(case, sample_rate=16384.0, interpolation='spline')


def synchronous_average(
    samples: Array, rate: float, pulses: Array, settings: AverageSettings,
) -> Average:
    """
    Return the average of the first `settings.trigger_cycles` cycles of a recording.

    `samples` (n, channels) at `rate` Hz from time 0, `pulses` in s. Raises SignalError when there
    are too few pulses or samples.
    """
    averager = ShaftAverager(settings)
    average = None
    for cycle in range(min(settings.trigger_cycles, len(pulses) - 1)):
        margin = averager.margin(pulses[cycle + 1] - pulses[cycle], rate)
        first = max(int(pulses[cycle] * rate) - margin, 0)
        last = int(pulses[cycle + 1] * rate) + margin + 2
        average = averager.update(
            CycleSamples(samples[first:last], first / rate, rate, pulses, cycle))
    if average is None:
        raise SignalError(f'{len(pulses)} pulses make no average of {settings.trigger_cycles} '
                          'trigger cycles: record longer')
    return average


def fourier_lines(average: Average, orders: list[int]) -> Array:
    """Return the complex peak amplitudes of whole orders of the waveform, (channel, order)."""
    spectrum = np.fft.rfft(average.waveform, axis=-1)
    return np.asarray(2.0 / average.waveform.shape[-1] * spectrum[:, orders])
