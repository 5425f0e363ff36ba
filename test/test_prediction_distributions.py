# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Distributions of the pulse error: their characteristic functions, variances and draws agree."""

import numpy as np
import pytest
from sa_jitter_ros.errors import ModelError
from sa_jitter_ros.prediction.distributions import (
    Empirical, Normal, PulseErrorDistribution, Triangular, Uniform)
from scipy import stats

SKEWED = np.random.default_rng(3).exponential(1e-5, 500)
DISTRIBUTIONS = [Uniform(3e-5), Normal(1e-5), Triangular(1e-5), Empirical(SKEWED)]
FREQUENCIES = np.array([-4e4, -1e3, 0.0, 100.0, 1e3, 1e4, 3.3e4, 1.2e5])


@pytest.mark.parametrize('distribution', DISTRIBUTIONS, ids=lambda item: type(item).__name__)
def test_draws_have_the_distribution_that_the_characteristic_function_says(distribution, rng):
    assert isinstance(distribution, PulseErrorDistribution)
    draws = distribution.draw(rng, 400_000)
    phasors = np.exp(2j * np.pi * np.outer(FREQUENCIES, draws))
    error = np.abs(phasors.mean(axis=1) - distribution.characteristic_function(FREQUENCIES))
    assert np.all(error <= 4.5 / np.sqrt(draws.size))  # E|error|^2 <= 1/n
    assert abs(draws.mean()) < 4.5 * np.sqrt(distribution.variance / draws.size)
    fourth = np.mean(draws**4)
    assert draws.var() == pytest.approx(
        distribution.variance, abs=4.5 * np.sqrt((fourth - distribution.variance**2) / draws.size))
    assert distribution.draw(rng, (3, 4)).shape == (3, 4)


@pytest.mark.parametrize('distribution', DISTRIBUTIONS, ids=lambda item: type(item).__name__)
def test_variance_is_the_curvature_of_the_characteristic_function(distribution):
    step = 1e-3 / np.sqrt(distribution.variance)
    values = distribution.characteristic_function([-step, 0.0, step])
    curvature = np.real(values[0] - 2.0 * values[1] + values[2]) / (2.0 * np.pi * step) ** 2
    assert -curvature == pytest.approx(distribution.variance, rel=1e-4)
    assert values[1] == 1.0


def test_bounded_distributions_fill_their_width_and_no_more(rng):
    for distribution in (Uniform(2.0), Triangular(0.5), Empirical(SKEWED)):
        draws = distribution.draw(rng, 200_000)
        assert 0.95 * distribution.width < np.ptp(draws) <= distribution.width * (1.0 + 1e-12)
    assert stats.norm.cdf(-0.5 * Normal(1.0).width) < 4e-5


def test_a_table_is_centred_and_its_fast_sum_is_the_direct_one():
    distribution = Empirical(SKEWED)
    assert abs(distribution.table.mean()) < 1e-20
    assert distribution.variance == pytest.approx(SKEWED.var(), rel=1e-12)
    frequencies = np.linspace(-3e4, 3e4, 100_001)
    fast = distribution.characteristic_function(frequencies)[::997]
    direct = np.exp(2j * np.pi * np.outer(frequencies[::997], distribution.table)).mean(axis=1)
    np.testing.assert_allclose(fast, direct, atol=1e-12)
    with pytest.raises(ValueError, match='read-only'):
        distribution.table[0] = 1.0


def test_a_constant_table_is_no_jitter():
    assert np.all(Empirical([2e-6, 2e-6]).characteristic_function([[1e3, 2e6]]) == 1.0)


@pytest.mark.parametrize(('make', 'message'), [
    (lambda: Uniform(-1e-6), 'width is -1e-06 s'),
    (lambda: Uniform(float('nan')), 'width is nan s'),
    (lambda: Normal(float('inf')), 'std is inf s'),
    (lambda: Triangular(-1.0), r'std is -1.0 s: it must be finite and not negative'),
    (lambda: Empirical([]), r'shape \(0,\): give one list'),
    (lambda: Empirical([[1.0, 2.0]]), r'shape \(1, 2\)'),
    (lambda: Empirical([1.0, float('nan')]), r'table\[1\] is nan'),
    (lambda: Empirical(['a', 'b']), 'holds a value that is no number'),
])
def test_what_is_no_distribution_is_refused(make, message):
    with pytest.raises(ModelError, match=message):
        make()
