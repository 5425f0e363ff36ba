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
import math

import numpy as np
from numpy.typing import ArrayLike
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.prediction.angle_error import unit_nodes
from sa_jitter_ros.prediction.parts import offset_of, Parts
from sa_jitter_ros.prediction.sampled_distribution import require_probabilities
from scipy.special import ndtr, ndtri

_REACH = 8.5  # standard deviations; 2e-17 of a normal distribution lies outside
_NODES, _MOST_STEEP = 48, 8  # 1e-9 of a distribution function; times as many where it is steep
_HERMITE, _HERMITE_WEIGHTS = np.polynomial.hermite_e.hermegauss(32)  # 1e-5 of Var|X|, kinks apart
_HERMITE_PAIRS = (np.multiply.outer(_HERMITE_WEIGHTS, _HERMITE_WEIGHTS)
                  / _HERMITE_WEIGHTS.sum() ** 2)
_UNIT, _UNIT_WEIGHTS = unit_nodes(64)  # of amplitudes from 0 to the largest
_MAXIMAL_SKEW = 2.0  # that of an exponential variable
_MOST_BENT = 0.9  # of the variance along that the part across does not explain
_GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)  # the step that spreads points most evenly
_ROOT_STEPS = 60  # bisection alone takes 50 to the last digit
_ROOT_TOLERANCE, _ROOT_WIDTH = 1e-9, 1e-12  # of probability; of where the root may be
_LARGEST = 1e100  # amplitude, whose square is a number


@dataclass(frozen=True)
class AmplitudeDistribution:
    """
    The distribution of |X|, X = along + j across, one entry per order.

    across = mean_across + A and along = mean_along + slope A + bend Q + std_along T. A has the
    standard deviation `std_across` and the skewness `skew_across`, T the standard deviation 1 and
    the skewness `skew`: Wilson and Hilferty's cubes of normal variables, gamma variables to 1e-3.
    Q is A^2 less its mean and what of it a multiple of A explains. X is normal, exactly, where
    bend and skewness are 0. Everything is computed about abs(mean), so that a scatter far below
    the last digit of the amplitude keeps its own digits.

    An approximation: of averages of as many cycles as it is taken for, the distribution function
    is 0.005 off at most for symmetric pulse errors, 0.01 for skewed tables, and the standard
    deviation 1 % (`benchmarks/prediction_domain.py`). Tails beyond 1 % are less certain.
    """

    mean_along: Array
    mean_across: Array
    std_along: Array
    std_across: Array
    slope: Array
    bend: Array
    skew: Array
    skew_across: Array

    @property
    def mean_square(self) -> Array:
        """Return E|X|^2, exact."""
        return np.asarray(self.center**2 + self._swing**2 + self.std_across**2)

    @property
    def center(self) -> Array:
        """Return |E X|, from which offsets count."""
        return np.hypot(self.mean_along, self.mean_across)

    @property
    def _swing(self) -> Array:
        """Return the standard deviation of the part along."""
        bent = self.bend * self.std_across**2
        return np.asarray(np.sqrt(
            self.std_along**2 + (self.slope * self.std_across) ** 2
            + bent**2 * _of_square(self.skew_across)[0]))

    @cached_property
    def variance(self) -> Array:
        """Return Var|X|."""
        off = self.std_across[:, None] * _lopsided(_HERMITE, self.skew_across[:, None])
        along = self.std_along[:, None] * _lopsided(_HERMITE, self.skew[:, None])
        offset = self._offset((self._ridge(off)[:, :, None] + along[:, None, :]),
                              off[:, :, None])
        mean = np.sum(offset * _HERMITE_PAIRS, axis=(1, 2))
        variance = np.sum((offset - mean[:, None, None]) ** 2 * _HERMITE_PAIRS, axis=(1, 2))
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
        y = np.clip(np.atleast_2d(np.asarray(amplitude, float)), 0.0, _LARGEST)
        return self._below(y - self.center[:, None])

    def ppf(self, probability: ArrayLike) -> Array:
        """
        Return quantiles of |X|, shape (orders, k) for k probabilities in (0, 1).

        Raises ParameterError for a probability outside (0, 1).
        """
        excess = self._swing**2 + self.std_across**2 - self.variance
        p, low, high = _quantile_bracket(_ratio(excess, self.mean + self.center), self.variance,
                                         probability)
        offset = _increasing_root(lambda y: self._below(y) - p,
                                  np.maximum(low, -self.center[:, None]), high)
        return np.asarray(self.center[:, None] + offset)

    def spread(self, count: int) -> Array:
        """Return evenly spread, equally likely values of |X| - `center`, (orders, count)."""
        index = np.arange(count)  # a lattice of the golden ratio
        z = ndtri(np.array([(index + 0.5) / count, (0.5 + index * _GOLDEN) % 1.0]))
        off = self.std_across[:, None] * _lopsided(z[0], self.skew_across[:, None])
        along = self.std_along[:, None] * _lopsided(z[1], self.skew[:, None])
        return self._offset(self._ridge(off) + along, off)

    def _rows(self, mask: Array) -> 'AmplitudeDistribution':
        """Return the distribution of some of the orders."""
        return AmplitudeDistribution(*(getattr(self, item.name)[mask] for item in fields(self)))

    def _ridge(self, off: Array) -> Array:
        """Return the mean of along - mean_along for given across - mean_across."""
        each = (slice(None), *[None] * (off.ndim - 1))
        std = self.std_across[each]
        return np.asarray(self.slope[each] * off + self.bend[each] * (
            off * (off - self.skew_across[each] * std) - std**2))

    def _offset(self, along: Array, across: Array) -> Array:
        """Return |X| - `center` of parts off their means."""
        each = (slice(None), *[None] * (along.ndim - 1))
        return offset_of(self.center[each], self.mean_along[each], self.mean_across[each], along,
                         across)

    def _below(self, offset: Array) -> Array:
        """Return P(|X| - center <= offset) for offsets (orders, k)."""
        if any(np.any(item) for item in (self.slope, self.bend, self.skew, self.skew_across)):
            return self._curved_cdf(offset)
        return self._normal_cdf(offset)

    def _normal_cdf(self, offset: Array) -> Array:
        """Integrate over the part along; the part across has a closed distribution function."""
        off, weight = _chord(offset, self.center, self.mean_along, self.std_along)
        std = self.std_across[:, None, None]
        high, low = _ends(offset, self.center, self.mean_along, self.mean_across, off)
        return np.asarray(np.sum(
            weight * (ndtr(_ratio(high, std)) - ndtr(_ratio(low, std))), axis=-1))

    def _curved_cdf(self, offset: Array) -> Array:
        """Integrate over the part across; the part along has a closed distribution function."""
        steep = np.max(_ratio(self._swing, self.std_along), initial=1.0, where=self._swing > 0.0)
        nodes = _NODES * min(math.ceil(0.5 * steep), _MOST_STEEP)
        off, weight = _chord(offset, self.center, self.mean_across, self.std_across,
                             self.skew_across, nodes)
        ridge = self._ridge(off)
        high, low = _ends(offset, self.center, self.mean_across, self.mean_along, off)
        return np.asarray(np.sum(
            weight * (self._along(high - ridge) - self._along(low - ridge)), axis=-1))

    def _along(self, x: Array) -> Array:
        """Return P(std_along T <= x)."""
        t = _ratio(x, self.std_along[:, None, None])
        return np.asarray(ndtr(_straight(t, self.skew[:, None, None])))


def curved_along(parts: Parts) -> AmplitudeDistribution:
    """Return the distribution of |X| from its parts along and across its mean, the base."""
    across, slope = parts.ii, _ratio(parts.ri, parts.ii)
    lopsided = np.clip(_ratio(parts.iii, across**1.5), -_MAXIMAL_SKEW, _MAXIMAL_SKEW)
    square, mixed, cube = _of_square(lopsided)
    third = lopsided * across**1.5
    bend = _ratio(parts.rii - slope * third, square * across**2)
    free = np.maximum(parts.rr - slope**2 * across, 0.0)
    limit = _ratio(np.sqrt(_MOST_BENT * free / square), across)
    bend = np.clip(bend, -limit, limit)
    bent = bend * across
    rest = free - square * bent**2
    skew = (parts.rrr - slope**3 * third - 3.0 * slope**2 * bent * square * across
            - 3.0 * slope * bent**2 * mixed * np.sqrt(across) - bent**3 * cube)
    skew = np.clip(_ratio(skew, rest**1.5), -_MAXIMAL_SKEW, _MAXIMAL_SKEW)
    size = parts.size
    return AmplitudeDistribution(size, np.zeros(size.size), np.sqrt(rest), np.sqrt(across), slope,
                                 bend, skew, lopsided)


def _of_square(skew: Array) -> tuple[Array, Array, Array]:
    """Return E Q^2, E A Q^2 and E Q^3 of an A of unit variance."""
    a = _lopsided(_HERMITE, skew[..., None])
    q = a * (a - skew[..., None]) - 1.0
    weight = _HERMITE_WEIGHTS / _HERMITE_WEIGHTS.sum()
    return (q**2) @ weight, (a * q**2) @ weight, (q**3) @ weight


def _ratio(value: Array, scale: Array) -> Array:
    """Return value / scale, and value's sign times a large number, or 0, where scale is 0."""
    safe = np.where(scale > 0.0, scale, 1.0)
    return np.where(scale > 0.0, value / safe, 1e9 * np.sign(value))


def _ends(offset: Array, center: Array, mean: Array, other: Array, off: Array
          ) -> tuple[Array, Array]:
    """
    Return both ends (..., node) of chords of a circle, off the mean `other` on their own axis.

    The radius is center + offset; chords stand `off` (..., node) the `mean` of the other axis.
    The half length less the mean is a difference of squares, which keeps its digits.
    """
    c, m, o = center[:, None, None], mean[:, None, None], other[:, None, None]
    d = offset[..., None]
    gain = np.maximum(2.0 * (c * d - m * off) + d**2 - off**2, -o**2)
    size = np.abs(o)
    total = np.sqrt(o**2 + gain) + size
    longer = gain / np.where(total > 0.0, total, 1.0)
    return longer + (size - o), -longer - (size + o)


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


def _chord(offset: Array, center: Array, mean: Array, std: Array, skew: Array | None = None,
           nodes: int = _NODES) -> tuple[Array, Array]:
    """
    Return nodes on one axis, off its mean and inside a circle, and their probabilities.

    Both have the shape offset + (nodes,); the radius is center + offset. The sine substitution
    takes the root singularities off both ends of the chord.
    """
    c, m = center[:, None], mean[:, None]
    first, last = -(c + m) - offset, (c - m) + offset
    some = (std > 0.0)[:, None, None]
    scale = np.where(some, std[:, None, None], 1.0)
    low, high = (end[..., None] / scale for end in (first, last))
    if skew is not None:
        low, high = (_straight(end, skew[:, None, None]) for end in (low, high))
    low, high = (np.clip(end, -_REACH, _REACH) for end in (low, high))
    x, w = unit_nodes(nodes)
    angle = np.pi * (x - 0.5)
    z = 0.5 * (low + high) + 0.5 * (high - low) * np.sin(angle)
    weight = (np.sqrt(0.125 * np.pi) * (high - low) * np.cos(angle) * w * np.exp(-0.5 * z**2))
    off = scale * (z if skew is None else _lopsided(z, skew[:, None, None]))
    point = ((first <= 0.0) & (last >= 0.0))[..., None] / nodes  # all of it where std is 0
    return np.where(some, off, 0.0), np.where(some, weight, point)


def _quantile_bracket(mean: Array, variance: Array, probability: ArrayLike
                      ) -> tuple[Array, Array, Array]:
    """
    Return probabilities (k,) and bounds (orders, k) of their quantiles, by Cantelli's inequality.

    Raises ParameterError for a probability outside (0, 1).
    """
    p = require_probabilities(probability)
    reach = 1.02 * np.sqrt(variance)[:, None] * np.sqrt(np.maximum(p / (1.0 - p), (1.0 - p) / p))
    return p, mean[:, None] - reach, mean[:, None] + reach


def _increasing_root(function: Callable[[Array], Array], low: Array, high: Array) -> Array:
    """Return the bracketed roots of an increasing vectorised function by the Illinois rule."""
    f_low, f_high = function(low), function(high)
    enough = _ROOT_WIDTH * (high - low)
    root, last = 0.5 * (low + high), np.zeros(low.shape)
    for _ in range(_ROOT_STEPS):
        with np.errstate(divide='ignore', invalid='ignore'):
            chord = high - f_high * (high - low) / (f_high - f_low)
        root = np.where(f_high - f_low > 0.0, np.clip(chord, low, high), 0.5 * (low + high))
        value = function(root)
        if np.all((np.abs(value) < _ROOT_TOLERANCE) | (high - low <= enough)):
            break
        side = np.sign(value)
        f_low = np.where(side < 0.0, value, np.where(last > 0.0, 0.5 * f_low, f_low))
        f_high = np.where(side < 0.0, np.where(last < 0.0, 0.5 * f_high, f_high), value)
        low, high = np.where(side < 0.0, root, low), np.where(side < 0.0, high, root)
        last = side
    return root
