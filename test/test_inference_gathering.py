# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""What is known of the errors of pulses on the grid of a clock."""

from types import SimpleNamespace

import numpy as np
import pytest
from sa_jitter_ros.effects.lattice import Clock, smooth_on_grid
from sa_jitter_ros.inference.gathering import (
    _Grid, _of_centred, _runs, _slope, _uncertainty, _unskewed, dithered, of_acquisitions)
from sa_jitter_ros.inference.observation import _in_parts

PULSES, PERIOD, TICK, SKEW = 24, 0.025, 1e-4, 1e-3


@pytest.mark.parametrize(('jitter', 'uneven', 'expected'), [
    (0.0, 0.0, False), (0.05, 0.0, False), (0.5, 0.0, True), (1.0, 0.0, True), (0.0, 2.0, False)])
def test_jitter_of_half_a_tick_makes_ticks_independent_errors(rng, jitter, uneven, expected):
    """Uneven marks, which no motion of the shaft makes, are no such jitter."""
    count, marks = 25 * PULSES, 4
    true = PERIOD * np.cumsum(1.0 + 1e-5 * np.cumsum(rng.standard_normal(count)))
    true += uneven * TICK * np.array([0.0, 1.0, -0.4, 0.3])[np.arange(count) % marks]
    times = TICK * np.ceil(true / TICK + jitter * rng.standard_normal(count))
    errors = times - true + uneven * TICK * np.array([0.0, 1.0, -0.4, 0.3])[
        np.arange(count) % marks] + 0.02 * TICK * rng.standard_normal(count)
    items = [SimpleNamespace(first=first, times=times[first:first + PULSES],
                             errors=errors[first:first + PULSES], missing=np.zeros(PULSES - 1))
             for first in range(0, count - PULSES + 1, PULSES)]
    observation = SimpleNamespace(
        model=SimpleNamespace(pulses_per_revolution=marks, pulses_per_trigger=1),
        shown=items, pulses=SimpleNamespace(number=np.arange(count)),
        recoveries=[SimpleNamespace(roughness=0.05 * TICK)])
    assert dithered(observation, Clock(1.0 / TICK, 0.0), smooth_on_grid(times, 1.0 / TICK)
                    ) is expected


@pytest.mark.parametrize('skew', [0.0, SKEW])
def test_recovered_errors_are_as_sure_as_the_reference_shows_with_a_skew_too(rng, skew):
    """The skew moves the pulses of an acquisition by 17 times what the errors are wrong by."""
    smooth = rng.uniform(-0.5, 0.5, 12 * PULSES) * TICK
    wrong = 0.1 * TICK
    items = [SimpleNamespace(first=first, times=(first + np.arange(PULSES)) * PERIOD,
                             standard_errors=np.full(PULSES, wrong))
             for first in range(0, smooth.size, PULSES)]
    on_grid = np.array([smooth[item.first:item.first + PULSES] for item in items])
    slope = skew * np.array([item.times - item.times.mean() for item in items])
    reference = on_grid + slope + 0.01 * TICK * rng.standard_normal(slope.shape)
    grid = _Grid(1.0 / TICK, smooth)
    motion = _unskewed(items, reference + wrong * rng.standard_normal(reference.shape), grid)
    observation = SimpleNamespace(against_reference=True, acquisitions=items,
                                  stacked=lambda _: reference)
    # of 12 variances with 23 degrees of freedom
    assert _uncertainty(observation, motion, [motion], grid) == pytest.approx(
        wrong, rel=4.0 / np.sqrt(2.0 * 12 * 23))


def test_skew_of_neighbours_is_that_of_their_whole_run(rng):
    count = 40 * (PULSES - 1) + 1
    times = PERIOD * np.arange(count)
    errors = SKEW * times + TICK * rng.uniform(-0.5, 0.5, count)
    items = [SimpleNamespace(first=first, times=times[first:first + PULSES])
             for first in range(0, count - 1, PULSES - 1) if first != 10 * (PULSES - 1)]
    rows = np.array([errors[item.first:item.first + PULSES] for item in items])
    rows -= rows.mean(axis=1, keepdims=True)
    rows[20, 3] = np.nan
    error = TICK / np.ptp(times) / np.sqrt(count)  # of the whole, without the gap
    assert _slope(_runs(items, rows)) == pytest.approx(SKEW, abs=4.0 * 2.0 * error)


@pytest.mark.parametrize('correlation', [0.0, 0.5, 0.95])
def test_size_of_errors_counts_what_their_means_took(rng, correlation):
    runs, count, size = 4000, 30, 2.0
    errors = size * rng.standard_normal((runs, count))
    for k in range(1, count):
        errors[:, k] *= np.sqrt(1.0 - correlation**2)
        errors[:, k] += correlation * errors[:, k - 1]
    errors -= errors.mean(axis=1, keepdims=True)
    variance = np.mean(errors**2)
    together = np.mean(errors[:, 1:] * errors[:, :-1]) / variance
    assert _of_centred(variance, together, count) == pytest.approx(
        (size, correlation), rel=0.03, abs=0.01)


def test_skew_is_taken_out_though_the_smoothest_motion_drifts(rng):
    """Its drift of a third of a tick over the recording is no skew: the ticks leave no room."""
    count = 12 * (PULSES - 1) + 1
    times = PERIOD * np.arange(count)
    true = rng.uniform(-0.5, 0.5, count) * TICK
    drift = TICK / 3.0 * times / times[-1]
    items = [SimpleNamespace(first=first, times=times[first:first + PULSES],
                             standard_errors=np.full(PULSES, 1e-3 * TICK))
             for first in range(0, count - 1, PULSES - 1)]
    motion = of_acquisitions(true + SKEW * times, items)
    motion -= motion.mean(axis=1, keepdims=True)
    left = _unskewed(items, motion, _Grid(1.0 / TICK, true - drift)) - of_acquisitions(
        true, items)
    slope = _slope(_runs(items, left))
    assert abs(slope) * np.ptp(times) < 0.05 * TICK


@pytest.mark.parametrize('points', [400, 61, 9])
def test_amplitudes_in_parts_of_cycles_are_of_one_order_each(points):
    """A gain that is faster than the cycles shows, and no other declared order, of any length."""
    turns, count = np.array([0.8, 2.3]) if points < 20 else np.array([3.6, 11.3]), 60
    angle = np.arange(count * points) / points
    gain = 1.0 + 0.1 * np.cos(2.0 * np.pi * 0.37 * angle)
    waves = np.exp(2j * np.pi * angle[:, None] * turns) * np.exp([0.3j, 1.1j]) * (1.0, 0.5)
    waves[:, 0] *= gain
    of_cycles = np.stack([gain.reshape(count, points).mean(axis=1) * np.exp(0.3j),
                          np.full(count, 0.5 * np.exp(1.1j))], axis=1)
    found = _in_parts(waves.real.sum(axis=1).reshape(count, points, 1), of_cycles[:, None], turns)
    parts = min(points, 16)
    middles = (np.arange(count * parts) + 0.5) / parts
    assert found.shape == (count * parts, 1, 2)
    if points > 20:
        expected = 1.0 + 0.1 * np.cos(2.0 * np.pi * 0.37 * middles)
        slow = np.convolve(found[:, 0, 0], np.ones(parts) / parts, 'valid')
        np.testing.assert_allclose(
            slow, np.convolve(expected, np.ones(parts) / parts, 'valid'), atol=0.02)
    assert np.std(found[:, 0, 1]) < 0.06
