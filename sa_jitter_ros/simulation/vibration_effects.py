"""Effects on the vibration: motion of the shafts, path to the sensor, sampling."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
import math

import numpy as np
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.simulation.effect import Effect, require_number, Setting, Signal, slow_process
from sa_jitter_ros.simulation.random_streams import FloatArray, RandomStream
from sa_jitter_ros.simulation.sinusoids import band_limited, SinusoidSum
from scipy.interpolate import CubicSpline

GRID_OFFSET = 1e-3 * (np.sqrt(5.0) - 1.0)  # of rates; irrational: fractions spread evenly
_SPLINE_MARGIN = 32  # an end acts on the spline by 0.268^32 there: below rounding

Interpolator = Callable[[FloatArray, FloatArray], FloatArray]


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


# Name of the averager's method: function, and number of samples that it needs on either side.
INTERPOLATORS: Mapping[str, tuple[Interpolator, int]] = {
    'linear': (linear, 1), 'cubic': (cubic, 2), 'spline': (spline, _SPLINE_MARGIN)}


@dataclass(frozen=True)
class SpeedFluctuation(Effect):
    """
    Random acceleration of `acceleration_std` rad/s^2 of the tach shaft.

    Its frequencies lie below a fifth of the trigger rate: it is nearly constant within a trigger
    cycle.
    """

    acceleration_std: float

    def __post_init__(self) -> None:
        """Check the parameters."""
        require_number('speed_fluctuation.acceleration_std', self.acceleration_std, minimum=0)

    def speed_fluctuation(self, setting: Setting) -> SinusoidSum:
        """Return the relative fluctuation whose derivative is the acceleration."""
        rate = setting.trigger_rate
        acceleration = band_limited(std=self.acceleration_std, band=(0.05 * rate, 0.2 * rate),
                                    seed=setting.seed, name='speed_fluctuation')
        return acceleration.integral().scaled(1 / (2 * np.pi * setting.motion.nominal_speed))


@dataclass(frozen=True)
class PhaseWander(Effect):
    """
    Slow random angle of `std` rad between a shaft and its vibration, independent for each shaft.

    Its frequencies reach up to `bandwidth` times the trigger rate.
    """

    std: float
    bandwidth: float = 0.4

    def __post_init__(self) -> None:
        """Check the parameters."""
        require_number('phase_wander.std', self.std, minimum=0)
        require_number('phase_wander.bandwidth', self.bandwidth, minimum=0.05, below=0.5)

    def source_angle(self, setting: Setting, shaft: str, times: FloatArray) -> FloatArray:
        """Return the angle in rad of the shaft."""
        return slow_process(setting, self.std, f'phase_wander {shaft}',
                            bandwidth=self.bandwidth).value(times)


@dataclass(frozen=True)
class AmplitudeModulation(Effect):
    """Slow random gain on the vibration of each shaft, of mean 1 and standard deviation `std`."""

    std: float

    def __post_init__(self) -> None:
        """Check the parameters."""
        require_number('amplitude_modulation.std', self.std, minimum=0)

    def gain(self, setting: Setting, shaft: str, times: FloatArray) -> FloatArray:
        """Return the factor."""
        return 1.0 + slow_process(setting, self.std, f'amplitude_modulation {shaft}').value(times)


@dataclass(frozen=True)
class InterpolationLoss(Effect):
    """
    The vibration was sampled on another grid of nearly the same rate and interpolated by `method`.

    Positions between two samples of the other grid run evenly through all fractions.
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
        rate = setting.sample_rate * (1.0 + GRID_OFFSET)
        positions = np.arange(start, stop) * (1.0 + GRID_OFFSET)
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

    def __post_init__(self) -> None:
        """Check the parameters."""
        require_number('interfering_tone.frequency', self.frequency, above=0)
        require_number('interfering_tone.amplitude', self.amplitude, minimum=0)

    def added(self, setting: Setting, start: int, stop: int) -> FloatArray:
        """Return the tone."""
        cycles = np.arange(start, stop) * (self.frequency / setting.sample_rate)
        phase = RandomStream(setting.seed, 'interfering_tone').uniform(0, 1)[0, 0]
        return np.asarray(self.amplitude * np.cos(2.0 * np.pi * (cycles % 1.0 + phase)))
