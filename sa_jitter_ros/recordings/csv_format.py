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

What a file holds is told by its structure (`csv_layout`): lines above the samples, names, units.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TextIO

import numpy as np
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.errors import RecordingError
from sa_jitter_ros.recordings.channel_map import ChannelMap
from sa_jitter_ros.recordings.csv_layout import CsvLayout, layout_of, MAX_LINE
from sa_jitter_ros.recordings.recording import Recording, recording_errors


@dataclass(frozen=True)
class CsvSource:
    """
    The columns of a `.csv` file that are samples.

    With a time column (`times`, its number) each sample must be within half a sample period of its
    time by rate and row number.
    """

    path: Path
    layout: CsvLayout
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
        with recording_errors(self.path), _open(self.path, self.layout) as file:
            lines = _rows(file, self.layout)
            while start < self.samples:
                count = min(samples_per_block, self.samples - start)
                block = _parse(islice(lines, count), self.layout, wanted, start)
                if not len(block):
                    raise RecordingError(f'ends at row {start} of {self.samples}: the file was '
                                         'cut while it was read; open it again')
                if self.times is not None:
                    self._check_times(block[:, -1], start)
                yield block[:, :self.channels].T
                start += len(block)

    def _check_times(self, times: FloatArray, start: int) -> None:
        times = times * self.layout.time_unit
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
    layout = layout_of(path)
    names = list(layout.names)
    channel_map = channel_map.named(names)
    layout = layout.with_time(channel_map.time)
    time = '' if layout.time is None else names[layout.time]
    wanted = {*channel_map.vibration} or {names[k] for k in layout.used} - {time, ''}
    if channel_map.tach:
        wanted.add(channel_map.tach)
    columns = tuple(k for k, name in enumerate(names) if name in wanted)
    if not columns:
        raise RecordingError(f'no column of vibration among {", ".join(names)}: name it with '
                             'vibration_channels')
    times = layout.time
    cut, samples, start_time, end_time = _extent(path, layout)
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
            f'or give the sample_rate{layout.hint}')
    source = CsvSource(path, layout, columns, samples, times, start_time, rate)
    remarks = (*layout.remarks, *([
        f'the file ends in the middle of row {samples}: it was read up to there']
        if cut else ()))
    return channel_map.select(Recording(
        source, rate, start_time=start_time, remarks=remarks,
        channel_names=tuple(names[column] for column in columns),
        units=tuple(layout.units[column] for column in columns)))


def _open(path: Path, layout: CsvLayout) -> TextIO:
    return open(path, encoding=layout.encoding, errors='replace', newline=None)


def _rows(file: TextIO, layout: CsvLayout) -> Iterator[str]:
    """Iterate over the rows with data, with decimal points."""
    for _ in range(layout.skipped):
        file.readline(MAX_LINE)
    while line := file.readline(MAX_LINE):
        if not line.endswith('\n') and len(line) >= MAX_LINE:
            raise RecordingError(f'a line is longer than {MAX_LINE} characters: give a table '
                                 'with one sample per row')
        if not line.isspace():
            yield layout.pointed(line)


def _parse(lines: Iterator[str], layout: CsvLayout, columns: tuple[int, ...],
           start: int) -> FloatArray:
    """Return rows as `row` x `column`, without rows an empty array."""
    rows = list(lines)
    if not rows:
        return np.empty((0, len(columns)))
    try:
        return np.loadtxt(rows, delimiter=layout.delimiter, usecols=columns, ndmin=2,
                          comments=None, dtype=np.float64, quotechar='"')
    except ValueError as error:
        reason = str(error).split(';')[0]
        raise RecordingError(f'rows {start} to {start + len(rows)}: {reason}; give numbers '
                             'only') from error


def _extent(path: Path, layout: CsvLayout) -> tuple[bool, int, float, float]:
    """
    Return whether the last row is cut off, the number of whole rows, and the first and last time.

    The times are 0 without a time column.
    """
    count, first, last, before = 0, '', '', ''
    with _open(path, layout) as file:
        for line in _rows(file, layout):
            before, last, first = last, line, first or line
            count += 1
    cut = count > 1 and not last.endswith('\n') and (
        last.count(layout.delimiter) + 1 < layout.fields)
    if cut:
        last, count = before, count - 1
    if layout.time is None or not count:
        return cut, count, 0.0, 0.0
    ends = layout.time_unit * _parse(iter([first, last]), layout, (layout.time,), 0)
    if not np.isfinite(ends).all():
        raise RecordingError(f'time runs from {ends[0, 0]} to {ends[1, 0]} s: must be finite')
    return cut, count, float(ends[0, 0]), float(ends[1, 0])
