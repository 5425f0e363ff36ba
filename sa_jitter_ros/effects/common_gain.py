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

import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.effects.effect import ONE_SIDED
from sa_jitter_ros.effects.timing import LARGE
from scipy.optimize import minimize

_LEAST = 0.1  # of the noise: what a line changes by itself at least


@dataclass(frozen=True)
class CommonGain:
    """
    A gain that all orders share.

    `likelihood` is the gain in log likelihood by its power in so many `bands`; `slow` is the
    variance of its means over the cycles of an acquisition, `fast` that within acquisitions, and
    `slow_error` and `fast_error` are their standard errors.
    """

    likelihood: float
    bands: int
    slow: float
    slow_error: float
    fast: float
    fast_error: float


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
    share = 2.0 * counts[1:] / (acquisitions * cycles)
    return CommonGain(
        float(likelihood.sum()), size.size, float(size[0] / cycles), float(error[0] / cycles),
        float(share @ size[1:]), float(np.sqrt(share**2 @ error[1:] ** 2)))


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
