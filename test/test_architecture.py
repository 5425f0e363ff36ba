"""The rules of the house: who imports what, and how long a module may be."""

import ast
from pathlib import Path
import sys

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / 'sa_jitter_ros'
MODULES = sorted(PACKAGE.rglob('*.py'))
LONGEST = 300  # lines that are not blank

# Third-party packages and own parts that each part of the core may import.
SCIENCE = {'numpy', 'scipy'}
CORE = {
    'errors': set(),
    'angle': SCIENCE | {'errors'},
    'averaging': SCIENCE | {'angle', 'errors'},
    'statistics': SCIENCE | {'errors'},
    'effects': SCIENCE | {'angle', 'errors', 'statistics'},
    'recordings': SCIENCE | {'angle', 'errors', 'rosbags'},
    'simulation': SCIENCE | {'errors'},
    'reproduction': SCIENCE | {
        'angle', 'averaging', 'errors', 'matplotlib', 'simulation', 'statistics'},
    'closure': SCIENCE | {
        'angle', 'averaging', 'effects', 'errors', 'matplotlib', 'recordings', 'statistics'},
}
ROS = {'ament_index_python', 'builtin_interfaces', 'rcl_interfaces', 'rclpy'}
ROS_PARTS = {'commands', 'nodes'}
CLOSURE_USERS = {
    'closure', 'commands.close_loop', 'commands.reproduce', 'nodes.residual_analyser'}


def name_of(path):
    """Return the dotted name of a module below the package, '' for the package itself."""
    parts = path.relative_to(PACKAGE).with_suffix('').parts
    return '.'.join(part for part in parts if part != '__init__')


def part_of(path):
    """Return the first part of a module's name."""
    return name_of(path).partition('.')[0]


def imports(path):
    """Yield the absolute name of everything a module imports, wherever in it the import stands."""
    for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f'{path}: relative import'
            yield from (f'{node.module}.{alias.name}' for alias in node.names)


def needs(path):
    """Return the third-party packages and the own parts that a module imports."""
    found = set()
    for name in imports(path):
        top, _, rest = name.partition('.')
        if top == 'sa_jitter_ros':
            found.add(rest.partition('.')[0])
        elif top not in sys.stdlib_module_names:
            found.add(top)
    return found


def is_ros(package):
    """Return whether an imported package is part of ROS 2."""
    return package in ROS or package.endswith('_msgs')


def test_every_part_of_the_package_has_its_rule():
    assert {part_of(path) for path in MODULES} <= CORE.keys() | ROS_PARTS | {''}


@pytest.mark.parametrize('path', MODULES, ids=name_of)
def test_module_keeps_to_its_place(path):
    part, needed = part_of(path), needs(path)
    if part in CORE:
        assert needed <= CORE[part] | {part}
    if part not in ROS_PARTS:
        assert not any(is_ros(package) for package in needed)
    if 'closure' in needed:
        assert part in CLOSURE_USERS or name_of(path) in CLOSURE_USERS


@pytest.mark.parametrize('path', MODULES, ids=name_of)
def test_module_is_one_concept_long(path):
    lines = sum(bool(line.strip()) for line in path.read_text(encoding='utf-8').splitlines())
    assert lines <= LONGEST


@pytest.mark.parametrize('path', MODULES, ids=name_of)
def test_core_does_not_print(path):
    called = {
        node.func.id
        for node in ast.walk(ast.parse(path.read_text(encoding='utf-8')))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    }
    assert 'print' not in called or part_of(path) in ROS_PARTS


def test_rules_see_what_they_forbid(tmp_path):
    module = tmp_path / 'module.py'
    module.write_text(
        'import os.path\n'
        'from sa_jitter_ros.closure.trace import trace\n'
        'def late():\n'
        '    from sensor_msgs.msg import Imu\n'
    )
    assert needs(module) == {'closure', 'sensor_msgs'}
    assert is_ros('sensor_msgs')
