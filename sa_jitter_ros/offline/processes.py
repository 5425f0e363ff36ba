# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""A function of many jobs, each in a process of its own: one that dies costs its own result."""

from collections.abc import Callable, Iterator, Sequence
import multiprocessing
from multiprocessing import connection
import os
import signal
from typing import Any, TypeVar

from sa_jitter_ros.errors import one_line, SaJitterError

Job = TypeVar('Job')
Result = TypeVar('Result')

_STOP_SECONDS = 5.0  # until a process that does not end is killed


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
