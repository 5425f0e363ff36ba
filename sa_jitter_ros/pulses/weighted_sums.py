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
Weighted sums of samples, whose weights are polynomials.

This is what `_weighted_sums.c` computes, in a third of the time, where the package was installed
with a C compiler. The sums are the product of a sparse matrix with the samples of all channels.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import _sparsetools

FloatArray = NDArray[np.float64]

_PIECE = 1 << 11  # positions whose weights are in the cache at once


@lru_cache(maxsize=8)
def _steps(taps: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return the steps from the first to every weight of `_PIECE` sums, and where each begins."""
    return (np.tile(np.arange(taps, dtype=np.int32), _PIECE),
            np.arange(0, taps * _PIECE + 1, taps, dtype=np.int32))


def weighted_sums(samples: FloatArray, begin: NDArray[np.int32], fraction: FloatArray,
                  polynomials: FloatArray, values: FloatArray, /) -> None:
    """
    Write the weighted sums of `samples` (n, channels) to `values` (m, channels).

    The sums begin at samples `begin` (m,). The weights are `polynomials` (power, tap) of
    2 `fraction` - 1.
    """
    order, taps = polynomials.shape
    channels, size = samples.shape[1], min(begin.size, _PIECE)
    values[:] = 0.0
    powers, weights = np.ones((order, size)), np.empty((size, taps))
    steps, rows = _steps(taps)
    for start in range(0, begin.size, size):
        count = min(size, begin.size - start)
        power = powers[:, :count]
        np.multiply(fraction[start:start + count], 2.0, out=power[1])
        power[1] -= 1.0
        for k in range(2, order):
            np.multiply(power[k - 1], power[1], out=power[k])
        np.matmul(power.T, polynomials, out=weights[:count])
        columns = np.repeat(begin[start:start + count], taps)
        columns += steps[:columns.size]
        # What csr_matrix calls for a product, without its checks, which take as long here.
        matrix = count, len(samples), rows[:count + 1], columns, weights.reshape(-1)
        found = values[start:start + count].reshape(-1)
        if channels == 1:
            _sparsetools.csr_matvec(*matrix, samples.reshape(-1), found)
        else:
            _sparsetools.csr_matvecs(*matrix[:2], channels, *matrix[2:], samples.reshape(-1),
                                     found)
