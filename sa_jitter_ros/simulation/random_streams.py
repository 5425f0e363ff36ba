"""Random numbers that depend on their index only, not on the blocks in which they are read."""

from dataclasses import dataclass
import zlib

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

FloatArray = NDArray[np.float64]

CHUNK = 1024
_NEGLIGIBLE = 1e-17  # correlation below the resolution of a float64


@dataclass(frozen=True)
class RandomStream:
    """
    An endless table of random numbers: item `k` of a row does not depend on how it is read.

    Parameters
    ----------
    seed
        Seed of the whole simulation.
    name
        Name of this stream; streams of different names are independent.
    rows
        Number of independent rows.

    """

    seed: int
    name: str
    rows: int = 1

    def uniform(self, start: int, stop: int) -> FloatArray:
        """Return items `start` to `stop` of every row, uniform in [0, 1)."""
        return self._read(start, stop, normal=False)

    def normal(self, start: int, stop: int) -> FloatArray:
        """Return items `start` to `stop` of every row, standard normal."""
        return self._read(start, stop, normal=True)

    def autoregressive(self, start: int, stop: int, *, correlation: float) -> FloatArray:
        """
        Return standard normal items whose neighbours are correlated, lag k by `correlation^k`.

        Each chunk filters white noise that begins so early that still earlier noise has no effect.
        """
        if abs(correlation) < _NEGLIGIBLE:
            return self.normal(start, stop)
        memory = int(np.ceil(np.log(_NEGLIGIBLE) / np.log(abs(correlation))))
        gain = np.sqrt(1.0 - correlation**2)
        pieces = [
            lfilter([gain], [1.0, -correlation],
                    self.normal(chunk * CHUNK - memory, (chunk + 1) * CHUNK))[:, memory:]
            for chunk in range(start // CHUNK, -(-stop // CHUNK))]
        return self._cut(pieces, start, stop)

    def _read(self, start: int, stop: int, *, normal: bool) -> FloatArray:
        pieces = []
        for chunk in range(start // CHUNK, -(-stop // CHUNK)):
            generator = self._generator(chunk)
            draw = generator.standard_normal if normal else generator.random
            pieces.append(draw((self.rows, CHUNK)))
        return self._cut(pieces, start, stop)

    def _cut(self, pieces: list[FloatArray], start: int, stop: int) -> FloatArray:
        if not pieces:
            return np.empty((self.rows, 0))
        offset = start % CHUNK
        return np.concatenate(pieces, axis=1)[:, offset:offset + stop - start]

    def _generator(self, chunk: int) -> np.random.Generator:
        key = np.random.SeedSequence([self.seed, zlib.crc32(self.name.encode())])
        # The upper half of the counter is the chunk's number; numbers below 0 are legal.
        return np.random.Generator(np.random.Philox(
            key=key.generate_state(2, np.uint64), counter=(chunk % 2**63) << 128))
