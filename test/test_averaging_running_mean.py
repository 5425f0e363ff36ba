# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Running means against numpy, merging, and what noise they leave."""

from hypothesis import given, strategies as st
import numpy as np
import pytest
from sa_jitter_ros.averaging.noise import noise_floor, radial_noise, without_leakage
from sa_jitter_ros.averaging.running_mean import BlockMean, ExponentialMean, SlidingMean
from scipy import signal

NUMBERS = st.floats(-1e6, 1e6)
VALUES = st.lists(NUMBERS, min_size=1, max_size=40)


def filled(mean, values):
    """Return the mean after it took these values, each in an array, one or some at a time."""
    size = len(values) % 4 + 1
    for first in range(0, len(values), size):
        mean.update(np.array(values[first:first + size])[:, None])
    return mean


@given(VALUES)
def test_block_mean_is_the_mean(values):
    mean, array = filled(BlockMean(), values), np.array(values)
    scale = np.abs(array).max() + 1e-300
    assert mean.count == len(values)
    np.testing.assert_allclose(mean.mean[0], array.mean(), atol=1e-13 * scale)
    if len(values) == 1:
        assert np.isnan(mean.standard_error).all()
    else:
        expected = np.sqrt(array.var(ddof=1) / len(values))
        np.testing.assert_allclose(mean.standard_error[0], expected, atol=1e-12 * scale)


@given(VALUES, VALUES)
def test_merged_means_are_the_mean_of_all(first, second):
    merged, whole = filled(BlockMean(), first), filled(BlockMean(), first + second)
    merged.merge(filled(BlockMean(), second))
    scale = np.abs(first + second).max() + 1e-300
    assert merged.count == whole.count
    np.testing.assert_allclose(merged.mean, whole.mean, atol=1e-12 * scale)
    np.testing.assert_allclose(merged.standard_error, whole.standard_error, atol=1e-11 * scale)


def test_arrays_may_lie_in_any_order_in_memory(rng):
    values = rng.standard_normal((5, 4, 3))
    plain, turned = BlockMean(), BlockMean()
    plain.update(values)
    turned.update(np.asfortranarray(values))
    np.testing.assert_array_equal(turned.mean, plain.mean)
    np.testing.assert_array_equal(turned.standard_error, plain.standard_error)


def test_merging_with_nothing_changes_nothing():
    mean = filled(BlockMean(), [1.0, 3.0])
    mean.merge(BlockMean())
    empty = BlockMean()
    empty.merge(mean)
    mean.update(np.array([[100.0]]))  # and what was merged is a copy
    assert (empty.count, empty.mean[0]) == (2, 2.0)
    assert np.isnan(BlockMean().mean)


def test_a_mean_is_a_copy_of_what_goes_on():
    for mean in (BlockMean(), ExponentialMean(4.0), SlidingMean()):
        first = filled(mean, [1.0]).mean
        filled(mean, [5.0])
        assert first[0] == 1.0


def test_sliding_mean_forgets_the_oldest():
    mean = filled(SlidingMean(), [100.0, 1.0, 2.0, 6.0])
    mean.forget(1)
    assert (mean.count, mean.mean[0]) == (3, 3.0)
    assert mean.standard_error[0] == pytest.approx(np.std([1.0, 2.0, 6.0], ddof=1) / np.sqrt(3.0))
    mean.forget(10)
    mean.forget(-3)
    assert mean.count == 0
    assert np.isnan(mean.mean)


@given(st.lists(st.one_of(st.integers(1, 5), NUMBERS), max_size=60))
def test_sliding_mean_is_that_of_its_window_whatever_came_and_went(steps):
    mean, window, largest = SlidingMean(), [], 1e-300
    for step in steps:
        if isinstance(step, int):
            mean.forget(step)
            del window[:step]
        else:
            mean.update(np.array([[step]]))
            window.append(step)
            largest = max(largest, abs(step))
        assert mean.count == len(window)
        if window:
            np.testing.assert_allclose(mean.mean[0], np.mean(window), atol=1e-13 * largest)
        if len(window) > 1:
            np.testing.assert_allclose(
                mean.standard_error[0], np.std(window, ddof=1) / np.sqrt(len(window)),
                rtol=1e-6, atol=1e-7 * largest)


def test_sliding_mean_recovers_from_an_undefined_value():
    mean = filled(SlidingMean(), [1.0, np.nan, 2.0, 4.0])
    assert np.isnan(mean.mean[0])
    mean.forget(2)
    assert mean.mean[0] == 3.0


def test_exponential_mean_has_the_noise_of_as_many_equal_weights(rng):
    cycles, mean = 9.0, ExponentialMean(9.0)
    means_, errors = [], []
    for _ in range(60):
        mean.update(rng.standard_normal((1, 2000)))
    for _ in range(40):
        mean.update(rng.standard_normal((1, 2000)))
        means_.append(mean.mean)
        errors.append(mean.standard_error)
    # 2000 independent columns, in time about 40 / 9 independent ones
    assert np.var(means_) * cycles == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / 8000))
    assert np.mean(np.square(errors)) * cycles == pytest.approx(1.0, abs=0.06)


def test_exponential_mean_begins_as_the_ordinary_mean():
    values = [1.0, 2.0, 6.0, -3.0]
    mean = filled(ExponentialMean(20.0), values)
    assert mean.mean[0] == pytest.approx(np.mean(values))
    assert np.isnan(filled(ExponentialMean(20.0), [1.0]).standard_error).all()


def test_exponential_mean_recovers_where_it_was_undefined():
    mean = ExponentialMean(4.0)
    for row in ([1.0, 1.0], [np.nan, 1.0]):
        mean.update(np.array([row]))
    np.testing.assert_array_equal(np.isnan(mean.mean), [True, False])
    mean.update(np.array([[5.0, 1.0]]))
    np.testing.assert_allclose(mean.mean, [5.0, 1.0])
    mean.update(np.array([[7.0, 1.0]]))
    np.testing.assert_allclose(mean.mean, [5.8, 1.0])


@pytest.mark.parametrize('count', [6, 17, 24, 40])
def test_radial_noise_is_that_of_the_mean(count, rng):
    trials = 3000
    noise = rng.standard_normal((count, trials)) + 1j * rng.standard_normal((count, trials))
    cycles = 5.0 * np.exp(0.7j) + noise
    estimate = radial_noise(cycles) ** 2 * count
    lines = (count - 1) // 2
    spread = np.sqrt(2.0 / (count - 1)) if lines < 8 else 1.44 / np.sqrt(lines)
    assert estimate.mean() == pytest.approx(1.0, abs=5.0 * spread / np.sqrt(trials) + 0.015)


def test_radial_noise_leaves_out_turning_and_lines(rng):
    k = np.arange(40)[:, None]
    noise = 0.01 * (rng.standard_normal((40, 500)) + 1j * rng.standard_normal((40, 500)))
    turned = np.exp(1j * 0.05 * rng.standard_normal((40, 500)))
    leaking = 0.5 * np.exp(2j * np.pi * 0.2 * k)  # 8 whole periods
    assert np.mean(radial_noise(turned + noise) ** 2) * 40 < 2.0 * 0.01**2
    assert np.mean(radial_noise(1.0 + noise + leaking) ** 2) * 40 < 1.3 * 0.01**2


@pytest.mark.parametrize('length', [1.0, 2.40789, 0.4137])
def test_leakage_between_orders_is_taken_out(length):
    orders, amplitudes = np.array([2.0, 3.0, 7.5]), np.array([[1.0, 0.5j, -0.3]])
    angles = 5.0 + length * np.arange(1500)
    u = (np.arange(500) + 0.5) / 500
    cycles = []
    for angle in angles:
        theta = angle + length * u
        wave = (amplitudes @ np.exp(2j * np.pi * np.multiply.outer(orders, theta))).real
        cycles.append(2.0 * wave @ np.exp(-2j * np.pi * np.multiply.outer(theta, orders)) / 500)
    cycles = np.array(cycles)
    clean = without_leakage(cycles, tuple(orders), length, angles)
    np.testing.assert_allclose(clean, np.broadcast_to(amplitudes, clean.shape), atol=2e-3)
    cycles[0, 0, 1] = np.nan  # an undefined order leaves the others
    assert np.isfinite(without_leakage(cycles, tuple(orders), length, angles)[1:, 0, ::2]).all()


@pytest.mark.parametrize('count', [5, 10, 40])
def test_noise_that_is_added_to_coloured_noise_and_orders_adds_its_power(rng, count):
    angle = np.arange(count * 512) / 512
    orders = np.geomspace(1.0, 0.02, 200) @ np.cos(
        2.0 * np.pi * np.outer(np.arange(1, 201), angle))
    found = []
    for std in (0.0, 0.3):
        noise = signal.lfilter([0.2], [1.0, -0.5], rng.standard_normal((60, angle.size)))
        added = std * rng.standard_normal(noise.shape)
        grid = (orders + noise + added).T.reshape(count, 512, -1)
        floor = noise_floor(grid, 1.0, np.array([20.0]), 256.0)
        found.append(np.mean(floor**2) * angle.size / 2.0)
    coloured = 0.04 / abs(1.0 - 0.5 * np.exp(-2j * np.pi * 20.0 / 512)) ** 2
    np.testing.assert_allclose(found, [coloured, coloured + 0.09], rtol=0.1)


def test_radial_noise_of_too_little_is_undefined():
    assert np.isnan(radial_noise(np.ones((1, 2, 3), dtype=complex))).all()
    undefined = np.ones((20, 2), dtype=complex)
    undefined[3, 1] = np.nan
    np.testing.assert_array_equal(np.isnan(radial_noise(undefined)), [False, True])
    np.testing.assert_array_equal(radial_noise(np.zeros((20, 1), dtype=complex)), 0.0)
