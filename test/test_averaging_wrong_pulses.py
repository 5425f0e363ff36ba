# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Recovered errors that no jitter explains, and those that grow with time."""

import numpy as np
import pytest
import sa_jitter_ros as sa

pytestmark = pytest.mark.filterwarnings('ignore::sa_jitter_ros.errors.DataWarning')

RATE, SPEED, JITTER = 12_800.0, 25.0, 20e-6
ORDERS, AMPLITUDES = (12.0, 23.0, 46.0), np.array([0.7, 1.0, 0.5])
OPTIONS = {'orders': ORDERS, 'trigger_cycles': 40, 'correct_jitter': True,
           'keyphasor_rate': 1.0 / (np.sqrt(12.0) * JITTER)}


@pytest.fixture
def machine(rng):
    """Return vibration and pulses of a shaft, 8 s."""
    time = np.arange(round(8.0 * RATE)) / RATE
    vibration = sum(a * np.cos(2.0 * np.pi * g * SPEED * time + g)
                    for a, g in zip(AMPLITUDES, ORDERS)) + rng.normal(0.0, 0.05, time.size)
    pulses = np.arange(1, 199) / SPEED
    return vibration, pulses + rng.normal(0.0, JITTER, pulses.size)


def errors_of(averages):
    """Return the largest relative error of the corrected amplitudes of each average."""
    return [np.max(np.abs(np.abs(item.correction.amplitudes[0]) / AMPLITUDES - 1.0))
            for item in averages]


@pytest.mark.parametrize('late', [0.01, -0.02, 0.05])
def test_a_displaced_pulse_is_fitted_again_as_a_missing_one(machine, late):
    vibration, pulses = machine
    places = [30, 70, 130]
    pulses[places] += late / SPEED
    averager = sa.Averager(RATE, interval_tolerance=0.25, **OPTIONS)
    averages = averager.update(vibration, pulses) + averager.flush()
    assert len(averages) == 4
    assert [item.correction.refitted for item in averages] == [1, 1, 0, 1]
    assert averager.counts['pulses_refitted'] == 3
    assert sum('no jitter explains' in line for line in averager.messages) == 3
    assert max(errors_of(averages)) < 0.005
    assert np.max(np.abs(np.abs(averages[0].amplitudes[0]) / AMPLITUDES - 1.0)) > 0.04
    found = averages[1].correction.pulse_errors
    assert found[30] - np.median(found) == pytest.approx(late / SPEED, abs=5.0 * JITTER)
    assert averages[1].correction.jitter_std == pytest.approx(JITTER, rel=0.4)


def test_a_pulse_too_far_for_the_samples_at_hand_refuses_the_correction(machine):
    vibration, pulses = machine
    pulses[70] += 0.1 / SPEED
    averages = sa.average(vibration, RATE, pulses, interval_tolerance=0.25, **OPTIONS)
    refused = [item.correction for item in averages if not item.correction.accepted]
    assert len(refused) == 1
    assert '6% of a trigger cycle: check the pulses' in refused[0].reason


def test_a_displaced_pulse_beside_discarded_cycles_is_found_too(machine):
    vibration, pulses = machine
    pulses[20] += 0.02 / SPEED
    averager = sa.Averager(RATE, interval_tolerance=0.25, maximum_discarded=0.5, **OPTIONS)
    averages = averager.update(vibration, np.delete(pulses, [24, 60])) + averager.flush()
    assert averages[0].discarded_cycles == 2
    assert averages[0].correction.refitted == 1
    assert max(errors_of(averages)) < 0.005


def test_nothing_is_fitted_again_where_jitter_explains_all(machine, rng):
    vibration, pulses = machine
    averager = sa.Averager(RATE, **OPTIONS)
    averages = averager.update(vibration, pulses) + averager.flush()
    assert averager.counts['pulses_refitted'] == 0
    assert max(errors_of(averages)) < 0.005
    assert not averager.messages


@pytest.mark.parametrize('skew', [1e-4, -5e-5])
def test_a_clock_that_runs_away_is_named_with_its_size(machine, skew):
    vibration, pulses = machine
    averager = sa.Averager(RATE, **{**OPTIONS, 'trigger_cycles': 20})
    averager.update(vibration, pulses * (1.0 + skew))
    averager.flush()
    line, = averager.messages
    word = 'late' if skew > 0.0 else 'early'
    assert line.startswith(f'shaft: the pulses come {word} by ')
    size = float(line.rpartition('differ by ')[2].removesuffix(' ppm'))
    assert f'by {size:.3g} us more every second' in line
    assert size == pytest.approx(1e6 * abs(skew), abs=15.0)
