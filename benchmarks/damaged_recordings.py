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
Recordings that are damaged, or declared wrongly, at random, through a command.

    python benchmarks/damaged_recordings.py --count 500 --command close_loop

Each is a machine of `independent_machines` with one to three damages: of its arrays, of the bytes
of its file, or of its declaration. A command must then end with 0 and its results, or with 2, one
line and no results; never with a traceback or a warning of numpy or scipy. Prints what did not;
the exit status is 1 if anything did not.
"""

import argparse
from collections import Counter
from collections.abc import Callable, Sequence
import contextlib
from dataclasses import dataclass, replace
import importlib
import io
from pathlib import Path
import re
import shutil
import sys
import tempfile
import time
import traceback
from typing import Any
import warnings

from independent_effects import draw_case
from independent_machines import declared, record
import numpy as np

Fields = dict[str, Any]
EFFECTS = ('', 'excess_jitter', 'clock_skew', 'target_geometry', 'phase_wander')
ODD_NUMBERS = (0, -1, 1, 2, 1e-300, 1e300, float('nan'), float('inf'), -0.5, 0.3, 7, 1e6, 1e9)
ODD_TEXTS = ('[]', '[1, nan]', 'null', 'true', 'abc', '[1, 2', '1e400', '{a: 1}', '-.inf', '""')


@dataclass
class Case:
    """Fields of a recording, the declared text, and bytes to be changed in the file."""

    fields: Fields
    text: str
    rng: np.random.Generator
    cut: float = 1.0
    flipped: int = 0

    def any_of(self, items: Sequence[Any]) -> Any:
        """Return one of the items."""
        return items[int(self.rng.integers(len(items)))]


def _piece(case: Case, name: str) -> tuple[np.ndarray, slice]:
    """Return a copy of an array, put in its place, and a random piece of its last axis."""
    case.fields[name] = np.array(case.fields[name], float)
    size = case.fields[name].shape[-1]
    begin, end = np.sort(case.rng.integers(0, size + 1, 2))
    return case.fields[name], slice(begin, end)


def _spoil(name: str) -> Callable[[Case], None]:
    """Put a value, or noise, in place of a piece or of single samples."""
    def damage(case: Case) -> None:
        values, piece = _piece(case, name)
        value = case.any_of((np.nan, np.inf, -np.inf, 0.0, 1e300, -1e30, 1e-300))
        if case.rng.uniform() < 0.5:
            values[..., piece] = value
        else:
            values[..., case.rng.integers(0, values.shape[-1], 5)] = value
    return damage


def _reshape(case: Case) -> None:
    name = case.any_of(('vibration', 'pulse_times'))
    values = np.asarray(case.fields[name])
    case.fields[name] = case.any_of((
        values[..., :0], values[..., :1], values[..., :3], values.T, values[np.newaxis],
        values.astype(str), values.astype(complex), values.astype(np.float16),
        np.zeros_like(values), values[..., ::-1], np.asarray(3.0), values.astype(object)))


def _pulses(case: Case) -> None:
    times, piece = _piece(case, 'pulse_times')
    case.fields['pulse_times'] = case.any_of((
        np.delete(times, piece), np.append(times, times), case.rng.permutation(times), 1e3 * times,
        times + 1e9, times - times.mean(), np.repeat(times, 2), times[::2], times[::7],
        np.append(times, case.rng.uniform(times[0], times[-1], 40)), np.full(times.size, times[3]),
        np.arange(times.size), np.round(times, 2), times + case.rng.normal(
            0.0, 0.3 * np.diff(times).mean(), times.size)))


def _field(case: Case) -> None:
    name = case.any_of([key for key in case.fields if np.ndim(case.fields[key]) == 0])
    if case.rng.uniform() < 0.3:
        del case.fields[name]
    else:
        case.fields[name] = case.any_of((*ODD_NUMBERS, 'abc', 3.3 * float(case.fields[name])))


def _without(case: Case) -> None:
    case.fields.pop(case.any_of(list(case.fields)))


def _mildly(case: Case) -> None:
    """Let the electronics of the vibration fail as they do."""
    values, piece = _piece(case, 'vibration')
    size = float(np.std(values))
    channel = int(case.rng.integers(values.shape[0]))
    kind = int(case.rng.integers(7))
    if kind == 0:
        np.clip(values, -size, size, out=values)
    elif kind == 1:
        np.round(values / size * case.any_of((1, 3, 30)), out=values)
    elif kind == 2:
        values[channel] = case.any_of((0.0, 3.0, np.nan))
    elif kind == 3:
        values[..., piece] += case.any_of((10.0, 1e4)) * size
    elif kind == 4:
        values[..., case.rng.integers(0, values.shape[-1], 9)] += 1e3 * size
    elif kind == 5:
        values[..., piece] *= case.any_of((-1.0, 0.1, 10.0))
    else:
        values *= 10.0 ** case.rng.uniform(-30.0, 30.0)


def _number(case: Case) -> None:
    """Declare another value of a parameter."""
    lines = case.text.splitlines()
    at = int(case.rng.integers(2, len(lines)))
    name, _, value = lines[at].partition(': ')
    numbers = [repr(item) for item in ODD_NUMBERS]
    if not value.startswith('['):
        factors = (0.1, 0.5, 0.9, 1.1, 1.5, 2.0, 10.0)
        numbers += [repr(float(value) * factor) for factor in factors] * 6
    lines[at] = f'{name}: {case.any_of((*numbers, *ODD_TEXTS))}'
    case.text = '\n'.join(lines) + '\n'


def _orders(case: Case) -> None:
    """Declare other orders."""
    size = int(case.rng.integers(1, 30))
    orders = case.any_of((case.rng.uniform(0.0, 200.0, size), case.rng.integers(1, 2000, size),
                          10.0 ** case.rng.uniform(-3.0, 6.0, size), [5.0, 5.0], [1e-9]))
    case.text = re.sub(r'orders: .*', f'orders: {[float(item) for item in orders]}', case.text)


def _text(case: Case) -> None:
    """Cut the declaration, or change a letter of it."""
    at = int(case.rng.integers(0, len(case.text)))
    case.text = case.text[:at] + case.any_of(('', chr(int(case.rng.integers(32, 300)))
                                              + case.text[at + 1:]))


def _effect(case: Case) -> None:
    """Declare an effect that is not there, of any size."""
    name, parameter = case.any_of((
        ('excess_jitter', 'std'), ('clock_skew', 'skew'), ('phase_wander', 'std'),
        ('jitter_scale', 'scale'), ('path_delay', 'delay'), ('additive_noise', 'std')))
    case.text += (f'    effects.{name}.enabled: true\n    effects.{name}.{parameter}: '
                  f'{case.any_of((*ODD_NUMBERS, 1e-5, 1e-3))}\n')


def _cut(case: Case) -> None:
    case.cut = float(case.rng.uniform())


def _flip(case: Case) -> None:
    case.flipped = int(case.rng.integers(1, 200))


DAMAGES = (*[_mildly] * 8, *[_number] * 6, *[_orders] * 3, *[_effect] * 3, *[_pulses] * 3,
           *[_spoil('vibration')] * 2, _spoil('pulse_times'), _reshape, _field, _without, _text,
           _cut, _flip)


def draw(seed: int) -> Case:
    """Return a damaged case; a seed gives the same one each time."""
    rng = np.random.default_rng([seed, 38])
    effect = EFFECTS[int(rng.integers(len(EFFECTS)))]
    drawn = draw_case((effect,) if effect else (), seed)
    machine = replace(drawn.machine, acquisitions=min(drawn.machine.acquisitions, 12))
    text = declared(machine).replace('jitter_predictor:', '/**:')
    case = Case(dict(record(machine, drawn.what, rng)), text, rng)
    for _ in range(int(rng.integers(1, 4))):
        with contextlib.suppress(KeyError, ValueError, TypeError, IndexError):  # damaged before
            case.any_of(DAMAGES)(case)
    return case


def write(case: Case, folder: Path) -> None:
    """Write the recording and its declaration."""
    path = folder / 'machine.npz'
    np.savez(path, **case.fields)
    content = bytearray(path.read_bytes())
    for at in case.rng.integers(0, len(content), case.flipped):
        content[at] = int(case.rng.integers(256))
    path.write_bytes(content[:int(case.cut * len(content))])
    (folder / 'model.yaml').write_text(case.text, encoding='utf-8')


def run(command: str, folder: Path) -> tuple[int, str, float]:
    """Run a command on the case; return its exit status, what it said, and its time in s."""
    arguments = [str(folder / 'machine.npz'), '--output', str(folder / 'out'), '--quiet']
    if command != 'check_keyphasor':
        arguments += ['--params', str(folder / 'model.yaml')]
    said = io.StringIO()
    start = time.process_time()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said), \
            warnings.catch_warnings():
        warnings.simplefilter('always')
        try:
            status = importlib.import_module(f'sa_jitter_ros.commands.{command}').main(arguments)
        except SystemExit as stop:
            status = int(stop.code or 0)
        except BaseException:
            if isinstance(sys.exc_info()[1], KeyboardInterrupt):
                raise
            said.write(traceback.format_exc())
            status = -1
    return status, said.getvalue(), time.process_time() - start


def wrong(status: int, said: str, output: Path) -> str:
    """Return what is wrong with an end, '' for nothing."""
    results = sorted(item.name for item in output.rglob('*')) if output.exists() else []
    if 'Traceback' in said or status not in (0, 2):
        return f'status {status}: {said[-600:]}'
    if re.search(r'(Runtime|Deprecation|Future|Optimize|LinAlg|User|Complex)Warning', said):
        return f'a warning of a library: {said[-600:]}'
    if status == 0:
        return '' if results else 'status 0 without results'
    if results:
        return f'status 2 with results: {results}'
    lines = said.strip().splitlines()
    return '' if len(lines) <= 2 and len(lines[-1]) < 600 else f'status 2, long: {said}'


def main(arguments: Sequence[str] | None = None) -> int:
    """Print what ended wrongly."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--count', type=int, default=500)
    parser.add_argument('--first', type=int, default=0, help='first seed')
    parser.add_argument('--command', default='close_loop',
                        choices=['close_loop', 'average', 'check_keyphasor'])
    options = parser.parse_args(arguments)
    counts: Counter[str] = Counter()
    slowest, slow = 0, 0.0
    for seed in range(options.first, options.first + options.count):
        folder = Path(tempfile.mkdtemp())
        write(draw(seed), folder)
        status, said, seconds = run(options.command, folder)
        fault = wrong(status, said, folder / 'out')
        counts['wrong' if fault else f'status {status}'] += 1
        if seconds > slow:
            slowest, slow = seed, seconds
        if fault:
            print(f'seed {seed}: {fault}', flush=True)
        shutil.rmtree(folder)
    print(', '.join(f'{name}: {number}' for name, number in sorted(counts.items()))
          + f'; slowest: seed {slowest}, {slow:.1f} s')
    return int(counts['wrong'] > 0)


if __name__ == '__main__':
    sys.exit(main())
