"""Random numbers that depend on where they are read, never on how a run is cut into blocks."""

from dataclasses import dataclass
import zlib

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

FloatArray = NDArray[np.float64]

CHUNK = 1024
_FORGOTTEN = 1e-17  # correlation that no longer shows in a float64


@dataclass(frozen=True)
class RandomStream:
    """
    An endless table of random numbers: item `k` of a row is the same for every way of reading it.

    Parameters
    ----------
    seed
        Of the whole simulation.
    name
        Of this stream; streams of different names are independent.
    rows
        Independent rows that are read together.

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
        Return standard normal items whose neighbours are correlated, lag k by `correlation`^k.

        Every chunk filters white noise from so far back that what lies before is forgotten.
        """
        if abs(correlation) < _FORGOTTEN:
            return self.normal(start, stop)
        memory = int(np.ceil(np.log(_FORGOTTEN) / np.log(abs(correlation))))
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
