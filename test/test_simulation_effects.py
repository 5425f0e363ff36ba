# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The statistics of every simulated effect: sizes, shapes and correlations that were asked for."""

import numpy as np
import pytest
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.simulation import (
    AdditiveNoise, Component, DeclaredJitter, EFFECTS, Gearbox, Keyphasor, make_effects)

SPEED = 25.0
STD = 1e-5


def machine(*effects, rate=5000.0, orders=(4.0,), **options):
    """Return a steady machine with unit components of one shaft and one channel."""
    return Gearbox(tuple(Component('shaft', order, (1.0,), (0.0,)) for order in orders), rate,
                   **{'speed': ((0.0, SPEED),), 'effects': effects, 'seed': 11, **options})


def one(name, **parameters):
    """Return one effect."""
    return make_effects({name: parameters})[0]


def pulse_errors(*effects, count=20_000, **options):
    """Return the errors of a number of pulses of a once-a-revolution keyphasor."""
    return machine(*effects, **options).pulses(0.0, count / SPEED).errors


def correlation(values, lag):
    """Return the autocorrelation at a lag."""
    values = values - np.mean(values)
    return np.mean(values[lag:] * values[:-lag]) / np.var(values)


# --- pulses -------------------------------------------------------------------------------------

@pytest.mark.parametrize(('effect', 'kurtosis'), [
    (DeclaredJitter('uniform', STD), 1.8), (DeclaredJitter('triangular', STD), 2.4),
    (DeclaredJitter('normal', STD), 3.0), (one('excess_jitter', std=STD), 3.0)])
def test_jitter_has_its_moments_and_is_white(effect, kurtosis):
    errors = pulse_errors(effect)
    se = 1 / np.sqrt(errors.size)
    assert abs(np.mean(errors)) < 4 * STD * se
    assert np.var(errors) == pytest.approx(STD**2, rel=4 * np.sqrt(kurtosis - 1) * se)
    assert np.mean(errors**4) / STD**4 == pytest.approx(kurtosis, abs=4 * np.sqrt(96) * se)
    assert max(abs(correlation(errors, lag)) for lag in (1, 2, 3)) < 4 * se


def test_jitter_of_a_table_is_drawn_evenly_around_its_mean():
    table = (0.0, 1e-6, 5e-6)
    errors = pulse_errors(DeclaredJitter('table', table=table))
    values, counts = np.unique(errors.round(12), return_counts=True)
    np.testing.assert_allclose(values, np.array(table) - 2e-6, atol=1e-12)
    np.testing.assert_allclose(counts / errors.size, 1 / 3, atol=4 * np.sqrt(2 / 9 / errors.size))


@pytest.mark.parametrize('rho', [-0.4, 0.0, 0.6, 0.95])
def test_correlated_jitter(rho):
    errors = pulse_errors(one('correlated_jitter', std=STD, correlation=rho), count=50_000)
    # Effective numbers of independent values of an AR(1) process (Bartlett).
    spread = np.sqrt((1 + rho**2) / (1 - rho**2) / errors.size)
    assert np.var(errors) == pytest.approx(STD**2, rel=4 * np.sqrt(2) * spread)
    for lag in (1, 2, 5):
        assert correlation(errors, lag) == pytest.approx(rho**lag, abs=4 * spread)


def test_quantised_pulses_lie_on_the_clock_after_their_time():
    gearbox = machine(one('keyphasor_quantisation', clock_rate=3300.0, period_std=1e-4))
    pulses = gearbox.pulses(0.0, 400.0)
    ticks = pulses.times * 3300.0
    np.testing.assert_allclose(ticks, np.round(ticks), rtol=0, atol=1e-9)
    assert (pulses.errors >= 0).all()
    assert (pulses.errors < 1 / 3300.0).all()
    periods = np.diff(pulses.true_times)
    # Slow fluctuation: about two independent periods for each 1 / bandwidth of 0.4 s.
    assert np.std(periods) == pytest.approx(1e-4, rel=4 / np.sqrt(2 * 400 / 0.4))
    # At this fluctuation the phase on the grid covers the clock period evenly.
    assert np.var(pulses.errors) == pytest.approx(1 / 12 / 3300**2, rel=0.1)


def test_target_geometry_repeats_with_the_marks():
    angles = (0.0, 0.004, -0.003, 0.001)
    gearbox = machine(one('target_geometry', pulse_angles=angles),
                      keyphasor=Keyphasor(pulses_per_revolution=4), speed=((0, 20), (5, 60)))
    pulses = gearbox.pulses(0.0, 4.0)
    turned = 2 * np.pi * (gearbox.angle(pulses.times) - gearbox.angle(pulses.true_times))
    np.testing.assert_allclose(turned, np.array(angles)[pulses.index % 4], atol=1e-11)


def test_clock_skew_grows_with_time():
    pulses = machine(one('clock_skew', skew=1e-3)).pulses(1000.0, 1001.0)
    np.testing.assert_allclose(pulses.errors, 1e-3 * pulses.true_times, rtol=1e-9)
    assert 1000.0 <= pulses.times[0] < 1000.0 + 1.01 / SPEED
    assert pulses.times[-1] > 1001.0 - 1.01 / SPEED


def test_jitter_scale_scales_the_declared_jitter_alone():
    jitter = DeclaredJitter('triangular', STD)
    declared = pulse_errors(jitter)
    np.testing.assert_allclose(pulse_errors(jitter, one('jitter_scale', scale=2.5)),
                               2.5 * declared, rtol=0, atol=1e-12)
    more = one('excess_jitter', std=STD)
    np.testing.assert_allclose(
        pulse_errors(jitter, more, one('jitter_scale', scale=0.5)) - pulse_errors(more),
        0.5 * declared, rtol=0, atol=1e-12)


def test_path_delay_is_the_same_at_every_speed():
    pulses = machine(one('path_delay', delay=3e-3), speed=((0, 20), (5, 60))).pulses(0.0, 5.0)
    np.testing.assert_allclose(pulses.errors, 3e-3, rtol=0, atol=1e-12)
    assert pulses.times[0] < 1.01 / 20.0 + 3e-3
    # The keyphasor's clock shows the delay: its skew and grid come last.
    late = machine(one('path_delay', delay=3e-3), one('clock_skew', skew=1e-2)).pulses(0.0, 5.0)
    np.testing.assert_allclose(late.times, 1.01 * (late.true_times + 3e-3), rtol=1e-12)


def test_missing_pulses():
    gearbox = machine(one('missing_pulses', probability=0.03))
    index = gearbox.pulses(0.0, 800.0).index
    lost = 20_000 - index.size
    assert abs(lost - 600) < 4 * np.sqrt(20_000 * 0.03 * 0.97)
    neighbours = np.count_nonzero(np.diff(index) > 2)
    assert abs(neighbours - 600 * 0.03) < 4 * np.sqrt(18)


def test_effects_on_pulses_leave_the_vibration_alone():
    effects = make_effects({
        'excess_jitter': {'std': STD}, 'correlated_jitter': {'std': STD, 'correlation': 0.5},
        'target_geometry': {'pulse_angles': (0.1,)}, 'clock_skew': {'skew': 1e-3},
        'keyphasor_quantisation': {'clock_rate': 1e3}, 'missing_pulses': {'probability': 0.1}})
    np.testing.assert_array_equal(machine(*effects).vibration(0, 5000),
                                  machine().vibration(0, 5000))


# --- shaft and vibration ------------------------------------------------------------------------

@pytest.mark.machines
def test_acceleration_of_the_shaft():
    gearbox = machine(one('speed_fluctuation', acceleration_std=2.0))
    times, step = np.arange(0, 1000.0, 0.01), 1e-4
    speed = [2 * np.pi * gearbox.shaft_speed(times + shift) for shift in (-step, step)]
    acceleration = (speed[1] - speed[0]) / (2 * step)
    # A bandwidth of 0.15 x 25 Hz gives about 2 x 3.75 independent values a second.
    assert np.std(acceleration) == pytest.approx(2.0, rel=4 / np.sqrt(2 * 7.5 * 1000))
    # Over half a trigger cycle, 20 ms, the acceleration hardly changes: mean of cos(pi f / 25 Hz).
    assert correlation(acceleration, 2) == pytest.approx(0.92, abs=0.03)
    assert abs(np.mean(speed) / (2 * np.pi * SPEED) - 1) < 1e-4


def cycle_amplitudes(gearbox, orders, cycles):
    """Return the complex amplitude of orders in every revolution, read at the true angle."""
    angles = (np.arange(cycles * 64) + 0.5) / 64
    signal = gearbox._signal(gearbox.setting.motion.time_at(angles))[0]
    waves = np.exp(-2j * np.pi * np.multiply.outer(orders, angles))
    return 2 * (signal * waves).reshape(len(orders), cycles, 64).mean(axis=2)


@pytest.mark.machines
def test_phase_wander_attenuates_all_orders_of_a_shaft_alike():
    std = 0.12
    gearbox = machine(one('phase_wander', std=std), orders=(4.0, 8.0))
    first, second = cycle_amplitudes(gearbox, (4.0, 8.0), 4000)
    # 0.38 of the trigger rate as bandwidth: 0.76 independent values a cycle.
    se = 1 / np.sqrt(0.76 * 4000)
    for order, got in ((4, first), (8, second)):
        variance = 1 - np.exp(-(order * std) ** 2)
        wanted = np.exp(-((order * std) ** 2) / 2)
        assert abs(np.mean(got)) == pytest.approx(wanted, abs=4 * variance * se + 0.01)
    locked = np.sum(second * np.conj(first) ** 2) / np.sum(np.abs(second * first ** 2))
    assert locked.real > 0.99


def test_phase_wander_differs_between_shafts():
    gearbox = Gearbox(tuple(Component(name, 4.0, (1.0,), (0.0,)) for name in 'ab'), 5000.0,
                      shafts={'a': 1.0, 'b': 2.0}, effects=(one('phase_wander', std=0.1),))
    first, second = np.angle(cycle_amplitudes(gearbox, (4.0, 8.0), 2000))
    assert np.std(first) > 0.3
    assert abs(np.corrcoef(first, second)[0, 1]) < 4 / np.sqrt(0.76 * 2000)


@pytest.mark.machines
def test_amplitude_modulation_scatters_without_bias():
    gearbox = machine(one('amplitude_modulation', std=0.2), orders=(4.0, 8.0))
    first, second = cycle_amplitudes(gearbox, (4.0, 8.0), 4000)
    se = 1 / np.sqrt(0.76 * 4000)
    assert np.mean(first).real == pytest.approx(1.0, abs=4 * 0.2 * se)
    # The mean over a cycle smooths what lies below 0.4 of the trigger rate by up to sinc(0.4).
    assert 0.8 * 0.2 < np.std(first.real) < 0.2 * (1 + 4 * se)
    np.testing.assert_allclose(first.real, second.real, atol=0.1)


GAINS = {
    'linear': lambda x: np.sinc(x) ** 2,
    'cubic': lambda x: np.sinc(x) ** 3 * (3 * np.sinc(x) - 2 * np.cos(np.pi * x)),
    'spline': lambda x: 3 * np.sinc(x) ** 4 / (2 + np.cos(2 * np.pi * x))}


@pytest.mark.parametrize('method', GAINS)
@pytest.mark.parametrize('order', [18.0, 34.0, 60.0])
def test_interpolation_loses_what_theory_says(method, order):
    gearbox = machine(one('interpolation_loss', method=method), orders=(order,))
    cycles = order * gearbox.angle(np.arange(80_000) / 5000.0)
    gain = 2 * np.mean(gearbox.vibration(0, 80_000)[0] * np.exp(-2j * np.pi * cycles))
    assert abs(gain) == pytest.approx(GAINS[method](order * SPEED / 5000), abs=1e-3)
    assert abs(np.angle(gain)) < 1e-3


@pytest.mark.parametrize('effect', [AdditiveNoise(0.3, 'noise'), one('additive_noise', std=0.3)])
def test_noise_is_white_and_independent_between_channels(effect):
    component = Component('shaft', 4.0, (1.0, 1.0), (0.0, 0.0))
    quiet, noisy = (Gearbox((component,), 5000.0, effects=effects) for effects in ((), (effect,)))
    noise = noisy.vibration(0, 50_000) - quiet.vibration(0, 50_000)
    se = 1 / np.sqrt(50_000)
    np.testing.assert_allclose(np.std(noise, axis=1), 0.3, rtol=4 * se / np.sqrt(2))
    assert abs(np.corrcoef(noise)[0, 1]) < 4 * se
    assert max(abs(correlation(noise[0], lag)) for lag in (1, 2, 1024)) < 4 * se


def test_tone_has_its_amplitude_and_frequency():
    tone, none = machine(one('interfering_tone', frequency=612.5, amplitude=0.4)), machine()
    values = (tone.vibration(0, 50_000) - none.vibration(0, 50_000))[0]
    wave = np.exp(-2j * np.pi * 612.5 * np.arange(50_000) / 5000)
    assert abs(2 * np.mean(values * wave)) == pytest.approx(0.4, abs=1e-9)
    assert np.sqrt(2) * np.std(values) == pytest.approx(0.4, abs=1e-9)


# --- options ------------------------------------------------------------------------------------

def test_effects_of_size_zero_change_nothing():
    options = {
        'excess_jitter': {'std': 0.0}, 'correlated_jitter': {'std': 0.0, 'correlation': 0.5},
        'target_geometry': {'pulse_angles': (0.0,)}, 'clock_skew': {'skew': 0.0},
        'missing_pulses': {'probability': 0.0}, 'speed_fluctuation': {'acceleration_std': 0.0},
        'phase_wander': {'std': 0.0}, 'amplitude_modulation': {'std': 0.0},
        'additive_noise': {'std': 0.0}, 'interfering_tone': {'frequency': 1.0, 'amplitude': 0.0},
        'jitter_scale': {'scale': 1.0}, 'path_delay': {'delay': 0.0}}
    assert options.keys() == EFFECTS.keys() - {'keyphasor_quantisation', 'interpolation_loss'}
    with_them, without = machine(*make_effects(options)), machine()
    np.testing.assert_allclose(with_them.vibration(0, 5000), without.vibration(0, 5000),
                               rtol=0, atol=1e-12)
    np.testing.assert_allclose(with_them.pulses(0, 1).times, without.pulses(0, 1).times,
                               rtol=0, atol=1e-12)


@pytest.mark.parametrize(('options', 'message'), [
    ({'excess_jiter': {'std': 1.0}}, "no effect 'excess_jiter': choose from jitter_scale"),
    ({'excess_jitter': {'sdt': 1.0}}, 'effect excess_jitter has std and not sdt'),
    ({'excess_jitter': {'std': -1.0}}, 'excess_jitter.std -1.0: must be finite and at least 0'),
    ({'correlated_jitter': {'std': 1.0, 'correlation': 1.0}}, 'above -0.9999 and below 0.9999'),
    ({'keyphasor_quantisation': {'clock_rate': 0.0}}, 'clock_rate 0.0'),
    ({'keyphasor_quantisation': {'clock_rate': 1.0, 'period_std': -1.0}}, 'period_std -1.0'),
    ({'target_geometry': {'pulse_angles': ()}}, 'at least one finite angle'),
    ({'target_geometry': {'pulse_angles': (np.nan,)}}, 'at least one finite angle'),
    ({'clock_skew': {'skew': -1.0}}, 'skew -1.0'),
    ({'missing_pulses': {'probability': 1.0}}, 'probability 1.0'),
    ({'speed_fluctuation': {'acceleration_std': np.inf}}, 'acceleration_std inf'),
    ({'phase_wander': {'std': np.nan}}, 'std nan'),
    ({'phase_wander': {'std': 0.1, 'bandwidth': 0.5}}, 'bandwidth 0.5'),
    ({'amplitude_modulation': {'std': -0.1}}, 'std -0.1'),
    ({'amplitude_modulation': {'std': 0.1, 'bandwidth': 0.0}}, 'bandwidth 0.0'),
    ({'jitter_scale': {'scale': -1.0}}, 'jitter_scale.scale -1.0'),
    ({'path_delay': {'delay': np.nan}}, 'path_delay.delay nan'),
    ({'interpolation_loss': {'method': 'magic'}}, "'magic': must be one of linear, cubic, spline"),
    ({'additive_noise': {'std': -0.1}}, 'additive_noise.std -0.1'),
    ({'interfering_tone': {'frequency': 0.0, 'amplitude': 1.0}}, 'frequency 0.0'),
    ({'interfering_tone': {'frequency': 1.0, 'amplitude': -1.0}}, 'amplitude -1.0'),
])
def test_wrong_options_are_refused(options, message):
    with pytest.raises(ParameterError, match=message):
        make_effects(options)


@pytest.mark.parametrize(('options', 'message'), [
    ({'distribution': 'cauchy'}, "'cauchy': must be one of"),
    ({'distribution': 'normal', 'std': -1.0}, 'jitter std -1.0'),
    ({'distribution': 'table'}, 'give finite errors'),
])
def test_wrong_jitter_is_refused(options, message):
    with pytest.raises(ParameterError, match=message):
        DeclaredJitter(**options)
