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
Targets: the positions of the teeth on a keyphasor's wheel, and the match of pulses to teeth.

An even target has equal angles between its pulses. A toothed wheel may lack some teeth (60-2,
36-1, 36-2-1); its index is the tooth after the widest gap. Once the latest pulses fit a target, it
tells which tooth caused each of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt
from sa_jitter_ros.errors import ParameterError
from scipy.ndimage import median_filter

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

# A pulse after less than this fraction of the expected interval is a second one of the same tooth.
DOUBLE = 0.5
# Sensors shift the pulses of teeth next to a gap by up to 2 degrees, a fifth of the pitch of 36
# teeth.
# The gap must still be distinguished from one that is a tooth wider or narrower.
_BESIDE_GAP = 0.45
_ACROSS_GAP = 0.9  # teeth


@dataclass(frozen=True)
class Lock:
    """
    How the latest pulses fit a target, from pulse number `first` on, which is tooth `slot`.

    For every tooth present (m,), counted from the index: `steps` to the next one in teeth, `teeth`
    its number, and the `tolerance` of the interval behind it, a fraction of that interval.
    `interval` (s) is the expected time from tooth to tooth.
    """

    first: int
    slot: int
    interval: float
    steps: IntArray
    teeth: IntArray
    tolerance: FloatArray

    @property
    def even(self) -> bool:
        """Whether all teeth are equal, so that the index cannot be lost."""
        return self.steps.size == 1


class Target(Protocol):
    """What the pulse validator needs to know of a target."""

    memory: int

    def lock(self, pulses: Sequence[float]) -> Lock | None:
        """Match the latest pulses (s), None if they do not fit (yet)."""


class EvenTarget:
    """Equal angles: two consecutive intervals that agree, without double pulses, are a lock."""

    memory = 8

    def __init__(self, *, tolerance: float) -> None:
        self._tolerance = tolerance

    def lock(self, pulses: Sequence[float]) -> Lock | None:
        """Match the latest pulses (s), None if they do not fit (yet)."""
        if len(pulses) < 3:
            return None
        # If the pulses fit, the latest one is no double; the one before it may be one.
        for before in pulses[-2], pulses[-3]:
            if self._agrees(pulses, pulses[-1] - before):
                one = np.ones(1, dtype=np.int64)
                return Lock(first=0, slot=0, interval=pulses[-1] - before, steps=one,
                            teeth=one - 1, tolerance=np.full(1, self._tolerance))
        return None

    def _agrees(self, pulses: Sequence[float], interval: float) -> bool:
        agreeing, last = 0, pulses[0]
        for pulse in pulses[1:]:
            if pulse - last >= DOUBLE * interval:
                near = abs(pulse - last - interval) <= self._tolerance * interval
                agreeing = agreeing + 1 if near else 0
                last = pulse
        return agreeing >= 2


class ToothedWheel:
    """
    A wheel with `teeth` tooth positions, of which `missing` have no tooth.

    The positions of the gaps are learnt from one revolution. With several gaps the index is unique
    if the widest gap, or the teeth in front of it, are unique. Otherwise the index may be another
    one after every loss of the match.

    The pulses of a wheel 8-1 at one tooth per second; the one after the fifth pulse is missing:

    >>> wheel = ToothedWheel(teeth=8, missing=1, tolerance=0.25)
    >>> lock = wheel.lock([0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 7.0, 8.0])
    >>> lock.slot, lock.steps.tolist(), lock.teeth.tolist()
    (2, [1, 1, 1, 1, 1, 1, 2], [0, 1, 2, 3, 4, 5, 6])
    """

    def __init__(self, *, teeth: int, missing: int, tolerance: float) -> None:
        self._teeth, self._present = teeth, teeth - missing
        if self._present < 2:
            raise ParameterError(
                f'missing_teeth {missing} of {teeth} leaves {self._present} teeth: a wheel needs '
                '2 or more; for a single tooth set pulses_per_revolution to 1')
        self._tolerance = tolerance
        self.memory = 2 * (self._present + 1)

    def lock(self, pulses: Sequence[float]) -> Lock | None:
        """Match the latest pulses (s), None if they do not fit (yet): one revolution is needed."""
        if len(pulses) <= self._present:
            return None
        every = np.asarray(pulses)
        intervals = np.diff(every)
        single = np.append(0, 1 + np.flatnonzero(intervals >= DOUBLE * np.median(intervals)))
        if single.size <= self._present:
            return None
        single = single[-self._present - 1:]
        intervals = np.diff(every[single])
        # At a steady speed the tooth interval follows from the revolution, at a changing one from
        # the intervals around it, of which few may be gaps.
        guesses = [np.full(intervals.size, intervals.sum() / self._teeth)]
        if self._present >= 8:
            guesses.append(median_filter(intervals, size=5, mode='mirror'))
        for guess in guesses:
            steps = np.maximum(np.rint(intervals / guess), 1.0).astype(np.int64)
            if steps.sum() == self._teeth:
                index = max(range(steps.size), key=lambda k: tuple(np.roll(steps, -k)[::-1]))
                steps = np.roll(steps, -index)
                tolerance = self._tolerances(steps)
                error = np.abs(np.roll(intervals / guess, -index) / steps - 1.0)
                if np.all(error <= tolerance):
                    return Lock(first=int(single[0]), slot=-index % steps.size,
                                interval=float(guess[0]), steps=steps,
                                teeth=np.cumsum(steps) - steps, tolerance=tolerance)
        return None

    def _tolerances(self, steps: IntArray) -> FloatArray:
        gap = steps > 1
        next_to_gap = np.roll(gap, 1) | np.roll(gap, -1)
        tolerance = np.where(next_to_gap, max(self._tolerance, _BESIDE_GAP), self._tolerance)
        return np.where(gap, np.minimum(_BESIDE_GAP, _ACROSS_GAP / steps), tolerance)
