# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Targets of few marks of which one is loose, and machines that must not look so."""

import numpy as np
import pytest
import sa_jitter_ros as sa
from sa_jitter_ros.errors import DataWarning
from sa_jitter_ros.pulses.validation import PulseValidator

TURNS, SPEED = 150, 20.0  # revolutions, Hz


def _times(seed, marks, *, share=0.0, off=0.0, jitter=1e-4, scatter=0.0, ramp=0.0):
    """Return pulses (s); `off` is in intervals, `jitter` in revolutions."""
    rng = np.random.default_rng(seed)
    angle = np.arange(TURNS)[:, None] + np.arange(marks) / marks + rng.normal(0.0, 4e-3, marks)
    loose = rng.random(TURNS) < share
    angle[loose, rng.integers(marks)] += off / marks
    angle = angle.ravel() + rng.normal(0.0, jitter, angle.size)
    time = np.linspace(-1.0, 2.0 * TURNS / SPEED, 40_000)
    speed = 1.0 + ramp * np.clip(time - 3.0, 0.0, 2.0) + scatter * np.sin(
        2.0 * np.pi * 3.1 * time + rng.uniform(0.0, 6.0))
    turned = np.cumsum(SPEED * speed) * (time[1] - time[0])
    return np.interp(angle, turned - np.interp(0.0, time, turned), time)


def _said(times, marks, blocks=7):
    validator = PulseValidator(pulses_per_revolution=marks)
    lines = []
    for part in np.array_split(times, blocks):
        validator.update(part)
        lines += [line for line in validator.take_messages() if 'beside its place' in line]
    return lines, validator.counts.displaced


@pytest.mark.machines
@pytest.mark.parametrize(('share', 'off', 'marks'), [
    *((0.2, 0.3, marks) for marks in (1, 2, 3, 4)), (0.4, -0.1, 1), (0.4, -0.1, 4), (0.4, 0.4, 2)])
def test_a_loose_mark_is_said_once(share, off, marks):
    times = _times(3, marks, share=share, off=off)
    (line,), displaced = _said(times, marks)
    assert f'of {marks}, counted' in line
    assert 4 < displaced < 1.3 * share * TURNS
    assert _said(times, marks, blocks=90) == ([line], displaced)


@pytest.mark.machines
@pytest.mark.parametrize('marks', [1, 2, 4])
@pytest.mark.parametrize('machine', [
    {'jitter': 0.01}, {'jitter': 0.03}, {'scatter': 0.3}, {'ramp': 0.3}, {'ramp': -0.3}])
def test_no_other_machine_has_a_loose_mark(marks, machine):
    for seed in range(2):
        assert _said(_times(seed, marks, **machine), marks) == ([], 0)


@pytest.mark.machines
@pytest.mark.parametrize('marks', [1, 4])
def test_lost_and_stray_pulses_and_clocks_are_no_loose_mark(marks):
    times, size = _times(5, marks), 11 * marks  # pulses fitted at once
    lost = np.random.default_rng(6).random(times.size) < 0.03
    assert _said(times[~lost], marks) == ([], 0)
    for first in range(size):  # one in all that are fitted
        strays = times[first::size - 1] + 0.3 / SPEED / marks
        assert _said(np.sort(np.concatenate([times, strays])), marks) == ([], 0)
    for tick in (1e-3, 3e-3):
        assert _said(np.ceil(times / tick) * tick, marks) == ([], 0)


def test_the_average_warns():
    times = _times(3, 1, share=0.4, off=0.1)
    with pytest.warns(DataWarning, match='is the target loose'):
        sa.average(np.zeros(8000), 1e3, times)
