# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Clock skew: the keyphasor's clock runs faster or slower than that of the vibration."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from sa_jitter_ros.effects.effect import absent, Array, Effect, Finding, parameter
from sa_jitter_ros.effects.evidence import Evidence
from sa_jitter_ros.prediction.influence import Pulses
from sa_jitter_ros.prediction.model import DeclaredModel
from scipy import stats

_SIGNIFICANT = 1e-3


@dataclass(frozen=True)
class ClockSkew(Effect):
    """Time t of the vibration is t (1 + skew) on the keyphasor's clock."""

    name: ClassVar[str] = 'clock_skew'
    summary: ClassVar[str] = 'speed of the keyphasor clock relative to the vibration clock'
    skew: float = parameter(0.0, 'relative speed of the keyphasor clock, less 1', '1',
                            minimum=-0.1, maximum=0.1)

    def scenarios(self, model: DeclaredModel) -> Array | None:
        """Return the delay that grows through an average."""
        if self.skew == 0.0:
            return None
        return (self.skew * model.trigger_period
                * np.arange(model.trigger_cycles + 1.0))[None, :]

    def pattern(self, model: DeclaredModel, pulses: Pulses) -> Array | None:
        """Return the delay that grows through the average at hand."""
        return np.asarray(self.skew * (pulses.times - pulses.times[0]))

    @classmethod
    def fit(cls, evidence: Evidence) -> Finding:
        """Fit the slope of the pulse errors over time, the same in all acquisitions."""
        times = evidence.times
        if len(times) < 3:
            return absent(cls.name, 'too few acquisitions to compare the slopes of their errors')
        x = times - times.mean(axis=1, keepdims=True)
        slopes = np.sum(x * evidence.errors, axis=1) / np.sum(x**2, axis=1)
        spread = float(slopes.std(ddof=1))
        skew, error = float(slopes.mean()), spread / np.sqrt(len(slopes))
        p_value = float(2.0 * stats.t.sf(abs(skew) / max(error, 1e-300), len(slopes) - 1))
        text = (f'the pulse errors grow by {skew:.3g} +- {error:.2g} s a second in every '
                f'acquisition, p = {p_value:.2g}')
        if p_value > _SIGNIFICANT:
            return absent(cls.name, f'no common slope of the pulse errors: {text}',
                          p_value=p_value)
        return Finding(cls.name, cls(skew), {'skew': error}, p_value, text)
