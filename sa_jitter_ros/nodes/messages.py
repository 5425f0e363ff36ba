"""
Messages to arrays and back: the only module that knows message layouts.

Inputs decode to `SampleBlock` and pulse times, results are frozen dataclasses with an `encode_*`
and a `decode_*` function each; other Python nodes can import them. A message that does not follow
the layout raises `MessageError`. Arrays are in C order; infinities are never published (NaN
instead).
"""

import array
from dataclasses import astuple, dataclass
import math
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.averaging.timeline import SampleBlock
from sa_jitter_ros.errors import MessageError, ParameterError
from sa_jitter_ros.recordings.stamp_counter import StampCounter
from sensor_msgs.msg import Imu, TimeReference
from std_msgs.msg import Float32MultiArray, Float64MultiArray, MultiArrayDimension

FloatArray = NDArray[np.float64]
ArrayMessage = TypeVar('ArrayMessage', Float64MultiArray, Float32MultiArray)

AMPLITUDE_FIELDS = (
    'order', 'raw_amplitude', 'raw_phase', 'corrected_amplitude', 'corrected_phase',
    'attenuation', 'attenuation_standard_error', 'noise_standard_deviation')
PULSE_ERROR_FIELDS = ('time', 'error', 'standard_error')
PREDICTION_FIELDS = (
    'order', 'mean_attenuation', 'variance', 'standard_deviation',
    'quantile_05', 'quantile_50', 'quantile_95')
RESIDUAL_FIELDS = ('order', 'observed', 'predicted', 'residual', 'standard_error', 'z')
SAMPLE_TYPES: dict[str, type] = {
    'std_msgs/Float64MultiArray': Float64MultiArray,
    'std_msgs/Float32MultiArray': Float32MultiArray,
    'sensor_msgs/Imu': Imu,
}
PULSE_TYPES: dict[str, type] = {
    'sensor_msgs/TimeReference': TimeReference,
    'std_msgs/Float64MultiArray': Float64MultiArray,
}
INDEX_BASE = 1 << 24  # largest power of two below which every integer is a float32
_LARGEST = 1 << 32  # elements, of an empty array as well: numpy knows no larger shapes


@dataclass(frozen=True)
class AverageHeader:
    """What an average covers; times in s, `mean_trigger_speed` of the tach shaft in Hz."""

    start_time: float
    end_time: float
    sequence: int
    trigger_cycles: int
    fundamental_cycles: int
    mean_trigger_speed: float


@dataclass(frozen=True)
class AverageMessage:
    """
    One array about one average.

    `values` is channel x angle for a synchronous average, channel x order x field for order
    amplitudes (`AMPLITUDE_FIELDS`), pulse x field for pulse errors (`PULSE_ERROR_FIELDS`) and
    channel x indicator for condition indicators; `names` are the fields or indicators.
    """

    header: AverageHeader
    values: FloatArray
    names: tuple[str, ...] = ()


@dataclass(frozen=True)
class PredictionMessage:
    """Statistics of each order, order x `PREDICTION_FIELDS`, and what they hold for."""

    values: FloatArray
    trigger_speed: float
    keyphasor_rate: float
    trigger_cycles: int
    ratio: float
    pulse_error_standard_deviation: float
    noise_standard_deviation: float


@dataclass(frozen=True)
class ResidualMessage:
    """Observed against predicted, order x `RESIDUAL_FIELDS`, and the summary."""

    values: FloatArray
    acquisitions: int
    chi2_per_dof: float
    p_value: float
    rms: float


def known_type(parameter: str, name: str, types: dict[str, type]) -> str:
    """Key of `types` for a message type as users write it; raises `ParameterError`."""
    key = name.replace('/msg/', '/')
    if key not in types:
        raise ParameterError(f'{parameter} is {name!r}: give one of {", ".join(types)}')
    return key


def _build(message: ArrayMessage, typecode: str, values: NDArray[np.floating[Any]],
           labels: tuple[str, ...], header: tuple[float, ...]) -> ArrayMessage:
    """Fill a message with an array whose dimensions are named `labels`, behind its header."""
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
    """Encode a result: dimensions named `labels`, `header` elements in front, no infinities."""
    finite = tuple(item if math.isfinite(item) else math.nan for item in map(float, header))
    values = np.where(np.isinf(values), np.nan, values)
    return _build(Float64MultiArray(), 'd', values, labels, finite)


def decode_array(message: Float64MultiArray | Float32MultiArray, labels: tuple[str, ...],
                 header_size: int) -> tuple[FloatArray, FloatArray, tuple[str, ...]]:
    """
    Decode an array.

    Returns header elements, values shaped as the layout says, names of the last dimension.
    Raises `MessageError` where label, number of dimensions, size or offset do not fit.
    """
    layout, data = message.layout, np.asarray(message.data)
    got = tuple(dim.label.split(':', 1)[0] for dim in layout.dim)
    if len(got) != len(labels) or any(a not in ('', b) for a, b in zip(got, labels)):
        raise MessageError(f'dimensions {list(got)} received, {list(labels)} expected: '
                           'label layout.dim as the interface says')
    shape = tuple(dim.size for dim in layout.dim)
    if layout.data_offset != header_size:
        raise MessageError(f'data_offset {layout.data_offset} received, {header_size} expected: '
                           'put exactly that many header elements in front')
    if math.prod(shape) != data.size - header_size or math.prod(filter(None, shape)) > _LARGEST:
        raise MessageError(
            f'layout {"x".join(map(str, shape))} behind {header_size} header elements does not '
            f'fit {data.size} elements: send the size that the layout says')
    label = layout.dim[-1].label if layout.dim else ''
    names = tuple(label.split(':', 1)[1].split(',')) if ':' in label else ()
    if names and len(names) != shape[-1]:
        raise MessageError(f'{len(names)} names for {shape[-1]} elements in "{label}"')
    return data[:header_size].astype(np.float64), data[header_size:].reshape(shape), names


def _whole(name: str, value: float) -> int:
    if not (math.isfinite(value) and 0.0 <= value <= 2.0**53 and value == math.floor(value)):
        raise MessageError(f'{name} is {value}: send a whole number >= 0')
    return int(value)


def _block_samples(message: Float64MultiArray | Float32MultiArray,
                   header_size: int) -> tuple[FloatArray, FloatArray]:
    """Header and channel x sample array of a vibration or waveform message."""
    if message.layout.dim:
        header, values, _ = decode_array(message, ('channel', 'sample'), header_size)
    else:  # an empty layout means one channel
        data = np.asarray(message.data)
        if message.layout.data_offset != header_size:
            raise MessageError(f'data_offset {message.layout.data_offset} received, '
                               f'{header_size} expected')
        if data.size < header_size:
            raise MessageError(f'{data.size} elements cannot hold {header_size} header elements')
        header, values = data[:header_size].astype(np.float64), data[header_size:][None, :]
    if values.size == 0:
        raise MessageError(f'empty block of {values.shape[0]} channels x {values.shape[1]} '
                           'samples: send at least one sample of one channel')
    return header, np.asarray(values, dtype=np.float64)


class SampleDecoder:
    """
    Decode `vibration` or `tach_waveform` messages of one type into `SampleBlock`s.

    `kind` is a key of `SAMPLE_TYPES`, `imu_axis` one or more of x, y, z; `sample_rate` (Hz) and
    `start_time` (s) serve where the message does not carry them. Messages without header are
    counted from `start_time`; `counted` tells that this happened. Raises `ParameterError` for
    other axes, `MessageError` on a malformed message.
    """

    def __init__(self, kind: str, *, sample_rate: float, start_time: float = 0.0,
                 imu_axis: str = 'z') -> None:
        if not imu_axis or not set(imu_axis) <= set('xyz') or len(set(imu_axis)) < len(imu_axis):
            raise ParameterError(f'imu_axis is {imu_axis!r}: give different ones of x, y and z')
        self._decode = dict(zip(SAMPLE_TYPES, (self._float64, self._float32, self._imu)))[kind]
        self._rate, self._start_time = sample_rate, start_time
        self._axes = tuple(imu_axis)
        self._next_index = 0
        self._stamps, self._imu_index = StampCounter(sample_rate), 0
        self._imu_last: tuple[float, ...] = ()
        self.counted = False

    def decode(self, message: Float64MultiArray | Float32MultiArray | Imu) -> SampleBlock:
        """Return the block that a message holds."""
        return self._decode(message)

    def _known_rate(self) -> float:
        if not self._rate > 0.0:
            raise MessageError(f'sample_rate is {self._rate} Hz and the message carries none: '
                               'set the parameter sample_rate')
        return self._rate

    def _count(self, samples: FloatArray) -> SampleBlock:
        rate, index = self._known_rate(), self._next_index
        self._next_index += samples.shape[1]
        self.counted = True
        return SampleBlock(samples, self._start_time + index / rate, rate, index)

    def _float64(self, message: Float64MultiArray) -> SampleBlock:
        if message.layout.data_offset == 0:
            return self._count(_block_samples(message, 0)[1])
        header, samples = _block_samples(message, 3)
        time, rate = float(header[0]), float(header[1])
        if not (math.isfinite(time) and math.isfinite(rate) and rate > 0.0):
            raise MessageError(f'header time {time} s, rate {rate} Hz: send a finite time and a '
                               'positive rate')
        index = _whole('index of the first sample', float(header[2]))
        return SampleBlock(samples, time, rate, index)

    def _float32(self, message: Float32MultiArray) -> SampleBlock:
        if message.layout.data_offset == 0:
            return self._count(_block_samples(message, 0)[1])
        header, samples = _block_samples(message, 2)
        high, low = (_whole('index of the first sample', float(item)) for item in header)
        index = _whole('index of the first sample', high * INDEX_BASE + low)
        rate = self._known_rate()
        return SampleBlock(samples, self._start_time + index / rate, rate, index)

    def _imu(self, message: Imu) -> SampleBlock:
        rate = self._known_rate()
        time = decode_time(message.header.stamp.sec, message.header.stamp.nanosec)
        vector = message.linear_acceleration
        values = tuple(float(getattr(vector, axis)) for axis in self._axes)
        if (time, *values) != self._imu_last:  # a repeat keeps its index
            self._imu_index = self._stamps.index(time)
        self._imu_last = time, *values
        return SampleBlock(np.array(values)[:, None], time, rate, self._imu_index)


def encode_samples(block: SampleBlock) -> Float64MultiArray:
    """Encode a block as Float64MultiArray with header [time, sample rate, index]."""
    return _build(Float64MultiArray(), 'd', block.samples, ('channel', 'sample'),
                  (block.start_time, block.sample_rate, float(block.index)))


def encode_samples_float32(block: SampleBlock) -> Float32MultiArray:
    """Encode a block as Float32MultiArray with header [index div 2^24, index mod 2^24]."""
    high, low = divmod(block.index, INDEX_BASE)
    return _build(Float32MultiArray(), 'f', block.samples, ('channel', 'sample'),
                  (float(high), float(low)))


def decode_time(seconds: int, nanoseconds: int) -> float:
    """Seconds of a ROS time; negative `seconds` are legal."""
    return seconds + 1e-9 * nanoseconds


def decode_pulse_reference(message: TimeReference) -> tuple[FloatArray, str]:
    """Pulse time (1,) in s and the keyphasor's name."""
    stamp = message.time_ref
    return np.array([decode_time(stamp.sec, stamp.nanosec)]), str(message.source)


def decode_pulse_array(message: Float64MultiArray) -> FloatArray:
    """Pulse times (n,) in s."""
    if not message.layout.dim and message.layout.data_offset == 0:
        return np.array(message.data, dtype=np.float64)
    return decode_array(message, ('pulse',), 0)[1].astype(np.float64)


def encode_pulse_reference(time: float, source: str) -> TimeReference:
    """Encode one pulse; header.stamp repeats its time so that tools can plot it."""
    message = TimeReference(source=source)
    second = math.floor(time)
    nanosecond = round((time - second) * 1e9)
    for stamp in (message.time_ref, message.header.stamp):
        stamp.sec, stamp.nanosec = int(second + nanosecond // 10**9), int(nanosecond % 10**9)
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
}


def encode_average(kind: str, average: AverageMessage) -> Float64MultiArray:
    """Encode an average's array; `kind` is the topic's name."""
    labels = _AVERAGE_LABELS[kind]
    if average.names:
        labels = (*labels[:-1], f'{labels[-1]}:{",".join(average.names)}')
    return encode_array(average.values, labels, astuple(average.header))


_AVERAGE_FIELDS = {'order_amplitude': AMPLITUDE_FIELDS, 'pulse_error': PULSE_ERROR_FIELDS}


def _with_fields(values: FloatArray, fields: tuple[str, ...]) -> FloatArray:
    if values.shape[-1] != len(fields):
        raise MessageError(f'{values.shape[-1]} fields received, {len(fields)} expected: '
                           f'{", ".join(fields)}')
    return values


def decode_average(kind: str, message: Float64MultiArray) -> AverageMessage:
    """Decode an average's array; `kind` is the topic's name."""
    header, values, names = decode_array(message, _AVERAGE_LABELS[kind], 6)
    if kind in _AVERAGE_FIELDS:
        values, names = _with_fields(values, _AVERAGE_FIELDS[kind]), _AVERAGE_FIELDS[kind]
    start, end, sequence, cycles, fundamental, speed = (float(item) for item in header)
    return AverageMessage(
        AverageHeader(start, end, _whole('sequence', sequence), _whole('trigger cycles', cycles),
                      _whole('fundamental cycles', fundamental), speed),
        values, names)


def encode_prediction(prediction: PredictionMessage) -> Float64MultiArray:
    """Encode a prediction."""
    return encode_array(prediction.values, ('order', f'field:{",".join(PREDICTION_FIELDS)}'),
                        astuple(prediction)[1:])


def decode_prediction(message: Float64MultiArray) -> PredictionMessage:
    """Decode a prediction."""
    header, values, _ = decode_array(message, ('order', 'field'), 6)
    speed, rate, cycles, ratio, pulse_error, noise = (float(item) for item in header)
    return PredictionMessage(_with_fields(values, PREDICTION_FIELDS), speed, rate,
                             _whole('trigger cycles', cycles), ratio, pulse_error, noise)


def encode_residual(residual: ResidualMessage) -> Float64MultiArray:
    """Encode a residual."""
    return encode_array(residual.values, ('order', f'field:{",".join(RESIDUAL_FIELDS)}'),
                        astuple(residual)[1:])


def decode_residual(message: Float64MultiArray) -> ResidualMessage:
    """Decode a residual."""
    header, values, _ = decode_array(message, ('order', 'field'), 4)
    count, chi2, p_value, rms = (float(item) for item in header)
    return ResidualMessage(_with_fields(values, RESIDUAL_FIELDS), _whole('acquisitions', count),
                           chi2, p_value, rms)
