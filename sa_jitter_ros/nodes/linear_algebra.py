"""
One thread of linear algebra in the process of a node.

The matrices of this package are small. Split among the threads of OpenBLAS they wait, in busy
loops, for whichever thread the machine has no processor for at that moment: on a busy machine a
recovery of pulse errors takes ten times as long. `OMP_NUM_THREADS=1` does the same but must be
there before Python starts, which a node cannot see to itself.
"""

import ctypes
import os
from pathlib import Path

_MAPS = Path('/proc/self/maps')
_ASKED = ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS')
# Names in plain builds, and in those that numpy and scipy bring along.
_SETTERS = tuple(f'{prefix}openblas_set_num_threads{suffix}'
                 for prefix in ('', 'scipy_') for suffix in ('', '64_'))


def use_one_thread() -> int:
    """
    Keep every OpenBLAS of this process to one thread, unless the environment asks for a number.

    Returns how many there were: 0 where it asks, with another BLAS, and where the libraries of a
    process cannot be listed (other than Linux).
    """
    if any(os.environ.get(name) for name in _ASKED) or not _MAPS.exists():
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
