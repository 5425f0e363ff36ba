# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Machines that run up and coast down: the band of orders, and what a change of speed shows."""

import numpy as np
import pytest
from sa_jitter_ros.effects import declared_effects
from sa_jitter_ros.inference.observation import observe
from sa_jitter_ros.inference.order_band import OrderBand
from sa_jitter_ros.inference.record_fit import OpenRecord
from sa_jitter_ros.inference.trace import trace
from sa_jitter_ros.prediction.influence import trigger_periods
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.recordings.recording import ArraySource, Recording
from sa_jitter_ros.report.report import report

pytestmark = pytest.mark.usefixtures('unasked')
RATE, DURATION, JITTER, NOISE = 20e3, 12.0, 12e-6, 0.2
ORDERS = 23.0, 46.0


def run_up(rng, *, marks=1, end=110.0, delay=0.0, skew=0.0, angles=(0.0,), stretch=1.0):
    """
    Return the vibration of a shaft that runs up from 45 Hz, its pulses and their errors.

    It holds an order of another shaft, too. `angles` (mark,) are those by which marks are late, in
    turns.
    """
    time = np.arange(round(DURATION * stretch * RATE)) / RATE
    u = time / time[-1]
    turns = 45.0 * time + (end - 45.0) * time[-1] * (0.5 * u - np.sin(np.pi * u) / (2.0 * np.pi))
    vibration = sum(size * np.cos(2.0 * np.pi * order * turns + order)
                    for order, size in ((23.0, 0.6), (46.0, 0.8), (11.675, 0.3)))
    vibration += NOISE * rng.standard_normal(time.size)
    number = np.arange(1, int(turns[-1] * marks))
    true = np.interp(number / marks, turns, time)
    late = np.interp(number / marks + np.resize(angles, number.size), turns, time)
    times = (late + rng.normal(0.0, JITTER, number.size) + delay) * (1.0 + skew)
    return Recording(ArraySource(vibration[None]), RATE, pulse_times=times,
                     pulses_per_revolution=marks), times - true


def vibration_of(recording):
    """Return the vibration (sample, channel)."""
    return np.concatenate([*recording.blocks()], axis=1).T


def traced(recording, marks=1, **declared):
    """Trace a run-up; every mark begins a trigger cycle."""
    model = DeclaredModel(
        keyphasor_rate=20e3, jitter_distribution='normal', jitter_std=JITTER, trigger_speed=77.0,
        trigger_cycles=50 * marks, orders=ORDERS, noise_std=NOISE, sample_rate=RATE,
        pulses_per_revolution=marks, pulses_per_trigger=1)
    return report(trace([observe(recording, model)], [recording],
                        declared=declared_effects(declared)))


def test_band_holds_the_same_orders_at_every_speed(rng):
    """Beyond the band of the mean speed is the highest order where the shaft is fast."""
    recording, errors = run_up(rng)
    times = recording.pulse_times - errors
    band = OrderBand.below(52.0, vibration_of(recording), RATE, 0.0, times)
    u = (np.arange(256) + 0.5) / 256  # far above what the band holds
    for begin in (10, times.size // 2, times.size - 60):
        own = times[begin:begin + 41]
        read = band.at(own[:-1, None] + np.diff(own)[:, None] * u)[..., 0].ravel()
        spectrum = 2.0 * np.abs(np.fft.rfft(read)) / read.size
        assert spectrum[[40 * 23, 40 * 46]] == pytest.approx([0.6, 0.8], abs=0.02)
        assert spectrum[40 * 70:].max() < 1e-3


def test_band_of_a_steady_shaft_ends_at_a_frequency(rng):
    recording, _ = run_up(rng, end=46.0)
    band = OrderBand.below(52.0, vibration_of(recording), RATE, 0.0, recording.pulse_times)
    assert band.even is None


@pytest.mark.machines
@pytest.mark.parametrize(('delay', 'skew'), [
    (0.0, 0.0), (8e-4, 0.0), (-2e-3, 0.0), (0.0, 1e-4)])
def test_errors_of_a_run_up_are_right_at_every_speed(rng, delay, skew):
    """Errors of several turns of the highest order, too."""
    recording, errors = run_up(rng, delay=delay, skew=skew)
    times = recording.pulse_times
    found = OpenRecord(
        vibration_of(recording), RATE, 0.0, times, measured=np.ones(times.size, bool),
        cycle_length=1.0, orders=ORDERS, jitter_std=JITTER).fit()
    wrong = (found.errors - errors)[2:-2]
    turn = trigger_periods(times - errors)[2:-2]
    wrong -= turn * (turn @ wrong) / (turn @ turn)
    # a linear law bends what it misses of the acceleration into the errors, 1/12 of its change
    assert all(np.std(part) < 0.25 * JITTER for part in np.array_split(wrong, 6))
    assert found.jitter_std > 0.8 * JITTER


@pytest.mark.machines
@pytest.mark.parametrize(('name', 'parameter', 'true', 'machine'), [
    ('path_delay', 'delay', -2e-3, {'delay': -2e-3}),
    ('clock_skew', 'skew', 8e-5, {'skew': 8e-5}),
])
def test_what_turns_the_lines_as_the_speed_changes_is_found(rng, name, parameter, true, machine):
    recording, _ = run_up(rng, stretch=0.6, **machine)
    content = traced(recording)
    effect, = content['missing_effects']
    found = effect['parameters'][parameter]
    assert effect['name'] == name
    assert found['value'] == pytest.approx(true, abs=4.0 * found['standard_error'])
    assert found['standard_error'] < 0.05 * abs(true)


@pytest.mark.machines
def test_run_up_as_declared_is_as_declared(rng):
    recording, _ = run_up(rng, stretch=0.6)
    assert traced(recording)['verdict'] == 'none'


@pytest.mark.machines
def test_marks_of_a_target_are_late_by_angles_at_every_speed(rng):
    angles = np.array([3e-3, -1e-3, 0.0, -2e-3])
    recording, _ = run_up(rng, marks=4, angles=angles, stretch=0.5)
    content = traced(recording, 4)
    assert content['verdict'] == 'traced'
    effect, = content['missing_effects']
    found = effect['parameters']['pulse_angles']
    assert effect['name'] == 'target_geometry'
    true = 2.0 * np.pi * (angles - angles.mean())
    off = np.subtract(found['value'], true) / found['standard_error']
    assert np.abs(off).max() < 4.0
