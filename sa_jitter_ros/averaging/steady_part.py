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
The steady part of order amplitudes that turn or change from cycle to cycle.

The lines of another shaft leak into the amplitudes of single trigger cycles, and turn there at a
steady rate, the same for all orders. A few cycles do not average them out: their mean holds what
the turns leave, and no interval of normal errors is that of a sine. Such tones are found one by
one by an F test, along the radius of the amplitudes and across it, and fitted together with the
means.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.averaging.synchronous_orders import shares_of_tones
from scipy.fft import rfft
from scipy.special import betainc

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# Cycles from which on a tone in them can be told, and cycles for each of them.
_LEAST_CYCLES, _OF_EACH = 8, 4
_MOST_TONES = 8
# Probability that noise alone passes for a tone.
_FALSE_ALARM = 1e-3
# Share of the scatter of an order below which a tone costs the mean less than to fit it does.
_LEAST_SHARE = 0.25
# Turns of a tone in all cycles, from which on its fit hardly disturbs that of the mean, and by
# which it must differ from a tone that alternates, of which one phase does not show.
_LEAST_TURNS, _LEAST_BESIDE = 2.0, 1.0
_REFINED = 2  # rounds of the search for a rate, each eight times as fine as the one before
_TINY = float(np.finfo(np.float64).tiny)


@dataclass(frozen=True)
class SteadyPart:
    """
    The `mean` (channel, order) of cycles (cycle, channel, order) without their `rates` of tones.

    `cycles` are without them, too, and scatter as much as their noise does. The variance of the
    mean is `inflation` (channel, order) times that of the mean of so many cycles with the variance
    that they show; `lost` (channel, order) degrees of freedom are the tones'. Rates are in turns a
    cycle. What tones hardly disturb keeps its mean.
    """

    mean: ComplexArray
    cycles: ComplexArray
    rates: FloatArray
    inflation: FloatArray
    lost: FloatArray


def steady_part(cycles: ComplexArray) -> SteadyPart:
    """
    Return the steady part of consecutive amplitudes (cycle, channel, order).

    >>> rng = np.random.default_rng(1)
    >>> tone = 0.2 * np.exp(2j * np.pi * 0.23 * np.arange(20))[:, None, None]
    >>> noise = rng.normal(0.0, 1e-3, (20, 1, 3)) + 1j * rng.normal(0.0, 1e-3, (20, 1, 3))
    >>> found = steady_part(1.0 + tone * np.array([1.0, 0.3, 0.1]) + noise)
    >>> found.rates.round(2), bool(abs(found.mean - 1.0).max() < 2e-3)
    (array([0.23]), True)
    """
    count = len(cycles)
    mean = cycles.mean(axis=0)
    rates: FloatArray = np.empty(0)
    if count >= _LEAST_CYCLES:
        turned = cycles * np.exp(-1j * np.angle(mean))
        known = np.isfinite(mean) & (np.ptp(turned.real, axis=0) > 0.0)
        if known.any():
            parts = turned[:, known]
            rates = _rates(np.concatenate((parts.real, parts.imag), axis=1))
    if not rates.size:
        return SteadyPart(mean, cycles, rates, np.ones(mean.shape), np.zeros(mean.shape))
    design = _design(rates, count)
    inverse = np.linalg.inv(design.T @ design)
    fitted = inverse @ (design.T @ cycles.reshape(count, -1))
    tones = (design[:, 1:] @ fitted[1:]).reshape(cycles.shape)
    alone, steady = fitted[0].reshape(mean.shape), cycles - tones
    left, scatter = (np.sum(np.abs(item - about) ** 2, axis=0)
                     for item, about in ((steady, alone), (cycles, mean)))
    disturbed = left < (1.0 - _LEAST_SHARE) * scatter
    unknowns = design.shape[1]
    inflation = count * inverse[0, 0] * (count - 1.0) / (count - unknowns)
    return SteadyPart(
        np.where(disturbed, alone, mean), np.where(disturbed, steady, cycles), rates,
        np.where(disturbed, inflation, 1.0), np.where(disturbed, unknowns - 1.0, 0.0))


def _design(rates: FloatArray, count: int) -> FloatArray:
    """Return columns (cycle, 1 + 2 rates): a constant, and cosine and sine of each rate."""
    turns = 2.0 * np.pi * np.multiply.outer(np.arange(count), rates)
    return np.concatenate((np.ones((count, 1)), np.cos(turns), np.sin(turns)), axis=1)


def _rates(series: FloatArray) -> FloatArray:
    """Return the rates of the tones in series (cycle, column)."""
    count = len(series)
    rates: FloatArray = np.empty(0)
    most = min(_MOST_TONES, count // _OF_EACH - 1)
    while rates.size < most:
        left = _without(series, rates)
        place, chance = _strongest(left, 2 * rates.size)
        within = _LEAST_TURNS / count <= place <= 0.5 - _LEAST_BESIDE / count
        if not (within and chance < _FALSE_ALARM / count
                and _largest_share(left, place) > _LEAST_SHARE):
            break
        rates = np.append(rates, _refined(left, place))
    for i in range(rates.size if rates.size > 1 else 0):
        rates[i] = _refined(_without(series, np.delete(rates, i)), rates[i])
    return rates


def _without(series: FloatArray, rates: FloatArray) -> FloatArray:
    """Return series (cycle, column) without their means and tones."""
    design = _design(rates, len(series))
    return np.asarray(series - design @ np.linalg.solve(design.T @ design, design.T @ series))


def _strongest(series: FloatArray, lost: int) -> tuple[float, float]:
    """Return the rate of the strongest tone in series without means, and its chance in noise."""
    count, columns = series.shape
    rates = np.arange(1, count) / (2.0 * count)
    lines = rfft(series, 2 * count, axis=0)[1:-1]
    shares = shares_of_tones(series, rates, lines)
    place = int(np.argmax(shares))
    freedom = max(count - 3 - lost, 1)
    return float(rates[place]), float(betainc(
        0.5 * columns * freedom, columns, 1.0 - shares[place]))


def _largest_share(series: FloatArray, rate: float) -> float:
    """Return the largest share of the variance of a column that a tone of this rate has."""
    left = _without(series, np.array([rate]))
    return 1.0 - float(np.min(np.sum(left**2, axis=0) / np.maximum(
        np.sum(series**2, axis=0), _TINY)))


def _refined(series: FloatArray, rate: float) -> float:
    """Return the rate near `rate` at which a tone has most of series without means."""
    count = len(series)
    step = 0.5 / count
    for _ in range(_REFINED):
        near = np.clip(rate + np.linspace(-step, step, 17), 0.5 * _LEAST_TURNS / count,
                       0.5 - 0.25 / count)
        waves: ComplexArray = np.exp(-2j * np.pi * np.multiply.outer(near, np.arange(count)))
        rate = float(near[int(np.argmax(shares_of_tones(series, near, waves @ series)))])
        step /= 8.0
    return rate
