"""Interpolators that lose amplitude, as found in averagers and acquisition systems."""

from collections.abc import Callable, Mapping

import numpy as np
from sa_jitter_ros.simulation.random_streams import FloatArray
from scipy.interpolate import CubicSpline

GRID_OFFSET = 1e-3 * (np.sqrt(5.0) - 1.0)  # of the rates; irrational, so that fractions spread
_SPLINE_MARGIN = 32  # the spline's memory of its ends, 0.268^32, is below rounding

Interpolator = Callable[[FloatArray, FloatArray], FloatArray]


def linear(samples: FloatArray, positions: FloatArray) -> FloatArray:
    """Interpolate `channel` x `sample` linearly; mean gain sinc^2(f/fs)."""
    at = np.floor(positions).astype(np.int64)
    fraction = positions - at
    return (1.0 - fraction) * samples[:, at] + fraction * samples[:, at + 1]


def cubic(samples: FloatArray, positions: FloatArray) -> FloatArray:
    """Interpolate by cubic convolution with a = -1/2 (Keys 1981)."""
    at = np.floor(positions).astype(np.int64)
    s = positions - at
    weights = (((2.0 - s) * s - 1.0) * s / 2.0, (3.0 * s - 5.0) * s * s / 2.0 + 1.0,
               ((4.0 - 3.0 * s) * s + 1.0) * s / 2.0, (s - 1.0) * s * s / 2.0)
    return np.asarray(sum(weight * samples[:, at + shift]
                          for weight, shift in zip(weights, (-1, 0, 1, 2))))


def spline(samples: FloatArray, positions: FloatArray) -> FloatArray:
    """Interpolate by the cubic spline; mean gain 3 sinc^4(f/fs) / (2 + cos(2 pi f/fs))."""
    return np.asarray(CubicSpline(np.arange(samples.shape[1]), samples, axis=1)(positions))


# The method's name, as the averager has it, with the samples it needs on either side.
INTERPOLATORS: Mapping[str, tuple[Interpolator, int]] = {
    'linear': (linear, 1), 'cubic': (cubic, 2), 'spline': (spline, _SPLINE_MARGIN)}
