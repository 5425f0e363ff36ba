# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""A sampled angle as keyphasor: crossings of marks, their errors, glitches, wraps and jumps."""

from itertools import pairwise
import warnings

from hypothesis import example, given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
import sa_jitter_ros as sa
from sa_jitter_ros.errors import DataWarning, ParameterError, SignalError
from sa_jitter_ros.pulses.sampled_angle import AngleCrossings, counter_pulses, counter_runs

SPEED, RATE, SECONDS = 20.0, 1000.0, 10.0
TURN = 2.0 * np.pi


def turned(time, *, drift=0.3, sign=1.0):
    """Return the angle (revolutions) of a shaft whose speed grows by `drift`."""
    return sign * (SPEED * time + 0.5 * SPEED * drift / SECONDS * time**2 + 0.1)


def joint(rng, *, bits=0, stamp=0.0, wrap='pi', **motion):
    """Return stamps (s) and positions (rad) of a joint."""
    time = np.arange(int(SECONDS * RATE)) / RATE
    angle = turned(time, **motion)
    angle = TURN * (np.rint(angle * 2.0**bits) / 2.0**bits if bits else angle)
    angle = {'pi': (angle + np.pi) % TURN - np.pi, 'turn': angle % TURN, 'none': angle}[wrap]
    return time + rng.normal(0.0, stamp, time.size), angle


def true_crossings(marks=1, **motion):
    """Return when the marks pass (s)."""
    time = np.linspace(0.0, SECONDS, 1_000_001)
    angle = np.abs(turned(time, **motion)) * marks
    return np.interp(np.arange(np.ceil(angle[0]), np.ceil(angle[-1])), angle, time)


@pytest.mark.parametrize(('marks', 'options'), [
    (1, {'bits': 12}), (1, {'bits': 14, 'wrap': 'turn'}), (4, {'bits': 16, 'wrap': 'none'}),
    (1, {'bits': 14, 'sign': -1.0}), (1, {'stamp': 2e-5}), (8, {'bits': 13, 'stamp': 1e-5}),
])
def test_pulses_have_the_error_that_is_shown(rng, marks, options):
    motion = {key: options[key] for key in ('sign',) if key in options}
    crossings = AngleCrossings(marks=marks)
    pulses = crossings.update(*joint(rng, **options))
    true = true_crossings(marks, **motion)[:pulses.size]
    assert pulses.size >= true_crossings(marks, **motion).size - 1
    state = crossings.state
    assert np.std(pulses - true) == pytest.approx(state.pulse_error_std, rel=0.25)
    if 'bits' in options:
        assert state.angle_resolution == pytest.approx(TURN / 2.0**options['bits'], rel=1e-6)
    if 'stamp' in options:
        assert state.stamp_noise_std == pytest.approx(options['stamp'], rel=0.25)


@given(st.lists(st.integers(1, 400), min_size=1, max_size=40), st.integers(0, 2**31))
@settings(max_examples=25, deadline=None)
def test_any_cut_gives_the_same_pulses(lengths, seed):
    time, angle = joint(np.random.default_rng(seed), bits=14, stamp=1e-5)
    time, angle = time[:3000], angle[:3000]
    crossings, found = AngleCrossings(marks=2), []
    edges = np.minimum(np.cumsum([0, *lengths, 3000]), 3000)
    for start, stop in pairwise(edges):
        found.append(crossings.update(time[start:stop], angle[start:stop]))
    np.testing.assert_allclose(np.concatenate(found),
                               AngleCrossings(marks=2).update(time, angle), rtol=0, atol=1e-12)


def test_a_run_of_few_samples_has_the_pulses_of_its_marks_only():
    crossings = AngleCrossings()
    assert crossings.update([0.0, 0.01, 0.02], [1.0, 4.0, 7.0]).size == 0
    assert crossings.flush() == pytest.approx([0.01 * (TURN - 1.0) / 3.0])


def test_stops_and_reversals_end_a_run_and_marks_keep_their_angle():
    time = np.arange(20_000) / RATE
    speed = np.where(time < 5, 20.0, np.where(time < 8, 0.0, np.where(
        time < 12, 20.0, np.where(time < 14, -20.0, 20.0))))
    angle = TURN * (np.cumsum(speed) / RATE + 0.3)
    crossings = AngleCrossings()
    pulses = crossings.update(time, (angle + np.pi) % TURN - np.pi)
    assert (crossings.state.stops, crossings.state.reversals) == (1, 2)
    assert not np.any((pulses > 5.01) & (pulses < 7.99))
    place = np.interp(pulses, time, angle / TURN)
    assert np.max(np.abs(place - np.rint(place))) < 1e-3
    assert pulses.size == pytest.approx((5 + 4 + 2 + 6) * 20, abs=4)
    assert np.all(np.diff(pulses) > 0.0)


def test_lost_samples_are_no_crossing(rng):
    time, angle = joint(rng, bits=14)
    kept = (time < 3.0) | (time > 4.0)
    crossings = AngleCrossings()
    pulses = crossings.update(time[kept], angle[kept])
    assert crossings.state.gaps == 1
    assert not np.any((pulses > 3.0) & (pulses < 4.0))
    true = true_crossings()
    nearest = true[np.argmin(np.abs(true[:, None] - pulses), axis=0)]
    assert np.max(np.abs(pulses - nearest)) < 1e-5


def test_bad_samples_cost_themselves_and_time_that_runs_back_begins_anew(rng):
    time, angle = joint(rng)
    angle[1234] = np.nan
    time[2345] = time[2344]
    crossings = AngleCrossings()
    first = crossings.update(time, angle)
    assert crossings.state.dropped == 2
    second = crossings.update(time, angle)
    np.testing.assert_allclose(second, first, rtol=0, atol=1e-9)
    assert crossings.state.restarts == 1


def test_a_joint_that_stands_still_has_no_pulses(rng):
    crossings = AngleCrossings()
    noise = rng.normal(0.0, 1e-4, 5000)
    assert not crossings.update(np.arange(5000) / RATE, 1.0 + noise).size
    assert crossings.state.pulses == 0


def test_unusable_options_and_arrays_are_named():
    with pytest.raises(ParameterError, match='marks 0 must be a whole number'):
        AngleCrossings(marks=0)
    with pytest.raises(ParameterError, match='time_tolerance nan'):
        AngleCrossings(time_tolerance=np.nan)
    with pytest.raises(SignalError, match='give as many times as angles'):
        AngleCrossings().update([0.0, 1.0], [0.0])


# --- glitches, wraps and jumps ------------------------------------------------------------------

TIME = np.arange(10_000) / RATE
TURNED = 7.3 * TIME + 0.1  # revolutions; 73 pulses


def wrapped(turned, wrap):
    """Return an angle (rad) as sensors give it."""
    angle = TURN * np.asarray(turned)
    return {'pi': (angle + np.pi) % TURN - np.pi, 'turn': angle % TURN, 'none': angle}[wrap]


@pytest.mark.parametrize('wrap', ['pi', 'turn', 'none'])
@pytest.mark.parametrize('where', [[5000], [1234, 3456, 5001, 7002, 9003], [5000, 5001, 5002]])
def test_a_position_that_reads_0_is_bridged(wrap, where):
    clean = AngleCrossings().update(TIME, wrapped(TURNED, wrap))
    angle = wrapped(TURNED, wrap)
    angle[where] = 0.0
    crossings = AngleCrossings()
    pulses = crossings.update(TIME, angle)
    assert (clean.size, pulses.size) == (73, 73)
    assert np.max(np.abs(pulses - clean)) < 1.0 / RATE
    state = crossings.state
    assert (state.glitches, state.restarts, state.reversals, state.dropped) == (
        len(where), 0, 0, 0)


@pytest.mark.parametrize('first', [0, 2**15])
@pytest.mark.parametrize('sign', [1, -1])
@pytest.mark.parametrize(('bits', 'counts'), [(8, 60), (16, 2400), (32, 2**26 + 3)])
def test_a_position_from_a_counter_that_overflows_goes_on(first, sign, bits, counts):
    count = (np.floor(sign * counts * TURNED) + first) % 2.0**bits - first
    crossings = AngleCrossings()
    pulses = crossings.update(TIME, TURN * count / counts)
    assert pulses.size == 73
    assert (crossings.state.glitches, crossings.state.reversals) == (0, 0)
    assert crossings.state.restarts == 0


def test_a_position_that_jumps_by_no_modulus_begins_a_run():
    jumped = TURNED + 12.2 * (TIME > 5.0)
    crossings = AngleCrossings()
    pulses = crossings.update(TIME, TURN * jumped)
    assert (crossings.state.restarts, crossings.state.glitches) == (1, 0)
    assert pulses.size == pytest.approx(73, abs=1)
    place = np.interp(pulses, TIME, jumped)
    assert np.max(np.abs(place - np.rint(place))) < 1e-6
    turns = sa.pulses_from_angle(TIME, TURN * (TURNED % 12.2), modulus=12.2 * TURN)
    assert turns.size == 73


def machine(rng, kind):
    """Return the maker of crossings, stamps, positions of a shaft and the unit of a turn."""
    rate = rng.choice([200.0, 1000.0, 5000.0])
    count = int(rng.integers(500, 3000))
    turn = TURN if kind in ('pi', 'turn', 'none') else float(rng.choice([100, 360, 2400, 4096]))
    least = {'overflow of 8 bits': 256 / turn}.get(kind, 1.0)
    speed = rng.choice([-1, 1]) * rng.uniform(0.02, 1.0) * rate / 20.0 * min(least, 1.0)
    uneven, depth = rng.uniform(0.5, 4.0), rng.uniform(0.0, 0.2)
    time = np.arange(count) / rate
    turned = rng.random() + speed * time + (
        depth * speed / (TURN * uneven) * np.sin(TURN * uneven * time))
    if turn == TURN:
        if bits := rng.choice([0, 10, 14]):
            turned = np.rint(turned * 2.0**bits) / 2.0**bits
        stamps = time + rng.normal(0.0, rng.choice([0.0, 0.02]) / rate, count)
        return lambda angle: AngleCrossings(), stamps, wrapped(turned, kind), turn, rate, 0.0
    size = {'reset each turn': turn, 'overflow of 8 bits': 256.0,
            'overflow of 16 bits': 65536.0}[kind]
    return (lambda angle: AngleCrossings(runs=counter_runs(angle, turn)), time,
            np.floor(turn * turned) % size, turn, rate, 1.0 / abs(turn * speed))


def hurt(rng, angle, turn):
    """Return the angle with some glitches of 1 to 3 samples, and where they are."""
    angle, where = angle.copy(), np.zeros(angle.size, bool)
    for _ in range(rng.integers(1, 6)):
        length = int(rng.integers(1, 4))
        first = int(rng.integers(0, angle.size - length))
        if not where[max(first - 8, 0):first + length + 8].any():
            where[first:first + length] = True
            angle[where & (np.arange(angle.size) >= first)
                  & (np.arange(angle.size) < first + length)] = rng.choice(
                [0.0, rng.uniform(-1, 1) * turn, rng.uniform(-100, 100) * turn, 1e9])
    return (angle if turn == TURN else np.rint(angle)), where


@pytest.mark.parametrize('kind', ['pi', 'overflow of 16 bits', *(
    pytest.param(kind, marks=pytest.mark.machines)
    for kind in ('turn', 'none', 'reset each turn', 'overflow of 8 bits'))])
@given(st.integers(0, 2**31))
@example(107429)  # glitches that stand out of few deviations
@settings(max_examples=4, deadline=None)
def test_glitches_anywhere_leave_the_pulses_and_any_cut_is_the_same(kind, seed):
    rng = np.random.default_rng(seed)
    make, stamps, angle, turn, rate, tick = machine(rng, kind)
    crossings = make(angle)
    clean = np.append(crossings.update(stamps, angle), crossings.flush())
    state = crossings.state
    assert (state.glitches, state.restarts, state.reversals, state.gaps) == (0, 0, 0, 0)
    angle, where = hurt(rng, angle, turn)
    crossings = make(angle)
    pulses = np.append(crossings.update(stamps, angle), crossings.flush())
    if not (where[:4].any() or where[-4:].any()):
        assert pulses.size == clean.size
        near = np.array([where[max(int(time * rate) - 6, 0):int(time * rate) + 7].any()
                         for time in clean], bool)
        assert np.all(np.abs(pulses - clean)[~near] < 0.2 / rate)
        # A glitch of less than is told from motion may move a crossing in it.
        assert np.all(np.abs(pulses - clean)[near] < 3.0 / rate + tick)
    assert abs(pulses.size - clean.size) <= 1
    assert crossings.state.glitches <= np.count_nonzero(where) + 1
    assert crossings.state.restarts <= 1
    other = make(angle)
    edges = np.sort(rng.integers(0, angle.size + 1, rng.choice([1, 5, 300, 2000])))
    found = [other.update(stamps[start:stop], angle[start:stop])
             for start, stop in pairwise([0, *edges, angle.size])]
    np.testing.assert_allclose(np.concatenate([*found, other.flush()]), pulses, rtol=0,
                               atol=1e-9)
    assert other.state.glitches == crossings.state.glitches
    assert other.state.restarts == crossings.state.restarts


@pytest.mark.machines
@pytest.mark.parametrize('counts', [8, 24, 60, 360])
def test_coarse_and_held_positions_have_no_glitches(rng, counts):
    """A standing or slow shaft moves by rare steps, noise moves it to and fro."""
    coarse = np.floor(counts * TURNED) / counts
    held = np.repeat(TURNED[::10], 10)
    standing = np.rint(counts * (0.3 + rng.normal(0.0, 0.1 / counts, TIME.size))) / counts
    slow = np.floor(counts * 0.1 * TIME) / counts
    for turned, pulses in ((coarse, 73), (held, 73), (standing, 0), (slow, 0)):
        for wrap in ('pi', 'turn', 'none'):
            crossings = AngleCrossings()
            found = crossings.update(TIME, wrapped(turned, wrap))
            assert found.size == pytest.approx(pulses, abs=1 if pulses else 0)
            assert (crossings.state.glitches, crossings.state.restarts) == (0, 0)


def test_a_speed_that_changes_at_once_is_no_jump():
    speed = np.select([TIME < 2, TIME < 4, TIME < 6, TIME < 8], [0.0, 20.0, 3.0, -30.0], 9.0)
    turned = np.cumsum(speed) / RATE
    crossings = AngleCrossings()
    pulses = crossings.update(TIME, wrapped(turned, 'pi'))
    assert (crossings.state.glitches, crossings.state.restarts) == (0, 0)
    assert pulses.size == pytest.approx((20 + 3 + 30 + 9) * 2, abs=3)


def test_memory_is_bounded_while_a_shaft_stands(rng):
    crossings = AngleCrossings()
    for start in range(0, 400_000, 5000):
        crossings.update((start + np.arange(5000)) / RATE, 1.0 + rng.normal(0.0, 0.01, 5000))
    assert crossings._time.size < 50_000
    assert crossings._runs._time.size < 100


# --- counters -----------------------------------------------------------------------------------

def test_counter():
    pulses, state = counter_pulses([3, 3, 4, 4, 6], start_time=1.0, sample_rate=10.0)
    assert pulses == pytest.approx([1.2, 1.35, 1.4])
    assert (state.glitches, state.restarts) == (0, 0)
    assert counter_pulses([6, 6, 5, 5, 3], start_time=1.0, sample_rate=10.0)[0] == pytest.approx(
        [1.2, 1.35, 1.4])
    assert counter_pulses(np.empty(0, int), sample_rate=1.0)[0].size == 0


@pytest.mark.parametrize('given_turn', [1, 100])
@pytest.mark.parametrize('sign', [1, -1])
def test_a_counter_that_its_index_resets_counts_every_mark(sign, given_turn):
    counts = sign * np.floor(100 * 7.3 * TIME).astype(int)
    pulses, state = counter_pulses(counts % 100, sample_rate=RATE,
                                   pulses_per_revolution=given_turn)
    np.testing.assert_allclose(pulses, counter_pulses(np.abs(counts), sample_rate=RATE)[0])
    assert pulses.size == abs(counts[-1])
    assert (state.restarts, state.reversals) == (0, 0)


def test_a_reversal_ends_a_run_of_a_counter_and_dither_does_not():
    up = np.repeat(np.arange(200), 10)
    counts = np.concatenate((up, up[::-1]))
    pulses, state = counter_pulses(counts, sample_rate=RATE, pulses_per_revolution=100)
    assert state.reversals == 1
    assert pulses.size == 398
    dithered = up.copy()
    dithered[11:1990:20] -= 1
    pulses, state = counter_pulses(dithered, sample_rate=RATE, pulses_per_revolution=100)
    assert state.reversals == 0
    assert pulses.size == 199


def test_a_count_that_is_wrong_by_one_for_a_sample_moves_no_pulse():
    counts = np.arange(4000) // 27 % 100
    clean, _ = counter_pulses(counts, sample_rate=RATE, pulses_per_revolution=100)
    counts[27 * 100 - 7] = 0  # reads 0, is 99
    counts[27 * 101 + 7] = 0  # is 1
    pulses, state = counter_pulses(counts, sample_rate=RATE, pulses_per_revolution=100)
    np.testing.assert_array_equal(pulses, clean)
    assert state.glitches == 2


@pytest.mark.parametrize('wrong', [1, -1])
def test_a_wrong_count_in_the_last_sample_of_a_block_waits_for_the_next(wrong):
    counts = np.arange(800) // 20
    counts[333] += wrong
    crossings = AngleCrossings(marks=10, counted=True,
                               runs=counter_runs(counts.astype(float), 10.0))
    found = [crossings.update(TIME[block], counts[block])
             for block in (slice(0, 334), slice(334, 800))]
    np.testing.assert_array_equal(
        np.concatenate((*found, crossings.flush())), TIME[20:800:20])
    assert crossings.state.glitches == 1


def test_a_revolution_counter_of_a_bearing_rig(shared_data):
    with np.load(shared_data / 'uia_bearing_rig_1.npz') as data:
        counts, rate = data['tach_count'], float(data['tach_rate'])
    pulses, state = counter_pulses(counts, sample_rate=rate)
    assert pulses.size == counts[-1] - counts[0]
    assert (state.glitches, state.restarts) == (0, 0)
    assert 1.0 / np.diff(pulses).mean() == pytest.approx(4.19, rel=2e-3)


# --- the function -------------------------------------------------------------------------------

@pytest.mark.parametrize(('angle', 'options', 'pulses'), [
    (wrapped(TURNED, 'pi'), {}, 73),
    (wrapped(-TURNED, 'turn'), {'pulses_per_revolution': 4}, 292),
    (360.0 * TURNED % 360.0, {'modulus': 360}, 73),
    (np.floor(4096 * TURNED).astype(np.uint16) % 4096, {'modulus': 4096}, 73),
    (np.floor(2400 * TURNED).astype(np.uint16), {'modulus': 2400}, 73),
    (np.floor(4096 * TURNED).astype(np.int16), {'modulus': 4096, 'pulses_per_revolution': 8}, 584),
    (np.floor(2400 * TURNED).astype(np.uint16),
     {'modulus': 65536, 'pulses_per_revolution': 2400}, 175_182),
    (np.floor(100 * TURNED) % 100, {'modulus': 100.0, 'pulses_per_revolution': 100}, 7299),
    (np.floor(-TURNED).astype(int), {}, 73)])
def test_pulses_from_an_angle_in_rad_or_counts(angle, options, pulses):
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        assert sa.pulses_from_angle(TIME, angle, **options).size == pulses


def test_what_was_bridged_is_said():
    angle = wrapped(TURNED, 'pi')
    angle[5000] = 0.0
    with pytest.warns(DataWarning, match='^1 samples of the angle are where the shaft cannot be'):
        assert sa.pulses_from_angle(TIME, angle).size == 73
    with pytest.warns(DataWarning, match='no pulses: its 10000 samples go from 1 to 1 rad'):
        assert not sa.pulses_from_angle(TIME, np.ones(10_000)).size
    with pytest.warns(DataWarning, match='no pulses: its 0 samples hold no finite one; check'):
        assert not sa.pulses_from_angle([], []).size


@pytest.mark.parametrize(('angle', 'options', 'error', 'message'), [
    ([0.0], {'pulses_per_revolution': 0}, ParameterError, 'pulses_per_revolution 0 must be a who'),
    ([0.0], {'pulses_per_revolution': 1.5}, ParameterError, '1.5 must be a whole number'),
    ([0.0], {'modulus': 2}, ParameterError, 'modulus 2 must be finite and 4 counts or more'),
    ([0.0], {'modulus': -0.5}, ParameterError, 'modulus -0.5 must be finite and above 0 rad'),
    ([0.0], {'modulus': np.inf}, ParameterError, 'modulus inf must be finite'),
    ([0.0], {'modulus': 'x'}, ParameterError, "modulus is 'x': give a number"),
    (['a'], {}, SignalError, 'give one row of real numbers, in rad or counts'),
    ([[0.0]], {}, SignalError, 'give one row of real numbers, in rad or counts'),
    ([2**60], {}, SignalError, r'above 2\^53 and not exact'),
    ([1e150], {}, SignalError, r'sample of 1e.150: must be within 1e.100'),
    ([0.0, 1024.0], {}, SignalError, 'from 0 to 1024 in whole numbers, not in rad: give integers'),
    ([0.0, 1.0], {}, SignalError, 'give as many times as angles'),
])
def test_unusable_angles_are_refused_in_a_line(angle, options, error, message):
    with pytest.raises(error, match=message):
        sa.pulses_from_angle([0.0], angle, **options)


def test_times_that_run_backwards_are_refused_and_early_stamps_are_not():
    order = np.random.default_rng(1).permutation(TIME.size)
    with pytest.raises(SignalError, match='the times run backwards: sort them'):
        sa.pulses_from_angle(TIME[order], wrapped(TURNED, 'pi')[order])
    early = TIME.copy()
    early[500] -= 0.005
    assert sa.pulses_from_angle(early, wrapped(TURNED, 'pi')).size == 73


@pytest.mark.parametrize('turn', [360.0, 1.0])
def test_an_angle_in_another_unit_has_any_number_of_marks(turn):
    time = np.arange(4000) / 1e3
    angle = (9.3 * time + 0.3) % 1.0 * turn
    for marks in (1, 16):
        pulses = sa.pulses_from_angle(time, angle, pulses_per_revolution=marks, modulus=turn)
        assert np.diff(pulses) == pytest.approx(1.0 / 9.3 / marks, abs=1e-9)
        assert pulses.size == pytest.approx(37.2 * marks, abs=1)


def test_an_angle_that_wraps_at_360_is_told():
    time = np.arange(4000) / 1e3
    with pytest.warns(sa.DataWarning, match='wraps at about 360, .* give modulus=360'):
        sa.pulses_from_angle(time, 9.3 * time % 1.0 * 360.0)


@pytest.mark.parametrize('rate', [300.0, 1e3, 10e3])
@pytest.mark.parametrize('bits', [4, 6, 10])
def test_positions_in_gray_code_are_refused_with_the_remedy(rate, bits):
    time = np.arange(int(4.0 * rate)) / rate
    turned = 7.3 * time + 0.01 * np.sin(20.0 * time)
    binary = np.floor(2**bits * turned).astype(int) % 2**bits
    coded = binary ^ (binary >> 1)
    with pytest.raises(SignalError, match=r'Gray code .* counts \^= counts >> shift'):
        sa.pulses_from_angle(time, coded, modulus=2**bits)
    for shift in (1, 2, 4, 8, 16):
        coded ^= coded >> shift
    assert sa.pulses_from_angle(time, coded, modulus=2**bits).size == 29


@pytest.mark.parametrize('bits', [16, 32])
def test_a_glitch_and_an_overflow_are_no_gray_code(bits):
    counts = np.floor(50.0 - 100.0 * TURNED).astype(np.int64) % 2**bits
    counts[5000] = 5 * 2**(bits - 3)
    with pytest.warns(DataWarning, match='^1 samples of the angle are where the shaft cannot be'):
        assert sa.pulses_from_angle(TIME, counts, pulses_per_revolution=100).size == pytest.approx(
            7300, abs=1)


@pytest.mark.parametrize('rate', [100.0, 1e3, 10e3])
def test_an_angle_in_degrees_that_was_unwrapped_is_doubted(rate):
    time = np.arange(int(4.0 * rate)) / rate
    angle = 360.0 * 25.2 * time + np.sin(20.0 * time)
    with pytest.warns(DataWarning, match=r'would turn 14\d\d times a second: .* modulus=360'):
        sa.pulses_from_angle(time, angle)
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        assert sa.pulses_from_angle(time, angle, modulus=360).size == 100
        assert sa.pulses_from_angle(time, np.radians(angle)).size == 100
