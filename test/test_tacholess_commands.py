# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Commands on recordings without a tach: what they write and refuse; and parts of the search."""

import csv

import numpy as np
import pytest
from sa_jitter_ros.commands import average, check_keyphasor, close_loop
from sa_jitter_ros.tacholess.evidence import best_path, comb, spectra_of, without
from sa_jitter_ros.tacholess.lines import demodulated, first_correction, noise_power
from scipy.interpolate import CubicSpline

RATE = 4096.0
SECONDS = 16.0
TACHOLESS = ['--tacholess', '12', '28']
MODEL = """
jitter_predictor:
  ros__parameters: {keyphasor_rate: 100000.0, trigger_speed: 18.0, trigger_cycles: 40,
                    orders: [19.0, 38.0]}
"""


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """Return a folder with a recording without a tach, one whose tach was lost, and a model."""
    folder = tmp_path_factory.mktemp('tacholess')
    rng = np.random.default_rng(7)
    time = np.arange(int(SECONDS * RATE)) / RATE
    knots = np.arange(-1.0, SECONDS + 2.0)
    angle = CubicSpline(knots, 18.0 + 0.1 * rng.standard_normal(knots.size)).antiderivative()
    turns = angle(time)
    vibration = sum(np.cos(2.0 * np.pi * order * turns) for order in (19.0, 38.0)
                    ) + rng.standard_normal((2, time.size))
    fields = {'vibration': vibration, 'sample_rate': RATE, 'orders': [19.0, 38.0]}
    np.savez(folder / 'rig.npz', **fields)
    marks = np.arange(np.ceil(turns[0]), np.floor(turns[-1]))
    pulses = np.delete(np.interp(marks, turns, time), np.r_[100:120])
    np.savez(folder / 'lost.npz', **fields, pulse_times=pulses)
    np.savez(folder / 'noise.npz', **(fields | {'vibration': rng.standard_normal((1, 60_000))}))
    (folder / 'model.yaml').write_text(MODEL, encoding='utf-8')
    return folder


def test_average_without_a_tach(folder, capsys):
    output = folder / 'averages'
    assert average.main([str(folder / 'rig.npz'), *TACHOLESS, '--output', str(output),
                         '--no-figures']) == 0
    said = capsys.readouterr().err
    assert 'no tach: ' in said
    assert 'phase 0 is arbitrary' in said
    with np.load(output / 'rig' / 'found_pulses.npz') as found:
        assert found['used_orders'].tolist() == [19.0, 38.0]
        assert found['pulse_times'].size > 250
        assert np.all(np.diff(found['pulse_times']) > 0.0)
    with open(output / 'averages.csv', encoding='utf-8') as file:
        rows = list(csv.DictReader(file))
    assert {float(row['order']) for row in rows} == {19.0, 38.0}
    for row in rows:
        corrected = float(row['corrected_amplitude'])
        error = float(row['corrected_standard_error'])
        assert float(row['attenuation']) > 1.0  # its noise is aligned with itself
        assert corrected < float(row['raw_amplitude'])
        assert abs(corrected - 1.0) < 5.0 * error


@pytest.mark.machines
def test_lost_tach_is_bridged(folder, capsys):
    assert average.main([str(folder / 'lost.npz'), *TACHOLESS, '--bridge-tach', '--output',
                         str(folder / 'bridged'), '--no-figures']) == 0
    assert '20 pulses that the tach lost were found in the vibration' in capsys.readouterr().err


@pytest.mark.machines
@pytest.mark.usefixtures('undrawn', 'unasked')
def test_check_and_loop_without_a_tach(folder, capsys):
    assert check_keyphasor.main([str(folder / 'rig.npz'), *TACHOLESS, '--output',
                                 str(folder / 'found'), '--quiet']) == 0
    assert 'pulses_per_revolution  1' in capsys.readouterr().out
    assert close_loop.main([str(folder / 'rig.npz'), *TACHOLESS, '--quiet', '--declared',
                            str(folder / 'model.yaml'), '--output', str(folder / 'loop')]) == 0
    said = capsys.readouterr()
    assert 'phase 0 is arbitrary' in said.err
    assert 'verdict: none' in said.out
    assert (folder / 'loop' / 'report.json').exists()


@pytest.mark.parametrize(('words', 'message'), [
    (['rig.npz', '--tacholess', '28', '12'], 'speed_range is [28.0, 12.0]'),
    (['rig.npz', '--tacholess', '12', '9000'], 'sample_rate of 4096 Hz'),
    (['rig.npz', '--comb', '19'], 'belong to --tacholess'),
    (['noise.npz', *TACHOLESS], 'stand out'),
    (['rig.npz'], 'no keyphasor'),
])
def test_refusals_are_one_line_and_write_nothing(folder, words, message, capsys):
    output = folder / 'refused'
    name, *rest = words
    assert average.main([str(folder / name), *rest, '--output', str(output), '--quiet']) == 2
    said = capsys.readouterr().err.strip()
    assert message in said
    assert '\n' not in said
    assert not list(output.glob('*/averages.npz'))


@pytest.mark.machines
def test_orders_of_the_machine_file_and_a_second_run(folder, capsys):
    """The comb follows from the gears; what is finished is skipped, unless the range differs."""
    (folder / 'machine.yaml').write_text("""
/**:
  ros__parameters:
    machine:
      tach_shaft: input
      gears: {stage: {shaft: input, teeth: 19, mate_shaft: output, mate_teeth: 61}}
/**/synchronous_averager:
  ros__parameters: {trigger_cycles: 40}
""", encoding='utf-8')
    output = folder / 'geared'
    words = [str(folder / 'rig.npz'), '--params', str(folder / 'machine.yaml'), '--no-figures',
             '--output', str(output), '--tacholess', '12']
    times = []
    for high in ('28', '28', '27'):
        assert average.main([*words, high]) == 0
        times.append((output / 'rig' / 'averages.npz').stat().st_mtime_ns)
    assert times[0] == times[1] < times[2]
    # Of 19, 38 and 57 the third has no line: two of three are enough, and only they are used.
    assert 'pulses from orders 19, 38, at ' in capsys.readouterr().err


@pytest.mark.machines
@pytest.mark.usefixtures('undrawn', 'unasked')
def test_loop_of_a_folder_without_a_tach(folder):
    several = folder / 'several'
    several.mkdir()
    (several / 'rig.npz').write_bytes((folder / 'rig.npz').read_bytes())
    (several / 'noise.npz').write_bytes((folder / 'noise.npz').read_bytes())
    assert close_loop.main([str(several), *TACHOLESS, '--quiet', '--declared',
                            str(folder / 'model.yaml'), '--output', str(folder / 'loops')]) == 0
    with open(folder / 'loops' / 'loops.csv', encoding='utf-8') as file:
        rows = {row['recording']: row for row in csv.DictReader(file)}
    assert rows['rig']['verdict'] == 'none'
    assert 'stand out' in rows['noise']['error']


def test_evidence_is_for_lines_not_for_noise_or_colour():
    rng = np.random.default_rng(3)
    time = np.arange(40_000) / 4e3
    noise = np.convolve(rng.standard_normal(time.size + 20), np.hanning(8), 'valid')[:time.size]
    vibration = np.stack([noise + 1.0 * np.cos(2.0 * np.pi * 333.0 * time), noise * 0.0 + np.nan])
    spectra = spectra_of(vibration, 4e3, 0.5, 1500.0)
    place = round(333.0 / spectra.step)
    others = np.delete(spectra.evidence, range(place - 3, place + 4), axis=1)
    assert spectra.evidence[:, place].mean() > 2.0
    assert others.mean() < 0.1
    found = comb(spectra, np.array([30.0, 33.3, 35.0]), np.array([10.0, 1000.0]))
    assert np.argmax(found.mean(axis=0)) == 1


def test_best_path_is_the_best_of_all():
    """Against all paths of a small grid, with the costs of its steps."""
    rng = np.random.default_rng(5)
    evidence = rng.standard_normal((5, 6)).astype(np.float32)
    paths = np.stack(np.meshgrid(*5 * [np.arange(6)], indexing='ij'), axis=-1).reshape(-1, 5)
    steps = np.abs(np.diff(paths, axis=1))
    costs = np.select([steps <= 1, steps <= 4], [0.0, 2.0], np.inf).sum(axis=1)
    totals = evidence[np.arange(5), paths].sum(axis=1) - costs
    path, total = best_path(evidence, 4.0)
    assert total == pytest.approx(totals.max(), abs=1e-5)
    assert path.tolist() == paths[np.argmax(totals)].tolist()
    apart = without(evidence, path, np.ones(5, int))
    assert not np.any(np.abs(best_path(apart, 4.0)[0] - path) <= 1)


def test_demodulated_line_is_that_of_the_machine():
    """Cells have its amplitude and the mean of the angle; other whole orders leave nothing."""
    rate = 8e3
    time = np.arange(40_000) / rate
    angle = 20.0 * time + 0.4 * time**2
    vibration = 0.7 * np.cos(2.0 * np.pi * 7.0 * angle + 1.0) + 3.0 * np.cos(
        2.0 * np.pi * 9.0 * angle)
    cells = demodulated(vibration[None], rate, angle, 1, np.array([7.0, 8.0]))
    phases = cells.values[0] / np.abs(cells.values[0])
    assert np.ptp(np.angle(phases * phases[0].conj())) < 1e-3
    level = np.abs(cells.values)
    assert level[1].max() < 0.01 * level[0].min()
    np.testing.assert_allclose(np.interp(cells.times, time, angle), np.round(cells.angle),
                               atol=0.02)


def test_noise_power_of_cells_is_that_of_white_noise():
    rng = np.random.default_rng(6)
    time = np.arange(200_000) / 8e3
    cells = demodulated(rng.standard_normal((1, time.size)), 8e3, 20.0 * time, 1,
                        np.array([7.0, 33.0]))
    values = cells.values / np.sqrt(np.mean(np.abs(cells.values) ** 2, axis=1))[:, None]
    assert noise_power(values).mean() == pytest.approx(4.0 / 3.0, rel=0.1)


def test_first_correction_finds_how_far_a_rough_speed_is_off():
    """A speed that is wrong by 0.3 % turns all lines from cell to cell, each by its order."""
    rng = np.random.default_rng(8)
    time = np.arange(80_000) / 8e3
    vibration = sum(np.cos(2.0 * np.pi * order * 20.0 * time) for order in (17.0, 34.0, 51.0))
    cells = demodulated((vibration + rng.standard_normal(time.size))[None], 8e3,
                        20.0 * 1.003 * time, 1, np.array([17.0, 34.0, 51.0]))
    corrected = cells.angle + first_correction(cells)
    slope = np.polyfit(cells.times, corrected, 1)[0]
    assert slope == pytest.approx(20.0, rel=5e-4)  # two steps of its grid
