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
The squared-envelope order spectrum of what a synchronous average leaves: the residual signal.

A damaged bearing strikes once in a turn of its cage, ball or ring, at an order that is no multiple
of the shaft and slips by a percent. A synchronous average does not contain it. The residual
signal, the samples of the cycles minus their average, does, without the gears. Its squared
envelope, the square of the magnitude of the analytic signal, shows how often the resonances of the
machine are struck (Antoni 2007, "Cyclic spectral analysis of rolling-element bearing signals";
Randall, Antoni 2011, "Rolling element bearing diagnostics: a tutorial", Mechanical Systems and
Signal Processing 25).

The average of M fundamental cycles contains 1/M of each of them. Subtracting it takes 2/M of a
squared envelope that is not synchronous with the shaft, 1/M of one that is; amplitudes are those
without this loss.
"""

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.averaging.cycle import CycleSamples, grid_points
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.parameters import listed
from sa_jitter_ros.pulses.angle_law import angle_law
from sa_jitter_ros.pulses.resampling import periodic
from scipy.fft import fft, ifft, next_fast_len

#: Slip: how far from a bearing order the line that stands out may be, relative to it.
SLIP = 0.02
_BAND = 0.15  # of the lines around a bearing order that show the noise, relative to it
_FEWEST = 16  # of these lines on either side
_FINE = 4  # steps of a search in the width of a line
_ROOM = 1.25  # highest order of the spectrum over the highest bearing order
_MOST_LINES = 1 << 13  # of a spectrum
_PER_PERIOD = 16.0  # points of the squared envelope in a period of its highest order
_UPSAMPLED = 8  # points of the waveform between two of its own, where it is interpolated
_LEAST_LEFT = 0.2  # of the squared envelope, below which its loss is not made up for


@dataclass(frozen=True)
class EnvelopeSettings:
    """
    What is looked for in the squared envelope: `bearing_orders`, multiples of the shaft speed.

    `band` (low, high) in Hz is that of the residual signal whose envelope is taken, () for all of
    it. Raises ParameterError for orders that are not positive and for an empty band.

    >>> EnvelopeSettings((4.9, 7.1), (4e3, 8e3)).orders(72.0).size
    639
    """

    bearing_orders: tuple[float, ...] = ()
    band: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        """Check the values."""
        if not all(math.isfinite(order) and order > 0.0 for order in self.bearing_orders):
            raise ParameterError(f'bearing_orders are {list(self.bearing_orders)}: give positive '
                                 'numbers')
        if self.band and not (len(self.band) == 2 and 0.0 <= self.band[0] < self.band[1]):
            raise ParameterError(f'envelope_band is {list(self.band)} Hz: give its lowest and its '
                                 'highest frequency, or nothing for all')

    def shown(self, rate: float, speed: float) -> tuple[float, str]:
        """
        Return the order that limits the envelope, and which bearing orders lie beyond it, and why.

        The vibration is sampled at a `rate` (Hz), the shaft turns at a `speed` (Hz).
        """
        low, high = self.band or (0.0, 0.5 * rate)
        shown = max(min(high, 0.5 * rate) - low, 0.0) / speed
        lost = [order for order in self.bearing_orders if order >= shown]
        return shown, (
            f'no amplitude of bearing orders {listed(lost)}: the shaft turns at {speed:.5g} Hz, '
            f'and vibration of {low:g} to {high:g} Hz, sampled at {rate:g} Hz, has an envelope of '
            f'orders below {shown:.5g} only; drop such orders, or give a wider envelope_band '
            f'below {0.5 * rate:g} Hz') if lost else ''

    def orders(self, revolutions: float) -> FloatArray:
        """Return the orders of the spectrum of an average over so many revolutions."""
        count = math.ceil(_ROOM * max(self.bearing_orders, default=0.0) * revolutions)
        step = max(1, math.ceil(count / _MOST_LINES))
        return np.arange(step, count + 1, step) / revolutions


@dataclass(frozen=True)
class Envelope:
    """
    Squared-envelope order spectrum of the residual signal of an average.

    For each of the `bearing_orders` (order,), `found` (channel, order) is the order of the largest
    line within 2 % of it, `amplitudes` its peak amplitude in the squared unit of the channel, and
    `standard_errors` that of the noise around. `mean` (channel,) is the mean squared envelope,
    twice the power of the residual signal. `spectrum` (channel, line) are the amplitudes at
    `orders` (line,). The squared envelope of a band is as wide as its part below half the sampling
    rate: amplitudes beyond are NaN, and `problem` says which bearing orders have none, and why.
    """

    bearing_orders: FloatArray
    found: FloatArray
    amplitudes: FloatArray
    standard_errors: FloatArray
    mean: FloatArray
    orders: FloatArray
    spectrum: FloatArray
    problem: str = ''


def residual_envelope(
    cycles: Sequence[CycleSamples], waveform: FloatArray, settings: EnvelopeSettings, *,
    cycle_length: float, trigger_cycles: int, first_angle: float, cycle_numbers: NDArray[np.int64],
    fundamental_cycles: int, law: str = 'linear', method: str = 'band_limited',
) -> Envelope:
    """
    Return the envelope of what `cycles` have beside the `waveform` (channel, angle) of them all.

    `cycle_length`, angle `law` and `method` of interpolation are settings of the average; the
    numbers of cycles, `first_angle` and `cycle_numbers` are fields of it. All amplitudes are NaN
    where the waveform is, and where it holds too few cycles.
    """
    highest = _ROOM * max(settings.bearing_orders)
    period = float(np.mean([cycle.periods.mean() for cycle in cycles]))
    points = int(grid_points(max(cycle.periods.max() for cycle in cycles), cycles[0].rate))
    together = max(1, int(points // (_PER_PERIOD * max(highest * cycle_length, 1.0))))
    points = math.ceil(points / together) * together
    u = np.arange(points) / points
    kind, begins = angle_law(law), first_angle + cycle_length * cycle_numbers
    fine = periodic(waveform, _UPSAMPLED * waveform.shape[1])
    residual = np.stack([
        cycle.at(kind, u, method=method).T - _periodic(fine, begin + cycle_length * u)
        for cycle, begin in zip(cycles, begins)])  # cycle x channel x point
    squares = np.concatenate([
        _squared_envelope(run, settings.band, points / period)
        for run in np.split(residual, np.flatnonzero(np.diff(cycle_numbers) != 1) + 1)])
    squares = squares.reshape(*squares.shape[:2], -1, together).mean(axis=-1)
    lines = _EnvelopeLines(
        squares, np.asarray(cycle_length * cycle_numbers, np.float64), cycle_length,
        together / points, fundamental_cycles)
    resolution = 1.0 / (cycle_length * (int(cycle_numbers[-1] - cycle_numbers[0]) + 1))
    orders = settings.orders(cycle_length * trigger_cycles)
    rows = [_around(lines, order, resolution) for order in settings.bearing_orders]
    shown, problem = settings.shown(cycles[0].rate, cycle_length / period)
    bearings = np.array(settings.bearing_orders)
    found, amplitudes, errors = (
        np.where(bearings < shown, np.stack(item, axis=1), np.nan) for item in zip(*rows))
    return Envelope(bearings, found, amplitudes, errors, np.where(shown, lines.mean, np.nan),
                    orders, np.where(orders < shown, lines.at(orders), np.nan), problem)


def _periodic(fine: FloatArray, angle: FloatArray) -> FloatArray:
    """Return a waveform (channel, point of a revolution) at angles in revolutions."""
    place = np.mod(angle, 1.0) * fine.shape[1]
    before = np.minimum(place.astype(np.int64), fine.shape[1] - 1)
    share = place - before
    return np.asarray(fine[:, before] * (1.0 - share)
                      + fine[:, (before + 1) % fine.shape[1]] * share)


def _squared_envelope(residual: FloatArray, band: tuple[float, ...], rate: float) -> FloatArray:
    """Return the squared envelope of consecutive cycles (cycle, channel, point) in a band (Hz)."""
    found = np.empty(residual.shape)
    size = len(residual) * residual.shape[2]
    length = next_fast_len(size)
    low, high = band or (0.0, math.inf)
    frequency = np.arange(length // 2 + 1) * (rate / length)
    mask = (frequency > 0.0) & (frequency >= low) & (frequency <= high)
    for channel in range(residual.shape[1]):
        spectrum = fft(residual[:, channel].ravel(), length)
        spectrum[:mask.size] *= 2.0 * mask
        spectrum[mask.size:] = 0.0
        analytic = ifft(spectrum, overwrite_x=True)[:size]
        found[:, channel] = (analytic.real**2 + analytic.imag**2).reshape(len(residual), -1)
    return found


class _EnvelopeLines:
    """Amplitudes of lines of squared envelopes (cycle, channel, point) at any order."""

    def __init__(self, squares: FloatArray, begins: FloatArray, cycle_length: float, step: float,
                 cycles: int) -> None:
        mean = squares.mean(axis=(0, 2), keepdims=True)
        self._squares = squares - mean
        self._begins, self._cycles = begins, max(cycles, 1)
        self._angle = cycle_length * step * (np.arange(squares.shape[2]) + 0.5)
        self._width = cycle_length * step
        left = 1.0 - 1.0 / self._cycles
        self.mean = mean.ravel() / left if left > _LEAST_LEFT else np.full(mean.size, np.nan)

    def at(self, orders: FloatArray) -> FloatArray:
        """Return amplitudes (channel, order)."""
        count, channels, points = self._squares.shape
        waves = np.exp(-2j * np.pi * np.multiply.outer(self._angle, orders))
        flat = self._squares.reshape(count * channels, points)
        sums = (flat @ waves.real + 1j * (flat @ waves.imag)).reshape(count, channels, -1)
        turns = np.exp(-2j * np.pi * np.multiply.outer(self._begins, orders))
        total = np.abs(np.einsum('cko,co->ko', sums, turns)) * (2.0 / (count * points))
        half = np.pi * orders
        whole = np.abs(np.sin(half)) < 1e-9
        kernel = np.where(whole, 1.0, np.sin(half * self._cycles) / np.where(
            whole, 1.0, self._cycles * np.sin(half)))
        left = 1.0 - (2.0 - kernel**2) / self._cycles
        left = np.where(left > _LEAST_LEFT, left, np.nan)
        return np.asarray(total / (left * np.sinc(orders * self._width)))


def _around(lines: _EnvelopeLines, order: float, resolution: float
            ) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return order, amplitude and standard error (channel,) of the largest line near an order."""
    reach = max(round(SLIP * order * _FINE / resolution), 1)
    near = order + np.linspace(-SLIP, SLIP, 2 * reach + 1) * order
    size = lines.at(near)
    at = np.nan_to_num(size).argmax(axis=1)
    channel, inner = np.arange(len(size)), np.clip(at, 1, near.size - 2)
    before, top, behind = (size[channel, inner + k] ** 2 for k in (-1, 0, 1))
    bend = before - 2.0 * top + behind
    shift = np.clip(0.5 * (before - behind) / np.where(bend < 0.0, bend, -np.inf), -1.0, 1.0)
    peak = np.sqrt(np.maximum(top - 0.25 * (before - behind) * shift, 0.0))
    edge = (at != inner) | ~(bend < 0.0)
    found = np.where(edge, near[at], near[inner] + shift * (near[1] - near[0]))
    amplitude = np.where(edge, size[channel, at], peak)
    count = max(math.ceil(_BAND * order / resolution), _FEWEST)
    around = np.asarray(order + resolution * np.arange(-count, count + 1), np.float64)
    apart = np.abs(around - order) > SLIP * order + 1.5 * resolution
    noise = lines.at(around[apart & (around > 1.5 * resolution)])
    found = np.where(np.isnan(amplitude), np.nan, found)
    return found, amplitude, np.median(noise, axis=1) / math.sqrt(math.log(4.0))
