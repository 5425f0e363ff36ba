# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Interpolators: their gain, their anti-alias filter, and what they refuse."""

from hypothesis import given, strategies as st
import numpy as np
import pytest
from sa_jitter_ros.errors import ParameterError, SignalError
from sa_jitter_ros.pulses.resampling import (
    interpolate, interpolator_gain, margin, METHODS, periodic)
from scipy import signal


def tone(frequency, count=400):
    """Return samples (count, 2) of a cosine and a sine at a frequency in sampling rates."""
    angle = 2.0 * np.pi * frequency * np.arange(count)
    return np.stack((np.cos(angle), np.sin(angle)), axis=1)


def measured_gain(method, frequency, cutoff=1.0):
    """Return the complex gain at positions that fall everywhere between samples."""
    positions = np.linspace(100.0, 300.0, 3001)[:-1]
    values = interpolate(tone(frequency), positions, method=method, cutoff=cutoff)
    return np.mean((values[:, 0] + 1j * values[:, 1])
                   * np.exp(-2j * np.pi * frequency * positions))


@pytest.mark.parametrize('method', METHODS)
@pytest.mark.parametrize('frequency', [0.013, 0.0903, 0.1703, 0.3001, 0.4203])
def test_gain_is_the_transform_of_the_kernel(method, frequency):
    expected = interpolator_gain(method, np.array(frequency))
    assert measured_gain(method, frequency) == pytest.approx(complex(expected), abs=2e-3)


def test_gains_are_those_of_the_literature():
    f = np.array([0.05, 0.09, 0.17, 0.3])
    np.testing.assert_allclose(interpolator_gain('linear', f), np.sinc(f) ** 2, rtol=1e-5)
    np.testing.assert_allclose(
        interpolator_gain('spline', f),
        3.0 * np.sinc(f) ** 4 / (2.0 + np.cos(2.0 * np.pi * f)), rtol=1e-5)
    # Keys 1981: cubic convolution with a = -1/2
    s, c = np.sinc(f), np.sinc(2.0 * f)
    np.testing.assert_allclose(
        interpolator_gain('cubic', f),
        3.0 / (np.pi * f) ** 2 * (s**2 - c) - 4.0 / (2.0 * np.pi * f) ** 2 * (
            3.0 * c**2 - 2.0 * c - np.sinc(4.0 * f)), rtol=1e-5)
    decibels = 20.0 * np.log10(interpolator_gain('linear', np.array([0.09, 0.17, 0.3])))
    np.testing.assert_allclose(decibels, [-0.233, -0.847, -2.636], atol=0.02)


def test_default_loses_nothing_that_matters():
    f = np.linspace(0.0, 0.3, 61)
    loss = np.abs(20.0 * np.log10(interpolator_gain('band_limited', f)))
    assert loss.max() < 0.01
    assert loss[f <= 0.17].max() < 0.001
    for frequency in (0.05, 0.17, 0.3):
        limit = 0.001 if frequency <= 0.17 else 0.01
        assert abs(20.0 * np.log10(abs(measured_gain('band_limited', frequency)))) < limit


@pytest.mark.parametrize('method', METHODS)
def test_samples_and_constants_stay_what_they_are(method, rng):
    samples = rng.standard_normal((60, 2))
    np.testing.assert_allclose(
        interpolate(samples, np.arange(60.0), method=method), samples, atol=2e-6)
    constant = interpolate(np.full((60, 1), 3.0), np.linspace(0.0, 59.0, 100), method=method)
    np.testing.assert_allclose(constant, 3.0, rtol=1e-12)


@pytest.mark.parametrize('cutoff', [0.9, 0.5, 0.1, 0.02])
def test_cutoff_keeps_below_and_stops_above(cutoff):
    count = max(400, int(200 / cutoff))
    width = margin('band_limited', cutoff=cutoff)
    positions = np.linspace(width, count + width, 997)
    for share in (0.1, 0.5, 0.78, 1.01, 1.2, 1.6):
        frequency = 0.5 * cutoff * share
        if frequency >= 0.5:
            continue
        values = interpolate(tone(frequency, count + 2 * width + 1), positions, cutoff=cutoff)
        size = np.hypot(*values.T)
        if share < 1.0:
            np.testing.assert_allclose(size, 1.0, atol=2e-3)
        else:
            assert size.max() < 2e-3


@given(st.integers(40, 90), st.lists(st.floats(0.0, 38.0), min_size=1, max_size=30),
       st.sampled_from(METHODS), st.sampled_from([1.0, 0.4]))
def test_a_value_depends_on_its_neighbourhood_alone(count, positions, method, cutoff):
    samples = np.random.default_rng(3).standard_normal((count, 2))
    together = interpolate(samples, np.array(positions), method=method, cutoff=cutoff)
    alone = [interpolate(samples, np.array([each]), method=method, cutoff=cutoff)[0]
             for each in positions]
    np.testing.assert_allclose(together, alone, atol=1e-12)
    width = margin(method, cutoff=cutoff)
    if min(positions) >= width:
        first = int(min(positions)) - width
        moved = interpolate(samples[first:], np.array(positions) - first, method=method,
                            cutoff=cutoff)
        np.testing.assert_allclose(together, moved, atol=1e-11)


def test_ends_are_continued_by_point_reflection():
    ramp = np.arange(30.0)[:, None]
    positions = np.array([0.0, 0.3, 1.5, 28.6, 29.0])
    np.testing.assert_allclose(interpolate(ramp, positions)[:, 0], positions, atol=1e-3)
    assert interpolate(ramp, np.empty(0)).shape == (0, 1)


@pytest.mark.parametrize('positions', [[-0.1], [29.01], [np.nan], [3.0, np.inf]])
def test_positions_outside_are_refused(positions):
    with pytest.raises(SignalError, match='give positions within the samples'):
        interpolate(np.zeros((30, 1)), np.array(positions))


def test_wrong_arguments_are_refused():
    with pytest.raises(ParameterError, match="interpolation is 'sinc': give one of band_limited"):
        interpolate(np.zeros((30, 1)), np.zeros(1), method='sinc')
    for cutoff in (0.0, -1.0, 1.1, np.nan):
        with pytest.raises(ParameterError, match='cutoff'):
            interpolate(np.zeros((30, 1)), np.zeros(1), cutoff=cutoff)
    with pytest.raises(SignalError, match='samples have 3 dimensions, positions 1'):
        interpolate(np.zeros((30, 1, 1)), np.zeros(1))


@pytest.mark.parametrize('points', [5, 6, 7, 8, 12, 15, 63])
@pytest.mark.parametrize('count', [7, 8, 12])
def test_a_period_keeps_its_lines_at_any_number_of_points(count, points):
    values = np.random.default_rng(1).standard_normal((2, count))
    np.testing.assert_allclose(periodic(values, points), signal.resample(values, points, axis=1),
                               atol=1e-12)
