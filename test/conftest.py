# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Fixtures of all tests; those of nodes are the fixtures that the package gives its users."""

import atexit
import gc
import os
from pathlib import Path
import shutil
import tempfile

from hypothesis import settings
import numpy as np
import pytest
from sa_jitter_ros.nodes.linear_algebra import use_one_thread
import scipy.linalg  # noqa: F401 (its BLAS must be loaded to be set)

pytest_plugins = ['sa_jitter_ros.nodes.testing']

# Logs, and baselines of monitors.
os.environ['ROS_HOME'] = os.environ['ROS_LOG_DIR'] = tempfile.mkdtemp(prefix='sa_jitter_ros_')
atexit.register(shutil.rmtree, os.environ['ROS_HOME'], ignore_errors=True)

use_one_thread()
settings.register_profile('repeatable', deadline=None, derandomize=True, max_examples=40)
settings.load_profile('repeatable')

ROOT = Path(__file__).resolve().parents[1]


def pytest_collection_finish():
    """Let the garbage collector, which commands call often, leave alone what is imported."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_teardown(item, nextitem):
    """Let it leave alone what the tests of a file have left, too."""
    yield
    if nextitem is not None and nextitem.path != item.path:
        gc.collect()
        gc.freeze()


@pytest.fixture
def rng():
    """Return the random generator of one test, the same in every run."""
    return np.random.default_rng(20240229)


@pytest.fixture
def undrawn(monkeypatch):
    """Leave figures blank: to draw those of a report takes as long as the report."""
    monkeypatch.setattr('matplotlib.figure.Figure.draw', lambda figure, renderer: None)


UNDECIDED = 'sa_jitter_ros.inference.trace.undecided_effects', lambda *_: ()


@pytest.fixture
def unasked(monkeypatch):
    """Leave out of a trace what stays undecided, which takes a third of its time."""
    monkeypatch.setattr(*UNDECIDED)


@pytest.fixture(scope='module')
def all_unasked():
    """Leave it out of all traces of a file, those of its fixtures, too."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(*UNDECIDED)
        yield


@pytest.fixture(scope='session')
def shared_data():
    """Return the folder of the measured recordings, or skip the test where it is missing."""
    folder = Path(os.environ.get('SA_JITTER_DATA', ROOT.parent / 'shared' / 'data'))
    if not folder.is_dir():
        pytest.skip(f'no measured recordings in {folder}: set SA_JITTER_DATA to their folder')
    return folder
