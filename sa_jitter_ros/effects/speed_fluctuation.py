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
from typing import ClassVar

import numpy as np
from sa_jitter_ros.effects.band import (
    ACCELERATION_BAND, fading, ripple_of_acceleration, slow_memory)
from sa_jitter_ros.effects.effect import absent, Array, Effect, Finding, parameter, require_below
from sa_jitter_ros.effects.evidence import Evidence, root
from sa_jitter_ros.prediction.angle_error import AngleErrorProcess, GaussianAngleError, unit_nodes
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.pulses.angle_law import Covariance, PulseWeights
from scipy import stats

_SIGNIFICANT = 1e-4
_FEWEST = 2  # acquisitions
# Noise moves a cycle's ripple up where it moves the pulses at its ends down: of the least squares
# fit of both, minus their covariance in the regression below over the variance of the ripple.
_COSINE = np.cos(np.pi * (np.arange(512) + 0.5) / 512)
_APART = (2.0 + _COSINE) / 90.0 - (1.0 + _COSINE) / 72.0
_SHARED = float(np.mean((1.0 - _COSINE**2) / (12.0 * _APART))
                / np.mean((2.0 + _COSINE) / (3.0 * _APART)))
_FREQUENCIES, _FREQUENCY_WEIGHTS = unit_nodes(128)  # enough for the memory of slow motions
_MOST_KEPT = 500  # covariances at the same places


@dataclass(frozen=True)
class SpeedFluctuation(Effect):
    """
    Random acceleration of the tach shaft, nearly constant within a trigger cycle.

    The linear law then errs by nearly -(1/2) a T^2 r u (1 - u), a in trigger cycles/s^2: nothing
    at the pulses, most in the middle. Other laws err by what the acceleration changes from cycle
    to cycle.
    """

    name: ClassVar[str] = 'speed_fluctuation'
    summary: ClassVar[str] = 'acceleration inside a trigger cycle'
    acceleration_std: float = parameter(
        0.0, 'standard deviation of the acceleration of the tach shaft', 'rad/s^2', minimum=0.0)

    def processes(self, model: DeclaredModel) -> Sequence[AngleErrorProcess]:
        """Return the error of the angle law."""
        if self.acceleration_std == 0.0:
            return ()
        size = _cycles(model, self.acceleration_std) * model.trigger_period**2
        require_below('speed_fluctuation.acceleration_std times the trigger period', size, 1.0,
                      'trigger speeds', 'the shaft would stop; lower it, or use more '
                      'pulses_per_revolution')
        variance = (size * model.cycle_length) ** 2
        covariance = _error_covariance(model.weights, variance)
        known: dict[tuple[object, ...], Array] = {}  # all orders ask for the same places

        def faded(u: Array, v: Array, lag: int) -> Array:
            key = u.shape, u.tobytes(), v.shape, v.tobytes(), lag
            if key not in known:
                if len(known) >= _MOST_KEPT:
                    known.clear()
                known[key] = covariance(u, v, lag) * fading(
                    lag + v - u, model.trigger_cycles, ACCELERATION_BAND)
            return known[key]

        return (GaussianAngleError(
            faded, slow_memory(model.trigger_cycles, ACCELERATION_BAND)),)

    @classmethod
    def fit(cls, evidence: Evidence) -> Finding:
        """Fit the ripple inside the cycles, which the true pulse times must show as well."""
        model = evidence.model
        resolved = np.all(np.isfinite(evidence.ripple), axis=1)  # not where a pulse lacks
        if np.count_nonzero(resolved) < _FEWEST or evidence.ripple[:, 1:-1].size < 12:
            return absent(cls.name, 'the vibration does not resolve the error inside the cycles')
        times = evidence.unexplained_times[resolved]
        expected = _inside(times - evidence.errors[resolved])  # s, at all cycles but the outer two
        ripple = evidence.ripple[resolved, 1:-1]
        noise = evidence.ripple_standard_error**2
        rows = np.mean(evidence.ripple[resolved] ** 2, axis=1)
        variance = float(rows.mean() - noise)
        size, error = root(variance, float(rows.std(ddof=1) / np.sqrt(rows.size)))
        fit = stats.linregress(expected.ravel(), ripple.ravel())
        shared = 0.0 if evidence.against_reference else _SHARED * noise
        slope, slope_error = fit.slope + shared / float(expected.var()), fit.stderr
        p_value = float(stats.t.sf(slope / slope_error, expected.size - 2))
        # Radians of the tach shaft per s^2 for a ripple of 1 s.
        unit = 2.0 * np.pi * model.trigger_revolutions / model.trigger_period**3 / (
            ripple_of_acceleration(ACCELERATION_BAND))
        text = (f'an error u (1 - u) of {size:.3g} s inside the cycles '
                f'follows the acceleration between the pulses with slope {slope:.2f} +- '
                f'{slope_error:.2f}, p = {p_value:.2g}')
        if variance <= 0.0 or p_value > _SIGNIFICANT or slope <= 0.0:
            return absent(cls.name, 'the error inside the cycles does not follow the acceleration '
                          f'between the pulses: slope {slope:.2f}, p = {p_value:.2g}',
                          p_value=p_value)
        contradiction = ''
        r = slope * float(expected.std() / ripple.std())
        if r**2 * (1.0 + noise / variance) < 0.4:
            contradiction = (f'the acceleration between the pulses explains {r**2:.0%} of the '
                             'error inside the cycles: something faster moves')
        # Jitter of the pulses has no part in the ripple, a moving source none in the pulses.
        product = ripple * _inside(times)
        whole = float(np.mean(ripple * expected)) + shared
        share = float(product.mean()) / whole
        unsure = float(product.std() / np.sqrt(product.size)) / abs(whole)
        if share < 0.5 and share + 3.0 * unsure < 1.0:
            contradiction = (f'the pulse times show {share:.0%} +- {unsure:.0%} of the '
                             'acceleration: the source moves')
        return Finding(cls.name, cls(unit * size), {'acceleration_std': unit * error},
                       p_value, text, contradiction)


def _error_covariance(weights: PulseWeights, variance: float) -> Covariance:
    """
    Return the covariance of the error that the angle law makes of accelerations of `variance`.

    It is an integral over the spectrum. Of a motion of f cycles a trigger cycle the law follows
    what its weights make of the values at the pulses; the acceleration is (2 pi f)^2 times the
    motion.
    """
    low, high = ACCELERATION_BAND
    turn = 2j * np.pi * (low + (high - low) * _FREQUENCIES)
    at_pulses = np.exp(np.multiply.outer(turn, np.arange(weights.pulses) - weights.before))

    def missed(u: Array) -> Array:
        followed = np.tensordot(at_pulses, weights.at(u), 1)
        return np.asarray(np.moveaxis(
            np.exp(np.multiply.outer(turn, u)) - followed, 0, -1) / turn**2)

    def covariance(u: Array, v: Array, lag: int) -> Array:
        later = missed(v) * np.exp(turn * lag) * _FREQUENCY_WEIGHTS
        return np.asarray(variance * np.einsum('...f,...f', missed(u).conj(), later).real)

    return covariance


def _cycles(model: DeclaredModel, acceleration: float) -> float:
    """Return an acceleration in rad/s^2 of the tach shaft in trigger cycles/s^2."""
    return acceleration / (2.0 * np.pi * model.trigger_revolutions)


def _inside(times: Array) -> Array:
    """Return the ripple of all cycles but the outer two that `times` of pulses bend by."""
    bends = np.diff(times, 2, axis=1)
    return np.asarray(0.25 * (bends[:, :-1] + bends[:, 1:]))
