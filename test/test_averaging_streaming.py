# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The streaming averager against closed forms: any cut, any order of arrival, faults."""

from fractions import Fraction
from functools import lru_cache
import math
import tracemalloc
from types import SimpleNamespace

from hypothesis import given, settings, strategies as st
from machine import averager, feed, Machine
import numpy as np
import pytest
from sa_jitter_ros.averaging.amplitude_errors import widened
from sa_jitter_ros.averaging.average import AverageSettings, AVERAGING
from sa_jitter_ros.averaging.cycle import CycleSamples
from sa_jitter_ros.averaging.recovered_marks import RecoveredMarks
from sa_jitter_ros.averaging.shaft import ShaftAverager
from sa_jitter_ros.averaging.streaming import StreamingAverager
from sa_jitter_ros.averaging.timeline import VibrationTimeline
from sa_jitter_ros.errors import ParameterError, SignalError
from sa_jitter_ros.pulses.resampling import interpolator_gain
from sa_jitter_ros.pulses.target_geometry import MarkOffsets
from sa_jitter_ros.pulses.validation import PulseValidator
from sa_jitter_ros.samples import SampleBlock

RATIOS = [1.0, 2.40789, 0.4137, 5.8154, 183 / 76]
FIELDS = ('start_time', 'end_time', 'sequence', 'fundamental_cycles', 'angle', 'waveform',
          'standard_error', 'amplitudes', 'noise', 'pulses')

# --- every cut and every order of arrival --------------------------------------------------------

STREAM_RATE = 1200.0
SHAFTS = {'tach': {}, 'fast': {'cycle_length': 2.40789}, 'slow': {'cycle_length': 0.4137},
          'teeth': {'cycle_length': 183 / 76},
          'coarse': {'cycle_length': 1.5, 'samples_per_revolution': 16}}


@lru_cache(maxsize=1)
def stream():
    """Return noise (2, n) and the pulses of a machine whose speed varies, with a gap."""
    rng = np.random.default_rng(1)
    pulses = np.cumsum(1.0 / (17.0 + 1.5 * np.sin(np.arange(45) / 4.0)))
    pulses += 1e-4 * rng.standard_normal(45)
    return rng.standard_normal((2, int(STREAM_RATE * (pulses[-1] + 0.1)))), pulses


def new_stream(law, averaging):
    """Return an averager of several shafts with this law."""
    return averager(**{name: {'angle_law': law, 'averaging': averaging, 'trigger_cycles': 7,
                              **item}
                       for name, item in SHAFTS.items()})


@lru_cache(maxsize=9)
def whole(law, averaging):
    """Return the averages when all comes at once, pulses first."""
    samples, pulses = stream()
    target = new_stream(law, averaging)
    assert not target.add_pulses(pulses)
    return target.add_samples(SampleBlock(samples, 0.0, STREAM_RATE, 0))


def assert_same(found, expected):
    """Check that averages agree to rounding, shaft by shaft."""
    for name in SHAFTS:
        ours = [item for shaft, item in found if shaft == name]
        theirs = [item for shaft, item in expected if shaft == name]
        assert len(ours) == len(theirs)
        for key in FIELDS:
            one, other = ([np.asarray(getattr(item, key)) for item in items]
                          for items in (ours, theirs))
            assert [item.shape for item in one] == [item.shape for item in other]
            if one:
                np.testing.assert_allclose(
                    *(np.concatenate([item.ravel() for item in items]) for items in (one, other)),
                    rtol=1e-9, atol=1e-11, err_msg=f'{name} {key}')


@pytest.mark.machines
@settings(max_examples=6)
@given(st.data())
def test_averages_are_the_same_for_every_cut_and_order_of_arrival(data):
    law = data.draw(st.sampled_from(['linear', 'quadratic', 'spline']))
    averaging = data.draw(st.sampled_from(AVERAGING))
    samples, pulses = stream()
    count = samples.shape[1]
    cuts = sorted(data.draw(st.sets(st.integers(1, count - 1), max_size=12)))
    pulse_cuts = sorted(data.draw(st.sets(st.integers(1, len(pulses) - 1), max_size=12)))
    turns = data.draw(st.permutations(
        [True] * (len(cuts) + 1) + [False] * (len(pulse_cuts) + 1)))
    blocks = iter(zip([0, *cuts], [*cuts, count]))
    parts = iter(np.split(pulses, pulse_cuts))
    target, found = new_stream(law, averaging), []
    for vibration in turns:
        if vibration:
            start, end = next(blocks)
            found += target.add_samples(
                SampleBlock(samples[:, start:end], start / STREAM_RATE, STREAM_RATE, start))
        else:
            found += target.add_pulses(next(parts))
    assert_same(found, whole(law, averaging))
    assert not target.take_messages()


@pytest.mark.parametrize('delay', [-4.5, 0.0, 4.5])
def test_pulses_may_lead_or_trail_by_the_buffer_over_a_long_run(delay):
    machine = Machine(speed=20.0, rate=1000.0, components={2.0: (1.0, 0.3)}, channels=1)
    target, found = averager(shaft={'orders': (2.0,), 'trigger_cycles': 10}), []
    pulses = machine.pulses(20.0)
    for step in range(-50, 250):
        now = 0.1 * step
        found += target.add_pulses(
            pulses[(pulses >= now - delay - 1e-9) & (pulses < now - delay + 0.1 - 1e-9)])
        if 0 <= step < 200:
            found += target.add_samples(machine.block(100 * step, 100))
    assert len(found) == 39
    assert target.counts.cycles_dropped == 0 == target.timeline.counts.samples_dropped
    np.testing.assert_allclose([item.amplitudes[0, 0] for _, item in found],
                               np.exp(0.3j), atol=2e-5)


# --- amplitudes and waveforms against closed forms -----------------------------------------------


@pytest.mark.parametrize('ratio', RATIOS)
def test_order_amplitudes_of_jittered_pulses_are_exact(ratio, rng):
    components = {19.0 * ratio: (1.0, 0.3), 38.0 * ratio: (0.5, -2.0), 3.0 * ratio: (0.7, 1.0)}
    machine = Machine(speed=10.0 / ratio, rate=9000.0, components=components)
    pulses = machine.pulses(50 / machine.speed)
    pulses += rng.uniform(-0.1, 0.1, pulses.size) / (19.0 * 10.0)
    pulses[0] = abs(pulses[0])
    orders = (3.0, 19.0, 38.0, 2.5)
    target = averager(timeline=VibrationTimeline(buffer_seconds=60.0),
                      shaft={'cycle_length': ratio, 'orders': orders, 'trigger_cycles': 12})
    found = feed(target, machine, seconds=51 / machine.speed, pulses=pulses)
    assert len(found) == 4
    for number, (_, average) in enumerate(found):
        read = pulses[12 * number:12 * number + 13]
        np.testing.assert_array_equal(average.pulses, read)
        assert average.first_angle == pytest.approx(12 * number * ratio)
        truth = machine.amplitudes(read, orders, cycles=ratio, angle=average.first_angle)
        np.testing.assert_allclose(average.amplitudes[0], truth, atol=2e-4)
        np.testing.assert_allclose(average.amplitudes[1], 2.0 * truth, atol=4e-4)
        # the same without the leakage of other components: Camerini et al. 2019, Eq. 26
        error = (read * machine.speed - np.arange(12 * number, 12 * number + 13)) * ratio
        for order, (amplitude, phase) in ((19.0, (1.0, 0.3)), (38.0, (0.5, -2.0))):
            gains = np.exp(1j * np.pi * order * (error[:-1] + error[1:])) * np.sinc(
                order * np.diff(error))
            assert abs(average.amplitudes[0, orders.index(order)]
                       - amplitude * np.exp(1j * phase) * gains.mean()) < 0.03 / ratio


@pytest.mark.parametrize('method', ['band_limited', 'linear', 'cubic', 'spline'])
def test_gain_through_the_averager_is_that_of_the_interpolator(method):
    """The waveform holds it; amplitudes are over it."""
    shares = np.array([0.05, 0.09, 0.17, 0.25, 0.3])
    rate, speed = 10007.0, 23.7
    orders = tuple(np.round(shares * rate / speed).tolist())
    machine = Machine(speed=speed, rate=rate, channels=1,
                      components={order: (1.0, order) for order in orders})
    # with 2.5 revolutions a cycle the waveform has a grid of its own
    for ratio, teeth in ((1.0, 1), (1.0, 2)):
        (_, average), *_ = feed(
            averager(validator=PulseValidator(pulses_per_revolution=1, pulses_per_trigger=teeth),
                     shaft={'cycle_length': ratio * teeth, 'orders': orders, 'trigger_cycles': 40,
                            'interpolation': method}), machine, seconds=4.0)
        expected = interpolator_gain(method, np.array(orders) * speed / rate)
        np.testing.assert_allclose(np.abs(average.amplitudes[0]), 1.0, atol=2e-3)
        np.testing.assert_allclose(average.gain, expected, atol=1e-5)
        if method == 'band_limited':
            loss = -20.0 * np.log10(expected)
            assert np.all(np.abs(loss) < np.where(shares <= 0.171, 0.001, 0.01))
        spectrum = 2.0 * np.abs(np.fft.rfft(average.waveform[0])) / average.waveform.shape[1]
        np.testing.assert_allclose(spectrum[np.array(orders, dtype=int)], expected, atol=2e-3)


@pytest.mark.parametrize('ratio', RATIOS)
def test_waveform_is_exact_where_fundamental_cycles_straddle_pulses(ratio):
    # speed changes from cycle to cycle, which the linear law follows exactly
    rate, trigger = 20000.0, 25.0 / ratio
    period = (1.0 + 0.02 * np.sin(np.arange(30))) / trigger
    pulses = np.concatenate(([0.0], np.cumsum(period)))
    times = np.arange(int(pulses[-1] * rate)) / rate
    angle = ratio * np.interp(times, pulses, np.arange(31.0))

    def wave(theta):
        return np.cos(2 * np.pi * 5 * theta + 0.5) + 0.5 * np.cos(2 * np.pi * 12 * theta) + 0.3

    target = averager(timeline=VibrationTimeline(buffer_seconds=90.0),
                      shaft={'cycle_length': ratio, 'orders': (5.0, 12.0), 'trigger_cycles': 9})
    target.add_pulses(pulses)
    found = target.add_samples(SampleBlock(wave(angle)[None], 0.0, rate, 0))
    assert len(found) == 3
    for number, (_, average) in enumerate(found):
        first, last = 9 * number * ratio, 9 * (number + 1) * ratio
        assert average.fundamental_cycles == np.floor(last + 1e-9) - np.ceil(first - 1e-9)
        points = average.waveform.shape[1]
        np.testing.assert_allclose(average.waveform[0], wave(np.arange(points) / points),
                                   atol=2e-3)
        assert np.all(average.standard_error < 2e-3)
        np.testing.assert_allclose(average.amplitudes[0, 0], np.exp(0.5j), atol=0.05)


def test_waveform_of_less_than_a_fundamental_cycle_is_undefined():
    machine = Machine(channels=1)
    (_, average), *_ = feed(averager(shaft={'cycle_length': 0.4137, 'trigger_cycles': 2}), machine,
                            seconds=1.0)
    assert average.fundamental_cycles == 0
    assert np.isnan(average.waveform).all()
    assert np.isfinite(average.amplitudes).all()


@pytest.mark.parametrize('averaging', AVERAGING)
def test_a_cycle_that_began_before_the_window_is_not_in_its_waveform(averaging):
    """A fundamental cycle of 50 trigger cycles does not fit into a window of 40."""
    shaft = ShaftAverager(AverageSettings(cycle_length=0.02, trigger_cycles=40,
                                          averaging=averaging))
    for number in range(200):
        cycle = CycleSamples(np.full((200, 1), float(number)), 0.04 * number - 0.03, 2000.0,
                             0.04 * (number + np.arange(2.0)), 0)
        average = shaft.update(cycle)
        if average is None:
            continue
        if averaging == 'exponential' and number >= 49:
            assert average.fundamental_cycles == 1
            assert np.isfinite(average.waveform).all()
        else:
            assert average.fundamental_cycles == 0
            assert np.isnan(average.waveform).all()


def steady_cycles(ratio, order, first, count, rate=93750.0, speed=25.0):
    """Yield trigger cycles of a cosine, the angle counted in whole numbers from cycle `first`."""
    period, margin = 1.0 / speed, 40
    times = (np.arange(round(period * rate) + 2 * margin + 2) - margin) / rate
    for number in range(first, first + count):
        angle = float(Fraction(ratio).limit_denominator(1000) * number % 1) + ratio * speed * times
        start = (number - first) * period
        yield CycleSamples(np.cos(2.0 * np.pi * order * angle)[:, None], start - margin / rate,
                           rate, np.array([start, start + period]), 0)


@pytest.mark.parametrize('averaging', AVERAGING)
@pytest.mark.parametrize('first', [0, 6_000_000, 1_000_000_000])
@pytest.mark.parametrize(('ratio', 'points'), [(2.2, 2048), (2.4, 0), (7 / 3, 1000)])
def test_the_angle_is_as_good_after_years(averaging, first, ratio, points):
    """Rounded, the angle of the waveform was wrong by a point after 2.4E5 s at 25 Hz."""
    shaft = ShaftAverager(AverageSettings(
        cycle_length=ratio, trigger_cycles=15, orders=(100.0,), averaging=averaging,
        samples_per_revolution=points), first_cycle=first)
    for cycle in steady_cycles(ratio, 100.0, first, 40):
        average = shaft.update(cycle) or None
        if average is not None:
            line = 2.0 * np.fft.rfft(average.waveform[0])[100] / average.waveform.shape[1]
            assert abs(line - 1.0) < 1e-4
            assert abs(average.amplitudes[0, 0] - 1.0) < 1e-4
            assert average.fundamental_cycles in (math.floor(15 * ratio) - 1,
                                                  math.floor(15 * ratio))


def test_time_since_1970_costs_nothing():
    """A sample at 1.76E9 s falls between doubles 0.24 us apart: 0.06 rad at 40 kHz."""
    rate, frequency, found = 93750.0, 40e3, []
    pulses = np.arange(12) / 32.0  # exact there, too
    for start in (0.0, 1.76e9):
        averager = StreamingAverager(
            {'shaft': AverageSettings(trigger_cycles=10, orders=(frequency / 32.0,))},
            validator=PulseValidator(), timeline=VibrationTimeline())
        averager.add_pulses(start + pulses)
        for index in range(0, 36000, 4000):
            times = (index + np.arange(4000)) / rate
            for _, average in averager.add_samples(SampleBlock(
                    np.cos(2.0 * np.pi * frequency * times)[None], start + index / rate, rate,
                    index)):
                found.append(average.amplitudes[0, 0])
    np.testing.assert_allclose(found[1], found[0], atol=1e-9)


@pytest.mark.parametrize('averaging', ['sliding', 'exponential'])
def test_noise_of_a_window_is_estimated_anew_when_an_eighth_of_it_is(averaging, rng):
    shaft = ShaftAverager(AverageSettings(trigger_cycles=40, averaging=averaging))
    noise = []
    for number in range(61):
        average = shaft.update(CycleSamples(
            rng.standard_normal((200, 1)), 0.04 * number - 0.03, 2000.0,
            0.04 * (number + np.arange(2.0)), 0))
        if average is not None:
            noise.append(float(average.noise[0, 0]))
    assert np.isfinite(noise).all()
    assert np.flatnonzero(np.diff(noise)).tolist() == [4, 9, 14, 19]


@pytest.mark.parametrize('ratio', [1.0, 2.40789])
def test_coarse_angular_grid_does_not_alias(ratio):
    machine = Machine(speed=20.0, rate=12800.0, channels=1, components={
        5.0 * ratio: (0.5, 0.0), 12.0 * ratio: (0.4, 1.0), 28.0 * ratio: (1.0, 0.0),
        40.0 * ratio: (1.0, 0.7), 64.0 * ratio: (1.0, 2.0)})
    # the very first cycle has no samples before it, of which a long filter takes note
    _, (_, average), *_ = feed(averager(shaft={
        'cycle_length': ratio, 'orders': (5.0, 40.0), 'samples_per_revolution': 32,
        'trigger_cycles': 40}), machine, seconds=4.2)
    spectrum = 2.0 * np.abs(np.fft.rfft(average.waveform[0])) / 32
    expected = np.zeros(17)
    expected[[5, 12]] = 0.5, 0.4
    np.testing.assert_allclose(spectrum, expected, atol=2e-3)
    # the order amplitudes do not go through that grid
    np.testing.assert_allclose(np.abs(average.amplitudes[0]), [0.5, 1.0], atol=1e-2)


def test_orders_from_the_nyquist_frequency_on_are_undefined():
    machine = Machine(speed=20.0, rate=1000.0, components={4.0: (1.0, 0.0)}, channels=1)
    (_, average), *_ = feed(averager(shaft={'orders': (4.0, 24.9, 25.0, 26.0, 1e6)}), machine,
                            seconds=3.0)
    np.testing.assert_array_equal(np.isnan(average.amplitudes[0]), [0, 0, 1, 1, 1])
    np.testing.assert_array_equal(np.isnan(average.noise[0]), [0, 0, 1, 1, 1])


@pytest.mark.parametrize('averaging', AVERAGING)
def test_order_is_defined_again_when_the_speed_has_come_down(averaging):
    periods = np.concatenate((np.full(12, 1 / 20.0), np.geomspace(1 / 20.0, 1 / 30.0, 10),
                              np.geomspace(1 / 30.0, 1 / 20.0, 10), np.full(30, 1 / 20.0)))
    pulses = np.cumsum(periods)
    times = np.arange(int(pulses[-1] * 1000.0) + 20) / 1000.0
    wave = np.cos(2.0 * np.pi * np.interp(times, pulses, np.arange(1.0, 63.0)))
    target = averager(shaft={'orders': (1.0, 20.0), 'trigger_cycles': 5, 'averaging': averaging})
    target.add_pulses(pulses)
    found = target.add_samples(SampleBlock(wave[None], 0.0, 1000.0, 0))
    defined = [np.isfinite(item.amplitudes[0, 1]) for _, item in found]
    assert defined[0]
    assert not all(defined)
    assert defined[-1]
    assert all(np.isfinite(item.amplitudes[0, 0]) for _, item in found)
    np.testing.assert_allclose(found[-1][1].amplitudes[0, 0], 1.0, atol=0.02)


def test_shaft_beyond_the_nyquist_frequency_is_discarded_and_the_others_go_on():
    machine = Machine(speed=20.0, rate=1000.0, components={1.0: (1.0, 0.0)}, channels=1)
    target = averager(fast={'cycle_length': 26.0, 'trigger_cycles': 10},
                      shaft={'orders': (1.0,), 'trigger_cycles': 10})
    found = feed(target, machine, seconds=3.02)
    assert [name for name, _ in found] == ['shaft'] * 6
    assert [item.first_angle for _, item in found] == [0.0, 10.0, 20.0, 30.0, 40.0, 50.0]
    assert target.counts.cycles_dropped == 60
    line = target.take_messages()[0]
    assert 'shaft frequency 520 Hz is not below half the sampling rate of 1000 Hz' in line


# --- laws ----------------------------------------------------------------------------------------


def accelerated(law, phase, *, rate=20000.0, cycles=40):
    """Return the amplitude of order 9 when the angle is `phase(t)` revolutions."""
    times = np.arange(int(2.0 * rate)) / rate
    angle = phase(times)
    pulses = np.interp(np.arange(np.ceil(angle[0]), angle[-1]), angle, times)
    for _ in range(4):  # Newton, from linear interpolation to the exact time
        step = (phase(pulses + 1e-7) - phase(pulses - 1e-7)) / 2e-7
        pulses -= (phase(pulses) - np.round(phase(pulses))) / step
    target = averager(shaft={'orders': (9.0,), 'trigger_cycles': cycles, 'angle_law': law})
    target.add_pulses(pulses)
    (_, average), *_ = target.add_samples(
        SampleBlock(np.cos(2.0 * np.pi * 9.0 * angle)[None], 0.0, rate, 0))
    return complex(average.amplitudes[0, 0])


def test_quadratic_law_is_exact_for_constant_acceleration():
    def phase(t):
        return 20.0 * t + 15.0 * t * t

    assert abs(accelerated('quadratic', phase) - 1.0) < 1e-5
    assert abs(accelerated('linear', phase) - 1.0) > 1e-3
    assert abs(accelerated('spline', phase) - 1.0) < 1e-4


def test_spline_law_follows_a_smooth_speed_best():
    def phase(t):
        return 30.0 * t + 0.3 * np.sin(2.0 * np.pi * 4.0 * t)

    errors = [abs(accelerated(law, phase) - 1.0) for law in ('spline', 'quadratic', 'linear')]
    assert errors[0] < 4e-3
    assert errors[0] < 0.1 * errors[1]
    assert errors[1] < 0.5 * errors[2]


# --- noise ---------------------------------------------------------------------------------------


@pytest.mark.machines
@pytest.mark.parametrize(('ratio', 'jitter'), [(1.0, 0.0), (2.40789, 0.0), (1.0, 0.04)])
def test_noise_estimate_is_the_scatter_along_the_radius(ratio, jitter, rng):
    rate, speed, cycles, averages = 3200.0 * np.ceil(ratio), 50.0, 24, 100
    # a single order where pulses jitter: what leaks from another would add to the noise
    orders = (3.0,) if jitter else (2.0, 3.0)
    machine = Machine(speed=speed, rate=rate, channels=2,
                      components={g * ratio: (20.0, 0.3) for g in orders})
    target = averager(shaft={'cycle_length': ratio, 'orders': orders, 'trigger_cycles': cycles})
    seconds = cycles * averages / speed + 0.1
    pulses = machine.pulses(seconds)
    pulses += jitter / (3.0 * speed) * rng.uniform(-0.5, 0.5, pulses.size)
    found, size = [], 800
    for index in range(0, int(seconds * rate), size):
        end = (index + size) / rate
        block = machine.block(index, size)
        found += target.add_samples(SampleBlock(
            block.samples + rng.standard_normal((2, size)), index / rate, rate, index))
        found += target.add_pulses(pulses[(pulses >= end - size / rate) & (pulses < end)])
    found = [item for _, item in found][:averages]
    assert len(found) == averages
    theory = 2.0 / (rate * cycles / speed)  # THEORY: 2 s2 / (fs T)
    estimate = np.array([item.noise for item in found]) ** 2
    count = estimate.size
    # a median of 11 lines scatters by about 1 / sqrt(11 x 0.48)
    assert estimate.mean() / theory == pytest.approx(1.0, abs=4.0 * 0.45 / np.sqrt(count) + 0.02)
    radius = np.array([
        (item.amplitudes * np.exp(-1j * np.angle([machine.amplitudes(
            item.pulses, orders, cycles=ratio, angle=item.first_angle)]))).real
        - np.arange(1, 3)[:, None] * np.abs([machine.amplitudes(
            item.pulses, orders, cycles=ratio, angle=item.first_angle)]) for item in found])
    assert radius.var() / theory == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / count) + 0.02)
    assert abs(radius.mean()) < 4.0 * np.sqrt(theory / count)


def test_standard_error_of_the_waveform_is_its_scatter(rng):
    rate, speed, cycles = 2000.0, 50.0, 16
    target = averager(shaft={'trigger_cycles': cycles})
    count = int(rate * (100 * cycles / speed + 0.1))
    noise = rng.standard_normal((1, count))
    found = []
    for index in range(0, count, 2000):
        found += target.add_samples(SampleBlock(
            noise[:, index:index + 2000], index / rate, rate, index))
        found += target.add_pulses(np.arange(index / 40, (index + 2000) / 40) / speed)
    waveforms = np.array([item.waveform for _, item in found])
    errors = np.array([item.standard_error for _, item in found])
    assert len(found) == 100
    # some 40 independent points in each of 100 averages; errors have 15 degrees of freedom
    spread = np.sqrt(2.0 / (40 * 100) + 2.0 / (15 * 40 * 100))
    assert (errors**2).mean() / waveforms.var() == pytest.approx(
        widened(1.0, 15.0)**2, abs=4.0 * spread)


# --- kinds of average ----------------------------------------------------------------------------


def single_cycles(samples, pulses, rate, cycles, order):
    """Return the amplitude of every trigger cycle, one average each."""
    target = averager(shaft={'cycle_length': cycles, 'orders': (order,), 'trigger_cycles': 1})
    target.add_pulses(pulses)
    return np.array([item.amplitudes for _, item in target.add_samples(
        SampleBlock(samples, 0.0, rate, 0))])


@pytest.mark.parametrize('cycles', [1.0, 2.40789])
def test_kinds_of_average_weigh_the_cycles_as_they_say(cycles, rng):
    samples, pulses = rng.standard_normal((2, 4000)), np.arange(0.01, 3.9, 0.1)
    order = 7.0 / cycles  # whole in a trigger cycle, or each average has another mean of samples
    single = single_cycles(samples, pulses, 1000.0, cycles, order)
    found = {}
    for averaging in AVERAGING:
        target = averager(shaft={'cycle_length': cycles, 'orders': (order,), 'trigger_cycles': 6,
                                 'averaging': averaging})
        target.add_pulses(pulses)
        found[averaging] = [item for _, item in target.add_samples(
            SampleBlock(samples, 0.0, 1000.0, 0))]
    count = len(single)
    assert [len(found[kind]) for kind in AVERAGING] == [count // 6, count - 5, count - 5]
    exponential, weight = single[0], 2.0 / 7.0
    for last in range(count):
        exponential = exponential + max(weight, 1.0 / (last + 1)) * (single[last] - exponential)
        if last < 5:
            continue
        sliding, smoothed = found['sliding'][last - 5], found['exponential'][last - 5]
        mean = single[last - 5:last + 1].mean(axis=0)
        np.testing.assert_allclose(sliding.amplitudes, mean, atol=1e-12)
        np.testing.assert_allclose(smoothed.amplitudes, exponential, atol=1e-12)
        np.testing.assert_array_equal(sliding.pulses, pulses[last - 5:last + 2])
        assert sliding.first_angle == pytest.approx(cycles * (last - 5))
        assert sliding.sequence == last - 5 == smoothed.sequence
        whole_cycles = np.floor((last + 1) * cycles + 1e-9) - np.ceil((last - 5) * cycles - 1e-9)
        assert sliding.fundamental_cycles == whole_cycles
        if last % 6 == 5:
            block = found['block'][last // 6]
            for key in FIELDS[3:]:
                np.testing.assert_allclose(getattr(sliding, key), getattr(block, key),
                                           rtol=1e-9, atol=1e-12, err_msg=key)


@pytest.mark.parametrize(('ratio', 'trigger_cycles', 'averaging'), [
    (2.4, 2, 'block'), (2.40789, 7, 'exponential'), (53.0 / 37.0, 5, 'sliding'),
    (0.41, 12, 'block'), (3.0, 4, 'block')])
def test_a_constant_in_the_samples_changes_no_amplitude(ratio, trigger_cycles, averaging, rng):
    """It stays in an order that has fewer than ten cycles, which leak into the mean themselves."""
    time, pulses = np.arange(2000) / 1000.0, np.arange(0.01, 1.9, 0.1)
    pulses = pulses + rng.uniform(0.0, 1e-3, pulses.size)
    samples = np.cos(2.0 * np.pi * 30.0 * ratio * time) + 0.1 * rng.standard_normal((2, time.size))
    found, law = [], str(rng.choice(['linear', 'spline']))
    for constant in (0.0, 9.81):
        target = averager(shaft={
            'cycle_length': ratio, 'orders': (3.0, 4.5, 1.1), 'angle_law': law,
            'averaging': averaging, 'trigger_cycles': trigger_cycles})
        target.add_pulses(pulses)
        found.append([item for _, item in target.add_samples(
            SampleBlock(samples + constant, 0.0, 1000.0, 0))])
    orders = slice(3 if 1.1 * ratio * trigger_cycles >= 10.0 else 2)
    names = 'amplitudes', 'cycle_amplitudes', *['noise'] * (orders.stop == 3)
    for one, other in zip(*found, strict=True):
        for name in names:
            # The interpolator and the integral around the pulses leave 1e-6 of the constant.
            np.testing.assert_allclose(getattr(one, name)[..., orders],
                                       getattr(other, name)[..., orders], atol=2e-5)
        leaks = np.abs(one.amplitudes - other.amplitudes)[:, orders.stop:]
        assert np.all(leaks > 0.1)
        np.testing.assert_allclose(one.waveform + constant, other.waveform, atol=2e-5)


# --- gaps, restarts ------------------------------------------------------------------------------


def check(machine, found, *, orders, trigger_cycles, lost_spans=()):
    """Check every average against the cycles it claims; `lost_spans` (s) have no samples."""
    for _, average in found:
        assert len(average.pulses) == trigger_cycles + 1
        np.testing.assert_allclose(np.diff(average.pulses), 1.0 / machine.speed, rtol=1e-6)
        truth = machine.amplitudes(average.pulses, orders, angle=average.first_angle)
        np.testing.assert_allclose(average.amplitudes[0], truth, atol=3e-4)
        for start, end in lost_spans:
            assert average.end_time <= start or average.start_time >= end


@pytest.mark.parametrize('lag', [-0.4, 0.0, 0.4])
@pytest.mark.parametrize('fault', ['lost', 'nan', 'infinite', 'shape', 'swapped', 'late'])
def test_fault_costs_its_cycles_and_nothing_else(fault, lag):
    machine = Machine()
    target = averager(shaft={'orders': (1.0, 7.0, 23.0), 'trigger_cycles': 8})
    size, found, pulses = 640, [], machine.pulses(4.0)
    blocks = [machine.block(index, size) for index in range(0, 51200, size)]
    if fault == 'lost':
        del blocks[30]
    elif fault in ('nan', 'infinite'):
        blocks[30].samples[:, 300] = np.nan if fault == 'nan' else -np.inf
    elif fault == 'shape':
        blocks[30] = SampleBlock(blocks[30].samples[:1], blocks[30].start_time, machine.rate,
                                 blocks[30].index)
    elif fault == 'swapped':
        blocks[30], blocks[31] = blocks[31], blocks[30]
    else:
        blocks.insert(35, blocks.pop(30))
    for step in range(90):
        now = step * size / machine.rate
        found += target.add_pulses(pulses[(pulses >= now - lag - size / machine.rate)
                                          & (pulses < now - lag)])
        if step < len(blocks):
            if fault == 'shape' and step == 30:
                with pytest.raises(SignalError, match='block of 1 channels'):
                    target.add_samples(blocks[step])
            else:
                found += target.add_samples(blocks[step])
    lost = (1.50, 1.55) if fault not in ('nan', 'infinite') else (1.5233, 1.5236)
    check(machine, found, orders=(1.0, 7.0, 23.0), trigger_cycles=8, lost_spans=[lost])
    assert 14 <= len(found) <= 16
    assert 1 <= target.counts.cycles_dropped <= 3
    assert target.counts.averages_dropped <= 1
    assert found[-1][1].end_time > 3.6
    # the angle starts anew behind the gap
    angles = [item.first_angle for _, item in found]
    again = angles.index(0.0, 1)
    np.testing.assert_allclose(angles, [8.0 * k for k in range(again)]
                               + [8.0 * k for k in range(len(angles) - again)])


@pytest.mark.parametrize('first', [0.05, 0.3, 2.0])
@pytest.mark.parametrize('lead', [-0.3, 0.0, 0.3])
@pytest.mark.parametrize('start', [0.0, 1000.0])
def test_restart_of_both_sources_begins_again(first, lead, start):
    """The second run differs in amplitude, so that a mixture would show."""
    orders, size = (1.0, 7.0, 23.0), 256
    old = Machine()
    new = Machine(components={1.0: (3.0, -0.4), 7.0: (1.5, 0.1), 23.0: (0.7, 1.0)})
    target = averager(shaft={'orders': orders, 'trigger_cycles': 8})
    results = []
    events = []  # vibration of a run, then that of the next; pulses lead or trail
    for run, (machine, seconds) in enumerate(((old, first), (new, 3.0))):
        begin = run * (first + 0.02)
        for index in range(0, int(seconds * machine.rate) - size + 1, size):
            at = begin + index / machine.rate
            events.append((at, machine.block(index, size, start=start)))
        pulses = machine.pulses(seconds, start)
        events += [(begin + pulse - start - lead, np.array([pulse])) for pulse in pulses]
    for _, event in sorted(events, key=lambda item: item[0]):
        add = target.add_pulses if isinstance(event, np.ndarray) else target.add_samples
        results.append((event, add(event)))
    found = [item for _, items in results for item in items]
    of_old = [item for item in found if item[1].amplitudes[0, 0].real > 0.0
              and abs(item[1].amplitudes[0, 0]) < 2.0]
    of_new = found[len(of_old):]
    assert target.timeline.counts.restarts == 1
    assert len(of_old) == max(int((first - 0.05) * old.speed) // 8, 0)
    check(old, of_old, orders=orders, trigger_cycles=8)
    # the angle is 0 at the first pulse, which is not at time 0 where `start` is not
    turn = np.exp(2j * np.pi * np.array(orders) * new.pulses(3.0, start)[0] * new.speed)
    np.testing.assert_allclose(turn, 1.0, atol=1e-6)
    shifted = new.pulses(3.0, start)
    for number, (_, average) in enumerate(of_new):
        assert average.first_angle == 8.0 * number
        truth = new.amplitudes(average.pulses, orders, angle=average.first_angle)
        np.testing.assert_allclose(average.amplitudes[0], truth, atol=1e-3)
    # two pulses are too few to tell that time ran back behind them: the next ones are taken for
    # the old run's until it is over, and for as long again as the new run overlaps it
    lost = max(lead, 0.0) + 2.0 * first + 1.0 / new.speed if first < 0.1 else 0.0
    assert shifted[0] - 1e-9 <= of_new[0][1].start_time <= shifted[0] + lost + 1e-9
    assert len(of_new) >= 11 - (lost > 0.0)


def test_pulses_that_come_only_after_a_restart_are_used_within_the_buffer():
    machine = Machine()
    target = averager(timeline=VibrationTimeline(buffer_seconds=1.0),
                      shaft={'orders': (1.0,), 'trigger_cycles': 8})
    for index in range(0, 12800 * 30, 1280):  # half a minute without a pulse
        target.add_samples(machine.block(index, 1280))
    found = feed(target, machine, seconds=5.0, chunk=0.1)
    check(machine, found, orders=(1.0,), trigger_cycles=8)
    assert len(found) >= 15
    assert target.timeline.counts.restarts == 1


# --- bounded memory ------------------------------------------------------------------------------


def test_pulses_without_vibration_are_bounded():
    target = averager(timeline=VibrationTimeline(buffer_seconds=2.0), shaft={})
    for start in range(0, 100, 5):
        assert target.add_pulses(np.arange(start, start + 5, 0.01)) == []
        assert len(target._triggers) <= 202
    assert target.counts.pulses_dropped > 9700
    assert target.counts.cycles_dropped == target.counts.pulses_dropped
    assert 'waited longer than buffer_seconds = 2 s' in target.take_messages()[-1]


def test_pulses_that_start_again_and_again_without_vibration_are_bounded():
    target = averager(timeline=VibrationTimeline(buffer_seconds=2.0), shaft={})
    for _ in range(50):
        target.add_pulses(np.arange(0.0, 1.0, 0.01))
        assert len(target._triggers) <= 320
    assert target.counts.pulses_dropped > 4500


def test_vibration_without_pulses_is_bounded():
    machine = Machine()
    target = averager(timeline=VibrationTimeline(buffer_seconds=0.5), shaft={})
    tracemalloc.start()
    for index in range(0, 12800 * 60, 1280):
        target.add_samples(machine.block(index, 1280))
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert sum(len(item.samples) for item in target.timeline.segments) == 6400
    assert held < 1e6
    assert target.timeline.counts.samples_dropped == 12800 * 60 - 6400


def test_trigger_cycle_longer_than_the_buffer_says_so():
    machine = Machine(speed=0.5, components={10.0: (1.0, 0.0)}, rate=1000.0)
    target = averager(timeline=VibrationTimeline(buffer_seconds=1.0),
                      shaft={'orders': (10.0,), 'trigger_cycles': 2})
    assert feed(target, machine, seconds=60.0) == []
    assert target.counts.cycles_dropped >= 25
    assert 'longer than buffer_seconds = 1 s: raise it' in target.take_messages()[0]


def test_restarts_without_end_are_bounded():
    machine = Machine(rate=1000.0)
    target = averager(shaft={'trigger_cycles': 8})
    for _ in range(60):
        feed(target, machine, seconds=0.5, chunk=0.1)
        assert sum(len(item.samples) for item in target.timeline.segments) <= 5000
        assert len(target._triggers) < 60
    assert target.timeline.counts.restarts == 59


# --- settings while it runs ----------------------------------------------------------------------


def test_change_loses_the_unfinished_average_and_keeps_the_angle():
    machine = Machine()
    target = averager(shaft={'orders': (1.0, 7.0), 'trigger_cycles': 10})
    found = target.add_samples(machine.block(0, 12800))
    found += target.add_pulses(machine.pulses(0.45))
    target.change({'shaft': AverageSettings(orders=(7.0,), trigger_cycles=4)})
    assert target.counts.averages_dropped == 1
    later = machine.pulses(0.5, 0.45)
    found = target.add_pulses(later)
    assert [item.first_angle for _, item in found] == [14.0, 18.0, 22.0, 26.0]
    check(machine, found, orders=(7.0,), trigger_cycles=4)
    assert [item.sequence for _, item in found] == [1, 2, 3, 4]


def test_change_of_law_uses_the_pulses_that_the_new_one_needs():
    machine = Machine()
    target = averager(shaft={'orders': (1.0,), 'trigger_cycles': 10})
    found = feed(target, machine, seconds=1.0)
    target.change({'shaft': AverageSettings(orders=(1.0,), trigger_cycles=10, angle_law='spline')})
    found += target.add_samples(machine.block(12800, 12800))
    found += target.add_pulses(machine.pulses(1.0, 1.0))
    check(machine, found, orders=(1.0,), trigger_cycles=10)
    assert len(found) == 5


def test_change_of_pulses_starts_the_angle_anew():
    machine = Machine()
    target = averager(shaft={'orders': (1.0,), 'trigger_cycles': 10})
    assert len(feed(target, machine, seconds=1.0)) == 3
    target.change_pulses(PulseValidator())
    target.add_samples(machine.block(12800, 12800))
    (_, first), *_ = target.add_pulses(machine.pulses(0.9, 1.0))
    assert first.first_angle == 0.0
    assert first.start_time == pytest.approx(34 / 33.3)


def test_speed_is_the_mean_of_the_cycles_since_the_last_call():
    machine = Machine()
    target = averager(shaft={})
    assert np.isnan(target.take_speed())
    feed(target, machine, seconds=1.0)
    assert target.take_speed() == pytest.approx(33.3)
    assert np.isnan(target.take_speed())


@pytest.mark.parametrize(('wrong', 'says'), [
    ({'cycle_length': 0.0}, 'positive ratio'), ({'cycle_length': np.nan}, 'nan'),
    ({'trigger_cycles': 0}, 'trigger_cycles is 0'), ({'orders': ()}, r'orders are \[\]'),
    ({'orders': (1.0, -2.0)}, '-2.0'), ({'orders': (np.inf,)}, 'inf'),
    ({'samples_per_revolution': 3}, 'at least 4'), ({'averaging': 'median'}, 'block, sliding'),
    ({'angle_law': 'cubic'}, 'linear, quadratic, spline'),
    ({'interpolation': 'best'}, 'band_limited'),
])
def test_settings_that_cannot_be_used_are_refused(wrong, says):
    with pytest.raises(ParameterError, match=says):
        AverageSettings(**wrong)


def test_averager_needs_a_shaft():
    with pytest.raises(ParameterError, match='no shaft'):
        StreamingAverager({}, validator=PulseValidator(), timeline=VibrationTimeline())


def test_late_block_beside_a_restart_leaves_no_pulse_behind():
    """Pulses that ran back do not make a restart of a block that is merely late."""
    machine = Machine()
    target = averager(shaft={'orders': (1.0,), 'trigger_cycles': 8})
    feed(target, machine, seconds=2.0)
    blocks = [machine.block(25600 + 1280 * k, 1280) for k in range(4)]
    target.add_samples(blocks[1])
    target.add_pulses(machine.pulses(0.3, 1000.0) - 1000.0)  # the source starts again
    for late in (blocks[0], blocks[2], blocks[3]):
        target.add_samples(late)
    found = []
    for index in range(0, 38400, 1280):
        found += target.add_samples(machine.block(index, 1280))
        found += target.add_pulses(machine.pulses(0.1, 0.3 + index / 12800))
    assert target.timeline.counts.restarts == 1
    assert len(found) >= 2.5 * machine.speed // 8
    check(machine, found, orders=(1.0,), trigger_cycles=8)


@pytest.mark.parametrize('averaging', ['block', 'sliding', 'exponential'])
def test_a_fundamental_cycle_that_ends_behind_the_last_pulse_is_not_in_the_waveform(averaging):
    """All its points are, where the grid is coarser than what is missing of the cycle."""
    ratio, count = 1.9975, 2  # windows end at 3.995, 5.9925, ... of which 3.99 is a point
    machine = Machine(components={ratio: (1.0, 0.4)})
    target = averager(shaft={'cycle_length': ratio, 'orders': (1.0,), 'trigger_cycles': count,
                             'samples_per_revolution': 100, 'averaging': averaging})
    found = feed(target, machine, seconds=1.0)
    for _, average in found:
        start, end = average.first_angle, average.first_angle + count * ratio
        assert average.fundamental_cycles == np.floor(end + 1e-9) - np.ceil(start - 1e-9)
        wave = np.cos(2.0 * np.pi * np.arange(100) / 100 + 0.4)
        np.testing.assert_allclose(average.waveform[0], wave, atol=3e-4)
    assert len(found) > 10


def test_every_sample_is_averaged_or_counted():
    """400 samples a cycle; what is received beside a lost block is dropped with its cycle."""
    machine = Machine(speed=32.0)
    target = averager(shaft={'orders': (1.0,), 'trigger_cycles': 4})
    lost, bad, received = (21, 22), 40, 0
    for number in range(100):
        block = machine.block(160 * number, 160)
        if number == bad:
            block.samples[:, 7] = np.nan
        if number not in lost:
            target.add_samples(block)
            received += 160
        target.add_pulses(machine.pulses(160 / 12800, 160 * number / 12800))
    counts = target.timeline.counts
    assert (counts.gaps, counts.samples_lost) == (1, 320)
    # samples 3360 to 3679 of the cycles 8 and 9 are lost, sample 6407 of cycle 16 is no number
    assert counts.samples_dropped == (800 - 320) + 400
    assert target.counts.cycles == 39 - 3
    assert received == 400 * (36 + 1) + counts.samples_dropped  # the last cycle is not over


def test_counts_of_pulses_outlive_their_validator():
    machine = Machine()
    target = averager(shaft={'orders': (1.0,)})
    pulses = machine.pulses(2.0)
    target.add_pulses(np.sort(np.append(pulses, pulses[10] + 1e-3)))
    before = target.pulse_counts
    target.change_pulses(PulseValidator(interval_tolerance=0.2))
    assert target.pulse_counts == before
    target.change_pulses(PulseValidator())
    target.add_pulses(np.array([9.0]))  # waits for its like
    target.change_pulses(PulseValidator())
    assert target.pulse_counts.unlocked == 1
    assert (before.accepted, before.doubles) == (len(pulses), 1)
    assert target.counts.cycles_dropped == len(pulses) - 1  # they waited for vibration
    target.add_pulses(machine.pulses(1.0, 2.0))
    assert target.pulse_counts.accepted == len(machine.pulses(3.0))


def test_pulses_of_a_run_stay_with_it_in_a_gap_and_behind_its_end_though_the_next_overlaps_it():
    """The clock runs back by half a second; pulses trail by more; nothing of both is averaged."""
    old, new = Machine(), Machine(components={1.0: (5.0, 2.0)})
    target = averager(shaft={'orders': (1.0,), 'trigger_cycles': 2})
    for index in range(0, 24320, 1280):  # to 1.9 s of 2 s: the last block is lost, too
        if index not in (17920, 19200):  # 1.4 s to 1.6 s
            target.add_samples(old.block(index, 1280))
    for index in range(0, 38400, 1280):
        target.add_samples(new.block(index, 1280, start=1.5))
    found = target.add_pulses(old.pulses(2.0))
    assert len(found) > 20
    check(old, found, orders=(1.0,), trigger_cycles=2, lost_spans=[(1.4, 1.6), (1.9, 9.0)])
    later = [item for pulse in new.pulses(3.0, 1.5) for item in target.add_pulses([pulse])]
    assert len(later) > 40
    for _, average in later:
        np.testing.assert_allclose(np.abs(average.amplitudes[0]), 5.0, rtol=1e-3)


@pytest.mark.parametrize('averaging', AVERAGING)
def test_an_average_holds_the_amplitudes_of_its_cycles(averaging):
    shaft = ShaftAverager(AverageSettings(cycle_length=2.4, trigger_cycles=20, orders=(5.0, 7.5),
                                          averaging=averaging))
    found = [average for cycle in steady_cycles(2.4, 5.0, 0, 70, rate=5000.0)
             if (average := shaft.update(cycle)) is not None]
    assert len(found) == (3 if averaging == 'block' else 51)
    for average in found:
        cycles = average.cycle_amplitudes
        assert cycles.shape == (20, 1, 2)
        assert not cycles.flags.writeable
        assert cycles[:, 0, 0] == pytest.approx(1.0, abs=0.1)  # but for leakage
        if averaging != 'exponential':
            assert cycles.mean(axis=0) == pytest.approx(average.amplitudes, abs=1e-12)
        frequency = average.orders * 2.4 * average.trigger_speed / 25.0
        assert frequency == pytest.approx(2.4 * average.orders, rel=1e-9)


def encoder(speed=50.0, marks=1024, rate=100e3, seconds=0.3):
    """Return samples with orders 3 and 20 of a shaft, and the pulses of its encoder."""
    pulses = 0.005 + np.arange(int((seconds - 0.01) * speed * marks)) / (speed * marks)
    angle = speed * (np.arange(int(seconds * rate)) / rate - 0.005)
    return (0.3 * np.cos(2.0 * np.pi * 3.0 * angle + 1.0)
            + np.cos(2.0 * np.pi * 20.0 * angle))[None], pulses


def test_encoder_whose_pulses_are_trigger_cycles_gives_the_amplitudes_of_the_shaft():
    """Trigger cycles are two samples long; thousands of them are averaged together."""
    samples, pulses = encoder()
    target = StreamingAverager({'shaft': AverageSettings(
        cycle_length=1 / 1024, trigger_cycles=4096, orders=(3.0, 20.0))},
        validator=PulseValidator(pulses_per_revolution=1024, pulses_per_trigger=1),
        timeline=VibrationTimeline())
    found = []
    for first in range(0, samples.shape[1], 3000):
        found += target.add_samples(
            SampleBlock(samples[:, first:first + 3000], first / 100e3, 100e3, first))
        passed = (pulses >= first / 100e3) & (pulses < (first + 3000) / 100e3)
        found += target.add_pulses(pulses[passed])
    assert [average.sequence for _, average in found] == [0, 1, 2]
    for _, average in found:
        expected = np.array([0.3 * np.exp(1j), 1.0])
        # a cycle is the integral over two samples by the trapezoidal rule in eight steps
        np.testing.assert_allclose(average.amplitudes[0], expected, rtol=1e-6)
        assert average.fundamental_cycles in (3, 4)
        lines = 2.0 * np.fft.rfft(average.waveform[0])[[3, 20]] / average.waveform.shape[1]
        np.testing.assert_allclose(lines, expected, rtol=1e-5)


@pytest.mark.parametrize('law', ['linear', 'quadratic', 'spline'])
def test_cycles_averaged_together_are_those_averaged_alone(law, rng):
    """Pulses stand on samples, where a kernel of polynomials has steps of 1e-8."""
    samples, pulses = rng.standard_normal((6000, 2)), np.arange(100.0, 5900.0, 100.0) / 1e3
    settings = AverageSettings(trigger_cycles=40, orders=(3.0,), angle_law=law)
    cut = {'start_time': 0.0, 'rate': 1e3, 'pulses': pulses, 'margin': 20}
    together = ShaftAverager(settings).update(
        CycleSamples.cut(samples, first=8, count=40, **cut))
    shaft = ShaftAverager(settings)
    alone = [shaft.update(CycleSamples(samples, 0.0, 1e3, pulses, 8 + k)) for k in range(40)][-1]
    shaft = ShaftAverager(settings)
    parts = [shaft.update(CycleSamples.cut(samples, first=8 + first, count=count, **cut))
             for first, count in ((0, 1), (1, 25), (26, 14))][-1]
    for other in (alone, parts):
        np.testing.assert_allclose(other.waveform, together.waveform, atol=1e-14)
        np.testing.assert_allclose(other.standard_error, together.standard_error, atol=1e-14)
        np.testing.assert_allclose(other.cycle_amplitudes, together.cycle_amplitudes, atol=1e-14)


def test_marks_are_known_by_the_vibration_only_as_far_as_their_errors_show_them():
    marks, even = np.tile(np.arange(4), 50), MarkOffsets(*np.zeros((2, 4)))
    shift = 5e-3 * np.array([1.0, -1.0, 1.0, -1.0])
    for late, known in ((0.0 * shift, False), (shift, True)):
        seen = RecoveredMarks(4)
        seen._update(marks, late[marks], np.full(200, 1e6))  # 1 mrad each
        found = seen.added_to(even, np.arange(4))
        assert found.by_vibration == known
        np.testing.assert_allclose(found.angles, late, rtol=1e-3)


def test_an_average_whose_pulses_none_was_taken_from_teaches_no_marks():
    """As behind a change of the wheel: the average before had all that were remembered."""
    seen = RecoveredMarks(2)
    seen._pulses.append((np.arange(4.0), np.array([0, 1, 0, 1]), np.full(4, 0.1), np.zeros(4)))
    for end in (10.0, 20.0):
        seen.learn(SimpleNamespace(
            end_time=end, pulses=np.arange(4.0) + end, correction=SimpleNamespace(
                accepted=True, pulse_errors=np.full(4, 1e-3), standard_errors=np.full(4, 1e-4))))
    even = MarkOffsets(*np.zeros((2, 2)))
    assert seen.added_to(even, np.arange(2)) is even
