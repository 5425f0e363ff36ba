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
What an effect is: an influence on the average that has parameters and can be fitted to evidence.

An effect is one frozen dataclass whose fields are its parameters. It overrides the hooks of
`Influence` that it needs; the defaults of the other hooks have no influence.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
import math
import operator
from typing import Any, ClassVar

import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.effects.evidence import Evidence
from sa_jitter_ros.effects.lattice import SAME_RATE
from sa_jitter_ros.effects.timing import Pattern, Setting, Spectrum
from sa_jitter_ros.errors import ModelError, ParameterError
from sa_jitter_ros.parameters import Parameter
from sa_jitter_ros.prediction.amplitudes import scenario_cycles, SCENARIOS
from sa_jitter_ros.prediction.influence import Influence
from sa_jitter_ros.prediction.model import DeclaredModel
from scipy import special

#: Chance of what is beyond a limit, and of what is taken for decided and is not.
RARE = 0.05
#: What a normal variable exceeds so seldom, in standard deviations.
ONE_SIDED = -float(special.ndtri(RARE))
#: Standard errors of a power, where there is none, below which no limit is.
SEEN = 0.25
#: Logarithm of the odds against an effect before any data: one in 150.
ODDS = 5.0


def parameter(default: Any, description: str, unit: str, **limits: Any) -> Any:
    """Return the dataclass field of a parameter; `limits` are those of `Parameter`."""
    listed = list(default) if isinstance(default, tuple) else default
    return field(default=default, metadata={
        'range': Parameter('', listed, description, unit, **limits)})


def _require_range(name: str, value: Any, limits: Parameter) -> None:
    """Raise ParameterError unless the value, or every one of a list, is in range."""
    if limits.choices:
        if value not in limits.choices:
            raise ParameterError(f'{name} is {value!r}: give one of {", ".join(limits.choices)}')
        return
    given = [(word, limit, holds) for word, limit, holds in (
        ('at least', limits.minimum, operator.ge), ('more than', limits.above, operator.gt),
        ('at most', limits.maximum, operator.le)) if limit is not None]
    for number in value if isinstance(value, tuple) else (value,):
        if not (isinstance(number, (int, float)) and math.isfinite(number)
                and all(holds(number, limit) for _, limit, holds in given)):
            unit = f' {limits.unit}' if limits.unit != '1' else ''
            raise ParameterError(f'{name} is {number}{unit}: give a finite number' + ''.join(
                f', {word} {limit:g}' for word, limit, _ in given))


def largest_power(value: float, count: float, noise: float, square: float, memory: float
                  ) -> float:
    """
    Return the 95 % limit of a random power of which `value` is an estimate, infinite for none.

    An estimate of a power p by `count` squares has the variance 2 / count times (`square`
    + 2 `noise` p + `memory` p^2); that of the limit is a value as low as this once in 20 times.
    """
    chance = 2.0 * ONE_SIDED**2 / count
    left, middle = 1.0 - chance * memory, value + chance * noise
    if left <= 0.0:
        return math.inf
    beyond = math.sqrt(max(middle**2 + left * (chance * square - value**2), 0.0))
    return max((middle + beyond) / left, SEEN * math.sqrt(2.0 * square / count))


def most_scenarios(model: DeclaredModel, wanted: int = SCENARIOS) -> int:
    """Return how many scenarios of a model's averages to list: fewer where averages are long."""
    return min(wanted, max(1, scenario_cycles(model) // model.trigger_cycles))


def require_below(name: str, value: float, limit: float, unit: str, why: str) -> None:
    """Raise ModelError unless a value is below a limit; `why` says the reason and the remedy."""
    if not value < limit:
        raise ModelError(f'{name} is {value:.6g} {unit}, not below {limit:.6g} {unit}: {why}')


def require_in_turn(name: str, spread: float, model: DeclaredModel) -> None:
    """Raise ModelError for pulse errors that spread over `spread` s, so that pulses could swap."""
    require_below(name, spread, model.trigger_period, 's',
                  'pulses could swap in a trigger cycle that short; lower it, or trigger_speed')


class Effect(Influence):
    """
    Base class of all effects; it has no influence itself.

    `name` is the prefix of the effect's parameters, `summary` describes the effect in a few words.
    For somebody who does not know the package, `meaning` says what happens, `remedy` what to do.
    """

    name: ClassVar[str]
    summary: ClassVar[str]
    meaning: ClassVar[str] = ''
    remedy: ClassVar[str] = ''
    #: Whether it makes amplitudes scatter but does not change the attenuation, raw over corrected.
    scatters: ClassVar[bool] = False
    #: Whether the pulse times alone show it; it is then reported even if amplitudes do not change.
    visible_in_pulse_times: ClassVar[bool] = False
    #: Whether the vibration moves while the pulse times are correct; recovery shows pulse errors.
    pulse_times_correct: ClassVar[bool] = False

    #: How it shows in pulse times and recovered pulse errors, None where it does not.
    timing: ClassVar[Spectrum | Pattern | None] = None

    def __post_init__(self) -> None:
        """Check every parameter."""
        for name, limits in parameter_ranges(type(self)).items():
            _require_range(f'{self.name}.{name}', getattr(self, name), limits)

    @property
    def random(self) -> bool:
        """Return whether its errors are drawn at random, so that only their size is known."""
        return self.scatters or not isinstance(self.timing, Pattern)

    @classmethod
    def of_timing(cls, sizes: Array, errors: Array, setting: Setting
                  ) -> tuple['Effect', Mapping[str, Any]]:
        """
        Return the effect, and the standard errors of its parameters, of what `timing` was fitted.

        `sizes` are the parameters of the spectrum, or the sizes of the columns of the pattern;
        `errors` their standard errors, of a pattern their covariance.
        """
        raise NotImplementedError

    def remark(self, model: DeclaredModel) -> str:
        """Return what is to be said of the fitted effect beside its parameters, '' for nothing."""
        return ''

    def in_timing(self, setting: Setting) -> Array:
        """Return the `sizes` of the effect as it is."""
        raise NotImplementedError

    @property
    def values(self) -> Mapping[str, Any]:
        """Return the parameters by name."""
        return {name: getattr(self, name) for name in parameter_ranges(type(self))}


def possible(effect: Effect, model: DeclaredModel) -> bool:
    """Tell whether a machine can have an effect of that size: whether it can be predicted."""
    try:
        effect.processes(model)
    except ModelError:
        return False
    return True


class DirectEffect(Effect):
    """Base class of the effects whose size is read from the lines, or from the pulses missing."""

    @classmethod
    def fit(cls, evidence: Evidence) -> 'Finding':
        """Return the effect that fits the evidence best, what supports and what contradicts it."""
        raise NotImplementedError

    @classmethod
    def limit(cls, evidence: Evidence) -> Effect | None:
        """Return the largest such effect that the evidence allows at 95 %, None for no limit."""
        return None


@dataclass(frozen=True)
class Finding:
    """
    The result of fitting an effect to the evidence.

    `effect` has the fitted parameters, None if nothing could be fitted; `standard_errors` are by
    parameter; `p_value` is the probability of evidence at least this strong if the effect is
    absent; `gain` is what the effect adds to the logarithm of the evidence, without the odds
    against it, NaN where all sets of effects decide together; `evidence` describes it in words.
    `contradiction` says what in the data contradicts the effect, '' if nothing does.
    `indistinguishable_from` names effects that this evidence cannot distinguish from it,
    `deciding_measurement` a measurement that could. `largest_change` is the largest change, over
    the lines, of the mean attenuation or of the standard deviation of one average that the effect
    makes, NaN where it is not known.
    """

    name: str
    effect: Effect | None
    standard_errors: Mapping[str, Any]
    p_value: float
    evidence: str
    contradiction: str = ''
    indistinguishable_from: Sequence[str] = ()
    deciding_measurement: str = ''
    largest_change: float = math.nan
    gain: float = math.nan

    @property
    def probability(self) -> float:
        """Return the probability of the effect by its gain."""
        return float(special.expit(self.gain - ODDS))


def absent(name: str, reason: str, *, p_value: float = 1.0, gain: float = 0.0) -> Finding:
    """Return the finding of an effect that the evidence does not show; `reason` says why."""
    return Finding(name, None, {}, p_value, reason, contradiction=reason, gain=gain)


def beyond_chance(likelihood: float, parameters: int, cycles: int, tried: float = 1.0) -> float:
    """
    Return what of a gain in log likelihood is none of free parameters (Schwarz).

    The `parameters` were measured in so many trigger `cycles`, and are the best of those `tried`.
    """
    return likelihood - 0.5 * parameters * math.log(cycles) - math.log(tried)


def weighed(finding: Finding, likelihood: float, parameters: int, evidence: Evidence, *,
            tried: float = 1.0) -> Finding:
    """
    Return a finding with its gain and p value, absent unless its gain exceeds the odds against it.

    `likelihood` is the gain in log likelihood by its `parameters`, the best of those `tried`.
    """
    gain = beyond_chance(likelihood, parameters, evidence.cycles, tried)
    found = replace(finding, gain=gain, p_value=min(
        1.0, tried * float(special.chdtrc(parameters, 2.0 * likelihood))))
    return found if gain > ODDS else absent(
        finding.name, 'the likelihood gains too little by it', p_value=found.p_value, gain=gain)


def same(found: Any, known: Any) -> bool:
    """Return whether two values of a parameter are the same; rates are that where clocks are."""
    return bool(found == known) or (isinstance(found, float) and math.isclose(
        found, known, rel_tol=SAME_RATE))


def departs(effect: Effect, errors: Mapping[str, Any], declared: Effect, cycles: int) -> bool:
    """
    Return whether the numbers of a fitted effect, with their errors, are not the declared.

    A rate whose error is None counts as another one where a clock would.
    """
    away: list[float] = []
    for name, error in errors.items():
        found, known = effect.values[name], declared.values[name]
        if error is None or np.shape(found) != np.shape(known):
            if not same(found, known):
                return True
            continue
        size = np.ravel(error)
        given = np.isfinite(size) & (size > 0.0)
        away += (np.ravel(np.subtract(found, known))[given] / size[given]).tolist()
    return beyond_chance(0.5 * float(np.sum(np.square(away))), len(away), cycles) > ODDS


def parameter_ranges(kind: type) -> Mapping[str, Parameter]:
    """Return the ranges of an effect's parameters by name, in their order."""
    return {item.name: item.metadata['range'] for item in fields(kind)
            if 'range' in item.metadata}


def effects_of(findings: Iterable[Finding]) -> list[Effect]:
    """Return the effects that were found."""
    return [finding.effect for finding in findings if finding.effect is not None]
