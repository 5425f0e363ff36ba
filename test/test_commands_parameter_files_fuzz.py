# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Random parameter files: commands read them or end with one line, and execute nothing."""

from dataclasses import replace

from hypothesis import example, given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from sa_jitter_ros.commands import close_loop
from sa_jitter_ros.declaration import predictor_parameters, read_declaration
from sa_jitter_ros.errors import ModelError, ParameterError
from sa_jitter_ros.parameter_file import read_parameters
import yaml

HEAD = 'jitter_predictor:\n  ros__parameters:\n    '
NAMES = [
    'shafts', 'shaft.ratio', 'shaft.orders',
    *(item.name for item in predictor_parameters())]
SCALARS = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=9), st.dates(),
    st.binary(max_size=4), st.sampled_from([10**400, -1, 0, '5e-6', 'linear', 'uniform', 'table']))
VALUES = st.one_of(SCALARS, st.lists(SCALARS, max_size=4),
                   st.dictionaries(SCALARS, SCALARS, max_size=2))
KEYS = st.one_of(st.sampled_from(['/**', '*', 'jitter_predictor', '/rig/jitter_predictor', 'rig',
                                  'ros__parameters', 'effects']), st.text(max_size=5))
DOCUMENTS = st.recursive(VALUES, lambda inner: st.dictionaries(KEYS, inner, max_size=4),
                         max_leaves=12)


def refusal(path):
    """Read a declaration; return the message with which it was refused, '' if it was not."""
    try:
        read_declaration(path)
    except ModelError as error:
        return str(error)
    return ''


def check(folder, text):
    """Assert that a text is read or refused in one line that can be read."""
    path = folder / 'model.yaml'
    path.write_text(text, encoding='utf-8', errors='surrogatepass')
    message = refusal(path)
    assert '\n' not in message
    assert len(message) < 500 + len(str(path))
    assert not message or message.startswith(str(path))


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """Return a folder for files that are written over and over."""
    return tmp_path_factory.mktemp('models')


@settings(max_examples=120)
@given(st.dictionaries(st.sampled_from(NAMES), VALUES, max_size=3))
@example({'keyphasor_rate': 10**400})
@example({'effects.excess_jitter.enabled': True, 'effects.excess_jitter.std': [1.0]})
@example({'effects.target_geometry.enabled': True, 'effects.target_geometry.pulse_angles': 1})
def test_any_values_of_the_parameters(folder, values):
    enabled = {name.rpartition('.')[0] + '.enabled': True for name in values if '.' in name}
    check(folder, yaml.safe_dump({'/**': {'ros__parameters': {**enabled, **values}}}))


@settings(max_examples=80)
@given(DOCUMENTS)
def test_any_document(folder, document):
    check(folder, yaml.safe_dump(document))


@settings(max_examples=80)
@given(st.text(alphabet='ab:-[]{}&*!|>?#"\'%@,\n 1.e', max_size=60))
def test_any_text(folder, text):
    check(folder, text)
    check(folder, HEAD + text)


LAUGHS = 'a: &a [lol, lol]\n' + ''.join(
    f'{new}: &{new} [{", ".join([f"*{old}"] * 9)}]\n'
    for old, new in zip('abcdefghi', 'bcdefghij'))
HOSTILE = {
    'billion laughs': (LAUGHS + HEAD + 'orders: *j', 'line 2: YAML aliases are not supported'),
    'merge keys': ('a: &a {x: 1}\nb: {<<: [*a, *a]}\n', 'aliases are not supported'),
    'endless': ('jitter_predictor:\n  ros__parameters: &a\n    x: *a\n',
                'aliases are not supported'),
    'deep lists': (HEAD + 'orders: ' + '[' * 100_000, 'nested deeper than 20 levels'),
    'deep maps': (HEAD + 'a: ' + '{a: ' * 300 + '1' + '}' * 300, 'nested deeper than 20 levels'),
    'object': (HEAD + 'orders: !!python/object/apply:os.system [touch ran]', 'constructor'),
    'module': (HEAD + 'orders: !!python/module:os', 'constructor'),
    'digits': (HEAD + 'keyphasor_rate: ' + '9' * 5000, 'integer string conversion'),
    'large': (HEAD + 'keyphasor_rate: ' + '9' * 400, 'keyphasor_rate is 999'),
    'large count': (HEAD + 'trigger_cycles: ' + '9' * 400, 'trigger_cycles is 999'),
    'many cycles': (HEAD + 'trigger_cycles: 1000001', 'give at most 1000000'),
    'tiny ratio': (HEAD + 'ratio: 1e-300', 'ratio is 1e-300: give at least 0.001'),
    'date': (HEAD + 'keyphasor_rate: 2001-99-99', 'month must be in'),
    'empty integer': (HEAD + 'keyphasor_rate: !!int ""', 'cannot be read as YAML'),
    'no time': (HEAD + 'keyphasor_rate: !!timestamp now', 'cannot be read as YAML'),
    'no boolean': (HEAD + 'keyphasor_rate: !!bool maybe', 'cannot be read as YAML'),
    'nan': (HEAD + 'keyphasor_rate: .nan', 'keyphasor_rate is nan'),
    'infinity': (HEAD + 'trigger_speed: .inf', 'trigger_speed is inf Hz: give a finite number'),
    'another node': ('tach_detector:\n  ros__parameters: {x: 1}', 'no ros__parameters of jitter'),
    'no map': ('jitter_predictor:\n  ros__parameters: 3', 'no ros__parameters of jitter'),
    'two documents': ('a: 1\n---\nb: 2', 'another document'),
    'long': ('#' * (1 << 20) + '\n', 'too many for a parameter file'),
    'no text': ('\0\1', 'control characters|special characters'),
}


@pytest.mark.parametrize('name', HOSTILE)
def test_hostile_documents(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    text, says = HOSTILE[name]
    (tmp_path / 'model.yaml').write_text(text)
    with pytest.raises(ModelError, match=says):
        read_declaration(tmp_path / 'model.yaml')
    check(tmp_path, text)
    assert [item.name for item in tmp_path.iterdir()] == ['model.yaml']


def test_the_last_section_wins_and_names_are_joined(tmp_path):
    path = tmp_path / 'model.yaml'
    path.write_text('/**:\n  ros__parameters: {a: 1, b: {c: 2}}\n'
                    'rig:\n  node:\n    ros__parameters: {a: 3, "two\\nlines": 4}\n'
                    'other:\n  ros__parameters: {a: 5}\n')
    assert read_parameters(path, 'node') == {'a': 3, 'b.c': 2, 'two lines': 4}


@pytest.mark.parametrize('make', [lambda path: None, lambda path: path.mkdir()])
def test_path_that_is_no_file(tmp_path, make):
    path = tmp_path / 'model.yaml'
    make(path)
    with pytest.raises(ParameterError, match=r'model\.yaml: (No such file|Is a directory)'):
        read_parameters(path, 'node')


SHAFTS = """
    trigger_cycles: 30
    shafts: [input, output]
    input: {ratio: 2.40789, orders: [19.0, 38]}
    output.ratio: 0.4137
    effects: {clock_skew: {enabled: true, skew: 1e-4}}
"""


def test_several_shafts_are_as_many_models(tmp_path):
    path = tmp_path / 'model.yaml'
    path.write_text(HEAD + SHAFTS)
    found = read_declaration(path, sample_rate=2e4)
    assert list(found.models) == ['input', 'output']
    first, second = found.models.values()
    assert (first.ratio, first.orders) == (2.40789, (19.0, 38.0))
    assert (second.ratio, second.orders) == (0.4137, (1.0, 2.0, 3.0))
    assert replace(second, ratio=first.ratio, orders=first.orders) == first
    assert (first.trigger_cycles, first.sample_rate) == (30, 2e4)
    assert [effect.name for effect in found.effects] == ['clock_skew']
    assert found.unknown == ()
    with pytest.raises(ModelError, match='shafts input, output are declared: one shaft is needed'):
        assert found.model is None


@pytest.mark.parametrize('lines', [
    '{ratio: 2.0, orders: [4.0]}', '{shafts: [a], ratio: 2.0, orders: [4.0]}',
    '{shafts: [a], a.ratio: 2.0, a.orders: [4.0]}', '{shaft.ratio: 2.0, shaft: {orders: [4]}}'])
def test_one_shaft_may_have_its_name_before_its_parameters(tmp_path, lines):
    path = tmp_path / 'model.yaml'
    path.write_text(f'/**: {{ros__parameters: {lines}}}')
    found = read_declaration(path)
    assert (found.model.ratio, found.model.orders) == (2.0, (4.0,))
    assert found.unknown == ()


@pytest.mark.parametrize(('lines', 'says'), [
    ('{shafts: [a, b], ratio: 2.0}',
     'ratio is given together with the shafts a, b: give a.ratio, b.ratio and leave out ratio'),
    ('{shafts: [a, b], a.ratio: 2.0, orders: [1.0]}',
     'orders is given together with the shafts a, b'),
    ('{shaft.ratio: 2.0, ratio: 2.0}',
     'ratio is given together with the shafts shaft: give shaft.ratio'),
    ('{shafts: [a, a]}', "shafts is 'a', 'a': give different names"),
    ('{shafts: []}', 'shafts is : give different names'),
    ('{shafts: [A]}', "shafts is 'A'"),
    ('{shafts: a}', "shafts is 'a': give a list of texts"),
])
def test_shafts_declared_in_both_forms_or_without_names_are_refused(tmp_path, lines, says):
    path = tmp_path / 'model.yaml'
    path.write_text(f'/**: {{ros__parameters: {lines}}}')
    with pytest.raises(ModelError, match=says):
        read_declaration(path)


def test_parameter_of_no_shaft_is_unknown(tmp_path):
    path = tmp_path / 'model.yaml'
    path.write_text('/**: {ros__parameters: {shafts: [a, b], c.ratio: 2.0, use_sim_time: true}}')
    assert read_declaration(path).unknown == ('c.ratio',)


@pytest.mark.parametrize('name', ['billion laughs', 'object', 'large', 'deep lists'])
def test_the_command_says_it_in_one_line_and_writes_nothing(tmp_path, capfd, name):
    recording, model = tmp_path / 'rig.npz', tmp_path / 'model.yaml'
    np.savez(recording, vibration=np.ones((1, 100)), sample_rate=100.0,
             pulse_times=np.linspace(0.0, 1.0, 11))
    model.write_text(HOSTILE[name][0])
    assert close_loop.main([str(recording), '--declared', str(model), '--quiet', '--output',
                            str(tmp_path / 'report')]) == 2
    assert capfd.readouterr().err.count('\n') == 1
    assert not (tmp_path / 'report').exists()
