# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Random messages: decoders raise nothing except MessageError, and no node stops."""

from contextlib import suppress
import math

from hypothesis import example, given, settings
from hypothesis import strategies as st
import pytest
from rclpy.parameter import Parameter
from sa_jitter_ros.errors import MessageError
from sa_jitter_ros.nodes import messages
from sa_jitter_ros.nodes.change_monitor import ChangeMonitor
from sa_jitter_ros.nodes.jitter_predictor import JitterPredictor
from sa_jitter_ros.nodes.live_view import LiveView
from sa_jitter_ros.nodes.residual_analyser import ResidualAnalyser
from sa_jitter_ros.nodes.synchronous_averager import SynchronousAverager
from sa_jitter_ros.nodes.tach_detector import TachDetector
from sensor_msgs.msg import Imu, TimeReference
from std_msgs.msg import Float32MultiArray, Float64, Float64MultiArray, MultiArrayDimension, String

LARGEST = 2**32 - 1
NUMBERS = st.one_of(st.sampled_from([0.0, 1.0, 2.0, 25.0, -1.0, math.nan, math.inf, -math.inf,
                                     1e308, -1e308, 5e-324, 2.0**53, 2.0**63, 1e18]), st.floats())
LABELS = st.sampled_from([
    'channel', 'sample', 'pulse', 'order', 'angle', '', 'field:', 'x:y', 'indicator:a,b',
    f'field:{",".join(messages.AMPLITUDE_FIELDS)}', f'field:{",".join(messages.RESIDUAL_FIELDS)}',
    f'field:{",".join(messages.PREDICTION_FIELDS)}',
    f'field:{",".join(messages.PULSE_ERROR_FIELDS)}'])
SIZES = st.sampled_from([0, 1, 2, 3, 6, 7, 8, 2**31, LARGEST])
LABELLED = [('channel', 'sample'), ('channel', 'angle'), ('channel', 'order', 'field'),
            ('pulse', 'field'), ('channel', 'indicator'), ('order', 'field'), ('pulse',)]


def filled(message, offset, dims, data):
    """Return a message with this layout and data, limited to the range of float32."""
    message.layout.data_offset = offset
    message.layout.dim = [MultiArrayDimension(label=label, size=size, stride=size)
                          for label, size in dims]
    single = isinstance(message, Float32MultiArray)
    message.data = [math.copysign(3e38, item) if single and 3.4e38 < abs(item) < math.inf else item
                    for item in data]
    return message


@st.composite
def contents(draw):
    """Return offset, dimensions and data, often such that they fit each other."""
    labels = draw(st.one_of(st.sampled_from(LABELLED), st.lists(LABELS, max_size=4)))
    dims = [(label, draw(SIZES)) for label in labels]
    offset = draw(st.sampled_from([0, 2, 3, 4, 6, LARGEST]))
    size = offset + math.prod(size for _, size in dims)
    if size > 500 or draw(st.integers(0, 4)) == 0:
        size = draw(st.integers(0, 20))
    return offset, dims, draw(st.lists(NUMBERS, min_size=size, max_size=size))


# Sizes whose product is 0, though no array can have them.
IMPOSSIBLE = (6, [('channel', 0), ('order', LARGEST), ('field', LARGEST)], [1.0] * 6)
DECODERS = {
    **{kind: lambda message, kind=kind: messages.decode_average(kind, message) for kind in (
        'synchronous_average', 'order_amplitude', 'pulse_error', 'condition_indicator')},
    'prediction': messages.decode_prediction, 'residual': messages.decode_residual,
    'pulse array': messages.decode_pulse_array}


@settings(max_examples=150)
@given(contents())
@example(IMPOSSIBLE)
def test_any_array_is_decoded_or_refused(content):
    for decode in DECODERS.values():
        with suppress(MessageError):
            decode(filled(Float64MultiArray(), *content))


@settings(max_examples=150)
@given(st.lists(contents(), min_size=1, max_size=4), st.sampled_from([0.0, 100.0, 1e308]))
@example([(2, [], [2.0**53, 2.0**53, 1.0])], 100.0)
def test_any_samples_are_decoded_or_refused(blocks, rate):
    for kind, message in (('std_msgs/Float64MultiArray', Float64MultiArray),
                          ('std_msgs/Float32MultiArray', Float32MultiArray)):
        decoder = messages.SampleDecoder(kind, sample_rate=rate)
        for content in blocks:
            with suppress(MessageError):
                block = decoder.decode(filled(message(), *content))
                assert block.samples.ndim == 2
                assert math.isfinite(block.start_time)
                assert 0 <= block.end_index <= 2**54


STAMPS = st.tuples(st.sampled_from([-2**31, -1, 0, 1, 2, 2**31 - 1]),
                   st.sampled_from([0, 1, 999_999_999, LARGEST]))


def imu(stamp, value):
    """Return an Imu message."""
    message = Imu()
    message.header.stamp.sec, message.header.stamp.nanosec = stamp
    message.linear_acceleration.z = value
    return message


def pulse(stamp, source):
    """Return a pulse."""
    message = TimeReference(source=source)
    message.time_ref.sec, message.time_ref.nanosec = stamp
    return message


TEXTS = st.one_of(
    st.text(max_size=40).filter(lambda text: '\0' not in text),
    st.sampled_from(['{}', '[1]', '{"lines": [{"order": "x"}]}', '{"verdict": 3}', '1e999',
                     '{"missing_effects": [{"parameters": {"a": 1}}]}', 'NaN']))
ARRAY = contents().map(lambda content: filled(Float64MultiArray(), *content))
ARRAY32 = contents().map(lambda content: filled(Float32MultiArray(), *content))
IMU = st.builds(imu, STAMPS, NUMBERS)
PULSE = st.builds(pulse, STAMPS, st.sampled_from(['', 'kp']))
SPEED = st.builds(Float64, data=NUMBERS)
SINGLE = 'std_msgs/Float32MultiArray'
NODES = {
    'averager': (SynchronousAverager, {'trigger_cycles': 2, 'correct_jitter': True},
                 {'vibration': ARRAY, 'tach_pulse': PULSE}),
    'averager of arrays': (
        SynchronousAverager, {'vibration_type': SINGLE, 'sample_rate': 100.0,
                              'tach_type': 'std_msgs/Float64MultiArray', 'trigger_cycles': 1},
        {'vibration': ARRAY32, 'tach_pulse': ARRAY}),
    'averager of imu': (SynchronousAverager, {'vibration_type': 'sensor_msgs/Imu',
                                              'sample_rate': 1e9, 'trigger_cycles': 1},
                        {'vibration': IMU, 'tach_pulse': PULSE}),
    'detector': (TachDetector, {'learning_time': 0.01}, {'tach_waveform': ARRAY}),
    'predictor': (JitterPredictor, {'follow_shaft_speed': True}, {'shaft_speed': SPEED}),
    'analyser': (ResidualAnalyser, {'acquisitions': 2}, {
        'shaft/order_amplitude': ARRAY, 'shaft/pulse_error': ARRAY, 'prediction': ARRAY}),
    'monitor': (ChangeMonitor, {'learning_averages': 8, 'group_averages': 1,
                                'baseline_file': 'none'}, {
        'shaft/order_amplitude': ARRAY, 'shaft/condition_indicator': ARRAY,
        'shaft/condition_indicator_error': ARRAY}),
    'view': (LiveView, {'port': 0}, {
        'shaft/synchronous_average': ARRAY, 'shaft/order_amplitude': ARRAY,
        'shaft/pulse_error': ARRAY, 'prediction': ARRAY, 'residual': ARRAY,
        'shaft_speed': SPEED, 'missing_effect': st.builds(String, data=TEXTS)}),
}


@pytest.mark.machines
@pytest.mark.parametrize('name', NODES)
def test_no_message_ends_a_node(ros_graph, name):
    node_class, parameters, inputs = NODES[name]
    node = node_class(context=ros_graph.context, parameter_overrides=[
        Parameter(key, value=value) for key, value in parameters.items()])
    callbacks = {item.topic_name.lstrip('/'): item.callback for item in node.subscriptions}
    assert inputs.keys() <= callbacks.keys()
    stream = st.one_of([st.tuples(st.just(topic), kind) for topic, kind in inputs.items()])

    @settings(max_examples=40)
    @given(st.lists(stream, max_size=8))
    def receive(sequence):
        for topic, message in sequence:
            callbacks[topic](message)
        for timer in node.timers:
            timer.callback()

    receive()
    node.destroy_node()
