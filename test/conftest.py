"""
Fixtures that all tests share, and the environment they run in.

The environment is set before anything imports rclpy or a message package. Discovery is off: no
test meets another ROS graph; tests of several processes give these ``process_environment``.
"""

import atexit
import os
from pathlib import Path
import shutil
import socket
import tempfile
import time

from hypothesis import settings
import numpy as np
import pytest

os.environ.update(
    ROS_AUTOMATIC_DISCOVERY_RANGE='OFF',
    ROS_LOG_DIR=tempfile.mkdtemp(prefix='sa_jitter_ros_log_'),
    ROS_PYTHON_CHECK_FIELDS='1',
)
for _name in ('ROS_DISCOVERY_SERVER', 'ROS_LOCALHOST_ONLY', 'ROS_STATIC_PEERS'):
    os.environ.pop(_name, None)
atexit.register(shutil.rmtree, os.environ['ROS_LOG_DIR'], ignore_errors=True)

settings.register_profile('repeatable', deadline=None, derandomize=True)
settings.load_profile('repeatable')

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def rng():
    """Return the random generator of one test, the same in every run."""
    return np.random.default_rng(20240229)


@pytest.fixture(scope='session')
def shared_data():
    """Return the folder of the measured recordings, or skip the test where it is missing."""
    folder = Path(os.environ.get('SA_JITTER_DATA', ROOT.parent / 'shared' / 'data'))
    if not folder.is_dir():
        pytest.skip(f'no measured recordings in {folder}: set SA_JITTER_DATA to their folder')
    return folder


@pytest.fixture
def ros_context():
    """Yield an initialised ROS context of this test's own and shut it down afterwards."""
    context = pytest.importorskip('rclpy.context').Context()
    context.init(args=[])
    yield context
    context.try_shutdown()


@pytest.fixture
def executor_for(ros_context):
    """
    Return a function that puts nodes into one single-threaded executor.

    ``spin = executor_for(node, other)`` returns ``spin(until, timeout=60.0)``, which serves
    callbacks until ``until()`` is true and returns whether it was so before ``timeout`` seconds:
    ``assert spin(lambda: len(received) == 3)``. ``spin.settle(seen)`` serves them until what
    ``seen()`` returns stays the same: all that was sent in this process has then arrived, however
    busy the machine is. The nodes are destroyed after the test.
    """
    executors = pytest.importorskip('rclpy.executors')
    made = []

    def executor_of(*nodes):
        executor = executors.SingleThreadedExecutor(context=ros_context)
        made.append(executor)
        for node in nodes:
            executor.add_node(node)

        def spin(until=lambda: False, timeout=60.0):
            deadline = time.monotonic() + timeout
            while not until():
                if time.monotonic() > deadline:
                    return False
                executor.spin_once(timeout_sec=0.02)
            return True

        def settle(seen, rounds=40):
            same, last = 0, seen()
            while same < rounds:  # a round serves one of the callbacks that are ready
                executor.spin_once(timeout_sec=0.001)
                same, last = (same + 1 if seen() == last else 0), seen()

        spin.settle = settle
        return spin

    yield executor_of
    for executor in made:
        nodes = executor.get_nodes()
        executor.shutdown()
        for node in nodes:
            node.destroy_node()


@pytest.fixture
def process_environment():
    """Return the environment of processes that meet each other, and nobody else, over DDS."""
    environment = dict(os.environ, ROS_AUTOMATIC_DISCOVERY_RANGE='LOCALHOST')
    environment['ROS_DOMAIN_ID'] = str(_free_domain())
    return environment


def _free_domain():
    """Return a domain whose first participant's discovery port is not bound on this host."""
    for domain in np.random.default_rng().permutation(np.arange(1, 101)):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(('', 7410 + 250 * int(domain)))
            except OSError:
                continue
        return domain
    raise RuntimeError('all ROS domains from 1 to 100 are in use on this host')
