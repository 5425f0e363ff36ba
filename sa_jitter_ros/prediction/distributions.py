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
Distributions of the error of one keyphasor pulse: one interface, all of zero mean.

Errors are in seconds and a characteristic function takes a frequency in Hz, so that its value at
``g f`` is the mean phasor of order ``g`` of a shaft that turns at ``f``.
Where errors are given in fundamental cycles, the argument is simply the order.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
import math
from numbers import Real
from typing import Protocol, runtime_checkable, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.errors import ModelError
from scipy.special import ndtri

Shape = int | tuple[int, ...]

_TAYLOR_TERMS = 8
_TAYLOR_RADIUS = 0.08  # radians; 0.08^8 / 8! < 1e-13
_Kind = TypeVar('_Kind', bound='_OfStd')
_NORMAL_WIDTH = 8.0  # standard deviations; 6e-5 of a normal distribution lies outside


@runtime_checkable
class PulseErrorDistribution(Protocol):
    """The zero-mean distribution of the time error of one pulse."""

    @property
    def variance(self) -> float:
        """Variance in s^2."""

    @property
    def width(self) -> float:
        """Full width of the support in s (8 standard deviations for an unbounded distribution)."""

    def characteristic_function(self, frequency: ArrayLike) -> Array:
        """Return E exp(j 2 pi f eps), real for a symmetric distribution, for frequencies in Hz."""

    def draw(self, rng: np.random.Generator, shape: Shape) -> Array:
        """Return independent errors in s."""

    def quantile(self, probability: Array) -> Array:
        """Return the errors in s that are exceeded with 1 - `probability`, in (0, 1)."""

    def scaled(self, factor: float) -> 'PulseErrorDistribution':
        """Return the distribution of `factor` times the error."""


@dataclass(frozen=True)
class Uniform:
    """Uniform error of full width `width` s: a pulse seen at a keyphasor sampling instant."""

    width: float

    def __post_init__(self) -> None:
        """Refuse a width that is no width."""
        _require_scale('width', self.width)

    @property
    def variance(self) -> float:
        """Variance in s^2."""
        return self.width**2 / 12.0

    def characteristic_function(self, frequency: ArrayLike) -> Array:
        """Return sinc(f width)."""
        return np.asarray(np.sinc(np.asarray(frequency, float) * self.width))

    def draw(self, rng: np.random.Generator, shape: Shape) -> Array:
        """Return independent errors in s."""
        return rng.uniform(-0.5 * self.width, 0.5 * self.width, shape)

    def quantile(self, probability: Array) -> Array:
        """Return the errors in s that are exceeded with 1 - `probability`."""
        return np.asarray(self.width * (probability - 0.5))

    def scaled(self, factor: float) -> 'Uniform':
        """Return the distribution of `factor` times the error."""
        return Uniform(factor * self.width)


@dataclass(frozen=True)
class _OfStd:
    """An error given by its standard deviation in s."""

    std: float

    def __post_init__(self) -> None:
        """Refuse a standard deviation that is none."""
        _require_scale('std', self.std)

    @property
    def variance(self) -> float:
        """Variance in s^2."""
        return self.std**2

    def scaled(self: _Kind, factor: float) -> _Kind:
        """Return the distribution of `factor` times the error."""
        return replace(self, std=factor * self.std)


@dataclass(frozen=True)
class Normal(_OfStd):
    """Normal error of standard deviation `std` s: electrical noise on the trigger level."""

    @property
    def width(self) -> float:
        """Width in s that holds all but 6e-5 of the errors."""
        return _NORMAL_WIDTH * self.std

    def characteristic_function(self, frequency: ArrayLike) -> Array:
        """Return exp(-2 pi^2 f^2 std^2)."""
        return np.asarray(np.exp(-2.0 * (np.pi * self.std * np.asarray(frequency, float)) ** 2))

    def draw(self, rng: np.random.Generator, shape: Shape) -> Array:
        """Return independent errors in s."""
        return rng.normal(0.0, self.std, shape)

    def quantile(self, probability: Array) -> Array:
        """Return the errors in s that are exceeded with 1 - `probability`."""
        return np.asarray(self.std * ndtri(probability))


@dataclass(frozen=True)
class Triangular(_OfStd):
    """Symmetric triangular error of standard deviation `std` s: difference of two clocks."""

    @property
    def width(self) -> float:
        """Full width of the support in s."""
        return 2.0 * math.sqrt(6.0) * self.std

    def characteristic_function(self, frequency: ArrayLike) -> Array:
        """Return sinc(f width / 2)^2."""
        return np.asarray(np.sinc(np.asarray(frequency, float) * (0.5 * self.width)) ** 2)

    def draw(self, rng: np.random.Generator, shape: Shape) -> Array:
        """Return independent errors in s."""
        return 0.25 * self.width * (rng.uniform(-1.0, 1.0, shape) + rng.uniform(-1.0, 1.0, shape))

    def quantile(self, probability: Array) -> Array:
        """Return the errors in s that are exceeded with 1 - `probability`."""
        below = 2.0 * probability - 1.0
        return np.asarray(0.5 * self.width * np.sign(below) * (1.0 - np.sqrt(1.0 - np.abs(below))))


@dataclass(frozen=True, eq=False)
class Empirical:
    """
    Equally likely errors of a table, in s, centred: a mean error is a delay that no average shows.

    `table` keeps the centred values. Raises ModelError for a table that is empty, not
    one-dimensional or not finite.
    """

    table: Array = field(repr=False)
    _cache: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Check and centre the table."""
        try:
            table = np.array(self.table, float)
        except (TypeError, ValueError) as error:
            raise ModelError(
                f'table holds a value that is no number ({error}): give errors in s') from error
        if table.ndim != 1 or table.size == 0:
            raise ModelError(f'table has the shape {table.shape}: give one list of at least one '
                             'pulse error in s')
        if not np.all(np.isfinite(table)):
            index = int(np.argmin(np.isfinite(table)))
            raise ModelError(f'table[{index}] is {table[index]}: give finite errors in s')
        table -= table.mean()
        table.setflags(write=False)
        object.__setattr__(self, 'table', table)
        object.__setattr__(self, '_cache', np.empty((_TAYLOR_TERMS, 0), complex))

    @property
    def variance(self) -> float:
        """Variance in s^2."""
        return float(np.mean(self.table**2))

    @cached_property
    def values(self) -> int:
        """Return the number of different values."""
        return int(np.unique(self.table).size)

    @property
    def skewness(self) -> float:
        """Third central moment over the third power of the standard deviation, 0 for one value."""
        unit = np.max(np.abs(self.table))
        if unit == 0.0:
            return 0.0
        value = self.table / unit
        return float(np.mean(value**3) / np.mean(value**2) ** 1.5)

    @property
    def width(self) -> float:
        """Full width of the support in s."""
        return float(np.ptp(self.table))

    def characteristic_function(self, frequency: ArrayLike) -> Array:
        """
        Return the mean phasor of the table.

        Many frequencies are served by Taylor expansions about a grid so fine that the error stays
        below 1e-13, because a table of thousands at a million frequencies would take minutes.
        """
        f = np.asarray(frequency, float)
        omega = 2.0 * np.pi * self.table
        reach = float(np.max(np.abs(omega)))
        if reach == 0.0:
            return np.ones(f.shape)
        position = np.abs(f) * (reach / (2.0 * _TAYLOR_RADIUS))
        cells = int(np.max(position, initial=0.0)) + 2
        if f.size < 2 * cells:
            return np.asarray(np.exp(1j * np.multiply.outer(f, omega)).mean(axis=-1))
        coefficients = self._expansions(cells)
        nearest = np.rint(position).astype(np.intp)
        offset = position - nearest
        value = coefficients[-1].take(nearest)
        for coefficient in coefficients[-2::-1]:
            value *= offset
            value += coefficient.take(nearest)
        np.negative(value.imag, where=f < 0.0, out=value.imag)
        return np.asarray(value)

    def _expansions(self, cells: int) -> Array:
        """Return Taylor coefficients about at least `cells` grid points, shape (terms, points)."""
        if self._cache.shape[1] < cells:
            omega = 2.0 * np.pi * self.table
            step = 2.0 * _TAYLOR_RADIUS / np.max(np.abs(omega))
            powers = np.stack([(1j * omega * step) ** n / math.factorial(n)
                               for n in range(_TAYLOR_TERMS)], axis=1) / omega.size
            grid = step * np.arange(max(cells, 2 * self._cache.shape[1]))
            phasors = np.exp(1j * np.multiply.outer(grid, omega))
            object.__setattr__(self, '_cache', np.ascontiguousarray((phasors @ powers).T))
        return self._cache

    def draw(self, rng: np.random.Generator, shape: Shape) -> Array:
        """Return independent errors in s."""
        return np.asarray(rng.choice(self.table, shape))

    def quantile(self, probability: Array) -> Array:
        """Return the errors in s that are exceeded with 1 - `probability`."""
        return np.asarray(np.sort(self.table)[(probability * self.table.size).astype(np.intp)])

    def scaled(self, factor: float) -> 'Empirical':
        """Return the distribution of `factor` times the error."""
        return Empirical(factor * self.table)


def is_number(value: object) -> bool:
    """Return whether a value is a real number, neither a text nor true or false."""
    return isinstance(value, Real) and not isinstance(value, bool)


def _require_scale(name: str, value: float) -> None:
    if not (is_number(value) and math.isfinite(value) and value >= 0.0):
        raise ModelError(f'{name} is {value} s: it must be finite and not negative')
