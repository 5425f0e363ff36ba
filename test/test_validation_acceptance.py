# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Which pulses of the paper's cases `average` accepts, and that it tells of the others."""

import pytest
import sa_jitter_ros as sa
from validation import pulse_acceptance
from validation.order_tracking import HarmonicCase


def test_default_tolerances_lose_cycles_of_case_1_and_a_wide_one_does_not():
    learnt, wide = (pulse_acceptance.losses(1, 20, tolerance)
                    for tolerance in (pulse_acceptance.LEARNT, pulse_acceptance.WIDE))
    assert learnt.recordings == 20
    assert learnt.cycles == 40
    assert 1 <= learnt.with_losses <= 10
    assert learnt.with_losses <= learnt.lost
    assert wide.lost <= 1  # a first pulse
    assert learnt.share > 3.0 * wide.share


def test_average_tells_what_it_loses():
    case = HarmonicCase(40, 1.0, 0.2, sample_rate=256.0)
    vibration = case.machine(0).vibration(0, round(41.0 * case.trigger_period * 256.0))
    pulses = [case.machine(seed).pulses(0.0, 40.75 * case.trigger_period).times
              for seed in range(27)]
    with pytest.warns(sa.DataWarning, match='1 trigger cycles were discarded'):
        found = sa.average(vibration, 256.0, pulses[26], orders=[1.0])
    assert sum(average.trigger_cycles for average in found) < 40
    found, = sa.average(vibration, 256.0, pulses[26], orders=[1.0], interval_tolerance=0.45)
    assert found.trigger_cycles == 40
