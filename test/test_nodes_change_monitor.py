# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The change monitor over DDS: learning, changes, health, and the file of its baseline."""

from contextlib import contextmanager
import json
import os
from pathlib import Path
import resource
import subprocess
import sys

from bench import NodeBench, SteadyClock
from diagnostic_msgs.msg import DiagnosticStatus
from drawn_machine import DrawnMachine
import numpy as np
import pytest
from sa_jitter_ros.errors import ParameterError, RecordingError
from sa_jitter_ros.monitoring.baseline_file import lock_baseline
from sa_jitter_ros.monitoring.quantities import KINDS
from sa_jitter_ros.nodes import health, messages
from sa_jitter_ros.nodes.change_monitor import baseline_path, ChangeMonitor
from sa_jitter_ros.nodes.testing import Graph
from std_msgs.msg import Float64, Float64MultiArray, String

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
KEYS = {'shaft', 'channel', 'kind', 'name', 'change', 'standard_error', 'since_sequence',
        'since_time', 'keyphasor_share', 'p_value', 'level', 'limit'}


class MonitorBench(NodeBench):
    """A bench around a monitor of drawn averages."""

    def __init__(self, graph, *, shafts=('input',), state=None, **parameters):
        parameters = {'learning_averages': 40, 'group_averages': 4, 'hardware_id': 'pump 3',
                      'shafts': list(shafts), 'baseline_file': 'none', **parameters}
        super().__init__(
            graph, ChangeMonitor,
            inputs={f'{shaft}/{kind}': Float64MultiArray for shaft in shafts for kind in KINDS
                    } | ({'operating_state': state} if state else {}),
            outputs={}, **parameters)
        self.received['change'] = graph.capture('change', String, latched=True)

    def play(self, machine, count, *, shaft='input', kinds=KINDS):
        """Publish averages of a machine, their arrays in any order."""
        for number in range(count):
            arrays = dict(zip(KINDS, machine.messages()))
            for kind in sorted(kinds, key=lambda kind: hash((kind, number))):
                self.send(f'{shaft}/{kind}', messages.encode_average(kind, arrays[kind]))
        self.settle()

    def change(self):
        """Return the latest content of the topic."""
        self.settle()
        assert self.spin(lambda: self.received['change'])
        return json.loads(self.received['change'][-1].data, parse_constant=pytest.fail)


@pytest.mark.machines
def test_learns_then_names_the_change(ros_graph):
    b, machine = MonitorBench(ros_graph), DrawnMachine(1)
    assert b.change() == {'baseline': {'averages': 0, 'complete': False}, 'changes': []}
    assert b.diagnostics()[:2] == (OK, 'no average received yet')
    count = len(b.received['change'])
    b.play(machine, 30)
    assert len(b.received['change']) - count == 30
    assert b.change()['baseline'] == {'averages': 30, 'complete': False}
    assert b.diagnostics()[:2] == (OK, 'learning: 30 of 40 averages of input at 16.6 Hz')
    b.play(machine, 50)
    assert b.change() == {'baseline': {'averages': 80, 'complete': True}, 'changes': []}
    assert b.diagnostics()[:2] == (OK, 'no change in 80 averages')
    machine.gain[1, 2] = 1.08
    b.play(machine, 80)
    found, = b.change()['changes']
    assert found.keys() == KEYS
    assert [found[key] for key in ('shaft', 'channel', 'kind', 'name')] == [
        'input', 1, 'order', '38']
    assert found['change'] == pytest.approx(0.08, abs=4.0 * found['standard_error'])
    assert abs(found['since_sequence'] - 80) <= 4
    assert found['p_value'] < 1e-3
    level, text, values = b.diagnostics()
    assert level == WARN
    assert text.startswith('the machine has changed: order 38 of input, channel 1: +')
    assert 'since average 80; the keyphasor explains 0.' in text
    assert (values['changes'], values['baseline_complete']) == ('1', 'true')
    machine.gain[1, 2] = 2.0
    b.play(machine, 80)
    level, text, _ = b.diagnostics()
    assert (level, text.partition(':')[0]) == (ERROR, 'order 38 of input, channel 1')
    assert b.set_parameter('severe_change', 10.0) == (True, '')
    assert b.diagnostics()[0] == WARN


LIMITS = {'machine__tach_shaft': 'input', 'machine__channels__motor__unit': 'g',
          'machine__channels__pump__unit': 'g', 'machine__limits__mesh__order': 19,
          'machine__limits__mesh__warn': 1.5, 'machine__limits__mesh__alarm': 2,
          'machine__limits__mesh__channel': 'pump', 'machine__limits__other__order': 40.0,
          'machine__limits__other__relative': True, 'machine__limits__other__alarm': 3.0}


def test_limits_are_warnings_and_errors_before_the_baseline_is_complete(ros_graph):
    b, machine = MonitorBench(ros_graph, **LIMITS), DrawnMachine(21)
    b.play(machine, 3)
    assert b.change()['changes'] == []
    level, text, _ = b.diagnostics()
    assert (level, text) == (
        WARN, 'limit other: the averages of input lack order 40: see input.orders')
    machine.gain[1, 1] = 1.7
    b.play(machine, 2)
    found, = b.change()['changes']
    assert found.keys() == KEYS | {'value', 'value_error', 'limit_name'}
    assert [found[key] for key in ('shaft', 'channel', 'kind', 'name', 'level', 'limit')] == [
        'input', 1, 'limit', 'order 19', 'warn', 1.5]
    assert (found['since_sequence'], found['change'], found['limit_name']) == (3, None, 'mesh')
    assert found['value'] == pytest.approx(1.7, abs=4.0 * found['value_error'])
    level, text, values = b.diagnostics()
    assert (level, values['limits_passed']) == (WARN, '1')
    assert text.startswith('a limit is passed: order 19 of input, channel 1: 1.')
    assert 'limit other: ' in text
    machine.gain[1, 1] = 2.5
    b.play(machine, 1)
    level, text, _ = b.diagnostics()
    assert level == ERROR
    assert text.startswith('order 19 of input, channel 1: 2.')
    assert 'above 2 (alarm), since average 5' in text
    machine.gain[1, 1] = 1.0
    b.play(machine, 1)
    assert b.change()['changes'] == []
    assert b.diagnostics()[0] == WARN  # of the other one


def test_a_wrong_limit_stops_the_node_with_one_line(ros_graph):
    with pytest.raises(ParameterError, match=r"^machine\.limits\.mesh\.channel is 'fan'"):
        MonitorBench(ros_graph, **{**LIMITS, 'machine__limits__mesh__channel': 'fan'})


def test_speeds_that_are_never_learnt_are_said(ros_graph):
    b, machine = MonitorBench(ros_graph), DrawnMachine(13)
    for number in range(24):
        machine.speed = (16.6, 20.0, 24.0)[number % 3]
        b.play(machine, 2)
    assert b.diagnostics()[:2] == (
        OK, 'learning: 16 of 40 averages of input at 24.53 Hz, of 48 in all bins: larger ones '
        'learn sooner')
    assert not b.change()['baseline']['complete']


@pytest.mark.machines
@pytest.mark.parametrize('stamped', [False, True])
def test_a_load_that_changes_is_no_change_of_the_machine(ros_graph, stamped):
    kind = Float64MultiArray if stamped else Float64
    b, machine = MonitorBench(
        ros_graph, state=kind, state_bin=50, state_lowest=50,
        operating_state_type=f'std_msgs/{kind.__name__}'), DrawnMachine(22)
    for number in range(20):
        load = (100.0, 200.0, 20.0, 200.0)[number % 4]
        machine.gain[:] = load / 100.0
        stamp = machine.sequence * 60.0
        b.send('operating_state', Float64MultiArray(data=[stamp, load]) if stamped else
               Float64(data=load))
        b.settle()
        b.play(machine, 8 if load == 200.0 else 4)
    assert b.change() == {'baseline': {'averages': 100, 'complete': True}, 'changes': []}
    level, text, values = b.diagnostics()
    assert (level, text, values['averages_discarded']) == (OK, 'no change in 100 averages', '20')
    b.send('operating_state', Float64MultiArray(data=[machine.sequence * 60.0, 20.0]) if stamped
           else Float64(data=20.0))
    b.settle()
    b.play(machine, 1)
    assert b.diagnostics()[:2] == (
        OK, '21 averages discarded; input: state 20 is below 50')
    wrong = Float64MultiArray(data=[0.0, np.nan]) if stamped else Float64(data=np.nan)
    b.send('operating_state', wrong)
    level, text, values = b.diagnostics()
    assert (level, values['messages_rejected']) == (WARN, '1')
    assert text.startswith('operating_state: state nan at ')


def test_an_operating_state_that_never_comes_is_said(ros_graph, monkeypatch):
    clock = SteadyClock()
    monkeypatch.setattr(health, 'time', clock)
    b = MonitorBench(ros_graph, state_bin=50.0, stale_after=5.0)
    clock.now += 4.0
    b.play(DrawnMachine(23), 2)
    clock.now += 2.0
    level, text, values = b.diagnostics()
    assert level == WARN
    assert text == ('no /operating_state since the start 6 s ago: nobody publishes it: start its '
                    'source, and compare topics and namespaces (ros2 topic list)')
    assert values['averages_discarded'] == '2'
    assert b.change()['baseline']['averages'] == 0


def test_an_unused_operating_state_is_not_asked_for(ros_graph):
    b = MonitorBench(ros_graph)
    assert not [item for item in b.node.subscriptions if 'operating' in item.topic_name]
    with pytest.raises(ParameterError, match=r"^operating_state_type is 'std_msgs/Int8': give"):
        MonitorBench(ros_graph, operating_state_type='std_msgs/Int8')


def test_late_subscriber_gets_the_last_answer(ros_graph):
    b = MonitorBench(ros_graph)
    b.play(DrawnMachine(2), 12)
    late = ros_graph.capture('change', String, latched=True)
    assert ros_graph.spin(lambda: late)
    assert json.loads(late[-1].data)['baseline'] == {'averages': 12, 'complete': False}


def test_worse_keyphasor_is_no_change(ros_graph):
    b, machine = MonitorBench(ros_graph, learning_averages=80), DrawnMachine(3)
    b.play(machine, 120)
    machine.keyphasor, machine.bias = 3.0, 0.02
    b.play(machine, 120)
    assert b.change()['changes'] == []
    assert b.diagnostics()[0] == OK


def test_missing_correction_is_said(ros_graph):
    b, machine = MonitorBench(ros_graph), DrawnMachine(4)
    b.play(machine, 8)
    machine.corrected = False
    b.play(machine, 3)
    level, text, values = b.diagnostics()
    assert level == WARN
    assert text.startswith('comparison of input: without 3 of the latest 10 averages, '
                           'order_amplitude has no corrected amplitudes')
    assert (values['uncorrected'], values['baseline_averages']) == ('3', '11')
    machine.corrected = True
    b.play(machine, 9)
    assert b.diagnostics()[1].startswith('comparison of input: without 1 of the latest 10 ')
    b.play(machine, 1)
    b.diagnostics()
    assert b.diagnostics()[0] == OK


def test_shafts_are_monitored_apart_and_together(ros_graph):
    b = MonitorBench(ros_graph, shafts=('input', 'output'))
    first, second = DrawnMachine(5), DrawnMachine(6)
    b.play(first, 60, shaft='input')
    assert b.change()['baseline'] == {'averages': 60, 'complete': False}
    b.play(second, 60, shaft='output')
    assert b.change()['baseline'] == {'averages': 120, 'complete': True}
    second.damage[0, 0] = 1.2
    b.play(second, 40, shaft='output')
    found, = b.change()['changes']
    assert (found['shaft'], found['kind'], found['name']) == ('output', 'indicator', 'rms')


def test_averager_without_indicators_is_monitored(ros_graph):
    b, machine = MonitorBench(ros_graph), DrawnMachine(7)
    b.play(machine, 80, kinds=KINDS[:1])
    assert b.change()['baseline']['complete']
    machine.gain[0, 1] = 1.2
    b.play(machine, 60, kinds=KINDS[:1])
    assert [item['name'] for item in b.change()['changes']] == ['19']


class DeafMachine(DrawnMachine):
    """A machine whose channel 1 has no data while `deaf`."""

    deaf = True

    def messages(self):
        """Return the arrays of an average."""
        arrays = super().messages()
        for array in arrays if self.deaf else ():
            array.values[1, ..., 1 if array is arrays[0] else 0:] = np.nan
        return arrays


def test_a_channel_without_data_is_named_and_never_complete(ros_graph):
    b, machine = MonitorBench(ros_graph), DeafMachine(7)
    b.play(machine, 60)
    assert b.change()['baseline'] == {'averages': 60, 'complete': False}
    level, text, _ = b.diagnostics()
    assert level == WARN
    assert text.startswith('channels of input: 1 not judged, the latest averages have no values ')
    machine.deaf = False
    b.play(machine, 20)
    level, text, _ = b.diagnostics()
    assert (level, text.partition(' at ')[0]) == (OK, 'learning: 20 of 40 averages of input')
    b.play(machine, 20)
    assert b.change()['baseline'] == {'averages': 100, 'complete': True}
    machine.deaf = True
    b.play(machine, 4)
    level, text, _ = b.diagnostics()
    assert (level, text.partition(',')[0]) == (WARN, 'channels of input: 1 not judged')
    assert b.set_parameter('relearn', True) == (True, '')
    assert b.diagnostics()[0] == OK


def test_wrong_messages_cost_themselves(ros_graph):
    b, machine = MonitorBench(ros_graph), DrawnMachine(8)
    orders, indicators, errors, envelope = machine.messages()
    b.send('input/order_amplitude', Float64MultiArray())
    for kind, array in zip(KINDS, (orders, indicators, errors, envelope)):
        message = messages.encode_average(kind, array)
        if kind == 'condition_indicator':  # of one channel
            message.layout.dim[0].size = 1
            message.data = message.data[:7 + indicators.values.shape[1]]
        b.send(f'input/{kind}', message)
    level, text, values = b.diagnostics()
    assert (level, values['messages_rejected']) == (WARN, '2')
    assert '1 channels of indicators and 2 of orders' in text
    b.play(machine, 4)
    assert b.change()['baseline']['averages'] == 4


def test_silence_is_reported(ros_graph, monkeypatch):
    clock = SteadyClock()
    monkeypatch.setattr(health, 'time', clock)
    b = MonitorBench(ros_graph, stale_after=5.0)
    b.play(DrawnMachine(9), 2)
    clock.now += 8.0  # an average takes 2 s
    level, text, values = b.diagnostics()
    assert (level, text.partition(':')[0]) == (WARN, 'no /input/order_amplitude for 8 s')
    assert values['average_age'] == '8.0'


@pytest.mark.parametrize('silent', KINDS[1:])
def test_indicators_that_stay_away_are_named(ros_graph, monkeypatch, silent):
    clock, machine = SteadyClock(), DrawnMachine(9)
    monkeypatch.setattr(health, 'time', clock)
    b = MonitorBench(ros_graph, stale_after=5.0)
    b.play(machine, 1)
    for seconds, expected in ((4.0, OK), (4.0, WARN), (12.0, ERROR)):
        clock.now += seconds
        b.play(machine, 1, kinds=[kind for kind in KINDS if kind != silent])
        level, text, values = b.diagnostics()
        assert level == expected
        assert (f'no /input/{silent} for' in text) == (expected != OK)
    assert (values['average_age'], values[f'{silent}_age']) == ('0.0', '20.0')
    b.play(machine, 1)
    assert b.diagnostics()[0] == OK


def test_each_shaft_is_watched(ros_graph, monkeypatch):
    clock, machine = SteadyClock(), DrawnMachine(9)
    monkeypatch.setattr(health, 'time', clock)
    b = MonitorBench(ros_graph, stale_after=5.0, shafts=('input', 'output'))
    for shaft in ('input', 'output'):
        b.play(machine, 1, shaft=shaft)
    clock.now += 8.0
    b.play(machine, 1)
    level, text, values = b.diagnostics()
    assert (level, text.partition(':')[0]) == (WARN, 'no /output/order_amplitude for 8 s')
    assert (values['input.average_age'], values['output.average_age']) == ('0.0', '8.0')


def test_parameters_that_do_not_fit_are_refused(ros_graph):
    with pytest.raises(ParameterError, match='learn at least 8 groups, 80 averages'):
        MonitorBench(ros_graph, learning_averages=79, group_averages=10)
    b = MonitorBench(ros_graph)
    accepted, reason = b.set_parameter('false_alarms_per_year', 0.0)
    assert (accepted, 'more than 0.0' in reason) == (False, True)
    assert b.set_parameter('false_alarms_per_year', 12.0)[0]


# --- the file ------------------------------------------------------------------------------------


@contextmanager
def running(**parameters):
    """Start a monitor, as a process would; end it."""
    graph = Graph()
    try:
        yield MonitorBench(graph, **parameters)
    finally:
        graph.shutdown()


@pytest.fixture
def learned(tmp_path):
    """Return a machine, the file that a monitor has kept of it, and its last answer: a change."""
    machine, path = DrawnMachine(10), tmp_path / 'state' / 'baseline.npz'
    with running(baseline_file=str(path)) as b:
        b.play(machine, 80)
        machine.gain[0, 1] = 1.1
        b.play(machine, 40)
        content = b.change()
    assert content['changes']
    return machine, path, content


@pytest.mark.machines
def test_baseline_and_changes_survive_a_restart(learned):
    machine, path, content = learned
    with running(baseline_file=str(path)) as b:
        assert b.change() == content
        assert b.diagnostics()[0] == WARN
        b.play(machine, 40)
        assert b.change()['changes'][0]['since_time'] == content['changes'][0]['since_time']
        assert b.change()['baseline']['complete']


def test_corrupt_file_is_refused_and_kept(learned, capfd):
    machine, path, _ = learned
    path.write_bytes(path.read_bytes()[:500])
    before = path.read_bytes()
    with running(baseline_file=str(path)) as b:
        level, text, _ = b.diagnostics()
        assert level == ERROR
        assert text.startswith(f'{path}: is no intact baseline')
        b.play(machine, 60)
        assert b.change() == {'baseline': {'averages': 0, 'complete': False}, 'changes': []}
    assert capfd.readouterr().err.count('is no intact baseline') == 1
    assert path.read_bytes() == before


@pytest.mark.machines
def test_relearn_begins_a_baseline_and_keeps_the_file_of_the_old_one(learned, capfd):
    machine, path, content = learned
    before = path.read_bytes()
    with running(baseline_file=str(path)) as b:
        for number in (1, 2):
            assert b.set_parameter('relearn', True) == (True, '')
            assert b.change() == {'baseline': {'averages': 0, 'complete': False}, 'changes': []}
            assert not b.node.get_parameter('relearn').value
            assert b.diagnostics()[0] == OK
            assert path.with_name(f'baseline.{number}.npz').exists()
            assert path.with_name('baseline.1.npz').read_bytes() == before
            b.play(machine, 50)
            assert b.change() == {'baseline': {'averages': 50, 'complete': True}, 'changes': []}
    assert 'well again' not in capfd.readouterr().err
    with running(baseline_file=str(path.with_name('baseline.1.npz'))) as b:
        assert b.change() == content
    with pytest.raises(ParameterError, match='relearn is true: set it while the node runs'):
        MonitorBench(Graph(), relearn=True)


def test_relearn_sets_a_damaged_file_aside(learned):
    machine, path, _ = learned
    path.write_bytes(path.read_bytes()[:500])
    before = path.read_bytes()
    with running(baseline_file=str(path)) as b:
        assert b.diagnostics()[0] == ERROR
        assert b.set_parameter('relearn', True) == (True, '')
        assert b.diagnostics()[0] == OK
        b.play(machine, 50)
        assert b.change()['baseline']['complete']
    assert path.with_name('baseline.1.npz').read_bytes() == before


def test_second_monitor_of_a_file_is_refused_until_the_first_has_ended(learned):
    machine, path, content = learned
    with running(baseline_file=str(path)):
        before = path.read_bytes()
        with running(baseline_file=str(path)) as b:
            level, text, _ = b.diagnostics()
            assert (level, text) == (
                ERROR, f'{path}: process {os.getpid()} keeps its baseline there: end that one, or '
                'give another baseline_file')
            b.play(machine, 60)
        assert path.read_bytes() == before
    with running(baseline_file=str(path)) as b:
        assert b.change() == content


def test_lock_of_a_file_ends_with_its_process(tmp_path):
    path = tmp_path / 'baseline.npz'
    process = subprocess.Popen(
        [sys.executable, '-c', 'import sys, time\nfrom pathlib import Path\n'
         'from sa_jitter_ros.monitoring.baseline_file import lock_baseline\n'
         'lock = lock_baseline(Path(sys.argv[1]))\nprint(flush=True)\ntime.sleep(600.0)',
         str(path)], stdout=subprocess.PIPE)
    assert process.stdout.readline()
    with pytest.raises(RecordingError, match=f'process {process.pid} keeps'):
        lock_baseline(path)
    process.kill()
    process.communicate()
    lock_baseline(path).close()


def test_baseline_of_another_machine_is_refused_and_kept(learned):
    machine, path, _ = learned
    before = path.read_bytes()
    with running(baseline_file=str(path), hardware_id='pump 4') as b:
        level, text, _ = b.diagnostics()
        assert (level, "machine 'pump 3', this one is 'pump 4'" in text) == (ERROR, True)
        b.play(machine, 10)
    with running(baseline_file=str(path)) as b:
        orders, indicators, errors, envelope = machine.messages()
        orders.values[..., 0] += 1.0
        for kind, array in zip(KINDS, (orders, indicators, errors, envelope)):
            b.send(f'input/{kind}', messages.encode_average(kind, array))
        level, text, _ = b.diagnostics()
        assert (level, 'orders 2, 20, 39' in text) == (ERROR, True)
    assert path.read_bytes() == before


def test_averages_of_another_machine_are_one_steady_error(ros_graph, capfd):
    b, machine = MonitorBench(ros_graph), DrawnMachine(22)
    b.play(machine, 5)
    levels = []
    for add in (1.0, 1.0, 0.0, 0.0, 1.0):
        arrays = machine.messages()
        arrays[0].values[..., 0] += add
        for kind, array in zip(KINDS, arrays):
            b.send(f'input/{kind}', messages.encode_average(kind, array))
            levels.append(b.diagnostics()[0])
    assert levels == [OK] * 3 + [ERROR] * 8 + [OK] * 8 + [ERROR]
    log = capfd.readouterr().err
    assert log.count('[ERROR]') == log.count('orders 2, 20, 39') == 2


def test_baseline_survives_a_restart_without_any_setting(tmp_path, monkeypatch):
    monkeypatch.setenv('ROS_HOME', str(tmp_path))
    machine = DrawnMachine(13)
    path = tmp_path / 'sa_jitter_ros' / 'pump%203%2FA.change_monitor.npz'
    usual = {'hardware_id': 'pump 3/A', 'baseline_file': ''}
    with running(**usual) as b:
        b.play(machine, 60)
        assert b.diagnostics()[2]['baseline_file'] == str(path)
    assert path.exists()
    with running(**usual) as b:
        assert b.change()['baseline'] == {'averages': 60, 'complete': True}
    for other in ({'hardware_id': 'pump 4'}, {'baseline_file': 'none'}):
        with running(**{**usual, **other}) as b:
            assert b.change()['baseline'] == {'averages': 0, 'complete': False}
            b.play(machine, 60)
    assert {item.name for item in path.parent.glob('[!.]*')} == {
        path.name, 'pump%204.change_monitor.npz'}


@pytest.mark.parametrize(('machine', 'node', 'name'), [
    ('', '/change_monitor', 'change_monitor.npz'),
    ('mill', '/hall_2/change_monitor', 'mill.hall_2.change_monitor.npz')])
def test_file_has_the_names_of_machine_and_node(monkeypatch, machine, node, name):
    monkeypatch.delenv('ROS_HOME', raising=False)
    monkeypatch.setenv('HOME', '/home/somebody')
    assert baseline_path('', machine, node) == Path('/home/somebody/.ros/sa_jitter_ros') / name
    assert baseline_path('~/a.npz', machine, node) == Path('/home/somebody/a.npz')
    assert baseline_path('none', machine, node) is None


@pytest.mark.parametrize('place', ['file', '/proc'])
def test_file_that_cannot_be_written_is_a_warning_from_the_start(ros_graph, tmp_path, place):
    (tmp_path / 'file').write_text('in the way')
    b = MonitorBench(ros_graph, baseline_file=str(tmp_path / place / 'baseline.npz'))
    for count in (0, 60):
        b.play(DrawnMachine(11), count)
        level, text, _ = b.diagnostics()
        assert level == WARN
        assert text.startswith('baseline file: ')
        assert 'the baseline cannot be written' in text
    assert b.change()['baseline'] == {'averages': 60, 'complete': True}


@pytest.mark.parametrize(('given', 'reason'), [
    ({'baseline_file': '/dev/full'}, '/dev/full: is no regular file: give another baseline_file'),
    ({'baseline_file': '', 'hardware_id': 'a' * 300}, 'File name too long')])
def test_what_can_be_no_file_is_an_error(ros_graph, tmp_path, monkeypatch, capfd, given, reason):
    monkeypatch.setenv('ROS_HOME', str(tmp_path))
    b = MonitorBench(ros_graph, **given)
    for _ in range(2):
        level, text, _ = b.diagnostics()
        assert (level, reason in text) == (ERROR, True)
        assert b.set_parameter('relearn', True) == (True, '')
    assert Path('/dev/full').exists()
    assert 'a new baseline' not in capfd.readouterr().err


def test_a_full_disk_is_a_warning_and_the_node_ends_well(tmp_path):
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, limit[1]))  # no file can hold a byte
    try:
        with running(baseline_file=str(tmp_path / 'baseline.npz')) as b:
            b.play(DrawnMachine(12), 5)
            b.node.keep_state()
            level, text, _ = b.diagnostics()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert level == WARN
    assert 'the baseline cannot be written: File too large' in text


def test_arrays_hold_nan_and_nothing_else_happens(ros_graph):
    b, machine = MonitorBench(ros_graph), DrawnMachine(12)
    for _ in range(60):
        for kind, array in zip(KINDS, machine.messages()):
            array.values[0] = array.values[0] if kind == 'order_amplitude' else np.nan
            b.send(f'input/{kind}', messages.encode_average(kind, array))
    assert b.change() == {'baseline': {'averages': 60, 'complete': True}, 'changes': []}
    assert b.diagnostics()[1] == (
        'no change in 60 averages; without values: rms of input, channel 0; kurtosis of input, '
        'channel 0; m8a of input, channel 0; bearing order 4.9 of input, channel 0')
