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
Observation: the attenuation of each line in each acquisition of a recording.

An acquisition is N_t consecutive trigger cycles. Its raw amplitudes are those between the measured
pulses with the declared angle law. Its corrected amplitudes are those between the pulses of a
reference keyphasor with the same law, or, without one, between pulses whose errors were recovered
from the vibration. The attenuation is the raw over the corrected amplitude. Effects of noise,
modulation and interpolation on both cancel in it.

The pulses are those that the pulse validation of the averager accepts, and each average is that of
the on-line averager (`averaging/shaft.py`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
import math

import numpy as np
from sa_jitter_ros.arrays import Array, BoolArray, ComplexArray, FloatArray, IntArray
from sa_jitter_ros.averaging.cycle import cycle_grid
from sa_jitter_ros.averaging.noise import (
    attenuation, noise_floor, radial_noise, without_leakage)
from sa_jitter_ros.errors import ModelError, RecordingError
from sa_jitter_ros.inference.clock_steps import broken_at_steps, clock_steps, ClockStep
from sa_jitter_ros.inference.cycle_reader import CycleReader, MARGIN, METHOD
from sa_jitter_ros.inference.record_pulses import numbered, record_pulses, RecordPulses
from sa_jitter_ros.inference.record_recovery import (
    leaking_orders, RecordRecovery, recover_record, RESOLVED)
from sa_jitter_ros.number_text import order_words
from sa_jitter_ros.prediction.influence import common_turn, mean_period
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.pulses.angle_law import angle_law, LINEAR_LAW
from sa_jitter_ros.pulses.resampling import FULL_BAND
from sa_jitter_ros.recordings.channel_check import stuck
from sa_jitter_ros.recordings.limits import MAX_VALUES
from sa_jitter_ros.recordings.recording import Recording

NameOf = Callable[[float], str]  # of an order

#: Coherence of a line from cycle to cycle, in units of that of noise, from which on it is used.
CHANCE = 4
#: Of the strongest channel's amplitude of an order, from which on a line is worth comparing.
STRONG = 0.2
_OTHER_MACHINE = 5.0
_PARTS = 16  # of a trigger cycle, in which the beat of an interpolator is looked for
_HARMLESS = 3e-4  # of an amplitude, a tenth of what residuals are to be accurate to
_LOSS = 0.03  # of amplitude by a reference keyphasor, and noise over amplitude of lines for it


def nameless(order: float) -> str:
    """Return no name of an order."""
    return ''


@dataclass(frozen=True)
class Acquisition:
    """
    One acquisition: N_t consecutive trigger cycles from trigger pulse `first` of the recording on.

    `times`, `errors` and `standard_errors` (N_t + 1,) in s are those of its measured pulses;
    errors are measured minus true times with mean 0, NaN where nothing was recovered. `missing`
    (N_t,) is the number of missing pulses in each cycle; `bridged` are the times with these
    interpolated. `raw` and `corrected` (channel, order) are complex peak amplitudes, `cycles`
    (cycle, channel, order) the corrected ones of single cycles. `noise` (channel, order) is the
    standard deviation of an amplitude along its radius, `noise_floor` the part of it that the
    spectrum around the order shows. `parts` (part, channel, order) are the amplitudes of declared
    orders in equal parts of the cycles, less the other ones. `ripple` (cycle,) is the factor of
    u (1 - u) in the error inside a cycle (s). Unless the errors are `recovered`, because their
    standard errors are as large as they are, the corrected amplitudes are the raw ones, and
    `reason` says why.
    """

    first: int
    times: FloatArray
    missing: IntArray
    bridged: FloatArray
    errors: FloatArray
    standard_errors: FloatArray
    raw: ComplexArray
    cycles: ComplexArray
    noise: FloatArray
    noise_floor: FloatArray
    parts: FloatArray
    ripple: FloatArray
    recovered: bool
    reason: str

    @property
    def number(self) -> IntArray:
        """Return the indices of the measured pulses in `bridged`."""
        return numbered(self.missing)

    @property
    def true_times(self) -> FloatArray:
        """Return the times of the measured pulses less their recovered errors, in s."""
        return self.times - np.nan_to_num(self.errors)

    def middles(self, count: int) -> FloatArray:
        """Return the middles of so many equal parts of its cycles, in s."""
        places = (np.arange(count) + 0.5) * len(self.cycles) / max(count, 1)
        return np.asarray(np.interp(places, self.number, self.true_times))

    @property
    def period(self) -> float:
        """Return the mean trigger period in s."""
        return mean_period(self.times, self.missing)

    @cached_property
    def corrected(self) -> ComplexArray:
        """Return the corrected complex peak amplitudes (channel, order) of whole cycles."""
        some = self.missing.any() and not self.missing.all()
        whole = np.repeat(self.missing == 0, 1 + self.missing) if some else ...
        return np.asarray(self.cycles[whole].mean(axis=0))

    @property
    def attenuation(self) -> FloatArray:
        """Return raw over corrected amplitude (channel, order)."""
        return np.asarray(np.abs(self.raw) / np.abs(self.corrected))

    @property
    def attenuation_standard_error(self) -> FloatArray:
        """Return the standard error of the attenuation (channel, order)."""
        ratio = self.attenuation
        return attenuation(self.raw, self.corrected, self.noise, np.minimum(ratio, 1.0 / ratio))[1]


@dataclass(frozen=True)
class Observation:
    """
    All acquisitions of one recording.

    `orders` are the declared ones, `sources` these and the undeclared orders that leak into them.
    The amplitudes of an acquisition are those of `sources`. The trigger_speed of `model` is the
    measured mean; `declared_speed` (Hz) is the declared one. `recoveries` are those of the
    recordings, none on line; `clock_steps` are where their clock steps; `name_of` returns the name
    of what makes an order, '' of an unknown one.
    """

    model: DeclaredModel
    acquisitions: tuple[Acquisition, ...]
    orders: FloatArray
    sources: FloatArray
    channel_names: tuple[str, ...]
    pulses: RecordPulses
    sample_rate: float
    against_reference: bool
    declared_speed: float
    name: str = ''
    recoveries: tuple[RecordRecovery, ...] = ()
    clock_steps: tuple[ClockStep, ...] = ()
    name_of: NameOf = nameless

    def words(self, order: float) -> str:
        """Return an order in a sentence."""
        return order_words(order, self.name_of(order))

    @property
    def shown(self) -> list[Acquisition]:
        """Return the acquisitions whose pulse errors the vibration shows."""
        return [item for item in self.acquisitions if np.all(np.isfinite(item.errors))]

    @property
    def compared(self) -> tuple[int, ...]:
        """Return the acquisitions whose attenuation is known."""
        return tuple(a for a, item in enumerate(self.acquisitions)
                     if self.against_reference or item.recovered)

    @property
    def periods(self) -> FloatArray:
        """Return the mean trigger period (acquisition,) in s."""
        return np.array([item.period for item in self.acquisitions])

    @property
    def recording(self) -> IntArray:
        """Return the number (acquisition,) of the recording of each acquisition."""
        first = np.array([item.first for item in self.acquisitions])
        return np.cumsum(np.diff(first, prepend=first[:1] - 1) <= 0)

    @property
    def first_numbers(self) -> IntArray:
        """Return the number, in its recording, of each acquisition's first trigger pulse."""
        return np.array([self.recoveries[recording].pulses.number[item.first] for item, recording
                         in zip(self.acquisitions, self.recording.tolist())])

    def stacked(self, field: str) -> Array:
        """Return one field of all acquisitions as an array."""
        return np.array([getattr(item, field) for item in self.acquisitions])


def observe(recording: Recording, model: DeclaredModel, *, sources: Sequence[float] = (),
            name_of: NameOf = nameless) -> Observation:
    """
    Observe the acquisitions of a recording.

    `sources` are the declared orders, then others that leak into them; without it these are
    searched for. `name_of` is that of the observation. A reference keyphasor is not used if it is
    worse than the keyphasor, or if the vibration wanders against it, or the speed ripples between
    its pulses, so much that the average with it loses amplitude. Raises RecordingError if there is
    no whole acquisition, ModelError if the declared model does not fit the recording.
    """
    if recording.samples * recording.channels > MAX_VALUES:
        raise RecordingError(f'{recording.samples} samples of {recording.channels} channels: at '
                             f'most {MAX_VALUES} values are read; cut the recording')
    if model.trigger_cycles <= CHANCE:
        raise ModelError(f'trigger_cycles is {model.trigger_cycles}: the coherence of a line from '
                         f'cycle to cycle needs at least {CHANCE + 1}; raise trigger_cycles')
    if model.sample_rate and abs(recording.sample_rate / model.sample_rate - 1.0) > 1e-3:
        raise ModelError(f'sample_rate is declared as {model.sample_rate:g} Hz but the recording '
                         f'has {recording.sample_rate:g} Hz: declare {recording.sample_rate:g}')
    once = tuple(dict.fromkeys(float(g) for g in model.orders))  # each order once
    pulses, declared_speed = record_pulses(recording, model), model.trigger_speed
    speed = model.revolutions_per_trigger / mean_period(pulses.times, pulses.missing)
    model = replace(model, sample_rate=recording.sample_rate, orders=once, trigger_speed=speed)
    samples, gaps = _read(recording)
    pulses = pulses.broken_at(gaps, recording.start_time, recording.sample_rate, MARGIN)
    reader = CycleReader(samples, recording.start_time, recording.sample_rate)
    starts = _starts(pulses, reader, model)
    if not starts:
        raise RecordingError(
            f'{pulses.times.size} trigger pulses do not make an acquisition of '
            f'{model.trigger_cycles} consecutive trigger cycles inside the vibration: lower '
            'trigger_cycles or record longer'
            + ''.join(f' ({remark})' for remark in pulses.remarks))
    recovery = recover_record(samples, recording.start_time, recording.sample_rate, pulses, model)
    steps = clock_steps(reader, pulses, recovery.stretches, model)
    if steps:
        pulses = broken_at_steps(pulses, steps)
        recovery = recover_record(samples, recording.start_time, recording.sample_rate, pulses,
                                  model)
        starts = _starts(pulses, reader, model)
        if not starts:
            raise RecordingError(
                f'the clock steps {len(steps)} times, first at {steps[0].time:.6g} s by '
                f'{steps[0].step:.3g} s: no acquisition of {model.trigger_cycles} trigger cycles '
                'is left between; lower trigger_cycles, or record without losing samples')
    orders = np.array(sources if len(sources) else [*once, *leaking_orders(recovery, model)])
    bare = replace(pulses, reference=None)
    found, referenced = [], []
    for first in starts:
        found.append(_acquire(reader, bare, recovery, model, first, orders))
        if pulses.reference is not None:
            referenced.append(_acquire(reader, pulses, recovery, model, first, orders))
    if referenced:
        reason = _fails_as_reference(referenced, found, len(once))
        pulses = replace(bare, remarks=(
            *bare.remarks, f'reference_pulse_times are not used: {reason}')) if reason else pulses
        found = found if reason else referenced
    return Observation(
        model, tuple(found), np.array(once), orders, recording.channel_names, pulses,
        recording.sample_rate, pulses.reference is not None, declared_speed,
        recording.description, (recovery,), steps, name_of)


def together(observations: Sequence[Observation]) -> Observation:
    """
    Return the acquisitions of several recordings of one machine as one observation.

    Raises ModelError for recordings of different machines: channels, rate or amplitudes differ.
    """
    first = observations[0]
    if len(observations) == 1:
        return first
    level = np.abs(first.stacked('corrected')).mean(axis=0)
    for other in observations[1:]:
        same = (other.sample_rate == first.sample_rate
                and other.against_reference == first.against_reference
                and len(other.channel_names) == len(first.channel_names))
        if not same:
            raise ModelError(f'recordings {first.name!r} and {other.name!r} differ in sample '
                             'rate, channels or reference keyphasor: run the loop on each alone')
        ratio = np.abs(other.stacked('corrected')).mean(axis=0) / level
        strong = level > STRONG * level.max()
        if not np.all((ratio[strong] > 1.0 / _OTHER_MACHINE) & (ratio[strong] < _OTHER_MACHINE)):
            raise ModelError(f'recordings {first.name!r} and {other.name!r} have amplitudes that '
                             f'differ by more than a factor of {_OTHER_MACHINE:g}: these are '
                             'different machines or loads; run the loop on each alone')
    pulses = RecordPulses(
        **{name: np.concatenate([getattr(item.pulses, name) for item in observations])
           for name in ('times', 'missing', 'doubtful', 'bridged')},
        displaced=np.concatenate([np.broadcast_to(
            item.pulses.displaced, item.pulses.missing.shape) for item in observations]),
        ahead=0,
        # no interval ends where a recording begins
        starts_run=np.concatenate([first.pulses.starts_run, *(
            item.pulses.starts_run[1:] for item in observations[1:])]),
        remarks=tuple(f'{item.name or "a recording"}: {remark}' for item in observations
                      for remark in item.pulses.remarks))
    speed = np.average([item.model.trigger_speed for item in observations],
                       weights=[len(item.acquisitions) for item in observations])
    return replace(first, model=replace(first.model, trigger_speed=float(speed)), pulses=pulses,
                   acquisitions=tuple(acquisition for item in observations
                                      for acquisition in item.acquisitions),
                   recoveries=tuple(recovery for item in observations
                                    for recovery in item.recoveries),
                   clock_steps=tuple(step for item in observations for step in item.clock_steps))


def recovered_again(recording: Recording, observation: Observation, channels: Sequence[int]
                    ) -> FloatArray:
    """Return the pulse errors (acquisition, N_t + 1) that some channels show."""
    samples, _ = _read(recording)
    recovery = recover_record(
        samples[:, list(channels)], recording.start_time, recording.sample_rate,
        observation.pulses, observation.model, known=observation.recoveries[0].undeclared)
    errors = np.array([recovery.errors[item.first:item.first + item.times.size]
                       for item in observation.acquisitions])
    return np.asarray(errors - errors.mean(axis=1, keepdims=True))


def _read(recording: Recording) -> tuple[FloatArray, BoolArray]:
    """Return the samples (sample, channel), their mean 0, and which are none: 0, too."""
    read = recording.read()
    gaps = np.asarray(~np.isfinite(read).all(axis=0))
    for channel in read:
        gaps |= stuck(channel)
    samples = np.ascontiguousarray(read.T)
    samples -= samples[~gaps].mean(axis=0) if not gaps.all() else 0.0
    samples[gaps] = 0.0
    return samples, gaps


def _starts(pulses: RecordPulses, reader: CycleReader, model: DeclaredModel) -> list[int]:
    """Return the first pulse of every acquisition with valid pulses and gapless vibration."""
    times, number, cycles = pulses.times, pulses.number, model.trigger_cycles
    law = angle_law(model.angle_law)
    found, first = [], law.before
    while first + cycles + law.after < times.size:
        part = slice(first, first + cycles + 1)
        read = slice(first - law.before, first + cycles + 1 + law.after)
        whole = (reader.inside(times[part]) and not pulses.doubtful[read].any()
                 and not pulses.starts_run[read.start + 1:read.stop].any())
        if whole and pulses.reference is not None:
            better = pulses.reference[number[read.start]:number[read.stop - 1] + 1]
            whole = bool(np.all(np.isfinite(better))) and reader.inside(
                pulses.reference[[number[part.start], number[part.stop - 1]]])
        if whole:
            found.append(first)
            first += cycles
        else:
            first += 1
    return found


def _fails_as_reference(referenced: Sequence[Acquisition], bare: Sequence[Acquisition],
                        orders: int) -> str:
    """
    Return why amplitudes with the reference keyphasor are too small, '' where they are not.

    The acquisitions are those with the reference keyphasor and without it, of which so many
    declared `orders` are compared.
    """
    kept, gained = [], []
    for item, other in zip(referenced, bare):
        with np.errstate(divide='ignore', invalid='ignore'):
            best = other if other.recovered else item
            clear = (best.noise < _LOSS * np.abs(best.corrected))[:, :orders]
            gained.append(np.where(clear, item.attenuation[:, :orders], np.nan))
            if other.recovered:
                kept.append(np.where(clear, (np.abs(item.corrected) / np.abs(other.corrected)
                                             )[:, :orders], np.nan))
    gain = np.median(gained, axis=0)
    if np.any(gain > 1.0 + _LOSS):
        return ('they give less amplitude than pulse_times (raw over reference amplitude '
                f'{np.nanmax(gain):.3f}, at most {1.0 + _LOSS:g}); give better ones or none')
    if kept and np.any((left := np.median(kept, axis=0)) < 1.0 - _LOSS):
        return ('the vibration moves against them: they give '
                f'{np.nanmin(left):.3f} of the amplitude that corrected pulses give, at least '
                f'{1.0 - _LOSS:g} is asked')
    return ''


def _acquire(reader: CycleReader, pulses: RecordPulses, recovery: RecordRecovery,
             model: DeclaredModel, first: int, sources: FloatArray) -> Acquisition:
    """Return the acquisition that begins at trigger pulse `first`."""
    count = model.trigger_cycles
    times = pulses.times[first:first + count + 1]
    missing = pulses.missing[first:first + count]
    span = slice(pulses.number[first], pulses.number[first + count] + 1)
    bridged, measured = pulses.bridged[span], numbered(missing)
    late = recovery.bridged_errors[span]
    late = late - late[measured].mean() * common_turn(bridged - late, measured)
    errors, standard_errors = late[measured], recovery.bridged_standard_errors[span][measured]
    ripple = recovery.ripple[span.start:span.stop - 1]
    # asked of all cycles: of one acquisition, chance would choose which is compared
    resolved = recovery.ripple_resolved and bool(np.isfinite(ripple).all())
    reason = _unresolved(bridged - late, standard_errors, recovery, model, resolved)
    corrected_pulses: FloatArray = bridged if reason else bridged - late
    law = angle_law(model.angle_law)
    used = slice(first - law.before, first + count + 1 + law.after)
    corrected_law = LINEAR_LAW  # the recovery is a model of the linear law
    if pulses.reference is not None:
        corrected_law = law
        errors = times - pulses.reference[span][measured]
        better = pulses.reference[span.start - law.before:span.stop + law.after]
        corrected_pulses = better + errors.mean() * common_turn(better, law.before + measured)
    errors = errors - errors.mean()
    corrects_ripple = pulses.reference is None and resolved and not reason
    raw = reader.amplitudes(reader.cycles(pulses.times[used], law=law), model, sources, law)
    cycles = reader.cycles(corrected_pulses, law=corrected_law,
                           ripple=ripple if corrects_ripple else 0.0)
    clean_cycles = without_leakage(
        reader.amplitudes(cycles, model, sources, corrected_law), tuple(sources.tolist()),
        model.cycle_length, model.cycle_length * np.arange(cycles.count))
    grid = cycle_grid([cycles], method=METHOD, law=corrected_law,
                      period=float(np.diff(bridged).max()))
    declared = sources[:len(model.orders)]
    floor = noise_floor(grid, model.cycle_length, declared,
                        FULL_BAND * reader.rate / model.fundamental_frequency)
    return Acquisition(
        first, times, missing, bridged, errors, standard_errors, raw.mean(axis=0), clean_cycles,
        radial_noise(clean_cycles), floor, _in_parts(
            grid, clean_cycles[..., :len(declared)], model.cycle_length * declared),
        np.where(missing > 0, np.nan, ripple[measured[:-1]]), not reason, reason)


def _in_parts(grid: FloatArray, cycles: ComplexArray, turns: FloatArray) -> FloatArray:
    """Return the amplitudes in parts of the cycles of a grid, of one of the `turns` at a time."""
    points = grid.shape[1]
    count = min(_PARTS, points)
    begins = np.arange(count) * points // count
    waves = np.exp(2j * np.pi * np.arange(points)[:, None] / points * turns)
    own = cycles * np.exp(2j * np.pi * np.arange(len(cycles))[:, None, None] * turns)
    rest = grid - (own @ waves.T).real.transpose(0, 2, 1)
    left = [np.add.reduceat(rest * (2.0 * wave.conj())[:, None], begins, axis=1)
            for wave in waves.T]
    means = np.stack(left, axis=-1) / np.diff([*begins, points])[:, None, None]
    unit = np.exp(-1j * np.angle(own))[:, None]
    return np.asarray(((own[:, None] + means) * unit).real).reshape(-1, *cycles.shape[1:])


def _unresolved(corrected: FloatArray, standard_errors: FloatArray, recovery: RecordRecovery,
                model: DeclaredModel, bends: bool) -> str:
    """
    Return why the errors of an acquisition tell nothing of its amplitudes, '' if they do.

    The `bends` of the angle inside the cycles tell of them where the errors of pulses do not.
    Errors that are right enough not to cost any order amplitude tell how little the pulses do.
    """
    size = max(float(np.sqrt(model.distribution.variance)), recovery.size)
    typical = float(np.sqrt(np.mean(standard_errors**2)))
    if not (np.isfinite(typical) and recovery.held):
        return 'the vibration holds no declared order'
    loss = 0.5 * (math.tau * max(model.orders) * model.fundamental_frequency * typical) ** 2
    if typical >= RESOLVED * size and not bends and loss > _HARMLESS:
        return (f'the standard error of a recovered pulse, {typical:.3g} s, is not below '
                f'{RESOLVED:g} of the size of the pulse errors, {size:.3g} s')
    if np.any(np.diff(corrected) <= 0.0):
        return 'a recovered error is larger than a trigger cycle'
    return ''
