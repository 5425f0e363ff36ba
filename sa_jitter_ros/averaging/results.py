# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
Results of an average as arrays under the names of their topics, the same in messages and files.

Layouts are those of the topics of `synchronous_averager`: `<shaft>/synchronous_average`, ...
"""

from dataclasses import dataclass

import numpy as np
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.averaging.average import Average
from sa_jitter_ros.averaging.envelope import Envelope
from sa_jitter_ros.averaging.shaft_indicators import best_of, ShaftIndicators

AMPLITUDE_FIELDS = (
    'order', 'raw_amplitude', 'raw_phase', 'corrected_amplitude', 'corrected_phase',
    'attenuation', 'attenuation_standard_error', 'noise_standard_deviation',
    'raw_standard_error', 'raw_phase_standard_error', 'corrected_standard_error',
    'corrected_phase_standard_error', 'upper_95')
ENVELOPE_FIELDS = ('order', 'found_order', 'amplitude', 'standard_error', 'mean')
SPECTRUM_FIELDS = ('order', 'amplitude')
PULSE_ERROR_FIELDS = ('time', 'error', 'standard_error', 'used')

_Table = tuple[FloatArray, tuple[str, ...]]  # values and their fields


@dataclass(frozen=True)
class AverageHeader:
    """
    Times (s), numbers of cycles and `mean_trigger_speed` (Hz, tach shaft) of an average.

    `discarded_cycles` trigger cycles between the first and the last one are not in it.
    """

    start_time: float
    end_time: float
    sequence: int
    trigger_cycles: int
    fundamental_cycles: int
    mean_trigger_speed: float
    discarded_cycles: int = 0


@dataclass(frozen=True)
class AverageMessage:
    """
    One array of results of one average.

    `values` is channel x angle for a synchronous average, channel x order x field for order
    amplitudes (`AMPLITUDE_FIELDS`), envelope amplitudes (`ENVELOPE_FIELDS`) and the spectrum of
    the envelope (`SPECTRUM_FIELDS`), pulse x field for pulse errors (`PULSE_ERROR_FIELDS`) and
    channel x indicator for condition indicators; `names` are the fields or indicators.
    """

    header: AverageHeader
    values: FloatArray
    names: tuple[str, ...] = ()


class ShaftResults(ShaftIndicators):
    """The results of the averages of one shaft; condition indicators depend on earlier ones."""

    #: Which bearing orders the latest average has no amplitude of, and why.
    bearing_problem = ''

    def of(self, average: Average) -> dict[str, AverageMessage]:
        """
        Return the arrays of the next average by the names of their topics.

        `corrected_average` and `pulse_error` are there if the correction was accepted,
        `condition_indicator` and `condition_indicator_error` if the waveform of a channel is
        finite and the mesh orders are in it, `envelope_amplitude` and `envelope_spectrum` with
        bearing orders.
        """
        header = AverageHeader(
            average.start_time, average.end_time, average.sequence, average.trigger_cycles,
            average.fundamental_cycles, average.trigger_speed, average.discarded_cycles)
        tables: dict[str, _Table] = {
            'synchronous_average': (average.waveform, ()),
            'standard_error': (average.standard_error, ()),
            'order_amplitude': (amplitude_table(average), AMPLITUDE_FIELDS)}
        correction = average.correction
        if correction is not None and correction.accepted:
            tables['corrected_average'] = correction.waveform, ()
            tables['pulse_error'] = np.stack(
                (average.pulses, correction.pulse_errors, correction.standard_errors,
                 average.used), axis=1), PULSE_ERROR_FIELDS
        envelope = average.envelope or best_of(average).envelope
        self.bearing_problem = envelope.problem if envelope is not None else ''
        if envelope is not None:
            tables |= envelope_tables(envelope)
        indicators = self.indicators_of(average)
        if indicators is not None:
            tables['condition_indicator'] = indicators.values, indicators.names
            tables['condition_indicator_error'] = indicators.standard_errors, indicators.names
        return {name: AverageMessage(header, *table) for name, table in tables.items()}


def envelope_tables(envelope: Envelope) -> dict[str, _Table]:
    """Return tables (channel, order, field) and their fields by the names of their topics."""
    shape = envelope.amplitudes.shape
    lines = np.stack((np.broadcast_to(envelope.bearing_orders, shape), envelope.found,
                      envelope.amplitudes, envelope.standard_errors,
                      np.broadcast_to(envelope.mean[:, None], shape)), axis=-1)
    spectrum = np.stack((np.broadcast_to(envelope.orders, envelope.spectrum.shape),
                         envelope.spectrum), axis=-1)
    return {'envelope_amplitude': (lines, ENVELOPE_FIELDS),
            'envelope_spectrum': (spectrum, SPECTRUM_FIELDS)}


def amplitude_table(average: Average) -> FloatArray:
    """Return (channel, order, `AMPLITUDE_FIELDS`), NaN where there is no correction."""
    table = np.full((*average.amplitudes.shape, len(AMPLITUDE_FIELDS)), np.nan)
    table[..., 0] = average.orders
    table[..., 1] = np.abs(average.amplitudes)
    table[..., 2] = np.angle(average.amplitudes)
    table[..., 7] = average.noise
    errors = average.amplitude_errors
    table[..., 8], table[..., 9], table[..., 12] = errors.amplitude, errors.phase, errors.upper_95
    if average.correction is not None and average.correction.accepted:
        correction = average.correction
        table[..., 3] = np.abs(correction.amplitudes)
        table[..., 4] = np.angle(correction.amplitudes)
        table[..., 5] = correction.attenuation
        table[..., 6] = correction.attenuation_standard_error
        table[..., 7] = correction.noise  # without the scatter that jitter causes
        errors = correction.amplitude_errors
        table[..., 10], table[..., 11] = errors.amplitude, errors.phase
        table[..., 12] = np.where(np.isnan(errors.upper_95), table[..., 12], errors.upper_95)
    return table
