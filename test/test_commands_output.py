# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""What commands share: output that cannot be written, and the machine file of recordings."""

from functools import partial
import io
from pathlib import Path
import signal
import subprocess
import sys
from threading import Thread

from bench import SteadyClock
import numpy as np
import pytest
from sa_jitter_ros.commands import (
    average, check_keyphasor, close_loop, layouts, loop_run, progress)
from sa_jitter_ros.errors import ParameterError, SignalError
from sa_jitter_ros.parameter_file import shipped


@pytest.mark.processes
@pytest.mark.parametrize(('output', 'status', 'says'), [
    ('/dev/full', 2, 'layouts: standard output: No space left on device\n'), ('head', 0, '')])
def test_output_that_cannot_be_printed_is_one_line(tmp_path, output, status, says):
    command = [sys.executable, '-m', 'sa_jitter_ros.commands.layouts', '--params',
               str(shipped('machine.yaml')), '--output', str(tmp_path)]
    target = subprocess.PIPE if output == 'head' else Path(output).open('w')
    process = subprocess.Popen(command, stdout=target, stderr=subprocess.PIPE, text=True)
    (process.stdout or target).close()  # head has seen enough
    errors = process.stderr.read()
    process.stderr.close()
    assert (process.wait(), errors) == (status, says)


def test_loop_refuses_a_folder_that_it_cannot_write_before_it_reads(tmp_path, capsys):
    (tmp_path / 'file').touch()
    arguments = ['none.npz', '--params', 'none.yaml', '--output']
    assert close_loop.main([*arguments, str(tmp_path / 'file' / 'out')]) == 2
    assert capsys.readouterr().err == (
        f'close_loop: --output {tmp_path}/file/out: {tmp_path}/file is a file: give a folder\n')
    assert close_loop.main([*arguments, '/proc/new']) == 2
    assert capsys.readouterr().err.startswith(
        'close_loop: --output /proc/new: cannot write in /proc (')
    assert close_loop.main([*arguments, str(tmp_path / 'new')]) == 2
    assert 'none.npz: no such file' in capsys.readouterr().err
    assert [item.name for item in tmp_path.iterdir()] == ['file']


@pytest.mark.parametrize('option', ['-p state_bin:=3', '--state load'])
def test_what_the_change_monitor_takes_needs_a_baseline(tmp_path, capsys, option):
    assert average.main(['rig.npz', '--output', str(tmp_path), *option.split()]) == 2
    assert capsys.readouterr().err == (
        f'average: {option.removesuffix(" load")} needs --baseline\n')


def test_stopped_loop_says_so_in_one_line_and_writes_nothing(tmp_path, capsys, monkeypatch):
    def stopped(*_):
        raise KeyboardInterrupt
    monkeypatch.setattr(loop_run, 'run', stopped)
    assert close_loop.main(['rig.npz', '--declared', str(shipped('machine.yaml')), '--quiet',
                            '--output', str(tmp_path / 'report')]) == 130
    assert capsys.readouterr().err == 'close_loop: stopped before the report was written\n'
    assert not (tmp_path / 'report' / 'report.json').exists()


def test_error_of_a_command_is_one_line_with_its_remedy(tmp_path, capsys, monkeypatch):
    def refused(*_):
        raise ParameterError('orders are\n' + ', '.join(map(str, range(500))) + ': give fewer')
    monkeypatch.setattr(loop_run, 'run', refused)
    assert close_loop.main(['rig.npz', '--declared', str(shipped('machine.yaml')), '--quiet',
                            '--output', str(tmp_path / 'report')]) == 2
    line, end = capsys.readouterr().err.split('\n')
    assert line.startswith('close_loop: orders are 0, 1, ')
    assert line.endswith('499: give fewer')
    assert not end


def test_command_runs_in_any_thread_and_gives_sigterm_back(tmp_path, capsys):
    before, status = signal.getsignal(signal.SIGTERM), []
    command = partial(layouts.main, [
        '--params', str(shipped('machine.yaml')), '--output', str(tmp_path)])
    thread = Thread(target=lambda: status.append(command()))
    thread.start()
    thread.join()
    assert [*status, command()] == [0, 0]
    assert capsys.readouterr().err == ''
    assert signal.getsignal(signal.SIGTERM) is before


def test_machine_file_describes_the_recording_and_fields_win(tmp_path, monkeypatch):
    np.savez(tmp_path / 'rig.npz', vibration=np.zeros(100), sample_rate=1e3,
             pulse_times=[0.0, 0.05])
    checked = []

    def refused(recording, **_):
        checked.append(recording)
        raise SignalError('seen')

    monkeypatch.setattr(check_keyphasor, 'check_keyphasor', refused)
    command = [str(tmp_path / 'rig.npz'), '--output', str(tmp_path), '--params',
               str(shipped('machine.yaml'))]
    assert check_keyphasor.main(command) == check_keyphasor.main([
        *command, '--field', 'ratio=3']) == 2
    found, given = checked
    assert (found.ratio, found.orders[0], found.pulses_per_revolution) == (183 / 76, 19.0, 1)
    assert (given.ratio, given.orders[0]) == (3.0, 19.0)


class Terminal(io.StringIO):
    """A text that says whether it is a terminal."""

    def __init__(self, terminal):
        super().__init__()
        self.isatty = lambda: terminal


@pytest.mark.parametrize('terminal', [True, False])
def test_progress_of_a_long_step_is_shown(monkeypatch, terminal):
    clock, output = SteadyClock(), Terminal(terminal)
    monkeypatch.setattr(progress, 'time', clock)
    monkeypatch.setattr(sys, 'stderr', output)
    shown = progress.Progress('prog')
    shown.tick()
    assert ('working, 0 s' in output.getvalue()) == terminal  # a line costs more than a bar
    shown.step('reading')
    clock.now += 3.0
    shown.tick()
    assert ('working, 3 s' in output.getvalue()) == terminal
    clock.now += 9.0
    shown.tick()
    assert 'prog: working, 12 s' in output.getvalue()
    with shown.ticking():
        shown.step('fitting')
    assert output.getvalue().count('prog: reading\n') == 1
    assert output.getvalue().count('prog: fitting\n') == 1


def test_quiet_progress_is_silent(monkeypatch):
    monkeypatch.setattr(sys, 'stderr', Terminal(True))
    shown = progress.Progress('prog', quiet=True)
    with shown.ticking():
        shown.step('reading')
        shown.tick()
    assert sys.stderr.getvalue() == ''
