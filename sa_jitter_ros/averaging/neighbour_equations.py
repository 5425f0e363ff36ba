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
Problems of a chain of pulses, in which only neighbours have a trigger cycle in common.

Normal equations of their errors are tridiagonal, and the best of all sequences of errors is found
step by step: the time of both is proportional to the number of pulses.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from sa_jitter_ros.arrays import FloatArray
from scipy.linalg import lapack


@dataclass(frozen=True)
class Tridiagonal:
    """
    A symmetric positive definite tridiagonal matrix.

    >>> matrix = Tridiagonal(np.array([2.0, 3.0, 2.0]), np.array([-1.0, -1.0]))
    >>> matrix.times(matrix.solve(np.array([1.0, 2.0, 4.0]))).round(9)
    array([1., 2., 4.])
    """

    diagonal: FloatArray
    off_diagonal: FloatArray

    def plus(self, value: float) -> 'Tridiagonal':
        """Return the matrix with a value added to the diagonal."""
        return Tridiagonal(self.diagonal + value, self.off_diagonal)

    def times(self, vector: FloatArray) -> FloatArray:
        """Return the product with a vector."""
        product = self.diagonal * vector
        product[:-1] += self.off_diagonal * vector[1:]
        product[1:] += self.off_diagonal * vector[:-1]
        return np.asarray(product)

    def pivots(self) -> tuple[FloatArray, FloatArray]:
        """Return the diagonal and the multipliers of the factors L D L'."""
        pivots, multipliers, fault = lapack.dpttrf(self.diagonal, self.off_diagonal)
        if fault:
            raise np.linalg.LinAlgError('the normal matrix of the pulse errors is not positive '
                                        'definite')
        return pivots, multipliers

    def solve(self, right: FloatArray) -> FloatArray:
        """Return the solution for one right-hand side (n,) or several (n, k)."""
        return np.asarray(lapack.dpttrs(*self.pivots(), right)[0].reshape(right.shape))

    def inverse(self) -> FloatArray:
        """Return the diagonal and the next diagonal (2, n) of the inverse."""
        down, multipliers = self.pivots()
        up = Tridiagonal(self.diagonal[::-1], self.off_diagonal[::-1]).pivots()[0][::-1]
        found = np.zeros((2, len(down)))
        found[0] = 1.0 / (down + up - self.diagonal)
        found[1, :-1] = -multipliers * found[0, 1:]
        return found

    def covariance(self) -> FloatArray:
        """
        Return variances and covariances with the next (2, n) of normal variables of mean 0.

        The matrix is their information; that their mean is 0 is known besides.
        """
        count, found = len(self.diagonal), self.inverse()
        common = self.solve(np.ones(count))
        mean = common.sum() / count**2
        found[0] += mean - 2.0 * common / count
        found[1, :-1] += mean - (common[:-1] + common[1:]) / count
        return found


def shortest_path(costs: Sequence[FloatArray], steps: Sequence[FloatArray]
                  ) -> tuple[list[int], float]:
    """
    Return the places that cost least together, one of each row, and what they cost.

    `costs` are those of the places of each row, `steps` (row - 1 of (place, place)) those from
    one row to the next (Viterbi 1967).
    """
    total, came = costs[0], []
    for cost, step in zip(costs[1:], steps):
        whole = total[:, None] + step
        came.append(np.argmin(whole, axis=0))
        total = whole.min(axis=0) + cost
    path = [int(np.argmin(total))]
    for row in reversed(came):
        path.append(int(row[path[-1]]))
    return path[::-1], float(total.min())
