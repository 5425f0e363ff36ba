"""How a node publishes `tach_pulse`, in the message type that its user chose."""

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.errors import MessageError
from sa_jitter_ros.nodes.base import INPUT_QOS, MonitoringNode
from sa_jitter_ros.nodes.messages import (
    encode_pulse_array, encode_pulse_reference, known_type, PULSE_TYPES)
from sa_jitter_ros.parameters import Parameter
from sensor_msgs.msg import TimeReference

TACH_TYPE = Parameter(
    'tach_type', 'sensor_msgs/TimeReference', 'message type of tach_pulse: '
    'sensor_msgs/TimeReference, or std_msgs/Float64MultiArray above some hundred pulses a second',
    read_only=True)


class PulseOutput:
    """
    Publisher of pulse times (s) on `tach_pulse`.

    `single` tells that every pulse is a message of its own; `published` counts pulses.
    """

    def __init__(self, node: MonitoringNode, tach_type: str) -> None:
        kind = PULSE_TYPES[known_type('tach_type', tach_type, PULSE_TYPES)]
        self._node = node
        self._publisher = node.create_output(kind, 'tach_pulse', INPUT_QOS)
        self.single = kind is TimeReference
        self.published = 0

    @property
    def subscribers(self) -> int:
        """Number of subscribers."""
        return int(self._publisher.get_subscription_count())

    def publish(self, times: NDArray[np.float64], keyphasor: str) -> int:
        """Publish pulses; return how many their message could not hold, which is warned of."""
        refused = 0
        if not self.single:
            if times.size:
                self._publisher.publish(encode_pulse_array(times))
            self.published += times.size
            return refused
        for time in times.tolist():
            try:
                message = encode_pulse_reference(time, keyphasor)
            except MessageError as error:
                refused += 1
                self._node.warn(f'tach_pulse: {error}')
            else:
                self._publisher.publish(message)
                self.published += 1
        return refused
