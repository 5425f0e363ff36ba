# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""What commands for many recordings share: one row for each, said as soon as it is known."""

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
import signal
from typing import Any, Protocol, TypeVar

from sa_jitter_ros.commands.command_line import failure, require_writable
from sa_jitter_ros.commands.progress import Progress
from sa_jitter_ros.errors import ParameterError, SaJitterError
from sa_jitter_ros.nodes.linear_algebra import use_one_thread
from sa_jitter_ros.offline.files import remove_unfinished
from sa_jitter_ros.offline.fleet import find_recordings, Found, run_jobs
from sa_jitter_ros.offline.processes import Failure


class Job(Protocol):
    """A recording, its name in the results, and the folder of its files."""

    @property
    def name(self) -> str:
        """Return the name in the results."""

    @property
    def path(self) -> str:
        """Return the path of the recording."""

    @property
    def folder(self) -> str:
        """Return the folder of its files."""


class Result(Protocol):
    """What became of a recording."""

    @property
    def recording(self) -> str:
        """Return the name in the results."""

    @property
    def path(self) -> str:
        """Return the path of the recording."""

    @property
    def error(self) -> str:
        """Return why it has no result, or ended early; empty if all is well."""

    @property
    def remarks(self) -> tuple[str, ...]:
        """Return what is doubtful."""


Work = TypeVar('Work', bound=Job)
Row = TypeVar('Row', bound=Result)


def recordings_of(options: argparse.Namespace) -> tuple[Found, ...]:
    """Return the recordings of a command line; raises ParameterError if there is none."""
    found = find_recordings(options.recordings, leave_out=options.output)
    if not found:
        raise ParameterError(f'{", ".join(map(str, options.recordings))}: no recording in this '
                             'folder: give one with .npz, .mat, .wav, .csv, .tdms, .mf4, .uff or '
                             'rosbag2')
    return found


def run_to_end(run: Callable[[argparse.Namespace, Progress], list[Row]],
               tell: Callable[[argparse.Namespace, list[Row]], int],
               options: argparse.Namespace, progress: Progress) -> int:
    """
    Run what makes rows, and `tell` what they are; return the exit status.

    It is 2 after one line for what cannot be used or written, 130 for SIGINT and SIGTERM.
    """
    use_one_thread()
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        require_writable(options.output)
        rows = run(options, progress)
    except (SaJitterError, OSError) as error:
        progress.say(failure(error, options.output))
        return 2
    except KeyboardInterrupt:
        progress.say('stopped; what was finished stays, the same command goes on from there')
        return 130
    return tell(options, rows)


def work_through(function: Callable[[Work], Row], jobs: Sequence[Work], rows: list[Row], *,
                 failed: Callable[[str, str, str], Row], options: argparse.Namespace,
                 progress: Progress) -> None:
    """
    Add a row for each job, as soon as it is done; raises as `run_jobs` does.

    `failed` makes the row of a job without one, from name, path and reason. The rows that are
    there already are of recordings without a job.
    """
    for known in rows:
        _say(known, progress)
    for job in jobs:
        remove_unfinished(Path(job.folder))
    try:
        for done, (job, result) in enumerate(run_jobs(
                function, jobs, processes=options.jobs or 1, scheduler=options.scheduler), 1):
            row: Any = (failed(job.name, job.path, str(result)) if isinstance(result, Failure)
                        else result)
            rows.append(row)
            _say(row, progress)
            progress.show(done / len(jobs), f'{done} of {len(jobs)} done')
    finally:
        for job in jobs:  # of workers that died, or were stopped
            remove_unfinished(Path(job.folder))
        progress.clear()


def _say(row: Result, progress: Progress) -> None:
    for remark in row.remarks:
        progress.say(f'warning: {row.recording}: {remark}')
    if row.error:
        progress.say(row.error if row.error.startswith(row.path) else f'{row.path}: {row.error}')
