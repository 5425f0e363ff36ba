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
Share of faults in the code that the tests of its folder notice.

A fault is a number that is ten times as large (0 becomes 1), or a comparison that becomes its
opposite. `cover` runs the tests of the folders and keeps which lines each test executes; `run`
draws faults, makes each in a copy of the package, and asks the tests that execute its line, then
those that execute others of its file, the quickest first, up to a minute in all.

    python benchmarks/mutants.py cover --output cover
    python benchmarks/mutants.py run --cover cover --count 500 --jobs 2

What noticed each is kept in `mutants.json` beside this file; the tests ask some of it.
"""

import argparse
import ast
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import compress, islice
import json
from multiprocessing import Pool
import os
from pathlib import Path
import random
import subprocess
import sys
from typing import Any
from xml.etree import ElementTree

from coverage import CoverageData
from mutations import changed, fails, MARKS, ROOT
import numpy as np

PUBLISHED = Path(__file__).with_suffix('.json')
#: Folders whose code is changed, and their files of tests.
ROOMS = {'pulses': 'test_pulses_*.py', 'averaging': 'test_averaging_*.py',
         'prediction': 'test_prediction*.py', 'keyphasor_check': 'test_keyphasor_*.py',
         'monitoring': 'test_monitoring*.py'}
_LONGEST = 60.0  # s, of the tests that are asked of one fault
_OPPOSITE = {ast.Lt: '>=', ast.LtE: '>', ast.Gt: '<=', ast.GtE: '<', ast.Eq: '!=', ast.NotEq: '=='}

Answer = dict[str, str]


@dataclass(frozen=True)
class Fault:
    """A change of the source: its line, what it replaces there, and the names of its constant."""

    path: str
    line: int
    text: str
    start: int
    end: int
    before: str
    after: str
    constants: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Return the module, the whole line, and the change."""
        return f'{self.path}: {self.text.strip()}: {self.before} -> {self.after} @{self.start}'

    @property
    def changed(self) -> str:
        """Return the line with the fault."""
        return self.text[:self.start] + self.after + self.text[self.end:]


def faults() -> Iterator[Fault]:
    """Yield every fault of `ROOMS`, of which each line can hold several."""
    for room in ROOMS:
        for path in sorted(Path(ROOT, 'sa_jitter_ros', room).glob('*.py')):
            yield from faults_of(str(path.relative_to(ROOT)))


@cache
def faults_of(path: str) -> tuple[Fault, ...]:
    """Return the faults of a file, none if it is no longer there."""
    found: list[Fault] = []
    source = Path(ROOT, path).read_text() if Path(ROOT, path).exists() else ''
    lines = source.splitlines()
    for top in ast.parse(source).body:
        if isinstance(top, (ast.Import, ast.ImportFrom)):
            continue
        constants = () if isinstance(top, (ast.FunctionDef, ast.ClassDef)) else tuple(
            item.id for item in ast.walk(top)
            if isinstance(item, ast.Name) and isinstance(item.ctx, ast.Store))
        for place in filter(None, (_fault(node, lines) for node in ast.walk(top))):
            line, start, end, after = place
            text = lines[line - 1]
            found.append(Fault(path, line, text, start, end, text[start:end], after, constants))
    return tuple(found)


def _fault(node: ast.AST, lines: Sequence[str]) -> tuple[int, int, int, str] | None:
    """Return line, columns and text of the fault of a node; None if it has none."""
    if isinstance(node, ast.Constant) and type(node.value) in (int, float):
        assert node.end_col_offset is not None
        return node.lineno, node.col_offset, node.end_col_offset, repr(10 * node.value or 1)
    if isinstance(node, ast.Compare) and len(node.ops) == 1 and type(node.ops[0]) in _OPPOSITE:
        left, right = node.left, node.comparators[0]
        if left.end_lineno == right.lineno:
            assert left.end_col_offset is not None
            between = lines[right.lineno - 1][left.end_col_offset:right.col_offset]
            sign = between.strip(' ()')
            start = left.end_col_offset + between.index(sign)
            return right.lineno, start, start + len(sign), _OPPOSITE[type(node.ops[0])]
    return None


# --- which tests execute a line ------------------------------------------------------------------

def cover(options: argparse.Namespace) -> int:
    """Run the tests of the folders; keep the lines of each and its time."""
    options.output.mkdir(exist_ok=True)
    data = options.output / 'coverage'
    tests = sorted(f'test/{path.name}' for pattern in ROOMS.values()
                   for path in Path(ROOT, 'test').glob(pattern))
    return subprocess.run([
        sys.executable, '-m', 'pytest', '-q', '--tb=short', '-p', 'no:cacheprovider', '-m', MARKS,
        '--cov=sa_jitter_ros', '--cov-context=test', '--cov-report=',
        f'--junitxml={options.output / "times.xml"}', *tests], cwd=ROOT,
        env={**os.environ, 'COVERAGE_FILE': str(data.resolve())}).returncode


class Cover:
    """Which tests execute which lines, and how long they take, as `cover` wrote them."""

    def __init__(self, folder: Path) -> None:
        self._data = CoverageData(str(folder / 'coverage'))
        self._data.read()
        self._lines: dict[str, dict[int, list[str]]] = {}
        self._seconds = {
            f'{case.get("classname", "").replace(".", "/")}.py::{case.get("name")}':
            float(case.get('time', 0)) for case in ElementTree.parse(
                folder / 'times.xml').iter('testcase')}

    def tests(self, fault: Fault) -> list[str]:
        """Return the tests of a fault's line, then of its file, the quickest first."""
        lines = [(fault.path, fault.line)] if not fault.constants else [
            (str(path.relative_to(ROOT)), node.lineno)
            for path in Path(ROOT, 'sa_jitter_ros').rglob('*.py') for node in ast.walk(
                ast.parse(path.read_text()))
            if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load)
            and node.id in fault.constants]
        of_line = {name for path, line in lines for name in self._of(path).get(line, ())}
        of_file = {name for names in self._of(fault.path).values() for name in names}
        # what runs once, at the import or for a cache, is of the first test that needs it
        asked = sorted((of_line | of_file) - {''}, key=lambda name: (
            name not in of_line, self._seconds.get(name, _LONGEST), name))
        until = np.cumsum([self._seconds.get(name, _LONGEST) for name in asked]) <= _LONGEST
        return list(compress(asked, until))

    def _of(self, path: str) -> dict[int, list[str]]:
        if path not in self._lines:
            self._lines[path] = {
                line: [context.split('|')[0] for context in contexts] for line, contexts in
                self._data.contexts_by_lineno(str(Path(ROOT, path))).items()}
        return self._lines[path]


# --- faults and what notices them ----------------------------------------------------------------

def noticed(fault: Fault, tests: Sequence[str]) -> str:
    """Return the first of some tests that fails with a fault; '' if none does."""
    if not tests:
        return ''
    with changed(fault.path, fault.line, fault.changed):
        return fails(tests)


def _answer(job: tuple[Fault, list[str]]) -> Answer:
    fault, tests = job
    return {'fault': fault.name, 'tests': str(len(tests)), 'noticed': noticed(fault, tests)}


def run(options: argparse.Namespace) -> int:
    """Draw faults and ask the tests; those that are in the output already are left out."""
    known: dict[str, Answer] = {item['fault']: item for item in kept()}
    covered = Cover(options.cover)
    every = sorted(faults(), key=lambda item: (item.path, item.line, item.start))
    drawn = random.Random(options.seed).sample(every, options.count)
    todo = [(fault, covered.tests(fault)) for fault in drawn if fault.name not in known]
    with Pool(options.jobs) as pool:
        for number, answer in enumerate(pool.imap_unordered(_answer, todo), 1):
            known[answer['fault']] = answer
            print(f'{number}/{len(todo)} {answer["fault"]}: '
                  f'{answer["noticed"] or "noticed by none of " + answer["tests"]}', flush=True)
            PUBLISHED.write_text(json.dumps(sorted(
                known.values(), key=lambda item: item['fault']), indent=1) + '\n')
    return table(options)


def table(_: Any = None) -> int:
    """Print how many faults of each folder were noticed."""
    count: Counter[tuple[str, bool]] = Counter(
        (item['fault'].split('/')[1], bool(item['noticed'])) for item in kept())
    for room in [*ROOMS, '']:
        yes, all_ = (sum(number for (name, found), number in count.items()
                         if room in ('', name) and (found or not only)) for only in (True, False))
        print(f'{room or "all"}: {yes} of {all_} noticed ({yes / max(all_, 1):.0%})')
    return 0


def kept() -> list[Answer]:
    """Return the published answers."""
    return json.loads(PUBLISHED.read_text()) if PUBLISHED.exists() else []


def sample(count: int, seed: int) -> list[tuple[Fault, str]]:
    """Draw faults that are still in the source and were noticed, and the test that did."""
    answers = [item for item in kept() if item['noticed']]
    random.Random(seed).shuffle(answers)
    named = (({fault.name: fault for fault in faults_of(item['fault'].partition(':')[0])}, item)
             for item in answers)
    drawn = ((now[item['fault']], item['noticed']) for now, item in named if item['fault'] in now)
    return list(islice(drawn, count))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command."""
    parser = argparse.ArgumentParser(description=__doc__)
    commands = parser.add_subparsers(required=True)
    one = commands.add_parser('cover', help='which tests execute which lines')
    one.add_argument('--output', type=Path, required=True, help='folder')
    one.set_defaults(command=cover)
    two = commands.add_parser('run', help='draw faults, and ask the tests')
    two.add_argument('--cover', type=Path, required=True, help='folder that `cover` wrote')
    two.add_argument('--count', type=int, default=500)
    two.add_argument('--seed', type=int, default=1)
    two.add_argument('--jobs', type=int, default=1)
    two.set_defaults(command=run)
    three = commands.add_parser('table', help='count what was noticed')
    three.set_defaults(command=table)
    options = parser.parse_args(arguments)
    return int(options.command(options))


if __name__ == '__main__':
    sys.exit(main())
