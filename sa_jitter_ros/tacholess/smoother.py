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
Phase of a shaft from its lines: a linear Gaussian Markov model, solved for all cells at once.

States stand at nodes, before and after each cell: angle, speed and acceleration of the shaft, and
the own phase of every line. The acceleration and the own phases are random walks. In a cell a line
observes its order times the mean of the angle over the taper, plus its own phase. The precision of
the states is block-tridiagonal: one banded Cholesky factor gives mode, covariances and marginal
likelihood, by which the sizes of the random walks are chosen.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import factorial

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve_banded, cholesky_banded, LinAlgError
from scipy.optimize import minimize

FloatArray = NDArray[np.float64]

_SHAFT = 3  # states of the shaft
_WIDE = (1e-3, 1e4, 1e3)  # standard deviations of them at the first node, rad, rad/cell, ...
_WIDE_PHASE = 10.0  # rad, of the own phase of a line at the first node
_UNSCALED = np.linalg.inv([[1 / 20, 1 / 8, 1 / 6], [1 / 8, 1 / 3, 1 / 2], [1 / 6, 1 / 2, 1]])
_RANGE = np.log([[1e-12, 1e4], [1e-9, 1e-1]])  # of the sizes of walks


@dataclass(frozen=True)
class Walk:
    """
    Sizes of the random walks, as variances a cell of mean length.

    `shaft` of its acceleration, in rad^2 of the highest order, `own` of the phase of a line.
    """

    shaft: float
    own: float


STARTS = (Walk(1e-1, 1e-6), Walk(1e-4, 1e-6), Walk(1e-7, 1e-6))


@dataclass(frozen=True)
class Seen:
    """
    What the lines show in cells.

    `times` (cell,); `moments` (cell, 2) of the time from them, and of its square, over the taper;
    `orders` (line,) over the highest; `phase` (line, cell) in rad with `precision` (line, cell),
    which is 0 where a line shows nothing; `amplitude` (line, cell) over its running mean, less 1.
    """

    times: FloatArray
    moments: FloatArray
    orders: FloatArray
    phase: FloatArray
    precision: FloatArray
    amplitude: FloatArray

    @cached_property
    def unit(self) -> float:
        """Return the mean length of a cell, s: the unit of time of the states."""
        return float(np.mean(np.diff(self.times)))

    @cached_property
    def nodes(self) -> FloatArray:
        """Return the times (cell + 1,) between the cells, before and after them."""
        middle = 0.5 * (self.times[1:] + self.times[:-1])
        return np.concatenate([[2.0 * self.times[0] - middle[0]], middle,
                               [2.0 * self.times[-1] - middle[-1]]])

    @cached_property
    def taper(self) -> FloatArray:
        """Return factors (cell, 2 nodes, angle and speed) of the mean angle over the taper."""
        steps = np.diff(self.nodes) / self.unit
        apart = (self.times - 0.5 * (self.nodes[1:] + self.nodes[:-1])) / self.unit
        first = self.moments[:, 0] / self.unit
        second = self.moments[:, 1] / self.unit**2 + 2.0 * first * apart + apart**2
        # In the middle: mean angle and half a step of the bend, change of the angle, and the bend.
        turn, bend = (first + apart) / steps, 0.5 * second / steps - steps / 8.0
        return np.stack([np.column_stack([0.5 - turn, -bend]),
                         np.column_stack([0.5 + turn, bend])], axis=1)

    @cached_property
    def rows(self) -> FloatArray:
        """Return what each line sees (cell, line, 2 nodes x state) of the states."""
        lines = len(self.orders)
        found = np.zeros((len(self.times), lines, 2, _SHAFT + (lines if lines > 1 else 0)))
        found[..., :2] = self.taper[:, None] * self.orders[:, None, None]
        if lines > 1:
            found[:, :, 1, _SHAFT:] = np.eye(lines)
        return found.reshape(*found.shape[:2], -1)


class Posterior:
    """The states at all nodes (node, state), given what the lines show."""

    def __init__(self, seen: Seen, walk: Walk) -> None:
        rows = seen.rows
        self.unit = seen.unit
        count, width = len(seen.nodes), rows.shape[2] // 2
        prior = _Prior(np.diff(seen.nodes) / seen.unit, width, walk)
        weighted = seen.precision.T[..., None] * rows
        both = weighted.transpose(0, 2, 1) @ rows
        diagonal, below = prior.diagonal, prior.below + both[:, width:, :width]
        diagonal[:-1] += both[:, :width, :width]
        diagonal[1:] += both[:, width:, width:]
        band = np.zeros((2 * width, count * width))
        for i in range(width):
            for j in range(width):
                if i >= j:
                    band[i - j, j::width] = diagonal[:, i, j]
                band[width + i - j, j::width][:count - 1] = below[:, i, j]
        self._factor = cholesky_banded(band, lower=True, check_finite=False)
        pulled = np.einsum('lk,kli->ki', seen.phase, weighted)
        right = np.zeros((count, width))
        right[:-1] += pulled[:, :width]
        right[1:] += pulled[:, width:]
        mode = cho_solve_banded((self._factor, True), right.ravel(), check_finite=False)
        self.mode = mode.reshape(count, width)
        self.rest = seen.phase - np.einsum(
            'kli,ki->lk', rows, np.concatenate([self.mode[:-1], self.mode[1:]], axis=1))
        # The same for all sizes of walks, and left out: the determinant of the precisions.
        self.evidence = (prior.evidence(self.mode) - float(np.log(self._factor[0]).sum())
                         - 0.5 * float(np.sum(seen.precision * self.rest**2)))

    def solved(self, right: FloatArray) -> FloatArray:
        """Return the covariance of the states with sums of them, `right` (node x state, sum)."""
        return np.asarray(cho_solve_banded((self._factor, True), right, check_finite=False))

    @cached_property
    def pairs(self) -> FloatArray:
        """Return covariances (cell, 2 nodes x state, the same) of the nodes beside it."""
        count, width, factor = len(self.mode), self.mode.shape[1], self._factor
        own, beside = np.zeros((2, count, width, width))
        for i in range(width):
            for j in range(width):
                if i >= j:
                    own[:, i, j] = factor[i - j, j::width]
                beside[:, i, j] = factor[width + i - j, j::width]
        inverse = np.linalg.inv(own)
        found = inverse.transpose(0, 2, 1) @ inverse
        turned = beside @ inverse
        for k in range(count - 2, -1, -1):
            found[k] += turned[k].T @ found[k + 1] @ turned[k]
        along = -found[1:] @ turned[:-1]
        return np.concatenate([
            np.concatenate([found[:-1], along.transpose(0, 2, 1)], axis=2),
            np.concatenate([along, found[1:]], axis=2)], axis=1)


class _Prior:
    """Precision of the states before data: diagonal and below it; steps in units of a cell."""

    def __init__(self, steps: FloatArray, width: int, walk: Walk) -> None:
        shaft, own = slice(0, _SHAFT), slice(_SHAFT, width)
        down = [[j - i for j in range(_SHAFT)] for i in range(_SHAFT)]
        kept = np.array([[steps**k / factorial(k) if k >= 0 else 0.0 * steps for k in row]
                         for row in down]).transpose(2, 0, 1)
        # Inverse of the covariance of what integrals of white noise add, for a step and scaled.
        up = np.array([[5 - i - j for j in range(_SHAFT)] for i in range(_SHAFT)])
        inverse = _UNSCALED / (walk.shaft * steps[:, None, None] ** up)
        self._kept, self._inverse, self._own = kept, inverse, 1.0 / (walk.own * steps)
        self._first = np.array([*_WIDE, *[_WIDE_PHASE] * (width - _SHAFT)])
        self.diagonal = np.zeros((len(steps) + 1, width, width))
        self.below = np.zeros((len(steps), width, width))
        moved = inverse @ kept
        self.diagonal[:-1, shaft, shaft] += kept.transpose(0, 2, 1) @ moved
        self.diagonal[1:, shaft, shaft] += inverse
        self.below[:, shaft, shaft] -= moved
        change = self._own[:, None, None] * np.eye(width - _SHAFT)
        self.diagonal[:-1, own, own] += change
        self.diagonal[1:, own, own] += change
        self.below[:, own, own] -= change
        self.diagonal[0] += np.diag(self._first**-2.0)

    def evidence(self, states: FloatArray) -> float:
        """Return the logarithm of the density of states (node, state), without constants."""
        shaft, own = states[:, :_SHAFT], np.diff(states[:, _SHAFT:], axis=0)
        new = shaft[1:] - np.einsum('kij,kj->ki', self._kept, shaft[:-1])
        square = (np.einsum('ki,kij,kj', new, self._inverse, new)
                  + np.sum(self._own[:, None] * own**2) + np.sum((states[0] / self._first) ** 2))
        size = _SHAFT * len(new) * np.log(self._inverse[0, 0, 0]) + own.shape[1] * np.sum(
            np.log(self._own))
        return 0.5 * float(size - square)


def fitted(seen: Seen, starts: Sequence[Walk]) -> tuple[Walk, Posterior]:
    """Return the walk with the most evidence, sought beside one of `starts`, and its states."""
    def walk_of(sizes: FloatArray) -> Walk:
        return Walk(*np.exp(np.clip(sizes, *_RANGE.T)).tolist())

    def loss(sizes: FloatArray) -> float:
        try:
            evidence = Posterior(seen, walk_of(sizes)).evidence
        except (LinAlgError, np.linalg.LinAlgError):
            return 1e12
        return -evidence + 10.0 * float(np.sum((sizes - np.clip(sizes, *_RANGE.T)) ** 2))

    begin = min((np.log([walk.shaft, walk.own]) for walk in starts), key=loss)
    walk = walk_of(minimize(loss, begin, method='Nelder-Mead', options={
        'initial_simplex': begin + np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 3.0]]),
        'xatol': 0.1, 'fatol': 0.1, 'maxfev': 40}).x)
    return walk, Posterior(seen, walk)
