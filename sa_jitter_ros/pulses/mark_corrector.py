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

from collections.abc import Callable
from functools import partial

import numpy as np
from sa_jitter_ros.arrays import FloatArray, IntArray
from sa_jitter_ros.pulses.target_geometry import (
    combined, MarkOffsets, matches, measured_geometry, turned, turned_by)
from sa_jitter_ros.pulses.trigger_counter import TriggerCounter, TriggerPulses

_LEARNT, _LONGEST = 100, 3.0  # revolutions and seconds
_TRIED = (8, 32, _LEARNT)  # revolutions after which the pattern is looked for
_RENEWED, _MEMORY = 50, 1000.0  # revolutions
_LONG_GAP = 4  # revolutions that are not measured across


class MarkCorrector:
    """
    Subtracts from pulses how late their marks are: learnt, or `given` (mark,) in rad.

    It takes what `TriggerCounter` takes and gives it to that. A revolution has `count` teeth. If
    they have an `index`, it tells which mark is which where revolutions are too few to show it.
    `geometry` is what is subtracted now, None for nothing, of the `teeth` (mark,) that are there;
    what went wrong it tells `say`.

    >>> late = np.array([0.02, 0.0, -0.02])  # rad, at 10 Hz
    >>> numbers = np.arange(601)
    >>> counter = TriggerCounter(teeth=3, teeth_per_trigger=1)
    >>> corrector = MarkCorrector(counter, count=3, say=print)
    >>> corrector.begin(0.02 / (20 * np.pi), 0)
    >>> times = numbers / 30 + late[numbers % 3] / (20 * np.pi)
    >>> corrector.extend(times[1:].tolist(), [1] * 600)
    >>> found = corrector.take().times
    >>> bool(np.ptp(np.diff(found)) < 1e-9), corrector.geometry.angles.round(6) + 0.0
    (True, array([ 0.02,  0.  , -0.02]))
    """

    def __init__(self, counter: TriggerCounter, *, count: int, given: FloatArray | None = None,
                 index: bool = False, say: Callable[[str], None]) -> None:
        self._counter, self._count, self._index, self._say = counter, count, index, say
        self._learns = given is None
        self._known: MarkOffsets | None = None  # the latest that was not refused
        if given is not None:
            self._known = MarkOffsets(given - given.mean(), np.zeros(given.size))
        self.geometry: MarkOffsets | None = None
        self.teeth: IntArray = np.empty(0, np.int64)
        self.refused = 0
        self._marks = np.zeros(count)  # angle of each tooth that is subtracted, rad
        self._waits = True
        self._shift = 0  # teeth from mark 0 to number 0 of the present runs
        self._calls: list[Callable[[], None]] = []  # of the counter, which wait
        self._known_end = self._running = self._begun = self._dropped = False
        self._new_times: list[float] = []
        self._new_steps: list[int] = []
        self._passed: int | None = None  # teeth from the run before to the first pulse
        self._times, self._numbers = np.empty(0), np.empty(0, np.int64)  # the latest of the run
        self._measure_from_here()

    def begin(self, time: float, tooth: int, *, passed: int | None = None) -> None:
        """Begin a run at a pulse (s) of this tooth, `passed` teeth after the last run's end."""
        self.stop()
        self._passed = passed if self._known_end else None
        number = tooth if self._passed is None else int(self._numbers[-1]) + self._passed
        if self._passed is None:
            self._wait_no_longer()
            # Missing teeth show which tooth is which; even ones have to be found by their angles.
            self._shift, self._waits = 0, True
            self._measure_from_here()
        elif self._passed > _LONG_GAP * self._count and not self._waits:
            self._measure_from_here()
        self._running, self._begun, self._dropped = True, False, False
        self._times, self._numbers = self._times[:0], self._numbers[:0]
        self._take(np.array([time]), np.array([number]))

    def extend(self, times: list[float], steps: list[int]) -> None:
        """Add pulses (s) to the run, each `steps` teeth after the one before."""
        self._new_times += times
        self._new_steps += steps

    def drop(self) -> None:
        """Record that a pulse behind the latest one was dropped."""
        self._measure()
        self._dropped |= not self._begun
        if self._begun:
            self._calls.append(self._counter.drop)

    def stop(self, *, known: bool = True) -> None:
        """End the run; `known`: the last pulse is valid."""
        self._measure()
        if self._running or not known:
            if self._running and not self._begun:
                self._begin(self._times, self._numbers)
            self._calls.append(partial(self._counter.stop, known=known))
            self._known_end, self._running = known, False
            self._pass_on()

    def restart(self) -> None:
        """Mark the next run as one that starts after time ran back."""
        self._calls.append(self._counter.restart)

    def take(self) -> TriggerPulses:
        """Return the new trigger pulses."""
        self._measure()
        return self._counter.take()

    def flush(self) -> TriggerPulses:
        """Return the trigger pulses that waited, because none follows."""
        self._measure()
        self._wait_no_longer()
        return self._counter.take()

    # --- measuring ---

    def _measure_from_here(self) -> None:
        """Measure the angles from the next pulse on."""
        self._seen: list[tuple[FloatArray, IntArray]] = []
        self._deadline = np.inf
        self._wanted = float(_RENEWED)
        if self._waits:
            self._wanted = float(_LEARNT if self._known is None else _TRIED[0])

    def _measure(self) -> None:
        """Measure the new pulses of the run."""
        if self._new_times:
            times, steps = np.array(self._new_times), np.array(self._new_steps, np.int64)
            self._new_times, self._new_steps = [], []
            self._take(times, self._numbers[-1] + np.cumsum(steps))

    def _take(self, times: FloatArray, numbers: IntArray) -> None:
        """Measure the next pulses (n,) of the run, and pass on what need not wait."""
        while times.size:
            if self._waits and not self._seen:
                self._deadline = float(times[0]) + _LONGEST
            first = self._seen[0][1][0] if self._seen else numbers[0]
            due = (numbers - first >= self._wanted * self._count) | (
                self._waits & (times >= self._deadline))
            count = int(np.argmax(due)) + 1 if due.any() else times.size
            self._seen.append((times[:count], numbers[:count]))
            self._add(times[:count], numbers[:count])
            if due.any():
                self._evaluate(last=self._waits and (
                    float(times[count - 1]) >= self._deadline or self._wanted >= _LEARNT))
                self._pass_on()
            times, numbers = times[count:], numbers[count:]

    def _wait_no_longer(self) -> None:
        """Pass on what waits with the angles that the pulses so far show."""
        if self._waits and self._seen:
            self._evaluate(last=True)
            self._pass_on()

    def _evaluate(self, *, last: bool) -> None:
        """Find the angles that the pulses show; `last`: they cannot wait for more."""
        times, numbers = (np.concatenate(each) for each in zip(*self._seen))
        teeth = np.unique(numbers % self._count)
        found = measured_geometry(times, numbers, teeth, self._count)
        reason = f'{(numbers[-1] - numbers[0]) / self._count:.3g} revolutions are too few'
        if self._waits and self._known is not None:
            if found is not None:
                turn, reason = turned_by(self._known, found,
                                         np.arange(1 if self._index else teeth.size))
            elif last and self._index and teeth.size == self._known.angles.size:
                turn, reason = 0, ''
            if not reason:
                self._shift = turn
                self._use(self._known, teeth)
            elif last:
                self._refuse(reason, found, teeth, float(times[0]))
            else:
                self._wanted = float(min(item for item in _TRIED if item > self._wanted))
                return
        elif self._waits or self.geometry is None:
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
        self._say(f'target_geometry: {reason}, from {time:.6f} s on: '
                  + ('the angles of the marks are learnt anew' if found is not None else
                     'no angles are subtracted; check_keyphasor measures them'))
        self._use(found, teeth)

    # --- passing on ---

    def _add(self, times: FloatArray, numbers: IntArray) -> None:
        """Add pulses (n,) of the run to what the counter is to take; the first one waits."""
        known = self._times.size
        times, numbers = np.append(self._times, times), np.append(self._numbers, numbers)
        if known:
            if not self._begun:
                self._begin(times, numbers)
            self._calls.append(lambda: self._counter.extend(
                self._corrected(times, numbers)[known:].tolist(),
                np.diff(numbers[known - 1:]).tolist()))
            self._pass_on()
        self._times, self._numbers = times[-self._count:], numbers[-self._count:]

    def _begin(self, times: FloatArray, numbers: IntArray) -> None:
        """Begin the run in the counter with the first of its pulses (n,)."""
        passed = self._passed
        self._calls.append(lambda: self._counter.begin(
            float(self._corrected(times, numbers)[0]),
            int(numbers[0] + self._shift) % self._count, passed=passed))
        self._calls += [self._counter.drop] * self._dropped
        self._begun = True

    def _pass_on(self) -> None:
        """Tell the counter all that need not wait."""
        if not self._waits:
            calls, self._calls = self._calls, []
            for call in calls:
                call()

    def _corrected(self, times: FloatArray, numbers: IntArray) -> FloatArray:
        """Return the times of pulses (n,) of a run without the angles of their marks."""
        late = self._marks[(numbers + self._shift) % self._count]
        if times.size == 1 or not late.any():
            return times
        # The speed is that of the revolution before, as far as it is there.
        place = np.arange(times.size)
        before = np.maximum(place - np.count_nonzero(self._marks), 0)
        before[0] = 1
        angle = 2.0 * np.pi / self._count * (numbers - numbers[0]) + late
        pace = (times - times[before]) / (angle - angle[before])
        return np.asarray(times - late * pace)


#: What takes accepted pulses.
PulseSink = TriggerCounter | MarkCorrector
