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
Design of a monitoring system: what keyphasor rate and how many cycles an amplitude needs.

The keyphasor rate decides the loss, 1 - |E X|, which no number of cycles cures; rate, noise and
number of cycles decide the coefficient of variation, std|X| / E|X|. Both are those of unit
components. The number of cycles also decides which interfering components fall into notches of the
average (`comb`), and all of them how small a change one average shows (`detection_probability`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

import numpy as np
from numpy.typing import ArrayLike
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.errors import ModelError, ParameterError
from sa_jitter_ros.parameters import listed, number, numbers, unwrapped
from sa_jitter_ros.prediction.amplitudes import line_variance, unit_amplitudes
from sa_jitter_ros.prediction.angle_error import IndependentPulseJitter
from sa_jitter_ros.prediction.comb import Leakage, leakage
from sa_jitter_ros.prediction.influence import KnownGain
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.prediction.moments import cycle_moments, require_orders
from sa_jitter_ros.prediction.prediction import predict
from scipy.optimize import brentq

#: Distributions of pulse errors that are as wide as the keyphasor rate makes them.
RATE_DISTRIBUTIONS = ('uniform', 'normal', 'triangular')

_MOST_CYCLES = 1_000_000
_FEW = 8  # up to here the coefficient of variation may rise with the number of cycles
_MAIN_LOBE, _WIDEST = 1.32, 100.0  # widths in cycles of the order
_RATE_SPAN = 1e9  # highest rate tried, over the lowest at which pulses keep their order
_ANY_RATE = 1e12  # Hz; stands for the rate until it is chosen
# Trigger cycles looked at on either side for notches: as many again as the average has, but no
# fewer than reach a notch of most orders, and no more than are worth their time.
_FEWEST_MORE, _MOST_MORE = 20, 1000


@dataclass(frozen=True)
class Design:
    """
    Settings of keyphasor and average, and what they mean for each monitored order.

    `keyphasor_rate` is in Hz. `loss` = 1 - |E X| and `variation` = std|X| / E|X| have shape
    (order,), in the sequence of `orders`, as has `detection`, the probability that one average
    shows the change asked for (None where none was). `leakage` holds what is left of interfering
    components (None where there are none), its `orders` those of `others`, then those of `tones`.

    >>> import sa_jitter_ros as sa
    >>> found = sa.design(orders=[19, 38], trigger_speed=25.0, maximum_loss=0.02)
    >>> found  # doctest: +NORMALIZE_WHITESPACE
    Design(keyphasor_rate 7011 Hz, trigger_cycles 1, orders 19, 38, loss 0.00502, 0.02,
    variation 0.00149, 0.00595)
    >>> found.keyphasor_rate, found.loss.round(3).tolist()
    (7011.0, [0.005, 0.02])
    """

    keyphasor_rate: float
    trigger_cycles: int
    orders: Array
    loss: Array
    variation: Array
    leakage: Leakage | None
    detection: Array | None
    model: DeclaredModel

    def __repr__(self) -> str:
        """Return one line: the two settings and what they mean for each order."""
        return (f'Design(keyphasor_rate {self.keyphasor_rate:.5g} Hz, trigger_cycles '
                f'{self.trigger_cycles}, orders {listed(self.orders)}, loss '
                f'{listed(self.loss, 3)}, variation {listed(self.variation, 3)})')


@dataclass(frozen=True)
class DesignGrid:
    """
    The worst order's loss and coefficient of variation over rates and cycles.

    Both have shape (keyphasor rates, trigger cycles): iso-lines over them are the paper's Fig. 9.
    Rates at which pulses could swap hold NaN.
    """

    keyphasor_rate: Array
    trigger_cycles: Array
    loss: Array
    variation: Array


def design(*, orders: Sequence[float], trigger_speed: float, maximum_loss: float = 0.05,
           maximum_variation: float = 0.05, keyphasor_rate: float | None = None,
           trigger_cycles: int | None = None, ratio: float = 1.0, pulses_per_revolution: int = 1,
           pulses_per_trigger: int | None = None, jitter_distribution: str = 'uniform',
           noise_std: float = 0.0, sample_rate: float = 0.0, others: Sequence[float] = (),
           tones: Sequence[float] = (), change: float | None = None,
           false_alarm_rate: float | None = None) -> Design:
    """
    Choose the keyphasor rate and the number of trigger cycles, or assess those that are given.

    `orders` are to be monitored; `others` (orders, multiples of the same shaft) and `tones` (Hz)
    are components that interfere. What is None is chosen: the lowest `keyphasor_rate` (Hz, rounded
    up to four digits) that keeps `maximum_loss`, and the fewest `trigger_cycles` from which on
    `maximum_variation` holds, or somewhat more where that puts interfering components into notches
    of the average. `change` (0.1: 10 % up) and `false_alarm_rate` belong together. The other
    keywords are parameters of `jitter_predictor`; the pulse error is as wide as the keyphasor rate
    makes it. Raises ParameterError for limits outside (0, 1) and for interfering components that
    are synchronous, ModelError for a machine that makes no sense and for limits out of reach.

    >>> import sa_jitter_ros as sa
    >>> found = sa.design(orders=[19, 38], trigger_speed=41.5, ratio=2.4, maximum_loss=0.03,
    ...                   maximum_variation=0.01, noise_std=0.5, sample_rate=50e3)
    >>> found.keyphasor_rate, found.trigger_cycles
    (22770.0, 14)
    >>> found.loss.round(4).tolist()
    [0.0076, 0.03]
    """
    _require_limit('maximum_loss', number('maximum_loss', maximum_loss))
    _require_limit('maximum_variation', number('maximum_variation', maximum_variation))
    keyphasor_rate, trigger_cycles = unwrapped(keyphasor_rate), unwrapped(trigger_cycles)
    change, false_alarm_rate = unwrapped(change), unwrapped(false_alarm_rate)
    if (change is None) != (false_alarm_rate is None):
        name, missing = (('change', 'false_alarm_rate') if false_alarm_rate is None
                         else ('false_alarm_rate', 'change'))
        raise ParameterError(f'{name} is given without {missing}: which change an average shows '
                             'depends on both; give both')
    if change == 0.0:
        raise ParameterError('change is 0: give a relative change, 0.1 for one of 10 % up')
    if jitter_distribution not in RATE_DISTRIBUTIONS:
        raise ParameterError(f'jitter_distribution is {jitter_distribution!r}: choose one of '
                             f'{", ".join(RATE_DISTRIBUTIONS)}, whose width follows from the rate')
    model = DeclaredModel(
        keyphasor_rate=_ANY_RATE if keyphasor_rate is None else keyphasor_rate,
        trigger_cycles=1 if trigger_cycles is None else trigger_cycles,
        trigger_speed=trigger_speed, orders=tuple(require_orders(orders).tolist()), ratio=ratio,
        pulses_per_revolution=pulses_per_revolution, pulses_per_trigger=pulses_per_trigger or 0,
        jitter_distribution=jitter_distribution, noise_std=noise_std, sample_rate=sample_rate)
    interfering = _interfering_orders(model, others, tones)
    if keyphasor_rate is None:
        rate = _round_up(required_keyphasor_rate(model, maximum_loss))
        model = replace(model, keyphasor_rate=rate)
    if trigger_cycles is None:
        model = replace(model, trigger_cycles=required_trigger_cycles(model, maximum_variation))
    interference = None
    if interfering.size:
        count = model.trigger_cycles
        more = min(max(count, _FEWEST_MORE), _MOST_MORE)
        interference = leakage(
            interfering, model.orders, cycle_length=model.cycle_length,
            minimum=count if trigger_cycles is None else max(count - more, 1),
            maximum=count + more, trigger_cycles=trigger_cycles)
        model = replace(model, trigger_cycles=interference.trigger_cycles)
    detection = None
    if change is not None and false_alarm_rate is not None:
        detection = detection_probability(model, change, false_alarm_rate)[:, 0]
    loss, variation = loss_and_variation(model)
    return Design(model.keyphasor_rate, model.trigger_cycles, np.asarray(model.orders), loss,
                  variation, interference, detection, model)


def loss_and_variation(model: DeclaredModel) -> tuple[Array, Array]:
    """Return the loss and the coefficient of variation of each of a model's orders."""
    amplitudes = unit_amplitudes(model, ())
    found = amplitudes.distribution(np.arange(len(model.orders)), noise=line_variance(model, ()))
    return 1.0 - np.abs(amplitudes.moments.mean), np.sqrt(found.variance) / found.mean


def required_keyphasor_rate(model: DeclaredModel, maximum_loss: float) -> float:
    """
    Return the lowest keyphasor rate in Hz that keeps the loss of every order below a limit.

    Every higher rate keeps it too. The model's own rate does not matter, its noise neither.
    """
    unit = replace(model, orders=(max(model.orders),), sample_rate=0.0, noise_std=0.0)
    width = unit.distribution.width * model.keyphasor_rate  # s at a rate of 1 Hz
    lowest = 1.0001 * width / model.trigger_period

    def excess(log_rate: float) -> float:
        at_rate = replace(unit, keyphasor_rate=math.exp(log_rate))
        jitter = IndependentPulseJitter(
            at_rate.distribution, at_rate.fundamental_frequency, at_rate.weights)
        gain = abs(cycle_moments(at_rate.orders, [jitter]).mean[0])
        return float(1.0 - gain - maximum_loss)

    # The mean of uniform errors is 0 at a width of 1.32 cycles of the order: stay on this side.
    widest = _MAIN_LOBE if model.jitter_distribution == 'uniform' else _WIDEST
    start = max(lowest, width * unit.fundamental_frequency * unit.orders[0] / widest)
    if excess(math.log(start)) <= 0.0:
        return start
    return math.exp(brentq(excess, math.log(start), math.log(start * _RATE_SPAN), xtol=1e-10))


def required_trigger_cycles(model: DeclaredModel, maximum_variation: float) -> int:
    """
    Return the fewest trigger cycles that keep the coefficient of variation of every order below.

    Every larger number keeps it too: averages of one or two cycles can scatter less than averages
    of four, because an error common to all their pulses costs no amplitude. The model's own
    `trigger_cycles` do not matter. Raises ModelError when a million do not do.
    """
    worst = replace(model, orders=(max(model.orders),))

    def good(cycles: int) -> bool:
        _, variation = loss_and_variation(replace(worst, trigger_cycles=cycles))
        return bool(variation[0] <= maximum_variation)

    high = _FEW
    while not good(high):
        if high >= _MOST_CYCLES:
            raise ModelError(
                f'a coefficient of variation of {maximum_variation:g} needs more than '
                f'{_MOST_CYCLES} trigger cycles: allow more, or lower the noise')
        high = min(4 * high, _MOST_CYCLES)
    if high == _FEW:
        return 1 + max((count for count in range(1, _FEW) if not good(count)), default=0)
    low = high // 4
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if good(middle) else (middle, high)
    return high


def design_grid(model: DeclaredModel, keyphasor_rates: ArrayLike, trigger_cycles: ArrayLike
                ) -> DesignGrid:
    """Return the figures of the highest (worst) order over rates (Hz) and trigger cycles."""
    worst = replace(model, orders=(max(model.orders),))
    rates = np.asarray(keyphasor_rates, float)
    cycles = np.asarray(trigger_cycles)
    width = worst.distribution.width * worst.keyphasor_rate  # s at a rate of 1 Hz
    figures = np.full((2, rates.size, cycles.size), np.nan)
    for i in np.flatnonzero(width < rates * worst.trigger_period):
        for k, count in enumerate(cycles.tolist()):
            at = replace(worst, keyphasor_rate=float(rates[i]), trigger_cycles=count)
            figures[:, i, k] = np.ravel(loss_and_variation(at))
    return DesignGrid(rates, cycles, *figures)


def detection_probability(model: DeclaredModel, changes: ArrayLike, false_alarm_rate: float
                          ) -> Array:
    """
    Return the probability, shape (orders, k), that one average shows each of k relative changes.

    An alarm is raised when the amplitude of an order crosses a threshold that amplitudes of the
    unchanged component cross with the false-alarm rate: above it for a change upwards, below it
    for one downwards. The component alone changes; noise stays. A change of 0.1 makes the
    component 1.1 times as large. Raises ParameterError for a change that is not finite or below
    -1 and for a false-alarm rate outside (0, 1).

    >>> model = DeclaredModel(keyphasor_rate=10e3, trigger_speed=25.0, trigger_cycles=40,
    ...                       orders=(23.0, 46.0), noise_std=1.0, sample_rate=20e3)
    >>> detection_probability(model, [0.02, 0.05], 0.01).round(2)
    array([[0.57, 1.  ],
           [0.53, 1.  ]])
    """
    if not 0.0 < false_alarm_rate < 1.0:
        raise ParameterError(f'false_alarm_rate is {false_alarm_rate}: give a probability between '
                             '0 and 1, both excluded')
    ratios = 1.0 + np.atleast_1d(np.asarray(changes, float))
    if not np.all(np.isfinite(ratios) & (ratios >= 0.0)):
        raise ParameterError(f'change is {np.min(ratios) - 1.0:g}: give a finite relative change '
                             'of at least -1 (the component vanishes)')
    unchanged = predict(model)
    low, high = np.hsplit(unchanged.ppf([false_alarm_rate, 1.0 - false_alarm_rate]), 2)
    detected = []
    for ratio in ratios:
        changed = predict(model, [KnownGain(ratio)])
        detected.append(1.0 - changed.cdf(high) if ratio >= 1.0 else changed.cdf(low))
    return np.hstack(detected)


def _interfering_orders(model: DeclaredModel, others: Sequence[float], tones: Sequence[float]
                        ) -> Array:
    """Return the orders of everything that interferes; raise ParameterError for what cannot."""
    for name, given, unit in (('others', others, ''), ('tones', tones, ' Hz')):
        for value in numbers(name, given):
            if not (math.isfinite(value) and value > 0.0):
                raise ParameterError(f'{name} hold {value:g}{unit}: give finite numbers above 0')
    orders = np.array([*others, *(tone / model.fundamental_frequency for tone in tones)])
    highest = np.max(orders, initial=0.0) * model.fundamental_frequency
    if 0.0 < model.sample_rate < 2.0 * highest:
        raise ParameterError(
            f'an interfering component of {highest:g} Hz is above half the sample_rate of '
            f'{model.sample_rate:g} Hz, where an anti-aliasing filter removes it: leave it out')
    return orders


def _round_up(rate: float) -> float:
    """Round up to four digits, which never breaks a limit."""
    unit = 10.0 ** (math.floor(math.log10(rate)) - 3)
    return float(f'{math.ceil(rate / unit) * unit:.4g}')


def _require_limit(name: str, value: float) -> None:
    if not 0.0 < value < 1.0:
        raise ParameterError(f'{name} is {value}: give a fraction between 0 and 1, both excluded')
