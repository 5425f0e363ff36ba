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
Recordings in `.mf4` and `.mdf` files (ASAM MDF), read by asammdf, an optional dependency.

The times of a group of channels must be at a constant rate. A channel bears its own name, or
`group/name` with the number of its group where several groups have one of that name.
"""

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.recordings.channel_list import Channel, constant_rate, recording_of
from sa_jitter_ros.recordings.channel_map import ChannelMap
from sa_jitter_ros.recordings.libraries import library
from sa_jitter_ros.recordings.recording import Recording


def open_mdf(path: Path, *, channel_map: ChannelMap, sample_rate: float | None) -> Recording:
    """
    Open a `.mf4` or `.mdf` file, whose times give the rates.

    Raises RecordingError if asammdf is not installed or the file is broken.
    """
    with library('a .mf4 file is', 'asammdf', 'mdf'):
        import asammdf
    left_out: list[str] = []
    with asammdf.MDF(path) as file:
        channels = list(_channels(file, left_out))
    return recording_of(path, channels, channel_map=channel_map, sample_rate=sample_rate,
                        left_out=left_out, opened=partial(asammdf.MDF, path))


def _channels(file: Any, left_out: list[str]) -> Iterator[Channel]:
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
                          count, partial(_samples, number, index))


def _is_number(file: Any, group: int, index: int) -> bool:
    try:
        first = file.get(group=group, index=index, record_count=1).samples
    except Exception:
        return False  # asammdf does not document what it cannot decode
    return bool(first.ndim == 1 and first.dtype.kind in 'fiub')


def _samples(group: int, index: int, file: Any, start: int, stop: int) -> FloatArray:
    """Return the samples of a channel from `start` to `stop`."""
    return np.asarray(file.get(group=group, index=index, record_offset=start,
                               record_count=stop - start).samples, np.float64)
