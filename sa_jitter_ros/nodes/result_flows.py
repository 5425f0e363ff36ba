# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Silence of the results of an averager, for the nodes that take them."""

from collections.abc import Sequence

import numpy as np
from sa_jitter_ros.averaging.results import AMPLITUDE_FIELDS, AverageMessage
from sa_jitter_ros.nodes.base import MonitoringNode
from sa_jitter_ros.nodes.health import Flow

AVERAGE = 'order_amplitude'
UNCORRECTED = (f'{AVERAGE} has no corrected amplitudes: set correct_jitter: true in the averager; '
               'if the averager refuses the correction (see its diagnostics), use a better '
               'keyphasor')
_OPTIONAL = ('envelope_amplitude',)  # of shafts with bearing orders
_ATTENUATION = AMPLITUDE_FIELDS.index('attenuation')


class ResultFlows:
    """
    The averages of each of the `shafts` that a node takes, and the kinds `beside` them.

    The averager publishes these others with every corrected average, so that their silence counts
    while such averages come; that of the envelope, if it has come before.
    """

    def __init__(self, node: MonitoringNode, shafts: Sequence[str], beside: Sequence[str] = ()
                 ) -> None:
        self._flows: dict[str, dict[str, Flow]] = {}
        for shaft in shafts:
            prefix = f'{shaft}.' if len(shafts) > 1 else ''
            average = f'{prefix}average'
            self._flows[shaft] = {
                AVERAGE: node.watch_input(average, f'{shaft}/{AVERAGE}',
                                          'has it vibration and pulses? (see its status)'),
                **{kind: node.watch_input(f'{prefix}{kind}', f'{shaft}/{kind}',
                                          'averages come without it (see its status)',
                                          after=(average,), judged=False,
                                          optional=kind in _OPTIONAL) for kind in beside}}

    def came(self, shaft: str, kind: str, message: AverageMessage) -> None:
        """Note that a result came."""
        flows = self._flows[shaft]
        flows[kind].came()
        if kind == AVERAGE:
            corrected = bool(np.isfinite(message.values[..., _ATTENUATION]).any())
            for other in flows.values():
                other.allowance = message.header.end_time - message.header.start_time
                other.judged = corrected or other is flows[AVERAGE]

    def expect(self, duration: float) -> None:
        """Expect averages of a duration (s) as long as none has come."""
        for flows in self._flows.values():
            if not flows[AVERAGE].allowance:
                flows[AVERAGE].allowance = duration
