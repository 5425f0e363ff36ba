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
False alarms of the change monitor, and how soon it finds a growing fault.

`python benchmarks/change_monitor.py` prints the tables of `docs/change_monitor.md`. The averages
of many machines are drawn from their laws, one every ten minutes: amplitudes of orders with
complex noise, indicators with normal and with skewed scatter, and a load that moves the orders.
The last table is of `average --baseline`: one value a day, six weeks long.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, field
import math

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.monitoring.change_test import ChangeTest, memory_of
from sa_jitter_ros.monitoring.monitor import Settings, YEAR

FloatArray = NDArray[np.float64]

INTERVAL = 600.0  # s between averages
MONTH = YEAR / 12.0
SETTINGS = Settings()
#: Groups of averages in a month and in a year.
GROUPS = round(MONTH / INTERVAL / SETTINGS.group_averages)
SCORES_PER_ALARM = YEAR / INTERVAL / SETTINGS.group_averages / SETTINGS.false_alarms_per_year
CHANNELS = 2
#: Amplitudes of orders, their noise, and the relative scatter of indicators: normal, skewed.
AMPLITUDES = {'order, noise 1 %': 1.0, 'order, noise 10 %': 0.1, 'absent order': 0.0}
NOISE = 0.01
INDICATORS = {'indicator, scatter 1 %': 0.01, 'indicator, skewed, scatter 30 %': 0.3}
KINDS = (*AMPLITUDES, *INDICATORS)
_SIX_WEEKS, _BEGIN = 45, 20  # days, and the day on which a fault begins
_SHAPE = 11.0  # of the gamma distribution of skewed indicators: scatter 0.3, skewness 0.6


@dataclass
class Machines:
    """
    Machines with `count` units; each draws groups of averages of its quantities.

    `load` is the relative scatter of a load that moves all amplitudes and remembers `memory`
    averages (1: none). The noise is `noise` times the usual, and the published errors say so.
    """

    count: int
    seed: int
    load: float = 0.0
    memory: float = 1.0
    noise: float = 1.0
    growth: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        """Start without a fault."""
        self._rng = np.random.default_rng(self.seed)
        self.growth = np.zeros((self.count, CHANNELS * len(KINDS)))
        self._load = self._rng.standard_normal((self.count, 1))

    def _loads(self) -> FloatArray:
        """Return the load of a group of averages, (average, unit, 1)."""
        kept = 1.0 - 1.0 / self.memory
        found = []
        for _ in range(SETTINGS.group_averages):
            self._load = kept * self._load + math.sqrt(1.0 - kept**2) * self._rng.standard_normal(
                self._load.shape)
            found.append(self._load)
        return 1.0 + self.load * np.array(found)

    def group(self) -> tuple[FloatArray, FloatArray]:
        """Return the mean of a group of averages (unit, quantity), and its published variance."""
        rng, size = self._rng, SETTINGS.group_averages
        true = np.tile(list(AMPLITUDES.values()), CHANNELS)
        count, noise = len(true), NOISE * self.noise
        loads = self._loads()
        true = true + np.where(true > 0.0, true, NOISE) * self.growth[:, :count]
        shape = (size, self.count, count)
        amplitudes = np.abs(loads * true + noise * (
            rng.standard_normal(shape) + 1j * rng.standard_normal(shape)))
        squares = amplitudes**2 - 2.0 * noise**2
        half = (size, self.count, CHANNELS)
        normal, skewed = INDICATORS.values()
        indicators = np.concatenate((
            self.noise * normal * rng.standard_normal(half),
            np.log(rng.gamma(_SHAPE, 1.0 / _SHAPE, half))), axis=2) + np.log1p(
                self.growth[:, count:])
        values = np.concatenate((squares, indicators), axis=2).mean(axis=0)
        published = np.concatenate((
            4.0 * noise**2 * (np.tile(list(AMPLITUDES.values()), CHANNELS) ** 2 + noise**2),
            np.full(CHANNELS, (self.noise * normal) ** 2),
            np.full(CHANNELS, skewed**2))) / size
        return values, np.broadcast_to(published, values.shape)


class Watch:
    """The test of many machines; `take` draws the next averages and returns who alarms."""

    def __init__(self, machines: Machines) -> None:
        self.machines = machines
        self.test = ChangeTest(machines.growth.shape, learning=SETTINGS.learning_groups)
        self._doubt = np.zeros(machines.growth.shape)
        self._number = 0

    def take(self) -> NDArray[np.bool_]:
        """Return which quantities (unit, quantity) are found changed now, and begin again."""
        values, published = self.machines.group()
        mark = (float(self._number), 0.0)
        self._number += 1
        found, _ = self.test.update(0, values, published, self._doubt, mark, SCORES_PER_ALARM)
        again = found.any(axis=1)
        if again.any():
            self.test.active[again] = False
            self.test.evidence.ratios[:, again] = self.test.evidence.sums[:, again] = 0.0
        return found


@dataclass(frozen=True)
class Case:
    """What machines do that do not change; `later` is the factor of the noise from half time."""

    name: str
    load: float = 0.0
    memory: float = 1.0
    later: float = 1.0


CASES = (
    Case('steady machine'),
    Case('load scatters by 2 %', 0.02),
    Case('load scatters by 2 %, correlated over 10 averages', 0.02, 10.0),
    Case('load scatters by 2 %, correlated over 50 averages', 0.02, 50.0),
    Case('keyphasor exchanged for one with twice the noise', later=2.0),
)


def false_alarms(case: Case, months: int, years: float, seed: int) -> tuple[int, float]:
    """Return the number of false alarms, and the years that machines were watched for."""
    count = max(round(months / 12.0 / years), 1)
    watch = Watch(Machines(count, seed, case.load, case.memory))
    length, found = round(12.0 * years * GROUPS), 0
    for number in range(SETTINGS.learning_groups + length):
        if number == SETTINGS.learning_groups + length // 2:
            watch.machines.noise = case.later
        found += int(watch.take().any(axis=1).sum())
    return found, count * length / (12.0 * GROUPS)


def false_alarm_table(months: int, years: float, seed: int) -> Iterator[str]:
    """Iterate over the lines of the table of false alarms."""
    yield '| machine | months | false alarms | a year |'
    yield '|---|---|---|---|'
    total = [0, 0.0]
    for number, case in enumerate(CASES):
        found, watched = false_alarms(case, months, years, seed + number)
        total = [total[0] + found, total[1] + watched]
        yield _row(case.name, found, watched)
    yield _row('all', int(total[0]), total[1])


def _row(name: str, found: int, years: float) -> str:
    """Return a row of the table of false alarms."""
    return (f'| {name} | {12.0 * years:.0f} | {found} | {found / years:.2f} ± '
            f'{math.sqrt(max(found, 1)) / years:.2f} |')


def detections(count: int, seed: int, months: int = 10
               ) -> Iterator[tuple[str, float, float, bool]]:
    """
    Iterate over faults of machines: kind of quantity, growth a month, days until found, found.

    A fault is in any quantity with equal probability, begins at any time in the second to fourth
    month, and grows linearly, from 1 % to 100 % a month with equal probability of its logarithm. A
    machine whose alarm came before its fault began is left out. An absent order grows in units of
    its noise.
    """
    rng = np.random.default_rng(seed)
    watch = Watch(Machines(count, seed + 1, load=0.01))
    place = rng.integers(0, CHANNELS * len(KINDS), count)
    begin = rng.uniform(1.0, 4.0, count) * GROUPS
    growth = 10.0 ** rng.uniform(-2.0, 0.0, count)
    end, false = np.full(count, math.nan), np.zeros(count, np.bool_)
    unit = np.arange(count)
    for number in range(months * GROUPS):
        watch.machines.growth[unit, place] = growth * np.maximum(number - begin, 0.0) / GROUPS
        found = watch.take()
        alarmed = found.any(axis=1) & np.isnan(end)
        false |= alarmed & (number < begin)
        end[alarmed & found[unit, place]] = number
        if not np.isnan(end[~false]).any():
            break
    names = [*(name for _ in range(CHANNELS) for name in AMPLITUDES),
             *(name for name in INDICATORS for _ in range(CHANNELS))]
    days = (end - begin) / GROUPS * MONTH / 86400.0
    for item in np.flatnonzero(~false).tolist():
        known = bool(np.isfinite(days[item]))
        yield (names[place[item]], float(growth[item]),
               float(days[item]) if known else math.inf, known)


def detection_table(count: int, seed: int) -> Iterator[str]:
    """Iterate over the lines of the table of growing faults."""
    bands = ((0.01, 0.03), (0.03, 0.1), (0.1, 0.3), (0.3, 1.0))
    faults = [*detections(count, seed)]
    yield '| fault in, % a month | ' + ' | '.join(
        f'{100.0 * low:.0f} to {100.0 * high:.0f}' for low, high in bands) + ' |'
    yield '|---|' + '---|' * len(bands)
    for kind in KINDS:
        cells = []
        for low, high in bands:
            some = [(days, growth) for name, growth, days, _ in faults
                    if name == kind and low <= growth < high]
            days = sorted(item[0] for item in some)
            size = sorted(100.0 * item[0] * item[1] * 86400.0 / MONTH for item in some)
            middle = len(some) // 2
            cells.append('' if len(some) < 5 else 'not found' if math.isinf(days[middle]) else
                         f'{days[middle]:.1f}, {size[middle]:.1f}')
        yield f'| {kind} | ' + ' | '.join(cells) + ' |'
    yield ''
    yield (f'{len(faults)} faults, {sum(item[3] for item in faults)} found in the ten months '
           'that were simulated')


def six_weeks(kept: float, learning: int, count: int, seed: int) -> tuple[float, float]:
    """
    Return the share of machines with a false alarm in 45 days, and the days to find a fault.

    There is one value of each quantity a day, which keeps a part of the deviation of the day
    before, half of it with all others. The fault grows from day 20 on in one quantity, by 0.7 of
    its scatter a day.
    """
    rng, shape = np.random.default_rng(seed), (count, 20)
    own, common = rng.standard_normal(shape), rng.standard_normal((count, 1))
    values = np.empty((_SIX_WEEKS, *shape))
    for day in range(_SIX_WEEKS):
        values[day] = math.sqrt(0.5) * (own + common)
        own, common = (kept * item + math.sqrt(1.0 - kept**2) * rng.standard_normal(item.shape)
                       for item in (own, common))
    memory = np.array([memory_of(values[:learning, unit]) for unit in range(count)])[:, None]
    alarmed, days = (
        np.array([*_of_days(values + fault * growth, learning, memory)])
        for fault, growth in ((0.0, 0.0), (0.7, _growth(shape))))
    late = days[_BEGIN + 1:, :, 0]
    return float(alarmed.any(axis=(0, 2)).mean()), float(np.median(
        np.where(late.any(axis=0), 1.0 + late.argmax(axis=0), math.inf)))


def _growth(shape: tuple[int, int]) -> FloatArray:
    """Return days since the fault began (day, unit, quantity), in the first quantity."""
    found = np.zeros((_SIX_WEEKS, *shape))
    found[_BEGIN:, :, 0] = np.arange(_SIX_WEEKS - _BEGIN)[:, None]
    return found


def _of_days(values: FloatArray, learning: int, memory: FloatArray
             ) -> Iterator[NDArray[np.bool_]]:
    """Iterate over what is found changed (unit, quantity) on each day."""
    unknown = np.full(values.shape[1:], np.nan)
    test = ChangeTest(unknown.shape, learning=learning, memory=memory)
    for day, value in enumerate(values):
        yield test.update(0, value, unknown, unknown, (day, day), YEAR / 86400.0)[0]


def six_weeks_table(count: int, seed: int) -> Iterator[str]:
    """Iterate over the lines of the table of a value a day."""
    baselines = (8, 10, 15, 20)
    yield '| correlation of successive days, baseline of | ' + ' | '.join(
        f'{number}' for number in baselines) + ' |'
    yield '|---|' + '---|' * len(baselines)
    for kept in (0.0, 0.3, 0.6):
        cells = [six_weeks(kept, number, count, seed) for number in baselines]
        yield f'| {kept:g} | ' + ' | '.join(
            f'{100.0 * alarms:.0f}, {days:.0f}' for alarms, days in cells) + ' |'


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--months', type=int, default=1000,
                        help='simulated months of each row; 0: no table')
    parser.add_argument('--years', type=float, default=4.0, help='years that a machine runs')
    parser.add_argument('--faults', type=int, default=400, help='growing faults; 0: no table')
    parser.add_argument('--weeks', type=int, default=1000,
                        help='machines with a value a day for six weeks; 0: no table')
    parser.add_argument('--seed', type=int, default=2024)
    options = parser.parse_args()
    if options.months:
        for line in false_alarm_table(options.months, options.years, options.seed):
            print(line, flush=True)
        print()
    if options.faults:
        print('\n'.join(detection_table(options.faults, options.seed)), flush=True)
    if options.weeks:
        print()
        print('\n'.join(six_weeks_table(options.weeks, options.seed)), flush=True)


if __name__ == '__main__':
    main()
