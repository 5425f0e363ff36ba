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
The limits of a machine: which orders, bearing orders and condition indicators have passed theirs.

A value passes a limit when its 95 % interval lies above it, and is back when the interval lies
below it: a value exactly at a limit crosses it by chance once in 40 averages in each direction.
Raw values, where there is no correction, pass limits like corrected ones, because jitter makes
amplitudes smaller; but they end nothing that a corrected one has begun.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
import math
from typing import Any

import numpy as np
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.averaging.indicators import INDICATORS
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.machine import LEVELS, Limit, Machine
from sa_jitter_ros.monitoring.quantities import in_words, Layout, MonitoredAverage, part_of
from sa_jitter_ros.number_text import HALF_95, measured_text

#: Of a number of channels, the names that a limit may call each.
Labels = Callable[[int], Sequence[Sequence[str]]]

_PARAMETERS = {'order': 'orders', 'bearing': 'bearing_orders', 'indicator': 'mesh_orders'}
_SAME = 1e-5  # by which an order may differ from that of a limit, relative


@dataclass(frozen=True)
class PassedLimit:
    """
    A limit that a value has passed, `since` when at this `level`.

    `limit` is its name, `what` the `quantity` (kind, name) in words, `bound` the limit in the unit
    of the value, `times` that of the `baseline`, NaN where it is absolute, or not known.
    """

    limit: str
    shaft: str
    channel: int
    what: str
    quantity: tuple[str, str]
    level: str
    value: float
    error: float
    bound: float
    times: float
    baseline: float
    is_corrected: bool
    since_sequence: int
    since_time: float

    def content(self) -> dict[str, Any]:
        """Return the object of the topic `change`; `change` is against the baseline."""
        return {'shaft': self.shaft, 'channel': self.channel, 'kind': 'limit', 'name': self.what,
                'change': self.value / self.baseline - 1.0,
                'standard_error': self.error / self.baseline,
                'since_sequence': self.since_sequence, 'since_time': self.since_time,
                'keyphasor_share': math.nan, 'p_value': math.nan, 'level': self.level,
                'limit': self.bound, 'value': self.value, 'value_error': self.error,
                'limit_name': self.limit}

    def __str__(self) -> str:
        """Return it in words."""
        return self.words(f'average {self.since_sequence}')

    def words(self, since: str) -> str:
        """
        Return it in words, with what it is `since`.

        >>> PassedLimit('mesh', 'input', 0, 'mesh input-output 1x', ('order', '19'),
        ...             'alarm', 0.913, 0.016, 0.8, 4.0, 0.2, True, 812, 9.5).words('day 3')
        'mesh input-output 1x of input, channel 0: 0.913 +- 0.031 above 0.8 (alarm, 4 times the \
baseline), since day 3'
        """
        value = measured_text(self.value, HALF_95 * self.error).replace('±', '+-')
        times = f', {self.times:g} times the baseline' if math.isfinite(self.times) else ''
        return (f'{self.what} of {self.shaft}, channel {self.channel}: {value} above '
                f'{self.bound:.4g} ({self.level}{times}), since {since}')


@dataclass(frozen=True)
class _Watched:
    """A limit of a shaft: of an order and the kinds of quantities that it may be, or by name."""

    shaft: str
    limit: Limit
    kinds: tuple[str, ...]
    order: float

    def is_of(self, kind: str, name: str) -> bool:
        """Return whether the limit is that of a quantity."""
        return kind in self.kinds and (
            name == self.limit.indicator if kind == 'indicator'
            else abs(float(name) - self.order) <= _SAME * self.order)


class LimitWatch:
    """
    Which limits of a machine are passed, by the averages of its `shafts`.

    `named` are the names of channels that limits may call, beside numbers from 0, None where they
    are not known yet; `labels` says which those are, `since` what the number of an average means.
    Raises ParameterError, in one line, for limits of shafts, parts, channels and indicators that
    are unknown.
    """

    def __init__(self, machine: Machine, shafts: Sequence[str],
                 named: Sequence[str] | None = None, *, labels: Labels | None = None,
                 since: Callable[[int], str] = 'average {}'.format) -> None:
        self._labels = labels or (lambda count: [[str(place)] for place in range(count)])
        self._since = since
        self._machine = machine
        self._limits: dict[str, _Watched] = {}
        self._passed: dict[tuple[str, int], PassedLimit] = {}
        #: Why limits are not watched, by their names.
        self.missing: dict[str, str] = {}
        for name, limit in machine.limits.items():
            place = f'machine.limits.{name}'
            if limit.indicator not in (None, *INDICATORS):
                raise ParameterError(f'{place}.indicator is {limit.indicator!r}, which is '
                                     f'unknown: give one of {", ".join(INDICATORS)}')
            if named is not None and limit.channel not in (None, *named) and (
                    not limit.channel.isdecimal()):
                raise ParameterError(
                    f'{place}.channel is {limit.channel!r}, which is unknown: give one of '
                    f'machine.channels ({", ".join(named) or "none is declared"}), or a number '
                    'from 0')
            shaft = _shaft_of(place, limit, machine, shafts)
            kinds: tuple[str, ...] = ('indicator',) if limit.indicator else ('order', 'bearing')
            if limit.part:
                kinds = kinds[limit.part in machine.bearing_orders(shaft):][:1]
            self._limits[name] = _Watched(shaft, limit, kinds, (
                machine.orders(shaft)[limit.part] if limit.part else limit.order or math.nan))
            if shaft not in shafts:
                self.missing[name] = f'{shaft} is not monitored: add it to shafts'

    @property
    def names(self) -> list[str]:
        """Return the names of the limits."""
        return [*self._limits]

    def warnings(self) -> list[str]:
        """Return which limits are not watched, and why."""
        return [f'limit {name}: {reason}' for name, reason in self.missing.items()]

    def passed(self, shaft: str = '') -> list[PassedLimit]:
        """Return the limits that are passed, of one shaft or all, alarms first."""
        return sorted((item for item in self._passed.values() if shaft in ('', item.shaft)),
                      key=lambda item: (item.level != LEVELS[-1], -item.value / item.bound))

    def update(self, shaft: str, average: MonitoredAverage, usual: FloatArray | None = None
               ) -> list[str]:
        """
        Take the next average; return lines that say which limits were passed and are no longer.

        `usual` (channel, quantity) is the baseline of its readings, NaN where it is not complete.
        """
        usual = np.full(average.layout.shape, np.nan) if usual is None else usual
        lines = []
        for name, item in self._limits.items():
            if item.shaft != shaft:
                continue
            channels, quantity = self._places(item, average.layout)
            self.missing.pop(name, None)
            if not channels:
                names = [label[-1] for label in self._labels(average.layout.channels)]
                self.missing[name] = f'no channel {item.limit.channel} among {", ".join(names)}'
            elif quantity is None:
                self.missing[name] = (f'the averages of {shaft} lack {item.limit.what}: see '
                                      f'{shaft}.{_PARAMETERS[item.kinds[0]]}')
            else:
                values, noise = average.readings[:2, channels, quantity]
                if np.isfinite(values).any() and not np.isfinite(values + noise).any():
                    self.missing[name] = (f'{item.limit.what} of {shaft} has no standard error: '
                                          'take more trigger cycles')
                for channel in channels:
                    lines += self._judge(name, channel, quantity, average,
                                         float(usual[channel, quantity]))
        return lines

    def bounds(self, shaft: str, layout: Layout, channel: int, quantity: int) -> list[
            tuple[str, float, bool]]:
        """Return level, bound and whether it is relative of all limits of a quantity."""
        return [(level, bound, bool(item.limit.relative)) for item in self._limits.values()
                if item.shaft == shaft for level, bound in item.limit.bounds.items()
                for channels, place in [self._places(item, layout)]
                if channel in channels and place == quantity]

    def _places(self, item: _Watched, layout: Layout) -> tuple[list[int], int | None]:
        """Return the places of a limit: of its channels, and of its quantity if there is one."""
        return [place for place, known in enumerate(self._labels(layout.channels))
                if item.limit.channel in (None, *known)], next(
            (place for place, quantity in enumerate(layout.quantities) if item.is_of(*quantity)),
            None)

    def _judge(self, name: str, channel: int, quantity: int, average: MonitoredAverage,
               usual: float) -> list[str]:
        """Judge one value by a limit; return the line that says so if its level is another."""
        shaft, limit = self._limits[name].shaft, self._limits[name].limit
        before = self._passed.get((name, channel))
        value, noise, doubt, corrected = average.readings[:, channel, quantity].tolist()
        error = math.sqrt(noise + doubt**2)
        scale = usual if limit.relative else 1.0
        if not math.isfinite(value + error + scale) or (
                before is not None and before.is_corrected and not corrected):
            return []
        level = _level(value, HALF_95 * error, {
            level: scale * bound for level, bound in limit.bounds.items()}, before)
        if not level:
            gone = self._passed.pop((name, channel), None)
            return [f'{gone.what} of {shaft}, channel {channel} is below its limits again'
                    ] if gone else []
        kind, label = average.layout.quantities[quantity]
        same = before is not None and before.level == level
        since = (before.since_sequence, before.since_time) if before is not None and same else (
            average.header.sequence, average.header.start_time)
        self._passed[name, channel] = found = PassedLimit(
            name, shaft, channel, part_of(self._machine, shaft, kind, label) or in_words(
                kind, label), (kind, label), level, value, error, scale * limit.bounds[level],
            limit.bounds[level] if limit.relative else math.nan, usual, bool(corrected), *since)
        return [] if same else [found.words(self._since(found.since_sequence))]


def _level(value: float, half: float, bounds: Mapping[str, float], before: PassedLimit | None
           ) -> str:
    """Return the highest level whose bound is passed, or still is; '' for none."""
    held = 0 if before is None else 1 + LEVELS.index(before.level)
    return next((level for level in LEVELS[::-1] if level in bounds and (
        value - half > bounds[level] or (
            level in LEVELS[:held] and value + half >= bounds[level]))), '')


def _shaft_of(place: str, limit: Limit, machine: Machine, shafts: Sequence[str]) -> str:
    """Return the shaft of a limit, a monitored one if it names none; raises ParameterError."""
    known = dict.fromkeys((*shafts, *machine.shafts))
    having = [shaft for shaft in known if not limit.part or (
        shaft in machine.shafts and limit.part in machine.orders(shaft))]
    if limit.shaft is not None and limit.shaft not in having:
        raise ParameterError(
            f'{place}.shaft is {limit.shaft!r}, which ' + (
                f'has no {limit.part}' if limit.shaft in known else 'is unknown')
            + f': give one of {", ".join(having)}')
    monitored = [shaft for shaft in having if shaft in shafts] or having
    if limit.shaft is None and len(monitored) > 1:
        raise ParameterError(f'{place} is of which shaft? give shaft, one of '
                             f'{", ".join(monitored)}')
    return limit.shaft or monitored[0]
