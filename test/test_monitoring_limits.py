# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Limits: what passes them and what does not, how scatter crosses them, and wrong ones."""

from dataclasses import replace
import math

from drawn_machine import DrawnMachine, SETTINGS
import numpy as np
import pytest
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.machine import Machine
from sa_jitter_ros.monitoring.limits import LimitWatch
from sa_jitter_ros.monitoring.machine_monitor import MachineMonitor
from sa_jitter_ros.monitoring.quantities import mean_of

GEARS = {'stage': {'shaft': 'input', 'teeth': 19, 'mate_shaft': 'output', 'mate_teeth': 61}}
BEARINGS = {'b1': {'shaft': 'input', 'cage': 0.4, 'ball': 2.3, 'outer': 4.9, 'inner': 7.1}}
NOISE = 0.01  # of an amplitude of 1, without a scatter of the load


def machine_of(**limit):
    """Return a machine with one limit."""
    return Machine('output', GEARS, {}, BEARINGS, {'one': {'channel': 0, **limit}})


def watch_of(**limit):
    """Return what watches one limit of order 19 of channel 0."""
    return LimitWatch(machine_of(**{'order': 19.0, 'shaft': 'input', **limit}), ['input'])


def crossings(gain, *, averages=2000, **limit):
    """Return the share of averages at which a value begins, and ends, to be above a limit of 1."""
    watch, machine = watch_of(alarm=1.0, **limit), DrawnMachine(5, noise=NOISE, load=0.0)
    machine.gain[0, 1] = gain
    above = np.zeros(averages, bool)
    for number in range(averages):
        watch.update('input', machine.average())
        above[number] = bool(watch.passed())
    change = np.diff(above.astype(int))
    return np.sum(change > 0) / max(np.sum(~above[:-1]), 1), np.sum(change < 0) / max(
        np.sum(above[:-1]), 1)


@pytest.mark.machines
def test_scatter_at_a_limit_crosses_it_once_in_forty_averages():
    for share in crossings(1.0):
        assert share == pytest.approx(0.025, abs=4.0 * math.sqrt(0.025 * 0.975 / 900))


@pytest.mark.machines
def test_scatter_below_a_limit_is_no_alarm():
    below = 1.0 - 2.0 * NOISE  # 4 standard errors from an alarm: 0.00004 of the averages
    assert crossings(below)[0] <= 0.001


def test_a_value_above_a_limit_is_found_at_once_and_stays():
    begin, end = crossings(1.0 + 5.0 * NOISE, averages=500)
    assert (begin, end) == (0.0, 0.0)  # it has begun with the first
    watch, machine = watch_of(warn=1.2, alarm=1.5), DrawnMachine(6, noise=NOISE)
    levels = []
    for gain in (1.0, 1.3, 1.6, 1.5, 1.3, 1.2, 1.0):
        machine.gain[0, 1] = gain
        watch.update('input', machine.average())
        levels += [item.level for item in watch.passed()] or ['']
    assert levels == ['', 'warn', 'alarm', 'alarm', 'warn', 'warn', '']


def test_lines_say_when_a_limit_is_passed_and_when_no_longer():
    watch, machine = watch_of(warn=1.2, alarm=1.5), DrawnMachine(6)
    assert watch.update('input', machine.average()) == []
    machine.gain[0, 1] = 1.3
    line, = watch.update('input', machine.average())
    assert line.startswith('mesh input-output 1x of input, channel 0: 1.')
    assert line.endswith(' above 1.2 (warn), since average 1')
    assert watch.update('input', machine.average()) == []
    machine.gain[0, 1] = 1.0
    assert watch.update('input', machine.average()) == [
        'mesh input-output 1x of input, channel 0 is below its limits again']


@pytest.mark.parametrize(('of', 'place'), [
    ({'part': 'mesh input-output 2x'}, 2), ({'indicator': 'kurtosis', 'shaft': 'input'}, 4),
    ({'part': 'bearing b1 outer'}, 6), ({'order': 4.9, 'shaft': 'input'}, 6)])
def test_orders_parts_bearings_and_indicators_have_limits(of, place):
    machine = DrawnMachine(7)
    usual = machine.average().readings[0, 0, place]
    watch = LimitWatch(machine_of(alarm=1.5 * usual, **of), ['input'])
    assert watch.update('input', machine.average()) == []
    machine.gain[:], machine.damage[:], machine.strikes[:] = 2.0, 2.0, 2.0
    assert len(watch.update('input', machine.average())) == 1


def test_relative_limits_are_times_the_baseline_and_wait_for_it():
    limit = {'order': 19.0, 'shaft': 'input', 'relative': True, 'warn': 1.1, 'alarm': 1.3}
    watch, machine = LimitWatch(machine_of(**limit), ['input']), DrawnMachine(8)
    monitor = MachineMonitor('m', ['input'], replace(SETTINGS, learning_averages=40),
                             limits=watch)
    machine.gain[0, 1] = 2.0
    lines = [monitor.take_average('input', machine.average()) for _ in range(42)]
    assert not any(lines)
    machine.gain[0, 1] = 2.3
    line, = monitor.take_average('input', machine.average())
    assert '(warn, 1.1 times the baseline), since average 42' in line
    found = monitor.report()['changes'][0]
    assert (found['kind'], found['level']) == ('limit', 'warn')
    assert found['limit'] == pytest.approx(2.2, rel=0.01)
    assert found['change'] == pytest.approx(0.15, abs=0.02)
    assert (found['p_value'], found['keyphasor_share']) == (None, None)


def test_a_relative_limit_of_an_order_that_is_absent_counts_its_noise():
    limit = {'order': 19.0, 'shaft': 'input', 'relative': True, 'alarm': 3.0}
    watch, machine = LimitWatch(machine_of(**limit), ['input']), DrawnMachine(9)
    machine.gain[0, 1] = 0.0
    monitor = MachineMonitor('m', ['input'], replace(SETTINGS, learning_averages=40),
                             limits=watch)
    assert not any(monitor.take_average('input', machine.average()) for _ in range(300))


def test_an_average_without_correction_ends_no_alarm_of_one_with_it():
    watch, machine = watch_of(alarm=0.95), DrawnMachine(10)
    watch.update('input', machine.average())
    assert watch.passed()
    machine.corrected = False  # jitter has left 0.9
    assert watch.update('input', machine.average()) == []
    assert watch.passed()
    machine.corrected, machine.gain[0, 1] = True, 0.8
    assert len(watch.update('input', machine.average())) == 1


def test_averages_of_a_recording_have_one_reading():
    machine = DrawnMachine(11)
    averages = [machine.average() for _ in range(4)]
    mean = mean_of(averages).readings
    assert mean[0] == pytest.approx(np.mean([item.readings[0] for item in averages], axis=0))
    assert mean[1] == pytest.approx(averages[0].readings[1] / 4, rel=0.1)
    machine.corrected = False
    assert mean_of([*averages, machine.average()]).readings[:, :, :3] == pytest.approx(
        mean[:, :, :3])


def test_what_the_averages_lack_is_said():
    watch, machine = LimitWatch(machine_of(order=3.0, shaft='input', warn=1.0), [
        'input', 'output']), DrawnMachine(12)
    watch.update('input', machine.average())
    assert watch.missing == {'one': 'the averages of input lack order 3: see input.orders'}
    average = machine.average()
    average.readings[1, 0, 1] = np.nan
    watch = watch_of(warn=1.0)
    watch.update('input', average)
    assert watch.missing == {
        'one': 'order 19 of input has no standard error: take more trigger cycles'}
    watch = watch_of(channel=4, warn=1.0)
    watch.update('input', machine.average())
    assert watch.missing == {'one': 'no channel 4 among 0, 1'}
    watch = LimitWatch(machine_of(order=3.0, shaft='output', warn=1.0), ['input'])
    assert watch.missing == {'one': 'output is not monitored: add it to shafts'}


@pytest.mark.parametrize(('limit', 'text'), [
    ({}, 'gives no quantity: give one of order, part, indicator'),
    ({'order': 3.0, 'indicator': 'fm4', 'warn': 1.0}, 'gives order and indicator: give one'),
    ({'order': 3.0}, 'has neither warn nor alarm'),
    ({'order': 3.0, 'warn': 2.0, 'alarm': 1.0}, r'.warn is 2, above its alarm of 1: a warning'),
    ({'order': 3.0, 'warn': -1.0}, r'.warn is -1.0: give more than 0'),
    ({'order': 3.0, 'warn': 'high'}, r".warn is 'high': give a number"),
    ({'order': 3.0, 'warn': 0.9, 'relative': True}, 'is relative and 0.9: give times the base'),
    ({'order': 3.0, 'warm': 1.0}, 'has unknown warm: give order, part, indicator, shaft'),
    ({'part': 'mesh input-outptu 1x', 'warn': 1.0},
     r".part is 'mesh input-outptu 1x', which no .* give mesh input-output 1x or "),
    ({'part': 'mesh input-output 1x', 'warn': 1.0}, 'is of which shaft. give shaft, one of in'),
    ({'order': 3.0, 'warn': 1.0}, 'is of which shaft. give shaft, one of input, output'),
    ({'order': 3.0, 'warn': 1.0, 'shaft': 'inptu'}, r".shaft is 'inptu', which is unknown: give"),
    ({'part': 'bearing b1 outer', 'warn': 1.0, 'shaft': 'output'},
     r".shaft is 'output', which has no bearing b1 outer: give one of input"),
    ({'indicator': 'fm44', 'warn': 1.0}, r".indicator is 'fm44', which is unknown: give one of"),
    ({'order': 3.0, 'warn': 1.0, 'shaft': 'input', 'channel': 'gearbox'},
     r"channel is 'gearbox', which is unknown: give one of machine.channels \(drive end\), or"),
])
def test_a_wrong_limit_is_one_line(limit, text):
    with pytest.raises(ParameterError, match=rf'^machine\.limits\.one[ .]?{text}') as error:
        LimitWatch(machine_of(**limit), ['input', 'output'], ['drive end'])
    assert '\n' not in str(error.value)
