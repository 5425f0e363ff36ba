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
Running means of real arrays: block, sliding and exponential.

Each takes one array per cycle, of some cycles at once with `update`, and returns `mean` and
`standard_error`. Memory does not grow with the number of cycles (a sliding mean keeps its window).
Undefined values are NaN.

>>> mean = BlockMean()
>>> mean.update(np.array([[1.0], [2.0]]))
>>> mean.update(np.array([[6.0]]))
>>> mean.mean, mean.standard_error.round(3), mean.count
(array([3.]), array([1.528]), 3)
"""

from typing import Protocol

import numpy as np
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.inner_loops import add_steps

_CACHED = 1 << 16  # numbers


class RunningMean(Protocol):
    """The interface of the three means."""

    @property
    def count(self) -> int:
        """Return the number of arrays that make the mean."""

    def update(self, values: FloatArray) -> None:
        """Take the arrays of one or more cycles (cycle, ...), at least one."""

    @property
    def mean(self) -> FloatArray:
        """Mean so far."""

    @property
    def standard_error(self) -> FloatArray:
        """Return the standard error of the mean, from the scatter of the arrays."""


class BlockMean:
    """
    Mean of all arrays since the start; mergeable.

    It keeps the first array and the sums of the steps from it to all arrays, and of their squares.
    The variance contains the first array, too, so that it is at least a fraction 1 / count of the
    mean of these squares, and rounding errors are no more than `count` times those of a number.
    """

    def __init__(self) -> None:
        self.count = 0
        self._first: FloatArray = np.array(np.nan)
        self._sum: FloatArray = np.array(np.nan)
        self._squares: FloatArray = np.array(np.nan)

    def update(self, values: FloatArray) -> None:
        """Take one or more arrays (cycle, ...), at least one."""
        values = np.ascontiguousarray(values)
        if not self.count:
            self._first = values[0].copy()
            self._sum, self._squares = np.zeros((2, *self._first.shape))
        self.count += len(values)
        # Piece by piece, so that what is computed of a piece stays in the cache.
        size = max(_CACHED // (values[:, :1].size or 1), 1)
        for begin in range(0, values.shape[1], size):
            where = slice(begin, begin + size)
            add_steps(values[:, where], self._first[where], self._sum[where], self._squares[where])

    def merge(self, other: 'BlockMean') -> None:
        """Add all arrays of another mean."""
        if not other.count:
            return
        if not self.count:
            self.count, self._first = other.count, other._first
            self._sum, self._squares = other._sum.copy(), other._squares.copy()
            return
        step = other._first - self._first
        moved = other.count * step
        self._sum += other._sum + moved
        moved += 2.0 * other._sum
        moved *= step
        self._squares += other._squares + moved
        self.count += other.count

    @property
    def mean(self) -> FloatArray:
        """Mean so far."""
        return np.asarray(self._first + self._sum / self.count if self.count else self._first)

    @property
    def standard_error(self) -> FloatArray:
        """Return the standard error of the mean; NaN below two arrays."""
        if self.count < 2:
            return np.full(self._squares.shape, np.nan)
        squares = np.maximum(self._squares - np.square(self._sum) / self.count, 0.0)
        return np.asarray(np.sqrt(squares / (self.count - 1) / self.count))


class PartsMean(BlockMean):
    """
    Mean of all arrays that also keeps the means of consecutive parts of them.

    It keeps from `least` to twice as many parts of equal size, and the rest in one more; the size
    begins at `size` and doubles when there are too many.

    >>> mean = PartsMean(size=1, least=2)
    >>> mean.update(np.arange(9.0)[:, None])
    >>> [(part.count, part.mean.tolist()) for part in mean.parts()]
    [(4, [1.5]), (4, [5.5]), (1, [8.0])]
    >>> mean.mean, mean.count
    (array([4.]), 9)
    """

    def __init__(self, *, size: int, least: int) -> None:
        super().__init__()
        self._size, self._least = size, least
        self._parts: list[BlockMean] = []

    def update(self, values: FloatArray) -> None:
        """Take one or more arrays (cycle, ...), at least one."""
        self.count += len(values)
        while self.count > 2 * self._least * self._size:
            self._double()
        while len(values):
            if not self._parts or self._parts[-1].count == self._size:
                self._parts.append(BlockMean())
            count = self._size - self._parts[-1].count
            self._parts[-1].update(values[:count])
            values = values[count:]

    def _double(self) -> None:
        for first, second in zip(self._parts[::2], self._parts[1::2]):
            first.merge(second)
        del self._parts[1::2]
        self._size *= 2

    def parts(self) -> list[BlockMean]:
        """Return the parts, whose means must not be changed."""
        return self._parts

    def together(self) -> BlockMean:
        """Return the mean of all parts."""
        total = BlockMean()
        for part in self._parts:
            total.merge(part)
        return total

    @property
    def mean(self) -> FloatArray:
        """Mean so far."""
        return self.together().mean

    @property
    def standard_error(self) -> FloatArray:
        """Return the standard error of the mean; NaN below two arrays."""
        return self.together().standard_error


class SlidingMean:
    """
    Mean of the latest arrays; the caller drops the oldest ones with `forget`.

    The window consists of the latest arrays and of means of the older ones, each from one of these
    to the newest of them. To forget the oldest array is to drop its mean. When there are no more
    means, they are computed anew from the latest arrays, backwards. Each array is thus added twice
    for any length of the window, and nothing is subtracted, so that rounding errors do not add up.

    >>> mean = SlidingMean()
    >>> mean.update(np.array([[1.0], [2.0], [6.0]]))
    >>> mean.forget(1)
    >>> mean.mean, mean.count
    (array([4.]), 2)
    """

    def __init__(self) -> None:
        self._latest: list[FloatArray] = []
        self._sum = BlockMean()  # of the latest
        self._older: list[BlockMean] = []

    @property
    def count(self) -> int:
        """Return the number of arrays in the window."""
        return len(self._latest) + len(self._older)

    def update(self, values: FloatArray) -> None:
        """Take one or more arrays (cycle, ...), which must not be changed later."""
        self._latest.extend(values)
        self._sum.update(values)

    def forget(self, count: int) -> None:
        """Forget the oldest `count` arrays."""
        for _ in range(min(count, self.count)):
            if not self._older:
                self._turn()
            self._older.pop()

    def _turn(self) -> None:
        """Compute the means of the latest arrays, backwards from the newest."""
        while self._latest:
            block = BlockMean()
            block.update(self._latest.pop()[None])
            if self._older:
                block.merge(self._older[-1])
            self._older.append(block)
        self._sum = BlockMean()

    def _window(self) -> BlockMean:
        window = BlockMean()
        window.merge(self._sum)
        if self._older:
            window.merge(self._older[-1])
        return window

    @property
    def mean(self) -> FloatArray:
        """Mean of the window."""
        return self._window().mean

    @property
    def standard_error(self) -> FloatArray:
        """Return the standard error of the mean of the window; NaN below two arrays."""
        return self._window().standard_error


class ExponentialMean:
    """
    Exponentially weighted mean with the noise reduction of `cycles` equal weights.

    The weight of a new array is 2 / (cycles + 1). The mean of white noise then has 1 / cycles of
    the variance of one array. At the start the mean is that of all arrays. After a NaN the mean
    starts again at the next defined value.

    >>> mean = ExponentialMean(3.0)
    >>> mean.update(np.array([[1.0], [3.0], [6.0]]))
    >>> mean.mean  # (1 + 3) / 2, then half of the difference to 6 more
    array([4.])
    """

    def __init__(self, cycles: float) -> None:
        self._weight = 2.0 / (cycles + 1.0)
        self.count = 0
        self._mean: FloatArray = np.array(np.nan)
        self._variance: FloatArray = np.array(np.nan)
        self._squared_weights = 0.0

    def update(self, values: FloatArray) -> None:
        """Take one or more arrays (cycle, ...)."""
        for item in values:
            self._take(item)

    def _take(self, values: FloatArray) -> None:
        self.count += 1
        weight = max(self._weight, 1.0 / self.count)
        if self.count == 1:
            self._mean = values.copy()
            self._variance = np.zeros(values.shape)
        else:
            step = values - self._mean
            undefined = np.isnan(self._mean)
            self._mean = np.where(undefined, values, self._mean + weight * step)
            self._variance = np.where(
                undefined, 0.0, (1.0 - weight) * (self._variance + weight * np.square(step)))
        self._squared_weights = (1.0 - weight) ** 2 * self._squared_weights + weight**2

    @property
    def mean(self) -> FloatArray:
        """Mean so far."""
        return self._mean.copy()

    @property
    def standard_error(self) -> FloatArray:
        """Return the standard error of the mean; NaN below two arrays."""
        share = self._squared_weights
        if self.count < 2 or share >= 1.0:  # the mean is the last array alone
            return np.full(self._variance.shape, np.nan)
        return np.asarray(np.sqrt(self._variance * share / (1.0 - share)))
