# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Opening a recording of any format: `read`."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
import os
from pathlib import Path
from types import MappingProxyType
from typing import Any

from sa_jitter_ros.errors import RecordingError
from sa_jitter_ros.parameters import fixed
from sa_jitter_ros.recordings.bag_format import open_bag
from sa_jitter_ros.recordings.channel_list import recording_of
from sa_jitter_ros.recordings.channel_map import ChannelMap
from sa_jitter_ros.recordings.channel_units import Channels, channels_of, in_units, PREFIX
from sa_jitter_ros.recordings.csv_format import open_csv
from sa_jitter_ros.recordings.fields import (
    given_fields, recording_from_fields, require_fields, SAMPLE_FIELDS)
from sa_jitter_ros.recordings.list_formats import open_mdf, open_tdms, open_uff
from sa_jitter_ros.recordings.mat_format import mat_arrays
from sa_jitter_ros.recordings.npz_format import npz_arrays
from sa_jitter_ros.recordings.recording import Recording, recording_errors
from sa_jitter_ros.recordings.wav_format import open_wav

_LISTS = {'.tdms': open_tdms, '.mf4': open_mdf, '.mdf': open_mdf, '.uff': open_uff,
          '.unv': open_uff}  # what opens files that are lists of channels
#: Keywords of `read` that commands and the recording player take, too.
READ_PARAMETERS = (
    fixed('acquisition', 0, 'acquisition to read, from 0, of several in a file', minimum=0),
    fixed('sample_rate', 0.0, 'sampling rate of the vibration, if not in the file', unit='Hz',
          minimum=0.0),
    fixed('vibration_channels', [], 'names or numbers of the vibration channels, or /topic of a '
          'bag; empty: all but the tach', element=str),
    fixed('tach_channel', '', 'name or number of the tach waveform'),
    fixed('time_column', '', 'name or number of the column of times in a .csv'),
)
SUFFIXES = ('.npz', '.mat', '.wav', '.csv', *_LISTS, '.mcap', '.db3')


def read(path: str | os.PathLike[str], *, acquisition: int = 0, keyphasor: str = '',
         vibration_channels: Sequence[str | int] = (), tach_channel: str | int = '',
         time_column: str | int = '', pulses_suffice: bool = False,
         channels: Channels = MappingProxyType({}), **fields: Any) -> Recording:
    """
    Open a recording of any format; its samples are read later, in blocks of bounded memory.

    Parameters
    ----------
    path
        `.npz`, `.mat`, `.wav`, `.csv`, `.tdms`, `.mf4`, `.mdf`, `.uff`, `.unv`, `.mcap` or `.db3`
        file, or a rosbag2 folder.
    acquisition
        Number of the acquisition, from 0, in a file with several (`Recording.acquisitions`).
    keyphasor
        Name of the keyphasor, in a bag with several; '' for the first one.
    vibration_channels
        Names, or numbers from 0, of the vibration channels; of a bag also a `/topic`. Empty: all
        channels but the tach.
    tach_channel
        Name or number of the channel with the sampled keyphasor waveform; of a bag also a
        `/topic`.
    time_column
        Name or number of the column of a `.csv` with the sample times in s; '' for one named
        `time` or `t`.
    pulses_suffice
        Read a `.npz` or `.mat` without vibration, too, as one whose vibration is a single NaN.
    channels
        `unit` and `sensitivity` (V per unit) of vibration channels by their names, as in
        `machine.channels` of a machine file: `{'bearing': {'unit': 'g', 'sensitivity': 0.1}}`.
    fields
        Values that are not in the file, or replace those of the file, by their names in
        `Recording`: `sample_rate` (Hz), `start_time` (s), `pulse_times` (s),
        `reference_pulse_times` (s), `tach_rate` (Hz), `pulses_per_revolution`,
        `pulses_per_trigger`, `missing_teeth`, `ratio`, `orders`, `channel_names`, `units`,
        `description`. None is the value of the file. A text is the key under which a `.npz` or
        `.mat` has the field (`pulse_times='tach'`), else numbers (`orders='20,40'`).
        `vibration`, `tach` and `tach_count` are given by key; in other formats `vibration` and
        `tach` name channels. The sample times of a `.csv` or a bag are not replaced:
        `sample_rate` must agree with them.

    Raises
    ------
    ParameterError
        If `fields` has an unknown name.
    RecordingError
        If the file is missing, broken, unsafe or incomplete, in one line that starts with the
        path.

    Examples
    --------
    >>> import tempfile, numpy as np
    >>> from sa_jitter_ros.recordings import read
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     np.savez(f'{folder}/rig.npz', vibration=np.zeros((2, 5000)), sample_rate=5000.0,
    ...              pulse_times=np.arange(0.0, 1.0, 0.04))
    ...     recording = read(f'{folder}/rig.npz', ratio=2.5, orders=(20, 40))
    >>> recording.channels, recording.duration, recording.ratio, recording.orders
    (2, 1.0, 2.5, (20.0, 40.0))

    """
    require_fields(fields)
    path = Path(path)
    if isinstance(vibration_channels, str):
        vibration_channels = (vibration_channels,)
    channel_map = ChannelMap(tuple(map(str, vibration_channels)), str(tach_channel),
                             str(time_column))
    fields = {name: value for name, value in fields.items() if value is not None}
    with recording_errors(path):
        if not path.exists():
            raise RecordingError('no such file or folder: check the path')
        for item in [path, *(path.iterdir() if path.is_dir() else ())]:
            if item.exists() and not (item.is_file() or item.is_dir()):
                raise RecordingError(f'{item.name} is a pipe or a device: give a file or a '
                                     'rosbag2 folder')
        suffix = 'bag' if path.is_dir() else path.suffix.lower()
        if suffix not in ('bag', *SUFFIXES):
            raise RecordingError(f'cannot be read: {suffix or "no suffix"} is not one of '
                                 f'{", ".join(SUFFIXES)} or a rosbag2 folder; convert it')
        if suffix in ('.npz', '.mat'):
            with (npz_arrays if suffix == '.npz' else mat_arrays)(path) as arrays:
                recording = channel_map.select(recording_from_fields(
                    arrays, acquisition=acquisition, given=fields, pulses_suffice=pulses_suffice))
        else:
            channel_map, given = _in_channels(channel_map, fields)
            if suffix == '.wav':
                recording = channel_map.select(replace(open_wav(path), **given))
            else:
                how: dict[str, Any] = {
                    'channel_map': channel_map, 'sample_rate': given.pop('sample_rate', None)}
                recording = replace(
                    recording_of(path, _LISTS[suffix](path), **how) if suffix in _LISTS else
                    open_csv(path, **how) if suffix == '.csv' else
                    open_bag(path, keyphasor=keyphasor, **how), **given)
        if not 0 <= acquisition < recording.acquisitions:
            raise RecordingError(f'acquisition {acquisition}: the file has '
                                 f'{recording.acquisitions}, numbered from 0')
        recording = in_units(recording, channels_of({
            f'{PREFIX}{name}.{field}': value for name, values in channels.items()
            for field, value in values.items()}))
        return replace(recording, description=recording.description or path.name, path=str(path))


def _in_channels(channel_map: ChannelMap, fields: Mapping[str, Any]
                 ) -> tuple[ChannelMap, dict[str, Any]]:
    """Return the channel map with the channels that `fields` name, and the other fields."""
    named = {name: str(fields[name]) for name in SAMPLE_FIELDS if name in fields}
    if 'tach_count' in named:
        raise RecordingError('tach_count is a field of .npz and .mat only: convert the file')
    values, _ = given_fields({name: value for name, value in fields.items() if name not in named})
    if 'vibration' in named:
        channels = tuple(part.strip() for part in named['vibration'].split(','))
        channel_map = replace(channel_map, vibration=channels)
    if 'tach' in named:
        channel_map = replace(channel_map, tach=named['tach'])
    return channel_map, values
