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
The tone that no shaft makes: its frequency is constant while the speed of the shafts drifts.

It is looked for in the amplitudes of single trigger cycles. The phase of a tone near an order
turns relative to that order, evenly in time. The phase of an order of another shaft turns evenly
from cycle to cycle, whatever the speed; where the speed drifts, this distinguishes the two.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.effects.evidence import Tone
from scipy import optimize
from scipy.ndimage import maximum_filter1d

Array = NDArray[Any]

_PADDED = 4  # values of a spectrum a line
# Power over that of its twin, and power of an even line near it over its own.
_TWIN, _EVEN = 4.0, 1.5
_EXACT = 1e-3  # last power of the distance from a whole place that counts


def find_tone(cycles: Array, times: Array, angle: Array, orders: Array) -> Tone:
    """
    Find the strongest tone whose phase turns relative to an order.

    `cycles` (acquisition, cycle, line) are complex peak amplitudes, corrected, of the `orders`
    (line,); `times` (acquisition, cycle) the middles of the cycles in s and `angle` the
    fundamental cycles there. A modulation has a twin on the other side of the order, a tone has
    none.
    """
    turned = cycles * np.exp(-1j * np.angle(cycles.mean(axis=1, keepdims=True)))
    series = turned.reshape(-1, cycles.shape[2])
    series = series - series.mean(axis=0)
    count = len(series)
    time, turns = times.ravel() - times.mean(), angle.ravel() - angle.mean()
    speed = float(np.polyfit(time, turns, 1)[0])
    period = float(np.median(np.diff(times, axis=1)))
    # What an order is ahead of its mean frequency: a tone near it turns back by as much.
    ahead = 2.0 * np.pi * (turns - speed * time)
    weight = np.hanning(count + 2)[1:-1]
    places, even_places = time / period, turns / speed / period
    best, line, rate = -np.inf, 0, 0.0
    for i, order in enumerate(orders):
        height, rates = _heights(series[:, i] * weight, order * ahead, places, even_places)
        peak = int(np.argmax(height))
        if height[peak] > best:
            best, line, rate = float(height[peak]), i, float(rates[peak])
    # Along the radius only: the pulse errors have been fitted to what turns.
    along = series[:, line].real * weight
    back = along * np.exp(1j * orders[line] * ahead)

    def strength(turn: float) -> float:
        return float(np.abs(np.exp(-2j * np.pi * turn * places) @ back))

    turn = float(optimize.minimize_scalar(
        lambda x: -strength(x), bounds=rate + np.array((-0.25, 0.25)) / count,
        method='bounded', options={'xatol': 1e-5 / count}).x)
    amplitude = 2.0 * strength(turn) / weight.sum()
    # White noise of variance s2 leaves s2 sum(window^2) in a bin of the spectrum.
    power = np.abs(np.fft.rfft(along)[1:]) ** 2
    s2 = float(np.median(power)) / np.log(2.0) / float(weight @ weight)
    error = np.sqrt(2.0 * s2 * (weight @ weight)) / weight.sum()
    bend = np.sqrt(2.0 * s2 * np.sum((weight * time) ** 2)) / (weight @ time**2) / amplitude
    lost = np.sinc(turn)  # in the mean over a cycle
    return Tone(
        frequency=float(abs(orders[line] * speed + turn / period)),
        amplitude=float(amplitude / lost), frequency_error=float(bend / (2.0 * np.pi)),
        standard_error=float(error / lost),
        p_value=min(1.0, series.size * math.exp(-max(best, 0.0))))


def _heights(series: Array, ahead: Array, places: Array, even_places: Array
             ) -> tuple[Array, Array]:
    """
    Return the power of tones beside one order over that of the noise, and their turns per cycle.

    `series` (cycle,) is the amplitude relative to the order, `ahead` (cycle,) the phase by which
    the order is ahead of its mean frequency; `places` and `even_places` count the cycles by time
    and by angle.
    """
    size = _PADDED * int(max(np.ptp(places), np.ptp(even_places)) + 2.0)
    spectrum, twin = (np.abs(_spectrum(item * np.exp(1j * ahead), places, size)) ** 2
                      for item in (series, series.conj()))
    even = np.abs(_spectrum(series, even_places, size)) ** 2
    rates = np.fft.fftfreq(size)
    beside = np.abs(rates) >= 2.0 / series.size
    floor = max(float(np.median(spectrum[beside])) / np.log(2.0), np.finfo(float).tiny)
    drift = float(np.abs(np.diff(ahead)).max()) / (2.0 * np.pi)
    reach = min(2 * int((drift + 3.0 / series.size) * size) + 1, size)
    sharp = maximum_filter1d(even, reach, mode='wrap') <= _EVEN * spectrum
    return np.where(beside & sharp, spectrum - _TWIN * twin, 0.0) / floor, rates


def _spectrum(values: Array, places: Array, size: int) -> Array:
    """
    Return the Fourier transform (size,) of `values` (place,) at uneven `places`.

    Frequencies are those of `fftfreq` for unit steps, phases refer to the first place. Values are
    moved to the nearest whole place; a power series in the distance corrects their phase.
    """
    nearest = np.rint(places - places[0]).astype(int)
    turn = -2j * np.pi * np.fft.fftfreq(size)
    apart = places - places[0] - nearest
    largest = np.pi * float(np.abs(apart).max())
    total = np.zeros(size, complex)
    term, power = values.astype(complex), 0
    while power == 0 or largest**power / math.factorial(power) > _EXACT:
        grid = (np.bincount(nearest, term.real, size)
                + 1j * np.bincount(nearest, term.imag, size))
        total += np.fft.fft(grid) * turn**power
        power += 1
        term = term * apart / power
    return total
