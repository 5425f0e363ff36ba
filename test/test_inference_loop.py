# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The loop off line on simulated machines: what is observed, what is left, and what is traced."""

from dataclasses import replace
from functools import cache
import json
import math

import numpy as np
import pytest
from sa_jitter_ros.commands.close_loop import main
from sa_jitter_ros.declaration import read_declaration
from sa_jitter_ros.effects import declared_effects, EFFECTS, make_effect
from sa_jitter_ros.effects.lattice import NO_CLOCK
from sa_jitter_ros.errors import ModelError, RecordingError
from sa_jitter_ros.inference.beat import find_beat
from sa_jitter_ros.inference.observation import observe
from sa_jitter_ros.inference.record_pulses import record_pulses
from sa_jitter_ros.inference.residual import residual
from sa_jitter_ros.inference.timing import stretches
from sa_jitter_ros.inference.trace import trace
from sa_jitter_ros.prediction.distributions import Normal
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.pulses.resampling import interpolate
from sa_jitter_ros.recordings import read
from sa_jitter_ros.recordings.recording import ArraySource, Recording
from sa_jitter_ros.report.html_report import report_files
from sa_jitter_ros.report.report import report, summary
from sa_jitter_ros.report.words import findings, next_steps, verdict_sentence
from sa_jitter_ros.simulation.components import mesh
from sa_jitter_ros.simulation.effect import Effect
from sa_jitter_ros.simulation.effects import AdditiveNoise, DeclaredJitter, make_effects
from sa_jitter_ros.simulation.gearbox import Gearbox
from sa_jitter_ros.simulation.motion import Torsion
from scipy import stats
from worse_pulses import with_added_jitter, with_slower_clock

pytestmark = pytest.mark.usefixtures('unasked')
RATE, SPEED, CYCLES, NOISE = 5000.0, 25.0, 20, 0.05
MODEL = DeclaredModel(keyphasor_rate=5000.0, trigger_speed=SPEED, trigger_cycles=CYCLES,
                      orders=(8.0, 16.0, 24.0, 32.0), noise_std=NOISE, sample_rate=RATE)


class Hum(Effect):
    """A trigger level that hums: in no module."""

    def pulse_delay(self, setting, index, times):
        return 100e-6 * np.sin(2.0 * np.pi * 0.2871 * setting.trigger_rate * times)


def simulated(*effects, acquisitions=12, jitter=True, seed=3, reference=False, torsion=()):
    """Return a recording with the declared jitter and noise, and effects that nobody declares."""
    declared = [AdditiveNoise(NOISE, name='declared_noise')]
    if jitter:
        declared.append(DeclaredJitter('uniform', 1.0 / math.sqrt(12.0) / 5000.0))
    gearbox = Gearbox(
        mesh('shaft', 8, harmonics=(1.0, 0.8, 0.6, 0.5), channel_gains=(1.0, 0.7), seed=seed),
        RATE, speed=((0.0, SPEED),), effects=(*declared, *effects), torsion=torsion, seed=seed)
    duration = (acquisitions * CYCLES + 3) / SPEED
    pulses = gearbox.pulses(0.0, duration)
    return Recording(
        ArraySource(gearbox.vibration(0, round(duration * RATE))), RATE, pulse_times=pulses.times,
        reference_pulse_times=pulses.true_times if reference else None, description='simulated')


@cache
def observed(*effects, model=MODEL, **options):
    """Return the observations of a simulated recording, and the recording."""
    recording = simulated(*effects, **options)
    return [observe(recording, model)], [recording]


def traced(*effects, declared=(), **options):
    """Trace a simulated recording."""
    return trace(*observed(*effects, **options), declared=declared)


@pytest.fixture(scope='module')
def plain():
    """Return the loop closed on a machine as it was declared."""
    return traced()


@pytest.mark.machines
def test_order_that_is_declared_twice_counts_once(plain):
    recording = simulated()
    twice = replace(MODEL, orders=(8.0, 16.0, 8.0, 24.0, 32.0, 16.0))
    found = trace([observe(recording, twice)], [recording])
    assert found.observation.orders.tolist() == list(MODEL.orders)
    assert found.verdict == plain.verdict == 'none'
    assert found.after.rms == pytest.approx(plain.after.rms)


def test_observation_finds_the_true_errors_and_attenuation():
    recording = simulated(acquisitions=4)
    truth = simulated(acquisitions=4, reference=True)
    found, best = observe(recording, MODEL), observe(truth, MODEL)
    assert not found.against_reference
    assert best.against_reference
    assert len(found.acquisitions) == 4
    for item, other in zip(found.acquisitions, best.acquisitions):
        assert item.recovered
        off = (item.errors - other.errors) / item.standard_errors
        assert np.sqrt(np.mean(off**2)) < 2.0
        spread = np.hypot(item.attenuation_standard_error, 2e-3)
        assert np.all(np.abs(item.attenuation - other.attenuation) < 5.0 * spread)
    mean = found.stacked('attenuation').mean(axis=0)
    assert np.all(np.diff(mean, axis=1) < 0.0)


@pytest.mark.machines
def test_reference_keyphasor_is_used_unless_the_source_moves_relative_to_it():
    wander = make_effects({'phase_wander': {'std': 0.02}})
    moved = observe(simulated(*wander, acquisitions=4, reference=True), MODEL)
    assert not moved.against_reference
    assert 'the vibration moves against them' in moved.pulses.remarks[-1]
    jitter = make_effects({'excess_jitter': {'std': 80e-6}})
    recording = simulated(*jitter, acquisitions=10, reference=True)
    found = trace([observe(recording, MODEL)], [recording])
    assert found.observation.against_reference
    assert [item.name for item in found.findings] == ['excess_jitter']
    swapped = replace(recording, pulse_times=recording.reference_pulse_times,
                      reference_pulse_times=recording.pulse_times)
    worse = observe(swapped, MODEL)
    assert not worse.against_reference
    assert 'they give less amplitude than pulse_times' in worse.pulses.remarks[-1]


def test_errors_of_all_stretches_are_against_the_vibration_or_all_against_the_reference(rng):
    """The vibration resolves those before a gap only, the reference keyphasor all."""
    whole, gap = simulated(acquisitions=6, reference=True), slice(58, 64)
    samples = whole.read().copy()
    after = samples[:, samples.shape[1] // 2:]
    after += rng.normal(0.0, 3.0, after.shape)
    recording = replace(whole, vibration=ArraySource(samples),
                        pulse_times=np.delete(whole.pulse_times, gap),
                        reference_pulse_times=np.delete(whole.reference_pulse_times, gap))
    parts = stretches(observe(recording, MODEL), range(4), NO_CLOCK)
    assert len(parts) == 2
    assert len({part.referenced for part in parts}) == 1


@pytest.mark.machines
def test_moving_source_takes_from_the_average_with_a_reference_keyphasor_too():
    # An average with the reference keyphasor shows nothing of the loss that the wander makes.
    found = traced(*make_effects({'phase_wander': {'std': 0.006}}), acquisitions=20,
                   reference=True)
    assert found.observation.against_reference
    assert [item.name for item in found.findings] == ['phase_wander']
    highest = found.lines.order == len(MODEL.orders) - 1
    off = (found.attenuation - found.prediction_after.attenuation)[list(found.held_out)]
    loss = (found.prediction_before.attenuation
            - found.prediction_after.attenuation)[list(found.held_out)]
    assert loss[:, highest].mean() > 0.01
    each = off[:, highest].mean(axis=1)  # channels of an acquisition share its wander
    assert abs(each.mean()) < 3.0 * each.std(ddof=1) / np.sqrt(each.size) < loss[:, highest].mean()


@pytest.mark.machines
def test_declared_model_suffices(plain):
    content = report(plain)
    assert plain.verdict == 'none'
    assert content['error_after'] == content['error_before']
    assert content['missing_effects'] == []
    assert {item['name'] for item in content['candidates']} == set(EFFECTS)
    assert all(item['rejected_because'] for item in content['candidates'])
    assert content['acquisitions'] == {'fit': 6, 'held_out': 6}
    assert 0.3 < content['error_before']['chi2_per_dof'] < 2.0


@pytest.mark.machines
def test_few_acquisitions_leave_undecided_what_more_exclude(plain, monkeypatch):
    """What their limits leave room for would still change an average."""
    monkeypatch.undo()
    assert 'excess_jitter' in traced(acquisitions=4).undecided
    assert plain.undecided == ()


@pytest.mark.parametrize(('name', 'values', 'parameter'), [
    ('excess_jitter', {'std': 80e-6}, 'std'),
    pytest.param('missing_pulses', {'probability': 0.015}, 'probability',
                 marks=pytest.mark.machines),
])
def test_effect_on_the_mean_is_traced(name, values, parameter):
    content = report(traced(*make_effects({name: values})))
    assert content['verdict'] == 'traced'
    assert [item['name'] for item in content['missing_effects']] == [name]
    stated = content['probabilities']
    assert stated.keys() == EFFECTS.keys() - {item['name'] for item in content['not_testable']}
    assert {other for other, value in stated.items() if value > 0.9} == {name}
    assert all(0.0 <= item <= 1.0 for item in stated.values())
    assert content['error_before']['p_value'] < 0.01
    assert content['error_after']['p_value'] > 1e-3
    fitted = content['missing_effects'][0]['parameters'][parameter]
    assert abs(fitted['value'] - values[parameter]) < 4.0 * fitted['standard_error']
    before, after = content['error_before']['rms'], content['error_after']['rms']
    chance = content['error_after']['rms_standard_error']
    assert after < max(before / 5.0, 2.5 * chance)  # few acquisitions


@pytest.mark.machines
@pytest.mark.parametrize(('name', 'values', 'tolerances'), [
    ('amplitude_modulation', {'std': 0.3}, {'std': 0.08}),
    # of the frequency four standard errors: the jitter of the mean speed makes more
    ('interfering_tone', {'frequency': 400.9, 'amplitude': 0.12},
     {'amplitude': 0.01, 'frequency': 0.0016}),
])
def test_effect_on_the_scatter_is_traced(name, values, tolerances):
    content = report(traced(*make_effects({name: values}), seed=5, acquisitions=8))
    assert content['verdict'] == 'traced'
    assert [item['name'] for item in content['missing_effects']] == [name]
    for parameter, tolerance in tolerances.items():
        fitted = content['missing_effects'][0]['parameters'][parameter]
        assert fitted['value'] == pytest.approx(values[parameter], abs=tolerance)
    assert content['error_before']['chi2_per_dof'] > 10.0
    assert content['error_after']['chi2_per_dof'] < 2.5


@pytest.mark.machines
def test_declared_clock_refines_the_prediction_pulse_by_pulse():
    model = DeclaredModel(**{**vars(MODEL), 'keyphasor_rate': 2000.0})
    quantised = make_effects({'keyphasor_quantisation': {'clock_rate': 2000.0,
                                                         'period_std': 4e-6}})
    content = report(traced(*quantised, model=model, jitter=False))
    assert (content['verdict'], content['missing_effects']) == ('none', [])
    clock, = [item for item in content['declared_changes'] if item['parameter'] == 'clock_rate']
    assert (clock['name'], clock['declared']) == ('keyphasor_quantisation', None)
    assert clock['value'] == pytest.approx(2000.0, rel=1e-6)
    assert content['error_after'] == content['error_before']
    assert content['error_after']['rms'] < 0.2 * content['error_as_declared']['rms']
    assert 'clock_rate' in content['parameter_file']


@pytest.mark.machines
def test_interpolation_is_traced_by_its_beat():
    content = report(traced(*make_effects({'interpolation_loss': {'method': 'linear'}})))
    assert content['verdict'] == 'traced'
    assert [item['name'] for item in content['missing_effects']] == ['interpolation_loss']
    assert content['missing_effects'][0]['parameters']['method']['value'] == 'linear'
    assert content['error_after']['rms'] < 0.2 * content['error_before']['rms']


@pytest.mark.parametrize('method', ['linear', 'cubic', 'spline'])
def test_beat_tells_the_gain_of_the_interpolator(rng, method):
    frequency = np.array([0.08, 0.16, 0.24, 0.32])
    place = (0.0873 * np.arange(240)) % 1.0
    index = np.arange(64)
    waves = np.exp(2j * np.pi * np.outer(index, frequency))
    at = 31.0 + place
    read = interpolate(np.hstack((waves.real, waves.imag)), at, method=method)
    gain = np.real((read[:, :4] + 1j * read[:, 4:]) * np.exp(
        -2j * np.pi * np.outer(at, frequency)))
    mean = gain.mean(axis=0)
    found = find_beat(
        gain / mean - 1.0 + rng.normal(0.0, 2e-4, gain.shape), np.arange(240), 100.0 * frequency,
        frequency)
    assert found.method == method
    assert found.kept == pytest.approx(mean, abs=0.06 * (1.0 - mean.min()) + 1e-3)


def test_modulation_of_all_lines_alike_is_no_beat(rng):
    radial = 0.05 * np.cos(0.7 * np.arange(240))[:, None] + rng.normal(0.0, 1e-3, (240, 4))
    frequency = np.array([0.08, 0.16, 0.24, 0.32])
    for some in (radial, radial[:8]):
        assert find_beat(some, np.arange(len(some)), 100.0 * frequency, frequency).method == ''


@pytest.mark.machines
def test_effect_of_no_module_stays_unexplained():
    content = report(traced(Hum()))
    assert content['verdict'] == 'unexplained'
    assert content['missing_effects'] == []
    assert 'of the pulses' in content['remains']
    assert json.loads(json.dumps(content, allow_nan=False)) == content
    assert 'unexplained' in summary(content)


@pytest.mark.machines
def test_missing_pulses_hide_no_modulation():
    effects = make_effects({'amplitude_modulation': {'std': 0.2, 'bandwidth': 0.03},
                            'missing_pulses': {'probability': 0.015}})
    found = traced(*effects, acquisitions=12)
    assert {item.name for item in found.findings} == {'amplitude_modulation', 'missing_pulses'}


@pytest.mark.machines
def test_missing_pulses_leave_the_other_cycles_of_an_average_corrected():
    effects = make_effects({'speed_fluctuation': {'acceleration_std': 220.0},
                            'missing_pulses': {'probability': 0.015}})
    (found,), _ = observed(*effects, acquisitions=16)
    beside = [item for item in found.acquisitions if item.missing.any()]
    assert len(beside) > 2
    for item in beside:
        np.testing.assert_allclose(np.abs(item.corrected[0]), [1.0, 0.8, 0.6, 0.5], rtol=0.02)


@pytest.mark.machines
def test_torsion_is_a_speed_that_fluctuates():
    """The sidebands that it makes beside every line are bends of the speed."""
    order = 0.2
    found = traced(torsion=(Torsion(order, 0.03),), acquisitions=16)
    assert found.verdict == 'traced'
    effect, = (item.effect for item in found.findings)
    true = 0.03 * (2.0 * np.pi * order * SPEED) ** 2 / np.sqrt(2.0)
    assert effect.acceleration_std == pytest.approx(true, rel=0.1)


@pytest.mark.machines
def test_steady_torsion_that_averages_lose_by_is_unexplained():
    """No effect is as narrow as it; the limit of the speed holds it."""
    order = 0.3
    found = traced(torsion=(Torsion(order, 0.05),), acquisitions=14)
    assert found.verdict == 'unexplained'
    row, = (item for item in found.limits if item.name == 'speed_fluctuation')
    assert row.upper > 0.05 * (2.0 * np.pi * order * SPEED) ** 2 / np.sqrt(2.0)


@pytest.mark.machines
@pytest.mark.parametrize('effects', [
    {'clock_skew': {'skew': 4e-4}},
    {'interfering_tone': {'frequency': 400.9, 'amplitude': 0.12}},
    {'speed_fluctuation': {'acceleration_std': 90.0}}])
def test_declared_effect_is_not_missing(effects):
    assert traced(*make_effects(effects), declared=declared_effects(effects)).verdict == 'none'


@pytest.mark.machines
@pytest.mark.parametrize(('name', 'true', 'parameter', 'wrong'), [
    ('additive_noise', {'std': 1.0}, 'std', 0.5),
    ('interfering_tone', {'frequency': 400.9, 'amplitude': 0.12}, 'amplitude', 0.06),
])
def test_declared_effect_on_the_lines_of_another_size_is_named(name, true, parameter, wrong):
    content = report(traced(*make_effects({name: true}), declared=declared_effects(
        {name: {**true, parameter: wrong}})))
    assert content['verdict'] == 'traced'
    changed, = [item for item in content['declared_changes'] if item['parameter'] == parameter]
    assert (changed['name'], changed['declared']) == (name, wrong)
    assert f'lacks the right numbers of {name.replace("_", " ")}' in verdict_sentence(content)
    assert f'{name}: {parameter} = ' in summary(content)
    assert any(text.startswith(f'{parameter} = ') for _, text in findings(content))
    assert abs(changed['value'] - true[parameter]) < 4.0 * changed['standard_error']


@pytest.mark.machines
@pytest.mark.parametrize(('name', 'declared', 'size'), [
    ('additive_noise', {'std': 1.0}, 'std'),
    ('missing_pulses', {'probability': 0.03}, 'probability'),
    ('clock_skew', {'skew': 4e-4}, 'skew'),
    ('phase_wander', {'std': 0.01}, 'std'),
])
def test_declared_effect_that_is_not_there_is_named(name, declared, size):
    content = report(traced(declared=declared_effects({name: declared})))
    assert (content['verdict'], content['missing_effects']) == ('traced', [])
    changed, = [item for item in content['declared_changes'] if item['parameter'] == size]
    assert changed['name'] == name
    assert abs(changed['value']) < max(0.2 * declared[size], 3.0 * changed['standard_error'])


@pytest.mark.machines
def test_declared_clock_that_did_not_time_the_pulses_is_named():
    def of(rate):
        declared = declared_effects({'keyphasor_quantisation': {'clock_rate': rate}})
        return report(traced(declared=declared))

    content = of(2.93e3)
    assert (content['verdict'], content['missing_effects']) == ('traced', [])
    changed, = content['declared_changes']
    assert (changed['name'], changed['parameter']) == ('keyphasor_quantisation', 'clock_rate')
    assert changed['value'] > 100.0 * RATE
    assert content['error_after']['rms'] < 0.2 * content['error_before']['rms']
    assert of(changed['value'])['verdict'] == 'none'


@pytest.mark.machines
def test_declared_clock_of_another_rate_is_named_though_measured_pulses_tell_their_ticks():
    recording = with_slower_clock(simulated(jitter=False), 3.91e3)
    declared = declared_effects({'keyphasor_quantisation': {'clock_rate': 1.53e3}})
    content = report(trace([observe(recording, MODEL)], [recording], declared=declared))
    changed = {item['parameter']: item for item in content['declared_changes']}
    assert changed['clock_rate']['value'] == pytest.approx(3.91e3)


@pytest.mark.machines
def test_clock_on_whose_ticks_the_pulses_lie_is_named_if_a_slower_one_is_declared():
    recording = with_slower_clock(simulated(jitter=False), 3017.3)
    model = replace(MODEL, keyphasor_rate=2000.0)
    found = trace([observe(recording, model)], [recording])
    effect, = (item.effect for item in found.findings)
    assert effect.clock_rate == pytest.approx(3017.3)


@pytest.mark.machines
@pytest.mark.parametrize(('near', 'where'), [(1e-3, 'declared_changes'), (0.03, 'present')])
def test_declared_tone_that_is_not_there_is_named(near, where):
    tone = (1.0 + near) * MODEL.orders[0] * MODEL.fundamental_frequency
    declared = declared_effects({'interfering_tone': {'amplitude': 0.05, 'frequency': tone}})
    content = report(traced(declared=declared))
    found, = content[where]
    assert found['name'] == 'interfering_tone'
    assert content['missing_effects'] == []


@pytest.mark.machines
def test_tone_beyond_its_limit_is_found(plain):
    limit, = [row.effect for row in plain.limits if row.name == 'interfering_tone']
    place = 8.0 + np.random.default_rng(4).uniform(0.1, 7.9)
    tone = {'amplitude': 1.2 * limit.amplitude, 'frequency': place * SPEED}
    found = traced(*make_effects({'interfering_tone': tone})).evidence.lines.tone
    assert found.frequency == pytest.approx(tone['frequency'], rel=1e-4)


@pytest.mark.machines
def test_declared_interpolator_that_no_beat_shows_is_taken_for_as_declared(monkeypatch):
    monkeypatch.undo()
    declared = declared_effects({'interpolation_loss': {'method': 'linear'}})
    content = report(traced(declared=declared))
    assert content['verdict'] == 'none'
    assert 'interpolation_loss' in content['undecided']


@pytest.mark.machines
def test_measured_gearbox_needs_the_phases_of_its_pulses(shared_data):
    whole = read(shared_data / 'gear0_gearbox.npz')
    half = 0.5 * whole.duration
    recording = with_slower_clock(replace(
        whole, vibration=ArraySource(whole.read()[:2, :whole.samples // 2]), channel_names=(),
        units=(), pulse_times=whole.keyphasor_pulses(duration=half),
        reference_pulse_times=None), 3300.0)
    model = DeclaredModel(keyphasor_rate=3300.0, trigger_speed=33.33, trigger_cycles=40,
                          orders=(23.0, 46.0, 69.0, 92.0, 115.0))
    content = report(trace([observe(recording, model)], [recording]))
    changes = {item['parameter']: item['value'] for item in content['declared_changes']}
    assert changes['clock_rate'] == pytest.approx(3300.0, rel=1e-6)
    assert changes['noise_std'] > 0.0
    assert content['error_as_declared']['rms'] > 0.1
    assert content['error_after']['rms'] < 0.015


@pytest.mark.machines
@pytest.mark.parametrize('name', ['motor_10V_100kHz.npz', 'uia_bearing_rig_1.npz'])
def test_recording_that_hides_its_pulse_errors_says_what_it_cannot_exclude(
        shared_data, monkeypatch, name):
    recording = read(shared_data / name)
    motor = name.startswith('motor')
    if motor:
        monkeypatch.undo()
    model = DeclaredModel(
        keyphasor_rate=1e5 if motor else 1024.0, trigger_speed=19.6 if motor else 4.19,
        trigger_cycles=5 if motor else 10, pulses_per_revolution=8 if motor else 1,
        orders=(12.0, 16.0, 18.0) if motor else (1.0, 2.0, 3.0))
    content = report(trace([observe(recording, model)], [recording]))
    upper = {item['name']: item['upper_95'] for item in content['limits']}
    assert upper['clock_skew'] > 0.0  # the timing is known, if badly
    if motor:
        assert content['error_before']['rms'] is None
        assert content['verdict'] == 'none'
        assert upper['additive_noise'] is None  # there is no line
        assert {'additive_noise', 'amplitude_modulation'} <= set(content['undecided'])
    else:  # no error of a single pulse shows, but bends do, and noise, of which none is declared
        assert content['error_after']['rms'] < 1e-3
        assert content['missing_effects'] == []
        assert 'noise_std' in [item['parameter'] for item in content['declared_changes']]
        assert 0.0 < upper['amplitude_modulation'] < 1.0
    assert 0.0 < upper['missing_pulses'] < 0.2  # which the pulse times show


@pytest.mark.machines
@pytest.mark.parametrize(('day', 'skew', 'orders', 'share'), [
    (20130331, 1.4e-4, (40.0,), 0.5), (20130405, 0.0, (20.0, 40.0), 0.5)])
def test_turbine_whose_lines_come_and_go_has_no_limit_of_what_they_do_not_hold(
        shared_data, day, skew, orders, share):
    whole = read(shared_data / f'turbine_{day}.npz')
    times = whole.keyphasor_pulses(duration=share * whole.duration)
    vibration = ArraySource(whole.read()[:, :int(share * whole.samples)])
    recording = replace(whole, vibration=vibration, tach=None, tach_rate=None,
                        pulse_times=times + skew * (times - times[0]), reference_pulse_times=None)
    model = DeclaredModel(keyphasor_rate=3.125e6, trigger_speed=30.0, trigger_cycles=10,
                          pulses_per_revolution=2, orders=orders)
    content = report(trace([observe(recording, model)], [recording]))
    unsteady = any(item['scatter'] > 0.07 for item in content['unsteady_lines'])
    assert (content['verdict'] == 'unexplained') == unsteady
    found = {item['name'] for item in content['missing_effects']}
    assert found <= {'interfering_tone', 'additive_noise'}  # of noise none is declared
    upper = {item['name']: item['upper_95'] for item in content['limits']}
    assert upper['clock_skew'] is None or upper['clock_skew'] > skew
    if day == 20130405:
        # what the lines scatter by shows all the same, unless none can be compared
        untested = {item['name']: item['reason'] for item in content['not_testable']}
        for name in ('additive_noise', 'amplitude_modulation'):
            assert name in found or (upper[name] or 0.0) > 0.0 or (
                untested[name].startswith('no line is compared'))


@pytest.mark.machines
def test_noise_that_hides_the_pulse_errors_is_found():
    """No attenuation can be compared where single errors do not show; the noise is seen."""
    recording = simulated(AdditiveNoise(1.5), jitter=False)
    # averages of more than 20 cycles, which are predicted without draws, are quicker
    model = replace(MODEL, keyphasor_rate=1e6, noise_std=0.5, trigger_cycles=25)
    content = report(trace([observe(recording, model)], [recording]))
    assert content['error_before']['rms'] is None
    assert 'no line is compared' in ' '.join(content['remarks'])
    assert verdict_sentence(content).startswith('Lines and pulse times show additive noise;')
    effect, = content['missing_effects']
    assert effect['name'] == 'additive_noise'
    std = effect['parameters']['std']
    assert std['value'] == pytest.approx(np.sqrt(1.5**2 - 0.5**2), abs=3.5 * std['standard_error'])


@pytest.mark.machines
def test_pulse_times_alone_show_lost_pulses(rng, tmp_path):
    whole = noise_alone(rng)
    recording = replace(whole, pulse_times=np.delete(whole.pulse_times, [20, 41, 42, 77]))
    found = trace([observe(recording, MODEL)], [recording])
    content = report(found)
    assert content['verdict'] == 'traced'
    effect, = content['missing_effects']
    assert effect['name'] == 'missing_pulses'
    assert effect['parameters']['probability']['value'] == pytest.approx(
        4.0 / (whole.pulse_times.size - 1))
    assert content['error_after']['rms'] is None
    assert 'missing_pulses' in summary(content)
    html = report_files(found, content)['report.html'].decode()
    assert 'The pulse times alone show missing pulses' in html
    # noise holds no line that a drift would move
    upper = {item['name']: item['upper_95'] for item in content['limits']}
    assert upper['clock_skew'] is None


def test_residual_of_what_is_predicted_is_chance(rng):
    shape = (30, 6)
    draws = rng.normal(0.9, 0.02, shape)
    predicted = np.full(shape, 0.9)
    variance = np.full(shape, 4e-4)
    probability = stats.norm.cdf(draws, 0.9, 0.02)

    def of(shift):
        return residual(draws + shift, predicted, variance, draws + shift, predicted, variance,
                        probability)

    right, wrong = of(0.0), of(0.03)
    assert not right.significant
    assert right.chi2_per_dof == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / draws.size))
    assert right.ks < 1.63 / np.sqrt(draws.size)
    assert right.coverage == pytest.approx(0.95, abs=4.0 * np.sqrt(0.05 * 0.95 / draws.size))
    assert wrong.rms == pytest.approx(0.03, abs=4.0 * 0.02 / np.sqrt(30))
    assert wrong.significant
    assert wrong.p_value < 1e-3
    assert wrong.score < right.score


def test_p_value_is_even_whatever_lines_have_in_common(rng):
    """Lines share the errors of the pulses, and scatter by what the prediction says."""
    values = []
    for _ in range(300):
        count, lines = int(rng.integers(4, 15)), int(rng.integers(1, 9))
        scale = rng.uniform(1e-3, 0.05, lines)
        own = rng.uniform(0.0, 1.0)
        shared = rng.standard_normal((count, 1))
        z = np.sqrt(own) * rng.standard_normal((count, lines)) + np.sqrt(1.0 - own) * shared
        predicted, variance = np.full(z.shape, 0.9), np.broadcast_to(scale**2, z.shape)
        draws = predicted + scale * z
        values.append(residual(draws, predicted, variance, draws, predicted, variance,
                               stats.norm.cdf(z)).p_value)
    assert stats.kstest(values, 'uniform').pvalue > 0.01
    one = residual(*(np.ones((1, 3)) for _ in range(7)))
    assert np.isnan(one.p_value)


def test_added_jitter_and_slower_clock_make_the_old_pulses_the_reference():
    recording = simulated(acquisitions=4)
    worse = with_added_jitter(recording, Normal(1e-4), seed=1)
    assert worse.reference_pulse_times is recording.pulse_times
    added = worse.pulse_times - recording.pulse_times
    assert added.std() == pytest.approx(1e-4, rel=4.0 / np.sqrt(2.0 * added.size))
    slower = with_slower_clock(recording, 1000.0)
    ticks = slower.pulse_times * 1000.0
    assert ticks == pytest.approx(np.rint(ticks), abs=1e-6)
    late = slower.pulse_times - recording.pulse_times
    assert late.min() >= -1e-9
    assert late.max() <= 1e-3
    with pytest.raises(ModelError, match='positive rate'):
        with_slower_clock(recording, 0.0)


@pytest.mark.parametrize('count', [0, 1])
def test_reference_without_pulses_is_refused(count):
    recording = replace(simulated(acquisitions=2), reference_pulse_times=1.0 + np.zeros(count))
    with pytest.raises(RecordingError, match='valid reference_pulse_times, at least 3 are needed'):
        record_pulses(recording, MODEL)


def test_missing_pulses_are_counted():
    every = 0.3 + np.arange(60) * 0.04
    lost = [10, 20, 21, 31, 32, 33, 34, 35]
    found = record_pulses(Recording(ArraySource(np.zeros((1, 15_000))), RATE,
                                    pulse_times=np.delete(every, lost)), MODEL)
    assert np.flatnonzero(found.missing).tolist() == [9, 18, 27]
    assert found.missing[[9, 18, 27]].tolist() == [1, 2, 5]
    # three in a row are put in, more are a gap that no acquisition may hold
    assert found.bridged[:31] == pytest.approx(every[:31], abs=1e-12)
    assert np.isnan(found.bridged[31:36]).all()
    assert np.flatnonzero(found.starts_run).tolist() == [0, 28]
    assert found.remarks == ('3 pulses are missing between the 52 that were measured',
                             '1 of 52 pulses are late: the gap before them is not a whole number '
                             'of intervals, or longer than three missing pulses; no acquisition '
                             'contains such a gap')


def changed(**values):
    """Return the model with some values changed."""
    return DeclaredModel(**{**vars(MODEL), **values})


@pytest.mark.parametrize(('model', 'error', 'text'), [
    (changed(trigger_speed=50.0), ModelError, 'turns at 25'),
    (changed(sample_rate=9000.0), ModelError, 'sample_rate is declared'),
    (changed(trigger_cycles=500), RecordingError, 'lower trigger_cycles'),
])
def test_model_that_does_not_fit_is_refused(model, error, text):
    recording = simulated(acquisitions=5)
    with pytest.raises(error, match=text):
        trace([observe(recording, model)], [recording])


def test_no_pulses_are_refused():
    bare = Recording(simulated(acquisitions=2).vibration, RATE)
    with pytest.raises(RecordingError, match='no keyphasor'):
        record_pulses(bare, MODEL)


def noise_alone(rng):
    """Return a recording whose vibration is noise."""
    machine = simulated(acquisitions=5)
    return Recording(ArraySource(rng.normal(size=(2, machine.samples))), RATE,
                     pulse_times=machine.pulse_times)


def silent(recording, *channels):
    """Return a recording some channels of which are constant."""
    samples = recording.read().copy()
    samples[list(channels)] = 0.3
    return replace(recording, vibration=ArraySource(samples))


@pytest.mark.machines
def test_a_dead_channel_changes_nothing():
    recording = silent(simulated(acquisitions=8), 1)
    found = trace([observe(recording, MODEL)], [recording])
    assert found.verdict == 'none'
    assert set(found.lines.channel.tolist()) == {0}


@pytest.mark.machines
@pytest.mark.parametrize(('made', 'model', 'reason'), [
    (lambda rng: simulated(acquisitions=2), MODEL, '2 acquisitions of 20 trigger cycles'),
    (lambda rng: simulated(acquisitions=8), changed(orders=(11.3, 17.7)),
     'the vibration holds no declared order'),
    (lambda rng: silent(simulated(acquisitions=5), 0, 1), MODEL, 'holds no declared order'),
    (noise_alone, MODEL, 'holds no declared order')])
def test_where_nothing_can_be_compared_the_report_says_why(made, model, reason, rng, tmp_path):
    recording = made(rng)
    found = trace([observe(recording, model)], [recording])
    content = report(found)
    assert content['verdict'] == 'none'
    assert content['lines'] == content['missing_effects'] == []
    assert content['error_before']['rms'] is None
    assert reason in content['remarks'][-1]
    assert reason in summary(content)
    files = report_files(found, content)
    assert set(files) == {'report.json', 'report.html'}
    assert b'nothing could have been seen' in files['report.html']
    remedy = content['remarks'][-1].rpartition('; ')[2]
    assert next_steps(content) == [f'{remedy[0].upper()}{remedy[1:]}.']


def test_pulses_that_are_not_resolved_may_have_all_errors_that_are_declared(rng):
    found = observe(noise_alone(rng), MODEL)
    assert not found.compared
    assert np.all(found.stacked('errors') == 0.0)
    assert found.stacked('standard_errors') == pytest.approx(
        np.sqrt(MODEL.distribution.variance), rel=1e-9)
    assert found.stacked('attenuation') == pytest.approx(1.0, abs=1e-3)


def test_recordings_of_different_machines_are_refused():
    one = simulated(acquisitions=4)
    louder = Recording(ArraySource(20.0 * one.read()), RATE, pulse_times=one.pulse_times)
    observed = [observe(one, MODEL), observe(louder, MODEL)]
    with pytest.raises(ModelError, match='different machines'):
        trace(observed, [one, louder])


PARAMETERS = """
{node}:
  ros__parameters:
    keyphasor_rate: 5e3
    trigger_speed: 25
    trigger_cycles: 20
    orders: [8, 16.0, 24, 32]
    noise_std: 0.05
    effects:
      excess_jitter: {{enabled: true, std: 5e-6}}
    effects.clock_skew.enabled: false
    pinoin: 3.0
"""


@pytest.mark.parametrize('node', ['jitter_predictor', '/**', '/jitter_predictor',
                                  '/plant/jitter_predictor', 'plant:\n  jitter_predictor'])
def test_parameter_files_are_read_as_ros_reads_them(tmp_path, node):
    text = PARAMETERS.format(node=node)
    if '\n' in node:
        head, _, rest = text.partition('jitter_predictor:')
        text = head + 'jitter_predictor:' + rest.replace('\n', '\n  ')
    path = tmp_path / 'model.yaml'
    path.write_text(text)
    found = read_declaration(path, sample_rate=RATE)
    assert found.model == MODEL
    assert found.effects == (make_effect('excess_jitter', std=5e-6),)
    assert found.unknown == ('pinoin',)


@pytest.mark.parametrize(('text', 'reason'), [
    ('other_node: {ros__parameters: {ratio: 1.0}}', 'no ros__parameters of jitter_predictor'),
    ('/**: {ros__parameters: {ratio: fast}}', "ratio is 'fast'"),
    ('/**: {ros__parameters: {orders: 3}}', 'give a list'),
    ('/**: {ros__parameters: {trigger_cycles: 2.5}}', 'whole number'),
    ('/**: {ros__parameters: {keyphasor_rate: -1.0}}', 'keyphasor_rate is -1'),
    ('/**: {ros__parameters: {effects.clock_skew.enabled: 1}}', 'true or false'),
    ('/**: {ros__parameters: {effects: {clock_skew: {enabled: true, skew: 2}}}}', 'at most 0.1'),
    ('!!python/object/apply:os.system [true]', 'cannot be read as YAML'),
    ('{', 'cannot be read as YAML'),
    ('just text', 'no ros__parameters'),
])
def test_bad_parameter_files_are_refused(tmp_path, text, reason):
    path = tmp_path / 'model.yaml'
    path.write_text(text)
    with pytest.raises(ModelError, match=reason):
        read_declaration(path)


def saved(folder, recording):
    """Save a recording as a file, and its declared model."""
    np.savez(folder / 'machine.npz', vibration=recording.read(), sample_rate=RATE,
             pulse_times=recording.pulse_times)
    (folder / 'model.yaml').write_text(PARAMETERS.format(node='/**').replace('true', 'false'))
    return [str(folder / 'machine.npz'), '--declared', str(folder / 'model.yaml'), '--output',
            str(folder / 'out')]


@pytest.mark.machines
@pytest.mark.usefixtures('undrawn')
def test_command_writes_the_report(tmp_path, capsys):
    arguments = saved(tmp_path, simulated(*make_effects({'clock_skew': {'skew': 4e-4}}),
                                          acquisitions=8))
    assert main(arguments) == 0
    printed = capsys.readouterr()
    assert 'missing effect: clock_skew' in printed.out
    assert 'no such parameters: ' in printed.err
    content = json.loads((tmp_path / 'out' / 'report.json').read_text())
    assert content['verdict'] == 'traced'
    assert content['probabilities']['clock_skew'] > 0.9
    skew = content['missing_effects'][0]['parameters']['skew']
    assert abs(skew['value'] - 4e-4) < 4.0 * skew['standard_error'] < 4e-5
    assert content['declared']['trigger_cycles'] == CYCLES
    assert (tmp_path / 'out' / 'report.html').exists()
    assert not [path for path in (tmp_path / 'out').iterdir() if path.name.startswith('.')]


def test_command_refuses_in_one_line_and_writes_nothing(tmp_path, capsys):
    recording = simulated(acquisitions=2)
    arguments = saved(tmp_path, replace(recording, pulse_times=recording.pulse_times[:10]))
    assert main([*arguments, '--quiet']) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert 'lower trigger_cycles or record longer' in lines[-1]
    assert not (tmp_path / 'out').exists()
    assert main([str(tmp_path / 'none.npz'), *arguments[1:], '--quiet']) == 2
    assert 'no such file' in capsys.readouterr().err
