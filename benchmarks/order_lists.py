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
Whether one recording gives the same answer under several lists of orders and trigger cycles.

`python benchmarks/order_lists.py` draws machines with an effect each (`independent_effects`). Each
is recorded once and declared several times, with some of its orders, in any sequence, and with
half to twice its trigger cycles. The answers should agree: the same effects found or present, and
parameters within two of their standard errors of the median over the lists.
"""

import argparse
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
import sys
import tempfile

from independent_effects import draw_case
from independent_machines import Array, declared, Machine, record
import numpy as np
from sa_jitter_ros.loop import close_loop

EFFECTS = ('excess_jitter', 'correlated_jitter', 'target_geometry', 'clock_skew', 'phase_wander',
           'additive_noise')
_STANDARD_ERRORS = 2.0
_LONGER = (0.5, 0.7, 1.0, 1.4, 2.0)
_FEWEST_CYCLES, _FEWEST_ACQUISITIONS = 8, 8


@dataclass(frozen=True)
class Answer:
    """What one list gave: the names found or present, and numbers with standard errors."""

    orders: tuple[float, ...]
    trigger_cycles: int
    names: tuple[str, ...]
    numbers: Mapping[str, tuple[Array, Array]]


def lists(machine: Machine, seed: int, count: int) -> list[Machine]:
    """Return the machine with some of its orders, at least half of them, and other cycles."""
    rng = np.random.default_rng([seed, 2])
    most = machine.trigger_cycles * machine.acquisitions // _FEWEST_ACQUISITIONS
    found = []
    for _ in range(count):
        size = int(rng.integers((machine.orders.size + 1) // 2, machine.orders.size + 1))
        cycles = round(rng.choice(_LONGER) * machine.trigger_cycles)
        found.append(replace(machine, orders=rng.permutation(machine.orders)[:size],
                             trigger_cycles=int(np.clip(cycles, _FEWEST_CYCLES, most))))
    return found


def answers(effect: str, seed: int, count: int, folder: Path) -> list[Answer]:
    """Close the loop on one recording under some lists."""
    case = draw_case((effect,), seed)
    machine = replace(case.machine, noise_colour=0.0)
    fields = record(machine, case.what, np.random.default_rng([seed, 1]))
    np.savez(folder / 'machine.npz', **fields)
    found = []
    for item in lists(machine, seed, count):
        (folder / 'model.yaml').write_text(declared(item))
        report = close_loop(folder / 'machine.npz', folder / 'model.yaml').report
        effects = [*report['missing_effects'], *report['present']]
        found.append(Answer(
            tuple(item.orders.tolist()), item.trigger_cycles,
            tuple(sorted(one['name'] for one in effects)),
            {f'{one["name"]}.{name}': (np.array(value['value'], float),
                                       np.array(value['standard_error'], float))
             for one in effects for name, value in one['parameters'].items()
             if value['standard_error'] is not None}))
    return found


def deviations(found: Sequence[Answer]) -> list[str]:
    """Return what each answer has unlike the others, '' for nothing."""
    (names, _), = Counter(item.names for item in found).most_common(1)
    alike = [item for item in found if item.names == names]
    middle = {key: np.median([item.numbers[key][0] for item in alike], axis=0)
              for key in alike[0].numbers}
    rows = []
    for item in found:
        if item.names != names:
            rows.append(f'{"+".join(item.names) or "-"} for {"+".join(names) or "-"}')
            continue
        z = {key: float(np.nanmax(np.abs(value - middle[key]) / error))
             for key, (value, error) in item.numbers.items()}
        rows.append(', '.join(f'{key} by {size:.1f} standard errors' for key, size in z.items()
                              if size > _STANDARD_ERRORS))
    return rows


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the share of lists that agree."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--effects', nargs='+', default=EFFECTS)
    parser.add_argument('--lists', type=int, default=12, help='of each machine')
    parser.add_argument('--first', type=int, default=10_000, help='seed of the first machine')
    options = parser.parse_args(arguments)
    agreed = 0
    for number, effect in enumerate(options.effects):
        with tempfile.TemporaryDirectory() as folder:
            found = answers(effect, options.first + number, options.lists, Path(folder))
        rows = deviations(found)
        agreed += rows.count('')
        print(f'{effect}: {rows.count("")} of {len(rows)} agree', flush=True)
        for item, text in zip(found, rows):
            if text:
                print(f'  {np.round(item.orders, 2).tolist()}, {item.trigger_cycles} trigger '
                      f'cycles: {text}', flush=True)
    print(f'{agreed} of {options.lists * len(options.effects)} lists agree')
    return 0


if __name__ == '__main__':
    sys.exit(main())
