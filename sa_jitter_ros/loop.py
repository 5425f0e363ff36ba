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
The loop off line: from recordings of a machine and its declared model to a report.

It compares the observed with the predicted attenuation of all acquisitions and finds the effects
that the declared model lacks if the residual is significant.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, MISSING, replace
from datetime import datetime, timezone
from functools import cached_property, partial
from itertools import combinations
import math
import os
from pathlib import Path
from typing import Any
import warnings

from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.declaration import Declaration, read_declaration
from sa_jitter_ros.effects import declared_effects
from sa_jitter_ros.errors import DataWarning, ModelError, RecordingError, SaJitterError
from sa_jitter_ros.inference.observation import Observation, observe
from sa_jitter_ros.inference.trace import trace
from sa_jitter_ros.inference.trace_result import Trace
from sa_jitter_ros.keyphasor_check.machine_file import on_target
from sa_jitter_ros.keyphasor_check.plausibility import doubts
from sa_jitter_ros.parameters import SAME_RATIO
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.pulses.unit_check import likely_mistake
from sa_jitter_ros.recordings import read, Recording
from sa_jitter_ros.recordings.channel_check import (
    channel_faults, is_copy, is_lost, without_channels)
from sa_jitter_ros.report.report import parameters_text, report, summary
from sa_jitter_ros.whole_files import finished_together

Source = str | os.PathLike[str] | Recording
Declared = str | os.PathLike[str] | DeclaredModel | Mapping[str, Any]

_VERDICTS = ('none', 'traced', 'unexplained')
_SHAFT = 'shaft'  # name of the only one


@dataclass(frozen=True)
class Loop:
    """
    Result of `close_loop`; `str` makes a summary of it.

    `traces` are the arrays behind the report, by the name of the shaft. `unit` is that of the
    vibration, '' where it is unknown or not that of all channels; `faults` are what is wrong with
    the recordings, or doubtful; `created` is the time (UTC).

    A machine whose pulses have no other error than that of a keyphasor sampled at 5 kHz, as
    declared:

    >>> import sa_jitter_ros as sa
    >>> from sa_jitter_ros.recordings.recording import ArraySource
    >>> from sa_jitter_ros.simulation import AdditiveNoise, DeclaredJitter, Gearbox, mesh
    >>> machine = Gearbox(mesh('shaft', 8, harmonics=(1.0, 0.8)), 5000.0, speed=((0.0, 25.0),),
    ...                   effects=(DeclaredJitter('uniform', 2e-4 / 12**0.5), AdditiveNoise(0.05)),
    ...                   seed=3)
    >>> recording = sa.Recording(ArraySource(machine.vibration(0, 20_000)), 5000.0,
    ...                          pulse_times=machine.pulses(0.0, 4.0).times)
    >>> loop = sa.close_loop(recording, {'keyphasor_rate': 5e3, 'trigger_speed': 25.0,
    ...                                  'trigger_cycles': 10, 'orders': [8, 16]})
    >>> loop
    Loop(none; 1 recording)
    >>> loop.verdict, loop.report['missing_effects']
    ('none', [])
    """

    traces: Mapping[str, Trace]
    recordings: tuple[str, ...]
    unit: str = ''
    faults: tuple[str, ...] = ()
    ratio_is_stated: bool = False
    created: str = field(default_factory=lambda: datetime.now(timezone.utc).isoformat(
        timespec='seconds'))

    @cached_property
    def shafts(self) -> Mapping[str, Mapping[str, Any]]:
        """Return the report of each shaft by its name; undefined numbers are None."""
        models = {shaft: trace.observation.model for shaft, trace in self.traces.items()}
        return {shaft: report(trace, recordings=self.recordings, shaft=shaft, models=models,
                              unit=self.unit, created=self.created, faults=self.faults,
                              ratio_is_stated=self.ratio_is_stated)
                for shaft, trace in self.traces.items()}

    @property
    def report(self) -> Mapping[str, Any]:
        """
        Return the content of `report.json`.

        With one shaft it is the report of that shaft; with several it has a common `verdict` and
        `shafts`, the report of each.
        """
        if len(self.shafts) == 1:
            return next(iter(self.shafts.values()))
        return {'verdict': self.verdict, 'shafts': self.shafts}

    @property
    def verdict(self) -> str:
        """Return the verdict; with several shafts the worst: `unexplained`, then `traced`."""
        return max((trace.verdict for trace in self.traces.values()), key=_VERDICTS.index)

    @property
    def found(self) -> tuple[str, ...]:
        """Return the missing effects with their parameters, a text for each."""
        return tuple((f'{shaft}: ' if len(self.shafts) > 1 else '')
                     + f'{effect["name"]} {parameters_text(effect, content["unit"])}'
                     for shaft, content in self.shafts.items()
                     for effect in content['missing_effects'])

    def __repr__(self) -> str:
        """Return one line: the verdict and the missing effects of each shaft."""
        found = []
        for shaft, item in self.traces.items():
            names = ', '.join(finding.name for finding in item.findings)
            found.append((f'{shaft}: ' if len(self.traces) > 1 else '') + item.verdict
                         + (f' ({names})' if names else ''))
        count = len(self.recordings)
        return f'Loop({"; ".join(found)}; {count} recording{"s" * (count > 1)})'

    def __str__(self) -> str:
        """Return a summary in a few lines."""
        if len(self.shafts) == 1:
            return summary(self.report)
        return '\n'.join(f'shaft {shaft}\n{summary(content)}'
                         for shaft, content in self.shafts.items())

    def write(self, folder: str | os.PathLike[str]) -> None:
        """
        Write `report.json`, `report.html` and the figures as PNG: all of them or none.

        With several shafts these files are in one folder per shaft; `report.json` and
        `report.html` beside these folders cover all shafts. Loads matplotlib. Raises OSError if
        the folder cannot be written.
        """
        from sa_jitter_ros.report.html_report import files_of_all, report_files

        files = {shaft: report_files(trace, self.shafts[shaft])
                 for shaft, trace in self.traces.items()}
        written = next(iter(files.values())) if len(files) == 1 else files_of_all(
            self.report, files)
        with finished_together(Path(folder)) as place:
            for name, content in written.items():
                (place / name).parent.mkdir(exist_ok=True)
                (place / name).write_bytes(content)


def close_loop(recordings: Source | Sequence[Source], declared: Declared, *,
               names: Sequence[str] = (), progress: Callable[[str], None] | None = None) -> Loop:
    """
    Find the effects that the declared jitter model of a machine lacks, from its recordings.

    `recordings` is one path or `Recording`, or several. `declared` is the path of a ROS parameter
    file of `jitter_predictor`, or of the machine, of which the averager's target is taken, too; a
    `DeclaredModel`, or a mapping of the keywords of `predict`, with `effects` as a mapping of
    names to parameters. A parameter file may declare several `shafts`; each gets a report. An
    undeclared `sample_rate` is that of the first recording. `names` are the names of the
    recordings in the report, else their paths or descriptions. `progress` is called with one line
    of text for every step.

    Raises RecordingError, ModelError or SignalError if the recordings cannot be read, do not
    match the declared model, or contain no order above the noise.

    >>> from sa_jitter_ros.recordings.recording import ArraySource, Recording
    >>> from sa_jitter_ros.simulation import AdditiveNoise, DeclaredJitter, Gearbox, mesh
    >>> rate, speed = 5000.0, 25.0  # Hz
    >>> machine = Gearbox(mesh('shaft', 8, harmonics=(1.0, 0.8, 0.6)), rate, speed=((0.0, speed),),
    ...                   effects=(DeclaredJitter('normal', 8e-5), AdditiveNoise(0.02)), seed=3)
    >>> recording = Recording(ArraySource(machine.vibration(0, 36_000)), rate,
    ...                       pulse_times=machine.pulses(0.0, 7.2).times)
    >>> found = close_loop(recording, {
    ...     'keyphasor_rate': 20e3, 'trigger_speed': speed, 'trigger_cycles': 20,
    ...     'orders': [8, 16, 24], 'noise_std': 0.02})
    >>> found.verdict, [effect['name'] for effect in found.report['missing_effects']]
    ('traced', ['excess_jitter'])
    """
    show = progress or (lambda text: None)
    if isinstance(recordings, (str, os.PathLike, Recording)):
        recordings = [recordings]
    if not isinstance(recordings, Sequence) or not all(
            isinstance(item, (str, os.PathLike, Recording)) for item in recordings):
        raise ModelError(f'recordings is {recordings!r}: give a path or a Recording, or a list '
                         'of them')
    if not recordings:
        raise ModelError('no recording: give at least one')
    names = tuple(names) or tuple(_name(*item) for item in enumerate(recordings, 1))
    opened = [item if isinstance(item, Recording) else read(item) for item in recordings]
    opened, faults = _usable(opened, names)
    opened = [_with_pulses(item) for item in opened]
    for (one, name), (other, again) in combinations(zip(opened, names), 2):
        if is_copy(one, other):
            raise RecordingError(f'{again} holds what {name} holds: give each recording once')
    if isinstance(declared, (str, os.PathLike)):
        opened = [on_target(item, Path(declared)) for item in opened]
    declaration = _declaration(declared, opened[0].sample_rate)
    models, stated = declaration.models, any(item.ratio != 1.0 for item in opened)
    if len(models) > 1:
        opened = [_for_several(item, models) for item in opened]
    traces = {}
    for shaft, model in models.items():
        if len(models) > 1:
            show(f'shaft {shaft}')
        observations: list[Observation] = []
        for name, recording in zip(names, opened):
            show(f'reading {name}')
            for doubt in doubts(recording, _times(recording), orders=model.orders,
                                ratio=model.ratio,
                                pulses_per_revolution=model.pulses_per_revolution,
                                pulses_per_trigger=model.pulses_per_trigger or None,
                                **recording.target):
                faults.append(f'{name}: {doubt}')
            try:
                observations.append(observe(
                    recording, model, name_of=partial(declaration.machine.name_of, shaft),
                    sources=observations[0].sources.tolist() if observations else ()))
            except SaJitterError as error:
                reason = _mistake(recording) or str(error).removeprefix(f'{name}: ')
                raise type(error)(f'{name}: {reason}') from error
            show(f'{len(observations[-1].acquisitions)} acquisitions of {model.trigger_cycles} '
                 'trigger cycles')
        traces[shaft] = trace(observations, opened, declared=declaration.effects,
                              progress=progress)
    for fault in dict.fromkeys(faults):
        warnings.warn(fault, DataWarning, stacklevel=2)
    units = {unit for recording in opened for unit in recording.units}
    return Loop(traces, names, units.pop() if len(units) == 1 else '', tuple(
        dict.fromkeys(faults)), stated)


def _usable(recordings: Sequence[Recording], names: Sequence[str]
            ) -> tuple[list[Recording], list[str]]:
    """Return the recordings without channels that hold nothing new in one; what is wrong."""
    lost: set[int] = set()
    faults = []
    for name, recording in zip(names, recordings):
        found = channel_faults(recording, most_lost=0.0, copies=True)
        if sum(map(is_lost, found.values())) == recording.channels:  # then gaps cost cycles
            found = channel_faults(recording, copies=True)
        for channel, reason in found.items():
            lost |= {channel} if is_lost(reason) else set()
            faults.append(f'{name}: {recording.channel_names[channel]} {reason}'
                          + (' and is left out' if is_lost(reason) else ''))
    return [without_channels(recording, lost) for recording in recordings], faults


def _with_pulses(recording: Recording) -> Recording:
    """
    Return a recording with the pulses of its waveform among its fields, so found once.

    They are placed as the keyphasor was sampled, whose jitter is part of the declared model.
    """
    if recording.pulse_times is not None or recording.tach is None:
        return recording
    try:
        return replace(recording, pulse_times=recording.keyphasor_pulses(interpolate=False))
    except SaJitterError:
        return recording


def _times(recording: Recording) -> FloatArray | None:
    """Return the pulse times of a recording, those of its reference where it has no others."""
    return recording.reference_pulse_times if recording.pulse_times is None else (
        recording.pulse_times)


def _mistake(recording: Recording) -> str:
    """Return what is probably wrong with the pulse times of a recording, '' for nothing."""
    times, start = _times(recording), recording.start_time
    return '' if times is None else likely_mistake(
        times, start, start + recording.duration, recording.sample_rate)


def _for_several(recording: Recording, models: Mapping[str, DeclaredModel]) -> Recording:
    """Return a recording without its ratio, which is that of one shaft only."""
    ratios = [model.ratio for model in models.values()]
    if recording.ratio != 1.0 and not any(
            math.isclose(recording.ratio, ratio, rel_tol=SAME_RATIO) for ratio in ratios):
        raise ModelError(f'the recording has the ratio {recording.ratio:.9g}, which none of the '
                         f'shafts {", ".join(models)} has: declare the ratios of this machine')
    return replace(recording, ratio=1.0)


def _name(number: int, source: Source) -> str:
    """Return the name of a recording in a report: path or description, else its number."""
    if isinstance(source, Recording):
        return source.description or f'recording {number}'
    return os.fspath(source)


def _declaration(declared: Declared, sample_rate: float) -> Declaration:
    """Return models and effects, declared in any of the forms; raises SaJitterError."""
    if isinstance(declared, DeclaredModel):
        return Declaration({_SHAFT: declared}, ())
    if not isinstance(declared, (str, os.PathLike, Mapping)):
        raise ModelError(f'declared is {declared!r}: give the path of a parameter file, a '
                         'DeclaredModel or a mapping of the keywords of predict')
    if not isinstance(declared, Mapping):
        found = read_declaration(Path(declared), sample_rate=sample_rate)
        if found.unknown:
            warnings.warn(f'{os.fspath(declared)}: ignored, because jitter_predictor has no such '
                          f'parameters: {", ".join(found.unknown)}', stacklevel=3)
        return found
    known = {item.name for item in fields(DeclaredModel)}
    needed = [item.name for item in fields(DeclaredModel) if item.default is MISSING]
    for name in declared.keys() - known - {'effects'}:
        raise ModelError(f'{name} is not a keyword of a declared model: give some of '
                         f'{", ".join(sorted(known))}, effects')
    values = {'sample_rate': sample_rate,
              **{name: value for name, value in declared.items() if value is not None}}
    effects = declared_effects(values.pop('effects', {}))
    missing = [name for name in needed if name not in values]
    if missing:
        raise ModelError(f'the declared model has no {", ".join(missing)}: a model '
                         f'needs at least {", ".join(needed)}')
    return Declaration({_SHAFT: DeclaredModel(**values)}, effects)
