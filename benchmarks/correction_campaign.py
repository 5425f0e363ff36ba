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
Errors of corrected amplitudes over those of raw ones, at every size of noise.

`python benchmarks/correction_campaign.py` prints tables for docs/theory.md. Every trial is one
average of a machine whose true pulses are known: the raw amplitudes, the corrected ones, and those
between the true pulses, all with the same noise. SNR is that of the strongest order in one trigger
cycle, the jitter the standard deviation of its phase in rad.
"""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any
import warnings

import numpy as np
from numpy.typing import NDArray
import sa_jitter_ros as sa

FloatArray = NDArray[np.float64]

PERIOD = 0.04  # s, of a trigger cycle
SAMPLES = 160  # in a fundamental cycle at r >= 1, in a trigger cycle below
#: Peak amplitudes by order, by the number of lines.
LINES = {1: {16.0: 1.0}, 3: {8.0: 0.5, 16.0: 1.0, 32.0: 0.3},
         8: {4.0: 0.2, 8.0: 0.5, 15.0: 0.3, 16.0: 1.0, 17.0: 0.4, 32.0: 0.3, 33.0: 0.1, 40.0: 0.2}}
STRONGEST = 16.0
SNRS = (-10.0, 0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0)
JITTERS = (0.1, 0.3, 0.6)
SPARE = 3  # pulses that the validation may take to learn the interval
#: dB of an order above the noise of the average from which its bias counts.
CLEAR = 20.0


@dataclass(frozen=True)
class Case:
    """
    One machine and average.

    `jitter` in rad of the strongest order, `ratio` is r, `cycles` N_t, `lines` a key of `LINES`,
    `scale` the true over the declared jitter.
    """

    snr: float
    jitter: float = 0.3
    ratio: float = 1.0
    cycles: int = 40
    lines: int = 3
    scale: float = 1.0

    @property
    def noise(self) -> float:
        """Return the standard deviation of the noise of a sample."""
        return float(np.sqrt(self.points / 4.0) * 10.0 ** (-self.snr / 20.0))

    @property
    def points(self) -> int:
        """Return the samples in a trigger cycle."""
        return round(SAMPLES * max(self.ratio, 1.0))


@dataclass(frozen=True)
class Outcome:
    """
    Amplitudes over the true ones (trial, order): `raw`, `corrected`, between the `true` pulses.

    `above` (order,) is how far each order stands above the noise of the average, in dB, and
    `accepted` the share of corrections that were.
    """

    raw: NDArray[np.complex128]
    corrected: NDArray[np.complex128]
    true: NDArray[np.complex128]
    above: FloatArray
    accepted: float

    def mean_square_ratio(self) -> tuple[float, float]:
        """Return the mean square error, corrected over raw, of the worst order, and its error."""
        after, before = (np.abs(values - 1.0) ** 2 for values in (self.corrected, self.raw))
        ratio = after.mean(axis=0) / before.mean(axis=0)
        spread = (after - ratio * before).std(axis=0) / np.sqrt(len(after)) / before.mean(axis=0)
        worst = int(np.argmax(ratio - 2.0 * spread))
        return float(ratio[worst]), float(spread[worst])

    def bias(self) -> tuple[float, float]:
        """Return the largest bias of a clear order, and its error; NaN without a clear one."""
        clear = self.above >= CLEAR
        if not clear.any():
            return np.nan, np.nan
        off = (np.abs(self.corrected) - np.abs(self.true))[:, clear]
        mean, error = off.mean(axis=0), off.std(axis=0) / np.sqrt(len(off))
        worst = int(np.argmax(np.abs(mean) - 2.0 * error))
        return float(mean[worst]), float(error[worst])


def averaged(samples: FloatArray, rate: float, pulses: FloatArray, late: FloatArray, *,
             declared: float, **settings: Any) -> tuple[sa.Average, sa.Average, int]:
    """
    Return the corrected average between `late` pulses, and the one between the true `pulses`.

    `declared` is the standard deviation (s) of the declared jitter. The third result is the number
    of the first pulse.
    """
    settings = {**settings, 'interval_tolerance': 0.45}
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        average, *_ = sa.average(samples, rate, late, correct_jitter=True,
                                 keyphasor_rate=1.0 / (np.sqrt(12.0) * declared), **settings)
        first = int(np.argmin(np.abs(late - average.pulses[0])))
        exact, *_ = sa.average(samples, rate, pulses[first:], **settings)
    return average, exact, first


def trials(case: Case, count: int, seed: int) -> Outcome:
    """Return the amplitudes of `count` averages."""
    rng = np.random.default_rng(seed)
    lines = LINES[case.lines]
    orders, size = np.array(list(lines)), np.array(list(lines.values()))
    speed, rate = case.ratio / PERIOD, case.points / PERIOD
    std = case.jitter / (2.0 * np.pi * STRONGEST * speed)
    length = (case.cycles + 4 + SPARE) * PERIOD
    times = np.arange(round(length * rate)) / rate
    found: dict[str, list[NDArray[np.complex128]]] = {'raw': [], 'corrected': [], 'true': []}
    accepted = 0
    pulses = 2.0 * PERIOD + PERIOD * np.arange(case.cycles + 1.0 + SPARE)
    wave = np.exp(2j * np.pi * np.outer(orders, speed * (times - pulses[0])))
    for _ in range(count):
        phase = np.exp(2j * np.pi * rng.uniform(size=orders.size))
        vibration = (size * phase) @ wave
        samples = vibration.real + case.noise * rng.standard_normal(times.size)
        late = pulses + rng.uniform(-1.0, 1.0, pulses.size) * np.sqrt(3.0) * std
        average, exact, first = averaged(
            samples, rate, pulses, late, declared=std / case.scale, ratio=case.ratio,
            orders=orders, trigger_cycles=case.cycles)
        assert average.correction is not None
        accepted += average.correction.accepted
        raw, corrected = average.amplitudes[0], average.correction.amplitudes[0]
        corrected = np.where(np.isfinite(corrected), corrected, raw)
        shown = {'raw': raw, 'corrected': corrected, 'true': exact.amplitudes[0]}
        for name, values in shown.items():
            found[name].append(values / (size * phase * np.exp(
                2j * np.pi * orders * case.ratio * first)))
    above = case.snr + 20.0 * np.log10(size) + 10.0 * np.log10(case.cycles)
    return Outcome(**{name: np.array(rows) for name, rows in found.items()}, above=above,
                   accepted=accepted / count)


def table(cases: Sequence[tuple[str, Case]], count: int, seed: int) -> Iterator[str]:
    """Iterate over the rows of a table: a case for each SNR of `SNRS`."""
    yield '| | ' + ' | '.join(f'{snr:g} dB' for snr in SNRS) + ' |'
    yield '|' + '---|' * (len(SNRS) + 1)
    for number, (name, case) in enumerate(cases):
        cells = []
        for snr in SNRS:
            outcome = trials(replace(case, snr=snr), count, seed + number)
            ratio, spread = outcome.mean_square_ratio()
            bias, _ = outcome.bias()
            of_bias = '-' if np.isnan(bias) else f'{100.0 * bias:+.1f} %'
            cells.append(f'{ratio:.3f} ± {spread:.3f}, {of_bias}')
        yield f'| {name} | ' + ' | '.join(cells) + ' |'


def all_cases() -> Sequence[tuple[str, Case]]:
    """Return the jitters of the usual machine, and then what differs from it, one by one."""
    usual = Case(0.0)
    return (*((f'jitter {jitter:g} rad', replace(usual, jitter=jitter)) for jitter in JITTERS),
            *((f'r = {ratio:g}', replace(usual, ratio=ratio))
              for ratio in (0.25, 0.5, 2.40789, 4.0)),
            *((f'{cycles} cycles', replace(usual, cycles=cycles)) for cycles in (10, 160)),
            ('1 line', replace(usual, lines=1)), ('8 lines', replace(usual, lines=8)),
            *((f'jitter {scale:g} x the declared', replace(usual, scale=scale))
              for scale in (0.2, 0.5, 2.0, 5.0)))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--trials', type=int, default=60, help='averages in a cell')
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--cases', nargs='*', help='only rows that contain one of these texts')
    options = parser.parse_args()
    chosen = [item for item in all_cases()
              if not options.cases or any(text in item[0] for text in options.cases)]
    for row in table(chosen, options.trials, options.seed):
        print(row, flush=True)


if __name__ == '__main__':
    main()
