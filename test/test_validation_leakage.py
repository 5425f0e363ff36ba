# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Leakage between components: brute quadrature, one component alone, components far apart."""

from itertools import product

import numpy as np
import pytest
from sa_jitter_ros.errors import ModelError
from sa_jitter_ros.prediction.angle_error import IndependentPulseJitter
from sa_jitter_ros.prediction.distributions import Empirical, Uniform
from sa_jitter_ros.prediction.moments import cycle_moments
from test_prediction_moments import assert_moments
from validation.analytic import multi_harmonic_moments

EXPONENTIAL = Empirical(np.random.default_rng(8).exponential(0.15, 3000))


@pytest.mark.machines
@pytest.mark.parametrize(('ratio', 'cycles'), [(1.0, 6), (2.0, 3), (0.4137, 3), (5.8154, 4)])
def test_leakage_between_components(ratio, cycles, rng):
    distribution, sources, amplitudes = EXPONENTIAL, (1.0, 2.0, 3.0), (1.0, 0.5j, -2.0)
    moments = multi_harmonic_moments(
        [2.0], sources, amplitudes, [IndependentPulseJitter(distribution)], cycles, ratio)
    errors = distribution.draw(rng, (40_000, cycles + 1))
    x, w = np.polynomial.legendre.leggauss(64)
    u = 0.5 * (x + 1.0)
    draws = 0.0
    for k, (source, amplitude) in product(range(cycles), zip(sources, amplitudes)):
        angle = np.outer(errors[:, k], 1.0 - u) + np.outer(errors[:, k + 1], u)
        turn = np.exp(2j * np.pi * (source - 2.0) * ratio * (k + u))
        draws = draws + amplitude * (np.exp(2j * np.pi * source * angle) @ (0.5 * w * turn))
    assert_moments(draws / cycles, moments)


def test_leakage_over_many_orders_takes_the_nodes_it_needs():
    jitter = [IndependentPulseJitter(Uniform(0.4 / 19.0))]
    default, fine = (multi_harmonic_moments(
        [19.0, 38.0], [19.0, 38.0], [1.0, 2.0], jitter, 41, 2.40789, nodes=n) for n in (64, 400))
    for name in ('mean', 'variance', 'pseudo_variance'):
        np.testing.assert_allclose(getattr(default, name), getattr(fine, name), atol=1e-12)


def test_one_component_alone_is_the_single_harmonic_case():
    jitter = [IndependentPulseJitter(Uniform(0.3))]
    single = cycle_moments([1.0], jitter).averaged(9)
    multi = multi_harmonic_moments([1.0], [1.0], [1.0], jitter, 9, 2.286)
    np.testing.assert_allclose(multi.variance, single.variance, atol=1e-14)
    np.testing.assert_allclose(multi.pseudo_variance, single.pseudo_variance, atol=1e-14)


@pytest.mark.parametrize(('source', 'length', 'message'), [
    (1.0, 0.0, 'cycle_length is 0.0'), (500.0, 1.0, 'makes 499 turns a trigger cycle')])
def test_leakage_that_makes_no_sense_is_refused(source, length, message):
    with pytest.raises(ModelError, match=message):
        multi_harmonic_moments([1.0], [source], [1.0], [IndependentPulseJitter(Uniform(0.1))], 3,
                               length)
