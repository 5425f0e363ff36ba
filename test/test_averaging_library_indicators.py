# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Condition indicators, gear signals and envelope of the library's averages."""

import copy

import numpy as np
import pytest
import sa_jitter_ros as sa
from sa_jitter_ros.averaging.averager_parameters import gear_settings, PARAMETERS, shaft_parameters
from sa_jitter_ros.averaging.indicators import condition_indicators, GearSettings, separate
from sa_jitter_ros.averaging.results import ShaftResults
from sa_jitter_ros.averaging.shaft_indicators import ShaftIndicators

RATE, SPEED = 8e3, 10.0
MACHINE = sa.Machine('output', gears={'stage': {
    'shaft': 'input', 'teeth': 19, 'mate_shaft': 'output', 'mate_teeth': 38}}, bearings={
        'b1': {'shaft': 'input', 'cage': 0.4, 'ball': 2.3, 'outer': 3.6, 'inner': 5.4}})


def rig(seconds=20.0, seed=1):
    """Return vibration of an input shaft at 20 Hz, and pulses of the output shaft at 10 Hz."""
    rng = np.random.default_rng(seed)
    time = np.arange(int(seconds * RATE)) / RATE
    angle = 2.0 * np.pi * 2.0 * SPEED * time
    vibration = np.stack([(1.0 + 0.2 * np.cos(angle)) * np.cos(19.0 * angle)
                          + gain * np.cos(7.0 * angle) for gain in (0.1, 0.3)])
    pulses = np.arange(1, int(seconds * SPEED)) / SPEED
    return vibration + rng.normal(0.0, 0.2, vibration.shape), pulses


def test_indicators_are_those_of_the_waveform():
    vibration, pulses = rig()
    averages = sa.average(vibration, RATE, pulses, ratio=2.0, trigger_cycles=40,
                          mesh_orders=[19], sidebands=2)
    gear = GearSettings([19], 2)
    expected = condition_indicators([item.waveform for item in averages], gear)
    for place, item in enumerate(averages):
        for name, (value, error) in item.indicators.items():
            np.testing.assert_allclose(value, expected[name][place], rtol=1e-9)
            assert error.shape == (2,)
            assert (error[np.isfinite(value)] > 0.0).all()
        signals = separate(item.waveform, gear)
        np.testing.assert_array_equal(item.residual, signals.residual)
        np.testing.assert_array_equal(item.difference, signals.difference)
    assert averages[0].indicators['kurtosis'][0][0] == pytest.approx(1.6, abs=0.1)


def test_they_are_made_when_asked_for_in_any_order_and_in_a_stream(monkeypatch):
    made = []
    of = ShaftIndicators.indicators_of
    monkeypatch.setattr(ShaftIndicators, 'indicators_of', lambda self, item: made.append(
        item.sequence) or of(self, item))
    vibration, pulses = rig()
    options = {'ratio': 2.0, 'trigger_cycles': 40, 'mesh_orders': [19]}
    ahead, back = (sa.average(vibration, RATE, pulses, **options) for _ in range(2))
    assert made == []
    na4 = [item.indicators['na4'][0] for item in ahead]
    del made[:]
    copied = copy.deepcopy(back[2])  # asks, and so do those before it
    assert made == [0, 1, 2]
    np.testing.assert_array_equal(back[3].indicators['na4'][0], na4[3])
    np.testing.assert_array_equal(copied.indicators['na4'][0], na4[2])
    np.testing.assert_array_equal(copied.residual, ahead[2].residual)
    assert back[3].indicators is back[3].indicators
    assert made == [0, 1, 2, 3]
    del made[:]
    averager = sa.Averager(RATE, **options)
    parts = [averager.update(block) for block in np.array_split(vibration, 4, axis=1)]
    found = averager.update(pulse_times=pulses)
    assert made == []
    assert not any(parts)
    averager.update(vibration[:, :10])  # what nobody asked for must not pile up
    assert made == [0, 1, 2, 3]
    np.testing.assert_array_equal(found[3].indicators['na4'][0], na4[3])


def test_they_are_those_of_the_corrected_average_as_the_topic_has_them():
    vibration, pulses = rig()
    clocked = np.ceil(pulses * 1e3) / 1e3 + np.random.default_rng(2).uniform(
        0.0, 1e-3, pulses.size)
    options = {'ratio': 2.0, 'trigger_cycles': 40, 'correct_jitter': True,
               'keyphasor_rate': 1e3, 'bearing_orders': [3.6]}
    averages = sa.average(vibration, RATE, clocked, mesh_orders=[19], **options)
    values = {item.name: item.default for item in (*PARAMETERS, *shaft_parameters('input'))}
    node = ShaftResults(gear_settings({**values, 'input.mesh_orders': [19.0]}, 'input'))
    for item in averages:
        assert item.correction.accepted
        topics = node.of(item)
        for kind, part in (('condition_indicator', 0), ('condition_indicator_error', 1)):
            message = topics[kind]
            for place, name in enumerate(message.names):
                np.testing.assert_array_equal(item.indicators[name][part],
                                              message.values[:, place])
        raw = condition_indicators(item.waveform, GearSettings([19]))['energy_ratio']
        assert (item.indicators['energy_ratio'][0] != raw).all()
        np.testing.assert_array_equal(
            item.residual, separate(item.correction.waveform, GearSettings([19])).residual)
        assert item.envelope is item.correction.envelope is not None


@pytest.mark.machines
def test_the_machine_gives_ratio_and_orders_of_a_shaft():
    vibration, pulses = rig()
    by_name, = sa.average(vibration, RATE, pulses, machine=MACHINE, shaft='input')
    by_ratio, = sa.average(vibration, RATE, pulses, machine=MACHINE, ratio=2.0)
    plain, = sa.average(vibration, RATE, pulses, ratio=2.0, mesh_orders=[19.0],
                        orders=[18, 19, 20, 37, 38, 39, 56, 57, 58],
                        bearing_orders=[0.4, 2.3, 3.6, 4.6, 5.4])
    for item in (by_name, by_ratio):
        np.testing.assert_array_equal(item.amplitudes, plain.amplitudes)
        np.testing.assert_array_equal(item.envelope.bearing_orders, plain.envelope.bearing_orders)
        np.testing.assert_array_equal(item.indicators['fm0'], plain.indicators['fm0'])
    given, = sa.average(vibration, RATE, pulses, machine=MACHINE, shaft='input', orders=[19.0],
                        bearing_orders=[3.6])
    assert given.orders.tolist() == [19.0]
    assert given.envelope.bearing_orders.tolist() == [3.6]
    sliding = sa.average(vibration, RATE, pulses, machine=MACHINE, shaft='input',
                         averaging='sliding', trigger_cycles=100)
    assert sliding[0].envelope is None
    with pytest.raises(sa.ParameterError, match='shaft fan is unknown'):
        sa.average(vibration, RATE, pulses, machine=MACHINE, shaft='fan')
    with pytest.raises(sa.ParameterError, match=r'no shaft .* \(output 1, input 2\): give shaft'):
        sa.average(vibration, RATE, pulses, machine=MACHINE, ratio=3.0)
    with pytest.raises(sa.ParameterError, match='machine is of type str'):
        sa.average(vibration, RATE, pulses, machine='machine.yaml')


def test_a_lost_channel_and_a_mesh_beyond_the_band_cost_themselves():
    vibration, pulses = rig()
    vibration[1, ::50] = np.nan
    with pytest.warns(sa.DataWarning):
        found, = sa.average(vibration, RATE, pulses, ratio=2.0, mesh_orders=[19])
    assert np.isfinite(found.residual[0]).all()
    assert np.isnan(found.residual[1]).all()
    assert np.isnan(found.indicators['fm4'][0][1])
    with pytest.warns(sa.DataWarning, match='no condition indicators: mesh order 4000'):
        beyond, = sa.average(vibration[0], RATE, pulses, ratio=2.0, mesh_orders=[4000])
    assert beyond.indicators == {}


def test_no_pulses_per_revolution_is_one_line():
    with pytest.raises(sa.ParameterError, match='pulses_per_revolution is 0: give at least 1'):
        sa.average(np.zeros(100), 1e3, [0.0, 0.1], pulses_per_revolution=0)


def test_nb4_is_near_its_definition():
    """Beside the envelope at 30 times as many points, for waveforms of noise."""
    rng = np.random.default_rng(1)
    for mesh in (7, 13, 19, 32):
        waveform = rng.normal(size=512)
        spectrum, reach = np.fft.rfft(waveform), mesh // 2
        band = np.zeros(1 << 14, complex)
        band[mesh - reach:mesh + reach + 1] = spectrum[mesh - reach:mesh + reach + 1]
        envelope = np.abs(np.fft.ifft(band))
        envelope -= envelope.mean()
        found = condition_indicators(waveform[None], GearSettings([mesh]))['nb4'][0]
        assert found == pytest.approx(np.mean(envelope**4) / np.mean(envelope**2) ** 2, rel=1e-3)
