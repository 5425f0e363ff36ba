# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Pulse errors recovered from a measured gearbox, its keyphasor sampled with a slower clock."""

import numpy as np
import pytest
from sa_jitter_ros.averaging.grid_cycles import GridCycles
from sa_jitter_ros.averaging.recovery import recover_pulse_errors
from sa_jitter_ros.pulses.resampling import interpolate

POINTS = 1024
ORDERS = np.array([23, 46, 92, 115])
U = np.arange(POINTS) / POINTS


@pytest.fixture(scope='module')
def gearbox(shared_data):
    """Return the samples (sample, channel), the sampling rate and the reference keyphasor."""
    path = shared_data / 'gear0_gearbox.npz'
    if not path.is_file():
        pytest.skip(f'no {path.name} in {shared_data}')
    with np.load(path) as data:
        return (data['vibration'].T.astype(float), float(data['sample_rate']),
                data['reference_pulse_times'])


def resample(gearbox, pulses):
    """Trigger cycles (cycle, sample, channel) between pulses, linear law."""
    samples, rate, _ = gearbox
    times = pulses[:-1, None] + np.diff(pulses)[:, None] * U
    return interpolate(samples, times.ravel() * rate).reshape(len(times), POINTS, -1)


def average(cycles):
    """Complex amplitudes (channel, order) over whole trigger cycles."""
    waves = np.exp(-2j * np.pi * np.outer(U, ORDERS)) * 2.0 / POINTS
    return cycles.mean(axis=0).T @ waves


@pytest.mark.machines
@pytest.mark.parametrize('clock', [2560.0, 8000.0])
@pytest.mark.parametrize('count', [40, 100])
def test_corrected_amplitudes_are_those_of_the_reference(gearbox, clock, count):
    reference = gearbox[2]
    sampled = np.ceil(reference * clock) / clock
    ratios = []
    for first in range(0, len(reference) - count, count):
        pulses = sampled[first:first + count + 1]
        found = recover_pulse_errors(GridCycles(resample(gearbox, pulses)),
                                     periods=np.diff(pulses), cycle_length=1.0,
                                     declared_standard_deviation=1.0 / clock / np.sqrt(12.0))
        assert found.accepted
        # Half orders, which this machine has at 45.5 and 46.5, hide errors of alternate sign: what
        # the other orders say of these differs from the reference by a fifth of the jitter.
        apart = found.errors - (pulses - reference[first:first + count + 1])
        turns = np.stack((np.ones(count + 1), (-1.0) ** np.arange(count + 1)), axis=1)
        (_, alternate), *_ = np.linalg.lstsq(turns, apart, rcond=None)
        assert np.std(apart - turns[:, 1] * alternate) < 5e-6
        assert abs(alternate) < 1.5e-5
        expected = average(resample(gearbox, reference[first:first + count + 1]))
        corrected = average(resample(gearbox, pulses - found.errors))
        strong = np.argmax(np.abs(expected), axis=0), np.arange(len(ORDERS))
        ratios.append(np.abs(corrected[strong] / expected[strong]))
    deviations = np.abs(np.array(ratios) - 1.0)
    assert (deviations < [0.01, 0.01, 0.01, 0.015]).all(), deviations  # every average by itself


def test_a_channel_of_noise_changes_nothing(gearbox, rng):
    reference = gearbox[2][:101]
    pulses = np.ceil(reference * 5120.0) / 5120.0
    noise = rng.standard_normal((100, POINTS, 2))
    found = recover_pulse_errors(GridCycles(noise), periods=np.diff(pulses), cycle_length=1.0,
                                 declared_standard_deviation=1.0 / 5120.0 / np.sqrt(12.0))
    assert not found.accepted
    assert not found.errors.any()
