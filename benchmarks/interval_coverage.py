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
Shares of published intervals that contain the truth of a simulation.

`python benchmarks/interval_coverage.py` prints the tables of `docs/theory.md` and
`docs/condition_indicators.md`.
The simulation knows no formula of the package: it adds cosines of known amplitude and white noise,
and moves known pulse times by uniform or normal errors.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
import warnings

import numpy as np
from numpy.typing import NDArray
import sa_jitter_ros as sa
from sa_jitter_ros.averaging.indicators import GearSettings, INDICATORS, RunningIndicators
from sa_jitter_ros.averaging.jackknife import WaveformParts
from scipy.signal import lfilter

FloatArray = NDArray[np.float64]

PERIOD, POINTS = 0.04, 160  # s of a trigger cycle, and samples in it
#: Orders of the shaft: three strong ones, one 10 dB above its noise, one that is not there.
STRONG, WEAK, ABSENT = (8.0, 16.0, 32.0), 21.0, 11.0
AMPLITUDES = (0.5, 1.0, 0.3)
#: Orders close to the noise, and how far above it (dB).
CLOSE, LEVELS = (21.0, 11.0, 13.0, 5.0, 27.0), (-10.0, -5.0, 0.0, 5.0, 10.0)
_SPARE = 3  # pulses that the validation may take to learn the interval


@dataclass(frozen=True)
class Case:
    """
    Averages of `cycles` trigger cycles.

    Order 16 stands `above` dB above the noise of the average, and the jitter turns it by `jitter`
    rad (standard deviation), by uniform or `normal` errors; `correct` says whether pulses are
    corrected.
    """

    cycles: int
    above: float
    jitter: float
    normal: bool = False
    correct: bool = True


@dataclass(frozen=True)
class Setting:
    """
    A machine whose corrected amplitudes are asked for, beside what disturbs them.

    Its `orders` have peak amplitudes `size`. The jitter turns the second one by `jitter` rad. With
    `another_shaft`, three harmonics of a random order of amplitudes 0.3 to 0.5 are no orders of
    the shaft, and at least two turns of the average away from one. With `quality`, noise of a
    resonance of this quality factor is within half an order of order 16. White noise of 0.05 is in
    every sample.
    """

    name: str
    cycles: int = 40
    ratio: float = 1.0
    jitter: float = 0.3
    orders: tuple[float, ...] = STRONG
    size: tuple[float, ...] = AMPLITUDES
    another_shaft: bool = False
    quality: float = 0.0

    @property
    def points(self) -> int:
        """Return the samples in a trigger cycle."""
        return round(POINTS * max(self.ratio, 1.0))


#: Orders up to 0.4 of the sampling rate, and their amplitudes.
BAND = (16.0, 40.0, 60.0, 64.0), (0.5, 1.0, 0.4, 0.3)
SETTINGS = (
    Setting('orders 16, 40, 60, 64: 0.1, 0.25, 0.375, 0.4 of the sampling rate',
            orders=BAND[0], size=BAND[1]),
    *(Setting(f'another shaft, N_t {cycles}, r {ratio:g}', cycles, ratio, another_shaft=True)
      for cycles in (12, 40, 120) for ratio in (1.0, 0.3137, 2.40789)),
    *(Setting(f'noise of a resonance, Q {quality:g}', quality=quality)
      for quality in (10.0, 50.0, 200.0)),
    *(Setting(f'jitter {jitter:g} rad', jitter=jitter) for jitter in (0.05, 0.2, 0.5, 1.0)),
    *(Setting(f'r {ratio:g}', ratio=ratio) for ratio in (0.3137, 2.40789)))


@dataclass(frozen=True)
class Coverage:
    """
    Distances over standard errors, by kind of order: `strong`, `weak`, `absent`.

    `amplitude` and `phase` hold arrays of them, `absent` being the real part of the amplitude;
    `upper` holds whether the true amplitude is below the limit. `accepted` is the share of
    accepted corrections, whose averages alone count for corrected values.
    """

    amplitude: dict[str, FloatArray]
    phase: dict[str, FloatArray]
    upper: dict[str, FloatArray]
    accepted: float


def coverage(case: Case, trials: int, seed: int) -> tuple[Coverage, Coverage]:
    """Return the coverage of raw and of corrected values of so many averages."""
    error = 10.0 ** (-case.above / 20.0)
    size = np.array([*AMPLITUDES, np.sqrt(10.0) * error, 0.0])
    found: list[tuple[NDArray[np.complex128], ...]] = []
    for average, turn in averages(case, (*STRONG, WEAK, ABSENT), size, trials, seed):
        row = []
        for source in (average, average.correction or average):
            errors = source.amplitude_errors
            row += [source.amplitudes[0] / turn, errors.amplitude[0], errors.phase[0],
                    errors.upper_95[0]]
        found.append(tuple(row))
    columns = [np.array(item) for item in zip(*found)]
    accepted = np.isfinite(columns[5]).all(axis=1)
    if not accepted.any():
        accepted[:] = True  # NaN
    raw = _coverage(columns[:4], None, size, 1.0)
    return raw, _coverage([item[accepted] for item in columns[4:]], size, size,
                          float(np.isfinite(columns[5]).all(axis=1).mean()))


def averages(case: Case, orders: tuple[float, ...], size: FloatArray, trials: int, seed: int
             ) -> Iterator[tuple[sa.Average, NDArray[np.complex128]]]:
    """Iterate over averages of `orders` of this `size`, and the true phasors of the orders."""
    rng = np.random.default_rng(seed)
    rate = POINTS / PERIOD
    noise = np.sqrt(POINTS * case.cycles / 4.0) * 10.0 ** (-case.above / 20.0)
    std = case.jitter * PERIOD / (2.0 * np.pi * STRONG[1])
    times = np.arange((case.cycles + 4 + _SPARE) * POINTS) / rate
    pulses = PERIOD * (2.0 + np.arange(case.cycles + 1.0 + _SPARE))
    wave = np.exp(2j * np.pi * np.outer(orders, (times - pulses[0]) / PERIOD))
    for _ in range(trials):
        turn = np.exp(2j * np.pi * rng.uniform(size=len(orders)))
        samples = ((size * turn) @ wave).real + noise * rng.standard_normal(times.size)
        late = std * (rng.standard_normal(pulses.size) if case.normal
                      else rng.uniform(-1.0, 1.0, pulses.size) * np.sqrt(3.0))
        with warnings.catch_warnings():
            warnings.simplefilter('ignore')
            average, *_ = sa.average(
                samples, rate, pulses + late, orders=orders, trigger_cycles=case.cycles,
                correct_jitter=case.correct, keyphasor_rate=1.0 / (np.sqrt(12.0) * std),
                interval_tolerance=0.45)
        yield average, turn


def setting_distances(setting: Setting, trials: int, seed: int
                      ) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """
    Return distances over standard errors (average, order) of corrected and of raw amplitudes.

    Those of corrected ones are from the truth, of raw ones from their mean. The third result
    (average, order) says whether the true amplitude is below `upper_95`. Averages whose correction
    is refused are not in them.
    """
    rng = np.random.default_rng(seed)
    size = np.array(setting.size)
    found = []
    for _ in range(trials):
        average = setting_average(setting, rng)
        correction = average.correction
        assert correction is not None
        if correction.accepted:
            errors = correction.amplitude_errors
            found.append((np.abs(correction.amplitudes[0]), errors.amplitude[0],
                          errors.upper_95[0], np.abs(average.amplitudes[0]),
                          average.amplitude_errors.amplitude[0]))
    corrected, error, limit, raw, raw_error = np.array(found).transpose(1, 0, 2)
    return (corrected - size) / error, (raw - raw.mean(axis=0)) / raw_error, limit >= size


def setting_average(setting: Setting, rng: np.random.Generator) -> sa.Average:
    """Return the second corrected average of a setting, which begins anywhere in a revolution."""
    orders, size, cycles = np.array(setting.orders), np.array(setting.size), setting.cycles
    rate, speed = setting.points / PERIOD, setting.ratio / PERIOD
    times = np.arange((2 * cycles + 4 + _SPARE) * setting.points) / rate
    pulses = PERIOD * (2.0 + rng.uniform() / setting.points + np.arange(2.0 * cycles + 1 + _SPARE))
    angle = speed * (times - pulses[0])
    samples = 0.05 * rng.standard_normal(times.size)
    if setting.another_shaft:
        apart = 0.0
        while apart < 2.0 / (cycles * setting.ratio):
            others = rng.uniform(4.0, 15.0) * np.arange(1.0, 4.0)
            apart = float(np.abs(others[:, None] - orders).min())
        orders = np.append(orders, others)
        size = np.append(size, rng.uniform(0.3, 0.5, others.size))
    if setting.quality:
        at = (STRONG[1] + rng.uniform(-0.5, 0.5)) * speed
        pole = np.exp((2j * np.pi - np.pi / setting.quality) * at / rate)
        ringing = lfilter([1.0], np.poly([pole, np.conj(pole)]).real,
                          rng.standard_normal(2 * times.size))[times.size:]
        samples += 0.3 * ringing / ringing.std()
    samples += np.cos(2.0 * np.pi * (np.outer(orders, angle).T + rng.uniform(size=orders.size))
                      ) @ size
    std = setting.jitter / (2.0 * np.pi * setting.orders[1] * speed)
    late = pulses + std * rng.uniform(-1.0, 1.0, pulses.size) * np.sqrt(3.0)
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        _, average, *_ = sa.average(
            samples, rate, late, orders=setting.orders, ratio=setting.ratio,
            trigger_cycles=cycles, correct_jitter=True, interval_tolerance=0.45,
            keyphasor_rate=1.0 / (np.sqrt(12.0) * std))
    return average


def setting_table(trials: int) -> Iterator[str]:
    """Iterate over the lines of the table of `SETTINGS`; orders count together."""
    yield '| | corrections accepted | corrected | below `upper_95` | raw |'
    yield '|' + '---|' * 5
    for number, setting in enumerate(SETTINGS):
        corrected, raw, below = setting_distances(setting, trials, seed=3000 + number)
        yield (f'| {setting.name} | {100.0 * len(corrected) / trials:.0f} % | {shares(corrected)} '
               f'| {100.0 * below.mean():.1f} | {shares(raw)} |')


def _coverage(columns: list[NDArray[np.complex128]], truth: FloatArray | None,
              true: FloatArray, accepted: float) -> Coverage:
    """Return the coverage about a `truth` (order,), or about the mean of all trials."""
    amplitudes, error, phase, upper = columns
    mean = amplitudes.mean(axis=0)
    wanted = np.abs(amplitudes).mean(axis=0) if truth is None else truth
    along = (np.abs(amplitudes) - wanted) / error.real
    across = np.angle(amplitudes * np.conj(mean if truth is None else 1.0)) / phase.real
    below = upper.real >= true
    kinds = {'strong': slice(0, 3), 'weak': slice(3, 4)}
    return Coverage(
        {**{kind: along[:, place].ravel() for kind, place in kinds.items()},
         'absent': amplitudes[:, 4].real / error[:, 4].real},
        {kind: across[:, place].ravel() for kind, place in kinds.items()},
        {**{kind: below[:, place].ravel() for kind, place in kinds.items()},
         'absent': below[:, 4]}, accepted)


def shares(z: FloatArray) -> str:
    """Return the shares in percent of `z` within 1 and within 1.96."""
    return ' / '.join(f'{100.0 * np.mean(np.abs(z) < width):.1f}' for width in (1.0, 1.96))


def amplitude_table(trials: int) -> Iterator[str]:
    """Iterate over the lines of the table of amplitudes and phases."""
    yield ('| N_t | order 16 above the noise, jitter | value | amplitude strong | weak | absent | '
           'phase strong | below `upper_95`: strong | weak | absent |')
    yield '|' + '---|' * 10
    cases = [Case(cycles, above, jitter) for cycles in (5, 10, 20, 40, 160)
             for above, jitter in ((20.0, 0.1), (40.0, 0.3), (40.0, 0.8))]
    cases += [Case(cycles, 40.0, 0.3, normal=True) for cycles in (5, 10, 20, 40)]
    cases += [Case(cycles, 40.0, jitter, correct=False) for cycles in (5, 10, 20)
              for jitter in (0.3, 0.8)]
    for case in cases:
        count = trials if case.cycles < 100 else trials // 3
        pair = coverage(case, count, seed=case.cycles + int(10 * case.jitter))
        for name, item in zip(('raw', 'corrected'), pair):
            if item.accepted < 0.1 or (name == 'corrected' and not case.correct):
                continue
            limits = (f'{100.0 * np.mean(item.upper[kind]):.1f}'
                      for kind in ('strong', 'weak', 'absent'))
            how = ', normal' if case.normal else '' if case.correct else ', not corrected'
            yield (f'| {case.cycles} | {case.above:g} dB, {case.jitter:g} rad{how} | {name} | '
                   + ' | '.join(shares(item.amplitude[kind])
                                for kind in ('strong', 'weak', 'absent'))
                   + f' | {shares(item.phase["strong"])} | ' + ' | '.join(limits) + ' |')


def limit_table(trials: int) -> Iterator[str]:
    """Iterate over the lines of the table of `upper_95` of orders close to the noise."""
    yield '| N_t | value | ' + ' | '.join(f'{level:g} dB' for level in LEVELS) + ' |'
    yield '|' + '---|' * (2 + len(LEVELS))
    for cycles in (5, 10, 40):
        case = Case(cycles, 40.0, 0.3)
        size = np.append(AMPLITUDES, 10.0 ** (0.05 * (np.array(LEVELS) - case.above)))
        limits = np.array([
            [item.amplitude_errors.upper_95[0] for item in (average, average.correction)]
            for average, _ in averages(case, STRONG + CLOSE, size, trials, seed=2000 + cycles)
            if average.correction is not None and average.correction.accepted])
        for name, below in zip(('raw', 'corrected'), (limits >= size).mean(axis=0)):
            yield (f'| {cycles} | {name} | '
                   + ' | '.join(f'{100.0 * share:.1f}' for share in below[len(STRONG):]) + ' |')


def strong_amplitudes(cycles: int, turn: float, uniform: bool, trials: int, seed: int
                      ) -> FloatArray:
    """
    Return mean amplitudes (trial,) of an order without noise, of amplitude 1.

    Independent errors of the pulses turn it by `turn` rad (standard deviation).
    """
    rng = np.random.default_rng(seed)
    draw = (rng.uniform(-np.sqrt(3.0), np.sqrt(3.0), (trials, cycles + 1)) if uniform
            else rng.standard_normal((trials, cycles + 1)))
    nodes, weights = np.polynomial.legendre.leggauss(16)
    u = 0.5 * (nodes + 1.0)
    return np.abs(sum(np.exp(1j * turn * (np.outer(draw[:, k], 1.0 - u)
                                          + np.outer(draw[:, k + 1], u))) @ (0.5 * weights)
                      for k in range(cycles)) / cycles)


def shape_table(trials: int) -> Iterator[str]:
    """
    Iterate over the lines of the table of shapes of the pulse errors.

    It shows how often the mean plus and minus 1 / 1.96 exact standard deviations of one shape
    contains amplitudes of the other one: what a perfect estimate of the size would reach.
    """
    yield ('| N_t | jitter | standard deviation, uniform | normal | uniform errors in intervals '
           'of uniform ones | normal in uniform | normal in normal | uniform in normal |')
    yield '|' + '---|' * 8
    for cycles in (5, 10):
        for turn in (0.3, 0.8, 1.6):
            drawn = [strong_amplitudes(cycles, turn, uniform, trials, seed=1000 + cycles)
                     for uniform in (True, False)]
            z = [(sizes - sizes.mean()) / by.std()
                 for by, order in ((drawn[0], (0, 1)), (drawn[1], (1, 0)))
                 for sizes in (drawn[item] for item in order)]
            yield (f'| {cycles} | {turn:g} rad | '
                   + ' | '.join(f'{sizes.std():.4f}' for sizes in drawn) + ' | '
                   + ' | '.join(map(shares, z)) + ' |')


def indicator_coverage(noise: float, damage: float, cycles: int, channels: int, seed: int
                       ) -> dict[str, FloatArray]:
    """
    Return distances over standard errors of the condition indicators, by their names.

    `channels` channels have white `noise` in each cycle; `damage` is the amplitude of a burst.
    The distance is that from the mean over channels, of the ninth to twelfth average.
    """
    rng, points = np.random.default_rng(seed), 512
    theta = 2.0 * np.pi * np.arange(points) / points
    wave = sum(size * np.cos(order * theta) for order, size in (
        (19, 1.0), (38, 0.5), (18, 0.1), (20, 0.05), (1, 0.2)))
    wave = wave + 3.0 + damage * np.exp(-0.5 * ((theta - 3.0) / 0.1) ** 2) * np.cos(60.0 * theta)
    counts = np.diff(np.round(np.linspace(0.0, cycles, 4)))
    running, z = RunningIndicators(GearSettings([19])), []
    for number in range(12):
        parts = wave + noise * rng.standard_normal((3, channels, points)) / np.sqrt(
            counts[:, None, None])
        running.update(np.tensordot(counts / cycles, parts, axes=1), WaveformParts(counts, parts))
        if number >= 8:
            latest = running.get()
            z.append((latest.values - latest.values.mean(axis=0)) / latest.standard_errors)
    return {name: np.array(z)[..., place].ravel() for place, name in enumerate(INDICATORS)}


def indicator_table(channels: int) -> Iterator[str]:
    """Iterate over the lines of the table of condition indicators."""
    cases = {'noise 0.1': (0.1, 0.0), 'noise 1': (1.0, 0.0), 'noise 0.1, damage': (0.1, 0.5)}
    yield '| indicator | ' + ' | '.join(
        f'{name}, {cycles} cycles' for cycles in (10, 40) for name in cases) + ' |'
    yield '|' + '---|' * (1 + 2 * len(cases))
    columns = [indicator_coverage(*case, cycles, channels, seed=cycles + number)
               for cycles in (10, 40) for number, case in enumerate(cases.values())]
    for name in INDICATORS:
        yield f'| `{name}` | ' + ' | '.join(shares(column[name]) for column in columns) + ' |'


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--trials', type=int, default=900, help='averages of a row; 0: no table')
    parser.add_argument('--indicators', type=int, default=1500, help='channels; 0: no table')
    parser.add_argument('--shapes', type=int, default=20000, help='averages of a row; 0: no table')
    parser.add_argument('--settings', type=int, default=400,
                        help='averages of a setting; 0: no table')
    options = parser.parse_args()
    tables = [(options.settings, setting_table), (options.trials, amplitude_table),
              (options.trials, limit_table), (options.shapes, shape_table),
              (options.indicators, indicator_table)]
    for count, table in tables:
        if count:
            for line in table(count):
                print(line, flush=True)
            print()


if __name__ == '__main__':
    main()
