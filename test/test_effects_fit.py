# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Fitted parameters lie within their stated standard errors, on drawn evidence."""

from dataclasses import replace
import math

import numpy as np
import pytest
from sa_jitter_ros.effects import EFFECTS, make_effect
from sa_jitter_ros.effects.band import (
    ACCELERATION_BAND, band_of_ripple, flat_band_correlation, recovered_correlation,
    ripple_of_acceleration, SLOW_BAND, slow_band)
from sa_jitter_ros.effects.common_gain import fit_common_gain
from sa_jitter_ros.effects.effect import beyond_chance, ODDS
from sa_jitter_ros.effects.evidence import Evidence, LineEvidence, root
from sa_jitter_ros.effects.lattice import Clock, find_clock
from sa_jitter_ros.prediction.influence import AveragePulses
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.prediction.prediction import predict
from scipy.linalg import toeplitz

pytestmark = pytest.mark.machines
MODEL = DeclaredModel(keyphasor_rate=5_000.0, trigger_speed=25.0, trigger_cycles=20,
                      orders=(8.0, 16.0), sample_rate=6_000.0)
ACQUISITIONS, PULSES = 12, 21
PERIOD = 0.04
NOISE = 1.5e-6
COSINE = np.cos(np.pi * (np.arange(512) + 0.5) / 512)
# Variance of a ripple that is fitted beside pulse errors, for noise of unit power over a cycle: at
# the frequency w (per cycle), that is the inverse of the mean square of u (1 - u) without its best
# fit by straight lines between the pulses.
RIPPLE_VARIANCE = np.mean(1.0 / (1.0 / 30.0 - (1.0 + COSINE) / (24.0 * (2.0 + COSINE))))


def evidence_of(rng, errors, *, moving=None, ripple=None, noise_density=None, radial=None,
                explained=(), speed=None, known=0.0):
    """
    Return evidence of pulse `errors` (acquisition, pulse) in s, recovered with some noise.

    `moving` is what of them the vibration does, not the pulses; `known` what is explained of the
    pulses; `speed` (acquisition, pulse) moves the true pulses (s).
    """
    count, pulses = errors.shape
    true = PERIOD * np.arange(count * (pulses - 1) + 1)
    rows = np.array([true[a * (pulses - 1):(a + 1) * (pulses - 1) + 1] for a in range(count)])
    late = errors + known - (0.0 if moving is None else moving)
    times = rows + late + (0.0 if speed is None else speed)
    seen = errors + rng.normal(0.0, NOISE, errors.shape)
    radial = np.zeros((count, pulses - 1, 4)) if radial is None else radial
    lines = LineEvidence(
        order=8.0 + np.arange(4), channel=np.zeros(4, int), level=np.ones(4),
        noise_density=np.zeros((count, 4)) if noise_density is None else noise_density,
        radial=radial, radial_noise=np.full(4, 0.01))
    return Evidence(
        model=MODEL, pulses=tuple(AveragePulses(row, a * (pulses - 1), row * 0.0)
                                  for a, row in enumerate(times)),
        errors=seen - seen.mean(axis=1, keepdims=True),
        standard_errors=np.full(errors.shape, NOISE),
        ripple=np.full((count, pulses - 1), np.nan) if ripple is None else ripple,
        record_times=times.ravel(),
        record_missing=np.zeros(times.size - 1, int), clock=Clock(5_000.0, 1e-9),
        lines=lines, explained=tuple(explained))


def declared(rng):
    """Return the declared jitter."""
    return rng.uniform(-1e-4, 1e-4, (ACQUISITIONS, PULSES))


def stationary(rng, covariance, draws=ACQUISITIONS):
    """Return normal rows (draw, pulse) of an autocovariance (lag,)."""
    matrix = toeplitz(covariance) + 1e-18 * np.eye(len(covariance))
    return rng.multivariate_normal(np.zeros(len(covariance)), matrix, draws, method='cholesky')


def check(z):
    """Mean and root mean square of z scores are those of chance, within 3.5 standard errors."""
    z = np.asarray(z)
    assert abs(z.mean()) < 3.5 / np.sqrt(z.size)
    assert abs(np.sqrt(np.mean(z**2)) - 1.0) < 3.5 / np.sqrt(2.0 * z.size)


def z_scores(findings, **truth):
    """Return (fitted - true) / standard error of each parameter."""
    return {name: [(item.effect.values[name] - value) / item.standard_errors[name]
                   for item in findings] for name, value in truth.items()}


LAGS = np.arange(PULSES)


def recovered(motion):
    """Return pulse errors and ripple that least squares fits to `motion` (time in cycles)."""
    steps = 16
    u = (np.arange(steps) + 0.5) / steps
    cycles = np.arange(PULSES - 1)
    design = np.zeros((PULSES - 1, steps, 3 * PULSES - 2))
    for k in cycles:  # hats, and a bump and a bend inside each cycle
        design[k, :, k], design[k, :, k + 1] = 1.0 - u, u
        design[k, :, PULSES + k] = u * (1.0 - u)
        design[k, :, 2 * PULSES - 1 + k] = u * (1.0 - u) * (2.0 * u - 1.0)
    values = motion((cycles[:, None] + u).ravel())
    fitted = np.linalg.lstsq(design.reshape(-1, 3 * PULSES - 2), values.T, rcond=None)[0].T
    return fitted[:, :PULSES], fitted[:, PULSES:2 * PULSES - 1]


def sines(rng, band, draws=ACQUISITIONS):
    """Return a normal motion with a flat spectrum in `band`, as a function of time in cycles."""
    waves = 30
    frequency = rng.uniform(*band, (draws, waves))
    a, b = rng.normal(0.0, 1.0 / np.sqrt(waves), (2, draws, waves))

    def motion(time, *, derivative=0):
        turns = 2.0 * np.pi * frequency[..., None] * time
        factor = (2.0 * np.pi * frequency[..., None]) ** -derivative
        return np.sum(factor * (a[..., None] * np.cos(turns) + b[..., None] * np.sin(turns)),
                      axis=1)
    return motion


def test_recovery_sees_a_motion_as_least_squares_does(rng):
    errors, _ = recovered(sines(rng, SLOW_BAND, 600))
    seen = np.mean(errors[:, 5:12] * errors[:, 8:9], axis=0)
    expected = recovered_correlation(np.arange(5, 12) - 8, SLOW_BAND)
    assert seen == pytest.approx(expected, abs=4.0 * np.sqrt(2.0 / 600.0))
    assert expected[3] == pytest.approx(0.993, abs=0.005)
    assert flat_band_correlation(0, SLOW_BAND) == pytest.approx(1.0)
    narrow = (0.1999, 0.2001)
    assert ripple_of_acceleration((1e-4, 2e-4)) == pytest.approx(0.5, rel=1e-6)
    _, ripple = recovered(sines(rng, narrow, 600))
    size = np.sqrt(np.mean(ripple[:, 10] ** 2)) / (2.0 * np.pi * 0.2) ** 2
    assert size == pytest.approx(ripple_of_acceleration(narrow), rel=4.0 / np.sqrt(1200.0))


@pytest.mark.parametrize('bandwidth', [0.1, 0.2, 0.35, 0.45])
def test_ripple_of_neighbours_tells_the_bandwidth_of_an_acceleration(rng, bandwidth):
    motion = sines(rng, slow_band(bandwidth, ACCELERATION_BAND), 600)
    _, ripple = recovered(lambda time: motion(time, derivative=2))
    product = np.mean(ripple[:, 5:12] * ripple[:, 6:13], axis=1)
    power = np.mean(ripple[:, 5:13] ** 2, axis=1)
    together = product.mean() / power.mean()
    error = np.std(product - together * power) / np.sqrt(600.0) / power.mean()
    low, high = band_of_ripple(together + 4.0 * error * np.array([1.0, -1.0]))
    assert low < bandwidth < high
    assert high - low < 0.1


def test_noise_is_fitted_within_its_error(rng):
    found = []
    for _ in range(60):
        power = rng.chisquare(9.0, (ACQUISITIONS, 4)) / 9.0
        found.append(EFFECTS['additive_noise'].fit(evidence_of(
            rng, declared(rng), noise_density=np.sqrt(power))))
    check(z_scores(found, std=1.0)['std'])
    quiet = EFFECTS['additive_noise'].fit(evidence_of(rng, declared(rng), noise_density=np.zeros(
        (ACQUISITIONS, 4))))
    assert quiet.effect is None


@pytest.mark.parametrize('resolution', [0.0, 1e-9])
def test_rate_of_a_clock_is_known_as_well_as_its_times_are_written(rng, resolution):
    off = []
    for _ in range(40):
        ticks = np.cumsum(rng.integers(195, 206, 400))
        rate = 5_000.0 * (1.0 + 1e-4 * rng.uniform(-1.0, 1.0))
        times = ticks / rate
        if resolution:
            times = np.rint(times / resolution) * resolution
        clock = find_clock(times)
        off.append((clock.rate - rate) / clock.standard_error)
    if resolution:
        check(off)
    else:  # rounding of the times is all that is left: a bound
        assert np.max(np.abs(off)) < 3.0


def test_root_of_a_variance_near_zero_is_uncertain_by_the_root_of_its_error():
    assert root(4.0, 0.04) == pytest.approx((2.0, 0.01), rel=3e-3)
    assert root(-1.0, 0.04) == (0.0, pytest.approx(0.2))
    assert root(1.0, 0.0) == (1.0, 0.0)


def test_modulation_is_found_in_few_acquisitions(rng):
    """Without one, lines do not move together: false alarms are as rare as the p value says."""
    def fit(std):
        gain = std * stationary(rng, flat_band_correlation(LAGS, SLOW_BAND), 3)[:, :-1, None]
        return EFFECTS['amplitude_modulation'].fit(evidence_of(
            rng, declared(rng)[:3], radial=gain + rng.normal(0.0, 0.01, (3, PULSES - 1, 4))))

    assert all(fit(0.05).effect is not None for _ in range(8))
    gains = np.array([fit(0.0).gain for _ in range(40)])
    assert np.all(gains < ODDS)
    assert np.mean(gains) < 0.0


@pytest.mark.parametrize('band', [(0.0, 0.4), (0.0, 0.05), (0.0, 0.005)])
def test_a_found_modulation_predicts_the_scatter_of_the_averages(rng, band):
    frequency = np.linspace(*band, 2000)
    cycles = np.cos(2.0 * np.pi * np.multiply.outer(LAGS, frequency)) * np.sinc(frequency) ** 2
    gain = 0.3 * stationary(rng, cycles.mean(axis=1) + 1e-9 * (LAGS == 0), 400)[:, :-1, None]
    finding = EFFECTS['amplitude_modulation'].fit(evidence_of(
        rng, np.zeros((400, PULSES)), radial=gain + rng.normal(0.0, 0.01, (400, PULSES - 1, 4))))
    again = make_effect('amplitude_modulation', **finding.effect.values)
    quiet = replace(MODEL, keyphasor_rate=1e12)
    seen = gain.mean(axis=1).std()
    assert predict(quiet, [again]).standard_deviation == pytest.approx(
        np.full(2, seen), rel=4.0 / np.sqrt(800.0))
    assert finding.effect.std == pytest.approx(0.3, abs=4.0 * finding.standard_errors['std'])
    found, error = finding.effect.bandwidth, finding.standard_errors['bandwidth']
    assert found == pytest.approx(band[1], abs=3.5 * error)
    assert 0.0 < error < 0.3 * band[1]


@pytest.mark.parametrize(('noise', 'acquisitions', 'cycles', 'unsteady'), [
    *((*case, unsteady) for unsteady in (0.0, 0.1) for case in (
        (np.full(12, 0.02), 12, 20), (np.array([0.01, 0.05, 0.05, 0.05]), 2, 20),
        (np.array([0.01, 0.02]), 3, 6))),
    (np.array([0.02]), 12, 20, 0.0)])
def test_orders_that_change_each_by_itself_have_no_common_gain(
        rng, noise, acquisitions, cycles, unsteady):
    """What chance gains in likelihood is about what the penalty takes it for, or less."""
    draws = 40
    slow = unsteady * stationary(rng, flat_band_correlation(np.arange(cycles), SLOW_BAND), (
        draws, acquisitions, noise.size)).swapaxes(2, 3)
    values = slow + noise * rng.standard_normal(slow.shape)
    found = [fit_common_gain(radial, noise) for radial in values]
    gains = [beyond_chance(item.likelihood, item.powers.size, acquisitions * cycles)
             for item in found]
    assert np.mean(gains) < 0.0
    assert np.mean(np.array(gains) > ODDS) < 0.01


def test_size_and_width_of_a_gain_are_as_wrong_as_their_errors_say(rng):
    """Of any width: one that is slower than an acquisition leaks into all frequencies of it."""
    off = []
    for _ in range(100):
        acquisitions, cycles, orders = rng.integers((10, 10, 2), (60, 40, 5))
        std, width = rng.uniform(0.05, 0.3), math.exp(rng.uniform(math.log(0.5 / cycles), -0.9))
        frequency = (np.arange(2000) + 0.5) / 2000.0 * width
        correlation = np.mean(np.sinc(frequency) ** 2 * np.cos(2.0 * np.pi * np.multiply.outer(
            np.arange(cycles), frequency)), axis=1)
        noise = rng.uniform(0.02, 0.1, orders)
        gain = std * stationary(rng, correlation + 1e-9 * np.eye(cycles)[0], acquisitions)
        found = fit_common_gain(gain[..., None] + noise * rng.standard_normal(
            (acquisitions, cycles, orders)), noise).size_and_width()
        off.append([(value - true) / error for (value, error), true in zip(found, (std, width))])
    assert np.abs(np.mean(off, axis=0)).max() < 0.3
    assert 0.65 < np.std(off, axis=0).min()
    assert np.std(off, axis=0).max() < 1.35


@pytest.mark.parametrize(('std', 'band'), [
    (0.0, (0.0, 0.1)), (0.05, (0.0, 0.1)), (0.05, (0.2, 0.3))])
def test_what_reaches_all_channels_is_a_modulation_if_it_is_slow(rng, std, band):
    """Noise and the lines of bearings reach all channels, which tell as much as one."""
    found = []
    for _ in range(60):
        gain = std * stationary(rng, flat_band_correlation(LAGS, band) + 1e-9 * (LAGS == 0), 12)
        noise = rng.normal(0.0, 0.03, (12, PULSES - 1, 1)) + rng.normal(
            0.0, 0.01, (12, PULSES - 1, 4))
        evidence = evidence_of(rng, declared(rng)[:12], radial=gain[:, :-1, None] + noise)
        finding = EFFECTS['amplitude_modulation'].fit(replace(evidence, lines=replace(
            evidence.lines, order=np.full(4, 8.0), channel=np.arange(4))))
        if finding.effect is not None:
            found.append((finding.effect.std - std) / finding.standard_errors['std'])
    if std and not band[0]:
        assert len(found) > 54
        assert abs(np.mean(found)) < 0.5
    else:
        assert not found


@pytest.mark.parametrize(('rate', 'found'), [(600.0, True), (520.0, False), (0.0, True)])
def test_one_order_at_the_end_of_the_band_tells_no_modulation_from_its_noise(rng, rate, found):
    """Noise that ends beside an order changes it slowly more than fast, as a gain does."""
    gain = 0.05 * stationary(rng, flat_band_correlation(LAGS, (0.0, 0.1)) + 1e-9 * (LAGS == 0), 12)
    radial = gain[:, :-1, None] + rng.normal(0.0, 0.01, (12, PULSES - 1, 4))
    evidence = evidence_of(rng, declared(rng)[:12], radial=radial)
    finding = EFFECTS['amplitude_modulation'].fit(replace(
        evidence, model=replace(MODEL, orders=(8.0,), sample_rate=rate), lines=replace(
            evidence.lines, order=np.full(4, 8.0), channel=np.arange(4))))
    assert (finding.effect is not None) == found


def test_a_modulation_has_the_size_that_shows_with_what_stands_beside_the_orders(rng):
    """Its fastest part passes for undeclared sources; they alone are none."""
    fast = stationary(rng, flat_band_correlation(LAGS, (0.0, 0.4)) + 1e-9 * (LAGS == 0), 24)
    gain = 0.05 * fast[:, :-1, None]
    noise = rng.normal(0.0, 0.01, (24, PULSES - 1, 4))
    evidence = evidence_of(rng, declared(rng)[:24], radial=0.5 * gain + noise)

    def found(evidence, **lines):
        return EFFECTS['amplitude_modulation'].fit(replace(
            evidence, lines=replace(evidence.lines, **lines)))

    assert found(evidence, with_sources=gain + noise).effect.std == pytest.approx(0.05, rel=0.1)
    assert found(evidence).effect.std == pytest.approx(0.025, rel=0.1)
    assert found(evidence, radial=noise, with_sources=gain + noise).effect is None
    one = {'order': np.full(4, 8.0), 'channel': np.arange(4)}
    slow = 0.05 * stationary(rng, flat_band_correlation(LAGS, (0.0, 0.1)) + 1e-9 * (LAGS == 0),
                             24)[:, :-1, None] + noise
    sizes = [found(evidence, radial=slow, with_sources=whole, **one).effect.std
             for whole in (None, noise - np.roll(noise, 1, axis=1))]
    assert sizes[0] == sizes[1] > 0.0


def test_orders_that_a_trigger_cycle_does_not_resolve_count_as_one(rng):
    lines = evidence_of(rng, np.zeros((3, 5))).lines
    for length, groups in ((1.0, 4), (0.9, 1), (1.0 / 3.0, 1), (2.0, 4)):
        evidence = evidence_of(rng, np.zeros((3, 5)))
        evidence = replace(evidence, model=replace(MODEL, ratio=length), lines=lines)
        radial, noise = evidence.of_orders(evidence.lines.radial)
        assert radial.shape == (3, 4, groups)
        assert noise == pytest.approx(np.full(groups, 0.01 / np.sqrt(4 / groups)))


def test_few_acquisitions_tell_no_noise_that_is_declared(rng):
    """Their own scatter is uncertain: Student's distribution."""
    model = replace(MODEL, noise_std=1.0)
    found = []
    for _ in range(2500):
        evidence = replace(evidence_of(rng, np.zeros((3, 5))), model=model)
        power = rng.chisquare(60.0, (3, 1)) / 60.0
        found.append(EFFECTS['additive_noise'].fit(replace(evidence, lines=replace(
            evidence.lines, noise_density=np.sqrt(power)))).effect is not None)
    assert np.mean(found) < 0.005
