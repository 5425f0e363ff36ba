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
One continuous angle from the samples of a position or counter, in runs.

What the shaft turns from one sample to the next is learnt from the samples before. A step that
does not fit is a wrap, a glitch of few samples, another speed, or the begin of a new run.
"""

import math
from typing import NamedTuple

import numpy as np
from sa_jitter_ros.arrays import FloatArray

_BLOCK = 16  # steps from which those of the next block are judged
_LONGEST = 4  # samples of a glitch
_DRIFT = 3.0  # times what is usual, by which the samples after a glitch may be off
_FEWEST = 3  # steps that show a speed
_CHUNK = 1 << 13  # samples that are judged at once
_GAP = 6.0  # usual intervals of samples without a sample
_SHARE = 0.9  # of the usual step, by which a step may differ from it
_DEVIATIONS = 10.0  # median absolute deviations of the steps, likewise
_QUANTA = 1.1  # steps of the resolution, likewise
_SLOW = 0.5  # counts a sample; a slower counter stands between its counts
_LEAST = 1e-3  # of a turn, likewise
_OF_MODULUS = 1.0 / 12.0  # more is not told from a step in the other direction
_TICK = 0.15  # of a turn, that a standing angle may move at once
_TICKS = 3.0  # times the latest tick, likewise
#: of the registers that overflow
BITS = 8, 16, 32
_BELOW = 0.0, 0.5, 1.0  # shares of their ranges that may lie below 0
_ALIKE, _NEARLY_ALL = 0.02, 0.9  # of a count; share of the steps that are whole counts


class Piece(NamedTuple):
    """Samples of a run, whose `angle` is continuous; `begins` a run or continues the last one."""

    begins: bool
    time: FloatArray
    angle: FloatArray


class AngleRuns:
    """
    Make a sampled angle continuous, in blocks of any size.

    :param turn: the angle of a revolution, in the unit of the samples.
    :param moduli: the angles after which the samples may wrap, also by several of them at once.
    :param registers: ranges of counters that may overflow, one at a time.
    :param counts: the samples are whole counts.

    `glitches` counts samples that were bridged, `jumps` the runs that began because the angle
    jumped by what is no wrap, `gaps` those after lost samples.

    >>> runs = AngleRuns(100.0, registers=(100.0,), counts=True)
    >>> value = np.arange(0.0, 300.0, 7.0) % 100.0
    >>> value[20] = 0.0
    >>> [piece] = runs.update(np.arange(43.0), value, ends=True)
    >>> float(piece.angle[-1]), piece.angle.size, runs.glitches
    (294.0, 42, 1)
    """

    def __init__(self, turn: float, *, moduli: tuple[float, ...] = (),
                 registers: tuple[float, ...] = (), counts: bool = False) -> None:
        self.glitches = self.jumps = self.gaps = 0
        self.turn, self._quantum = turn, 1.0 if counts else 0.0
        self._moduli, self._registers = moduli, registers
        self._tick = 0.0  # the latest step of an angle that stands between its steps
        self._time, self._value = np.empty(0), np.empty(0)
        self._forget(0)

    def _forget(self, kept: int) -> None:
        """Forget the samples before `kept`: the next one begins a run."""
        # From two whole blocks before those that are not decided on.
        self._time, self._value = self._time[kept:], self._value[kept:]
        self._decided = 0  # of them
        # Step a sample, how far others may be from it, and interval (s) of whole blocks of them.
        self._blocks = np.empty((0, 3))
        self._angle = math.nan  # of the latest sample that is decided

    def update(self, time: FloatArray, value: FloatArray, *, ends: bool = False) -> list[Piece]:
        """Take samples in order of time, `ends` if none follow; return those that are decided."""
        found: list[Piece] = []
        for first in range(0, max(time.size, 1), _CHUNK):
            part = slice(first, first + _CHUNK)
            self._time = np.concatenate((self._time, time[part]))
            self._value = np.concatenate((self._value, value[part]))
            last = first + _CHUNK >= time.size
            while self._decide(found, ends=ends and last):
                pass
        if ends:
            self._forget(self._time.size)
        return found

    # --- what is usual ---

    def _usual(self, steps: FloatArray, spans: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return step and tolerance of blocks (block, step); `spans` are in usual intervals."""
        each = steps / spans
        step, deviation = _centre(each)
        for modulus in (*self._moduli, *self._registers):
            wrapped = (steps - modulus * np.rint(steps / modulus)) / spans
            new = _centre(wrapped)
            better = new[1] < 0.5 * deviation - 1e-9 * self.turn
            step, deviation = np.where(better, new, (step, deviation))
            each = np.where(better[:, None], wrapped, each)
        least = min((*self._moduli, *self._registers), default=np.inf)
        share = np.minimum(_SHARE * np.abs(step), _OF_MODULUS * least)
        size = np.abs(steps)
        quantum = np.min(np.where(size > 0.0, size, np.inf), axis=1)
        few = np.any(size == 0.0, axis=1) & (quantum <= _TICK * min(self.turn, least))
        quantum = np.maximum(np.where(few, quantum, 0.0), self._quantum)
        floor = np.maximum(_QUANTA * quantum, _LEAST * self.turn)
        tolerance = np.maximum(share, floor) + _DEVIATIONS * deviation
        near = np.abs(each - step[:, None]) <= tolerance[:, None]  # half of them at least
        return np.mean(each, axis=1, where=near), tolerance

    def _learn(self, *, ends: bool) -> None:
        """Learn what is usual from the blocks that are whole, or from what there is at the end."""
        known, size, whole = len(self._blocks), _BLOCK, (self._time.size - 1) // _BLOCK
        if ends and self._time.size > 1 and not whole:
            size, whole = self._time.size - 1, 1
        if whole > known:
            table, length = (np.diff(each[known * size:whole * size + 1]).reshape(-1, size)
                             for each in (self._value, self._time))
            interval = np.median(length, axis=1)
            usual = self._usual(table, np.maximum(length / interval[:, None], 1.0))
            self._blocks = np.vstack((self._blocks, np.transpose((*usual, interval))))

    # --- what is decided ---

    def _decide(self, found: list[Piece], *, ends: bool) -> bool:
        """Decide on samples; whether a gap ended the run, and others follow it."""
        self._learn(ends=ends)
        count, decided = self._time.size, self._decided
        if not count or (not ends and count <= (decided or 2 * _BLOCK)):
            return False
        steps = _Steps(self._time, self._value, self._blocks)
        gaps = np.flatnonzero(steps.gap[decided:]) + decided
        end = int(gaps[0]) if gaps.size else count
        decided = self._judge(steps, end, ends=ends or end < count)
        self._emit(found, steps, decided)
        if end < count:
            self.gaps += 1
            self._forget(end)
            return True
        block = max((decided - 1) // _BLOCK - 2, 0)
        self._time, self._value = (each[block * _BLOCK:] for each in (self._time, self._value))
        self._blocks, self._decided = self._blocks[block:], decided - block * _BLOCK
        return False

    def _near(self, step: FloatArray, expected: FloatArray, before: FloatArray,
              after: FloatArray) -> FloatArray:
        """Return the steps without the wraps that bring them nearer to what is expected."""
        best = step
        low, high = np.minimum(before, after), np.maximum(before, after)
        for modulus in self._moduli:
            turns = np.rint((step - expected) / modulus)
            if np.any(turns):
                other = step - modulus * turns
                best = np.where(np.abs(other - expected) < np.abs(best - expected), other, best)
        for modulus in self._registers:
            other = step - np.copysign(modulus, step - expected)
            inside = np.any([(low >= -share * modulus) & (high <= (1.0 - share) * modulus)
                             for share in _BELOW], axis=0)
            best = np.where(inside & (np.abs(other - expected) < np.abs(best - expected)),
                            other, best)
        return best

    def _judge(self, steps: '_Steps', end: int, *, ends: bool) -> int:
        """Judge the samples before `end`; return how many are decided."""
        value = self._value
        steps.taken[1:] = self._near(steps.raw[1:], steps.expected[1:], value[:-1], value[1:])
        usual = np.abs(steps.taken - steps.expected) <= steps.limit
        usual[0] = True
        lone = np.zeros(usual.size, bool)
        if self._quantum:  # one sample beside a count that stands for long
            lone[:-1] = (steps.taken[:-1] != 0.0) & (steps.taken[1:] == -steps.taken[:-1]) & (
                np.abs(steps.expected[:-1]) < _SLOW)
            lone[end - 1] = not ends and bool(steps.taken[end - 1])
            usual &= ~lone
        done = self._decided
        for i in (np.flatnonzero(~usual[done:end]) + done).tolist():
            if i < done:
                continue
            if not ends and i + _BLOCK >= end:
                return int(i)
            if lone[i]:
                self._bridge(steps, i, i + 1)
                steps.taken[i + 1], done = 0.0, i + 2
            else:
                done = self._resolve(steps, i, end, ends=ends)
        return end

    def _resolve(self, steps: '_Steps', i: int, end: int, *, ends: bool) -> int:
        """Decide on sample `i`, whose step is not usual; return the next one to look at."""
        value, span = self._value, steps.span
        speeds, tolerances = [], []
        for side in (slice(max(i - _BLOCK, 1), i), slice(i + 1, min(i + 1 + _BLOCK, end))):
            if side.stop - side.start < _FEWEST:
                continue
            (speed,), (limit,) = self._usual(steps.raw[None, side], span[None, side])
            here = slice(i, i + 1)
            taken = self._near(steps.raw[here], speed * span[here], value[i - 1:i], value[here])
            if abs(taken[0] - speed * span[i]) <= limit * span[i]:
                steps.taken[here] = taken
                return i + 1
            speeds.append(speed)
            tolerances.append(limit)
        speed = float(np.mean(speeds)) if speeds else steps.expected[i] / span[i]
        tolerance = min(tolerances, default=steps.limit[i] / span[i])
        stands = max(map(abs, speeds), default=0.0) <= _LEAST * self.turn
        follow = np.arange(i, min(i + 1 + 2 * _LONGEST, end))
        spans = np.cumsum(span[follow])
        expected = speed * spans
        before = np.full(follow.size, value[i - 1])
        taken = self._near(value[follow] - before, expected, before, value[follow])
        beside = taken - expected
        middle = float(np.median(beside[1:])) if follow.size > 1 else math.inf
        if abs(middle) <= _DRIFT * tolerance:  # those that follow are where they would be
            back = int(np.argmax(np.abs(beside - middle) <= tolerance))
            if back <= _LONGEST:
                self._bridge(steps, i, i + back)
                steps.taken[i + back] = taken[back]
                return i + back + 1
        if not self._decided and i <= _LONGEST:  # the first samples are the glitch
            self._bridge(steps, 0, i)
            return i + 1
        moved, further = abs(steps.taken[i]), (1.0 + _LONGEST) * tolerance
        if stands:
            tick, self._tick = self._tick, moved
            further = max(_TICK * self.turn, _TICKS * tick)
        if abs(steps.taken[i] - speed * span[i]) <= further:  # as after a glitch that is not seen
            return i + 1
        if ends and end - i <= _LONGEST:
            self._bridge(steps, i, end)
            return end
        modulus = self._register(steps, i)
        if modulus:
            self._moduli = (*self._moduli, modulus)
            steps.taken[i] = steps.raw[i] - math.copysign(modulus, steps.raw[i])
        else:
            steps.begins[i] = True
            self.jumps += 1
        return i + 1

    def _bridge(self, steps: '_Steps', first: int, end: int) -> None:
        self.glitches += end - first
        steps.kept[first:end] = False

    def _register(self, steps: '_Steps', i: int) -> float:
        """Return the range of a counter behind the angle, if its overflow explains step `i`."""
        if self._quantum:
            return 0.0
        jump = abs(steps.raw[i] - steps.expected[i])
        near = np.concatenate((steps.raw[max(i - _BLOCK, 1):i], steps.raw[i + 1:i + _BLOCK]))
        near = near[near != 0.0]
        for bits in BITS:
            counts = round(2.0**bits * self.turn / jump)  # of a turn
            if counts < 2:
                continue
            modulus = 2.0**bits * self.turn / counts
            whole = near * counts / self.turn
            if near.size >= _FEWEST and abs(modulus - jump) <= steps.limit[i] and (
                    np.mean(np.abs(whole - np.rint(whole)) < _ALIKE) > _NEARLY_ALL):
                return float(modulus)
        return 0.0

    def _emit(self, found: list[Piece], steps: '_Steps', decided: int) -> None:
        """Add the samples that are decided now to what was found."""
        new = np.arange(self._decided, decided)
        new = new[steps.kept[new]]
        if not new.size:
            return
        begins = np.flatnonzero(steps.begins[new])
        for part in np.split(new, begins[begins > 0]):
            fresh = bool(steps.begins[part[0]]) or math.isnan(self._angle)
            step = steps.taken[part]
            step[0] = self._value[part[0]] if fresh else self._angle + step[0]
            angle = np.cumsum(step)
            self._angle = float(angle[-1])
            found.append(Piece(fresh, self._time[part], angle))


class _Steps:
    """The steps of a block of samples and what is decided on them; the first is none."""

    def __init__(self, time: FloatArray, value: FloatArray, blocks: FloatArray) -> None:
        count = value.size
        self.raw = np.diff(value, prepend=value[:1])
        self.taken = self.raw.copy()  # without wraps
        self.kept, self.begins = np.ones(count, bool), np.zeros(count, bool)
        self.span, self.gap = np.ones(count), np.zeros(count, bool)
        self.expected, self.limit = np.zeros(count), np.full(count, np.inf)
        if not len(blocks):
            return
        # Those of a block are judged by the block before, those of the first one by itself.
        place = np.minimum(np.maximum((np.arange(count) - 1) // _BLOCK - 1, 0), len(blocks) - 1)
        step, limit, interval = blocks[place].T
        intervals = np.diff(time, prepend=time[:1])
        self.gap = intervals > _GAP * interval
        self.span = np.maximum(intervals / interval, 1.0)
        self.expected, self.limit = step * self.span, limit * self.span


def _centre(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return medians and median absolute deviations of rows."""
    middle = np.median(values, axis=1)
    return middle, np.median(np.abs(values - middle[:, None]), axis=1)
