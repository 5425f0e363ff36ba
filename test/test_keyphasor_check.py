# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Targets, strays, clocks and jitter of which nothing is declared are found as they are."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import sa_jitter_ros as sa
from sa_jitter_ros.errors import RecordingError, SignalError
from sa_jitter_ros.keyphasor_check import check as check_module
from sa_jitter_ros.keyphasor_check.check import check_keyphasor
from sa_jitter_ros.keyphasor_check.clock import find_clock
from sa_jitter_ros.keyphasor_check.costs import _of_speed
from sa_jitter_ros.keyphasor_check.jitter import Jitter, measure_jitter
from sa_jitter_ros.keyphasor_check.lines import (
    _per_line, find_lines, marks_evidence, on_orders, ToothLines)
from sa_jitter_ros.keyphasor_check.machine_file import machine_parameters
from sa_jitter_ros.keyphasor_check.marks import fit_pulses, number_and_patterns
from sa_jitter_ros.keyphasor_check.teeth import number_pulses
from sa_jitter_ros.keyphasor_check.vibration import recovered_jitter
from sa_jitter_ros.keyphasor_check.wheel import _missing, patterns
from sa_jitter_ros.recordings import read
from sa_jitter_ros.recordings.recording import ArraySource, Recording
from scipy.signal import lfilter

RATE, SPEED, SECONDS = 6000.0, 25.0, 8.0
ORDERS = ((1.0, 0.3), (19.0, 1.0), (20.0, 0.2), (38.0, 0.5))


def motion(drift=0.01, seconds=SECONDS):
    """Return times (s) and angles (revolutions) of a shaft whose speed grows by `drift`."""
    time = np.linspace(0.0, seconds, 200_001)
    speed = SPEED * (1.0 + drift * time / seconds) * (1.0 + 1e-3 * np.sin(2.3 * time))
    return time, np.append(0.0, np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(time)))


def tach(rng, marks=1, *, missing=(), late=None, drift=0.01, jitter=5e-6, strays=0, lost=0.0,
         clock=0.0, memory=0.0, seconds=SECONDS):
    """Return pulse times (s) of a target, the true strays and the number of lost pulses."""
    time, angle = motion(drift, seconds)
    late = np.zeros(marks) if late is None else np.asarray(late)
    number = np.arange(int(angle[-1] * marks) - 1)
    place = (number / marks + late[number % marks] / (2.0 * np.pi))[
        ~np.isin(number % marks, missing)] + 0.1
    errors = rng.normal(0.0, jitter, place.size)
    for k in range(1, errors.size if memory else 0):
        errors[k] = memory * errors[k - 1] + np.sqrt(1.0 - memory**2) * errors[k]
    pulses = np.interp(place, angle, time) + errors
    gone = rng.random(pulses.size) < lost
    extra = np.sort(rng.uniform(pulses[0], pulses[-1], strays))
    times = np.sort(np.append(pulses[~gone], extra))
    return (np.ceil(times * clock) / clock if clock else times), extra, int(gone.sum())


def vibration(rng, *, ratio=1.0, drift=0.01, orders=ORDERS, noise=0.3):
    """Return samples (channel, sample) of a gear on a shaft at `ratio`."""
    turns = ratio * np.interp(np.arange(int(SECONDS * RATE)) / RATE, *motion(drift))
    return (sum(size * np.cos(2.0 * np.pi * order * turns + order) for order, size in orders)
            + rng.normal(0.0, noise, turns.size))[None]


def checked(samples, times, *, rate=RATE, teeth=(), **fields):
    """Check a recording."""
    return check_keyphasor(Recording(ArraySource(samples), rate, pulse_times=times, **fields),
                           teeth=teeth)


def codes(check):
    """Return the codes of the warnings."""
    return {item.code for item in check.warnings}


def values(check, *names):
    """Return values of findings."""
    return tuple(check.findings[name].value for name in names)


# --- targets ------------------------------------------------------------------------------------

@pytest.mark.machines
@pytest.mark.parametrize(('marks', 'missing', 'late', 'drift'), [
    (1, (), None, 0.01), (1, (), None, 2.0), (2, (), (0.01, -0.01), 0.01),
    (2, (), (0.3, -0.3), 0.01), (8, (), 3e-3, 2.0),
    (36, (16, 31, 32), None, 0.5),
    (60, (58, 59), 1e-3, 0.01), (4, (3,), None, 0.01), (4, (2, 3), None, 0.01),
    (3, (2,), None, 1.0)])
def test_target_strays_and_lost_pulses(rng, marks, missing, late, drift):
    """Every stray is found, unless it stands as near to a mark as the pulse does."""
    late = rng.normal(0.0, late, marks) if isinstance(late, float) else late
    seconds = SECONDS if marks < 36 else 0.5 * SECONDS
    count = marks * SPEED * seconds
    times, strays, lost = tach(rng, marks, missing=missing, late=late, drift=drift,
                               strays=max(10, int(0.01 * count)), lost=0.01, seconds=seconds)
    check = checked(np.full((1, 1), np.nan), times, rate=1.0)
    found, gaps, spurious, missed = values(
        check, 'pulses_per_revolution', 'missing_teeth', 'spurious', 'missing')
    if late is not None or missing:
        assert (found, gaps) == (marks, len(missing))
    hit = np.isin(strays, spurious['times'])
    assert hit.mean() > 0.94
    assert spurious['count'] <= 1.15 * strays.size + 4
    assert missed['count'] == pytest.approx(lost, abs=max(6, 0.15 * lost))


def test_marks_have_their_places_and_errors(rng):
    """The standard errors are those of the scatter over 20 drawn targets."""
    misses = []
    for _ in range(20):
        late = rng.normal(0.0, 2e-3, 6)
        late -= late.mean()
        times, _, _ = tach(rng, 6, late=late)
        pulses = number_pulses(times)
        pattern = fit_pulses(pulses, 6).pattern
        scale = 2.0 * np.pi / 6
        shifts = [pattern.marks * scale - np.roll(late, -k) for k in range(6)]
        miss = min(shifts, key=lambda each: np.sum(each**2))
        misses.append(miss / (pattern.errors * scale))
    size = np.sqrt(np.mean(np.square(misses)))
    assert 0.7 < size < 1.4  # 120 values, of which those of a target sum to 0


def test_even_marks_of_which_many_are_lost_have_no_pattern(rng):
    """A stray that stands far from all marks speaks for no gap in which it stands."""
    for _ in range(4):
        turns = np.flatnonzero(rng.random(4000) > 0.2) / 4.0 + rng.normal(0.0, 1e-4, 1)
        turns += rng.normal(0.0, 1e-4, turns.size)
        strays = rng.uniform(0.0, turns[-1], int(rng.integers(20, 200)))
        assert not patterns(number_pulses(np.sort(np.append(turns, strays)) / SPEED))


@pytest.mark.machines
def test_even_marks_have_no_pattern(rng):
    """Of 40 even targets at most one looks uneven."""
    found = [len(patterns(number_pulses(tach(rng, int(marks))[0])))
             for marks in rng.integers(1, 5, 40)]
    assert np.count_nonzero(found) <= 1


def test_the_clock_of_pulses_makes_no_unsteady_speed(rng):
    check = checked(vibration(rng, orders=((1.0, 0.3), (60.0, 1.0), (90.0, 0.5))),
                    tach(rng, clock=3e3)[0])
    assert {'quantised', 'jitter'} <= codes(check)
    assert 'unsteady_speed' not in codes(check)


@pytest.mark.parametrize(('hunting', 'clock'), [(0.0, 2e4), (0.05, 1e4), (0.5, 2e4)])
def test_a_slow_hunting_of_the_speed_and_the_beat_of_a_clock_are_no_wheel(hunting, clock):
    """The speed repeats after 1170 teeth, and the ticks of 20 kHz after 117."""
    time = np.linspace(0.0, 20.0, 200_001)
    turned = 13.0 * time - hunting / (0.8 * np.pi) * (np.cos(0.8 * np.pi * time) - 1.0)
    numbers = np.arange(1, int(36 * turned[-1]))
    times = np.ceil(np.interp(numbers / 36, turned, time) * clock) / clock
    assert not patterns(number_pulses(times))
    found = checked(np.full((1, 1), np.nan), times[numbers % 36 != 0], rate=1.0)
    assert values(found, 'pulses_per_revolution', 'missing_teeth') == (36, 1)
    assert all(values(found, name)[0]['count'] == 0 for name in ('missing', 'spurious'))


@pytest.mark.machines
def test_a_swing_of_the_speed_is_no_wheel_of_several_marks_but_an_eccentric_wheel_is(rng):
    """Both move pulses by a sine; that of a wheel keeps step with the pulses."""
    wheels = swings = 0
    for _ in range(40):
        time = np.linspace(0.0, 100.0, 200_001)
        speed, swing = rng.uniform(1.0, 6.0), rng.uniform(0.2, 0.45)
        turned = speed * time + 0.01 * np.sin(2.0 * np.pi * swing * time)
        times = np.interp(np.arange(1.0, turned[-1]), turned, time)
        swings += not patterns(number_pulses(times + 1e-5 * rng.standard_normal(times.size)))

        marks = int(rng.integers(5, 17))
        numbers = np.arange(1.0, speed * 100.0)
        times = (numbers + 0.01 * np.sin(2.0 * np.pi * numbers / marks)) / speed
        found = patterns(number_pulses(times + 1e-5 * rng.standard_normal(times.size)))
        wheels += bool(found) and found[0].teeth == marks
    assert wheels == 40
    assert swings >= 20  # the others nearly keep step over these 100 s


@pytest.mark.machines
@pytest.mark.parametrize(('marks', 'orders'), [
    (1, ORDERS), (2, ORDERS), (2, ((19.0, 1.0), (37.0, 0.5), (57.0, 0.4))), (8, ORDERS),
    *((marks, ((1.0, 1.0), (19.0, 0.6), (38.0, 0.3))) for marks in (20, 60))])
def test_lines_of_the_vibration_tell_even_marks(rng, marks, orders):
    check = checked(vibration(rng, orders=orders), tach(rng, marks)[0])
    count = check.findings['pulses_per_revolution']
    assert count.value == marks
    assert all(probability < 0.3 for _, probability in count.alternatives)
    assert values(check, 'ratio', 'orders') == (1.0, [order for order, _ in orders])


@pytest.mark.machines
@pytest.mark.parametrize(('teeth', 'gap'), [(60, 2), (36, 1)])
def test_half_orders_of_an_engine_do_not_double_its_wheel(rng, teeth, gap):
    orders = [(1.0, 0.3), (2.0, 1.0), (4.0, 0.6), (0.5, 0.15), (1.5, 0.15), (2.5, 0.1)]
    check = checked(vibration(rng, orders=orders),
                    tach(rng, teeth, missing=range(teeth - gap, teeth))[0])
    assert values(check, 'pulses_per_revolution', 'missing_teeth') == (teeth, gap)


@pytest.mark.machines
def test_a_mesh_of_another_shaft_does_not_exclude_one_mark(rng):
    """Gears of 19 teeth at ratio 183/76 make lines at multiples of a quarter of the speed."""
    check = checked(vibration(rng, orders=[(k * 19 * 183 / 76, 1.0 / k) for k in (1, 2, 3)]),
                    tach(rng, 1)[0])
    count = check.findings['pulses_per_revolution']
    assert count.value == 1 or dict(count.alternatives)[1] > 0.05


def test_even_marks_without_vibration_are_listed_with_what_would_decide(rng):
    check = checked(rng.normal(0.0, 1.0, (1, int(SECONDS * RATE))), tach(rng, 2)[0])
    count = check.findings['pulses_per_revolution']
    probability = dict(count.alternatives)
    assert 2 in {count.value, *probability}
    assert sum(probability.values()) > 0.3
    assert 'strobe' in count.decided_by
    assert {'marks_ambiguous', 'no_orders'} <= codes(check)


@pytest.mark.machines
def test_stated_marks_count_unless_pulses_contradict(rng):
    times = tach(rng, 8)[0]
    check = checked(vibration(rng, orders=((16.0, 1.0),)), times, pulses_per_revolution=8)
    assert values(check, 'pulses_per_revolution') == (8,)
    times = tach(rng, 12, missing=(11,))[0]
    check = checked(np.full((1, 1), np.nan), times, rate=1.0, pulses_per_revolution=50)
    assert values(check, 'pulses_per_revolution', 'missing_teeth') == (12, 1)
    assert 'marks_contradict' in codes(check)


def test_stated_orders_tell_the_marks_and_without_one_there_is_no_ratio(rng):
    """Lines of a shaft at 1.7992 are multiples of a fifth of the tach shaft's speed by chance."""
    times = tach(rng)[0]
    samples = vibration(rng, ratio=1.7992, orders=((1.0, 0.5), (25.0, 1.0), (50.0, 0.6)))
    check = checked(samples, times, ratio=1.7992, orders=(25.0, 50.0))
    assert values(check, 'pulses_per_revolution', 'orders') == (1, [1.0, 25.0, 50.0])
    samples = vibration(rng, ratio=2.2042, orders=((1.0, 0.5), (22.0, 1.0), (44.0, 0.6)))
    check = checked(samples, times)
    assert values(check, 'ratio', 'orders') == (None, None)
    assert 'give the numbers of teeth' in check.findings['ratio'].decided_by


def test_a_run_up_with_one_mark_has_the_orders_of_the_gear_and_no_others(rng):
    orders = ((1.0, 0.5), (13.0, 1.0), (26.0, 0.5))
    samples = vibration(rng, drift=1.0, orders=orders, noise=0.05)
    check = checked(samples, tach(rng, drift=1.0)[0])
    assert values(check, 'pulses_per_revolution', 'ratio', 'orders') == (1, 1.0, [1.0, 13.0, 26.0])


@pytest.mark.parametrize('teeth', [(), (19, 183, 76)])
def test_ratio_of_a_shaft_without_keyphasor(rng, teeth):
    check = checked(vibration(rng, ratio=183 / 76), tach(rng)[0], teeth=teeth)
    ratio = check.findings['ratio']
    assert ratio.value == pytest.approx(183 / 76, abs=3.0 * ratio.standard_error)
    assert values(check, 'pulses_per_revolution', 'orders') == (1, [1.0, 19.0, 20.0, 38.0])


def test_target_that_changes_is_named(rng):
    early, late = tach(rng)[0], tach(rng, 8, missing=(7,))[0]
    middle = 0.5 * SECONDS
    check = checked(np.full((1, 1), np.nan), np.append(early[early < middle],
                                                       late[late > middle]), rate=1.0)
    assert 'pattern_changes' in codes(check)


def test_target_whose_gap_is_elsewhere_later_is_named(rng):
    early, late = (tach(rng, 12, missing=missing)[0] for missing in ((3, 8), (4, 8)))
    middle = 0.5 * SECONDS
    check = checked(np.full((1, 1), np.nan), np.append(early[early < middle],
                                                       late[late > middle]), rate=1.0)
    text = next(item.text for item in check.warnings if item.code == 'pattern_changes')
    assert '12 teeth, 2 of them missing before' in text
    assert '12 teeth, 2 of them missing elsewhere behind' in text


def test_standstill_costs_nothing_else(rng):
    times = tach(rng, 12, missing=(11,))[0]
    check = checked(np.full((1, 1), np.nan), times[(times < 3.0) | (times > 6.0)], rate=1.0)
    assert values(check, 'pulses_per_revolution', 'missing_teeth') == (12, 1)
    assert values(check, 'spurious')[0]['count'] == values(check, 'missing')[0]['count'] == 0
    assert check.findings['speed'].value['mean'] == pytest.approx(SPEED, rel=0.01)


@pytest.mark.parametrize('behind', [5, 400])
def test_uneven_marks_are_found_again_behind_a_standstill(rng, behind):
    """The marks in front of it show which one comes first behind it, however few follow."""
    late = rng.permutation(np.linspace(-0.05, 0.05, 12))  # rad
    numbers = np.append(np.arange(480), 485 + np.arange(behind))
    times = (numbers / 12 + late[numbers % 12] / (2.0 * np.pi)) / SPEED + 5.0 * (numbers >= 480)
    fitted = fit_pulses(number_pulses(times), 12)
    assert (fitted.strays.size, fitted.lost.size, fitted.breaks.tolist()) == (0, 0, [480])
    assert np.all(np.diff(fitted.pattern.tooth(fitted.numbers) - numbers) % 12 == 0)
    pitch = np.diff(fitted.true)[np.diff(numbers) == 1] * SPEED * 12
    assert np.abs(pitch - 1.0).max() < 5e-3


def test_a_pulse_that_is_there_twice_is_a_stray_once(rng):
    times = tach(rng, 12, missing=(11,))[0]
    twice = np.sort(rng.choice(times, 30, replace=False))
    both = np.sort(np.append(times, twice))
    numbered, found = number_and_patterns(both)
    assert (found[0].teeth, found[0].present) == (12, 11)
    assert np.array_equal(numbered.times, times)
    assert np.array_equal(numbered.strays, twice)


# --- clock and jitter ---------------------------------------------------------------------------

@pytest.mark.parametrize('drift', [1e-4, 1e-3])
def test_a_pulse_that_is_a_tick_late_is_no_stray(drift):
    """A steady speed is a whole number of ticks for most pulses, which seem to have no errors."""
    number, tick = np.arange(4000), 1.0 / (SPEED * 12 * 20)
    times = np.ceil(number / (SPEED * 12) * (1.0 + drift * number / 4000) / tick) * tick
    fitted = fit_pulses(number_pulses(times), 1, tick=tick)
    assert fitted.strays.size == fitted.lost.size == 0


@pytest.mark.parametrize('clock', [5000.0, 51_200.0, 3.125e6])
@pytest.mark.parametrize('drift', [0.0, 0.5])
@pytest.mark.parametrize(('marks', 'strays'), [(1, 0), (12, 30)])
def test_clock_at_a_steady_and_a_changing_speed(rng, clock, drift, marks, strays):
    times = tach(rng, marks, drift=drift, clock=clock, strays=strays)[0]
    assert find_clock(times).rate == pytest.approx(clock, rel=1e-9)
    since_1970 = find_clock(times + 1.7e9)
    assert since_1970.rate in (0.0, pytest.approx(clock, rel=1e-4))


def test_no_clock_in_pulses_of_full_precision(rng):
    assert not any(find_clock(tach(rng, marks, drift=drift)[0]).rate
                   for marks in (1, 8) for drift in (0.0, 0.5) for _ in range(5))


@pytest.mark.machines
@pytest.mark.parametrize('memory', [0.0, 0.6, -0.4])
def test_jitter_of_pulses_has_its_size_memory_and_errors(rng, memory):
    """At the speed of `motion`, over 30 drawn tachs: the errors are those of the scatter."""
    std = 2e-5
    found = []
    for _ in range(30):
        times = tach(rng, jitter=std, memory=memory)[0]
        pulses = number_pulses(times)
        jitter = measure_jitter(pulses.times, pulses.numbers)
        if np.isfinite(jitter.correlation):
            found.append(((jitter.std - std) / jitter.std_error,
                          (jitter.correlation - memory) / jitter.correlation_error))
    size, correlation = np.array(found).T
    assert len(found) >= 24
    assert abs(np.median(size)) < 1.2
    assert abs(np.median(correlation)) < 1.2
    assert np.mean(np.abs(size) < 3.0) > 0.8
    assert np.mean(np.abs(correlation) < 3.0) > 0.8


@pytest.mark.parametrize(('marks', 'start'), [(1, 0.0), (4, 0.0), (1, 1.7e9)])
def test_the_rounding_of_exact_pulse_times_is_no_jitter(rng, marks, start):
    pulses, *_ = tach(rng, marks, jitter=0.0)
    check = checked(np.full((1, 1), np.nan), start + pulses, start_time=start)
    assert values(check, 'jitter_std', 'jitter_correlation') == (None, None)
    assert 'jitter_memory' not in codes(check)


def test_slow_jitter_is_that_of_the_vibration(rng):
    times = tach(rng, jitter=6e-5, memory=0.9)[0]
    check = checked(vibration(rng, noise=0.1), times)
    std = check.findings['jitter_std']
    assert std.decided_by.startswith('pulse errors recovered from the vibration')
    # Each average shows the errors without their mean.
    assert 2.5e-5 < std.value < 7e-5
    assert {'jitter', 'jitter_memory'} <= codes(check)


def test_cost_of_a_coarse_clock_is_what_an_average_loses(rng):
    clock = 3000.0
    samples, times = vibration(rng), tach(rng, jitter=0.0, clock=clock)[0]
    check = checked(samples, times)
    cost = dict(next(item for item in check.warnings if item.code == 'quantised').cost)
    average, = sa.average(samples, RATE, times, orders=[19.0, 38.0])
    left = np.abs(average.amplitudes[0]) / (1.0, 0.5)
    scatter = average.cycle_amplitudes[:, 0].std(axis=0) / np.sqrt(average.trigger_cycles)
    np.testing.assert_array_less(
        np.abs(100.0 * (1.0 - left) - (cost[19.0], cost[38.0])), 300.0 * scatter)
    assert 8.0 < cost[38.0] < 12.0


# --- what does not fit --------------------------------------------------------------------------

@pytest.mark.machines
@pytest.mark.parametrize(('code', 'change', 'rate'), [
    ('unit_ms', lambda times: 1e3 * times, RATE),
    ('unit_samples', lambda times: np.rint(RATE * times), RATE),
    ('unit_epoch', lambda times: times + 1.7e9, RATE),
    ('unit_khz', lambda times: times, RATE / 1e3),
])
def test_unit_is_named_and_the_rest_found(rng, code, change, rate):
    check = checked(vibration(rng), change(tach(rng, 8, missing=(7,))[0]), rate=rate)
    assert code in codes(check)
    assert values(check, 'pulses_per_revolution', 'missing_teeth') == (8, 1)
    assert check.findings['speed'].value['mean'] == pytest.approx(SPEED, rel=0.01)
    assert check.sample_rate == RATE
    assert values(check, 'orders') == ([1.0, 19.0, 20.0, 38.0],)


def test_tach_waveform_in_khz(rng):
    angle = np.interp(np.arange(int(SECONDS * RATE)) / RATE, *motion())
    recording = Recording(ArraySource(vibration(rng)), RATE, tach_rate=RATE / 1e3,
                          tach=ArraySource(np.sin(2.0 * np.pi * angle)[None]))
    check = check_keyphasor(recording)
    assert 'unit_khz' in codes(check)
    assert values(check, 'pulses_per_revolution', 'clock_rate') == (1, RATE)
    assert check.findings['speed'].value['mean'] == pytest.approx(SPEED, rel=0.01)


def test_bad_channels_cost_themselves_only(rng):
    good = vibration(rng)[0]
    samples = np.array([np.full(good.size, np.nan), good, np.zeros(good.size),
                        np.clip(good, -0.5, 0.5)])
    check = checked(samples, tach(rng)[0], channel_names=('a', 'b', 'c', 'd'))
    texts = [item.text for item in check.warnings if item.code == 'bad_channel']
    assert [text[:20] for text in texts] == [
        'channel a is NaN or ', 'channel c is constan', 'channel d is saturat']
    assert values(check, 'orders') == ([1.0, 19.0, 20.0, 38.0],)


def test_tach_shorter_than_the_vibration(rng):
    times = tach(rng)[0]
    assert 'span' in codes(checked(vibration(rng), times[times < 5.0]))
    assert 'span' not in codes(checked(vibration(rng), times))


@pytest.mark.parametrize(('times', 'error', 'message'), [
    ([], SignalError, '0 pulses in 8 s: at least 6 are needed'),
    ([1.0], SignalError, '1 pulses in 8 s'),
    ([1.0] * 20, SignalError, 'all 20 pulses are at 1 s'),
    (np.arange(20.0, 0.0, -1.0), RecordingError, 'time runs backwards at pulse 1'),
])
def test_pulses_that_show_nothing(times, error, message):
    with pytest.raises(error, match=message):
        checked(np.zeros((1, int(SECONDS * RATE))), np.array(times))


@pytest.mark.parametrize(('times', 'strays'), [
    (np.delete(np.arange(12) / 25.0, 6), 0), (np.round(np.arange(1000) / 600.0 * 2.0) / 2.0, 748)])
def test_few_different_pulses_are_one_mark(times, strays):
    check = checked(np.full((1, 1), np.nan), times, rate=1.0)
    assert check.findings['pulses_per_revolution'].value == 1
    assert check.findings['spurious'].value['count'] == strays


@pytest.mark.parametrize('count', [50, 90, 400])
def test_strays_alone_are_no_wheel(rng, count):
    """The message counts what does not fit, and says what to look at."""
    with pytest.raises(SignalError, match=r'belong to no steady wheel.*look at the waveform'):
        checked(vibration(rng), np.sort(rng.uniform(0.0, SECONDS, count)))


@pytest.mark.machines
@pytest.mark.parametrize(('marks', 'missing'), [(1, ()), (8, ()), (36, (35,))])
def test_a_wheel_with_a_fifth_lost_and_as_many_strays_is_one(rng, marks, missing):
    pulses = tach(rng, marks, missing=missing, lost=0.2)[0][:2000 if marks < 36 else 1200]
    strays = rng.uniform(pulses[0], pulses[-1], pulses.size // 5)
    samples = vibration(rng)[:, :int(RATE * pulses[-1])]
    assert checked(samples, np.sort(np.append(pulses, strays))).findings


@pytest.mark.machines
@pytest.mark.parametrize(('factor', 'wrong'), [(0.5, 2), (2.0, 1)])
def test_another_sampling_rate_that_fits_the_spans_is_listed(rng, factor, wrong):
    check = checked(vibration(rng), tach(rng)[0], rate=factor * RATE)
    text, = (item.text for item in check.warnings if item.code == 'rate_ambiguous')
    marks = f'{wrong} mark{"s" * (wrong > 1)}'
    assert f'{marks} a revolution at sample_rate {factor * RATE:g} Hz' in text
    assert f'1 mark a revolution at sample_rate {RATE:g} Hz' in text
    marks = check.findings['pulses_per_revolution']
    assert marks.value == wrong
    assert f'{RATE:g} Hz' in marks.decided_by
    assert 'strobe' in marks.decided_by
    if factor < 1.0:
        assert 'rate_ambiguous' not in codes(checked(vibration(rng), tach(rng)[0]))


# --- delay --------------------------------------------------------------------------------------

@pytest.mark.machines
@pytest.mark.parametrize('delay', [0.0, 2e-4])
def test_delay_of_the_tach_turns_all_orders_alike(rng, delay):
    times = tach(rng, drift=1.0)[0] + delay
    found = checked(vibration(rng, drift=1.0), times).findings['path_delay']
    assert found.value == pytest.approx(delay, abs=max(4.0 * found.standard_error, 3e-6))
    assert found.standard_error < 2e-5


@pytest.mark.machines
def test_delay_has_the_error_that_is_stated(rng):
    """Over 6 drawn machines whose speed hardly changes: all pulses of one turn all orders."""
    found = [checked(vibration(rng, drift=0.05), tach(rng, drift=0.05, jitter=2e-5)[0]).findings[
        'path_delay'] for _ in range(6)]
    known = [item.value / item.standard_error for item in found if item.value is not None]
    assert len(known) >= 5
    assert np.sqrt(np.mean(np.square(known))) < 1.8


@pytest.mark.machines
def test_delay_that_was_found_keeps_the_phases_of_a_run_up(rng):
    """Without it order 38 turns by more than a radian, with it by less than a tenth."""
    times = tach(rng, drift=1.0)[0] + 2e-4
    samples = vibration(rng, drift=1.0)
    check = checked(samples, times)
    delay = machine_parameters(check)['synchronous_averager']['path_delay']
    turned = [np.ptp(np.unwrap([np.angle(item.amplitudes[0, 0]) for item in sa.average(
        samples, RATE, times, orders=[38.0], trigger_cycles=20, angle_law='spline',
        path_delay=used)])) for used in (0.0, delay)]
    assert turned[0] > 1.0
    assert turned[1] < 0.1


@pytest.mark.machines
def test_delay_is_not_given_where_orders_disagree(rng):
    time, angle = motion(1.0)
    turns = np.interp(np.arange(int(SECONDS * RATE)) / RATE, time, angle)
    speed = np.gradient(turns) * RATE
    samples = sum(np.cos(2.0 * np.pi * order * turns + turn * speed / SPEED)
                  for order, turn in ((3.0, 0.5), (19.0, -0.8))) + rng.normal(0, 0.2, turns.size)
    found = checked(samples[None], tach(rng, drift=1.0)[0]).findings['path_delay']
    assert found.value is None
    assert 'orders turn differently' in found.decided_by
    found = checked(vibration(rng), tach(rng)[0]).findings['path_delay']
    assert found.value is None
    assert 'speed hardly changes' in found.decided_by


# --- measured -----------------------------------------------------------------------------------

@pytest.mark.machines
@pytest.mark.parametrize(('name', 'missing'), [('4b11_running', 3), ('toyota_3_tooth_cam', 2)])
def test_measured_engines(shared_data, name, missing):
    """Wheels 36-2-1 and 36-2; sensors shift the teeth in front of a gap."""
    check = check_keyphasor(read(shared_data / f'engine_edges_{name}.npz', pulse_times='edges_1',
                                 pulses_suffice=True))
    assert values(check, 'pulses_per_revolution', 'missing_teeth') == (36, missing)
    assert values(check, 'spurious', 'missing') == (
        {'count': 0, 'times': []}, {'count': 0, 'times': []})
    assert 'uneven_marks' in codes(check)


@pytest.mark.machines
@pytest.mark.parametrize(('ripple', 'late'), [(3.4, 0.0), (0.0, 0.5)])
def test_the_vibration_tells_uneven_marks_from_a_speed_that_ripples(ripple, late):
    """The pulses of both are alike; degrees. A crank gets trigger cycles from mark to mark."""
    rng, rate, teeth, missing = np.random.default_rng(3), 5e3, 60, 2
    time = np.arange(round(12 * rate)) / rate
    even = 5.0 * time + 0.01 * np.sin(2.0 * np.pi * 0.3 * time)
    angle = even + ripple / 360.0 * np.sin(4.0 * np.pi * even)
    number = np.arange(1, int(angle[-1] * teeth))
    number = number[number % teeth < teeth - missing]
    pattern = late / 360.0 * np.sin(4.0 * np.pi * np.arange(teeth) / teeth)
    pulses = np.interp(number / teeth + pattern[number % teeth], angle, time)
    wave = sum(size * np.cos(2.0 * np.pi * g * angle)
               for g, size in ((1, 1.0), (20, 0.5), (40, 0.25)))
    found = check_keyphasor(Recording(
        ArraySource((wave + 0.02 * rng.standard_normal(time.size))[None]), rate,
        pulse_times=pulses))
    marks = np.array(found.findings['marks'].value)
    averager = machine_parameters(found)['synchronous_averager']
    assert found.findings['orders'].value[0] == 1.0
    if ripple:
        assert not marks.any()
        assert 'target_angles' not in averager
        if ripple > 1.0:  # it costs more than 1 % of an order
            assert found.findings['orders'].value == [1.0, 20.0, 40.0]
            assert averager['pulses_per_trigger'] == 1
            assert 'pulses_per_trigger to 1' in ' '.join(item.text for item in found.warnings)
    else:
        assert np.ptp(marks) > 1.5 * np.radians(late)
        assert 'target_angles' in averager


def test_a_speed_that_scatters_from_mark_to_mark_is_no_fault_of_the_keyphasor(shared_data):
    """Of an encoder on a motor whose speed scatters by a third, all pulses are true."""
    found = check_keyphasor(read(shared_data / 'encoder_motor_slow.npz'))
    for name in ('missing', 'spurious'):
        assert found.findings[name].value['count'] == 0
        assert 'the speed scatters so much' in found.findings[name].decided_by
    assert found.findings['jitter_std'].value is None
    assert not {'missing', 'spurious', 'jitter'} & {item.code for item in found.warnings}


def test_a_vibration_may_repeat_several_times_in_a_revolution():
    size = np.linspace(20.0, 40.0, 4)
    lines = ToothLines(np.array([2.0, 3.0, 5.0, 7.0]), size, size / 40.0, 1e-3)
    one, two, four = marks_evidence(lines, [1, 2, 4]).values()
    assert 1.0 < one - two < 2.5  # not the four lines that would be at odd orders by chance
    assert 1.5 < one - four < 3.5


def test_a_line_that_falls_anywhere_says_nothing_for_a_shaft(rng):
    """The likelihood ratio of a random line has the mean 1, however dense the orders are."""
    for ratio in (0.06, 0.3, 2.0):
        places = np.sort(rng.uniform(50.0, 100.0, 200_000))
        lines = ToothLines(places, *np.ones((2, places.size)), 0.05)
        on = on_orders(lines, ratio)[1].mean()
        said = np.exp(_per_line(lines, ratio))
        assert on * said + (1.0 - on) * 0.3 == pytest.approx(1.0, abs=0.05)


def test_jitter_that_the_pulses_hide_is_told_in_us(rng, monkeypatch):
    monkeypatch.setattr(check_module, 'recovered_jitter', lambda _: Jitter(3e-5, 1e-6, 0.9, 0.02))
    numbers = np.arange(2000)
    fitted = SimpleNamespace(true=numbers / 25.0 + rng.normal(0.0, 1e-5, 2000), numbers=numbers)
    check = SimpleNamespace(_jitter_of=lambda item: measure_jitter(item.true, item.numbers))
    found = check_module._Check._jitter(check, fitted, (), '')['jitter_std']
    assert found.value == 3e-5
    alone = found.decided_by.split('the pulses alone show ')[1].split(' us')[0]
    assert float(alone) == pytest.approx(10.0, rel=0.1)


@pytest.mark.parametrize(('frequency', 'width'), [(700.0, 16.0), (300.0, 8.0)])
def test_noise_in_a_resonance_is_no_line(rng, frequency, width):
    pole = np.exp(2.0 * np.pi / RATE * (1j * frequency - 0.5 * width))
    noise = lfilter([1.0], [1.0, -2.0 * pole.real, abs(pole) ** 2], rng.normal(size=120_000))
    noise += 0.02 * noise.std() * rng.normal(size=noise.size)
    pulses = np.arange(1, 399) / 20.0
    assert find_lines(noise[:, None], 0.0, RATE, pulses, 20.0 * pulses).places.size == 0


def test_a_tooth_without_a_pulse_is_missing_unless_most_pulses_are_lost():
    span = np.full(4, 100)
    assert _missing(np.array([90, 90, 90, 0]), span).tolist() == [False, False, False, True]
    assert not _missing(np.array([50, 50, 50, 0]), span).any()


def test_the_tach_shaft_with_orders_of_its_own_is_the_one_of_interest(rng):
    """Nobody named another shaft, whose lines are stronger and more."""
    own = vibration(rng, orders=((1.0, 0.5), (2.0, 0.5), (3.0, 0.5), (4.0, 0.5), (5.0, 0.3)))
    other = vibration(rng, ratio=2.40789)
    assert checked(own + 3.0 * other, tach(rng)[0]).findings['ratio'].value == 1.0


@pytest.mark.parametrize(('scatter', 'shown'), [(0.3, False), (0.8, True)])
def test_pulse_errors_below_their_own_uncertainty_show_no_jitter(rng, scatter, shown):
    average, *_ = sa.average(vibration(rng), RATE, tach(rng)[0], orders=[19.0], trigger_cycles=40,
                             correct_jitter=True, keyphasor_rate=3000.0)
    known = np.full(41, 1e-5)

    def drawn():
        errors = rng.normal(0.0, np.hypot(1.0, scatter) * 1e-5, 41)
        errors -= errors.mean()
        return replace(average, correction=replace(
            average.correction, accepted=True, pulse_errors=errors, standard_errors=known))
    found = recovered_jitter([drawn() for _ in range(200)])
    assert (found is not None) == shown
    if shown:
        assert found.std == pytest.approx(scatter * 1e-5, rel=0.1)


def test_cost_of_a_run_up_is_what_the_straight_angle_law_loses():
    """At a speed that grows by 2 % in each revolution, within which it is ahead by its half."""
    fitted = SimpleNamespace(speed=25.0 * 1.02 ** np.arange(50.0), mean_speed=40.0,
                             pattern=SimpleNamespace(present=1))
    found, = _of_speed(fitted, 1.0, [20.0, 40.0], None)
    u = (np.arange(1000) + 0.5) / 1000
    lost = [100.0 - 100.0 * abs(np.mean(np.exp(2j * np.pi * g * 0.01 * u * (1.0 - u))))
            for g in (20.0, 40.0)]
    np.testing.assert_allclose([cost for _, cost in found.cost], lost, rtol=0.25)
    fitted.speed = np.full(50, 25.0)
    assert not _of_speed(fitted, 1.0, [20.0, 40.0], None, 1e-5)


def test_what_marks_do_not_show_of_the_speed_is_given_in_per_cent():
    found, = _of_speed(None, 1.0, [1.0, 2.0], (np.array([0.1, 0.2]), np.array([0.01, 0.013])))
    assert 'no order here then loses more than 1.3 %' in found.text
    assert dict(found.cost) == {1.0: 10.0, 2.0: 20.0}


@pytest.mark.parametrize(('from_rest', 'marks'), [(True, 1), (False, 1), (None, 3)])
def test_pulses_before_and_behind_those_whose_speed_is_known_are_not_spurious(
        rng, from_rest, marks):
    t = np.arange(round(12.0 * RATE)) / RATE
    turns = 25.0 * t if from_rest is None else 1.1 * np.clip(t - 1.8, 0.0, None) ** 2
    turns = turns[-1] - turns[::-1] if from_rest is False else turns
    places = np.arange(1.0, turns[-1] - 1.0)[:, None] + np.array([0.0, 0.1, 0.22])[:marks]
    samples = np.cos(2.0 * np.pi * np.outer([1.0, 19.0], turns)).sum(axis=0)
    samples += rng.normal(0.0, 0.2, t.size)
    found = checked(samples[None], np.interp(places.ravel(), turns, t)).findings
    assert found['pulses_per_revolution'].value == marks
    assert found['spurious'].value['count'] == found['missing'].value['count'] == 0


def test_marks_that_are_close_together_are_no_wheel_that_stands_still_every_turn(rng):
    """As torn reflective tape gives them, or an edge that bounces."""
    time, angle = motion()
    places = np.arange(1.0, angle[-1] - 1.0)[:, None] + np.array([0.0, 0.016, 0.03])
    found = checked(vibration(rng), np.interp(places.ravel(), angle, time)).findings
    assert found['pulses_per_revolution'].value == 3
    assert found['speed'].value['mean'] == pytest.approx(angle[-1] / time[-1], rel=0.02)
