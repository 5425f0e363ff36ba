"""The demo's eyes: collects what the nodes publish and says how far they are."""

from collections.abc import Callable
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
from rcl_interfaces.srv import SetParameters
from rclpy.node import Node
from rclpy.parameter import Parameter
from sa_jitter_ros.nodes.base import LATCHED_QOS, RESULT_QOS
from sa_jitter_ros.nodes.messages import (AverageMessage, decode_average, decode_prediction,
                                          PredictionMessage)
from std_msgs.msg import Float64, Float64MultiArray


class Watcher(Node):
    """Subscribes to all results of one shaft and to the diagnostics."""

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__('demo', **node_kwargs)
        self.averages: dict[str, list[AverageMessage]] = {
            kind: [] for kind in ('synchronous_average', 'corrected_average', 'order_amplitude',
                                  'pulse_error', 'standard_error')}
        self.prediction: PredictionMessage | None = None
        self.speed = float('nan')
        self.status: dict[str, dict[str, str]] = {}
        for kind in self.averages:
            self.create_subscription(Float64MultiArray, f'shaft/{kind}', self._taker(kind),
                                     RESULT_QOS)
        self.create_subscription(Float64MultiArray, 'prediction', self._on_prediction,
                                 LATCHED_QOS)
        self.create_subscription(Float64, 'shaft_speed', self._on_speed, RESULT_QOS)
        self.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)

    def _taker(self, kind: str) -> Callable[[Float64MultiArray], None]:
        return lambda message: self.averages[kind].append(decode_average(kind, message))

    def _on_prediction(self, message: Float64MultiArray) -> None:
        self.prediction = decode_prediction(message)

    def _on_speed(self, message: Float64) -> None:
        self.speed = message.data

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.status[status.name] = {
                'message': status.message, **{item.key: item.value for item in status.values}}

    def count(self, key: str) -> int:
        """Sum of one count over all nodes."""
        return sum(int(values.get(key, 0)) for values in self.status.values())

    def set_parameter(self, node: str, name: str, value: Any) -> Any:
        """Ask a node to set a parameter; returns the future, None while the node is not there."""
        client = self.create_client(SetParameters, f'{node}/set_parameters')
        if not client.service_is_ready():
            self.destroy_client(client)
            return None
        return client.call_async(SetParameters.Request(
            parameters=[Parameter(name, value=value).to_parameter_msg()]))

    def progress(self) -> str:
        """One line: speed, averages so far, pulses dropped, strongest orders."""
        parts = [f'speed {self.speed:8.3f} Hz', f'averages {len(self.amplitudes()):3d}',
                 f'pulses dropped {self.count("pulses_dropped")}',
                 f'cycles dropped {self.count("cycles_dropped")}']
        if self.amplitudes():
            table = self.amplitudes()[-1].values
            channel = int(np.argmax(np.nansum(table[:, :, 1], axis=1)))
            strongest = np.argsort(-np.nan_to_num(table[channel, :, 1]))[:3]
            parts.append('strongest: ' + ', '.join(
                f'order {table[channel, i, 0]:g} {table[channel, i, 1]:.4g}' for i in strongest))
        return ' | '.join(parts)

    def amplitudes(self) -> list[AverageMessage]:
        """Order amplitudes received so far."""
        return self.averages['order_amplitude']
