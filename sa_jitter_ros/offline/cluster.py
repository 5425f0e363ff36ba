# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""A function of many jobs on the workers of an existing Dask cluster."""

import asyncio
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
import logging
from typing import Any, TypeVar

from sa_jitter_ros.errors import one_line, ParameterError, quoted, SaJitterError
from sa_jitter_ros.offline.processes import attempt, Failure

Job = TypeVar('Job')
Result = TypeVar('Result')

ANSWER = 10.0  # s until a cluster has to answer, and to have a worker


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
