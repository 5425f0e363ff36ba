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

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from sa_jitter_ros.effects.band import (
    fading, flat_band_correlation, NARROWEST, recovered_correlation, SLOW_BAND, slow_band,
    slow_memory, WIDEST)
from sa_jitter_ros.effects.effect import absent, Array, Effect, Finding, parameter, require_below
from sa_jitter_ros.effects.evidence import Evidence, root
from sa_jitter_ros.effects.pulse_covariance import fit_covariance, fit_memory, white
from sa_jitter_ros.effects.slope_test import slope_test
from sa_jitter_ros.prediction.angle_error import AngleErrorProcess, GaussianAngleError
from sa_jitter_ros.prediction.model import DeclaredModel

_NARROW = 0.05
_DECIDING = 'a second keyphasor, or a steadier speed'
_SIGNIFICANT = 1e-3
_MOST_BESIDE = 4.0  # variance of independent errors beside that of the wander
_FREEDOM = 2.0  # what one more parameter gains by chance, Akaike's criterion


@dataclass(frozen=True)
class PhaseWander(Effect):
    """
    Slow random angle of `std` rad between the shaft of interest and its vibration.

    Its spectrum is flat from a fiftieth of the trigger rate to `bandwidth` times that rate; where
    the bandwidth is below 0.05, from 0.4 of it.
    """

    name: ClassVar[str] = 'phase_wander'
    summary: ClassVar[str] = 'slow motion of the source relative to the tach shaft'
    pulse_times_correct: ClassVar[bool] = True
    needs_pulse_errors: ClassVar[bool] = True
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
        variance, band = (self.std / (2.0 * np.pi)) ** 2, slow_band(self.bandwidth)

        def covariance(u: Array, v: Array, lag: int) -> Array:
            apart = lag + v - u
            return np.asarray(variance * fading(apart, model.trigger_cycles, band)
                              * flat_band_correlation(apart, band))

        return (GaussianAngleError(covariance, slow_memory(model.trigger_cycles, band)),)

    def pulse_autocovariance(self, model: DeclaredModel, lags: Array) -> Array:
        """Return the autocovariance of the pulse errors that the recovery makes of the wander."""
        seconds = self.std / (2.0 * np.pi * model.fundamental_frequency)
        return np.asarray(seconds**2 * recovered_correlation(lags, slow_band(self.bandwidth)))

    @classmethod
    def fit(cls, evidence: Evidence) -> Finding:
        """Fit slow errors that the measured pulse times do not have."""
        if evidence.against_reference:
            return absent(cls.name, 'relative to a better keyphasor the source cannot move')
        slope = slope_test(evidence.of_all)
        if slope.tach_side:
            return absent(cls.name, 'the pulse times move as the recovered errors do: the '
                          f'vibration makes {slope.share:.2f} +- {slope.standard_error:.2f} of '
                          'the motion', p_value=slope.p_value)
        fit = fit_covariance(evidence, _correlation, bounds=(_NARROW, WIDEST))
        bandwidth, bandwidth_error = fit.shape, fit.shape_error
        # Independent errors beside a wander must not swell it.
        beside = fit_covariance(
            evidence, lambda lags, share: _correlation(lags, SLOW_BAND[1]) + share * white(
                lags, 0.0), bounds=(0.0, _MOST_BESIDE))
        if beside.p_value_over(fit) < _SIGNIFICANT:
            fit, bandwidth, bandwidth_error = beside, SLOW_BAND[1], float('nan')
        if fit.variance == 0.0:
            return absent(cls.name, 'the pulse errors vary no more than declared')
        seconds, error = root(fit.variance, fit.variance_error)
        rad = 2.0 * np.pi * evidence.model.fundamental_frequency
        text = (f'the vibration moves by {seconds:.3g} s relative to the pulses, whose times do '
                f'not show {slope.share:.2f} +- {slope.standard_error:.2f} of the motion, '
                f'p = {slope.p_value:.2g}')
        rivals = () if slope.decided else ('correlated_jitter',)
        contradiction = ''
        if rivals:
            whole = evidence.of_all
            better = max(fit_covariance(whole, white).gain, fit_memory(whole).gain - _FREEDOM)
            wander = fit_covariance(whole, _correlation, bounds=(_NARROW, WIDEST)).gain - _FREEDOM
            if better > wander:
                contradiction = (
                    'independent or autoregressive pulse errors explain them better: twice the '
                    f'log-likelihood gains {better:.1f} with them, {wander:.1f} with a wander')
        return Finding(cls.name, cls(rad * seconds, bandwidth),
                       {'std': rad * error, 'bandwidth': bandwidth_error},
                       max(fit.p_value, 1e-300), text, contradiction,
                       indistinguishable_from=rivals,
                       deciding_measurement=_DECIDING if rivals else '')


def _correlation(lags: Array, bandwidth: float) -> Array:
    return recovered_correlation(lags, slow_band(bandwidth))
