# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Averages with corrected pulses, through the streaming averager."""

import numpy as np
import pytest
import sa_jitter_ros as sa
from sa_jitter_ros.averaging.average import AverageSettings
from sa_jitter_ros.averaging.cycle import cycle_grid
from sa_jitter_ros.averaging.streaming import StreamingAverager
from sa_jitter_ros.averaging.timeline import VibrationTimeline
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.pulses.validation import PulseValidator
from sa_jitter_ros.samples import SampleBlock
from sa_jitter_ros.simulation import AdditiveNoise, DeclaredJitter, Gearbox, mesh

RATE, SPEED, CLOCK, CYCLES = 20000.0, 20.0, 3000.0, 40
ORDERS = (19.0, 38.0)
AMPLITUDES = {19.0: 1.0, 38.0: 0.5}


def averages_of(machine, *, ratio=1.0, seconds=6.2, orders=ORDERS, correct_jitter=True, **options):
    """Averages of a simulated machine, with corrections unless these are not wanted."""
    settings = AverageSettings(cycle_length=ratio, trigger_cycles=CYCLES, orders=orders,
                               correct_jitter=correct_jitter, keyphasor_rate=CLOCK, **options)
    averager = StreamingAverager({'shaft': settings}, validator=PulseValidator(),
                                 timeline=VibrationTimeline(buffer_seconds=2.0 * seconds))
    averager.add_pulses(machine.pulses(0.0, seconds).times)
    samples = machine.vibration(0, round(seconds * RATE))
    return [average for _, average in averager.add_samples(SampleBlock(samples, 0.0, RATE, 0))]


def gearbox(ratio, noise, harmonics=(1.0, 0.5), seed=5):
    """Return a gear of 19 teeth whose keyphasor is sampled at `CLOCK`."""
    return Gearbox(
        mesh('shaft', 19, harmonics=harmonics, channel_gains=(1.0, 0.7), seed=seed), RATE,
        shafts={'shaft': ratio}, speed=((0.0, SPEED),), seed=seed,
        effects=(DeclaredJitter('uniform', 1.0 / np.sqrt(12.0) / CLOCK), AdditiveNoise(noise)))


@pytest.mark.machines
@pytest.mark.parametrize('ratio', [1.0, 2.0, 2.40789])
@pytest.mark.parametrize('law', ['linear', 'quadratic', 'spline'])
def test_amplitudes_come_back_and_errors_are_found(ratio, law):
    machine = gearbox(ratio, noise=0.3)
    found = averages_of(machine, ratio=ratio, angle_law=law)
    assert len(found) == 2 if law == 'spline' else 3
    pulses = machine.pulses(0.0, 6.2)
    true = dict(zip(pulses.times.tolist(), pulses.errors.tolist()))
    for average in found:
        correction = average.correction
        assert correction.accepted
        scale = np.array([[1.0], [0.7]])
        wanted = scale * np.array([AMPLITUDES[order] for order in ORDERS])
        # the noise of an amplitude, and what errors that are not known exactly leave of it
        errors = np.array([true[time] for time in average.pulses.tolist()])
        remaining = correction.pulse_errors - (errors - errors.mean())
        angle = 2.0 * np.pi * np.array(ORDERS) * ratio * SPEED * remaining.std()
        np.testing.assert_array_less(
            np.abs(np.abs(correction.amplitudes) - wanted),
            4.0 * correction.noise + wanted * angle**2 + 1e-3)
        np.testing.assert_array_less(np.abs(average.amplitudes), wanted * 1.01)
        assert remaining.std() < 0.1 / CLOCK
        np.testing.assert_allclose(
            correction.attenuation,
            np.abs(average.amplitudes) / np.abs(correction.amplitudes))


@pytest.mark.machines
def test_later_averages_whose_cycles_leak_are_as_near_as_the_first():
    """With r = 0.3137 the second and third average begin at other angles of the shaft."""
    found = averages_of(gearbox(0.3137, noise=0.05), ratio=0.3137, seconds=6.6)
    assert len(found) >= 3
    error = np.array([item.correction.amplitude_errors.amplitude for item in found])
    raw = np.array([item.amplitude_errors.amplitude for item in found])
    off = np.array([np.abs(item.correction.amplitudes) for item in found]) - np.outer(
        (1.0, 0.7), tuple(AMPLITUDES.values()))
    assert np.all(np.abs(off) < 4.5 * error)
    assert np.all(error < 1.8 * error[0])
    assert np.all(raw < 2.0 * raw[0])


@pytest.mark.machines
def test_attenuation_is_that_of_the_noiseless_machine_within_its_error():
    ratio = 2.40789
    noisy = averages_of(gearbox(ratio, noise=1.0), ratio=ratio, seconds=30.0)
    clean = averages_of(gearbox(ratio, noise=0.0), ratio=ratio, seconds=30.0,
                        correct_jitter=False)
    z = []
    for average, truth in zip(noisy, clean, strict=True):
        exact = np.abs(truth.amplitudes) / np.array([[1.0], [0.7]]) / [
            AMPLITUDES[order] for order in ORDERS]
        z.append((average.correction.attenuation - exact)
                 / average.correction.attenuation_standard_error)
    assert len(z) == 14
    # 56 values; pulse errors that are not known exactly add some to the stated error
    assert 0.6 < np.std(z) < 1.6


@pytest.mark.machines
def test_attenuation_of_weak_and_absent_orders_has_a_standard_error_that_holds():
    """Order 24 is not there, 27 stands 6 dB above the noise of the average, 19 20 dB."""
    orders, size = np.array([19.0, 24.0, 27.0]), np.array([1.0, 0.0, 0.2])
    rng, rate = np.random.default_rng(6), 3200.0
    times, true = np.arange(round(44 / SPEED * rate)) / rate, (2.0 + np.arange(41)) / SPEED
    wave = np.exp(2j * np.pi * SPEED * np.outer(orders, times - true[0]))
    u, z, raised = (np.arange(8) + 0.5) / 8.0, [], []
    trials = 40
    for _ in range(trials):
        phase = np.exp(2j * np.pi * rng.uniform(size=3))
        samples = ((size * phase) @ wave).real + 2.0 * rng.standard_normal(times.size)
        errors = rng.uniform(-0.5, 0.5, 41) / 1100.0
        average, = sa.average(samples, rate, true + errors, orders=orders, trigger_cycles=40,
                              correct_jitter=True, keyphasor_rate=1100.0)
        path = SPEED * (np.outer(errors[:-1], 1.0 - u) + np.outer(errors[1:], u))
        turned = np.exp(2j * np.pi * orders[:, None, None] * path).mean(axis=(1, 2))
        correction = average.correction
        assert correction.accepted
        z.append((correction.attenuation[0] - np.abs(turned))
                 / correction.attenuation_standard_error[0])
        raised.append(np.abs([correction.amplitudes[0], average.amplitudes[0]]) ** 2)
    inside = np.mean(np.abs(z) < 1.96, axis=0)
    assert np.all(inside > 0.95 - 3.0 * np.sqrt(0.05 * 0.95 / trials))
    # noise is not aligned to itself
    corrected, raw = np.array(raised)[:, :, 1].T
    change = corrected - raw
    assert change.mean() < 0.02 * raw.mean() + 3.0 * change.std() / np.sqrt(trials)


@pytest.mark.machines
def test_attenuation_of_five_cycles_has_a_standard_error_that_holds():
    orders, size, cycles, trials = np.array([8.0, 16.0, 32.0]), np.array([0.5, 1.0, 0.3]), 5, 60
    rng, rate, std = np.random.default_rng(8), 160.0 * SPEED, 0.3 / (2.0 * np.pi * 16.0 * SPEED)
    times, true = np.arange(1920) / rate, (2.0 + np.arange(9)) / SPEED
    wave = np.exp(2j * np.pi * SPEED * np.outer(orders, times - true[0]))
    settings = {'orders': orders, 'trigger_cycles': cycles, 'interval_tolerance': 0.45}
    z = []
    for _ in range(trials):
        clean = ((size * np.exp(2j * np.pi * rng.uniform(size=3))) @ wave).real
        noisy = clean + 0.14 * rng.standard_normal(times.size)
        pulses = true + np.sqrt(3.0) * std * rng.uniform(-1.0, 1.0, true.size)
        exact, *_ = sa.average(clean, rate, pulses, **settings)
        average, *_ = sa.average(noisy, rate, pulses, correct_jitter=True,
                                 keyphasor_rate=1.0 / (np.sqrt(12.0) * std), **settings)
        correction = average.correction
        assert correction.accepted
        z.append((correction.attenuation[0] - np.abs(exact.amplitudes[0]) / size)
                 / correction.attenuation_standard_error[0])
    for width, wanted in ((1.0, 0.683), (1.96, 0.95)):
        error = np.sqrt(wanted * (1.0 - wanted) / np.size(z))
        assert np.mean(np.abs(z) < width) == pytest.approx(wanted, abs=0.03 + 3.0 * error)


@pytest.mark.machines
def test_noise_does_not_raise_what_errors_leave_uncertain():
    found = averages_of(gearbox(2.40789, noise=6.0), ratio=2.40789, seconds=40.0)
    raw, corrected = (np.abs([item.amplitudes[0] for item in items]) for items in (
        found, [average.correction for average in found]))
    assert sum(average.correction.accepted for average in found) > 10
    true = np.array([AMPLITUDES[order] for order in ORDERS])
    error = corrected.std(axis=0) / np.sqrt(len(found))
    assert abs(corrected[:, 0].mean() - 1.0) < 3.5 * error[0]
    assert np.all(corrected.mean(axis=0) < true + 3.5 * error)
    assert np.all(np.mean((corrected - true) ** 2, axis=0) < np.mean((raw - true) ** 2, axis=0))


def test_order_whose_phase_the_errors_do_not_tell_is_not_corrected():
    machine = gearbox(2.40789, noise=6.0)
    found = averages_of(machine, ratio=2.40789, seconds=10.0, orders=(19.0, 38.0, 152.0))
    accepted = [average.correction for average in found if average.correction.accepted]
    assert len(accepted) > 2
    for correction in accepted:
        assert np.isfinite(correction.amplitudes[:, :2]).all()
        assert np.isnan(correction.amplitudes[:, 2]).all()
        np.testing.assert_array_equal(np.isnan(correction.attenuation),
                                      np.isnan(correction.amplitudes))


def test_noise_alone_is_not_changed():
    machine = gearbox(1.0, noise=1.0, harmonics=(0.0, 0.0))
    for average in averages_of(machine):
        correction = average.correction
        assert not correction.accepted
        assert correction.reason
        assert correction.refitted == 0
        np.testing.assert_array_equal(
            correction.waveform, average.waveform)


def test_a_declared_order_that_is_no_integer_tells_the_errors(rng):
    rate, speed = 6400.0, 25.0
    true = 0.01 + np.arange(32) / speed
    pulses = true + rng.uniform(-0.5, 0.5, 32) / rate
    times = np.arange(round(32.5 / speed * rate)) / rate
    samples = np.cos(2.0 * np.pi * 40.5 * speed * (times - 0.01))
    averager = StreamingAverager(
        {'shaft': AverageSettings(trigger_cycles=30, orders=(40.5,), correct_jitter=True,
                                  keyphasor_rate=rate)},
        validator=PulseValidator(), timeline=VibrationTimeline())
    averager.add_pulses(pulses)
    (_, average), = averager.add_samples(SampleBlock(
        (samples + 0.01 * rng.standard_normal(len(samples)))[None], 0.0, rate, 0))
    correction = average.correction
    assert correction.accepted
    errors = (pulses - true)[:31]
    apart = (correction.pulse_errors - (errors - errors.mean())) / correction.standard_errors
    assert np.sqrt(np.mean(apart**2)) < 1.5


@pytest.mark.parametrize('amplitude', [1.0, 2.0])
def test_errors_that_follow_another_shafts_order_are_refused(rng, amplitude):
    """
    Six cycles do not separate order 12.04 from order 12.

    A displaced pulse, far beyond the declared jitter, leaves no other order to recover from.
    """
    rate, tones = 6400.0, {1.0: 1.0, 5.0: 1.0, 12.04: amplitude, 30.0: 0.8}
    settings = AverageSettings(trigger_cycles=6, orders=(1.0, 5.0, 30.0), correct_jitter=True,
                               keyphasor_rate=rate)
    refused = wrong = 0
    for displaced in np.linspace(-1.2e-3, 1.2e-3, 16):
        speed = rng.uniform(22.0, 28.0)
        true = 0.01 + np.arange(8) / speed
        pulses = true + rng.uniform(-0.5, 0.5, 8) / rate
        pulses[rng.integers(7)] += displaced
        times = np.arange(round(8.5 / speed * rate)) / rate
        phase = 2.0 * np.pi * rng.random(4)
        samples = sum(a * np.cos(2.0 * np.pi * g * speed * times + at)
                      for (g, a), at in zip(tones.items(), phase))
        averager = StreamingAverager(
            {'shaft': settings}, validator=PulseValidator(interval_tolerance=0.25),
            timeline=VibrationTimeline())
        averager.add_pulses(pulses)
        found = averager.add_samples(SampleBlock(samples[None], 0.0, rate, 0))
        (_, average), = found + averager.finish()
        correction = average.correction
        errors = (pulses - true)[np.isin(pulses, average.pulses)]
        apart = np.abs(
            correction.pulse_errors - (errors - errors.mean())) / correction.standard_errors
        wrong += correction.accepted and apart.max() > 8.0
        refused += 'order of another shaft' in correction.reason
    assert wrong == 0
    assert refused > 0


def test_correction_needs_blocks_of_cycles():
    with pytest.raises(ParameterError, match='set averaging to block'):
        AverageSettings(correct_jitter=True, averaging='sliding')
    with pytest.raises(ParameterError, match='give at least 2'):
        AverageSettings(correct_jitter=True, trigger_cycles=1)


@pytest.mark.machines
def test_an_order_that_the_correction_makes_smaller_is_corrected_too(rng):
    """Errors may turn a leaking order so that it reads too large."""
    corrected, raw, true = [], [], []
    times = np.arange(round(0.95 * RATE)) / RATE
    pulses = 0.05 + np.arange(16) / SPEED
    for _ in range(10):
        phase = rng.uniform(0.0, 2.0 * np.pi, 2)
        samples = sum(a * np.cos(2.0 * np.pi * g * SPEED * (times - 0.05) + at)
                      for g, a, at in zip((5.0, 6.0), (1.0, 0.05), phase))
        late = pulses + rng.uniform(-0.5, 0.5, 16) / 1200.0
        averages = [sa.average(samples + 0.003 * rng.standard_normal(times.size), RATE, item,
                               orders=[5.0, 6.0], trigger_cycles=12, correct_jitter=True,
                               keyphasor_rate=1200.0)[0] for item in (late, pulses)]
        assert averages[0].correction.accepted
        corrected.append(np.abs(averages[0].correction.amplitudes[0]))
        raw.append(np.abs(averages[0].amplitudes[0]))
        true.append(np.abs(averages[1].amplitudes[0]))
    corrected, raw, true = map(np.array, (corrected, raw, true))
    assert np.count_nonzero(raw > corrected) > 0
    assert np.all(raw != corrected)
    assert np.mean((corrected - true) ** 2) < 0.5 * np.mean((raw - true) ** 2)


@pytest.mark.machines
def test_shafts_that_are_due_together_are_corrected_as_each_alone(monkeypatch):
    machine, made = gearbox(2.0, noise=0.3), []
    shafts = {'shaft': {'cycle_length': 2.0}, 'tach': {'orders': (38.0,)},
              'linear': {'interpolation': 'linear'}, 'short': {'trigger_cycles': 15}}
    settings = {name: AverageSettings(**{
        'trigger_cycles': CYCLES, 'orders': ORDERS, 'correct_jitter': True,
        'keyphasor_rate': CLOCK, **item}) for name, item in shafts.items()}
    monkeypatch.setattr(
        'sa_jitter_ros.averaging.correction.cycle_grid', lambda cycles, **options: (
            made.append(len(cycles)), cycle_grid(cycles, **options))[1])

    def averages(names):
        averager = StreamingAverager(
            {name: settings[name] for name in names}, validator=PulseValidator(),
            timeline=VibrationTimeline(buffer_seconds=10.0))
        averager.add_pulses(machine.pulses(0.0, 4.2).times)
        return averager.add_samples(SampleBlock(
            machine.vibration(0, round(4.2 * RATE)), 0.0, RATE, 0))

    together = averages(shafts)
    assert sorted(made) == [15] * 5 + [CYCLES] * 4  # two methods, two averages each
    for name in shafts:
        found = [average for shaft, average in together if shaft == name]
        for one, (_, alone) in zip(found, averages([name]), strict=True):
            assert one.correction.accepted
            np.testing.assert_allclose(one.correction.waveform, alone.correction.waveform,
                                       rtol=1e-9, atol=1e-11)
            np.testing.assert_allclose(one.correction.pulse_errors,
                                       alone.correction.pulse_errors, rtol=1e-7, atol=1e-13)


@pytest.mark.machines
@pytest.mark.parametrize('cycles', [40, 120])
def test_amplitudes_beside_the_lines_of_another_shaft_are_not_biased(cycles):
    """Its lines turn the recovered errors slowly, and not as white noise does."""
    rng, period, rate = np.random.default_rng(cycles), 0.04, 5e3
    orders, size = np.array([8.0, 16.0, 32.0]), np.array([0.5, 1.0, 0.3])
    others, strength = np.array([6.52, 13.04, 19.56]), np.array([0.3, 0.4, 0.5])
    std = 0.3 / (2.0 * np.pi * 16.0) * period
    time = np.arange(round((cycles + 7) * period * rate)) / rate
    pulses = period * (2.0 + np.arange(cycles + 4.0))
    waves = np.exp(2j * np.pi * np.outer(np.append(orders, others), (time - pulses[0]) / period))
    found, errors, limits = [], [], []
    for _ in range(16 if cycles == 40 else 8):
        phases = np.exp(2j * np.pi * rng.uniform(size=6))
        vibration = ((np.append(size, strength) * phases) @ waves).real
        average, *_ = sa.average(
            vibration + 0.01 * rng.standard_normal(time.size), rate,
            pulses + np.sqrt(3.0) * std * rng.uniform(-1.0, 1.0, pulses.size), orders=orders,
            trigger_cycles=cycles, correct_jitter=True, interval_tolerance=0.45,
            keyphasor_rate=1.0 / (np.sqrt(12.0) * std))
        correction = average.correction
        assert correction.accepted
        found.append(abs(correction.amplitudes[0]))
        errors.append(correction.amplitude_errors.amplitude[0])
        limits.append(correction.amplitude_errors.upper_95[0])
    off = np.array(found) - size
    assert np.all(np.abs(off.mean(axis=0)) < np.mean(errors, axis=0))
    assert np.all(np.abs(off) < 4.0 * np.array(errors))
    assert np.mean(np.array(limits) >= size) > 0.95 - 3.0 * np.sqrt(0.05 * 0.95 / off.size)
