"""Third cumulants of the average: what its normal law lacks at order 1/sqrt(N_t)."""

from collections import Counter
from collections.abc import Sequence
from itertools import permutations
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sa_jitter_ros.statistics.angle_error import (
    AngleErrorProcess,
    joint_characteristic,
    unit_nodes,
)
from sa_jitter_ros.statistics.moments import (
    correlation_length,
    CycleMoments,
    require_cycles,
    require_orders,
)

Array = NDArray[Any]

_NODES = 6  # on each of three axes; 1e-8 of the largest cumulant while g D stays below 1


def third_cumulants(
    orders: ArrayLike, processes: Sequence[AngleErrorProcess], trigger_cycles: int,
    cycles: CycleMoments, *, nodes: int = _NODES,
) -> tuple[Array, Array]:
    """
    Return the joint cumulants k(X, X, X) and k(X, X, conj X) of the average, shape (orders,) each.

    `cycles` are the `cycle_moments` of the same processes.
    """
    g = require_orders(orders)
    require_cycles(trigger_cycles)
    u, w = unit_nodes(nodes)
    length = correlation_length(processes)
    axes = (u[:, None, None], u[:, None], u)
    box = g[:, None, None, None]
    m = cycles.mean
    plain = np.zeros(g.size, complex)
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
            plain += places * len(arrangements) * (raw - m * lower + 2.0 * m**3)
            for (a, b, c), count in Counter(
                    (*sorted(order[:2]), order[2]) for order in arrangements).items():
                raw = joint_characteristic(processes, [box, box, -box], axes, (a, b, c))
                lower = m * (pair_conj(a, c) + pair_conj(b, c)) + m.conj() * pair(a, b)
                mixed += places * count * (
                    raw @ w @ w @ w - lower + 2.0 * m * np.abs(m) ** 2)
    return plain, mixed
