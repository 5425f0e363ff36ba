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
Slow random motions whose spectrum is flat in a band, and what recovered pulse errors show of them.

Frequencies are in units of the trigger rate, times in trigger cycles.
"""

from functools import lru_cache
import math

import numpy as np
from numpy.typing import ArrayLike
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.prediction.angle_error import unit_nodes
from sa_jitter_ros.pulses.angle_law import Covariance

#: Of what wanders or modulates, as a fraction of the trigger rate: below half of it by definition.
#: It may be slower than any record, as load and temperature are.
SLOW_BAND = (0.0, 0.4)
#: Of an acceleration, which is nearly constant within a trigger cycle.
ACCELERATION_BAND = (0.05, 0.2)

#: Widths of a slow motion's band, over the trigger rate; so low that no average changes in it.
NARROWEST, WIDEST = 1e-4, 0.5

# Of the highest frequency, and cycles, over which a correlation is followed at most.
_PERIODS, _LONGEST = 40.0, 2000
_RULE = unit_nodes(math.ceil(math.tau * _PERIODS))  # twice as many as so many turns take
#: Nodes and weights inside a cycle, enough for what turns once in it.
INSIDE = unit_nodes(20)


def slow_band(bandwidth: float, usual: tuple[float, float] = SLOW_BAND) -> tuple[float, float]:
    """
    Return the band of a slow motion whose highest frequency is `bandwidth`.

    It begins where the `usual` one does, or at 0.4 of the bandwidth where that is lower.

    >>> slow_band(0.01), slow_band(0.3, ACCELERATION_BAND), slow_band(0.1, ACCELERATION_BAND)
    ((0.0, 0.01), (0.05, 0.3), (0.04000000000000001, 0.1))
    """
    return min(usual[0], 0.4 * bandwidth), bandwidth


def slow_memory(trigger_cycles: int, band: tuple[float, float]) -> int:
    """Return the number of cycles over which motions in `band` are followed."""
    return min(_reach(band), trigger_cycles)


def fading(lag: ArrayLike, trigger_cycles: int, band: tuple[float, float]) -> Array:
    """
    Return the factor on correlations at `lag` that lets them end with the memory.

    1 where an average is no longer than the memory, so that they are exact. To cut them off would
    leave power at frequency 0, which no length of an average takes out; to fade them blurs the
    spectrum by 1/60 of its highest frequency, and by 1/3000 of the trigger rate at least.
    """
    reach = _reach(band)
    if trigger_cycles <= reach:
        return np.ones(np.shape(lag))
    return np.asarray(np.exp(-0.5 * (4.0 * np.asarray(lag) / reach) ** 2))


def _reach(band: tuple[float, float]) -> int:
    return int(min(_PERIODS / band[1], _LONGEST))


def flat_band_correlation(lag: ArrayLike, band: tuple[float, float]) -> Array:
    """Return the autocorrelation of a flat spectrum in `band` at `lag`, inverse units."""
    low, high = band
    x = np.asarray(lag, float)
    return np.asarray((high * np.sinc(2.0 * high * x) - low * np.sinc(2.0 * low * x))
                      / (high - low))


def slow_covariance(variance: float, trigger_cycles: int, band: tuple[float, float]) -> Covariance:
    """Return the covariance of a motion of that variance in `band`, which ends with the memory."""
    def covariance(u: Array, v: Array, lag: int) -> Array:
        apart = lag + v - u
        return np.asarray(variance * fading(apart, trigger_cycles, band)
                          * flat_band_correlation(apart, band))
    return covariance


def memory(band: tuple[float, float]) -> float:
    """Return the sum of squared autocorrelations at all lags of a flat spectrum in `band`."""
    return 0.5 / (band[1] - band[0])


def recovered_correlation(lag: ArrayLike, band: tuple[float, float]) -> Array:
    """
    Return the autocovariance, at whole `lag`, of the pulse errors recovered from a unit motion.

    A motion that is fast enough to bend within a cycle pulls the fitted errors a little.
    """
    frequency, weight = even_in(band)
    gain = recovered(frequency, frequency)[:, 0].real ** 2
    return np.asarray(np.cos(2.0 * np.pi * np.multiply.outer(lag, frequency)) @ (weight * gain))


def ripple_of_acceleration(band: tuple[float, float]) -> float:
    """
    Return the standard deviation of the recovered ripple for a unit acceleration.

    It is 1/2, that of a constant one, less what changes within the cycle.
    """
    return math.sqrt(_ripple_covariances(band)[0])


def band_of_ripple(correlation: Array) -> Array:
    """Return the bandwidth of an acceleration whose ripple has a `correlation` of neighbours."""
    widths = np.geomspace(NARROWEST, WIDEST, 200)
    bands = [slow_band(width, ACCELERATION_BAND) for width in widths]
    known = np.array([ripple_correlation(band) for band in bands])
    return np.asarray(np.interp(correlation, known[::-1], widths[::-1]))


def ripple_correlation(band: tuple[float, float]) -> float:
    """Return the correlation of neighbouring ripples that an acceleration in a band makes."""
    variance, neighbours = _ripple_covariances(band)
    return neighbours / variance


@lru_cache(maxsize=1024)
def _ripple_covariances(band: tuple[float, float]) -> tuple[float, float]:
    """Return variance and covariance of neighbours of the ripple of a unit acceleration."""
    frequency, weight = even_in(band)
    gain = np.abs(recovered(frequency, frequency)[:, 1]) / (2.0 * np.pi * frequency) ** 2
    power = weight * gain**2
    return float(power.sum()), float(power @ np.cos(2.0 * np.pi * frequency))


def even_in(band: tuple[float, float]) -> tuple[Array, Array]:
    """Return frequencies in a band and their weights, whose sum is 1."""
    u, weight = _RULE
    return band[0] + (band[1] - band[0]) * u, weight


def recovered_shapes(frequency: Array) -> tuple[Array, Array]:
    """Return the shapes (f, u, 3) that the recovery fits inside a cycle, and their products."""
    u, weight = INSIDE
    z = np.exp(2j * np.pi * frequency)[:, None]
    ripple = np.broadcast_to(u * (1.0 - u), (frequency.size, u.size))
    shapes = np.stack([1.0 - u + u * z, ripple, ripple * (2.0 * u - 1.0)], axis=-1)
    return shapes, np.einsum('fui,u,fuj->fij', shapes.conj(), weight, shapes, optimize=True)


def recovered(frequency: Array, turning: Array) -> Array:
    """
    Return pulse errors, ripples and bends (f, 3) that the recovery fits to exp(2 pi j turning u).

    It fits hats between pulses that turn by `frequency`, and in every cycle a ripple u (1 - u) and
    a bend u (1 - u) (2 u - 1), by least squares.
    """
    shapes, normal = recovered_shapes(frequency)
    wave = INSIDE[1] * np.exp(2j * np.pi * turning[:, None] * INSIDE[0])
    right = np.einsum('fui,fu->fi', shapes.conj(), wave)
    return np.asarray(np.linalg.solve(normal, right[..., None])[..., 0])
