# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The likelihood of the timing: what it finds, how surely, and what it cannot see."""

from copy import copy
from dataclasses import replace
from functools import partial

from hypothesis import given, settings, strategies as st
import limit_coverage
from limit_coverage import limit_of, lines, MODEL, recovered_source, UNIT
import numpy as np
import pytest
from sa_jitter_ros.effects import EFFECTS
from sa_jitter_ros.effects.clock_skew import ClockSkew
from sa_jitter_ros.effects.correlated_jitter import CorrelatedJitter
from sa_jitter_ros.effects.effect import largest_power
from sa_jitter_ros.effects.excess_jitter import ExcessJitter
from sa_jitter_ros.effects.lattice import smooth_on_grid
from sa_jitter_ros.effects.timing import MOTION, SOURCE
from sa_jitter_ros.inference import limits
from sa_jitter_ros.inference.limits import largest
from sa_jitter_ros.inference.timing import read_timing, refitted
from sa_jitter_ros.inference.timing_choice import Chooser, SIDEBANDS
from sa_jitter_ros.inference.timing_data import steering, TimingData
from sa_jitter_ros.inference.timing_fit import JITTER, TimingFit
from scipy import stats

#: A stretch, of pulses enough for most of what is asked.
machine = partial(limit_coverage.machine, count=300)


def names_of(timing):
    return {finding.name for finding in timing.findings} - {'speed_fluctuation'}


def value_of(timing, name, parameter):
    finding = next(item for item in timing.findings if item.name == name)
    return finding.effect.values[parameter], finding.standard_errors.get(parameter)


CASES = {
    'excess_jitter': ({'excess': 1.5}, ('std', 1.5 * UNIT)),
    'jitter_scale': ({'scale': 0.6}, ('scale', 0.6)),
    'correlated_jitter': ({'excess': 1.2, 'rho': 0.7}, ('std', 1.2 * UNIT)),
    'clock_skew': ({'skew': 2e-5}, ('skew', 2e-5)),
    'phase_wander': ({'wander': 1.0}, ('std', 2.0 * np.pi * MODEL.fundamental_frequency * UNIT)),
    'path_delay': ({'delay': 0.02, 'swing': 2e-3}, ('delay', 0.02)),
}


@pytest.mark.machines
@pytest.mark.parametrize('name', CASES)
def test_effect_is_found_with_its_size(name):
    sizes, (parameter, truth) = CASES[name]
    timing = read_timing([machine(0, **sizes)])
    assert names_of(timing) == {name}
    value, error = value_of(timing, name, parameter)
    assert abs(value - truth) < 3.0 * error
    assert timing.probabilities[name] > 0.45  # half of it, where two names share the power


@pytest.mark.machines
def test_parameters_that_fit_more_pulses_are_surer():
    first, second = machine(3, skew=2e-5), machine(4, skew=2e-5)
    timing = read_timing([first])
    _, again = refitted(timing, [first, second], [])
    assert names_of(again) == names_of(timing) == {'clock_skew'}
    assert again.probabilities == timing.probabilities
    value, error = value_of(again, 'clock_skew', 'skew')
    assert error == pytest.approx(value_of(timing, 'clock_skew', 'skew')[1] / np.sqrt(2.0), rel=.1)
    assert abs(value - 2e-5) < 4.0 * error


@pytest.mark.machines
def test_more_pulses_decide_what_odds_left_undecided():
    """Correlation that is none is taken for some in a part: the whole tells."""
    first, second = machine(3, excess=1.5), machine(4, excess=1.5)
    memory, independent = (frozenset([name]) for name in ('correlated_jitter', JITTER))
    part = read_timing([first], names=memory)
    part.chooser.fit(independent)
    part = replace(part, choice=part.chooser.choice(memory))
    assert {*part.choice.undecided} == {memory, independent}
    for found in refitted(part, [first, second], []):
        assert names_of(found) == {'excess_jitter'}
        assert found.findings[0].indistinguishable_from == ('correlated_jitter',)


def without_the_middle(stretch):
    """Return what is left of a stretch whose middle third is held out."""
    third = stretch.errors.size // 3
    setting = stretch.setting
    return [replace(stretch, setting=replace(
        setting, index=setting.index[part], times=setting.times[part],
        true_times=setting.true_times[part]), measured=stretch.measured[part],
        errors=stretch.errors[part], bends=stretch.bends[part][:third - 1])
        for part in (slice(0, third), slice(2 * third, 3 * third))]


@pytest.mark.machines
@pytest.mark.parametrize(('sizes', 'name'), [
    ({}, ''), ({'swing': 2e-3}, ''), ({'excess': 1.0, 'rho': 0.7}, 'correlated_jitter'),
    ({'wander': 2.0, 'band': (0.0, 0.2)}, 'phase_wander')])
def test_what_sets_stretches_apart_has_the_power_of_its_frequency(sizes, name):
    count, ratios = 10, []
    for seed in range(count):
        parts = without_the_middle(machine([61, seed], **sizes))
        fit = Chooser(parts, []).fit(frozenset([name] if name else []))
        assert fit.data.each[0] < fit.data.each[1] == 1.0 / fit.data.longest
        power = np.linalg.inv(fit.spectrum)[0]
        apart = fit.data.ordinates[0]
        ratios.append(float((apart.conj() @ power @ apart).real) / fit.data.series)
    # of squares of three normal variables
    assert np.mean(ratios) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / 3.0 / count) + 0.1)


@pytest.mark.machines
def test_a_skew_shows_on_either_side_of_what_is_held_out():
    parts = without_the_middle(machine(7, skew=3e-6))
    timing = read_timing(parts)
    assert names_of(timing) == {'clock_skew'}
    alone = [replace(part, setting=replace(part.setting, fitted=part.setting.times))
             for part in parts]  # two recordings, whose errors may differ by any constant
    assert names_of(read_timing(alone)) == set()
    value, error = value_of(timing, 'clock_skew', 'skew')
    assert abs(value - 3e-6) < 4.0 * error
    whole = read_timing([machine(7, skew=3e-6)])
    assert error < 1.3 * value_of(whole, 'clock_skew', 'skew')[1]


@pytest.mark.machines
def test_a_delay_shows_on_either_side_of_what_is_held_out():
    """The turn that all pulses have in common is that of the whole fit, not of a part of it."""
    whole = machine([63, 0], delay=0.02, swing=2e-3)
    timing = read_timing(without_the_middle(whole))
    assert names_of(timing) == {'path_delay'}
    value, error = value_of(timing, 'path_delay', 'delay')
    assert abs(value - 0.02) < 4.0 * error
    known = read_timing([whole], names=frozenset({'path_delay'}))
    assert error < 1.5 * value_of(known, 'path_delay', 'delay')[1]


@pytest.mark.machines
def test_independent_errors_beside_a_slow_motion_have_no_memory(monkeypatch):
    """Errors with a memory explain both at first, so that jitter begins in their place."""
    monkeypatch.setattr(Chooser, 'pool', ('jitter_scale', 'correlated_jitter', 'phase_wander'))
    timing = read_timing([machine([64, 0], excess=6.0, wander=6.0, band=(0.0, 0.1), noise=0.6)])
    assert names_of(timing) == {'excess_jitter', 'phase_wander'}


def test_a_beat_within_the_cycles_is_no_acceleration(rng):
    """Neighbouring bends of a slow motion are more alike than those of a line that comes by."""
    part = machine(7)
    index = part.setting.index
    phase = 0.31 * index + np.cumsum(rng.normal(0.0, 0.02, index.size))
    beat = 2e-4 * np.cos(2.0 * np.pi * phase)
    timing = read_timing([replace(part, bends=part.bends + beat[:-1])])
    assert 'speed_fluctuation' not in {item.name for item in timing.findings}


@pytest.mark.machines
@pytest.mark.parametrize('noise', [0.02, 0.3])
def test_declared_machine_shows_nothing_beside_what_is_held_out(noise):
    found = [names_of(read_timing(without_the_middle(machine([62, seed], noise=noise))))
             for seed in range(2)]
    assert not any(found)


def test_uneven_marks_are_found_mark_by_mark():
    marks = np.array([0.5, -0.3, 0.2, -0.4])
    timing = read_timing([machine(1, marks=marks)])
    assert names_of(timing) == {'target_geometry'}
    value, error = value_of(timing, 'target_geometry', 'pulse_angles')
    truth = 2.0 * np.pi * MODEL.trigger_speed * UNIT * marks
    assert np.all(np.abs(np.array(value) - truth) < 4.0 * np.array(error))


@pytest.mark.machines
def test_a_speed_that_sways_up_to_a_sharp_edge_is_no_source_that_moves():
    """As a speed control makes it; without a motion of this kind every fifth machine is wrong."""
    for seed in (0, 3):  # two of those
        rng = np.random.default_rng([78, seed])
        drawn = {'sway': 10.0 ** rng.uniform(-3.7, -2.7), 'band': (0.006, rng.uniform(0.06, 0.25)),
                 'noise': 10.0 ** rng.uniform(-1.9, -1.0)}
        assert names_of(read_timing([machine([77, seed], walk=0.0, **drawn)])) == set(), drawn


@pytest.mark.machines
def test_two_effects_are_told_apart():
    timing = read_timing([machine(3, excess=1.0, rho=0.8, skew=4e-5)])
    assert names_of(timing) == {'correlated_jitter', 'clock_skew'}


@pytest.mark.machines
def test_declared_machine_shows_nothing_in_noise():
    found = [names_of(read_timing([machine(100 + seed, noise=2.0)])) for seed in range(4)]
    assert sum(bool(names) for names in found) <= 1


@pytest.mark.machines
def test_declared_machine_shows_nothing_and_its_checks_are_calibrated():
    found = [read_timing([machine(200 + seed)]) for seed in range(8)]
    assert sum(bool(names_of(timing)) for timing in found) <= 1
    checks = [timing.checks for timing in found]
    p_values = np.array([each[i].p_value for each in checks for i in (0, 4)])
    assert np.mean(p_values < 0.05) < 0.2  # of 16 numbers three: as rare as 1 in 140 is more
    assert p_values.min() > 1e-4


@pytest.mark.machines
@pytest.mark.parametrize('excess', [0.0, 2.0])
def test_size_of_errors_is_as_steady_as_normal_ones_beside_the_declared(excess):
    names = frozenset({'jitter_scale'} if excess else ())
    steady = [read_timing([machine(300 + seed, count=1000, excess=excess)],
                          names=names).checks[-1].p_value for seed in range(3)]
    # uniform errors of the same size would scatter less, and make these look unsteady
    assert stats.combine_pvalues(steady).pvalue > 1e-3
    assert min(steady) > 0.05 / len(steady) / 5


@pytest.mark.machines
@pytest.mark.parametrize('scale', [0.0, 0.6])
def test_jitter_of_a_declared_scale_is_that_and_normal_jitter_comes_on_top(scale):
    """A scale of errors that noise hides is not told from normal errors: it is as declared."""
    declared = [EFFECTS['jitter_scale'](scale)]
    timing = read_timing([machine(500, count=600, scale=scale, noise=2.0)], declared)
    assert names_of(timing) <= {'jitter_scale'}
    if scale:
        found, error = value_of(timing, 'jitter_scale', 'scale')
        assert abs(found - scale) < 3.5 * error
    timing = read_timing([machine(501, count=600, scale=scale, excess=3.0)], declared)
    assert names_of(timing) == {'excess_jitter'}
    found, error = value_of(timing, 'excess_jitter', 'std')
    assert abs(found - 3.0 * UNIT) < 3.5 * error


@pytest.mark.machines
def test_standard_error_of_a_scale_is_that_of_uniform_errors():
    scale, off = 0.4, []
    for seed in range(30):
        timing = read_timing([machine([510, seed], scale=scale)],
                             names=frozenset({'jitter_scale'}))
        found, error = value_of(timing, 'jitter_scale', 'scale')
        off.append((found - scale) / error)
    # it is 0.63 by that of normal errors; of 30, a deviation has a standard error of 0.13
    assert 0.72 < np.sqrt(np.mean(np.square(off))) < 1.39


@pytest.mark.machines
def test_skew_beside_larger_jitter_is_no_jitter_with_a_long_memory():
    timing = read_timing([machine([0, k], count=163, excess=1.0, skew=9.5e-5) for k in range(2)])
    assert timing.choice.best == {'clock_skew', 'jitter_scale'}
    skew, error = value_of(timing, 'clock_skew', 'skew')
    assert abs(skew - 9.5e-5) < 4.0 * error


@pytest.mark.machines
def test_declared_bandwidth_that_is_too_small_is_another_number():
    rad = 2.0 * np.pi * MODEL.fundamental_frequency
    timing = read_timing([machine(0, wander=2.0, band=(0.0, 0.3))],
                         [EFFECTS['phase_wander'](2.0 * rad * UNIT, 0.09)])
    assert names_of(timing) == {'phase_wander'}
    bandwidth, error = value_of(timing, 'phase_wander', 'bandwidth')
    assert abs(bandwidth - 0.3) < 4.0 * error


@pytest.mark.machines
def test_declared_speed_fluctuation_that_is_not_there_has_size_0():
    declared = EFFECTS['speed_fluctuation'].of_ripple(2.0 * UNIT, MODEL)
    timing = read_timing([machine(0, walk=0.0, count=400)], [declared])
    size, error = value_of(timing, 'speed_fluctuation', 'acceleration_std')
    assert max(size, 2.0 * error) < 0.06 * declared.acceleration_std
    assert not read_timing([machine(0, walk=0.0)]).findings


def surest(checks, text):
    return min((check.p_value for check in checks if text in check.text), default=1.0)


def test_ends_of_a_motion_far_above_the_jitter_are_no_other_distribution():
    """What whitens the errors passes on much of the jump between both ends of a recording."""
    chances = [surest(read_timing([machine(300 + k, wander=80.0, band=(0.0, 0.1))],
                                  names=frozenset({'phase_wander'})).checks, 'distributed')
               for k in range(4)]
    assert min(chances) > 0.01 / len(chances)
    assert np.mean(chances) > 0.2


@pytest.mark.machines
def test_source_that_moves_as_a_sine_does_is_no_random_motion():
    text = 'a sinusoid of the source'
    random = [surest(read_timing([machine(40, wander=3.0, band=band)],
                                 names=frozenset({'phase_wander'})).checks, text)
              for band in ((0.0, 0.3), (0.1, 0.15))]
    assert min(random) > 0.05 / len(random)
    timing = read_timing([machine(1, wander=6.0, band=(0.2, 0.2001))])
    assert names_of(timing) == {'phase_wander'}
    assert surest(timing.checks, text) < 1e-6


@pytest.mark.machines
def test_motion_of_a_few_swings_is_a_drift():
    wander = frozenset({'phase_wander'})
    for band, few, names in (((0.0, 0.005), True, None), ((0.0, 0.1), False, wander)):
        timing = read_timing([machine(3, wander=4.0, band=band, count=450)], names=names)
        assert names_of(timing) == wander
        assert (surest(timing.checks, 'a drift of the source') == 0.0) == few


@pytest.mark.machines
def test_pulse_errors_of_one_band_are_no_random_effect(rng):
    """No sinusoid stands out of them, but their power is that of no effect."""
    frequency = np.fft.rfftfreq(600)
    part = machine(500, count=600)
    waves = np.fft.rfft(rng.standard_normal(600))
    band = np.fft.irfft(waves * ((frequency > 0.2) & (frequency < 0.3)), 600)
    band *= 2.0 * UNIT / band.std()
    timing = read_timing([replace(part, errors=part.errors + band, setting=replace(
        part.setting, times=part.setting.times + band))])
    assert min(check.p_value for check in timing.checks) < 1e-5


def test_memory_is_no_longer_than_a_third_of_a_stretch():
    parts = [machine([7, k], count=21, excess=3.0, rho=0.8) for k in range(20)]
    fit = Chooser(parts).fit(frozenset({'correlated_jitter'}))
    assert 0.6 < np.tanh(fit.starts['correlated_jitter'][1]) <= np.exp(-3.0 / 19.0) + 1e-9


@pytest.mark.machines
def test_effect_that_nobody_knows_is_seen():
    timing = read_timing([machine(0, hum=1.5)])
    assert min(check.p_value for check in timing.checks) < 1e-4


@pytest.mark.machines
def test_declared_effect_is_taken_as_declared_and_free_where_wrong():
    right = read_timing([machine(5, excess=1.5)], [ExcessJitter(1.5 * UNIT)])
    assert names_of(right) == set()
    wrong = read_timing([machine(5, skew=1e-4)], [ClockSkew(5e-5)])
    assert 'clock_skew' in names_of(wrong)
    value, error = value_of(wrong, 'clock_skew', 'skew')
    assert abs(value - 1e-4) < 4.0 * error


@pytest.mark.machines
def test_larger_uniform_jitter_is_a_scale_and_normal_jitter_an_excess():
    scaled = read_timing([machine(7, scale=2.0, count=600)])
    assert names_of(scaled) == {'jitter_scale'}
    normal = read_timing([machine(7, excess=np.sqrt(3.0), count=600)])
    assert names_of(normal) == {'excess_jitter'}
    hidden = read_timing([machine(7, scale=2.0, count=200, noise=2.0)])
    assert any({finding.name, *finding.indistinguishable_from} >= {'excess_jitter', 'jitter_scale'}
               for finding in hidden.findings)


def test_slope_of_the_likelihood_is_that_of_its_differences():
    data = TimingData([machine(0, wander=0.5, excess=0.5, rho=0.5)])
    fit = TimingFit(data, {name: EFFECTS[name].timing for name in (
        'correlated_jitter', 'phase_wander')}, {}, scaled=True)
    at = fit.parameters + 0.1 * np.random.default_rng(1).standard_normal(fit.parameters.size)
    slope = fit._cost(at)[1]
    for i in range(at.size):
        step = np.zeros(at.size)
        step[i] = 1e-5
        numeric = (fit._cost(at + step)[0] - fit._cost(at - step)[0]) / 2e-5
        assert slope[i] == pytest.approx(numeric, rel=1e-3, abs=1e-2)


@pytest.mark.machines
@pytest.mark.parametrize('name', ['excess_jitter', 'clock_skew'])
def test_limit_holds_as_often_as_it_says(name):
    # the true size is half the median limit of the declared machine
    nothing = [limit_of(machine(300 + seed, count=150), name) for seed in range(7)]
    median = float(np.median(nothing))
    size = {'excess': median / UNIT} if name == 'excess_jitter' else {'skew': median}
    held = [limit_of(machine(400 + seed, count=150, **size), name) >= median
            for seed in range(16)]
    # 95 %, with four standard errors of such a count
    assert 0.95 - np.mean(held) < 4.0 * np.sqrt(0.95 * 0.05 / len(held))


@pytest.mark.machines
@pytest.mark.parametrize(('name', 'sizes'), [
    ('excess_jitter', {'excess': 0.4}), ('phase_wander', {'wander': 0.5}),
    ('correlated_jitter', {'excess': 0.5, 'rho': 0.7})])
def test_score_of_the_true_power_is_normal(name, sizes):
    """The power of uniform errors scatters less than that of normal ones."""
    power = 2.0 * np.log(max(sizes.get('excess', 0.0), sizes.get('wander', 0.0)))
    scores = []
    for seed in range(16):
        chooser = Chooser([machine(900 + seed, count=300, **sizes)])
        fit = chooser.fit(frozenset([name]), held={(name, 0): power})
        more, seen = fit.more_than_held(name, chooser.shapes.kurtosis)
        assert seen > 0.25
        scores.append(more)
    assert abs(np.mean(scores)) < 4.0 / np.sqrt(len(scores))
    assert np.std(scores) == pytest.approx(1.0, abs=4.0 / np.sqrt(2.0 * len(scores)))


def test_power_has_a_limit_as_often_above_it_as_said(rng):
    power, noise, count, draws = 0.5, 1.0, 60, 4000
    values = (noise + power) * rng.chisquare(count, draws) / count - noise
    held = np.mean([largest_power(value, count, noise, noise**2, 1.0) >= power
                    for value in values])
    # that powers are skewed makes it more: by 1.5 % of so few squares
    assert 0.95 - 4.0 * np.sqrt(0.05 * 0.95 / draws) < held < 0.975
    assert largest_power(1.0, 4, noise, noise**2, 1.0) == np.inf


def test_sizes_of_a_pattern_have_one_limit_together(rng):
    draws, truth = 4000, np.array([0.8, -1.2, 0.4])
    covariance = 0.5 * (np.eye(3) + 1.0)
    values = rng.multivariate_normal(truth, covariance, draws)
    weight = np.linalg.inv(covariance)
    far = np.array([limits._farthest(value, covariance) for value in values])
    held = np.mean(np.einsum('di,ij,dj->d', far, weight, far) >= truth @ weight @ truth)
    assert held == pytest.approx(0.95, abs=4.0 * np.sqrt(0.05 * 0.95 / draws))


@pytest.mark.parametrize(('name', 'sizes'), [
    ('additive_noise', {'std': 0.6}), ('amplitude_modulation', {'gain': 0.4})])
def test_limits_from_the_lines_hold_as_often_as_they_say(name, sizes):
    draws, (size,) = 300, sizes.values()
    held = np.mean([limit_of(lines(seed, **sizes), name) >= size for seed in range(draws)])
    assert held == pytest.approx(0.95, abs=4.0 * np.sqrt(0.05 * 0.95 / draws))


def test_so_few_losses_are_as_rare_as_said():
    evidence = lines(1, lost=0.02)
    lost, seen = int(evidence.record_missing.sum()), evidence.record_missing.size
    assert stats.binom.cdf(lost, lost + seen, limit_of(evidence, 'missing_pulses')) == (
        pytest.approx(0.05))


def test_noise_that_hides_any_jitter_leaves_no_limit():
    """The largest size that a fit tries is none."""
    quiet, noisy = (limit_of(machine(1, noise=noise), 'excess_jitter') for noise in (3.0, 300.0))
    assert 5.0 < noisy / quiet < 50.0  # jitter below the noise shows by its power
    timing = read_timing([machine(1, noise=3e4)], names=frozenset())
    assert largest(timing, 'excess_jitter') is None
    assert largest(timing, 'clock_skew') is not None
    part = machine(1, noise=3e6)  # as large, the errors would leave no order of the pulses
    part = replace(part, setting=replace(part.setting, true_times=part.setting.times))
    assert largest(read_timing([part], names=frozenset()), 'clock_skew') is None  # beyond a clock


def test_errors_far_beyond_a_tiny_declared_jitter_have_a_limit():
    """A grid of a third of a microsecond says little of what a worn sensor does."""
    part = machine(5, excess=120.0, noise=40.0)
    limit = largest(read_timing([part], names=frozenset()), 'excess_jitter')
    # 300 pulses tell a power to 8 %, beside that of the noise
    assert 120.0 * UNIT < limit.std < 120.0 * UNIT * (1.0 + 4.0 * 0.5 * 0.09)


def test_search_for_a_limit_stays_finite_where_smaller_sizes_fit_worse(monkeypatch):
    """Errors that were recovered wrongly make a likelihood of many hills."""
    timing = read_timing([machine(1)], names=frozenset())
    tried, fit = [], timing.chooser.fit

    def poor(names, start=None, *, held=None):
        found = copy(fit(names, start, held=held))
        if held:
            tried.extend(held.values())
            found.value -= 1e6 * (len(tried) > 1)
            found.more_than_held = lambda *_: (-10.0, 5.0)  # far less is seen
        return found
    monkeypatch.setattr(timing.chooser, 'fit', poor)
    largest(timing, 'excess_jitter')
    assert len(tried) > 2
    assert np.all(np.isfinite(tried))


@pytest.mark.machines
def test_what_no_machine_can_have_is_in_no_set(monkeypatch):
    """Pulses that come by minutes late were recovered wrongly: no delay makes that."""
    part = machine(3, swing=2e-3, count=150)
    speed = 0.02 / np.gradient(part.setting.true_times)
    wrong = replace(part, errors=part.errors + 300.0 * (speed - speed.mean()))
    monkeypatch.setattr(Chooser, 'pool', ('jitter_scale', 'correlated_jitter', 'path_delay'))
    timing = read_timing([wrong])
    assert timing.choice.fit.value < -1e6  # of all sets: a pattern of minutes is the truth
    assert all(abs(item.effect.delay) <= 1.0 for item in timing.findings
               if item.name == 'path_delay')


def test_no_motion_of_the_source_shows_against_a_reference_keyphasor():
    late = replace(machine(1, excess=2.0), referenced=True, bend_std=np.inf)
    assert not np.any(TimingData([late]).steer[SOURCE])
    assert names_of(read_timing([late])) == {'excess_jitter'}
    part = replace(machine(1), referenced=True, bend_std=np.inf)
    assert limit_of(part, 'phase_wander') == np.inf
    assert limit_of(part, 'excess_jitter') < UNIT


def test_short_or_missing_stretches_show_nothing():
    assert read_timing([]) is None
    assert read_timing([machine(0, count=12)]) is None


def test_missing_pulses_have_no_error():
    part = machine(9)
    rng = np.random.default_rng(1)
    measured = rng.uniform(size=300) > 0.05
    errors = np.where(measured, part.errors, 7.0 * UNIT)
    assert names_of(read_timing([replace(part, measured=measured, errors=errors)])) == set()


@pytest.mark.machines
def test_skew_beside_missing_pulses_is_no_jitter():
    """A missing pulse has the mean error, as it has in what a skew makes."""
    part = machine(12, skew=3e-4)
    measured = np.ones(part.errors.size, np.bool_)
    measured[np.linspace(20, 280, 6).astype(int)] = False
    timing = read_timing([replace(part, measured=measured)])
    assert names_of(timing) == {'clock_skew'}
    value, error = value_of(timing, 'clock_skew', 'skew')
    assert abs(value - 3e-4) < 3.0 * error


def test_memory_and_size_come_back_from_what_they_made():
    truth = CorrelatedJitter(2e-5, 0.6)
    setting = machine(0).setting
    again, _ = CorrelatedJitter.of_timing(truth.in_timing(setting), np.zeros(2), setting)
    assert again.std == pytest.approx(truth.std)
    assert again.correlation == pytest.approx(truth.correlation)


@pytest.mark.parametrize('rho', [0.0, 0.7])
def test_distribution_of_single_errors_tells_normal_ones_beside_the_declared(rho):
    """Half as large as the declared ones, they hide in the power but not in the edges."""
    with_shape, without = [], []
    for seed in range(6):
        chooser = Chooser([machine(600 + seed, count=200, excess=0.5, rho=rho)])
        nothing = chooser.fit(frozenset())
        name = 'correlated_jitter' if rho else 'excess_jitter'
        found = chooser.fit(frozenset([name]))
        without.append(found.value - nothing.value)
        with_shape.append(without[-1] + chooser.of_shape(found, 1.0)
                          - chooser.of_shape(nothing, 1.0))
    assert np.median(with_shape) > np.median(without) + 5.0
    declared = Chooser([machine(700, count=200)])
    nothing = declared.fit(frozenset())
    assert declared.of_shape(nothing, 1.0) > 5.0  # uniform errors are no normal ones
    assert Chooser([replace(item, setting=replace(
        item.setting, model=replace(MODEL, jitter_distribution='normal')))
        for item in declared.data.stretches]).of_shape(nothing, 1.0) == 0.0


@pytest.mark.machines
def test_events_that_fade_are_no_normal_errors_with_a_memory():
    timing = read_timing([machine(0, shocks=4.0)])
    events = [check.p_value for check in timing.checks if 'events' in check.text]
    assert events
    assert min(events) < 1e-4
    drawn = read_timing([machine(0, excess=1.5, rho=0.7)], names=frozenset({'correlated_jitter'}))
    (fair,) = [check.p_value for check in drawn.checks if 'events' in check.text]
    assert fair > 1e-3


@pytest.mark.machines
def test_motion_that_ends_nowhere_is_no_remainder():
    """A shaft that shakes faster than half the trigger rate shows at an alias."""
    part = machine(8)
    wave = 3.0 * UNIT * np.exp(2j * np.pi * 0.83 * part.setting.index)
    turn = steering(MOTION, np.array([0.83]), np.array([0.83]))[0]
    left = (turn[1] * wave).real  # of which the recovery follows the rest
    moved = replace(part, errors=part.errors + left, bends=part.bends + (turn[2] * wave).real[:-1],
                    setting=replace(part.setting, times=part.setting.times + wave.real,
                                    true_times=part.setting.true_times + wave.real - left))
    timing = read_timing([moved], names=frozenset())
    assert min(check.p_value for check in timing.checks) > 1e-3


@pytest.mark.machines
def test_sidebands_of_one_time_are_no_source_that_moves():
    part = machine(9)
    hum = 1.0 * UNIT * np.cos(2.0 * np.pi * 0.11 * part.setting.index)
    moving = replace(part, errors=part.errors + hum, setting=replace(
        part.setting, true_times=part.setting.true_times - hum))
    known = replace(moving, sidebands=np.array([0.11]))
    assert names_of(read_timing([known])) == set()
    unknown = read_timing([moving])
    assert names_of(unknown) or min(check.p_value for check in unknown.checks) < 1e-3


def test_skew_beside_the_ticks_of_a_clock_is_found_with_its_error():
    """The errors of the ticks are no white noise; only sizes that leave them whole remain."""
    rate, skew = MODEL.keyphasor_rate, 4e-5
    off = []
    for seed in range(4):
        part = machine(800 + seed, count=300, scale=0.0)
        motion = part.setting.times
        times = np.ceil(motion * rate) / rate
        late = times - motion - 0.5 / rate + skew * (motion - motion[0])
        late += 0.01 / rate * np.random.default_rng(seed).standard_normal(late.size)
        late -= late.mean()
        setting = replace(part.setting, times=times, true_times=times - late, clock_rate=rate,
                          clock_errors=smooth_on_grid(times, rate))
        timing = read_timing([replace(part, setting=setting, errors=late,
                                      error_std=0.01 / rate)])
        assert names_of(timing) == {'clock_skew', 'keyphasor_quantisation'}
        value, error = value_of(timing, 'clock_skew', 'skew')
        assert error < 0.01 * skew
        off.append((value - skew) / error)
    assert np.max(np.abs(off)) < 3.0


@pytest.mark.machines
def test_jitter_does_not_make_a_skew_grow_with_the_angle():
    """Corrected pulse times have no jitter, and a skew puts none into them."""
    timing = read_timing([machine(0, noise=1e-3, walk=1e-7, swing=1e-3, skew=4e-4)])
    assert timing.choice.best == {'clock_skew'}


@pytest.mark.machines
@given(st.integers(0, 99), st.sampled_from([-3e-3, -1e-4, 4e-5, 2e-3]), st.booleans())
@settings(max_examples=1)
def test_a_skew_that_was_found_and_is_declared_is_found_no_more(seed, skew, quiet):
    part = machine(seed, skew=skew, swing=1e-3, **({'noise': 1e-3, 'walk': 1e-7} if quiet else {}))
    found, = (item.effect for item in read_timing([part]).findings if item.name == 'clock_skew')
    assert names_of(read_timing([part], [found])) == set()


@pytest.mark.machines
def test_skew_of_a_machine_whose_speed_changes_is_no_wander():
    """
    The delay that has grown turns the vibration as the speed changes.

    What turn all pulses have in common is that of the whole recording, not of its parts.
    """
    whole = machine(820, count=1500, skew=2e-4, swing=0.02)
    parts = [replace(whole, measured=whole.measured[here], errors=whole.errors[here],
                     bends=whole.bends[here][:-1], setting=replace(
                         whole.setting, index=whole.setting.index[here],
                         times=whole.setting.times[here],
                         true_times=whole.setting.true_times[here]))
             for here in (slice(0, 500), slice(1000, 1500))]
    timing = read_timing(parts)
    assert names_of(timing) == {'clock_skew'}
    value, error = value_of(timing, 'clock_skew', 'skew')
    assert abs(value - 2e-4) < 3.0 * error


@pytest.mark.machines
@pytest.mark.parametrize('beside', [0.0, 3.0])
def test_speed_fluctuation_is_told_from_sidebands_by_its_frequency(beside):
    """The shaft bends the angle slowly; sidebands of half an order bend it to and fro."""
    part = machine(7)
    index = part.setting.index
    motion = 10.0 * UNIT * np.cos(2.0 * np.pi * 0.11 * index)
    seen = motion * [[1.0], [0.0]] + recovered_source(motion)
    seen += recovered_source(beside * UNIT * (-1.0) ** index)
    setting = replace(part.setting, times=part.setting.times + motion)
    timing = read_timing([replace(
        part, setting=setting, errors=part.errors + seen[0], bends=part.bends + seen[1, :-1],
        sidebands=np.array([0.5]))], names=frozenset({SIDEBANDS} if beside else ()))
    value, error = value_of(timing, 'speed_fluctuation', 'acceleration_std')
    size = np.std(recovered_source(motion)[1])
    bandwidth, _ = value_of(timing, 'speed_fluctuation', 'bandwidth')
    truth = EFFECTS['speed_fluctuation'].of_ripple(size, MODEL, bandwidth).acceleration_std
    assert abs(value - truth) < 3.0 * error + 0.05 * truth
