"""
Targets: where the teeth of a keyphasor's wheel are, and how pulses are matched to them.

An even target gives equal angles between pulses. A toothed wheel lacks some teeth (60-2, 36-1,
36-2-1); its index is the tooth after the widest gap. Both look at the latest pulses and say, once
these fit, which tooth each belongs to.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt
from sa_jitter_ros.errors import ParameterError
from scipy.ndimage import median_filter

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

# A pulse sooner than this part of the expected interval is a second pulse of the same tooth.
DOUBLE = 0.5
# Teeth next to a gap stand out of place by up to 2 degrees, a fifth of a tooth of 36. The gap
# itself must not pass for one that is a tooth wider or narrower.
_BESIDE_GAP = 0.45
_ACROSS_GAP = 0.9  # teeth


@dataclass(frozen=True)
class Lock:
    """
    How the latest pulses fit a target, from pulse number `first` on, which is tooth `slot`.

    For every tooth present (m,), counted from the index: `steps` to the next one in teeth, `teeth`
    its number, and the `tolerance` of the interval behind it, in parts of that interval.
    `interval` (s) is the expected time from tooth to tooth.
    """

    first: int
    slot: int
    interval: float
    steps: IntArray
    teeth: IntArray
    tolerance: FloatArray

    @property
    def even(self) -> bool:
        """Whether all teeth are alike, so that none can be lost."""
        return self.steps.size == 1


class Target(Protocol):
    """What the pulse validator needs to know of a target."""

    memory: int

    def lock(self, pulses: Sequence[float]) -> Lock | None:
        """Match the latest pulses (s), None if they do not fit (yet)."""


class EvenTarget:
    """Equal angles: two intervals in a row that agree, double pulses left out, are a lock."""

    memory = 8

    def __init__(self, *, tolerance: float) -> None:
        self._tolerance = tolerance

    def lock(self, pulses: Sequence[float]) -> Lock | None:
        """Match the latest pulses (s), None if they do not fit (yet)."""
        if len(pulses) < 3:
            return None
        # The latest pulse is a good one if anything fits; the one before may be a double.
        for before in pulses[-2], pulses[-3]:
            if self._agrees(pulses, pulses[-1] - before):
                one = np.ones(1, dtype=np.int64)
                return Lock(first=0, slot=0, interval=pulses[-1] - before, steps=one,
                            teeth=one - 1, tolerance=np.full(1, self._tolerance))
        return None

    def _agrees(self, pulses: Sequence[float], interval: float) -> bool:
        agreeing, last = 0, pulses[0]
        for pulse in pulses[1:]:
            if pulse - last >= DOUBLE * interval:
                near = abs(pulse - last - interval) <= self._tolerance * interval
                agreeing = agreeing + 1 if near else 0
                last = pulse
        return agreeing >= 2


class ToothedWheel:
    """
    A wheel of `teeth` teeth (those missing counted) of which `missing` are left out.

    Where the gaps are is learnt from one revolution. Several gaps have one index if the widest, or
    what stands in front of it, is unique; else the index may change whenever the wheel is lost.
    """

    def __init__(self, *, teeth: int, missing: int, tolerance: float) -> None:
        self._teeth, self._present = teeth, teeth - missing
        if self._present < 2:
            raise ParameterError(
                f'missing_teeth {missing} of {teeth} leave {self._present}: a wheel needs 2 or '
                'more; a single tooth is pulses_per_revolution 1')
        self._tolerance = tolerance
        self.memory = 2 * (self._present + 1)

    def lock(self, pulses: Sequence[float]) -> Lock | None:
        """Match the latest pulses (s), None if they do not fit (yet): one revolution is needed."""
        if len(pulses) <= self._present:
            return None
        every = np.asarray(pulses)
        intervals = np.diff(every)
        single = np.append(0, 1 + np.flatnonzero(intervals >= DOUBLE * np.median(intervals)))
        if single.size <= self._present:
            return None
        single = single[-self._present - 1:]
        intervals = np.diff(every[single])
        # An even speed gives the tooth interval from the revolution, a changing one from its
        # neighbours, which needs gaps to be rare.
        guesses = [np.full(intervals.size, intervals.sum() / self._teeth)]
        if self._present >= 8:
            guesses.append(median_filter(intervals, size=5, mode='mirror'))
        for guess in guesses:
            steps = np.maximum(np.rint(intervals / guess), 1.0).astype(np.int64)
            if steps.sum() == self._teeth:
                index = max(range(steps.size), key=lambda k: tuple(np.roll(steps, -k)[::-1]))
                steps = np.roll(steps, -index)
                tolerance = self._tolerances(steps)
                error = np.abs(np.roll(intervals / guess, -index) / steps - 1.0)
                if np.all(error <= tolerance):
                    return Lock(first=int(single[0]), slot=-index % steps.size,
                                interval=float(guess[0]), steps=steps,
                                teeth=np.cumsum(steps) - steps, tolerance=tolerance)
        return None

    def _tolerances(self, steps: IntArray) -> FloatArray:
        gap = steps > 1
        beside = np.roll(gap, 1) | np.roll(gap, -1)
        tolerance = np.where(beside, max(self._tolerance, _BESIDE_GAP), self._tolerance)
        return np.where(gap, np.minimum(_BESIDE_GAP, _ACROSS_GAP / steps), tolerance)
