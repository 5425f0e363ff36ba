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
Recordings in rosbag2 folders, `.mcap` and `.db3` files: the package's input topics.

The pure-Python library `rosbags` reads them, without ROS. The last part of its name tells what a
topic is (`/rig/vibration` is `vibration`); a channel map can name others.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache, partial
import math
from pathlib import Path
from typing import Any

import numpy as np
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.errors import MessageError, RecordingError
from sa_jitter_ros.recordings.channel_map import ChannelMap
from sa_jitter_ros.recordings.limits import check_bag
from sa_jitter_ros.recordings.message_layouts import (
    decode_pulse_array, decode_pulse_reference, FLOAT32, FLOAT64, IMU, SampleDecoder,
    TIME_REFERENCE, TIME_TOLERANCE)
from sa_jitter_ros.recordings.recording import (
    library, MAX_PULSES, rechunk, Recording, recording_errors, SampleSource)
from sa_jitter_ros.samples import SampleBlock

_SAMPLE_TYPES = (FLOAT64, FLOAT32, IMU)
_PULSE_TYPES = (FLOAT64, TIME_REFERENCE)
_MAX_GAP = 3600.0  # s
_MAX_LOST = 1 << 29  # largest gap, in samples of all channels
_SAME_RATE = 1e-6  # relative
_IMU_AXES = 'xyz'
_FILL = 65_536


def open_bag(path: Path, *, channel_map: ChannelMap, sample_rate: float | None,
             keyphasor: str = '') -> Recording:
    """
    Open a bag.

    Parameters
    ----------
    path
        Rosbag2 folder, `.mcap` or `.db3` file.
    channel_map
        Entries that start with '/' name topics for `vibration` and `tach`, others
        channels (`x`, `y`, `z` of an Imu).
    sample_rate
        Of messages that do not contain it (Float32MultiArray, Imu, no header), Hz.
    keyphasor
        `source` of the TimeReference messages to use, '' for that of the first message.

    Raises
    ------
    RecordingError
        If `rosbags` is missing, the bag is broken, has no vibration, or has samples of more than
        one run (index or clock jump back, rate or channels change, the stamps of an Imu have
        another rate).

    """
    topics = [entry for entry in channel_map.vibration if entry.startswith('/')]
    waveform = channel_map.tach if channel_map.tach.startswith('/') else ''
    channels = ChannelMap(tuple(e for e in channel_map.vibration if not e.startswith('/')),
                          '' if waveform else channel_map.tach)
    with _reader(path) as reader:
        topic = _find_topic(reader, topics[0] if topics else '', 'vibration', _SAMPLE_TYPES)
        tach_topic = _find_topic(reader, waveform, 'tach_waveform', _SAMPLE_TYPES)
        pulses = _find_topic(reader, '', 'tach_pulse', _PULSE_TYPES)
        if not topic:
            raise RecordingError('no vibration topic among '
                                 f'{", ".join(sorted(reader.topics)) or "none"}')
        found = _samples(reader, path, topic, sample_rate)
        if sample_rate is not None and not math.isclose(found.sample_rate, sample_rate,
                                                        rel_tol=_SAME_RATE):
            raise RecordingError(f'sample_rate {sample_rate} Hz given, but the messages of '
                                 f'{topic} say {found.sample_rate} Hz: leave it out')
        tach = _samples(reader, path, tach_topic, sample_rate) if tach_topic else None
        pulse_times, remarks = _pulses(reader, pulses, keyphasor) if pulses else (None, ())
    found = replace(found, pulse_times=pulse_times, remarks=(
        *found.remarks, *(tach.remarks if tach else ()), *remarks))
    if tach is None:
        return channels.select(found)
    if abs(tach.start_time - found.start_time) > TIME_TOLERANCE:
        raise RecordingError(f'{tach_topic} starts at {tach.start_time} s and {topic} at '
                             f'{found.start_time} s: record both from the same moment')
    return channels.select(replace(found, tach=tach.vibration, tach_rate=tach.sample_rate))


class _BlockRun:
    """Makes a continuous stream of the blocks of one run; counts lost and repeated samples."""

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self.first: SampleBlock | None = None
        self.received = self.repeated = self.lost = 0

    def continuous(self, blocks: Iterator[SampleBlock]) -> Iterator[FloatArray]:
        """Iterate over the samples in order of their index, NaN where they were lost."""
        for block in blocks:
            first = self.first = self.first or block
            self._check(first, block)
            missing = block.index - first.index - self.received
            if missing > min(_MAX_GAP * block.sample_rate, _MAX_LOST / max(len(block.samples), 1)):
                raise RecordingError(
                    f'{self.topic}: {missing} samples are missing before index {block.index}, '
                    f'more than {_MAX_GAP:g} s or {_MAX_LOST} values; split the bag')
            for start in range(0, missing, _FILL):
                yield np.full((len(block.samples), min(_FILL, missing - start)), np.nan)
            fresh = block.samples[:, max(-missing, 0):]
            self.lost += max(missing, 0)
            self.repeated += block.samples.shape[1] - fresh.shape[1]
            self.received += max(missing, 0) + fresh.shape[1]
            yield fresh

    def remarks(self) -> tuple[str, ...]:
        """Return what was repaired, one sentence each."""
        counts = ((self.lost, 'lost samples are NaN'),
                  (self.repeated, 'repeated samples were skipped'))
        return tuple(f'{self.topic}: {count} {text}' for count, text in counts if count)

    def _check(self, first: SampleBlock, block: SampleBlock) -> None:
        count, passed = block.index - first.index, block.start_time - first.start_time
        if len(block.samples) != len(first.samples) or block.sample_rate != first.sample_rate:
            raise RecordingError(
                f'{self.topic}: {len(first.samples)} channels at {first.sample_rate} Hz become '
                f'{len(block.samples)} at {block.sample_rate} Hz at index {block.index}; split '
                'the bag')
        if count < 0 or not abs(passed - count / first.sample_rate) <= TIME_TOLERANCE:
            pace = count / passed if passed > 0.0 else 0.0
            drifts = 0.9 < pace / first.sample_rate < 1.1  # more is a jump
            hint = f', or sample_rate is not the {pace:.6g} Hz of its times' if drifts else ''
            raise RecordingError(
                f'{self.topic}: index {block.index} has time {block.start_time} s, expected '
                f'{first.start_time + count / first.sample_rate} s from index {first.index} on: '
                f'a second run; split the bag{hint}')


@contextmanager
def _reader(path: Path) -> Iterator[Any]:
    """Open a bag; `rosbags` must not compile the message definitions in it."""
    with library('bags are', 'rosbags', 'bags'):
        from rosbags.rosbag2 import Reader
    check_bag(path)
    with Reader(path) as reader:
        if reader.compression_mode == 'message':
            raise RecordingError('messages are compressed one by one: convert the bag with ros2 '
                                 'bag convert to compressed files, or to no compression')
        yield reader


def _find_topic(reader: Any, asked: str, role: str, types: tuple[str, ...]) -> str:
    """Return the topic of a role, '' if there is none."""
    found = [name for name in reader.topics if _type_of(reader, name) in types and (
        name == asked if asked else name.rsplit('/', 1)[-1] == role)]
    if asked and not found:
        raise RecordingError(f'no topic {asked} with a type of {", ".join(types)}: choose from '
                             f'{", ".join(sorted(reader.topics))}')
    if len(found) > 1:
        raise RecordingError(f'several topics are named {role}: {", ".join(sorted(found))}; name '
                             'one in the channel map, or record one machine per bag')
    return found[0] if found else ''


def _type_of(reader: Any, topic: str) -> str:
    """Return the message type of a topic, as `std_msgs/Float64MultiArray`."""
    return str(reader.topics[topic].msgtype).replace('/msg/', '/')


def _parts_of(path: Path, topic: str, sample_rate: float | None, samples_per_block: int
              ) -> Iterator[FloatArray]:
    with recording_errors(path), _reader(path) as reader:
        messages = _blocks(reader, topic, sample_rate)
        yield from rechunk(_BlockRun(topic).continuous(messages), samples_per_block)


def _samples(reader: Any, path: Path, topic: str, sample_rate: float | None) -> Recording:
    """
    Read a topic once and return its samples as a recording.

    Lost ones are NaN, repeated ones are skipped.
    """
    run = _BlockRun(topic)
    for _ in run.continuous(_blocks(reader, topic, sample_rate)):
        pass
    if run.first is None:
        raise RecordingError(f'{topic} has no messages: record the topic')
    imu = _type_of(reader, topic) == IMU
    source = SampleSource(len(run.first.samples), run.received,
                          partial(_parts_of, path, topic, sample_rate))
    return Recording(source, run.first.sample_rate, tuple(_IMU_AXES) if imu else (),
                     ('m/s^2',) if imu else (), run.first.start_time, remarks=run.remarks())


@cache
def _types() -> Any:
    from rosbags.typesys import get_typestore, Stores
    return get_typestore(Stores.ROS2_JAZZY)


def _messages(reader: Any, topic: str) -> Iterator[Any]:
    connections = [item for item in reader.connections if item.topic == topic]
    for item in connections:
        if item.digest not in ('', _types().hash_rihs01(item.msgtype)):
            raise RecordingError(f'{topic}: its {item.msgtype} differs from that of ROS 2: record '
                                 'the standard message')
    for connection, _, data in reader.messages(connections=connections):
        yield _types().deserialize_cdr(data, connection.msgtype)


def _blocks(reader: Any, topic: str, sample_rate: float | None) -> Iterator[SampleBlock]:
    """Iterate over the sample blocks of a topic, one per message."""
    decoder = SampleDecoder(_type_of(reader, topic), sample_rate=sample_rate or 0.0,
                            imu_axis=_IMU_AXES)
    for message in _messages(reader, topic):
        with _message_errors(topic):
            block = decoder.decode(message)
        if decoder.restarts:
            raise RecordingError(f'{topic}: stamps jump back to {block.start_time} s: a second '
                                 'run; split the bag')
        yield block


@contextmanager
def _message_errors(topic: str) -> Iterator[None]:
    """Raise the error of a message as that of the recording."""
    try:
        yield
    except MessageError as error:
        raise RecordingError(f'{topic}: {error}') from error


def _pulses(reader: Any, topic: str, keyphasor: str) -> tuple[FloatArray, tuple[str, ...]]:
    """Return the pulse times in order, and remarks on what was skipped or sorted."""
    pieces: list[FloatArray] = []
    chosen, others, count = keyphasor, 0, 0
    for message in _messages(reader, topic):
        if hasattr(message, 'time_ref'):
            chosen = chosen or message.source
            if message.source != chosen:
                others += 1
                continue
            pieces.append(decode_pulse_reference(message)[0])
        else:
            with _message_errors(topic):
                pieces.append(decode_pulse_array(message))
        count += pieces[-1].size
        if count > MAX_PULSES:
            raise RecordingError(f'{topic}: more than {MAX_PULSES} pulses: split the bag')
    times = np.concatenate(pieces) if pieces else np.empty(0)
    late = int(np.count_nonzero(np.diff(times) < 0))
    counts = ((others, f'pulses of other keyphasors than {chosen!r} were skipped'),
              (late, 'pulses that arrived late were sorted'))
    return np.sort(times), tuple(f'{topic}: {n} {text}' for n, text in counts if n)
