# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Pulse errors and lines of whole recordings, against the truth of another simulator."""

from functools import cache

from independent_effects import draw_case
import numpy as np
import pytest
import record_recovery
from sa_jitter_ros.inference.cycle_states import independent_power
from sa_jitter_ros.inference.record_fit import OpenRecord

fitted = cache(record_recovery.fitted)


@pytest.mark.machines
@pytest.mark.parametrize(('names', 'seed'), [
    ((), 203), (('target_geometry',), 200), (('interfering_tone',), 200),
    (('missing_pulses',), 201), (('speed_fluctuation',), 223)])
def test_errors_are_as_wrong_as_their_standard_errors_say(names, seed):
    run = fitted(names, seed)
    inner = slice(2, -2)  # half as much vibration tells the outermost pulses
    z = (run.wrong / run.fit.standard_errors)[inner]
    z = z[np.isfinite(z)]
    # the mean of z^2 of about as many independent values as pulses
    assert np.sqrt(np.mean(z**2)) == pytest.approx(1.0, abs=4.0 / np.sqrt(2.0 * z.size) + 0.15)
    size = np.nanstd(run.true)
    assert np.nanstd(run.wrong) < 0.2 * size
    assert run.fit.jitter_std == pytest.approx(size, rel=4.0 / np.sqrt(2.0 * z.size) + 0.05)


@pytest.mark.machines
@pytest.mark.parametrize('seed', [210, 213])
def test_undeclared_orders_are_found_and_none_is_made_up(seed):
    run = fitted((), seed)
    assert np.all(run.near.min(axis=1) < 0.5)
    # what is not found is below what would matter
    missed = run.undeclared[run.near.min(axis=0) > 0.5]
    lost = np.abs(run.machine.peaks[:, np.isin(np.round(run.machine.components, 9), missed)])
    assert not lost.size or lost.max() < 0.05 * np.abs(run.machine.peaks).max()
    assert run.fit.tones.size == 0


@pytest.mark.machines
def test_a_tone_is_no_order():
    run = fitted(('interfering_tone',), 201)
    true = draw_case(('interfering_tone',), 201).what.tone[0]
    resolved = 1.0 / (run.machine.average * run.machine.acquisitions)
    assert run.fit.tones == pytest.approx([true], abs=0.1 * resolved)


@pytest.mark.machines
def test_a_speed_that_moves_inside_the_cycle_is_found_as_such():
    run = fitted(('speed_fluctuation',), 223)
    assert np.std(run.fit.bends[:, 0]) > 5.0 * run.fit.bend_standard_errors[0]
    assert np.std(run.wrong) < 0.2 * np.std(run.true)


def steady(rng, count=60, rate=5000.0, speed=25.0, noise=0.02):
    """Return a steady machine's vibration, and its pulses with errors."""
    time = np.arange(int((count + 2) / speed * rate)) / rate
    vibration = sum(size * np.cos(2.0 * np.pi * g * speed * time)
                    for g, size in ((8.0, 1.0), (16.0, 0.7), (24.0, 0.5)))
    errors = rng.normal(0.0, 5e-5, count)
    times = (np.arange(count) + 0.5) / speed + errors
    return (vibration + noise * rng.standard_normal(time.size))[:, None], times, errors


def test_without_noise_nothing_is_made_up(rng):
    samples, times, errors = steady(rng, noise=0.0)
    found = OpenRecord(samples, 5000.0, 0.0, times, measured=np.ones(times.size, bool),
                       cycle_length=1.0, orders=[8.0, 16.0, 24.0], jitter_std=5e-5).fit()
    assert found.orders.tolist() == [8.0, 16.0, 24.0]
    wrong = found.errors - errors
    assert wrong[1:-1] == pytest.approx(wrong.mean(), abs=1e-8)  # half as much tells the ends


@pytest.mark.parametrize('noise', [0.02, 0.5, 1.0])
@pytest.mark.parametrize('size', [0.2, 1.0, 5.0, 100.0])
def test_the_declared_size_hardly_matters(rng, size, noise):
    samples, times, errors = steady(rng, noise=noise)
    found = OpenRecord(samples, 5000.0, 0.0, times, measured=np.ones(times.size, bool),
                       cycle_length=1.0, orders=[8.0, 16.0, 24.0], jitter_std=5e-5 / size).fit()
    wrong = found.errors - (errors - errors.mean())
    assert np.sqrt(np.mean((wrong / found.standard_errors) ** 2)) == pytest.approx(
        1.0, abs=4.0 / np.sqrt(2.0 * times.size))
    power = 1.0 + np.mean(found.standard_errors**2) / 5e-5**2  # of errors and their noise
    assert found.jitter_std == pytest.approx(5e-5, rel=4.0 * power / np.sqrt(2.0 * times.size))


@pytest.mark.parametrize('size', [1.0, 100.0])
def test_errors_are_hardly_shrunk_however_little_shows_of_them(rng, size):
    samples, times, errors = steady(rng, noise=4.0)
    found = OpenRecord(samples, 5000.0, 0.0, times, measured=np.ones(times.size, bool),
                       cycle_length=1.0, orders=[8.0, 16.0, 24.0], jitter_std=5e-5 / size).fit()
    wrong = found.errors - (errors - errors.mean())
    assert np.sqrt(np.mean((wrong / found.standard_errors) ** 2)) == pytest.approx(
        1.0, abs=4.0 / np.sqrt(2.0 * times.size))
    assert found.expected_std[0] > 2.0 * np.median(found.standard_errors)


def coloured(noise, power):
    """Return noise (sample, 1) whose power grows with a power of the frequency, as strong."""
    waves = np.fft.rfft(noise, axis=0)
    waves *= np.maximum(np.arange(len(waves)), 1.0)[:, None] ** (0.5 * power)
    found = np.fft.irfft(waves, len(noise), axis=0)
    return found * np.std(noise) / np.std(found)


@pytest.mark.parametrize('power', [-1.0, 0.0, 2.0])
@pytest.mark.parametrize('noise', [0.5, 4.0])
def test_noise_counts_as_it_is_at_the_lines(rng, power, noise):
    """Noise that grows with frequency is less there than in the band that is read, or more."""
    samples, times, errors = steady(rng, count=300, noise=0.0)
    samples = samples + noise * coloured(rng.standard_normal(samples.shape), power)
    found = OpenRecord(samples, 5000.0, 0.0, times, measured=np.ones(times.size, bool),
                       cycle_length=1.0, orders=[8.0, 16.0, 24.0], jitter_std=5e-5).fit()
    z = ((found.errors - (errors - errors.mean())) / found.standard_errors)[2:-2]
    assert np.sqrt(np.mean(z**2)) == pytest.approx(1.0, abs=4.0 / np.sqrt(2.0 * z.size) + 0.1)


@pytest.mark.parametrize('slope', [0.0, 3e-4, -9e-4])
@pytest.mark.parametrize('noise', [2.0, 8.0])
def test_a_trend_shows_where_no_single_error_does(rng, noise, slope):
    """A clock is told from errors of 1 us of which the vibration shows each to 20 us or more."""
    samples, times, _ = steady(rng, count=200, noise=noise)
    times = times + slope * times
    found = OpenRecord(samples, 5000.0, 0.0, times, measured=np.ones(times.size, bool),
                       cycle_length=1.0, orders=[8.0, 16.0, 24.0], jitter_std=1e-6).fit()
    assert np.median(found.standard_errors) > 20e-6
    # of a straight line through errors with independent noise
    error = np.sqrt(12.0 / times.size) * np.median(found.standard_errors) / np.ptp(times)
    fitted_slope = np.polyfit(times, found.errors, 1)[0]
    assert fitted_slope == pytest.approx(slope, abs=4.0 * error)


def test_a_shaft_that_runs_up_lets_pulses_err_no_more():
    """A speed that doubles in 80 cycles makes second differences of 0.1 ms, and no errors."""
    turns = np.arange(80.0)
    times = 20.0 * (np.sqrt(1.0 + turns / 100.0) - 1.0)
    assert np.sqrt(independent_power(np.diff(times, 3))) < 2e-6
    jitter = np.random.default_rng(1).normal(0.0, 5e-5, 80)
    power = independent_power(np.diff(times + jitter, 3))
    assert np.sqrt(power) == pytest.approx(5e-5, rel=4.0 / np.sqrt(80.0))


@pytest.mark.machines
@pytest.mark.parametrize('seed', [201, 203])
def test_a_tone_has_the_errors_that_it_states(seed):
    run = fitted(('interfering_tone',), seed)
    frequency, amplitude = draw_case(('interfering_tone',), seed).what.tone
    assert run.fit.tones.size == 1
    errors = run.fit.amplitude_errors[:, -1]
    z = (np.abs(run.fit.amplitudes[:, -1]) - amplitude) / errors
    assert np.all(np.abs(z) < 4.0)
    duration = run.machine.average * run.machine.acquisitions
    # of a line that begins and ends, by the least error of its phase on any channel
    least = np.sqrt(12.0) * (errors / amplitude).min() / (2.0 * np.pi * duration)
    assert abs(run.fit.tones[0] - frequency) < 4.0 * least


def test_sidebands_turn_with_those_of_their_spacing(rng):
    """On a steady machine, beside three lines 0.37 orders away, and alone at 0.37."""
    count, rate, speed = 300, 2000.0, 20.0
    time = np.arange(int((count + 2) / speed * rate)) / rate
    others = [8.37, 15.63, 24.37, 0.37, 11.21]
    vibration = sum(size * np.cos(2.0 * np.pi * order * speed * time + order) for order, size
                    in zip([8.0, 16.0, 24.0, *others], [1.0, 0.7, 0.5] + [0.1] * 5))
    found = OpenRecord((vibration + 0.02 * rng.standard_normal(time.size))[:, None], rate, 0.0,
                       (np.arange(count) + 0.5) / speed + rng.normal(0.0, 5e-5, count),
                       measured=np.ones(count, bool), cycle_length=1.0, orders=[8.0, 16.0, 24.0],
                       jitter_std=5e-5).fit()
    lines = np.append(found.orders, found.tones / speed)
    turning = {other: found.synchronous[np.argmin(np.abs(lines - other))] for other in others}
    assert [other for other, turns in turning.items() if not turns] == [11.21]


@pytest.mark.parametrize('memory', [0.0, 0.9])
def test_errors_of_more_than_half_a_turn_are_found(rng, memory):
    """Where steps alone would end at a place that fits as badly as any near it."""
    count, rate, speed, size = 600, 4000.0, 25.0, 4e-4  # 0.24 turns of order 24
    errors = rng.standard_normal(count)
    for k in range(1, count):
        errors[k] = memory * errors[k - 1] + np.sqrt(1.0 - memory**2) * errors[k]
    errors *= size
    assert np.abs(errors).max() > 0.5 / (24.0 * speed)
    time = np.arange(int((count + 2) / speed * rate)) / rate
    vibration = sum(size * np.cos(2.0 * np.pi * g * speed * time)
                    for g, size in ((8.0, 0.3), (12.0, 0.3), (24.0, 1.0)))
    found = OpenRecord((vibration + 0.05 * rng.standard_normal(time.size))[:, None], rate, 0.0,
                       (np.arange(count) + 0.5) / speed + errors,
                       measured=np.ones(count, bool), cycle_length=1.0, orders=[8.0, 12.0, 24.0],
                       jitter_std=5e-5).fit()
    wrong = (found.errors - errors)[2:-2]
    z = (wrong - wrong.mean()) / found.standard_errors[2:-2]
    assert np.abs(z).max() < 6.0
    assert found.orders.size == 3
    assert found.tones.size == 0


def foreign_shaft(rng, *, varying):
    """Return a steady machine's vibration, pulses and errors, beside a shaft of its own speed."""
    count, rate, speed = 700, 4000.0, 25.0
    samples, times, errors = steady(rng, count=count, rate=rate, speed=speed)
    time = np.arange(len(samples)) / rate
    turns = 60.6 * time + varying * 60.6 / (2.0 * np.pi * 0.05) * np.sin(2.0 * np.pi * 0.05 * time)
    for order, size in ((1, 0.3), (2, 0.3), (3, 0.3), (5, 0.4)):
        samples[:, 0] += size * np.cos(2.0 * np.pi * order * turns + order)
    sides = [7.0, 9.0, 15.0, 17.0, 23.0, 25.0]
    for order in sides:
        samples[:, 0] += 0.05 * np.cos(2.0 * np.pi * order * speed * time + order)
    return samples, rate, times, errors, sides


@pytest.mark.machines
@pytest.mark.parametrize('varying', [0.0, 1.5e-3])
def test_a_foreign_shaft_hides_no_lines_and_tells_no_errors(rng, varying):
    """What is left beside its strong lines must not end the search for others."""
    samples, rate, times, errors, sides = foreign_shaft(rng, varying=varying)
    found = OpenRecord(samples, rate, 0.0, times, measured=np.ones(times.size, bool),
                       cycle_length=1.0, orders=[8.0, 16.0, 24.0], jitter_std=5e-5).fit()
    assert np.all(np.abs(found.orders[:, None] - sides).min(axis=0) < 1e-3)
    wrong = (found.errors - errors)[2:-2]
    z = (wrong - wrong.mean()) / found.standard_errors[2:-2]
    assert np.sqrt(np.mean(z**2)) < 1.0 + 4.0 / np.sqrt(2.0 * z.size)  # less far from the shaft
    assert np.std(wrong) < 0.5 * np.std(errors)
    own = np.append(found.orders, found.tones / 25.0)
    foreign = np.abs(own[:, None] - 60.6 / 25.0 * np.array([1, 2, 3, 5])).min(axis=1) < 0.04
    assert foreign.sum() >= 4
    assert not found.synchronous[foreign].any()


def test_sidebands_that_do_not_change_are_no_bend_of_all_cycles(rng):
    """A bend that all cycles share would take the place of sidebands that are not looked for."""
    speed, rate, count = 9.0, 2300.0, 150
    lines = {25: 0.27, 26: 0.8, 27: 0.22, 28: 0.08, 50: 0.1, 51: 0.35, 52: 4.3, 53: 1.2, 54: 0.33,
             77: 0.07, 78: 0.33, 79: 0.1}
    phases = rng.uniform(0.0, 2.0 * np.pi, len(lines))
    time = np.arange(int((count + 2) / speed * rate)) / rate
    turns = speed * time + 0.05 * np.sin(2.0 * np.pi * 0.3 * time)
    vibration = sum(size * np.cos(2.0 * np.pi * order * turns + phase)
                    for (order, size), phase in zip(lines.items(), phases))
    times = np.interp(np.arange(count) + 0.5, turns, time) + rng.normal(0.0, 5e-5, count)
    declared = [25, 27, 52, 53, 78]
    found = OpenRecord((vibration + 0.05 * rng.standard_normal(time.size))[:, None], rate, 0.0,
                       times, measured=np.ones(count, bool), cycle_length=1.0, orders=declared,
                       jitter_std=5e-5).fit((np.zeros(0), np.zeros(0)))
    wrong = np.abs(found.amplitudes[0, :5]) - [lines[order] for order in declared]
    assert np.all(np.abs(wrong) < 4.0 * found.amplitude_errors[0, :5])


def test_declared_lines_alone_tell_how_fast_the_angle_runs(rng):
    """The orders of the others are free, and follow a clock that is wrong by 2e-4."""
    speed, rate, count, skew = 14.0, 2200.0, 800, -2e-4
    lines = {13: 1.0, 27: 0.3, 12: 0.4, 14: 0.3, 15: 0.2, 25: 0.4, 26: 1.5, 1: 0.3, 2: 0.2,
             18.18: 0.6, 19.04: 0.3}
    phases = rng.uniform(0.0, 2.0 * np.pi, len(lines))
    time = np.arange(int((count + 2) / speed * rate)) / rate
    turns = speed * time + 0.05 * np.sin(2.0 * np.pi * 0.1 * time)
    vibration = sum(size * np.cos(2.0 * np.pi * order * turns + phase)
                    for (order, size), phase in zip(lines.items(), phases))
    true = np.interp(np.arange(count) + 0.5, turns, time)
    times = true * (1.0 + skew) + rng.normal(0.0, 2e-5, count)
    found = OpenRecord((vibration + 0.5 * rng.standard_normal(time.size))[:, None], rate, 0.0,
                       times, measured=np.ones(count, bool), cycle_length=1.0,
                       orders=[13, 27], jitter_std=2e-5).fit()
    assert np.polyfit(times, found.errors, 1)[0] == pytest.approx(skew, rel=0.005)


@pytest.mark.parametrize('swing', [3e-6, 1e-5, 3e-4, 3e-3])
def test_a_tone_near_an_order_is_one_tone_of_the_right_numbers(rng, swing):
    """The steadier the speed, the more a tone looks like an order, or several of them."""
    speed, rate, count, tone = 10.0, 2000.0, 300, 249.9
    time = np.arange(int((count + 2) / speed * rate)) / rate
    slow = time[-1] / (2.0 * np.pi) * np.cos(2.0 * np.pi * time / time[-1])
    turns = speed * (time + swing * slow)
    samples = sum(size * np.cos(2.0 * np.pi * order * turns + order)
                  for order, size in ((20.0, 0.5), (21.0, 1.8), (25.0, 0.9), (42.0, 2.3)))
    samples += 0.3 * np.cos(2.0 * np.pi * tone * time + 1.0)
    samples += 0.05 * rng.standard_normal(time.size)
    times = np.interp(np.arange(turns[0] + 0.5, turns[-1] - 0.5), turns, time)
    times += rng.normal(0.0, 5e-5, times.size)
    found = OpenRecord(samples[:, None], rate, 0.0, times, measured=np.ones(times.size, bool),
                       cycle_length=1.0, orders=[20.0, 21.0, 25.0, 42.0], jitter_std=5e-5).fit()
    assert found.orders.size == 4
    error, amplitude = found.amplitude_errors[0, 4], np.abs(found.amplitudes[0, 4:])
    unsure = np.sqrt(12.0) * error / amplitude / (2.0 * np.pi * np.ptp(times))
    assert found.tones == pytest.approx([tone], abs=4.0 * unsure[0])
    assert amplitude == pytest.approx([0.3], abs=4.0 * error)


@pytest.mark.machines
@pytest.mark.parametrize('seed', [0, 3, 4])
def test_a_strong_tone_of_the_supply_leads_no_error_astray(seed):
    """It beats the shaft slowly, and the sidebands that a converter makes are as far from it."""
    rng = np.random.default_rng(seed)
    rate, speed, supply = 2500.0, 24.55, 100.0
    time = np.arange(int(40.0 * rate)) / rate
    waves, phases = rng.uniform(0.02, 0.2, (30, 1)), rng.uniform(0.0, 2.0 * np.pi, (30, 1))
    swing = np.sqrt(2.0 / waves.size) * 3e-4 * np.sin(2.0 * np.pi * waves * time + phases)
    turns = speed * (time + np.sum(swing / (2.0 * np.pi * waves), axis=0))
    samples = 0.2 * rng.standard_normal(time.size)
    for order, size in ((1.0, 1.0), (36.0, 0.6)):
        samples += size * np.cos(2.0 * np.pi * order * turns + order)
    for tone, size in ((supply, 1.0), (36.0 * speed - supply, 0.3), (36.0 * speed + supply, 0.3)):
        samples += size * np.cos(2.0 * np.pi * tone * time)
    times = np.interp(np.arange(turns[0] + 1.5, turns[-1] - 1.5), turns, time)
    errors = rng.normal(0.0, 7e-5, times.size)
    found = OpenRecord(samples[:, None], rate, 0.0, times + errors,
                       measured=np.ones(times.size, bool), cycle_length=1.0, orders=[1.0, 36.0],
                       jitter_std=7e-5).fit()
    z = (found.errors - (errors - errors.mean())) / found.standard_errors
    assert np.sqrt(np.mean(z**2)) == pytest.approx(1.0, abs=4.0 / np.sqrt(2.0 * z.size))
    assert np.abs(found.tones - supply).min() < 0.01


@pytest.mark.parametrize('swing', [0.02, 0.05, 0.1])
def test_a_tone_that_the_speed_spreads_over_several_orders_is_one_tone(rng, swing):
    """Over angle it is a line with sidebands, none of which a tone beside the others explains."""
    speed, rate, tone = 40.0, 2000.0, 40.6
    time = np.arange(int(20.0 * rate)) / rate
    turns = speed * time + sum(
        swing * np.sin(2.0 * np.pi * wave * time + wave) for wave in (0.07, 0.18))
    samples = sum(size * np.cos(2.0 * np.pi * order * turns + order)
                  for order, size in ((1.0, 1.8), (8.0, 0.6), (16.0, 1.7)))
    samples += 0.15 * np.cos(2.0 * np.pi * tone * time + 1.0)
    samples += 0.02 * rng.standard_normal(time.size)
    times = np.interp(np.arange(turns[0] + 1.5, turns[-1] - 1.5), turns, time)
    times += rng.normal(0.0, 2e-5, times.size)
    found = OpenRecord(samples[:, None], rate, 0.0, times, measured=np.ones(times.size, bool),
                       cycle_length=1.0, orders=[1.0, 8.0, 16.0], jitter_std=2e-5).fit()
    assert found.orders.size == 3
    assert found.tones == pytest.approx([tone], abs=1e-3)
    error = found.amplitude_errors[0, 3]
    assert np.abs(found.amplitudes[0, 3:]) == pytest.approx([0.15], abs=4.0 * error)


@pytest.mark.parametrize('wave', [0.01, 0.02, 0.035, 0.05, 0.08])
def test_a_speed_that_swings_as_one_wave_makes_bends_and_no_sidebands(rng, wave):
    """The curve that it makes in every cycle repeats with the turns of the swing and the shaft."""
    speed, rate, count = 30.0, 3000.0, 500
    time = np.arange(int((count + 3) / speed * rate)) / rate
    size = 2e-3 / (2.0 * np.pi * wave) ** 2  # turns: a curve of 2e-3 in every cycle
    turns = speed * time + size * np.sin(2.0 * np.pi * wave * speed * time)
    samples = sum(level * np.cos(2.0 * np.pi * order * turns + order)
                  for order, level in ((9.0, 1.0), (24.0, 2.0), (36.0, 1.0)))
    samples += 0.03 * rng.standard_normal(time.size)
    times = np.interp(np.arange(count) + 1.5, turns, time)
    errors = rng.normal(0.0, 1e-3 / speed, count)
    found = OpenRecord(samples[:, None], rate, 0.0, times + errors,
                       measured=np.ones(count, bool), cycle_length=1.0,
                       orders=[9.0, 24.0, 36.0], jitter_std=1e-3 / speed).fit()
    sides = np.abs(found.orders[3:, None] - found.orders[:3])
    assert not np.any(np.abs(sides - 1.0) < 1.5 * wave)
    z = (found.errors - (errors - errors.mean())) / found.standard_errors
    assert np.sqrt(np.mean(z**2)) == pytest.approx(1.0, abs=0.2)
    middle = np.interp(np.arange(count - 1) + 2.0, turns, time)
    bends = 4.0 * (0.5 * (times[1:] + times[:-1]) - middle)  # of u (1 - u), at its middle
    off = found.bends[2:-2, 0] - (bends - bends.mean())[2:-2]
    assert np.std(off) < 0.3 * np.std(bends)


@pytest.mark.machines
@pytest.mark.parametrize('seed', range(6))
def test_sidebands_are_no_pulse_errors_that_swing(seed):
    """Errors that swing as fast, or at an alias, make lines at the same places, and others."""
    rng = np.random.default_rng([38, seed])
    cycle, rate, speed, count = rng.uniform(0.5, 1.0), 6400.0, 25.0, 300
    mesh = float(rng.integers(15, 30))
    offset = np.cumsum(rng.uniform(0.3, 0.7, 2))
    sides = np.add.outer([mesh, 2.0 * mesh], [*offset, *-offset]).ravel()
    time = np.arange(int((count + 2) * cycle / speed * rate)) / rate
    vibration = sum(size * np.cos(2.0 * np.pi * (g * speed * time + rng.uniform()))
                    for g, size in [(mesh, 1.0), (2.0 * mesh, 0.7),
                                    *zip(sides, rng.uniform(0.02, 0.2, sides.size))])
    errors = rng.normal(0.0, 2e-5, count)
    times = (np.arange(count) + 0.5) * cycle / speed + errors
    found = OpenRecord((vibration + 0.02 * rng.standard_normal(time.size))[:, None], rate, 0.0,
                       times, measured=np.ones(count, bool), cycle_length=cycle,
                       orders=[mesh, 2.0 * mesh], jitter_std=2e-5).fit()
    wrong = (found.errors - errors)[2:-2]
    z = (wrong - wrong.mean()) / found.standard_errors[2:-2]
    assert np.sqrt(np.mean(z**2)) == pytest.approx(1.0, abs=4.0 / np.sqrt(2.0 * z.size) + 0.1)
    near = np.abs(found.orders[2:, None] - sides) * cycle * count
    assert near.min(axis=0).max() < 0.5
    made_up = np.abs(found.amplitudes[0, 2:found.orders.size])[near.min(axis=1) > 0.5]
    assert np.all(made_up < 0.01)
