# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Speed fluctuation: an acceleration that the angle law cannot follow inside a cycle."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.effects.band import (
    ACCELERATION_BAND, even_in, fading, NARROWEST, ripple_of_acceleration, slow_band, slow_memory,
    WIDEST)
from sa_jitter_ros.effects.effect import Effect, parameter, require_below
from sa_jitter_ros.prediction.angle_error import AngleErrorProcess, GaussianAngleError
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.pulses.angle_law import Covariance, PulseWeights


@dataclass(frozen=True)
class SpeedFluctuation(Effect):
    """
    Random acceleration of the tach shaft, nearly constant within a trigger cycle.

    The linear law then errs by nearly -(1/2) a T^2 r u (1 - u), a in trigger cycles/s^2: nothing
    at the pulses, most in the middle. Other laws err by what the acceleration changes from cycle
    to cycle. Its spectrum is flat from a twentieth of the trigger rate to `bandwidth` times that
    rate; where the bandwidth is below 0.125, from 0.4 of it. The narrower, the more do averages
    differ.
    """

    name: ClassVar[str] = 'speed_fluctuation'
    summary: ClassVar[str] = 'acceleration inside a trigger cycle'
    meaning: ClassVar[str] = (
        'the speed changes within a trigger cycle, where the pulses do not show it')
    remedy: ClassVar[str] = 'use more pulses a revolution, or the angle_law quadratic or spline'
    acceleration_std: float = parameter(
        0.0, 'standard deviation of the acceleration of the tach shaft', 'rad/s^2', minimum=0.0)
    bandwidth: float = parameter(
        ACCELERATION_BAND[1], 'highest frequency of the acceleration, cycles a trigger cycle; the '
        'lowest is 0.05, or 0.4 of it', '1', minimum=NARROWEST, maximum=WIDEST)

    def processes(self, model: DeclaredModel) -> Sequence[AngleErrorProcess]:
        """Return the error of the angle law."""
        if self.acceleration_std == 0.0:
            return ()
        size = _cycles(model, self.acceleration_std) * model.trigger_period**2
        require_below('speed_fluctuation.acceleration_std times the trigger period', size, 1.0,
                      'trigger speeds', 'the shaft would stop; lower it, or use more '
                      'pulses_per_revolution')
        variance = (size * model.cycle_length) ** 2
        band = slow_band(self.bandwidth, ACCELERATION_BAND)
        unit = _unit_covariance(model.weights, model.trigger_cycles, band)
        return (GaussianAngleError(
            lambda u, v, lag: np.asarray(variance * unit(u, v, lag)),
            slow_memory(model.trigger_cycles, band)),)

    @classmethod
    def of_ripple(cls, size: float, model: DeclaredModel,
                  bandwidth: float = ACCELERATION_BAND[1]) -> 'SpeedFluctuation':
        """Return the acceleration that makes errors size u (1 - u), in s, inside the cycles."""
        ripple = ripple_of_acceleration(slow_band(bandwidth, ACCELERATION_BAND))
        return cls(size / ripple / model.trigger_period**3 / _cycles(model, 1.0), bandwidth)


@lru_cache(maxsize=4)
def _unit_covariance(weights: PulseWeights, cycles: int, band: tuple[float, float]
                     ) -> Covariance:
    """
    Return the covariance of the error that the angle law makes of accelerations of variance 1.

    It is an integral over the spectrum. Of a motion of f cycles a trigger cycle the law follows
    what its weights make of the values at the pulses; the acceleration is (2 pi f)^2 times the
    motion. All orders at all speeds ask for the same places, so that it is kept for these. It
    fades over an average of so many `cycles`.
    """
    frequency, weight = even_in(band)
    turn = 2j * np.pi * frequency
    at_pulses = np.exp(np.multiply.outer(turn, np.arange(weights.pulses) - weights.before))

    def missed(u: Array) -> Array:
        followed = np.tensordot(at_pulses, weights.at(u), 1)
        return np.asarray(np.moveaxis(
            np.exp(np.multiply.outer(turn, u)) - followed, 0, -1) / turn**2)

    known: dict[tuple[object, ...], Array] = {}

    def covariance(u: Array, v: Array, lag: int) -> Array:
        key = u.shape, u.tobytes(), v.shape, v.tobytes(), lag
        if key not in known:
            later = missed(v) * np.exp(turn * lag) * weight
            known[key] = np.einsum('...f,...f', missed(u).conj(), later).real * fading(
                lag + v - u, cycles, band)
        return known[key]

    return covariance


def _cycles(model: DeclaredModel, acceleration: float) -> float:
    """Return an acceleration in rad/s^2 of the tach shaft in trigger cycles/s^2."""
    return acceleration / (2.0 * np.pi * model.revolutions_per_trigger)
