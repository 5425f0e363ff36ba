# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The prediction: declared models, every distribution, effects."""

from dataclasses import dataclass, replace

import numpy as np
from processes import gaussian_pulse_jitter
import pytest
from sa_jitter_ros.effects import make_effect
from sa_jitter_ros.errors import ModelError, ParameterError
from sa_jitter_ros.prediction.amplitude_distribution import AmplitudeDistribution
from sa_jitter_ros.prediction.angle_error import GaussianAngleError, IndependentPulseJitter
from sa_jitter_ros.prediction.distributions import Empirical, Normal, Triangular, Uniform
from sa_jitter_ros.prediction.influence import Influence, KnownGain
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.prediction.prediction import predict
from sa_jitter_ros.prediction.sampled_distribution import SampledDistribution
from scipy import signal, stats
from validation.monte_carlo import AveragedSignal, monte_carlo

MODEL = DeclaredModel(keyphasor_rate=5000.0, trigger_speed=20.0, trigger_cycles=41,
                      orders=(1.0, 19.0, 38.0), ratio=2.40789)
SKEWED = tuple(np.random.default_rng(12).exponential(4e-5, 400))


@dataclass(frozen=True)
class Given(Influence):
    """Processes and noise as they are given, `alone` in the place of the declared jitter."""

    name = 'given'
    items: tuple = ()
    variance: object = 0.0
    alone: bool = False

    def processes(self, model):
        return self.items

    def line_variance(self, model):
        return self.variance

    def replaces_jitter(self, model):
        return self.alone


def simulate(model, order, iterations, seed):
    """Amplitudes of one order of whole trigger cycles, noise included."""
    averaged = AveragedSignal(model.trigger_cycles, model.cycle_length, order)
    noise = (4.0 * model.noise**2 / (model.sample_rate * model.duration)
             if model.noise else 0.0)

    class Scaled:
        """The declared distribution in fundamental cycles."""

        def draw(self, rng, shape):
            return model.fundamental_frequency * model.distribution.draw(rng, shape)

    return np.abs(monte_carlo(averaged.whole_trigger_cycles, Scaled(), model.trigger_cycles,
                              iterations, seed=seed, line_variance=noise))


@pytest.mark.machines
@pytest.mark.parametrize(('changes', 'order', 'bias'), [
    ({}, 38.0, 0.004),
    ({'ratio': 0.4137, 'trigger_cycles': 3, 'jitter_distribution': 'table',
      'jitter_table': SKEWED, 'noise_std': 6.0, 'sample_rate': 5e4}, 200.0, 0.004),
    ({'ratio': 5.8154, 'jitter_distribution': 'triangular', 'noise_std': 20.0,
      'sample_rate': 5e4}, 16.0, 0.004),
    ({'ratio': 5.8154, 'trigger_cycles': 1}, 16.0, 0.004),
    ({'jitter_distribution': 'normal', 'jitter_std': 1e-4, 'trigger_cycles': 12}, 30.0, 0.004),
    ({'jitter_distribution': 'table', 'jitter_table': SKEWED, 'trigger_cycles': 15}, 38.0, 0.004),
    ({'jitter_distribution': 'table', 'jitter_table': SKEWED, 'trigger_cycles': 60}, 38.0, 0.004),
    ({'pulses_per_revolution': 6, 'pulses_per_trigger': 2, 'trigger_cycles': 123}, 38.0, 0.004)])
def test_prediction_agrees_with_an_independent_simulation(changes, order, bias):
    model = replace(MODEL, orders=(0.5 * order, order), **changes)
    prediction = predict(model)
    draws = simulate(model, order, 20_000, seed=21)
    root_n = np.sqrt(draws.size)
    distance = stats.kstest(draws, lambda x: prediction.cdf(x)[1]).statistic
    assert distance < bias + 1.95 / root_n
    assert prediction.mean_attenuation[1] == pytest.approx(
        draws.mean(), abs=4.5 * draws.std() / root_n + 0.01 * draws.std())
    assert prediction.standard_deviation[1] == pytest.approx(draws.std(), rel=0.03)
    power = draws**2
    exact = prediction.mean_attenuation**2 + prediction.variance
    assert exact[1] == pytest.approx(power.mean(), abs=4.5 * power.std() / root_n)
    np.testing.assert_allclose(exact, prediction.moments.mean_square, rtol=1e-9)
    for name, level in (('quantile_05', 0.05), ('quantile_50', 0.5), ('quantile_95', 0.95)):
        below = np.mean(draws <= getattr(prediction, name)[1])
        tolerance = bias + 4.5 * np.sqrt(level * (1.0 - level)) / root_n
        assert below == pytest.approx(level, abs=tolerance)


def test_few_cycles_are_sampled_and_many_are_not():
    assert isinstance(predict(replace(MODEL, trigger_cycles=3)).distribution, SampledDistribution)
    assert isinstance(predict(MODEL).distribution, AmplitudeDistribution)
    first, second = (predict(replace(MODEL, trigger_cycles=2)).quantile_50 for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_declared_distributions_and_lengths():
    assert MODEL.distribution == Uniform(2e-4)
    std = 1.0 / (np.sqrt(12.0) * 5000.0)
    normal = replace(MODEL, jitter_distribution='normal')
    assert normal.distribution == Normal(std)
    assert replace(normal, jitter_std=3e-5).distribution == Normal(3e-5)
    assert replace(MODEL, jitter_distribution='triangular').distribution == Triangular(std)
    table = replace(MODEL, jitter_distribution='table', jitter_table=[1e-5, 3e-5])
    assert isinstance(table.distribution, Empirical)
    assert predict(table).header == (20.0, 5000.0, 41.0, 2.40789, pytest.approx(1e-5), 0.0)
    six = replace(MODEL, pulses_per_revolution=6, pulses_per_trigger=2)
    assert six.trigger_period == pytest.approx(1.0 / 60.0)
    assert six.cycle_length == pytest.approx(2.40789 / 3.0)
    assert replace(six, pulses_per_trigger=0).trigger_period == pytest.approx(0.05)
    assert six.duration == pytest.approx(41.0 / 60.0)


def test_noise_adds_to_the_mean_square_what_one_line_holds():
    noisy = replace(MODEL, noise_std=2.0, sample_rate=5e4)
    gained = predict(noisy).moments.mean_square - predict(MODEL).moments.mean_square
    np.testing.assert_allclose(gained, 4.0 * 4.0 / (5e4 * MODEL.duration), rtol=1e-9)
    assert np.all(predict(noisy).standard_deviation > predict(MODEL).standard_deviation)


@pytest.mark.parametrize('cycles', [3, 41])
def test_gain_acts_on_the_component_alone_and_noise_adds_to_the_mean_square(cycles):
    model = replace(MODEL, trigger_cycles=cycles)
    usual = predict(model)
    half = predict(model, [KnownGain(0.5)])
    np.testing.assert_allclose(half.mean_attenuation, 0.5 * usual.mean_attenuation, rtol=1e-6)
    np.testing.assert_allclose(half.quantile_05, 0.5 * usual.quantile_05, rtol=1e-5)
    turned = predict(model, [KnownGain(1j)])
    np.testing.assert_allclose(turned.quantile_95, usual.quantile_95, rtol=1e-6)
    loud = predict(model, [Given(variance=np.array([0.0, 0.1, 0.2]))])
    np.testing.assert_allclose(loud.moments.mean_square - usual.moments.mean_square,
                               [0.0, 0.1, 0.2], atol=1e-12)


def test_excess_jitter_of_few_cycles_is_sampled_with_the_declared_one(rng):
    model = replace(MODEL, orders=(19.0,), trigger_cycles=3)
    frequency = model.fundamental_frequency
    excess = IndependentPulseJitter(Normal(8e-5), frequency)
    prediction = predict(model, [Given([excess])])
    assert isinstance(prediction.distribution, SampledDistribution)
    errors = frequency * (model.distribution.draw(rng, (20_000, 4)) + 8e-5 * rng.normal(
        size=(20_000, 4)))
    draws = np.abs(AveragedSignal(3, model.cycle_length, 19.0).whole_trigger_cycles(errors))
    assert stats.ks_2samp(draws, prediction.distribution.draws[0]).pvalue > 1e-3


def test_correlated_jitter_is_predicted_beside_the_declared_one(rng):
    model = replace(MODEL, orders=(19.0,), trigger_cycles=20)
    std = 0.012  # fundamental cycles
    prediction = predict(model, [Given([gaussian_pulse_jitter([std**2, 0.5 * std**2])])])
    noise = rng.normal(0.0, std / np.sqrt(2.0), (20_000, 22))
    errors = (noise[:, 1:] + noise[:, :-1]
              + model.fundamental_frequency * model.distribution.draw(rng, (20_000, 21)))
    draws = np.abs(AveragedSignal(20, 2.40789, 19.0).whole_trigger_cycles(errors))
    distance = stats.kstest(draws, lambda x: prediction.cdf(x)[0]).statistic
    assert distance < 0.01 + 1.95 / np.sqrt(draws.size)
    assert prediction.mean_attenuation[0] == pytest.approx(
        draws.mean(), abs=4.5 * draws.std() / np.sqrt(draws.size))


def slow_wander(std):
    """Exponentially correlated angle error that forgets a fifth of itself in a trigger cycle."""
    return GaussianAngleError(lambda u, v, lag: std**2 * 0.8 ** np.abs(lag + v - u), 40)


@pytest.mark.machines
@pytest.mark.parametrize(('cycles', 'std'), [(41, 0.05), (41, 0.15), (130, 0.1)])
def test_slow_wander_is_predicted_beside_jitter(cycles, std, rng):
    model = replace(MODEL, orders=(38.0,), trigger_cycles=cycles)
    prediction = predict(model, [Given([slow_wander(std / 38.0)])])
    points, n = 6, 6000  # points in a cycle
    forget = 0.8 ** (1.0 / points)
    noise = np.sqrt(1.0 - forget**2) * rng.normal(size=(points * cycles, n))
    noise[0] /= np.sqrt(1.0 - forget**2)
    wander = signal.lfilter([1.0], [1.0, -forget], noise, axis=0).reshape(cycles, points, n)
    errors = model.fundamental_frequency * model.distribution.draw(rng, (cycles + 1, 1, n))
    u = (np.arange(points)[:, None] + 0.5) / points
    angle = errors[:-1] * (1.0 - u) + errors[1:] * u + std / 38.0 * wander
    draws = np.abs(np.exp(2j * np.pi * 38.0 * angle).mean(axis=(0, 1)))
    distance = stats.kstest(draws, lambda x: prediction.cdf(x)[0]).statistic
    assert distance < 0.012 + 1.95 / np.sqrt(n)
    assert prediction.standard_deviation[0] == pytest.approx(draws.std(), rel=0.075)
    assert prediction.mean_attenuation[0] == pytest.approx(draws.mean(), abs=0.004)


@pytest.mark.parametrize('memory', [3, 40, 10**9])
def test_an_effect_of_no_size_changes_nothing(memory):
    tiny = GaussianAngleError(lambda u, v, lag: np.full(np.broadcast(u, v).shape, 1e-20), memory)
    np.testing.assert_allclose(predict(MODEL, [Given([tiny])]).standard_deviation,
                               predict(MODEL).standard_deviation, rtol=1e-6)


def test_effects_can_take_the_place_of_the_declared_jitter():
    nothing = predict(MODEL, [Given(alone=True)])
    np.testing.assert_allclose(nothing.mean_attenuation, 1.0, rtol=1e-12)
    np.testing.assert_allclose(nothing.quantile_05, 1.0, rtol=1e-7)  # sqrt of rounding errors
    std = MODEL.fundamental_frequency / (np.sqrt(12.0) * MODEL.keyphasor_rate)
    process = predict(MODEL, [Given([gaussian_pulse_jitter([std**2])], alone=True)])
    normal = predict(replace(MODEL, jitter_distribution='normal'))
    np.testing.assert_allclose(process.quantile_05, normal.quantile_05, rtol=1e-7)


@pytest.mark.parametrize(('changes', 'message'), [
    ({'keyphasor_rate': 0.0}, 'keyphasor_rate is 0.0: it must be finite and above 0'),
    ({'keyphasor_rate': 'fast'}, "keyphasor_rate is 'fast': it must be finite and above 0"),
    ({'keyphasor_rate': None}, 'keyphasor_rate is None'),
    ({'trigger_cycles': float('inf')}, 'trigger_cycles is inf: an average holds a whole number'),
    ({'trigger_cycles': '3'}, 'trigger_cycles is 3: an average holds a whole number'),
    ({'trigger_cycles': None}, 'trigger_cycles is None'),
    ({'orders': ('first',)}, 'orders hold a value that is no number'),
    ({'pulses_per_revolution': 1.5}, 'pulses_per_revolution is 1.5: it must be finite and whole'),
    ({'jitter_table': None}, 'jitter_table is None: give a list of pulse errors in s'),
    ({'jitter_distribution': 'table'}, 'jitter_distribution is table and jitter_table is empty'),
    ({'keyphasor_rate': float('nan')}, 'keyphasor_rate is nan'),
    ({'trigger_speed': -3.0}, 'trigger_speed is -3.0'),
    ({'ratio': float('inf')}, 'ratio is inf'),
    ({'trigger_cycles': 0}, 'trigger_cycles is 0: an average holds a whole number of at least 1'),
    ({'orders': ()}, r'orders have the shape \(0,\)'),
    ({'orders': (1.0, -1.0)}, 'orders hold -1.0'),
    ({'pulses_per_revolution': 0}, 'pulses_per_revolution is 0'),
    ({'pulses_per_trigger': -1}, 'pulses_per_trigger is -1'),
    ({'jitter_distribution': 'cauchy'}, "jitter_distribution is 'cauchy': choose one of uniform"),
    ({'jitter_std': -1e-6}, 'jitter_std is -1e-06'),
    ({'jitter_distribution': 'table', 'jitter_table': (0.0, float('nan'))}, r'table\[1\] is nan'),
    ({'noise_std': 0.1}, 'noise_std is 0.1 without sample_rate'),
    ({'sample_rate': 3000.0}, 'order 38 is above the Nyquist order 31.1476'),
    ({'keyphasor_rate': 20.0}, 'spread over 0.05 s but a trigger cycle lasts 0.05 s'),
    ({'jitter_distribution': 'normal', 'jitter_std': 0.01}, 'pulses could swap'),
    ({'jitter_distribution': 'table', 'jitter_table': (-0.04, 0.04)}, 'spread over 0.08 s'),
])
def test_models_that_make_no_sense_are_refused(changes, message):
    with pytest.raises(ModelError, match=message):
        replace(MODEL, **changes)


@pytest.mark.parametrize(('effect', 'message'), [
    (KnownGain(np.nan), 'gain is nan: it must be finite'),
    (KnownGain(np.ones(2)), r'gain has the shape \(2,\): give one value, or 3'),
    (Given(variance=-1.0), 'line_variance is -1.0: it must be finite and at least 0')])
def test_gain_and_noise_that_are_none_are_refused(effect, message):
    with pytest.raises(ModelError, match=message):
        predict(MODEL, [effect])


def test_distribution_function_of_nothing_is_nothing():
    for cycles in (3, 41):
        below = predict(replace(MODEL, trigger_cycles=cycles)).cdf([-1.0, np.nan, np.inf])
        np.testing.assert_allclose(below, np.tile([0.0, np.nan, 1.0], (3, 1)), atol=1e-8)


@pytest.mark.parametrize(('call', 'error', 'message'), [
    (lambda: Normal('wide'), ModelError, 'std is wide s: it must be finite'),
    (lambda: predict(MODEL).ppf('half'), ParameterError, 'must be numbers between 0 and 1'),
])
def test_what_is_no_number_is_refused(call, error, message):
    with pytest.raises(error, match=message):
        call()


def test_effect_of_no_size_changes_no_drawn_prediction():
    """Averages of few cycles are drawn, but exact moments leave little of the chance in it."""
    model = replace(MODEL, trigger_cycles=18, pulses_per_revolution=10, pulses_per_trigger=1,
                    ratio=30.1, orders=(21.0, 63.0), trigger_speed=0.45, jitter_std=1.5e-4,
                    jitter_distribution='normal')
    angles = tuple(2e-4 * np.random.default_rng(3).standard_normal(10))
    geometry = make_effect('target_geometry', pulse_angles=angles)
    alone = predict(model, [geometry])
    beside = predict(model, [geometry, make_effect('phase_wander', std=1e-9, bandwidth=0.2)])
    error = 0.5 * np.sqrt(2.0 / beside.distribution.draws.shape[1])  # of a standard deviation
    np.testing.assert_allclose(beside.standard_deviation, alone.standard_deviation,
                               rtol=3.0 * error)
    np.testing.assert_allclose(beside.mean_attenuation, alone.mean_attenuation, atol=5e-5)
