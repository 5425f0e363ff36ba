# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Wheels with an extra mark, or with marks at any angles: found, and averaged as declared."""


import numpy as np
import pytest
import sa_jitter_ros as sa
from sa_jitter_ros.keyphasor_check.check import check_keyphasor
from sa_jitter_ros.keyphasor_check.machine_file import machine_file, machine_parameters
from sa_jitter_ros.keyphasor_check.marks import number_and_patterns
from sa_jitter_ros.keyphasor_check.plausibility import doubts
from sa_jitter_ros.nodes.recording_player import RecordingPlayer
from sa_jitter_ros.recordings import write_npz
from sa_jitter_ros.recordings.recording import ArraySource, Recording

pytestmark = pytest.mark.filterwarnings('ignore::sa_jitter_ros.errors.DataWarning')
SPEED = 20.0


def edges_of(widths):
    """Return the angles of marks in revolutions."""
    return np.append(0.0, np.cumsum(widths))[:-1] / np.sum(widths)


def with_extra(marks, share):
    """Return the angles of even marks and of another one in front of the second."""
    return edges_of([share, 1.0 - share, *np.ones(marks - 1)])


def pulses_on(rng, edges, *, turns=60, share=0.0, ramp=0.2, jitter=2e-5):
    """Return pulses in s of a speed that grows; a `share` of them is lost, as many are strays."""
    angle = (np.arange(turns)[:, None] + edges).ravel()
    times = (angle - ramp * angle**2 / (2.0 * turns)) / SPEED
    times += rng.normal(0.0, jitter / SPEED, times.size)
    kept = times[rng.random(times.size) >= share]
    return np.sort(np.append(kept, rng.uniform(times[0], times[-1], round(share * times.size))))


@pytest.mark.machines
@pytest.mark.parametrize('share', [0.0, 0.01])
@pytest.mark.parametrize('marks', [4, 12, 24, 60])
def test_an_extra_mark_is_a_mark(rng, marks, share):
    edges = with_extra(marks, rng.uniform(0.15, 0.45))
    numbered, found = number_and_patterns(pulses_on(rng, edges, share=share))
    assert (found[0].teeth, found[0].present) == (marks + 1, marks + 1)
    wrong = 2.0 * share * 60 * (marks + 1)
    assert numbered.strays.size <= 3.0 * np.sqrt(wrong) + wrong + 2


@pytest.mark.parametrize('marks', [5, 17])
def test_marks_at_any_angles_are_measured(rng, marks):
    edges = edges_of(rng.uniform(0.3, 1.7, marks))
    check = check_keyphasor(Recording(ArraySource(np.zeros((1, 100))), 100.0,
                                      pulse_times=pulses_on(rng, edges, ramp=0.0)))
    assert check.findings['pulses_per_revolution'].value == marks
    found = np.array(check.findings['marks'].value)
    late = 2.0 * np.pi * (edges - np.arange(marks) / marks)
    apart = [np.ptp(np.roll(late, -turn) - found) for turn in range(marks)]
    assert min(apart) < 2e-3 * 2.0 * np.pi


def test_few_uneven_marks_are_counted_to_the_ends_of_a_long_recording(rng):
    numbered, found = number_and_patterns(
        pulses_on(rng, np.array([0.0, 0.31, 0.62]), turns=400, ramp=0.0))
    assert (found[0].teeth, found[0].present, numbered.strays.size) == (3, 3, 0)
    assert np.array_equal(np.diff(numbered.numbers), np.ones(1199))


def test_teeth_that_one_half_of_a_recording_never_shows_are_missing_there(rng):
    pulses = pulses_on(rng, np.array([0.0, 0.05, 0.12]), turns=30, ramp=0.0)
    check = check_keyphasor(Recording(ArraySource(np.zeros((1, 100))), 100.0, pulse_times=pulses))
    assert check.findings['pulses_per_revolution'].value == 3


@pytest.mark.machines
@pytest.mark.parametrize(('teeth', 'missing'), [(60, 2), (36, 1)])
def test_missing_teeth_stay_missing_teeth_among_many_strays(rng, teeth, missing):
    edges = np.arange(teeth - missing) / teeth
    _, found = number_and_patterns(pulses_on(rng, edges, share=0.03))
    assert (found[0].teeth, found[0].present) == (teeth, teeth - missing)


def test_even_marks_among_many_strays_have_no_pattern(rng):
    for marks in (2, 7, 30):
        _, found = number_and_patterns(
            pulses_on(rng, np.arange(marks) / marks, share=0.1, turns=1000 // marks))
        assert not found


@pytest.mark.machines
def test_what_is_found_is_averaged_without_loss(rng):
    """Orders come back, and no pulse of the extra mark is taken for a double."""
    edges, rate = with_extra(12, 0.34), 6000.0
    pulses = pulses_on(rng, edges, turns=80, ramp=0.0, jitter=1e-6)
    turns = SPEED * np.arange(round(rate * (pulses[-1] + 0.1))) / rate
    samples = [sum(np.cos(2.0 * np.pi * order * turns) for order in (1.0, 5.0, 24.0))
               + 0.1 * rng.normal(size=turns.size)]
    recording = Recording(ArraySource(np.array(samples)), rate, pulse_times=pulses)
    check = check_keyphasor(recording)
    assert check.findings['spurious'].value['count'] == 0
    declared = machine_parameters(check)['synchronous_averager']
    assert not doubts(recording, pulses, orders=(1.0, 5.0, 24.0), pulses_per_revolution=13,
                      target_geometry='given', target_angles=declared['target_angles'])
    averages = sa.average(samples, rate, pulses, orders=[1.0, 5.0, 24.0], **{
        name: declared[name] for name in (
            'pulses_per_revolution', 'trigger_cycles', 'target_geometry', 'target_angles')})
    assert len(averages) >= 7
    for average in averages:
        assert np.max(np.abs(np.abs(average.amplitudes) - 1.0)) < 0.02


@pytest.fixture
def files(rng, tmp_path):
    """Return the paths of a recording of a wheel with an extra mark, and of its machine file."""
    pulses = pulses_on(rng, with_extra(12, 0.34), turns=120, ramp=0.0, jitter=2e-5)
    turns = SPEED * np.arange(round(3000.0 * (pulses[-1] + 0.1))) / 3000.0
    samples = np.cos(2.0 * np.pi * turns) + np.cos(48.0 * np.pi * turns)
    recording = Recording(ArraySource((samples + 0.1 * rng.normal(size=turns.size))[None]), 3000.0,
                          pulse_times=pulses)
    write_npz(tmp_path / 'rig.npz', recording)
    (tmp_path / 'rig.yaml').write_text(machine_file(check_keyphasor(recording), 'rig'))
    return tmp_path / 'rig.npz', tmp_path / 'rig.yaml'


@pytest.mark.machines
@pytest.mark.usefixtures('unasked')
def test_library_takes_the_target_of_the_machine_file(files):
    path, params = files
    found = sa.close_loop(path, params)
    assert found.faults == ()
    assert (found.verdict, found.found) == ('none', ())


@pytest.mark.machines
def test_player_takes_the_target_of_the_machine_file(files, ros_graph):
    path, params = files
    alone, with_file = (ros_graph.add(RecordingPlayer, cli_args=[
        '--ros-args', *given, '-p', f'recording:={path}', '-p', 'playing:=false'])
        for given in ([], ['--params-file', str(params)]))
    assert 'a stray comes after every 12 pulses' in alone._last_warning
    assert with_file._last_warning == ''
