# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The synchronous average: its parameters, its settings and its result."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
import math
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.arrays import ComplexArray, FloatArray
from sa_jitter_ros.averaging.amplitude_errors import AmplitudeErrors
from sa_jitter_ros.averaging.envelope import Envelope, EnvelopeSettings
from sa_jitter_ros.averaging.interpolator_gain import mean_gain
from sa_jitter_ros.averaging.jackknife import WaveformParts
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.parameters import listed, number, numbers, RATIO, whole_number
from sa_jitter_ros.pulses.angle_law import ANGLE_LAWS
from sa_jitter_ros.pulses.resampling import METHODS
from sa_jitter_ros.pulses.validation import GeometryMode, MissingPulses, PulseValidator

AVERAGING = ('block', 'sliding', 'exponential')


@dataclass(frozen=True)
class AverageSettings:
    """
    Settings of the average of one shaft.

    `cycle_length` is r, the fundamental cycles in a trigger cycle, `revolutions_per_trigger` the
    revolutions of the tach shaft in it; `trigger_cycles` is N_t; `orders` are multiples of the
    shaft speed; `samples_per_revolution` 0 chooses the number of points of the waveform. With
    `correct_jitter` the pulse errors are recovered from the vibration (block averages only). They
    are expected to be of the size that a keyphasor sampled at `keyphasor_rate` (Hz) causes; 0 is
    the sampling rate of the vibration. Up to `maximum_discarded` times N_t discarded trigger
    cycles may lie between those of an average, if their number is known. With bearing orders in
    `envelope` a block average has the squared envelope of the residual signal. Raises
    `ParameterError` for values that cannot be used.
    """

    cycle_length: float = 1.0
    trigger_cycles: int = 40
    orders: tuple[float, ...] = (1.0, 2.0, 3.0)
    samples_per_revolution: int = 0
    averaging: str = 'block'
    angle_law: str = 'linear'
    revolutions_per_trigger: float = 1.0
    interpolation: str = 'band_limited'
    correct_jitter: bool = False
    keyphasor_rate: float = 0.0
    maximum_discarded: float = 0.0
    envelope: EnvelopeSettings = field(default_factory=EnvelopeSettings)

    def __post_init__(self) -> None:
        """Check every value."""
        for name in ('cycle_length', 'revolutions_per_trigger', 'keyphasor_rate',
                     'maximum_discarded'):
            object.__setattr__(self, name, number(name, getattr(self, name)))
        for name in ('trigger_cycles', 'samples_per_revolution'):
            object.__setattr__(self, name, whole_number(name, getattr(self, name)))
        if not (math.isfinite(self.cycle_length) and self.cycle_length > 0.0):
            raise ParameterError(f'a trigger cycle is {self.cycle_length} fundamental cycles '
                                 'long: give a positive ratio')
        if self.trigger_cycles < 1:
            raise ParameterError(f'trigger_cycles is {self.trigger_cycles}: give at least 1')
        if not self.orders or not all(math.isfinite(g) and g > 0.0 for g in self.orders):
            raise ParameterError(f'orders are {list(self.orders)}: give positive numbers')
        if self.samples_per_revolution < 0 or 0 < self.samples_per_revolution < 4:
            raise ParameterError(f'samples_per_revolution is {self.samples_per_revolution}: give '
                                 'at least 4, or 0 to choose it')
        if self.correct_jitter and self.averaging != 'block':
            raise ParameterError(f'correct_jitter with averaging {self.averaging!r}: pulse errors '
                                 'are recovered per block; set averaging to block')
        if self.envelope.bearing_orders and self.averaging != 'block':
            raise ParameterError(f'bearing_orders with averaging {self.averaging!r}: the squared '
                                 'envelope is that of a block; set averaging to block')
        if not (math.isfinite(self.keyphasor_rate) and self.keyphasor_rate >= 0.0):
            raise ParameterError(f'keyphasor_rate is {self.keyphasor_rate} Hz: give a positive '
                                 "rate, or 0 for the vibration's")
        if not 0.0 <= self.maximum_discarded <= 1.0:
            raise ParameterError(f'maximum_discarded is {self.maximum_discarded}: give the share '
                                 'of trigger_cycles, 0 to 1, that may be discarded between those '
                                 'of an average')
        if self.correct_jitter and self.trigger_cycles < 2:
            raise ParameterError('correct_jitter with trigger_cycles 1: pulse errors follow from '
                                 'the difference between cycles; give at least 2')
        for name, value, known in (('averaging', self.averaging, AVERAGING),
                                   ('angle_law', self.angle_law, ANGLE_LAWS),
                                   ('interpolation', self.interpolation, METHODS)):
            if value not in known:
                raise ParameterError(f'{name} is {value!r}: give one of {", ".join(known)}')

    def declared_jitter(self, period: float) -> float:
        """
        Return the standard deviation of the declared jitter in fundamental cycles, 0 without one.

        `period` (s) is that of a trigger cycle.
        """
        clock = math.sqrt(12.0) * self.keyphasor_rate
        return self.cycle_length / (clock * period) if clock else 0.0


@dataclass(frozen=True, kw_only=True)
class KeyphasorParameters:
    """
    Parameters of the keyphasor, under the names that the nodes use.

    With `pulses_per_trigger` None or 0 a trigger cycle is a revolution. The other parameters are
    those of `PulseValidator`. Raises `ParameterError` if a trigger cycle is longer than a
    revolution.

    >>> keyphasor = KeyphasorParameters(pulses_per_revolution=60, pulses_per_trigger=30)
    >>> keyphasor.revolutions_per_trigger, keyphasor.average(ratio=3.0).cycle_length
    (0.5, 1.5)
    """

    pulses_per_revolution: int = 1
    pulses_per_trigger: int | None = None
    missing_teeth: int = 0
    missing_pulses: MissingPulses = 'break'
    maximum_missing: int = 3
    interval_tolerance: float = 0.0
    minimum_interval: float = 0.0
    time_tolerance: float = 0.01
    path_delay: float = 0.0
    target_geometry: GeometryMode = 'none'
    target_angles: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        """Check what `PulseValidator` does not check."""
        for name in ('interval_tolerance', 'minimum_interval', 'time_tolerance', 'path_delay'):
            object.__setattr__(self, name, number(name, getattr(self, name)))
        object.__setattr__(self, 'target_angles', numbers('target_angles', self.target_angles))
        for name in ('pulses_per_revolution', 'pulses_per_trigger', 'missing_teeth',
                     'maximum_missing'):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, whole_number(name, getattr(self, name)))
        if self.pulses_per_revolution < 1:
            raise ParameterError(f'pulses_per_revolution is {self.pulses_per_revolution}: give at '
                                 'least 1')
        if (self.pulses_per_trigger or 0) > self.pulses_per_revolution:
            raise ParameterError(
                f'pulses_per_trigger is {self.pulses_per_trigger}, more than the '
                f'{self.pulses_per_revolution} pulses_per_revolution: give at most '
                f'{self.pulses_per_revolution}')

    @property
    def revolutions_per_trigger(self) -> float:
        """Revolutions of the tach shaft in a trigger cycle."""
        return float((self.pulses_per_trigger or self.pulses_per_revolution)
                     / self.pulses_per_revolution)

    def validator(self) -> PulseValidator:
        """Return a validator for the pulses of this keyphasor; raises `ParameterError`."""
        options = {**asdict(self), 'pulses_per_trigger': self.pulses_per_trigger or None}
        return PulseValidator(**options)

    def average(self, *, ratio: float = 1.0, orders: Sequence[float] | None = None,
                **settings: Any) -> AverageSettings:
        """
        Return the settings of the average of a shaft; raises `ParameterError`.

        `ratio` is the speed of the shaft over that of the tach shaft, `orders` None are 1, 2, 3;
        other settings are those of `AverageSettings`.
        """
        if orders is not None:
            settings['orders'] = numbers('orders', orders)
        return AverageSettings(
            cycle_length=RATIO.convert(ratio) * self.revolutions_per_trigger,
            revolutions_per_trigger=self.revolutions_per_trigger, **settings)


@dataclass(frozen=True)
class Correction:
    """
    The pulse errors of an average, recovered from the vibration, and the corrected average.

    `waveform` (channel, angle) and `amplitudes` (channel, order), with their standard deviation
    `noise`, are those between corrected pulses. Where the correction is not `accepted` they are
    the raw ones, and `reason` says why. `pulse_errors` and `standard_errors` (N_t + 1,) in s are
    measured minus true times with mean 0, as the vibration alone tells them; NaN where it leaves
    an error ambiguous. `jitter_std` in s is the standard deviation of the true jitter that the
    vibration shows, the declared one where it shows too little, NaN where the correction is not
    accepted. `refitted` pulses counted as missing, because no jitter explains their errors.
    `amplitudes` are NaN where the phase of an order stays unknown. `attenuation`
    (channel, order) is the raw over the corrected amplitude, NaN without an accepted correction.
    Both contain the same noise, and `attenuation_standard_error` accounts for this correlation.
    `cycle_amplitudes` (cycle, channel, order) are those of the single trigger cycles between
    corrected pulses. `amplitude_errors` say how far `amplitudes` are from the truth, `parts` are
    the waveforms of parts of the cycles, None of fewer than three, `envelope` that of the
    residual signal between corrected pulses, None without bearing orders.

    A clock of 1 kHz makes each pulse up to 1 ms late, which attenuates order 19 of a shaft at
    20.3 Hz. The correction recovers these errors except for their mean:

    >>> import numpy as np
    >>> import sa_jitter_ros as sa
    >>> true = np.arange(31) / 20.3
    >>> vibration = np.cos(2.0 * np.pi * 19.0 * 20.3 * np.arange(30_000) / 20e3)
    >>> pulses = np.ceil(true * 1e3) / 1e3
    >>> average, = sa.average(vibration, 20e3, pulses, orders=[19.0], correct_jitter=True,
    ...                       keyphasor_rate=1e3)
    >>> correction = average.correction
    >>> correction.accepted, correction.attenuation.round(2)
    (True, array([[0.86]]))
    >>> abs(correction.amplitudes).round(3)
    array([[1.]])
    >>> errors = pulses - true
    >>> bool(abs(correction.pulse_errors - (errors - errors.mean())[:31]).max() < 1e-6)
    True
    """

    waveform: FloatArray
    amplitudes: ComplexArray
    noise: FloatArray
    pulse_errors: FloatArray
    standard_errors: FloatArray
    accepted: bool
    reason: str
    attenuation: FloatArray
    attenuation_standard_error: FloatArray
    cycle_amplitudes: ComplexArray
    amplitude_errors: AmplitudeErrors
    parts: WaveformParts | None = None
    jitter_std: float = math.nan
    refitted: int = 0
    envelope: Envelope | None = None

    def __repr__(self) -> str:
        """Return one line: whether it was accepted, the size of the errors, what is left."""
        if not self.accepted:
            return f'Correction(refused: {self.reason})'
        known = self.pulse_errors[np.isfinite(self.pulse_errors)]
        size = 1e6 * math.sqrt(np.mean(known**2)) if known.size else math.nan
        return (f'Correction(accepted, {self.pulse_errors.size} pulse errors of {size:.3g} us '
                f'RMS, attenuation {listed(self.attenuation.ravel(), 3)})')


class Later(Protocol):
    """What an average makes when it is asked for it."""

    def indicators(self) -> Mapping[str, tuple[FloatArray, FloatArray]]:
        """Return the condition indicators by name, each with its standard error."""

    def signals(self) -> tuple[FloatArray, FloatArray]:
        """Return the residual and the difference signal."""


@dataclass(frozen=True)
class Average:
    """
    A synchronous average over consecutive trigger cycles.

    Times in s; `trigger_speed` is the mean speed of the tach shaft in Hz. `waveform` and its
    `standard_error` (channel, angle) are means over whole fundamental cycles at the `angle`
    (angle,) in revolutions of the shaft, NaN if no cycle is whole. `amplitudes` (channel, order)
    are complex peak amplitudes over whole trigger cycles, over what the interpolator leaves of
    them, `gains` (cycle, order); a cosine whose maximum is at angle 0 has phase 0. They are NaN of
    the orders that are `refused`, by their reason: those of which the interpolator leaves less
    than half, or that reach half the sampling rate. `noise` (channel, order) is their standard
    deviation along the radius. The waveform holds the loss by the interpolator. `first_angle` is
    the angle of the first pulse in revolutions of the shaft since the start, `pulses` (N_t + 1,)
    are in s. `discarded_cycles` trigger cycles between
    the first and the last pulse are not in the average: then there are more pulses, those at both
    ends of every run of consecutive cycles, and `used` (pulse,) says which of them begin a cycle
    of the average. `cycle_numbers` (N_t,) count from the first cycle, discarded ones included.
    `cycle_amplitudes` (cycle, channel, order)
    are the amplitudes of the single trigger cycles, read-only, with phases that refer to the same
    angle as those of their mean. `amplitude_errors` say how well another average would repeat
    `amplitudes`. `parts` are the waveforms of parts of the cycles of a block, None of fewer than
    three whole fundamental cycles. `correction` is None unless `correct_jitter` was set.

    `indicators`, `residual` and `difference` are made when they are first asked for
    (`sa_jitter_ros.averaging.indicators`); `envelope` is that of what the average leaves of the
    vibration, None without bearing orders. All of them are of the corrected average where there is
    one.

    A shaft at 25 Hz with an order 3 of amplitude 2 and phase 1 rad, in a single channel:

    >>> import numpy as np
    >>> import sa_jitter_ros as sa
    >>> time = np.arange(10_000) / 5e3
    >>> vibration = 2.0 * np.cos(2.0 * np.pi * 3.0 * 25.0 * time + 1.0)
    >>> average, = sa.average(vibration, 5e3, np.arange(50) / 25.0, orders=[3.0])
    >>> average.trigger_cycles, round(average.trigger_speed, 6), average.waveform.shape
    (49, 25.0, (1, 216))
    >>> average
    Average(sequence 0, 49 trigger cycles at 25 Hz from 0 s to 1.96 s, waveform (1, 216), orders 3)
    >>> abs(average.amplitudes).round(3), np.angle(average.amplitudes).round(3)
    (array([[2.]]), array([[1.]]))
    """

    start_time: float
    end_time: float
    sequence: int
    trigger_cycles: int
    fundamental_cycles: int
    discarded_cycles: int
    trigger_speed: float
    angle: FloatArray
    waveform: FloatArray
    standard_error: FloatArray
    orders: FloatArray
    amplitudes: ComplexArray
    noise: FloatArray
    first_angle: float
    pulses: FloatArray
    used: NDArray[np.bool_]
    cycle_numbers: NDArray[np.int64]
    cycle_amplitudes: ComplexArray
    amplitude_errors: AmplitudeErrors
    parts: WaveformParts | None = None
    correction: Correction | None = None
    envelope: Envelope | None = None
    later: Later | None = field(default=None, repr=False, compare=False)
    gains: FloatArray = field(default_factory=lambda: np.ones((1, 1)))
    refused: Mapping[float, str] = field(default_factory=dict)

    @cached_property
    def indicators(self) -> Mapping[str, tuple[FloatArray, FloatArray]]:
        """Return the condition indicators by name, each with its standard error (channel,)."""
        return {} if self.later is None else self.later.indicators()

    @cached_property
    def _signals(self) -> tuple[FloatArray | None, FloatArray | None]:
        return (None, None) if self.later is None else self.later.signals()

    @property
    def residual(self) -> FloatArray | None:
        """Return the residual signal (channel, angle)."""
        return self._signals[0]

    @property
    def difference(self) -> FloatArray | None:
        """Return the difference signal (channel, angle)."""
        return self._signals[1]

    def __getstate__(self) -> dict[str, Any]:
        """Return the values for a copy, which does not need the averages before it."""
        made = {'indicators': self.indicators, '_signals': self._signals}
        return {**vars(self), **made, 'later': None}

    @property
    def gain(self) -> FloatArray:
        """Return what the interpolator leaves of each order (order,), NaN if refused."""
        return mean_gain(self.gains, self.orders, self.refused)

    @property
    def periods(self) -> FloatArray:
        """Return the lengths (N_t,) of the trigger cycles in s."""
        begins = np.flatnonzero(self.used)
        return np.asarray(self.pulses[begins + 1] - self.pulses[begins])

    def __repr__(self) -> str:
        """Return one line: cycles, speed, times, shape of the waveform, orders."""
        corrected = '' if self.correction is None else (
            ', corrected' if self.correction.accepted else ', correction refused')
        return (f'Average(sequence {self.sequence}, {self.trigger_cycles} trigger cycles at '
                f'{self.trigger_speed:.5g} Hz from {self.start_time:.6g} s to '
                f'{self.end_time:.6g} s, waveform {self.waveform.shape}, orders '
                f'{listed(self.orders)}{corrected})')
