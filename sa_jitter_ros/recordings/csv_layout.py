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
that a preamble. Fields are separated by comma, semicolon or tab; with semicolons or tabs a comma
is a decimal point.
"""

from collections import Counter
from collections.abc import Sequence
import csv
from dataclasses import dataclass, replace
from pathlib import Path
import re

from sa_jitter_ros.errors import RecordingError

MAX_LINE = 1 << 20
_MOST_LINES, _MOST_CHARACTERS = 1000, 1 << 20  # at the start of a file, that show its structure
_HINTS = 40  # lines, in which a sampling rate may be stated beside the samples
_LEAST_ROWS = 3  # that begin the samples; fewer are a part of the preamble
_DELIMITERS = ';\t,'
_TIME_NAMES = ('time', 't', 'time_s')
_SECONDS = {'s': 1.0, 'sec': 1.0, 'second': 1.0, 'seconds': 1.0, 'ms': 1e-3, 'us': 1e-6,
            '\u00b5s': 1e-6, '\u03bcs': 1e-6, 'ns': 1e-9}
# Known without brackets, also words for the number of a row.
_UNITS = {*_SECONDS, 'V', 'mV', 'uV', '\u00b5V', 'volt', 'volts', 'A', 'mA', 'amp', 'ampere',
          'g', 'mg', 'm/s2', 'm/s^2', 'm/s\u00b2', 'mm/s', 'm/s', 'mm', 'um', '\u00b5m', 'Hz',
          'rpm', '1/min', 'deg', 'rad', 'dB', '%', 'Pa', 'bar', 'N', 'Nm', 'EU',
          'index', 'sequence', 'sample', 'point'}
_IN_NAME = re.compile(r'^(.*?)(?:\s*[\[(]([^\])]*)[\])]|(?:^|,?\s)in\s+(\S+))$')
_RATE_WORDS = re.compile(r'interval|increment|period|resolution|rate|dt\b', re.IGNORECASE)
_NUMBER = re.compile(r'(?<!\w)[-+.]?\d')


@dataclass(frozen=True)
class CsvLayout:
    """
    The layout of a file.

    Parameters
    ----------
    delimiter
        Of the fields.
    encoding
        Of the text.
    skipped
        Number of lines above the first row of samples.
    names
        Of the columns; without a line of names their numbers.
    units
        Of the columns, '' where unknown.
    fields
        Number of fields of a row.
    used
        The columns that are not empty all along.
    time
        The column with the times; None for none.
    time_unit
        Of the times, s.
    hint
        What the preamble says of the sampling rate.
    remarks
        What was left out, one sentence each.

    """

    delimiter: str
    encoding: str
    skipped: int
    names: tuple[str, ...]
    units: tuple[str, ...]
    fields: int
    used: tuple[int, ...]
    time: int | None = None
    time_unit: float = 1.0
    hint: str = ''
    remarks: tuple[str, ...] = ()

    def pointed(self, line: str) -> str:
        """Return a row with decimal points."""
        return line if self.delimiter == ',' else line.replace(',', '.')

    def with_time(self, name: str) -> 'CsvLayout':
        """Return this layout with the time column of a name, without one with that it shows."""
        if name:
            column = self.names.index(name)
        else:
            named = [k for k, text in enumerate(self.names) if _bare(text) in _TIME_NAMES
                     and (self._seconds(k) or not self.units[k])]
            timed = [k for k in self.used if self._seconds(k)]
            found = named or (timed if len(timed) == 1 else [])
            if not found:
                return self
            column = found[0]
        return replace(self, time=column, time_unit=self._seconds(column) or 1.0)

    def _seconds(self, column: int) -> float:
        """Return the unit of a column in s, 0 for one that is no unit of time."""
        return _SECONDS.get(self.units[column], 0.0) or _SECONDS.get(
            self.units[column].lower() if len(self.units[column]) > 2 else '', 0.0)


def layout_of(path: Path) -> CsvLayout:
    r"""
    Return the layout of a file, from its first lines.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder, 'scope.csv')
    ...     _ = path.write_text('Model,X1\nTime,A\n(ms),(V)\n\n0.0,1.2\n0.5,1.3\n1.0,1.2\n')
    ...     layout = layout_of(path).with_time('')
    >>> layout.skipped, layout.names, layout.units, layout.time, layout.time_unit
    (4, ('Time', 'A'), ('ms', 'V'), 0, 0.001)
    """
    encoding, lines = _first_lines(path)
    tables = {mark: _table(lines, mark) for mark in _DELIMITERS}
    delimiter = max(_DELIMITERS, key=lambda mark: _pattern(tables[mark], mark)[0])
    table = tables[delimiter]
    _, pattern = _pattern(table, delimiter)
    start = _start(table, pattern, delimiter)
    rows = [row for row in table[start:] if row]
    fields = Counter(map(len, rows)).most_common(1)[0][0] if rows else 0
    above = [number for number, row in enumerate(table[:start]) if row]
    header, units = _header(table, above, pattern)
    names = [] if header is None else table[header]
    width = max(len(names), fields)
    labels = [str(column) for column in range(width)] if header is None else (
        names + [''] * (width - len(names)))
    given = ([] if units is None else table[units]) + [''] * width
    preamble = [number for number in above if header is None or number < header]
    filled = Counter(column for row in rows for column, text in enumerate(row) if text)
    return CsvLayout(
        delimiter, encoding, start, tuple(labels),
        tuple(_unit(text) or _unit_in(name) for name, text in zip(labels, given)),
        fields or width, tuple(k for k in range(width) if 2 * filled[k] >= max(len(rows), 1)
                               or not rows),
        hint=_hint(lines[:max(start, _HINTS)]),
        remarks=(f'{len(preamble)} line{"s" * (len(preamble) > 1)} above the table skipped: no '
                 'samples',) if preamble else ())


def _first_lines(path: Path) -> tuple[str, list[str]]:
    """Return the coding of a text file and its first lines."""
    with open(path, 'rb') as raw:
        head = raw.read(_MOST_CHARACTERS)
    encoding = 'utf-8-sig'
    if head.startswith((b'\xff\xfe', b'\xfe\xff')):
        encoding = 'utf-16'
    else:
        try:
            head[:head.rfind(b'\n') + 1].decode()
        except UnicodeDecodeError:
            encoding = 'latin-1'
    with open(path, encoding=encoding, errors='replace', newline=None) as file:
        lines: list[str] = []
        size = 0
        while len(lines) < _MOST_LINES and size < _MOST_CHARACTERS and (
                line := file.readline(MAX_LINE)):
            if lines and len(line) >= MAX_LINE and not line.endswith('\n'):
                raise RecordingError(f'a line is longer than {MAX_LINE} characters: give a table '
                                     'with one sample per row')
            lines.append(line)
            size += len(line)
    return encoding, lines


def _table(lines: Sequence[str], delimiter: str) -> list[list[str]]:
    """Return the fields of lines, a list for each, which is empty for an empty line."""
    return [[] if line.isspace() else _fields(line.strip('\r\n'), delimiter)
            for line in lines]


def _fields(line: str, delimiter: str) -> list[str]:
    if delimiter not in line and delimiter != ',':
        return [line.strip()]
    return [text.strip() for text in next(csv.reader([line], delimiter=delimiter), [])]


def _numbers(row: Sequence[str], delimiter: str) -> frozenset[int]:
    """Return the columns of a row that are numbers; without the delimiter there are none."""
    if len(row) < 2 and delimiter != ',':
        return frozenset()
    return frozenset(column for column, text in enumerate(row)
                     if reads_as_number(text if delimiter == ',' else text.replace(',', '.')))


def reads_as_number(text: str) -> bool:
    """Return whether a text is a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def _pattern(table: Sequence[Sequence[str]], delimiter: str) -> tuple[int, frozenset[int]]:
    """Return the columns that are numbers in most rows, and in how many rows they are."""
    counts = Counter(filter(None, (_numbers(row, delimiter) for row in table)))
    if not counts:
        return 0, frozenset()
    pattern = max(counts, key=lambda columns: (counts[columns], len(columns)))
    return counts[pattern], pattern


def _start(table: Sequence[Sequence[str]], pattern: frozenset[int], delimiter: str) -> int:
    """Return the number of the first row of samples; without samples 1."""
    runs: list[list[int]] = [[]]  # of rows that have the numbers
    for number, row in enumerate(table):
        if pattern and pattern <= _numbers(row, delimiter):
            runs[-1].append(number)
        elif row:
            if runs[-1] and not _numbers(row, ',') and _is_text(row, pattern):  # names, perhaps
                runs.append([])
            elif runs[-1] and len(runs[-1]) < _LEAST_ROWS:
                return runs[-1][0]
    found = [run for run in runs if run]
    longest = max(map(len, found), default=0)
    return next((run[0] for run in found if len(run) >= min(_LEAST_ROWS, longest)), 1)


def _is_text(row: Sequence[str], pattern: frozenset[int]) -> bool:
    """Return whether a row may name columns: text, or the number of a channel, in each of them."""
    texts = [row[column] if column < len(row) else '' for column in pattern]
    if len(row) < min(2, len(pattern)):
        return False
    return any(text and not reads_as_number(text.replace(',', '.')) for text in texts) and all(
        text.isdecimal() or not reads_as_number(text.replace(',', '.')) for text in texts)


def _header(table: Sequence[Sequence[str]], above: Sequence[int], pattern: frozenset[int]
            ) -> tuple[int | None, int | None]:
    """Return the rows of names and of units, of the rows `above` the samples; None for none."""
    texts = [number for number in above[-2:] if _is_text(table[number], pattern)]
    if not above or above[-1] not in texts:
        return (above[0], None) if above and not pattern else (None, None)
    last = table[above[-1]]
    named = [last[column] for column in pattern if column < len(last) and last[column]]
    units = sum(bool(_unit(text)) for text in named)
    if len(texts) == 2 and 2 * units >= len(named) and not any(
            _bare(text) in _TIME_NAMES for text in named):
        return texts[0], texts[1]
    return above[-1], None


def _unit(text: str) -> str:
    """Return the unit that a text is, in brackets or known; '' for another text."""
    inner = text[1:-1].strip() if text[:1] + text[-1:] in ('()', '[]') else ''
    return inner or (text if _is_unit(text) else '')


def _is_unit(text: str) -> bool:
    return text in _UNITS or (len(text) > 2 and text.lower() in _UNITS)


def _unit_in(name: str) -> str:
    """Return the known unit at the end of a name, '' for none."""
    found = _IN_NAME.match(name)
    unit = (found.group(2) or found.group(3)).strip() if found else ''
    return unit if _is_unit(unit) else ''


def _bare(name: str) -> str:
    """Return a name without its unit, in small letters."""
    found = _IN_NAME.match(name)
    return (found.group(1) if found and _unit_in(name) else name).strip().lower()


def _hint(lines: Sequence[str]) -> str:
    """Return what the first lines say of the sampling rate."""
    found = [' '.join(f'{line} {"" if _NUMBER.search(line) else after}'.split())[:80]
             for line, after in zip(lines, [*lines[1:], ''])
             if _RATE_WORDS.search(line)]
    return f'; the lines above the table say: {" | ".join(found[:2])}' if found else ''
