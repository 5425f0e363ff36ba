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
independent ones. The errors of a clock of another rate are added. Errors of a steady machine
repeat, p_{k+1} = p_k - T f mod 1, so that the mean over all starting phases need not be what one
average shows: where pulses were measured, the prediction is made for their own phases.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from sa_jitter_ros.effects.effect import (
    absent, Array, Effect, Finding, most_scenarios, parameter, require_in_turn)
from sa_jitter_ros.effects.evidence import Evidence, root
from sa_jitter_ros.prediction.distributions import Normal
from sa_jitter_ros.prediction.influence import Pulses
from sa_jitter_ros.prediction.model import DeclaredModel
from scipy import stats

_PHASES, _SEED = 128, 6
_SAME_RATE = 0.01
_SIGNIFICANT = 1e-4
# Least correlation of the errors with those that a grid imposes; what the grid does not see of the
# motion makes the slope flatter, but other errors make it steeper.
_ALIKE, _STEEPEST = 0.5, 1.5


@dataclass(frozen=True)
class KeyphasorQuantisation(Effect):
    """Pulse times rounded up to a clock of `clock_rate` Hz, the period varying by `period_std`."""

    name: ClassVar[str] = 'keyphasor_quantisation'
    summary: ClassVar[str] = 'pulse times on the grid of a clock'
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
        return self.drawn_scenarios(model, most_scenarios(model, _PHASES))

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

    def pattern(self, model: DeclaredModel, pulses: Pulses) -> Array | None:
        """Return the errors that follow from the measured times."""
        return pulses.errors

    def replaces_jitter(self, model: DeclaredModel) -> bool:
        """Return whether this clock is the declared one."""
        return abs(self.clock_rate / model.keyphasor_rate - 1.0) < _SAME_RATE

    @classmethod
    def fit(cls, evidence: Evidence) -> Finding:
        """Test whether the errors are those that the grid of the pulse times imposes."""
        clock = evidence.clock.rate
        if not clock > 0.0:
            return absent(cls.name, 'the pulse times lie on no grid of a clock')
        known = np.array([pulses.errors for pulses in evidence.pulses], dtype=float)
        errors, known = evidence.errors.ravel(), known - known.mean(axis=1, keepdims=True)
        correlation, p_value = stats.pearsonr(errors, known.ravel())
        slope = float(errors @ known.ravel() / np.sum(known**2))
        std, std_error = _period_std(evidence)
        text = (f'the pulse times lie on a grid of {clock:.6g} Hz, and the errors that the grid '
                f'imposes on a smooth motion are the recovered ones: correlation '
                f'{correlation:.3f}, slope {slope:.2f}, p = {p_value:.2g}')
        if p_value > _SIGNIFICANT or correlation < _ALIKE or slope > _STEEPEST:
            return absent(cls.name, f'the pulse times lie on a grid of {clock:.6g} Hz, but their '
                          f'errors are others: correlation {correlation:.3f}, slope {slope:.2f}',
                          p_value=p_value)
        return Finding(cls.name, cls(clock, std),
                       {'clock_rate': evidence.clock.standard_error, 'period_std': std_error},
                       float(p_value), text)


def _period_std(evidence: Evidence) -> tuple[float, float]:
    """
    Return the standard deviation of the trigger period in s and its standard error.

    True pulses are the measured ones less their errors, whose noise is taken out of the periods'
    variance. A slow speed moves neighbouring periods together: acquisitions count, not periods.
    """
    periods = np.diff(evidence.unexplained_times - evidence.errors, axis=1)
    noise = np.nan_to_num(evidence.standard_errors) ** 2
    rows = np.mean((periods - periods.mean()) ** 2 - noise[:, 1:] - noise[:, :-1], axis=1)
    return root(float(rows.mean()), float(rows.std(ddof=1) / np.sqrt(rows.size)))
