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
Results of the loop stay what was published, on machines whose truth is known.

After a change that is meant to change results: `python benchmarks/published_results.py --write`.
"""

import json

from independent_effects import draw_case, UNKNOWN
from published_results import CASES, differences, result, RESULTS
import pytest

pytestmark = pytest.mark.machines


@pytest.mark.parametrize('case', CASES)
def test_result_is_the_published_one(case):
    published = json.loads(RESULTS.read_text())[case]
    assert list(differences(json.loads(json.dumps(result(case))), published)) == []


@pytest.mark.parametrize('case', CASES)
def test_published_result_is_right(case):
    """Naming coloured noise, which no declared model holds, is right, too."""
    published = json.loads(RESULTS.read_text())[case]
    name, seed = case.split(' ')
    names = [] if name == 'none' else name.split('+')
    unknown = set(UNKNOWN) & set(names)
    verdict = 'unexplained' if unknown else 'traced' if names else 'none'
    coloured = draw_case(tuple(names), int(seed)).machine.noise_colour > 0.0
    found = [item['name'] for item in published['missing_effects']]
    if coloured and 'additive_noise' not in names:
        found = [item for item in found if item != 'additive_noise']
    assert (published['verdict'], sorted(found)) == (verdict, [] if unknown else sorted(names))
