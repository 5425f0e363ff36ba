# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Interpolation loss: samples read between samples by a rule that damps high frequencies."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.effects.effect import absent, DirectEffect, Finding, parameter
from sa_jitter_ros.effects.evidence import Evidence
from sa_jitter_ros.errors import ModelError
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.pulses.resampling import interpolator_gain, METHODS


@dataclass(frozen=True)
class InterpolationLoss(DirectEffect):
    """The samples were interpolated by `method`, at places that are even between the samples."""

    name: ClassVar[str] = 'interpolation_loss'
    summary: ClassVar[str] = 'interpolation of the samples'
    meaning: ClassVar[str] = 'the samples were interpolated by a rule that damps high frequencies'
    remedy: ClassVar[str] = (
        'interpolate band-limited (interpolation of the averager), or sample faster')
    method: str = parameter('linear', 'interpolator of the samples', '', choices=METHODS)

    def gain(self, model: DeclaredModel) -> Array:
        """Return the mean gain of the interpolator; raise ModelError without a sample rate."""
        if not model.sample_rate > 0.0:
            raise ModelError('sample_rate is 0: interpolation_loss depends on frequency over '
                             'sample rate, so declare sample_rate')
        frequency = np.asarray(model.orders) * model.fundamental_frequency / model.sample_rate
        return interpolator_gain(self.method, np.minimum(frequency, 0.5))

    @classmethod
    def fit(cls, evidence: Evidence) -> Finding:
        """Look for the beat that interpolation between samples of another clock makes."""
        beat = evidence.lines.beat
        if not beat.method:
            return absent(cls.name, 'the lines show no common beat that deepens with frequency as '
                          'an interpolator makes it', p_value=beat.p_value, gain=beat.gain)
        text = (f'all lines beat at one frequency, the deeper the higher their order, as '
                f'{beat.method} interpolation makes them')
        return Finding(cls.name, cls(beat.method), {'method': None}, beat.p_value, text,
                       gain=beat.gain)
