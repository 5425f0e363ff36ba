# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The normal equations of the record fit: cycles in a band, amplitudes of lines beside it."""

from dataclasses import dataclass

import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.averaging.neighbour_equations import Tridiagonal
from scipy.linalg import cho_factor, cho_solve


@dataclass(frozen=True)
class Solved:
    """
    The normal equations of a step, solved; states and right-hand sides times `scale`.

    Bends and gain of a cycle meet those of others only through the errors of its two pulses. So
    they are eliminated cycle by cycle, and what is left of the states is a tridiagonal matrix
    `errors` of the errors. `root` (pulse, rest, rest) is the inverse
    Cholesky factor of bends and gain, `through` (pulse, rest, 2) how they follow the errors of
    the two pulses, `border` (pulse, state, amplitude) that of the amplitudes, `inner` (pulse,
    amplitude) how the errors follow the amplitudes, `schur` the factor of what is left of these.
    """

    scale: Array
    root: Array
    through: Array
    errors: Tridiagonal
    border: Array
    inner: Array
    schur: tuple[Array, bool]

    @classmethod
    def of(cls, cells: Array, border: Array, corner: Array, scale: Array) -> 'Solved':
        """Solve for `cells` (pulse, state + 1, state + 1) of the states and the next error."""
        own = cells[:, 1:-1, 1:-1].copy()
        own[:, np.arange(own.shape[1]), np.arange(own.shape[1])] = 1.0  # with the precision
        root = np.linalg.inv(np.linalg.cholesky(own))
        coupling = root @ cells[:, 1:-1, [0, -1]]
        less = np.moveaxis(coupling, 1, 2) @ coupling
        left = Tridiagonal(1.0 - less[:, 0, 0], (cells[:, 0, -1] - less[:, 0, 1])[:-1])
        left.diagonal[1:] -= less[:-1, 1, 1]
        through = np.moveaxis(root, 1, 2) @ coupling
        errors = _of_errors(through, border)
        inner = left.solve(errors)
        rest = (root @ border[:, 1:]).reshape(-1, border.shape[2])
        schur = cho_factor(corner - rest.T @ rest - errors.T @ inner)
        return cls(scale, root, through, left, border, inner, schur)

    def of_states(self, right: Array) -> Array:
        """Return the states (pulse, state) for a right-hand side with the amplitudes as 0."""
        errors = self.errors.solve(_of_errors(self.through, right[..., None])[:, 0])
        after = np.append(errors[1:], 0.0)
        rest = np.einsum('kji,kjl,kl->ki', self.root, self.root, right[:, 1:])
        rest -= self.through[:, :, 0] * errors[:, None] + self.through[:, :, 1] * after[:, None]
        return np.column_stack([errors, rest])

    def of_errors(self, right: Array) -> Array:
        """Return the errors (pulse, ...) for a right-hand side of the errors, amplitudes free."""
        return np.asarray(self.errors.solve(right)
                          + self.inner @ cho_solve(self.schur, self.inner.T @ right))

    def of_state(self, state: int) -> tuple[Array, Array]:
        """Return variances (pulse,) with the amplitudes as 0, and how it follows these."""
        variance, beside = self.errors.inverse()
        if not state:
            return variance, self.inner
        i = state - 1
        one, other = self.through[:, i].T
        own = np.einsum('kj,kjl->kl', self.root[:, :, i], self.root)
        inner = np.einsum('kl,kla->ka', own, self.border[:, 1:])
        local = own[:, i] + one**2 * variance
        local[:-1] += other[:-1] ** 2 * variance[1:] + 2.0 * (one * other * beside)[:-1]
        inner -= one[:, None] * self.inner
        inner[:-1] -= other[:-1, None] * self.inner[1:]
        return local, inner


def _of_errors(through: Array, right: Array) -> Array:
    """Return right-hand sides (pulse, ...) of errors for those of states (pulse, state, ...)."""
    each = np.moveaxis(through, 1, 2) @ right[:, 1:]
    found = right[:, 0] - each[:, 0]
    found[1:] -= each[:-1, 1]
    return np.asarray(found)
