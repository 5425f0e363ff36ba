# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""What every node shares: parameters, diagnostics at 1 Hz, throttled warnings, QoS, main."""

from collections.abc import Callable, Sequence
from copy import copy
from inspect import getdoc
import re
import socket
import sys
import time
import traceback
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import (DurabilityPolicy, qos_check_compatible, qos_policy_name_from_kind,
                       QoSCompatibility, QoSPolicyKind, QoSProfile)
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from rclpy.topic_endpoint_info import TopicEndpointInfo
from rclpy.utilities import remove_ros_args
from sa_jitter_ros.errors import MessageError, ParameterError, SaJitterError
from sa_jitter_ros.nodes.health import first_of, Flow, Health, Level
from sa_jitter_ros.nodes.lifetime import end_within, InterruptOnce, SECONDS
from sa_jitter_ros.nodes.linear_algebra import use_one_thread
from sa_jitter_ros.nodes.parameters import given_parameters, parameter_files, ParameterSet
from sa_jitter_ros.parameter_file import require_regular_file
from sa_jitter_ros.parameters import HARDWARE_ID, Parameter, STALE_AFTER

DIAGNOSTIC_KEYS = ('samples_dropped', 'pulses_dropped', 'cycles_dropped', 'gaps', 'restarts',
                   'clock_deviation', 'messages_rejected')
WARNING_PERIOD = 5.0  # s between log lines of the same kind
WARNING_KINDS = 10
_USAGE = ('usage: {} --ros-args [-p NAME:=VALUE] [--params-file FILE] [-r OLD:=NEW]\n\n{}\n\n'
          'Parameters: docs/parameters.md, or ros2 param describe while it runs')
_UNKNOWN = ' are no arguments of ROS: give -p NAME:=VALUE, --params-file FILE or -r OLD:=NEW'


def _incompatibility(subscription: Subscription, policy: str) -> str:
    name = subscription.topic_name
    return (f'a publisher of {name} offers an incompatible {policy}: match it with the parameter '
            f'qos_overrides.{name}.subscription.{policy}')


_OVERRIDABLE = QoSOverridingOptions(policy_kinds=(
    QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY,
    QoSPolicyKind.DURABILITY))
# A subscriber logs by itself that its quality of service is incompatible. An executor would ask
# every publisher for such events each time that it waits.
_NO_EVENTS = PublisherEventCallbacks(use_default_callbacks=False)
# Reliable, keep last. Given to rclpy as copies: it writes the user's overrides into the profile.
INPUT_QOS, RESULT_QOS = QoSProfile(depth=200), QoSProfile(depth=10)
LATCHED_QOS = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class MonitoringNode(Node):
    """
    A node of this package: described parameters, diagnostics, and no message that can stop it.

    `counts` are cumulative. A subclass updates them in `update_counts`, which is called before
    they are published, and describes its state in `summary`. The status is WARN after a count
    increased or a warning was given, while an input is silent or has too many publishers, and
    while something that the user asked for is missing (`set_missing`). It is ERROR while a
    publisher of an input has an incompatible quality of service, while an input is silent for
    long, and while `faults` holds a text.
    """

    takes_data = True  # whether silence of inputs is judged, by the parameter `stale_after`

    def __init__(self, name: str, parameters: Sequence[Parameter], **node_kwargs: Any) -> None:
        super().__init__(name, **node_kwargs)
        self.parameters = ParameterSet(self, [
            *parameters, HARDWARE_ID, *([STALE_AFTER] if self.takes_data else [])])
        self.counts: dict[str, int] = dict.fromkeys(DIAGNOSTIC_KEYS, 0)
        self.faults: dict[str, str] = {}
        self.health = Health()
        #: Largest number of publishers by topic whose messages do not mix; 0 for any number.
        self.most_publishers: dict[str, int] = {}
        #: Why the latest message of a topic was not taken, '' where it was.
        self.refused: dict[str, str] = {}
        self._inputs: dict[str, Subscription] = {}
        self._missing: dict[str, str] = {}
        self._incompatible: dict[Subscription, str] = {}  # and the incompatible policy
        self._reported = dict(self.counts)
        self._last_warning = ''
        self._logged: dict[str, float] = {}  # kinds of warnings, and when they were logged
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10,
                                                  event_callbacks=_NO_EVENTS)
        self.create_steady_timer(1.0, self.publish_diagnostics)

    # --- building blocks ---

    def create_steady_timer(self, period: float, callback: Callable[[], None]) -> Timer:
        """Timer on the steady clock: `use_sim_time` does not stop it."""
        return self.create_timer(period, callback, clock=self._steady)

    def create_input(self, kind: type, topic: str, callback: Callable[[Any], None],
                     qos: QoSProfile = INPUT_QOS, *, most_publishers: int = 1) -> Subscription:
        """
        Subscribe to a topic; an error in the callback becomes a warning.

        A `MessageError`, or an exception that is no `SaJitterError`, counts as a rejected message.
        A callback that raises another `SaJitterError` has counted itself what it dropped.
        """
        def guarded(message: Any) -> None:
            self.refused[subscription.topic_name] = ''
            try:
                callback(message)
                return
            except SaJitterError as error:
                self.counts['messages_rejected'] += isinstance(error, MessageError)
                reason = str(error)
            except Exception as error:
                if not self.context.ok():
                    raise
                self.counts['messages_rejected'] += 1
                self.get_logger().error(traceback.format_exc(),
                                        throttle_duration_sec=WARNING_PERIOD)
                reason = f'{type(error).__name__}: {error}'
            self.refused[subscription.topic_name] = reason
            self.warn(f'{topic}: {reason}')

        def incompatible(info: Any) -> None:
            policy = qos_policy_name_from_kind(info.last_policy_kind).lower()
            self._incompatible[subscription] = policy
            self.get_logger().error(_incompatibility(subscription, policy),
                                    throttle_duration_sec=WARNING_PERIOD)

        subscription = self.create_subscription(
            kind, topic, guarded, copy(qos),
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=incompatible),
            qos_overriding_options=_OVERRIDABLE)
        self._inputs[subscription.topic_name] = subscription
        self.most_publishers[subscription.topic_name] = most_publishers
        return subscription

    def watch_input(self, name: str, topic: str, look_at: str, **options: Any) -> Flow:
        """Watch what comes on a topic: its callback calls `came` for data that can be used."""
        return self.health.add(Flow(name, self.resolve_topic_name(topic), look_at, **options))

    def create_output(self, kind: type, topic: str, qos: QoSProfile = RESULT_QOS) -> Publisher:
        """Return the publisher of a result."""
        return self.create_publisher(kind, topic, copy(qos), event_callbacks=_NO_EVENTS,
                                     qos_overriding_options=_OVERRIDABLE)

    # --- warnings and diagnostics ---

    @property
    def hardware_id(self) -> str:
        """Return the name of the machine, or of this computer."""
        return str(self.get_parameter(HARDWARE_ID.name).value or socket.gethostname())

    def warn(self, text: str) -> None:
        """
        Log a warning, and show it in the next diagnostics.

        In each `WARNING_PERIOD` the log has one line of a kind, and lines of `WARNING_KINDS`.
        Warnings that differ in their numbers only are of one kind.
        """
        self.show_warning(text)
        if self._is_new(text):
            self.get_logger().warning(text)

    def _is_new(self, text: str) -> bool:
        """Return whether the log has room for a text and no other of its kind lately."""
        kind, now = re.sub(r'[-+]?\d[\d.]*(e[-+]?\d+)?', '#', text), time.monotonic()
        self._logged = {key: at for key, at in self._logged.items() if now - at < WARNING_PERIOD}
        if kind in self._logged or len(self._logged) >= WARNING_KINDS:
            return False
        self._logged[kind] = now
        return True

    def show_warning(self, text: str) -> None:
        """Show a warning in the next diagnostics, but not in the log."""
        self._last_warning = text

    def set_missing(self, what: str, reason: str) -> None:
        """
        Say why the user does not get something, in log and status, until the reason is ''.

        The log has one line when it begins and one when it ends, unless it comes and goes.
        """
        before = self._missing.pop(what, '')
        if reason:
            self._missing[what] = reason
        line = f'{what}: {reason or "well again"}'
        if bool(reason) != bool(before) and self._is_new(line):
            self._log(Level.WARN if reason else Level.OK, line)

    def set_fault(self, what: str, reason: str) -> None:
        """Make the status an error that says the reason, until this is ''."""
        self.faults.pop(what, '')
        if reason:
            self.faults[what] = reason

    def _log(self, level: Level, line: str) -> None:
        if level == Level.ERROR:  # rclpy wants one line of code for each severity
            self.get_logger().error(line)
        elif level == Level.WARN:
            self.get_logger().warning(line)
        else:
            self.get_logger().info(line)

    def _find_crowds(self) -> None:
        """Find topics on which several publishers mix their messages."""
        for topic, most in self.most_publishers.items():
            crowd = ''
            if 0 < most < self.count_publishers(topic):
                offered = self.get_publishers_info_by_topic(topic)
                names = sorted(_node_name(item) for item in offered)
                crowd = (f'{len(offered)} publishers ({", ".join(names)}) mix their messages: '
                         f'stop all but {most}, or remap them')
                if len(set(names)) < len(names):
                    crowd += '; one that was killed disappears after 20 s'
            self.set_missing(f'single source of {topic}', crowd)

    def _cause(self, flow: Flow) -> str:
        """Return what the ROS graph shows of a silent flow."""
        subscription = self._inputs.get(flow.what)
        if subscription is None:
            return flow.look_at
        offered = self.get_publishers_info_by_topic(flow.what)
        kind = _type_name(subscription.msg_type)
        if not offered:
            return ('nobody publishes it: start its source, and compare topics and namespaces '
                    '(ros2 topic list)')
        others = sorted({item.topic_type for item in offered} - {kind})
        if others:
            return (f'it is published as {", ".join(others)}, this node takes {kind}: set the '
                    'parameter of its type')
        if reason := self.refused.get(flow.what):
            return f'what comes is refused: {reason}'
        names = ', '.join(sorted({_node_name(item) for item in offered}))
        return f'{names} publishes nothing: {flow.look_at}'

    def _incompatibilities(self) -> list[str]:
        """Return a line for each input with an incompatible publisher."""
        for subscription in list(self._incompatible):
            offered = self.get_publishers_info_by_topic(subscription.topic_name)
            if all(qos_check_compatible(item.qos_profile, subscription.qos_profile)[0]
                   != QoSCompatibility.ERROR for item in offered):
                del self._incompatible[subscription]
        return [_incompatibility(*item) for item in self._incompatible.items()]

    def update_counts(self) -> None:
        """Bring `counts` up to date before they are published."""

    def keep_state(self) -> None:
        """Write what has to outlast the node; it may go on afterwards."""

    def summary(self) -> tuple[str, dict[str, object]]:
        """Return the node's state in one line, and values to publish beside the counts."""
        return 'running', {}

    def publish_diagnostics(self) -> None:
        """Publish the node's status."""
        self.update_counts()
        text, values = self.summary()
        self._find_crowds()
        grown = [key for key, count in self.counts.items() if count > self._reported.get(key, 0)]
        faults = [*self.faults.values(), *self._incompatibilities()]
        for flow in self.health.flows.values():
            if flow.once and self.count_publishers(flow.what):
                flow.lasts()
        silent = self.health.silent(self.get_parameter(STALE_AFTER.name).value
                                    if self.takes_data else 0.0)
        for _, flow in silent:
            flow.cause = self._cause(flow)
        missing = [f'{what}: {reason}' for what, reason in self._missing.items()]
        problems = [*faults, *(flow.problem() for _, flow in silent), *missing]
        if not silent and self._last_warning:  # else it is a consequence
            problems.append(self._last_warning)
        level = max([Level.ERROR if faults else Level.OK, *(level for level, _ in silent),
                     Level.WARN if problems or grown else Level.OK])
        for change, line in self.health.changes(silent):
            self._log(change, line)
        status = DiagnosticStatus(
            level=bytes([level]), name=self.get_fully_qualified_name().lstrip('/'),
            message=first_of(problems) or (f'{", ".join(grown)} increased' if grown else text),
            hardware_id=self.hardware_id)
        self._reported, self._last_warning = dict(self.counts), ''
        shown = {**self.counts, **self.health.ages(), **values}
        if (everything := '; '.join(problems)) != first_of(problems):
            shown['problems'] = everything
        status.values = [KeyValue(key=key, value=str(value)) for key, value in shown.items()]
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)


def _node_name(info: TopicEndpointInfo) -> str:
    """Return the full name of the node of a publisher."""
    return f'{info.node_namespace.rstrip("/")}/{info.node_name}'


def _type_name(kind: type) -> str:
    """Return the name of a message type, as the graph has it."""
    package, folder = kind.__module__.split('.')[:2]
    return f'{package}/{folder}/{kind.__name__}'


def run_node(node_class: Callable[..., MonitoringNode], args: Sequence[str] | None = None) -> int:
    """Run one node until a signal ends it; return 0, or 2 after one line on a bad argument."""
    return run_nodes([node_class], args)


def run_nodes(node_classes: Sequence[Callable[..., MonitoringNode]],
              args: Sequence[str] | None = None, process: Sequence[str] = ()) -> int:
    """
    Run nodes in one executor until SIGINT, SIGTERM or SIGHUP; return the status of `run_node`.

    The process is that of the nodes: it ends if the middleware hangs after such a signal.
    `process` are names under which a file may have parameters of all these nodes.
    """
    use_one_thread()
    interrupt = InterruptOnce()
    nodes: list[MonitoringNode] = []
    given = sys.argv if args is None else args
    try:
        _check_parameter_files(given)
        others = [item for item in remove_ros_args(given) if item != sys.argv[0]]
        if {'-h', '--help'} & {*others}:
            print(_USAGE.format(_name_of(node_classes[0]), getdoc(node_classes[0])))
            return 0
        if others:
            raise ParameterError(_no_arguments(others))
        rclpy.init(args=given)
    except (ParameterError, RuntimeError) as error:  # rcl cannot read the command line or a file
        print(f'error: {error}' + _UNKNOWN * str(error).startswith('['), file=sys.stderr)
        return 2
    try:
        try:
            for node_class in node_classes:
                nodes.append(node_class(parameter_overrides=given_parameters(
                    _name_of(node_class), given, process)))
        except (InvalidParameterTypeException, RuntimeError) as error:  # of rclpy's own parameters
            if rclpy.ok():
                print(f'error: {error}', file=sys.stderr)
                return 2
            raise
        executor = SingleThreadedExecutor()
        for node in nodes:
            executor.add_node(node)
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except (SaJitterError, InvalidParameterValueException) as error:
        print(f'error: {error}', file=sys.stderr)
        return 2
    except Exception:
        if rclpy.ok():  # else the shutdown interrupted a callback
            raise
    finally:
        interrupt.ending = True
        _end(nodes)
    return 0


def _name_of(node_class: Callable[..., MonitoringNode]) -> str:
    """Return the name of a node, which is that of its executable."""
    return re.sub('(?<=.)(?=[A-Z])', '_', node_class.__name__).lower()


def _no_arguments(others: Sequence[str]) -> str:
    """
    Return what is wrong with arguments that are not for ROS, and what may be meant.

    >>> _no_arguments(['--params', 'rig.yaml'])
    '--params rig.yaml: is not for a node: did you mean --ros-args --params-file rig.yaml?'
    >>> _no_arguments(['trigger_cycles:=12'])
    'trigger_cycles:=12: is not for a node: did you mean --ros-args -p trigger_cycles:=12?'
    """
    last = others[-1]
    meant = f'-p {last}' if ':=' in last else (
        f'--params-file {last}' if last.endswith(('.yaml', '.yml')) else '')
    return f'{" ".join(others)}: is not for a node: ' + (
        f'did you mean --ros-args {meant}?' if meant else 'see --help')


def _end(nodes: Sequence[MonitoringNode]) -> None:
    """Keep the state of nodes, then destroy them."""
    for node in nodes:
        node.keep_state()
    with end_within(SECONDS) as text:
        for node in nodes:
            text.value = (f'{node.get_fully_qualified_name()}: the middleware hangs while it '
                          'destroys the node: ended without it, nothing is lost').encode()[:199]
            node.destroy_node()
        text.value = b'the middleware hangs while it shuts down: ended without it, nothing is lost'
        rclpy.try_shutdown()


def _check_parameter_files(args: Sequence[str]) -> None:
    """Raise ParameterError for a file that rcl would read for ever."""
    for name in parameter_files(args):
        try:
            require_regular_file(name)
        except ParameterError as error:
            raise ParameterError(f'{name}: {error}') from None
        except OSError:
            pass  # rcl says what is wrong
