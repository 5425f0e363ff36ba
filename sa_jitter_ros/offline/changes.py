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
Has the machine changed: the change monitor over the finished averages of its recordings.

One value of a recording is tested, the mean of its averages: these have one load and one
temperature, and show nothing of how the machine scatters from recording to recording.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
import math
from pathlib import Path
from typing import Any

import numpy as np
from sa_jitter_ros.errors import RecordingError
from sa_jitter_ros.json_values import json_text
from sa_jitter_ros.machine import Machine, UNKNOWN
from sa_jitter_ros.monitoring.change_test import memory_of
from sa_jitter_ros.monitoring.limits import LimitWatch, PassedLimit
from sa_jitter_ros.monitoring.monitor import Change, PARAMETERS, Settings, ShaftMonitor
from sa_jitter_ros.monitoring.operating import OperatingBins
from sa_jitter_ros.monitoring.quantities import KINDS, mean_of, monitored, MonitoredAverage
from sa_jitter_ros.offline.files import read_averages, Signals, waveforms
from sa_jitter_ros.offline.series import ShaftSeries
from sa_jitter_ros.offline.settings import section, values_of
from sa_jitter_ros.parameters import converted, listed
from sa_jitter_ros.whole_files import whole_file

CHANGES, FIGURE = 'changes.json', 'changes.png'
MONITOR = 'change_monitor'
#: Parameters of the node that count here, too.
SETTINGS = {item.name: item for item in PARAMETERS if item.name in (
    'false_alarms_per_year', 'speed_bin', 'allow_uncorrected', 'state_bin', 'state_lowest',
    'state_highest')}
Key = tuple[str, int, str, str]  # shaft, channel, kind and name of a quantity
_INTERVAL = 86400.0  # s between recordings that do not say their time
_MOST_LINES = 6


@dataclass(frozen=True)
class Recorded:
    """
    A recording: its `name`, `start` and `end` (s), `speed` (Hz), and numbers of its channels.

    `means` are those of the averages of each shaft at a `state` that counts, without those
    `discarded`; channels have `units` and `channel_names`. `reason` says why it is not compared.
    """

    name: str
    start: float
    end: float
    speed: float
    channels: tuple[int, ...]
    means: Mapping[str, MonitoredAverage]
    units: tuple[str, ...] = ()
    channel_names: tuple[str, ...] = ()
    state: float = math.nan
    discarded: int = 0
    reason: str = ''


@dataclass(frozen=True)
class Changes:
    """
    What the monitors of the shafts found in `recordings`, in order of time.

    Those of `baseline`, the first ones of each bin of the state, are learnt. `left_out` are
    reasons by the names of recordings; `found` are those with which the present `changes` were
    found, `limits` the machine's. `events` say with which recording something changed, or was back
    at its baseline.
    """

    baseline: tuple[bool, ...]
    recordings: tuple[Recorded, ...]
    left_out: Mapping[str, str]
    monitors: Mapping[str, ShaftMonitor]
    events: tuple[dict[str, str], ...]
    found: Mapping[Key, str]
    limits: LimitWatch

    @property
    def learning(self) -> int:
        """Return the number of recordings that are the baseline."""
        return sum(self.baseline)

    @property
    def changes(self) -> list[Change]:
        """Return what has changed, the most certain first."""
        return sorted((item for monitor in self.monitors.values() for item in monitor.changes()),
                      key=lambda item: item.p_value)

    def since(self, change: Change | PassedLimit) -> str:
        """Return the recording with which a change began, or a limit was passed."""
        return self.recordings[change.since_sequence].name

    def report(self) -> dict[str, Any]:
        """Return the content of `changes.json`."""
        return {
            'baseline': {'averages': self.learning, 'complete': all(
                monitor.is_complete for monitor in self.monitors.values())},
            'changes': [*(self._content(item, self.since(item)) for item in self.limits.passed()),
                        *(self._content(item, self.found[key_of(item)])
                          for item in self.changes)],
            'events': list(self.events),
            'recordings': [item.name for item in self.recordings],
            'left_out': dict(self.left_out)}

    def write(self, output: Path) -> None:
        """Write `changes.json`; raises OSError."""
        with whole_file(output / CHANGES) as file:
            file.write(json_text(self.report()))

    def _content(self, item: Change | PassedLimit, found: str) -> dict[str, Any]:
        return {**item.content(), 'channel': self.recordings[0].channels[item.channel],
                'since_recording': self.since(item), 'found_recording': found}

    def warnings(self) -> list[str]:
        """Return what is not compared, and what to do about it."""
        discarded = sum(item.discarded for item in self.recordings)
        missing = sum(not all(mean.is_corrected for mean in item.means.values())
                      for item in self.recordings)
        return [*(f'{name} is not compared: it {reason}' for name, reason in
                  self.left_out.items()), *self.limits.warnings(),
                *([f'{discarded} averages are discarded, because their operating state is outside '
                   'state_lowest to state_highest'] if discarded else []),
                *(f'no bearing of {shaft} is watched, and averages do not show its faults: give '
                  f'{shaft}.bearing_orders' for shaft, monitor in self.monitors.items()
                  if not monitor.layout.bearings),
                *([f'orders and indicators of {missing} of {len(self.recordings)} recordings '
                   'are not compared, because they are not corrected: '
                   '-p allow_uncorrected:=true compares raw ones'] if missing else [])]

    def lines(self) -> list[str]:
        """Return the answer in a few lines."""
        tested, changes = len(self.recordings) - self.learning, self.changes
        after = f'{tested} recordings after the baseline of {self.learning}'
        compared = [f'compared: {monitor.layout} of {shaft}'
                    for shaft, monitor in self.monitors.items()]
        passed = self.limits.passed()
        limits = ['limits are passed:', *(f'  {item.words(self.since(item))}'
                                          for item in passed[:_MOST_LINES])] if passed else []
        if not changes:
            return [f'no change in {after}', *limits, *compared]
        more = len(changes) - _MOST_LINES
        return [f'the machine has changed in {after}:', *(
            f'  {item.words(self.since(item))}; found with {self.found[key_of(item)]}'
            for item in changes[:_MOST_LINES]), *(
                [f'  and {more} more: see {CHANGES}'] if more > 0 else []), *limits, *compared]


def key_of(change: Change) -> Key:
    """Return what tells a quantity from the others: shaft, channel, kind and name."""
    return change.shaft, change.channel, change.kind, change.name


def settings_of(params: Path | None, given: Sequence[str], learning: int) -> Settings:
    """
    Return the settings for a baseline of so many recordings; raises ParameterError.

    They are those of `change_monitor` in a machine file, and of texts `NAME:=VALUE`.
    """
    return Settings(learning_averages=learning, group_averages=1, **converted(
        section(params, MONITOR) | values_of(given), SETTINGS))


def find_changes(output: Path, names: Sequence[str], settings: Settings,
                 machine: Machine = UNKNOWN, *, state: str = '') -> Changes:
    """
    Return what has changed in recordings that are averaged in the folders `names` of `output`.

    The `machine` names the orders. The mean of the channel `state`, a name or a number, is the
    operating state; it is not monitored itself.
    Raises RecordingError if too few of them can be compared.
    """
    averaged = [read_averages(output / name) for name in names]
    orders = _common_orders(series for _, series, _ in averaged)
    recorded = [_recorded(output, name, signals, series, orders, settings, state)
                for name, (signals, series, _) in zip(names, averaged)]
    left_out: dict[str, str] = {}

    def compared(reason: Callable[[Recorded], str]) -> list[Recorded]:
        """Return the recordings that no reason leaves out."""
        left_out.update((item.name, text) for item in recorded if (text := reason(item)))
        return [item for item in recorded if item.name not in left_out]

    recorded = compared(lambda item: item.reason)
    if not recorded:
        raise _too_few(recorded, settings, left_out)
    usual, _ = Counter(item.channels for item in recorded).most_common(1)[0]
    recorded = compared(lambda item: '' if item.channels == usual else (
        f'has the channels {listed(item.channels)}, most have {listed(usual)}'))
    apart = _in_time(recorded)
    recorded = apart or recorded
    learnt = [item for item, known in zip(recorded, _baseline(recorded, settings)) if known]
    speeds = [item.speed for item in learnt]
    low, high = min(speeds), max(speeds)
    most = 1.0 + settings.speed_bin
    recorded = compared(lambda item: '' if low / most <= item.speed <= high * most else (
        f'turns at {item.speed:.4g} Hz, the baseline at {low:.4g} to {high:.4g} Hz: a longer '
        'baseline, or a larger speed_bin, compares it'))
    if all(_baseline(recorded, settings)):
        raise _too_few(recorded, settings, left_out)
    return _watched(recorded, left_out, settings, machine, clock=bool(apart))


def _too_few(recorded: Sequence[Any], settings: Settings, left_out: Mapping[str, str]
             ) -> RecordingError:
    learning = settings.learning_averages
    of_bin = ' of each state_bin' if settings.state_bin else ''
    first = next((f'; {name} {reason}' for name, reason in left_out.items()), '')
    return RecordingError(f'{len(recorded)} recordings can be compared, and {learning}{of_bin} '
                          f'are the baseline: give {learning + 1} or more; their averages are '
                          f'written{first}')


def _bins(recorded: Sequence[Recorded], settings: Settings) -> list[int | None]:
    """Return the bin of the state of each recording."""
    bins = OperatingBins(1.0, settings.state_bin)
    return [bins.key(1.0, item.state) for item in recorded]


def _baseline(recorded: Sequence[Recorded], settings: Settings) -> tuple[bool, ...]:
    """Return whether each recording is among the first of its bin, which are learnt."""
    bins = _bins(recorded, settings)
    return tuple(bins[:place].count(key) < settings.learning_averages
                 for place, key in enumerate(bins))


def _common_orders(averaged: Iterable[Sequence[ShaftSeries]]) -> dict[str, list[float]]:
    """Return the orders of each shaft that all recordings have."""
    found: dict[str, list[float]] = {}
    for series in averaged:
        for item in series:
            own = item.orders.tolist()
            found[item.shaft] = [order for order in found.get(item.shaft, own) if order in own]
    return found


def _recorded(output: Path, name: str, signals: Signals, series: Sequence[ShaftSeries],
              orders: Mapping[str, list[float]], settings: Settings, state: str) -> Recorded:
    """Return the means of the averages of a recording, in which one channel is the `state`."""
    labels = zip(map(str, signals.channels), signals.channel_names)
    place = next((k for k, label in enumerate(labels) if state and state in label), None)
    kept = [k for k in range(len(signals.channels)) if k != place]
    means: dict[str, MonitoredAverage] = {}
    discarded, refusal = 0, f'has no channel {state}'
    for item in series:
        averages = [monitored(parts, allow_uncorrected=settings.allow_uncorrected)
                    for parts in item.messages(KINDS, kept, np.array(orders[item.shaft]))]
        if state:
            values = () if place is None else waveforms(output / name, item.shaft)[:, place]
            averages = [replace(average, state=float(value.mean()))
                        for average, value in zip(averages, values)]
        counted = [average for average in averages if not settings.refusal(average.state)]
        discarded += len(averages) - len(counted)
        if counted:
            means[item.shaft] = mean_of(counted)
        elif averages:
            refusal = f'has no average that counts: {settings.refusal(averages[-1].state)}'
    first = next(iter(means.values()), None)
    channels = tuple(signals.channels[k] for k in kept)
    names, units = (tuple(values[k] for k in kept)
                    for values in (signals.channel_names, signals.units))
    return Recorded(
        name, float(series[0]['start_time'][0]), float(series[0]['end_time'][-1]),
        math.nan if first is None else first.header.mean_trigger_speed, channels, means,
        units, names, math.nan if first is None else first.state, discarded,
        refusal if first is None else '' if channels else f'has no channel beside {state}')


def _in_time(recorded: Sequence[Recorded]) -> list[Recorded]:
    """Return the recordings in order of time, [] where they overlap: each has its own clock."""
    ordered = sorted(recorded, key=lambda item: item.start)
    return [] if any(later.start < before.end for before, later in pairwise(ordered)) else ordered


def _watched(recorded: Sequence[Recorded], left_out: Mapping[str, str], settings: Settings,
             machine: Machine, *, clock: bool) -> Changes:
    """Return what the monitors of all shafts find."""
    shafts = dict.fromkeys(shaft for item in recorded for shaft in item.means)
    bins = _bins(recorded, settings)
    monitors = {}
    for shaft in shafts:
        layout = max((item.means[shaft].layout for item in recorded if shaft in item.means),
                     key=lambda layout: layout.shape)
        # Of the fullest bin: in others the machine has another load.
        fullest, _ = Counter(bins).most_common(1)[0]
        baseline = [fitted.values.ravel() for item, key, known in zip(
            recorded, bins, _baseline(recorded, settings)) if known and key == fullest
            and shaft in item.means and (fitted := item.means[shaft].fitted(layout))]
        monitors[shaft] = ShaftMonitor(shaft, layout, settings, share=1.0 / len(shafts),
                                       memory=memory_of(np.array(baseline)), machine=machine)
    channels = [(str(number), name) for number, name in zip(
        recorded[0].channels, recorded[0].channel_names)]
    limits = LimitWatch(machine, list(shafts), labels=lambda count: channels,
                        since=lambda number: recorded[number].name)
    events: list[dict[str, str]] = []
    found: dict[Key, str] = {}
    for number, item in enumerate(recorded):
        for shaft, monitor in monitors.items():
            if shaft not in item.means:
                continue
            mean = item.means[shaft]
            # Which speeds compare is decided already: all are in one bin.
            mean = replace(mean, state=item.state, header=replace(
                mean.header, sequence=number, mean_trigger_speed=1.0,
                start_time=item.start if clock else math.nan,
                end_time=item.end if clock else number * _INTERVAL))
            lines = limits.update(shaft, mean.fitted(monitor.layout) or mean, monitor.usual())
            monitor.update(mean)
            now = {key_of(change): change for change in monitor.changes()}
            for key in now.keys() - found.keys():
                found[key] = item.name
                lines.append(now[key].words(recorded[now[key].since_sequence].name))
            for key in [key for key in found if key[0] == shaft and key not in now]:
                del found[key]
                lines.append(f'{monitor.words(*key[2:])} of {shaft}, channel {key[1]} is back at '
                             'its baseline')
            events += [{'recording': item.name, 'text': line} for line in lines]
    return Changes(_baseline(recorded, settings), tuple(recorded), left_out, monitors,
                   tuple(events), found, limits)
