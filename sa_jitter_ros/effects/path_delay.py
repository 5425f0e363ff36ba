# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
Path delay: the pulses come late by a constant time, relative to the vibration.

Where order g turns at the frequency f, a delay d turns it by 2 pi g f d. At constant speed that is
a phase, the same in every average. Where the speed changes from average to average, the phase
follows it; where it changes within one, the cycles turn apart and the amplitude shrinks.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.effects.effect import Effect, parameter
from sa_jitter_ros.effects.timing import Pattern, Setting
from sa_jitter_ros.prediction.influence import AveragePulses, trigger_periods
from sa_jitter_ros.prediction.model import DeclaredModel

#: Filters and converters seldom delay by more (s).
USUAL_DELAY = 5e-3
#: Relative spread of speeds below which nothing follows the speed, and a delay is a phase.
STEADY = 1e-4


def _of_speed(setting: Setting) -> Array:
    """Return a delay less the turn of all, which takes longer when slow; none if steady."""
    period = trigger_periods(setting.true_times)
    longer = period / setting.common_period - 1.0
    return np.asarray(-longer)[None] if np.std(longer) > STEADY else np.zeros((0, period.size))


@dataclass(frozen=True)
class PathDelay(Effect):
    """
    Measured pulses are late by `delay` s, those of all cycles alike.

    What the keyphasor's path delays more than that of the vibration counts positive.
    """

    name: ClassVar[str] = 'path_delay'
    summary: ClassVar[str] = 'pulses late by a constant time'
    meaning: ClassVar[str] = (
        'the pulses come late by a constant time, which turns the phases as the speed '
        'changes')
    remedy: ClassVar[str] = 'give the delay to the averager (path_delay)'
    timing: ClassVar[Pattern] = Pattern(
        _of_speed, show_in_times=False, usual=lambda setting: USUAL_DELAY / setting.unit)
    delay: float = parameter(0.0, 'delay of the pulses behind the vibration',
                             's', minimum=-1.0, maximum=1.0)

    @classmethod
    def of_timing(cls, sizes: Array, errors: Array, setting: Setting
                  ) -> tuple['PathDelay', Mapping[str, Any]]:
        """Return the delay of some units."""
        return cls(setting.unit * float(sizes[0])), {
            'delay': setting.unit * float(np.sqrt(errors[0, 0]))}

    def in_timing(self, setting: Setting) -> Array:
        """Return the delay in units."""
        return np.array([self.delay / setting.unit])

    def gain(self, model: DeclaredModel) -> ArrayLike:
        """Return the turn of each order at the speed of the model."""
        if self.delay == 0.0:
            return 1.0
        turns = np.asarray(model.orders) * model.fundamental_frequency * self.delay
        return np.asarray(np.exp(2j * np.pi * turns))

    def pattern(self, model: DeclaredModel, pulses: AveragePulses) -> Array | None:
        """
        Return what the change of speed within the average at hand makes of the delay.

        Angle errors count in s at the mean speed f of the average: a pulse at the speed f_k is
        late by delay f_k of a revolution, delay (f_k / f - 1) beyond the turn of all.
        """
        if self.delay == 0.0 or not np.any(np.isfinite(pulses.times)):
            return None
        return np.asarray(self.delay * (pulses.relative_speed - 1.0))
