# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Eqs. 5 to 18: what is printed, what holds, what the package does."""

import numpy as np
import pytest
from validation import printed_equations


@pytest.mark.parametrize('erratum', [
    printed_equations.slope_of_the_linear_law, printed_equations.sum_of_the_cycles,
    lambda: printed_equations.phase_of_a_cycle(0.5, 10.0), printed_equations.initial_phase])
def test_errata_of_the_first_equations(erratum):
    found = erratum()
    assert found.printed_error > 0.5
    assert found.right_error < 1e-12


@pytest.mark.parametrize('order', [1.0, 4.0, 7.0])
def test_equation_17_is_right_where_the_cycle_has_length_1(order):
    found = printed_equations.phase_of_a_cycle(1.0, order)
    assert max(found.printed_error, found.right_error) < 1e-12


@pytest.mark.parametrize('order', [1.0, 5.0])
def test_jittered_cycles_are_those_of_equation_18(order):
    read, given = printed_equations.jittered_cycles(order, 0.3)
    np.testing.assert_allclose(read, given, atol=1e-11)
    exact = np.exp(2j * np.pi * (order * np.arange(read.shape[1]) / read.shape[1] + 0.3))
    assert np.abs(read - exact).max() > 0.3  # jitter of up to a tenth of a cycle


def test_averages_are_a_comb_filter_that_leaves_a_root_of_the_noise():
    assert printed_equations.comb_error() < 1e-6
    left, standard_error = printed_equations.noise_left()
    assert abs(left - 1.0) < 4.0 * standard_error
