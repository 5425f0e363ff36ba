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
Noise of an order amplitude, and the leakage between the orders of single trigger cycles.

Pulse errors turn an order amplitude, so that its scatter along the radius, from cycle to cycle, is
due to noise.
"""

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.arrays import ComplexArray, FloatArray
from scipy.special import digamma

# The orders that leak contain leakage of each other: iterations until this is negligible.
_PASSES = 6
_ORTHOGONAL = 1e-12  # leakage that is rounding: of whole orders over whole fundamental cycles
# Share of others in an order, up to which its own part follows from the mean of all cycles.
_APART = 0.5
# Lines of the average next to an order that show the noise: beyond the main lobe of the window.
_LOBE, _AROUND = 3, 150
_OUTLIER = 3.0  # times the noise
_MEDIAN_FROM = 8  # spectral lines from which on the median is used, which scatters more


@lru_cache(maxsize=16)
def _leaking(orders: tuple[float, ...], length: float) -> ComplexArray:
    """Return the leakage of each order, then of each negative one, to each order of a cycle."""
    step = np.concatenate((orders, np.negative(orders)))[:, None] - np.array(orders)
    share = np.exp(1j * np.pi * step * length) * np.sinc(step * length)
    np.fill_diagonal(share, 0.0)
    return np.asarray(share)


def without_leakage(cycles: ComplexArray, orders: tuple[float, ...], length: float,
                    angles: NDArray[Any]) -> ComplexArray:
    """
    Return amplitudes of single trigger cycles without the leakage between the orders.

    `cycles` (cycle, channel, order); a trigger cycle is `length` fundamental cycles long and
    begins at `angles` (cycle,). Over a fraction of a fundamental cycle the orders, and the
    negative frequencies of real signals, are not orthogonal. This leakage vanishes in the mean of
    many cycles, but in a single cycle it is far above the noise.

    Order 2 of amplitude 1 leaks into order 3, whose amplitude is 0, in cycles of r = 0.4:

    >>> angles = 0.4 * np.arange(50)
    >>> theta = angles[:, None] + 0.4 * (np.arange(100) + 0.5) / 100
    >>> wave = 2.0 * np.cos(4.0 * np.pi * theta)
    >>> cycles = np.stack([np.mean(wave * np.exp(-2j * np.pi * order * theta), axis=1)
    ...                    for order in (2.0, 3.0)], axis=-1)[:, None]
    >>> float(abs(cycles[:, 0, 1]).max().round(2))
    0.76
    >>> float(abs(without_leakage(cycles, (2.0, 3.0), 0.4, angles)[:, 0, 1]).max().round(2))
    0.0
    """
    share = _leaking(orders, length)
    if np.abs(share).max(initial=0.0) < _ORTHOGONAL:
        return cycles
    turn = np.exp(2j * np.pi * np.multiply.outer(angles, orders))[:, None, :]
    clean = cycles
    for _ in range(_PASSES):
        mean = np.nan_to_num(clean.mean(axis=0)) * turn
        leaked = np.concatenate((mean, np.conj(mean)), axis=-1) @ share
        clean = cycles - leaked / turn
    return np.asarray(clean)


def leaks_apart(orders: tuple[float, ...], length: float, count: int) -> bool:
    """
    Whether the mean of `count` consecutive cycles keeps orders apart, so that leakage is known.

    >>> leaks_apart((2.0, 3.0), 0.4, 50), leaks_apart((2.0, 2.1), 0.4, 5)
    (True, False)
    """
    share = np.abs(_leaking(orders, length))
    turn = np.pi * length * (np.concatenate((orders, np.negative(orders)))[:, None]
                             - np.array(orders))
    once = np.sin(turn)
    near = np.abs(once) < _ORTHOGONAL
    mean = np.where(near, 1.0, np.abs(np.sin(count * turn) / np.where(near, 1.0, count * once)))
    return bool(np.max(np.sum(share * mean, axis=0)) < _APART)


def attenuation(raw: ComplexArray, corrected: ComplexArray, noise: FloatArray,
                correlation: FloatArray | float) -> tuple[FloatArray, FloatArray]:
    """
    Return the attenuation, raw over corrected amplitude, and its standard error due to `noise`.

    The two amplitudes hold the same noise but for the turns of the correction: `correlation` is
    the length of their mean phasor. Both results are NaN or infinite where the corrected amplitude
    is 0 or NaN.

    >>> ratio, error = attenuation(np.array([0.8j]), np.array([1.0 + 0.0j]), np.array([0.01]), 0.8)
    >>> ratio.round(3), error.round(3)
    (array([0.8]), array([0.006]))
    """
    with np.errstate(divide='ignore', invalid='ignore'):
        amplitude = np.abs(corrected)
        ratio = np.abs(raw) / amplitude
        apart = 1.0 + ratio**2 - 2.0 * ratio * correlation
        error = noise / amplitude * np.sqrt(np.maximum(apart, 0.0))
    return np.asarray(ratio), np.asarray(error)


def radial_noise(cycles: ComplexArray) -> FloatArray:
    """
    Return the standard deviation of the mean amplitude due to noise, along the radius.

    `cycles` (cycle, ...) are complex amplitudes of single trigger cycles. To first order, pulse
    jitter turns an amplitude without a change of its length, so that the part in phase with the
    mean shows the noise. From 17 cycles on, the result is the median over the periodogram of this
    part: leakage of other orders, or a modulation, makes lines there, which the median ignores.
    NaN for one cycle.

    >>> noise = np.random.default_rng(1).normal(0.0, 0.1, (400, 2)) @ (1.0, 1.0j)
    >>> float(radial_noise(5.0 + noise).round(4))  # 0.1 / sqrt(400) is 0.005
    0.0049
    """
    count = len(cycles)
    if count < 2:
        return np.full(cycles.shape[1:], np.nan)
    radial = (cycles * np.exp(-1j * np.angle(cycles.mean(axis=0)))).real
    power = scatter_power(radial)
    lines = len(power)
    if lines < _MEDIAN_FROM:
        return np.asarray(np.sqrt(radial.var(axis=0, ddof=1) / count))
    # expected median of `lines` exponential variables of unit mean
    factor = digamma(lines + 1.0) - digamma(lines // 2 + 1.0) + (1.0 - lines % 2) / lines
    return np.asarray(np.sqrt(np.median(power, axis=0) / factor / count))


def scatter_power(series: FloatArray) -> FloatArray:
    """Return the power of real series (cycle, ...) without frequency zero and Nyquist's."""
    count = len(series)
    lines = np.fft.rfft(series, axis=0)[1:(count - 1) // 2 + 1]
    return np.asarray((lines.real**2 + lines.imag**2) / count)


def noise_floor(grid: FloatArray, cycles: float, orders: FloatArray, top: float) -> FloatArray:
    """
    Return the noise (channel, order) of the mean of trigger cycles along the radius.

    `grid` (cycle, point, channel) are consecutive cycles of `cycles` fundamental cycles without
    their ends; their band ends at order `top`. The noise is the mean of the spectrum near the
    order, in phase with it (pulse errors only turn the order), between the lines of the shafts and
    without other tones.
    """
    flat = np.ascontiguousarray(grid.reshape(-1, grid.shape[2]).T)
    window, waves = _windowed_waves(cycles, grid.shape[1], flat.shape[1], tuple(orders.tolist()))
    lines = len(grid) * cycles
    floors = []
    for order, (cos, sin) in zip(orders, waves):
        phase = np.angle(flat @ cos - 1j * (flat @ sin))[:, None]
        in_phase = 2.0 * flat * window
        in_phase *= np.cos(phase) * cos - np.sin(phase) * sin
        reach = int(np.clip((top - order) * lines, 4 * _LOBE, max(_AROUND, 5 * len(grid))))
        bins = _between_lines(np.arange(_LOBE, reach), order * lines, (len(grid), lines))
        floors.append(_without_lines(np.abs(np.fft.rfft(in_phase, axis=1)[:, bins]) ** 2))
    return np.asarray(np.sqrt(np.array(floors).T / (flat.shape[1] * np.sum(window**2))))


def _between_lines(bins: NDArray[Any], middle: float, steps: tuple[float, ...]) -> NDArray[Any]:
    """
    Return the bins on both sides of a `middle` that no multiple of the `steps` reaches.

    Through the window a line reaches less than two bins. All are returned if less than a third
    is left.

    >>> _between_lines(np.arange(3, 63), 40.0, (5, 20.0))[:6]
    array([ 3,  7,  8, 12, 13, 17])
    """
    place, step = np.stack([middle + bins, middle - bins]), np.reshape(steps, (-1, 1, 1))
    away = np.abs(place - step * np.rint(place / step)).min(axis=(0, 1))
    left = bins[away.round(6) >= 2.0]
    return left if 3 * left.size >= bins.size else bins


@lru_cache(maxsize=4)
def _windowed_waves(cycles: float, points: int, size: int, orders: tuple[float, ...]
                    ) -> tuple[FloatArray, FloatArray]:
    """Return a window (size,) and cosine and sine of orders (order, 2, size)."""
    turns = 2.0 * np.pi * cycles / points * np.arange(size)
    return np.hanning(size + 1)[:-1], np.array(
        [[np.cos(order * turns), np.sin(order * turns)] for order in orders])


def row_medians(values: FloatArray) -> FloatArray:
    """
    Return the medians (row,) of finite `values` (row, value), several times as fast as numpy.

    >>> row_medians(np.array([[3.0, 1.0, 2.0, 10.0], [0.0, 1.0, 4.0, 4.0]])).tolist()
    [2.5, 2.5]
    """
    middle = values.shape[1] // 2
    ordered = np.partition(values, middle, axis=1)
    if values.shape[1] % 2:
        return np.asarray(ordered[:, middle])
    return np.asarray(0.5 * (ordered[:, :middle].max(axis=1) + ordered[:, middle]))


def _without_lines(power: FloatArray) -> FloatArray:
    """Return the mean of exponentially distributed values (row, value) without outliers."""
    floor = row_medians(power) / np.log(2.0)
    kept = 1.0 - _OUTLIER * np.exp(-_OUTLIER) / (1.0 - np.exp(-_OUTLIER))
    before = np.zeros(power.shape, np.bool_)
    for _ in range(10):
        low = power < _OUTLIER * floor[:, None]
        if np.array_equal(low, before):
            break
        before = low
        floor = np.sum(power, axis=1, where=low) / np.maximum(low.sum(axis=1), 1) / kept
    return np.asarray(floor)


def long_run_variance(series: FloatArray, lags: int | None = None) -> FloatArray:
    """
    Return count times the variance of the mean over the first axis (Newey and West 1987).

    The series have no mean. So many `lags` count, at most a quarter of the series, None for that.
    """
    count = len(series)
    lags = count // 4 if lags is None else min(lags, count // 4)
    total = np.sum(series**2, axis=0)
    for lag in range(1, lags + 1):
        total += 2.0 * (1.0 - lag / (lags + 1.0)) * np.sum(series[lag:] * series[:-lag], axis=0)
    return np.asarray(total / (count - 1))
