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
Command `average`: synchronous averages of recordings, all that the averager does, as files.

Each recording gets a folder with averages.npz, averages.csv, figures and page.html, which prints;
averages.csv and recordings.csv beside these folders cover all recordings. Recordings that were
finished before are skipped. A folder counts for all recordings below it. --baseline N says whether
the machine has changed since the first N recordings, in changes.json, changes.png and page.html.
"""

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path
import sys

from sa_jitter_ros.commands.command_line import (
    add_fleet_options, add_work_options, few_collections, FORMATS, Parser, read_options,
    run_to_end, show, tacholess_options, whole_from)
from sa_jitter_ros.commands.fleet_run import jobs_of, STOPPED, work_through
from sa_jitter_ros.commands.progress import Progress
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.monitoring.change_test import LEAST_LEARNED
from sa_jitter_ros.monitoring.monitor import Settings
from sa_jitter_ros.offline.average_recording import (
    average_file, AverageJob, RECORDINGS, Row, write_tables)
from sa_jitter_ros.offline.changes import Changes, find_changes, SETTINGS, settings_of
from sa_jitter_ros.offline.settings import MachineFile


def make_parser() -> Parser:
    """Return the parser of the command line."""
    parser = Parser('average', __doc__)
    parser.add_argument('recordings', type=Path, nargs='+', metavar='RECORDING',
                        help=f'{FORMATS}, or a folder of them')
    parser.add_argument('--params', type=Path, metavar='MACHINE.yaml',
                        help='parameter file of the machine; without: settings are chosen from '
                        'each recording')
    parser.add_argument('-p', '--param', action='append', default=[], dest='given',
                        metavar='NAME:=VALUE', help='parameter of synchronous_averager, as in '
                        'trigger_cycles:=60; overrides the file; may be repeated')
    parser.add_argument('--baseline', type=whole_from(LEAST_LEARNED), metavar='N',
                        help='the recordings are those of one machine, in order of time, and the '
                        'first N of them (at least 8) its normal state: say what has changed '
                        f'since; -p also takes {", ".join(SETTINGS)}')
    parser.add_argument('--state', default='', metavar='CHANNEL', help='with --baseline: name or '
                        'number of the channel whose mean is the operating state, for '
                        'state_bin, state_lowest and state_highest')
    parser.add_argument('--output', type=Path, required=True, metavar='DIR',
                        help='folder for the results')
    parser.add_argument('--no-figures', action='store_true',
                        help='write arrays and tables only, no figures and no page')
    add_fleet_options(parser)
    add_work_options(parser)
    return parser


def settings_for_changes(options: argparse.Namespace) -> Settings | None:
    """
    Return the settings of the change monitor, None without a baseline; raises ParameterError.

    Its parameters are taken out of the given ones.
    """
    of_monitor = [text for text in options.given if text.partition(':=')[0] in SETTINGS]
    if options.baseline is None:
        needing = [*['--state'] * bool(options.state), *(f'-p {text}' for text in of_monitor)]
        if needing:
            raise ParameterError(f'{needing[0]} needs --baseline')
        return None
    options.given = [text for text in options.given if text not in of_monitor]
    settings = settings_of(options.params, of_monitor, options.baseline)
    if settings.uses_state != bool(options.state):
        raise ParameterError('--state needs state_bin, state_lowest or state_highest'
                             if options.state else 'state_bin, state_lowest and state_highest '
                             'need --state CHANNEL')
    return settings


def run(options: argparse.Namespace, progress: Progress) -> tuple[list[Row], Changes | None]:
    """
    Average the recordings and write the tables; raises SaJitterError, OSError.

    Return what became of them and, with a baseline, what has changed.
    """
    settings = settings_for_changes(options)
    machine = MachineFile.read(options.params, options.given)
    if machine.unknown:
        progress.say(f'{options.params}: ignored, because synchronous_averager has no such '
                     f'parameters: {", ".join(machine.unknown)}')
    jobs = jobs_of(options, partial(
        AverageJob, machine=machine, options=read_options(options),
        figures=not options.no_figures, state=options.state, tacholess=tacholess_options(options)))
    rows: list[Row] = []

    def alone(job: AverageJob) -> Row:
        done = len(rows)
        return average_file(job, lambda share: progress.show(
            (done + share) / len(jobs), job.name if len(jobs) == 1 else
            f'{job.name}, {done} of {len(jobs)} done'))

    in_this = not options.scheduler and options.jobs in (None, 1)
    try:
        work_through(alone if in_this else average_file, jobs, rows, failed=Row, options=options,
                     progress=progress)
    finally:
        if any(row.averages for row in rows):
            write_tables(options.output, rows)
    if settings is None:
        return rows, None
    averaged = {row.recording for row in rows if row.averages}
    found = find_changes(
        options.output, [job.name for job in jobs if job.name in averaged and not job.error],
        settings, machine.machine, state=options.state)
    found.write(options.output)
    if not options.no_figures:
        from sa_jitter_ros.offline.change_figure import write_figure
        from sa_jitter_ros.offline.machine_page import PAGE, write_page
        write_figure(found, options.output)
        write_page(options.output / found.recordings[-1].name, found, place=options.output / PAGE)
    for line in found.warnings():
        progress.say(f'warning: {line}')
    return rows, found


def tell(options: argparse.Namespace, found: tuple[list[Row], Changes | None]) -> int:
    """Say how many recordings were averaged, and what changed; return 2 if none could be."""
    rows, changes = found
    averaged = [row for row in rows if row.averages]
    if not averaged:
        return 2
    failed = sum(bool(row.error) for row in rows)
    return show('average', f'{sum(row.averages for row in averaged)} averages of {len(averaged)} '
                f'recording{"s" * (len(averaged) > 1)}'
                + (f'; {failed} could not be averaged, or not wholly: see {RECORDINGS}'
                   if failed else ''),
                *(changes.lines() if changes else ()), f'written: {options.output}')


@few_collections()
def main(args: Sequence[str] | None = None) -> int:
    """Average recordings; return 0, or 2 after one line if none could be averaged."""
    options = make_parser().parse_args(args)
    return run_to_end(run, tell, options, Progress('average', quiet=options.quiet),
                      stopped=STOPPED)


if __name__ == '__main__':
    sys.exit(main())
