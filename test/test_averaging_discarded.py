# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Averages that go on behind discarded trigger cycles."""

import numpy as np
import pytest
import sa_jitter_ros as sa

pytestmark = pytest.mark.filterwarnings('ignore::sa_jitter_ros.errors.DataWarning')

RATE, SPEED, ORDERS = 6400.0, 25.0, (1.0, 7.0, 23.0)
AMPLITUDES = np.array([1.0 * np.exp(0.4j), 0.5 * np.exp(-1.1j), 0.8 * np.exp(2.0j)])


def machine(seconds, *, ratio=1.0, noise=0.0, rng=None):
    """Return the vibration of a shaft at `ratio` times 25 Hz."""
    times = np.arange(round(seconds * RATE)) / RATE
    turns = np.outer(ORDERS, ratio * SPEED * times)
    wave = (AMPLITUDES[:, None] * np.exp(2j * np.pi * turns)).sum(axis=0).real
    return wave + (noise * rng.standard_normal(times.size) if noise else 0.0)


@pytest.mark.machines
@pytest.mark.parametrize('averaging', ['block', 'sliding', 'exponential'])
@pytest.mark.parametrize('ratio', [1.0, 2.40789])
def test_an_average_goes_on_over_missing_pulses(averaging, ratio):
    pulses = np.delete(np.arange(200) / SPEED, [30, 31, 60, 95, 96, 97, 130, 150])
    averages = sa.average(
        machine(8.1, ratio=ratio), RATE, pulses, ratio=ratio, orders=ORDERS, trigger_cycles=40,
        maximum_discarded=0.5, averaging=averaging)
    assert [average.sequence for average in averages] == list(range(len(averages)))
    assert len(averages) == (4 if averaging == 'block' else 200 - 1 - 8 - 5 - 39)
    for average in averages:
        assert average.trigger_cycles == 40
        # phases of all averages compare, because the angle runs on; other orders leak for r = 2.4
        leak = 1e-3 if ratio == 1.0 else 0.05
        assert abs(average.amplitudes[0] - AMPLITUDES).max() < leak
        assert average.trigger_speed == pytest.approx(SPEED, rel=1e-9)
        count = round((average.end_time - average.start_time) * SPEED)
        assert average.discarded_cycles == count - 40
        assert average.used.sum() == 40
        assert np.isin(average.pulses, pulses).all()
        assert np.count_nonzero(~average.used) == 1 + np.count_nonzero(
            np.diff(average.cycle_numbers) > 1)
        turns = np.exp(2j * np.pi * np.outer(ORDERS, average.angle))
        wave = (AMPLITUDES[:, None] * turns).sum(axis=0).real
        assert np.abs(average.waveform[0] - wave).max() < 2e-2
        assert average.fundamental_cycles <= 40 * ratio
    assert max(average.discarded_cycles for average in averages) > 2


def test_more_discarded_cycles_than_allowed_end_the_average():
    pulses = np.delete(np.arange(160) / SPEED, np.arange(30, 45))
    settings = {'orders': ORDERS, 'trigger_cycles': 40}
    few = sa.average(machine(6.5), RATE, pulses, maximum_discarded=0.3, **settings)
    many = sa.average(machine(6.5), RATE, pulses, maximum_discarded=0.4, **settings)
    assert [average.discarded_cycles for average in few] == [0, 0]
    assert few[0].start_time == 45 / SPEED
    assert [average.discarded_cycles for average in many] == [16, 0, 0]
    assert many[0].start_time == 0.0
    averages = sa.average(machine(6.5), RATE, pulses, **settings)
    assert [average.start_time for average in averages] == [45 / SPEED, 85 / SPEED]


def test_an_average_with_too_many_discarded_cycles_begins_later():
    missing = [*range(2, 32, 3), 55]
    pulses = np.delete(np.arange(160) / SPEED, missing)
    averages = sa.average(machine(6.5), RATE, pulses, orders=ORDERS, trigger_cycles=40,
                          maximum_discarded=0.5)
    assert averages[0].start_time == 3 / SPEED
    assert averages[0].discarded_cycles == 20
    for average in averages:
        assert average.used.sum() == 40
        assert abs(average.amplitudes[0] - AMPLITUDES).max() < 1e-3
    np.testing.assert_array_equal(averages[0].cycle_numbers[:2], [0, 3])


@pytest.mark.machines
@pytest.mark.parametrize('correct', [False, True])
@pytest.mark.parametrize('seed', range(3))
def test_averages_that_begin_later_do_not_depend_on_the_cutting(seed, correct):
    rng = np.random.default_rng(seed)
    pulses = (np.arange(160) / SPEED)[rng.random(160) > 0.2]
    wave = machine(6.5, ratio=2.40789, noise=0.1, rng=rng)
    options = {'orders': ORDERS, 'trigger_cycles': 20, 'maximum_discarded': 0.5,
               'ratio': 2.40789, 'correct_jitter': correct}
    whole = sa.average(wave, RATE, pulses, **options)
    averager, found = sa.Averager(RATE, **options), []
    for part in np.array_split(np.arange(wave.size), 40):
        due = pulses[pulses < (part[-1] + 1) / RATE]
        found += averager.update(wave[part], due)
        pulses = pulses[due.size:]
    found += averager.update(None, pulses) + averager.flush()
    assert averager.counts['averages_dropped'] > 1
    assert len(found) == len(whole) > 2
    for a, b in zip(found, whole):
        np.testing.assert_allclose(a.amplitudes, b.amplitudes, rtol=1e-9)
        np.testing.assert_allclose(a.waveform, b.waveform, rtol=1e-9)
        np.testing.assert_array_equal(a.pulses, b.pulses)
        np.testing.assert_array_equal(a.cycle_numbers, b.cycle_numbers)
        assert a.discarded_cycles == b.discarded_cycles <= 10


def test_a_gap_of_unknown_length_ends_the_average():
    pulses = np.arange(160) / SPEED
    pulses = np.append(pulses[:30], pulses[33:] + 0.4 / SPEED)
    averages = sa.average(machine(6.6), RATE, pulses, orders=ORDERS, trigger_cycles=40,
                          maximum_discarded=0.5)
    assert averages[0].start_time == pulses[30]
    assert averages[0].discarded_cycles == 0


def test_a_gap_of_the_vibration_costs_its_cycles_only():
    wave = machine(4.1)
    wave[8000:8100] = np.nan
    average, _ = sa.average(wave, RATE, np.arange(100) / SPEED, orders=ORDERS, trigger_cycles=40,
                            maximum_discarded=0.5)
    assert average.discarded_cycles == 1
    assert abs(average.amplitudes[0] - AMPLITUDES).max() < 1e-3


@pytest.mark.parametrize('ratio', [1.0, 2.40789])
def test_pulse_errors_are_recovered_over_gaps(rng, ratio):
    clock = 2000.0 * ratio
    true = np.arange(180) / SPEED
    late = np.ceil(true * clock + rng.random()) / clock
    kept = rng.random(180) > 0.08
    wave = machine(7.3, ratio=ratio, noise=0.05, rng=rng)
    averages = sa.average(wave, RATE, late[kept], ratio=ratio, orders=ORDERS, trigger_cycles=40,
                          maximum_discarded=0.5, correct_jitter=True, keyphasor_rate=clock)
    assert len(averages) >= 2
    z_scores = []
    for average in averages:
        correction = average.correction
        assert correction.accepted
        assert average.discarded_cycles > 0
        assert correction.pulse_errors.shape == average.pulses.shape == average.used.shape
        error = late - true
        error = error[np.searchsorted(late, average.pulses)]
        apart = correction.pulse_errors - (error - error.mean())
        z_scores.append(apart / correction.standard_errors)
        assert np.abs(z_scores[-1]).max() < 6.0
        assert np.abs(correction.amplitudes[0]) == pytest.approx(np.abs(AMPLITUDES), rel=0.02)
    assert np.std(np.concatenate(z_scores)) == pytest.approx(1.0, abs=0.2)


@pytest.mark.machines
@pytest.mark.parametrize('seed', range(4))
def test_any_cutting_gives_the_same_averages(seed):
    rng = np.random.default_rng(seed)
    pulses = (np.arange(200) / SPEED)[rng.random(200) > 0.06]
    wave = machine(8.1, noise=0.1, rng=rng)
    options = {'orders': ORDERS, 'trigger_cycles': 30, 'maximum_discarded': 0.5,
               'averaging': ['block', 'sliding'][seed % 2]}
    whole = sa.average(wave, RATE, pulses, **options)
    averager, found = sa.Averager(RATE, **options), []
    cuts = np.sort(rng.integers(0, wave.size, 25))
    for part in np.split(np.arange(wave.size), cuts):
        end = (part[-1] + 1) / RATE if part.size else 0.0
        due = pulses[pulses < end + rng.uniform(-0.1, 0.1)]
        found += averager.update(wave[part], due)
        pulses = pulses[due.size:]
    found += averager.update(None, pulses) + averager.flush()
    assert len(found) == len(whole) > 2
    for a, b in zip(found, whole):
        np.testing.assert_allclose(a.amplitudes, b.amplitudes, rtol=1e-9)
        np.testing.assert_array_equal(a.pulses, b.pulses)
        assert a.discarded_cycles == b.discarded_cycles
