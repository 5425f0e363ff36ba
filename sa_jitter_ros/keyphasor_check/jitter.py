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
Size and memory of the jitter, from the pulses alone.

The spectrum of pulse times is the sum of two: that of the jitter, first-order autoregressive, and
that of the motion, which falls with the fourth power of the frequency. Both are fitted by the
likelihood of Whittle (1953). Slow jitter cannot be told from motion without the vibration.
"""

from collections.abc import Callable
from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.arrays import FloatArray

_FEWEST = 24
_LOWEST = 0.02  # cycles a pulse, below which the motion has any spectrum
_MOST = 65_536
_BINS = 300
_INFLATION = 1.5  # neighbouring lines of a Hann window are correlated
_BOUND = 1.5  # of the inverse hyperbolic tangent of the correlation
_LEAST = 0.02  # of the scatter of the pulses beside their neighbours: less is no jitter found


@dataclass(frozen=True)
class Jitter:
    """
    Standard deviation (s) and correlation of neighbouring pulse errors, with their errors.

    The correlation is NaN where motion hides it; then `std` is that of the jitter without memory.
    """

    std: float
    std_error: float
    correlation: float
    correlation_error: float


def measure_jitter(true: FloatArray, numbers: NDArray[np.int64]) -> Jitter | None:
    """
    Return the jitter of pulses (n,) in s, marks corrected, that have these `numbers`.

    None for too few pulses, and where the motion hides the jitter.

    >>> rng = np.random.default_rng(1)
    >>> times = np.arange(2000) / 25.0 + rng.normal(0.0, 1e-5, 2000)
    >>> found = measure_jitter(times, np.arange(2000))
    >>> 0.9e-5 < found.std < 1.1e-5, abs(found.correlation) < 3.0 * found.correlation_error
    (True, True)
    """
    true, numbers = true[:_MOST], numbers[:_MOST]
    if true.size < _FEWEST:
        return None
    grid = np.arange(numbers[0], numbers[-1] + 1)
    share = true.size / grid.size
    if share < 0.5:
        return None
    full = np.interp(grid, numbers, true)
    # Differences take the motion out of the window's side lobes.
    bend = np.diff(full, 2)
    window = np.hanning(bend.size + 2)[1:-1]
    power = np.abs(np.fft.rfft(bend * window)) ** 2 / np.sum(window**2)
    frequency = np.arange(power.size) / bend.size
    use = (frequency > max(_LOWEST, 4.0 / bend.size)) & (frequency < 0.5)
    omega, power = 2.0 * np.pi * frequency[use], power[use]
    transfer = (2.0 - 2.0 * np.cos(omega)) ** 2
    scale = float(np.median(power / transfer)) or 1e-30
    (omega, transfer, power), count = _binned(np.stack((omega, transfer, power)))

    def deviance(parameters: FloatArray) -> float:
        (size, motion), r = np.exp(parameters[:2]), math.tanh(parameters[2])
        errors = size * (1.0 - r**2) / (1.0 - 2.0 * r * np.cos(omega) + r**2)
        model = transfer * errors + motion
        return float(np.sum(count * (np.log(model) + power / scale / model)))

    from scipy import optimize  # which loads long, for programs that fit nothing

    def fitted(bound: float) -> tuple[FloatArray, FloatArray]:
        best = optimize.minimize(
            deviance, np.array([0.0, -6.0, 0.0]), method='L-BFGS-B',
            bounds=((-25.0, 15.0), (-35.0, 10.0), (-bound, bound)))
        free = slice(None) if bound else slice(2)
        errors = np.zeros(3)
        inverse = np.linalg.pinv(_curvature(deviance, best.x)[free, free])
        errors[free] = np.sqrt(np.maximum(_INFLATION * np.diag(inverse), 0.0))
        return best.x, errors

    (size, _, memory), errors = fitted(_BOUND)
    known = abs(memory) < 0.99 * _BOUND and math.exp(size) > _LEAST and bool(np.all(errors > 0.0))
    if not known:  # a memory so long that motion has it, too: the part without memory
        (size, _, memory), errors = fitted(0.0)
        if math.exp(size) < _LEAST or not errors[0] > 0.0:
            return None
    # Interpolated pulses hold half the variance of measured ones.
    std = math.sqrt(scale * math.exp(size) / (1.0 - 0.5 * (1.0 - share)))
    correlation = math.tanh(memory)
    return Jitter(std, 0.5 * std * float(errors[0]), correlation if known else math.nan,
                  (1.0 - correlation**2) * float(errors[2]) if known else math.nan)


def _binned(spectra: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return means (row, bin) of rows over neighbouring lines, and how many lines each is."""
    lines = spectra.shape[1]
    starts = np.arange(0, lines, max(1, lines // _BINS))
    count = np.diff(np.append(starts, lines)).astype(np.float64)
    return np.add.reduceat(spectra, starts, axis=1) / count, count


def _curvature(call: Callable[[FloatArray], float], at: FloatArray) -> FloatArray:
    """Return the matrix of second derivatives of a function at its minimum."""
    step, n = 1e-3, at.size
    matrix = np.zeros((n, n))
    shift = step * np.eye(n)
    for i in range(n):
        for j in range(i, n):
            matrix[i, j] = matrix[j, i] = (
                call(at + shift[i] + shift[j]) - call(at + shift[i] - shift[j])
                - call(at - shift[i] + shift[j]) + call(at - shift[i] - shift[j])) / (4 * step**2)
    return matrix
