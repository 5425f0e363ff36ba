# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Has the machine changed, over recordings of days: what is found, and what a bad day costs."""

from itertools import pairwise
import json
import signal

from matplotlib.image import imread
import numpy as np
import pytest
from sa_jitter_ros.commands import average
from sa_jitter_ros.machine import Machine
from sa_jitter_ros.monitoring.change_test import ChangeTest, memory_of
from sa_jitter_ros.offline.change_figure import changes_figure, write_figure
from sa_jitter_ros.offline.changes import find_changes, settings_of
from sa_jitter_ros.offline.machine_page import write_page

RATE, SECONDS, BEARING = 4000.0, 2.0, 4.87
DAYS, LEARNING, BEGIN = 18, 9, 13
SETTINGS = ('-p', 'shaft.orders:=[1.0, 19.0]', '-p', f'shaft.bearing_orders:=[{BEARING}]',
            '-p', 'trigger_cycles:=16', '-p', 'correct_jitter:=false', '-p',
            'allow_uncorrected:=true')


def day(number, *, speed=None, depth=None, channels=1, rate=RATE):
    """Return a recording of a day: mesh, load, noise, and a bearing that strikes from `BEGIN`."""
    rng = np.random.default_rng([7, number])
    time = np.arange(round(rate * SECONDS)) / rate
    turn = (speed or rng.uniform(19.5, 20.5)) * time
    load = np.exp(0.2 * rng.standard_normal())
    depth = max(number - BEGIN + 1, 0) * 0.1 if depth is None else depth
    noise = load * rng.standard_normal((channels, time.size))
    vibration = noise * np.sqrt(1.0 + depth * np.cos(2.0 * np.pi * BEARING * turn)) + load * (
        0.2 * np.cos(2.0 * np.pi * turn) + np.cos(2.0 * np.pi * 19.0 * turn))
    return {'vibration': vibration, 'sample_rate': rate,
            'pulse_times': np.interp(np.arange(0.5, turn[-1]), turn, time)}


def write(folder, days):
    """Write recordings by the numbers of their days."""
    folder.mkdir(exist_ok=True)
    for number, content in days.items():
        np.savez(folder / f'day_{number:02d}.npz', **content)
    return folder


def run(*arguments):
    """Run the command in this process, return its exit status."""
    before = signal.getsignal(signal.SIGTERM)
    try:
        return average.main([*map(str, arguments), '--quiet'])
    finally:
        signal.signal(signal.SIGTERM, before)


def answer(out):
    """Return what the file says."""
    return json.loads((out / 'changes.json').read_text(), parse_constant=pytest.fail)


@pytest.fixture(scope='module')
def weeks(tmp_path_factory):
    """Return a folder of recordings and one of their averages."""
    place = tmp_path_factory.mktemp('weeks')
    write(place / 'in', {number: day(number) for number in range(1, DAYS + 1)})
    assert run(place / 'in', '--output', place / 'out', '--baseline', LEARNING, *SETTINGS,
               '--no-figures') == 0
    return place / 'in', place / 'out'


@pytest.mark.machines
def test_a_bearing_fault_is_found_with_the_day_on_which_it_began(weeks):
    found = answer(weeks[1])
    assert found['baseline'] == {'averages': LEARNING, 'complete': True}
    change, = found['changes']
    assert (change['kind'], change['name'], change['since_time']) == ('bearing', '4.87', None)
    assert change['change'] > 1.0
    assert change['since_recording'] in {f'day_{BEGIN + late:02d}' for late in (-1, 0, 1)}
    assert change['found_recording'] in {f'day_{BEGIN + late:02d}' for late in (2, 3, 4)}
    assert [event['recording'] for event in found['events']] == [change['found_recording']]
    assert found['recordings'] == [f'day_{number:02d}' for number in range(1, DAYS + 1)]


@pytest.mark.machines
def test_the_figure_shows_what_changed_first(weeks, tmp_path):
    names = [f'day_{number:02d}' for number in range(1, DAYS + 1)]
    changes = find_changes(weeks[1], names, settings_of(
        None, ['allow_uncorrected:=true'], LEARNING))
    write_figure(changes, tmp_path)
    assert imread(tmp_path / 'changes.png').ndim == 3
    write_page(weeks[1] / names[-1], changes, place=tmp_path / 'page.html')
    page = (tmp_path / 'page.html').read_text()
    assert '<p class="verdict unexplained">The machine has changed in 9 recordings' in page
    assert page.count('<img alt="Changes"') == 1
    figure = changes_figure(changes)
    first, *others = figure.axes
    assert first.get_title(loc='left').startswith('bearing order 4.87 of shaft, channel 0: +')
    assert len(others) == 5
    for _ in range(2):  # the layout moves the labels
        figure.savefig(tmp_path / 'labels.png')
    places = [axes.yaxis.label.get_window_extent() for axes in figure.axes]
    assert any('unit unknown' in axes.get_ylabel() for axes in others)
    assert all(below.y1 < above.y0 for above, below in pairwise(places))


def test_limits_of_days_are_passed_beside_the_changes(weeks, tmp_path):
    names = [f'day_{number:02d}' for number in range(1, DAYS + 1)]
    machine = Machine(limits={
        'fault': {'order': BEARING, 'relative': True, 'warn': 3.0, 'alarm': 30.0},
        'mesh': {'order': 19.0, 'warn': 0.1, 'channel': '0'},
        'other': {'order': 19.0, 'warn': 99.0, 'channel': 'gearbox'}})
    changes = find_changes(weeks[1], names, settings_of(
        None, ['allow_uncorrected:=true'], LEARNING), machine)
    changes.write(tmp_path)
    statistical, fault, mesh = sorted(answer(tmp_path)['changes'], key=lambda item: item['name'])
    assert (fault['kind'], fault['name'], fault['level']) == (
        'limit', f'bearing order {BEARING}', 'warn')
    assert fault['since_recording'] in {f'day_{BEGIN + late:02d}' for late in (1, 2, 3, 4)}
    assert fault['limit'] == pytest.approx(3.0 * fault['value'] / (1.0 + fault['change']))
    assert (mesh['name'], mesh['since_recording'], mesh['limit']) == ('order 19', 'day_01', 0.1)
    assert (statistical['kind'], statistical['level']) == ('bearing', None)
    assert any(line.endswith(f'since {fault["since_recording"]}') for line in changes.lines())
    assert 'limit other: no channel gearbox among channel 0' in changes.warnings()
    titles = [axes.get_title(loc='left') for axes in changes_figure(changes).axes]
    assert titles[0].startswith('order 19 of shaft')
    assert titles[1].startswith('bearing order 4.87 of shaft')


def test_a_second_run_only_looks_again(weeks, capsys):
    folder, out = weeks
    before = (out / 'day_01' / 'averages.npz').stat().st_mtime_ns
    text = (out / 'changes.json').read_text()
    assert run(folder, '--output', out, '--baseline', LEARNING, *SETTINGS, '--no-figures') == 0
    assert (out / 'day_01' / 'averages.npz').stat().st_mtime_ns == before
    assert (out / 'changes.json').read_text() == text
    lines = capsys.readouterr().out.splitlines()
    assert lines[1] == f'the machine has changed in 9 recordings after the baseline of {LEARNING}:'
    assert lines[2].startswith('  bearing order 4.87 of shaft, channel 0: +')


def test_healthy_days_show_no_change(weeks, capsys):
    folder, out = weeks
    days = [folder / f'day_{number:02d}.npz' for number in range(1, BEGIN)]
    assert run(*days, '--output', out, '--baseline', 8, *SETTINGS, '--no-figures') == 0
    assert 'no change in 4 recordings after the baseline of 8' in capsys.readouterr().out
    assert answer(out)['changes'] == answer(out)['events'] == []


@pytest.mark.machines
def test_a_bad_day_costs_itself_and_is_named(tmp_path, capsys):
    days = {number: day(number) for number in range(1, DAYS + 1)}
    days[3] = day(3, channels=2)
    days[5] = {**day(5), 'pulse_times': np.array([])}
    days[11] = day(11, rate=2.0 * RATE)  # is no bad one
    days[15] = day(15, speed=25.0)
    folder, out = write(tmp_path / 'in', days), tmp_path / 'out'
    (folder / 'day_07.npz').write_bytes((folder / 'day_07.npz').read_bytes()[:5000])
    assert run(folder, '--output', out, '--baseline', LEARNING, *SETTINGS, '--no-figures') == 0
    found, told = answer(out), capsys.readouterr()
    assert found['left_out'].keys() == {'day_03', 'day_15'}
    assert 'day_03 is not compared: it has the channels 0, 1, most have 0' in told.err
    assert 'day_15 is not compared: it turns at 25 Hz, the baseline at 19.' in told.err
    assert '2 could not be averaged' in told.out
    assert [item['name'] for item in found['changes']] == ['4.87']
    assert 'day_11' in found['recordings']
    assert not {'day_05', 'day_07'} & {*found['recordings']}


@pytest.mark.machines
def test_recordings_of_one_clock_are_in_its_order(tmp_path):
    days = {}
    for number in range(1, DAYS + 1):
        content, start = day(number), 1e6 + 3600.0 * number
        days[DAYS - number] = {**content, 'start_time': start,
                               'pulse_times': content['pulse_times'] + start}
    folder, out = write(tmp_path / 'in', days), tmp_path / 'out'
    assert run(folder, '--output', out, '--baseline', LEARNING, *SETTINGS, '--no-figures') == 0
    found = answer(out)
    assert found['recordings'] == [f'day_{number:02d}' for number in range(DAYS - 1, -1, -1)]
    change, = found['changes']
    assert change['since_time'] == pytest.approx(
        1e6 + 3600.0 * (DAYS - int(change['since_recording'][-2:])), abs=0.2)


def test_too_few_recordings_and_wrong_settings_are_one_line(weeks, capsys):
    folder, out = weeks
    few = [folder / f'day_{number:02d}.npz' for number in range(1, 9)]
    assert run(*few, '--output', out, '--baseline', 8, *SETTINGS, '--no-figures') == 2
    assert capsys.readouterr().err == (
        'average: 8 recordings can be compared, and 8 are the baseline: give 9 or more; their '
        'averages are written\n')
    assert (out / 'averages.csv').exists()
    assert run(folder, '--output', out, '--baseline', 8, '-p', 'speed_bin:=-1.0') == 2
    assert capsys.readouterr().err.startswith('average: speed_bin is -1.0: give at least')
    with pytest.raises(SystemExit):
        run(folder, '--output', out, '--baseline', 7)
    assert capsys.readouterr().err == (
        "average: argument --baseline: '7': give a whole number, 8 or more\n")


def test_refused_corrections_are_said(weeks, capsys):
    folder, out = weeks
    assert run(folder, '--output', out, '--baseline', LEARNING, *SETTINGS[:-2],
               '--no-figures') == 0
    assert (f'orders and indicators of {DAYS} of {DAYS} recordings are not compared'
            in capsys.readouterr().err)
    assert {item['kind'] for item in answer(out)['changes']} == {'bearing'}


def test_settings_of_the_machine_file_count(weeks, tmp_path):
    folder, out = weeks
    machine = tmp_path / 'machine.yaml'
    machine.write_text(f"""
/**/synchronous_averager:
  ros__parameters: {{shaft.orders: [1.0, 19.0], trigger_cycles: 16, correct_jitter: false,
                     shaft.bearing_orders: [{BEARING}]}}
/**/change_monitor:
  ros__parameters: {{learning_averages: 200, allow_uncorrected: true, speed_bin: 0.01}}
""")
    assert run(folder, '--params', machine, '--output', out, '--baseline', 8,
               '--no-figures') == 0
    found = answer(out)
    assert found['baseline']['averages'] == 8
    assert [item['kind'] for item in found['changes']] == ['bearing']


@pytest.fixture(scope='module')
def loads(tmp_path_factory):
    """Return arguments for days of two loads, with a channel of the torque."""
    place, days = tmp_path_factory.mktemp('loads'), {}
    for number in range(1, 25):
        content, load = day(number, depth=0.0), 1.0 + 2.0 * (11 < number < 23)
        rng = np.random.default_rng([8, number])
        torque = np.full(round(RATE * SECONDS), 100.0 * load + rng.standard_normal())
        scale = load * np.exp(0.02 * rng.standard_normal()) / np.std(content['vibration'])
        days[number] = {**content, 'vibration': [content['vibration'][0] * scale, torque],
                        'channel_names': ['acc', 'torque']}
    return (write(place / 'in', days), '--output', place / 'out', '--no-figures', '--baseline',
            LEARNING, *SETTINGS)


@pytest.mark.machines
def test_a_load_that_changes_is_a_change_where_it_is_not_known(loads):
    assert run(*loads) == 0
    texts = [event['text'] for event in answer(loads[2])['events']]
    assert any(text.startswith('order 19 of shaft, channel 0: +') for text in texts)


@pytest.mark.machines
def test_days_are_compared_with_days_of_their_load(loads, tmp_path):
    assert run(*loads, '--state', 'torque', '-p', 'state_bin:=100') == 0
    found = answer(loads[2])
    assert [found[key] for key in ('changes', 'events', 'left_out')] == [[], [], {}]
    assert found['baseline'] == {'averages': 2 * LEARNING, 'complete': True}
    changes = find_changes(loads[2], found['recordings'], settings_of(
        None, ['allow_uncorrected:=true', 'state_bin:=100.0'], LEARNING), state='1')
    assert changes.baseline == tuple(
        (number if number < 12 else number - 11) <= LEARNING for number in range(1, 25))
    write_figure(changes, tmp_path)
    assert imread(tmp_path / 'changes.png').ndim == 3


def test_averages_outside_the_gate_do_not_count(loads, capsys):
    assert run(*loads, '--state', 'torque', '-p', 'state_highest:=200') == 0
    found, told = answer(loads[2]), capsys.readouterr()
    assert len(found['recordings']) == 13
    assert found['left_out']['day_12'].endswith(' is above 200')
    assert f'no change in 4 recordings after the baseline of {LEARNING}' in told.out


@pytest.mark.machines
@pytest.mark.parametrize(('arguments', 'text'), [
    (('--state', 'power', '-p', 'state_bin:=80'), 'are the baseline: give 10 or more; their '
     'averages are written; day_01 has no channel power'),
    (('--state', 'torque'), 'average: --state needs state_bin, state_lowest or state_highest'),
    (('-p', 'state_bin:=80'), 'average: state_bin, state_lowest and state_highest need --state'),
    (('--state', 'torque', '-p', 'state_bin:=-1'), 'average: state_bin is -1: give at least 0')])
def test_a_wrong_state_is_one_line(loads, arguments, text, capsys):
    assert run(*loads, *arguments) == 2
    assert text in capsys.readouterr().err.splitlines()[-1]


UNITS = 100  # machines


def alarms(kept, learning, *, known):
    """Return the share of series of 45 days, which remember a part of the day before, with one."""
    rng, shape, days = np.random.default_rng(9), (UNITS, 12), []
    state = rng.standard_normal(shape)
    for _ in range(45):
        state = kept * state + np.sqrt(1.0 - kept**2) * rng.standard_normal(shape)
        days.append(state)
    unknown = np.full(shape, np.nan)
    memory = np.array([[memory_of(np.array(days[:learning])[:, unit]) if known else 0.0]
                       for unit in range(UNITS)])
    test = ChangeTest(shape, learning=learning, memory=memory)
    return np.any([test.update(0, value, unknown, unknown, (0.0, 0.0), 365.25)[0]
                   for value in days], axis=(0, 2)).mean()


@pytest.mark.machines
@pytest.mark.parametrize('kept', [0.0, 0.6])
def test_days_that_follow_each_other_are_no_change(kept):
    expected = 35.0 / 365.25
    error = np.sqrt(expected * (1.0 - expected) / UNITS)
    assert alarms(kept, 10, known=True) <= expected + 3.0 * error
    if kept == 0.6:
        assert alarms(kept, 10, known=False) > 0.5
