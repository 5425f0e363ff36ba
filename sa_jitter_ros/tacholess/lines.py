# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Lines of the machine in short cells along an angle: complex amplitudes, and their noise."""

from dataclasses import dataclass
import warnings

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.arrays import Array, ComplexArray, FloatArray
from sa_jitter_ros.tacholess.evidence import best_path
from scipy.ndimage import uniform_filter1d

_PIECE = 1 << 19  # samples of a channel at a time, so that memory stays small
_CAP = 4.0  # amplitude over noise beyond which a line has no more to say of the first phase
_TURN = 0.6  # of the strongest order, between cells, within which the first phase is sought
_SEEN = 0.5  # share of the cells in which a channel has samples, at least
_RADIAL = 3.05  # power of noise over what `noise_power` finds in its part along the line
_USUAL = 0.25  # of it, beyond which a change is unlikely
_OVERLAP = 4.0 / 3.0  # noise of tapered cells that overlap by half, over that of single ones
NOISE_CELLS = 64  # over which noise is constant


@dataclass(frozen=True)
class Cells:
    """
    Complex amplitudes (line, cell) of lines in cells, each of them seen by a Hann taper.

    The taper of cell k is centred about `times[k]` (cell,) and is 0 at its neighbours. Over it the
    mean of the angle by which the lines were demodulated is `angle[k]` revolutions, and that of
    the time from `times[k]`, and of its square, is `moments` (cell, 2). NaN: samples are lacking.
    `orders` (line,) are those of the lines.
    """

    times: FloatArray
    angle: FloatArray
    moments: FloatArray
    orders: FloatArray
    values: ComplexArray


def demodulated(vibration: FloatArray, sample_rate: float, angle: FloatArray, revolutions: int,
                orders: FloatArray) -> Cells:
    """
    Return orders of vibration (channel, sample), all channels together, in cells.

    `angle` (sample,) in revolutions rises from sample to sample; a cell has `revolutions`.
    """
    first = np.ceil(angle[0] / revolutions)
    marks = revolutions * np.arange(first, np.floor(angle[-1] / revolutions) + 1)
    edges = np.searchsorted(angle, marks)
    times = np.interp(marks[1:-1], angle, np.arange(angle.size) / sample_rate)
    cells = len(marks) - 2
    values = np.zeros((len(orders), len(vibration), cells), complex)
    mean, moments = np.zeros(cells), np.zeros((cells, 2))
    per_piece = max(int(_PIECE * cells / (edges[-1] - edges[0])), 4)
    for start in range(0, cells, per_piece):
        part = slice(start, min(start + per_piece, cells))
        inside = slice(edges[start], edges[part.stop + 1])
        piece = angle[inside]
        tapered = _Tapers(piece / revolutions - first - start,
                          edges[start:part.stop + 1] - edges[start])
        after = np.arange(inside.start, inside.stop) / sample_rate - times[start]
        here = times[part] - times[start]
        when = tapered.means(after)
        moments[part, 0] = when - here
        moments[part, 1] = tapered.means(after**2) - 2.0 * here * when + here**2
        mean[part] = tapered.means(piece - piece[0]) + piece[0]
        for order, found in zip(orders, values):
            turning = np.exp(-2j * np.pi * np.remainder(order * piece, 1.0))
            for channel, samples in enumerate(vibration[:, inside]):
                found[channel, part] = 2.0 * tapered.means(samples * turning)
    return Cells(times, mean, moments, orders, np.array([_together(item) for item in values]))


def _together(values: ComplexArray) -> ComplexArray:
    """Return the sum (cell,) of the channels (channel, cell) of a line that stands out most."""
    values = values[np.isfinite(values).mean(axis=1) > _SEEN]
    if not len(values):
        return np.full(values.shape[1], np.nan + 0j)
    white = values / np.sqrt(np.median(noise_power(values), axis=1, keepdims=True))
    known = np.nan_to_num(white)
    _, vectors = np.linalg.eigh(known @ known.conj().T)
    return np.where(np.isfinite(white).any(axis=0), vectors[:, -1].conj() @ known, np.nan)


class _Tapers:
    """Hann tapers over two cells each; `place` (sample,) in cells, which begin at `bounds`."""

    def __init__(self, place: FloatArray, bounds: NDArray[np.intp]) -> None:
        self._bounds = bounds
        self._rising = np.sin(0.5 * np.pi * np.remainder(place, 1.0)) ** 2
        self._weight = self._sums(np.ones(place.size))

    def _sums(self, values: Array) -> Array:
        whole = np.add.reduceat(values, self._bounds)
        up = np.add.reduceat(values * self._rising, self._bounds)
        return np.asarray(up[:-1] + (whole - up)[1:])

    def means(self, values: Array) -> Array:
        """Return for each cell the weighted mean of values (sample,)."""
        return np.asarray(self._sums(values) / self._weight)


def noise_power(values: Array) -> FloatArray:
    """
    Return the power (line, cell) of the noise of cells, from their changes.

    Those of the cell after next do not share samples; medians leave steps and strangers aside.
    """
    change = np.abs(values[:, 2:] - values[:, :-2]) ** 2 / (2.0 * np.log(2.0))
    count = max(change.shape[1] // NOISE_CELLS, 1)
    parts = np.array_split(np.arange(change.shape[1]), count)
    with warnings.catch_warnings():
        warnings.simplefilter('ignore', RuntimeWarning)  # of parts without a sample
        levels = np.array([np.nanmedian(change[:, part], axis=1) for part in parts])
    middles = [part.mean() + 1.0 for part in parts]
    cells = np.arange(values.shape[1])
    found = np.empty(values.shape)
    for line, level in enumerate(levels.T):
        good = np.isfinite(level) & (level > 0.0)
        found[line] = np.exp(np.interp(cells, np.array(middles)[good], np.log(level[good]))
                             ) if good.any() else np.inf
    return _OVERLAP * found


def first_correction(cells: Cells) -> FloatArray:
    """
    Return the angle (cell,), in revolutions, to be added to that of the cells.

    From cell to cell all lines turn by their order times the same angle: the path of this angle
    with the most agreement, as a whole.
    """
    power = _RADIAL * noise_power(np.abs(cells.values))  # which a wrong speed leaves alone
    seen = np.nan_to_num(cells.values / np.sqrt(power), nan=0.0, posinf=0.0, neginf=0.0)
    seen = seen / np.sqrt(1.0 + np.abs(seen) ** 2 / _CAP**2)
    turns = seen[:, 1:] * seen[:, :-1].conj()
    highest = cells.orders.max()
    steps = np.linspace(-_TURN, _TURN, 97) / highest
    agreement = np.real(np.exp(-2j * np.pi * steps[:, None] * cells.orders) @ turns)
    agreement -= len(seen) * (steps[:, None] * highest / _USUAL) ** 2
    path, _ = best_path(agreement.T.astype(np.float32), 12.0)
    return np.concatenate([[0.0], np.cumsum(uniform_filter1d(steps[path], 3, mode='nearest'))])
