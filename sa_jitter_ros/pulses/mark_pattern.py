# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The angles between the marks of a target, from the intervals of several revolutions."""

from dataclasses import dataclass
import math

import numpy as np
from sa_jitter_ros.arrays import BoolArray, FloatArray, IntArray

#: Standard deviation of normal variables, over the median of their magnitudes: strays among them
#: hardly move it.
OF_MEDIAN = 1.4826
_FEWEST = 2  # intervals of a mark
# How much more the means of the marks have to scatter than the intervals of one mark explain.
_SIGNIFICANT = 4.0
# Degrees of freedom of a few revolutions; those left where several pulses may be displaced.
_FEWEST_FREE, _FREE_OF_SEVERAL = 4, 6
_DISPLACED, _MOST_DISPLACED = 64.0, 3  # variances that a displaced pulse explains
_TINY = 1e-9
# Levels of two revolutions that repeat: tried from narrow to wide; and their change of speed.
_UNEVEN = 0.5  # of levels: intervals of more than 1.6 times others are gaps
_REPEATING, _CHANGE = (0.005, 0.02, 0.06), 0.3
_UNLIKE = 2.0  # tolerances by which the changes of speed may differ
_CLEAN = 0.25  # of all pairs of revolutions are without a stray, at least
_RANGE = {2: 0.4, 3: 0.75}  # of so many normal variables, in that of four and more


@dataclass(frozen=True)
class MarkPattern:
    """
    Logarithms of the relative `widths` (mark,), and the `scatter` of the intervals about them.

    The widths shrink towards 0 as far as the scatter explains them. Those of marks that are not
    `known` (mark,) are 0.
    """

    widths: FloatArray
    known: BoolArray
    scatter: float


def mark_pattern(marks: IntArray, levels: FloatArray, count: int, *,
                 significant: float = _SIGNIFICANT) -> MarkPattern | None:
    """
    Return what repeats in the levels (n,) of consecutive intervals, None if they are too few.

    The interval i begins at the mark `marks[i]` of `count`; its level is the logarithm of its
    length, NaN where it is not known. Widths that scatter less than `significant` variances of
    their means are 0.

    >>> late = np.tile([0.1, -0.1, 0.0, 0.0], 5)
    >>> pattern = mark_pattern(np.arange(20) % 4, late + 0.001 * np.arange(20), 4)
    >>> pattern.widths.round(2) + 0.0
    array([ 0.1, -0.1,  0. ,  0. ])
    """
    if levels.size < (1 + _FEWEST) * count:
        return None
    known = np.isfinite(levels)
    window = np.ones(count)
    weights = np.convolve(known, window, 'valid')
    with np.errstate(invalid='ignore', divide='ignore'):
        smooth = np.convolve(np.where(known, levels, 0.0), window, 'valid') / weights
    first = (count - 1) // 2
    middle = slice(first, first + smooth.size)
    off = levels[middle] - smooth
    at = marks[middle]
    # Row by row a revolution, as far as the intervals follow each other.
    row = np.cumsum(np.append(0, np.diff(at) <= 0))
    table = np.full((int(row[-1]) + 1, count), np.nan)
    table[row, at] = off
    seen = np.count_nonzero(np.isfinite(table), axis=0)
    known_marks = seen >= _FEWEST
    if not known_marks.any():
        return None
    widths = np.zeros(count)
    ordered, column = np.sort(table, axis=0), np.flatnonzero(known_marks)  # NaN last
    widths[column] = 0.5 * sum(ordered[(seen[column] - k) // 2, column] for k in (0, 1))
    deviations = (table - widths) * np.sqrt(seen / np.maximum(seen - 1.0, 1.0))
    every = deviations[:, known_marks]
    every = every[np.isfinite(every)]
    # The median of the magnitudes is not moved by strays; of two values it is their deviation.
    scatter = OF_MEDIAN * float(np.median(np.abs(every)))
    per_mark = every.size / np.count_nonzero(known_marks)
    widths[known_marks] -= widths[known_marks].mean()
    return MarkPattern(_shrunk(widths, known_marks, scatter**2 / per_mark, significant),
                       known_marks, scatter)


def _shrunk(widths: FloatArray, known: BoolArray, variance: float,
            significant: float = _SIGNIFICANT) -> FloatArray:
    """Return widths (mark,), those not `known` 0, as far as their variance is no explanation."""
    between = float(np.mean(widths[known]**2))
    if between <= significant * variance:
        return np.zeros(widths.size)
    return np.asarray(widths * (1.0 - variance / between))


def _fit(design: FloatArray, levels: FloatArray) -> tuple[FloatArray, float]:
    """Return the factors of a design (n, factor) and the variance of what it leaves of levels."""
    found = np.linalg.lstsq(design, levels, rcond=None)[0]
    left = levels - design @ found
    return np.asarray(found), float(left @ left) / (levels.size - found.size)


def steady_pattern(marks: IntArray, levels: FloatArray, count: int) -> MarkPattern | None:
    """
    Return the pattern of a few revolutions of few marks, None if they are too few.

    `marks`, `levels` and `count` are those of `mark_pattern`. The speed changes along a line, and
    up to three pulses may be displaced: each makes an interval as much longer as the next is
    shorter. The two levels then differ, and together they are lower. Where a stray was taken for a
    pulse, a single interval may be wrong.

    >>> late = np.tile([0.1, -0.1], 5) + 1e-3 * np.array([1, 0, -1, 2, 0, -2, 0, 1, -1, 0])
    >>> pulses = np.append(0.0, np.cumsum(np.exp(late)))
    >>> pulses[4] += 0.3  # displaced
    >>> pattern = steady_pattern(np.arange(10) % 2, np.log(np.diff(pulses)), 2)
    >>> pattern.widths.round(2).tolist(), round(pattern.scatter, 4)
    ([0.1, -0.1], 0.0014)
    """
    place = np.flatnonzero(np.isfinite(levels))
    free = place.size - count - 1
    if free < _FEWEST_FREE or np.bincount(marks[place], minlength=count).min() < _FEWEST:
        return None
    levels = levels[place]
    design = np.column_stack((np.eye(count)[marks[place]], place - place.mean()))
    single = np.eye(place.size)
    pulses = np.column_stack(((single[:, :-1] - single[:, 1:])[:, np.diff(place) == 1], single))
    found, square = _fit(design, levels)
    for _ in range(max(1, min(_MOST_DISPLACED, free - _FREE_OF_SEVERAL))):
        fitted = np.linalg.qr(design).Q
        left, moved = (item - fitted @ (fitted.T @ item) for item in (levels, pulses))
        told = np.square(moved.T @ left) / np.maximum(np.sum(np.square(moved), axis=0), _TINY)
        largest = int(np.argmax(told))
        design = np.column_stack((design, pulses[:, largest]))
        without = _fit(design, levels)
        longer, shorter = pulses[:, largest] > 0.0, pulses[:, largest] < 0.0
        if shorter.any():
            half = without[0][-1]
            first, second = np.exp(without[0][marks[place][longer | shorter]])
            levels = levels + (longer | shorter) * np.log(
                (first * np.exp(half) + second * np.exp(-half)) / (first + second))
            without = _fit(design, levels)
        # Two of them hide each other: the last one that is significant tells how many.
        if told[largest] > _DISPLACED * without[1]:
            found, square = without
    widths = found[:count] - found[:count].mean()
    known = np.ones(count, np.bool_)
    variance = square * count / place.size
    return MarkPattern(_shrunk(widths, known, variance), known, math.sqrt(square + variance))


def repeating(levels: FloatArray, count: int) -> tuple[int, MarkPattern] | None:
    """
    Return where levels (n,) first repeat for two revolutions of `count` marks, and their pattern.

    Two revolutions without a stray or missing pulse show the pattern of few marks, however uneven.

    >>> begin, pattern = repeating(np.array([0.4, *[0.1, -0.1, 0.0] * 2]), 3)
    >>> begin, pattern.widths.round(3).tolist()
    (1, [0.1, -0.1, 0.0])
    """
    if levels.size < 2 * count:
        return None
    change = levels[count:] - levels[:-count]
    windows = np.lib.stride_tricks.sliding_window_view(change, count)
    apart = windows.max(axis=1) - windows.min(axis=1)  # apart from a change of speed
    # Pulses that are missing may repeat by chance.
    first = np.lib.stride_tricks.sliding_window_view(levels[:-count], count)
    apart[np.ptp(first, axis=1) > _UNEVEN] = np.inf
    near = np.abs(windows).max(axis=1) <= _CHANGE
    # A displaced pulse of two marks repeats, too, with a change of speed that the others lack.
    slopes = windows.mean(axis=1)
    unlike = np.abs(slopes - (np.median(slopes[near]) if near.any() else 0.0))
    found = [(tolerance, np.flatnonzero((apart <= tolerance) & near & (
        unlike <= _UNLIKE * tolerance))) for tolerance in _REPEATING]
    found = [item for item in found if item[1].size]
    if not found:
        return None
    tolerance, fits = found[0]
    begin = int(fits[0])
    slope = float(slopes[begin]) / count
    two = (levels[begin:begin + 2 * count].reshape(2, count)
           - slope * np.arange(2 * count).reshape(2, count))
    widths = two.mean(axis=0)
    # Of large jitter some repeat by chance, which tell too small a scatter.
    usual = _RANGE.get(count, 1.0)
    all_pairs = apart[near & np.isfinite(apart)]
    typical = max(float(np.median(apart[fits])) / 4.0,
                  min(float(np.quantile(all_pairs, _CLEAN)) / 3.0, tolerance)) / usual
    # The widths are those of two revolutions, as uncertain as one of these by a root of two.
    scatter = math.sqrt(1.5) * (float(np.std(two[1] - two[0])) + typical)
    return begin, MarkPattern(widths - widths.mean(), np.ones(count, np.bool_), scatter)


def regular_start(levels: FloatArray, tolerance: float) -> int:
    """
    Return the number of the first of the levels (n,) that those behind it confirm.

    It differs from the next one, or from the line through the next two, by at most `tolerance`.

    >>> regular_start(np.array([0.5, 0.1, 0.0, 0.0, 0.0]), 0.01)
    2
    """
    if levels.size < 3:
        return 0
    first, second, third = levels[:-2], levels[1:-1], levels[2:]
    near = np.minimum(np.abs(first - second), np.abs(first - 2.0 * second + third)) <= tolerance
    return int(np.argmax(near)) if near.any() else 0
