# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""A path delay is predicted per acquisition: against averages of a simulated machine."""

from dataclasses import replace

import numpy as np
import pytest
import sa_jitter_ros as sa
from sa_jitter_ros.effects import make_effect
from sa_jitter_ros.prediction.amplitudes import component_gain, known_amplitudes
from sa_jitter_ros.prediction.influence import AveragePulses, random_processes
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.simulation import Component, DeclaredJitter, Gearbox, PathDelay

RATE, ORDERS, CYCLES, DELAY = 5000.0, (10.0, 20.0, 40.0), 40, 5e-3
MODEL = DeclaredModel(keyphasor_rate=1500.0, trigger_speed=25.0, trigger_cycles=CYCLES,
                      orders=ORDERS, sample_rate=RATE)
EFFECT = make_effect('path_delay', delay=DELAY)


def averages(*effects, seed=1, speed=((0.0, 20.0), (20.0, 30.0))):
    """Return averages of a run-up, by default of 0.5 Hz a second."""
    machine = Gearbox(tuple(Component('shaft', order, (1.0,), (0.3,)) for order in ORDERS), RATE,
                      speed=speed, seed=seed, effects=effects)
    return sa.average(machine.vibration(0, 100_000), RATE, machine.pulses(0.0, 20.0).times,
                      trigger_cycles=CYCLES, orders=ORDERS, interval_tolerance=0.25)


def predicted(average, jitter=()):
    """Return what is predicted of an average whose pulses were measured."""
    model = replace(MODEL, trigger_speed=average.trigger_speed)
    return known_amplitudes(
        model, jitter, EFFECT.pattern(model, AveragePulses(average.pulses))[None],
        gain=component_gain(model, [EFFECT]))


def test_delay_turns_with_the_speed_and_attenuates_where_it_changes():
    plain, late = averages(), averages(PathDelay(DELAY))
    assert len(plain) == len(late) > 9
    for one, other in zip(plain, late):
        seen = other.amplitudes[0] / one.amplitudes[0]
        found = predicted(other).moments.mean
        np.testing.assert_allclose(seen, found, atol=2e-3)
        # 1.3 Hz within the first average: order 40 turns by a quarter of a cycle.
        spread = 40.0 * DELAY * np.ptp(1.0 / np.diff(one.pulses)) * CYCLES / (CYCLES - 1)
        assert abs(found[2]) == pytest.approx(np.sinc(spread), abs=1e-3)
    turns = np.angle(late[-1].amplitudes[0] / plain[-1].amplitudes[0]
                     * np.conj(late[0].amplitudes[0] / plain[0].amplitudes[0]))
    change = late[-1].trigger_speed - late[0].trigger_speed
    wanted = 2.0 * np.pi * np.array(ORDERS) * change * DELAY
    np.testing.assert_allclose(np.exp(1j * turns), np.exp(1j * wanted), atol=5e-3)


@pytest.mark.machines
def test_delay_and_jitter_have_the_predicted_mean_and_scatter():
    """Jitter is also in the speeds from which the delay's errors are predicted."""
    z, parts = [], []
    jitter = DeclaredJitter('uniform', 1.0 / 1500.0 / 12**0.5)
    for seed in range(8):
        for average in averages(PathDelay(DELAY), jitter, seed=seed):
            model = replace(MODEL, trigger_speed=average.trigger_speed)
            found = predicted(average, random_processes(model, [EFFECT]))
            law = found.distribution(np.arange(len(ORDERS)))
            z.append((np.abs(average.amplitudes[0]) - law.mean) / np.sqrt(law.variance))
            parts.append(law.cdf(np.abs(average.amplitudes[0])[:, None])[:, 0])
    z = np.array(z)
    assert z.shape[0] >= 80
    assert np.all(np.abs(z.mean(axis=0)) < 4.0 / np.sqrt(len(z)))
    kurtosis = np.mean(z**4, axis=0) / np.mean(z**2, axis=0) ** 2
    assert np.all(np.abs(np.mean(z**2, axis=0) - 1.0) < 4.0 * np.sqrt((kurtosis - 1.0) / len(z)))
    assert np.all(np.abs(np.mean(parts, axis=0) - 0.5) < 4.0 / np.sqrt(12.0 * len(z)))


def test_unknown_times_leave_the_known_ones_their_errors():
    times = np.cumsum(np.linspace(0.05, 0.04, 20))
    whole = EFFECT.pattern(MODEL, AveragePulses(times))
    holes = times.copy()
    holes[[0, 7, 19]] = np.nan
    found = EFFECT.pattern(MODEL, AveragePulses(holes))
    assert np.all(np.isfinite(found))
    np.testing.assert_allclose(np.diff(found)[2:17], np.diff(whole)[2:17], atol=0.05 * DELAY)
    assert EFFECT.pattern(MODEL, AveragePulses(np.full(20, np.nan))) is None
    missing = np.zeros(17, int)
    missing[8] = 2
    gap = EFFECT.pattern(MODEL, AveragePulses(np.delete(times, [9, 10]), missing=missing))
    np.testing.assert_allclose(gap, np.delete(whole, [9, 10]), atol=0.01 * DELAY)
