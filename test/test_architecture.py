# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The rules of the rooms: which module may import what."""

import ast
from collections import defaultdict
from functools import cache
from pathlib import Path
import re
import subprocess
import sys

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / 'sa_jitter_ros'
MODULES = sorted(PACKAGE.rglob('*.py'))

# What each room may import: third-party packages and other rooms. `` is the library itself.
SCIENCE = {'arrays', 'numpy', 'scipy'}
CORE = {
    'arrays': {'numpy'},
    'errors': set(),
    'html_parts': set(),
    'inner_loops': SCIENCE,
    'json_values': {'numpy'},
    'number_text': set(),
    'parameters': {'errors'},
    'parameter_file': {'errors', 'yaml'},
    'machine': {'errors', 'parameter_file', 'parameters'},
    'samples': {'arrays', 'errors', 'numpy'},
    'version': set(),
    'whole_files': set(),
    'pulses': SCIENCE | {'errors', 'inner_loops', 'parameters', 'samples'},
    'averaging': SCIENCE | {
        'errors', 'inner_loops', 'machine', 'parameters', 'pulses', 'samples'},
    'prediction': SCIENCE | {'errors', 'parameters', 'pulses'},
    'effects': SCIENCE | {'errors', 'parameters', 'prediction', 'pulses'},
    'declaration': {
        'effects', 'errors', 'machine', 'parameter_file', 'parameters', 'prediction', 'pulses'},
    'recordings': SCIENCE | {
        'asammdf', 'errors', 'h5py', 'nptdms', 'parameters', 'pulses', 'pyuff', 'rosbags',
        'samples'},
    'simulation': SCIENCE | {'errors'},
    'tacholess': SCIENCE | {
        'averaging', 'errors', 'machine', 'parameters', 'pulses', 'recordings'},
    'inference': SCIENCE | {
        'averaging', 'effects', 'errors', 'number_text', 'parameters', 'prediction', 'pulses',
        'recordings'},
    'monitoring': SCIENCE | {
        'averaging', 'errors', 'json_values', 'machine', 'number_text', 'parameter_file',
        'parameters', 'whole_files'},
    'keyphasor_check': SCIENCE | {
        'averaging', 'effects', 'errors', 'machine', 'parameter_file', 'parameters', 'pulses',
        'recordings'},
    'offline': SCIENCE | {
        'averaging', 'distributed', 'errors', 'html_parts', 'json_values', 'keyphasor_check',
        'loop', 'machine', 'matplotlib', 'monitoring', 'number_text', 'parameter_file',
        'parameters', 'pulses', 'recordings', 'samples', 'tacholess', 'whole_files'},
    'report': SCIENCE | {
        'averaging', 'effects', 'errors', 'html_parts', 'inference', 'json_values', 'matplotlib',
        'number_text', 'parameter_file', 'prediction', 'pulses', 'recordings', 'version'},
    'loop': {
        'arrays', 'declaration', 'effects', 'errors', 'inference', 'keyphasor_check', 'parameters',
        'prediction', 'pulses', 'recordings', 'report', 'whole_files'},
}
ROOMS = {
    **CORE,
    '': {'numpy', *CORE},
    'start': set(),  # it loads what it starts
    'nodes': {'pytest'} | SCIENCE | CORE.keys(),
    'commands': {'matplotlib', 'nodes'} | SCIENCE | CORE.keys(),
}
#: What people look at; the others average, predict and infer, and know nothing of it.
TOOLS = {'report', 'loop', 'offline', 'commands', 'nodes'}
ROS = {'ament_index_python', 'builtin_interfaces', 'rcl_interfaces', 'rclpy'}
ROS_USERS = ('nodes', 'commands.demo')  # the demo starts nodes
INFERENCE_USERS = ('', 'inference', 'report', 'loop', 'nodes.residual_analyser')


def name_of(path):
    """Return the dotted name of a module below the package, '' for the package itself."""
    parts = path.relative_to(PACKAGE).with_suffix('').parts
    return '.'.join(part for part in parts if part != '__init__')


def room_of(path):
    """Return the room of a module: the first part of its name."""
    return name_of(path).partition('.')[0]


@cache
def nodes_of(path):
    """Return all nodes of the syntax tree of a file, its module first."""
    return list(ast.walk(ast.parse(path.read_text(encoding='utf-8'))))


def imports(path):
    """Yield the absolute name of everything a module imports, wherever in it the import stands."""
    for node in nodes_of(path):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f'{path}: relative import'
            yield from (f'{node.module}.{alias.name}' for alias in node.names)


def needs(path):
    """Return the third-party packages and the rooms that a module imports."""
    found = set()
    for name in imports(path):
        top, _, rest = name.partition('.')
        if top == 'sa_jitter_ros':
            found.add(rest.partition('.')[0])
        elif top not in sys.stdlib_module_names and top != 'typing_extensions':  # for mypy alone
            found.add(top)
    return found


def is_ros(package):
    """Return whether an imported package is part of ROS 2."""
    return package in ROS or package.endswith('_msgs')


def is_one_of(name, users):
    """Return whether a module is one of those named, or in a room or group of modules named."""
    return any(name == user or (user and name.startswith((f'{user}.', f'{user}_')))
               for user in users)


def import_graph(names):
    """Return {module: modules of the package that it imports}."""
    graph = {}
    for name, path in names.items():
        graph[name] = set()
        for imported in imports(path):
            top, _, target = imported.partition('.')
            while target not in names:  # a name in a module
                target = target.rpartition('.')[0]
            if top == 'sa_jitter_ros' and target != name:
                graph[name].add(target)
    return graph


def in_circles(graph):
    """Return the names from which imports lead back to themselves."""
    reached = {name: set(needed) for name, needed in graph.items()}
    for between in graph:
        for needed in reached.values():
            if between in needed:
                needed |= reached[between]
    return {name for name, needed in reached.items() if name in needed}


def test_every_room_has_its_rule():
    assert {room_of(path) for path in MODULES} <= ROOMS.keys()


def forbidden(path):
    """Return what a module needs beyond what its room allows."""
    name, room, needed = name_of(path), room_of(path), needs(path)
    ros = {package for package in needed if is_ros(package)}
    found = needed - ros - ROOMS[room] - {room}
    if not is_one_of(name, ROS_USERS):
        found |= ros
    if name != 'nodes.testing':
        found |= needed & {'pytest'}
    if not is_one_of(name, INFERENCE_USERS):
        found |= needed & {'inference', 'report'}
    return found


def test_modules_import_what_their_room_allows():
    assert {name_of(path): found for path in MODULES if (found := forbidden(path))} == {}


def test_what_people_look_at_is_apart_from_the_core():
    """The library's own door, which loads `loop` when it is used, stands above both."""
    for room in ROOMS.keys() - TOOLS - {''}:
        assert not ROOMS[room] & TOOLS, room


def test_rooms_use_public_names_of_one_another():
    for path in MODULES:
        for name in imports(path):
            room, _, inside = name.removeprefix('sa_jitter_ros.').partition('.')
            if name.startswith('sa_jitter_ros.') and room != room_of(path):
                assert not re.search(r'\b_(?!_version)', inside), f'{path}: {name}'


def test_no_two_classes_have_one_name():
    """A simulated effect has the name of the effect, beside which it stands in the docs."""
    homes = defaultdict(list)
    for path in MODULES:
        for node in nodes_of(path)[0].body:
            if isinstance(node, ast.ClassDef) and room_of(path) != 'simulation':
                homes[node.name].append(name_of(path))
    assert {name: found for name, found in homes.items() if len(found) > 1} == {}


def test_no_circle_of_imports():
    """None between modules, none between rooms, not even for types."""
    graph = import_graph({name_of(path): path for path in MODULES})
    assert not in_circles(graph)
    rooms = {}
    for name, needed in graph.items():
        room = name.partition('.')[0]
        rooms.setdefault(room, set()).update(
            other.partition('.')[0] for other in needed if other.partition('.')[0] != room)
    assert not in_circles(rooms)


def test_import_of_the_library_loads_numpy_only():
    loaded = subprocess.run(
        [sys.executable, '-c', 'import sys, sa_jitter_ros; print(*sys.modules)'], cwd=ROOT,
        check=True, capture_output=True, text=True).stdout.split()
    packages = {name.partition('.')[0] for name in loaded}
    assert not packages & {'matplotlib', 'rclpy', 'rosbags', 'scipy', 'yaml'}


@pytest.mark.parametrize('module', ['commands.loop_run', 'nodes.change_monitor'])
def test_distributions_take_no_time_to_load(module):
    loaded = subprocess.run(
        [sys.executable, '-c', f'import sys, sa_jitter_ros.{module}; print(*sys.modules)'],
        cwd=ROOT, check=True, capture_output=True, text=True).stdout.split()
    assert 'scipy.special' in loaded
    assert 'scipy.stats' not in loaded


def test_core_does_not_print():
    assert [name_of(path) for path in MODULES if room_of(path) in CORE and any(
        isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
        and node.func.id == 'print' for node in nodes_of(path))] == []


def test_rules_see_what_they_forbid(tmp_path, monkeypatch):
    module = tmp_path / 'module.py'
    module.write_text(
        'import os.path\n'
        'from typing import TYPE_CHECKING\n'
        'from sa_jitter_ros.inference.trace import trace\n'
        'if TYPE_CHECKING:\n'
        '    from sa_jitter_ros.report import report\n'
        'def late():\n'
        '    from sensor_msgs.msg import Imu\n'
    )
    assert needs(module) == {'inference', 'report', 'sensor_msgs'}
    monkeypatch.setattr(f'{__name__}.PACKAGE', tmp_path)
    monkeypatch.setitem(ROOMS, 'module', {'report'})
    assert forbidden(module) == {'inference', 'report', 'sensor_msgs'}
    monkeypatch.undo()
    assert is_ros('sensor_msgs')
    assert is_one_of('commands.demo_plan', ['commands.demo'])
    assert not is_one_of('commands.design', ['commands.demo', ''])
    names = {'': PACKAGE / '__init__.py', 'inference.trace': module, 'report.report': module}
    assert import_graph(names)['inference.trace'] == {'report.report'}
    assert in_circles({'a': {'b'}, 'b': {'c'}, 'c': {'d'}, 'd': {'b', 'e'}, 'e': set()}) == {
        'b', 'c', 'd'}
