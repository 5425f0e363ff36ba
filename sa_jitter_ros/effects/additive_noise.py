# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Additive noise: white noise on the vibration that the declared model lacks."""

from dataclasses import dataclass
import math
from typing import ClassVar

import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.effects.effect import (
    absent, beyond_chance, DirectEffect, Effect, Finding, largest_power, ODDS, parameter, weighed)
from sa_jitter_ros.effects.evidence import Evidence, root
from sa_jitter_ros.errors import ModelError
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.prediction.moments import noise_line_variance

# What weak lines that nobody declared leave in the noise beside an order, in parts of it.
_LINES = 0.01


@dataclass(frozen=True)
class AdditiveNoise(DirectEffect):
    """White noise of `std` per vibration sample, on top of the declared noise."""

    name: ClassVar[str] = 'additive_noise'
    summary: ClassVar[str] = 'white noise on the vibration'
    meaning: ClassVar[str] = (
        'the vibration holds more noise than was declared: amplitudes scatter more, but '
        'none is lost')
    remedy: ClassVar[str] = 'average more cycles (trigger_cycles)'
    scatters: ClassVar[bool] = True
    std: float = parameter(0.0, 'standard deviation per sample, units as noise_std', '1',
                           minimum=0.0)

    def line_variance(self, model: DeclaredModel) -> Array:
        """Return E|n|^2 of a peak amplitude; raise ModelError without a sample rate."""
        if self.std > 0.0 and not model.sample_rate > 0.0:
            raise ModelError('sample_rate is 0: additive_noise.std is per sample, so declare '
                             'sample_rate')
        variance = (noise_line_variance(self.std, model.sample_rate, model.duration)
                    if self.std > 0.0 else 0.0)
        return np.full(len(model.orders), variance)

    @classmethod
    def _power(cls, evidence: Evidence) -> tuple[float, float, float]:
        """Return the declared power of the noise, that around the lines, and its error."""
        known = evidence.model.noise**2 + sum(
            effect.std**2 for effect in evidence.explained if isinstance(effect, cls))
        power = evidence.lines.noise_density**2
        count, width = power.shape
        if not width:
            return known, math.nan, math.nan
        value = float(np.median(power.mean(axis=0)))
        # Of a median over lines of means over acquisitions; lines of other noise do not count.
        scatter = float(np.median(power.std(axis=0, ddof=1)))
        return known, value, scatter * math.sqrt(
            max(1.0, 0.5 * math.pi * (width > 2)) / (count * width))

    @classmethod
    def limit(cls, evidence: Evidence) -> Effect | None:
        """Return the noise beyond the declared one that the noise around the lines allows."""
        known, value, error = cls._power(evidence)
        if not 0.0 < error < math.inf:
            return None
        power = largest_power(value - known, 2.0 * (value / error) ** 2, known, known**2, 1.0)
        return None if math.isinf(power) else cls(math.sqrt(power))

    @classmethod
    def fit(cls, evidence: Evidence) -> Finding:
        """Fit the noise around the lines, beyond what was declared."""
        known, value, error = cls._power(evidence)
        if not (value > known and error > 0.0):
            return absent(cls.name, 'the noise around the lines is not above the declared one')
        error = math.hypot(error, 2.0 * _LINES * value)
        std, std_error = root(value - known, error)
        text = (f'the lines scatter as white noise of {np.sqrt(value):.3g} per sample '
                'would make them, '
                + (f'noise_std is {np.sqrt(known):.3g}' if evidence.model.noise_is_declared
                   else 'and noise_std is not declared'))
        return weighed(Finding(cls.name, cls(std), {'std': std_error}, 1.0, text),
                       _likelihood((value - known) / error, evidence), 1, evidence)


def measured_noise(evidence: Evidence) -> tuple[float, float] | None:
    """Return the noise per sample, and its error, None where no line shows it."""
    _, value, error = AdditiveNoise._power(evidence)
    if not (value > 0.0 and error > 0.0):
        return None
    return root(value, math.hypot(error, 2.0 * _LINES * value))


def less_noise(evidence: Evidence) -> tuple[float, float] | None:
    """Return the noise per sample, and its error, where it is certainly less than declared."""
    known, value, error = AdditiveNoise._power(evidence)
    if not (known > value > 0.0 and error > 0.0):
        return None
    error = math.hypot(error, 2.0 * _LINES * value)
    gain = beyond_chance(_likelihood((value - known) / error, evidence), 1, evidence.cycles)
    return root(value, error) if gain > ODDS else None


def _likelihood(apart: float, evidence: Evidence) -> float:
    """
    Return the gain in log likelihood by a power so many standard errors away (Student).

    Lines of an average share its noise floor at worst: only acquisitions are independent.
    """
    freedom = len(evidence.lines.noise_density) - 1
    return 0.5 * freedom * math.log1p(apart**2 / freedom)
