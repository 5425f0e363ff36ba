# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""A speed that changes inside revolutions, which averages of whole revolutions do not follow."""

import re
import warnings

import numpy as np
import pytest
import sa_jitter_ros as sa

RATE, SPEED, SECONDS = 5000.0, 10.0, 5.0


def machine(ripple, times, phase, teeth, missing, orders, phases):
    """Return vibration (sample,) of a shaft whose speed ripples, and pulses of its target."""
    time = np.arange(int(RATE * SECONDS)) / RATE
    turns = SPEED * time + ripple / times / (2.0 * np.pi) * np.sin(
        times * 2.0 * np.pi * SPEED * time + phase)
    vibration = sum(np.cos(2.0 * np.pi * order * turns + each)
                    for order, each in zip(orders, phases))
    marks = np.arange(np.ceil(turns[0] * teeth), turns[-1] * teeth)
    pulses = np.interp(marks / teeth, turns, time)
    return vibration, pulses[~np.isin(marks % teeth, missing)]


def averaged(vibration, pulses, **options):
    """Return the amplitudes (order,) and what is said of revolutions."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter('always')
        found = sa.average(vibration, RATE, pulses, **options)
    return np.abs(found[0].amplitudes[0]), [
        str(item.message) for item in said if 'inside revolutions' in str(item.message)]


@pytest.mark.machines
@pytest.mark.parametrize('seed', range(12))
def test_what_a_revolution_loses_is_said_with_its_size(seed):
    rng = np.random.default_rng(seed)
    teeth, missing = [(36, [0]), (60, [0, 1]), (24, []), (8, [])][seed % 4]
    ripple, times = rng.uniform(0.1, 0.35), int(rng.integers(1, 4))
    orders, phases = sorted(rng.choice(np.arange(1, 7), 2, replace=False)), rng.uniform(0, 6.28, 2)
    vibration, pulses = machine(ripple, times, rng.uniform(0, 6.28), teeth, missing, orders,
                                phases)
    options = {'orders': [float(order) for order in orders], 'pulses_per_revolution': teeth,
               'missing_teeth': len(missing)}
    alone = [machine(ripple, times, 0.0, teeth, missing, [order], [phase])[0]
             for order, phase in zip(orders, phases)]
    lost = max(1.0 - averaged(one, machine(ripple, times, 0.0, teeth, missing, [1], [0])[1],
                              trigger_cycles=40, **options)[0][k] for k, one in enumerate(alone))
    _, said = averaged(vibration, pulses, trigger_cycles=40, **options)
    named = float(re.search(r'may lose (\d+)%', said[0])[1]) / 100.0 if said else 0.0
    assert lost <= named + 0.012  # said from 1 % on, in whole percents
    marks = teeth - len(missing)
    _, said = averaged(vibration, pulses, trigger_cycles=40 * marks, pulses_per_trigger=1,
                       **options)
    assert said == []


@pytest.mark.parametrize(('teeth', 'missing'), [
    (36, [0]), (60, []), (4, []), (1, []), (36, [16, 17, 19, 20, 34, 35]), (24, [3, 8, 9])])
def test_nothing_is_said_of_a_steady_shaft(teeth, missing):
    vibration, pulses = machine(0.0, 1, 0.0, teeth, missing, [3], [0.3])
    pulses = pulses + np.random.default_rng(1).normal(0.0, 1e-5, pulses.size)
    amplitudes, said = averaged(vibration, pulses, orders=[3.0], pulses_per_revolution=teeth,
                                missing_teeth=len(missing))
    assert (amplitudes[0], said) == (pytest.approx(1.0, abs=5e-3), [])


@pytest.mark.parametrize('teeth', [6, 12])
def test_jitter_is_no_pattern_of_the_marks(rng, teeth):
    vibration, pulses = machine(0.0, 1, 0.0, teeth, [], [3], [0.3])
    for _ in range(20):
        _, said = averaged(vibration, pulses + rng.normal(0.0, 3e-4, pulses.size),
                           orders=[3.0, 100.0], pulses_per_revolution=teeth)
        assert said == []
