# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The change monitor of a machine: arrays of results in, changes of all its shafts out."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.averaging.results import AMPLITUDE_FIELDS, AverageMessage
from sa_jitter_ros.averaging.shortfall import Shortfall
from sa_jitter_ros.errors import MessageError, ParameterError, RecordingError
from sa_jitter_ros.json_values import json_values
from sa_jitter_ros.machine import Machine, UNKNOWN
from sa_jitter_ros.monitoring.baseline_file import (
    lock_baseline, new_files, read_baseline, set_aside, write_baseline)
from sa_jitter_ros.monitoring.limits import LimitWatch
from sa_jitter_ros.monitoring.monitor import Change, Settings, ShaftMonitor
from sa_jitter_ros.monitoring.operating import OperatingState
from sa_jitter_ros.monitoring.quantities import KINDS, Layout, monitored, MonitoredAverage

# Averages that wait for arrays that are on their way; older ones do without.
_WAITING = 4
# Averages without indicators after which a shaft is taken to have none.
_WITHOUT = 3
_ATTENUATION = AMPLITUDE_FIELDS.index('attenuation')


class Pairing:
    """
    Puts the arrays of one average together, which come on topics of their own.

    Each topic keeps its order: when an average is complete, those before it will not become more.
    Which kinds a shaft has is known from its `layout`, or when an average has waited in vain for
    the others. With `allow_uncorrected` raw amplitudes count where there are no corrected ones;
    what the keyphasor takes from them is known from the latest corrected average.
    """

    def __init__(self, layout: Layout | None = None) -> None:
        self.allow_uncorrected = False
        self._kinds = {*KINDS} if layout is None else {
            KINDS[0], *(KINDS[1:3] if layout.indicators else ()),
            *(KINDS[3:] if layout.bearings else ())}
        self._came: set[str] = set()
        self._left: FloatArray | None = None  # of amplitudes by jitter
        self._waiting: dict[tuple[int, float], dict[str, AverageMessage]] = {}

    def add(self, kind: str, message: AverageMessage) -> list[MonitoredAverage]:
        """
        Take an array; return the averages that are complete, or have waited long enough.

        Raises MessageError for arrays that do not fit each other.
        """
        key = message.header.sequence, message.header.start_time
        self._waiting.setdefault(key, {})[kind] = message
        self._came.add(kind)
        keys = [*self._waiting]
        count = max(len(keys) - _WAITING, 0)
        if count:
            self._kinds = self._came.copy()
        if self._waiting[key].keys() >= self._kinds:
            count = max(count, keys.index(key) + 1)
        return self._take(count)

    def flush(self) -> list[MonitoredAverage]:
        """Return the averages that still wait, when no more arrays come."""
        return self._take(len(self._waiting))

    def _take(self, count: int) -> list[MonitoredAverage]:
        ready = [self._waiting.pop(item) for item in [*self._waiting][:count]]
        return [self._whole(parts) for parts in ready if KINDS[0] in parts]

    def _whole(self, parts: dict[str, AverageMessage]) -> MonitoredAverage:
        left = parts[KINDS[0]].values[..., _ATTENUATION]
        if self._left is None or left.shape != self._left.shape or np.isfinite(left).any():
            self._left = left
        return monitored(parts, allow_uncorrected=self.allow_uncorrected, left=self._left)


class MachineMonitor:
    """
    The monitors of the shafts of a machine, whose baseline is kept in a file.

    `path` is the file, None: it is not kept. Nobody else can use it before `close`, or the end of
    the process. With `anew` an older file is kept under another name, and not used. `parts` name
    the orders, `limits` are watched beside; averages get the operating `state`. Raises
    RecordingError for a file that cannot be used.
    """

    def __init__(self, machine: str, shafts: Sequence[str], settings: Settings,
                 path: Path | None = None, *, parts: Machine = UNKNOWN,
                 limits: LimitWatch | None = None, state: OperatingState | None = None,
                 anew: bool = False) -> None:
        self.state = state or OperatingState(stamped=True)
        #: Averages discarded for their operating state, and why the latest one of each shaft was.
        self.discarded = 0
        self.refusals: dict[str, str] = {}
        self._parts, self.limits = parts, limits or LimitWatch(UNKNOWN, shafts)
        self.machine, self.shafts, self._settings, self.path = machine, shafts, settings, path
        self.monitors: dict[str, ShaftMonitor] = {}
        self._others: dict[str, ShaftMonitor] = {}
        self._lock = None if path is None else lock_baseline(path)
        if path is not None:
            try:
                if anew:
                    set_aside(path)
                found = read_baseline(path, machine, settings, 1.0 / len(shafts))
            except RecordingError:
                self.close()
                raise
            self.monitors = {shaft: found[shaft] for shaft in shafts if shaft in found}
            for item in self.monitors.values():
                item.machine = parts
            self._others = {name: item for name, item in found.items() if name not in shafts}
        self._pairings = {
            shaft: Pairing(self.monitors[shaft].layout if shaft in self.monitors else None)
            for shaft in shafts}
        self._without = dict.fromkeys(shafts, 0)
        self.use(settings)
        #: How many of the latest averages of each shaft had no corrected amplitudes.
        self.uncorrected = {shaft: Shortfall() for shaft in shafts}
        #: Whether the file lacks what is known now.
        self.unsaved = False

    def finish(self) -> None:
        """Take the averages that still wait for arrays, and fit."""
        for shaft, pairing in self._pairings.items():
            with suppress(MessageError, ParameterError):
                for average in pairing.flush():
                    self.take_average(shaft, average)

    def close(self) -> None:
        """Let others use the file."""
        if self._lock is not None:
            self._lock.close()

    def use(self, settings: Settings) -> None:
        """Use another rate of false alarms, and take uncorrected averages or not."""
        self._settings = settings
        for pairing in self._pairings.values():
            pairing.allow_uncorrected = settings.allow_uncorrected
        for item in self.monitors.values():
            item.settings = settings

    def take(self, shaft: str, kind: str, message: AverageMessage) -> list[str]:
        """
        Take an array, of a kind in `KINDS`; return lines that say which changes began and ended.

        Raises MessageError for arrays that do not fit each other, ParameterError for those that
        do not fit the baseline.
        """
        return [line for average in self._pairings[shaft].add(kind, message)
                for line in self.take_average(shaft, average)]

    def take_average(self, shaft: str, average: MonitoredAverage) -> list[str]:
        """Take a whole average, as `take` does its arrays."""
        if self._settings.uses_state:
            average = replace(average, state=self.state.of(shaft, average.header))
            self.refusals[shaft] = self._settings.refusal(average.state)
            if self.refusals[shaft]:
                self.discarded += 1
                return []
        self.uncorrected[shaft].add(not average.is_corrected)
        monitor = self.monitors.get(shaft) or self._begin(shaft, average)
        if monitor is None:
            return self.limits.update(shaft, average)
        self.unsaved = True
        fitted = average.fitted(monitor.layout)
        usual = monitor.usual() if fitted else None
        return self.limits.update(shaft, fitted or average, usual) + monitor.update(average)

    def _begin(self, shaft: str, average: MonitoredAverage) -> ShaftMonitor | None:
        """Return a new monitor, or None while it is not known what the shaft has."""
        if not average.layout.channels:
            raise MessageError('average of no channel: publish at least one')
        self._without[shaft] += 1
        if not (np.isfinite(average.values).any() and (
                average.layout.indicators or self._without[shaft] >= _WITHOUT)):
            return None
        self.monitors[shaft] = ShaftMonitor(
            shaft, average.layout, self._settings, share=1.0 / len(self.shafts),
            machine=self._parts)
        return self.monitors[shaft]

    @property
    def averages(self) -> int:
        """Return the number of averages that all shafts have taken."""
        return sum(item.averages for item in self.monitors.values())

    @property
    def is_complete(self) -> bool:
        """Return whether all shafts have learnt their baseline at the present speed."""
        return len(self.monitors) == len(self.shafts) and all(
            item.is_complete for item in self.monitors.values())

    def changes(self) -> list[Change]:
        """Return what has changed, the most certain first."""
        return sorted((change for item in self.monitors.values() for change in item.changes()),
                      key=lambda change: change.p_value)

    def report(self) -> dict[str, Any]:
        """Return the object of the topic `change`, without NaN and infinities."""
        found: dict[str, Any] = json_values({
            'baseline': {'averages': self.averages, 'complete': self.is_complete},
            'changes': [*(item.content() for item in self.limits.passed()),
                        *(item.content() for item in self.changes())]})
        return found

    def try_to_save(self) -> None:
        """Raise RecordingError where `save` could write no file."""
        if self.path is not None:
            with new_files(self.path):
                pass

    def save(self) -> None:
        """Write the file; raises RecordingError where it cannot be written."""
        if self.path is not None and self.monitors:
            write_baseline(self.path, self.machine, {**self._others, **self.monitors},
                           self._settings)
        self.unsaved = False
