# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""From a rough speed to the phase of the shaft, with its errors: demodulate, smooth, again."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.arrays import ComplexArray, FloatArray
from sa_jitter_ros.errors import SignalError
from sa_jitter_ros.tacholess.lines import Cells, demodulated, first_correction, noise_power
from sa_jitter_ros.tacholess.smoother import fitted, MOST_OWN, Posterior, Seen, STARTS, Walk
from scipy.interpolate import CubicHermiteSpline
from scipy.ndimage import uniform_filter1d
from scipy.sparse import csr_matrix

UNKNOWN = ('the lines are too weak, change too fast, or do not turn together, to follow their '
           'phase without losing turns: give other orders or another sensor')
_WIDTHS = (8, 32, 128)  # cells over which the own phase of a line is constant, at first and later
_NEWTON = 4  # steps to a time of a pulse
_WHITE = 0.75  # of the variance of overlapping cells remains where their noise is white
_OWN_AT_FIRST = 0.03  # rad a cell, that a line may turn by itself before its noise is known
_ROUNDS = 8  # in which the noise of a line becomes that of its residuals
_KNOWN = 0.1  # of the residuals, as which the noise of before counts: some lines leave none


@dataclass(frozen=True)
class Phase:
    """
    The angle of the shaft from cell to cell.

    `posterior` has it in rad of the order `highest`, from `first` revolutions; the lines of
    `cells` were used, which show what is `seen`.
    """

    cells: Cells
    seen: Seen
    posterior: Posterior
    walk: Walk
    first: float
    highest: float

    @property
    def unit(self) -> FloatArray:
        """Return the angle and the speed of the states in revolutions and Hz."""
        turn = 2.0 * np.pi * self.highest
        return np.array([1.0 / turn, 1.0 / turn / self.seen.unit])

    @property
    def states(self) -> FloatArray:
        """Return angle and speed (node, 2) at the nodes, in revolutions and Hz."""
        return np.asarray(self.posterior.mode[:, :2] * self.unit + [self.first, 0.0])

    def angle(self, times: FloatArray) -> FloatArray:
        """Return angles (time,) in revolutions; beyond the nodes it goes on as it was."""
        return np.asarray(CubicHermiteSpline(self.seen.nodes, *self.states.T)(times))

    def times_of(self, turns: FloatArray) -> FloatArray:
        """Return when the angle is so many revolutions, between the nodes."""
        nodes, states = self.seen.nodes, self.states
        times = np.interp(turns, states[:, 0], nodes)
        for _ in range(_NEWTON):
            times = np.clip(times - (self.angle(times) - turns) / self.speed(times),
                            nodes[0], nodes[-1])
        return np.asarray(times)

    def rows(self, times: FloatArray, *, speed: bool = False) -> csr_matrix:
        """Return the factors (time, node x state) of the states in the angle, or in the speed."""
        nodes = self.seen.nodes
        place = np.clip(np.searchsorted(nodes, times, side='right') - 1, 0, len(nodes) - 2)
        step = nodes[place + 1] - nodes[place]
        u = (times - nodes[place]) / step
        factors = np.array([
            6 * u * (u - 1) / step, (1 - u) * (1 - 3 * u), 6 * u * (1 - u) / step, u * (3 * u - 2)
        ] if speed else [
            (1 + 2 * u) * (1 - u) ** 2, u * (1 - u) ** 2 * step, u**2 * (3 - 2 * u),
            u**2 * (u - 1) * step])
        width = self.posterior.mode.shape[1]
        columns = (place * width)[:, None] + [0, 1, width, width + 1]
        return csr_matrix(((factors.T * np.tile(self.unit, 2)).ravel(), columns.ravel(),
                           np.arange(0, 4 * len(times) + 1, 4)),
                          shape=(len(times), self.posterior.mode.size))

    def speed(self, times: FloatArray) -> FloatArray:
        """Return speeds (time,) in Hz between the nodes."""
        return np.asarray(self.rows(times, speed=True) @ self.posterior.mode.ravel())

    def variance(self, rows: csr_matrix) -> FloatArray:
        """Return variances (time,) of what rows (time, node x state) see."""
        width = self.posterior.mode.shape[1]
        columns = rows.indices.reshape(-1, 4)
        place = columns[:, 0] // width
        inside = columns - (place * width)[:, None]
        pairs = self.posterior.pairs[place[:, None, None], inside[:, :, None], inside[:, None]]
        factors = rows.data.reshape(-1, 4)
        return np.asarray(np.einsum('ki,kij,kj->k', factors, pairs, factors))


def phase_of(vibration: FloatArray, sample_rate: float, angle: FloatArray, revolutions: int,
             orders: FloatArray) -> Phase:
    """Return the phase by lines of some orders along a rough angle; raises SignalError."""
    found = _smoothed(demodulated(vibration, sample_rate, angle, revolutions, orders), None)
    angle = found.angle(np.arange(angle.size) / sample_rate)
    if not np.all(np.diff(angle) > 0.0):
        raise SignalError(UNKNOWN)
    return _smoothed(demodulated(vibration, sample_rate, angle, revolutions, orders), found.walk)


def _smoothed(cells: Cells, before: Walk | None) -> Phase:
    """Return the phase by the lines of cells, along a rough angle or that of a walk before."""
    highest = float(cells.orders.max())
    correction, starts = np.zeros(len(cells.times)), STARTS
    if before is None:
        correction = first_correction(cells)
        for width in _WIDTHS:
            seen = _seen(cells, correction, width)
            walk, posterior = fitted(seen, starts, _OWN_AT_FIRST)
            starts = (walk,)
            ends = np.stack([posterior.mode[:-1, :2], posterior.mode[1:, :2]], axis=1)
            mean = np.sum(ends * seen.taper, axis=(1, 2))
            correction = mean / (2.0 * np.pi * highest) - (cells.angle - cells.angle[0])
    else:
        seen, walk = _seen(cells, correction, _WIDTHS[-1]), before
        posterior = Posterior(seen, walk)
    for _ in range(_ROUNDS):
        seen = replace(seen, precision=seen.precision / _misfit(seen, posterior)[:, None])
        posterior = Posterior(seen, walk)
    walk, posterior = fitted(seen, [walk], _OWN_AT_FIRST if before is None else MOST_OWN)
    return Phase(cells, seen, posterior, walk, float(cells.angle[0]), highest)


def _seen(cells: Cells, correction: FloatArray, width: int) -> Seen:
    """Return what the lines show about an angle."""
    turn = 2.0 * np.pi * cells.orders[:, None]
    present = np.isfinite(cells.values)
    still = np.where(present, cells.values, 0.0) * np.exp(-1j * turn * correction)
    width = min(width, max(still.shape[1] // 2, 1))
    own = np.unwrap(np.angle(_mean(still, width)), axis=1)
    still = still * np.exp(-1j * own)
    power = noise_power(np.where(present, still, np.nan))
    share = np.maximum(_mean(present.astype(float), width).real, 1e-3)
    size = np.maximum(_mean(still, width).real / share, 1e-30)
    precision = np.where(present, 2.0 * size**2 / power, 0.0)
    phase = own + still.imag / size
    phase -= np.sum(precision * phase, axis=1, keepdims=True) / np.maximum(
        precision.sum(axis=1, keepdims=True), 1e-30)
    phase += turn * (cells.angle - cells.angle[0] + correction)
    return Seen(cells.times, cells.moments, cells.orders / cells.orders.max(), phase, precision)


def _mean(values: NDArray[np.generic], width: int) -> ComplexArray:
    """Return running means (line, cell)."""
    return np.asarray(uniform_filter1d(values.real, width, axis=1, mode='nearest')
                      + 1j * uniform_filter1d(values.imag, width, axis=1, mode='nearest'))


def _misfit(seen: Seen, posterior: Posterior) -> FloatArray:
    """Return the variance (line,) of residuals over that of white noise."""
    rows, precision = seen.rows, seen.precision
    known = np.sum((rows @ posterior.pairs) * rows, axis=2).T
    few = _KNOWN * np.count_nonzero(precision, axis=1) + 1.0
    left = np.sum((precision > 0.0) * (1.0 - precision * known), axis=1)
    return np.asarray((np.sum(precision * posterior.rest**2, axis=1) / _WHITE + few)
                      / (np.maximum(left, 0.0) + few))
