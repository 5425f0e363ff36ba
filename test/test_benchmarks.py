# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
The benchmarks run, on small sizes, and find the accuracy that their page states.

How fast they find the package depends on what else the machine does: no test asserts it.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
import importlib
import json
import os
from pathlib import Path
import re
import subprocess
import sys

import numpy as np
import pytest
import sa_jitter_ros as sa
from sa_jitter_ros.recordings import ArraySource, read
from sa_jitter_ros.recordings.npz_format import write_npz

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / 'benchmarks'


@pytest.fixture
def benchmark():
    """Return the function that imports a module of the benchmarks."""
    return importlib.import_module


@pytest.mark.parametrize('name', sorted(path.stem for path in FOLDER.glob('*.py')))
def test_every_benchmark_finds_what_it_imports(benchmark, name):
    benchmark(name)


def test_core_is_as_accurate_as_its_page_says(benchmark):
    peers = benchmark('peers')
    for ratio in (1.0, 2.40789):
        record = peers.make_record(channels=2, seconds=1.0, ratio=ratio)
        gain = {name: peers.gains(record, method(record))
                for name, method in peers.METHODS.items()}
        for name in ('sa_jitter_ros, on line', 'sa_jitter_ros, resampling and mean'):
            assert np.abs(gain[name]).max() < 0.01
        assert np.all(gain['quintic spline'][-1] < -0.03)
        # sinc^2, the loss of linear interpolation, and what of it MATLAB's algorithm shows
        bands = np.array(record.orders) * ratio * peers.SPEED / record.rate
        expected = 40.0 * np.log10(np.sinc(bands))
        for name in ('tsa linear', 'sa_jitter_ros, resampling and mean, linear'):
            np.testing.assert_allclose(gain[name], expected, rtol=0.05)


@pytest.mark.machines
@pytest.mark.parametrize('values', [
    {'snr': 0.0}, {'snr': 10.0, 'scale': 5.0}, {'snr': 20.0, 'ratio': 0.25},
    {'snr': 15.0, 'cycles': 10}])
def test_a_corrected_amplitude_is_no_worse_and_not_biased(benchmark, values):
    campaign = benchmark('correction_campaign')
    outcome = campaign.trials(campaign.Case(**values), 16, 11)
    ratio, spread = outcome.mean_square_ratio()
    assert ratio < 1.02 + 3.0 * spread
    bias, error = outcome.bias()
    if values['snr'] >= 10.0:
        assert abs(bias) < 5e-3 + 3.0 * error
        assert error < 5e-3
        assert outcome.accepted == 1.0
        raw = np.abs(outcome.raw).mean(axis=0) - np.abs(outcome.true).mean(axis=0)
        assert raw[1] < -0.01


@pytest.mark.machines
def test_intervals_of_corrected_amplitudes_hold_in_many_settings(benchmark):
    """
    Over all settings together to 3 points, beside what few averages scatter.

    Lines of another shaft that a few cycles do not tell make intervals too safe;
    `test_averaging_other_lines.py` has more of these.
    """
    campaign, trials, shares = benchmark('interval_coverage'), 1, {False: [], True: []}
    for number, setting in enumerate(campaign.SETTINGS):
        if setting.another_shaft and setting.ratio != 1.0:
            continue
        corrected, _, below = campaign.setting_distances(setting, trials, seed=5000 + number)
        assert len(corrected) == trials
        shares[setting.another_shaft] += np.mean([
            np.abs(corrected) < 1.0, np.abs(corrected) < 1.96, below], axis=2).T.tolist()
    wanted = np.array([0.683, 0.95, 0.95])
    for another_shaft, found in shares.items():
        # of three orders or more, which scatter by themselves at best
        error = np.maximum(np.std(found, axis=0), np.sqrt(wanted * (1.0 - wanted) / 3.0)
                           ) / np.sqrt(len(found))
        off = np.mean(found, axis=0) - wanted
        assert np.all(off > -0.03 - 3.0 * error)
        if not another_shaft:
            assert np.all(off[:2] < 0.03 + 3.0 * error[:2])


@pytest.mark.campaign
def test_recordings_with_different_keyphasors_share_one_scale(benchmark, tmp_path):
    scale = benchmark('fleet_scale')
    found = scale.fleet(3, 2, tmp_path)
    assert {item.raw.size for item in found.values()} == {2}
    for (width, order), item in found.items():
        known = np.isfinite(item.corrected)
        assert known.all() or width == scale.WIDTHS[-1]
        distance = (item.corrected - item.true)[known] / item.error[known]
        assert np.abs(distance).max() < 4.0
        assert np.abs(distance.mean()) < 4.0 / np.sqrt(known.sum())
        assert np.all(item.error[known] < 0.05 * item.true[known])
        if width > 0.1:
            assert np.all(item.raw < item.true - 4.0 * item.error[known].max()), order
    assert '| 46 | 0.4 mesh periods | 2 |' in scale.fleet_table(found)
    assert len(scale.fleet_figure(found).axes) == 4


@pytest.mark.campaign
def test_a_measured_gearbox_has_one_scale_at_all_clocks(benchmark, shared_data, tmp_path):
    scale = benchmark('fleet_scale')
    whole, path = read(shared_data / 'gear0_gearbox.npz'), tmp_path / 'gear0.npz'
    pulses = whole.reference_pulse_times[:90]
    write_npz(path, replace(
        whole, vibration=ArraySource(whole.read()[:2, :int(whole.sample_rate * pulses[-1])]),
        reference_pulse_times=pulses, channel_names=(), units=()))
    found = scale.gearbox(path, (3300.0, 9100.0), tmp_path)
    for item in found.values():
        assert np.all(np.abs(item.corrected - item.true) < 4.0 * item.error)
    slow, fast = found['3300 Hz', 46.0], found['9100 Hz', 46.0]
    assert np.median(slow.raw / fast.raw) < 0.9
    assert np.median(np.abs(slow.corrected / fast.corrected - 1.0)) < 2e-3
    assert scale.gearbox_figure(found).axes


@pytest.mark.machines
def test_jitter_of_strong_orders_is_no_noise_of_absent_ones(benchmark):
    coverage, trials = benchmark('interval_coverage'), 200
    raw, _ = coverage.coverage(coverage.Case(5, 40.0, 0.8, correct=False), trials, seed=1)
    # of few cycles in so large a jitter they are too safe, by up to 10 points (docs/theory.md)
    for width, wanted, safe in ((1.0, 0.683, 0.1), (1.96, 0.95, 0.03)):
        off = np.mean(np.abs(raw.amplitude['absent']) < width) - wanted
        error = 3.0 * np.sqrt(wanted * (1.0 - wanted) / trials)
        assert -0.03 - error < off < safe + error
    assert raw.upper['absent'].mean() > 0.92


@pytest.mark.parametrize(('uniform', 'distribution'), [(True, 'uniform'), (False, 'normal')])
def test_drawn_strong_amplitudes_are_those_that_are_predicted(benchmark, uniform, distribution):
    drawn = benchmark('interval_coverage').strong_amplitudes(5, 0.8, uniform, 20000, seed=1)
    std = 0.8 / (2.0 * np.pi * 16.0 * 25.0)
    wanted = sa.predict(keyphasor_rate=1.0 / (np.sqrt(12.0) * std), trigger_speed=25.0,
                        trigger_cycles=5, orders=[16.0], jitter_distribution=distribution,
                        jitter_std=0.0 if uniform else std)
    assert drawn.mean() == pytest.approx(wanted.mean_attenuation[0], rel=3e-3)
    assert drawn.std() == pytest.approx(wanted.standard_deviation[0], rel=0.03)


@pytest.mark.campaign
def test_average_is_timed_as_a_user_starts_it(benchmark):
    found = benchmark('average_speed').measured(2.5, 1)
    assert found.keys() == {'start', 'average', 'corrected'}
    assert min(found.values()) > 0.0


def test_methods_are_timed_in_turns(benchmark):
    calls = []
    timings = benchmark('timing').interleaved(
        {'a': lambda: calls.append('a'), 'b': lambda: calls.append('b')}, rounds=3)
    assert calls == ['a', 'b'] * 3
    assert timings['a'].runs == 3
    assert 0.0 <= timings['a'].best <= timings['a'].median


@pytest.mark.campaign
def test_memory_does_not_grow_with_the_record(benchmark):
    _, short, _, long = benchmark('core_speed').memory(0.1).values()  # 1 and 4 s
    assert long < 1.05 * short


def run(script, *arguments, environment):
    """Run a benchmark and return what it found."""
    done = subprocess.run([sys.executable, FOLDER / script, *arguments], capture_output=True,
                          env={**environment, 'OMP_NUM_THREADS': '1', 'PYTHONPATH': str(ROOT)},
                          text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.campaign
def test_page_is_written_from_small_runs(
        benchmark, process_environment, tmp_path, monkeypatch, capsys):
    page, performance, found = benchmark('page'), benchmark('performance'), {}
    monkeypatch.setenv('OMP_NUM_THREADS', '1')
    monkeypatch.setattr(os, 'cpu_count', lambda: 1)
    loops = benchmark('loop_speed')
    monkeypatch.setattr(loops, 'LOOPS', [(0.0, 10000.0, (1.0,), 1)])
    monkeypatch.setattr(loops, '_SHORTEST', 3.0)  # too short to trace anything in, and quick
    with ThreadPoolExecutor() as pool:  # the graph waits for its processes most of the time
        graph = pool.submit(run, 'graph_speed.py', '--channels', '2', '--large', '2', '--seconds',
                            '4', '--latency-seconds', '0', environment=process_environment)
        for name in ('core', 'loop'):
            monkeypatch.setattr(sys, 'argv', [name, '--scale', '0.03', '--rounds', '1'])
            assert benchmark(f'{name}_speed').main() == 0
            found[name] = json.loads(capsys.readouterr().out)
        found['graph'] = graph.result()
    graph, large = found['graph']['runs']
    assert graph['averages'] > 10
    assert large['peak_megabytes'] > graph['peak_megabytes'] + 32.0  # of shared memory
    assert 0.0 < graph['data_median'] <= graph['data_99']
    assert found['loop']['prediction'].keys() >= {'uniform, 40 trigger cycles'}
    text = page.fill((ROOT / 'docs' / 'performance.md').read_text(), performance.sections(found))
    assert '| quintic spline |' in text
    assert page.fill(text, performance.sections(found)) == text
    performance.draw(found, tmp_path)
    assert len(list(tmp_path.glob('performance-*.png'))) == 3


def test_machines_of_another_simulator_attenuate_as_theory_says(benchmark):
    effects, machines = benchmark('independent_effects'), benchmark('independent_machines')
    machine = effects.draw_case((), 0).machine
    observed = machines.attenuation(machine, machines.Disturbance(), np.random.default_rng(1))
    width = machine.orders * machine.ratio * machine.speed / machine.keyphasor_rate
    # E|X|, not |E X|: Var Im of the average adds half of itself over N_t
    share = (np.arange(1000) + 0.5) / 1000
    gain = np.mean(np.sinc(width[:, None] * (1.0 - share)) * np.sinc(width[:, None] * share),
                   axis=1)
    extra = (2.0 * np.pi * width) ** 2 / 24.0 / machine.trigger_cycles
    error = observed.std(axis=0) / np.sqrt(len(observed))
    assert np.all(np.abs(observed.mean(axis=0) - gain - extra) < 4.0 * error + 0.2 * extra)


@pytest.mark.usefixtures('unasked')
@pytest.mark.campaign
@pytest.mark.parametrize(('effects', 'seed', 'row'), [
    ((), 4, '| declared model | 1 | 1 | 1 - |'),  # an order between the lines of the trigger cycle
    (('excess_jitter',), 0, '| excess_jitter | 1 | 1 | 1 excess_jitter |')])
def test_loop_is_judged_on_machines_of_another_simulator(benchmark, tmp_path, effects, seed, row):
    confusion = benchmark('independent_confusion')
    run = confusion.judge(effects, seed, tmp_path)
    assert run.right, run
    assert all(abs(z) < 4.0 for z in run.errors.values())
    assert run.after.rms < 0.5 * run.before.rms or not effects  # six acquisitions to fit
    assert run.near
    assert row in confusion.table([run])
    assert '| on the lines | 0 to 0.01 | 4 | ' in confusion.reliability([run])
    assert row.split('|')[1] in confusion.scores([run])


def test_page_without_a_section_is_refused(benchmark):
    with pytest.raises(ValueError, match='no section'):
        benchmark('page').fill('nothing', {'core': ''})


@pytest.mark.campaign
@pytest.mark.usefixtures('undrawn', 'unasked')
def test_measured_cases_are_run_as_a_user_does(benchmark, tmp_path):
    cases, machines = benchmark('measured_cases'), benchmark('trace_confusion')
    taken = machines.recording(machines.machine((), seed=1), 8.1)
    np.savez(tmp_path / 'machine.npz', vibration=taken.read(), sample_rate=taken.sample_rate,
             pulse_times=taken.pulse_times)
    model = {'keyphasor_rate': machines.KEYPHASOR_RATE, 'trigger_speed': machines.SPEED,
             'orders': list(machines.ORDERS), 'noise_std': machines.NOISE}
    stored = [cases.stored('machine.npz')]
    used, short, refused = (
        cases.run(cases.Case(title, stored, {**model, 'trigger_cycles': count}), tmp_path)
        for title, count in (('used', 20), ('short', 100), ('refused', 1000)))
    assert used.content['verdict'] == short.content['verdict'] == 'none'
    assert 'fitting and scoring take at least 4' in short.content['remarks'][-1]
    assert 'do not make an acquisition' in refused.error
    lines = cases.table([used, short, refused], 'machine').splitlines()
    assert {line.count('|') for line in lines} == {11}
    assert lines[2].startswith('| used | 5 | none | - | - | 0.0% |')
    assert cases.error_figure([used]).axes


@pytest.mark.campaign
def test_fault_campaign_finds_no_wrong_average_and_writes_its_page(
        benchmark, process_environment, tmp_path):
    page = tmp_path / 'reliability.md'
    page.write_text((ROOT / 'docs' / 'reliability.md').read_text())
    done = subprocess.run(
        [sys.executable, FOLDER / 'fault_campaign.py', '--scenes', '2', '--seed', '3', '--numbers',
         tmp_path / 'faults.json', '--page', page, '--figures', tmp_path], capture_output=True,
        env={**process_environment, 'OMP_NUM_THREADS': '1', 'PYTHONPATH': str(ROOT)}, text=True,
        check=False)
    assert (tmp_path / 'faults.json').is_file(), done.stdout + done.stderr
    found = json.loads((tmp_path / 'faults.json').read_text())
    # on a machine that has other things to do averages come late, and are missed
    late = [item for item in found['wrong'] if 'no average after' in item]
    assert found['wrong'] == late, done.stdout + done.stderr
    assert not found['died']
    assert sum(found['faults'].values()) > 15
    assert min(found['averages'].values()) > 5
    assert found['corrected']['corrected'] > 2
    assert f'**failed checks: {len(late)}**' in page.read_text()
    assert (tmp_path / 'reliability-faults.png').exists()


@pytest.mark.campaign
def test_fault_replay_finds_no_wrong_average(benchmark, capsys):
    assert benchmark('fault_replay').main(['--scenes', '2', '--seed', '70001']) == 0
    for line in capsys.readouterr().out.splitlines():
        scenes, averages, wrong = re.findall(r'\d+', line)
        assert (int(scenes), int(wrong)) == (2, 0)
        assert int(averages) > 5


def test_soak_says_which_averages_a_full_queue_lost(benchmark):
    soak = benchmark('soak')
    sequence = [k for k in range(40) if k not in (20, 21)]  # of a silence that 12 averages filled
    latency = [max(0.02, 8.0 - 0.25 * (k + 1)) if 20 <= k < 32 else 0.02 for k in sequence]
    found = {'sequence': sequence, 'end': [0.25 * (k + 1) for k in sequence], 'latency': latency,
             'published': 40}
    assert soak.overwritten(found) == (2, pytest.approx(8.0 - 5.02))
    every = {key: list(range(40)) for key in ('sequence', 'end', 'latency')}
    assert soak.overwritten({**every, 'published': 40}) == (0, np.inf)


def test_process_that_has_ended_holds_no_memory(benchmark):
    resident = benchmark('graph_speed').resident
    assert resident(os.getpid()) > 10.0
    with subprocess.Popen([sys.executable, '-c', '']) as process:
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)  # a zombie, as poll() left it
        assert resident(process.pid) is None


@pytest.mark.campaign
def test_soak_follows_memory_and_writes_its_page(process_environment, tmp_path):
    page = tmp_path / 'reliability.md'
    page.write_text((ROOT / 'docs' / 'reliability.md').read_text())
    done = subprocess.run(
        [sys.executable, FOLDER / 'soak.py', '--minutes', '0.15', '--channels', '2', '--numbers',
         tmp_path / 'soak.json', '--page', page, '--figures', tmp_path], capture_output=True,
        env={**process_environment, 'OMP_NUM_THREADS': '1', 'PYTHONPATH': str(ROOT)}, text=True,
        check=False)
    assert (tmp_path / 'soak.json').exists(), done.stdout + done.stderr
    found = json.loads((tmp_path / 'soak.json').read_text())
    assert found['expected'] > 30
    assert len(found['end']) > 10
    assert min(found['latency']) > 0.0
    assert found['sequence'] == sorted(set(found['sequence']))
    assert {'synchronous_averager', 'jitter_predictor', 'source'} == found['rss'].keys()
    assert '| jitter_predictor |' in page.read_text()
    assert (tmp_path / 'soak.png').exists()


@pytest.mark.campaign
def test_months_of_averages_are_simulated(benchmark):
    monitor = benchmark('change_monitor')
    found, years = monitor.false_alarms(monitor.CASES[0], 12, 1.0 / 12.0, seed=1)
    assert years == pytest.approx(1.0, rel=0.01)
    assert found <= years + 4.0 * np.sqrt(years)
    faults = [*monitor.detections(60, seed=2, months=2)]
    assert len(faults) >= 15  # others had an alarm before, one a year, or began later
    quick = [days for kind, growth, days, known in faults
             if kind == 'order, noise 1 %' and growth > 0.1 and known]
    assert quick
    assert all(days < 5.0 for days in quick)


@pytest.mark.machines
@pytest.mark.usefixtures('undrawn')
def test_a_damaged_recording_ends_in_one_line_or_with_a_report(benchmark, capsys):
    assert benchmark('damaged_recordings').main(['--first', '17', '--count', '3']) == 0
    assert capsys.readouterr().out.startswith('status 0: 1, status 2: 2; ')


@pytest.mark.usefixtures('unasked')
@pytest.mark.machines
def test_the_loop_counts_marks_alike_in_recordings_that_begin_at_any_of_them(benchmark, capsys):
    compare = benchmark('channels_and_cuts')
    assert compare.main([
        '--effects', 'target_geometry', '--machines', '1', '--first', '40087', '--ways', 'cut'
    ]) == 0
    assert 'cut: 1 of 1 alike' in capsys.readouterr().out
