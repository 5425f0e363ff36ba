# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.


"""Lines of other shafts: which are found, and amplitudes beside them."""

import numpy as np
import pytest
import sa_jitter_ros as sa
from sa_jitter_ros.averaging.cycle import project
from sa_jitter_ros.averaging.grid_cycles import GridCycles
from sa_jitter_ros.averaging.other_lines import coherent, other_lines

ORDERS, SIZE, POINTS, PERIOD = np.array([8.0, 16.0, 32.0]), np.array([0.5, 1.0, 0.3]), 160, 0.04


def wave(theta, orders, size, rng):
    """Return the sum of cosines of random phase at angles `theta`, with noise."""
    phase = rng.uniform(0.0, 2.0 * np.pi, len(orders))
    return np.cos(2.0 * np.pi * np.multiply.outer(theta, orders) + phase
                  ) @ size + 0.05 * rng.standard_normal(np.shape(theta))


def scene(rng, *, cycles, ratio, others, jitter=0.3):
    """Return the corrected average of a machine with lines at `others`."""
    points = round(POINTS * max(ratio, 1.0))
    time = np.arange((cycles + 7) * points) * PERIOD / points
    pulses = PERIOD * (2.0 + rng.uniform() / points + np.arange(cycles + 4.0))
    samples = wave(ratio * (time - pulses[0]) / PERIOD, np.append(ORDERS, others),
                   np.append(SIZE, rng.uniform(0.3, 0.5, len(others))), rng)
    std = jitter * PERIOD / (2.0 * np.pi * 16.0 * ratio)
    average, *_ = sa.average(
        samples, points / PERIOD, pulses + np.sqrt(3.0) * std * rng.uniform(
            -1.0, 1.0, pulses.size),
        orders=ORDERS, ratio=ratio, trigger_cycles=cycles, correct_jitter=True,
        interval_tolerance=0.45, keyphasor_rate=1.0 / (np.sqrt(12.0) * std))
    return average.correction


@pytest.mark.parametrize(('cycles', 'ratio'), [(12, 1.0), (12, 0.3137), (40, 2.40789)])
def test_amplitudes_beside_another_shaft_are_as_good_as_alone(cycles, ratio):
    """Intervals hold 68 and 95 %; amplitudes are as near as noise lets them be."""
    rng, off, z = np.random.default_rng(cycles), [], []
    for _ in range(40):
        while True:
            others = rng.uniform(4.0, 15.0) * np.arange(1.0, 4.0)
            if np.abs(others[:, None] - ORDERS).min() * cycles * ratio >= 4.0:
                break
        correction = scene(rng, cycles=cycles, ratio=ratio, others=others)
        if correction.accepted:
            off.append(np.abs(correction.amplitudes[0]) - SIZE)
            z.append(off[-1] / correction.amplitude_errors.amplitude[0])
    z = np.abs(np.array(z))
    assert len(z) >= 38
    noise = 0.05 * np.sqrt(2.0 / (cycles * POINTS * max(ratio, 1.0)))
    assert np.median(np.abs(off)) < 1.4 * 0.6745 * noise
    for width, share in ((1.0, 0.683), (1.96, 0.95)):
        assert abs(np.mean(z < width) - share) < 3.0 * np.sqrt(share * (1.0 - share) / z.size)


def grid_of(samples, cycles):
    return GridCycles(samples[:-1].reshape(cycles, -1, 1))


@pytest.mark.parametrize('ratio', [1.0, 0.3137, 2.40789])
def test_lines_are_found_at_their_orders(ratio, rng):
    cycles, others = 40, np.array([6.52, 13.04, 19.56])
    theta = ratio * np.linspace(0.0, cycles, cycles * POINTS * 3 + 1)
    samples = wave(theta, np.append(ORDERS, others), np.append(SIZE, [0.3, 0.4, 0.5]), rng)
    found = other_lines(grid_of(samples, cycles), ORDERS, ratio)
    near = found[np.argmin(np.abs(found[:, None] - others), axis=0)]
    assert np.abs(near - others).max() < 0.1 / (cycles * ratio)
    rough = others + 0.3 / (cycles * ratio)
    amplitudes = project(samples[:, None], ratio, tuple(rough), count=cycles)
    exact = coherent(rough, amplitudes, ratio)
    assert np.abs(exact - others).max() < 0.03 / (cycles * ratio)


def test_what_pulse_errors_make_is_no_line():
    """They make lines on both sides of an order, which are gone without the errors."""
    cycles, found, left = 40, 0, 0
    theta = np.linspace(0.0, cycles, cycles * POINTS * 3 + 1)
    for seed in range(10):
        rng = np.random.default_rng(seed)
        late = np.interp(theta, np.arange(cycles + 1.0), rng.normal(0.0, 0.003, cycles + 1))
        grid = grid_of(wave(theta + late, ORDERS, SIZE, rng), cycles)
        candidates = other_lines(grid, ORDERS, 1.0)
        clean = project(wave(theta, ORDERS, SIZE, rng)[:, None], 1.0, tuple(candidates),
                        count=cycles)
        found += candidates.size
        left += coherent(candidates, clean, 1.0).size if candidates.size else 0
    assert found < 60  # of 160: the others have an image as strong
    assert not left


def test_few_cycles_and_slow_changes_show_no_lines(rng):
    theta = np.linspace(0.0, 40.0, 40 * POINTS + 1)
    slow = wave(theta, ORDERS, SIZE, rng) * (1.0 + 0.2 * np.cos(np.pi * theta / 40.0))
    assert not other_lines(grid_of(slow, 40), ORDERS, 1.0).size
    beside = wave(theta, np.append(ORDERS, 6.5), np.append(SIZE, 0.5), rng)
    assert other_lines(grid_of(beside, 40), ORDERS, 1.0).size
    few = beside[:7 * POINTS + 1]
    assert not other_lines(grid_of(few, 7), ORDERS, 1.0).size
    assert not other_lines(grid_of(beside, 40), np.empty(0), 1.0).size
