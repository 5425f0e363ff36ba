"""
Running means of arrays: block, sliding and exponential.

Each takes one array per cycle with `update` and gives `mean` and `standard_error`; memory does not
grow with the number of cycles (a sliding mean keeps its window). Undefined values are NaN.

>>> mean = BlockMean()
>>> for value in (1.0, 2.0, 6.0):
...     mean.update(np.array([value]))
>>> mean.mean, mean.standard_error.round(3), mean.count
(array([3.]), array([1.528]), 3)
"""

from collections import deque
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
FloatArray = NDArray[np.float64]


class RunningMean(Protocol):
    """What the three have in common."""

    @property
    def count(self) -> int:
        """Number of arrays that make the mean."""

    def update(self, values: Array) -> None:
        """Take the array of one more cycle."""

    @property
    def mean(self) -> Array:
        """Mean so far."""

    @property
    def standard_error(self) -> FloatArray:
        """Standard error of the mean, from the scatter of what was taken."""


class BlockMean:
    """Mean of all arrays since the start (Welford 1962); mergeable (Chan et al. 1983)."""

    def __init__(self) -> None:
        self.count = 0
        self._mean: Array = np.array(np.nan)
        self._squares: FloatArray = np.array(np.nan)

    def update(self, values: Array) -> None:
        """Take one more array."""
        self.count += 1
        if self.count == 1:
            self._mean = values.copy()
            self._squares = np.zeros(values.shape)
            return
        step = values - self._mean
        self._mean += step / self.count
        self._squares += (step * np.conj(values - self._mean)).real

    def merge(self, other: 'BlockMean') -> None:
        """Take all that another mean has taken."""
        if not other.count:
            return
        if not self.count:
            self.count = other.count
            self._mean, self._squares = other._mean.copy(), other._squares.copy()
            return
        total = self.count + other.count
        step = other._mean - self._mean
        self._mean += step * (other.count / total)
        self._squares += other._squares + np.abs(step) ** 2 * (self.count * other.count / total)
        self.count = total

    @property
    def mean(self) -> Array:
        """Mean so far."""
        return self._mean.copy()

    @property
    def standard_error(self) -> FloatArray:
        """Standard error of the mean; NaN below two arrays."""
        if self.count < 2:
            return np.full(self._squares.shape, np.nan)
        return np.asarray(np.sqrt(self._squares / (self.count - 1) / self.count))


class SlidingMean:
    """Mean of the latest arrays; the caller says which are out of the window."""

    def __init__(self) -> None:
        self._window: deque[Array] = deque()

    @property
    def count(self) -> int:
        """Number of arrays in the window."""
        return len(self._window)

    def update(self, values: Array) -> None:
        """Take one more array."""
        self._window.append(values)

    def forget(self, count: int) -> None:
        """Forget the oldest `count` arrays."""
        for _ in range(min(count, len(self._window))):
            self._window.popleft()

    def _block(self) -> BlockMean:
        block = BlockMean()
        for values in self._window:
            block.update(values)
        return block

    @property
    def mean(self) -> Array:
        """Mean of the window, summed anew: rounding does not build up."""
        return np.mean(self._window, axis=0) if self._window else np.array(np.nan)

    @property
    def standard_error(self) -> FloatArray:
        """Standard error of the mean of the window; NaN below two arrays."""
        return self._block().standard_error


class ExponentialMean:
    """
    Exponentially weighted mean with the noise reduction of `cycles` equal weights.

    The weight of a new array is 2 / (cycles + 1), for which white noise has the variance
    1 / cycles of one array's; until that many have come it is the plain mean. Where it became
    undefined, the next defined value starts it anew.
    """

    def __init__(self, cycles: float) -> None:
        self._weight = 2.0 / (cycles + 1.0)
        self.count = 0
        self._mean: Array = np.array(np.nan)
        self._variance: FloatArray = np.array(np.nan)
        self._squared_weights = 0.0

    def update(self, values: Array) -> None:
        """Take one more array."""
        self.count += 1
        weight = max(self._weight, 1.0 / self.count)
        if self.count == 1:
            self._mean = values.copy()
            self._variance = np.zeros(values.shape)
        else:
            step = values - self._mean
            anew = np.isnan(self._mean)
            self._mean = np.where(anew, values, self._mean + weight * step)
            self._variance = np.where(
                anew, 0.0, (1.0 - weight) * (self._variance + weight * np.abs(step) ** 2))
        self._squared_weights = (1.0 - weight) ** 2 * self._squared_weights + weight**2

    @property
    def mean(self) -> Array:
        """Mean so far."""
        return self._mean.copy()

    @property
    def standard_error(self) -> FloatArray:
        """Standard error of the mean; NaN below two arrays."""
        if self.count < 2:
            return np.full(self._variance.shape, np.nan)
        share = self._squared_weights
        return np.asarray(np.sqrt(self._variance * share / (1.0 - share)))
