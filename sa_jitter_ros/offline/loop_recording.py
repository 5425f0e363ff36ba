# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""One recording: its loop closed, by a function of a job that any process can do."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
import json
import math
from pathlib import Path
from typing import Any
import warnings

from sa_jitter_ros.errors import DataWarning, one_line
from sa_jitter_ros.json_values import json_text
from sa_jitter_ros.keyphasor_check.machine_file import on_target
from sa_jitter_ros.loop import close_loop, Loop
from sa_jitter_ros.machine import Machine
from sa_jitter_ros.offline.files import RecordingJob, RecordingRow, row_values
from sa_jitter_ros.parameter_file import read_parameters
from sa_jitter_ros.recordings import read, Recording
from sa_jitter_ros.tacholess.recording import Tacholess

_VERSION = 2  # of the files: those of another one are written again
_JOB = 'job.json'  # what a finished folder is of


@dataclass(frozen=True, kw_only=True)
class LoopJob(RecordingJob):
    """One recording whose loop is closed, with the path of the parameter file."""

    declared: str


@dataclass(frozen=True)
class LoopRow(RecordingRow):
    """
    What became of one recording: `error`, or `verdict` and what was found.

    With several shafts the RMS errors are those of the worst one.
    """

    verdict: str = ''
    missing_effects: tuple[str, ...] = ()
    rms_before: float = math.nan
    rms_after: float = math.nan
    remarks: tuple[str, ...] = ()


def with_pulses(recording: Recording, params: Path, tacholess: Tacholess | None) -> Recording:
    """Return a recording whose pulses are found in the vibration, if that is asked."""
    if tacholess is None:
        return recording
    machine = Machine.among(read_parameters(params, 'jitter_predictor'))
    found, _ = tacholess.pulses_of(on_target(recording, params), machine)
    warnings.warn(found.remarks[-1], DataWarning, stacklevel=2)
    return found


def loop_file(job: LoopJob) -> LoopRow:
    """
    Close the loop on one recording, unless that was done before with the same settings.

    Raises SaJitterError for a recording that cannot be used, OSError where the folder cannot be
    written.
    """
    done = Path(job.folder, _JOB)
    settings = job.settings(
        version=_VERSION, declared=Path(job.declared).read_text(encoding='utf-8'))
    found = _finished(done)
    if found.get('settings') == settings:
        return LoopRow(**row_values(found['row']))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter('always', DataWarning)
        recording = with_pulses(read(job.path, **job.options), Path(job.declared), job.tacholess)
        loop = close_loop(recording, job.declared, names=[job.name])
    loop.write(job.folder)
    row = _row(job, loop, tuple(one_line(item.message) for item in caught))
    done.write_text(json_text({'settings': settings, 'row': asdict(row)}), encoding='utf-8')
    return row


def _finished(path: Path) -> Mapping[str, Any]:
    try:
        return dict(json.loads(path.read_text(encoding='utf-8')))
    except (OSError, TypeError, ValueError):
        return {}


def _row(job: LoopJob, loop: Loop, remarks: tuple[str, ...]) -> LoopRow:
    before, after = (max((content[name]['rms'] for content in loop.shafts.values()
                          if content[name]['rms'] is not None), default=math.nan)
                     for name in ('error_before', 'error_after'))
    return LoopRow(job.name, job.path, verdict=loop.verdict, missing_effects=loop.found,
                   rms_before=before, rms_after=after, remarks=remarks)
