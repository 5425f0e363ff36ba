# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The tach detector node publishes the pulses that the library finds, in spite of faults."""

from bench import NodeBench
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
import numpy as np
import pytest
from rclpy.parameter import Parameter
import sa_jitter_ros as sa
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.nodes import messages
from sa_jitter_ros.nodes.base import DIAGNOSTIC_KEYS
from sa_jitter_ros.nodes.synchronous_averager import SynchronousAverager
from sa_jitter_ros.nodes.tach_detector import TachDetector
from sa_jitter_ros.pulses.detection import KeyphasorDetector
from sa_jitter_ros.recordings.message_layouts import encode_time
from sa_jitter_ros.samples import SampleBlock
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

RATE = 5000.0
SPEED = 21.3


def waveform(seconds, speed=SPEED, low=0.2, high=4.8):
    """Return a keyphasor signal (n,) of short pulses with sloping edges."""
    turn = np.arange(int(seconds * RATE)) / RATE * speed % 1.0
    return low + (high - low) * np.clip(8.0 - 200.0 * np.abs(turn - 0.3), 0.0, 1.0)


@pytest.fixture
def bench(ros_graph):
    """Return a maker of benches around the detector."""
    def make(**parameters):
        kind = messages.SAMPLE_TYPES[
            parameters.get('vibration_type', 'std_msgs/Float64MultiArray')]
        pulse = messages.PULSE_TYPES[parameters.get('tach_type', 'sensor_msgs/TimeReference')]
        return NodeBench(ros_graph, TachDetector, inputs={'tach_waveform': kind},
                         outputs={'tach_pulse': pulse}, **parameters)
    return make


def play(b, samples, *, size=250, start=0.0, index=0, skip=(),
         encode=messages.encode_samples):
    """Publish a waveform in blocks, except those in `skip`."""
    for number, first in enumerate(range(0, len(samples), size)):
        if number not in skip:
            b.send('tach_waveform', encode(SampleBlock(
                samples[None, first:first + size], start + first / RATE, RATE, index + first)))
    b.settle()
    assert b.spin(lambda: not b.node._waiting)  # pulses found at once are sent in portions
    b.settle()


def pulses(b):
    """Return the pulse times received."""
    found = b.received['tach_pulse']
    if found and hasattr(found[0], 'time_ref'):
        return np.array([messages.decode_pulse_reference(item)[0][0] for item in found])
    return np.concatenate([messages.decode_pulse_array(item) for item in found] or [[]])


@pytest.mark.parametrize('tach_type', ['sensor_msgs/TimeReference', 'std_msgs/Float64MultiArray'])
@pytest.mark.parametrize('interpolate', [True, False])
def test_pulses_are_those_of_the_core(bench, tach_type, interpolate):
    b = bench(tach_type=tach_type, interpolate=interpolate, keyphasor='shaft 2')
    samples = waveform(3.0)
    play(b, samples)
    expected = KeyphasorDetector(interpolate=interpolate).update(samples, 0.0, RATE)
    assert len(expected) == 64 == round(3.0 * SPEED + 0.5 - 0.26)
    np.testing.assert_allclose(pulses(b), expected, atol=6e-10)
    if tach_type == 'sensor_msgs/TimeReference':
        assert {item.source for item in b.received['tach_pulse']} == {'shaft 2'}
    if not interpolate:
        np.testing.assert_allclose(pulses(b) * RATE, np.rint(pulses(b) * RATE), atol=1e-5)
    level, text, values = b.diagnostics()
    assert level == DiagnosticStatus.OK
    assert '64 pulses at threshold 2.5' in text
    assert set(DIAGNOSTIC_KEYS) <= values.keys()


@pytest.mark.parametrize('edge', ['rising', 'falling', 'centre'])
@pytest.mark.parametrize('polarity', ['positive', 'negative'])
def test_edge_and_polarity_reach_the_core(bench, edge, polarity):
    b = bench(edge=edge, polarity=polarity)
    samples = waveform(2.0) * (1.0 if polarity == 'positive' else -1.0)
    play(b, samples)
    expected = KeyphasorDetector(edge=edge, polarity=polarity).update(samples, 0.0, RATE)
    np.testing.assert_allclose(pulses(b), expected, atol=6e-10)


def test_spikes_are_counted_and_polarity_is_decided(bench):
    b = bench(polarity='auto')
    samples = -waveform(3.0)
    clean = KeyphasorDetector(polarity='auto').update(samples, 0.0, RATE)
    spoilt = samples.copy()
    spoilt[[4000, 9000, 9001]] = 60.0, -500.0, 500.0
    play(b, spoilt)
    assert len(clean) == 64
    np.testing.assert_allclose(pulses(b), clean, atol=2e-4)
    values = b.diagnostics()[2]
    assert (values['spikes'], values['polarity']) == ('3', 'negative')


def test_given_threshold_needs_no_learning(bench):
    b = bench(automatic_threshold=False, threshold=1, hysteresis=0)
    play(b, waveform(0.3))
    assert len(pulses(b)) == 7
    assert 'at threshold 1' in b.diagnostics()[1]


def test_no_pulse_is_read_across_a_gap(bench):
    b = bench()
    samples = waveform(3.0)
    play(b, samples, skip={30, 31})
    expected = KeyphasorDetector()
    times = [expected.update(samples[:7500], 0.0, RATE),
             expected.update(samples[8000:], 8000 / RATE, RATE)]
    np.testing.assert_allclose(pulses(b), np.concatenate(times), atol=6e-10)
    assert len(pulses(b)) in (60, 61, 62)
    assert b.status()['gaps'] == 1


def test_state_levels_are_learnt_again_after_a_restart(bench):
    b = bench()
    play(b, waveform(2.0))
    before = len(pulses(b))
    play(b, waveform(2.0, low=-30.0, high=-20.0))
    expected = KeyphasorDetector().update(waveform(2.0, low=-30.0, high=-20.0), 0.0, RATE)
    np.testing.assert_allclose(pulses(b)[before:], expected, atol=6e-10)
    status = b.status()
    assert status['restarts'] == 1
    assert status['threshold'] == '-25'


@pytest.mark.parametrize('bad', ['channels', 'nan', 'label', 'repeat'])
def test_bad_block_is_counted_and_the_others_are_used(bench, bad):
    b = bench()
    samples = waveform(3.0)
    blocks = [SampleBlock(samples[None, first:first + 250], first / RATE, RATE, first)
              for first in range(0, len(samples), 250)]
    for number, block in enumerate(blocks):
        message = messages.encode_samples(block)
        if number == 30:
            if bad == 'channels':
                message = messages.encode_samples(SampleBlock(
                    np.tile(block.samples, (2, 1)), block.start_time, RATE, block.index))
            elif bad == 'nan':
                message.data[100] = float('nan')
            elif bad == 'label':
                message.layout.dim[0].label = 'wire'
            else:
                b.send('tach_waveform', message)
        b.send('tach_waveform', message)
    b.settle()
    status = b.status()
    assert status['messages_rejected'] == (bad in ('channels', 'label'))
    assert status['repeats'] == (bad == 'repeat')
    assert status['samples_dropped'] == {'channels': 0, 'nan': 1, 'label': 0, 'repeat': 250}[bad]
    whole = KeyphasorDetector().update(samples, 0.0, RATE)
    near = np.abs(pulses(b)[:, None] - whole).min(axis=1)
    assert near.max() < 6e-10
    assert len(whole) - len(pulses(b)) <= (0 if bad == 'repeat' else 3)


def test_several_channels_are_refused_with_a_reason(bench):
    b = bench()
    b.send('tach_waveform', messages.encode_samples(SampleBlock(np.zeros((3, 9)), 0.0, RATE, 0)))
    level, text, _ = b.diagnostics()
    assert level == DiagnosticStatus.WARN
    assert '3 channels: send only the channel of the keyphasor' in text


def test_float32_waveform_with_header(bench):
    b = bench(vibration_type='std_msgs/Float32MultiArray', sample_rate=RATE, start_time=1.0)
    samples = waveform(2.0).astype(np.float32).astype(np.float64)
    play(b, samples, encode=messages.encode_samples_float32)
    expected = KeyphasorDetector().update(samples, 1.0, RATE)
    np.testing.assert_allclose(pulses(b), expected, atol=6e-10)


def test_parameters_change_while_it_runs(bench):
    b = bench()
    play(b, waveform(1.0))
    assert b.set_parameter('edge', 'falling') == (True, '')
    before = len(pulses(b))
    play(b, waveform(1.5)[5000:], start=1.0, index=5000)
    assert len(pulses(b)) > before
    successful, reason = b.set_parameter('polarity', 'both')
    assert not successful
    assert 'one of positive, negative' in reason
    successful, reason = b.set_parameter('hysteresis', 1.5)
    assert not successful


@pytest.mark.parametrize('factor', [2.0, 1.0 + 1e-10])
def test_state_levels_are_learnt_again_after_a_change_of_rate(bench, factor):
    b = bench()
    play(b, waveform(2.0))
    before = len(pulses(b))
    samples = waveform(4.0)
    for first in range(0, len(samples), 250):
        b.send('tach_waveform', messages.encode_samples(SampleBlock(
            samples[None, first:first + 250], 3.0 + first / (factor * RATE), factor * RATE,
            15000 + first)))
    b.settle()
    assert b.spin(lambda: not b.node._waiting)
    b.settle()
    late = pulses(b)[before:]
    # the first block of another layout may be a fault: only the second starts a new run
    assert len(late) >= len(KeyphasorDetector().update(samples, 0.0, RATE)) - 2
    np.testing.assert_allclose(np.diff(late), 1.0 / SPEED / factor, rtol=1e-3)


def test_new_name_drops_nothing_and_new_options_count_what_they_drop(bench):
    b = bench(minimum_interval=0.05)  # above the period of 0.047 s
    play(b, waveform(2.0))
    dropped = int(b.diagnostics()[2]['pulses_dropped'])
    assert dropped > 10
    assert b.set_parameter('keyphasor', 'another') == (True, '')
    assert int(b.diagnostics()[2]['pulses_dropped']) == dropped
    assert b.set_parameter('minimum_interval', 0.0) == (True, '')
    play(b, waveform(2.2)[10000:], start=2.0, index=10000)  # too short to learn from
    assert int(b.diagnostics()[2]['pulses_dropped']) == dropped
    assert b.set_parameter('edge', 'falling') == (True, '')
    values = b.diagnostics()[2]
    assert int(values['pulses_dropped']) == dropped
    assert int(values['samples_dropped']) == 1000


def test_unusable_parameters_are_refused_at_the_start(ros_graph):
    with pytest.raises(ParameterError, match='edge'):
        ros_graph.add(TachDetector, {'edge': 'up'})


def test_status_says_who_receives_the_pulses(bench, ros_graph):
    assert bench().diagnostics()[2]['subscribers'] == '1'
    alone = ros_graph.add(TachDetector, {'tach_type': 'std_msgs/Float64MultiArray'},
                          namespace='/alone')
    assert alone.summary()[1]['subscribers'] == 0


def test_silence_is_not_a_keyphasor(bench, rng):
    b = bench(minimum_difference=0.5)
    play(b, 0.01 * rng.standard_normal(10000))
    assert len(pulses(b)) == 0
    assert b.diagnostics()[1] == 'learning the state levels'


def test_times_too_large_for_a_reference_are_counted_and_named(bench):
    b = bench()
    play(b, waveform(1.0), start=3.8e9)
    assert len(pulses(b)) == 0
    level, text, values = b.diagnostics()
    assert level == DiagnosticStatus.WARN
    assert 'std_msgs/Float64MultiArray' in text
    found = KeyphasorDetector().update(waveform(1.0), 0.0, RATE)
    assert int(values['pulses_dropped']) == len(found)


TURN = 2.0 * np.pi


# --- joints -------------------------------------------------------------------------------------

def joint_state(time, **positions):
    """Return a message with the positions (rad) of joints."""
    message = JointState(name=list(positions), position=list(positions.values()))
    message.header.stamp.sec, message.header.stamp.nanosec = encode_time(time)
    return message


@pytest.mark.machines
def test_joint_gives_corrected_orders(ros_graph, rng):
    """From positions at 1 kHz, of 14 bits and with noisy stamps, to the true amplitudes."""
    speed, rate, seconds, stamp, cycles = 20.0, 4000.0, 1.4, 1e-4, 24
    ros_graph.add(TachDetector, parameter_overrides=[
        Parameter('tach_waveform_type', value='sensor_msgs/JointState'),
        Parameter('joint', value='wrist')])
    ros_graph.add(SynchronousAverager, parameter_overrides=[
        Parameter('trigger_cycles', value=cycles), Parameter('shaft.orders', value=[19.0, 38.0]),
        Parameter('correct_jitter', value=True),
        Parameter('keyphasor_rate', value=1.0 / (np.sqrt(12.0) * stamp))])
    amplitudes = ros_graph.capture('shaft/order_amplitude', Float64MultiArray)
    status = ros_graph.capture('/diagnostics', DiagnosticArray)
    joints = ros_graph.publisher('tach_waveform', JointState)
    vibration = ros_graph.publisher('vibration', Float64MultiArray)
    for start in np.arange(0.0, seconds, 0.1):
        time = start + np.arange(round(0.1 * rate)) / rate
        samples = (np.cos(TURN * 19.0 * speed * time) + 0.5 * np.cos(TURN * 38.0 * speed * time)
                   + rng.normal(0.0, 0.1, time.size))
        vibration.publish(messages.encode_samples(SampleBlock(
            samples[None], start, rate, round(start * rate))))
        for instant in start + np.arange(100) / 1e3:
            angle = TURN * np.rint(speed * instant * 2.0**14) / 2.0**14
            joints.publish(joint_state(instant + rng.normal(0.0, stamp), elbow=0.3,
                                       wrist=(angle + np.pi) % TURN - np.pi))
        ros_graph.settle()
    assert ros_graph.spin(lambda: amplitudes)
    table = messages.decode_average('order_amplitude', amplitudes[0]).values[0]
    np.testing.assert_allclose(table[:, 3], (1.0, 0.5), rtol=0.02)
    status.clear()
    assert ros_graph.spin(lambda: any(
        item.status[0].name == 'tach_detector' for item in status))
    values = {item.key: item.value for item in next(
        each.status[0] for each in status if each.status[0].name == 'tach_detector').values}
    assert float(values['stamp_noise_std']) == pytest.approx(stamp, rel=0.3)
    assert values['joint'] == 'wrist'
    # Declared as the node shows it, the error predicts what the raw amplitudes lose.
    predicted = sa.predict(
        keyphasor_rate=1e3, trigger_speed=speed, trigger_cycles=cycles, orders=[19.0, 38.0],
        jitter_distribution='normal', jitter_std=float(values['pulse_error_std']))
    scatter = np.hypot(predicted.standard_deviation, table[:, 6])
    assert np.all(np.abs(table[:, 5] - predicted.mean_attenuation) < 3.0 * scatter)
    assert predicted.mean_attenuation[1] < 0.98


@pytest.mark.machines
@pytest.mark.parametrize('kind', ['zeros', 'overflow', 'jump'])
def test_joint_with_glitches_overflows_and_jumps_gives_every_pulse(ros_graph, kind):
    """14 pulses of 7.3 Hz, 2 s at 500 Hz, as without what is wrong."""
    node = ros_graph.add(TachDetector, parameter_overrides=[
        Parameter('tach_waveform_type', value='sensor_msgs/JointState'),
        Parameter('tach_type', value='std_msgs/Float64MultiArray')])
    found = ros_graph.capture('tach_pulse', Float64MultiArray)
    status = ros_graph.capture('/diagnostics', DiagnosticArray)
    publisher = ros_graph.publisher('tach_waveform', JointState)
    time = np.arange(1000) / 500.0
    angle = TURN * (7.3 * time + 0.1)
    counts = {'glitches': '0', 'restarts': '0', 'reversals': '0', 'samples_dropped': '0'}
    if kind == 'zeros':
        angle %= TURN
        angle[[317, 400, 650, 751, 901]] = 0.0
        counts['glitches'] = '5'
    elif kind == 'overflow':
        angle = np.floor(angle * 2400 / TURN) % 2**14 * TURN / 2400
    else:
        angle[500:] += 12.2 * TURN
        counts['restarts'] = '1'
    for number, (instant, position) in enumerate(zip(time, angle)):
        publisher.publish(joint_state(instant, wrist=position))
        if number % 100 == 99:
            ros_graph.settle()
    assert ros_graph.spin(lambda: node._joint.crossings.state.samples == 1000)
    ros_graph.settle()
    pulses = np.concatenate([messages.decode_pulse_array(item) for item in found])
    assert pulses.size == pytest.approx(14, abs=1 if kind == 'jump' else 0)
    if kind != 'jump':
        np.testing.assert_allclose(pulses, (np.arange(1, 15) - 0.1) / 7.3, rtol=0, atol=1e-3)
    status.clear()
    assert ros_graph.spin(lambda: status)
    values = {item.key: item.value for item in status[0].status[0].values}
    assert {key: values[key] for key in counts} == counts


def test_joint_is_named_where_it_is_missing(ros_graph):
    node = ros_graph.add(TachDetector, parameter_overrides=[
        Parameter('tach_waveform_type', value='sensor_msgs/msg/JointState')])
    publisher = ros_graph.publisher('tach_waveform', JointState)
    publisher.publish(joint_state(0.0, elbow=0.3, wrist=0.2))
    assert ros_graph.spin(lambda: node.counts['messages_rejected'] == 1)
    assert 'joint is empty, and the message has 2 joints (elbow, wrist)' in node._last_warning
    publisher.publish(joint_state(0.0, wrist=0.2))
    assert ros_graph.spin(lambda: node._joint.joint == 'wrist')
    publisher.publish(joint_state(0.1, elbow=0.3))
    assert ros_graph.spin(lambda: node._joint.others == 1)
    assert node.summary()[0] == 'joint wrist has not passed a mark yet: does it turn?'
    publisher.publish(JointState(name=['wrist']))
    assert ros_graph.spin(lambda: node.counts['messages_rejected'] == 2)
    assert '0 positions for 1 joints' in node._last_warning


def test_waveform_type_replaces_that_of_the_vibration(ros_graph):
    node = ros_graph.add(TachDetector, parameter_overrides=[
        Parameter('tach_waveform_type', value='std_msgs/Float32MultiArray'),
        Parameter('sample_rate', value=1e3)])
    assert node._samples.message_type.__name__ == 'Float32MultiArray'
    with pytest.raises(ParameterError, match=r'tach_waveform_type is .sensor_msgs/Joy.'):
        ros_graph.add(TachDetector, parameter_overrides=[
            Parameter('tach_waveform_type', value='sensor_msgs/Joy')])
