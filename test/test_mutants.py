# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Faults in the code, which tests must notice."""

import ast

from mutants import faults, noticed, ROOMS, sample
import pytest


def test_each_fault_changes_the_code_of_a_folder():
    every = list(faults())
    assert {fault.path.split('/')[1] for fault in every} == set(ROOMS)
    for fault in every[::400]:
        before, after = fault.text, fault.changed
        assert before[fault.start:fault.end] == fault.before
        assert before != after
    assert len(every) > 5000


def test_a_fault_is_a_number_or_a_comparison():
    for fault in list(faults())[::50]:
        if not fault.before.strip('<>=!'):
            assert fault.after.strip('<>=!') == ''
        else:
            number = ast.literal_eval(fault.before)
            assert ast.literal_eval(fault.after) == (10 * number or 1)


@pytest.mark.machines
@pytest.mark.parametrize(('fault', 'test'), [
    pytest.param(fault, test, id=fault.name) for fault, test in sample(5, seed=1)])
def test_a_fault_is_noticed(fault, test):
    assert noticed(fault, [test])
