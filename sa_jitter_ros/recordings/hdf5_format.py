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
Recordings in MATLAB `.mat` files of version 7.3, which are HDF5, read by h5py.

h5py is an optional dependency. A MATLAB array of shape (a, b) is an HDF5 dataset of shape (b, a);
a text is a dataset of character codes, a cell one of references. Large datasets are read chunk by
chunk into an unnamed temporary file and mapped there, as members of an `.npz` are.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.errors import RecordingError
from sa_jitter_ros.recordings.fields import Arrays, MAX_FIELD_BYTES
from sa_jitter_ros.recordings.limits import check_inflation, check_size, IN_MEMORY_BYTES
from sa_jitter_ros.recordings.recording import library, mapped

_ROWS_BYTES = 1 << 24
_MOST_CELLS = 10_000
_MOST_KEYS = 100_000


@contextmanager
def hdf5_arrays(path: Path) -> Iterator[Arrays]:
    """
    Open a `.mat` recording of version 7.3: yield the keys of its variables, and what loads one.

    A variable inside a struct has the key `struct/variable`, in element k of an array of structs
    `struct/k/variable`. Raises RecordingError if h5py is not
    installed, the file is broken, or a variable has the wrong class.
    """
    with library('MATLAB version 7.3 (HDF5) is', 'h5py', 'mat73',
                 ", or save the file with '-v7'"):
        import h5py
    with h5py.File(path, 'r') as file:
        variables = dict(islice(_datasets(file, file, '', ()), _MOST_KEYS))
        yield variables, lambda name, limit: _array(file, name, variables[name], limit)


def _datasets(file: Any, group: Any, prefix: str, above: tuple[Any, ...]
              ) -> Iterator[tuple[str, Any]]:
    """Iterate over keys and datasets of a struct, which is inside the structs `above`."""
    if group in above:
        return
    above = (*above, group)
    for name, item in group.items():
        if name.startswith('#'):
            continue
        if hasattr(item, 'items'):
            yield from _datasets(file, item, f'{prefix}{name}/', above)
        elif item.dtype.kind != 'O' or item.attrs.get('MATLAB_class', b''):
            yield f'{prefix}{name}', item
        else:  # a field of an array of structs is a dataset of references
            for number, reference in enumerate(np.ravel(item[()])):
                target = file[reference]
                if hasattr(target, 'items'):
                    yield from _datasets(file, target, f'{prefix}{number}/{name}/', above)
                else:
                    yield f'{prefix}{number}/{name}', target


def _array(file: Any, name: str, dataset: Any, limit: int) -> Array:
    """Return the array of a dataset, of at most `limit` bytes, as MATLAB has it."""
    kind = dataset.attrs.get('MATLAB_class', b'')
    if kind == b'cell':
        if dataset.size > _MOST_CELLS:
            raise RecordingError(f'{name} has {dataset.size} cells: at most {_MOST_CELLS} are '
                                 'read')
        return np.array([_text(name, file[cell]) for cell in np.ravel(dataset[()])])
    if kind == b'char':
        return np.array([_text(name, dataset)])
    if dataset.dtype.kind not in 'fiub':
        raise RecordingError(f'{name} has type {dataset.dtype}: give real numbers or text')
    shape, size = dataset.shape, prod(dataset.shape) * dataset.dtype.itemsize
    check_size(name, size, limit)
    if size <= IN_MEMORY_BYTES:
        return np.asarray(dataset[()]).T
    check_inflation(name, dataset.id.get_storage_size(), size, 'store it without compression')
    rows = max(1, _ROWS_BYTES * shape[0] // size)
    pieces = (dataset[start:start + rows].tobytes() for start in range(0, shape[0], rows))
    return mapped(pieces, dataset.dtype).reshape(shape).T


def _text(name: str, dataset: Any) -> str:
    """Return a text, which is stored as character codes (column by column)."""
    if dataset.dtype.kind != 'u' or 4 * dataset.size > MAX_FIELD_BYTES:
        raise RecordingError(f'{name} has a cell of type {dataset.dtype}: give text only')
    if dataset.attrs.get('MATLAB_empty', 0):
        return ''
    return ''.join(map(chr, np.ravel(dataset[()], order='F').tolist()))
