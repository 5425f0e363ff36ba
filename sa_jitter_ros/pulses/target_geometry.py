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
Where the marks of a target stand, from the pulses of many revolutions.

The mean over whole revolutions sees no pattern of the target. How late a mark is against it is
averaged over the revolutions. The pulses alone cannot tell a pattern from a speed that ripples
with the revolution; pulse errors that the vibration shows can.
"""

from dataclasses import dataclass, replace
import math

import numpy as np
from sa_jitter_ros.arrays import FloatArray, IntArray
from sa_jitter_ros.pulses.mark_pattern import OF_MEDIAN
from scipy.ndimage import uniform_filter1d

_FEWEST = 4  # revolutions; without the first and the last, two show how much a mark scatters
_ROUNDS = 4  # which missing pulses and teeth need
_CLIPPED = 5.0  # robust standard deviations: displaced pulses tell nothing of their mark
_BLOCK = 4  # revolutions: beyond them what is left of the speed is independent
# Blocks for which the scatter of all marks counts: of fewer, that of one mark is known to worse
# than half (sqrt(2 / 10)); more would hide that one mark scatters more than others.
_OF_ALL = 10.0
# Squared standard errors: more than chance makes of all marks together, and of each one. The one
# is five standard errors of a single mark, and still 2.3 standard deviations of the sum over 60
# marks; of two turns of a pattern, the likelier one is then e^12.5 times as likely. The other is
# three standard errors of every mark.
_CLEAR, _OTHER = 25.0, 9.0
_ALIKE = 0.1  # share of its angles by which a pattern may differ beside standard errors


@dataclass(frozen=True)
class MarkOffsets:
    """
    How far each mark of a target is off its even place.

    `angles` (mark,) in rad of the tach shaft are late positive, with mean 0, and have the
    `standard_errors` (mark,), 0 where the angles were given. Mark 0 is the first trigger mark; of
    a wheel with missing teeth it is the first one behind the widest gap. The angles are those of
    the latest `revolutions`. `by_vibration`: pulse errors that the vibration shows have a part in
    them.
    """

    angles: FloatArray
    standard_errors: FloatArray
    revolutions: float = 0.0
    by_vibration: bool = False

    def __str__(self) -> str:
        """Return one line: the size of the angles, how they are known, what they may hold."""
        size = math.sqrt(float(np.mean(self.angles**2)))
        known = 'as given'
        if self.revolutions:
            error = math.sqrt(float(np.mean(self.standard_errors**2)))
            known = (f'with a standard error of {error:.2g} rad from {self.revolutions:.0f} '
                     f'revolutions; {self.remark}')
        return f'{self.angles.size} marks off by {size:.3g} rad RMS, {known}'

    @property
    def remark(self) -> str:
        """Return what the angles may hold beside the places of the marks."""
        if self.by_vibration:
            return ('the vibration tells the places of the marks from a ripple of the speed with '
                    'the revolution')
        if not self.revolutions:
            return ''
        return ('a ripple of the speed with the revolution looks the same in the pulses and is '
                'part of the angles; correct_jitter tells them apart where the vibration shows it')

    @property
    def significant(self) -> bool:
        """Whether the angles are more than their standard errors explain."""
        chi2 = float(np.sum((self.angles / np.maximum(self.standard_errors, 1e-300))**2))
        return chi2 > self.angles.size + _CLEAR


def measured_geometry(times: FloatArray, numbers: IntArray, teeth: IntArray, count: int
                      ) -> MarkOffsets | None:
    """
    Return where the marks of a target stand, None for pulses of too few revolutions.

    The pulses at `times` (n,) in s are those of the teeth `numbers` (n,), which count on from
    revolution to revolution. A revolution has `count` teeth, of which `teeth` (mark,) are there.

    >>> late = np.array([0.003, 0.001, -0.004])  # of a revolution, at 10 Hz
    >>> numbers = np.arange(60)
    >>> geometry = measured_geometry((numbers / 3 + late[numbers % 3]) / 10, numbers,
    ...                              np.arange(3), 3)
    >>> (geometry.angles / (2 * np.pi)).round(6)
    array([ 0.003,  0.001, -0.004])
    """
    turns = numbers // count - numbers[0] // count
    if turns[-1] < _FEWEST:
        return None
    tooth = numbers % count
    index = np.searchsorted(teeth, tooth)
    place = numbers - numbers[0]
    late = np.zeros(teeth.size)  # in teeth
    pitch: FloatArray = np.full(place[-1] + 1, (times[-1] - times[0]) / place[-1])
    for _ in range(_ROUNDS):
        smooth, pitch = motion_of(times - late[index] * pitch[place], place, count)
        table = np.full((int(turns[-1]) + 1, teeth.size), np.nan)
        table[turns, index] = (times - smooth[place]) / pitch[place]
        table = table[1:-1]  # the speed of the first and the last one is known less
        table = _clipped(table) if np.isfinite(table).any(axis=0).all() else table
        seen = np.count_nonzero(np.isfinite(table), axis=0)
        if seen.min() < _FEWEST - 2:
            return None
        late = np.nanmean(table, axis=0)
        late -= late.mean()
    scale = 2.0 * np.pi / count
    return MarkOffsets(late * scale, _standard_errors(table) * scale, float(seen.mean()))


def motion_of(times: FloatArray, place: IntArray, count: int
              ) -> tuple[FloatArray, FloatArray]:
    """
    Return when teeth 0, 1, ... (m,) of an even target would pass, and the pitch there, in s.

    They follow from the `times` (n,) in s at which the teeth `place` (n,), of which 0 is the
    first, passed. Means over revolutions of `count` teeth, and of what they miss of a bent motion,
    see no pattern of the target.
    """
    grid = np.arange(place[-1] + 1)
    straight = np.linspace(times[0], times[-1], grid.size)
    once = _over_revolution(np.interp(grid, place, times) - straight, count)
    smooth = np.asarray(2.0 * once - _over_revolution(once, count) + straight)
    return smooth, np.maximum(np.gradient(smooth), 1e-300)


def combined(before: MarkOffsets, latest: MarkOffsets, most: float) -> MarkOffsets:
    """Return the mean of both by their revolutions, of those before at most `most`."""
    weight = latest.revolutions / (latest.revolutions + min(before.revolutions, most))
    return replace(
        before, angles=before.angles + weight * (latest.angles - before.angles),
        standard_errors=np.hypot((1.0 - weight) * before.standard_errors,
                                 weight * latest.standard_errors),
        revolutions=min(before.revolutions, most) + latest.revolutions)


def turned_by(known: MarkOffsets, measured: MarkOffsets, turns: IntArray
              ) -> tuple[int, str]:
    """
    Return by how many marks the measured geometry is turned against the known one, and ''.

    Of the possible `turns` (k,) in marks one has to be clear. Else the text says why none is.

    >>> known = MarkOffsets(np.array([0.02, 0.0, -0.02]), np.full(3, 1e-4), 50)
    >>> measured = MarkOffsets(np.array([0.0, -0.02, 0.02]), np.full(3, 2e-4), 5)
    >>> turned_by(known, measured, np.arange(3))
    (1, '')
    """
    if known.angles.size != measured.angles.size:  # some came off, or are never seen
        return 0, 'the pulses show other marks than those known'
    every = [turned(known, int(turn)) for turn in turns]
    angles = np.array([item.angles for item in every])
    variance = measured.standard_errors**2 + np.array([item.standard_errors for item in every])**2
    off = np.sum((measured.angles - angles)**2 / np.maximum(variance, 1e-300), axis=1)
    best = int(np.argmin(off))
    # Turns by which the pattern repeats itself are the same.
    apart = (angles - angles[best])**2 / np.maximum(variance + variance[best], 1e-300)
    other = apart.sum(axis=1) > known.angles.size + _CLEAR
    if not matches(known, measured, int(turns[best])):
        return 0, 'the pulses show other marks than those known'
    if np.any(other & (off < off[best] + _CLEAR)):
        return 0, 'the pulses do not show which mark is which: their errors hide the pattern'
    return int(turns[best]), ''


def turned(geometry: MarkOffsets, turn: int) -> MarkOffsets:
    """Return the geometry whose mark 0 is number `turn` of this one."""
    return replace(geometry, angles=np.roll(geometry.angles, -turn),
                   standard_errors=np.roll(geometry.standard_errors, -turn))


def matches(known: MarkOffsets, measured: MarkOffsets, turn: int = 0) -> bool:
    """Return whether the measured angles are the known ones, turned by so many marks."""
    if known.angles.size != measured.angles.size:
        return False
    known = turned(known, turn)
    variance = (measured.standard_errors**2 + known.standard_errors**2
                + _ALIKE**2 * np.mean(known.angles**2))
    off = (measured.angles - known.angles)**2 / np.maximum(variance, 1e-300)
    return bool(np.mean(off) <= _OTHER)


def _over_revolution(values: FloatArray, count: int) -> FloatArray:
    """Return the mean over a revolution on either side, to which no pattern contributes."""
    room = min(2 * count, values.size - 1)
    padded = np.pad(values, room, mode='reflect', reflect_type='odd')  # the speed goes on
    once = uniform_filter1d(padded, count, mode='nearest')
    twice = uniform_filter1d(once, count, mode='nearest', origin=-1 if count % 2 == 0 else 0)
    return np.asarray(twice[room:room + values.size])


def _clipped(table: FloatArray) -> FloatArray:
    """Return the table (revolution, mark) with NaN in the place of outliers."""
    off = np.abs(table - np.nanmedian(table, axis=0))
    spread = OF_MEDIAN * float(np.nanmedian(off))
    return np.where(off <= max(_CLIPPED * spread, 1e-12), table, np.nan)


def _standard_errors(table: FloatArray) -> FloatArray:
    """Return the standard errors (mark,) of the means over revolutions, by blocks of them."""
    size = _BLOCK if len(table) >= 2 * _BLOCK else 1
    blocks = len(table) // size
    seen = np.isfinite(table[:blocks * size]).reshape(blocks, size, -1)
    off = np.where(np.isfinite(table), table - np.nanmean(table, axis=0), 0.0)
    sums = off[:blocks * size].reshape(blocks, size, -1).sum(axis=1)
    own = np.sum(sums**2, axis=0) / np.maximum(seen.sum(axis=(0, 1)), 1)**2
    own *= blocks / (blocks - 1.0)
    return np.asarray(np.sqrt((blocks * own + _OF_ALL * own.mean()) / (blocks + _OF_ALL)))
