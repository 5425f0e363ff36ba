# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The limits of a machine: what is a warning and what an alarm, by the names of its parts."""

from dataclasses import dataclass
from typing import ClassVar

from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.machine.parts import Part
from sa_jitter_ros.parameters import Parameter

LEVELS = ('warn', 'alarm')
_OF = ('order', 'part', 'indicator')


@dataclass(frozen=True)
class Limit(Part):
    """
    A limit of an order, of what a part of the machine makes, or of a condition indicator.

    `warn` and `alarm` are in the unit of the channel, `relative` ones times the baseline. Without
    `channel`, a name or a number, all are meant; without `shaft` the only one that has it.
    """

    order: float | None = None
    part: str | None = None
    indicator: str | None = None
    shaft: str | None = None
    channel: str | None = None
    warn: float | None = None
    alarm: float | None = None
    relative: bool | None = None
    KINDS: ClassVar = {
        'order': Parameter('order', 0.0, 'a multiple of the speed of the shaft', above=0.0),
        **{name: Parameter(name, '', f'name of a {name}')
           for name in ('part', 'indicator', 'shaft', 'channel')},
        **{name: Parameter(name, 0.0, 'a limit', above=0.0) for name in LEVELS},
        'relative': Parameter('relative', False, 'times the baseline')}

    def check(self, place: str) -> None:
        """Check the values; raises ParameterError, which names the place in the file."""
        super().check(place)
        given = [name for name in _OF if getattr(self, name) is not None]
        if len(given) != 1:
            raise ParameterError(f'{place} gives {" and ".join(given) or "no quantity"}: give one '
                                 f'of {", ".join(_OF)}')
        bounds = [*self.bounds.values()]
        if not bounds:
            raise ParameterError(f'{place} has neither warn nor alarm: give one, or both')
        if bounds[0] > bounds[-1]:
            raise ParameterError(f'{place}.warn is {self.warn:g}, above its alarm of '
                                 f'{self.alarm:g}: a warning comes first; are they swapped?')
        if self.relative and bounds[0] <= 1.0:
            raise ParameterError(f'{place} is relative and {bounds[0]:g}: give times the '
                                 'baseline, more than 1')

    @property
    def bounds(self) -> dict[str, float]:
        """Return the bounds that are given, by level."""
        return {level: value for level, value in zip(LEVELS, (self.warn, self.alarm))
                if value is not None}
