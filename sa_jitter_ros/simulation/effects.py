# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
The simulated effects, under the names of the predictor's parameters.

First come the effects on the keyphasor's pulses: their times, the clock that measures them, lost
pulses. Then come those on the vibration: motion of the shafts, path to the sensor, sampling. The
interpolators here are not those of the averager, which the simulation serves to test.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
import math
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.simulation.effect import (
    BANDWIDTH, Effect, IndexArray, NOT_NEGATIVE, POSITIVE, require_number, Setting, Signal,
    slow_process)
from sa_jitter_ros.simulation.random_streams import band_limited, RandomStream, SinusoidSum
from scipy.interpolate import CubicSpline
from scipy.special import ndtri

_MAX_CORRELATION = 0.9999  # beyond it a pulse depends on too many earlier ones
JITTER_DISTRIBUTIONS = ('uniform', 'normal', 'triangular', 'table')
_GRID_OFFSET = 1e-3 * (np.sqrt(5.0) - 1.0)  # relative, irrational: all fractions occur evenly
_SPLINE_MARGIN = 32  # samples; there the end acts on the spline by 0.268^32: below rounding

_Interpolator = Callable[[FloatArray, FloatArray], FloatArray]


def _per_pulse(draw: Callable[[int, int], FloatArray], index: IndexArray) -> FloatArray:
    """Return one item of a stream for each of some consecutive pulses."""
    return draw(int(index[0]), int(index[-1]) + 1)[0] if index.size else np.empty(0)


@dataclass(frozen=True)
class DeclaredJitter(Effect):
    """
    The declared pulse errors: independent, of zero mean.

    `std` in s; a `table` (s) has equally likely errors and needs no `std`.
    """

    distribution: str
    std: float = 0.0
    table: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        """Check the parameters."""
        if self.distribution not in JITTER_DISTRIBUTIONS:
            raise ParameterError(f'jitter distribution {self.distribution!r}: must be one of '
                                 f'{", ".join(JITTER_DISTRIBUTIONS)}')
        require_number('jitter std', self.std, minimum=0)
        if self.distribution == 'table' and not (
                self.table and np.isfinite(self.table).all()):
            raise ParameterError(f'jitter table {self.table}: give finite errors in s')

    def pulse_delay(self, setting: Setting, index: IndexArray, times: FloatArray) -> FloatArray:
        """Return the error of each pulse."""
        place = _per_pulse(RandomStream(setting.seed, 'declared_jitter').uniform, index)
        return setting.jitter_factor * self._at(place)

    def _at(self, place: FloatArray) -> FloatArray:
        """Return the errors below which a share `place` of all lies."""
        if self.distribution == 'table':
            errors = np.array(self.table) - np.mean(self.table)
            return np.asarray(errors[np.floor(place * errors.size).astype(np.int64)])
        if self.distribution == 'uniform':
            return self.std * math.sqrt(12.0) * (place - 0.5)
        if self.distribution == 'normal':
            return self.std * np.asarray(ndtri(np.maximum(place, 1e-300)))
        folded = np.sqrt(2.0 * np.minimum(place, 1.0 - place))
        return self.std * math.sqrt(6.0) * np.sign(place - 0.5) * (1.0 - folded)


@dataclass(frozen=True)
class JitterScale(Effect):
    """The declared pulse errors are `scale` times as large as declared."""

    scale: float
    LIMITS: ClassVar = {'scale': NOT_NEGATIVE}

    def jitter_factor(self) -> float:
        """Return the scale."""
        return self.scale


@dataclass(frozen=True)
class ExcessJitter(Effect):
    """Independent normal errors of the pulse times, `std` in s (electrical noise)."""

    std: float
    LIMITS: ClassVar = {'std': NOT_NEGATIVE}

    def pulse_delay(self, setting: Setting, index: IndexArray, times: FloatArray) -> FloatArray:
        """Return the delay of each pulse."""
        return self.std * _per_pulse(RandomStream(setting.seed, 'excess_jitter').normal, index)


@dataclass(frozen=True)
class CorrelatedJitter(Effect):
    """Normal errors of `std` s; those of pulses k apart have the correlation `correlation^k`."""

    std: float
    correlation: float
    LIMITS: ClassVar = {'std': NOT_NEGATIVE, 'correlation': {
        'above': -_MAX_CORRELATION, 'below': _MAX_CORRELATION}}

    def pulse_delay(self, setting: Setting, index: IndexArray, times: FloatArray) -> FloatArray:
        """Return the delay of each pulse."""
        stream = RandomStream(setting.seed, 'correlated_jitter')
        return self.std * _per_pulse(
            lambda *places: stream.autoregressive(*places, correlation=self.correlation), index)


@dataclass(frozen=True)
class TargetGeometry(Effect):
    """
    Marks of the target that are not evenly spaced: pulse k is late by `pulse_angles[k mod n]` rad.

    With as many angles as pulses per revolution, each angle belongs to a mark of the target.
    """

    pulse_angles: tuple[float, ...]

    def __post_init__(self) -> None:
        """Check the parameters."""
        if not self.pulse_angles or not np.isfinite(self.pulse_angles).all():
            raise ParameterError(f'target_geometry.pulse_angles {self.pulse_angles}: give at '
                                 'least one finite angle in rad')

    def pulse_delay(self, setting: Setting, index: IndexArray, times: FloatArray) -> FloatArray:
        """Return the delay of each mark against an evenly spaced one."""
        marks = np.array(self.pulse_angles)[index % len(self.pulse_angles)] / (2.0 * np.pi)
        nominal = index / setting.pulses_per_revolution
        return setting.motion.time_at(nominal + marks) - times


@dataclass(frozen=True)
class PathDelay(Effect):
    """All pulses come late by `delay` s, early where it is negative."""

    delay: float
    LIMITS: ClassVar = {'delay': {}}

    def observed(self, setting: Setting, times: FloatArray) -> FloatArray:
        """Return the later times."""
        return times + self.delay


@dataclass(frozen=True)
class ClockSkew(Effect):
    """The clock of the keyphasor is fast by `skew`: it shows t (1 + skew) at time t."""

    skew: float
    LIMITS: ClassVar = {'skew': {'above': -1, 'below': 1}}

    def observed(self, setting: Setting, times: FloatArray) -> FloatArray:
        """Return the times on the fast clock."""
        return times * (1.0 + self.skew)


@dataclass(frozen=True)
class KeyphasorQuantisation(Effect):
    """
    The keyphasor is sampled: pulse times are rounded up to a clock of `clock_rate` Hz.

    `period_std` (s) is the standard deviation of the trigger period due to a slow speed
    fluctuation, which distributes the pulses evenly between the ticks of the clock.
    """

    clock_rate: float
    period_std: float = 0.0
    LIMITS: ClassVar = {'clock_rate': POSITIVE, 'period_std': NOT_NEGATIVE}

    def speed_fluctuation(self, setting: Setting) -> SinusoidSum:
        """Return a relative fluctuation below a tenth of the trigger rate."""
        rate = setting.trigger_rate
        return band_limited(std=self.period_std * rate, band=(0.005 * rate, 0.1 * rate),
                            seed=setting.seed, name='keyphasor_quantisation')

    def observed(self, setting: Setting, times: FloatArray) -> FloatArray:
        """Return the times of the next clock ticks."""
        return np.ceil(times * self.clock_rate) / self.clock_rate


@dataclass(frozen=True)
class MissingPulses(Effect):
    """Every pulse is lost with `probability`."""

    probability: float
    LIMITS: ClassVar = {'probability': {'minimum': 0, 'below': 1}}

    def kept(self, setting: Setting, index: IndexArray) -> NDArray[np.bool_]:
        """Return which pulses are measured."""
        draws = _per_pulse(RandomStream(setting.seed, 'missing_pulses').uniform, index)
        return draws >= self.probability


@dataclass(frozen=True)
class SpeedFluctuation(Effect):
    """
    Random acceleration of the tach shaft with the standard deviation `acceleration_std` (rad/s^2).

    Its frequencies are below `bandwidth` times the trigger rate: at the usual fifth of it the
    acceleration is nearly constant within a trigger cycle.
    """

    acceleration_std: float
    bandwidth: float = 0.2
    LIMITS: ClassVar = {'acceleration_std': NOT_NEGATIVE, 'bandwidth': BANDWIDTH}

    def speed_fluctuation(self, setting: Setting) -> SinusoidSum:
        """Return the relative fluctuation whose derivative is the acceleration."""
        rate = setting.trigger_rate
        band = min(0.05, 0.4 * self.bandwidth) * rate, self.bandwidth * rate
        acceleration = band_limited(std=self.acceleration_std, band=band, seed=setting.seed,
                                    name='speed_fluctuation')
        return acceleration.integral().scaled(1 / (2 * np.pi * setting.motion.nominal_speed))


@dataclass(frozen=True)
class PhaseWander(Effect):
    """
    Slow random angle of `std` rad between a shaft and its vibration, independent for each shaft.

    Its frequencies are up to `bandwidth` times the trigger rate.
    """

    std: float
    bandwidth: float = 0.4
    LIMITS: ClassVar = {'std': NOT_NEGATIVE, 'bandwidth': BANDWIDTH}

    def source_angle(self, setting: Setting, shaft: str, times: FloatArray) -> FloatArray:
        """Return the angle in rad of the shaft."""
        return slow_process(setting, self.std, f'phase_wander {shaft}', self.bandwidth
                            ).value(times)


@dataclass(frozen=True)
class AmplitudeModulation(Effect):
    """
    Slow random gain on the vibration of each shaft, of mean 1 and standard deviation `std`.

    Its frequencies are up to `bandwidth` times the trigger rate.
    """

    std: float
    bandwidth: float = 0.4
    LIMITS: ClassVar = {'std': NOT_NEGATIVE, 'bandwidth': BANDWIDTH}

    def gain(self, setting: Setting, shaft: str, times: FloatArray) -> FloatArray:
        """Return the factor."""
        return 1.0 + slow_process(setting, self.std, f'amplitude_modulation {shaft}',
                                  self.bandwidth).value(times)


def linear(samples: FloatArray, positions: FloatArray) -> FloatArray:
    """Interpolate `channel` x `sample` linearly; mean gain sinc^2(f/fs)."""
    at = np.floor(positions).astype(np.int64)
    fraction = positions - at
    return (1.0 - fraction) * samples[:, at] + fraction * samples[:, at + 1]


def cubic(samples: FloatArray, positions: FloatArray) -> FloatArray:
    """Interpolate by cubic convolution with a = -1/2 (Keys 1981)."""
    at = np.floor(positions).astype(np.int64)
    s = positions - at
    weights = (((2.0 - s) * s - 1.0) * s / 2.0, (3.0 * s - 5.0) * s * s / 2.0 + 1.0,
               ((4.0 - 3.0 * s) * s + 1.0) * s / 2.0, (s - 1.0) * s * s / 2.0)
    return np.asarray(sum(weight * samples[:, at + shift]
                          for weight, shift in zip(weights, (-1, 0, 1, 2))))


def spline(samples: FloatArray, positions: FloatArray) -> FloatArray:
    """Interpolate by the cubic spline; mean gain 3 sinc^4(f/fs) / (2 + cos(2 pi f/fs))."""
    return np.asarray(CubicSpline(np.arange(samples.shape[1]), samples, axis=1)(positions))


# Name of the averager's method: its function and the samples that it needs on either side.
INTERPOLATORS: Mapping[str, tuple[_Interpolator, int]] = {
    'linear': (linear, 1), 'cubic': (cubic, 2), 'spline': (spline, _SPLINE_MARGIN)}


@dataclass(frozen=True)
class InterpolationLoss(Effect):
    """
    The vibration was sampled on another grid of nearly the same rate and interpolated by `method`.

    The positions between two samples of that grid go evenly through all fractions.
    """

    method: str

    def __post_init__(self) -> None:
        """Check the parameters."""
        if self.method not in INTERPOLATORS:
            raise ParameterError(f'interpolation_loss.method {self.method!r}: must be one of '
                                 f'{", ".join(INTERPOLATORS)}')

    def sampled(self, setting: Setting, signal: Signal, start: int, stop: int) -> FloatArray:
        """Return the interpolated samples."""
        interpolate, margin = INTERPOLATORS[self.method]
        rate = setting.sample_rate * (1.0 + _GRID_OFFSET)
        positions = np.arange(start, stop) * (1.0 + _GRID_OFFSET)
        first = math.floor(positions[0]) - margin
        grid = np.arange(first, math.floor(positions[-1]) + 1 + margin + 1)
        return interpolate(signal(grid / rate), positions - first)


@dataclass(frozen=True)
class AdditiveNoise(Effect):
    """White normal noise of `std` in units of the vibration, independent on every channel."""

    std: float
    name: str = 'additive_noise'

    def __post_init__(self) -> None:
        """Check the parameters."""
        require_number(f'{self.name}.std', self.std, minimum=0)

    def added(self, setting: Setting, start: int, stop: int) -> FloatArray:
        """Return the noise."""
        stream = RandomStream(setting.seed, self.name, rows=setting.channels)
        return self.std * stream.normal(start, stop)


@dataclass(frozen=True)
class InterferingTone(Effect):
    """Tone of `frequency` Hz and `amplitude` on every channel, not locked to any shaft."""

    frequency: float
    amplitude: float
    LIMITS: ClassVar = {'frequency': POSITIVE, 'amplitude': NOT_NEGATIVE}

    def added(self, setting: Setting, start: int, stop: int) -> FloatArray:
        """Return the tone."""
        cycles = np.arange(start, stop) * (self.frequency / setting.sample_rate)
        phase = RandomStream(setting.seed, 'interfering_tone').uniform(0, 1)[0, 0]
        return np.asarray(self.amplitude * np.cos(2.0 * np.pi * (cycles % 1.0 + phase)))


# Effects are applied in this order: a delay before the clock, its skew before its quantisation.
EFFECTS: Mapping[str, type[Effect]] = {kind.kind(): kind for kind in (
    JitterScale, ExcessJitter, CorrelatedJitter, TargetGeometry, PathDelay, ClockSkew,
    KeyphasorQuantisation, MissingPulses, SpeedFluctuation, PhaseWander, AmplitudeModulation,
    InterpolationLoss, AdditiveNoise, InterferingTone)}


def make_effects(options: Mapping[str, Mapping[str, Any]]) -> tuple[Effect, ...]:
    """
    Return effects from their names and parameters.

    Raises ParameterError if there is no such effect or parameter, or a value is out of range.

    >>> make_effects({'excess_jitter': {'std': 2e-5}, 'clock_skew': {'skew': 1e-5}})
    (ExcessJitter(std=2e-05), ClockSkew(skew=1e-05))
    """
    for name, parameters in options.items():
        if name not in EFFECTS:
            raise ParameterError(f'no effect {name!r}: choose from {", ".join(EFFECTS)}')
        known = [item.name for item in fields(EFFECTS[name])]  # type: ignore[arg-type]
        if set(parameters) - set(known):
            raise ParameterError(f'effect {name} has {", ".join(known)} and not '
                                 f'{", ".join(sorted(set(parameters) - set(known)))}')
    return tuple(EFFECTS[name](**options[name]) for name in EFFECTS if name in options)
