# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Publishers of the averager's results for one shaft, also as texts that a person reads."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
import math

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
import numpy as np
from rclpy.publisher import Publisher
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.averaging.average import Average
from sa_jitter_ros.averaging.indicators import GearSettings, IN_UNIT
from sa_jitter_ros.averaging.results import AMPLITUDE_FIELDS, AverageMessage, ShaftResults
from sa_jitter_ros.averaging.shortfall import Shortfall
from sa_jitter_ros.errors import MessageError
from sa_jitter_ros.machine import LEVELS, Machine
from sa_jitter_ros.monitoring.limits import LimitWatch, PassedLimit
from sa_jitter_ros.monitoring.quantities import best_amplitudes, monitored
from sa_jitter_ros.nodes.base import MonitoringNode
from sa_jitter_ros.nodes.messages import encode_average
from sa_jitter_ros.number_text import HALF_95, measured_text, order_text
from sa_jitter_ros.recordings.channel_units import ChannelScale
from sa_jitter_ros.recordings.message_layouts import encode_time
from std_msgs.msg import Float64MultiArray

_ORDERS = 10  # of a summary, the strongest ones
_THERE = 2.45  # standard errors of an amplitude that noise alone passes in 5 %
_STATUS = dict(zip(('', *LEVELS), (
    DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR)))


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
        self._results, self._refusals = ShaftResults(), Shortfall()
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
        self._node.set_missing(f'envelope of {self._name}', self._results.bearing_problem)
        if (correction := average.correction) is None:  # not asked for
            self._refusals = Shortfall()
        else:
            self._refusals.add(not correction.accepted)
            self.refused += not correction.accepted
            self.refusal = correction.reason or self.refusal
        self._node.set_missing(f'correction of {self._name}',
                               f'refused for {self._refusals}: {self.refusal}'
                               if self._refusals else '')


def summary_of(shaft: str, results: Mapping[str, AverageMessage], channels: ChannelScale,
               hardware_id: str, machine: Machine, passed: Sequence[PassedLimit] = ()
               ) -> DiagnosticArray:
    """
    Return one status for each channel; `results` are those of `ShaftResults`.

    Its level is that of the worst of the limits that are `passed`, the worst first; a channel
    without data is a warning.
    """
    table = results['order_amplitude']
    message = DiagnosticArray()
    try:
        stamp = encode_time(table.header.end_time)
    except MessageError:  # beyond the year 2038
        stamp = 0, 0
    message.header.stamp.sec, message.header.stamp.nanosec = stamp
    for channel, (name, unit) in enumerate(zip(channels.names, channels.units)):
        orders = dict(_orders(table.values[channel], unit, partial(machine.name_of, shaft)))
        values = {'sequence': str(table.header.sequence),
                  'trigger_speed_hz': f'{table.header.mean_trigger_speed:.6g}',
                  **orders, **_indicators(results, channel, unit)}
        worst = next((item for item in passed if item.channel == channel), None)
        deaf = bool(np.isnan(results['synchronous_average'].values[channel]).all())
        message.status.append(DiagnosticStatus(
            level=_STATUS[worst.level if worst else LEVELS[0] if deaf else ''],
            name=f'{shaft}: {name}', hardware_id=hardware_id, message=str(
                worst or 'no data: look at sensor and cable' * deaf or (
                    f'average {table.header.sequence} of {table.header.trigger_cycles} '
                    f'trigger cycles at {table.header.mean_trigger_speed:.4g} Hz')),
            values=[KeyValue(key=key, value=value) for key, value in values.items()]))
    return message


def _orders(table: FloatArray, unit: str, name_of: Callable[[float], str]
            ) -> Iterator[tuple[str, str]]:
    """Iterate over the strongest orders of a table (order, field), or names, and their texts."""
    field = dict(zip(AMPLITUDE_FIELDS, table.T))
    amplitude, error, _ = best_amplitudes(table)
    known = np.flatnonzero(np.isfinite(amplitude))
    for place in sorted(known[np.argsort(-amplitude[known])][:_ORDERS]):
        order, share = field['order'][place], field['attenuation'][place]
        text = _interval(amplitude[place], error[place], unit)
        if amplitude[place] <= _THERE * error[place]:
            text = f'below {field["upper_95"][place]:.2g} {unit}'.rstrip()
        elif math.isfinite(share):
            text += f', attenuation {share:.3g}'
        yield name_of(order) or order_text(order), text


def _indicators(results: Mapping[str, AverageMessage], channel: int, unit: str) -> dict[str, str]:
    found, errors = (results.get(f'condition_indicator{end}') for end in ('', '_error'))
    if found is None or errors is None:
        return {}
    return {name: _interval(value, error, unit if name in IN_UNIT else '')
            for name, value, error in zip(found.names, found.values[channel],
                                          errors.values[channel]) if math.isfinite(value)}


def _interval(value: float, error: float, unit: str) -> str:
    """
    Return a value with half of its 95 % interval.

    >>> _interval(0.99823, 0.0061, 'm/s^2')
    '0.998 +- 0.012 m/s^2'
    """
    half = HALF_95 * error
    text = measured_text(float(value), float(half)) if math.isfinite(half) else f'{value:.4g}'
    return ' '.join(filter(None, (text.replace('±', '+-'), unit)))
