# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""A sampled angle as keyphasor: crossings of marks, their errors, stops and reversals."""

from itertools import pairwise

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from sa_jitter_ros.errors import ParameterError, SignalError
from sa_jitter_ros.pulses.sampled_angle import AngleCrossings

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
