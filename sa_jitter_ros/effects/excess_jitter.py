# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Excess jitter: independent normal pulse errors beyond the declared ones (electrical noise)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from sa_jitter_ros.effects.effect import absent, Array, Effect, Finding, parameter, require_in_turn
from sa_jitter_ros.effects.evidence import Evidence, root
from sa_jitter_ros.effects.pulse_covariance import (
    fit_covariance, goodness_of_fit, memory_p_value, white)
from sa_jitter_ros.effects.slope_test import require_tach_side
from sa_jitter_ros.prediction.angle_error import AngleErrorProcess, IndependentPulseJitter
from sa_jitter_ros.prediction.distributions import Normal
from sa_jitter_ros.prediction.model import DeclaredModel

_HINT = 0.05  # the p value of a memory that is hardly chance, and no proof
_DECIDING = 'more acquisitions, or longer ones'


@dataclass(frozen=True)
class ExcessJitter(Effect):
    """Independent normal errors of `std` s on top of the declared jitter."""

    name: ClassVar[str] = 'excess_jitter'
    summary: ClassVar[str] = 'independent normal pulse errors'
    needs_pulse_errors: ClassVar[bool] = True
    std: float = parameter(0.0, 'standard deviation of additional normal pulse errors', 's',
                           minimum=0.0)

    def processes(self, model: DeclaredModel) -> Sequence[AngleErrorProcess]:
        """Return the independent pulse errors."""
        if self.std == 0.0:
            return ()
        distribution = Normal(self.std)
        require_in_turn('the spread of excess_jitter.std', distribution.width, model)
        return (IndependentPulseJitter(
            distribution, model.fundamental_frequency, model.weights),)

    def pulse_autocovariance(self, model: DeclaredModel, lags: Array) -> Array:
        """Return std^2 at lag 0."""
        return np.asarray(np.where(np.asarray(lags) == 0, self.std**2, 0.0))

    @classmethod
    def fit(cls, evidence: Evidence) -> Finding:
        """Fit the variance that the pulse errors have beyond the expected one."""
        fit = fit_covariance(evidence, white)
        std, error = root(fit.variance, fit.variance_error)
        if std == 0.0:
            return absent(cls.name, 'the pulse errors vary no more than declared')
        text = (f'the pulse errors have {fit.observed_std:.3g} s where '
                f'{fit.expected_std:.3g} s were expected, p = {fit.p_value:.2g}')
        contradiction = require_tach_side(evidence) or goodness_of_fit(evidence, fit)
        unsure = memory_p_value(evidence.of_all) < _HINT
        return Finding(
            cls.name, cls(std), {'std': error}, fit.p_value, text, contradiction,
            indistinguishable_from=('correlated_jitter',) if unsure else (),
            deciding_measurement=_DECIDING if unsure else '')
