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
Lines of the vibration over the angle of the tach shaft, and what they tell of marks and ratio.

A component that a shaft makes is a line in the spectrum over angle, also while the speed changes.
All lines of a shaft are multiples of its speed. Lines at half a mark, a third, ... say that a
revolution has two marks, three, ...; lines between the orders of the tach shaft say that another
shaft turns at a ratio.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
import math

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.keyphasor_check.marks import FittedPulses
from sa_jitter_ros.pulses.resampling import FULL_BAND, interpolate
from scipy.fft import next_fast_len, rfft
from scipy.interpolate import PchipInterpolator
from scipy.special import softmax

_MOST_VALUES = 3_000_000
_MOST_POINTS = 600_000
# Times the median of the spectrum around: a line; and one that noise makes in 5e-5 of places.
_PROMINENT, _CLEAR = 7.0, 4.0
# Bins of a line to either side, and how much larger it is than as many bins beside them.
_LOBE, _ABOVE = 3, 1.5
_NEIGHBOURHOOD = 100
_MOST_LINES = 60
_STRONGEST = 3e-3  # of the strongest line; below it are side lobes and distortion
# Width of a line's place in bins of the spectrum.
_WIDTH = 0.6
_FOLLOWS = 0.7  # probability that a line is an order of a shaft that is considered
# The most that families on fractions of the mark rate say, each of meshes beyond it: ratios of
# gears are fractions, too.
_COINCIDENCE = 2.5
_MEMBER = 0.25  # what each further multiple of a line says, in parts of the first
# A vibration that repeats several times in a revolution is so improbable.
_SYMMETRY = 1.5
_FEWEST_ON_RATIO = 3
_PRIOR = 3.0  # log probability that the shaft of interest carries the tach
_LARGEST_RATIO, _SMALLEST_RATIO = 30.0, 0.05
# Marks of usual targets and encoders divide one of these; what the others are less probable by.
_DIVIDED, _UNUSUAL = (18_000, 4096, 10_000), 2.5
# Marks that may be uneven, by at least so many revolutions, and by how much sharper the lines with
# the one or the other are.
_SEVERAL_MARKS, _EVEN, _SHARPER = 4, 1e-4, 1.001


@dataclass(frozen=True)
class ToothLines:
    """
    Lines of the vibration: `places` (n,) in cycles a tooth, ascending, and their `sizes` (n,).

    `sizes` are amplitudes over the median of the spectrum around; `levels` (n,) are amplitudes on
    the strongest channel, in parts of the strongest line. `step` is a bin of the spectrum.
    """

    places: FloatArray
    sizes: FloatArray
    levels: FloatArray
    step: float

    def logarithms(self, places: FloatArray) -> FloatArray:
        """Return the logarithms of the sizes of lines at places (n,), 0 where there is none."""
        near = np.abs(self.places - places[:, None]) < 0.5 * _LOBE * self.step
        return np.asarray(np.log(np.max(np.where(near, self.sizes, 1.0), axis=1, initial=1.0)))

    def share(self, least: float, most: float) -> float:
        """Return the share of places from `least` to `most` where `logarithms` has a line."""
        count = np.count_nonzero((self.places > least) & (self.places < most))
        return min(1.0, _LOBE * self.step * count / (most - least))

    def scaled(self, factor: float) -> 'ToothLines':
        """Return the lines with places in cycles of something `factor` teeth long."""
        return ToothLines(self.places * factor, self.sizes, self.levels, self.step * factor)


def find_lines(samples: FloatArray, start: float, rate: float, times: FloatArray,
               turned: FloatArray, *, weak: bool = False) -> ToothLines | None:
    """
    Return the lines in `samples` (sample, channel) over the angle, also `weak` ones if asked.

    The shaft has `turned` (n,) at `times` (n,) in s; the first sample was at `start`. What leaks
    from a line is none. None where the orders of the shaft are not apart.
    """
    end, skirt = start + (len(samples) - 1) / rate, 2 * _LOBE + 1
    inside = (times >= start) & (times <= end)
    times, turned = times[inside], turned[inside]
    most = min(_MOST_POINTS, _MOST_VALUES // samples.shape[1])
    count = int(np.searchsorted(times, times[0] + most / rate)) if times.size else 0
    times, turned = times[:count], turned[:count]
    if times.size < 3 or turned[-1] - turned[0] < 2 * skirt:
        return None
    step = 1.0 / float(turned[-1] - turned[0])
    spectrum = _spectrum(samples, (times - start) * rate, turned)
    tiny = np.finfo(np.float64).tiny
    share = spectrum / np.maximum(_background(spectrum), tiny)
    size = share.max(axis=1)
    level = (spectrum / np.maximum(spectrum.max(axis=0), tiny)).max(axis=1)
    peak = (size > (_CLEAR if weak else _PROMINENT)) & (level > (0.0 if weak else _STRONGEST))
    found = np.flatnonzero(peak[skirt:1 - skirt]) + skirt
    around = share[found[:, None] + np.arange(-skirt + 1, skirt)]  # line, bin, channel
    beside = np.delete(around, slice(skirt - _LOBE, skirt + _LOBE - 1), axis=1).max(axis=1)
    top = around[:, skirt - 2:skirt + 1].argmax(axis=1) == 1
    found = found[np.any(top & (share[found] > np.maximum(_ABOVE * beside, _CLEAR)), axis=1)]
    if not weak:
        found = np.sort(found[np.argsort(-size[found])][:_MOST_LINES])
    channel = np.argmax(share[found], axis=1)
    left, middle, right = (np.log(np.maximum(spectrum[found + k, channel], 1e-300))
                           for k in (-1, 0, 1))
    bend = left - 2.0 * middle + right
    offset = np.where(bend < 0.0, 0.5 * (left - right) / np.minimum(bend, -1e-12), 0.0)
    return ToothLines((found + np.clip(offset, -0.5, 0.5)) * step, size[found], level[found], step)


def _spectrum(samples: FloatArray, places: FloatArray, turned: FloatArray) -> FloatArray:
    """Return the amplitude spectrum (bin, channel) over the angle, `turned` at `places` (n,)."""
    points = next_fast_len(int(places[-1] - places[0]), real=True)
    angle = turned[0] + (turned[-1] - turned[0]) * np.arange(points) / points
    position = PchipInterpolator(turned, places)(angle)
    over_angle = interpolate(samples, np.clip(position, 0.0, len(samples) - 1.0))
    over_angle -= over_angle.mean(axis=0)
    window = np.hanning(points + 1)[:-1, None]
    return np.asarray(np.abs(rfft(over_angle * window, axis=0))[:int(FULL_BAND * points)])


def _background(spectrum: FloatArray) -> FloatArray:
    """Return the median (bin, channel) of a spectrum around each bin."""
    blocks = max(1, len(spectrum) // _NEIGHBOURHOOD)
    edges = np.linspace(0, len(spectrum), blocks + 1).astype(int)
    middle = 0.5 * (edges[1:] + edges[:-1])
    medians = np.array([np.median(spectrum[a:b], axis=0) for a, b in pairwise(edges)])
    return np.array([np.interp(np.arange(len(spectrum)), middle, column)
                     for column in medians.T]).T


def marks_evidence(lines: ToothLines | None, counts: Sequence[int]) -> dict[int, float]:
    """
    Return the logarithm of the likelihood of each number of marks in a revolution.

    Lines are in cycles a mark. A target with more marks than the lines need is possible: the
    vibration then repeats several times in a revolution.
    """
    if lines is None or not lines.places.size:
        return dict.fromkeys(counts, 0.0)
    families, log = _families(lines), dict.fromkeys(counts, 0.0)
    strays = -math.inf if np.any(on_orders(lines, 1.0)[1]) else (
        len(families) * math.log(1.0 - _FOLLOWS))
    for count in counts:
        said = [_says(lines, family, count) for family in families]
        chance = sum(min(value, _COINCIDENCE) if lines.places[family[0]] > 1.0 else value
                     for (value, certain), family in zip(said, families) if not certain)
        log[count] = sum(value for value, certain in said if certain) + max(
            min(chance, _COINCIDENCE), chance + strays)
    return {count: max([value, *(log[part] - _SYMMETRY - math.log(count / part)
                                 for part in counts if count % part == 0 and part < count)])
            for count, value in log.items()}


def is_usual(count: int) -> bool:
    """Return whether targets or encoders with so many marks are usual."""
    return any(each % count == 0 for each in _DIVIDED)


def usual_marks(count: int) -> float:
    """Return the logarithm of the probability, but for a constant, of so many marks."""
    return -math.log(count) - (0.0 if is_usual(count) else _UNUSUAL)


def _families(lines: ToothLines) -> list[list[int]]:
    """Return the lines in groups of one line and its multiples."""
    left, families = list(range(lines.places.size)), []
    while left:
        base, sure = lines.places[left[0]], 1.0
        family = [left[0]]
        for index in left[1:]:
            place = lines.places[index]
            multiple = round(place / base)
            # The base is as exact as the highest multiple that gave it.
            width = _WIDTH * lines.step * (1.0 + 0.5 * multiple / sure)
            if width < 0.25 * base and abs(place - multiple * base) < width:
                family.append(index)
                base, sure = place / multiple, float(multiple)
        families.append(family)
        left = [index for index in left if index not in family]
    return families


def _says(lines: ToothLines, family: list[int], count: int) -> tuple[float, bool]:
    """
    Return the log likelihood that a family lies on multiples of 1/count, over any other place.

    It is certain where the lines are whole multiples of the marks; else they may be those of
    another shaft: gear ratios are fractions, too.
    """
    places = lines.places[family] * count
    width = _WIDTH * lines.step
    on = np.abs(places - np.rint(places)) < width * count
    one = np.where(on, _per_line(lines, 1.0 / count) - math.log(1.0 - _FOLLOWS), 0.0)
    weight = np.where(np.arange(one.size) == 0, 1.0, _MEMBER)
    whole = bool(np.all(np.abs(lines.places[family] - np.rint(lines.places[family])) < width))
    # Multiples of a line that is no multiple of 1/count are those of another shaft.
    return float(weight @ one) if on[0] else 0.0, whole


def on_orders(lines: ToothLines, ratio: float) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return the orders (n,) of lines, in cycles a revolution, of a shaft, and which fit."""
    orders = np.rint(lines.places / ratio)
    near = np.abs(lines.places - orders * ratio) < _WIDTH * lines.step
    return orders, near & (orders > 0.0)


def ratio_evidence(lines: ToothLines, teeth: Sequence[int] = ()) -> list[tuple[float, float]]:
    """
    Return ratios of a shaft whose orders the lines are, with their probabilities, best first.

    Lines are in cycles a revolution of the tach shaft. `teeth` are numbers of teeth that gears of
    the machine have; without them, sidebands tell the speed of a shaft.
    """
    _, near = on_orders(lines, 1.0)
    other = ~near
    weight = np.log(lines.sizes / _PROMINENT) + 1.0
    own = float(weight[near].sum())
    log = {1.0: own * _per_line(lines, 1.0)}
    strong = np.flatnonzero(other)[np.argsort(-lines.sizes[other])][:24]
    candidates: set[float] = set()
    for i in strong:
        for count in teeth:
            candidates.add(lines.places[i] / count)
        for j in strong:
            apart = abs(lines.places[i] - lines.places[j])
            if i != j:  # the place is as exact, and a multiple
                candidates |= {apart, lines.places[i] / max(round(lines.places[i] / apart), 1)}
    for a in teeth:
        candidates |= {a / b for b in teeth if b != a}
    for ratio in sorted(candidates):
        if not _SMALLEST_RATIO < ratio < _LARGEST_RATIO or abs(ratio - 1.0) < 1e-4:
            continue
        ratio = _fine(lines, ratio, strong)
        fits = on_orders(lines, ratio)[1] & other
        if np.count_nonzero(fits) < _FEWEST_ON_RATIO:
            continue
        score = float(weight[fits].sum()) * _per_line(lines, ratio)
        log[round(ratio, 9)] = score - _PRIOR - math.log(len(candidates))
    return _normalised(log, lines.step)


def _per_line(lines: ToothLines, ratio: float) -> float:
    """Return what a line on an order of a shaft says for it: little where orders are dense."""
    chance = min(1.0, 2.0 * _WIDTH * lines.step / ratio)
    return math.log(1.0 - _FOLLOWS + _FOLLOWS / chance)


def _fine(lines: ToothLines, ratio: float, strong: NDArray[np.intp]) -> float:
    """Return a ratio adjusted to the lines that are its multiples."""
    places, sizes = lines.places[strong], lines.sizes[strong]
    for _ in range(3):
        orders = np.rint(places / ratio)
        near = (np.abs(places - orders * ratio) < 1.5 * lines.step) & (orders > 0)
        if not near.any():
            break
        g = orders[near] * sizes[near]
        ratio = float(g @ places[near] / (g @ orders[near]))
    return ratio


def _normalised(log: dict[float, float], step: float) -> list[tuple[float, float]]:
    merged: dict[float, float] = {}
    for ratio, value in sorted(log.items(), key=lambda item: -item[1]):
        if all(abs(ratio - kept) >= step for kept in merged):
            merged[ratio] = value
    shares = softmax([*merged.values()]).tolist()
    return [(ratio, share) for ratio, share in zip(merged, shares) if share > 1e-3][:6]


def speed_ripples(samples: FloatArray, start: float, rate: float, fitted: FittedPulses) -> bool:
    """
    Return whether uneven pulses are those of even marks on a shaft whose speed changes in a turn.

    The two are alike in the pulse times. The vibration (channel, sample) from `start` (s) decides:
    its power over the angle is in fewer lines with the right one.
    """
    pattern = fitted.pattern
    if pattern.present < _SEVERAL_MARKS or fitted.breaks.size or (
            np.ptp(pattern.marks) < _EVEN * pattern.teeth):
        return False
    shares = []
    for times in (fitted.measured, fitted.true):
        lines = find_lines(samples.T, start, rate, times, fitted.revolutions, weak=True)
        if lines is None:
            return False
        power = lines.levels**2
        shares.append(float(np.sum(power**2)) / max(float(np.sum(power))**2, 1e-300))
    return shares[0] > _SHARPER * shares[1]
