# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Pulses, vibration and declaration that contradict each other get one plain sentence each."""

from dataclasses import replace

import numpy as np
import pytest
from sa_jitter_ros.commands import close_loop
from sa_jitter_ros.commands.demo_plan import plan_doubts, plan_recording
from sa_jitter_ros.errors import DataWarning, RecordingError
from sa_jitter_ros.keyphasor_check.plausibility import doubts, weak_orders
from sa_jitter_ros.loop import close_loop as loop
from sa_jitter_ros.nodes.recording_player import RecordingPlayer
from sa_jitter_ros.recordings import read, write_npz
from sa_jitter_ros.recordings.channel_check import bad_channels, usable_channels
from sa_jitter_ros.recordings.recording import ArraySource, Recording

RATE, SPEED, SECONDS, CLOCK = 5000.0, 25.0, 10.0, 4000.0
DECLARED = {'keyphasor_rate': CLOCK, 'trigger_speed': SPEED, 'trigger_cycles': 20,
            'orders': [8, 16]}


@pytest.fixture
def recording(rng):
    """Return a machine whose pulses are timed by a slow clock, as declared."""
    time = np.arange(int(RATE * SECONDS)) / RATE
    turns = SPEED * time + 0.01 * time**2
    true = np.interp(np.arange(1, int(SPEED * SECONDS) - 1), turns, time)
    samples = np.cos(16.0 * np.pi * turns) + 0.8 * np.cos(32.0 * np.pi * turns + 1.0)
    return Recording(ArraySource((samples + rng.normal(0.0, 0.1, time.size))[None]), RATE,
                     pulse_times=np.ceil(true * CLOCK) / CLOCK, tach_rate=CLOCK,
                     orders=(8.0, 16.0), channel_names=('bearing',))


def with_bad_channels(recording):
    """Return a recording with a NaN, a dead and a saturated channel beside the good one."""
    good = recording.read()[0]
    return replace(recording, units=(), channel_names=('loose', 'bearing', 'dead', 'clipped'),
                   vibration=ArraySource(np.array([
                       np.full(good.size, np.nan), good, np.zeros(good.size),
                       np.clip(good, -0.5, 0.5)])))


def of(recording, **declared):
    """Return the doubts about a recording."""
    return doubts(recording, recording.pulse_times, **{
        'orders': recording.orders, 'jitter_std': 1.0 / CLOCK / np.sqrt(12.0), **declared})


def test_nothing_is_doubted_where_all_fits(recording):
    assert of(recording) == ()
    assert of(replace(recording, tach_rate=None)) == ()


@pytest.mark.parametrize(('change', 'declared', 'text'), [
    (lambda r: {'pulse_times': 1e3 * r.pulse_times}, {}, 'look like milliseconds'),
    (lambda r: {'sample_rate': RATE / 1e3}, {}, 'looks like kHz'),
    (lambda r: {'pulse_times': r.pulse_times[:60]}, {}, 'the pulses span 2.3'),
    (lambda r: {'vibration': ArraySource(r.read()[:, :r.samples // 2])}, {}, 'the pulses span '),
    (lambda r: {'pulse_times': r.pulse_times[r.pulse_times < 9.0],
                'sample_rate': RATE / 1.03}, {}, 'none of the orders 8, 16 stands above'),
    (lambda r: {}, {'ratio': 1.37}, 'Hz and ratio 1.37'),
    (lambda r: {}, {'pulses_per_revolution': 7}, 'none of the orders 8, 16 stands above'),
    (lambda r: {}, {'jitter_std': 2e-6}, 'but 2 us are declared'),
])
def test_what_does_not_fit_is_said_once(recording, change, declared, text):
    found = of(replace(recording, **change(recording)), **declared)
    assert text in ' '.join(found)
    assert len(found) == 1


@pytest.mark.parametrize(('factor', 'found'), [(2.0, 0), (0.5, 0), (6.0, 1), (0.1, 1)])
def test_a_declared_jitter_of_another_size_is_named(recording, factor, found):
    assert len(of(recording, jitter_std=factor / CLOCK / np.sqrt(12.0))) == found


@pytest.mark.parametrize('geometry', ['none', 'learn', 'given'])
@pytest.mark.parametrize(('declared', 'found'), [(None, 0), (2e-5, 0), (2e-6, 1), (4e-4, 1)])
def test_the_scatter_of_pulses_is_that_beside_their_uneven_marks(
        gearbox, rng, geometry, declared, found):
    late = rng.normal(0.0, 0.005, 8)
    rig = gearbox(EIGHT + late - late.mean())
    pulses = rig.pulse_times + rng.normal(0.0, 2e-5, rig.pulse_times.size)
    said = doubts(rig, pulses, pulses_per_revolution=8, jitter_std=declared,
                  target_geometry=geometry,
                  target_angles=tuple(2.0 * np.pi * (late - late.mean())))
    assert len(said) == found
    assert all(text.startswith(('the pulses scatter by 19', 'the pulses scatter by 2'))
               for text in said)


def test_no_jitter_is_doubted_where_the_speed_hides_it(shared_data):
    rig = read(shared_data / 'encoder_motor_slow.npz')
    said, = doubts(rig, rig.pulse_times, pulses_per_revolution=16, jitter_std=1e-6)
    assert said.startswith('the speed scatters so much')


def test_a_standstill_is_no_other_target(recording):
    times = recording.pulse_times
    assert of(replace(recording, pulse_times=times[(times < 3.0) | (times > 7.0)])) == ()


@pytest.fixture
def gearbox(rng):
    """Return a function for a machine with a shaft at 2.5 times the speed, and 8 marks."""
    time = np.arange(int(6400.0 * SECONDS)) / 6400.0
    turns = 20.0 * time + 0.02 * np.sin(time)
    samples = rng.normal(0.0, 0.3, time.size)
    for order in (1.0, 2.0, 3.0, 11.37, 24.02, 2.5, 5.0, 37.5, 75.0):
        samples += rng.uniform(0.3, 1.0) * np.cos(2.0 * np.pi * order * turns)

    def made(marks, first=0.0, last=1.0):
        """Return the machine with pulses of `marks` (revolutions) in a part of its time."""
        every = (np.arange(1, int(20.0 * SECONDS) - 1)[:, None] + np.asarray(marks)).ravel()
        pulses = np.interp(every, turns, time)
        return Recording(ArraySource(samples[None]), 6400.0, ratio=2.5,
                         orders=(1.0, 2.0, 15.0, 30.0), pulse_times=pulses[
                             (pulses > first * SECONDS) & (pulses < last * SECONDS)])
    return made


EIGHT = np.arange(8) / 8.0


@pytest.mark.parametrize(('declared', 'texts'), [
    ({}, ()), ({'ratio': 2.4}, ('none of the orders 1, 2, 15, 30', 'ratio 2.4')),
    ({'pulses_per_revolution': 4}, ('pulses_per_revolution 8 instead of 4',)),
    ({'pulses_per_revolution': 16}, ('pulses_per_revolution 8 instead of 16',)),
    ({'pulses_per_revolution': 7}, ('none of the orders 1, 2, 15, 30', 'pulses_per_revolution')),
])
def test_what_leaks_from_strong_lines_is_no_order(gearbox, declared, texts):
    rig = gearbox(EIGHT)
    found = doubts(rig, rig.pulse_times, **{
        'orders': rig.orders, 'ratio': 2.5, 'pulses_per_revolution': 8, **declared})
    assert len(found) == bool(texts)
    assert all(text in found[0] for text in texts)


@pytest.mark.parametrize(('first', 'second', 'declared', 'text'), [
    (EIGHT, EIGHT[:7], {'missing_teeth': 1}, 's give no trigger cycle: they are not those of a '
     'target with 8 marks a revolution, 1 of them missing'),
    (EIGHT, EIGHT[:7], {}, 's give no trigger cycle: they are not those of a target with 8 marks'),
    (EIGHT[:7], EIGHT[:6], {'missing_teeth': 1}, 'give no trigger cycle'),
    (EIGHT, EIGHT[::2], {}, 'every other pulse is missing'),
    (EIGHT[:1], [0.0, 0.4], {'pulses_per_revolution': 1}, 'pulses are strays'),
])
def test_a_target_that_changes_half_way_is_named(gearbox, first, second, declared, text):
    pulses = np.concatenate([gearbox(first, last=0.5).pulse_times,
                             gearbox(second, first=0.5).pulse_times])
    found, = doubts(gearbox(EIGHT), pulses, **{'pulses_per_revolution': 8, **declared})
    assert text in found


@pytest.mark.parametrize(('offset', 'text'), [
    (0.5, 'pulses_per_revolution 2 instead of 1'), (0.499, 'longer and shorter in turns'),
    (0.3, 'are strays: is there a second keyphasor'), (0.05, 'are strays: is there a second'),
])
def test_two_keyphasors_of_one_name_are_named(gearbox, rng, offset, text):
    rig = gearbox([0.0, offset])
    pulses = np.sort(rig.pulse_times + rng.normal(0.0, 2e-6, rig.pulse_times.size))
    found, = doubts(rig, pulses, orders=rig.orders, ratio=2.5)
    assert text in found


def test_noise_alone_is_seldom_taken_for_an_order(rng):
    """Of 30 recordings of noise at most one has an order above it, by chance."""
    time, missed = np.arange(20_000) / 2e3, 0
    for _ in range(30):
        noise = Recording(ArraySource(rng.normal(size=(1, time.size))), 2e3)
        missed += not doubts(noise, np.arange(200) / 20.0, orders=(3.0, 7.0, 19.0))
    assert missed <= 1


@pytest.mark.parametrize(('strong', 'weak', 'marks', 'declared'), [
    ((8, 16, 24), (1, 2, 3), 1, 8), ((1, 2, 3), (8, 16, 24), 8, 1)])
def test_marks_of_an_eighth_or_eight_times_as_many_are_named(rng, strong, weak, marks, declared):
    time = np.arange(int(RATE * SECONDS)) / RATE
    lines = [(order, 1.0) for order in strong] + [(order, 0.05) for order in weak]
    samples = rng.normal(0.0, 0.01, time.size) + sum(
        size * np.cos(40.0 * np.pi * order * time + order) for order, size in lines)
    pulses = np.arange(1, int(20 * SECONDS * marks)) / (20.0 * marks)
    found, = doubts(Recording(ArraySource(samples[None]), RATE), pulses, orders=strong,
                    pulses_per_revolution=declared)
    assert f'pulses_per_revolution {marks} instead of {declared} they are far larger' in found


def test_bad_channels_are_left_out_and_named(recording):
    found, remarks = usable_channels(with_bad_channels(recording))
    assert found.channel_names == ('bearing', 'clipped')
    assert [text.split(':')[0] for text in remarks] == [
        'loose is NaN or infinite in 100% of its samples and is left out',
        'dead is constant at 0 and is left out', remarks[2].split(':')[0]]
    assert remarks[2].startswith('clipped is saturated in')


def test_counts_of_a_converter_are_not_saturated(rng):
    counts = np.rint(rng.normal(0.0, 20.0, (3, 5000)))
    switch = (rng.random(5000) > 0.5).astype(float)
    assert bad_channels(np.vstack([counts, switch])) == {}


def test_signal_that_reaches_one_end_of_a_symmetric_range_more_often_is_saturated(rng):
    skewed = rng.gamma(1.0, 1.0, 20_000) - 1.0
    symmetric = np.where(rng.random(skewed.size) < 1e-3, -2.0, np.clip(skewed, -2.0, 2.0))
    assert bad_channels(symmetric[None])[0].startswith('is saturated in 5%')
    assert bad_channels(np.maximum(skewed, -0.9)[None]) == {}  # it rests at one end


# --- where users meet it ------------------------------------------------------------------------

def test_demo_plans_with_the_good_channels_and_says_what_is_doubtful(recording, tmp_path):
    good, _ = usable_channels(with_bad_channels(recording))
    plan = plan_recording(tmp_path / 'rig.npz', good)
    assert plan.channels == ('bearing', 'clipped')
    assert plan_doubts(plan, good) == ()
    wrong = replace(good, ratio=1.37)
    doubt, = plan_doubts(plan_recording(tmp_path / 'rig.npz', wrong), wrong)
    assert 'ratio 1.37' in doubt
    with pytest.raises(RecordingError, match='look like milliseconds'):
        plan_recording(tmp_path / 'rig.npz', replace(
            good, pulse_times=1e3 * recording.pulse_times))


def test_player_plays_the_good_channels_and_warns(recording, tmp_path, ros_graph):
    write_npz(tmp_path / 'rig.npz', replace(with_bad_channels(recording), ratio=1.37))
    node = ros_graph.add(RecordingPlayer, cli_args=[
        '--ros-args', '-p', f'recording:={tmp_path / "rig.npz"}', '-p', 'playing:=false'])
    assert node._recording.channel_names == ('bearing', 'clipped')
    assert 'ratio 1.37' in node._last_warning


@pytest.mark.machines
@pytest.mark.usefixtures('unasked')
def test_loop_uses_the_good_channels_and_warns(recording):
    bad = with_bad_channels(recording)
    holes = np.vstack((bad.read(), recording.read()))
    holes[-1, 5000:5100] = np.nan
    bad = replace(bad, vibration=ArraySource(holes), units=(),
                  channel_names=(*bad.channel_names, 'gappy'))
    with pytest.warns(DataWarning) as caught:
        found = loop(bad, DECLARED)
    with pytest.warns(DataWarning, match='clipped is saturated'):
        good = loop(usable_channels(with_bad_channels(recording))[0], DECLARED)
    same = {'created': found.created, 'remarks': found.report['remarks']}
    assert found.report == {**good.report, **same}
    assert found.report['remarks'] == [str(item.message) for item in caught]
    assert [str(item.message).split(': ', 1)[1][:12] for item in caught] == [
        'loose is NaN', 'dead is cons', 'clipped is s', 'gappy is NaN']


@pytest.mark.machines
@pytest.mark.usefixtures('undrawn', 'unasked')
def test_command_prints_a_warning_as_a_line(recording, tmp_path, capsys):
    write_npz(tmp_path / 'rig.npz', with_bad_channels(recording))
    (tmp_path / 'model.yaml').write_text('jitter_predictor:\n  ros__parameters:\n' + ''.join(
        f'    {key}: {value}\n' for key, value in DECLARED.items()))
    assert close_loop.main([str(tmp_path / 'rig.npz'), '--declared', str(tmp_path / 'model.yaml'),
                            '--output', str(tmp_path / 'out'), '--quiet']) == 0
    said = capsys.readouterr().err.splitlines()
    assert (f'close_loop: warning: {tmp_path / "rig.npz"}: dead is constant at 0 and is left '
            'out') in said
    assert len(said) == 3


@pytest.mark.machines
def test_loop_names_orders_that_are_not_there(recording):
    with pytest.warns(DataWarning, match='none of the orders 5, 11 stands above'):
        loop(recording, {**DECLARED, 'orders': [5, 11]})


@pytest.mark.machines
def test_loop_names_orders_that_are_not_there_without_pulse_times(recording):
    pulses = recording.pulse_times
    with pytest.warns(DataWarning, match='none of the orders 5, 11 stands above'):
        loop(replace(recording, pulse_times=None, tach_rate=None, reference_pulse_times=pulses),
             {**DECLARED, 'orders': [5, 11]})


@pytest.mark.parametrize(('orders', 'text'), [
    ([23, 46, 69], ''), ([24, 48, 72], 'no line beside 23, 46, 69, each at least 5 times'),
    ([24], ''), ([24, 46], ''), ([23, 24], ''), ([26, 52, 78], 'none of'),
    ([21, 42, 63], 'beside 23')])
def test_harmonics_beside_a_larger_family_are_named(rng, orders, text):
    turns = np.cumsum(np.full(100_000, 20.0)) / 5e3
    mesh = sum((1.0 + 0.1 * np.cos(2.0 * np.pi * turns) + 0.06 * np.cos(4.0 * np.pi * turns))
               * np.cos(2.0 * np.pi * g * turns + g) for g in (23, 46, 69))
    rig = Recording(ArraySource((mesh + 0.01 * rng.normal(size=turns.size))[None]), 5e3)
    found = weak_orders(rig, np.arange(1, 399) / 20.0, orders, ratio=1.0,
                        pulses_per_revolution=1, pulses_per_trigger=None, missing_teeth=0)
    assert (text in found[0]) if text else found == ()


@pytest.mark.parametrize(('marks', 'text'), [
    (1, ''), (2, 'pulses_per_revolution 1 instead of 2 all of them do'),
    (4, 'pulses_per_revolution 1 instead of 4 they are far larger')])
def test_other_marks_of_a_measured_gearbox_are_named(shared_data, marks, text):
    """With 4 marks its orders stand, too: on weak lines at quarters of the mesh order."""
    machine = np.load(shared_data / 'gear0_gearbox.npz')
    found = weak_orders(
        Recording(ArraySource(machine['vibration']), float(machine['sample_rate'])),
        machine['reference_pulse_times'], machine['orders'].tolist(), ratio=1.0,
        pulses_per_revolution=marks, pulses_per_trigger=None, missing_teeth=0)
    assert len(found) == bool(text)
    assert not text or text in found[0]
