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
Recordings in MATLAB `.mat` files of version 5 to 7, read with bounded memory.

Those of version 7.3 are HDF5: `hdf5_format` reads them.

Only numbers, text, cells of text and structs of these are parsed, from a map of the file. A
variable in a struct has the key `struct/variable`; in element k of an array of structs it has
`struct/k/variable`, with k from 0. A compressed variable is unpacked once into an unnamed
temporary file. Format: MathWorks, MAT-File Format, chapter 1.

scipy.io.loadmat is not used for two reasons. A broken file can end the process: scipy 1.17.1
crashed (SIGSEGV, SIGBUS) on 23 of 4000 small files in which one to four places were overwritten,
cut or inserted, because it does not check the type numbers of tags. A check in front of it would
have to walk all tags, also those of compressed variables, and this walk is most of this module.
Second, loadmat reads whole variables into memory, with no limit of their unpacked size.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from math import prod
import mmap
from pathlib import Path
import struct
import tempfile
import zlib

import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.errors import RecordingError
from sa_jitter_ros.recordings.fields import Arrays, MAX_FIELD_BYTES
from sa_jitter_ros.recordings.hdf5_format import hdf5_arrays
from sa_jitter_ros.recordings.limits import check_inflation, check_size, IN_MEMORY_BYTES

_Buffer = bytes | mmap.mmap

_MATRIX, _COMPRESSED = 14, 15
_CELL, _STRUCT, _CHAR, _NUMERIC, _OPAQUE = 1, 2, 4, range(6, 16), 17
_COMPLEX = 0x0800
_NUMBERS = {1: 'i1', 2: 'u1', 3: 'i2', 4: 'u2', 5: 'i4', 6: 'u4', 7: 'f4', 9: 'f8', 12: 'i8',
            13: 'u8'}
_TEXTS = {1: 'latin-1', 2: 'latin-1', 4: 'utf-16', 16: 'utf-8', 17: 'utf-16', 18: 'utf-32'}
_HEADER, _HEAD, _STEP = 128, 4096, 1 << 20
_DEEPEST, _MOST_ELEMENTS = 32, 10_000  # of structs in structs; of an array of structs

_Variables = Iterator[tuple[str, Callable[[int], Array]]]


@dataclass(frozen=True)
class _Element:
    """A tagged piece of the file: its type and the positions of its bytes."""

    kind: int
    start: int
    stop: int


@dataclass(frozen=True)
class _Matrix:
    """The head of a variable and the position of its content."""

    name: str
    kind: int
    shape: tuple[int, ...]
    content: int
    stop: int


@contextmanager
def mat_arrays(path: Path) -> Iterator[Arrays]:
    """
    Open a `.mat` recording: yield the keys of its variables, and what loads one.

    Raises RecordingError if the file is broken, of version 4, of version 7.3 without h5py, or a
    variable of a recording has the wrong class.
    """
    with open(path, 'rb') as file:
        head = file.read(_HEADER)
        if head.startswith((b'MATLAB 7.3', b'\x89HDF')):
            with hdf5_arrays(path) as arrays:
                yield arrays
            return
        order = _byte_order(head)
        whole = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    variables = dict(_Reader(order).variables(whole))
    yield variables, lambda name, limit: variables[name](limit)


def _byte_order(head: bytes) -> str:
    if len(head) < _HEADER or head[126:128] not in (b'IM', b'MI'):
        raise RecordingError("is not a MATLAB file of version 5 to 7: save it with '-v7'")
    return '<' if head[126:128] == b'IM' else '>'


class _Reader:
    """Reads the elements of a file of one byte order."""

    def __init__(self, order: str) -> None:
        self._order = order

    def variables(self, whole: _Buffer) -> _Variables:
        """Iterate over the keys of the variables and what reads the array of each."""
        start = _HEADER
        while start + 8 <= len(whole):
            element = self._element(whole, start, len(whole))
            start = element.stop
            if element.kind == _MATRIX:
                matrix = self._matrix(whole, element)
                yield from _or_refusal(
                    matrix.name, partial(self._parts, whole, matrix, matrix.name))
            elif element.kind == _COMPRESSED:
                packed = whole[element.start:min(element.start + _HEAD, element.stop)]
                head = zlib.decompressobj().decompress(packed, _HEAD)
                tag = self._element(head, 0, None)
                matrix, size = self._matrix(head, tag), 8 + tag.stop - tag.start
                if matrix.kind == _STRUCT:
                    yield from _or_refusal(
                        matrix.name, partial(self._unpacked_parts, whole, element, size))
                else:
                    yield matrix.name, partial(self._unpacked, whole, element, size)

    def _unpacked_parts(self, whole: _Buffer, element: _Element, size: int) -> _Variables:
        """Iterate over the keys of a compressed struct of `size` bytes."""
        data = _inflate(whole, element, size)
        matrix = self._matrix(data, self._element(data, 0, len(data)))
        yield from self._parts(data, matrix, matrix.name)

    def _parts(self, data: _Buffer, matrix: _Matrix, key: str, depth: int = 0) -> _Variables:
        """Iterate over the keys below `key`: of a struct those of its fields, else itself."""
        if matrix.kind != _STRUCT:
            yield key, partial(self._array, data, matrix)
            return
        count = prod(matrix.shape)
        if depth > _DEEPEST or not 0 <= count <= _MOST_ELEMENTS:
            raise RecordingError(f'{key} has {count} elements in {depth} structs: at most '
                                 f'{_MOST_ELEMENTS} in {_DEEPEST} are read')
        length = self._element(data, matrix.content, matrix.stop)
        size = struct.unpack_from(f'{self._order}i', data, length.start)[0]
        at = self._after(length, matrix.content)
        texts = self._element(data, at, matrix.stop)
        at = self._after(texts, at)
        if size < 1 or (texts.stop - texts.start) % size:
            raise RecordingError(f'{key}: field names of {size} bytes: the file is broken')
        names = [data[start:start + size].split(b'\0')[0].decode('ascii', 'replace')
                 for start in range(texts.start, texts.stop, size)]
        for number in range(count):
            for name in names:
                element = self._element(data, at, matrix.stop)
                at = self._after(element, at)
                if element.kind != _MATRIX:
                    raise RecordingError(f'{key}/{name} is no array: the file is broken')
                if element.stop > element.start:  # without: an empty field
                    yield from self._parts(
                        data, self._matrix(data, element),
                        f'{key}/{name}' if count == 1 else f'{key}/{number}/{name}', depth + 1)

    def _unpacked(self, whole: _Buffer, element: _Element, size: int, limit: int) -> Array:
        """Read the array of a compressed variable of `size` bytes."""
        data = _inflate(whole, element, size)
        return self._array(data, self._matrix(data, self._element(data, 0, len(data))), limit)

    def _element(self, data: _Buffer, start: int, limit: int | None) -> _Element:
        """Read the tag at `start`, of an element that ends at `limit` or before."""
        kind, size = struct.unpack_from(f'{self._order}2I', data, start)
        if kind >> 16:  # the small format: four bytes of data within the tag
            kind, size, begin = kind & 0xFFFF, kind >> 16, start + 4
        else:
            begin = start + 8
        if limit is not None and (begin + size > limit or (begin == start + 4 and size > 4)):
            raise RecordingError(f'an element of {size} bytes at byte {start} does not end inside '
                                 'the file: the file is truncated or broken; copy it again')
        return _Element(kind, begin, begin + size)

    def _after(self, element: _Element, start: int) -> int:
        """Return where the element after one at `start` begins, 8 bytes aligned."""
        return max(start + 8, element.stop + (start - element.stop) % 8)

    def _matrix(self, data: _Buffer, element: _Element) -> _Matrix:
        limit = min(element.stop, len(data))
        places, at = [], element.start
        for _ in range(3):
            places.append(self._element(data, at, limit))
            at = self._after(places[-1], at)
        flags, dims, name = places
        flag = struct.unpack_from(f'{self._order}I', data, flags.start)[0]
        kind = 0 if flag & _COMPLEX else flag & 0xFF  # 0 is none of the format's classes
        if kind == _OPAQUE:  # an object, as a table or a datetime: its name follows the flags
            return _Matrix(data[dims.start:dims.stop].decode('ascii', 'replace'), kind, (1, 1),
                           element.stop, element.stop)
        shape = np.frombuffer(data[dims.start:dims.stop], f'{self._order}i4')
        return _Matrix(data[name.start:name.stop].decode('ascii', 'replace'), kind,
                       tuple(shape.tolist()), at, element.stop)

    def _array(self, data: _Buffer, matrix: _Matrix, limit: int) -> Array:
        if not matrix.shape or min(matrix.shape) < 0 or 8 * prod(matrix.shape) > limit:
            raise RecordingError(f'{matrix.name} of shape {matrix.shape} exceeds its limit of '
                                 f'{limit} bytes: split the recording')
        if matrix.kind == _CELL:
            cells = list(self._cells(data, matrix))
            check_size(matrix.name, 4 * len(cells) * max(map(len, cells), default=0), limit,
                       'shorten it')
            return np.array(cells)
        if matrix.kind == _CHAR:
            return self._text(data, matrix)
        if matrix.kind not in _NUMERIC:
            what = f'has class {matrix.kind}' if matrix.kind else 'is complex'
            raise RecordingError(f'{matrix.name} {what}: give real numbers or text')
        part = self._element(data, matrix.content, matrix.stop)
        dtype = np.dtype(self._order + _NUMBERS[part.kind])
        count = prod(matrix.shape)
        if count * dtype.itemsize != part.stop - part.start:
            raise RecordingError(f'{matrix.name} of shape {matrix.shape} does not fit '
                                 f'{part.stop - part.start} bytes of {dtype}: the file is broken')
        array = np.frombuffer(data, dtype, count, part.start) if count else np.empty(0)
        return array.reshape(matrix.shape, order='F')

    def _cells(self, data: _Buffer, matrix: _Matrix) -> Iterator[str]:
        """Iterate over the texts of a cell array."""
        at = matrix.content
        for _ in range(prod(matrix.shape)):
            element = self._element(data, at, matrix.stop)
            cell = self._matrix(data, element)
            if cell.kind != _CHAR:
                raise RecordingError(f'{matrix.name} has a cell that is no text: save samples in '
                                     'variables of their own, or as fields of a struct')
            yield ''.join(self._text(data, cell).tolist())
            at = self._after(element, at)

    def _text(self, data: _Buffer, matrix: _Matrix) -> Array:
        """Return the rows of a character matrix."""
        part = self._element(data, matrix.content, matrix.stop)
        check_size('a text', part.stop - part.start, MAX_FIELD_BYTES, 'shorten it')
        coding = _TEXTS[part.kind] + (
            {'<': '-le', '>': '-be'}[self._order] if part.kind in (4, 17, 18) else '')
        text = data[part.start:part.stop].decode(coding, 'replace')
        rows = matrix.shape[0]
        if len(text) != prod(matrix.shape) or rows <= 1:
            return np.array([text])
        return np.array([text[row::rows] for row in range(rows)])


def _or_refusal(key: str, parts: Callable[[], _Variables]) -> _Variables:
    """Return the parts of a variable; of one that is broken, its key, which refuses to be read."""
    try:
        return iter(list(parts()))
    except (RecordingError, struct.error, zlib.error) as error:
        reason = RecordingError(f'{key}: {error}')

    def refuse(limit: int) -> Array:
        raise reason

    return iter([(key, refuse)])


def _inflate(whole: _Buffer, element: _Element, size: int) -> _Buffer:
    """Unpack a compressed variable of `size` bytes, into a mapped file if it is large."""
    packed = element.stop - element.start
    check_inflation('a variable', packed, size, "save it with '-v6', which does not compress")
    unpack, at, remaining = zlib.decompressobj(), element.start, size
    with tempfile.SpooledTemporaryFile(IN_MEMORY_BYTES) as spool:
        while remaining > 0 and (at < element.stop or unpack.unconsumed_tail):
            piece = unpack.unconsumed_tail
            if not piece:
                piece = whole[at:min(at + _STEP, element.stop)]
                at += len(piece)
            data = unpack.decompress(piece, min(remaining, _STEP))
            remaining -= len(data)
            spool.write(data)
        if remaining > 0:
            raise RecordingError(f'{remaining} of {size} bytes of a compressed variable are '
                                 'missing: the file is truncated or broken; copy it again')
        if size > IN_MEMORY_BYTES:
            spool.flush()
            return mmap.mmap(spool.fileno(), 0, access=mmap.ACCESS_READ)
        spool.seek(0)
        return spool.read()
