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
Many recordings: where they are, and a function of each of them.

It is called in this process, in one of its own for each, so that one that dies costs its own
result, or on the workers of an existing Dask cluster.
"""

import asyncio
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from dataclasses import dataclass
import gc
import logging
import multiprocessing
from multiprocessing import connection
import os
from pathlib import Path
import signal
from typing import Any, TypeVar

from sa_jitter_ros.errors import one_line, ParameterError, quoted, SaJitterError
from sa_jitter_ros.recordings.reading import SUFFIXES

Job = TypeVar('Job')
Result = TypeVar('Result')

ANSWER = 10.0  # s until a cluster has to answer, and to have a worker
_STOP_SECONDS = 5.0  # until a process that does not end is killed


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


class Failure(Exception):
    """A job that has no result; the text says why."""


def attempt(function: Callable[[Job], Result], job: Job) -> Result | Failure:
    """Return the result of a function, or why it has none; raises OSError."""
    try:
        return function(job)
    except OSError:
        raise
    except SaJitterError as error:
        return Failure(str(error))
    except MemoryError:
        return Failure('not enough memory: use fewer processes (--jobs)')
    except Exception as error:  # what is wrong with one recording costs no other
        return Failure(f'{type(error).__name__}: {one_line(error)}')


def _work(function: Callable[[Any], Any], job: Any, sender: Any) -> None:
    """Do one job in a process of its own, and send what became of it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that started this one ends it
    try:
        sender.send(attempt(function, job))
    except OSError as error:
        sender.send(error)


def in_processes(function: Callable[[Job], Result], jobs: Sequence[Job], count: int
                 ) -> Iterator[tuple[Job, Result | Failure]]:
    """Iterate over jobs and results; `count` processes at a time have a job each."""
    os.environ.setdefault('OMP_NUM_THREADS', '1')  # of the processes: they share the cores
    context = multiprocessing.get_context('forkserver')
    context.set_forkserver_preload([function.__module__])
    waiting, running = list(reversed(jobs)), dict[Any, tuple[Any, Job]]()
    try:
        while waiting or running:
            while waiting and len(running) < count:
                receiver, sender = context.Pipe(duplex=False)
                process = context.Process(target=_work, args=(function, waiting[-1], sender),
                                          daemon=True)
                process.start()
                sender.close()  # that the death of the process is the end of the pipe
                running[receiver] = process, waiting.pop()
            ready: list[Any] = connection.wait(list(running))
            for receiver in ready:
                process, job = running[receiver]
                try:
                    found = receiver.recv()
                except EOFError:
                    process.join()
                    found = Failure(_death(process.exitcode))
                process.join()
                receiver.close()
                del running[receiver]
                if isinstance(found, OSError):
                    raise found
                yield job, found
    finally:
        _stop([process for process, _ in running.values()])


def _stop(processes: Sequence[Any]) -> None:
    """End the processes that still run."""
    for process in processes:
        process.terminate()
    for process in processes:
        process.join(_STOP_SECONDS)
        if process.is_alive():
            process.kill()
            process.join()


def _death(status: int) -> str:
    if status >= 0:
        return f'its process ended with status {status} and without a result'
    name = signal.Signals(-status).name if -status in set(signal.Signals) else f'signal {-status}'
    return (f'its process was ended by {name}: if the memory was full, use fewer processes '
            '(--jobs)' if -status == signal.SIGKILL else f'its process was ended by {name}')


def run_on_cluster(function: Callable[[Job], Result], jobs: Sequence[Job], address: str
                   ) -> Iterator[tuple[Job, Result | Failure]]:
    """
    Call a function for every job on the workers of the cluster at an address.

    A worker that dies costs nothing: another one does its jobs again. Raises as `run_jobs` does.
    """
    try:
        from distributed import as_completed, Client
    except ImportError:
        raise ParameterError("--scheduler needs Dask: pip install 'sa_jitter_ros[fleet]'"
                             ) from None
    log = logging.getLogger('distributed.client')  # what it says of a lost cluster, we say, too
    level = log.level
    log.setLevel(logging.CRITICAL + 1)
    client = None
    try:
        client = _connected(Client, address)
        futures = {client.submit(attempt, function, job, pure=False): job for job in jobs}
        for future in as_completed(futures):
            try:
                found: Any = future.result()
            except CancelledError:
                raise SaJitterError(f'--scheduler {address}: the cluster has gone; what was '
                                    'finished stays, the same command goes on from there'
                                    ) from None
            except OSError:
                raise
            except ImportError as error:
                raise ParameterError(f'--scheduler {address}: its workers cannot import this '
                                     f'package ({error}): install it there') from None
            except Exception as error:  # a job that kills every worker
                found = Failure(f'{type(error).__name__}: {one_line(error)}')
            yield futures[future], found
    finally:
        if client is not None:
            client.close(timeout=ANSWER)
        log.setLevel(level)


def _connected(connect: Callable[..., Any], address: str) -> Any:
    """
    Return a client of the cluster; raises ParameterError unless it answers and has a worker.

    A client that cannot connect closes itself when it is collected as garbage. If that happens
    while another client starts, both wait for one lock, for ever: a client of an event loop, which
    is closed in any case, tries the address first.
    """
    try:
        asyncio.run(_try(connect, address))
        return connect(address, timeout=ANSWER)
    except ParameterError:
        raise
    except Exception as error:  # of a wrong address, or of what answers there, of any type
        raise ParameterError(f'--scheduler {address}: no answer of a Dask scheduler within '
                             f'{ANSWER:g} s: check host and port, and that dask scheduler runs '
                             f'({quoted(error)})') from None


async def _try(connect: Callable[..., Any], address: str) -> None:
    """Connect and wait for a worker; raises ParameterError without one."""
    client = connect(address, timeout=ANSWER, asynchronous=True, set_as_default=False)
    try:
        await client
        await client.wait_for_workers(1, timeout=ANSWER)
    except TimeoutError:
        if client.status != 'running':
            raise
        raise ParameterError(f'--scheduler {address}: the cluster has no worker: start some, '
                             f'dask worker {address}') from None
    finally:
        await client.close(timeout=ANSWER)


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
