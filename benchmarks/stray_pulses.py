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
Put strays, doubles and gaps into the pulses of shafts and judge every trigger cycle.

    .venv/bin/python benchmarks/stray_pulses.py

takes about two minutes. One pulse in 24 is spoilt, uniform over the record and the interval. A
trigger cycle is wrong if it is not one true revolution to 0.4 %. The table goes to
docs/reliability.md.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from page import fill, table
from sa_jitter_ros.pulses.trigger_counter import TriggerPulses
from sa_jitter_ros.pulses.validation import PulseValidator
from scipy.ndimage import gaussian_filter1d

FloatArray = NDArray[np.float64]

ROOT = Path(__file__).resolve().parents[1]
SECONDS, POINTS = 6.0, 100_001
WRONG = 4e-3  # of a revolution
JITTER = 2e-6  # s, standard deviation of the errors of all pulses
SPOILT = 24
WHEELS = {
    '1': (1, 0, np.zeros(1)), '4': (4, 0, np.arange(4) / 4.0),
    '4, uneven by 1 % of a revolution': (
        4, 0, np.arange(4) / 4.0 + np.array([0.0, 0.01, -0.012, 0.006])),
    '60': (60, 0, np.arange(60) / 60.0),
    '36-1': (36, 1, np.arange(35) / 36.0), '60-2': (60, 2, np.arange(58) / 60.0)}
#: Speed relative to its mean, of a time (s) and a random generator.
SPEEDS: dict[str, Callable[[FloatArray, np.random.Generator], FloatArray]] = {
    'steady': lambda time, rng: np.ones(time.size),
    'run-up to 2.5 times the speed': lambda time, rng: 0.6 + 0.9 * time / SECONDS,
    'random, 2 % within 50 ms': lambda time, rng: _random(rng, time.size)}
FAULTS = ('stray', 'double', 'displaced', 'missing', 'stray beside missing')


def _random(rng: np.random.Generator, count: int) -> FloatArray:
    noise = gaussian_filter1d(rng.standard_normal(count), 0.05 * POINTS / SECONDS)
    return np.asarray(1.0 + 0.02 * noise / noise.std())


def spoilt(rng: np.random.Generator, pulses: FloatArray, fault: str) -> FloatArray:
    """Return the pulses (n,) with one fault in 24 of them."""
    count = max(pulses.size // SPOILT, 3)
    some = rng.choice(np.arange(1, pulses.size - 2), count, replace=False)
    interval = np.gradient(pulses)[some]
    given, kept, extra = pulses.copy(), np.ones(pulses.size, np.bool_), np.empty(0)
    if fault == 'displaced':
        given[some] += rng.uniform(-0.5, 0.5, count) * interval
    elif fault == 'stray':
        extra = rng.uniform(pulses[0], pulses[-1], count)
    elif fault == 'double':
        extra = pulses[some] + rng.uniform(0.0, 0.5, count) * interval
    else:
        kept[some] = False
        if fault != 'missing':
            extra = pulses[some] + rng.uniform(-1.0, 1.0, count) * interval
    return np.sort(np.append(given[kept], extra))


def judged(seed: int, speed: str, wheel: str, fault: str) -> tuple[int, int, int]:
    """Return the revolutions turned, the trigger cycles found and those that are wrong."""
    teeth, missing, marks = WHEELS[wheel]
    rng = np.random.default_rng([seed, *fault.encode()])
    time = np.linspace(0.0, SECONDS, POINTS)
    rate = (33.3 if teeth == 1 else 12.0) * SPEEDS[speed](time, rng)
    angle = np.append(0.0, np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(time)))
    turns = int(angle[-1]) - 1
    pulses = np.interp((np.arange(turns)[:, None] + marks).ravel(), angle, time)
    pulses += rng.normal(0.0, JITTER, pulses.size)
    validator = PulseValidator(pulses_per_revolution=teeth, missing_teeth=missing)
    found = TriggerPulses.joined([
        validator.update(spoilt(rng, pulses, fault)), validator.flush()])
    turned = np.diff(np.interp(found.times, time, angle))[~found.starts_run[1:]]
    return turns - 1, turned.size, int(np.count_nonzero(np.abs(turned - 1.0) > WRONG))


def run(seeds: int) -> str:
    """Return the table: share of the cycles found, and of those found the wrong ones."""
    rows = []
    for wheel in WHEELS:
        counts = np.zeros((len(FAULTS), 3), np.int64)
        for speed in SPEEDS:
            here = np.array([np.sum([judged(seed, speed, wheel, fault) for seed in range(seeds)],
                                    axis=0) for fault in FAULTS])
            print(' | '.join((speed, wheel, *map(cell, here))), flush=True)
            counts += here
        rows.append((wheel, *map(cell, counts)))
    return table(('marks', *FAULTS), rows)


def cell(counts: NDArray[np.int64]) -> str:
    """Return revolutions, trigger cycles and wrong ones as text."""
    turns, found, wrong = counts
    return f'{found / turns:.0%}' + (f', {wrong} of {found:,}' if wrong else '')


def main() -> None:
    """Judge, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--seeds', type=int, default=4)
    parser.add_argument('--page', type=Path, default=ROOT / 'docs' / 'reliability.md')
    options = parser.parse_args()
    found = run(options.seeds)
    options.page.write_text(fill(options.page.read_text(), {'strays': found}))


if __name__ == '__main__':
    main()
