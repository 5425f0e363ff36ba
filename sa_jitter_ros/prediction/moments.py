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
Exact moments of the amplitude of one order in a synchronous average.

The average of a unit component of order ``g`` over ``N_t`` whole trigger cycles is

    X(g) = (1/N_t) sum_k G_k,    G_k = int_0^1 exp(j 2 pi g e_k(u)) du

for any ratio of the shafts. Its moments are integrals of joint characteristic functions of the
angle error, done here by a Gauss-Legendre rule for all orders at once. Neighbouring cycles share a
pulse, so lag 1 belongs in every variance.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.errors import ModelError
from sa_jitter_ros.prediction.angle_error import (
    angle_spread, AngleErrorProcess, joint_characteristic, pair_characteristic, unit_nodes)
from sa_jitter_ros.prediction.distributions import is_number

NODES = 64
_TOGETHER = 16  # orders whose arrays a processor keeps near
_NEAR, _FAR_NODES = 2, 8  # cycles further apart depend on each other smoothly
# Cycles of the order from which on a rule over the square is too coarse; panels of the distance.
_WIDE, _PANEL, _PANELS, _INSIDE = 8.0, 0.15, 1000, 12
#: Noise, in components, from which on none is visible.
MOST_NOISE = 1e9


@dataclass(frozen=True)
class AverageMoments:
    """
    Mean and second central moments of a complex amplitude, one entry per order.

    `variance` = E|X - m|^2 and `pseudo_variance` = E(X - m)^2, which together hold the covariance
    of real and imaginary part.
    """

    mean: Array
    variance: Array
    pseudo_variance: Array

    @property
    def mean_square(self) -> Array:
        """Return E|X|^2."""
        return np.asarray(np.abs(self.mean) ** 2 + self.variance)

    @property
    def real_variance(self) -> Array:
        """Return Var Re X."""
        return np.asarray(0.5 * (self.variance + np.real(self.pseudo_variance)))

    @property
    def imag_variance(self) -> Array:
        """Return Var Im X."""
        return np.asarray(0.5 * (self.variance - np.real(self.pseudo_variance)))

    def of(self, rows: Any) -> 'AverageMoments':
        """Return the moments of some entries, as an index of the arrays picks them."""
        return AverageMoments(self.mean[rows], self.variance[rows], self.pseudo_variance[rows])

    def shifted(self, shift: ArrayLike) -> 'AverageMoments':
        """Return the moments of X + shift."""
        return replace(self, mean=self.mean + np.asarray(shift))

    def with_noise(self, variance: ArrayLike) -> 'AverageMoments':
        """Return the moments of X + n with circular noise of variance E|n|^2."""
        return replace(self, variance=self.variance + np.asarray(variance))


@dataclass(frozen=True)
class CycleMoments:
    """
    Moments of the amplitude G_k of single trigger cycles.

    `mean` has shape (orders,); `variance[l]` = E G_k conj(G_{k+l}) - |m|^2 and
    `pseudo_variance[l]` = E G_k G_{k+l} - m^2 have shape (1 + correlation length, orders). Both
    are exact; lags beyond are 0.
    """

    mean: Array
    variance: Array
    pseudo_variance: Array

    def lag(self, lag: int) -> AverageMoments:
        """Return the moments at one lag, whose variances are covariances between two cycles."""
        return AverageMoments(self.mean, np.real(self.variance[lag]), self.pseudo_variance[lag])

    def averaged(self, trigger_cycles: int) -> AverageMoments:
        """Return the moments of the mean of `trigger_cycles` consecutive cycles."""
        require_cycles(trigger_cycles)
        lags = np.arange(min(len(self.variance), trigger_cycles))
        weight = (trigger_cycles - lags) * np.where(lags == 0, 1.0, 2.0) / trigger_cycles**2
        return AverageMoments(self.mean, weight @ np.real(self.variance[lags]),
                              weight @ self.pseudo_variance[lags])


def cycle_moments(orders: ArrayLike, processes: Sequence[AngleErrorProcess], *, nodes: int = NODES,
                  lags: int | None = None) -> CycleMoments:
    """
    Return the exact moments of single trigger cycles for orders of shape (n,).

    `lags` is the largest lag wanted, by default the correlation length of the processes.
    With 64 nodes they are good to 1e-12 as long as the angle errors stay within a cycle of the
    order, and with 160 up to ten cycles of standard deviation. Beyond, E |G|^2 is good to 1e-4,
    of tables up to 150 cycles; what else is left of the order is less than that of it squared.
    Section 2 of the theory; Eqs. 30-37 of Camerini et al. 2019 as special cases.
    """
    g = require_orders(orders)
    if g.size > _TOGETHER:
        found = [vars(cycle_moments(some, processes, nodes=nodes, lags=lags)).values()
                 for some in np.array_split(g, range(_TOGETHER, g.size, _TOGETHER))]
        return CycleMoments(*(np.concatenate(item, axis=-1) for item in zip(*found)))
    u, w = unit_nodes(nodes)
    mean = joint_characteristic(processes, [g[:, None]], [u], [0]) @ w
    pairs = []
    fine = (u, w, mean)
    rule = unit_nodes(min(nodes, max(_FAR_NODES, nodes // 4)))
    far = (*rule, joint_characteristic(processes, [g[:, None]], [rule[0]], [0]) @ rule[1])
    length = correlation_length(processes)
    for lag in range((length if lags is None else min(lags, length)) + 1):
        u, w, level = fine if lag <= _NEAR else far
        both = pair_characteristic(processes, g, u, lag)
        pairs.append(both @ w @ w - np.stack((np.abs(level) ** 2, level**2)))
    variance, pseudo = np.moveaxis(np.array(pairs), 1, 0)
    spread = g * angle_spread(processes)
    for i in np.flatnonzero(spread > _WIDE):
        variance[0][i] = _mean_square(g[i], spread[i], processes) - np.abs(mean[i]) ** 2
    return CycleMoments(mean, variance, pseudo)


def _mean_square(order: float, spread: float, processes: Sequence[AngleErrorProcess]) -> float:
    """
    Return E |G|^2 under errors of a standard deviation of many cycles of the order.

    Only places that are close in the cycle depend on each other: the integral over their distance
    has narrow panels where it is small.
    """
    edges = np.arange(_PANELS + 1) * (_PANEL / spread)
    far = np.geomspace(edges[-1], 1.0, 1 + math.ceil(max(np.log2(1.0 / edges[-1]), 1.0)))
    edges = np.append(edges, far[1:]) if edges[-1] < 1.0 else np.append(edges[edges < 1.0], 1.0)
    x, w = unit_nodes(_FAR_NODES)
    width = np.diff(edges)
    apart = (edges[:-1, None] + width[:, None] * x).ravel()[:, None]
    weight = (width[:, None] * w).ravel()
    u, inside = unit_nodes(_INSIDE)
    first = u * (1.0 - apart)
    plane = np.full((1, 1), order)
    pairs = joint_characteristic(processes, [plane, -plane], [first, first + apart], [0, 0])
    return float(2.0 * weight @ ((1.0 - apart[:, 0]) * (pairs.real @ inside)))


def noise_line_variance(noise_std: float, sample_rate: float, duration: float) -> float:
    """
    Return E|n|^2 of white noise in the PEAK amplitude of one order of an average of `duration` s.

    `noise_std` is per sample at `sample_rate` Hz: 4 noise_std^2 / (sample_rate duration), half of
    it on each of real and imaginary part (what Eqs. 49 and 50 become in sampled data). Raises
    ModelError for noise that buries every component.
    """
    size = 2.0 * noise_std / math.sqrt(sample_rate * duration)
    if not size < MOST_NOISE:
        raise ModelError(f'noise of {noise_std:.6g} per sample leaves {size:.3g} in each line, '
                         f'not below {MOST_NOISE:g} components: lower it, or average longer')
    return size**2


def correlation_length(processes: Sequence[AngleErrorProcess]) -> int:
    """Return the largest correlation length of the processes in cycles."""
    return max((process.correlation_length for process in processes), default=0)


def require_orders(orders: ArrayLike) -> Array:
    """Return the orders as floats of shape (n,); raise ModelError unless finite and positive."""
    try:
        g = np.atleast_1d(np.asarray(orders, float))
    except (TypeError, ValueError) as error:
        raise ModelError(f'orders hold a value that is no number ({error}): give a list of finite '
                         'orders above 0') from error
    bad = ~(np.isfinite(g) & (g > 0.0))
    if g.ndim != 1 or g.size == 0 or np.any(bad):
        what = f'orders hold {g[bad][0]}' if np.any(bad) else f'orders have the shape {g.shape}'
        raise ModelError(f'{what}: give a list of finite orders above 0')
    return g


def require_cycles(trigger_cycles: int) -> None:
    """Raise ModelError unless an average holds at least one trigger cycle."""
    if not (is_number(trigger_cycles) and trigger_cycles >= 1
            and float(trigger_cycles).is_integer()):
        raise ModelError(f'trigger_cycles is {trigger_cycles}: an average holds a whole number of '
                         'at least 1')
