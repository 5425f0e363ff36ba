# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Whether all lines move together: what a changing speed does to them, and what a path does."""

from dataclasses import replace

import numpy as np
import pytest
from sa_jitter_ros.effects.evidence import LineEvidence
from sa_jitter_ros.inference.gathering import choose_lines
from sa_jitter_ros.inference.line_checks import check_channels, check_gain, check_lines
from sa_jitter_ros.inference.observation import observe
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.recordings.recording import ArraySource, Recording

RATE, SPEED, CYCLES, ACQUISITIONS = 5000.0, 16.0, 8, 80


@pytest.mark.machines
@pytest.mark.parametrize('turn', [0.0, 0.15])
def test_speed_that_rises_and_falls_turns_no_line_but_a_resonance_does(rng, turn):
    """A speed that changes by 2 % bends the angle, so that order 58 leaks into order 59."""
    time = np.arange(int((ACQUISITIONS * CYCLES + 4) / SPEED * RATE)) / RATE
    load = np.sin(2.0 * np.pi * 0.27 * time)
    slow = -np.cos(2.0 * np.pi * 0.27 * time) / (2.0 * np.pi * 0.27)
    turns = SPEED * (time + 0.02 * slow)
    vibration = sum(size * np.cos(2.0 * np.pi * order * turns + phase) for order, size, phase in (
        (28, 0.5, 1.0), (58, 7.0, 2.0)))
    vibration += 0.4 * np.cos(2.0 * np.pi * 59.0 * turns + turn * load)
    vibration += rng.standard_normal(time.size)
    pulses = np.interp(np.arange(0.5, turns[-1]), turns, time)
    pulses += rng.uniform(-0.5, 0.5, pulses.size) / 20000.0
    model = DeclaredModel(keyphasor_rate=20000.0, trigger_speed=SPEED, trigger_cycles=CYCLES,
                          orders=(28.0, 58.0, 59.0), sample_rate=RATE)
    observation = observe(Recording(ArraySource(vibration[None]), RATE, pulse_times=pulses), model)
    turned = check_lines(observation, choose_lines(observation), np.zeros(3))[0]
    if turn:
        assert turned.p_value < 1e-6
        assert turned.size == pytest.approx(turn / np.sqrt(2.0), rel=0.3)
        # a tone that turns it as much explains it
        tone = np.array([0.0, 0.0, (0.4 * turn) ** 2])
        assert check_lines(observation, choose_lines(observation), tone)[0].p_value > 0.01
    else:
        assert turned.p_value > 0.01


def test_an_order_that_short_cycles_refuse_is_compared_nowhere(recwarn):
    """The speed swings by a quarter: the fastest cycles have fewer than two samples a turn."""
    time = np.arange(1600) / 100.0
    turns = time + 0.25 / np.pi * np.sin(np.pi * time)
    pulses = np.interp(np.arange(1, 13 * 15) / 13.0, turns, time)
    model = DeclaredModel(keyphasor_rate=1e4, trigger_speed=1.0, trigger_cycles=26,
                          orders=(45.0, 46.0), sample_rate=100.0, pulses_per_revolution=13,
                          pulses_per_trigger=1)
    observation = observe(Recording(
        ArraySource(np.cos(2.0 * np.pi * 45.0 * turns)[None]), 100.0, pulse_times=pulses,
        pulses_per_revolution=13), model)
    assert not choose_lines(observation).order.size
    assert not [item for item in recwarn if item.category is RuntimeWarning]


def turning_order(rng, share):
    """Check a highest order that turns by 0.5 rad, the others by a `share` of what turns it."""
    time = np.arange(int((50 * CYCLES + 4) / SPEED * RATE)) / RATE
    waves = np.fft.rfft(rng.standard_normal(time.size))
    turn = np.fft.irfft(np.where(
        np.arange(waves.size) < 0.15 * SPEED * time[-1], waves, 0.0), time.size)
    turn *= 0.5 / turn.std()
    vibration = sum(
        size * np.cos(2.0 * np.pi * order * SPEED * time + phase + own * order / 60.0 * turn)
        for order, size, phase, own in (
            (20, 1.0, 1.0, share), (40, 1.0, 2.0, share), (60, 0.4, 0.5, 1.0)))
    vibration += 0.3 * rng.standard_normal(time.size)
    pulses = np.arange(0.5, SPEED * time[-1]) / SPEED
    pulses += rng.uniform(-0.5, 0.5, pulses.size) / 20000.0
    model = DeclaredModel(keyphasor_rate=20000.0, trigger_speed=SPEED, trigger_cycles=CYCLES,
                          orders=(20.0, 40.0, 60.0), sample_rate=RATE)
    observation = observe(Recording(ArraySource(vibration[None]), RATE, pulse_times=pulses), model)
    return check_lines(observation, choose_lines(observation), np.zeros(3))[1]


@pytest.mark.machines
@pytest.mark.parametrize('share', [0.2, 1.0])
def test_order_that_turns_by_itself_from_cycle_to_cycle_is_no_common_motion(rng, share):
    """On some machines pulse errors take its turn for theirs, and sidebands make up for it."""
    found = [turning_order(child, share) for child in rng.spawn(4)]
    assert all('from cycle to cycle' in item.text for item in found)
    seen = sum(item.p_value < 1e-6 for item in found)
    assert seen >= 3 if share < 1.0 else min(item.p_value for item in found) > 0.01


@pytest.mark.parametrize('event', ['none', 'step', 'loss'])
def test_gain_of_single_events_is_no_modulation(rng, event):
    """A band of noise is one; a step of the gain, or a signal that is lost for a while, is not."""
    acquisitions, cycles = 30, 20
    count = acquisitions * cycles
    waves = np.fft.rfft(rng.standard_normal(count))
    gain = np.fft.irfft(np.where(np.arange(waves.size) < 0.1 * count, waves, 0.0), count)
    gain *= 0.1 / gain.std()
    if event != 'none':
        gain = np.where(np.arange(count) > 333, 0.3, 0.0) if event == 'step' else -0.9 * np.isin(
            np.arange(count) // 4, [20, 75, 110])
    radial = np.stack([gain, gain], axis=1) + 0.02 * rng.standard_normal((count, 2))
    found = check_gain(LineEvidence(
        np.array([20.0, 40.0]), np.zeros(2, int), np.ones(2), np.ones((acquisitions, 2)),
        radial.reshape(acquisitions, cycles, 2), np.array([0.02, 0.02])))
    assert (found.p_value < 1e-6) == (event != 'none')


@pytest.mark.parametrize('left_out', [2, 40])
def test_gain_that_went_on_between_acquisitions_is_no_single_event(rng, left_out):
    acquisitions, cycles = 24, 18
    number = np.add.outer(2 * cycles * np.arange(acquisitions), np.arange(cycles))
    place = np.add.outer((cycles + left_out) * np.arange(acquisitions), np.arange(cycles))
    count = (cycles + left_out) * acquisitions
    waves = np.fft.rfft(rng.standard_normal(count))
    gain = np.fft.irfft(np.where(np.arange(waves.size) < 0.02 * count, waves, 0.0), count)
    radial = 0.2 * (gain / gain.std())[place, None] + 0.005 * rng.standard_normal(
        (acquisitions, cycles, 1))
    lines = LineEvidence(np.array([20.0]), np.zeros(1, int), np.ones(1),
                         np.ones((acquisitions, 1)), radial, np.array([0.005]))
    assert check_gain(lines).p_value < 1e-6  # jumps, as if the cycles were neighbours
    assert check_gain(replace(lines, number=number)).p_value > 0.01


@pytest.mark.parametrize('drifting', [False, True])
def test_gain_of_one_channel_is_none_of_all(rng, drifting):
    acquisitions, cycles = 12, 20
    common = 0.1 * rng.standard_normal((acquisitions, 1, 1))
    radial = common + 0.02 * rng.standard_normal((acquisitions, cycles, 4))
    if drifting:
        radial[..., 2:] += np.linspace(-0.2, 0.2, acquisitions)[:, None, None]
    found = check_channels(LineEvidence(
        np.array([20.0, 40.0] * 2), np.array([0, 0, 1, 1]), np.ones(4), np.ones((acquisitions, 4)),
        radial, np.full(4, 0.02)))
    assert (found.p_value < 1e-6) == drifting
    assert not drifting or 'channel 1' in found.text


@pytest.mark.machines
@pytest.mark.parametrize('noise', [1.0, 4.0])
@pytest.mark.parametrize('seed', range(3))
def test_amplitudes_that_share_the_noise_of_the_errors_follow_nothing(noise, seed):
    """Weak lines show pulse errors of 4 ms as well as their noise: that is in both."""
    rng, rate, speed = np.random.default_rng(seed), 600.0, 4.19
    time = np.arange(int(92 / speed * rate)) / rate
    vibration = sum(size * np.cos(2.0 * np.pi * order * speed * time + phase)
                    for order, size, phase in ((1, 0.5, 1.0), (2, 1.0, 2.0), (3, 0.4, 0.3)))
    vibration += noise * rng.standard_normal(time.size)
    pulses = np.arange(0.5, speed * time[-1]) / speed
    pulses += rng.uniform(-0.5, 0.5, pulses.size) / 1024.0
    pulses += 4e-3 * rng.standard_normal(pulses.size)
    model = DeclaredModel(keyphasor_rate=1024.0, trigger_speed=speed, trigger_cycles=10,
                          orders=(1.0, 2.0, 3.0), sample_rate=rate)
    observation = observe(Recording(ArraySource(vibration[None]), rate, pulse_times=pulses), model)
    # of the first checks, those of the turns, other tests hold
    for check in check_lines(observation, choose_lines(observation), np.zeros(3))[2:]:
        assert check.p_value > 0.01
