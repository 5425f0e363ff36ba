# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""From accepted pulses to trigger pulses, by counting teeth."""

from dataclasses import dataclass

import numpy as np
from sa_jitter_ros.arrays import BoolArray, FloatArray, IntArray


@dataclass(frozen=True)
class TriggerPulses:
    """
    Trigger pulses (n,), each the end of a valid trigger cycle unless it starts a run.

    `times` in s. `starts_run`: no valid cycle ends at this pulse. `restarted`: time also ran back.
    `count` is the number of trigger cycles since the first pulse. It includes cycles with missing
    pulses, also where these break a run, and restarts at 0 where the number of cycles is unknown.
    `measured` is False for a missing pulse that was interpolated between its neighbours.
    `doubtful`: a pulse was dropped in the trigger cycle that ends here. `mark` is the tooth of
    the pulse where the geometry of the target is known, else -1. Teeth that were numbered anew
    have numbers that are larger by those of a revolution.
    """

    times: FloatArray
    starts_run: BoolArray
    restarted: BoolArray
    count: IntArray
    measured: BoolArray
    doubtful: BoolArray
    mark: IntArray

    @classmethod
    def joined(cls, parts: 'list[TriggerPulses]') -> 'TriggerPulses':
        """Return the pulses of all parts, in their order."""
        if len(parts) == 1:
            return parts[0]
        if not parts:
            none, no_numbers = np.empty(0, np.bool_), np.empty(0, np.int64)
            return cls(np.empty(0), none, none, no_numbers, none, none, no_numbers)
        return cls(*(np.concatenate([getattr(part, name) for part in parts])
                     for name in cls.__dataclass_fields__))


class TriggerCounter:
    """
    Count the teeth in runs of pulses and return the time of every `teeth_per_trigger`-th.

    Trigger pulses are on the same teeth as long as the number of teeth since the first pulse is
    known. The first trigger pulse of a run is returned together with the second one, when a whole
    trigger cycle is known. A run without a whole cycle counts as one discarded cycle.
    """

    def __init__(self, *, teeth: int, teeth_per_trigger: int) -> None:
        self._teeth, self._per_trigger = teeth, teeth_per_trigger
        self._times: list[float] = []  # of the last pulse and those since the last count
        self._steps: list[int] = []
        self._dropped: list[int] = []  # in `_times`, the pulses behind which one was dropped
        self._target = 0  # number of the tooth of the next trigger pulse
        self._last: int | None = None  # number of the last run's last tooth
        self._starting = False
        self._doubtful = False
        self._waiting: list[TriggerPulses] = []  # the first trigger pulse of a run
        self._found: list[TriggerPulses] = []
        self._restarted = False
        self._numbering: int | None = None  # of the teeth
        self.discarded = 0

    def begin(self, time: float, tooth: int, *, passed: int | None = None) -> None:
        """Begin a run at a pulse (s) of this tooth, `passed` teeth after the last run's end."""
        self.stop()
        if passed is None or self._last is None:
            number = tooth - self._teeth if tooth else 0  # trigger cycles begin at tooth 0
        else:
            number = self._last + passed
        target = max(-(-number // self._per_trigger) * self._per_trigger, 0)
        if passed is not None and self._last is not None:  # beside the cycle that did not end
            self.discarded += max(target - self._target, 0) // self._per_trigger
        self._times, self._steps, self._target = [time], [number], target
        self._starting = True

    def extend(self, times: list[float], steps: list[int]) -> None:
        """Add pulses (s) to the run, each `steps` teeth after the one before."""
        self._times += times
        self._steps += steps

    def drop(self) -> None:
        """Record that a pulse behind the latest one was dropped."""
        if self._times:
            self._dropped.append(len(self._times) - 1)

    def stop(self, *, known: bool = True) -> None:
        """End the run, discard its unfinished trigger cycle; `known`: the last pulse is valid."""
        if self._times:
            self._count()
            self._last = self._steps[0]
            self.discarded += not self._starting or bool(self._waiting)
        if not known:
            self._last = None
        self._times, self._steps, self._dropped, self._waiting = [], [], [], []
        self._doubtful = False

    def restart(self) -> None:
        """Mark the next run as one that starts after time ran back."""
        self._restarted = True

    def know_marks(self, numbering: int | None) -> None:
        """Take the number of the numbering of teeth from the next pulse on, None if not known."""
        if numbering != self._numbering and self._times:
            self._count()
        self._numbering = numbering

    def take(self) -> TriggerPulses:
        """Return the new trigger pulses."""
        if self._times:
            self._count()
        found, self._found = self._found, []
        return TriggerPulses.joined(found)

    flush = take  # none waits here

    def _count(self) -> None:
        numbers = np.array(self._steps).cumsum()
        targets = np.arange(self._target, numbers[-1] + 1, self._per_trigger)
        if targets.size:
            found = self._trigger_pulses(targets, numbers)
        else:
            self._doubtful |= bool(self._dropped)
        self._dropped = []
        self._target += targets.size * self._per_trigger
        self._times, self._steps = self._times[-1:], [int(numbers[-1])]
        if not targets.size:
            return
        if self._starting:
            found = TriggerPulses.joined([*self._waiting, found])
            self._waiting = []
            if found.times.size < 2:
                self._waiting = [found]
                return
            found.starts_run[0], found.restarted[0] = True, self._restarted
            self._starting = self._restarted = False
        self._found.append(found)

    def _trigger_pulses(self, targets: IntArray, numbers: IntArray) -> TriggerPulses:
        starts, restarts, doubtful = np.zeros((3, targets.size + 1), np.bool_)
        if self._dropped:
            doubtful[np.searchsorted(targets, numbers[self._dropped], side='right')] = True
        doubtful[0] |= self._doubtful
        self._doubtful = bool(doubtful[-1])
        if self._numbering is None:
            marks = np.full(targets.size, -1)
        else:
            marks = targets % self._teeth + self._numbering * self._teeth
        at = numbers.searchsorted(targets)
        times, measured = np.array(self._times)[at], numbers[at] == targets
        if np.count_nonzero(measured) < measured.size:
            # Missing teeth are interpolated between their neighbours.
            times = np.interp(targets, numbers, self._times)
        return TriggerPulses(times, starts[:-1], restarts[:-1], targets // self._per_trigger,
                             measured, doubtful[:-1], marks)
