# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Parameters of the averager for a recording: of a machine file, and of the recording itself."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.averaging.average import KeyphasorParameters
from sa_jitter_ros.averaging.averager import Averager
from sa_jitter_ros.averaging.averager_parameters import one_ratio, PARAMETERS, shaft_parameters
from sa_jitter_ros.errors import ParameterError, RecordingError
from sa_jitter_ros.machine import following, Machine, PREFIX
from sa_jitter_ros.monitoring.limits import LimitWatch
from sa_jitter_ros.parameter_file import read_parameters, value_of
from sa_jitter_ros.parameters import (
    converted, did_you_mean, HARDWARE_ID, Parameter, require_shaft_names, unknown_names, Values)
from sa_jitter_ros.pulses.detector_parameters import DETECTOR_PARAMETERS
from sa_jitter_ros.pulses.unit_check import likely_mistake
from sa_jitter_ros.recordings import Recording

AVERAGER, DETECTOR = 'synchronous_averager', 'tach_detector'
_PARAMETERS = {item.name: item for item in PARAMETERS}
_SHAFTS = _PARAMETERS['shafts']

_FIRST_SECONDS = 10.0  # part of a recording from which its settings are chosen
_ORDERS = 6  # if the recording names none
_AVERAGES = 8  # of a recording
_MOST_CYCLES = 100  # in an average
_FEWEST_CYCLES = 4  # in the first seconds


@dataclass(frozen=True)
class MachineFile:
    """
    Parameters of `synchronous_averager` and `tach_detector` that a user gives, by their names.

    Among those of the averager is what follows from the machine, whose own are `parts`.
    `source` is the path of the machine file, '' without one; `unknown` are names in it that the
    averager does not have; `hardware_id` is the name of the machine.
    """

    averager: Mapping[str, Any]
    detector: Mapping[str, Any]
    source: str = ''
    unknown: tuple[str, ...] = ()
    parts: Mapping[str, Any] = field(default_factory=dict)
    hardware_id: str = ''

    @property
    def machine(self) -> Machine:
        """Return the machine by its parts, one without parts where none are given."""
        return Machine.among(self.parts)

    @classmethod
    def read(cls, params: Path | None, given: Collection[str] = ()) -> 'MachineFile':
        """
        Read a machine file, and texts `NAME:=VALUE` that override it; raises ParameterError.

        >>> MachineFile.read(None, ['trigger_cycles:=60', 'shafts:=[gear]']).averager
        {'trigger_cycles': 60, 'shafts': ['gear']}
        """
        values: dict[str, Any] = {}
        detector: dict[str, Any] = {}
        if params is not None:
            values = read_parameters(params, AVERAGER)
            detector = section(params, DETECTOR)
        overrides = values_of(given)
        values |= overrides
        found = following(values)
        LimitWatch(Machine.among(values), found.get('shafts') or _SHAFTS.convert(
            values.get('shafts', _SHAFTS.default)))
        parts = {name: values.pop(name) for name in [*values] if name.startswith(PREFIX)}
        known = _specifications(found | values)
        values = {name: value for name, value in found.items() if name in known} | values
        wrong = sorted(overrides.keys() - known.keys() - parts.keys())
        if wrong:
            near = did_you_mean(wrong[0], known)
            raise ParameterError(f'{AVERAGER} has no parameter {", ".join(wrong)}'
                                 + (near or f': give some of {", ".join(sorted(known))}'))
        if params is not None and not known.keys() & (values.keys() - overrides.keys()):
            raise ParameterError(f'{params}: no parameter of {AVERAGER}: give a file with its '
                                 f'section, "/**/{AVERAGER}:" and "ros__parameters:"')
        return cls(converted(values, known),
                   converted(detector, {item.name: item for item in DETECTOR_PARAMETERS}),
                   '' if params is None else str(params), unknown_names(values, known), parts,
                   str(values.get(HARDWARE_ID.name, '')))


def values_of(given: Collection[str]) -> dict[str, Any]:
    """Return the values of parameters by name that texts `NAME:=VALUE` give; ParameterError."""
    found = {}
    for text in given:
        name, separator, value = text.partition(':=')
        if not (separator and name):
            raise ParameterError(f'parameter {text!r}: give NAME:=VALUE, as in trigger_cycles:=60')
        found[name] = value_of(value)
    return found


def section(params: Path | None, node: str) -> dict[str, Any]:
    """Return the parameters of a node in a machine file, {} where it has none."""
    try:
        return read_parameters(params, node) if params is not None else {}
    except ParameterError:
        return {}


def _specifications(values: Mapping[str, Any]) -> dict[str, Parameter]:
    """Return the averager's parameters by name, with those of the shafts in `values`."""
    shafts = _SHAFTS.convert(values.get('shafts', _SHAFTS.default))
    require_shaft_names('shafts', shafts)
    return _PARAMETERS | {item.name: item for shaft in shafts for item in shaft_parameters(shaft)}


@dataclass(frozen=True)
class Suggestion:
    """
    What the first seconds of a recording suggest.

    `speed` of the tach shaft in Hz, `trigger_cycles` for a few averages of the recording, and the
    `orders` of the recording, else the strongest ones.
    """

    speed: float
    trigger_cycles: int
    orders: tuple[float, ...]


def averager_values(machine: MachineFile, recording: Recording, *, fields: Collection[str] = ()
                    ) -> Values:
    """
    Return the values of all parameters of the averager for a recording, by their names.

    They are those that the user gives; else, of keyphasor, ratio and orders, those of the
    recording. `fields` are names of the recording that the user gives: they win. Without a machine
    file the others are chosen from the recording. Raises ParameterError for values that
    contradict each other, RecordingError for a recording without pulses.
    """
    given = dict(machine.averager)
    shafts = given.get('shafts', _SHAFTS.default)
    several = sorted({'ratio', 'orders'} & set(fields)) if len(shafts) > 1 else []
    if several:
        raise ParameterError(f'--field {several[0]} with the shafts {", ".join(shafts)}: give '
                             f'the parameters {", ".join(f"{s}.{several[0]}" for s in shafts)}')
    found: dict[str, Any] = {
        'pulses_per_revolution': recording.pulses_per_revolution,
        'pulses_per_trigger': recording.pulses_per_trigger or 0,
        'missing_teeth': recording.missing_teeth}
    if recording.tach_rate is not None:
        found['keyphasor_rate'] = recording.tach_rate
    names = {'tach_rate': 'keyphasor_rate'}
    if len(shafts) == 1:
        shaft, = shafts
        names |= {name: f'{shaft}.{name}' for name in ('ratio', 'orders')}
        if 'ratio' in fields:
            given.pop(f'{shaft}.ratio_teeth', None)
        if not given.get(f'{shaft}.ratio_teeth'):
            found[f'{shaft}.ratio'] = recording.ratio
        if recording.orders:
            found[f'{shaft}.orders'] = list(recording.orders)
    for name in fields:
        given.pop(names.get(name, name), None)
    if not machine.source:
        choice = choose(recording)
        found |= {'trigger_cycles': choice.trigger_cycles, 'correct_jitter': True,
                  'maximum_discarded': 0.5}
        if len(shafts) == 1:
            found[f'{shafts[0]}.orders'] = list(choice.orders)
    for shaft in shafts:
        if given.get(f'{shaft}.ratio_teeth') and f'{shaft}.ratio' in given:
            raise one_ratio(given, shaft)
    known = _specifications(given)
    return {name: known[name].convert((found | given).get(name, item.default))
            for name, item in known.items()}


def choose(recording: Recording) -> Suggestion:
    """
    Return settings for the averages of a recording, from its first seconds.

    Raises RecordingError where these hold no pulses, or not those of a few trigger cycles.
    """
    samples = next(recording.blocks(round(_FIRST_SECONDS * recording.sample_rate)))
    pulses = recording.keyphasor_pulses(duration=samples.shape[1] / recording.sample_rate)
    keyphasor = KeyphasorParameters(pulses_per_revolution=recording.pulses_per_revolution,
                                    pulses_per_trigger=recording.pulses_per_trigger,
                                    missing_teeth=recording.missing_teeth)
    triggers = keyphasor.validator().update(pulses)
    cycles = np.diff(triggers.times)[~triggers.starts_run[1:]]
    if len(cycles) < _FEWEST_CYCLES:
        mistake = likely_mistake(
            recording.keyphasor_pulses(), recording.start_time,
            recording.start_time + recording.duration, recording.sample_rate)
        raise RecordingError(mistake or f'{len(pulses)} pulses give {len(cycles)} trigger cycles '
                             f'in the first {_FIRST_SECONDS:g} s: at least {_FEWEST_CYCLES} are '
                             'needed; check pulses_per_revolution, or the threshold of the tach '
                             'waveform')
    period = float(np.median(cycles))
    trigger_cycles = int(np.clip(recording.duration / period // _AVERAGES, 2, _MOST_CYCLES))
    return Suggestion(
        keyphasor.revolutions_per_trigger / period, trigger_cycles,
        recording.orders or _strongest_orders(recording, samples, pulses, trigger_cycles))


def _strongest_orders(recording: Recording, samples: FloatArray, pulses: FloatArray,
                      trigger_cycles: int) -> tuple[float, ...]:
    """Return the orders with the largest amplitudes in the first average."""
    averages = Averager(
        recording.sample_rate, start_time=recording.start_time, ratio=recording.ratio,
        pulses_per_revolution=recording.pulses_per_revolution,
        pulses_per_trigger=recording.pulses_per_trigger,
        missing_teeth=recording.missing_teeth, trigger_cycles=trigger_cycles,
    ).update(samples, pulses)
    if not averages:
        return (1.0, 2.0, 3.0)
    waveform = averages[0].waveform
    amplitude = np.abs(np.fft.rfft(waveform, axis=1)).max(axis=0)[1:waveform.shape[1] // 3]
    strongest = np.sort(np.argsort(amplitude)[-_ORDERS:]) + 1
    return tuple(float(order) for order in strongest)
