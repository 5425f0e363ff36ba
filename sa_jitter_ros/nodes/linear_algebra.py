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
Limit the linear algebra of a process to one thread.

The matrices of this package are small. OpenBLAS splits them among threads that wait for each other
in busy loops: on a busy machine a recovery of pulse errors takes ten times as long. The
environment variable `OMP_NUM_THREADS=1` prevents it, too, but only if it is set before Python
starts.

threadpoolctl does the same, but rosdep has no key for it: `rosdep install` could not provide it in
a workspace. This module calls the same functions of OpenBLAS as threadpoolctl does.
"""

import ctypes
import os
from pathlib import Path

_MAPS = Path('/proc/self/maps')
_USER_LIMITS = ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS')
# Names in the builds of distributions and in the wheels of numpy and scipy.
_SETTERS = tuple(f'{prefix}openblas_set_num_threads{suffix}'
                 for prefix in ('', 'scipy_') for suffix in ('', '64_'))


def use_one_thread() -> int:
    """
    Limit every OpenBLAS of this process to one thread unless the environment sets a number.

    Returns the number of libraries that were limited. It is 0 if the environment sets the number
    of threads, if there is another BLAS, and on other systems than Linux.
    """
    if any(os.environ.get(name) for name in _USER_LIMITS) or not _MAPS.exists():
        return 0
    found = 0
    paths = {line.split(maxsplit=5)[-1] for line in _MAPS.read_text().splitlines()
             if 'openblas' in line}
    for path in paths:
        library = ctypes.CDLL(path)
        for setter in _SETTERS:
            if hasattr(library, setter):
                getattr(library, setter)(1)
                found += 1
    return found
