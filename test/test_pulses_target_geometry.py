# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The geometry of a target: measured, given, found again, and taken from the pulses."""

import numpy as np
import pytest
import sa_jitter_ros as sa
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.pulses.mark_corrector import MarkCorrector
from sa_jitter_ros.pulses.target_geometry import measured_geometry
from sa_jitter_ros.pulses.trigger_counter import TriggerCounter, TriggerPulses
from sa_jitter_ros.pulses.validation import PulseValidator

pytestmark = pytest.mark.filterwarnings('ignore::sa_jitter_ros.errors.DataWarning')

SPEED, ERROR = 50.0, 5e-6
LATE = np.array([0.012, -0.004, 0.0, -0.008])  # rad
#: standard error (rad) of a mark by white errors of all pulses of 100 revolutions
WHITE = 2.0 * np.pi * SPEED * ERROR / np.sqrt(100)


def pulses_of(revolutions, *, late=LATE, teeth=4, first=0, start=0.0, rng, error=ERROR):
    """Return pulses at 50 Hz; `first` is the tooth of the first one, which comes at `start`."""
    numbers = np.arange(first, first + round(revolutions * teeth))
    numbers = numbers[numbers % teeth < len(late)]
    turns = (numbers - first) / teeth + np.asarray(late)[numbers % teeth] / (2.0 * np.pi)
    return start + turns / SPEED + rng.normal(0.0, error, numbers.size)


def validated(pulses, *, pieces=30, **options):
    """Feed pulses in so many pieces; return validator, trigger pulses and messages."""
    validator = PulseValidator(**{'pulses_per_revolution': 4, 'pulses_per_trigger': 1, **options})
    found, lines = [], []
    for piece in np.array_split(pulses, pieces):
        found.append(validator.update(piece))
        lines += validator.take_messages()
    found.append(validator.flush())
    return validator, TriggerPulses.joined(found), lines + validator.take_messages()


def scatter(found):
    """Return how far trigger cycles are from their median, in s."""
    cycles = np.diff(found.times)[~found.starts_run[1:]]
    return np.std(cycles - np.median(cycles))


@pytest.mark.parametrize('speeds', [(50.0, 50.0), (40.0, 60.0)])
@pytest.mark.parametrize(('teeth', 'present'), [(2, 2), (4, 4), (36, 35)])
def test_standard_errors_are_those_of_white_jitter(rng, teeth, present, speeds):
    off, stated = [], []
    there = np.arange(present)
    for _ in range(20):
        late = rng.normal(0.0, 0.01 / teeth, present)
        late -= late.mean()
        numbers = np.arange(100 * teeth + 1)
        numbers = numbers[numbers % teeth < present]
        turns = numbers / teeth + late[numbers % teeth] / (2.0 * np.pi)
        slope = (speeds[1]**2 - speeds[0]**2) / 200.0
        times = 2.0 * turns / (speeds[0] + np.sqrt(speeds[0]**2 + 2.0 * slope * turns))
        geometry = measured_geometry(times + rng.normal(0.0, ERROR, times.size), numbers, there,
                                     teeth)
        off.append(geometry.angles - late)
        stated.append(geometry.standard_errors)
    off, stated = np.array(off), np.array(stated)
    assert np.sqrt(np.mean(off**2)) < 1.3 * WHITE
    assert np.max(stated.mean(axis=0)) < 1.3 * WHITE
    # 20 angles of each mark, but one of them follows from the others
    free = 20.0 * (present - 1)
    assert np.mean((off / stated)**2) == pytest.approx(1.1, abs=0.1 + 4.0 * np.sqrt(2.0 / free))


@pytest.mark.machines
@pytest.mark.parametrize(('teeth', 'present'), [(4, 4), (36, 35)])
def test_order_60_of_uneven_marks_is_that_of_even_ones(rng, teeth, present):
    late = rng.normal(0.0, 0.08 / teeth, present)
    late -= late.mean()
    uneven, even = (pulses_of(500, late=item, teeth=teeth, start=0.003, error=4.0 / teeth * ERROR,
                              rng=np.random.default_rng(5))
                    for item in (late, np.zeros(present)))
    vibration = np.cos(2.0 * np.pi * 60 * SPEED * np.arange(200_000) / 20e3)
    options = {'pulses_per_revolution': teeth, 'missing_teeth': teeth - present,
               'pulses_per_trigger': 1, 'trigger_cycles': 60 * teeth, 'orders': [60.0]}
    true = sa.average(vibration, 20e3, even, **options)
    raw = sa.average(vibration, 20e3, uneven, **options)
    learnt = sa.average(vibration, 20e3, uneven, target_geometry='learn', **options)
    given = sa.average(vibration, 20e3, uneven, target_geometry='given', target_angles=late,
                       **options)
    assert len(true) == len(learnt) == len(given) >= 7
    for average, one, other, uncorrected in zip(true, learnt, given, raw):
        expected = average.amplitudes[0, 0]
        assert abs(one.amplitudes[0, 0] - expected) < 1e-3 * abs(expected)
        assert abs(other.amplitudes[0, 0] - expected) < 1e-3 * abs(expected)
        assert abs(uncorrected.amplitudes[0, 0]) < 0.998 * abs(expected)


def test_the_result_does_not_depend_on_the_pieces(rng):
    pulses = np.concatenate((pulses_of(230, rng=rng), pulses_of(
        120, first=2, start=9.123, rng=rng)))
    kept = pulses[rng.random(pulses.size) > 0.02]
    _, whole, _ = validated(kept, pieces=1, target_geometry='learn')
    for pieces in (7, kept.size):
        _, found, _ = validated(kept, pieces=pieces, target_geometry='learn')
        for name in TriggerPulses.__dataclass_fields__:
            np.testing.assert_array_equal(getattr(found, name), getattr(whole, name))


@pytest.mark.parametrize('mode', ['learn', 'given'])
def test_marks_are_found_again_behind_a_gap(rng, mode):
    before = pulses_of(150, rng=rng)
    behind = pulses_of(150, first=3, start=7.0071, rng=rng)
    validator, found, lines = validated(
        np.concatenate((before, behind)), pulses_per_trigger=4, target_geometry=mode,
        target_angles=LATE)
    assert not lines
    assert validator.counts.geometry_refused == 0
    assert found.starts_run.sum() == 2
    # the same mark begins trigger cycles: the first one after the gap is the second pulse
    first = found.times[np.flatnonzero(found.starts_run)[1]]
    assert first == pytest.approx(behind[1] - (LATE[0]) / (2.0 * np.pi * SPEED), abs=2e-6)
    np.testing.assert_allclose(validator.geometry.angles, LATE - LATE.mean(), atol=5.0 * WHITE)


def test_a_pattern_that_is_another_one_is_refused_with_the_reason(rng):
    pulses = pulses_of(300, rng=rng)
    validator, found, lines = validated(
        pulses, target_geometry='given', target_angles=LATE[::-1])
    assert validator.geometry is None
    assert validator.counts.geometry_refused == 1
    assert len(lines) == 1
    assert lines[0].startswith('target_geometry: the pulses show other marks than those known')
    assert lines[0].endswith('no angles are subtracted; check_keyphasor measures them')
    np.testing.assert_array_equal(found.times, pulses)


def test_a_pattern_hidden_by_jitter_is_refused(rng):
    pulses = pulses_of(300, rng=rng)
    _, found, lines = validated(pulses, target_geometry='given', target_angles=0.01 * LATE)
    assert 'their errors hide the pattern' in lines[0] or 'other marks' in lines[0]
    np.testing.assert_array_equal(found.times, pulses)


@pytest.mark.parametrize('mode', ['learn', 'given'])
def test_a_wheel_that_changes_its_pattern_is_named_once(rng, mode):
    other = np.array([0.0, 0.01, -0.02, 0.01])
    pulses = np.concatenate((pulses_of(300, rng=rng),
                             pulses_of(300, late=other, start=300 / SPEED, rng=rng)))
    validator, found, lines = validated(pulses, target_geometry=mode, target_angles=LATE)
    assert len(lines) == validator.counts.geometry_refused == 1
    assert 'the marks are no longer where they were' in lines[0]
    assert found.times.size > 1190
    if mode == 'learn':
        assert scatter(TriggerPulses(*(item[-800:] for item in vars(found).values()))) < 2 * ERROR


def test_an_even_target_is_never_refused(rng):
    even = np.zeros(4)
    pulses = np.concatenate((pulses_of(250, late=even, rng=rng), pulses_of(
        250, late=even, first=1, start=8.3217, rng=rng)))
    validator, found, lines = validated(pulses, target_geometry='learn')
    assert not lines
    assert not validator.geometry.significant
    assert scatter(found) < 1.1 * np.sqrt(2.0) * ERROR


def test_bridged_and_missing_pulses_do_not_disturb_the_marks(rng):
    pulses = pulses_of(300, rng=rng)
    pulses = pulses[rng.random(pulses.size) > 0.1]
    for missing in ('break', 'bridge'):
        validator, found, _ = validated(pulses, target_geometry='learn', missing_pulses=missing)
        late = validator.geometry.angles - (LATE - LATE.mean())
        turned = min(np.abs(np.roll(late + LATE, turn) - LATE).max() for turn in range(4))
        assert turned < 5.0 * WHITE
        measured = TriggerPulses(*(item[found.measured] for item in vars(found).values()))
        assert scatter(measured) < 2e-3 if missing == 'bridge' else 2.0 * ERROR


def test_few_pulses_pass_as_they_are(rng):
    for count in (0, 1, 3, 12):
        pulses = pulses_of(100, rng=rng)[:count]
        validator, found, _ = validated(pulses, pieces=1, target_geometry='learn')
        assert found.times.tolist() == pulses.tolist()[:found.times.size]
        assert validator.geometry is None


def test_the_vibration_tells_late_marks_from_a_ripple_of_the_speed(rng):
    speed, ripple, late = 20.0, 2e-3, np.array([0.003, -0.001, 0.002, -0.004])
    numbers = np.arange(1600)

    def time_of(turns):
        return turns / speed + ripple / (2.0 * np.pi * speed) * np.sin(2.0 * np.pi * turns)

    pulses = time_of(numbers / 4 + late[numbers % 4] / (2.0 * np.pi)) + rng.normal(
        0.0, ERROR, numbers.size)
    fine = np.linspace(-1.0, 401.0, 402 * 100)
    turns = np.interp(np.arange(400_000) / 20e3, time_of(fine), fine)
    vibration = sum(np.cos(2.0 * np.pi * g * turns) for g in (20, 40, 60))
    vibration += rng.normal(0.0, 0.1, turns.size)
    options = {'pulses_per_revolution': 4, 'pulses_per_trigger': 1, 'trigger_cycles': 200,
               'orders': [60.0], 'keyphasor_rate': 20e3, 'target_geometry': 'learn'}
    alone, helped = (sa.Averager(20e3, correct_jitter=correct, **options)
                     for correct in (False, True))
    by_pulses = alone.update(vibration, pulses) + alone.flush()
    both = helped.update(vibration, pulses) + helped.flush()
    assert not alone.geometry.by_vibration
    assert 'ripple' in alone.geometry.remark
    assert helped.geometry.by_vibration
    # the ripple moves marks 1 and 3 by 2 mrad; the straight angle law adds a part of it again
    off = [abs(item.geometry.angles - late)[[1, 3]].mean() for item in (alone, helped)]
    assert off[0] > 1.8e-3 > 0.8e-3 > off[1]
    assert abs(by_pulses[-1].amplitudes[0, 0]) < 0.997
    assert abs(both[-1].amplitudes[0, 0]) > 0.998


@pytest.mark.parametrize(('options', 'words'), [
    ({'target_geometry': 'given'}, 'target_angles has 0 angles for a target of 4 marks'),
    ({'target_geometry': 'given', 'target_angles': [0.0, 0.8, -0.8, 0.0]},
     'mark 2, -0.8 rad late, is not behind the mark before'),
    ({'target_geometry': 'given', 'target_angles': [0.0, 0.0, np.nan, 0.0]},
     'mark 2, nan rad late, is not behind'),
    ({'target_geometry': 'measure'}, "target_geometry 'measure'"),
    ({'target_geometry': 'given', 'target_angles': [0.0] * 4, 'missing_teeth': 1},
     'target_angles has 4 angles for a target of 3 marks')])
def test_angles_that_cannot_be_used_are_refused(options, words):
    with pytest.raises(ParameterError, match=words):
        PulseValidator(pulses_per_revolution=4, **options)


@pytest.mark.parametrize('extra_mark', [True, False])
def test_marks_at_any_given_angles_are_followed_through_strays_and_losses(rng, extra_mark):
    """One of the marks of an extra mark is as near as .15 of a tooth to the next."""
    for marks in (3, 5, 13, 25):
        widths = np.ones(marks) if extra_mark else rng.uniform(0.3, 1.7, marks)
        if extra_mark:
            widths[1] -= (share := rng.uniform(0.15, 0.5))
            widths[0] = share
        edges = np.append(0.0, np.cumsum(widths))[:-1] / widths.sum()
        late = 2.0 * np.pi * (edges - np.arange(marks) / marks)
        times = pulses_of(100, late=late - late.mean(), teeth=marks, first=1, rng=rng,
                          error=5e-5 / SPEED)
        gone = rng.integers(5 * marks, times.size - 5, 3)
        strays = rng.uniform(times[5 * marks], times[-5], 3)
        validator, found, _ = validated(
            np.sort(np.append(np.delete(times, gone), strays)), pulses_per_revolution=marks,
            pulses_per_trigger=None, target_geometry='given', target_angles=late)
        # A lost or stray pulse costs a trigger cycle or two.
        assert len(found.times) >= 90
        phase = np.angle(np.exp(2j * np.pi * found.times * SPEED))
        assert np.max(np.abs(phase - np.median(phase))) < 2e-3 * 2.0 * np.pi
        assert validator.counts.accepted >= times.size - 6


def dropouts(rng, pulses, count):
    """Return pulses of which some dozens in a row are lost, in so many places."""
    kept = np.ones(pulses.size, bool)
    for first in rng.integers(pulses.size - 60, size=count):
        kept[first:first + rng.integers(4, 40)] = False
    return pulses[kept]


@pytest.mark.machines
@pytest.mark.parametrize('seed', [0, 7])
@pytest.mark.parametrize('each', [False, True])
def test_dropouts_of_a_wheel_with_marks_at_any_angles_cost_no_amplitude(seed, each):
    """Behind each the index tells which mark comes, not the time that passed."""
    rng = np.random.default_rng(seed)
    marks = int(rng.integers(6, 16))
    edges = np.append(0.0, np.cumsum(rng.uniform(0.3, 1.7, marks)))
    edges = edges[:-1] / edges[-1]
    pulses = ((np.arange(200)[:, None] + edges) / 20.0).ravel()
    pulses = dropouts(rng, pulses + rng.normal(0.0, 2e-5, pulses.size), 6)
    time = np.arange(50_000) / 5000.0
    turned = 40.0 * np.pi * time
    averages = sa.average(
        sum(np.cos(order * turned) for order in (1, 5, 8, 24))[None], 5000.0, pulses,
        pulses_per_revolution=marks, pulses_per_trigger=1 if each else None,
        trigger_cycles=20 * marks if each else 20, orders=[1.0, 5.0, 8.0, 24.0],
        maximum_discarded=0.5, target_geometry='given', correct_jitter=True, keyphasor_rate=1.5e4,
        target_angles=(2.0 * np.pi * (edges - np.arange(marks) / marks)).tolist())
    assert len(averages) >= 5
    for item in averages:
        for found in (item, item.correction):
            np.testing.assert_allclose(np.abs(found.amplitudes), 1.0, atol=0.015)


@pytest.mark.parametrize('mode', ['given', 'learn'])
def test_a_mark_that_comes_off_is_told_and_stops_nothing(rng, mode):
    marks = 6
    late = 0.03 * rng.standard_normal(marks)
    pulses = (np.arange(400)[:, None] + np.arange(marks) / marks + late / (2.0 * np.pi)) / 20.0
    pulses += 1e-5 * rng.standard_normal(pulses.shape)
    times = np.concatenate([pulses[:200].ravel(), np.delete(pulses[200:], 3, axis=1).ravel()])
    validator = PulseValidator(
        pulses_per_revolution=marks, target_geometry=mode, missing_pulses='bridge',
        target_angles=late.tolist() if mode == 'given' else ())
    found = np.append(validator.update(times).times, validator.flush().times)
    assert np.max(np.abs(np.diff(found) * 20.0 - 1.0)) < 2e-3
    assert any('target_geometry: ' in line for line in validator.take_messages())


@pytest.mark.parametrize('first', range(13, 50, 3))
def test_a_gap_among_the_first_revolutions_costs_no_later_pulse(rng, first):
    """A probe of the first revolutions notes their intervals anew behind it."""
    edges = np.sort(np.append(np.arange(11) / 11, 1.27 / 11))
    times = ((np.arange(60)[:, None] + edges) / 20.0).ravel()
    times = np.delete(times + 1e-5 * rng.standard_normal(720), np.arange(first, first + 12))
    validator = PulseValidator(
        pulses_per_revolution=12, target_geometry='given',
        target_angles=(2.0 * np.pi * (edges - np.arange(12) / 12)).tolist())
    validator.update(times)
    validator.flush()
    counts = validator.finish()
    assert counts.accepted + counts.unlocked == times.size  # none behind the start
    assert counts.doubles == 0


def test_given_angles_are_found_in_far_fewer_revolutions_than_unknown_ones_are_learnt():
    late = np.array([0.02, 0.0, -0.02])  # rad, at 100 Hz
    waited = []
    for given in (late, None):
        counter = TriggerCounter(teeth=3, teeth_per_trigger=1)
        corrector = MarkCorrector(counter, count=3, given=given, say=print)
        numbers = np.arange(601)
        times = numbers / 300.0 + late[numbers % 3] / (200.0 * np.pi)
        corrector.begin(float(times[0]), 0)
        turn = 0
        while not corrector.take().times.size:
            turn += 1
            corrector.extend(times[3 * turn - 2:3 * turn + 1].tolist(), [1] * 3)
        waited.append(turn)
    assert waited[0] < 0.2 * waited[1]


@pytest.mark.parametrize('missing', [0, 1])
def test_given_angles_of_a_wheel_with_an_index_need_no_revolutions(missing):
    """Such as one at 0.5 Hz, of which the seconds that pulses wait show one and a half."""
    place = np.sort([*range(12), 0.5]) / 12.0 if not missing else np.arange(7) / 8.0 + 2e-3 * (
        np.arange(7) % 3)
    late = 2.0 * np.pi * (place - np.arange(place.size) / (place.size + missing))
    validator = PulseValidator(
        pulses_per_revolution=place.size + missing, missing_teeth=missing, pulses_per_trigger=1,
        target_geometry='given', target_angles=(late - late.mean()).tolist())
    found = validator.update((np.arange(20)[:, None] + place).ravel() / 0.5).times
    assert (validator.take_messages(), validator.counts.geometry_refused) == ([], 0)
    assert np.diff(found) == pytest.approx(2.0 / (place.size + missing), abs=1e-6)
