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
From the sampled waveform of a keyphasor to the times of its pulses.

A Schmitt trigger decides whether there is a pulse. The pulse time is that of the last threshold
crossing before the decision. With interpolation it lies between two samples; without, it is the
time of the first sample past the threshold, as Camerini et al. 2019 (Fig. 2) model a sampled
keyphasor.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
import math
from typing import Literal
import warnings

import numpy as np
import numpy.typing as npt
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.errors import DataWarning, SignalError
from sa_jitter_ros.parameters import number, Values
from sa_jitter_ros.pulses.detector_parameters import DETECTOR_PARAMETERS, OPTIONS
from sa_jitter_ros.pulses.threshold import (
    SchmittTrigger, state_levels, StateLevels, TOO_LONG, whole_pulses)
from sa_jitter_ros.samples import check_rate, check_samples, check_times, SampleBlock

Polarity = Literal['positive', 'negative', 'auto']
Edge = Literal['rising', 'falling', 'centre']
_NONE: FloatArray = np.empty(0)
Piece = tuple[float, int, FloatArray]  # origin of the times, index of the first sample, samples
# Fraction of the level difference. After two windows with levels that agree, a smaller difference
# is the noise of a stopped machine, or hum between slow pulses.
_STOPPED = 0.2
# Fraction of the level difference by which the levels of the same signal may have drifted.
_DRIFTED = 0.5
# Half of the hysteresis: at least so many standard deviations of the noise, by which a slow edge
# crosses the threshold several times, but at most this fraction of the level difference.
_BEYOND_NOISE, _WIDEST = 4.0, 0.2
# Windows of a recording after which a signal that does not rest at its levels is no hum, unless
# more than a few samples are so many times as far apart as these.
_SLOW, _FEW, _BEYOND_HUM = 8, 5e-3, 3.0
_FEWEST = 40  # samples from which levels are learnt: ten intervals of four
# The longest window, s and samples: two pulses of a shaft at 0.05 Hz, or 32 MB.
_LONGEST, _MOST = 64.0, 1 << 22
_READ = 1 << 17  # samples of a window that are looked at: slow pulses are in many
# Change of the noise that is another one; samples a pulse, of fewer two may be in its band.
_LOUDER, _SPARSE = 1.5, 3.0
# Part of a lobe that a signal must pass on either side of the resting level.
_PASSED = 0.4
# Share of the samples above the middle from which on pulses are taken for negative.
_MOSTLY = 0.55


@dataclass(frozen=True)
class KeyphasorState:
    """
    State levels and counts of a detector; levels in the waveform's unit, NaN if unknown.

    `waiting` counts samples that are searched for pulses when the levels are known; `too_close`
    pulses dropped because of `minimum_interval`; `spikes` the samples far beyond the levels that
    were bridged. `polarity` is that of the pulses: positive or negative, auto as long as it is not
    decided.
    """

    low: float
    high: float
    threshold: float
    waiting: int
    too_close: int
    spikes: int
    polarity: str


class KeyphasorDetector:
    """
    Find the pulses of one keyphasor in a stream of blocks of samples of any size.

    The detector learns the two state levels from the first window that holds whole pulses, and
    updates them from each later one. Windows have `learning_time` seconds or, for slow shafts,
    twice as many, and twice again, up to a minute; in a recording, a waveform that does not rest
    at its first levels may be hum before a slow pulse, and needs 8 windows. Samples wait until
    then, so that no pulse is lost. With a `threshold` and `hysteresis` 0 it learns nothing. Levels
    that two windows have agreed on change only where the next two agree on others, so that no
    single event, whatever its size, moves them for longer. Up to three samples that are farther
    from all others than these are apart are a spike, and are bridged. If no `threshold` is given,
    pulses with a lobe on either side of the resting level, as a variable reluctance sensor makes
    them, have the time of the steep crossing between the lobes. The time of a slow edge in noise
    is that of the straight line through its samples.

    :param threshold: in the waveform's unit; None for half way between the state levels.
    :param hysteresis: width of the band around the threshold, a fraction of the level difference;
        unless 0 it is widened to 8 standard deviations of the noise, up to 0.4 of the difference.
    :param polarity: 'negative' for pulses below the resting level; their first edge is 'rising'.
        'auto': decided from the first levels; the state in which the signal is less often is the
        pulse, the upper one where they are about equal.
    :param edge: the pulse's 'rising' (first) edge, its 'falling' edge or the 'centre' of the two.
    :param interpolate: False gives the time of the first sample past the threshold.
    :param minimum_interval: pulses that follow sooner (s) are dropped and counted.
    :param learning_time: seconds of the shortest window.
    :param minimum_difference: state levels closer than this (waveform's unit) are noise.
    :raises ParameterError: an option is out of range.

    >>> detector = KeyphasorDetector(threshold=2.5, hysteresis=0.0)
    >>> tach = np.tile([0.0, 0.0, 5.0, 5.0, 0.0], 3)
    >>> detector.update(tach[:7], 0.0, 100.0), detector.update(tach[7:], 0.07, 100.0)
    (array([0.015]), array([0.065, 0.115]))
    >>> detector.state.threshold
    2.5
    """

    def __init__(
        self, *, threshold: float | None = None, hysteresis: float = 0.1,
        polarity: Polarity = 'positive', edge: Edge = 'rising', interpolate: bool = True,
        minimum_interval: float = 0.0, learning_time: float = 0.5, minimum_difference: float = 0.0,
    ) -> None:
        given = {'hysteresis': hysteresis, 'polarity': polarity, 'edge': edge,
                 'minimum_interval': minimum_interval, 'learning_time': learning_time,
                 'minimum_difference': minimum_difference, 'threshold': threshold or 0.0}
        for item in DETECTOR_PARAMETERS:
            item.convert(given.get(item.name, item.default))
        self._polarity = polarity
        self._given_threshold, self._hysteresis = threshold, hysteresis
        self._edge, self._interpolate = edge, interpolate
        self._minimum_interval, self._learning_time = minimum_interval, learning_time
        self._minimum_difference = minimum_difference
        #: Whether more of a signal that does not rest at its first levels can be waited for.
        self.patient = False
        self._learns = threshold is None or hysteresis > 0.0 or polarity == 'auto'
        self.reset()

    def reset(self) -> None:
        """Forget the levels, the waiting samples, the time and the counts."""
        self._sign = -1.0 if self._polarity == 'negative' else 1.0
        self._decided = self._polarity != 'auto'
        self._rate, self._origin, self._index = 0.0, np.nan, 0
        self._window: list[Piece] = []
        self._held = self._shortest = 0  # samples in the window, and in one of `learning_time`
        self._levels: StateLevels | None = None
        self._confirmed, self._learnt = False, 0  # samples of the window they are from
        self._pending: StateLevels | None = None
        self._latest, self._doubtful = _NONE, 0  # samples, the last ones of which may be a spike
        self._trigger = SchmittTrigger(interpolate=self._interpolate)
        self._trigger_origin = np.nan
        self._leading: float | None = None
        self._last_pulse = -np.inf
        self._too_close = self._spikes = 0

    @property
    def state(self) -> KeyphasorState:
        """Return the state levels and the counts so far."""
        levels = self._levels or StateLevels(np.nan, np.nan, significant=False)
        low, high = sorted((self._sign * levels.low, self._sign * levels.high))
        return KeyphasorState(
            low=low, high=high, threshold=self._sign * self._threshold(levels),
            waiting=0 if self._levels else self._held,
            too_close=self._too_close, spikes=self._spikes,
            polarity='auto' if not self._decided else (
                'positive' if self._sign > 0.0 else 'negative'))

    def update(self, samples: FloatArray, start_time: float, sample_rate: float) -> FloatArray:
        """
        Take the next samples (n,), the first at `start_time` (s), and return new pulse times (s).

        A `start_time` more than half a sample from the end of the last block is a gap, across
        which no pulse is found. The samples are finite, as parts of a `SampleBlock` and what a
        `VibrationTimeline` returns; another `sample_rate` needs another detector.
        """
        self._rate, self._shortest = sample_rate, max(
            round(self._learning_time * sample_rate), _FEWEST)
        if not abs(start_time - (self._origin + self._index / sample_rate)) <= 0.5 / sample_rate:
            self._origin, self._index = start_time, 0
        found = []
        window = self._shortest if self._learns else max(samples.size, 1)
        while samples.size:
            piece, samples = np.split(samples, [window - self._held % window])
            part = self._origin, self._index, self._sign * piece
            if self._levels or not self._learns:
                found.append(self._detect(part))
            self._index += piece.size
            if self._learns:
                self._window.append(part)
                self._held += piece.size
                if self._held % window == 0:
                    found.append(self._review(window))
        return np.concatenate(found) if found else _NONE

    def flush(self) -> FloatArray:
        """Return the pulse times (s) in samples that wait for levels, at a recording's end."""
        size, found, self.patient = self._held, _NONE, False
        while size and self._levels is None:
            found = self._learn(size, whole=size < self._held)
            size = size // 2 if size > self._shortest else 0
        self._end()
        return found

    def _end(self) -> None:
        """Take the last samples that may be a spike for one: none follow them."""
        self._spikes += self._doubtful
        self._latest, self._doubtful = _NONE, 0

    def _review(self, window: int) -> FloatArray:
        """Learn from the shortest window that holds whole pulses; each is twice as long."""
        most = max(min(_LONGEST * self._rate, _MOST), window)
        size, found = window, _NONE
        while self._held and not self._held % size and size <= most:
            size *= 2
            found = self._learn(size // 2, whole=bool(self._levels) or size <= most)
        if size > most:
            self._held //= 2
            self._window = _last(self._window, self._held)
        return found

    def _hum(self, levels: StateLevels) -> bool:
        """Return whether there may be more than these levels in the samples that wait."""
        if self.patient and self._held < _SLOW * self._shortest:
            return True
        every = np.concatenate([part for *_, part in self._window])[::self._held // _READ + 1]
        return bool(np.ptp(np.quantile(every, [_FEW, 1 - _FEW])) > _BEYOND_HUM * levels.difference)

    def _learn(self, size: int, *, whole: bool) -> FloatArray:
        """Learn the levels from the last samples; return the pulses that waited for them."""
        window = np.concatenate([part for *_, part in _last(self._window, size)])
        window = window[::math.ceil(size / max(_READ, self._shortest))]
        known = self._levels
        levels = state_levels(window[~known.spikes(window)] if known else window, known)
        if known and not levels.significant:  # larger pulses, perhaps
            levels = state_levels(window, known)
        useful = levels.significant and levels.difference > self._minimum_difference
        slow = self._shortest < self._learnt >= size  # they are of pulses longer than this
        stopped = known and self._confirmed and (slow or not levels.pulsed) and (
            levels.difference < _STOPPED * known.difference)
        if stopped or not useful or (whole and not whole_pulses(window, levels)) or (
                not known and not levels.pulsed and self._hum(levels)):
            return _NONE
        waiting, self._window, self._held = self._window, [], 0
        if known is None:
            if not self._decided:
                waiting, levels = self._decide(waiting, levels)
            self._levels, self._learnt, self._confirmed = levels, size, size > self._shortest
            return np.concatenate([self._detect(piece) for piece in waiting])
        above = window >= self._threshold(known)
        if levels.resembles(known, _DRIFTED):
            self._pending, self._confirmed = None, True
            if not levels.resembles(known):
                self._levels = levels
            elif known.steep:  # lobes grow with the speed, and the threshold stays between them
                self._levels = replace(levels, resting=known.resting)
            elif max(levels.noise, known.noise) > _LOUDER * min(levels.noise, known.noise):
                self._levels = replace(known, noise=levels.noise)
        elif not self._confirmed or above.all() or not above.any() or (
                self._pending and levels.resembles(self._pending, _DRIFTED)):
            self._levels, self._learnt, self._pending = levels, size, None
            self._confirmed = False
        else:
            self._pending = levels
        return _NONE

    def _decide(self, waiting: list[Piece], levels: StateLevels
                ) -> tuple[list[Piece], StateLevels]:
        """Decide the polarity from the first levels; return what waits with the sign it has."""
        self._decided = True
        if levels.steep or levels.share <= _MOSTLY:
            return waiting, levels
        self._sign = -1.0
        return ([(origin, index, -part) for origin, index, part in waiting], levels.negated())

    def _threshold(self, levels: StateLevels) -> float:
        return (levels.middle if self._given_threshold is None
                else self._sign * self._given_threshold)

    def _bridged(self, samples: FloatArray, levels: StateLevels) -> FloatArray:
        """
        Return the samples with the last sound one in place of spikes, which are counted.

        The last ones wait for the next if they may be a spike, or the begin of what is none.
        """
        every = np.concatenate((self._latest, samples))
        spikes, begin = levels.spikes(every), self._latest.size - self._doubtful
        end = every.size - int(np.argmin(np.append(spikes[::-1], False)))
        self._latest, self._doubtful = every[max(end - TOO_LONG, 0):], every.size - end
        if spikes.any():
            self._spikes += int(np.count_nonzero(spikes[begin:end]))
            sound = np.maximum.accumulate(np.where(spikes, -1, np.arange(every.size)))
            every = np.where(sound < 0, levels.low, every[sound])
        return np.asarray(every[begin:end])

    def _detect(self, piece: Piece) -> FloatArray:
        """Return the times of the pulses that end their detection in `piece`."""
        origin, index, samples = piece
        if origin != self._trigger_origin:
            self._trigger = SchmittTrigger(interpolate=self._interpolate)
            self._trigger_origin, self._leading, self._last_pulse = origin, None, -np.inf
            self._end()
        levels = self._levels or StateLevels(0.0, 0.0, significant=False)
        if self._levels:
            index -= self._doubtful
            samples = self._bridged(samples, levels)
        steep = levels.steep if self._given_threshold is None else ''
        crossings, rising = self._trigger.update(
            samples, index, self._threshold(levels), self._band(levels, steep=bool(steep)),
            _BEYOND_NOISE * levels.noise)
        if steep:
            crossings = crossings[rising == (steep == 'rising')]
        elif self._edge == 'centre':
            crossings = self._centres(crossings, rising)
        else:
            crossings = crossings[rising == (self._edge == 'rising')]
        return self._apart(origin + crossings / self._rate)

    def _band(self, levels: StateLevels, *, steep: bool) -> float:
        """Return half of the hysteresis: 0 if it is, but between lobes."""
        if not (self._hysteresis or steep):
            return 0.0
        least, most = (_PASSED * levels.lobe, 2.0 * _PASSED * levels.lobe) if steep else (
            0.5 * self._hysteresis * levels.difference, _WIDEST * levels.difference)
        return max(least, min(_BEYOND_NOISE * levels.noise, most))

    def _centres(self, crossings: FloatArray, rising: npt.NDArray[np.bool_]) -> FloatArray:
        """Return the middles of rising crossings and the falling ones that follow them."""
        leading, trailing = crossings[rising], crossings[~rising]
        if self._leading is not None:
            leading = np.concatenate(([self._leading], leading))
        elif trailing.size and not rising[0]:
            trailing = trailing[1:]
        self._leading = float(leading[-1]) if leading.size > trailing.size else None
        return np.asarray(0.5 * (leading[:trailing.size] + trailing))

    def _apart(self, times: FloatArray) -> FloatArray:
        """Drop the pulses that follow the last kept one within `minimum_interval`."""
        keep = np.diff(times, prepend=self._last_pulse) >= self._minimum_interval
        if not keep.all():
            last = self._last_pulse
            for i, time in enumerate(times):
                keep[i] = time - last >= self._minimum_interval
                last = time if keep[i] else last
            self._too_close += int(np.count_nonzero(~keep))
            times = times[keep]
        if times.size:
            self._last_pulse = float(times[-1])
        return times


def _last(pieces: list[Piece], count: int) -> list[Piece]:
    """Return the last `count` samples of the pieces."""
    kept: list[Piece] = []
    for origin, index, samples in reversed(pieces):
        if count > 0:
            skip = max(samples.size - count, 0)
            kept.append((origin, index + skip, samples[skip:]))
            count -= samples.size
    return kept[::-1]


def detector_of(values: Values) -> KeyphasorDetector:
    """Return the detector with these parameters; raises `ParameterError`."""
    return KeyphasorDetector(
        threshold=None if values['automatic_threshold'] else values['threshold'],
        **{name: values[name] for name in OPTIONS})


def pulses_in_blocks(detector: KeyphasorDetector, blocks: Iterable[SampleBlock]) -> FloatArray:
    """Return the pulse times (s) that a detector finds in all blocks, NaN and infinity a gap."""
    detector.patient = True
    found = [detector.update(part.samples[0], part.start_time, part.sample_rate)
             for block in blocks for part in block.finite_parts()]
    return np.concatenate([*found, detector.flush()])


def spikes_text(count: int) -> str:
    """Return what users should know of so many spikes, '' for none."""
    if not count:
        return ''
    which, were = ('1 sample of the keyphasor waveform is a spike', 'was') if count == 1 else (
        f'{count} samples of the keyphasor waveform are spikes', 'were')
    return (f'{which}, far beyond its levels, and {were} bridged: look at cable and ground of the '
            'sensor')


def detect_pulses(
    tach: npt.ArrayLike, sample_rate: float, *, start_time: float = 0.0,
    threshold: float | None = None, hysteresis: float = 0.1,
    polarity: Polarity = 'positive', edge: Edge = 'rising', interpolate: bool = True,
    minimum_interval: float = 0.0, learning_time: float = 0.5, minimum_difference: float = 0.0,
) -> FloatArray:
    """
    Return the pulse times (pulse,) in s of the sampled waveform (sample,) of a keyphasor.

    The first sample is at `start_time`, `sample_rate` in Hz; the other keywords are those of
    `KeyphasorDetector`. Samples that are NaN or infinite are a gap, across which no pulse is
    found. A `DataWarning` names spikes, pulses of few samples, and if there is none. Raises
    `ParameterError` for options and `SignalError` for an array or a rate that cannot be used.

    One pulse per revolution of a shaft at 25 Hz. With `interpolate=False` each pulse has the time
    of a sample, as from a keyphasor that is sampled at 2 kHz:

    >>> import numpy as np
    >>> import sa_jitter_ros as sa
    >>> time = np.arange(2000) / 2e3
    >>> tach = 5.0 / (1.0 + np.exp(-80.0 * (np.cos(2.0 * np.pi * 25.0 * time) - 0.95)))
    >>> pulses = sa.detect_pulses(tach, 2e3)
    >>> pulses.size, float(np.diff(pulses).mean().round(6))
    (25, 0.04)
    >>> float((sa.detect_pulses(tach, 2e3, interpolate=False) - pulses).max()) < 1.0 / 2e3
    True
    """
    detector = KeyphasorDetector(
        threshold=threshold, hysteresis=hysteresis, polarity=polarity, edge=edge,
        interpolate=interpolate, minimum_interval=minimum_interval, learning_time=learning_time,
        minimum_difference=minimum_difference)
    sample_rate = number('sample_rate', sample_rate)
    start_time = number('start_time', start_time)
    samples = np.asarray(tach)
    if samples.ndim != 1:
        raise SignalError(f'the keyphasor waveform has shape {samples.shape}: give one channel')
    if samples.dtype.kind not in 'fiub':
        raise SignalError(f'the keyphasor waveform has type {samples.dtype}: give real numbers')
    if not np.isfinite(start_time):
        raise SignalError(f'start time {start_time} s must be finite')
    block = SampleBlock(samples.astype(np.float64)[None], start_time, sample_rate, 0)
    check_rate('sample_rate', sample_rate, SignalError)
    check_times('start_time', start_time, SignalError)
    check_samples(block.samples, SignalError)
    pulses = pulses_in_blocks(detector, [block])
    state, said = detector.state, [spikes_text(detector.state.spikes)]
    if not pulses.size:
        said.append('the keyphasor waveform has no pulses: ' + (
            f'its levels are {state.low:g} and {state.high:g}, the threshold is '
            f'{state.threshold:g}; set it between them' if np.isfinite(state.low) else
            f'its {samples.size} samples have one level; check that the shaft turns, and cables'))
    elif (each := sample_rate * float(np.quantile(np.diff(pulses, prepend=-1e12), .25))) < _SPARSE:
        said.append(f'the keyphasor waveform has {each:.2g} samples a pulse, of which some may be '
                    f'lost: sample it at {_SPARSE * sample_rate / each:.0f} Hz or more')
    for text in filter(None, said):
        warnings.warn(text, DataWarning, stacklevel=2)
    return pulses
