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
The start of a sequence: which of the first pulses are true, and which marks of the target.

The interval is not known yet, so pulses wait until several follow each other regularly. A target
with several marks is learnt for four revolutions, so that the uneven angles between its marks are
known before the first pulse is judged; none is lost.
"""

from collections.abc import Generator, Iterator
from dataclasses import dataclass, replace
import math

import numpy as np
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.pulses.interval_model import IntervalModel
from sa_jitter_ros.pulses.mark_pattern import (
    mark_pattern, regular_start, repeating, steady_pattern)
from sa_jitter_ros.pulses.pulse_chain import UNSTEADY
from sa_jitter_ros.pulses.pulse_follower import JudgeOptions, PulseFollower, REVOLUTIONS
from sa_jitter_ros.pulses.pulse_paths import is_multiple
from sa_jitter_ros.pulses.target import EvenTarget, Lock, Target
from sa_jitter_ros.pulses.trigger_counter import TriggerCounter
from sa_jitter_ros.pulses.verdicts import Verdicts

_LONGEST = 3.0  # s in which the marks are learnt
_FEW_MARKS = 12
_LACKS_ONE = 1.6  # intervals that are as long as two with a pulse missing between them
_LEAST_REGULAR = 5e-3  # tolerance of the first intervals
_BELIEVED = 0.45  # unevenness of marks that are not known yet
_LARGE_BLOCK = 32  # marks, with which the scatter is learnt from more intervals at once
_ROUGH = 0.06  # scatter that may be that of the speed


@dataclass(frozen=True)
class End:
    """
    Where a sequence ended: time (s), level of its last interval, and the scatter of `known`.

    `tooth` is that of the last pulse. `unsteady`: the speed scattered.
    """

    time: float
    level: float
    scatter: float
    known: int
    tooth: int
    unsteady: bool = False


def new_model(target: Target, options: JudgeOptions) -> IntervalModel:
    """Return the model of the intervals of a target."""
    return IntervalModel(
        given=options.tolerance, pulses_per_trigger=options.pulses_per_trigger,
        block=64 if target.marks >= _LARGE_BLOCK else 8, marks=target.marks)


class PulseStart:
    """
    Find the lock on a target in the pulses (s) of a queue.

    Those that no lock needs are taken away and count as unlocked.
    """

    def __init__(self, target: Target, queue: list[float], options: JudgeOptions,
                 verdicts: Verdicts) -> None:
        self._target, self._queue, self._options = target, queue, options
        self._verdicts = verdicts
        self._tried = 0  # pulses of the queue that were tried to match
        #: matches that found nothing, or were lost soon: the next waits longer
        self.failed = 0
        self._end: End | None = None
        self._final = False
        self._locks = self._search()

    def find(self, end: End | None, *, final: bool) -> Lock | None:
        """
        Return the lock on the first pulses, None if there are too few to fit one.

        The sequence before, if any, had this `end`. If no pulse follows, they are `final`.
        """
        self._end, self._final = end, final
        return next(self._locks)

    def drop_later(self) -> None:
        """Take note that the latest pulses were taken away."""
        self._tried = min(self._tried, len(self._queue))

    def _search(self) -> Iterator[Lock | None]:
        """Yield locks, each on the first pulses, and None as often as more pulses are needed."""
        while True:
            lock = yield from self._chosen()
            lock = self._at_known_speed(lock)
            if lock.steps.size > 1:
                wanted = lock.first + 1 + min(
                    REVOLUTIONS * lock.steps.size, math.ceil(_LONGEST / lock.interval))
                pulses, found = (yield from self._first(wanted)), None
                if isinstance(self._target, EvenTarget) and self._target.marks <= _FEW_MARKS:
                    found = self._repeating(lock, pulses, doubtful=False)
                    if found is None:
                        found = self._repeating(
                            lock, (yield from self._first(2 * wanted)), doubtful=True)
                lock = found or self._rehearsed(lock, pulses)
            self._drop(lock.first)
            self._tried = 0
            yield lock

    def _first(self, count: int) -> Generator[None, None, FloatArray]:
        """Return so many of the first pulses; yield until they are there, or no more follow."""
        while len(self._queue) < count and not self._final:
            yield None
        return np.array(self._queue[:count])

    def _chosen(self) -> Generator[None, None, Lock]:
        """Return a lock on the pulses of the queue; yield while there are too few to fit one."""
        lock, end = None, self._end
        scatter = None if end is None or end.unsteady else end.scatter
        while lock is None:
            queue = np.array(self._queue)
            size = self._target.next_size(
                queue, self._tried, self.failed, known=scatter is not None)
            if size > queue.size and not (self._final and self._tried < queue.size):
                if self._final:
                    self._drop(queue.size)
                yield None
                continue
            self._tried = min(size, queue.size)
            lock = self._target.lock(queue[:self._tried], scatter)
            self.failed += lock is None
            if lock is None:
                self._drop(max(self._tried - self._target.memory, 0))
        if (lock.scatter > _ROUGH and not lock.unsteady and not self._options.tolerance
                and isinstance(self._target, EvenTarget)):
            # It may be the speed that scatters, which more pulses show.
            lock = self._target.unsteady((yield from self._first(UNSTEADY))) or lock
        return lock

    def _drop(self, count: int) -> None:
        """Take pulses away that are in no sequence."""
        del self._queue[:count]
        self._tried -= count
        counts, marks = self._verdicts.counts, self._target.marks
        before, counts['unlocked'] = counts['unlocked'], counts['unlocked'] + count
        limit = max(EvenTarget.memory, REVOLUTIONS * marks)
        if before < limit <= counts['unlocked'] and not counts['accepted']:
            self._verdicts.say(
                f'the first {limit} pulses fit no target of {marks} marks as declared: is it '
                'noise, or another target? check_keyphasor finds its marks and their angles')

    def _at_known_speed(self, lock: Lock) -> Lock:
        """Return the lock with the interval before, if its own is twice, thrice, ... as long."""
        end = self._end
        if end is None or not lock.even:
            return lock
        longer = lock.interval / math.exp(end.level)
        if not (is_multiple(longer - 1.0) and round(longer) <= 1 + self._options.maximum_missing):
            return lock
        return replace(lock, interval=lock.interval / round(longer), intervals=np.empty(0))

    def _rehearsed(self, lock: Lock, pulses: FloatArray) -> Lock:
        """Return the lock with the angles between the marks, which the pulses (n,) show."""
        probe = self._probe(_uneven(lock), pulses[lock.first:])
        slots, levels = np.array(probe.slots, np.int64), np.array(probe.levels)
        pattern = mark_pattern(slots, levels, lock.steps.size)
        if pattern is None:
            return lock
        learnt = lock.with_pattern(pattern)
        # The first pulse may have been a stray, which only the pattern shows.
        levels = levels + np.log(lock.widths[slots] / learnt.widths[slots])
        begin = regular_start(levels, max(6.0 * pattern.scatter, _LEAST_REGULAR))
        # Behind a long gap a probe notes intervals anew: the first may not be that of the lock.
        time, slot = (probe.times[begin - 1], int(slots[begin])) if begin else (
            pulses[lock.first], lock.slot)
        return self._from_earliest(replace(
            learnt, first=int(np.searchsorted(pulses, time)), slot=slot,
            interval=math.exp(levels[begin])), pulses)

    def _repeating(self, lock: Lock, pulses: FloatArray, *, doubtful: bool) -> Lock | None:
        """
        Return the lock on pulses (n,) of few even marks that repeat for two revolutions.

        It is `doubtful` if too few others tell whether one of these pulses is displaced.
        """
        size = lock.steps.size
        levels = np.log(np.diff(pulses))
        two = repeating(levels, size)
        if two is None:
            return None
        begin, pattern = two
        learnt = lock.with_pattern(pattern)
        learnt = self._from_earliest(replace(
            learnt, first=begin, slot=0,
            interval=math.exp(levels[begin]) / float(learnt.widths[0])), pulses)
        # All revolutions know angles and scatter better than these two.
        probe = self._probe(_uneven(learnt), pulses[learnt.first:])
        # Before pulses that it could not judge, the last interval is doubtful, too.
        count = len(probe.levels) - (probe.confirmed < pulses[-1])
        tried = [(np.array(probe.slots[:count], np.int64), np.array(probe.levels[:count]))]
        # It may be misled by a displaced pulse, which spoils two of otherwise whole revolutions.
        slots = (learnt.slot + np.arange(pulses.size - 1 - learnt.first)) % size
        lengths = np.diff(pulses[learnt.first:]) / learnt.widths[slots]
        parts = lengths / np.median(lengths)
        if parts.max() < _LACKS_ONE and abs(parts.sum() - parts.size) < 0.5:
            tried.append((slots, np.log(lengths)))
        found = [replace(learnt.with_pattern(every), known=levels.size - size)
                 for slots, levels in tried
                 if (every := steady_pattern(slots, levels, size)) is not None]
        if not found:
            return learnt if doubtful else None
        return min(found, key=lambda item: item.scatter)

    def _from_earliest(self, lock: Lock, pulses: FloatArray) -> Lock:
        """Return the lock from the earliest of the pulses (n,) on that fits, in reversed time."""
        back = (lock.slot - 1 - np.arange(lock.steps.size)) % lock.steps.size
        probe = self._probe(replace(
            lock, slot=0, steps=lock.steps[back], widths=lock.widths[back],
            believed=lock.believed[back]), -pulses[lock.first::-1])
        slot = (lock.slot - probe.slot) % lock.steps.size
        turn = slot if lock.even else 0  # without an index the first pulse is number 0
        return replace(lock, first=int(np.searchsorted(pulses, -probe.confirmed)),
                       slot=slot - turn, widths=np.roll(lock.widths, -turn),
                       believed=np.roll(lock.believed, -turn))

    def _probe(self, lock: Lock, pulses: FloatArray) -> PulseFollower:
        """Return what followed the pulses (n,) from this lock on until it lost them."""
        probe = PulseFollower(
            lock, pulses.tolist(), new_model(self._target, self._options), options=self._options,
            sink=TriggerCounter(teeth=1, teeth_per_trigger=1), verdicts=Verdicts(), probe=True)
        probe.follow(final=True)
        return probe


def _uneven(lock: Lock) -> Lock:
    """Return the lock with marks that may be uneven."""
    return replace(lock, believed=np.maximum(lock.believed, _BELIEVED))
