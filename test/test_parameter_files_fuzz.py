"""Whatever is in a parameter file, the command ends with one line, and nothing of it is run."""

from hypothesis import example, given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from sa_jitter_ros.commands import close_loop
from sa_jitter_ros.commands.declaration import _INTEGERS, _RATIOS, read_declaration
from sa_jitter_ros.commands.parameter_file import read_parameters
from sa_jitter_ros.effects import EFFECTS, parameter_ranges
from sa_jitter_ros.errors import ModelError, ParameterError
import yaml

HEAD = 'jitter_predictor:\n  ros__parameters:\n    '
NAMES = [
    'keyphasor_rate', 'trigger_speed', 'trigger_cycles', 'orders', 'ratio', 'jitter_table',
    'pulses_per_revolution', 'pulses_per_trigger', 'jitter_distribution', 'jitter_std',
    'noise_std', 'sample_rate', *(f'effects.{name}.{key}' for name, kind in EFFECTS.items()
                                  for key in ('enabled', *parameter_ranges(kind)))]
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


@settings(max_examples=300)
@given(st.dictionaries(st.sampled_from(NAMES), VALUES, max_size=3))
@example({'keyphasor_rate': 10**400})
@example({'effects.excess_jitter.enabled': True, 'effects.excess_jitter.std': [1.0]})
@example({'effects.target_geometry.enabled': True, 'effects.target_geometry.pulse_angles': 1})
def test_any_values_of_the_parameters(folder, values):
    enabled = {name.rpartition('.')[0] + '.enabled': True for name in values if '.' in name}
    check(folder, yaml.safe_dump({'/**': {'ros__parameters': {**enabled, **values}}}))


@settings(max_examples=200)
@given(DOCUMENTS)
def test_any_document(folder, document):
    check(folder, yaml.safe_dump(document))


@settings(max_examples=200)
@given(st.text(alphabet='ab:-[]{}&*!|>?#"\'%@,\n 1.e', max_size=60))
def test_any_text(folder, text):
    check(folder, text)
    check(folder, HEAD + text)


LAUGHS = 'a: &a [lol, lol]\n' + ''.join(
    f'{new}: &{new} [{", ".join([f"*{old}"] * 9)}]\n'
    for old, new in zip('abcdefghi', 'bcdefghij'))
HOSTILE = {
    'billion laughs': (LAUGHS + HEAD + 'orders: *j', 'line 2: aliases are not read'),
    'merge keys': ('a: &a {x: 1}\nb: {<<: [*a, *a]}\n', 'aliases are not read'),
    'endless': ('jitter_predictor:\n  ros__parameters: &a\n    x: *a\n', 'aliases are not read'),
    'deep lists': (HEAD + 'orders: ' + '[' * 100_000, 'nested deeper than 20 levels'),
    'deep maps': (HEAD + 'a: ' + '{a: ' * 300 + '1' + '}' * 300, 'nested deeper than 20 levels'),
    'object': (HEAD + 'orders: !!python/object/apply:os.system [touch ran]', 'constructor'),
    'module': (HEAD + 'orders: !!python/module:os', 'constructor'),
    'digits': (HEAD + 'keyphasor_rate: ' + '9' * 5000, 'integer string conversion'),
    'large': (HEAD + 'keyphasor_rate: ' + '9' * 400, 'keyphasor_rate: give -1e.15 to 1e.15'),
    'large count': (HEAD + 'trigger_cycles: ' + '9' * 400, 'trigger_cycles is 999'),
    'many cycles': (HEAD + 'trigger_cycles: 1000001', 'give at most 1000000'),
    'tiny ratio': (HEAD + 'ratio: 1e-300', 'ratio: give 0.001 to 1000, not 1e-300'),
    'date': (HEAD + 'keyphasor_rate: 2001-99-99', 'month must be in'),
    'empty integer': (HEAD + 'keyphasor_rate: !!int ""', 'cannot be read as YAML'),
    'no time': (HEAD + 'keyphasor_rate: !!timestamp now', 'cannot be read as YAML'),
    'no boolean': (HEAD + 'keyphasor_rate: !!bool maybe', 'cannot be read as YAML'),
    'nan': (HEAD + 'keyphasor_rate: .nan', 'keyphasor_rate is nan'),
    'infinity': (HEAD + 'trigger_speed: .inf', 'trigger_speed: give .* not inf'),
    'another node': ('tach_detector:\n  ros__parameters: {x: 1}', 'no ros__parameters of jitter'),
    'no map': ('jitter_predictor:\n  ros__parameters: 3', 'no ros__parameters of jitter'),
    'two documents': ('a: 1\n---\nb: 2', 'another document'),
    'long': ('#' * (1 << 20) + '\n', 'is no parameter file'),
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
def test_what_is_no_file(tmp_path, make):
    path = tmp_path / 'model.yaml'
    make(path)
    with pytest.raises(ParameterError, match='cannot be read as YAML'):
        read_parameters(path, 'node')


def test_ranges_are_those_of_the_nodes():
    predictor = pytest.importorskip('sa_jitter_ros.nodes.jitter_predictor')
    limits = {item.name: item.maximum for item in predictor.PARAMETERS}
    assert {name: limits[name] for name in _INTEGERS} == _INTEGERS
    averager = pytest.importorskip('sa_jitter_ros.nodes.averager_parameters')
    assert averager.RATIOS == _RATIOS


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
