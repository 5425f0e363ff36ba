# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The machine by its parts, against formulas worked out by hand and published figures."""

import csv
from math import gcd, radians

import numpy as np
import pytest
import sa_jitter_ros as sa
from sa_jitter_ros.commands import average
from sa_jitter_ros.machine import following, Machine
from sa_jitter_ros.monitoring.monitor import Change
from sa_jitter_ros.offline.files import Signals

STAGE = {'shaft': 'input', 'teeth': 19, 'mate_shaft': 'output', 'mate_teeth': 61}


def a_machine(**parts):
    return Machine.of({'tach_shaft': 'output', 'gears': {'stage': STAGE}, **parts})


def test_a_gear_pair():
    machine = a_machine()
    assert machine.shafts == ('output', 'input')
    assert machine.ratio('input') == pytest.approx(61 / 19)
    orders = machine.orders('input')
    assert [orders[f'mesh input-output {k}x'] for k in (1, 2, 3)] == [19.0, 38.0, 57.0]
    assert orders['mesh input-output 2x +1 input'] == 39.0
    assert orders['mesh input-output 1x -1 output'] == pytest.approx(19.0 - 19.0 / 61.0)
    assert orders['hunting tooth input-output'] == pytest.approx(1 / 61)
    assert machine.orders('output')['mesh input-output 1x'] == 61.0
    # The same frequency, seen from the other shaft.
    assert machine.orders('output')['hunting tooth input-output'] == pytest.approx(1 / 19)
    assert machine.average_orders('input') == (18, 19, 20, 37, 38, 39, 56, 57, 58)
    assert machine.name_of('input', 38.0) == 'mesh input-output 2x'
    assert machine.name_of('input', 30.0) == machine.name_of('elsewhere', 38.0) == ''


@pytest.mark.parametrize('teeth', [(19, 61), (18, 60), (20, 60), (25, 40)])
def test_hunting_tooth_and_assembly_phase(teeth):
    """The same teeth meet after lcm(a, b) teeth: a hunting tooth frequency of mesh gcd / (a b)."""
    first, second = teeth
    orders = a_machine(gears={'g': {**STAGE, 'teeth': first, 'mate_teeth': second}}).orders(
        'input')
    phases = gcd(first, second)
    turns = first * second / phases / first
    assert orders['hunting tooth input-output'] == pytest.approx(1.0 / turns)
    assert orders.get('assembly phase input-output', first) == pytest.approx(first / phases)


def test_a_train_of_two_stages():
    machine = a_machine(tach_shaft='input', gears={'first': STAGE, 'second': {
        'shaft': 'output', 'teeth': 23, 'mate_shaft': 'drum', 'mate_teeth': 70}})
    assert machine.ratio('drum') == pytest.approx(19 / 61 * 23 / 70)
    assert {'mesh input-output 1x', 'mesh output-drum 1x'} <= machine.orders('output').keys()
    assert machine.mesh_orders('output') == (23.0, 61.0)


def test_two_pairs_between_the_same_shafts_have_names_of_their_own():
    machine = a_machine(gears={'low': STAGE, 'high': {**STAGE, 'teeth': 38, 'mate_teeth': 122}})
    assert machine.orders('input')['mesh input-output (high) 1x'] == 38.0


# Fixed member, speeds of sun, ring, carrier, ratio output / input, mesh order of both shafts: of
# sun 20, ring 100, planet 40, by hand from (sun - carrier) / (ring - carrier) = -100 / 20.
PLANETARY = [
    ('ring', 1 / 6, 100 / 6, 100.0),  # sun in, carrier out: sun turns 6 times
    ('sun', 1 / 1.2, 100 * 0.2 / 1.2, 20.0),  # ring in, carrier out: ring turns 1.2 times
    ('carrier', 1 / 5, 20.0, 100.0)]  # sun in, ring out


@pytest.mark.parametrize(('fixed', 'ratio', 'input_mesh', 'output_mesh'), PLANETARY)
def test_planetary_stages(fixed, ratio, input_mesh, output_mesh):
    machine = Machine.of({'tach_shaft': 'motor', 'planetary': {'stage': {
        'sun': 20, 'ring': 100, 'planet': 40, 'planets': 4, 'fixed': fixed,
        'input_shaft': 'motor', 'output_shaft': 'drum'}}})
    assert machine.ratio('drum') == pytest.approx(ratio)
    assert machine.orders('motor')['mesh stage 1x'] == pytest.approx(input_mesh)
    assert machine.orders('drum')['mesh stage 2x'] == pytest.approx(2.0 * output_mesh)
    if fixed == 'ring':
        drum = machine.orders('drum')
        assert drum['planet pass stage'] == drum['ring fault stage'] == 4.0
        assert drum['mesh stage 1x -1 planet pass'] == 96.0
        assert drum['sun fault stage'] == 20.0  # 4 planets pass a tooth of the sun, (6 - 1) turns
        assert drum['planet fault stage'] == 5.0  # 100 / 40 turns against the carrier, two rings
        assert machine.mesh_orders('motor') == ()  # 100 / 6 is not whole
        assert machine.mesh_orders('drum') == (100.0,)
        assert machine.average_orders('drum')[:2] == (4.0, 96.0)


def test_a_planetary_stage_that_steps_up():
    """A wind turbine: its rotor turns the carrier."""
    machine = Machine.of({'tach_shaft': 'rotor', 'planetary': {'stage': {
        'sun': 21, 'ring': 99, 'planet': 39, 'planets': 3, 'fixed': 'ring', 'input': 'carrier',
        'input_shaft': 'rotor', 'output_shaft': 'fast'}}})
    assert machine.ratio('fast') == pytest.approx(1 + 99 / 21)  # 5.714, of the NREL gearbox


def test_bearing_by_geometry():
    """SKF 6205-2RS, drive end of the test rig of Case Western Reserve University, as published."""
    machine = a_machine(bearings={'drive_end': {
        'shaft': 'input', 'balls': 9, 'pitch_diameter': 1.537 * 0.0254,
        'ball_diameter': 0.3126 * 0.0254, 'contact_angle': 0.0}})
    orders = machine.bearing_orders('input')
    published = {'inner': 5.4152, 'outer': 3.5848, 'cage': 0.39828, '2x ball': 4.7135}
    for part, order in published.items():
        assert orders[f'bearing drive_end {part}'] == pytest.approx(order, rel=4e-4)
    assert machine.bearing_orders('output') == {}
    assert machine.name_of('input', orders['bearing drive_end outer'], bearing=True) == (
        'bearing drive_end outer')


def test_bearing_with_a_contact_angle_and_with_the_outer_ring_on_the_shaft():
    """By hand: d / D cos = 0.2 x 0.5."""
    given = {'shaft': 'input', 'balls': 10, 'pitch_diameter': 0.05, 'ball_diameter': 0.01,
             'contact_angle': radians(60.0)}
    expected = {'cage': 0.45, 'ball': 2.475, '2x ball': 4.95, 'inner': 5.5, 'outer': 4.5}
    for rotating, cage in (('inner', 0.45), ('outer', 0.55)):
        machine = a_machine(bearings={'b': {**given, 'rotating': rotating}})
        assert machine.bearing_orders('input') == pytest.approx(
            {f'bearing b {part}': order for part, order in {**expected, 'cage': cage}.items()})


def test_bearing_by_the_orders_of_its_maker():
    machine = Machine.of({'bearings': {'b': {
        'shaft': 'fan', 'cage': 0.4, 'ball': 2.3, 'inner': 5.4, 'outer': 3.6}}})
    assert machine.tach_shaft == 'fan'
    assert sorted(machine.bearing_orders('fan').values()) == [0.4, 2.3, 3.6, 4.6, 5.4]


def test_a_shaft_behind_a_belt():
    fan = {'shaft': 'fan', 'cage': 0.4, 'ball': 2.3, 'inner': 5.4, 'outer': 3.6}
    machine = a_machine(belts={'b': {'shaft': 'output', 'mate_shaft': 'fan', 'ratio': 0.4}},
                        bearings={'f': fan})
    assert machine.ratio('fan') == 0.4 * machine.ratio('output')
    assert machine.orders('fan') == machine.bearing_orders('fan') != {}
    closed = {'shaft': 'fan', 'teeth': 20, 'mate_shaft': 'output', 'mate_teeth': 8}
    Machine('output', belts=machine.belts, gears={'again': closed})  # 8 / 20 is 0.4
    found = following({'machine.tach_shaft': 'motor', 'machine.belts.b.shaft': 'motor',
                       'machine.belts.b.mate_shaft': 'fan', 'machine.belts.b.ratio': 0.5})
    assert (found['shafts'], found['fan.ratio']) == (['motor', 'fan'], 0.5)


RING = {'sun': 20, 'ring': 100, 'planet': 40, 'planets': 4, 'fixed': 'ring',
        'input_shaft': 'output', 'output_shaft': 'drum'}
BALLS = {'shaft': 'input', 'balls': 9, 'pitch_diameter': 0.04, 'ball_diameter': 0.008}
WRONG = [
    ({'gears': {'a': STAGE, 'b': {**STAGE, 'teeth': 20}}},
     'machine.gears.b closes the train with another ratio: output .*check the teeth'),
    ({'belts': {'a': {'shaft': 'input', 'mate_shaft': 'input', 'ratio': 2.0}}},
     'machine.belts.a: shaft and mate_shaft are both input'),
    ({'belts': {'a': {'shaft': 'input', 'mate_shaft': 'fan', 'ratio': 0}}},
     'machine.belts.a.ratio is 0: give more than 0.0'),
    ({'gears': {'a': {**STAGE, 'teeth': 4}}}, 'machine.gears.a.teeth is 4: give at least 5'),
    ({'gears': {'a': {**STAGE, 'teeth': 19.5}}}, 'machine.gears.a.teeth is 19.5'),
    ({'gears': {'a': {'shaft': 'input', 'teeth': 19}}}, 'gears.a lacks mate_shaft, mate_teeth'),
    ({'gears': {'a': {**STAGE, 'tooth': 19}}}, 'machine.gears.a has unknown tooth: give shaft'),
    ({'gears': {'a': STAGE, 'b': {**STAGE, 'shaft': 'x', 'mate_shaft': 'y'}}},
     'shaft x is not coupled with the tach shaft output'),
    ({'gears': {'a': {**STAGE, 'shaft': 'output'}}}, 'are both output'),
    ({'gears': {'a': {**STAGE, 'shaft': 'Input shaft'}}}, 'small letters'),
    ({'gears': 5}, 'machine.gears is unknown'),
    ({'tach_shaft': 'fan'}, 'tach_shaft is fan, which nothing turns: give one of input'),
    ({'tach_shaft': ''}, 'tach_shaft is not given: name the shaft .* one of input, output'),
    ({'planetary': {'p': {**RING, 'planets': 7}}}, 'p does not assemble: .* no multiple of 7'),
    ({'planetary': {'p': {**RING, 'ring': 108}}}, 'does not assemble: .* planet = 100 teeth'),
    ({'planetary': {'p': {**RING, 'planets': 5}}}, '5 planets touch each other'),
    ({'planetary': {'p': {**RING, 'fixed': 'planet'}}}, 'give one of sun, ring, carrier'),
    ({'planetary': {'p': {**RING, 'input': 'ring'}}}, 'input is ring, which is fixed'),
    ({'bearings': {'b': {**BALLS, 'shaft': 'fan'}}}, 'b.shaft is fan, which is unknown: give one'),
    ({'bearings': {'b': {**BALLS, 'outer': 3.6}}}, 'give its geometry or its orders'),
    ({'bearings': {'b': {'shaft': 'input', 'balls': 9}}}, 'b lacks pitch_diameter'),
    ({'bearings': {'b': {**BALLS, 'ball_diameter': 0.02}}}, 'do not fit'),
    ({'bearings': {'b': {'shaft': 'input', 'outer': 5.4, 'inner': 3.6}}}, 'are they swapped'),
    ({'bearings': {'b': {'shaft': 'input', 'cage': 12.0}}}, 'orders of the shaft, not Hz'),
    ({'wheels': 3}, 'machine.wheels is unknown: give tach_shaft, gears')]


@pytest.mark.parametrize(('parts', 'message'), WRONG, ids=[text[:25] for _, text in WRONG])
def test_wrong_machines_are_one_line(parts, message):
    with pytest.raises(sa.ParameterError, match=message) as caught:
        a_machine(**parts)
    assert '\n' not in str(caught.value)


def test_a_train_that_closes_with_the_same_ratio_is_one():
    machine = a_machine(gears={'a': STAGE, 'b': {**STAGE, 'teeth': 38, 'mate_teeth': 122}})
    assert machine.ratio('input') == pytest.approx(61 / 19)


def test_machine_file(tmp_path):
    path = tmp_path / 'machine.yaml'
    path.write_text('/**:\n  ros__parameters:\n    machine:\n      tach_shaft: output\n'
                    '      gears:\n        stage: {shaft: input, teeth: 19, mate_shaft: output,'
                    ' mate_teeth: 61}\n')
    machine = sa.Machine.read(path)
    assert machine == a_machine()
    with pytest.raises(sa.ParameterError, match=r'shaft fan is unknown .* output, input'):
        machine.ratio('fan')
    path.write_text('/**:\n  ros__parameters:\n    hardware_id: pump\n')
    with pytest.raises(sa.ParameterError, match='no machine'):
        sa.Machine.read(path)


def given(**values):
    return {**{f'machine.gears.g.{key}': value for key, value in STAGE.items()},
            'machine.tach_shaft': 'output', **values}


def test_what_follows_from_the_machine():
    found = following(given(shafts=['input']))
    assert found['input.ratio'] == pytest.approx(61 / 19)
    assert found['input.mesh_orders'] == [19.0]
    assert found['input.orders'] == [18, 19, 20, 37, 38, 39, 56, 57, 58]
    assert following(given())['shafts'] == ['output', 'input']
    assert following({'shafts': ['shaft']}) == {}


def test_csv_and_changes_show_the_names(tmp_path):
    """Of a change the name is that of the part, and the order a number beside it."""
    change = Change('input', 0, 'order', '38', 0.1, 0.01, 3, 9.5, 0.0, 1e-9,
                    'mesh input-output 2x')
    assert str(change).startswith('mesh input-output 2x of input, channel 0: +10')
    assert (change.content()['name'], change.content()['order']) == ('mesh input-output 2x', 38.0)
    signals = Signals('rig', (0,), ('a',), ('g',), a_machine())
    assert signals.order('input', 38.0) == 'mesh input-output 2x (38)'
    assert signals.order('input', 40.0) == '40'
    (tmp_path / 'm.yaml').write_text(
        '/**: {ros__parameters: {machine: {tach_shaft: output, gears: {g: {shaft: input, '
        'teeth: 19, mate_shaft: output, mate_teeth: 61}}}}}\n'
        '/**/synchronous_averager: {ros__parameters: {shafts: [input], trigger_cycles: 10}}\n')
    time = np.arange(40_000) / 4e3
    np.savez(tmp_path / 'rig.npz', vibration=np.cos(2.0 * np.pi * 19.0 * 61 / 19 * 5.0 * time),
             sample_rate=4e3, pulse_times=np.arange(1, 49) / 5.0)
    assert average.main([str(tmp_path / 'rig.npz'), '--params', str(tmp_path / 'm.yaml'),
                         '--output', str(tmp_path / 'out'), '--no-figures']) == 0
    with (tmp_path / 'out' / 'averages.csv').open() as file:
        rows = list(csv.DictReader(file))
    assert {row['part'] for row in rows if row['order'] == '38.0'} == {'mesh input-output 2x'}


def test_plain_numbers_win():
    found = following(given(**{'shafts': ['input'], 'input.ratio_teeth': [61, 19]}))
    assert 'input.ratio' not in found
    belt = following(given(**{'shafts': ['input', 'fan'], 'fan.ratio': 0.7}))
    assert 'fan.orders' not in belt
    with pytest.raises(sa.ParameterError, match='shafts names fan, which the machine does not'):
        following(given(shafts=['input', 'fan']))
