"""
What an effect is: parameters with ranges, what it does to an average, and how it is fitted.

An effect is one frozen dataclass whose fields are its parameters. It overrides the hooks it needs;
what it leaves alone has no influence. Any number of effects combine, because each only names its
independent contribution to the one angle error (THEORY, section 1).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
import math
from typing import Any, ClassVar, TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.errors import ModelError, ParameterError
from sa_jitter_ros.prediction.angle_error import AngleErrorProcess
from sa_jitter_ros.prediction.moments import AverageMoments
from sa_jitter_ros.prediction.prediction import DeclaredModel

if TYPE_CHECKING:
    from sa_jitter_ros.effects.evidence import Evidence, Finding

Array = NDArray[Any]

_MOST_ERRORS = 4_000_000  # of pulses in all scenarios


@dataclass(frozen=True)
class ParameterRange:
    """Description, SI unit and range of one parameter; `choices` are those of a text."""

    description: str
    unit: str
    minimum: float = -math.inf
    maximum: float = math.inf
    above: float = -math.inf
    choices: tuple[str, ...] = ()

    def check(self, name: str, value: Any) -> None:
        """Raise ParameterError unless the value, or every one of a list, is in range."""
        if self.choices:
            if value not in self.choices:
                raise ParameterError(f'{name} is {value!r}: give one of {", ".join(self.choices)}')
            return
        for number in value if isinstance(value, tuple) else (value,):
            if not (isinstance(number, (int, float)) and math.isfinite(number)
                    and self.minimum <= number <= self.maximum and number > self.above):
                limits = [f'at least {self.minimum:g}'] if math.isfinite(self.minimum) else []
                limits += [f'more than {self.above:g}'] if math.isfinite(self.above) else []
                limits += [f'at most {self.maximum:g}'] if math.isfinite(self.maximum) else []
                raise ParameterError(f'{name} is {number} {self.unit}: give a finite number'
                                     + ''.join(f', {limit}' for limit in limits))


def parameter(default: Any, description: str, unit: str, **limits: Any) -> Any:
    """Return the dataclass field of a parameter; `limits` are those of `ParameterRange`."""
    return field(default=default, metadata={'range': ParameterRange(description, unit, **limits)})


@dataclass(frozen=True)
class Pulses:
    """
    The measured trigger pulses of one average, or with them those beside that its angle law reads.

    `times` (N_t + 1,) in s, NaN where nothing is known but the number of pulses; `first` counts
    the pulses before them in the recording, missing ones too; `errors` (N_t + 1,) in s holds what
    the grid of a clock says about each (`keyphasor_quantisation`), None where it says nothing;
    `missing` (N_t,) is how many pulses lack within each cycle; `error_std` in s is how uncertain
    `errors` are that were measured otherwise, `unknown_std` what they do not hold of the true
    ones, correlated from pulse to pulse by `unknown_correlation`.
    """

    times: Array
    first: int = 0
    errors: Array | None = None
    missing: Array | None = None
    error_std: float = 0.0
    unknown_std: float = 0.0
    unknown_correlation: float = 0.0

    @property
    def index(self) -> Array:
        """Return how many pulses went before each (N_t + 1,), missing ones too."""
        lost = 0 if self.missing is None else np.concatenate(([0], np.cumsum(self.missing)))
        return np.asarray(self.first + np.arange(len(self.times)) + lost)

    def without(self, before: int, after: int) -> 'Pulses':
        """Return all but some pulses at either end."""
        kept = slice(before, len(self.times) - after)
        cycles = slice(before, kept.stop - 1)
        return replace(
            self, times=self.times[kept], first=int(self.index[before]),
            errors=None if self.errors is None else self.errors[kept],
            missing=None if self.missing is None else self.missing[cycles])


def mean_period(times: Array, missing: Array | None) -> float:
    """Return the mean trigger period in s of pulses of which `missing` (interval,) lack."""
    lost = 0 if missing is None else missing.sum()
    return float((times[-1] - times[0]) / (len(times) - 1 + lost))


def most_scenarios(model: DeclaredModel, wanted: int) -> int:
    """Return how many scenarios of a model's averages to list: fewer where averages are long."""
    return int(np.clip(_MOST_ERRORS // model.trigger_cycles, 1, wanted))


def require_below(name: str, value: float, limit: float, unit: str, why: str) -> None:
    """Raise ModelError unless a value is below a limit; `why` says the reason and the remedy."""
    if not value < limit:
        raise ModelError(f'{name} is {value:.6g} {unit}, not below {limit:.6g} {unit}: {why}')


def require_in_turn(name: str, spread: float, model: DeclaredModel) -> None:
    """Raise ModelError for pulse errors that spread over `spread` s, so that pulses could swap."""
    require_below(name, spread, model.trigger_period, 's',
                  'pulses could swap in a trigger cycle that short; lower it, or trigger_speed')


class Effect:
    """
    An effect that does nothing: the base of all.

    Pulse errors are in s, measured minus true time; `name` is the one of the contract.
    """

    name: ClassVar[str]
    summary: ClassVar[str]
    #: Whether amplitudes scatter while the attenuation, raw over corrected, stays as it is.
    scatters: ClassVar[bool] = False
    #: Whether it is seen in the pulses themselves, so that it is reported whatever it does.
    seen: ClassVar[bool] = False
    #: Whether the recovered errors of single pulses are what tells it.
    of_pulses: ClassVar[bool] = False
    #: Whether the vibration moves and the pulses are right, however its motion is recovered.
    moves_vibration: ClassVar[bool] = False

    def __post_init__(self) -> None:
        """Check every parameter."""
        for name, limits in parameter_ranges(type(self)).items():
            limits.check(f'{self.name}.{name}', getattr(self, name))

    # --- forward model ---

    @classmethod
    def unmodelled(cls, model: DeclaredModel) -> str:
        """Say why there is no forward model with this declared model; '' where there is one."""
        return ''

    def processes(self, model: DeclaredModel) -> Sequence[AngleErrorProcess]:
        """
        Return random angle errors, or random gains, that are stationary over the cycles.

        None of them where they have no size: the prediction is then the one without the effect.
        """
        return ()

    def scenarios(self, model: DeclaredModel) -> Array | None:
        """
        Return equally likely pulse errors (scenario, N_t + 1) in s of an average.

        They are what is known of the pulses up to a few numbers that nobody knows in advance. None
        where nothing is known, or all errors are 0.
        """
        return None

    def drawn_scenarios(self, model: DeclaredModel, count: int) -> Array | None:
        """Return random scenarios (count, N_t + 1) in s where no few hold all, None elsewhere."""
        return None

    def exact_moments(self, model: DeclaredModel, processes: Sequence[AngleErrorProcess]
                      ) -> AverageMoments | None:
        """Return the moments over all scenarios with random `processes`, where they are known."""
        return None

    def pattern(self, model: DeclaredModel, pulses: Pulses) -> Array | None:
        """Return the pulse errors (N_t + 1,) in s of one average whose pulses were measured."""
        return None

    def gain(self, model: DeclaredModel) -> Array:
        """Return the factor (order,) on the component alone."""
        return np.ones(len(model.orders))

    def line_variance(self, model: DeclaredModel) -> Array:
        """Return the mean square (order,) of what is added to each complex peak amplitude."""
        return np.zeros(len(model.orders))

    def replaces_jitter(self, model: DeclaredModel) -> bool:
        """Tell whether the effect takes the place of the declared jitter."""
        return False

    def pulse_autocovariance(self, model: DeclaredModel, lags: Array) -> Array:
        """Return the autocovariance in s^2 that the random errors of the pulses show at `lags`."""
        return np.zeros(np.shape(lags))

    # --- evidence ---

    @classmethod
    def fit(cls, evidence: 'Evidence') -> 'Finding':
        """Return the effect that fits the evidence best, with what speaks for or against it."""
        raise NotImplementedError

    @property
    def values(self) -> Mapping[str, Any]:
        """Return the parameters by name."""
        return {name: getattr(self, name) for name in parameter_ranges(type(self))}


def parameter_ranges(kind: type) -> Mapping[str, ParameterRange]:
    """Return the ranges of an effect's parameters by name, in their order."""
    return {item.name: item.metadata['range'] for item in fields(kind)
            if 'range' in item.metadata}


def parameter_defaults(kind: type) -> Mapping[str, Any]:
    """Return the defaults of an effect's parameters by name, in their order."""
    return {item.name: item.default for item in fields(kind) if 'range' in item.metadata}
