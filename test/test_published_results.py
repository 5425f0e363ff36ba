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

from independent_effects import UNKNOWN
from published_results import CASES, DAMAGES, differences, EDGES, result, RESULTS, truth
import pytest

pytestmark = pytest.mark.machines

# What a damage makes of a recording that has no effect, or the words of the error or the remark.
ERRORS = {
    'faster': 'trigger_speed is declared as', 'other_ratio': 'ratio is declared as',
    'strays': 'pulses are spurious', 'no_shaft': 'no interval that a shaft could have',
    'two_pulses': '2 keyphasor pulses', 'louder': 'different machines or loads',
    'two_clocks': 'one declared model holds for one clock',
    'short_reference': 'reference_pulse_times cover 30% of the pulses'}
REMARKS = {
    'poor_reference': 'they give less amplitude than pulse_times',
    'short': 'no line is compared: 2 acquisitions of 12 trigger cycles'}
EFFECTS = {
    'much_jitter': 'jitter_scale', 'little_jitter': 'excess_jitter',
    'coarse_clock': 'keyphasor_quantisation', 'late': 'path_delay',
    'foreign_shaft': 'interfering_tone', 'fast_clock': 'clock_skew', 'late_run_up': 'path_delay',
    'slow_beat': 'interpolation_loss'}
# What remains of damages that are no effect.
REMAINS = {'swaying': 'a sinusoid of the pulses', 'twisting': 'the shaft twists steadily',
           'fading': 'by single events', 'displaced': 'distributed as no effect makes them',
           'slow_torsion': 'a sinusoid of the source', 'drifting': 'a drift of the source',
           'one_order': 'from cycle to cycle'}
AGAINST = {'late_reference': 'reference keyphasor', 'poor_reference': 'vibration'}


@pytest.mark.parametrize('case', CASES)
def test_result_is_the_published_one(case):
    published = json.loads(RESULTS.read_text())[case]
    assert list(differences(result(case), published, EDGES.get(case, ()))) == []


@pytest.mark.parametrize('case', CASES)
def test_published_result_is_right(case):
    """Naming coloured noise, which no declared model holds, is right, too."""
    published = json.loads(RESULTS.read_text())[case]
    drawn, _, damage = truth(case)
    if damage in ERRORS:
        assert ERRORS[damage] in published['error']
        return
    assert AGAINST.get(damage, published['against']) == published['against']
    assert REMARKS.get(damage, '') in ' '.join(published['remarks'])
    names = [*drawn.truth, *([EFFECTS[damage]] if damage in EFFECTS else [])]
    if damage in ('short', 'again'):  # which shows nothing, and where all is declared
        names = []
    unknown = set(UNKNOWN) & set(names) or damage in REMAINS
    verdict = 'unexplained' if unknown else 'traced' if names else 'none'
    coloured = drawn.machine.noise_colour > 0.0
    found = [item['name'] for item in published['missing_effects']]
    if coloured and 'additive_noise' not in names:
        found = [item for item in found if item != 'additive_noise']
    assert REMAINS.get(damage, '') in published['remains']
    assert (published['verdict'], sorted(found)) == (verdict, [] if unknown else sorted(names))


def test_sizes_that_were_declared_wrong_are_measured():
    published = json.loads(RESULTS.read_text())
    less, = published['none 1009 much_jitter']['missing_effects']
    scale = less['parameters']['scale']
    assert abs(scale['value'] - 0.1) < 3.0 * scale['standard_error']
    more, = published['none 1009 little_jitter']['missing_effects']
    jitter = 1.0 / truth('none 1009 ')[0].machine.keyphasor_rate / 12**0.5
    std = more['parameters']['std']
    assert abs(std['value'] - jitter * 0.99**0.5) < 3.0 * std['standard_error']
    coarse, = published['none 52619 coarse_clock']['missing_effects']
    machine = truth('none 52619 coarse_clock')[0].machine
    clock = 17.5 * machine.speed * machine.pulses_per_revolution
    assert coarse['parameters']['clock_rate']['value'] == pytest.approx(clock, rel=1e-3)


def test_a_delay_is_measured_by_the_speed_that_changes():
    late, = json.loads(RESULTS.read_text())['none 1013 late']['missing_effects']
    delay = late['parameters']['delay']
    assert abs(delay['value'] - 0.012) < 3.0 * delay['standard_error'] < 2e-3


def test_a_skew_too_small_to_matter_is_present():
    effect, = json.loads(RESULTS.read_text())['none 1009 slow_clock']['present']
    skew = effect['parameters']['skew']
    assert abs(skew['value'] - 2e-5) < 3.0 * skew['standard_error'] < 1e-5


def test_every_damage_has_a_case():
    assert {truth(case)[2] for case in CASES} == {*DAMAGES, 'again', ''}
