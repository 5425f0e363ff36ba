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
Judges pulses by what the shaft can do: finds a sequence, follows it, and finds it again.

`pulse_start` finds the first pulses and the speed, `pulse_follower` decides which of the next ones
are true. If nothing explains ten pulses, the match is lost and a start is looked for again. With
the tolerance 1 all pulses are taken for true, as is right for a clean encoder on a shaft whose
speed changes from one pulse to the next by more than a shaft is expected to.
"""

from dataclasses import replace
import math

from sa_jitter_ros.pulses.loose_marks import LooseMarks
from sa_jitter_ros.pulses.mark_corrector import PulseSink
from sa_jitter_ros.pulses.pulse_follower import JudgeOptions, NEAR_WHOLE, PulseFollower
from sa_jitter_ros.pulses.pulse_start import End, new_model, PulseStart
from sa_jitter_ros.pulses.target import Lock, Target
from sa_jitter_ros.pulses.verdicts import Verdicts

_SAME_SCATTER = 2.0  # ratio up to which the scatter before a gap is that after it
_KNOWN_WELL = 16  # intervals that tell the scatter better than the first ones behind a gap

#: What is said of a speed that hides them.
HIDDEN = ('the speed scatters so much from one pulse to the next that a stray or a missing one '
          'does not show')


class PulseJudge:
    """
    Judge pulses in order of time and pass the valid ones on to a trigger counter.

    `last` is the latest pulse (s) not dropped, `confirmed` the latest that was accepted.
    """

    def __init__(self, target: Target, counter: PulseSink, options: JudgeOptions,
                 verdicts: Verdicts) -> None:
        self._target, self._counter, self._options = target, counter, options
        self._every, self.verdicts = options.tolerance == 1.0, verdicts
        self._model = new_model(target, options)
        self.forget()

    def forget(self) -> None:
        """Forget the interval and the match: the next pulses begin a new sequence."""
        self._counter.stop(known=False)
        self._queue: list[float] = []
        self._start = PulseStart(self._target, self._queue, self._options, self.verdicts)
        self._follower: PulseFollower | None = None
        self._end: End | None = None
        self._confirmed = -math.inf
        self._loose = LooseMarks(self._target, self.verdicts)

    @property
    def confirmed(self) -> float:
        """Time (s) of the latest pulse that was accepted."""
        return self._confirmed if self._follower is None else self._follower.confirmed

    @property
    def last(self) -> float:
        """Time (s) of the latest pulse that was not dropped."""
        return self._queue[-1] if self._queue else self.confirmed

    @property
    def hides_missing(self) -> bool:
        """Whether the speed scatters so much that strays and missing pulses do not show."""
        return self._every or bool(self._model.hides_missing)

    @property
    def waiting(self) -> int:
        """Return the number of pulses not yet judged."""
        return len(self._queue)

    def take(self, pulses: list[float]) -> None:
        """Take the next pulses in s, in order of time, none before the last one."""
        least, last, waited = self._options.minimum_interval, self.last, len(self._queue)
        for pulse in pulses:
            if pulse - last < least or pulse == last:
                self.verdicts.reject(pulse, 'doubles')
            else:
                self._queue.append(pulse)
                last = pulse
        if self._every:
            self._pass_all()
            return
        self._loose.update(self._queue[waited:])
        self._run(final=False)

    def flush(self) -> None:
        """Judge the pulses that wait, because none follows."""
        self._run(final=True)

    def fits(self, gap: float) -> bool:
        """Whether a pulse at this interval (s) from the last one would be regular."""
        return self._every or (self._follower is not None and self._follower.fits(gap))

    def drop_later(self, time: float, most: int) -> int:
        """Drop the waiting pulses after a time (s) if they are `most` or fewer; their number."""
        later = sum(pulse > time for pulse in self._queue)
        if not 0 < later <= most:
            return 0
        del self._queue[-later:]
        self._start.drop_later()
        return later

    def _pass_all(self) -> None:
        """Take the pulses of the queue for true."""
        pulses = self._queue[:]
        if not pulses:
            return
        self.verdicts.counts['accepted'] += len(pulses)
        if not math.isfinite(self._confirmed):
            self._counter.begin(pulses.pop(0), 0)
        self._counter.extend(pulses, [1] * len(pulses))
        self._confirmed = self._queue[-1]
        self._queue.clear()

    def _run(self, *, final: bool) -> None:
        while self._queue:
            if self._follower is None:
                lock = self._start.find(self._end, final=final)
                if lock is None:
                    return
                self._follower = self._begun(lock)
            self._follower.follow(final=final)
            if not self._follower.lost:
                return
            self._lose(self._follower)

    def _lose(self, follower: PulseFollower) -> None:
        """Discard the trigger cycle and match the target again from the waiting pulses on."""
        model, known = self._model, int(self._model.degrees)
        soon = model.taken < _KNOWN_WELL  # what is lost so may have other intervals
        self._start.failed = self._start.failed + 1 if soon else 0
        self._end = None if model.irregular else End(
            follower.confirmed, model.level, model.scatter,
            known // 2 if soon else known, follower.tooth, model.unsteady)
        self._confirmed, self._follower = follower.confirmed, None
        self._counter.stop()

    def _begun(self, lock: Lock) -> PulseFollower:
        """Begin a sequence at the first waiting pulse."""
        first, end = self._queue[0], self._end
        passed = None
        if end is not None:
            gap = first - end.time
            teeth = [gap / math.exp(level) for level in (end.level, math.log(lock.interval))]
            number = round(teeth[0]) if math.isfinite(teeth[0]) else 0
            # An index tells the tooth, whatever the gap between uneven marks says.
            fits = lock.even or (end.tooth + number - lock.tooth) % int(lock.steps.sum()) == 0
            if number and fits and max(abs(item - number) for item in teeth) <= NEAR_WHOLE:
                passed = number
            known_better = end.known >= max(_KNOWN_WELL, lock.known)
            if known_better or 1.0 / _SAME_SCATTER < lock.scatter / end.scatter < _SAME_SCATTER:
                lock = replace(lock, scatter=end.scatter, known=max(lock.known, end.known))
        self._counter.begin(first, lock.tooth, passed=passed)
        follower = PulseFollower(lock, self._queue, self._model, options=self._options,
                                 sink=self._counter, verdicts=self.verdicts)
        if self.hides_missing:
            self.verdicts.say(f'{HIDDEN}: all are taken for true')
        if end is not None:
            follower.report_change(first - end.time, end.level, math.log(lock.interval))
        self._end = None
        return follower
