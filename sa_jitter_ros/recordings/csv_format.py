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
Recordings in `.csv` files: one row a sample.

What a file holds is told by its structure (`csv_layout`): lines above the samples, names, units.
Its numbers are read once, block by block, into an unnamed temporary file that is mapped.
"""

from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from pathlib import Path

import numpy as np
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.errors import RecordingError
from sa_jitter_ros.recordings.channel_map import ChannelMap
from sa_jitter_ros.recordings.csv_layout import CsvLayout, layout_of, lines_of, number_of
from sa_jitter_ros.recordings.recording import ArraySource, mapped, Recording

_ROWS_AT_ONCE = 65_536
_LONGEST_FOOTER = 100  # lines below the table
_ROUNDED = 1.1  # rows that a step of rounded times spans at least


def open_csv(path: Path, *, channel_map: ChannelMap, sample_rate: float | None) -> Recording:
    """
    Open a `.csv` file; only the columns of the channel map must be numeric.

    Lines below the table, and a last row that is cut off, are left out. The sampling rate is
    `sample_rate`, with which the times must agree within half a sample, else the mean rate of the
    times. Empty cells are NaN. Raises RecordingError if there is neither, or a row is not numeric.
    """
    layout = layout_of(path)
    names = layout.names
    channel_map = channel_map.named(names)
    layout.choose_time(channel_map.time)
    wanted = {*channel_map.vibration} or {
        names[k] for k in layout.used if k != layout.time} - {''}
    wanted |= {channel_map.tach} - {''}
    shown = sum(map(bool, names))
    if layout.delimiter == ',' and len(layout.used) + len(layout.idle) == 2 * shown:
        raise RecordingError(f'{2 * shown} columns of numbers, but {shown} names: if commas are '
                             'decimal points, too, separate the fields by semicolons')
    columns = tuple(k for k, name in enumerate(names) if name in wanted)
    if not columns:
        raise RecordingError(f'no column of vibration among {", ".join(names)}: name it with '
                             'vibration_channels')
    times = () if layout.time is None else (layout.time,)
    read, left_out = (*columns, *times), list[str]()
    table = mapped(_pieces(path, layout, read, left_out), np.float64).reshape(-1, len(read))
    start_time, rate = _clock(layout, table[:, -1], sample_rate) if times else (
        0.0, sample_rate)
    if rate is None:
        hints = ''.join(f'; {names[k] or k} {why}' for k, why in layout.idle.items())
        raise RecordingError(
            f'no time column among {", ".join(names)}: give its name as time_column, '
            f'or give the sample_rate{layout.hint}{hints}')
    remarks = (*layout.remarks, *left_out, *(
        f'column {names[k] or k} {reason}{" and is left out" * (k not in columns)}'
        for k, reason in layout.idle.items() if k not in times))
    return channel_map.select(Recording(
        ArraySource(table[:, :len(columns)].T), rate, start_time=start_time, remarks=remarks,
        channel_names=tuple(names[column] for column in columns),
        units=tuple(layout.units[column] for column in columns)))


def _clock(layout: CsvLayout, values: FloatArray, sample_rate: float | None
           ) -> tuple[float, float]:
    """Return start (s) and rate (Hz) of the values of a time column."""
    times = layout.times(values)
    start, end, count = float(times[0]), float(times[-1]), len(times) - 1
    rate = sample_rate
    if rate is None and not count:
        raise RecordingError('1 row of samples: give more, or the sample_rate')
    if not np.isfinite([start, end]).all() or (count and not end > start):
        raise RecordingError(f'time runs from {start} to {end} s: sort the rows by time')
    steps, index = np.diff(times), np.arange(count + 1)
    measured = count / (end - start) if count else 0.0
    rounding = float(np.min(steps, where=steps > 0.0, initial=end - start))
    if rounding * measured > _ROUNDED and np.any(steps == 0.0):
        start, period = np.polynomial.polynomial.polyfit(index, times, 1).tolist()
        measured = 1.0 / period
    else:
        rounding = 0.0
    if rate is None:
        rate = measured
    elif not abs((end - start) * rate - count) < 1.0 + rounding * rate:
        raise RecordingError(f'sample_rate {rate} Hz given, but the times of the file say '
                             f'{measured} Hz: leave it out')
    if not np.all(abs((times - start) * rate - index) < 0.5 + rounding * rate):
        usual = max(float(np.median(steps)), rounding)
        row = int(np.argmax(np.abs(steps - usual))) + 1
        raise RecordingError(
            f'row {row}: time {times[row]} s is {steps[row - 1]:.6g} s behind the row before, '
            f'most {usual:.6g} s: split the file at gaps; of edges, save pulse_times in a .npz')
    return start, rate


def _pieces(path: Path, layout: CsvLayout, columns: tuple[int, ...], left_out: list[str]
            ) -> Iterator[bytes]:
    """Iterate over numbers, `row` x `column`; `left_out` takes what is left out at the end."""
    with open(path, encoding=layout.encoding, errors='replace', newline=None) as file:
        lines = (layout.plain(line) for line in islice(lines_of(file), layout.skipped, None)
                 if not line.isspace())
        start, rows = 0, list(islice(lines, _ROWS_AT_ONCE))
        while rows:
            following = list(islice(lines, _ROWS_AT_ONCE))
            if len(following) < _LONGEST_FOOTER:
                rows, following = [*rows, *following], []
                left_out += _cut_end(rows, layout, columns, start)
            yield _parse(rows, layout, columns, start).tobytes()
            start, rows = start + len(rows), following


def _cut_end(rows: list[str], layout: CsvLayout, columns: tuple[int, ...], start: int
             ) -> tuple[str, ...]:
    """
    Remove the last rows that do not begin with a number, or one that is cut off; return what.

    A row begins with its time, else with the first of its `columns`; `start` is the first row.
    """
    whole, first = len(rows), columns[0] if layout.time is None else layout.time
    while len(rows) > 1 and not layout.has_number(rows[-1], first):
        del rows[-1]
    if below := whole - len(rows):
        return f'{below} line{"s" * (below > 1)} below the table skipped: no samples',
    if whole > 1 and not (rows[-1].endswith('\n') or layout.has_number(rows[-1], max(columns))):
        del rows[-1]
        return f'the file ends in the middle of row {start + whole - 1}: it was read up to there',
    return ()


def _parse(rows: Sequence[str], layout: CsvLayout, columns: tuple[int, ...], start: int
           ) -> FloatArray:
    """Return rows, of which `start` is the first, as `row` x `column`."""
    time: dict[int | str, Callable[[str], float]] = (
        {} if layout.time is None else {layout.time: number_of})
    for converters in (time, dict.fromkeys(columns, _sample_of) | time):
        try:
            return np.loadtxt(
                rows, delimiter=layout.delimiter.strip(' ') or None, usecols=columns, ndmin=2,
                comments=None, dtype=np.float64, quotechar='"', encoding=None,
                converters=converters)
        except ValueError as error:  # the fast way knows no empty cells
            reason = str(error).split(';')[0]
    raise RecordingError(f'rows {start} to {start + len(rows)}: {reason}; give numbers only')


def _sample_of(text: str) -> float:
    """Return the number that a cell is, NaN for none and for a sample beyond the range."""
    return float(text) if text.strip().strip('+-') not in ('', '\N{INFINITY}') else np.nan
