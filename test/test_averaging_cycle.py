# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Order amplitudes of single trigger cycles against the integrals that define them."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
import sa_jitter_ros as sa
from sa_jitter_ros.averaging.average import AverageSettings
from sa_jitter_ros.averaging.cycle import (
    CycleSamples, exact_cycles, has_same_angles, joined_cycles)
from sa_jitter_ros.averaging.shaft import ShaftAverager

RATE, SPEED, CYCLES, START = 10e3, 10.0, 36, 0.0123


def integrals(order, tone, ratio):
    """Return those of a cosine of order `tone` and phase 0.7 times exp(-j ...), cycle by cycle."""
    ends = ratio * np.arange(CYCLES + 1)

    def turned(step):
        if not step:
            return np.full(CYCLES, ratio)
        return np.diff(np.exp(2j * np.pi * step * ends)) / (2j * np.pi * step)

    return (np.exp(0.7j) * turned(tone - order)
            + np.exp(-0.7j) * turned(-tone - order)) / ratio


@pytest.mark.parametrize('tone', [3.0, 19.0, 50.5, 120.0])
@pytest.mark.parametrize('ratio', [2.40789, 0.410003, np.sqrt(2.0)])
def test_amplitudes_of_a_cycle_are_integrals_over_it(ratio, tone):
    frequency = tone * ratio * SPEED
    assert frequency < 0.32 * RATE
    time = np.arange(round((CYCLES + 2) / SPEED * RATE)) / RATE
    samples = np.cos(2.0 * np.pi * frequency * (time - START) + 0.7)[:, None]
    pulses = START + np.arange(CYCLES + 1) / SPEED
    orders = (tone, tone + 1.0, tone + 2.3)
    run = CycleSamples.cut(samples, start_time=0.0, rate=RATE, pulses=pulses, first=0, margin=40,
                           count=CYCLES)
    average = ShaftAverager(AverageSettings(
        cycle_length=ratio, trigger_cycles=CYCLES, orders=orders)).update(run)
    assert not has_same_angles(average.angle.size, ratio)
    for amplitudes, order in zip(average.cycle_amplitudes[:, 0].T, orders):
        # The gain of the interpolator is 1 to 0.001 dB.
        np.testing.assert_allclose(amplitudes, integrals(order, tone, ratio), atol=1.2e-4)


@pytest.mark.parametrize('layout', ['rows', 'channels', 'copies'])
def test_cycles_are_joined_to_the_samples_that_they_were_cut_from(layout, rng):
    samples = rng.standard_normal((500, 3))
    if layout == 'channels':  # the memory that they are cut from has other rows
        samples = np.ascontiguousarray(samples.T).T
    pulses = 0.0505 + 0.1 * np.arange(4)
    runs = [CycleSamples.cut(samples, start_time=0.0, rate=1e3, pulses=pulses, first=k, margin=9)
            for k in range(3)]
    if layout == 'copies':
        runs = [replace(run, samples=run.samples.copy()) for run in runs]
    run, = joined_cycles(runs)
    np.testing.assert_array_equal(run.samples, samples[41:361])
    assert np.shares_memory(run.samples, samples) == (layout != 'copies')
    assert run.count == 3


@pytest.mark.parametrize('ratio', [np.sqrt(2.0), np.pi / 2.0, 1.0 / 3.0 + 1e-13])
def test_a_ratio_that_is_none_of_numbers_of_teeth_is_exactly_its_float(ratio):
    assert exact_cycles(float(ratio)) == Fraction(float(ratio))


@pytest.mark.parametrize(('place', 'cycles'), [(0, [0]), (9, [0]), (980, [0]), (1000, [0, 1]),
                                               (1500, [1]), (2040, [1])])
def test_a_channel_lacks_the_cycles_that_a_gap_is_in_or_beside(place, cycles):
    samples = np.ones((2100, 2))
    samples[place, 1] = np.nan
    run = CycleSamples(samples, 0.0, 1000.0, np.array([0.02, 1.02, 2.02]), 0, count=2)
    found = run.without_gaps()
    assert [number for number, channels in enumerate(found.lacking) if channels] == cycles
    assert {channels for channels in found.lacking if channels} == {(1,)}
    assert found.samples.sum() == 4199.0


@pytest.mark.parametrize('ratio', [1.0, 2.40789])
def test_a_coarse_waveform_takes_nothing_from_orders_above_it(ratio):
    turn = 2.0 * np.pi * ratio * 10.0 * np.arange(4000) / 2000.0
    average, = sa.average(np.cos(30.0 * turn) + 3.0 * np.cos(2.0 * turn), 2000.0,
                          np.arange(1.0, 19.0) / 10.0, ratio=ratio, orders=[30.0],
                          samples_per_revolution=16)
    assert average.waveform.shape == (1, 16)
    assert abs(average.amplitudes[0, 0]) == pytest.approx(1.0, abs=5e-3)
