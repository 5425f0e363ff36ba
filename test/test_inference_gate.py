# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The loop makes nothing worse: the gate, steps of a clock, lines that vary, ticks and noise."""

from dataclasses import replace
import math

from hypothesis import given, HealthCheck, settings, strategies as st
import numpy as np
import pytest
import sa_jitter_ros as sa
from sa_jitter_ros.effects import make_effect
from sa_jitter_ros.effects.effect import Finding
from sa_jitter_ros.inference.expectation import Lines
from sa_jitter_ros.inference.gate import CERTAIN, HeldOut, passed, score_gain, ScoreGain
from sa_jitter_ros.inference.observation import observe
from sa_jitter_ros.inference.trace import trace
from sa_jitter_ros.inference.unsteady import unsteady_lines
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.recordings.recording import ArraySource, Recording
from sa_jitter_ros.report.words import next_steps, verdict_sentence
from sa_jitter_ros.simulation import (
    AdditiveNoise, band_limited, DeclaredJitter, Gearbox, Keyphasor, make_effects, mesh)
from scipy.interpolate import CubicSpline

pytestmark = pytest.mark.usefixtures('unasked')
RATE, SPEED, CYCLES, NOISE = 4096.0, 25.0, 20, 0.05
ORDERS = (8.0, 16.0, 24.0)
DECLARED = {'keyphasor_rate': 5000.0, 'trigger_speed': SPEED, 'trigger_cycles': CYCLES,
            'orders': ORDERS, 'noise_std': NOISE}


def machine(*effects, seed=1, seconds=10.0, jitter=True):
    """Return the vibration (channel, sample) and the pulse times of a plain machine."""
    declared = (DeclaredJitter('uniform', 2e-4 / math.sqrt(12.0)),) if jitter else ()
    gear = Gearbox(
        mesh('shaft', 8, harmonics=(1.0, 0.7, 0.5), channel_gains=(1.0, 0.8), seed=seed), RATE,
        speed=((0.0, SPEED),), effects=(*declared, AdditiveNoise(NOISE), *effects), seed=seed,
        fluctuation=band_limited(std=1e-3, band=(0.1, 2.0), seed=seed, name='speed'))
    return gear.vibration(0, int(seconds * RATE)), gear.pulses(0.0, seconds).times


def closed(vibration, pulse_times, **declared):
    """Return the report of the loop."""
    recording = Recording(ArraySource(vibration), RATE, pulse_times=pulse_times,
                          channel_names=('inner', 'outer'))
    values = {**DECLARED, **declared}
    return sa.close_loop(recording, {
        name: value for name, value in values.items() if value is not None}).report


def held_out(rng, expected, std, bias=0.0):
    """Return a prediction of 8 acquisitions and 3 lines that is right but for a bias."""
    observed = expected + std * rng.standard_normal((2, 8, 3))
    return HeldOut(observed, np.full(observed.shape, expected + bias),
                   np.full(observed.shape, std**2), 3)


def test_worse_prediction_does_not_pass_and_a_tie_does(rng):
    right = held_out(rng, 0.9, 0.01)
    wrong = replace(right, expected=right.expected + 0.05)
    assert score_gain(right, wrong, of_mean=False).worse
    better = score_gain(wrong, right, of_mean=True)
    assert not better.worse
    assert better.log_score > CERTAIN * better.log_score_error
    assert better.rms < 0.0
    assert not score_gain(right, right, of_mean=True).worse


def test_wider_distribution_that_is_right_is_no_harm(rng):
    """Of averages that scatter more, a few held-out ones may all be near the mean."""
    harmed = 0
    for _ in range(400):
        wide = held_out(rng, 1.0, 0.03)
        harmed += score_gain(
            replace(wide, variance=wide.variance / 9.0), wide, of_mean=False).worse
    assert harmed == 0


def test_effects_go_the_least_supported_first(rng):
    findings = [Finding(name, make_effect(name), {}, 0.0, '')
                for name in ('clock_skew', 'excess_jitter')]
    base = held_out(rng, 0.9, 0.01)
    declared, right, wrong = (replace(base, expected=base.expected + off)
                              for off in (0.03, 0.0, 0.2))
    predictions = {(): declared, ('clock_skew',): right, ('excess_jitter',): wrong,
                   ('clock_skew', 'excess_jitter'): wrong}
    kept, dropped, found = passed(
        findings, lambda some: predictions[tuple(item.name for item in some)])
    assert [item.name for item in kept] == ['clock_skew']
    assert [item.name for item in dropped] == ['excess_jitter']
    assert not found.worse


@pytest.mark.machines
def test_trace_with_effects_that_harm_can_not_be_made():
    vibration, pulses = machine(*make_effects({'excess_jitter': {'std': 1.5e-4}}))
    recording = Recording(ArraySource(vibration), RATE, pulse_times=pulses)
    model = DeclaredModel(**{**DECLARED, 'sample_rate': RATE})
    found = trace([observe(recording, model)], [recording])
    assert [item.name for item in found.findings] == ['excess_jitter']
    assert found.gain.log_score > 0.0
    with pytest.raises(ValueError, match='excess_jitter: held-out acquisitions are predicted'):
        replace(found, gain=ScoreGain(-1.0, 0.1, 0.0, 0.1, True))


@pytest.mark.machines
@settings(max_examples=2, deadline=None, derandomize=True,
          suppress_health_check=list(HealthCheck))
@given(st.integers(0, 10_000), st.sampled_from([
    {}, {'excess_jitter': {'std': 1e-4}}, {'clock_skew': {'skew': 2e-4}},
    {'amplitude_modulation': {'std': 0.2}}, {'phase_wander': {'std': 0.05}},
    {'speed_fluctuation': {'acceleration_std': 60.0}}]), st.booleans())
def test_loop_makes_no_random_machine_worse(seed, effects, on_ticks):
    vibration, pulses = machine(*make_effects(effects), seed=seed, seconds=7.0,
                                jitter=not on_ticks)
    if on_ticks:
        pulses = np.ceil(pulses * 5000.0) / 5000.0
    content = closed(vibration, pulses)
    gained = content['gain']
    if content['missing_effects']:
        assert gained['log_score'] >= -CERTAIN * gained['log_score_error']
        assert not gained['of_mean'] or gained['rms'] <= CERTAIN * gained['rms_error']
    else:
        assert content['error_after'] == content['error_before']
    assert 0.0 <= content['error_after']['p_value'] <= 1.0
    assert (content['remains'] != '') == (content['verdict'] == 'unexplained')


@pytest.mark.machines
@pytest.mark.parametrize(('lost', 'seed'), [(13, 2), (2, 3)])
def test_lost_samples_are_a_step_of_the_clock(lost, seed):
    vibration, pulses = machine(seed=seed)
    at = int(0.43 * vibration.shape[1])
    content = closed(np.delete(vibration, slice(at, at + lost), axis=1), pulses)
    assert (content['verdict'], content['missing_effects']) == ('unexplained', [])
    step, = content['clock_steps']
    assert abs(step['time'] - at / RATE) < 2.0 / SPEED
    assert step['period'] == pytest.approx(1.0 / (ORDERS[0] * SPEED), 1e-3)  # 20.5 samples
    off = math.remainder(step['step'] - lost / RATE, step['period'])
    assert abs(off) < 3.0 * step['standard_error'] < 0.5 * lost / RATE
    assert 'any multiple of 0.005 s' in content['remains']
    assert 'lost samples' in content['remains']
    assert 'clock_steps' in ' '.join(next_steps(content))


def test_motion_that_is_no_step_is_none():
    """Wander, drift and white errors have contrasts of their own size."""
    vibration, pulses = machine(*make_effects({'phase_wander': {'std': 0.06, 'bandwidth': 0.2}}))
    model = DeclaredModel(**{**DECLARED, 'sample_rate': RATE})
    drift = 1e-3 * np.linspace(-1.0, 1.0, pulses.size) ** 3
    for times in (pulses, pulses + drift):
        recording = Recording(ArraySource(vibration), RATE, pulse_times=times)
        assert observe(recording, model).clock_steps == ()


@pytest.mark.machines
@pytest.mark.parametrize('hidden', [False, True])
def test_channel_that_loses_a_quarter_is_named(hidden):
    """Whether or not single pulse errors show: a clock of 1 MHz leaves none."""
    vibration, pulses = machine(jitter=not hidden)
    vibration[1, vibration.shape[1] // 2:] *= 0.75
    content = closed(vibration, pulses, **({
        'keyphasor_rate': 1e6, 'trigger_cycles': 25} if hidden else {}))
    assert content['verdict'] == 'unexplained'
    assert {(item['order'], item['channel']) for item in content['unsteady_lines']} == {
        (order, 'outer') for order in ORDERS}
    assert all(0.1 < item['scatter'] < 0.2 for item in content['unsteady_lines'])
    assert 'on outer varies by' in verdict_sentence(content)


def test_noise_alone_makes_no_line_unsteady(rng):
    lines = Lines(np.zeros(4, int), np.arange(4))
    found = 0
    for _ in range(300):
        noise = np.array([0.005, 0.05, 0.1, 0.2])
        amplitude = 1.0 + noise * rng.standard_normal((12, 4))
        found += bool(unsteady_lines(amplitude, noise**2, np.arange(1.0, 5.0), ['one'], lines))
    assert found <= 300 * 0.005 + 3.0 * math.sqrt(300 * 0.005)


@pytest.mark.machines
def test_noise_that_nobody_declared_is_measured():
    vibration, pulses = machine()
    content = closed(vibration, pulses, noise_std=None)
    assert (content['verdict'], content['missing_effects']) == ('none', [])
    noise, = [item for item in content['declared_changes'] if item['parameter'] == 'noise_std']
    assert noise['declared'] is None
    assert abs(noise['value'] - NOISE) < 3.0 * noise['standard_error'] < 0.2 * NOISE


@pytest.mark.machines
def test_keyphasor_on_the_ticks_of_the_declared_clock_suffices():
    ratio = 183 / 76
    gear = Gearbox(
        mesh('input', 19, harmonics=(1.0, 0.5, 0.25)), 10000.0, shafts={'input': ratio},
        speed=[(0.0, 16.6)], keyphasor=Keyphasor(rate=5000.0), seed=4,
        fluctuation=band_limited(std=3e-4, band=(0.1, 2.0), seed=4, name='speed'),
        effects=[AdditiveNoise(0.3, 'noise')])
    recording = Recording(
        ArraySource(gear.vibration(0, 200_000)), 10000.0, ratio=ratio,
        pulse_times=sa.detect_pulses(gear.tach_waveform(0, 100_000), 5000.0, interpolate=False))
    declared = {'keyphasor_rate': 5000.0, 'trigger_speed': 16.6, 'trigger_cycles': 40,
                'ratio': ratio, 'orders': [19.0, 38.0, 57.0]}
    content = sa.close_loop(recording, declared).report
    assert (content['verdict'], content['missing_effects']) == ('none', [])
    assert content['error_after']['rms'] < 0.015
    assert {'clock_rate', 'noise_std'} <= {
        item['parameter'] for item in content['declared_changes']}


@pytest.mark.machines
def test_mesh_of_another_shaft_is_no_tone_of_the_supply(rng):
    rate, seconds = 10_000.0, 16.0
    time = np.arange(int(rate * seconds)) / rate
    waves = SPEED * sum(4e-4 * np.sin(2.0 * np.pi * f * time + f) / (2.0 * np.pi * f)
                        for f in (0.13, 0.41, 0.87))  # a speed that wanders by 5e-4
    turns = SPEED * time + waves - 0.25
    true = CubicSpline(turns, time)(np.arange(1, int(turns[-1])))
    vibration = sum(size * np.cos(2.0 * np.pi * order * turns + order) for order, size in (
        (7.0, 1.0), (14.0, 0.5), (21.0, 0.3), (6.52, 0.4), (13.04, 0.25)))
    vibration = vibration + 0.1 * rng.standard_normal(time.size)
    content = sa.close_loop(
        Recording(ArraySource(vibration[None]), rate,
                  pulse_times=true + rng.uniform(-5e-5, 5e-5, true.size)),
        {'keyphasor_rate': 1e4, 'trigger_speed': SPEED, 'trigger_cycles': 20,
         'orders': [7, 14, 21], 'noise_std': 0.1}).report
    assert (content['verdict'], content['missing_effects']) == ('none', [])
