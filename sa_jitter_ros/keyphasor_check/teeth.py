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
Numbering of pulses by tooth, without any knowledge of the target.

The median of neighbouring intervals is the time from tooth to tooth: gaps, lost pulses and strays
are the minority. The phase of the pulses in these intervals, averaged over neighbours, tells where
the next teeth stand, so that nothing depends on a single pulse and no error is passed on.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from sa_jitter_ros.arrays import BoolArray, FloatArray, IntArray
from scipy.ndimage import convolve1d, rank_filter, uniform_filter1d

#: Pulses from which on a target can be numbered; by which the count goes on behind a standstill.
FEWEST, ACROSS = 6, 50
# Pulses around one from which its place follows: few follow a changing speed, many see through
# strays.
_WINDOWS = (41, 11, 5)
_BESIDE = 0.1  # of the window: ranks beside the median
_BETTER = 0.7  # times as bad a fit makes up for fewer pulses
# A longer silence than so many teeth is a standstill: teeth are counted anew behind it.
_STANDSTILL = 40.0
_FAR = 0.3  # teeth from its place: no pulse of that tooth
_PASSES = 3
# Where the pulses stand on average so many teeth from their places, an interval may be more than a
# tooth; a finer division must bring them nearer than this.
_ROUGH, _FINE = 0.08, 0.04
_FINER = (1.5, 2.0, 3.0)
_MOST_STRAYS = 0.12


@dataclass(frozen=True)
class NumberedPulses:
    """
    Pulses numbered by tooth.

    `times` (n,) in s are those that stand nearest to their tooth, one a tooth; `numbers` (n,)
    count teeth from the first one; `places` (n,) are how far, in teeth, each stands behind its
    number; `pitch` (n,) is the time from tooth to tooth there, in s. `strays` (m,) in s are the
    others. `breaks` are the indices of the pulses in front of which the count began anew.
    """

    times: FloatArray
    numbers: IntArray
    places: FloatArray
    pitch: FloatArray
    strays: FloatArray
    breaks: IntArray

    def only(self, kept: BoolArray) -> 'NumberedPulses':
        """Return these pulses without those that are not `kept` (n,), which become strays."""
        breaks = np.unique(np.cumsum(kept)[self.breaks - 1])
        return NumberedPulses(
            self.times[kept], self.numbers[kept], self.places[kept], self.pitch[kept],
            np.sort(np.append(self.strays, self.times[~kept])),
            np.asarray(breaks[(breaks > 0) & (breaks < kept.sum())], np.int64))

    def every(self, step: int, first: int) -> 'NumberedPulses':
        """Return the pulses of each `step`-th tooth from `first` on, counted by one."""
        coarse = replace(self, numbers=(self.numbers - first) // step, places=self.places / step,
                         pitch=self.pitch * step)
        return coarse.only((self.numbers - first) % step == 0)

    def unbroken(self) -> list['NumberedPulses']:
        """Return the parts between standstills."""
        begins = self.breaks
        parts = zip(np.split(self.times, begins), np.split(self.numbers, begins),
                    np.split(self.places, begins), np.split(self.pitch, begins),
                    np.split(self.strays, np.searchsorted(self.strays, self.times[begins])))
        return [NumberedPulses(*part, np.empty(0, np.int64)) for part in parts]


def joined_parts(parts: Sequence[NumberedPulses], teeth: int) -> NumberedPulses:
    """Return parts as one; the count goes on from part to part by whole targets of `teeth`."""
    numbers = [parts[0].numbers]
    for part in parts[1:]:
        behind = int(numbers[-1][-1]) + ACROSS - int(part.numbers[0])
        numbers.append(part.numbers + teeth * -(-behind // teeth))
    times, places, pitch, strays = (np.concatenate([getattr(part, name) for part in parts])
                                    for name in ('times', 'places', 'pitch', 'strays'))
    return NumberedPulses(
        times, np.concatenate(numbers), places, pitch, strays,
        np.asarray(np.cumsum([part.times.size for part in parts[:-1]]), np.int64))


def number_pulses(times: FloatArray) -> NumberedPulses:
    """
    Return pulses (n,) in s, whose times rise, numbered by tooth.

    Of several widths of neighbourhood the one is taken with which the pulses stand nearest to
    their teeth. Six teeth of which one lacks its pulse, and a stray:

    >>> found = number_pulses(np.array([0.0, 1.0, 2.0, 2.4, 3.0, 5.0, 6.0, 7.0, 8.0]))
    >>> found.numbers.tolist(), found.strays.tolist()
    ([0, 1, 2, 3, 5, 6, 7, 8], [2.4])
    """
    best = _best(times, 1.0)
    if _unfit(best) > _ROUGH:  # most intervals may be gaps
        for scale in _FINER:
            found = _best(times, scale)
            if (np.mean(np.abs(found.places)) < _FINE
                    and found.strays.size < _MOST_STRAYS * times.size):
                return found
    return best


def _unfit(found: NumberedPulses) -> float:
    """Return how badly pulses stand on their teeth; a stray counts as one between two teeth."""
    return float(np.sum(np.abs(found.places)) + 0.5 * found.strays.size) / (
        found.times.size + found.strays.size)


def _best(times: FloatArray, scale: float) -> NumberedPulses:
    windows = [window for window in _WINDOWS if window <= max(times.size // 2, _WINDOWS[-1])]
    best = _numbered(times, windows[0], scale)
    for window in windows[1:]:
        found = _numbered(times, window, scale)
        if _unfit(found) < _BETTER * _unfit(best):
            best = found
    return best


def _numbered(times: FloatArray, window: int, scale: float) -> NumberedPulses:
    """Return numbered pulses; the median of `window` intervals is `scale` teeth."""
    intervals = np.maximum(np.diff(times), 1e-300)
    pitch = _middle(intervals / scale, window)
    silent = intervals > _STANDSTILL * pitch
    strays = np.empty(0)
    for step in range(_PASSES):
        numbers, places, breaks = _places(times, pitch, silent, window)
        kept = nearest_pulses(numbers, np.abs(places))
        far = np.abs(places) > _FAR
        if np.mean(far) < 0.5:
            kept &= ~far
        if step == _PASSES - 1:
            break
        # Without strays, and with the known steps, intervals tell more of the pitch.
        strays = np.sort(np.append(strays, times[~kept]))
        times, numbers = times[kept], numbers[kept]
        kept = np.ones(times.size, np.bool_)
        if times.size < FEWEST:
            break
        intervals, steps = np.diff(times), np.maximum(np.diff(numbers), 1)
        pitch = _middle(np.maximum(intervals, 1e-300) / steps, 2 * window + 1)
        silent = intervals > _STANDSTILL * pitch
    if times.size < FEWEST:
        numbers, places = np.arange(times.size), np.zeros(times.size)
        breaks = np.empty(0, np.int64)
    found = NumberedPulses(times, numbers, places, np.append(pitch[:1], pitch)[:times.size],
                           strays, breaks)
    return found.only(kept)


def _middle(intervals: FloatArray, window: int) -> FloatArray:
    """
    Return the usual interval (n,) around each.

    It is the mean of two ranks beside the median: where two kinds of intervals alternate, the
    median is that of which one more is in the window.
    """
    window = min(window, intervals.size - (intervals.size + 1) % 2)
    beside = min(max(1, round(_BESIDE * window)), window // 2)
    low, high = (rank_filter(intervals, window // 2 + rank, size=window, mode='mirror')
                 for rank in (-beside, beside))
    middle = uniform_filter1d(0.5 * (low + high), window, mode='mirror')
    if intervals.size >= 4 * window:  # where half the window is missing, the speed goes on
        for side in (middle, middle[::-1]):
            slope = (side[2 * window] - side[window]) / window
            side[:window] = side[window] - slope * np.arange(window, 0, -1)
    return np.asarray(np.maximum(middle, np.max(intervals) * 1e-12))


def _places(times: FloatArray, pitch: FloatArray, silent: BoolArray, window: int
            ) -> tuple[IntArray, FloatArray, IntArray]:
    """Return the number of each pulse, how far it stands behind it, and where counts begin."""
    intervals = np.diff(times)
    phase = np.append(0.0, np.cumsum(np.where(silent, 0.0, intervals / pitch)))
    starts = np.append(0, np.flatnonzero(silent) + 1)
    stops = np.append(starts[1:], times.size)
    numbers = np.empty(times.size, np.int64)
    places = np.empty(times.size)
    first = 0
    for start, stop in zip(starts, stops):
        part = slice(start, stop)
        mean = convolve1d(np.exp(2j * np.pi * phase[part]), np.bartlett(window + 2)[1:-1],
                          mode='constant')
        teeth = phase[part] - np.unwrap(np.angle(mean)) / (2.0 * np.pi)
        count = np.rint(teeth - teeth[0])
        shift = float(np.median(teeth - count))
        places[part] = teeth - shift - count
        numbers[part] = count - count[0] + first
        first = int(numbers[stop - 1]) + ACROSS
    return numbers, places, np.asarray(starts[1:], np.int64)


def nearest_pulses(numbers: IntArray, away: FloatArray) -> BoolArray:
    """Return which pulses (n,), so far `away`, are nearest among those of the same number."""
    order = np.lexsort((away, numbers))
    kept = np.zeros(numbers.size, np.bool_)
    kept[order[np.unique(numbers[order], return_index=True)[1]]] = True
    return kept
