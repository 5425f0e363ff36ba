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
Classification of pulses by their interval from the last valid pulse.

A pulse is *regular* if its interval is within the tolerance of the last accepted interval or of
the median of the last three. The last interval follows a changing speed; the median is not changed
by one displaced pulse. The interval in units of the nearer of the two classifies all other pulses:

* double: less than a half. The pulse is dropped, the trigger cycle continues.
* early: less than one. The pulse is dropped, the trigger cycle is discarded.
* missing: within the tolerance of a multiple, up to the maximum of missing pulses. The missing
  pulses are interpolated (bridge), or the trigger cycle is discarded and a new run begins (break).
* late: everything else. The trigger cycle is discarded and a new run begins.

Four consecutive intervals that agree with each other but not with the expected one become the new
expected interval. After eight consecutive irregular pulses the interval is learnt again as at the
start, where pulses wait until they match the target. A wheel with gaps is matched again after
every early or late pulse and every break, because its index is lost.
"""

from collections import deque

import numpy as np
import numpy.typing as npt
from sa_jitter_ros.pulses.target import DOUBLE, Lock, Target
from sa_jitter_ros.pulses.trigger_counter import TriggerCounter

FloatArray = npt.NDArray[np.float64]
_CALM = 4  # regular pulses in a row, after which they are judged in chunks
_AGREEING = 4
_LOST = 8
_STANDSTILL = 1e9  # intervals; the ratio of a gap to denormal ones is infinite


class IntervalJudge:
    """
    Judge pulses in order of time and pass the valid ones on to a trigger counter.

    `last` is the latest pulse (s) not dropped, `confirmed` the latest with a valid interval.
    """

    def __init__(
        self, target: Target, counter: TriggerCounter, *, bridge: bool, tolerance: float,
        maximum_missing: int, minimum_interval: float,
    ) -> None:
        self._target, self._counter = target, counter
        self._bridge = bridge
        self._tolerance = tolerance
        self._maximum_missing = maximum_missing
        self._minimum_interval = minimum_interval
        self.counts = dict.fromkeys(
            ('accepted', 'doubles', 'missing_bridged', 'missing_broken', 'early', 'late',
             'unlocked', 'relearnt'), 0)
        self._pending: list[float] = []  # pulses not yet matched to the target
        self.forget()

    def forget(self) -> None:
        """Forget the interval and the match: the next pulses begin a new sequence."""
        self._counter.stop(known=False)
        self._lock: Lock | None = None
        self.counts['unlocked'] += len(self._pending)
        self._pending = []
        self._recent: deque[float] = deque(maxlen=_AGREEING + 1)  # dropped ones too
        self._intervals: deque[float] = deque(maxlen=3)
        self._slot = 0
        self.last = self.confirmed = -np.inf
        self._calm = self._strikes = 0

    @property
    def calm(self) -> bool:
        """Whether so many pulses were regular that `take_regular` can be used."""
        return self._calm >= _CALM

    @property
    def waiting(self) -> int:
        """Return the number of pulses not yet matched to the target."""
        return len(self._pending)

    def take_regular(self, pulses: FloatArray) -> int:
        """Accept the pulses (n,) up to the first irregular one; return their number."""
        assert self._lock is not None
        slots = (self._slot + np.arange(pulses.size)) % self._lock.steps.size
        steps, tolerance = self._lock.steps[slots], self._lock.tolerance[slots]
        gaps = np.diff(pulses, prepend=self.last)
        intervals = np.concatenate((self._intervals, gaps / steps))
        a, b, c, new = (intervals[k:k + pulses.size] for k in range(4))
        median = np.maximum(np.minimum(a, b), np.minimum(np.maximum(a, b), c))
        regular = (np.abs(new - c) <= tolerance * c) | (np.abs(new - median) <= tolerance * median)
        regular &= gaps >= self._minimum_interval
        count = pulses.size if regular.all() else int(np.argmin(regular))
        if count:
            self._counter.extend(pulses[:count].tolist(), steps[:count].tolist())
            self.counts['accepted'] += count
            self._intervals.extend(intervals[count:count + 3].tolist())
            self._recent.extend(pulses[:count][-_AGREEING - 1:].tolist())
            self._slot = int(slots[count - 1] + 1) % self._lock.steps.size
            self.last = self.confirmed = float(pulses[count - 1])
        if count < pulses.size:
            self._calm = 0
        return count

    def take(self, pulse: float) -> None:
        """Judge a pulse (s) that is not before the last one."""
        if pulse == self.last or pulse - self.last < self._minimum_interval:
            self._drop_double()
        else:
            self._recent.append(pulse)
            self._judge(pulse)

    def fits(self, gap: float) -> bool:
        """Whether a pulse at this interval (s) from the last one would be regular."""
        if self._lock is None:
            return False
        interval = gap / float(self._lock.steps[self._slot])
        tolerance = float(self._lock.tolerance[self._slot])
        return any(abs(interval - each) <= tolerance * each for each in self._expected())

    def drop_unconfirmed(self) -> int:
        """Drop the pulses after the last confirmed one; return their number."""
        self._counter.stop(known=False)
        dropped = max(len(self._pending), 1)
        self.counts['accepted'] -= not self._pending  # it was accepted as the start of a run
        self._pending = []
        self.last = self.confirmed
        self._calm = 0
        return dropped

    def _judge(self, pulse: float) -> None:
        """Accept a pulse that follows the last one, drop it, or begin a new run at it."""
        if self._lock is None:
            self._match(pulse)
            return
        step = int(self._lock.steps[self._slot])
        gap = pulse - self.last
        if self.fits(gap):
            self._calm += len(self._intervals) == 3
            self._strikes = 0
            self._accept(pulse, step, 1)
            return
        self._calm = 0
        self._strikes += 1
        if self._lock.even and self._agree():
            self.counts['relearnt'] += 1
            self._intervals.extend(np.diff(self._recent)[-3:].tolist())
            self._break(pulse)
            return
        if self._strikes == _LOST:
            self._lose(pulse)
            return
        number = gap / min(self._expected(), key=lambda interval: abs(gap / step - interval))
        missing = round(min(number, _STANDSTILL)) - step
        if number < DOUBLE:
            self._drop_double()
        elif number < step:
            self.counts['early'] += 1
            self._counter.stop()
            if not self._lock.even:
                self._lose(pulse)
        elif (0 < missing <= self._maximum_missing
              and abs(number - step - missing) <= self._lock.tolerance[self._slot]):
            passed = self._slots_passed(step + missing)
            self._intervals.append(gap / (step + missing))
            if self._bridge and passed:
                self.counts['missing_bridged'] += missing
                self._accept(pulse, step + missing, passed)
            else:
                self.counts['missing_broken'] += missing
                self._break(pulse, step + missing)
        else:
            self.counts['late'] += 1
            self._break(pulse)

    def _drop_double(self) -> None:
        self.counts['doubles'] += 1
        self._counter.double()

    def _expected(self) -> tuple[float, float]:
        return self._intervals[-1], sorted(self._intervals)[len(self._intervals) // 2]

    def _agree(self) -> bool:
        """Whether the intervals of the latest pulses agree with each other."""
        intervals = np.diff(self._recent)
        # Strictly less: intervals of 0, of a repeated pulse, do not count as agreement.
        return len(intervals) == _AGREEING and bool(np.all(
            np.abs(np.diff(intervals)) < self._tolerance * intervals[:-1]))

    def _slots_passed(self, teeth: int) -> int:
        """Return the number of pulses in the next `teeth` teeth, 0 if the last one is missing."""
        assert self._lock is not None
        passed = 0
        while teeth > 0:
            teeth -= int(self._lock.steps[(self._slot + passed) % self._lock.steps.size])
            passed += 1
        return passed if teeth == 0 else 0

    def _accept(self, pulse: float, step: int, passed: int) -> None:
        assert self._lock is not None
        self._slot = (self._slot + passed) % self._lock.steps.size
        if self._counter.running:
            self._counter.extend([pulse], [step])
        else:
            self._counter.begin(pulse, int(self._lock.teeth[self._slot]), passed=step)
        if passed == 1:
            self._intervals.append((pulse - self.last) / step)
        self.counts['accepted'] += 1
        self.last = self.confirmed = pulse

    def _break(self, pulse: float, passed: int | None = None) -> None:
        """
        Discard the trigger cycle and begin a new run, of a wheel once it is matched again.

        `passed` is the number of teeth since the last pulse, None where it is not known.
        """
        if self._lock is None or not self._lock.even:
            self._lose(pulse)
            return
        self._counter.begin(pulse, 0, passed=passed)
        self.counts['accepted'] += 1
        self.last = pulse

    def _lose(self, pulse: float) -> None:
        """Discard the trigger cycle and match the target again from this pulse on."""
        self._counter.stop(known=False)
        self._lock = None
        self._calm = self._strikes = 0
        self._pending = [pulse]
        self.last = pulse

    def _match(self, pulse: float) -> None:
        """Match the waiting pulses to the target if they fit it."""
        self._pending.append(pulse)
        self.last = pulse
        lock = self._target.lock(self._pending)
        if lock is None:
            if len(self._pending) > self._target.memory:
                self._pending.pop(0)
                self.counts['unlocked'] += 1
            return
        waiting, self._pending = self._pending[lock.first:], []
        self.counts['unlocked'] += lock.first
        self.counts['accepted'] += 1
        self._lock, self._slot, self.last = lock, lock.slot, waiting[0]
        self._intervals.clear()
        self._intervals.append(lock.interval)
        self._counter.begin(waiting[0], int(lock.teeth[lock.slot]))
        for each in waiting[1:]:
            self._judge(each)
