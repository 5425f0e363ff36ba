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

States stand at nodes, before and after each cell: angle, speed and acceleration of the shaft, a
random walk, and for every line, and for all together, a phase of their own and its rate, which
wanders: resonances turn it smoothly. In a cell a line observes its order times the mean of the
angle over the taper, plus these phases. The precision of the states is block-tridiagonal: one
banded Cholesky factor gives mode, covariances and marginal likelihood, by which the sizes of the
random walks are chosen.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import factorial

import numpy as np
from sa_jitter_ros.arrays import FloatArray
from scipy.linalg import cho_solve_banded, cholesky_banded, LinAlgError
from scipy.optimize import minimize

_SHAFT, _OWN = 3, 2  # states of the shaft, and of a line
MEMORY = 100.0  # cells that the rate of the phase of a line lasts: about a resonance
_SHARED = 2.0  # of what lines turn by themselves, all turn: resonances have one direction
_WIDE = (10.0, 1e4, 1e3)  # standard deviations of them at the first node, rad, rad/cell, ...
_UNSCALED = np.linalg.inv([[1 / 20, 1 / 8, 1 / 6], [1 / 8, 1 / 3, 1 / 2], [1 / 6, 1 / 2, 1]])
MOST_OWN = 0.1  # rad a cell, of lines of one shaft: a resonance takes some tens of cells


@dataclass(frozen=True)
class Walk:
    """
    Sizes of the random walks.

    `shaft`: variance of the acceleration a cell, in rad^2 of the highest order; `own`: standard
    deviation of the rate of the own phase of a line, rad a cell.
    """

    shaft: float
    own: float


STARTS = tuple(Walk(shaft, own) for shaft in (1e-1, 1e-4, 1e-7) for own in (1e-5, 1e-2))


@dataclass(frozen=True)
class Seen:
    """
    What the lines show in cells.

    `times` (cell,); `moments` (cell, 2) of the time from them, and of its square, over the taper;
    `orders` (line,) over the highest; `phase` (line, cell) in rad with `precision` (line, cell),
    which is 0 where a line shows nothing.
    """

    times: FloatArray
    moments: FloatArray
    orders: FloatArray
    phase: FloatArray
    precision: FloatArray

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
        own = _OWN * (lines + 1) if lines > 1 else 0
        found = np.zeros((len(self.times), lines, 2, _SHAFT + own))
        found[..., :2] = self.taper[:, None] * self.orders[:, None, None]
        if lines > 1:
            found[:, :, 1, _SHAFT::_OWN] = np.column_stack([np.eye(lines), np.ones(lines)])
        return found.reshape(*found.shape[:2], -1)


class Posterior:
    """The states at all nodes (node, state), given what the lines show."""

    def __init__(self, seen: Seen, walk: Walk) -> None:
        rows = seen.rows
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
        self._parts = [(slice(0, _SHAFT), *_jerk(steps, walk.shaft), np.array(_WIDE))]
        for begin in range(_SHAFT, width, _OWN):
            size = _SHARED * walk.own if begin == width - _OWN else walk.own
            self._parts.append((slice(begin, begin + _OWN), *_wander(steps, size), size * np.array(
                [np.sqrt(2.0 * MEMORY * len(steps)), 1.0])))
        self.diagonal = np.zeros((len(steps) + 1, width, width))
        self.below = np.zeros((len(steps), width, width))
        for place, kept, inverse, first in self._parts:
            moved = inverse @ kept
            self.diagonal[:-1, place, place] += kept.transpose(0, 2, 1) @ moved
            self.diagonal[1:, place, place] += inverse
            self.diagonal[0, place, place] += np.diag(first**-2.0)
            self.below[:, place, place] -= moved

    def evidence(self, states: FloatArray) -> float:
        """Return the logarithm of the density of states (node, state), without constants."""
        found = 0.0
        for place, kept, inverse, first in self._parts:
            part = states[:, place]
            new = part[1:] - np.einsum('kij,kj->ki', kept, part[:-1])
            found += 0.5 * float(np.sum(np.linalg.slogdet(inverse)[1]) - np.einsum(
                'ki,kij,kj', new, inverse, new) - np.sum((part[0] / first) ** 2))
            found -= float(np.sum(np.log(first)))
        return found


def _jerk(steps: FloatArray, size: float) -> tuple[FloatArray, FloatArray]:
    """Return the transition (step, 3, 3) of a white jerk, and the precision of what is new."""
    down = [[j - i for j in range(_SHAFT)] for i in range(_SHAFT)]
    kept = np.array([[steps**k / factorial(k) if k >= 0 else 0.0 * steps for k in row]
                     for row in down]).transpose(2, 0, 1)
    up = np.array([[5 - i - j for j in range(_SHAFT)] for i in range(_SHAFT)])
    return kept, _UNSCALED / (size * steps[:, None, None] ** up)


def _wander(steps: FloatArray, size: float) -> tuple[FloatArray, FloatArray]:
    """Return the same (step, 2, 2) of a phase whose rate wanders by `size`, rad a cell."""
    decay, one = np.exp(-steps / MEMORY), np.ones(len(steps))
    kept = np.array([[one, MEMORY * (1.0 - decay)], [0.0 * one, decay]]).transpose(2, 0, 1)
    both = MEMORY * (1.0 - decay) ** 2
    new = np.array([[MEMORY**2 * (2.0 * steps / MEMORY - 3.0 + 4.0 * decay - decay**2), both],
                    [both, 1.0 - decay**2]]).transpose(2, 0, 1)
    return kept, np.linalg.inv(new) / size**2


def fitted(seen: Seen, starts: Sequence[Walk], most: float = MOST_OWN) -> tuple[Walk, Posterior]:
    """
    Return the walk with the most evidence, sought beside one of `starts`, and its states.

    Lines turn by themselves by up to `most`, rad a cell.
    """
    bounds = np.log([[1e-12, 1e4], [1e-7, most]]).T

    def walk_of(sizes: FloatArray) -> Walk:
        return Walk(*np.exp(np.clip(sizes, *bounds)).tolist())

    def loss(sizes: FloatArray) -> float:
        try:
            evidence = Posterior(seen, walk_of(sizes)).evidence
        except (LinAlgError, np.linalg.LinAlgError):
            return 1e12
        return -evidence + 10.0 * float(np.sum((sizes - np.clip(sizes, *bounds)) ** 2))

    begin = min((np.log([walk.shaft, walk.own]) for walk in starts), key=loss)
    walk = walk_of(minimize(loss, begin, method='Nelder-Mead', options={
        'initial_simplex': begin + np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 3.0]]),
        'xatol': 0.2, 'fatol': 0.2, 'maxfev': 25}).x)
    return walk, Posterior(seen, walk)
