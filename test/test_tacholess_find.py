# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Pulses found in the vibration alone: right, with errors that cover, or refused with a reason."""

from dataclasses import replace

import numpy as np
import pytest
import sa_jitter_ros as sa
from sa_jitter_ros.tacholess.found import CorrectedAmplitudes
from sa_jitter_ros.tacholess.smoother import MEMORY, Posterior, Seen, Walk
from scipy.interpolate import CubicSpline
from scipy.linalg import expm
from scipy.stats import chi2

RATE = 4096.0
ORDERS = [19.0, 38.0, 57.0]
RANGE = (12.0, 28.0)


def made(seed, *, seconds=20.0, noise=1.0, sizes=(1.0, 1.0, 0.7), orders=ORDERS, wander=0.1,
         slope=0.0, channels=1):
    """Return vibration (channel, sample) and the true angle of a machine near 20 Hz."""
    rng = np.random.default_rng(seed)
    knots = np.arange(-1.0, seconds + 1.5, 0.5)
    angle = CubicSpline(
        knots, 18.0 + slope * knots + wander * rng.standard_normal(knots.size)).antiderivative()
    turns = angle(np.arange(int(seconds * RATE)) / RATE)
    lines = sum(size * np.cos(2.0 * np.pi * order * turns + order)
                for order, size in zip(orders, sizes))
    return lines + noise * rng.standard_normal((channels, turns.size)), angle


def error(found, angle):
    """Return the errors of the angle at the pulses found, in turns, about their mean."""
    turns = angle(found.times) - np.arange(found.times.size)
    return turns - turns.mean()


@pytest.fixture(scope='module')
def run_up():
    vibration, angle = made(1, slope=0.2, channels=2)
    return vibration, angle, sa.find_pulses(vibration, RATE, orders=ORDERS, speed_range=RANGE)


@pytest.fixture(scope='module')
def noisy():
    """Return vibration, angle and found pulses of three machines in much noise."""
    machines = [made(seed, noise=2.0, seconds=10.0) for seed in range(3)]
    return [(vibration, angle, sa.find_pulses(
        vibration, RATE, orders=ORDERS, speed_range=RANGE)) for vibration, angle in machines]


@pytest.mark.machines
def test_pulses_of_a_run_up(run_up):
    _, angle, found = run_up
    assert found.reason == ''
    assert found.used == tuple(ORDERS)
    assert found.times.size > 350
    stated = found.standard_errors * found.speed
    off = error(found, angle)
    assert 0.6 < off.std() / np.sqrt(np.mean(stated**2)) < 1.4
    assert np.mean(np.abs(off) < 1.96 * stated) > 0.85
    speed = (found.speed - angle(found.times, 1)) / found.speed_standard_errors
    assert np.mean(np.abs(speed) < 1.96) > 0.85


@pytest.mark.machines
def test_errors_whitened_by_their_covariance_are_independent(noisy):
    """Their sum of squares is that of the directions in which pulses err most."""
    squares = freedom = 0.0
    for _, angle, found in noisy:
        values, vectors = np.linalg.eigh(found.covariance)
        known = values > 0.3 * values.max()  # where nearly all of the variance is
        off = vectors.T[known] @ (error(found, angle) / found.speed)
        squares += np.sum(off**2 / values[known])
        freedom += known.sum()
    low, high = chi2.ppf([1e-3, 1.0 - 1e-3], freedom)
    assert 0.7 * low < squares < 1.2 * high  # sizes of walks and noise are estimated, too


def test_covariance_agrees_with_standard_errors_and_parts(run_up):
    found = run_up[2]
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), found.standard_errors,
                               rtol=1e-6)
    part = found.angle_covariance(40, 30)
    whole = found.covariance * np.multiply.outer(*2 * [2.0 * np.pi * found.speed])
    difference = whole[40:70, 40:70]
    for matrix in (part, difference):  # alike but for the arbitrary angle
        matrix -= matrix.mean(axis=0)
        matrix -= matrix.mean(axis=1, keepdims=True)
    np.testing.assert_allclose(part, difference, atol=1e-9 * np.abs(part).max() + 1e-12)


@pytest.mark.machines
def test_used_orders_are_too_large_and_others_too_small(noisy):
    """By as much as is expected: both are of the same averages, whose noise does not count."""
    rows = []
    for vibration, _, found in noisy:
        row = []
        for used in (True, False):
            if not used:
                found = sa.find_pulses(vibration, RATE, orders=ORDERS, speed_range=RANGE,
                                       hold_out=ORDERS[1:2])
            expected = found.expected(ORDERS, 60)
            assert expected.used.tolist() == [True, used, True]
            average = sa.average(vibration, RATE, found.times, orders=ORDERS, trigger_cycles=60,
                                 angle_law='spline')
            measured = np.mean([np.abs(item.amplitudes[0, 1]) for item in average])
            row.append((measured, expected.factor[1]))
        rows.append(row)
    measured, factor = np.moveaxis(rows, 2, 0)
    assert np.all((factor > 1.0) == [True, False])
    # the standard deviations of machines are 0.018 of an average, 0.0015 of a difference
    assert np.all(np.abs((measured - factor).mean(axis=0)) < 3.0 * 0.018 / np.sqrt(len(rows)))
    difference = np.diff(measured - factor)
    assert abs(difference.mean()) < 3.0 * 0.0015 / np.sqrt(len(rows)) < 0.5 * np.mean(
        factor[:, 0] - factor[:, 1])


def test_correction_covers_the_truth(run_up):
    vibration, _, found = run_up
    averages = sa.average(vibration, RATE, found.times, orders=ORDERS, trigger_cycles=100,
                          angle_law='spline')
    corrected = found.correct(averages[0])
    assert isinstance(corrected, CorrectedAmplitudes)
    assert all(text.startswith('bias corrected') for text in corrected.how)
    off = (np.abs(corrected.amplitudes) - [1.0, 1.0, 0.7]) / corrected.standard_errors
    assert np.all(np.abs(off) < 4.0)


def test_attenuation_of_small_errors_is_that_of_their_variance(run_up):
    found = run_up[2]
    expected = found.expected([7.0], 50)
    loss = np.mean([1.0 - np.exp(-0.5 * 49.0 * (np.trace(part) / len(part) - part.mean()))
                    for begin in np.linspace(0, len(found.times) - 51, 7).astype(int)
                    for part in [found.angle_covariance(begin, 51)]])
    assert 1.0 - expected.attenuation[0] == pytest.approx(loss, rel=0.2)


def test_gap_ends_the_pulses_and_a_dead_channel_costs_itself(run_up):
    vibration, angle, _ = run_up
    broken = np.vstack([vibration, np.full((1, vibration.shape[1]), np.nan)])
    broken[:, int(7.0 * RATE):int(7.2 * RATE)] = np.inf
    broken[1, int(12.0 * RATE):] = np.nan  # one channel less from here
    found = sa.find_pulses(broken, RATE, orders=ORDERS, speed_range=RANGE, start_time=100.0)
    assert found.reason == 'outside 107.2 to 120 s samples are lacking'
    assert 107.2 < found.times[0] < 107.5
    assert found.times[-1] > 119.8
    assert np.abs(error(replace(found, times=found.times - 100.0), angle)).max() < 0.005


@pytest.mark.machines
def test_pulses_end_where_the_lines_do(run_up):
    """Ten seconds of lines, then their noise alone."""
    vibration, angle, _ = run_up
    faded = vibration.copy()
    faded[:, int(10.0 * RATE):] = np.random.default_rng(4).standard_normal((2, int(10.0 * RATE)))
    found = sa.find_pulses(faded, RATE, orders=ORDERS, speed_range=RANGE)
    assert ' s the lines are too weak' in found.reason
    assert found.times[0] < 0.5
    assert 8.5 < found.times[-1] < 10.5
    assert np.abs(error(found, angle)).max() < 0.005


@pytest.mark.machines
def test_few_lost_samples_cost_nothing(run_up):
    vibration, angle, whole = run_up
    broken = vibration.copy()
    broken[:, 30_000:30_020] = np.nan
    found = sa.find_pulses(broken, RATE, orders=ORDERS, speed_range=RANGE)
    assert found.reason == ''
    assert abs(found.times.size - whole.times.size) < 2  # phase 0 is arbitrary
    assert np.abs(error(found, angle)).max() < 0.005


def test_tach_that_was_lost_is_bridged(run_up):
    _, angle, found = run_up
    fine = np.linspace(0.0, 20.0, 200_000)
    marks = np.arange(np.ceil(4.0 * angle(0.2)), np.floor(4.0 * angle(19.8))) / 4.0
    true = np.interp(marks, angle(fine), fine)
    kept = np.delete(true, np.r_[200:240, 700])
    bridged = found.bridged(kept, 4)
    assert bridged.size == true.size
    assert np.abs(bridged - true).max() < 2e-4
    assert np.array_equal(found.bridged(true, 4), true)


def test_what_cannot_be_told_is_refused():
    rng = np.random.default_rng(0)
    noise = rng.standard_normal(int(12.0 * RATE))
    with pytest.raises(sa.SignalError, match=r'stand out|two combs|no line'):
        sa.find_pulses(noise, RATE, orders=ORDERS, speed_range=RANGE)
    time = np.arange(noise.size) / RATE
    two = sum(np.cos(2.0 * np.pi * 19.0 * speed * time) for speed in (15.0, 22.0))
    with pytest.raises(sa.SignalError, match='two combs of the orders 19 fit'):
        sa.find_pulses(two + noise, RATE, orders=[19.0], speed_range=RANGE)
    one, _ = made(3, seconds=12.0)
    with pytest.raises(sa.SignalError, match='only 1 of the orders'):
        sa.find_pulses(one, RATE, orders=ORDERS, speed_range=(32.0, 42.0))
    with pytest.raises(sa.SignalError, match='speed_range'):
        sa.find_pulses(one, RATE, orders=ORDERS, speed_range=(12.0, 17.0))


@pytest.mark.parametrize(('wrong', 'message'), [
    ({'speed_range': (20.0, 10.0)}, 'speed_range is'),
    ({'speed_range': (0.0, 10.0)}, 'both above 0'),
    ({'speed_range': (20.0, 500.0)}, 'the lowest order 19'),
    ({'orders': None}, 'neither orders nor machine'),
    ({'orders': [0.0, 1.0]}, 'all above 0'),
    ({'orders': None, 'machine': 'rig'}, 'machine is of type str'),
    ({'maximum_rate': 0.0}, 'maximum_rate is'),
    ({'sample_rate': 0.0}, 'sample_rate is'),
    ({'vibration': np.zeros((4000, 2))}, 'transpose'),
    ({'vibration': ['a']}, 'has type'),
    ({'vibration': np.zeros(200)}, 'too few revolutions'),
])
def test_wrong_input_is_named_in_one_line(wrong, message):
    given = {'vibration': np.zeros(40_000), 'sample_rate': RATE, 'orders': ORDERS,
             'speed_range': RANGE} | wrong
    with pytest.raises(sa.SaJitterError, match=message) as caught:
        sa.find_pulses(given.pop('vibration'), given.pop('sample_rate'), **given)
    assert '\n' not in str(caught.value)


def test_orders_follow_from_the_machine():
    machine = sa.Machine(tach_shaft='input', gears={'stage': {
        'shaft': 'input', 'teeth': 19, 'mate_shaft': 'output', 'mate_teeth': 61}})
    vibration, angle = made(5, seconds=12.0)
    found = sa.find_pulses(vibration[0], RATE, machine=machine, speed_range=RANGE)
    assert found.orders == (19.0, 38.0, 57.0)
    assert np.abs(error(found, angle)).max() < 0.005


def transition(step, drift, spread):
    """Return transition and covariance over a step of dx = drift x dt + noise, by Van Loan."""
    size = len(drift)
    both = expm(step * np.block([[-drift, spread], [np.zeros((size, size)), drift.T]]))
    move = both[size:, size:].T
    return move, move @ both[:size, size:]


def dense_covariance(steps, walk):
    """Return the covariance (node, state, node, state) of a shaft and two lines before data."""
    drift, spread = np.zeros((2, 9, 9))
    drift[[0, 1], [1, 2]], spread[2, 2] = 1.0, walk.shaft
    for place, size in ((3, walk.own), (5, walk.own), (7, 2.0 * walk.own)):
        drift[place, place + 1], drift[place + 1, place + 1] = 1.0, -1.0 / MEMORY
        spread[place + 1, place + 1] = 2.0 * size**2 / MEMORY
    count = len(steps) + 1
    found = np.zeros((count, 9, count, 9))
    own = walk.own * np.array([np.sqrt(2.0 * MEMORY * len(steps)), 1.0])
    found[0, :, 0] = np.diag(np.concatenate([[10.0, 1e4, 1e3], own, own, 2.0 * own]) ** 2)
    for k, step in enumerate(steps):
        move, new = transition(step, drift, spread)
        for before in range(k + 1):
            found[k + 1, :, before] = move @ found[k, :, before]
            found[before, :, k + 1] = found[k + 1, :, before].T
        found[k + 1, :, k + 1] = move @ found[k, :, k] @ move.T + new
    return found.reshape(9 * count, 9 * count)


def test_states_are_those_of_the_dense_model():
    """Mode and evidence against matrices that hold all states at once."""
    rng = np.random.default_rng(4)
    times = np.cumsum(rng.uniform(0.8, 1.2, 7))
    moments = np.column_stack([0.01 * rng.standard_normal(7), np.full(7, 0.13)])
    seen = Seen(times, moments, np.array([0.5, 1.0]), rng.standard_normal((2, 7)),
                rng.uniform(5.0, 20.0, (2, 7)))
    rows = np.zeros((7, 2, 8, 9))
    for k in range(7):
        rows[k, :, k:k + 2] = seen.rows[k].reshape(2, 2, 9)
    rows = rows.reshape(14, 72)
    values = seen.phase.T.ravel()
    evidence, dense = [], []
    for walk in (Walk(0.3, 0.02), Walk(0.05, 0.2)):
        found = Posterior(seen, walk)
        prior = dense_covariance(np.diff(seen.nodes) / seen.unit, walk)
        marginal = rows @ prior @ rows.T + np.diag(1.0 / seen.precision.T.ravel())
        mode = prior @ rows.T @ np.linalg.solve(marginal, values)
        np.testing.assert_allclose(rows @ found.mode.ravel(), rows @ mode, rtol=1e-4, atol=1e-4)
        evidence.append(found.evidence)
        dense.append(-0.5 * np.linalg.slogdet(marginal)[1]
                     - 0.5 * values @ np.linalg.solve(marginal, values))
    assert evidence[1] - evidence[0] == pytest.approx(dense[1] - dense[0], abs=0.02)


@pytest.mark.machines
def test_run_up_through_resonances():
    """Each line turns by itself where it passes a resonance; the errors stated grow with it."""
    rng = np.random.default_rng(101)
    time = np.arange(int(25.0 * RATE)) / RATE
    turns = np.cumsum(12.0 + 0.5 * time + 0.05 * np.sin(2.0 * np.pi * 0.3 * time)) / RATE
    speed = np.gradient(turns, 1.0 / RATE)
    plain, turned = 0.5 * rng.standard_normal((2, 2, time.size))
    for order in ORDERS:
        line = np.exp(2j * np.pi * order * turns)
        for channel in range(2):
            place, damping = rng.uniform(10.0, 28.0), rng.uniform(0.04, 0.1)
            gain = 1.0 / (1.0 - (speed / place) ** 2 + 1j * damping * speed / place)
            plain[channel] += line.real
            turned[channel] += np.real(gain / np.median(np.abs(gain)) * line)
    stated = []
    for vibration in (plain, turned):
        found = sa.find_pulses(vibration, RATE, orders=ORDERS, speed_range=(9.0, 31.0))
        stated.append(np.median(found.standard_errors * found.speed))
    off = error(found, lambda at: np.interp(at, time, turns))
    assert stated[1] > 10.0 * stated[0]
    assert off.std() < 2.0 * stated[1]
