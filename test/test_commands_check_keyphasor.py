# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The command check_keyphasor: its files serve all nodes and commands as they are."""

import json

from matplotlib.figure import Figure
import numpy as np
import pytest
from rclpy.parameter import Parameter
from sa_jitter_ros.commands import check_keyphasor, close_loop, design
from sa_jitter_ros.declaration import read_declaration
from sa_jitter_ros.nodes.jitter_predictor import JitterPredictor
from sa_jitter_ros.nodes.live_view import LiveView
from sa_jitter_ros.nodes.recording_player import RecordingPlayer
from sa_jitter_ros.nodes.residual_analyser import ResidualAnalyser
from sa_jitter_ros.nodes.synchronous_averager import SynchronousAverager
from sa_jitter_ros.nodes.tach_detector import TachDetector
from sa_jitter_ros.parameter_file import read_parameters

RATE, SPEED, SECONDS, CLOCK = 6000.0, 25.0, 10.0, 20000.0
NODES = {'jitter_predictor': JitterPredictor, 'live_view': LiveView,
         'recording_player': RecordingPlayer, 'residual_analyser': ResidualAnalyser,
         'synchronous_averager': SynchronousAverager, 'tach_detector': TachDetector}
KEYS = ('pulses_per_revolution', 'missing_teeth', 'marks', 'clock_rate', 'jitter_std',
        'jitter_correlation', 'missing', 'spurious', 'speed', 'ratio', 'orders', 'path_delay')


@pytest.fixture(scope='module')
def recording(tmp_path_factory):
    """Return a recording of another make: a wheel 12-1, sampled by a coarse clock."""
    rng = np.random.default_rng(1)
    path = tmp_path_factory.mktemp('rig') / 'rig.npz'
    time = np.arange(int(RATE * SECONDS)) / RATE
    turns = SPEED * time + 2e-3 * np.sin(3.0 * time)
    teeth = np.arange(5, int(12 * SPEED * SECONDS) - 5)
    pulses = np.interp(teeth[teeth % 12 != 11] / 12.0, turns, time)
    strays = rng.uniform(1.0, 9.0, 5)
    samples = sum(np.cos(2.0 * np.pi * order * turns + order) for order in (7.0, 14.0, 21.0))
    np.savez(path, acc=samples + rng.normal(0.0, 0.2, time.size), fs=RATE,
             clicks=np.sort(np.append(np.ceil(pulses * CLOCK) / CLOCK, strays)))
    return path


@pytest.fixture(scope='module')
def written(recording):
    """Return the folder that the command wrote."""
    folder = recording.parent / 'found'
    assert check_keyphasor.main([
        str(recording), '--field', 'vibration=acc', '--field', 'sample_rate=fs', '--field',
        'pulse_times=clicks', '--output', str(folder), '--quiet']) == 0
    return folder


@pytest.mark.machines
def test_json_has_every_key_with_value_error_and_alternatives(written):
    report = json.loads((written / 'keyphasor.json').read_text())
    assert report.keys() == {*KEYS, 'warnings'}
    for key in KEYS:
        assert report[key].keys() == {
            'value', 'standard_error', 'unit', 'alternatives', 'decided_by'}
        assert all(item.keys() == {'value', 'probability'} for item in report[key]['alternatives'])
    assert [report[key]['value'] for key in KEYS[:2]] == [12, 1]
    assert len(report['marks']['value']) == len(report['marks']['standard_error']) == 11
    assert report['spurious']['value']['count'] == len(report['spurious']['value']['times']) == 5
    assert report['speed']['value'].keys() == {'minimum', 'mean', 'maximum'}
    assert report['orders']['value'] == [7.0, 14.0, 21.0]
    assert report['path_delay']['value'] is None
    for warning in report['warnings']:
        assert warning.keys() == {'code', 'text', 'cost'}
        assert all(item.keys() == {'order', 'percent'} for item in warning['cost'])
    assert 'spurious' in [warning['code'] for warning in report['warnings']]
    assert (written / 'keyphasor.png').read_bytes().startswith(b'\x89PNG')


@pytest.mark.parametrize('name', NODES)
def test_machine_file_starts_every_node(name, written, recording, ros_graph):
    given = read_parameters(written / 'machine.yaml', name)
    extra = {'live_view': {'port': 0}, 'recording_player': {
        'recording': str(recording), 'fields': ['vibration=acc', 'sample_rate=fs']}}
    node = ros_graph.add(
        NODES[name], cli_args=['--ros-args', '--params-file', str(written / 'machine.yaml')],
        parameter_overrides=[Parameter(key, value=value)
                             for key, value in extra.get(name, {}).items()])
    assert given['hardware_id'] == 'rig.npz'
    for key, value in given.items():
        assert node.get_parameter(key).value == value


@pytest.mark.machines
@pytest.mark.usefixtures('undrawn', 'unasked')
def test_machine_file_declares_the_machine_to_the_commands(
        written, recording, capsys, monkeypatch):
    machine = written / 'machine.yaml'
    declaration = read_declaration(machine)
    assert declaration.unknown == ()
    assert declaration.model.orders == (7.0, 14.0, 21.0)
    assert declaration.model.keyphasor_rate == pytest.approx(CLOCK, rel=0.05)
    monkeypatch.setattr(design, 'draw', lambda *arguments: Figure())  # iso-lines take seconds
    assert design.main(['--params', str(machine), '--output', str(written / 'design.png')]) == 0
    assert close_loop.main([
        str(recording), '--field', 'vibration=acc', '--field', 'sample_rate=fs', '--field',
        'pulse_times=clicks', '--params', str(machine), '--output', str(written / 'loop'),
        '--quiet']) == 0
    assert (written / 'loop' / 'report.json').exists()


PARTS = """/**:
  ros__parameters:
    hardware_id: "no. 7"
    machine:
      tach_shaft: main
      gears: {g: {shaft: main, teeth: 7, mate_shaft: out, mate_teeth: 21}}
      bearings: {b: {shaft: out, cage: 0.4, ball: 2.3, outer: 3.0e-5, inner: 5.4}}
      channels: {"in: #1": {unit: "%", sensitivity: 2.0}}
jitter_predictor:
  ros__parameters: {shafts: [main, out], out.orders: [21, 42.0]}
"""


@pytest.mark.machines
@pytest.mark.usefixtures('undrawn')
def test_machine_file_keeps_the_parts(recording, tmp_path, ros_graph):
    declared, found = tmp_path / 'declared.yaml', tmp_path / 'out' / 'machine.yaml'
    declared.write_text(PARTS)
    assert check_keyphasor.main([
        str(recording), '--field', 'vibration=acc', '--field', 'sample_rate=fs', '--field',
        'pulse_times=clicks', '--params', str(declared), '--output', str(found.parent),
        '--quiet']) == 0
    before, after = (read_parameters(path, 'live_view') for path in (declared, found))
    assert {**after, 'shafts': 0} == {**before, 'shafts': 0}
    declaration = read_declaration(found)
    assert {name: model.orders for name, model in declaration.models.items()} == {
        'main': read_declaration(declared).models['main'].orders, 'out': (21.0, 42.0)}
    node = ros_graph.add(NODES['synchronous_averager'], cli_args=[
        '--ros-args', '--params-file', str(found)])
    assert node.get_parameter('out.ratio').value == pytest.approx(1 / 3)
    assert list(node.get_parameter('out.orders').value) == [21.0, 42.0]
    assert list(node.get_parameter('main.mesh_orders').value) == [7.0]
    assert node.get_parameter('pulses_per_revolution').value == 12


@pytest.mark.machines
@pytest.mark.usefixtures('undrawn')
def test_machine_file_is_compared_with_what_is_found(recording, tmp_path):
    (tmp_path / 'machine.yaml').write_text(
        '/**/jitter_predictor:\n  ros__parameters:\n    pulses_per_revolution: 50\n'
        '    trigger_speed: 25.0\n    orders: [7.0, 9.0]\n')
    assert check_keyphasor.main([
        str(recording), '--field', 'vibration=acc', '--field', 'sample_rate=fs', '--field',
        'pulse_times=clicks', '--output', str(tmp_path / 'out'), '--quiet',
        '--params', str(tmp_path / 'machine.yaml')]) == 0
    report = json.loads((tmp_path / 'out' / 'keyphasor.json').read_text())
    texts = {item['code']: item['text'] for item in report['warnings']}
    assert report['pulses_per_revolution']['value'] == 12
    assert 'states 50 marks' in texts['marks_contradict']
    assert texts['orders_weak'].endswith(': 9')


@pytest.mark.parametrize(('arguments', 'line'), [
    (['rig.npz', '--output', 'out'], 'rig.npz: no such file or folder: check the path'),
    (['{rig}', '--output', 'out', '--field', 'raito=2'], 'no field raito'),
    (['{rig}', '--output', 'out', '--field', 'pulse_times=nowhere'], 'neither a number nor a key'),
    (['{rig}', '--output', 'out', '--field', 'pulse_times=1,1,1,1,1,1,1', '--field',
      'sample_rate=9'], 'all 7 pulses are at 1 s'),
    (['{rig}', '--output', '{rig}', '--field', 'sample_rate=9'], 'is a file'),
])
def test_unusable_input_is_one_line_and_status_2(arguments, line, recording, tmp_path, capsys):
    given = [str(recording) if item == '{rig}' else str(tmp_path / item) if item == 'out' else item
             for item in arguments]
    assert check_keyphasor.main([*given, '--quiet']) == 2
    said = capsys.readouterr().err
    assert line in said
    assert said.count('\n') == 1
    assert not (tmp_path / 'out').exists()
