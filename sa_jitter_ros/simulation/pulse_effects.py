"""Effects on the pulses of the keyphasor: their times, the clock that measures them, losses."""

from collections.abc import Callable
from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.simulation.effect import Effect, IndexArray, require_number, Setting
from sa_jitter_ros.simulation.random_streams import FloatArray, RandomStream
from sa_jitter_ros.simulation.sinusoids import band_limited, SinusoidSum
from scipy.special import ndtri

MAX_CORRELATION = 0.9999  # beyond it a pulse depends on too many earlier ones to draw
JITTER_DISTRIBUTIONS = ('uniform', 'normal', 'triangular', 'table')


@dataclass(frozen=True)
class DeclaredJitter(Effect):
    """
    The declared pulse error: independent, of zero mean.

    `std` in s; a `table` (s) lists equally likely errors and needs no `std`.
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
            raise ParameterError(f'jitter table {self.table}: needs finite errors in s')

    def pulse_delay(self, setting: Setting, index: IndexArray, times: FloatArray) -> FloatArray:
        """Return the error of each pulse."""
        place = _per_pulse(RandomStream(setting.seed, 'declared_jitter').uniform, index)
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
class ExcessJitter(Effect):
    """Independent normal errors of the pulse times, `std` s (electrical noise)."""

    std: float

    def __post_init__(self) -> None:
        """Check the parameters."""
        require_number('excess_jitter.std', self.std, minimum=0)

    def pulse_delay(self, setting: Setting, index: IndexArray, times: FloatArray) -> FloatArray:
        """Return the delay of each pulse."""
        return self.std * _per_pulse(RandomStream(setting.seed, 'excess_jitter').normal, index)


@dataclass(frozen=True)
class CorrelatedJitter(Effect):
    """Normal errors of `std` s, pulses k apart correlated by `correlation^k`."""

    std: float
    correlation: float

    def __post_init__(self) -> None:
        """Check the parameters."""
        require_number('correlated_jitter.std', self.std, minimum=0)
        require_number('correlated_jitter.correlation', self.correlation, above=-MAX_CORRELATION,
                       below=MAX_CORRELATION)

    def pulse_delay(self, setting: Setting, index: IndexArray, times: FloatArray) -> FloatArray:
        """Return the delay of each pulse."""
        stream = RandomStream(setting.seed, 'correlated_jitter')
        return self.std * _per_pulse(
            lambda *places: stream.autoregressive(*places, correlation=self.correlation), index)


@dataclass(frozen=True)
class TargetGeometry(Effect):
    """
    Marks of the target that are not evenly spaced: pulse k is late by `pulse_angles[k mod n]` rad.

    With one angle for each pulse of a revolution, an angle belongs to a mark of the target.
    """

    pulse_angles: tuple[float, ...]

    def __post_init__(self) -> None:
        """Check the parameters."""
        if not self.pulse_angles or not np.isfinite(self.pulse_angles).all():
            raise ParameterError(f'target_geometry.pulse_angles {self.pulse_angles}: needs at '
                                 'least one finite angle in rad')

    def pulse_delay(self, setting: Setting, index: IndexArray, times: FloatArray) -> FloatArray:
        """Return how much later each mark passes than an evenly spaced one."""
        marks = np.array(self.pulse_angles)[index % len(self.pulse_angles)] / (2.0 * np.pi)
        nominal = index / setting.pulses_per_revolution
        return setting.motion.time_at(nominal + marks) - times


@dataclass(frozen=True)
class ClockSkew(Effect):
    """The clock of the keyphasor runs fast by `skew`: it shows t (1 + skew) at time t."""

    skew: float

    def __post_init__(self) -> None:
        """Check the parameters."""
        require_number('clock_skew.skew', self.skew, above=-1, below=1)

    def observed(self, setting: Setting, times: FloatArray) -> FloatArray:
        """Return the times on the fast clock."""
        return times * (1.0 + self.skew)


@dataclass(frozen=True)
class KeyphasorQuantisation(Effect):
    """
    The keyphasor is sampled: pulse times are rounded up to a clock of `clock_rate` Hz.

    `period_std` (s) is the standard deviation of the trigger period by a slow speed fluctuation,
    which spreads the pulses evenly between the ticks of the clock.
    """

    clock_rate: float
    period_std: float = 0.0

    def __post_init__(self) -> None:
        """Check the parameters."""
        require_number('keyphasor_quantisation.clock_rate', self.clock_rate, above=0)
        require_number('keyphasor_quantisation.period_std', self.period_std, minimum=0)

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

    def __post_init__(self) -> None:
        """Check the parameters."""
        require_number('missing_pulses.probability', self.probability, minimum=0, below=1)

    def kept(self, setting: Setting, index: IndexArray) -> NDArray[np.bool_]:
        """Return which pulses are measured."""
        draws = _per_pulse(RandomStream(setting.seed, 'missing_pulses').uniform, index)
        return draws >= self.probability


def _per_pulse(draw: Callable[[int, int], FloatArray], index: IndexArray) -> FloatArray:
    """Return one item of a stream for each of consecutive pulses."""
    return draw(int(index[0]), int(index[-1]) + 1)[0] if index.size else np.empty(0)
