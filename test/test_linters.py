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

from importlib.util import find_spec
from pathlib import Path
import subprocess
import sys

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]


def check(tool, *arguments):
    """Run a linter on the repository and fail with what it prints."""
    if find_spec(tool) is None:
        pytest.skip(f'{tool} is not installed')
    command = [sys.executable, '-m', tool, *arguments]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if result.returncode != 0:
        pytest.fail(f'{tool}:\n{result.stdout}{result.stderr}', pytrace=False)


def test_ruff():
    check('ruff', 'check', '--output-format=concise', '--quiet', '.')


@pytest.mark.style
def test_flake8():
    check('flake8', '.')


@pytest.mark.skipif(
    tuple(map(int, np.__version__.split('.')[:2])) < (2, 3),
    reason='types are checked against those of numpy 2.3 or later')
def test_mypy():
    check('mypy')
