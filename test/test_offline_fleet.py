# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Many recordings: processes and workers that die, full disks, clusters that do not answer."""

from contextlib import suppress
import csv
import errno
import os
from pathlib import Path
import signal
import socket
import sys
import threading
import time

import numpy as np
import pytest
from sa_jitter_ros.commands import average, close_loop
from sa_jitter_ros.errors import ParameterError, SaJitterError
from sa_jitter_ros.offline.fleet import Failure, find_recordings, run_jobs
from sa_jitter_ros.recordings.npz_format import write_npz
from sa_jitter_ros.recordings.recording import ArraySource, Recording
from sa_jitter_ros.simulation import AdditiveNoise, DeclaredJitter, Gearbox, mesh
from sa_jitter_ros.whole_files import TEMPORARY


def work(job):
    """Return the job, or what its name says."""
    name, _, folder = job.partition('@')
    if name == 'dies':
        os.kill(os.getpid(), signal.SIGKILL)
    if name == 'dies once':
        mark = Path(folder, 'died')
        if not mark.exists():
            mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
    if name == 'is wrong':
        raise SaJitterError('a value')
    if name == 'has a bug':
        return {}['key']
    if name == 'is full':
        raise OSError(28, 'No space left on device')
    time.sleep(0.01)
    return name


def greet(server, answer):
    """Answer every connection of a server in the same way, until it is closed."""
    with suppress(OSError):
        while True:
            connection, _ = server.accept()
            with connection:
                connection.sendall(answer)


@pytest.fixture
def address():
    """Return the address of a cluster with two workers, which restarts those that die."""
    distributed = pytest.importorskip(
        'distributed', reason="Dask is not installed: pip install '.[fleet]'")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None,
                                  host='127.0.0.1') as cluster:
        yield cluster.scheduler_address


@pytest.mark.parametrize('processes', [1, 2])
def test_each_job_has_a_result_or_a_reason(processes):
    jobs = ['a', 'is wrong', 'b', 'has a bug', *(['dies'] if processes > 1 else []), 'c']
    found = {job: str(result) for job, result in run_jobs(work, jobs, processes=processes)}
    assert list(found) == jobs or processes > 1
    assert {job: found[job] for job in 'abc'} == {'a': 'a', 'b': 'b', 'c': 'c'}
    assert found['is wrong'] == 'a value'
    assert found['has a bug'] == "KeyError: 'key'"
    if processes > 1:
        assert found['dies'].startswith('its process was ended by SIGKILL')


@pytest.mark.parametrize('processes', [1, 2])
def test_full_disk_ends_the_run(processes):
    with pytest.raises(OSError, match='No space left'):
        list(run_jobs(work, ['a', 'is full', 'b', 'c'], processes=processes))


def test_stopped_run_leaves_nothing_half_done(tmp_path, monkeypatch, capfd):
    (tmp_path / 'a.npz').touch()

    def stopped(job, told):
        Path(job.folder, f'{TEMPORARY}x').mkdir(parents=True)
        raise KeyboardInterrupt

    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(average, 'average_file', stopped)
    try:
        assert average.main([str(tmp_path), '--output', str(tmp_path / 'out'), '--quiet']) == 130
    finally:
        signal.signal(signal.SIGTERM, before)
    assert 'what was finished stays' in capfd.readouterr().err
    assert list((tmp_path / 'out').rglob('*')) == [tmp_path / 'out' / 'a']


@pytest.mark.machines
def test_full_disk_is_one_line_and_what_was_finished_stays(tmp_path, monkeypatch, capfd):
    machine = Gearbox(mesh('shaft', 8), 5000.0, speed=((0.0, 25.0),), seed=3)
    for name in 'ab':
        write_npz(tmp_path / f'{name}.npz', Recording(
            ArraySource(machine.vibration(0, 20_000)), 5000.0,
            pulse_times=machine.pulses(0.0, 4.0).times))
    save = np.savez

    def full(path, **arrays):
        if path.parts[-4] == 'b':
            Path(path).write_bytes(b'half')
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        save(path, **arrays)

    command = [str(tmp_path), '--output', str(tmp_path / 'out'), '--no-figures', '--quiet']
    before = signal.getsignal(signal.SIGTERM)
    with monkeypatch.context() as patch:
        patch.setattr(np, 'savez', full)
        assert average.main(command) == 2
    assert capfd.readouterr().err == (
        f'average: {tmp_path}/out: No space left on device: make room, or give another folder; '
        'what was finished stays\n')
    assert sorted(path.parent.name for path in (tmp_path / 'out').rglob('averages.npz')) == ['a']
    assert average.main(command) == 0
    signal.signal(signal.SIGTERM, before)
    assert sorted(path.parent.name for path in (tmp_path / 'out').rglob('averages.npz')) == [
        'a', 'b']


def test_names_of_recordings_are_their_paths_below_the_folder(tmp_path):
    for name in ('b/rig.npz', 'a/rig.npz', 'a/rig.mat', 'bag/metadata.yaml', 'bag/0.mcap',
                 'out/rig/averages.csv', '.hidden/rig.npz', 'a/notes.txt'):
        (tmp_path / name).parent.mkdir(exist_ok=True, parents=True)
        (tmp_path / name).touch()
    found = find_recordings([tmp_path, tmp_path / 'b' / 'rig.npz'], leave_out=tmp_path / 'out')
    assert [(item.name, bool(item.error)) for item in found] == [
        ('a/rig', False), ('a/rig', True), ('b/rig', False), ('bag', False)]
    same = find_recordings([tmp_path / 'b' / 'rig.npz', tmp_path / 'a' / 'rig.npz'])
    assert [item.name for item in same] == ['rig', 'rig']
    assert same[1].error == (
        f'{tmp_path}/a/rig.npz: its results would have the name rig, as those of '
        f'{tmp_path}/b/rig.npz: rename one of the two, or give the folder that holds both')


def test_cluster_without_dask_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, 'distributed', None)
    with pytest.raises(ParameterError, match=r"pip install 'sa_jitter_ros\[fleet\]'"):
        list(run_jobs(work, ['a'], scheduler='tcp://127.0.0.1:8786'))


def test_cluster_that_does_not_answer_is_one_line(monkeypatch):
    pytest.importorskip('distributed', reason="Dask is not installed: pip install '.[fleet]'")
    monkeypatch.setattr('sa_jitter_ros.offline.fleet.ANSWER', 1.0)
    with socket.create_server(('127.0.0.1', 0)) as server:  # of something else
        threading.Thread(target=greet, args=(server, b'HTTP/1.1 400 Bad Request\r\n\r\n'),
                         daemon=True).start()
        for address in ('tcp://127.0.0.1:9', 'nonsense', 'tcp://',
                        f'tcp://127.0.0.1:{server.getsockname()[1]}'):
            with pytest.raises(ParameterError, match='no answer of a Dask scheduler') as error:
                list(run_jobs(work, ['a'], scheduler=address))
            assert '\n' not in str(error.value)
    assert 'IO loop' not in {thread.name for thread in threading.enumerate()}  # of a client


def test_cluster_without_a_worker_is_one_line(monkeypatch):
    distributed = pytest.importorskip(
        'distributed', reason="Dask is not installed: pip install '.[fleet]'")
    monkeypatch.setattr('sa_jitter_ros.offline.fleet.ANSWER', 1.0)
    with distributed.LocalCluster(n_workers=0, dashboard_address=None, host='127.0.0.1') as empty:
        address = empty.scheduler_address
        with pytest.raises(ParameterError, match=f'no worker: start some, dask worker {address}'):
            list(run_jobs(work, ['a'], scheduler=address))


@pytest.mark.machines
@pytest.mark.usefixtures('undrawn', 'unasked')
def test_loops_of_a_folder_have_a_report_and_a_row_each(tmp_path, capfd):
    machine = Gearbox(mesh('shaft', 8, harmonics=(1.0, 0.8, 0.6)), 5000.0, speed=((0.0, 25.0),),
                      seed=3, effects=(DeclaredJitter('normal', 8e-5), AdditiveNoise(0.02)))
    data, out = tmp_path / 'data', tmp_path / 'out'
    data.mkdir()
    write_npz(data / 'good.npz', Recording(
        ArraySource(machine.vibration(0, 36_000)), 5000.0,
        pulse_times=machine.pulses(0.0, 7.2).times))
    (data / 'broken.npz').write_bytes(b'PK')
    (tmp_path / 'model.yaml').write_text(
        'jitter_predictor:\n  ros__parameters: {keyphasor_rate: 20000.0, trigger_speed: 25.0, '
        'trigger_cycles: 20, orders: [8, 16, 24], noise_std: 0.02}\n')
    command = [str(data), '--declared', str(tmp_path / 'model.yaml'), '--output', str(out),
               '--quiet']
    before, times = signal.getsignal(signal.SIGTERM), []
    for _ in range(2):
        assert close_loop.main(command) == 0
        captured = capfd.readouterr()
        assert captured.out == (
            f'1 traced of 1 recording; 1 could not be used\ntable: {out}/loops.csv\n')
        assert len(captured.err.splitlines()) == 1
        times.append((out / 'good' / 'report.json').stat().st_mtime_ns)
    signal.signal(signal.SIGTERM, before)
    assert times[0] == times[1]
    with (out / 'loops.csv').open(newline='') as file:
        broken, good = csv.DictReader(file)
    assert broken['error'].startswith(f'{data}/broken.npz: ')
    assert good['verdict'] == 'traced'
    assert good['missing_effects'].startswith('excess_jitter std ')
    assert float(good['rms_after']) < float(good['rms_before'])


@pytest.mark.processes
def test_a_worker_that_is_killed_loses_nothing(address, tmp_path):
    jobs = ['a', f'dies once@{tmp_path}', 'b', 'is wrong', 'c', 'd']
    found = dict(run_jobs(work, jobs, scheduler=address))
    assert (tmp_path / 'died').exists()
    assert found.keys() == set(jobs)
    assert found[jobs[1]] == 'dies once'
    assert [job for job, result in found.items() if isinstance(result, Failure)] == ['is wrong']
