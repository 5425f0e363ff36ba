# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""What trigger cycles of a revolution lose where marks inside it come early or late each time."""

import numpy as np
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.averaging.average import AverageSettings

_FEWEST = 4  # marks that show the motion inside a revolution, and revolutions
_LOSS = 0.01  # of an amplitude, from which on it is said
_WHOLE = 0.02  # part of a revolution, by which its neighbours may differ
# Standard error of a median over that of a mean; power of a pattern over that of its errors, which
# the jitter of the first mark gives to all others alike.
_MEDIAN_ERROR, _CLEAR = 1.25, 9.0


def lost_inside_revolutions(pulses: FloatArray, settings: AverageSettings,
                            pulses_per_revolution: int, missing_teeth: int) -> str:
    """
    Say which order a pattern of the pulses (pulse,) that each revolution repeats attenuates most.

    Returns '' where trigger cycles are no revolutions or their average keeps 99 % of each order,
    where marks or revolutions are fewer than four, where less than half of the revolutions take as
    long as the others, or where the jitter of the pulses leaves such a pattern by chance.
    """
    marks, orders = pulses_per_revolution - missing_teeth, settings.orders
    count = (pulses.size - 1) // max(marks, 1)
    if min(marks, count) < _FEWEST or settings.revolutions_per_trigger != 1.0 or not orders:
        return ''
    turns = pulses[:count * marks].reshape(count, marks)
    period = np.diff(pulses[:count * marks + 1:marks])
    steady = np.abs(period / np.median(period) - 1.0) < _WHOLE
    if 2 * np.count_nonzero(steady) < count:
        return ''
    part = (turns - turns[:, :1]) / period[:, None]
    pitch = np.diff(np.median(part[steady], axis=0), append=1.0)
    nominal = np.ones(marks) / pulses_per_revolution
    for _ in range(missing_teeth):
        nominal[np.argmax(pitch / nominal)] += 1.0 / pulses_per_revolution
    off = np.cumsum(pitch - nominal)
    error = _MEDIAN_ERROR * np.std(part[steady], axis=0) / np.sqrt(np.count_nonzero(steady))
    if off @ off < _CLEAR * (error @ error):  # jitter leaves as much
        return ''
    angle = 2j * np.pi * settings.cycle_length * np.array(orders)[:, None]
    turn, place = angle * off, 2.0 * angle * np.cumsum(nominal)
    # what is missing of an order, and what its negative one adds at the worst phase
    added = np.expm1(-turn) * np.exp(-place)
    lost = 1.0 - np.abs(np.exp(turn) @ nominal) + np.abs(added @ nominal)
    worst = int(np.argmax(lost))
    if lost[worst] < _LOSS:
        return ''
    return (f'in each revolution marks come up to {np.ptp(off):.1%} of it early or late: '
            f'if the speed changes inside revolutions, order {orders[worst]:g} may lose '
            f'{min(lost[worst], 1.0):.0%} of its amplitude, which pulses_per_trigger 1 keeps '
            '(trigger_cycles then counts marks); if the marks stand unevenly, nothing is lost: '
            'check_keyphasor tells which')
