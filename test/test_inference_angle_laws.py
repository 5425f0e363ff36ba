# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The loop with every angle law: what is observed by a law is what is predicted for it."""

from dataclasses import replace

import numpy as np
import pytest
from sa_jitter_ros.averaging.average import AverageSettings
from sa_jitter_ros.averaging.cycle import CycleSamples
from sa_jitter_ros.averaging.shaft import ShaftAverager
from sa_jitter_ros.commands.close_loop import main
from sa_jitter_ros.inference.observation import observe
from sa_jitter_ros.inference.residual import ACCURACY
from sa_jitter_ros.inference.trace import trace
from sa_jitter_ros.prediction.distributions import Normal
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.prediction.prediction import predict
from sa_jitter_ros.recordings import read
from sa_jitter_ros.recordings.npz_format import write_npz
from sa_jitter_ros.recordings.recording import ArraySource, Recording
from sa_jitter_ros.report.report import report
from sa_jitter_ros.simulation.components import mesh
from sa_jitter_ros.simulation.effects import make_effects
from sa_jitter_ros.simulation.gearbox import Gearbox
from worse_pulses import with_added_jitter, with_slower_clock
import yaml

pytestmark = pytest.mark.usefixtures('unasked')
RATE, SPEED, CYCLES, JITTER = 5000.0, 25.0, 20, 2e-4
LAWS = ('linear', 'quadratic', 'spline')
MODEL = DeclaredModel(
    keyphasor_rate=5000.0, trigger_speed=SPEED, trigger_cycles=CYCLES, orders=(8.0, 16.0, 24.0),
    jitter_distribution='normal', jitter_std=JITTER)


def machine(*, acquisitions, seed=5, **effects):
    """Return the recording of a machine with exact pulses and `acquisitions` for every law."""
    gearbox = Gearbox(mesh('shaft', 8, harmonics=(1.0, 0.8, 0.6), channel_gains=(1.0,), seed=5),
                      RATE, speed=((0.0, SPEED),), effects=make_effects(effects), seed=seed)
    duration = (acquisitions * CYCLES + 20) / SPEED
    return Recording(ArraySource(gearbox.vibration(0, round(duration * RATE))), RATE,
                     pulse_times=gearbox.pulses(0.0, duration).times, description='simulated')


def wandering(*, acquisitions, seed=5):
    """Return one whose trigger period wanders over the ticks of a clock."""
    return machine(acquisitions=acquisitions, seed=seed, keyphasor_quantisation={
        'clock_rate': 1e7, 'period_std': 4e-6})


@pytest.mark.parametrize('law', LAWS)
def test_raw_amplitudes_are_those_of_the_averager(law):
    model = replace(MODEL, angle_law=law)
    recording = with_added_jitter(machine(acquisitions=2), Normal(JITTER), seed=1)
    samples = recording.read().T
    for item in observe(recording, model).acquisitions:
        shaft = ShaftAverager(AverageSettings(
            trigger_cycles=CYCLES, orders=model.orders, angle_law=law), first_cycle=0)
        for k in range(item.first, item.first + CYCLES):
            average = shaft.update(CycleSamples(samples, 0.0, RATE, recording.pulse_times, k))
        assert item.raw == pytest.approx(average.amplitudes, abs=1e-4)


@pytest.mark.machines
@pytest.mark.parametrize('law', LAWS)
def test_added_jitter_attenuates_as_predicted_for_the_law(law):
    model = replace(MODEL, angle_law=law)
    recording = with_added_jitter(machine(acquisitions=16), Normal(JITTER), seed=2)
    found = observe(recording, model)
    assert found.against_reference
    observed = found.stacked('attenuation')[:, 0]
    assert len(observed) == 16
    expected = predict(model)
    error = 4.5 * expected.standard_deviation / np.sqrt(len(observed))
    assert np.all(np.abs(observed.mean(axis=0) - expected.mean_attenuation) < error)
    others = [predict(replace(MODEL, angle_law=other)).mean_attenuation[-1]
              for other in LAWS if other != law]
    assert min(np.abs(expected.mean_attenuation[-1] - others)) > error[-1] / 4.5


@pytest.mark.machines
def test_slower_clock_of_two_recordings_is_predicted_pulse_by_pulse():
    clock = 1010.0  # 40.4 ticks a cycle: neighbouring errors are far from independent
    model = replace(MODEL, jitter_distribution='uniform', keyphasor_rate=clock, angle_law='spline',
                    trigger_cycles=2 * CYCLES)
    recordings = [with_slower_clock(wandering(acquisitions=6, seed=seed), clock)
                  for seed in (5, 6)]
    content = report(trace([observe(item, model) for item in recordings], recordings))
    assert content['acquisitions'] == {'fit': 3, 'held_out': 3}
    assert content['missing_effects'] == []
    assert 'clock_rate' in [item['parameter'] for item in content['declared_changes']]
    assert content['error_after']['rms'] < ACCURACY < 0.2 * content['error_as_declared']['rms']


def saved(folder, *recordings):
    """Save recordings and the declared model of a slow clock; return the command's arguments."""
    paths = [folder / f'{k}.npz' for k in range(len(recordings))]
    for path, recording in zip(paths, recordings):
        write_npz(path, recording)
    (folder / 'model.yaml').write_text(yaml.safe_dump({'/**': {'ros__parameters': {
        'keyphasor_rate': 1030.0, 'trigger_speed': SPEED, 'trigger_cycles': CYCLES,
        'orders': list(MODEL.orders)}}}))
    return [*map(str, paths), '--declared', str(folder / 'model.yaml'), '--output',
            str(folder / 'out'), '--quiet']


@pytest.mark.machines
@pytest.mark.parametrize(('clock', 'grid'), [(1470.0, 'a grid of 1470 Hz'),
                                             (2e6, 'no coarse grid')])
def test_recordings_by_different_clocks_are_refused(tmp_path, capsys, clock, grid):
    true = wandering(acquisitions=4)
    recordings = [with_slower_clock(true, rate) for rate in (1030.0, clock)]
    assert main(saved(tmp_path, *recordings)) == 2
    assert capsys.readouterr().err.splitlines() == [
        'close_loop: pulse times of recording 1 lie on a grid of 1030 Hz, those of recording 2 on '
        f'{grid}: one declared model holds for one clock; run the loop on each alone']
    assert not (tmp_path / 'out').exists()


@pytest.mark.machines
def test_gaps_cannot_be_identified_with_a_curved_angle_law():
    model = replace(MODEL, jitter_distribution='uniform', angle_law='spline')
    recording = machine(acquisitions=6, missing_pulses={'probability': 0.02})
    content = report(trace([observe(recording, model)], [recording]))
    assert content['declared']['angle_law'] == 'spline'
    assert content['verdict'] == 'unexplained'
    reasons = {item['name']: item['rejected_because'] for item in content['candidates']}
    assert 'no forward model; declare linear' in reasons['missing_pulses']


@pytest.mark.machines
def test_measured_gearbox_under_added_jitter(shared_data):
    """With the law that reads most pulses for each cycle."""
    whole = read(shared_data / 'gear0_gearbox.npz')
    recording = with_added_jitter(replace(
        whole, vibration=ArraySource(whole.read()[:2, :whole.samples // 2]), channel_names=(),
        units=(), pulse_times=whole.keyphasor_pulses(duration=0.5 * whole.duration)),
        Normal(6e-5), seed=4)
    model = DeclaredModel(keyphasor_rate=1e4, trigger_speed=33.33, trigger_cycles=40,
                          orders=(23.0, 46.0, 115.0), jitter_distribution='normal',
                          jitter_std=6e-5, angle_law='spline')
    found = observe(recording, model)
    observed, level = (np.abs(found.stacked(name)[..., :3]).mean(axis=0)
                       for name in ('attenuation', 'corrected'))
    expected = predict(model)
    best = observed[np.argmax(level, axis=0), np.arange(3)]
    error = 4.5 * expected.standard_deviation / np.sqrt(len(found.acquisitions))
    # what the orders leak into each other, and the reference's own jitter
    assert np.all(np.abs(best - expected.mean_attenuation) < error + 0.005)
