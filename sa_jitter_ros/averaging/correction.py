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
from dataclasses import dataclass, replace
import math

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray
from sa_jitter_ros.arrays import ComplexArray, FloatArray
from sa_jitter_ros.averaging.amplitude_errors import (AmplitudeErrors, corrected_errors,
                                                      kurtosis_of, Repeatability, Scatter)
from sa_jitter_ros.averaging.average import Average, AverageSettings, Correction
from sa_jitter_ros.averaging.channel_gaps import ChannelGaps, telling
from sa_jitter_ros.averaging.cycle import cycle_grid, CycleSamples
from sa_jitter_ros.averaging.displaced_pulses import displacements
from sa_jitter_ros.averaging.envelope import Envelope, residual_envelope
from sa_jitter_ros.averaging.grid_cycles import GridCycles
from sa_jitter_ros.averaging.noise import attenuation, leaks_apart, without_leakage
from sa_jitter_ros.averaging.other_lines import coherent, other_lines, with_images
from sa_jitter_ros.averaging.pulse_error_fit import variance_within
from sa_jitter_ros.averaging.recovery import PulseErrorRecovery, recover_pulse_errors
from sa_jitter_ros.averaging.shaft import ShaftAverager

Grid = tuple[FloatArray, GridCycles, NDArray[np.bool_]]

_ROUNDS = 2  # of the search for displaced pulses
_REACH = 0.06  # largest correction of a pulse, a fraction of a trigger cycle
# Largest uncertainty of the phase (rad) of an order by that of the expected errors.
_UNCERTAIN = 1.0
# Noise over amplitude, both squared, up to which the whole correction counts (19.3 dB), and from
# which on it counts as far as it is worth so many times that, and as pulse errors are evident.
_CLEAR, _WEAK, _CAUTION = 0.0118, 0.015, 3.0
# Loss of an order by what is uncertain of the errors: the same for them.
_SURE, _AMBIGUOUS = 0.05, 0.3
# Evidence that noise has by chance, how fast more of it is rarer, and what noise never has.
_DOUBT, _DECAY, _EVIDENT = 2.0, 3.0, 10.0
# Share of a leakage at an unknown angle that lies along the radius.
_RADIAL = math.sqrt(0.5)
_TINY = 1e-150  # whose square is not 0
_U, _U_WEIGHT = (0.5 * (item + shift) for item, shift in zip(legendre.leggauss(6), (1.0, 0.0)))


class LatestGrid:
    """Grids of the latest trigger cycles that were corrected: several shafts may have the same."""

    def __init__(self) -> None:
        self._key: tuple[str, bytes] | None = None
        self._found: Grid | None = None

    def forget(self) -> None:
        """Free the memory: the cycles that come have other samples."""
        self._key = self._found = None

    def of(self, cycles: list[CycleSamples], method: str, numbers: NDArray[np.int64]) -> Grid:
        """
        Return the grid (cycle, sample, channel) of `cycles`, which are resampled by `method`.

        Their `numbers` (cycle,) count from the first one, discarded ones included. The second
        result has those channels only which tell of the pulse errors, as the third (channel,)
        says; if none does, all.
        """
        key = method, np.array([cycle.edges for cycle in cycles]).tobytes()
        if self._found is None or key != self._key:
            grid = cycle_grid(cycles, method=method)
            informative = telling(grid, cycles)
            if not informative.any():
                informative[:] = True
            seen = grid if informative.all() else grid[..., informative]
            self._key, self._found = key, (grid, GridCycles(seen, numbers), informative)
        return self._found


class CorrectingAverager(ShaftAverager):
    """
    A `ShaftAverager` that adds to its averages what needs their cycles once more.

    That is the `Correction` if `correct_jitter` is set, and the `Envelope` with bearing orders.
    `grids` it shares with other shafts.
    """

    def __init__(self, settings: AverageSettings, grids: LatestGrid) -> None:
        self._grids = grids
        super().__init__(settings)

    def margin(self, period: float, rate: float) -> int:
        """Return the samples that a cycle of `period` s at `rate` Hz needs on either side."""
        reach = math.ceil(_REACH * period * rate) if self.settings.correct_jitter else 0
        return super().margin(period, rate) + reach

    def _start(self) -> None:
        super()._start()
        self._cycles: list[CycleSamples] = []
        self._gaps = ChannelGaps()

    def _take(self, cycles: CycleSamples) -> None:
        super()._take(cycles)
        self._gaps.take(cycles)
        if self._keeps_cycles:
            self._cycles += [cycles.part(k, k + 1) for k in range(cycles.count)]

    @property
    def _keeps_cycles(self) -> bool:
        return self.settings.correct_jitter or bool(self.settings.envelope.bearing_orders)

    def _result(self) -> Average:
        average = super()._result()
        if self.settings.correct_jitter:
            average = self._corrected(average, self._cycles)
        if self._keeps_cycles and (
                average.correction is None or not average.correction.accepted):
            average = replace(average, envelope=_envelope(average, self._cycles, self.settings))
        return self._gaps.blank(average, averaging=self.settings.averaging,
                                trigger_cycles=self.settings.trigger_cycles)

    def _corrected(self, average: Average, cycles: list[CycleSamples]) -> Average:
        correction = correct_average(average, cycles, self.settings, self._grids)
        errors = average.amplitude_errors
        if correction.accepted:
            # The vibration and the declaration together know the jitter better than a few cycles.
            errors = Repeatability.of(
                *_resampled(average, average.cycle_amplitudes, self.settings), average.orders,
                cycle_length=self.settings.cycle_length,
                jitter=_in_cycles(correction.jitter_std, average, self.settings),
                kurtosis=kurtosis_of(correction.pulse_errors),
                corrected=Scatter.of(*_resampled(
                    average, correction.cycle_amplitudes, self.settings))).errors(
                        average.amplitudes * average.gain).over(average.gain)
        return replace(average, correction=correction, amplitude_errors=errors)


def _in_cycles(seconds: float, average: Average, settings: AverageSettings) -> float:
    """Return a time in fundamental cycles."""
    return seconds * settings.cycle_length / float(np.mean(average.periods))


def _resampled(average: Average, cycles: ComplexArray, settings: AverageSettings
               ) -> tuple[ComplexArray, ComplexArray]:
    """
    Return amplitudes of the `cycles` of an average as the interpolator has left them.

    The second result is without the leakage between the orders.
    """
    cycles = cycles * average.gains[:, None]
    angles = average.first_angle + settings.cycle_length * average.cycle_numbers
    return cycles, without_leakage(cycles, settings.orders, settings.cycle_length, angles)


def correct_average(raw: Average, cycles: list[CycleSamples], settings: AverageSettings,
                    grids: LatestGrid) -> Correction:
    """
    Recover the pulse errors of a block average and average its cycles again without them.

    `cycles` are the trigger cycles of `raw`, `settings` its settings.
    """
    if len(cycles) < 2:
        return _uncorrected(raw, 'pulse errors follow from the difference between trigger cycles '
                                 'and there is one cycle: average more')
    found = _aligned(raw, cycles, settings, grids)
    if isinstance(found, Correction):
        return found
    lines = _coherent(found, settings)
    if lines.size:
        lines = with_images(lines, raw.orders, settings.cycle_length, raw.fundamental_cycles)
        again = _aligned(raw, cycles, settings, grids, known=(found.recovery.orders, lines))
        found, lines = (found, lines[:0]) if isinstance(again, Correction) else (
            again, _coherent(again, settings))
    recovery, periods = found.recovery, raw.periods
    aligned, scatter = _steady(found.average, settings, lines)
    corrected = _of_orders(found.average, settings)
    amplitudes, unsure, whole = _amplitudes(raw, replace(corrected, amplitudes=aligned), recovery)
    begins = np.flatnonzero(raw.used)
    errors = recovery.expected * settings.cycle_length / np.mean(periods)
    turned = _mean_phasor(raw.orders, errors[begins], errors[begins + 1])
    gain = corrected.gain
    ratio, error = attenuation(raw.amplitudes, amplitudes, scatter.error_of_mean / gain, turned)
    # The raw amplitude holds what is not steady.
    apart = _RADIAL * np.abs(corrected.amplitudes - aligned) / np.maximum(abs(amplitudes), _TINY)
    return Correction(
        corrected.waveform, amplitudes, corrected.noise,
        np.where(recovery.resolved, recovery.errors, np.nan), recovery.standard_errors, True, '',
        ratio, np.hypot(np.hypot(error, apart), ratio * unsure), corrected.cycle_amplitudes,
        corrected_errors(
            scatter, raw.orders, amplitudes=amplitudes * gain, unsure=unsure, largest=whole * gain,
            jitter=_in_cycles(recovery.std, raw, settings)).over(gain),
        corrected.parts, recovery.std, found.refitted,
        _envelope(corrected, _between(raw, cycles, corrected.pulses), settings))


@dataclass(frozen=True)
class _Aligned:
    """
    The `average` between the pulses that a `recovery` expects, `refitted` of them displaced.

    It has the orders of `candidates` for lines of other shafts, too, behind its own ones: the
    first ones, and others that count where none of the first does.
    """

    recovery: PulseErrorRecovery
    refitted: int
    candidates: tuple[FloatArray, FloatArray]
    average: Average


def _aligned(raw: Average, cycles: list[CycleSamples], settings: AverageSettings,
             grids: LatestGrid, *,
             known: tuple[FloatArray, FloatArray] | None = None) -> _Aligned | Correction:
    """
    Recover the pulse errors and average again without them.

    They are recovered from orders and lines of other shafts that are `known`; else these are
    looked for. Strong ones, which leave images of themselves in recovered errors, stand out
    between the measured pulses, weak ones between the recovered pulses. A correction that is not
    accepted is returned as it is.
    """
    orders = () if known is None else np.unique(np.concatenate((raw.orders, *known))).tolist()
    recovery, refitted = _refitted(raw, cycles, settings, grids, orders)
    largest, reach = np.abs(recovery.expected).max(), _REACH * raw.periods.min()
    reason = recovery.reason if largest <= reach else (
        f'a pulse error of {largest:.3g} s is above {reach:.3g} s, {_REACH:.0%} of a trigger '
        'cycle: check the pulses')
    if reason:
        return replace(_uncorrected(raw, reason), standard_errors=recovery.standard_errors)
    grid = grids.of(cycles, settings.interpolation, raw.cycle_numbers)[1]
    errors = recovery.expected / np.mean(raw.periods)
    first = known[1] if known else other_lines(
        grid, np.zeros_like(errors), raw.orders, settings.cycle_length)
    more = first[:0] if known else other_lines(
        grid, errors, np.append(raw.orders, first), settings.cycle_length)
    return _Aligned(recovery, refitted, (first, more), _average_again(
        raw, cycles, _beside(settings, np.append(first, more)), raw.pulses - recovery.expected))


def _beside(settings: AverageSettings, lines: FloatArray) -> AverageSettings:
    """Return settings with `lines` of other shafts behind the orders."""
    return replace(settings, orders=(*settings.orders, *lines.tolist()))


def _of_orders(average: Average, settings: AverageSettings) -> Average:
    """Return an average of the orders of `settings`, which are its first ones."""
    count = len(settings.orders)
    return replace(
        average, orders=average.orders[:count], amplitudes=average.amplitudes[:, :count],
        noise=average.noise[:, :count], gains=average.gains[:, :count],
        cycle_amplitudes=average.cycle_amplitudes[..., :count])


def _coherent(found: _Aligned, settings: AverageSettings) -> FloatArray:
    """Return the lines among the candidates that an average without pulse errors still shows."""
    average, first = found.average, len(settings.orders)
    clean = _resampled(average, average.cycle_amplitudes, _beside(
        settings, np.concatenate(found.candidates)))[1]
    lines = np.empty(0)
    for candidates in found.candidates:
        if candidates.size and not lines.size:
            lines = coherent(candidates, clean[..., first:first + candidates.size],
                             average.cycle_numbers, settings.cycle_length)
        first += candidates.size
    while lines.size and not leaks_apart(
            _beside(settings, lines).orders, settings.cycle_length, len(clean)):
        lines = lines[:-1]
    return lines


def _steady(average: Average, settings: AverageSettings, lines: FloatArray
            ) -> tuple[ComplexArray, Scatter]:
    """
    Return the amplitudes (channel, order) of an average without what leaks into its cycles.

    That are the other orders, as far as the cycles keep them apart, and the `lines` of other
    shafts. The second result is the scatter of the cycles about them.
    """
    known, count = _beside(settings, lines), len(settings.orders)
    average = _of_orders(average, known)
    cycles, clean = _resampled(average, average.cycle_amplitudes, known)
    if not average.discarded_cycles and leaks_apart(
            known.orders, settings.cycle_length, len(cycles)):
        leaked = cycles.mean(axis=0) - clean.mean(axis=0)
        average, cycles = replace(
            average, amplitudes=average.amplitudes - leaked * (1.0 / average.gain)), clean
    return average.amplitudes[:, :count], Scatter.of(cycles[..., :count], clean[..., :count])


def _envelope(average: Average, cycles: Sequence[CycleSamples], settings: AverageSettings
              ) -> Envelope | None:
    """Return the envelope of what the cycles of an average have beside it, if it is asked for."""
    if not settings.envelope.bearing_orders:
        return None
    return residual_envelope(
        cycles, average.waveform, settings.envelope, cycle_length=settings.cycle_length,
        trigger_cycles=average.trigger_cycles, first_angle=average.first_angle,
        cycle_numbers=average.cycle_numbers, fundamental_cycles=average.fundamental_cycles,
        law=settings.angle_law, method=settings.interpolation)


def _amplitudes(raw: Average, aligned: Average, recovery: PulseErrorRecovery
                ) -> tuple[ComplexArray, FloatArray, FloatArray]:
    """
    Return the amplitudes (channel, order) that raw and `aligned` average show together.

    `aligned` is that between the expected pulses. What is uncertain of their errors makes an order
    smaller there; in an order that the errors were recovered from the noise has aligned itself,
    too, and it is larger (`PulseErrorRecovery.aligned`). The factor that makes up for either is
    uncertain itself. Where noise leaves more of that than the attenuation is worth, the amplitude
    stays nearer to what it is without the factor or, of an order that the errors were recovered
    from, to the raw one. An order whose phase is uncertain by more than `_UNCERTAIN` has none.

    The second result (channel, order) is the relative standard error that the factors add, the
    third the largest size of the amplitude: that with the whole factor.
    """
    variance = variance_within(recovery.covariance, _U, np.flatnonzero(raw.used))
    turn = 2.0 * (np.pi * raw.orders) ** 2
    white = (np.exp(-turn[:, None, None] * variance) @ _U_WEIGHT).mean(axis=1)
    left = np.minimum(white * np.exp(-turn * recovery.excess), 1.0)
    lost = 1.0 / left - 1.0
    size = np.maximum(np.abs(raw.amplitudes), _TINY)
    noise = np.nan_to_num(2.0 * aligned.noise**2, nan=np.inf)
    informative, factor = np.zeros(size.shape, np.bool_), np.ones(size.shape)
    beside = np.broadcast_to(turn * recovery.excess_error, size.shape)
    for order, of_one, ratio, error in zip(recovery.orders, recovery.noise.T, recovery.aligned.T,
                                           recovery.aligned_error.T):
        same = np.isclose(raw.orders, order, rtol=1e-9, atol=0.0) & np.isfinite(ratio)[:, None]
        informative |= same
        beside = np.where(same, error[:, None], beside)
        factor = np.where(same, 1.0 / ratio[:, None], factor)
        noise = np.where(same, (of_one[:, None] / raw.gain) ** 2 / raw.trigger_cycles, noise)
    whole = aligned.amplitudes * np.where(informative, factor, 1.0 + lost)
    start = np.where(informative, raw.amplitudes, aligned.amplitudes)
    # Noise that has aligned itself makes an order clear by chance: without evidence it is as clear
    # as the raw one.
    evident = recovery.evidence > _EVIDENT
    noise = noise / (np.fmax(size, np.abs(whole)) if evident else size) ** 2
    unsure = np.clip((noise - _CLEAR) / (_WEAK - _CLEAR), 0.0, 1.0)
    doubt = _CAUTION * np.where((unsure > 0.0) & ~(informative & evident), unsure * noise, 0.0)
    gained = np.where(informative, np.abs(whole) / size - 1.0, lost)
    share = np.where(doubt > 0.0, np.maximum(gained - doubt, 0.0) / np.maximum(
        gained + doubt, _TINY), 1.0)
    ambiguous = np.clip((1.0 - left - _SURE) / (_AMBIGUOUS - _SURE), 0.0, 1.0)
    chance = math.exp(-max(recovery.evidence - _DOUBT, 0.0) / _DECAY)
    share = share * np.where(informative, 1.0 - np.maximum(unsure, ambiguous) * chance, 1.0)
    amplitudes = start + share * (whole - start)
    withheld = np.abs(whole) / np.maximum(np.abs(amplitudes), _TINY) - 1.0
    # The factor is as uncertain as the size of the errors, to which N_t cycles contribute what
    # the vibration shows of each.
    unsure_factor = lost / recovery.shown * math.sqrt(2.0 / raw.trigger_cycles)
    known = np.minimum(white, left) > math.exp(-0.5 * _UNCERTAIN**2)
    return (np.where(known, amplitudes, np.nan),
            np.hypot(np.hypot(withheld, unsure_factor), beside),
            np.where(known, np.fmax(np.abs(whole), np.abs(amplitudes)), np.nan))


def _refitted(raw: Average, cycles: list[CycleSamples], settings: AverageSettings,
              grids: LatestGrid, orders: Sequence[float]) -> tuple[PulseErrorRecovery, int]:
    """
    Recover the pulse errors, where needed again without the pulses that no jitter explains.

    The second result is the number of these.
    """
    recovery, grid = _recovered(raw, cycles, settings, grids, orders)
    moved = np.zeros(raw.pulses.size)
    for _ in range(_ROUNDS):
        late = displacements(grid, recovery, raw, cycle_length=settings.cycle_length,
                             declared=_declared(cycles, settings))
        if not late.any():
            break
        if np.abs(late).max() > _REACH * raw.periods.min():  # which is refused
            return replace(recovery, expected=recovery.expected + late), 0
        moved += late
        if np.any(np.diff(raw.pulses - moved) <= 0.0):
            return recovery, 0
        again = replace(raw, pulses=raw.pulses - moved)
        recovery, grid = _recovered(
            again, _between(raw, cycles, again.pulses), settings, grids, orders)
    if not moved.any():
        return recovery, 0
    shift = moved - moved.mean()
    return replace(recovery, errors=recovery.errors + shift, expected=recovery.expected + shift
                   ), int(np.count_nonzero(moved))


def _declared(cycles: Sequence[CycleSamples], settings: AverageSettings) -> float:
    """Return the standard deviation (s) of the declared jitter."""
    return 1.0 / (math.sqrt(12.0) * (settings.keyphasor_rate or cycles[0].rate))


def _recovered(raw: Average, cycles: list[CycleSamples], settings: AverageSettings,
               grids: LatestGrid, orders: Sequence[float]
               ) -> tuple[PulseErrorRecovery, FloatArray]:
    """Recover the errors of the pulses of `raw` from its trigger `cycles`; return both."""
    # The recovery is a model of the linear law, whatever law the settings have.
    grid, seen, informative = grids.of(cycles, settings.interpolation, raw.cycle_numbers)
    found = recover_pulse_errors(
        seen, periods=raw.periods, cycle_length=settings.cycle_length,
        first_angle=raw.first_angle, orders=orders, additional_orders=settings.orders,
        declared_standard_deviation=_declared(cycles, settings))
    return _of_all_channels(found, informative), grid


def _of_all_channels(recovery: PulseErrorRecovery, informative: NDArray[np.bool_]
                     ) -> PulseErrorRecovery:
    """Return what was recovered from `informative` channels (channel,) as one of all."""
    if informative.all():
        return recovery
    shape = informative.size, recovery.orders.size
    amplitudes = np.zeros(shape, np.complex128)
    amplitudes[informative] = recovery.amplitudes
    noise, aligned, error = np.full((3, *shape), np.nan)
    noise[informative], aligned[informative], error[informative] = (
        recovery.noise, recovery.aligned, recovery.aligned_error)
    return replace(recovery, amplitudes=amplitudes, noise=noise, aligned=aligned,
                   aligned_error=error)


def _mean_phasor(orders: FloatArray, begin: FloatArray, end: FloatArray) -> FloatArray:
    """Return the length (order,) of the mean phasor of cycles with these errors (cycles)."""
    path = begin[:, None] * (1.0 - _U) + end[:, None] * _U
    phasors = np.exp(2j * np.pi * orders[:, None, None] * path) @ _U_WEIGHT
    return np.asarray(np.abs(phasors.mean(axis=1)))


def _uncorrected(raw: Average, reason: str) -> Correction:
    """Return the raw average as a correction that is not accepted."""
    unknown = np.full(raw.amplitudes.shape, np.nan)
    return Correction(
        raw.waveform, raw.amplitudes, raw.noise, np.zeros(len(raw.pulses)),
        np.full(len(raw.pulses), np.nan), False, reason, unknown, unknown, raw.cycle_amplitudes,
        AmplitudeErrors(unknown, unknown, unknown), raw.parts)


def _between(raw: Average, cycles: Sequence[CycleSamples], pulses: FloatArray
             ) -> list[CycleSamples]:
    """Return the trigger cycles of `raw` between other pulses (pulse,)."""
    begins, run, found = np.flatnonzero(raw.used), 0, []
    for index, cycle in enumerate(cycles):
        if index and begins[index] != begins[index - 1] + 1:
            run = begins[index]
        stop = run + int(np.argmin(raw.used[run:])) + 1
        found.append(replace(cycle, pulses=pulses[run:stop], first=int(begins[index] - run)))
    return found


def _average_again(raw: Average, cycles: Sequence[CycleSamples],
                   settings: AverageSettings, pulses: FloatArray) -> Average:
    """Return the average of the same cycles between corrected pulses."""
    again = replace(settings, samples_per_revolution=raw.waveform.shape[1],
                    trigger_cycles=raw.trigger_cycles, maximum_discarded=1.0)
    first = round(raw.first_angle / settings.cycle_length)
    shaft, average = ShaftAverager(again, first_cycle=first), None
    parts, numbers, index = _between(raw, cycles, pulses), raw.cycle_numbers, 0
    while index < len(parts):
        if index and parts[index].first == 0:
            shaft.skip(int(numbers[index] - numbers[index - 1]) - 1)
        end = index + 1  # of the cycles that were cut out together: they are resampled together
        while end < len(parts) and parts[end].samples is parts[index].samples and (
                parts[end].first > 0):
            end += 1
        average = shaft.update(replace(parts[index], count=end - index))
        index = end
    assert average is not None
    return replace(average, sequence=raw.sequence)
