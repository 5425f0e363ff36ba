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
Pulse times and recovered errors of a recording, as the likelihood of its timing takes them.

Three series, one value a trigger pulse: second differences of the corrected pulse times, the
errors that were recovered from the vibration, and the bends inside the cycles. Errors of the
pulses are in the second series alone: in the measured times they would be there twice, and a
taper would let the difference of the two leak. Their cross-periodograms, in
bins of frequency, are what the likelihood is made of; a taper at both ends of every stretch keeps
the motion of the shaft from leaking.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.effects.band import recovered, recovered_shapes
from sa_jitter_ros.effects.timing import MOTION, PULSES, ROUNDING, Setting, SOURCE

#: Whole cycles a trigger cycle that a frequency may have more: itself and its neighbours.
ALIASES = np.array([0, 1, -1])
#: Power of the noise of the recovery, beside that in each direction.
NOISE = 'noise'
#: Share of a series, at either end, over which a `taper` rises or falls.
TAPER = 0.05
_BINS, _SHARP = 60, 12  # least numbers: of bins, and of the frequency over the width of one
#: Trigger cycles of a stretch from which it shows something.
FEWEST = 12


@dataclass(frozen=True)
class Stretch:
    """
    Consecutive trigger pulses and what was recovered at them.

    `measured` (pulse,) tells which pulses are no interpolation. `errors` (pulse,) in s are
    measured minus true times, with the noise `error_std` (s), shrunk by a prior of `prior_std` (s,
    infinite for none); `bends` (cycle,) in s are the factors of u (1 - u) inside the cycles, not
    shrunk, with the noise `bend_std` that a prior of `bend_prior_std` left. Against a reference
    keyphasor (`referenced`) no motion of the source shows. `sidebands` (k,) are those of several
    lines, in cycles a trigger cycle from them. Without a line that holds the angle to the pulses
    (`held`) any drift between them may be there.
    """

    setting: Setting
    measured: Array
    errors: Array
    error_std: float
    prior_std: float
    bends: Array
    bend_std: float
    bend_prior_std: float
    referenced: bool = False
    sidebands: Array = field(default_factory=lambda: np.zeros(0))
    held: bool = True


class TimingData:
    """
    Periodograms of some stretches and what is the same for every model of them.

    `frequency` (bin,) are the middles of bins of `size` ordinates; `alias` the frequencies (alias,
    bin) that fall on them, where errors of a direction have any; `steer` the cross-spectra (alias,
    bin, 3, 3) of unit errors in each direction; `passed` (bin, 3, 4) is what the recovery makes of
    them, `noise` (bin, 3, 3) what it adds. `table` (row, bin, 3, 3) has noise and `steer` of the
    measured pulses one after the other, in `rows` by name. `ordinates` (ordinate, 3) are the
    transforms at the frequencies `each`, and what sets stretches apart between which some cycles
    are left out.
    """

    def __init__(self, stretches: Sequence[Stretch]) -> None:
        self.stretches = list(stretches)
        self.unit = self.stretches[0].setting.unit
        self.lengths = [item.errors.size - 2 for item in self.stretches]
        self.longest = max(self.lengths)
        self.cycles = sum(self.lengths)
        self.measured = float(np.mean(np.concatenate([item.measured for item in self.stretches])))
        self._apart = _apart(self.stretches)
        frequency = np.concatenate([list(self._apart.values()), *map(_frequencies, self.lengths)])
        self._sorted = np.argsort(frequency, kind='stable')
        self.each = frequency = frequency[self._sorted]
        weight = np.concatenate([[0.5] * len(self._apart), *(
            np.where(_frequencies(n) == 0.5, 0.5, 1.0) * _effective(n)
            for n in self.lengths)])[self._sorted]
        edges = _edges(frequency.size, len(self.lengths), len(self._apart))
        self.edges, self.weight = edges, weight
        self.size = np.add.reduceat(weight, edges[:-1])
        self.frequency = np.add.reduceat(weight * frequency, edges[:-1]) / self.size
        self.bin = np.repeat(np.arange(self.size.size), np.diff(edges))
        # bends that nothing resolves are no series
        self.series = 3 if any(np.isfinite(item.bend_std) for item in self.stretches) else 2
        passed, noise = self._recovery()
        self.passed = passed[:, :self.series]
        self.noise = noise[:, :self.series, :self.series]
        self.steer = {}
        for name in (PULSES, SOURCE, MOTION):
            passed = np.stack([np.einsum('fij,fj->fi', self.passed, steering(
                name, self.frequency, self.frequency + n, referenced=self.referenced))
                for n in ALIASES])
            self.steer[name] = outer(passed)
        self.steer[PULSES] = self.steer[PULSES][:1]
        made = {NOISE: self.noise[None], **self.steer, PULSES: self.measured * self.steer[PULSES]}
        # of very large motion, rounding alone tells one series from the others
        self.table = np.concatenate(list(made.values()))
        self.table *= 1.0 + ROUNDING**1.5 * np.eye(self.series)
        ends = np.cumsum([0, *map(len, made.values())]).tolist()
        self.rows = dict(zip(made, map(slice, ends, ends[1:])))
        self.alias = {name: np.abs(self.frequency + ALIASES[:len(rows), None])
                      for name, rows in made.items()}
        self.ordinates = self.transform([self._series(item) for item in self.stretches])

    @property
    def referenced(self) -> bool:
        """Return whether the errors are those against a reference keyphasor."""
        return self.stretches[0].referenced

    @property
    def pulse_times(self) -> Array:
        """Return when the pulses of all stretches were measured (pulse,), in s."""
        return np.concatenate([item.setting.times[item.measured] for item in self.stretches])

    def _series(self, item: Stretch) -> Array:
        """Return the series (pulse - 2, 3) of a stretch; a missing pulse has no error."""
        n = item.errors.size - 2
        bends = item.bends[:n] / (1.0 + (item.bend_std / item.bend_prior_std) ** 2)
        return np.column_stack([np.diff(item.setting.times - item.errors, 2),
                                of_measured(item, item.errors)[:n], bends]) / self.unit

    def _recovery(self) -> tuple[Array, Array]:
        """
        Return what the recovery passes on (bin, 3, 4) and the noise that it adds (bin, 3, 3).

        It is the least squares fit of hat functions and bends to an angle error of white noise,
        with priors; the noise is as large as the stated standard errors.
        """
        stretch = self.stretches[0]
        priors = np.array([stretch.prior_std, stretch.bend_prior_std, stretch.bend_prior_std])
        prior = np.diag((self.unit / priors) ** 2)
        variance = float(np.mean([item.error_std for item in self.stretches]) / self.unit) ** 2
        normal = recovered_shapes(self.frequency)[1]

        def spread(information: float) -> float:
            inverse = np.linalg.inv(information * normal + prior)
            return float(np.average(inverse[:, 0, 0].real, weights=self.size))

        low, high = -30.0, 40.0
        for _ in range(60):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if spread(np.exp(middle)) > variance else (low, middle)
        information = float(np.exp(low)) * normal
        inverse = np.linalg.inv(information + prior)
        passed = np.zeros((self.frequency.size, 3, 4), complex)
        passed[:, 0, 0] = 1.0
        corrected = _corrected(self.frequency)
        noise = np.zeros((self.frequency.size, 3, 3), complex)
        if self.referenced:  # pulses that are compared with others need no recovery
            passed[:, 1, 1], noise[:, 1, 1] = 1.0, variance
        else:
            passed[:, 1:, 1:] = (inverse @ information)[:, :2]
            noise[:, 1:, 1:] = (inverse @ information @ inverse)[:, :2, :2]
        return (np.asarray(corrected @ passed),
                np.asarray(corrected @ noise @ corrected.conj().swapaxes(1, 2)))

    def transform(self, series: Sequence[Array]) -> Array:
        """Return the ordinates (ordinate, 3) of a series (pulse - 2, 3) of every stretch."""
        rows, means, spread = [], [], []
        for item in series:
            window = taper(len(item))
            means.append(np.average(item[:, :self.series], axis=0, weights=window))
            item = (item[:, :self.series] - means[-1]) * window[:, None]
            power = np.sum(window**2)
            rows.append(np.fft.rfft(item, axis=0)[1:len(item) // 2 + 1] / np.sqrt(power))
            spread.append(power / np.sum(window)**2)
        apart = [(means[i + 1] - means[i]) / np.sqrt(spread[i] + spread[i + 1])
                 for i in self._apart]
        return np.asarray(np.concatenate([np.reshape(apart, (-1, self.series)), *rows]
                                         )[self._sorted])

    def of_errors(self, errors: Sequence[Array]) -> Array:
        """Return the ordinates that errors (pulse,) make, in units; corrected times lack them."""
        return self.transform([np.column_stack([
            np.zeros(row.size - 2), of_measured(item, row)[:-2], np.zeros(row.size - 2)])
            for item, row in zip(self.stretches, errors)])

    def of_wave(self, direction: str, frequency: float) -> tuple[Array, Array]:
        """Return the ordinates of a unit cosine and sine of a frequency in a direction."""
        one = np.array([frequency])
        turn = steering(direction, one % 1.0, one, referenced=self.referenced)[0][:3]
        turn = _corrected(one)[0] @ turn
        waves = [np.exp(2j * np.pi * frequency * item.setting.index[:-2])[:, None] * turn
                 for item in self.stretches]
        return (self.transform([wave.real for wave in waves]),
                self.transform([wave.imag for wave in waves]))

    def made(self, density: Array, direction: str | None = None) -> Array:
        """Return the cross-spectrum (bin, 3, 3) of a density (row, bin), of all rows or some."""
        table = self.table[self.rows[direction]] if direction else self.table
        found = np.einsum('rf,rfk->fk', density, parts(table))
        return np.asarray(found.view(np.complex128).reshape(table.shape[1:]))

    def binned(self, ordinates: Array) -> Array:
        """Return the mean cross-periodogram (bin, 3, 3) of ordinates."""
        power = outer(ordinates) * self.weight[:, None, None]
        return np.asarray(np.add.reduceat(power, self.edges[:-1], axis=0)
                          / self.size[:, None, None])


def parts(matrices: Array) -> Array:
    """Return all real and imaginary parts of matrices (..., i, j) in one axis."""
    return matrices.view(np.float64).reshape(*matrices.shape[:-2], -1)


def of_measured(item: Stretch, errors: Array) -> Array:
    """Return errors (pulse,) with their mean in place of those of missing pulses."""
    return np.where(item.measured, errors, np.mean(errors[item.measured]))


def steering(direction: str, frequency: Array, turning: Array, *, referenced: bool = False
             ) -> Array:
    """
    Return what a unit wave makes of second differences, errors, bends and cubic bends (f, 4).

    `turning` is its frequency, of which whole cycles a trigger cycle are invisible at `frequency`.
    """
    z = np.exp(2j * np.pi * turning)
    none = np.zeros_like(z)
    pulses = np.stack([(z - 1.0) ** 2, np.ones_like(z), none, none], axis=-1)
    followed = recovered(frequency, turning)
    if referenced:  # the pulses are compared with other pulses, and bends are those of the speed
        followed[:, 0] = 0.0 if direction == SOURCE else 1.0
    source = np.concatenate([none[:, None], -followed], axis=1)
    found = {PULSES: pulses, SOURCE: source, MOTION: pulses + source}
    return np.asarray(found[direction])


def _corrected(frequency: Array) -> Array:
    """Return the matrix (f, 3, 3) that takes the errors out of the second differences."""
    matrix = np.tile(np.eye(3, dtype=complex), (frequency.size, 1, 1))
    matrix[:, 0, 1] = -(np.exp(2j * np.pi * frequency) - 1.0) ** 2
    return matrix


def outer(vectors: Array) -> Array:
    """Return vector times its conjugate, of the last axis."""
    return np.asarray(vectors[..., :, None] * vectors[..., None, :].conj())


def _frequencies(count: int) -> Array:
    return np.arange(1, count // 2 + 1) / count


def taper(count: int) -> Array:
    """Return a window (count,) that rises and falls at either end."""
    place = np.arange(count) + 0.5
    inside = np.minimum(place, count - place) / max(2.0, TAPER * count)
    return np.asarray(np.sin(0.5 * np.pi * np.clip(inside, 0.0, 1.0)) ** 2)


def _effective(count: int) -> float:
    """Return the share of the ordinates that count, which the taper correlates."""
    window = taper(count)
    return float(np.sum(window**2) ** 2 / np.sum(window**4) / count)


def _apart(stretches: Sequence[Stretch]) -> Mapping[int, float]:
    """
    Return which stretches go on behind a gap, and the frequency of what sets the two apart.

    Vibration that was fitted as a whole shows by how much more the pulses err behind the gap.
    """
    found = {}
    for i, (one, other) in enumerate(pairwise(stretches)):
        same = one.setting.fitted.size and np.array_equal(one.setting.fitted, other.setting.fitted)
        if same and one.held and not one.referenced:
            found[i] = 0.5 / float(other.setting.index.mean() - one.setting.index.mean())
    return found


def _edges(count: int, stretches: int, apart: int) -> Array:
    """
    Return the edges of bins of ordinates: single frequencies first, then wider ones.

    Those between stretches that are set `apart` have the first bin.
    """
    edges = [0, apart] if apart else [0]
    while edges[-1] < count:
        width = min(edges[-1] // _SHARP, count // _BINS) // stretches
        edges.append(min(edges[-1] + max(1, width) * stretches, count))
    return np.array(edges)
