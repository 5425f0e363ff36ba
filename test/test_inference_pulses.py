# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The pulses that the loop works with: spurious, lost, of a flat tach, declared otherwise."""

from dataclasses import replace
import re

import numpy as np
import pytest
from sa_jitter_ros.effects import make_effect
from sa_jitter_ros.errors import ModelError, RecordingError
from sa_jitter_ros.inference.observation import observe
from sa_jitter_ros.inference.record_pulses import record_pulses
from sa_jitter_ros.inference.scoring import make_bench
from sa_jitter_ros.inference.trace import trace
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.recordings.recording import ArraySource, Recording
from sa_jitter_ros.report.report import report, summary
from sa_jitter_ros.simulation import AdditiveNoise, DeclaredJitter, Gearbox, make_effects, mesh

pytestmark = pytest.mark.usefixtures('unasked')
RATE, SPEED, CYCLES, NOISE = 5000.0, 25.0, 20, 0.05
MODEL = DeclaredModel(keyphasor_rate=5000.0, trigger_speed=SPEED, trigger_cycles=CYCLES,
                      orders=(8.0, 16.0, 24.0), noise_std=NOISE, sample_rate=RATE)


def simulated(*, acquisitions=12, seed=4, **effects):
    """Return a machine of the declared jitter and noise, and of effects that nobody declares."""
    machine = Gearbox(
        mesh('shaft', 8, harmonics=(1.0, 0.8, 0.6), channel_gains=(1.0, 0.7), seed=seed), RATE,
        speed=((0.0, SPEED),), seed=seed,
        effects=(AdditiveNoise(NOISE), DeclaredJitter('uniform', 1.0 / np.sqrt(12.0) / 5000.0),
                 *make_effects(effects)))
    seconds = (acquisitions * CYCLES + 3) / SPEED
    return Recording(ArraySource(machine.vibration(0, round(seconds * RATE))), RATE,
                     pulse_times=machine.pulses(0.0, seconds).times)


def traced(recording, model=MODEL):
    """Trace a recording."""
    return trace([observe(recording, model)], [recording])


def validated(times, marks):
    """Return the pulses of a recording each of which begins a trigger cycle."""
    return record_pulses(
        Recording(ArraySource(np.zeros((1, 10))), RATE, pulse_times=times),
        replace(MODEL, pulses_per_revolution=marks, pulses_per_trigger=1,
                trigger_speed=SPEED))


@pytest.mark.parametrize('marks', [1, 4])
def test_spurious_pulses_and_their_cycles_are_dropped(rng, marks):
    """Wherever in its interval, of a target with uneven marks and beside lost pulses."""
    late = np.resize([0.0, 0.06, -0.05, 0.02][:marks], 1200)
    true = (np.arange(1200) + late + rng.normal(0.0, 0.01, 1200)) * 0.04 / marks
    true = np.delete(true, [300, 700])
    place = rng.choice(np.arange(10, 1180, 12), 30, replace=False)
    extra = true[place] + rng.uniform(0.03, 0.97, 30) * np.diff(true)[place]
    given = np.sort(np.append(true, extra))
    found = validated(given, marks)
    wrong = ~np.isin(found.times, true)
    assert np.all(found.doubtful[wrong])
    assert abs(found.times.size - true.size) <= 3  # uneven marks beside an extra pulse
    after = np.searchsorted(found.times, extra[~np.isin(extra, found.times)])
    assert np.all(found.doubtful[after - 1])
    assert np.all(found.doubtful[after] | found.starts_run[after])
    assert found.doubtful.sum() <= 3 * 30
    assert re.match(rf'(2[5-9]|3\d) of {given.size} pulses are spurious', found.remarks[0])
    alone = validated(true, marks)  # genuine pulses beside gaps and uneven marks are kept
    np.testing.assert_array_equal(alone.times, true)
    assert not alone.doubtful.any()
    assert alone.missing.sum() == 2
    with pytest.raises(RecordingError, match='pulses are spurious, more than 5%'):
        validated(np.sort(np.append(true, true[10::12] + 0.01 / marks)), marks)


@pytest.mark.machines
def test_pulses_may_be_missing_in_every_acquisition():
    recording = simulated()
    lost = np.delete(recording.pulse_times, np.arange(7, recording.pulse_times.size, 13))
    found = traced(replace(recording, pulse_times=lost))
    assert all(item.missing.any() for item in found.observation.acquisitions)
    assert [item.name for item in found.findings] == ['missing_pulses']


@pytest.mark.parametrize('marks', [1, 4])
@pytest.mark.parametrize('apart', [-0.12, 0.12])
def test_displaced_pulse_is_not_lost(rng, marks, apart):
    """A pulse in the tail of its jitter is dropped; no pulse is missing for that."""
    interval = 1.0 / SPEED / marks
    times = interval * (np.arange(600) + 1e-3 * rng.standard_normal(600))
    times[300] += apart * interval
    found = validated(times, marks)
    assert found.missing.sum() == 1
    assert found.lost.sum() == 0
    assert any('displaced by its jitter' in remark for remark in found.remarks)
    assert validated(np.delete(times, 300), marks).lost.sum() == 1


@pytest.mark.parametrize('count', [250, 2500])
def test_pulses_at_random_are_no_shaft_of_another_speed(rng, count):
    with pytest.raises(RecordingError, match='at no interval that a shaft could have'):
        validated(np.sort(rng.uniform(0.0, 10.0, count)), 1)


@pytest.mark.parametrize('lost', [False, True])
@pytest.mark.parametrize('step', [0, 1])
def test_given_angles_are_taken_from_pulses_unless_all_are_of_one_mark(rng, step, lost):
    edges = np.array([0.0, 0.03, 0.2, 0.5, 0.8])
    times = ((np.arange(200)[:, None] + edges) / SPEED).ravel() + 1e-6 * rng.normal(size=1000)
    times = np.delete(times, [308, 500]) if lost else times
    target = 2.0 * np.pi * (edges - np.arange(5) / 5)
    recording = Recording(ArraySource(np.zeros((1, 10))), RATE, pulse_times=times,
                          pulses_per_revolution=5, target_angles=tuple(target.tolist()))
    found = record_pulses(recording, replace(
        MODEL, pulses_per_revolution=5, pulses_per_trigger=step, trigger_speed=SPEED))
    assert np.isin(found.times, times).all() == (step == 0)
    assert found.missing.sum() == lost * (1 if step == 0 else 2)
    interval = np.diff(found.times) / (1 + found.missing) * (5.0 if step else 1.0)
    assert np.max(np.abs(interval * SPEED - 1.0)) < 1e-3


def test_a_wheel_whose_trigger_mark_gives_no_pulse_is_refused_in_one_line():
    numbers = np.arange(16 * 49)
    tooth = numbers % 16
    times = numbers[(tooth != 11) & (tooth < 14)] / 16.0 / SPEED
    with pytest.raises(RecordingError, match='0 trigger pulses of 637 keyphasor pulses'):
        record_pulses(
            Recording(ArraySource(np.zeros((1, 10))), RATE, pulse_times=times,
                      pulses_per_revolution=16, missing_teeth=2),
            replace(MODEL, pulses_per_revolution=16, trigger_speed=SPEED))


def test_trigger_pulses_of_a_wheel_with_gaps_stay_on_its_teeth():
    """The first pulse is not the index, and a fourth of the teeth is missing."""
    teeth = np.arange(5, 2000)
    recording = Recording(ArraySource(np.zeros((1, 10))), RATE,
                          pulse_times=teeth[teeth % 12 < 9] / 12.0 / SPEED,
                          pulses_per_revolution=12, missing_teeth=3)
    model = replace(MODEL, pulses_per_revolution=12, trigger_speed=SPEED)
    found = record_pulses(recording, model)
    np.testing.assert_allclose(np.diff(found.times), 1.0 / SPEED)
    assert found.times.size > 160
    assert not found.missing.any()


@pytest.mark.machines
def test_double_pulses_are_no_effect():
    """They take acquisitions, not the verdict."""
    recording = simulated(acquisitions=18)
    times = recording.pulse_times
    double = np.sort(np.append(times, times[[60, 200, 350]] + np.array([0.013, 0.002, 0.031])))
    found = traced(replace(recording, pulse_times=double))
    content = report(found)
    assert found.verdict == 'none'
    assert content['missing_effects'] == []
    assert len(found.observation.acquisitions) >= 13
    (remark,) = content['remarks']
    assert remark.startswith(f'3 of {double.size} pulses are spurious')
    assert remark in summary(content)


@pytest.mark.parametrize('level', [0.0, 2.5])
def test_flat_tach_is_refused(level):
    flat = replace(simulated(acquisitions=2), pulse_times=None, tach_rate=5000.0,
                   tach=ArraySource(np.full((1, 8000), level)))
    with pytest.raises(RecordingError, match='0 keyphasor pulses, at least 3'):
        observe(flat, MODEL)
    few = replace(simulated(acquisitions=2), pulse_times=np.array([0.1, 0.14, 0.18]))
    with pytest.raises(RecordingError, match='1 trigger pulses of 3'):
        observe(few, replace(MODEL, pulses_per_revolution=4))


def geared(marks, step):
    """Return the machine with a target that turns once in `marks` / `step` cycles."""
    model = replace(MODEL, pulses_per_revolution=marks, pulses_per_trigger=step,
                    trigger_speed=SPEED * step / marks, ratio=marks / step)
    recording = simulated()
    times = recording.pulse_times
    count = step * (times.size - 1) + 1
    return replace(recording, pulse_times=np.interp(
        np.arange(count) / step, np.arange(times.size), times)), model


@pytest.fixture(scope='module')
def late_marks():
    """Return delays (s) of four marks, the recording, its model, and what is traced of them."""
    recording, model = geared(4, 1)
    late = np.array([2e-4, -1e-4, 0.0, -1e-4])
    recording = delayed(recording, late)
    return late, recording, model, traced(recording, model)


def delayed(recording, late):
    """Return the recording with pulses late by what `late` (s) repeats."""
    times = recording.pulse_times
    return replace(recording, pulse_times=times + np.resize(late, times.size))


@pytest.mark.machines
@pytest.mark.parametrize(('marks', 'step'), [(4, 4), (4, 1)])
def test_errors_that_repeat_with_no_revolution_are_no_target(marks, step):
    """They are a hum's, say, and the reader sees that they repeat."""
    recording, model = geared(marks, step)
    hum = 2e-4 * np.sin(2.0 * np.pi * (np.arange(5 * step) / step + 0.2) / 5.0)
    found = traced(delayed(recording, hum), model)
    assert found.verdict == 'unexplained'
    assert not found.findings
    assert ' of the pulses ' in found.remains


@pytest.mark.machines
def test_errors_that_repeat_with_the_revolution_are_a_target(late_marks):
    truth, _, model, found = late_marks
    (finding,) = found.findings
    rad = 2.0 * np.pi * model.trigger_speed
    off = np.array(finding.effect.pulse_angles) - rad * truth
    assert np.abs(off).max() < 4.0 * finding.standard_errors['pulse_angles'][0]


@pytest.mark.machines
def test_nothing_is_known_of_marks_that_begin_no_cycle():
    recording, model = geared(4, 2)
    (finding,) = traced(delayed(recording, [2e-4, 0.0, -2e-4, 0.0]), model).findings
    assert np.flatnonzero(finding.effect.pulse_angles).tolist() == [0, 2]
    assert np.isnan(finding.standard_errors['pulse_angles']).tolist() == [False, True] * 2
    assert '2 of the 4 marks' in finding.evidence


def test_declared_ratio_may_be_written_with_six_digits():
    """The recording has all digits."""
    recording = replace(simulated(), ratio=183 / 76)
    model = replace(MODEL, ratio=2.407895)
    assert record_pulses(recording, model).times.size == recording.pulse_times.size
    with pytest.raises(ModelError, match=r'declared as 2\.408 but the recording says 2\.40789474'):
        record_pulses(replace(recording, ratio=183 / 76), replace(MODEL, ratio=2.408))


@pytest.mark.machines
@pytest.mark.parametrize(('rate', 'said'), [(10_000.0, True), (5_040.0, False)])
def test_another_rate_of_the_tach_is_remarked(rate, said):
    recording = replace(simulated(acquisitions=2), tach_rate=5_000.0)
    content = report(traced(recording, replace(MODEL, keyphasor_rate=rate)))
    text = ("keyphasor_rate is declared as 10000 Hz but the recording's tach was sampled at "
            '5000 Hz: declare 5000')
    assert (text in content['remarks']) == (text in summary(content)) == said


@pytest.mark.machines
def test_declared_speed_does_not_enter_what_is_fitted(late_marks):
    """Fit and prediction share the measured speed; the report keeps the declared one."""
    _, recording, model, right = late_marks
    found = traced(recording, replace(model, trigger_speed=1.08 * model.trigger_speed))
    (finding,), (expected,) = found.findings, right.findings
    np.testing.assert_allclose(finding.effect.pulse_angles, expected.effect.pulse_angles)
    assert found.after.rms == pytest.approx(right.after.rms)
    content = report(found)
    assert content['declared']['trigger_speed'] == 1.08 * SPEED / 4
    assert content['measured_speed'] == pytest.approx(SPEED / 4, rel=1e-4)


def test_gap_turns_by_whole_cycles_whatever_the_speed():
    """The rounded speed at which acquisitions are predicted together must not count per gap."""
    recording = simulated()
    lost = replace(recording, pulse_times=np.delete(recording.pulse_times, [25, 60, 64, 108, 165]))
    effect = make_effect('missing_pulses', probability=0.02)
    found = []
    for share in (1.0, 1.0004):
        observation = observe(lost, MODEL)
        observation = replace(observation, model=replace(observation.model, trigger_speed=(
            share * observation.model.trigger_speed)))
        bench = make_bench(observation, [observation], [lost], ())
        found.append(bench.expect([effect], range(len(observation.acquisitions))).attenuation)
    np.testing.assert_allclose(found[0], found[1], atol=2e-5)


@pytest.mark.parametrize('cycles', [1, 4])
def test_too_few_trigger_cycles_are_named(cycles):
    with pytest.raises(ModelError, match=f'trigger_cycles is {cycles}: .* at least 5'):
        traced(simulated(acquisitions=2), replace(MODEL, trigger_cycles=cycles))


@pytest.mark.machines
def test_order_that_is_not_compared_is_named():
    content = report(traced(simulated(), replace(MODEL, orders=(8.0, 13.0, 16.0))))
    assert {item['order'] for item in content['lines']} == {8.0, 16.0}
    assert any(text.startswith('declared, but not compared: order 13')
               for text in content['remarks'])
    assert 'order 13' in summary(content)
