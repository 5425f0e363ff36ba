# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The lines of the vibration against the declared gears."""

import numpy as np
import pytest
import sa_jitter_ros as sa
from sa_jitter_ros.keyphasor_check.check import check_keyphasor
from sa_jitter_ros.keyphasor_check.declared_parts import contradictions
from sa_jitter_ros.keyphasor_check.lines import ToothLines
from sa_jitter_ros.recordings.recording import ArraySource, Recording

RATIO = 183 / 76  # of the input shaft
#: In orders of the output shaft: mesh harmonics of 19 teeth with sidebands.
PLACES = RATIO * np.array([18.0, 19.0, 20.0, 38.0, 57.0])


def gearbox(first=19, second=61, third=32, fourth=24):
    return sa.Machine('output', gears={
        'first': {'shaft': 'input', 'teeth': first, 'mate_shaft': 'layshaft',
                  'mate_teeth': second},
        'second': {'shaft': 'layshaft', 'teeth': third, 'mate_shaft': 'output',
                   'mate_teeth': fourth}})


def lines_at(places):
    return ToothLines(np.sort(places), np.full(len(places), 50.0), np.ones(len(places)), 0.005)


def test_the_right_teeth_are_not_contradicted():
    assert contradictions(lines_at(PLACES), gearbox()) == []
    assert contradictions(None, gearbox()) == []
    assert contradictions(lines_at(PLACES), sa.Machine()) == []


@pytest.mark.parametrize(('wrong', 'name'), [
    ({'first': 20}, 'first.teeth is 20, but 5 lines of the vibration fit 19'),
    ({'first': 17}, 'first.teeth is 17, but 5 lines of the vibration fit 19'),
    ({'first': 22}, 'first.teeth is 22, but 5 lines of the vibration fit 19'),
    ({'second': 60}, 'first.mate_teeth is 60, but 5 lines of the vibration fit 61'),
    ({'third': 33}, 'second.teeth is 33, but 5 lines of the vibration fit 32'),
    ({'fourth': 25}, 'second.mate_teeth is 25, but 5 lines of the vibration fit 24')])
def test_a_miscounted_gear_is_named_with_the_ratio_that_it_spoils(wrong, name):
    found, = contradictions(lines_at(PLACES), gearbox(**wrong))
    assert found.code == 'machine_contradicted'
    assert name in found.text
    assert 'input 2.40789 instead of' in found.text


def test_another_machine_has_no_mesh_in_the_vibration():
    found, = contradictions(lines_at(PLACES), gearbox(first=25, second=50))
    assert (found.code, 'mesh input-layshaft 1x 37.5' in found.text) == ('mesh_absent', True)


def test_a_planetary_stage():
    stage = {'sun': 20, 'ring': 100, 'planet': 40, 'planets': 4, 'fixed': 'ring',
             'input_shaft': 'sun', 'output_shaft': 'drum'}
    lines = lines_at(np.array([96.0, 100.0, 104.0, 200.0, 300.0]))
    assert contradictions(lines, sa.Machine('drum', planetary={'p': stage})) == []
    other = sa.Machine('drum', planetary={'p': {**stage, 'sun': 22, 'ring': 102}})
    assert [item.code for item in contradictions(lines, other)] == ['mesh_absent']


@pytest.mark.machines
def test_random_lines_contradict_nothing_by_chance():
    """Of 100 machines whose lines are somewhere, beside two harmonics of the mesh."""
    rng = np.random.default_rng(1)
    codes = [item.code for _ in range(100) for item in contradictions(
        lines_at(np.concatenate((RATIO * np.array([19.0, 38.0]), rng.uniform(1.0, 150.0, 8)))),
        gearbox())]
    assert not codes


@pytest.mark.machines
def test_a_check_takes_the_machine():
    time = np.arange(200_000) / 5e3
    angle = 2.0 * np.pi * RATIO * 10.0 * time
    rng = np.random.default_rng(1)
    vibration = (1.0 + 0.2 * np.cos(angle)) * np.cos(19.0 * angle) + 0.5 * np.cos(
        38.0 * angle) + rng.normal(0.0, 0.1, time.size)
    recording = Recording(ArraySource(vibration[None]), 5e3, pulse_times=np.arange(1, 399) / 10.0)
    check = check_keyphasor(recording, machine=gearbox(first=20))
    assert check.findings['ratio'].value == pytest.approx(RATIO, rel=1e-4)
    assert 'machine_contradicted' in {item.code for item in check.warnings}
    # 19 teeth at 183/76 of the speed are 183/4 orders of the tach shaft: four marks would do, too
    assert 'marks_ambiguous' in {item.code for item in check_keyphasor(recording).warnings}
    check = check_keyphasor(recording, machine=gearbox())
    assert check.findings['pulses_per_revolution'].value == 1
    assert not {item.code for item in check.warnings} & {'mesh_absent', 'marks_ambiguous'}
