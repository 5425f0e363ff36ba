"""
The two state levels of a keyphasor waveform, and whether it has two levels at all.

The levels are the modes of the lower and of the upper half of the amplitude histogram (as in IEEE
Std 181-2011), so that the length of a pulse and a few overshoots do not move them.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

__all__ = ['StateLevels', 'state_levels']

_BINS = 100
# In units of the noise that the steps between samples suggest, the means of the two halves lie
# 1.6 (normal), 1.7 (uniform) or 2 (one bit) apart where samples are white noise, but sqrt(n) in a
# square wave of n samples a period and 1.27/sin(pi/n) in a sine.
_CONTRAST = 2.4


@dataclass(frozen=True)
class StateLevels:
    """
    State levels of a piece of waveform, in its own unit.

    `significant` says that samples move between two levels: False for a constant or white noise.
    """

    low: float
    high: float
    significant: bool

    @property
    def middle(self) -> float:
        """Return the level half way between the states."""
        return 0.5 * (self.low + self.high)

    @property
    def difference(self) -> float:
        """Return the distance of the states."""
        return self.high - self.low


def state_levels(samples: npt.NDArray[np.float64]) -> StateLevels:
    """
    Find the state levels of finite samples (n,).

    A mean of the samples in the modal histogram bin stands for the level.
    """
    low, high = (float(samples.min()), float(samples.max())) if samples.size else (0.0, 0.0)
    half = 0.5 * (low + high)
    upper = samples > half
    if samples.size < 3 or not low < half < high:
        return StateLevels(low, high, significant=False)
    contrast = float(samples[upper].mean() - samples[~upper].mean())
    noise = float(np.diff(samples).std()) / np.sqrt(2.0)
    counts, edges = np.histogram(samples, bins=_BINS, range=(low, high))
    # Of equally frequent levels the outer ones count.
    lower_mode = int(np.argmax(counts[:_BINS // 2]))
    upper_mode = _BINS - 1 - int(np.argmax(counts[:_BINS // 2 - 1:-1]))
    low = _mean_between(samples, edges[lower_mode], edges[lower_mode + 1])
    high = _mean_between(samples, edges[upper_mode], edges[upper_mode + 1])
    # A machine that starts to turn late in these samples has both modes at its level of rest.
    significant = contrast > _CONTRAST * noise and high - low > 0.5 * contrast
    return StateLevels(low, high, significant=bool(significant))


def _mean_between(samples: npt.NDArray[np.float64], low: float, high: float) -> float:
    return float(samples[(samples >= low) & (samples <= high)].mean())
