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
The search for undeclared lines in what the record fit leaves.

Undeclared orders of other shafts and sidebands leak into trigger cycles that are too short to keep
them apart, and would be taken for pulse errors. So the fit looks for them in the spectrum of what
it leaves, over angle (orders) and over time (tones): the sharper peak decides which it is.
"""

from collections.abc import Sequence
import math

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.arrays import Array, BoolArray, ComplexArray
from sa_jitter_ros.averaging.spectral_lines import (
    FALSE, line_limit, peaks, spectrum, top_between)
from sa_jitter_ros.effects.clock_skew import USUAL_SKEW
from sa_jitter_ros.effects.effect import ODDS
from sa_jitter_ros.effects.path_delay import USUAL_DELAY
from sa_jitter_ros.inference.cycle_states import States
from sa_jitter_ros.prediction.influence import trigger_periods
from sa_jitter_ros.pulses.resampling import interpolate
from scipy.fft import fft, next_fast_len
from scipy.special import gammaincc

_MOST_LINES = 60  # undeclared ones
# A line is not far below the strongest, which may leave images of itself.
_SHARE = 0.3
_HANN = 1.5  # bins of noise in one of the window
_MISSED = 1e-3  # share of the power of a tone that the frequencies tried for it may miss
_SHARPER = 1.3  # in power, over angle than over time or the reverse
_FEWEST_SIDES = 3  # lines as far from declared ones that show a shaft
#: Bins between lines, or cycles in a stretch between waves, that are told apart.
APART = 1.5
_FINE = 0.3  # bins between frequencies that are tried
_SKIRT = 24  # bins beside a line that it may share with others
_SLOPE_GAIN = 0.7
_SLOPE_LINES = 0.7  # share of the declared lines that must stand out of the noise with a slope


def follow_trend(states: States, expected: float) -> tuple[float, bool]:
    """
    Start from the slope of the errors, or the delay, that keeps the declared lines together.

    A clock that is fast or slow, or a wrong ratio, makes a slope, and a delay errors that follow
    the speed. The slope is the `expected` one where nothing else is clearly better. Returned are
    the chance that counts, as many were tried, and whether the lines are together by less.
    """
    pace = states.cycle_length / trigger_periods(states.times)
    since = states.times - states.times[0]
    states.make_tables()
    each = np.stack([states.sums(row) for row in states.vibration]).conj()
    each *= np.exp(-2j * np.pi * expected * np.outer((pace * since)[:-1], states.orders))
    count, best = 1, _SLOPE_GAIN * states.declared
    slope, errors = expected, expected * since
    for moved, most in (since, USUAL_SKEW), (np.ones(since.size), USUAL_DELAY):
        most_turns = states.orders.max() * float(np.ptp(pace * moved))
        if most * most_turns < _FINE:
            continue
        places = int(most * most_turns / _FINE)
        tried = _FINE / most_turns * np.arange(-places, places + 1)
        power = np.array([_coherence(each[:, :, g], order * (pace * moved)[:-1], tried)
                          for g, order in enumerate(states.orders)])
        score = np.sum(np.log(1e-3 * power.max() + power), axis=0)
        top = int(np.argmax(score))
        chance = gammaincc(len(each), power[:, top])
        gained = score[top] - score[places]
        if gained > best and np.mean(chance < FALSE / tried.size) > _SLOPE_LINES:
            best, errors = gained, expected * since + tried[top] * moved
            slope = expected + tried[top] * (moved is since)
        count += tried.size
    states.trend = float(slope)
    states.by_speed = errors - errors.mean() * states.common_turn - slope * states.ramp
    states.states[:, 0] = states.no_jitter
    states.read()
    each *= np.exp(-2j * np.pi * np.outer((pace * (errors - expected * since))[:-1],
                                          states.orders))
    together = np.abs(each.sum(axis=1)) ** 2 / np.maximum(
        np.sum(np.abs(each) ** 2, axis=1), np.finfo(np.float64).tiny)
    rare = FALSE / count
    return rare, bool(gammaincc(together.size, together.sum()) < rare)


def _coherence(each: ComplexArray, turns: Array, tried: Array) -> Array:
    """
    Return the power, over its mean, of a line in all cycles together for errors of sizes `tried`.

    `each` (channel, cycle) are its amplitudes, which errors of size 1 turn by `turns` (cycle,).
    """
    cell = _FINE / float(tried[-1])
    place = ((turns - turns.min()) / cell).astype(int)
    size = next_fast_len(int((place.max() + 1) / _FINE) + 1)
    at = np.rint(tried * cell * size).astype(int) % size
    total = np.zeros(tried.size)
    for row in each:
        cells = np.bincount(place, row.real) + 1j * np.bincount(place, row.imag)
        total += np.abs(fft(cells, size)[at]) ** 2 / max(
            float(np.sum(np.abs(row) ** 2)), np.finfo(np.float64).tiny)
    return total


def new_lines(states: States) -> tuple[list[float], list[float]]:
    """Return orders, and tones in Hz, that stand out of the residual; some if too many do."""
    states.make_tables()
    span = states.cycle_length * states.transformed
    residual = states.residual()[:, :states.transformed]
    flat = np.ascontiguousarray(residual.reshape(len(residual), -1).T)
    time = states.place[:states.transformed].ravel()
    duration = float(time[-1] - time[0])
    at = np.interp(np.linspace(time[0], time[-1], time.size), time, np.arange(time.size))
    even = interpolate(flat, np.clip(at, 0.0, time.size - 1.0))
    size = np.sqrt(np.mean(states.vibration**2, axis=(1, 2)))
    over_angle, over_time = (spectrum(item, span, size) for item in (flat, even))
    limit = line_limit(flat.shape[1], len(over_angle[0]))
    found: list[tuple[float, float, bool]] = []
    for tone, (ratio, power), (_, other) in ((False, over_angle, over_time),
                                             (True, over_time, over_angle)):
        for peak, place in zip(*peaks(ratio, limit)):
            near = other[max(peak - 8, 0):peak + 9].max()
            if 3 < peak < states.highest * span and (
                    power[peak] > near * (_SHARPER if tone else 1.0 / _SHARPER)):
                found.append((power[peak], place / (duration if tone else span), tone))
    found.sort(reverse=True)
    orders: list[float] = []
    tones: list[float] = []
    room = _MOST_LINES - states.amplitudes[0, states.declared:].size
    least_power = 0.0
    for size, place, tone in found:
        if size < least_power or len(orders) + len(tones) >= room:
            break
        taken = np.append(states.orders, orders)
        if tone:
            taken = np.append(taken * states.frequency, [*states.tones, *tones])
        if np.abs(taken - place).min() * (duration if tone else span) >= APART:
            (tones if tone else orders).append(float(place))
            least_power = least_power or _SHARE * size
    return [*orders, *_partners(states, orders, room - len(tones))], tones


def _partners(states: States, orders: Sequence[float], room: int) -> list[float]:
    """
    Return lines as far from other declared ones as new undeclared orders, on either side.

    Pulse errors that swing as fast, or at an alias, make lines at all these places. So they take
    the sidebands of a modulation for theirs, unless all have their own amplitudes from the start.
    With the `orders` they are `room` at most.
    """
    declared, found = states.orders[:states.declared], list(orders)
    offset = np.abs(nearest_orders(np.array(orders), declared)[1])
    offset = offset[(offset * states.span > _SKIRT) & (offset < 1.0 / states.cycle_length)]
    for line in (offset[:, None, None] * [[-1.0], [1.0]] + declared).ravel().tolist():
        near = np.abs(np.append(states.orders, [0.0, *found]) - line).min() * states.span
        if 0.0 < line < states.highest and near > APART and len(found) < room:
            found.append(line)
    return found[len(orders):]


def least_seen(samples: float, channels: int) -> float:
    """Return the least amplitude of a line on all channels that is found, over its error."""
    return float(np.sqrt(2.0 * _HANN * line_limit(channels, samples) / channels))


def add_lines(states: States, orders: Sequence[float] | Array,
              tones: Sequence[float] | Array) -> None:
    """Add undeclared lines, and fit all."""
    states.orders = np.append(states.orders, orders)
    states.tones = np.append(states.tones, tones)
    fit_lines(states)


def refine(states: States) -> float:
    """
    Move each undeclared line to where the residual has nothing left of it.

    The declared lines alone tell how fast the angle runs; those that may move do not. What a
    line moves by at most is returned in standard errors.
    """
    states.make_tables()
    residual = states.residual()
    cycle = np.arange(states.times.size - 1) - 0.5 * (states.times.size - 1)
    angle = states.cycle_length * (cycle[:, None] + states.u)
    time = states.place - states.place.mean()
    count = states.orders.size
    top, bottom = np.zeros(states.amplitudes.shape[1]), np.zeros(states.amplitudes.shape[1])
    for c, (weight, row) in enumerate(zip(states.weight, states.amplitudes)):
        moved = np.append(states.sums(angle * residual[c])[:, :count].sum(axis=0),
                          states.sums(time * residual[c])[:, count:].sum(axis=0))
        top += weight * np.real(2j * np.pi * row * moved)
        bottom += weight * 2.0 * np.pi**2 * np.abs(row) ** 2
    curves = [float(np.sum(x**2 * states.whole[:, None])) for x in (angle, time)]
    most_of = [0.5 / float(np.ptp(x)) for x in (angle, time)]
    declared = states.orders[:states.declared]
    stretch = float(top[:states.declared] @ declared) / max(
        float(bottom[:states.declared] @ declared**2) * curves[0], np.finfo(np.float64).tiny)
    most_stretched = most_of[0] / declared.max()
    stretch = min(max(stretch, -most_stretched), most_stretched)
    furthest = 0.0
    for chosen, curve, most in zip((slice(states.declared, count), slice(count, None)), curves,
                                   most_of):
        with np.errstate(divide='ignore', invalid='ignore'):
            step = np.nan_to_num(top[chosen] / (bottom[chosen] * curve), posinf=0.0,
                                 neginf=0.0).clip(-most, most)
        lines = states.orders[states.declared:] if chosen.stop else states.tones
        lines += step
        in_errors = np.abs(step) * np.sqrt(bottom[chosen] * curve)
        furthest = max(furthest, float(in_errors.max(initial=0.0)))
    states.orders[states.declared:] *= 1.0 - stretch
    states.states[:, 0] += stretch * states.ramp
    states.trend += stretch
    states.read()
    return furthest


def prune(states: States) -> tuple[Array, Array, Array]:
    """
    Take out undeclared lines whose amplitudes are noise; return `both_ways` of the others.

    On a mean channel, the others are more likely than none by the odds against a line.
    """
    lines = states.amplitudes.shape[1]
    power = np.abs(states.amplitudes) ** 2 / states.amplitude_variances()
    kept = (np.arange(lines) < states.declared) | (power.mean(axis=0) > 2.0 * ODDS)
    orders, tones = np.split(kept, [states.orders.size])
    states.orders, states.tones = states.orders[orders], states.tones[tones]
    return fit_lines(states)


def nearest_orders(lines: Array, declared: Array) -> tuple[NDArray[np.intp], Array]:
    """Return which `declared` order is nearest to each line (line,), and how far that is above."""
    apart = lines[:, None] - declared
    near = np.argmin(np.abs(apart), axis=1)
    return near, apart[np.arange(near.size), near]


def _synchronous(states: States, ways: tuple[Array, Array, Array]) -> tuple[BoolArray, BoolArray]:
    """
    Tell which orders, and tones after them (line,), turn with the shafts, and which may.

    Shafts must have whole orders and the lines of the trigger cycle. Others have more power
    over angle than any tone near them over time. Sidebands turn with those as far from
    declared lines or 0; on a steady machine, several show a shaft. Lines that stand alone may
    turn, but not several side by side, as a machine makes them whose own speed varies.
    """
    lines = np.append(states.orders, states.tones / states.frequency)
    declared, others = np.split(lines, [states.declared])
    least, r = APART / states.span, states.cycle_length
    exact = np.minimum(np.abs(others - np.rint(others)),
                       np.abs(others * r - np.rint(others * r)) / r) < least
    apart = others[:, None] - declared
    near, offset = nearest_orders(others, declared)
    distance = np.stack([np.abs(offset), others], axis=1)
    alike = np.abs(distance[:, None, :, None] - distance[:, None, :]).min(axis=(2, 3)) < least
    known = exact & (np.arange(others.size) < states.orders.size - states.declared)
    for size in np.unique(np.abs(offset)).tolist():
        beside = np.abs(np.abs(offset) - size) < least
        sides = {*zip(near[beside].tolist(), (offset[beside] < 0.0).tolist())}
        if len(sides) >= _FEWEST_SIDES:
            known |= np.any(np.abs(np.abs(apart) - size) < least, axis=1)
            known |= np.abs(others - size) < least
    over_angle, over_time, _ = ways
    none = np.zeros(states.tones.size, np.bool_)
    sharper = np.append(over_angle > (1.0 + _MISSED) * over_time + ODDS, none)
    stands = np.append(over_time > over_angle + ODDS, ~none)
    close = np.abs(others[:, None] - others) * states.span < _SKIRT
    alone = (np.count_nonzero(close, axis=1) < 2) | (np.abs(offset) * states.span < _SKIRT)
    alone &= ~stands
    own = np.ones(states.declared, np.bool_)
    synchronous, movable = (np.append(own, np.any(alike & found, axis=1) | found)
                            for found in (known | sharper, known | alone))
    return synchronous, movable


def fit_lines(states: States) -> tuple[Array, Array, Array]:
    """Fit the amplitudes of all lines, and tell which of them turn; return `both_ways`."""
    states.fit_amplitudes()
    ways = both_ways(states)
    states.synchronous, states.movable = _synchronous(states, ways)
    return ways


def let_stand(states: States, ways: tuple[Array, Array, Array], *, searching: bool) -> None:
    """
    Make tones of the undeclared orders that are better over time than over angle, by `both_ways`.

    Parts of a tone are taken out. While others are looked for, when `searching`, it takes one
    that is new and certain.
    """
    over_angle, over_time, tones = ways
    standing = over_time > over_angle + searching * ODDS
    standing &= ~states.synchronous[states.declared:states.orders.size]
    apart, new = APART / float(np.ptp(states.place)), states.tones
    for i in np.flatnonzero(standing)[np.argsort(-over_time[standing])].tolist():
        if np.all(np.abs(new - tones[i]) > apart):  # else a part of the same
            new = np.append(new, tones[i])
    if not standing.any() or (searching and new.size == states.tones.size):
        return
    states.orders = states.orders[np.append(np.ones(states.declared, np.bool_), ~standing)]
    states.tones = new
    fit_lines(states)
    states.step()


def both_ways(states: States) -> tuple[Array, Array, Array]:
    """
    Return the gain in log likelihood of undeclared orders, of tones near them, and these.

    Either is to explain what the undeclared orders close to it do, too: a line that stands while
    the speed varies makes several of them.
    """
    states.make_tables()
    residual = states.residual()
    middle = states.place.mean(axis=1)
    angle = states.cycle_length * (np.arange(states.times.size - 1) + 0.5)
    reach = math.ceil(1.0 / _FINE)
    step = _FINE / float(np.ptp(middle))
    tried = np.exp(-2j * np.pi * step * np.arange(-reach, reach + 1)[:, None] * middle)
    count = states.orders.size - states.declared
    over_angle, over_time, tones = np.zeros((3, count))
    sums = np.stack([states.sums(item) for item in residual])
    weights = states.weight / (states.whole.sum() * states.u.size)
    own = np.arange(states.declared, states.orders.size)
    for k, i in enumerate(own):
        near = own[np.abs(states.orders[own] - states.orders[i]) * states.span < _SKIRT]
        waves, turn = states.wave[near], states.turn[:, i]
        parts = states.amplitudes[:, None, near] * states.turn[:, near]  # (channel, cycle, line)
        alone = 0.5 * turn * (parts @ (waves @ states.wave[i])
                              + parts.conj() @ (waves.conj() @ states.wave[i]))
        each = (sums[:, :, i] + alone).conj()
        over_angle[k] = weights @ np.abs(each.sum(axis=1)) ** 2
        away = states.orders[i] * (angle - states.frequency * middle)
        beside = each * np.exp(2j * np.pi * away)
        found = np.abs(tried @ beside.T) ** 2 @ weights
        best = int(np.argmax(found))
        near = np.log(found[best - 1:best + 2])
        off = step * (best - reach + (float(top_between(near)) if near.size == 3 else 0.0))
        over_time[k] = weights @ np.abs(beside @ np.exp(-2j * np.pi * off * middle)) ** 2
        tones[k] = states.orders[i] * states.frequency + off
    return over_angle, over_time, tones
