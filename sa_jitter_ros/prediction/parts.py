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
Cumulants of the parts of a complex amplitude along and across a direction, with all their digits.

Small errors turn an amplitude by what they are and shorten it by their square. The sum and the
difference of the complex moments, of which the two parts consist, leave nothing of the smaller one
in 16 digits. Here each part has a number of its own, and the means are those of what is missing.
"""

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.prediction.moments import AverageMoments


@dataclass(frozen=True)
class Parts:
    """
    Cumulants of R and I where X = base + (R + j I) base / abs(base), one entry per amplitude.

    `base` is complex, all else is real: the means `r` and `i`, the covariances `rr`, `ri`, `ii`
    and the third cumulants `rrr`, `rri`, `rii`, `iii`.
    """

    base: Array
    r: Array
    i: Array
    rr: Array
    ri: Array
    ii: Array
    rrr: Array
    rri: Array
    rii: Array
    iii: Array

    @classmethod
    def about(cls, base: ArrayLike, moments: AverageMoments, unmixed: ArrayLike = 0.0,
              mixed: ArrayLike = 0.0) -> 'Parts':
        """Return the parts of an X with third cumulants k(X, X, X) and k(X, X, conj X)."""
        base = np.broadcast_to(np.asarray(base, complex), np.shape(moments.mean))
        turn = _direction(base).conj()
        off = (moments.mean - base) * turn
        pseudo = moments.pseudo_variance * turn**2
        whole = np.asarray(unmixed * turn**3)
        mixed = np.asarray(mixed * turn)
        return cls(
            base, off.real, off.imag, np.maximum(0.5 * (moments.variance + pseudo.real), 0.0),
            0.5 * pseudo.imag, np.maximum(0.5 * (moments.variance - pseudo.real), 0.0),
            0.25 * (3.0 * mixed.real + whole.real), 0.25 * (mixed.imag + whole.imag),
            0.25 * (mixed.real - whole.real), 0.25 * (3.0 * mixed.imag - whole.imag))

    @property
    def direction(self) -> Array:
        """Return base / abs(base), 1 where there is none."""
        return _direction(self.base)

    @property
    def size(self) -> Array:
        """Return abs(base)."""
        return np.abs(self.base)

    @property
    def moments(self) -> AverageMoments:
        """Return the complex moments."""
        turn = self.direction
        return AverageMoments(
            self.base + (self.r + 1j * self.i) * turn, self.rr + self.ii,
            (self.rr - self.ii + 2j * self.ri) * turn**2)

    def of(self, rows: Any) -> 'Parts':
        """Return the parts of some entries, as an index of the arrays picks them."""
        return Parts(*(getattr(self, item.name)[rows] for item in fields(self)))

    def raveled(self) -> 'Parts':
        """Return the parts in one row."""
        return Parts(*(np.ravel(getattr(self, item.name)) for item in fields(self)))

    def shrunk(self, factor: Array) -> 'Parts':
        """Return the parts under small errors that are all `factor` times as large."""
        return Parts(self.base, *(
            getattr(self, name) * factor ** (2 * name.count('r') + name.count('i'))
            for name in _CUMULANTS))

    def scaled(self, gain: ArrayLike) -> 'Parts':
        """Return the parts of gain * X."""
        size = np.abs(np.asarray(gain))
        return Parts(self.base * gain, *(
            getattr(self, name) * size ** len(name) for name in _CUMULANTS))

    def with_noise(self, variance: ArrayLike) -> 'Parts':
        """Return the parts of X + n with circular noise of variance E|n|^2."""
        half = 0.5 * np.asarray(variance)
        return replace(self, rr=self.rr + half, ii=self.ii + half)

    def shifted(self, shift: ArrayLike) -> 'Parts':
        """Return the parts of X + shift, along and across the new base."""
        return self._along(self.base + np.asarray(shift))

    def centred(self) -> 'Parts':
        """Return the parts along and across the mean, which becomes the base."""
        off = self.r + 1j * self.i
        found = self._along(self.base + off * self.direction)
        zero = np.zeros(np.shape(self.r))
        return replace(found, r=zero, i=zero)

    def _along(self, base: Array) -> 'Parts':
        """Return the parts in the direction of another base; the means stay those of X - base."""
        turn = self.direction * _direction(base).conj()
        c, s = turn.real, turn.imag
        off = (self.r + 1j * self.i) * turn
        return Parts(
            base, off.real, off.imag,
            c**2 * self.rr - 2.0 * c * s * self.ri + s**2 * self.ii,
            c * s * (self.rr - self.ii) + (c**2 - s**2) * self.ri,
            s**2 * self.rr + 2.0 * c * s * self.ri + c**2 * self.ii,
            c**3 * self.rrr - 3.0 * c**2 * s * self.rri + 3.0 * c * s**2 * self.rii
            - s**3 * self.iii,
            c**2 * s * self.rrr + (c**3 - 2.0 * c * s**2) * self.rri
            + (s**3 - 2.0 * c**2 * s) * self.rii + c * s**2 * self.iii,
            c * s**2 * self.rrr + (2.0 * c**2 * s - s**3) * self.rri
            + (c**3 - 2.0 * c * s**2) * self.rii - c**2 * s * self.iii,
            s**3 * self.rrr + 3.0 * c * s**2 * self.rri + 3.0 * c**2 * s * self.rii
            + c**3 * self.iii)


_CUMULANTS = [item.name for item in fields(Parts) if item.name != 'base']


def offset_of(center: Array, mean_along: Array, mean_across: Array, along: Array, across: Array
              ) -> Array:
    """
    Return |X| - center of an X whose parts are `along` and `across` off means of length center.

    The difference of the squares keeps the digits that the difference of the lengths loses.
    """
    square = along * (2.0 * mean_along + along) + across * (2.0 * mean_across + across)
    total = np.sqrt((mean_along + along) ** 2 + (mean_across + across) ** 2) + center
    return np.asarray(square / np.where(total > 0.0, total, 1.0))


def _direction(base: Array) -> Array:
    size = np.abs(base)
    return np.asarray(np.where(size > 0.0, base, 1.0) / np.where(size > 0.0, size, 1.0))
