# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Pulse errors recovered from simulated vibration, whose truth is known."""

from itertools import pairwise, product

import numpy as np
import pytest
from sa_jitter_ros.averaging.grid_cycles import GridCycles
from sa_jitter_ros.averaging.neighbour_equations import shortest_path, Tridiagonal
from sa_jitter_ros.averaging.pulse_error_fit import _CHANCES, _SIZES, estimated_size
from sa_jitter_ros.averaging.recovery import recover_pulse_errors
from sa_jitter_ros.errors import ParameterError, SignalError
from scipy.signal import lfilter

RATIO = 2.40789
PERIOD = 0.05
SPEED = RATIO / PERIOD  # Hz, of the shaft of interest


def jitter(rng, width, *, count=100, speed=SPEED):
    """Pulse errors (s), uniform on `width` mesh-19 cycles."""
    return rng.uniform(-0.5, 0.5, count + 1) * width / 19.0 / speed


def simulate(rng, errors, lines, *, samples=512, ratio=RATIO, noise=0.0, angle=0.0):
    """
    Trigger cycles (cycle, sample, channel) between the wrong pulses, and these pulses.

    `lines` maps orders to the amplitudes of the channels; `noise` is per sample.
    """
    count = len(errors) - 1
    periods = PERIOD * (1.0 + 2e-4 * rng.standard_normal(count + 2))
    true = np.cumsum(periods) - periods[0]
    pulses = true[:-1] + errors
    u = np.arange(samples) / samples
    times = pulses[:-1, None] + np.diff(pulses)[:, None] * u
    knots = np.concatenate(([-PERIOD], true))
    turns = angle + ratio * np.interp(times, knots, np.arange(-1.0, count + 2.0))
    cycles = sum(np.real(np.exp(2j * np.pi * order * turns)[:, :, None] * np.asarray(amplitudes))
                 for order, amplitudes in lines.items())
    return cycles + noise * rng.standard_normal(cycles.shape), pulses


def recover(cycles, pulses, *, declared, ratio=RATIO, **options):
    """Recover with what an averager knows."""
    return recover_pulse_errors(GridCycles(cycles), periods=np.diff(pulses), cycle_length=ratio,
                                declared_standard_deviation=declared, **options)


def declared(width, speed=SPEED):
    """Return the standard deviation (s) of `jitter`."""
    return width / 19.0 / speed / np.sqrt(12.0)


def z_scores(recovery, errors):
    """Recovered minus true errors without their common delay, in standard errors."""
    return (recovery.errors - (errors - errors.mean())) / recovery.standard_errors


MESH = {19: [1.0], 38: [0.5]}


def test_dense_harmonics_show_the_errors(rng):
    """Impacts make every harmonic as strong as those around it, which are no background."""
    lines = {order: [np.exp(rng.normal(0.0, 0.5) + 1j * rng.uniform(0.0, 2.0 * np.pi))]
             for order in range(1, 41)}
    errors = 5e-5 * rng.standard_normal(61)
    cycles, pulses = simulate(rng, errors, lines, samples=512, ratio=1.0, noise=0.1)
    for listed, left in ((), 0.5), ((5.0, 20.0), 0.5), (range(1, 41), 0.05):
        found = recover(cycles, pulses, declared=5e-5, ratio=1.0, additional_orders=listed)
        assert found.accepted
        assert found.std == pytest.approx(np.std(errors), rel=0.15)
        assert np.std(found.expected - errors) < left * np.std(errors)
    assert np.mean(z_scores(found, errors) ** 2) == pytest.approx(1.0, abs=0.5)


@pytest.mark.parametrize('seed', range(12))
def test_few_samples_and_parts_of_a_revolution_are_enough(seed):
    """Orders leak into each other where a cycle is part of a revolution, with 11 to 60 samples."""
    rng = np.random.default_rng(seed)
    ratio = 1.0 / rng.integers(1, 12) if seed % 2 else rng.uniform(0.1, 2.5)
    samples, count = int(np.exp(rng.uniform(np.log(11), np.log(60)))), 80
    highest = 0.3 * samples / ratio
    orders = np.unique(np.rint(np.exp(rng.uniform(0.0, np.log(highest), rng.integers(2, 6)))))
    lines = {order: [np.exp(rng.normal(0.0, 0.5))] for order in orders.tolist()}
    size = rng.uniform(0.02, 0.07) / orders.max()  # fundamental cycles
    errors = np.clip(size, 0.0, 0.02 * ratio) * PERIOD / ratio * rng.standard_normal(count + 1)
    cycles, pulses = simulate(rng, errors, lines, samples=samples, ratio=ratio, noise=0.03)
    found = recover(cycles, pulses, declared=np.std(errors) * np.exp(rng.normal(0.0, 0.4)),
                    ratio=ratio, additional_orders=orders)

    assert found.accepted, found.reason
    assert found.std == pytest.approx(np.std(errors), rel=0.35)
    late = found.errors - errors
    late -= np.average(late, weights=found.standard_errors**-2)
    assert np.mean((late / found.standard_errors) ** 2) < 1.7


def test_pulses_whose_errors_leave_the_phase_open_are_not_resolved():
    """The first and the last pulse bound one cycle, which shows less of them than two."""
    rng = np.random.default_rng(3)
    cycles, pulses = simulate(rng, jitter(rng, 0.8), {19: [1.0]}, noise=11.0)
    found = recover(cycles, pulses, declared=declared(0.8), orders=[19.0])
    assert found.accepted
    turn = 2.0 * np.pi * 19.0 * SPEED * found.standard_errors  # rad, of order 19
    assert turn[[0, -1]].min() > 1.1 > 0.9 > turn[1:-1].max()
    assert found.resolved[1:-1].all()
    assert not found.resolved[[0, -1]].any()


@pytest.mark.parametrize(('width', 'snr_db'), [(0.2, 10), (0.4, 10), (0.4, 0), (0.8, 10)])
def test_gear_mesh_is_restored_at_the_widths_that_hide_it(rng, width, snr_db):
    errors = jitter(rng, width)
    noise = np.sqrt(0.625 / 10.0 ** (snr_db / 10.0))
    cycles, pulses = simulate(rng, errors, MESH, samples=2500, noise=noise)  # 50 kHz
    found = recover(cycles, pulses, declared=declared(width))

    assert found.accepted
    assert found.reason == ''
    np.testing.assert_array_equal(found.orders, [19.0, 38.0])
    # standard error of an amplitude: noise sqrt(2 / samples), plus what the errors leave of it
    tolerance = 4.0 * noise * np.sqrt(2.0 / cycles.shape[0] / cycles.shape[1])
    remaining = (2.0 * np.pi * found.orders * SPEED * np.median(found.standard_errors)) ** 2
    np.testing.assert_array_less(np.abs(np.abs(found.amplitudes[0]) - [1.0, 0.5]),
                                 tolerance + remaining)
    after = np.std(found.errors - errors)
    assert after < 4e-6
    assert after < 0.06 * np.std(errors)


@pytest.mark.machines
@pytest.mark.parametrize(('ratio', 'width', 'noise', 'lines'), [
    (RATIO, 0.4, 0.2, MESH),
    (RATIO, 0.8, 1.0, MESH),
    (RATIO, 0.4, 0.7, {19: [1.0, 0.0, 0.5], 38: [0.5, 0.0, 0.7]}),
    (0.4137, 0.4, 0.2, MESH),
    (1.0, 0.4, 0.2, {18: [0.5], 19: [1.0], 20: [0.3]}),
], ids=['moderate', 'wide', 'three channels', 'ratio below 1', 'sidebands'])
def test_standard_errors_are_calibrated(rng, ratio, width, noise, lines):
    speed, squares = ratio / PERIOD, []
    for _ in range(6):
        errors = jitter(rng, width, speed=speed)
        cycles, pulses = simulate(rng, errors, lines, ratio=ratio, noise=noise)
        found = recover(cycles, pulses, declared=declared(width, speed), ratio=ratio)
        assert found.accepted
        squares.append(z_scores(found, errors) ** 2)
    # 606 squares of unit variance 2, some 1.3 times less independent than they are many
    assert np.mean(squares) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 * 1.3 / 606.0))


def test_normal_jitter_of_more_than_half_a_cycle_does_not_slip(rng):
    for _ in range(4):
        errors = 0.25 / 19.0 / SPEED * rng.standard_normal(101)
        assert np.max(np.abs(errors - errors.mean())) * 19.0 * SPEED > 0.5
        cycles, pulses = simulate(rng, errors, MESH, noise=0.2)
        found = recover(cycles, pulses, declared=np.std(errors))
        if found.accepted:  # or else the average holds too little of the mesh, and it says so
            assert np.max(np.abs(z_scores(found, errors))) < 6.0


def test_jitter_beyond_the_declared_is_recovered_without_bias(rng):
    errors = jitter(rng, 0.4)
    cycles, pulses = simulate(rng, errors, MESH, noise=0.1)
    found = recover(cycles, pulses, declared=declared(0.4) / 5.0)
    assert found.accepted
    assert np.std(found.errors) == pytest.approx(np.std(errors), rel=0.01)


def test_phase_is_that_at_angle_zero(rng):
    errors = jitter(rng, 0.2)
    cycles, pulses = simulate(rng, errors, {19: [np.exp(0.7j)]}, noise=0.05, angle=123.45)
    found = recover(cycles, pulses, declared=declared(0.2), first_angle=123.45)
    # a common delay is not observable: its phase stays in the amplitude
    phase = 0.7 + 2.0 * np.pi * 19.0 * SPEED * errors.mean()
    assert np.angle(found.amplitudes[0, 0]) == pytest.approx(phase, abs=0.01)


@pytest.mark.machines
def test_noise_and_nothing_else_is_refused(rng):
    accepted = 0
    for _ in range(100):
        cycles, pulses = simulate(rng, jitter(rng, 0.4, count=40), {19: [0.0, 0.0]}, noise=1.0,
                                  samples=256)
        found = recover(cycles, pulses, declared=declared(0.4))
        accepted += found.accepted
        assert found.accepted or not found.errors.any()
    assert accepted <= 2
    assert 'no synchronous order' in found.reason
    assert np.isnan(found.standard_errors).all()
    assert found.orders.size == 0
    assert (found.std, found.shown, found.evidence, found.excess, found.excess_error) == (0.0,) * 5


@pytest.mark.parametrize('order', [19.37, 18.5, 19.05])
def test_a_line_that_is_not_synchronous_is_not_taken(rng, order):
    cycles, pulses = simulate(rng, jitter(rng, 0.2), {order: [1.0]}, noise=0.2)
    assert not recover(cycles, pulses, declared=declared(0.2)).accepted


@pytest.mark.machines
@pytest.mark.parametrize(('quality', 'most'), [(50, 0), (500, 8)])
def test_noise_that_rings_at_an_order_is_mostly_refused(quality, most):
    # Cycles that ring on are not independent: at 500, taking them for it lets a third of 40 pass.
    # About one in 13 still does, so that 8 of 40 is three standard deviations above what is known.
    accepted = 0
    for seed in range(40):
        white = np.random.default_rng(seed).standard_normal((100 * 256, 2))
        frequency = 19.0 * RATIO / 256.0
        radius = 1.0 - np.pi * frequency / quality
        poles = [1.0, -2.0 * radius * np.cos(2.0 * np.pi * frequency), radius**2]
        cycles = lfilter([1.0], poles, white, axis=0).reshape(100, 256, 2)
        accepted += recover(cycles, PERIOD * np.arange(101.0), declared=declared(0.4)).accepted
    assert accepted <= most


def test_expected_errors_are_as_small_as_noise_demands(rng):
    """They come closer than no errors at all, as much as their variance says."""
    left, stated, size = [], [], []
    for _ in range(6):
        errors = jitter(rng, 0.1)
        cycles, pulses = simulate(rng, errors, MESH, noise=4.0)
        found = recover(cycles, pulses, declared=declared(0.1))
        assert found.accepted
        assert np.std(found.expected) < 0.9 * np.std(found.errors)
        left.append((found.expected - (errors - errors.mean())) ** 2)
        stated.append(found.covariance[0] / SPEED**2)
        size.append(errors**2)
    assert np.mean(left) < 0.7 * np.mean(size)
    assert np.mean(left) == pytest.approx(np.mean(stated), rel=4.0 * np.sqrt(2.0 * 1.3 / 606.0))


def test_noise_that_leaves_errors_unknown_is_refused(rng):
    errors = jitter(rng, 0.02)
    cycles, pulses = simulate(rng, errors, MESH, noise=4.0)
    found = recover(cycles, pulses, declared=declared(0.02))
    assert not found.accepted
    assert not found.errors.any()
    assert not found.expected.any()
    assert 'of the variance of the pulse errors, not more than 5%' in found.reason


@pytest.mark.parametrize('scale', [0.2, 1.0, 5.0])
def test_the_size_of_the_errors_is_estimated(rng, scale):
    width, sizes = 0.1, []
    for _ in range(4):
        errors = jitter(rng, width)
        cycles, pulses = simulate(rng, errors, MESH, noise=0.3)
        found = recover(cycles, pulses, declared=declared(width) / scale)
        assert found.accepted
        assert found.shown > 0.9
        assert found.evidence > 20.0
        sizes.append(found.std / np.std(errors))
    # grid of sizes 1.16 apart, of which the declared one is likeliest
    assert np.mean(sizes) == pytest.approx(1.0, abs=0.05)


def test_restricted_likelihood_leaves_out_the_delay_of_all_pulses(rng):
    """Against the likelihood with all errors integrated numerically: a wide prior of the delay."""
    information = Tridiagonal(rng.uniform(2.0, 4.0, 12), rng.uniform(-0.9, 0.9, 11))
    dense = (np.diag(information.diagonal) + np.diag(information.off_diagonal, 1)
             + np.diag(information.off_diagonal, -1))
    right = rng.normal(0.0, 2.0, 12)
    found = []
    for size in 0.7 * _SIZES:
        covariance = size**2 * np.eye(12) + 1e8
        shrunk = np.linalg.inv(np.linalg.inv(covariance) + dense)
        found.append(0.5 * (right @ shrunk @ right - np.linalg.slogdet(
            np.eye(12) + covariance @ dense)[1]))
    chance = np.exp(np.array(found) - np.max(found)) * _CHANCES
    mean = np.exp(np.log(0.7 * _SIZES) @ chance / chance.sum())
    assert estimated_size(information, right, 0.7) == pytest.approx(mean, rel=1e-4)
    variance = information.covariance()
    centred = np.eye(12) - 1.0 / 12.0
    exact = centred @ np.linalg.inv(dense) @ centred
    np.testing.assert_allclose(variance[0], np.diag(exact))
    np.testing.assert_allclose(variance[1, :-1], np.diag(exact, 1))


def test_the_shortest_path_is_that_of_all_paths(rng):
    costs = [rng.uniform(size=n) for n in (2, 3, 1, 4)]
    steps = [rng.uniform(size=(a.size, b.size)) for a, b in pairwise(costs)]

    def cost(path):
        return sum(row[i] for row, i in zip(costs, path)) + sum(
            step[i, j] for step, (i, j) in zip(steps, pairwise(path)))

    best = min(product(*(range(row.size) for row in costs)), key=cost)
    path, found = shortest_path(costs, steps)
    assert tuple(path) == best
    assert found == pytest.approx(cost(best))


def test_noise_channels_and_constant_channels_add_nothing(rng):
    errors = jitter(rng, 0.4)
    cycles, pulses = simulate(rng, errors, MESH, noise=0.3)
    alone = recover(cycles, pulses, declared=declared(0.4))
    others = np.concatenate((100.0 * rng.standard_normal((*cycles.shape[:2], 3)),
                             np.full((*cycles.shape[:2], 1), 1e3 / 3.0)), axis=2)
    together = recover(np.concatenate((cycles, others), axis=2), pulses, declared=declared(0.4))
    assert together.accepted
    # other candidates on the way there: the errors are fitted on other nodes, no more
    apart = together.errors - alone.errors
    assert np.sqrt(np.mean(apart**2)) < 0.1 * np.median(alone.standard_errors)


def test_a_high_order_that_jitter_has_averaged_away_waits_for_a_low_one(rng):
    errors = jitter(rng, 0.5)
    lines = {19: [0.2], 190: [1.0]}  # 5 cycles of order 190 wide
    cycles, pulses = simulate(rng, errors, lines, samples=2048, noise=0.2)
    found = recover(cycles, pulses, declared=declared(0.5))
    np.testing.assert_array_equal(found.orders, [19.0, 190.0])
    assert abs(found.amplitudes[0, 1]) == pytest.approx(1.0, abs=0.02)
    assert abs(np.mean(np.exp(2j * np.pi * 190.0 * SPEED * found.errors))) < 0.2
    without, _ = simulate(rng, errors, {190: [1.0]}, samples=2048, noise=0.2)
    assert not recover(without, pulses, declared=declared(0.5)).accepted


@pytest.mark.parametrize('strong', [(1,), (2,), (1, 2), (1, 2, 3), (1, 2, 3, 4, 5)])
def test_the_lowest_orders_stand_out_too(rng, strong):
    """They have no neighbours below: of copies of themselves nothing stands out."""
    errors = jitter(rng, 0.8)
    cycles, pulses = simulate(rng, errors, {order: [1.0] for order in strong}, noise=0.003)
    found = recover(cycles, pulses, declared=declared(0.8))
    assert found.accepted
    assert set(strong) == set(found.orders)
    assert np.sqrt(np.mean(z_scores(found, errors) ** 2)) < 1.3


def test_a_strong_first_order_leaves_the_mesh_orders_what_they_tell(rng):
    errors = jitter(rng, 0.4)
    size = {}
    for lines in (MESH, {1: [1.0], **MESH}):
        cycles, pulses = simulate(rng, errors, lines, noise=0.3)
        found = recover(cycles, pulses, declared=declared(0.4))
        assert found.accepted
        size[len(lines)] = np.sqrt(np.mean(found.standard_errors**2))
    assert size[3] < 1.05 * size[2]


def test_given_orders_are_the_only_ones(rng):
    cycles, pulses = simulate(rng, jitter(rng, 0.2), MESH, noise=0.2)
    found = recover(cycles, pulses, declared=declared(0.2), orders=[19.0])
    np.testing.assert_array_equal(found.orders, [19.0])
    assert not recover(cycles, pulses, declared=declared(0.2), orders=[21.5]).accepted


def test_a_known_order_of_another_shaft_helps_and_does_not_disturb(rng):
    errors = jitter(rng, 0.3, count=40)
    cycles, pulses = simulate(rng, errors, {18: [1.0], 20.3226: [0.9]}, ratio=3.0, noise=0.3)
    recovery = recover(cycles, pulses, declared=declared(0.3), ratio=3.0,
                       additional_orders=[20.3226])
    assert 20.3226 in recovery.orders
    # a mean square of 41 normal variables
    assert np.mean(z_scores(recovery, errors) ** 2) < 1.0 + 4.0 * np.sqrt(2.0 / errors.size)


@pytest.mark.parametrize('count', [2, 3, 4, 5])
def test_few_cycles_work_or_are_refused(rng, count):
    for width in (0.02, 0.4):
        errors = jitter(rng, width, count=count)
        cycles, pulses = simulate(rng, errors, MESH, noise=0.003)
        found = recover(cycles, pulses, declared=declared(width))
        assert np.isfinite(found.errors).all()
        if found.accepted:
            assert np.std(found.errors - errors) < 0.5 * np.std(errors)
        else:
            assert found.reason


def test_bad_input_is_refused(rng):
    cycles, pulses = simulate(rng, jitter(rng, 0.2, count=5), MESH)
    broken = cycles.copy()
    broken[2, 7, 0] = np.nan
    with pytest.raises(SignalError, match='not finite'):
        recover(broken, pulses, declared=1e-5)
    with pytest.raises(SignalError, match='not finite'):
        recover(cycles, pulses[::-1], declared=1e-5)
    with pytest.raises(SignalError, match='at least 2 cycles'):
        recover(cycles, pulses[:-1], declared=1e-5)
    with pytest.raises(SignalError, match='at least 2 cycles'):
        recover(cycles[:1], pulses[:2], declared=1e-5)
    with pytest.raises(ParameterError, match='declared_standard_deviation is 0'):
        recover(cycles, pulses, declared=0.0)
    with pytest.raises(ParameterError, match='cycle_length is nan'):
        recover(cycles, pulses, declared=1e-5, ratio=float('nan'))


def test_neighbours_of_strong_orders_take_no_room_from_weaker_ones(rng):
    """A coarse clock's errors widen each order so that few fit into a short cycle."""
    width = 0.4 / 32.0 * PERIOD
    lines = {8: [1.0], 16: [0.8], 24: [0.6], 32: [0.5]}
    for errors in rng.uniform(-0.5, 0.5, (12, 21)) * width:
        cycles, pulses = simulate(rng, errors, lines, samples=240, ratio=1.0, noise=0.05)
        found = recover(cycles, pulses, ratio=1.0, declared=width / np.sqrt(12.0))
        np.testing.assert_array_equal(found.orders, list(lines))


@pytest.mark.parametrize(('samples', 'ratio'), [(80, 25.0), (10, 1.0), (16, 0.3)])
def test_few_samples_a_cycle_are_searched_to_their_end(rng, samples, ratio):
    speed = ratio / PERIOD
    errors = rng.uniform(-0.5, 0.5, 101) * 0.1 / speed
    cycles, pulses = simulate(rng, errors, {1.0: [1.0]}, samples=samples, ratio=ratio, noise=0.02)
    found = recover(cycles, pulses, declared=0.1 / speed / np.sqrt(12.0), ratio=ratio)
    assert found.errors.shape == errors.shape
    assert not found.accepted or np.abs(z_scores(found, errors)).mean() < 2.0
