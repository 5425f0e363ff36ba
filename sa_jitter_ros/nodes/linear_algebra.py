"""
One thread of linear algebra in the process of a node.

The matrices of this package are small. OpenBLAS splits them among threads that wait for each
other in busy loops: on a busy machine a recovery of pulse errors takes ten times as long.
`OMP_NUM_THREADS=1` does the same, but it must be set before Python starts.

threadpoolctl finds the same libraries, but rosdep has no key for it, so that `rosdep install`
could not provide it to a workspace. These lines set what threadpoolctl sets for OpenBLAS.
"""

import ctypes
import os
from pathlib import Path

_MAPS = Path('/proc/self/maps')
_USER_LIMITS = ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS')
# Names in the builds of distributions, and in those inside the wheels of numpy and scipy.
_SETTERS = tuple(f'{prefix}openblas_set_num_threads{suffix}'
                 for prefix in ('', 'scipy_') for suffix in ('', '64_'))


def use_one_thread() -> int:
    """
    Limit every OpenBLAS of this process to one thread, unless the environment sets a number.

    Returns how many libraries were limited: 0 where the environment sets the number, with another
    BLAS, and where the libraries of a process cannot be listed (not on Linux).
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
