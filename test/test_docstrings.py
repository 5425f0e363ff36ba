# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The examples in the docstrings of the package run, and every public name has one."""

import doctest
from importlib import import_module
from pathlib import Path

import pytest
import sa_jitter_ros

PACKAGE = Path(sa_jitter_ros.__file__).parent
MODULES = ['.'.join(path.relative_to(PACKAGE.parent).with_suffix('').parts)
           for path in sorted(PACKAGE.rglob('*.py')) if '\n    >>> ' in path.read_text('utf-8')
           or '\n>>> ' in path.read_text('utf-8')]


@pytest.mark.parametrize('name', [
    pytest.param(name, marks=[pytest.mark.machines] * (name == 'sa_jitter_ros.loop'))
    for name in MODULES])
def test_examples_of_a_module(name):
    module = import_module(name.removesuffix('.__init__'))
    found = doctest.testmod(module)
    assert found.attempted
    assert not found.failed


@pytest.mark.parametrize('name', sa_jitter_ros.__all__)
def test_a_public_name_has_an_example(name):
    assert '>>> ' in getattr(sa_jitter_ros, name).__doc__
