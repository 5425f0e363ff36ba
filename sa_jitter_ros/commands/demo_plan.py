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

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.averaging.average import KeyphasorParameters
from sa_jitter_ros.averaging.averager import Averager
from sa_jitter_ros.declaration import read_declaration
from sa_jitter_ros.errors import RecordingError
from sa_jitter_ros.keyphasor_check.plausibility import doubts
from sa_jitter_ros.parameter_file import read_parameters
from sa_jitter_ros.pulses.unit_check import likely_mistake
from sa_jitter_ros.recordings import Recording

FloatArray = NDArray[np.float64]

FIRST_SECONDS = 10.0  # part of a recording from which its plan is made
ORDERS = 6  # orders to show if the recording names none
AVERAGES = 8  # averages to make of a recording
SIMULATED_SECONDS = 20.0


@dataclass(frozen=True)
class Plan:
    """
    How signals are played, averaged and predicted.

    `source` is the node that plays them, with `source_parameters`, for `seconds`. `speed` of the
    tach shaft and `keyphasor_rate` are in Hz; `pulses_per_trigger` is 0 for all pulses of a
    revolution. `waveform` is true if the pulses come from a tach waveform; `note` is for the user.
    With `params`, a machine file, the nodes take their parameters from it.
    """

    source: str
    source_parameters: Mapping[str, object]
    title: str
    seconds: float
    channels: tuple[str, ...]
    unit: str
    speed: float
    keyphasor_rate: float
    pulses_per_revolution: int
    ratio: float
    trigger_cycles: int
    orders: tuple[float, ...]
    waveform: bool = False
    pulses_per_trigger: int = 0
    missing_teeth: int = 0
    note: str = ''
    shaft: str = 'shaft'
    params: Path | None = None

    @property
    def unit_label(self) -> str:
        """Return the unit of the vibration in brackets, empty if it is unknown."""
        return f'[{self.unit}]' if self.unit and self.unit != 'unknown' else ''


def plan_simulation(params: Path) -> Plan:
    """Return the plan for the simulated gearbox of a machine file; raises SaJitterError."""
    gains = read_parameters(params, 'machine_simulator').get('channel_gains', [1.0])
    labels = read_parameters(params, 'live_view')
    names = labels.get('channel_names', [])
    if len(names) != len(gains):
        names = [f'channel {i}' for i in range(len(gains))]
    plan = Plan(
        source='machine_simulator', source_parameters={}, title='simulated gearbox',
        seconds=SIMULATED_SECONDS, channels=tuple(names), unit=labels.get('vibration_unit', ''),
        speed=0.0, keyphasor_rate=0.0, pulses_per_revolution=1, ratio=1.0, trigger_cycles=1,
        orders=())
    planned = with_machine(plan, params)
    return replace(planned, speed=read_declaration(params).models[planned.shaft].trigger_speed)


def with_machine(plan: Plan, params: Path) -> Plan:
    """Return a plan for the first shaft of a machine file; raises SaJitterError."""
    shaft, model = next(iter(read_declaration(params).models.items()))
    declared = {name: getattr(model, name) for name in (
        'keyphasor_rate', 'pulses_per_revolution', 'pulses_per_trigger', 'ratio',
        'trigger_cycles', 'orders')}
    return replace(plan, params=params, shaft=shaft, note='', **declared)


def plan_recording(path: Path, recording: Recording, *, keyphasor_rate: float = 0.0,
                   parameters: Mapping[str, object] | None = None) -> Plan:
    """
    Return the plan for a recording, from its first seconds.

    `path` and `parameters` are those with which `recording_player` opens the recording. With
    `keyphasor_rate` (Hz) its pulse times are rounded up to a clock of that rate, as if the
    keyphasor had been sampled with it. Raises `RecordingError` if the recording cannot be used.
    """
    first, pulses = _first_seconds(recording)
    triggers = _keyphasor(recording).validator().update(pulses)
    cycles = np.diff(triggers.times)[~triggers.starts_run[1:]]
    if len(cycles) < 4:
        mistake = likely_mistake(
            recording.keyphasor_pulses(), recording.start_time,
            recording.start_time + recording.duration, recording.sample_rate)
        raise RecordingError(mistake or f'{len(pulses)} pulses give {len(cycles)} trigger cycles '
                             f'in the first {FIRST_SECONDS:g} s: at least 4 are needed; check '
                             'pulses_per_revolution, or the threshold of the tach waveform')
    period = float(np.median(cycles))
    trigger_cycles = int(np.clip(recording.duration / period // AVERAGES, 2, 100))
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
        channels=recording.channel_names, unit=recording.units[0] if recording.units else '',
        speed=_keyphasor(recording).revolutions_per_trigger / period, keyphasor_rate=rate,
        pulses_per_revolution=recording.pulses_per_revolution, ratio=recording.ratio,
        trigger_cycles=trigger_cycles,
        orders=recording.orders or _strongest_orders(recording, first, pulses, trigger_cycles),
        waveform=waveform, pulses_per_trigger=recording.pulses_per_trigger or 0,
        missing_teeth=recording.missing_teeth, note=note)


def plan_doubts(plan: Plan, recording: Recording) -> tuple[str, ...]:
    """Return what contradicts each other in a recording and its plan, a sentence each."""
    declared = plan.params is not None or recording.tach_rate is not None
    return doubts(
        recording, recording.keyphasor_pulses(), orders=plan.orders, ratio=plan.ratio,
        pulses_per_revolution=plan.pulses_per_revolution,
        pulses_per_trigger=plan.pulses_per_trigger or None, missing_teeth=plan.missing_teeth,
        jitter_std=1.0 / math.sqrt(12.0) / plan.keyphasor_rate
        if declared and not plan.waveform and not plan.source_parameters.get('keyphasor_rate')
        else None)


def _keyphasor(recording: Recording) -> KeyphasorParameters:
    return KeyphasorParameters(pulses_per_revolution=recording.pulses_per_revolution,
                               pulses_per_trigger=recording.pulses_per_trigger,
                               missing_teeth=recording.missing_teeth)


def _first_seconds(recording: Recording) -> tuple[FloatArray, FloatArray]:
    """Return vibration and pulse times of the first seconds."""
    samples = next(recording.blocks(round(FIRST_SECONDS * recording.sample_rate)))
    return samples, recording.keyphasor_pulses(duration=samples.shape[1] / recording.sample_rate)


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
    strongest = np.sort(np.argsort(amplitude)[-ORDERS:]) + 1
    return tuple(float(order) for order in strongest)
