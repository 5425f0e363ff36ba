# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""How the demo averages a recording, and the model that it declares for it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
import math
from pathlib import Path

from sa_jitter_ros.declaration import read_declaration
from sa_jitter_ros.errors import RecordingError
from sa_jitter_ros.keyphasor_check.plausibility import doubts
from sa_jitter_ros.offline.settings import choose
from sa_jitter_ros.parameter_file import read_parameters
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.recordings import Recording
from sa_jitter_ros.recordings.channel_units import channels_of, scale_of

SIMULATED_SECONDS = 20.0


@dataclass(frozen=True)
class Plan:
    """
    How signals are played, averaged and predicted.

    `source` is the node that plays them, with `source_parameters`, for `seconds`. `model` is that
    of the first of the `shafts`. `waveform` is true if the pulses come from a tach waveform;
    `note` is for the user. With `params`, a machine file, the nodes take their parameters from it.
    """

    source: str
    source_parameters: Mapping[str, object]
    title: str
    seconds: float
    channels: tuple[str, ...]
    unit: str
    model: DeclaredModel
    waveform: bool = False
    missing_teeth: int = 0
    note: str = ''
    shafts: tuple[str, ...] = ('shaft',)
    params: Path | None = None

    @property
    def shaft(self) -> str:
        """Return the first shaft, which the model is of."""
        return self.shafts[0]


def plan_simulation(params: Path) -> Plan:
    """Return the plan for the simulated gearbox of a machine file; raises SaJitterError."""
    values = read_parameters(params, 'machine_simulator')
    channels = scale_of(channels_of(values), len(values.get('channel_gains', [1.0])))
    models = read_declaration(params).models
    return Plan(
        source='machine_simulator', source_parameters={}, title='simulated gearbox',
        seconds=SIMULATED_SECONDS, channels=channels.names, unit=channels.units[0],
        model=next(iter(models.values())), shafts=tuple(models), params=params)


def with_machine(plan: Plan, params: Path) -> Plan:
    """Return a plan for the machine of a file, at the speed of the signals; SaJitterError."""
    models = read_declaration(params).models
    model = replace(next(iter(models.values())), trigger_speed=plan.model.trigger_speed)
    return replace(plan, params=params, shafts=tuple(models), note='', model=model)


def plan_recording(path: Path, recording: Recording, *, keyphasor_rate: float = 0.0,
                   parameters: Mapping[str, object] | None = None) -> Plan:
    """
    Return the plan for a recording, from its first seconds.

    `path` and `parameters` are those with which `recording_player` opens the recording. With
    `keyphasor_rate` (Hz) its pulse times are rounded up to a clock of that rate, as if the
    keyphasor had been sampled with it. Raises `SaJitterError` if the recording cannot be used.
    """
    choice = choose(recording)
    waveform = recording.pulse_times is None and recording.tach is not None
    if keyphasor_rate and waveform:
        raise RecordingError('--keyphasor-rate rounds recorded pulse times, but the recording has '
                             'a tach waveform: leave --keyphasor-rate out')
    rate = keyphasor_rate or recording.tach_rate or recording.sample_rate
    note = '' if keyphasor_rate or recording.tach_rate else (
        'the recording does not contain the sampling rate of the keyphasor (tach_rate): the '
        'sampling rate of the vibration is assumed; --keyphasor-rate sets another one')
    return Plan(
        source='recording_player',
        source_parameters={'recording': str(path), 'keyphasor_rate': keyphasor_rate,
                           **(parameters or {})},
        title=path.name, seconds=recording.duration,
        channels=recording.channel_names, unit=recording.units[0],
        model=DeclaredModel(rate, choice.speed, choice.trigger_cycles, choice.orders,
                            recording.ratio, recording.pulses_per_revolution,
                            recording.pulses_per_trigger or 0),
        waveform=waveform, missing_teeth=recording.missing_teeth, note=note)


def plan_doubts(plan: Plan, recording: Recording) -> tuple[str, ...]:
    """Return what contradicts each other in a recording and its plan, a sentence each."""
    declared = plan.params is not None or recording.tach_rate is not None
    model = plan.model
    return doubts(
        recording, recording.keyphasor_pulses(), orders=model.orders, ratio=model.ratio,
        pulses_per_revolution=model.pulses_per_revolution,
        pulses_per_trigger=model.pulses_per_trigger or None, **recording.target,
        jitter_std=1.0 / math.sqrt(12.0) / model.keyphasor_rate
        if declared and not plan.waveform and not plan.source_parameters.get('keyphasor_rate')
        else None)
