"""Noise of an order amplitude, from how it scatters along its own radius from cycle to cycle."""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

_MEDIAN_FROM = 8  # spectral lines from which on a median is worth its larger scatter


def radial_noise(cycles: ComplexArray) -> FloatArray:
    """
    Standard deviation of the mean amplitude due to noise, along the radius.

    `cycles` (cycle, ...) are complex amplitudes of single trigger cycles. Pulse jitter turns an
    amplitude and leaves its length alone to first order, so the part in phase with the mean shows
    the noise. From 18 cycles on the median over that part's periodogram is taken: other orders
    that leak into single cycles, or a modulation, are lines there and do not count. NaN for one
    cycle.
    """
    count = len(cycles)
    if count < 2:
        return np.full(cycles.shape[1:], np.nan)
    mean = cycles.mean(axis=0)
    size = np.abs(mean)
    turn = np.where(size > 0.0, mean, 1.0) / np.where(size > 0.0, size, 1.0)
    radial = (cycles * np.conj(turn)).real
    lines = (count - 1) // 2
    if lines < _MEDIAN_FROM:
        return np.asarray(np.sqrt(radial.var(axis=0, ddof=1) / count))
    power = np.abs(np.fft.rfft(radial, axis=0)[1:lines + 1]) ** 2 / count
    # expected median of `lines` exponential variables of unit mean
    if lines % 2:
        factor = float(np.sum(1.0 / np.arange((lines + 1) // 2, lines + 1)))
    else:
        upper = 1.0 / np.arange(lines // 2 + 1, lines + 1)
        factor = float(np.sum(upper) + 1.0 / lines)
    return np.asarray(np.sqrt(np.median(power, axis=0) / factor / count))
