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
Target geometry: marks off their even places, an error that repeats with the revolution.

Which mark begins a trigger cycle repeats with a period that the declared marks and pulses per
trigger make. Errors that repeat with another one are no target's, but a hum's, say.
"""

from collections.abc import Mapping
from dataclasses import dataclass
import math
from typing import ClassVar

import numpy as np
from sa_jitter_ros.effects.effect import (
    absent, Array, Effect, Finding, most_scenarios, parameter, require_in_turn)
from sa_jitter_ros.effects.evidence import Evidence
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.prediction.influence import Pulses
from sa_jitter_ros.prediction.model import DeclaredModel
from scipy import stats

_LONGEST = 24
_SIGNIFICANT = 1e-4
_FEWEST = 3  # acquisitions


@dataclass(frozen=True)
class TargetGeometry(Effect):
    """Pulse k comes late by `pulse_angles[k mod n]` rad of the tach shaft."""

    name: ClassVar[str] = 'target_geometry'
    summary: ClassVar[str] = 'marks of the target off their even places'
    needs_pulse_errors: ClassVar[bool] = True
    pulse_angles: tuple[float, ...] = parameter(
        (), 'angle by which each mark of the target is late', 'rad')

    def __post_init__(self) -> None:
        """Check every angle."""
        if not isinstance(self.pulse_angles, tuple):
            raise ParameterError(f'target_geometry.pulse_angles is {self.pulse_angles}: give a '
                                 'list of angles in rad, one for each mark')
        super().__post_init__()

    def _at(self, model: DeclaredModel, index: Array) -> Array:
        """Return the errors in s of the trigger pulses `index`."""
        step = model.pulses_per_trigger or model.pulses_per_revolution
        angles = np.asarray(self.pulse_angles)[index * step % len(self.pulse_angles)]
        return np.asarray(angles / (2.0 * np.pi * model.trigger_speed))

    def scenarios(self, model: DeclaredModel) -> Array | None:
        """Return the errors for every mark that an average may begin with."""
        if not any(self.pulse_angles):
            return None
        require_in_turn('the spread of target_geometry.pulse_angles', (
            max(self.pulse_angles) - min(self.pulse_angles)) / (2.0 * np.pi * model.trigger_speed),
            model)
        kept = most_scenarios(model, len(self.pulse_angles))
        first = (np.arange(kept) * len(self.pulse_angles) // kept)[:, None]
        return self._at(model, first + np.arange(model.trigger_cycles + 1))

    def pattern(self, model: DeclaredModel, pulses: Pulses) -> Array | None:
        """Return the errors of the pulses at hand."""
        return self._at(model, pulses.index) if self.pulse_angles else None

    @classmethod
    def fit(cls, evidence: Evidence) -> Finding:
        """Fold the pulse errors by the marks that begin trigger cycles: a revolution repeats."""
        model = evidence.model
        count = evidence.errors.shape[1]
        marks = model.pulses_per_revolution
        step = model.pulses_per_trigger or marks
        own = marks // math.gcd(marks, step)
        fold = _folded(evidence, own) if 1 < own < count - 2 else None
        if own > 1 and fold is None:
            return absent(cls.name, f'too few pulses to fold by the {own} marks that begin '
                          f'trigger cycles: {_FEWEST} acquisitions of {own + 2} cycles are needed')
        if fold is None or fold.log_p_value > math.log(_SIGNIFICANT):
            others = [p for p in range(2, min(_LONGEST, count // 2) + 1) if own % p]
            return cls._absent({p: found for p in others if (found := _folded(evidence, p))},
                               own, marks)
        p_value = math.exp(max(fold.log_p_value, -690.0))
        angles, errors = np.zeros(marks), np.full(marks, np.nan)
        places = (np.arange(own) * step) % marks
        angles[places] = 2.0 * np.pi * model.trigger_speed * fold.mean
        errors[places] = 2.0 * np.pi * model.trigger_speed * fold.error
        text = (f'the pulse errors repeat every {own} trigger pulses, as the marks do, with '
                f'{fold.size:.3g} s, p = {p_value:.2g}')
        if own < marks:
            text += (f'; {own} of the {marks} marks begin trigger cycles, nothing is known of '
                     'the others (0 rad)')
        return Finding(cls.name, cls(tuple(angles.tolist())),
                       {'pulse_angles': errors.tolist()}, p_value, text)

    @classmethod
    def _absent(cls, folds: Mapping[int, '_Fold'], own: int, marks: int) -> Finding:
        """Say with what period the errors repeat that is none of the target's."""
        if not folds:
            return absent(cls.name, 'the pulse errors do not repeat with the pulse index')
        best = min(folds, key=lambda p: folds[p].criterion)
        p_value = min(1.0, math.exp(max(folds[best].log_p_value, -690.0)) * len(folds))
        if p_value > _SIGNIFICANT:
            return absent(cls.name, 'the pulse errors do not repeat with the pulse index: best '
                          f'period {best}, p = {p_value:.2g}', p_value=p_value)
        target = (f'a target of {marks} marks, {own} of which begin trigger cycles,' if own > 1
                  else f'a target with {marks} mark{"s" * (marks > 1)}, the same every time,')
        return absent(cls.name, f'the pulse errors repeat every {best} trigger pulses with '
                      f'{folds[best].size:.3g} s, p = {p_value:.2g}, which no mark of {target} '
                      'does', p_value=p_value)


@dataclass(frozen=True)
class _Fold:
    """
    Pulse errors folded by the pulse index: `mean` (phase,) and its standard `error` in s.

    The p value of their repeating comes from how acquisitions agree, which any memory of the
    errors leaves valid; the Bayesian information `criterion` compares periods.
    """

    mean: Array
    error: float
    log_p_value: float
    criterion: float

    @property
    def size(self) -> float:
        """Return the root mean square of what repeats, in s."""
        return float(np.sqrt(np.mean(self.mean**2)))


def _folded(evidence: Evidence, period: int) -> _Fold | None:
    """
    Return the errors folded by the index; None where too few acquisitions hold all phases.

    Errors at the ends are rough and left out.
    """
    table, phases, errors = [], [], []
    for row, pulses in zip(evidence.errors[:, 1:-1], evidence.pulses):
        phase = pulses.index[1:-1] % period
        often = np.bincount(phase, minlength=period)
        if np.all(often > 0):  # a gap may hide one
            folded = np.bincount(phase, row, period) / often
            table.append(folded - folded.mean())
            phases.append(phase)
            errors.append(row)
    count = len(table)
    if count < _FEWEST:
        return None
    rows = np.array(table)
    mean = rows.mean(axis=0)
    between = np.sum((rows - mean) ** 2) / ((count - 1) * (period - 1))
    ratio = count * np.sum(mean**2) / (period - 1) / max(between, 1e-300)
    log_p_value = float(stats.f.logsf(ratio, period - 1, (count - 1) * (period - 1)))
    left = np.array(errors) - mean[np.array(phases)]
    left = left - left.mean(axis=1, keepdims=True)
    # Where the pulses are those of the reference keyphasor, all errors are 0.
    variance = max(float(np.mean(left**2)), 1e-300)
    criterion = left.size * math.log(variance) + period * math.log(left.size)
    error = float(np.sqrt(between * (period - 1) / period / count))
    return _Fold(mean, error, log_p_value, criterion)
