# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Sampled signals in and tach pulses out, in the message types that the user chose."""

from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.errors import MessageError, ParameterError
from sa_jitter_ros.nodes.base import INPUT_QOS, MonitoringNode
from sa_jitter_ros.nodes.messages import (
    encode_pulse_array, encode_pulse_reference, known_type, PULSE_TYPES, SAMPLE_TYPES,
    SampleDecoder)
from sa_jitter_ros.parameters import Values
from sa_jitter_ros.recordings.channel_units import Channels, scale_of
from sa_jitter_ros.samples import SampleBlock
from sensor_msgs.msg import TimeReference

NO_HEADER = ('messages have no header: sample times are counted from start_time, and lost samples '
             'are not detected; send time, sampling rate and index of the first sample')


class SampleInput:
    """
    Decodes the samples of one topic, and warns of those without header and of a wrong rate.

    With `channels` the samples are in their units, and `scale` has names and units of those of
    the latest message.
    """

    def __init__(self, node: MonitoringNode, values: Values,
                 channels: Channels = MappingProxyType({})) -> None:
        self._node, self._channels = node, channels
        self.scale = scale_of({}, 0)
        key = known_type('vibration_type', values['vibration_type'], SAMPLE_TYPES)
        self.message_type = SAMPLE_TYPES[key]
        self._decoder = SampleDecoder(key, sample_rate=values['sample_rate'],
                                      start_time=values['start_time'],
                                      imu_axis=values['imu_axis'])
        self._warned = False

    def decode(self, message: Any) -> SampleBlock:
        """Return the samples of a message; raises `MessageError`."""
        block = self._decoder.decode(message)
        if self._decoder.counted and not self._warned:
            self._warned = True
            self._node.warn(NO_HEADER)
        if len(block.samples) != len(self.scale.names):
            try:
                self.scale = scale_of(self._channels, len(block.samples))
            except ParameterError as error:
                raise MessageError(str(error)) from None
        return replace(block, samples=self.scale.apply(block.samples)) if self._channels else block

    def show_warning(self) -> None:
        """Say in the next diagnostics what is wrong with the samples."""
        if self._decoder.counted:
            self._node.show_warning(NO_HEADER)
        self._node.set_missing('samples', self._decoder.doubt)


class PulseOutput:
    """
    Publisher of pulse times (s) on `tach_pulse`.

    `single` says that each pulse is one message; `published` counts pulses.
    """

    def __init__(self, node: MonitoringNode, tach_type: str) -> None:
        kind = PULSE_TYPES[known_type('tach_type', tach_type, PULSE_TYPES)]
        self._node = node
        self._publisher = node.create_output(kind, 'tach_pulse', INPUT_QOS)
        self.single = kind is TimeReference
        self.published = 0

    @property
    def subscribers(self) -> int:
        """Return the number of subscribers."""
        return int(self._publisher.get_subscription_count())

    def publish(self, times: NDArray[np.float64], keyphasor: str) -> int:
        """Publish pulses; warn of those whose time the message cannot hold, and count them."""
        dropped = 0
        if not self.single:
            if times.size:
                self._publisher.publish(encode_pulse_array(times))
            self.published += times.size
            return dropped
        for time in times.tolist():
            try:
                message = encode_pulse_reference(time, keyphasor)
            except MessageError as error:
                dropped += 1
                self._node.warn(f'tach_pulse: {error}')
            else:
                self._publisher.publish(message)
                self.published += 1
        return dropped
