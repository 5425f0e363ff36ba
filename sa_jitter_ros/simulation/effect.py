# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The base class of simulated effects, and the properties of the machine that they may use."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
import math
import re
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.simulation.motion import Motion
from sa_jitter_ros.simulation.random_streams import band_limited, SinusoidSum, ZERO

IndexArray = NDArray[np.int64]
Signal = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True, eq=False)
class Setting:
    """
    Properties of the machine that effects may use.

    `sample_rate` of the vibration and `trigger_rate`, the nominal rate of trigger cycles, in Hz;
    `motion` of the tach shaft; `jitter_factor` on the errors of the declared jitter.
    """

    seed: int
    sample_rate: float
    channels: int
    pulses_per_revolution: int
    trigger_rate: float
    motion: Motion
    jitter_factor: float = 1.0


class Effect:
    """
    Base class of the effects: it changes nothing, subclasses override what they change.

    A keyphasor that is late by a constant time:

    >>> from sa_jitter_ros.simulation import Gearbox, mesh
    >>> class Late(Effect):
    ...     def pulse_delay(self, setting, index, times):
    ...         return np.full(times.shape, 1e-3)
    >>> gearbox = Gearbox(mesh('shaft', 19), 20e3, effects=[Late()])
    >>> float(gearbox.pulses(0.0, 1.0).errors.mean().round(6))
    0.001
    """

    #: What `require_number` demands of each number among the parameters.
    LIMITS: ClassVar[Mapping[str, Mapping[str, float]]] = {}

    @classmethod
    def kind(cls) -> str:
        """Return the name of the effect among the predictor's parameters."""
        return re.sub('(?<=.)(?=[A-Z])', '_', cls.__name__).lower()

    def __post_init__(self) -> None:
        """Check the numbers."""
        for name, limits in self.LIMITS.items():
            require_number(f'{self.kind()}.{name}', getattr(self, name), **limits)

    def speed_fluctuation(self, setting: Setting) -> SinusoidSum:
        """Return a relative fluctuation of the speed."""
        return ZERO

    def jitter_factor(self) -> float:
        """Return a factor on the declared pulse errors."""
        return 1.0

    def source_angle(self, setting: Setting, shaft: str, times: FloatArray) -> FloatArray | float:
        """Return an angle (rad) that is added to the angle of a shaft in its vibration."""
        return 0.0

    def gain(self, setting: Setting, shaft: str, times: FloatArray) -> FloatArray | float:
        """Return a factor on the vibration of a shaft."""
        return 1.0

    def sampled(self, setting: Setting, signal: Signal, start: int,
                stop: int) -> FloatArray | None:
        """Return samples `start` to `stop` of a signal, None if the effect does not resample."""
        return None

    def added(self, setting: Setting, start: int, stop: int) -> FloatArray | float:
        """Return a signal (`channel` x `sample`) to add to samples `start` to `stop`."""
        return 0.0

    def pulse_delay(self, setting: Setting, index: IndexArray,
                    times: FloatArray) -> FloatArray | float:
        """Return the delay (s) of the pulses `index`, whose true times are `times` (s)."""
        return 0.0

    def observed(self, setting: Setting, times: FloatArray) -> FloatArray:
        """Return `times` (s) as the acquisition clock of the keyphasor measures them."""
        return times

    def kept(self, setting: Setting, index: IndexArray) -> NDArray[np.bool_]:
        """Return which pulses are measured."""
        return np.ones(index.shape, dtype=np.bool_)


def slow_process(setting: Setting, std: float, name: str, bandwidth: float) -> SinusoidSum:
    """Return a random function of time, flat up to `bandwidth` times the trigger rate."""
    return band_limited(std=std, band=(0.0, bandwidth * setting.trigger_rate), seed=setting.seed,
                        name=name)


#: Limits of a number; `BANDWIDTH` is that of a slow process.
NOT_NEGATIVE, POSITIVE = {'minimum': 0.0}, {'above': 0.0}
BANDWIDTH = {'minimum': 1e-4, 'below': 0.5}


def require_number(name: str, value: float, *, minimum: float = -math.inf,
                   below: float = math.inf, above: float = -math.inf) -> None:
    """Raise ParameterError unless `value` is finite, at least `minimum`, `above` and `below`."""
    if not (math.isfinite(value) and minimum <= value < below and value > above):
        limits = [f'{text} {limit:g}' for text, limit in (
            ('at least', minimum), ('above', above), ('below', below)) if math.isfinite(limit)]
        raise ParameterError(f'{name} {value}: must be {" and ".join(["finite", *limits])}')
