# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Publishers of the averager's results for one shaft."""

import math

from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
from rclpy.publisher import Publisher
from sa_jitter_ros.averaging.average import Average
from sa_jitter_ros.averaging.indicators import GearSettings
from sa_jitter_ros.averaging.results import ShaftResults
from sa_jitter_ros.averaging.shortfall import Shortfall
from sa_jitter_ros.monitoring.limits import LimitWatch
from sa_jitter_ros.monitoring.quantities import monitored
from sa_jitter_ros.nodes.base import MonitoringNode
from sa_jitter_ros.nodes.messages import encode_average
from sa_jitter_ros.nodes.summary import summary_of
from sa_jitter_ros.recordings.channel_units import ChannelScale
from std_msgs.msg import Float64MultiArray

ROUNDING = 1e-9  # relative scatter of a constant that was resampled


class ShaftOutput:
    """Publishes the results of one shaft, and says what they lack."""

    def __init__(self, node: MonitoringNode, name: str, limits: LimitWatch) -> None:
        self._node, self._name, self._limits = node, name, limits
        self._publishers: dict[str, Publisher] = {
            kind: node.create_output(Float64MultiArray, f'{name}/{kind}')
            for kind in ('synchronous_average', 'standard_error', 'order_amplitude',
                         'condition_indicator', 'condition_indicator_error', 'corrected_average',
                         'pulse_error', 'envelope_amplitude', 'envelope_spectrum')}
        self._summary = node.create_output(DiagnosticArray, f'{name}/summary')
        self._summarised = -math.inf  # s, end of the latest average in a summary
        self._results = ShaftResults()
        self._refusals = Shortfall()
        self.published = self.refused = 0
        self.refusal = ''

    def use(self, gear: GearSettings) -> None:
        """Use other mesh orders; the indicators forget earlier averages."""
        self._results.use(gear)

    def publish(self, average: Average, channels: ChannelScale, pause: float) -> None:
        """Publish one average of channels; a summary, if it ends a `pause` (s) after the last."""
        results = self._results.of(average)
        for kind, result in results.items():
            self._publishers[kind].publish(encode_average(kind, result))
        if self._limits.names:
            self._limits.update(self._name, monitored(results))
        since = average.end_time - self._summarised
        if not 0.0 <= since < pause and self._summary.get_subscription_count():
            self._summarised = average.end_time
            self._summary.publish(summary_of(
                self._name, results, channels, self._node.hardware_id,
                self._node.parameters.machine, self._limits.passed(self._name)))
        self.published += 1
        self._node.set_missing(f'condition indicators of {self._name}', self._results.problem)
        constant = np.ptp(average.waveform, axis=1) <= ROUNDING * np.abs(average.waveform[:, 0])
        lacking = np.all(np.isnan(average.waveform), axis=1)
        for channel, (is_constant, is_lacking) in enumerate(zip(constant, lacking)):
            what = f'constant at {average.waveform[channel, 0]:.6g}' if is_constant else (
                'NaN or infinite' if is_lacking and average.fundamental_cycles else '')
            self._node.set_missing(f'channel {channel} of vibration', (
                f'{what}, look at its sensor and cable' if what else ''))
        correction = average.correction
        if correction is None:  # not asked for
            self._refusals = Shortfall()
        else:
            self._refusals.add(not correction.accepted)
            if not correction.accepted:
                self.refused += 1
                self.refusal = correction.reason
        self._node.set_missing(f'correction of {self._name}',
                               f'refused for {self._refusals}: {self.refusal}'
                               if self._refusals else '')
