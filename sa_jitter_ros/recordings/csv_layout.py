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
What the lines of a `.csv` file are: a preamble, names, units, and rows of samples.

The structure tells, not the make of the instrument. Rows of samples have numbers in the same
columns all along; above them are the names, below these the units, or none of both, and above all
that a preamble. Fields are separated by comma, semicolon, tab or spaces; but for the first, and in
quotes, a comma is a decimal point. Clock times count from midnight, whatever their date. A column
that counts the rows is none of samples.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
import csv
from io import StringIO
from pathlib import Path
import re
from typing import TextIO

import numpy as np
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.errors import RecordingError
from sa_jitter_ros.recordings.channel_list import constant_rate

_MAX_LINE = 1 << 20
_MOST_LINES, _MOST_BYTES = 1000, 1 << 20  # at the start of a file, that show its structure
_HINTS = 40  # lines, in which a sampling rate may be stated beside the samples
_LEAST_ROWS = 3  # that begin the samples; fewer are a part of the preamble
_DELIMITERS = ';\t|, '
_TIME_NAMES = ('time', 't')
_SECONDS = {name: seconds for seconds, names in (
    (1.0, 's sec second seconds'), (1e-3, 'ms msec millisecond milliseconds'),
    (1e-6, 'us \u00b5s \u03bcs usec microsecond microseconds'), (1e-9, 'ns nsec'),
    (60.0, 'min minute minutes'), (3600.0, 'h hr hour hours')) for name in names.split()}
_DAY = 86400.0  # s
_LEAST_EVEN, _EVEN = 16, 'rises evenly'  # rows; as numbers of rows, or times
_ALONE = _SECONDS.keys() - {'min', 'h'}  # as the name of a column of times
# Known without brackets, also words for the number of a row.
_UNITS = {*_SECONDS, 'V', 'mV', 'uV', '\u00b5V', 'volt', 'volts', 'A', 'mA', 'amp', 'ampere',
          'g', 'mg', 'm/s2', 'm/s^2', 'm/s\u00b2', 'mm/s', 'm/s', 'mm', 'um', '\u00b5m', 'Hz',
          'rpm', '1/min', 'deg', 'rad', 'dB', '%', 'Pa', 'bar', 'N', 'Nm', 'EU',
          'index', 'sequence', 'sample', 'point'}
_IN_NAME = re.compile(r'^(.*?)(?:\s*[\[(]([^\])]*)[\])]|(?:^|,?\s)in\s+(\S+)|'
                      r'(?:(?<=time)|(?<=^t))[ _/]+(\w+))$', re.IGNORECASE)
# A date that is not read, hours, minutes, seconds, time zone.
_CLOCK = re.compile(r'(?:\S*\d[T ])?(?:(\d+):)?(\d+):(\d+(?:\.\d*)?)(?:Z|[-+]\d\d:?\d\d)?')
# Groups of three digits are told from decimals by the decimals behind them.
_QUOTED, _LINE = re.compile(r'"[-+\d.,\'\seE]*"'), re.compile('.+')  # with numbers
_GROUPED = re.compile(r"[-+]?\d{1,3}([.,'\s])\d{3}(?:\1\d{3})*(?!\1)[.,]\d+")
_RATE_WORDS = re.compile(r'interval|increment|period|resolution|rate|dt\b', re.IGNORECASE)
_NUMBER = re.compile(r'(?<!\w)[-+.]?\d')


class CsvLayout:
    """
    The layout of a file whose first lines have fields with a delimiter.

    `pattern` are the columns that are numbers in most rows, `fit` how many such rows there are,
    and whether one of them has no text. With a pattern there are: `skipped` lines above the
    samples, `names` of the columns (their numbers without a line of names, or behind a name that
    another has), `units` ('' where
    unknown), columns that hold samples (`used`) or none (`idle`, with the reason), the column of
    times (`time`, None for none), what was left out (`remarks`) and what the preamble says of the
    sampling rate (`hint`).
    """

    def __init__(self, encoding: str, lines: Sequence[str], delimiter: str) -> None:
        self.delimiter, self.encoding = delimiter, encoding
        self._rows = [_fields(line, delimiter) for line in lines]
        groups = Counter(found.group(1) for row in self._rows for text in row
                         if (found := _GROUPED.fullmatch(text)))
        self._thousands = max(groups, key=lambda mark: groups[mark], default='')
        self._values = [{k: number_of(text) for k, text in enumerate(
            _fields(self.plain(line), delimiter)) if reads_as_number(text)} for line in lines]
        counts = Counter(frozenset(values) for row, values in zip(self._rows, self._values)
                         if values and (len(row) > 1 or delimiter == ','))
        self.pattern = max(counts, key=lambda columns: (counts[columns], len(columns)),
                           default=frozenset())
        self.fit = counts[self.pattern], any(
            self.pattern == {k for k, text in enumerate(row) if text} for row in self._rows)
        self.time: int | None = None
        if self.pattern:
            self._find(lines)

    def _find(self, lines: Sequence[str]) -> None:
        """Find what the lines and columns are."""
        self.skipped = start = self._start()
        rows = [row for row in self._rows[start:] if row]
        above = [number for number, row in enumerate(self._rows[:start]) if row]
        header, units = self._header(above)
        names = [] if header is None else self._rows[header]
        width = max(len(names), *map(len, rows))
        self.names = names + [str(k) if header is None else '' for k in range(len(names), width)]
        given = ([] if units is None else self._rows[units]) + [''] * width
        self.units = [_unit(text) or _split(name)[1] for name, text in zip(self.names, given)]
        values = list(filter(None, self._values[start:]))
        whole = next(row for row, numbers in zip(self._rows[start:], self._values[start:])
                     if self.pattern <= numbers.keys())
        self._clocks = {k for k in self.pattern if ':' in whole[k]}
        self.idle = self._idle(rows, values)
        self.used = sorted({k for each in values for k in each} - self.idle.keys())
        preamble = [number for number in above if header is None or number < header]
        self.remarks = [f'{len(preamble)} line{"s" * (len(preamble) > 1)} above the table '
                        'skipped: no samples'] * bool(preamble)
        self.hint = _hint(lines[:max(start, _HINTS)])
        first = {name: k for k, name in reversed([*enumerate(self.names)])}
        self.names = [f'{name} {k}' if name and first[name] < k else name
                      for k, name in enumerate(self.names)]

    def plain(self, line: str) -> str:
        """Return a line with decimal points and without groups of digits."""
        numbers = _QUOTED if self.delimiter == ',' else _LINE
        return numbers.sub(
            lambda found: found[0].replace(self._thousands, '').replace(',', '.'), line)

    def has_number(self, line: str, column: int) -> bool:
        """Return whether a row has a number in a column."""
        fields = _fields(line, self.delimiter)
        return column < len(fields) and reads_as_number(fields[column])

    def choose_time(self, name: str) -> None:
        """Take the times from the column of a name, without one from that which shows it."""
        named = [k for k, text in enumerate(self.names) if _split(text)[0] in _TIME_NAMES
                 and (self._seconds(k) or not self.units[k])]
        timed = [k for k in (*self.used, *self.idle) if self._seconds(k)]
        found = [k for k in named or timed[:len(timed) == 1]
                 if self.idle.get(k, _EVEN) == _EVEN]
        self.time = self.names.index(name) if name else next(iter(found), None)

    def times(self, values: FloatArray) -> FloatArray:
        """Return the values of the column of times in s; those of a clock pass midnight."""
        if self.time in self._clocks:
            values = values[0] + (values - values[0]) % _DAY
        return values * (self._seconds(self.time or 0) or 1.0)

    def _seconds(self, column: int) -> float:
        """Return the unit of a column in s, 0 for one that is no unit of time."""
        unit = 's' if column in self._clocks else self.units[column]
        return _SECONDS.get(unit.lower() if len(unit) > 2 else unit, 0.0)

    def _idle(self, rows: Sequence[Sequence[str]], values: Sequence[Mapping[int, float]]
              ) -> dict[int, str]:
        """Return the columns that hold no samples, with the reason."""
        found = {k: 'holds text' for row in rows for k, text in enumerate(row) if text}
        for k in sorted(set().union(*values)):
            del found[k]
            column = np.array([each.get(k, np.nan) for each in values])
            if 2 * np.isfinite(column).sum() < len(rows):
                found[k] = 'is empty in most rows'
            elif k in self._clocks and np.any(np.diff(column) == 0.0):
                found[k] = 'has times that repeat'
            elif len(column) >= _LEAST_EVEN and constant_rate(column):
                found[k] = _EVEN
        return found

    def _is_text(self, number: int) -> bool:
        """Return whether a row may name columns: text, or the number of a channel, in each."""
        row, values = self._rows[number], self._values[number]
        if len(row) < min(2, len(self.pattern)):
            return False
        numbers = self.pattern & values.keys()
        filled = {k for k in self.pattern if k < len(row) and row[k]}
        return numbers != filled and all(row[k].isdecimal() for k in numbers)

    def _start(self) -> int:
        """Return the number of the first row of samples."""
        samples = [number for number, values in enumerate(self._values)
                   if self.pattern <= values.keys()]
        begin = -1
        for number in range(samples[0], samples[-1]):  # names, perhaps, below a part with numbers
            before = sum(begin < sample < number for sample in samples)
            if before < _LEAST_ROWS and not self._values[number] and self._is_text(number):
                begin = number
        first = next(sample for sample in samples if sample > begin)
        above = first - 1
        while above >= 0 and self._has_gaps(above):  # samples, where names are above them
            above -= 1
        return above + 1 if above >= 0 and self._is_text(above) else first

    def _has_gaps(self, number: int) -> bool:
        """Return whether a row has numbers in some columns, of samples too, and no text."""
        row = self._rows[number]
        filled = {k for k, text in enumerate(row) if text}
        return bool(filled & self.pattern) and len(row) > max(self.pattern) and (
            filled == self._values[number].keys())

    def _header(self, above: Sequence[int]) -> tuple[int | None, int | None]:
        """Return the rows of names and of units, of those `above` the samples; None for none."""
        texts = [number for number in above[-2:] if self._is_text(number)]
        if not above or above[-1] not in texts:
            return None, None
        last = self._rows[above[-1]]
        named = [last[k] for k in self.pattern if k < len(last) and last[k]]
        units = sum(bool(_unit(text)) for text in named)
        if len(texts) == 2 and 2 * units >= len(named) and not any(
                _split(text)[0] in _TIME_NAMES for text in named):
            return texts[0], texts[1]
        return above[-1], None


def layout_of(path: Path) -> CsvLayout:
    r"""
    Return the layout of a file, from its first lines; raises RecordingError if it has no numbers.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder, 'scope.csv')
    ...     _ = path.write_text('Model,X1\nTime,A\n(ms),(V)\n\n0.0,1.2\n0.5,1.3\n1.0,1.2\n')
    ...     layout = layout_of(path)
    >>> layout.choose_time('')
    >>> layout.skipped, layout.names, layout.units, layout.time
    (4, ['Time', 'A'], ['ms', 'V'], 0)
    """
    encoding, lines = _first_lines(path)
    tables = [CsvLayout(encoding, lines, mark) for mark in _DELIMITERS
              if mark == ',' or any(mark in line for line in lines)]
    found = max(tables, key=lambda each: each.fit)
    if not found.pattern:
        raise RecordingError(f'no rows of numbers: give at least one sample in a row, in lines '
                             f'of at most {_MAX_LINE} characters')
    return found


def _first_lines(path: Path) -> tuple[str, list[str]]:
    """Return the coding of a text file and its first lines."""
    with open(path, 'rb') as raw:
        head = raw.read(_MOST_BYTES)
    encoding = 'utf-8-sig'
    if head.startswith((b'\xff\xfe', b'\xfe\xff')):
        encoding = 'utf-16'
    elif 2 * head.count(0) > 0.8 * len(head) > 0:
        encoding = 'utf-16-be' if head[0] == 0 else 'utf-16-le'
    else:
        try:
            head[:head.rfind(b'\n') + 1].decode()
        except UnicodeDecodeError:
            encoding = 'latin-1'
    lines = StringIO(head.decode(encoding, 'replace'), newline=None).readlines()
    if len(head) == _MOST_BYTES:
        lines.pop()
    return encoding, lines[:_MOST_LINES]


def lines_of(file: TextIO) -> Iterator[str]:
    """Iterate over the lines of a file; raises RecordingError if one has no end."""
    while line := file.readline(_MAX_LINE):
        if len(line) >= _MAX_LINE and not line.endswith('\n'):
            raise RecordingError(f'a line is longer than {_MAX_LINE} characters: give a table '
                                 'with one sample per row')
        yield line


def _fields(line: str, delimiter: str) -> list[str]:
    """Return the fields of a line; an empty one has none."""
    line = line.strip('\r\n ').lstrip('#% ')
    if delimiter not in line:
        return [line] if line.strip() else []
    if delimiter != ' ':
        return [text.strip() for text in next(csv.reader([line], delimiter=delimiter))]
    words, names = line.split(), re.split(r'\s{2,}', line)
    return words if len(names) == 1 or reads_as_number(words[0]) else names


def number_of(text: str) -> float:
    """Return the number that a text is, of a clock time the s since midnight; or ValueError."""
    clock = _CLOCK.fullmatch(text)
    if clock is None:
        return float(text)
    hours, minutes, seconds = clock.groups('0')
    return 3600.0 * int(hours) + 60.0 * int(minutes) + float(seconds)


def reads_as_number(text: str) -> bool:
    """Return whether a text is a number, or a clock time."""
    try:
        number_of(text)
    except ValueError:
        return False
    return True


def _unit(text: str) -> str:
    """Return the unit that a text is, in brackets or known; '' for another text."""
    inner = text[1:-1].strip() if text[:1] + text[-1:] in ('()', '[]') else ''
    known = text in _UNITS or (len(text) > 2 and text.lower() in _UNITS)
    return inner or (text if known else '')


def _split(name: str) -> tuple[str, str]:
    """Return a name without the known unit at its end, in small letters, and the unit or ''."""
    found = _IN_NAME.match(name)
    bare, *units = found.groups('') if found else ('', name)
    unit = ''.join(units).strip()
    known = _unit(unit) and (found or unit.lower() in _ALONE)
    return (bare.strip().lower(), unit) if known else (name.strip().lower(), '')


def _hint(lines: Sequence[str]) -> str:
    """Return what the first lines say of the sampling rate."""
    found = [' '.join(f'{line} {"" if _NUMBER.search(line) else after}'.split())[:80]
             for line, after in zip(lines, [*lines[1:], ''])
             if _RATE_WORDS.search(line)]
    return f'; the lines above the table say: {" | ".join(found[:2])}' if found else ''
