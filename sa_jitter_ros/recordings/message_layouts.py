"""
The layouts of the input messages: the one place where they become arrays, live and from bags.

Messages are known by their fields alone, so that those of rclpy and those of `rosbags` are
decoded by the same rules. What does not follow a layout raises `MessageError`.
"""

from collections.abc import Callable
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.errors import MessageError, ParameterError
from sa_jitter_ros.recordings.limits import check_rate, check_samples, check_times
from sa_jitter_ros.samples import SampleBlock

FloatArray = NDArray[np.float64]

FLOAT64 = 'std_msgs/Float64MultiArray'
FLOAT32 = 'std_msgs/Float32MultiArray'
IMU = 'sensor_msgs/Imu'
TIME_REFERENCE = 'sensor_msgs/TimeReference'
INDEX_BASE = 1 << 24  # largest power of two below which every integer is a float32
_LARGEST = 1 << 32  # elements, of an empty array as well: numpy knows no larger shapes
TIME_TOLERANCE = 0.01  # s; a clock that jumps back by more starts a new run
LOSS = 0.75  # samples later than the clock that is followed: more than jitter of 0.7 brings
FOLLOW = 0.05  # share of a deviation that the clock takes over: at 3 % of another rate it lags 0.6
EVIDENCE = 13.0  # of lateness, in variances: white jitter brings as much once in 1e8 stamps


def decode_array(message: Any, labels: tuple[str, ...],
                 header_size: int) -> tuple[FloatArray, FloatArray, tuple[str, ...]]:
    """
    Decode a MultiArray.

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


def whole(name: str, value: float) -> int:
    """Return a count that a message holds as a float; raises `MessageError`."""
    if not (math.isfinite(value) and 0.0 <= value <= 2.0**53 and value == math.floor(value)):
        raise MessageError(f'{name} is {value}: send a whole number >= 0')
    return int(value)


def decode_time(seconds: int, nanoseconds: int) -> float:
    """Seconds of a ROS time; negative `seconds` are legal."""
    return seconds + 1e-9 * nanoseconds


def encode_time(time: float) -> tuple[int, int]:
    """Seconds and nanoseconds of a ROS time; `MessageError` where its int32 cannot hold it."""
    if math.isfinite(time):
        second = math.floor(time)
        carry, nanosecond = divmod(round((time - second) * 1e9), 10**9)
        if -2**31 <= second + carry < 2**31:
            return second + carry, nanosecond
    raise MessageError(f'pulse time {time} s: a sensor_msgs/TimeReference holds times from -2^31 '
                       'to 2^31 s; set tach_type to std_msgs/Float64MultiArray')


def decode_pulse_reference(message: Any) -> tuple[FloatArray, str]:
    """Pulse time (1,) in s and the keyphasor's name."""
    stamp = message.time_ref
    return np.array([decode_time(stamp.sec, stamp.nanosec)]), str(message.source)


def decode_pulse_array(message: Any) -> FloatArray:
    """Pulse times (n,) in s."""
    if not message.layout.dim and message.layout.data_offset == 0:
        times = np.array(message.data, dtype=np.float64)
    else:
        times = decode_array(message, ('pulse',), 0)[1].astype(np.float64)
    check_times('pulse time', times, MessageError)
    return times


class StampCounter:
    """
    Counts samples by their stamps; a loss is a lasting step of the stamps by whole samples.

    The stamps are compared with a clock that follows them slowly, so that a source whose rate is
    up to 3 % off `sample_rate` (Hz) loses nothing, and neither does jitter of up to 0.7 samples,
    as the next stamp comes early. Where stamps are steady, a loss is seen at once; where they are
    noisy, it takes the evidence of some stamps (Page's test), and the gap stands that much later.
    `restarts` counts jumps back, from which on samples are counted anew.
    """

    def __init__(self, sample_rate: float) -> None:
        self.restarts = 0
        self._rate = sample_rate
        self._last: float | None = None  # stamp
        self._start(0.0)

    def _start(self, time: float) -> None:
        self._index, self._expected = 0, time
        self._late, self._variance = 0.0, 0.01  # samples and samples^2, against the clock
        self._surplus, self._doubtful = 0.0, 0  # lateness, and of how many stamps

    def index(self, time: float) -> int:
        """Return the index of the next sample, stamped `time` (s)."""
        if self._last is None:
            self._start(time)
        elif time < self._last - max(TIME_TOLERANCE, 1.0 / self._rate):
            self.restarts += 1
            self._start(time)
        late = (time - self._expected) * self._rate
        self._surplus = max(0.0, self._surplus + late - LOSS)
        self._doubtful = self._doubtful + 1 if self._surplus else 0
        lost = 0
        if self._surplus > EVIDENCE * self._variance:
            lost = max(1, round(LOSS + self._surplus / self._doubtful))
            self._surplus, self._doubtful = 0.0, 0
        gain = max(FOLLOW, 1.0 / (self._index + 1.0))
        # Of differences, as another rate is no noise; with steps, so that bursts are no losses.
        self._variance += gain * (0.5 * (late - self._late)**2 - self._variance)
        late -= lost
        found = self._index + lost
        self._index, self._late, self._last = found + 1, late, time
        self._expected += (lost + 1 + gain * late) / self._rate
        return found


class SampleDecoder:
    """
    Decode `vibration` or `tach_waveform` messages of one type to `SampleBlock`.

    `kind` is `FLOAT64`, `FLOAT32` or `IMU`, `imu_axis` one or more of x, y, z; `sample_rate` (Hz,
    0 for unknown) and `start_time` (s) serve where the message does not carry them. Messages
    without header are counted from `start_time`; `counted` tells that this happened. Imu messages
    are counted by their stamps; `restarts` tells how often these jumped back. Raises
    `ParameterError` for other axes, `MessageError` on a malformed message.
    """

    def __init__(self, kind: str, *, sample_rate: float, start_time: float = 0.0,
                 imu_axis: str = 'z') -> None:
        if not imu_axis or not set(imu_axis) <= set('xyz') or len(set(imu_axis)) < len(imu_axis):
            raise ParameterError(f'imu_axis is {imu_axis!r}: give different ones of x, y and z')
        decoders: dict[str, Callable[[Any], SampleBlock]] = {
            FLOAT64: self._float64, FLOAT32: self._float32, IMU: self._imu}
        self._decode = decoders[kind]
        self._rate, self._start_time = sample_rate, start_time
        self._axes = tuple(imu_axis)
        self._next_index = 0
        self._stamps, self._imu_index = StampCounter(sample_rate), 0
        self._imu_last: tuple[float, ...] = ()
        self.counted = False

    @property
    def restarts(self) -> int:
        """How often the stamps of Imu messages jumped back."""
        return self._stamps.restarts

    def decode(self, message: Any) -> SampleBlock:
        """Return the block that a message holds."""
        block = self._decode(message)
        check_times('time of the first sample', block.start_time, MessageError)
        check_samples(block.samples, MessageError)
        return block

    def _known_rate(self) -> float:
        if not self._rate > 0.0:
            raise MessageError(f'sample_rate is {self._rate} Hz and the message carries none: '
                               'set the parameter sample_rate')
        check_rate('sample_rate', self._rate, MessageError)
        return self._rate

    def _count(self, samples: FloatArray) -> SampleBlock:
        rate, index = self._known_rate(), self._next_index
        self._next_index += samples.shape[1]
        self.counted = True
        return SampleBlock(samples, self._start_time + index / rate, rate, index)

    def _float64(self, message: Any) -> SampleBlock:
        if message.layout.data_offset == 0:
            return self._count(_samples(message, 0)[1])
        header, samples = _samples(message, 3)
        time, rate = float(header[0]), float(header[1])
        if not (math.isfinite(time) and math.isfinite(rate) and rate > 0.0):
            raise MessageError(f'header time {time} s, rate {rate} Hz: send a finite time and a '
                               'positive rate')
        check_rate('sampling rate in the header', rate, MessageError)
        return SampleBlock(samples, time, rate,
                           whole('index of the first sample', float(header[2])))

    def _float32(self, message: Any) -> SampleBlock:
        if message.layout.data_offset == 0:
            return self._count(_samples(message, 0)[1])
        header, samples = _samples(message, 2)
        high, low = (whole('index of the first sample', float(item)) for item in header)
        index = whole('index of the first sample', high * INDEX_BASE + low)
        rate = self._known_rate()
        return SampleBlock(samples, self._start_time + index / rate, rate, index)

    def _imu(self, message: Any) -> SampleBlock:
        rate = self._known_rate()
        time = decode_time(message.header.stamp.sec, message.header.stamp.nanosec)
        vector = message.linear_acceleration
        values = tuple(float(getattr(vector, axis)) for axis in self._axes)
        if (time, *values) != self._imu_last:  # a repeat keeps its index
            self._imu_index = self._stamps.index(time)
        self._imu_last = time, *values
        return SampleBlock(np.array(values)[:, None], time, rate, self._imu_index)


def _samples(message: Any, header_size: int) -> tuple[FloatArray, FloatArray]:
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
