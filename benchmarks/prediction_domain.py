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
Whether predictions hold over their whole domain, against averages that are drawn here.

`python benchmarks/prediction_domain.py` draws settings: keyphasor rates of 1 kHz to 1 GHz, speeds
of 1 to 200 Hz, trigger cycles of 0.01 to 100 fundamental cycles, orders of 0.001 to 100 000, all
distributions and angle laws. Of each it draws averages, in double precision and by formulas of its
own, and compares mean, standard deviation and the ranks of three quantiles.
"""

import argparse
from collections.abc import Iterable
from dataclasses import dataclass
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from page import table
import sa_jitter_ros as sa
from scipy.interpolate import CubicSpline

Array = NDArray[Any]

DISTRIBUTIONS = ('uniform', 'normal', 'triangular', 'table')
LAWS = ('linear', 'quadratic', 'spline')
LEVELS = (0.05, 0.50, 0.95)
WIDTHS = {'uniform': math.sqrt(12.0), 'normal': 8.0, 'triangular': math.sqrt(24.0)}
#: Radians of the order up to which bent laws are integrated here.
MOST_TURN = 60.0
ROUNDING = 2.3e-16  # of an amplitude near 1
_CHUNK = 2_000_000


@dataclass(frozen=True)
class Setting:
    """A declared average; `std` in s is that of a pulse error, `unit` (value,) of a table is 1."""

    speed: float
    cycles: int
    order: float
    ratio: float
    law: str
    distribution: str
    std: float
    unit: tuple[float, ...] = ()

    @property
    def turn(self) -> float:
        """Return the standard deviation of a pulse error in radians of the order."""
        return 2.0 * np.pi * self.order * self.ratio * self.speed * self.std

    def predict(self) -> sa.Prediction:
        """Return the prediction of the package."""
        rate = (1.0 / (WIDTHS['uniform'] * self.std) if self.distribution == 'uniform' else 1e4)
        return sa.predict(
            keyphasor_rate=rate, trigger_speed=self.speed, trigger_cycles=self.cycles,
            orders=[self.order], ratio=self.ratio, angle_law=self.law, jitter_std=self.std,
            jitter_distribution=self.distribution,
            jitter_table=[self.std * value for value in self.unit])

    def draw(self, count: int, rng: np.random.Generator) -> Array:
        """Return X - 1 of as many averages."""
        weights, before = _weights(self.law)
        pulses = self.cycles + before
        places = 1 if self.law == 'linear' else int(12 + 3.0 * self.turn)
        step = max(1, _CHUNK // (pulses * places))
        return np.concatenate([
            _averages(self.turn * self._errors(rng, (min(step, count - i), pulses)), weights,
                      places)
            for i in range(0, count, step)])

    def _errors(self, rng: np.random.Generator, shape: tuple[int, int]) -> Array:
        if self.distribution == 'uniform':
            return np.asarray(np.sqrt(12.0) * (rng.random(shape) - 0.5))
        if self.distribution == 'normal':
            return rng.standard_normal(shape)
        if self.distribution == 'triangular':
            return np.asarray(np.sqrt(6.0) * (rng.random(shape) - rng.random(shape)))
        return np.asarray(rng.choice(self.unit, shape))


@dataclass(frozen=True)
class Difference:
    """Prediction less drawn averages, in standard deviations of the amplitude, and its error."""

    mean: float
    mean_error: float
    std: float
    std_error: float
    ranks: Array

    def is_off(self, count: int) -> bool:
        """Return whether it is more than 4.5 standard errors, and 0.01 or 1 %, off."""
        rank_error = 4.5 * np.sqrt(np.array(LEVELS) * (1.0 - np.array(LEVELS)) / count)
        return bool(abs(self.mean) > 0.01 + 4.5 * self.mean_error
                    or abs(self.std) > 0.01 + 4.5 * self.std_error
                    or np.any(np.abs(self.ranks) > 0.01 + rank_error))


def compare(setting: Setting, count: int, rng: np.random.Generator) -> Difference:
    """Return how far a prediction is from `count` drawn averages."""
    prediction = setting.predict()
    off = setting.draw(count, rng)
    size = (2.0 * off.real + np.abs(off) ** 2) / (np.abs(1.0 + off) + 1.0)  # abs(X) - 1
    spread = size - size.mean()
    std = spread.std()
    if std == 0.0:
        return Difference(0.0, 0.0, 0.0, 0.0, np.zeros(3))
    kurtosis = np.mean(spread**4) / std**4
    ranks = []
    for level, name in zip(LEVELS, ('quantile_05', 'quantile_50', 'quantile_95')):
        at = getattr(prediction, name)[0] - 1.0
        same = 1e-6 * abs(at) + ROUNDING  # which may part equal amplitudes
        low, high = np.mean(size < at - same), np.mean(size <= at + same)
        ranks.append(min(max(level, low), high) - level)
    mean = prediction.mean_attenuation[0] - 1.0 - size.mean()
    return Difference(
        math.copysign(max(abs(mean) - ROUNDING, 0.0), mean) / std, 1.0 / math.sqrt(count),
        prediction.standard_deviation[0] / std - 1.0,
        0.5 * math.sqrt(max(kurtosis - 1.0, 0.0) / count), np.array(ranks))


def draw_setting(rng: np.random.Generator, most_cycles: int = 99) -> Setting:
    """Return a setting from the whole domain whose amplitude is not lost in rounding."""
    while True:
        distribution, law = str(rng.choice(DISTRIBUTIONS)), str(rng.choice(LAWS))
        speed, order = _log(rng, 1.0, 200.0), _log(rng, 1e-3, 1e5)
        unit: tuple[float, ...] = ()
        width = WIDTHS.get(distribution, 0.0)
        if distribution == 'table':
            unit = _unit_table(rng)
            width = float(np.ptp(unit))
        std = min(1.0 / (math.sqrt(12.0) * _log(rng, 1e3, 1e9)), 0.999 / (width * speed))
        found = Setting(speed, int(_log(rng, 1.0, most_cycles + 1.0)), order,
                        _log(rng, 0.01, 100.0), law, distribution, std, unit)
        if 1e-7 < found.turn < MOST_TURN:
            return found


def _unit_table(rng: np.random.Generator) -> tuple[float, ...]:
    """Return a table of two values or many, symmetric or skewed, of standard deviation 1."""
    kind = rng.integers(4)
    if kind == 0:
        values = np.array([-1.0] * int(rng.integers(1, 6)) + [1.0])
    else:
        size = int(rng.integers(3, 400))
        values = (rng.exponential(size=size) if kind == 1 else rng.standard_normal(size)
                  if kind == 2 else rng.integers(0, 6, size).astype(float))
    values = values - values.mean()
    std = values.std()
    return tuple((values / (std if std > 0.0 else 1.0)).tolist())


def _log(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(math.log(low), math.log(high))))


def _weights(law: str) -> tuple[Any, int]:
    """Return the weights of pulses at places in a cycle, and how many pulses a cycle adds."""
    if law == 'linear':
        return None, 1
    if law == 'quadratic':
        return lambda u: np.stack((0.5 * u * (u - 1.0), 1.0 - u**2, 0.5 * u * (u + 1.0))), 2
    spline = CubicSpline(np.arange(18.0), np.eye(18))
    return lambda u: spline(8.0 + u).T, 17


def _averages(angle: Array, weights: Any, places: int) -> Array:
    """Return X - 1 of pulse errors (average, pulse) in radians."""
    if weights is None:
        middle, half = 0.5 * (angle[:, 1:] + angle[:, :-1]), 0.5 * np.diff(angle, axis=1)
        square = half**2
        lost = np.where(square < 1e-3, square / 6.0 * (1.0 - square / 20.0 * (1 - square / 42.0)),
                        1.0 - np.sinc(half / np.pi))
        behind = 2.0 * np.sin(0.5 * middle) ** 2
        real, imag = lost * behind - lost - behind, (1.0 - lost) * np.sin(middle)
        return np.asarray(real.mean(axis=1) + 1j * imag.mean(axis=1))
    x, w = np.polynomial.legendre.leggauss(places)
    matrix = weights(0.5 * (x + 1.0))
    path = np.lib.stride_tricks.sliding_window_view(angle, len(matrix), axis=1) @ matrix
    real, imag = -2.0 * np.sin(0.5 * path) ** 2 @ (0.5 * w), np.sin(path) @ (0.5 * w)
    return np.asarray(real.mean(axis=1) + 1j * imag.mean(axis=1))


def report(differences: Iterable[tuple[Setting, Difference]], count: int) -> str:
    """Return the table of the campaign, a row for each distribution and law."""
    every = list(differences)
    rows = []
    for distribution in DISTRIBUTIONS:
        for law in LAWS:
            some = [item for setting, item in every
                    if (setting.distribution, setting.law) == (distribution, law)]
            if some:
                rows.append((
                    f'{distribution}, {law}', f'{len(some)}',
                    f'{sum(item.is_off(count) for item in some)}',
                    f'{max(abs(item.mean) for item in some):.3f}',
                    f'{max(abs(item.std) for item in some):.3f}',
                    *(f'{worst:.3f}' for worst in np.max(
                        [np.abs(item.ranks) for item in some], axis=0))))
    return table(('pulse errors, law', 'settings', 'off', 'mean (standard deviations)',
                  'standard deviation', '5 %', '50 %', '95 %'), rows)


def main() -> None:
    """Draw settings, compare and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--settings', type=int, default=570)
    parser.add_argument('--draws', type=int, default=20_000)
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--show', action='store_true', help='print the settings that are off')
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    found = []
    for _ in range(options.settings):
        setting = draw_setting(rng)
        found.append((setting, compare(setting, options.draws, rng)))
        if options.show and found[-1][1].is_off(options.draws):
            print(*found[-1], flush=True)
    print(report(found, options.draws))


if __name__ == '__main__':
    main()
