# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The keyphasor: pulses with known errors, and the waveform of its probe."""

from dataclasses import dataclass

import numpy as np
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.simulation.effect import IndexArray, require_number

_WAVEFORMS = ('ttl', 'sine')


@dataclass(frozen=True, eq=False)
class Pulses:
    """
    Measured pulses and their true times.

    `index` counts the pulses since angle 0; `true_times` (s) are their true times, `times` (s) the
    measured ones.
    """

    index: IndexArray
    times: FloatArray
    true_times: FloatArray

    @property
    def errors(self) -> FloatArray:
        """Return the pulse errors, measured minus true time, s."""
        return self.times - self.true_times


@dataclass(frozen=True)
class Keyphasor:
    """
    A target with evenly spaced marks and the signal of its probe.

    Parameters
    ----------
    pulses_per_revolution
        Marks on the target.
    pulses_per_trigger
        Pulses of a trigger cycle; None for a whole revolution.
    rate
        Sampling rate of the waveform, Hz.
    waveform
        'ttl': low, and high for the fraction `duty` of an interval from each pulse on; 'sine': one
        period per pulse, which rises through the middle level at the pulse.
    low, high
        Levels.
    duty
        Fraction of the interval between pulses that is high, below 0.6.
    rise_time
        Of the edges, s; the pulse lies at half of it.
    noise_std
        White noise on the waveform, in units of the levels.

    Examples
    --------
    >>> keyphasor = Keyphasor(low=0.0, high=5.0, duty=0.2)
    >>> keyphasor.shape(np.array([0.0, 0.1, 0.3, 0.9]), 0.0)
    array([5., 5., 0., 0.])

    """

    pulses_per_revolution: int = 1
    pulses_per_trigger: int | None = None
    rate: float = 50_000.0
    waveform: str = 'ttl'
    low: float = 0.0
    high: float = 5.0
    duty: float = 0.2
    rise_time: float = 0.0
    noise_std: float = 0.0

    def __post_init__(self) -> None:
        """Check the parameters."""
        require_number('pulses_per_revolution', self.pulses_per_revolution, minimum=1)
        require_number('pulses_per_trigger', self.trigger_pulses, minimum=1)
        require_number('keyphasor rate', self.rate, above=0)
        require_number('duty', self.duty, above=0, below=0.6)
        require_number('rise_time', self.rise_time, minimum=0)
        require_number('keyphasor noise_std', self.noise_std, minimum=0)
        if self.waveform not in _WAVEFORMS:
            raise ParameterError(f'keyphasor waveform {self.waveform!r}: must be one of '
                                 f'{", ".join(_WAVEFORMS)}')

    @property
    def trigger_pulses(self) -> int:
        """Return the number of pulses of a trigger cycle."""
        return self.pulses_per_trigger or self.pulses_per_revolution

    def shape(self, phase: FloatArray, rise: FloatArray | float) -> FloatArray:
        """
        Return the waveform without noise.

        `phase` is 0 at a pulse and 1 at the next one; it may begin at -0.25. A ttl edge takes the
        fraction `rise` of this range.
        """
        middle = (self.low + self.high) / 2.0
        if self.waveform == 'sine':
            return middle + (self.high - self.low) / 2.0 * np.sin(2.0 * np.pi * phase)
        inside = np.minimum(phase, self.duty - phase)
        if self.rise_time > 0.0:
            level = np.clip(0.5 + inside / np.maximum(rise, np.finfo(np.float64).tiny), 0.0, 1.0)
        else:
            level = (inside >= 0.0).astype(np.float64)
        return self.low + (self.high - self.low) * level
