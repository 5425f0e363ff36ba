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


from itertools import pairwise

import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.effects.effect import ODDS
from sa_jitter_ros.effects.evidence import Beat
from sa_jitter_ros.pulses.resampling import interpolator_gain, METHODS
from scipy.interpolate import CubicSpline
from scipy.ndimage import maximum_filter1d
from scipy.optimize import minimize_scalar

_LOSSY = tuple(method for method in METHODS if method != 'band_limited')
_HARMONICS = 4  # of the beat
_AROUND = 81  # frequencies, a quarter of what is resolved apart, whose median is the noise
_LOBE = 17  # frequencies, in which the window spreads one
_ACCURACY = 0.03  # of a depth, to which it is known
_MOST = 2**14  # parts whose spectrum is looked at


def find_beat(radial: Array, times: Array, order: Array, frequency: Array) -> Beat:
    """
    Find the beat in relative amplitudes `radial` (part, line) of consecutive parts of cycles.

    The middles of the parts are at `times` (part,) in s. `order` (line,) and `frequency` (line,),
    in units of the sampling rate, are those of the lines.

    At each frequency the known depths of an interpolator's beat compete with a modulation of all
    lines, and with sidebands of each order by itself.
    """
    if len(radial) < 32 or np.unique(frequency).size < 2:
        return Beat()
    radial, step = _evenly(radial, times)
    count = len(radial)
    window = np.hanning(count + 2)[1:-1]
    spectrum = np.fft.rfft(
        (radial - radial.mean(axis=0)) * window[:, None], 4 * count, axis=0)[8:-8]
    swings = 2.0 * spectrum / window.sum()
    power = np.abs(spectrum) ** 2
    floor = np.maximum(np.median(power, axis=0), _around(power))
    noise = floor / np.log(2.0) * (2.0 / window.sum()) ** 2
    # what motions inside the cycles make grows as a beat does, and all lines share it
    together = np.abs(np.sum(swings * frequency**2 / noise, axis=1)) ** 2 / np.sum(
        frequency**4 / noise, axis=1)
    noise *= np.maximum(_around(together) / np.log(2.0), 1.0)[:, None]
    turns = np.arange(8, 8 + len(spectrum)) / (4 * count)
    depth_left = np.sinc(turns)[:, None]  # of the mean over a part
    tried = np.log(count)
    alone = [_of_sidebands(swings[:, own], noise[:, own]) - tried
             for own in order == np.unique(order)[:, None]]
    rival = np.maximum(_of_sidebands(swings, noise) - tried,
                       np.maximum(alone, 0.0).sum(axis=0))
    seen = np.sum(np.abs(swings) ** 2 / noise, axis=1)
    tops = np.flatnonzero(seen == maximum_filter1d(seen, _LOBE))  # beside them it is less deep
    best = -np.inf
    for method in _LOSSY:
        # over the place between two samples; the images of a line swing about it
        below, mean, above = (interpolator_gain(method, frequency + k) for k in (-1.0, 0.0, 1.0))
        swing = np.abs(below + above)
        wanted = depth_left * swing / mean
        unsure = noise + (_ACCURACY * wanted) ** 2
        along = 2.0 * np.abs(np.sum(swings * wanted / unsure, axis=1))
        likelihood = along - 0.5 * np.log1p(2.0 * np.pi * along) + np.sum(  # of any phase
            np.abs(swings) ** 2 * (1.0 / noise - 1.0 / unsure) - wanted**2 / unsure
            - np.log(unsure / noise), axis=1)
        peak = tops[np.argmax((likelihood - rival)[tops])]
        if likelihood[peak] - rival[peak] > best:
            best = likelihood[peak] - rival[peak]
            name, at, kept = method, peak, mean
    peaks = int(np.count_nonzero((rival[1:-1] > ODDS) & (rival[1:-1] > rival[:-2])
                                 & (rival[1:-1] >= rival[2:])))
    # each method, and each line that stands there by itself and may look like a beat
    tried += np.log(len(_LOSSY) * max(peaks, 1))
    gained, p_value = float(best - tried), float(np.exp(min(tried - best, 0.0)))
    if gained <= ODDS:
        return Beat(gained, p_value)
    return Beat(gained, p_value, name, kept, float(turns[at]) / step)


def _evenly(radial: Array, times: Array) -> tuple[Array, float]:
    """Return amplitudes at equal times, without gaps, and the step in s between them."""
    together = -(-len(radial) // _MOST)
    count = len(radial) // together
    radial, times = (item[:count * together].reshape(count, together, *item.shape[1:]).mean(axis=1)
                     for item in (radial, times))
    steps = np.diff(times)
    beside = np.abs(np.pad(steps, 1, mode='edge'))
    usual = np.minimum(beside[:-2], beside[2:])
    gap = (steps <= 0.0) | (steps > 2.0 * usual)  # or another recording
    places, step = np.append(0.0, np.cumsum(np.where(gap, usual, steps))), float(np.median(steps))
    return CubicSpline(places, radial)(np.arange(0.0, places[-1], step)), step


def _around(power: Array) -> Array:
    """Return the medians of a power (frequency, ...) over the frequencies around each."""
    groups = max(len(power) // _AROUND, 1)
    ends = np.arange(groups + 1) * len(power) // groups
    return np.repeat([np.median(power[begin:end], axis=0) for begin, end in pairwise(ends)],
                     np.diff(ends), axis=0)


def _of_sidebands(swings: Array, noise: Array) -> Array:
    """
    Return the logarithm of the evidence (frequency,) for sidebands of lines in the last axis.

    Any depth up to that of the lines is as likely as any other by its logarithm; each line has
    its own, or all have the same.
    """
    known = np.sum(1.0 / noise, axis=1)
    alike = np.abs(np.sum(swings / noise, axis=1)) ** 2 / known
    each = _any_depth(np.abs(swings) ** 2 / noise, 1.0 / noise).sum(axis=1)
    return np.asarray(np.maximum(each, _any_depth(alike, known)))


def _any_depth(power: Array, known: Array) -> Array:
    """Return the evidence for an amplitude of some power over that of the noise, 1 / known."""
    return np.asarray(power - np.log(np.maximum(power, 1.0) * np.log(np.maximum(known, np.e))))


def without_beat(radial: Array, times: Array, beat: Beat) -> Array:
    """Return relative amplitudes (cycle, line) at `times` (cycle,) in s less the beat in them."""
    if not beat.method:
        return radial
    window, apart = np.hanning(len(radial)), 0.25 / float(np.ptp(times))  # frequencies tried

    def wave(place: float) -> Array:
        return np.asarray(np.exp(2j * np.pi * (beat.frequency + place * apart) * times))

    def rest(place: float) -> float:
        return -float(np.sum(np.abs((window * wave(place)) @ radial) ** 2 / radial.var(axis=0)))

    best = wave(minimize_scalar(rest, bounds=(-0.5, 0.5), method='bounded').x)
    harmonics = np.stack([best**n for n in range(1, _HARMONICS + 1)], axis=1)
    parts = np.concatenate([harmonics.real, harmonics.imag], axis=1)
    return np.asarray(radial - parts @ np.linalg.lstsq(parts, radial, rcond=None)[0])
