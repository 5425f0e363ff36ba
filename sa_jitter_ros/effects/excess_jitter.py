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

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.effects.effect import Effect, parameter, require_in_turn
from sa_jitter_ros.effects.timing import FAINT, LARGE, PULSES, Setting, Spectrum, white
from sa_jitter_ros.prediction.angle_error import AngleErrorProcess, IndependentPulseJitter
from sa_jitter_ros.prediction.distributions import Normal
from sa_jitter_ros.prediction.model import DeclaredModel


@dataclass(frozen=True)
class ExcessJitter(Effect):
    """Independent normal errors of `std` s on top of the declared jitter."""

    name: ClassVar[str] = 'excess_jitter'
    summary: ClassVar[str] = 'independent normal pulse errors'
    meaning: ClassVar[str] = (
        'pulses come early or late at random, each on its own, by more than was declared')
    remedy: ClassVar[str] = (
        'look for noise on the keyphasor: trigger level, cable, earth, distance and edge '
        'of the target')
    timing: ClassVar[Spectrum] = Spectrum(PULSES, white, ((0.0,),), (FAINT,), (LARGE,))
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
    def of_timing(cls, sizes: Array, errors: Array, setting: Setting
                  ) -> tuple['ExcessJitter', Mapping[str, Any]]:
        """Return the standard deviation of a logarithm of power."""
        std = float(setting.unit * np.exp(0.5 * sizes[0]))
        return cls(std), {'std': 0.5 * std * float(errors[0])}

    def in_timing(self, setting: Setting) -> Array:
        """Return the logarithm of the power."""
        return np.array([2.0 * np.log(max(self.std / setting.unit, 1e-9))])
