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
The graph under test: every node a process of its own over DDS, as its console script starts it.

`direct` averages two shafts from the source's pulses; `detector`, `averager`, `predictor` and
`analyser` make the chain from the tach waveform to the residual.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
import os
import signal
import subprocess
import sys
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from fault_machine import MESH
from graph_speed import free_domain, resident
import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import QoSProfile
from rclpy.task import Future
from sa_jitter_ros.errors import MessageError
from sa_jitter_ros.nodes.base import INPUT_QOS, LATCHED_QOS
from sa_jitter_ros.nodes.messages import (AverageMessage, decode_average, decode_prediction,
                                          decode_residual, PredictionMessage, ResidualMessage)
from sensor_msgs.msg import TimeReference
from std_msgs.msg import Float64, Float64MultiArray, String

ORDERS = [1.0, 5.0, 12.0]
CYCLES = 6
AVERAGER: dict[str, Any] = {
    'pulses_per_revolution': 2, 'pulses_per_trigger': 0, 'trigger_cycles': CYCLES,
    'averaging': 'block', 'missing_pulses': 'break', 'keyphasor': 'keyphasor'}
DIRECT = {**AVERAGER, 'shafts': ['tach', 'gear'], 'gear.ratio': 2.40789, 'tach.ratio': 1.0,
          'tach.orders': ORDERS, 'gear.orders': ORDERS}
DECLARED_ORDERS = [1.0, 5.0, MESH]
DETECTED = {**AVERAGER, 'shaft.orders': DECLARED_ORDERS, 'shaft.ratio': 1.0,
            'correct_jitter': True}
MODEL = {'pulses_per_revolution': 2, 'trigger_cycles': CYCLES, 'orders': DECLARED_ORDERS,
         'follow_shaft_speed': True, 'keyphasor_rate': 6400.0}
DETECTOR = {'automatic_threshold': False, 'threshold': 0.5, 'learning_time': 0.3}


@dataclass(frozen=True)
class Role:
    """A node of the graph: its executable, full name, parameters and remappings."""

    executable: str
    name: str
    parameters: dict[str, Any]
    remaps: tuple[str, ...] = ()


ROLES = {
    'direct': Role('synchronous_averager', 'direct/synchronous_averager', DIRECT, (
        '__ns:=/direct', 'vibration:=/vibration', 'tach_pulse:=/tach_pulse')),
    'detector': Role('tach_detector', 'tach_detector', DETECTOR, ('tach_pulse:=detected_pulse',)),
    'averager': Role('synchronous_averager', 'synchronous_averager', DETECTED, (
        'tach_pulse:=detected_pulse',)),
    'predictor': Role('jitter_predictor', 'jitter_predictor', MODEL),
    'analyser': Role('residual_analyser', 'residual_analyser', {'acquisitions': 4}),
}
#: Topics of the averages that are checked, by role and shaft.
SHAFTS = {('direct', 'tach'): 'direct/tach', ('direct', 'gear'): 'direct/gear',
          ('averager', 'shaft'): 'shaft'}
#: Topics of an average that are checked; the last two come with a corrected average only.
KINDS = ('order_amplitude', 'synchronous_average', 'corrected_average', 'pulse_error')


def _without_ages(status: dict[str, str]) -> dict[str, str]:
    """Return a status without the ages of data, which grow while nothing comes."""
    return {key: value for key, value in status.items() if not key.endswith('_age')}


def shown(value: Any) -> str:
    """Return a parameter's value as the command line takes it."""
    return str(value).lower() if isinstance(value, bool) else str(value)


@dataclass
class Life:
    """A process of a role, its last status and its memory over time."""

    process: subprocess.Popen[bytes]
    started: float
    status: dict[str, str] = field(default_factory=dict)
    status_time: float = 0.0
    rss: list[tuple[float, float]] = field(default_factory=list)


@dataclass(frozen=True)
class Received:
    """An average as its topics carry it."""

    amplitude: AverageMessage
    waveform: AverageMessage
    corrected: AverageMessage | None
    pulse_error: AverageMessage | None


class Inbox:
    """Averages of one shaft as they arrive, put together from the messages of their topics."""

    def __init__(self, node: Any, topic: str) -> None:
        self._waiting: dict[str, list[AverageMessage]] = {kind: [] for kind in KINDS}
        deep = QoSProfile(depth=1000, reliability=INPUT_QOS.reliability)
        for kind in KINDS:
            node.create_subscription(Float64MultiArray, f'{topic}/{kind}', self._taking(kind),
                                     deep)

    def _taking(self, kind: str) -> Callable[[Float64MultiArray], None]:
        def take(message: Float64MultiArray) -> None:
            with suppress(MessageError):  # nonsense that was sent to the analyser
                self._waiting[kind].append(decode_average(kind, message))
        return take

    def take(self) -> list[Received]:
        """Return the averages that are complete."""
        found, waiting = [], self._waiting
        while all(waiting[kind] for kind in KINDS[:2]):
            corrected = bool(np.isfinite(waiting['order_amplitude'][0].values[..., 3:7]).any())
            kinds = KINDS if corrected else KINDS[:2]
            if not all(waiting[kind] for kind in kinds):
                break
            found.append(Received(*(waiting[kind].pop(0) if kind in kinds else None
                                    for kind in KINDS)))
        return found

    def forget(self) -> None:
        """Drop the messages of averages that a killed node did not complete."""
        for messages in self._waiting.values():
            messages.clear()

    @property
    def incomplete(self) -> int:
        """Return the number of messages that belong to no complete average."""
        return sum(map(len, self._waiting.values()))


class Graph:
    """Starts, feeds, disturbs and watches the nodes."""

    def __init__(self) -> None:
        os.environ.update(ROS_AUTOMATIC_DISCOVERY_RANGE='LOCALHOST',
                          ROS_DOMAIN_ID=str(free_domain()))
        self.begin = time.monotonic()
        self.lives: dict[str, Life] = {}
        self.past: list[tuple[str, Life]] = []
        self.died: list[str] = []
        self._context = rclpy.Context()
        self._context.init(args=[])
        self.node = rclpy.create_node('fault_campaign', context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self.publishers = {
            topic: self.node.create_publisher(kind, topic, qos) for topic, kind, qos in (
                ('vibration', Float64MultiArray, INPUT_QOS),
                ('tach_waveform', Float64MultiArray, INPUT_QOS),
                ('tach_pulse', TimeReference, INPUT_QOS), ('shaft_speed', Float64, INPUT_QOS),
                ('shaft/order_amplitude', Float64MultiArray, INPUT_QOS),
                ('shaft/pulse_error', Float64MultiArray, INPUT_QOS),
                ('prediction', Float64MultiArray, LATCHED_QOS))}
        self.inboxes = {key: Inbox(self.node, topic) for key, topic in SHAFTS.items()}
        self.predictions: list[PredictionMessage] = []
        self.residuals: list[ResidualMessage] = []
        self.reports: list[str] = []
        for topic, kind, take, qos in (
                ('prediction', Float64MultiArray, self._on_prediction, LATCHED_QOS),
                ('residual', Float64MultiArray, self._on_residual, INPUT_QOS),
                ('missing_effect', String, self._on_report, LATCHED_QOS)):
            self.node.create_subscription(kind, topic, take, QoSProfile(
                depth=100, reliability=qos.reliability, durability=qos.durability))
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 100)
        self._clients = {role: AsyncParameterClient(self.node, f'/{item.name}')
                         for role, item in ROLES.items()}

    def _on_prediction(self, message: Float64MultiArray) -> None:
        with suppress(MessageError):  # nonsense that was sent to the analyser
            self.predictions.append(decode_prediction(message))

    def _on_residual(self, message: Float64MultiArray) -> None:
        self.residuals.append(decode_residual(message))

    def _on_report(self, message: String) -> None:
        self.reports.append(message.data)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            for role, life in self.lives.items():
                if status.name == ROLES[role].name:
                    life.status = {item.key: item.value for item in status.values}
                    life.status_time = time.monotonic()

    # --- processes ---

    def start(self, roles: Sequence[str]) -> None:
        """Start nodes and wait until they publish their status and are subscribed."""
        before = {topic: item.get_subscription_count() for topic, item in self.publishers.items()}
        for role in roles:
            item = ROLES[role]
            arguments = ['--ros-args', '--log-level', 'fatal']
            for name, value in item.parameters.items():
                arguments += ['-p', f'{name}:={shown(value)}']
            for remap in item.remaps:
                arguments += ['-r', remap]
            code = (f'from sa_jitter_ros.nodes.{item.executable} import main; '
                    'raise SystemExit(main())')
            if role in self.lives:
                self.past.append((role, self.lives[role]))
            self.lives[role] = Life(
                subprocess.Popen([sys.executable, '-c', code, *arguments]), time.monotonic())
        if not self.spin(lambda: all(self.lives[role].status_time for role in roles), 60.0):
            raise RuntimeError(f'{roles} sent no status within 60 s')
        wanted = {'direct': ('vibration', 'tach_pulse'), 'averager': ('vibration',),
                  'detector': ('tach_waveform',), 'predictor': ('shaft_speed',),
                  'analyser': ('shaft/order_amplitude', 'shaft/pulse_error', 'prediction')}
        self.spin(lambda: all(
            self.publishers[topic].get_subscription_count() > before[topic]
            for role in roles for topic in wanted.get(role, ())), 10.0)
        self.spin(lambda: False, 0.5)  # detector and averager find each other as well

    def kill(self, role: str) -> None:
        """Kill a node as the kernel would, and take what it published before."""
        life = self.lives[role]
        life.process.kill()
        life.process.wait()
        self.spin(lambda: False, 0.3)

    def stall(self, role: str, seconds: float) -> None:
        """Stop a node's process for a while."""
        process = self.lives[role].process
        process.send_signal(signal.SIGSTOP)
        self.spin(lambda: False, seconds)
        process.send_signal(signal.SIGCONT)

    def watch(self) -> None:
        """Remember each node's memory (MB) at this time (s), and who has died."""
        for role, life in self.lives.items():
            if life.process.poll() is not None:
                self.died.append(f'{role} with status {life.process.returncode}')
                continue
            if (held := resident(life.process.pid)) is not None:  # else it ends in this moment
                life.rss.append((time.monotonic() - self.begin, held))

    def close(self) -> dict[str, int]:
        """End all nodes by SIGINT; return their exit statuses."""
        for life in self.lives.values():
            if life.process.poll() is None:
                life.process.send_signal(signal.SIGINT)
        try:
            statuses = {role: life.process.wait(timeout=60.0) for role, life in self.lives.items()}
        finally:  # a node that does not end fails the campaign, and must not keep a core busy
            for life in self.lives.values():
                life.process.kill()
        self._executor.shutdown()
        self.node.destroy_node()
        self._context.try_shutdown()
        return statuses

    # --- talking to them ---

    def spin(self, until: Callable[[], bool], limit: float) -> bool:
        """Serve callbacks until something is true, at most `limit` s; return whether it is."""
        end = time.monotonic() + limit
        while not until():
            remaining = end - time.monotonic()
            if remaining <= 0.0:
                return False
            self._executor.spin_once(timeout_sec=min(remaining, 0.05))
        return True

    def send(self, topic: str, message: Any) -> None:
        """Publish, and take what has come in the meantime."""
        self.publishers[topic].publish(message)
        self._executor.spin_once(timeout_sec=0.0)

    def set_parameter(self, role: str, name: str, value: Any) -> Future:
        """Ask a node to change a parameter."""
        client = self._clients[role]
        self.spin(client.services_are_ready, 10.0)
        return client.set_parameters([Parameter(name, value=value)])

    def quiet_status(self, role: str) -> dict[str, str]:
        """Return a node's status once it says the same twice: it has had all that was sent."""
        life, last = self.lives[role], {'': ''}
        while _without_ages(life.status) != last:
            last, status_time = _without_ages(life.status), life.status_time
            if not self.spin(lambda status_time=status_time: life.status_time > status_time, 20.0):
                self.died.append(f'{role} is silent')
                break
        return life.status
