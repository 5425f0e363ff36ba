# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The parameter files and the transport profile of the package start its nodes."""

import os
from pathlib import Path
import subprocess
import sys

import pytest
from rclpy.context import Context
from sa_jitter_ros.nodes.jitter_predictor import JitterPredictor
from sa_jitter_ros.nodes.machine_simulator import MachineSimulator
from sa_jitter_ros.nodes.residual_analyser import ResidualAnalyser
from sa_jitter_ros.nodes.synchronous_averager import SynchronousAverager
from sa_jitter_ros.nodes.tach_detector import TachDetector
import yaml

CONFIG = Path(__file__).resolve().parents[1] / 'config'
NODES = {'jitter_predictor': JitterPredictor, 'machine_simulator': MachineSimulator,
         'residual_analyser': ResidualAnalyser, 'synchronous_averager': SynchronousAverager,
         'tach_detector': TachDetector}


def flat(parameters, prefix=''):
    """Return parameters by their full name."""
    result = {}
    for key, value in parameters.items():
        result.update(flat(value, f'{prefix}{key}.') if isinstance(value, dict)
                      else {f'{prefix}{key}': value})
    return result


@pytest.mark.parametrize('name', NODES)
def test_parameter_file_starts_its_node_and_every_entry_counts(name):
    path = CONFIG / f'{name}.yaml'
    given = flat(yaml.safe_load(path.read_text())['/**']['ros__parameters'])
    context = Context()
    context.init(args=['--ros-args', '--params-file', str(path)])
    try:
        node = NODES[name](context=context)
        for key, value in given.items():
            assert node.get_parameter(key).value == value
        node.destroy_node()
    finally:
        context.try_shutdown()


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
