# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Compressed bags: read where they are measurements, refused before they are unpacked if not."""

from contextlib import suppress
import struct

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from sa_jitter_ros.errors import RecordingError
from sa_jitter_ros.recordings import read
from sa_jitter_ros.recordings.limits import check_bag

rosbag2, typesys = (pytest.importorskip(f'rosbags.{name}') for name in ('rosbag2', 'typesys'))
Mode, Storage = rosbag2.CompressionMode, rosbag2.StoragePlugin
FLOAT64 = 'std_msgs/msg/Float64MultiArray'


def written(path, mode, storage=Storage.MCAP, samples=2000):
    """Write a compressed bag of ten blocks; return its folder and its vibration."""
    store = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
    kinds = {name: store.types[f'std_msgs/msg/MultiArray{name}'] for name in (
        'Dimension', 'Layout')}
    vibration = np.random.default_rng(1).standard_normal((10, samples))
    bag = rosbag2.Writer(path, version=9, storage_plugin=storage)
    bag.set_compression(mode, rosbag2.CompressionFormat.ZSTD)
    with bag:
        connection = bag.add_connection('/vibration', FLOAT64, typestore=store)
        for k, block in enumerate(vibration):
            layout = kinds['Layout']([kinds['Dimension']('channel', 1, samples),
                                      kinds['Dimension']('sample', samples, samples)], 3)
            message = store.types[FLOAT64](layout, np.concatenate((
                [k * samples / 100.0, 100.0, k * samples], block)))
            bag.write(connection, k, store.serialize_cdr(message, FLOAT64))
    return path, vibration.reshape(1, -1)


@pytest.mark.parametrize(('mode', 'storage'), [
    (Mode.STORAGE, Storage.MCAP), (Mode.FILE, Storage.MCAP), (Mode.FILE, Storage.SQLITE3)])
def test_compressed_bags_are_read(tmp_path, mode, storage):
    path, vibration = written(tmp_path / 'bag', mode, storage)
    np.testing.assert_array_equal(read(path).read(), vibration)


def test_bags_of_compressed_messages_are_refused(tmp_path):
    path, _ = written(tmp_path / 'bag', Mode.MESSAGE, Storage.SQLITE3)
    with pytest.raises(RecordingError, match='compressed one by one: convert'):
        read(path)


def frame(blocks, *, content_size=b'\0'):
    """Return a zstd frame of one segment with these (kind, size, content) blocks."""
    found = struct.pack('<IB', 0xFD2FB528, 0x20) + content_size
    for k, (kind, size, content) in enumerate(blocks):
        found += struct.pack('<I', size << 3 | kind << 1 | (k == len(blocks) - 1))[:3] + content
    return found


def record(kind, content):
    """Return an MCAP record."""
    return struct.pack('<BQ', kind, len(content)) + content


def text(content):
    """Return a text as MCAP has it."""
    return struct.pack('<I', len(content)) + content


def mcap(data, *, index=None):
    """Return an MCAP file of one zstd chunk; `index` (place, size) is what its summary says."""
    head = b'\x89MCAP0\r\n' + record(1, text(b'ros2') + text(b''))
    place = len(head)
    head += record(6, struct.pack('<QQQI', 0, 0, 100, 0) + text(b'zstd')
                   + struct.pack('<Q', len(data)) + data)
    summary = 0
    if index is not None:
        summary = len(head)
        shift, size = index
        head += record(8, struct.pack('<QQQQI', 0, 0, place + shift, 0, 0) + bytes(8)
                       + text(b'zstd') + struct.pack('<QQ', size, 100))
    return head + record(2, struct.pack('<QQI', summary, 0, 0)) + b'\x89MCAP0\r\n'


BOMB = frame([(1, 1 << 17, b'\0')] * 1000)  # 4 kB for 128 MB


@pytest.mark.parametrize(('name', 'content'), [
    ('bomb.mcap', mcap(BOMB)), ('bomb.mcap.zstd', BOMB), ('bomb.db3.zstd', BOMB)])
def test_bombs_are_refused_without_being_unpacked(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(RecordingError, match='more than 200 times as many'):
        check_bag(tmp_path)


@pytest.fixture(scope='module')
def compressed(tmp_path_factory):
    """Return the path of an MCAP file with zstd chunks, and its bytes."""
    folder, _ = written(tmp_path_factory.mktemp('bags') / 'bag', Mode.STORAGE, samples=50)
    path, = folder.glob('*.mcap')
    return path, path.read_bytes()


@settings(max_examples=150)
@given(st.floats(0, 1, exclude_max=True), st.binary(min_size=1, max_size=8))
def test_only_recording_errors_come_out(compressed, place, piece):
    path, content = compressed
    at = int(place * len(content))
    path.write_bytes(content[:at] + piece + content[at + len(piece):])
    with suppress(RecordingError):
        read(path).read()


@pytest.mark.parametrize(('content', 'says'), [
    (mcap(BOMB), 'more than 200 times as many'),
    (mcap(frame([(0, 1, b'x')]), index=(1, 10)), 'chunks that do not exist'),
    (mcap(frame([(0, 1, b'x')]), index=(0, 5000)), 'chunks that do not exist'),
    (mcap(b'no frame'), 'no zstd frame at byte'),
    (mcap(frame([(2, 1 << 20, b'')])), 'cannot be read'),
])
def test_broken_bags(tmp_path, content, says):
    (tmp_path / 'rig.mcap').write_bytes(content)
    with pytest.raises(RecordingError, match=says):
        read(tmp_path / 'rig.mcap')
