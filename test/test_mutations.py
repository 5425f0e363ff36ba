# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Published decisions of the loop, and tests, depend on the numbers in constants."""

from pathlib import Path

from decisions import published
from mutations import cases, differs, kept, noticed, numbers, sample
import pytest


def test_numbers_of_constants_are_found():
    names = [number.name for number in numbers()]
    assert len(set(names)) == len(names) > 100
    assert 'effects.effect.ODDS' in names


def test_what_noticed_is_published_and_open_or_a_test():
    names = {name for _, name in kept().values() if name}
    tests = {name for name in names if name.startswith('test/')}
    assert names - tests <= set(cases()) <= published().keys()
    here = Path(__file__).parent
    assert {name.split('::')[0] for name in tests} <= {f'test/{path.name}' for path in
                                                       here.glob('test_*.py')}


@pytest.mark.machines
def test_without_a_move_nothing_changes():
    assert not differs(['damaged faster 0'])


@pytest.mark.machines
@pytest.mark.parametrize(('number', 'way', 'name'), [
    pytest.param(*item, id=item[0].name) for item in sample(6, seed=1)])
def test_moving_a_number_tenfold_is_noticed(number, way, name):
    assert noticed(number, way == 'up', [name])
