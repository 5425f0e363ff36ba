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
Start everything that a machine needs: averager, predictor, analyser, and what `with` names.

    ros2 launch sa_jitter_ros monitor.launch.py with:=monitor,live_view,simulator

All ends when the process of averager, predictor and analyser does.
"""

import json
import os
from pathlib import Path

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction, Shutdown
from launch_ros.actions import Node

# What `with` takes: nodes that run in the process of `chain`, and the simulator beside it.
IN_CHAIN = {'monitor': 'change_monitor', 'live_view': 'live_view', 'detector': 'tach_detector'}
SIMULATOR = 'simulator'
SHIPPED = Path(__file__).resolve().parents[1] / 'config' / 'machine.yaml'


def generate_launch_description() -> LaunchDescription:
    """Return the arguments, and the processes that they ask for."""
    return LaunchDescription([
        DeclareLaunchArgument('params', default_value='', description=(
            'machine file of all nodes; empty: their defaults, or that of the simulated gearbox')),
        DeclareLaunchArgument('namespace', default_value='', description='of all nodes'),
        DeclareLaunchArgument('with', default_value='monitor', description=(
            f'what runs beside averager, predictor and analyser, separated by commas: '
            f'{", ".join((*IN_CHAIN, SIMULATOR))}')),
        DeclareLaunchArgument('recording', default_value='', description=(
            'file that is played as the source; empty: your sensors, or the simulator')),
        DeclareLaunchArgument('use_sim_time', default_value='false', description=(
            'true: stamps of the nodes are those of /clock')),
        OpaqueFunction(function=processes)])


def processes(context: LaunchContext) -> list[Node]:
    """Return the processes for the arguments; raises RuntimeError for wrong ones."""
    given = context.launch_configurations
    recording, params = (os.path.expanduser(given[name]) for name in ('recording', 'params'))
    chosen = list(filter(None, map(str.strip, given['with'].split(','))))
    unknown = [name for name in chosen if name not in (*IN_CHAIN, SIMULATOR)]
    if unknown:
        raise RuntimeError(f'with:={given["with"]}: {", ".join(unknown)} is none of '
                           f'{", ".join((*IN_CHAIN, SIMULATOR))}')
    if recording and SIMULATOR in chosen:
        raise RuntimeError('both a recording and the simulator would publish: leave out one')
    if not params and SIMULATOR in chosen:
        params = str(SHIPPED)
    if params and not Path(params).is_file():
        raise RuntimeError(f'params:={params}: no such file')
    if recording and not Path(recording).exists():  # a bag is a folder
        raise RuntimeError(f'recording:={recording}: no such file or folder')
    file = ['--params-file', params] if params else []
    if given['use_sim_time'] != 'false':
        file += ['-p', f'use_sim_time:={given["use_sim_time"]}']
    tach = ['-p', 'tach:=waveform'] if 'detector' in chosen else []
    added = [IN_CHAIN[name] for name in chosen if name in IN_CHAIN]

    def process(executable: str, *ros_arguments: str, arguments: tuple[str, ...] = ()) -> Node:
        return Node(package='sa_jitter_ros', executable=executable, namespace=given['namespace'],
                    arguments=list(arguments), ros_arguments=[*file, *ros_arguments],
                    output='screen', on_exit=Shutdown() if executable == 'chain' else None)

    found = [process('chain', arguments=('--with', *added) if added else ())]
    if recording:
        found.append(process('recording_player', '-p', f'recording:={json.dumps(recording)}',
                             *tach))
    elif SIMULATOR in chosen:
        found.append(process('machine_simulator', *tach))
    return found
