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
The loops over all samples, in numpy and scipy.

This is what `_in_c.c` computes, in a fraction of the time, where the package was installed
with a C compiler. Each function writes to its last arguments.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.arrays import FloatArray
from scipy.sparse import _sparsetools

_PIECE = 1 << 11  # positions whose weights are in the cache at once


@lru_cache(maxsize=8)
def _steps(taps: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return the steps from the first to every weight of `_PIECE` sums, and where each begins."""
    return (np.tile(np.arange(taps, dtype=np.int32), _PIECE),
            np.arange(0, taps * _PIECE + 1, taps, dtype=np.int32))


def weighted_sums(samples: FloatArray, origin: NDArray[np.int32], begin: FloatArray,
                  length: FloatArray, u: FloatArray, polynomials: FloatArray, values: FloatArray, /
                  ) -> None:
    """
    Write weighted sums of `samples` (n, channels) to `values` (row x u, channels), row by row.

    The place of a sum is `begin` + `length` `u`, not negative, from sample `origin` (row,) on. It
    begins at the sample before it. The weights of its first half are `polynomials` (power, tap) of
    twice the rest, less 1; those of the second half are of the negative, in the other order. Sums
    are the product of a sparse matrix with the samples of all channels.
    """
    polynomials = np.concatenate((polynomials, polynomials[:, ::-1]), axis=1)
    polynomials[1::2, polynomials.shape[1] // 2:] *= -1.0
    places = (begin[:, None] + length[:, None] * u).ravel()
    index = places.astype(np.int32)
    fraction = np.subtract(places, index, out=places)
    index += np.repeat(origin, u.size)
    order, taps = polynomials.shape
    channels, size = samples.shape[1], min(index.size, _PIECE)
    values[:] = 0.0
    powers, weights = np.ones((order, size)), np.empty((size, taps))
    steps, rows = _steps(taps)
    for start in range(0, index.size, size):
        count = min(size, index.size - start)
        power = powers[:, :count]
        np.multiply(fraction[start:start + count], 2.0, out=power[1])
        power[1] -= 1.0
        for k in range(2, order):
            np.multiply(power[k - 1], power[1], out=power[k])
        np.matmul(power.T, polynomials, out=weights[:count])
        columns = np.repeat(index[start:start + count], taps)
        columns += steps[:columns.size]
        # What csr_matrix calls for a product, without its checks, which take as long here.
        matrix = count, len(samples), rows[:count + 1], columns, weights.reshape(-1)
        found = values[start:start + count].reshape(-1)
        if channels == 1:
            _sparsetools.csr_matvec(*matrix, samples.reshape(-1), found)
        else:
            _sparsetools.csr_matvecs(*matrix[:2], channels, *matrix[2:], samples.reshape(-1),
                                     found)


def frames(samples: FloatArray, values: FloatArray, /) -> bool:
    """Write `samples` (channel, n) to `values` (n, channel); return whether all are finite."""
    values[:] = samples.T
    return bool(np.isfinite(samples).all())


def add_steps(values: FloatArray, first: FloatArray, total: FloatArray, squares: FloatArray, /
              ) -> None:
    """Add the steps from `first` (...) to the `values` (cycle, ...), and their squares."""
    steps = values - first
    total += steps.sum(axis=0) if len(steps) > 1 else steps[0]
    squares += np.einsum('k...,k...->...', steps, steps)


def add_products(table: FloatArray, values: FloatArray, sums: FloatArray, /) -> None:
    """Add the products of a `table` (line, row) with `values` (cycle, row, n)."""
    sums += table @ values
