"""The synchronous average: how it is made, and what it is."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.parameters import RATIO
from sa_jitter_ros.pulses.angle_law import ANGLE_LAWS
from sa_jitter_ros.pulses.resampling import METHODS
from sa_jitter_ros.pulses.validation import MissingPulses, PulseValidator

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

AVERAGING = ('block', 'sliding', 'exponential')


@dataclass(frozen=True)
class AverageSettings:
    """
    How the trigger cycles of one shaft are averaged.

    `cycle_length` is r, the fundamental cycles in a trigger cycle, `revolutions_per_trigger` the
    revolutions of the tach shaft in it; `trigger_cycles` is N_t; `orders` are multiples of the
    shaft; `samples_per_revolution` 0 chooses the waveform's grid. With
    `correct_jitter` the pulse errors are recovered from the vibration (block averages only);
    `keyphasor_rate` (Hz) declares how large they may be, 0 for a keyphasor sampled with the
    vibration. Raises `ParameterError` for values that cannot be used.
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

    def __post_init__(self) -> None:
        """Check every value."""
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
        if not (math.isfinite(self.keyphasor_rate) and self.keyphasor_rate >= 0.0):
            raise ParameterError(f'keyphasor_rate is {self.keyphasor_rate} Hz: give a positive '
                                 "rate, or 0 for the vibration's")
        if self.correct_jitter and self.trigger_cycles < 2:
            raise ParameterError('correct_jitter with trigger_cycles 1: one cycle cannot be '
                                 'compared with itself; give at least 2')
        for name, value, known in (('averaging', self.averaging, AVERAGING),
                                   ('angle_law', self.angle_law, ANGLE_LAWS),
                                   ('interpolation', self.interpolation, METHODS)):
            if value not in known:
                raise ParameterError(f'{name} is {value!r}: give one of {", ".join(known)}')


@dataclass(frozen=True, kw_only=True)
class KeyphasorParameters:
    """
    What is known of the keyphasor, by the names of the node's parameters.

    `pulses_per_trigger` None or 0 makes all pulses of a revolution a trigger cycle; the others are
    those of `PulseValidator`. Raises `ParameterError` where a trigger cycle is more than a
    revolution.
    """

    pulses_per_revolution: int = 1
    pulses_per_trigger: int | None = None
    missing_teeth: int = 0
    missing_pulses: MissingPulses = 'break'
    maximum_missing: int = 3
    interval_tolerance: float = 0.25
    minimum_interval: float = 0.0
    time_tolerance: float = 0.01

    def __post_init__(self) -> None:
        """Check what a validator does not."""
        if (self.pulses_per_trigger or 0) > self.pulses_per_revolution:
            raise ParameterError(
                f'pulses_per_trigger is {self.pulses_per_trigger} of {self.pulses_per_revolution} '
                'pulses_per_revolution: give at most that many')

    @property
    def revolutions_per_trigger(self) -> float:
        """Revolutions of the tach shaft in a trigger cycle."""
        return float((self.pulses_per_trigger or self.pulses_per_revolution)
                     / self.pulses_per_revolution)

    def validator(self) -> PulseValidator:
        """Return a validator of this keyphasor's pulses; raises `ParameterError`."""
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
            settings['orders'] = tuple(float(order) for order in orders)
        return AverageSettings(
            cycle_length=RATIO.convert(ratio) * self.revolutions_per_trigger,
            revolutions_per_trigger=self.revolutions_per_trigger, **settings)


@dataclass(frozen=True)
class Correction:
    """
    What the vibration tells about the errors of an average's pulses, and the average without them.

    `waveform` (channel, angle) and `amplitudes` (channel, order) with their standard deviation
    `noise` are those between corrected pulses, the raw ones where the correction is not `accepted`
    (`reason` says why). `pulse_errors` and `standard_errors` (N_t + 1,) in s, measured minus true
    with mean 0. `attenuation` (channel, order) is raw over corrected amplitude; the noise of the
    two is the same noise, so that its `attenuation_standard_error` is that of a ratio of
    correlated amplitudes. `cycle_amplitudes` (cycle, channel, order) are those of the single
    trigger cycles between corrected pulses.
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


@dataclass(frozen=True)
class Average:
    """
    A synchronous average over consecutive trigger cycles.

    Times in s; `trigger_speed` is the mean speed of the tach shaft in Hz. `waveform` and its
    `standard_error` are (channel, angle) over whole fundamental cycles, NaN where none is whole,
    at the `angle` (angle,) in revolutions of the shaft; `amplitudes` (channel, order) are complex
    peak amplitudes over whole trigger cycles, cos having phase 0 where the angle is 0 (NaN from
    the Nyquist frequency on), `noise` (channel, order) their standard deviation along the radius.
    `first_angle` is the angle of the first pulse in revolutions of the shaft since the start,
    `pulses` (N_t + 1,) in s; `discarded_cycles` trigger cycles between the first and the last
    pulse are not in the average. `cycle_amplitudes` (cycle, channel, order) are the amplitudes of
    the single trigger cycles, read-only, with phases at the same angle as their mean.
    `correction` is there where it was asked for.
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
    cycle_amplitudes: ComplexArray
    correction: Correction | None = None
