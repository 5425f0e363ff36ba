# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""How the residual moves with order, speed, frequency and cycles, and what that tells."""

from dataclasses import replace

import numpy as np
import pytest
from sa_jitter_ros.inference.benches import make_bench
from sa_jitter_ros.inference.dependence import dependences, moving
from sa_jitter_ros.inference.expectation import Memory
from sa_jitter_ros.inference.fewer_cycles import fewer_cycles
from sa_jitter_ros.inference.observation import observe
from sa_jitter_ros.inference.trace import trace
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.recordings.recording import ArraySource, Recording
from sa_jitter_ros.report.html_report import html
from sa_jitter_ros.report.report import report, summary
from sa_jitter_ros.report.words import verdict_sentence
from sa_jitter_ros.simulation.components import mesh
from sa_jitter_ros.simulation.effect import Effect
from sa_jitter_ros.simulation.effects import AdditiveNoise, DeclaredJitter, make_effects
from sa_jitter_ros.simulation.gearbox import Gearbox
from sa_jitter_ros.simulation.random_streams import RandomStream

pytestmark = pytest.mark.machines
RATE, SPEED, CYCLES, NOISE = 6000.0, 25.0, 20, 0.05
RAMP = (21.0, 29.0)
ON = ['order', 'speed', 'frequency', 'trigger_cycles']


class Pickup(Effect):
    """Known to no module: the slower a pickup's voltage rises, the more its noise shifts it."""

    def pulse_delay(self, setting, index, times):
        """Return the delay of each pulse, which falls with the third power of the speed."""
        noise = RandomStream(setting.seed, 'pickup').normal(int(index[0]), int(index[-1]) + 1)[0]
        return 80e-6 * (np.gradient(times) * SPEED) ** 3 * noise


def recorded(effects=(), *, seed, speeds=RAMP, ratio=1.0, acquisitions=24):
    """Return the recording of a machine that runs from one speed to another."""
    duration = (acquisitions * CYCLES + 3) / SPEED
    gearbox = Gearbox(
        mesh('shaft', 8, harmonics=(1.0, 0.8, 0.6, 0.5), channel_gains=(1.0, 0.7, 0.9), seed=seed),
        RATE, shafts={'shaft': ratio}, speed=((0.0, speeds[0] / ratio),
                                              (duration, speeds[1] / ratio)),
        effects=(AdditiveNoise(NOISE, name='declared_noise'),
                 DeclaredJitter('uniform', 1.0 / np.sqrt(12.0) / 5000.0), *effects), seed=seed)
    duration *= ratio
    return Recording(ArraySource(gearbox.vibration(0, round(duration * RATE))), RATE,
                     pulse_times=gearbox.pulses(0.0, duration).times, ratio=ratio)


def declared(*, ratio=1.0):
    """Return what is declared of it."""
    return DeclaredModel(
        keyphasor_rate=5000.0, trigger_speed=SPEED / ratio, trigger_cycles=CYCLES, ratio=ratio,
        orders=(8.0, 16.0, 24.0, 32.0), noise_std=NOISE, sample_rate=RATE)


def bench_of(recording, model):
    """Return the bench of one recording."""
    observation = observe(recording, model)
    return make_bench(observation, [observation], [recording], ())


def traced(*effects, seed, **options):
    """Return the trace of a machine with undeclared effects."""
    recording = recorded(effects, seed=seed, **options)
    return trace([observe(recording, declared())], [recording])


@pytest.fixture(scope='module')
def pickup():
    """Return the trace of a machine whose jitter falls with speed."""
    return traced(Pickup(), seed=2)


@pytest.mark.parametrize('ratio', [1.0, 2.40789])
def test_fewer_cycles_are_what_averaging_fewer_would_have_shown(ratio):
    model, count = declared(ratio=ratio), 5
    recording = recorded(seed=4, ratio=ratio, speeds=(SPEED, SPEED), acquisitions=6)
    bench = bench_of(recording, model)
    few = fewer_cycles(bench, count).observation
    shorter = observe(recording, replace(model, trigger_cycles=count),
                      sources=bench.observation.sources)
    for item in few.acquisitions:
        other = next(one for one in shorter.acquisitions if one.first == item.first)
        assert item.times == pytest.approx(other.times, abs=0.0)
        assert item.raw == pytest.approx(other.raw, abs=1e-3)
        assert np.abs(item.corrected) == pytest.approx(np.abs(other.corrected), abs=0.1)
    assert len(few.acquisitions) == CYCLES // count * len(bench.observation.acquisitions)


def test_held_out_acquisitions_stay_held_out():
    bench = bench_of(recorded(seed=4, acquisitions=6), declared())
    few = fewer_cycles(bench, 6)  # two cycles of each are left over
    firsts = [bench.observation.acquisitions[a].first for a in bench.held_out]
    assert [few.observation.acquisitions[a].first for a in few.held_out] == [
        first + start for first in firsts for start in (0, 6, 12)]
    assert [few.pulses[a][0].first for a in few.held_out] == [
        few.observation.acquisitions[a].first for a in few.held_out]
    assert all(len(few.pulses[a][0].times) == 7 for a in few.held_out)


def test_right_prediction_depends_on_nothing():
    found = traced(seed=0)
    assert found.verdict == 'none'
    assert [item.on for item in found.dependences_after] == ON
    assert moving(found.dependences_after) is None
    assert found.dependences_before == found.dependences_after


def test_steady_speed_tells_nothing_of_speed():
    found = traced(seed=1, speeds=(SPEED, SPEED), acquisitions=8)
    assert [item.on for item in found.dependences_after] == ['order', 'trigger_cycles']


def test_missing_jitter_grows_with_order_and_the_effect_ends_that():
    found = traced(*make_effects({'excess_jitter': {'std': 80e-6}}), seed=1)
    assert [item.name for item in found.findings] == ['excess_jitter']
    assert found.verdict == 'traced'
    before, after = found.dependences_before[0], found.dependences_after[0]
    assert before.on == 'order'
    assert (before.low, before.high) == (8.0, 32.0)
    assert before.change < -0.02
    assert before.p_value < 1e-3
    assert abs(after.change) < 3.0 * after.standard_error
    assert after.p_value > 1e-3


def test_dependence_judges_normal_errors_by_their_scatter(rng):
    """A residual of nothing but chance changes certainly in one of a thousand at most."""
    bench = bench_of(recorded(seed=2, acquisitions=12), declared())
    runs, p_values = 40, []
    for _ in range(runs):
        gain = 1.0 + 0.05 * rng.standard_normal(len(bench.observation.acquisitions))
        noisy = replace(bench.observation, acquisitions=tuple(
            replace(item, raw_cycles=item.raw_cycles * each)
            for item, each in zip(bench.observation.acquisitions, gain)))
        shaken = replace(bench, observation=noisy, memory=Memory(), fewer=None)
        p_values.append([item.p_value for item in dependences(shaken, (), ())
                         if item.on == 'speed'])
    share = np.mean(np.array(p_values) < 0.05)
    assert share <= 0.05 + 3.0 * np.sqrt(0.05 * 0.95 / runs)
    assert np.mean(np.array(p_values) < 0.5) >= 0.5 - 3.0 * np.sqrt(0.25 / runs)


def test_jitter_of_another_size_at_another_speed_is_not_blamed_on_a_steady_one(pickup):
    assert pickup.verdict == 'unexplained'


def test_jitter_that_changes_its_size_says_so(pickup):
    reasons = {item.name: item.rejected_because for item in pickup.candidates}
    assert 'times larger in some parts of the recording' in reasons['excess_jitter']
    assert 'times larger in some parts of the recording' in report(pickup)['remains']


def test_report_says_what_the_residual_changes_with(pickup):
    sure = tuple(replace(item, p_value=1e-5) for item in pickup.dependences_after)
    content = report(replace(pickup, dependences_after=sure, remains=str(sure[1])))
    assert [item['on'] for item in content['dependence']] == ON
    speed = content['dependence'][1]
    assert speed['unit'] == 'Hz'
    assert RAMP[0] < speed['low'] < speed['high'] < RAMP[1]
    assert speed['before']['change'] == pickup.dependences_before[1].change
    assert 'what is left changes' in summary(content)
    assert 'what is left changes' in verdict_sentence(content)
    page = html(content, (), {})
    assert 'Dependence of the residual' in page
    assert '>trigger cycles</td>' in page
