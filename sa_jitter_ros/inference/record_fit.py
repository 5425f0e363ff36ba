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
The record fit: pulse errors and all lines of a whole recording in one least-squares problem.

Steps of the states of its cycles (`cycle_states`) and a search for lines (`line_search`) take
turns, until there is nothing new.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
import math

import numpy as np
from sa_jitter_ros.arrays import Array, BoolArray, ComplexArray
from sa_jitter_ros.effects.effect import ODDS
from sa_jitter_ros.effects.timing import ROUNDING
from sa_jitter_ros.inference.cycle_states import States
from sa_jitter_ros.inference.line_search import (
    add_lines, fit_lines, follow_trend, let_stand, new_lines, prune, refine)
from sa_jitter_ros.inference.order_band import band_end, OrderBand
from sa_jitter_ros.inference.slips import mend_slips
from scipy.special import gammaincc

#: Steps that a search may take, and what its last one may change, in standard errors.
MOST_STEPS, _SETTLED = 20, 0.1
# The last fit expects pulse errors that are so many times as large as they, or their standard
# errors, are, so that they are hardly shrunk.
_WEAK = 3.0


@dataclass(frozen=True)
class RecordFit:
    """
    Pulse errors and lines of a stretch of a recording.

    `errors` and `standard_errors` (pulse,) in s, measured minus true, less the turn of all lines
    that leaves their mean 0;
    `roughness` (s) is the RMS of what their second differences are wrong by. `bends` (cycle, 2)
    are the factors of u (1 - u) and of u (1 - u) (2 u - 1) in the error inside a cycle (s),
    `bend_standard_errors` (2,) their standard errors, infinite where the vibration tells nothing
    of them. `orders` (order,), the first of them `declared`, and `tones` (tone,) in Hz are the
    lines; `amplitudes` (channel, line) complex peak amplitudes of orders, and tones after them;
    `amplitude_errors` (channel, line) the standard errors of their real and imaginary parts.
    `synchronous` (line,) tells which of them turn with the shafts: orders that shafts must have,
    those that a varying speed shows to turn, and sidebands of several lines. `jitter_std` (s) is
    the estimated size of the pulse errors; `expected_std` (3,) in s are the sizes of errors and
    bends that the fit expected, towards 0, the errors towards a line that grows by `trend` s in a
    second. Declared lines that stand out of the noise have `held` the angle to the pulses: others
    go along with any drift.
    """

    errors: Array
    standard_errors: Array
    roughness: float
    bends: Array
    bend_standard_errors: Array
    declared: int
    orders: Array
    tones: Array
    amplitudes: ComplexArray
    amplitude_errors: Array
    synchronous: BoolArray
    jitter_std: float
    expected_std: Array
    trend: float
    held: bool


class OpenRecord:
    """
    What all fits of a stretch of a recording have in common: its band, and where they begin.

    The declared lines are in the vibration where it `stands` together from cycle to cycle.
    """

    def __init__(self, samples: Array, sample_rate: float, start_time: float, times: Array, *,
                 measured: BoolArray, cycle_length: float, orders: Sequence[float],
                 jitter_std: float, top: float | None = None, trend: float = 0.0) -> None:
        """
        Read the band that ends at order `top`, or little beyond the highest one.

        `samples` (sample, channel) begin at `start_time` (s); `times` (pulse,) are consecutive
        trigger pulses, of which some are `measured` (pulse,) and the others were put in evenly.
        `cycle_length` is r; `jitter_std` (s) the declared size of the pulse errors. They are
        expected to grow by `trend` s in a second, as elsewhere in the recording.
        """
        top = top or band_end(times, sample_rate, cycle_length, orders, 1.0)
        band = OrderBand.below(top * cycle_length, samples, sample_rate, start_time, times)
        self._begin = States(
            band, times, measured, cycle_length, np.array(orders), top, jitter_std)
        self._false_alarm, self.stands = follow_trend(self._begin, trend)

    def fit(self, known: tuple[Array, Array] | None = None) -> RecordFit:
        """
        Fit the stretch.

        `known` are undeclared orders, and tones (Hz), of an earlier fit; then none is looked for.
        Others are looked for beside declared lines that stand: without these, nothing is known.
        """
        states = copy(self._begin)
        states.size = states.size.copy()
        fit_lines(states)
        if known is None and not self.stands:
            return _unknown(states)
        _search(states, known)
        states.converged = True
        _settle(states)
        return _result(states, self._false_alarm)


def _unknown(states: States) -> RecordFit:
    """Return the fit of lines that do not stand: errors are as large as was expected."""
    size, pulses, lines = states.size[:3], states.times.size, states.amplitudes
    return RecordFit(
        np.zeros(pulses), np.full(pulses, size[0]), math.sqrt(6.0) * size[0],
        np.zeros((pulses - 1, 2)), np.full(2, np.inf), states.declared, states.orders,
        states.tones, lines, np.full(lines.shape, np.inf), states.synchronous, float(size[0]),
        size, states.trend, held=False)


def _settle(states: States) -> None:
    """Do steps until the pulse errors hardly change: what they leave are lines, and no bends."""
    for _ in range(MOST_STEPS):
        if states.step() < _SETTLED * states.size[0] * np.sqrt(1.0 - states.resolved[0]):
            break


def _search(states: States, known: tuple[Array, Array] | None) -> None:
    """
    Fit states and lines by turns until no line is found any more.

    Lines that are `known` come after steps, too: high ones follow a trend that the declared ones
    have shown. Slips are mended as long as the lines fit better by it.
    """
    look, lines, before = known is None, known or ((), ()), -math.inf
    while True:
        _settle(states)
        (orders, tones), lines = new_lines(states) if look else lines, ((), ())
        if len(orders) or len(tones):
            add_lines(states, orders, tones)
            if look:
                refine(states)
                let_stand(states, fit_lines(states), searching=True)
        else:
            likelihood = 0.5 * states.whole.sum() * states.u.size * float(
                np.sum(np.log(states.weight)))
            if likelihood < before + ODDS or not mend_slips(states):
                break
            before = likelihood
    if look:
        let_stand(states, prune(states), searching=False)
        for _ in range(MOST_STEPS):  # each 0.6 of the one before where an order is near
            moved = refine(states)
            fit_lines(states)
            states.step()
            if moved < _SETTLED:
                break
        prune(states)


def _result(states: States, false_alarm: float) -> RecordFit:
    """
    Return the fit, pulse errors and bends as good as unshrunk.

    Declared lines stand out of the noise where it is as strong in fewer than `false_alarm` cases.
    """
    variance = states.variance(0)
    weak = _WEAK * max(1.0, float(np.sqrt(variance / states.resolved[0]) / states.size[0]))
    states.step(weak=_WEAK)
    states.step(weak=weak, move=False)
    errors = states.states[:, 0] + states.change
    errors -= states.common_turn * errors[states.measured].mean()
    bends, bend_errors = states.states[:-1, 1:3].copy(), np.full(2, np.inf)
    for i in range(2):
        variance = states.variance(1 + i)
        kept = 1.0 - variance / states.size[1 + i] ** 2  # not shrunk
        if kept > ROUNDING:
            bends[:, i] /= kept
            bend_errors[i] = np.sqrt(variance / kept)
    variances = states.amplitude_variances()
    shown = (np.abs(states.amplitudes) ** 2 / variances)[:, :states.declared]
    return RecordFit(
        errors, np.sqrt(states.variances(0)), _roughness(states), bends, bend_errors,
        states.declared, states.orders, states.tones, states.amplitudes, np.sqrt(variances),
        states.synchronous,
        float(states.size[0]), states.size[:3] * np.array([weak, 1.0, 1.0]), states.trend,
        bool(gammaincc(shown.size, 0.5 * shown.sum()) < false_alarm))


def _roughness(states: States) -> float:
    """Return the RMS of what second differences of the pulse errors are wrong by, of some."""
    chosen = np.arange(0, states.times.size - 2, math.isqrt(states.times.size))
    unit = np.zeros((states.times.size, chosen.size))
    whole = np.ones(chosen.size, np.bool_)
    for place, factor in zip((chosen, chosen + 1, chosen + 2), (1.0, -2.0, 1.0)):
        unit[place, np.arange(chosen.size)] = factor * states.solved.scale[place, 0]
        whole &= states.measured[place]
    variance = np.sum(unit * states.solved.of_errors(unit), axis=0)
    return float(np.sqrt(variance @ whole / max(whole.sum(), 1)))
