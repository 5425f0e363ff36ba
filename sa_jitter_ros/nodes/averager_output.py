# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Results of the averager for one shaft, as messages."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.publisher import Publisher
from sa_jitter_ros.averaging.average import Average
from sa_jitter_ros.averaging.indicators import GearSettings, INDICATORS, RunningIndicators
from sa_jitter_ros.errors import ParameterError, SignalError
from sa_jitter_ros.nodes.base import MonitoringNode
from sa_jitter_ros.nodes.messages import (AMPLITUDE_FIELDS, AverageHeader, AverageMessage,
                                          encode_average, PULSE_ERROR_FIELDS)
from std_msgs.msg import Float64MultiArray

FloatArray = NDArray[np.float64]

ROUNDING = 1e-9  # relative scatter of a constant that was resampled


class ShaftOutput:
    """Publishers of one shaft and its condition indicators, which depend on earlier averages."""

    def __init__(self, node: MonitoringNode, name: str) -> None:
        self._node, self._name = node, name
        self._publishers: dict[str, Publisher] = {
            kind: node.create_output(Float64MultiArray, f'{name}/{kind}')
            for kind in ('synchronous_average', 'standard_error', 'order_amplitude',
                         'condition_indicator', 'corrected_average', 'pulse_error')}
        self._gear = GearSettings()
        self._indicators = RunningIndicators(self._gear)
        self.published = self.refused = 0
        self.refusal = ''

    def use(self, gear: GearSettings) -> None:
        """Use other mesh orders; the indicators forget earlier averages."""
        if gear != self._gear:
            self._gear, self._indicators = gear, RunningIndicators(gear)

    def publish(self, average: Average) -> None:
        """Publish one average."""
        header = AverageHeader(
            average.start_time, average.end_time, average.sequence, average.trigger_cycles,
            average.fundamental_cycles, average.trigger_speed, average.discarded_cycles)
        self._send('synchronous_average', header, average.waveform)
        self._send('standard_error', header, average.standard_error)
        self._send('order_amplitude', header, amplitude_table(average), AMPLITUDE_FIELDS)
        self.published += 1
        constant = np.ptp(average.waveform, axis=1) <= ROUNDING * np.abs(average.waveform[:, 0])
        for channel, is_constant in enumerate(constant.tolist()):
            self._node.set_missing(f'channel {channel} of vibration', (
                f'constant at {average.waveform[channel, 0]:.6g}, look at its sensor and cable'
                if is_constant else ''))
        correction = average.correction
        refusal = '' if correction is None or correction.accepted else correction.reason
        self._node.set_missing(f'correction of {self._name}',
                               f'refused, {refusal}' if refusal else '')
        if refusal:
            self.refused += 1
            self.refusal = refusal
        elif correction is not None:
            self._send('corrected_average', header, correction.waveform)
            self._send('pulse_error', header, np.stack(
                (average.pulses, correction.pulse_errors, correction.standard_errors,
                 average.used), axis=1), PULSE_ERROR_FIELDS)
        waveform = average.waveform if correction is None else correction.waveform
        if np.isfinite(waveform).all():
            self._indicate(header, waveform)

    def _indicate(self, header: AverageHeader, waveform: FloatArray) -> None:
        """Publish the condition indicators of a waveform."""
        try:
            self._indicators.update(waveform)
        except SignalError:  # the number of channels has changed
            self._indicators = RunningIndicators(self._gear)
            self._indicators.update(waveform)
        except ParameterError as error:
            self._node.warn(f'{self._name}: {error}')
            return
        self._send('condition_indicator', header, self._indicators.get().values, INDICATORS)

    def _send(self, kind: str, header: AverageHeader, values: Any,
              names: tuple[str, ...] = ()) -> None:
        self._publishers[kind].publish(encode_average(kind, AverageMessage(header, values, names)))


def amplitude_table(average: Average) -> FloatArray:
    """Return (channel, order, `AMPLITUDE_FIELDS`), NaN where there is no correction."""
    table = np.full((*average.amplitudes.shape, len(AMPLITUDE_FIELDS)), np.nan)
    table[..., 0] = average.orders
    table[..., 1] = np.abs(average.amplitudes)
    table[..., 2] = np.angle(average.amplitudes)
    table[..., 7] = average.noise
    if average.correction is not None and average.correction.accepted:
        correction = average.correction
        table[..., 3] = np.abs(correction.amplitudes)
        table[..., 4] = np.angle(correction.amplitudes)
        table[..., 5] = correction.attenuation
        table[..., 6] = correction.attenuation_standard_error
        table[..., 7] = correction.noise  # without the scatter that jitter causes
    return table
