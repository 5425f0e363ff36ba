# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The distribution of |X|: exact for normal X, close for averages, sampled for few cycles."""

import numpy as np
import pytest
from sa_jitter_ros.effects import make_effect
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.prediction.amplitude_distribution import curved_along
from sa_jitter_ros.prediction.amplitudes import unit_amplitudes
from sa_jitter_ros.prediction.angle_error import IndependentPulseJitter
from sa_jitter_ros.prediction.cumulants import average_cumulants, third_cumulants
from sa_jitter_ros.prediction.distributions import Empirical, Normal, Triangular, Uniform
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.prediction.moments import AverageMoments, cycle_moments
from sa_jitter_ros.prediction.parts import Parts
from sa_jitter_ros.prediction.sampled_distribution import (
    distribution_of, drawn_averages, SampledDistribution)
from scipy import stats
from validation.analytic import (
    approximate_cycle_moments, inversion_cdf, laguerre_distribution, normal_distribution,
    squared_amplitude_cumulants, uniform_mean)
from validation.monte_carlo import AveragedSignal, monte_carlo

QUANTILES = np.array([0.001, 0.05, 0.5, 0.95, 0.999])


def moments_of(mean, real, imag, covariance=0.0):
    """Moments of one complex amplitude from the covariance of its parts."""
    return AverageMoments(np.array([mean], complex), np.array([real + imag]),
                          np.array([real - imag + 2j * covariance]))


def jittered(distribution, order, cycles):
    """Moments and both distributions of an average."""
    jitter = [IndependentPulseJitter(distribution)]
    single = cycle_moments([order], jitter)
    moments = single.averaged(cycles)
    return moments, curved_along(Parts.about(
        moments.mean, moments, *third_cumulants([order], jitter, cycles, single)))


@pytest.mark.parametrize(('moments', 'tolerance'), [
    (moments_of(0.95, 6e-5, 3e-3), 1e-9), (moments_of(0.9, 1e-7, 1e-3), 1e-9),
    (moments_of(0.2 + 0.4j, 0.02, 0.05, -0.01), 1e-7), (moments_of(1.0, 0.05, 0.05), 1e-9),
    (moments_of(0.3, 0.02, 0.05), 1e-5), (moments_of(0.1, 0.3, 0.2), 1e-5)])
def test_normal_distribution_agrees_with_inversion_of_the_quadratic_form(moments, tolerance):
    distribution = normal_distribution(moments)
    amplitudes = distribution.ppf(QUANTILES)
    np.testing.assert_allclose(distribution.cdf(amplitudes)[0], QUANTILES, atol=1.1e-9)
    np.testing.assert_allclose(inversion_cdf(moments, amplitudes), distribution.cdf(amplitudes),
                               atol=tolerance)


def test_circular_cases_are_the_distributions_of_rice_and_rayleigh():
    for mean in (0.0, 0.05, 0.5, 3.0):
        distribution = normal_distribution(moments_of(mean, 0.04, 0.04))
        rice = stats.rice(mean / 0.2, scale=0.2)
        amplitudes = rice.ppf(QUANTILES)
        np.testing.assert_allclose(distribution.cdf(amplitudes)[0], QUANTILES, atol=1e-8)
        assert distribution.mean[0] == pytest.approx(rice.mean(), rel=1e-6)
        assert distribution.variance[0] == pytest.approx(rice.var(), rel=1e-5)


@pytest.mark.parametrize(('real', 'imag'), [(0.0, 0.01), (0.01, 0.0), (1e-9, 0.01), (0.0, 0.0)])
def test_singular_covariances(real, imag):
    distribution = normal_distribution(moments_of(0.5, real, imag))
    amplitudes = np.array([0.4, 0.499, 0.51, 0.6])
    if imag > 0.0:  # |X|^2 = m^2 + z^2 to 1e-4
        half = np.sqrt(np.maximum(amplitudes**2 - 0.25, 0.0))
        expected = 2.0 * stats.norm.cdf(half / 0.1) - 1.0
    else:
        expected = stats.norm.cdf((amplitudes - 0.5) / np.sqrt(max(real, 1e-300)))
    np.testing.assert_allclose(distribution.cdf(amplitudes)[0], expected,
                               atol=2e-3 if 0 < real < 1e-6 else 1e-6)
    assert distribution.mean_square[0] == pytest.approx(0.25 + real + imag)
    assert distribution.mean[0] ** 2 + distribution.variance[0] == pytest.approx(
        distribution.mean_square[0], rel=1e-12)
    assert np.all(np.isfinite(distribution.ppf(QUANTILES)))


def test_tiny_scatter_keeps_its_digits():
    distribution = normal_distribution(moments_of(1.0, 1e-12, 1e-12))
    assert distribution.variance[0] == pytest.approx(1e-12, rel=1e-6)


# Kolmogorov-Smirnov: with n draws the 0.1 % point is 1.95 / sqrt(n); the own error is what
# is added: none where it is exact enough for n.
@pytest.mark.machines
@pytest.mark.parametrize(('distribution', 'order', 'cycles', 'bias'), [
    (Uniform(1.0), 0.3, 100, 0.0), (Uniform(1.0), 0.8, 60, 0.0), (Triangular(0.2), 0.9, 40, 0.0),
    (Normal(0.25), 0.4, 20, 0.0), (Uniform(1.0), 0.5, 10, 0.014), (Normal(0.25), 0.5, 10, 0.008),
    (Empirical(np.random.default_rng(4).exponential(0.2, 2000)), 0.8, 40, 0.008)],
    ids=['uniform-100', 'uniform-60', 'triangular-40', 'normal-20', 'uniform-10', 'normal-10',
         'exponential-40'])
def test_curved_distribution_agrees_with_simulated_averages(distribution, order, cycles, bias):
    moments, curved = jittered(distribution, order, cycles)
    signal = AveragedSignal(cycles, 1.0, order)
    draws = np.sort(np.abs(monte_carlo(
        signal.whole_trigger_cycles, distribution, cycles, 20_000, seed=cycles)))
    distance = stats.kstest(draws, lambda x: curved.cdf(x)[0]).statistic
    assert distance < bias + 1.95 / np.sqrt(draws.size)
    normal = stats.kstest(draws, lambda x: normal_distribution(moments).cdf(x)[0]).statistic
    assert normal > distance
    assert curved.mean_square[0] == pytest.approx(moments.mean_square[0], rel=1e-12)
    assert np.sqrt(curved.variance[0]) == pytest.approx(draws.std(), rel=0.025)


def test_third_cumulants_of_wide_tables_have_the_nodes_they_need():
    jitter = [IndependentPulseJitter(Empirical(np.array([-1.0, 1.0]) / np.sqrt(12.0)))]
    orders = np.array([0.4, 1.5, 2.5, 4.0])
    cycles = cycle_moments(orders, jitter, nodes=160)
    found = average_cumulants(orders, jitter, 100, cycles)
    exact = third_cumulants(orders, jitter, 100, cycles, nodes=32)
    np.testing.assert_allclose(found, exact, atol=1e-7)  # 1e-4 off with the nodes of small errors


def test_bent_averages_keep_their_mean_square_in_noise():
    jitter = [IndependentPulseJitter(Uniform(1.0))]
    single = cycle_moments([0.4], jitter)
    moments, cumulants = single.averaged(30), third_cumulants([0.4], jitter, 30, single)
    for level in (0.0, 1e-3, 1.0):
        noisy = moments.with_noise(level)
        distribution = curved_along(Parts.about(noisy.mean, noisy, *cumulants))
        assert distribution.mean_square[0] == pytest.approx(
            moments.mean_square[0] + level, rel=1e-12)
    normal = normal_distribution(noisy)
    assert distribution.variance[0] == pytest.approx(normal.variance[0], rel=1e-3)


@pytest.mark.parametrize('cycles', [1, 3])
def test_sampled_distribution_is_that_of_few_cycles(cycles):
    distribution, order, noise = Triangular(0.25), 0.7, 0.02
    moments, _ = jittered(distribution, order, cycles)
    model = DeclaredModel(keyphasor_rate=1e3, trigger_speed=1.0, trigger_cycles=cycles,
                          orders=(order,))
    drawn, unit_noise = drawn_averages(model, [IndependentPulseJitter(distribution)])
    sampled = distribution_of(drawn + np.sqrt(noise) * unit_noise,
                              Parts.about(1.0, moments.with_noise(noise)))
    assert sampled.mean_square[0] == pytest.approx(moments.with_noise(noise).mean_square[0])
    signal = AveragedSignal(cycles, 0.4137, order)
    draws = np.abs(monte_carlo(signal.whole_trigger_cycles, distribution, cycles, 60_000, seed=5,
                               line_variance=noise))
    assert stats.ks_2samp(draws, sampled.draws[0]).pvalue > 1e-3
    np.testing.assert_allclose(sampled.cdf(sampled.ppf([0.25, 0.75]))[0], [0.25, 0.75], atol=1e-4)
    assert sampled.mean[0] == pytest.approx(draws.mean(), abs=0.003)


def test_quantiles_need_probabilities():
    distribution = normal_distribution(moments_of(1.0, 0.1, 0.1))
    sampled = SampledDistribution(np.ones(1), np.array([[-0.1, 0.1]]), np.array([1.01]))
    for bad in (0.0, 1.0, -0.1, np.nan):
        for either in (distribution, sampled):
            with pytest.raises(ParameterError, match='between 0 and 1'):
                either.ppf([0.5, bad])
    with pytest.raises(ParameterError, match='between 0 and 1'):
        laguerre_distribution(moments_of(1.0, 0.1, 0.1)).amplitude_ppf(1.0)
    with pytest.raises(ParameterError, match='degree is 1'):
        laguerre_distribution(moments_of(1.0, 0.1, 0.1), degree=1)


def test_the_paper_approximates_its_moments_this_well():
    spread = np.array([0.1, 0.2, 0.3, 0.4])
    exact = cycle_moments(spread, [IndependentPulseJitter(Uniform(1.0))])
    close = approximate_cycle_moments(spread)
    np.testing.assert_allclose(close.mean, uniform_mean(spread), rtol=0.0016)
    for lag, name, tolerance in ((0, 'real_variance', 6e-4), (0, 'imag_variance', 7e-4),
                                 (1, 'real_variance', 0.03), (1, 'imag_variance', 6e-4)):
        np.testing.assert_allclose(getattr(close.lag(lag), name), getattr(exact.lag(lag), name),
                                   rtol=tolerance)
    assert abs(approximate_cycle_moments(0.8).mean[0] / uniform_mean(0.8) - 1.0) > 0.04


def test_cumulants_of_the_squared_amplitude(rng):
    moments = moments_of(0.9, 0.02, 0.09)
    squared = np.abs(0.9 + np.sqrt(0.02) * rng.normal(size=400_000)
                     + 0.3j * rng.normal(size=400_000)) ** 2
    first, second, third = squared_amplitude_cumulants(moments, 3)[:, 0]
    assert first == pytest.approx(0.81 + 0.11)
    assert second == pytest.approx(2.0 * (0.02**2 + 0.09**2) + 4.0 * 0.81 * 0.02)
    off = squared - squared.mean()
    assert first == pytest.approx(squared.mean(), abs=4.5 * off.std() / np.sqrt(off.size))
    assert second == pytest.approx(off.var(), abs=4.5 * (off**2).std() / np.sqrt(off.size))
    assert third == pytest.approx((off**3).mean(), abs=4.5 * (off**3).std() / np.sqrt(off.size))


@pytest.mark.parametrize(('spread', 'cycles', 'error'), [
    (0.1, 20, 5.5e-3), (0.1, 100, 2e-4), (0.4, 20, 2.4e-3), (0.4, 100, 1.1e-4), (0.8, 100, 5e-3)])
def test_laguerre_expansion_is_this_close_to_the_exact_distribution(spread, cycles, error):
    jitter = [IndependentPulseJitter(Uniform(1.0))]
    moments = cycle_moments([spread], jitter).averaged(cycles)
    expansion, exact = laguerre_distribution(moments), normal_distribution(moments)
    amplitudes = exact.ppf(np.linspace(0.01, 0.99, 33))
    assert np.max(np.abs(expansion.amplitude_cdf(amplitudes[0])
                         - exact.cdf(amplitudes))) < error
    median = expansion.amplitude_ppf(0.5)[0]
    assert expansion.amplitude_cdf(median)[0, 0] == pytest.approx(0.5, abs=1e-8)
    assert median == pytest.approx(exact.ppf(0.5)[0, 0], abs=2.0 * error * np.ptp(amplitudes))


def test_laguerre_density_is_the_derivative_of_its_cdf():
    moments = moments_of(0.8, 0.01, 0.04)
    distribution = laguerre_distribution(moments, degree=8)
    x = np.linspace(0.1, 2.0, 20001)
    slope = np.diff(distribution.cdf(x)[0]) / np.diff(x)
    np.testing.assert_allclose(slope, distribution.pdf(0.5 * (x[1:] + x[:-1]))[0], atol=1e-6)
    assert distribution.cdf([0.0, 50.0])[0] == pytest.approx([0.0, 1.0], abs=1e-9)


@pytest.mark.parametrize('setting', [
    {'trigger_cycles': 4}, {'trigger_cycles': 20}, {'trigger_cycles': 4, 'noise': 0.3},
    {'trigger_cycles': 6, 'pulses_per_revolution': 4, 'pulses_per_trigger': 1,
     'effects': [make_effect('target_geometry', pulse_angles=[0.02, -0.05, 0.05, -0.02])]}])
@pytest.mark.parametrize('most', [512, 4096])
def test_part_of_the_draws_has_the_distribution_of_all(setting, most):
    setting = dict(setting)
    effects, noise = setting.pop('effects', []), setting.pop('noise', 0.0)
    model = DeclaredModel(keyphasor_rate=2000.0, trigger_speed=16.6, ratio=2.4,
                          orders=[19.0, 57.0], **setting)
    found, rows = unit_amplitudes(model, effects), np.arange(2)
    whole, part = (found.distribution(rows, noise=noise, most=count) for count in (None, most))
    assert part.draws.shape[1] == most < whole.draws.shape[1]
    random = most**-0.5
    np.testing.assert_allclose(part.mean, whole.mean, atol=0.2 * random)
    np.testing.assert_allclose(part.variance**0.5, whole.variance**0.5, rtol=1.5 * random)
    share = [0.05, 0.5, 0.95]
    np.testing.assert_allclose(part.cdf(whole.ppf(share)), [share] * 2, atol=random)
