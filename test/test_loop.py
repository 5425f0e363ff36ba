# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The loop off line as a function: its arguments, its result, its files."""

from dataclasses import replace
import json
import subprocess
import sys

import numpy as np
import pytest
from sa_jitter_ros.declaration import read_declaration
from sa_jitter_ros.effects import make_effect
from sa_jitter_ros.errors import DataWarning, ModelError, ParameterError, RecordingError
from sa_jitter_ros.inference.observation import observe, together
from sa_jitter_ros.loop import close_loop
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.recordings.npz_format import write_npz
from sa_jitter_ros.recordings.recording import ArraySource, Recording
from sa_jitter_ros.simulation import AdditiveNoise, DeclaredJitter, Gearbox, mesh

pytestmark = pytest.mark.usefixtures('all_unasked')
RATE, SPEED, STD = 5000.0, 25.0, 8e-5
KEYWORDS = {'keyphasor_rate': 20e3, 'trigger_speed': SPEED, 'trigger_cycles': 20,
            'orders': [8, 16, 24], 'noise_std': 0.02}
FILE = """
jitter_predictor:
  ros__parameters: {keyphasor_rate: 2e4, trigger_speed: 25, trigger_cycles: 20,
                    orders: [8.0, 16.0, 24.0], noise_std: 0.02, pinoin: 1}
"""


@pytest.fixture(scope='module')
def recording():
    """Return a recording with normal pulse errors of 80 us."""
    machine = Gearbox(mesh('shaft', 8, harmonics=(1.0, 0.8, 0.6)), RATE, speed=((0.0, SPEED),),
                      effects=(DeclaredJitter('normal', STD), AdditiveNoise(0.02)), seed=3)
    return Recording(ArraySource(machine.vibration(0, 36_000)), RATE,
                     pulse_times=machine.pulses(0.0, 7.2).times)


@pytest.fixture(scope='module')
def found(recording, all_unasked):
    """Return the loop closed on the recording."""
    return close_loop([recording], KEYWORDS)


@pytest.mark.machines
def test_every_way_to_name_recording_and_model_finds_the_same(recording, found, tmp_path):
    path, declared = tmp_path / 'rig.npz', tmp_path / 'model.yaml'
    np.savez(path, vibration=recording.read(), sample_rate=RATE, pulse_times=recording.pulse_times)
    declared.write_text(FILE)
    model = DeclaredModel(**{**KEYWORDS, 'orders': (8.0, 16.0, 24.0), 'sample_rate': RATE})
    with pytest.warns(UserWarning, match='has no such parameters: pinoin'):
        second = close_loop(path, declared)
    assert second.report == {**found.report, 'recordings': [str(path)], 'created': second.created}
    for loop_found in (found, second):
        assert loop_found.verdict == loop_found.report['verdict'] == 'traced'
    short = replace(recording, vibration=ArraySource(recording.read()[:, :10_000]),
                    pulse_times=recording.keyphasor_pulses(duration=2.0))
    write_npz(path, short)  # too short to trace anything in, and quick
    third = close_loop([str(path)], model, names=['rig'])
    assert third.report == {**close_loop(short, KEYWORDS).report, 'recordings': ['rig'],
                            'created': third.created}


@pytest.mark.machines
def test_effects_are_declared_by_name(recording):
    excess = float(np.sqrt(STD**2 - (1.0 / 20e3) ** 2 / 12.0))
    found = close_loop(recording, {**KEYWORDS, 'effects': {'excess_jitter': {'std': excess}}})
    assert found.traces['shaft'].declared == (make_effect('excess_jitter', std=excess),)
    assert found.verdict == 'none'


@pytest.mark.machines
@pytest.mark.usefixtures('undrawn')
def test_written_report_is_the_report(found, tmp_path):
    found.write(tmp_path / 'a' / 'b')
    content = json.loads((tmp_path / 'a' / 'b' / 'report.json').read_text())
    assert content == found.report
    assert {'report.html', 'residual.png'} <= {item.name for item in (
        tmp_path / 'a' / 'b').iterdir()}


@pytest.mark.machines
def test_channel_of_nearly_nothing_or_nothing_new_is_left_out(recording, found):
    samples = recording.read() * [[1.0], [1e-200], [1.0]]
    with pytest.warns(DataWarning) as said:
        both = close_loop(Recording(ArraySource(samples), RATE,
                                    pulse_times=recording.pulse_times), KEYWORDS)
    assert {str(item.message).partition(': ')[2] for item in said} == {
        f'channel 1 is constant at {samples[1, 0]:.6g} and is left out',
        'channel 2 holds the samples of channel 0 again and is left out'}
    assert both.report['missing_effects'] == found.report['missing_effects']
    with pytest.warns(DataWarning, match='channel 0 is constant'):
        alone = close_loop(Recording(ArraySource(samples[1:2]), RATE,
                                     pulse_times=recording.pulse_times), KEYWORDS)
    assert alone.verdict == 'none'
    assert alone.report['error_before']['rms'] is None


@pytest.mark.machines
def test_gap_in_the_vibration_costs_the_trigger_cycles_that_it_touches(recording, found):
    """Of two channels none is whole; one is stuck for a while, too."""
    samples = np.concatenate([recording.read(), 0.5 * recording.read()])
    samples[1, 30_000] = np.inf
    samples[0, 9_000:9_232] = np.nan
    samples[0, 9_232:9_432] = 0.0
    loop_found = close_loop(Recording(ArraySource(samples), RATE,
                                      pulse_times=recording.pulse_times),
                            {**KEYWORDS, 'trigger_cycles': 10})
    assert [effect['name'] for effect in loop_found.report['missing_effects']] == ['excess_jitter']
    std = loop_found.report['missing_effects'][0]['parameters']['std']
    whole = found.report['missing_effects'][0]['parameters']['std']
    assert abs(std['value'] - whole['value']) < std['standard_error']  # nearly the same pulses
    remark, = (text for text in loop_found.report['remarks'] if 'NaN' in text)
    assert remark == ('1.2% of the samples are NaN, infinite or stuck at one value: no '
                      'acquisition contains any of the 5 trigger cycles that they touch')
    observation = loop_found.traces['shaft'].observation
    assert len(observation.channel_names) == len(samples)
    assert len(observation.acquisitions) >= 15


@pytest.mark.machines
def test_trigger_pulses_of_each_recording_are_numbered_by_themselves(recording):
    """Two pulses that the first one lacks move no number of the second."""
    model = DeclaredModel(**{**KEYWORDS, 'trigger_cycles': 10, 'sample_rate': RATE})
    short = replace(recording, vibration=ArraySource(recording.read()[:, :10_000]),
                    pulse_times=recording.pulse_times[:50])
    lacking = replace(short, pulse_times=np.delete(short.pulse_times, [14, 15]))
    observations = [observe(item, model) for item in (lacking, short)]
    first, second = (item.first_numbers for item in observations)
    np.testing.assert_array_equal(np.diff(second), 10)
    assert np.any(np.diff(first) != 10)
    np.testing.assert_array_equal(
        together(observations).first_numbers, np.concatenate([first, second]))


@pytest.mark.machines
def test_reference_that_is_the_pulse_times_is_none(recording, found):
    twice = replace(recording, reference_pulse_times=recording.pulse_times)
    before = found.traces['shaft'].observation
    observed = observe(twice, before.model)
    assert not observed.against_reference
    np.testing.assert_array_equal(observed.stacked('errors'), before.stacked('errors'))
    assert any('the pulse times themselves' in text for text in observed.pulses.remarks)


@pytest.mark.machines
def test_channel_with_a_loose_contact_spoils_no_average(recording):
    """It is left out beside another, and the report says so."""
    samples = recording.read().copy()
    whole = samples.copy()
    for begin in (3_000, 9_000, 15_500, 21_000):
        samples[0, begin:begin + 300] = 0.0
    both = Recording(ArraySource(np.concatenate([samples, whole])), RATE,
                     pulse_times=recording.pulse_times)
    with pytest.warns(DataWarning, match='stuck'):
        content = close_loop(both, {**KEYWORDS, 'trigger_cycles': 10}).report
    assert [effect['name'] for effect in content['missing_effects']] == ['excess_jitter']
    assert any('stuck at one value' in text for text in content['remarks'])


@pytest.mark.machines
@pytest.mark.usefixtures('undrawn')
@pytest.mark.parametrize('name', ['pulse_times', 'reference_pulse_times'])
def test_pulses_without_any_jitter_have_a_report(name, tmp_path):
    """Their errors are all 0, and their intervals equal to rounding."""
    machine = Gearbox(mesh('shaft', 8, harmonics=(1.0, 0.8, 0.6)), RATE, speed=((0.0, SPEED),),
                      effects=(AdditiveNoise(0.02),), seed=3)
    recording = Recording(ArraySource(machine.vibration(0, 15_000)), RATE,
                          **{name: np.cumsum(np.full(74, 1.0 / SPEED))})
    close_loop(recording, {**KEYWORDS, 'trigger_cycles': 10}).write(tmp_path)
    assert (tmp_path / 'pulse_errors.png').is_file()


@pytest.mark.machines
def test_table_of_a_single_error_declares_no_jitter(recording):
    with np.errstate(divide='raise', invalid='raise'):
        assert close_loop(recording, {
            **KEYWORDS, 'jitter_distribution': 'table', 'jitter_table': (1e-5,)}).verdict != 'none'


@pytest.mark.machines
@pytest.mark.usefixtures('undrawn')
def test_every_shaft_has_its_report(recording, found, tmp_path):
    """The ratio of the recording is that of one of the shafts."""
    declared = tmp_path / 'model.yaml'
    declared.write_text("""
jitter_predictor:
  ros__parameters: {keyphasor_rate: 2e4, trigger_speed: 25, trigger_cycles: 20, noise_std: 0.02,
                    shafts: [fast, slow], fast.ratio: 2.0, fast.orders: [4.0, 8.0, 12.0],
                    slow.ratio: 1.0, slow.orders: [8.0, 16.0, 24.0]}
""")
    one, found = found.report, close_loop(replace(recording, ratio=2.0), declared)
    assert list(found.shafts) == ['fast', 'slow']
    assert found.report == {'verdict': 'traced', 'shafts': found.shafts}
    differ = ('created', 'shaft', 'parameter_file')
    assert found.shafts['slow'] == {**one, **{key: found.shafts['slow'][key] for key in differ}}
    assert 'slow.orders' not in one['parameter_file']
    (tmp_path / 'again.yaml').write_text(found.shafts['slow']['parameter_file'])
    again = read_declaration(tmp_path / 'again.yaml')
    assert {shaft: (model.ratio, model.orders) for shaft, model in again.models.items()} == {
        'fast': (2.0, (4.0, 8.0, 12.0)), 'slow': (1.0, (8.0, 16.0, 24.0))}
    assert [effect.name for effect in again.effects] == ['excess_jitter']
    assert [text.split(' = ')[0] for text in found.found] == [
        'fast: excess_jitter std', 'slow: excess_jitter std']
    stds = [item['missing_effects'][0]['parameters']['std']['value']
            for item in found.shafts.values()]
    assert stds[0] == pytest.approx(stds[1], rel=1e-2)  # the same pulses, the same orders in Hz
    assert 'shaft fast\nverdict: traced' in str(found)
    found.write(tmp_path / 'out')
    assert json.loads((tmp_path / 'out' / 'report.json').read_text()) == found.report
    for shaft, content in found.shafts.items():
        assert json.loads((tmp_path / 'out' / shaft / 'report.json').read_text()) == content
        assert f'href="{shaft}/report.html"' in (tmp_path / 'out' / 'report.html').read_text()
    assert not [item for item in (tmp_path / 'out').iterdir() if item.name.startswith('.')]
    with pytest.raises(ModelError, match='the ratio 3, which none of the shafts fast, slow has'):
        close_loop(replace(recording, ratio=3.0), declared)


def test_unusable_input_is_named(recording, tmp_path):
    with pytest.raises(ModelError, match='no recording: give at least one'):
        close_loop([], KEYWORDS)
    with pytest.raises(ModelError, match='pinoin is not a keyword of a declared model'):
        close_loop(recording, {**KEYWORDS, 'pinoin': 1.0})
    with pytest.raises(ModelError, match='model has no trigger_speed, orders: a model needs'):
        close_loop(recording, {'keyphasor_rate': 20e3, 'trigger_cycles': 20})
    with pytest.raises(ParameterError, match='effect excess_jitter is 5e-05: give its parameters'):
        close_loop(recording, {**KEYWORDS, 'effects': {'excess_jitter': 5e-5}})
    with pytest.raises(ModelError, match='declared is None: give the path'):
        close_loop(recording, None)
    with pytest.raises(ModelError, match='recordings is 3: give a path or a Recording'):
        close_loop(3, KEYWORDS)
    with pytest.raises(ModelError, match='the pulse times look like milliseconds'):
        close_loop(replace(recording, pulse_times=1e3 * recording.pulse_times), KEYWORDS)
    with pytest.raises(RecordingError, match='no such file'):
        close_loop(tmp_path / 'none.npz', KEYWORDS)
    with pytest.raises(RecordingError, match=r'^two holds what one holds: give each'):
        close_loop([recording, recording], KEYWORDS, names=['one', 'two'])


@pytest.mark.machines
def test_figures_are_not_loaded_before_they_are_drawn():
    code = ('import sys, sa_jitter_ros.loop; '
            'raise SystemExit(bool({"matplotlib", "rclpy"} & sys.modules.keys()))')
    assert subprocess.run([sys.executable, '-c', code], check=False).returncode == 0
