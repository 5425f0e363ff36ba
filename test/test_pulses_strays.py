# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Pulses that no tooth made, or at another time: no trigger cycle is wrong, on any wheel."""

import numpy as np
import pytest
from sa_jitter_ros.pulses.interval_model import IntervalModel
from sa_jitter_ros.pulses.mark_pattern import regular_start, repeating, steady_pattern
from sa_jitter_ros.pulses.trigger_counter import TriggerPulses
from sa_jitter_ros.pulses.validation import PulseCounts, PulseValidator
from sa_jitter_ros.recordings import read
from scipy.ndimage import gaussian_filter1d
from worse_pulses import with_slower_clock

SECONDS = 2.5
WHEELS = {
    '1': ({}, np.zeros(1)),
    '4': ({'pulses_per_revolution': 4}, np.arange(4) / 4.0),
    '4 uneven': ({'pulses_per_revolution': 4}, np.arange(4) / 4.0 + [0.0, 0.01, -0.012, 0.006]),
    '60': ({'pulses_per_revolution': 60}, np.arange(60) / 60.0),
    '36-1': ({'pulses_per_revolution': 36, 'missing_teeth': 1}, np.arange(35) / 36.0),
    '60-2': ({'pulses_per_revolution': 60, 'missing_teeth': 2}, np.arange(58) / 60.0)}
FAULTS = ('stray', 'double', 'displaced', 'missing', 'beside gaps')


class Shaft:
    """A shaft at 33.3 Hz (one mark) or 12 Hz, steady or with a speed that changes at random."""

    def __init__(self, rng, wheel, unsteady):
        self.options, marks = WHEELS[wheel]
        self._time = np.linspace(0.0, SECONDS, 50_001)
        speed = np.full(self._time.size, 33.3 if marks.size == 1 else 12.0)
        if unsteady:
            noise = gaussian_filter1d(rng.standard_normal(speed.size), 1000)
            speed *= 1.0 + 0.02 * noise / noise.std()
        self._angle = np.append(0.0, np.cumsum(0.5 * (speed[1:] + speed[:-1])
                                               * np.diff(self._time)))
        turns = np.arange(int(self._angle[-1]) - 1)[:, None] + marks
        self.pulses = np.interp(turns.ravel(), self._angle, self._time)
        self.pulses += rng.normal(0.0, 2e-6, self.pulses.size)

    def angle(self, times):
        """Return the true angle in revolutions."""
        return np.interp(times, self._time, self._angle)


def spoilt(rng, pulses, fault):
    """Return the pulses with one fault in 24 of them, uniform over record and interval."""
    count = max(pulses.size // 24, 3)
    some = rng.choice(np.arange(1, pulses.size - 2), count, replace=False)
    interval = np.gradient(pulses)[some]
    given = pulses.copy()
    if fault == 'displaced':
        given[some] += rng.uniform(-0.5, 0.5, count) * interval
    extra = {'stray': rng.uniform(pulses[0], pulses[-1], count),
             'double': pulses[some] + rng.uniform(0.001, 0.5, count) * interval,
             'beside gaps': pulses[some] + rng.uniform(-1.0, 1.0, count) * interval
             }.get(fault, [])
    keep = np.ones(pulses.size, np.bool_)
    if fault in ('missing', 'beside gaps'):
        keep[some] = False
    return np.sort(np.append(given[keep], extra))


@pytest.mark.machines
@pytest.mark.parametrize('unsteady', [False, True])
@pytest.mark.parametrize('wheel', WHEELS)
def test_no_trigger_cycle_is_wrong(wheel, unsteady):
    for seed, fault in enumerate(FAULTS):
        if fault == 'displaced' and unsteady and wheel == '1':
            continue  # a speed that changes as much explains small displacements
        rng = np.random.default_rng([seed, len(wheel)])
        shaft = Shaft(rng, wheel, unsteady)
        validator = PulseValidator(**shaft.options)
        found = TriggerPulses.joined([
            validator.update(spoilt(rng, shaft.pulses, fault)), validator.flush()])
        turned = np.diff(shaft.angle(found.times))
        whole = ~found.starts_run[1:]
        assert np.abs(turned[whole] - 1.0).max(initial=0.0) < 4e-3, fault
        known = np.diff(found.count) > 0  # over gaps, too
        assert np.abs(turned - np.diff(found.count))[known].max(initial=0.0) < 0.05, fault
        if fault in ('stray', 'double'):
            assert np.count_nonzero(whole) > 0.9 * turned.size > 0, fault


@pytest.mark.parametrize('size', [0.01, 0.03, 0.1, 0.3])
def test_a_displaced_pulse_of_a_steady_shaft_is_in_no_cycle(rng, size):
    pulses = 0.03 * np.arange(300.0) + rng.normal(0.0, 3e-6, 300)
    given = pulses.copy()
    given[40::29] += size * 0.03 * rng.choice([-1.0, 1.0], given[40::29].size)
    validator = PulseValidator()
    found = np.concatenate([validator.update(given).times, validator.flush().times])
    assert np.isin(found, pulses).all()
    assert found.size > 270


@pytest.mark.parametrize('clock', [0.0, 4000.0])
@pytest.mark.parametrize('marks', [1, 4])
def test_a_displaced_pulse_among_equal_intervals_is_no_tick_of_a_clock(marks, clock):
    """Whole fractions of an interval, too, which a clock with such a tick would show."""
    for period in (0.03, 0.04, 1.0 / 33.3):
        for size in (0.02, 0.03, 0.05, 0.1):
            pulses = 1.0 + period / marks * np.arange(200.0 * marks)
            displaced = pulses[90 * marks] + size * period / marks * np.array([0.0, 1.0])
            given = np.where(pulses == displaced[0], displaced[1], pulses)
            if clock:
                given = np.ceil(given * clock - 1e-9) / clock
                displaced = np.ceil(displaced * clock - 1e-9) / clock
            if clock and np.ptp(displaced) < 2.5 / clock:
                continue  # intervals that are rounded differ by two ticks
            validator = PulseValidator(pulses_per_revolution=marks, pulses_per_trigger=1)
            found = np.append(validator.update(given).times, validator.flush().times)
            assert displaced[1] not in found, (period, size)
            assert found.size > 195 * marks


@pytest.mark.parametrize('part', [0.49, 0.499, 0.5002])
def test_two_keyphasors_of_one_name_are_named(rng, part):
    pulses = 0.03 * np.arange(300.0) + rng.normal(0.0, 1e-6, 300)
    validator = PulseValidator()
    every = np.sort(np.append(pulses, pulses[:-1] + part * np.diff(pulses)))
    for first in range(0, every.size, 7):
        validator.update(every[first:first + 7])
    message, = validator.take_messages()
    longer, shorter = sorted((0.03 * part, 0.03 * (1.0 - part)), reverse=True)
    assert message.startswith('the pulse intervals are longer and shorter in turns')
    found = [float(word) for word in message.split() if word.startswith('0.')]
    assert found == pytest.approx([longer, shorter], rel=3e-4)


@pytest.mark.parametrize('clock', [0.0, 5120.0])
def test_intervals_of_one_mark_are_in_no_turns(rng, clock):
    for drift in (0.0, 0.02):
        pulses = drifting(rng, 1500, 1, drift) + rng.normal(0.0, 2e-5, 1500)
        if clock:
            pulses = np.ceil(pulses * clock) / clock
        validator = PulseValidator()
        validator.update(pulses)
        assert not validator.take_messages()


@pytest.mark.machines
@pytest.mark.parametrize('marks', [1, 2, 4])
def test_a_displaced_pulse_in_the_first_revolutions_is_in_no_cycle(rng, marks):
    for trial in range(36):
        pulses = 1.0 + 0.02 * np.arange(60.0) + rng.uniform(-2e-6, 2e-6, 60)
        place = 3 + trial % 6
        pulses[place] += rng.choice([-1.0, 1.0]) * rng.uniform(0.03, 0.1) * 0.02
        validator = PulseValidator(pulses_per_revolution=marks, pulses_per_trigger=1)
        found = np.append(validator.update(pulses).times, validator.flush().times)
        assert pulses[place] not in found, trial
        assert found.size > 54


@pytest.mark.machines
def test_a_displaced_pulse_is_known_from_the_jitter_of_the_first_revolutions():
    """Five revolutions of few marks tell their jitter, also with one pulse displaced."""
    used = lost = 0
    for trial in range(90):
        rng = np.random.default_rng([trial, 42])
        marks = 2 + trial % 3
        pulses = 1.0 + 0.02 * (np.arange(60.0) + rng.uniform(-0.0039, 0.0039, 60))
        place = rng.integers(7, 20)
        pulses[place] += rng.choice([-1.0, 1.0]) * rng.uniform(0.05, 0.1) * 0.02
        validator = PulseValidator(pulses_per_revolution=marks, pulses_per_trigger=1)
        found = np.append(validator.update(pulses).times, validator.flush().times)
        used += pulses[place] in found
        lost += 59 - np.isin(np.delete(pulses, place), found).sum()
    assert used == 0
    assert lost <= 18


@pytest.mark.machines
@pytest.mark.parametrize('again', [False, True])
def test_a_displaced_pulse_beside_a_gap_is_no_pattern_of_two_marks(again):
    """Nor does it tell the scatter, at the start and behind a loss of the match."""
    used = lost = 0
    for trial in range(60):
        rng = np.random.default_rng([trial, 43])
        pulses = 1.0 + 0.02 * (np.arange(80.0) + rng.uniform(-0.0039, 0.0039, 80))
        first = 40 if again else 0  # a loss of the match there
        displaced = first + rng.integers(4, 10)
        gap = displaced + rng.choice([-3, 3])
        pulses[displaced] += rng.choice([-1.0, 1.0]) * rng.uniform(0.05, 0.1) * 0.02
        missing = [*range(gap, gap + 2 * int(np.sign(gap - displaced)),
                          int(np.sign(gap - displaced)))]
        if again:
            missing += range(30, 40)
            pulses[30:] += 0.011
        given = np.delete(pulses, missing)
        validator = PulseValidator(pulses_per_revolution=2, pulses_per_trigger=1)
        found = np.append(validator.update(given).times, validator.flush().times)
        used += pulses[displaced] in found
        lost += given.size - 1 - np.isin(given, found).sum()
    assert used <= 1
    assert lost < 60


def test_two_displaced_pulses_do_not_hide_each_other(rng):
    """Nor in what two marks show, which tells the scatter of the intervals."""
    for _ in range(30):
        errors = rng.normal(0.0, 2e-3, 21)
        errors[[5, 12]] += rng.choice([-1.0, 1.0], 2) * rng.uniform(0.06, 0.12, 2)
        levels = np.log(1.0 + np.diff(errors))
        pattern = steady_pattern(np.arange(20) % 2, levels, 2)
        assert 1e-3 < pattern.scatter < 7e-3
        assert np.abs(pattern.widths).max() < 5e-3


@pytest.mark.parametrize('late', [0.3, 0.45, -0.45])
@pytest.mark.parametrize('widths', [(0.0, 0.0), (0.2, -0.2)])
def test_a_far_displaced_pulse_leaves_the_scatter_what_it_is(late, widths, rng):
    """Its two levels together are lower, as logarithms are; this is no scatter."""
    for _ in range(30):
        places = np.arange(15) + np.where(np.arange(15) % 2, widths[0] / 2, widths[1] / 2)
        places += rng.uniform(-4e-3, 4e-3, 15)
        places[rng.integers(1, 14)] += late
        pattern = steady_pattern(np.arange(14) % 2, np.log(np.diff(places)), 2)
        assert 5e-4 < pattern.scatter < 0.015
        assert abs(np.ptp(pattern.widths) - np.ptp(np.log1p(widths))) < 0.02


def test_a_wrong_interval_alone_is_no_scatter(rng):
    """As where a displaced pulse was taken for the true one, and the next one for a stray."""
    for _ in range(30):
        levels = np.log(1.0 + np.diff(rng.uniform(-4e-3, 4e-3, 21)))
        levels[7:9] += np.log([1.42, 1.58])
        assert 1e-3 < steady_pattern(np.arange(20) % 2, levels, 2).scatter < 0.01


@pytest.mark.machines
@pytest.mark.parametrize('place', range(5, 12))
def test_displaced_pulses_in_the_first_revolutions_are_in_no_cycle(place, rng):
    """Nor in those behind: the tolerance that they teach is that of the others."""
    for _ in range(20):
        errors = rng.uniform(-4e-3, 4e-3, 60)
        errors[place] += rng.choice([-1.0, 1.0]) * rng.uniform(0.05, 0.45)
        errors[place + 14] += rng.choice([-1.0, 1.0]) * rng.uniform(0.06, 0.2)
        pulses = 0.018 * (np.arange(60) + errors)
        validator = PulseValidator(pulses_per_revolution=2)
        found = TriggerPulses.joined([validator.update(pulses), validator.flush()])
        for displaced in (place, place + 14):
            assert pulses[displaced] not in found.times
        assert found.times.size >= 20


@pytest.mark.parametrize('clock', [0.0, 4000.0])
@pytest.mark.parametrize('step', [1e-3, -1e-3])
def test_a_step_of_the_time_among_equal_intervals_is_in_no_cycle(step, clock):
    for period in (0.02, 0.03, 0.04, 1.0 / 33.3):
        pulses = 1.0 + period * np.arange(300.0) + step * (np.arange(300) >= 150)
        if clock:
            pulses = np.ceil(pulses * clock - 1e-9) / clock
        validator = PulseValidator()
        found = TriggerPulses.joined([validator.update(pulses), validator.flush()])
        assert found.times.size > 295
        assert found.starts_run[np.flatnonzero(found.times >= pulses[150])[0]]


def test_the_nearer_of_two_pulses_of_one_mark_is_the_pulse(rng):
    """Not a stray shortly before it, which fits worse."""
    pulses = 0.03 * np.arange(400.0) + rng.normal(0.0, 10e-6, 400)
    given = np.sort(np.append(pulses, pulses[50::20] - 80e-6))
    validator = PulseValidator()
    found = np.append(validator.update(given).times, validator.flush().times)
    assert np.array_equal(found, pulses)


def test_the_second_of_two_near_pulses_is_the_true_one():
    """A stray at 75 to 95 % of an interval is not taken for the pulse, nor the pulse dropped."""
    pulses = 0.03 * np.arange(100.0)
    for place in np.linspace(0.75, 0.95, 9):
        validator = PulseValidator()
        found = validator.update(np.sort(np.append(pulses, pulses[50] + 0.03 * place)))
        assert np.array_equal(found.times, pulses)
        assert validator.counts.early == 1


def test_strays_before_and_after_the_first_pulse(rng):
    pulses = 1.0 + 0.03 * np.arange(60.0) + rng.normal(0.0, 3e-6, 60)
    for place in np.arange(-0.9, 1.0, 0.1):
        validator = PulseValidator()
        found = validator.update(np.sort(np.append(pulses, pulses[0] + 0.03 * place)))
        assert np.isin(found.times, pulses).all()
        assert found.times.size >= 59


def test_a_doubled_rate_is_learnt_and_counted():
    """Pulses of a second keyphasor half an interval apart, say."""
    pulses = 0.03 * np.arange(100.0)
    validator = PulseValidator()
    found = validator.update(np.sort(np.append(pulses, pulses[50:] + 0.015)))
    assert validator.counts.relearnt == 1
    message, = validator.take_messages()
    assert 'from 0.03 s to 0.015 s' in message
    assert 'is there a second keyphasor of the same name' in message
    assert np.count_nonzero(found.starts_run) == 2
    assert np.diff(found.times)[~found.starts_run[1:]].min() == pytest.approx(0.015)


def test_the_tolerance_follows_the_shaft(rng):
    tolerance = []
    for scatter in (1e-4, 1e-3, 1e-2):
        model = IntervalModel(given=0.0, pulses_per_trigger=1, block=8)
        model.start(0.0, scatter=0.01, count=3)
        for _ in range(100):
            model.accept(rng.normal(0.0, scatter, model.room).tolist())
        tolerance.append(model.tolerance)
    assert tolerance == pytest.approx([2e-3, 6.5e-3, 6.5e-2], rel=0.4)


@pytest.mark.parametrize('clock', [3000.0, 5120.0, 8000.0])
def test_steps_of_a_slow_clock_cost_nothing(clock):
    """Equal intervals, one of them a period longer now and then."""
    pulses = np.ceil(np.arange(400.0) / 33.331 * clock) / clock
    validator = PulseValidator()
    found = np.concatenate([validator.update(pulses).times, validator.flush().times])
    assert np.array_equal(found, pulses)


def accepted_alone(pulses, **options):
    """Return whether all pulses were accepted, and no cycle was lost."""
    validator = PulseValidator(**options)
    validator.update(pulses)
    validator.flush()
    return validator.finish() == PulseCounts(accepted=pulses.size)


def drifting(rng, count, per_revolution, drift):
    """Return the times of marks at 25 Hz, of a speed that drifts to and fro by `drift`."""
    time = np.linspace(0.0, 1.3 * count / per_revolution / 25.0, 20_001)
    phase = rng.uniform(-np.pi, np.pi)
    speed = 25.0 * (1.0 + drift * np.sin(2.0 * np.pi * time / time[-1] + phase))
    angle = np.append(0.0, np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(time)))
    uneven = np.array([0.0, 0.01, -0.012, 0.006]) if per_revolution == 4 else 0.0
    turns = (np.arange(count // per_revolution)[:, None]
             + np.arange(per_revolution) / per_revolution + uneven)
    return rng.uniform(0.5, 1.0) + np.interp(turns.ravel(), angle, time)


@pytest.mark.parametrize('drift', [0.0, 0.05])
@pytest.mark.parametrize('per_revolution', [1, 4])
@pytest.mark.parametrize('clock', [2000.0, 5000.0])
def test_a_slow_clock_drops_no_pulse(clock, per_revolution, drift):
    """Nor with jitter of a tenth of its tick, which lets intervals be two ticks apart."""
    for seed in range(5):
        rng = np.random.default_rng([seed, 40])
        pulses = drifting(rng, 320, per_revolution, drift)
        pulses += rng.normal(0.0, 0.1 / clock, pulses.size)
        pulses = np.ceil(pulses * clock) / clock
        assert accepted_alone(pulses, pulses_per_revolution=per_revolution), seed


@pytest.mark.parametrize(('marks', 'seed'), [(2, 232), (2, 243), (3, 26), (3, 62), (4, 35)])
def test_pulses_are_no_strays_beside_the_first_few_that_scatter_less(marks, seed):
    """Nor is a pulse missing where one came, that happened to be a stray so near to its place."""
    rng = np.random.default_rng(seed)
    pulses = 1.0 + np.arange(40 * marks) / 25.0 / marks
    errors = rng.uniform(-0.5, 0.5, pulses.size)
    pulses += 0.004 * rng.choice([1, 3, 8]) / 25.0 / marks * errors
    assert accepted_alone(pulses, pulses_per_revolution=marks)


@pytest.mark.machines
@pytest.mark.parametrize(('shape', 'per_revolution'), [
    ('uniform', 1), ('uniform', 4), ('normal', 1), ('normal', 4), ('bimodal', 1)])
def test_large_errors_are_no_strays(shape, per_revolution):
    """Errors of a width of 1 to 10 % of an interval; the first few pulses may be unlocked."""
    for seed, width in enumerate([0.01, 0.03, 0.1] * 3):
        rng = np.random.default_rng([seed, 41])
        pulses = drifting(rng, 320, per_revolution, 0.02)
        errors = {'uniform': rng.uniform(-0.5, 0.5, pulses.size),
                  'normal': rng.normal(0.0, 12.0**-0.5, pulses.size),
                  'bimodal': rng.choice([-0.5, 0.5], pulses.size)}[shape]
        pulses += width * errors / 25.0 / per_revolution
        validator = PulseValidator(pulses_per_revolution=per_revolution)
        validator.update(pulses)
        validator.flush()
        counts = validator.finish()
        assert counts.unlocked <= 4
        # one of two places at random is what a loose mark shows, where that is far enough
        displaced = counts.displaced if shape == 'bimodal' and width > 0.01 else 0
        assert counts == PulseCounts(accepted=pulses.size - counts.unlocked,
                                     unlocked=counts.unlocked, displaced=displaced)


def test_gear_pulses_of_a_slow_clock_are_all_accepted(shared_data):
    slower = with_slower_clock(read(shared_data / 'gear0_gearbox.npz'), 6000.0)
    assert accepted_alone(slower.keyphasor_pulses(interpolate=False))


def test_a_tick_that_shows_every_two_hundred_pulses_costs_the_first_cycle_only():
    """The first may be a step of the time; no displaced pulse comes again with the same size."""
    pulses = np.ceil(13.995 * np.arange(2000.0)) / 7600.0
    validator = PulseValidator()
    validator.update(pulses)
    validator.flush()
    assert validator.finish() == PulseCounts(accepted=2000, late=1, cycles_discarded=1)


def test_a_stray_on_the_grid_of_the_clock_is_dropped():
    """Also where it is a whole number of ticks from the pulses, which others are not."""
    clock = 5000.0
    pulses = np.ceil(np.arange(300.0) / 25.03 * clock) / clock
    for place in (20, 40, 100, 160, 180):
        validator = PulseValidator()
        found = validator.update(np.sort(np.append(pulses, pulses[100::40] + place / clock)))
        found = np.append(found.times, validator.flush().times)
        assert np.isin(found, pulses).all()
        assert found.size == pulses.size


@pytest.mark.parametrize(('times', 'count'), [
    ([], 0), ([1.0], 0), (np.full(50, 2.0), 0), (np.arange(50.0, 0.0, -1.0), 0)])
def test_what_is_no_shaft_gives_no_cycle(times, count):
    validator = PulseValidator()
    found = validator.update(np.asarray(times, float)).times.size + validator.flush().times.size
    assert found == count


def test_strays_alone_give_hardly_any_cycle(rng):
    validator = PulseValidator()
    found = validator.update(np.sort(rng.uniform(0.0, 10.0, 300)))
    assert found.times.size < 30
    counts = validator.finish()
    assert counts.unlocked + counts.early + counts.doubles > 200


def test_a_wheel_that_changes_its_pattern_is_learnt_again(rng):
    even, uneven = np.arange(4) / 4.0, np.array([0.0, 0.2, 0.5, 0.7])
    turns = np.arange(60)[:, None] + np.where(np.arange(60)[:, None] < 30, even, uneven)
    pulses = turns.ravel() / 12.0 + rng.normal(0.0, 2e-6, turns.size)
    validator = PulseValidator(pulses_per_revolution=4)
    found = TriggerPulses.joined([validator.update(pulses), validator.flush()])
    assert np.abs(np.diff(found.times)[~found.starts_run[1:]] * 12.0 - 1.0).max() < 4e-3
    assert found.times.size > 40


@pytest.mark.machines
@pytest.mark.parametrize('share', [0.1, 0.15])
def test_missing_pulses_beside_steps_of_a_clock_cost_themselves_only(share):
    """Pulses missing in turns are no shaft at half the speed, and a tick is no displacement."""
    clock, lost = 6667.0, 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        true = np.arange(300) / 36.45 + 0.02 * rng.random()
        every = np.ceil((true + rng.normal(0.0, 1e-6, true.size)) * clock) / clock
        given = every[rng.random(true.size) > share]
        validator = PulseValidator()
        found = TriggerPulses.joined([validator.update(given), validator.flush()])
        cycles = np.diff(np.searchsorted(every, found.times))[~found.starts_run[1:]]
        assert np.all(cycles == 1)
        assert not validator.take_messages()
        lost += given.size - validator.counts.accepted
    assert lost < 12


@pytest.mark.parametrize('marks', [2, 4, 8])
def test_uneven_marks_are_matched_again_behind_a_step_of_the_time(marks):
    for seed in range(12):
        rng = np.random.default_rng(seed)
        places = np.arange(marks) / marks + rng.normal(0.0, 0.003, marks)
        pulses = (np.arange(60)[:, None] + places).ravel() / 25.0
        pulses += rng.normal(0.0, 5e-6, pulses.size)
        pulses[pulses.size // 2 + seed % marks:] += rng.uniform(0.2, 1.0)
        validator = PulseValidator(pulses_per_revolution=marks)
        found = TriggerPulses.joined([validator.update(pulses), validator.flush()])
        counts = validator.finish()
        assert (counts.accepted, counts.late) == (pulses.size, 1)
        turned = np.diff(np.searchsorted(pulses, found.times))[~found.starts_run[1:]]
        assert np.all(turned == marks)


def test_many_missing_pulses_of_two_marks_cause_no_warning():
    """Where most pairs of revolutions lack pulses, the others tell the scatter."""
    rng = np.random.default_rng(57)
    pulses = 0.02 * np.arange(60) + rng.normal(0.0, 1e-5, 60)
    there = pulses[rng.uniform(size=60) > 0.3][:24]
    begin, pattern = repeating(np.log(np.diff(there)), 2)
    assert begin == 12
    assert 5e-4 < pattern.scatter < 5e-3  # the intervals scatter by 7e-4


def test_every_other_pulse_that_stays_away_is_named():
    validator = PulseValidator()
    validator.update(np.arange(60) / 30.0)
    found = validator.update(2.0 + np.arange(60) / 15.0)
    assert np.count_nonzero(~found.starts_run) >= 50
    message, = validator.take_messages()
    assert 'every other pulse is missing' in message


@pytest.mark.parametrize(('pulses', 'narrowest'), [
    (1, 0.001), (10, 0.01), (60, 0.03), (1000, 0.03)])
def test_a_steady_shaft_narrows_the_tolerance_to_what_no_average_shows(pulses, narrowest):
    model = IntervalModel(given=0.0, pulses_per_trigger=pulses, block=8)
    model.start(0.0, scatter=0.0, count=200)
    assert model.tolerance == pytest.approx(narrowest)


@pytest.mark.parametrize(('levels', 'first'), [
    ([], 0), ([0.3, 0.0], 0), ([0.3, 0.0, 0.0, 0.0], 1), ([0.5, 0.1, 0.2, 0.3], 1),
    ([0.0, 1.0, 9.0], 0)])
def test_intervals_are_regular_from_the_first_that_others_confirm(levels, first):
    assert regular_start(np.array(levels), 0.01) == first
