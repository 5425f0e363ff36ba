"""Noise of an order amplitude, from how it scatters along its own radius from cycle to cycle."""

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

_MEDIAN_FROM = 8  # spectral lines from which on a median is worth its larger scatter


@lru_cache(maxsize=16)
def _leaking(orders: tuple[float, ...], length: float) -> ComplexArray:
    """Return what leaks from each order, then each negative one, into each order of a cycle."""
    step = np.concatenate((orders, np.negative(orders)))[:, None] - np.array(orders)
    share = np.exp(1j * np.pi * step * length) * np.sinc(step * length)
    np.fill_diagonal(share, 0.0)  # what an order is itself
    return np.asarray(share)


def without_leakage(cycles: ComplexArray, orders: tuple[float, ...], length: float,
                    angles: NDArray[Any]) -> ComplexArray:
    """
    Return amplitudes of single trigger cycles without what the orders leak into each other.

    `cycles` (cycle, channel, order), a trigger cycle is `length` fundamental cycles long and
    begins at `angles` (cycle,). Over a part of a fundamental cycle the orders, and the negative
    frequencies of real signals, are not orthogonal; leakage is gone from the mean of many cycles,
    but is far above the noise in one.
    """
    share = _leaking(orders, length)
    turn = np.exp(2j * np.pi * np.multiply.outer(angles, orders))[:, None, :]
    clean = cycles
    for _ in range(2):
        mean = np.nan_to_num(clean.mean(axis=0)) * turn
        leaked = np.concatenate((mean, np.conj(mean)), axis=-1) @ share
        clean = cycles - leaked / turn
    return np.asarray(clean)


def radial_noise(cycles: ComplexArray) -> FloatArray:
    """
    Return the standard deviation of the mean amplitude due to noise, along the radius.

    `cycles` (cycle, ...) are complex amplitudes of single trigger cycles. Pulse jitter turns an
    amplitude and leaves its length alone to first order, so the part in phase with the mean shows
    the noise. From 17 cycles on the median over that part's periodogram is taken: other orders
    that leak into single cycles, or a modulation, are lines there and do not count. NaN for one
    cycle.
    """
    count = len(cycles)
    if count < 2:
        return np.full(cycles.shape[1:], np.nan)
    mean = cycles.mean(axis=0)
    size = np.abs(mean)
    known = size > np.finfo(np.float64).tiny
    turn = np.where(known, mean, 1.0) / np.where(known, size, 1.0)
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
