# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The script `run`: the marks that the quick tests leave out, and its errors of one line."""

import os
from pathlib import Path
import re
import shutil
import subprocess

import pytest

ROOT = Path(__file__).resolve().parents[1]
RUN = ROOT / 'run'


@pytest.fixture
def refusal(tmp_path):
    """Return a function that starts a copy of `run`, which must refuse, and returns its line."""
    copy = tmp_path / 'repository' / 'run'
    copy.parent.mkdir()
    shutil.copy(RUN, copy)
    tools = tmp_path / 'tools'
    tools.mkdir()

    def refuse(*arguments, tool='', script='', **environment):
        if tool:
            (tools / tool).write_text(f'#!/bin/sh\n{script}\n')
            (tools / tool).chmod(0o755)
        inherited = {
            key: value for key, value in os.environ.items()
            if key not in ('PYTHONPATH', 'ROS_DISTRO', 'SA_JITTER_ROS_DISTRO')
        }
        result = subprocess.run(
            [copy, *arguments],
            env={**inherited, 'PATH': f'{tools}:{inherited["PATH"]}', **environment},
            capture_output=True, text=True, check=False)
        assert result.returncode == 2
        assert not result.stdout
        assert result.stderr.startswith('run: ')
        assert result.stderr.count('\n') == 1
        assert [path.name for path in copy.parent.iterdir()] == ['run']
        return result.stderr

    return refuse


@pytest.mark.parametrize('arguments', [(), ('build',), ('--help',)])
def test_another_command(refusal, arguments):
    assert './run demo' in refusal(*arguments)


@pytest.mark.parametrize('variable', ['ROS_DISTRO', 'SA_JITTER_ROS_DISTRO'])
def test_another_distribution(refusal, variable):
    assert 'humble is not supported' in refusal('test', **{variable: 'humble'})


def test_distribution_without_wheels(refusal):
    assert 'no wheels of ROS 2 lyrical: source it' in refusal(
        'test', SA_JITTER_ROS_DISTRO='lyrical')
    line = refusal('test', tool='python3', script='exit 1', ROS_DISTRO='lyrical')
    assert 'imports rclpy of ROS 2 lyrical' in line


def test_two_distributions(refusal):
    line = refusal('test', ROS_DISTRO='jazzy', SA_JITTER_ROS_DISTRO='kilted')
    assert 'SA_JITTER_ROS_DISTRO' in line


def test_another_processor(refusal):
    assert 'aarch64' in refusal('demo', tool='uname', script='echo aarch64')


def test_another_python(refusal):
    assert 'cpython 3.9.2' in refusal('demo', tool='python3', script='echo cpython 3.9.2')


def test_python_without_its_venv_module(refusal):
    script = 'case "$2" in *ensurepip*) exit 1 ;; esac; echo cpython 3.12.3'
    assert 'apt install python3-venv' in refusal('demo', tool='python3', script=script)


def test_no_python(refusal):
    assert 'apt install python3' in refusal('test', tool='python3', script='exit 127')


def test_distribution_that_is_named_but_not_sourced(refusal):
    line = refusal('test', tool='python3', script='exit 1', ROS_DISTRO='kilted')
    assert 'imports rclpy' in line


@pytest.mark.parametrize(('command', 'files', 'extras'), [
    ('test', [], ['test']), ('demo', [], []), ('demo', ['rig.npz', '--output', 'out'], []),
    ('demo', ['rig.mcap'], ['bags']), ('demo', ['bag'], ['bags']), ('demo', ['old.mat'], []),
    ('demo', ['new.mat'], ['mat73'])])
def test_extras_are_those_that_the_recording_needs(tmp_path, command, files, extras):
    (tmp_path / 'bag').mkdir()
    (tmp_path / 'bag' / 'metadata.yaml').touch()
    (tmp_path / 'out').mkdir()
    (tmp_path / 'rig.npz').write_bytes(b'PK\x03\x04')
    (tmp_path / 'old.mat').write_bytes(b'MATLAB 5.0 MAT-file\x00')
    (tmp_path / 'new.mat').write_bytes(b'MATLAB 7.3 MAT-file\x00')
    function = re.search(r'(?ms)^needed_extras\(\) \{.*?^\}', RUN.read_text())[0]
    script = f'shopt -s extglob\n{function}\ncommand={command}\nneeded_extras "$@"'
    found = subprocess.run(['bash', '-euc', script, 'run', *files], cwd=tmp_path,
                           capture_output=True, text=True, check=True)
    assert found.stdout.split() == extras


def test_quick_leaves_out_the_marks_that_contributing_explains(pytestconfig):
    marks = {line.partition(':')[0] for line in pytestconfig.getini('markers')
             if line in (ROOT / 'pyproject.toml').read_text()}
    found = re.search(r"quick='not \((.*)\)'", RUN.read_text())
    assert set(found[1].split(' or ')) == marks
    table = (ROOT / 'CONTRIBUTING.md').read_text().partition('| mark |')[2]
    assert set(re.findall(r'(?m)^\| `(\w+)` \|', table)) == marks
