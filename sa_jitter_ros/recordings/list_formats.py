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
Recordings of measuring systems: `.tdms`, `.mf4`, `.mdf`, `.uff`, `.unv`, lists of channels.

Optional dependencies read them. In a `.tdms` of LabVIEW a channel is sampled at 1/`wf_increment`
from `wf_start_offset` on. The times of a group of channels in a `.mf4` or `.mdf` (ASAM MDF) must
be at a constant rate. A channel of these bears its own name, or `group/name`, with the number of
the group in MDF, where several groups have one of that name. In universal files (`.uff`, `.unv`;
data sets 58 and 58b) time responses are channels. One bears the text of its first identification
line, else node and direction (`7:+Z`), else its number.
"""

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.errors import RecordingError
from sa_jitter_ros.recordings.channel_list import Channel, ChannelList, constant_rate
from sa_jitter_ros.recordings.limits import MAX_VALUES
from sa_jitter_ros.recordings.recording import library

_FUNCTION, _GENERAL, _TIME_RESPONSE = 58, 0, 1
_DIRECTIONS = {1: '+X', 2: '+Y', 3: '+Z', -1: '-X', -2: '-Y', -3: '-Z'}


def open_tdms(path: Path) -> ChannelList:
    """Open a `.tdms` file; RecordingError if npTDMS is not installed or the file is broken."""
    with _opened_tdms(path) as file:
        channels = [_tdms_channel(group.name, channel)
                    for group in file.groups() for channel in group.channels()
                    if channel.dtype is not None and channel.dtype.kind in 'fiub']
    return channels, [], partial(_opened_tdms, path)


@contextmanager
def _opened_tdms(path: Path) -> Iterator[Any]:
    with library('a .tdms file is', 'npTDMS', 'tdms'):
        import nptdms
    with open(path, 'rb') as raw, nptdms.TdmsFile.open(raw) as file:
        yield file


def _tdms_channel(group: str, channel: Any) -> Channel:
    step, name = float(channel.properties.get('wf_increment', 0.0)), channel.name
    return Channel((name, f'{group}/{name}'), str(channel.properties.get('unit_string', '')),
                   1.0 / step if step > 0.0 else None,
                   float(channel.properties.get('wf_start_offset', 0.0)), len(channel),
                   lambda file, start, stop: file[group][name][start:stop])


def open_mdf(path: Path) -> ChannelList:
    """
    Open a `.mf4` or `.mdf` file, whose times give the rates.

    Raises RecordingError if asammdf is not installed or the file is broken.
    """
    with library('a .mf4 file is', 'asammdf', 'mdf'):
        import asammdf
    left_out: list[str] = []
    with asammdf.MDF(path) as file:
        channels = list(_mdf_channels(file, left_out))
    return channels, left_out, partial(asammdf.MDF, path)


def _mdf_channels(file: Any, left_out: list[str]) -> Iterator[Channel]:
    """Iterate over the channels of numbers; `left_out` takes groups without a constant rate."""
    for number, group in enumerate(file.groups):
        count, master = group.channel_group.cycles_nr, file.masters_db.get(number)
        if not count:
            continue
        steady = constant_rate(np.asarray(file.get_master(number), np.float64))
        signals = [(index, channel) for index, channel in enumerate(group.channels)
                   if index != master and _is_number(file, number, index)]
        if steady is None:
            left_out.append('the times of '
                            + ', '.join(channel.name for _, channel in signals[:4])
                            + ' are at no constant rate')
            continue
        for index, channel in signals:
            yield Channel((channel.name, f'{number}/{channel.name}'), channel.unit or '', *steady,
                          count, partial(_mdf_samples, number, index))


def _is_number(file: Any, group: int, index: int) -> bool:
    try:
        first = file.get(group=group, index=index, record_count=1).samples
    except Exception:
        return False  # asammdf does not document what it cannot decode
    return bool(first.ndim == 1 and first.dtype.kind in 'fiub')


def _mdf_samples(group: int, index: int, file: Any, start: int, stop: int) -> FloatArray:
    """Return the samples of a channel from `start` to `stop`."""
    return np.asarray(file.get(group=group, index=index, record_offset=start,
                               record_count=stop - start).samples, np.float64)


def open_uff(path: Path) -> ChannelList:
    """
    Open a universal file; its samples are read into memory.

    Raises RecordingError if pyuff is not installed or the file is broken.
    """
    with library('a universal file is', 'pyuff', 'uff'):
        import pyuff
    if path.stat().st_size > 8 * MAX_VALUES:
        raise RecordingError(f'{path.stat().st_size} bytes: universal files of at most '
                             f'{8 * MAX_VALUES} are read; export .tdms, .mat or .wav')
    left_out: list[str] = []
    channels = list(_uff_channels(pyuff.UFF(str(path)), left_out))
    return channels, left_out, nullcontext


def _uff_channels(file: Any, left_out: list[str]) -> Iterator[Channel]:
    """Iterate over the time responses; `left_out` takes those that cannot be channels."""
    for number, kind in enumerate(file.get_set_types()):
        if int(kind) != _FUNCTION:
            continue
        content = file.read_sets(number)
        data = np.asarray(content['data'])
        name = str(content.get('id1', '')).strip()
        if content.get('func_type') not in (_GENERAL, _TIME_RESPONSE) or data.dtype.kind == 'c':
            left_out.append(f'data set {number} ({name}) is no time response')
            continue
        steady = constant_rate(np.asarray(content['x'], np.float64))
        if content.get('abscissa_spacing') == 1 and float(content['abscissa_inc']) > 0.0:
            steady = 1.0 / float(content['abscissa_inc']), float(content['abscissa_min'])
        if steady is None:
            left_out.append(f'the times of data set {number} ({name}) are at no constant rate')
            continue
        place = f'{content.get("rsp_node", 0)}:' + _DIRECTIONS.get(
            int(content.get('rsp_dir', 0)), '0')
        unit = str(content.get('ordinate_axis_units_lab', '')).strip()
        yield Channel(('' if name.upper() == 'NONE' else name, place),
                      '' if unit.upper() == 'NONE' else unit, *steady, data.size,
                      lambda file, start, stop, data=data: data[start:stop])  # type: ignore[misc]
