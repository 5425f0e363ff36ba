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
Takes the geometry of a target from accepted pulses, on their way to a trigger counter.

Pulses wait until the angles of the marks are known: learnt from `_LEARNT` revolutions, or found
again behind an interruption by their pattern, but `_LONGEST` s at most. Then the angles are
subtracted, and renewed after every `_RENEWED` revolutions. Where the pattern does not show which
mark is which, what was known before is not used, and `refused` counts it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.pulses.target_geometry import (
    combined, MarkOffsets, matches, measured_geometry, turned, turned_by)
from sa_jitter_ros.pulses.trigger_counter import TriggerCounter, TriggerPulses

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_LEARNT, _LONGEST = 100, 3.0  # revolutions and seconds
_TRIED = (8, 32, _LEARNT)  # revolutions after which the pattern is looked for
_RENEWED, _MEMORY = 50, 1000.0  # revolutions
_LONG_GAP = 4  # revolutions that are not measured across
_TRIMMED = 4096  # pulses
_MESSAGES = 10


@dataclass
class _Run:
    """
    Pulses (n,) in a row, of which `seen` were measured and `sent` went on to the counter.

    `numbers` (n,) of teeth count on from run to run, and begin anew where `passed` is None.
    """

    times: list[float]
    numbers: list[int]
    passed: int | None
    restarted: bool
    dropped: list[int] = field(default_factory=list)  # pulses behind which one was dropped
    seen: int = 0
    sent: int = 0
    begun: bool = False  # in the counter, and closed there
    closed: bool = False
    ended: bool | None = None  # if so, whether its last pulse is known

    def trim(self, kept: int) -> None:
        """Forget pulses that were sent, but for the latest ones."""
        count = self.sent - kept
        if count > _TRIMMED:
            del self.times[:count], self.numbers[:count]
            self.seen, self.sent = self.seen - count, self.sent - count
            self.dropped = [number - count for number in self.dropped]


class MarkCorrector:
    """
    Subtracts from pulses how late their marks are: learnt, or `given` (mark,) in rad.

    It takes what `TriggerCounter` takes and gives it to that. A revolution has `count` teeth.
    `geometry` is what is subtracted now, None for nothing, of the `teeth` (mark,) that are there;
    `messages` say what went wrong.

    >>> late = np.array([0.02, 0.0, -0.02])  # rad, at 10 Hz
    >>> numbers = np.arange(601)
    >>> counter = TriggerCounter(teeth=3, teeth_per_trigger=1)
    >>> corrector = MarkCorrector(counter, count=3)
    >>> corrector.begin(0.02 / (20 * np.pi), 0)
    >>> times = numbers / 30 + late[numbers % 3] / (20 * np.pi)
    >>> corrector.extend(times[1:].tolist(), [1] * 600)
    >>> found = corrector.take().times
    >>> bool(np.ptp(np.diff(found)) < 1e-9), corrector.geometry.angles.round(6) + 0.0
    (True, array([ 0.02,  0.  , -0.02]))
    """

    def __init__(self, counter: TriggerCounter, *, count: int,
                 given: Sequence[float] | None = None) -> None:
        self._counter, self._count = counter, count
        self._learns = given is None
        self._known: MarkOffsets | None = None  # the latest that was not refused
        if given is not None:
            angles = np.array(given, np.float64)
            self._known = MarkOffsets(angles - angles.mean(), np.zeros(angles.size))
        self.geometry: MarkOffsets | None = None
        self.teeth: IntArray = np.empty(0, np.int64)
        self.refused = 0
        self.messages: list[str] = []
        self._marks = np.zeros(count)  # angle of each tooth that is subtracted, rad
        self._runs: list[_Run] = []
        self._restarted = False
        self._waits = True
        self._shift = 0  # teeth from mark 0 to number 0 of the present runs
        self._measure_from_here()

    def begin(self, time: float, tooth: int, *, passed: int | None = None) -> None:
        """Begin a run at a pulse (s) of this tooth, `passed` teeth after the last run's end."""
        self.stop()
        number = tooth
        if passed is not None and self._runs and self._runs[-1].ended:
            number = self._runs[-1].numbers[-1] + passed
        else:
            passed = None
        self._runs.append(_Run([time], [number], passed, self._restarted))
        self._restarted = False

    def extend(self, times: list[float], steps: list[int]) -> None:
        """Add pulses (s) to the run, each `steps` teeth after the one before."""
        run = self._runs[-1]
        run.numbers += np.cumsum([run.numbers[-1], *steps])[1:].tolist()
        run.times += times

    def drop(self) -> None:
        """Record that a pulse behind the latest one was dropped."""
        if self._runs and self._runs[-1].ended is None:
            self._runs[-1].dropped.append(len(self._runs[-1].times) - 1)

    def stop(self, *, known: bool = True) -> None:
        """End the run; `known`: the last pulse is valid."""
        if self._runs and (self._runs[-1].ended is None or not known):
            self._runs[-1].ended = known

    def restart(self) -> None:
        """Mark the next run as one that starts after time ran back."""
        self._restarted = True

    def take(self) -> TriggerPulses:
        """Return the new trigger pulses."""
        for number in range(len(self._runs)):
            self._measure(self._runs[:number + 1])
        kept = [run for run in self._runs[:-1] if not run.closed]
        self._runs = kept + self._runs[-1:]
        for run in self._runs:
            run.trim(self._count)
        return self._counter.take()

    def flush(self) -> TriggerPulses:
        """Return the trigger pulses that waited, because none follows."""
        found = [self.take()]
        if self._waits and self._times:
            self._evaluate(last=True)
            self._send(self._runs)
        return TriggerPulses.joined([*found, self._counter.take()])

    # --- measuring ---

    def _measure_from_here(self) -> None:
        """Measure the angles from the next pulse on."""
        self._times: list[FloatArray] = []
        self._numbers: list[IntArray] = []
        self._revolutions = 0.0
        self._deadline = np.inf
        self._wanted = float(_RENEWED)
        if self._waits:
            self._wanted = float(_LEARNT if self._known is None else _TRIED[0])

    def _measure(self, runs: list[_Run]) -> None:
        """Measure the new pulses of the last of these runs, and send what need not wait."""
        run = runs[-1]
        if not run.seen:
            self._start(runs)
        while run.seen < len(run.times):
            times = np.array(run.times[run.seen:])
            numbers = np.array(run.numbers[run.seen:], np.int64)
            if self._waits and not self._times:
                self._deadline = float(times[0]) + _LONGEST
            first = self._numbers[0][0] if self._numbers else numbers[0]
            due = (numbers - first >= self._wanted * self._count) | (
                self._waits & (times >= self._deadline))
            evaluates = bool(due.any())
            count = int(np.argmax(due)) + 1 if evaluates else times.size
            self._times.append(times[:count])
            self._numbers.append(numbers[:count])
            run.seen += count
            if not self._waits:
                self._send(runs)
            if evaluates:
                late = self._waits and (float(times[count - 1]) >= self._deadline
                                        or self._wanted >= _LEARNT)
                self._evaluate(last=late)
        if not self._waits:
            self._send(runs)

    def _start(self, runs: list[_Run]) -> None:
        """Begin to measure the last of these runs, of which the others came before."""
        run = runs[-1]
        if run.passed is None:
            if self._waits and self._times:
                self._evaluate(last=True)
                self._send(runs[:-1])
            # Missing teeth show which tooth is which; even ones have to be found by their angles.
            self._shift, self._waits = 0, True
            self._measure_from_here()
        elif run.passed > _LONG_GAP * self._count and not self._waits:
            self._measure_from_here()

    def _evaluate(self, *, last: bool) -> None:
        """Find the angles that the pulses show; `last`: they cannot wait for more."""
        numbers, times = np.concatenate(self._numbers), np.concatenate(self._times)
        teeth = np.unique(numbers % self._count)
        even = teeth.size == self._count
        found = measured_geometry(times, numbers, teeth, self._count)
        reason = f'{(numbers[-1] - numbers[0]) / self._count:.3g} revolutions are too few'
        if self._waits and self._known is not None:
            if found is not None:
                turn, reason = turned_by(self._known, found,
                                         np.arange(teeth.size) if even else np.zeros(1, int))
            if not reason:
                self._shift = turn
                self._use(self._known, teeth)
            elif last:
                self._refuse(reason, found, teeth, float(times[0]))
            else:
                self._wanted = float(min(item for item in _TRIED if item > self._wanted))
                return
        elif self._waits or self.geometry is None:
            if found is None and not self._waits:
                self._wanted *= 2.0
                return
            if self._learns:
                self._use(found, teeth)
        elif found is not None:
            found = turned(found, -self._shift)
            if not matches(self.geometry, found):
                self._refuse('the marks are no longer where they were', found, teeth,
                             float(times[0]))
            elif self._learns:
                self._use(combined(self.geometry, found, _MEMORY), teeth)
        self._waits = False
        self._measure_from_here()
        if self.geometry is None:
            self._wanted = float(_TRIED[0])

    def _use(self, geometry: MarkOffsets | None, teeth: IntArray) -> None:
        """Subtract these angles of the teeth (mark,) from the next pulses on."""
        self.geometry = geometry
        self._counter.know_marks(None if geometry is None else self.refused)
        self._marks = np.zeros(self._count)
        if geometry is not None:
            self._known, self.teeth = geometry, teeth
            self._marks[teeth] = geometry.angles

    def _refuse(self, reason: str, found: MarkOffsets | None, teeth: IntArray, time: float
                ) -> None:
        """Subtract what was known before no longer, but what was `found`, if anything."""
        self.refused += 1
        found = found if self._learns else None
        self.messages.append(
            f'target_geometry: {reason}, from {time:.6f} s on: '
            + ('the angles of the marks are learnt anew' if found is not None else
               'no angles are subtracted'))
        del self.messages[:-_MESSAGES]
        self._use(found, teeth)

    # --- sending ---

    def _send(self, runs: list[_Run]) -> None:
        """Pass on what was measured of these runs."""
        for run in runs:
            if run.sent < run.seen and (run.seen > 1 or run.ended is not None):
                self._send_run(run)
            if run.ended is not None and not run.closed and run.sent == len(run.times):
                self._counter.stop(known=run.ended)
                run.closed = True

    def _send_run(self, run: _Run) -> None:
        times = self._corrected(run).tolist()
        first, steps = run.sent, np.diff(run.numbers[max(run.sent - 1, 0):run.seen]).tolist()
        if not run.begun:
            if run.restarted:
                self._counter.restart()
            tooth = (run.numbers[0] + self._shift) % self._count
            self._counter.begin(times[0], tooth, passed=run.passed)
            run.begun, times, first = True, times[1:], 1
        for last in sorted({*(item + 1 for item in run.dropped if item < run.seen), run.seen}):
            count = last - first
            self._counter.extend(times[:count], steps[:count])
            times, steps, first = times[count:], steps[count:], last
            if last - 1 in run.dropped:
                self._counter.drop()
        run.dropped = [item for item in run.dropped if item >= run.seen]
        run.sent = run.seen

    def _corrected(self, run: _Run) -> FloatArray:
        """Return the times of the pulses of a run that are sent next, without their angles."""
        begin = max(run.sent - self._count, 0)
        times = np.array(run.times[begin:run.seen])
        numbers = np.array(run.numbers[begin:run.seen], np.int64) + self._shift
        late = self._marks[numbers % self._count]
        chosen = np.arange(run.sent - begin, times.size)
        if times.size == 1 or not late.any():
            return times[chosen]
        # The speed is that of the revolution before, as far as it is there.
        before = np.maximum(chosen - np.count_nonzero(self._marks), 0)
        before[chosen == 0] = 1
        angle = 2.0 * np.pi / self._count * (numbers - numbers[0]) + late
        pace = (times[chosen] - times[before]) / (angle[chosen] - angle[before])
        return np.asarray(times[chosen] - late[chosen] * pace)
