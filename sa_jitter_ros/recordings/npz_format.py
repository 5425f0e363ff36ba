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
Recordings in `.npz` files: arrays in a zip archive, read without pickle and with bounded memory.

Large members are not loaded: a stored one is mapped in the archive, a compressed one is unpacked
once into an unnamed temporary file (in `$TMPDIR`) and mapped there. numpy.load cannot do this: it
ignores `mmap_mode` for archives, and reads a member without a limit of its unpacked size.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from io import BytesIO
from math import prod
import os
from pathlib import Path
import struct
from typing import Any, IO
import zipfile

import numpy as np
from numpy.lib import format as npy
from numpy.typing import DTypeLike
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.errors import RecordingError
from sa_jitter_ros.recordings.fields import Arrays, CONVERTED
from sa_jitter_ros.recordings.limits import check_inflation, check_size, IN_MEMORY_BYTES
from sa_jitter_ros.recordings.recording import mapped, Recording

_COPY_BYTES = 1 << 20
_HEADER_BYTES = 10_000


@contextmanager
def npz_arrays(path: Path) -> Iterator[Arrays]:
    """
    Open an `.npz` recording: yield the names of its arrays, and what loads one.

    Raises RecordingError if the archive is broken, contains pickled objects or a field exceeds its
    limit.
    """
    with _archive(path) as archive:
        yield ([name[:-4] for name in archive.namelist() if name.endswith('.npy')],
               lambda name, limit: _member(archive, path, name, limit))


def _archive(path: Path) -> zipfile.ZipFile:
    try:
        return zipfile.ZipFile(path)
    except zipfile.BadZipFile:
        raise RecordingError('ends before the list of its arrays, or is no .npz: the file is '
                             'truncated or broken; copy it again') from None


def write_npz(path: str | os.PathLike[str], recording: Recording, *,
              dtype: DTypeLike = np.float64) -> None:
    """
    Write a recording as `.npz` with bounded memory; vibration and tach are stored as `dtype`.

    Samples are stored in Fortran order, all channels of a sample together.

    >>> import tempfile
    >>> from sa_jitter_ros.recordings import ArraySource, read
    >>> recording = Recording(ArraySource(np.ones((1, 2000))), 1e3, pulse_times=np.arange(2.0))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_npz(f'{folder}/rig.npz', recording, dtype=np.float32)
    ...     read(f'{folder}/rig.npz').samples
    2000
    """
    sources = (('vibration', recording.vibration), ('tach', recording.tach))
    with zipfile.ZipFile(path, 'w') as archive:
        for name in CONVERTED:
            if (value := getattr(recording, name)) is not None:
                with archive.open(f'{name}.npy', 'w') as stream:
                    npy.write_array(stream, np.asanyarray(value), allow_pickle=False)
        for name, source in sources:
            if source is None:
                continue
            header = {'descr': npy.dtype_to_descr(np.dtype(dtype)), 'fortran_order': True,
                      'shape': (source.channels, source.samples)}
            with archive.open(f'{name}.npy', 'w', force_zip64=True) as stream:
                npy.write_array_header_2_0(stream, header)
                for block in source.blocks(65_536):
                    stream.write(block.astype(dtype).tobytes(order='F'))


def _member(archive: zipfile.ZipFile, path: Path, name: str, limit: int) -> Array:
    """Return the array of a member: in memory if small, else mapped from a file."""
    info = archive.getinfo(f'{name}.npy')
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise RecordingError(f'{name}: zip method {info.compress_type} is not supported: save '
                             'with numpy.savez or numpy.savez_compressed')
    with archive.open(info) as stream:
        shape, fortran, dtype, start = _read_header(stream, name)
        size = prod(shape) * dtype.itemsize
        if start + size != info.file_size:
            raise RecordingError(
                f'{name}: {shape} of {dtype} needs {size} bytes, the file has '
                f'{info.file_size - start}: it is truncated or broken; copy it again')
        check_size(name, size, limit)
        order: Any = 'F' if fortran else 'C'
        if size <= IN_MEMORY_BYTES:
            data = stream.read(size)
            stream.read(1)  # reaching the end makes zipfile compare the checksum
            return np.frombuffer(data, dtype).reshape(shape, order=order)
        if info.compress_type == zipfile.ZIP_STORED:
            offset = _data_offset(path, info) + start
            return np.memmap(path, dtype, 'r', offset, shape, order)
        check_inflation(name, info.compress_size, size, 'store it without compression')
        pieces = iter(partial(stream.read, _COPY_BYTES), b'')
        return mapped(pieces, dtype).reshape(shape, order=order)


def _read_header(stream: IO[bytes],
                 name: str) -> tuple[tuple[int, ...], bool, np.dtype[Any], int]:
    """Return shape, whether in Fortran order, dtype and length of a `.npy` header."""
    head = BytesIO(stream.read(_HEADER_BYTES))  # the header of an array of numbers is shorter
    version = npy.read_magic(head)
    if version not in ((1, 0), (2, 0)):
        raise RecordingError(f'{name}: npy version {version} is not supported; save it again')
    read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, fortran, dtype = read(head)
    stream.seek(head.tell())
    if dtype.hasobject:
        raise RecordingError(
            f'{name} contains Python objects, which are not loaded: save numbers or text')
    if dtype.itemsize == 0 or any(length < 0 for length in shape):
        raise RecordingError(f'{name}: an array of shape {shape} and type {dtype} cannot be read')
    return shape, fortran, dtype, head.tell()


def _data_offset(path: Path, info: zipfile.ZipInfo) -> int:
    """Return the position of the bytes of a stored member in the archive."""
    with open(path, 'rb') as file:
        file.seek(info.header_offset)
        name_length, extra_length = struct.unpack('<26x2H', file.read(30))
    return int(info.header_offset + 30 + name_length + extra_length)
