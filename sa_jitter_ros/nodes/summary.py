# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Averages as texts that a person reads in any tool: `<shaft>/summary`."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
import math

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
import numpy as np
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.averaging.indicators import IN_UNIT
from sa_jitter_ros.averaging.results import AMPLITUDE_FIELDS, AverageMessage
from sa_jitter_ros.errors import MessageError
from sa_jitter_ros.machine import LEVELS, Machine
from sa_jitter_ros.monitoring.limits import PassedLimit
from sa_jitter_ros.monitoring.quantities import best_amplitudes
from sa_jitter_ros.number_text import HALF_95, measured_text, order_text
from sa_jitter_ros.recordings.channel_units import ChannelScale
from sa_jitter_ros.recordings.message_layouts import encode_time

_ORDERS = 10  # the strongest ones
_STATUS = dict(zip(('', *LEVELS), (
    DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR)))


def summary_of(shaft: str, results: Mapping[str, AverageMessage], channels: ChannelScale,
               hardware_id: str, machine: Machine, passed: Sequence[PassedLimit] = ()
               ) -> DiagnosticArray:
    """
    Return one status for each channel; `results` are those of `ShaftResults`.

    Its level is that of the worst of the limits that are `passed`, the worst first.
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
        message.status.append(DiagnosticStatus(
            level=_STATUS[worst.level if worst else ''], name=f'{shaft}: {name}',
            hardware_id=hardware_id, message=str(
                worst or f'average {table.header.sequence} of {table.header.trigger_cycles} '
                f'trigger cycles at {table.header.mean_trigger_speed:.4g} Hz'),
            values=[KeyValue(key=key, value=value) for key, value in values.items()]))
    return message


def _orders(table: FloatArray, unit: str, name_of: Callable[[float], str]
            ) -> Iterator[tuple[str, str]]:
    """Iterate over the strongest orders of a table (order, field), or names, and their texts."""
    field = dict(zip(AMPLITUDE_FIELDS, table.T))
    amplitude, error, _ = best_amplitudes(table)
    known = np.flatnonzero(np.isfinite(amplitude))
    for place in sorted(known[np.argsort(-amplitude[known])][:_ORDERS]):
        order = field['order'][place]
        yield name_of(order) or order_text(order), (
            f'{_interval(amplitude[place], error[place], unit)}, '
            f'attenuation {field["attenuation"][place]:.3g}')


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
