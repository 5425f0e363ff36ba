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
Pulses that stand where no jitter puts them, found by the vibration.

A displaced pulse turns the phases of its two trigger cycles too far for the fit of small errors,
which then ends a turn of a high order aside: both cycles fit badly. The one pulse is searched for
over the whole reach, by all orders that the fit has found. Where that explains its cycles, the
pulse counts as missing: it is put where the vibration has it, and the rest is fitted again.
"""

import numpy as np
from sa_jitter_ros.arrays import FloatArray, IntArray
from sa_jitter_ros.averaging.average import Average
from sa_jitter_ros.averaging.recovery import PulseErrorRecovery
from sa_jitter_ros.pulses.mark_pattern import OF_MEDIAN

#: Error of a pulse, over a trigger cycle, up to which it is searched for.
REACH = 0.15
_FEWEST = 8  # trigger cycles, of which most have to be right
_MOST = 0.25  # of the pulses that may be displaced
_STEPS = 12  # of the search in a turn of the highest order
_CHANNELS = 4  # that show the orders best
_PARTS = 64  # of a cycle, in which errors hardly turn an order
# What no jitter explains, in its standard deviations. Squared deviations of cycles from their mean
# over their median: those that are looked at, and what the search has to win of them.
_JITTER, _BAD, _WON = 6.0, 8.0, 25.0


def displacements(grid: FloatArray, recovery: PulseErrorRecovery, raw: Average, *,
                  cycle_length: float, declared: float) -> FloatArray:
    """
    Return how late (pulse,) in s the displaced pulses are, 0 for all others.

    `grid` (cycle, sample, channel) are the trigger cycles of the `raw` average between measured
    pulses; `declared` is the standard deviation of the jitter in s.
    """
    found = np.zeros(recovery.expected.size)
    if len(grid) < _FEWEST or not recovery.orders.size:
        return found
    fit = _Cycles(grid, recovery, raw, cycle_length)
    begins, to_cycles = np.flatnonzero(raw.used), cycle_length / float(np.mean(raw.periods))
    errors = recovery.expected * to_cycles
    known = recovery.errors[recovery.resolved] * to_cycles
    usual = OF_MEDIAN * float(np.median(np.abs(known))) if known.size else 0.0
    limit = _JITTER * np.hypot(max(usual, declared * to_cycles), np.nan_to_num(
        recovery.standard_errors) * to_cycles)
    misfit = fit.misfit(np.arange(begins.size), errors[begins], errors[begins + 1])
    noise = float(np.median(misfit))
    bad = misfit > _BAD * noise
    suspects = np.union1d(begins[bad], begins[bad] + 1)
    best: list[tuple[float, int, float]] = []
    for pulse in suspects.tolist():
        cycles = np.flatnonzero((begins == pulse - 1) | (begins == pulse))
        reach = REACH * cycle_length
        tried = np.arange(-reach, reach, 1.0 / (_STEPS * fit.highest))
        total = np.zeros(tried.size)
        for k in cycles.tolist():
            ends = [np.full(tried.size, errors[item]) for item in (begins[k], begins[k] + 1)]
            ends[pulse - begins[k]] = tried
            total += fit.misfit(np.full(tried.size, k), *ends)
        won = float(misfit[cycles].sum() - total.min()) / noise
        late = float(tried[np.argmin(total)])
        if won > _WON and abs(late) > limit[pulse]:
            best.append((won, pulse, late))
    for _, pulse, late in sorted(best, reverse=True):
        # Two cycles tell one pulse: the neighbour, which they tempt, is not displaced, too.
        if not found[max(pulse - 1, 0):pulse + 2].any():
            found[pulse] = late / to_cycles
    clear = recovery.resolved & (np.abs(recovery.errors * to_cycles) > limit)
    clear &= ~np.convolve(found != 0.0, np.ones(3), 'same').astype(bool)
    found[clear] = recovery.errors[clear]
    if np.count_nonzero(found) > _MOST * found.size:
        return np.zeros(found.size)
    return found


class _Cycles:
    """The amplitudes of trigger cycles between pulses with given errors, against their mean."""

    def __init__(self, grid: FloatArray, recovery: PulseErrorRecovery, raw: Average,
                 cycle_length: float) -> None:
        known = np.isfinite(recovery.noise) & np.isfinite(recovery.aligned)
        weight = np.where(known, recovery.noise, np.inf)**-2
        best = np.argsort(-np.sum(weight * np.abs(recovery.amplitudes)**2, axis=1))[:_CHANNELS]
        self._weight, self._amplitudes = weight[best], recovery.amplitudes[best]
        self._orders = recovery.orders
        used = self._orders[known.any(axis=0)]
        self.highest = float(used.max(initial=1.0 / cycle_length))
        samples = grid.shape[1]
        edges = np.unique(np.arange(_PARTS) * samples // _PARTS)
        u = np.arange(samples) / samples
        self._u = np.add.reduceat(u, edges) / np.diff(edges, append=samples)
        chosen = grid[:, :, best]
        # (cycle, channel, order, part) without the turns of the order: their sum is its amplitude
        self._parts = np.empty((len(grid), best.size, self._orders.size, edges.size),
                               np.complex128)
        for number, order in enumerate(self._orders):
            carrier = 2.0 / samples * np.exp(-2j * np.pi * order * cycle_length * u)
            sums = np.add.reduceat(chosen * carrier[:, None], edges, axis=1)
            start = np.exp(-2j * np.pi * order * (
                raw.first_angle + cycle_length * raw.cycle_numbers))
            self._parts[:, :, number] = (sums * start[:, None, None]).transpose(0, 2, 1)

    def misfit(self, cycles: IntArray, first: FloatArray, last: FloatArray) -> FloatArray:
        """
        Return the weighted squared deviations (n,) of these cycles (n,).

        `first` and `last` (n,) are the errors at their ends, in fundamental cycles.
        """
        path = first[:, None] * (1.0 - self._u) + last[:, None] * self._u
        turned = np.exp(-2j * np.pi * self._orders[:, None] * path[:, None])
        found = np.einsum('kcgp,kgp->kcg', self._parts[cycles], turned)
        return np.asarray(np.sum(self._weight * np.abs(found - self._amplitudes)**2, axis=(1, 2)))
