# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Machines of many kinds without a tach, and what is known of the pulses found in them."""

import numpy as np
import pytest
import sa_jitter_ros as sa
from sa_jitter_ros.recordings import ArraySource, Recording
from sa_jitter_ros.tacholess.recording import summary, Tacholess
from scipy.interpolate import CubicSpline
from scipy.signal import lfilter
import tacholess as benchmark

RATE = 4096.0
SECONDS = 10.0
TIMES = np.arange(int(SECONDS * RATE)) / RATE


def steady(rng):
    """Return the speed (sample,) in Hz of a machine on the mains."""
    return 17.0 + 0.003 * np.sin(2.0 * np.pi * 0.3 * TIMES + rng.uniform(0.0, 6.0))


def wander(rng):
    """Return that of a machine whose load changes."""
    knots = np.arange(-1.0, SECONDS + 2.0)
    return CubicSpline(knots, 17.0 + 0.15 * rng.standard_normal(knots.size))(TIMES)


def torsion(rng):
    """Return that of a shaft that swings."""
    return 17.0 * (1.0 + 0.002 * np.sin(2.0 * np.pi * rng.uniform(0.8, 1.5) * TIMES))


def run_up(_):
    """Return that of a machine that starts."""
    return 12.0 + 0.8 * TIMES


def coast_down(_):
    """Return that of a machine that stops."""
    return 22.0 * np.exp(-TIMES / 20.0)


MOTIONS = [steady, wander, torsion, run_up, coast_down]


def shown(speed, orders, rng, *, channels=1, noise=1.0):
    """Return vibration (channel, sample) and angle (sample,) of a machine at a speed."""
    angle = np.cumsum(speed) / RATE
    lines = sum(np.cos(2.0 * np.pi * order * angle + rng.uniform(0.0, 6.0)) for order in orders)
    return lines + noise * rng.standard_normal((channels, angle.size)), angle


def off(found, angle):
    """Return errors of the angle at the pulses, in turns, about their mean."""
    error = np.interp(found.times, TIMES, angle) - np.arange(found.times.size)
    return error - error.mean()


@pytest.mark.machines
@pytest.mark.parametrize('motion', MOTIONS, ids=lambda motion: motion.__name__)
@pytest.mark.parametrize('orders', [(1.0, 2.0, 3.0, 4.0), (17.0, 23.0, 46.0)], ids=str)
def test_motion_is_followed(motion, orders):
    rng = np.random.default_rng(MOTIONS.index(motion))
    vibration, angle = shown(motion(rng), orders, rng)
    found = sa.find_pulses(vibration, RATE, orders=orders, speed_range=(9.0, 27.0))
    error, stated = off(found, angle), found.standard_errors * found.speed
    assert np.abs(error).max() * max(found.used) < 0.1
    # Of a smooth motion the errors are all alike: one draw of a few numbers.
    assert error.std() < 3.0 * np.sqrt(np.mean(stated**2))
    assert stated.max() * max(found.used) < 0.1


def test_lines_of_another_shaft_are_not_followed():
    rng = np.random.default_rng(8)
    speed = wander(rng)
    vibration, angle = shown(speed, (17.0, 23.0, 46.0), rng)
    for order in (19.0, 38.0):
        vibration += 2.0 * np.cos(2.0 * np.pi * order * 0.77 * angle)
    found = sa.find_pulses(vibration, RATE, orders=(17.0, 23.0, 46.0), speed_range=(9.0, 27.0))
    assert np.abs(off(found, angle)).max() * 46.0 < 0.1


def test_resonance_of_the_noise_attracts_nothing():
    rng = np.random.default_rng(9)
    vibration, angle = shown(run_up(rng), (17.0, 34.0, 51.0), rng, noise=0.3)
    colour = [1.0, -2.0 * 0.97 * np.cos(2.0 * np.pi * 400.0 / RATE), 0.97**2]
    vibration += lfilter([0.3], colour, rng.standard_normal(vibration.shape), axis=1)
    found = sa.find_pulses(vibration, RATE, orders=(17.0, 34.0, 51.0), speed_range=(9.0, 27.0))
    assert np.abs(off(found, angle)).max() * 51.0 < 0.1


@pytest.mark.machines
def test_a_channel_without_lines_costs_nothing():
    rng = np.random.default_rng(10)
    vibration, angle = shown(wander(rng), (17.0, 34.0, 51.0), rng)
    noise = 50.0 * rng.standard_normal(vibration.shape)
    alone, beside = (sa.find_pulses(samples, RATE, orders=(17.0, 34.0, 51.0),
                                    speed_range=(9.0, 27.0))
                     for samples in (vibration, np.vstack([noise, vibration])))
    assert np.median(beside.standard_errors) < 1.2 * np.median(alone.standard_errors)
    assert np.abs(off(beside, angle)).max() * 51.0 < 0.1


def test_the_recording_gets_pulses_and_a_remark():
    rng = np.random.default_rng(11)
    vibration, _ = shown(wander(rng), (17.0, 34.0), rng)
    recording = Recording(ArraySource(vibration), RATE, start_time=50.0, ratio=2.0,
                          orders=(8.5, 17.0), pulses_per_revolution=4)
    with_pulses, found = Tacholess((9.0, 27.0)).pulses_of(recording, sa.Machine())
    assert with_pulses.pulses_per_revolution == 1
    assert np.array_equal(with_pulses.keyphasor_pulses(), found.times)
    assert 50.0 < found.times[0] < 50.5
    assert with_pulses.remarks[-1] == summary(found)
    assert 'orders 17, 34, at ' in summary(found)
    with pytest.raises(sa.ParameterError, match='no orders to find pulses from'):
        Tacholess((9.0, 27.0)).pulses_of(Recording(ArraySource(vibration), RATE), sa.Machine())


def test_expected_amplitudes_name_what_is_wrong_with_revolutions():
    rng = np.random.default_rng(12)
    vibration, _ = shown(steady(rng), (17.0, 34.0), rng)
    found = sa.find_pulses(vibration, RATE, orders=(17.0, 34.0), speed_range=(9.0, 27.0))
    for wrong in (1, 10_000):
        with pytest.raises(sa.ParameterError, match=f'revolutions is {wrong}: give 2 to'):
            found.expected([17.0], wrong)
    few, many = (found.expected([5.0, 17.0, 60.0], count) for count in (10, 150))
    assert np.all(np.diff(few.attenuation) < 0.0)  # the higher, the more is lost
    assert np.all(many.attenuation < few.attenuation)  # and the longer
    assert many.factor[1] > 1.0 > many.factor[0]


@pytest.mark.campaign
def test_benchmark_judges_a_machine():
    row = benchmark.judged(benchmark.drawn(3), others=True)
    assert not row.wrong
    assert row.error < row.comb
    assert len(benchmark.summary('one', [row])) == len(benchmark.HEADER)
