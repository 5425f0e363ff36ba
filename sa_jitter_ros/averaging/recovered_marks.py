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
What the vibration adds to the geometry of a target: pulse errors that repeat with the mark.

The pulses alone take a ripple of the speed with the revolution for late marks. The errors that are
recovered from the vibration are measured against its angle, so that they show by how much the
angles taken from the pulses are wrong. Their mean over averages is taken from later pulses.
"""

from collections import deque
from dataclasses import replace
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.arrays import FloatArray, IntArray
from sa_jitter_ros.averaging.average import Average
from sa_jitter_ros.pulses.target_geometry import MarkOffsets

_FEWEST = 2  # pulses of each mark in an average: of one, all may be its jitter
# Averages that the mean remembers: fewer leave more of the noise, more follow a target that
# changes (another speed, a mark that bends) later.
_MEMORY = 50.0
# Share of the errors that are taken, with which the vibration decides: from half on, the
# angles are larger than their standard errors.
_DECIDES = 0.5


class RecoveredMarks:
    """
    Mean of the recovered errors of each mark of a target with `count` teeth.

    `take_from` takes them from trigger pulses, `learn` learns them from an average.
    """

    def __init__(self, count: int) -> None:
        self._count = count
        self._pulses: deque[tuple[FloatArray, IntArray, FloatArray, FloatArray]] = deque()
        self._begin(0)

    def _begin(self, numbering: int) -> None:
        """Begin with teeth that are numbered anew."""
        self._numbering = numbering
        self._angles, self._sum, self._weight = np.zeros((3, self._count))
        self._shares, self._errors = np.zeros((2, self._count))
        self._shown: tuple[MarkOffsets, MarkOffsets] | None = None  # without, and with it

    def take_from(self, items: NDArray[Any], first: int, stop: int, *, revolutions: float,
                  remember: bool) -> None:
        """
        Take the angles from the times of pulses `first` to `stop` of a run that begins before.

        `items` are trigger pulses (`streaming.TRIGGER`); a trigger cycle is so many `revolutions`
        long. Pulses are remembered until `learn` has seen the average that they are in.
        """
        place = first + np.flatnonzero(items['mark'][first:stop] >= 0)
        if not place.size:
            return
        numbering, marks = np.divmod(items['mark'][place], self._count)
        if numbering[-1] != self._numbering:
            self._begin(int(numbering[-1]))
        before = np.where(items['starts_run'][place] | (place == 0), place, place - 1)
        elapsed = items['elapsed']
        pace = (elapsed[before + 1] - elapsed[before]) / (2.0 * math.pi * revolutions)
        angles = np.where(numbering == self._numbering, self._angles[marks], 0.0)
        items['time'][place] -= angles * pace
        items['mark'][place] = -1
        if remember:
            self._pulses.append((items['time'][place], marks, pace, angles))

    def learn(self, average: Average) -> None:
        """Take the recovered errors of an average."""
        correction = average.correction
        if not self._pulses or correction is None:
            return
        times, marks, pace, taken = (np.concatenate(item) for item in zip(*self._pulses))
        last = int(np.searchsorted(times, average.end_time))
        self._pulses = deque([(times[last:], marks[last:], pace[last:], taken[last:])])
        if not times.size:  # all were in the average before
            return
        place = np.minimum(np.searchsorted(times, average.pulses), times.size - 1)
        chosen = ((times[place] == average.pulses) & np.isfinite(correction.pulse_errors)
                  & (correction.standard_errors > 0.0))
        place = place[chosen]
        if not correction.accepted or not place.size:
            return
        late = taken[place] + correction.pulse_errors[chosen] / pace[place]
        errors = correction.standard_errors[chosen] / pace[place]
        self._update(marks[place], late, errors**-2)

    def _update(self, marks: IntArray, late: FloatArray, weights: FloatArray) -> None:
        there = np.bincount(marks, minlength=self._count) >= _FEWEST
        if np.count_nonzero(there) < 2:
            return
        weight = np.bincount(marks, weights, self._count) * there
        mean = np.bincount(marks, late * weights, self._count) / np.where(there, weight, np.inf)
        mean -= there * mean[there].mean()
        kept = 1.0 - 1.0 / _MEMORY
        self._sum = kept * self._sum + weight * mean
        self._weight = kept * self._weight + weight
        seen = self._weight > 0.0
        found, error = self._sum[seen] / self._weight[seen], self._weight[seen]**-0.5
        # The less there is beyond their standard errors, the less is taken.
        size = max(float(np.mean(found**2 - error**2)), 0.0)
        self._shares[seen] = size / (size + error**2)
        self._errors[seen], self._shown = error, None
        self._angles[seen] = self._shares[seen] * found

    def added_to(self, geometry: MarkOffsets, teeth: IntArray) -> MarkOffsets:
        """Return the geometry of the `teeth` (mark,) with what the vibration shows of it."""
        if not self._weight.any():
            return geometry
        if self._shown is None or self._shown[0] is not geometry:
            self._shown = geometry, self._added(geometry, teeth)
        return self._shown[1]

    def _added(self, geometry: MarkOffsets, teeth: IntArray) -> MarkOffsets:
        angles, share = geometry.angles + self._angles[teeth], self._shares[teeth]
        return replace(
            geometry, angles=angles - angles.mean(), by_vibration=bool(share.min() > _DECIDES),
            standard_errors=np.hypot((1.0 - share) * geometry.standard_errors,
                                     share * self._errors[teeth]))
