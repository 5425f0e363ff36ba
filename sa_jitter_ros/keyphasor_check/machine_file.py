# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The machine file of a check, with parameters of the nodes; its target for a recording."""

from collections.abc import Mapping
from dataclasses import replace
import math
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from sa_jitter_ros.averaging.averager_parameters import PARAMETERS
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.keyphasor_check.result import KeyphasorCheck
from sa_jitter_ros.machine import following, PREFIX
from sa_jitter_ros.parameter_file import nested, read_parameters, section_text
from sa_jitter_ros.parameters import converted, HARDWARE_ID
from sa_jitter_ros.pulses.target_geometry import MarkOffsets
from sa_jitter_ros.recordings.recording import Recording

# close_loop compares no fewer cycles; cycles from mark to mark are more, and corrected together
_LEAST_CYCLES, _MOST_CYCLES, _AVERAGES, _MOST_FROM_MARKS = 5, 100, 8, 400
_ROUNDED = 0.7  # of the jitter: a clock that makes as much makes all of it
_SHAFT = 'shaft'
NOTHING: Mapping[str, Any] = MappingProxyType({})  # declared
_DISCARDED = 0.5  # of the trigger cycles of an average
_COARSE, _TICKS, _WIDEST = 0.02, 2.5, 0.45  # of an interval
_CLEAR = 4.0  # standard errors of a delay that is corrected
_SHOWS = 1e-4  # rad, of the highest order, by which a mark is uneven enough
_TARGET = {item.name: item for item in PARAMETERS if item.name in (
    'pulses_per_revolution', 'missing_teeth', 'target_geometry', 'target_angles')}


def machine_parameters(check: KeyphasorCheck, declared: Mapping[str, Any] = NOTHING
                       ) -> dict[str, dict[str, Any]]:
    """
    Return the parameters of the nodes, by the name of the node.

    `declared` are those of a machine file: ratios and orders of shafts of which it has parts
    follow from these, unless it gives them.
    """
    found = {name: item.value for name, item in check.findings.items()}
    count, std, clock = found['pulses_per_revolution'], found['jitter_std'], found['clock_rate']
    tick = 1.0 / clock if clock else 0.0  # s
    width = math.sqrt(12.0) * (std or check.fitted.scatter)
    rounded = check.from_waveform or tick > _ROUNDED * width
    rate = clock if rounded else 1.0 / width
    turns = check.fitted.turns
    cycles = int(np.clip(turns // _AVERAGES, _LEAST_CYCLES if turns > _LEAST_CYCLES else 2,
                         _MOST_CYCLES))
    common: dict[str, Any] = {
        **_of_shafts(found, declared),
        'pulses_per_revolution': count, 'trigger_cycles': cycles, 'keyphasor_rate': float(rate)}
    if check.by_marks:
        turns = min(cycles, max(1, _MOST_FROM_MARKS // count))
        common |= {'pulses_per_trigger': 1, 'trigger_cycles': turns * count}
    jitter: dict[str, Any] = {'jitter_distribution': 'uniform'}
    if not rounded and std:
        jitter = {'jitter_distribution': 'normal', 'jitter_std': float(std)}
    nodes: dict[str, dict[str, Any]] = {
        'synchronous_averager': {**common, 'missing_teeth': found['missing_teeth'],
                                 'maximum_discarded': _DISCARDED, 'correct_jitter': True},
        'jitter_predictor': {**common, 'trigger_speed': float(found['speed']['mean']),
                             'follow_shaft_speed': True, **jitter},
        'residual_analyser': {'shaft': common['shafts'][0]},
        'live_view': {'shafts': common['shafts']}}
    pitch = 1.0 / (float(found['speed']['mean']) * count)
    if tick > _COARSE * pitch:  # intervals scatter by a tick to either side
        nodes['synchronous_averager']['interval_tolerance'] = min(_WIDEST, _TICKS * tick / pitch)
    target = MarkOffsets(np.array(check.findings['marks'].value),
                         np.array(check.findings['marks'].standard_error or 0.0))
    turn = np.abs(target.angles).max() * (found['ratio'] or 1.0) * max(found['orders'] or [1.0])
    if target.standard_errors.all() and target.significant and turn > _SHOWS:
        nodes['synchronous_averager'] |= {
            'target_geometry': 'given', 'target_angles': target.angles.tolist()}
    delay = check.findings['path_delay']
    if delay.value is not None and abs(delay.value) > _CLEAR * delay.standard_error:
        nodes['synchronous_averager']['path_delay'] = float(delay.value)
    if check.from_waveform:
        # The declared jitter is that of a pulse time which is the first sample past the threshold.
        nodes['tach_detector'] = {'interpolate': False}
    return nodes


def _of_shafts(found: Mapping[str, Any], declared: Mapping[str, Any]) -> dict[str, Any]:
    """Return names, ratios and orders of the shafts: those found, unless a machine has parts."""
    follow = following(declared)
    if not follow:
        orders = {f'{_SHAFT}.orders': found['orders']} if found['orders'] else {}
        return {'shafts': [_SHAFT], f'{_SHAFT}.ratio': float(found['ratio'] or 1.0), **orders}
    shafts = follow['shafts']
    alone = {name: f'{shafts[0]}.{name}' for name in ('ratio', 'orders') if len(shafts) == 1}
    given = {alone.get(name, name): value for name, value in declared.items()}
    return {'shafts': shafts, **{
        f'{shaft}.{name}': np.asarray(given[f'{shaft}.{name}'], float).tolist() for shaft in shafts
        for name in ('ratio', 'orders') if f'{shaft}.{name}' in given}}


def machine_file(check: KeyphasorCheck, name: str, declared: Mapping[str, Any] = NOTHING) -> str:
    """
    Return the text of a ROS parameter file for all nodes, with what is uncertain as remarks.

    It keeps the parts of the machine in `declared`, the parameters of a machine file.
    """
    name = ' '.join(name.split())
    lines = [f'# The machine as check_keyphasor found it in {name}.']
    for key, item in check.findings.items():
        if item.alternatives:
            others = ', '.join(f'{value:.6g} ({probability:.0%})'
                               for value, probability in item.alternatives)
            lines.append(f'# {key} may also be {others}: {item.decided_by}')
    if not (check.findings['orders'].value or following(declared)):
        lines.append('# No order is known: add those of interest, as in shaft.orders: [1.0, 2.0], '
                     'to synchronous_averager and jitter_predictor.')
    parts = nested({key: value for key, value in declared.items() if key.startswith(PREFIX)})
    sections = {'': {HARDWARE_ID.name: declared.get(HARDWARE_ID.name) or name, **parts},
                **machine_parameters(check, declared)}
    return '\n'.join(lines) + '\n\n' + '\n'.join(
        section_text(node, parameters) for node, parameters in sections.items())


def on_target(recording: Recording, params: Path) -> Recording:
    """
    Return a recording with the target that a machine file gives to the averager.

    Marks and missing teeth of the recording are kept. Raises ParameterError for a wrong value.
    """
    try:
        values = read_parameters(params, 'synchronous_averager')
    except ParameterError:  # no section of the averager
        return recording
    target = converted(values, _TARGET)
    angles = tuple(target.pop('target_angles', ()))
    if target.pop('target_geometry', 'none') == 'given':
        recording = replace(recording, target_angles=angles)
    stated = recording.pulses_per_revolution > 1 and not target.get('missing_teeth')
    return recording if recording.missing_teeth or stated else replace(recording, **target)
