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
Lines of other shafts that leak into order amplitudes of a correction.

A line that is no order of the shaft leaks into the amplitudes of all orders of a trigger cycle,
and turns there from cycle to cycle. A few cycles do not average it out, and it looks like errors
of the pulses. Where its order is known it is no disturbance: it is fitted, and removed, as the
orders of the shaft are (`noise.without_leakage`). The lines stand out in the spectrum of all
cycles; so do those that pulse errors make beside an order, on both of its sides.
"""

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.arrays import ComplexArray, FloatArray
from sa_jitter_ros.averaging.grid_cycles import GridCycles
from sa_jitter_ros.averaging.synchronous_orders import significance

# Cycles from which on lines are told from changes of the orders, and most lines.
_LEAST_CYCLES, _MOST = 8, 16
# Turns of a line against an order in all cycles from which on it is no slow change of the order.
_LEAST_TURNS = 2.0
# Turns of a line against a whole order in all cycles below which it is that order.
_WHOLE = 0.1
# Share of the power of a line in any order of a cycle that does not matter.
_LEAST_SHARE = 1e-6
# The highest line that is looked for, over the highest order.
_HIGHEST = 2.0
# What has so much of its power in the mirror image about an order is made by that order.
_MIRRORED = 0.25
_STEPS = 16  # places between two lines of the spectrum at which the order of a line is refined


def other_lines(grid: GridCycles, errors: FloatArray, orders: FloatArray, cycle_length: float
                ) -> FloatArray:
    """
    Return the orders of lines that may leak into `orders` of trigger cycles.

    Pulse `errors` (pulse,), in trigger cycles, are removed from the angle; `cycle_length` is r.
    Those that may leak most come first, at most 16.
    """
    if len(grid.cycles) < _LEAST_CYCLES or not orders.size:
        return np.empty(0)
    span = grid.span * cycle_length
    lines, power = grid.lines(_HIGHEST * float(orders.max()) * cycle_length, errors, span)
    lines = lines / cycle_length
    whole = np.rint(lines)  # an order of the shaft that is not asked for is known exactly
    lines = np.where(np.abs(lines - whole) * span < _WHOLE, whole, lines)
    own = np.concatenate((orders, -orders))
    share = np.max(np.sinc(cycle_length * np.abs(lines[:, None] - own)) ** 2, axis=1)
    lines, power, share = (item[share > _LEAST_SHARE] for item in (lines, power, share))
    by_leakage = np.argsort(-power * share)
    mirrored = np.abs(2.0 * orders[:, None, None] - lines[:, None] - lines) * span < 1.0
    alone = ~np.any(mirrored & (power > _MIRRORED * power[:, None]), axis=(0, 2))
    return _apart(lines[by_leakage][alone[by_leakage]], own, span)


def _apart(lines: FloatArray, others: FloatArray, span: float) -> FloatArray:
    """Return the first 16 lines that are apart from all before them and from others."""
    found = np.empty(0)
    for line in lines:
        if found.size < _MOST and np.all(
                np.abs(line - np.append(others, found)) * span >= _LEAST_TURNS):
            found = np.append(found, line)
    return found


def with_images(lines: FloatArray, orders: FloatArray, cycle_length: float, span: float
                ) -> FloatArray:
    """
    Return lines, and images of those that are up to half a turn of a cycle beside an order.

    An order whose length changes has both. `span` are the turns of the shaft in all cycles.
    """
    near = orders[np.argmin(np.abs(lines[:, None] - orders), axis=1)]
    images = (2.0 * near - lines)[np.abs(lines - near) * cycle_length <= 0.5]
    return np.append(lines, _apart(images, np.concatenate((orders, -orders, lines)), span))


def coherent(lines: FloatArray, cycles: ComplexArray, numbers: NDArray[np.int64],
             cycle_length: float) -> FloatArray:
    """
    Return the orders of those `lines` that pulse errors do not make.

    `cycles` (cycle, channel, line) are their amplitudes in trigger cycles without pulse errors,
    which are numbers `numbers` (cycle,) from 0 on. A line keeps its amplitude from cycle to cycle,
    and turns by what its order is off.
    """
    count, channels, _ = cycles.shape
    known, off = lines == np.rint(lines), np.zeros(lines.size)
    for width in (1.0, 0.1):  # of the search, in lines of the spectrum of all cycles
        step = width * np.arange(-_STEPS, _STEPS + 1) / (2.0 * _STEPS * (numbers[-1] + 1.0))
        waves = np.exp(-2j * np.pi * (off + step[:, None]) * numbers[:, None, None])
        sums = np.abs(np.einsum('ksl,kcl->scl', waves, cycles)) ** 2 / count
        best = np.where(known, _STEPS, np.argmax(np.sum(sums, axis=1), axis=0))
        off = off + step[best]
    steady = sums[best, :, np.arange(lines.size)].T
    scatter = np.maximum(np.sum(np.abs(cycles) ** 2, axis=0) - steady, np.finfo(float).tiny)
    level = significance(channels * lines.size, count) / (count - 1.0)
    return np.asarray((lines + off / cycle_length)[np.any(steady > level * scatter, axis=0)])
