# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The library's average: any cut is the same average, and what is discarded is said."""

from dataclasses import fields
import inspect
import warnings

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
import sa_jitter_ros as sa
from sa_jitter_ros.averaging.averager_parameters import PARAMETERS, shaft_parameters
from sa_jitter_ros.averaging.timeline import VibrationTimeline
from sa_jitter_ros.errors import DataWarning
from sa_jitter_ros.pulses.resampling import interpolator_gain, METHODS
from sa_jitter_ros.recordings.recording import ArraySource, Recording

RATE, SPEED = 2000.0, 25.0
TIME = np.arange(4000) / RATE
PULSES = 0.01 + np.arange(49) / SPEED
NOISE = np.random.default_rng(3).normal(0.0, 0.2, (2, TIME.size))
WAVE = np.cos(2.0 * np.pi * 5.0 * SPEED * (TIME - PULSES[0]))
VIBRATION = WAVE * np.array([[1.0], [0.5]]) + NOISE


def same(first, second):
    """Assert that two lists of averages are alike in everything."""
    assert len(first) == len(second)
    for one, other in zip(first, second):
        known = {item.name for item in fields(sa.Average)} - {'later'}
        for field in sorted(known | {'indicators', 'residual', 'difference'}):
            a, b = getattr(one, field), getattr(other, field)
            if field == 'correction':
                assert (a is None) == (b is None)
                if a is not None:
                    assert a.pulse_errors == pytest.approx(b.pulse_errors, abs=1e-12)
            elif field == 'envelope':
                assert a is b is None
            elif field == 'parts':
                assert (a is None) == (b is None)
                if a is not None:
                    assert np.array_equal(a.counts, b.counts)
                    assert np.allclose(a.waveforms, b.waveforms, rtol=1e-9, atol=1e-12,
                                       equal_nan=True)
            elif field == 'indicators':
                assert a.keys() == b.keys()
                for name in a:
                    assert np.allclose(a[name], b[name], rtol=1e-6, equal_nan=True), name
            elif field == 'refused':
                assert a == b
            elif field == 'amplitude_errors':
                for x, y in zip(vars(a).values(), vars(b).values(), strict=True):
                    assert np.allclose(x, y, rtol=1e-6, atol=1e-12, equal_nan=True)
            else:
                assert np.allclose(a, b, rtol=1e-9, atol=1e-12, equal_nan=True), field


#: Averages of all at once, by the options.
WHOLE = {}


@pytest.mark.machines
@pytest.mark.parametrize('options', [
    {}, {'trigger_cycles': 9}, {'trigger_cycles': 9, 'averaging': 'sliding'},
    {'angle_law': 'spline', 'ratio': 2.4}, {'correct_jitter': True, 'keyphasor_rate': 1e3}],
    ids=str)
@settings(max_examples=6, deadline=None)
@given(data=st.data())
def test_any_cut_gives_the_average_of_all(options, data):
    samples, pulses = VIBRATION.copy(), np.delete(PULSES, 30)
    samples[1, 700] = np.nan
    if str(options) not in WHOLE:
        with pytest.warns(sa.DataWarning, match='1 samples that are NaN'):
            WHOLE[str(options)] = sa.average(samples, RATE, pulses, **options)
    cut = data.draw(st.lists(st.tuples(st.integers(0, TIME.size), st.integers(0, pulses.size)),
                             max_size=6))
    rows, columns = (sorted(part) for part in zip(*cut)) if cut else ([], [])
    averager = sa.Averager(RATE, **options)
    found = []
    for one, other in zip(np.split(samples, rows, axis=1), np.split(pulses, columns)):
        if data.draw(st.booleans()):
            found += averager.update(pulse_times=other)
            found += averager.update(one)
        else:
            found += averager.update(one, other)
    same(WHOLE[str(options)], (*found, *averager.flush()))


def test_one_channel_may_be_one_dimensional_and_integer():
    counts = np.rint(1000.0 * VIBRATION[0]).astype(np.int16)
    result, = sa.average(counts, RATE, PULSES.tolist(), orders=[5])
    assert result.amplitudes == pytest.approx(1000.0, rel=0.02)
    assert result.waveform.shape == (1, result.angle.size)


def test_without_trigger_cycles_all_make_one_average():
    result, = sa.average(VIBRATION, RATE, PULSES)
    assert result.trigger_cycles == 48
    assert result.start_time, result.end_time == (PULSES[0], PULSES[-1])
    assert result.trigger_speed == pytest.approx(SPEED)
    assert result.orders.tolist() == [1.0, 2.0, 3.0]
    assert np.diff(result.angle) == pytest.approx(1.0 / result.angle.size)
    truth = np.cos(2.0 * np.pi * 5.0 * result.angle)
    assert np.abs(result.waveform[0] - truth).max() < 6.0 * result.standard_error.max()


def test_every_unbroken_run_makes_an_average():
    with pytest.warns(sa.DataWarning, match='1 missing pulses'):
        found = sa.average(VIBRATION, RATE, np.delete(PULSES, 20), orders=[5])
    assert [item.trigger_cycles for item in found] == [19, 27]
    assert [item.sequence for item in found] == [0, 1]


def test_the_times_are_those_of_the_clock_of_the_pulses():
    here, = sa.average(VIBRATION, RATE, PULSES, orders=[5])
    there, = sa.average(VIBRATION, RATE, PULSES + 1000.0, start_time=1000.0, orders=[5])
    assert there.start_time == pytest.approx(here.start_time + 1000.0)
    assert there.amplitudes == pytest.approx(here.amplitudes, abs=1e-7)  # the kernel


def test_several_pulses_a_revolution_and_a_faster_shaft():
    pulses = PULSES[0] + np.arange(48 * 3 + 1) / (3.0 * SPEED)
    result, = sa.average(VIBRATION, RATE, pulses, pulses_per_revolution=3, ratio=2.5, orders=[2])
    assert result.trigger_cycles == 48
    assert result.trigger_speed == pytest.approx(SPEED)
    assert abs(result.amplitudes[:, 0]) == pytest.approx([1.0, 0.5], abs=0.02)
    third, = sa.average(VIBRATION, RATE, pulses, pulses_per_revolution=3, pulses_per_trigger=1)
    assert third.trigger_cycles == 144
    assert third.trigger_speed == pytest.approx(SPEED)


def test_nothing_is_said_where_everything_was_used():
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        sa.average(VIBRATION, RATE, PULSES)
    averager = sa.Averager(RATE)
    averager.update(VIBRATION, PULSES)
    averager.flush()
    assert averager.messages == []
    assert averager.counts['trigger_cycles'] == averager.counts['pulses_accepted'] - 1 == 48
    assert averager.counts['cycles_dropped'] == 0


@pytest.mark.parametrize(('pulses', 'text'), [
    (np.sort(np.append(PULSES, PULSES[7] + 0.01)), '1 double pulses'),
    (np.insert(PULSES, 9, np.nan), '1 pulse times that are NaN'),
    (PULSES - 0.5, 'no vibration without a gap from -0.49'),
    (PULSES + 0.5, 'from 2.030000 s on: 10 trigger cycles discarded'),
    (np.append(PULSES, PULSES + 500.0), 'no vibration from')])
def test_what_is_discarded_is_said(pulses, text):
    with pytest.warns(sa.DataWarning, match=text):
        sa.average(VIBRATION, RATE, pulses)


def test_samples_that_wait_too_long_are_said_and_counted():
    averager = sa.Averager(RATE, buffer_seconds=0.5, trigger_cycles=10)
    for part in np.split(VIBRATION, 4, axis=1):
        assert averager.update(part) == ()
    averager.update(pulse_times=PULSES)
    assert averager.counts['samples_dropped'] >= 3000
    assert averager.messages


@pytest.mark.parametrize(('options', 'text'), [
    ({'trigger_cycles': 60}, 'make 48 whole trigger cycles of the 60 of an average'),
    ({'start_time': 50.0}, 'make 0 whole trigger cycles')])
def test_too_few_cycles_are_an_error_that_says_how_many_there_are(options, text):
    with pytest.raises(sa.SignalError, match=text):
        sa.average(VIBRATION, RATE, PULSES, **options)


def test_a_stream_may_end_without_an_average():
    averager = sa.Averager(RATE, trigger_cycles=60)
    assert averager.update(VIBRATION, PULSES) == averager.flush() == ()
    with pytest.raises(sa.SignalError, match='make another Averager'):
        averager.update(VIBRATION)


@pytest.mark.parametrize(('options', 'text'), [
    ({'sample_rate': 0.0}, 'sample_rate is 0.0 Hz'), ({'ratio': 0.0}, 'ratio is 0'),
    ({'start_time': np.nan}, 'start_time is nan'), ({'trigger_cycles': 0}, 'trigger_cycles is 0'),
    ({'orders': []}, 'orders are'), ({'orders': [-1.0]}, 'orders are'),
    ({'averaging': 'sliding'}, 'without trigger_cycles'),
    ({'averaging': 'mean', 'trigger_cycles': 4}, "averaging is 'mean'"),
    ({'angle_law': 'cubic'}, "angle_law is 'cubic'"),
    ({'pulses_per_trigger': 2}, 'pulses_per_trigger is 2, more than the 1 '),
    ({'interval_tolerance': 0.7}, 'interval_tolerance 0.7'),
    ({'orders': 12}, r'orders is 12: give a list of numbers, \[12\]'),
    ({'orders': '12'}, "orders is '12': give a list of numbers"),
    ({'orders': [1, 'b']}, r"orders\[1\] is 'b': give a number"),
    ({'trigger_cycles': 9.5}, 'trigger_cycles is 9.5: give a whole number'),
    ({'missing_teeth': 'two'}, "missing_teeth is 'two': give a whole number"),
    ({'sample_rate': None}, 'sample_rate is None: give a number'),
    ({'ratio': '2.5'}, "ratio is '2.5': give a number"),
    ({'time_tolerance': []}, r'time_tolerance is \[\]: give a number'),
    ({'maximum_discarded': 1.5}, 'maximum_discarded is 1.5: give the share'),
    ({'keyphasor_rate': -1.0}, 'keyphasor_rate is -1')])
def test_parameters_that_cannot_be_used_are_refused(options, text):
    with pytest.raises(sa.ParameterError, match=text):
        sa.average(VIBRATION, **{'sample_rate': RATE, 'pulse_times': PULSES, **options})


@pytest.mark.parametrize(('vibration', 'pulses', 'text'), [
    (VIBRATION.T, PULSES, '4000 channels of 2 samples'),
    (VIBRATION[:1].T, PULSES, '4000 channels of 1 samples'),
    (VIBRATION[None], PULSES, 'shape'), (VIBRATION.astype(complex), PULSES, 'complex'),
    (['a', 'b'], PULSES, 'real numbers'), (VIBRATION, ['a'], 'real numbers'),
    (VIBRATION, PULSES[None], 'pulse times have'), (VIBRATION, [], 'make 0 whole'),
    (VIBRATION[:, :0], PULSES, 'make 0 whole'),
    (VIBRATION, VIBRATION[0], 'pulse_times are 4000 values that do not rise'),
    (VIBRATION, None, r'those of a recording are recording.keyphasor_pulses\(\)'),
    (ArraySource(VIBRATION), PULSES, r'give all of them as an array, recording.read\(\)'),
    (Recording(ArraySource(VIBRATION), RATE), PULSES, r'recording.read\(\)')])
def test_arrays_that_cannot_be_used_are_refused(vibration, pulses, text):
    with pytest.raises(sa.SignalError, match=text):
        sa.average(vibration, RATE, pulses)


@pytest.mark.parametrize(('pulses', 'text'), [
    (1e3 * PULSES, 'span 1920 s, the vibration spans 2 s: the pulse times look like milliseconds; '
     'divide them by 1000'),
    (1e6 * PULSES, 'look like microseconds'),
    (np.round(RATE * PULSES), 'look like sample indices; divide them by 2000'),
    (60.0 * PULSES, 'span 115.2 s, the vibration spans 2 s: give pulse times in s'),
    (1e-4 * PULSES, 'span 0.000192 s, the vibration spans 2 s: give pulse times in s'),
    (1e9 + PULSES, 'set start_time to the time of the first sample on the clock of the pulses'),
    (PULSES[::-1], '48 of 49 pulse times are earlier than the one before: give them in order')])
def test_a_likely_mistake_is_named(pulses, text):
    with pytest.raises(sa.SignalError, match=text):
        sa.average(VIBRATION, RATE, pulses)


def test_milliseconds_slightly_too_long_are_likelier_than_indices_that_end_early():
    rate = 1900.0
    pulses = np.linspace(0.0, 1.05e3 * TIME.size / rate, 50)
    with pytest.raises(sa.SignalError, match='look like milliseconds'):
        sa.average(VIBRATION, rate, pulses)


def test_a_likely_mistake_is_named_beside_an_average():
    with pytest.warns(sa.DataWarning, match='span 400 s, the vibration spans 2 s'):
        sa.average(VIBRATION, RATE, np.arange(0.0, 400.5, 0.5))


@pytest.mark.parametrize(('factor', 'text'), [(0.5, 'half its rate: is it sampled at 5000'),
                                              (2.0, 'twice its rate: is it sampled at 5000')])
def test_another_sampling_rate_is_named(rng, factor, text):
    time = np.arange(20_000) / 5e3
    vibration = np.cos(2.0 * np.pi * 8.0 * 25.0 * time) + 0.1 * rng.normal(size=time.size)
    with pytest.warns(sa.DataWarning) as caught:
        sa.average(vibration, factor * 5e3, np.arange(1, 100) / 25.0)
    assert sum(text in str(item.message) for item in caught) == 1


@pytest.mark.parametrize('cycles', [None, 10])
def test_orders_without_a_line_are_named_and_no_others(rng, cycles):
    time = np.arange(40_000) / 5e3
    angle = 2.0 * np.pi * (25.0 * time + 0.3 * time**2)  # in a run-up
    pulses = np.interp(2.0 * np.pi * np.arange(1, 200), angle, time)
    vibration = 0.1 * np.cos(23.0 * angle) + rng.normal(size=time.size)
    for orders in ([23.0], [23.0, 24.0], [1.0, 23.0, 46.0]):
        sa.average(vibration, 5e3, pulses, orders=orders, trigger_cycles=cycles)
    sa.average(vibration, 5e3, pulses, trigger_cycles=cycles)
    with pytest.warns(sa.DataWarning, match=r'none of the orders 24, 48 stands above its noise'):
        sa.average(vibration, 5e3, pulses, orders=[24.0, 48.0], trigger_cycles=cycles)
    sa.average(vibration, 5e3, pulses, orders=[24.0], trigger_cycles=3)  # these tell no noise
    sa.average(0.0 * vibration, 5e3, pulses, orders=[24.0])


@pytest.mark.filterwarnings('ignore:none of the orders 2, 20, 30')
def test_orders_from_the_nyquist_frequency_on_are_named():
    with pytest.warns(sa.DataWarning, match='no amplitude of orders 20, 30: the shaft turns at 50 '
                      'Hz, and vibration sampled at 2000 Hz shows orders below 20 only'):
        average, = sa.average(VIBRATION, RATE, PULSES, ratio=2.0, orders=[2, 20, 30])
    assert np.array_equal(np.isnan(average.amplitudes[0]), [False, True, True])
    assert list(average.refused) == [20.0, 30.0]
    assert 'orders below 20 only' in average.refused[30.0]


@pytest.mark.parametrize('method', METHODS)
def test_amplitudes_are_over_the_gain_of_the_interpolator_as_far_as_half_is_left(method):
    rate, speed = 4000.0, 24.2
    time, pulses = np.arange(12_000) / rate, 0.031 + np.arange(60) / speed
    orders = np.round(np.array([0.1, 0.3, 0.376, 0.43, 0.45, 0.49, 0.499]) * rate / speed)
    expected = np.where(interpolator_gain(method, orders * speed / rate) >= 0.5, 0.4, np.nan)
    with warnings.catch_warnings():
        warnings.simplefilter('ignore', sa.DataWarning)
        for order, amplitude in zip(orders, expected):
            vibration = 0.4 * np.cos(2.0 * np.pi * order * speed * time)
            average, = sa.average(vibration, rate, pulses, orders=[order], interpolation=method)
            found = abs(average.amplitudes[0, 0])
            assert found == pytest.approx(amplitude, rel=1e-3, nan_ok=True)
            assert np.isnan(average.amplitude_errors.upper_95[0, 0]) == np.isnan(found)
            assert np.isnan(average.cycle_amplitudes).all() == np.isnan(found)
            assert list(average.refused) == ([order] if np.isnan(found) else [])


def test_gain_follows_a_speed_that_changes_during_the_average():
    rate, order = 4000.0, 60.0
    time = np.arange(16_000) / rate
    turns = 20.0 * time + 1.2 * time**2  # order 60 from 0.30 to 0.44 of the sampling rate
    pulses = np.interp(np.arange(1.0, 98.0), turns, time)
    vibration = (1.0 + 0.2 * time) * np.cos(2.0 * np.pi * order * turns)
    average, = sa.average(vibration, rate, pulses, orders=[order], angle_law='spline')
    middle = 0.5 * (pulses[1:] + pulses[:-1])
    expected = 1.0 + 0.2 * middle
    assert average.gains.min() < 0.9
    # of the first and the last two cycles the spline knows the speed less well
    assert abs(average.cycle_amplitudes[2:-2, 0, 0]) == pytest.approx(expected[2:-2], rel=3e-3)
    assert abs(average.amplitudes[0, 0]) == pytest.approx(expected.mean(), rel=2e-3)


def test_correction_and_attenuation_near_the_end_of_the_band():
    rate, speed, order = 4000.0, 25.0, 60.0
    rng = np.random.default_rng(3)
    time, pulses = np.arange(14_000) / rate, 0.041 + np.arange(82) / speed
    late = pulses + rng.uniform(-1.0, 1.0, pulses.size) * 1.2e-4
    vibration = np.cos(2.0 * np.pi * 20.0 * speed * time) + 0.4 * np.cos(
        2.0 * np.pi * order * speed * time) + 0.01 * rng.standard_normal(time.size)
    average, = sa.average(vibration, rate, late, orders=[20.0, order], correct_jitter=True,
                          keyphasor_rate=4e3)
    found = average.correction
    assert average.gain[1] == pytest.approx(interpolator_gain('band_limited', 0.375), abs=1e-4)
    for off in (abs(found.amplitudes[0]) - [1.0, 0.4]) / found.amplitude_errors.amplitude[0]:
        assert abs(off) < 4.0
    assert found.amplitude_errors.amplitude[0, 1] < 1e-3
    assert abs(average.amplitudes) / abs(found.amplitudes) == pytest.approx(found.attenuation)
    turn = 2.0 * np.pi * order * speed * 1.2e-4
    left = np.sinc(turn * np.linspace(0.0, 1.0, 501) / np.pi)
    assert found.attenuation[0, 1] == pytest.approx(np.mean(left * left[::-1]), abs=0.05)


def test_whole_floats_numpy_scalars_and_0d_arrays_are_numbers():
    numbers = {'ratio': 2.0, 'pulses_per_revolution': 1, 'pulses_per_trigger': 1,
               'trigger_cycles': 10.0, 'keyphasor_rate': 1e3, 'samples_per_revolution': 64,
               'missing_teeth': 0, 'maximum_missing': 3, 'interval_tolerance': 0.25,
               'minimum_interval': 0.0, 'time_tolerance': 0.01, 'start_time': 0.0,
               'maximum_discarded': 0.0}
    expected = sa.average(VIBRATION, RATE, PULSES, **numbers)
    for kind in (np.array, np.float64):
        same(expected, sa.average(VIBRATION, kind(RATE), PULSES,
                                  **{name: kind(value) for name, value in numbers.items()}))
    assert np.array_equal(sa.detect_pulses(WAVE, np.array(RATE), threshold=np.array(0.0)),
                          sa.detect_pulses(WAVE, RATE, threshold=0.0))


def test_a_block_of_other_channels_is_not_taken():
    averager = sa.Averager(RATE)
    averager.update(VIBRATION[:, :1000])
    with pytest.raises(sa.SignalError, match='3 channels and had 2'):
        averager.update(np.zeros((3, 10)))
    averager.update(VIBRATION[:, 1000:], PULSES)
    same(averager.flush(), sa.average(VIBRATION, RATE, PULSES))


def test_one_cycle_is_an_average_that_cannot_be_corrected():
    with pytest.warns(sa.DataWarning):
        found = sa.average(VIBRATION, RATE, np.delete(PULSES, [46]), correct_jitter=True)
    assert [item.trigger_cycles for item in found] == [45, 1]
    last = found[-1].correction
    assert not last.accepted
    assert 'there is one cycle' in last.reason
    assert np.array_equal(last.amplitudes, found[-1].amplitudes)


def test_the_two_signatures_are_one():
    stream = dict(inspect.signature(sa.Averager).parameters)
    whole = dict(inspect.signature(sa.average).parameters)
    del stream['buffer_seconds'], whole['vibration'], whole['pulse_times']
    assert [(item.name, item.default, item.annotation) for item in stream.values()] == [
        (item.name, item.default, item.annotation) for item in whole.values()]


def test_defaults_are_those_of_the_node():
    signature = inspect.signature(sa.Averager)
    shown = {item.name: item.default for item in signature.parameters.values()}
    known = {item.name: item.default for item in (*PARAMETERS, *shaft_parameters(''))}
    known = {name.lstrip('.'): default for name, default in known.items()}
    differ = {name for name in shown.keys() & known.keys()
              if shown[name] != known[name] and (shown[name] or known[name])}
    assert shown.keys() - known.keys() == {'machine', 'shaft'}  # of the machine file in the node
    assert differ == {'sample_rate', 'orders', 'trigger_cycles', 'buffer_seconds'}
    for name in ('buffer_seconds', 'time_tolerance'):
        assert getattr(VibrationTimeline(), name) == known[name]


def test_an_unknown_keyword_is_named_with_the_one_it_looks_like():
    with pytest.raises(TypeError, match=r"'trigger_cycle', did you mean trigger_cycles"):
        sa.Averager(RATE, trigger_cycle=4)
    with pytest.raises(TypeError, match="unknown keyword 'buffer_seconds'"):
        sa.average(VIBRATION, RATE, PULSES, buffer_seconds=4.0)


def test_detected_pulses_are_those_of_the_waveform():
    tach = np.where((TIME - PULSES[0]) % (1.0 / SPEED) < 0.004, 5.0, 0.0)
    pulses = sa.detect_pulses(tach, RATE, start_time=3.0)
    assert pulses == pytest.approx(3.0 + np.append(PULSES, 1.97), abs=0.6 / RATE)
    tach[500:520] = np.nan
    gappy = sa.detect_pulses(tach, RATE, start_time=3.0)
    assert set(gappy.round(6)) < set(pulses.round(6))
    assert gappy.size == pulses.size - 1


def test_a_waveform_without_pulses_says_so():
    with pytest.warns(sa.DataWarning, match='check that the shaft turns'):
        assert sa.detect_pulses(np.zeros(5000), RATE).size == 0
    with pytest.warns(sa.DataWarning, match='the threshold is 9'):
        assert sa.detect_pulses(np.sin(TIME * 100.0), RATE, threshold=9.0).size == 0


@pytest.mark.parametrize('tach', [np.zeros((2, 9)), ['a'], [1j]])
def test_a_waveform_that_cannot_be_used_is_refused(tach):
    with pytest.raises(sa.SignalError, match='keyphasor waveform'):
        sa.detect_pulses(tach, RATE)


def test_path_delay_is_taken_from_the_pulses():
    vibration = np.cos(2.0 * np.pi * 8.0 * SPEED * np.arange(6000) / RATE)
    pulses = np.arange(70) / SPEED
    plain, = sa.average(vibration, RATE, pulses, orders=[8.0])
    delayed, = sa.average(vibration, RATE, pulses + 3e-3, orders=[8.0], path_delay=3e-3)
    np.testing.assert_allclose(delayed.amplitudes, plain.amplitudes, rtol=1e-9)
    np.testing.assert_allclose(delayed.pulses, pulses, rtol=0, atol=1e-12)
    with pytest.raises(sa.ParameterError, match='path_delay'):
        sa.average(vibration, RATE, pulses, path_delay=np.inf)


def test_cycles_that_lack_pulses_from_the_start_are_counted(rng):
    pulses = np.delete(np.arange(1, 36 * 40) / 720.0, 36 * np.arange(16) + 5)
    with pytest.warns(DataWarning) as said:
        sa.average(rng.normal(size=1000), 500.0, pulses, pulses_per_revolution=36)
    assert str(said[0].message).endswith(
        '16 missing pulses; no valid pulses to 0.801389 s: 16 trigger cycles discarded')


@pytest.mark.parametrize('dtype', [np.int16, np.uint64, np.float16, np.float32, np.float64])
def test_samples_of_any_type_are_taken_with_what_is_missing(dtype):
    samples = np.arange(40_000).reshape(2, -1) % 50
    samples = samples.astype(dtype)
    if samples.dtype.kind == 'f':
        samples[1, [7, 9]] = np.nan, np.inf
    averager = sa.Averager(1000.0, trigger_cycles=5)
    found = averager.update(samples, np.arange(0.0, 20.0, 0.05))
    assert len(found) > 70
