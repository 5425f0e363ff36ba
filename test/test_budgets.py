# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Budgets of pyproject.toml: lines of code of each folder, words of docs, size of functions."""

import ast
from collections import Counter
from functools import cache
from pathlib import Path
import sys

import pytest
from radon.metrics import mi_visit

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[1]
BUDGETS = tomllib.loads((ROOT / 'pyproject.toml').read_text())['tool']['sa_jitter_ros']['budgets']
MODULES = sorted((ROOT / 'sa_jitter_ros').rglob('*.py'))
FUNCTIONS = ast.FunctionDef | ast.AsyncFunctionDef


def docstring_lines(node):
    """Return the numbers of the lines of a docstring, none without one."""
    first = node.body[0] if node.body else None
    if isinstance(first, ast.Expr) and isinstance(getattr(first.value, 'value', None), str):
        return set(range(first.lineno, first.end_lineno + 1))
    return set()


@cache
def parsed(path):
    """Return the text of a file and its tree."""
    text = path.read_text('utf-8')
    return text, ast.parse(text)


@cache
def lines_of(path):
    """Return the number of lines of code of a file."""
    return code_lines(*parsed(path))


def code_lines(text, tree):
    """Return the number of lines without blanks, comments and docstrings."""
    lines = {number for number, line in enumerate(text.splitlines(), 1)
             if line.strip() and not line.lstrip().startswith('#')}
    for node in ast.walk(tree):
        if isinstance(node, (ast.Module, ast.ClassDef, *FUNCTIONS.__args__)):
            lines -= docstring_lines(node)
    return len(lines)


def test_lines_of_code_are_counted_without_docstrings():
    text = '"""A module."""\n\nx = (1,  # one\n     2)\n\n\ndef f():\n    """Do."""\n'
    assert code_lines(text, ast.parse(text)) == 3


def test_every_folder_keeps_its_lines_of_code():
    found = Counter()
    for path in MODULES:
        parts = path.relative_to(ROOT / 'sa_jitter_ros').parts
        found[parts[0] if len(parts) > 1 else 'top'] += lines_of(path)
    limits = BUDGETS['lines']
    assert found.keys() == limits.keys()
    assert {name: count for name, count in found.items() if count > limits[name]} == {}


def test_the_documentation_keeps_its_words():
    pages = [ROOT / 'README.md', *sorted((ROOT / 'docs').glob('*.md'))]
    assert sum(len(page.read_text('utf-8').split()) for page in pages) <= BUDGETS['words']


def test_tests_are_as_long_as_what_they_test():
    lines = [sum(lines_of(path) for path in (ROOT / folder).rglob('*.py'))
             for folder in ('test', 'sa_jitter_ros')]
    assert lines[0] >= BUDGETS['tests_per_line'] * lines[1]


@pytest.mark.parametrize('folder', ['sa_jitter_ros', 'test'])
def test_no_function_is_long(folder):
    long = {}
    for path in sorted((ROOT / folder).rglob('*.py')):
        for node in ast.walk(parsed(path)[1]):
            if isinstance(node, FUNCTIONS):
                size = node.end_lineno + 1 - node.lineno - len(docstring_lines(node))
                if size > BUDGETS['function']:
                    long[f'{path.relative_to(ROOT)}: {node.name}'] = size
    assert long == {}


def test_the_longest_modules_can_be_maintained():
    longest = sorted(MODULES, key=lambda path: len(parsed(path)[0]))[-40:]
    found = {path.name: mi_visit(parsed(path)[0], multi=True) for path in longest}
    assert {name: value for name, value in found.items()
            if value < BUDGETS['maintainability_index']} == {}
