# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Channels that are NaN, now and then or for ever, or constant: they alone have no average."""

from dataclasses import replace

import numpy as np
import pytest
import sa_jitter_ros as sa
from sa_jitter_ros.averaging.results import ShaftResults

pytestmark = [pytest.mark.filterwarnings('error::RuntimeWarning'),
              pytest.mark.filterwarnings('ignore::sa_jitter_ros.errors.DataWarning')]

RATE, SPEED, JITTER = 6400.0, 25.0, 30e-6
ORDERS = (5.0, 23.0, 40.0)
OTHERS = [0, 2]


@pytest.fixture
def machine(rng):
    """Return vibration of three channels and pulses of a shaft, 4 s."""
    time = np.arange(round(4.0 * RATE)) / RATE
    wave = sum(np.cos(2.0 * np.pi * g * SPEED * time + g) for g in ORDERS)
    vibration = np.array([1.0, 2.0, 0.5])[:, None] * wave + rng.normal(0.0, 0.1, (3, time.size))
    return vibration, np.arange(1, 99) / SPEED + rng.normal(0.0, JITTER, 98)


def averages_of(vibration, pulses, cut=6400, **options):
    """Return the averages of blocks of `cut` samples, and the averager."""
    averager = sa.Averager(RATE, orders=ORDERS, **{'trigger_cycles': 20, **options})
    found = averager.update(None, pulses)
    for first in range(0, vibration.shape[1], cut):
        found += averager.update(vibration[:, first:first + cut])
    return found + averager.flush(), averager


@pytest.mark.machines
@pytest.mark.parametrize('value', [np.nan, np.inf, 0.0, 3.3])
def test_a_channel_that_tells_nothing_changes_no_other_one(machine, value):
    vibration, pulses = machine
    bad = vibration.copy()
    bad[1] = value
    options = {'correct_jitter': True, 'keyphasor_rate': 1.0 / (np.sqrt(12.0) * JITTER)}
    expected, _ = averages_of(vibration[OTHERS], pulses, **options)
    found, averager = averages_of(bad, pulses, **options)
    assert len(found) == len(expected) == 4
    results, without = ShaftResults(), ShaftResults()
    for one, other in zip(found, expected):
        assert one.correction.accepted
        messages, others = results.of(one), without.of(other)
        for name in ('condition_indicator', 'condition_indicator_error'):
            np.testing.assert_allclose(
                messages[name].values[OTHERS], others[name].values, rtol=1e-6)
        np.testing.assert_allclose(one.amplitudes[OTHERS], other.amplitudes, rtol=1e-12)
        np.testing.assert_allclose(one.waveform[OTHERS], other.waveform, rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(one.correction.amplitudes[OTHERS],
                                   other.correction.amplitudes, rtol=1e-12)
        np.testing.assert_allclose(one.correction.pulse_errors, other.correction.pulse_errors,
                                   rtol=0.0, atol=1e-15)
        if not np.isfinite(value):
            for item in (one.amplitudes, one.waveform, one.noise, one.standard_error,
                         one.correction.amplitudes, one.correction.waveform):
                assert np.isnan(item[1]).all()
    if not np.isfinite(value):
        assert averager.messages == ['samples from index 0 on are NaN or infinite in channels '
                                     '[1]: they have no average there']
        assert averager.counts['samples_non_finite'] == vibration.shape[1]
        assert averager.counts['cycles_dropped'] == 0


def test_averages_whose_correction_was_refused_have_a_history_of_indicators_of_their_own(machine):
    vibration, pulses = machine
    found, _ = averages_of(vibration, pulses, correct_jitter=True,
                           keyphasor_rate=1.0 / (np.sqrt(12.0) * JITTER))
    raw = [replace(item, correction=replace(
        item.correction, accepted=False, waveform=item.waveform)) for item in found]
    mixed, corrected, refused = ShaftResults(), ShaftResults(), ShaftResults()
    for one, other in zip(found, raw):
        for average, alone in ((one, corrected), (other, refused)):
            both, own = (item.of(average)['condition_indicator'] for item in (mixed, alone))
            np.testing.assert_array_equal(both.values, own.values)


@pytest.mark.machines
@pytest.mark.parametrize('averaging', ['block', 'sliding', 'exponential'])
def test_a_gap_of_one_channel_costs_its_averages_only(machine, averaging):
    vibration, pulses = machine
    bad = vibration.copy()
    bad[1, 9000:9100] = np.nan  # at 1.41 s
    options = {'averaging': averaging, 'trigger_cycles': 5}
    expected, _ = averages_of(vibration, pulses, **options)
    found, _ = averages_of(bad, pulses, **options)
    again, _ = averages_of(bad, pulses, cut=777, **options)
    reach = 40 if averaging == 'exponential' else 5
    assert len(found) == len(expected) == len(again)
    for one, other, third in zip(found, expected, again):
        np.testing.assert_allclose(one.amplitudes[OTHERS], other.amplitudes[OTHERS], rtol=1e-12)
        lacking = one.start_time < 1.43 and one.end_time > 1.40
        if averaging == 'exponential':
            lacking = one.end_time > 1.40 and one.end_time - reach / SPEED < 1.43
        assert np.isnan(one.amplitudes[1]).all() == np.isnan(one.amplitudes[1]).any()
        assert np.isnan(one.amplitudes[1]).all() == lacking, one
        assert np.isnan(third.amplitudes[1]).all() == lacking
        if not lacking and averaging != 'exponential':
            np.testing.assert_allclose(one.amplitudes[1], other.amplitudes[1], rtol=1e-9)
