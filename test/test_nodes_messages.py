# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Conversion of messages to arrays and back, for random and for malformed messages."""

from dataclasses import replace
import math

from builtin_interfaces.msg import Time
from hypothesis import given, strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
import numpy as np
import pytest
from sa_jitter_ros.errors import MessageError, ParameterError
from sa_jitter_ros.nodes import messages
from sa_jitter_ros.nodes.messages import (AverageHeader, AverageMessage, PredictionMessage,
                                          ResidualMessage, SampleDecoder)
from sa_jitter_ros.samples import SampleBlock
from sensor_msgs.msg import Imu, TimeReference
from std_msgs.msg import Float32MultiArray, Float64MultiArray, MultiArrayDimension

FINITE = st.floats(allow_nan=False, allow_infinity=False)
TIMES = st.floats(-1e15, 1e15)
SAMPLES = arrays(np.float64, array_shapes(min_dims=2, max_dims=2, max_side=20),
                 elements=st.one_of(st.floats(-1e100, 1e100), st.just(np.nan), st.just(-np.inf)))
FLOAT64, FLOAT32, IMU = messages.SAMPLE_TYPES


@given(SAMPLES, TIMES, st.floats(1e-12, 1e12), st.integers(0, 2**53 - 1))
def test_samples_travel_unchanged(samples, time, rate, index):
    message = messages.encode_samples(SampleBlock(samples, time, rate, index))
    assert [dim.label for dim in message.layout.dim] == ['channel', 'sample']
    # as std_msgs documents: a stride counts the elements of its dimension and all below
    assert [dim.stride for dim in message.layout.dim] == [samples.size, samples.shape[1]]
    assert message.layout.data_offset == 3
    block = SampleDecoder(FLOAT64, sample_rate=0.0).decode(message)
    np.testing.assert_array_equal(block.samples, samples)
    assert (block.start_time, block.sample_rate, block.index) == (time, rate, index)


@given(arrays(np.float32, (2, 5), elements=st.floats(-1e6, 1e6, width=32)),
       st.integers(0, 2**48 - 1))
def test_float32_carries_any_index(samples, index):
    message = messages.encode_samples_float32(
        SampleBlock(samples.astype(np.float64), 0.0, 100.0, index))
    assert list(message.data[:2]) == [index // 2**24, index % 2**24]
    block = SampleDecoder(FLOAT32, sample_rate=100.0, start_time=7.0).decode(message)
    np.testing.assert_array_equal(block.samples, samples)
    assert block.samples.dtype == np.float64
    assert (block.index, block.sample_rate) == (index, 100.0)
    assert block.start_time == 7.0 + index / 100.0


@given(st.lists(st.integers(1, 30), min_size=1, max_size=8), st.booleans())
def test_blocks_without_header_are_counted(sizes, named):
    decoder, index = SampleDecoder(FLOAT64, sample_rate=50.0, start_time=-1.0), 0
    assert not decoder.counted
    for size in sizes:
        message = Float64MultiArray(data=[1.0] * size)
        if named:
            message.layout.dim = [MultiArrayDimension(label='channel', size=1, stride=size),
                                  MultiArrayDimension(label='sample', size=size, stride=size)]
        block = decoder.decode(message)
        assert block.samples.shape == (1, size)
        assert (block.index, block.start_time) == (index, -1.0 + index / 50.0)
        index += size
    assert decoder.counted


@pytest.mark.parametrize(('change', 'text'), [
    ({'sample_rate': 5e-324}, r'rate in the header is 5e-324 Hz: must be from 1e-12 to 1e\+12 Hz'),
    ({'sample_rate': 1e-13}, r'rate in the header is 1e-13 Hz'),
    ({'sample_rate': 1.1e12}, 'rate in the header is 1100000000000.0 Hz'),
    ({'start_time': 1e308}, r'time of the first sample is 1e\+308 s: must be within 1e\+15 s'),
    ({'start_time': -1.1e15}, 'time of the first sample is -1100000000000000.0 s'),
    ({'samples': np.array([[0.0, np.nan, -2e100]])}, r'sample of -2e\+100: must be within 1e\+1'),
    ({'samples': np.array([[0.0, 1e308, 1.0]])}, r'sample of 1e\+308: must be within 1e\+100'),
])
def test_numbers_that_no_machine_has_are_refused(change, text):
    block = replace(SampleBlock(np.ones((1, 2)), 0.0, 100.0, 0), **change)
    with pytest.raises(MessageError, match=text):
        SampleDecoder(FLOAT64, sample_rate=0.0).decode(messages.encode_samples(block))


@pytest.mark.parametrize('rate', [5e-324, 1e308])
@pytest.mark.parametrize('kind', [FLOAT32, IMU])
def test_parameter_that_no_machine_has_is_refused(rate, kind):
    message = Imu() if kind == IMU else Float32MultiArray(data=[1.0])
    with pytest.raises(MessageError, match=r'sample_rate is .* Hz: must be from 1e-12 to'):
        SampleDecoder(kind, sample_rate=rate).decode(message)


def test_start_time_that_the_index_leaves_behind_is_refused():
    message = messages.encode_samples_float32(SampleBlock(np.ones((1, 2)), 0.0, 1.0, 2**40))
    with pytest.raises(MessageError, match='time of the first sample is'):
        SampleDecoder(FLOAT32, sample_rate=1e-10).decode(message)


def test_a_message_without_dimensions_is_one_channel():
    message = Float64MultiArray(data=[2.0, 100.0, 30.0, 1.0, 2.0])
    message.layout.data_offset = 3
    block = SampleDecoder(FLOAT64, sample_rate=0.0).decode(message)
    np.testing.assert_array_equal(block.samples, [[1.0, 2.0]])
    assert (block.start_time, block.sample_rate, block.index) == (2.0, 100.0, 30)


def test_labels_may_be_empty_and_name_their_fields():
    message = messages.encode_samples(SampleBlock(np.ones((1, 2)), 0.0, 1.0, 0))
    message.layout.dim[0].label = ''
    message.layout.dim[1].label = 'sample:first,second'
    assert SampleDecoder(FLOAT64, sample_rate=0.0).decode(message).samples.shape == (1, 2)
    message.layout.dim[1].label = 'sample:first,second,third'
    with pytest.raises(MessageError, match='3 names for 2 elements'):
        SampleDecoder(FLOAT64, sample_rate=0.0).decode(message)


@pytest.mark.parametrize('header', [[-1.0, 0.0], [0.5, 0.0], [0.0, math.nan], [math.inf, 0.0]])
def test_float32_index_must_be_a_whole_number(header):
    message = messages.encode_samples_float32(SampleBlock(np.ones((1, 2)), 0.0, 1.0, 0))
    message.data[0], message.data[1] = header
    with pytest.raises(MessageError, match='index of the first sample'):
        SampleDecoder(FLOAT32, sample_rate=1.0).decode(message)


def test_float32_offset_of_float64_is_refused():
    message = messages.encode_samples_float32(SampleBlock(np.ones((1, 2)), 0.0, 1.0, 0))
    message.layout.data_offset = 3
    with pytest.raises(MessageError, match='data_offset 3 received, 2 expected'):
        SampleDecoder(FLOAT32, sample_rate=1.0).decode(message)


@pytest.mark.parametrize('kind', [FLOAT32, IMU])
def test_missing_sample_rate_is_requested(kind):
    message = messages.SAMPLE_TYPES[kind]()
    if kind == FLOAT32:
        message.data = [0.0]
    with pytest.raises(MessageError, match='set the parameter sample_rate'):
        SampleDecoder(kind, sample_rate=0.0).decode(message)


@pytest.mark.parametrize('axes', ['', 'w', 'xx', 'xyzz', 'X'])
def test_imu_axes_are_checked(axes):
    with pytest.raises(ParameterError, match='give different ones of x, y and z'):
        SampleDecoder(IMU, sample_rate=100.0, imu_axis=axes)


def imu_blocks(stamps, rate=100.0, values=None, decoder=None):
    """Return the indices of the blocks of Imu messages with these stamps (s)."""
    decoder, found = decoder or SampleDecoder(IMU, sample_rate=rate), []
    for number, stamp in enumerate(stamps):
        message = Imu()
        nanoseconds = round(stamp * 1e9)
        message.header.stamp = Time(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
        message.linear_acceleration.z = float(number if values is None else values[number])
        found.append(decoder.decode(message))
    return [item.index for item in found]


def test_imu_index_counts_messages_and_skips_losses():
    assert imu_blocks([5.0, 5.01, 5.02, 5.05, 5.06]) == [0, 1, 2, 5, 6]
    assert imu_blocks([0.0, 0.0096, 0.0204, 0.0296, 0.04]) == [0, 1, 2, 3, 4]


def test_imu_repeat_keeps_its_index_and_a_coarse_stamp_does_not():
    assert imu_blocks([0.0, 0.01, 0.01, 0.02], values=[1, 2, 2, 3]) == [0, 1, 1, 2]
    assert imu_blocks([0.0, 0.001, 0.001, 0.003], rate=1000.0) == [0, 1, 2, 3]


@pytest.mark.machines
@pytest.mark.parametrize('source_rate', [970.0, 990.0, 999.0, 999.9, 1001.0, 1010.0, 1030.0])
def test_imu_of_a_slightly_other_rate_loses_nothing(source_rate):
    count = 20_000 if source_rate == 999.9 else 4000  # off by two samples or more
    stamps = 100.0 + np.arange(count) / source_rate
    assert imu_blocks(stamps, rate=1000.0) == list(range(count))
    if abs(source_rate - 1000.0) <= 10.0:  # and what it does lose is detected
        kept = np.delete(np.arange(3000), [1500, 2000, 2001])
        assert imu_blocks(stamps[kept], rate=1000.0) == kept.tolist()


@pytest.mark.parametrize(('stamps', 'indices'), [
    ([0.0, 1.0, 2.0, 4.0, 5.0], [0, 1, 2, 4, 5]),
    ([0.0, 2.0, 3.0], [0, 2, 3]),
    ([0.0, 1.0, 2.0, 3.7, 4.0, 5.0, 6.0], [0, 1, 2, 3, 4, 5, 6]),
    ([0.0, 1.0, 2.0, 2.3, 4.0, 5.0, 6.0], [0, 1, 2, 3, 4, 5, 6]),
    ([0.0, 0.7, 2.0, 2.3, 4.0, 4.3, 6.7], [0, 1, 2, 3, 4, 5, 6]),
    ([0.0, 1.0, 2.0, 3.7, 5.0, 6.0], [0, 1, 2, 3, 4, 5]),
])
def test_imu_stamp_that_is_late_once_is_no_loss(stamps, indices):
    assert imu_blocks(100.0 + 0.005 * np.array(stamps), rate=200.0) == indices


@pytest.mark.machines
@pytest.mark.parametrize('jitter', [
    lambda rng, count: rng.uniform(-0.7, 0.7, count),
    lambda rng, count: 0.2 * rng.standard_normal(count),
    lambda rng, count: 0.5 * rng.standard_normal(count)])
def test_imu_jitter_is_no_loss(rng, jitter):
    stamps = 100.0 + (np.arange(6000) + jitter(rng, 6000)) / 999.0
    assert imu_blocks(stamps, rate=1000.0) == list(range(6000))


def test_imu_loss_amid_jitter_is_detected_when_it_is_significant(rng):
    kept = np.delete(np.arange(3000), range(1500, 1502))
    stamps = 100.0 + (kept + 0.2 * rng.standard_normal(kept.size)) / 1000.0
    indices = np.array(imu_blocks(stamps, rate=1000.0))
    wrong = np.flatnonzero(indices != kept)
    assert wrong.size <= 3
    assert np.all(abs(wrong - 1500) <= 3)


def test_imu_stamps_of_bursts_are_no_losses():
    stamps = 100.0 + np.arange(8000) // 8 * 8 / 1000.0
    indices = np.array(imu_blocks(stamps, rate=1000.0))
    assert np.all(np.diff(indices[8:]) == 1)  # from the second burst on


def test_imu_stamps_that_jump_back_start_a_new_run():
    assert imu_blocks([9.0, 9.01, 9.02, 1.0, 1.01]) == [0, 1, 2, 0, 1]


@given(st.integers(-2**31, 2**31 - 2), st.integers(0, 999_999_999))
def test_pulse_times_travel_to_the_nanosecond(seconds, nanoseconds):
    time = messages.decode_time(seconds, nanoseconds)
    times, source = messages.decode_pulse_reference(messages.encode_pulse_reference(time, 'kp'))
    assert source == 'kp'
    assert times.shape == (1,)
    assert times[0] == pytest.approx(time, abs=1e-9 + 1e-15 * abs(time))


@pytest.mark.parametrize('time', [2.0**31, 2.0**31 - 1e-10, 3.8e9, -2.0**31 - 0.5, 1e308, np.nan,
                                  -np.inf])
def test_pulse_beyond_the_int32_of_its_message_is_refused(time):
    with pytest.raises(MessageError, match=r'from -2\^31 to 2\^31 s; set tach_type to std'):
        messages.encode_pulse_reference(time, 'kp')


def test_pulse_array_beyond_any_time_is_refused():
    with pytest.raises(MessageError, match=r'pulse time is 1e\+16 s: must be within 1e\+15'):
        messages.decode_pulse_array(messages.encode_pulse_array(np.array([1.0, np.nan, 1e16])))


def test_pulse_before_the_epoch_has_a_negative_second():
    message = messages.encode_pulse_reference(-0.25, 'kp')
    assert (message.time_ref.sec, message.time_ref.nanosec) == (-1, 750_000_000)
    message = messages.encode_pulse_reference(-1e-10, '')
    assert (message.time_ref.sec, message.time_ref.nanosec) == (0, 0)
    assert messages.decode_pulse_reference(
        TimeReference(time_ref=Time(sec=-3, nanosec=500_000_000)))[0][0] == -2.5


@given(st.lists(st.one_of(TIMES, st.just(np.nan)), max_size=20))
def test_pulse_arrays_travel_unchanged(times):
    message = messages.encode_pulse_array(np.array(times))
    np.testing.assert_array_equal(messages.decode_pulse_array(message), times)
    bare = Float64MultiArray(data=times)
    np.testing.assert_array_equal(messages.decode_pulse_array(bare), times)


RESULTS = arrays(np.float64, (2, 3, len(messages.AMPLITUDE_FIELDS)),
                 elements=st.floats(allow_infinity=False))
HEADER = st.builds(AverageHeader, FINITE, FINITE, st.integers(0, 2**53), st.integers(1, 10**6),
                   st.integers(0, 10**6), FINITE, st.integers(0, 10**6))


@given(RESULTS, HEADER)
def test_order_amplitudes_travel_unchanged(values, header):
    message = messages.encode_average(
        'order_amplitude', AverageMessage(header, values, messages.AMPLITUDE_FIELDS))
    assert [dim.label for dim in message.layout.dim] == [
        'channel', 'order', f'field:{",".join(messages.AMPLITUDE_FIELDS)}']
    assert message.layout.data_offset == 7
    got = messages.decode_average('order_amplitude', message)
    assert (got.header, got.names) == (header, messages.AMPLITUDE_FIELDS)
    np.testing.assert_array_equal(got.values, values)
    message.layout.dim[-1].label = ''  # readers compare what is in front of the colon
    assert messages.decode_average('order_amplitude', message).names == messages.AMPLITUDE_FIELDS


@given(arrays(np.float64, (2, 7), elements=st.floats()))
def test_predictions_and_residuals_travel_and_nothing_is_infinite(values):
    finite = np.where(np.isinf(values), np.nan, values)
    prediction = messages.decode_prediction(messages.encode_prediction(
        PredictionMessage(values, 25.0, 5120.0, 40, 2.4, 1e-5, math.inf)))
    np.testing.assert_array_equal(prediction.values, finite)
    assert (prediction.trigger_cycles, prediction.ratio) == (40, 2.4)
    assert math.isnan(prediction.noise_standard_deviation)
    residual = messages.decode_residual(messages.encode_residual(
        ResidualMessage(values[:, :6], 12, 1.1, 0.4, 0.01)))
    np.testing.assert_array_equal(residual.values, finite[:, :6])
    assert (residual.acquisitions, residual.p_value) == (12, 0.4)


def test_result_of_another_topic_is_refused():
    header = AverageHeader(0.0, 1.0, 0, 10, 10, 10.0)
    message = messages.encode_average(
        'synchronous_average', AverageMessage(header, np.zeros((2, 8))))
    with pytest.raises(MessageError, match=r"\['channel', 'angle'\] received"):
        messages.decode_average('order_amplitude', message)
    with pytest.raises(MessageError, match='expected'):
        messages.decode_prediction(message)


def test_types_are_known_with_and_without_msg():
    known = messages.known_type('vibration_type', 'std_msgs/msg/Float32MultiArray',
                                messages.SAMPLE_TYPES)
    assert messages.SAMPLE_TYPES[known] is Float32MultiArray
    with pytest.raises(ParameterError, match="tach_type is 'Pulse': give one of sensor_msgs/Tim"):
        messages.known_type('tach_type', 'Pulse', messages.PULSE_TYPES)


@pytest.mark.parametrize(('position', 'value'), [(2, np.nan), (3, np.inf), (4, -1.0), (2, 0.5)])
def test_result_with_an_impossible_count_is_refused(position, value):
    header = [0.0, 1.0, 3.0, 40.0, 40.0, 25.0]
    header[position] = value
    message = messages.encode_array(np.zeros((1, 4)), ('channel', 'angle'), tuple(header))
    with pytest.raises(MessageError, match=r'is .*: send a whole number'):
        messages.decode_average('synchronous_average', message)


@pytest.mark.parametrize(('decode', 'fields', 'header'), [
    (messages.decode_prediction, messages.PREDICTION_FIELDS, 6),
    (messages.decode_residual, messages.RESIDUAL_FIELDS, 4)])
def test_fields_that_are_missing_are_not_known(decode, fields, header):
    message = messages.encode_array(
        np.ones((2, 3)), ('order', f'field:{",".join(fields[:3])}'), (1.0,) * header)
    values = decode(message).values
    assert np.all(values[:, :3] == 1.0)
    assert np.isnan(values[:, 3:]).all()
    message.layout.dim[-1].label = 'field'
    with pytest.raises(MessageError, match='3 fields received'):
        decode(message)


@pytest.mark.parametrize('elements', [6, 7, 9])
@pytest.mark.parametrize('fields', [8, 13, 15])
def test_averages_of_older_and_newer_versions_are_read(elements, fields):
    """Old bags have six header elements; newer versions append elements and fields."""
    names = [*messages.AMPLITUDE_FIELDS, 'one', 'two'][:fields]
    values = np.arange(2.0 * 3 * fields).reshape(2, 3, fields)
    header = (0.5, 2.1, 4.0, 40.0, 96.0, 25.0, 3.0, 7.0, 8.0)[:elements]
    message = messages.encode_array(
        values, ('channel', 'order', f'field:{",".join(names)}'), header)
    got = messages.decode_average('order_amplitude', message)
    assert got.header == AverageHeader(0.5, 2.1, 4, 40, 96, 25.0, 3 if elements > 6 else 0)
    assert got.names == messages.AMPLITUDE_FIELDS
    count = min(fields, len(messages.AMPLITUDE_FIELDS))
    np.testing.assert_array_equal(got.values[..., :count], values[..., :count])
    assert np.isnan(got.values[..., count:]).all()
    swapped = messages.encode_array(
        values[..., ::-1], ('channel', 'order', f'field:{",".join(names[::-1])}'), header)
    np.testing.assert_array_equal(
        messages.decode_average('order_amplitude', swapped).values, got.values)


def test_input_with_more_header_elements_is_read():
    """Newer versions append elements to the header of vibration and pulses."""
    for kind, header, made in (('std_msgs/Float64MultiArray', (1.5, 100.0, 150.0, 7.0, 8.0),
                                Float64MultiArray),
                               ('std_msgs/Float32MultiArray', (0.0, 150.0, 7.0, 8.0),
                                Float32MultiArray)):
        message = made(data=[*header, 1.0, 2.0])
        message.layout.data_offset = len(header)
        for sizes in ((), (('channel', 1), ('sample', 2))):
            message.layout.dim = [MultiArrayDimension(label=name, size=size)
                                  for name, size in sizes]
            block = SampleDecoder(kind, sample_rate=100.0).decode(message)
            assert (block.start_time, block.sample_rate, block.index) == (1.5, 100.0, 150)
            np.testing.assert_array_equal(block.samples, [[1.0, 2.0]])
    pulses = messages.encode_array(np.array([0.5, 1.0]), ('pulse',), (7.0, 8.0))
    np.testing.assert_array_equal(messages.decode_pulse_array(pulses), [0.5, 1.0])


def test_pulse_errors_without_the_field_used_are_read():
    message = messages.encode_array(
        np.ones((5, 3)), ('pulse', 'field:time,error,standard_error'), (0.0, 1.0, 0, 4, 4, 4.0))
    got = messages.decode_average('pulse_error', message)
    assert np.isnan(got.values[:, 3]).all()
    assert np.all(got.values[:, :3] == 1.0)


@pytest.mark.parametrize(('stamps', 'doubt'), [
    (np.arange(400) / 150.0, 'its stamps come 150 times a second, sample_rate declares 400 Hz: set'
     ' sample_rate to 150'),
    (np.arange(400) / 440.0, 'its stamps come 440 times a second, sample_rate declares 400 Hz'),
    (np.arange(400) // 10 / 40.0 + np.arange(400) % 10 * 1e-5, 'its stamps come in bursts, 4'),
    (np.arange(400) // 10 / 15.0 + np.arange(400) % 10 * 1e-5, 'its stamps come in bursts, 15'),
    (np.arange(60) / 150.0, ''),
    (np.arange(400) / 410.0, ''),
    (np.delete(np.arange(400), np.arange(0, 400, 5)) / 400.0, ''),
    (np.concatenate((np.arange(200) / 400.0, 30.0 + np.arange(100) / 400.0)), ''),
    (np.concatenate((np.arange(100) / 150.0, np.arange(-400, -200) / 400.0)), '')])
def test_imu_rate_that_is_not_the_declared_one_is_named(stamps, doubt):
    decoder = SampleDecoder(IMU, sample_rate=400.0)
    imu_blocks(100.0 + stamps, decoder=decoder)
    assert decoder.doubt.startswith(doubt)
    assert bool(decoder.doubt) == bool(doubt)
