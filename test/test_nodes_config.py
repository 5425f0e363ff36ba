# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The machine file and the transport profile of the package start its nodes."""

from importlib import import_module
import os
from pathlib import Path
import signal
import subprocess
import sys

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from matplotlib.figure import Figure
import numpy as np
import pytest
from rclpy.parameter import Parameter
from sa_jitter_ros.commands import chain, check_keyphasor, close_loop, design
from sa_jitter_ros.declaration import read_declaration
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.nodes import messages
from sa_jitter_ros.nodes.change_monitor import ChangeMonitor
from sa_jitter_ros.nodes.jitter_predictor import JitterPredictor
from sa_jitter_ros.nodes.live_view import LiveView
from sa_jitter_ros.nodes.machine_simulator import MachineSimulator
from sa_jitter_ros.nodes.parameters import given_parameters
from sa_jitter_ros.nodes.recording_player import RecordingPlayer
from sa_jitter_ros.nodes.residual_analyser import ResidualAnalyser
from sa_jitter_ros.nodes.synchronous_averager import SynchronousAverager
from sa_jitter_ros.nodes.tach_detector import TachDetector
from sa_jitter_ros.parameter_file import read_parameters, shipped
from sa_jitter_ros.recordings.channel_units import channels_of
from std_msgs.msg import Float64MultiArray
from test_keyphasor_machine_file import write_rig
import yaml

CONFIG = Path(__file__).resolve().parents[1] / 'config'
MACHINE = CONFIG / 'machine.yaml'
NODES = {'jitter_predictor': JitterPredictor, 'live_view': LiveView,
         'machine_simulator': MachineSimulator, 'recording_player': RecordingPlayer,
         'residual_analyser': ResidualAnalyser, 'synchronous_averager': SynchronousAverager,
         'tach_detector': TachDetector, 'change_monitor': ChangeMonitor}
#: The truth of the simulated machine: amplitudes of its orders on channel 0.
TRUE = {18.0: 0.1, 19.0: 1.0, 20.0: 0.1, 37.0: 0.05, 38.0: 0.5, 39.0: 0.05,
        56.0: 0.025, 57.0: 0.25, 58.0: 0.025}
SECONDS, RATE = 24.0, 12.0  # of machine time; times real time


def add(graph, name, machine=MACHINE, **parameters):
    """Start a node from a machine file, with further parameters."""
    return graph.add(
        NODES[name], cli_args=['--ros-args', '--params-file', str(machine)],
        parameter_overrides=[Parameter(key, value=value) for key, value in parameters.items()])


def test_machine_file_has_a_section_for_every_node():
    sections = yaml.safe_load(MACHINE.read_text())
    assert sections.keys() == {'/**', *(f'/**/{name}' for name in NODES)}
    assert shipped('machine.yaml') == MACHINE


@pytest.mark.parametrize('name', NODES)
def test_every_entry_of_its_section_counts_in_a_node_and_no_other(name, ros_graph, tmp_path):
    given = {key: value for key, value in read_parameters(MACHINE, name).items()
             if not key.startswith('machine.')}
    assert given['hardware_id'] == 'simulated_gearbox'
    extra = {'live_view': {'port': 0}, 'recording_player': {'recording': str(tmp_path / 'a.npz')}}
    np.savez(tmp_path / 'a.npz', vibration=np.zeros(100), sample_rate=1e3, pulse_times=[0.0, 0.1])
    node = add(ros_graph, name, **extra.get(name, {}))
    for key, value in given.items():
        if key not in extra.get(name, {}) and (
                not key.startswith('machine.') or node.has_parameter(key)):
            assert node.get_parameter(key).value == value
    own = {key for key in node._parameter_overrides if not key.startswith('machine.')}
    assert own <= given.keys() | extra.get(name, {}).keys()
    assert all(node.has_parameter(key) for key in own)


def test_ratios_and_orders_follow_from_the_parts_in_the_nodes_that_have_them(ros_graph):
    averager, predictor, simulator = (add(ros_graph, name) for name in (
        'synchronous_averager', 'jitter_predictor', 'machine_simulator'))
    for node, name, expected in (
            (averager, 'input.ratio', 183 / 76), (averager, 'input.orders', [*TRUE]),
            (averager, 'input.mesh_orders', [19.0]), (predictor, 'ratio', 183 / 76),
            (predictor, 'orders', [*TRUE]), (simulator, 'input.teeth', 19)):
        assert node.get_parameter(name).value == pytest.approx(expected)
    given = ros_graph.add(JitterPredictor, {'ratio': 2.0}, cli_args=[
        '--ros-args', '--params-file', str(MACHINE)])
    assert given.get_parameter('ratio').value == 2.0  # a plain number wins


def test_a_wrong_machine_is_one_line(ros_graph):
    with pytest.raises(ParameterError, match='tach_shaft is fan, which nothing turns'):
        ros_graph.add(ChangeMonitor, {'machine.tach_shaft': 'fan'}, cli_args=[
            '--ros-args', '--params-file', str(MACHINE)])


def test_sections_describe_the_same_machine():
    sections = [read_parameters(MACHINE, name) for name in NODES]
    shared = {key for section in sections for key in section} - {'keyphasor'}
    for key in shared:
        values = [section[key] for section in sections if key in section]
        assert all(value == values[0] for value in values), key
    simulated, averaged = sections[2], sections[5]
    assert averaged['shafts'] == simulated['shafts']
    assert sections[0]['trigger_speed'] == simulated['speed']
    assert len(channels_of(averaged)) == len(simulated['channel_gains'])
    assert {section['keyphasor'] for section in sections if 'keyphasor' in section} == {
        'output_shaft'}


@pytest.mark.machines
def test_nodes_of_the_machine_file_find_the_truth_of_its_simulator(ros_graph):
    names = ('synchronous_averager', 'jitter_predictor', 'residual_analyser', 'live_view',
             'change_monitor')
    changes = {'residual_analyser': {'acquisitions': 12}, 'live_view': {'port': 0}}
    for name in names:
        add(ros_graph, name, **changes.get(name, {}))
    amplitudes = ros_graph.capture('input/order_amplitude', Float64MultiArray)
    indicators = ros_graph.capture('input/condition_indicator', Float64MultiArray)
    predictions = ros_graph.capture('prediction', Float64MultiArray, latched=True)
    residuals = ros_graph.capture('residual', Float64MultiArray)
    status = ros_graph.capture('/diagnostics', DiagnosticArray)
    add(ros_graph, 'machine_simulator', duration=SECONDS, rate=RATE)
    assert ros_graph.spin(lambda: residuals)
    status.clear()
    assert ros_graph.spin(lambda: {item.status[0].name for item in status} >= set(names))
    for item in (each.status[0] for each in status):
        assert item.hardware_id == 'simulated_gearbox'
        if item.name in names:  # the simulator may warn that the computer is slow
            assert item.level == DiagnosticStatus.OK, item.message

    tables = np.stack([messages.decode_average('order_amplitude', item).values
                       for item in amplitudes])
    count, (noise, corrected, attenuation) = len(tables), (
        tables[..., messages.AMPLITUDE_FIELDS.index(name)]
        for name in ('noise_standard_deviation', 'corrected_amplitude', 'attenuation'))
    assert count >= 12
    true = np.array([TRUE[order] for order in tables[0, 0, :, 0]])
    for channel, gain in enumerate((1.0, 0.6)):
        error = np.sqrt(np.mean(noise[:, channel] ** 2, axis=0) / count)
        np.testing.assert_array_less(
            np.abs(corrected[:, channel].mean(axis=0) - gain * true), 5.0 * error)
    table = messages.decode_prediction(predictions[-1]).values
    scatter = table[:, 3] / np.sqrt(count) + noise[:, 0].mean(axis=0) / true / np.sqrt(count)
    np.testing.assert_array_less(
        np.abs(attenuation[:, 0].mean(axis=0) - table[:, 1]), 5.0 * scatter)
    assert messages.decode_residual(residuals[0]).p_value > 1e-3
    assert np.isfinite(messages.decode_average(
        'condition_indicator', indicators[-1]).values).all()


@pytest.mark.machines
@pytest.mark.usefixtures('undrawn')
def test_nodes_take_the_machine_file_of_a_wheel_with_an_extra_mark(ros_graph, tmp_path):
    path, declared = tmp_path / 'rig.npz', tmp_path / 'machine.yaml'
    write_rig(path, turns=100, edges=[*np.arange(12) / 12, 11.3 / 12], jitter=2e-5)
    assert check_keyphasor.main([str(path), '--output', str(tmp_path), '--quiet']) == 0
    for name in ('synchronous_averager', 'jitter_predictor', 'residual_analyser'):
        add(ros_graph, name, declared, **(
            {'acquisitions': 3} if name == 'residual_analyser' else {}))
    amplitudes = ros_graph.capture('shaft/order_amplitude', Float64MultiArray)
    residuals = ros_graph.capture('residual', Float64MultiArray)
    status = ros_graph.capture('/diagnostics', DiagnosticArray)
    # One thread serves all nodes: a busy computer must not lose messages.
    add(ros_graph, 'recording_player', declared, recording=str(path), rate=0.5)
    assert ros_graph.spin(lambda: residuals)
    for message in amplitudes:
        table = messages.decode_average('order_amplitude', message)
        raw = table.values[..., table.names.index('raw_amplitude')]
        np.testing.assert_allclose(raw, 1.0, atol=0.02)
    assert messages.decode_residual(residuals[0]).p_value > 1e-3
    averager = [item.status[0] for item in status
                if item.status[0].name == 'synchronous_averager']
    assert {item.level for item in averager} == {DiagnosticStatus.OK}


@pytest.mark.machines
@pytest.mark.usefixtures('undrawn')
def test_commands_read_the_machine_file(capsys, tmp_path, monkeypatch):
    declaration = read_declaration(MACHINE)
    assert declaration.unknown == ()
    assert declaration.model.orders == tuple(TRUE)
    monkeypatch.setattr(design, 'draw', lambda *arguments: Figure())  # iso-lines take seconds
    assert design.main(['--params', str(MACHINE), '--output', str(tmp_path / 'a.png')]) == 0
    assert '57' in capsys.readouterr().out
    assert design.main(['--params', str(MACHINE), '--shaft', 'out']) == 2
    assert capsys.readouterr().err == f"design: --shaft is 'out': {MACHINE} has input\n"
    np.savez(tmp_path / 'rig.npz', vibration=np.zeros(100), sample_rate=2e4)
    assert close_loop.main([str(tmp_path / 'rig.npz'), '--params', str(MACHINE), '--output',
                            str(tmp_path)]) == 2
    assert 'keyphasor' in capsys.readouterr().err


CHAIN = 'from sa_jitter_ros.commands.chain import main; raise SystemExit(main())'


@pytest.mark.processes
def test_chain_runs_its_nodes_in_one_process(process_environment, tmp_path):
    own = tmp_path / 'own.yaml'  # as launch writes what a launch file gives to `chain`
    own.write_text('/rig/first:\n  ros__parameters:\n    port: 0\n    acquisitions: 7\n')
    process = subprocess.Popen(
        [sys.executable, '-c', CHAIN, '--params', str(MACHINE), '--with', 'live_view',
         'change_monitor',
         '--ros-args', '-r', '__node:=first', '-r', '__ns:=/rig', '--params-file', str(own),
         '-p', 'trigger_cycles:=12'],
        env=process_environment, text=True, stderr=subprocess.PIPE)
    lines = []
    while sum('started' in line for line in lines) < 5:
        lines.append(process.stderr.readline())
        assert lines[-1], ''.join(lines)
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=600)
    assert process.returncode == 0, errors
    text = ''.join(lines)  # -p wins over the section of the node
    assert '[rig.synchronous_averager]: started: averages 12 trigger cycles of input' in text
    for name in ('jitter_predictor', 'residual_analyser', 'live_view', 'change_monitor'):
        assert f'[rig.{name}]: started' in text


@pytest.mark.parametrize(('args', 'expected'), [
    ([], {}),
    (['-p', 'a:=1'], {'a': 1}),
    (['-r', '__node:=mine'], {'trigger_cycles': 30, 'shafts': ['input'], 'b': 3}),
    (['-r', 'synchronous_averager:__node:=mine', '-p', 'mine:b:=4', '-p', 'other:b:=5'],
     {'trigger_cycles': 30, 'b': 4}),
    (['-r', 'other:__node:=mine'], {})])
def test_renamed_node_reads_its_section(tmp_path, args, expected):
    own = tmp_path / 'own.yaml'
    own.write_text('mine:\n  ros__parameters:\n    b: 3\n')
    found = {item.name: item.value for item in given_parameters('synchronous_averager', [
        '--ros-args', '--params-file', str(MACHINE), '--params-file', str(own), *args])}
    assert found.items() >= expected.items()
    assert bool(found) == bool(expected)
    of_process = given_parameters('synchronous_averager', [
        '--ros-args', '--params-file', str(MACHINE), '--params-file', str(own)], ('mine',))
    assert [(item.name, item.value) for item in of_process] == [('b', 3)]  # wins over its own
    assert 'hardware_id' not in found  # of `/**`, which rcl gives to every node


def test_chain_names_the_nodes_that_it_can_add(capsys):
    with pytest.raises(SystemExit) as left:
        chain.main(['--with', 'demo'])
    assert left.value.code == 2
    line, = capsys.readouterr().err.splitlines()
    assert 'live_view' in line


@pytest.mark.parametrize('name', NODES)
def test_a_node_says_what_its_arguments_are(name, capfd, monkeypatch):
    main = import_module(f'sa_jitter_ros.nodes.{name}').main
    monkeypatch.setattr('sys.argv', [name, '--help'])
    assert main() == 0
    assert capfd.readouterr().out.startswith(f'usage: {name} --ros-args [-p NAME:=VALUE]')
    for given, says in {
            ('--params', 'rig.yaml'): 'did you mean --ros-args --params-file rig.yaml?',
            ('-p', 'rate:=12'): 'did you mean --ros-args -p rate:=12?',
            ('--frobnicate',): 'see --help'}.items():
        monkeypatch.setattr('sys.argv', [name, *given])
        assert main() == 2
        assert capfd.readouterr().err == f'error: {" ".join(given)}: is not for a node: {says}\n'
    assert main(['--ros-args', '-q', 'x:=3']) == 2
    assert ("error: ['-q', 'x:=3'] are no arguments of ROS: give -p NAME:=VALUE, --params-file "
            'FILE or -r OLD:=NEW\n') in capfd.readouterr().err


@pytest.mark.parametrize('command', [['--params'], ['--ros-args', '--params-file']])
@pytest.mark.parametrize('kind', ['fifo', 'device'])
def test_parameter_file_without_end_is_refused(tmp_path, capsys, kind, command):
    path = Path('/dev/zero')
    if kind == 'fifo':
        path = tmp_path / 'fifo.yaml'
        os.mkfifo(path)
    assert chain.main([*command, str(path)]) == 2
    assert capsys.readouterr().err == (
        f'error: {path}: is no regular file: give a parameter file (.yaml)\n')


SEGMENT = """
import rclpy
rclpy.init()
node = rclpy.create_node('large')
for line in open('/proc/self/maps'):
    first, last = (int(end, 16) for end in line.split()[0].split('-'))
    if '/dev/shm/fast' in line and '_port' not in line:
        print(last - first)
rclpy.shutdown()
"""


@pytest.mark.processes
@pytest.mark.skipif(os.environ.get('RMW_IMPLEMENTATION', 'rmw_fastrtps_cpp')
                    != 'rmw_fastrtps_cpp', reason='the profile is for Fast DDS')
def test_transport_profile_gives_a_node_more_shared_memory():
    found = []
    for profile in ('', str(CONFIG / 'fastdds.xml')):
        environment = {key: value for key, value in os.environ.items()
                       if key != 'FASTRTPS_DEFAULT_PROFILES_FILE'}
        if profile:
            environment['FASTRTPS_DEFAULT_PROFILES_FILE'] = profile
        done = subprocess.run([sys.executable, '-c', SEGMENT], env=environment, timeout=600,
                              capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        found.append([int(line) for line in done.stdout.split()])
    built_in, given = found
    assert max(built_in) < 2e6
    assert max(given) >= 64 << 20
