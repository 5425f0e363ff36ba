# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Write a recording as a rosbag2 folder of the package's input topics, for tests and examples."""

from collections.abc import Iterator
from heapq import merge
import os
from pathlib import Path
from typing import Any

import numpy as np
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.errors import MessageError, RecordingError
from sa_jitter_ros.recordings.message_layouts import encode_time, INDEX_BASE
from sa_jitter_ros.recordings.recording import Recording

FLOAT64 = 'std_msgs/msg/Float64MultiArray'
FLOAT32 = 'std_msgs/msg/Float32MultiArray'
TIME_REFERENCE = 'sensor_msgs/msg/TimeReference'

_Timed = tuple[float, str, Any]


def write_bag(path: str | os.PathLike[str], recording: Recording, *, storage: str = 'mcap',
              vibration_type: str = FLOAT64, tach_type: str = TIME_REFERENCE,
              keyphasor: str = 'keyphasor', samples_per_block: int = 1024,
              namespace: str = '') -> None:
    """
    Write a recording as the topics `vibration`, `tach_pulse` and `tach_waveform`.

    Messages lie at the time of their last sample, shifted so that the bag starts at 0 s.

    Parameters
    ----------
    path
        Folder to make.
    recording
        What to write.
    storage
        'mcap' or 'sqlite3'.
    vibration_type
        `FLOAT64` or `FLOAT32`.
    tach_type
        `TIME_REFERENCE`, a message a pulse, or `FLOAT64`, a message a block.
    keyphasor
        `source` of the TimeReference messages.
    samples_per_block
        Of vibration and waveform messages.
    namespace
        In front of the topics, as '/rig'.

    Raises
    ------
    RecordingError
        If `rosbags` is missing, a type is unknown, the folder exists or a pulse time is beyond
        2^31 s, which only `FLOAT64` holds.

    """
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer, WriterError
        from rosbags.typesys import get_typestore, Stores
    except ImportError as error:
        raise RecordingError(
            "writing bags needs the Python package rosbags: 'pip install rosbags'") from error
    if storage.upper() not in StoragePlugin.__members__ or vibration_type not in (
            FLOAT64, FLOAT32) or tach_type not in (FLOAT64, TIME_REFERENCE):
        raise RecordingError(f'storage {storage!r}, types {vibration_type!r} and {tach_type!r}: '
                             'not one of those this writer knows')
    store = get_typestore(Stores.ROS2_JAZZY)
    build = _Messages(store)
    streams = {'vibration': (vibration_type, build.vibration(
        recording, vibration_type, samples_per_block))}
    if recording.tach is not None:
        streams['tach_waveform'] = (FLOAT64, build.waveform(recording, samples_per_block))
    if recording.pulse_times is not None:
        streams['tach_pulse'] = (tach_type, build.pulses(
            recording.pulse_times, tach_type, keyphasor,
            samples_per_block / recording.sample_rate))
    try:
        with Writer(Path(path), version=9, storage_plugin=StoragePlugin[storage.upper()]) as bag:
            connections = {
                topic: bag.add_connection(f'{namespace}/{topic}', kind, typestore=store)
                for topic, (kind, _) in streams.items()}
            offset = recording.start_time
            for time, topic, message in merge(
                    *(_tagged(topic, stream) for topic, (_, stream) in streams.items()),
                    key=lambda item: item[0]):
                data = store.serialize_cdr(message, streams[topic][0])
                bag.write(connections[topic], max(0, round((time - offset) * 1e9)), data)
    except (WriterError, RecordingError) as error:
        raise RecordingError(f'{path}: {error}') from error


def _tagged(topic: str, stream: Iterator[tuple[float, Any]]) -> Iterator[_Timed]:
    return ((time, topic, message) for time, message in stream)


class _Messages:
    """Builds the messages of a recording with the types of one ROS distribution."""

    def __init__(self, store: Any) -> None:
        self._types = store.types

    def vibration(self, recording: Recording, kind: str,
                  count: int) -> Iterator[tuple[float, Any]]:
        """Iterate over the time and message of each block."""
        return self._samples(recording.blocks(count), recording.start_time,
                             recording.sample_rate, kind)

    def waveform(self, recording: Recording, count: int) -> Iterator[tuple[float, Any]]:
        """Iterate over the time and message of each block of the keyphasor waveform."""
        return self._samples(recording.tach_blocks(count), recording.start_time,
                             recording.tach_rate or recording.sample_rate, FLOAT64)

    def pulses(self, times: FloatArray, kind: str, keyphasor: str,
               period: float) -> Iterator[tuple[float, Any]]:
        """Iterate over the time and message of each pulse, or of the pulses of each `period`."""
        if kind == TIME_REFERENCE:
            header = self._types['std_msgs/msg/Header']
            for time in times.tolist():
                stamp = self._stamp(time)
                yield time, self._types[kind](header(stamp, ''), stamp, keyphasor)
        elif times.size:
            block = np.floor((times - times[0]) / period)
            for piece in np.split(times, np.flatnonzero(np.diff(block)) + 1):
                yield float(piece[-1]), self._array(piece, ('pulse',), np.empty(0), kind)

    def _samples(self, blocks: Iterator[FloatArray], start: float, rate: float,
                 kind: str) -> Iterator[tuple[float, Any]]:
        done = 0
        for block in blocks:
            known = ~np.isnan(block).any(axis=0)  # a gap is what was not sent
            edges = np.flatnonzero(np.diff(np.concatenate([[0], known.astype(np.int8), [0]])))
            for low, high in edges.reshape(-1, 2).tolist():
                index = done + low
                header = (np.array([start + index / rate, rate, index]) if kind == FLOAT64 else
                          np.array(divmod(index, INDEX_BASE), dtype=np.float64))
                yield start + (done + high) / rate, self._array(
                    block[:, low:high], ('channel', 'sample'), header, kind)
            done += block.shape[1]

    def _array(self, values: FloatArray, labels: tuple[str, ...], header: FloatArray,
               kind: str) -> Any:
        dimension = self._types['std_msgs/msg/MultiArrayDimension']
        strides = np.cumprod(values.shape[::-1])[::-1]
        layout = self._types['std_msgs/msg/MultiArrayLayout']([
            dimension(label, size, int(stride))
            for label, size, stride in zip(labels, values.shape, strides)], header.size)
        dtype = np.float64 if kind == FLOAT64 else np.float32
        return self._types[kind](layout, np.concatenate([header, values.ravel()]).astype(dtype))

    def _stamp(self, time: float) -> Any:
        try:
            return self._types['builtin_interfaces/msg/Time'](*encode_time(time))
        except MessageError as error:
            raise RecordingError(str(error)) from error
