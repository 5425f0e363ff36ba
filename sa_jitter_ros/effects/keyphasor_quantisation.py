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
Keyphasor quantisation: pulse times on the grid of a clock, to which their errors are locked.

A clock of the declared keyphasor rate is the cause of the declared jitter: its errors replace the
independent ones. So do those of any clock whose ticks are not lost in a declared one, if the
declared jitter is that of the rate; jitter that is declared as such comes on top. Errors of a
steady machine repeat, p_{k+1} = p_k - T f mod 1, so that the mean over all starting phases need
not be what one average shows: where pulses were measured, the prediction is made for their own
phases.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.effects.effect import Effect, most_scenarios, parameter, require_in_turn
from sa_jitter_ros.effects.evidence import root
from sa_jitter_ros.effects.lattice import Clock, SLOPE_OFF
from sa_jitter_ros.effects.timing import Pattern, Setting
from sa_jitter_ros.prediction.distributions import Normal
from sa_jitter_ros.prediction.influence import AveragePulses
from sa_jitter_ros.prediction.model import DeclaredModel

_SEED = 6
_PARTS = 8


def _of_grid(setting: Setting) -> Array:
    """Return the errors that the grid of the clock imposes on a smooth motion, if there is one."""
    if setting.clock_errors is None:
        return np.zeros((0, setting.times.size))
    return np.asarray(setting.clock_errors)[None] / setting.unit


@dataclass(frozen=True)
class KeyphasorQuantisation(Effect):
    """Pulse times rounded up to a clock of `clock_rate` Hz, the period varying by `period_std`."""

    name: ClassVar[str] = 'keyphasor_quantisation'
    summary: ClassVar[str] = 'pulse times on the grid of a clock'
    meaning: ClassVar[str] = (
        'a clock rounds the pulse times to its ticks, so that the errors of neighbouring '
        'pulses depend on each other')
    remedy: ClassVar[str] = 'sample the keyphasor faster, or time its edges by a counter'
    timing: ClassVar[Pattern] = Pattern(_of_grid, off_by=SLOPE_OFF, replaces_jitter=True)
    clock_rate: float = parameter(10000.0, 'rate of the clock that times the pulses', 'Hz',
                                  above=0.0)
    period_std: float = parameter(0.0, 'standard deviation of the trigger period', 's',
                                  minimum=0.0)

    def scenarios(self, model: DeclaredModel) -> Array | None:
        """Return the errors for evenly spread phases of the first pulse on the grid."""
        require_in_turn('the tick of keyphasor_quantisation.clock_rate', 1.0 / self.clock_rate,
                        model)
        require_in_turn('the spread of keyphasor_quantisation.period_std',
                        Normal(self.period_std).width, model)
        return self.drawn_scenarios(model, most_scenarios(model))

    def drawn_scenarios(self, model: DeclaredModel, count: int) -> Array:
        """Return the errors for as many evenly spread phases."""
        rng = np.random.default_rng(_SEED)
        ticks = np.zeros((count, model.trigger_cycles + 1))
        ticks[:, 1:] = model.trigger_period
        if self.period_std:
            ticks[:, 1:] += self.period_std * rng.standard_normal((count, model.trigger_cycles))
        np.cumsum(ticks, axis=1, out=ticks)
        ticks *= self.clock_rate
        ticks += (rng.permutation(count)[:, None] + 0.5) / count
        return np.asarray((np.ceil(ticks) - ticks - 0.5) / self.clock_rate)

    def pattern(self, model: DeclaredModel, pulses: AveragePulses) -> Array | None:
        """Return the errors that follow from the measured times."""
        return pulses.errors

    def replaces_jitter(self, model: DeclaredModel) -> bool:
        """Return whether this clock is the declared one, or is read in its place."""
        other = model.jitter_std or model.jitter_distribution == 'table'
        seen = Clock(self.clock_rate, 0.0).visible(model.keyphasor_rate)
        return (seen and not other) or self.is_declared(model)

    def is_declared(self, model: DeclaredModel) -> bool:
        """Return whether this clock is the declared one."""
        return Clock(self.clock_rate, 0.0).same_as(model.keyphasor_rate)

    @classmethod
    def of_timing(cls, sizes: Array, errors: Array, setting: Setting
                  ) -> tuple['KeyphasorQuantisation', Mapping[str, Any]]:
        """Return the clock whose grid the pulses lie on, and how much the period varies."""
        periods = np.diff(setting.true_times)
        power = (periods - periods.mean()) ** 2
        # a slow speed moves neighbouring periods together: parts of the recording count
        parts = [part.mean() for part in np.array_split(power, _PARTS)]
        std, error = root(float(power.mean()), float(np.std(parts, ddof=1) / np.sqrt(_PARTS)))
        return cls(setting.clock_rate, std), {'clock_rate': None, 'period_std': error}

    def in_timing(self, setting: Setting) -> Array:
        """Return the slope of the errors over those that a grid imposes."""
        return np.ones(1)
