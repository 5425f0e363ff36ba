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
The pulses of a target whose marks and speed are known: which of them are true.

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

If two pulses explain one tooth equally well, neither is used and the tooth counts as missing.
"""

from collections import deque
from dataclasses import dataclass, replace
import math

import numpy as np
from sa_jitter_ros.pulses.interval_model import IntervalModel
from sa_jitter_ros.pulses.mark_corrector import PulseSink
from sa_jitter_ros.pulses.mark_pattern import mark_pattern
from sa_jitter_ros.pulses.pulse_paths import likely, Path, PathRules
from sa_jitter_ros.pulses.target import Lock
from sa_jitter_ros.pulses.verdicts import Verdicts

_MOST_WAITING = 10  # doubtful pulses, until the match is lost
_RAMP = 0.25  # largest change of an interval that is a change of speed
_AGREEING = 5  # equal intervals that show another pulse rate
_AGREE, _FASTER = 0.03, 0.75
_LONGEST_GAP = 1000.0  # revolutions
_LONG = 2.0  # revolutions, of a gap behind which the marks are matched again
_LACKING = 6  # intervals in a row with as many missing pulses that show another pulse rate
_FITS = 0.1  # tolerance with which a pulse after a step of time fits
# A change of the interval that is reported: across so many intervals, by this much of its
# logarithm; and how near to a factor of two.
_SHORT, _CHANGED, _NEAR = 5.0, 0.3, 0.03
#: revolutions from which the angles between the marks are learnt
REVOLUTIONS = 5
#: intervals by which a gap may differ from a whole number of them
NEAR_WHOLE = 0.2
_NEVER = 1 << 62
# Intervals that show whether every other one is longer: by how much at least, and by how many
# times their variance.
_TURNS, _LEAST_TURNS, _SURE_TURNS = 256, 2e-5, 100.0


@dataclass(frozen=True)
class JudgeOptions:
    """Options of `PulseValidator` that decide which pulses are true."""

    bridge: bool
    tolerance: float
    maximum_missing: int
    minimum_interval: float
    pulses_per_trigger: int


class PulseFollower:
    """
    Follow the pulses of a target, the first of which is the first of the `queue`.

    The `model` of the intervals is started by the `lock`. Those in the queue (s) that are decided
    about are taken away; the true ones go to the `sink`.
    `confirmed` (s) is the latest of these. Once the match is `lost`, nothing is decided; of a
    `probe`, which has no trigger cycles to lose, it is lost wherever the number of passed teeth is
    not sure. `slots`, `levels` and `times` are those of the intervals since the pattern of the
    marks was learnt, which a probe does not learn.
    """

    def __init__(self, lock: Lock, queue: list[float], model: IntervalModel, *,
                 options: JudgeOptions, sink: PulseSink, verdicts: Verdicts, probe: bool = False
                 ) -> None:
        self._lock, self._queue, self._model, self._options = lock, queue, model, options
        self._sink, self._verdicts, self._probe = sink, verdicts, probe
        self.lost = False
        self.slot = lock.slot
        self.slots: list[int] = []
        self.levels: list[float] = []
        self.times: list[float] = []
        self._learnt = 0  # times that the pattern was learnt
        self._lacking: list[int] = []  # slots of the latest intervals, all of which lacked pulses
        self._alternates = False
        model.start(math.log(lock.interval), scatter=lock.scatter, count=lock.known,
                    intervals=lock.intervals.tolist(), unsteady=lock.unsteady)
        # the latest pulses, dropped ones too
        self._recent = deque[float](maxlen=_AGREEING + 1)
        verdicts.counts['accepted'] += 1
        self.confirmed = queue.pop(0)
        self._recent.append(self.confirmed)

    def follow(self, *, final: bool) -> None:
        """Decide about the pulses in the queue, all of them if none follows: `final`."""
        while self._queue and not self.lost and (
                self._take_regular(final) or self._decide(final)):
            self.lost |= self._model.irregular

    @property
    def tooth(self) -> int:
        """Return the number of the tooth of the latest true pulse."""
        return replace(self._lock, slot=self.slot).tooth

    def fits(self, gap: float) -> bool:
        """Whether a pulse at this interval (s) from the last one would be regular."""
        expected = math.exp(self._model.expected) * float(self._lock.widths[self.slot])
        return abs(gap / expected - 1.0) <= max(self._model.tolerance, _FITS)

    def _drop(self, kind: str, at: int = 0) -> None:
        """Drop a waiting pulse."""
        pulse = self._queue.pop(at)
        self._recent.append(pulse)
        self._verdicts.reject(pulse, kind)
        if kind != 'unlocked':
            self._sink.drop()

    # --- regular pulses ---

    def _take_regular(self, final: bool) -> int:
        """Accept the pulses up to the first doubtful one; return their number."""
        lock, model = self._lock, self._model
        room = min(model.room, self._room_of_marks)
        pulses, (steps, widths, believed) = self._queue[:room + 1], lock.lists
        size = len(steps)
        slots = [number % size for number in range(self.slot, self.slot + len(pulses))]
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
            self._sink.extend(taken, [steps[slot] for slot in slots])
            self._verdicts.counts['accepted'] += count
            model.accept(levels, gaps[:count])
            self._lacking = []
            if size == 1:
                self._look_at_turns(levels)
            self._recent.extend(taken)
            self.slot = (slots[-1] + 1) % size
            self.confirmed = taken[-1]
            self._note(slots, levels, taken)
            del self._queue[:count]
        return count

    def _look_at_turns(self, levels: list[float]) -> None:
        """Say that intervals of one mark are longer and shorter in turns."""
        self.levels += levels
        if self._probe or len(self.levels) < _TURNS:
            return
        every = np.array(self.levels)
        pattern = mark_pattern(np.arange(every.size) % 2, every, 2, significant=_SURE_TURNS)
        size = 0.0 if pattern is None else abs(float(pattern.widths[0]))
        self.levels = []
        if size < _LEAST_TURNS or self._alternates or self._model.has_tick:
            return
        self._alternates = True
        usual = math.exp(0.5 * sum(self._model.recent[-2:]))
        self._verdicts.say(
            f'the pulse intervals are longer and shorter in turns, {usual * math.exp(size):.6g} s '
            f'and {usual * math.exp(-size):.6g} s: are they pulses of two keyphasors of one name, '
            'or of two marks (pulses_per_revolution)? A load that repeats every two revolutions '
            'does the same')

    def _note(self, slots: list[int], levels: list[float], times: list[float]) -> None:
        """Note the intervals behind these slots and when they end; learn the marks from many."""
        lock = self._lock
        if lock.steps.size == 1:
            return
        self.slots += slots
        self.levels += levels
        self.times += times
        if self._room_of_marks <= 0:
            self._lock = lock.with_pattern(
                mark_pattern(np.array(self.slots, np.int64), np.array(self.levels),
                             lock.steps.size), weight=1.0 / min(2 + self._learnt, 8))
            self._learnt += 1
            self.slots, self.levels, self.times = [], [], []

    # --- doubtful pulses ---

    def _decide(self, final: bool) -> bool:
        """Judge the first waiting pulse, which is doubtful; False if the next one is needed."""
        queue, model = self._queue, self._model
        expected = math.exp(model.expected) * float(self._lock.widths[self.slot])
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
        _, widths, believed = self._lock.lists
        given = [max(item, self._options.tolerance) for item in believed]
        rules = PathRules(
            widths, model.scatter, given, self._options.maximum_missing, model.expected,
            model.predictions, model.tick, model.degrees)
        paths = [Path(0.0, self.confirmed, self.slot, recent=model.recent, using=model.chosen)]
        for number, pulse in enumerate(queue[:_MOST_WAITING]):
            paths = rules.extend(paths, pulse)
            if (number or len(queue) == 1) and self._commit(paths, final):
                return True
        if len(queue) >= _MOST_WAITING:
            self.lost = True
            return True
        if final:
            self._drop('unlocked')
        return final

    def _is_of_clock(self) -> bool:
        """Whether the ticks of a clock explain the next two intervals, which are regular then."""
        model, (_, every, _) = self._model, self._lock.lists
        size, slot, last, expected = len(every), self.slot, self.confirmed, model.expected
        gaps, widths = [], []
        for pulse in () if model.given else self._queue[:2]:
            passed = self._slots_in(pulse - last, expected, slot)
            if not 0 < passed <= 1 + self._options.maximum_missing:
                return False
            gaps.append(pulse - last)
            widths.append(sum(every[(slot + number) % size] for number in range(passed)))
            slot, last = (slot + passed) % size, pulse
        return bool(gaps) and model.explains(np.array(gaps), np.array(widths), last)

    def _commit(self, paths: list[Path], final: bool) -> bool:
        """Decide about the first pulses if the likely paths agree about them."""
        near = likely(paths)
        if self._model.hides_missing:
            near = [path for path in near if path.steps[0].passed == 1] or near
        best = near[0]
        passed, first = best.passed, best.steps[0]
        if all(path.steps[0].passed == first.passed for path in near):
            if first.passed == 0:
                if not (any(passed) or final):  # strays come between true pulses
                    return False
                self._drop_stray()
                return True
            if first.passed == 1 and (abs(first.off) <= self._tolerance or (
                    self._model.unsteady and not first.jumps)):
                self._accept(first.level)
                return True
            later = [step.level for step in best.steps[1:] if step.passed]
            if not later and not final:
                return False
            self._irregular(first.passed, first.level, first.off, later[0] if later else None)
            return True
        count = len(passed)
        if count < 3 or not (passed[-1] and passed[-2]):
            return False
        if any(one.passed[-2:] != passed[-2:] or sum(one.passed) != sum(passed) for one in near):
            return False
        # Which of the pulses before is true makes no difference to these two.
        skipped = sum(passed[:-1])
        for _ in range(count - 2):
            self._drop('early')
        slots, _ = self._next_slots(skipped)
        gap = self._queue[0] - self.confirmed
        level = math.log(gap / float(self._lock.widths[slots].sum()))
        off = math.expm1(level - self._model.expected)  # a path that jumps miscounts them
        self._irregular(skipped, level, off, best.steps[-1].level)
        return True

    def _drop_stray(self) -> None:
        gap = self._queue[0] - self.confirmed
        expected = math.exp(self._model.expected) * float(self._lock.widths[self.slot])
        self._drop('doubles' if gap < 0.5 * expected else 'early')
        recent = np.diff(self._recent)
        mean = float(recent.mean()) if recent.size == _AGREEING else np.inf
        if (self._lock.even and mean < _FASTER * expected
                and np.all(np.abs(np.diff(recent))
                           < max(_AGREE, self._model.tolerance) * recent[1:])):
            self._verdicts.counts['relearnt'] += 1
            self.lost = True

    def _accept(self, level: float) -> None:
        """Accept the first waiting pulse, one slot after the last one."""
        slots, steps = self._next_slots(1)
        pulse = self._next(slots, level)
        self._model.accept([level])
        self._lacking = []
        self._sink.extend([pulse], [steps])

    def _irregular(self, passed: int, level: float, deviation: float, after: float | None) -> None:
        """
        Accept the first waiting pulse, whose interval needs an explanation.

        `after` is the level of the interval behind it, None if there is none.
        """
        model, tolerance = self._model, self._tolerance
        slots, steps = self._next_slots(passed)
        gap = self._queue[0] - self.confirmed
        if passed == 1 and after is not None and abs(math.expm1(level - model.level)) <= max(
                _RAMP, self._options.tolerance):
            low, high = sorted((model.level, after))
            if low - tolerance <= level <= high + tolerance:  # the speed changes
                pulse = self._next(slots, level)
                model.jump(level)
                self._sink.extend([pulse], [steps])
                return
        if passed > 1 and abs(deviation) <= tolerance:
            kind = 'missing_bridged' if self._options.bridge else 'missing_broken'
            self._verdicts.counts[kind] += passed - 1
            self._verdicts.rejected += [(self.confirmed + gap * number / passed, 'missing')
                                        for number in range(1, min(passed, _MOST_WAITING))]
            pulse = self._next(slots, level)
            model.accept([level])
            if self._lacks_alike(passed, gap) or not self._options.bridge:
                self._sink.begin(pulse, 0, passed=steps)
            else:
                self._sink.extend([pulse], [steps])
            return
        self._verdicts.reject(self._queue[0], 'late')
        across = self._slots_in(gap, model.level, self.slot)
        if after is not None and across != self._slots_in(gap, after, self.slot):
            across = 0
        known = across == passed or (passed == 1 and after is not None and across > 0)
        if known:
            slots, steps = self._next_slots(across)
        # A step of the time may be whole by chance: uneven marks tell which of them comes next.
        long = gap > _LONG * float(self._lock.widths.sum()) * math.exp(model.level)
        alike = self._lock.even and bool(np.all(self._lock.widths == 1.0))
        if (not known or long) and (self._probe or not alike):
            self.lost = True
            return
        if after is not None and abs(after - model.level) > tolerance:
            self._verdicts.counts['relearnt'] += 1
            self.report_change(gap, model.level, after)
        pulse = self._next(slots, level if len(slots) == 1 and known else math.nan)
        if after is not None:
            model.jump(after)
        self._sink.begin(pulse, 0, passed=steps if known else None)

    def _lacks_alike(self, passed: int, gap: float) -> bool:
        """Take the latest interval for the usual one if many have lacked as many pulses."""
        self._lacking = [*self._lacking, passed] if passed in self._lacking else [passed]
        if len(self._lacking) < _LACKING:
            return False
        level = self._model.level
        self.report_change(gap, level, level + math.log(passed))
        self._verdicts.counts['relearnt'] += 1
        self._model.jump(level + math.log(passed))
        self._lacking = []
        return True

    def report_change(self, gap: float, before: float, after: float) -> None:
        """Say that the interval changed across a gap (s) as no shaft changes it."""
        old, new = math.exp(before), math.exp(after)
        if self._probe or gap > _SHORT * max(old, new) or abs(after - before) < _CHANGED:
            return
        why = ('did another keyphasor take over, or the pulses of several marks become visible? '
               'interval_tolerance 1 accepts every pulse of a machine that turns so unevenly')
        if abs(new / old - 0.5) < _NEAR:
            why = ('twice as many pulses come: is there a second keyphasor of the same name, or '
                   'are both edges of a mark detected?')
        elif abs(old / new - 0.5) < _NEAR:
            why = 'every other pulse is missing: is the threshold of the detector too high?'
        self._verdicts.say(
            f'the pulse interval changes from {old:.4g} s to {new:.4g} s at {self.confirmed:.6f} '
            f's, faster than a shaft can change its speed: {why}')

    @property
    def _tolerance(self) -> float:
        """Largest deviation of a regular interval from the last pulse."""
        return max(self._model.tolerance, float(self._lock.believed[self.slot]))

    def _next_slots(self, count: int) -> tuple[list[int], int]:
        """Return the next `count` slots, and the teeth that they span."""
        slots = [(self.slot + k) % self._lock.steps.size for k in range(count)]
        return slots, int(self._lock.steps[slots].sum())

    def _next(self, slots: list[int], level: float) -> float:
        """Take the first pulse out of the queue as the one at the end of these slots."""
        if self._lock.steps.size == 1:
            self.levels, self._alternates = [], False
        pulse = self._queue.pop(0)
        self._recent.append(pulse)
        self._verdicts.counts['accepted'] += 1
        self.confirmed = pulse
        self.slot = (slots[-1] + 1) % self._lock.steps.size
        if len(slots) > self._lock.steps.size:  # a gap of more than a revolution
            self.slots, self.levels, self.times = [], [], []
        else:
            self._note(slots, [level if len(slots) == 1 else math.nan] * len(slots),
                       [pulse] * len(slots))
        return pulse

    def _slots_in(self, gap: float, level: float, slot: int) -> int:
        """Return how many slots a gap (s) from `slot` on has at a level, 0 if no whole one."""
        ends = np.append(0.0, np.cumsum(np.roll(self._lock.widths, -slot)))
        turns, rest = divmod(gap / math.exp(level), float(ends[-1]))
        apart = np.abs(ends - rest)
        if not (turns <= _LONGEST_GAP and apart.min() <= NEAR_WHOLE):  # nor NaN
            return 0
        return int(turns) * self._lock.widths.size + int(np.argmin(apart))

    @property
    def _room_of_marks(self) -> int:
        """Return the number of intervals until the angles between marks are learnt."""
        size = self._lock.steps.size
        if size == 1 or self._probe:
            return _NEVER
        return REVOLUTIONS * size + 1 - len(self.levels)
