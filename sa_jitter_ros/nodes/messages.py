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
Conversion between messages and arrays, for the nodes of this package and others in Python.

Inputs are decoded to `SampleBlock` and pulse times; their layouts are those of bags, in
`recordings.message_layouts`. Each result is a frozen dataclass with an `encode_*` and a `decode_*`
function; only this module knows their layouts. A message with another layout raises
`MessageError`. Arrays are in C order; NaN is published instead of infinities.
"""

from __future__ import annotations

import array
from dataclasses import astuple, dataclass, fields, MISSING
import math
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.averaging.results import (
    AMPLITUDE_FIELDS, AverageHeader, AverageMessage, ENVELOPE_FIELDS, PULSE_ERROR_FIELDS,
    SPECTRUM_FIELDS)
from sa_jitter_ros.errors import MessageError, ParameterError
from sa_jitter_ros.pulses.target_geometry import MarkOffsets
from sa_jitter_ros.recordings import message_layouts
from sa_jitter_ros.recordings.message_layouts import (
    decode_array, FLOAT32, FLOAT64, IMU, INDEX_BASE, TIME_REFERENCE, whole_number)
from sa_jitter_ros.samples import SampleBlock
from sensor_msgs.msg import Imu, TimeReference
from std_msgs.msg import Float32MultiArray, Float64MultiArray, MultiArrayDimension

ArrayMessage = TypeVar('ArrayMessage', Float64MultiArray, Float32MultiArray)

GEOMETRY_FIELDS = ('angle', 'standard_error')
PREDICTION_FIELDS = (
    'order', 'mean_attenuation', 'variance', 'standard_deviation',
    'quantile_05', 'quantile_50', 'quantile_95')
RESIDUAL_FIELDS = ('order', 'observed', 'predicted', 'residual', 'standard_error', 'z')
SAMPLE_TYPES: dict[str, type] = {
    FLOAT64: Float64MultiArray,
    FLOAT32: Float32MultiArray,
    IMU: Imu,
}
PULSE_TYPES: dict[str, type] = {TIME_REFERENCE: TimeReference, FLOAT64: Float64MultiArray}


@dataclass(frozen=True)
class PredictionMessage:
    """Statistics (order, `PREDICTION_FIELDS`), and speed, rate, cycles and ratio they are for."""

    values: FloatArray
    trigger_speed: float
    keyphasor_rate: float
    trigger_cycles: int
    ratio: float
    pulse_error_standard_deviation: float
    noise_standard_deviation: float


@dataclass(frozen=True)
class ResidualMessage:
    """Observed and predicted attenuation (order, `RESIDUAL_FIELDS`), and their summary."""

    values: FloatArray
    acquisitions: int
    chi2_per_dof: float
    p_value: float
    rms: float


def known_type(parameter: str, name: str, types: dict[str, type]) -> str:
    """Return the key of `types` for a message type, with or without `/msg`."""
    key = name.replace('/msg/', '/')
    if key not in types:
        raise ParameterError(f'{parameter} is {name!r}: give one of {", ".join(types)}')
    return key


def _build(message: ArrayMessage, typecode: str, values: NDArray[np.floating[Any]],
           labels: tuple[str, ...], header: tuple[float, ...]) -> ArrayMessage:
    """Return the message filled with header and array, whose dimensions are named `labels`."""
    stride = values.size
    for label, size in zip(labels, values.shape, strict=True):
        message.layout.dim.append(
            MultiArrayDimension(label=label, size=int(size), stride=int(stride)))
        stride //= max(size, 1)
    message.layout.data_offset = len(header)
    data = array.array(typecode, header)
    data.frombytes(np.ascontiguousarray(values, dtype=typecode).tobytes())
    message.data = data
    return message


def encode_array(values: FloatArray, labels: tuple[str, ...],
                 header: tuple[float, ...] = ()) -> Float64MultiArray:
    """Encode a result: `header` elements, then the array; infinities become NaN."""
    finite = tuple(item if math.isfinite(item) else math.nan for item in map(float, header))
    values = np.where(np.isinf(values), np.nan, values)
    return _build(Float64MultiArray(), 'd', values, labels, finite)


def encode_samples(block: SampleBlock) -> Float64MultiArray:
    """Encode a block as Float64MultiArray with header [time, sample rate, index]."""
    return _build(Float64MultiArray(), 'd', block.samples, ('channel', 'sample'),
                  (block.start_time, block.sample_rate, float(block.index)))


def encode_samples_float32(block: SampleBlock) -> Float32MultiArray:
    """Encode a block as Float32MultiArray with header [index div 2^24, index mod 2^24]."""
    high, low = divmod(block.index, INDEX_BASE)
    return _build(Float32MultiArray(), 'f', block.samples, ('channel', 'sample'),
                  (float(high), float(low)))


SampleDecoder = message_layouts.SampleDecoder
decode_time = message_layouts.decode_time
decode_pulse_reference = message_layouts.decode_pulse_reference
decode_pulse_array = message_layouts.decode_pulse_array


def encode_pulse_reference(time: float, source: str) -> TimeReference:
    """
    Encode one pulse; header.stamp has the same time, for tools that plot it.

    Raises `MessageError` for a time beyond 2^31 s, which the message cannot represent.
    """
    message = TimeReference(source=source)
    second, nanosecond = message_layouts.encode_time(time)
    for stamp in (message.time_ref, message.header.stamp):
        stamp.sec, stamp.nanosec = second, nanosecond
    return message


def encode_pulse_array(times: FloatArray) -> Float64MultiArray:
    """Encode pulse times (n,) in s."""
    return encode_array(np.asarray(times, dtype=np.float64), ('pulse',))


_AVERAGE_LABELS = {
    'synchronous_average': ('channel', 'angle'),
    'standard_error': ('channel', 'angle'),
    'corrected_average': ('channel', 'angle'),
    'order_amplitude': ('channel', 'order', 'field'),
    'pulse_error': ('pulse', 'field'),
    'condition_indicator': ('channel', 'indicator'),
    'condition_indicator_error': ('channel', 'indicator'),
    'envelope_amplitude': ('channel', 'order', 'field'),
    'envelope_spectrum': ('channel', 'order', 'field'),
}


def encode_average(kind: str, average: AverageMessage) -> Float64MultiArray:
    """Encode an average's array; `kind` is the topic's name."""
    labels = _AVERAGE_LABELS[kind]
    if average.names:
        labels = (*labels[:-1], f'{labels[-1]}:{",".join(average.names)}')
    return encode_array(average.values, labels, astuple(average.header))


_AVERAGE_FIELDS = {
    'order_amplitude': AMPLITUDE_FIELDS, 'pulse_error': PULSE_ERROR_FIELDS,
    'envelope_amplitude': ENVELOPE_FIELDS, 'envelope_spectrum': SPECTRUM_FIELDS}


# Number of fields of the first version, where it had fewer.
_FIRST_FIELDS = {AMPLITUDE_FIELDS: 8, PULSE_ERROR_FIELDS: 3}


def _numbers(kind: type[Any], header: FloatArray) -> list[Any]:
    """
    Return header elements as the numbers of a dataclass, its counts whole.

    Those that an older writer lacks are NaN, or what they are by default.
    """
    found = []
    wanted = [item for item in fields(kind) if item.name != 'values']
    for item, value in zip(wanted, [*header.tolist(), *[math.nan] * len(wanted)]):
        if math.isnan(value) and item.default is not MISSING:
            value = item.default
        found.append(whole_number(item.name.replace('_', ' '), value)
                     if item.type in ('int', int) else value)
    return found


def _with_fields(values: FloatArray, names: tuple[str, ...], known: tuple[str, ...]
                 ) -> FloatArray:
    """
    Return the known fields, by name where there are names, NaN for those that are missing.

    Without names there have to be those of the first version.
    """
    if names == known:
        return values
    if not names and values.shape[-1] < _FIRST_FIELDS.get(known, len(known)):
        raise MessageError(f'{values.shape[-1]} fields received, {len(known)} expected: '
                           f'{", ".join(known)}')
    found = np.full((*values.shape[:-1], len(known)), np.nan)
    for place, name in enumerate(names or known[:values.shape[-1]]):
        if name in known:
            found[..., known.index(name)] = values[..., place]
    return found


def decode_average(kind: str, message: Float64MultiArray) -> AverageMessage:
    """Decode an average's array, of this or another version; `kind` is the topic's name."""
    header, values, names = decode_array(message, _AVERAGE_LABELS[kind], None)
    if kind in _AVERAGE_FIELDS:
        values = _with_fields(values, names, _AVERAGE_FIELDS[kind])
        names = _AVERAGE_FIELDS[kind]
    return AverageMessage(AverageHeader(*_numbers(AverageHeader, header)), values, names)


def encode_geometry(geometry: MarkOffsets) -> Float64MultiArray:
    """Encode where the marks of a target stand."""
    return encode_array(
        np.stack((geometry.angles, geometry.standard_errors), axis=1),
        ('mark', f'field:{",".join(GEOMETRY_FIELDS)}'), (geometry.revolutions,))


def decode_geometry(message: Float64MultiArray) -> MarkOffsets:
    """Decode where the marks of a target stand."""
    header, values, names = decode_array(message, ('mark', 'field'), None)
    angles, errors = _with_fields(values, names, GEOMETRY_FIELDS).T
    return MarkOffsets(angles, errors, header.tolist()[0] if header.size else math.nan)


def _encode_orders(message: PredictionMessage | ResidualMessage, known: tuple[str, ...]
                   ) -> Float64MultiArray:
    return encode_array(message.values, ('order', f'field:{",".join(known)}'),
                        astuple(message)[1:])


def encode_prediction(prediction: PredictionMessage) -> Float64MultiArray:
    """Encode a prediction."""
    return _encode_orders(prediction, PREDICTION_FIELDS)


def decode_prediction(message: Float64MultiArray) -> PredictionMessage:
    """Decode a prediction."""
    header, values, names = decode_array(message, ('order', 'field'), None)
    return PredictionMessage(_with_fields(values, names, PREDICTION_FIELDS),
                             *_numbers(PredictionMessage, header))


def encode_residual(residual: ResidualMessage) -> Float64MultiArray:
    """Encode a residual."""
    return _encode_orders(residual, RESIDUAL_FIELDS)


def decode_residual(message: Float64MultiArray) -> ResidualMessage:
    """Decode a residual."""
    header, values, names = decode_array(message, ('order', 'field'), None)
    return ResidualMessage(_with_fields(values, names, RESIDUAL_FIELDS),
                           *_numbers(ResidualMessage, header))
