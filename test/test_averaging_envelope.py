# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The squared envelope of the residual signal has the amplitudes of known modulations."""

import numpy as np
import pytest
import sa_jitter_ros as sa
from sa_jitter_ros.averaging.envelope import EnvelopeSettings
from sa_jitter_ros.averaging.results import ENVELOPE_FIELDS, ShaftResults, SPECTRUM_FIELDS
from sa_jitter_ros.errors import ParameterError

RATE, SPEED, RATIO = 10e3, 10.0, 2.4


def carrier(rng, channels, samples):
    """Return noise of unit power between 1.5 and 3 kHz, a resonance."""
    spectrum = np.fft.rfft(rng.standard_normal((channels, samples)))
    frequency = np.fft.rfftfreq(samples, 1.0 / RATE)
    spectrum[:, (frequency < 1500.0) | (frequency > 3000.0)] = 0.0
    noise = np.fft.irfft(spectrum, samples)
    return noise / noise.std(axis=1, keepdims=True)


def averaged(depth, order, *, cycles=30, averages=4, channels=12, seed=0, jitter=0.0, **options):
    """Return averages of modulated noise, gears and an offset, with pulses at 10 Hz."""
    rng = np.random.default_rng(seed)
    time = np.arange(round((averages * cycles + 2) / SPEED * RATE)) / RATE
    turns = RATIO * SPEED * (time - 0.05)
    noise = carrier(rng, channels, time.size)
    gears = 3.0 * np.cos(2.0 * np.pi * 19.0 * turns) + np.cos(2.0 * np.pi * 38.0 * turns)
    pulses = 0.05 + np.arange(averages * cycles + 1) / SPEED
    return sa.average(
        np.sqrt(1.0 + depth * np.cos(2.0 * np.pi * order * turns)) * noise + gears + 10.0, RATE,
        pulses + jitter * rng.uniform(-0.5, 0.5, pulses.size), ratio=RATIO,
        trigger_cycles=cycles, orders=[19.0, 38.0], **options)


@pytest.mark.machines
@pytest.mark.parametrize(('order', 'depth', 'cycles'), [
    (4.9, 0.8, 30), (5.0, 0.8, 30), (11.3, 0.5, 30), (0.41, 0.8, 30), (4.9, 0.8, 8)])
def test_envelope_has_the_amplitude_of_the_modulation(order, depth, cycles):
    slip = 0.008 if order % 1.0 else 0.0  # of the ball in its cage
    found = [average.envelope for average in averaged(
        depth, order * (1.0 + slip), cycles=cycles, averages=240 // cycles,
        bearing_orders=[order])]
    amplitude = np.array([item.amplitudes[:, 0] for item in found])
    # cos^2 of a unit carrier has the squared envelope 2 (1 + depth cos)
    bias = amplitude.mean() / (2.0 * depth) - 1.0
    assert abs(bias) < 0.02 + 3.0 * amplitude.std() / np.sqrt(amplitude.size) / (2.0 * depth)
    assert amplitude.std() < 0.2 * depth * np.sqrt(30.0 / cycles)
    error = np.mean([item.standard_errors for item in found])
    assert error == pytest.approx(amplitude.std(), rel=0.3)
    assert np.mean([item.mean for item in found]) == pytest.approx(2.0, rel=0.01)
    slipped = np.array([item.found[:, 0] for item in found]) / order - 1.0
    resolution = 1.0 / (order * cycles * RATIO)
    assert np.abs(slipped - slip).max() < 0.5 * resolution
    spectrum, orders = found[0].spectrum, found[0].orders
    assert orders[-1] == pytest.approx(1.25 * order, abs=1.1 / (cycles * RATIO))
    top = orders[spectrum.mean(axis=0).argmax()]
    assert top == pytest.approx(order * (1.0 + slip), abs=1.0 / (cycles * RATIO))


def test_noise_alone_shows_no_bearing():
    found = [average.envelope for average in averaged(0.0, 5.0, bearing_orders=[4.9, 7.3])]
    height = np.array([item.amplitudes / item.standard_errors for item in found])
    assert 1.5 < np.median(height) < 4.0
    assert height.max() < 6.0


def test_jitter_that_is_corrected_leaves_no_gears_in_the_residual():
    options = {'jitter': 1e-3, 'bearing_orders': [4.9], 'averages': 2, 'channels': 3}
    raw = averaged(0.8, 4.9, **options)[0]
    corrected = averaged(0.8, 4.9, correct_jitter=True, keyphasor_rate=1e3, **options)[0]
    assert corrected.correction.accepted
    assert corrected.envelope is corrected.correction.envelope
    np.testing.assert_allclose(corrected.correction.envelope.mean, 2.0, rtol=0.05)
    assert np.all(raw.envelope.mean > 2.5)
    in_band = averaged(0.8, 4.9, envelope_band=[1400.0, 3100.0], **options)[0]
    np.testing.assert_allclose(in_band.envelope.mean, 2.0, rtol=0.05)
    np.testing.assert_allclose(in_band.envelope.amplitudes, 1.6, rtol=0.2)


def test_envelope_runs_on_over_discarded_cycles():
    average = averaged(0.8, 4.9, averages=1, bearing_orders=[4.9])[0]
    time = np.arange(round(3.2 * RATE)) / RATE
    pulses = np.delete(0.05 + np.arange(31) / SPEED, 12)
    rng = np.random.default_rng(0)
    noise = carrier(rng, 12, time.size)
    samples = noise * np.sqrt(1.0 + 0.8 * np.cos(2.0 * np.pi * 4.9 * RATIO * SPEED * time))
    with pytest.warns(sa.errors.DataWarning):
        gap, = sa.average(samples, RATE, pulses, ratio=RATIO, trigger_cycles=28,
                          maximum_discarded=0.5, orders=[19.0], bearing_orders=[4.9])
    assert gap.discarded_cycles == 2
    assert gap.envelope.amplitudes.mean() == pytest.approx(
        average.envelope.amplitudes.mean(), rel=0.05)


def test_tables_name_their_fields():
    average = averaged(0.8, 4.9, averages=1, channels=2, bearing_orders=[4.9, 7.1])[0]
    found = ShaftResults().of(average)
    assert found['envelope_amplitude'].values.shape == (2, 2, len(ENVELOPE_FIELDS))
    np.testing.assert_array_equal(found['envelope_amplitude'].values[..., 0], [[4.9, 7.1]] * 2)
    assert found['envelope_spectrum'].values.shape == (
        2, average.envelope.orders.size, len(SPECTRUM_FIELDS))


@pytest.mark.parametrize(('options', 'reason'), [
    ({'bearing_orders': [-1.0]}, 'positive'), ({'envelope_band': [3e3]}, 'lowest and its highest'),
    ({'envelope_band': [3e3, 2e3]}, 'lowest and its highest'),
    ({'bearing_orders': [4.9], 'averaging': 'sliding', 'trigger_cycles': 10}, 'set averaging')])
def test_wrong_settings_are_refused(options, reason):
    with pytest.raises(ParameterError, match=reason):
        sa.Averager(RATE, **options)


@pytest.mark.parametrize('revolutions', [30.0, 1e7])
def test_a_spectrum_reaches_beyond_every_bearing_order_in_a_bounded_number_of_lines(revolutions):
    orders = EnvelopeSettings([4.9, 11.3]).orders(revolutions)
    assert 100 < orders.size <= 8192
    assert 1.2 * 11.3 < orders[-1] < 1.3 * 11.3
    assert np.ptp(np.diff(orders)) < 1e-9


@pytest.mark.parametrize(('band', 'shown', 'says'), [
    ([], [True, True, False], '250: .* 24 Hz, and vibration of 0 to 5000 Hz, sampled at '
     '10000 Hz, has an envelope of orders below 208.33 only; .*_band below 5000 Hz'),
    ([2000.0, 2100.0], [True, False, False], '7.1, 250: .* below 4.1667 only'),
    ([4000.0, 9000.0], [True, True, False], '250: .* 4000 to 9000 Hz, .* below 41.667 only'),
    ([6000.0, 9000.0], [False] * 3, '3.9, 7.1, 250: .* orders below 0 only')])
def test_what_an_envelope_cannot_show_has_no_amplitude(band, shown, says):
    with pytest.warns(sa.DataWarning, match='no amplitude of bearing orders ' + says):
        average, = averaged(0.8, 3.9, averages=1, channels=1, bearing_orders=[3.9, 7.1, 250.0],
                            envelope_band=band)
    envelope = average.envelope
    for values in (envelope.found, envelope.amplitudes, envelope.standard_errors):
        np.testing.assert_array_equal(np.isfinite(values[0]), shown)
    assert np.isfinite(envelope.mean).all() == any(shown)
    assert np.isfinite(envelope.spectrum).any() == any(shown)
    assert (envelope.standard_errors[0, shown] > 0.0).all()
