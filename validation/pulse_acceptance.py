# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Table 3 through `average`: which of its jittered pulses the validation of pulses accepts."""

from dataclasses import asdict, dataclass
import math
from typing import Any
import warnings

import numpy as np
from numpy.typing import NDArray
import sa_jitter_ros as sa
from validation.order_tracking import HarmonicCase
from validation.results import agreement, Effort, Finding, Progress, Results
from validation.single_harmonic import TABLE_3

Array = NDArray[Any]

LEARNT, WIDE = 0.0, 0.45  # interval_tolerance: the default, and the remedy
_SAMPLE_RATE = 256.0  # Hz; only the number of averaged cycles is looked at
_SEEDS = 2_000_000
_FEW = 1e-3  # of all cycles


@dataclass(frozen=True)
class Losses:
    """Trigger cycles lost in `recordings` of `cycles` each, and in how many of them any was."""

    recordings: int
    cycles: int
    lost: int
    with_losses: int

    @property
    def share(self) -> float:
        """Return the share of all cycles that was lost."""
        return self.lost / (self.recordings * self.cycles)


def losses(number: int, recordings: int, tolerance: float) -> Losses:
    """Return what `average` loses in recordings of a simulation of Table 3."""
    _, trigger_cycles, ratio, width = TABLE_3[number - 1]
    case = HarmonicCase(trigger_cycles, ratio, width, sample_rate=_SAMPLE_RATE)
    stop = (trigger_cycles + 1.0) * case.trigger_period
    vibration = case.machine(0).vibration(0, math.ceil(stop * _SAMPLE_RATE))
    lost = np.array([trigger_cycles - _averaged(case, vibration, _SEEDS * number + seed, tolerance)
                     for seed in range(recordings)])
    return Losses(recordings, trigger_cycles, int(lost.sum()), int(np.count_nonzero(lost)))


def _averaged(case: HarmonicCase, vibration: Array, seed: int, tolerance: float) -> int:
    """Return the number of trigger cycles in the averages of one recording."""
    stop = (case.trigger_cycles + 0.75) * case.trigger_period
    pulses = case.machine(seed).pulses(0.0, stop).times
    with warnings.catch_warnings():
        warnings.simplefilter('ignore', sa.DataWarning)
        averages = sa.average(vibration, _SAMPLE_RATE, pulses, ratio=case.cycle_length,
                              orders=[1.0], interval_tolerance=tolerance)
    return sum(average.trigger_cycles for average in averages)


def run(effort: Effort, progress: Progress) -> Results:
    """Count what `average` loses of the recordings of Table 3."""
    found: dict[int, tuple[Losses, Losses]] = {}
    recordings = max(effort.simulations // 3, 1)
    for number, *_ in TABLE_3:
        learnt, wide = (losses(number, recordings, tolerance)
                        for tolerance in (LEARNT, WIDE))
        found[number] = learnt, wide
        progress(number / len(TABLE_3))
    numbers = {str(number): {'learnt': asdict(learnt), f'{WIDE}': asdict(wide)}
               for number, (learnt, wide) in found.items()}
    return Results(
        'Pulse validation under jitter: Table 3 through `average`', numbers, (_finding(found),),
        {}, ('The other parts of this page average between the pulses as they are, without '
             'validation, as the paper does; `average`, the library and the nodes validate them '
             'first.',))


def _finding(found: dict[int, tuple[Losses, Losses]]) -> Finding:
    first, _ = found[1]
    default, wide = (sum(item[k].lost for item in found.values()) for k in (0, 1))
    total = sum(item.recordings * item.cycles for item, _ in found.values())
    return Finding(
        'Table 3', 'all N_t trigger cycles of a recording are averaged',
        f'{default} of {total} are lost (simulation 1: {first.lost} of '
        f'{first.recordings * first.cycles}), with `interval_tolerance` {WIDE} {wide}',
        agreement(default == 0, wide <= _FEW * total),
        'So large a jitter looks like stray or missing pulses: set `interval_tolerance` to '
        f'{WIDE} if it is a tenth of an interval or more.')
