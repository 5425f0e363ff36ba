# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""From keyphasor waveform to pulse times: exact crossings, any cutting, real tachos, bad input."""

import warnings

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
import sa_jitter_ros as sa
from sa_jitter_ros.errors import ParameterError, SignalError
from sa_jitter_ros.pulses import detection
from sa_jitter_ros.pulses.detection import KeyphasorDetector
from sa_jitter_ros.pulses.threshold import SchmittTrigger, state_levels
from scipy.signal import butter, lfilter

RATE = 10_000.0


def detect(samples, *, rate=RATE, start=0.0, cuts=(), **options):
    """Return the pulses of a waveform given in blocks, and the detector."""
    detector = KeyphasorDetector(**options)
    found, index = [], 0
    for block in np.split(samples, sorted(cuts)):
        found.append(detector.update(block, start + index / rate, rate))
        index += block.size
    found.append(detector.flush())
    return np.concatenate(found), detector


def pulse_train(times, *, seconds, width=2e-3, slope=4e-4, high=1.0, low=0.0):
    """Return trapezoidal pulses whose rising edges pass the middle at `times`."""
    t = np.arange(round(seconds * RATE)) / RATE
    wave = np.zeros(t.size)
    for time in times:
        wave += np.interp(t, time + np.array([-slope, slope, width - slope, width + slope]),
                          [0.0, 1.0, 1.0, 0.0])
    return low + (high - low) * wave


TRUE = 0.0312345 + np.cumsum(0.04 + 0.002 * np.sin(np.arange(45)))


@pytest.mark.parametrize(('high', 'low', 'polarity'), [
    (1.0, 0.0, 'positive'), (5.0, 0.2, 'positive'), (-24.0, -2.0, 'negative'),
    (1.0, -1.0, 'positive')])
def test_interpolated_edges_are_exact(high, low, polarity):
    wave = pulse_train(TRUE, seconds=2.0, high=high, low=low)
    for edge, shift in (('rising', 0.0), ('falling', 2e-3), ('centre', 1e-3)):
        pulses, _ = detect(wave, polarity=polarity, edge=edge)
        # the modal bin of the lower level holds a few samples of the edges too
        assert pulses == pytest.approx(TRUE + shift, abs=1e-7)


def test_sampled_keyphasor_rounds_up_to_its_clock():
    wave = pulse_train(TRUE, seconds=2.0)
    pulses, _ = detect(wave, start=3.0, interpolate=False)
    assert pulses - 3.0 == pytest.approx(np.ceil(TRUE * RATE) / RATE, abs=1e-9)


def test_threshold_given_without_hysteresis_needs_no_learning():
    wave = pulse_train(TRUE, seconds=0.1)
    detector = KeyphasorDetector(threshold=0.25, hysteresis=0.0)
    pulses = detector.update(wave, 0.0, RATE)
    # the slope of 0.8 ms from low to high passes a quarter 0.2 ms before the middle
    assert pulses == pytest.approx(TRUE[:pulses.size] - 2e-4, abs=1e-9)
    assert pulses.size == 1


@pytest.mark.machines
@settings(max_examples=20)
@given(cuts=st.lists(st.integers(0, 20_000), max_size=40),
       edge=st.sampled_from(['rising', 'centre']), interpolate=st.booleans(),
       seed=st.integers(0, 3))
def test_every_cutting_gives_the_same_pulses(cuts, edge, interpolate, seed):
    rng = np.random.default_rng(seed)
    drift = np.linspace(0.0, 0.8, 20_000)
    wave = pulse_train(TRUE, seconds=2.0) + drift + rng.normal(0.0, 0.02, 20_000)
    options = {'edge': edge, 'interpolate': interpolate, 'learning_time': 0.21}
    whole, one = detect(wave, start=100.0, **options)
    parts, many = detect(wave, start=100.0, cuts=cuts, **options)
    assert np.array_equal(whole, parts)
    assert one.state == many.state
    assert whole.size == TRUE.size


def test_no_pulse_is_lost_while_learning():
    wave = pulse_train(TRUE, seconds=2.0)
    detector = KeyphasorDetector()
    assert detector.update(wave[:4999], 0.0, RATE).size == 0
    assert detector.update(wave[4999:5001], 0.4999, RATE).size == np.sum(TRUE < 0.499)


def test_a_steady_waveform_keeps_its_threshold(rng):
    wave = pulse_train(TRUE, seconds=2.0) + rng.normal(0.0, 0.01, 20_000)
    detector = KeyphasorDetector()
    thresholds = set()
    for k in range(20):
        detector.update(wave[1000 * k:1000 * (k + 1)], k / 10.0, RATE)
        thresholds.add(detector.state.threshold)
    learnt = [level for level in thresholds if np.isfinite(level)]
    assert len(learnt) == 1
    # a bin of the histogram is 1 % of the range
    assert learnt[0] == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize('drift', [3.0, -3.0])
def test_a_drifting_level_is_followed(drift, rng):
    times = 0.05 + 0.04 * np.arange(240)
    wave = pulse_train(times, seconds=10.0) + rng.normal(0.0, 0.01, 100_000)
    pulses, _ = detect(wave + np.linspace(0.0, drift, wave.size))
    assert pulses.size == times.size
    # the threshold lags by at most the dead band and one and a half windows: 0.1 + 0.75 s 0.3/s
    assert np.max(np.abs(pulses - times)) < (0.1 + 0.75 * abs(drift) / 10.0) * 8e-4 + 5e-5


@pytest.mark.parametrize('noise', ['normal', 'uniform', 'bit', 'constant'])
def test_a_stopped_machine_gives_no_pulses(noise, rng):
    n = 100_000
    wave = {'normal': rng.normal(size=n), 'uniform': rng.uniform(size=n),
            'bit': rng.integers(0, 2, n), 'constant': np.full(n, 0.7)}[noise]
    pulses, detector = detect(wave)
    assert pulses.size == 0
    assert np.isnan(detector.state.threshold)


def test_stop_and_start_again(rng):
    times = 0.05 + 0.04 * np.arange(24)
    wave = np.concatenate([pulse_train(times, seconds=1.0), np.zeros(30_000),
                           pulse_train(times, seconds=1.0)])
    hum = 0.02 * np.sin(2.0 * np.pi * 50.0 * np.arange(wave.size) / RATE)
    pulses, _ = detect(wave + hum + rng.normal(0.0, 0.005, wave.size))
    # hum and noise move a crossing by their size over the slope: 0.025/(1/0.8 ms)
    assert pulses == pytest.approx(np.concatenate([times, times + 4.0]), abs=5e-5)


def test_hysteresis_ignores_noise_at_the_threshold(rng):
    t = np.arange(40_000) / RATE
    wave = np.sin(2.0 * np.pi * 20.0 * t - 0.3) + rng.normal(0.0, 0.02, t.size)
    pulses, _ = detect(wave)
    bare, _ = detect(wave, hysteresis=0.0)
    assert pulses.size == 80
    assert bare.size > 100
    error = pulses - (np.arange(80) + 0.3 / (2.0 * np.pi)) / 20.0
    # white noise over the slope of the sine, the last of a few crossings
    assert np.std(error) < 3.0 * 0.02 / (40.0 * np.pi)


def test_minimum_interval_drops_bounces():
    bounces = np.sort(np.concatenate([TRUE, TRUE + 6e-3]))
    wave = pulse_train(bounces, seconds=2.0)
    for cuts in ((), (313, 374, 9000)):
        pulses, detector = detect(wave, minimum_interval=0.01, cuts=cuts)
        assert pulses == pytest.approx(TRUE, abs=1e-7)
        assert detector.state.too_close == TRUE.size


def test_a_gap_invents_no_pulse():
    wave = pulse_train(TRUE, seconds=2.0)
    inside = round((TRUE[20] + 1e-3) * RATE)  # while the pulse is high
    detector = KeyphasorDetector(edge='centre')
    first = detector.update(wave[:10_000 - 8100 + 6000], 0.0, RATE)
    second = detector.update(wave[inside:], inside / RATE, RATE)
    known = TRUE[(TRUE < 0.78) | (np.arange(TRUE.size) > 20)]
    assert np.concatenate([first, second]) == pytest.approx(known + 1e-3, abs=1e-7)


def test_a_block_that_is_left_out_is_a_gap_and_no_pulse():
    wave = pulse_train(TRUE, seconds=2.0)
    start, end = round((TRUE[20] + 1e-3) * RATE), round((TRUE[22] + 1e-3) * RATE)
    detector = KeyphasorDetector()
    first = detector.update(wave[:start], 0.0, RATE)
    last = detector.update(wave[end:], end / RATE, RATE)
    assert np.concatenate([first, last]) == pytest.approx(np.delete(TRUE, [21, 22]), abs=1e-7)


def test_time_running_back_starts_again():
    wave = pulse_train(TRUE, seconds=2.0)
    detector = KeyphasorDetector()
    detector.update(wave, 50.0, RATE)
    assert detector.update(wave, 0.0, RATE) == pytest.approx(TRUE, abs=1e-7)
    detector.reset()
    assert np.isnan(detector.state.threshold)


@pytest.mark.parametrize(('samples', 'start', 'rate', 'message'), [
    (np.zeros((2, 5)), 0.0, RATE, r'shape \(2, 5\)'),
    (np.array(0.0), 0.0, RATE, r'shape \(\)'),
    (np.zeros(5, complex), 0.0, RATE, 'complex128'),
    (np.zeros(5), np.nan, RATE, 'start time nan'),
    (np.zeros(5), -1e16, RATE, 'start_time is -1e.16 s'),
    (np.array([0.0, 1e150]), 0.0, RATE, 'sample of 1e.150: must be within 1e.100'),
    (np.zeros(5), 0.0, np.inf, 'sample_rate is inf Hz'),
    (np.zeros(5), 0.0, 0.0, 'sample_rate is 0.0 Hz')])
def test_bad_waveforms_are_refused(samples, start, rate, message):
    with pytest.raises(SignalError, match=message):
        sa.detect_pulses(samples, rate, start_time=start)


@pytest.mark.parametrize('options', [
    {'threshold': np.nan}, {'hysteresis': 1.0}, {'hysteresis': -0.1}, {'polarity': 'up'},
    {'edge': 'top'}, {'minimum_interval': -1.0}, {'learning_time': 0.0},
    {'minimum_difference': -1.0}])
def test_bad_options_are_refused(options):
    with pytest.raises(ParameterError, match=next(iter(options))):
        KeyphasorDetector(**options)


@pytest.mark.parametrize(('name', 'speed', 'jitter'), [
    ('motor_10V_100kHz', 19.6, 6e-6), ('motor_30V_100kHz', 94.4, 0.25e-6)])
def test_motor_tacho(shared_data, name, speed, jitter):
    with np.load(shared_data / f'{name}.npz') as data:
        tach, rate = data['tach'], float(data['tach_rate'])
    pulses, _ = detect(tach, rate=rate)
    revolutions = pulses[::8]
    assert 1.0 / np.diff(revolutions).mean() == pytest.approx(speed, rel=5e-3)
    assert np.std(np.diff(revolutions, 2)) / np.sqrt(6.0) < jitter
    assert pulses.size == pytest.approx(8.0 * speed * tach.size / rate, abs=1.5)


def test_motor_run_up_from_rest(shared_data):
    with np.load(shared_data / 'motor_runup_20V_40kHz.npz') as data:
        tach, rate = data['tach'], float(data['tach_rate'])
    pulses, _ = detect(tach, rate=rate)
    late = pulses[pulses > 1.5]
    assert 1.0 / (8.0 * np.diff(late[:9]).mean()) == pytest.approx(39.0, rel=0.02)
    assert 1.0 / (8.0 * np.diff(late[-9:]).mean()) == pytest.approx(48.0, rel=0.02)
    assert np.diff(late).max() < 1.1 * np.diff(late).min() * 48.0 / 39.0
    assert 0.2 < pulses[0] < 0.4  # nothing from the least significant bits at rest
    assert np.diff(pulses, 2).max() < 1e-4  # faster from pulse to pulse, none is lost


@pytest.mark.parametrize('name', ['weight', 'weight_5', 'without_weight'])
def test_one_bit_optical_mark(shared_data, name):
    with np.load(shared_data / f'rotorbalancer_{name}.npz') as data:
        tach, rate = data['tach'], float(data['tach_rate'])
    for row in tach:
        pulses, _ = detect(row, rate=rate, polarity='negative', interpolate=False)
        assert pulses * rate == pytest.approx(np.flatnonzero(np.diff(row) < 0.0) + 1, abs=1e-6)


def tach(kind, rng, *, rate=5000.0, seconds=10.0, speed=20.0):
    """Return a waveform with a pulse a turn at whole angles, from -0.3 turns on."""
    t = np.arange(round(seconds * rate)) / rate
    turn = speed * t - 0.3
    u = (turn + 0.5) % 1.0 - 0.5
    pulse = (turn % 1.0 < 0.1).astype(float)
    return {
        'pulse': 5.0 * pulse,
        'reluctance': -8.2 * (u / 0.02) * np.exp(-0.5 * (u / 0.02) ** 2),
        'reluctance, reversed': 8.2 * (u / 0.02) * np.exp(-0.5 * (u / 0.02) ** 2),
        'eddy probe': -10.0 + 1.5 * pulse + 0.5 * np.sin(2.0 * np.pi * (turn + rng.uniform())),
        'coupled': lfilter(*butter(1, 2.0 * 2.0 / rate, 'high'), 5.0 * pulse),
        'hum': 5.0 * pulse + 0.8 * np.sin(2.0 * np.pi * 50.0 * t),
        'steps of 8 bit': np.round(5.0 * pulse / 0.05) * 0.05,
    }[kind] + 0.01 * rng.standard_normal(t.size)


@pytest.mark.machines
@pytest.mark.parametrize('size', [60.0, 15.0, 50.0, -60.0, -20.0])
@pytest.mark.parametrize('threshold', [None, 2.5])
def test_one_spike_costs_no_pulse_and_makes_none(size, threshold, rng):
    wave = tach('pulse', rng)
    clean, _ = detect(wave, rate=5000.0, threshold=threshold)
    for place in rng.integers(0, wave.size, 10):
        # not in the edge of a pulse, which it would move
        place += 30 * (np.abs(clean * 5000.0 - place).min() < 2.0)
        disturbed = wave.copy()
        disturbed[place] = size
        pulses, detector = detect(disturbed, rate=5000.0, threshold=threshold)
        assert pulses == pytest.approx(clean, abs=2e-5)
        assert detector.state.spikes == 1


@pytest.mark.parametrize('kind', ['reluctance', 'reluctance, reversed'])
@pytest.mark.parametrize('threshold', [None, 1.0])
def test_pulses_with_two_lobes(kind, threshold, rng):
    pulses, detector = detect(tach(kind, rng), rate=5000.0, threshold=threshold)
    assert pulses.size == 200
    if threshold is None:  # the steep crossing between the lobes
        assert pulses == pytest.approx((np.arange(200.0) + 0.3) / 20.0, abs=2e-5)
        assert detector.state.threshold == pytest.approx(0.0, abs=0.01)


@pytest.mark.machines
@pytest.mark.parametrize('kind', ['eddy probe', 'coupled', 'hum', 'steps of 8 bit'])
@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_waveforms_of_sensors(kind, sign, rng):
    for _ in range(4):
        wave = sign * tach(kind, rng)
        pulses, detector = detect(wave, rate=5000.0, polarity='auto')
        assert pulses.size in (199, 200)
        assert np.diff(pulses) == pytest.approx(0.05, abs=2e-3)
        assert detector.state.polarity == ('positive' if sign > 0.0 else 'negative')


@pytest.mark.parametrize('shape', ['half sine', 'bell', 'two lobes'])
def test_slow_edges_in_noise_are_one_pulse_each(shape, rng):
    """Noise of 3 % crosses such an edge often."""
    for _ in range(12):
        rate, speed = rng.choice([5e3, 51.2e3]), rng.uniform(8.0, 50.0)
        width = rng.uniform(0.08, 0.3)
        turn = speed * np.arange(round(4.0 * rate)) / rate - 0.3
        x = ((turn + 0.5) % 1.0 - 0.5) / width
        wave = {'half sine': np.where(np.abs(x) < 0.5, np.cos(np.pi * x), 0.0),
                'bell': np.exp(-0.5 * (x / 0.2) ** 2),
                'two lobes': -x / 0.2 * np.exp(0.5 - 0.5 * (x / 0.2) ** 2)}[shape]
        if shape != 'two lobes':  # the resting level moves
            wave += 0.15 * np.sin(2.0 * np.pi * (turn + rng.uniform()))
        wave += 0.03 * rng.standard_normal(turn.size)
        pulses, _ = detect(wave * rng.uniform(0.1, 10.0) + rng.uniform(-9.0, 9.0), rate=rate)
        assert np.diff(pulses) * speed == pytest.approx(1.0, abs=0.15 * width)
        assert abs(pulses.size - 4.0 * speed) < 1.0


@pytest.mark.parametrize(('edge', 'width'), [(0.06, 0.25), (0.08, 0.35), (0.05, 0.15)])
def test_noise_that_grows_costs_the_pulses_of_one_window(edge, width, rng):
    rate, speed = 25.6e3, 20.0
    turn = speed * np.arange(round(8.0 * rate)) / rate % 1.0 - 0.3
    wave = 5.0 * (np.clip(turn / edge, 0.0, 1.0) - np.clip((turn - width) / edge, 0.0, 1.0))
    wave += np.where(np.arange(turn.size) < 2.0 * rate, 0.02, 0.2) * rng.standard_normal(turn.size)
    pulses, _ = detect(wave, rate=rate)
    late = pulses[pulses > 2.51]
    assert late.size == 110
    assert np.diff(late) * speed == pytest.approx(1.0, abs=0.02)


@pytest.mark.machines
@given(st.integers(0, 9999), st.sampled_from([0.1, 1e-9, 1e9]), st.integers(1, 4))
@settings(max_examples=40)
def test_coarse_steps_in_noise_have_finite_times(seed, unit, steps):
    """Some lines through few samples of a few steps have no slope."""
    rng = np.random.default_rng(seed)
    turn = rng.uniform(5.0, 60.0) * np.arange(6000) / 3000.0
    wave = np.rint(steps * np.sin(2.0 * np.pi * turn) + rng.normal(0.0, 0.6, turn.size))
    pulses, _ = detect(unit * wave, rate=3000.0, hysteresis=rng.uniform(0.01, 0.5))
    assert np.all(np.isfinite(pulses))
    assert np.all(np.diff(pulses) > 0.0)


@pytest.mark.parametrize('rate', [12.8e3, 51.2e3])
def test_noise_of_slow_edges_is_averaged_over_their_samples(rate, rng):
    """
    The time of a line through n samples has the standard deviation noise / (slope sqrt(n)).

    Its samples are at most those nearer than 4 standard deviations of the noise: an edge ends with
    the first one beyond, which noise brings there earlier. Two samples alone have three times it.
    """
    noise, speed, width = 0.02, 25.0, 0.2
    turn = speed * np.arange(round(16.0 * rate)) / rate - 0.3
    x = ((turn + 0.5) % 1.0 - 0.5) / width
    wave = np.where(np.abs(x) < 0.5, np.cos(np.pi * x), 0.0)
    pulses, _ = detect(wave + noise * rng.standard_normal(wave.size), rate=rate)
    slope = np.pi * np.sqrt(0.75) / width * speed / rate  # of a sample, half way up
    expected = noise / slope / np.sqrt(8.0 * noise / slope) / rate
    late = pulses - (np.arange(400) + 0.3) / speed
    late -= np.median(late)
    assert 1.4826 * np.median(np.abs(late)) < 1.4 * expected
    assert np.std(late) < 2.0 * expected  # a few edges end early


def test_narrow_pulses_without_a_flat_top_stand_out_of_a_moving_level(rng):
    for width in rng.uniform(0.04, 0.1, 8):
        turn = 27.0 * np.arange(200_000) / 51.2e3 - 0.3
        wave = np.maximum(1.0 - 2.0 * np.abs((turn + 0.5) % 1.0 - 0.5) / width, 0.0)
        wave += 0.15 * np.sin(2.0 * np.pi * (turn + rng.uniform()))
        pulses, _ = detect(wave, rate=51.2e3)
        assert np.diff(pulses) * 27.0 == pytest.approx(1.0, abs=0.02)
        assert abs(pulses.size - 27.0 * 200_000 / 51.2e3) < 1.0


@pytest.mark.parametrize('mains', [50.0, 60.0])
@pytest.mark.parametrize('duty', [0.04, 0.1, 0.5])
def test_hum_of_a_third_of_the_pulses_costs_none(mains, duty, rng):
    t = np.arange(50_000) / 10e3
    wave = 5.0 * ((24.7 * t - 0.3) % 1.0 < duty) + 1.5 * np.sin(2.0 * np.pi * mains * t + 1.0)
    pulses, _ = detect(wave + 0.02 * rng.standard_normal(t.size), rate=10e3)
    assert pulses == pytest.approx((np.arange(pulses.size) + 0.3) / 24.7, abs=1.1e-4)
    assert pulses.size == 124


def test_pulses_of_three_steps_of_the_converter(rng):
    t = np.arange(50_000) / 10e3
    wave = np.rint(3.0 * ((31.0 * t - 0.3) % 1.0 < 0.1) + rng.normal(0.0, 0.25, t.size))
    pulses, _ = detect(wave, rate=10e3)
    assert pulses == pytest.approx((np.arange(155.0) + 0.3) / 31.0, abs=2.1e-4)


@pytest.mark.parametrize('duty', [0.02, 0.1, 0.44, 0.5, 0.56, 0.9, 0.98])
def test_automatic_polarity_is_that_of_the_rarer_state(duty, rng):
    t = np.arange(50_000) / 5000.0
    wave = ((20.0 * t - 0.3) % 1.0 < duty) + 0.01 * rng.standard_normal(t.size)
    pulses, detector = detect(wave, rate=5000.0, polarity='auto', cuts=rng.integers(0, t.size, 9))
    assert detector.state.polarity == ('negative' if duty > 0.55 else 'positive')
    assert pulses.size in (199, 200)


def test_four_samples_of_a_pulse_interval(rng):
    wave = (np.arange(800) % 4 == 1) + 0.02 * rng.standard_normal(800)
    assert detect(wave, rate=80.0)[0].size == 200


def corrupted(wave, rate, rng):
    """Return a waveform of levels 0 and 1 with some spoilt pieces, and which samples these are."""
    wave, hit = wave.copy(), np.zeros(wave.size, np.bool_)
    for _ in range(rng.integers(1, 6)):
        begin, kind = rng.integers(wave.size), rng.integers(5)
        most = (4, 30, 3 * int(rate), 3 * int(rate), 3 * int(rate))[kind]
        count = min(rng.integers(1, most), wave.size - begin)
        size, place = 10.0 ** rng.uniform(-1.0, 3.0) * rng.choice([-1.0, 1.0]), np.arange(count)
        wave[begin:begin + count] = size * (
            1.0 + 0.0 * place, rng.choice([-1.0, 1.0], count), 1.0 + 0.0 * place,
            rng.standard_normal(count), place // int(rate / 60.0) % 2)[kind]
        hit[begin:begin + count] = True
    return wave, hit


def far(times, bad, reach):
    """Return the times that are farther than `reach` from any bad one."""
    after = np.searchsorted(bad, times)
    return times[np.minimum(times - bad[after - 1], bad[after] - times) > reach]


def test_hum_between_slow_pulses_is_none():
    """Of 2 to 9 % of the pulse, which single windows hold alone."""
    wrong, trials = 0, 100
    for seed in range(trials):
        rng = np.random.default_rng(seed)
        speed, rate = 10.0 ** rng.uniform(-0.6, 0.3), rng.choice([1e3, 5e3])
        t = np.arange(round(6.0 / speed * rate)) / rate
        turns = speed * t + rng.uniform()
        wave = (turns % 1.0 < rng.uniform(0.05, 0.9)) + rng.uniform(0.01, 0.045) * np.sin(
            2.0 * np.pi * rng.choice([50.0, 60.0, 100.0]) * t) + rng.choice(
                [0.001, 0.01]) * rng.standard_normal(t.size)
        wrong += sa.detect_pulses(wave, rate).size != np.floor(turns[-1]) - np.floor(turns[0])
    # a few times noise and hum rest at two levels by chance
    assert wrong <= 0.03 * trials


@pytest.mark.parametrize(('least', 'most'), [(0.04, 2.0), (-1.0, 0.7)])
def test_slow_edges_in_noise_that_a_rail_clips_are_one_pulse_each(rng, least, most):
    for _ in range(10):
        speed, duty = 10.0 ** rng.uniform(-0.5, 1.0), rng.uniform(0.2, 0.6)
        t = np.arange(round(20.0 / speed * 5e3)) / 5e3
        turned = (speed * t + 0.7) % 1.0
        wave = np.where(turned < duty, np.sin(np.pi * turned / duty), 0.0)
        wave = np.clip(wave + 0.03 * rng.standard_normal(t.size), least, most)
        assert detect(np.round(255.0 * wave) / 255.0, rate=5e3)[0].size == 20


def test_spikes_of_both_signs_do_not_take_the_place_of_pulses(rng):
    wrong = 0
    for _ in range(40):
        t = np.arange(9000) / 2e4
        wave = (200.0 * t % 1.0 < rng.uniform(0.2, 0.8)) + 0.01 * rng.standard_normal(t.size)
        wave[rng.integers(t.size, size=3)] += rng.uniform(4.0, 40.0, 3) * [1.0, -1.0, -1.0]
        wrong += abs(detect(wave, rate=2e4)[0].size - 90) > 3
    assert wrong <= 1


@pytest.mark.parametrize('seconds', [1, 3, 6])
def test_a_fast_sine_is_found_in_recordings_of_any_length(seconds):
    t = np.arange(100_000 * seconds) / 1e5
    wave = np.sin(2.0 * np.pi * 9_900.0 * t)
    assert detect(wave, rate=1e5)[0].size == pytest.approx(9_900 * seconds, abs=2)
    assert detect(wave, rate=1e5, cuts=range(5000, t.size, 5000))[0].size == pytest.approx(
        9_900 * seconds, abs=2)


@pytest.mark.parametrize(('patient', 'windows'), [(False, 1), (True, 8)])
def test_a_sine_waits_for_its_levels_in_recordings_alone_and_loses_nothing(patient, windows):
    t = np.arange(round(12.0 * RATE)) / RATE
    detector = KeyphasorDetector()
    detector.patient = patient
    found = [detector.update(block, 0.5 * k, RATE) for k, block in enumerate(
        np.split(np.sin(2.0 * np.pi * 20.0 * t + 1.0), 24))]
    assert [item.size for item in found[:windows - 1]] == [0] * (windows - 1)
    assert found[windows - 1].size == pytest.approx(10 * windows, abs=1)
    assert np.allclose(np.diff(np.concatenate(found)), 0.05)


@pytest.mark.machines
def test_spoilt_samples_cost_only_the_pulses_near_them():
    """Whatever their number, place and size: all but those within 1 s or 10 turns are the same."""
    wrong, trials = 0, 50
    for seed in range(trials):
        rng = np.random.default_rng(seed)
        speed, rate = rng.uniform(5.0, 50.0), rng.choice([2000.0, 5000.0, 10_000.0])
        t = np.arange(round(12.0 * rate)) / rate
        wave = (speed * t + rng.uniform()) % 1.0 < rng.uniform(max(0.02, 2.0 * speed / rate), 0.5)
        wave = wave + rng.choice([0.0, 0.01, 0.05]) * rng.standard_normal(t.size)
        gain, reach = 10.0 ** rng.uniform(-3.0, 3.0), max(1.0, 10.0 / speed)
        spoilt, hit = corrupted(wave, rate, rng)
        options = {'rate': rate, 'learning_time': max(0.5, 2.5 / speed)}
        clean, found = (detect(gain * (item + 20.0), **options)[0] for item in (wave, spoilt))
        bad = np.concatenate(([-1e9], t[hit], [1e9]))

        clean, found = far(clean, bad, reach), far(found, bad, reach)
        wrong += clean.size != found.size or not np.allclose(clean, found, atol=2.0 / rate)
    # a long piece at the beginning, where no level is known yet, may cost more
    assert wrong <= 0.02 * trials


def test_a_spoilt_piece_beside_levels_that_differ_by_rounding_only():
    wave = np.tile(np.repeat([0.02, 0.021], [80, 20]), 60) * (1.0 + 1e-15 * np.arange(6000))
    wave[2000:5000] = 0.02 + 5e-17 * (np.arange(3000) % 2)
    wave[4000] = 7.0
    pulses, detector = detect(wave, rate=1000.0)
    assert (pulses.size, detector.state.spikes) == (30, 1)


def test_offset_and_gain_change_nothing(rng):
    for kind in ('pulse', 'reluctance', 'eddy probe', 'hum'):
        wave = tach(kind, rng, seconds=3.0)
        pulses, _ = detect(wave, rate=5000.0)
        for _ in range(5):
            gain = 10.0 ** rng.uniform(-6.0, 6.0)
            moved, _ = detect(gain * (wave + rng.uniform(-30.0, 30.0)), rate=5000.0)
            assert moved == pytest.approx(pulses, abs=1e-6)


def test_spikes_of_a_recording_are_told():
    wave = np.tile(np.repeat([0.0, 5.0, 0.0], [40, 20, 40]), 50)
    wave[1234] = 80.0
    with pytest.warns(sa.DataWarning, match='1 sample of the keyphasor waveform is a spike'):
        assert sa.detect_pulses(wave, 2000.0).size == 50


@pytest.mark.parametrize(('speed', 'every', 'length'), [
    (20.0, 0.45, 3), (20.0, 0.3, 1), (200.0, 0.06, 1)])
def test_spikes_in_every_window_cost_no_pulse(speed, every, length, rng):
    time = np.arange(20_000) / 5e3
    clean = 5.0 * ((speed * time) % 1.0 < 0.2) + rng.normal(0.0, 0.05, time.size)
    spoilt = clean.copy()
    places = np.rint(np.arange(0.113, 3.9, every) * 5e3).astype(int)
    for number, place in enumerate(places):
        spoilt[place:place + length] = (60.0, 200.0, -90.0)[number % 3]
    detector = KeyphasorDetector()
    found = np.append(detector.update(spoilt, 0.0, 5e3), detector.flush())
    assert np.abs(found - sa.detect_pulses(clean, 5e3)).max() < 2e-4
    assert detector.state.spikes == length * places.size


@pytest.mark.parametrize(('speed', 'hum', 'noise'), [
    (1.6, 0.2, 0.0), (2.0, 0.2, 0.0), (0.4, 0.0, 0.01), (1.0, 0.0, 0.05)])
def test_hum_and_clipped_noise_between_slow_pulses_are_none(speed, hum, noise, rng):
    t = np.arange(10_000) / 1e3
    wave = ((speed * t + 0.95) % 1.0 < 0.3) + hum * np.sin(2.0 * np.pi * 50.3 * t)
    clip = (0.0, 1.0) if noise else (-1.0, 2.0)
    wave = np.clip(wave + noise * rng.standard_normal(t.size), *clip)
    assert detect(wave, rate=1e3)[0].size == int(10.0 * speed + 0.95)


@pytest.mark.parametrize('length', [1, 3, 4, 6])
def test_a_long_spike_is_the_same_in_any_cut(length):
    wave = np.tile(np.repeat([0.0, 5.0], [80, 20]), 30)
    wave[1910:1910 + length] = wave[3000 - length:] = 90.0
    whole, one = detect(wave, rate=1000.0)
    for cut in range(1909, 1911 + length):
        for cuts in ([cut, 3000 - length + cut - 1909], range(cut, cut + 4)):
            found, detector = detect(wave, rate=1000.0, cuts=cuts)
            assert np.array_equal(found, whole)
            assert detector.state == one.state
    assert one.state.spikes == (2 * length if length < 4 else 0)


def slow_shaft(speed, marks, rate, seconds, *, noise=0.01):
    """Return a waveform in V of bumps at `marks` of a revolution, and how many pass."""
    t = np.arange(round(seconds * rate)) / rate
    turns = 0.137 + speed * (t - 1.1 * np.cos(2.0 * np.pi * t / 70.0))
    wave = np.zeros(t.size)
    passes = 0
    for mark in marks:
        wave += np.exp(-0.5 * (((turns - mark + 0.5) % 1.0 - 0.5) / 0.012)**2)
        passes += int(np.floor(turns[-1] - mark) - np.floor(turns[0] - mark))
    return 5.0 * (wave + noise * np.random.default_rng(1).standard_normal(t.size)) - 8.0, passes


@pytest.mark.parametrize(('speed', 'marks', 'rate', 'seconds'), [
    (0.3, [0.0], 2000.0, 60.0), (0.3, np.arange(4) / 4, 2000.0, 60.0),
    (0.3, [0.0, 0.11, 0.36, 0.5, 0.61, 0.86], 2000.0, 60.0), (0.05, [0.0], 1000.0, 140.0),
    (0.3, [0.0], 200.0, 60.0)])
def test_windows_grow_until_they_hold_whole_pulses_of_a_slow_shaft(
        speed, marks, rate, seconds):
    for noise, sign in ((0.0, -1.0), (0.02, 1.0)):
        wave, passes = slow_shaft(speed, marks, rate, seconds, noise=noise)
        polarity = 'positive' if sign > 0.0 else 'negative'
        found, detector = detect(sign * wave, rate=rate, polarity=polarity,
                                 cuts=range(0, wave.size, 997))
        assert found.size == passes
        assert detector.state.spikes == 0
        assert detector.state.high - detector.state.low == pytest.approx(5.0, rel=0.15)


def test_windows_grow_to_a_minute_and_noise_has_no_levels(rng):
    detector = KeyphasorDetector()
    most = 0
    for k in range(300):
        assert detector.update(rng.standard_normal(500), 0.5 * k, 1000.0).size == 0
        most = max(most, detector.state.waiting)
    assert 32_000 <= most <= 64_000
    t = 150.0 + np.arange(2000) / 1000.0
    assert detector.update(20.0 * (25.0 * t % 1.0 < 0.1), 150.0, 1000.0).size >= 49


def in_bits(wave, rng, *, noise=0.25, volts=20.0 / 4096):
    """Return a waveform in V from a converter of 12 bits, with noise in units of the last one."""
    return np.round(wave / volts + noise * rng.standard_normal(wave.size)) * volts


@pytest.mark.parametrize(('speed', 'rate', 'turning', 'stopped'), [
    (25.0, 10_000.0, 4.0, 3.0), (25.0, 10_000.0, 0.0, 4.5), (0.2, 1000.0, 30.0, 0.0),
    (1.0, 2000.0, 10.0, 3.0)])
def test_the_last_bit_of_a_machine_that_stands_is_no_pulse(speed, rate, turning, stopped, rng):
    t = np.arange(round((2.0 * turning + stopped + 4.0) * rate)) / rate
    turns = 0.37 + speed * (np.minimum(t, turning) + np.clip(t - turning - stopped, 0.0, None))
    wave = np.where(turns % 1.0 < 0.1, 5.0, 0.0)
    expected = t[1:][np.diff(np.floor(turns)) > 0]
    for noise in (0.0, 0.25, 0.5):
        found = detect(in_bits(wave, rng, noise=noise), rate=rate)[0]
        assert found == pytest.approx(expected, abs=1.5 / rate)
    still = in_bits(0.0 * wave, rng, noise=0.25)
    assert detect(still, rate=rate)[0].size == 0


@pytest.mark.parametrize('level', [1.0, 5.0])
@pytest.mark.parametrize(('speed', 'width'), [(25.0, 1), (5.0, 3), (2.0, 3), (5.0, 1)])
def test_pulses_of_a_digital_input_may_be_short(level, speed, width):
    wave = level * (np.arange(10_000) % round(1000.0 / speed) < width)
    assert detect(wave, rate=1000.0)[0].size == np.count_nonzero(np.diff(wave) > 0.0)


def test_two_samples_of_a_digital_input_have_a_pulse_and_no_warning_of_numpy():
    assert sa.detect_pulses([0.0, 1.0], 1000.0) == pytest.approx([0.0005])


@pytest.mark.parametrize('each', [2.2, 2.5, 3.5, 4.0])
def test_lines_of_an_encoder_may_have_few_samples(each):
    turns = (np.arange(40_000) + 0.3) / each
    lines = int(turns[-1])
    assert detect(np.where(turns % 1.0 < 0.5, 5.0, 0.0), rate=50e3)[0].size == (
        pytest.approx(lines, abs=1))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter('always')
        found = sa.detect_pulses(np.sin(2.0 * np.pi * turns), 50e3)
    if each > 3.0:
        assert not said
        assert found.size == pytest.approx(lines, abs=1)
    else:
        text = str(said[0].message)
        assert 'samples a pulse, of which some may be lost: sample it at ' in text
        assert 45e3 < float(text.split()[-4]) * each / 3.0 < 65e3


def test_a_cable_that_is_unplugged_gives_no_pulses(rng):
    t = np.arange(100_000) / 1e4
    wave = np.where(25.0 * t % 1.0 < 0.1, 5.0, 0.0)
    for off in rng.uniform(2.0, 6.0, 10):
        quiet = (t >= off) & (t < off + 2.0)
        read = in_bits(np.where(quiet, 0.0, wave), rng, noise=np.where(quiet, 0.0, 10.0))
        found = detect(read, rate=1e4)[0]
        assert found.size == pytest.approx(200, abs=1)
        assert not np.any((found > off + 1e-3) & (found < off + 2.0 - 1e-3))


def reluctance_wheel(rng, *, teeth, missing, tooth, speeds, noise=1e-3, rate=20_000.0,
                     seconds=8.0):
    """Return the voltage of a wheel at a speed that changes, true times and pitch (s)."""
    t = np.arange(round(seconds * rate)) / rate
    rise = (speeds[1] - speeds[0]) / seconds
    place = teeth * (0.37 + speeds[0] * t + 0.5 * rise * t**2)
    voltage = np.zeros(t.size)
    for near in np.floor(place) + np.arange(-1.0, 3.0)[:, None]:
        apart = (place - near) / tooth
        voltage -= np.where(near % teeth < teeth - missing, apart * np.exp(-0.5 * apart**2), 0.0)
    voltage = voltage * (speeds[0] + rise * t) + noise * max(speeds) * rng.standard_normal(t.size)
    whole = np.arange(np.ceil(place[0]), place[-1])
    return voltage, np.interp(whole[whole % teeth < teeth - missing], place, t)


@pytest.mark.parametrize('gain', [1.0, -2.0])
@pytest.mark.parametrize(('teeth', 'missing', 'tooth', 'speeds'), [
    (60, 2, 0.2, (10.0, 40.0)), (60, 2, 0.3, (20.0, 20.0)), (36, 1, 0.25, (15.0, 5.0)),
    (60, 2, 0.2, (3.0, 3.0)), (4, 1, 0.15, (10.0, 20.0))])
def test_reluctance_of_a_wheel_with_missing_teeth_has_the_time_of_each_tooth(
        rng, gain, teeth, missing, tooth, speeds):
    """All around the wheel, also beside the gap, where the voltage rests at the threshold."""
    voltage, times = reluctance_wheel(
        rng, teeth=teeth, missing=missing, tooth=tooth, speeds=speeds)
    pulses = detect(2.5 + gain * voltage, rate=20_000.0)[0]
    near = np.abs(pulses - times[np.searchsorted(0.5 * (times[1:] + times[:-1]), pulses)])
    assert pulses.size == pytest.approx(times.size, abs=2)
    assert np.quantile(near, 0.999) < 0.01 / (teeth * min(speeds))


def test_long_windows_are_looked_at_in_part(rng, monkeypatch):
    """A stopped machine at 200 kHz does not hold up what takes its samples."""
    sizes = []
    monkeypatch.setattr(detection, 'state_levels', lambda samples, known=None: (
        sizes.append(samples.size), state_levels(samples, known))[1])
    detector = KeyphasorDetector()
    for start in range(14):
        detector.update(0.01 * rng.standard_normal(200_000), float(start), 200e3)
    assert len(sizes) > 20
    assert max(sizes) <= 1 << 17


def test_the_time_of_an_edge_does_not_depend_on_other_edges_of_its_block():
    sudden, slow = np.array([0.0, 0.3, 0.4, 0.45, 1.0]), np.array([1.0, 0.7, 0.6, 0.4, 0.3, 0.0])
    options = {'threshold': 0.5, 'band': 0.3, 'near': 0.9}
    together, _ = SchmittTrigger(interpolate=True).update(
        np.append(sudden, slow), 0, **options)
    alone = SchmittTrigger(interpolate=True)
    apart = [alone.update(part, index, **options)[0] for part, index in ((sudden, 0), (slow, 5))]
    assert together == pytest.approx(np.concatenate(apart), abs=1e-12)
