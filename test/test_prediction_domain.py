# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
Predictions hold over their whole domain, from jitter that is hardly there to that of a cycle.

The reference, averages in double precision, is drawn by a benchmark that shares no formula with
the package (`benchmarks/prediction_domain.py`).
"""

from dataclasses import replace

from hypothesis import assume, given, settings, strategies as st
import numpy as np
from prediction_domain import compare, draw_setting, LAWS, LEVELS, Setting, WIDTHS
import pytest
import sa_jitter_ros as sa
from sa_jitter_ros.effects import make_effect
from sa_jitter_ros.prediction.angle_error import IndependentPulseJitter
from sa_jitter_ros.prediction.distributions import Empirical, Normal, Triangular, Uniform
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.prediction.moments import AverageMoments
from sa_jitter_ros.prediction.parts import Parts
from sa_jitter_ros.prediction.prediction import predict
from scipy.signal import lfilter

TABLES = st.one_of(
    st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=40),
    st.integers(1, 30).map(lambda n: [-1.0] * n + [1.0]),  # skewed, two values
    st.integers(0, 99).map(lambda seed: list(np.random.default_rng(seed).exponential(size=300))))


def logarithmic(low, high):
    return st.floats(np.log(low), np.log(high)).map(lambda x: float(np.exp(x)))


@st.composite
def anywhere(draw, most_cycles=1_000_000):
    """Draw any setting of the domain: errors from 1e-15 of a trigger cycle up to all of it."""
    distribution = draw(st.sampled_from([*WIDTHS, 'table']))
    speed, unit = draw(logarithmic(1.0, 200.0)), ()
    share = draw(logarithmic(1e-15, 0.99))
    if distribution == 'table':
        table = np.array(draw(TABLES))
        width = max(float(np.ptp(table)), 1e-3)
        unit = tuple(table - table.mean())
    else:
        width = WIDTHS[distribution]
    return Setting(speed, round(draw(logarithmic(1.0, most_cycles))), draw(logarithmic(1e-3, 1e5)),
                   draw(logarithmic(0.01, 100.0)), draw(st.sampled_from(LAWS)), distribution,
                   share / (width * speed), unit)


@pytest.mark.machines
@settings(max_examples=36, deadline=None)
@given(anywhere())
def test_moments_and_quantiles_are_in_order_everywhere(setting):
    prediction = setting.predict()
    mean, std = prediction.mean_attenuation[0], prediction.standard_deviation[0]
    square = prediction.moments.mean_square[0]
    digits = 1.0 + 1e-12
    assert abs(prediction.moments.mean[0]) <= mean * digits + 1e-12
    assert mean <= np.sqrt(square) * digits
    assert mean**2 + prediction.variance[0] == pytest.approx(square, rel=1e-6)
    assert std**2 == pytest.approx(prediction.variance[0])
    quantiles = prediction.ppf(np.linspace(0.01, 0.99, 25))[0]
    assert np.all(np.diff(quantiles) >= 0.0)
    assert 0.0 <= quantiles[0] <= quantiles[-1] <= digits + 6.0 * std


@pytest.mark.parametrize('seed', range(24))
def test_predictions_are_those_of_drawn_averages(seed):
    rng = np.random.default_rng([37, seed])
    setting, count = draw_setting(rng, most_cycles=60), 8000
    found = compare(setting, count, rng)
    assert not found.is_off(count), (setting, found)


@pytest.mark.machines
@pytest.mark.parametrize('seed', range(12))
def test_predictions_with_effects_are_those_of_drawn_averages(seed):
    """Pulses that remember each other, alternate or drift, of marks that are uneven."""
    rng = np.random.default_rng([39, seed])
    count, speed, order = 20_000, 20.0, 10.0
    cycles, marks = int(np.exp(rng.uniform(1.0, np.log(200)))), int(rng.choice([1, 4]))
    turn = np.exp(rng.uniform(np.log(0.05), np.log(2.0), 4)) / (2.0 * np.pi * order * speed)  # s
    memory = float(rng.choice([-0.8, -0.6, 0.3, 0.8]))
    angles = turn[2] * 2.0 * np.pi * speed * np.array([1.0, -0.5, 0.5, -1.0])
    effects = {
        'correlated_jitter': {'std': turn[0], 'correlation': memory},
        'excess_jitter': {'std': turn[1]},
        'target_geometry': {'pulse_angles': np.clip(angles, -0.6, 0.6).tolist()},
        'clock_skew': {'skew': min(turn[3] * speed / cycles, 5e-3)}}
    chosen = rng.permutation([name for name in effects if marks > 1 or 'target' not in name])[:2]
    shape = count, cycles + 1
    errors = 0.3 * turn[1] * np.sqrt(12.0) * rng.uniform(-0.5, 0.5, shape)
    white = rng.standard_normal(shape)
    if 'excess_jitter' in chosen:
        errors = errors + turn[1] * rng.standard_normal(shape)
    if 'correlated_jitter' in chosen:
        white[:, 1:] *= np.sqrt(1.0 - memory**2)
        errors = errors + turn[0] * lfilter([1.0], [1.0, -memory], white, axis=1)
    if 'target_geometry' in chosen:
        first = rng.integers(0, marks, (count, 1))
        errors = errors + np.clip(angles, -0.6, 0.6)[
            (first + np.arange(cycles + 1)) % marks] / (2.0 * np.pi * speed)
    if 'clock_skew' in chosen:
        errors = errors + effects['clock_skew']['skew'] * np.arange(cycles + 1) / (marks * speed)
    found = sa.predict(
        keyphasor_rate=1.0 / (0.3 * turn[1] * np.sqrt(12.0)), trigger_speed=speed, orders=[order],
        trigger_cycles=cycles, pulses_per_revolution=marks, pulses_per_trigger=1,
        effects={name: effects[name] for name in chosen})
    angle = np.pi * order * speed * errors
    amplitude = np.abs(np.mean(np.exp(1j * (angle[:, 1:] + angle[:, :-1])) * np.sinc(
        np.diff(angle, axis=1) / np.pi), axis=1))
    assert found.mean_attenuation[0] == pytest.approx(
        amplitude.mean(), abs=5.0 * amplitude.std() / np.sqrt(count) + 0.02 * amplitude.std())
    assert found.standard_deviation[0] == pytest.approx(amplitude.std(), rel=0.05)
    ranks = [np.mean(amplitude <= getattr(found, f'quantile_{q}')[0]) for q in ('05', '50', '95')]
    np.testing.assert_allclose(ranks, [0.05, 0.5, 0.95], atol=0.018)


@pytest.mark.machines
@pytest.mark.parametrize(('effects', 'cycles'), [
    ({'correlated_jitter': {'std': 8e-5, 'correlation': -0.7}}, 50),
    ({'correlated_jitter': {'std': 6e-5, 'correlation': -0.7}}, 140),
    ({'correlated_jitter': {'std': 2.6e-4, 'correlation': 0.9}}, 200),
    ({'clock_skew': {'skew': 4.5e-4}}, 41)])
def test_quantiles_of_pulses_that_are_not_independent_have_their_ranks(effects, cycles, rng):
    skew = effects.get('clock_skew', {'skew': 0.0})['skew']
    values = effects.get('correlated_jitter', {'std': 0.0, 'correlation': 0.0})
    found = sa.predict(keyphasor_rate=5e3, trigger_speed=20.0, orders=[50.0], effects=effects,
                       trigger_cycles=cycles)
    white = rng.standard_normal((20_000, cycles + 1))
    white[:, 1:] *= np.sqrt(1.0 - values['correlation']**2)
    errors = (values['std'] * lfilter([1.0], [1.0, -values['correlation']], white, axis=1)
              + rng.uniform(-1e-4, 1e-4, white.shape) + skew * np.arange(cycles + 1) / 20.0)
    turns = 1e3 * errors
    amplitude = np.abs(np.mean(np.exp(1j * np.pi * (turns[:, 1:] + turns[:, :-1]))
                               * np.sinc(np.diff(turns, axis=1)), axis=1))
    share = np.array([0.05, 0.5, 0.95])
    ranks = np.mean(amplitude[:, None] <= found.ppf(share)[0], axis=0)
    np.testing.assert_allclose(ranks, share, atol=0.01)


@pytest.mark.parametrize('values', [
    {'cycles': 9, 'order': 1.0, 'std': 1.0 / (np.sqrt(12.0) * 20e3)},
    {'cycles': 20, 'std': 1.0 / (np.sqrt(12.0) * 1e6), 'speed': 25.0},
    {'cycles': 12, 'distribution': 'normal', 'std': 1.0 / (16.0 * np.pi), 'order': 4.0},
    {'cycles': 12, 'law': 'spline', 'distribution': 'table', 'std': 1e-3,
     'unit': tuple(np.random.default_rng(12).exponential(size=400) - 1.0)},
    {'cycles': 1, 'law': 'quadratic', 'distribution': 'normal', 'std': 1e-9}])
def test_what_was_drawn_or_subtracted_near_a_limit_is_right(values, rng):
    setting = replace(Setting(2.0, 9, 1.0, 1.0, 'linear', 'uniform', 1e-5), **values)
    found = compare(setting, 60_000, rng)
    assert not found.is_off(60_000), found


def test_single_cycles_are_as_a_quadrature_says():
    """The amplitude of one cycle is abs(sinc) of the difference of two errors."""
    for width in (1e-6, 1e-3, 0.3, 1.0, 3.0):
        prediction = sa.predict(keyphasor_rate=1.0 / width, trigger_speed=1e-3, ratio=1e3,
                                trigger_cycles=1, orders=[1.0])
        apart = (np.arange(200_000) + 0.5) / 200_000
        weight = 2.0 * (1.0 - apart) / apart.size  # difference of two uniform errors
        phase = np.pi * width * apart
        less = np.where(phase < 1e-3, phase**2 / 6.0, 1.0 - np.abs(np.sin(phase)) / phase)
        mean = weight @ less
        std = np.sqrt(weight @ (less - mean) ** 2)
        assert 1.0 - prediction.mean_attenuation[0] == pytest.approx(mean, abs=0.01 * std + 1e-15)
        assert prediction.standard_deviation[0] == pytest.approx(std, rel=0.01)


@pytest.mark.machines
@settings(max_examples=9, deadline=None)
@given(anywhere(most_cycles=1000), logarithmic(1e-9, 1e-3))
def test_without_jitter_nothing_is_lost(setting, factor):
    """Mean and standard deviation go to their limits as the square of the errors."""
    assume(0.0 < setting.turn * (max(map(abs, setting.unit)) if setting.unit else 1.0))
    one = replace(setting, std=setting.std * 1e-3 / setting.turn)
    assume(one.std * (np.ptp(one.unit) if one.unit else 8.0) * one.speed < 0.9)
    less = replace(one, std=factor * one.std)
    near, nearer = one.predict(), less.predict()
    assert abs(nearer.mean_attenuation[0] - 1.0) <= 1e-6
    np.testing.assert_allclose(nearer.standard_deviation, factor**2 * near.standard_deviation,
                               rtol=2e-3)
    np.testing.assert_allclose(nearer.moments.variance, factor**2 * near.moments.variance,
                               rtol=1e-3)


@settings(max_examples=30, deadline=None)
@given(logarithmic(1e-6, 3.0), st.floats(1.01, 3.0), st.integers(200, 1_000_000))
def test_more_normal_jitter_is_never_a_larger_mean(turn, factor, cycles):
    def mean(size):
        return replace(Setting(1e-3, cycles, 1.0, 1e3, 'linear', 'normal', 1.0),
                       std=size / (2.0 * np.pi)).predict().mean_attenuation[0]
    assert mean(factor * turn) <= mean(turn) * (1.0 + 1e-12)


@settings(max_examples=20, deadline=None)
@given(anywhere())
def test_many_cycles_leave_the_mean_phasor(setting):
    prediction = replace(setting, cycles=1_000_000).predict()
    scatter = np.sqrt(prediction.moments.variance[0])
    assert scatter <= 2e-3  # 17 pulses of a law at most act together
    assert prediction.mean_attenuation[0] == pytest.approx(
        abs(prediction.moments.mean[0]), abs=scatter + 1e-12)


NOTHING = {
    'excess_jitter': 'std', 'correlated_jitter': 'std', 'phase_wander': 'std',
    'speed_fluctuation': 'acceleration_std', 'clock_skew': 'skew', 'additive_noise': 'std',
    'amplitude_modulation': 'std', 'interfering_tone': 'amplitude', 'path_delay': 'delay',
    'missing_pulses': 'probability'}


@pytest.mark.machines
@settings(max_examples=25, deadline=None)
@given(st.sampled_from(sorted(NOTHING)), st.sampled_from([0.0, 1e-18, 1e-13]),
       st.sampled_from([1, 5, 12, 40]), logarithmic(1e3, 1e9))
def test_effects_of_no_size_change_nothing(name, size, cycles, rate):
    model = DeclaredModel(keyphasor_rate=rate, trigger_speed=20.0, trigger_cycles=cycles,
                          orders=(1.0, 40.0), sample_rate=1e4)
    alone = predict(model)
    beside = predict(model, [make_effect(name, **{NOTHING[name]: size})])
    # 8192 draws, of which controls explain all but 0.2 standard deviations
    error = 0.2 / np.sqrt(8192.0) * alone.standard_deviation
    assert np.all(np.abs(beside.mean_attenuation - alone.mean_attenuation) <= 3.0 * error + 1e-8)
    # other draws, and what rounding leaves of two numbers that hardly differ
    np.testing.assert_allclose(beside.standard_deviation, alone.standard_deviation, rtol=0.05,
                               atol=1e-7 + 40.0 * np.sqrt(cycles * size))


@pytest.mark.parametrize('distribution', [
    Uniform(2.0), Normal(0.5), Triangular(0.5), Empirical(np.array([-1.0, -1.0, 3.0]))])
def test_quantiles_of_pulse_errors_are_those_of_draws(distribution, rng):
    drawn = np.sort(distribution.draw(rng, 40_000))
    levels = np.array([0.01, 0.3, 0.5, 0.8, 0.99])
    at = distribution.quantile(levels)
    error = 4.5 * np.sqrt(levels * (1.0 - levels) / drawn.size)
    assert np.all(np.searchsorted(drawn, at - 1e-9) / drawn.size <= levels + error)
    assert np.all(np.searchsorted(drawn, at + 1e-9) / drawn.size >= levels - error)
    jitter = IndependentPulseJitter(distribution, 2.0)
    np.testing.assert_allclose(jitter.pulses_at(levels), 2.0 * at)


def test_parts_are_those_of_drawn_amplitudes(rng):
    """Cumulants along and across follow shifts, gains and noise as those of draws do."""
    r, i = rng.exponential(size=(2, 300_000)) - 1.0
    x = 0.8 + 0.3 * r + 1j * (0.2 * i + 0.1 * r)

    def cumulants(values, base):
        off = (values - base) * np.conj(base) / abs(base)
        r, i = off.real - off.real.mean(), off.imag - off.imag.mean()
        return [off.real.mean(), off.imag.mean(), *(np.mean(item) for item in (
            r * r, r * i, i * i, r**3, r * r * i, r * i * i, i**3))]

    def parts(values, base):
        off = values - values.mean()
        moments = AverageMoments(*(np.array([item]) for item in (
            values.mean(), np.mean(np.abs(off) ** 2), np.mean(off**2))))
        return Parts.about(base, moments, np.mean(off**3), np.mean(off**2 * off.conj()))

    def numbers(item):
        return [value[0] for value in list(vars(item).values())[1:]]

    found = parts(x, 1.0)
    np.testing.assert_allclose(numbers(found), cumulants(x, 1.0), atol=1e-9)
    np.testing.assert_allclose(numbers(found.shifted(0.2 - 0.7j)),
                               cumulants(x + 0.2 - 0.7j, 1.2 - 0.7j), atol=1e-9)
    np.testing.assert_allclose(numbers(found.scaled(0.5j)), cumulants(0.5j * x, 0.5j), atol=1e-9)
    np.testing.assert_allclose(numbers(found.centred()), cumulants(x, x.mean()), atol=1e-9)
    np.testing.assert_allclose(
        np.subtract(numbers(found.with_noise(0.2)), numbers(found)),
        [0.0, 0.0, 0.1, 0.0, 0.1, 0.0, 0.0, 0.0, 0.0], atol=1e-12)
    assert found.moments.mean[0] == pytest.approx(x.mean())


def test_levels_are_those_that_a_prediction_has():
    assert LEVELS == sa.prediction.prediction.QUANTILES
