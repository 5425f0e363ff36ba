# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

# The name is that of the concept; a module in a package hides no builtin one.
# flake8: noqa: A005

"""
Limits: how large an effect that was not found could still be, at 95 %.

Limits are one-sided. Of a random effect it is where the profile of the likelihood, all other
parameters at their best, has fallen by what a normal variable exceeds once in twenty times; of a
pattern, whose size has either sign, it is the size of which an estimate as small is as rare.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.effects import Effect, EFFECTS
from sa_jitter_ros.effects.effect import DirectEffect, parameter_ranges
from sa_jitter_ros.effects.evidence import Evidence
from sa_jitter_ros.effects.jitter_scale import JitterScale
from sa_jitter_ros.effects.speed_fluctuation import SpeedFluctuation
from sa_jitter_ros.effects.timing import Pattern, Spectrum
from sa_jitter_ros.inference.timing import Timing
from sa_jitter_ros.inference.timing_fit import JITTER
from scipy import optimize, special

Array = NDArray[Any]

_CONFIDENCE = 0.95
_FALL = float(special.ndtri(_CONFIDENCE)) ** 2
_TWO_SIDED = float(special.ndtri(0.5 * (1.0 + _CONFIDENCE)))
_LEAST = -9.0  # logarithm of a power that is nothing
_STEP, _EXACT = 1.5, 0.02  # of a logarithm of power
_RESOLUTION = 4.0  # spacings of a number: finer grids are its own


@dataclass(frozen=True)
class Limit:
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
           ) -> tuple[Limit, ...]:
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
        elif isinstance(kind.timing, Pattern) and kind.timing.about is not None:
            lower = _coarsest_clock(np.concatenate([
                item.setting.times[item.measured] for item in timing.chooser.data.stretches]))
        else:
            effect = largest(timing, name)
        parameter, limit = next(iter(parameter_ranges(kind).items()))
        rows.append(Limit(name, parameter, limit.unit, _size(effect), lower, effect))
    return tuple(rows)


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
    names = choice.best | {name}
    if isinstance(kind.timing, Pattern):
        if name not in chooser.patterns:
            return None
        fit = chooser.fit(names, choice.fit.starts)
        sizes, covariance = fit.pattern(name)
        error = np.sqrt(np.diag(covariance))
        wide = np.array([_folded(*pair) for pair in zip(np.abs(sizes), error)])
        return kind.of_timing(wide, covariance, choice.setting)[0]
    if not isinstance(kind.timing, Spectrum):
        return None
    fit = chooser.fit(names, choice.fit.starts)
    best, start = max(fit.value, choice.fit.value), dict(fit.starts)

    @cache  # fits start where others ended: another one may differ by a little
    def fallen(log_power: float) -> float:
        held = chooser.fit(names, start, held={(name, 0): log_power})
        start.update(held.starts)
        return 2.0 * (best - held.value) - _FALL

    low = max(float(fit.starts[name][0]), _LEAST)
    high, top = low + _STEP, kind.timing.upper[0]
    while high < top and fallen(high) < 0.0:
        low, high = high, high + _STEP
    high = min(high, top)
    if fallen(high) < 0.0:  # however large it is
        return None
    at = float(optimize.brentq(
        fallen, low, high, xtol=_EXACT, disp=False)) if fallen(low) < 0.0 else low
    held = chooser.fit(names, start, held={(name, 0): at})
    return kind.of_timing(held.starts[name], np.zeros(len(kind.timing.upper)), choice.setting)[0]


def _folded(size: float, error: float) -> float:
    """Return the size of which an estimate of at most `size`, either sign, is as rare as 5 %."""
    def missed(true: float) -> float:
        return float(special.ndtr(size / error - true) - special.ndtr(-size / error - true)) - (
            1.0 - _CONFIDENCE)

    if error <= 0.0 or not math.isfinite(error):
        return size
    if missed(1.0) < 0.0:  # never below a standard error
        return error
    return error * float(optimize.brentq(missed, 1.0, size / error + 10.0))


def _of_scale(timing: Timing) -> tuple[float, Effect]:
    """Return the interval of the size of the declared jitter."""
    choice = timing.choice
    fit = timing.chooser.fit(choice.best | {JITTER}, choice.fit.starts)
    middle, error = float(fit.starts[JITTER][0]), float(fit.standard_errors(JITTER)[0])
    low, high = (math.exp(0.5 * (middle + sign * _TWO_SIDED * error)) for sign in (-1.0, 1.0))
    return low, JitterScale(high)


def _of_speed(timing: Timing) -> Effect | None:
    """Return the largest acceleration that the bends inside the cycles allow."""
    parts = timing.chooser.data.stretches
    if not all(np.isfinite(item.bend_std) for item in parts):
        return None
    bends = np.concatenate([item.bends for item in parts])
    noise = float(np.mean([item.bend_std**2 for item in parts]))
    power = max(float(np.mean(bends**2)) - noise, 0.0)
    power += math.sqrt(_FALL * 2.0 / bends.size) * (noise + power)
    return SpeedFluctuation.of_ripple(math.sqrt(power), timing.choice.setting.model)


def _coarsest_clock(times: Array) -> float | None:
    """Return the rate of the coarsest clock whose grid the pulse times could lie on."""
    intervals = np.sort(np.diff(times))
    steps = np.diff(intervals)
    steps = steps[steps > _RESOLUTION * np.spacing(np.max(np.abs(times)))]
    return float(1.0 / steps.min()) if steps.size else None
