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
What the documents say: commands and names exist, Python runs and prints what is printed.

Python blocks of a document run in one namespace and one folder; a `text` block behind one is what
it prints. A first line `# NAME` saves a block in that folder. Commands of this package are taken
as far as one process can: nodes are constructed with the parameters given, tables are printed.
What cannot be run says so above the block, `<!-- not run: REASON -->`, and is skipped with it.

`python test/test_docs.py` writes docs/parameters.md, the list of all parameters, and the figures
that Python blocks draw.
"""

from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.util import find_spec
import io
from itertools import pairwise
import json
import os
from pathlib import Path
import re
import shlex
from shutil import copyfile
import subprocess
import sys
import tempfile

from matplotlib.figure import Figure
from matplotlib.image import imread
import numpy as np
import pytest
from rclpy.context import Context
from rclpy.parameter import Parameter
from sa_jitter_ros.averaging.indicators import INDICATORS
from sa_jitter_ros.commands import chain, design
from sa_jitter_ros.effects import EFFECTS
from sa_jitter_ros.nodes import messages
from sa_jitter_ros.nodes.base import DIAGNOSTIC_KEYS
from sa_jitter_ros.nodes.tach_detector import JOINT_TYPE
from sa_jitter_ros.pulses.sampled_angle import AngleState
from sa_jitter_ros.recordings.fields import FIELDS
from scipy.io import wavfile
from std_msgs.msg import String
import yaml

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = (ROOT / 'README.md', *sorted((ROOT / 'docs').glob('*.md')))


def scripts(kind):
    """Return the names of the nodes or commands that setup.py installs."""
    found = re.search(rf'(?s){kind} = \((.*?)\)', (ROOT / 'setup.py').read_text(encoding='utf-8'))
    return re.findall(r"'(\w+)'", found[1])


NODES = {name: getattr(import_module(f'sa_jitter_ros.nodes.{name}'),
                       name.title().replace('_', '')) for name in scripts('NODES')}
COMMANDS = {name: import_module(f'sa_jitter_ros.commands.{name}') for name in scripts('COMMANDS')}
# Values that a node cannot do without.
NEEDED = {'recording_player': ['-p', 'recording:=rig.npz']}
PYTHONS = ('python', 'python3', '.venv/bin/python')
OTHERS = {'.', 'cd', 'colcon', 'export', 'pip'}
PROGRAMS = {'./run', 'ros2', *PYTHONS, *OTHERS, *NODES, *COMMANDS}
STAR = r'\*'
SHARE = '$(ros2 pkg prefix --share sa_jitter_ros)'


# --- blocks --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Block:
    """A fenced or indented block; `reason` says why it is not run, `name` where it is saved."""

    document: Path
    line: int
    language: str
    text: str
    reason: str = ''

    @property
    def name(self):
        found = re.match(r'# ([\w.]+\.(?:py|yaml))\n', self.text)
        return found[1] if found else ''

    @property
    def place(self):
        return f'{self.document.name}:{self.line}'


def blocks_of(document):
    """Iterate over the blocks of a document."""
    lines = document.read_text(encoding='utf-8').splitlines()
    reason, at = '', 0
    while at < len(lines):
        line, start = lines[at], at + 1
        fence = re.fullmatch(r' *```(\w*)', line)
        if fence:
            end = next(i for i in range(start, len(lines)) if lines[i].strip() == '```')
            body, at = lines[start:end], end + 1
        elif line.startswith('    ') and (at == 0 or not lines[at - 1].strip()):
            end = next((i for i in range(at, len(lines))
                        if lines[i].strip() and not lines[i].startswith('    ')), len(lines))
            body, at = [item[4:] for item in lines[at:end]], end
        else:
            found = re.fullmatch(r'<!-- not run: (.+) -->', line)
            reason = found[1] if found else reason if not line.strip() else ''
            at += 1
            continue
        indent = len(fence[0]) - len(fence[0].lstrip()) if fence else 0
        text = ''.join(f'{item[indent:]}\n' for item in body).strip('\n') + '\n'
        yield Block(document, start, fence[1] if fence else language_of(text), text, reason)
        reason = ''


def language_of(text):
    """Return what an indented block is: commands, a session with `$ ` before commands, or not."""
    if text.startswith('$ '):
        return 'session'
    return 'bash' if text.split()[0] in PROGRAMS else 'formula'


BLOCKS = [block for document in DOCUMENTS for block in blocks_of(document)]
SHOWN = {block: after.text for block, after in pairwise(BLOCKS)
         if after.language == 'text' and after.document == block.document}
SHOWN |= {block: re.sub(r'(?m)^\$ .*\n', '', block.text) for block in BLOCKS
          if block.language == 'session'}


# --- a folder where a document's blocks have been run --------------------------------------------


@contextmanager
def inside(folder):
    """Work in a folder from which modules can be imported."""
    before, path = Path.cwd(), list(sys.path)
    os.chdir(folder)
    sys.path.insert(0, str(folder))
    try:
        yield
    finally:
        os.chdir(before)
        sys.path[:] = path


@cache
def _base():
    return tempfile.TemporaryDirectory(prefix='sa_jitter_ros_docs_')


@cache
def folder_of(document):
    """Return a folder with a reader's recordings and the files that the document makes."""
    folder = Path(_base().name) / document.stem
    folder.mkdir()
    pulses = np.arange(20) / 20.0
    vibration = np.random.default_rng(1).normal(size=(2, 1000))
    np.savez(folder / 'rig.npz', vibration=vibration, sample_rate=1000.0, pulse_times=pulses)
    channels = np.stack((*vibration, np.arange(1000) % 50 < 10), axis=1)
    wavfile.write(folder / 'rig.wav', 1000, channels.astype(np.float32))
    for block in BLOCKS:
        if block.document == document and block.name:
            (folder / block.name).write_text(block.text)
    return folder


@cache
def namespace_of(document):
    return {'__name__': 'document'}


def run_python(block):
    """Run a block, or by pytest the tests that it holds; return what it prints."""
    folder = folder_of(block.document)
    if block.name.startswith('test_'):
        done = subprocess.run(
            [sys.executable, '-m', 'pytest', '-p', 'no:cacheprovider', block.name], cwd=folder,
            env={**os.environ, 'PYTHONPATH': str(ROOT)}, capture_output=True, text=True,
            check=False)
        assert done.returncode == 0, done.stdout
        return ''
    with inside(folder), redirect_stdout(io.StringIO()) as printed:
        exec(compile(block.text, block.place, 'exec'), namespace_of(block.document))
    return printed.getvalue()


PYTHON = [block for block in BLOCKS if block.language == 'python']
LONG = {'adding_an_effect.md', 'tacholess.md'}  # trace whole machines
FIGURES = [(block.document, name) for block in PYTHON
           for name in re.findall(r"savefig\('([\w.-]+)'", block.text)]


@pytest.mark.parametrize('document', [
    pytest.param(item, id=item.name, marks=[pytest.mark.machines] * (item.name in LONG))
    for item in DOCUMENTS if any(block.document == item for block in PYTHON)])
def test_python_runs_and_prints_what_the_document_shows(document):
    for block in PYTHON:
        if block.document == document and not block.reason:
            assert stripped(run_python(block)) == stripped(SHOWN.get(block, '')), block.place


@pytest.mark.parametrize(('document', 'name'), FIGURES)
def test_figure_is_the_one_that_the_document_draws(document, name):
    drawn = folder_of(document) / name
    if not drawn.exists():
        draw(document)
    assert f'figures/{name})' in document.read_text(encoding='utf-8')
    made, held = imread(drawn), imread(ROOT / 'docs' / 'figures' / name)
    assert made.shape == held.shape, 'run: python test/test_docs.py'
    # versions of matplotlib place a line of text or a tick a pixel apart
    assert np.abs(made - held).mean() < 0.01, 'run: python test/test_docs.py'


def draw(document):
    """Run the Python of a document up to its last figure."""
    blocks = [block for block in PYTHON if block.document == document and not block.reason]
    last = max(i for i, block in enumerate(blocks) if 'savefig(' in block.text)
    for block in blocks[:last + 1]:
        run_python(block)


def stripped(text):
    """Return the lines of a text without space at their ends."""
    return [line.rstrip() for line in text.strip('\n').splitlines()]


@pytest.mark.parametrize('block', [block for block in BLOCKS if block.reason],
                         ids=lambda block: block.place)
def test_block_that_cannot_be_run(block):
    pytest.skip(f'{block.place} cannot be run: {block.reason}')


@pytest.mark.parametrize('block', [block for block in BLOCKS if block.language == 'yaml'],
                         ids=lambda block: block.place)
def test_parameter_files_hold_parameters_of_the_nodes(block):
    file = folder_of(block.document) / (block.name or 'parameters.yaml')
    file.write_text(block.text)
    for key in yaml.safe_load(block.text):
        unknown = []
        for name in NODES:
            if key.strip('/') in (name, '**'):
                with node(name, '--params-file', str(file), document=block.document) as made:
                    assert made._parameter_overrides
                    unknown.append(set(undeclared(made)))
        assert unknown, f'{key} is no node'
        assert not set.intersection(*unknown)


# --- commands ------------------------------------------------------------------------------------


@contextmanager
def node(name, *arguments, document=ROOT / 'README.md'):
    """Construct a node as the command line would."""
    context = Context()
    needed = [] if any('recording:=' in item for item in arguments) else NEEDED.get(name, [])
    with inside(folder_of(document)):
        context.init(args=['--ros-args', *needed, *arguments])
        try:
            made = NODES[name](context=context)
            yield made
            made.destroy_node()
        finally:
            context.try_shutdown()


def undeclared(made):
    """Return overrides that match no parameter of a node; its constructor checks the machine."""
    return [name for name in made._parameter_overrides
            if not (made.has_parameter(name) or name.startswith('machine.'))]


def topics_of(made):
    """Return the topics of a node, its parameter events and log left out."""
    return {item.topic_name if hasattr(item, 'topic_name') else item.topic
            for item in (*made.publishers, *made.subscriptions)} - {
                '/parameter_events', '/rosout'}


@cache
def all_topics():
    """Return the topics of all nodes, with the default shaft and with two shafts."""
    found = set()
    for name in NODES:
        extra = ['-p', 'tach:=both'] if name == 'machine_simulator' else []
        with node(name, *extra) as made:
            found |= topics_of(made)
    with node('synchronous_averager', '-p', 'shafts:=[input, output]') as made:
        found |= topics_of(made)
    with node('jitter_predictor', '-p', 'shafts:=[input, output]') as made:
        return found | topics_of(made)


def lines_of(block):
    """Iterate over the commands of a block as lists of words."""
    text = block.text.replace('\\\n', ' ')
    if block.language == 'session':
        text = '\n'.join(re.findall(r'(?m)^\$ (.*)$', text))
    for line in text.splitlines():
        line = re.split(r'\s(?:&&|\||>)\s', line.replace(SHARE, str(ROOT)))[0]
        words = shlex.split(line, comments=True)
        while words and re.fullmatch(r'[A-Z_]+=.*', words[0]):
            words.pop(0)
        if words and words[-1] == '&':
            words.pop()
        if words:
            yield words


COMMAND_LINES = [(block, words) for block in BLOCKS
                 if block.language in ('bash', 'session') and not block.reason
                 for words in lines_of(block)]


@pytest.mark.parametrize(('block', 'words'), COMMAND_LINES, ids=[
    f'{block.place} {" ".join(words[:4])}' for block, words in COMMAND_LINES])
def test_command(block, words, capsys, monkeypatch):
    monkeypatch.setattr(design, 'draw', lambda *_: Figure())  # test_design_command draws
    program, *rest = words
    if program in OTHERS:
        pytest.skip(f'{program} is not ours to run')
    elif program == './run':
        assert rest[0] in ('demo', 'test')
        if rest[0] == 'demo':
            check_executable(block, 'demo', rest[1:], capsys)
        else:
            assert all(item.startswith('-') or (ROOT / item.split('::')[0]).exists()
                       for item in rest[1:])
    elif program in PYTHONS:
        if rest[0] == '-m':
            assert find_spec(rest[1]) is not None
        else:
            assert any((folder / rest[0]).is_file()
                       for folder in (ROOT, folder_of(block.document)))
    elif program == 'ros2':
        check_ros2(block, rest, capsys)
    elif program in NODES or program in COMMANDS:
        check_executable(block, program, rest, capsys)
    else:
        pytest.fail(f'{block.place}: {program} is no command of this package: tag the block '
                    'as text, or add it to OTHERS')


TUTORIAL = ROOT / 'docs' / 'tutorial.md'
DAY = '## 9. A day with an own gearbox'


@pytest.mark.machines
@pytest.mark.usefixtures('undrawn')
def test_a_day_with_an_own_gearbox_can_be_spent(capsys, ros_graph):
    """All of its commands run, in their order, and print what is shown."""
    begins = TUTORIAL.read_text(encoding='utf-8').splitlines().index(DAY)
    namespace_of(TUTORIAL)['np'] = np
    online = []
    for block in (item for item in BLOCKS if item.document == TUTORIAL and item.line > begins):
        if block.language == 'python':
            run_python(block)
        for words in lines_of(block) if block.language == 'bash' else ():
            if words[:2] != ['ros2', 'run'] or words[3] not in COMMANDS.keys() - {'chain'}:
                online.append(words[3:])
                continue
            with inside(folder_of(TUTORIAL)):
                assert COMMANDS[words[3]].main(words[4:]) == 0
            printed = capsys.readouterr().out
            assert set(stripped(SHOWN.get(block, ''))) <= {*stripped(printed), ''}
    assert (folder_of(TUTORIAL) / 'averages' / 'gearbox' / 'page.html').exists()
    see_the_alarm(online, ros_graph)


def see_the_alarm(online, ros_graph):
    """Start the nodes of the commands for programs on line, and wait for their alarm."""
    (_, _, params, _, *others), (player, *_), _ = online
    changes = ros_graph.capture('change', String, latched=True)
    for name in (*chain.NODES, *others):
        ros_graph.add(NODES[name], cli_args=[
            '--ros-args', '--params-file', str(folder_of(TUTORIAL) / params)])
    ros_graph.add(NODES[player], {
        'recording': str(folder_of(TUTORIAL) / 'gearbox.npz'), 'rate': 10.0})
    assert ros_graph.spin(lambda: changes and json.loads(changes[-1].data)['changes'])
    change, = json.loads(changes[-1].data)['changes']
    assert (change['kind'], change['name'], change['level']) == (
        'limit', 'mesh input-output 2x', 'warn')


def check_executable(block, name, arguments, capsys):
    """Construct a node with its arguments, or take a command's."""
    if name in COMMANDS:
        check_command(block, name, arguments, capsys)
        return
    if arguments:
        assert arguments.pop(0) == '--ros-args', 'parameters follow --ros-args'
    with node(name, *arguments, document=block.document) as made:
        assert not undeclared(made)
        for option, value in pairwise(arguments):
            if option in ('-r', '--remap') and not value.startswith('__'):
                assert made.resolve_topic_name(value.split(':=')[1]) in topics_of(made)


def check_command(block, name, arguments, capsys):
    """Run `design`; of the others look whether there are such options."""
    if name == 'design' and '--help' not in arguments:
        with inside(folder_of(block.document)):
            assert design.main(arguments) == 0
        printed = capsys.readouterr().out
        assert set(stripped(SHOWN.get(block, ''))) <= set(stripped(printed))
        return
    with pytest.raises(SystemExit):
        COMMANDS[name].main(['--help'])
    known = re.findall(r'--[a-z-]+', capsys.readouterr().out)
    assert {item for item in arguments if item.startswith('--')} <= set(known)


def check_ros2(block, words, capsys):
    """Look whether what a command of ROS 2 names is there."""
    verb, *rest = words
    if verb == 'run':
        assert rest[0] == 'sa_jitter_ros'
        check_executable(block, rest[1], rest[2:], capsys)
    elif verb in ('topic', 'bag'):
        named = {item for item in rest if re.fullmatch(r'/[a-z_/]+', item)}
        assert named
        assert named <= all_topics()
    elif verb == 'param':
        action, name, *parameter = [item for item in rest if not item.startswith('-')]
        with node(name.lstrip('/'), document=block.document) as made:
            if parameter:
                assert made.has_parameter(parameter[0])
            if action == 'set':
                value = Parameter(parameter[0], value=yaml.safe_load(parameter[1]))
                result, = made.set_parameters([value])
                assert result.successful, result.reason
    else:
        pytest.skip(f'ros2 {verb} is not ours to run')


# --- names ---------------------------------------------------------------------------------------


def parameters_of(name):
    """Return the parameters of a node with their descriptors and defaults; `<shaft>.` for one."""
    with node(name) as made:
        names = list(made.parameters.values())
        return {re.sub(r'^shaft\.', '<shaft>.', key): (
            made.describe_parameter(key), made.get_parameter(key).value) for key in names}


def table_of_parameters():
    """Return docs/parameters.md, where what several nodes have in common stands once."""
    found = {name: parameter_rows(name) for name in NODES}
    nodes_of = {}  # of each row without its star; of each node whether it has one
    for name, rows in found.items():
        for key, *rest in rows:
            nodes_of.setdefault((key.removesuffix(STAR), *rest), {})[name] = key.endswith(STAR)
    lines = ['# Parameters', '',
             'Every parameter of every node, for whoever writes a machine file or starts a node.',
             '',
             '`<shaft>` is each name in `shafts`. A parameter with a star, or in a node with a '
             'star, is read only when the node starts. `ros2 param describe` prints the same. '
             'Units of channels: [interfaces.md](interfaces.md#units-of-the-channels).',
             '', '## Several nodes', *table('parameter', 'nodes', 'default (allowed)', 'meaning')]
    lines += [f'| {key}{STAR * all(nodes.values())} | {those(nodes)} | {with_default(*values)} | '
              f'{meaning} |' for (key, *values, meaning), nodes in nodes_of.items()
              if len(nodes) > 1 and 'effects.' not in key]
    for name, rows in found.items():
        own = [row for row in rows if 'effects.' not in row[0]
               and len(nodes_of[(row[0].removesuffix(STAR), *row[1:])]) == 1]
        lines += ['', f'## {name}', *table('parameter', 'default (allowed)', 'meaning')]
        lines += [f'| {key} | {with_default(*values)} | {meaning} |'
                  for key, *values, meaning in own]
    return '\n'.join([*lines, *table_of_effects(found)]) + '\n'


def table_of_effects(found):
    """Return the lines about the effects, with their defaults in predictor and simulator."""
    predictor, simulator = ({row[0]: row for row in found[name] if 'effects.' in row[0]}
                            for name in ('jitter_predictor', 'machine_simulator'))
    assert predictor.keys() == simulator.keys()
    lines = ['', '## Effects',
             '`effects.<name>.enabled` (`false`) adds an effect to the model of '
             '`jitter_predictor`, or to the machine of `machine_simulator`. '
             '[What each of them is](theory.md#effects).',
             '', *table('parameter', 'default of predictor, of simulator (allowed)', 'meaning')]
    for key, (_, default, limits, meaning) in predictor.items():
        assert simulator[key][2:] == (limits, meaning)
        if not key.endswith('.enabled`'):
            both = with_default(f'{default}, {simulator[key][1]}', limits)
            lines.append(f'| {key} | {both} | {meaning} |')
    return lines


def parameter_rows(name):
    """Return (name, default, allowed, meaning) of each parameter of a node, in Markdown."""
    return [(f'`{key}`{STAR * descriptor.read_only}',
             '' if key == 'recording' else shown(value), allowed(descriptor),
             descriptor.description.removesuffix(' [1]'))
            for key, (descriptor, value) in parameters_of(name).items()]


def table(*columns):
    """Return the first two lines of a table."""
    return f'| {" | ".join(columns)} |', f'|{"---|" * len(columns)}'


def those(nodes):
    """Return the names of some nodes, with a star where only some of them have one."""
    others = [name for name in NODES if name not in nodes]
    if not others:
        return 'all'
    if len(others) < len(nodes):
        return f'all but {", ".join(others)}'
    some = any(nodes.values()) and not all(nodes.values())
    return ', '.join(name + STAR * (some and star) for name, star in nodes.items())


def shown(value):
    """Return a default as YAML has it."""
    if isinstance(value, str):
        return f"`'{value}'`"
    if hasattr(value, '__len__'):
        return f'`{list(value)}`'
    return f'`{str(value).lower() if isinstance(value, bool) else value}`'


def with_default(default, limits):
    """Return a default with what else is allowed."""
    return f'{default} ({limits})' if limits else default


def allowed(descriptor):
    """Return the range of a parameter, or its choices."""
    text = descriptor.additional_constraints.removeprefix('one of ').removesuffix('.0')
    parts = [text.replace('more than ', '>').replace('at least ', '≥')] if text else []
    for limits in (*descriptor.floating_point_range, *descriptor.integer_range):
        low, high = limits.from_value, limits.to_value
        has_low = abs(low) < 1e300 and low > -2**63
        has_high = abs(high) < 1e300 and high < 2**63 - 1
        if has_low and has_high:
            parts.append(f'{low:.8g}..{high:.8g}')
        elif has_low:
            parts.append(f'≥{low:.8g}')
        elif has_high:
            parts.append(f'≤{high:.8g}')
    return ', '.join(parts)


def test_the_list_of_parameters_is_that_of_the_nodes():
    held = (ROOT / 'docs' / 'parameters.md').read_text(encoding='utf-8')
    assert held == table_of_parameters(), 'run: python test/test_docs.py'


def words_in(path):
    """Return all that stands between backticks."""
    text = re.sub(r'(?ms)^ *```.*?^ *```', '', path.read_text(encoding='utf-8'))
    return {word.strip('/') for item in re.findall(r'`([^`\n]+)`', text)
            for word in re.split('[:,]', item.split(': ')[0])}


@cache
def known_words():
    """Return the names of parameters, their choices, topics, fields, nodes and counts."""
    known = {*NODES, *COMMANDS, *INDICATORS, *FIELDS, *messages.AMPLITUDE_FIELDS,
             *messages.PULSE_ERROR_FIELDS, *messages.PREDICTION_FIELDS,
             *messages.RESIDUAL_FIELDS, *messages.ENVELOPE_FIELDS,
             *messages.SAMPLE_TYPES, *messages.PULSE_TYPES, *diagnostic_keys(),
             *AngleState.__dataclass_fields__, JOINT_TYPE}
    for name in NODES:
        for key, (descriptor, _) in parameters_of(name).items():
            known |= {key, key.removeprefix('<shaft>.')}
            choices = descriptor.additional_constraints.partition('one of ')[2]
            known |= set(choices.split(';')[0].split(', '))
    return known.union((topic[1:] for topic in all_topics()), *(
        {topic, topic.rpartition('/')[2]} for topic in general_topics()))


def general_topics():
    """Return the topics of all nodes without the first stroke, `<shaft>/` for one of a shaft."""
    return {re.sub('^(shaft|input|output)/', '<shaft>/', topic[1:]) for topic in all_topics()}


@cache
def diagnostic_keys():
    """Return the keys that the nodes show in /diagnostics."""
    keys = {'<shaft>.corrections_refused', '<shaft>.refusal', 'channels', 'sample_rate',
            'problems'}
    for name in NODES:
        with node(name) as made:
            made.update_counts()
            ages = {f'{flow}_age' for flow in made.health.flows}
            keys |= {*made.counts, *ages, *made.summary()[1]}
    return keys


# Other words in backticks: ROS's own, the dimensions of arrays, and a topic that is subscribed to
# only where parameters use it.
ORDINARY = {
    'operating_state',
    'ros2', 'foxglove_bridge', 'joint_states', 'nan', 'diagnostic_aggregator', 'diagnostics_agg',
    *(folder + path.name for path in (ROOT / 'config').iterdir() for folder in ('', 'config/')),
    'channel', 'sample', 'angle', 'order', 'field', 'pulse', 'mark', 'indicator', 'time_ref',
    'source', 'layout.data_offset', 'data_offset', 'std_msgs/Float64', 'effects.<name>.enabled',
    'sa_jitter_ros.nodes.messages', *vars(messages), 'diagnostic_msgs/DiagnosticArray',
    'header.stamp', 'sequence', 'trigger_speed_hz',
    'qos_overrides.<topic>.subscription.reliability', 'std_msgs/Float64MultiArray'}


@pytest.mark.parametrize('name', ['interfaces.md', 'monitoring.md'])
def test_names_in_backticks_exist(name):
    words = {re.sub('[./]data$', '', word) for word in words_in(ROOT / 'docs' / name)
             if re.fullmatch(r'[a-z<][a-z0-9_<>./]+', word)}
    assert not words - known_words() - ORDINARY - EFFECTS.keys()


def test_every_topic_is_in_the_interfaces():
    assert general_topics() <= words_in(ROOT / 'docs' / 'interfaces.md')


def test_every_diagnostic_key_is_explained():
    assert diagnostic_keys() <= words_in(ROOT / 'docs' / 'monitoring.md')
    assert set(DIAGNOSTIC_KEYS) <= words_in(ROOT / 'docs' / 'interfaces.md')


# --- links and the names of tests and files ------------------------------------------------------


def slugs(document):
    """Return the anchors of a document's headings."""
    headings = re.findall(r'(?m)^#+ (.+)$', document.read_text(encoding='utf-8'))
    return {re.sub(r'[^\w\- ]', '', item.lower()).replace(' ', '-') for item in headings}


LINKS = [(document, target) for document in (*DOCUMENTS, ROOT / 'CONTRIBUTING.md')
         for target in re.findall(r'\]\(([^)\s]+)\)', document.read_text(encoding='utf-8'))
         if '://' not in target]


@pytest.mark.parametrize(('document', 'target'), LINKS, ids=[
    f'{document.name} {target}' for document, target in LINKS])
def test_link(document, target):
    path, _, anchor = target.partition('#')
    found = (document.parent / path).resolve() if path else document
    assert found.exists()
    assert not anchor or anchor in slugs(found)


@pytest.mark.parametrize('document', [*DOCUMENTS, ROOT / 'CONTRIBUTING.md'],
                         ids=lambda document: document.name)
def test_files_and_tests_that_are_named_exist(document):
    tests = {path.name: path.read_text(encoding='utf-8') for path in (ROOT / 'test').glob('*.py')}
    text = re.sub(r'(?ms)^ *```.*?^ *```', '', document.read_text(encoding='utf-8'))
    for name in re.findall(r'`([^`\s]+)`', text):
        if re.fullmatch(r'test_\w+\.py', name):
            assert name in tests
        elif re.fullmatch(r'test_\w+', name):
            assert any(f'def {name}(' in content for content in tests.values()), name
        elif re.fullmatch(r'(?:\w+/)+\w+\.(py|yaml|md)', name):
            assert any((folder / name).is_file() for folder in (
                ROOT, ROOT / 'sa_jitter_ros', ROOT / 'docs')), name


if __name__ == '__main__':
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'OFF'
    (ROOT / 'docs' / 'parameters.md').write_text(table_of_parameters(), encoding='utf-8')
    for drawing, figure in FIGURES:
        draw(drawing)
        copyfile(folder_of(drawing) / figure, ROOT / 'docs' / 'figures' / figure)
