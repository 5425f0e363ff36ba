"""
Limits of what is taken in, live or from a file.

No machine has times, rates or samples beyond them: their squares, products and periods would
overflow. A file that unpacks to far more than it holds is no measurement either.
"""

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.errors import SaJitterError

FloatArray = NDArray[np.float64]

MIN_RATE, MAX_RATE = 1e-12, 1e12  # Hz
MAX_TIME = 1e15  # s, as 30 million years
MAX_SAMPLE = 1e100  # sums of its squares are far below 1e308
IN_MEMORY_BYTES = 64 << 20  # larger arrays of a file are mapped
MAX_INFLATION = 200  # measured signals shrink a few fold; only a bomb shrinks more than this


def check_rate(name: str, rate: float, error: type[SaJitterError]) -> None:
    """Raise `error` for a rate (Hz) beyond the limits, and for NaN."""
    if not MIN_RATE <= rate <= MAX_RATE:
        raise error(f'{name} is {rate} Hz: must be from {MIN_RATE:g} to {MAX_RATE:g} Hz')


def check_times(name: str, times: float | FloatArray, error: type[SaJitterError]) -> None:
    """Raise `error` for finite times (s) beyond the limits."""
    values = np.atleast_1d(times)
    wrong = values[np.isfinite(values) & (np.abs(values) > MAX_TIME)]
    if wrong.size:
        raise error(f'{name} is {wrong[0]} s: must be within {MAX_TIME:g} s of 0; count seconds '
                    'from the start of the measurement or of the epoch')


def check_samples(samples: FloatArray, error: type[SaJitterError]) -> None:
    """Raise `error` for finite samples beyond the limits; NaN and infinity are a gap."""
    if not samples.size:
        return
    peak = max(float(samples.max()), -float(samples.min()))
    if peak <= MAX_SAMPLE:
        return
    wrong = samples[np.isfinite(samples) & (np.abs(samples) > MAX_SAMPLE)]  # NaN has no order
    if wrong.size:
        raise error(f'sample of {wrong[0]}: must be within {MAX_SAMPLE:g} of 0; send it in the '
                    'unit of the sensor')
