# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Standard errors of amplitudes and phases against the truth that a simulation knows."""

import numpy as np
import pytest
import sa_jitter_ros as sa
from sa_jitter_ros.averaging.amplitude_errors import (
    _Jittered, AmplitudeErrors, corrected_errors, kurtosis_of, Repeatability, Scatter, upper_limit,
    waveform_error)

ORDERS = np.array([16.0, 32.0, 8.0, 5.0, 11.0])  # strong, three times; absent; 10 dB weak
AMPLITUDES = np.array([1.0, 0.3, 0.5, 0.0, 0.0])
PHASES = np.array([0.1, 2.2, -2.5, 0.0, 1.3])
ABSENT, WEAK = 3, 4
STRONG = slice(0, 3)


def cycles_of(rng, count, *, noise, turn, orders=ORDERS, weak=None, errors=None):
    """
    Return amplitudes (cycle, 1, order) of single trigger cycles between jittery pulses, and true.

    Between wrong pulses the orders leak into each other. `noise` is that of the mean of all,
    `turn` (rad) the standard deviation of order 16's phase. `errors` (count + 1,) of the pulses
    are uniform unless given.
    """
    true = AMPLITUDES * np.exp(1j * PHASES)
    true[WEAK] = (weak or 10 ** 0.5 * noise) * np.exp(1j * PHASES[WEAK])
    if errors is None:
        errors = rng.uniform(-1.0, 1.0, count + 1) * np.sqrt(3.0)
    errors = errors * turn / (2.0 * np.pi * orders[0])
    u = np.linspace(0.0, 1.0, 129)
    weight = np.full(u.size, 1.0 / 128) * np.where((u == 0.0) | (u == 1.0), 0.5, 1.0)
    angle = u + errors[:-1, None] * (1.0 - u) + errors[1:, None] * u
    wave = np.einsum('k,kcu->cu', true, np.exp(
        2j * np.pi * orders[:, None, None] * angle)).real
    found = 2.0 * (wave * weight) @ np.exp(-2j * np.pi * np.outer(u, orders))
    white = rng.standard_normal((count, orders.size, 2)) @ (1.0, 1.0j)
    return (found + noise * np.sqrt(count) * white)[:, None], true


def shares(z):
    """Return the shares of z (trial, order) within 1 and within 1.96."""
    return np.array([np.mean(np.abs(z) < width, axis=0) for width in (1.0, 1.96)])


def hold(found, trials):
    """Whether shares are 68 % and 95 % within 3 points and the error of so many trials."""
    wanted = np.array([0.683, 0.950]).reshape(2, *(1,) * (found.ndim - 1))
    return np.abs(found - wanted) < 0.03 + 3.0 * np.sqrt(wanted * (1.0 - wanted) / trials)


@pytest.mark.parametrize(('count', 'noise', 'turn'), [
    (6, 0.01, 0.3), (10, 0.01, 0.02), (10, 0.05, 0.3),
    pytest.param(40, 0.01, 0.8, marks=pytest.mark.machines)])
def test_raw_errors_are_the_scatter_from_average_to_average(count, noise, turn):
    trials, rng = 250, np.random.default_rng(count)
    means, along, phase, upper, turned = [], [], [], [], []
    for _ in range(trials):
        cycles, true = cycles_of(rng, count, noise=noise, turn=turn)
        mean = cycles.mean(axis=0)
        errors = Repeatability.of(cycles, cycles, ORDERS).errors(mean)
        means.append(mean[0])
        turned.append(mean[0] * np.conj(true))
        along.append(errors.amplitude[0])
        phase.append(errors.phase[0])
        upper.append(errors.upper_95[0])
    size = np.abs(means)
    present = np.array([0, 1, 2, WEAK])
    z = ((size - size.mean(axis=0)) / along)[:, present]
    assert hold(shares(z), trials).all()
    strong = np.angle(turned)[:, STRONG] / np.array(phase)[:, STRONG]
    assert hold(shares(strong), trials).all()
    # an absent order: its real part
    z = np.real(means)[:, ABSENT] / np.array(along)[:, ABSENT]
    assert hold(shares(z), trials).all()
    limits = np.array(upper)
    assert np.mean(limits[:, WEAK] > np.sqrt(10.0) * noise) > 0.92
    assert np.all(limits[:, ABSENT] > 0.0)


@pytest.mark.parametrize(('count', 'turn', 'shape'), [
    (20, 0.3, 'normal'), (40, 0.6, 'uniform'),
    pytest.param(40, 0.6, 'normal', marks=pytest.mark.machines)])
def test_errors_of_known_jitter_hold_for_both_shapes_of_it(count, turn, shape):
    """The correction tells the size and the kurtosis of the pulse errors, and the noise."""
    trials, rng, noise = 200, np.random.default_rng(count + int(10 * turn)), 0.01
    size, along, phase, turned, absent = [], [], [], [], []
    for _ in range(trials):
        errors = (rng.standard_normal(count + 1) if shape == 'normal'
                  else rng.uniform(-1.0, 1.0, count + 1) * np.sqrt(3.0))
        cycles, true = cycles_of(rng, count, noise=noise, turn=turn, errors=errors)
        white = rng.standard_normal((count, 1, ORDERS.size, 2)) @ (1.0, 1.0j)
        aligned = true + noise * np.sqrt(count) * white
        mean = cycles.mean(axis=0)
        found = Repeatability.of(
            cycles, cycles, ORDERS, jitter=turn / (2.0 * np.pi * ORDERS[0]),
            kurtosis=kurtosis_of(errors - errors.mean()), corrected=Scatter.of(aligned, aligned)
        ).errors(mean)
        size.append(np.abs(mean[0]))
        along.append(found.amplitude[0])
        phase.append(found.phase[0])
        turned.append(np.angle(mean[0] * np.conj(true)))
        absent.append(mean[0, ABSENT].real)
    along = np.array(along)
    assert hold(shares(((size - np.mean(size, axis=0)) / along)[:, STRONG]), trials).all()
    assert hold(shares((np.array(turned) / phase)[:, STRONG]), trials).all()
    assert hold(shares(absent / along[:, ABSENT]), trials).all()


@pytest.mark.machines
@pytest.mark.parametrize(('count', 'turn', 'weak'), [(20, 0.3, 0.1), (40, 0.8, 0.03)])
def test_errors_of_a_sideband_hold_what_jitter_leaks_into_the_mean(count, turn, weak):
    """Into single cycles the strong order leaks much more, which the next cycle takes back."""
    trials, rng, orders = 200, np.random.default_rng(count), ORDERS.copy()
    orders[WEAK] = ORDERS[0] + 1.0
    size, along = [], []
    for _ in range(trials):
        cycles, _ = cycles_of(rng, count, noise=0.01, turn=turn, orders=orders, weak=weak)
        mean = cycles.mean(axis=0)
        size.append(np.abs(mean[0, WEAK]))
        along.append(Repeatability.of(cycles, cycles, orders).errors(mean).amplitude[0, WEAK])
    assert hold(shares((size - np.mean(size)) / along), trials).all()


@pytest.mark.machines
@pytest.mark.filterwarnings('ignore::sa_jitter_ros.errors.DataWarning')
def test_corrected_errors_are_the_distance_from_the_truth():
    """Also of the phase, which the mean of the pulse errors turns, and which no one can know."""
    rng, trials, count = np.random.default_rng(4), 36, 10
    orders, size = np.array([8.0, 16.0, 21.0, 11.0]), np.array([0.5, 1.0, 0.04, 0.0])
    rate, speed, clock = 4000.0, 25.0, 1200.0
    times = np.arange(round(17 / speed * rate)) / rate
    true = (2.0 + np.arange(14.0)) / speed
    wave = np.exp(2j * np.pi * speed * np.outer(orders, times - true[0]))
    amplitude, phase, limits = [], [], []
    for _ in range(trials):
        turn = np.exp(2j * np.pi * rng.uniform(size=orders.size))
        samples = ((size * turn) @ wave).real + 0.25 * rng.standard_normal(times.size)
        pulses = true + rng.uniform(-0.5, 0.5, true.size) / clock
        average, *_ = sa.average(
            samples, rate, pulses, orders=orders, trigger_cycles=count, correct_jitter=True,
            keyphasor_rate=clock, interval_tolerance=0.45)
        correction = average.correction
        assert correction.accepted
        errors = correction.amplitude_errors
        amplitude.append((np.abs(correction.amplitudes[0]) - size) / errors.amplitude[0])
        phase.append(np.angle(correction.amplitudes[0] / turn) / errors.phase[0])
        limits.append(errors.upper_95[0] >= size)
    assert hold(shares(np.array(amplitude)[:, :3]), trials).all()
    assert hold(shares(np.array(phase)[:, :2]), trials).all()
    assert np.all(np.mean(limits, axis=0) > 0.92 - 3.0 * np.sqrt(0.05 * 0.95 / trials))


@pytest.mark.machines
@pytest.mark.filterwarnings('ignore::sa_jitter_ros.errors.DataWarning')
@pytest.mark.parametrize(
    ('count', 'turn', 'ratio'), [(10, 0.3, 1.0), (40, 0.8, 1.0), (10, 0.3, 2.4)])
def test_errors_of_a_waveform_hold_the_jitter_that_neighbouring_cycles_share(count, turn, ratio):
    rng, trials, rate, speed = np.random.default_rng(count), 40, 8000.0, 25.0
    times = np.arange(round((count + 7) / speed * rate)) / rate
    true, orders = (2.0 + np.arange(count + 4.0)) / speed, ORDERS[STRONG]
    wave = (AMPLITUDES[STRONG] * np.exp(1j * PHASES[STRONG])) @ np.exp(
        2j * np.pi * speed * ratio * np.outer(orders, times - true[0]))
    std = turn / (2.0 * np.pi * orders[0] * speed * ratio)
    found = [sa.average(wave.real + 0.05 * rng.standard_normal(times.size), rate,
                        true + std * np.sqrt(3.0) * rng.uniform(-1.0, 1.0, true.size),
                        ratio=ratio, orders=orders, trigger_cycles=count,
                        interval_tolerance=0.45)[0] for _ in range(trials)]
    waveforms = np.array([item.waveform[0] for item in found])
    z = (waveforms - waveforms.mean(axis=0)) / [item.standard_error[0] for item in found]
    assert hold(shares(z.ravel()), trials).all()


@pytest.mark.parametrize('true', [0.5, 1.0, 2.0, 5.0])
def test_upper_limit_holds_for_any_amplitude(true):
    noise = np.random.default_rng(2).standard_normal((20000, 2)) @ (1.0, 1.0j)
    above = upper_limit(np.abs(true + noise), np.ones(noise.size)) >= true
    if true > 0.5:  # that of which the lowest limit is
        assert above.mean() == pytest.approx(0.95, abs=4.0 * np.sqrt(0.05 * 0.95 / noise.size))
    else:
        assert above.mean() == 1.0


def test_upper_limit_without_correction_is_that_before_the_loss():
    rng, upper = np.random.default_rng(3), []
    for _ in range(120):
        cycles, _ = cycles_of(rng, 40, noise=0.01, turn=0.8)
        upper.append(Repeatability.of(cycles, cycles, ORDERS).errors(cycles.mean(axis=0)).upper_95)
    assert np.all(np.mean(np.array(upper)[:, 0] >= AMPLITUDES, axis=0) > 0.92)
    # which the declared jitter tells, too, where no order shows it
    quiet = Repeatability.of(cycles, cycles, ORDERS, jitter=0.0)
    declared = 0.8 / (2.0 * np.pi * ORDERS)
    ratio = [quiet.errors(cycles.mean(axis=0), jitter).upper_95[0, line]
             / quiet.errors(cycles.mean(axis=0)).upper_95[0, line]
             for line, jitter in enumerate(declared)]
    np.testing.assert_allclose(ratio, 1.0 / 0.8018, rtol=1e-3)  # E X of uniform jitter


@pytest.mark.filterwarnings('ignore::sa_jitter_ros.errors.DataWarning')
def test_errors_of_one_cycle_of_silence_and_above_nyquist_are_no_numbers():
    cycles, _ = cycles_of(np.random.default_rng(1), 1, noise=0.1, turn=0.1)
    errors = Repeatability.of(cycles, cycles, ORDERS).errors(cycles[0])
    assert np.isnan([errors.amplitude, errors.phase, errors.upper_95]).all()
    time = np.arange(4000) / 1000.0
    average, = sa.average(np.stack((0.0 * time, np.cos(time))), 1000.0, np.arange(1, 39) / 10.0,
                          orders=[1.0, 40.0, 60.0])
    errors = average.amplitude_errors
    for item in (errors.amplitude, errors.phase, errors.upper_95):
        assert np.isnan(item[:, 2]).all()
        assert np.isfinite(item[:, :2]).all()


@pytest.mark.parametrize(('count', 'length'), [(100, 1.0), (40, 2.5)])
def test_neighbouring_cycles_share_what_a_pulse_moves(count, length):
    """The variance of the mean beyond that of independent cycles, for any place in the cycle."""
    place = (np.arange(0.0, length, length / 200)[:, None] + np.arange(count)) / length
    moved = np.maximum(1.0 - abs(place[:, None] - np.arange(place.max() + 2.0)[:, None]), 0.0)
    alone = np.sum(np.mean(moved, axis=2) ** 2 - np.mean(moved**2, axis=2) / count, axis=1)
    wave = np.cos(2.0 * np.pi * np.arange(64) / 64)[:, None]
    error = waveform_error(wave, np.zeros(wave.shape), count, 0.01, length)
    # between the neighbours of a point, 2 of 64 steps apart, the steepest slope is 0.9984 of it
    steepest = 0.01 * 2.0 * np.pi * 0.9984
    assert error.max() == pytest.approx(steepest * np.sqrt(alone.mean()), rel=2e-3)


def test_limits_go_as_far_as_either_kind_of_jitter_takes_and_no_farther():
    amplitude, noise = np.ones((1, 1)), np.full((1, 1), 1e-3)
    u = (np.arange(400) + 0.5) / 400
    for turn in (1.0, 2.5, 20.0):
        errors = Repeatability(np.ones(1), noise, noise, turn / (2.0 * np.pi)).errors(amplitude)
        normal = np.mean(np.exp(-0.5 * turn**2 * (u**2 + (1.0 - u) ** 2)))
        uniform = np.mean(np.sinc(np.sqrt(3.0) / np.pi * turn * u)
                          * np.sinc(np.sqrt(3.0) / np.pi * turn * (1.0 - u)))
        left = max(min(normal, uniform), 0.02)
        assert errors.upper_95[0, 0] == pytest.approx(1.0016 / left, rel=1e-3)


def test_degrees_of_freedom_are_those_of_the_noise(rng):
    """Of a strong order along the radius, of an absent one in any direction."""
    for count in (10, 60, 61):
        noise = rng.standard_normal((count, 1, 2, 2)) @ (1.0, 1.0j)
        cycles = (5.0, 0.0) + 0.1 * (noise - noise.mean(axis=0))
        freedom = Scatter.of(cycles, cycles).freedom[0]
        assert freedom[0] == pytest.approx(count - 1, abs=1.0)
        assert freedom[1] == pytest.approx(2 * (count - 1), abs=2.0)


@pytest.mark.parametrize('ratio', [0.2, 0.5, 0.7])
def test_errors_of_a_phase_hold_down_to_noise_as_large_as_the_amplitude(rng, ratio):
    noise = ratio * (rng.standard_normal((20_000, 1, 2)) @ (1.0, 1.0j))
    found = AmplitudeErrors.of(1.0 + noise, np.full(noise.shape, ratio),
                               np.full(noise.shape, ratio))
    assert hold(shares(np.angle(1.0 + noise) / found.phase), 20_000).all()


@pytest.mark.parametrize('count', [2, 5, 30])
def test_the_mean_of_all_pulse_errors_turns_the_corrected_phase(count):
    cycles = np.ones((count, 1, 3), complex)
    errors = corrected_errors(
        Scatter.of(cycles, cycles), np.array([1.0, 8.0, 20.0]), amplitudes=cycles[0],
        unsure=np.zeros((1, 3)), largest=np.ones((1, 3)), jitter=1e-4)
    pulses = count + 1.0
    np.testing.assert_allclose(errors.phase[0], 2e-4 * np.pi * np.array([1.0, 8.0, 20.0])
                               / np.sqrt(pulses), rtol=1e-3)


def test_what_turns_a_phasor_does_not_make_its_size_uncertain(rng):
    """Phases scatter from cycle to cycle by more than the pulses do, whose jitter is known."""
    count, noise = 60, 1e-3
    turned = np.exp(0.1j * rng.standard_normal((count, 1, 1)))
    white = noise * (rng.standard_normal((count, 1, 1, 2)) @ (1.0, 1.0j))
    cycles = turned + white
    found = Repeatability.of(cycles, cycles, np.array([16.0]), jitter=1e-4)
    radial = (cycles * np.exp(-1j * np.angle(cycles.mean(axis=0)))).real
    assert found.along[0, 0] == pytest.approx(radial.std() / np.sqrt(count), rel=0.25)


@pytest.mark.parametrize('phase', [1.0, 2.5])
def test_orders_that_jitter_leaks_into_the_same_place_add_with_their_phases(rng, phase):
    """An absent order between two strong ones, whose cycles show the noise beside the leakage."""
    orders, count, std, noise = np.array([15.0, 16.0, 17.0]), 4000, 0.003, 0.02
    true = np.array([[1.0, 0.0, 0.7 * np.exp(1j * phase)]])
    u = (np.arange(64) + 0.5) / 64
    errors = std * np.sqrt(3.0) * rng.uniform(-1.0, 1.0, count + 1)
    angle = u + errors[:-1, None] * (1.0 - u) + errors[1:, None] * u
    wave = np.tensordot(true[0], np.exp(2j * np.pi * orders[:, None, None] * angle), axes=1)
    cycles = (wave.real @ np.exp(-2j * np.pi * np.outer(u, orders)) / 32)[:, None]
    jittered = _Jittered.of(true, orders, std**2, 1.8, 1.0, whole=True)
    apart = cycles - cycles.mean(axis=0)
    for lag, (both, lean) in enumerate(zip(jittered.both, jittered.lean)):
        first, second = apart[:count - lag], apart[lag:]
        near = 0.2 * jittered.both[0]
        assert np.all(abs(both - np.mean(np.conj(first) * second, axis=0).real) < near)
        assert np.all(abs(lean - np.mean(first * second, axis=0)) < near)
    cycles += noise * (rng.standard_normal((*cycles.shape, 2)) @ (1.0, 1.0j))
    found, freedom = jittered.noise_beside(
        Scatter.of(cycles, cycles), np.exp(1j * np.angle(cycles.mean(axis=0))))
    assert np.all(abs(found / noise**2 - 1.0) < 4.0 * np.sqrt(2.0 / freedom))
    assert np.all(freedom[0, [0, 2]] < count)


@pytest.mark.parametrize('kurtosis', [1.8, 3.0])
def test_what_turns_all_cycles_together_does_not_shorten_their_mean(rng, kurtosis):
    count, std, true = 3, 0.004, np.ones((1, 1))
    draw = (rng.standard_normal((20_000, count + 1)) if kurtosis == 3.0
            else np.sqrt(3.0) * rng.uniform(-1.0, 1.0, (20_000, count + 1)))
    begin, change = std * draw[:, :-1], std * np.diff(draw)
    mean = np.mean(np.exp(2j * np.pi * 10.0 * (begin + 0.5 * change)) * np.sinc(10.0 * change),
                   axis=1)
    along, across = _Jittered.of(true, np.array([10.0]), std**2, kurtosis, 1.0, whole=True
                                 ).of_mean(np.ones((1, 1)), count)
    assert along[0, 0] == pytest.approx(np.var(abs(mean)), rel=0.1)
    assert across[0, 0] == pytest.approx(np.var(mean.imag), rel=0.1)
