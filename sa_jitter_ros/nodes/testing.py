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
Pytest fixtures for tests of nodes: a graph in one process, and the environment of several.

Name this module in the `conftest.py` at the top of your tests:

    pytest_plugins = ['sa_jitter_ros.nodes.testing']

A test requests the fixture `ros_graph`, adds nodes to it, captures topics, publishes messages, and
serves callbacks until a condition is true:

    def test_listener(ros_graph):
        ros_graph.add(SynchronousAverager, {'trigger_cycles': 10, 'shaft.orders': [1.0]})
        amplitudes = ros_graph.capture('shaft/order_amplitude', Float64MultiArray)
        ros_graph.publish('vibration', encode_samples(block))
        ros_graph.settle()
        assert len(amplitudes) == 2

The import of this module disables discovery, so that tests do not find other ROS graphs, and
enables the checks of message fields. Both must be set before a message package is imported: name
the module in `conftest.py`, not in a test. For the same reason rclpy is imported where it is used.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
import fcntl
import os
from pathlib import Path
import random
import socket
import tempfile
import time
from typing import Any, TextIO

import pytest

os.environ.update(ROS_AUTOMATIC_DISCOVERY_RANGE='OFF', ROS_PYTHON_CHECK_FIELDS='1')
for _name in ('ROS_DISCOVERY_SERVER', 'ROS_LOCALHOST_ONLY', 'ROS_STATIC_PEERS'):
    os.environ.pop(_name, None)

_DEPTH = 5000  # messages in the queue of a captured topic: none is lost in a test
_AHEAD = 50  # messages that `publish` sends before it serves callbacks; inputs queue 200
_IDLE_ROUNDS = 12  # rounds of one callback without a new message, after which all is settled
_DOMAINS = range(1, 101)  # ROS domains whose ports are outside the range of clients' ports


class Graph:
    """
    Nodes, publishers and captured topics in one context and one single-threaded executor.

    `context` is the context of all nodes; `node` publishes and captures.
    """

    def __init__(self) -> None:
        from rclpy.context import Context
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.node import Node
        self.context = Context()
        self.context.init(args=[])
        self.node = Node('test', context=self.context)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self._publishers: dict[str, Any] = {}
        self._captured: list[list[Any]] = []
        self._listeners = Counter[str]()  # by resolved topic, as the others
        self._handled = Counter[str]()
        self._expected = Counter[str]()  # messages published by `publish`

    def add(self, node_class: Callable[..., Any], parameters: Mapping[str, Any] | None = None,
            **node_kwargs: Any) -> Any:
        """Create a node in this graph with parameters by name; return it."""
        from rclpy.parameter import Parameter
        if parameters:
            node_kwargs['parameter_overrides'] = [
                *node_kwargs.get('parameter_overrides', ()),
                *(Parameter(name, value=value) for name, value in parameters.items())]
        node = node_class(context=self.context, **node_kwargs)
        for subscription in node.subscriptions:
            self._listeners[subscription.topic_name] += 1
            subscription.callback = self._counting(subscription)
        self._executor.add_node(node)
        return node

    def _counting(self, subscription: Any) -> Callable[[Any], None]:
        callback, topic = subscription.callback, subscription.topic_name

        def counted(message: Any) -> None:
            self._handled[topic] += 1
            callback(message)
        return counted

    def capture(self, topic: str, kind: type, *, qos: Any = None, latched: bool = False
                ) -> list[Any]:
        """Return a list to which each further message of a topic is added."""
        from rclpy.qos import DurabilityPolicy, QoSProfile
        if qos is None:
            qos = QoSProfile(depth=_DEPTH)
            if latched:
                qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
        messages: list[Any] = []
        self._captured.append(messages)
        self.node.create_subscription(kind, topic, messages.append, qos)
        return messages

    def publisher(self, topic: str, kind: type, *, qos: Any = None) -> Any:
        """Return the publisher of a topic; its default quality of service is that of inputs."""
        from sa_jitter_ros.nodes.base import INPUT_QOS
        if topic not in self._publishers:
            self._publishers[topic] = self.node.create_publisher(kind, topic, qos or INPUT_QOS)
        return self._publishers[topic]

    def publish(self, topic: str, *messages: Any) -> None:
        """
        Publish messages after waiting for a subscriber.

        Callbacks are served in between, so that many messages do not overflow a queue.
        """
        for message in messages:
            publisher = self.publisher(topic, type(message))
            assert self.spin(publisher.get_subscription_count), f'nobody subscribes to {topic}'
            publisher.publish(message)
            self._expected[publisher.topic_name] += self._listeners[publisher.topic_name]
            if (self._expected - self._handled).total() > _AHEAD:
                assert self.spin(self._all_handled)

    def spin(self, until: Callable[[], object], timeout: float = 60.0) -> bool:
        """
        Serve callbacks until `until()` is true; return False after `timeout` seconds.

        The timeout only ends a test that hangs: no test may depend on the speed of the computer.
        """
        deadline = time.monotonic() + timeout
        while not until():
            if time.monotonic() > deadline:
                return False
            self._executor.spin_once(timeout_sec=0.02)
        return True

    def settle(self) -> None:
        """Serve callbacks until all published messages and their results have arrived."""
        assert self.spin(self._all_handled)
        idle, before = 0, self._arrived()
        while idle < _IDLE_ROUNDS:
            self._executor.spin_once(timeout_sec=0.004)
            idle, before = (idle + 1 if before == self._arrived() else 0), self._arrived()

    def _all_handled(self) -> bool:
        return self._handled >= self._expected

    def _arrived(self) -> tuple[int, ...]:
        return self._handled.total(), *map(len, self._captured)

    def shutdown(self) -> None:
        """Destroy the nodes and the context."""
        nodes = self._executor.get_nodes()
        self._executor.shutdown()
        for node in nodes:
            node.destroy_node()
        self.context.try_shutdown()


@pytest.fixture
def ros_graph() -> Iterator[Graph]:
    """Yield an empty ROS graph for one test; skip the test if ROS is not installed."""
    pytest.importorskip('rclpy')
    graph = Graph()
    yield graph
    graph.shutdown()


@pytest.fixture
def process_environment() -> Iterator[dict[str, str]]:
    """Yield an environment in which processes find only each other over DDS."""
    domain, lock = _reserve_domain()
    with lock:
        yield {**os.environ, 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
               'ROS_DOMAIN_ID': str(domain)}


def _reserve_domain() -> tuple[int, TextIO]:
    """Return an unused ROS domain, and the open file that reserves it."""
    for domain in random.sample(_DOMAINS, len(_DOMAINS)):
        with suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            lock = Path(tempfile.gettempdir(), f'sa_jitter_ros_domain_{domain}').open('w')
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                probe.bind(('', 7410 + 250 * domain))  # of its first participant
            except OSError:
                lock.close()
                continue
            return domain, lock
    raise RuntimeError('all ROS domains from 1 to 100 are in use on this host')
