"""An average with the errors of its pulses recovered from the vibration, and taken out."""

from collections.abc import Sequence
from dataclasses import replace
import math

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.averaging.average import Average, AverageSettings, Correction
from sa_jitter_ros.averaging.cycle import cycle_grid, CycleSamples
from sa_jitter_ros.averaging.recovery import recover_pulse_errors
from sa_jitter_ros.averaging.shaft import average_cycles, ShaftAverager

FloatArray = NDArray[np.float64]

_REACH = 0.02  # of a trigger cycle by which a corrected pulse may move
# Phase in rad up to which the recovered errors may be uncertain at an order. Beyond it the noise
# of the order itself has a say in them, and aligning noise to itself raises the amplitude.
_UNCERTAIN = 0.3


class CorrectingAverager:
    """A `ShaftAverager` whose averages come with their `Correction` where settings ask for it."""

    def __init__(self, settings: AverageSettings) -> None:
        self._shaft = ShaftAverager(settings)
        self._cycles: list[CycleSamples] = []

    @property
    def settings(self) -> AverageSettings:
        """Settings in force."""
        return self._shaft.settings

    def reset(self) -> bool:
        """Begin again at angle 0; returns whether an unfinished average was lost."""
        self._cycles.clear()
        return self._shaft.reset()

    def change(self, settings: AverageSettings) -> bool:
        """Go on with other settings and the same angle; returns whether an average was lost."""
        self._cycles.clear()
        return self._shaft.change(settings)

    def margin(self, period: float, rate: float) -> int:
        """Return how many samples a cycle of `period` s at `rate` Hz needs on either side."""
        reach = math.ceil(_REACH * period * rate) if self.settings.correct_jitter else 0
        return self._shaft.margin(period, rate) + reach

    def update(self, cycle: CycleSamples) -> Average | None:
        """Take the next trigger cycle; returns an average, corrected, when one is due."""
        average = self._shaft.update(cycle)
        if not self.settings.correct_jitter:
            return average
        self._cycles.append(cycle)
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

    `cycles` are the trigger cycles of `raw`, `settings` those it was made with.
    """
    if len(cycles) < 2:
        return _uncorrected(raw, 'one trigger cycle cannot be compared with itself: average more')
    # By the linear law, whatever the settings: the recovery knows its error inside a cycle.
    grid = cycle_grid(cycles, method=settings.interpolation)
    clock = settings.keyphasor_rate or cycles[0].rate
    recovery = recover_pulse_errors(
        grid, periods=np.diff(raw.pulses), cycle_length=settings.cycle_length,
        first_angle=raw.first_angle, also=settings.orders,
        declared_standard_deviation=1.0 / (math.sqrt(12.0) * clock))
    corrected = raw
    largest, reach = np.abs(recovery.errors).max(), _REACH * np.diff(raw.pulses).min()
    if largest > reach:
        recovery = replace(recovery, accepted=False, errors=np.zeros_like(recovery.errors),
                           reason=f'a pulse error of {largest:.3g} s is above {reach:.3g} s, '
                                  f'{_REACH:.0%} of a trigger cycle: validate the pulses')
    elif recovery.accepted:
        corrected = _average_again(raw, cycles, settings, raw.pulses - recovery.errors)
    phase = np.zeros(len(raw.orders))
    if recovery.accepted:
        frequency = raw.orders * settings.cycle_length / np.diff(raw.pulses).mean()
        phase = 2.0 * np.pi * frequency * math.sqrt(np.mean(recovery.standard_errors**2))
        corrected = replace(corrected, amplitudes=np.where(
            phase <= _UNCERTAIN, corrected.amplitudes, np.nan))
    with np.errstate(divide='ignore', invalid='ignore'):
        amplitude = np.abs(corrected.amplitudes)
        attenuation = np.abs(raw.amplitudes) / amplitude
        # The noises of raw and corrected are correlated by what the signal keeps, `attenuation`.
        error = corrected.noise / amplitude * np.sqrt(np.maximum(1.0 - attenuation**2, 0.0))
    return Correction(
        corrected.waveform, corrected.amplitudes, corrected.noise, recovery.errors,
        recovery.standard_errors, recovery.accepted, recovery.reason, attenuation,
        np.hypot(error, attenuation * phase**2 / 2.0), corrected.cycle_amplitudes)


def _uncorrected(raw: Average, reason: str) -> Correction:
    """Return the raw average as one that could not be corrected."""
    unknown = np.full(raw.amplitudes.shape, np.nan)
    return Correction(
        raw.waveform, raw.amplitudes, raw.noise, np.zeros(len(raw.pulses)),
        np.full(len(raw.pulses), np.nan), False, reason, unknown, unknown, raw.cycle_amplitudes)


def _average_again(raw: Average, cycles: Sequence[CycleSamples],
                   settings: AverageSettings, pulses: FloatArray) -> Average:
    """Average the same cycles between corrected pulses."""
    again = replace(settings, samples_per_revolution=raw.waveform.shape[1],
                    trigger_cycles=raw.trigger_cycles)
    average = average_cycles(
        (replace(cycle, pulses=pulses, first=index) for index, cycle in enumerate(cycles)),
        again, first_cycle=round(raw.first_angle / settings.cycle_length))
    return replace(average, sequence=raw.sequence)
