# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Tests of files of measuring systems: .tdms, .mf4 and universal files."""

import contextlib
from pathlib import Path
import sys

import numpy as np
import pytest
from sa_jitter_ros.errors import RecordingError
from sa_jitter_ros.recordings import read
from sa_jitter_ros.recordings.channel_list import Channel, source_of

# pyuff leaves files that it writes, and all three libraries broken ones, to the collector.
pytestmark = pytest.mark.filterwarnings('ignore::pytest.PytestUnraisableExceptionWarning')
RATE, TACH_RATE, SAMPLES = 1000.0, 5000.0, 800


@pytest.fixture(name='signals')
def make_signals(rng):
    """Return vibration of two channels at RATE and a tach waveform at TACH_RATE."""
    time = np.arange(SAMPLES * 5) / TACH_RATE
    return rng.normal(size=(2, SAMPLES)), np.where(time * 25.0 % 1.0 < 0.1, 5.0, 0.0)


def write_tdms(path, signals, *, names=('acc x', 'acc y', 'key'), rates=True):
    """Write two groups, one with samples in two segments."""
    nptdms = pytest.importorskip('nptdms')
    vibration, tach = signals
    with nptdms.TdmsWriter(path) as writer:
        for half in (slice(0, 300), slice(300, None)):
            writer.write_segment([nptdms.ChannelObject('vib', name, row[half], properties={
                'unit_string': 'g', **({'wf_increment': 1 / RATE} if rates else {})})
                for name, row in zip(names, vibration)])
        writer.write_segment([
            nptdms.ChannelObject('tacho', names[2], tach, properties={
                'wf_increment': 1 / TACH_RATE} if rates else {}),
            nptdms.ChannelObject('tacho', 'text', ['a', 'b'])])


def write_mf4(path, signals, *, start=0.0):
    """Write two groups of different rates, and one whose times are uneven."""
    asammdf = pytest.importorskip('asammdf')
    vibration, tach = signals
    times = start + np.arange(SAMPLES) / RATE
    with asammdf.MDF(version='4.10') as file:
        file.append([asammdf.Signal(row, times, name=name, unit='g')
                     for name, row in zip(('acc x', 'acc y'), vibration)])
        file.append([asammdf.Signal(tach, np.arange(tach.size) / TACH_RATE, name='key')])
        file.append([asammdf.Signal(np.ones(3), np.array([0.0, 0.1, 0.5]), name='gear')])
        file.save(path, overwrite=True)


def write_uff(path, signals, *, binary=0, func_type=1):
    """Write data sets of different rates."""
    pyuff = pytest.importorskip('pyuff')
    vibration, tach = signals
    file = pyuff.UFF(str(path))
    for name, node, row, rate in (('acc x', 1, vibration[0], RATE),
                                  ('acc y', 2, vibration[1], RATE), ('key', 3, tach, TACH_RATE)):
        content = pyuff.prepare_58(
            binary=binary, id1=name, rsp_node=node, rsp_dir=3, ref_node=1, ref_dir=1, data=row,
            x=np.arange(row.size) / rate, func_type=func_type, abscissa_spacing=1,
            abscissa_min=0.0, abscissa_inc=1 / rate, num_pts=row.size, ord_data_type=4,
            ordinate_axis_units_lab='g', return_full_dict=True)
        file.write_sets({key: value if value is not None else 'NONE' if key.endswith(
            ('lab', 'name')) or key.startswith('id') else 0
            for key, value in content.items()}, mode='add')


WRITERS = {'rig.tdms': write_tdms, 'rig.mf4': write_mf4, 'rig.uff': write_uff,
           'binary.uff': lambda path, signals: write_uff(path, signals, binary=1)}


@pytest.mark.parametrize('name', WRITERS)
def test_vibration_and_a_tach_of_another_rate(tmp_path, signals, name):
    WRITERS[name](tmp_path / name, signals)
    opened = read(tmp_path / name, tach_channel='key')
    assert opened.channel_names == ('acc x', 'acc y')
    assert opened.units == ('g', 'g')
    assert opened.sample_rate == pytest.approx(RATE)
    assert opened.tach_rate == pytest.approx(TACH_RATE)
    np.testing.assert_allclose(opened.read(), signals[0], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(opened.read_tach(), signals[1])
    np.testing.assert_array_equal(np.concatenate(list(opened.blocks(300)), axis=1),
                                  opened.read())
    assert opened.keyphasor_pulses().size == 19
    assert opened.remarks == (('the times of gear are at no constant rate',)
                              if name == 'rig.mf4' else ())


@pytest.mark.parametrize('name', WRITERS)
def test_without_a_map_the_channels_of_one_clock_are_vibration(tmp_path, signals, name):
    WRITERS[name](tmp_path / name, signals)
    opened = read(tmp_path / name)
    assert (opened.channel_names, opened.samples) == (('key',), SAMPLES * 5)
    assert 'left out, because they were not sampled with key: acc x, acc y' in opened.remarks
    assert read(tmp_path / name, vibration='acc y', pulses_per_revolution=2).channels == 1
    with pytest.raises(RecordingError, match='different rates, starts or lengths: acc x 800'):
        read(tmp_path / name, vibration='acc x,key')
    with pytest.raises(RecordingError, match=r'no channel .z.: choose from acc x, acc y, key'):
        read(tmp_path / name, tach_channel='z')


def test_tdms_of_one_name_or_without_rates(tmp_path, signals):
    path = tmp_path / 'rig.tdms'
    write_tdms(path, signals, names=('a', 'b', 'a'))
    assert read(path, tach_channel='tacho/a').channel_names == ('vib/a', 'b')
    write_tdms(path, signals, rates=False)
    with pytest.raises(RecordingError, match='acc x has no sampling rate in the file: give'):
        read(path, vibration='acc x')
    assert read(path, vibration='acc x', sample_rate=50.0).sample_rate == 50.0


@pytest.mark.parametrize('name', WRITERS)
def test_a_rate_is_made_exact_but_not_replaced(tmp_path, signals, name):
    WRITERS[name](tmp_path / name, signals)
    exact = read(tmp_path / name, vibration='acc x', sample_rate=RATE * 1.00001)
    assert exact.sample_rate == RATE * 1.00001
    with pytest.raises(RecordingError, match='sample_rate 900 Hz given, but the file says 1000'):
        read(tmp_path / name, vibration='acc x', sample_rate=900.0)


def test_a_tach_that_begins_at_another_time_is_refused(tmp_path, signals):
    write_mf4(tmp_path / 'rig.mf4', signals, start=0.25)
    assert read(tmp_path / 'rig.mf4', vibration='acc x').start_time == 0.25
    with pytest.raises(RecordingError, match=r'key begins at 0 s and acc x at 0\.25 s'):
        read(tmp_path / 'rig.mf4', tach_channel='key')


def test_universal_file_whose_binary_data_sets_end_on_a_line_of_their_own(tmp_path, signals):
    path = tmp_path / 'rig.uff'
    write_uff(path, signals, binary=1)
    lines = path.read_bytes()
    assert b'    -1\n    -1\n' in lines
    path.write_bytes(lines.replace(b'    -1\n    -1\n', b'\n    -1\n    -1\n'))
    np.testing.assert_allclose(read(path, vibration='acc x,acc y').read(), signals[0])


def test_universal_file_without_time_responses(tmp_path, signals):
    write_uff(tmp_path / 'rig.uff', signals, func_type=2)
    with pytest.raises(RecordingError, match=r'no channel .* data set 0 \(acc x\) is no time'):
        read(tmp_path / 'rig.uff')


@pytest.mark.parametrize(('name', 'package', 'message'), [
    ('rig.tdms', 'nptdms', r"pip install 'sa_jitter_ros\[tdms\]' or npTDMS"),
    ('rig.mf4', 'asammdf', r"pip install 'sa_jitter_ros\[mdf\]' or asammdf"),
    ('rig.mdf', 'asammdf', r"pip install 'sa_jitter_ros\[mdf\]' or asammdf"),
    ('rig.uff', 'pyuff', r"pip install 'sa_jitter_ros\[uff\]' or pyuff"),
    ('rig.unv', 'pyuff', r"pip install 'sa_jitter_ros\[uff\]' or pyuff")])
def test_a_missing_extra_is_named(tmp_path, monkeypatch, name, package, message):
    (tmp_path / name).write_bytes(b'something')
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(RecordingError, match=message) as refused:
        read(tmp_path / name)
    assert '\n' not in str(refused.value)


@pytest.mark.parametrize('name', WRITERS)
def test_broken_files_get_one_line(tmp_path, signals, rng, name):
    path = tmp_path / name
    WRITERS[name](path, signals)
    whole = path.read_bytes()
    for content in (b'', b'something', whole[:len(whole) // 2], bytes(2000), *(
            whole[:at] + bytes(rng.integers(0, 256, 8, np.uint8)) + whole[at + 8:]
            for at in rng.integers(0, len(whole), 20))):
        path.write_bytes(content)
        with contextlib.suppress(RecordingError):
            assert read(path).read().size
    assert path.exists()


def test_a_file_stays_open_through_a_pass():
    opened = []

    @contextlib.contextmanager
    def open_file():
        opened.append(True)
        yield 3.0

    source = source_of(Path(), 2 * (Channel(
        ('a',), '', 1.0, 0.0, 10, lambda file, start, stop: np.full(stop - start, file)),),
        open_file)
    assert [block.shape[1] for block in source.blocks(4)] == [4, 4, 2]
    assert opened == [True]
