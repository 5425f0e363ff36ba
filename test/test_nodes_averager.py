# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The averager node through real publishers, subscribers and parameter services."""

from dataclasses import replace
import math
import re
import signal
import subprocess
import sys
import time

from bench import assert_true, AveragerBench
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from machine import Machine
import numpy as np
import pytest
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.nodes import messages
from sa_jitter_ros.nodes.base import DIAGNOSTIC_KEYS, INPUT_QOS, LATCHED_QOS
from sa_jitter_ros.nodes.synchronous_averager import SynchronousAverager
from sensor_msgs.msg import Imu
from std_msgs.msg import Float64MultiArray

MACHINE = Machine()
ORDERS = [1.0, 7.0, 23.0]


@pytest.fixture
def bench(ros_graph):
    """Return a maker of benches; averages have 10 trigger cycles by default."""
    def make(**options):
        options = {'trigger_cycles': 10, 'shaft__orders': ORDERS, **options}
        return AveragerBench(ros_graph, **options)
    return make


# --- what is published ---------------------------------------------------------------------------


def test_summary_says_amplitudes_with_intervals_and_units(ros_graph, bench):
    summaries = ros_graph.capture('shaft/summary', DiagnosticArray)
    given = {'channels.gear_box.unit': 'g', 'channels.gear_box.sensitivity': 0.5,
             'channels.motor.unit': 'm/s^2', 'tach_shaft': 'shaft', 'gears.g.shaft': 'shaft',
             'gears.g.teeth': 7, 'gears.g.mate_shaft': 'out', 'gears.g.mate_teeth': 14}
    b = bench(hardware_id='rig', overrides=[
        Parameter(f'machine.{key}', value=value) for key, value in given.items()])
    b.play(MACHINE, 2.0)
    assert len(summaries) == len(b.amplitudes()) > 2
    average = b.amplitudes()[-1]
    status, motor = summaries[-1].status
    assert motor.name == 'shaft: motor'
    assert motor.values[2].value.endswith(' m/s^2')
    assert (status.name, status.hardware_id, status.level) == (
        'shaft: gear_box', 'rig', DiagnosticStatus.OK)
    stamp = summaries[-1].header.stamp
    assert stamp.sec + 1e-9 * stamp.nanosec == pytest.approx(average.header.end_time, abs=1e-8)
    values = {item.key: item.value for item in status.values}
    assert values.pop('sequence') == str(average.header.sequence)
    assert float(values.pop('trigger_speed_hz')) == pytest.approx(MACHINE.speed, rel=1e-5)
    names = ['assembly phase shaft-out', 'mesh shaft-out 1x', '23']
    assert [*values][:3] == names
    for row, order, name in zip(average.values[0], ORDERS, names):
        found = re.fullmatch(r'(\S+) \+- (\S+) g', values[name])
        assert float(found[1]) == pytest.approx(
            2.0 * abs(MACHINE.components[order][0]), rel=1e-3)  # volts over 0.5 V per g
        assert float(found[2]) == pytest.approx(1.96 * row[8], rel=0.06)
    assert values['rms'].endswith(' g')
    assert 'kurtosis' in values


def test_a_summary_says_what_lines_and_channels_are_not_there(ros_graph, bench):
    summaries = ros_graph.capture('shaft/summary', DiagnosticArray)
    b = bench(shaft__orders=[7.0, 11.0], correct_jitter=True, keyphasor_rate=1e4)
    rng = np.random.default_rng(1)

    def one_without(number, block):
        samples = block.samples + 0.1 * rng.standard_normal(block.samples.shape)
        samples[1] = np.nan
        return [replace(block, samples=samples)]

    b.play(MACHINE, 3.0, change=one_without)
    status, deaf = summaries[-1].status
    values = {item.key: item.value for item in status.values}
    assert ' +- ' in values['7']
    assert re.fullmatch(r'below 0\.0\d+', values['11'])
    assert (deaf.level, deaf.message) == (
        DiagnosticStatus.WARN, 'no data: look at sensor and cable')


def test_the_level_of_a_summary_is_that_of_the_worst_limit(ros_graph, bench):
    summaries = ros_graph.capture('shaft/summary', DiagnosticArray)
    amplitude, _ = MACHINE.components[7.0]
    limits = {'all.order': 7.0, 'all.warn': 0.8 * amplitude, 'all.alarm': 1.2 * amplitude,
              'one.order': 1.0, 'one.warn': 1e-6, 'one.channel': '0',
              'rise.order': 7.0, 'rise.relative': True, 'rise.alarm': 1.5}
    b = bench(overrides=[Parameter(f'machine.limits.{key}', value=value)
                         for key, value in limits.items()])
    b.play(MACHINE, 2.0)
    first, second = summaries[-1].status
    assert first.level == DiagnosticStatus.WARN
    assert re.fullmatch(r'order 1 of shaft, channel 0: .* above 1e-06 \(warn\), since average 0',
                        first.message)
    assert second.level == DiagnosticStatus.ERROR  # twice the amplitude
    assert 'order 7 of shaft, channel 1: ' in second.message


@pytest.mark.machines
def test_summaries_of_sliding_averages_come_once_a_second(ros_graph, bench):
    summaries = ros_graph.capture('shaft/summary', DiagnosticArray)
    b = bench(averaging='sliding')
    b.play(MACHINE, 4.0)
    assert len(b.amplitudes()) > 50
    assert 3 <= len(summaries) <= 4
    assert summaries[0].status[0].name == 'shaft: channel 0'


def test_channels_that_a_machine_file_does_not_tell_apart_are_refused(bench):
    b = bench(overrides=[
        Parameter(f'machine.channels.{name}.sensitivity', value=0.1) for name in 'abc'])
    b.play(MACHINE, 1.0)
    assert not b.amplitudes()
    level, text, values = b.diagnostics()
    assert level == DiagnosticStatus.WARN
    assert 'machine.channels has a, b, c, the vibration 2 channels' in values.get('problems', text)
    assert int(values['messages_rejected']) > 0


@pytest.mark.parametrize('blocks', [1, 3])
def test_averages_of_before_have_their_own_channels(ros_graph, bench, blocks):
    """Pulses come behind a stray block, or behind the first ones of another source."""
    shafts = ('shaft', 'other')
    summaries = {name: ros_graph.capture(f'{name}/summary', DiagnosticArray) for name in shafts}
    b = bench(shafts=shafts, overrides=[Parameter('machine.channels.0.unit', value='g')])
    b.send('vibration', messages.encode_samples(MACHINE.block(0, 6400)))
    for number in range(blocks):
        b.send('vibration', messages.encode_samples(
            Machine(channels=3).block(6400 + 640 * number, 640)))
    b.send_pulses(MACHINE.pulses(0.9))
    b.settle()
    for name in shafts:
        assert len(summaries[name]) == len(b.amplitudes(name)) == 1
        assert [item.name for item in summaries[name][0].status] == [
            f'{name}: channel 0', f'{name}: channel 1']
        assert summaries[name][0].status[0].values[2].value.endswith(' g')
    assert 'Error' not in b.diagnostics()[1]


def test_an_error_while_one_shaft_is_published_leaves_the_others(bench, monkeypatch):
    b = bench(shafts=('shaft', 'other'))
    monkeypatch.setattr(b.node._shafts['shaft'], 'publish', lambda *_: 1 / 0)
    b.play(MACHINE, 0.5)
    assert len(b.amplitudes('other')) == 1
    assert 'ZeroDivisionError' in b.diagnostics()[1]


def test_outputs_are_those_of_the_machine(bench):
    b = bench(trigger_cycles=20)
    b.play(MACHINE, 4.0)
    averages = b.amplitudes()
    assert len(averages) == 6
    assert_true(averages, MACHINE, ORDERS)
    for number, average in enumerate(averages):
        assert average.names == messages.AMPLITUDE_FIELDS
        assert average.header.sequence == number
        assert average.header.trigger_cycles == 20 == average.header.fundamental_cycles
        assert average.header.mean_trigger_speed == pytest.approx(MACHINE.speed, rel=1e-7)
        assert np.isnan(average.values[..., 3:7]).all()
        assert (average.values[..., 7] < 1e-4).all()
    waveform = messages.decode_average(
        'synchronous_average', b.received['shaft/synchronous_average'][-1])
    angle = np.arange(waveform.values.shape[1]) / waveform.values.shape[1]
    np.testing.assert_allclose(waveform.values, MACHINE.at(angle / MACHINE.speed), atol=1e-4)
    error = messages.decode_average('standard_error', b.received['shaft/standard_error'][-1])
    assert error.values.shape == waveform.values.shape
    assert (error.values < 1e-4).all()
    indicators = messages.decode_average(
        'condition_indicator', b.received['shaft/condition_indicator'][-1])
    assert indicators.names[0] == 'rms'
    assert indicators.values[0, 0] == pytest.approx(
        np.sqrt(sum(a * a for a, _ in MACHINE.components.values()) / 2.0), rel=1e-4)
    np.testing.assert_allclose([item.data for item in b.received['shaft_speed']], MACHINE.speed,
                               rtol=1e-6)
    level, text, values = b.diagnostics()
    assert set(DIAGNOSTIC_KEYS) <= values.keys()
    assert all(values[key] == '0' for key in DIAGNOSTIC_KEYS)
    assert (level, text) == (DiagnosticStatus.OK, '6 averages of 133 trigger cycles')


def test_several_shafts_share_the_tach(bench):
    ratio = 183 / 76
    machine = Machine(components={1.0: (1.0, 0.4), 3.0 * ratio: (0.5, 1.0)})
    b = bench(shafts=('input', 'output'), input__orders=[1.0, 3.0], output__orders=[1.0, 3.0],
              output__ratio_teeth=[183, 76], output__samples_per_revolution=512,
              shaft__orders=[1.0])
    b.play(machine, 2.0)
    assert len(b.amplitudes('input')) == 6 == len(b.amplitudes('output'))
    assert_true(b.amplitudes('input'), machine, [1.0, 3.0])
    assert_true(b.amplitudes('output'), machine, [1.0, 3.0], cycles=ratio)
    waveforms = b.received['output/synchronous_average']
    assert messages.decode_average('synchronous_average', waveforms[0]).values.shape == (2, 512)


def test_pulses_per_trigger_counts_pulses_not_revolutions(bench):
    b = bench(pulses_per_revolution=6, pulses_per_trigger=3)
    machine = Machine(speed=6 * 25.0, components={1.0 / 6.0: (1.0, 0.4)})
    b.play(machine, 1.5)
    averages = b.amplitudes()
    header = averages[0].header
    assert header.end_time - header.start_time == pytest.approx(10 * 0.5 / 25.0)
    assert header.mean_trigger_speed == pytest.approx(25.0)
    assert header.fundamental_cycles == 5
    assert averages[0].values[0, 0, 1] == pytest.approx(1.0, rel=2e-3)
    np.testing.assert_allclose([item.data for item in b.received['shaft_speed']], 25.0, rtol=1e-6)


@pytest.mark.parametrize('kind', ['sliding', 'exponential'])
def test_moving_averages_come_once_per_trigger_cycle(bench, kind):
    b = bench(averaging=kind)
    b.play(MACHINE, 1.0)
    averages = b.amplitudes()
    assert len(averages) >= 22
    starts = [item.header.start_time for item in averages]
    np.testing.assert_allclose(np.diff(starts), 1.0 / MACHINE.speed, rtol=1e-6)
    for number, item in enumerate(averages):
        assert item.header.sequence == number
        # one angle for all: the phases of successive averages compare
        np.testing.assert_allclose(item.values[0, :, 2], [0.4, -1.1, 2.0], atol=1e-3)


# --- inputs --------------------------------------------------------------------------------------


def test_float32_with_split_index(bench):
    b = bench(vibration_type='std_msgs/msg/Float32MultiArray', sample_rate=12800.0,
              start_time=-2.0 * 2**24 / 12800.0 - 0.5)
    first = 2 * 2**24 + 6400 - 3200  # passes a multiple of 2^24 in single precision exactly

    def encode(block):
        return messages.encode_samples_float32(messages.SampleBlock(
            block.samples, 0.0, block.sample_rate, block.index + first))

    b.play(MACHINE, 1.0, start=-0.25, encode=encode)
    assert len(b.amplitudes()) == 3
    assert_true(b.amplitudes(), Machine(), ORDERS)
    # pulses before 0 have a negative `sec`
    assert b.amplitudes()[0].header.start_time == pytest.approx(-8 / 33.3)


def test_ros_times_of_today_round_to_a_quarter_of_a_microsecond(bench):
    b = bench()
    machine = Machine(speed=32.0)  # whose pulses fall on whole seconds
    b.play(machine, 2.0, start=1.7e9)
    assert len(b.amplitudes()) == 6
    for average in b.amplitudes():
        np.testing.assert_allclose(average.values[0, :, 1], [1.0, 0.5, 0.2], rtol=1e-3)
        np.testing.assert_allclose(average.values[0, :, 2], [0.4, -1.1, 2.0], atol=2e-3)
    assert b.status()['clock_deviation'] == 0


@pytest.mark.parametrize('kind', ['std_msgs/Float64MultiArray', 'std_msgs/Float32MultiArray'])
def test_blocks_without_header_are_counted_and_the_node_says_so(bench, kind):
    b = bench(vibration_type=kind, sample_rate=12800.0)

    def encode(block):
        message = messages.SAMPLE_TYPES[kind]()
        message.data = block.samples[0].astype('f' if '32' in kind else 'd').tolist()
        return message

    b.play(MACHINE, 1.0, encode=encode)
    assert len(b.amplitudes()) == 3
    assert b.amplitudes()[0].values.shape[0] == 1
    assert_true(b.amplitudes(), MACHINE, ORDERS)
    level, text, _ = b.diagnostics()
    assert level == DiagnosticStatus.WARN
    assert 'lost samples are not detected' in text


def imu(time, *values):
    """Return an Imu message."""
    nanoseconds = round(time * 1e9)
    message = Imu()
    message.header.stamp = Time(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
    vector = message.linear_acceleration
    vector.x, vector.y, vector.z = map(float, values)
    return message


def test_imu_axes_are_channels(bench, rng):
    machine = Machine(speed=8.0, rate=400.0, components={1.0: (1.0, 0.4), 5.0: (0.5, 1.0)})
    b = bench(vibration_type='sensor_msgs/Imu', imu_axis='zx', sample_rate=400.0,
              shaft__orders=[1.0, 5.0])
    times = np.arange(1200) / 400.0
    wave = machine.at(times)
    stamps = times + np.append(0.0, rng.uniform(-4e-4, 4e-4, 1199))
    b.send_pulses(machine.pulses(3.0))
    for stamp, (one, two) in zip(stamps, wave.T):
        b.send('vibration', imu(stamp, two, 99.0, one))
    b.settle()
    assert len(b.amplitudes()) == 2
    assert_true(b.amplitudes(), machine, [1.0, 5.0], rtol=1e-3)
    assert b.status()['clock_deviation'] == 0


@pytest.mark.machines
def test_imu_losses_repeats_and_restarts_are_detected(bench):
    machine = Machine(speed=8.0, rate=400.0, components={1.0: (1.0, 0.4)}, channels=1)
    b = bench(vibration_type='sensor_msgs/Imu', sample_rate=400.0, shaft__orders=[1.0])
    samples = [imu(k / 400.0, 0.0, 0.0, value) for k, value in enumerate(
        machine.at(np.arange(1400) / 400.0)[0])]
    samples[100:100] = [samples[99]]
    del samples[400:404]
    b.send_pulses(machine.pulses(3.5))
    for message in samples:
        b.send('vibration', message)
    b.settle()
    status = b.status()
    assert (status['gaps'], status['repeats'], status['restarts']) == (1, 1, 0)
    assert len(b.amplitudes()) == 1
    assert_true(b.amplitudes(), machine, [1.0], rtol=1e-3)
    b.send_pulses(machine.pulses(2.0))
    for message in samples[:800]:
        b.send('vibration', message)
    b.settle()
    assert b.status()['restarts'] == 1
    assert_true(b.amplitudes(), machine, [1.0], rtol=1e-3)


@pytest.mark.machines
@pytest.mark.parametrize(('stamps', 'words'), [
    (np.arange(600) / 150.0, 'its stamps come 150 times a second, sample_rate declares 400 Hz'),
    (np.arange(800) // 20 / 20.0 + np.arange(800) % 20 * 1e-5, 'its stamps come in bursts, 4')])
def test_imu_of_another_rate_than_declared_is_named(bench, stamps, words):
    machine = Machine(speed=8.0, rate=400.0, components={1.0: (1.0, 0.4)}, channels=1)
    b = bench(vibration_type='sensor_msgs/Imu', sample_rate=400.0, shaft__orders=[1.0])
    b.send_pulses(machine.pulses(stamps[-1]))
    for stamp in stamps:
        b.send('vibration', imu(stamp, 0.0, 0.0, np.cos(2.0 * np.pi * 8.0 * stamp)))
    b.settle()
    level, text, _ = b.diagnostics()
    assert level == DiagnosticStatus.WARN
    assert words in text
    assert 'sample_rate declares 400 Hz' in text


def test_pulse_arrays_carry_many_pulses(bench):
    b = bench(tach_type='std_msgs/msg/Float64MultiArray')
    b.play(MACHINE, 1.0)
    assert len(b.amplitudes()) == 3
    assert_true(b.amplitudes(), MACHINE, ORDERS)


@pytest.mark.parametrize('named', [False, True])
def test_one_keyphasor_is_used_and_the_others_counted(bench, named):
    b = bench(**({'keyphasor': 'kp'} if named else {}))
    if named:
        b.send_pulses([-0.5], source='other')

    def and_another(number, block):
        b.send_pulses([block.start_time + 0.003, block.start_time + 0.02], source='other')
        return [block]

    b.play(MACHINE, 1.0, change=and_another)
    assert len(b.amplitudes()) == 3
    assert_true(b.amplitudes(), MACHINE, ORDERS)
    level, text, status = b.diagnostics()
    assert (level == DiagnosticStatus.OK, 'restart with keyphasor: other' in text) == (
        named, not named)
    assert status['pulses_dropped'] == ('0' if named else '40')
    assert (status['pulses_of_others'], status['keyphasor']) == (str(40 + named), 'kp')


@pytest.mark.parametrize(('end', 'says'), [
    (2.4, 'no valid pulses from 0.780000 s to 2.400000 s: 54 trigger cycles discarded'),
    (2.41, 'no valid pulses from 0.780000 s to 2.410000 s: an unknown number of trigger cycles '
     'discarded'),
    (0.99, 'no valid pulses from 0.780000 s to 0.990000 s: 7 trigger cycles discarded'),
    (0.84, None)])
def test_a_gap_of_the_pulses_is_said_with_what_it_cost(bench, end, says):
    b = bench()
    for number in range(20):
        b.send('vibration', messages.encode_samples(MACHINE.block(2560 * number, 2560)))
        for start, stop, first in ((0, 27, 0.0), (0, 40, end)):
            times = first + np.arange(start, stop) * 0.03
            b.send_pulses(times[(times >= 0.2 * number) & (times < 0.2 * number + 0.2)])
    b.settle()
    text = b.diagnostics()[1]
    assert (says or 'cycles_dropped') in text
    assert ('no valid pulses' in text) == bool(says)
    assert len(b.amplitudes()) >= 5


@pytest.mark.parametrize(('vibration', 'pulses', 'says'), [
    (1.7e9, 0.0, r'no vibration without a gap from .* s to .* s \(vibration begins at '
     r'1700000000.000000 s: time both by one clock\): \d+ trigger cycles discarded'),
    (0.0, 1.7e9, r'trigger pulses waited longer than buffer_seconds = 0.5 s for vibration, which '
     r'ends at 0.\d+ s: is it published, on the clock of the pulses\?')])
def test_vibration_and_pulses_of_two_clocks_are_named(bench, vibration, pulses, says):
    b = bench(buffer_seconds=0.5)
    b.send_pulses(pulses + MACHINE.pulses(0.4))
    b.settle()
    b.send('vibration', messages.encode_samples(MACHINE.block(0, 1280, start=vibration)))
    b.settle()
    text = b.diagnostics()[1]
    b.send_pulses(pulses + MACHINE.pulses(1.0, 0.4))
    text += b.diagnostics()[1]
    assert re.search(says, text)


def test_keyphasor_may_have_an_empty_name(bench):
    b = bench()
    b.send_pulses([-0.5], source='')
    b.play(MACHINE, 1.0)
    assert b.amplitudes() == []
    assert b.status()['pulses_dropped'] == len(MACHINE.pulses(1.0))


def test_unexpected_error_rejects_one_message_only(bench, monkeypatch):
    b = bench()
    add_pulses = b.node._averager.add_pulses

    def failing(times):
        if 0.3 < times[0] < 0.33:
            raise ZeroDivisionError('unthought of')
        return add_pulses(times)

    monkeypatch.setattr(b.node._averager, 'add_pulses', failing)
    b.play(MACHINE, 1.0)
    assert len(b.amplitudes()) == 2
    level, text, values = b.diagnostics()
    assert level == DiagnosticStatus.WARN
    assert 'ZeroDivisionError: unthought of' in text
    assert values['messages_rejected'] == '1'


def malformed():
    """Yield the name of an error, a message with it, and the text of the node."""
    good = messages.encode_samples

    def changed(**changes):
        message = good(MACHINE.block(0, 100))
        for name, value in changes.items():
            if name == 'label':
                message.layout.dim[0].label = value
            elif name == 'size':
                message.layout.dim[1].size = value
            elif name == 'offset':
                message.layout.data_offset = value
            elif name == 'header':
                for position, item in value.items():
                    message.data[position] = item
        return message

    yield 'label', changed(label='sensor'), "dimensions ['sensor', 'sample']"
    yield 'size', changed(size=101), 'layout 2x101'
    yield 'huge size', changed(size=2**32 - 1), 'does not fit 203 elements'
    yield 'empty', changed(size=0), 'layout 2x0'
    yield 'offset', changed(offset=2), 'data_offset 2 received, 3 expected'
    yield 'offset beyond', changed(offset=2**32 - 1), 'behind 4294967295 header elements'
    yield 'time', changed(header={0: math.nan}), 'header time nan s'
    yield 'endless time', changed(header={0: math.inf}), 'header time inf s'
    yield 'rate', changed(header={1: 0.0}), 'rate 0.0 Hz'
    yield 'negative rate', changed(header={1: -1.0}), 'rate -1.0 Hz'
    yield 'index', changed(header={2: 0.5}), 'index of the first sample is 0.5'
    yield 'negative index', changed(header={2: -1.0}), 'index of the first sample is -1.0'
    yield 'nan index', changed(header={2: math.nan}), 'index of the first sample is nan'
    empty = messages.Float64MultiArray()
    yield 'nothing', empty, 'empty block'
    short = messages.Float64MultiArray(data=[0.0, 12800.0])
    short.layout.data_offset = 3
    yield 'short', short, '2 elements received, at least 3 header elements'
    deep = good(MACHINE.block(0, 100))
    deep.layout.dim.append(deep.layout.dim[0])
    yield 'three dimensions', deep, "['channel', 'sample', 'channel']"


@pytest.mark.parametrize(('message', 'says'), [
    pytest.param(message, says, id=name) for name, message, says in malformed()])
def test_malformed_block_is_rejected_with_its_reason_and_nothing_else(bench, message, says):
    b = bench()

    def with_it(number, block):
        return [block, message] if number == 5 else [block]

    b.play(MACHINE, 0.8, change=with_it)
    level, text, values = b.diagnostics()
    if says.startswith('empty'):  # without header it needs a rate before it needs samples
        assert 'vibration: ' in text
    else:
        assert says in text
    assert level == DiagnosticStatus.WARN
    assert values['messages_rejected'] == '1'
    assert values['cycles_dropped'] == '0'
    assert len(b.amplitudes()) == 2
    assert_true(b.amplitudes(), MACHINE, ORDERS)
    assert b.diagnostics()[0] == DiagnosticStatus.OK


def test_malformed_pulses_are_rejected(bench):
    b = bench(tach_type='std_msgs/Float64MultiArray')
    wrong = messages.encode_pulse_array(np.array([0.1, 0.2]))
    wrong.layout.dim[0].label = 'sample'
    b.send('tach_pulse', wrong)
    assert b.status()['messages_rejected'] == 1
    b.send_pulses([math.nan, math.inf, 0.0])
    assert b.status()['pulses_dropped'] == 2
    b.play(MACHINE, 0.8)
    assert_true(b.amplitudes(), MACHINE, ORDERS)
    assert len(b.amplitudes()) == 2


def test_missing_sample_rate_is_requested(bench):
    b = bench(vibration_type='std_msgs/Float32MultiArray')
    b.send('vibration', messages.encode_samples_float32(MACHINE.block(0, 100)))
    _, text, values = b.diagnostics()
    assert 'set the parameter sample_rate' in text
    assert values['messages_rejected'] == '1'


def test_lasting_change_of_channels_is_averaged(bench):
    b = bench()
    other = Machine(channels=3)
    b.play(MACHINE, 0.8)
    b.play(Machine(channels=1), 0.05)  # one odd block is a fault
    before = len(b.amplitudes())
    assert b.status()['messages_rejected'] == 1
    b.play(other, 1.0)
    status = b.status()
    assert status['messages_rejected'] == 2
    assert status['channels'] == 3
    assert status['restarts'] == 1
    assert {item.values.shape[0] for item in b.amplitudes()[:before]} == {2}
    assert {item.values.shape[0] for item in b.amplitudes()[before:]} == {3}
    assert len(b.amplitudes()) - before >= 2
    assert_true(b.amplitudes()[before:], other, ORDERS)


def test_rate_that_the_source_measures_for_each_block_is_that_of_the_run(bench, rng):
    b = bench()
    b.play(MACHINE, 1.0, change=lambda number, block: [replace(
        block, sample_rate=MACHINE.rate + 0.02 * rng.standard_normal())])
    assert len(b.amplitudes()) == 3
    assert_true(b.amplitudes(), MACHINE, ORDERS, rtol=2e-3)
    level, _, values = b.diagnostics()
    assert (level, values['messages_rejected']) == (DiagnosticStatus.OK, '0')


def test_other_channels_at_continuing_times_are_a_gap(bench):
    b = bench()
    b.play(MACHINE, 0.5)
    for index in (6400, 7040, 7680):
        b.send('vibration', messages.encode_samples(Machine(channels=1).block(index, 640)))
    status = b.status()
    assert (status['gaps'], status['restarts'], status['messages_rejected']) == (1, 0, 1)


def test_orders_and_shafts_beyond_nyquist(bench):
    b = bench(shafts=('shaft', 'turbine'), shaft__orders=[1.0, 300.0], turbine__ratio=200.0)
    b.play(MACHINE, 0.8)
    assert b.received['turbine/order_amplitude'] == []
    amplitude = b.amplitudes()[0].values[0]
    assert amplitude[0, 1] == pytest.approx(1.0, rel=1e-4)
    assert np.isnan(amplitude[1, 1:]).all()
    _, text, values = b.diagnostics()
    assert 'turbine: shaft frequency 6660 Hz is not below half the sampling rate' in text
    assert int(values['cycles_dropped']) == int(values['trigger_cycles']) > 20
    level, text, _ = b.diagnostics()  # as long as the order is asked for
    assert level == DiagnosticStatus.WARN
    assert text.startswith('orders of shaft: no amplitude of orders 300: the shaft turns at 33.3')
    assert 'shows orders below' in text


def test_orders_that_hold_no_line_are_named_until_they_are_changed(bench):
    b = bench(shaft__orders=[31.0, 37.0])
    b.play(MACHINE, 4.0)
    level, text, _ = b.diagnostics()
    assert level == DiagnosticStatus.WARN
    assert text.startswith('lines of shaft: none of the orders 31, 37 stands above its noise')
    assert b.set_parameter('shaft.orders', ORDERS)[0]
    b.play(MACHINE, 4.0)
    assert 'none of the orders' not in b.diagnostics()[1]


# --- parameters ----------------------------------------------------------------------------------


def test_parameters_are_described_with_their_ranges(bench):
    b = bench()
    ask = b.client()
    names = ask('list_parameters', [], 0).result.names
    ours = [name for name in names if name != 'use_sim_time'
            and not name.startswith(('qos_overrides', 'start_type'))]
    assert {'trigger_cycles', 'shaft.ratio', 'shaft.orders', 'shaft.samples_per_revolution',
            'averaging', 'angle_law', 'interpolation', 'pulses_per_trigger'} <= set(ours)
    described = {item.name: item for item in ask('describe_parameters', ours).descriptors}
    assert all(item.description for item in described.values())
    assert described['trigger_cycles'].integer_range[0].from_value == 1
    assert described['vibration_type'].read_only
    assert 'sliding' in described['averaging'].additional_constraints
    values = ask('get_parameters', ['shaft.orders', 'trigger_cycles']).values
    assert list(values[0].double_array_value) == ORDERS
    assert values[1].integer_value == 10


@pytest.mark.machines
@pytest.mark.parametrize(('name', 'value', 'stored'), [
    ('trigger_cycles', 5, 5), ('shaft.orders', [1, 7], [1.0, 7.0]), ('shaft.ratio', 2, 2.0),
    ('averaging', 'sliding', 'sliding'), ('angle_law', 'spline', 'spline'),
    ('interpolation', 'linear', 'linear'), ('shaft.samples_per_revolution', 64, 64),
    ('shaft.mesh_orders', [23], [23.0]), ('shaft.ratio_teeth', [20, 10], [20, 10]),
    ('minimum_interval', 0, 0.0),
])
def test_parameter_can_be_set_while_it_runs(bench, name, value, stored):
    b = bench()
    b.play(MACHINE, 0.5)
    assert b.set_parameter(name, value) == (True, '')
    got = b.node.get_parameter(name).value
    assert (list(got) if isinstance(stored, list) else got) == stored
    assert type(got[0] if isinstance(stored, list) else got) is type(
        stored[0] if isinstance(stored, list) else stored)
    before = len(b.amplitudes())
    b.play(MACHINE, 2.0, change=lambda number, block: [block])
    last = b.amplitudes()[-1]
    assert len(b.amplitudes()) > before
    assert last.header.trigger_cycles == (5 if name == 'trigger_cycles' else 10)
    if name == 'shaft.orders':
        assert list(last.values[0, :, 0]) == [1.0, 7.0]
    if name in ('shaft.ratio', 'shaft.ratio_teeth'):
        assert last.header.fundamental_cycles == 20
    elif name == 'averaging':
        assert len(b.amplitudes()) - before > 30
    else:
        np.testing.assert_allclose(last.values[0, :2, 1], [1.0, 0.5], rtol=1e-2)
    if name == 'shaft.samples_per_revolution':
        shape = messages.decode_average(
            'synchronous_average', b.received['shaft/synchronous_average'][-1]).values.shape
        assert shape == (2, 64)


@pytest.mark.parametrize(('name', 'value', 'reason'), [
    ('trigger_cycles', 0, 'trigger_cycles out of range. Min: 1'),  # refused by rclpy
    ('trigger_cycles', 10.5, 'trigger_cycles is 10.5: give a whole number'),
    ('trigger_cycles', 'many', "trigger_cycles is 'many': give a whole number"),
    ('shaft.ratio', 0.0, 'shaft.ratio out of range Min: 0.001, Max: 1000.0'),
    ('shaft.ratio', math.nan, 'shaft.ratio out of range'),
    ('shaft.ratio_teeth', [1, 10**9], 'shaft: ratio is 1e-09: give at least 0.001'),
    ('shaft.ratio', True, 'shaft.ratio is True: give a number'),
    ('shaft.orders', [1.0, -1.0], 'shaft.orders[1] is -1.0: give more than 0.0'),
    ('shaft.orders', 3.0, 'give a list of numbers'),
    ('shaft.ratio_teeth', [3], 'give pairs of driver and driven'),
    ('shaft.samples_per_revolution', 2, 'give at least 4, or 0 to choose it'),
    ('averaging', 'median', 'one of block, sliding, exponential'),
    ('angle_law', '', 'one of linear, quadratic, spline'),
    ('interpolation', 'best', 'one of band_limited'),
    ('pulses_per_trigger', 2, 'pulses_per_trigger is 2, more than the 1 pulses_per_revolution'),
    ('shafts', ['other'], 'read-only'),
    ('vibration_type', 'sensor_msgs/Imu', 'read-only'),
])
def test_wrong_value_is_refused_with_its_reason_and_changes_nothing(bench, name, value, reason):
    b = bench()
    b.play(MACHINE, 0.4)
    before = b.node.get_parameter(name).value
    successful, text = b.set_parameter(name, value)
    assert not successful
    assert reason in text
    assert b.node.get_parameter(name).value == before
    assert b.status()['averages_dropped'] == 0


def test_an_atomic_change_is_refused_as_a_whole(bench):
    b = bench()
    result = b.client()('set_parameters_atomically', [
        Parameter('trigger_cycles', value=7), Parameter('shaft.ratio', value=-1.0)]).result
    assert not result.successful
    assert b.node.get_parameter('trigger_cycles').value == 10
    result = b.client()('set_parameters_atomically', [
        Parameter('shaft.ratio', value=1), Parameter('trigger_cycles', value=7)]).result
    assert result.successful, result.reason
    assert b.node.get_parameter('trigger_cycles').value == 7


def test_ratio_and_teeth_together_are_refused(ros_graph):
    with pytest.raises(ParameterError, match=r'shaft.ratio is 2.0 .* \[3, 2\]: give one of them'):
        ros_graph.add(SynchronousAverager, {'shaft.ratio': 2.0, 'shaft.ratio_teeth': [3, 2]})


@pytest.mark.parametrize(('name', 'value', 'says'), [
    ('shafts', ['Input'], 'small letters'), ('shafts', ['a', 'a'], 'different names'),
    ('vibration_type', 'std_msgs/String', 'give one of std_msgs/Float64MultiArray'),
    ('tach_type', 'std_msgs/Header', 'give one of sensor_msgs/TimeReference'),
    ('imu_axis', 'w', 'imu_axis'), ('trigger_cycles', 'x', 'give a whole number'),
    ('buffer_seconds', 0.0, 'more than 0.0'),
])
def test_node_refuses_to_start_with(ros_graph, name, value, says):
    with pytest.raises(ParameterError, match=says):
        ros_graph.add(SynchronousAverager, {name: value})


def test_override_without_parameter_is_named(bench, capfd):
    bench(overrides=[Parameter('shaft.ration', value=2.0)])
    assert 'parameter shaft.ration is ignored' in capfd.readouterr().err


# --- quality of service, process -----------------------------------------------------------------

BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)


def test_incompatible_publisher_is_an_error_that_names_the_override(bench):
    b = bench(qos=BEST_EFFORT)
    named = ['qos_overrides./vibration.subscription.reliability',
             'qos_overrides./tach_pulse.subscription.reliability']
    assert b.spin(lambda: all(name in b.diagnostics()[1] for name in named))
    assert b.diagnostics()[0] == DiagnosticStatus.ERROR
    for publisher in b.publishers.values():
        b.graph.node.destroy_publisher(publisher)
    assert b.spin(lambda: b.diagnostics()[0] == DiagnosticStatus.OK)  # no publisher is left


def test_durability_can_be_overridden_as_the_error_says(bench):
    names = [f'qos_overrides./{topic}.subscription.durability'
             for topic in ('vibration', 'tach_pulse')]
    b = bench(qos=QoSProfile(depth=10), overrides=[
        Parameter(name, value='transient_local') for name in names])
    assert b.spin(lambda: all(name in b.diagnostics()[1] for name in names))


def test_quality_of_service_can_be_overridden(bench):
    b = bench(qos=BEST_EFFORT, overrides=[
        Parameter(f'qos_overrides./{topic}.subscription.reliability', value='best_effort')
        for topic in ('vibration', 'tach_pulse')])
    b.play(MACHINE, 0.5)
    assert len(b.amplitudes()) == 1
    assert b.diagnostics()[0] == DiagnosticStatus.OK


def test_an_override_is_for_its_topic_only(ros_graph):
    node = ros_graph.add(SynchronousAverager, {
        'qos_overrides./vibration.subscription.reliability': 'best_effort'})
    found = {item.topic_name: item.qos_profile.reliability for item in node.subscriptions}
    assert found['/vibration'] == ReliabilityPolicy.BEST_EFFORT
    assert found['/tach_pulse'] == INPUT_QOS.reliability == ReliabilityPolicy.RELIABLE


def test_topics_follow_namespace(ros_graph):
    node = ros_graph.add(SynchronousAverager, namespace='/press/motor')
    topics = {name for name, _ in node.get_topic_names_and_types()}
    assert {'/press/motor/vibration', '/press/motor/tach_pulse', '/diagnostics',
            '/press/motor/shaft/order_amplitude', '/press/motor/shaft_speed'} <= topics


RUN = """
import sys
from rclpy.executors import SingleThreadedExecutor
from sa_jitter_ros.nodes.synchronous_averager import main
spin = SingleThreadedExecutor.spin
def say_and_spin(executor):
    print('spinning', flush=True)
    spin(executor)
SingleThreadedExecutor.spin = say_and_spin
sys.exit(main())
"""


NO_NOHUP = 'import signal\nsignal.signal(signal.SIGHUP, signal.SIG_DFL)\n'


def run(environment, *arguments, before=''):
    """Start the node as a process."""
    return subprocess.Popen(
        [sys.executable, '-c', before + RUN, '--ros-args', *arguments], env=environment, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE)


@pytest.mark.processes
@pytest.mark.parametrize('number', [signal.SIGTERM, signal.SIGHUP])
def test_main_ends_well_on_a_signal_with_a_parameter_file(process_environment, tmp_path, number):
    file = tmp_path / 'averager.yaml'
    file.write_text('/**:\n  ros__parameters:\n    trigger_cycles: 12\n    shaft:\n'
                    '      ratio: 2\n      orders: [1, 38]\n')
    process = run(process_environment, '--params-file', str(file), before=NO_NOHUP)
    assert process.stdout.readline() == 'spinning\n'
    process.send_signal(number)
    _, errors = process.communicate(timeout=600)
    assert process.returncode == 0, errors
    assert re.fullmatch(r'.*started: averages 12 trigger cycles of shaft\n', errors)


@pytest.mark.processes
def test_interrupts_that_repeat_end_it_well(process_environment):
    process = run(process_environment)
    assert process.stdout.readline() == 'spinning\n'
    while process.poll() is None:
        process.send_signal(signal.SIGINT)
        time.sleep(0.02)
    _, errors = process.communicate(timeout=600)
    assert process.returncode == 0
    assert re.fullmatch(r'.*started: averages .*\n', errors)


HANG = """
import ctypes
from rclpy.node import Node
Node.destroy_node = lambda node: ctypes.PyDLL(None).sleep(600)  # keeps the interpreter's lock
"""


@pytest.mark.processes
def test_middleware_that_hangs_does_not_keep_it(process_environment):
    process = run(process_environment, before=HANG)
    assert process.stdout.readline() == 'spinning\n'
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=600)
    assert process.returncode == 0
    assert '/synchronous_averager: the middleware hangs while it destroys the node' in errors


@pytest.mark.processes
@pytest.mark.parametrize(('argument', 'says'), [
    ('averaging:=median', "averaging is 'median'"),
    ('shaft.orders:=[1.0, x]', "Couldn't parse parameter override rule"),
    ('use_sim_time:=3', 'expecting type'),
])
def test_main_says_in_one_line_what_is_wrong(process_environment, argument, says):
    process = run(process_environment, '-p', argument)
    output, errors = process.communicate(timeout=600)
    assert process.returncode == 2
    assert output == ''
    *logged, line = errors.strip().splitlines()
    assert all('[rcl]' in item for item in logged), errors
    assert line.startswith('error: ')
    assert says in line


@pytest.mark.machines
def test_the_geometry_of_the_target_is_published_and_kept_for_later_subscribers(bench, ros_graph):
    late = np.array([0.012, -0.004, 0.0, -0.008])

    class Uneven(Machine):

        def pulses(self, seconds, start=0.0):
            numbers = np.arange(int(seconds * self.speed * 4))
            return start + (numbers / 4 + late[numbers % 4] / (2.0 * np.pi)) / self.speed

    b = bench(pulses_per_revolution=4, pulses_per_trigger=1, trigger_cycles=40,
              target_geometry='learn')
    b.play(Uneven(), 6.0)
    assert len(b.amplitudes()) == 19
    np.testing.assert_allclose([item.header.mean_trigger_speed for item in b.amplitudes()],
                               Machine().speed, rtol=1e-6)
    received = ros_graph.capture('target_geometry', Float64MultiArray, qos=LATCHED_QOS)
    assert b.spin(lambda: received)
    assert [item.label for item in received[-1].layout.dim] == [
        'mark', 'field:angle,standard_error']
    geometry = messages.decode_geometry(received[-1])
    np.testing.assert_allclose(geometry.angles, late, atol=1e-5)
    assert (geometry.standard_errors < 1e-5).all()
    assert geometry.revolutions > 50
    text = b.diagnostics()[2]['target_geometry']
    assert text.startswith('4 marks off by 0.00748 rad RMS, with a standard error of')
    assert 'a ripple of the speed with the revolution looks the same in the pulses' in text


def test_angles_of_another_target_are_refused_with_a_warning(bench):
    b = bench(pulses_per_revolution=2, pulses_per_trigger=1, target_geometry='given',
              target_angles=[0.05, -0.05])
    b.play(Machine(speed=50.0), 4.5)
    level, text, values = b.diagnostics()
    assert level == DiagnosticStatus.WARN
    assert 'the pulses show other marks than those known' in text
    assert values['pulses_geometry_refused'] == '1'
    assert b.set_parameter('target_angles', [0.05]) == (
        False, 'target_angles has 1 angles for a target of 2 marks: give one for each, in rad')


def test_pulses_that_fit_no_revolution_of_the_given_angles_have_their_cause_named(bench):
    b = bench(pulses_per_revolution=2, pulses_per_trigger=1, target_geometry='given',
              target_angles=[0.8, -0.8])
    b.play(Machine(speed=50.0), 1.5)
    level, text, values = b.diagnostics()
    assert level == DiagnosticStatus.WARN
    assert 'the first 64 pulses fit no target of 2 marks as declared' in text
    assert 'check_keyphasor finds its marks and their angles' in text
    assert (values['trigger_cycles'], values['pulses_accepted']) == ('0', '0')
