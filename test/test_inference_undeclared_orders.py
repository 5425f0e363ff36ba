# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Orders beside the declared ones, found in vibration whose truth is known."""

import numpy as np
import pytest
from sa_jitter_ros.inference.observation import observe
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.recordings.recording import ArraySource, Recording

RATE, SPEED, CYCLES, ACQUISITIONS = 5000.0, 25.0, 20, 8
TONE = 560.0  # Hz


def sources(rng, ratio, orders, *, drift, tone=0.0):
    """Return the sources found beside order 8, amplitudes of `orders` by order."""
    time = np.arange(int((ACQUISITIONS * CYCLES + 4) / SPEED * RATE)) / RATE
    turns = SPEED * (time + 0.5 * drift * time**2 / time[-1])
    vibration = sum(size * np.cos(2.0 * np.pi * order * ratio * turns)
                    for order, size in orders.items())
    vibration = vibration + tone * np.cos(2.0 * np.pi * TONE * time)
    vibration += 0.02 * rng.standard_normal(time.size)
    pulses = np.interp(np.arange(0.5, turns[-1]), turns, time)
    pulses = pulses + rng.uniform(-0.5, 0.5, pulses.size) / 10000.0
    model = DeclaredModel(keyphasor_rate=10000.0, trigger_speed=SPEED, trigger_cycles=CYCLES,
                          ratio=ratio, orders=(8.0,), sample_rate=RATE)
    return observe(Recording(ArraySource(vibration[None]), RATE, pulse_times=pulses), model
                   ).sources[1:]


def test_orders_of_other_shafts_are_found_and_tones_are_not(rng):
    orders = {8.0: 1.0, 8.37: 0.2, 12.3: 0.1}
    found = sources(rng, 2.4, orders, drift=0.01, tone=0.3)
    # places of single acquisitions scatter by 0.04 of what an average resolves; of 5, 3 errors
    np.testing.assert_allclose(found, [8.37, 12.3],
                               atol=3.0 * 0.04 / np.sqrt(5.0) / (CYCLES * 2.4))


@pytest.mark.parametrize(('other', 'count'), [(9.0, 1), (9.0 + 1.0 / 3.0, 1), (9.04, 0)])
def test_a_steady_machine_tells_only_orders_that_its_shafts_have(rng, other, count):
    found = sources(rng, 3.0, {8.0: 1.0, other: 0.2}, drift=0.0)
    assert found.size == count
