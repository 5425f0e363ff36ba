# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Interfering tone: a line that no shaft makes, of which the average's comb lets some through."""

from dataclasses import dataclass
import math
from typing import ClassVar

import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.effects.effect import (
    absent, DirectEffect, Effect, Finding, ONE_SIDED, parameter, require_below, weighed)
from sa_jitter_ros.effects.evidence import Evidence
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.prediction.moments import MOST_NOISE


@dataclass(frozen=True)
class InterferingTone(DirectEffect):
    """A tone of `frequency` Hz and peak `amplitude` on every channel."""

    name: ClassVar[str] = 'interfering_tone'
    summary: ClassVar[str] = 'a tone that no shaft makes'
    meaning: ClassVar[str] = 'a tone that no shaft makes leaks into the averages'
    remedy: ClassVar[str] = 'average more cycles (trigger_cycles), or remove its source'
    scatters: ClassVar[bool] = True
    amplitude: float = parameter(0.0, "peak amplitude in units of the component's", '1',
                                 minimum=0.0)
    frequency: float = parameter(50.0, 'frequency of the tone', 'Hz', above=0.0)

    def line_variance(self, model: DeclaredModel) -> Array:
        """Return the power that the comb filter of the average passes (Eq. 8)."""
        require_below('interfering_tone.amplitude', self.amplitude, MOST_NOISE, 'components',
                      'no component is visible beside it; lower it')
        line = np.asarray(model.orders) * model.fundamental_frequency
        passed = (np.sinc((self.frequency - line) * model.duration) ** 2
                  + np.sinc((self.frequency + line) * model.duration) ** 2)
        return np.asarray(self.amplitude**2 * passed)

    @classmethod
    def limit(cls, evidence: Evidence) -> Effect | None:
        """
        Return the strongest line that may be no order of the shaft.

        Where none stands out, it is the strongest that noise hides, beside the weakest order.
        """
        lines = evidence.lines
        if lines.tone is not None:
            size, error = lines.tone.amplitude, lines.tone.standard_error
            frequency = lines.tone.frequency
        elif lines.order.size:
            size, error = lines.hidden_tone
            frequency = evidence.model.fundamental_frequency * float(
                lines.order[np.argmin(lines.level)])
        else:
            return None
        return cls(size + ONE_SIDED * error, frequency) if 0.0 <= error < math.inf else None

    @classmethod
    def fit(cls, evidence: Evidence) -> Finding:
        """Take the strongest line of the spectrum that is not synchronous."""
        tone = evidence.lines.tone
        if tone is None:
            return absent(cls.name, 'no line stands out between the synchronous ones')
        text = (f'a line of amplitude {tone.amplitude:.3g} at {tone.frequency:.6g} Hz '
                'that is no order of the shaft')
        found = Finding(cls.name, cls(tone.amplitude, tone.frequency),
                        {'frequency': tone.frequency_error, 'amplitude': tone.standard_error},
                        1.0, text)
        return weighed(found, tone.likelihood, 2 * tone.channels, evidence, tried=tone.tried)
