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
Recordings in `.wav` files: integer or float samples of any width, read in blocks.

scipy.io.wavfile.read is not used because it reads a whole file into memory: its `mmap` supports
neither 24-bit samples nor a data chunk that was cut short.
"""

from collections.abc import Iterator
from functools import partial
import os
from pathlib import Path
import struct

import numpy as np
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.errors import RecordingError
from sa_jitter_ros.recordings.recording import Recording, recording_errors, SampleSource

_PCM, _FLOAT, _EXTENSIBLE = 1, 3, 0xFFFE
_WIDTHS = {_PCM: (8, 16, 24, 32), _FLOAT: (32, 64)}


def _blocks(path: Path, offset: int, channels: int, samples: int, coding: int, bits: int,
            samples_per_block: int) -> Iterator[FloatArray]:
    """Iterate over `channel` x `sample` blocks."""
    frame = channels * bits // 8
    with recording_errors(path), open(path, 'rb') as file:
        file.seek(offset)
        for start in range(0, samples, samples_per_block):
            count = min(samples_per_block, samples - start)
            data = file.read(count * frame)
            if len(data) != count * frame:
                raise RecordingError(f'ends inside sample {start + len(data) // frame}: it was '
                                     'cut while it was read; open it again')
            yield _decoded(data, coding, bits).reshape(count, channels).T


def _decoded(data: bytes, coding: int, bits: int) -> FloatArray:
    """Return samples; integers are scaled so that full scale is 1."""
    if coding == _FLOAT:
        return np.frombuffer(data, f'<f{bits // 8}').astype(np.float64)
    if bits == 8:
        return (np.frombuffer(data, np.uint8) - 128.0) / 128
    if bits == 24:  # put each sample into the upper three bytes of a 32-bit integer
        wide = np.zeros((len(data) // 3, 4), np.uint8)
        wide[:, 1:] = np.frombuffer(data, np.uint8).reshape(-1, 3)
        return wide.view('<i4')[:, 0] / 2.0**31
    return np.frombuffer(data, f'<i{bits // 8}') / 2.0**(bits - 1)


def open_wav(path: Path) -> Recording:
    """
    Open a `.wav` file as vibration of all its channels.

    Units are '1' (of full scale) for integers and unknown for floats. A data chunk that was cut
    short, as by a power failure of the recorder, is read up to its end, with a remark. Raises
    RecordingError if the file is broken or its coding is not supported.
    """
    with open(path, 'rb') as file:
        form, _, kind = struct.unpack('<4sI4s', file.read(12))
        if form != b'RIFF' or kind != b'WAVE':
            raise RecordingError('is not a RIFF/WAVE file: convert it to .wav or .npz')
        layout: tuple[int, int, int, int] | None = None
        while len(head := file.read(8)) == 8:
            chunk, size = struct.unpack('<4sI', head)
            if chunk == b'fmt ':
                layout = _read_format(file.read(min(size, 64)))
                file.seek(max(size - 64, 0) + size % 2, 1)
            elif chunk == b'data':
                break
            else:
                file.seek(size + size % 2, 1)
        else:
            raise RecordingError('has no data chunk: the file is broken or not a recording')
        if layout is None:
            raise RecordingError('has no fmt chunk in front of its data: the file is broken')
        coding, channels, rate, bits = layout
        offset = file.tell()
        available = min(size, os.fstat(file.fileno()).st_size - offset)
        samples = available // (channels * bits // 8)
        source = SampleSource(channels, samples, partial(
            _blocks, path, offset, channels, samples, coding, bits))
        remarks = () if available == size else (
            f'the data chunk should have {size} bytes and has {available}: it was read up to its '
            'end',)
        return Recording(source, float(rate), units=('' if coding == _FLOAT else '1',),
                         remarks=remarks)


def _read_format(data: bytes) -> tuple[int, int, int, int]:
    """Return coding, channels, sampling rate and bits per sample of a `fmt ` chunk."""
    coding, channels, rate, _, block, bits = struct.unpack('<HHIIHH', data[:16])
    if coding == _EXTENSIBLE:
        coding = struct.unpack('<H', data[24:26])[0]
    if bits not in _WIDTHS.get(coding, ()):
        raise RecordingError(
            f'coding {coding} with {bits} bits is not supported: use integers of 8 to 32 bits or '
            'floats of 32 or 64 bits')
    if channels == 0 or block != channels * bits // 8:
        raise RecordingError(f'{channels} channels of {bits} bits are not {block} bytes: the '
                             'file is broken')
    return coding, channels, rate, bits
