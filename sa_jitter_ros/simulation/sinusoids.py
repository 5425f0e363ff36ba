"""Sums of sinusoids: band-limited random motion whose integral is known exactly."""

from dataclasses import dataclass

import numpy as np
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.simulation.random_streams import FloatArray, RandomStream

LINES = 48


@dataclass(frozen=True, eq=False)
class SinusoidSum:
    """The function sum of a cos(2 pi f t + phase), with `frequencies` f in Hz and t in s."""

    amplitudes: FloatArray
    frequencies: FloatArray
    phases: FloatArray

    def value(self, times: FloatArray) -> FloatArray:
        """Return the value at `times`, of their shape."""
        angles = np.multiply.outer(times, 2.0 * np.pi * self.frequencies) + self.phases
        # A plain sum, no matrix product: a value must not depend on the other times.
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
        """Return a value that the function's magnitude never exceeds."""
        return float(np.abs(self.amplitudes).sum())


ZERO = SinusoidSum(np.empty(0), np.empty(0), np.empty(0))


def band_limited(*, std: float, band: tuple[float, float], seed: int, name: str) -> SinusoidSum:
    """
    Return a nearly normal random function of zero mean with a flat spectrum in `band` (Hz).

    Its standard deviation over a long time is `std`. Raises ParameterError if the band is not
    0 < low < high or `std` is negative.
    """
    low, high = band
    if not 0.0 < low < high < np.inf:
        raise ParameterError(f'{name}: band {low} to {high} Hz, must be 0 < low < high')
    if not 0.0 <= std < np.inf:
        raise ParameterError(f'{name}: standard deviation {std}, must be at least 0')
    places, phases = RandomStream(seed, name, rows=2).uniform(0, LINES)
    frequencies = low + (np.arange(LINES) + places) * (high - low) / LINES
    return SinusoidSum(np.full(LINES, std * np.sqrt(2.0 / LINES)), frequencies,
                       2.0 * np.pi * phases)
