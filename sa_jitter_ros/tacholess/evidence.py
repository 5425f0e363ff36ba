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
Evidence for lines in short-time spectra, its sum over a comb of orders, the path with the most.

The power in a bin is compared with the noise around it. Peaks that belong to nobody are part of
what is there without a line, so that one strong foreign line outweighs no comb.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.arrays import FloatArray
from scipy.ndimage import maximum_filter1d
from scipy.special import gammaincc

RULED_OUT = -20.0  # nats, more than a frame of any comb loses
# A step of the path up to this share of the largest one costs so many nats.
_COSTS = ((1.0 / 16.0, 0.0), (1.0 / 4.0, 0.5), (1.0, 2.0))
_FOREIGN = 0.05  # of all bins hold a peak of something else
_ABSENT = 0.3  # of the time a line of the machine is not to be seen
_HOPS = 4  # of frames in the length of one
_NARROW, _WIDE = 12, 40  # bins over which the floor of the noise is taken, below and above
_LOW = 120  # this bin
_SHARPNESS = 0.1  # nats for a power e times as large: the middle of a strong line wins
_LARGEST = 600.0  # power over noise, beyond which the incomplete gamma function underflows


@dataclass(frozen=True)
class CombSpectra:
    """Evidence (frame, bin) in nats for a line in a bin; `times` (frame,) in s, `step` in Hz."""

    evidence: NDArray[np.float32]
    times: FloatArray
    step: float


def spectra_of(vibration: FloatArray, sample_rate: float, seconds: float, highest: float
               ) -> CombSpectra:
    """
    Return the evidence for lines up to `highest` Hz in frames of `seconds`.

    `vibration` (channel, sample); a frame with a sample that is not finite says nothing of its
    channel.
    """
    size = 2 * max(round(seconds * sample_rate / 2.0), 8)
    hop = size // _HOPS
    count = (vibration.shape[1] - size) // hop + 1
    bins = min(int(np.ceil(highest * size / sample_rate)) + 2, size // 2 + 1)
    taper = np.hanning(size + 1)[:-1]
    starts = hop * np.arange(count)
    total = np.zeros((count, bins))
    seen = np.zeros(count)
    for samples in vibration:
        frames = np.lib.stride_tricks.sliding_window_view(samples, size)[::hop]
        power = np.empty((count, bins))
        for first in range(0, count, 64):
            part = frames[first:first + 64]
            part = part - part.mean(axis=1, keepdims=True)
            power[first:first + 64] = np.abs(np.fft.rfft(part * taper)[:, :bins]) ** 2
        good = np.isfinite(power[:, 0]) & (power.sum(axis=1) > 0.0)
        power[good] /= _floor(power[good])
        total[good] += power[good]
        seen += good
    tail = gammaincc(np.maximum(seen, 1.0)[:, None], np.minimum(total, _LARGEST))
    surprise = -np.log(np.maximum(tail, 1e-250))
    surprise[seen == 0] = 0.0
    evidence = _evidence(surprise) + _SHARPNESS * np.log1p(
        np.maximum(total / np.maximum(seen, 1.0)[:, None] - 1.0, 0.0))
    evidence[seen == 0] = 0.0
    evidence[:, 0] = 0.0
    return CombSpectra(evidence.astype(np.float32), (starts + size / 2.0) / sample_rate,
                       sample_rate / size)


def _floor(power: FloatArray) -> FloatArray:
    """Return the mean power (frame, bin) of the noise: medians over bins, lines left aside."""
    bins = power.shape[1]
    edges = np.concatenate([np.arange(1, min(_LOW, bins), _NARROW), np.arange(_LOW, bins, _WIDE)])
    parts = np.split(np.arange(bins), edges)[1:]
    middles = [part.mean() for part in parts]
    medians = np.stack([np.median(power[:, part], axis=1) for part in parts], axis=1)
    between = np.array([np.interp(np.arange(bins), middles, one) for one in np.eye(len(parts))])
    return np.asarray(np.exp(np.log(medians / np.log(2.0) + 1e-300) @ between))


def _evidence(surprise: FloatArray) -> FloatArray:
    """Return log odds of a line, of unknown power, against noise with peaks of others."""
    line = 0.1 * (1.0 - np.exp(-surprise / 4.0)) / np.maximum(surprise, 1e-3)
    noise = np.exp(-surprise)
    odds = line / ((1.0 - _FOREIGN) * noise + _FOREIGN * line)
    return np.log(_ABSENT + (1.0 - _ABSENT) * odds)


def comb(spectra: CombSpectra, speeds: FloatArray, orders: FloatArray) -> NDArray[np.float32]:
    """Return the evidence (frame, speed) summed over the orders, those in the band."""
    found = np.zeros((len(spectra.times), len(speeds)), np.float32)
    last = spectra.evidence.shape[1] - 1
    for order in orders:
        place = order * speeds / spectra.step
        place = place[place < last]
        below = place.astype(int)
        share = (place - below).astype(np.float32)
        found[:, :place.size] += (1.0 - share) * spectra.evidence[:, below]
        found[:, :place.size] += share * spectra.evidence[:, below + 1]
    return found


def best_path(evidence: NDArray[np.float32], largest: float) -> tuple[NDArray[np.intp], float]:
    """
    Return the cells (frame,) of the path with the most evidence (frame, cell), and its sum.

    From a frame to the next it moves by at most `largest` cells.
    """
    steps = [(max(round(share * largest), 1), cost) for share, cost in _COSTS]
    total = np.empty_like(evidence)
    total[0] = evidence[0]
    for k in range(1, len(evidence)):
        before = total[k - 1]
        total[k] = evidence[k] + np.maximum.reduce([
            maximum_filter1d(before, 2 * reach + 1, mode='nearest') - cost
            for reach, cost in steps])
    path = np.empty(len(evidence), np.intp)
    path[-1] = np.argmax(total[-1])
    for k in range(len(evidence) - 1, 0, -1):
        cell = path[k]
        best = -np.inf
        for reach, cost in steps:
            first = max(cell - reach, 0)
            part = total[k - 1, first:cell + reach + 1]
            near = first + int(np.argmax(part - 1e-4 * np.abs(np.arange(first, first + part.size)
                                                              - cell)))
            if total[k - 1, near] - cost > best:
                best, path[k - 1] = total[k - 1, near] - cost, near
    return path, float(total[-1].max())


def without(evidence: NDArray[np.float32], path: NDArray[np.intp], reach: NDArray[np.intp]
            ) -> NDArray[np.float32]:
    """Return the evidence with `reach` (frame,) cells on either side of a path ruled out."""
    cells = np.arange(evidence.shape[1])
    near = np.abs(cells - path[:, None]) <= reach[:, None]
    return np.where(near, np.float32(RULED_OUT), evidence)
