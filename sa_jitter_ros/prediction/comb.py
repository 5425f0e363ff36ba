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
Synchronous averaging as a comb filter: what is left of components that are not synchronous.

The waveform, the mean of N whole fundamental cycles, multiplies a tone of order gamma by

    H(gamma) = (1/N) sum_i exp(j 2 pi i gamma)
             = sin(pi gamma N) / (N sin(pi gamma)) exp(j pi gamma (N-1))

(Camerini et al. 2019, Eq. 8; Eq. 7 lacks the 1/N): 1 at every integer order, zero at the other
multiples of 1/N. An order amplitude is no such mean: it is the integral at order g over all of the
L = N_t r fundamental cycles in the trigger cycles, whole or not, and takes from the tone

    G(gamma, g) = (1/L) int_0^L exp(j 2 pi (gamma - g) theta) dtheta
                = sinc(L (gamma - g)) exp(j pi L (gamma - g)).

A real tone also brings its mirror image -gamma. The number of cycles moves the notches, so it can
be chosen to put one on an interfering order: McFadden, "A revised model for the extraction of
periodic waveforms by time domain averaging", Mech. Syst. Signal Process. 1 (1987) 83-95; Braun,
"The synchronous (time domain) average revisited", ibid. 25 (2011) 1087-1102. All of this is about
block and sliding averages; an exponential one has no notches.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.errors import ParameterError

# Closer than this, an order counts as synchronous and a number of cycles as whole.
_SAME = 1e-9
# A component of which an order amplitude keeps a thousandth changes no reading, and a tenth more
# than the least is no worse: of the numbers of cycles that reach either, the fewest is best.
_NOTCH, _AS_GOOD = 1e-3, 1.1


@dataclass(frozen=True)
class Leakage:
    """
    What averages of `trigger_cycles`, and of other numbers of them, keep of what interferes.

    `orders` (component,) are the interfering orders. `share` (component, order) is the largest
    share of a component's amplitude that appears in the amplitude of each monitored order,
    whatever its phase; `waveform_share` (component,) the share in the waveform, NaN where an
    average may hold no whole fundamental cycle. `candidates` (k,) are numbers of trigger cycles
    and `largest_share` (k,) the largest `share` of each.
    """

    trigger_cycles: int
    orders: Array
    share: Array
    waveform_share: Array
    candidates: Array
    largest_share: Array

    def best(self, count: int) -> Array:
        """Return the `count` best candidates, in rising order; equally good: the fewest cycles."""
        worse = np.maximum(self.largest_share, _good_share(self.largest_share))
        return np.sort(self.candidates[np.argsort(worse, kind='stable')[:count]])


def comb_response(orders: ArrayLike, cycles: ArrayLike) -> Array:
    """
    Return the complex response H of the mean of whole fundamental cycles, Eq. 8.

    `orders` (integers and zero included) and `cycles` broadcast. Raises ParameterError unless the
    orders are finite and the cycles positive integers.
    """
    gamma, n = _finite('orders', orders), _finite('cycles', cycles)
    if not np.all((n >= 1) & (n == np.round(n))):
        raise ParameterError(f'cycles = {n.tolist()}: give positive whole numbers')
    # Of the order only the distance to the next integer counts; near 0 no digits are lost.
    distance = gamma - np.round(gamma)
    return np.asarray(np.sinc(n * distance) / np.sinc(distance)
                      * np.exp(1j * np.pi * distance * (n - 1)))


def order_response(tone_orders: ArrayLike, orders: ArrayLike, length: ArrayLike) -> Array:
    """
    Return the complex response G of the amplitude at `orders` to exp(j 2 pi gamma theta).

    `tone_orders` gamma, `orders` and `length`, the fundamental cycles in the average, broadcast.
    Raises ParameterError on numbers that are not finite and on lengths that are not positive.
    """
    whole = _finite('length', length)
    if not np.all(whole > 0.0):
        raise ParameterError(f'length = {whole.tolist()}: give positive numbers')
    cycles = whole * (_finite('tone_orders', tone_orders) - _finite('orders', orders))
    return np.asarray(np.sinc(cycles) * np.exp(1j * np.pi * cycles))


def order_share(tone_orders: ArrayLike, orders: ArrayLike, length: ArrayLike) -> Array:
    """
    Return the largest share of a real tone's amplitude that the amplitude at `orders` shows.

    The worst phase of the tone adds its mirror image in full: abs(G(gamma, g)) + abs(G(-gamma,
    g)). Arguments and errors are those of `order_response`.
    """
    tones = np.asarray(tone_orders, float)
    direct, mirrored = (np.abs(order_response(sign * tones, orders, length)) for sign in (1, -1))
    return np.asarray(direct + mirrored)


def waveform_share(tone_orders: ArrayLike, length: float) -> Array:
    """
    Return the share of a tone's amplitude in the waveform of `length` fundamental cycles.

    Where `length` is no whole number, the waveform may hold one cycle fewer than fit in, and the
    worse case counts. NaN where it may hold none.
    """
    most = np.floor(length + _SAME)
    fewest = most if length - most < _SAME else most - 1.0
    if fewest < 1.0:
        return np.full(np.shape(tone_orders), np.nan)
    return np.asarray(np.maximum(*(np.abs(comb_response(tone_orders, count))
                                   for count in (most, fewest))))


def leakage(interfering_orders: ArrayLike, orders: ArrayLike, *, cycle_length: float, minimum: int,
            maximum: int, trigger_cycles: int | None = None) -> Leakage:
    """
    Return what an average keeps of interfering orders, and choose its number of trigger cycles.

    Left out, `trigger_cycles` is the fewest from `minimum` to `maximum` of which no amplitude at
    `orders` keeps more than 0.001 of an interfering component, or more than 1.1 times the least
    that any number in this range keeps. Where an order is known roughly only, give the ends of its
    range as two. `cycle_length` is r, the fundamental cycles in a trigger cycle. Raises
    ParameterError on orders that are not positive, on bounds that are not 1 <= minimum <= maximum,
    and on an interfering order that is one of `orders`: no number of cycles removes it.
    """
    tones = np.ravel(_finite('interfering orders', interfering_orders))
    monitored = np.ravel(_finite('orders', orders))
    for name, given in (('interfering orders', tones), ('orders', monitored)):
        if given.size == 0 or np.any(given <= 0.0):
            raise ParameterError(f'{name} = {given.tolist()}: give orders above 0, one at least')
    if not (1 <= minimum <= maximum and float(minimum).is_integer()
            and float(maximum).is_integer()):
        raise ParameterError(f'minimum = {minimum}, maximum = {maximum}: give whole numbers with '
                             '1 <= minimum <= maximum')
    synchronous = np.any(np.abs(tones[:, None] - monitored) < _SAME * monitored, axis=1)
    if synchronous.any():
        raise ParameterError(
            f'interfering order {tones[synchronous][0]:g} is synchronous with a monitored order: '
            'no number of trigger cycles removes it; leave out one of them')
    candidates = np.arange(int(minimum), int(maximum) + 1)
    largest = order_share(tones[:, None], monitored,
                          cycle_length * candidates[:, None, None]).max(axis=(1, 2))
    chosen = trigger_cycles
    if chosen is None:
        chosen = int(candidates[np.argmax(largest <= _good_share(largest))])
    length = cycle_length * chosen
    return Leakage(chosen, tones, order_share(tones[:, None], monitored, length),
                   waveform_share(tones, length), candidates, largest)


def _good_share(largest_share: Array) -> float:
    """Return the largest share up to which numbers of cycles are equally good."""
    return max(_NOTCH, _AS_GOOD * float(np.min(largest_share)))


def _finite(name: str, values: ArrayLike) -> Array:
    numbers = np.asarray(values, float)
    if not np.all(np.isfinite(numbers)):
        raise ParameterError(f'{name} = {numbers.tolist()}: give finite numbers')
    return numbers
