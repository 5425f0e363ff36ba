# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Recordings averaged into files: what they hold, what is left out, and what bad input costs."""

import csv
from dataclasses import replace
import json
import os
from pathlib import Path
import signal

from matplotlib.image import imread
import numpy as np
import pytest
import sa_jitter_ros as sa
from sa_jitter_ros.averaging.results import AMPLITUDE_FIELDS
from sa_jitter_ros.commands import average, check_keyphasor
from sa_jitter_ros.offline import fleet
from sa_jitter_ros.offline.repairs_figure import write_repairs
from sa_jitter_ros.pulses.validation import PulseValidator
from sa_jitter_ros.recordings.npz_format import write_npz
from sa_jitter_ros.recordings.recording import ArraySource, Recording
from sa_jitter_ros.simulation import AdditiveNoise, DeclaredJitter, Gearbox, mesh

CLOCK, RATE, SPEED, SECONDS, RATIO = 3000.0, 8000.0, 16.6, 5.0, 2.40789
MACHINE = f"""
/**/synchronous_averager:
  ros__parameters:
    shafts: [output, input]
    input.ratio: {RATIO}
    input.orders: [19.0, 38.0]
    input.mesh_orders: [19.0]
    output.orders: [1.0]
    trigger_cycles: 20
    keyphasor_rate: {CLOCK}
    correct_jitter: true
"""


@pytest.fixture(scope='module')
def recording():
    """Return a recording of two channels whose keyphasor is slow."""
    machine = Gearbox(mesh('input', 19, harmonics=(1.0, 0.5)), RATE, shafts={'input': RATIO},
                      speed=((0.0, SPEED),), seed=1, effects=(
                          DeclaredJitter('uniform', 1 / CLOCK / 12**0.5), AdditiveNoise(0.1)))
    samples = machine.vibration(0, round(RATE * SECONDS))[0]
    return Recording(ArraySource(np.stack((samples, 0.6 * np.roll(samples, 5)))), RATE,
                     units=('m/s^2',), channel_names=('drive end', 'free end'),
                     pulse_times=machine.pulses(0.0, SECONDS).times, ratio=RATIO, orders=(19.0,))


@pytest.fixture
def rig(recording, tmp_path):
    """Return its path, beside a machine file `machine.yaml`."""
    write_npz(tmp_path / 'rig.npz', recording)
    (tmp_path / 'machine.yaml').write_text(MACHINE)
    return tmp_path / 'rig.npz'


def run(*arguments):
    """Run the command in this process, without figures."""
    before = signal.getsignal(signal.SIGTERM)
    try:
        return average.main([*map(str, arguments), '--no-figures'])
    finally:
        signal.signal(signal.SIGTERM, before)


def table(path):
    """Return the rows of a .csv."""
    with path.open(newline='') as file:
        return list(csv.DictReader(file))


def test_files_hold_what_the_library_returns(recording, rig, tmp_path, capsys):
    out = tmp_path / 'out'
    assert run(rig, '--params', tmp_path / 'machine.yaml', '--output', out) == 0
    assert capsys.readouterr() == (f'8 averages of 1 recording\nwritten: {out}\n', '')
    expected = sa.average(
        recording.read(), RATE, recording.pulse_times, ratio=RATIO, trigger_cycles=20,
        orders=(19.0, 38.0), correct_jitter=True, keyphasor_rate=CLOCK)
    arrays = np.load(out / 'rig' / 'averages.npz')
    assert list(arrays['shafts']) == ['output', 'input']
    assert list(arrays['input_order_amplitude_fields']) == list(AMPLITUDE_FIELDS)
    for name in ('start_time', 'end_time', 'sequence', 'trigger_speed', 'trigger_cycles',
                 'discarded_cycles'):
        of_library = [getattr(item, name) for item in expected]
        assert arrays[name].tolist() == arrays[f'input_{name}'].tolist() == of_library
    assert arrays['input_angle'] == pytest.approx(expected[0].angle)
    for name, values in (
            ('waveform', [item.waveform for item in expected]),
            ('standard_error', [item.standard_error for item in expected]),
            ('corrected_average', [item.correction.waveform for item in expected])):
        np.testing.assert_allclose(arrays[f'input_{name}'], values, atol=1e-12)
    fields = arrays['input_order_amplitude']
    for name, values in (
            ('raw_amplitude', [abs(item.amplitudes) for item in expected]),
            ('corrected_phase', [np.angle(item.correction.amplitudes) for item in expected])):
        np.testing.assert_allclose(fields[..., AMPLITUDE_FIELDS.index(name)], values, atol=1e-12)
    np.testing.assert_allclose(
        arrays['input_pulse_error'][:, 1],
        np.concatenate([item.correction.pulse_errors for item in expected]), atol=1e-12)
    assert arrays['input_condition_indicator'].shape == (
        4, 2, arrays['input_condition_indicator_names'].size)


def test_the_table_has_a_row_for_each_average_channel_and_order(rig, tmp_path):
    out = tmp_path / 'out'
    assert run(rig, '--params', tmp_path / 'machine.yaml', '--output', out, '--quiet') == 0
    rows = table(out / 'rig' / 'averages.csv')
    assert list(rows[0]) == [
        'recording', 'shaft', 'sequence', 'start_time', 'end_time', 'trigger_speed',
        'trigger_cycles', 'discarded_cycles', 'channel', *AMPLITUDE_FIELDS, 'channel_name',
        'unit', 'note']
    assert len(rows) == 4 * 2 * (1 + 2)
    arrays = np.load(out / 'rig' / 'averages.npz')
    row, = (row for row in rows if (row['shaft'], row['sequence'], row['channel'], row['order'])
            == ('input', '2', '1', '38.0'))
    assert row['channel_name'] == 'free end'
    np.testing.assert_array_equal(
        [float(row[name]) for name in AMPLITUDE_FIELDS], arrays['input_order_amplitude'][2, 1, 1])
    everything = table(out / 'averages.csv')
    assert everything == [{**row, 'error': ''} for row in rows]
    summary, = table(out / 'recordings.csv')
    assert (summary['averages'], summary['trigger_cycles'], summary['error']) == ('8', '82', '')
    assert not any(row['note'] for row in rows)


@pytest.mark.machines
@pytest.mark.parametrize(('unit', 'volts'), [('V', 1.0), ('mV', 1e-3), ('', 1.0)])
def test_volts_become_units_once(recording, rig, tmp_path, unit, volts):
    sensitivity = np.array([[0.1], [-0.05]])
    write_npz(tmp_path / 'volts.npz', replace(
        recording, units=(unit,),
        vibration=ArraySource(recording.read() * sensitivity / volts)))
    channels = MACHINE + """/**:
  ros__parameters:
    machine:
      channels:
        free_end: {unit: m/s^2, sensitivity: -0.05}
        drive end: {unit: m/s^2, sensitivity: 0.1}
"""
    (tmp_path / 'volts.yaml').write_text(channels)
    assert run(rig, '--params', tmp_path / 'machine.yaml', '--output', tmp_path / 'a') == 0
    assert run(tmp_path / 'volts.npz', '--params', tmp_path / 'volts.yaml',
               '--output', tmp_path / 'b') == 0
    for plain, scaled in zip(table(tmp_path / 'a/rig/averages.csv'),
                             table(tmp_path / 'b/volts/averages.csv'), strict=True):
        assert scaled['unit'] == plain['unit'] == 'm/s^2'
        assert float(scaled['raw_amplitude']) == pytest.approx(float(plain['raw_amplitude']))
        assert float(scaled['raw_phase']) == pytest.approx(float(plain['raw_phase']), abs=1e-9)


def test_sensitivity_of_a_channel_that_is_in_units_is_refused(rig, tmp_path, capsys):
    (tmp_path / 'machine.yaml').write_text(
        MACHINE + '    machine.channels.free_end.sensitivity: 0.1\n')
    assert run(rig, '--params', tmp_path / 'machine.yaml', '--output', tmp_path / 'a') == 2
    assert 'comes in m/s^2, not in V: leave it out' in capsys.readouterr().err


def test_an_order_beyond_the_band_has_a_note(rig, tmp_path):
    out = tmp_path / 'out'
    assert run(rig, '-p', 'shaft.orders:=[1.0, 5000.0]', '--output', out, '--quiet') == 0
    rows = table(out / 'rig' / 'averages.csv')
    assert list(rows[0])[-1] == 'note'
    for row in rows:
        refused = row['order'] == '5000.0'
        assert ('shows orders below' in row['note']) == refused
        assert (row['raw_amplitude'] == 'nan') == refused
    with np.load(out / 'rig' / 'averages.npz') as arrays:
        assert [bool(note) for note in arrays['shaft_note'][0]] == [False, True]


def test_finished_recordings_are_skipped_until_settings_or_file_change(
        rig, tmp_path, monkeypatch):
    out, times = tmp_path / 'out', []
    command = [rig, '--params', tmp_path / 'machine.yaml', '--output', out]
    for change in ((), (), ('-p', 'trigger_cycles:=40'), ('-p', 'trigger_cycles:=40')):
        assert run(*command, *change) == 0
        times.append((out / 'rig' / 'averages.npz').stat().st_mtime_ns)
    assert times[0] == times[1] < times[2] == times[3]
    assert table(out / 'recordings.csv')[0]['averages'] == '4'
    os.utime(rig)
    assert run(*command, '-p', 'trigger_cycles:=40') == 0
    assert (out / 'rig' / 'averages.npz').stat().st_mtime_ns > times[3]


@pytest.mark.parametrize('jobs', [1, 2])
def test_recordings_that_cannot_be_read_cost_their_own_row(rig, tmp_path, capfd, jobs):
    data = tmp_path / 'data'
    (data / 'old').mkdir(parents=True)
    (data / 'rig.npz').write_bytes(rig.read_bytes())
    (data / 'old' / 'rig.npz').write_bytes(rig.read_bytes())
    (data / 'broken.npz').write_bytes(rig.read_bytes()[:-30_000])
    (data / 'notes.txt').write_text('no recording')
    os.mkfifo(data / 'pipe.npz')
    out = data / 'out'
    for _ in range(2):  # the results in `out` are no recordings
        assert run(data, '--params', tmp_path / 'machine.yaml', '--output', out, '--jobs', jobs,
                   '--quiet') == 0
        rows = {row['recording']: row for row in table(out / 'recordings.csv')}
        assert [name for name, row in rows.items() if not row['error']] == ['old/rig', 'rig']
        assert sorted(rows) == ['broken', 'old/rig', 'pipe', 'rig']
        assert 'pipe or a device' in rows['pipe']['error']
        lines = capfd.readouterr().err.splitlines()
        assert len(lines) == 2
        assert all(f'average: {data}/' in line for line in lines)
    everything = table(out / 'averages.csv')
    assert len(everything) == 2 * 24 + 2
    assert [row['recording'] for row in everything if row['error']] == ['broken', 'pipe']


def test_recording_that_ends_in_the_middle_keeps_what_came_before(rig, tmp_path, capsys):
    rate = 2000.0
    time = np.arange(12_000) / rate
    lines = ['time,vibration,tach'] + [
        f'{t:.4f},{np.cos(2 * np.pi * 19 * 10 * t):.4f},{float(10 * t % 1 < 0.1)}' for t in time]
    lines[9001] = '4.5,nonsense'
    (tmp_path / 'rig.csv').write_text('\n'.join(lines))
    out = tmp_path / 'out'
    assert run(tmp_path / 'rig.csv', '--tach-channel', 'tach', '--field', 'orders=19', '-p',
               'trigger_cycles:=10', '--output', out) in (0, 2)
    captured = capsys.readouterr()
    assert len(captured.err.splitlines()) == 1
    assert 'rig.csv' in captured.err


@pytest.mark.machines
def test_figures_of_a_run_up_with_gear(tmp_path):
    machine = Gearbox(mesh('shaft', 11, harmonics=(1.0, 0.5)), RATE,
                      speed=((0.0, 10.0), (4.0, 20.0)), seed=1, effects=(AdditiveNoise(0.1),))
    write_npz(tmp_path / 'run up.npz', Recording(
        ArraySource(machine.vibration(0, round(4.0 * RATE))), RATE, orders=(11.0, 22.0),
        pulse_times=machine.pulses(0.0, 4.0).times))
    before = signal.getsignal(signal.SIGTERM)
    assert average.main([
        str(tmp_path / 'run up.npz'), '--output', str(tmp_path / 'out'), '--quiet',
        '-p', 'trigger_cycles:=8', '-p', 'shaft.mesh_orders:=[11]']) == 0
    signal.signal(signal.SIGTERM, before)
    figures = {path.stem: path for path in (tmp_path / 'out' / 'run up').glob('*.png')}
    assert set(figures) == {'waveform', 'orders', 'spectrum', 'order_map', 'tracked_orders',
                            'gear_signals'}
    width, height = imread(figures['order_map']).shape[1::-1]
    assert width > height  # over time, and over speed beside it
    page = (tmp_path / 'out' / 'run up' / 'page.html').read_text()
    assert page.count('<img ') == 3  # average, spectrum, trend
    assert 'No baseline to compare with' in page


@pytest.mark.parametrize(('arguments', 'says'), [
    (['nothing.npz'], 'nothing.npz: No such file or directory: check the path'),
    (['rig.npz', '-p', 'pinoin.ratio:=2'], 'synchronous_averager has no parameter pinoin.ratio'),
    (['rig.npz', '-p', 'trigger_cycle:=2'], 'trigger_cycle, did you mean trigger_cycles?'),
    (['rig.npz', '-p', 'trigger_cycles=2'], "parameter 'trigger_cycles=2': give NAME:=VALUE"),
    (['rig.npz', '-p', 'trigger_cycles:=-2'], 'trigger_cycles is -2: give at least 1'),
    (['rig.npz', '-p', 'trigger_cycles:=400'], 'make 82 whole trigger cycles of the 400'),
    (['rig.npz', '--field', 'ration=2'], 'a recording has no field ration'),
    (['rig.npz', '--params', 'machine.yaml', '--field', 'ratio=2'],
     '--field ratio with the shafts output, input: give the parameters output.ratio'),
    (['rig.npz', '--params', 'none.yaml'], 'none.yaml: No such file'),
    (['rig.npz', '--params', '/dev/zero'], '/dev/zero: is no regular file'),
    (['/dev/zero', '--params', 'machine.yaml'], '/dev/zero: '),
    (['empty'], 'empty: no recording in this folder'),
    (['rig.npz', '--scheduler', 'tcp://127.0.0.1:9'], '--scheduler'),
])
def test_unusable_input_is_one_line_and_status_2(
        rig, tmp_path, capsys, monkeypatch, arguments, says):
    monkeypatch.setattr(fleet, 'ANSWER', 1.0)
    monkeypatch.chdir(tmp_path)
    Path('empty').mkdir()
    assert run(*arguments, '--output', 'out') == 2
    captured = capsys.readouterr()
    assert captured.out == ''
    assert len(captured.err.splitlines()) == 1
    assert captured.err.startswith('average: ')
    assert says in captured.err
    assert not list(tmp_path.glob('out/*'))


def test_a_tach_that_is_recorded_twice_is_drawn(tmp_path):
    """Every pulse comes twice: half of them are strays, at the times of the others."""
    times = np.repeat(np.arange(0.2, 9.0, 0.05), 2)
    recording = Recording(ArraySource(np.zeros((1, 5000))), 500.0, pulse_times=times)
    assert write_repairs(tmp_path, 'twice', recording, times, [(times[8], 'spurious')])
    assert imread(tmp_path / 'repairs.png').shape[1] > 600


@pytest.mark.machines
def test_what_was_repaired_is_drawn(tmp_path):
    """A stray pulse, a lost one and a spike of the tach: `average` and `check_keyphasor` show."""
    rate, rng = 5000.0, np.random.default_rng(1)
    turn = 20.0 * np.arange(100_000) / rate - 0.3
    tach = 5.0 * (turn % 1.0 < 0.1) + 0.02 * rng.standard_normal(turn.size)
    lost = round((100.0 + 0.3) / 20.0 * rate)
    tach[lost - 5:lost + 60] = 0.0
    tach[50_030:50_034], tach[80_000] = 5.0, 60.0
    np.savez(tmp_path / 'shop.npz', vibration=np.cos(6.0 * np.pi * turn), sample_rate=rate,
             tach=tach, tach_rate=rate)
    checked, averaged = tmp_path / 'checked', tmp_path / 'averaged'
    assert check_keyphasor.main([str(tmp_path / 'shop.npz'), '--output', str(checked),
                                 '--quiet']) == 0
    assert average.main([
        str(tmp_path / 'shop.npz'), '--params', str(checked / 'machine.yaml'), '--output',
        str(averaged), '--quiet']) == 0
    for folder in (checked, averaged / 'shop'):
        assert imread(folder / 'repairs.png').shape[1] > 600
    assert '1 sample of the keyphasor waveform is a spike' in (
        averaged / 'recordings.csv').read_text(encoding='utf-8')
    codes = {item['code'] for item in json.loads(
        (checked / 'keyphasor.json').read_text(encoding='utf-8'))['warnings']}
    assert {'spikes', 'spurious', 'missing'} <= codes
    validator = PulseValidator()
    validator.update([0.0, 1.0, 2.0, 3.0, 3.3, 4.0, 6.0, 7.0, 8.0])
    validator.flush()
    assert validator.rejected == [(3.3, 'doubles'), (5.0, 'missing')]
