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

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import math
from typing import Any, ClassVar

import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.effects.effect import Effect, parameter, require_in_turn
from sa_jitter_ros.effects.timing import (
    autoregressive, FAINT, LARGE, PULSES, ROUNDING, Setting, Spectrum)
from sa_jitter_ros.prediction.angle_error import AngleErrorProcess, GaussianPulseJitter
from sa_jitter_ros.prediction.distributions import Normal
from sa_jitter_ros.prediction.model import DeclaredModel


@dataclass(frozen=True)
class CorrelatedJitter(Effect):
    """Normal errors of `std` s, pulses k apart correlated by `correlation^k`."""

    name: ClassVar[str] = 'correlated_jitter'
    summary: ClassVar[str] = 'normal pulse errors with memory'
    meaning: ClassVar[str] = (
        'pulses come early or late at random, neighbouring ones alike, as with a trigger '
        'level that wanders')
    remedy: ClassVar[str] = (
        'set the trigger level on the steepest part of the edge, and check the supply of '
        'the sensor')
    timing: ClassVar[Spectrum] = Spectrum(
        PULSES, autoregressive, ((0.5, 0.8), (0.5, -0.5), (-1.5, 0.6)), (FAINT, -2.0),
        (LARGE, None))
    std: float = parameter(0.0, 'standard deviation of correlated pulse errors', 's', minimum=0.0)
    correlation: float = parameter(
        0.5, 'correlation of the errors of neighbouring trigger pulses', '1', minimum=-0.999,
        maximum=0.999)

    def processes(self, model: DeclaredModel) -> Sequence[AngleErrorProcess]:
        """Return the angle errors that first-order autoregressive pulse errors cause."""
        if self.std == 0.0:
            return ()
        require_in_turn('the spread of correlated_jitter.std', Normal(self.std).width, model)
        variance = (self.std * model.fundamental_frequency) ** 2
        rho = abs(self.correlation)
        memory = 1 if rho < ROUNDING else 1 + math.ceil(math.log(ROUNDING) / math.log(rho))
        reach = memory + model.weights.pulses - 2
        return (GaussianPulseJitter.through(
            model.weights, lambda lags: variance * self.correlation ** np.abs(lags),
            min(reach, model.trigger_cycles)),)

    def pulse_autocovariance(self, model: DeclaredModel, lags: Array) -> Array:
        """Return std^2 correlation^|lag|."""
        return np.asarray(self.std**2 * self.correlation ** np.abs(lags))

    @classmethod
    def of_timing(cls, sizes: Array, errors: Array, setting: Setting
                  ) -> tuple['CorrelatedJitter', Mapping[str, Any]]:
        """Return standard deviation and correlation of a logarithm of power and an artanh."""
        std = float(setting.unit * np.exp(0.5 * sizes[0]))
        rho = float(np.tanh(sizes[1]))
        return cls(std, rho), {'std': 0.5 * std * float(errors[0]),
                               'correlation': (1.0 - rho**2) * float(errors[1])}

    def in_timing(self, setting: Setting) -> Array:
        """Return the logarithm of the power and the artanh of the correlation."""
        return np.array([2.0 * np.log(max(self.std / setting.unit, 1e-9)),
                         np.arctanh(self.correlation)])
