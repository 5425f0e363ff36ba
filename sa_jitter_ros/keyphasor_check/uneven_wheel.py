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
Numbering of pulses whose marks stand so unevenly that no tooth is the unit of their angles.

A wheel with an extra mark as index, or with marks at any angles, repeats its intervals after a
revolution, whatever they are. The longest stretch that does so shows the angles, and the search
that validates pulses for averages then tells which mark each pulse is.
"""

import numpy as np
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.keyphasor_check.teeth import ACROSS, NumberedPulses
from sa_jitter_ros.pulses.pulse_follower import JudgeOptions
from sa_jitter_ros.pulses.pulse_judge import PulseJudge
from sa_jitter_ros.pulses.target import ToothedWheel
from sa_jitter_ros.pulses.target_geometry import motion_of
from sa_jitter_ros.pulses.trigger_counter import TriggerCounter
from sa_jitter_ros.pulses.verdicts import Verdicts

MOST_MARKS = 150  # of a revolution
_FEWEST_MARKS = 3
_FEWEST_REVOLUTIONS, _CLEAN = 4, 2  # and those without a stray or a gap that show the angles
_MOST_PULSES = 20_000  # that show the angles
_LONGER = 1.2  # times as long must more marks repeat: multiples do, too
_ALIKE = 0.15  # of an interval: shares of two revolutions that differ by less repeat
_TOLERANCE = 0.25  # of an interval, by which teeth are uneven


class _Numbers(TriggerCounter):
    """Takes the pulses that a trigger counter takes, and keeps their times and numbers alone."""

    def __init__(self, marks: int) -> None:
        super().__init__(teeth=1, teeth_per_trigger=1)
        self._marks = marks
        self.times: list[float] = []
        self.numbers: list[int] = []
        self.breaks: list[int] = []

    def begin(self, time: float, tooth: int, *, passed: int | None = None) -> None:
        """Begin a run; where the marks in front of it are not known, the count begins anew."""
        last = self.numbers[-1] if self.numbers else 0
        if self.numbers and passed is None:
            self.breaks.append(len(self.numbers))
            passed = ACROSS + (tooth - last - ACROSS) % self._marks
        self.times.append(time)
        self.numbers.append(tooth if passed is None else last + passed)

    def extend(self, times: list[float], steps: list[int]) -> None:
        """Add pulses to the run."""
        self.times += times
        self.numbers += (self.numbers[-1] + np.cumsum(steps)).tolist()


def number_marks(times: FloatArray) -> NumberedPulses | None:
    """
    Return pulses (n,) in s numbered by mark, None if no revolutions repeat.

    Where the wider angles are multiples of the others, teeth are missing, and count.

    >>> turns = np.array([0.0, 0.1, 0.25, 0.5, 0.75]) + np.arange(12)[:, None]
    >>> found = number_marks(np.delete(turns.ravel() / 10.0, 22))
    >>> (found.numbers - found.numbers[0])[19:25].tolist()
    [19, 20, 21, 23, 24, 25]
    """
    shares, start, stop, marks = _repeating(times[:_MOST_PULSES])
    if not marks or stop - start < _CLEAN * marks:
        return None
    turns = shares[start:stop - (stop - start) % marks].reshape(-1, marks)
    widths = np.exp(np.median(turns, axis=0))
    target = ToothedWheel(teeth=marks, tolerance=_ALIKE, widths=widths * marks / widths.sum())
    found = _Numbers(marks)
    judge = PulseJudge(target, found, JudgeOptions(
        bridge=True, tolerance=0.0, maximum_missing=3, minimum_interval=0.0,
        pulses_per_trigger=marks), Verdicts())
    judge.take(times.tolist())
    judge.flush()
    if len(found.numbers) < _FEWEST_REVOLUTIONS * marks:
        return None
    accepted, numbers = np.array(found.times), np.array(found.numbers)
    steps = np.maximum(np.rint(widths / np.median(widths)), 1.0).astype(np.int64)
    if np.all(np.abs(widths / np.median(widths) - steps) < _TOLERANCE):  # teeth, some missing
        numbers = numbers // marks * steps.sum() + (np.cumsum(steps) - steps)[numbers % marks]
        marks = int(steps.sum())
    place = numbers - numbers[0]
    own, pitch = (each[place] for each in motion_of(accepted, place, marks))
    return NumberedPulses(accepted, numbers, (accepted - own) / pitch, pitch,
                          np.setdiff1d(times, accepted), np.array(found.breaks, np.int64))


def _repeating(times: FloatArray) -> tuple[FloatArray, int, int, int]:
    """
    Return the logarithms of the intervals (n - 1,) of pulses (n,) in s, and which repeat longest.

    They are shares of the revolution around them. The intervals from the second to the third
    result repeat after so many as the fourth one says: 0 if there are too few.
    """
    levels = np.log(np.diff(times))
    best = levels, 0, 0, 0
    for marks in range(_FEWEST_MARKS, min(MOST_MARKS, levels.size // _FEWEST_REVOLUTIONS) + 1):
        turns = times[marks:] - times[:-marks]
        around = np.clip(np.arange(levels.size) - marks // 2, 0, turns.size - 1)
        shares = levels - np.log(turns[around])
        alike = np.abs(shares[marks:] - shares[:-marks]) < _ALIKE
        edges = np.flatnonzero(np.diff(np.concatenate(([0], alike, [0]))))
        if edges.size:
            longest = 2 * int(np.argmax(edges[1::2] - edges[::2]))
            start, stop = int(edges[longest]), int(edges[longest + 1])
            if stop - start > _LONGER * (best[2] - best[1] - best[3]):
                best = shares, start, stop + marks, marks
    return best
