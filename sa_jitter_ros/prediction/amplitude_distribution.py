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
The distribution of the amplitude |X| from the moments of the complex amplitude X, for all orders.

The curved distribution adds to the normal one of X what the central limit theorem leaves out at
order 1/sqrt(N_t): timing errors that turn X also shorten it, so X lies along an arc, and its
radial part is skewed. Both follow from the third cumulants. At N_t = 20 the distribution function
of a normal X is up to 0.06 off, the curved one 0.006 (symmetric jitter).
"""

from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sa_jitter_ros.prediction.angle_error import unit_nodes
from sa_jitter_ros.prediction.moments import AverageMoments
from sa_jitter_ros.prediction.sampled_distribution import require_probabilities
from scipy.special import ndtr, ndtri

Array = NDArray[Any]

_REACH = 8.5  # standard deviations; 2e-17 of a normal distribution lies outside
_AXIS, _AXIS_WEIGHTS = np.polynomial.legendre.leggauss(48)  # 1e-9 of a distribution function
_HERMITE, _HERMITE_WEIGHTS = np.polynomial.hermite_e.hermegauss(32)  # 1e-5 of Var|X|, kinks apart
_HERMITE_PAIRS = (np.multiply.outer(_HERMITE_WEIGHTS, _HERMITE_WEIGHTS)
                  / _HERMITE_WEIGHTS.sum() ** 2)
_UNIT, _UNIT_WEIGHTS = unit_nodes(64)  # of amplitudes from 0 to the largest
_MAXIMAL_SKEW = 2.0  # that of an exponential variable
_GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)  # the step that spreads points most evenly
_ROOT_STEPS = 60  # bisection alone takes 50 to the last digit
_ROOT_TOLERANCE = 1e-9  # of probability


@dataclass(frozen=True)
class AmplitudeDistribution:
    """
    The distribution of |X|, X = along + j across, one entry per order.

    across = mean_across + std_across Z and along = mean_along + slope (across - mean_across) +
    bend ((across - mean_across)^2 - std_across^2) + std_along T, with Z normal and T of unit
    variance and skewness `skew`: Wilson and Hilferty's cube of a normal variable, a gamma variable
    to 1e-3. X is normal, exactly, where bend and skew are 0.
    """

    mean_along: Array
    mean_across: Array
    std_along: Array
    std_across: Array
    slope: Array
    bend: Array
    skew: Array

    @property
    def mean_square(self) -> Array:
        """Return E|X|^2, exact."""
        return np.asarray(self.mean_along**2 + self.mean_across**2 + self._swing**2
                          + self.std_across**2)

    @property
    def _swing(self) -> Array:
        """Return the standard deviation of the part along."""
        return np.asarray(np.sqrt(self.std_along**2 + (self.slope * self.std_across) ** 2
                                  + 2.0 * (self.bend * self.std_across**2) ** 2))

    @cached_property
    def variance(self) -> Array:
        """Return Var|X|."""
        across = self.mean_across[:, None] + self.std_across[:, None] * _HERMITE
        along = self.std_along[:, None] * _lopsided(_HERMITE, self.skew[:, None])
        amplitude = np.hypot(self._ridge(across)[:, :, None] + along[:, None, :],
                             across[:, :, None])
        mean = np.sum(amplitude * _HERMITE_PAIRS, axis=(1, 2))
        variance = np.sum((amplitude - mean[:, None, None]) ** 2 * _HERMITE_PAIRS, axis=(1, 2))
        cusp = ((np.abs(self.mean_along) < 6.0 * self._swing)  # the kink at 0 needs more
                & (np.abs(self.mean_across) < 6.0 * self.std_across))
        if np.any(cusp):
            top = ((1.0 + _REACH) * np.sqrt(self.mean_square))[cusp, None]
            y = top * _UNIT
            tail = top * _UNIT_WEIGHTS * (1.0 - self._rows(cusp).cdf(y))
            mean = tail.sum(axis=1)
            variance[cusp] = mean**2 + 2.0 * np.sum((y - mean[:, None]) * tail, axis=1)
        return np.asarray(variance)

    @cached_property
    def mean(self) -> Array:
        """Return E|X|, so that mean^2 + variance = E|X|^2."""
        return np.asarray(np.sqrt(np.maximum(self.mean_square - self.variance, 0.0)))

    def cdf(self, amplitude: ArrayLike) -> Array:
        """Return P(|X| <= amplitude), (orders, k) for amplitudes of shape (k,) or (orders, k)."""
        y = np.maximum(np.atleast_2d(np.asarray(amplitude, float)), 0.0)
        y = np.broadcast_to(y, (self.mean_along.size, y.shape[-1]))
        if np.any(self.slope) or np.any(self.bend) or np.any(self.skew):
            return self._curved_cdf(y)
        return self._normal_cdf(y)

    def ppf(self, probability: ArrayLike) -> Array:
        """
        Return quantiles of |X|, shape (orders, k) for k probabilities in (0, 1).

        Raises ParameterError for a probability outside (0, 1).
        """
        p, low, high = quantile_bracket(self.mean, self.variance, probability)
        return increasing_root(lambda y: self.cdf(y) - p, low, high)

    def spread(self, count: int) -> Array:
        """Return evenly spread, equally likely values of |X|, shape (orders, count)."""
        index = np.arange(count)  # a lattice of the golden ratio
        z = ndtri(np.array([(index + 0.5) / count, (0.5 + index * _GOLDEN) % 1.0]))
        across = self.mean_across[:, None] + self.std_across[:, None] * z[0]
        along = self.std_along[:, None] * _lopsided(z[1], self.skew[:, None])
        return np.asarray(np.hypot(self._ridge(across) + along, across))

    def _rows(self, mask: Array) -> 'AmplitudeDistribution':
        """Return the distribution of some of the orders."""
        return AmplitudeDistribution(*(getattr(self, item.name)[mask] for item in fields(self)))

    def _ridge(self, across: Array) -> Array:
        """Return the mean of the part along for given parts across."""
        off = across - self.mean_across[:, None]
        return np.asarray(self.mean_along[:, None] + self.slope[:, None] * off
                          + self.bend[:, None] * (off**2 - self.std_across[:, None] ** 2))

    def _normal_cdf(self, y: Array) -> Array:
        """Integrate over the part along; the part across has a closed distribution function."""
        along, weight = _chord(y, self.mean_along[:, None], self.std_along[:, None])
        half = np.sqrt(np.maximum(y[..., None] ** 2 - along**2, 0.0))
        mean, std = self.mean_across[:, None, None], self.std_across[:, None, None]
        return np.asarray(np.sum(
            weight * (ndtr(_ratio(half - mean, std)) - ndtr(_ratio(-half - mean, std))), axis=-1))

    def _curved_cdf(self, y: Array) -> Array:
        """Integrate over the part across; the part along has a closed distribution function."""
        across, weight = _chord(y, self.mean_across[:, None], self.std_across[:, None])
        half = np.sqrt(np.maximum(y[..., None] ** 2 - across**2, 0.0))
        ridge = self._ridge(across.reshape(y.shape[0], -1)).reshape(across.shape)
        return np.asarray(np.sum(
            weight * (self._along(half - ridge) - self._along(-half - ridge)), axis=-1))

    def _along(self, x: Array) -> Array:
        """Return P(std_along T <= x)."""
        t = _ratio(x, self.std_along[:, None, None])
        return np.asarray(ndtr(_straight(t, self.skew[:, None, None])))


def curved_distribution(moments: AverageMoments, unmixed: Array, mixed: Array
                        ) -> AmplitudeDistribution:
    """
    Return the distribution of |X| for an average with third cumulants, in the frame of its phase.

    `unmixed` is k(X, X, X), `mixed` is k(X, X, conj X).
    """
    size = np.abs(moments.mean)
    turn = np.where(size > 0.0, moments.mean / np.where(size > 0.0, size, 1.0), 1.0).conj()
    pseudo = moments.pseudo_variance * turn**2
    along = np.maximum(0.5 * (moments.variance + pseudo.real), 0.0)
    across = np.maximum(0.5 * (moments.variance - pseudo.real), 0.0)
    unmixed = unmixed * turn**3
    mixed = mixed * turn
    along_cubed = 0.25 * (3.0 * mixed.real + unmixed.real)
    along_across_squared = 0.25 * (mixed.real - unmixed.real)
    slope = _ratio(0.5 * pseudo.imag, across)
    bend = _ratio(along_across_squared, 2.0 * across**2)
    free = np.maximum(along - slope**2 * across, 0.0)
    limit = _ratio(np.sqrt(0.45 * free), across)
    bend = np.clip(bend, -limit, limit)
    rest = free - 2.0 * (bend * across) ** 2
    third = along_cubed - 6.0 * slope**2 * bend * across**2 - 8.0 * (bend * across) ** 3
    skew = np.clip(_ratio(third, rest**1.5), -_MAXIMAL_SKEW, _MAXIMAL_SKEW)
    return AmplitudeDistribution(size, np.zeros(size.size), np.sqrt(rest), np.sqrt(across), slope,
                                 bend, skew)


def _ratio(value: Array, scale: Array) -> Array:
    """Return value / scale, and value's sign times a large number, or 0, where scale is 0."""
    safe = np.where(scale > 0.0, scale, 1.0)
    return np.where(scale > 0.0, value / safe, 1e9 * np.sign(value))


def _cube(skew: Array) -> tuple[Array, Array, Array, Array]:
    """Return b, a, mean and scale of the cube (a + b z)^3 whose skewness is 6 b."""
    b = np.where(np.abs(skew) > 1e-4, skew, 1e-4) / 6.0
    a = 1.0 - b**2
    return b, a, a**3 + 3.0 * a * b**2, 3.0 * b * np.sqrt(a**4 + 4.0 * (a * b) ** 2 + 5 / 3 * b**4)


def _lopsided(z: Array, skew: Array) -> Array:
    """Return T for a normal z."""
    b, a, mean, scale = _cube(skew)
    return np.asarray(((a + b * z) ** 3 - mean) / scale)


def _straight(t: Array, skew: Array) -> Array:
    """Return the normal z of a T."""
    b, a, mean, scale = _cube(skew)
    return np.asarray((np.cbrt(mean + scale * t) - a) / b)


def _chord(y: Array, mean: Array, std: Array) -> tuple[Array, Array]:
    """
    Return nodes inside [-y, y] on one axis and their normal probabilities, shape y + (nodes,).

    The sine substitution takes the root singularities off both ends of the chord.
    """
    low = np.clip(mean - _REACH * std, -y, y)[..., None]
    high = np.clip(mean + _REACH * std, -y, y)[..., None]
    angle = 0.5 * np.pi * _AXIS
    nodes = 0.5 * (low + high) + 0.5 * (high - low) * np.sin(angle)
    jacobian = 0.25 * np.pi * (high - low) * np.cos(angle) * _AXIS_WEIGHTS
    with np.errstate(divide='ignore', invalid='ignore', over='ignore'):
        z = (nodes - mean[..., None]) / std[..., None]
        weight = jacobian * np.exp(-0.5 * z**2) / (np.sqrt(2.0 * np.pi) * std[..., None])
    point = (np.abs(mean) <= y)[..., None] / _AXIS.size  # all the probability where std is 0
    return (np.where(std[..., None] > 0.0, nodes, mean[..., None]),
            np.where(std[..., None] > 0.0, weight, point))


def quantile_bracket(
    mean: Array, variance: Array, probability: ArrayLike,
) -> tuple[Array, Array, Array]:
    """
    Return probabilities (k,) and bounds (orders, k) of their quantiles, by Cantelli's inequality.

    Raises ParameterError for a probability outside (0, 1).
    """
    p = require_probabilities(probability)
    reach = 1.02 * np.sqrt(variance)[:, None] * np.sqrt(np.maximum(p / (1.0 - p), (1.0 - p) / p))
    return p, np.maximum(mean[:, None] - reach, 0.0), mean[:, None] + reach


def increasing_root(function: Callable[[Array], Array], low: Array, high: Array) -> Array:
    """Return the bracketed roots of an increasing vectorised function by the Illinois rule."""
    f_low, f_high = function(low), function(high)
    root, last = 0.5 * (low + high), np.zeros(low.shape)
    for _ in range(_ROOT_STEPS):
        with np.errstate(divide='ignore', invalid='ignore'):
            chord = high - f_high * (high - low) / (f_high - f_low)
        root = np.where(f_high - f_low > 0.0, np.clip(chord, low, high), 0.5 * (low + high))
        value = function(root)
        if np.all((np.abs(value) < _ROOT_TOLERANCE) | (high - low <= 1e-12 * high)):
            break
        side = np.sign(value)
        f_low = np.where(side < 0.0, value, np.where(last > 0.0, 0.5 * f_low, f_low))
        f_high = np.where(side < 0.0, np.where(last < 0.0, 0.5 * f_high, f_high), value)
        low, high = np.where(side < 0.0, root, low), np.where(side < 0.0, high, root)
        last = side
    return root
