# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Numerical models: exact splitting, the paper's approximation, chunks, seeds, progress."""

import numpy as np
import pytest
from sa_jitter_ros.errors import ModelError, ParameterError
from sa_jitter_ros.prediction.amplitude_distribution import curved_along
from sa_jitter_ros.prediction.angle_error import IndependentPulseJitter
from sa_jitter_ros.prediction.cumulants import third_cumulants
from sa_jitter_ros.prediction.distributions import Normal, Triangular, Uniform
from sa_jitter_ros.prediction.moments import cycle_moments
from sa_jitter_ros.prediction.parts import Parts
from scipy import stats
from validation.analytic import multi_harmonic_moments
from validation.monte_carlo import AveragedSignal, monte_carlo


def brute(errors, ratio, length, order, components, folded):
    """Average sampled signals of 4000 points per fundamental cycle, angle by angle."""
    theta = (np.arange(round(length * 4000)) + 0.5) / 4000
    cycle = np.minimum((theta / ratio).astype(int), errors.shape[1] - 2)
    u = theta / ratio - cycle
    read = theta + errors[:, cycle] * (1.0 - u) + errors[:, cycle + 1] * u
    signal = sum(a * np.exp(2j * np.pi * g * read) for g, a in components)
    return (signal * np.exp(-2j * np.pi * order * (theta % 1.0 if folded else theta))).mean(axis=1)


@pytest.mark.parametrize(('ratio', 'cycles'), [(0.4137, 3), (5.8154, 3), (2.286, 7), (2.0, 4)])
@pytest.mark.parametrize('order', [1.0, 2.0, 2.3])
def test_split_cycles_agree_with_a_sampled_waveform(ratio, cycles, order, rng):
    components = ((1.0, 1.0), (3.0, 0.4 - 0.7j))
    sources, amplitudes = zip(*components)
    signal = AveragedSignal(cycles, ratio, order, sources, amplitudes)
    errors = Uniform(0.3).draw(rng, (5, cycles + 1))
    whole = np.floor(cycles * ratio * (1.0 + 1e-12))
    np.testing.assert_allclose(
        signal.whole_fundamental_cycles(errors),
        brute(errors, ratio, whole, order, components, folded=True), atol=3e-5)
    np.testing.assert_allclose(
        signal.whole_trigger_cycles(errors),
        brute(errors, ratio, cycles * ratio, order, components, folded=False), atol=2e-3)


def test_for_an_integer_ratio_all_models_are_one(rng):
    errors = Uniform(0.4).draw(rng, (50, 11))
    for ratio in (1.0, 3.0):
        signal = AveragedSignal(10, ratio, 2.0)
        exact = signal.whole_fundamental_cycles(errors)
        np.testing.assert_allclose(signal.whole_trigger_cycles(errors), exact, atol=1e-12)
        np.testing.assert_allclose(signal.majority_assignment(errors), exact, atol=1e-12)


def test_even_orders_do_not_change_sign_between_trigger_cycles():
    signal = AveragedSignal(41, 2.40789, 38.0)
    jitter = Uniform(0.2 / 38.0)
    approximate, exact = (
        np.abs(monte_carlo(model, jitter, 41, 2000, seed=1)).mean()
        for model in (signal.majority_assignment, signal.whole_fundamental_cycles))
    assert exact == pytest.approx(0.957, abs=0.003)
    assert approximate == pytest.approx(exact, abs=0.01)


def test_folding_differs_from_whole_trigger_cycles():
    distribution = Uniform(0.6)
    signal = AveragedSignal(3, 0.4137)
    folded, whole = (monte_carlo(model, distribution, 3, 40_000, seed=2) for model in (
        signal.whole_fundamental_cycles, signal.whole_trigger_cycles))
    exact = cycle_moments([1.0], [IndependentPulseJitter(distribution)]).averaged(3)
    square = whole.imag**2
    assert square.mean() == pytest.approx(exact.imag_variance[0],
                                          abs=4.5 * square.std() / np.sqrt(square.size))
    assert folded.imag.var() > 1.1 * whole.imag.var()


def test_large_ratios_need_no_splitting():
    signal = AveragedSignal(100, 75.27)
    approximate, exact = (monte_carlo(model, Uniform(0.2), 100, 200, seed=3) for model in (
        signal.majority_assignment, signal.whole_fundamental_cycles))
    np.testing.assert_allclose(np.abs(approximate), np.abs(exact), atol=1e-3)


@pytest.mark.parametrize('ratio', [1.0, 2.286])
def test_leakage_is_a_bias_only_for_integer_ratios(ratio):
    distribution, cycles = Uniform(0.2), 100
    signal = AveragedSignal(cycles, ratio, 1.0, (1.0, 2.0), (1.0, 20.0))
    draws = monte_carlo(signal.whole_trigger_cycles, distribution, cycles, 4000, seed=4)
    moments = multi_harmonic_moments([1.0], [1.0, 2.0], [1.0, 20.0],
                                     [IndependentPulseJitter(distribution)], cycles, ratio)
    error = np.sqrt(moments.variance[0] / draws.size)
    assert abs(draws.mean() - moments.mean[0]) < 4.5 * error
    attenuation = 0.956794 - abs(moments.mean[0])
    assert (attenuation > 0.4) if ratio == 1.0 else (abs(attenuation) < 0.01)


@pytest.mark.parametrize(('distribution', 'order', 'cycles', 'ratio', 'noise'), [
    (Triangular(0.1), 1.0, 40, 0.4137, 0.3), (Normal(0.03), 5.0, 25, 5.8154, 0.05)])
def test_prediction_of_the_distribution_holds_for_other_jitters_ratios_and_strong_noise(
        distribution, order, cycles, ratio, noise):
    jitter = [IndependentPulseJitter(distribution)]
    single = cycle_moments([order], jitter)
    moments = single.averaged(cycles).with_noise(noise)
    predicted = curved_along(Parts.about(
        moments.mean, moments, *third_cumulants([order], jitter, cycles, single)))
    signal = AveragedSignal(cycles, ratio, order)
    draws = np.abs(monte_carlo(signal.whole_trigger_cycles, distribution, cycles, 20_000, seed=6,
                               line_variance=noise))
    result = stats.kstest(draws, lambda x: predicted.cdf(x)[0])
    assert result.pvalue > 1e-3
    assert predicted.mean[0] == pytest.approx(draws.mean(),
                                              abs=4.5 * draws.std() / np.sqrt(draws.size))


def test_chunks_seeds_and_progress():
    signal = AveragedSignal(1000, 2.286)
    shares = []
    draws = monte_carlo(signal.whole_trigger_cycles, Uniform(0.2), 1000, 1200, seed=7,
                        progress=shares.append)
    again = monte_carlo(signal.whole_trigger_cycles, Uniform(0.2), 1000, 1200, seed=7)
    other = monte_carlo(signal.whole_trigger_cycles, Uniform(0.2), 1000, 1200, seed=8)
    np.testing.assert_array_equal(draws, again)
    assert np.all(draws != other)
    assert shares == sorted(shares)
    assert len(shares) == 3
    assert shares[-1] == 1.0
    assert monte_carlo(signal.whole_trigger_cycles, Uniform(0.2), 1000, 3, seed=7).shape == (3,)


@pytest.mark.parametrize(('call', 'error', 'message'), [
    (lambda: AveragedSignal(0, 1.0), ModelError, 'trigger_cycles is 0'),
    (lambda: AveragedSignal(3, -1.0), ModelError, 'cycle_length is -1.0'),
    (lambda: AveragedSignal(3, 1.0, 0.0), ModelError, 'orders hold 0.0'),
    (lambda: AveragedSignal(3, 1.0, 1.0, (1.0, 2.0), (1.0, 2.0, 3.0)), ModelError,
     '3 amplitudes for 2 source_orders'),
    (lambda: AveragedSignal(2, 0.4).whole_fundamental_cycles(np.zeros((1, 3))), ModelError,
     'hold no whole one'),
    (lambda: AveragedSignal(9, 0.4).majority_assignment(np.zeros((1, 10))), ModelError,
     'Eq. 26 needs at least 1'),
    (lambda: monte_carlo(np.abs, Uniform(1.0), 3, 0, seed=1), ParameterError, 'iterations is 0'),
    (lambda: monte_carlo(np.abs, Uniform(1.0), -3, 5, seed=1), ModelError, 'trigger_cycles is -3'),
])
def test_bad_input_is_refused(call, error, message):
    with pytest.raises(error, match=message):
        call()
