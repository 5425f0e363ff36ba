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
trigger make.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
import math
from typing import Any, ClassVar

import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.effects.effect import Effect, most_scenarios, ODDS, parameter, require_in_turn
from sa_jitter_ros.effects.timing import Pattern, Setting
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.prediction.influence import AveragePulses, trigger_periods
from sa_jitter_ros.prediction.model import DeclaredModel


def own_marks(model: DeclaredModel) -> tuple[int, int]:
    """Return how many marks begin trigger cycles, and the pulses in a trigger cycle."""
    marks = model.pulses_per_revolution
    step = model.pulses_per_trigger or marks
    return marks // math.gcd(marks, step), step


def marks_ahead(model: DeclaredModel, one: tuple[Array, Array], other: tuple[Array, Array]) -> int:
    """
    Return by how many trigger pulses the count of another recording is behind that of one.

    Each recording begins at any mark: what its marks have in common tells. Both are given by the
    `index` of trigger pulses and their `errors` in s, (acquisition, pulse); 0 if they do not tell.
    """
    own, _ = own_marks(model)
    late = [errors - np.nanmean(errors, axis=1, keepdims=True) for _, errors in (one, other)]
    known = np.isfinite(late[0])
    count = np.bincount(one[0][known] % own, minlength=own)
    if own == 1 or not count.all():
        return 0
    marks = np.bincount(one[0][known] % own, late[0][known], minlength=own) / count
    left = [np.nansum((late[1] - marks[(other[0] + ahead) % own]) ** 2) for ahead in range(own)]
    best = int(np.argmin(left))
    clear = math.exp(2.0 * (ODDS + math.log(own)) / np.isfinite(late[1]).sum())
    return best if min(left[0], np.nansum(late[1] ** 2)) > clear * left[best] else 0


def _marks(setting: Setting) -> Array:
    """
    Return for each mark but the last that begins trigger cycles where it is late, alone.

    An angle takes longer where the shaft is slow.
    """
    own, _ = own_marks(setting.model)
    mark = np.asarray(setting.index) % own
    longer = trigger_periods(setting.true_times) / setting.model.trigger_period
    return np.array([((mark == m) * 1.0 - (mark == own - 1)) * longer for m in range(own - 1)])


@dataclass(frozen=True)
class TargetGeometry(Effect):
    """Pulse k comes late by `pulse_angles[k mod n]` rad of the tach shaft."""

    name: ClassVar[str] = 'target_geometry'
    summary: ClassVar[str] = 'marks of the target off their even places'
    meaning: ClassVar[str] = 'the marks of the target are not at even angles'
    remedy: ClassVar[str] = (
        'let the averager learn their angles (target_geometry: learn), or trigger once a '
        'revolution')
    timing: ClassVar[Pattern] = Pattern(_marks)
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
        step = model.pulses_in_trigger_cycle
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

    def pattern(self, model: DeclaredModel, pulses: AveragePulses) -> Array | None:
        """Return the errors of the pulses at hand."""
        return self._at(model, pulses.index) if self.pulse_angles else None

    def counted_anew(self, model: DeclaredModel, index: Array, errors: Array) -> 'TargetGeometry':
        """
        Return the target counted from the mark with which a recording begins.

        It is told by the `errors` in s of the trigger pulses `index`, both (acquisition, pulse);
        the target is as declared where they do not tell.
        """
        angles, left = np.asarray(self.pulse_angles), []
        turned = [replace(self, pulse_angles=tuple(np.roll(angles, -first).tolist()))
                  for first in range(angles.size)]
        for item in turned:
            rest = errors - item._at(model, index)
            left.append(np.nansum((rest - np.nanmean(rest, axis=1, keepdims=True)) ** 2))
        best = int(np.argmin(left))
        gain = 0.5 * np.isfinite(errors).sum() * math.log(left[0] / left[best])
        return turned[best] if gain - math.log(angles.size) > ODDS else self

    @classmethod
    def of_timing(cls, sizes: Array, errors: Array, setting: Setting
                  ) -> tuple['TargetGeometry', Mapping[str, Any]]:
        """Return the angles of all marks; those that begin no trigger cycle stay at 0."""
        own, step = own_marks(setting.model)
        marks = setting.model.pulses_per_revolution
        rad = 2.0 * np.pi * setting.model.trigger_speed * setting.unit
        angles, unsure = np.zeros(marks), np.full(marks, np.nan)
        places = (np.arange(own) * step) % marks
        angles[places] = rad * np.append(sizes, -np.sum(sizes))
        unsure[places] = rad * np.sqrt(np.append(np.diag(errors), np.sum(errors)))
        return cls(tuple(angles.tolist())), {'pulse_angles': unsure.tolist()}

    def remark(self, model: DeclaredModel) -> str:
        """Return how many marks nothing is known of."""
        own, _ = own_marks(model)
        if own == model.pulses_per_revolution:
            return ''
        return (f' ({own} of the {model.pulses_per_revolution} marks begin trigger cycles, '
                'nothing is known of the others: 0 rad)')

    def in_timing(self, setting: Setting) -> Array:
        """Return the delays in units of the marks that begin trigger cycles, but the last."""
        own, step = own_marks(setting.model)
        angles = np.asarray(self.pulse_angles)[(np.arange(own) * step) % len(self.pulse_angles)]
        delays = angles / (2.0 * np.pi * setting.model.trigger_speed * setting.unit)
        return np.asarray((delays - delays.mean())[:-1])
