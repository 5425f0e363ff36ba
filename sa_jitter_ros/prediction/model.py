# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The declared model: what is known about keyphasor, machine and average before measuring."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields
import math

import numpy as np
from sa_jitter_ros.errors import ModelError
from sa_jitter_ros.parameters import unwrapped
from sa_jitter_ros.prediction.distributions import (
    Empirical, is_number, Normal, PulseErrorDistribution, Triangular, Uniform)
from sa_jitter_ros.prediction.moments import require_cycles, require_orders
from sa_jitter_ros.pulses.angle_law import angle_law, ANGLE_LAWS, PulseWeights

DISTRIBUTIONS = ('uniform', 'normal', 'triangular', 'table')


@dataclass(frozen=True)
class DeclaredModel:
    """
    What is declared about keyphasor, machine and average; the parameters of `jitter_predictor`.

    Rates and speeds are in Hz, times in s, orders in multiples of the shaft of interest.
    `pulses_per_trigger` 0 means all pulses of a revolution, `jitter_std` 0 the standard deviation
    1/(sqrt(12) keyphasor_rate), `noise_std` NaN that the noise is not declared (no noise is
    predicted), `sample_rate` 0 unknown; `angle_law` is that of the average. What a distribution
    does not use (`jitter_std` of a uniform one, `jitter_table` of any but table)
    may stay set, so that the distribution can be switched. Raises ModelError for values that make
    no sense.

    A shaft at 2.4 times the speed of the tach shaft, whose keyphasor sees six marks and triggers
    at every third:

    >>> model = DeclaredModel(keyphasor_rate=10e3, trigger_speed=25.0, trigger_cycles=40,
    ...                       orders=(23.0, 46.0), ratio=2.4, pulses_per_revolution=6,
    ...                       pulses_per_trigger=3)
    >>> model.trigger_period, model.cycle_length, model.duration
    (0.02, 1.2, 0.8)
    """

    keyphasor_rate: float
    trigger_speed: float
    trigger_cycles: int
    orders: tuple[float, ...]
    ratio: float = 1.0
    pulses_per_revolution: int = 1
    pulses_per_trigger: int = 0
    jitter_distribution: str = 'uniform'
    jitter_std: float = 0.0
    jitter_table: tuple[float, ...] = ()
    noise_std: float = math.nan
    sample_rate: float = 0.0
    angle_law: str = 'linear'

    def __post_init__(self) -> None:
        """Check every value and every combination."""
        for item in fields(self):
            object.__setattr__(self, item.name, unwrapped(getattr(self, item.name)))
        for name in ('keyphasor_rate', 'trigger_speed', 'ratio'):
            _require(name, getattr(self, name), lambda value: value > 0.0, 'above 0')
        for name in ('jitter_std', 'sample_rate'):
            _require(name, getattr(self, name), lambda value: value >= 0.0, '0 (unset) or above')
        if self.noise_is_declared:
            _require('noise_std', self.noise_std, lambda value: value >= 0.0,
                     'NaN (not declared), 0 or above')
        _require('pulses_per_revolution', self.pulses_per_revolution,
                 lambda value: value >= 1 and float(value).is_integer(), 'whole, at least 1')
        _require('pulses_per_trigger', self.pulses_per_trigger,
                 lambda value: value >= 0 and float(value).is_integer(),
                 'whole, 0 (all of a revolution) or above')
        require_cycles(self.trigger_cycles)
        for name in ('trigger_cycles', 'pulses_per_revolution', 'pulses_per_trigger'):
            object.__setattr__(self, name, int(getattr(self, name)))
        object.__setattr__(self, 'orders', tuple(require_orders(self.orders).tolist()))
        if not isinstance(self.jitter_table, Iterable):
            raise ModelError(f'jitter_table is {self.jitter_table}: give a list of pulse errors '
                             'in s')
        object.__setattr__(self, 'jitter_table', tuple(self.jitter_table))
        if self.jitter_distribution == 'table' and not self.jitter_table:
            raise ModelError('jitter_distribution is table and jitter_table is empty: give at '
                             'least one pulse error in s')
        if self.jitter_distribution not in DISTRIBUTIONS:
            raise ModelError(f'jitter_distribution is {self.jitter_distribution!r}: choose one of '
                             f'{", ".join(DISTRIBUTIONS)}')
        if self.angle_law not in ANGLE_LAWS:
            raise ModelError(f'angle_law is {self.angle_law!r}: choose one of '
                             f'{", ".join(ANGLE_LAWS)}')
        if self.noise_std > 0.0 and self.sample_rate == 0.0:
            raise ModelError(f'noise_std is {self.noise_std} without sample_rate: how much noise '
                             'one line of the average holds depends on it; set sample_rate (Hz)')
        highest = max(self.orders)
        if 0.0 < self.sample_rate < 2.0 * highest * self.fundamental_frequency:
            limit = 0.5 * self.sample_rate / self.fundamental_frequency
            raise ModelError(
                f'order {highest:g} is above the Nyquist order {limit:g} of vibration sampled at '
                f'{self.sample_rate:g} Hz: drop it, or raise sample_rate, if trigger_speed, '
                f'{self.trigger_speed:g}, is in Hz')
        width = self.distribution.width
        if not width < self.trigger_period:
            raise ModelError(
                f'pulse errors spread over {width:.3g} s but a trigger cycle lasts '
                f'{self.trigger_period:.3g} s, so pulses could swap: raise keyphasor_rate or '
                'pulses_per_trigger, or lower jitter_std or trigger_speed')

    @property
    def noise_is_declared(self) -> bool:
        """Return whether the noise is declared; NaN says that it is not."""
        return not (isinstance(self.noise_std, float) and math.isnan(self.noise_std))

    @property
    def noise(self) -> float:
        """Return the standard deviation of the declared noise per sample, 0 for none."""
        return self.noise_std if self.noise_is_declared else 0.0

    @property
    def distribution(self) -> PulseErrorDistribution:
        """Return the distribution of one pulse error in s."""
        if self.jitter_distribution == 'uniform':
            return Uniform(1.0 / self.keyphasor_rate)
        if self.jitter_distribution == 'table':
            return Empirical(np.asarray(self.jitter_table))
        std = self.jitter_std or 1.0 / (math.sqrt(12.0) * self.keyphasor_rate)
        return Normal(std) if self.jitter_distribution == 'normal' else Triangular(std)

    @property
    def weights(self) -> PulseWeights:
        """Return how the angle law passes on pulse errors."""
        return angle_law(self.angle_law).weights

    @property
    def fundamental_frequency(self) -> float:
        """Return the speed of the shaft of interest in Hz."""
        return self.ratio * self.trigger_speed

    @property
    def pulses_in_trigger_cycle(self) -> int:
        """Return the number of pulses of the keyphasor from trigger to trigger."""
        return self.pulses_per_trigger or self.pulses_per_revolution

    @property
    def revolutions_per_trigger(self) -> float:
        """Return the length of a trigger cycle in revolutions of the tach shaft."""
        return self.pulses_in_trigger_cycle / self.pulses_per_revolution

    @property
    def trigger_period(self) -> float:
        """Return the length of a trigger cycle in s."""
        return self.revolutions_per_trigger / self.trigger_speed

    @property
    def cycle_length(self) -> float:
        """Return r, the length of a trigger cycle in fundamental cycles."""
        return self.ratio * self.revolutions_per_trigger

    @property
    def duration(self) -> float:
        """Return the length of an average in s."""
        return self.trigger_cycles * self.trigger_period


def _require(name: str, value: float, holds: Callable[[float], bool], limit: str) -> None:
    if not (is_number(value) and math.isfinite(value) and holds(value)):
        raise ModelError(f'{name} is {value!r}: it must be finite and {limit}')
