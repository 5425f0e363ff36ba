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
Recordings in universal files (`.uff`, `.unv`; data sets 58 and 58b), read by pyuff.

pyuff is an optional dependency. Data sets that are time responses are channels. One bears the
text of its first identification line, else node and direction (`7:+Z`), else its number.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from sa_jitter_ros.errors import RecordingError
from sa_jitter_ros.recordings.channel_list import Channel, constant_rate, recording_of
from sa_jitter_ros.recordings.channel_map import ChannelMap
from sa_jitter_ros.recordings.libraries import library
from sa_jitter_ros.recordings.limits import MAX_VALUES
from sa_jitter_ros.recordings.recording import Recording

_FUNCTION, _GENERAL, _TIME_RESPONSE = 58, 0, 1
_DIRECTIONS = {1: '+X', 2: '+Y', 3: '+Z', -1: '-X', -2: '-Y', -3: '-Z'}


def open_uff(path: Path, *, channel_map: ChannelMap, sample_rate: float | None) -> Recording:
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
    channels = list(_channels(pyuff.UFF(str(path)), left_out))
    return recording_of(path, channels, channel_map=channel_map, sample_rate=sample_rate,
                        left_out=left_out)


def _channels(file: Any, left_out: list[str]) -> Iterator[Channel]:
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
