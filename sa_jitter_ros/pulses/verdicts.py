# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""What was decided about pulses, in numbers and in words."""

from collections import deque
from dataclasses import astuple, dataclass
from operator import add

#: Latest pulses that were rejected, or are missing, of which times and reasons are kept.
REMEMBERED = 2000
_MESSAGES = 10  # that wait
_ALIKE = 8  # strays, each behind as many pulses as the one before, that are no chance


@dataclass(frozen=True)
class PulseCounts:
    """
    Number of pulses so far, by what the validation decided.

    `accepted` pulses are regular, end a gap or start a run. Missing pulses are those that did not
    arrive: interpolated (`missing_bridged`) or the end of a run (`missing_broken`). `late` pulses
    start a run. All others were dropped; `unlocked` ones because no steady interval was known yet.
    `relearnt` counts changes of speed within one or two intervals, `cycles_discarded` trigger
    cycles that began and were lost, `restarts` how often time ran back, `geometry_refused` how
    often the pulses did not fit what was known of the target's marks. `displaced` pulses, of
    whatever kind, are those of a loose mark (`loose_marks`).
    """

    accepted: int = 0
    doubles: int = 0
    missing_bridged: int = 0
    missing_broken: int = 0
    early: int = 0
    late: int = 0
    out_of_order: int = 0
    restarts: int = 0
    non_finite: int = 0
    unlocked: int = 0
    relearnt: int = 0
    cycles_discarded: int = 0
    geometry_refused: int = 0
    displaced: int = 0

    def __add__(self, other: 'PulseCounts') -> 'PulseCounts':
        """Return the counts of both."""
        return PulseCounts(*map(add, astuple(self), astuple(other)))


class Verdicts:
    """
    The `counts` of all kinds of pulses, the latest that were `rejected`, and `messages`.

    `rejected` are pulses (s) that were not taken as they came, each with the count that it is in,
    and where pulses are missing. The target has so many `marks`, 0 for unknown.
    """

    def __init__(self, marks: int = 0) -> None:
        self._marks, self._apart, self._alike, self._before = marks, 0, 0, 0  # of strays
        self.counts = dict.fromkeys(PulseCounts.__dataclass_fields__, 0)
        self.rejected: deque[tuple[float, str]] = deque(maxlen=REMEMBERED)
        self.messages: list[str] = []

    def reject(self, pulse: float, kind: str) -> None:
        """Count a pulse (s) that is not taken as it came."""
        self.counts[kind] += 1
        self.rejected.append((pulse, kind))
        if kind not in ('doubles', 'early'):
            return
        apart, self._before = self.counts['accepted'] - self._before, self.counts['accepted']
        self._alike = self._alike + 1 if apart == self._apart else 1
        self._apart = apart
        if self._alike == _ALIKE and 1 < apart != self._marks:
            self.say(f'a stray comes after every {apart} pulses, as from an extra mark, the index '
                     f'of a wheel of {apart} marks: is pulses_per_revolution {apart}?')

    def say(self, message: str) -> None:
        """Keep a message, and the latest before it."""
        self.messages = [*self.messages, message][-_MESSAGES:]
