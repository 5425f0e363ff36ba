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
from sa_jitter_ros.tacholess.lines import Cells, demodulated, first_correction, noise_power
from sa_jitter_ros.tacholess.smoother import fitted, Posterior, Seen, STARTS, Walk
from scipy.interpolate import CubicHermiteSpline
from scipy.ndimage import uniform_filter1d
from scipy.sparse import csr_matrix

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

_WIDTHS = (8, 32, 128)  # cells over which the own phase of a line is constant, at first and later
_PASSES = 2
_NEWTON = 4  # steps to a time of a pulse
MOST_LINES = 8
_WHITE = 0.75  # of the variance of overlapping cells remains where their noise is white
_STRANGE = 25.0  # squared residual over its variance that no noise makes
_FEWEST_BINS = 8  # over which the slow part of the noise is measured
_MOST_STRANGE = 0.2  # share of such cells, beyond which the line is
_LEAST = 40.0  # sum of the ratios of power of line and noise over cells, of a line that is there


@dataclass(frozen=True)
class Phase:
    """
    The angle of the shaft from cell to cell.

    `posterior` has it in rad of the order `highest`, from `first` revolutions; the lines of
    `cells` were used, which show what is `seen`; `misfit` (line,) is the variance of residuals
    over that of the noise.
    """

    cells: Cells
    seen: Seen
    posterior: Posterior
    walk: Walk
    first: float
    highest: float
    misfit: FloatArray

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
        nodes, states = self.seen.nodes, self.states
        found = CubicHermiteSpline(nodes, states[:, 0], states[:, 1])(times)
        bends = np.diff(states[:, 1]) / np.diff(nodes)
        for outside, end in ((times < nodes[0], 0), (times > nodes[-1], -1)):
            after = times[outside] - nodes[end]
            found[outside] = states[end, 0] + after * (states[end, 1] + 0.5 * after * bends[end])
        return np.asarray(found)

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
             orders: FloatArray) -> Phase | None:
    """Return the phase by lines of some orders along a rough angle; None if none is there."""
    times = np.arange(angle.size) / sample_rate
    found = None
    for number in range(_PASSES):
        found = _smoothed(demodulated(vibration, sample_rate, angle, revolutions, orders), found)
        if found is None or number == _PASSES - 1:
            break
        orders, angle = found.cells.orders, found.angle(times)
        if not np.all(np.diff(angle) > 0.0):
            return None
    return found


def _smoothed(cells: Cells, before: Phase | None) -> Phase | None:
    """Return the phase by the lines of cells, the strongest of them; None if none is there."""
    if not len(cells.orders):
        return None
    correction = first_correction(cells) if before is None else np.zeros(len(cells.times))
    starts = STARTS if before is None else [before.walk]
    for width in _WIDTHS if before is None else _WIDTHS[-1:]:
        seen, kept = _seen(cells, correction, width, trusted=before is not None)
        cells = cells.chosen(kept)
        if not len(cells.orders):
            return None
        walk, posterior = fitted(seen, starts)
        starts, highest = [walk], float(cells.orders.max())
        ends = np.stack([posterior.mode[:-1, :2], posterior.mode[1:, :2]], axis=1)
        mean = np.sum(ends * seen.taper, axis=(1, 2))
        correction = mean / (2.0 * np.pi * highest) - (cells.angle - cells.angle[0])
    misfit, slow = _misfit(seen, posterior)
    # Residuals that are larger than the noise of the cells count as noise.
    fair = replace(seen, precision=seen.precision / np.maximum(1.0, np.maximum(
        misfit, slow))[:, None])
    return Phase(cells, fair, Posterior(fair, walk), walk, float(cells.angle[0]), highest, misfit)


def _seen(cells: Cells, correction: FloatArray, width: int, *, trusted: bool
          ) -> tuple[Seen, NDArray[np.bool_]]:
    """
    Return what the lines show about an angle, and which of them are strong enough to be kept.

    About an angle that is `trusted`, cells that no noise explains are left out.
    """
    turn = 2.0 * np.pi * cells.orders[:, None]
    present = np.isfinite(cells.values)
    still = np.where(present, cells.values, 0.0) * np.exp(-1j * turn * correction)
    power = noise_power(np.where(present, still, np.nan))
    width = min(width, max(still.shape[1] // 2, 1))
    own = np.unwrap(np.angle(_mean(still, width)), axis=1)
    still = still * np.exp(-1j * own)
    share = np.maximum(_mean(present.astype(float), width).real, 1e-3)
    size = np.maximum(_mean(still, width).real / share, 1e-30)
    precision = np.where(present, 2.0 * size**2 / power, 0.0)
    strange = precision * (np.abs(still - size) / size) ** 2 > 2.0 * _STRANGE
    precision[strange & trusted & (strange.mean(axis=1) < _MOST_STRANGE)[:, None]] = 0.0
    phase = own + still.imag / size + turn * (cells.angle - cells.angle[0] + correction)
    weight = precision.sum(axis=1)
    kept = weight > 2.0 * _LEAST
    strong = np.argsort(-weight * cells.orders**2 * kept)[:MOST_LINES]
    kept &= np.isin(np.arange(len(kept)), strong)
    orders = cells.orders[kept]
    return Seen(cells.times, cells.moments, orders / orders.max(initial=1e-9), phase[kept],
                precision[kept], (still.real / size - 1.0)[kept]), kept


def _mean(values: NDArray[np.generic], width: int) -> ComplexArray:
    """Return running means (line, cell)."""
    return np.asarray(uniform_filter1d(values.real, width, axis=1, mode='nearest')
                      + 1j * uniform_filter1d(values.imag, width, axis=1, mode='nearest'))


def _misfit(seen: Seen, posterior: Posterior) -> tuple[FloatArray, FloatArray]:
    """Return variances (line,) over those of white noise: of residuals, and of the slow noise."""
    rows, precision = seen.rows, seen.precision
    known = np.sum((rows @ posterior.pairs) * rows, axis=2).T
    left = np.sum((precision > 0.0) * (1.0 - precision * known), axis=1)
    found = np.sum(precision * posterior.rest**2, axis=1) / np.maximum(left, 1.0) / _WHITE
    # The phase follows what is slow in the noise; the amplitude shows how much of that there is.
    band = max(int(0.5 * np.sum(precision * known)), _FEWEST_BINS)
    slow = np.abs(np.fft.rfft(np.sqrt(precision) * seen.amplitude, axis=1)[:, 1:band + 1]) ** 2
    level = slow.mean(axis=1) / np.maximum(np.count_nonzero(precision, axis=1), 1)
    return found, np.where(level > 1.0 + 3.0 / np.sqrt(slow.shape[1]), level, 1.0)
