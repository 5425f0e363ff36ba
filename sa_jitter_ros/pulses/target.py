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

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from sa_jitter_ros.arrays import FloatArray, IntArray
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.pulses.interval_model import WIDTH
from sa_jitter_ros.pulses.mark_pattern import MarkPattern
from sa_jitter_ros.pulses.pulse_chain import (
    Chain, find_chain, scatter_of, STRAY_OF_MARKS, STRAY_OF_ONE, unsteadiness)
from scipy.ndimage import median_filter

# Pulses from which the interval is learnt: those of this time (s), in these limits.
_LEARNING_TIME, _FEWEST, _MOST = 1.0, 4, 12
# How often the pulses double after which noise is tried again, 2 of them at first; the most that
# are waited for after locks that were lost soon.
_DOUBLED, _MORE = 5, 6
_LATEST = 16  # pulses of a chain
# A pulse after less than this fraction of the expected interval is a second one of the same tooth.
_DOUBLE = 0.5
# Sensors shift the pulses of teeth next to a gap by up to 2 degrees, a fifth of the pitch of 36
# teeth.
# The gap must still be distinguished from one that is a tooth wider or narrower.
_BESIDE_GAP = 0.45
_ACROSS_GAP = 0.9  # teeth


@dataclass(frozen=True)
class Lock:
    """
    How the latest pulses fit a target, from pulse number `first` on.

    That pulse is number `slot` of the teeth present (`tooth`: counted with the missing ones).

    For every tooth present (m,), counted from the index: `steps` to the next one in teeth, and
    `widths`, the steps with what is known of uneven marks. Deviations of the interval behind it
    within `believed` are expected as long as the widths are not known. `interval` (s) is the first
    time from tooth to tooth; `known` intervals had the `scatter`;
    `intervals` (k,) in s are those from tooth to tooth. If `unsteady`, the speed scatters; if
    `even`, no tooth is known from the others: there is no index.
    """

    first: int
    slot: int
    interval: float
    steps: IntArray
    widths: FloatArray
    believed: FloatArray
    scatter: float
    known: int
    intervals: FloatArray
    unsteady: bool = False
    even: bool = True

    @property
    def tooth(self) -> int:
        """Return the number of the tooth of the first pulse."""
        return int(self.steps[:self.slot].sum())

    @cached_property
    def lists(self) -> tuple[list[int], list[float], list[float]]:
        """Return steps, widths and believed deviations as lists, whose items take less time."""
        return self.steps.tolist(), self.widths.tolist(), self.believed.tolist()

    def with_pattern(self, pattern: MarkPattern | None, *, weight: float = 1.0) -> 'Lock':
        """Return the lock with what was learnt of its marks."""
        if pattern is None:
            return self
        widths = self.widths * np.exp(weight * pattern.widths)
        widths *= self.steps.sum() / widths.sum()
        believed = np.zeros(widths.size) if self.even else _of_narrow(widths, pattern.scatter)
        return replace(self, widths=widths, scatter=pattern.scatter,
                       believed=np.where(pattern.known, believed, self.believed))


def _of_narrow(widths: FloatArray, scatter: float) -> FloatArray:
    """Return deviations (m,) that a scatter of whole intervals explains in narrower ones."""
    return np.where(widths < 1.0, WIDTH * scatter / widths, 0.0)


def index_of(steps: IntArray) -> int:
    """
    Return which tooth is the index of a wheel with these `steps` (m,) from tooth to tooth.

    It is the one behind the widest gap; of several, the one behind the widest teeth before it.
    """
    return max(range(steps.size), key=lambda k: tuple(np.roll(steps, -k)[::-1]))


class EvenTarget:
    """So many `marks` at equal or nearly equal angles: several intervals in a row are a lock."""

    memory = 64

    def __init__(self, *, marks: int) -> None:
        self.marks = marks
        self._stray = STRAY_OF_ONE if marks == 1 else STRAY_OF_MARKS

    def next_size(self, pulses: FloatArray, tried: int, failed: int, *, known: bool
                  ) -> int:
        """
        Return how many of the waiting pulses to match next, after the first `tried` ones.

        It `failed` so often before, or found a lock that was lost soon.
        """
        if pulses.size < _FEWEST:
            return _FEWEST
        interval = float(np.median(np.diff(pulses[:_FEWEST])))
        first = _FEWEST if known else int(np.clip(_LEARNING_TIME / interval, _FEWEST, _MOST))
        more = 2 << min(failed // 2, _DOUBLED)
        return first + min(more - 2, _MORE) if tried < first else tried + more

    def lock(self, pulses: FloatArray, scatter: float | None) -> Lock | None:
        """Match the latest pulses (n,) in s; `scatter` is that of earlier intervals."""
        start = max(pulses.size - _LATEST, 0)
        found = find_chain(pulses[start:], scatter, stray=self._stray)
        if found is None:
            return self.unsteady(pulses)
        return self._locked(pulses[start:], found, start)

    def unsteady(self, pulses: FloatArray) -> Lock | None:
        """Match pulses (n,) in s that follow each other at a speed that scatters, None if not."""
        if not unsteadiness(np.log(np.diff(pulses))):
            return None
        found = find_chain(pulses, None, stray=self._stray)
        return self._locked(pulses, found, 0) if found is not None and found.unsteady else None

    def _locked(self, pulses: FloatArray, found: Chain, start: int) -> Lock:
        """Return the lock on pulses (n,), the latest, of which `start` came before."""
        gaps = np.diff(pulses[found.pulses])
        levels = np.log(gaps / found.steps)
        ones = np.ones(self.marks, dtype=np.int64)
        return Lock(first=start + int(found.pulses[0]), slot=0, interval=float(np.exp(levels[0])),
                    steps=ones, widths=ones.astype(np.float64), believed=np.zeros(self.marks),
                    scatter=scatter_of(found.levels), known=levels.size,
                    intervals=gaps[found.steps == 1], unsteady=found.unsteady)


class ToothedWheel:
    """
    A wheel with `teeth` tooth positions, of which `missing` have no tooth.

    The positions of the gaps are learnt from one revolution. With several gaps the index is unique
    if the widest gap, or the teeth in front of it, are unique. Otherwise the index may be another
    one after every loss of the match. `widths` (tooth,), in teeth of an even wheel, are the known
    angles from each tooth to the next one if the teeth stand unevenly; then none is missing.

    The pulses of a wheel 8-1 at one tooth per second; the one after the fifth pulse is missing:

    >>> wheel = ToothedWheel(teeth=8, missing=1, tolerance=0.25)
    >>> lock = wheel.lock(np.array([0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 7.0, 8.0]), None)
    >>> lock.slot, lock.tooth, lock.steps.tolist()
    (2, 2, [1, 1, 1, 1, 1, 1, 2])

    Four teeth, the first of which stands near the second:

    >>> wheel = ToothedWheel(teeth=4, tolerance=0.25, widths=np.array([0.3, 1.1, 1.3, 1.3]))
    >>> wheel.lock(np.array([0.0, 1.3, 2.6, 2.9, 4.0]), None).slot
    2
    """

    def __init__(self, *, teeth: int, tolerance: float, missing: int = 0,
                 widths: FloatArray | None = None) -> None:
        self._teeth, self.marks = teeth, teeth - missing
        if self.marks < 2:
            raise ParameterError(
                f'missing_teeth {missing} of {teeth} leaves {self.marks} teeth: a wheel needs '
                '2 or more; for a single tooth set pulses_per_revolution to 1')
        self._tolerance, self._widths = tolerance, widths
        self._least = _DOUBLE if widths is None else _DOUBLE * float(
            widths.min() / np.median(widths))
        self.memory = 2 * (self.marks + 1)

    def next_size(self, pulses: FloatArray, tried: int, failed: int, *, known: bool
                  ) -> int:
        """
        Return how many of the waiting pulses to match next, after the first `tried` ones.

        It `failed` so often before, or found a lock that was lost soon.
        """
        return max(self.marks + 1, tried + 1)

    def lock(self, every: FloatArray, scatter: float | None) -> Lock | None:
        """Match the latest pulses (n,) in s, None if they do not fit: a revolution is needed."""
        if every.size <= self.marks:
            return None
        intervals = np.diff(every)
        single = np.append(0, 1 + np.flatnonzero(intervals >= self._least * np.median(intervals)))
        if single.size <= self.marks:
            return None
        single = single[-self.marks - 1:]
        intervals = np.diff(every[single])
        # At a steady speed the tooth interval follows from the revolution, at a changing one from
        # the intervals around it, of which few may be gaps.
        guesses = [np.full(intervals.size, intervals.sum() / self._teeth)]
        if self.marks >= 8 and self._widths is None:
            guesses.append(median_filter(intervals, size=5, mode='mirror'))
        for guess in guesses:
            found = self._matched(intervals / guess)
            if found is not None:
                slot, steps, widths, tolerance = found
                lengths = intervals / np.roll(widths, -slot)
                levels = np.log(lengths)
                scatter = scatter_of(levels)
                return Lock(first=int(single[0]), slot=slot, interval=float(guess[0]),
                            steps=steps, widths=widths, even=False, scatter=scatter,
                            believed=np.where(tolerance > self._tolerance, tolerance,
                                              _of_narrow(widths, scatter)), known=levels.size,
                            intervals=lengths[np.roll(steps, -slot) == 1])
        return None

    def _matched(self, teeth: FloatArray) -> tuple[int, IntArray, FloatArray, FloatArray] | None:
        """
        Return the tooth of the first of the intervals (m,), which are given in teeth.

        And, from the index on, their steps, widths and tolerances; None if they do not fit.
        """
        if self._widths is None:
            steps = np.maximum(np.rint(teeth), 1.0).astype(np.int64)
            if steps.sum() != self._teeth:
                return None
            slot = -index_of(steps) % steps.size
            steps = np.roll(steps, slot)
            widths, tolerance = steps.astype(np.float64), self._tolerances(steps)
        else:
            turned = [np.roll(self._widths, -slot) for slot in range(teeth.size)]
            slot = int(np.argmin(np.max(np.abs(teeth / turned - 1.0), axis=1)))
            steps, widths = np.ones(teeth.size, np.int64), self._widths
            tolerance = np.full(teeth.size, self._tolerance)
        error = np.abs(np.roll(teeth, slot) / widths - 1.0)
        return (slot, steps, widths, tolerance) if np.all(error <= tolerance) else None

    def _tolerances(self, steps: IntArray) -> FloatArray:
        gap = steps > 1
        next_to_gap = np.roll(gap, 1) | np.roll(gap, -1)
        tolerance = np.where(next_to_gap, max(self._tolerance, _BESIDE_GAP), self._tolerance)
        return np.where(gap, np.minimum(_BESIDE_GAP, _ACROSS_GAP / steps), tolerance)


Target = EvenTarget | ToothedWheel
