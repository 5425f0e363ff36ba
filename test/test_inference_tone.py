# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""A tone is found at its frequency while the speed drifts; what a shaft makes is none."""

from types import SimpleNamespace

import numpy as np
import pytest
from sa_jitter_ros.inference.tone import _spectrum, find_tone

ORDERS = np.array([12.0, 24.0])
SPEED, ACQUISITIONS, CYCLES, NOISE = 25.0, 20, 25, 0.02


@pytest.fixture
def shaft():
    """Middles of cycles, and many points in each, as times in s and as angles."""
    edges = np.arange(ACQUISITIONS * CYCLES + 1.0)
    # angle as a function of time: 0.5 % of drift
    grid = np.linspace(0.0, 1.02 * edges[-1] / SPEED, 400_001)
    angle = SPEED * (grid + 5e-3 * 1.5 * (1.0 - np.cos(grid / 1.5)))
    inside = edges[:-1, None] + (np.arange(64) + 0.5) / 64
    shape = ACQUISITIONS, CYCLES
    return SimpleNamespace(
        time=np.interp(edges[:-1] + 0.5, angle, grid).reshape(shape),
        angle=(edges[:-1] + 0.5).reshape(shape), inside=np.interp(inside, angle, grid),
        turns=inside)


def amplitudes(shaft, rng, extra):
    """Return what is complex (acquisition, cycle, line) of two orders and `extra`."""
    clean = [np.mean((np.cos(2.0 * np.pi * order * shaft.turns) + extra)
                     * 2.0 * np.exp(-2j * np.pi * order * shaft.turns), axis=1)
             for order in ORDERS]
    values = np.array(clean).T
    values = values + NOISE * (rng.normal(size=values.shape) + 1j * rng.normal(size=values.shape))
    return values.reshape(ACQUISITIONS, CYCLES, ORDERS.size)


@pytest.mark.parametrize('frequency', [303.7, 595.2])
def test_tone_is_found_with_its_errors_while_the_speed_drifts(shaft, rng, frequency):
    z = []
    for phase in np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False):
        extra = 0.06 * np.cos(2.0 * np.pi * frequency * shaft.inside + phase)
        tone = find_tone(amplitudes(shaft, rng, extra), shaft.time, shaft.angle, ORDERS)
        assert tone.p_value < 1e-10
        z.append(((tone.frequency - frequency) / tone.frequency_error,
                  (tone.amplitude - 0.06) / tone.standard_error))
    assert np.all(np.abs(np.mean(z, axis=0)) < 3.5 / np.sqrt(12))
    assert np.all(np.sqrt(np.mean(np.square(z), axis=0)) < 1.0 + 3.5 / np.sqrt(24))


def test_order_of_another_shaft_is_no_tone(shaft, rng):
    extra = 0.06 * np.cos(2.0 * np.pi * 12.147 * shaft.turns)
    tone = find_tone(amplitudes(shaft, rng, extra), shaft.time, shaft.angle, ORDERS)
    assert tone.p_value > 1e-3


def test_modulation_is_no_tone(shaft, rng):
    extra = 0.06 * np.cos(2.0 * np.pi * 3.7 * shaft.inside) * np.cos(
        2.0 * np.pi * 12.0 * shaft.turns)
    tone = find_tone(amplitudes(shaft, rng, extra), shaft.time, shaft.angle, ORDERS)
    assert tone.p_value > 1e-3


def test_noise_is_no_tone(shaft, rng):
    p_values = [find_tone(amplitudes(shaft, rng, 0.0), shaft.time, shaft.angle, ORDERS).p_value
                for _ in range(60)]
    assert np.mean(np.array(p_values) < 0.05) < 0.05 + 3.0 * np.sqrt(0.05 * 0.95 / 60)


def test_spectrum_of_uneven_places_is_the_sum(rng):
    places = np.sort(rng.uniform(0.0, 60.0, 50))
    values = rng.normal(size=50) + 1j * rng.normal(size=50)
    found = _spectrum(values, places, 256)
    frequency = np.fft.fftfreq(256)
    expected = np.exp(-2j * np.pi * np.outer(frequency, places - places[0])) @ values
    assert np.abs(found - expected).max() < 2e-3 * np.abs(values).sum()
