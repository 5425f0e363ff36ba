"""Recordings in MATLAB `.mat` files up to version 7, whose variables are at most 2 GB each."""

from pathlib import Path
import struct
import zlib

import numpy as np
from sa_jitter_ros.errors import RecordingError
from sa_jitter_ros.recordings.fields import FIELDS, RawArray, recording_from_fields, size_limit
from sa_jitter_ros.recordings.npz_format import IN_MEMORY_BYTES, MAX_INFLATION
from sa_jitter_ros.recordings.recording import Recording, recording_errors
import scipy.io

_REFUSED = {'struct', 'object', 'function', 'opaque', 'sparse', 'unknown'}
_STEP = 1 << 20


def open_mat(path: Path, *, acquisition: int = 0) -> Recording:
    """
    Open a `.mat` recording (version 4 to 7); fields as in `recording_from_fields`.

    The variables of a recording are read into memory, others are not touched. Raises
    RecordingError if the file is broken, of version 7.3, or a variable has the wrong class.
    """
    with recording_errors(path):
        _check_version(path)
        _check_inflation(path)
        found = {name: (shape, kind) for name, shape, kind in scipy.io.whosmat(str(path))}
        names = sorted(set(found).intersection(FIELDS))
        for name in names:
            shape, kind = found[name]
            if kind in _REFUSED or (kind == 'cell' and name not in ('channel_names', 'units')):
                raise RecordingError(f'{name} is a {kind}: must be numbers or text')
            if min(shape) < 0 or 8 * np.prod(shape, dtype=np.float64) > size_limit(name):
                raise RecordingError(f'{name} of shape {shape}: exceeds its limit of '
                                     f'{size_limit(name)} bytes')
        variables = scipy.io.loadmat(str(path), variable_names=names) if names else {}

        def load(name: str) -> RawArray:
            return np.asarray(variables[name])

        return recording_from_fields(
            [name for name in names if name in variables], load, acquisition=acquisition)


def _check_version(path: Path) -> None:
    with open(path, 'rb') as file:
        head = file.read(128)
    if head.startswith((b'MATLAB 7.3', b'\x89HDF')):
        raise RecordingError("MATLAB version 7.3 (HDF5) is not read; save it with '-v7', or with "
                             'savez as .npz if a variable is larger than 2 GB')
    if len(head) < 20:
        raise RecordingError(f'{len(head)} bytes are no MATLAB file')


def _check_inflation(path: Path) -> None:
    """Refuse a compressed element that inflates like a zip bomb, before scipy inflates it."""
    with open(path, 'rb') as file:
        head = file.read(128)
        if head[126:128] not in (b'IM', b'MI'):
            return  # version 4 knows no compression
        order = '<' if head[126:128] == b'IM' else '>'
        while len(tag := file.read(8)) == 8:
            kind, size = struct.unpack(f'{order}2I', tag)
            if kind != 15:
                file.seek(size, 1)
                continue
            inflated, left, inflate = 0, size, zlib.decompressobj()
            while left > 0 and (packed := file.read(min(left, _STEP))):
                left -= len(packed)
                while packed:
                    inflated += len(inflate.decompress(packed, _STEP))
                    packed = inflate.unconsumed_tail
                if inflated > max(IN_MEMORY_BYTES, MAX_INFLATION * size):
                    raise RecordingError(
                        f'a variable of {size} bytes inflates more than {MAX_INFLATION}-fold: '
                        "looks like a zip bomb; save it with '-v6', which does not compress")
