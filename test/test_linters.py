# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The quality gates: style as ROS packages have it, ruff, and strict types."""

from configparser import ConfigParser
from hashlib import sha256
from importlib import import_module
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
import subprocess
import sys

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ('benchmarks', 'docs', 'sa_jitter_ros', 'test', 'validation', 'setup.py')
# The file header of ament_copyright, which compares it without regard to line ends.
HEADER = """\
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


def check(tool, *arguments):
    """Run a linter on the repository and fail with what it prints."""
    if find_spec(tool.partition('.')[0]) is None:
        pytest.skip(f'{tool} is not installed')
    command = [sys.executable, '-m', tool, *arguments]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if result.returncode != 0:
        pytest.fail(f'{tool}:\n{result.stdout}{result.stderr}', pytrace=False)


def test_ruff():
    check('ruff', 'check', '--output-format=concise', '--quiet', '.')


def test_codespell():
    check('codespell_lib', *SOURCES, 'README.md', 'CONTRIBUTING.md', 'CHANGELOG.rst', 'config')


@pytest.mark.style
def test_flake8(cache):
    """Files that it found right before, by the same rules, are not checked again, as in mypy."""
    if find_spec('flake8') is None:
        pytest.skip('flake8 is not installed')
    version = subprocess.run([sys.executable, '-m', 'flake8', '--version'], capture_output=True,
                             check=True).stdout
    rules = version + (ROOT / 'setup.cfg').read_bytes()
    paths = [ROOT / 'setup.py', *(path for folder in (*SOURCES, 'launch')
                                  for path in sorted((ROOT / folder).glob('**/*.py')))]
    found = {str(path.relative_to(ROOT)): sha256(rules + path.read_bytes()).hexdigest()
             for path in paths if '.venv' not in path.parts}
    known = cache.get('flake8', {})
    changed = [name for name, digest in found.items() if known.get(name) != digest]
    if changed:
        check('flake8', *changed)
    cache.set('flake8', found)


def test_flake8_has_the_settings_of_ament():
    if find_spec('ament_flake8') is None:
        pytest.skip('ament_flake8 is not installed')
    ours, theirs = ConfigParser(), ConfigParser()
    ours.read(ROOT / 'setup.cfg')
    theirs.read_string(
        files('ament_flake8').joinpath('configuration/ament_flake8.ini').read_text())
    style = {key: value for key, value in theirs['flake8'].items()
             if key not in ('show-source', 'statistics')}
    assert style.items() <= dict(ours['flake8']).items()


def test_docstrings_are_checked_as_ament_pep257_does():
    """flake8-docstrings asks what ament_pep257 does: pydocstyle, without the same codes."""
    if find_spec('ament_pep257') is None:
        pytest.skip('ament_pep257 is not installed')
    theirs = import_module('ament_pep257.main')._ament_ignore
    ours = ConfigParser()
    ours.read(ROOT / 'setup.cfg')
    ignored = ours['flake8']['extend-ignore'].split(',')
    assert {code for code in ignored if code.startswith('D')} <= set(theirs)
    assert ours['flake8']['docstring-convention'] == 'all'


def test_every_file_states_copyright_and_licence():
    names = [path for source in SOURCES for path in sorted((ROOT / source).glob('**/*'))
             if path.suffix in ('.c', '.h', '.py', '.pyi') and '.venv' not in path.parts]
    assert len(names) > 200
    in_c = HEADER.replace('# ', '// ').replace('#\n', '//\n')
    assert [path for path in names if not path.read_text('utf-8').startswith(
        in_c if path.suffix in ('.c', '.h') else HEADER)] == []


def test_ament_copyright():
    check('ament_copyright.main', *SOURCES, 'CONTRIBUTING.md', 'LICENSE')


@pytest.mark.style
@pytest.mark.skipif(
    tuple(map(int, np.__version__.split('.')[:2])) < (2, 3),
    reason='types are checked against those of numpy 2.3 or later')
def test_mypy():
    check('mypy')
