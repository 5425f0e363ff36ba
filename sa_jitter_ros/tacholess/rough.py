# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The rough speed: the path of a comb through short-time spectra, and what else would fit."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.errors import SignalError
from sa_jitter_ros.parameters import listed
from sa_jitter_ros.tacholess.evidence import (
    best_path, comb, CombSpectra, RULED_OUT, spectra_of, without)

_WINDOWS = (24.0, 12.0, 6.0)  # revolutions, if the orders are one apart
_FRAMES = 6  # in a recording, at least
_STEP = 0.35  # of a bin of the highest order, between speeds
_COARSEST = 0.02  # step of the speeds, relative
_NEAR = 2.5  # bins of the lowest order within which a path is the same
_AMBIGUOUS = 0.8  # share of the evidence of the best path that no other may have
_FEW = 0.4  # less of it, if there is only one order
PRESENT = 0.4  # nats a frame, of an order that is there
_AT_EDGE = 0.3  # share of the frames in which the speed may be at the end of its range
_STILL = 12.0  # revolutions of a window, where run-ups stand still
_FINER = 0.04  # relative change of the speed that the second path may make


@dataclass(frozen=True)
class Rough:
    """Speed (frame,) in Hz at `times` (frame,) in s, and the evidence (order,) in nats a frame."""

    times: FloatArray
    speed: FloatArray
    evidence: FloatArray

    def angle(self, sample_rate: float, samples: int) -> FloatArray:
        """Return angles (sample,) in revolutions; speeds go on at the ends as they changed."""
        level = np.log(self.speed)
        times = np.concatenate([[0.0], self.times, [samples / sample_rate]])
        ends = [level[k] + (level[k] - level[k + by]) * abs(
            (times[e] - self.times[k]) / (self.times[k] - self.times[k + by]))
            for e, k, by in ((0, 0, 4), (-1, -1, -4))]
        level = np.concatenate([[ends[0]], level, [ends[1]]])
        return np.cumsum(np.exp(np.interp(
            np.arange(samples) / sample_rate, times, level))) / sample_rate


@dataclass(frozen=True)
class _Track:
    spectra: CombSpectra
    speeds: FloatArray
    path: NDArray[np.intp]
    total: float
    other: float
    other_speed: float
    near: float

    @property
    def margin(self) -> float:
        """
        Return by how much a frame speaks for the path, rather than for another.

        In the share `near` of the speeds no other could be told from it.
        """
        other = max(self.other, _AMBIGUOUS * self.near * self.total)
        return (self.total - other) / len(self.path)


def rough_speed(vibration: FloatArray, sample_rate: float, orders: FloatArray,
                speed_range: tuple[float, float], maximum_rate: float) -> Rough:
    """Return the rough speed; raises SignalError where no path, or more than one, fits."""
    low, high = speed_range
    spacing = min(1.0, float(np.min(np.diff(np.concatenate([[0.0], orders])))))
    duration = vibration.shape[1] / sample_rate
    tracks = []
    for revolutions in _WINDOWS:
        seconds = revolutions / spacing / np.sqrt(low * high)
        if (duration / seconds - 1.0) * 4.0 < _FRAMES:
            continue
        spectra = spectra_of(vibration, sample_rate, seconds, orders.max() * high)
        tracks.append(_track(spectra, orders, speed_range, maximum_rate))
    if not tracks:
        raise SignalError(f'vibration of {duration:g} s: too few revolutions between {low:g} and '
                          f'{high:g} Hz to find a speed; give a longer recording')
    best = max(tracks, key=lambda track: track.margin)
    speed = best.speeds[best.path]
    _require_one(best, speed, orders, speed_range)
    found = Rough(best.spectra.times, speed, _by_order(best.spectra, speed, orders))
    _require_most(found, orders)
    found = _finer(vibration, sample_rate, orders, found, spacing)
    _require_most(found, orders)
    return found


def _track(spectra: CombSpectra, orders: FloatArray, speed_range: tuple[float, float],
           maximum_rate: float) -> _Track:
    low, high = np.log(speed_range)
    step = min(_STEP * spectra.step / (orders.max() * np.exp(high)), _COARSEST)
    speeds = np.exp(np.linspace(low, high, int((high - low) / step) + 2))
    step = float(np.log(speeds[1] / speeds[0]))
    largest = maximum_rate * (spectra.times[1] - spectra.times[0]) / step
    evidence = comb(spectra, speeds, orders)
    path, total = best_path(evidence, largest)
    near = np.ceil(_NEAR * spectra.step / (orders.min() * speeds[path]) / step).astype(np.intp)
    apart = without(evidence, path, near)
    other, other_total = best_path(apart, largest)
    return _Track(spectra, speeds, path, total, other_total,
                  float(np.median(speeds[other])), float(np.mean(apart <= RULED_OUT)))


def _by_order(spectra: CombSpectra, speed: FloatArray, orders: FloatArray) -> FloatArray:
    """Return the evidence (order,) in nats a frame along a path (frame,)."""
    place = np.rint(np.outer(speed, orders) / spectra.step).astype(int)
    within = place < spectra.evidence.shape[1]
    found = np.take_along_axis(spectra.evidence, np.where(within, place, 0), axis=1)
    return np.asarray(np.where(within, found, 0.0).mean(axis=0))


def _require_one(track: _Track, speed: FloatArray, orders: FloatArray,
                 speed_range: tuple[float, float]) -> None:
    """Raise SignalError if the evidence is too little, or if another speed fits as well."""
    low, high = speed_range
    found = _by_order(track.spectra, speed, orders)
    ranged = f'between {low:g} and {high:g} Hz'
    if track.total <= 0.0 or found.max() < PRESENT:
        raise SignalError(f'no lines of the orders {listed(orders)} stand out {ranged}: give the '
                          'orders that the vibration has, or a sensor nearer to their source')
    if track.other > (_AMBIGUOUS - _FEW / len(orders)**2) * track.total:
        raise SignalError(
            f'two combs of the orders {listed(orders)} fit, at {np.median(speed):.4g} Hz and at '
            f'{track.other_speed:.4g} Hz: narrow speed_range, or give more orders of the machine')
    edge = np.mean((track.path <= 1) | (track.path >= len(track.speeds) - 2))
    if edge > _AT_EDGE:
        raise SignalError(f'the speed stays at the end of speed_range, {ranged}: widen it')


def _require_most(found: Rough, orders: FloatArray) -> None:
    """Raise SignalError unless most orders are there: half of them may be those of a multiple."""
    present = np.count_nonzero(found.evidence > PRESENT)
    if 2 * present <= len(orders):
        raise SignalError(f'only {present} of the orders {listed(orders)} stand out at '
                          f'{np.median(found.speed):.4g} Hz, which may be a guess: give those '
                          'that the vibration has')


def _finer(vibration: FloatArray, sample_rate: float, orders: FloatArray, rough: Rough,
           spacing: float) -> Rough:
    """Return the speed from spectra over the angle by a rough one: there, run-ups stand still."""
    samples = vibration.shape[1]
    angle = rough.angle(sample_rate, samples)
    count = int(np.clip(2.5 * orders.max() * (angle[-1] - angle[0]), samples // 4, 2 * samples))
    even = np.linspace(angle[0], angle[-1], count)
    rate = (count - 1) / (angle[-1] - angle[0])
    clock = np.arange(samples) / sample_rate
    times = np.interp(even, angle, clock)
    turned = np.array([np.interp(times, clock, channel) for channel in vibration])
    seconds = _STILL / spacing  # a turn is the second of this time
    if ((angle[-1] - angle[0]) / seconds - 1.0) * 4.0 < _FRAMES:
        return rough
    spectra = spectra_of(turned, rate, seconds, min(orders.max() * (1.0 + _FINER), 0.49 * rate))
    track = _track(spectra, orders, (1.0 - _FINER, 1.0 + _FINER),
                   _FINER / (spectra.times[1] - spectra.times[0]))
    ratio = track.speeds[track.path]
    middle = np.interp(spectra.times + angle[0], even, times)
    return Rough(middle, ratio * np.exp(np.interp(middle, rough.times, np.log(rough.speed))),
                 _by_order(spectra, ratio, orders))
