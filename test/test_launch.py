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
The launch file, with stand-ins for `launch` and `launch_ros`, which have no wheels.

Where they are installed the file is loaded with them, too.
"""

from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
import sys
from types import ModuleType, SimpleNamespace

import pytest

ROOT = Path(__file__).resolve().parents[1]
FILE = ROOT / 'launch' / 'monitor.launch.py'
MACHINE = str(ROOT / 'config' / 'machine.yaml')
ARGUMENTS = {'params': '', 'namespace': '', 'with': 'monitor', 'recording': '',
             'use_sim_time': 'false'}


def load():
    """Return the launch file as a module."""
    spec = spec_from_file_location('monitor_launch', FILE)
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def processes(monkeypatch):
    """Return a function of arguments that returns the processes, as the launch file has them."""
    for name, parts in {
            'launch': {'LaunchContext': None, 'LaunchDescription': list},
            'launch.actions': {
                'DeclareLaunchArgument': lambda name, **options: (name, options['default_value']),
                'OpaqueFunction': lambda function: function, 'Shutdown': lambda: 'shutdown'},
            'launch_ros': {}, 'launch_ros.actions': {
                'Node': lambda **options: SimpleNamespace(**options)}}.items():
        module = ModuleType(name)
        vars(module).update(parts)
        monkeypatch.setitem(sys.modules, name, module)
    *arguments, function = load().generate_launch_description()
    assert dict(arguments) == ARGUMENTS
    return lambda **given: function(SimpleNamespace(
        launch_configurations={**ARGUMENTS, **given}))


def test_chain_is_started_with_what_is_asked_for(processes):
    chain, simulator = processes(namespace='/rig', **{
        'with': 'monitor, live_view,detector,simulator'})
    assert chain.executable == 'chain'
    assert chain.arguments == ['--with', 'change_monitor', 'live_view', 'tach_detector']
    assert chain.ros_arguments == ['--params-file', MACHINE]
    assert simulator.executable == 'machine_simulator'
    assert simulator.ros_arguments == ['--params-file', MACHINE, '-p', 'tach:=waveform']
    assert chain.namespace == simulator.namespace == '/rig'
    assert (chain.on_exit, simulator.on_exit) == ('shutdown', None)


def test_recording_is_the_source(processes, tmp_path):
    recording = tmp_path / 'a: b.npz'
    recording.touch()
    chain, player = processes(params=MACHINE, recording=str(recording))
    assert chain.arguments == ['--with', 'change_monitor']
    assert player.executable == 'recording_player'
    assert player.ros_arguments[-1] == f'recording:="{recording}"'
    alone, = processes(**{'with': ''})
    assert (alone.arguments, alone.ros_arguments) == ([], [])


def test_a_home_is_found_and_a_simulated_clock_is_for_all(processes, monkeypatch, tmp_path):
    (tmp_path / 'rig.yaml').touch()
    monkeypatch.setenv('HOME', str(tmp_path))
    for process in processes(params='~/rig.yaml', recording='~/', use_sim_time='true'):
        assert process.ros_arguments[:4] == [
            '--params-file', str(tmp_path / 'rig.yaml'), '-p', 'use_sim_time:=true']
    assert process.ros_arguments[-1] == f'recording:="{tmp_path}/"'


@pytest.mark.parametrize(('given', 'line'), [
    ({'with': 'monitr'}, 'with:=monitr: monitr is none of monitor, live_view, detector'),
    ({'params': '/none.yaml'}, 'params:=/none.yaml: no such file'),
    ({'params': '/tmp'}, 'params:=/tmp: no such file'),
    ({'recording': '/none.npz'}, 'recording:=/none.npz: no such file'),
    ({'recording': MACHINE, 'with': 'simulator'}, 'leave out one')])
def test_wrong_arguments_are_refused(processes, given, line):
    with pytest.raises(RuntimeError, match=line):
        processes(**given)


@pytest.mark.skipif(find_spec('launch_ros') is None, reason='launch_ros is not installed')
def test_launch_takes_the_file():
    names = [item.name for item in load().generate_launch_description().entities[:-1]]
    assert names == [*ARGUMENTS]
