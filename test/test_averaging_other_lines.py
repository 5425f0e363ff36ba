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
from sa_jitter_ros.averaging.cycle import CycleProjection
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


@pytest.mark.machines
@pytest.mark.parametrize(('cycles', 'ratio'), [(12, 0.3137), (40, 2.40789)])
def test_amplitudes_beside_another_shaft_are_as_good_as_alone(cycles, ratio):
    """Intervals hold 68 and 95 %; amplitudes are as near as noise lets them be."""
    rng, off, z = np.random.default_rng(cycles), [], []
    for _ in range(26):
        while True:
            others = rng.uniform(4.0, 15.0) * np.arange(1.0, 4.0)
            if np.abs(others[:, None] - ORDERS).min() * cycles * ratio >= 4.0:
                break
        correction = scene(rng, cycles=cycles, ratio=ratio, others=others)
        if correction.accepted:
            off.append(np.abs(correction.amplitudes[0]) - SIZE)
            z.append(off[-1] / correction.amplitude_errors.amplitude[0])
    z = np.abs(np.array(z))
    assert len(z) >= 25
    noise = 0.05 * np.sqrt(2.0 / (cycles * POINTS * max(ratio, 1.0)))
    assert np.median(np.abs(off)) < 1.4 * 0.6745 * noise
    for width, share in ((1.0, 0.683), (1.96, 0.95)):
        assert abs(np.mean(z < width) - share) < 3.0 * np.sqrt(share * (1.0 - share) / z.size)


def z_scores(rng, width, beside, size, *, noise, missing):
    """
    Return the recovered errors of 40 cycles less the true ones, in standard errors.

    These are uniform on `width` cycles of order 19; the line at order `beside` is of another
    shaft.
    """
    points, period = 512, 0.05
    time = np.arange(54 * points) * period / points
    true = period * (2.0 + np.arange(50.0))
    late = true + width / 19.0 * period * rng.uniform(-0.5, 0.5, true.size)
    phase = rng.uniform(0.0, 2.0 * np.pi, 3)
    samples = np.cos(2.0 * np.pi * np.outer(time / period, [19.0, 38.0, beside]) + phase
                     ) @ [1.0, 0.5, size] + noise * rng.standard_normal(time.size)
    kept = np.setdiff1d(np.arange(true.size), missing)
    average, *_ = sa.average(
        samples, points / period, late[kept], orders=[19.0, 38.0], trigger_cycles=40,
        correct_jitter=True, maximum_discarded=0.2, keyphasor_rate=19.0 / (width * period))
    assert average.correction.accepted
    assert (average.discarded_cycles > 0) == bool(missing)
    errors = (late - true)[np.searchsorted(late, average.pulses)]
    return (average.correction.pulse_errors - errors + errors.mean()
            ) / average.correction.standard_errors


@pytest.mark.filterwarnings('ignore::sa_jitter_ros.errors.DataWarning')
@pytest.mark.parametrize('missing', [(), (20, 33)])
@pytest.mark.parametrize('seed', range(12))
def test_a_line_beside_an_order_does_not_pass_for_errors(seed, missing):
    rng = np.random.default_rng([seed, 5])
    beside = 38.0 + rng.choice([-1.0, 1.0]) * rng.uniform(3.0, 19.0) / 40.0
    size = 10.0 ** (rng.uniform(-6.0, 6.0) / 20.0)  # half to twice the strongest order
    found = z_scores(rng, rng.uniform(0.05, 0.2), beside, size, noise=0.3, missing=missing)
    # a mean square of 41 normal variables
    assert np.mean(found**2) < 1.0 + 4.0 * np.sqrt(2.0 / found.size)


@pytest.mark.parametrize('share', [0.007, 0.07])
def test_a_weak_line_beside_an_order_does_not_disturb(rng, share):
    found = z_scores(rng, 0.1, 38.3, 0.5 * share, noise=0.01, missing=())
    assert np.mean(found**2) < 1.0 + 4.0 * np.sqrt(2.0 / found.size)


def lines_of(samples, cycles, ratio=1.0, *, orders=ORDERS, errors=None):
    """Return the lines of cycles at even angles, or between pulses with errors (pulse,)."""
    grid = GridCycles(samples[:-1].reshape(cycles, -1, 1))
    return other_lines(grid, np.zeros(cycles + 1) if errors is None else errors, orders, ratio)


@pytest.mark.parametrize('ratio', [1.0, 0.3137, 2.40789])
def test_lines_are_found_at_their_orders(ratio, rng):
    cycles, others = 40, np.array([6.52, 13.04, 19.56])
    theta = ratio * np.linspace(0.0, cycles, cycles * POINTS * 3 + 1)
    samples = wave(theta, np.append(ORDERS, others), np.append(SIZE, [0.3, 0.4, 0.5]), rng)
    found = lines_of(samples, cycles, ratio)
    near = found[np.argmin(np.abs(found[:, None] - others), axis=0)]
    assert np.abs(near - others).max() < 0.1 / (cycles * ratio)
    rough = others + 0.3 / (cycles * ratio)
    projection = CycleProjection(samples.size // cycles, ratio, tuple(rough))
    projection.add(0, samples[:-1].reshape(cycles, -1, 1))
    amplitudes = projection.amplitudes(samples[-1:])
    exact = coherent(rough, amplitudes, np.arange(cycles), ratio)
    assert np.abs(exact - others).max() < 0.03 / (cycles * ratio)


def test_what_pulse_errors_make_is_no_line(rng):
    """They hide weak lines, which stand out without the errors."""
    errors = rng.normal(0.0, 0.003, 41)
    theta = np.linspace(0.0, 40.0, 40 * POINTS * 3 + 1)
    late = theta + np.interp(theta, np.arange(41.0), errors)
    assert not lines_of(wave(late, ORDERS, SIZE, rng), 40, errors=errors).size
    beside = wave(late, np.append(ORDERS, 16.6), np.append(SIZE, 0.02), rng)
    assert not lines_of(beside, 40).size
    assert lines_of(beside, 40, errors=errors) == pytest.approx([16.6], abs=0.01)


def test_a_line_keeps_its_amplitude_over_a_gap(rng):
    numbers = np.delete(np.arange(40), [7, 22, 23])
    steady = np.exp(2j * np.pi * (0.004 * numbers[:, None, None] + rng.uniform(size=(1, 2, 1))))
    noise = 0.3 * rng.standard_normal((37, 2, 1))
    assert coherent(np.array([6.5]), steady + noise, numbers, 1.0) == pytest.approx(
        [6.504], abs=2e-3)
    turned = steady * np.exp(2j * np.pi * rng.uniform(size=(37, 1, 1)))
    assert not coherent(np.array([6.5]), turned + noise, numbers, 1.0).size


def test_few_cycles_and_slow_changes_show_no_lines(rng):
    theta = np.linspace(0.0, 40.0, 40 * POINTS + 1)
    slow = wave(theta, ORDERS, SIZE, rng) * (1.0 + 0.2 * np.cos(np.pi * theta / 40.0))
    assert not lines_of(slow, 40).size
    beside = wave(theta, np.append(ORDERS, 6.5), np.append(SIZE, 0.5), rng)
    assert lines_of(beside, 40).size
    few = beside[:7 * POINTS + 1]
    assert not lines_of(few, 7).size
    assert not lines_of(beside, 40, orders=np.empty(0)).size
