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
Recordings in `.csv` files: one row a sample, read in blocks.

Fields are separated by comma, semicolon or tab; with semicolons a comma is a decimal point. A
first row that is not numeric has the names of the columns, otherwise these are 0, 1, ...
"""

from collections.abc import Iterator
import csv
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TextIO

import numpy as np
from sa_jitter_ros.errors import RecordingError
from sa_jitter_ros.recordings.channel_map import ChannelMap
from sa_jitter_ros.recordings.recording import FloatArray, Recording, recording_errors

_MAX_LINE = 1 << 20
_TIME_NAMES = ('time', 't', 'time_s', 'time [s]', 'time (s)')


@dataclass(frozen=True)
class CsvSource:
    """
    The columns of a `.csv` file that are samples.

    With a time column (`times`, its number) each sample must be within half a sample period of its
    time by rate and row number.
    """

    path: Path
    delimiter: str
    has_header: bool
    columns: tuple[int, ...]
    samples: int
    times: int | None = None
    start_time: float = 0.0
    sample_rate: float = 1.0

    @property
    def channels(self) -> int:
        """Return the number of channels."""
        return len(self.columns)

    def blocks(self, samples_per_block: int) -> Iterator[FloatArray]:
        """Iterate over `channel` x `sample` blocks."""
        wanted = self.columns if self.times is None else (*self.columns, self.times)
        start = 0
        with recording_errors(self.path), _open(self.path) as file:
            lines = _rows(file, self.delimiter, self.has_header)
            while start < self.samples:
                count = min(samples_per_block, self.samples - start)
                block = _parse(islice(lines, count), self.delimiter, wanted, start)
                if not len(block):
                    raise RecordingError(f'ends at row {start} of {self.samples}: the file was '
                                         'cut while it was read; open it again')
                if self.times is not None:
                    self._check_times(block[:, -1], start)
                yield block[:, :self.channels].T
                start += len(block)

    def _check_times(self, times: FloatArray, start: int) -> None:
        places = (times - self.start_time) * self.sample_rate
        astray = np.flatnonzero(~(abs(places - start - np.arange(len(times))) < 0.5))
        if astray.size:
            row = int(astray[0])
            raise RecordingError(
                f'row {start + row}: time {times[row]} s does not fit a constant rate of '
                f'{self.sample_rate:g} Hz from {self.start_time} s: split the file at its gaps')


def open_csv(path: Path, *, channel_map: ChannelMap, sample_rate: float | None) -> Recording:
    """
    Open a `.csv` file; only the columns of the channel map must be numeric.

    A last row that is cut off is left out. The sampling rate is `sample_rate`, with which the
    times must agree within half a sample, else the mean rate of the times. Raises RecordingError
    if there is neither, or a row is not numeric.
    """
    with recording_errors(path):
        with _open(path) as file:
            first = file.readline(_MAX_LINE).strip()
        delimiter = next((mark for mark in ';\t,' if mark in first), ',')
        names = [name.strip() for name in next(csv.reader([first], delimiter=delimiter), [])]
        has_header = not all(_is_number(name, delimiter) for name in names)
        if not has_header:
            names = [str(column) for column in range(len(names))]
        channel_map = channel_map.named(names)
        time = channel_map.time or next((n for n in names if n.lower() in _TIME_NAMES), '')
        wanted = {*channel_map.vibration} or {*names} - {time, ''}  # none: a delimiter too many
        if channel_map.tach:
            wanted.add(channel_map.tach)
        columns = tuple(k for k, name in enumerate(names) if name in wanted)
        if not columns:
            raise RecordingError(f'no column of vibration among {", ".join(names)}: name it with '
                                 'vibration_channels')
        times = names.index(time) if time else None
        cut, samples, start_time, end_time = _extent(path, delimiter, has_header, len(names),
                                                     times)
        rate = sample_rate
        if times is not None and samples > 1:
            if not end_time > start_time:
                raise RecordingError(f'time runs from {start_time} to {end_time} s: sort the rows '
                                     'by time')
            rate = (samples - 1) / (end_time - start_time)
            if sample_rate is not None:  # times are rounded, so it is the better of the two
                if not abs((end_time - start_time) * sample_rate - (samples - 1)) < 1.0:
                    raise RecordingError(f'sample_rate {sample_rate} Hz given, but the times of '
                                         f'the file say {rate} Hz: leave it out')
                rate = sample_rate
        if rate is None:
            raise RecordingError(
                f'no time column among {", ".join(names)}: give its name as time_column, '
                'or give the sample_rate')
        source = CsvSource(path, delimiter, has_header, columns, samples, times, start_time, rate)
        return channel_map.select(Recording(
            source, rate, start_time=start_time,
            channel_names=tuple(names[column] for column in columns),
            remarks=(f'the file ends in the middle of row {samples}: it was read up to there',)
            if cut else ()))


def _open(path: Path) -> TextIO:
    return open(path, encoding='utf-8-sig', newline=None)


def _rows(file: TextIO, delimiter: str, has_header: bool) -> Iterator[str]:
    """Iterate over the rows with data, with decimal points."""
    if has_header:
        file.readline(_MAX_LINE)
    while line := file.readline(_MAX_LINE):
        if not line.endswith('\n') and len(line) >= _MAX_LINE:
            raise RecordingError(f'a line is longer than {_MAX_LINE} characters: give a table '
                                 'with one sample per row')
        if not line.isspace():
            yield line.replace(',', '.') if delimiter == ';' else line


def _parse(lines: Iterator[str], delimiter: str, columns: tuple[int, ...],
           start: int) -> FloatArray:
    """Return rows as `row` x `column`, without rows an empty array."""
    rows = list(lines)
    if not rows:
        return np.empty((0, len(columns)))
    try:
        return np.loadtxt(rows, delimiter=delimiter, usecols=columns, ndmin=2, comments=None,
                          dtype=np.float64)
    except ValueError as error:
        reason = str(error).split(';')[0]
        raise RecordingError(f'rows {start} to {start + len(rows)}: {reason}; give numbers '
                             'only') from error


def _extent(path: Path, delimiter: str, has_header: bool, fields: int,
            times: int | None) -> tuple[bool, int, float, float]:
    """
    Return whether the last row is cut off, the number of whole rows, and the first and last time.

    Rows have so many `fields`. The times are 0 without a time column.
    """
    count, first, last, before = 0, '', '', ''
    with _open(path) as file:
        for line in _rows(file, delimiter, has_header):
            before, last, first = last, line, first or line
            count += 1
    cut = count > 1 and not last.endswith('\n') and last.count(delimiter) + 1 < fields
    if cut:
        last, count = before, count - 1
    if times is None or not count:
        return cut, count, 0.0, 0.0
    ends = _parse(iter([first, last]), delimiter, (times,), 0)
    if not np.isfinite(ends).all():
        raise RecordingError(f'time runs from {ends[0, 0]} to {ends[1, 0]} s: must be finite')
    return cut, count, float(ends[0, 0]), float(ends[1, 0])


def _is_number(text: str, delimiter: str) -> bool:
    try:
        float(text.replace(',', '.') if delimiter == ';' else text)
    except ValueError:
        return False
    return True
