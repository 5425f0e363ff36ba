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
What came last, and what stays away: the ages of a node's data on the steady clock.

A `Flow` is one kind of data that a node takes or makes. `Health` holds those of one node, judges
their silence and says once when it begins, grows and ends. It knows nothing of ROS.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
import math
import time

_SHOWN = 6  # problems in the message of a status
ERROR_FACTOR = 3.0  # silence is an error after so many times the time that makes it a warning


def first_of(lines: Sequence[str]) -> str:
    """
    Return the first lines in one, and how many there are beside them.

    >>> first_of([f'problem {number}' for number in range(1, 9)])[-21:]
    'problem 6; and 2 more'
    """
    more = f'; and {len(lines) - _SHOWN} more' if len(lines) > _SHOWN else ''
    return '; '.join(lines[:_SHOWN]) + more


class Level(IntEnum):
    """Severity, numbered as in `diagnostic_msgs/DiagnosticStatus`."""

    OK = 0
    WARN = 1
    ERROR = 2


@dataclass
class Flow:
    """
    Data of one kind: `name` is that of its age in the diagnostics, `what` its topic or a noun.

    `look_at` says where the cause of silence may lie, `cause` what is known of it. Silence is
    judged if `judged`. It counts from `since` or the last data. What is made of other flows,
    `after`, is judged while these flow: `since` is when they began. Silence may last `allowance`
    (s) longer than that of others. Data that come `once` are not repeated: they last while their
    publisher is there (`lasts`). What is `optional` is missed only after it came.
    """

    name: str
    what: str
    look_at: str = ''
    judged: bool = True
    after: tuple[str, ...] = ()
    once: bool = False
    optional: bool = False
    allowance: float = 0.0
    cause: str = ''
    since: float = field(default_factory=lambda: time.monotonic())
    last: float = math.nan
    reported: Level = Level.OK
    reported_at: float = -math.inf

    def came(self) -> None:
        """Note that data came now."""
        self.last = time.monotonic()

    def lasts(self) -> None:
        """Note that the publisher of what came once is there now."""
        if not math.isnan(self.last):
            self.since = time.monotonic()

    @property
    def age(self) -> float:
        """Seconds since the last data, NaN before the first."""
        return time.monotonic() - self.last

    @property
    def silence(self) -> float:
        """Seconds since the last data, or since they could come."""
        return time.monotonic() - (self.last if self.last > self.since else self.since)

    def level(self, stale_after: float) -> Level:
        """Return how severe the silence is."""
        if stale_after <= 0.0 or not self.judged or (
                self.optional and math.isnan(self.last)):
            return Level.OK
        silence = self.silence - self.allowance
        if silence > ERROR_FACTOR * stale_after:
            return Level.ERROR
        return Level.WARN if silence > stale_after else Level.OK

    def problem(self) -> str:
        """Return what is silent, and where to look."""
        silence = (f'since the start {self.silence:.0f} s ago'
                   if math.isnan(self.last) and not self.after else f'for {self.silence:.0f} s')
        return f'no {self.what} {silence}: {self.cause or self.look_at}'


class Health:
    """The flows of one node by name."""

    def __init__(self) -> None:
        self.flows: dict[str, Flow] = {}
        self._flowing = False

    def add(self, flow: Flow) -> Flow:
        """Watch a flow; return it."""
        self.flows[flow.name] = flow
        return flow

    def ages(self) -> dict[str, str]:
        """
        Return the age of each flow in s as a text, `nan` before its first data.

        Flows that never came and are not judged, or optional, mean nothing to the node.
        """
        return {f'{flow.name}_age': f'{flow.age:.1f}' for flow in self.flows.values()
                if (flow.judged and not flow.optional) or not math.isnan(flow.last)}

    def silent(self, stale_after: float) -> list[tuple[Level, Flow]]:
        """Return the silent flows, the worst first."""
        for flow in self.flows.values():
            causes = [self.flows[name] for name in flow.after]
            if any(math.isnan(item.last) or item.level(stale_after) for item in causes):
                flow.since = time.monotonic()
        found = [(flow.level(stale_after), flow) for flow in self.flows.values()]
        return sorted((item for item in found if item[0]), key=lambda item: -item[0])

    def changes(self, silent: Iterable[tuple[Level, Flow]]) -> list[tuple[Level, str]]:
        """Return the lines for the log: what became silent, or continues, since the last call."""
        now = {flow.name: level for level, flow in silent}
        lines = []
        for flow in self.flows.values():
            level = now.get(flow.name, Level.OK)
            if level > flow.reported:
                lines.append((level, flow.problem()))
                flow.reported, flow.reported_at = level, time.monotonic()
            elif flow.reported and flow.last > flow.reported_at:
                flow.reported = level
                if self._flowing:
                    lines.append((Level.OK, f'{flow.what} continues'))
        arrived = [flow for flow in self.flows.values()
                   if flow.judged and not (flow.after or flow.optional)]
        if not self._flowing and arrived and not any(math.isnan(flow.last) for flow in arrived):
            self._flowing = True
            lines.append((Level.OK, f'data flow: {", ".join(flow.what for flow in arrived)}'))
        return lines
