# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Whatever is wrong with a file, nothing but RecordingError comes out of the readers."""

import warnings

from bag_writer import write_bag
from hypothesis import example, given, HealthCheck, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from sa_jitter_ros.errors import RecordingError
from sa_jitter_ros.recordings import ArraySource, read, Recording, write_npz
import scipy.io
import scipy.io.wavfile

# An edit overwrites, inserts or cuts bytes at a place given as a fraction of the file.
EDITS = st.lists(
    st.tuples(st.floats(0, 1, exclude_max=True), st.sampled_from(['write', 'insert', 'cut']),
              st.binary(min_size=1, max_size=8)), min_size=1, max_size=4)


@pytest.fixture(scope='module')
def originals(tmp_path_factory):
    """Return the bytes of one small valid file of each format, by suffix."""
    pytest.importorskip('rosbags')
    folder = tmp_path_factory.mktemp('originals')
    rng = np.random.default_rng(1)
    recording = Recording(
        ArraySource(rng.standard_normal((2, 60))), 100.0, tach=ArraySource(np.ones((1, 60))),
        tach_rate=100.0, pulse_times=np.linspace(0, 0.6, 7), orders=(1.0, 2.0))
    vibration = recording.read()
    write_npz(folder / 'stored.npz', recording)
    np.savez_compressed(folder / 'deflated.npz', vibration=vibration, sample_rate=100.0,
                        channel_names=['a', 'b'], pulse_times=recording.pulse_times)
    fields = {'vibration': vibration, 'sample_rate': 100.0, 'units': 'g',
              'channel_names': np.array(['a', 'b'], dtype=object)}
    for name, compress in (('v5', False), ('v7', True)):
        scipy.io.savemat(folder / f'{name}.mat', fields, do_compression=compress)
    scipy.io.wavfile.write(folder / 'rig.wav', 100, vibration.T.astype(np.float32))
    lines = '\n'.join(f'{k / 100},{a:.5f},{b:.5f}' for k, (a, b) in enumerate(vibration.T))
    (folder / 'rig.csv').write_text(f'time,a,b\n{lines}\n')
    for storage in ('mcap', 'sqlite3'):
        write_bag(folder / storage, recording, storage=storage, samples_per_block=20)
    found = {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}
    for path in (*folder.glob('*/*.mcap'), *folder.glob('*/*.db3')):
        found[path.name] = path.read_bytes()
    return found


def edited(data, edits):
    """Return bytes after some edits."""
    data = bytearray(data)
    for place, kind, piece in edits:
        at = int(place * len(data))
        if kind == 'write':
            data[at:at + len(piece)] = piece
        elif kind == 'insert':
            data[at:at] = piece
        else:
            del data[at:at + 16 * len(piece)]
    return bytes(data)


def refusal(path, **options):
    """Read a whole file and return the message it was refused with, '' if it was read."""
    try:
        opened = read(path, **options)
        for block in opened.blocks(1000):
            assert len(block) == opened.channels
        opened.read_tach()
    except RecordingError as error:
        return str(error)
    return ''


@pytest.mark.machines
@pytest.mark.parametrize('name', [
    'stored.npz', 'deflated.npz', 'v5.mat', 'v7.mat', 'rig.wav', 'rig.csv', 'mcap.mcap',
    'sqlite3.db3'])
@settings(max_examples=80, suppress_health_check=list(HealthCheck))
@example(edits=[(0.0, 'cut', b'12345678' * 1000)])
@given(edits=EDITS)
def test_only_recording_errors_come_out(originals, tmp_path, name, edits):
    path = tmp_path / name
    path.write_bytes(edited(originals[name], edits))
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')  # parsers warn of what they then refuse or survive
        message = refusal(path)
    assert message.startswith(str(path)) or not message
    assert '\n' not in message


@settings(max_examples=60)
@given(text=st.text(max_size=200))
@example(text='time,a\n0,1e999\n1,2\n')
@example(text='time,a\nnan,1\nnan,2\n')
@example(text='"a\n1,2\n')
@example(text='a;b\n1,5;2\n')
def test_any_text_as_csv(tmp_path_factory, text):
    path = tmp_path_factory.mktemp('csv') / 'any.csv'
    path.write_text(text, encoding='utf-8', errors='surrogatepass')
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        message = refusal(path, sample_rate=10.0)
    assert '\n' not in message
