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

from importlib import import_module
from importlib.util import find_spec
import os
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


def python_files():
    """Return the paths of all files in Python."""
    return [ROOT / 'setup.py', *(path for folder in (*SOURCES, 'launch')
                                 for path in sorted((ROOT / folder).glob('**/*.py'))
                                 if '.venv' not in path.parts)]


def test_ruff():
    check('ruff', 'check', '--output-format=concise', '--quiet', '.')


def test_codespell():
    check('codespell_lib', *SOURCES, 'README.md', 'CONTRIBUTING.md', 'CHANGELOG.rst', 'config')


def test_imports_are_in_the_order_of_ament():
    """Ruff has an order of its own: the plugin of ament_flake8 is asked, without flake8."""
    orders = pytest.importorskip('flake8_import_order.checker')
    style = import_module('flake8_import_order.styles').lookup_entry_point('google')
    orders.ImportOrderChecker.options = {'import_order_style': style}
    wrong = [f'{path.relative_to(ROOT)}:{error.lineno}: {error.code} {error.message}'
             for path in python_files()
             for error in orders.ImportOrderChecker(str(path), None).check_order()
             if error.code != 'I202']
    assert wrong == []


@pytest.mark.style
@pytest.mark.skipif('ROS_DISTRO' not in os.environ, reason='ruff asks what ament_flake8 and '
                    'ament_pep257 do: those of ROS 2 run where it is sourced')
@pytest.mark.parametrize('linter', ['ament_flake8', 'ament_pep257'])
def test_linters_of_ros(linter):
    check(f'{linter}.main', *map(str, python_files()))


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
