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
Random numbers and random functions of time.

They depend on seed, name and index or time only, not on the blocks in which they are read.
"""

from collections.abc import Callable
from dataclasses import dataclass
import zlib

import numpy as np
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.errors import ParameterError

CHUNK = 1024
_LINES = 48  # sinusoids of a random function
_NEGLIGIBLE = 1e-17  # correlation below the resolution of a float64


def in_chunks(read: Callable[[int], FloatArray], start: int, stop: int, size: int = CHUNK
              ) -> FloatArray:
    """Return items `start` to `stop` of rows, of which `read` returns chunks of a fixed size."""
    first = start // size
    rows = [read(number) for number in range(first, max(-(-stop // size), first + 1))]
    return np.concatenate(rows, axis=1)[:, start - first * size:stop - first * size]


@dataclass(frozen=True)
class RandomStream:
    """
    An endless table of random numbers: item `k` of a row is the same however it is read.

    Parameters
    ----------
    seed
        Seed of the whole simulation.
    name
        Name of this stream; streams of different names are independent.
    rows
        Number of independent rows.

    Examples
    --------
    >>> stream = RandomStream(seed=1, name='noise')
    >>> bool(np.all(stream.normal(0, 3000)[:, 2000:2010] == stream.normal(2000, 2010)))
    True

    """

    seed: int
    name: str
    rows: int = 1

    def uniform(self, start: int, stop: int) -> FloatArray:
        """Return items `start` to `stop` of every row, uniform in [0, 1)."""
        return in_chunks(lambda chunk: self._generator(chunk).random((self.rows, CHUNK)),
                         start, stop)

    def normal(self, start: int, stop: int) -> FloatArray:
        """Return items `start` to `stop` of every row, standard normal."""
        return in_chunks(lambda chunk: self._generator(chunk).standard_normal(
            (self.rows, CHUNK)), start, stop)

    def autoregressive(self, start: int, stop: int, *, correlation: float) -> FloatArray:
        """
        Return standard normal items whose neighbours are correlated, lag k by `correlation^k`.

        Each chunk filters white noise from so early on that earlier noise is negligible.
        """
        if abs(correlation) < _NEGLIGIBLE:
            return self.normal(start, stop)
        memory = int(np.ceil(np.log(_NEGLIGIBLE) / np.log(abs(correlation))))
        gain = np.sqrt(1.0 - correlation**2)
        from scipy.signal import lfilter  # which loads long, for streams without memory

        return in_chunks(lambda chunk: lfilter(
            [gain], [1.0, -correlation],
            self.normal(chunk * CHUNK - memory, (chunk + 1) * CHUNK))[:, memory:], start, stop)

    def _generator(self, chunk: int) -> np.random.Generator:
        key = np.random.SeedSequence([self.seed, zlib.crc32(self.name.encode())])
        # The upper half of the counter is the number of the chunk, which may be negative.
        return np.random.Generator(np.random.Philox(
            key=key.generate_state(2, np.uint64), counter=(chunk % 2**63) << 128))


@dataclass(frozen=True, eq=False)
class SinusoidSum:
    """The function sum of a cos(2 pi f t + phase), with `frequencies` f in Hz and t in s."""

    amplitudes: FloatArray
    frequencies: FloatArray
    phases: FloatArray

    def value(self, times: FloatArray) -> FloatArray:
        """Return the value at `times`, of their shape."""
        angles = np.multiply.outer(times, 2.0 * np.pi * self.frequencies) + self.phases
        # A sum, not a matrix product, whose rounding depends on the other times.
        return np.asarray((np.cos(angles) * self.amplitudes).sum(axis=-1))

    def integral(self) -> 'SinusoidSum':
        """Return the integral over time whose mean is 0."""
        return SinusoidSum(self.amplitudes / (2.0 * np.pi * self.frequencies), self.frequencies,
                           self.phases - np.pi / 2.0)

    def __add__(self, other: 'SinusoidSum') -> 'SinusoidSum':
        """Return the sum of both functions."""
        return SinusoidSum(np.concatenate([self.amplitudes, other.amplitudes]),
                           np.concatenate([self.frequencies, other.frequencies]),
                           np.concatenate([self.phases, other.phases]))

    def scaled(self, factor: float) -> 'SinusoidSum':
        """Return the function times `factor`."""
        return SinusoidSum(factor * self.amplitudes, self.frequencies, self.phases)

    @property
    def bound(self) -> float:
        """Return an upper bound of the magnitude of the function."""
        return float(np.abs(self.amplitudes).sum())


ZERO = SinusoidSum(np.empty(0), np.empty(0), np.empty(0))


def band_limited(*, std: float, band: tuple[float, float], seed: int, name: str) -> SinusoidSum:
    """
    Return a nearly normal random function of zero mean with a flat spectrum in `band` (Hz).

    Its standard deviation over a long time is `std`. Raises ParameterError if the band is not
    0 <= low < high or `std` is negative.

    >>> wander = band_limited(std=0.01, band=(0.5, 5.0), seed=1, name='wander')
    >>> float(wander.value(np.arange(0.0, 500.0, 0.02)).std().round(4))
    0.01
    """
    low, high = band
    if not 0.0 <= low < high < np.inf:
        raise ParameterError(f'{name}: band is {low} to {high} Hz, must be 0 <= low < high')
    if not 0.0 <= std < np.inf:
        raise ParameterError(f'{name}: standard deviation is {std}, must be at least 0')
    places, phases = RandomStream(seed, name, rows=2).uniform(0, _LINES)
    frequencies = low + (np.arange(_LINES) + places) * (high - low) / _LINES
    return SinusoidSum(np.full(_LINES, std * np.sqrt(2.0 / _LINES)), frequencies,
                       2.0 * np.pi * phases)
