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
from sa_jitter_ros.inference.gathering import (
    _Grid, _of_acquisitions, _of_centred, _runs, _slope, _uncertainty, _unskewed)

PULSES, PERIOD, TICK, SKEW = 24, 0.025, 1e-4, 1e-3


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
    motion = _of_acquisitions(true + SKEW * times, items)
    motion -= motion.mean(axis=1, keepdims=True)
    left = _unskewed(items, motion, _Grid(1.0 / TICK, true - drift)) - _of_acquisitions(
        true, items)
    slope = _slope(_runs(items, left))
    assert abs(slope) * np.ptp(times) < 0.05 * TICK
