# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""A bench around one node: publishers of its inputs, captured outputs, its status when asked."""

from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from sa_jitter_ros.nodes import messages
from sa_jitter_ros.nodes.base import INPUT_QOS
from sa_jitter_ros.nodes.synchronous_averager import SynchronousAverager
from std_msgs.msg import Float64, Float64MultiArray


class SteadyClock:
    """A clock that stands still until a test moves it: replaces `time` in a module."""

    def __init__(self):
        self.now = 1000.0

    def monotonic(self):
        """Return the time in s."""
        return self.now


class NodeBench:
    """
    One node and its neighbours in a graph.

    Parameters are given as keywords, `__` for the dot. `inputs` and `outputs` are {topic: type};
    `send(topic, message)` publishes, `settle()` serves callbacks until the node has had all that
    was sent and the bench all that came back, `received[topic]` are the messages. The node's
    timer of diagnostics is stopped: a status says what came since the one before, so that a test
    must decide when it is published. `diagnostics()` publishes it and returns it.
    """

    def __init__(self, graph, node_class, *, inputs, outputs, qos=INPUT_QOS, result_qos=None,
                 overrides=(), **parameters):
        self.graph, self.spin, self.settle = graph, graph.spin, graph.settle
        if node_class.takes_data:
            parameters.setdefault('stale_after', 0.0)
        self.node = graph.add(
            node_class, {name.replace('__', '.'): value for name, value in parameters.items()},
            parameter_overrides=list(overrides))
        for timer in self.node.timers:
            if timer.callback == self.node.publish_diagnostics:
                timer.cancel()
        self.publishers = {topic: graph.publisher(topic, kind, qos=qos)
                           for topic, kind in inputs.items()}
        self.received = {topic: graph.capture(topic, kind, qos=result_qos)
                         for topic, kind in {**outputs, '/diagnostics': DiagnosticArray}.items()}

    def send(self, topic, message):
        """Publish a message."""
        self.graph.publish(topic, message)

    def diagnostics(self):
        """Return level, message and values of the node's status now."""
        self.settle()
        self.received['/diagnostics'].clear()
        self.node.publish_diagnostics()
        assert self.spin(lambda: self.received['/diagnostics'])
        status = self.received['/diagnostics'][-1].status[0]
        return status.level, status.message, {item.key: item.value for item in status.values}

    def status(self):
        """Return the values of the node's status now, numbers as such."""
        return {key: int(value) if value.isdecimal() else value
                for key, value in self.diagnostics()[2].items()}

    def client(self):
        """Return a client of the node's parameter services that waits for answers."""
        client = AsyncParameterClient(self.graph.node, self.node.get_name())
        assert self.spin(client.services_are_ready)

        def ask(method, *arguments):
            future = getattr(client, method)(*arguments)
            assert self.spin(future.done)
            return future.result()

        return ask

    def set_parameter(self, name, value):
        """Set a parameter through its service; return success and the reason of a refusal."""
        result = self.client()('set_parameters', [Parameter(name, value=value)]).results[0]
        return result.successful, result.reason


class AveragerBench(NodeBench):
    """A bench around the averager with one machine."""

    def __init__(self, graph, *, shafts=('shaft',), **options):
        parameters = {'shafts': list(shafts), **options}
        vibration = options.get('vibration_type', 'std_msgs/Float64MultiArray')
        tach = options.get('tach_type', 'sensor_msgs/TimeReference')
        kinds = {'vibration': messages.SAMPLE_TYPES[vibration.replace('/msg/', '/')],
                 'tach_pulse': messages.PULSE_TYPES[tach.replace('/msg/', '/')]}
        outputs = {f'{shaft}/{kind}': Float64MultiArray for shaft in shafts for kind in (
            'order_amplitude', 'synchronous_average', 'condition_indicator', 'standard_error')}
        super().__init__(graph, SynchronousAverager, inputs=kinds,
                         outputs={**outputs, 'shaft_speed': Float64}, **parameters)
        self.references = 'tach_type' not in options

    def amplitudes(self, shaft='shaft'):
        """Return the order amplitudes received."""
        return [messages.decode_average('order_amplitude', item)
                for item in self.received[f'{shaft}/order_amplitude']]

    def send_pulses(self, times, source='kp'):
        """Publish pulses, one message each where they are references."""
        if not self.references:
            self.send('tach_pulse', messages.encode_pulse_array(np.asarray(times)))
            return
        for time in times:
            self.send('tach_pulse', messages.encode_pulse_reference(float(time), source))

    def play(self, machine, seconds, *, size=640, start=0.0, encode=messages.encode_samples,
             change=lambda number, block: [block]):
        """Publish a run of a machine in step; `change` makes other blocks of each, by number."""
        pulses = machine.pulses(seconds, start)
        for number, index in enumerate(range(0, int(seconds * machine.rate), size)):
            at = start + index / machine.rate
            self.send_pulses(pulses[(pulses >= at) & (pulses < at + size / machine.rate)])
            for block in change(number, machine.block(index, size, start=start)):
                self.send('vibration', encode(block) if hasattr(block, 'samples') else block)
        self.settle()


def assert_true(averages, machine, orders, *, cycles=1.0, rtol=3e-4, start=0.0):
    """
    Check amplitudes, phases, times and angles of successive averages against the machine.

    The angle runs on where an average begins at the last one's end and is 0 elsewhere.
    """
    angle, end = 0.0, -np.inf
    for average in averages:
        header = average.header
        first = round(header.start_time * machine.speed)
        pulses = np.arange(first, first + header.trigger_cycles + 1) / machine.speed
        np.testing.assert_allclose((header.start_time, header.end_time), pulses[[0, -1]],
                                   atol=3e-9 + 1e-12 * abs(start))
        angle = angle if abs(header.start_time - end) < 1e-6 else 0.0
        truth = machine.amplitudes(pulses, orders, cycles=cycles, angle=angle)
        for channel, row in enumerate(average.values):
            np.testing.assert_array_equal(row[:, 0], orders)
            np.testing.assert_allclose(row[:, 1] * np.exp(1j * row[:, 2]), (channel + 1) * truth,
                                       atol=rtol * (channel + 1))
        angle += cycles * header.trigger_cycles
        end = header.end_time
