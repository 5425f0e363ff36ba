# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The angle of a joint in, times of virtual marks out: `JointState` as a keyphasor."""

from typing import Any

import numpy as np
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.errors import MessageError
from sa_jitter_ros.nodes.messages import decode_time
from sa_jitter_ros.pulses.sampled_angle import AngleCrossings


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

    def pulses(self, message: Any) -> FloatArray | None:
        """Return new pulse times (s), None for a message of others; raises MessageError."""
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
        return self.crossings.update([time], [float(message.position[index])])

    def summary(self) -> tuple[str, dict[str, str]]:
        """Return what the node says of its state, and the values behind it."""
        state = self.crossings.state
        values = {name: f'{getattr(state, name):.6g}' for name in (
            'pulse_error_std', 'angle_resolution', 'stamp_noise_std')}
        values |= {name: str(getattr(state, name)) for name in ('reversals', 'stops', 'glitches')}
        values |= {'joint': self.joint, 'messages_of_others': str(self.others)}
        if not state.samples:
            of = f' of joint {self.joint}' if self.joint else ''
            return f'no position{of} received yet', values
        if not state.pulses:
            return f'joint {self.joint} has not passed a mark yet: does it turn?', values
        error = ('' if np.isnan(state.pulse_error_std) else
                 f', each with an error of {1e6 * state.pulse_error_std:.3g} us')
        bridged = f'; {state.glitches} samples of glitches bridged' if state.glitches else ''
        return f'{state.pulses} marks of joint {self.joint} passed{error}{bridged}', values
