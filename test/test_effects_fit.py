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
from functools import partial

import numpy as np
import pytest
from sa_jitter_ros.effects import EFFECTS, make_effect
from sa_jitter_ros.effects.amplitude_modulation import _chance
from sa_jitter_ros.effects.band import (
    ACCELERATION_BAND, flat_band_correlation, recovered_correlation, ripple_of_acceleration,
    SLOW_BAND)
from sa_jitter_ros.effects.evidence import Evidence, LineEvidence, root
from sa_jitter_ros.effects.lattice import Clock, find_clock
from sa_jitter_ros.effects.pulse_covariance import (
    _distribution_p_value, fit_covariance, log_likelihood, white)
from sa_jitter_ros.effects.slope_test import slope_test
from sa_jitter_ros.prediction.influence import Pulses
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.prediction.prediction import predict
from scipy.linalg import toeplitz
from scipy.signal import lfilter

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


def evidence_of(rng, errors, *, moving=None, ripple=None, ripple_error=1e-7, noise_density=None,
                radial=None, explained=(), speed=None, known=0.0):
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
        order=np.full(4, 8.0), channel=np.arange(4), level=np.ones(4),
        noise_density=np.zeros((count, 4)) if noise_density is None else noise_density,
        radial=radial, radial_noise=np.full(4, 0.01))
    return Evidence(
        model=MODEL, pulses=tuple(Pulses(row, a * (pulses - 1), row * 0.0)
                                  for a, row in enumerate(times)),
        errors=seen - seen.mean(axis=1, keepdims=True),
        standard_errors=np.full(errors.shape, NOISE),
        ripple=np.full((count, pulses - 1), np.nan) if ripple is None else ripple,
        ripple_standard_error=ripple_error, against_reference=False, record_times=times.ravel(),
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


@pytest.mark.parametrize(('name', 'truth', 'covariance'), [
    ('excess_jitter', {'std': 60e-6}, np.where(LAGS == 0, 60e-6**2, 0.0)),
    ('excess_jitter', {'std': 120e-6}, np.where(LAGS == 0, 120e-6**2, 0.0)),
    ('correlated_jitter', {'std': 100e-6, 'correlation': 0.7}, 1e-8 * 0.7**LAGS),
    ('correlated_jitter', {'std': 100e-6, 'correlation': -0.6}, 1e-8 * (-0.6)**LAGS),
])
def test_pulse_errors_are_fitted_within_their_errors(rng, name, truth, covariance):
    found = [EFFECTS[name].fit(evidence_of(rng, declared(rng) + stationary(rng, covariance)))
             for _ in range(30)]
    assert all(item.effect is not None for item in found)
    for z in z_scores(found, **truth).values():
        check(z)


def test_uniform_jitter_tells_more_of_its_variance_than_normal_one(rng):
    found = [EFFECTS['excess_jitter'].fit(evidence_of(
        rng, declared(rng) + rng.normal(0.0, 60e-6, (ACQUISITIONS, PULSES)))) for _ in range(4)]
    stated = np.mean([item.standard_errors['std'] for item in found])
    # of the whole variance, whose fourth cumulant is that of the uniform part
    total, uniform = 60e-6**2 + 1e-8 / 3.0, 1e-8 / 3.0
    expected = np.sqrt((2.0 * total**2 - 1.2 * uniform**2) / (ACQUISITIONS * (PULSES - 1)))
    assert stated == pytest.approx(expected / (2.0 * 60e-6), rel=0.1)


def recovered(motion):
    """Return pulse errors and ripple that least squares fits to `motion` (time in cycles)."""
    steps = 16
    u = (np.arange(steps) + 0.5) / steps
    cycles = np.arange(PULSES - 1)
    design = np.zeros((PULSES - 1, steps, 2 * PULSES - 1))
    for k in cycles:  # hats, and a bump inside each cycle
        design[k, :, k], design[k, :, k + 1] = 1.0 - u, u
        design[k, :, PULSES + k] = u * (1.0 - u)
    values = motion((cycles[:, None] + u).ravel())
    fitted = np.linalg.lstsq(design.reshape(-1, 2 * PULSES - 1), values.T, rcond=None)[0].T
    return fitted[:, :PULSES], fitted[:, PULSES:]


def sines(rng, band, draws=ACQUISITIONS):
    """Return a normal motion with a flat spectrum in `band`, as a function of time in cycles."""
    frequency = rng.uniform(*band, (draws, 60))
    a, b = rng.normal(0.0, 1.0 / np.sqrt(60.0), (2, draws, 60))

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
    assert expected[3] == pytest.approx(1.06, abs=0.005)
    assert flat_band_correlation(0, SLOW_BAND) == pytest.approx(1.0)
    narrow = (0.1999, 0.2001)
    assert ripple_of_acceleration((1e-4, 2e-4)) == pytest.approx(0.5, rel=1e-6)
    _, ripple = recovered(sines(rng, narrow, 600))
    size = np.sqrt(np.mean(ripple[:, 10] ** 2)) / (2.0 * np.pi * 0.2) ** 2
    assert size == pytest.approx(ripple_of_acceleration(narrow), rel=4.0 / np.sqrt(1200.0))


@pytest.mark.parametrize('bandwidth', [0.2, SLOW_BAND[1]])
def test_wander_is_fitted_within_its_error(rng, bandwidth):
    found = []
    for _ in range(30):
        moving = 1e-4 * recovered(sines(rng, (SLOW_BAND[0], bandwidth)))[0]
        found.append(EFFECTS['phase_wander'].fit(evidence_of(
            rng, declared(rng) + moving, moving=moving)))
    off = z_scores(found, std=1e-4 * 2.0 * np.pi * 25.0, bandwidth=bandwidth)
    check(off['std'])
    assert abs(np.mean(off['bandwidth'])) < 3.5 / np.sqrt(30)


@pytest.mark.parametrize(('top', 'memory'), [
    (0.15, 0.0), (SLOW_BAND[1], 0.0), (0.0, 0.0), (0.0, 0.8)])
def test_tach_or_source_is_decided_by_the_standard_error(rng, top, memory):
    """Motions of the source up to `top`, or pulse errors of a memory: shares of 1 and 0."""
    off = []
    for _ in range(40):
        moving = (1e-4 * recovered(sines(rng, (0.0, top)))[0] if top
                  else np.zeros((ACQUISITIONS, PULSES)))
        late = 0.0 if top else stationary(rng, (8e-5) ** 2 * memory**LAGS)
        test = slope_test(evidence_of(rng, declared(rng) + moving + late, moving=moving))
        assert test.decided
        assert test.tach_side == (top == 0.0)
        off.append((test.share - (top > 0.0)) / test.standard_error)
    # What is declared is separated from the rest by the spectrum of a few acquisitions, which
    # errs by some standard errors on the side of the tach.
    assert abs(np.mean(off)) < 1.5
    assert np.std(off) < 1.5


def test_all_acquisitions_tell_the_effect_and_half_of_them_its_size(rng):
    """All acquisitions decide whether there is a memory; it is fitted to the first."""
    hits = []
    for _ in range(15):
        errors = declared(rng) + stationary(rng, 1e-8 * 0.5**LAGS)
        few = evidence_of(rng, errors[:4])
        found = EFFECTS['correlated_jitter'].fit(replace(few, whole=evidence_of(rng, errors)))
        hits.append(found.effect is not None)
        if found.effect is not None:
            few_only = EFFECTS['correlated_jitter'].fit(replace(few, errors=few.errors))
            assert few_only.effect is None or few_only.effect == found.effect
    assert sum(hits) >= 13


def test_acceleration_is_fitted_within_its_error(rng):
    std = 80.0 / (2.0 * np.pi) * PERIOD**3  # s per cycle^2
    found = []
    for _ in range(40):
        motion = sines(rng, ACCELERATION_BAND)
        errors, bump = (std * item for item in recovered(partial(motion, derivative=2)))
        true = std * motion(np.arange(float(PULSES)), derivative=2)
        found.append(EFFECTS['speed_fluctuation'].fit(evidence_of(
            rng, declared(rng) + errors - true, ripple=bump + rng.normal(0.0, 1e-5, bump.shape),
            ripple_error=1e-5, speed=-true)))
    check(z_scores(found, acceleration_std=80.0)['acceleration_std'])


def test_acceleration_is_fitted_where_no_pulse_lacks(rng):
    """An acquisition whose ripple is unknown takes nothing from the others."""
    motion = sines(rng, ACCELERATION_BAND)
    true = 3e-4 * motion(np.arange(float(PULSES)), derivative=2)
    errors, bump = (3e-4 * item for item in recovered(partial(motion, derivative=2)))
    evidence = evidence_of(rng, declared(rng) + errors - true, ripple=bump, speed=-true)
    ripple = bump.copy()
    ripple[4] = np.nan
    kept = np.delete(np.arange(ACQUISITIONS), 4)
    gap, without = (EFFECTS['speed_fluctuation'].fit(item) for item in (
        replace(evidence, ripple=ripple),
        replace(evidence, ripple=bump[kept], errors=evidence.errors[kept],
                pulses=tuple(evidence.pulses[a] for a in kept))))
    assert gap.effect == without.effect is not None


def test_noise_that_ripple_and_errors_share_is_no_acceleration(rng):
    """Both are fitted to the same vibration, whose noise moves them against each other."""
    points, draws, std = 64, 100, 3e-5
    u = (np.arange(points) + 0.5) / points
    lines = np.kron(np.eye(PULSES - 1, PULSES), 1.0 - u[:, None]) + np.kron(
        np.eye(PULSES - 1, PULSES, 1), u[:, None])
    fit = np.linalg.pinv(np.hstack((lines, np.kron(np.eye(PULSES - 1), (u * (1.0 - u))[:, None]))))
    p_values, power = [], []
    for _ in range(draws):
        both = std * rng.standard_normal((ACQUISITIONS, len(lines))) @ fit.T
        errors, ripple = both[:, :PULSES], both[:, PULSES:]
        power.append(np.mean(ripple[:, 1:-1] ** 2))
        true = 1e-6 * rng.standard_normal(errors.shape)  # the speed is not quite steady
        evidence = evidence_of(rng, declared(rng), ripple=ripple, speed=true,
                               ripple_error=std * np.sqrt(RIPPLE_VARIANCE / points))
        p_values.append(EFFECTS['speed_fluctuation'].fit(replace(
            evidence, errors=evidence.errors + errors)).p_value)
    # one in ten cycles is next to an outer one, which the ends leave a little rougher
    assert np.mean(power) == pytest.approx(std**2 * RIPPLE_VARIANCE / points, rel=0.05)
    assert abs(np.mean(p_values) - 0.5) < 4.0 / np.sqrt(12.0 * draws)


def test_wandering_source_is_no_acceleration(rng):
    """The ripple follows the errors in both cases, the pulses only in one."""
    errors, bump = (3e-4 * item for item in recovered(sines(rng, ACCELERATION_BAND)))
    found = EFFECTS['speed_fluctuation'].fit(evidence_of(
        rng, declared(rng) + errors, moving=errors,
        ripple=bump + rng.normal(0.0, 1e-6, bump.shape), ripple_error=1e-6))
    assert 'the source moves' in found.contradiction


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


def test_period_of_a_clock_is_fitted_within_its_error(rng):
    off = []
    for _ in range(40):
        # many acquisitions: a standard error that follows from their scatter is itself uncertain
        speed = np.cumsum(stationary(rng, 16e-12 * 0.5**LAGS, 6 * ACQUISITIONS), axis=1)
        grid = rng.uniform(-1e-4, 1e-4, speed.shape)
        evidence = evidence_of(rng, grid, speed=speed)
        evidence = replace(evidence, pulses=tuple(
            replace(item, errors=row) for item, row in zip(evidence.pulses, grid)))
        found = EFFECTS['keyphasor_quantisation'].fit(evidence)
        off.append((found.effect.period_std - 4e-6) / found.standard_errors['period_std'])
    check(off)


def test_errors_much_larger_than_ticks_are_not_those_of_the_clock(rng):
    """Times on a grid tell half a tick at most; what errs more than they tell is jitter."""
    grid = rng.uniform(-1e-4, 1e-4, (ACQUISITIONS, PULSES))
    for size, there in ((0.0, True), (1e-4, False)):
        errors = grid + size * np.sign(grid)  # in step with the ticks
        evidence = evidence_of(rng, errors)
        evidence = replace(evidence, pulses=tuple(
            replace(item, errors=row) for item, row in zip(evidence.pulses, grid)))
        assert (EFFECTS['keyphasor_quantisation'].fit(evidence).effect is not None) == there


def test_what_is_known_of_the_pulses_is_no_slope(rng):
    """Marks that were explained are in the measured times and not in the errors that are left."""
    angles = (0.03, -0.02, 0.01, -0.02)
    geometry = make_effect('target_geometry', pulse_angles=angles)
    index = np.add.outer(20 * np.arange(ACQUISITIONS), LAGS)
    known = np.array(angles)[index % 4] / (2.0 * np.pi * MODEL.trigger_speed)
    jitter = declared(rng) + rng.normal(0.0, 60e-6, known.shape)
    test = slope_test(evidence_of(rng, jitter, known=known, explained=[geometry]))
    assert test.decided
    assert test.tach_side
    assert abs(test.share) < 4.0 * test.standard_error + 0.01


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


def test_independent_errors_beside_a_wander_do_not_swell_it(rng):
    """Once the wander is explained, what the pulses do as well is theirs."""
    found = []
    for _ in range(20):
        moving = 2e-4 * recovered(sines(rng, SLOW_BAND))[0]
        evidence = evidence_of(
            rng, declared(rng) + moving + rng.normal(0.0, 8e-5, moving.shape), moving=moving)
        found.append(EFFECTS['phase_wander'].fit(evidence))
    off = z_scores(found, std=2e-4 * 2.0 * np.pi * 25.0)['std']
    assert np.mean(off) < 3.5 / np.sqrt(len(off))
    wander = make_effect('phase_wander', std=2e-4 * 2.0 * np.pi * 25.0)
    assert not slope_test(evidence).tach_side
    assert slope_test(evidence).p_value < 1e-6
    assert slope_test(replace(evidence, explained=(wander,))).p_value > 1e-3


def test_few_pulses_find_a_memory_or_leave_it_open(rng):
    """A memory that three acquisitions do not prove is named beside independent errors."""
    hits = []
    for _ in range(15):
        evidence = evidence_of(rng, declared(rng)[:3] + stationary(rng, 1e-8 * 0.7**LAGS, 3))
        independent = EFFECTS['excess_jitter'].fit(evidence)
        assert bool(independent.indistinguishable_from) == bool(independent.deciding_measurement)
        hits.append(EFFECTS['correlated_jitter'].fit(evidence).effect is not None
                    or 'correlated_jitter' in independent.indistinguishable_from)
    assert sum(hits) >= 13
    independent = [EFFECTS['excess_jitter'].fit(evidence_of(
        rng, declared(rng) + rng.normal(0.0, 60e-6, (ACQUISITIONS, PULSES)))) for _ in range(15)]
    assert sum(bool(item.indistinguishable_from) for item in independent) <= 4  # 5 % by chance


def test_rare_shocks_that_fade_are_no_correlated_jitter(rng):
    """A sensor that is late after drop-outs remembers, too, but its innovations are shocks."""
    def against(errors):
        found = EFFECTS['correlated_jitter'].fit(evidence_of(rng, 0.1 * declared(rng) + errors))
        assert found.effect is not None
        return found.contradiction

    def shocks():
        size = ACQUISITIONS * PULSES + 50
        late = 3e-4 * (rng.uniform(size=size) < 0.05) * rng.uniform(0.5, 1.5, size)
        return lfilter([1.0], [1.0, -0.7], late)[50:].reshape(ACQUISITIONS, PULSES)

    found = [against(shocks()) for _ in range(15)]
    assert all(found)
    assert sum('distribution' in text for text in found) >= 8  # some are a memory, a line
    normal = [against(stationary(rng, 1e-8 * 0.7**LAGS)) for _ in range(60)]
    assert sum('distribution' in text for text in normal) <= 1


def test_modulation_is_found_in_few_acquisitions(rng):
    """Without one, lines do not move together: false alarms are as rare as the p value says."""
    def fit(std):
        gain = std * stationary(rng, flat_band_correlation(LAGS, SLOW_BAND), 3)[:, :-1, None]
        return EFFECTS['amplitude_modulation'].fit(evidence_of(
            rng, declared(rng)[:3], radial=gain + rng.normal(0.0, 0.01, (3, PULSES - 1, 4))))

    assert all(fit(0.05).effect is not None for _ in range(20))
    p_values = [fit(0.0).p_value for _ in range(200)]
    assert abs(np.mean(p_values) - 0.5) < 4.0 / np.sqrt(12.0 * 200.0)


@pytest.mark.parametrize('band', [(0.02, 0.4), (0.0, 0.05), (0.0, 0.005)])
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
    if band[0] == 0.02:  # the form of the spectrum is that of the model
        assert found == pytest.approx(band[1], abs=3.5 * error)
        assert 0.0 < error < 0.1


def test_likelihood_prefers_what_is_there(rng):
    excess = make_effect('excess_jitter', std=60e-6)
    quiet = evidence_of(rng, declared(rng))
    noisy = evidence_of(rng, declared(rng) + rng.normal(0.0, 60e-6, (ACQUISITIONS, PULSES)))
    for evidence, better in ((quiet, -1.0), (noisy, 1.0)):
        gain = log_likelihood(replace(evidence, explained=(excess,))) - log_likelihood(evidence)
        assert better * gain > 7.0


def test_distribution_of_errors_beside_a_clock_is_without_the_declared_jitter(rng):
    """The clock takes the place of the uniform jitter: what is left is normal."""
    clock = make_effect('keyphasor_quantisation', clock_rate=5_000.0)
    slow = make_effect('correlated_jitter', std=60e-6, correlation=0.8)
    p_values = []
    for _ in range(15):
        errors = stationary(rng, 60e-6**2 * 0.8**LAGS, 120) + rng.normal(0.0, 4e-5, (120, PULSES))
        evidence = evidence_of(rng, errors, explained=(clock, slow))
        p_values.append(_distribution_p_value(evidence, fit_covariance(evidence, white)))
    bare = replace(MODEL, jitter_distribution='table', jitter_table=(0.0,))
    same = replace(evidence, model=bare, explained=(slow,))
    assert p_values[-1] == pytest.approx(
        _distribution_p_value(same, fit_covariance(same, white)), rel=0.1)
    assert np.median(p_values) > 0.01


@pytest.mark.parametrize(('noise', 'acquisitions', 'cycles'), [
    (np.full(12, 0.02), 12, 20), (np.array([0.01, 0.05, 0.05, 0.05]), 2, 20),
    (np.array([0.01, 0.02]), 3, 6)])
def test_chance_of_a_modulation_is_as_rare_as_stated(rng, noise, acquisitions, cycles):
    draws = 10_000
    weight = noise**-2.0 / np.sum(noise**-2.0)
    values = rng.standard_normal((draws, acquisitions * cycles, noise.size)) * np.sqrt(weight)
    means = np.mean(values.sum(axis=2) ** 2 - np.sum(values**2, axis=2), axis=1)
    p_values = np.array([_chance(mean, weight, acquisitions * cycles) for mean in means])
    for level in (1e-3, 1e-2, 0.5):
        rate = np.mean(p_values < level)
        assert abs(rate - level) < 4.0 * np.sqrt(level / p_values.size)


def test_few_acquisitions_tell_no_noise_that_is_declared(rng):
    """Their own scatter is uncertain: Student's distribution."""
    model = replace(MODEL, noise_std=1.0)
    p_values = []
    for _ in range(4000):
        evidence = replace(evidence_of(rng, np.zeros((3, 5))), model=model)
        power = rng.chisquare(60.0, (3, 1)) / 60.0
        p_values.append(EFFECTS['additive_noise'].fit(replace(evidence, lines=replace(
            evidence.lines, noise_density=np.sqrt(power)))).p_value)
    assert np.mean(np.array(p_values) < 0.01) < 0.01 + 4.0 * np.sqrt(0.01 / len(p_values))
