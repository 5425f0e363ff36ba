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
The files of averages: `averages.npz` and `averages.csv` of a recording, and tables of many.

`averages.npz` has the arrays of each shaft under `<shaft>_<name>`, and those of the header also
without a shaft: of the first one. `averages.csv` has a row for each average, channel and order;
with a machine by its parts, `part` is the one that makes the order; the last column, `note`, says
why an order has no amplitude.
"""

from collections.abc import Iterable, Mapping, Sequence
import csv
from dataclasses import asdict, dataclass, field, fields
import json
import math
from pathlib import Path
import shutil
from typing import Any, TextIO, TypeVar

import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.errors import RecordingError
from sa_jitter_ros.json_values import json_values
from sa_jitter_ros.machine import Machine, UNKNOWN
from sa_jitter_ros.monitoring.limits import LimitWatch
from sa_jitter_ros.number_text import order_text
from sa_jitter_ros.offline.series import HEADER, ShaftSeries
from sa_jitter_ros.tacholess.recording import Tacholess
from sa_jitter_ros.whole_files import TEMPORARY, whole_file

ARRAYS, TABLE = 'averages.npz', 'averages.csv'

_OVER_ANGLE = ('_waveform', '_average', '_standard_error', '_spectrum')  # ends of names
_COLUMNS = ('recording', 'shaft', 'sequence', 'start_time', 'end_time', 'trigger_speed',
            'trigger_cycles', 'discarded_cycles', 'channel')


@dataclass(frozen=True)
class RecordingJob:
    """
    One recording to work on: its `name` in the results, its `path`, the folder of its files.

    `options` are keywords of `read`. With `tacholess` the pulses are found in the vibration.
    `error` says why it cannot be used beside the others.
    """

    name: str
    path: str
    folder: str
    options: Mapping[str, Any] = field(default_factory=dict)
    tacholess: Tacholess | None = None
    error: str = ''

    def settings(self, **others: Any) -> dict[str, Any]:
        """Return all that decides the files, as values of JSON; raises RecordingError."""
        if self.error:
            raise RecordingError(self.error)
        found: dict[str, Any] = json_values({
            'files': stamp(Path(self.path)), 'path': self.path, 'options': self.options,
            'tacholess': self.tacholess and asdict(self.tacholess), **others})
        return found


@dataclass(frozen=True)
class RecordingRow:
    """What became of one recording: `error` says why it has no result, or ended early."""

    recording: str
    path: str
    error: str = ''


Row = TypeVar('Row', bound=RecordingRow)


def row_values(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a row from what `json_values` made of them."""
    return {name: tuple(value) if isinstance(value, list) else
            math.nan if value is None else value for name, value in values.items()}


@dataclass(frozen=True)
class Signals:
    """
    What was averaged: name of the recording, and number, name and unit of its channels.

    The `machine` names the orders; `limits` are its own.
    """

    recording: str
    channels: tuple[int, ...]
    channel_names: tuple[str, ...]
    units: tuple[str, ...]
    machine: Machine = field(default_factory=Machine)
    limits: LimitWatch = field(default_factory=lambda: LimitWatch(UNKNOWN, ()))

    def order(self, shaft: str, order: float) -> str:
        """Return an order, behind the part of the machine that makes it, if one does."""
        return order_text(order, self.machine.name_of(shaft, order))

    def label(self, channel: int) -> str:
        """Return name and unit of the channel in this place, for an axis."""
        return f'{self.channel_names[channel]}\n[{self.unit_of([channel])}]'

    def unit_of(self, channels: Iterable[int]) -> str:
        """Return the unit, or the units, of channels in some places, for an axis."""
        return ' / '.join(sorted({self.units[place] for place in channels})) or 'unit unknown'


def write_averages(folder: Path, signals: Signals, series: Sequence[ShaftSeries],
                   about: Mapping[str, Any]) -> None:
    """
    Write `averages.npz` and `averages.csv` of a recording; raises OSError.

    `about` are values of JSON that `read_about` returns.
    """
    with (folder / TABLE).open('w', encoding='utf-8', newline='') as file:
        _write_table(file, signals, series)
    arrays: dict[str, Any] = {
        'recording': np.array(signals.recording), 'channels': np.array(signals.channels),
        'channel_names': np.array(signals.channel_names), 'units': np.array(signals.units),
        'shafts': np.array([item.shaft for item in series]),
        'about': np.array(json.dumps(json_values(about), allow_nan=False))}
    arrays |= {name: series[0][name] for name in HEADER}
    for item in series:
        arrays |= {f'{item.shaft}_{name}': array for name, array in item.arrays.items()}
    np.savez(folder / ARRAYS, **arrays)


def read_about(folder: Path) -> dict[str, Any]:
    """Return what a finished folder says of itself, nothing if it is not finished."""
    try:
        with np.load(folder / ARRAYS) as arrays:
            return dict(json.loads(str(arrays['about'])))
    except Exception:  # a broken file may raise an exception of any type: it is written again
        return {}


def read_averages(folder: Path) -> tuple[Signals, list[ShaftSeries], dict[str, Any]]:
    """
    Return what a finished folder holds: signals, averages of each shaft, and what it says.

    The arrays over the angle, which are large, are left out. The signals bear the name of the
    machine, if it has one.
    """
    with np.load(folder / ARRAYS) as arrays:
        about = json.loads(str(arrays['about']))
        settings = about.get('settings', {})
        signals = Signals(
            settings.get('hardware_id') or str(arrays['recording']),
            tuple(arrays['channels'].tolist()), tuple(arrays['channel_names'].tolist()),
            tuple(arrays['units'].tolist()), Machine.among(settings.get('machine', {})))
        return signals, [ShaftSeries(shaft, {
            name.removeprefix(f'{shaft}_'): arrays[name] for name in arrays.files
            if name.startswith(f'{shaft}_') and not name.endswith(_OVER_ANGLE)})
            for shaft in arrays['shafts'].tolist()], about


def waveforms(folder: Path, shaft: str) -> Array:
    """Return the averages of a shaft over the angle, (average, channel, angle)."""
    with np.load(folder / ARRAYS) as arrays:
        return np.asarray(arrays[f'{shaft}_waveform'])


def _write_table(file: TextIO, signals: Signals, series: Sequence[ShaftSeries]) -> None:
    writer = csv.writer(file, lineterminator='\n')
    of_order = series[0]['order_amplitude_fields'].tolist()
    named = ['part'] if signals.machine.shafts else []
    writer.writerow([*_COLUMNS, *of_order, 'channel_name', 'unit', *named, 'note'])
    for item in series:
        parts = [[signals.machine.name_of(item.shaft, order)] * len(named)
                 for order in item.orders.tolist()]
        header = {name: item[name].tolist() for name in HEADER}
        for row, (table, notes) in enumerate(zip(item['order_amplitude'], item['note'].tolist())):
            start = [signals.recording, item.shaft, *(
                header[name][row] for name in _COLUMNS[2:-1])]
            for channel, name, unit, orders in zip(signals.channels, signals.channel_names,
                                                   signals.units, table.tolist()):
                writer.writerows([*start, channel, *values, name, unit, *part, note]
                                 for values, part, note in zip(orders, parts, notes))


def join_tables(path: Path, folders: Sequence[Path], failures: Sequence[tuple[str, str]]
                ) -> None:
    """
    Write the rows of all `averages.csv` in the folders into one table; raises OSError.

    Its last column, `error`, is empty there; each of the `failures`, (name of a recording,
    reason), has a row of its own.
    """
    columns: list[str] = []
    with whole_file(path) as file:
        for folder in folders:
            with (folder / TABLE).open(encoding='utf-8', newline='') as part:
                first = part.readline().rstrip('\n')
                if not columns:
                    columns = first.split(',')
                    file.write(f'{first},error\n')
                for line in part:
                    file.write(f'{line[:-1]},\n')
        writer = csv.writer(file, lineterminator='\n')
        if not columns:
            columns = [*_COLUMNS]
            writer.writerow([*columns, 'error'])
        for name, reason in failures:
            writer.writerow([name, *[''] * (len(columns) - 1), reason])


def stamp(path: Path) -> list[list[Any]]:
    """
    Return name, size and time of change (ns) of a file, or of all files of a bag.

    Raises RecordingError for a file that is not there.
    """
    try:
        files = sorted(path.iterdir()) if path.is_dir() else [path]
        return [[item.name, item.stat().st_size, item.stat().st_mtime_ns] for item in files]
    except OSError as error:
        raise RecordingError(f'{path}: {error.strerror}: check the path') from None


def write_rows(path: Path, rows: Sequence[Row]) -> list[Row]:
    """Write rows of recordings as a table, in the order of their names; return them so."""
    ordered = sorted(rows, key=lambda row: (row.recording, row.path))
    with whole_file(path) as file:
        writer = csv.writer(file, lineterminator='\n')
        writer.writerow(item.name for item in fields(rows[0]))
        for row in ordered:
            writer.writerow('; '.join(value) if isinstance(value, tuple) else value
                            for value in asdict(row).values())
    return ordered


def remove_unfinished(folder: Path) -> None:
    """Remove what a run that was killed has left in a folder."""
    for path in folder.glob(f'{TEMPORARY}*'):
        shutil.rmtree(path, ignore_errors=True)
