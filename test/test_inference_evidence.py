# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""What the loop takes as evidence: noise that is no line, pulses that are counted, ticks."""

from dataclasses import replace
import math

from decision_independent import independent
from decision_worker import answer
from decisions import stored
import numpy as np
import pytest
from sa_jitter_ros.averaging.noise import noise_floor
from sa_jitter_ros.effects import make_effect
from sa_jitter_ros.effects.effect import Finding
from sa_jitter_ros.effects.lattice import placed_on_grid, ticks_leave_room, within_half_tick
from sa_jitter_ros.inference.beat import find_beat, without_beat
from sa_jitter_ros.inference.expectation import Memory
from sa_jitter_ros.inference.observation import observe
from sa_jitter_ros.inference.record_pulses import record_pulses
from sa_jitter_ros.inference.refinements import with_its_ticks
from sa_jitter_ros.inference.scoring import make_bench
from sa_jitter_ros.inference.trace import trace
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.recordings.recording import ArraySource, Recording

pytestmark = pytest.mark.usefixtures('unasked')
RATE, SPEED, CYCLES = 6000.0, 25.0, 20


@pytest.mark.parametrize(('length', 'order'), [(3.0, 8.0), (0.206, 17.0), (2.4, 8.0)])
def test_noise_floor_is_the_noise_of_the_amplitude_beside_other_orders(rng, length, order):
    cycles, points, std, draws = 40, 400, 0.1, 20
    turns = length * np.arange(cycles * points) / points
    floors = []
    for _ in range(draws):
        phases = rng.uniform(0.0, 2.0 * np.pi, 4)
        signal = sum(size * np.cos(2.0 * np.pi * g * turns + phase) for g, size, phase in zip(
            (order, order + 1.0, 2.0 * order, order + 0.37), (1.0, 0.3, 0.5, 0.2), phases))
        noisy = signal[:, None] + std * rng.standard_normal((turns.size, 2))
        floors.append(noise_floor(noisy.reshape(cycles, points, 2), length,
                                  np.array([order, 2.0 * order]), order + 180.0 / length))
    expected = std * np.sqrt(2.0 / turns.size)
    # At least 147 lines, every other one resolved and few of them taken; rounding up of what is
    # cut: 2 %.
    error = 0.5 / np.sqrt(0.5 * 147 * 2 * draws)
    assert np.sqrt(np.mean(np.square(floors), axis=(0, 1))) == pytest.approx(
        np.full(2, expected), rel=4.0 * error + 0.02)


@pytest.mark.parametrize('begin', [1, 100])
def test_lost_pulses_between_triggers_change_nothing(rng, begin):
    model = DeclaredModel(keyphasor_rate=10_000.0, trigger_speed=SPEED, trigger_cycles=CYCLES,
                          orders=(8.0,), pulses_per_revolution=4, pulses_per_trigger=3)
    true = 0.003 + np.arange(400) / (4 * SPEED)
    lost = np.array([40, 41, 114, 200])  # the third is a trigger
    kept = np.setdiff1d(np.arange(400), lost)
    measured = true[kept] + rng.uniform(-1e-5, 1e-5, kept.size)
    found = record_pulses(Recording(
        ArraySource(np.zeros((1, 30_000))), RATE, pulse_times=measured,
        reference_pulse_times=true[begin:], pulses_per_revolution=4), model)
    triggers = np.arange(0, 400, 3)
    there = np.setdiff1d(triggers, lost)
    np.testing.assert_array_equal(found.times, measured[np.searchsorted(kept, there)])
    assert found.missing.sum() == np.intersect1d(triggers, lost).size
    # also where the tested keyphasor has none
    expected = np.where(triggers < begin, np.nan, true[triggers])
    np.testing.assert_allclose(found.reference, expected, atol=1e-12)


def beats(frequency, place):
    """Return what linear interpolation at each `place` makes of lines, over their mean, less 1."""
    later = np.exp(2j * np.pi * frequency)
    gain = (1.0 - place + place * later) / later**place
    return gain.real / gain.real.mean(axis=0) - 1.0


FREQUENCY = np.array([0.08, 0.16, 0.24, 0.32])
ORDER = 100.0 * FREQUENCY


def interpolator(radial):
    """Return the interpolator whose beat is certain, '' for none."""
    return find_beat(radial, np.arange(len(radial)), ORDER, FREQUENCY).method


def test_beat_is_found_among_other_changes_of_the_lines(rng):
    cycle = np.arange(600)[:, None]
    beat = beats(FREQUENCY, (0.0873 * cycle) % 1.0)
    # Another shaft's orders: every line beats for itself, and far more than by interpolation.
    others = 0.2 * np.cos(2.0 * np.pi * 0.239 * cycle + rng.uniform(0.0, 6.0, 4))
    noise = rng.normal(0.0, 1e-3, (600, 4))
    assert interpolator(others + noise) == ''
    assert interpolator(beat + others + noise) == 'linear'
    radial = beat + others + noise
    times = cycle[:, 0] / 25.0
    beating = radial - without_beat(radial, times, find_beat(radial, times, ORDER, FREQUENCY))
    wave = np.exp(-2j * np.pi * 0.0873 * cycle)
    assert np.abs((beating * wave).mean(axis=0)) == pytest.approx(
        np.abs((beat * wave).mean(axis=0)), rel=0.05, abs=1e-3)


def test_lines_that_beat_otherwise_were_not_interpolated(rng):
    cycle = np.arange(240)[:, None]
    beat = beats(FREQUENCY, (0.0873 * cycle) % 1.0)

    def method(radial):
        return interpolator(radial + rng.normal(0.0, 2e-4, beat.shape))

    assert method(beat) == 'linear'
    assert method(0.5 * beat) == ''  # not as deep
    assert method(beat[:, ::-1]) == ''  # not as the frequencies
    delay = np.array([0, 4, 7, 2])  # out of step
    assert method(np.stack([np.roll(row, n) for row, n in zip(beat.T, delay)], axis=1)) == ''


@pytest.mark.parametrize('turns', [0.2, 0.97, 1.0, 3.3, 4.6])
def test_a_beat_of_any_rate_is_found_while_the_speed_changes(rng, turns):
    parts = 16
    speed = 25.0 * (1.0 + 0.2 * np.sin(np.linspace(0.0, 2.0, 300 * parts)))  # cycles a second
    times = np.cumsum(1.0 / (parts * speed))
    radial = beats(FREQUENCY, (turns * 25.0 * times[:, None]) % 1.0)
    noise = rng.normal(0.0, 0.05, radial.shape)
    found = find_beat(radial + noise, times, ORDER, FREQUENCY)
    assert (found.method, found.frequency) == ('linear', pytest.approx(turns * 25.0, abs=0.05))
    assert find_beat(noise, times, ORDER, FREQUENCY).method == ''
    assert find_beat(2.0 * radial + noise, times, ORDER, FREQUENCY).method == ''
    some = radial[::parts] if turns < 0.5 else noise[::parts]
    left = without_beat(some, times[::parts], found)
    assert left.std() == pytest.approx(some.std() if turns > 0.5 else 0.0, rel=0.1, abs=0.01)


def test_a_sideband_of_one_order_is_no_beat(rng):
    cycle = np.arange(240)[:, None]
    beat = beats(FREQUENCY, (0.0873 * cycle) % 1.0)
    noise = rng.normal(0.0, 0.05, beat.shape)
    noise[:, -1] *= 0.1  # the other orders could not show it
    alone = np.where(np.arange(FREQUENCY.size) == FREQUENCY.size - 1, beat, 0.0)
    assert interpolator(alone + noise) == ''
    assert interpolator(beat + 0.1 * noise) == 'linear'


@pytest.mark.machines
def test_the_beat_is_found_among_lines_that_the_fit_takes_for_others():
    with stored(independent(11506, 'interpolation_loss')) as job:
        found = answer(**job)['report']
    assert [item['name'] for item in found['missing_effects']] == ['interpolation_loss']
    assert found['error_after']['rms'] < 0.2 * found['error_before']['rms']


def test_errors_within_ticks_are_separated_from_larger_ones(rng):
    clock = 4000.0
    grid = rng.uniform(-0.5, 0.5, (8, 21)) / clock
    recovered = grid - grid.mean(axis=1, keepdims=True) + rng.normal(0.0, 2e-6, grid.shape)
    small = np.full(grid.shape, 2e-6)
    assert ticks_leave_room(recovered, np.mean(small**2), clock)
    assert not ticks_leave_room(recovered + rng.normal(0.0, 0.2 / clock, grid.shape),
                                np.mean(small**2), clock)
    placed, beyond = placed_on_grid(recovered[0], clock)
    assert beyond < 0.02 / clock
    assert np.abs(placed).max() < 0.54 / clock
    slipped = recovered[0] + np.where(np.arange(21) == 7, 2.0 / clock, 0.0)
    assert np.abs(within_half_tick(slipped, clock)).max() < 0.75 / clock


@pytest.fixture
def quantised(rng):
    """Return a recording of one channel whose pulses a coarse clock rounded up, and its model."""
    seconds = 12 * CYCLES / SPEED + 0.2
    time = np.arange(round(seconds * RATE)) / RATE
    wander = sum(5e-4 * np.sin(2.0 * np.pi * f * time + p) / f for f, p in (
        (0.31, 0.4), (0.77, 2.0), (1.9, 5.0)))
    turns = SPEED * time + wander
    vibration = sum(size * np.cos(2.0 * np.pi * g * turns + g) for g, size in (
        (8.0, 1.0), (16.0, 0.8), (24.0, 0.6)))
    vibration = vibration + 0.02 * rng.standard_normal(time.size)
    clock = 710.0
    true = np.interp(np.arange(1, int(turns[-1])), turns, time)
    model = DeclaredModel(keyphasor_rate=clock, trigger_speed=SPEED, trigger_cycles=CYCLES,
                          orders=(8.0, 16.0, 24.0), noise_std=0.02, sample_rate=RATE)
    return Recording(ArraySource(vibration[None]), RATE,
                     pulse_times=np.ceil(true * clock) / clock), model


@pytest.mark.machines
def test_what_ticks_hide_of_the_motion_is_no_other_effect(quantised):
    """One channel: nothing predicts the motion within the ticks, and so nobody is to blame."""
    recording, model = quantised
    found = trace([observe(recording, model)], [recording])
    assert found.findings == ()
    assert [item.name for item in found.refinements] == ['keyphasor_quantisation']
    assert found.verdict == 'none'
    assert found.after.rms < 0.3 * found.as_declared.rms
    assert 0.2 < found.after.chi2_per_dof < 3.0


def test_ticks_that_tell_nothing_of_the_errors_are_left_out(quantised, rng):
    recording, model = quantised
    observation = observe(recording, model)
    bench = make_bench(observation, [observation], [recording], ())
    ticks = Finding('keyphasor_quantisation', make_effect(
        'keyphasor_quantisation', clock_rate=model.keyphasor_rate), {}, 0.0, '')
    refined, found, *_ = with_its_ticks(bench, [ticks], [])
    assert [item.name for item in found] == [ticks.name]
    assert [item.name for item in refined.declared] == [ticks.name]
    mixed = replace(bench, memory=Memory(), pulses=[[replace(
        item, errors=rng.permutation(item.errors)) for item in rows] for rows in bench.pulses])
    assert with_its_ticks(mixed, [ticks], []) == (mixed, [], [], [])


def test_loop_is_repeatable(quantised):
    recording, model = quantised
    first, second = (observe(recording, model).stacked('errors') for _ in range(2))
    np.testing.assert_array_equal(first, second)
    assert np.isfinite(first).all()


@pytest.mark.machines
def test_effect_that_leaves_nearly_all_is_not_named(rng):
    """A scatter far beyond all noise is not blamed on a little more noise."""
    seconds = 12 * CYCLES / SPEED + 0.2
    time = np.arange(round(seconds * RATE)) / RATE
    step = np.repeat(rng.choice([0.6, 1.4], math.ceil(seconds / 0.9)), round(0.9 * RATE))
    vibration = sum(size * np.cos(2.0 * np.pi * g * SPEED * time + g) * step[:time.size] ** sign
                    for g, size, sign in ((8.0, 1.0, 1), (16.0, 0.8, -1), (24.0, 0.6, 1)))
    vibration = vibration + 0.5 * rng.standard_normal(time.size)
    pulses = np.arange(1, int(SPEED * time[-1])) / SPEED
    pulses = pulses + rng.uniform(-0.5, 0.5, pulses.size) / 4000.0
    model = DeclaredModel(keyphasor_rate=4000.0, trigger_speed=SPEED, trigger_cycles=CYCLES,
                          orders=(8.0, 16.0, 24.0), noise_std=0.4, sample_rate=RATE)
    recording = Recording(ArraySource(vibration[None]), RATE, pulse_times=pulses)
    found = trace([observe(recording, model)], [recording])
    assert not found.findings
    assert found.verdict == 'unexplained'
    assert found.after.chi2_per_dof > 10.0
