# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""A node uses one thread of linear algebra, unless its environment sets the number."""

import os
from pathlib import Path
import subprocess
import sys

import pytest

PROGRAM = """
import ctypes
import numpy
import scipy.linalg
from sa_jitter_ros.nodes import linear_algebra

found = linear_algebra.use_one_thread()
threads = []
for path in {line.split()[-1] for line in open('/proc/self/maps') if 'openblas' in line}:
    library = ctypes.CDLL(path)
    for setter in linear_algebra._SETTERS:
        getter = setter.replace('set', 'get')
        if hasattr(library, getter):
            threads.append(getattr(library, getter)())
print(found, *threads)
"""


def threads(**environment):
    """Return how many libraries were limited, and the threads of each, in a separate process."""
    usual = {key: value for key, value in os.environ.items()
             if key not in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS')}
    done = subprocess.run([sys.executable, '-c', PROGRAM], capture_output=True, check=True,
                          cwd=Path(__file__).parents[1], env={**usual, **environment}, text=True)
    found, *counts = map(int, done.stdout.split())
    if not counts:
        pytest.skip('numpy and scipy do not use OpenBLAS here')
    return found, counts


def test_every_openblas_is_limited_to_one_thread():
    found, counts = threads()
    assert found == len(counts)
    assert set(counts) == {1}


@pytest.mark.machines
@pytest.mark.parametrize('name', ['OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS'])
def test_number_of_threads_in_the_environment_is_kept(name):
    found, counts = threads(**{name: '2'})
    assert found == 0
    assert set(counts) == {min(2, len(os.sched_getaffinity(0)))}
