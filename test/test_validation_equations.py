# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Eqs. 5 to 18 and the bench's spectrum: what is printed, what holds, what the package does."""

import numpy as np
import pytest
from validation import bench_spectrum, printed_equations
from validation.bench import FAST


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


def test_the_peak_of_a_modulated_tone_has_its_place_and_width(rng):
    # a speed that wanders slowly by 0.2 %: RMS width 7.6 Hz, beside the 2.5 Hz of the window
    time = np.arange(round(2.0 * FAST)) / FAST
    wander = 7.6 * np.sqrt(2.0) * np.sin(2.0 * np.pi * 1.5 * time)
    tone = np.cos(2.0 * np.pi * np.cumsum(3800.0 + wander) / FAST)
    density = bench_spectrum.spectrum(tone + 0.01 * rng.normal(size=time.size))
    centre, height, width = bench_spectrum.peak(*density, 2)
    assert centre == pytest.approx(3800.0, abs=0.5)
    assert height > 40.0
    assert width == pytest.approx(np.hypot(7.6, 2.5), rel=0.1)
