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
steady rate. A few cycles do not average them out: their mean holds what the turns leave, and no
interval of normal errors is that of a sine. A line of p orders leaks into order g as two tones: of
p - g orders, and by its negative frequency of -p - g. All orders show the same p, up to whole
turns in a cycle. Lines are looked for one by one, those found are tested together by an F test,
and fitted together with the means.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import fft
from scipy.special import betainc

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# Cycles from which on a line in them can be identifiable, and cycles for each of them.
_LEAST_CYCLES, _OF_EACH = 8, 4
_MOST_LINES = 8
# Probability that noise alone passes for a line.
_FALSE_ALARM = 1e-3
# Share of the scatter of an order below which a line costs the mean less than to fit it does.
_LEAST_SHARE = 0.25
# Turns of a tone in all cycles, from which on its fit hardly disturbs that of the mean or of
# another tone.
_LEAST_TURNS = 2.0
_REFINED = 2  # rounds of the search for a rate, each eight times as fine as the one before
# Turns of a tone in a cycle that are none, and digits of turns in which orders are alike.
_WHOLE, _DIGITS = 1e-9, 9
_TINY = float(np.finfo(np.float64).tiny)


@dataclass(frozen=True)
class SteadyPart:
    """
    The `mean` (channel, order) of cycles (cycle, channel, order) without their `rates` of lines.

    `cycles` are without them, too, and scatter as much as their noise does. The variance of the
    mean is `inflation` (channel, order) times that of the mean of so many cycles with the variance
    that they show; `lost` (channel, order) degrees of freedom are the lines'. Rates are in turns a
    cycle. What lines hardly disturb keeps its mean.
    """

    mean: ComplexArray
    cycles: ComplexArray
    rates: FloatArray
    inflation: FloatArray
    lost: FloatArray


def steady_part(cycles: ComplexArray, turns: FloatArray) -> SteadyPart:
    """
    Return the steady part of consecutive amplitudes (cycle, channel, order).

    `turns` (order,) are those of the orders in a cycle.

    >>> rng = np.random.default_rng(1)
    >>> tone = 0.2 * np.exp(2j * np.pi * 0.23 * np.arange(20))[:, None, None]
    >>> noise = rng.normal(0.0, 1e-3, (20, 1, 3)) + 1j * rng.normal(0.0, 1e-3, (20, 1, 3))
    >>> found = steady_part(1.0 + tone * np.array([1.0, 0.3, 0.1]) + noise, np.arange(1.0, 4.0))
    >>> found.rates.round(2), bool(abs(found.mean - 1.0).max() < 2e-3)
    (array([0.23]), True)
    """
    count, mean = len(cycles), cycles.mean(axis=0)
    inflation, lost = np.ones(mean.shape), np.zeros(mean.shape)
    deviations = cycles - mean
    scatter = np.sum(np.abs(deviations) ** 2, axis=0)
    identifiable = scatter > 0.0  # not those of a silent channel, or NaN
    channels = identifiable.any(axis=1)
    known = np.flatnonzero(identifiable[channels].all(axis=0))
    if count < _LEAST_CYCLES or not channels.any() or not known.size:
        return SteadyPart(mean, cycles, np.empty(0), inflation, lost)
    turns = np.mod(np.round(turns, _DIGITS), 1.0)
    rates = _Lines(deviations[:, channels][..., known], turns[known]).rates()
    steady = cycles.copy()
    for order in known if rates.size else ():
        design = _design(rates, count, turns[order])
        unknowns = design.shape[1]
        inverse = np.linalg.inv(design.conj().T @ design)
        fitted = inverse @ (design.conj().T @ cycles[..., order])
        left = cycles[..., order] - design[:, 1:] @ fitted[1:]
        better = np.sum(np.abs(left - fitted[0]) ** 2, axis=0) < (
            1.0 - _LEAST_SHARE) * scatter[:, order]
        mean[better, order] = fitted[0, better]
        steady[:, better, order] = left[:, better]
        inflation[better, order] = (
            count * inverse[0, 0].real * (count - 1.0) / (count - unknowns))
        lost[better, order] = unknowns - 1.0
    return SteadyPart(mean, steady, rates, inflation, lost)


def _apart(rate: FloatArray, turn: FloatArray) -> FloatArray:
    """Return how far (turns a cycle) tones of these rates are from one another."""
    return np.asarray(np.abs(np.mod(rate - turn + 0.5, 1.0) - 0.5))


def _identifiable(rates: FloatArray, turns: FloatArray, count: int
                  ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """
    Return which tones (rate, order) `count` cycles tell from an order and from each other.

    The first result is that of a line's own frequency, the second of its negative one.
    """
    own, negative = (_apart(sign * rates[:, None], turns) >= _LEAST_TURNS / count
                     for sign in (1.0, -1.0))
    twice = _apart(rates, -rates)[:, None] < 1.0 / count
    return own, negative & ~(own & twice)


def _design(rates: FloatArray, count: int, turn: float) -> ComplexArray:
    """Return columns (cycle, tone): a constant, and what lines of `rates` are in an order."""
    own, negative = _identifiable(rates, np.array([turn]), count)
    tones = np.concatenate(([turn], rates[own[:, 0]], -rates[negative[:, 0]]))
    return np.asarray(np.exp(2j * np.pi * np.multiply.outer(np.arange(count), tones - turn)))


def _sum_of(turns: FloatArray, count: int) -> ComplexArray:
    """Return the sums over the cycles of tones that turn by `turns` in each."""
    slow = _apart(turns, np.zeros(())) < _WHOLE
    half = np.pi * np.where(slow, 0.25, turns)
    sums = np.exp(1j * half * (count - 1)) * np.sin(half * count) / np.sin(half)
    return np.asarray(np.where(slow, count, sums))


class _Lines:
    """Lines in the deviations (cycle, channel, order) of orders that make `turns` in a cycle."""

    def __init__(self, deviations: ComplexArray, turns: FloatArray) -> None:
        self._deviations, self._turns = deviations, turns
        # In this frame an order turns, and a line has one rate in all orders.
        self._frame = np.exp(2j * np.pi * np.multiply.outer(np.arange(len(deviations)), turns)
                             )[:, None]

    def rates(self) -> FloatArray:
        """Return the rates of the lines, in turns a cycle."""
        count = len(self._deviations)
        rates, found = np.empty((2, 0))
        least = np.log(_FALSE_ALARM)
        grid = np.arange(count + 1) / (2.0 * count)
        left = self._deviations
        # Of a few lines in a few cycles each alone may be no more than noise makes.
        while rates.size < min(_MOST_LINES, count // _OF_EACH):
            sums = fft(left * self._frame, 2 * count, axis=0)
            shares = self._shares(left, grid, sums[:count + 1], sums[-np.arange(count + 1)])
            place = _strongest(shares)
            if not np.nanmax(shares[place], initial=0.0) > _LEAST_SHARE:
                break
            rates = np.append(rates, self._refined(left, grid[place]))
            for i in range(rates.size if rates.size > 1 else 0):
                rates[i] = self._refined(self._without(np.delete(rates, i)), rates[i])
            left = self._without(rates)
            chance = self._chance(rates, left) + rates.size * np.log(2.0 * count)
            if chance < least:
                least, found = chance, rates.copy()
        return found

    def _chance(self, rates: FloatArray, left: ComplexArray) -> float:
        """Return the logarithm of the probability that noise has as little `left` as lines."""
        count = len(left)
        unknowns = sum(item.sum(axis=0) for item in _identifiable(rates, self._turns, count))
        share = np.sum(np.abs(left) ** 2, axis=0) / np.maximum(
            np.sum(np.abs(self._deviations) ** 2, axis=0), _TINY)
        freedom = float(len(share) * np.sum(np.maximum(count - 1 - unknowns, 0)))
        lost = float(len(share) * np.sum(unknowns))
        return float(np.log(max(betainc(freedom, lost, float(share.mean())), _TINY)
                            )) if lost and freedom else 0.0

    def _without(self, rates: FloatArray) -> ComplexArray:
        """Return the deviations without their means and lines."""
        if not rates.size:
            return self._deviations
        left = np.empty_like(self._deviations)
        for turn in np.unique(self._turns):
            same = self._turns == turn
            part = self._deviations[..., same]
            design = _design(rates, len(left), turn)
            fitted = np.linalg.lstsq(design, part.reshape(len(left), -1), rcond=None)[0]
            left[..., same] = part - (design @ fitted).reshape(part.shape)
        return left

    def _shares(self, left: ComplexArray, rates: FloatArray, own: ComplexArray,
                negative: ComplexArray) -> FloatArray:
        """
        Return the shares (rate, channel, order) that lines of these rates have of deviations.

        `own` and `negative` (rate, channel, order) are Fourier sums in the frame of the lines, at
        the rates and at their negative. NaN where the cycles do not tell a line from the order.
        """
        count, whole = len(left), np.maximum(np.sum(np.abs(left) ** 2, axis=0), _TINY)
        shown = [item[:, None] for item in _identifiable(rates, self._turns, count)]
        mean_own, mean_negative = (_sum_of(self._turns - sign * rates[:, None], count)
                                   for sign in (1.0, -1.0))
        # Tones without their means, multiplied with one another.
        first, second = (np.where(item, count - np.abs(mean[:, None]) ** 2 / count, 1.0)
                         for item, mean in zip(shown, (mean_own, mean_negative)))
        both = (_sum_of(-2.0 * rates, count)[:, None]
                - mean_own * np.conj(mean_negative) / count)[:, None]
        both = np.where(shown[0] & shown[1], both, 0.0)
        own, negative = np.where(shown[0], own, 0.0), np.where(shown[1], negative, 0.0)
        power = (second * np.abs(own) ** 2 + first * np.abs(negative) ** 2
                 - 2.0 * (np.conj(own) * both * negative).real
                 ) / (first * second - np.abs(both) ** 2)
        return np.where(shown[0] | shown[1], np.minimum(power / whole, 1.0), np.nan)

    def _refined(self, left: ComplexArray, rate: float) -> float:
        """Return the rate near `rate` at which a line has most of deviations without means."""
        count = len(left)
        flat, step = (left * self._frame).reshape(count, -1), 0.5 / count
        for _ in range(_REFINED):
            near = rate + np.linspace(-step, step, 17)
            waves = np.exp(-2j * np.pi * np.multiply.outer(near, np.arange(count)))
            own, negative = ((item @ flat).reshape(-1, *left.shape[1:])
                             for item in (waves, np.conj(waves)))
            rate = float(near[_strongest(self._shares(left, near, own, negative))])
            step /= 8.0
        return rate


def _strongest(shares: FloatArray) -> int:
    """Return the place of the line that has most of the deviations, of shares (rate, ...)."""
    flat = shares.reshape(len(shares), -1)
    return int(np.argmax(np.nansum(flat, axis=1)))
