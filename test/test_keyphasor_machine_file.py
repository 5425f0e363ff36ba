# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""What `check_keyphasor` writes, `average` and `close_loop` take."""

from dataclasses import replace
from functools import cache
import json
import re
from shutil import copytree
from types import SimpleNamespace
import warnings

import numpy as np
import pytest
from sa_jitter_ros.averaging.averager_parameters import streaming_averager
from sa_jitter_ros.commands import average, check_keyphasor, close_loop
from sa_jitter_ros.declaration import read_declaration
from sa_jitter_ros.inference.observation import observe
from sa_jitter_ros.inference.record_pulses import record_pulses
from sa_jitter_ros.keyphasor_check import check as keyphasor
from sa_jitter_ros.keyphasor_check.machine_file import machine_file
from sa_jitter_ros.keyphasor_check.vibration import path_delay
from sa_jitter_ros.offline.average_recording import average_file, AverageJob
from sa_jitter_ros.offline.settings import averager_values, MachineFile
from sa_jitter_ros.recordings import ArraySource, read
from sa_jitter_ros.recordings.npz_format import write_npz

pytestmark = pytest.mark.usefixtures('undrawn', 'unasked')

RATE = 5120.0


def write_rig(path, *, turns, marks=1, missing=0, edges=None, speed=20.0, torsion=0.0,
              jitter=2e-6, orders=(1, 5, 8), seed=1):
    """
    Write a shaft whose angle swings by `torsion` (rad) twice a turn, and its wheel.

    Its marks stand at `edges`, in revolutions, or evenly but for the missing ones.
    """
    rng = np.random.default_rng(seed)
    fine = np.linspace(0.0, turns / speed + 0.1, int((turns / speed + 0.1) * 20e3))
    angle = 2.0 * np.pi * speed * (fine - 0.02) + torsion * np.sin(4.0 * np.pi * speed * fine)
    time = np.arange(int(fine[-1] * RATE)) / RATE
    turned = np.interp(time, fine, angle)
    edges = np.arange(marks - missing) / marks if edges is None else np.asarray(edges)
    places = np.append((np.arange(turns)[:, None] + edges).ravel(), turns + edges[0])
    pulses = np.interp(2.0 * np.pi * places, angle, fine)
    np.savez(path, sample_rate=RATE, pulse_times=pulses + rng.normal(0.0, jitter, pulses.size),
             vibration=[sum(np.cos(g * turned + g) for g in orders)
                        + 0.05 * rng.normal(size=time.size)])


@pytest.fixture(scope='module')
def checked(tmp_path_factory):
    """Return the function that writes a rig, checks it, and returns its folder, once for each."""
    @cache
    def of(turns, **options):
        folder = tmp_path_factory.mktemp('checked')
        write_rig(folder / 'rig.npz', turns=turns, **options)
        assert check_keyphasor.main([
            str(folder / 'rig.npz'), '--output', str(folder), '--quiet']) == 0
        return folder

    return of


def run_all(folder, capsys, change=None):
    """Average and close the loop; return the text that both print, and the report."""
    path, machine = folder / 'rig.npz', str(folder / 'machine.yaml')
    if change is not None:
        change(folder / 'machine.yaml')
    capsys.readouterr()
    assert average.main([str(path), '--params', machine, '--output', str(folder / 'averages'),
                         '--no-figures', '--quiet']) == 0
    assert close_loop.main([str(path), '--declared', machine, '--output', str(folder / 'loop'),
                            '--quiet']) == 0
    return ''.join(capsys.readouterr()), json.loads((folder / 'loop/report.json').read_text())


@pytest.mark.machines
@pytest.mark.parametrize(('turns', 'marks'), [(9, 6), (9, 1)])
def test_a_short_recording_is_averaged_and_says_what_is_too_short(checked, capsys, turns, marks):
    text, report = run_all(checked(turns, marks=marks), capsys)
    assert 'averages of 1 recording' in text
    assert report['verdict'] == 'none'
    reason = report['not_testable'][0]['reason']
    assert reason.endswith('take at least 4; record longer')


@pytest.mark.machines
def test_a_wheel_whose_shaft_twists_by_more_than_half_a_tooth_is_taken(checked, capsys):
    folder = checked(12, marks=60, missing=2, torsion=np.radians(3.4))  # of so few it is taken
    angles = re.search(r'target_angles: \[(.*)\]', (folder / 'machine.yaml').read_text())[1]
    assert max(float(angle) for angle in angles.split(',')) > np.pi / 60  # for uneven marks
    text, _ = run_all(folder, capsys)
    assert 'averages of 1 recording' in text


def from_mark_to_mark(file):
    """Let trigger cycles of a machine file go from mark to mark, five revolutions an average."""
    text = file.read_text()
    marks = int(re.search(r'pulses_per_revolution: (\d+)', text)[1])
    text, count = re.subn(r'( +)trigger_cycles: \d+', rf'\1trigger_cycles: {5 * marks}\n'
                          r'\1pulses_per_trigger: 1', text)
    assert count == 2
    file.write_text(text)


@pytest.mark.machines
@pytest.mark.parametrize(('wheel', 'each'), [
    ('extra', False), ('narrow', False), ('any', True), ('nearly even', True)])
def test_a_wheel_with_marks_at_any_angles_is_taken(checked, tmp_path, capsys, rng, wheel, each):
    """The loop takes the given angles from the pulses, and finds no effect that is none."""
    edges = {
        'extra': np.sort([*np.arange(12) / 12, (rng.integers(12) + rng.uniform(.15, .45)) / 12]),
        'narrow': np.array([0.0, 0.05, 0.12]),
        'any': np.append(0.0, np.cumsum(rng.uniform(0.3, 1.7, 7))),
        'nearly even': (np.arange(8) + rng.uniform(-0.05, 0.05, 8)) / 8}[wheel]
    if wheel == 'any':
        edges = edges[:-1] / edges[-1]
    folder = copytree(checked(40, edges=tuple(edges), jitter=2e-5, orders=(1, 5, 8, 24)),
                      tmp_path / 'rig')
    text, report = run_all(folder, capsys, change=from_mark_to_mark if each else None)
    assert 'averages of 1 recording' in text
    assert (report['verdict'], report['missing_effects'], report['remarks']) == ('none', [], [])
    table = np.genfromtxt(folder / 'averages/averages.csv', delimiter=',', names=True,
                          dtype=None, encoding='utf-8')
    if not each:
        assert np.max(np.abs(table['raw_amplitude'] - 1.0)) < 0.02


@pytest.mark.machines
def test_jitter_that_is_not_declared_is_named_for_an_uneven_wheel(checked, tmp_path, capsys):
    """Three times the declared jitter, with the size of what is not declared."""
    def change(file):
        from_mark_to_mark(file)
        text, count = re.subn('jitter_std: .*', 'jitter_std: 4e-5', file.read_text())
        assert count == 1
        file.write_text(text)

    folder = copytree(checked(50, edges=(*np.arange(12) / 12, 11.3 / 12), jitter=1.2e-4,
                              orders=(1, 5, 8, 24)), tmp_path / 'rig')
    _, report = run_all(folder, capsys, change)
    effect, = report['missing_effects']
    size = effect['parameters']['std']
    assert effect['name'] == 'excess_jitter'
    assert abs(size['value'] - np.sqrt(1.2e-4**2 - 4e-5**2)) < 4.0 * size['standard_error']


@pytest.mark.machines
@pytest.mark.parametrize('wrong', ['reversed', 'of fewer marks'])
def test_angles_of_another_wheel_are_named_as_the_cause(checked, tmp_path, capsys, rng, wrong):
    edges = np.append(0.0, np.cumsum(rng.uniform(0.3, 1.7, 9)))
    edges = edges[:-1] / edges[-1]
    folder = checked(60, edges=tuple(edges))
    other = np.sort((1.0 - edges) % 1.0) if wrong == 'reversed' else np.delete(edges, 4)
    angles = 2.0 * np.pi * (other - np.arange(other.size) / other.size)
    file = tmp_path / 'machine.yaml'
    text = re.sub('target_angles: .*', f'target_angles: {angles.tolist()}',
                  (folder / 'machine.yaml').read_text())
    file.write_text(text.replace('revolution: 9', f'revolution: {other.size}'))
    capsys.readouterr()
    for main, declared in ((average.main, '--params'), (close_loop.main, '--declared')):
        assert main([str(folder / 'rig.npz'), declared, str(file), '--output',
                     str(tmp_path / 'out'), '--quiet']) == 2
        said = capsys.readouterr().err
        assert said.count('\n') == 1
        assert f'pulses fit no target of {other.size} marks as declared' in said
        assert 'check_keyphasor finds its marks and their angles' in said


@pytest.mark.machines
def test_a_file_without_orders_names_none_and_is_taken(checked, capsys):
    """It says what to add; averager and predictor take orders of their own meanwhile."""
    folder = checked(60, orders=())
    run_all(folder, capsys)
    text = (folder / 'machine.yaml').read_text()
    assert '# No order is known: add those of interest, as in shaft.orders: [1.0, 2.0], to' in text
    assert text.count('shaft.orders') == 1


def test_an_order_that_one_average_refuses_gives_no_delay_and_no_warning():
    def item(speed, refused):
        return SimpleNamespace(
            trigger_speed=speed, orders=np.array([1.0, 2.0]),
            amplitudes=np.array([[np.exp(0.01j * speed), np.nan if refused else 1.0]]),
            noise=np.array([[0.01, np.nan if refused else 0.01]]))

    with warnings.catch_warnings():
        warnings.simplefilter('error')
        for refused in ((False, True), (True, True)):
            items = [item(20.0 + k, refused[k % 2]) for k in range(8)]
            found = path_delay(items, 1.0)
            assert (found.value, found.decided_by) == (
                None, 'fewer than two orders stand clear of their noise at all speeds')


# --- measured machines ---------------------------------------------------------------------------

EDGES = [(f'engine_edges_{name}', {'pulse_times': f'edges_{k}'}) for name, k in (
    ('4b11_running', 1), ('4b11_running', 2), ('civic_K20_cranking', 1),
    ('civic_K20_cranking', 2), ('toyota_3_tooth_cam', 1), ('toyota_3_tooth_cam', 2))]
RECORDINGS = [
    *EDGES, ('crank_vr_60_2', {}), ('crank_vr_60_2', {'tach': 'tach_4'}), ('gear0_gearbox', {}),
    *((f'motor_{name}', {}) for name in ('10V_100kHz', '30V_100kHz', 'runup_20V_40kHz')),
    *((f'rotorbalancer_{name}', {'acquisition': k})
      for name, k in (('weight', 0), ('weight_5', 6), ('without_weight', 3))),
    ('turbine_20130316', {}), ('uia_bearing_rig_1', {}),
    ('encoder_motor_slow', {})]
#: Marks, missing teeth, clock in Hz and mean speed in Hz, of which the check is told nothing.
KNOWN = {'gear0_gearbox': (1, 0, None, 33.33), 'motor_30V_100kHz': (8, 0, 100e3, 94.4),
         'motor_runup_20V_40kHz': (8, 0, 40e3, 38.3), 'turbine_20130316': (2, 0, 1e8, 30.03)}


def cut(recording, seconds, channels=None):
    """Return the first seconds of a recording, and all or the first channels."""
    vibration = recording.read()[:channels, :int(seconds * recording.sample_rate)]
    changes = {} if channels is None else {'channel_names': (), 'units': ()}
    if recording.pulse_times is not None:
        changes['pulse_times'] = recording.keyphasor_pulses(duration=seconds)
    if (tach := recording.read_tach()).size:
        changes['tach'] = ArraySource(tach[None, :int(seconds * recording.tach_rate)])
    return replace(recording, vibration=ArraySource(vibration), **changes)


@pytest.mark.machines
@pytest.mark.filterwarnings('ignore::sa_jitter_ros.errors.DataWarning')
@pytest.mark.parametrize(('name', 'fields'), RECORDINGS)
def test_machine_files_of_measured_recordings_are_taken(shared_data, tmp_path, name, fields):
    """Other warnings than those for users, as numpy gives them, are errors in all tests."""
    path = shared_data / f'{name}.npz'
    recording = read(path, pulses_suffice=True, **fields)
    if recording.samples * recording.channels > 200_000:  # all would be corrected
        recording, path = cut(recording, 2.5, channels=1), tmp_path / path.name
        write_npz(path, recording)
    if name in KNOWN:
        check = keyphasor.check_keyphasor(replace(recording, pulses_per_revolution=1, orders=()))
        marks, missing, clock, speed = KNOWN[name]
        found = {key: item.value for key, item in check.findings.items()}
        assert (found['pulses_per_revolution'], found['missing_teeth']) == (marks, missing)
        assert found['speed']['mean'] == pytest.approx(speed, rel=0.005)
        assert found['clock_rate'] == (clock and pytest.approx(clock, rel=1e-6))
    else:
        check = keyphasor.check_keyphasor(recording)
    file = tmp_path / 'machine.yaml'
    file.write_text(machine_file(check, path.name))
    values = averager_values(MachineFile.read(file), recording)
    if recording.samples == 1:
        streaming_averager(values, buffer_seconds=1.0)
        assert read_declaration(file).models
        return
    row = average_file(AverageJob(name, str(path), str(tmp_path / 'averages'),
                                  machine=MachineFile.read(file), options=fields, figures=False))
    assert (row.error, row.averages > 0) == ('', True)
    for model in read_declaration(file, sample_rate=recording.sample_rate).models.values():
        record_pulses(recording, model)
        if recording.samples * recording.channels > 20_000:  # of all the loop is slow
            seen = recording.keyphasor_pulses()
            last = int(2.0 * model.trigger_cycles * model.revolutions_per_trigger
                       * model.pulses_per_revolution)
            recording = cut(recording, seen[min(last, seen.size - 1)] - recording.start_time)
            seen = recording.keyphasor_pulses(duration=recording.duration)
            model = replace(model, trigger_speed=(seen.size - 1) / np.ptp(seen)
                            / model.pulses_per_revolution)
        assert observe(recording, model).acquisitions
