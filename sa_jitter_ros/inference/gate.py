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
The gate: no effect is named with which held-out averages are predicted worse than as declared.

Two predictions of the same acquisitions are compared one acquisition at a time, since what an
acquisition has by chance is in both. A tie is no harm.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
import math

import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.effects.effect import effects_of, Finding

#: Standard errors of a paired difference from which on it is one.
CERTAIN = 2.0


@dataclass(frozen=True)
class HeldOut:
    """
    A prediction of the held-out acquisitions, and what was observed of them.

    `observed`, `expected` and `variance` (2, acquisition, line) are those of attenuation and raw
    amplitude; the first `compared` lines are those whose attenuation is compared.
    """

    observed: Array = field(repr=False)
    expected: Array = field(repr=False)
    variance: Array = field(repr=False)
    compared: int

    @property
    def log_density(self) -> Array:
        """Return the normal log density (acquisition,), the mean over lines."""
        power = (self.observed - self.expected) ** 2 / self.variance
        return np.asarray(np.mean(-0.5 * (power + np.log(self.variance)), axis=2).sum(axis=0))

    @property
    def difference(self) -> Array:
        """Return observed minus predicted attenuation (acquisition, line)."""
        return np.asarray((self.observed - self.expected)[0, :, :self.compared])

    @property
    def rms(self) -> float:
        """Return the RMS over lines of the mean difference."""
        return _rms(self.difference)

    def beside(self, other: 'HeldOut') -> 'HeldOut':
        """Return the prediction of these lines and of those of another one, not compared."""
        observed, expected, variance = (
            np.concatenate([getattr(item, name) for item in (self, other)], axis=2)
            for name in ('observed', 'expected', 'variance'))
        return HeldOut(observed, expected, variance, self.compared)


@dataclass(frozen=True)
class ScoreGain:
    """
    What a prediction gains over another one, with standard errors of the paired differences.

    `log_score` is the mean gain in log density of an acquisition, `rms` the change of the RMS of
    the attenuation, whose sign counts where an effect changes a mean (`of_mean`).
    """

    log_score: float
    log_score_error: float
    rms: float
    rms_error: float
    of_mean: bool

    @property
    def worse(self) -> bool:
        """Return whether the prediction is worse, by more than two standard errors."""
        return (self.log_score < -CERTAIN * self.log_score_error
                or (self.of_mean and self.rms > CERTAIN * self.rms_error))


#: With nothing added, nothing changes.
NO_GAIN = ScoreGain(0.0, 0.0, 0.0, 0.0, False)


def score_gain(before: HeldOut, after: HeldOut, *, of_mean: bool) -> ScoreGain:
    """
    Return what `after` gains over `before`; the RMS errs by the jackknife over acquisitions.

    The log score errs at least by as much as `after` lets it: a wider distribution gains by few
    acquisitions that are far away, which a few held-out ones may lack.
    """
    apart = after.log_density - before.log_density
    count = apart.size
    if count < 2:
        return ScoreGain(float(apart.mean()), math.inf, after.rms - before.rms, math.inf, of_mean)
    every = np.arange(count)
    without = [_rms(after.difference[every != i]) - _rms(before.difference[every != i])
               for i in every]
    error = max(float(np.std(apart, ddof=1)), _expected_scatter(before, after)) / math.sqrt(count)
    return ScoreGain(float(apart.mean()), error, after.rms - before.rms,
                     float(np.std(without) * math.sqrt(count - 1)), of_mean)


def passed(findings: Sequence[Finding], predict: Callable[[Sequence[Finding]], HeldOut]
           ) -> tuple[list[Finding], list[Finding], ScoreGain]:
    """
    Return the findings that pass the gate, those that do not, and what the former gain.

    ``predict(findings)`` predicts with the declared model and these. The first to go is the one
    without which the held-out acquisitions are most likely.
    """
    if not findings:
        return [], [], NO_GAIN
    kept, dropped, declared = list(findings), list[Finding](), predict([])
    while kept:
        found = score_gain(declared, predict(kept), of_mean=any(
            not effect.scatters for effect in effects_of(kept)))
        if not found.worse:
            return kept, dropped, found
        scores = [float(predict(kept[:i] + kept[i + 1:]).log_density.mean())
                  for i in range(len(kept))]
        dropped.append(kept.pop(int(np.argmax(scores))))
    return [], dropped, NO_GAIN


def _expected_scatter(before: HeldOut, after: HeldOut) -> float:
    """Return by how much the gain of an acquisition scatters if `after` is right, at most."""
    ratio = after.variance / before.variance
    moved = (after.expected - before.expected) ** 2 * ratio / before.variance
    return float(np.mean(np.sqrt(0.5 * (1.0 - ratio) ** 2 + moved), axis=(1, 2)).sum())


def _rms(difference: Array) -> float:
    """Return the RMS over lines of the mean over acquisitions (acquisition, line)."""
    return float(np.sqrt(np.mean(difference.mean(axis=0) ** 2)))
