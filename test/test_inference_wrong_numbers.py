# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""A machine whose speed swings, and what the loop says of numbers that are declared wrong."""

from dataclasses import replace

import numpy as np
import pytest
from sa_jitter_ros.effects import make_effect
from sa_jitter_ros.inference import record_fit
from sa_jitter_ros.inference.observation import observe
from sa_jitter_ros.inference.trace import trace
from sa_jitter_ros.loop import close_loop
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.recordings.recording import ArraySource, Recording
from sa_jitter_ros.report.report import report
from sa_jitter_ros.report.words import findings
import yaml

pytestmark = pytest.mark.usefixtures('unasked')
RATE, SPEED, CYCLES, NOISE, SECONDS = 4000.0, 16.0, 16, 0.3, 26.0
ORDERS, SIZES = (20.0, 40.0, 60.0), (1.0, 0.7, 0.8)
MODEL = DeclaredModel(keyphasor_rate=20000.0, trigger_speed=SPEED, trigger_cycles=CYCLES,
                      orders=ORDERS, sample_rate=RATE, noise_std=NOISE)


def machine(*, swing=0.02, late=0.0, tone=(0.0, 0.0), wander=(0.0, 0.0), scale=1.0, rise=0.0,
            clock=0.0, source_rate=RATE, seconds=12.0):
    """
    Return a recording of a shaft whose speed swings by a part of it, and rises by another.

    Pulses are `late` (s), a `tone` has a frequency in Hz and an amplitude, a `wander` a standard
    deviation in rad and a highest frequency in cycles a trigger cycle. A `clock` in Hz rounds the
    pulses; samples of another `source_rate` are interpolated linearly.
    """
    rng = np.random.default_rng(7)
    time = np.arange(round(seconds * source_rate) + 1) / source_rate
    swings = 2.0 * np.pi * 0.15
    turns = SPEED * (time - swing * np.cos(swings * time) / swings
                     + 0.5 * rise * time**2 / seconds)
    waves = rng.uniform(0.0, wander[1] * SPEED, 200)
    angle = wander[0] * np.sqrt(2.0 / waves.size) / (2.0 * np.pi) * sum(
        np.cos(2.0 * np.pi * f * time + phase)
        for f, phase in zip(waves, rng.uniform(0.0, 2.0 * np.pi, waves.size)))
    vibration = sum(size * np.cos(2.0 * np.pi * order * (turns + angle) + order)
                    for order, size in zip(ORDERS, SIZES))
    vibration += tone[1] * np.cos(2.0 * np.pi * tone[0] * time)
    even = np.arange(round(seconds * RATE)) / RATE
    vibration = np.interp(even, time, vibration)
    vibration += NOISE * rng.standard_normal(even.size)
    pulses = np.interp(np.arange(0.5, turns[-1]), turns, time)
    pulses += late + rng.uniform(-0.5, 0.5, pulses.size) / MODEL.keyphasor_rate
    if clock:
        pulses = np.ceil(pulses * clock) / clock
    return Recording(ArraySource(scale * vibration[None]), RATE, pulse_times=pulses)


def told(recording, model=MODEL, declared=()):
    """Return the report of the loop."""
    return report(trace([observe(recording, model)], [recording], declared=declared))


def names(content):
    """Return the names of what is missing."""
    return [item['name'] for item in content['missing_effects']]


def parameter(content, name):
    """Return value and standard error of the parameter of the only missing effect."""
    item, = content['missing_effects']
    return item['parameters'][name]['value'], item['parameters'][name]['standard_error']


@pytest.mark.machines
@pytest.mark.filterwarnings('ignore::sa_jitter_ros.errors.DataWarning')
def test_wrong_ratio_grows_with_the_angle_where_the_speed_changes(tmp_path):
    """
    The right one is in the parameter file, unless the recording states the wrong one.

    Another one is refused with that; a declared skew may grow with the angle.
    """
    recording = replace(machine(seconds=16.0), ratio=0.999)
    loop = close_loop(recording, {
        'keyphasor_rate': MODEL.keyphasor_rate, 'trigger_speed': SPEED, 'trigger_cycles': CYCLES,
        'orders': list(ORDERS), 'noise_std': NOISE, 'ratio': 0.999})
    content = replace(loop, ratio_is_stated=False).report
    assert names(content) == ['clock_skew']
    change, = content['declared_changes']
    assert (change['name'], change['parameter'], change['declared']) == (
        'ratio', 'ratio', 0.999)
    assert abs(change['value'] - 1.0) < 3.0 * change['standard_error'] < 1.2e-6
    assert content['error_after']['rms'] < 0.2 * content['error_before']['rms']
    section, = yaml.safe_load(content['parameter_file']).values()
    assert section['ros__parameters']['ratio'] == pytest.approx(change['value'], rel=1e-9)
    assert 'effects' not in section['ros__parameters']
    file = tmp_path / 'model.yaml'
    file.write_text(loop.report['parameter_file'])
    again = close_loop(recording, file).report
    assert (again['verdict'], again['declared_changes']) == ('none', [])


@pytest.mark.machines
def test_wrong_ratio_at_one_speed_is_said_to_be_inseparable_from_a_skew():
    content = told(machine(swing=0.0), replace(MODEL, ratio=1.0002))
    assert (names(content), content['declared_changes']) == (['clock_skew'], [])
    evidence = content['missing_effects'][0]['evidence']
    assert 'instead of 1.0002 makes the same at constant speed' in evidence


@pytest.mark.machines
def test_nothing_is_named_or_looked_for_where_no_declared_order_stands(monkeypatch):
    monkeypatch.setattr(record_fit, 'new_lines', None)
    found = machine(wander=(0.03, 0.2), seconds=6.0)
    slow = observe(replace(found, sample_rate=0.5 * RATE), replace(MODEL, sample_rate=0.5 * RATE))
    assert (len(slow.acquisitions), slow.compared) == (5, ())
    content = told(found, replace(MODEL, ratio=1.01))
    assert (content['verdict'], names(content)) == ('none', [])
    assert content['error_after']['rms'] is None
    assert {item['reason'].split(';')[0] for item in content['not_testable']} == {
        'no line is compared: the vibration holds no declared order'}
    # what the pulses show by themselves
    limit, = [item for item in content['limits'] if item['name'] == 'excess_jitter']
    assert 0.0 < limit['upper_95'] < 1e-4


@pytest.mark.machines
def test_path_delay_does_not_depend_on_the_angle_that_all_lines_turn_by():
    delayed = machine(late=2e-3, seconds=16.0)
    content = told(delayed)
    assert names(content) == ['path_delay']
    value, error = parameter(content, 'delay')
    assert abs(value - 2e-3) < 3.0 * error < 2.5e-4
    right = told(delayed, declared=[make_effect('path_delay', delay=2e-3)])
    assert (right['verdict'], right['declared_changes']) == ('none', [])


@pytest.mark.machines
def test_noise_below_the_declared_is_another_number_and_no_effect():
    content = told(machine(seconds=SECONDS), replace(MODEL, noise_std=2.0 * NOISE))
    assert (content['verdict'], names(content)) == ('none', [])
    change, = content['declared_changes']
    assert (change['name'], change['parameter']) == ('noise', 'noise_std')
    # 5 % of the noise in 40 s
    assert abs(change['value'] - NOISE) < 3.0 * change['standard_error'] < (
        0.05 * NOISE * np.sqrt(40.0 / SECONDS))
    assert content['error_as_declared']['chi2_per_dof'] < 0.5
    assert 0.7 < content['error_after']['chi2_per_dof'] < 1.4
    assert ('noise is not as it was declared.') in [meaning for meaning, _ in findings(content)]
    section, = yaml.safe_load(content['parameter_file']).values()
    assert section['ros__parameters']['noise_std'] == pytest.approx(change['value'], rel=1e-5)


@pytest.mark.machines
def test_noise_above_the_declared_is_another_number_where_it_matters_little():
    content = told(machine(swing=0.0, seconds=SECONDS), replace(MODEL, noise_std=0.9 * NOISE))
    assert content['verdict'] == 'none'
    assert [item['name'] for item in content['present']] == ['additive_noise']
    change, = content['declared_changes']
    assert (change['name'], change['declared']) == ('noise', 0.9 * NOISE)
    assert abs(change['value'] - NOISE) < 4.0 * change['standard_error']


@pytest.mark.machines
def test_period_of_a_declared_clock_need_not_be_declared():
    rounded = machine(clock=3e3)
    model = replace(MODEL, keyphasor_rate=3e3)
    clock = make_effect('keyphasor_quantisation', clock_rate=3e3)
    content = told(rounded, model, declared=[clock])
    assert (content['verdict'], names(content)) == ('none', [])
    assert {item['parameter'] for item in content['declared_changes']} == {'period_std'}


@pytest.mark.machines
def test_beat_slower_than_an_average_is_that_of_an_interpolator():
    content = told(machine(swing=0.0, source_rate=RATE - 0.375))  # six beats, an average takes 1 s
    assert names(content) == ['interpolation_loss']
    assert content['missing_effects'][0]['parameters']['method']['value'] == 'linear'


@pytest.mark.machines
def test_noise_that_is_declared_in_another_unit_ends_in_no_error():
    content = told(machine(swing=0.0, scale=1e-9))
    assert content['verdict'] == 'none'
    change, = content['declared_changes']
    assert change['value'] == pytest.approx(1e-9 * NOISE, rel=0.05)


@pytest.mark.machines
def test_tone_that_hides_its_order_is_named():
    """An order that a tone makes too unsteady to be compared is what the tone disturbs."""
    frequency = 40.0 * SPEED + 0.3
    content = told(machine(swing=0.01, tone=(frequency, 0.6), seconds=16.0))
    assert names(content) == ['interfering_tone']
    assert 40.0 not in [item['order'] for item in content['lines']]
    for name, true in (('frequency', frequency), ('amplitude', 0.6)):
        value, error = parameter(content, name)
        assert abs(value - true) < 3.0 * error


@pytest.mark.machines
def test_tone_is_no_modulation():
    content = told(machine(swing=0.01, tone=(20.0 * SPEED + 0.5, 0.15)),
                   replace(MODEL, orders=(20.0,)))
    assert names(content) == ['interfering_tone']


@pytest.mark.machines
def test_declared_wander_bends_the_angle_inside_cycles():
    """What bends is the declared wander, and no speed that fluctuates."""
    bandwidth = 0.44
    wander = make_effect('phase_wander', std=0.006, bandwidth=bandwidth)
    content = told(machine(wander=(0.006, bandwidth)), declared=[wander])
    assert (content['verdict'], content['declared_changes']) == ('none', [])


@pytest.mark.machines
def test_run_up_passes_the_declared_speed():
    """The speed is half as high again at the end."""
    content = told(machine(rise=0.5, swing=0.0), replace(MODEL, trigger_speed=1.2 * SPEED))
    assert content['verdict'] == 'none'
