# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Signals in, sampled ones and the angle of a joint, and tach pulses out, as the user chose."""

from dataclasses import replace
from functools import lru_cache
import math
from types import MappingProxyType
from typing import Any

import numpy as np
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.errors import MessageError, ParameterError, SignalError
from sa_jitter_ros.nodes.base import INPUT_QOS, MonitoringNode
from sa_jitter_ros.nodes.messages import (
    decode_time, encode_pulse_array, encode_pulse_reference, known_type, PULSE_TYPES, SAMPLE_TYPES,
    SampleDecoder)
from sa_jitter_ros.parameters import Values
from sa_jitter_ros.pulses.sampled_angle import AngleCrossings
from sa_jitter_ros.recordings.channel_check import bad_channels, with_advice
from sa_jitter_ros.recordings.channel_units import Channels, scale_of
from sa_jitter_ros.samples import SampleBlock
from sensor_msgs.msg import TimeReference

NO_HEADER = ('messages have no header: sample times are counted from start_time, and lost samples '
             'are not detected; send time, sampling rate and index of the first sample')
_JUDGED = 4096  # samples by which channels are judged


class SampleInput:
    """
    Decodes the samples of one topic, and warns of those without header and of a wrong rate.

    With `channels` the samples are in their units; `scale_of` has names and units of a number of
    channels, and raises ParameterError where these are not known.
    """

    def __init__(self, node: MonitoringNode, values: Values,
                 channels: Channels = MappingProxyType({})) -> None:
        self._node = node
        self.scale_of = lru_cache(maxsize=8)(lambda count: scale_of(channels, count))
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
        try:
            scale = self.scale_of(len(block.samples))
        except ParameterError as error:
            raise MessageError(str(error)) from None
        return replace(block, samples=scale.apply(block.samples))

    def show_warning(self) -> None:
        """Say in the next diagnostics what is wrong with the samples."""
        if self._decoder.counted:
            self._node.show_warning(NO_HEADER)
        self._node.set_missing('samples', self._decoder.doubt)


class ChannelWatch:
    """Says about once a second which channels of the vibration are constant or saturated."""

    def __init__(self) -> None:
        self._blocks: list[FloatArray] = []
        self._held = 0

    def add(self, samples: FloatArray) -> None:
        """Take samples (channel, sample), of which as many as a judgement needs are kept."""
        if self._blocks and len(samples) != len(self._blocks[0]):
            self._blocks, self._held = [], 0
        if self._held < _JUDGED:
            self._blocks.append(samples)
            self._held += samples.shape[1]

    def say(self, node: MonitoringNode) -> None:
        """Say what is wrong with channels, once enough samples have come."""
        if self._held >= _JUDGED:
            samples = np.hstack(self._blocks)
            self._blocks, self._held, faults = [], 0, bad_channels(samples)
            for channel in range(len(samples)):
                node.set_missing(f'channel {channel} of vibration',
                                 with_advice(faults[channel]) if channel in faults else '')


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

    def publish(self, times: FloatArray, keyphasor: str) -> int:
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


class JointInput:
    """
    Decodes the position of one joint and finds the crossings of its marks.

    `joint` is the name of the joint, '' for the only one. Messages of other joints alone, as
    several publishers of one topic send them, are counted in `others`.
    """

    def __init__(self, joint: str, *, marks: int, time_tolerance: float) -> None:
        self.joint = joint
        self.crossings = AngleCrossings(marks=marks, time_tolerance=time_tolerance)
        self.others = 0
        self._time = math.nan  # s, the latest stamp

    def pulses(self, message: Any) -> FloatArray | None:
        """
        Return new pulse times (s), None for a message of others.

        Raises MessageError, and SignalError for a stamp that came before, which is counted.
        """
        names = list(message.name)
        if not self.joint:
            if len(names) != 1:
                raise MessageError(f'joint is empty, and the message has {len(names)} joints '
                                   f'({", ".join(names[:6]) or "none"}): set joint to one of them')
            self.joint = names[0]
        if self.joint not in names:
            self.others += 1
            return None
        index = names.index(self.joint)
        if len(message.position) <= index:
            raise MessageError(f'{len(message.position)} positions for {len(names)} joints: '
                               f'{self.joint} needs its position in rad')
        stamp = message.header.stamp
        time = decode_time(stamp.sec, stamp.nanosec)
        pulses = self.crossings.update([time], [float(message.position[index])])
        if time == self._time:
            raise SignalError(f'stamps do not advance from {time:.9g} s on: fill header.stamp '
                              'with the time of measurement')
        self._time = time
        return pulses

    def summary(self) -> tuple[str, dict[str, object]]:
        """Return what the node says of its state, and the values behind it."""
        state = self.crossings.state
        values: dict[str, object] = {name: f'{getattr(state, name):.6g}' for name in (
            'pulse_error_std', 'angle_resolution', 'stamp_noise_std')}
        values |= {name: getattr(state, name) for name in ('reversals', 'stops', 'glitches')}
        values |= {'joint': self.joint, 'messages_of_others': self.others}
        if not state.samples:
            of = f' of joint {self.joint}' if self.joint else ''
            return f'no position{of} received yet', values
        if not state.pulses:
            return f'joint {self.joint} has not passed a mark yet: does it turn?', values
        error = ('' if np.isnan(state.pulse_error_std) else
                 f', each with an error of {1e6 * state.pulse_error_std:.3g} us')
        bridged = f'; {state.glitches} samples of glitches bridged' if state.glitches else ''
        return f'{state.pulses} marks of joint {self.joint} passed{error}{bridged}', values
