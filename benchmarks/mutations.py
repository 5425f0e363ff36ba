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
Which numbers of the package no published decision, and no test, depends on.

`python benchmarks/mutations.py` moves each number in the constants of `inference` and `effects` by
a factor of ten, up or else down, in a copy of the package, and looks whether the decision on one
of the open rows (`decisions.py`) becomes another. For those of `keyphasor_check` and `pulses` it
looks whether one of the tests of the folder fails. What noticed is kept in `mutations.json` beside
this file, so that the next run asks it first, and the tests ask some of it.
"""

import argparse
import ast
from collections import Counter
from collections.abc import Iterator, Sequence
import compileall
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
import json
import os
from pathlib import Path
import random
import shutil
import subprocess
import sys
import tempfile

from decision_machines import BROKEN, INDEPENDENT, LOOP, OWN, rows
from decisions import published

NOTICED = Path(__file__).with_suffix('.json')
ROOT = Path(__file__).resolve().parents[1]
_PACKAGE = 'sa_jitter_ros'
_ROOMS = 'inference', 'effects', 'keyphasor_check', 'pulses'
#: The tests of folders on whose numbers no row is asked.
_TESTS = {'keyphasor_check': 'test_keyphasor_*.py', 'pulses': 'test_pulses_*.py'}
MARKS = 'not (build or campaign or processes or style)'
_FACTOR = 10
_LONGEST = 600.0  # s, of a row: a search that does not end is noticed
_OF_A_ROW = 4  # numbers, in a sample
#: Rows that take more than 2 s, and a test that does with its number moved; no sample asks them.
_SLOW = ('damaged drifting 0', 'damaged fading 0', 'damaged short 0',
         'independent excess_jitter 4', 'independent interfering_tone 0',
         'independent clock_skew 0', 'independent late_recovery 0', 'independent resonance 2',
         'independent speed_fluctuation 0', 'lost 5 samples 0',
         'test/test_pulses_sampled_angle.py::test_pulses_have_the_error_that_is_shown[1-options0]')


@dataclass(frozen=True)
class Number:
    """A number in a constant: its name, its file, and where it stands in the line."""

    name: str
    path: str
    line: int
    start: int
    end: int
    value: float

    @property
    def asked(self) -> list[str]:
        """Return what may notice it: the open rows, or the files of tests of its folder."""
        tests = _TESTS.get(self.name.split('.')[0])
        return sorted(f'test/{path.name}' for path in (ROOT / 'test').glob(tests)) if tests else (
            cases())

    def moved(self, up: bool) -> str | None:
        """Return the number ten times larger or smaller as source; None where it is the same."""
        if isinstance(self.value, int):
            value: float = self.value * _FACTOR if up else self.value // _FACTOR
        else:
            value = self.value * _FACTOR if up else self.value / _FACTOR
        return None if value == self.value or (value == 0 and isinstance(value, int)) else repr(
            value)


def numbers() -> Iterator[Number]:
    """Yield every number of a constant at the level of a module, but the seeds."""
    for room in _ROOMS:
        for path in sorted((ROOT / _PACKAGE / room).glob('*.py')):
            for node in ast.parse(path.read_text()).body:
                if isinstance(node, ast.Assign):
                    targets, value = node.targets[0], node.value
                elif isinstance(node, ast.AnnAssign) and node.value is not None:
                    targets, value = node.target, node.value
                else:
                    continue
                names = [item.id for item in ast.walk(targets) if isinstance(item, ast.Name)]
                if not all(name.lstrip('_').isupper() for name in names):
                    continue
                values = value.elts if isinstance(value, ast.Tuple) else [value]
                if len(names) == 1 < len(values):
                    names = [f'{names[0]}[{index}]' for index in range(len(values))]
                elif len(names) == 1:
                    values = [value]
                for name, item in zip(names, values):
                    found = [leaf for leaf in ast.walk(item) if isinstance(leaf, ast.Constant)
                             and isinstance(leaf.value, (int, float))
                             and not isinstance(leaf.value, bool) and leaf.value]
                    for index, leaf in enumerate(found):
                        if 'SEED' not in name and leaf.end_col_offset is not None:
                            yield Number(
                                f'{room}.{path.stem}.{name}' + f'#{index}' * (len(found) > 1),
                                str(path.relative_to(ROOT)), leaf.lineno, leaf.col_offset,
                                leaf.end_col_offset, leaf.value)


def cases() -> list[str]:
    """Return the open rows that need nothing from outside."""
    known = published()
    return [row.name for row in rows() if not row.reserved and row.name in known
            and row.source in (OWN, INDEPENDENT, BROKEN, LOOP)]


def noticed(number: Number, up: bool, asked: Sequence[str]) -> str:
    """Return the first row, or test, that the moved number changes; '' if there is none."""
    moved = number.moved(up)
    if moved is None or not asked:
        return ''
    line = Path(ROOT, number.path).read_text().splitlines()[number.line - 1]
    with changed(number.path, number.line, line[:number.start] + moved + line[number.end:]):
        return fails(asked) if asked[0].startswith('test/') else differs(asked)


@contextmanager
def changed(path: str, number: int, line: str) -> Iterator[None]:
    """Replace a line of a file in the copy."""
    file = Path(_copy().name, path)
    before = file.read_text()
    lines = before.split('\n')
    lines[number - 1] = line
    file.write_text('\n'.join(lines))
    try:
        yield
    finally:
        file.write_text(before)


@cache
def _copy() -> 'tempfile.TemporaryDirectory[str]':
    """Return a compiled copy of the package, whose files are moved one after the other."""
    copy = tempfile.TemporaryDirectory()
    shutil.copytree(ROOT / _PACKAGE, Path(copy.name, _PACKAGE))
    compileall.compile_dir(copy.name, quiet=1)
    return copy


def differs(asked: Sequence[str]) -> str:
    """
    Return the first row whose decision is another in the copy; '' if none is.

    A search that does not end is another result, too.
    """
    command = [sys.executable, str(ROOT / 'benchmarks' / 'decisions.py'), 'check', '--first',
               *asked]
    environment = {**os.environ, 'PYTHONPATH': _copy().name, 'PYTHONDONTWRITEBYTECODE': '1'}
    with tempfile.TemporaryFile('w+') as names:
        try:
            if not subprocess.run(command, stdout=subprocess.DEVNULL, stderr=names,
                                  timeout=_LONGEST, env=environment).returncode:
                return ''
        except subprocess.TimeoutExpired:
            pass
        names.seek(0)
        return [line.strip() for line in names if line.strip() in asked][-1]


def fails(tests: Sequence[str]) -> str:
    """
    Return the first of some tests, or files of them, that fails with the copy; '' if none does.

    One that does not end has failed, too.
    """
    paths = f'pythonpath={_copy().name} {ROOT / "benchmarks"}'
    command = [sys.executable, '-m', 'pytest', '-x', '-q', '--tb=no', '--assert=plain',
               '-p', 'no:cacheprovider', '-m', MARKS, '-o', paths, *tests]
    environment = {**os.environ, 'PYTHONPATH': _copy().name, 'PYTHONSAFEPATH': '1',
                   'PYTHONDONTWRITEBYTECODE': '1', 'PYTEST_DISABLE_PLUGIN_AUTOLOAD': '1'}
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_LONGEST,
                              cwd=ROOT, env=environment)
    except subprocess.TimeoutExpired:
        return tests[0]
    names = [line.split(' ', 1)[1].split(' - ')[0] for line in done.stdout.splitlines()
             if line.startswith(('FAILED ', 'ERROR '))]
    return next(iter(names), '') if done.returncode else ''


def kept() -> dict[str, list[str]]:
    """Return which way each number was moved before, and the row that noticed it, '' for none."""
    return json.loads(NOTICED.read_text()) if NOTICED.exists() else {}


def sample(count: int, seed: int) -> list[tuple[Number, str, str]]:
    """
    Draw numbers that a quick row noticed before: the number, which way it moved, and the row.

    At most four numbers of a row are drawn, so that many rows are asked.
    """
    known = kept()
    every = [(number, *known[number.name]) for number in numbers()
             if known.get(number.name, ['', ''])[1]]
    random.Random(seed).shuffle(every)
    asked: Counter[str] = Counter(dict.fromkeys(_SLOW, _OF_A_ROW))
    drawn = []
    for number, way, name in every:
        asked[name] += 1
        if asked[name] <= _OF_A_ROW:
            drawn.append((number, way, name))
    return drawn[:count]


def main(arguments: Sequence[str] | None = None) -> int:
    """Move the numbers, and print what notices each; 1 if nothing notices some."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--only', default='', help='only names with this text')
    parser.add_argument('--new', action='store_true', help='only numbers that nothing noticed yet')
    parser.add_argument('--stale', action='store_true',
                        help='only numbers that the row which noticed them no longer notices')
    parser.add_argument('--rows', nargs='*', help='the rows, or files of tests, that are asked')
    options = parser.parse_args(arguments)
    known = kept()
    chosen = [number for number in numbers() if options.only in number.name]
    for number in chosen:
        last, before = known.get(number.name, ['', ''])
        if options.new and before:
            continue
        if options.stale and (not before or noticed(number, last == 'up', [before])):
            continue
        found = ['', '']
        asked = number.asked if options.rows is None else options.rows
        for way in sorted(('up', 'down'), key=lambda item: item != last):
            name = noticed(number, way == 'up', [
                *([before] if before else []), *(each for each in asked if each != before)])
            if name:
                found = [way, name]
                break
        known[number.name] = found
        print(f'{number.name} {number.value}: {" ".join(found)}', flush=True)
        NOTICED.write_text(json.dumps(known, indent=1, sort_keys=True) + '\n')
    missed = [number.name for number in chosen if not known.get(number.name, ['', ''])[1]]
    print(f'{len(missed)} of {len(chosen)} are noticed by nothing: {", ".join(missed)}')
    return int(bool(missed))


if __name__ == '__main__':
    sys.exit(main())
