# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Jitter that changes with the speed, which no effect describes."""

import numpy as np
import pytest
from sa_jitter_ros.inference.observation import observe
from sa_jitter_ros.inference.trace import trace
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.recordings.recording import ArraySource, Recording
from sa_jitter_ros.report.report import report
from sa_jitter_ros.simulation.components import mesh
from sa_jitter_ros.simulation.effect import Effect
from sa_jitter_ros.simulation.effects import AdditiveNoise, DeclaredJitter
from sa_jitter_ros.simulation.gearbox import Gearbox
from sa_jitter_ros.simulation.random_streams import RandomStream

pytestmark = [pytest.mark.machines, pytest.mark.usefixtures('unasked')]
RATE, SPEED, CYCLES, NOISE = 6000.0, 25.0, 20, 0.05


class Pickup(Effect):
    """Known to no module: the slower a pickup's voltage rises, the more its noise shifts it."""

    def pulse_delay(self, setting, index, times):
        """Return the delay of each pulse, which falls with the third power of the speed."""
        noise = RandomStream(setting.seed, 'pickup').normal(int(index[0]), int(index[-1]) + 1)[0]
        return 80e-6 * (np.gradient(times) * SPEED) ** 3 * noise


@pytest.fixture(scope='module')
def pickup():
    """Return the trace of a machine that speeds up, and whose jitter falls with the speed."""
    duration = (24 * CYCLES + 3) / SPEED
    gearbox = Gearbox(
        mesh('shaft', 8, harmonics=(1.0, 0.8, 0.6, 0.5), channel_gains=(1.0, 0.7), seed=2),
        RATE, speed=((0.0, 21.0), (duration, 29.0)), seed=2, effects=(
            AdditiveNoise(NOISE, name='declared_noise'),
            DeclaredJitter('uniform', 1.0 / np.sqrt(12.0) / 5000.0), Pickup()))
    recording = Recording(ArraySource(gearbox.vibration(0, round(duration * RATE))), RATE,
                          pulse_times=gearbox.pulses(0.0, duration).times)
    model = DeclaredModel(
        keyphasor_rate=5000.0, trigger_speed=SPEED, trigger_cycles=CYCLES,
        orders=(8.0, 16.0, 24.0, 32.0), noise_std=NOISE, sample_rate=RATE)
    return trace([observe(recording, model)], [recording])


def test_jitter_of_another_size_at_another_speed_is_not_blamed_on_a_steady_one(pickup):
    assert pickup.verdict == 'unexplained'


def test_jitter_that_changes_its_size_says_so(pickup):
    reasons = {item.name: item.rejected_because for item in pickup.candidates}
    assert 'times larger in some parts of the recording' in reasons['excess_jitter']
    assert 'times larger in some parts of the recording' in report(pickup)['remains']
