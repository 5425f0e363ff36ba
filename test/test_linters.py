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
