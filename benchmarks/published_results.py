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
Results of the loop on a few drawn machines, as `published_results.json` beside this file has them.

`python benchmarks/published_results.py` closes the loop on each machine and prints what differs
from the file; `--write` makes the file anew, after a change that is meant to change results. The
truth of each machine is in its name: all of them are right.
"""

import argparse
from collections.abc import Iterator, Mapping, Sequence
import json
import math
from pathlib import Path
import re
import sys
import tempfile
from typing import Any

from independent_effects import draw_case
from independent_machines import declared, record
import numpy as np
from sa_jitter_ros.loop import close_loop

RESULTS = Path(__file__).with_suffix('.json')
# Effects joined by +, and the seed of the machine: short recordings, one for each kind of answer.
CASES = (
    'none 1009', 'interfering_tone 1005', 'two_paths 1001', 'additive_noise 1007',
    'clock_skew 1000', 'keyphasor_quantisation 1005', 'target_geometry 1002',
    'target_geometry 2003', 'correlated_jitter 1002', 'interpolation_loss 1005',
    'speed_fluctuation 1011', 'resonance 1010', 'resonance 2000', 'late_recovery 2012',
    'amplitude_modulation 1006', 'excess_jitter 1007', 'excess_jitter 12103', 'phase_wander 1004',
    'missing_pulses 3000', 'correlated_jitter+additive_noise 3000', 'resonance 41009',
    'phase_wander+interfering_tone 3000', 'keyphasor_quantisation+clock_skew 3003',
    'missing_pulses+clock_skew 3001', 'following_level 3000', 'late_recovery 3001',
    'interfering_tone 3001', 'additive_noise 3001', 'keyphasor_quantisation 3001',
    'target_geometry 3001', 'excess_jitter+amplitude_modulation 3000', 'none 52619')
# A result on another computer differs by rounding, which the searches of the fit enlarge.
_RELATIVE, _PROBABILITY, _TINY = 0.02, 0.02, 1e-9
_UNLIKE = {'recordings', 'created', 'version', 'parameter_file', 'declared'}
_PROBABILITIES = {'probabilities', 'p_value', 'coverage_95', 'ks', 'mean'}


def result(name: str) -> Mapping[str, Any]:
    """Close the loop on a case; return its report without what is new every time."""
    effects, seed = name.split(' ')
    case = draw_case(tuple(item for item in effects.split('+') if item != 'none'), int(seed))
    fields = record(case.machine, case.what, np.random.default_rng([int(seed), 1]))
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        np.savez(folder / 'machine.npz', **fields)
        (folder / 'model.yaml').write_text(declared(case.machine))
        report = close_loop(folder / 'machine.npz', folder / 'model.yaml').report
    return {key: value for key, value in report.items() if key not in _UNLIKE}


def differences(found: Any, published: Any, place: str = '') -> Iterator[str]:
    """Yield a line for each value that differs by more than rounding can make it."""
    if isinstance(published, Mapping):
        for key in sorted({*published, *found}):
            yield from differences(found.get(key), published.get(key), f'{place}.{key}')
    elif isinstance(published, Sequence) and not isinstance(published, str):
        if len(found) != len(published):
            yield f'{place}: {len(found)} items for {len(published)}'
        for index, pair in enumerate(zip(found, published)):
            yield from differences(*pair, f'{place}[{index}]')
    elif not _alike(found, published, place):
        yield f'{place}: {found} for {published}'


def _alike(found: Any, published: Any, place: str) -> bool:
    if isinstance(published, str) and isinstance(found, str):
        return _words(found) == _words(published)
    if isinstance(published, bool) or not isinstance(published, (int, float)) or not isinstance(
            found, (int, float)):
        return bool(found == published)
    probability = _PROBABILITIES & set(re.findall(r'\w+', place))
    return math.isclose(found, published, rel_tol=_RELATIVE,
                        abs_tol=_PROBABILITY if probability else _TINY)


def _words(text: str) -> str:
    """Return a text without its numbers, which stand elsewhere."""
    return re.sub(r'-?\d[\d.e+-]*', '0', text)


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare the results with the published ones, or write them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--write', action='store_true', help='make the file anew')
    parser.add_argument('--cases', nargs='+', default=CASES, help='only these')
    parser.add_argument('--first', action='store_true', help='stop at the first difference')
    options = parser.parse_args(arguments)
    published = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    count = 0
    for name in options.cases:
        print(name, file=sys.stderr, flush=True)
        found = json.loads(json.dumps(result(name)))
        if options.write:
            published[name] = found
            continue
        for line in differences(found, published[name]):
            print(f'{name}{line}', flush=True)
            count += 1
            if options.first:
                return 1
    if options.write:
        rows = (f'{json.dumps(name)}: {json.dumps(published[name])}' for name in CASES)
        RESULTS.write_text('{\n' + ',\n'.join(rows) + '\n}\n')
    return int(count > 0)


if __name__ == '__main__':
    sys.exit(main())
