# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Third cumulants of the average: what its normal distribution lacks at order 1/sqrt(N_t)."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise, permutations
import math

import numpy as np
from numpy.typing import ArrayLike
from sa_jitter_ros.arrays import Array, BoolArray
from sa_jitter_ros.prediction.angle_error import (
    AngleErrorProcess, IndependentPulseJitter, joint_characteristic, pair_characteristic,
    unit_nodes)
from sa_jitter_ros.prediction.distributions import Empirical
from sa_jitter_ros.prediction.moments import (
    correlation_length, cycle_moments, CycleMoments)

_REACH = 3  # correlation in cycles up to which triple moments are integrated
_NODES = 6  # on each of three axes; 1e-8 of the largest cumulant while g D stays below 1
# Of tables, whose values do not smear what wide errors do, and their spreads in cycles.
_TABLE_NODES, _SPREADS = (_NODES, 12, 24), (0.4, 0.75)
# Variance of a cycle over its squared mean, up to which it is a mean to expand about: by errors of
# any distribution, and by normal ones.
_CLEAR, _CLEAR_NORMAL = 8.0, 1e4
_MOST_BLOCKS = 64
_PAIR_NODES = 32
# Places in a cycle whose phasors superpose, and of all that meet; share of the variance forgotten.
_INSIDE, _MOST_INSIDE, _FORGOTTEN = 3, 400, 1e-3


def third_cumulants(orders: ArrayLike, processes: Sequence[AngleErrorProcess], trigger_cycles: int,
                    cycles: CycleMoments, *, nodes: int = _NODES) -> tuple[Array, Array]:
    """
    Return the joint cumulants k(X, X, X) and k(X, X, conj X) of the average, shape (orders,) each.

    `cycles` are the `cycle_moments` of the same processes.
    """
    g = np.asarray(orders, float)
    u, w = unit_nodes(nodes)
    length = correlation_length(processes)
    axes = (u[:, None, None], u[:, None], u)
    box = g[:, None, None, None]
    m = cycles.mean
    unmixed = np.zeros(g.size, complex)
    mixed = np.zeros(g.size, complex)

    def pair(i: int, j: int) -> Array:
        return (cycles.pseudo_variance[abs(i - j)] if abs(i - j) <= length else 0.0) + m**2

    def pair_conj(i: int, j: int) -> Array:
        if abs(i - j) > length:
            return np.abs(m) ** 2
        moment: Array = cycles.variance[abs(i - j)] + np.abs(m) ** 2
        return moment if j >= i else np.conj(moment)

    for p in range(length + 1):
        for q in range(length + 1):
            triple = (0, p, p + q)
            places = (trigger_cycles - p - q) / trigger_cycles**3
            if places <= 0.0:
                continue
            arrangements = set(permutations(triple))
            raw = joint_characteristic(processes, [box] * 3, axes, triple) @ w @ w @ w
            lower = pair(0, p) + pair(0, p + q) + pair(p, p + q)
            unmixed += places * len(arrangements) * (raw - m * lower + 2.0 * m**3)
            for (a, b, c), count in Counter(
                    (*sorted(order[:2]), order[2]) for order in arrangements).items():
                raw = joint_characteristic(processes, [box, box, -box], axes, (a, b, c))
                lower = m * (pair_conj(a, c) + pair_conj(b, c)) + m.conj() * pair(a, b)
                mixed += places * count * (
                    raw @ w @ w @ w - lower + 2.0 * m * np.abs(m) ** 2)
    return unmixed, mixed


def superposed_cumulants(cycles: CycleMoments, trigger_cycles: int, clear: BoolArray
                         ) -> tuple[Array, Array]:
    """
    Return k(X, X, X) and k(X, X, conj X) as the pair moments of the cycles alone suggest.

    A triple moment is taken for the product of its three pair moments over its three means: exact
    for phasors of a Gaussian phase, and cheap where the memory is long. Long averages are summed
    in blocks. 0 where the mean of a cycle is not `clear` (order,) enough to expand about.
    """
    size = np.abs(cycles.mean)
    m, size = np.where(clear, cycles.mean, 1.0), np.where(clear, size, 1.0)
    block = math.ceil(trigger_cycles / _MOST_BLOCKS)
    count = round(trigger_cycles / block)
    steps = np.arange(1 - block, block)
    lags = block * np.arange(count)[:, None] + steps
    weight = (block - np.abs(steps)) / block**2 * (np.abs(lags) < len(cycles.variance))
    first, last = 1 - len(cycles.variance), len(cycles.variance) - 1
    by_lag = np.zeros((count, last - first + 1))  # weights of the lags that are remembered
    row, column = np.nonzero(weight)
    by_lag[row, lags[row, column] - first] = weight[row, column]
    known = np.arange(first, last + 1)
    p = (by_lag @ cycles.pseudo_variance[np.abs(known)]).T / m[:, None] ** 2
    both = cycles.variance[np.abs(known)]
    j = (by_lag @ np.where(known[:, None] < 0, both.conj(), both)).T / size[:, None] ** 2
    distance = np.subtract.outer(np.arange(count), np.arange(count))
    p, j = p[:, np.abs(distance)], j[:, np.abs(distance)]
    j = np.where(distance > 0, j.conj(), j)
    p_row, j_row, j_column = p.sum(axis=2), j.sum(axis=2), j.sum(axis=1)
    unmixed = 3.0 * np.sum(p_row**2, axis=1) + np.sum(p * (p @ p), axis=(1, 2))
    mixed = (2.0 * np.sum(p_row * j_row, axis=1) + np.sum(j_column**2, axis=1)
             + np.sum(p * (j @ j.transpose(0, 2, 1)), axis=(1, 2)))
    factor = np.where(clear, m, 0.0) / count**3
    return unmixed * factor * m**2, mixed * factor * size**2


def _superposed(orders: ArrayLike, processes: Sequence[AngleErrorProcess], trigger_cycles: int,
                cycles: CycleMoments, clear: BoolArray) -> tuple[Array, Array]:
    """
    Return the same, of the phasors at places inside the cycles where the memory is not too long.

    Pulses that remember each other turn the places of a cycle by different angles. The triples of
    a place and two others around it are summed, each as often as it fits into the average.
    """
    memory = min(correlation_length(processes), trigger_cycles - 1)
    known = np.abs(cycles.variance[:memory + 1])
    reach = int(np.flatnonzero(np.any(known >= _FORGOTTEN * known[0], axis=1))[-1])
    if (2 * reach + 1) * _INSIDE > _MOST_INSIDE:
        return superposed_cumulants(cycles, trigger_cycles, clear)
    g = np.asarray(orders, float)
    u, w = unit_nodes(_INSIDE)
    mean = np.where(clear[:, None], joint_characteristic(
        processes, [g[:, None]], [u], [0]), 1.0)
    pair, conj = _pairs(g, processes, mean, u, reach)
    place = np.arange(-reach, reach + 1)
    span = (np.maximum(np.maximum.outer(place, place), 0)
            - np.minimum(np.minimum.outer(place, place), 0))
    often = np.kron(np.maximum(trigger_cycles - span, 0), np.ones((u.size, u.size)))
    apart, middle = place - place[:, None] + 2 * reach, place + 2 * reach
    found = np.zeros((2, g.size), complex)
    for k in np.flatnonzero(clear).tolist():
        weight = np.tile(w * mean[k], place.size)
        first, other = (weight * item[k, middle].transpose(1, 0, 2).reshape(u.size, -1)
                        for item in (pair, conj.conj()))
        both, both_conj = (item[k, apart].transpose(0, 2, 1, 3).reshape(weight.size, -1)
                           for item in (pair, conj))
        own = w * mean[k]
        for i, (a, b) in enumerate(zip(first, other)):
            found[0, k] += own[i] * (a @ (often * (3.0 + both)) @ a)
            found[1, k] += own[i] * (a @ (often * (2.0 + both_conj)) @ b.conj())
            found[1, k] += own[i].conj() * (b @ often @ b)
    return found[0] / trigger_cycles**3, found[1] / trigger_cycles**3


def _pairs(g: Array, processes: Sequence[AngleErrorProcess], mean: Array, u: Array, reach: int
           ) -> tuple[Array, Array]:
    """
    Return E[x y] and E[x conj(y)] over the means, less 1, for lags of y from -2 reach to 2 reach.

    They are (order, lag, place of x, place of y), 0 for lags beyond `reach`.
    """
    found = np.zeros((2, g.size, 4 * reach + 1, u.size, u.size), complex)
    level = mean[:, :, None] * np.stack((mean.conj(), mean))[:, :, None]
    for lag in range(reach + 1):
        value = pair_characteristic(processes, g, u, lag) / level - 1.0
        back = value.swapaxes(2, 3)
        found[:, :, 2 * reach - lag] = np.stack((back[0].conj(), back[1]))
        found[:, :, 2 * reach + lag] = value
    return found[1], found[0]


def average_cumulants(orders: ArrayLike, processes: Sequence[AngleErrorProcess],
                      trigger_cycles: int, cycles: CycleMoments) -> tuple[Array, Array]:
    """
    Return k(X, X, X) and k(X, X, conj X): integrated where the memory is short, else superposed.

    Normal gains have no third cumulants; what their superposition makes of them is taken out. With
    both kinds of processes the superposition is corrected by its error for the short ones.
    Independent jitter seen through a law that reads many pulses counts as seen through its `near`
    law, which moves the distribution function of |X| by less than 0.01 where it is not sampled.
    """
    near = [_near(process) for process in processes]
    if all(one is other and one.correlation_length <= _REACH
           for one, other in zip(near, processes)):
        return _integrated(orders, processes, trigger_cycles, cycles)
    gains = [process for process in processes if hasattr(process, 'draw_gain')]
    spurious = (0.0, 0.0)
    clear = _clear(cycles, _CLEAR_NORMAL)
    if gains:
        of_gains = _superposed(orders, gains, trigger_cycles, cycle_moments(
            orders, gains, nodes=_PAIR_NODES), clear)
        spurious = (of_gains[0] * cycles.mean**3,
                    of_gains[1] * cycles.mean * np.abs(cycles.mean) ** 2)
    short = [process for process in near if process.correlation_length <= _REACH]
    if not short:
        every = _superposed(orders, processes, trigger_cycles, cycles, clear)
        return every[0] - spurious[0], every[1] - spurious[1]
    alone = cycle_moments(orders, short, nodes=_PAIR_NODES)
    unmixed, mixed = _integrated(orders, short, trigger_cycles, alone)
    gain = cycles.mean / np.where(np.abs(alone.mean) > 0.0, alone.mean, 1.0)
    if len(short) == len(near):
        return unmixed * gain**3, mixed * gain * np.abs(gain) ** 2
    clear &= _clear(alone, _CLEAR)
    every = _superposed(orders, processes, trigger_cycles, cycles, clear)
    close = _superposed(orders, short, trigger_cycles, alone, clear)
    return (every[0] - spurious[0] + (unmixed - close[0]) * gain**3,
            every[1] - spurious[1] + (mixed - close[1]) * gain * np.abs(gain) ** 2)


def _clear(cycles: CycleMoments, most: float) -> BoolArray:
    """Return where the variance of a cycle is so many times its squared mean at most (order,)."""
    return np.asarray(np.real(cycles.variance[0]) < most * np.abs(cycles.mean) ** 2)


def _integrated(orders: ArrayLike, processes: Sequence[AngleErrorProcess], trigger_cycles: int,
                cycles: CycleMoments) -> tuple[Array, Array]:
    """Return `third_cumulants` with as many nodes as the spread of a table asks for."""
    g = np.asarray(orders, float)
    tables = [process for process in processes if isinstance(process, IndependentPulseJitter)
              and isinstance(process.distribution, Empirical)]
    spread = g * math.sqrt(sum(item.frequency**2 * item.distribution.variance for item in tables))
    found = np.zeros((2, g.size), complex)
    for (low, high), nodes in zip(pairwise((-1.0, *_SPREADS, np.inf)), _TABLE_NODES):
        some = (spread > low) & (spread <= high)
        if some.any():
            part = CycleMoments(cycles.mean[some], cycles.variance[:, some],
                                cycles.pseudo_variance[:, some])
            found[:, some] = third_cumulants(g[some], processes, trigger_cycles, part, nodes=nodes)
    return found[0], found[1]


def _near(process: AngleErrorProcess) -> AngleErrorProcess:
    """Return independent jitter seen through the `near` law, any other process as it is."""
    if isinstance(process, IndependentPulseJitter) and process.weights.near is not None:
        return replace(process, weights=process.weights.near)
    return process
