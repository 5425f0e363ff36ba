# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Operating states: their bins, gate and times, and a load that changes beside damage."""

from dataclasses import replace
import math

from drawn_machine import DrawnMachine, SECONDS, SETTINGS
import numpy as np
import pytest
from sa_jitter_ros.averaging.results import AverageHeader
from sa_jitter_ros.errors import MessageError, ParameterError, RecordingError
from sa_jitter_ros.monitoring import operating
from sa_jitter_ros.monitoring.machine_monitor import MachineMonitor
from sa_jitter_ros.monitoring.monitor import Settings
from sa_jitter_ros.monitoring.operating import OperatingBins, OperatingState

LOADS = (100.0, 140.0, 220.0)  # of a machine whose amplitudes are proportional to them
LEARNING = replace(SETTINGS, learning_averages=40, false_alarms_per_year=1.0)


class Loaded:
    """A monitored machine whose load is another one every ten averages."""

    def __init__(self, seed, settings, path=None):
        self.machine = DrawnMachine(seed)
        self.monitor = MachineMonitor('m', ['input'], settings, path)
        self.damage = np.ones(self.machine.gain.shape)

    def run(self, count, loads=LOADS):
        """Take averages; return the lines that are said."""
        lines = []
        for number in range(count):
            load = loads[number // 10 % len(loads)] * (
                1.0 + 0.02 * self.machine.rng.standard_normal())
            self.machine.gain[:] = load / 100.0 * self.damage
            average = self.machine.average()
            self.monitor.state.add(load, average.header.start_time + 1.0)
            lines += self.monitor.take_average('input', average)
        return lines


def test_a_load_that_changes_is_no_damage_where_bins_are_set():
    plain = Loaded(31, LEARNING)
    plain.run(60, LOADS[:1])
    assert plain.run(60, LOADS[2:])  # looks like damage
    binned = Loaded(31, replace(LEARNING, state_bin=40.0))
    assert binned.run(60, LOADS[:1]) == []
    assert binned.run(300) == []
    assert binned.monitor.monitors['input'].is_complete
    binned.damage[1, 1] = 1.1
    lines = binned.run(60)
    assert [line.partition(':')[0] for line in lines] == ['order 19 of input, channel 1']
    found, = binned.monitor.changes()
    assert found.change == pytest.approx(0.1, abs=4.0 * found.standard_error)


@pytest.mark.machines
def test_false_alarms_of_a_changing_load_are_those_of_a_steady_one():
    alarms = sum(len(Loaded(seed, replace(LEARNING, state_bin=40.0)).run(400))
                 for seed in range(3))
    years = 3 * 400 * SECONDS / (365.25 * 86400.0)
    assert alarms <= years + 4.0 * math.sqrt(years) + 1.0


def test_averages_outside_the_gate_are_discarded():
    gated = Loaded(32, replace(LEARNING, state_lowest=120.0, state_highest=180.0))
    assert gated.run(90) == []
    assert (gated.monitor.averages, gated.monitor.discarded) == (30, 60)
    assert gated.monitor.refusals['input'].endswith(' is above 180')
    gated.run(1)
    assert gated.monitor.refusals['input'].endswith(' is below 120')
    gated.run(10, LOADS[1:2])
    assert gated.monitor.refusals['input'] == ''
    gated.monitor.take_average('input', replace(gated.machine.average(), header=replace(
        gated.machine.average().header, start_time=-5.0, end_time=-3.0)))
    assert gated.monitor.refusals['input'] == 'no operating state is known'


def test_bins_outlast_a_restart(tmp_path):
    path, settings = tmp_path / 'baseline.npz', replace(LEARNING, state_bin=40.0)
    before = Loaded(33, settings, path)
    before.run(150)
    before.monitor.save()
    before.monitor.close()
    after = Loaded(34, settings, path)
    after.run(20)
    shaft = after.monitor.monitors['input']
    assert shaft.place == before.monitor.monitors['input'].place.replace('220', '140')
    assert (shaft.averages, shaft.is_complete) == (170, True)
    after.monitor.close()
    with pytest.raises(RecordingError, match=r'learnt with state_bin 40.0, now it is 0.0'):
        Loaded(35, LEARNING, path)


def test_bins_are_told_apart():
    bins = OperatingBins(0.05, 10.0)
    keys = {(speed, state): bins.key(speed, state)
            for speed in (16.6, 17.5, 18.4, 15.8, 1e-3, 1e6) for state in (0.0, 11.0, -9.0, 1e6)}
    assert len({*keys.values()}) == len(keys)
    assert all(float(key) == key for key in keys.values())
    farthest = {bins.key(speed, 1e12) for speed in (16.6, 17.5)}
    assert all(0 < key < 1 << 53 for key in farthest)  # which floats tell apart
    assert bins.words(keys[15.8, -9.0]) == '15.81 Hz and state -10'
    assert bins.key(16.6, math.nan) is bins.key(0.0, 1.0) is bins.key(math.nan, 1.0) is None
    assert OperatingBins(0.05, 0.0).key(16.6, math.nan) == 0


def header(start, end):
    """Return the header of an average."""
    return AverageHeader(start, end, 0, 1, 1, 1.0)


def test_an_average_has_the_mean_state_of_its_time():
    state = OperatingState(stamped=True, hold=3.0)
    for time, value in ((1.0, 10.0), (2.0, 20.0), (3.0, 60.0), (9.0, 5.0)):
        state.add(value, time)
    assert state.of('a', header(1.5, 3.0)) == 40.0
    assert state.of('a', header(4.0, 5.0)) == 60.0
    assert math.isnan(state.of('a', header(6.5, 7.0)))
    assert math.isnan(state.of('a', header(0.0, 0.5)))
    with pytest.raises(MessageError, match='publish finite numbers'):
        state.add(math.nan, 10.0)
    state.add(7.0, 0.0)  # begun again
    assert state.of('a', header(0.0, 9.5)) == 7.0


def test_the_states_of_long_ago_are_forgotten(monkeypatch):
    monkeypatch.setattr(operating, '_MOST_VALUES', 10)
    state = OperatingState(stamped=True)
    sizes = []
    for number in range(100):
        state.add(float(number), float(number))
        sizes.append(len(state._times))
    assert max(sizes) <= 20
    assert state.of('a', header(90.0, 99.0)) == 94.5
    assert math.isnan(state.of('a', header(0.0, 50.0)))


def test_a_state_without_times_counts_as_it_comes(monkeypatch):
    clock = type('Clock', (), {'now': 100.0, 'monotonic': lambda self: self.now})()
    monkeypatch.setattr(operating, 'time', clock)
    state, found = OperatingState(stamped=False, hold=5.0), []
    for later, value in ((0.0, 10.0), (0.5, 20.0), (0.1, None), (0.1, 50.0), (0.1, None),
                         (3.0, None), (9.0, None)):
        clock.now += later
        if value is None:
            found.append(state.of('a', header(0.0, 1.0)))
        else:
            state.add(value)
    assert found[:3] == [15.0, 50.0, 50.0]
    assert math.isnan(found[3])


def test_wrong_gates_are_one_line():
    with pytest.raises(ParameterError, match=r'^state_lowest is 3, state_highest 2: give a lower'):
        Settings(state_lowest=3.0, state_highest=2.0)
    with pytest.raises(ParameterError, match=r'^state_bin is -1.0: give at least 0'):
        Settings(state_bin=-1.0)
