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
From the sampled angle of a shaft, of a joint or a counter, to the times of virtual marks.

The angle may wrap or not. Around the crossing of a mark, a parabola through six samples gives its
time; what they leave is the noise of stamps and the quantisation of the angle, from which the
error of the pulses follows. No crossing is interpolated over a gap, a stop or a reversal, or over
a jump of the angle; the few samples of a glitch are left out.
"""

from dataclasses import dataclass
import math
import warnings

import numpy as np
from numpy.typing import ArrayLike
from sa_jitter_ros.arrays import Array, FloatArray
from sa_jitter_ros.errors import DataWarning, ParameterError, SignalError
from sa_jitter_ros.parameters import number
from sa_jitter_ros.pulses.angle_runs import AngleRuns, BITS
from sa_jitter_ros.samples import check_samples

_TURN = 2.0 * math.pi
_OTHER_TURNS, _SIMILAR = (360.0, 1.0), 0.1  # of an angle that is not in rad; part of them
_BEFORE, _AFTER = 3, 3  # samples around a crossing
_KEPT = 32  # samples before the next crossing
# Within so many seconds a shaft that turns passes this part of the pitch of its marks.
_STOPPED, _PROGRESS = 1.0, 0.02
_SEEN = 0.1  # of the pitch, from which a run that ends has a direction
_STEPS = 512  # steps of the angle, from which its resolution follows
_MULTIPLE, _MOST = 0.02, 0.9  # of a step; share of the steps that are multiples of the resolution
_MEMORY = 0.98  # weight of the errors before, at each crossing
_DITHER = 1.5  # counts; less back is no reversal of a counter
_MOST_BEFORE = 1 << 14  # samples before the shaft turns
_MOST_AT_ONCE = 50_000_000  # pulses
_LEAST_MODULUS = 4.0  # counts; with fewer the direction cannot be told
_USUALLY = 0.9  # of the counts are within the range of a counter
_GRAY = 0.6  # of the steps of Gray code, below which those of the counts behind it are
_FASTEST = 1000.0  # turns a second of an angle in rad; more are doubtful
_EARLY = 0.01  # s, by which stamps may be early
_EXACT = 2.0 / np.finfo(np.float64).eps  # the largest count that is exact


@dataclass(frozen=True)
class AngleState:
    """
    Counts so far, and the errors of the latest pulses.

    `pulse_error_std` in s is the standard deviation of a pulse, made of `angle_resolution` in rad
    (0 if it is not seen) and of the rest, `stamp_noise_std` in s; NaN while unknown. `glitches`
    are samples that the shaft cannot have reached, which are left out. A run begins anew after
    `gaps`, and after jumps of the angle or of time: `restarts`.
    """

    samples: int
    dropped: int
    pulses: int
    gaps: int
    stops: int
    reversals: int
    restarts: int
    glitches: int
    pulse_error_std: float
    angle_resolution: float
    stamp_noise_std: float


class AngleCrossings:
    """
    Find when a sampled angle passes the marks of a virtual target, in blocks of any size.

    :param marks: number of marks on a revolution; one is at angle 0.
    :param time_tolerance: time (s) by which a sample may be early before a new run begins.
    :param runs: of the angle; those of an angle in rad if it is None.
    :param counted: the angle is a counter, and a pulse has the time of the sample that counts it.
    :raises ParameterError: an option is out of range.

    A shaft at 20 Hz, sampled at 1 kHz with 12 bits a revolution:

    >>> time = np.arange(1000) / 1e3
    >>> angle = np.rint(20.0 * time * 4096) / 4096 * 2.0 * np.pi % (2.0 * np.pi)
    >>> crossings = AngleCrossings()
    >>> pulses = crossings.update(time, angle)
    >>> pulses.size, bool(abs(pulses - np.arange(1, 20) / 20.0).max() < 1e-5)
    (19, True)
    >>> round(crossings.state.angle_resolution * 4096 / (2.0 * np.pi), 3)
    1.0
    """

    def __init__(self, *, marks: int = 1, time_tolerance: float = _EARLY,
                 runs: AngleRuns | None = None, counted: bool = False) -> None:
        if marks != int(marks) or marks < 1:
            raise ParameterError(f'marks {marks} must be a whole number, 1 or more')
        if not 0.0 <= time_tolerance < np.inf:
            raise ParameterError(f'time_tolerance {time_tolerance} s must be finite, from 0 on')
        self._runs = runs or AngleRuns(_TURN, moduli=(_TURN,))
        self._pitch = self._runs.turn / int(marks)
        self._counted = counted
        self._back = max(0.5 * self._pitch, _DITHER if counted else 0.0)  # of a reversal
        self._tolerance = time_tolerance
        self._samples = self._dropped = self._pulses = 0
        self._stops = self._reversals = self._restarts = 0
        self._latest = -math.inf  # time of the latest sample
        self._steps = np.empty(0)
        self._left = self._freedom = 0.0  # of the latest crossings
        self._leverage_slowness = np.zeros(2)
        self._begin()

    def _begin(self) -> None:
        """Forget the samples: the next one begins a run."""
        self._time, self._angle = np.empty(0), np.empty(0)  # of the run, continuous
        self._direction = 0
        self._next = 0  # number of the next mark, in the direction
        self._standing = False
        self._moved, self._place = math.inf, math.nan  # when and where it last moved on

    @property
    def state(self) -> AngleState:
        """Return the counts and errors so far."""
        resolution = self._resolution()
        error = noise = math.nan
        if self._freedom > 0.0:
            variance = self._left / self._freedom
            leverage, slowness = self._leverage_slowness.tolist()
            error = math.sqrt(variance * leverage)
            rounding = resolution * slowness / math.sqrt(12.0)
            noise = math.sqrt(max(variance - rounding**2, 0.0))
        runs = self._runs
        return AngleState(self._samples, self._dropped, self._pulses, runs.gaps, self._stops,
                          self._reversals, self._restarts + runs.jumps, runs.glitches, error,
                          resolution, noise)

    def update(self, times: ArrayLike, angles: ArrayLike) -> FloatArray:
        """
        Take the next samples (n,) in s and rad, and return new pulse times (s).

        Samples that are not finite, or not later than the one before, are dropped and counted.

        :raises SignalError: the arrays are not one-dimensional, of one length and real.
        """
        time, angle = np.atleast_1d(np.asarray(times)), np.atleast_1d(np.asarray(angles))
        if time.shape != angle.shape or time.ndim != 1 or (
                time.dtype.kind not in 'fiu' or angle.dtype.kind not in 'fiu'):
            raise SignalError(f'times of shape {time.shape} and angles of shape {angle.shape}: '
                              'give as many times as angles, in s and rad')
        time, angle = time.astype(np.float64), angle.astype(np.float64)
        good = np.isfinite(time) & np.isfinite(angle)
        self._samples += time.size
        self._dropped += int(np.count_nonzero(~good))
        time, angle = time[good], angle[good]
        found: list[FloatArray] = []
        while time.size:
            reached = np.maximum.accumulate(np.append(self._latest, time))[:-1]
            back = np.flatnonzero(time < reached - self._tolerance)
            stop = int(back[0]) if back.size else time.size
            later = time[:stop] > reached[:stop]
            self._dropped += int(np.count_nonzero(~later))
            self._take(time[:stop][later], angle[:stop][later], found, ends=back.size > 0)
            self._latest = max(self._latest, float(time[:stop].max(initial=-math.inf)))
            if back.size:
                self._restarts += 1
                self._latest = -math.inf
            time, angle = time[stop:], angle[stop:]
        return self._counted_pulses(found)

    def flush(self) -> FloatArray:
        """Return the pulse times (s) up to the last sample; the next one begins a run."""
        found: list[FloatArray] = []
        self._take(np.empty(0), np.empty(0), found, ends=True)
        self._latest = -math.inf
        return self._counted_pulses(found)

    def _counted_pulses(self, found: list[FloatArray]) -> FloatArray:
        pulses = np.concatenate(found) if found else np.empty(0)
        self._pulses += pulses.size
        return pulses

    def _take(self, time: FloatArray, angle: FloatArray, found: list[FloatArray], *, ends: bool
              ) -> None:
        """Take samples in order of time, `ends` if none follow in the run; add pulse times."""
        for piece in self._runs.update(time, angle, ends=ends):
            if piece.begins:
                found += self._crossings(ends=True)
                self._begin()
            size = self._angle.size
            self._time = np.concatenate((self._time, piece.time))
            self._angle = np.concatenate((self._angle, piece.angle))
            steps = np.abs(np.diff(self._angle[max(size - 1, 0):]))
            self._steps = np.concatenate((self._steps, steps[steps != 0.0]))[-_STEPS:]
            found += self._crossings()
        if ends:
            found += self._crossings(ends=True)
            self._begin()

    def _crossings(self, *, ends: bool = False) -> list[FloatArray]:
        """
        Return the pulse times of the marks that were passed; forget what is not needed.

        No sample follows those of a run that `ends`.
        """
        found: list[FloatArray] = []
        if not self._angle.size:
            return found
        if not self._direction:
            moved = self._angle - self._angle[0]
            if np.max(np.abs(moved)) < (_SEEN if ends else 0.5) * self._pitch:
                self._thin(moved)
                return found
            self._set_direction(1 if moved[np.argmax(np.abs(moved))] > 0.0 else -1)
        while True:
            turned = self._direction * self._angle
            reached = np.maximum.accumulate(turned)
            back = np.flatnonzero(reached - turned > self._back)
            stop = int(back[0]) if back.size else turned.size
            found.append(self._passed(reached[:stop], turned[:stop], ended=ends or back.size > 0))
            self._watch_standstill(self._time[:stop], reached[:stop])
            if not back.size:
                break
            self._reversals += 1
            top = int(np.argmax(turned[:stop]))
            self._time, self._angle = self._time[top:], self._angle[top:]
            self._set_direction(-self._direction)
        needed = int(np.searchsorted(reached, self._next * self._pitch))
        keep = max(min(needed, reached.size) - _KEPT, 0)
        self._time, self._angle = self._time[keep:], self._angle[keep:]
        return found

    def _thin(self, moved: FloatArray) -> None:
        """Forget most samples of a shaft that has stood for long before it turns."""
        if moved.size > _MOST_BEFORE:
            kept = np.zeros(moved.size, bool)
            for each in (moved, -moved):
                kept |= np.diff(np.maximum.accumulate(each), prepend=-1.0) > 0.0
            kept[-_KEPT:] = True
            self._time, self._angle = self._time[kept], self._angle[kept]

    def _set_direction(self, direction: int) -> None:
        self._direction, self._moved, self._place = direction, float(self._time[0]), math.nan
        self._next = math.floor(direction * self._angle[0] / self._pitch) + 1

    def _watch_standstill(self, time: FloatArray, reached: FloatArray) -> None:
        """Count the times without progress, each once."""
        place = np.floor(reached / (_PROGRESS * self._pitch))
        before = self._place if np.isfinite(self._place) else place[0]
        on = np.flatnonzero(np.diff(np.maximum.accumulate(np.append(before, place))) > 0.0)
        moved = np.append(self._moved, time[on])
        long = np.diff(moved) > _STOPPED
        self._stops += int(np.count_nonzero(long)) - (self._standing and bool(long[:1].any()))
        if on.size:
            self._moved, self._place, self._standing = float(moved[-1]), float(place.max()), False
        if time[-1] - self._moved > _STOPPED and not self._standing:
            self._stops, self._standing = self._stops + 1, True

    def _passed(self, reached: FloatArray, turned: FloatArray, *, ended: bool) -> FloatArray:
        """Return when the next marks were passed, as far as the samples behind them are there."""
        known = reached.size - 1 if ended else reached.size - _AFTER
        if known < 1:
            return np.empty(0)
        last = math.floor(reached[known] / self._pitch)
        if last - self._next > _MOST_AT_ONCE:
            raise SignalError(f'the angle passes {last - self._next} marks in '
                              f'{self._time[known] - self._time[0]:g} s, at most {_MOST_AT_ONCE} '
                              'are read: check its unit and the number of marks')
        marks = np.arange(self._next, last + 1) * self._pitch
        self._next = max(self._next, last + 1)
        index = np.minimum(np.searchsorted(reached, marks), reached.size - 1)  # to rounding
        marks, index = marks[index > 0], index[index > 0]
        if not marks.size:
            return np.empty(0)
        low, high = turned[index - 1], turned[index]
        share = (marks - low) / np.where(high > low, high - low, 1.0)
        straight = self._time[index - 1] + np.clip(share, 0.0, 1.0) * (
            self._time[index] - self._time[index - 1])
        fitted = np.flatnonzero(
            (index >= _BEFORE) & (index + _AFTER <= reached.size) & (not self._counted))
        around = index[fitted, None] + np.arange(-_BEFORE, _AFTER)
        moving = np.all(np.diff(turned[around], axis=1) > 0.0, axis=1)
        if moving.any():
            at = fitted[moving]
            straight[at] += self._beside(around[moving], marks[at], turned, straight[at])
        return np.asarray(np.maximum.accumulate(straight))

    def _beside(self, around: Array, marks: FloatArray, turned: FloatArray, origin: FloatArray
                ) -> FloatArray:
        """Return times of marks behind `origin` (s): parabolas through the samples `around`."""
        span = turned[around[:, -1]] - turned[around[:, 0]]
        x = (turned[around] - marks[:, None]) / span[:, None]
        y = self._time[around] - origin[:, None]
        powers = np.stack([np.ones_like(x), x, x**2], axis=2)
        inverse = np.linalg.pinv(powers)  # (crossing, power, sample)
        factors = np.einsum('ips,is->ip', inverse, y)
        left = y - np.einsum('isp,ip->is', powers, factors)
        latest = np.column_stack((  # leverage, and s a rad
            np.sum(inverse[:, 0] ** 2, axis=1), (y[:, -1] - y[:, 0]) / span))
        free = _BEFORE + _AFTER - 3
        for rest, each in zip(left, latest):  # a recursion over crossings, not over samples
            self._left = _MEMORY * self._left + float(rest @ rest)
            self._freedom = _MEMORY * self._freedom + free
            self._leverage_slowness += free / self._freedom * (each - self._leverage_slowness)
        return np.asarray(factors[:, 0])

    def _resolution(self) -> float:
        """Return the step of which nearly all steps of the angle are multiples, 0 if none is."""
        if self._steps.size < 16:
            return 0.0
        latest = self._steps[-64:]
        least = np.append(self._steps, np.abs(np.subtract.outer(latest, latest)))
        step = float(least[least > 1e-9].min(initial=np.inf))
        multiples = self._steps / step
        found = np.mean(np.abs(multiples - np.rint(multiples)) < _MULTIPLE) > _MOST
        return step if found and math.isfinite(step) else 0.0


def counter_runs(counts: FloatArray, turn: float, modulus: float = 0.0) -> AngleRuns:
    """
    Return the runs of a counter of `turn` counts a revolution.

    It may overflow a register of 8, 16 or 32 bits, wrap at `modulus` or at a turn, or be reset at
    the end of the range in which `counts` return again and again.
    """
    if not counts.size:
        return AngleRuns(turn, counts=True)
    size = np.quantile(np.abs(counts), _USUALLY)
    registers = [each for each in (turn, *(2.0**bits for bits in BITS))
                 if each >= max(size, _LEAST_MODULUS)]
    steps = np.diff(counts)
    falls = np.flatnonzero(np.abs(steps) > 0.5 * (np.ptp(counts) + 1.0))
    usual = 2.0 * float(np.median(np.abs(steps))) + 2.0 if steps.size else 0.0
    if falls.size > 1:
        fall = np.median(steps[falls])
        falls = falls[np.abs(steps[falls] - fall) <= usual]
        ends = np.concatenate((counts[falls], counts[falls + 1]))
        span = float(np.ptp(ends)) + 1.0 if falls.size > 1 else 0.0
        if span >= _LEAST_MODULUS and not any(
                span <= each <= span + usual for each in registers):
            registers.append(span)
    return AngleRuns(turn, moduli=(modulus,) if modulus else (), registers=tuple(registers),
                     counts=True)


def _of_counter(counts: FloatArray, marks: int, modulus: float = 0.0) -> AngleCrossings:
    """Return the crossings of a counter, a turn of which is the modulus if `marks` divide it."""
    turn = modulus if modulus and modulus % marks == 0.0 else float(marks)
    runs = counter_runs(counts, turn, modulus)
    return AngleCrossings(marks=marks, runs=runs, counted=turn == marks)


def counter_pulses(counts: ArrayLike, *, start_time: float = 0.0, sample_rate: float,
                   pulses_per_revolution: int = 1) -> tuple[FloatArray, AngleState]:
    """
    Return the pulse times (s) of a sampled pulse counter (n,), and its state at the end.

    Each count is a pulse, `pulses_per_revolution` are a turn. A pulse has the time of the first
    sample that counts it; several pulses in one sample are spaced evenly over the time since the
    sample before. The counter may count down, overflow or be reset each turn.

    >>> counter_pulses([7, 7, 8, 8, 10], sample_rate=10.0)[0]
    array([0.2 , 0.35, 0.4 ])
    >>> counter_pulses([2, 1, 0, 0, 255], sample_rate=10.0)[0]
    array([0.1, 0.2, 0.4])
    """
    values = np.asarray(counts)
    times = np.arange(values.size) / sample_rate
    crossings = _of_counter(values.astype(np.float64), int(pulses_per_revolution))
    pulses = np.append(crossings.update(times, values), crossings.flush())
    return start_time + pulses, crossings.state


def _is_gray(counts: FloatArray, modulus: float) -> bool:
    """Return whether counts (n,) change more evenly if they are taken for Gray code."""
    counts = counts[np.diff(counts, prepend=np.nan) != 0.0]
    if counts.size < 2 or counts.min() < 0.0:
        return False
    binary = counts.astype(np.int64)
    for bits in (1, 2, 4, 8, 16, 32):
        binary ^= binary >> bits
    steps = np.diff(np.array([counts, binary]))
    steps -= modulus * np.rint(steps / modulus) if modulus else 0.0
    # Neither a glitch nor the overflow of a register is usual.
    usual = max(int(_USUALLY * counts.size), 1)
    coded, decoded = np.sort(np.abs(steps), axis=1)[:, :usual].mean(axis=1)
    return bool(decoded < _GRAY * coded)


def _other_unit(angle: FloatArray, pulses: FloatArray, marks: float) -> list[str]:
    """Return why an angle (n,) with these pulses (s) is not in rad; empty if it may be."""
    if np.count_nonzero(np.abs(np.diff(angle)) > 0.5 * np.ptp(angle)) > 1:
        return [f'the angle wraps at about {other:g}, no turn in rad: give modulus={other:g}'
                for other in _OTHER_TURNS if abs(np.ptp(angle) / other - 1.0) < _SIMILAR]
    turns, span = pulses.size / marks, float(np.ptp(pulses))
    return [f'an angle in rad would turn {turns / span:.4g} times a second: if it is in degrees, '
            'give modulus=360'] if 0.0 < _FASTEST * span < turns else []


def pulses_from_angle(times: ArrayLike, angle: ArrayLike, *, pulses_per_revolution: int = 1,
                      modulus: float | None = None) -> FloatArray:
    """
    Return the pulse times (pulse,) in s of a sampled angle (sample,), as from a target on it.

    The `angle` of a resolver or joint is in rad and may wrap at any multiple of 2 pi, or at
    `modulus`, in rad. If `modulus` is a whole number it is a turn in another unit, of 360 degrees
    or 1. An angle of integers, or of whole numbers with a whole `modulus`, is in counts. A turn is
    then `modulus` counts, if `pulses_per_revolution` divides it; otherwise each count is a pulse,
    and `pulses_per_revolution` counts are a turn. For a register that holds some turns, `modulus`
    may be the counts of one turn; overflows of 8, 16 and 32 bits are seen in any case.

    One of the marks is at angle 0. The shaft may turn in either direction. Samples where it cannot
    be are bridged, and a `DataWarning` says how many; a jump of the angle that is no wrap, lost
    samples and a reversal end a run. Samples that are not finite are left out. Raises
    `ParameterError` for options and `SignalError` for arrays that cannot be used, as are times
    that run backwards.

    A shaft at 25 Hz, sampled at 1 kHz; an absolute encoder of 12 bits on it; and an incremental
    one of 500 counts a turn:

    >>> import numpy as np
    >>> import sa_jitter_ros as sa
    >>> time = np.arange(1000) / 1e3
    >>> turned = 25.0 * time
    >>> sa.pulses_from_angle(time, 2.0 * np.pi * turned % (2.0 * np.pi))[:3].round(6)
    array([0.04, 0.08, 0.12])
    >>> counts = np.floor(4096 * turned).astype(int) % 4096
    >>> sa.pulses_from_angle(time, counts, modulus=4096).size
    24
    >>> counts = np.floor(500 * turned).astype(np.uint16)
    >>> sa.pulses_from_angle(time, counts, pulses_per_revolution=500).size
    12487
    """
    marks = number('pulses_per_revolution', pulses_per_revolution)
    if not (marks >= 1.0 and marks.is_integer()):
        raise ParameterError(f'pulses_per_revolution {marks:g} must be a whole number, 1 or more')
    moments, values = np.asarray(times), np.asarray(angle)
    if moments.dtype.kind in 'fiu' and np.any(np.diff(moments.astype(np.float64)) < -_EARLY):
        raise SignalError('the times run backwards: sort them, and the angle with them '
                          '(numpy.argsort), or split the recording')
    if values.ndim != 1 or values.dtype.kind not in 'fiu':
        raise SignalError(f'angle of shape {values.shape} and type {values.dtype}: give one row '
                          'of real numbers, in rad or counts')
    check_samples(values, SignalError)
    finite = values[np.isfinite(values)].astype(np.float64)
    whole, turn = values.dtype.kind in 'iu', _TURN
    if not (whole or modulus or np.any(finite % 1.0)) and np.any(np.abs(finite) > _TURN):
        raise SignalError(f'the angle goes from {finite.min():g} to {finite.max():g} in whole '
                          'numbers, not in rad: give integers if these are counts, or a modulus')
    if modulus is not None:
        modulus = number('modulus', modulus)
        turn = modulus if modulus.is_integer() and modulus > 0.0 else _TURN
        whole |= modulus.is_integer() and not np.any(finite % 1.0)
        least = _LEAST_MODULUS if whole else 0.0
        if not least <= modulus < np.inf or modulus == 0.0:
            raise ParameterError(f'modulus {modulus:g} must be finite and '
                                 + (f'{least:g} counts or more' if whole else 'above 0 rad'))
    if whole:
        if np.any(np.abs(finite) > _EXACT):
            raise SignalError(f'a count of {np.max(np.abs(finite)):.0f} is above 2^53 and not '
                              'exact: subtract the first one')
        if _is_gray(finite, modulus or 0.0):
            raise SignalError('the counts change as Gray code does: convert them, in Python '
                              'for shift in (1, 2, 4, 8, 16): counts ^= counts >> shift')
        crossings = _of_counter(finite, int(marks), modulus or 0.0)
    else:
        runs = AngleRuns(turn, moduli=(turn, modulus or turn))
        crossings = AngleCrossings(marks=int(marks), runs=runs)
    pulses = np.append(crossings.update(times, values), crossings.flush())
    state = crossings.state
    if not pulses.size:
        seen = (f'go from {finite.min():g} to {finite.max():g} {"counts" if whole else "rad"}'
                if finite.size else 'hold no finite one')
        warnings.warn(f'the angle has no pulses: its {values.size} samples {seen}; check its '
                      'unit, the modulus, and that the shaft turns', DataWarning, stacklevel=2)
        return pulses
    found = [f'{state.glitches} samples of the angle are where the shaft cannot be, and were '
             'bridged'] * bool(state.glitches)
    if turn == _TURN and not whole:
        found += _other_unit(finite, pulses, marks)
    found += [f'{state.restarts} jumps of the angle that are no wrap began a new run'] * bool(
        state.restarts)
    if found:
        warnings.warn(f'{"; ".join(found)}: check sensor and modulus', DataWarning, stacklevel=2)
    return pulses
