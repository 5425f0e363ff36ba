# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The recording player through real subscribers."""

from dataclasses import replace
from itertools import pairwise

from bag_writer import write_bag
from bench import NodeBench, SteadyClock
from diagnostic_msgs.msg import DiagnosticStatus
import numpy as np
import pytest
from rclpy.parameter import Parameter
from sa_jitter_ros.commands import average
from sa_jitter_ros.errors import ParameterError, RecordingError
from sa_jitter_ros.nodes import messages, playback, recording_player
from sa_jitter_ros.nodes.playback import Pacer
from sa_jitter_ros.nodes.recording_player import RecordingPlayer
from sa_jitter_ros.parameter_file import section_text
from sa_jitter_ros.recordings import ArraySource, Recording, write_npz
from sensor_msgs.msg import TimeReference
from std_msgs.msg import Float32MultiArray, Float64MultiArray

RATE = 2000.0


@pytest.fixture
def recording(rng):
    """Return two seconds of a recording with everything in it."""
    return Recording(
        ArraySource(rng.standard_normal((2, 4000))), RATE, start_time=5.0,
        pulse_times=5.0 + np.arange(-0.01, 2.05, 0.04), tach=ArraySource(
            rng.standard_normal((1, 12_000))), tach_rate=3 * RATE,
        reference_pulse_times=np.arange(5.003, 7.0, 0.04))


class Bench(NodeBench):
    """A player and what it publishes."""

    def __init__(self, graph, path, *, vibration=Float64MultiArray, pulse=TimeReference,
                 **parameters):
        super().__init__(
            graph, RecordingPlayer, inputs={}, **{
                'recording': str(path), 'rate': 50.0, **parameters},
            outputs={'vibration': vibration, 'tach_waveform': vibration, 'tach_pulse': pulse})
        self.kind = next(name for name, item in messages.SAMPLE_TYPES.items() if item is vibration)

    def _blocks(self, topic, rate):
        decoder = messages.SampleDecoder(self.kind, sample_rate=rate, start_time=5.0)
        return [decoder.decode(item) for item in self.received[topic]]

    @property
    def blocks(self):
        """Return the blocks of vibration received."""
        return self._blocks('vibration', RATE)

    @property
    def waveform(self):
        """Return the blocks of the tach waveform received."""
        return self._blocks('tach_waveform', 3 * RATE)

    @property
    def pulses(self):
        """Return the pulse times received."""
        return [time for item in self.received['tach_pulse'] for time in (
            messages.decode_pulse_reference(item)[0] if isinstance(item, TimeReference)
            else messages.decode_pulse_array(item))]

    def ended(self):
        """Return whether the player has stopped by itself and all was received."""
        return not self.node.get_parameter('playing').value

    def tick(self):
        """Send what is due now, and receive it."""
        self.node._tick()
        self.settle()

    def play(self):
        """Play to the end and receive the last messages."""
        assert self.spin(self.ended)
        self.settle()

    def samples(self):
        """Return the received samples, checked to be without gaps."""
        blocks = self.blocks
        assert blocks[0].index == 0
        for block, following in pairwise(blocks):
            assert following.index == block.end_index
        return np.concatenate([block.samples for block in blocks], axis=1)


@pytest.fixture
def bench(ros_graph, tmp_path, recording):
    """Return a maker of benches that play `recording`, changed as asked."""
    def make(changed=recording, **options):
        write_npz(tmp_path / 'rig.npz', changed)
        return Bench(ros_graph, tmp_path / 'rig.npz', **options)
    return make


def test_vibration_and_pulses_arrive_as_recorded(bench, recording):
    player = bench()
    player.play()
    np.testing.assert_array_equal(player.samples(), recording.read())
    for block in player.blocks:
        assert block.start_time == pytest.approx(5.0 + block.index / RATE, abs=1e-12)
        assert block.sample_rate == RATE
    assert {block.samples.shape[1] for block in player.blocks} == {100}
    wanted = recording.pulse_times[recording.pulse_times < 7.0]
    np.testing.assert_allclose(player.pulses, wanted, rtol=0, atol=1e-9)
    assert player.waveform == []
    assert player.node.counts['pulses_dropped'] == np.count_nonzero(recording.pulse_times >= 7.0)


def test_recording_of_other_make_is_played_by_its_fields(ros_graph, recording, tmp_path):
    np.savez(tmp_path / 'other.npz', acc=recording.read().T, tach=recording.pulse_times)
    player = Bench(ros_graph, tmp_path / 'other.npz', fields=[
        'vibration=acc', 'pulse_times=tach', f'sample_rate={RATE}', 'start_time=5'])
    player.play()
    np.testing.assert_array_equal(player.samples(), recording.read())
    assert len(player.pulses) == np.count_nonzero(recording.pulse_times < 7.0)


def test_sensitivities_in_another_order_than_the_channels_are_refused(bench, recording):
    named = replace(recording, channel_names=('a', 'b'))
    swapped = {f'machine__channels__{name}__sensitivity': size
               for name, size in (('b', 0.1), ('a', 0.2))}
    with pytest.raises(ParameterError, match='list the channels in its order'):
        bench(named, **swapped)
    bench(named, **dict(reversed(swapped.items())))


def test_waveform_and_pulses_together(bench, recording):
    player = bench(tach='both')
    player.play()
    waveform = np.concatenate([block.samples[0] for block in player.waveform])
    np.testing.assert_array_equal(waveform, recording.read_tach())
    assert player.waveform[7].start_time == pytest.approx(
        5.0 + player.waveform[7].index / (3 * RATE), abs=1e-12)
    assert len(player.pulses) > 40


def test_waveform_has_the_type_of_the_vibration(bench, recording):
    player = bench(vibration=Float32MultiArray, vibration_type='std_msgs/Float32MultiArray',
                   tach='waveform')
    player.play()
    np.testing.assert_array_equal(player.samples(), recording.read().astype(np.float32))
    waveform = np.concatenate([block.samples[0] for block in player.waveform])
    np.testing.assert_array_equal(waveform, recording.read_tach().astype(np.float32))
    assert player.waveform[7].start_time == pytest.approx(
        5.0 + player.waveform[7].index / (3 * RATE), abs=1e-12)


@pytest.mark.parametrize(('gone', 'options', 'wanted'), [
    ({}, {}, 'pulses'), ({'pulse_times': None}, {}, 'waveform'),
    ({'pulse_times': None, 'tach': None}, {}, 'reference'), ({}, {'tach': 'none'}, 'none'),
    ({}, {'tach': 'reference'}, 'reference')])
def test_keyphasor_is_chosen(bench, recording, gone, options, wanted):
    player = bench(replace(recording, **gone), **options)
    player.play()
    assert bool(player.waveform) == (wanted == 'waveform')
    times = {'pulses': recording.pulse_times[recording.pulse_times < 7],
             'reference': recording.reference_pulse_times}.get(wanted, [])
    np.testing.assert_allclose(player.pulses, times, rtol=0, atol=1e-9)


def test_pulses_beyond_2038_are_counted_or_sent_as_arrays(bench, recording):
    late = replace(recording, start_time=3e9, pulse_times=recording.pulse_times - 5.0 + 3e9,
                   reference_pulse_times=None)
    player = bench(late)
    player.play()
    player.samples()
    assert player.pulses == []
    assert player.node.counts['pulses_dropped'] == recording.pulse_times.size
    assert 'set tach_type to std_msgs/Float64MultiArray' in player.diagnostics()[1]


def test_pulse_arrays_reach_beyond_2038(bench, recording):
    late = replace(recording, start_time=3e9, pulse_times=recording.pulse_times - 5.0 + 3e9)
    player = bench(late, pulse=Float64MultiArray, tach_type='std_msgs/Float64MultiArray')
    player.play()
    np.testing.assert_allclose(player.pulses, late.pulse_times[late.pulse_times < 3e9 + 2.0],
                               rtol=0, atol=1e-6)


@pytest.mark.parametrize(('chosen', 'played'), [('', True), ('kp', True), ('other', False)])
def test_keyphasor_of_a_bag_is_chosen(
        ros_graph, tmp_path, recording, chosen, played):
    pytest.importorskip('rosbags')
    write_bag(tmp_path / 'bag', recording, keyphasor='kp')
    player = Bench(ros_graph, tmp_path / 'bag', tach='pulses', recorded_keyphasor=chosen)
    player.play()
    assert len(player.pulses) == played * np.count_nonzero(recording.pulse_times < 7.0)


def test_pulses_rounded_up_to_a_clock(bench, recording):
    player = bench(keyphasor_rate=330.0, tach='reference')
    player.play()
    wanted = np.ceil(recording.reference_pulse_times * 330.0) / 330.0
    np.testing.assert_allclose(player.pulses, wanted, rtol=0, atol=1e-9)


def test_message_types(bench, recording):
    player = bench(vibration=Float32MultiArray, vibration_type='std_msgs/Float32MultiArray',
                   pulse=Float64MultiArray, tach_type='std_msgs/msg/Float64MultiArray')
    player.play()
    np.testing.assert_array_equal(player.samples(), recording.read().astype(np.float32))
    np.testing.assert_array_equal(player.pulses, recording.pulse_times[recording.pulse_times < 7])


def test_loop_goes_on_in_time_and_index(bench, recording):
    player = bench(loop=True, tach='both')
    assert player.spin(lambda: len(player.received['vibration']) > 110)
    samples = player.samples()
    np.testing.assert_array_equal(samples[:, 4000:8000], recording.read())
    last = player.blocks[-1]
    assert last.start_time == pytest.approx(5.0 + last.index / RATE)
    assert player.waveform[-1].index > 3 * 10_000
    inside = recording.pulse_times[(recording.pulse_times >= 5) & (recording.pulse_times < 7)]
    first = recording.pulse_times[recording.pulse_times < 7].size
    np.testing.assert_allclose(player.pulses[first:first + inside.size], inside + 2.0, rtol=0,
                               atol=1e-9)
    assert (np.diff(player.pulses) > 0).all()
    player.node.set_parameters([Parameter('loop', value=False)])
    player.play()
    assert len(player.samples()[0]) % 4000 == 0


def test_a_loop_that_begins_after_the_end_is_refused(bench):
    player = bench()
    player.play()
    assert player.set_parameter('loop', True) == (
        False, 'loop is true after the end: set playing: true with it')
    player.node.set_parameters_atomically([Parameter(name, value=True)
                                           for name in ('loop', 'playing')])
    assert player.spin(lambda: len(player.received['vibration']) > 120)


def test_a_recording_that_nobody_takes_is_a_warning(ros_graph, tmp_path, recording, capfd):
    write_npz(tmp_path / 'rig.npz', recording)
    node = ros_graph.add(RecordingPlayer, {
        'recording': str(tmp_path / 'rig.npz'), 'rate': 50.0, 'wait_seconds': 0.0})
    assert ros_graph.spin(lambda: not node.get_parameter('playing').value)
    assert capfd.readouterr().err.count('nobody took the vibration') == 1


def test_nan_is_a_gap(bench, recording):
    vibration = recording.read()
    vibration[:, 950:1730] = np.nan
    vibration[1, 300:310] = np.inf  # the other channel has them
    player = bench(replace(recording, vibration=ArraySource(vibration)))
    player.play()
    starts = [block.index for block in player.blocks]
    assert {0, 900, 1730, 1800} <= set(starts)
    assert not any(950 <= index < 1730 for index in starts)
    assert player.node.counts['samples_dropped'] == 780
    vibration[1, 300:310] = np.nan
    for block in player.blocks:
        np.testing.assert_array_equal(block.samples, vibration[:, block.index:block.end_index])


@pytest.fixture
def clock(monkeypatch):
    """Return the clock of the players; it stands still until a test moves it."""
    found = SteadyClock()
    monkeypatch.setattr(playback, 'time', found)
    return found


def test_stop_go_and_rate(bench, clock):
    player = bench(rate=1.0)
    player.tick()  # starts
    for _ in range(3):
        clock.now += 0.04  # due are 0.8, 1.6 and 2.4 blocks
        player.tick()
    assert len(player.samples()[0]) == 300
    player.node.set_parameters([Parameter('playing', value=False)])
    clock.now += 10.0
    player.tick()
    assert len(player.samples()[0]) == 300
    player.node.set_parameters([Parameter('rate', value=40), Parameter('playing', value=True)])
    clock.now += 0.05
    player.play()
    assert len(player.samples()[0]) == 4000
    assert 'ended' in player.node.summary()[0]


def test_signals_that_are_late_are_delayed_with_a_warning(bench, clock):
    player = bench(rate=1.0)
    player.tick()
    clock.now += 1.2
    player.tick()
    assert 200 <= len(player.samples()[0]) <= 300  # of 2400: due are none, or one by rounding
    assert 'cannot send at 1 x real time' in player.diagnostics()[1]
    clock.now += 0.05
    player.tick()
    assert 300 <= len(player.samples()[0]) <= 400


def test_defect_in_a_recording_ends_it_with_a_lasting_error(bench, recording):
    vibration = recording.read()
    vibration[0, 1234] = 1e200
    player = bench(replace(recording, vibration=ArraySource(vibration)))
    player.play()
    assert len(player.samples()[0]) == 1200
    for _ in range(2):
        level, text, _ = player.diagnostics()
        assert level == DiagnosticStatus.ERROR
        assert text.startswith('ended early: ')
        assert 'rig.npz: sample of 1e+200: must be within' in text


def test_recording_can_be_played_again_after_its_end(bench, recording):
    player = bench()
    player.play()
    player.node.set_parameters([Parameter('playing', value=True)])
    player.play()
    np.testing.assert_array_equal(player.samples()[:, 4000:], recording.read())


def test_messages_stay_small(bench):
    vibration = np.zeros((400, 3000))
    player = bench(Recording(ArraySource(vibration), 10_000.0), block_seconds=0.1)
    player.play()
    assert 250_000 < 8 * player.blocks[0].samples.size < 300_000


def test_diagnostics_contain_the_progress(bench, clock):
    player = bench(rate=1.0)
    player.tick()
    clock.now += 0.08
    player.tick()
    _, text, values = player.diagnostics()
    assert 'playing' in text
    assert 'of 2.0 s' in text
    assert {'samples_dropped', 'pulses_dropped'} <= values.keys()
    assert values['seconds_sent'] == '0.100'


def waits_half_a_second(node, clock):
    """Assert that a node that is to play from now on waits for subscribers before it does."""
    clock.now += 0.4
    node._tick()
    assert 'waiting' in node.summary()[0]
    clock.now += 0.2
    node._tick()
    assert 'playing' in node.summary()[0]


def test_player_waits_for_subscribers(ros_graph, clock, tmp_path, recording):
    write_npz(tmp_path / 'rig.npz', recording)
    node = ros_graph.add(RecordingPlayer, {
        'recording': str(tmp_path / 'rig.npz'), 'wait_seconds': 0.5})
    node._tick()
    assert 'waiting' in node.summary()[0]
    waits_half_a_second(node, clock)


def test_player_that_was_paused_waits_for_subscribers_when_it_is_to_play(
        ros_graph, clock, tmp_path, recording):
    write_npz(tmp_path / 'rig.npz', recording)
    node = ros_graph.add(RecordingPlayer, {
        'recording': str(tmp_path / 'rig.npz'), 'wait_seconds': 0.5, 'playing': False})
    clock.now += 100.0
    node._tick()
    assert 'paused' in node.summary()[0]
    node.set_parameters([Parameter('playing', value=True)])
    waits_half_a_second(node, clock)


def test_pacer_follows_clock_and_rate_and_skips_a_lag():
    pacer = Pacer(2.0)
    assert pacer.due(100.0) == 0.0
    pacer.run(100.0, rate=2.0, running=True)
    assert pacer.due(101.5) == 3.0
    pacer.run(101.5, rate=10.0, running=True)
    assert pacer.due(102.0) == 8.0
    pacer.run(102.0, rate=10.0, running=False)
    assert pacer.due(200.0) == 8.0
    pacer.skip(1.0)
    assert pacer.due(200.0) == 7.0


@pytest.mark.parametrize(('parameters', 'error', 'message'), [
    ({'recording': ''}, ParameterError, 'set the parameter recording'),
    ({'recording': '/nowhere.npz'}, RecordingError, 'no such file'),
    ({'rate': 0.0}, ParameterError, 'rate is 0.0'),
    ({'tach': 'pulse'}, ParameterError, "tach is 'pulse'"),
    ({'vibration_type': 'sensor_msgs/Imu'}, ParameterError, 'vibration_type'),
    ({'acquisition': 3}, RecordingError, 'acquisition 3'),
    ({'tach_channel': 'z'}, RecordingError, "no channel 'z'"),
    ({'fields': ['raito=2']}, ParameterError, 'a recording has no field raito'),
])
def test_unusable_parameters_are_refused(bench, parameters, error, message):
    with pytest.raises(error, match=message):
        bench(**parameters)


def test_keyphasor_that_the_recording_lacks_is_refused(bench, recording):
    with pytest.raises(ParameterError, match='the recording contains waveform, reference'):
        bench(replace(recording, pulse_times=None), tach='pulses')


def test_a_target_that_no_averager_takes_is_refused_as_there(
        recording, tmp_path, capfd, monkeypatch):
    message = 'target_angles has 2 angles for a target of 7 marks: give one for each, in rad'
    write_npz(tmp_path / 'rig.npz', replace(recording, pulses_per_revolution=7))
    file = tmp_path / 'machine.yaml'
    file.write_text(section_text('synchronous_averager', {
        'pulses_per_revolution': 7, 'target_geometry': 'given', 'target_angles': [0.1, -0.1]}))
    assert average.main([str(tmp_path / 'rig.npz'), '--params', str(file), '--output',
                         str(tmp_path / 'out'), '--quiet']) == 2
    assert message in capfd.readouterr().err
    monkeypatch.setattr('sys.argv', [
        'recording_player', '--ros-args', '-p', f'recording:={tmp_path / "rig.npz"}',
        '--params-file', str(file)])
    assert recording_player.main() == 2
    said = capfd.readouterr().err
    assert f'error: {message}' in said
    assert said.count('\n') == 1


def test_main_ends_with_one_line_on_bad_input(capfd):
    assert recording_player.main(['--ros-args', '-p', 'recording:=/nowhere.npz']) == 2
    assert 'error: /nowhere.npz: no such file or folder' in capfd.readouterr().err
    assert recording_player.main(['--field', 'raito=2', '--ros-args', '-p',
                                  'recording:=/nowhere.npz']) == 2
    assert 'error: a recording has no field raito: give some of' in capfd.readouterr().err
