"""
The graph under test: every node a process of its own over DDS, as its console script starts it.

`direct` averages two shafts from the source's pulses; `detector`, `averager`, `predictor` and
`analyser` make the chain from the tach waveform to the residual.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
import os
from pathlib import Path
import signal
import subprocess
import sys
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from graph_speed import free_domain
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import QoSProfile
from rclpy.task import Future
from sa_jitter_ros.errors import MessageError
from sa_jitter_ros.nodes.base import INPUT_QOS, LATCHED_QOS
from sa_jitter_ros.nodes.messages import AverageMessage, decode_average
from sensor_msgs.msg import TimeReference
from std_msgs.msg import Float64, Float64MultiArray, String

ORDERS = [1.0, 5.0, 12.0]
CYCLES = 6
AVERAGER: dict[str, Any] = {
    'pulses_per_revolution': 2, 'pulses_per_trigger': 0, 'trigger_cycles': CYCLES,
    'averaging': 'block', 'missing_pulses': 'break', 'keyphasor': 'keyphasor'}
DIRECT = {**AVERAGER, 'shafts': ['tach', 'gear'], 'gear.ratio': 2.40789, 'tach.ratio': 1.0,
          'tach.orders': ORDERS, 'gear.orders': ORDERS}
DETECTED = {**AVERAGER, 'shaft.orders': ORDERS, 'shaft.ratio': 1.0, 'correct_jitter': True}
MODEL = {'pulses_per_revolution': 2, 'trigger_cycles': CYCLES, 'orders': ORDERS,
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
    'analyser': Role('residual_analyser', 'residual_analyser', {'acquisitions': 20}),
}
#: Topics of the averages that are checked, by role and shaft.
SHAFTS = {('direct', 'tach'): 'direct/tach', ('direct', 'gear'): 'direct/gear',
          ('averager', 'shaft'): 'shaft'}


def shown(value: Any) -> str:
    """Return a parameter's value as the command line takes it."""
    return str(value).lower() if isinstance(value, bool) else str(value)


@dataclass
class Life:
    """A process of a role and what was heard of it."""

    process: subprocess.Popen[bytes]
    started: float
    status: dict[str, str] = field(default_factory=dict)
    heard: float = 0.0
    rss: list[tuple[float, float]] = field(default_factory=list)


class Inbox:
    """Averages of one shaft as they come: amplitudes and waveforms, paired in their order."""

    def __init__(self, node: Any, topic: str) -> None:
        self.malformed = 0
        self._waves: list[AverageMessage] = []
        self._amplitudes: list[AverageMessage] = []
        deep = QoSProfile(depth=1000, reliability=INPUT_QOS.reliability)
        node.create_subscription(Float64MultiArray, f'{topic}/synchronous_average',
                                 self._on_waveform, deep)
        node.create_subscription(Float64MultiArray, f'{topic}/order_amplitude',
                                 self._on_amplitude, deep)

    def _on_waveform(self, message: Float64MultiArray) -> None:
        self._waves.append(decode_average('synchronous_average', message))

    def _on_amplitude(self, message: Float64MultiArray) -> None:
        try:
            self._amplitudes.append(decode_average('order_amplitude', message))
        except MessageError:
            self.malformed += 1

    def take(self) -> list[tuple[AverageMessage, AverageMessage]]:
        """Return the pairs that are complete."""
        count = min(len(self._waves), len(self._amplitudes))
        pairs = list(zip(self._amplitudes[:count], self._waves[:count]))
        del self._amplitudes[:count], self._waves[:count]
        return pairs

    def forget(self) -> None:
        """Drop what a killed node published only half of."""
        self._waves.clear()
        self._amplitudes.clear()


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
        self.heard = dict.fromkeys(('prediction', 'residual', 'missing_effect'), 0)
        for topic, kind in (('prediction', Float64MultiArray), ('residual', Float64MultiArray),
                            ('missing_effect', String)):
            self.node.create_subscription(kind, topic, self._counting(topic), LATCHED_QOS
                                          if topic != 'residual' else INPUT_QOS)
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 100)
        self._clients = {role: AsyncParameterClient(self.node, f'/{item.name}')
                         for role, item in ROLES.items()}

    def _counting(self, topic: str) -> Callable[[Any], None]:
        def count(message: Any) -> None:
            self.heard[topic] += 1
        return count

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            for role, life in self.lives.items():
                if status.name == ROLES[role].name:
                    life.status = {item.key: item.value for item in status.values}
                    life.heard = time.monotonic()

    # --- processes ---

    def start(self, roles: Sequence[str]) -> None:
        """Start nodes and wait until they are heard and hear."""
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
        if not self.spin(lambda: all(self.lives[role].heard for role in roles), 60.0):
            raise RuntimeError(f'{roles} were not heard within 60 s')
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
            status = Path(f'/proc/{life.process.pid}/status').read_text()
            line = next(line for line in status.splitlines() if line.startswith('VmRSS'))
            life.rss.append((time.monotonic() - self.begin, int(line.split()[1]) / 1e3))

    def close(self) -> dict[str, int]:
        """End all nodes by SIGINT; return their exit statuses."""
        for life in self.lives.values():
            if life.process.poll() is None:
                life.process.send_signal(signal.SIGINT)
        statuses = {role: life.process.wait(timeout=60.0) for role, life in self.lives.items()}
        self._executor.shutdown()
        self.node.destroy_node()
        self._context.try_shutdown()
        return statuses

    # --- talking to them ---

    def spin(self, until: Callable[[], bool], limit: float) -> bool:
        """Serve callbacks until something is true, at most `limit` s; return whether it is."""
        end = time.monotonic() + limit
        while not until():
            left = end - time.monotonic()
            if left <= 0.0:
                return False
            self._executor.spin_once(timeout_sec=min(left, 0.05))
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
        while life.status != last:
            last, heard = life.status, life.heard
            if not self.spin(lambda heard=heard: life.heard > heard, 20.0):
                self.died.append(f'{role} is silent')
                break
        return life.status
