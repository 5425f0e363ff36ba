# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Many recordings: where they are, and a function of each of them in several processes."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
import gc
import os
from pathlib import Path
from typing import TypeVar

from sa_jitter_ros.offline.cluster import run_on_cluster
from sa_jitter_ros.offline.processes import attempt, Failure, in_processes
from sa_jitter_ros.recordings.reading import SUFFIXES

Job = TypeVar('Job')
Result = TypeVar('Result')


@dataclass(frozen=True)
class Found:
    """A recording and its name; `error` says why it cannot be used beside the others."""

    name: str
    path: Path
    error: str = ''


def find_recordings(paths: Sequence[Path], *, leave_out: Path | None = None) -> tuple[Found, ...]:
    """
    Return the recordings among files and folders, each once, in order.

    A folder counts for all recordings below it, without those below `leave_out`; it is a recording
    itself if it is a rosbag2 folder. The name of a recording is its path below the given folder,
    or its file name, without suffix.
    """
    found: dict[Path, Found] = {}
    names: dict[str, Path] = {}
    hidden = leave_out.resolve() if leave_out is not None else None
    for given in map(Path, map(os.path.abspath, paths)):
        for path in _below(given, hidden) if is_folder(given) else [given]:
            place = path.resolve()
            if place in found:
                continue
            below = path.relative_to(given) if path != given else Path(path.resolve().name)
            name = below.with_suffix('').as_posix() if path.suffix.lower() in SUFFIXES else (
                below.as_posix())
            same = names.setdefault(name, path)
            found[place] = Found(name, path, '' if same == path else (
                f'{path}: its results would have the name {name}, as those of {same}: rename one '
                'of the two, or give the folder that holds both'))
    return tuple(found.values())


def is_folder(path: Path) -> bool:
    """Return whether a path is a folder of recordings, and no rosbag2 folder."""
    return path.is_dir() and not (path / 'metadata.yaml').exists()


def _below(folder: Path, hidden: Path | None) -> Iterator[Path]:
    for path in sorted(folder.iterdir()):
        if path.name.startswith('.') or path.resolve() == hidden:
            continue
        if is_folder(path):
            yield from _below(path, hidden)
        elif path.is_dir() or path.suffix.lower() in SUFFIXES:
            yield path


def run_jobs(function: Callable[[Job], Result], jobs: Sequence[Job], *, processes: int = 1,
             scheduler: str = '') -> Iterator[tuple[Job, Result | Failure]]:
    """
    Call a function for every job; iterate over jobs and results in the order of completion.

    Each job has a process of its own, `processes` of them at a time: one that dies costs its own
    result, which is a `Failure`. With one process at a time the function is called in this one.
    With the address of a `scheduler`, tcp://HOST:PORT, the workers of a Dask cluster call it.
    Raises OSError that a function raises: it cannot write. Raises ParameterError without a
    cluster at the address, SaJitterError if the cluster disappears.
    """
    if scheduler:
        yield from run_on_cluster(function, jobs, scheduler)
    elif processes == 1:
        for job in jobs:
            yield job, attempt(function, job)
            if job is not jobs[-1]:
                gc.collect()  # commands let garbage wait, and that of a recording may be large
    else:
        yield from in_processes(function, jobs, processes)
