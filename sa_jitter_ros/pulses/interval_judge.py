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
Classification of pulses by what the shaft can do.

A pulse is *regular* if its interval is within the tolerance of the expected one
(`interval_model`), and it passes at once if it is so near that no average would show the
difference. All others wait for the next pulses. Then every explanation (`pulse_paths`) is tried:
the pulse is true, it is a stray, pulses are missing before it, the speed changed. What all likely
explanations have in common is decided:

* double, early: a stray less, or more, than half an interval after the last true pulse. It is
  dropped; the trigger cycle continues if the true pulse came, too.
* missing: pulses did not come. They are interpolated (bridge), or the trigger cycle is discarded
  and a new run begins (break).
* late: the interval is none that the shaft can have. The trigger cycle is discarded and a new run
  begins.
* a change of speed, which the intervals on either side show: nothing is lost.

If two pulses explain one tooth equally well, neither is used and the tooth counts as missing. If
nothing explains ten pulses, the interval is learnt again as at the start, where pulses wait until
several follow each other regularly. A target with several marks is learnt for four revolutions, so
that the uneven angles between its marks are known before the first pulse is judged; none is lost.
"""

from collections import deque
from dataclasses import dataclass, replace
import math

import numpy as np
import numpy.typing as npt
from sa_jitter_ros.pulses.alternation import Alternation
from sa_jitter_ros.pulses.interval_model import IntervalModel
from sa_jitter_ros.pulses.mark_pattern import (
    mark_pattern, regular_start, repeating, steady_pattern)
from sa_jitter_ros.pulses.pulse_paths import is_multiple, likely, Path, PathRules
from sa_jitter_ros.pulses.target import EvenTarget, Lock, Target
from sa_jitter_ros.pulses.trigger_counter import PulseSink, TriggerCounter

FloatArray = npt.NDArray[np.float64]
_MOST_WAITING = 10  # doubtful pulses, until the interval is learnt again
_NEAR_WHOLE = 0.2  # intervals by which a gap may differ from a whole number of them
_RAMP = 0.25  # largest change of an interval that is a change of speed
_AGREEING = 5  # equal intervals that show another pulse rate
_AGREE, _FASTER = 0.03, 0.75
_SAME_SCATTER = 2.0  # ratio up to which the scatter before a gap is that after it
_KNOWN_WELL = 16  # intervals that tell the scatter better than the first ones behind a gap
_REVOLUTIONS, _LONGEST = 5, 3.0  # and seconds in which the marks are learnt
_FEW_MARKS = 12
_LACKS_ONE = 1.6  # intervals that are as long as two with a pulse missing between them
_LEAST_REGULAR = 5e-3  # tolerance of the first intervals
_BELIEVED = 0.45  # unevenness of marks that are not known yet
_LARGE_BLOCK = 32  # marks, with which the scatter is learnt from more intervals at once
_LONGEST_GAP = 1000.0  # revolutions
_LONG = 2.0  # revolutions, of a gap behind which the marks are matched again
_LACKING = 6  # intervals in a row with as many missing pulses that show another pulse rate
_NO_INTERVALS = np.empty(0)
_FITS = 0.1  # tolerance with which a pulse after a step of time fits
# A change of the interval that is reported: across so many intervals, by this much of its
# logarithm; near a factor of two; and the number of reports that wait.
_SHORT, _CHANGED, _NEAR, _MESSAGES = 5.0, 0.3, 0.03, 10
_NEVER = 1 << 62
#: Latest pulses that were rejected, or are missing, of which times and reasons are kept.
REMEMBERED = 2000


@dataclass(frozen=True)
class JudgeOptions:
    """Options of `PulseValidator` that its judge needs."""

    bridge: bool
    tolerance: float
    maximum_missing: int
    minimum_interval: float
    pulses_per_trigger: int


@dataclass(frozen=True)
class _End:
    """Where a sequence ended: time (s), level of its last interval, and the scatter of `known`."""

    time: float
    level: float
    scatter: float
    known: int


class IntervalJudge:
    """
    Judge pulses in order of time and pass the valid ones on to a trigger counter.

    `last` is the latest pulse (s) not dropped, `confirmed` the latest that was accepted.
    `rejected` are the latest pulses (s) that were not taken as they came, each with the count that
    it is in, and where pulses are missing.
    """

    def __init__(self, target: Target, counter: PulseSink, options: JudgeOptions) -> None:
        self._target, self._counter, self._options = target, counter, options
        self._rehearses = False  # it stops where the match is lost
        self.counts = dict.fromkeys(
            ('accepted', 'doubles', 'missing_bridged', 'missing_broken', 'early', 'late',
             'unlocked', 'relearnt'), 0)
        self.messages: list[str] = []
        self.rejected: deque[tuple[float, str]] = deque(maxlen=REMEMBERED)
        block = 64 if target.marks >= _LARGE_BLOCK else 8
        self._model = IntervalModel(
            given=options.tolerance, pulses_per_trigger=options.pulses_per_trigger, block=block,
            marks=target.marks)
        self.forget()

    def forget(self) -> None:
        """Forget the interval and the match: the next pulses begin a new sequence."""
        self._counter.stop(known=False)
        self._lock: Lock | None = None
        self._candidate: Lock | None = None
        self._end: _End | None = None
        self._queue: list[float] = []
        self._tried = 0  # pulses of the queue that were tried to match
        self._failed = 0  # matches that found nothing, or were lost soon: the next waits longer
        self._recent: list[float] = []  # of the latest pulses, dropped ones too
        self._slot = 0
        self.confirmed = -np.inf
        self._marks: list[int] = []  # levels and ends of intervals since the pattern was learnt
        self._levels: list[float] = []
        self._times: list[float] = []
        self._lacking: list[int] = []  # slots of the latest intervals, all of which lacked pulses
        self._learnt = 0  # times that the pattern was learnt
        self._alternation = Alternation()

    @property
    def _few_marks(self) -> bool:
        """Whether two revolutions without a stray are likely."""
        return isinstance(self._target, EvenTarget) and self._target.marks <= _FEW_MARKS

    @property
    def last(self) -> float:
        """Time (s) of the latest pulse that was not dropped."""
        return self._queue[-1] if self._queue else self.confirmed

    @property
    def waiting(self) -> int:
        """Return the number of pulses not yet judged."""
        return len(self._queue)

    def take(self, pulses: list[float]) -> None:
        """Take the next pulses in s, in order of time, none before the last one."""
        least, last = self._options.minimum_interval, self.last
        for pulse in pulses:
            if pulse - last < least or pulse == last:
                self.counts['doubles'] += 1
                self.rejected.append((pulse, 'doubles'))
            else:
                self._queue.append(pulse)
                last = pulse
        self._run(final=False)

    def flush(self) -> None:
        """Judge the pulses that wait, because none follows."""
        self._run(final=True)

    def fits(self, gap: float) -> bool:
        """Whether a pulse at this interval (s) from the last one would be regular."""
        if self._lock is None:
            return False
        expected = math.exp(self._model.expected) * float(self._lock.widths[self._slot])
        return abs(gap / expected - 1.0) <= max(self._model.tolerance, _FITS)

    def drop_later(self, time: float, most: int) -> int:
        """Drop the waiting pulses after a time (s) if they are `most` or fewer; their number."""
        later = sum(pulse > time for pulse in self._queue)
        if not 0 < later <= most:
            return 0
        del self._queue[-later:]
        self._tried = min(self._tried, len(self._queue))
        return later

    # --- the queue ---

    def _run(self, *, final: bool) -> None:
        while self._queue:
            going_on = (self._match(final) if self._lock is None
                        else self._take_regular(final) or self._decide(final))
            if not going_on:
                return
            if self._lock is not None and self._model.irregular:
                self._lose()
                self._end = None

    def _drop(self, kind: str, at: int = 0) -> None:
        """Drop a waiting pulse."""
        pulse = self._queue.pop(at)
        self._remember(pulse)
        self.rejected.append((pulse, kind))
        self.counts[kind] += 1
        if kind != 'unlocked':
            self._counter.drop()

    def _remember(self, pulse: float) -> None:
        self._recent = [*self._recent[-_AGREEING:], pulse]

    # --- regular pulses ---

    def _take_regular(self, final: bool) -> int:
        """Accept the pulses up to the first doubtful one; return their number."""
        lock, model = self._lock, self._model
        assert lock is not None
        room = min(model.room, self._room_of_marks)
        pulses, (steps, widths, believed) = self._queue[:room + 1], lock.lists
        size = len(steps)
        slots = [number % size for number in range(self._slot, self._slot + len(pulses))]
        gaps = [pulse - before for before, pulse in zip((self.confirmed, *pulses), pulses)]
        levels = [math.log(gap / widths[slot]) for gap, slot in zip(gaps, slots)]
        off = [abs(item) for item in model.deviations(levels)]
        # Teeth beside gaps are uneven; a stray among marks that may be uneven needs a search.
        tolerance, uneven = model.tolerance, not lock.even
        regular = [item <= tolerance or (uneven and item <= believed[slot])
                   for item, slot in zip(off, slots)]
        # A pulse with a small deviation cannot spoil an average. A larger one may be a stray's:
        # then the next interval is too short.
        regular.append(final and len(pulses) == len(self._queue))
        passes = [item <= model.harmless or (fits and following)
                  for item, fits, following in zip(off, regular, regular[1:])]
        count = min(passes.index(False) if False in passes else len(pulses), room)
        if count:
            taken, slots, levels = pulses[:count], slots[:count], levels[:count]
            self._counter.extend(taken, [steps[slot] for slot in slots])
            self.counts['accepted'] += count
            model.accept(levels, gaps[:count])
            self._lacking = []
            if size == 1:
                self._look_at_turns(levels)
            self._recent = [*self._recent, *taken[-_AGREEING - 1:]][-_AGREEING - 1:]
            self._note(slots, levels, taken)
            self._slot = (slots[-1] + 1) % size
            self.confirmed = taken[-1]
            del self._queue[:count]
            self._learn_marks()
        return count

    def _look_at_turns(self, levels: list[float]) -> None:
        """Say that intervals of one mark are longer and shorter in turns."""
        known = self._alternation.size
        self._alternation.update(levels)
        size = abs(self._alternation.size)
        if not size or known or self._rehearses or self._model.has_tick:
            return
        usual = math.exp(0.5 * (self._model.level + self._model.before))
        self.messages.append(
            f'the pulse intervals are longer and shorter in turns, {usual * math.exp(size):.6g} s '
            f'and {usual * math.exp(-size):.6g} s: are they pulses of two keyphasors of one name, '
            'or of two marks (pulses_per_revolution)? A load that repeats every two revolutions '
            'does the same')
        del self.messages[:-_MESSAGES]

    def _note(self, slots: list[int], levels: list[float], times: list[float]) -> None:
        """Note the intervals behind these slots, and when they end, for the pattern."""
        assert self._lock is not None
        if self._lock.steps.size > 1:
            self._marks += slots
            self._levels += levels
            self._times += times

    # --- doubtful pulses ---

    def _rules(self) -> PathRules:
        assert self._lock is not None
        return PathRules(
            self._lock.steps.tolist(), self._lock.widths.tolist(), self._model.scatter,
            np.maximum(self._lock.believed, self._options.tolerance).tolist(),
            self._options.maximum_missing, self._model.expected, self._model.tick,
            self._model.told)

    def _decide(self, final: bool) -> bool:
        """Judge the first waiting pulse, which is doubtful; False if the next one is needed."""
        assert self._lock is not None
        queue, model = self._queue, self._model
        expected = math.exp(model.expected) * float(self._lock.widths[self._slot])
        same = model.same * expected
        if queue[0] - self.confirmed < same:
            self._drop('doubles')
            return True
        if len(queue) > 1 and queue[1] - queue[0] < same:
            first_is_nearer = expected <= 0.5 * (queue[0] + queue[1]) - self.confirmed
            self._drop('doubles', at=int(first_is_nearer))
            return True
        if len(queue) == 1 and not final:
            return False
        if self._is_of_clock():
            return True
        rules = self._rules()
        paths = [Path(0.0, self.confirmed, self._slot, 0, model.level, model.before,
                      slowed=model.slowed)]
        for number, pulse in enumerate(queue[:_MOST_WAITING]):
            paths = rules.extend(paths, pulse)
            if (number or len(queue) == 1) and self._commit(paths, final):
                return True
        if len(queue) >= _MOST_WAITING:
            self._lose()
            return True
        if final:
            self._drop('unlocked')
        return final

    def _is_of_clock(self) -> bool:
        """Whether the ticks of a clock explain the next two intervals, which are regular then."""
        assert self._lock is not None
        pulses = np.array([self.confirmed, *self._queue[:2]])
        gaps, widths, slot = np.diff(pulses), [], self._slot
        for gap in gaps.tolist():
            passed = self._slots_in(gap, self._model.expected, slot)
            if not 0 < passed <= 1 + self._options.maximum_missing:
                return False
            slots = (slot + np.arange(passed)) % self._lock.steps.size
            widths.append(float(self._lock.widths[slots].sum()))
            slot = (slot + passed) % self._lock.steps.size
        return self._model.explains(gaps, np.array(widths), float(pulses[-1]))

    def _commit(self, paths: list[Path], final: bool) -> bool:
        """Decide about the first pulses if the likely paths agree about them."""
        near = likely(paths)
        best = near[0]
        if all(path.marks[0] == best.marks[0] for path in near):
            if best.marks[0] == 0:
                if not (any(best.marks) or final):  # strays come between true pulses
                    return False
                self._drop_stray()
                return True
            later = [level for level in best.levels[1:] if not math.isnan(level)]
            if best.marks[0] == 1 and abs(best.deviations[0]) <= self._tolerance:
                self._accept(1, best.levels[0])
                return True
            if not later and not final:
                return False
            self._irregular(best.marks[0], best.levels[0], best.deviations[0],
                            later[0] if later else None)
            return True
        count = len(best.marks)
        if count < 3 or not (best.marks[-1] and best.marks[-2]):
            return False
        if any(path.marks[-2:] != best.marks[-2:] or path.slot != best.slot
               or path.passed != best.passed for path in near):
            return False
        # Which of the pulses before is true makes no difference to these two.
        skipped = sum(best.marks[:-1])
        for _ in range(count - 2):
            self._drop('early')
        lock = self._lock
        assert lock is not None
        slots = (self._slot + np.arange(skipped)) % lock.steps.size
        gap = self._queue[0] - self.confirmed
        level = math.log(gap / float(lock.widths[slots].sum()))
        self._irregular(skipped, level, 0.0, best.levels[-1])
        return True

    def _drop_stray(self) -> None:
        assert self._lock is not None
        gap = self._queue[0] - self.confirmed
        expected = math.exp(self._model.expected) * float(self._lock.widths[self._slot])
        self._model.refuse(gap / expected - 1.0)
        self._drop('doubles' if gap < 0.5 * expected else 'early')
        recent = np.diff(self._recent)
        mean = float(recent.mean()) if recent.size == _AGREEING else np.inf
        if (self._lock.even and mean < _FASTER * expected
                and np.all(np.abs(np.diff(recent))
                           < max(_AGREE, self._model.tolerance) * recent[1:])):
            self.counts['relearnt'] += 1
            self._lose()

    def _accept(self, mark: int, level: float) -> None:
        """Accept the first waiting pulse, `mark` slots after the last one."""
        slots, steps = self._passed(mark)
        pulse = self._next(slots, level)
        self._model.accept([level])
        self._lacking = []
        self._counter.extend([pulse], [steps])

    def _irregular(self, mark: int, level: float, deviation: float, after: float | None) -> None:
        """
        Accept the first waiting pulse, whose interval needs an explanation.

        `after` is the level of the interval behind it, None if there is none.
        """
        model, tolerance = self._model, self._tolerance
        slots, steps = self._passed(mark)
        gap = self._queue[0] - self.confirmed
        regular = abs(deviation) <= tolerance
        known = self._is_whole(gap, slots, model.level) and (
            after is None or self._is_whole(gap, slots, after))
        if mark == 1 and after is not None and abs(math.expm1(level - model.level)) <= max(
                _RAMP, self._options.tolerance):
            low, high = sorted((model.level, after))
            changes = low - tolerance <= level <= high + tolerance  # the speed does
            if changes:
                pulse = self._next(slots, level)
                model.jump(level)
                self._counter.extend([pulse], [steps])
                return
        if mark > 1 and regular and known:
            kind = 'missing_bridged' if self._options.bridge else 'missing_broken'
            self.counts[kind] += mark - 1
            self.rejected += [(self.confirmed + gap * number / mark, 'missing')
                              for number in range(1, min(mark, _MOST_WAITING))]
            pulse = self._next(slots, level)
            model.accept([level])
            if self._lacks_alike(mark, gap):
                self._counter.begin(pulse, 0, passed=steps)
            elif self._options.bridge:
                self._counter.extend([pulse], [steps])
            else:
                self._counter.begin(pulse, 0, passed=steps)
            return
        self.counts['late'] += 1
        self.rejected.append((self._queue[0], 'late'))
        if mark == 1:
            model.refuse(deviation)
        if not known and mark == 1 and after is not None:
            passed = self._slots_in(gap, model.level, self._slot)
            if passed and passed == self._slots_in(gap, after, self._slot):
                slots, steps = self._passed(passed)
                known = True
        assert self._lock is not None
        # A step of the time may be whole by chance: uneven marks tell which of them comes next.
        long = gap > _LONG * float(self._lock.widths.sum()) * math.exp(model.level)
        if (not known or long) and (self._rehearses or not self._lock_is_plain):
            self._lose()
            return
        if after is not None and abs(after - model.level) > tolerance:
            self.counts['relearnt'] += 1
            self._report_change(gap, model.level, after)
        pulse = self._next(slots, level if len(slots) == 1 and known else math.nan)
        if after is not None:
            model.jump(after)
        self._counter.begin(pulse, 0, passed=steps if known else None)

    def _lacks_alike(self, mark: int, gap: float) -> bool:
        """Take the latest interval for the usual one if many have lacked as many pulses."""
        self._lacking = [*self._lacking, mark] if mark in self._lacking else [mark]
        if len(self._lacking) < _LACKING:
            return False
        level = self._model.level
        self._report_change(gap, level, level + math.log(mark))
        self.counts['relearnt'] += 1
        self._model.jump(level + math.log(mark))
        self._lacking = []
        return True

    def _report_change(self, gap: float, before: float, after: float) -> None:
        """Say that the interval changed across a gap (s) as no shaft changes it."""
        old, new = math.exp(before), math.exp(after)
        if self._rehearses or gap > _SHORT * max(old, new) or abs(after - before) < _CHANGED:
            return
        why = ('did another keyphasor take over, or the pulses of several marks become visible? '
               'interval_tolerance 1 accepts every pulse of a machine that turns so unevenly')
        if abs(new / old - 0.5) < _NEAR:
            why = ('twice as many pulses come: is there a second keyphasor of the same name, or '
                   'are both edges of a mark detected?')
        elif abs(old / new - 0.5) < _NEAR:
            why = 'every other pulse is missing: is the threshold of the detector too high?'
        self.messages.append(
            f'the pulse interval changes from {old:.4g} s to {new:.4g} s at {self.confirmed:.6f} '
            f's, faster than a shaft can change its speed: {why}')
        del self.messages[:-_MESSAGES]

    @property
    def _tolerance(self) -> float:
        """Largest deviation of a regular interval from the last pulse."""
        assert self._lock is not None
        return max(self._model.tolerance, float(self._lock.believed[self._slot]))

    @property
    def _lock_is_plain(self) -> bool:
        """Whether all marks are alike, so that none has to be found again."""
        lock = self._lock
        return lock is not None and lock.even and bool(np.all(lock.widths == 1.0))

    def _passed(self, mark: int) -> tuple[list[int], int]:
        """Return the next `mark` slots, and the teeth that they span."""
        assert self._lock is not None
        slots = [(self._slot + k) % self._lock.steps.size for k in range(mark)]
        return slots, int(self._lock.steps[slots].sum())

    def _next(self, slots: list[int], level: float) -> float:
        """Take the first pulse out of the queue as the one at the end of these slots."""
        self._alternation = Alternation()
        assert self._lock is not None
        pulse = self._queue.pop(0)
        self._remember(pulse)
        self.counts['accepted'] += 1
        self.confirmed = pulse
        if len(slots) > self._lock.steps.size:  # a gap of more than a revolution
            self._marks, self._levels, self._times = [], [], []
        else:
            self._note(slots, [level if len(slots) == 1 else math.nan] * len(slots),
                       [pulse] * len(slots))
        self._slot = (slots[-1] + 1) % self._lock.steps.size
        self._learn_marks()
        return pulse

    def _slots_in(self, gap: float, level: float, slot: int) -> int:
        """Return how many slots a gap (s) from `slot` on has at a level, 0 if no whole one."""
        assert self._lock is not None
        widths = np.roll(self._lock.widths, -slot)
        revolution = float(widths.sum())
        turns, rest = divmod(gap / math.exp(level), revolution)
        if turns > _LONGEST_GAP:
            return 0
        ends = np.append(0.0, np.cumsum(widths))
        nearest = int(np.argmin(np.abs(ends - rest)))
        if abs(float(ends[nearest]) - rest) > _NEAR_WHOLE:
            return 0
        return int(turns) * widths.size + nearest

    def _is_whole(self, gap: float, slots: list[int], level: float) -> bool:
        """Whether intervals of this level make the gap (s) the whole number of teeth."""
        assert self._lock is not None
        width = float(self._lock.widths[slots].sum())
        return abs(gap / math.exp(level) - width) <= _NEAR_WHOLE

    # --- learning ---

    def _lose(self) -> None:
        """Discard the trigger cycle and match the target again from the waiting pulses on."""
        soon = self._model.taken < _KNOWN_WELL  # what is lost so may have other intervals
        known = self._model.known // 2 if soon else self._model.known
        self._failed = self._failed + 1 if soon else 0
        self._end = _End(self.confirmed, self._model.level, self._model.scatter, known)
        self._counter.stop()
        self._alternation = Alternation()
        self._lock = self._candidate = None
        self._tried = 0
        self._marks, self._levels, self._times = [], [], []

    def _match(self, final: bool) -> bool:
        """Match the waiting pulses to the target; False if there are too few to fit it."""
        if self._rehearses:
            return False
        scatter = None if self._end is None else self._end.scatter
        queue = np.array(self._queue)
        while self._candidate is None:
            size = self._target.next_size(
                queue, self._tried, self._failed, known=scatter is not None)
            if size > queue.size:
                if not final or self._tried >= queue.size:
                    return self._drop_rest(final)
                size = queue.size
            self._tried = size
            self._candidate = self._target.lock(queue[:size], scatter)
            self._failed += self._candidate is None
            excess = size - self._target.memory
            if self._candidate is None and excess > 0:
                self._drop_unlocked(excess)
                queue = queue[excess:]
        lock = self._candidate = self._at_known_speed(self._candidate)
        if lock.steps.size > 1:
            wanted = lock.first + 1 + min(
                _REVOLUTIONS * lock.steps.size, math.ceil(_LONGEST / lock.interval))
            if queue.size < wanted and not final:
                return False
            found = None
            if self._few_marks:
                found = self._repeating(lock, queue[:wanted], doubtful=False)
                if found is None and queue.size < 2 * wanted and not final:
                    return False
                found = found or self._repeating(lock, queue[:2 * wanted], doubtful=True)
            lock = found or self._rehearsed(lock, queue[:wanted])
        self._drop_unlocked(lock.first)
        self._begin(lock)
        return True

    def _at_known_speed(self, lock: Lock) -> Lock:
        """Return the lock with the interval before, if its own is twice, thrice, ... as long."""
        if self._end is None or not lock.even:
            return lock
        longer = lock.interval / math.exp(self._end.level)
        if not (is_multiple(longer - 1.0) and round(longer) <= 1 + self._options.maximum_missing):
            return lock
        return replace(lock, interval=lock.interval / round(longer), intervals=_NO_INTERVALS)

    def _drop_unlocked(self, count: int) -> None:
        del self._queue[:count]
        self._tried -= count
        self.counts['unlocked'] += count

    def _drop_rest(self, final: bool) -> bool:
        if final:
            self._drop_unlocked(len(self._queue))
        return False

    def _rehearsed(self, lock: Lock, pulses: FloatArray) -> Lock:
        """Return the lock with the angles between the marks, which the pulses (n,) show."""
        judge = self._rehearsal(_uneven(lock), pulses[lock.first:])
        marks, levels = np.array(judge._marks, np.int64), np.array(judge._levels)
        pattern = mark_pattern(marks, levels, lock.steps.size)
        if pattern is None:
            return lock
        learnt = lock.with_pattern(pattern)
        # The first pulse may have been a stray, which only the pattern shows.
        levels = levels + np.log(lock.widths[marks] / learnt.widths[marks])
        begin = regular_start(levels, max(6.0 * pattern.scatter, _LEAST_REGULAR))
        time = judge._times[begin - 1] if begin else pulses[lock.first]
        return self._from_earliest(replace(
            learnt, first=int(np.searchsorted(pulses, time)), slot=int(marks[begin]),
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
        judge = self._rehearsal(_uneven(learnt), pulses[learnt.first:])
        # Before pulses that it could not judge, the last interval is doubtful, too.
        count = len(judge._levels) - (judge.confirmed < pulses[-1])
        tried = [(np.array(judge._marks[:count], np.int64), np.array(judge._levels[:count]))]
        # It may be misled by a displaced pulse, which spoils two of otherwise whole revolutions.
        marks = (learnt.slot + np.arange(pulses.size - 1 - learnt.first)) % size
        lengths = np.diff(pulses[learnt.first:]) / learnt.widths[marks]
        parts = lengths / np.median(lengths)
        if parts.max() < _LACKS_ONE and abs(parts.sum() - parts.size) < 0.5:
            tried.append((marks, np.log(lengths)))
        found = [replace(learnt.with_pattern(every), known=levels.size - size)
                 for marks, levels in tried
                 if (every := steady_pattern(marks, levels, size)) is not None]
        if not found:
            return learnt if doubtful else None
        return min(found, key=lambda item: item.scatter)

    def _from_earliest(self, lock: Lock, pulses: FloatArray) -> Lock:
        """Return the lock from the earliest of the pulses (n,) on that fits, in reversed time."""
        back = (lock.slot - 1 - np.arange(lock.steps.size)) % lock.steps.size
        judge = self._rehearsal(replace(
            lock, slot=0, steps=lock.steps[back], widths=lock.widths[back],
            believed=lock.believed[back]), -pulses[lock.first::-1])
        return replace(lock, first=int(np.searchsorted(pulses, -judge.confirmed)),
                       slot=(lock.slot - judge._slot) % lock.steps.size).numbered()

    def _rehearsal(self, lock: Lock, pulses: FloatArray) -> 'IntervalJudge':
        """Return a judge that judged the pulses (n,) with this lock until it lost it."""
        judge = IntervalJudge(
            self._target, TriggerCounter(teeth=1, teeth_per_trigger=1), self._options)
        judge._queue, judge._rehearses = pulses.tolist(), True
        judge._begin(lock)
        judge._run(final=True)
        return judge

    def _begin(self, lock: Lock) -> None:
        """Begin a sequence at the first waiting pulse."""
        first = self._queue[0]
        self._lock, self._candidate, self._slot = lock, None, lock.slot
        tooth = int(lock.teeth[lock.slot])
        passed = None
        scatter, count = lock.scatter, lock.known
        if self._end is not None:
            gap = first - self._end.time
            teeth = [gap / math.exp(level) for level in (self._end.level, math.log(lock.interval))]
            number = round(teeth[0]) if math.isfinite(teeth[0]) else 0
            if number and max(abs(item - number) for item in teeth) <= _NEAR_WHOLE:
                passed = number
            known_better = self._end.known >= max(_KNOWN_WELL, count)
            if known_better or scatter < _SAME_SCATTER * self._end.scatter:
                scatter, count = self._end.scatter, max(count, self._end.known)
            self._report_change(gap, self._end.level, math.log(lock.interval))
        self._counter.begin(first, tooth, passed=passed)
        self.counts['accepted'] += 1
        del self._queue[0]
        self._remember(first)
        self.confirmed = first
        self._end = None
        self._tried = 0
        self._model.start(math.log(lock.interval), scatter=scatter, count=count,
                          intervals=lock.intervals.tolist())

    @property
    def _room_of_marks(self) -> int:
        """Return the number of intervals until the angles between marks are learnt."""
        assert self._lock is not None
        size = self._lock.steps.size
        if size == 1 or self._rehearses:
            return _NEVER
        return _REVOLUTIONS * size + 1 - len(self._levels)

    def _learn_marks(self) -> None:
        """Learn the angles between the marks from the latest revolutions."""
        lock = self._lock
        assert lock is not None
        size = lock.steps.size
        if self._room_of_marks > 0:
            return
        self._lock = lock.with_pattern(
            mark_pattern(np.array(self._marks, np.int64), np.array(self._levels), size),
            weight=1.0 / min(2 + self._learnt, 8))
        self._learnt += 1
        self._marks, self._levels, self._times = [], [], []


def _uneven(lock: Lock) -> Lock:
    """Return the lock with marks that may be uneven."""
    return replace(lock, believed=np.maximum(lock.believed, _BELIEVED))
