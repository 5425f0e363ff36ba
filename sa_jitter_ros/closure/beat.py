"""
The beat that an interpolator leaves: how much amplitude it cost, from the samples alone.

Samples that were read between the samples of another clock lose amplitude most half-way between
two of them and nothing on one of them. As the two clocks drift through each other, every line
beats at one common frequency and in step, the more the higher its own frequency is. The depth of
the beat tells the mean loss, which raw and corrected amplitudes share and their ratio does not
show.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.angle.resampling import interpolate
from scipy import stats

Array = NDArray[Any]

METHODS = ('linear', 'cubic', 'spline')
_PLACES = 32
_CERTAIN = 1e-9
_DEEPEST = 1.15
_POOR = 6.0  # mean square misfit of the depths, in their errors, that is no interpolator's


@dataclass(frozen=True)
class Beat:
    """
    A common beat of the lines: its interpolator, chance, and the gain (line,) that it tells.

    `depth` (line,) is the relative amplitude of the beat; `method` is '' without a beat.
    """

    method: str
    p_value: float
    gain: Array
    depth: Array


def find_beat(radial: Array, frequency: Array) -> Beat:
    """
    Find the beat in relative amplitudes `radial` (cycle, line) of consecutive trigger cycles.

    `frequency` (line,) is in units of the sampling rate.
    """
    count, lines = radial.shape
    nothing = Beat('', 1.0, np.ones(lines), np.zeros(lines))
    if count < 32 or np.unique(frequency).size < 3:
        return nothing
    window = np.hanning(count + 2)[1:-1]
    spectrum = np.fft.rfft((radial - radial.mean(axis=0)) * window[:, None], 4 * count, axis=0)[8:]
    power = np.abs(spectrum) ** 2
    floor = np.median(power, axis=0) / np.log(2.0)
    total = np.sum(power / floor, axis=1)
    peak = int(np.argmax(total))
    p_value = float(min(1.0, count * stats.gamma.sf(total[peak], lines)))
    swings = 2.0 * spectrum[peak] / window.sum()
    depth = np.abs(swings)
    error = 2.0 * np.sqrt(floor) / window.sum()
    if p_value > _CERTAIN:
        return Beat('', p_value, np.ones(lines), depth)
    best, method, gain = _misfit(swings, np.ones(lines), error)[0], '', np.ones(lines)
    for name in METHODS:
        mean, swing = _interpolated(name, frequency)
        misfit, size = _misfit(swings, swing / mean, error)
        if misfit < min(best, _POOR * lines) and 0.0 < size <= _DEEPEST:
            best, method = misfit, name
            gain = 1.0 - (1.0 - mean) * np.clip(depth / (size * swing / mean), 0.5, 1.5)
    return Beat(method, p_value, gain, depth)


def _misfit(swings: Array, shape: Array, error: Array) -> tuple[float, float]:
    """
    Return the sum of squares that a shape of any size and phase leaves, and its best size.

    `swings` (line,) are complex; lines that swing out of step fit no shape.
    """
    weight = 1.0 / (error**2 + (0.05 * np.abs(swings)) ** 2)
    size = np.sum(weight * swings * shape) / np.sum(weight * shape**2)
    return float(np.sum(weight * np.abs(swings - size * shape) ** 2)), float(np.abs(size))


def _interpolated(method: str, frequency: Array) -> tuple[Array, Array]:
    """Return mean gain and amplitude of its first harmonic over the place between two samples."""
    place = (np.arange(_PLACES) + 0.5) / _PLACES
    index = np.arange(64)
    mean, swing = np.empty(frequency.size), np.empty(frequency.size)
    for i, nu in enumerate(frequency):
        wave = np.stack((np.cos(2.0 * np.pi * nu * index), np.sin(2.0 * np.pi * nu * index)), 1)
        value = interpolate(wave, 31.0 + place, method=method)
        gain = (value[:, 0] + 1j * value[:, 1]) * np.exp(-2j * np.pi * nu * (31.0 + place))
        mean[i] = gain.mean().real
        swing[i] = 2.0 * abs(np.mean(gain.real * np.exp(-2j * np.pi * place)))
    return mean, swing
