# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""What the findings of a check cost at each order, in words that say what to do."""

from collections.abc import Mapping, Sequence
import math
from typing import Any

import numpy as np
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.effects.library import predict
from sa_jitter_ros.errors import SaJitterError
from sa_jitter_ros.keyphasor_check.clock import is_decimal
from sa_jitter_ros.keyphasor_check.marks import FittedPulses
from sa_jitter_ros.keyphasor_check.result import Checked, Warn
from sa_jitter_ros.keyphasor_check.teeth import number_pulses
from sa_jitter_ros.keyphasor_check.wheel import patterns

Losses = tuple[FloatArray, FloatArray]

#: Orders of which costs are given where none was found.
NO_ORDERS = (1.0, 10.0, 100.0)
_CYCLES = 40  # in the average whose loss is given
_MANY_STRAYS = 0.2
_CLEAR_MARK = 5.0  # standard errors
_VISIBLE, _INVISIBLE = 1e-3, 1e-6  # loss
_UNSTEADY = 0.005  # loss
# Marks that show the motion within a revolution; the loss from which on trigger cycles from mark
# to mark are proposed, and the part of it that they may leave.
_SEVERAL, _DEAR, _SAVED = 4, 0.01, 0.3
_MEMORY = 0.2
# Angle ahead of that of a steady speed, in parts of the change of the speed, within a cycle.
_BEND = 0.5 * np.linspace(0.0, 1.0, 17) * np.linspace(1.0, 0.0, 17)
_HALF = 40  # pulses in which a pattern can be seen
_MOST_PULSES = 5000
_CLEAR_PATTERN, _CERTAIN_PATTERN = 10.0, 40.0


def costs(findings: Mapping[str, Checked], fitted: FittedPulses, times: FloatArray,
          orders: Sequence[float], from_marks: Losses | None) -> list[Warn]:
    """
    Return the warnings that findings call for, with the loss in percent at each order.

    `fitted` are the pulses `times` (n,) in s on their target; `from_marks` is what `by_marks`
    returns.
    """
    ratio = float(findings['ratio'].value or 1.0)
    return [*_of_pulses(fitted, orders), *_of_marks(fitted, ratio, orders),
            *_of_jitter(findings, ratio, orders),
            *_of_speed(fitted, ratio, orders, from_marks, findings['jitter_std'].value or 0.0),
            *_of_changes(np.unique(times))]


def _of_pulses(fitted: FittedPulses, orders: Sequence[float]) -> list[Warn]:
    """Return what strays and lost pulses cost where each spoils a revolution."""
    turns = max(fitted.turns, 1.0)
    strays, lost, total = fitted.spurious.size, fitted.lost.size, fitted.true.size
    found = []
    if strays:
        many = ('. So many were not understood: look at the figure'
                if strays > _MANY_STRAYS * total else '')
        found.append(Warn(
            'spurious', f'{strays} of {total + strays} pulses belong to no mark: raise hysteresis '
            'or threshold, and shield the sensor; each takes a revolution from the average where '
            f'the validation cannot tell it from the true pulse{many}',
            _percent(orders, [min(strays / turns, 1.0)] * len(orders))))
    if lost:
        found.append(Warn(
            'missing', f'{lost} marks have no pulse: lower the hysteresis or the distance of the '
            'sensor, and set maximum_discarded, so that only the revolutions without a pulse are '
            'lost', _percent(orders, [min(lost / turns, 1.0)] * len(orders))))
    return found


def _of_marks(fitted: FittedPulses, ratio: float, orders: Sequence[float]) -> list[Warn]:
    pattern = fitted.pattern
    with np.errstate(invalid='ignore', divide='ignore'):
        clear = np.abs(pattern.marks / pattern.errors)
    if pattern.teeth < 2 or not np.nanmax(clear, initial=0.0) > _CLEAR_MARK:
        return []
    late = pattern.marks / pattern.teeth  # revolutions
    loss = _of_errors(late, ratio, orders).tolist()
    if max(loss) < _INVISIBLE:
        return []
    worst = int(np.argmax(np.abs(pattern.marks)))
    return [Warn(
        'uneven_marks', f'the marks stand unevenly, mark {worst} by {360.0 * late[worst]:.3g} '
        'degrees: begin trigger cycles at one mark only (pulses_per_trigger 0), or give the marks '
        'as target_angles; the loss is that of trigger cycles from mark to mark',
        _percent(orders, loss))]


def _of_jitter(findings: Mapping[str, Checked], ratio: float, orders: Sequence[float]
               ) -> list[Warn]:
    speed = findings['speed'].value['mean']
    clock, memory = findings['clock_rate'], findings['jitter_correlation']
    std = findings['jitter_std'].value
    common: dict[str, Any] = {'trigger_speed': speed, 'trigger_cycles': _CYCLES, 'ratio': ratio,
                              'orders': list(orders)}
    found = []
    if clock.value and not is_decimal(clock.value):
        loss = _loss(keyphasor_rate=clock.value, **common)
        if max(loss) > _VISIBLE and 'multiples' in clock.decided_by:
            found.append(Warn(
                'quantised', f'pulse times are multiples of {1e6 / clock.value:.4g} us, the clock '
                f'of {clock.value:.6g} Hz: sample the keyphasor faster, or set correct_jitter and '
                'keyphasor_rate', _percent(orders, loss)))
    if std:
        loss = _loss(keyphasor_rate=1.0 / (math.sqrt(12.0) * std), jitter_std=std,
                     jitter_distribution='normal', **common)
        if max(loss) > _VISIBLE:
            found.append(Warn('jitter', f'pulses scatter by {1e6 * std:.3g} us: set '
                              'correct_jitter', _percent(orders, loss)))
    if memory.value is not None and (
            abs(memory.value) > max(4.0 * float(memory.standard_error), _MEMORY)):
        found.append(Warn(
            'jitter_memory', f'neighbouring pulse errors are correlated by {memory.value:.2f}: '
            'declare the effect correlated_jitter, or look for a beat of the clock with the '
            'speed'))
    return found


def by_marks(fitted: FittedPulses, ratio: float, orders: Sequence[float]) -> Losses | None:
    """
    Return the losses (order,) of trigger cycles of a revolution, and of those from mark to mark.

    None where trigger cycles from mark to mark save too little over the quadratic angle law to be
    proposed, or with few marks.
    """
    if fitted.pattern.present < _SEVERAL:
        return None
    turn, parabola = (_of_errors(error, ratio, orders) for error in fitted.within_turns)
    steady = _steady_change(np.diff(fitted.true) / np.diff(fitted.numbers))
    mark = _of_errors(np.multiply.outer(steady / fitted.pattern.teeth, _BEND), ratio, orders)
    dear = max(parabola) > _DEAR and max(mark) < _SAVED * max(parabola)
    return (turn, mark) if dear else None


def _steady_change(values: FloatArray) -> FloatArray:
    """Return relative changes of speeds or periods; pulse errors make others, to and fro."""
    change = np.diff(values) / values[1:]
    return np.asarray(0.5 * (change[1:] + change[:-1]))


def _of_errors(error: FloatArray, ratio: float, orders: Sequence[float]) -> FloatArray:
    """Return the losses (order,) by errors of the angle in revolutions."""
    return np.array([1.0 - abs(np.mean(np.exp(2j * math.pi * g * ratio * error)))
                     if error.size else 0.0 for g in orders])


def _of_speed(fitted: FittedPulses, ratio: float, orders: Sequence[float],
              from_marks: Losses | None, jitter: float = 0.0) -> list[Warn]:
    """Return what a speed costs that changes within a revolution, with the linear angle law."""
    if from_marks is not None:
        turn, mark = from_marks
        return [Warn(
            'unsteady_speed', 'the speed changes within a revolution: set pulses_per_trigger to '
            '1, so that trigger cycles go from mark to mark; no order here then loses more than '
            f'{100.0 * max(mark):.2g} % by it, whatever the angle_law',
            _percent(orders, turn.tolist()))]
    steady = _steady_change(fitted.speed[::max(1, fitted.pattern.present)])
    # Each change holds half of four pulse errors (s): as much is not of the speed.
    size, noise = math.sqrt(steady @ steady / max(steady.size, 1)), fitted.mean_speed * jitter
    steady *= math.sqrt(1.0 - (noise / size)**2) if size > noise else 0.0
    loss = _of_errors(np.multiply.outer(steady, _BEND), ratio, orders)
    if max(loss) < _UNSTEADY:
        return []
    return [Warn(
        'unsteady_speed', f'the speed changes by {100.0 * float(np.std(steady)):.2g} % from '
        'revolution to revolution: set angle_law to quadratic or spline, or use more marks a '
        'revolution', _percent(orders, loss.tolist()))]


def _of_changes(times: FloatArray) -> list[Warn]:
    """Return whether both halves of the pulses show different targets."""
    half = int(np.searchsorted(times, 0.5 * (times[0] + times[-1])))
    if min(half, times.size - half) < _HALF:
        return []
    best = [next(iter(patterns(number_pulses(part))), None)
            for part in (times[:half][:_MOST_PULSES], times[half:][-_MOST_PULSES:])]
    evidence = [0.0 if item is None else item.evidence for item in best]
    one, other = best
    if one is not None and other is not None:
        if one.teeth == other.teeth:
            same = bool(np.array_equal(one.missing, other.missing))
        else:  # one half may show part of the pattern only
            same = not (one.missing.any() or other.missing.any()) and (
                one.teeth % other.teeth == 0 or other.teeth % one.teeth == 0)
    else:
        same = max(evidence) < _CERTAIN_PATTERN
    if same or (min(evidence) < _CLEAR_PATTERN and max(evidence) < _CERTAIN_PATTERN):
        return []
    names = ['even marks' if item is None else f'{item.teeth} teeth, {item.teeth - item.present} '
             'of them missing' for item in best]
    return [Warn(
        'pattern_changes', f'the target looks like {names[0]} before {times[half]:.6g} s, and '
        f'like {names[1]}{" elsewhere" * (names[0] == names[1])} behind it: check whether two '
        'recordings were joined, or a mark came off')]


def _percent(orders: Sequence[float], loss: Sequence[float]) -> tuple[tuple[float, float], ...]:
    return tuple((g, 100.0 * float(each)) for g, each in zip(orders, loss))


def _loss(**declared: Any) -> list[float]:
    try:
        return [float(value) for value in predict(**declared).loss]
    except SaJitterError:  # pulses would swap: nothing is left
        return [1.0] * len(declared['orders'])
