# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Correlated jitter: normal pulse errors with memory (a wandering trigger level)."""

from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import ClassVar

import numpy as np
from sa_jitter_ros.effects.effect import absent, Array, Effect, Finding, parameter, require_in_turn
from sa_jitter_ros.effects.evidence import Evidence, root
from sa_jitter_ros.effects.pulse_covariance import fit_memory, goodness_of_fit, memory_p_value
from sa_jitter_ros.effects.slope_test import require_tach_side
from sa_jitter_ros.prediction.angle_error import AngleErrorProcess, GaussianPulseJitter
from sa_jitter_ros.prediction.distributions import Normal
from sa_jitter_ros.prediction.model import DeclaredModel

_FORGOTTEN = 1e-3
_SIGNIFICANT = 0.01  # the better of two explanations, not the existence of one


@dataclass(frozen=True)
class CorrelatedJitter(Effect):
    """Normal errors of `std` s, pulses k apart correlated by `correlation^k`."""

    name: ClassVar[str] = 'correlated_jitter'
    summary: ClassVar[str] = 'normal pulse errors with memory'
    needs_pulse_errors: ClassVar[bool] = True
    std: float = parameter(0.0, 'standard deviation of correlated pulse errors', 's', minimum=0.0)
    correlation: float = parameter(0.5, 'correlation of neighbouring pulse errors', '1',
                                   minimum=-0.999, maximum=0.999)

    def processes(self, model: DeclaredModel) -> Sequence[AngleErrorProcess]:
        """Return the angle errors that first-order autoregressive pulse errors cause."""
        if self.std == 0.0:
            return ()
        require_in_turn('the spread of correlated_jitter.std', Normal(self.std).width, model)
        variance = (self.std * model.fundamental_frequency) ** 2
        rho = abs(self.correlation)
        memory = 1 if rho < _FORGOTTEN else 1 + math.ceil(math.log(_FORGOTTEN) / math.log(rho))
        reach = memory + model.weights.pulses - 2
        return (GaussianPulseJitter.through(
            model.weights, lambda lags: variance * self.correlation ** np.abs(lags),
            min(reach, model.trigger_cycles)),)

    def pulse_autocovariance(self, model: DeclaredModel, lags: Array) -> Array:
        """Return std^2 correlation^|lag|."""
        return np.asarray(self.std**2 * self.correlation ** np.abs(lags))

    @classmethod
    def fit(cls, evidence: Evidence) -> Finding:
        """Fit variance and memory of the pulse errors; independent errors are `excess_jitter`."""
        fit = fit_memory(evidence)
        std, error = root(fit.variance, fit.variance_error)
        if std == 0.0:
            return absent(cls.name, 'the pulse errors vary no more than declared')
        p_value = memory_p_value(evidence.of_all)
        text = (f'pulse errors of {std:.3g} s correlated by {fit.shape:.2f} from pulse to pulse, '
                f'p = {p_value:.2g} if they were independent')
        if p_value > _SIGNIFICANT:
            return absent(cls.name, f'the pulse errors are not correlated: {text}',
                          p_value=p_value)
        contradiction = require_tach_side(evidence) or goodness_of_fit(evidence, fit)
        return Finding(cls.name, cls(std, fit.shape),
                       {'std': error, 'correlation': fit.shape_error},
                       min(p_value, fit.p_value), text, contradiction)
