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
The pulses on their target: where each mark stands, which pulses are strays and which are lost.

The mean over whole revolutions sees no pattern of the target. What a mark is late against it is
averaged over the revolutions. Each pulse is then compared with its neighbours, marks corrected.
"""

from dataclasses import dataclass, replace
import math

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.arrays import FloatArray, IntArray
from sa_jitter_ros.keyphasor_check.teeth import (
    joined_parts, nearest_pulses, number_pulses, NumberedPulses)
from sa_jitter_ros.keyphasor_check.uneven_wheel import MOST_MARKS, number_marks
from sa_jitter_ros.keyphasor_check.wheel import Marking, pattern_of, patterns
from sa_jitter_ros.pulses.mark_pattern import OF_MEDIAN
from sa_jitter_ros.pulses.target_geometry import measured_geometry, motion_of

_ROUNDS = 2
_OUTLIER = 8.0  # robust standard deviations
_LEAST = 0.02  # teeth that a stray stands beside its tooth at least
_MOST_AT_ONCE = 200
_NEIGHBOURS = 7  # with the pulse itself
_FEWEST_TURNS = 24
_LEAST_SCATTER = 1e-9  # s
# Strays and gaps a revolution, and times as bad a fit, with which all pulses may be marks.
_OFTEN, _BETTER = 0.5, 0.85
_NEAR = 0.25  # teeth from its mark: a pulse may be that of the mark


@dataclass(frozen=True)
class FittedPulses:
    """
    Pulses of a known target.

    `true` (n,) are their times in s with the marks corrected, `measured` (n,) without that,
    `numbers` (n,) count teeth.
    `strays` (m,) and `lost` (k,) in s are the pulses that belong to no mark, and the times at
    which a mark has no pulse. `speed` (n - 1,) is that of the tach shaft in Hz between pulses.
    """

    pattern: Marking
    true: FloatArray
    numbers: IntArray
    breaks: IntArray
    strays: FloatArray
    lost: FloatArray
    measured: FloatArray

    def with_even_marks(self) -> 'FittedPulses':
        """Return the pulses of even marks, which the speed alone makes early and late."""
        pattern = replace(self.pattern, marks=np.zeros_like(self.pattern.marks))
        return replace(self, pattern=pattern, true=self.measured)

    @property
    def within_turns(self) -> tuple[FloatArray, FloatArray]:
        """
        Return by how much the angle of pulses is ahead of an even turn, in revolutions (m,).

        Those of a revolution are compared with the line from its first mark to the next one's. The
        second result is what a parabola in each revolution leaves, as a speed that changes evenly.
        """
        turned, start = self.revolutions, np.arange(
            math.ceil(self.revolutions[0]), math.floor(self.revolutions[-1]) + 1.0)
        if start.size < 2:
            return np.zeros(0), np.zeros(0)
        begun = np.interp(start, turned, self.true)
        inside = (turned >= start[0]) & (turned < start[-1])
        number = np.floor(turned[inside] - start[0]).astype(np.intp)
        place = (self.true[inside] - begun[number]) / np.diff(begun)[number]
        ahead, bend = turned[inside] % 1.0 - place, place * (1.0 - place)
        known = np.maximum(np.bincount(number, bend * bend), np.finfo(np.float64).tiny)
        size = np.bincount(number, bend * ahead) / known
        near = np.abs(ahead) < 0.5  # of a turn: not beside a standstill
        return ahead[near], (ahead - size[number] * bend)[near]

    @property
    def revolutions(self) -> FloatArray:
        """Return the angle of each pulse (n,) in revolutions of the tach shaft."""
        return np.asarray((self.numbers - self.pattern.origin) / self.pattern.teeth)

    @property
    def spurious(self) -> FloatArray:
        """Return the strays (m,) in s; before and behind all others the speed is not known."""
        first, last = np.searchsorted(self.strays, self.measured[[0, -1]])
        return np.asarray(self.strays[first:last])

    @property
    def unfit(self) -> float:
        """Return how far pulses stand from their marks, in teeth; a stray or a gap counts half."""
        pitch = np.gradient(self.true) / np.gradient(self.numbers.astype(np.float64))
        away = np.abs(_beside(self.true, self.numbers, np.maximum(pitch, 1e-300)))
        wrong = self.strays.size + self.lost.size + self.breaks.size
        return float(np.minimum(away, 0.5).sum() + 0.5 * wrong) / (self.true.size + wrong)

    @property
    def scatter(self) -> float:
        """Return how far pulses stand from a smooth motion, in s; it holds some of the motion."""
        one = np.diff(self.numbers) == 1
        third = np.diff(self.true, 3)[one[:-2] & one[1:-1] & one[2:]]
        return max(float(np.std(third)) / math.sqrt(20.0) if third.size else 0.0, _LEAST_SCATTER)

    def once_a_revolution(self) -> NDArray[np.bool_]:
        """Return the pulses (n,) of the mark that begins trigger cycles, all if there are few."""
        first = self.pattern.tooth(self.numbers) == 0
        return first if np.count_nonzero(first) >= _FEWEST_TURNS else np.ones_like(first)

    @property
    def mean_speed(self) -> float:
        """Return the mean speed of the tach shaft in Hz, without standstills."""
        return self.turns / float(np.delete(np.diff(self.true), self.breaks - 1).sum())

    @property
    def turns(self) -> float:
        """Return the number of revolutions, without standstills."""
        return float(np.delete(np.diff(self.revolutions), self.breaks - 1).sum())

    @property
    def speed(self) -> FloatArray:
        """Return the speed of the tach shaft (n - k,) in Hz, over about a revolution each."""
        step = max(1, min(self.pattern.present, self.true.size // 2))
        turned = (self.numbers[step:] - self.numbers[:-step]) / self.pattern.teeth
        time = self.true[step:] - self.true[:-step]
        inside = np.ones(time.size, np.bool_)
        for begin in self.breaks:
            inside[max(begin - step, 0):begin] = False
        return np.asarray((turned / np.maximum(time, 1e-300))[inside & (time > 0.0)])


def number_and_patterns(times: FloatArray) -> tuple[NumberedPulses, list[Marking]]:
    """
    Return pulses (n,) in s numbered on their target, and its patterns, the best first.

    Where strays and gaps are frequent, the numbers of teeth may be wrong, and all pulses those of
    marks that stand unevenly. Pulses of equal times are one, and strays.
    """
    apart = np.append(True, np.diff(times) > 0.0)
    numbered, found = _number_and_patterns(times[apart])
    return replace(numbered, strays=np.sort(np.append(numbered.strays, times[~apart]))), found


def _number_and_patterns(times: FloatArray) -> tuple[NumberedPulses, list[Marking]]:
    numbered = number_pulses(times)
    found = patterns(numbered)
    if found and found[0].present == 1:  # one mark, and the teeth between are none
        numbered = numbered.every(found[0].teeth, found[0].origin)
        found = patterns(numbered)
    found = [item for item in found if item.present > 1]
    first = fit_pulses(numbered, found[0].teeth if found else 1)
    wrong = first.strays.size + first.lost.size + first.breaks.size
    marks = number_marks(times) if wrong * MOST_MARKS > _OFTEN * times.size else None
    uneven = [item for item in patterns(marks) if item.present > 1] if marks is not None else []
    if marks is not None and uneven:
        other = fit_pulses(marks, uneven[0].teeth)
        if other.unfit < _BETTER * first.unfit:
            return marks, uneven
    return numbered, found


def fit_pulses(pulses: NumberedPulses, teeth: int, *, tick: float = 0.0) -> FittedPulses:
    """
    Return the pulses on a target of so many teeth; 1 for an even one of unknown marks.

    `tick` is the period of the clock in s of which pulse times are multiples.
    """
    pattern = pattern_of(pulses, teeth)
    parts = pulses.unbroken()
    best = max(range(len(parts)), key=lambda k: parts[k].times.size)
    pattern, parts[best] = _fitted(parts[best], pattern, tick)
    for k, part in enumerate(parts):
        if k != best:
            aligned = _aligned(part, pattern)
            parts[k] = _fitted(aligned, pattern, tick)[1] if (
                part.times.size >= _NEIGHBOURS) else aligned
    pulses = joined_parts(parts, teeth)
    late = pattern.late()[pattern.tooth(pulses.numbers)] * pulses.pitch
    true = pulses.times - late
    wanted = np.arange(pulses.numbers[0], pulses.numbers[-1] + 1)
    expected = wanted[~pattern.missing[pattern.tooth(wanted)]]
    for begin in pulses.breaks:  # the count over a standstill means nothing
        low, high = pulses.numbers[begin - 1], pulses.numbers[begin]
        expected = expected[(expected <= low) | (expected >= high)]
    absent = np.setdiff1d(expected, pulses.numbers)
    pitch = np.interp(absent, pulses.numbers, pulses.pitch)
    lost = np.interp(absent, pulses.numbers, true) + pattern.late()[pattern.tooth(absent)] * pitch
    return FittedPulses(pattern, true, pulses.numbers, pulses.breaks, pulses.strays,
                        np.asarray(lost), pulses.times)


def _fitted(pulses: NumberedPulses, pattern: Marking, tick: float
            ) -> tuple[Marking, NumberedPulses]:
    """Return the pattern with its marks measured, and the pulses on it."""
    for _ in range(_ROUNDS):
        pulses = pulses.only(~pattern.missing[pattern.tooth(pulses.numbers)])
        if pattern.teeth > 1:
            pulses, pattern = _measured(pulses, pattern)
            pulses = _chosen_again(pulses, pattern)
        pulses = pulses.only(
            ~_outliers(pulses, pattern.late()[pattern.tooth(pulses.numbers)], tick))
    if pattern.teeth > 1:
        pulses, pattern = _measured(pulses, pattern)
    return pattern, pulses


def _aligned(pulses: NumberedPulses, pattern: Marking) -> NumberedPulses:
    """Return pulses behind a standstill with numbers that fit the pattern in front of it."""
    late = np.where(pattern.missing, np.inf, pattern.late())
    away = [np.abs(pulses.places - late[pattern.tooth(pulses.numbers + shift)])
            for shift in range(pattern.teeth)]
    costs = np.minimum(away, 0.5).mean(axis=1)
    return replace(pulses, numbers=pulses.numbers + int(np.argmin(costs)))


def _measured(pulses: NumberedPulses, pattern: Marking) -> tuple[NumberedPulses, Marking]:
    """Return the pattern with the marks where the pulses show them, and the pitch there."""
    teeth = np.flatnonzero(~pattern.missing)
    found = measured_geometry(pulses.times, pulses.numbers - pattern.origin, teeth, pattern.teeth)
    if found is None:
        return pulses, pattern
    scale = pattern.teeth / (2.0 * math.pi)
    pattern = replace(pattern, marks=found.angles * scale, errors=found.standard_errors * scale)
    _, pitch = _motion(pulses, pattern)
    return replace(pulses, pitch=pitch[pulses.numbers - pulses.numbers[0]]), pattern


def _motion(pulses: NumberedPulses, pattern: Marking) -> tuple[FloatArray, FloatArray]:
    """Return when teeth from the first number on (m,) would pass if even, and their pitch (s)."""
    true = pulses.times - pattern.late()[pattern.tooth(pulses.numbers)] * pulses.pitch
    return motion_of(true, pulses.numbers - pulses.numbers[0], pattern.teeth)


def _chosen_again(pulses: NumberedPulses, pattern: Marking) -> NumberedPulses:
    """Return the pulses and strays that stand nearest to the marks, which are known by now."""
    grid = np.arange(pulses.numbers[0], pulses.numbers[-1] + 1)
    late = pattern.late()[pattern.tooth(grid)]
    marks = np.flatnonzero(~pattern.missing[pattern.tooth(grid)])
    pitch = np.interp(grid, pulses.numbers, pulses.pitch)
    expected = np.maximum.accumulate((_motion(pulses, pattern)[0] + late * pitch)[marks])
    every = np.sort(np.append(pulses.times, pulses.strays))
    after = np.clip(np.searchsorted(expected, every), 1, marks.size - 1)
    near = after - (every - expected[after - 1] < expected[after] - every)
    away = np.abs(every - expected[near]) / pitch[marks[near]]
    kept = nearest_pulses(near, away)
    # Where the speed is not known well, as at the ends and beside gaps, pulses keep their number.
    fixed = np.isin(every, pulses.times) & (
        (away > _NEAR) | (near < pattern.teeth) | (near >= marks.size - pattern.teeth))
    kept &= ~fixed
    kept &= away <= _NEAR
    numbers = grid[marks[near]]
    unused = np.isin(pulses.numbers, numbers[kept], invert=True)
    known = np.searchsorted(every, pulses.times)
    extra = np.zeros(every.size, np.bool_)
    extra[known[unused]] = True
    extra &= fixed
    numbers[known[unused]] = pulses.numbers[unused]
    kept |= extra
    return NumberedPulses(every[kept], numbers[kept], np.zeros(int(kept.sum())),
                          np.interp(numbers[kept], grid, pitch), every[~kept], pulses.breaks)


def _outliers(pulses: NumberedPulses, late: FloatArray, tick: float) -> NDArray[np.bool_]:
    """Return which pulses (n,) stand far from where their neighbours have them."""
    found = np.zeros(pulses.times.size, np.bool_)
    for _ in range(_MOST_AT_ONCE):
        index = np.flatnonzero(~found)
        if index.size < 6:
            break
        place = _beside(pulses.times[index] - late[index] * pulses.pitch[index],
                        pulses.numbers[index], pulses.pitch[index])
        size = np.abs(place)
        limit = np.maximum(max(_OUTLIER * OF_MEDIAN * float(np.median(size)), _LEAST),
                           2.0 * tick / pulses.pitch[index])
        before, after = np.append(0.0, size[:-1]), np.append(size[1:], 0.0)
        wrong = (size > limit) & (size >= before) & (size >= after)
        if not wrong.any():
            break
        found[index[wrong]] = True
    return found


def _beside(times: FloatArray, numbers: IntArray, pitch: FloatArray) -> FloatArray:
    """Return how far (n,), in teeth, pulses stand behind the parabola through six neighbours."""
    n = times.size
    reach = min(_NEIGHBOURS, n)
    low = np.clip(np.arange(n) - reach // 2, 0, n - reach)
    around = low[:, None] + np.arange(reach)
    at = np.sort(np.where(around == np.arange(n)[:, None], n, around), axis=1)[:, :-1]
    x = (numbers[at] - numbers[:, None]).astype(np.float64)
    y = (times[at] - times[:, None]) / pitch[:, None]
    weight = 1.0 / np.maximum(np.abs(x), 1.0) ** 4
    degree = 2 if reach == _NEIGHBOURS else 1
    powers = np.stack([x**k for k in range(degree + 1)])
    normal = np.einsum('ink,jnk,nk->nij', powers, powers, weight)
    right = np.einsum('ink,nk->ni', powers, weight * y)
    normal += 1e-12 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(degree + 1)
    return np.asarray(-np.linalg.solve(normal, right[..., None])[:, 0, 0])
