# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The scale of the residual: what the observation itself is uncertain by, and nothing else."""

from dataclasses import replace
import math

import numpy as np
import pytest
from sa_jitter_ros.effects import make_effect
from sa_jitter_ros.inference.expectation import expect, Lines, Memory
from sa_jitter_ros.inference.gathering import line_evidence
from sa_jitter_ros.inference.observation import observe
from sa_jitter_ros.inference.scoring import make_bench
from sa_jitter_ros.inference.trace import trace
from sa_jitter_ros.inference.unsteady import SCATTER
from sa_jitter_ros.prediction.influence import AveragePulses
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.recordings.recording import ArraySource, Recording
from sa_jitter_ros.simulation.components import mesh
from sa_jitter_ros.simulation.effects import AdditiveNoise, DeclaredJitter
from sa_jitter_ros.simulation.gearbox import Gearbox
from validation.analytic import normal_mean

pytestmark = pytest.mark.usefixtures('unasked')
RATE, SPEED, CYCLES, NOISE, ACQUISITIONS = 5000.0, 25.0, 20, 0.05, 16
JITTER = 1.0 / math.sqrt(12.0) / 5000.0
MODEL = DeclaredModel(keyphasor_rate=5000.0, trigger_speed=SPEED, trigger_cycles=CYCLES,
                      orders=(8.0, 16.0, 24.0, 32.0), noise_std=NOISE, sample_rate=RATE)


def simulated(*, noise=NOISE, jitter=JITTER, seed=3):
    """Return a recording with white noise and uniform jitter of these standard deviations."""
    gearbox = Gearbox(
        mesh('shaft', 8, harmonics=(1.0, 0.8, 0.6, 0.5), channel_gains=(1.0, 0.7), seed=seed),
        RATE, speed=((0.0, SPEED),), seed=seed,
        effects=(AdditiveNoise(noise, name='declared_noise'), DeclaredJitter('uniform', jitter)))
    duration = (ACQUISITIONS * CYCLES + 3) / SPEED
    return Recording(ArraySource(gearbox.vibration(0, round(duration * RATE))), RATE,
                     pulse_times=gearbox.pulses(0.0, duration).times)


@pytest.fixture(scope='module')
def recording():
    return simulated()


@pytest.fixture(scope='module')
def observation(recording):
    return observe(recording, MODEL)


def drifting(observation, size, rng):
    """Return an observation whose lines have different loads in each acquisition."""
    def changed(item):
        gain = 1.0 + size * rng.standard_normal(item.raw.shape)
        return replace(item, raw=gain * item.raw, cycles=gain * item.cycles)
    return replace(observation, acquisitions=tuple(map(changed, observation.acquisitions)))


@pytest.mark.machines
def test_steady_machine_has_no_unsteadiness(recording, observation):
    assert trace([observation], [recording]).unsteadiness == 0.0


@pytest.mark.machines
def test_small_unexplained_scatter_is_unsteadiness(recording, observation, rng):
    size = 0.012
    found = trace([drifting(observation, size, rng)], [recording])
    count = found.level.size * len(observation.acquisitions)
    assert found.unsteadiness == pytest.approx(size, rel=4.0 / np.sqrt(2.0 * count))
    assert found.verdict == 'none'
    assert found.after.chi2_per_dof == pytest.approx(
        1.0, abs=4.0 * np.sqrt(2.0 / (count // 2) + 2.0 / count))
    assert found.after.ks < 1.63 / np.sqrt(count // 2)


@pytest.mark.machines
def test_levels_of_few_averages_are_part_of_the_scale(recording, observation, rng):
    few = replace(observation, acquisitions=observation.acquisitions[:8])
    size, found = 0.02, []
    for _ in range(28):
        changed = drifting(few, size, rng)
        bench = make_bench(changed, [changed], [recording], ())
        assert len(bench.fit) == 4
        found.append(bench.score((), unsteadiness=size).chi2_per_dof)
    error = np.std(found, ddof=1) / np.sqrt(len(found))
    assert np.mean(found) == pytest.approx(1.0, abs=4.0 * error)
    assert error < 0.05  # a quarter of it is that of the levels


@pytest.mark.machines
def test_large_unexplained_scatter_stays_unexplained(recording, observation, rng):
    found = trace([drifting(observation, 0.08, rng)], [recording])
    assert found.verdict == 'unexplained'
    assert found.findings == ()
    assert found.unsteadiness == pytest.approx(SCATTER, rel=1e-12)
    assert found.after.chi2_per_dof > 5.0


@pytest.mark.machines
def test_little_white_noise_is_named_although_the_machine_scatters_as_much():
    noisy = simulated(noise=0.3)
    found = trace([observe(noisy, MODEL)], [noisy])
    effect, = (item.effect for item in found.findings)
    assert effect.name == 'additive_noise'
    assert math.hypot(effect.std, NOISE) == pytest.approx(0.3, rel=0.1)
    assert found.verdict == 'traced'
    assert found.unsteadiness == 0.0
    assert found.before.chi2_per_dof > 5.0
    assert 0.7 < found.after.chi2_per_dof < 1.4


def test_what_leaks_into_cycles_but_not_into_averages_is_no_noise(observation, rng):
    lines, *_ = lines_of(observation)

    def changed(item):
        leak = 0.3 * np.abs(item.corrected) * rng.standard_normal(item.cycles.shape)
        return replace(item, cycles=item.cycles + leak - leak.mean(axis=0))

    leaking = replace(observation, acquisitions=tuple(map(changed, observation.acquisitions)))
    for each in observation, leaking:
        density = np.sqrt(np.median(np.mean(line_evidence(each, lines).noise_density**2, axis=0)))
        # of as many squares as there are averages and lines, the more uncertain of both
        assert density == pytest.approx(NOISE, rel=4.0 / np.sqrt(2.0 * ACQUISITIONS * lines.count))


def lines_of(observation):
    """Return all lines, their level, and the group of each channel."""
    channel, order = np.indices(observation.acquisitions[0].noise.shape).reshape(2, -1)
    lines = Lines(channel, order)
    level = lines.of(np.abs(observation.stacked('corrected'))).mean(axis=0)
    return lines, level, np.zeros(2, int)


def test_each_acquisition_is_predicted_at_its_speed(observation):
    slow = tuple(replace(item, times=1.25 * item.times) for item in observation.acquisitions)
    pulses = [[AveragePulses(item.times, item.first)] for item in slow]
    lines, level, group = lines_of(observation)
    found = expect(replace(observation, acquisitions=slow), lines, level, (), pulses, group, [0])
    model = replace(MODEL, trigger_speed=SPEED / 1.25)
    right = expect(replace(observation, acquisitions=slow, model=model), lines, level, (), pulses,
                   group, [0])
    assert found.attenuation == pytest.approx(right.attenuation, abs=1e-6)
    assert found.amplitude_variance == pytest.approx(right.amplitude_variance, rel=1e-3)


def test_acquisitions_are_predicted_alike_together_alone_and_from_memory(observation):
    """Known pulses of several acquisitions are predicted at once; what was predicted is kept."""
    effects = [make_effect('keyphasor_quantisation', clock_rate=MODEL.keyphasor_rate),
               make_effect('amplitude_modulation', std=0.05)]
    lines, level, group = lines_of(observation)
    pulses = [[AveragePulses(item.times, item.first, item.errors, None, 1e-6 * (i % 2))]
              for i, item in enumerate(observation.acquisitions)]
    memory = Memory()

    def predicted(chosen, kept=None):
        found = expect(observation, lines, level, effects, pulses, group, chosen, memory=kept,
                       unsteadiness=0.01)
        return np.stack((found.attenuation, found.amplitude_variance))

    together = predicted(range(4), memory)
    alone = np.concatenate([predicted([a]) for a in range(4)], axis=1)
    assert together == pytest.approx(alone, rel=1e-6)
    assert np.array_equal(predicted([2, 1], memory), together[:, [2, 1]])
    assert len(memory.shown) == 8  # with the gain, which attenuation has not, and without it


def test_uncertain_pulse_errors_do_not_attenuate(observation, rng):
    """The mean prediction by errors that are off is that by the true ones."""
    clock = make_effect('keyphasor_quantisation', clock_rate=MODEL.keyphasor_rate)
    lines, level, group = lines_of(observation)
    off, everything = 40e-6, range(len(observation.acquisitions))

    def predicted(noise, error_std):
        pulses = [[AveragePulses(item.times, item.first, item.errors + noise
                                 * rng.standard_normal(item.errors.size), None, error_std)]
                  for item in observation.acquisitions]
        return expect(observation, lines, level, [clock], pulses, group, everything).attenuation

    true = predicted(0.0, 0.0)
    uncertain, naive = predicted(off, off) - true, predicted(off, 0.0) - true
    chance = naive.std(axis=0, ddof=1) / np.sqrt(len(naive))
    assert np.all(np.abs(uncertain.mean(axis=0)) < 4.0 * chance)
    lost = true.mean(axis=0) * (1.0 - normal_mean(observation.orders * off * SPEED))[lines.order]
    assert np.all(np.abs(naive.mean(axis=0) + lost) < 4.0 * chance)
    assert lost.max() > 4.0 * chance.max()


def test_noise_that_passes_for_larger_jitter_is_not_corrected():
    noisy = simulated(noise=1.5, jitter=1e-6)
    found = observe(noisy, replace(MODEL, keyphasor_rate=20000.0, noise_std=1.5))
    assert not found.compared
    assert found.stacked('attenuation') == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize('correlation', [0.0, 0.7, 0.95])
def test_slow_errors_turn_averages_and_do_not_scatter_their_amplitude(observation, correlation):
    effect = make_effect('correlated_jitter', std=1e-4, correlation=correlation)
    lines, level, group = lines_of(observation)
    pulses = [[AveragePulses(item.times, item.first)] for item in observation.acquisitions]
    found = expect(observation, lines, level, [effect], pulses, group, [0])
    rng, draws = np.random.default_rng(2), 20_000
    slow = np.empty((draws, CYCLES + 1))
    slow[:, 0] = rng.standard_normal(draws)
    for k in range(CYCLES):
        slow[:, k + 1] = correlation * slow[:, k] + np.sqrt(
            1.0 - correlation**2) * rng.standard_normal(draws)
    errors = 1e-4 * slow + rng.uniform(-0.5, 0.5, slow.shape) / MODEL.keyphasor_rate
    turns = np.multiply.outer(MODEL.orders, SPEED * errors)
    amplitude = np.abs(np.mean(np.exp(1j * np.pi * (turns[..., 1:] + turns[..., :-1]))
                               * np.sinc(np.diff(turns)), axis=2))
    mean, std = amplitude.mean(axis=1), amplitude.std(axis=1)
    order = np.searchsorted(MODEL.orders, observation.orders[lines.order])
    # Where cycles remember each other, averages are drawn, some thousand of them.
    assert found.attenuation[0] == pytest.approx(mean[order], abs=1e-3)
    assert np.sqrt(found.attenuation_variance[0]) == pytest.approx(std[order], rel=0.05, abs=1e-3)
