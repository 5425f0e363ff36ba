"""
Exact moments of averages whose pulses are lost at random and not repaired.

In every cycle the counted angle falls behind by a geometric number of trigger cycles, so that the
phasors make a random walk, whose characteristic function is closed: moments are geometric sums.
Inside a cycle the angle falls behind evenly; those integrals are done by Legendre polynomials,
whose Fourier transforms are spherical Bessel functions, however far the angle turns.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray
from sa_jitter_ros.prediction.angle_error import (
    AngleErrorProcess, joint_characteristic, unit_nodes)
from sa_jitter_ros.prediction.moments import AverageMoments, correlation_length
from scipy.special import spherical_jn

Array = NDArray[Any]

_RULE = unit_nodes(20)
_RARE = 1e-12  # probability of the losses that are left out


def loss_moments(
    orders: Array, turns: Array, probability: float, processes: Sequence[AngleErrorProcess],
    trigger_cycles: int,
) -> AverageMoments:
    """
    Return the moments (order,) with random `processes` on top of the losses.

    `turns` (order,) are the cycles of each order in a trigger cycle; `probability` in (0, 1) is
    that of a pulse to be lost.
    """
    u = _RULE[0]
    most = max(1, int(np.ceil(np.log(_RARE) / np.log(probability))))
    lost = np.arange(most + 1)
    chance = (1.0 - probability) * probability**lost
    omega = 2.0 * np.pi * np.multiply.outer(turns, lost)  # (order, lost)
    weight = _fourier_weights(omega)  # (order, lost, u)
    ahead = np.exp(1j * omega)[:, :, None]
    inside, forward, back = (np.einsum('l,olu->ou', chance, part) for part in (
        weight, weight * ahead, weight * ahead.conj()))
    walk, double = ((1.0 - probability) / (1.0 - probability * np.exp(2j * np.pi * n * turns))
                    for n in (1, 2))
    g = np.asarray(orders)[:, None]
    first = joint_characteristic(processes, [g], [u], [0]) * np.ones((g.size, 1))
    count = trigger_cycles
    steps = np.arange(count)
    mean = np.sum(inside * first, axis=1) * np.mean(walk[:, None] ** steps, axis=1)
    power = count * _own(chance, weight, weight.conj(), _pair(processes, g, u, -1.0, 0)).real
    starts = np.cumsum(double[:, None] ** steps, axis=1)  # of n cycles at n - 1
    square = starts[:, -1] * _own(chance, weight, weight, _pair(processes, g, u, 1.0, 0))
    lags = steps[1:]
    left = np.sum(back * first, axis=1) * np.sum(inside * first, axis=1).conj()
    right = np.sum(forward * first, axis=1) * np.sum(inside * first, axis=1)
    apart = np.repeat(left[:, None], lags.size, axis=1)
    apart_square = np.repeat(right[:, None], lags.size, axis=1)
    for lag in range(1, min(correlation_length(processes) + 1, count)):
        apart[:, lag - 1] = np.einsum('ou,ouv,ov->o', back, _pair(processes, g, u, -1.0, lag),
                                      inside.conj())
        apart_square[:, lag - 1] = np.einsum('ou,ouv,ov->o', forward,
                                             _pair(processes, g, u, 1.0, lag), inside)
    between = walk[:, None] ** (lags - 1)
    power = power + 2.0 * np.sum((count - lags) * (between.conj() * apart).real, axis=1)
    square = square + 2.0 * np.sum(starts[:, count - 1 - lags] * between * apart_square, axis=1)
    return AverageMoments(mean, np.maximum(power / count**2 - np.abs(mean) ** 2, 0.0),
                          square / count**2 - mean**2)


def _fourier_weights(omega: Array) -> Array:
    """Return the weights (..., u) of int_0^1 exp(j omega u) f(u) du for a smooth f."""
    u, w = _RULE
    degree = np.arange(u.size)
    polynomials = legendre.legvander(2.0 * u - 1.0, u.size - 1)  # (u, degree)
    bessel = spherical_jn(degree, 0.5 * omega[..., None])
    transforms = (2 * degree + 1) * 1j**degree * bessel * np.exp(0.5j * omega)[..., None]
    return np.asarray(transforms @ (polynomials * w[:, None]).T)


def _pair(processes: Sequence[AngleErrorProcess], g: Array, u: Array, sign: float, lag: int
          ) -> Array:
    """Return E of the product of two phasors (order, u, v), the second conjugate for sign -1."""
    plane = g[:, :, None]
    value = joint_characteristic(processes, [plane, sign * plane], [u[:, None], u], [0, lag])
    return np.asarray(value * np.ones((g.size, u.size, u.size)))


def _own(chance: Array, early: Array, late: Array, pair: Array) -> Array:
    """Return the mean over losses of a cycle's own product."""
    return np.asarray(np.einsum('l,olu,ouv,olv->o', chance, early, pair, late, optimize=True))
