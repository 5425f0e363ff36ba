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
Limits of the range of samples, and of the unpacked size of files.

A file that unpacks to far more than its size is not a measurement.

The unpacked size of a compressed bag is limited without unpacking it. Chunks of an MCAP file (its
specification, "Records") and whole files may be compressed with zstd (RFC 8878, section 3.1.1).
A zstd block holds at most 128 kB, so that the number of blocks limits the unpacked size, whatever
sizes the file states. (LZ4 unpacks to 255 times its size at most.)
"""

from collections.abc import Iterator
from pathlib import Path
import struct
from typing import BinaryIO

from sa_jitter_ros.errors import RecordingError

MAX_VALUES = 200_000_000  # samples of all channels that are read into memory
#: A range of samples whose fourth powers are above 1e-308; a smaller one is none.
LEAST_RANGE = 1e-75
IN_MEMORY_BYTES = 64 << 20  # larger arrays of a file are mapped
_MAX_INFLATION = 200  # unpacked over packed size; of measured signals it is below 10
_BLOCK = 1 << 17
_MAGIC, _SKIPPABLE = 0xFD2FB528, 0x184D2A50
_REPEATED, _COMPRESSED = 1, 2
_FOOTER, _CHUNK, _CHUNK_INDEX = 0x02, 0x06, 0x08


def check_size(name: str, size: int, limit: int, remedy: str = 'split the recording') -> None:
    """Raise RecordingError for an array of a file that takes more than `limit` bytes."""
    if size > limit:
        raise RecordingError(f'{name}: {size} bytes exceed its limit of {limit}: {remedy}')


def check_inflation(name: str, packed: int, size: int, remedy: str) -> None:
    """Raise RecordingError if `packed` bytes unpack to a `size` that no measurement has."""
    if size > max(IN_MEMORY_BYTES, _MAX_INFLATION * packed):
        raise RecordingError(f'{name}: {packed} bytes unpack to {size}, more than '
                             f'{_MAX_INFLATION} times as many, which no measured signal does: '
                             f'{remedy}')


def check_bag(path: Path) -> None:
    """Raise RecordingError if a file of a bag unpacks to a size that no measurement has."""
    for file in sorted(path.iterdir()) if path.is_dir() else [path]:
        if file.suffix == '.mcap':
            with open(file, 'rb') as stream:
                for start, size in _zstd_chunks(stream):
                    _check_zstd(stream, start, start + size)
        elif file.suffix == '.zstd':
            with open(file, 'rb') as stream:
                _check_zstd(stream, 0, file.stat().st_size)


def _unpack(stream: BinaryIO, layout: str) -> tuple[int, ...]:
    return struct.unpack(layout, stream.read(struct.calcsize(layout)))


def _zstd_chunks(stream: BinaryIO) -> Iterator[tuple[int, int]]:
    """
    Iterate over positions and sizes of the zstd chunks in an MCAP file.

    The summary must list no other chunks, because a reader uses the summary.
    """
    places, chunks, named, summary = set(), set(), set(), 0
    stream.seek(8)
    while len(head := stream.read(9)) == 9:
        kind, size = struct.unpack('<BQ', head)
        start = stream.tell()
        places.add(start - 9)
        if kind == _CHUNK:
            stream.seek(start + 28)
            compression = stream.read(*_unpack(stream, '<I'))
            packed, = _unpack(stream, '<Q')
            chunks.add((start - 9, compression, packed))
            if compression == b'zstd':
                yield stream.tell(), packed
        elif kind == _CHUNK_INDEX:
            stream.seek(start + 16)
            place, _, offsets = _unpack(stream, '<QQI')
            stream.seek(offsets + 8, 1)
            compression = stream.read(*_unpack(stream, '<I'))
            named.add((place, compression, *_unpack(stream, '<Q')))
        elif kind == _FOOTER:
            summary, = _unpack(stream, '<Q')
        stream.seek(start + size)
    if not named <= chunks or summary not in places | {0}:
        raise RecordingError('the summary lists chunks that do not exist: the file is broken; '
                             'recover it with mcap recover')


def _check_zstd(stream: BinaryIO, start: int, stop: int) -> None:
    """Raise RecordingError if the zstd frames from `start` to `stop` may unpack to too much."""
    total, at = 0, start
    while at < stop:
        stream.seek(at)
        magic, = _unpack(stream, '<I')
        if magic & 0xFFFFFFF0 == _SKIPPABLE:
            at += 8 + _unpack(stream, '<I')[0]
            continue
        if magic != _MAGIC:
            raise RecordingError(f'no zstd frame at byte {at}: the file is broken')
        descriptor, = _unpack(stream, '<B')
        single = descriptor >> 5 & 1
        at += 6 - single + (0, 1, 2, 4)[descriptor & 3] + (single, 2, 4, 8)[descriptor >> 6]
        last = 0
        while not last:
            stream.seek(at)
            low, high = _unpack(stream, '<HB')
            block = low | high << 16
            last, kind, size = block & 1, block >> 1 & 3, block >> 3
            total += _BLOCK if kind == _COMPRESSED else size
            at += 3 + (1 if kind == _REPEATED else size)
            check_inflation('compressed data', stop - start, total, 'record without compression')
        at += 4 * (descriptor >> 2 & 1)
