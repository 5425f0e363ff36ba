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
The likelihood of a gain that all orders share, from the amplitudes of single trigger cycles.

The spectra of the orders are normal (Whittle). In each octave of frequency, and in the averages,
each order changes by itself as much as it likes, and the common gain has a power of its own. One
order alone changes by itself as noise does, by the power of the highest octave in all of them.
"""

from dataclasses import dataclass
import math

import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.effects.band import NARROWEST, WIDEST
from sa_jitter_ros.effects.effect import ONE_SIDED
from sa_jitter_ros.effects.timing import LARGE
from scipy import linalg, special
from scipy.optimize import minimize

_LEAST = 0.1  # of the noise: what a line changes by itself at least
_WIDER = 5.0  # than all that is there, or smaller, is the gain at most
_TRIED, _ROUNDS = 80, 4  # sizes and widths, closer to what is likely each time
_LONGEST = 1000  # cycles whose ordinates are compared one by one


@dataclass(frozen=True)
class CommonGain:
    """
    A gain that all orders share.

    `likelihood` is the gain in log likelihood by its power. `powers` (octave,) are the means over
    the ordinates of windows of so many `cycles`, of which `first` (octave,) begin the octaves;
    `errors` (octave,) are their standard errors, `counts` (ordinate,) the numbers of ordinates.
    """

    likelihood: float
    powers: Array
    errors: Array
    cycles: int
    first: Array
    counts: Array

    def size_and_width(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """
        Return standard deviation and bandwidth of the gain, each with its standard error.

        They are means and standard deviations over all sizes and widths of a flat band, which are
        as likely as the octaves are with them and the noise that their errors show (Whittle).
        """
        counts = np.add.reduceat(self.counts, self.first)
        noise = np.maximum(self.errors * np.sqrt(counts) - self.powers, _LEAST * self.powers)
        total = math.sqrt(float(self.powers @ counts) / float(np.sum(counts)))
        sizes, widths, share = (total / _WIDER, total * _WIDER), (NARROWEST, WIDEST), 1.0
        for _ in range(_ROUNDS):
            tried, width = np.geomspace(*sizes, _TRIED), np.geomspace(*widths, _TRIED)
            shown = np.add.reduceat(self.counts * ordinates_of_band(width, self.cycles),
                                    self.first, axis=1) / counts
            expected = tried[:, None, None] ** 2 * shown + noise
            value = -share * np.sum(counts * (
                np.log(expected) + (self.powers + noise) / expected), axis=2)
            likely = np.exp(value - value.max())
            likely /= likely.sum()
            std = _moments(tried, likely.sum(axis=1))
            bandwidth = _moments(width, likely.sum(axis=0))
            sizes, widths = _closer(tried, std), _closer(width, bandwidth)
            # a gain that is slower than the windows is the same in several of them
            share = min(1.0, 2.0 * bandwidth[0] * self.cycles) / self._dependence(
                std[0], bandwidth[0], noise)
        return std, bandwidth

    def _dependence(self, std: float, bandwidth: float, noise: Array) -> float:
        """Return how many ordinates are one independent one: a slow gain leaks into all."""
        each = np.repeat(noise, np.diff([*self.first, self.counts.size]))[:_LONGEST // 2]
        cycles = min(self.cycles, _LONGEST)  # of which as narrow a band leaks alike
        width = min(bandwidth * self.cycles / cycles, WIDEST)
        lagged = std**2 * correlations(np.array([width]), cycles)[0]
        waves = np.fft.ifft(np.fft.rfft(linalg.toeplitz(lagged), axis=0), axis=1)
        both = np.abs(waves[:each.size, :each.size] + np.diag(each)) ** 2
        scale = np.sqrt(np.diag(both))
        return float(np.sum(both / np.outer(scale, scale))) / each.size


def _moments(values: Array, weight: Array) -> tuple[float, float]:
    """Return mean and standard deviation."""
    mean = float(values @ weight)
    return mean, math.sqrt(float((values - mean) ** 2 @ weight))


def _closer(values: Array, found: tuple[float, float]) -> tuple[float, float]:
    """Return the range of `values` that is likely, and as far as they do not tell."""
    away = 5.0 * found[1] + 2.0 * found[0] * (values[1] / values[0] - 1.0)
    return max(values[0], found[0] - away), min(values[-1], found[0] + away)


def correlations(widths: Array, cycles: int) -> Array:
    """
    Return the autocorrelation (width, lag) of the means in cycles of unit gains.

    The gains have flat spectra from 0 up to the `widths`, in cycles a trigger cycle.
    """
    rate, lag = 2.0 * np.pi * widths[:, None], np.arange(-1.0, cycles + 1.0)
    # the second integral of that of the gains
    twice = (lag * special.sici(rate * lag)[0] + (np.cos(rate * lag) - 1.0) / rate) / rate
    return np.asarray(np.diff(twice, 2))


def ordinates_of_band(widths: Array, cycles: int) -> Array:
    """Return the mean power of the ordinates (width, ordinate) of such gains."""
    weighted = correlations(widths, cycles) * (1.0 - np.arange(cycles) / cycles)
    return np.asarray(2.0 * np.fft.rfft(weighted).real - weighted[:, :1])


def fit_common_gain(radial: Array, noise: Array) -> CommonGain:
    """
    Fit `radial` (acquisition, cycle, order), relative amplitudes less 1.

    `noise` (order,) is about their standard deviation by noise.
    """
    acquisitions, cycles, _ = radial.shape
    waves = np.fft.rfft(radial / noise, axis=1) / np.sqrt(cycles)
    waves[:, 0] -= waves[:, 0].mean(axis=0)  # the levels are free
    power = np.einsum('afl,afm->flm', waves, waves.conj()).real
    count = np.full(len(power), float(acquisitions))
    count[0] = 0.5 * (acquisitions - 1)
    power[0] *= 0.5
    if cycles % 2 == 0:
        count[-1] *= 0.5
        power[-1] *= 0.5
    edges = [0, *(2**k for k in range(len(power).bit_length()) if 2**k < len(power))]
    counts, powers = (np.add.reduceat(item, edges, axis=0) for item in (count, power))
    if noise.size == 1:
        likelihood, size, error = _above_noise(powers[:, 0, 0] * noise**2, counts)
    else:
        likelihood, size, error = np.array([
            _shared(own / number, number, 1.0 / noise) for own, number in zip(powers, counts)]).T
    return CommonGain(float(likelihood.sum()), size, error, cycles, np.array(edges), count)


def _above_noise(powers: Array, counts: Array) -> tuple[Array, Array, Array]:
    """
    Return the log likelihood that a gain of one order adds, its powers and their standard errors.

    `powers` (octave,) are sums of `counts` ordinates. A slow gain has no more power in an octave
    than in those below, but by chance, and none in the highest, which shows the noise alone; what
    is more is a line beside the order.
    """
    own = powers / counts
    least = own.copy()
    for octave, number in enumerate(np.cumsum(counts)[:-1], 1):
        below = np.average(least[:octave], weights=counts[:octave])
        least[octave] = min(own[octave], below * (1.0 + ONE_SIDED / np.sqrt(number)))
    more = least > least[-1]
    noise = np.average(least, weights=counts * ~more)
    equal = counts * (own == least)
    likelihood = equal * np.log(np.average(least, weights=equal) / np.where(more, least, noise))
    error = np.hypot(least / np.sqrt(counts), noise / np.sqrt(np.sum(counts, where=~more)))
    return likelihood, np.where(more, least - noise, 0.0), error


def _shared(power: Array, count: float, gain: Array) -> tuple[float, float, float]:
    """
    Return the log likelihood that a common gain adds, its power and its standard error.

    `power` (order, order) is the mean of `count` ordinates, `gain` (order,) what a unit of the
    common gain makes of each order.
    """
    each = np.diag(power)
    alone = np.maximum(each, _LEAST)
    others = np.outer(gain, gain) * (1.0 - np.eye(gain.size))
    start = max(float(np.sum(others * power) / np.sum(others**2)), 1e-3 / float(gain @ gain))

    def cost(logs: Array) -> tuple[float, Array]:
        own, size = np.exp(logs[:-1]), np.exp(logs[-1])
        along = gain / own
        strength = gain @ along
        # the inverse of own + size gain gain' is 1 / own - fall along along'
        fall = size / (1.0 + size * strength)
        seen = power @ along
        both = along @ seen
        value = np.sum(np.log(own) + each / own) + np.log1p(size * strength) - fall * both
        by_own = 1.0 - each / own + own * along * (
            fall * (2.0 * seen / own - along) - fall**2 * both * along)
        by_size = size * (strength * (1.0 - fall * strength) - both * (1.0 - fall * strength) ** 2)
        return count * float(value), count * np.append(by_own, by_size)

    first = np.append(np.log(np.maximum(each - gain**2 * start, 0.5 * alone)), np.log(start))
    bounds = [*[(np.log(_LEAST), LARGE)] * gain.size, (-LARGE, LARGE)]
    found = minimize(cost, first, method='L-BFGS-B', jac=True, bounds=bounds)
    own, size = np.exp(found.x[:-1]), float(np.exp(found.x[-1]))
    without = count * float(np.sum(np.log(alone) + each / alone))
    inverse = np.linalg.inv(np.diag(own) + size * np.outer(gain, gain))
    strength = inverse @ gain
    information = count * np.block([[inverse**2, strength[:, None] ** 2],
                                    [strength**2, (gain @ strength) ** 2]])
    error = float(np.sqrt(max(np.linalg.pinv(information)[-1, -1], 0.0)))
    return max(without - float(found.fun), 0.0), size, error
