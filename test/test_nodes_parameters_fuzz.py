# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Random parameters: a node refuses them with a reason or works with them."""

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from rclpy.exceptions import InvalidParameterValueException
from rclpy.parameter import Parameter
from sa_jitter_ros.errors import SaJitterError
from sa_jitter_ros.nodes import messages
from sa_jitter_ros.nodes.change_monitor import ChangeMonitor
from sa_jitter_ros.nodes.jitter_predictor import JitterPredictor
from sa_jitter_ros.nodes.live_view import LiveView
from sa_jitter_ros.nodes.machine_simulator import MachineSimulator
from sa_jitter_ros.nodes.recording_player import RecordingPlayer
from sa_jitter_ros.nodes.residual_analyser import ResidualAnalyser
from sa_jitter_ros.nodes.synchronous_averager import SynchronousAverager
from sa_jitter_ros.nodes.tach_detector import TachDetector
from sa_jitter_ros.samples import SampleBlock
from std_msgs.msg import Float64

NUMBERS = st.one_of(st.sampled_from([0.0, -1.0, 1e-9, 1e-3, 0.5, 1.0, 2.0, 1e3, 1e6, 1e9, 1e15]),
                    st.floats())
WHOLE = st.one_of(st.integers(-2, 100), st.sampled_from([1000, 2**31, 2**63 - 1, -2**63]))
TEXTS = st.one_of(
    st.sampled_from(['', 'shaft', 'x', '0', 'a b', '/', 'a__b', 'sampled', 'table', 'linear']),
    st.text(max_size=5).filter(lambda text: '\0' not in text))
KINDS = {float: NUMBERS, int: WHOLE, str: TEXTS, bool: st.booleans()}
ANY = st.one_of(*KINDS.values(), *(st.lists(kind, max_size=4) for kind in (NUMBERS, WHOLE, TEXTS)))


def values_for(value):
    """Return values like one of a parameter, and some that are not."""
    listed = isinstance(value, list)
    kind = KINDS[type((value or [0.0])[0] if listed else value)]
    return st.one_of(st.lists(kind, max_size=4) if listed else kind, ANY)


@pytest.fixture(scope='module')
def recording(tmp_path_factory):
    """Return the path of a short recording."""
    path = tmp_path_factory.mktemp('recording') / 'rig.npz'
    np.savez(path, vibration=np.ones((2, 500)), sample_rate=1000.0,
             pulse_times=np.linspace(0.0, 0.5, 11))
    return str(path)


def vibration():
    """Return half a second of vibration."""
    samples = np.sin(np.arange(500.0))[None]
    return messages.encode_samples(SampleBlock(samples, 0.0, 1000.0, 0))


def signals(node):
    """Send messages to all inputs of the node, and call its timer."""
    callbacks = {item.topic_name.lstrip('/'): item.callback for item in node.subscriptions}
    if 'tach_waveform' in callbacks:
        callbacks['tach_waveform'](vibration())
    if 'vibration' in callbacks:
        for time in np.arange(1.0, 12.0) * 0.04:
            callbacks['tach_pulse'](messages.encode_pulse_reference(time, 'kp'))
        callbacks['vibration'](vibration())
    if 'shaft_speed' in callbacks:
        callbacks['shaft_speed'](Float64(data=30.0))
    node.publish_diagnostics()


# Node and what it needs.
NODES = {
    'averager': (SynchronousAverager, {'trigger_cycles': 2, 'correct_jitter': True}),
    'detector': (TachDetector, {'learning_time': 0.05}),
    'predictor': (JitterPredictor, {}),
    'analyser': (ResidualAnalyser, {}),
    'simulator': (MachineSimulator, {'playing': False}),
    'player': (RecordingPlayer, {'playing': False}),
    'monitor': (ChangeMonitor, {}),
    'view': (LiveView, {'port': 0}),
}


@pytest.mark.machines
@pytest.mark.parametrize('name', NODES)
def test_any_parameters_are_refused_or_used(ros_graph, recording, name, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)  # of files with a random relative name
    node_class, needed = NODES[name]
    if name == 'player':
        needed = {**needed, 'recording': recording}

    def make(overrides):
        return node_class(context=ros_graph.context, parameter_overrides=[
            Parameter(key, value=value) for key, value in overrides.items()])

    node = make(needed)
    some = st.lists(st.one_of([
        st.tuples(st.just(key), values_for(value))
        for key, value in sorted(node.parameters.values().items())]), max_size=3).map(dict)
    node.destroy_node()

    @settings(max_examples=16)
    @given(some, st.lists(some, max_size=3))
    def use(first, later):
        try:
            node = make({**needed, **first})
        except (SaJitterError, InvalidParameterValueException) as error:
            refused = str(error)
        else:
            refused = ''
            signals(node)
            for change in later:
                node.set_parameters_atomically([
                    Parameter(key, value=value) for key, value in change.items()])
                signals(node)
            node.destroy_node()
        assert '\n' not in refused

    use()
