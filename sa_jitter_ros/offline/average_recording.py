# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""One recording: its averages in files, by a function of a job that any process can do."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
import math
from pathlib import Path
from typing import Any

import numpy as np
from sa_jitter_ros.averaging.average import Average
from sa_jitter_ros.averaging.averager_parameters import gear_settings, streaming_averager
from sa_jitter_ros.averaging.results import AverageMessage, ShaftResults
from sa_jitter_ros.averaging.uneven_revolution import lost_inside_revolutions
from sa_jitter_ros.errors import RecordingError, SignalError
from sa_jitter_ros.keyphasor_check.plausibility import doubts, weak_orders
from sa_jitter_ros.monitoring.limits import LimitWatch
from sa_jitter_ros.monitoring.quantities import monitored
from sa_jitter_ros.offline.files import (
    ARRAYS, join_tables, read_about, RecordingJob, RecordingRow, row_values, Signals, TABLE,
    write_averages, write_rows)
from sa_jitter_ros.offline.series import ShaftCollector, ShaftSeries
from sa_jitter_ros.offline.settings import averager_values, MachineFile
from sa_jitter_ros.parameters import Values
from sa_jitter_ros.pulses.detection import detector_of, spikes_text
from sa_jitter_ros.pulses.detector_parameters import DETECTOR_PARAMETERS
from sa_jitter_ros.pulses.unit_check import likely_mistake
from sa_jitter_ros.recordings import read, Recording
from sa_jitter_ros.recordings.channel_check import (
    channel_faults, fault_texts, is_lost, without_channels)
from sa_jitter_ros.recordings.fields import FIELDS
from sa_jitter_ros.samples import SampleBlock
from sa_jitter_ros.tacholess.found import CorrectedAmplitudes, FoundPulses
from sa_jitter_ros.whole_files import finished_together

Progress = Callable[[float], None]
Notes = Mapping[float, str]

FOUND, RECORDINGS = 'found_pulses.npz', 'recordings.csv'
_VERSION = 5  # of the files: those of another one are written again
_BLOCK = 1 << 19  # values in a block, of all channels
_MOST_REMARKS = 10
_TOTALS = ('cycles_dropped', 'pulses_dropped', 'samples_dropped', 'gaps')  # of diagnostics


@dataclass(frozen=True, kw_only=True)
class AverageJob(RecordingJob):
    """
    One recording to average.

    The channel `state`, a name or a number, may be constant.
    """

    machine: MachineFile
    figures: bool = True
    state: str = ''


@dataclass(frozen=True)
class Row(RecordingRow):
    """
    What became of one recording.

    `error` is empty if all of it was averaged. With averages and an error it ended early, and the
    averages up to there are in its files. Counts are those of the averager's diagnostics;
    `trigger_speed` (Hz) is the mean of the averages.
    """

    averages: int = 0
    trigger_speed: float = math.nan
    trigger_cycles: int = 0
    cycles_dropped: int = 0
    pulses_dropped: int = 0
    samples_dropped: int = 0
    gaps: int = 0
    corrections_refused: int = 0
    remarks: tuple[str, ...] = ()


class RecordingAverager:
    """Averages a recording; the counts and remarks are complete when `results` is exhausted."""

    def __init__(self, recording: Recording, values: Values, detector: Mapping[str, Any],
                 limits: LimitWatch, found: FoundPulses | None) -> None:
        self._recording, self._values, self._found = recording, values, found
        #: The averager, for its counts, and the times (s) of all pulses of the keyphasor.
        self.stream = streaming_averager(values, buffer_seconds=math.inf)
        self._results = {name: ShaftResults(gear_settings(values, name))
                         for name in values['shafts']}
        waveform = detector_of({
            **{item.name: item.default for item in DETECTOR_PARAMETERS}, **detector})
        self.pulses = recording.keyphasor_pulses(detector=waveform)
        self._spikes = spikes_text(waveform.state.spikes)
        self.limits = limits
        #: What was said of limits that the averages passed.
        self.passed: list[str] = []
        self.refused = 0
        self.ended_early = ''

    def results(self, progress: Progress | None = None
                ) -> Iterator[tuple[str, dict[str, Any], Notes]]:
        """
        Iterate over the results of all averages, as (shaft, arrays by topic, refused orders).

        A recording that breaks off in the middle ends there: `ended_early` says why.
        """
        recording, stream = self._recording, self.stream
        rate, start, index = recording.sample_rate, recording.start_time, 0
        yield from self._arrays(stream.add_pulses(self.pulses))
        # Vibration that no pulse follows would only wait.
        end = self.pulses[-1] + max(np.diff(self.pulses[-3:]), default=0.0) + 1.0 \
            if self.pulses.size else start
        blocks = recording.blocks(max(_BLOCK // recording.channels, 1))
        while True:
            try:
                samples = next(blocks, None)
            except RecordingError as error:
                self.ended_early = str(error)
                break
            if samples is None or start + index / rate > end:
                break
            yield from self._arrays(stream.add_samples(
                SampleBlock(samples, start + index / rate, rate, index)))
            index += samples.shape[1]
            if progress is not None:
                progress(index / recording.samples)
        yield from self._arrays(stream.finish())

    def none(self) -> SignalError:
        """Return the error for a recording without an average."""
        recording, pulses = self._recording, self.pulses
        start, end = recording.start_time, recording.start_time + recording.duration
        messages = self.stream.take_messages()
        return SignalError(
            f'{pulses.size} pulses and vibration from {start:g} s to {end:g} s make '
            f'{self.stream.counts.cycles} whole trigger cycles of the '
            f'{self._values["trigger_cycles"]} of an average: '
            + (self.ended_early or likely_mistake(pulses, start, end, recording.sample_rate)
               or '; '.join(messages[:2]) or 'lower trigger_cycles, or give more pulses'))

    def doubts(self, series: Sequence[ShaftSeries]) -> tuple[str, ...]:
        """Return what contradicts each other in recording, settings and averages of the shafts."""
        rate = self._values['keyphasor_rate']
        target = {name: self._values[name] for name in (
            'pulses_per_revolution', 'pulses_per_trigger', 'missing_teeth', 'target_geometry',
            'target_angles')}
        found = list(doubts(
            self._recording, self.pulses, **target,
            jitter_std=1.0 / math.sqrt(12.0) / rate
            if rate and self._recording.tach is None else None))
        if not (self.stream.validator.rejected or self.stream.validator.geometry):
            found += [lost_inside_revolutions(
                self.pulses, self.stream.shafts[item.shaft].settings,
                target['pulses_per_revolution'], target['missing_teeth']) for item in series]
        found += [item.bearing_problem for item in self._results.values()]
        weak = []  # a shaft of which the vibration shows nothing is no mistake beside others
        for item in series:
            settings = self.stream.shafts[item.shaft].settings
            weak.append(weak_orders(
                self._recording, self.pulses, item.orders.tolist(),
                ratio=settings.cycle_length / settings.revolutions_per_trigger, **target))
        return (*filter(None, [self._spikes, *found]), *(weak[0] if all(weak) else ()))

    def _arrays(self, averages: list[tuple[str, Average]]
                ) -> Iterator[tuple[str, dict[str, Any], Notes]]:
        for name, average in averages:
            self.refused += average.correction is not None and not average.correction.accepted
            results = self._results[name].of(average)
            if self._found is not None:
                settings = self.stream.shafts[name].settings
                results['order_amplitude'] = _with_found(
                    results['order_amplitude'], self._found.correct(average, ratio=(
                        settings.cycle_length / settings.revolutions_per_trigger)))
            if self.limits.names:
                self.passed += self.limits.update(name, monitored(results))
            yield name, results, average.refused


def _with_found(message: AverageMessage, corrected: CorrectedAmplitudes) -> AverageMessage:
    """Return order amplitudes with what the errors of found pulses did to them undone."""
    size, expected = np.abs(corrected.amplitudes), corrected.expected
    columns = {
        'corrected_amplitude': size, 'corrected_phase': np.angle(corrected.amplitudes),
        'attenuation': np.broadcast_to(expected.factor, size.shape),
        'attenuation_standard_error': np.broadcast_to(
            expected.standard_deviation, size.shape),
        'corrected_standard_error': corrected.standard_errors,
        'corrected_phase_standard_error': corrected.standard_errors / size}
    values = message.values.copy()
    for name, column in columns.items():
        values[..., message.names.index(name)] = column
    return replace(message, values=values)


def average_file(job: AverageJob, progress: Progress | None = None) -> Row:
    """
    Average one recording into its folder, unless that was done before with the same settings.

    Raises SaJitterError for a recording that cannot be used, OSError where the folder cannot be
    written.
    """
    machine = job.machine
    settings = job.settings(
        version=_VERSION, figures=job.figures, state=job.state, averager=machine.averager,
        detector=machine.detector, machine=machine.parts, hardware_id=machine.hardware_id)
    done = read_about(Path(job.folder))
    if done.get('settings') == settings:
        return Row(**row_values(done['row']))
    return _averaged(job, settings, progress)


def _averaged(job: AverageJob, settings: Mapping[str, Any], progress: Progress | None) -> Row:
    recording = read(job.path, **job.options)
    faults = {channel: reason for channel, reason in channel_faults(recording).items()
              if not job.state or job.state not in (
                  str(channel), recording.channel_names[channel])}
    lost = {channel for channel, reason in faults.items() if is_lost(reason)}
    kept = [k for k in range(recording.channels) if k not in lost] or range(recording.channels)
    several = '' if recording.acquisitions == 1 else (
        f'the file holds {recording.acquisitions} acquisitions, of which one is averaged: '
        '--acquisition chooses another')
    remarks = [*filter(None, [several]), *recording.remarks, *fault_texts(recording, faults)]
    recording = without_channels(recording, lost)
    found = None
    if job.tacholess is not None:
        recording, found = job.tacholess.pulses_of(recording, job.machine.machine)
        remarks.append(recording.remarks[-1])
    values = averager_values(job.machine, recording, fields=[
        name for name in job.options if name in FIELDS])
    if found is not None:  # errors that are alike, which the averager would take for single ones
        values = {**values, 'correct_jitter': False}
    labels = [(str(number), name) for number, name in zip(kept, recording.channel_names)]
    limits = LimitWatch(job.machine.machine, values['shafts'], labels=lambda count: labels)
    signals = Signals(job.name, tuple(kept), recording.channel_names, recording.units,
                      job.machine.machine, limits)
    averager = RecordingAverager(recording, values, job.machine.detector, limits, found)
    with finished_together(Path(job.folder), last=ARRAYS) as folder:
        series = collect(averager, folder.parent, progress)
        if not series:
            raise averager.none()
        remarks += [*averager.passed[:_MOST_REMARKS // 2], *limits.warnings(),
                    *averager.doubts(series), *averager.stream.take_messages()[:_MOST_REMARKS]]
        row = Row(
            job.name, job.path, averager.ended_early, sum(map(len, series)),
            float(np.mean(series[0]['trigger_speed'])), averager.stream.counts.cycles,
            **{name: averager.stream.totals[name] for name in _TOTALS},
            corrections_refused=averager.refused,
            remarks=tuple(dict.fromkeys(remarks))[:_MOST_REMARKS])
        write_averages(folder, signals, series, {
            'settings': settings, 'row': asdict(row), 'said': averager.passed,
            'limits': [*map(str, limits.passed())]})
        if found is not None:
            found.save(folder / FOUND)
        if job.figures:
            from sa_jitter_ros.offline.figures import write_figures
            write_figures(folder, signals, series, {
                name: gear_settings(values, name) for name in values['shafts']})
            from sa_jitter_ros.offline.repairs_figure import write_repairs
            write_repairs(folder, job.name, recording, averager.pulses,
                          averager.stream.validator.rejected)
            from sa_jitter_ros.offline.machine_page import write_page
            write_page(folder)
    return row


def collect(averager: RecordingAverager, folder: Path, progress: Progress | None = None
            ) -> list[ShaftSeries]:
    """Return the averages of all shafts that have any; large arrays are in files in `folder`."""
    collectors: dict[str, ShaftCollector] = {}
    for shaft, results, refused in averager.results(progress):
        if shaft not in collectors:
            collectors[shaft] = ShaftCollector(shaft, folder)
        collectors[shaft].add(results, refused)
    return [collector.series() for collector in collectors.values()]


def write_tables(output: Path, rows: Sequence[Row]) -> None:
    """
    Write `averages.csv` and `recordings.csv` beside the folders of the recordings.

    A recording that ended early, or could not be averaged, has a row with the reason in both.
    Raises OSError.
    """
    ordered = write_rows(output / RECORDINGS, rows)
    join_tables(output / TABLE, [output / row.recording for row in ordered if row.averages],
                [(row.recording, row.error) for row in ordered if row.error])
