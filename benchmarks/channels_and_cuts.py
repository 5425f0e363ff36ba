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
The loop on other orders of the channels, and on recordings that are cut in two.

    python benchmarks/channels_and_cuts.py --machines 4

Each machine of `independent_machines` with several channels is recorded once, then its channels
are reversed, and it is cut into two files at a random place. Prints where names or verdict
differ, and by how many standard errors the sizes do.
"""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
import sys
import tempfile
from typing import Any
import warnings

from independent_effects import draw_case
from independent_machines import declared, record
import numpy as np
from sa_jitter_ros.loop import close_loop

EFFECTS = ('', 'excess_jitter', 'correlated_jitter', 'target_geometry', 'clock_skew',
           'phase_wander')
WAYS = ('channels', 'cut')
_MOST_CYCLES = 900  # of a machine, which take some seconds


def answer(files: Sequence[Path], model: Path) -> tuple[tuple[str, ...], Mapping[str, Any]]:
    """Return verdict and effects, and each size with its standard error."""
    report = close_loop(list(files), model).report
    effects = report['missing_effects']
    return ((report['verdict'], *sorted(one['name'] for one in effects)),
            {f'{one["name"]}.{name}': (np.array(value['value'], float),
                                       np.array(value['standard_error'], float))
             for one in effects for name, value in one['parameters'].items()
             if value['standard_error'] is not None})


def cut(fields: Mapping[str, Any], share: float) -> list[dict[str, Any]]:
    """Return a recording in two pieces, of which the first has a share of the samples."""
    at = int(share * fields['vibration'].shape[-1])
    time = fields['start_time'] + at / fields['sample_rate']
    pieces = [dict(fields, vibration=fields['vibration'][:, :at]),
              dict(fields, vibration=fields['vibration'][:, at:], start_time=time)]
    for name in {'pulse_times', 'reference_pulse_times'} & fields.keys():
        pulses = np.asarray(fields[name])
        pieces[0][name], pieces[1][name] = pulses[pulses < time], pulses[pulses >= time]
    return pieces


def draw(effect: str, seed: int) -> tuple[dict[str, Any], str]:
    """
    Return the recording of the first machine from `seed` on with several channels.

    Those with a reference keyphasor, which may miss in one of the pieces, are left out.
    """
    while True:
        case = draw_case((effect,) if effect else (), seed)
        machine = case.machine
        fields = record(machine, case.what, np.random.default_rng([seed, 1]))
        if (len(fields['vibration']) > 1 and 'reference_pulse_times' not in fields
                and machine.acquisitions * machine.trigger_cycles < _MOST_CYCLES):
            return fields, declared(machine)
        seed += 1


def compare(effect: str, seed: int, folder: Path, wanted: Sequence[str] = WAYS) -> dict[str, str]:
    """Return how the answers for other channels and cuts differ, '' for not at all."""
    fields, text = draw(effect, seed)
    model = folder / 'model.yaml'
    model.write_text(text)
    share = float(np.random.default_rng([seed, 3]).uniform(0.3, 0.7))
    ways = {'as recorded': [fields],
            'channels': [dict(fields, vibration=fields['vibration'][::-1])],
            'cut': cut(fields, share)}
    answers = {}
    for name in ('as recorded', *wanted):
        pieces = ways[name]
        files = [folder / f'{name} {number}.npz' for number in range(len(pieces))]
        for file, piece in zip(files, pieces):
            np.savez(file, **piece)
        answers[name] = answer(files, model)
    names, sizes = answers.pop('as recorded')
    found = {}
    for way, (others, other) in answers.items():
        away = max([float(np.max(np.abs(other[key][0] - sizes[key][0]) / np.maximum(
            other[key][1], sizes[key][1]))) for key in other.keys() & sizes.keys()], default=0.0)
        found[way] = '' if others == names else f'{others} for {names}'
        print(f'{effect or "nothing"} {seed}, {way}: {found[way] or "alike"}, sizes within '
              f'{away:.1f} standard errors', flush=True)
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the share of machines whose answer is the same."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--effects', nargs='*', default=EFFECTS)
    parser.add_argument('--machines', type=int, default=4, help='of each effect')
    parser.add_argument('--first', type=int, default=40_000, help='seed of the first machine')
    parser.add_argument('--ways', nargs='*', default=WAYS, choices=WAYS)
    options = parser.parse_args(arguments)
    rows = []
    with warnings.catch_warnings(), tempfile.TemporaryDirectory() as folder:
        warnings.simplefilter('ignore')
        for effect in options.effects:
            rows += [compare(effect, options.first + 100 * k, Path(folder), options.ways)
                     for k in range(options.machines)]
    for way in rows[0]:
        alike = sum(not row[way] for row in rows)
        print(f'{way}: {alike} of {len(rows)} alike')
    return 0


if __name__ == '__main__':
    sys.exit(main())
