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
The layouts of the input messages, which are decoded here to arrays, live and from bags.

Only the fields of a message are used, so that messages of rclpy and of `rosbags` are decoded by
the same rules. A message with another layout raises `MessageError`.
"""

from collections import deque
from collections.abc import Callable
import math
from typing import Any

import numpy as np
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.errors import MessageError, ParameterError
from sa_jitter_ros.samples import check_rate, check_samples, check_times, SampleBlock

FLOAT64 = 'std_msgs/Float64MultiArray'
FLOAT32 = 'std_msgs/Float32MultiArray'
IMU = 'sensor_msgs/Imu'
TIME_REFERENCE = 'sensor_msgs/TimeReference'
INDEX_BASE = 1 << 24  # largest power of two below which every integer is a float32
_LARGEST = 1 << 32  # elements, also of the shape of an empty array: a limit of numpy
TIME_TOLERANCE = 0.01  # s; a clock that jumps back by more starts a new run
# Delay against the clock, in samples, that jitter of 0.7 samples does not cause.
_LOSS = 0.75
# Fraction of a deviation by which the clock is corrected: at a rate 3 % off it lags by 0.6
# samples.
_FOLLOW = 0.05
# Sum of delays, in variances, that white jitter causes once in 1e8 stamps.
_EVIDENCE = 13.0
# Stamps that are compared with the rate, and the least number of them; the relative difference of
# rates that loses no sample; a usual interval, in mean ones, that shows bursts.
_COMPARED, _ENOUGH = 256, 64
_SAME = 0.03
_BURST = 0.5
_PAUSES = 2


def decode_array(message: Any, labels: tuple[str, ...], header_size: int | None
                 ) -> tuple[FloatArray, FloatArray, tuple[str, ...]]:
    """
    Decode a MultiArray.

    Returns header elements, values in the shape of the layout, names of the last dimension. There
    may be more header elements than `header_size`, as in newer versions; these are left out. With
    None there may be any number, and all are returned.
    Raises `MessageError` if labels, number of dimensions, size or offset do not fit.

    >>> from types import SimpleNamespace as Message
    >>> dims = [Message(label='channel', size=1), Message(label='sample', size=2)]
    >>> message = Message(layout=Message(dim=dims, data_offset=1), data=[7.0, 0.1, 0.2])
    >>> decode_array(message, ('channel', 'sample'), header_size=1)
    (array([7.]), array([[0.1, 0.2]]), ())
    """
    layout, data = message.layout, np.asarray(message.data)
    got = tuple(dim.label.split(':', 1)[0] for dim in layout.dim)
    if len(got) != len(labels) or any(a not in ('', b) for a, b in zip(got, labels)):
        raise MessageError(f'dimensions {list(got)} received, {list(labels)} expected: '
                           'label layout.dim with the expected names')
    shape = tuple(dim.size for dim in layout.dim)
    offset = layout.data_offset
    header_size = offset if header_size is None else header_size
    if offset < header_size:
        raise MessageError(f'data_offset {offset} received, {header_size} expected: put that many '
                           'header elements in front of the array')
    if math.prod(shape) != data.size - offset or math.prod(filter(None, shape)) > _LARGEST:
        raise MessageError(
            f'layout {"x".join(map(str, shape))} behind {offset} header elements does not fit '
            f'{data.size} elements: make layout and data agree')
    label = layout.dim[-1].label if layout.dim else ''
    names = tuple(label.split(':', 1)[1].split(',')) if ':' in label else ()
    if names and len(names) != shape[-1]:
        raise MessageError(f'{len(names)} names for {shape[-1]} elements in "{label}": give a '
                           'name for each element, or none')
    return data[:header_size].astype(np.float64), data[offset:].reshape(shape), names


def whole_number(name: str, value: float) -> int:
    """Return a count that a message contains as a float; raises `MessageError`."""
    if not (math.isfinite(value) and 0.0 <= value <= 2.0**53 and value == math.floor(value)):
        raise MessageError(f'{name} is {value}: send a whole number >= 0')
    return int(value)


def decode_time(seconds: int, nanoseconds: int) -> float:
    """Return the time (s) of a ROS time; negative `seconds` are allowed."""
    return seconds + 1e-9 * nanoseconds


def encode_time(time: float) -> tuple[int, int]:
    """
    Return seconds and nanoseconds of a ROS time; `MessageError` beyond the range of its int32.

    >>> encode_time(-0.25), decode_time(-1, 750_000_000)
    ((-1, 750000000), -0.25)
    """
    if math.isfinite(time):
        second = math.floor(time)
        carry, nanosecond = divmod(round((time - second) * 1e9), 10**9)
        if -2**31 <= second + carry < 2**31:
            return second + carry, nanosecond
    raise MessageError(f'pulse time {time} s: a sensor_msgs/TimeReference holds times from -2^31 '
                       'to 2^31 s; set tach_type to std_msgs/Float64MultiArray')


def decode_pulse_reference(message: Any) -> tuple[FloatArray, str]:
    """Return the pulse time (1,) in s and the name of the keyphasor."""
    stamp = message.time_ref
    return np.array([decode_time(stamp.sec, stamp.nanosec)]), str(message.source)


def decode_pulse_array(message: Any) -> FloatArray:
    """Return the pulse times (n,) in s."""
    if not message.layout.dim and message.layout.data_offset == 0:
        times = np.array(message.data, dtype=np.float64)
    else:
        times = decode_array(message, ('pulse',), 0)[1].astype(np.float64)
    check_times('pulse time', times, MessageError)
    return times


class StampCounter:
    """
    Counts samples by their stamps; a lasting step of the stamps by whole samples is a loss.

    The stamps are compared with a clock that follows them slowly. A rate that differs from
    `sample_rate` (Hz) by up to 3 % is therefore no loss, and neither is jitter of up to 0.7
    samples, because the next stamp is early. With steady stamps a loss is found at once. With
    noisy stamps it takes several stamps (Page's test), and the gap is placed later by as many
    samples. `restarts` counts jumps back, after which samples are counted from 0 again.

    >>> counter = StampCounter(100.0)
    >>> [counter.index(time) for time in (0.0, 0.01, 0.02, 0.05, 0.06)]
    [0, 1, 2, 5, 6]
    >>> counter = StampCounter(400.0)
    >>> for number in range(100):
    ...     _ = counter.index(number / 150.0)
    >>> counter.doubt()
    'its stamps come 150 times a second, sample_rate declares 400 Hz: set sample_rate to 150'
    """

    def __init__(self, sample_rate: float) -> None:
        self.restarts = 0
        self._rate = sample_rate
        self._stamps: deque[float] = deque(maxlen=_COMPARED)  # the latest
        self._start(0.0)

    def _start(self, time: float) -> None:
        self._stamps.clear()
        self._index, self._expected = 0, time
        self._late, self._variance = 0.0, 0.01  # samples and samples^2, against the clock
        self._surplus, self._doubtful = 0.0, 0  # lateness, and of how many stamps

    def index(self, time: float) -> int:
        """Return the index of the next sample, stamped `time` (s)."""
        if not self._stamps:
            self._start(time)
        elif time < self._stamps[-1] - max(TIME_TOLERANCE, 1.0 / self._rate):
            self.restarts += 1
            self._start(time)
        late = (time - self._expected) * self._rate
        self._surplus = max(0.0, self._surplus + late - _LOSS)
        self._doubtful = self._doubtful + 1 if self._surplus else 0
        lost = 0
        if self._surplus > _EVIDENCE * self._variance:
            lost = max(1, round(_LOSS + self._surplus / self._doubtful))
            self._surplus, self._doubtful = 0.0, 0
        gain = max(_FOLLOW, 1.0 / (self._index + 1.0))
        # From differences, so that another rate is no noise; with steps, so that bursts are noise.
        self._variance += gain * (0.5 * (late - self._late)**2 - self._variance)
        late -= lost
        found = self._index + lost
        self._index, self._late = found + 1, late
        self._stamps.append(time)
        self._expected += (lost + 1 + gain * late) / self._rate
        return found

    def doubt(self) -> str:
        """Return why the stamps do not fit the rate, '' if they do or are few."""
        if len(self._stamps) < _ENOUGH or not self._stamps[-1] > self._stamps[0]:
            return ''
        intervals = np.diff(self._stamps)
        usual = float(np.median(intervals))
        # The mean without pauses; samples that are lost leave the usual interval as it is.
        mean = float(np.mean(np.sort(intervals)[:-_PAUSES]))
        if abs(usual * self._rate - 1.0) <= _SAME or (
                abs(mean * self._rate - 1.0) <= _SAME and usual >= _BURST * mean):
            return ''
        declared = f'sample_rate declares {self._rate:.4g} Hz'
        if usual < _BURST * mean:
            return (f'its stamps come in bursts, {1.0 / np.mean(intervals):.4g} a second in the '
                    f'mean, {declared}: stamp each sample with the time at which it was measured')
        measured = f'{1.0 / mean:.4g}'
        return (f'its stamps come {measured} times a second, {declared}: set sample_rate to '
                f'{measured}')


class SampleDecoder:
    """
    Decode `vibration` or `tach_waveform` messages of one type to `SampleBlock`.

    `kind` is `FLOAT64`, `FLOAT32` or `IMU`, `imu_axis` one or more of x, y, z; `sample_rate` (Hz,
    0 for unknown) and `start_time` (s) are used if the message does not contain them. Messages
    without header are counted from `start_time`; `counted` is True if there were such messages.
    Imu messages are counted by their stamps; `restarts` is how often these jumped back. Raises
    `ParameterError` for other axes, `MessageError` for a malformed message.
    """

    def __init__(self, kind: str, *, sample_rate: float, start_time: float = 0.0,
                 imu_axis: str = 'z') -> None:
        if not imu_axis or not set(imu_axis) <= set('xyz') or len(set(imu_axis)) < len(imu_axis):
            raise ParameterError(f'imu_axis is {imu_axis!r}: give different ones of x, y and z')
        decoders: dict[str, Callable[[Any], SampleBlock]] = {
            FLOAT64: self._float64, FLOAT32: self._float32, IMU: self._imu}
        self._decode, self._bounded = decoders[kind], kind == FLOAT32
        self._rate, self._start_time = sample_rate, start_time
        self._axes = tuple(imu_axis)
        self._next_index = 0
        self._stamps, self._imu_index = StampCounter(sample_rate), 0
        self._imu_last: tuple[float, ...] = ()
        self.counted = False

    @property
    def restarts(self) -> int:
        """Return how often the stamps of Imu messages jumped back."""
        return self._stamps.restarts

    @property
    def doubt(self) -> str:
        """Return why the stamps of Imu messages do not fit `sample_rate`, '' if they do."""
        return self._stamps.doubt()

    def decode(self, message: Any) -> SampleBlock:
        """Return the block of samples in a message."""
        block = self._decode(message)
        check_times('time of the first sample', block.start_time, MessageError)
        if not self._bounded:  # a float32 is below the limit
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
                           whole_number('index of the first sample', float(header[2])))

    def _float32(self, message: Any) -> SampleBlock:
        if message.layout.data_offset == 0:
            return self._count(_samples(message, 0)[1])
        if message.layout.data_offset == 3:
            raise MessageError('data_offset 3 received, 2 expected: the header of '
                               'Float64MultiArray has 3 elements, that of Float32MultiArray 2')
        header, samples = _samples(message, 2)
        high, low = (whole_number('index of the first sample', float(item)) for item in header)
        index = whole_number('index of the first sample', high * INDEX_BASE + low)
        rate = self._known_rate()
        return SampleBlock(samples, self._start_time + index / rate, rate, index)

    def _imu(self, message: Any) -> SampleBlock:
        rate = self._known_rate()
        time = decode_time(message.header.stamp.sec, message.header.stamp.nanosec)
        vector = message.linear_acceleration
        values = tuple(float(getattr(vector, axis)) for axis in self._axes)
        if (time, *values) != self._imu_last:  # a repeated message keeps its index
            self._imu_index = self._stamps.index(time)
        self._imu_last = time, *values
        return SampleBlock(np.array(values)[:, None], time, rate, self._imu_index)


def _samples(message: Any, header_size: int) -> tuple[FloatArray, FloatArray]:
    """Return header and channel x sample array of a vibration or waveform message."""
    if message.layout.dim:
        header, values, _ = decode_array(message, ('channel', 'sample'), header_size)
    else:  # an empty layout means one channel
        data, offset = np.asarray(message.data), message.layout.data_offset
        if offset < header_size:
            raise MessageError(f'data_offset {offset} received, {header_size} expected: put that '
                               'many header elements in front of the array')
        if data.size < offset:
            raise MessageError(f'{data.size} elements received, at least {offset} header '
                               'elements expected: send the header, or data_offset 0')
        header, values = data[:header_size].astype(np.float64), data[offset:][None, :]
    if values.size == 0:
        raise MessageError(f'empty block of {values.shape[0]} channels x {values.shape[1]} '
                           'samples: send at least one sample of one channel')
    return header, np.asarray(values, dtype=np.float64)
