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
Limits: how large an effect that was not found could still be, at 95 %.

Limits are one-sided. Of a random effect it is the power beside which the data show, all other
parameters at their best, as little as a normal variable falls short by once in twenty times; of a
pattern, whose sizes have either sign, it is the size of which estimates as small are as rare.
An effect is undecided if, as large as its limit, it would still change an average.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
import math

import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.effects import Effect, EFFECTS
from sa_jitter_ros.effects.band import ACCELERATION_BAND, memory
from sa_jitter_ros.effects.effect import (
    DirectEffect, largest_power, ONE_SIDED, parameter_ranges, possible, RARE, SEEN)
from sa_jitter_ros.effects.evidence import Evidence
from sa_jitter_ros.effects.jitter_scale import JitterScale
from sa_jitter_ros.effects.lattice import coarsest_clock
from sa_jitter_ros.effects.speed_fluctuation import SpeedFluctuation
from sa_jitter_ros.effects.timing import FAINT, Pattern
from sa_jitter_ros.errors import ModelError, ParameterError
from sa_jitter_ros.inference.candidates import Candidate
from sa_jitter_ros.inference.record_fit import MOST_STEPS
from sa_jitter_ros.inference.residual import NOTICEABLE
from sa_jitter_ros.inference.timing import Timing
from sa_jitter_ros.inference.timing_fit import JITTER
from sa_jitter_ros.prediction.prediction import Prediction
from scipy import special

_EXACT = 0.01  # of a logarithm of power
#: The largest change that an effect beside others makes.
Change = Callable[[Sequence[Effect], Effect], float]
# Shares of effects that are there, in the open half of the table of decisions; as many of those
# that are named are not.
_NOT_NAMED, _NOWHERE = 0.02, 7e-4


@dataclass(frozen=True)
class EffectLimit:
    """
    What of an effect could still be there.

    `upper` and `lower` are 95 % limits of its `parameter` in its `unit`, None where there is none;
    of a list it is the root mean square. `effect` is the effect at its limit.
    """

    name: str
    parameter: str
    unit: str
    upper: float | None
    lower: float | None = None
    effect: Effect | None = None


def limits(timing: Timing | None, evidence: Evidence, found: Sequence[str]
           ) -> tuple[EffectLimit, ...]:
    """Return the limit of each effect that was not `found`; `evidence` may hold pulses alone."""
    rows = []
    for name, kind in EFFECTS.items():
        if name in found:
            continue
        lower: float | None = None
        effect: Effect | None = None
        if issubclass(kind, DirectEffect):
            effect = kind.limit(evidence) if kind.visible_in_pulse_times or evidence.pulses else (
                None)
        elif timing is None:
            pass
        elif name == JITTER:
            lower, effect = _of_scale(timing)
        elif name == SpeedFluctuation.name:
            effect = _of_speed(timing)
        elif isinstance(kind.timing, Pattern) and kind.timing.replaces_jitter:
            lower = coarsest_clock(timing.chooser.data.pulse_times)
        else:
            effect = largest(timing, name)
        parameter, limit = next(iter(parameter_ranges(kind).items()))
        rows.append(EffectLimit(name, parameter, limit.unit, _size(effect), lower, effect))
    return tuple(rows)


def undecided_effects(change: Change, effects: Sequence[Effect], rows: Sequence[EffectLimit]
                      ) -> tuple[str, ...]:
    """
    Return the effects that, as large as their limits, would still change an average.

    Random motions without a limit may be of any size.
    """
    found = []
    for row in rows:
        if row.effect is None:
            kind = EFFECTS[row.name]
            if row.lower is None and not issubclass(kind, DirectEffect) and not isinstance(
                    kind.timing, Pattern):
                found.append(row.name)
            continue
        try:
            size = change(effects, row.effect)
        except ModelError:  # so large that no average is left
            size = math.inf
        if size >= NOTICEABLE:
            found.append(row.name)
    return tuple(found)


def published_change(before: Prediction, after: Prediction) -> float:
    """Return the largest change of what is published: mean and scatter of an order."""
    return float(max(np.abs(getattr(after, name) - getattr(before, name)).max()
                     for name in ('mean_attenuation', 'standard_deviation')))


def probabilities(candidates: Sequence[Candidate], timing: Timing | None, named: Iterable[str],
                  not_testable: Collection[str]) -> Mapping[str, float]:
    """
    Return the probability that the declared model lacks an effect, of all that could be seen.

    The odds among sets of effects hold if one of these sets is true. How often an effect is there
    that was named, or that has these odds and was not named, is counted.
    """
    odds = {item.name: item.finding.probability for item in candidates}
    odds |= timing.probabilities if timing is not None else {}
    found = {name: _NOWHERE + _NOT_NAMED * value for name, value in odds.items()}
    found |= dict.fromkeys(named, 1.0 - _NOT_NAMED)
    return {name: value for name, value in found.items() if name not in not_testable}


def _size(effect: Effect | None) -> float | None:
    if effect is None:
        return None
    value = next(iter(effect.values.values()))
    if isinstance(value, str):
        return None
    return float(np.sqrt(np.mean(np.square(value))))


def largest(timing: Timing, name: str) -> Effect | None:
    """Return the largest effect on the timing of some name that the data allow, None for none."""
    chooser, choice, kind = timing.chooser, timing.choice, EFFECTS[name]
    if isinstance(kind.timing, Pattern):
        if name not in chooser.patterns:
            return None
        sizes, covariance = chooser.fit(choice.best | {name}, choice.fit.starts).pattern(name)
        found, errors = _farthest(sizes, covariance), covariance
    else:
        power = _bound(timing, name, ONE_SIDED)
        if power is None:
            return None
        found, errors = power, np.zeros(power.size)
    try:
        effect, _ = kind.of_timing(found, errors, choice.setting)
    except ParameterError:  # the data allow more than such an effect may be
        return None
    return effect if possible(effect, choice.setting.model) else None


def _bound(timing: Timing, name: str, far: float) -> Array | None:
    """
    Return the parameters of a component that has `far` standard errors more power than is seen.

    A negative number stands for less; None is returned where it is beyond all that is tried.
    Far away, where the other parameters find no way back, the likelihood itself excludes a power.
    """
    chooser, choice = timing.chooser, timing.choice
    names, kurtosis = choice.best | {name}, chooser.shapes.kurtosis if chooser.shapes else 0.0
    fit = chooser.fit(names, choice.fit.starts)
    at = float(fit.starts[name][0])
    low, high = min(at, FAINT) - 1.0, float(fit.upper[fit.place[name]][0])
    top, best, first, begin = high, -math.inf, fit.starts, fit.starts
    last: tuple[float, float] | None = None
    for _ in range(MOST_STEPS):
        tried = chooser.fit(names, begin, held={(name, 0): at})
        best = max(best, tried.value)
        if tried.value < best - far**2:
            low, high = (low, at) if far > 0.0 else (at, high)
            begin, at = first, 0.5 * (low + high)
            continue
        fit, begin = tried, tried.starts
        more, seen = fit.more_than_held(name, kurtosis)
        if not seen > 0.0:
            return None
        # right if the power that is seen, and its standard error, do not depend on the one held
        step = math.log(max(seen + more + far, SEEN) / seen)
        low, high = (at, high) if step > 0.0 else (low, at)
        if abs(step) < _EXACT or high - low < _EXACT:
            break
        turn = 1.0 if last is None else (last[1] - step) / (at - last[0])
        last, to = (at, step), at + step / (turn if 0.0 < turn < 1.0 else 1.0)
        at = to if low < to < high else 0.5 * (low + high)
    return fit.starts[name] if abs(step) < _EXACT or high < top else None


def _farthest(sizes: Array, covariance: Array) -> Array:
    """
    Return the sizes of a pattern of which estimates as near to 0 as these are as rare as 5 %.

    How far estimates are from 0, in squared standard errors, has a noncentral chi2 distribution.
    """
    distance = float(sizes @ np.linalg.pinv(covariance) @ sizes)
    true = float(special.chndtrinc(distance, sizes.size, RARE))
    if not distance > 0.0 or math.isnan(true):  # so far from 0 that it makes no difference
        return sizes
    return np.asarray(sizes * math.sqrt(max(true, 1.0) / distance))


def _of_scale(timing: Timing) -> tuple[float | None, Effect | None]:
    """Return the interval of the size of the declared jitter."""
    far = float(special.ndtri(0.5 * RARE))  # on either side
    low, high = (_bound(timing, JITTER, side) for side in (far, -far))
    return (None if low is None else math.exp(0.5 * low[0]),
            None if high is None else JitterScale(math.exp(0.5 * high[0])))


def _of_speed(timing: Timing) -> Effect | None:
    """Return the largest acceleration that the bends allow."""
    parts = timing.chooser.data.stretches
    if not all(np.isfinite(item.bend_std) for item in parts):
        return None
    bends = np.concatenate([item.bends for item in parts])
    noise = float(np.mean([item.bend_std**2 for item in parts]))
    power = largest_power(float(np.mean(bends**2)) - noise, bends.size, noise, noise**2,
                          memory(ACCELERATION_BAND))
    return None if math.isinf(power) else SpeedFluctuation.of_ripple(
        math.sqrt(power), timing.choice.setting.model)
