# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
What the loop decides on machines whose truth is known: the judge, the list, and some of its rows.

All rows are run by `python benchmarks/decisions.py run --output FILE`.
"""

from dataclasses import replace
import json
import math

from decision_damages import DAMAGES
from decision_independent import DAMAGED
import decision_judge
from decision_judge import Answer, decision, distance, Expected, judge, mcnemar, TICKS
from decision_machines import groups, rows
from decision_outside import Absent
import decisions
from decisions import published
import numpy as np
import pytest

#: Quick rows that are right, of every source that needs nothing from outside, and some that do;
#: most single effects on a plain gear are those of test_inference_loop.py.
QUICK = (
    'own switching 0', 'damaged faster 0', 'damaged other_ratio 0', 'damaged strays 0',
    'damaged no_shaft 0', 'damaged two_pulses 0', 'damaged louder 0', 'damaged short_reference 0',
    'foreign none heli 0', 'foreign clock_skew 0', 'measured motor, 30 V: excess_jitter 0')


def report(verdict='none', names=(), **others):
    """Return a made-up report that names effects (name -> parameter -> value, error)."""
    errors = {'rms': 0.01, 'rms_standard_error': 0.001, 'p_value': None}
    return {'verdict': verdict, 'missing_effects': [
        {'name': name, 'evidence': 'pulses show it', 'indistinguishable_from': [], 'parameters': {
            key: {'value': value, 'standard_error': error}
            for key, (value, error) in parameters.items()}}
        for name, parameters in dict(names).items()],
        'present': [], 'limits': [], 'declared_changes': [], 'remarks': [], 'remains': '',
        'against': 'vibration', 'error_before': dict(errors), 'error_after': dict(errors),
        **others}


def judged(content, text='', **expected):
    """Return what the judge says of a report."""
    return judge(Answer(content, text), Expected(**expected))


SKEW = {'verdicts': ('traced',), 'effects': (frozenset({'clock_skew'}),),
        'sizes': {'clock_skew.skew': 1e-4}}


def test_the_judge_wants_verdict_names_and_sizes():
    assert judged(report()).right
    assert judged(report('traced', {'clock_skew': {'skew': (1.02e-4, 1e-6)}}), **SKEW).right
    far = judged(report('traced', {'clock_skew': {'skew': (1.04e-4, 1e-6)}}), **SKEW)
    assert (far.right, far.outcome) == (False, 'near')
    assert 'clock_skew.skew' in far.why[0]
    assert judged(report('unexplained'), **SKEW).outcome == 'unexplained'
    assert judged(report(), **SKEW).outcome == 'missed'
    other = report('traced', {'path_delay': {'delay': (1e-3, 1e-5)}})
    assert judged(other, **SKEW).outcome == 'other'
    assert judged(report('none', {'clock_skew': {'skew': (1e-4, 1e-6)}}), **SKEW).outcome == 'near'


def test_a_name_that_is_said_to_look_the_same_is_right():
    found = report('traced', {'path_delay': {}})
    assert not judged(found, **SKEW).right
    found['missing_effects'][0]['indistinguishable_from'] = ['clock_skew']
    assert judged(found, **SKEW).right


def test_an_effect_that_changes_nothing_may_be_present():
    found = report(present=[{'name': 'clock_skew', 'parameters': {
        'skew': {'value': 1e-4, 'standard_error': 1e-6}}}])
    assert judged(found, **SKEW).right
    found['present'][0]['parameters']['skew']['value'] = 2e-4
    assert not judged(found, **SKEW).right


def test_a_limit_must_cover_the_truth():
    limit = {'name': 'clock_skew', 'parameter': 'skew', 'upper_95': 2e-5, 'lower_95': None}
    covered = {'covered': {'clock_skew.skew': -1e-5}}
    assert judged(report(limits=[limit]), **covered).right
    assert not judged(report(limits=[{**limit, 'upper_95': 0.5e-5}]), **covered).right
    assert not judged(report(), **covered).right


def test_declared_changes_hold_noise_and_ticks():
    noise = {'name': 'noise', 'parameter': 'noise_std', 'value': 0.2, 'standard_error': 0.01}
    wanted = {'changes': {'noise.noise_std': 0.21, TICKS: math.nan}}
    clock = {'name': 'keyphasor_quantisation', 'parameter': 'clock_rate', 'value': 5e3}
    assert judged(report(declared_changes=[noise, clock]), **wanted).right
    assert not judged(report(declared_changes=[noise]), **wanted).right
    assert not judged(report(declared_changes=[{**noise, 'value': 0.25}, clock]), **wanted).right


def test_steps_of_the_clock_and_unsteady_lines_are_looked_for():
    wanted = {'verdicts': ('unexplained',), 'steps': ((9.0, -4e-4),), 'cycle': 0.05,
              'unsteady': ((23.0, 'outer'),)}
    step = {'time': 9.08, 'step': -3.9e-4, 'standard_error': 1e-5, 'period': None}
    aliased = {**step, 'step': 6.1e-4, 'period': 1e-3}
    line = {'order': 23.0, 'channel': 'outer', 'scatter': 0.1}
    assert judged(report('unexplained', clock_steps=[step], unsteady_lines=[line]), **wanted).right
    assert judged(report('unexplained', clock_steps=[aliased], unsteady_lines=[line]),
                  **wanted).right
    for change in ({'clock_steps': []}, {'clock_steps': [{**step, 'time': 9.2}]},
                   {'clock_steps': [{**aliased, 'period': None}]},
                   {'unsteady_lines': [{**line, 'channel': 'inner'}]}):
        found = judged({**report('unexplained', clock_steps=[step], unsteady_lines=[line]),
                        **change}, **wanted)
        assert found.outcome == 'near'
    assert not judged(report(clock_steps=[step])).right


def test_nothing_compared_is_not_testable():
    found = report(not_testable=[{'name': 'clock_skew', 'reason': 'no line'}])
    found['error_after']['rms'] = None
    assert judged(found, untested=True).right
    assert not judged({**found, 'not_testable': []}, untested=True).right


def test_words_are_compared():
    assert not judged(report(), 'a tone in Hz', never=('A tone',)).right
    assert not judged(report(), said=('a clock',)).right
    both = 'Predictions then hold for this machine.\nDo not rely on predictions.'
    assert not judged(report(), both).right


def test_an_effect_with_which_averages_are_predicted_worse_is_wrong():
    found = report('traced', {'clock_skew': {'skew': (1e-4, 1e-6)}})
    found['error_after']['rms'] = 0.0119
    assert judged(found, **SKEW).right
    found['error_after']['rms'] = 0.0121
    assert judged(found, **SKEW).outcome == 'near'


def test_errors_and_crashes():
    assert judge(Answer(error='speed is 3'), Expected(error='speed is')).right
    assert judge(Answer(error='speed is 3'), Expected()).outcome == 'failed'
    assert judge(Answer(report()), Expected(error='speed is')).outcome == 'failed'
    assert judge(Answer(crash='Traceback\nKeyError: 1'), Expected()).why == ('KeyError: 1',)


def test_marks_count_from_any_of_them(rng):
    marks = rng.standard_normal(6)
    assert distance(np.roll(marks, 2) + 0.3, [0.1] * 6, marks) == pytest.approx(0.0, abs=1e-6)
    assert distance(np.roll(marks, 2) + 0.3 * rng.standard_normal(6), [0.01] * 6, marks) > 3.0
    assert distance('linear', None, 'linear') == 0.0
    assert distance('cubic', None, 'linear') == math.inf


@pytest.mark.machines
@pytest.mark.parametrize('marks', [2, 4])
def test_marks_are_as_far_off_as_their_errors_say(rng, marks):
    """Angles count from their mean, whose error theirs have in common."""
    off = rng.standard_normal((2000, marks))
    error = math.sqrt(1.0 - 1.0 / marks)
    found = np.array([decision_judge._list_distance(
        row - row.mean(), np.full(marks, error)) for row in off])
    for most, share in ((1.0, 0.683), (2.0, 0.954)):
        assert np.mean(found < most) == pytest.approx(share, abs=4.0 * math.sqrt(
            share * (1.0 - share) / len(off)))


@pytest.mark.parametrize(('better', 'worse', 'p'), [
    (0, 0, 1.0), (0, 5, 2 * 0.5**5), (1, 9, 2 * 11 * 0.5**10), (4, 4, 1.0)])
def test_mcnemar_is_the_binomial_test_of_the_pairs_that_differ(better, worse, p):
    assert mcnemar(better, worse) == pytest.approx(p)


def test_results_are_json_whatever_the_truth_is(rng):
    marks = rng.standard_normal(4)
    found = judged(report('traced', {'target_geometry': {'pulse_angles': (
        list(marks), [0.1] * 4)}}), verdicts=('traced',), effects=(
            frozenset({'target_geometry'}),), sizes={'target_geometry.pulse_angles': marks})
    assert found.right
    assert json.loads(json.dumps(found.sizes))['target_geometry.pulse_angles'][3] < 1e-6


def test_a_decision_is_what_was_decided():
    row = {'right': True, 'verdict': 'traced', 'effects': ['b', 'a'],
           'sizes': {'a.std': [1.0, 0.1, 1.1, 1.0]}, 'seconds': 1.0}
    assert decision(row)['sizes'] == {'a.std': True}
    assert decision(row) == decision({**row, 'effects': ['a', 'b'], 'seconds': 2.0})
    assert decision(row) != decision({**row, 'sizes': {'a.std': [1.0, 0.1, 1.5, 5.0]}})
    assert decision(row) != decision({**row, 'verdict': 'unexplained'})


# --- the list ------------------------------------------------------------------------------------

def test_names_of_rows_are_unique():
    names = [row.name for row in rows()]
    assert len(set(names)) == len(names) > 250
    assert set(QUICK) <= set(names)


def test_half_of_every_class_is_reserved_on_seeds_of_its_own():
    for group in groups():
        found = [group.row(index) for index in range(group.count)]
        assert [row.reserved for row in found] == [False, True] * (group.count // 2)
        seeds = [[row.seed for row in (group.row(index) for index in range(200))
                  if row.reserved == reserved] for reserved in (False, True)]
        assert max(seeds[0]) < 1_000_000 <= min(seeds[1])
        assert all(len(set(half)) == len(half) for half in seeds)


def test_more_rows_of_every_class_can_be_drawn():
    more = rows(6)
    assert len(more) == 6 * len(groups())
    assert {row.name for row in more} >= {row.name for row in rows() if row.name.endswith(' 1')}


def test_every_damage_is_a_class():
    assert DAMAGES.keys() == DAMAGED.keys()


@pytest.mark.machines
@pytest.mark.parametrize('name', ['correct 0', 'damaged faster 0'])
def test_a_row_is_the_same_whenever_it_is_drawn(name):
    row, = (item for item in rows() if item.name == name)
    first, second = row.draw(), row.draw()
    assert first.declared == second.declared
    for one, other in zip(first.recordings, second.recordings, strict=True):
        assert one.keys() == other.keys()
        for key in one:
            np.testing.assert_array_equal(one[key], other[key])


@pytest.mark.parametrize(('name', 'words'), [
    ('foreign none heli 0', 'no simulator'), ('measured bearing rig: none 0', 'no measured')])
def test_a_row_whose_data_are_absent_is_skipped_visibly(
        name, words, monkeypatch, tmp_path, capsys):
    for variable in ('SA_JITTER_MACHINES', 'SA_JITTER_DATA'):
        monkeypatch.setenv(variable, str(tmp_path / 'nowhere'))
    output = tmp_path / 'results.jsonl'
    assert decisions.main(['run', '--only', name, '--output', str(output)]) == 0
    assert f'{name}: skipped, {words}' in capsys.readouterr().err
    assert output.read_text() == ''


def test_two_files_of_results_are_compared(tmp_path, capsys):
    row = {'name': 'a 0', 'class': 'a', 'source': 's', 'reserved': False, 'right': True,
           'outcome': 'right', 'why': [], 'verdict': 'none', 'effects': [], 'present': [],
           'p_value': None}
    wrong = {**row, 'right': False, 'outcome': 'missed', 'why': ['verdict none']}
    for name, lines in (('one', [row, {**wrong, 'name': 'a 1', 'reserved': True}]),
                        ('two', [row, {**row, 'name': 'a 1', 'reserved': True}])):
        (tmp_path / name).write_text(''.join(json.dumps(line) + '\n' for line in lines))
    assert decisions.main(['compare', str(tmp_path / 'one'), str(tmp_path / 'two')]) == 0
    printed = capsys.readouterr().out
    assert '| a | 2 | 1, 2 | 1 | 0 | 1 |' in printed
    assert '* a 1: none (verdict none) -> none' in printed
    decisions.main(['table', '--by', 'verdict', str(tmp_path / 'one')])
    assert '| none | 1, 1 | 1, 0 |' in capsys.readouterr().out
    decisions.main(['table', str(tmp_path / 'one')])
    assert '| a | 1, 1 | 1, 0 | 0, 0 | 0, 0 | 0, 1 | 0, 0 | 0, 0 |' in capsys.readouterr().out


@pytest.mark.machines
def test_a_worker_answers_as_this_process_does(tmp_path):
    row, = (item for item in rows() if item.name == 'damaged faster 0')
    worker = decisions.Worker(decisions.PUBLISHED.parents[1])
    try:
        found, other = decisions.result(row, worker), decisions.result(row)
    finally:
        worker.close()
    assert {**found, 'seconds': 0.0} == {**other, 'seconds': 0.0}


@pytest.mark.machines
def test_a_crash_is_an_answer(tmp_path):
    row, = (item for item in rows() if item.name == 'damaged faster 0')
    worker = decisions.Worker(tmp_path)  # which holds no package
    (tmp_path / 'sa_jitter_ros').mkdir()
    (tmp_path / 'sa_jitter_ros' / '__init__.py').write_text('1 / 0\n')
    try:
        found = decisions.result(row, worker)
    finally:
        worker.close()
    assert (found['outcome'], found['why']) == (
        'failed', ['ZeroDivisionError: division by zero'])


@pytest.mark.machines
@pytest.mark.parametrize('name', QUICK)
def test_a_row_that_is_published_as_right_is_right(name):
    row, = (item for item in rows() if item.name == name)
    assert published()[name]['right']
    try:
        drawn = row.draw()
    except Absent as reason:
        pytest.skip(str(reason))
    found = decisions.result(replace(row, draw=lambda: drawn))
    assert found['why'] == []
    assert (found['verdict'], found['effects']) == (
        published()[name]['verdict'], published()[name]['effects'])
