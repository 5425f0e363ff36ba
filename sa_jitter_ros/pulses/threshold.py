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
Threshold crossings of a keyphasor waveform, and the state levels between which the threshold is.

The state levels are the modes of the lower and of the upper half of the amplitude histogram (as in
IEEE Std 181-2011), so that the length of a pulse and a few overshoots do not change them. Three
things are told apart: single spikes, which are far from both levels; a resting level that moves
with the shaft or hum, between whose range and the tops of the pulses are levels that all pulses
cross; and pulses with a lobe on either side of the resting level, as variable reluctance makes
them. A crossing counts once the
signal leaves a band around the threshold (Schmitt trigger).
"""

from dataclasses import dataclass, replace
import math

import numpy as np
import numpy.typing as npt
from sa_jitter_ros.arrays import BoolArray, FloatArray, IntArray

_BINS = 100
# Difference of the means of both halves over the noise, which follows from the steps between
# samples. It is 1.6 (normal), 1.7 (uniform) or 2 (one bit) for white noise, but sqrt(n) for a
# square wave of n samples a period and 1.27/sin(pi/n) for a sine.
_CONTRAST = 2.4
# Intervals between pulses of so few samples that their steps look like noise: their least number,
# and standard deviation over mean. Those of noise have 0.5 and more.
_INTERVALS, _EVEN = 5, 0.25
# Fraction of the level difference. Smaller changes of the middle level leave the threshold as it
# is, because every change of it shifts the later pulses against the earlier ones.
_DEAD_BAND = 0.1
# Spikes: the most in a window, or one for so many pulses; samples of one that is as wide as a
# pulse may be; and how often they are looked for, each time in a smaller range.
_FEW_SPIKES, _PULSES_EACH, _SHORT, _SIZES = 2, 10, 3, 8
#: samples of what is too long for a spike
TOO_LONG = _SHORT + 1
# Levels between a moving resting level and the tops of the pulses: their least width in bins, and
# the share of the samples that must be on either side.
_GAP, _HELD = 10, 0.01
_CENTRAL = 0.25  # part of them, by which the middle of the modes may be beside theirs
# Lobes of a pulse: the smaller over the larger one; the share of samples near the resting level,
# and how near that is; the part of a lobe that counts; and the time from one lobe to the next in
# widths of a lobe, beyond which they are pulses of their own.
_LOBES, _RESTS, _NEAR, _LOBE, _JOINED = 0.25, 0.4, 0.15, 0.5, 2.0
_GAPS = 2.0  # the pause where teeth are missing over others, and that between lobes of one
# A waveform that is so seldom half way between its levels is no hum: of the samples of a sine 26 %
# are in the middle two fifths.
_HALF_WAY, _CLOSE = 0.1, 0.1
# Mean length of the runs of samples in the rarer state that noise may have; and levels that are so
# few steps of the samples apart may be a converter's last bit.
_LONG, _STEPS = 2.5, 2.5
# Pulses that a window must hold to show the levels; the noise over the level difference from which
# on it is averaged away, and how many of its standard deviations are beyond it.
_WHOLE, _QUIET, _BEYOND = 2, 0.1, 4.0
# Samples of an edge that are kept at most, and how often a line is fitted to those in the band.
_LONGEST, _ROUNDS = 1 << 16, 3
# Share of clipped samples that hide the noise, and second differences that show it.
_CLIPPED, _READABLE = 0.2, 50
_SECOND = 0.6745 * math.sqrt(6.0)  # median of second differences of white noise of size 1
_TINY = float(np.finfo(np.float64).tiny)


@dataclass(frozen=True)
class StateLevels:
    """
    State levels of a piece of waveform, in the unit of the waveform.

    `significant` is True where samples change between two levels, False for a constant or white
    noise. Pulses with lobes on both sides of a `resting` level (else NaN) cross it between the
    lobes, the `steep` way: 'rising' or 'falling', '' for pulses with one lobe. `share` is that of
    the samples above the middle, `pulsed` tells that few of them are half way between the levels,
    and that they change as pulses do, `noise` is the standard deviation of white noise whose
    second differences are as large. All samples that are no spikes are from `lowest` to `highest`.
    """

    low: float
    high: float
    significant: bool
    resting: float = math.nan
    steep: str = ''
    share: float = math.nan
    pulsed: bool = False
    noise: float = 0.0
    lowest: float = math.nan
    highest: float = math.nan

    @property
    def middle(self) -> float:
        """Return the level half way between the states, or the resting level between lobes."""
        return self.resting if self.steep else 0.5 * (self.low + self.high)

    @property
    def difference(self) -> float:
        """Return the difference of the two levels."""
        return self.high - self.low

    @property
    def lobe(self) -> float:
        """Return the size of the smaller lobe beside the resting level."""
        return min(self.high - self.resting, self.resting - self.low)

    def resembles(self, known: 'StateLevels', within: float = _DEAD_BAND) -> bool:
        """Return whether the middle differs from a known one by less than a part of the size."""
        return (self.steep == known.steep
                and abs(self.middle - known.middle) <= within * known.difference
                and 0.5 <= self.difference / known.difference <= 2.0)

    def still_passed(self, passed: 'StateLevels', size: float) -> bool:
        """Return whether these levels are among those `passed` by pulses of about the `size`."""
        off = max(passed.low - self.low, self.high - passed.high)
        return off <= _DEAD_BAND * self.difference and size <= 2.0 * (self.highest - self.lowest)

    def negated(self) -> 'StateLevels':
        """Return the levels of the waveform with the other sign."""
        steep = {'rising': 'falling', 'falling': 'rising'}.get(self.steep, '')
        return replace(self, low=-self.high, high=-self.low, resting=-self.resting, steep=steep,
                       share=1.0 - self.share, lowest=-self.highest, highest=-self.lowest)

    def spikes(self, samples: FloatArray) -> BoolArray:
        """
        Return which samples (n,) are in spikes.

        These are farther from all others than those are apart, and too short for pulses.
        """
        reach = self.highest - self.lowest
        spikes = (samples > self.highest + reach) | (samples < self.lowest - reach)
        for first, last in zip(*_runs(spikes)) if spikes.any() else ():
            if last - first > _SHORT:
                spikes[first:last] = False
        return np.asarray(spikes)


def state_levels(samples: FloatArray, known: StateLevels | None = None) -> StateLevels:
    """
    Return the state levels of finite samples (n,).

    A level is the mean of the samples in the most frequent histogram bin. Levels that are `known`
    already are returned where the samples have nearly the same, with the noise of these samples.

    >>> levels = state_levels(np.tile([0.0, 0.1, 5.0, 5.0, 0.0, 0.0], 20))
    >>> levels.low, levels.high, levels.significant
    (0.0, 5.0, True)
    """
    if known and not known.steep:
        levels = _modes(samples)
        if levels.significant and levels.resembles(known):
            return replace(known, noise=_noise(samples))
    kept = _without_spikes(samples)
    levels = _lobes(kept) or _modes(kept)
    if not levels.steep and (passed := _passed_by_all(kept)):
        if known and not known.steep and known.still_passed(passed, float(np.ptp(kept))):
            return known
        central = abs(levels.middle - passed.middle) <= _CENTRAL * passed.difference
        if not (levels.significant and central):
            levels = passed
    if not levels.significant:
        return levels
    share = float(np.mean(kept > levels.middle))
    coarse = _in_last_bits(levels, kept)
    as_pulses = _changes_as_pulses(levels, kept, coarse=coarse)
    noise = _noise(kept)
    if not as_pulses and (coarse or noise > _QUIET * levels.difference):
        return replace(levels, significant=False)
    half_way = np.abs(kept - 0.5 * (levels.low + levels.high)) < 0.2 * levels.difference
    pulsed = as_pulses and bool(levels.steep or (
        noise < _QUIET * levels.difference and np.mean(half_way) < _HALF_WAY))
    return replace(levels, share=share, pulsed=pulsed, noise=noise,
                   lowest=float(kept.min()), highest=float(kept.max()))


def whole_pulses(samples: FloatArray, levels: StateLevels) -> bool:
    """
    Return whether samples (n,) rise and fall between their levels as often as two pulses do.

    They do so beyond their noise, unless they do it at even intervals: samples of a part of a slow
    pulse have levels, too, but others than the pulse.
    """
    sound = samples[~levels.spikes(samples)] - levels.middle
    if _regular(_runs(sound > 0.0)[0]):
        return True
    reach = 2.0 * levels.lobe if levels.steep else levels.difference
    # Second differences take edges for noise where pulses have few samples.
    beside = np.abs(np.abs(sound) - 0.5 * levels.difference)
    held = levels.steep or float(np.median(beside)) < _CLOSE * reach
    noise = min(levels.noise, _QUIET * reach) if held else levels.noise
    count = min(math.ceil(max(noise / (_QUIET * reach), 1.0)**2), sound.size)
    mean = np.diff(np.cumsum(sound)[::count]) / count if count > 1 else sound
    band = max(_BEYOND * noise / math.sqrt(count), _QUIET * reach)
    outside = mean[np.abs(mean) > band] > 0.0
    return int(np.count_nonzero(outside[1:] != outside[:-1])) >= 2 * _WHOLE


def _in_last_bits(levels: StateLevels, samples: FloatArray) -> bool:
    """Return whether levels are as near as those between which the last bit of samples changes."""
    if (levels.low, levels.high) == (0.0, 1.0):  # of a digital input
        return False
    steps = np.abs(np.diff(samples))
    least = float(np.min(steps, where=steps > 0.0, initial=math.inf))
    return (levels.lobe if levels.steep else levels.difference) < _STEPS * least


def _changes_as_pulses(levels: StateLevels, samples: FloatArray, *, coarse: bool) -> bool:
    """
    Return whether samples pass from level to level as pulses do, and not as noise.

    Rare single samples stand as far above white noise as pulses do, but alone; and no noise has a
    run in more than four samples, as a fast encoder has.
    """
    above = samples > (0.5 * (levels.middle + levels.high) if levels.steep else levels.middle)
    begin, end = _runs(above if 2 * np.count_nonzero(above) < above.size else ~above)
    # Of few intervals those of noise are even by chance.
    chance = 0.5 * coarse * math.sqrt(_INTERVALS / max(begin.size, 1))
    if _regular(begin, _EVEN * (1.0 - chance)) or (not coarse and 4 * begin.size > samples.size):
        return True
    return bool(np.mean(end - begin) > _LONG)


def _noise(samples: FloatArray) -> float:
    """
    Return the standard deviation of white noise whose second differences are as large.

    Where many samples are clipped, it is that of those which are not.
    """
    bends = np.abs(np.diff(samples, 2))
    if not bends.size:
        return 0.0
    clipped = (samples == samples.min()) | (samples == samples.max())
    free = bends[~(clipped[2:] | clipped[1:-1] | clipped[:-2])]
    enough = np.mean(clipped) > _CLIPPED and free.size > _READABLE
    return float(np.median(free if enough else bends)) / _SECOND


def _range(samples: FloatArray) -> tuple[float, float]:
    """Return the extremes, one level for samples that differ by rounding only, or for none."""
    low, high = (float(samples.min()), float(samples.max())) if samples.size else (0.0, 0.0)
    rounding = 10 * _BINS * np.spacing(max(abs(low), abs(high)))
    return (low, high) if high - low > rounding else (low, low)


def _modes(samples: FloatArray) -> StateLevels:
    """Return the modes of both halves of the amplitudes."""
    low, high = _range(samples)
    upper = samples > 0.5 * (low + high)
    if not low < high:
        return StateLevels(low, high, significant=False)
    contrast = float(samples[upper].mean() - samples[~upper].mean())
    counts, edges = np.histogram(samples, bins=_BINS, range=(low, high))
    # Of equally frequent bins the outer one is taken.
    lower_mode = int(np.argmax(counts[:_BINS // 2]))
    upper_mode = _BINS - 1 - int(np.argmax(counts[:_BINS // 2 - 1:-1]))
    low = _mean_between(samples, edges[lower_mode], edges[lower_mode + 1])
    high = _mean_between(samples, edges[upper_mode], edges[upper_mode + 1])
    # If the machine starts late in these samples, both modes are at its resting level.
    significant = high - low > 0.5 * contrast and (
        _contrast(samples, upper) > _CONTRAST or _regular(_runs(upper)[0]))
    return StateLevels(low, high, significant=bool(significant))


def _mean_between(samples: FloatArray, low: float, high: float) -> float:
    return float(samples[(samples >= low) & (samples <= high)].mean())


def _runs(inside: BoolArray) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Return begin and end (run,) of runs of samples that are `inside`."""
    change = np.flatnonzero(np.diff(inside.view(np.int8), prepend=0, append=0))
    return change[::2], change[1::2]


def _held(samples: FloatArray, level: float) -> BoolArray:
    """Return where samples (n,) are above the level, or since then above half of it."""
    above = samples > level
    decided = np.where(above | (samples < 0.5 * level), np.arange(samples.size), 0)
    return np.asarray(above[np.maximum.accumulate(decided)])


def _regular(begin: npt.NDArray[np.intp], even: float = _EVEN) -> bool:
    """Return whether runs `begin` at even intervals, as those of noise do not."""
    intervals = np.diff(begin)
    return bool(intervals.size >= _INTERVALS and intervals.std() < even * intervals.mean())


def _without_spikes(samples: FloatArray) -> FloatArray:
    """
    Return the samples without spikes: a few short runs that alone make the range so large.

    Without them there are many more pulses, in a smaller range.
    """
    kept, spikes, longest = samples, 0, 0
    found, most = samples, 0
    for _ in range(_SIZES):
        low, high = _range(kept)
        if not low < high:
            break
        outside = kept > 0.5 * (low + high)
        if 2 * np.count_nonzero(outside) > kept.size:
            outside = ~outside
        begin, end = _runs(outside)
        spikes, longest = spikes + begin.size, max(longest, int(np.max(end - begin)))
        kept = kept[~outside]
        if spikes > max(_FEW_SPIKES, kept.size // (2 * _PULSES_EACH)):  # whatever the pulses
            break
        levels = _lobes(kept) or _modes(kept)
        if levels.significant:
            above = kept > 0.5 * (levels.low + levels.high)
            pulses, over = _runs(above if 2 * np.count_nonzero(above) < kept.size else ~above)
            short = max(_SHORT, 0.5 * float(np.median(over - pulses))) if pulses.size else 0.0
            few = spikes <= max(_FEW_SPIKES, pulses.size // _PULSES_EACH)
            # What remains after the spikes of one sign may be those of the other.
            if few and max(spikes, 2 * most) < pulses.size and longest <= short:
                found, most = kept, pulses.size
    return found


def _passed_by_all(samples: FloatArray) -> StateLevels | None:
    """
    Return the levels between which all pulses pass, whatever hum or motion adds, or None.

    That is the widest range of levels that are crossed equally often, of about equal ones the one
    that is crossed least.
    """
    low, high = _range(samples)
    if not low < high:
        return None
    place = np.floor((samples - low) / (high - low) * _BINS).astype(np.intp)
    rises = np.flatnonzero(place[1:] > place[:-1])
    crossed = np.cumsum(np.bincount(place[rises], minlength=_BINS + 1)
                        - np.bincount(place[rises + 1], minlength=_BINS + 1))
    below = np.cumsum(np.bincount(place, minlength=_BINS + 1))
    ends = np.flatnonzero(np.diff(crossed, prepend=-1, append=-1))
    # Pulses without a flat top are crossed equally often up to their tips.
    most = np.searchsorted(below, np.array([_HELD, 1.0 - _HELD]) * samples.size)
    begin, end = np.maximum(ends[:-1], most[0]), np.minimum(ends[1:], most[1]) - 1
    held = np.flatnonzero((crossed[begin] > 0) & (end - begin >= _GAP))
    widest = max(held, key=lambda k: ((end[k] - begin[k]) // _GAP, -crossed[begin[k]]), default=0)
    if not held.size or crossed[begin[widest]] == 1:  # a part of a pulse, with hum on it
        return None
    edges = low + (np.array([begin[widest], end[widest]]) + 1) * (high - low) / _BINS
    passed = StateLevels(float(edges[0]), float(edges[1]), significant=True)
    return passed if _contrast(samples, samples > passed.middle) > 2.0 * _CONTRAST else None


def _contrast(samples: FloatArray, upper: BoolArray) -> float:
    """Return the difference of the means of `upper` samples and the others over the noise."""
    noise = float(np.diff(samples).std()) / math.sqrt(2.0)
    return float(samples[upper].mean() - samples[~upper].mean()) / max(noise, _TINY)


def _lobes(samples: FloatArray) -> StateLevels | None:
    """Return the levels of pulses with a lobe on either side of the resting level, or None."""
    low, high = _range(samples)
    if not low < high:
        return None
    resting = float(np.median(samples))
    up, down = high - resting, resting - low
    if min(up, down) < _LOBES * max(up, down):
        return None
    rests = np.mean(np.abs(samples - resting) < _NEAR * min(up, down)) >= _RESTS
    first, first_end = _runs(_held(samples - resting, _LOBE * up))
    second, second_end = _runs(_held(resting - samples, _LOBE * down))
    if first.size < 2 or abs(first.size - second.size) > 1:
        return None
    width = float(np.median(np.concatenate((first_end - first, second_end - second))))
    pauses = {'falling': _pauses(first_end, second), 'rising': _pauses(second_end, first)}
    longest = {way: float(item.max()) if item.size else math.inf for way, item in pauses.items()}
    steep, other = sorted(longest, key=lambda way: longest[way])
    # teeth all around a wheel leave a rest only where some are missing, and beside all of them
    usual = max(longest[steep] + 1.0, float(np.median(pauses[other]))) if (
        pauses[other].size) else math.inf
    gap = longest[other] > _GAPS * usual
    if longest[steep] <= _JOINED * width + 1.0 and (rests or gap):
        return StateLevels(low, high, significant=True, resting=resting, steep=steep)
    # Lobes apart from each other: those above are the pulses.
    apart = rests and _regular(first)
    return StateLevels(resting, high, significant=True) if apart else None


def _pauses(end: npt.NDArray[np.intp], begin: npt.NDArray[np.intp]) -> FloatArray:
    """Return the numbers of samples from the `end` of a lobe to the next `begin` (pause,)."""
    place = np.searchsorted(begin, end)
    known = place < begin.size
    return np.asarray(begin[place[known]] - end[known], np.float64)


class SchmittTrigger:
    """
    Find the threshold crossings in a stream of blocks of finite samples of any size.

    Interpolated, a crossing is that of the straight line through the samples of the edge that are
    as near as their noise may bring them, two at least: the more there are, the less it moves it.

    :param interpolate: False puts a crossing on the first sample past the threshold.
    """

    def __init__(self, *, interpolate: bool) -> None:
        self._interpolate = interpolate
        self._high: bool | None = None
        self._kept: FloatArray = np.empty(0)  # from the last sample outside the band on

    def update(self, samples: FloatArray, index: int, threshold: float, band: float,
               near: float) -> tuple[FloatArray, BoolArray]:
        """
        Return the crossings that these samples (n,) confirm and which of them rise, (c,) each.

        `index` is that of the first sample in the stream. Crossings are given as such indices,
        fractional if interpolated. `band` is half the hysteresis, in the unit of the samples, and
        `near` how far noise may bring them. Before the signal first leaves the band there are no
        crossings.
        """
        kept = self._kept if self._kept.size else samples[:1]
        signal = np.concatenate((kept, samples))
        above = signal >= threshold
        after = np.flatnonzero(above[1:] != above[:-1]) + 1  # first sample past the threshold
        high = samples >= threshold + band
        outside = np.flatnonzero(high | (samples < threshold - band))
        level = high[outside]
        if self._high is None and outside.size:
            self._high = bool(level[0])
        changes = np.flatnonzero(level != np.append(bool(self._high), level)[:-1])
        outside += kept.size
        begin, end = np.append(0, outside)[changes], outside[changes]
        # The last crossing before the decision has the direction of the change, even if noise
        # made the signal cross the threshold several times inside the band.
        last = np.append(0, after)[np.searchsorted(after, end, side='right')]
        crossed = last > begin  # or the threshold has moved
        last = np.where(crossed, last, end)
        found = (index - kept.size + last).astype(np.float64)
        if self._interpolate:
            found[crossed] += _before(signal, threshold, near, begin[crossed], last[crossed],
                                      end[crossed])
        if outside.size:
            self._high = bool(level[-1])
        self._kept = signal[max(np.append(0, outside)[-1], signal.size - _LONGEST):].copy()
        return found, level[changes]


def _before(signal: FloatArray, threshold: float, near: float, begin: IntArray, last: IntArray,
            end: IntArray) -> FloatArray:
    """
    Return where edges pass the threshold (edge,), in samples from the `last` one behind it.

    An edge is from the sample `begin` to `end`. A line is fitted to as many samples in front of
    the crossing as behind it, and again to those where it is `near` the threshold.
    """
    lowest, highest = begin - last, end - last if near else np.zeros_like(last)
    low, high, found = np.maximum(lowest, -1 - highest), highest, np.zeros(0)
    for _ in range(_ROUNDS if last.size else 0):
        count = high - low + 1
        starts = np.cumsum(count) - count
        place = np.arange(count.sum()) - np.repeat(starts, count)
        values = signal[place + np.repeat(last + low, count)] - threshold
        mean = np.add.reduceat(values, starts) / count
        moment = np.add.reduceat(values * (place - np.repeat(0.5 * (count - 1), count)), starts)
        slope = 12.0 * moment / (count * (count**2 - 1.0))
        slope = np.where(np.abs(slope) > near / _LONGEST, slope, near / _LONGEST)
        found = np.clip(0.5 * (low + high) - mean / slope, lowest, highest)
        if not (near and np.any(highest - lowest > 1)):  # steep edges, here and in any other cut
            break
        reach = np.minimum(near / np.abs(slope), highest - lowest)
        low = np.clip(np.ceil(found - reach).astype(np.int64), lowest, -1)
        high = np.clip(np.floor(found + reach).astype(np.int64), 0, highest)
    return found
