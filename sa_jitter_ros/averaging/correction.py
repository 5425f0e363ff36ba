# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The corrected average: pulse errors are recovered from the vibration and removed."""

from collections.abc import Sequence
from dataclasses import replace
import math

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.averaging.average import Average, AverageSettings, Correction
from sa_jitter_ros.averaging.cycle import cycle_grid, CycleSamples
from sa_jitter_ros.averaging.noise import attenuation
from sa_jitter_ros.averaging.recovery import recover_pulse_errors
from sa_jitter_ros.averaging.shaft import average_cycles, ShaftAverager

FloatArray = NDArray[np.float64]

_REACH = 0.02  # largest correction of a pulse, a fraction of a trigger cycle
# Largest uncertainty of the phase (rad) of an order by that of the recovered errors. Beyond it the
# noise of the order determines the errors, and the correction would raise the amplitude of noise.
_UNCERTAIN = 0.3


class CorrectingAverager:
    """A `ShaftAverager` that adds the `Correction` to its averages if `correct_jitter` is set."""

    def __init__(self, settings: AverageSettings) -> None:
        self._shaft = ShaftAverager(settings)
        self._cycles: list[CycleSamples] = []

    @property
    def settings(self) -> AverageSettings:
        """Return the present settings."""
        return self._shaft.settings

    def reset(self) -> bool:
        """Begin again at angle 0; return whether an unfinished average was lost."""
        self._cycles.clear()
        return self._shaft.reset()

    def change(self, settings: AverageSettings) -> bool:
        """Continue at the same angle with other settings; return whether an average was lost."""
        self._cycles.clear()
        return self._shaft.change(settings)

    def margin(self, period: float, rate: float) -> int:
        """Return the samples that a cycle of `period` s at `rate` Hz needs on either side."""
        reach = math.ceil(_REACH * period * rate) if self.settings.correct_jitter else 0
        return self._shaft.margin(period, rate) + reach

    @property
    def room(self) -> int:
        """Trigger cycles up to the next average."""
        return self._shaft.room

    def usable(self, periods: FloatArray, rate: float) -> NDArray[np.bool_]:
        """Return in which cycles of `periods` s the shaft turns slowly enough for `rate` Hz."""
        return self._shaft.usable(periods, rate)

    def update(self, cycles: CycleSamples) -> Average | None:
        """Take cycles, not more than `room`; return the average and its correction when due."""
        average = self._shaft.update(cycles)
        if not self.settings.correct_jitter:
            return average
        self._cycles += [cycles.part(k, k + 1) for k in range(cycles.count)]
        return self._corrected(average)

    def finish(self) -> Average | None:
        """Return the average of the cycles of an unfinished block, None if there are none."""
        average = self._shaft.finish()
        return self._corrected(average) if self.settings.correct_jitter else average

    def _corrected(self, average: Average | None) -> Average | None:
        if average is None:
            return None
        cycles, self._cycles = self._cycles, []
        return replace(average, correction=correct_average(average, cycles, self.settings))


def correct_average(raw: Average, cycles: Sequence[CycleSamples],
                    settings: AverageSettings) -> Correction:
    """
    Recover the pulse errors of a block average and average its cycles again without them.

    `cycles` are the trigger cycles of `raw`, `settings` its settings.
    """
    if len(cycles) < 2:
        return _uncorrected(raw, 'pulse errors follow from the difference between trigger cycles '
                                 'and there is one cycle: average more')
    # The recovery is a model of the linear law, whatever law the settings have.
    grid = cycle_grid(cycles, method=settings.interpolation)
    clock = settings.keyphasor_rate or cycles[0].rate
    recovery = recover_pulse_errors(
        grid, periods=np.diff(raw.pulses), cycle_length=settings.cycle_length,
        first_angle=raw.first_angle, additional_orders=settings.orders,
        declared_standard_deviation=1.0 / (math.sqrt(12.0) * clock))
    corrected = raw
    largest, reach = np.abs(recovery.errors).max(), _REACH * np.diff(raw.pulses).min()
    if largest > reach:
        recovery = replace(recovery, accepted=False, errors=np.zeros_like(recovery.errors),
                           reason=f'a pulse error of {largest:.3g} s is above {reach:.3g} s, '
                                  f'{_REACH:.0%} of a trigger cycle: check the pulses')
    elif recovery.accepted:
        corrected = _average_again(raw, cycles, settings, raw.pulses - recovery.errors)
    phase = np.zeros(len(raw.orders))
    if recovery.accepted:
        frequency = raw.orders * settings.cycle_length / np.diff(raw.pulses).mean()
        phase = 2.0 * np.pi * frequency * math.sqrt(np.mean(recovery.standard_errors**2))
        corrected = replace(corrected, amplitudes=np.where(
            phase <= _UNCERTAIN, corrected.amplitudes, np.nan))
    ratio, error = attenuation(raw.amplitudes, corrected.amplitudes, corrected.noise)
    return Correction(
        corrected.waveform, corrected.amplitudes, corrected.noise, recovery.errors,
        recovery.standard_errors, recovery.accepted, recovery.reason, ratio,
        np.hypot(error, ratio * phase**2 / 2.0), corrected.cycle_amplitudes)


def _uncorrected(raw: Average, reason: str) -> Correction:
    """Return the raw average as a correction that is not accepted."""
    unknown = np.full(raw.amplitudes.shape, np.nan)
    return Correction(
        raw.waveform, raw.amplitudes, raw.noise, np.zeros(len(raw.pulses)),
        np.full(len(raw.pulses), np.nan), False, reason, unknown, unknown, raw.cycle_amplitudes)


def _average_again(raw: Average, cycles: Sequence[CycleSamples],
                   settings: AverageSettings, pulses: FloatArray) -> Average:
    """Return the average of the same cycles between corrected pulses."""
    again = replace(settings, samples_per_revolution=raw.waveform.shape[1],
                    trigger_cycles=raw.trigger_cycles)
    average = average_cycles(
        (replace(cycle, pulses=pulses, first=index) for index, cycle in enumerate(cycles)),
        again, first_cycle=round(raw.first_angle / settings.cycle_length))
    return replace(average, sequence=raw.sequence)
