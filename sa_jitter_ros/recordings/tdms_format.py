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
Recordings in `.tdms` files of LabVIEW, read by npTDMS, which is an optional dependency.

A channel is sampled at 1/`wf_increment` from `wf_start_offset` on, and bears its own name, or
`group/name` where several groups have one of that name.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from sa_jitter_ros.recordings.channel_list import Channel, recording_of
from sa_jitter_ros.recordings.channel_map import ChannelMap
from sa_jitter_ros.recordings.libraries import library
from sa_jitter_ros.recordings.recording import Recording


def open_tdms(path: Path, *, channel_map: ChannelMap, sample_rate: float | None) -> Recording:
    """
    Open a `.tdms` file; `sample_rate` is used for channels whose rate the file does not say.

    Raises RecordingError if npTDMS is not installed or the file is broken.
    """
    with _opened(path) as file:
        channels = [_channel(group.name, channel)
                    for group in file.groups() for channel in group.channels()
                    if channel.dtype is not None and channel.dtype.kind in 'fiub']
    return recording_of(path, channels, channel_map=channel_map, sample_rate=sample_rate,
                        opened=partial(_opened, path))


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    with library('a .tdms file is', 'npTDMS', 'tdms'):
        import nptdms
    with open(path, 'rb') as raw, nptdms.TdmsFile.open(raw) as file:
        yield file


def _channel(group: str, channel: Any) -> Channel:
    step, name = float(channel.properties.get('wf_increment', 0.0)), channel.name
    return Channel((name, f'{group}/{name}'), str(channel.properties.get('unit_string', '')),
                   1.0 / step if step > 0.0 else None,
                   float(channel.properties.get('wf_start_offset', 0.0)), len(channel),
                   lambda file, start, stop: file[group][name][start:stop])
