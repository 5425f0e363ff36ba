# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The files of a report: figures with their contents, and a self-contained page."""

import base64
from dataclasses import replace
from html.parser import HTMLParser
import io
import json

from matplotlib.image import imread
import numpy as np
import pytest
from sa_jitter_ros.declaration import read_declaration
from sa_jitter_ros.effects import EFFECTS
from sa_jitter_ros.inference.observation import observe
from sa_jitter_ros.inference.trace import trace
from sa_jitter_ros.number_text import measured_text, percent_text
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.recordings.recording import ArraySource, Recording
from sa_jitter_ros.report.figures import illustrate
from sa_jitter_ros.report.html_report import html, report_files
from sa_jitter_ros.report.plotting import arrange
from sa_jitter_ros.report.report import report
from sa_jitter_ros.report.words import findings, next_steps, order_shares, verdict_sentence
from sa_jitter_ros.simulation import (AdditiveNoise, band_limited, DeclaredJitter, Gearbox,
                                      make_effects, mesh)

pytestmark = pytest.mark.machines
RATIO, SPEED, RATE, CLOCK = 183 / 76, 25.0, 8192.0, 20000.0
NAMES = {'residual', 'distribution', 'pulse_errors', 'trigger_cycle', 'amplitudes'}
MODEL = DeclaredModel(keyphasor_rate=CLOCK, trigger_speed=SPEED, trigger_cycles=20,
                      orders=(19.0, 38.0), ratio=RATIO, noise_std=0.05, sample_rate=RATE)


def traced(marks=1, **effects):
    """Return the trace of a simulated machine with these undeclared effects."""
    # a target of some marks that turns as much slower
    model = replace(MODEL, pulses_per_revolution=marks, pulses_per_trigger=1,
                    trigger_speed=SPEED / marks, ratio=RATIO * marks)
    machine = Gearbox(
        mesh('shaft', 19, harmonics=(1.0, 0.6), channel_gains=(1.0, 0.7), seed=3), RATE,
        shafts={'shaft': RATIO}, speed=((0.0, SPEED),), seed=1,
        fluctuation=band_limited(std=2e-4, band=(0.1, 2.0), seed=1, name='speed'),
        effects=(DeclaredJitter('uniform', 1.0 / (CLOCK * np.sqrt(12.0))), AdditiveNoise(0.05),
                 *make_effects(effects)))
    seconds = 6.0
    recording = Recording(
        ArraySource(machine.vibration(0, int(seconds * RATE))), RATE, ratio=model.ratio,
        pulse_times=machine.pulses(0.0, seconds).times, channel_names=('<left>', 'right & top'))
    return trace([observe(recording, model)], [recording])


@pytest.fixture(scope='module')
def traces(all_unasked):
    """Yield traces of each verdict."""
    found = {'none': traced(), 'traced': traced(excess_jitter={'std': 5e-5}),
             'geometry': traced(3, target_geometry={'pulse_angles': (0.0, 0.006, -0.004)}),
             'grid': traced(keyphasor_quantisation={'clock_rate': 4000.0, 'period_std': 2e-5})}
    found['unexplained'] = replace(found['traced'], findings=(), remains='a drift',
                                   after=found['traced'].before,
                                   prediction_after=found['traced'].prediction_before)
    found['blind'] = replace(found['unexplained'], evidence=None)
    yield found
    DRAWN.clear()


@pytest.fixture(scope='module')
def files(traces):
    """Return the files of some reports."""
    return {verdict: report_files(
        traces[verdict], report(traces[verdict], recordings=['a<b>.npz']))
            for verdict in ('traced', 'blind')}


class Page(HTMLParser):
    """The tags, links and text of a page."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.links, self.text, self.open = [], [], '', []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.links += [value for name, value in attributes if name in ('src', 'href')]
        if tag not in ('br', 'meta', 'img'):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data.replace('\u00a0', ' ')  # numbers that stay with their units


@pytest.mark.parametrize('verdict', ['traced', 'blind'])
def test_page_is_complete_and_self_contained(files, verdict):
    found = files[verdict]
    names = NAMES if verdict != 'blind' else {'residual', 'distribution'}
    assert found.keys() == {'report.json', 'report.html', *(f'{name}.png' for name in names)}
    content = json.loads(found['report.json'])
    page = Page(found['report.html'].decode())
    assert 'script' not in page.tags
    assert 'link' not in page.tags
    assert len(page.links) == len(names)
    for link in page.links:
        head, data = link.split(',', 1)
        assert head == 'data:image/png;base64'
        assert base64.b64decode(data, validate=True) in found.values()
    assert verdict_sentence(content) in page.text
    for shown in ('a<b>.npz', '<left>', 'right & top',
                  *(item['rejected_because'] for item in content['candidates'])):
        assert shown in page.text
    for effect in content['missing_effects']:
        assert effect['evidence'] in page.text


def test_page_begins_with_what_was_analysed_found_and_to_be_done(traces):
    content = report(traces['traced'], recordings=['rigs/a<b>.npz'], unit='m/s^2',
                     created='2026-11-22T23:41:38+00:00')
    text = Page(html(content, (), {})).text
    parts = [
        'a<b>.npz', 'Analysed 2026-11-22 23:41:38 UTC with sa_jitter_ros',
        verdict_sentence(content), 'What was found', *next(findings(content)),
        'What it does to the amplitudes', 'What to do next', *next_steps(content),
        content['parameter_file'], 'Evidence']
    places = [text.index(part) for part in parts]
    assert places == sorted(places)
    assert 'rigs/' not in text[:places[-1]]


@pytest.mark.parametrize('verdict', ['none', 'traced', 'unexplained'])
def test_each_order_has_its_share_of_the_amplitude(traces, verdict):
    content = report(traces[verdict])
    shares = order_shares(content)
    assert [item['order'] for item in shares] == [19.0, 38.0]
    for share in shares:
        lines = [item for item in content['lines'] if item['order'] == share['order']]
        assert len(lines) == 2  # channels
        assert share['observed'] == np.mean([item['observed'] for item in lines])
        assert share['predicted_before'] == np.mean([item['predicted_before'] for item in lines])
    page = html(content, (), {}).replace('\u00a0', ' ')
    for share in shares:
        assert f'>{percent_text(share["observed"], share["standard_error"])}<' in page
    assert ('<th>as found</th>' in page.partition('What to do next')[0]) == (verdict == 'traced')


def test_orders_have_the_names_of_the_parts_that_make_them(traces):
    names = {19.0: 'mesh in-out 1x', 38.0: 'mesh in-out 2x'}
    trace = replace(traces['blind'], observation=replace(
        traces['blind'].observation, name_of=names.get))
    content = report(trace)
    assert content['order_names'] == [*names.values()]
    assert {item['name'] for item in content['lines']} == {*names.values()}
    text = html(content, (), {})
    assert 'orders mesh in-out 1x (19), mesh in-out 2x (38)' in text
    assert '<td data-label="order">mesh in-out 2x (38)</td>' in text
    assert any('of mesh in-out 2x (38). Take corrected' in step for step in next_steps(content))
    residual, distribution = illustrate(trace)
    assert residual.figure.axes[-1].get_xticklabels()[1].get_text() == 'mesh in-out 2x (38)'
    assert distribution.figure.axes[0].get_title() == 'mesh in-out 1x (19), <left>'


def test_steps_follow_from_what_was_found(traces):
    content = report(traces['traced'])
    steps = ' '.join(next_steps(content))
    assert steps.startswith('Paste the section below')
    assert EFFECTS['excess_jitter'].remedy in steps
    lost = min(order_shares(content), key=lambda item: item['observed'])
    assert ('correct_jitter: true' in steps) == (lost['observed'] < 0.95)
    doubtful = {**content['missing_effects'][0], 'indistinguishable_from': ['phase_wander'],
                'deciding_measurement': 'a run-up'}
    changed = {**content, 'missing_effects': [doubtful], 'undecided': ['clock_skew']}
    steps = ' '.join(next_steps(changed))
    assert 'To tell excess_jitter from phase_wander, take a run-up.' in steps
    assert 'cannot exclude clock_skew' in steps
    assert 'Do not rely' in ' '.join(next_steps(report(traces['unexplained'])))
    steady = {**report(traces['none']), 'undecided': []}
    assert 'Nothing: predictions' in ' '.join(next_steps(steady)) or any(
        item['observed'] < 0.95 for item in order_shares(steady))


@pytest.mark.parametrize('shaft', ['shaft', 'input'])
@pytest.mark.parametrize('verdict', ['traced', 'geometry', 'grid'])
def test_section_to_paste_declares_what_was_found(traces, verdict, shaft, tmp_path):
    trace = traces[verdict]
    content = report(trace, shaft=shaft)
    path = tmp_path / 'machine.yaml'
    path.write_text(content['parameter_file'])
    declaration = read_declaration(path)
    assert declaration.unknown == ()
    (name, model), = declaration.models.items()
    assert name == shaft
    wanted = trace.observation.model
    assert replace(model, ratio=wanted.ratio, trigger_speed=wanted.trigger_speed) == wanted
    np.testing.assert_allclose((model.ratio, model.trigger_speed), (
        wanted.ratio, trace.observation.declared_speed), rtol=1e-9)
    assert len(declaration.effects) == len(trace.findings)
    for item in trace.findings:
        effect, = [one for one in declaration.effects if one.name == item.name]
        for key, value in item.effect.values.items():
            np.testing.assert_allclose(effect.values[key], value, rtol=1e-5)
    # declared with it, it is no longer new
    again = report(replace(trace, declared=declaration.effects), shaft=shaft)['parameter_file']
    assert '# new' in content['parameter_file']
    assert '# new' not in again
    assert '# was' in again


def test_nothing_is_pasted_where_nothing_was_found(traces):
    assert report(traces['none'])['parameter_file'] == ''


@pytest.mark.parametrize('verdict', ['traced', 'blind'])
def test_nothing_runs_over_the_edge_of_a_picture(files, verdict):
    for name, data in files[verdict].items():
        if name.endswith('.png'):
            picture = imread(io.BytesIO(data))
            assert (picture[[0, -1]] == 1.0).all(), name
            assert (picture[:, [0, -1]] == 1.0).all(), name


def test_many_effects_leave_room_in_the_panels(traces):
    (effect,) = traces['traced'].findings
    axes = panel(replace(traces['traced'], findings=(effect, effect, effect)), 'pulse_errors',
                 'autocorrelation')
    assert 'with 3 effects' in axes.get_legend_handles_labels()[1]


@pytest.mark.parametrize('verdict', ['none', 'traced', 'geometry', 'grid'])
def test_panels_are_labelled(traces, verdict):
    figures = drawn(traces[verdict])
    assert {item.name for item in figures} == NAMES
    for item in figures:
        arrange(item.figure)
        for axes in item.figure.axes:
            assert axes.get_ylabel(), item.name
            assert axes.get_title() or item.name == 'residual'
            _, labels = axes.get_legend_handles_labels()
            assert len(labels) < 2 or axes.get_legend() is not None
        assert item.figure.axes[-1].get_xlabel()


def test_sentence_contains_effect_and_errors(traces):
    content = report(traces['traced'])
    before, after = content['error_before'], content['error_after']
    assert verdict_sentence(content) == (
        'The declared model lacks excess jitter. With it the prediction misses the measured '
        f'amplitudes by {percent_text(after["rms"], after["rms_standard_error"])} instead of '
        f'{percent_text(before["rms"], before["rms_standard_error"])}.')
    (effect,) = content['missing_effects']
    std = effect['parameters']['std']
    (meaning, found), = findings(content)
    assert meaning.startswith('Pulses come early or late')
    assert found.startswith('excess_jitter: std = '
                            + measured_text(std['value'], std['standard_error'], 's'))
    assert ' µs.' in found
    doubtful = {**effect, 'indistinguishable_from': ['phase_wander']}
    (_, found), = findings({**content, 'missing_effects': [doubtful]})
    assert found.endswith('It may also be phase_wander: these data do not tell them apart.')


@pytest.mark.parametrize(('verdict', 'says'), [
    ('none', 'The declared model suffices'),
    ('unexplained', 'none of the known effects explains it')])
def test_sentence_of_other_verdicts(traces, verdict, says):
    assert says in verdict_sentence(report(traces[verdict]))


def test_sentence_names_effects_that_do_not_suffice(traces):
    content = report(replace(traces['traced'], remains='a drift'))
    assert 'even with excess jitter the prediction' in verdict_sentence(content)


def test_what_remains_is_a_sentence_of_its_own(traces):
    content = {**report(traces['unexplained']), 'remains': 'a sinusoid'}
    assert verdict_sentence(content).endswith('explains it. What remains: a sinusoid.')
    content = {**report(traces['unexplained']), 'remains': '', 'undecided': ['clock_skew']}
    assert verdict_sentence(content).endswith('explains it.')
    assert 'cannot exclude' not in ' '.join(next_steps(content))  # nothing is excluded


def test_effect_that_does_not_help_the_prediction_is_not_said_to(traces):
    content = report(traces['traced'])
    content = {**content, 'error_after': {**content['error_after'], 'rms': 2.0 * content[
        'error_before']['rms']}}
    assert 'does not predict the amplitudes better with it' in verdict_sentence(content)
    assert next_steps(content)[0].endswith('here predictions are no better with it.')


def test_undefined_numbers_are_dashes(traces):
    trace = traces['none']
    content = report(replace(trace, before=replace(trace.before, ks=float('nan'))))
    assert content['error_before']['ks'] is None
    assert '<td data-label="before">–</td>' in html(content, (), {})


def curve(axes, label):
    """Return x and y of a labelled line."""
    (line,) = [item for item in axes.lines if item.get_label() == label]
    return np.array(line.get_data(), dtype=float)


DRAWN = []  # traces with their figures


def drawn(trace):
    """Return the figures of a trace, which are made once."""
    for known, figures in DRAWN:
        if known is trace:
            return figures
    DRAWN.append((trace, illustrate(trace)))
    return DRAWN[-1][1]


def panel(trace, name, title):
    """Return the axes with a title, or part of one, of one figure."""
    (figure,) = [item.figure for item in drawn(trace) if item.name == name]
    (axes,) = [item for item in figure.axes if title in item.get_title()]
    return axes


def test_expected_profile_is_that_of_the_declared_jitter(traces):
    # the linear law halves the variance in the middle: (1-u)^2 + u^2
    u, size = curve(panel(traces['none'], 'trigger_cycle', 'over the trigger cycle'),
                    'declared model')
    np.testing.assert_allclose(
        size, 1e6 / (CLOCK * np.sqrt(12.0)) * np.sqrt((1.0 - u) ** 2 + u**2), rtol=1e-3)


def test_recovered_errors_follow_the_traced_effect(traces):
    trace = traces['traced']
    label = 'with excess_jitter'
    axes = panel(trace, 'trigger_cycle', 'over the trigger cycle')
    with_effect, recovered = curve(axes, label)[1], curve(axes, 'recovered')[1]
    # the RMS of n normal errors is known to 1/sqrt(2n)
    np.testing.assert_allclose(
        recovered, with_effect, rtol=4.0 / np.sqrt(2.0 * trace.evidence.errors.size))
    assert (recovered > 2.0 * curve(axes, 'declared model')[1]).all()


def test_declared_effects_belong_to_the_declared_model(traces):
    trace = traces['grid']
    (clock,) = trace.findings
    declared = replace(
        trace, findings=(), evidence=replace(
            trace.evidence, explained=(clock.effect,), errors=trace.evidence.errors - np.array(
                [item.errors - item.errors.mean() for item in trace.evidence.pulses])))
    for case, label in ((trace, 'with keyphasor_quantisation'), (declared, 'declared model')):
        axes = panel(case, 'trigger_cycle', 'over the trigger cycle')
        np.testing.assert_allclose(curve(axes, 'recovered')[1], curve(axes, label)[1], rtol=0.1)


def test_target_is_folded_by_its_period(traces):
    trace = traces['geometry']
    period = len(trace.findings[0].effect.pulse_angles)
    assert period == 3
    axes = panel(trace, 'trigger_cycle', f'folded by {period} pulses')
    truth = 1e6 * np.resize([0.0, 0.006, -0.004], period) / (2.0 * np.pi * SPEED)
    known = curve(axes, 'with target_geometry')[1]
    # the marks' place in the record is arbitrary: the first trigger pulse need not be mark 0
    gaps = [np.abs(known - known.mean() - np.roll(truth - truth.mean(), k)).max()
            for k in range(3)]
    assert min(gaps) < 5e6 / (CLOCK * np.sqrt(12.0)) / np.sqrt(trace.evidence.errors.size / period)


def test_lattice_panel_names_the_clock_of_the_pulse_times(traces):
    axes = panel(traces['grid'], 'pulse_errors', 'clock of the pulse times, 4000 Hz')
    imposed, recovered = axes.lines[0].get_data()
    assert np.corrcoef(imposed, recovered)[0, 1] > 0.99
    assert panel(traces['none'], 'pulse_errors', f'declared clock, {CLOCK:g} Hz')


def test_lines_have_the_names_of_their_channels(traces):
    axes = panel(traces['none'], 'amplitudes', 'cycle by cycle')
    labels = axes.get_legend_handles_labels()[1]
    assert {label.split(', ')[1] for label in labels} == {'<left>', 'right & top'}


def test_fold_counts_missing_pulses(traces):
    trace = traces['geometry']
    first, *rest = trace.evidence.pulses
    # after pulse 7 of the first acquisition one pulse is missing: the marks shift by one
    missing = np.where(np.arange(len(first.times) - 1) == 6, 1, 0)
    gap = replace(trace, evidence=replace(trace.evidence, pulses=(
        replace(first, missing=missing), *rest)))
    whole, shifted = (curve(panel(item, 'trigger_cycle', 'folded by 3 pulses'),
                            'with target_geometry')[1] for item in (trace, gap))
    np.testing.assert_allclose(shifted, whole, atol=1.0)  # us, each pattern has mean 0
