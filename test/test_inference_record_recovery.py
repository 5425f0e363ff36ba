# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Pulse errors and undeclared orders of whole recordings, from vibration whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest
from sa_jitter_ros.inference.observation import observe
from sa_jitter_ros.inference.record_pulses import RecordPulses
from sa_jitter_ros.inference.record_recovery import leaking_orders, recover_record
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.recordings import read
from sa_jitter_ros.recordings.recording import ArraySource, Recording
from worse_pulses import with_slower_clock

RATE, SPEED, CYCLES, ACQUISITIONS = 5000.0, 25.0, 20, 8
TONE = 560.0  # Hz


def sources(rng, ratio, orders, *, drift, tone=0.0, declared=(8.0,), lost=()):
    """Return the sources found beside `declared` orders, amplitudes of `orders` by order."""
    time = np.arange(int((ACQUISITIONS * CYCLES + 4) / SPEED * RATE)) / RATE
    turns = SPEED * (time + 0.5 * drift * time**2 / time[-1])
    vibration = sum(size * np.cos(2.0 * np.pi * order * ratio * turns)
                    for order, size in orders.items())
    vibration = vibration + tone * np.cos(2.0 * np.pi * TONE * time)
    vibration += 0.02 * rng.standard_normal(time.size)
    pulses = np.interp(np.arange(0.5, turns[-1]), turns, time)
    pulses = pulses + rng.uniform(-0.5, 0.5, pulses.size) / 10000.0
    pulses = np.delete(pulses, lost)
    model = DeclaredModel(keyphasor_rate=10000.0, trigger_speed=SPEED, trigger_cycles=CYCLES,
                          ratio=ratio, orders=declared, sample_rate=RATE)
    return observe(Recording(ArraySource(vibration[None]), RATE, pulse_times=pulses), model
                   ).sources[len(declared):]


def test_orders_of_other_shafts_are_found_and_tones_are_not(rng):
    orders = {8.0: 1.0, 8.37: 0.2, 12.3: 0.1}
    found = sources(rng, 2.4, orders, drift=0.01, tone=0.3)
    # places of single acquisitions scatter by 0.04 of what an average resolves; of 5, 3 errors
    np.testing.assert_allclose(found, [8.37, 12.3],
                               atol=3.0 * 0.04 / np.sqrt(5.0) / (CYCLES * 2.4))


def test_what_an_average_does_not_resolve_from_a_line_is_no_source(rng):
    """An average resolves 0.02 orders; taken for a source, the line would grow beyond bounds."""
    orders = {8.0: 1.0, 7.988: 0.05, 8.012: 0.05, 8.37: 0.2}
    found = sources(rng, 2.4, orders, drift=0.02)
    np.testing.assert_allclose(found, [8.37], atol=1e-3)


@pytest.mark.parametrize(('other', 'count'), [(9.0, 1), (9.0 + 1.0 / 3.0, 1), (9.04, 0)])
def test_a_steady_machine_tells_only_orders_that_its_shafts_have(rng, other, count):
    found = sources(rng, 3.0, {8.0: 1.0, other: 0.2}, drift=0.0)
    assert found.size == count


def test_what_a_lost_pulse_reads_as_a_declared_order_comes_first(rng):
    """A cycle of two revolutions reads order 4 as order 8, order 20 as order 40."""
    orders = {8.0: 1.0, 40.0: 1.0, 4.0: 0.05, **{10.0 + k: 0.2 for k in range(22)}}
    whole = sources(rng, 1.0, orders, drift=0.01, declared=(8.0, 40.0))
    assert 4.0 not in whole
    assert whole.size == 20
    found = sources(rng, 1.0, orders, drift=0.01, declared=(8.0, 40.0), lost=[50])
    assert found[:2].tolist() == [20.0, 4.0]


def test_a_source_that_moves_does_not_hide_the_undeclared_orders(rng):
    """Pulses that are right are smoothest uncorrected; the vibration still shows its motion."""
    count = 200
    time = np.arange(int((count + 4) / SPEED * RATE)) / RATE
    moved = time + 3e-4 * np.cos(2.0 * np.pi * 0.13 * SPEED * time + 1.0)
    vibration = sum(np.cos(2.0 * np.pi * order * SPEED * moved + order**2)
                    for order in (8.0, 9.0, 10.0, 11.0))
    vibration += 0.1 * rng.standard_normal(time.size)
    pulses = np.arange(2.0, count) / SPEED + rng.uniform(-0.5, 0.5, count - 2) / 20000.0
    model = DeclaredModel(keyphasor_rate=20000.0, trigger_speed=SPEED, trigger_cycles=CYCLES,
                          orders=(8.0,), sample_rate=RATE)
    found = recover_record(vibration[:, None], 0.0, RATE, RecordPulses.unbroken(pulses), model)
    assert found.resolved
    assert found.undeclared[0].size >= 3


@pytest.mark.machines
def test_sidebands_of_a_shaft_are_no_tones_on_a_steady_machine(rng):
    gears = {8.0: 1.0, 16.0: 0.7}
    beside = {7.63: 0.2, 8.37: -0.1, 15.63: -0.15, 16.37: 0.05}  # in phase with neither line
    found = sources(rng, 2.4, {**gears, **beside}, drift=0.0, declared=(8.0, 16.0))
    np.testing.assert_allclose(np.sort(found), list(beside), atol=0.01)
    for one, size in beside.items():
        alone = sources(rng, 2.4, {**gears, one: size}, drift=0.0, declared=(8.0, 16.0))
        assert not alone.size


def machine(rng, *, ratio=2.4, gap=False):
    """Return samples, pulses and true errors of a machine whose speed drifts."""
    time = np.arange(int((ACQUISITIONS * CYCLES + 4) / SPEED * RATE)) / RATE

    def turns(when):
        return SPEED * (when + 0.005 * when**2 / time[-1])

    vibration = sum(size * np.cos(2.0 * np.pi * order * ratio * turns(time) + order)
                    for order, size in ((8.0, 1.0), (16.0, 0.7), (8.37, 0.2)))
    vibration = vibration + 0.02 * rng.standard_normal(time.size)
    true = np.interp(np.arange(0.5, turns(time[-1])), turns(time), time)
    errors = rng.uniform(-0.5, 0.5, true.size) / 10000.0
    pulses = RecordPulses.unbroken(true + errors)
    if gap:  # of an unknown number of pulses
        pulses.bridged[80] = np.nan
        measured = np.delete(np.arange(true.size), 80)
        pulses = RecordPulses(
            pulses.times[measured], np.diff(measured) - 1, measured == 81,
            np.zeros(measured.size, bool), pulses.bridged)
    return vibration[:, None], pulses, errors


def model_of(ratio=2.4):
    return DeclaredModel(keyphasor_rate=10000.0, trigger_speed=SPEED, trigger_cycles=CYCLES,
                         ratio=ratio, orders=(8.0, 16.0), sample_rate=RATE)


def test_a_gap_of_unknown_length_breaks_the_record(rng):
    samples, pulses, errors = machine(rng, gap=True)
    found = recover_record(samples, 0.0, RATE, pulses, model_of())
    assert len(found.fits) == 2
    for part in (slice(2, 78), slice(83, -3)):  # half as much tells the outermost pulses
        wrong = found.bridged_errors[part] - errors[part]
        z = (wrong - wrong.mean()) / found.bridged_standard_errors[part]
        assert np.sqrt(np.mean(z**2)) == pytest.approx(1.0, abs=4.0 / np.sqrt(2.0 * z.size))
    assert np.isnan(found.bridged_errors[80])
    assert found.errors.size == pulses.times.size


@pytest.mark.parametrize('shows', [True, False])
def test_strong_orders_far_above_the_declared_ones_show_the_errors(rng, shows):
    """A weak order 1 alone does not; what the rest of the band holds is asked then."""
    samples, pulses, errors = machine(rng)
    time = np.arange(len(samples)) / RATE
    turns = np.interp(time, pulses.times - errors, np.arange(errors.size) + 0.5)
    weak = 0.05 * np.cos(2.0 * np.pi * 2.4 * turns)[:, None]
    if not shows:
        samples = 0.02 * rng.standard_normal(samples.shape)
    found = recover_record(samples + weak, 0.0, RATE, pulses,
                           replace(model_of(), orders=(1.0,), noise_std=0.02))
    assert found.resolved == shows
    wrong = (found.errors - errors)[2:-2]
    z = (wrong - wrong.mean()) / found.standard_errors[2:-2]
    if shows:
        assert np.sqrt(np.mean(z**2)) == pytest.approx(1.0, abs=4.0 / np.sqrt(2.0 * z.size))
        assert np.std(wrong) < 0.3 * np.std(errors)
    else:
        assert found.undeclared[0].size <= 1  # noise has no lines


def test_roughness_is_that_of_what_the_errors_are_wrong_by(rng):
    seen, stated = [], []
    for _ in range(4):
        samples, pulses, errors = machine(rng)
        found = recover_record(samples, 0.0, RATE, pulses, model_of())
        second = np.diff(found.bridged_errors - errors, 2)[2:-2]
        seen.append(np.mean(second[np.isfinite(second)] ** 2))
        stated.append(found.roughness**2)
    count = 4 * (ACQUISITIONS * CYCLES - 4)
    # Neighbours are not independent. The fit allows for bends, which this machine does not have.
    assert np.mean(seen) == pytest.approx(
        np.mean(stated), rel=4.0 * np.sqrt(4.0 / count) + 0.15)


def test_an_order_that_turns_with_the_shaft_leaks(rng):
    samples, pulses, _ = machine(rng)
    found = recover_record(samples, 0.0, RATE, pulses, model_of())
    assert leaking_orders(found, model_of()) == pytest.approx([8.37], abs=1e-3)


@pytest.mark.machines
def test_declared_lines_only_are_used_where_the_others_disturb(shared_data):
    """Half orders of the measured gearbox look like errors that alternate from pulse to pulse."""
    clock = 6000.0
    recording = with_slower_clock(read(shared_data / 'gear0_gearbox.npz'), clock)
    times = recording.pulse_times[:100]
    true = (times - recording.reference_pulse_times[:100])[1:-1]
    model = DeclaredModel(keyphasor_rate=clock, trigger_speed=33.33, trigger_cycles=40,
                          orders=(23.0, 46.0, 69.0, 92.0, 115.0))
    samples = recording.read().T[:int(times[-1] * recording.sample_rate) + 100]
    found = recover_record(samples, recording.start_time, recording.sample_rate,
                           RecordPulses.unbroken(times[1:-1]), model)
    assert found.undeclared[0].size == 0
    assert np.std(found.errors - true) < 0.7 * np.std(found.fits[0].errors - true)


@pytest.mark.parametrize('order', [2.0, 2.8])  # of a cycle from mark to mark of five
def test_a_line_in_noise_lets_no_chance_choose_the_acquisitions(rng, order):
    """Where no pulse error is resolved, chance resolves the ripple of some acquisitions."""
    speed, clock, rate = 350.0, 55000.0, 2900.0
    time = np.arange(int(10.0 * rate)) / rate
    vibration = 0.35 * np.cos(2.0 * np.pi * order * speed * time)
    vibration += 0.38 * rng.standard_normal(time.size)
    pulses = np.arange(0.1, 9.9, 1.0 / speed)
    pulses += rng.uniform(-0.5, 0.5, pulses.size) / clock
    model = DeclaredModel(keyphasor_rate=clock, trigger_speed=speed, trigger_cycles=10,
                          orders=(order,), sample_rate=rate, noise_std=0.38)
    found = observe(Recording(ArraySource(vibration[None]), rate, pulse_times=pulses), model)
    recovered = sum(item.recovered for item in found.acquisitions)
    assert recovered == 0, f'{recovered} of {len(found.acquisitions)}'


@pytest.mark.parametrize(('noise', 'compared'), [(0.02, True), (0.2, True), (0.5, False)])
def test_pulses_without_errors_are_compared_where_their_recovery_costs_no_amplitude(
        rng, noise, compared):
    time = np.arange(int(8.0 * RATE)) / RATE
    vibration = np.cos(2.0 * np.pi * 8.0 * SPEED * time) + noise * rng.standard_normal(time.size)
    pulses = np.arange(0.1, 7.9, 1.0 / SPEED) + rng.uniform(-0.5, 0.5, 195) / 1e8
    model = DeclaredModel(keyphasor_rate=1e8, trigger_speed=SPEED, trigger_cycles=CYCLES,
                          orders=(8.0,), sample_rate=RATE, noise_std=noise)
    found = observe(Recording(ArraySource(vibration[None]), RATE, pulse_times=pulses), model)
    assert {item.recovered for item in found.acquisitions} == {compared}
    if compared:
        assert np.abs(found.stacked('attenuation')[..., 0] - 1.0).max() < 3e-3
