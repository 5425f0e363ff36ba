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
A mark whose pulses often come beside its place: a loose target, or a reflection.

A judge of single intervals takes many displaced pulses for jitter. Here the motion of several
revolutions and the places of the marks are fitted to most of their pulses (least absolute
deviations). Jitter and a speed that scatters move all pulses; a loose mark moves some by far more
than most, and by these alone the marks differ.
"""

from collections import deque
from itertools import pairwise
from operator import add
from statistics import median

import numpy as np
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.pulses.clock_grid import clock_tick
from sa_jitter_ros.pulses.target import EvenTarget, Target
from sa_jitter_ros.pulses.verdicts import Verdicts

_MARKS = 4  # of more, one that is loose spoils few trigger cycles that the judge does not drop
# Revolutions fitted at once, odd so that most pulses are on one side; how many such fits count.
_TURNS, _FEWEST, _LATEST = 11, 4, 16
_ROUNDS, _LEAST = 20, 1e-4  # of the fit, in intervals
_BESIDE, _USUAL, _QUANTILE = 0.02, 20.0, 0.4  # in intervals, and times what most are off
_LONGER = 0.4  # an interval of 1.6 others lacks a pulse; in two of 1.4 together, one is too many
_LOST = 0.9  # intervals by which a mark is off only if pulses were counted wrongly
_TICKS = 1.5  # by which a clock moves a pulse in such a fit
_SHARE = 0.08  # of the pulses of a mark, beyond those of the others


class LooseMarks:
    """
    Say whether one of the few marks of a target is loose: `update` it with all its pulses.

    From then on the displaced pulses of such a mark are counted in the `verdicts`.

    >>> verdicts = Verdicts()
    >>> pulses = np.arange(300) + 0.001 * np.sin(np.arange(300))
    >>> pulses[1::6] += 0.2
    >>> LooseMarks(EvenTarget(marks=2), verdicts).update(pulses.tolist())
    >>> verdicts.messages[0][:74], verdicts.counts['displaced']
    ('at least 34% of the pulses of mark 2 of 2, counted from the first, lie 20%', 48)
    """

    def __init__(self, target: Target, verdicts: Verdicts) -> None:
        self._verdicts, self._marks, self._size = verdicts, target.marks, _TURNS * target.marks
        self._few = isinstance(target, EvenTarget) and target.marks <= _MARKS
        self._pulses: list[float] = []
        self._off: deque[FloatArray] = deque(maxlen=_LATEST)  # each (revolution, mark)
        self._first = 1 % target.marks  # mark of the second pulse that waits
        self._said = False
        if self._few:
            place = np.arange(self._size)
            along = place / self._size - 0.5
            self._design = np.column_stack((
                along, along**2, place[:, None] % self._marks == np.arange(self._marks)))
            self._fit = self._design @ np.linalg.pinv(self._design)

    def update(self, pulses: list[float]) -> None:
        """Take the next pulses (s)."""
        self._pulses += pulses if self._few else []
        while len(self._pulses) > self._size + 1:
            times = self._pulses[:self._size + 2]  # one on either side is not fitted
            del self._pulses[:self._size]
            intervals = [after - before for before, after in pairwise(times)]
            usual, longest = median(intervals), max(intervals)
            if not min(intervals) > _LEAST * usual > _LEAST**2 * longest:
                continue  # out of order, or across a standstill
            passed = self._size
            if longest >= (2.0 - _LONGER) * usual:
                passed = sum(max(int(each / usual + _LONGER), 1) for each in intervals[1:])
            elif min(map(add, intervals, intervals[1:])) > (1.0 + _LONGER) * usual:
                off = np.abs(self._deviations((np.array(times[1:-1]) - times[1]) / usual))
                if off.max() < _LOST:
                    off -= _TICKS * clock_tick(np.array(intervals), times[-1]) / usual
                    self._off.append(np.roll(off.reshape(_TURNS, -1), self._first, axis=1))
                    self._look()
            self._first = (self._first + passed) % self._marks

    def _deviations(self, place: FloatArray) -> FloatArray:
        """Return how far pulses (n,) at these places are off, in intervals."""
        off = place - self._fit @ place
        for _ in range(_ROUNDS if np.abs(off).max() > _BESIDE else 0):
            weighted = self._design.T / np.maximum(np.abs(off), _LEAST)
            off = place - self._design @ np.linalg.solve(weighted @ self._design, weighted @ place)
        return np.asarray(off)

    def _look(self) -> None:
        """Count the pulses of the mark of which most are beside their place."""
        off = np.array(self._off)
        if off.max() <= _BESIDE:  # as it is below every limit
            return
        usual = np.maximum(np.quantile(off, _QUANTILE), np.quantile(off, _QUANTILE, axis=(1, 2)))
        limit = np.maximum(_BESIDE, _USUAL * usual)
        # A fit to a speed that bends, or to displaced pulses, is bad as a whole and tells nothing.
        tells = limit < off.max()
        if np.count_nonzero(tells) < _FEWEST:
            return
        beside = off > limit[:, None, None]
        shares = beside[tells].mean(axis=(0, 1))
        worst = int(np.argmax(shares))
        share = float(shares[worst] - np.delete(shares, worst).max(initial=0.0))
        if share <= _SHARE:
            return
        loose = beside[:, :, worst]
        self._verdicts.counts['displaced'] += int(np.count_nonzero(
            loose[-1] if self._said else loose))
        if not self._said:
            self._verdicts.say(
                f'at least {share:.0%} of the pulses of mark {worst + 1} of {self._marks}, '
                f'counted from the first, lie {np.mean(off[:, :, worst][loose]):.0%} of an '
                'interval beside its place, so that averages may be wrong: is the target loose, '
                'or does the sensor see a reflection?')
            self._said = True
