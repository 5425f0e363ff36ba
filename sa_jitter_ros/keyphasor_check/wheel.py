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
The pattern of a target: teeth in a revolution, which are missing, and how uneven the others are.

A target of N teeth repeats after N numbers: the same numbers modulo N have no pulse, and the same
pulses stand beside their places. Every N is compared with the even target by the likelihood of
both, with a penalty for the number of its parameters (Schwarz 1978). An even target without gaps
has no pattern: pulses alone do not show how many of its marks make a revolution. A pattern that
repeats may also be a ripple of the speed with the revolution.
"""

from dataclasses import dataclass
import math

import numpy as np
from sa_jitter_ros.arrays import BoolArray, FloatArray, IntArray
from sa_jitter_ros.keyphasor_check.clock import find_clock
from sa_jitter_ros.keyphasor_check.teeth import NumberedPulses
from sa_jitter_ros.pulses.target import index_of
from scipy.ndimage import convolve1d

_MOST_TEETH = 1200
_FEWEST_REVOLUTIONS = 4
_MOST_PULSES = 60_000
# A tooth is missing if it has a pulse in fewer of the revolutions; strays fall into gaps, too.
_MISSING = 0.3
_ALWAYS = 0.98  # share of revolutions in which a missing tooth has no pulse
_LOST = 0.4  # at most so many of the present teeth have no pulse
_MOSTLY = 0.67  # at most so many teeth are missing
# Likelihoods hold for independent errors; those of pulses and speeds are not.
_TEMPER = 0.3
_CLEAR, _MOST_PATTERNS = 3.0, 4
_STEPS = 16  # parts of a recording, in which a pattern is compared
# What neighbours share is the motion: weights of the pulses around one.
_AROUND = np.bartlett(43)[1:-1] / 21.0
_ROUNDED = 0.25  # mean distance of times from the middle of their ticks, in ticks


@dataclass(frozen=True)
class Marking:
    """
    A target of `teeth` positions.

    `missing` (teeth,) are those without a tooth, tooth 0 the first behind the widest gap. `marks`
    (present,) in teeth are how late each mark is, with mean 0, and `errors` (present,) their
    standard errors. `origin` is a number of `NumberedPulses` that tooth 0 has. `evidence` is the
    logarithm of the likelihood over that of an even target, less the penalty.
    """

    teeth: int
    missing: BoolArray
    marks: FloatArray
    errors: FloatArray
    origin: int
    evidence: float

    @property
    def present(self) -> int:
        """Return the number of marks."""
        return int(np.count_nonzero(~self.missing))

    def tooth(self, numbers: IntArray) -> IntArray:
        """Return the tooth of each number."""
        return np.asarray((numbers - self.origin) % self.teeth)

    def late(self) -> FloatArray:
        """Return how late each tooth is (teeth,), 0 where it is missing."""
        full = np.zeros(self.teeth)
        full[~self.missing] = self.marks
        return full


def patterns(pulses: NumberedPulses) -> list[Marking]:
    """
    Return the patterns that the pulses support better than an even target, the best first.

    Only the first in a row of multiples is listed unless the multiple says more.
    """
    numbers, places = _longest(pulses)
    span = int(numbers[-1] - numbers[0]) + 1
    most = min(_MOST_TEETH, span // _FEWEST_REVOLUTIONS)
    ticks = find_clock(pulses.times).rate * float(np.median(pulses.pitch))
    places = places - convolve1d(places, _AROUND, mode='nearest')
    evidence = _Evidence(numbers, places, _ROUNDED / ticks if ticks else 0.0)
    even = evidence.of(1)
    gains = np.array([evidence.of(n) - even for n in range(2, most + 1)])
    found: list[Marking] = []
    for index in np.argsort(-gains):
        teeth, gain = int(index) + 2, float(gains[index])
        if gain <= _CLEAR or len(found) == _MOST_PATTERNS:
            break
        if not any(teeth % item.teeth == 0 for item in found) and (
                _keeps_step(numbers, places, teeth)):
            found.append(_once(pulses, pattern_of(pulses, teeth, gain)))
    return found


def _keeps_step(numbers: IntArray, places: FloatArray, teeth: int) -> bool:
    """
    Return whether pulses of these numbers, at these places (n,), repeat with a target of `teeth`.

    A swing of the speed nearly repeats after some pulses, too, but falls out of step in time.
    """
    classes = numbers % teeth
    mean = np.bincount(classes, places, teeth) / np.maximum(np.bincount(classes, None, teeth), 1)
    strongest = 1 + int(np.argmax(np.abs(np.fft.rfft(mean)[1:])))
    swing = places * np.exp(-2j * np.pi * strongest / teeth * numbers)
    part = (numbers - numbers[0]) * _STEPS // (int(numbers[-1] - numbers[0]) + 1)
    sums = np.bincount(part, swing.real, _STEPS) + 1j * np.bincount(part, swing.imag, _STEPS)
    power = np.abs(np.fft.fft(sums * np.hanning(_STEPS + 2)[1:-1], 8 * _STEPS)) ** 2
    return bool(_TEMPER * (power.max() - power[0]) <= _CLEAR * np.median(power) / math.log(2.0))


def _once(pulses: NumberedPulses, pattern: Marking) -> Marking:
    """
    Return the pattern of a wheel whose gaps repeat as one of a single repetition.

    The speed of an engine repeats after two revolutions, its wheel after one.
    """
    for teeth in range(2, pattern.teeth if pattern.missing.any() else 0):
        if pattern.teeth % teeth == 0 and np.array_equal(
                np.tile(pattern.missing[:teeth], pattern.teeth // teeth), pattern.missing):
            return pattern_of(pulses, teeth, pattern.evidence)
    return pattern


def pattern_of(pulses: NumberedPulses, teeth: int, evidence: float = 0.0) -> Marking:
    """Return the pattern of a target of so many teeth, the errors of its marks not known yet."""
    numbers, places = _longest(pulses)
    classes = numbers % teeth
    seen, span = _seen_of(numbers, teeth)
    missing = _missing(seen, span) | (seen == 0)
    origin = _index(missing)
    missing = np.roll(missing, -origin)
    late = np.array([np.median(places[classes == (tooth + origin) % teeth])
                     for tooth in np.flatnonzero(~missing)])
    # Where teeth are missing, those that are there need not have the mean place 0.
    return Marking(teeth, missing, late - late.mean(), np.full(late.size, np.nan), origin,
                   evidence)


def _longest(pulses: NumberedPulses) -> tuple[IntArray, FloatArray]:
    """Return numbers and places of the longest part without a standstill, of a bounded length."""
    part = max(pulses.unbroken(), key=lambda part: part.times.size)
    return part.numbers[:_MOST_PULSES], part.places[:_MOST_PULSES]


def _index(missing: BoolArray) -> int:
    """Return the first tooth behind the widest gap."""
    there = np.flatnonzero(~missing)
    if there.size in (0, missing.size):
        return 0
    return int(there[index_of(np.diff(np.append(there, there[0] + missing.size)))])


def _seen_of(numbers: IntArray, teeth: int) -> tuple[IntArray, IntArray]:
    """Return the pulses of each tooth of a target (teeth,), and the revolutions that it made."""
    turns, rest = divmod(int(numbers[-1] - numbers[0]) + 1, teeth)
    span = np.full(teeth, turns)
    span[(numbers[0] + np.arange(rest)) % teeth] += 1
    return np.bincount(numbers % teeth, minlength=teeth), span


def _missing(seen: IntArray, span: IntArray) -> BoolArray:
    share = seen / np.maximum(span, 1)
    if share.min() >= _MISSING * share.max():
        return np.zeros(seen.size, np.bool_)
    usual = float(np.quantile(share, 0.75))
    missing = share < _MISSING * usual
    if usual < 1.0 - _LOST or np.mean(missing) > _MOSTLY:
        return np.zeros(seen.size, np.bool_)
    return np.asarray(missing)


class _Evidence:
    """
    What pulses with these numbers, at these places (n,) in teeth, say for numbers of teeth.

    A scatter below the one that is `rounding` tells nothing: ticks of a clock repeat, too.
    """

    def __init__(self, numbers: IntArray, places: FloatArray, rounding: float) -> None:
        self._numbers, self._places = numbers, places
        self._rounding = max(rounding, 1e-9)
        self._even = self._scatter(places - np.median(places))

    def of(self, teeth: int) -> float:
        """
        Return the log likelihood of a target of so many teeth, less half a log n a value.

        Of the places it is that over the one of even teeth, for the pulses on the target alone.
        """
        classes = self._numbers % teeth
        seen, span = _seen_of(self._numbers, teeth)
        missing = _missing(seen, span)
        gaps, place, even = int(np.count_nonzero(missing)), self._places, self._even
        absent = unexpected = 0
        if gaps:
            absent, unexpected = int((span - seen)[missing].sum()), int(seen[missing].sum())
            kept = ~missing[classes]
            classes, place = classes[kept], place[kept]
            even = self._scatter(place - np.median(place))
        count = place.size
        lost = float(int(span.sum()) - self._numbers.size - absent)
        positions = lost + count
        share = min(max(lost / positions, 0.5 / positions), 0.5)
        occupancy = (lost * math.log(share) + count * math.log1p(-share)
                     + absent * math.log(_ALWAYS) + unexpected * math.log(1.0 - _ALWAYS))
        mean = np.bincount(classes, place, teeth) / np.maximum(seen, 1)
        # Least absolute deviations: strays that pass for pulses say little.
        uneven = self._scatter(place - mean[classes])
        # Gaps need not have uneven teeth between them. Pulses in them are in neither scatter: a
        # stray far from its place would speak for any gap.
        penalty = 0.5 * math.log(count)
        return _TEMPER * occupancy - 2.0 * penalty * gaps + max(
            0.0, _TEMPER * count * (even - uneven) - penalty * (teeth - gaps - 1))

    def _scatter(self, away: FloatArray) -> float:
        """Return the logarithm of the mean distance of pulses (n,) from their places, in teeth."""
        return math.log(max(float(np.abs(away).mean()), self._rounding))
