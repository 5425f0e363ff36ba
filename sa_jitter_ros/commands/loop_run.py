# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""What the command `close_loop` does: one report, or one for each of many recordings."""

import argparse
from collections import Counter
from functools import partial
import os

from sa_jitter_ros.commands.command_line import (
    plain_warnings, read_options, run_to_end, show, tacholess_options)
from sa_jitter_ros.commands.fleet_run import jobs_of, STOPPED, work_through
from sa_jitter_ros.commands.progress import Progress
from sa_jitter_ros.declaration import read_declaration
from sa_jitter_ros.loop import close_loop, Loop
from sa_jitter_ros.offline.files import write_rows
from sa_jitter_ros.offline.fleet import is_folder
from sa_jitter_ros.offline.loop_recording import loop_file, LoopJob, LoopRow, with_pulses
from sa_jitter_ros.recordings import read

LOOPS = 'loops.csv'


def is_fleet(options: argparse.Namespace) -> bool:
    """Return whether each recording gets a report of its own."""
    return bool(options.scheduler or options.jobs or any(map(is_folder, options.recordings)))


def run(options: argparse.Namespace, progress: Progress) -> Loop:
    """Close the loop on the recordings; raises SaJitterError."""
    tacholess = tacholess_options(options)
    recordings = [with_pulses(read(path, **read_options(options)), options.declared, tacholess)
                  for path in options.recordings]
    return close_loop(recordings, options.declared, progress=progress.step,
                      names=[str(path) for path in options.recordings])


def show_report(options: argparse.Namespace, progress: Progress) -> int:
    """Close the loop on the recordings and write the report; return the exit status."""
    def write(options: argparse.Namespace, progress: Progress) -> Loop:
        with plain_warnings('close_loop'), progress.ticking():
            found = run(options, progress)
            progress.step('writing the report')
            found.write(options.output)
        return found

    return run_to_end(write, lambda options, found: show(
        'close_loop', found, f'report: {options.output / "report.html"}'), options, progress,
        stopped='stopped before the report was written')


def run_fleet(options: argparse.Namespace, progress: Progress) -> list[LoopRow]:
    """Close the loop on each recording, and write their table; raises SaJitterError, OSError."""
    declaration = read_declaration(options.declared, sample_rate=1e9)
    if declaration.unknown:
        progress.say(f'{options.declared}: ignored, because jitter_predictor has no such '
                     f'parameters: {", ".join(declaration.unknown)}')
    jobs, rows = jobs_of(options, partial(
        LoopJob, declared=os.path.abspath(options.declared), options=read_options(options),
        tacholess=tacholess_options(options))), list[LoopRow]()
    try:
        work_through(loop_file, jobs, rows, failed=LoopRow, options=options, progress=progress)
    finally:
        if any(row.verdict for row in rows):
            write_rows(options.output / LOOPS, rows)
    return rows


def show_fleet(options: argparse.Namespace, progress: Progress) -> int:
    """Close the loop on each recording; return the exit status."""
    return run_to_end(run_fleet, _tell, options, progress, stopped=STOPPED)


def _tell(options: argparse.Namespace, rows: list[LoopRow]) -> int:
    """Say what was found; return 2 if no recording could be used."""
    closed = [row for row in rows if row.verdict]
    if not closed:
        return 2
    counts = Counter(row.verdict for row in closed)
    failed = len(rows) - len(closed)
    return show('close_loop', ', '.join(f'{count} {verdict}' for verdict, count in counts.items())
                + f' of {len(closed)} recording{"s" * (len(closed) > 1)}'
                + (f'; {failed} could not be used' if failed else ''),
                f'table: {options.output / LOOPS}')
