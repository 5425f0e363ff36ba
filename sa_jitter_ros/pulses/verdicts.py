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

#: Latest pulses that were rejected, or are missing, of which times and reasons are kept.
REMEMBERED = 2000
_MESSAGES = 10  # that wait
_ALIKE = 8  # strays, each behind as many pulses as the one before, that are no chance


class Verdicts:
    """
    The `counts` of all kinds of pulses, the latest that were `rejected`, and `messages`.

    `rejected` are pulses (s) that were not taken as they came, each with the count that it is in,
    and where pulses are missing. The target has so many `marks`, 0 for unknown.
    """

    def __init__(self, marks: int = 0) -> None:
        self._marks, self._apart, self._alike, self._before = marks, 0, 0, 0  # of strays
        self.counts = dict.fromkeys(
            ('accepted', 'doubles', 'missing_bridged', 'missing_broken', 'early', 'late',
             'unlocked', 'relearnt', 'displaced', 'out_of_order', 'restarts', 'non_finite'), 0)
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
