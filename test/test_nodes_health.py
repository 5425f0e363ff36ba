# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""What nodes say of silent inputs, of several publishers, and of what the user does not get."""

import math
import socket
from types import SimpleNamespace

from bench import AveragerBench, NodeBench, SteadyClock
from diagnostic_msgs.msg import DiagnosticStatus
from machine import Machine
import numpy as np
import pytest
from rclpy.parameter import Parameter
from sa_jitter_ros.nodes import base, health, messages
from sa_jitter_ros.nodes.base import DIAGNOSTIC_KEYS, INPUT_QOS, RESULT_QOS
from sa_jitter_ros.nodes.health import Flow, Health, Level
from sa_jitter_ros.nodes.jitter_predictor import JitterPredictor
from sa_jitter_ros.nodes.live_view import LiveView
from sa_jitter_ros.nodes.machine_simulator import MachineSimulator
from sa_jitter_ros.nodes.residual_analyser import ResidualAnalyser
from sa_jitter_ros.nodes.tach_detector import TachDetector
from sa_jitter_ros.samples import SampleBlock
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
MACHINE = Machine()


@pytest.fixture
def clock(monkeypatch):
    """Return the steady clock of all flows, which a test moves."""
    clock = SteadyClock()
    monkeypatch.setattr(health, 'time', clock)
    return clock


@pytest.fixture
def averager(ros_graph, clock):
    """Return a bench of an averager that waits 5 s for its inputs."""
    return AveragerBench(ros_graph, trigger_cycles=10, shaft__orders=[1.0, 7.0], stale_after=5.0)


def test_silence_is_a_warning_then_an_error_and_ends(clock):
    flow = Flow('pulse', '/tach_pulse', 'look at the keyphasor')
    assert (flow.level(5.0), math.isnan(flow.age)) == (Level.OK, True)
    clock.now += 5.1
    assert flow.level(5.0) == Level.WARN
    assert flow.problem() == 'no /tach_pulse since the start 5 s ago: look at the keyphasor'
    clock.now += 10.0
    assert (flow.level(5.0), flow.level(0.0)) == (Level.ERROR, Level.OK)
    flow.came()
    clock.now += 5.1
    assert flow.problem() == 'no /tach_pulse for 5 s: look at the keyphasor'
    flow.allowance = 2.0
    assert flow.level(5.0) == Level.OK


def test_log_has_a_line_for_each_change_only(clock):
    flows = Health()
    vibration = flows.add(Flow('vibration', '/vibration', 'look'))
    average = flows.add(Flow('average', 'average', 'look', after=('vibration',)))
    seen = []
    for came in (False, False, False, False, True, True, False, True):
        clock.now += 6.0
        if came:
            vibration.came()
            average.came()
        silent = flows.silent(5.0)
        assert 'average' not in {flow.name for _, flow in silent}
        seen.append([(level, line.partition(' since')[0].partition(' for')[0])
                     for level, line in flows.changes(silent)])
    assert seen == [
        [(Level.WARN, 'no /vibration')], [], [(Level.ERROR, 'no /vibration')], [],
        [(Level.OK, 'data flow: /vibration')], [], [(Level.WARN, 'no /vibration')],
        [(Level.OK, '/vibration continues')]]


def test_averager_names_the_input_that_is_cut(averager, clock, capfd):
    b = averager
    assert b.diagnostics()[0] == OK
    clock.now += 6.0
    level, text, values = b.diagnostics()
    assert level == WARN
    assert '/vibration since the start 6 s ago: /test publishes nothing' in text
    assert (values['vibration_age'], values['average_age']) == ('nan', 'nan')
    b.play(MACHINE, 1.0)
    b.diagnostics()
    level, text, values = b.diagnostics()
    assert (level, text) == (OK, f'{values["averages"]} averages of 33 trigger cycles')
    assert (values['vibration_age'], values['pulse_age'], values['average_age']) == (
        '0.0', '0.0', '0.0')
    for seconds, expected in ((6.0, WARN), (10.0, ERROR)):  # the keyphasor is unplugged
        clock.now += seconds
        b.send('vibration', messages.encode_samples(MACHINE.block(12800, 64)))
        level, text, values = b.diagnostics()
        assert level == expected
        assert text.startswith('no /tach_pulse for')
        assert 'does the shaft turn? look at keyphasor' in text
        assert values['vibration_age'] == '0.0'
    b.send_pulses([1.1])
    text = b.diagnostics()[1]
    assert '/tach_pulse' not in text
    assert 'no average' not in text  # it could not come before
    clock.now += 6.0  # the acquisition is switched off
    b.send_pulses([1.13])
    level, text, _ = b.diagnostics()
    assert (level, text.partition(':')[0]) == (WARN, 'no /vibration for 6 s')
    log = capfd.readouterr().err
    for line in ('no /vibration since', 'data flow: /vibration, /tach_pulse',
                 '[ERROR]', '/tach_pulse continues', 'no /vibration for 6 s'):
        assert line in log


def test_inputs_that_flow_without_averages_are_named(averager, clock):
    b = averager
    b.play(MACHINE, 0.1)
    assert b.diagnostics()[0] == OK
    for _ in range(7):
        clock.now += 1.0
        b.send('vibration', messages.encode_samples(MACHINE.block(1280, 64)))
        b.send_pulses([1e4])  # on another clock
        level, text, _ = b.diagnostics()
    assert level == WARN
    assert text.startswith('no average for 7 s: ')


def test_node_says_that_nobody_publishes_or_another_type(ros_graph, clock, monkeypatch):
    b = NodeBench(ros_graph, TachDetector, inputs={}, outputs={}, stale_after=5.0)
    clock.now += 6.0
    assert 'nobody publishes it: start its source' in b.diagnostics()[1]
    # one DDS participant cannot have two types on a topic
    monkeypatch.setattr(b.node, 'get_publishers_info_by_topic', lambda topic: [SimpleNamespace(
        node_name='imu', node_namespace='/', topic_type='sensor_msgs/msg/Imu')])
    assert ('it is published as sensor_msgs/msg/Imu, this node takes '
            'std_msgs/msg/Float64MultiArray' in b.diagnostics()[1])


def test_detector_that_finds_no_pulse_says_so(ros_graph, clock):
    b = NodeBench(ros_graph, TachDetector, inputs={'tach_waveform': Float64MultiArray},
                  outputs={}, stale_after=5.0)
    for number in range(7):
        clock.now += 1.0
        b.send('tach_waveform', messages.encode_samples(
            SampleBlock(np.ones((1, 1000)), float(number), 1e3, 1000 * number)))
    level, text, values = b.diagnostics()
    assert (level, values['waveform_age'], values['pulse_age']) == (WARN, '0.0', 'nan')
    assert text.startswith('no pulse in the waveform for 7 s: does the shaft turn?')


def test_input_that_is_refused_is_not_called_silent(averager, clock, monkeypatch):
    b = averager
    b.send_pulses([0.0])
    b.settle()
    wrong = messages.encode_samples(MACHINE.block(0, 64))
    wrong.layout.data_offset = 2

    def play(vibration, source):
        for _ in range(6):
            clock.now += 1.0
            b.send('vibration', vibration)
            b.send_pulses([0.1], source)
        return b.diagnostics()[1]

    text = play(wrong, 'other')
    assert '/vibration since the start 6 s ago: what comes is refused: data_offset 2 ' in text
    assert ("no /tach_pulse for 6 s: what comes is refused: pulses of keyphasor 'other' are "
            "ignored, those of 'kp' are used: restart with keyphasor: other to use them" in text)
    assert 'publishes nothing' not in text
    monkeypatch.setattr(b.node._averager, 'add_samples', lambda block: 1 / 0)
    good = messages.encode_samples(MACHINE.block(0, 64))
    assert 'refused: ZeroDivisionError: division by zero' in play(good, 'kp')
    monkeypatch.undo()
    monkeypatch.setattr(health, 'time', clock)
    b.send('vibration', good)
    b.settle()
    clock.now += 6.0
    assert '/vibration for 6 s: /test publishes nothing' in b.diagnostics()[1]


def test_a_misspelt_keyphasor_is_named_with_the_one_that_comes(ros_graph, clock):
    b = AveragerBench(ros_graph, keyphasor='pk', stale_after=5.0)
    for _ in range(6):
        clock.now += 1.0
        b.send_pulses([0.0])
    level, text, _ = b.diagnostics()
    assert level == DiagnosticStatus.WARN
    assert "what comes is refused: pulses of keyphasor 'kp' are ignored, those of 'pk'" in text


@pytest.mark.parametrize(('kind', 'message', 'says'), [
    ('std_msgs/Float64MultiArray', messages.encode_samples(MACHINE.block(0, 64)),
     '2 channels: send only the channel of the keyphasor'),
    ('sensor_msgs/JointState', JointState(name=['elbow'], position=[0.1]),
     'joint wrist is not in it, only elbow: set the parameter joint')])
def test_detector_says_why_its_input_is_refused(ros_graph, clock, kind, message, says):
    b = NodeBench(ros_graph, TachDetector, inputs={'tach_waveform': type(message)}, outputs={},
                  stale_after=5.0, tach_waveform_type=kind, joint='wrist')
    for _ in range(6):
        clock.now += 1.0
        b.send('tach_waveform', message)
    assert f'6 s ago: what comes is refused: {says}' in b.diagnostics()[1]


def test_stamps_of_joints_that_nobody_fills_are_named(ros_graph, clock):
    b = NodeBench(ros_graph, TachDetector, inputs={'tach_waveform': JointState}, outputs={},
                  stale_after=5.0, tach_waveform_type='sensor_msgs/JointState')
    says = 'stamps do not advance from 0 s on: fill header.stamp with the time of measurement'
    for number in range(7):
        b.send('tach_waveform', JointState(name=['wrist'], position=[0.1 * number]))
        b.settle()
        if number == 1:
            assert b.diagnostics()[:2] == (WARN, f'tach_waveform: {says}')
        clock.now += 1.0
    level, text, values = b.diagnostics()
    assert (level, text) == (WARN, f'no /tach_waveform for 7 s: what comes is refused: {says}')
    assert values['samples_dropped'] == '6'


@pytest.mark.parametrize(('node', 'parameters', 'ages', 'text'), [
    (JitterPredictor, {'follow_shaft_speed': True}, {'speed_age', 'prediction_age'},
     'no /shaft_speed'),
    (JitterPredictor, {}, {'prediction_age'}, None),
    (ResidualAnalyser, {}, {'average_age', 'prediction_age'}, 'no /shaft/order_amplitude'),
    (LiveView, {'port': 0}, {'average_age'}, 'no /shaft/order_amplitude'),
    (MachineSimulator, {'playing': False}, set(), None),
])
def test_each_node_shows_the_ages_of_what_it_takes(
        ros_graph, clock, node, parameters, ages, text):
    if node.takes_data:
        parameters = {**parameters, 'stale_after': 1.0}
    b = NodeBench(ros_graph, node, inputs={}, outputs={}, hardware_id='gearbox 7', **parameters)
    clock.now += 2.0
    level, message, values = b.diagnostics()
    assert {key for key in values if key.endswith('_age')} == ages
    assert set(DIAGNOSTIC_KEYS) < set(values)
    assert level == (OK if text is None else WARN)
    assert message.startswith(text or '')
    assert b.received['/diagnostics'][-1].status[0].hardware_id == 'gearbox 7'


def test_hardware_is_this_computer_unless_named(ros_graph):
    b = NodeBench(ros_graph, JitterPredictor, inputs={}, outputs={})
    b.diagnostics()
    assert b.received['/diagnostics'][-1].status[0].hardware_id == socket.gethostname()


def test_second_publisher_of_an_input_is_named_until_it_stops(ros_graph):
    b = AveragerBench(ros_graph)
    assert b.diagnostics()[0] == OK
    second = ros_graph.node.create_publisher(Float64MultiArray, 'vibration', INPUT_QOS)
    assert b.spin(lambda: b.node.count_publishers('vibration') == 2)
    for _ in range(2):
        level, text, _ = b.diagnostics()
        assert level == WARN
        assert text.startswith('single source of /vibration: 2 publishers (/test, /test) mix')
    ros_graph.node.destroy_publisher(second)
    assert b.spin(lambda: b.node.count_publishers('vibration') == 1)
    assert b.diagnostics()[0] == OK


def test_each_keyphasor_may_have_its_publisher(ros_graph):
    b = AveragerBench(ros_graph, keyphasor='kp')
    second = ros_graph.node.create_publisher(
        type(messages.encode_pulse_reference(0.0, '')), 'tach_pulse', INPUT_QOS)
    assert b.spin(lambda: b.node.count_publishers('tach_pulse') == 2)
    b.send_pulses([0.0])
    assert 'single source of /tach_pulse' in b.diagnostics()[1]
    second.publish(messages.encode_pulse_reference(0.0, 'other'))
    b.settle()
    assert b.spin(lambda: b.status()['pulses_of_others'])
    assert 'single source' not in b.diagnostics()[1]


@pytest.mark.parametrize(('fault', 'words'), [
    (lambda row: 0.0 * row + 3.25, 'is constant at 3.25: check its sensor and cable'),
    (lambda row: np.nan * row, 'is NaN or infinite in 100% of its samples: check its sensor and '
     'cable'),
    (lambda row: np.clip(row, -0.5, 0.5),
     'is saturated in 82% of its samples: lower its gain, or choose a larger range')])
def test_a_bad_channel_is_named(ros_graph, fault, words):
    b = AveragerBench(ros_graph, trigger_cycles=10)

    def unplug(number, block):
        samples = block.samples.copy()
        samples[1] = fault(samples[1])
        return [SampleBlock(samples, block.start_time, block.sample_rate, block.index)]

    b.play(MACHINE, 1.0, change=unplug)
    b.diagnostics()
    level, text, _ = b.diagnostics()
    assert level == WARN
    assert text == f'channel 1 of vibration: {words}'


def test_the_status_names_some_problems_and_counts_the_rest(ros_graph):
    b = AveragerBench(ros_graph, trigger_cycles=10)
    b.play(MACHINE, 1.0, change=lambda number, block: [SampleBlock(
        np.full((9, block.samples.shape[1]), 3.25), block.start_time, block.sample_rate,
        block.index)])
    b.diagnostics()
    level, text, values = b.diagnostics()
    assert level == WARN
    channels = [f'channel {number} of vibration' for number in range(9)]
    assert [item.split(':')[0] for item in text.split('; ')] == [*channels[:6], 'and 3 more']
    assert [item.split(':')[0] for item in values['problems'].split('; ')] == channels


def noise_of(rng):
    """Return a change of what is played: noise in place of the vibration."""
    return lambda number, block: [SampleBlock(
        rng.standard_normal(block.samples.shape), block.start_time, block.sample_rate,
        block.index)]


def test_refused_correction_stays_a_warning(ros_graph, rng):
    b = AveragerBench(ros_graph, trigger_cycles=10, correct_jitter=True)
    b.play(MACHINE, 1.0, change=noise_of(rng))
    for _ in range(2):
        level, text, values = b.diagnostics()
        count = values['shaft.corrections_refused']
        assert level == WARN
        assert text.startswith(f'correction of shaft: refused for {count} of the latest {count} '
                               f'averages: {values["shaft.refusal"]}')
    assert b.set_parameter('correct_jitter', False) == (True, '')
    b.play(MACHINE, 1.0, start=2.0)
    b.diagnostics()
    assert b.diagnostics()[0] == OK


@pytest.mark.machines
def test_a_few_refused_corrections_are_a_warning_until_enough_were_accepted(ros_graph, rng):
    b = AveragerBench(ros_graph, trigger_cycles=10, correct_jitter=True)
    b.play(MACHINE, 1.0, change=noise_of(rng))
    refused = int(b.diagnostics()[2]['shaft.corrections_refused'])
    b.play(MACHINE, 1.5, start=1.0)
    b.diagnostics()
    level, text, values = b.diagnostics()
    assert values['shaft.corrections_refused'] == str(refused)
    assert level == WARN
    assert text.startswith(f'correction of shaft: refused for {refused} of the latest '
                           f'{values["averages"]} averages: {values["shaft.refusal"]}')
    b.play(MACHINE, 3.0, start=2.5)
    b.diagnostics()
    level, _, values = b.diagnostics()
    assert int(values['averages']) > 10 + refused
    assert level == OK


def test_mesh_orders_that_the_waveform_lacks_stay_a_warning(ros_graph):
    b = AveragerBench(ros_graph, trigger_cycles=10, shaft__mesh_orders=[5000.0])
    b.play(MACHINE, 1.0)
    for _ in range(2):
        level, text, _ = b.diagnostics()
        assert level == WARN
        assert text.startswith('condition indicators of shaft: ')


def test_bearing_orders_that_the_envelope_cannot_show_stay_a_warning(ros_graph):
    b = AveragerBench(ros_graph, trigger_cycles=10, shaft__bearing_orders=[3.6],
                      shaft__envelope_band=[7000.0, 8000.0])
    found = ros_graph.capture('shaft/envelope_amplitude', Float64MultiArray)
    b.play(MACHINE, 1.0)
    for _ in range(2):
        level, text, _ = b.diagnostics()
        assert level == WARN
        assert text.startswith('envelope of shaft: no amplitude of bearing orders 3.6: the shaft ')
    table = messages.decode_average('envelope_amplitude', found[-1]).values
    assert np.isnan(table[..., 1:]).all()


def test_prediction_follows_the_speed_of_an_average_not_its_jitter(ros_graph, rng):
    cycles, clock = 40, 3000.0
    b = NodeBench(ros_graph, JitterPredictor, inputs={'shaft_speed': Float64}, outputs={},
                  qos=RESULT_QOS, keyphasor_rate=clock, trigger_cycles=cycles,
                  trigger_speed=16.6, follow_shaft_speed=True)
    predictions = ros_graph.capture('prediction', Float64MultiArray, latched=True)

    def turn(times):
        errors = rng.uniform(0.0, 1.0 / clock, len(times))
        for speed in 1.0 / np.diff(times + errors):
            b.send('shaft_speed', Float64(data=float(speed)))
        b.settle()
        return b.status()['predictions']

    first = turn(np.arange(2 * cycles) / 16.6)
    assert turn(np.arange(300) / 16.6) <= first + 1
    turn(np.arange(2 * cycles) / 17.0)
    followed = messages.decode_prediction(predictions[-1]).trigger_speed
    assert followed == pytest.approx(17.0, rel=1.1e-3)  # speed_tolerance is 1e-3


def test_impossible_prediction_is_a_warning_until_it_is_possible(ros_graph):
    b = NodeBench(ros_graph, JitterPredictor, inputs={'shaft_speed': Float64}, outputs={},
                  qos=RESULT_QOS, keyphasor_rate=1000.0, trigger_speed=20.0,
                  follow_shaft_speed=True)
    b.send('shaft_speed', Float64(data=5000.0))
    for _ in range(2):
        level, text, _ = b.diagnostics()
        assert level == WARN
        assert text.startswith('prediction: impossible at the measured 5000 Hz, ')
    b.send('shaft_speed', Float64(data=20.1))
    assert b.diagnostics()[0] == OK


def test_log_has_one_line_of_each_kind_in_five_seconds(ros_graph, monkeypatch, capfd):
    now = SteadyClock()
    monkeypatch.setattr(base, 'time', now)
    node = NodeBench(ros_graph, JitterPredictor, inputs={}, outputs={}).node
    for number in range(50):
        node.warn(f'sample {number} at {1.5e-3 * number} s is lost')
        node.warn(f'pulse {number} is early')
    for letter in 'abcdefghijklmnop':
        node.warn(f'kind {letter}')
    lines = [line for line in capfd.readouterr().err.splitlines() if 'WARN' in line]
    assert len(lines) == base.WARNING_KINDS
    assert 'sample 0' in lines[0]
    assert 'pulse 0' in lines[1]
    now.now += base.WARNING_PERIOD
    node.warn('sample 99 at 3 s is lost')
    assert 'sample 99' in capfd.readouterr().err


def test_stale_after_can_be_changed_while_the_node_runs(averager, clock):
    b = averager
    clock.now += 6.0
    assert b.diagnostics()[0] == WARN
    assert b.node.set_parameters([Parameter('stale_after', value=0)])[0].successful
    assert b.diagnostics()[0] == OK
