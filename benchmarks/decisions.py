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
Behaviour of the loop as decisions: whether it is right on machines whose truth is known.

`run` closes the loop on the rows of `decision_machines` and writes a line of JSON for each;
`compare` tells two such files apart, pair by pair (McNemar's exact test); `table` counts rows by
class, source or verdict; `publish` writes `decisions.json` beside this file, which the tests
compare with.

    python benchmarks/decisions.py run --output now.jsonl
    python benchmarks/decisions.py run --output before.jsonl --package ../other_checkout
    python benchmarks/decisions.py compare before.jsonl now.jsonl
"""

import argparse
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import as_completed, ThreadPoolExecutor
from contextlib import contextmanager
from itertools import pairwise
import json
import os
from pathlib import Path
import queue
import select
import subprocess
import sys
import tempfile
from typing import Any

from decision_judge import (
    Answer, count, decision, judge, Judgement, mcnemar, names_of, OUTCOMES, stated)
from decision_machines import Row, rows
from decision_outside import Absent
from decision_own import Drawn
from decision_worker import answer, LIMIT
import numpy as np
from scipy import stats

PUBLISHED = Path(__file__).with_suffix('.json')
_ROOT = Path(__file__).resolve().parents[1]
_WALL = 10.0 * LIMIT  # s, for a worker that does not count its time
_LEVELS = 0.05, 0.25, 0.5, 0.75, 0.95
_BINS = 0.0, 0.01, 0.1, 0.5, 0.9, 1.1

Result = Mapping[str, Any]


# --- one row -------------------------------------------------------------------------------------

class Worker:
    """A process that closes the loop with the package in a folder; begun anew if it is lost."""

    def __init__(self, package: Path) -> None:
        self._package = package
        self._process: subprocess.Popen[str] | None = None

    def ask(self, job: Mapping[str, Any]) -> Answer:
        """Return the answer to a job."""
        process = self._process = self._process or subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name('decision_worker.py'))], text=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            cwd=tempfile.gettempdir(), env={
                **os.environ, 'PYTHONPATH': str(self._package), 'OMP_NUM_THREADS': '1'})
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(json.dumps(job) + '\n')
        process.stdin.flush()
        ready = select.select([process.stdout], [], [], _WALL)[0]
        line = process.stdout.readline() if ready else ''
        if not line:
            self.close()
            return Answer(crash='the process ended' if ready else f'no answer in {_WALL:g} s')
        return Answer(**json.loads(line))

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None


@contextmanager
def stored(drawn: Drawn) -> Iterator[Mapping[str, Any]]:
    """Write recordings and declaration to a temporary folder; yield the job of a worker."""
    with tempfile.TemporaryDirectory(prefix='decisions_') as name:
        files = [Path(name, f'{number}.npz') for number, _ in enumerate(drawn.recordings)]
        for file, fields in zip(files, drawn.recordings):
            np.savez(file, **fields)
        declared = Path(name, 'model.yaml')
        declared.write_text(drawn.declared, encoding='utf-8')
        yield {'files': [str(file) for file in files], 'declared': str(declared),
               'again': drawn.again, 'page': drawn.page}


def result(row: Row, worker: Worker | None = None) -> Result:
    """Return what came of a row, in this process or in that of a worker."""
    drawn = row.draw()
    with stored(drawn) as job:
        if worker is not None:
            found = worker.ask(job)
        else:
            found = Answer(**answer(**job))
    return {**_line(row, found, judge(found, drawn.expected)),
            'stated': stated(found.report, drawn.expected)}


def _line(row: Row, found: Answer, judged: Judgement) -> Result:
    report = found.report
    errors = {when: report.get(f'error_{when}') or {} for when in ('before', 'after')}
    kept = {key: report[key] for key in ('remains', 'remarks', 'declared_changes', 'clock_steps',
                                         'unsteady_lines', 'not_testable') if report.get(key)}
    scores = {f'{key}_{when}': value for when, item in errors.items()
              for key, value in item.items() if 'log_score' in key}
    return {
        'name': row.name, 'class': row.group, 'source': row.source, 'reserved': row.reserved,
        'right': judged.right, 'outcome': judged.outcome, 'why': list(judged.why),
        'verdict': report.get('verdict', ''), 'effects': sorted(names_of(report)),
        'present': sorted(item['name'] for item in report.get('present') or ()),
        'sizes': judged.sizes, 'error': found.error, 'crash': found.crash,
        'rms_before': errors['before'].get('rms'), 'rms_after': errors['after'].get('rms'),
        'p_value': errors['after'].get('p_value'), **scores, 'seconds': found.seconds, **kept}


# --- commands ------------------------------------------------------------------------------------

def run(options: argparse.Namespace) -> int:
    """Close the loop on rows; those that are in the output already are left out."""
    done = {row['name'] for row in _read(options.output)} if options.output.exists() else set()
    todo = [row for row in rows(options.seeds) if row.name not in done
            and options.only in row.name and options.group in ('', row.group)
            and options.half in ('', 'reserved' if row.reserved else 'open')]
    idle: queue.SimpleQueue[Worker] = queue.SimpleQueue()
    workers = [Worker(options.package.resolve()) for _ in range(options.jobs)]
    for worker in workers:
        idle.put(worker)

    def work(row: Row) -> Result:
        worker = idle.get()
        try:
            return result(row, worker)
        finally:
            idle.put(worker)

    pool = ThreadPoolExecutor(options.jobs)
    try:
        with options.output.open('a') as output:
            futures = {pool.submit(work, row): row for row in todo}
            for number, future in enumerate(as_completed(futures), 1):
                name = futures[future].name
                try:
                    found = future.result()
                except Absent as reason:
                    _say(f'{number}/{len(todo)} {name}: skipped, {reason}')
                    continue
                output.write(json.dumps(found) + '\n')
                output.flush()
                _say(f'{number}/{len(todo)} {name}: {found["outcome"]}, {found["verdict"]} '
                     f'{"+".join(found["effects"])}, {found["seconds"]:.1f} s'
                     f'{"".join(f"; {item}" for item in found["why"])}')
    finally:
        pool.shutdown(cancel_futures=True)
        for worker in workers:
            worker.close()
    return 0


def compare(options: argparse.Namespace) -> int:
    """Print what changed between two files of results, and how likely by chance."""
    first, second = ({row['name']: row for row in _read(path)} for path in options.results)
    both = [name for name in first if name in second]
    parts: dict[str, list[tuple[bool, bool]]] = {}
    for name in both:
        pair = (first[name]['right'], second[name]['right'])
        for title in (first[name][options.by], 'all, reserved' if first[name]['reserved'] else
                      'all, open', 'all'):
            parts.setdefault(title, []).append(pair)
    print(f'| {options.by} | rows | right before, after | better | worse | p |\n'
          '|---|---|---|---|---|---|')
    for title, pairs in sorted(parts.items(), key=lambda item: item[0].startswith('all')):
        better, worse = pairs.count((False, True)), pairs.count((True, False))
        if better or worse or title.startswith('all'):
            print(f'| {title} | {len(pairs)} | {sum(a for a, _ in pairs)}, '
                  f'{sum(b for _, b in pairs)} | {better} | {worse} | '
                  f'{mcnemar(better, worse):.2g} |')
    for title, before in (('better', False), ('worse', True)):
        changed = [name for name in both if (first[name]['right'], second[name]['right']) == (
            before, not before)]
        print(f'\n{title}: {len(changed)}')
        for name in changed:
            print(f'* {name}: {_short(first[name])} -> {_short(second[name])}')
    return 0


def _short(row: Result) -> str:
    why = f' ({"; ".join(row["why"])})' if row.get('why') else ''
    return f'{row["verdict"] or "refused"} {"+".join(row["effects"])}'.strip() + why


def table(options: argparse.Namespace) -> int:
    """Print how the rows of each class, source or verdict ended."""
    found = _read(options.results)
    wrong = {_title(row, options.by) for row in found if not row['right']}
    print(markdown(found, by=options.by, only=wrong if options.wrong else None))
    return 0


def markdown(found: Sequence[Result], *, by: str = 'class', only: set[str] | None = None) -> str:
    """Return how rows ended, open and reserved ones apart, as a table; `only` of some classes."""
    lines = [f'| {by} | rows | ' + ' | '.join(OUTCOMES) + ' |', '|---|' + '---|' * (
        len(OUTCOMES) + 1)]
    titles = dict.fromkeys(_title(row, by) for row in found)
    for title in (*(item for item in titles if only is None or item in only), ''):
        halves = [[row for row in found if title in ('', _title(row, by))
                   and row['reserved'] == reserved] for reserved in (False, True)]
        cells = [', '.join(str(count(half, outcome)) for half in halves)
                 for outcome in OUTCOMES]
        lines.append(f'| {title or "all"} | {", ".join(str(len(half)) for half in halves)} | '
                     + ' | '.join(cells) + ' |')
    return '\n'.join([*lines, '', _calibration(found)])


def _title(row: Result, by: str) -> str:
    """Return the class, source or verdict of a row; one that was refused has no verdict."""
    return row[by] or 'refused'


def _calibration(found: Sequence[Result]) -> str:
    """Return whether the p values of right reports are even, and how often effects are there."""
    lines = []
    for verdict in ('none', 'traced'):
        values = [row['p_value'] for row in found if row['p_value'] is not None and row['right']
                  and row['verdict'] == verdict]
        if len(values) > 1:
            even = stats.kstest(values, 'uniform').pvalue
            shares = ', '.join(f'{np.mean(np.array(values) <= p):.2f}' for p in _LEVELS)
            lines.append(f'{len(values)} p values of right `{verdict}`: {shares} are at most '
                         f'{", ".join(map(str, _LEVELS))}; Kolmogorov-Smirnov p {even:.2g}')
    pairs = [pair for row in found for pair in row.get('stated') or ()]
    if pairs:
        value, there = np.array(pairs, float).T
        lines += [f'{there.size} probabilities of effects, Brier score '
                  f'{np.mean((value - there) ** 2):.2g} '
                  f'({np.mean(there) * (1.0 - np.mean(there)):.2g} by their share alone)', '',
                  '| stated | effects | mean stated | there |', '|---|---|---|---|']
        for low, high in pairwise(_BINS):
            here = (value >= low) & (value < high)
            if here.any():
                lines.append(f'| {low:g} to {min(high, 1.0):g} | {here.sum()} | '
                             f'{value[here].mean():.2g} | {there[here].mean():.2g} |')
    return '\n'.join(lines)


def publish(options: argparse.Namespace) -> int:
    """Write the results that the tests compare with."""
    kept = {row['name']: {**decision(row), **({'why': row['why']} if row['why'] else {})}
            for row in _read(options.results)}
    lines = (f'{json.dumps(name)}: {json.dumps(kept[name])}' for name in sorted(kept))
    PUBLISHED.write_text('{\n' + ',\n'.join(lines) + '\n}\n', encoding='utf-8')
    return 0


def check(options: argparse.Namespace) -> int:
    """Print the rows whose decision is another than the published one."""
    known, every = published(), {row.name: row for row in rows()}
    for name in options.names or known:
        _say(name)
        found = {**known[name], **decision(result(every[name]))}
        if found != known[name]:
            print(f'{name}: {_short(found)} for {_short(known[name])}', flush=True)
            if options.first:
                return 1
    return 0


def published() -> Mapping[str, Result]:
    """Return the published results by the name of the row."""
    found: Mapping[str, Result] = json.loads(PUBLISHED.read_text(encoding='utf-8'))
    return found


def _read(path: Path) -> list[Result]:
    return [json.loads(line) for line in path.read_text(encoding='utf-8').splitlines()]


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    one = commands.add_parser('run', help='close the loop on the rows')
    one.add_argument('--output', type=Path, required=True, help='a line of JSON for each row')
    one.add_argument('--only', default='', help='only rows with this text in their name')
    one.add_argument('--class', dest='group', default='', help='only rows of this class')
    one.add_argument('--open', dest='half', action='store_const', const='open', default='')
    one.add_argument('--reserved', dest='half', action='store_const', const='reserved')
    one.add_argument('--seeds', type=int, help='rows of each class, instead of those of the table')
    one.add_argument('--jobs', type=int, default=1)
    one.add_argument('--package', type=Path, default=_ROOT, help='checkout of the version to run')
    one.set_defaults(command=run)
    two = commands.add_parser('compare', help='two files of results, row by row')
    two.add_argument('results', type=Path, nargs=2)
    two.add_argument('--by', choices=('class', 'source'), default='class')
    two.set_defaults(command=compare)
    three = commands.add_parser('table', help='count the rows that are right')
    three.add_argument('results', type=Path)
    three.add_argument('--by', choices=('class', 'source', 'verdict'), default='class')
    three.add_argument('--wrong', action='store_true', help='only classes with a wrong row')
    three.set_defaults(command=table)
    four = commands.add_parser('publish', help=f'write {PUBLISHED.name}')
    four.add_argument('results', type=Path)
    four.set_defaults(command=publish)
    five = commands.add_parser('check', help='rows whose decision is not the published one')
    five.add_argument('names', nargs='*', help='rows, all if none is named')
    five.add_argument('--first', action='store_true', help='stop at the first')
    five.set_defaults(command=check)
    options = parser.parse_args(arguments)
    return int(options.command(options))


if __name__ == '__main__':
    sys.exit(main())
