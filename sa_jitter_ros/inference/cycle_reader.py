# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Trigger cycles of a recording, and their amplitudes."""

from dataclasses import dataclass

import numpy as np
from sa_jitter_ros.arrays import ComplexArray, FloatArray
from sa_jitter_ros.averaging.average import AverageSettings
from sa_jitter_ros.averaging.cycle import CycleSamples
from sa_jitter_ros.averaging.shaft import ShaftAverager
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.pulses.angle_law import AngleLaw, LINEAR_LAW
from sa_jitter_ros.pulses.resampling import margin

#: Samples on either side of a cycle, for interpolation, which reads 8, and for corrected pulses
#: that lie outside the measured ones. With more of them, more cycles beside gaps and ends are
#: lost.
MARGIN = 40
#: How samples are read between samples.
METHOD = 'band_limited'


@dataclass(frozen=True)
class CycleReader:
    """Reads trigger cycles of a recording: `samples` (sample, channel) from `start_time` (s)."""

    samples: FloatArray
    start_time: float
    rate: float

    def inside(self, times: FloatArray) -> bool:
        """Whether the cycles between these pulses (s) are inside the samples."""
        reach = margin(METHOD) + 1
        position = (times[[0, -1]] - self.start_time) * self.rate
        return bool(position[0] >= reach and position[1] <= len(self.samples) - 1 - reach)

    def cycles(self, pulses: FloatArray, *, law: AngleLaw = LINEAR_LAW,
               ripple: FloatArray | float = 0.0) -> CycleSamples:
        """
        Return the trigger cycles between pulses.

        `pulses` (s) are those of the cycles and the others that the `law` uses; `ripple` (s) is
        the speed ripple in each cycle.
        """
        return CycleSamples.cut(
            self.samples, start_time=self.start_time, rate=self.rate, pulses=pulses,
            first=law.before, margin=MARGIN, ripple=ripple,
            count=len(pulses) - 1 - law.before - law.after)

    def amplitudes(self, cycles: CycleSamples, model: DeclaredModel, orders: FloatArray,
                   law: AngleLaw = LINEAR_LAW) -> ComplexArray:
        """Return what the averager makes of cycles from angle 0: (cycle, channel, order)."""
        return ShaftAverager(AverageSettings(
            cycle_length=model.cycle_length, trigger_cycles=cycles.count,
            orders=tuple(orders.tolist()), angle_law=law.name, interpolation=METHOD,
            revolutions_per_trigger=model.revolutions_per_trigger)).amplitudes(cycles)


def kept_apart(cycle_length: float, orders: FloatArray) -> bool:
    """Whether all orders have whole cycles in a trigger cycle of this length."""
    cycles = cycle_length * orders
    return bool(np.allclose(cycles, np.rint(cycles), rtol=0.0))
