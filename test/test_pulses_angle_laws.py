# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Angle laws: exact where they claim to be, local, and refusing pulses out of order."""

from hypothesis import given, strategies as st
import numpy as np
import pytest
from sa_jitter_ros.errors import ParameterError, SignalError
from sa_jitter_ros.pulses.angle_law import angle_law, ANGLE_LAWS, cycle_times, run_lines

U = np.linspace(0.0, 1.0, 33)


@pytest.mark.parametrize('name', ANGLE_LAWS)
@given(st.lists(st.floats(0.8, 1.2), min_size=1, max_size=24), st.floats(-1e3, 1e3))
def test_every_law_meets_the_pulses_and_runs_forward(name, intervals, start):
    pulses = start + np.concatenate(([0.0], np.cumsum(intervals)))
    for cycle in range(len(intervals)):
        times = cycle_times(angle_law(name), pulses, cycle, U)
        np.testing.assert_allclose(times[[0, -1]], pulses[cycle:cycle + 2], atol=1e-9)
        assert np.all(np.diff(times) > 0.0)


@pytest.mark.parametrize('name', ANGLE_LAWS)
def test_constant_speed_is_followed_by_all(name):
    pulses = 5.0 + 0.04 * np.arange(12)
    for cycle in range(11):
        np.testing.assert_allclose(cycle_times(angle_law(name), pulses, cycle, U),
                                   pulses[cycle] + 0.04 * U, atol=1e-13)


@pytest.mark.parametrize('acceleration', [-6.0, -1.0, 1.0, 30.0])
def test_quadratic_law_is_exact_for_constant_acceleration(acceleration):
    theta = np.arange(0.0, 12.0)
    pulses = (np.sqrt(400.0 + 2.0 * acceleration * theta) - 20.0) / acceleration
    for cycle in range(11):  # the first one from the cycle after
        times = cycle_times(angle_law('quadratic'), pulses, cycle, U)
        angle = 20.0 * times + 0.5 * acceleration * times**2
        np.testing.assert_allclose(angle, cycle + U, atol=1e-10)


def test_linear_law_errs_by_half_the_acceleration_between_pulses():
    # Camerini et al. 2019, Eq. 5; the error is -(1/2) alpha T^2 u (1 - u) trigger cycles
    alpha, theta = 2.0, np.arange(0.0, 12.0)
    pulses = (np.sqrt(400.0 + 2.0 * alpha * theta) - 20.0) / alpha
    times = cycle_times(angle_law('linear'), pulses, 5, U)
    period = pulses[6] - pulses[5]
    error = 20.0 * times + 0.5 * alpha * times**2 - (5.0 + U)
    np.testing.assert_allclose(error, -0.5 * alpha * period**2 * U * (1.0 - U), atol=1e-9)


def test_spline_follows_a_smooth_speed_better_than_the_others():
    angle = np.arange(40.0)
    exact = angle / 20.0 + 0.002 * np.sin(2.0 * np.pi * angle / 9.0)
    between = 20.0 + U
    truth = between / 20.0 + 0.002 * np.sin(2.0 * np.pi * between / 9.0)
    errors = [np.abs(cycle_times(angle_law(name), exact, 20, U) - truth).max()
              for name in ('spline', 'quadratic', 'linear')]
    assert errors[0] < 2e-6
    assert errors[0] < 0.3 * errors[1] < 0.3 * errors[2]


@pytest.mark.parametrize('name', ANGLE_LAWS)
def test_a_law_reads_no_more_pulses_than_it_says(name, rng):
    law = angle_law(name)
    pulses = np.cumsum(rng.uniform(0.9, 1.1, 40))
    full = cycle_times(law, pulses, 20, U)
    first, last = 20 - law.before, 22 + law.after
    np.testing.assert_allclose(
        cycle_times(law, pulses[first:last], law.before, U), full, atol=1e-12)
    np.testing.assert_allclose(
        cycle_times(law, pulses[:2 + law.after_first], 0, U), cycle_times(law, pulses, 0, U),
        atol=1e-12)


def test_where_pulses_are_few_a_simpler_law_takes_over():
    pulses = np.array([1.0, 2.1, 3.0])
    for name in ('quadratic', 'spline'):
        np.testing.assert_array_equal(
            cycle_times(angle_law(name), pulses[:2], 0, U),
            cycle_times(angle_law('linear'), pulses[:2], 0, U))
    np.testing.assert_array_equal(cycle_times(angle_law('spline'), pulses, 1, U),
                                  cycle_times(angle_law('quadratic'), pulses, 1, U))


def test_a_parabola_that_turns_round_is_replaced_by_a_line():
    pulses = np.array([0.0, 0.1, 5.0])
    times = cycle_times(angle_law('quadratic'), pulses, 1, U)
    assert np.all(np.diff(times) > 0.0)


@pytest.mark.parametrize('name', ANGLE_LAWS)
@pytest.mark.parametrize('pulses', [[0.0, 0.0], [1.0, 0.5], [0.0, np.nan]])
def test_pulses_out_of_order_are_refused(name, pulses):
    with pytest.raises(SignalError, match='do not increase: remove repeated'):
        cycle_times(angle_law(name), np.array(pulses), 0, U)


def test_error_names_the_pulses_that_do_not_increase():
    pulses = np.concatenate((np.arange(500.0), np.arange(498.5, 600.0)))
    with pytest.raises(SignalError, match=r'pulse times \[499\.0, 498\.5\] s'):
        run_lines(pulses, 0, np.zeros(550))


def test_unknown_law_is_refused():
    with pytest.raises(ParameterError, match="'cubic': give one of linear, quadratic, spline"):
        angle_law('cubic')
