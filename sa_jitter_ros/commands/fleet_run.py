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
from typing import Any, TypeVar

from sa_jitter_ros.commands.command_line import FORMATS
from sa_jitter_ros.commands.progress import Progress
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.offline.files import RecordingJob, RecordingRow, remove_unfinished
from sa_jitter_ros.offline.fleet import Failure, find_recordings, run_jobs

Work = TypeVar('Work', bound=RecordingJob)
Row = TypeVar('Row', bound=RecordingRow)
STOPPED = 'stopped; what was finished stays, the same command goes on from there'


def jobs_of(options: argparse.Namespace, job: Callable[..., Work]) -> list[Work]:
    """
    Return a job for each recording of a command line; raises ParameterError if there is none.

    `job` makes one of name, path, folder and `error`.
    """
    found = find_recordings(options.recordings, leave_out=options.output)
    if not found:
        raise ParameterError(f'{", ".join(map(str, options.recordings))}: no recording in this '
                             f'folder: give one with {FORMATS}')
    return [job(item.name, str(item.path), str(options.output.absolute() / item.name),
                error=item.error) for item in found]


def work_through(function: Callable[[Work], Row], jobs: Sequence[Work], rows: list[Row], *,
                 failed: Callable[[str, str, str], Row], options: argparse.Namespace,
                 progress: Progress) -> None:
    """
    Add a row for each job, as soon as it is done; raises as `run_jobs` does.

    `failed` makes the row of a job without one, from name, path and reason.
    """
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


def _say(row: Any, progress: Progress) -> None:
    for remark in row.remarks:
        progress.say(f'warning: {row.recording}: {remark}')
    if row.error:
        progress.say(row.error if row.error.startswith(row.path) else f'{row.path}: {row.error}')
