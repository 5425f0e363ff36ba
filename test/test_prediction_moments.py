# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Exact moments: closed forms, published values, Monte Carlo, and every combination of effects."""

import numpy as np
from processes import gaussian_pulse_jitter
import pytest
from sa_jitter_ros.errors import ModelError
from sa_jitter_ros.prediction import moments
from sa_jitter_ros.prediction.angle_error import (
    GaussianAngleError, IndependentPulseJitter, joint_characteristic)
from sa_jitter_ros.prediction.cumulants import third_cumulants
from sa_jitter_ros.prediction.distributions import Empirical, Normal, Triangular, Uniform
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.prediction.moments import cycle_moments, noise_line_variance
from sa_jitter_ros.prediction.scenario_moments import scenario_moments
from validation.analytic import normal_mean, uniform_mean

EXPONENTIAL = Empirical(np.random.default_rng(8).exponential(0.15, 3000))


def averages(errors, order, offset=None):
    """Average over the cycles of pulse errors of shape (n, cycles + 1), by brute quadrature."""
    x, w = np.polynomial.legendre.leggauss(24)
    u = 0.5 * (x + 1.0)
    angle = errors[:, :-1, None] * (1.0 - u) + errors[:, 1:, None] * u
    if offset is not None:
        angle = angle + offset(u)
    return (np.exp(2j * np.pi * order * angle) @ (0.5 * w)).mean(axis=1)


def assert_moments(draws, moments, index=0):
    """Compare draws with moments, each within 4.5 of its own standard errors."""
    n = draws.size
    centred = draws - moments.mean[index]
    for sample, expected in [
            (centred.real, 0.0), (centred.imag, 0.0),
            (centred.real**2, moments.real_variance[index]),
            (centred.imag**2, moments.imag_variance[index]),
            (centred.real * centred.imag, 0.5 * moments.pseudo_variance.imag[index]),
            (np.abs(draws) ** 2, moments.mean_square[index])]:
        tolerance = 4.5 * sample.std() / np.sqrt(n) + 1e-12
        assert sample.mean() == pytest.approx(expected, abs=tolerance)


def test_published_values_of_uniform_jitter():
    expected = np.array([  # width in cycles, mean, Var Re, Var Im, lag 1 Re, lag 1 Im
        [0.1, 0.989075, 0.0000773, 0.016199, 0.0000238, 0.008099],
        [0.2, 0.956794, 0.001193, 0.061875, 0.000367, 0.030935],
        [0.3, 0.904607, 0.005693, 0.128906, 0.001752, 0.064420],
        [0.4, 0.834840, 0.016556, 0.205717, 0.005095, 0.102685],
        [0.6, 0.655409, 0.065961, 0.339871, 0.020283, 0.168306],
        [0.8, 0.448639, 0.148406, 0.393444, 0.045460, 0.189768]])
    cycles = cycle_moments(expected[:, 0], [IndependentPulseJitter(Uniform(1.0))])
    one, next_one = cycles.lag(0), cycles.lag(1)
    got = np.column_stack([expected[:, 0], np.real(cycles.mean), one.real_variance,
                           one.imag_variance, next_one.real_variance, next_one.imag_variance])
    np.testing.assert_allclose(got, expected, atol=1.01e-6)  # the source's draws and digits


def test_closed_forms_agree_with_quadrature_to_1e_10():
    spread = np.array([0.01, 0.1, 0.4, 0.8, 1.5, 3.0])
    uniform = cycle_moments(spread, [IndependentPulseJitter(Uniform(1.0))]).mean
    normal = cycle_moments(spread, [IndependentPulseJitter(Normal(1.0))], nodes=96).mean
    np.testing.assert_allclose(uniform, uniform_mean(spread), atol=1e-10)
    np.testing.assert_allclose(normal, normal_mean(spread), atol=1e-10)


def test_small_jitter_has_the_limits_of_a_taylor_series():
    sigma = 2e-3
    for distribution, fourth in ((Uniform(np.sqrt(12.0) * sigma), 0.117), (Normal(sigma), 0.25)):
        moments = cycle_moments([1.0], [IndependentPulseJitter(distribution)]).averaged(500)
        angle = (2.0 * np.pi * sigma) ** 2
        assert 1.0 - moments.mean[0].real == pytest.approx(angle / 3.0, rel=1e-3)
        assert moments.imag_variance[0] == pytest.approx(angle / 500, rel=2e-3)
        assert moments.real_variance[0] == pytest.approx(fourth * angle**2 / 500, rel=5e-3)


@pytest.mark.machines
@pytest.mark.parametrize('distribution', [
    Uniform(0.9), Triangular(0.2), EXPONENTIAL, Normal(0.15)],
    ids=lambda distribution: type(distribution).__name__)
@pytest.mark.parametrize('cycles', [1, 3, 8])
def test_moments_and_third_cumulants_agree_with_monte_carlo(distribution, cycles, rng):
    order = 0.7
    jitter = [IndependentPulseJitter(distribution)]
    single = cycle_moments([order], jitter)
    moments = single.averaged(cycles)
    draws = averages(distribution.draw(rng, (25_000, cycles + 1)), order)
    assert_moments(draws, moments)
    off = draws - moments.mean[0]
    for sample, expected in zip((off**3, off * np.abs(off) ** 2),
                                third_cumulants([order], jitter, cycles, single)):
        for part in (np.real, np.imag):
            tolerance = 4.5 * part(sample).std() / np.sqrt(off.size) + 1e-12
            assert part(sample).mean() == pytest.approx(part(expected[0]), abs=tolerance)


def test_many_orders_are_taken_in_parts(monkeypatch):
    orders, sizes, process = np.arange(1.0, 41.0), [], IndependentPulseJitter(Uniform(0.03))

    def noted(processes, coefficients, *places):
        sizes.append(len(coefficients[0]))
        return joint_characteristic(processes, coefficients, *places)

    monkeypatch.setattr(moments, 'joint_characteristic', noted)
    found = cycle_moments(orders, [process])
    assert max(sizes) <= 16
    for place in (0, 20, 39):
        one = cycle_moments(orders[place:place + 1], [process])
        for name in ('mean', 'variance', 'pseudo_variance'):
            np.testing.assert_allclose(getattr(found, name)[..., place],
                                       getattr(one, name)[..., 0], rtol=1e-9, atol=1e-14)


def test_seconds_become_cycles_by_the_fundamental_frequency():
    in_cycles = cycle_moments([3.0, 7.0], [IndependentPulseJitter(Uniform(0.05))])
    in_seconds = cycle_moments([3.0, 7.0], [IndependentPulseJitter(Uniform(0.05 / 40.0), 40.0)])
    np.testing.assert_allclose(in_seconds.variance, in_cycles.variance, atol=1e-15)


def test_normal_jitter_is_the_same_as_pulses_and_as_a_gaussian_process():
    orders = np.array([0.3, 1.0, 2.0])
    pulses = cycle_moments(orders, [IndependentPulseJitter(Normal(0.1))])
    process = gaussian_pulse_jitter([0.01])
    both = cycle_moments(orders, [process])
    for name in ('variance', 'pseudo_variance'):
        np.testing.assert_allclose(getattr(both, name)[:2], getattr(pulses, name), atol=1e-14)
    a, b = (third_cumulants(orders, [p], 12, c) for p, c in (
        (IndependentPulseJitter(Normal(0.1)), pulses), (process, both)))
    np.testing.assert_allclose(a, b, atol=1e-14)


def test_correlated_jitter_and_an_independent_kind_combine(rng):
    rho, std, cycles = 0.4, 0.08, 5  # moving average: correlation 0.4 at lag 1
    b = (1.0 - np.sqrt(1.0 - 4.0 * rho**2)) / (2.0 * rho)
    noise = rng.normal(0.0, std / np.sqrt(1.0 + b**2), (60_000, cycles + 2))
    errors = noise[:, 1:] + b * noise[:, :-1] + Uniform(0.2).draw(rng, (60_000, cycles + 1))
    processes = [gaussian_pulse_jitter([std**2, rho * std**2]),
                 IndependentPulseJitter(Uniform(0.2))]
    assert_moments(averages(errors, 0.9), cycle_moments([0.9], processes).averaged(cycles))


def test_a_bump_in_every_cycle_as_a_speed_fluctuation_gives(rng):
    amplitude, cycles = 0.5, 4

    def covariance(u, v, lag):
        bump = amplitude**2 * u * (1.0 - u) * v * (1.0 - v)
        return bump if lag == 0 else np.zeros_like(bump)

    x, w = np.polynomial.legendre.leggauss(24)
    u = 0.5 * (x + 1.0)
    heights = rng.normal(0.0, amplitude, (60_000, cycles))
    draws = (np.exp(2j * np.pi * 1.3 * heights[:, :, None] * u * (1.0 - u)) @ (0.5 * w)).mean(1)
    moments = cycle_moments([1.3], [GaussianAngleError(covariance, 0)]).averaged(cycles)
    assert_moments(draws, moments)
    gain = np.sum(0.5 * w * np.exp(-2.0 * (np.pi * 1.3 * amplitude * u * (1.0 - u)) ** 2))
    assert moments.mean[0].real == pytest.approx(gain, abs=1e-12)


def unit_model(cycles, *orders):
    """Model of a shaft that turns once a second, so that errors in s are fundamental cycles."""
    return DeclaredModel(keyphasor_rate=100.0, trigger_speed=1.0, trigger_cycles=cycles,
                         orders=orders)


def test_known_pulse_errors_beside_random_jitter(rng):
    cycles = 6
    known = 0.2 * rng.normal(size=cycles + 1)

    def offset(u):
        return known[:-1, None] * (1.0 - u) + known[1:, None] * u

    moments = scenario_moments(unit_model(cycles, 0.8), [IndependentPulseJitter(Triangular(0.1))],
                               known[None])
    errors = Triangular(0.1).draw(rng, (30_000, cycles + 1))
    assert_moments(averages(errors, 0.8, offset), moments.of(0))


def test_clock_skew_alone_is_a_sinc():
    cycles, slip = 50, 0.013  # fundamental cycles of delay per trigger cycle
    moments = scenario_moments(unit_model(cycles, 1.0, 2.0), [],
                               slip * np.arange(cycles + 1.0)[None])
    np.testing.assert_allclose(np.abs(moments.mean[0]),
                               np.abs(np.sinc(slip * cycles * np.array([1.0, 2.0]))), atol=1e-12)
    np.testing.assert_allclose(moments.variance, 0.0, atol=1e-15)


def test_known_errors_of_0_change_nothing():
    jitter = [IndependentPulseJitter(EXPONENTIAL)]
    centred = cycle_moments([0.5, 1.0], jitter).averaged(7)
    known = scenario_moments(unit_model(7, 0.5, 1.0), jitter, np.zeros((1, 8)))
    for name in ('mean', 'variance', 'pseudo_variance'):
        np.testing.assert_allclose(getattr(known, name)[0], getattr(centred, name), atol=1e-13)


def test_noise_in_one_line_of_an_average_in_peak_units(rng):
    rate, samples, std = 1000.0, 500, 0.7
    time = np.arange(samples) / rate
    noise = rng.normal(0.0, std, (20_000, samples))
    lines = 2.0 * noise @ np.exp(-2j * np.pi * 62.0 * time) / samples
    power = np.abs(lines) ** 2
    assert power.mean() == pytest.approx(noise_line_variance(std, rate, samples / rate),
                                         abs=4.5 * power.std() / np.sqrt(power.size))
    half = lines.real**2
    assert half.mean() == pytest.approx(0.5 * noise_line_variance(std, rate, samples / rate),
                                        abs=4.5 * half.std() / np.sqrt(half.size))


@pytest.mark.parametrize(('call', 'message'), [
    (lambda jitter: cycle_moments([1.0, -2.0], jitter), 'orders hold -2.0'),
    (lambda jitter: cycle_moments([], jitter), r'orders have the shape \(0,\)'),
    (lambda jitter: cycle_moments([np.nan], jitter), 'orders hold nan'),
    (lambda jitter: cycle_moments([1.0], jitter).averaged(0), 'trigger_cycles is 0'),
    (lambda jitter: cycle_moments([1.0], jitter).averaged(2.5), 'trigger_cycles is 2.5'),
])
def test_bad_input_is_refused(call, message):
    with pytest.raises(ModelError, match=message):
        call([IndependentPulseJitter(Uniform(0.1))])
