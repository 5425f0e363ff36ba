# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""What each angle law makes of pulse errors: predicted, and by the laws of the averager."""

from dataclasses import replace

import numpy as np
from processes import gaussian_pulse_jitter
import pytest
from sa_jitter_ros.effects import make_effect
from sa_jitter_ros.effects.band import ACCELERATION_BAND
from sa_jitter_ros.errors import ModelError
from sa_jitter_ros.prediction.angle_error import IndependentPulseJitter
from sa_jitter_ros.prediction.distributions import Empirical, Normal, Uniform
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.prediction.moments import cycle_moments
from sa_jitter_ros.prediction.prediction import predict
from sa_jitter_ros.pulses.angle_law import angle_law, ANGLE_LAWS, cycle_times, LINEAR
from scipy import stats

MODEL = DeclaredModel(keyphasor_rate=5000.0, trigger_speed=20.0, trigger_cycles=20,
                      orders=(20.0, 60.0, 120.0), ratio=1.5)
OTHERS = ('quadratic', 'spline')
DRAWS = 200
U, W = np.polynomial.legendre.leggauss(16)
U, W = 0.5 * (U + 1.0), 0.5 * W
SKEWED = tuple(np.random.default_rng(12).exponential(4e-5, 400))


def averaged(model, pulses, true_times=None):
    """
    Return complex amplitudes (draw, order) of averages whose `pulses` (draw, pulse) the law reads.

    `true_times(angle)` (s) is when the shaft is at an angle in trigger cycles, evenly by default.
    """
    law = angle_law(model.angle_law)
    frequency = np.array(model.orders) * model.fundamental_frequency
    total = np.zeros((len(pulses), frequency.size), complex)
    for row, times in zip(total, pulses):
        for k in range(law.before, law.before + model.trigger_cycles):
            wrong = cycle_times(law, times, k, U) - (
                model.trigger_period * (k + U) if true_times is None else true_times(k + U))
            row += np.exp(2j * np.pi * np.multiply.outer(frequency, wrong)) @ W
    return total / model.trigger_cycles


def even(model):
    """Return the times of the pulses that the law reads for one average."""
    return model.trigger_period * np.arange(model.trigger_cycles + model.weights.pulses - 1.0)


def assert_agrees(prediction, draws):
    """Compare moments and law with complex draws, each within 4.5 of its standard errors."""
    n, amplitude = len(draws), np.abs(draws)
    moments = prediction.moments
    off = draws - moments.mean
    for sample, expected in [
            (draws.real, moments.mean.real), (draws.imag, moments.mean.imag),
            (off.real**2, moments.real_variance), (off.imag**2, moments.imag_variance),
            (amplitude, prediction.mean_attenuation)]:
        tolerance = 4.5 * sample.std(axis=0) / np.sqrt(n) + 1e-5
        assert np.all(np.abs(sample.mean(axis=0) - expected) < tolerance)
    for order in range(draws.shape[1]):
        distance = stats.kstest(amplitude[:, order],
                                lambda x, order=order: prediction.cdf(x)[order]).statistic
        assert distance < 0.016 + 1.95 / np.sqrt(n)  # third cumulants of the spline


@pytest.mark.parametrize('name', ANGLE_LAWS)
def test_weights_are_the_slopes_of_the_law(name):
    law, weights = angle_law(name), angle_law(name).weights
    assert (weights.before, weights.after) == (law.before, law.after)
    pulses, u, step = np.arange(30.0), np.linspace(0.0, 1.0, 21), 1e-4
    for j, expected in enumerate(weights.at(u)):
        shift = step * (np.arange(30) == 12 - weights.before + j)
        slope = (cycle_times(law, pulses + shift, 12, u)
                 - cycle_times(law, pulses - shift, 12, u)) / (2.0 * step)
        assert slope == pytest.approx(expected, abs=4.0 * step**2)
    assert weights.at(u).sum(axis=0) == pytest.approx(np.ones(21))


def test_a_model_refuses_an_unknown_law():
    with pytest.raises(ModelError, match="'cubic': choose one of linear, quadratic, spline"):
        replace(MODEL, angle_law='cubic')


@pytest.mark.machines
@pytest.mark.parametrize(('law', 'changes'), [
    ('quadratic', {'trigger_cycles': 4}),
    ('spline', {'jitter_distribution': 'normal', 'trigger_cycles': 12}),
    ('quadratic', {}), ('spline', {'jitter_distribution': 'table', 'jitter_table': SKEWED})],
    ids=['few cycles', 'normal', 'uniform', 'skewed'])
def test_prediction_is_what_the_law_makes_of_jitter(law, changes, rng):
    model = replace(MODEL, angle_law=law, **changes)
    pulses = even(model)
    errors = model.distribution.draw(rng, (DRAWS, pulses.size))
    assert_agrees(predict(model), averaged(model, pulses + errors))


@pytest.mark.parametrize(('law', 'square'), [('linear', 2.0 / 3.0), ('quadratic', 0.8),
                                             ('spline', 0.8742)])
def test_small_jitter_loses_half_the_mean_square_of_the_weights(law, square):
    weights, sigma, cycles = angle_law(law).weights, 2e-3, 500
    moments = cycle_moments([1.0], [IndependentPulseJitter(Normal(sigma), 1.0, weights)])
    angle = (2.0 * np.pi * sigma) ** 2
    assert 1.0 - moments.mean[0].real == pytest.approx(0.5 * square * angle, rel=2e-4)
    # every pulse error moves one cycle in all, whatever the law: its weights have the mean 1
    assert moments.averaged(cycles).imag_variance[0] == pytest.approx(angle / cycles, rel=2e-3)


@pytest.mark.parametrize('law', ANGLE_LAWS)
def test_every_law_sees_normal_jitter_alike_as_pulses_and_as_a_process(law):
    weights = angle_law(law).weights
    orders = np.array([0.3, 1.0, 2.0])
    pulses = cycle_moments(orders, [IndependentPulseJitter(Normal(0.1), 1.0, weights)])
    process = cycle_moments(orders, [gaussian_pulse_jitter([0.01], weights=weights)])
    for name in ('variance', 'pseudo_variance'):
        np.testing.assert_allclose(getattr(process, name), getattr(pulses, name), atol=1e-13)


def test_linear_law_is_what_the_default_is():
    jitter = IndependentPulseJitter(Uniform(0.3)), IndependentPulseJitter(
        Uniform(0.3), 1.0, angle_law('linear').weights)
    assert jitter[0] == jitter[1]
    assert jitter[0].correlation_length == 1
    assert angle_law('linear').weights is LINEAR
    skewed = Empirical(np.array(SKEWED))
    spline = angle_law('spline').weights
    assert IndependentPulseJitter(skewed, 1.0, spline).correlation_length == 17


@pytest.mark.parametrize('law', OTHERS)
def test_known_pulse_errors_make_the_angle_error_of_the_law(law, rng):
    weights = angle_law(law).weights
    errors = 1e-4 * rng.normal(size=13)
    beside = np.concatenate((np.full(weights.before, errors[0]), errors,
                             np.full(weights.after, errors[-1])))
    pulses = np.arange(beside.size) + beside
    path = weights.path(errors, U, 12)
    np.testing.assert_array_equal(path, weights.path(beside, U, 12))
    assert path.shape == (12, U.size)
    for k, row in enumerate(path):
        at = weights.before + k
        assert cycle_times(angle_law(law), pulses, at, U) - at - U == pytest.approx(
            row, abs=1e-6)


@pytest.mark.machines
@pytest.mark.parametrize('law', OTHERS)
def test_correlated_jitter_and_geometry_go_through_the_law(law, rng):
    model = replace(MODEL, angle_law=law)
    pulses = even(model)
    shape = (DRAWS, pulses.size)
    angles = (0.02, -0.01, 0.03)
    slow = rng.normal(0.0, 6e-5, shape)
    for k in range(1, pulses.size):
        slow[:, k] = 0.6 * slow[:, k - 1] + 0.8 * slow[:, k]
    index = (rng.integers(0, 3, (DRAWS, 1)) + np.arange(pulses.size)) % 3
    late = np.array(angles)[index] / (2.0 * np.pi * model.trigger_speed)
    jitter = model.distribution.draw(rng, shape)
    assert_agrees(predict(model, [
        make_effect('correlated_jitter', std=6e-5, correlation=0.6),
        make_effect('target_geometry', pulse_angles=angles)]),
        averaged(model, pulses + jitter + slow + late))


def unsteady(model, acceleration_std, rng):
    """Return the amplitudes (order,) of one average of a machine that accelerates at random."""
    period = model.trigger_period
    f = rng.uniform(*ACCELERATION_BAND, 40)
    phase = rng.uniform(0.0, 2.0 * np.pi, f.size)
    # of a time (s) by angle (trigger cycles), whose second derivative is the acceleration
    size = acceleration_std / (2.0 * np.pi) * np.sqrt(2.0 / f.size) * period**3 / (
        2.0 * np.pi * f) ** 2

    def true_times(angle):
        turns = 2.0 * np.pi * np.multiply.outer(angle, f)
        return period * angle + np.sin(turns + phase) @ size

    pulses = true_times(np.arange(model.trigger_cycles + model.weights.pulses - 1.0))
    return averaged(model, pulses[None], true_times)[0]


@pytest.mark.machines
@pytest.mark.parametrize('law', OTHERS)
def test_speed_fluctuation_is_what_the_law_cannot_follow(law, rng):
    model = replace(MODEL, angle_law=law, keyphasor_rate=1e9, orders=(30.0, 60.0))
    std = 60.0
    draws = np.array([unsteady(model, std, rng) for _ in range(DRAWS // 2)])
    effect = make_effect('speed_fluctuation', acceleration_std=std)
    prediction = predict(model, [effect])
    assert np.abs(prediction.moments.mean) == pytest.approx(
        draws.mean(axis=0).real, abs=4.5 * draws.real.std(axis=0).max() / np.sqrt(len(draws)))
    linear = predict(replace(model, angle_law='linear'), [effect]).mean_attenuation
    assert np.all(1.0 - prediction.mean_attenuation < 0.5 * (1.0 - linear))


@pytest.mark.parametrize('law', OTHERS)
def test_a_gap_is_refused_where_the_law_bends_around_it(law):
    effect = make_effect('missing_pulses', probability=0.01)
    with pytest.raises(ModelError, match=f'{law}.*no forward model; declare linear'):
        predict(replace(MODEL, angle_law=law), [effect])
