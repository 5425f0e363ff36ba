# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Has the machine changed: the statistics of the test, and the baseline in its file."""

from copy import deepcopy
from dataclasses import replace
import errno
from functools import cache
import math
import os
from pathlib import Path
from types import SimpleNamespace
import zipfile

from drawn_machine import DrawnMachine as Machine, LEVELS, SECONDS, SETTINGS
import numpy as np
import pytest
import sa_jitter_ros as sa
from sa_jitter_ros.averaging.indicators import GearSettings
from sa_jitter_ros.averaging.results import ShaftResults
from sa_jitter_ros.errors import MessageError, ParameterError, RecordingError
from sa_jitter_ros.monitoring.baseline_file import lock_baseline, read_baseline, write_baseline
from sa_jitter_ros.monitoring.change_test import ChangeTest, memory_of
from sa_jitter_ros.monitoring.evidence import ChangeEvidence, threshold
from sa_jitter_ros.monitoring.machine_monitor import MachineMonitor, Pairing
from sa_jitter_ros.monitoring.monitor import Settings, ShaftMonitor, YEAR
from sa_jitter_ros.monitoring.quantities import KINDS, Layout, monitored
from sa_jitter_ros.monitoring.speed_bin import SpeedBin
from sa_jitter_ros.simulation import AdditiveNoise, DeclaredJitter, Gearbox, mesh

# --- false alarms --------------------------------------------------------------------------------


def alarms_of(draw, *, units, quantities, learning, scores, length):
    """Return the number of alarms of units and how many are expected, for values from a law."""
    test, unknown = ChangeTest((units, quantities), learning=learning), np.full(
        (units, quantities), np.nan)
    found = 0
    for number in range(length):
        changed, _ = test.update(0, draw(), unknown, unknown, (number, number), scores)
        again = changed.any(axis=1)
        found += int(again.sum())
        test.active[again] = False
        test.evidence.ratios[:, again] = test.evidence.sums[:, again] = 0.0
    return found, units * (length - learning) / scores


@pytest.mark.machines
def test_evidence_reaches_its_threshold_once_in_the_stated_number_of_scores():
    rng = np.random.default_rng(1)
    units, quantities, scores = 400, 4, 400.0
    evidence, times, started = ChangeEvidence((units, quantities)), [], np.zeros(units)
    mix = np.array([0.0, 0.5, 0.9, 0.99])  # quantities that scatter together with the first
    for now in range(1, 3001):
        own = rng.standard_normal((units, quantities))
        evidence.update(mix * own[:, :1] + np.sqrt(1.0 - mix**2) * own)
        again = evidence.changed(threshold(scores)).any(axis=1)
        times += (now - started[again]).tolist()
        started[again] = now
        evidence.ratios[:, again] = evidence.sums[:, again] = 0.0
    # alarms are a renewal process, which begins anew at each: its mean number in a finite time
    variation = np.std(times) / np.mean(times)
    expected = units * (now / scores - 0.5 * (1.0 - variation**2))
    error = variation * np.sqrt(units * now / scores)
    assert len(times) == pytest.approx(expected, abs=4.0 * error)


def smooth(rng, shape, kept=0.5, noise=0.0):
    """Return a function that draws from a series that keeps a part, and noise beside it."""
    last = rng.standard_normal(shape)

    def draw():
        nonlocal last
        last = kept * last + np.sqrt(1.0 - kept**2) * rng.standard_normal(shape)
        return 5.0 + last + noise * rng.standard_normal(shape)
    return draw


LAWS = {
    'normal': lambda rng, shape: lambda: 5.0 + rng.standard_normal(shape),
    'together': lambda rng, shape: lambda: 5.0 + 0.9 * rng.standard_normal(
        (shape[0], 1)) + 0.44 * rng.standard_normal(shape),
    'absent order': lambda rng, shape: lambda: rng.rayleigh(size=(5, *shape)).mean(axis=0),
    'unsteady': smooth,
}


@pytest.mark.machines
@pytest.mark.parametrize('law', LAWS)
def test_false_alarms_keep_to_their_rate_with_a_learnt_baseline(law):
    shape, length = (40, 8), 2000 if law == 'unsteady' else 1000  # it takes longer to learn
    found, expected = alarms_of(
        LAWS[law](np.random.default_rng(7), shape), units=shape[0], quantities=shape[1],
        learning=40, scores=0.5 * length, length=length)
    assert found <= expected + 3.0 * np.sqrt(expected)
    # each machine loses the time that its first alarm takes to build up: a third of its alarms
    assert found >= 0.5 * expected - 3.0 * np.sqrt(expected)


@pytest.mark.machines
def test_slow_unsteadiness_below_the_noise_is_learnt():
    """What a prediction from the last score misses costs alarms until 32 groups have shown it."""
    shape, scores = (50, 8), 2000.0
    draw = smooth(np.random.default_rng(8), shape, 0.95, 2.0)
    test, unknown, alarms = ChangeTest(shape, learning=40), np.full(shape, np.nan), []
    for number in range(2000):
        changed, _ = test.update(0, draw(), unknown, unknown, (number, number), scores)
        again = changed.any(axis=1)
        alarms.append(int(again.sum()))
        test.active[again] = False
        test.evidence.ratios[:, again] = test.evidence.sums[:, again] = 0.0
    late = sum(alarms[1200:])
    expected = shape[0] * 800 / scores
    # scatter over 256 groups is known to a quarter: twice the rate
    assert late <= 2.0 * expected + 3.0 * np.sqrt(2.0 * expected)


def test_values_that_alternate_have_no_memory_and_those_of_a_walk_the_largest(rng):
    assert memory_of(np.tile([[1.0], [-1.0]], (50, 1))) == 0.0
    assert memory_of(rng.standard_normal((200, 30)).cumsum(axis=0)) == 0.95
    noise = rng.standard_normal((20, 400))
    noise[8:, ::2] = np.nan
    assert memory_of(noise) == pytest.approx(0.0, abs=0.1)


def give(test, values, doubt=np.nan):
    """Give values (number, unit, quantity) to a test, each of this doubt."""
    unknown = np.full(test.shape, np.nan)
    for number, value in enumerate(values):
        test.update(0, value, unknown, np.full(test.shape, doubt), (number, number), 1e4)


def test_what_came_before_a_change_is_no_part_of_what_comes_behind_it(rng):
    """Its first values neither correlate nor scatter with those that follow."""
    test = ChangeTest((1, 2), learning=20)
    give(test, rng.standard_normal((100, 1, 2)))
    for _ in range(10):
        if not test.active.any():
            give(test, np.array([[[6.0, 0.1]]]))
    assert test.active.tolist() == [[True, False]]
    state = test.state()
    for parts in (state['gone'], state['delayed'][:, 0], state['filled'],
                  state['blocks'][:, 0]):
        assert not parts[..., 0, 0].any()
    assert state['filled'][..., 0, 1].all()
    assert state['delayed'][:, 0, 0, 1].all()


def test_doubt_that_grows_is_no_correlation(rng):
    draw = smooth(rng, (1, 3), 0.6)
    values = np.array([draw() for _ in range(250)])
    found = []
    for doubt in (0.01, 2.0):
        test = ChangeTest((1, 3), learning=20)
        give(test, values[:100], 0.01)
        give(test, values[100:], doubt)
        found.append(test.correlation())
    np.testing.assert_allclose(*found, atol=0.05)


def test_noise_that_doubles_widens_the_scatter_within_some_tens_of_values():
    place, ones, none = SpeedBin((1, 1)), np.ones((1, 1)), np.zeros((1, 1), np.bool_)
    found = []
    for number in range(150):
        value = ones * (-1.0) ** number
        noise = 0.5 * ones if number < 100 else ones
        scores, weights = place.score(value, noise, ones, ones)
        place.learn(value, noise, ones, weights, none | (number >= 100))
        found.append(abs(float(scores[0, 0, 0])))
    # the variance of 1 has 0.5 more
    assert np.mean(found[90:100]) > 0.95
    assert np.mean(found[140:]) == pytest.approx(np.sqrt(1.0 / 1.5), abs=0.03)
    # much more noise does so at once
    scores, _ = place.score(ones, 5.0 * ones, ones, ones)
    assert scores[0, 0, 0] == pytest.approx(np.sqrt(1.0 / 5.5), abs=0.03)


def scored(values):
    """Return the score of the last value (count, unit) of each unit, that learns those before."""
    place, none = SpeedBin((values.shape[1], 1)), np.zeros((values.shape[1], 1))
    for value in values[:, :, None]:
        scores, weights = place.score(value, none, none, none + 1.0)
        place.learn(value, none, none, weights, none > 0.0)
    return scores[0]


@pytest.mark.parametrize('level', [1.0, 2.5])
def test_scores_of_a_short_baseline_are_normal(rng, level):
    found = np.mean(abs(scored(rng.standard_normal((9, 40_000)))) > level)
    wanted = math.erfc(level / np.sqrt(2.0))
    assert found == pytest.approx(wanted, abs=4.0 * np.sqrt(wanted / 40_000))


@pytest.mark.parametrize('value', [0.0, 1e-300, 3.0])
def test_a_constant_has_no_skewness_whatever_it_is(value):
    place, none = SpeedBin((1, 1)), np.zeros((1, 1))
    values = np.full((1, 1), value)
    for _ in range(3):
        scores, weights = place.score(values, none, none, np.ones((1, 1)))
        place.learn(values, none, none, weights, none > 0.0)
    np.testing.assert_array_equal(place.baseline().skewness, none)
    np.testing.assert_array_equal(scores, np.zeros((3, 1, 1)))


def test_skewness_that_the_baseline_shows_is_no_change(rng):
    """Of a gamma distribution, 1 % of which lie 3 standard deviations above the mean."""
    assert np.mean(scored(rng.gamma(4.0, size=(300, 3000))) > 3.0) < 0.006


def test_what_is_unsure_of_the_amplitudes_is_so_of_moments_by_their_power():
    average = Machine(21, bias=0.02).average()
    assert average.layout.indicators == ('rms', 'kurtosis', 'm8a')
    unsure = average.doubt[:, len(average.layout.orders):][:, :3]
    np.testing.assert_allclose(unsure, 0.02 * np.array([[1.0, 4.0, 8.0]] * 2), rtol=0.05)


@pytest.mark.parametrize('amplitude', [0.0, 0.3, 5.0])
def test_squares_of_amplitudes_scatter_as_those_of_drawn_ones(rng, amplitude):
    noise, doubt = 0.2, 0.01
    drawn = abs(amplitude + noise * (rng.standard_normal((100_000, 2)) @ (1.0, 1.0j))) ** 2
    monitor = SimpleNamespace(layout=SimpleNamespace(orders=(19.0,)))
    (variance,), (known,) = (item[0] for item in ShaftMonitor._of_squares(monitor, *(
        np.array([[value]]) for value in (amplitude**2, noise**2, doubt))))
    assert variance == pytest.approx(drawn.var(), rel=0.03)
    assert known == pytest.approx(2.0 * np.hypot(amplitude, noise) * doubt)


def test_threshold_follows_from_the_rate_of_averages_and_of_false_alarms():
    machine = Machine(1)
    monitor = machine.monitor(false_alarms_per_year=2.0)
    machine.run(monitor, 20)
    assert monitor.scores_per_alarm() == pytest.approx(YEAR / (5.0 * SECONDS) / 2.0)


# --- changes -------------------------------------------------------------------------------------

@cache
def watched_once(seed):
    """Return a machine and its monitor after 400 averages, which are not to change."""
    machine = Machine(seed)
    monitor = machine.monitor()
    assert machine.run(monitor, 400) == []
    return machine, monitor


def watched(seed):
    """Return a machine and its monitor after 400 averages."""
    return deepcopy(watched_once(seed))


def test_change_is_found_where_it_is_with_its_size_and_its_beginning():
    machine = Machine(2)
    monitor = machine.monitor()
    assert machine.run(monitor, 600) == []
    assert (monitor.is_complete, monitor.averages) == (True, 600)
    machine.gain[1, 2] = 1.05
    line, *others = machine.run(monitor, 200)
    assert line.startswith('order 38 of input, channel 1: +')
    assert others == []
    found, = monitor.changes()
    assert (found.shaft, found.channel, found.kind, found.name) == ('input', 1, 'order', '38')
    assert found.change == pytest.approx(0.05, abs=4.0 * found.standard_error)
    error = 0.01 / 0.5 * np.sqrt(1.0 / 200.0 + 1.0 / 600.0)
    # a group from before the change, or half of it, may count among those since then
    assert 0.8 * error < found.standard_error < 1.6 * error
    assert abs(found.since_sequence - 601) <= 10
    assert found.since_time == found.since_sequence * SECONDS
    assert found.keyphasor_share < 0.002
    assert found.p_value < 1e-6


def test_indicators_change_too_and_fall():
    machine, monitor = watched(20)
    machine.damage[0, 1] = 0.94
    line, = machine.run(monitor, 100)
    assert line.startswith('kurtosis of input, channel 0: -')
    found, = monitor.changes()
    assert (found.kind, found.name) == ('indicator', 'kurtosis')
    assert found.change == pytest.approx(-0.06, abs=4.0 * found.standard_error)


@pytest.mark.machines
def test_standard_errors_of_changes_hold():
    """Without selection: the estimate of what came since a change that is far above threshold."""
    z = []
    for seed in range(10):
        machine = Machine(100 + seed)
        monitor = machine.monitor(learning_averages=100)
        machine.run(monitor, 100)
        machine.gain[:] = 1.2
        machine.run(monitor, 100)
        found = {(item.channel, item.name): item for item in monitor.changes()}
        z += [(item.change - 0.2) / item.standard_error for item in (
            found[channel, name] for channel in (0, 1) for name in ('19', '38'))]
    # the load, which they have in common, is below 4 % of their variance
    assert abs(np.mean(z)) < 4.0 / np.sqrt(len(z))
    assert np.std(z) == pytest.approx(1.0, abs=4.0 / np.sqrt(2.0 * len(z)))


def test_what_came_since_a_change_is_no_part_of_the_baseline():
    machine = Machine(4)
    monitor = machine.monitor()
    machine.run(monitor, 300)
    before = monitor.baseline(16.6).mean[0, 1] ** 0.5
    machine.gain[0, 1] = 1.1
    assert machine.run(monitor, 300)
    after = monitor.baseline(16.6).mean[0, 1] ** 0.5
    assert after == pytest.approx(before, abs=4.0 * 0.01 / np.sqrt(300.0))


def test_change_that_ends_is_taken_back():
    machine, monitor = watched(20)
    machine.gain[0, 1] = 1.05
    assert len(machine.run(monitor, 100)) == 1
    machine.gain[0, 1] = 1.0
    assert machine.run(monitor, 150) == ['order 19 of input, channel 0 is back at its baseline']
    assert monitor.changes() == []
    assert machine.run(monitor, 300) == []


def test_one_wild_average_is_no_change_and_spoils_no_baseline():
    machine, monitor = watched(20)
    variance = monitor.baseline(16.6).variance
    machine.gain[:] = machine.damage[:] = 30.0
    assert machine.run(monitor, 1) == []
    machine.gain[:] = machine.damage[:] = 1.0
    assert machine.run(monitor, 400) == []
    np.testing.assert_allclose(np.sqrt(monitor.baseline(16.6).variance / variance), 1.0, atol=0.5)


def test_order_that_was_not_there_appears():
    machine = Machine(7)
    machine.gain[0, 0] = 0.0
    monitor = machine.monitor()
    machine.run(monitor, 400)
    machine.gain[0, 0] = 0.15  # three times the noise
    line, = machine.run(monitor, 50)
    assert line.startswith('order 1 of input, channel 0: +')


@pytest.mark.machines
def test_absent_order_has_a_baseline_without_bias():
    """An average that is large by chance publishes no larger error, and counts as any other."""
    machine = Machine(16)
    machine.gain[0, 0] = 0.0
    monitor = machine.monitor()
    machine.run(monitor, 2000)
    found = monitor.baseline(16.6)
    assert found.count[0, 0] == 2000.0 / 5.0
    error = np.sqrt(found.variance[0, 0] / (2000.0 / 5.0))
    assert abs(found.mean[0, 0]) < 4.0 * error
    assert error == pytest.approx(2.0 * 0.01**2 / np.sqrt(2000.0), rel=0.2)


# --- what is no change ---------------------------------------------------------------------------


@pytest.mark.machines
@pytest.mark.parametrize('worse', [{'keyphasor': 2.0}, {'keyphasor': 4.0, 'bias': 0.05}])
def test_worse_keyphasor_is_no_change_of_the_machine(worse):
    alarms = []
    for seed in range(3):
        machine, monitor = watched(20 + seed)
        for name, value in worse.items():
            setattr(machine, name, value)
        alarms += machine.run(monitor, 400)
    assert alarms == []
    machine.gain[0, 1] = 1.3  # and a real change is still found
    assert any('order 19 of input, channel 0' in line for line in machine.run(monitor, 200))
    found = {item.name: item for item in monitor.changes()}['19']
    assert found.keyphasor_share == pytest.approx(1.3 * machine.bias, rel=0.3, abs=1e-3)


def test_better_keyphasor_is_no_change_either():
    machine = Machine(30, keyphasor=3.0, bias=0.03)
    monitor = machine.monitor()
    machine.run(monitor, 400)
    machine.keyphasor = 0.0
    assert machine.run(monitor, 400) == []


def test_speeds_have_baselines_of_their_own():
    machine = Machine(8)
    monitor = machine.monitor()
    for speed in (16.6, 12.0, 16.6, 12.0):
        machine.speed = speed
        assert machine.run(monitor, 150) == []
    assert monitor.is_complete
    slow, fast = monitor.baseline(12.0), monitor.baseline(16.6)
    np.testing.assert_allclose(slow.mean[:, :3] / fast.mean[:, :3], (12.0 / 16.6) ** 4, rtol=0.04)
    machine.speed = 14.0
    machine.run(monitor, 20)
    assert not monitor.is_complete
    machine.speed, machine.gain[1, 1] = 12.0, 1.05
    for speed in (12.0, 16.6, 12.0):
        machine.speed = speed
        machine.run(monitor, 30)
    found, = monitor.changes()
    assert (found.channel, found.name) == (1, '19')
    assert found.change == pytest.approx(0.05, abs=4.0 * found.standard_error)


@pytest.mark.machines
def test_covariance_is_that_of_the_machine():
    machine = Machine(9, load=0.02)
    monitor = machine.monitor()
    machine.run(monitor, 1200)
    scatter = np.sqrt(monitor.baseline(16.6).variance[0])
    found = monitor.correlation()[0] * np.outer(scatter, scatter)
    square = LEVELS**2  # what is monitored
    expected = 4.0 / 5.0 * (0.02**2 * np.outer(square, square) + np.diag(square) * 0.01**2)
    scatter = np.sqrt(np.diag(expected))
    # 240 groups: a correlation is known to 0.065
    np.testing.assert_allclose(found[:3, :3] / np.outer(scatter, scatter),
                               expected / np.outer(scatter, scatter), atol=0.25)
    assert np.abs(found[3:, :3] / np.outer(np.sqrt(np.diag(found[3:, 3:])), scatter)).max() < 0.2


def test_missing_numbers_cost_themselves_alone():
    machine = Machine(10)
    monitor = machine.monitor()
    for number in range(700):
        orders, indicators, errors, _ = machine.messages()
        orders.values[0, 2, 3:] = np.nan  # an order that never has an amplitude
        if number % 3 == 0:
            orders.values[1, 1, 3:] = np.nan
        indicators.values[1, 2] = np.nan
        if number == 500:
            machine.gain[0, 1] = 1.1
        absent = number % 7 == 0
        arrays = dict(zip(KINDS, (orders, indicators, errors)[:2 if absent else 3]))
        lines = monitor.update(monitored(arrays))
        assert all('order 19 of input, channel 0' in line for line in lines)
    found, = monitor.changes()
    assert found.change == pytest.approx(0.1, abs=4.0 * found.standard_error)
    assert monitor.baseline(16.6).count[0, 2] == 0.0


def test_averages_that_are_not_corrected_or_overlap_are_left_out():
    machine = Machine(11)
    monitor = machine.monitor()
    machine.run(monitor, 10)
    machine.corrected = False
    machine.run(monitor, 10)
    assert (monitor.averages, monitor.uncorrected) == (20, 10)
    # the envelope of the residual signal needs no correction
    assert monitor.baseline(16.6).count[0].tolist() == [2.0] * 6 + [4.0]
    machine.corrected = True
    average = machine.average()
    for later in range(31):  # sliding averages of 30 cycles
        header = replace(average.header, sequence=average.header.sequence + later,
                         start_time=average.header.start_time + later / 15.0,
                         end_time=average.header.end_time + later / 15.0)
        monitor.update(replace(average, header=header))
    assert (monitor.averages, monitor.overlapping) == (22, 29)


def test_recordings_whose_times_begin_anew_do_not_overlap():
    """One average of each of them: start and length differ a little from day to day."""
    machine, rng = Machine(16), np.random.default_rng(16)
    monitor = machine.monitor()
    for sequence in range(40):
        start, seconds = rng.uniform(0.0, 0.06), rng.uniform(1.8, 2.2)
        average = machine.average()
        monitor.update(replace(average, header=replace(
            average.header, sequence=sequence, start_time=start, end_time=start + seconds)))
    assert (monitor.averages, monitor.overlapping) == (40, 0)


def test_raw_amplitudes_are_monitored_on_request():
    machine = Machine(14)
    machine.corrected = False
    settings = replace(SETTINGS, allow_uncorrected=True)
    monitor, lines = MachineMonitor('pump 3', ['input'], settings), []
    for number in range(600):
        if number == 400:
            machine.gain[1, 1] = 1.1
        arrays = machine.messages()
        arrays[0].values[..., 7] = arrays[0].values[..., 8] = 0.01
        for kind, array in zip(KINDS, arrays):
            lines += monitor.take('input', kind, array)
    line, = lines
    assert line.startswith('order 19 of input, channel 1: +')
    monitor.use(SETTINGS)
    for kind, array in zip(KINDS, machine.messages()):
        monitor.take('input', kind, array)
    assert monitor.monitors['input'].uncorrected == 1


def test_what_a_keyphasor_takes_from_raw_amplitudes_is_no_change_and_damage_is():
    machine = Machine(15)
    monitor, lines = MachineMonitor('pump 3', ['input'], replace(
        SETTINGS, allow_uncorrected=True)), []
    for number in range(600):
        machine.bias = 0.0 if number < 300 else 0.3
        machine.corrected = number < 300 or number % 4 == 0
        machine.gain[1, 1] = 1.0 if number < 450 else 2.0
        arrays = machine.messages()
        table = arrays[0].values
        table[..., 1] /= 1.0 - machine.bias
        table[..., 7] = table[..., 8] = 0.01
        if machine.corrected:
            table[..., 3], table[..., 10] = table[..., 1] / table[..., 5], 0.01
        for kind, array in zip(KINDS, arrays):
            lines += [f'{number}: {line}' for line in monitor.take('input', kind, array)]
    assert lines
    assert all(int(line.partition(':')[0]) > 450 and 'order 19 of input, channel 1' in line
               for line in lines), lines


def test_a_bearing_order_changes_alone_whatever_load_and_correction():
    machine = Machine(17)
    monitor = machine.monitor()
    machine.corrected = False
    assert machine.run(monitor, 400) == []
    machine.strikes[1] = 1.2
    line, = machine.run(monitor, 100)
    assert line.startswith('bearing order 4.9 of input, channel 1: +')
    found, = monitor.changes()
    assert (found.kind, found.name, found.keyphasor_share) == ('bearing', '4.9', 0.0)
    assert found.change == pytest.approx(0.2, abs=4.0 * found.standard_error)


def test_shaft_without_bearing_orders_waits_for_none_once_it_is_known():
    monitor = MachineMonitor('pump 3', ['input'], SETTINGS)
    taken = []
    machine = Machine(18)
    for _ in range(6):
        for kind, array in zip(KINDS[:3], machine.messages()):
            monitor.take('input', kind, array)
        taken.append(monitor.averages)
    assert taken == [0, 0, 0, 0, 5, 6]
    later = MachineMonitor('pump 3', ['input'], SETTINGS)
    for kind, array in zip(KINDS[:3], machine.messages()):
        later.take('input', kind, array)
    later.finish()
    assert later.averages == 1


@pytest.mark.parametrize(('indicators', 'bearings', 'awaited'), [
    ((), (), KINDS[:1]), (('rms',), (), KINDS[:3]), ((), (4.9,), (KINDS[0], KINDS[3])),
    (('rms',), (4.9,), KINDS)])
def test_an_average_is_complete_with_the_arrays_that_its_layout_has(indicators, bearings, awaited):
    pairing = Pairing(Layout(2, (19.0, 38.0), indicators, bearings))
    arrays = dict(zip(KINDS, Machine(20).messages()))
    found = [len(pairing.add(kind, arrays[kind])) for kind in awaited]
    assert found == [0] * (len(awaited) - 1) + [1]


def test_bearing_orders_that_the_baseline_lacks_are_refused():
    machine = Machine(19)
    orders, indicators, errors, envelope = machine.messages()
    monitor = MachineMonitor('pump 3', ['input'], SETTINGS)
    monitor.take_average('input', monitored(dict(zip(KINDS, (orders, indicators, errors)))))
    with pytest.raises(ParameterError, match=r'3 indicators, bearing orders 4\.9, its baseline'):
        monitor.take_average('input', machine.average())
    with pytest.raises(MessageError, match='1 channels of the envelope and 2 of orders'):
        monitored(dict(zip(KINDS, (
            orders, indicators, errors, replace(envelope, values=envelope.values[:1])))))


def test_average_without_indicators_keeps_none_waiting():
    machine, monitor = Machine(15), MachineMonitor('pump 3', ['input'], SETTINGS)
    for number in range(20):
        for kind, array in zip(KINDS, machine.messages()):
            if kind == 'order_amplitude' or number % 3 != 1:
                monitor.take('input', kind, array)
    assert monitor.averages == 19  # the last one, without indicators, waits for them


def test_arrays_that_do_not_fit_are_refused():
    orders, indicators, errors, _ = Machine(12).messages()
    with pytest.raises(MessageError, match='1 channels of indicators and 2 of orders'):
        monitored(dict(zip(KINDS, (
            orders, replace(indicators, values=indicators.values[:1]), errors))))
    with pytest.raises(ParameterError, match='learn at least 8 groups, 40 averages'):
        Settings(learning_averages=39)
    with pytest.raises(ParameterError, match='learning is 3 values: give at least 8'):
        ChangeTest((1, 1), learning=3)


# --- the file ------------------------------------------------------------------------------------


@pytest.fixture
def kept(tmp_path):
    """Return machine, monitor and the file of its baseline, with a change that is active."""
    machine = Machine(13)
    monitor = machine.monitor()
    machine.run(monitor, 300)
    machine.gain[0, 1] = 1.1
    machine.run(monitor, 50)
    path = tmp_path / 'state' / 'baseline.npz'
    write_baseline(path, 'pump 3', {'input': monitor}, SETTINGS)
    return machine, monitor, path


def test_baseline_survives_a_restart(kept):
    machine, monitor, path = kept
    again = read_baseline(path, 'pump 3', SETTINGS, 1.0)['input']
    assert again.changes() == monitor.changes() != []
    assert (again.averages, again.is_complete) == (monitor.averages, True)
    for _ in range(300):
        average = machine.average()
        assert again.update(average) == monitor.update(average)
    assert again.changes() == monitor.changes()
    assert list(path.parent.iterdir()) == [path]


def damage(path, kind):
    """Damage a file in one of several ways."""
    content = bytearray(path.read_bytes())
    if kind == 'cut':
        content = content[:len(content) // 2]
    elif kind == 'empty':
        content = bytearray()
    elif kind == 'text':
        content = bytearray(b'no baseline')
    elif kind == 'bits':
        with zipfile.ZipFile(path) as archive:
            largest = max(archive.infolist(), key=lambda item: item.compress_size)
        content[largest.header_offset + largest.compress_size // 2] ^= 0x10
    path.write_bytes(content)


@pytest.mark.machines
@pytest.mark.parametrize('kind', ['cut', 'empty', 'text', 'bits'])
def test_damaged_file_is_refused_in_one_line_and_kept(kept, kind):
    path = kept[2]
    damage(path, kind)
    before = path.read_bytes()
    with pytest.raises(RecordingError) as refused:
        read_baseline(path, 'pump 3', SETTINGS, 1.0)
    assert str(refused.value).startswith(f'{path}: is no intact baseline')
    assert 'move it away to learn again' in str(refused.value)
    assert '\n' not in str(refused.value)
    assert path.read_bytes() == before


def test_file_that_unpacks_to_gigabytes_is_not_read(kept):
    path = kept[2]
    content = bytearray(path.read_bytes())
    place = content.index(b'PK\x01\x02') + 24  # where the list of contents has the first size
    content[place:place + 4] = (1 << 30).to_bytes(4, 'little')
    path.write_bytes(content)
    with pytest.raises(RecordingError, match='bytes, at most'):
        read_baseline(path, 'pump 3', SETTINGS, 1.0)


def test_baseline_of_many_channels_is_read_again(tmp_path):
    path, monitor = tmp_path / 'baseline.npz', ShaftMonitor('input', Layout(2, (1.0,) * 300),
                                                            SETTINGS)
    monitor._products[:] = np.random.default_rng(1).random(monitor._products.shape)
    write_baseline(path, '', {'input': monitor}, SETTINGS)
    assert path.stat().st_size > 1 << 20
    assert read_baseline(path, '', SETTINGS, 1.0).keys() == {'input'}


def test_every_cut_and_flipped_byte_is_noticed(kept):
    path, rng = kept[2], np.random.default_rng(5)
    whole = path.read_bytes()
    intact, lines = read_baseline(path, 'pump 3', SETTINGS, 1.0)['input'].changes(), []
    for place in rng.integers(0, len(whole), 60).tolist():
        flipped = bytearray(whole)
        flipped[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(flipped)
        try:  # a byte of a date or a comment in the archive says nothing of the arrays
            assert read_baseline(path, 'pump 3', SETTINGS, 1.0)['input'].changes() == intact
        except RecordingError as error:
            lines.append(str(error))
    assert lines
    assert all('\n' not in line for line in lines)


def test_file_that_is_no_file_or_another_archive_is_refused(tmp_path):
    path = tmp_path / 'fifo.npz'
    os.mkfifo(path)
    for place in (path, tmp_path, Path('/dev/full')):
        with pytest.raises(RecordingError, match='is no regular file: give another baseline_file'):
            lock_baseline(place)
    other = tmp_path / 'other.npz'
    np.savez(other, vibration=np.zeros(3))
    with pytest.raises(RecordingError, match='is no intact baseline'):
        read_baseline(other, '', SETTINGS, 1.0)
    assert read_baseline(tmp_path / 'none.npz', '', SETTINGS, 1.0) == {}


def test_baseline_of_another_machine_is_refused(kept):
    machine, monitor, path = kept
    with pytest.raises(RecordingError, match="machine 'pump 3', this one is 'pump 4'"):
        read_baseline(path, 'pump 4', SETTINGS, 1.0)
    with pytest.raises(RecordingError, match='was learnt with group_averages 5, now it is 4'):
        read_baseline(path, 'pump 3', replace(SETTINGS, group_averages=4), 1.0)
    orders, indicators, errors, _ = machine.messages()
    orders.values[..., 0] += 1.0
    with pytest.raises(ParameterError, match=r'orders 2, 20, 39 .* another machine'):
        monitor.update(monitored(dict(zip(KINDS, (orders, indicators, errors)))))
    other = replace(SETTINGS, false_alarms_per_year=5.0)
    assert len(read_baseline(path, 'pump 3', other, 1.0)) == 1


def test_full_disk_and_unwritable_folder_keep_the_older_file(kept, monkeypatch):
    machine, monitor, path = kept
    before = path.read_bytes()
    machine.run(monitor, 50)

    def full(number):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    with monkeypatch.context() as patch:
        patch.setattr(os, 'fsync', full)
        with pytest.raises(RecordingError, match='cannot be written: No space left on device'):
            write_baseline(path, 'pump 3', {'input': monitor}, SETTINGS)
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path]
    with pytest.raises(RecordingError, match='cannot be written: File exists'):
        write_baseline(path / 'below.npz', 'pump 3', {'input': monitor}, SETTINGS)
    write_baseline(path, 'pump 3', {'input': monitor}, SETTINGS)
    assert path.read_bytes() != before


# --- with true averages --------------------------------------------------------------------------


def averages_of(rate, *, seed, seconds=27.0, damaged=False):
    """Return the arrays of averages of a simulated gear whose keyphasor is sampled at a rate."""
    harmonics = [1.0, 0.55 if damaged else 0.5, 0.25]
    gear = Gearbox(
        mesh('input', 19, harmonics=harmonics), 6e3, shafts={'input': 2.40789},
        speed=[(0.0, 16.6)], seed=seed, effects=[
            DeclaredJitter('uniform', 1.0 / rate / np.sqrt(12.0)), AdditiveNoise(0.2)])
    results = ShaftResults(GearSettings([19]))
    for average in sa.average(
            gear.vibration(0, int(6e3 * seconds)), 6e3, gear.pulses(0.0, seconds).times,
            ratio=2.40789, trigger_cycles=12, orders=[11.0, 19.0, 38.0, 57.0],
            correct_jitter=True, keyphasor_rate=rate):
        yield results.of(average)


@pytest.mark.machines
def test_exchanged_keyphasor_of_a_simulated_gear_is_no_change_and_damage_is():
    monitor = MachineMonitor('gear', ['input'], Settings(learning_averages=32, group_averages=4))

    def watch(**options):
        return [line for arrays in averages_of(**options) for kind in KINDS if kind in arrays
                for line in monitor.take('input', kind, arrays[kind])]
    assert watch(rate=20e3, seed=1) == []
    assert monitor.is_complete
    # order 57 keeps a fifth of its amplitude in the raw average
    assert watch(rate=2e3, seed=3, seconds=18.0) == []
    lines = watch(rate=2e3, seed=5, damaged=True)
    assert any(line.startswith('order 38 of input, channel 0: +') for line in lines)
    found = {item.name: item for item in monitor.changes()}
    assert found['38'].change == pytest.approx(0.1, abs=4.0 * found['38'].standard_error)
    assert found['38'].keyphasor_share < 0.01
    assert not {'11', '19', '57'} & found.keys()
