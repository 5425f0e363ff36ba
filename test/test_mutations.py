# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Published results of the loop depend on the numbers in its constants."""

from mutations import differs, noticed, numbers, sample
import pytest


def test_numbers_of_constants_are_found():
    names = [number.name for number in numbers()]
    assert len(set(names)) == len(names) > 100
    assert 'effects.effect.ODDS' in names


@pytest.mark.machines
def test_without_a_move_nothing_changes():
    assert not differs(['clock_skew 1000'])


@pytest.mark.machines
@pytest.mark.parametrize(('number', 'way', 'case'), [
    pytest.param(*item, id=item[0].name) for item in sample(20, seed=1)])
def test_moving_a_number_tenfold_changes_a_published_result(number, way, case):
    assert noticed(number, way == 'up', [case])
