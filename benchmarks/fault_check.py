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
Check averages and their corrections against the true vibration of the cycles that they claim.

The check uses the messages alone. The times of an average give its source and teeth, its phases
the angle at which it begins. The rest must then agree: amplitudes, phases, waveform, counts, and
its place after the averages before it.

A corrected average must be exactly that between the pulses minus the errors that were published
with it. These must be the errors of the teeth within their standard errors, except for a common
delay, which no vibration shows. Then the corrected values are true within their standard errors.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

from fault_graph import Received
from fault_machine import (AROUND, equal_weights, exponential_weights, FloatArray, RATE, Run,
                           TEETH, Window)
import numpy as np
from sa_jitter_ros.averaging.cycle import waveform_cutoff
from sa_jitter_ros.nodes.messages import AverageMessage
from sa_jitter_ros.pulses.resampling import interpolate

AMPLITUDE = 5e-4  # of the largest value: error of an amplitude by band-limited interpolation
POINT = 4e-3  # the same of a point of the waveform
REACH = 60  # samples on either side from which a point of the waveform may come
BELIEVED = 0.04  # of the pitch: pulses displaced by more must not be used
LONGEST = 60  # trigger cycles of an exponential average that are computed
MOST_DROPPED = 3  # faults within an average that cost other teeth than their own
RUNS = 8  # latest runs among which the source of an average is looked for
LIMIT = 6.0  # standard errors: two of a thousand million normal variables are farther out
MEAN = 1e-12  # s that recovered errors may be off on average: rounding


class WrongAverageError(AssertionError):
    """An average that is not that of the cycles it claims."""


@dataclass(frozen=True)
class Place:
    """The run and teeth of an average; at one of the teeth `zeros` its angle was 0."""

    run: Run
    first: int
    last: int
    zeros: frozenset[int]
    values: Mapping[str, Any]


def edge_error(window: Window, points: int) -> float:
    """
    Return by how much a point of the waveform may be off because samples end there.

    Interpolation continues them by point reflection. Of fewer points than samples, more of those
    contribute.
    """
    run, pulses = window.run, window.pulses
    beside = REACH / RATE
    if (run.sent(pulses[0] - beside, pulses[0])
            and run.sent(pulses[-1], pulses[-1] + beside)):
        return 0.0
    cutoff = float(waveform_cutoff(points, window.cycles, np.diff(pulses).max(), RATE))
    samples, between = np.arange(4.0 * REACH), np.linspace(0.0, 1.0, 21)
    error = 0.0
    for order, amplitude, _ in run.components:
        turns = 2.0 * np.pi * order * run.speed / RATE
        wave, true = (np.column_stack((np.cos(turns * at), np.sin(turns * at)))
                      for at in (samples, between))
        off = interpolate(wave, between, cutoff=cutoff) - true
        error += 1.3 * amplitude * float(np.hypot(*off.T).max())
    return error


def waveform_agrees(window: Window, start: int, waveform: AverageMessage,
                    values: Mapping[str, Any], gain: FloatArray, allowed: float = 0.0) -> bool:
    """
    Tell whether a waveform is the mean of a window, `start` trigger cycles from 0.

    It may be wrong by what interpolation causes, and by `allowed` more.
    """
    r, count = window.cycles, window.trigger_cycles
    whole = window.waveforms(start, waveform.values.shape[1])
    cycles = len(whole)
    if values['averaging'] == 'exponential':
        cycles = min(cycles, max(int(count * r), 1))
        weights = exponential_weights(len(whole), max(count * r, 1.0))
    else:
        weights = equal_weights(len(whole))
    if waveform.header.fundamental_cycles != cycles:
        return False
    if not len(whole):
        return bool(np.isnan(waveform.values).all())
    error = np.abs(waveform.values / gain - weights @ whole).max()
    allowed += edge_error(window, waveform.values.shape[1])
    return bool(error < POINT * window.run.scale + allowed)


class ShaftChecker:
    """
    Checks the averages of one shaft of one averager, in the order in which they come.

    `settings` are the parameters that may be in force: while a change is on its way, the old ones
    and the new ones.
    """

    def __init__(self, name: str, runs: Sequence[Run], settings: Sequence[Mapping[str, Any]], *,
                 delivered: bool) -> None:
        self._name, self._runs, self._settings = name, runs, settings
        self._delivered = delivered  # teeth that were lost on the way are missing as well
        self.last: Place | None = None
        self._sequence = 0
        self.checked = 0

    def start_anew(self, sequence: int = 0) -> None:
        """Expect this sequence next: the node was started again, or an average was wrong."""
        self._sequence, self.last = sequence, None

    def check(self, amplitude: AverageMessage, waveform: AverageMessage) -> Place:
        """Return the run and teeth of the average; raises `WrongAverageError`."""
        header = amplitude.header
        if waveform.header != header:
            raise WrongAverageError(f'{self._name}: waveform and amplitudes differ in {header}')
        if header.sequence != self._sequence:
            raise WrongAverageError(f'{self._name}: sequence {header.sequence} behind '
                                    f'{self._sequence - 1}')
        place, reasons = None, []
        bridged = any(values['missing_pulses'] == 'bridge' for values in self._settings)
        for run in reversed(self._runs[-RUNS:]):
            first, last = (run.tooth_at(time, bridged=bridged)
                           for time in (header.start_time, header.end_time))
            if first is None or last is None:
                continue
            for values in reversed(self._settings):
                found = self._matches(run, first, last, amplitude, waveform, values)
                if isinstance(found, Place):
                    place = found
                    break
                reasons.append(f'run {run.number}: {found}')
            if place:
                break
        if place is None:
            raise WrongAverageError(f'{self._name}: {header} is of no source: '
                                    f'{"; ".join(reasons) or "no teeth at these times"}')
        self.last = place
        self._sequence += 1
        self.checked += 1
        return place

    def _matches(self, run: Run, first: int, last: int, amplitude: AverageMessage,
                 waveform: AverageMessage, values: Mapping[str, Any]) -> Place | str:
        """Return the place, or what does not agree."""
        header, table = amplitude.header, amplitude.values
        step = values['pulses_per_trigger'] or TEETH
        ratio, orders = values[f'{self._name}.ratio'], values[f'{self._name}.orders']
        count, r = values['trigger_cycles'], ratio * step / TEETH
        if header.trigger_cycles != count or not np.array_equal(table[0, :, 0], orders):
            return f'other trigger cycles or orders than {count}, {orders}'
        if last - first != count * step:
            return f'teeth {first} to {last} are not {count} trigger cycles'
        if len(table) != run.channels:
            return f'{len(table)} channels of {run.channels}'
        speed = count * step / TEETH / (header.end_time - header.start_time)
        if abs(header.mean_trigger_speed - speed) > 1e-9 * speed:
            return f'speed {header.mean_trigger_speed} instead of {speed}'
        exponential = values['averaging'] == 'exponential'
        longest = LONGEST if exponential else count
        found: Place | str = ''
        for dropped, used in self._possible(run, last - longest * step, last):
            pulses = self._pulses(run, first, last, step, values, longest, dropped, used)
            found = pulses if isinstance(pulses, str) else self._agrees(
                Window(run, pulses, r, count), amplitude, waveform, values, first)
            if isinstance(found, Place):
                break
        return found

    def _possible(self, run: Run, begin: int, end: int) -> Iterator[tuple[set[int], set[int]]]:
        """
        Iterate over what the validation may have made of faults: teeth dropped, late ones used.

        Teeth that came before a late one may wait for the next: either they are out of order, or
        it is.
        """
        options = [(set(range(tooth + 1, tooth + 1 + later)), {tooth})
                   for tooth, later in run.behind.items()
                   if self._delivered and begin - later <= tooth <= end]
        for count in range(min(len(options), MOST_DROPPED) + 1):
            for chosen in combinations(options, count):
                yield (set().union(*(dropped for dropped, _ in chosen)),
                       set().union(*(used for _, used in chosen)))

    def _pulses(self, run: Run, first: int, last: int, step: int, values: Mapping[str, Any],
                longest: int, dropped: set[int], used: set[int]) -> FloatArray | str:
        """Return the pulses (tau) of as many usable cycles as end at `last`, at least these."""
        pitch = 1.0 / (TEETH * run.speed)
        absent = run.missing | dropped
        if self._delivered:
            absent |= run.undelivered - used
        absent |= {tooth for tooth, late in run.displaced.items() if abs(late) > BELIEVED * pitch}
        gaps = absent if values['missing_pulses'] == 'break' else set()
        begin = max(last - longest * step, 0)
        bad = [tooth for tooth in range(begin, last + 1) if tooth in gaps]
        if bad and bad[-1] >= first:
            return f'tooth {bad[-1]} is missing or displaced'
        begin = max([begin, *(tooth + 1 for tooth in bad)])
        begin = last - (last - begin) // step * step
        present = np.array([tooth for tooth in range(max(begin - 10, 0), last + 10)
                            if tooth not in absent])
        pulses = np.interp(np.arange(begin, last + 1, step), present, run.times(present))
        for k in range(len(pulses) - 1, 0, -1):
            if not run.sent(pulses[k - 1], pulses[k]):
                if k > len(pulses) - 1 - (last - first) // step:
                    return f'vibration between {pulses[k - 1]} s and {pulses[k]} s was lost'
                return pulses[k:]
        return pulses

    def _agrees(self, window: Window, amplitude: AverageMessage, waveform: AverageMessage,
                values: Mapping[str, Any], first: int) -> Place | str:
        """Compare with the truth at every angle at which the average may begin."""
        header, table, run = amplitude.header, amplitude.values, window.run
        count, orders = header.trigger_cycles, table[0, :, 0]
        step = values['pulses_per_trigger'] or TEETH
        gain = np.arange(1, run.channels + 1)[:, None]
        measured = (table[..., 1] * np.exp(1j * table[..., 2])) / gain
        limit = AMPLITUDE * run.scale
        if np.ptp(measured.real, axis=0).max() > limit:
            return 'channels disagree'
        cycles = window.amplitudes(orders)
        # Where pulses are bridged, teeth around a fault may be doubtful, and interpolated, too.
        teeth = first + step * np.arange(count + 1 - len(window.pulses), count + 1)
        doubtful = [number for number, tooth in enumerate(teeth.tolist())
                    if values['missing_pulses'] == 'bridge'
                    and run.faults(tooth - AROUND, tooth + AROUND)]
        changes = window.uncertain(orders, doubtful)
        starts = np.arange(first // step + 1)  # trigger cycles since the angle was 0
        turn = np.exp(-2j * np.pi * window.cycles * np.outer(starts, orders))
        lengths = [count]
        if values['averaging'] == 'exponential':
            lengths = list(range(count, len(cycles) + 1))
        best, zeros = np.inf, set[int]()
        for length in lengths:
            weights = (exponential_weights(length, count) if values['averaging'] == 'exponential'
                       else equal_weights(length))
            allowed = sum(np.abs(weights @ change[-length:]) for change in changes)
            error = np.abs(measured[0] - weights @ cycles[-length:] * turn) - allowed
            error = error.max(axis=1)
            best = min(best, error.min())
            fits = [int(start) for start in starts[error < limit] if start >= length - count]
            # the waveform knows the angle but for whole turns
            turns = {start: round(start * window.cycles % 1.0, 9) % 1.0 for start in fits}
            agrees = {turn: waveform_agrees(
                window.latest(length), start - (length - count), waveform, values, gain,
                run.steepest * run.most * min(2.0 * len(doubtful) / length, 1.0))
                for turn, start in {turn: start for start, turn in turns.items()}.items()}
            # Of an order that is not there, other lengths and angles fit by chance: all are kept.
            zeros |= {first - start * step for start in fits if agrees[turns[start]]}
        if zeros:
            if doubtful:  # the angle of the others is known well enough to be compared
                zeros = {first - start * step for start in starts.tolist()}
            return self._follows(
                Place(run, first, first + count * step, frozenset(zeros), values), step)
        return f'amplitudes off by {best:.3g} (limit {limit:.3g}), or the waveform is'

    def _follows(self, place: Place, step: int) -> Place | str:
        """Compare with the average before: order, overlap, and an angle that runs on."""
        last = self.last
        if last is None or last.run is not place.run:
            if last is not None and last.run.number > place.run.number:
                return f'behind one of run {last.run.number}'
            return place
        block = place.values['averaging'] == 'block'
        if place.first < (last.last if block and last.values is place.values else last.first):
            return f'teeth from {place.first} on, behind teeth {last.first} to {last.last}'
        if last.values is place.values and place.first == (
                last.last if block else last.first + step):
            zeros = place.zeros & last.zeros
            if not zeros:
                return 'the angle does not run on'
            return Place(place.run, place.first, place.last, zeros, place.values)
        return place


def check_correction(name: str, received: Received, place: Place,
                     settings: Sequence[Mapping[str, Any]]) -> bool:
    """
    Return whether an average that was found at `place` is corrected; raises `WrongAverageError`.

    `settings` are the parameters that may be in force.
    """
    amplitude = received.amplitude
    if received.corrected is None or received.pulse_error is None:
        return False
    if not any(values.get('correct_jitter') for values in settings):
        raise WrongAverageError(f'{name}: corrected without correct_jitter')
    header, table = amplitude.header, amplitude.values
    if not header == received.corrected.header == received.pulse_error.header:
        raise WrongAverageError(f'{name}: corrected average or pulse errors are not of {header}')
    run, step = place.run, place.values['pulses_per_trigger'] or TEETH
    teeth = np.arange(place.first, place.last + 1, step)
    times, errors, standard_errors = received.pulse_error.values[:, :3].T
    bridged = place.values['missing_pulses'] == 'bridge'
    if [run.tooth_at(time, bridged=bridged) for time in times] != teeth.tolist():
        raise WrongAverageError(f'{name}: pulses at {times} s are not those of {header}')
    true = run.errors(teeth)
    true -= true.mean()
    told = np.isfinite(errors)  # without ambiguity
    apart = np.abs(errors - np.mean(errors[told]) - true + np.mean(true[told]))[told]
    # All channels are multiples of one signal: what disturbs one disturbs all, and the recovery
    # takes them for independent.
    apart /= standard_errors[told] * np.sqrt(run.channels)
    if (told.all() and abs(errors.mean()) > MEAN) or not apart.max(initial=0.0) < LIMIT:
        raise WrongAverageError(f'{name}: errors of the pulses are {1e6 * true} us and not '
                                f'{1e6 * errors}, {apart.max():.3g} standard errors apart')
    ratio = place.values[f'{name}.ratio'] * step / TEETH
    measured = run.times(teeth)
    raw, truth = (Window(run, pulses, ratio, header.trigger_cycles)
                  for pulses in (measured, measured - true))
    gain = np.arange(1, run.channels + 1)[:, None]
    orders, known = table[0, :, 0], np.isfinite(table[0, :, 3])
    limit = AMPLITUDE * run.scale
    expected = truth.amplitudes(orders).mean(axis=0)
    # What is uncertain of the errors turns the orders, and changes their amplitudes.
    turns = 2.0 * np.pi * orders * run.speed * np.sqrt(np.nanmean(standard_errors**2))
    allowed = LIMIT * np.abs(expected) * np.hypot(turns, np.nan_to_num(table[..., 6]))
    found = table[..., 3] * np.exp(1j * table[..., 4]) / gain
    for zero in place.zeros:
        start = (place.first - zero) // step
        turn = np.exp(-2j * np.pi * ratio * start * orders)
        off = np.abs(found - expected * turn) - allowed
        if off[:, known].max() < limit and waveform_agrees(
                truth, start, received.corrected, place.values, gain, float(allowed.sum(axis=1)
                                                                            .max())):
            break
    else:
        raise WrongAverageError(f'{name}: corrected values of {header} are not those between the '
                                'true pulses')
    amplitudes, jittered = (np.abs(item.amplitudes(orders).mean(axis=0)) for item in (truth, raw))
    attenuation = jittered / amplitudes
    allowed = LIMIT * table[..., 6] + limit * (1.0 + attenuation) / amplitudes
    wrong = np.abs(table[..., 5] - attenuation) - allowed
    if wrong[:, known].max() > 0.0:
        raise WrongAverageError(f'{name}: attenuation is {attenuation} and not {table[..., 5]} '
                                f'with standard errors {table[..., 6]}')
    return True
