"""
Synchronous averaging as a comb filter: what is left of tones that are not synchronous.

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
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sa_jitter_ros.errors import ParameterError

Array = NDArray[Any]

# Closer than this, an order counts as synchronous, a number of cycles as whole, a gain as equal.
_SAME = 1e-9


@dataclass(frozen=True)
class CycleChoice:
    """
    The number of trigger cycles that suppresses the interfering orders best, and its gain.

    `gain` is the largest share of an interfering tone's amplitude that is left (0: a perfect
    notch). `gains` holds it for all `candidates`, NaN where no fundamental cycle is whole.
    """

    trigger_cycles: int
    gain: float
    candidates: Array
    gains: Array


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


def order_response(
    tone_orders: ArrayLike, orders: ArrayLike, *, trigger_cycles: ArrayLike, ratio: float = 1.0,
) -> Array:
    """
    Return the complex response G of the amplitude at `orders` to exp(j 2 pi gamma theta).

    `tone_orders` gamma, `orders` and `trigger_cycles` broadcast; a trigger cycle is `ratio`
    fundamental cycles long. Raises ParameterError on numbers that are not finite and on lengths
    that are not positive.
    """
    cycles = _length(trigger_cycles, ratio) * (
        _finite('tone_orders', tone_orders) - _finite('orders', orders))
    return np.asarray(np.sinc(cycles) * np.exp(1j * np.pi * cycles))


def tone_gain(
    tone_orders: ArrayLike, orders: ArrayLike, *, trigger_cycles: ArrayLike, ratio: float = 1.0,
) -> Array:
    """
    Return how much of a real tone's amplitude the amplitude at `orders` shows at most.

    The worst phase of the tone adds its mirror image in full: abs(G(gamma, g)) + abs(G(-gamma,
    g)). Arguments and errors are those of `order_response`.
    """
    tones = np.asarray(tone_orders, float)
    direct, mirrored = (
        np.abs(order_response(sign * tones, orders, trigger_cycles=trigger_cycles, ratio=ratio))
        for sign in (1.0, -1.0))
    return np.asarray(direct + mirrored)


def choose_cycles(
    interfering_orders: ArrayLike, *, minimum: int, maximum: int, ratio: float = 1.0,
    orders: ArrayLike = (),
) -> CycleChoice:
    """
    Choose the number of trigger cycles, within bounds, that suppresses interfering orders best.

    Several `interfering_orders` count by the worst of them; give the ends of the range where one
    is known roughly only. With `orders`, the order amplitudes are protected (`tone_gain`);
    without, the waveform (`comb_response`). A trigger cycle is `ratio` fundamental cycles long;
    where an average does not hold a whole number of them, the waveform may have one fewer than
    fit in, and the worse case counts. Of equally good numbers the smallest is taken. Raises
    ParameterError on orders that are not positive, on bounds that are not 1 <= minimum <= maximum,
    on a waveform without whole cycles, and on an interfering order that no number of cycles
    removes: an integer one, or one of `orders`.
    """
    tones = np.ravel(_finite('interfering_orders', interfering_orders))
    protected = np.ravel(_finite('orders', orders))
    if tones.size == 0 or np.any(tones <= 0.0) or np.any(protected <= 0.0):
        raise ParameterError(f'interfering_orders = {tones.tolist()}, orders = '
                             f'{protected.tolist()}: give positive ones, one interfering at least')
    if not (1 <= minimum <= maximum and float(minimum).is_integer()
            and float(maximum).is_integer()):
        raise ParameterError(f'minimum = {minimum}, maximum = {maximum}: give whole numbers with '
                             '1 <= minimum <= maximum')
    synchronous = np.abs(tones[:, None] - (protected if protected.size
                                           else np.round(tones)[:, None])) < _SAME
    if synchronous.any():
        raise ParameterError(
            f'interfering order {tones[synchronous.any(axis=1)][0]:g} is synchronous with what '
            'is averaged: no number of cycles removes it')
    candidates = np.arange(int(minimum), int(maximum) + 1)
    if protected.size:
        gains = tone_gain(tones[:, None], protected, trigger_cycles=candidates[:, None, None],
                          ratio=ratio).max(axis=(1, 2))
    else:
        gains = _waveform_gains(tones, _length(candidates, ratio))
    best = np.flatnonzero(gains <= np.nanmin(gains) + _SAME)[0]
    return CycleChoice(int(candidates[best]), float(gains[best]), candidates, gains)


def _waveform_gains(tones: Array, lengths: Array) -> Array:
    """Return the worst gain of the waveform over tones, for averages of so many cycles."""
    most = np.floor(lengths + _SAME)
    fewest = np.where(lengths - most < _SAME, most, most - 1.0)
    if not np.any(fewest >= 1.0):
        raise ParameterError(
            f'an average of {lengths[-1]:g} fundamental cycles may hold no whole one: raise '
            'maximum, or give the orders whose amplitudes matter')
    gains = np.maximum(*(
        np.abs(comb_response(tones, np.maximum(count, 1.0)[:, None])).max(axis=1)
        for count in (most, fewest)))
    return np.where(fewest >= 1.0, gains, np.nan)


def _finite(name: str, values: ArrayLike) -> Array:
    numbers = np.asarray(values, float)
    if not np.all(np.isfinite(numbers)):
        raise ParameterError(f'{name} = {numbers.tolist()}: give finite numbers')
    return numbers


def _length(trigger_cycles: ArrayLike, ratio: float) -> Array:
    """Return the fundamental cycles in so many trigger cycles."""
    cycles = np.asarray(_finite('trigger_cycles', trigger_cycles) * _finite('ratio', ratio))
    if not (np.all(cycles > 0.0) and ratio > 0.0):
        raise ParameterError(f'ratio = {ratio}, trigger_cycles x ratio = {cycles.tolist()}: give '
                             'positive numbers')
    return cycles
