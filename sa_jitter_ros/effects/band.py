"""Autocorrelation of slow random motions whose spectrum is flat up to a limit."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[Any]

#: Of what wanders or modulates, as a fraction of the trigger rate: below half of it by definition.
SLOW_BAND = (0.02, 0.4)
#: Of an acceleration, which is nearly constant within a trigger cycle.
ACCELERATION_BAND = (0.05, 0.2)


def flat_band_correlation(lag: ArrayLike, band: tuple[float, float]) -> Array:
    """Return the autocorrelation of a flat spectrum in `band` at `lag`, inverse units."""
    low, high = band
    x = np.asarray(lag, float)
    return np.asarray((high * np.sinc(2.0 * high * x) - low * np.sinc(2.0 * low * x))
                      / (high - low))
