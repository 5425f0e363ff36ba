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
What the distribution of single pulse errors tells beside their spectrum.

The likelihood of the timing takes all errors for normal. Those of a declared distribution are not,
and normal errors beside them, with or without a memory, round its edges off. Each error is
compared with what the others let expect of it: the declared distribution, widened by the rest,
over a normal one of the same size.
"""

import math

import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.effects.effect import RARE
from sa_jitter_ros.inference.residual import DRAWS
from sa_jitter_ros.inference.timing_data import TimingData
from sa_jitter_ros.inference.timing_fit import TimingFit
from sa_jitter_ros.prediction.distributions import PulseErrorDistribution
from scipy.fft import irfft, rfft
from scipy.special import ndtr

EDGE = 3  # pulses at either end of a stretch that filters do not reach
_CLEAR = 0.2  # of the declared jitter: noise of the recovery that leaves a distribution to see
_SEED = 11


def through(values: Array, gain: Array, data: TimingData) -> Array:
    """Return values (..., pulse) through a filter whose `gain` is given in bins of frequency."""
    count = values.shape[-1]
    transform = rfft(values) * np.interp(
        np.arange(count // 2 + 1) / count, data.frequency, gain)
    transform[..., 0] = 0.0
    return np.asarray(irfft(transform, count))


class Shapes:
    """
    Distributions of single errors that are a declared one, of any size, and normal ones.

    `kurtosis` is that of the declared one beyond a normal one's 3.
    """

    def __init__(self, distribution: PulseErrorDistribution) -> None:
        draws = np.asarray(distribution.draw(np.random.default_rng(_SEED), (DRAWS,)))
        draws = (draws - draws.mean()) / draws.std()
        self.kurtosis = float(np.mean(draws**4)) - 3.0
        self.edges = np.quantile(draws, np.linspace(0.0, 1.0, math.isqrt(DRAWS) + 1))

    def gain(self, fit: TimingFit, errors: list[Array], power: float) -> float:
        """
        Return the log likelihood that the declared distribution gains over a normal one.

        `errors` (pulse,) of each stretch are in units; declared ones have the `power`.
        """
        data = fit.data
        inverse = 1.0 / fit.spectrum[:, 1, 1].real
        mean = float(np.average(inverse, weights=data.size))
        rest = max(1.0 / mean - power, 0.0)
        total = 0.0
        for item, values in zip(data.stretches, errors):
            if item.error_std > _CLEAR * data.unit:
                continue
            usable = item.measured.copy()  # by the others: a missing one tells nothing
            usable[1:] &= item.measured[:-1]
            usable[:-1] &= item.measured[1:]
            beyond = through(values, inverse / mean, data)[usable][EDGE:-EDGE]
            normal = _normal(beyond, 1.0 / mean)
            # the trend that was taken out is known as well as so many errors tell it
            trend = 2.0 / mean / values.size
            shaped = self._density(beyond, math.sqrt(power), math.sqrt(rest + trend))
            # a rare one may be anything
            total += float(np.sum(np.log((1.0 - RARE) * shaped / normal + RARE)))
        return total

    def _density(self, errors: Array, size: float, rest: float) -> Array:
        """Return the density of errors of the declared shape with normal ones beside them."""
        low = size * self.edges[:-1]
        width = np.maximum(size * np.diff(self.edges), 1e-6 * rest)  # a size of 0 is a normal one
        inside = ndtr((errors[:, None] - low) / rest) - ndtr(
            (errors[:, None] - low - width) / rest)
        return np.asarray(np.mean(inside / width, axis=1))


def _normal(errors: Array, variance: float) -> Array:
    density = np.exp(-0.5 * errors**2 / variance) / math.sqrt(2.0 * math.pi * variance)
    return np.maximum(density, np.finfo(np.float64).tiny)  # far from all that is expected
