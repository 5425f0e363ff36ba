# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Phase wander: the source moves relative to the tach shaft (torsion, changing transfer path)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.effects.band import (
    ACCELERATION_BAND, NARROWEST, recovered_correlation, SLOW_BAND, slow_band, slow_covariance,
    slow_memory, WIDEST)
from sa_jitter_ros.effects.effect import Effect, parameter, RARE, require_below
from sa_jitter_ros.effects.timing import FAINT, LARGE, low_passed, Setting, SOURCE, Spectrum
from sa_jitter_ros.prediction.angle_error import AngleErrorProcess, GaussianAngleError
from sa_jitter_ros.prediction.model import DeclaredModel

# Logarithm of half the order of a spectrum: it falls within a part of its width that is rare.
_STEEPEST = -float(np.log(RARE))


@dataclass(frozen=True)
class PhaseWander(Effect):
    """
    Slow random angle of `std` rad between the shaft of interest and its vibration.

    Its spectrum is flat up to `bandwidth` times the trigger rate.
    """

    name: ClassVar[str] = 'phase_wander'
    summary: ClassVar[str] = 'slow motion of the source relative to the tach shaft'
    meaning: ClassVar[str] = (
        'the source of the vibration moves slowly against the shaft with the keyphasor: '
        'torsion, play, or a path that changes')
    remedy: ClassVar[str] = 'put the keyphasor on the shaft of interest, or average fewer cycles'
    pulse_times_correct: ClassVar[bool] = True
    timing: ClassVar[Spectrum] = Spectrum(
        SOURCE, low_passed,
        tuple((0.0, float(np.log(width)), 0.7) for width in (ACCELERATION_BAND[0], 0.15, 0.4)),
        (FAINT, None, 0.0), (LARGE, float(np.log(WIDEST)), _STEEPEST),
        limited=(FAINT, float(np.log(ACCELERATION_BAND[0])), 0.0))
    std: float = parameter(0.0, 'standard deviation of the angle, shaft of interest', 'rad',
                           minimum=0.0)
    bandwidth: float = parameter(
        SLOW_BAND[1], 'highest frequency of the motion, cycles a trigger cycle', '1',
        minimum=NARROWEST, maximum=WIDEST)

    def processes(self, model: DeclaredModel) -> Sequence[AngleErrorProcess]:
        """Return the wander, band-limited below half the trigger rate."""
        if self.std == 0.0:
            return ()
        require_below('phase_wander.std', self.std, 2.0 * np.pi, 'rad', 'a source that turns '
                      'freely relative to the shaft has no orders of it; lower it')
        cycles, band = model.trigger_cycles, slow_band(self.bandwidth)
        return (GaussianAngleError(slow_covariance((self.std / (2.0 * np.pi)) ** 2, cycles, band),
                                   slow_memory(cycles, band)),)

    def pulse_autocovariance(self, model: DeclaredModel, lags: Array) -> Array:
        """Return the autocovariance of the pulse errors that the recovery makes of the wander."""
        seconds = self.std / (2.0 * np.pi * model.fundamental_frequency)
        return np.asarray(seconds**2 * recovered_correlation(lags, slow_band(self.bandwidth)))

    @classmethod
    def of_timing(cls, sizes: Array, errors: Array, setting: Setting
                  ) -> tuple['PhaseWander', Mapping[str, Any]]:
        """
        Return standard deviation and bandwidth of logarithms of power and width.

        The bandwidth of a spectrum that falls gradually is no surer than where it falls, from 88
        to 12 % of its height.
        """
        rad = 2.0 * np.pi * setting.model.fundamental_frequency
        std = float(rad * setting.unit * np.exp(0.5 * sizes[0]))
        width, fall = np.exp(sizes[1]), np.exp(-sizes[2])
        return cls(std, float(np.clip(width, NARROWEST, WIDEST))), {
            'std': 0.5 * std * float(errors[0]),
            'bandwidth': float(width * np.hypot(errors[1], fall))}

    def in_timing(self, setting: Setting) -> Array:
        """Return the logarithms of power and width, and of the steepest slope."""
        rad = 2.0 * np.pi * setting.model.fundamental_frequency
        return np.array([2.0 * np.log(max(self.std / rad / setting.unit, 1e-9)),
                         np.log(self.bandwidth), _STEEPEST])
