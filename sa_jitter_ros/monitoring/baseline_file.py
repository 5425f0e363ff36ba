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
The file of a baseline: what the monitors of a machine know, kept over restarts.

It is an .npz file without pickle. `machine` is a JSON text with the name of the machine, the
settings of the learning, and the layout of each shaft; `<shaft>/<name>` are the arrays of the
state of its monitor. A new file replaces the old one when it is complete; the zip format finds
damage.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
import fcntl
from itertools import count
import json
import os
from pathlib import Path
from typing import Any, IO
import zipfile

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.errors import RecordingError
from sa_jitter_ros.monitoring.evidence import below
from sa_jitter_ros.monitoring.monitor import Settings, ShaftMonitor
from sa_jitter_ros.monitoring.quantities import Layout
from sa_jitter_ros.whole_files import finished_together

FORMAT = 'sa_jitter_ros change baseline 1'
_LARGEST_FILE = 1 << 28
# The settings of the learning: of other ones the sums cannot be used.
_LEARNING = ('group_averages', 'speed_bin', 'state_bin')


def lock_baseline(path: Path) -> IO[bytes] | None:
    """
    Keep other processes from using a baseline until the result is closed, or this process ends.

    The lock is that of a file beside it, whose text is the number of the process that holds it.
    None where there can be no such file, nor a baseline.
    Raises RecordingError, in one line, while another one has the lock, or for what is no file.
    """
    try:
        if path.exists() and not path.is_file():
            raise RecordingError(f'{path}: is no regular file: give another baseline_file')
        path.parent.mkdir(parents=True, exist_ok=True)
        # What a full disk refuses may not wait in a buffer: `close` would fail, too.
        lock = path.with_name(f'.{path.name}.lock').open('a+b', buffering=0)
    except OSError:
        return None
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        lock.truncate(0)
        lock.write(f'{os.getpid()}'.encode())
    except BlockingIOError:
        with lock:
            lock.seek(0)
            raise RecordingError(
                f'{path}: process {lock.read(20).decode()} keeps its baseline there: end that '
                'one, or give another baseline_file') from None
    except OSError:  # a full disk, or a file system without locks
        pass
    return lock


def set_aside(path: Path) -> None:
    """
    Give a file, if there is one, a name with a number, as `baseline.1.npz`.

    Raises RecordingError, in one line, where that is not possible.
    """
    try:
        other = next(name for number in count(1) if not (
            name := path.with_name(f'{path.stem}.{number}{path.suffix}')).exists())
        if path.exists():
            path.rename(other)
    except OSError as error:
        raise RecordingError(f'{path}: the old baseline cannot be kept under another name: '
                             f'{error.strerror or error}') from error


def write_baseline(path: Path, machine: str, monitors: Mapping[str, ShaftMonitor],
                   settings: Settings) -> None:
    """
    Write the baseline of a machine, of all its shafts, in place of an older one.

    Raises RecordingError, in one line, where it cannot be written; the older file stays.
    """
    about = {'format': FORMAT, 'machine': machine,
             'settings': {name: value for name, value in asdict(settings).items()
                          if name in _LEARNING},
             'shafts': {name: asdict(item.layout) for name, item in monitors.items()}}
    arrays: dict[str, Any] = {
        f'{shaft}/{name}': array for shaft, item in monitors.items()
        for name, array in item.state().items()}
    arrays['machine'] = np.array(json.dumps(about))
    with new_files(path) as folder, (folder / path.name).open('wb') as file:
        np.savez_compressed(file, **arrays)
        file.flush()
        os.fsync(file.fileno())


@contextmanager
def new_files(path: Path) -> Iterator[Path]:
    """Yield a folder for the file of a baseline; raises RecordingError as `write_baseline`."""
    try:
        with finished_together(path.parent) as folder:
            yield folder
    except OSError as error:
        raise RecordingError(f'{path}: the baseline cannot be written: '
                             f'{error.strerror or error}') from error


def read_baseline(path: Path, machine: str, settings: Settings, share: float
                  ) -> dict[str, ShaftMonitor]:
    """
    Return the monitors of the shafts of a machine as a file has them, {} where there is no file.

    Raises RecordingError, in one line, for a file that is damaged or that of another machine, or
    of other settings of the learning. The file is never changed.
    """
    try:
        if not path.exists():
            return {}
        about, arrays = _read(path)
        if about['machine'] != machine:
            raise RecordingError(
                f'{path}: is the baseline of machine {about["machine"]!r}, this one is '
                f'{machine!r} (hardware_id): give another baseline_file')
        for name, value in about['settings'].items():
            if getattr(settings, name) != value:
                raise RecordingError(
                    f'{path}: was learnt with {name} {value}, now it is '
                    f'{getattr(settings, name)}: set it as before, or give another baseline_file')
        return {shaft: _restored(shaft, layout, arrays, settings, share)
                for shaft, layout in about['shafts'].items()}
    except RecordingError:
        raise
    except OSError as error:
        raise RecordingError(f'{path}: {error.strerror or error}: give another '
                             'baseline_file') from error
    except Exception as error:  # damaged zip files raise exceptions of many types
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise RecordingError(f'{path}: is no intact baseline ({reason}): restore it from a '
                             'backup, or move it away to learn again') from error


def _read(path: Path) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Return description and arrays of a file."""
    with zipfile.ZipFile(path) as archive:
        size = sum(item.file_size for item in archive.infolist())
    if size > _LARGEST_FILE:
        raise ValueError(f'{size} bytes, at most {_LARGEST_FILE}')
    with np.load(path, allow_pickle=False) as content:
        arrays = dict(content)
    about = json.loads(str(arrays.pop('machine')))
    if about['format'] != FORMAT:
        raise ValueError(f'format {about["format"]!r}')
    about['settings'] = {'state_bin': 0.0, **about['settings']}  # which older files lack
    if not (isinstance(about['machine'], str) and isinstance(about['shafts'], dict)
            and about['settings'].keys() == set(_LEARNING)):
        raise ValueError('incomplete description')
    return about, arrays


def _restored(shaft: str, layout: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]],
              settings: Settings, share: float) -> ShaftMonitor:
    monitor = ShaftMonitor(shaft, Layout(
        int(layout['channels']), tuple(layout['orders']), tuple(layout['indicators']),
        tuple(layout.get('bearings', ()))),  # older files have none
        settings, share=share)
    monitor.restore(below(arrays, f'{shaft}/'))
    return monitor
