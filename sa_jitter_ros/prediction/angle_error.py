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
Random errors of the angle law, described so that any of them combine.

An angle law reads cycle ``k`` of a component at a wrong angle ``e_k(u)`` (fundamental cycles;
``u`` in [0, 1) is the position in the trigger cycle). Whatever an average does to order ``g``
follows from the joint characteristic functions of that error,

    E exp(j 2 pi sum_i c_i e_{k_i}(u_i)),    c_i = +g, or -g for a conjugate,

and those of independent errors MULTIPLY. So an effect is one class with one method, and the
moments of any combination are integrals of a product (`moments`). A random gain ``a_k(u)`` fits
too: it contributes E prod_i a_{k_i}(u_i).

A process that can be drawn has one of the methods `draw_pulses`, `draw_angle` and `draw_gain`;
then the distribution of averages of few cycles is sampled (`sampled_distribution`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
import math
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.prediction.distributions import PulseErrorDistribution
from sa_jitter_ros.pulses.angle_law import Covariance, LINEAR, PulseWeights
from scipy.linalg.lapack import dpstrf

_RANK = 1e-9  # variance of what is left out of a drawn process, in parts of its variance


class AngleErrorProcess(Protocol):
    """A zero-mean random angle error that is stationary from trigger cycle to trigger cycle."""

    @property
    def correlation_length(self) -> int:
        """Largest distance in cycles at which two cycles still depend on each other."""

    def characteristic(self, coefficients: Sequence[ArrayLike], positions: Sequence[ArrayLike],
                       cycles: Sequence[int]) -> Array:
        """
        Return E exp(j 2 pi sum_i c_i e_{k_i}(u_i)).

        The three sequences have one entry per point: `coefficients` c_i (orders, arrays),
        `positions` u_i (arrays) and `cycles` k_i (integers); all arrays broadcast together.
        """


@dataclass(frozen=True)
class IndependentPulseJitter:
    """
    Independent pulse errors seen through an angle law, by default the linear one.

    `frequency` is the fundamental frequency in Hz, which turns s into fundamental cycles (1 where
    errors are given in cycles). Neighbouring cycles share pulses. Eq. 16 of Camerini et al. 2019.
    """

    distribution: PulseErrorDistribution
    frequency: float = 1.0
    weights: PulseWeights = LINEAR

    @property
    def correlation_length(self) -> int:
        """Cycles share pulses as far as the weights of the law reach."""
        return self.weights.pulses - 1

    def characteristic(self, coefficients: Sequence[ArrayLike], positions: Sequence[ArrayLike],
                       cycles: Sequence[int]) -> Array:
        """Return the product of the characteristic functions of all pulses that are touched."""
        count = self.weights.pulses
        points = [(self.frequency * np.asarray(c), self.weights.at(np.asarray(u)), k)
                  for c, u, k in zip(coefficients, positions, cycles)]
        product: Array = np.ones(())
        for pulse in sorted({k + i for k in cycles for i in range(count)}):
            weight: Array = np.zeros(())
            for c, at, k in points:
                if k <= pulse < k + count:
                    weight = weight + c * at[pulse - k]
            product = product * self.distribution.characteristic_function(weight)
        return product

    def draw_pulses(self, rng: np.random.Generator, shape: tuple[int, int]) -> Array:
        """Return independent pulse errors (pulse, draw) in fundamental cycles."""
        return self.frequency * self.distribution.draw(rng, shape)

    def pulses_at(self, probability: Array) -> Array:
        """Return the pulse errors in fundamental cycles at these probabilities in (0, 1)."""
        return np.asarray(self.frequency * self.distribution.quantile(probability))


@dataclass(frozen=True)
class GaussianAngleError:
    """
    A Gaussian angle error with ``covariance(u, v, lag)`` = Cov[e_k(u), e_{k+lag}(v)], lag >= 0.

    The covariance is in fundamental cycles squared, vectorised over u and v, and 0 beyond
    `correlation_length` cycles.
    """

    covariance: Covariance
    correlation_length: int

    def draw_angle(self, rng: np.random.Generator, cycles: int, u: Array, count: int) -> Array:
        """Return `count` angle errors (cycle, u, draw) in fundamental cycles, single precision."""
        return drawn_normal(rng, self.covariance, min(self.correlation_length, cycles - 1),
                            cycles, u, count)

    def characteristic(self, coefficients: Sequence[ArrayLike], positions: Sequence[ArrayLike],
                       cycles: Sequence[int]) -> Array:
        """Return exp(-2 pi^2 variance of the weighted sum)."""
        points = [(np.asarray(c), np.asarray(u), k)
                  for c, u, k in zip(coefficients, positions, cycles)]
        variance: Array = np.zeros(())
        for i, (c, u, k) in enumerate(points):
            variance = variance + c**2 * self.covariance(u, u, 0)
            for d, v, m in points[i + 1:]:
                if abs(m - k) <= self.correlation_length:
                    pair = (self.covariance(u, v, m - k) if m >= k
                            else self.covariance(v, u, k - m))
                    variance = variance + 2.0 * c * d * pair
        return np.asarray(np.exp(-2.0 * np.pi**2 * variance))


@dataclass(frozen=True)
class GaussianPulseJitter(GaussianAngleError):
    """
    The Gaussian angle error that correlated normal pulse errors make through an angle law.

    ``autocovariance(lags)`` = Cov[eps_k, eps_{k+lag}] in fundamental cycles squared.
    """

    autocovariance: Callable[[Array], Array]

    @classmethod
    def through(cls, weights: PulseWeights, autocovariance: Callable[[Array], Array],
                correlation_length: int) -> 'GaussianPulseJitter':
        """Return the angle error behind the `weights` of a law."""
        return cls(weights.covariance(autocovariance), correlation_length, autocovariance)

    def draw_pulses(self, rng: np.random.Generator, shape: tuple[int, int]) -> Array:
        """Return pulse errors (pulse, draw) in fundamental cycles, single precision."""
        pulses, count = shape

        def covariance(u: Array, v: Array, lag: int) -> Array:
            return self.autocovariance(np.full(np.broadcast(u, v).shape, lag))

        return drawn_normal(rng, covariance, pulses - 1, pulses, np.zeros(1), count)[:, 0]


def drawn_normal(rng: np.random.Generator, covariance: Covariance, length: int, cycles: int,
                 u: Array, count: int) -> Array:
    """Return `count` draws (cycle, u, draw) of a stationary normal process, single precision."""
    blocks = np.zeros((cycles, u.size, u.size))
    for lag in range(length + 1):
        blocks[lag] = covariance(u[:, None], u, lag)
    factor = _root(blocks.tobytes(), cycles)
    z = rng.standard_normal((factor.shape[1], count), np.float32)
    return np.asarray((factor @ z).reshape(cycles, u.size, count))


@lru_cache(maxsize=4)  # effects are tried with the same numbers again and again
def _root(covariance: bytes, cycles: int) -> NDArray[np.float32]:
    """Return a root (cycle u, n) of a covariance (lag, u, u) of cycles, given by its bytes."""
    values = np.frombuffer(covariance)
    points = math.isqrt(values.size // cycles)
    blocks = values.reshape(cycles, points, points)
    lags = np.arange(cycles) - np.arange(cycles)[:, None]
    both = np.concatenate((blocks, blocks[:0:-1].transpose(0, 2, 1)))  # negative lags count back
    matrix = both[lags].transpose(0, 2, 1, 3).reshape(cycles * points, -1)
    # by pivots, of which a band needs few: eigenvalues of all points would take seconds
    lower, pivots, rank, _ = dpstrf(matrix, tol=_RANK * matrix.max(), lower=1)
    factor = np.empty((len(matrix), rank), np.float32)
    factor[pivots - 1] = np.tril(lower)[:, :rank]
    factor.flags.writeable = False
    return factor


def joint_characteristic(processes: Sequence[AngleErrorProcess], coefficients: Sequence[ArrayLike],
                         positions: Sequence[ArrayLike], cycles: Sequence[int]) -> Array:
    """Return the joint characteristic function of the sum of independent processes."""
    product: Array = np.ones(np.broadcast_shapes(*map(np.shape, (*coefficients, *positions))))
    for process in processes:
        product = product * process.characteristic(coefficients, positions, cycles)
    return product


def pair_characteristic(processes: Sequence[AngleErrorProcess], orders: Array, u: Array, lag: int
                        ) -> Array:
    """
    Return E x conj(y) and E x y of phasors x at places u of a cycle, y of the one `lag` behind.

    They have the shape (2, order, place of x, place of y).
    """
    plane, signs = orders[:, None, None], np.array([-1.0, 1.0])[:, None, None, None]
    return joint_characteristic(processes, [plane, signs * plane], [u[:, None], u], [0, lag])


def angle_spread(processes: Sequence[AngleErrorProcess]) -> float:
    """Return the standard deviation of the angle errors in fundamental cycles, roughly."""
    variance = 0.0
    for process in processes:
        if isinstance(process, IndependentPulseJitter):
            variance += process.frequency**2 * process.distribution.variance
        elif isinstance(process, GaussianAngleError):
            u = np.array([0.0, 0.5])
            variance += float(np.max(process.covariance(u, u, 0)))
    return math.sqrt(variance)


def only_angles(processes: Sequence[AngleErrorProcess]) -> bool:
    """Return whether all processes are angle errors whose spread is known."""
    return all(isinstance(process, (IndependentPulseJitter, GaussianAngleError))
               for process in processes)


@lru_cache(maxsize=64)
def unit_nodes(count: int) -> tuple[Array, Array]:
    """Return nodes and weights of the Gauss-Legendre rule on [0, 1], which are not to change."""
    x, w = np.polynomial.legendre.leggauss(count)
    nodes, weights = 0.5 * (x + 1.0), 0.5 * w
    nodes.flags.writeable = weights.flags.writeable = False
    return nodes, weights
