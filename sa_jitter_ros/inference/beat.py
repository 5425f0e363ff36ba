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
The beat that an interpolator causes, and from it the amplitude that the interpolator took.

Samples that were interpolated between the samples of another clock lose most amplitude half-way
between two of them and none on one of them. As the two clocks drift relative to each other, the
amplitudes of all lines beat at one common frequency and phase, the deeper the higher the frequency
of the line. The mean loss follows from the depth of the beat; raw and corrected amplitudes share
it, so that their ratio does not show it. Beats slower than half the trigger rate are found.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.pulses.resampling import interpolate
from scipy.ndimage import median_filter

Array = NDArray[Any]

METHODS = ('linear', 'cubic', 'spline')
_PLACES = 32
_CERTAIN = 1e-6
_OFF = 0.15  # depth beside that of samples at even places between the others
_KNOWN = 0.05  # error of the shape
_AROUND = 81  # frequencies, a quarter of what is resolved apart, whose median is the noise
_POOR = 3.0  # mean square misfit of the depths, in their errors, that is no interpolator's
_OTHERS = 1e-3  # p value of the other orders at the beat of the one that shows it best


@dataclass(frozen=True)
class Beat:
    """
    A common beat of the lines: interpolator, p value, and the `gain` (line,) that follows from it.

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
    if count < 32 or np.unique(frequency).size < 2:
        return nothing
    window = np.hanning(count + 2)[1:-1]
    spectrum = np.fft.rfft((radial - radial.mean(axis=0)) * window[:, None], 4 * count, axis=0)[8:]
    swings = 2.0 * spectrum / window.sum()
    power = np.abs(spectrum) ** 2
    floor = np.maximum(np.median(power, axis=0), median_filter(power, (_AROUND, 1)))
    error = 2.0 * np.sqrt(floor / np.log(2.0)) / window.sum()
    turns = np.arange(8, 8 + len(spectrum)) / (4 * count)
    depth_left = np.sinc(turns)  # of the mean over a trigger cycle
    alike = _fits(swings, np.ones(lines), error)[1]  # a modulation of all lines is no beat
    best, rarest, least = nothing, np.log(_CERTAIN), 1.0
    for name in METHODS:
        mean, swing = _interpolated(name, frequency)
        log_p_value, misfit, size = _fits(swings, swing / mean, error)
        chance = np.log(len(METHODS) * count) + log_p_value
        fitting = (misfit < np.minimum(alike, _POOR * lines)) & (
            np.abs(size / depth_left - 1.0) < _OFF)
        least = min(least, float(np.exp(np.min(chance))))
        peak = int(np.argmin(np.where(fitting, chance, np.inf)))
        if not (fitting[peak] and chance[peak] < rarest):
            continue
        shown = np.abs(swings[peak] / error[peak]) * swing / mean
        others = frequency != frequency[np.argmax(shown)]  # a sideband is one order's alone
        here = np.ix_([peak], others)
        if _fits(swings[here], (swing / mean)[others], error[here])[0][0] > np.log(_OTHERS):
            continue
        rarest = chance[peak]
        depth = np.abs(swings[peak])
        wanted = size[peak] * swing / mean
        # The shape is known to so much, what a line shows by its own noise.
        share = _KNOWN**2 / (_KNOWN**2 + (error[peak] / wanted) ** 2)
        gain = 1.0 - (1.0 - mean) * (1.0 + share * np.clip(depth / wanted - 1.0, -0.5, 0.5))
        best = Beat(name, float(np.exp(rarest)), gain, depth)
    return best if best.method else replace(nothing, p_value=least)


def _fits(swings: Array, shape: Array, error: Array) -> tuple[Array, Array, Array]:
    """
    Fit a shape (line,) of any size and phase to `swings` of some `error` (frequency, line).

    Returns, by frequency, the logarithm of the p value, the remaining sum of squares (large if the
    lines swing out of phase, or each by itself) and the size.
    """
    alone = np.sum(swings * shape / error**2, axis=1)
    weight = 1.0 / (error**2 + (_KNOWN * np.abs(swings)) ** 2)
    size = np.sum(weight * swings * shape, axis=1) / np.sum(weight * shape**2, axis=1)
    left = np.sum(weight * np.abs(swings - size[:, None] * shape) ** 2, axis=1)
    return -np.abs(alone) ** 2 / np.sum((shape / error) ** 2, axis=1), left, np.abs(size)


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
