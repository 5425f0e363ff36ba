# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""What the loop scores with is what the predictor publishes, conditional on known pulses."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from sa_jitter_ros.effects import make_effect
from sa_jitter_ros.inference.expectation import (
    _leakage, _sharpening, expect, Lines, RESOLUTION)
from sa_jitter_ros.inference.observation import Acquisition, Observation
from sa_jitter_ros.inference.record_pulses import RecordPulses
from sa_jitter_ros.prediction.angle_error import IndependentPulseJitter, unit_nodes
from sa_jitter_ros.prediction.distributions import Normal
from sa_jitter_ros.prediction.influence import AveragePulses, Influence, random_processes
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.prediction.prediction import predict
from sa_jitter_ros.pulses.angle_law import angle_law
from scipy import stats
from validation.monte_carlo import AveragedSignal

ORDERS = (19.0, 38.0, 57.0)
MODEL = DeclaredModel(
    keyphasor_rate=5000.0, trigger_speed=16.6, trigger_cycles=40, orders=ORDERS, ratio=2.0,
    noise_std=0.5, sample_rate=20_000.0)  # lines of the trigger cycle: no mirror image leaks
LINES = Lines(np.arange(3), np.arange(3))
LEVELS = np.linspace(0.02, 0.98, 49)
EFFECTS = {
    'declared jitter alone': {},
    'random pulse errors': {'excess_jitter': {'std': 4e-5}},
    'a slow motion': {'phase_wander': {'std': 0.01, 'bandwidth': 0.1}},
    'a slow gain and noise': {'amplitude_modulation': {'std': 0.1},
                              'additive_noise': {'std': 1.0}},
    'scenarios': {'target_geometry': {'pulse_angles': [0.0, 0.02, -0.01]},
                  'clock_skew': {'skew': 1e-4}},
    'scenarios of averages that are drawn': {'keyphasor_quantisation': {
        'clock_rate': 5000.0, 'period_std': 3e-6}},
    'an interpolator': {'interpolation_loss': {'method': 'linear'}},
}


@dataclass(frozen=True)
class Unknown(Influence):
    """An effect of whose pulse errors the pulses at hand tell nothing."""

    name = 'unknown'
    effect: Influence

    def __getattribute__(self, name):
        if name in ('effect', 'pattern', '__class__', '__hash__', '__eq__', '__dict__'):
            return object.__getattribute__(self, name)
        return getattr(object.__getattribute__(self, 'effect'), name)


@dataclass(frozen=True)
class Resolution(Influence):
    """What resampling leaves of uncertainty, which the loop counts as noise."""

    name = 'resolution'

    def line_variance(self, model):
        return 2.0 * RESOLUTION**2


def observed(model, count=1):
    """Return acquisitions at an even speed; channels show one order each, nothing leaks."""
    times = model.trigger_period * np.arange(model.trigger_cycles + 1.0)
    missing = np.zeros(model.trigger_cycles, int)
    nothing = np.zeros((3, 3))
    cycles = np.tile(np.eye(3, dtype=complex), (2, 1, 1))
    item = Acquisition(0, times, missing, times, 0.0 * times, 0.0 * times, cycles[0], cycles,
                       nothing, nothing, np.zeros((0, 3, 3)), 0.0 * missing, True, '')
    orders = np.array(model.orders)
    return Observation(model, count * (item,), orders, orders, ('a', 'b', 'c'),
                       RecordPulses.unbroken(times), model.sample_rate, False, model.trigger_speed)


def expected(model, effects, pulses):
    """Return what the loop expects of acquisitions with these pulses."""
    return expect(observed(model, len(pulses)), LINES, np.ones(3), effects,
                  [[item] for item in pulses], np.zeros(3, int), range(len(pulses)))


@pytest.mark.machines
@pytest.mark.parametrize(('cycles', 'law'), [(40, 'linear'), (5, 'spline')])
@pytest.mark.parametrize('name', EFFECTS)
def test_loop_scores_with_the_published_distribution(name, cycles, law):
    model = replace(MODEL, trigger_cycles=cycles, angle_law=law)
    effects = [make_effect(key, **values) for key, values in EFFECTS[name].items()]
    count = cycles + 1 + model.weights.before + model.weights.after
    found = expected(model, [Unknown(effect) for effect in effects],
                     [AveragePulses(np.full(count, np.nan))])
    published = predict(model, [*effects, Resolution()])
    np.testing.assert_allclose(found.amplitude[0], published.mean_attenuation, rtol=1e-6)
    np.testing.assert_allclose(found.amplitude_variance[0], published.variance, rtol=1e-5)
    for p, quantile in zip(LEVELS, published.ppf(LEVELS).T):
        np.testing.assert_allclose(found.cdf(quantile[None])[0], p, atol=2.0 / 4096)  # draws
        np.testing.assert_allclose(found.cdf(quantile[None])[0],
                                   published.cdf(quantile[:, None])[:, 0], atol=1e-4)
    bare = predict(replace(model, noise_std=0.0), [
        effect for effect in effects  # an average and its corrected one share the gain
        if effect.name not in ('additive_noise', 'amplitude_modulation')])
    np.testing.assert_allclose(found.attenuation[0], bare.mean_attenuation, rtol=1e-6)
    np.testing.assert_allclose(found.attenuation_variance[0], bare.variance + RESOLUTION**2,
                               rtol=1e-5)


@pytest.mark.parametrize('std', [0.05, 0.2])
def test_a_gain_scatters_amplitudes_and_not_what_pulse_errors_cost(std, rng):
    model, draws = replace(MODEL, noise_std=0.0), 6000
    gain = make_effect('amplitude_modulation', std=std, bandwidth=0.3)
    cycles, (u, weight) = model.trigger_cycles, unit_nodes(8)
    found = expected(model, [Unknown(gain)], [AveragePulses(np.full(cycles + 1, np.nan))])
    (process,) = gain.processes(model)
    gains = process.draw_gain(rng, cycles, u, draws)
    errors = model.fundamental_frequency * model.distribution.draw(rng, (cycles + 1, 1, draws))
    along = errors[:-1] * (1.0 - u[:, None]) + errors[1:] * u[:, None]
    corrected = weight @ gains.mean(axis=0)
    for line, order in enumerate(ORDERS):
        raw = np.abs(weight @ np.mean(gains * np.exp(2j * np.pi * order * along), axis=0))
        ratio = raw / corrected
        assert found.attenuation[0, line] == pytest.approx(ratio.mean(), abs=5e-4)
        # cycles of unequal weights are so many fewer; a variance of 6000 draws is known to 2 %
        assert found.attenuation_variance[0, line] - RESOLUTION**2 == pytest.approx(
            ratio.var() / (1.0 + std**2), rel=0.08)
        assert found.amplitude_variance[0, line] == pytest.approx(raw.var(), rel=0.08)


@pytest.mark.machines
@pytest.mark.parametrize('wander', [False, True])
@pytest.mark.parametrize(('cycles', 'bias', 'off'), [(5, 0.04, 5e-3), (40, 0.01, 1e-3)])
def test_known_pulses_give_the_distribution_of_their_own_average(cycles, bias, off, wander, rng):
    """It is curved, which few cycles are `off` from; under slow errors it is of 256 draws."""
    model = replace(MODEL, trigger_cycles=cycles)
    geometry = make_effect('target_geometry', pulse_angles=[0.0, 0.02, -0.01])
    effects, draws = [geometry], 8000
    errors = model.distribution.draw(rng, (draws, cycles + 1))
    if wander:  # so slow that it shifts all pulses alike, which no amplitude shows
        effects.append(make_effect('correlated_jitter', std=2e-4, correlation=0.99))
        steps = rng.standard_normal((draws, cycles + 1)) * np.sqrt(1.0 - 0.99**2)
        steps[:, 0] /= np.sqrt(1.0 - 0.99**2)
        for k in range(1, cycles + 1):
            steps[:, k] += 0.99 * steps[:, k - 1]
        errors = errors + 2e-4 * steps
    pulses = [AveragePulses(np.full(cycles + 1, np.nan), first=first) for first in (1, 2)]
    found = expected(model, effects, pulses)
    noise = np.sqrt(2.0) * np.sqrt(found.noise[0, 0] / 4.0) * (
        rng.standard_normal(draws) + 1j * rng.standard_normal(draws))
    for a, item in enumerate(pulses):
        known = errors + geometry.pattern(model, item)
        for line, order in enumerate(ORDERS):
            signal = AveragedSignal(cycles, model.cycle_length, order)
            amplitude = np.abs(signal.whole_trigger_cycles(known * model.fundamental_frequency))
            error = amplitude.std() / np.sqrt(256 if wander else draws)
            assert found.attenuation[a, line] == pytest.approx(amplitude.mean(),
                                                               abs=off + 4.5 * error)
            assert np.sqrt(found.attenuation_variance[a, line]) == pytest.approx(
                amplitude.std(), rel=0.15 if wander else 12.0 * off)
            noisy = np.sort(np.abs(signal.whole_trigger_cycles(
                known * model.fundamental_frequency) + noise))
            distance = stats.kstest(noisy, lambda x, a=a, line=line: found.mean_cdf(
                [a], line, x)).statistic
            assert distance < bias + 1.95 / np.sqrt(256 if wander else draws)


def test_orders_beside_leak_as_late_as_the_corrected_pulses_are(rng):
    """These have the mean of the measured ones, wherever the known errors of an average begin."""
    sources, amplitudes, cycles = (19.0, 18.3), np.array([1.0, 0.6j]), 16
    model = replace(MODEL, ratio=0.4, orders=(19.0,), noise_std=0.0, trigger_cycles=cycles)
    item = observed(model).acquisitions[0]
    heard = np.tile(amplitudes, (2, 1, 1))
    observation = replace(observed(model), orders=np.array([19.0]), sources=np.array(sources),
                          acquisitions=(replace(item, raw=amplitudes, cycles=heard),))
    errors = 2e-4 * np.arange(cycles + 1.0) + rng.uniform(-1e-4, 1e-4, cycles + 1)
    clock = make_effect('keyphasor_quantisation', clock_rate=model.keyphasor_rate)
    signal = AveragedSignal(cycles, model.cycle_length, 19.0, sources, tuple(amplitudes))
    seen = np.abs(signal.whole_trigger_cycles(
        (errors - errors.mean())[None] * model.fundamental_frequency))
    for delay in (0.0, 0.02):
        pulses = [[AveragePulses(np.full(cycles + 1, np.nan), errors=errors + delay)]]
        found = expect(observation, Lines(np.zeros(1, int), np.zeros(1, int)), np.ones(1),
                       [clock], pulses, np.zeros(1, int), [0])
        assert found.attenuation[0, 0] == pytest.approx(seen[0], abs=2e-3)  # mirror image


@pytest.mark.parametrize('correlated', [False, True])
def test_orders_beside_scatter_by_jitter_too(correlated, rng):
    """A short trigger cycle does not keep them apart; their phases are their own."""
    sources, draws, cycles = (19.0, 18.3, 20.0), 4000, 16
    model = replace(MODEL, ratio=0.4, keyphasor_rate=2000.0, orders=(19.0,), noise_std=0.0,
                    trigger_cycles=cycles)
    item = observed(model).acquisitions[0]
    amplitudes = np.tile(np.array([[[1.0, 0.6, 0.5j]]]), (2, 1, 1))
    observation = replace(observed(model), orders=np.array([19.0]), sources=np.array(sources),
                          acquisitions=(replace(item, raw=amplitudes[0], cycles=amplitudes),))
    effects = []
    errors = model.distribution.draw(rng, (draws, cycles + 1))
    if correlated:
        effects.append(make_effect('correlated_jitter', std=1.5e-4, correlation=0.5))
        steps = rng.standard_normal((draws, cycles + 1)) * np.sqrt(0.75)
        steps[:, 0] /= np.sqrt(0.75)
        for k in range(1, cycles + 1):
            steps[:, k] += 0.5 * steps[:, k - 1]
        errors = errors + 1.5e-4 * steps
    found = expect(
        observation, Lines(np.zeros(1, int), np.zeros(1, int)), np.ones(1), effects,
        [[AveragePulses(np.full(cycles + 1, np.nan))]], np.zeros(1, int), [0])
    errors = errors * model.fundamental_frequency
    powers = []
    for phase in rng.uniform(0.0, 2.0 * np.pi, (12, 2)):
        beside = 1j * np.array([0.0, *phase])
        signal = AveragedSignal(cycles, model.cycle_length, 19.0, sources,
                                tuple(np.array([1.0, 0.6, 0.5]) * np.exp(beside)))
        powers.append(np.var(np.abs(signal.whole_trigger_cycles(errors))))
    alone = AveragedSignal(cycles, model.cycle_length, 19.0)
    least = np.var(np.abs(alone.whole_trigger_cycles(errors)))
    variance = found.attenuation_variance[0, 0] - RESOLUTION**2
    assert variance > 1.5 * least
    assert variance == pytest.approx(np.mean(powers), rel=4.0 * np.std(powers) / np.mean(powers)
                                     / np.sqrt(12.0))


@pytest.mark.parametrize('law', ['linear', 'quadratic', 'spline'])
@pytest.mark.parametrize(('size', 'lost'), [(1e-4, 0.0), (1e-2, 0.0), (1e-4, 1.0)])
def test_leakage_from_few_places_is_that_of_all(law, size, lost, rng):
    """The wave that errors turn is a polynomial between few places, but across lost pulses."""
    weights, count, r = angle_law(law).weights, 10, 1.0
    orders, sources = np.array([1.0, 40.0]), np.array([1.0, 40.0, 41.0, 117.3])
    model = SimpleNamespace(cycle_length=r, trigger_cycles=count, fundamental_frequency=1.0,
                            weights=weights)
    errors = size * rng.standard_normal((2, count - 1 + weights.pulses))
    errors[0, 6:] += lost
    found = _leakage(SimpleNamespace(model=model, orders=orders, sources=sources), (), errors)
    u = (np.arange(20000) + 0.5) / 20000  # r (source - order) is no whole number for 117.3
    path, cycle = weights.path(errors, u, count), np.arange(count)[:, None]
    for g, order in enumerate(orders):
        for s, source in enumerate(sources):
            wave = np.exp(2j * np.pi * (source * path + (source - order) * r * (cycle + u)))
            assert found[:, g, s] == pytest.approx(wave.mean(axis=(1, 2)), abs=1e-7)


def test_mirror_images_far_away_do_not_leak():
    """Of order 62 and its image, 558 turns of a cycle apart, hardly anything leaks."""
    model = replace(MODEL, ratio=4.5, orders=(31.0, 62.0), keyphasor_rate=40_000.0)
    observation = SimpleNamespace(model=model, orders=np.array(model.orders),
                                  sources=np.array([31.0, 62.0, 0.5636]))
    found = _leakage(observation, random_processes(model, ()), np.zeros((1, 41)))[0]
    images = found[:, 3:5]  # of the two orders
    assert np.abs(images).max() < 1e-3
    assert np.abs(found[0, 0]) > 0.9


@pytest.mark.parametrize('blur', [1e-9, 1e-3, 1.0, 1e3])
def test_uncertain_errors_sharpen_moments_at_most_twice(blur):
    factor = _sharpening(np.array([1e-3, 1.0, 30.0, 1e5]), IndependentPulseJitter(Normal(blur)))
    assert np.all((factor >= 1.0 - 1e-12) & (factor <= 2.0))
