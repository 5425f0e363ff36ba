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
Which orders of a channel are synchronous: coherent from cycle to cycle, and above the noise.

Pulse errors that are already known are first removed from the phases, so that orders which jitter
attenuates completely are found, too. `LineSearch` finds candidates quickly, `significant_orders`
tests them.

The test has a limit. Random vibration of a lightly damped resonance exactly at an order is nearly
as coherent from cycle to cycle as the order, and passes the test more often than its level says
(with a quality factor of 500 at order 19, in 7 % of averages of 100 cycles).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import pi

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.arrays import ComplexArray, FloatArray, IntArray
from sa_jitter_ros.averaging.grid_cycles import cycle_weights, GridCycles
from sa_jitter_ros.averaging.noise import long_run_variance
from sa_jitter_ros.averaging.pulse_error_fit import CompressedCycles
from sa_jitter_ros.pulses.resampling import FULL_BAND
from scipy.ndimage import median_filter

# Probability that noise alone passes as a synchronous order in any of the orders and channels.
_FALSE_ALARM = 1e-3
# Share of the level of that test which an order reaches in a search if it passes the test: the
# windows of the search cost a factor of 1.5, and as much again may be chance.
_FAR_BELOW = 0.3
# Share of an order's power that must be coherent from cycle to cycle.
_COHERENCE = 0.15
_NEIGHBOURHOOD = 41
_MAIN_LOBE = 3
_TINY = float(np.finfo(float).tiny)
_POLE = 1e-8  # lines that are no nearer to a bin: there the lobe is a quotient of two zeros
_CLEAR = 100.0  # times the power of the orders around
# Candidates, over those wanted, whose lines are separated, and how far apart they must be.
_TOGETHER, _APART = 2, 0.02


@dataclass(frozen=True)
class LineSearch:
    """
    Spectra (line, cycle, channel) of some cycles with their `numbers` and `begins` (`GridCycles`).

    `orders` are the integer and the additional ones below 0.4 of the sampling rate.
    """

    spectra: ComplexArray
    orders: FloatArray
    cycle_length: float
    numbers: IntArray
    begins: IntArray

    @classmethod
    def of(cls, grid: GridCycles, cycle_length: float, additional_orders: Sequence[float] = ()
           ) -> 'LineSearch':
        """
        Prepare the search in trigger cycles.

        `additional_orders` are searched besides the integer ones.
        """
        top = FULL_BAND * grid.cycles.shape[1] / cycle_length
        others = [g for g in additional_orders if 0.0 < g <= top]
        orders = np.union1d(np.arange(1.0, int(top) + 1.0), others)
        used = slice(grid.first, grid.first + grid.spectra.shape[1])
        return cls(grid.spectra, orders, cycle_length, grid.numbers[used], grid.begins[used])

    def strongest(self, errors: FloatArray, most: int, *, below: float
                  ) -> tuple[FloatArray, FloatArray]:
        """
        Return the `most` strongest orders up to `below`, and the clear ones among them.

        Clear orders come first, and of those the ones that tell most of pulse errors.

        `errors` (pulse,) of the average, in fundamental cycles, are removed from the phases.
        """
        g = self.orders[self.orders <= below]
        if not len(g):
            return g, g
        series = self._series(errors, g)
        lines = series.sum(axis=1)
        power = np.abs(lines) ** 2
        # With repeated values at the border order 1 could not exceed its background.
        background = np.maximum(np.stack([
            median_filter(row, size=_NEIGHBOURHOOD, mode='reflect')
            for row in np.ascontiguousarray(power.T)], axis=1), _TINY)
        level = np.median(background, axis=0)
        # Where harmonics are dense it is their own level, and less changes from cycle to cycle.
        background = np.minimum(background, _coherent(series)[1] * np.sum(
            cycle_weights(series.shape[1]) ** 2))
        contrast = np.max(power / background, axis=1)
        telling = np.max((g**2)[:, None] * power / level, axis=1)
        telling = np.where(contrast > _CLEAR, telling, 0.0)
        best = np.lexsort((-contrast, -telling))[:_TOGETHER * most]
        # What a strong order shows at its neighbours must not take the room of weaker orders.
        own = np.abs(np.linalg.lstsq(self._shown(errors, g[best]), lines[best], rcond=_APART)[0])
        share = np.minimum(1.0, np.max(
            own**2 / np.maximum(power[best], _TINY), axis=1))
        best = best[np.lexsort((-contrast[best] * share, -telling[best] * share))[:most]]
        return g[best], g[best[contrast[best] > _CLEAR]]

    def plausible(self, errors: FloatArray, g: FloatArray, *, cycles: int) -> NDArray[np.bool_]:
        """
        Return which orders may be significant in all `cycles`, as the searched ones show them.

        What is far below the level of `significant_orders` need not be fitted.
        """
        series = self._series(errors, g)
        power, scatter = _coherent(series)
        limit = significance(len(self.orders) * series.shape[2], cycles)
        return np.asarray((cycles * (power - scatter / series.shape[1])
                           > _FAR_BELOW * limit * scatter).any(axis=1))

    def _shown(self, errors: FloatArray, g: FloatArray) -> ComplexArray:
        """Return what (row) orders show of unit lines at each order (column)."""
        count = self.spectra.shape[1]
        start = self.cycle_length * self.numbers + errors[self.begins]
        apart = g - g[:, None]
        turns = np.exp(2j * pi * np.multiply.outer(apart, start)) @ cycle_weights(count)
        x = apart * self.cycle_length
        lobe = sum(share * (np.sinc(x - shift) + np.sinc(x + shift))
                   for shift, share in enumerate((0.5, 2.0 / 3.0, 1.0 / 6.0)))
        return np.asarray(turns / cycle_weights(count).sum() * np.exp(1j * pi * x) * lobe)

    def gain(self, errors: FloatArray, orders: FloatArray) -> float:
        """
        Return the power of some `orders` without `errors` (pulse,) over their power with them.

        Orders are weighted by their square, as in the fit of the errors. True pulse errors can
        only give a value above 1; without orders it is 1.
        """
        before, after = (_coherent(self._series(item, orders))[0]
                         for item in (0.0 * errors, errors))
        weight = orders[:, None] ** 2 / np.maximum(np.sum(before, axis=0), _TINY)
        known = float(np.sum(weight * before))
        return float(np.sum(weight * after)) / known if known else 1.0

    def _series(self, errors: FloatArray, g: FloatArray) -> ComplexArray:
        """Return the amplitudes (order, cycle, channel), tapered over the cycles."""
        return np.array([np.einsum('bk,bkc->kc', weight, spectra) for weight, spectra in
                         self._lobes(errors, g)]).reshape(-1, *self.spectra.shape[1:])

    def _lobes(self, errors: FloatArray, g: FloatArray
               ) -> Iterator[tuple[ComplexArray, ComplexArray]]:
        """Yield weights (bin, cycle) and bins (bin, cycle, channel) around each order."""
        lines = len(self.spectra)
        angle = self.cycle_length * self.numbers + errors[self.begins]
        longer = errors[self.begins + 1] - errors[self.begins]
        nearest = np.rint(g * self.cycle_length).astype(np.intp)
        x = np.outer(g, self.cycle_length + longer) - nearest[:, None]
        x[np.abs(x - np.rint(x)) < _POLE] += 2.0 * _POLE
        # Hann's lobe 0.5 sin(pi x) / (pi x (1 - x^2)) times exp(-j pi x): the signs that an offset
        # gives to both cancel.
        common = np.exp(-1j * pi * (2.0 * np.outer(g, angle) + x)) * np.sin(pi * x) / (2.0 * pi)
        x = x[:, None] - np.arange(-_MAIN_LOBE, _MAIN_LOBE + 1)[:, None]
        weights = common[:, None] / (x * (1.0 - x) * (1.0 + x))
        for near, weight in zip(nearest.tolist(), weights):
            begin, end = max(near - _MAIN_LOBE, 0), min(near + _MAIN_LOBE + 1, lines)
            shift = _MAIN_LOBE - near
            yield weight[begin + shift:max(end, begin) + shift], self.spectra[begin:end]


def _coherent(series: ComplexArray) -> tuple[FloatArray, FloatArray]:
    """
    Return the power (order, channel) of the mean over cycles, and the variance of the cycles.

    `series` (order, cycle, channel) is tapered over the cycles, which is undone.
    """
    series = series / cycle_weights(series.shape[1])[:, None]
    mean = series.mean(axis=1)
    squares = np.sum(np.abs(series - mean[:, None]) ** 2, axis=1)
    return np.abs(mean) ** 2, np.maximum(squares / (series.shape[1] - 1), _TINY)


def significant_orders(model: CompressedCycles, errors: FloatArray, *, tests: int,
                       least: FloatArray) -> NDArray[np.bool_]:
    """
    Return which orders (row) are above the noise in which channels (column).

    An F test compares the mean amplitude over the cycles, without pulse `errors`, with its
    scatter. Its level is divided by `tests` orders and all channels. Amplitudes below `least`
    (channel,) are not significant. The response of a lightly damped resonance is correlated from
    cycle to cycle, so that its scatter counts with its autocorrelation. This is measured in phase
    with the mean, where pulse errors, which may be correlated too, have no effect to first order.
    """
    count, _, channels = model.coefficients.shape
    response, amplitudes, rest = model.fitted(errors, np.arange(len(model.orders)))
    parts = np.matmul(response.signal.transpose(0, 2, 1), rest)
    parts /= np.sum(response.signal**2, axis=1)[:, :, None]
    deviation = parts[:, :len(amplitudes)] + 1j * parts[:, len(amplitudes):]
    in_phase = (deviation * np.exp(-1j * np.angle(amplitudes))).real
    power = np.abs(amplitudes) ** 2
    scatter = np.sum(np.abs(deviation) ** 2, axis=0) / (count - 1)
    ringing = np.maximum(scatter, 2.0 * long_run_variance(in_phase))
    limit = significance(tests * channels, count)
    return np.asarray((count * power > limit * ringing) & (np.sqrt(power) > least)
                      & (power > _COHERENCE * (power + scatter)))


def significance(tests: int, cycles: int) -> float:
    """Return the level of the F test of one of so many orders and channels."""
    # of 2 and 2 k degrees of freedom the probability above f is (1 + f / k)^-k
    return float((cycles - 1) * np.expm1(np.log(tests / _FALSE_ALARM) / (cycles - 1)))
