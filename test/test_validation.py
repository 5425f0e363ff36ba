# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The reproduction of the paper: its pieces against closed forms, the command from outside."""

from dataclasses import replace
import json
from pathlib import Path

from matplotlib.image import imread
import numpy as np
import pytest
from sa_jitter_ros.averaging.average import AverageSettings
from sa_jitter_ros.errors import SignalError
from scipy.special import ndtr
from validation import angle_laws, bench, reproduce, residual_kurtosis
from validation.monte_carlo import AveragedSignal
from validation.order_tracking import as_in_table_1, HarmonicCase, simulate, synchronous_average
from validation.paper import ITEMS
from validation.report import page
from validation.results import agreement, compare, Finding, one_distribution, QUICK, Results, stage
from validation.single_harmonic import TABLE_3

DOCS = Path(__file__).resolve().parents[1] / 'docs'


def ignore(done):
    """Take progress and do nothing."""


# --- the full simulation ------------------------------------------------------------------------

@pytest.mark.parametrize('case', [
    HarmonicCase(5, 1.0, 0.3),
    HarmonicCase(7, 1.37, 0.35),
    HarmonicCase(6, 3.0, 0.2, ((1.0, 1.0), (2.0, 3.0))),
    HarmonicCase(4, 5.8154, 0.25, ((1.0, 0.5), (3.0, 1.0))),
], ids=str)
def test_simulation_and_exact_model_agree_under_the_same_errors(case):
    simulated = simulate(case, 4, seed=3, progress=ignore)
    orders, amplitudes = zip(*case.harmonics)
    signal = AveragedSignal(case.trigger_cycles, case.cycle_length, 1.0, orders, amplitudes)
    model = signal.whole_fundamental_cycles(simulated.errors)
    assert np.abs(simulated.errors).max() <= 0.5 * case.width
    assert np.abs(simulated.errors).max() > 0.4 * case.width
    # the split between two cycles falls between points of a grid of 256 a revolution
    np.testing.assert_allclose(simulated.amplitudes, model, atol=3e-4 * max(amplitudes))
    np.testing.assert_allclose(simulated.order_amplitudes,
                               signal.whole_trigger_cycles(simulated.errors),
                               atol=1e-4 * max(amplitudes))
    assert np.ptp(np.abs(model)) > 3e-3


def test_simulations_are_independent_and_repeatable():
    case = HarmonicCase(3, 1.0, 0.2)
    first, again, other = (simulate(case, 3, seed=seed, progress=ignore) for seed in (1, 1, 9))
    np.testing.assert_array_equal(first.amplitudes, again.amplitudes)
    assert len(np.unique(np.concatenate([first.errors, other.errors]))) == 6 * 4


def test_coarser_sampling_than_in_table_1_costs_nothing():
    case = HarmonicCase(4, 2.286, 0.2)
    coarse, fine = (simulate(item, 2, seed=5, progress=ignore).amplitudes
                    for item in (case, as_in_table_1(case)))
    np.testing.assert_allclose(coarse, fine, atol=1e-5)


def test_an_average_needs_enough_pulses():
    with pytest.raises(SignalError, match='3 pulses make no average of 5 trigger cycles'):
        synchronous_average(np.zeros((1000, 1)), 1000.0, np.array([0.1, 0.2, 0.3]),
                            AverageSettings(trigger_cycles=5))


# --- statistics ---------------------------------------------------------------------------------

def test_the_test_of_distributions_has_its_level_and_its_power(rng):
    # Of 400 tests of one distribution the count below 5 % is binomial: mean 20, deviation 4.4.
    reference = rng.normal(size=20_000)
    p_values = [compare(rng.normal(size=150), reference).p_value for _ in range(400)]
    assert abs(np.sum(np.array(p_values) < 0.05) - 20) < 4 * 4.4
    shifted = compare(rng.normal(0.5, 1.0, 150), reference)
    assert shifted.sizes == (150, 20_000)
    assert shifted.distance == pytest.approx(2 * ndtr(0.25) - 1, abs=0.12)
    assert shifted.p_value < 1e-4
    same = [replace(shifted, p_value=p) for p in (0.004, 0.5, 0.9)]
    assert one_distribution(same)
    assert not one_distribution([*same, shifted])


def test_agreement_takes_all_conditions():
    assert [agreement(True, True), agreement(True, False), agreement(False)] == [
        'yes', 'partly', 'no']


def test_detection_of_a_shifted_normal_distribution(rng):
    n, shift = 20_000, 1.5
    found = residual_kurtosis.detection(rng.normal(size=n), rng.normal(shift, 1.0, n))
    # standard errors: area below 0.5 / sqrt(n), detection (with its threshold) below 1.5 / sqrt(n)
    assert found.area == pytest.approx(ndtr(shift / np.sqrt(2.0)), abs=2.0 / np.sqrt(n))
    assert found.detection == pytest.approx(ndtr(shift - 1.6449), abs=6.0 / np.sqrt(n))
    alike = np.array([0.0, 1.0, 1.0])
    assert residual_kurtosis.detection(alike, alike).area == 0.5


def test_the_interval_of_the_separation_holds_the_truth(rng):
    # separations 4 and 2; with 12 acquisitions a jackknife covers 92 % rather than 95 %, and the
    # count of 200 has a standard deviation of 3.8
    def values(shift, scatter):
        healthy, faulty = rng.normal(size=(2, 12, 1)) * scatter
        return [healthy, faulty + shift]

    found = [residual_kurtosis.separation_factor(values(4.0, 1.0), values(2.0, 1.0))
             for _ in range(200)]
    assert np.sum([factor.low < 2.0 < factor.high for factor in found]) >= 172
    assert np.median([factor.value for factor in found]) == pytest.approx(2.0, abs=0.25)


def test_linear_law_passes_on_least():
    errors = {law: angle_laws.mean_square_error(law) for law in ('linear', 'quadratic', 'spline')}
    assert errors['linear'] == pytest.approx(2.0 / 3.0, abs=1e-4)  # mean of (1-u)^2 + u^2
    assert errors['quadratic'] == pytest.approx(0.8, abs=1e-4)  # with -+ u(1-u)/2 (1, -2, 1)
    assert errors['spline'] > errors['quadratic']


def test_predicted_ratio_of_two_clocks_with_common_ticks():
    ratios = angle_laws.predicted_ratios(4000, seed=2)
    assert np.all(ratios <= 1.1)
    # small jitter: the mean loses a third of the variance of the phase, the modulus of the
    # average regains half of its variance; the next term is below 6e-4 at order 38
    tick = bench.PINION_SPEED / bench.FAST
    phase = (2.0 * np.pi * np.array(angle_laws.HARMONICS) * tick) ** 2 * (16.0 - 1.0) / 12.0
    expected = 1.0 - phase * (1.0 / 3.0 - 0.5 / bench.TRIGGER_CYCLES)
    errors = ratios.std(axis=0) / np.sqrt(len(ratios))
    assert np.all(np.abs(ratios.mean(axis=0) - expected) < 6e-4 + 4.0 * errors)


def test_noise_widens_the_ratio_with_the_smaller_scatter_from_jitter_more(rng):
    # scatter 1 and 4 from jitter, noise of 1: log of sqrt(2) over sqrt(17/16)
    jitter = rng.normal(size=(400, 1, 2)) * np.array([1.0, 4.0])
    found, error = angle_laws.excess_factor(jitter + rng.normal(size=(400, 4, 2)), [1.0, 4.0])
    assert 0.01 < error < 0.1  # of independent values 1 / sqrt(400) for each sensor
    assert found == pytest.approx(0.5 * np.log(2.0 * 16.0 / 17.0), abs=4.0 * error)


def test_the_bench_is_that_of_table_4():
    vibration, pulses = bench.acquire(bench.machine(sample_rate=9375.0, seed=1))
    assert pulses.size > bench.TRIGGER_CYCLES + 8
    assert vibration.shape[0] / 9375.0 > pulses[-1]
    speed = np.diff(pulses) * bench.TRIGGER_SPEED
    assert np.std(speed) == pytest.approx(2e-3, rel=0.6)  # a handful of independent values
    spectrum = np.abs(np.fft.rfft(vibration[:, 0] * np.hanning(len(vibration))))
    assert np.argmax(spectrum) / len(vibration) * 9375.0 == pytest.approx(1900.0, rel=5e-3)


# --- the command --------------------------------------------------------------------------------

@pytest.fixture(scope='module')
def quick(tmp_path_factory):
    """Return the folder that a quick run has written."""
    folder = tmp_path_factory.mktemp('reproduction') / 'new'
    assert reproduce.main(['--quick', '--output', str(folder)]) == 0
    return folder


@pytest.mark.campaign
def test_the_command_writes_page_numbers_and_figures(quick):
    numbers = json.loads((quick / 'validation.json').read_text(encoding='utf-8'))
    text = (quick / 'validation.md').read_text(encoding='utf-8')
    assert numbers['effort']['iterations'] == QUICK.iterations
    assert len(numbers['groups']) == len(reproduce.GROUPS)
    assert numbers['settings'].keys() <= numbers['groups'].keys()
    assert all(text.endswith('.') for texts in numbers['settings'].values() for text in texts)
    simulations = numbers['groups']['Single harmonic: Tables 1 to 3, Figs. 4 to 6']['simulations']
    assert len(simulations) == len(TABLE_3) == 12
    figures = sorted(path.name for path in (quick / 'figures').iterdir())
    for name in ('fig03', 'fig04', 'fig05-06', 'fig07', 'fig08', 'fig09', 'fig10', 'fig11',
                 'fig15', 'fig16', 'fig17', 'fig18-19', 'fig21'):
        assert f'validation-{name}.png' in figures
        assert f'](figures/validation-{name}.png)' in text
        image = imread(quick / 'figures' / f'validation-{name}.png')
        assert min(image.shape[:2]) > 300
        assert image[..., :3].std() > 0.05
    for finding in numbers['findings']:
        assert finding['ours'].replace('|', '\\|') in text


@pytest.mark.campaign
def test_what_does_not_hang_on_chance_agrees_in_a_quick_run(quick):
    numbers = json.loads((quick / 'validation.json').read_text(encoding='utf-8'))
    found = {(item['item'], item['paper'].split(':')[0]): item['agreement']
             for item in numbers['findings']}
    for item, paper in (
            ('Figs. 4-6', 'simulations and the exact model agree very well'),
            ('Fig. 4a', 'for integer r the approximate model coincides with the exact one'),
            ('Fig. 7', 'simulations and the exact model agree'),
            ('Fig. 7b', 'r = 1'), ('Fig. 3a', 'the mean of g1'),
            ('Fig. 3', 'g2 dominates the variance, g1 the mean')):
        assert found[item, paper] == 'yes'
    means = {number: item['exact']['mean'] for number, item in numbers['groups'][
        'Single harmonic: Tables 1 to 3, Figs. 4 to 6']['simulations'].items()}
    # E|X| = |m| + half the variance across the mean / |m|; 4 standard errors of 3000 draws
    assert means['9'] == pytest.approx(0.98908 + 0.0162 / 100, abs=1e-4)
    assert means['11'] == pytest.approx(0.83484 + 0.2467 / 100, abs=2e-3)


def test_the_published_page_is_one_run_of_the_full_command():
    numbers = json.loads((DOCS / 'validation.json').read_text(encoding='utf-8'))
    text = (DOCS / 'validation.md').read_text(encoding='utf-8')
    assert f'    {numbers["command"]}\n' in text
    assert '--quick' not in numbers['command']
    for finding in numbers['findings']:
        ours = finding['ours'].replace('|', '\\|')
        agrees = ': '.join(filter(None, (finding['agreement'], finding['why'])))
        assert f'| {ours} | {agrees} |' in text


def test_every_table_and_figure_of_the_paper_is_on_the_page():
    kinds = {'Fig.': set(), 'Table': set()}
    for item in ITEMS:
        kind, numbers = item.name.replace('Figs.', 'Fig.').split()
        first, _, last = numbers.partition('-')
        kinds[kind].update(range(int(first), int(last or first) + 1))
    assert kinds == {'Fig.': set(range(1, 22)), 'Table': set(range(1, 6))}
    modules = {group.__name__.rpartition('.')[2] for group in reproduce.GROUPS}
    assert {item.module for item in ITEMS} == modules - {'printed_equations'} | {''}


def test_a_page_tells_what_disagrees():
    group = Results('Group', {}, (Finding('Fig. 0', 'a|b', 'c', 'no', 'd'),), {})
    text = page({'single_harmonic': group}, 'reproduce --output docs')
    assert '| Fig. 1, Fig. 2, Figs. 12-14, Fig. 20 | nothing: ' in text
    assert '0 are reproduced, 0 partly, 1 not' in text
    assert '| Fig. 0 | a\\|b | c | no: d |' in text


@pytest.mark.parametrize(('arguments', 'message'), [
    (['--iterations', '10'], '--iterations is 10: give at least 1000'),
    (['--simulations', '0'], '--simulations is 0: give at least 2'),
    (['--iterations', 'many'], "invalid int value: 'many'"),
    (['--fast'], 'unrecognized arguments: --fast'),
    (['--output', '/proc/nowhere'], '/proc/nowhere'),
])
def test_bad_input_is_one_line_and_status_2(capsys, arguments, message):
    try:
        status = reproduce.main(arguments)
    except SystemExit as stop:
        status = stop.code
    error = capsys.readouterr().err
    assert status == 2
    assert message in error
    assert error.count('\n') == 1


def test_progress_goes_to_stderr(capsys):
    progress = stage(reproduce.show(2, 'title'), 1, 2)
    for done in (0.0, 0.5, 0.501, 1.0):
        progress(done)
    captured = capsys.readouterr()
    assert captured.out == ''
    assert captured.err.splitlines() == [
        f'reproduce: 2/{len(reproduce.GROUPS)} title: {percent} %' for percent in (50, 70, 100)]
