# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The residual on line: batches of averages, as topics carry them, against the prediction."""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
import math

import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.averaging.cycle import exact_cycles
from sa_jitter_ros.errors import ModelError, SignalError
from sa_jitter_ros.inference.expectation import RESOLUTION
from sa_jitter_ros.inference.observation import STRONG
from sa_jitter_ros.inference.record_pulses import SPEED_TOLERANCE
from sa_jitter_ros.inference.residual import Residual, residual
from sa_jitter_ros.parameters import listed
from sa_jitter_ros.prediction.model import DeclaredModel
from scipy.special import ndtr

_NOISE = 0.1  # of its amplitude that a line may scatter by
_MOST_PULSES = 1000  # per revolution


@dataclass(frozen=True)
class ReceivedAverage:
    """
    One average, as the topics carry it; times in s, speed of the tach shaft in Hz.

    `raw` and `corrected` (channel, order) are complex peak amplitudes, `noise` their standard
    deviation; `attenuation` is raw over corrected. `pulses` (N_t + 1, 3) are times, errors and
    standard errors, None where none came.
    """

    start_time: float
    end_time: float
    trigger_cycles: int
    fundamental_cycles: int
    trigger_speed: float
    orders: Array
    raw: Array
    corrected: Array
    attenuation: Array
    attenuation_standard_error: Array
    noise: Array
    pulses: Array | None = None

    @property
    def layout(self) -> tuple[int, int, tuple[float, ...]]:
        """Return what all averages of a batch have in common."""
        return self.trigger_cycles, len(self.raw), tuple(self.orders.tolist())


@dataclass(frozen=True)
class Published:
    """A published prediction: arrays (order,) and what they hold for."""

    order: Array
    mean: Array
    standard_deviation: Array
    trigger_speed: float
    keyphasor_rate: float
    trigger_cycles: int
    ratio: float
    pulse_error_std: float


class Batch:
    """Collects independent averages of one run: none that overlap, the newest `size` of them."""

    def __init__(self, size: int) -> None:
        self.size = size
        self.averages: list[ReceivedAverage] = []
        self.overlapping = 0

    @property
    def full(self) -> bool:
        """Tell whether there are as many averages as asked for."""
        return len(self.averages) >= self.size

    def add(self, average: ReceivedAverage) -> None:
        """Take an average; another layout or an earlier time begins anew."""
        if self.averages:
            last = self.averages[-1]
            if average.layout != last.layout or average.start_time <= last.start_time:
                self.averages.clear()
            elif average.start_time < last.end_time - 1e-6:
                self.overlapping += 1
                return
        self.averages.append(average)
        del self.averages[:-self.size]


def require_comparable(averages: Sequence[ReceivedAverage], published: Published) -> None:
    """Raise ModelError where a prediction is of another average than the measured ones."""
    last = averages[-1]
    if published.trigger_cycles != last.trigger_cycles:
        raise ModelError(f'the prediction is for {published.trigger_cycles} trigger cycles and '
                         f'the averages have {last.trigger_cycles}: set trigger_cycles of '
                         'averager and predictor to the same')
    cycles = exact_cycles(published.ratio) * _share(last) * last.trigger_cycles
    # one whole cycle less is in an average that begins soon behind the beginning of one
    least = math.floor(cycles) - (0 < cycles.numerator % cycles.denominator
                                  < cycles.denominator - 1)
    possible = {math.floor(cycles), least}
    for count in {item.fundamental_cycles for item in averages} - possible:
        raise ModelError(
            f'the prediction is for the ratio {published.ratio:g}, which makes '
            f'{float(cycles):.5g} fundamental cycles, and an average has {count} whole ones: set '
            'ratio of averager and predictor to the same')
    speed = float(np.mean([item.trigger_speed for item in averages]))
    if abs(speed / published.trigger_speed - 1.0) > SPEED_TOLERANCE:
        raise ModelError(f'the prediction is for {published.trigger_speed:g} Hz and the tach '
                         f'shaft turns at {speed:.4g} Hz: set trigger_speed or '
                         'follow_shaft_speed of the predictor')
    if not _common(averages, published).size:
        raise ModelError(
            f'averages have the orders {listed(last.orders, 6)} and the prediction '
            f'{listed(published.order, 6)}: give averager and predictor orders in common')


def compare(averages: Sequence[ReceivedAverage], published: Published) -> tuple[Array, Residual]:
    """
    Compare the mean attenuation of every order with the published prediction.

    Returns the table (order, 6) of order, observed, predicted, residual, standard error and z, and
    the residual's summary. Channels count by their signal-to-noise ratio; acquisitions are what
    is independent. Raises SignalError where no order stands above the noise.
    """
    common = _common(averages, published)
    good = good_lines(averages, common)
    with np.errstate(divide='ignore', invalid='ignore'):
        weight = np.array([np.abs(item.corrected[:, common] / item.noise[:, common])
                           for item in averages]).mean(axis=0) ** 2
    weight = np.where(good, np.minimum(weight, 1e12), 0.0)
    weight = weight / np.where(good.any(axis=0), weight.sum(axis=0), 1.0)
    seen = np.flatnonzero(good.any(axis=0))
    common, weight = common[seen], weight[:, seen]
    ratio = np.array([item.attenuation[:, common] for item in averages])
    error = np.array([item.attenuation_standard_error[:, common] for item in averages])
    attenuation = np.sum(weight * np.where(weight > 0.0, ratio, 0.0), axis=1)
    variance = np.sum((weight * np.where(weight > 0.0, error, 0.0)) ** 2, axis=1)
    index = places(averages[-1].orders[common], published.order)
    expected = np.broadcast_to(published.mean[index], attenuation.shape)
    total = variance + published.standard_deviation[index] ** 2 + RESOLUTION**2
    z = (attenuation - expected) / np.sqrt(total)
    found = residual(attenuation, expected, total, attenuation, expected, total, ndtr(z))
    table = np.stack((
        averages[-1].orders[common], attenuation.mean(axis=0), expected[0], found.mean,
        found.standard_error, found.mean / found.standard_error), axis=1)
    return table, found


def declared_by(averages: Sequence[ReceivedAverage], published: Published) -> DeclaredModel:
    """Return the model that a prediction's header tells, where its predictor cannot be asked."""
    share = _share(averages[-1])
    clock = 1.0 / (math.sqrt(12.0) * published.keyphasor_rate)
    uniform = math.isclose(published.pulse_error_std, clock, rel_tol=1e-6)
    return DeclaredModel(
        keyphasor_rate=published.keyphasor_rate, trigger_speed=published.trigger_speed,
        trigger_cycles=published.trigger_cycles, ratio=published.ratio,
        orders=tuple(published.order.tolist()), pulses_per_revolution=share.denominator,
        pulses_per_trigger=share.numerator,
        jitter_distribution='uniform' if uniform else 'normal',
        jitter_std=0.0 if uniform else published.pulse_error_std)


def good_lines(averages: Sequence[ReceivedAverage], chosen: Array) -> Array:
    """
    Return which lines (channel, chosen order) stand above their noise.

    `chosen` are indices of orders. Raises SignalError where there is none.
    """
    level = np.abs([item.corrected[:, chosen] for item in averages]).mean(axis=0)
    noise = np.sqrt(np.mean([item.noise[:, chosen] ** 2 for item in averages], axis=0))
    attenuation = np.array([item.attenuation[:, chosen] for item in averages])
    good = np.isfinite(attenuation).all(axis=0) & (noise <= _NOISE * level)
    good &= level >= STRONG * np.where(good, level, 0.0).max(axis=0)
    if not good.any():
        raise SignalError(f'none of the orders {listed(averages[-1].orders[chosen], 6)} stands '
                          'ten times above its noise on any channel: average more trigger '
                          'cycles, or other orders')
    return np.asarray(good)


def places(orders: Array, among: Array) -> Array:
    """Return where each order (n,) is among others (m,), which hold it: the nearest is taken."""
    return np.asarray(np.argmin(np.abs(orders[:, None] - among), axis=1))


def _share(average: ReceivedAverage) -> Fraction:
    """Return the revolutions of the tach shaft in a trigger cycle."""
    revolutions = average.trigger_speed * (average.end_time - average.start_time)
    return Fraction(revolutions / average.trigger_cycles).limit_denominator(_MOST_PULSES)


def _common(averages: Sequence[ReceivedAverage], published: Published) -> Array:
    """Return which of the measured orders are predicted."""
    orders = averages[-1].orders
    return np.flatnonzero(np.isclose(orders[:, None], published.order, rtol=1e-6).any(axis=1))
