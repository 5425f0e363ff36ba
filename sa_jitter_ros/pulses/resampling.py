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
Resampling: values of a sampled signal between its samples.

The value at a position is a weighted sum of the samples around it. Between two samples
each weight is a polynomial of the position (exact for linear and both cubic methods, to 2e-7 for
the band-limited kernel); `weighted_sums` makes weights and sums. Positions that are further apart
than the samples need an anti-alias filter. For every method this is the band-limited kernel, three
times as long and stretched: flat to 0.8 of the cut-off, closed from the cut-off on.

`gain` is the gain of an interpolator at the frequency f. The loss of the default (Kaiser-windowed
sinc) is below 0.001 dB up to 0.32 fs. Linear interpolation has the gain sinc^2(f/fs); for a
keyphasor that is sampled at fs, its loss is three times that of the pulse jitter.
"""

from functools import lru_cache, partial
import math

import numpy as np
from numpy.polynomial import Chebyshev
from numpy.typing import NDArray
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.errors import ParameterError, SignalError
from sa_jitter_ros.inner_loops import room, weighted_sums
from scipy.special import i0

#: Of the sampling rate: lines are looked for below it, filters may end beyond it.
FULL_BAND = 0.4
_Places = tuple[NDArray[np.int32], FloatArray, FloatArray, FloatArray]

_SPLINE_POLE = np.sqrt(3.0) - 2.0
# method: half-width of its kernel in samples
_HALF_WIDTH = {'band_limited': 8, 'linear': 1, 'cubic': 2, 'spline': 12}
_KERNEL_STEPS = 512  # of a sample, in which a kernel is integrated
# Steps of the table of gains up to the Nyquist frequency: linear between them to 1e-7.
_GAIN_STEPS = 4096
_GAIN_DEGREE = 64  # of the polynomial that a table of gains comes from: exact to rounding
# method: degree of the polynomials
_DEGREE = {'band_limited': 7, 'linear': 1, 'cubic': 3, 'spline': 3}
METHODS = tuple(_HALF_WIDTH)
_KAISER_BETA = 9.0


def _kernel(method: str, x: FloatArray, half: int) -> FloatArray:
    """Impulse response of an interpolator at `x` samples from its centre, zero beyond `half`."""
    d = np.abs(x)
    if method == 'linear':
        return np.maximum(1.0 - d, 0.0)
    if method == 'cubic':  # Keys 1981, cubic convolution with a = -1/2
        inner = (1.5 * d - 2.5) * d * d + 1.0
        outer = ((-0.5 * d + 2.5) * d - 4.0) * d + 2.0
        return np.where(d < 1.0, inner, np.where(d < 2.0, outer, 0.0))
    if method == 'spline':  # cardinal cubic spline (Unser 1999, Eq. 22)
        total = np.zeros_like(d)
        for k in range(-half - 2, half + 3):
            e = np.abs(x - k)
            b3 = np.where(e < 1.0, 2.0 / 3.0 - e * e + e**3 / 2.0,
                          np.where(e < 2.0, (2.0 - e) ** 3 / 6.0, 0.0))
            total += -6.0 * _SPLINE_POLE / (1.0 - _SPLINE_POLE**2) * _SPLINE_POLE ** abs(k) * b3
        return total
    window = np.sqrt(np.maximum(1.0 - (d / half) ** 2, 0.0))
    taper: FloatArray = i0(_KAISER_BETA * window) / i0(_KAISER_BETA)
    return np.where(d < half, np.sinc(x) * taper, 0.0)


def _stretch(method: str, cutoff: float) -> tuple[str, int, float]:
    """Kernel to use, its half-width at unit stretch, and its stretch."""
    half = _HALF_WIDTH[_known(method)]
    if cutoff < 1.0:
        return 'band_limited', 3 * _HALF_WIDTH['band_limited'], 0.9 * cutoff
    return method, half, 1.0


@lru_cache(maxsize=64)
def _polynomials(method: str, cutoff: float) -> FloatArray:
    """
    Coefficients (power, tap) of the weights of samples up to the one in front of a position.

    They are polynomials of 2 f - 1, f being the fraction of a sample that the position lies beyond
    that sample, through the kernel at the Chebyshev nodes. The kernel is symmetric.
    """
    method, half, stretch = _stretch(method, cutoff)
    width, powers = math.ceil(half / stretch), _DEGREE[method] + 1
    nodes = np.cos(np.pi * (np.arange(powers) + 0.5) / powers)
    taps = np.arange(1 - width, width + 1)
    weights = _kernel(method, stretch * (taps - (nodes[:, None] + 1.0) / 2.0), half)
    weights /= weights.sum(axis=1, keepdims=True)  # the gain of a constant is 1
    return np.asarray(np.linalg.solve(np.vander(nodes, increasing=True), weights[:, :width]))


def _known(method: str) -> str:
    if method not in _HALF_WIDTH:
        raise ParameterError(f'interpolation is {method!r}: give one of {", ".join(METHODS)}')
    return method


def margin(method: str, *, cutoff: float = 1.0) -> int:
    """
    Return the number of samples that interpolation needs on either side of a position.

    >>> margin('linear'), margin('band_limited'), margin('linear', cutoff=0.5)
    (1, 8, 54)
    """
    _, half, stretch = _stretch(method, cutoff)
    return math.ceil(half / stretch)


def interpolator_gain(method: str, frequency: FloatArray) -> FloatArray:
    """
    Return the gain of an interpolator at `frequency` in units of the sampling rate.

    It is the Fourier transform of the kernel: sinc^2 for linear, 3 sinc^4 / (2 + cos 2 pi f) for
    the cubic spline.

    >>> for method in METHODS:
    ...     print(method, interpolator_gain(method, np.array([0.1, 0.25])).round(3))
    band_limited [1. 1.]
    linear [0.968 0.811]
    cubic [0.998 0.939]
    spline [1.    0.986]
    """
    x, kernel = _steps_of_kernel(_known(method))
    phase = 2.0 * np.pi * np.multiply.outer(np.asarray(frequency, dtype=np.float64), x)
    return np.asarray(np.cos(phase) @ kernel)


def gain_below_nyquist(method: str, frequency: FloatArray) -> FloatArray:
    """
    Return `gain` to 1e-6 from a table; NaN from half the sampling rate on.

    >>> gain_below_nyquist('linear', np.array([0.1, 0.25, 0.5])).round(3)
    array([0.968, 0.811,   nan])
    """
    grid, gains = _table_of_gains(method)
    return np.where(frequency < 0.5, np.interp(frequency, grid, gains), np.nan)


@lru_cache(maxsize=8)
def _table_of_gains(method: str) -> tuple[FloatArray, FloatArray]:
    """Return frequencies up to half the sampling rate, and the gains there."""
    grid: FloatArray = np.linspace(0.0, 0.5, _GAIN_STEPS + 1)
    through = Chebyshev.interpolate(
        partial(interpolator_gain, method), _GAIN_DEGREE, domain=[0.0, 0.5])
    return grid, np.asarray(through(grid), np.float64)


@lru_cache(maxsize=8)
def _steps_of_kernel(method: str) -> tuple[FloatArray, FloatArray]:
    """Return places in a kernel, and its values there times their distance."""
    half = _HALF_WIDTH[method]
    x = np.arange(-half, half, 1.0 / _KERNEL_STEPS)
    kernel = _kernel(method, x, half).reshape(-1, _KERNEL_STEPS)
    kernel /= kernel.sum(axis=0) * _KERNEL_STEPS  # the gain of a constant is 1
    return x, kernel.ravel()


def impulse_response(places: FloatArray) -> FloatArray:
    """Return the band-limited kernel at `places`, in samples from its centre."""
    return _kernel('band_limited', places, _HALF_WIDTH['band_limited'])


def periodic(period: FloatArray, points: int) -> FloatArray:
    """
    Return one period (..., n) of a signal at another number of evenly spaced points.

    It is the interpolation by the signal's own lines; of fewer points the higher ones are left
    out.

    >>> periodic(np.array([1.0, 0.0, -1.0, 0.0]), 6).round(3).tolist()
    [1.0, 0.5, -0.5, -1.0, -0.5, 0.5]
    """
    count = period.shape[-1]
    least = min(count, points)
    lines = np.fft.rfft(period)[..., :least // 2 + 1]
    if least % 2 == 0 and count != points:  # the line at the Nyquist order of the fewer points
        lines[..., -1] *= 0.5 if points > count else 2.0
    return np.asarray(np.fft.irfft(lines, points) * (points / count))


def interpolate(samples: FloatArray, positions: FloatArray, *, method: str = 'band_limited',
                cutoff: float = 1.0) -> FloatArray:
    """
    Return `samples` (n, channels) at `positions` (m,), counted in samples from the first.

    Positions must lie within [0, n - 1]; beyond either end the signal is continued by point
    reflection. `cutoff` in (0, 1] is the highest frequency that remains, as a fraction of half the
    sampling rate. Returns (m, channels). Raises `SignalError` for positions outside the samples or
    the wrong number of dimensions, `ParameterError` for an unknown method or cut-off.

    >>> samples = np.sin(0.2 * np.arange(100.0))[:, None]
    >>> positions = np.array([40.25, 50.5])
    >>> interpolate(samples, positions)[:, 0].round(4), np.sin(0.2 * positions).round(4)
    (array([ 0.9808, -0.6251]), array([ 0.9808, -0.6251]))
    """
    if not 0.0 < cutoff <= 1.0:
        raise ParameterError(f'cutoff is {cutoff}: give more than 0 and at most 1')
    if samples.ndim != 2 or positions.ndim != 1:
        raise SignalError(f'samples have {samples.ndim} dimensions, positions {positions.ndim}: '
                          'give (sample, channel) and (position,)')
    if positions.size and not (positions.min() >= 0.0 and positions.max() <= len(samples) - 1):
        raise SignalError(f'positions {positions.min():.6g} to {positions.max():.6g} are not '
                          f'within samples 0 to {len(samples) - 1}: give positions within the '
                          'samples')
    index = np.floor(positions)
    return interpolate_between(samples, index.astype(np.int32), positions - index, method=method,
                               cutoff=cutoff)


def interpolate_between(samples: FloatArray, index: NDArray[np.int32], fraction: FloatArray, *,
                        method: str, cutoff: float = 1.0) -> FloatArray:
    """
    Return `samples` (n, channels) a `fraction` (m,) of a sample behind samples `index` (m,).

    As `interpolate`, for positions whose whole part is known, which must lie within the samples.
    """
    ends = (int(index.min()), int(index.max())) if index.size else (0, 0)
    return _weighted(samples, ends, (index, fraction, np.zeros(index.size), np.zeros(1)),
                     _polynomials(method, cutoff))


def interpolate_along(samples: FloatArray, origin: NDArray[np.int32], begin: FloatArray,
                      length: FloatArray, u: FloatArray, *, method: str, cutoff: float = 1.0
                      ) -> FloatArray:
    """
    Return `samples` (n, channels) at `begin` + `length` `u` behind samples `origin` (row,).

    As `interpolate`, for rows of positions, which must lie within the samples, and behind those of
    `origin`. Returns (row x u, channels), row by row.
    """
    ends = origin + begin + length * np.array([[u.min()], [u.max()]])
    return _weighted(samples, (math.floor(ends.min()) - 1, math.floor(ends.max()) + 1),  # rounding
                     (origin, begin, length, u), _polynomials(method, cutoff))


def _weighted(samples: FloatArray, ends: tuple[int, int], places: _Places, polynomials: FloatArray
              ) -> FloatArray:
    """Return the weighted sums at places (origin, begin, length, u) between two samples."""
    origin, begin, length, u = places
    values = room((origin.size * u.size, samples.shape[1]))
    if not values.size:
        return values
    half = polynomials.shape[1]
    first, last = ends[0] - half + 1, ends[1] + half
    window = samples[max(first, 0):last + 1]
    if first < 0 or last >= len(samples):
        window = np.pad(window, ((max(-first, 0), max(last + 1 - len(samples), 0)), (0, 0)),
                        mode='reflect', reflect_type='odd')
    weighted_sums(np.ascontiguousarray(window), origin - np.int32(first + half - 1), begin, length,
                  u, polynomials, values)
    return values
