# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Recordings: every format gives back what was written, in blocks, and refuses what is wrong."""

from dataclasses import replace
import io
import os
import pickle
import struct
import sys
import tracemalloc
import wave
import zipfile

from bag_writer import write_bag
import numpy as np
import pytest
from sa_jitter_ros.errors import ParameterError, RecordingError
from sa_jitter_ros.recordings import ArraySource, read, Recording, write_npz
from sa_jitter_ros.recordings import hdf5_format, limits, mat_format, npz_format
from sa_jitter_ros.recordings.channel_map import find_channel
from sa_jitter_ros.recordings.fields import fields_of
import scipy.io
import scipy.io.wavfile

RATE = 2000.0


@pytest.fixture
def recording(rng):
    """Return a small recording with everything in it."""
    return Recording(
        ArraySource(rng.standard_normal((3, 5000))), RATE, channel_names=('a', 'b', 'c'),
        units=('m/s^2', 'm/s^2', 'Pa'), start_time=12.5,
        pulse_times=12.5 + np.cumsum(rng.uniform(0.02, 0.03, 90)),
        tach=ArraySource(rng.standard_normal((1, 10_000))), tach_rate=2 * RATE,
        pulses_per_revolution=6, pulses_per_trigger=3, ratio=2.40789, orders=(19.0, 38.0),
        reference_pulse_times=np.linspace(12.5, 15.0, 60), description='a rig')


def assert_same(got, wanted):
    """Compare all that two recordings hold."""
    np.testing.assert_array_equal(got.read(), wanted.read())
    np.testing.assert_array_equal(got.read_tach(), wanted.read_tach())
    for name in ('sample_rate', 'channel_names', 'units', 'start_time', 'tach_rate', 'ratio',
                 'pulses_per_revolution', 'pulses_per_trigger', 'orders', 'description'):
        assert getattr(got, name) == getattr(wanted, name), name
    for name in ('pulse_times', 'reference_pulse_times'):
        np.testing.assert_array_equal(getattr(got, name), getattr(wanted, name))


# --- blocks -------------------------------------------------------------------------------------

@pytest.mark.parametrize('count', [1, 7, 999, 5000, 10**6])
def test_blocks_have_the_asked_length_and_make_the_whole(recording, count):
    blocks = list(recording.blocks(count))
    assert all(block.shape == (3, min(count, 5000)) for block in blocks[:-1])
    assert all(block.dtype == np.float64 for block in blocks)
    np.testing.assert_array_equal(np.concatenate(blocks, axis=1), recording.vibration.array)
    assert recording.duration == 2.5


def test_blocks_without_samples_are_refused(recording):
    with pytest.raises(RecordingError, match='samples_per_block 0'):
        next(recording.blocks(0))


@pytest.mark.parametrize(('change', 'message'), [
    ({'sample_rate': 0.0}, 'sample_rate is 0.0 Hz'),
    ({'sample_rate': np.nan}, 'sample_rate is nan Hz'),
    ({'ratio': -1.0}, 'ratio -1.0'),
    ({'orders': (1.0, np.inf)}, 'orders inf'),
    ({'start_time': np.inf}, 'start_time inf'),
    ({'start_time': 1e12}, r'start_time: time 1e.12 s is so large that a float64 rounds it'),
    ({'start_time': -1e16}, 'start_time is -1e.16 s: must be within 1e.15 s'),
    ({'sample_rate': 5e-324}, 'sample_rate is 5e-324 Hz: must be from 1e-12 to'),
    ({'tach_rate': 1e300}, 'tach_rate is 1e.300 Hz: must be from 1e-12 to'),
    ({'pulse_times': np.array([1.0, 1e16])}, 'pulse_times is 1e.16 s: must be within'),
    ({'tach_rate': None}, 'without tach_rate'),
    ({'pulses_per_revolution': 0}, 'pulses_per_revolution 0'),
    ({'pulses_per_trigger': 0}, 'pulses_per_trigger 0'),
    ({'pulse_times': np.array([1.0, 2.0, 1.5])}, 'backwards at pulse 2'),
    ({'pulse_times': np.array([1.0, np.nan])}, 'NaN'),
    ({'reference_pulse_times': np.ones((2, 2))}, 'one row'),
    ({'channel_names': ('a', 'b')}, '2 channel_names for 3 channels'),
    ({'units': ('g', 'g')}, '2 units for 3 channels'),
    ({'tach': ArraySource(np.ones((2, 10)))}, 'tach of 2 channels'),
    ({'vibration': ArraySource(np.ones((1, 0)))}, 'at least one sample'),
])
def test_contradictions_are_refused(recording, change, message):
    with pytest.raises(RecordingError, match=message):
        replace(recording, **change)


# --- npz ----------------------------------------------------------------------------------------

def test_npz_round_trip(recording, tmp_path):
    write_npz(tmp_path / 'rig.npz', recording)
    assert_same(read(tmp_path / 'rig.npz'), recording)


def save(path, *, compress=False, **fields):
    """Write an npz as a user does."""
    (np.savez_compressed if compress else np.savez)(path, **fields)
    return path


@pytest.mark.parametrize('compress', [False, True])
@pytest.mark.parametrize('order', ['C', 'F'])
@pytest.mark.parametrize('limit', [0, 1 << 30])
def test_npz_of_any_layout_in_memory_or_mapped(rng, tmp_path, monkeypatch, compress, order, limit):
    monkeypatch.setattr(npz_format, 'IN_MEMORY_BYTES', limit)
    vibration = np.asarray(rng.standard_normal((4, 1000)).astype(np.float32), order=order)
    path = save(tmp_path / 'rig.npz', compress=compress, vibration=vibration, sample_rate=RATE)
    opened = read(path)
    assert isinstance(opened.vibration.array, np.memmap) == (limit == 0)
    np.testing.assert_array_equal(opened.read(), vibration)


def test_large_npz_is_written_and_read_with_bounded_memory(tmp_path):
    class Ramp:
        channels, samples = 4, 3_000_000

        def blocks(self, count):
            for start in range(0, self.samples, count):
                yield np.arange(start, min(start + count, self.samples)) * np.ones((4, 1))

    path = tmp_path / 'long.npz'
    tracemalloc.start()
    write_npz(path, Recording(Ramp(), RATE))
    last = None
    for block in read(path).blocks(10_000):
        last = block
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert path.stat().st_size > 96_000_000
    assert peak < 12_000_000
    np.testing.assert_array_equal(last[:, -1], 2_999_999)


def test_npz_minimum_gets_the_documented_defaults(tmp_path):
    opened = read(
        save(tmp_path / 'rig.npz', vibration=np.ones(10, np.int16), sample_rate=100))
    assert (opened.channels, opened.channel_names, opened.units) == (1, ('channel 0',), ('',))
    assert (opened.pulses_per_revolution, opened.pulses_per_trigger, opened.ratio) == (1, None, 1)
    assert opened.pulse_times is None
    assert opened.description == 'rig.npz'


def test_rows_with_a_tach_each_are_acquisitions(rng, tmp_path):
    vibration, tach = rng.standard_normal((2, 5, 100))
    path = save(tmp_path / 'rows.npz', vibration=vibration, tach=tach, sample_rate=RATE,
                tach_rate=RATE, channel_names=list('abcde'), units='g')
    opened = read(path, acquisition=3)
    assert (opened.acquisitions, opened.channel_names, opened.units) == (5, ('d',), ('g',))
    np.testing.assert_array_equal(opened.read()[0], vibration[3])
    np.testing.assert_array_equal(opened.read_tach(), tach[3])
    with pytest.raises(RecordingError, match='acquisition 5: the file has 5'):
        read(path, acquisition=5)


def test_a_revolution_counter_becomes_pulses(tmp_path):
    path = save(tmp_path / 'count.npz', vibration=np.ones(100), sample_rate=RATE, start_time=2.0,
                tach_count=np.array([7, 7, 8, 8, 8, 10, 10]), tach_rate=10.0)
    np.testing.assert_allclose(read(path).pulse_times, [2.2, 2.45, 2.5])


@pytest.mark.parametrize('kind', [np.uint8, np.int64, np.float64])
def test_a_revolution_counter_that_is_reset_goes_on(tmp_path, kind):
    path = save(tmp_path / 'count.npz', vibration=np.ones(100), sample_rate=RATE,
                tach_count=np.array([254, 255, 0, 1, 1, 2]).astype(kind), tach_rate=10.0)
    np.testing.assert_allclose(read(path).pulse_times, [0.1, 0.2, 0.3, 0.5])


def test_a_counter_of_a_turn_counts_on_and_says_what_was_left_out(tmp_path):
    counts = np.arange(1000) * 7 % 100
    counts[505] = 0
    path = save(tmp_path / 'count.npz', vibration=np.ones(100), sample_rate=RATE,
                tach_count=counts, tach_rate=10.0, pulses_per_revolution=100)
    recording = read(path)
    assert recording.pulse_times.size == 999 * 7
    assert recording.remarks == (
        'tach_count: 1 samples where the shaft cannot be are left out',)
    path = save(tmp_path / 'down.npz', vibration=np.ones(100), sample_rate=RATE,
                tach_count=-7 * np.arange(1000), tach_rate=10.0, pulses_per_revolution=100)
    np.testing.assert_allclose(read(path).pulse_times, recording.pulse_times, atol=0.2)
    counts = np.arange(1000) + 5000 * (np.arange(1000) > 400)
    path = save(tmp_path / 'jump.npz', vibration=np.ones(100), sample_rate=RATE,
                tach_count=counts, tach_rate=10.0)
    recording = read(path)
    assert recording.pulse_times.size == 998
    assert recording.remarks == (
        'tach_count: 1 jumps that are no overflow begin to count anew',)


@pytest.mark.parametrize(('counts', 'message'), [
    ([0.0, 0.5, 1.0], 'fractions'), ([0.0, np.nan], 'NaN'), ([0.0, 1e17], '2.53'),
    ([0, 2**40], 'passes 1099511627775 marks in 0.1 s, at most'),
    ([[0, 1], [0, 1]], 'one row')])
def test_a_revolution_counter_that_counts_nothing_is_refused(tmp_path, counts, message):
    path = save(tmp_path / 'count.npz', vibration=np.ones(100), sample_rate=RATE,
                tach_count=np.array(counts), tach_rate=10.0)
    with pytest.raises(RecordingError, match=message):
        read(path)


@pytest.mark.parametrize(('fields', 'message'), [
    ({'sample_rate': 1.0}, 'no vibration'),
    ({'vibration': np.ones(3)}, 'no sample_rate'),
    ({'vibration': np.ones((3, 2)), 'sample_rate': 1.0}, 'transpose'),
    ({'vibration': np.ones((1, 2, 3)), 'sample_rate': 1.0}, 'channel x sample'),
    ({'vibration': np.ones(3, complex), 'sample_rate': 1.0}, 'real numbers'),
    ({'vibration': np.array(['a']), 'sample_rate': 1.0}, 'real numbers'),
    ({'vibration': np.ones(3), 'sample_rate': [1.0, 2.0]}, 'single number'),
    ({'vibration': np.ones(3), 'sample_rate': 1.0, 'ratio': 'x'}, 'ratio of type'),
    ({'vibration': np.ones(3), 'sample_rate': 1.0, 'pulses_per_revolution': 1.5}, 'whole number'),
    ({'vibration': np.ones(3), 'sample_rate': 1.0, 'channel_names': 5}, 'give text'),
    ({'vibration': np.ones(3), 'sample_rate': 1.0, 'tach': np.ones(3)}, 'tach_rate'),
    ({'vibration': np.ones((2, 9)), 'sample_rate': 1.0, 'tach': np.ones((3, 9)),
      'tach_rate': 1.0}, 'tach of 3 rows for 2'),
    ({'vibration': np.ones(3), 'sample_rate': 1.0, 'tach_count': [1, 2]}, 'tach_rate'),
    ({'vibration': np.ones(3), 'sample_rate': 1.0, 'tach_count': [1, 2], 'tach_rate': np.inf},
     'tach_rate is inf'),
    ({'vibration': np.ones(3), 'sample_rate': 1.0, 'pulse_times': np.ones((2, 2))}, 'one row'),
    ({'vibration': np.ones(3), 'sample_rate': 1.0, 'description': 'x' * 300_000}, 'exceed'),
])
def test_npz_with_wrong_fields(tmp_path, fields, message):
    path = save(tmp_path / 'bad.npz', **fields)
    with pytest.raises(RecordingError, match=message) as caught:
        read(path)
    assert str(caught.value).startswith(str(path))
    assert '\n' not in str(caught.value)


def test_pickled_arrays_are_never_loaded(tmp_path):
    path = tmp_path / 'evil.npz'
    np.savez(path, vibration=np.array([{'a': 1}], dtype=object), sample_rate=1.0)
    with pytest.raises(RecordingError, match='Python objects, which are not loaded'):
        read(path)


def npy_header(shape, descr='<f8'):
    """Return the header of an array file."""
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        stream, {'descr': descr, 'fortran_order': False, 'shape': shape})
    return stream.getvalue()


def test_a_shape_beyond_the_data_is_refused_before_allocation(tmp_path):
    path = tmp_path / 'short.npz'
    with zipfile.ZipFile(path, 'w') as archive:
        archive.writestr('vibration.npy', npy_header((1 << 20, 1 << 20)) + bytes(800))
        archive.writestr('sample_rate.npy', npy_header(()) + struct.pack('<d', 1.0))
    with pytest.raises(RecordingError, match='the file has 800'):
        read(path)


def test_zip_bomb_is_refused(tmp_path, monkeypatch):
    for module in limits, npz_format:
        monkeypatch.setattr(module, 'IN_MEMORY_BYTES', 1 << 20)
    path = save(tmp_path / 'bomb.npz', compress=True, vibration=np.zeros(1 << 20),
                sample_rate=1.0)
    with pytest.raises(RecordingError, match='200 times as many'):
        read(path)


def peak_of(call):
    """Return the bytes that a call held at most at a time."""
    tracemalloc.start()
    try:
        call()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_a_long_header_is_not_unpacked(tmp_path):
    path = tmp_path / 'header.npz'
    with zipfile.ZipFile(path, 'w', zipfile.ZIP_DEFLATED) as archive:
        for name in ('vibration', 'sample_rate'):
            with archive.open(f'{name}.npy', 'w') as member:
                member.write(b'\x93NUMPY\x02\x00' + struct.pack('<I', 1 << 26))
                member.write(b' ' * (1 << 26))

    def refused():
        with pytest.raises(RecordingError, match='EOF: reading array header'):
            read(path)
    assert peak_of(refused) < 1 << 20


def test_zip_methods_that_numpy_does_not_write_are_refused(tmp_path):
    path = tmp_path / 'lzma.npz'
    with zipfile.ZipFile(path, 'w', zipfile.ZIP_LZMA) as archive:
        archive.writestr('vibration.npy', npy_header((1,)) + bytes(8))
        archive.writestr('sample_rate.npy', npy_header(()) + struct.pack('<d', 1.0))
    with pytest.raises(RecordingError, match='zip method 14 is not supported'):
        read(path)


def test_flipped_bits_in_samples_are_found(tmp_path):
    path = save(tmp_path / 'flip.npz', vibration=np.ones(1000), sample_rate=1.0)
    data = bytearray(path.read_bytes())
    data[4000] ^= 1
    path.write_bytes(data)
    with pytest.raises(RecordingError, match='CRC'):
        read(path)


# --- mat ----------------------------------------------------------------------------------------

@pytest.mark.parametrize('compress', [False, True])
def test_mat_round_trip(recording, tmp_path, compress):
    path = tmp_path / 'rig.mat'
    names = np.array(['a', 'b', 'c'], dtype=object)  # a cell of strings
    scipy.io.savemat(path, {
        'vibration': recording.read(), 'tach': recording.read_tach()[:, None],
        'sample_rate': RATE, 'tach_rate': 2 * RATE, 'pulse_times': recording.pulse_times,
        'reference_pulse_times': recording.reference_pulse_times[:, None], 'start_time': 12.5,
        'pulses_per_revolution': 6, 'pulses_per_trigger': 3.0, 'ratio': 2.40789,
        'orders': [19, 38], 'channel_names': names, 'units': ['m/s^2', 'm/s^2', 'Pa   '],
        'description': 'a rig', 'not_ours': {'a': 1}}, do_compression=compress)
    assert_same(read(path), recording)


def save_mat73(path, **fields):
    """Write a `.mat` as MATLAB does with '-v7.3'."""
    h5py = pytest.importorskip('h5py')

    def text(value):
        codes = np.array([[ord(c)] for c in value], np.uint16)
        return codes, b'char'

    with h5py.File(path, 'w', userblock_size=512) as file:
        for name, value in fields.items():
            if isinstance(value, str):
                content, kind = text(value)
            elif isinstance(value, tuple):  # a cell of texts
                cells = []
                for number, item in enumerate(value):
                    content, _ = text(item)
                    cell = file.create_dataset(f'#refs#/{name}{number}', data=content)
                    cell.attrs['MATLAB_class'] = np.bytes_('char')
                    cells.append([cell.ref])
                content, kind = np.array(cells, h5py.ref_dtype), b'cell'
            else:
                content, kind = np.atleast_2d(value).T, b'double'
            stored = file.create_dataset(name, data=content, compression='gzip' if kind ==
                                         b'double' else None)
            stored.attrs['MATLAB_class'] = np.bytes_(kind)
    with open(path, 'r+b') as file:
        file.write(b'MATLAB 7.3 MAT-file, Platform: GLNXA64'.ljust(124) + b'\0\2IM')
    return path


@pytest.mark.parametrize('limit', [0, 1 << 30])
def test_mat_of_version_73(recording, tmp_path, monkeypatch, limit):
    monkeypatch.setattr(hdf5_format, 'IN_MEMORY_BYTES', limit)
    path = save_mat73(
        tmp_path / 'rig.mat', vibration=recording.read(), tach=recording.read_tach(),
        sample_rate=RATE, tach_rate=2 * RATE, pulse_times=recording.pulse_times, start_time=12.5,
        reference_pulse_times=recording.reference_pulse_times, pulses_per_revolution=6,
        pulses_per_trigger=3.0, ratio=2.40789, orders=[19, 38], channel_names=('a', 'b', 'c'),
        units=('m/s^2', 'm/s^2', 'Pa'), description='a rig')
    assert_same(read(path), recording)


def test_mat_of_version_73_of_another_make(recording, tmp_path):
    """Sample x channel in a struct, pulse times under another key."""
    path = save_mat73(tmp_path / 'rig.mat', tach=recording.pulse_times, **{
        'rig/acc': recording.read().T})
    opened = read(path, vibration='rig/acc', sample_rate='2000', pulse_times='tach')
    np.testing.assert_array_equal(opened.read(), recording.read())
    np.testing.assert_array_equal(opened.pulse_times, recording.pulse_times)
    assert opened.remarks == ('rig/acc of shape (5000, 3) is taken as sample x channel',)


def test_mat_of_version_73_with_an_array_of_structs(tmp_path):
    path = save_mat73(tmp_path / 'rig.mat', sample_rate=RATE)
    h5py = pytest.importorskip('h5py')
    with h5py.File(path, 'r+') as file:
        cells = [file.create_dataset('#refs#/a', data=np.arange(90.0)[:, None]).ref,
                 file.create_dataset('#refs#/b/deep', data=np.ones((90, 1))).parent.ref]
        file.create_dataset('rig/data', data=np.array([cells], h5py.ref_dtype))
        file['rig/again'] = file['rig']  # a circle of links
    np.testing.assert_array_equal(
        read(path, vibration='rig/0/data,rig/1/data/deep').read(), [np.arange(90.0), np.ones(90)])


def test_mat_of_version_73_that_is_broken_or_without_h5py(tmp_path, monkeypatch):
    path = tmp_path / 'new.mat'
    path.write_bytes(b'MATLAB 7.3 MAT-file, Platform: GLNXA64'.ljust(512, b' '))
    monkeypatch.setitem(sys.modules, 'h5py', None)
    with pytest.raises(RecordingError, match=r"pip install 'sa_jitter_ros\[mat73\]'.*'-v7'"):
        read(path)
    monkeypatch.undo()
    pytest.importorskip('h5py')
    with pytest.raises(RecordingError, match=r'new\.mat: cannot be read'):
        read(path)


def test_old_mat_gets_a_clear_line(tmp_path):
    scipy.io.savemat(tmp_path / 'old.mat', {'vibration': np.ones((2, 90))}, format='4')
    with pytest.raises(RecordingError, match='not a MATLAB file of version 5 to 7'):
        read(tmp_path / 'old.mat')


@pytest.mark.parametrize('dtype', ['f4', 'f8', 'i1', 'u1', 'i2', 'u2', 'i4', 'u4', 'i8', 'u8'])
def test_large_mat_of_any_number_type_is_mapped(rng, tmp_path, monkeypatch, dtype):
    monkeypatch.setattr(mat_format, 'IN_MEMORY_BYTES', 1000)
    vibration = rng.integers(0, 100, (3, 40_000)).astype(dtype)
    scipy.io.savemat(tmp_path / 'rig.mat', {'vibration': vibration, 'sample_rate': 1.0},
                     do_compression=True)
    np.testing.assert_array_equal(read(tmp_path / 'rig.mat').read(), vibration)


def test_mat_with_a_struct_for_vibration(tmp_path):
    scipy.io.savemat(tmp_path / 'bad.mat', {'vibration': {'x': 1.0}, 'sample_rate': 1.0})
    with pytest.raises(RecordingError, match=r'no vibration among the fields .* vibration/x'):
        read(tmp_path / 'bad.mat')


def test_mat_with_complex_samples(tmp_path):
    scipy.io.savemat(tmp_path / 'bad.mat', {'vibration': np.ones((1, 9)) * 1j, 'sample_rate': 1.0})
    with pytest.raises(RecordingError, match='vibration is complex: give real numbers'):
        read(tmp_path / 'bad.mat')


@pytest.mark.parametrize('limit', [1000, 1 << 26], ids=['mapped', 'memory'])
@pytest.mark.parametrize('compress', [False, True])
def test_mat_with_structs_in_structs(rng, tmp_path, monkeypatch, compress, limit):
    monkeypatch.setattr(mat_format, 'IN_MEMORY_BYTES', limit)
    samples = rng.normal(size=(2000, 1))
    channels = np.array([(samples[:, 0], 'x'), (2.0 * samples[:, 0], 'y')],
                        dtype=[('data', object), ('name', object)])
    scipy.io.savemat(tmp_path / 'rig.mat', {
        'bearing': {'gs': samples, 'sr': 1000.0, 'load': [], 'none': {},
                    'tach': {'times': np.arange(5.0)}, 'names': np.array(['a', 'b'], object)},
        'channels': channels, 'sample_rate': 500.0}, do_compression=compress)
    opened = read(tmp_path / 'rig.mat', vibration='bearing/gs', sample_rate='bearing/sr',
                  pulse_times='bearing/tach/times')
    np.testing.assert_array_equal(opened.read(), samples.T)
    assert opened.sample_rate == 1000.0
    assert opened.pulse_times.tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    opened = read(tmp_path / 'rig.mat', vibration='channels/0/data,channels/1/data',
                  channel_names='bearing/names')
    np.testing.assert_array_equal(opened.read(), [samples[:, 0], 2.0 * samples[:, 0]])
    assert opened.channel_names == ('a', 'b')
    with pytest.raises(RecordingError, match='no such key; it has bearing/gs, bearing/load'):
        read(tmp_path / 'rig.mat', vibration='gs')


def test_a_broken_struct_spoils_no_other_variable(tmp_path):
    path = tmp_path / 'rig.mat'
    scipy.io.savemat(path, {'other': {'long_name': 1.0}, 'vibration': np.ones((1, 90)),
                            'sample_rate': 1.0})
    data = path.read_bytes()
    at = data.index(b'long_name') - 8
    path.write_bytes(data[:at - 4] + bytes(4) + data[at:])
    assert read(path).samples == 90
    with pytest.raises(RecordingError, match=r'other: .* the file is broken'):
        read(path, vibration='other')


def test_mat_bomb_is_refused(tmp_path):
    path = tmp_path / 'bomb.mat'
    scipy.io.savemat(path, {'vibration': np.zeros((1, 1 << 24)), 'sample_rate': 1.0},
                     do_compression=True)
    with pytest.raises(RecordingError, match='200 times as many'):
        read(path)


def test_a_long_text_among_many_cells_is_refused(tmp_path):
    path = tmp_path / 'cells.mat'
    names = np.array(['a' * 20000, *['b'] * 5000], dtype=object)
    scipy.io.savemat(path, {'vibration': np.zeros((1, 9)), 'sample_rate': 1.0, 'units': names})

    def refused():
        with pytest.raises(RecordingError, match='units: 400080000 bytes exceed its limit'):
            read(path)
    assert peak_of(refused) < 1 << 24


def test_a_text_that_is_too_long_is_refused(tmp_path):
    path = tmp_path / 'text.mat'
    scipy.io.savemat(path, {'vibration': np.zeros((1, 9)), 'sample_rate': 1.0,
                            'units': np.array(['a' * (1 << 20) + 'a'], dtype=object)})
    with pytest.raises(RecordingError, match='a text: 1048577 bytes exceed its limit'):
        read(path)


# --- wav ----------------------------------------------------------------------------------------

@pytest.mark.parametrize('dtype', [np.uint8, np.int16, np.int32, np.float32, np.float64])
def test_wav_with_one_channel_as_tach(rng, tmp_path, dtype):
    if np.dtype(dtype).kind == 'f':
        stored, scale, zero = rng.standard_normal((500, 3)).astype(dtype), 1.0, 0.0
    else:
        limits = np.iinfo(dtype)
        stored = rng.integers(limits.min, limits.max, (500, 3), dtype, endpoint=True)
        scale, zero = 2.0 ** (limits.bits - 1), 128.0 if dtype == np.uint8 else 0.0
    scipy.io.wavfile.write(tmp_path / 'rig.wav', 8000, stored)
    opened = read(tmp_path / 'rig.wav', tach_channel='1')
    assert (opened.sample_rate, opened.tach_rate) == (8000, 8000)
    assert opened.channel_names == ('channel 0', 'channel 2')
    wanted = ((stored.astype(np.float64) - zero) / scale).T
    np.testing.assert_array_equal(opened.read(), wanted[[0, 2]])
    tach = np.concatenate(list(opened.tach_blocks(77)), axis=1)
    np.testing.assert_array_equal(tach, wanted[1:2])


def test_wav_of_24_bits(tmp_path):
    values = [0, 1, -1, 2**23 - 1, -2**23]
    with wave.open(str(tmp_path / 'rig.wav'), 'wb') as file:
        file.setparams((1, 3, 4000, 0, 'NONE', ''))
        file.writeframes(b''.join(value.to_bytes(3, 'little', signed=True) for value in values))
    np.testing.assert_array_equal(read(tmp_path / 'rig.wav').read()[0],
                                  np.array(values) / 2.0**23)


def test_wav_cut_short_is_read_to_its_end(tmp_path):
    path = tmp_path / 'rig.wav'
    scipy.io.wavfile.write(path, 8000, np.arange(1000, dtype=np.int16))
    path.write_bytes(path.read_bytes()[:-501])
    opened = read(path)
    assert opened.samples == 749
    assert 'read up to its end' in opened.remarks[0]


@pytest.mark.parametrize(('data', 'message'), [
    (b'RIFX\0\0\0\0WAVE', 'not a RIFF'),
    (b'RIFF\0\0\0\0WAVE', 'no data chunk'),
    (b'RIFF\0\0\0\0WAVEdata\0\0\0\0', 'no fmt'),
    (b'RIFF\0\0\0\0WAVEfmt \x10\0\0\0' + struct.pack('<HHIIHH', 2, 1, 8000, 8000, 1, 4), 'coding'),
    (b'RIFF\0\0\0\0WAVEfmt \x10\0\0\0' + struct.pack('<HHIIHH', 1, 0, 8000, 0, 0, 8), '0 channel'),
    (b'RIFF', 'cannot be read'),
])
def test_broken_wav(tmp_path, data, message):
    (tmp_path / 'bad.wav').write_bytes(data)
    with pytest.raises(RecordingError, match=message):
        read(tmp_path / 'bad.wav')


def test_unknown_channel_names_those_there_are(tmp_path):
    scipy.io.wavfile.write(tmp_path / 'rig.wav', 8000, np.zeros((10, 2), np.int16))
    with pytest.raises(RecordingError, match="no channel '2': choose from channel 0, channel 1"):
        read(tmp_path / 'rig.wav', tach_channel='2')
    scipy.io.wavfile.write(tmp_path / 'mono.wav', 8000, np.zeros(10, np.int16))
    with pytest.raises(RecordingError, match='name a channel of vibration'):
        read(tmp_path / 'mono.wav', tach_channel='0')


def test_a_channel_is_found_without_its_unit_if_that_is_clear():
    names = ['n [V]', 'n (1/min)', 'Drehzahl [V]', 'a']
    assert [find_channel(names, name) for name in ('Drehzahl', 'n [V]', 'a')] == [2, 0, 3]
    for unclear in ('n', 'Drehzah', 'b'):
        with pytest.raises(RecordingError, match=r'choose from n \[V\], n \(1/min\)'):
            find_channel(names, unclear)


# --- csv ----------------------------------------------------------------------------------------

def table(path, columns, *, header='', delimiter=',', decimal='.'):
    """Write columns as text."""
    rows = '\n'.join(delimiter.join(f'{item:.12g}' for item in row) for row in zip(*columns))
    path.write_text(f'{header}\n{rows}\n'.lstrip('\n').replace('.', decimal))
    return path


def test_csv_with_times_and_a_tach(rng, tmp_path):
    a, b, key = rng.standard_normal((3, 1234)).round(6)
    times = 3.0 + np.arange(1234) / RATE
    path = table(tmp_path / 'rig.csv', (times, a, key, b), header='time,acc a,key,acc b')
    opened = read(path, tach_channel='key')
    assert opened.sample_rate == pytest.approx(RATE, rel=1e-9)
    assert (opened.start_time, opened.tach_rate) == (3.0, opened.sample_rate)
    assert opened.channel_names == ('acc a', 'acc b')
    np.testing.assert_array_equal(opened.read(), [a, b])
    np.testing.assert_array_equal(np.concatenate(list(opened.blocks(100)), axis=1), [a, b])
    np.testing.assert_array_equal(opened.read_tach(), key)
    by_number = read(path, vibration_channels=('3',), time_column='0')
    np.testing.assert_array_equal(by_number.read(), [b])


def test_csv_of_a_german_spreadsheet(rng, tmp_path):
    a, b = rng.standard_normal((2, 50)).round(6)
    path = table(tmp_path / 'rig.csv', (a, b), header='a;b', delimiter=';', decimal=',')
    np.testing.assert_array_equal(read(path, sample_rate=RATE).read(), [a, b])


@pytest.mark.parametrize(('rows', 'options', 'names'), [
    ('a,b,\n1,2,\n3,4,\n', {}, ('a', 'b')),
    ('a,b,\n1,2,\n3,4,\n', {'vibration_channels': ('a',)}, ('a',)),
    ('a,b,\n1,2,x\n3,4,y\n', {'vibration_channels': ('b', 'a')}, ('b', 'a')),
    ('time,a,b,\n0,1,2,\n0.1,3,4,\n', {}, ('a', 'b')),
    ('time,a,b,\n0,1,2,\n0.1,3,4,\n', {'tach_channel': 'b'}, ('a',)),
    ('a,b,\n1,2,5\n3,4,6\n', {'vibration_channels': ('2',), 'tach_channel': 'a'}, ('',)),
])
def test_csv_column_without_name_need_not_be_numeric(tmp_path, rows, options, names):
    (tmp_path / 'rig.csv').write_text(rows)
    opened = read(tmp_path / 'rig.csv', sample_rate=10.0, **options)
    assert opened.channel_names == names
    assert np.isfinite(opened.read()).all()


@pytest.mark.parametrize(('start', 'rate', 'decimals'), [
    (1.76e9, 25600.0, 6), (0.0, 4096.0, 5), (0.0, 300.0, 3)])
def test_csv_with_rounded_times_has_the_rate_that_is_given(tmp_path, start, rate, decimals):
    (tmp_path / 'rig.csv').write_text('time,a\n' + '\n'.join(
        f'{start + k / rate:.{decimals}f},{k % 7}' for k in range(2560)))
    opened = read(tmp_path / 'rig.csv', sample_rate=rate)
    assert (opened.sample_rate, opened.start_time) == (rate, start)
    np.testing.assert_array_equal(opened.read()[0], np.arange(2560) % 7)
    with pytest.raises(RecordingError, match=r'sample_rate .* given, but the times'):
        read(tmp_path / 'rig.csv', sample_rate=1.001 * rate)


def test_csv_whose_times_are_not_steady_is_refused_with_the_given_rate(tmp_path):
    times = np.arange(1000) / 100.0
    times[500] += 0.006
    (tmp_path / 'rig.csv').write_text('time,a\n' + '\n'.join(f'{t:.4f},1' for t in times))
    with pytest.raises(RecordingError, match=r'row 500: time 5.006 s is 0.016 s behind the'):
        read(tmp_path / 'rig.csv', sample_rate=100.0).read()


def test_csv_without_header_and_with_a_text_column(tmp_path):
    path = tmp_path / 'rig.csv'
    path.write_text('1,2\n\n3,4\n')
    opened = read(path, sample_rate=10)
    assert opened.channel_names == ('0', '1')
    np.testing.assert_array_equal(opened.read(), [[1, 3], [2, 4]])
    path.write_text('a,state\n1,ok\n2,ok\n')
    opened = read(path, sample_rate=10, vibration_channels=('a',))
    np.testing.assert_array_equal(opened.read(), [[1, 2]])


ROWS = [(f'{1e-3 * k:.8f}', f'{0.5 * (k % 9) - 3.0:.2f}', f'{k % 7}.5') for k in range(40)]
TABLES = {  # lines above the rows; separator, decimal point and coding; names, first unit
    'preamble': ('Model,X1\nLabel,\nSample Interval,1e-3\n\nTIME,CH1,CH2\n', ',.', 'utf-8',
                 ('CH1', 'CH2'), '', 1e3),
    'preamble of as many fields': ('a,b,c\nd,e,f\nTime,CH1,CH2\n', ',.', 'utf-8',
                                   ('CH1', 'CH2'), '', 1e3),
    'units': ('Time,Channel A,Channel B\n(ms),(V),(mV)\n\n', ',.', 'utf-8',
              ('Channel A', 'Channel B'), 'V', 1e6),
    'units without brackets': ('x-axis,1,2\nsecond,Volt,Volt\n', ',.', 'utf-8',
                               ('1', '2'), 'Volt', 1e3),
    'units in the names': ('in s,C1 in V,C2 in V\n', ',.', 'utf-8', ('C1 in V', 'C2 in V'), 'V',
                           1e3),
    'decimal commas': ('Time;A;B\n(us);(g);(g)\n', ';,', 'utf-8', ('A', 'B'), 'g', 1e9),
    'tabs': ('Rate\t1000\nTime [\u00b5s]\tA [m/s\u00b2]\tB\n', '\t,', 'latin-1',
             ('A [m/s\u00b2]', 'B'), 'm/s\u00b2', 1e9),
    'utf-16': ('Time [s]\tA [g]\tB\n', '\t.', 'utf-16', ('A [g]', 'B'), 'g', 1e3),
    'quotes': ('"t","A","B"\n', ',.', 'utf-8', ('A', 'B'), '', 1e3)}


@pytest.mark.parametrize('name', TABLES)
def test_csv_of_instruments(tmp_path, name):
    above, marks, coding, names, unit, rate = TABLES[name]
    rows = ''.join(marks[0].join(row).replace('.', marks[1]) + '\n' for row in ROWS)
    (tmp_path / 'scope.csv').write_bytes((above + rows).encode(coding))
    opened = read(tmp_path / 'scope.csv')
    assert opened.channel_names == names
    assert opened.units[0] == unit
    assert opened.sample_rate == pytest.approx(rate)
    np.testing.assert_allclose(opened.read(), np.array(ROWS, float)[:, 1:].T)
    assert len(opened.remarks) == ('preamble' in name or name == 'tabs')
    opened = read(tmp_path / 'scope.csv', vibration_channels=names[1:], tach_channel=names[0])
    np.testing.assert_allclose(opened.read_tach(), np.array(ROWS, float)[:, 1])


def test_csv_with_a_preamble_beside_the_samples(tmp_path):
    keys = [('Record Length', '40'), ('Sample Interval', '1e-3'), *[('', '')] * 38]
    (tmp_path / 'scope.csv').write_text(''.join(
        f'{",".join(key)},,{",".join(row)},\n' for key, row in zip(keys, ROWS)))
    with pytest.raises(RecordingError, match=r'no time column .* say: Sample Interval,1e-3'):
        read(tmp_path / 'scope.csv')
    opened = read(tmp_path / 'scope.csv', time_column='3')
    assert (opened.channels, opened.samples) == (2, 40)
    assert opened.sample_rate == pytest.approx(1e3)


def test_csv_whose_rows_are_numbered(tmp_path):
    (tmp_path / 'scope.csv').write_text(
        'X,CH1,Start,Increment,\nSequence,Volt,-6e-3,2e-6\n' + ''.join(
            f'{k},{row[1]},,\n' for k, row in enumerate(ROWS)))
    with pytest.raises(RecordingError, match=r'give the sample_rate; .*Increment.*,2e-6'):
        read(tmp_path / 'scope.csv')
    opened = read(tmp_path / 'scope.csv', vibration_channels='CH1', sample_rate=5e5)
    assert (opened.channels, opened.samples, opened.units) == (1, 40, ('Volt',))


def clock(time):
    """Return a time (s) of a day as a clock shows it, around midnight."""
    time = (86399.98 + float(time)) % 86400.0
    return f'{time // 3600:02.0f}:{time % 3600 // 60:02.0f}:{time % 60:06.3f}'


def grouped(text, marks=',.'):
    return f'{1e3 * float(text):,.2f}'.translate(str.maketrans(',.', marks))


STRANGE = {  # line of names, fields of a row, delimiter, coding, remarks; start and scale
    'iso': ('time,a,b', lambda t, a, b: (f'2026-03-05T{clock(t)}Z', a, b), ',', 86399.98, 1.0),
    'date and clock': ('Date;Zeit;a;b', lambda t, *row: ('05.03.26', *(
        text.replace('.', ',') for text in (clock(t), *row))), ';', 86399.98, 1.0),
    'minutes and seconds': ('Time\ta\tb', lambda t, a, b: (f'00:0{t}', a, b), '\t', 0.0, 1.0),
    'minutes': ('Time (min),a,b', lambda t, a, b: (f'{float(t) / 60:.9f}', a, b), ',', 0.0, 1.0),
    'milliseconds': ('time_ms|a|b', lambda t, a, b: (f'{1e3 * float(t):.0f}', a, b), '|', 0.0,
                     1.0),
    'a unit as name': ('Second, Value, Value', lambda t, a, b: (t, f' {a}', f' {b}'), ',', 0.0,
                       1.0),
    'groups in quotes': ('t,a,b', lambda t, *row: (t, *(f'"{grouped(x)}"' for x in row)), ',',
                         0.0, 1e3),
    'commas in quotes': ('"t","a","b"', lambda *row: (
        f'"{x.replace(".", ",")}"' for x in row), ',', 0.0, 1.0),
    'groups in quotes, comma behind': ('t,a,b', lambda t, *row: (
        t, *(f'"{grouped(x, ".,")}"' for x in row)), ',', 0.0, 1e3),
    'groups by points': ('t;a;b', lambda t, *row: (
        t.replace('.', ','), *(grouped(x, '.,') for x in row)), ';', 0.0, 1e3),
    'groups by apostrophes': ('t;a;b', lambda t, *row: (
        t, *(grouped(x, "'.") for x in row)), ';', 0.0, 1e3),
    'spaces': ('# t a b', lambda *row: row, ' ', 0.0, 1.0),
    'aligned': ('  Time (s)   Acc X  Acc Y', lambda *row: (f'{x:>12}' for x in row), ' ', 0.0,
                1.0),
    'decimal commas': ('t a b', lambda *row: (x.replace('.', ',') for x in row), ' ', 0.0, 1.0)}


@pytest.mark.parametrize('coding', ['utf-8', 'utf-16-le', 'utf-16-be'])
@pytest.mark.parametrize('name', STRANGE)
def test_csv_of_other_habits(tmp_path, name, coding):
    names, fields, delimiter, start, scale = STRANGE[name]
    text = names + '\n' + ''.join(delimiter.join(fields(*row)) + '\n' for row in ROWS)
    (tmp_path / 'log.csv').write_bytes(text.encode(coding))
    opened = read(tmp_path / 'log.csv')
    assert (opened.sample_rate, opened.start_time) == pytest.approx((1e3, start))
    np.testing.assert_allclose(opened.read(), scale * np.array(ROWS, float)[:, 1:].T)
    assert opened.remarks == (
        ('column Date holds text and is left out',) if name == 'date and clock' else ())


@pytest.mark.parametrize('footer', ['End of data', 'Mean,0.1,0.2\n\nMax,1,2\n'])
def test_csv_with_lines_below_the_table(tmp_path, footer):
    (tmp_path / 'log.csv').write_text('time,a,b\n' + ''.join(
        ','.join(row) + '\n' for row in ROWS) + footer)
    opened = read(tmp_path / 'log.csv')
    assert opened.samples == len(ROWS)
    count = footer.count(',') // 2
    assert opened.remarks == (f'{count or 1} line{"s" * (count > 1)} below the table skipped: no '
                              'samples',)


@pytest.mark.parametrize(('column', 'why'), [
    (lambda k: str(k), 'rises evenly'), (lambda k: str(k + 1), 'rises evenly'),
    (lambda k: f'{1.7e12 + k:.0f}', 'rises evenly'),
    (lambda k: f'12:00:{k // 20:02d}', 'has times that repeat'), (lambda k: 'ok', 'holds text'),
    (lambda k: '' if k % 3 else '20.5', 'is empty in most rows')])
def test_csv_column_that_holds_no_samples_is_said_and_left_out(tmp_path, column, why):
    (tmp_path / 'log.csv').write_text('when,a,b\n' + ''.join(
        ','.join((column(k), *row[1:])) + '\n' for k, row in enumerate(ROWS)))
    opened = read(tmp_path / 'log.csv', sample_rate=1e3)
    assert (opened.channel_names, opened.remarks) == (
        ('a', 'b'), (f'column when {why} and is left out',))
    with pytest.raises(RecordingError, match=f'or give the sample_rate; when {why}'):
        read(tmp_path / 'log.csv')


def test_csv_whose_commas_are_decimal_points_too_is_refused(tmp_path):
    (tmp_path / 'log.csv').write_text('a,b\n' + ''.join(
        ','.join(row[1:]).replace('.', ',') + '\n' for row in ROWS))
    with pytest.raises(RecordingError, match=r'4 columns of numbers, but 2 names: .* semicolons'):
        read(tmp_path / 'log.csv', sample_rate=1e3)


def test_csv_cells_without_a_number_are_gaps(rng, tmp_path):
    """Tables have empty cells for what is missing, and scopes an infinity beyond their range."""
    a, b = rng.standard_normal((2, 500)).round(6)
    rows = [[f'{k / RATE:.9g}', str(a[k]), str(b[k])] for k in range(500)]
    rows[100][1], rows[101][2] = '', ' '
    rows[200][1], rows[300][1] = '\N{INFINITY}', '-\N{INFINITY}'
    rows[0][2], rows[1][1:] = '', ('', '')  # the names above them are kept
    (tmp_path / 'rig.csv').write_text('time,a,b\n' + '\n'.join(map(','.join, rows)), 'utf-8')
    a[[1, 100, 200, 300]] = b[[0, 1, 101]] = np.nan
    opened = read(tmp_path / 'rig.csv')
    assert opened.channel_names == ('a', 'b')
    np.testing.assert_array_equal(opened.read(), [a, b])
    rows[400][0] = ''
    (tmp_path / 'rig.csv').write_text('time,a,b\n' + '\n'.join(map(','.join, rows)), 'utf-8')
    with pytest.raises(RecordingError, match=r'rows 0 to 500: .*give numbers only'):
        read(tmp_path / 'rig.csv').read()


def test_csv_whose_first_row_has_a_gap_and_what_others_have_not(tmp_path):
    rows = [[f'{k / RATE:.9g}', str(k % 7), ''] for k in range(100)]
    rows[0][1:] = '', '20.5'
    (tmp_path / 'rig.csv').write_text('time,a,temperature\ns,g,C\n' + '\n'.join(
        map(','.join, rows)))
    opened = read(tmp_path / 'rig.csv')
    assert (opened.channel_names, opened.remarks) == (
        ('a',), ('column temperature is empty in most rows and is left out',))
    np.testing.assert_array_equal(opened.read()[0], [np.nan, *(k % 7 for k in range(1, 100))])


@pytest.mark.parametrize('place', [0, 1, 2, 3, 20])
def test_csv_with_a_bad_row_is_not_shortened(tmp_path, place):
    rows = [','.join(row) for row in ROWS]
    rows[place] = 'x,1.5,2.5'
    (tmp_path / 'bad.csv').write_text('time,a,b\n' + '\n'.join(rows))
    with pytest.raises(RecordingError, match=r"could not convert string 'x'|no time column"):
        read(tmp_path / 'bad.csv').read()


@pytest.mark.parametrize(('text', 'options', 'message'), [
    ('a,b\n1,2\n5,3\n', {}, 'no time column among a, b'),
    ('time,a\n1,2\n', {}, '1 row of samples: give more, or the sample_rate'),
    ('time,a\n0,1\n0,2\n', {}, 'sort the rows by time'),
    ('time,a\n0,1\n1,2\n5,3\n6,4\n', {}, 'split the file at gaps'),
    ('time,a\nx,1\n', {}, 'no time column among time, a: .*; time holds text'),
    ('a,b\n1,2\n3\n', {'sample_rate': 1.0}, 'rows 0 to 2'),
    ('a,b\n1,2\n3,x\n', {'sample_rate': 1.0}, 'rows 0 to 2'),
    ('a,b\n', {'sample_rate': 1.0}, 'at least one sample'),
    ('', {'sample_rate': 1.0}, 'no rows of numbers'),
    ('time\n1\n2\n', {}, 'no column of vibration'),
    ('x' * (1 << 21), {'sample_rate': 1.0}, 'no rows of numbers'),
    ('a\n' + '1' * (1 << 21), {'sample_rate': 1.0}, 'no rows of numbers'),
])
def test_broken_csv(tmp_path, text, options, message):
    (tmp_path / 'bad.csv').write_text(text)
    with pytest.raises(RecordingError, match=message):
        read(tmp_path / 'bad.csv', **options).read()


def test_csv_columns_of_one_name_are_told_by_their_numbers(tmp_path):
    path = tmp_path / 'twice.csv'
    path.write_text('time,acc,acc\n' + ''.join(f'{k / 10},{k},{-k}\n' for k in range(9)))
    for tach in ('2', 'acc 2'):
        found = read(path, tach_channel=tach)
        assert found.channel_names == ('acc',)
        assert found.read()[0] == pytest.approx(-found.read_tach())
        assert found.read_tach()[1] == -1.0
    assert read(path).channel_names == ('acc', 'acc 2')


def test_csv_gaps_are_named(tmp_path):
    path = tmp_path / 'gap.csv'
    for rows in ([*range(2000), *range(2600, 6000)], [*range(2000), *range(6000)]):
        path.write_text('time,acc\n' + ''.join(f'{k / 5e3},{k % 7}\n' for k in rows))
        with pytest.raises(RecordingError, match=r'row 2000: time \S+ s is -?0\.\d+ s behind '
                                                 r'the row before, most 0\.0002 s: split'):
            read(path)


def test_csv_tach_in_few_rows_is_remarked(tmp_path):
    path = tmp_path / 'slow.csv'
    path.write_text('time,acc,tach\n' + ''.join(
        f'{k / 5e3},{k % 7},{"" if k % 5 else k % 3}\n' for k in range(500)))
    assert read(path, tach_channel='tach').remarks == ('column tach is empty in most rows',)


def test_a_vibration_without_samples_is_named(tmp_path):
    np.savez(tmp_path / 'a.npz', vibration=np.zeros((1, 0)), sample_rate=5e3)
    with pytest.raises(RecordingError, match=r'shape \(1, 0\): give samples, channel x sample'):
        read(tmp_path / 'a.npz')


def test_csv_that_ends_in_the_middle_of_a_row_is_read_up_to_there(tmp_path):
    text = ''.join(f'{k / 10:.1f},{k},{-k}\n' for k in range(9))
    for end in (' ', '0.9', '0.9,1'):
        (tmp_path / 'cut.csv').write_text(f'time,a,b\n{text}{end}')
        opened = read(tmp_path / 'cut.csv')
        np.testing.assert_array_equal(opened.read()[0], np.arange(9.0))
        assert opened.sample_rate == pytest.approx(10.0)
        assert len(opened.remarks) == (end != ' ')
    assert opened.remarks == (
        'the file ends in the middle of row 9: it was read up to there',)


def test_npz_that_is_cut_off_says_so(recording, tmp_path):
    write_npz(tmp_path / 'rig.npz', recording)
    (tmp_path / 'cut.npz').write_bytes((tmp_path / 'rig.npz').read_bytes()[:-500])
    with pytest.raises(RecordingError, match=r'cut\.npz: ends before .* copy it again'):
        read(tmp_path / 'cut.npz')


@pytest.mark.machines
def test_a_table_of_a_hundred_thousand_columns_gets_a_short_line(tmp_path):
    path = tmp_path / 'wide.csv'
    path.write_text('1,' * 1_000_000 + '1\n')
    with pytest.raises(RecordingError, match='at most 1048576'):
        read(path, sample_rate=1.0)
    path.write_text('1,' * 100_000 + '1\n')
    with pytest.raises(RecordingError, match='give 1 to 4096 channels'):
        read(path, sample_rate=1.0)
    with pytest.raises(RecordingError, match='no time column') as refused:
        read(path)
    assert len(str(refused.value)) < 1000


def test_a_bag_without_rosbags_is_refused_with_the_remedy(tmp_path, monkeypatch):
    (tmp_path / 'metadata.yaml').touch()
    monkeypatch.setitem(sys.modules, 'rosbags.rosbag2', None)
    with pytest.raises(RecordingError, match=r'not installed: pip install .* or rosbags$'):
        read(tmp_path)


@pytest.mark.parametrize('suffix', ['npz', 'mat'])
def test_given_fields_replace_those_of_the_file(recording, tmp_path, suffix):
    path = tmp_path / f'rig.{suffix}'
    fields = {'vibration': recording.read(), 'ratio': -1.0, 'units': 'g', 'sample_rate': RATE}
    np.savez(path, **fields) if suffix == 'npz' else scipy.io.savemat(path, fields)
    given = {'sample_rate': 500, 'start_time': 3, 'ratio': 2.5, 'orders': [20, 40],
             'pulse_times': [3.0, 3.5], 'pulses_per_revolution': 8, 'description': 'rig 2',
             'channel_names': ('x', 'y', 'z'), 'tach_rate': None}
    opened = read(path, **given)
    assert opened.duration == 10.0
    assert (opened.start_time, opened.ratio, opened.orders) == (3.0, 2.5, (20.0, 40.0))
    assert opened.pulse_times.tolist() == [3.0, 3.5]
    assert (opened.pulses_per_revolution, opened.tach_rate) == (8, None)
    assert (opened.description, opened.units) == ('rig 2', ('g', 'g', 'g'))
    assert opened.channel_names == ('x', 'y', 'z')
    np.testing.assert_array_equal(opened.read(), recording.read())


def test_given_fields_of_a_wav_and_a_csv(recording, tmp_path):
    scipy.io.wavfile.write(tmp_path / 'rig.wav', 100, recording.read().T)
    opened = read(tmp_path / 'rig.wav', sample_rate=97656, tach_channel=2, orders=(7,))
    assert (opened.sample_rate, opened.tach_rate, opened.orders) == (97656.0, 97656.0, (7.0,))
    opened = read(table(tmp_path / 'rig.csv', recording.read()), sample_rate=RATE, start_time=7.0,
                  vibration_channels='1', units='g')
    assert (opened.start_time, opened.units, opened.channels) == (7.0, ('g',), 1)


def test_a_sample_that_is_no_measurement_is_refused_with_its_file(tmp_path):
    path = save(tmp_path / 'rig.npz', vibration=np.full((1, 9), 1e200), sample_rate=RATE)
    with pytest.raises(RecordingError, match=f'^{path}: sample of 1e.200: must be within 1e.100'):
        read(path).read()


def test_a_missing_rate_can_be_given(recording, tmp_path):
    path = save(tmp_path / 'rig.npz', vibration=recording.read())
    assert read(path, sample_rate=RATE).sample_rate == RATE


@pytest.mark.parametrize(('given', 'error', 'message'), [
    ({'sampel_rate': 1.0}, ParameterError, 'no field sampel_rate: give some of sample_rate, '),
    ({'vibration': [1.0]}, ParameterError, 'no field vibration'),
    ({'ratio': 'two'}, RecordingError, 'ratio=two: neither a number nor a key of the file'),
    ({'ratio': '2,3'}, RecordingError, 'ratio of shape .2,.: give a single number'),
    ({'tach': 'trigger'}, RecordingError, 'tach=trigger: the file has no such key; it has chan'),
    ({'missing_teeth': 6}, RecordingError, 'missing_teeth 6: must be from 0 to less than'),
    ({'pulses_per_revolution': 1.5}, RecordingError, 'give a whole number'),
    ({'pulse_times': [[1.0, 2.0], [3.0, 4.0]]}, RecordingError, 'give one row of numbers'),
])
def test_fields_that_cannot_be_given(recording, tmp_path, given, error, message):
    write_npz(tmp_path / 'rig.npz', recording)
    with pytest.raises(error, match=message):
        read(tmp_path / 'rig.npz', **given)


@pytest.mark.parametrize('suffix', ['npz', 'mat'])
def test_a_file_of_another_make_is_read_by_its_own_keys(recording, tmp_path, suffix):
    path = tmp_path / f'rig.{suffix}'
    samples = recording.read()
    fields = {'DE': samples[:1].T, 'FE': samples[1:2].T, 'tach': recording.pulse_times,
              'FS': RATE, 'rpm': 1797.0}
    np.savez(path, **fields) if suffix == 'npz' else scipy.io.savemat(path, fields)
    opened = read(path, **fields_of(
        ['vibration=DE,FE', 'pulse_times=tach', 'sample_rate=FS', 'ratio=2.5', 'missing_teeth=2',
         'pulses_per_revolution=8', 'orders=20,40, 60', 'units=g']))
    np.testing.assert_array_equal(opened.read(), samples[:2])
    np.testing.assert_array_equal(opened.pulse_times, recording.pulse_times)
    assert opened.channel_names == ('DE', 'FE')
    assert (opened.sample_rate, opened.ratio, opened.orders, opened.units) == (
        RATE, 2.5, (20.0, 40.0, 60.0), ('g', 'g'))
    assert (opened.pulses_per_revolution, opened.missing_teeth) == (8, 2)


def test_keys_of_different_lengths_are_refused(tmp_path):
    path = save(tmp_path / 'rig.npz', a=np.zeros(90), b=np.zeros(80), sample_rate=RATE)
    with pytest.raises(RecordingError, match='different lengths: a 90, b 80 samples'):
        read(path, vibration='a,b')


def test_tach_of_another_make_as_long_as_the_vibration_has_its_rate(recording, tmp_path):
    path = save(tmp_path / 'rig.npz', vibration=recording.read(), trig=np.ones(5000),
                sample_rate=RATE)
    opened = read(path, tach='trig')
    assert opened.tach_rate == RATE
    assert 'as sampled with it' in opened.remarks[0]


def test_fields_of_wav_and_csv_name_channels(recording, tmp_path):
    scipy.io.wavfile.write(tmp_path / 'rig.wav', 100, recording.read().T)
    path = table(tmp_path / 'rig.csv', recording.read())
    for name in ('rig.wav', 'rig.csv'):
        opened = read(tmp_path / name, sample_rate='2000', tach='2', vibration='0',
                      pulses_per_revolution='36', missing_teeth='1', orders='7')
        assert (opened.sample_rate, opened.tach_rate, opened.channels) == (2000.0, 2000.0, 1)
        assert (opened.pulses_per_revolution, opened.missing_teeth, opened.orders) == (
            36, 1, (7.0,))
        np.testing.assert_allclose(opened.read_tach(), recording.read()[2], atol=1e-4)
    with pytest.raises(RecordingError, match=r'rig\.csv: no channel .acc.: choose from'):
        read(path, sample_rate=RATE, vibration='acc')
    with pytest.raises(RecordingError, match=r'rig\.csv: ratio=two: neither a number'):
        read(path, sample_rate=RATE, ratio='two')


@pytest.mark.parametrize('text', ['ratio', '=2', 'ratio=', 'raito=2'])
def test_field_texts_that_say_nothing(text):
    with pytest.raises(ParameterError, match=r'give NAME=KEY or|no field raito: give some of'):
        fields_of([text])


def test_pulses_without_vibration(tmp_path):
    path = save(tmp_path / 'edges.npz', edges=np.arange(50.0))
    with pytest.raises(RecordingError, match='no vibration among the fields edges'):
        read(path, pulse_times='edges')
    opened = read(path, pulse_times='edges', pulses_suffice=True)
    assert (opened.pulse_times.size, opened.samples) == (50, 1)


def test_a_rate_that_contradicts_the_messages_is_refused(recording, tmp_path):
    pytest.importorskip('rosbags')
    write_bag(tmp_path / 'bag', recording)
    with pytest.raises(RecordingError, match=r'500.* Hz given, but the messages of /vib'):
        read(tmp_path / 'bag', sample_rate=500)


def test_channel_map_applies_to_arrays_too(recording, tmp_path):
    write_npz(tmp_path / 'rig.npz', recording)
    opened = read(tmp_path / 'rig.npz', vibration_channels=('c', 'a'), tach_channel='b')
    assert (opened.channel_names, opened.units) == (('c', 'a'), ('Pa', 'm/s^2'))
    np.testing.assert_array_equal(opened.read(), recording.read()[[2, 0]])
    np.testing.assert_array_equal(opened.read_tach(), recording.read()[1])
    assert opened.tach_rate == RATE


@pytest.mark.parametrize('name', ['rig', 'rig.flac', 'nowhere.npz'])
def test_what_is_no_recording(tmp_path, name):
    if name != 'nowhere.npz':
        (tmp_path / name).write_bytes(b'')
    with pytest.raises(RecordingError, match=r'no such file|is not one of \.npz'):
        read(tmp_path / name)


# --- bags ---------------------------------------------------------------------------------------

@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
@pytest.mark.parametrize('tach_type', ['sensor_msgs/msg/TimeReference',
                                       'std_msgs/msg/Float64MultiArray'])
def test_bag_round_trip(recording, tmp_path, storage, tach_type):
    pytest.importorskip('rosbags')
    write_bag(tmp_path / 'bag', recording, storage=storage, tach_type=tach_type,
              samples_per_block=300, namespace='/rig')
    suffix = {'mcap': '.mcap', 'sqlite3': '.db3'}[storage]
    for path in (tmp_path / 'bag', next((tmp_path / 'bag').glob(f'*{suffix}'))):
        opened = read(path)
        np.testing.assert_array_equal(opened.read(), recording.read())
        np.testing.assert_array_equal(opened.read_tach(), recording.read_tach())
        np.testing.assert_allclose(opened.pulse_times, recording.pulse_times, rtol=0, atol=0.6e-9)
        assert (opened.start_time, opened.sample_rate, opened.tach_rate) == (12.5, RATE, 2 * RATE)
        assert opened.remarks == ()


def test_bag_of_float32_needs_a_rate(recording, tmp_path):
    pytest.importorskip('rosbags')
    write_bag(tmp_path / 'bag', replace(recording, tach=None, start_time=0.0),
              vibration_type='std_msgs/msg/Float32MultiArray')
    with pytest.raises(RecordingError, match='carries none: set the parameter sample_rate'):
        read(tmp_path / 'bag')
    opened = read(tmp_path / 'bag', sample_rate=RATE)
    np.testing.assert_array_equal(opened.read(), recording.read().astype(np.float32))


def test_lost_samples_in_a_bag_are_nan(recording, tmp_path):
    pytest.importorskip('rosbags')
    vibration = recording.read()
    vibration[:, 950:1351] = np.nan
    vibration[1, 1407] = np.nan
    gappy = replace(recording, vibration=ArraySource(vibration))
    write_bag(tmp_path / 'bag', gappy, samples_per_block=100)
    opened = read(tmp_path / 'bag')
    vibration[:, 1407] = np.nan
    np.testing.assert_array_equal(opened.read(), vibration)
    assert opened.remarks == ('/vibration: 402 lost samples are NaN',)


def write_messages(path, kind, messages, topic='vibration'):
    """Write messages of one topic; each is a function of the types."""
    rosbag2, typesys = (pytest.importorskip(f'rosbags.{name}') for name in ('rosbag2', 'typesys'))
    store = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
    with rosbag2.Writer(path, version=9) as bag:
        connection = bag.add_connection(f'/{topic}', kind, typestore=store)
        for k, message in enumerate(messages):
            bag.write(connection, k, store.serialize_cdr(message(store.types), kind))
    return path


def float64_block(index, *, time=None, rate=RATE, shape=(2, 100), sizes=None, offset=3):
    """Return the maker of a vibration message."""
    time = index / RATE if time is None else time
    samples = np.broadcast_to(index + np.arange(shape[1], dtype=np.float64), shape)

    def make(types):
        dims = [types['std_msgs/msg/MultiArrayDimension'](label, size, 0)
                for label, size in zip(('channel', 'sample'), sizes or shape)]
        data = np.concatenate([np.array([time, rate, index, 7.0, 8.0], np.float64)[:offset],
                               samples.ravel()])
        layout = types['std_msgs/msg/MultiArrayLayout'](dims, offset)
        return types['std_msgs/msg/Float64MultiArray'](layout, data)
    return make


def test_repeats_in_a_bag_are_dropped(tmp_path):
    path = write_messages(tmp_path / 'bag', 'std_msgs/msg/Float64MultiArray',
                          [float64_block(index) for index in (500, 600, 600, 550, 650, 800)])
    opened = read(path)
    wanted = np.arange(500.0, 900.0)
    wanted[250:300] = np.nan
    np.testing.assert_array_equal(opened.read(), [wanted, wanted])
    assert opened.start_time == 500 / RATE
    assert opened.remarks == ('/vibration: 50 lost samples are NaN',
                              '/vibration: 250 repeated samples were skipped')


@pytest.mark.parametrize('kind', ['bag', 'old bag'])
def test_bags_of_newer_and_older_versions_are_read(recording, tmp_path, kind):
    """Header elements are appended; an old bag has the topics and layouts of the first version."""
    pytest.importorskip('rosbags')
    offset = 5 if kind == 'bag' else 3
    path = write_messages(tmp_path / kind, 'std_msgs/msg/Float64MultiArray',
                          [float64_block(index, offset=offset) for index in (0, 100)])
    opened = read(path)
    np.testing.assert_array_equal(opened.read()[1], np.arange(200))
    assert (opened.sample_rate, opened.start_time) == (RATE, 0.0)


def test_a_bag_block_without_header_is_counted(tmp_path):
    path = write_messages(tmp_path / 'bag', 'std_msgs/msg/Float64MultiArray',
                          [float64_block(index, offset=0) for index in (0, 100)])
    np.testing.assert_array_equal(read(path, sample_rate=RATE).read()[1], np.arange(200))


@pytest.mark.parametrize(('second', 'message'), [
    (float64_block(100, rate=RATE + 1), 'become 2 at 2001'),
    (float64_block(100, shape=(3, 100)), 'become 3'),
    (float64_block(100, time=9.0), 'a second run; split the bag'),
    (float64_block(10**9), 'more than 3600 s'),
    (float64_block(2**53 - 100), 'more than 3600 s'),
    (float64_block(100.5), 'index of the first sample is 100.5: send a whole'),
    (float64_block(-100), 'index of the first sample is -100.0: send a whole'),
    (float64_block(100, time=np.nan), 'time nan'),
    (float64_block(100, rate=0.0), 'rate 0.0'),
    (float64_block(100, rate=5e-324), 'must be from 1e-12 to'),
    (float64_block(100, time=1e308), 'must be within 1e.15 s of 0'),
    (float64_block(1e101), 'index of the first sample is 1e.101'),
    (float64_block(100, sizes=(2, 101)), 'layout 2x101 .* does not fit'),
    (float64_block(100, sizes=(200,)), r"dimensions \['channel'\] received"),
    (float64_block(100, offset=2), 'data_offset 2 received, 3 expected'),
])
def test_bags_that_do_not_go_on(tmp_path, second, message):
    path = write_messages(tmp_path / 'bag', 'std_msgs/msg/Float64MultiArray',
                          [float64_block(0), second])
    with pytest.raises(RecordingError, match=message):
        read(path, sample_rate=RATE if 'offset' in message else None)


def test_a_gap_at_an_absurd_rate_is_no_gap_to_fill(tmp_path):
    path = write_messages(tmp_path / 'bag', 'std_msgs/msg/Float64MultiArray', [
        float64_block(index, time=index / 1e12, rate=1e12) for index in (0, 2**53 - 100)])
    with pytest.raises(RecordingError, match='more than 3600 s or 536870912 values'):
        read(path)


def test_a_type_that_only_bears_the_name_is_refused(tmp_path):
    rosbag2, typesys = (pytest.importorskip(f'rosbags.{name}') for name in ('rosbag2', 'typesys'))
    kind = 'std_msgs/msg/Float64MultiArray'
    store = typesys.get_typestore(typesys.Stores.EMPTY)
    store.register(typesys.get_types_from_msg('float64 only', kind))
    with rosbag2.Writer(tmp_path / 'bag', version=9) as bag:
        connection = bag.add_connection('/vibration', kind, typestore=store)
        bag.write(connection, 0, store.serialize_cdr(store.types[kind](1.0), kind))
    with pytest.raises(RecordingError, match='differs from that of ROS 2'):
        read(tmp_path / 'bag')


def imu(stamp, *values):
    """Return the maker of an Imu message."""
    def make(types):
        vector, numbers = types['geometry_msgs/msg/Vector3'], np.zeros(9)
        time = types['builtin_interfaces/msg/Time'](*divmod(round(stamp * 1e9), 10**9))
        return types['sensor_msgs/msg/Imu'](
            types['std_msgs/msg/Header'](time, ''),
            types['geometry_msgs/msg/Quaternion'](0.0, 0.0, 0.0, 1.0), numbers,
            vector(0.0, 0.0, 0.0), numbers, vector(*map(float, values)), numbers)
    return make


def imu_bag(path, stamps):
    """Write a bag of Imu messages whose z counts them."""
    return write_messages(path, 'sensor_msgs/msg/Imu',
                          [imu(stamp, 0.0, 0.0, k) for k, stamp in enumerate(stamps)])


def test_imu_bag_with_a_lost_message(tmp_path):
    path = write_messages(tmp_path / 'bag', 'sensor_msgs/msg/Imu',
                          [imu(5.0 + 0.01 * k, 1.0 * k, 2.0 * k, 9.81) for k in (0, 1, 2, 4, 5)],
                          topic='imu/data')
    topic = ('/imu/data',)
    opened = read(path, sample_rate=100, vibration_channels=topic)
    assert (opened.channel_names, opened.units[0]) == (('x', 'y', 'z'), 'm/s^2')
    assert opened.start_time == 5.0
    np.testing.assert_array_equal(opened.read()[:2], [[0, 1, 2, np.nan, 4, 5],
                                                      [0, 2, 4, np.nan, 8, 10]])
    one = read(path, sample_rate=100, vibration_channels=(*topic, 'z'))
    assert one.channel_names == ('z',)
    with pytest.raises(RecordingError, match='no vibration topic among /imu/data'):
        read(path, sample_rate=100)


def test_samples_that_no_machine_has_end_a_recording(tmp_path):
    samples = np.ones((1, 100))
    samples[0, [40, 50]] = np.nan, -1e200
    write_npz(tmp_path / 'a.npz', Recording(ArraySource(samples), RATE))
    opened = read(tmp_path / 'a.npz')
    assert next(opened.blocks(50)).shape == (1, 50)
    with pytest.raises(RecordingError, match=r'sample of -1e\+200: must be within 1e\+100'):
        opened.read()


def test_pulses_beyond_2038_need_an_array(tmp_path):
    pytest.importorskip('rosbags')
    late = Recording(ArraySource(np.zeros((1, 1000))), RATE, start_time=3.8e9,
                     pulse_times=3.8e9 + 0.1 * np.arange(5))
    with pytest.raises(RecordingError, match=r'pulse time 3800000000.0 s: .* set tach_type to'):
        write_bag(tmp_path / 'reference', late)
    write_bag(tmp_path / 'array', late, tach_type='std_msgs/msg/Float64MultiArray')
    opened = read(tmp_path / 'array')
    np.testing.assert_array_equal(opened.pulse_times, late.pulse_times)


@pytest.mark.machines
def test_imu_bag_is_played_by_its_stamps(tmp_path, rng):
    stamps = 100.0 + (np.arange(4000) + rng.uniform(-0.7, 0.7, 4000)) / 1000.0
    opened = read(imu_bag(tmp_path / 'jitter', stamps), sample_rate=1000.0)
    assert (opened.samples, opened.remarks) == (4000, ())
    stamps = 100.0 + np.delete(np.arange(5000), [2500, 2501]) / 999.5
    opened = read(imu_bag(tmp_path / 'slow', stamps), sample_rate=1000.0)
    assert opened.remarks == ('/vibration: 2 lost samples are NaN',)
    assert np.flatnonzero(np.isnan(opened.read()[2])).tolist() == [2500, 2501]


@pytest.mark.parametrize('source_rate', [990.0, 1010.0])
def test_imu_bag_of_another_rate_is_refused_with_its_rate(tmp_path, source_rate):
    bag = imu_bag(tmp_path / 'bag', 5.0 + np.arange(3000) / source_rate)
    with pytest.raises(RecordingError, match=f'or sample_rate is not the {source_rate:g} Hz of'):
        read(bag, sample_rate=1000.0)
    assert read(bag, sample_rate=source_rate).samples == 3000


def test_imu_bag_whose_stamps_jump_back_is_refused(tmp_path):
    bag = imu_bag(tmp_path / 'bag', np.concatenate([np.arange(100), np.arange(100)]) / 1000.0)
    with pytest.raises(RecordingError, match=r'stamps jump back to 0\.0 s: a second run; split'):
        read(bag, sample_rate=1000.0)


def test_repeats_in_an_imu_bag_are_dropped(tmp_path):
    messages = [imu(0.01 * k, 0.0, 0.0, k) for k in (0, 1, 1, 2, 3)]
    bag = write_messages(tmp_path / 'bag', 'sensor_msgs/msg/Imu', messages)
    opened = read(bag, sample_rate=100.0)
    np.testing.assert_array_equal(opened.read()[2], np.arange(4.0))
    assert opened.remarks == ('/vibration: 1 repeated samples were skipped',)


def test_errors_of_the_bag_writer(recording, tmp_path):
    pytest.importorskip('rosbags')
    with pytest.raises(RecordingError, match='not one of those'):
        write_bag(tmp_path / 'bag', recording, storage='cassette')
    write_bag(tmp_path / 'bag', recording)
    with pytest.raises(RecordingError, match='exists'):
        write_bag(tmp_path / 'bag', recording)
    with pytest.raises(RecordingError, match='no topic /nowhere'):
        read(tmp_path / 'bag', vibration_channels=('/nowhere',))


# --- measured -----------------------------------------------------------------------------------

@pytest.mark.parametrize(('name', 'channels', 'samples', 'pulses', 'acquisitions'), [
    ('gear0_gearbox', 6, 282_624, None, 1),
    ('gfds_b30hz0', 4, 88_320, None, 1),
    ('gfds_b30hz50', 4, 94_208, None, 1),
    ('gfds_h30hz0', 4, 88_832, None, 1),
    ('gfds_h30hz50', 4, 110_848, None, 1),
    ('motor_10V_100kHz', 1, 100_000, None, 1),
    ('motor_30V_100kHz', 1, 100_000, None, 1),
    ('motor_runup_20V_40kHz', 1, 120_000, None, 1),
    ('rotorbalancer_weight', 1, 952, None, 10),
    ('rotorbalancer_weight_5', 1, 952, None, 10),
    ('rotorbalancer_without_weight', 1, 952, None, 10),
    ('uia_bearing_rig_1', 1, 1_228_800, 102, 1),
])
def test_measured_recordings(shared_data, name, channels, samples, pulses, acquisitions):
    opened = read(shared_data / f'{name}.npz', acquisition=acquisitions - 1)
    assert (opened.channels, opened.samples, opened.acquisitions) == (
        channels, samples, acquisitions)
    assert (opened.pulse_times is None) == (pulses is None)
    assert pulses is None or opened.pulse_times.size == pulses
    assert sum(block.shape[1] for block in opened.blocks(10_000)) == samples


def test_trigger_edges_are_no_recording(shared_data):
    with pytest.raises(RecordingError, match='no vibration'):
        read(shared_data / 'engine_edges_civic_K20_cranking.npz')


@pytest.mark.parametrize('make', [
    lambda path: os.mkfifo(path), lambda path: path.symlink_to('/dev/zero')])
@pytest.mark.parametrize('name', ['rig.npz', 'rig.wav', 'bag/bag_0.mcap'])
def test_a_pipe_or_device_is_refused(tmp_path, name, make):
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    make(path)
    opened = path if path.parent == tmp_path else path.parent
    with pytest.raises(RecordingError, match=f'{path.name} is a pipe or a device: give a file'):
        read(opened)


def test_a_recording_can_be_sent_to_another_process(tmp_path, rng):
    both = rng.standard_normal((500, 2)).astype(np.float32)
    scipy.io.wavfile.write(tmp_path / 'rig.wav', 1000, both)
    found = read(tmp_path / 'rig.wav', tach_channel='1')
    sent = pickle.loads(pickle.dumps(found))
    np.testing.assert_array_equal(sent.read(), both[:, :1].T)
    np.testing.assert_array_equal(sent.read_tach(), both[:, 1])


@pytest.mark.parametrize('decimals', [3, 2])
def test_times_rounded_to_more_than_a_sample_tell_the_rate(tmp_path, decimals):
    rows = [f'{k / 2000.0:.{decimals}f},{k % 7}' for k in range(8000)]
    path = tmp_path / 'rounded.csv'
    path.write_text('\n'.join(['time,acceleration', *rows]), encoding='utf-8')
    found = read(path)
    assert found.sample_rate == pytest.approx(2000.0, rel=1e-4)
    assert found.start_time == pytest.approx(0.0, abs=10.0 ** -decimals)
    assert read(path, sample_rate=2000.0).sample_rate == 2000.0
    with pytest.raises(RecordingError, match='leave it out'):
        read(path, sample_rate=2100.0)
    path.write_text('\n'.join(['time,acceleration', *rows[:4000], *rows[4200:]]), encoding='utf-8')
    with pytest.raises(RecordingError, match='split the file at gaps'):
        read(path)


def test_a_tach_rate_in_khz_is_named_before_pulses_are_looked_for(rng):
    tach = (np.arange(200_000) % 400 < 40) + 0.01 * rng.standard_normal(200_000)
    recording = Recording(ArraySource(rng.standard_normal((1, 200_000))), 1e4,
                          tach=ArraySource(tach[None]), tach_rate=10.0)
    with pytest.raises(RecordingError, match='looks like kHz; give tach_rate=10000'):
        recording.keyphasor_pulses()
    assert replace(recording, tach_rate=1e4).keyphasor_pulses().size == 499
