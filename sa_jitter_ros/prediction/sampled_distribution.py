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
The distribution of the amplitude for averages of few cycles, for which no limit theorem holds.

The draws are the same for every order and every call (fixed seed), so a prediction is a function
of its model. The mean square is not sampled: it is exact.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.prediction.angle_error import AngleErrorProcess, unit_nodes
from sa_jitter_ros.prediction.moments import AverageMoments
from sa_jitter_ros.pulses.angle_law import LINEAR, PulseWeights

Array = NDArray[Any]
#: ``known(count)``: pulse errors (count, pulse) in fundamental cycles of as many averages.
KnownErrors = Callable[[int], Array]

_SEED = 20190215
_BUDGET = 3_000_000  # phasors in one distribution: a tenth of a second
_FEWEST, _MOST = 4096, 65536  # draws: standard errors of 0.008 and 0.002 of a median
#: Fewest draws of long averages.
COARSEST = 512
_IN_EACH = 256  # draws in a scenario that counts by itself: 6 % of its standard deviation
LONGEST, MOST_PHASORS = 20_000, 50_000  # cycles of an average drawn, and times orders
_MOST_POINTS = 1000  # of a process drawn at once: the cube of it is its time
_LINEAR_RULE, _BENT_RULE = unit_nodes(8), unit_nodes(12)  # inside a cycle


@dataclass(frozen=True)
class SampledDistribution:
    """
    The distribution of |X| by equally likely `draws` (orders, n) and an exact mean square.

    `drawn` are the complex X (orders, n) of these, if known, with their exact moments.
    """

    draws: Array = field(repr=False)
    mean_square: Array
    drawn: tuple[Array, AverageMoments] | None = field(default=None, repr=False)

    @cached_property
    def _sorted(self) -> Array:
        return np.sort(self.draws, axis=1)

    @cached_property
    def variance(self) -> Array:
        """Return Var|X|: that of the draws, or what is left of the mean square by E|X|."""
        if self.drawn is None:
            return np.asarray(np.var(self.draws, axis=1, dtype=float))
        return np.asarray(np.maximum(self.mean_square - _mean_size(*self.drawn) ** 2, 0.0))

    @property
    def mean(self) -> Array:
        """Return E|X|, so that mean^2 + variance = E|X|^2."""
        return np.asarray(np.sqrt(np.maximum(self.mean_square - self.variance, 0.0)))

    def cdf(self, amplitude: ArrayLike) -> Array:
        """Return P(|X| <= amplitude), (orders, k) for amplitudes of shape (k,) or (orders, k)."""
        y = np.atleast_2d(np.asarray(amplitude, float))
        y = np.broadcast_to(y, (self.draws.shape[0], y.shape[-1]))
        if y.shape[1] == 1:  # not worth sorting
            counts = np.count_nonzero(self.draws <= y, axis=1)[:, None]
        else:
            counts = np.array([np.searchsorted(row, at, side='right')
                               for row, at in zip(self._sorted, y)])
        return np.where(np.isnan(y), np.nan, counts / self.draws.shape[1])

    def ppf(self, probability: ArrayLike) -> Array:
        """
        Return quantiles of |X|, shape (orders, k) for k probabilities in (0, 1).

        Raises ParameterError for a probability outside (0, 1).
        """
        p = require_probabilities(probability)
        position = p * (self.draws.shape[1] - 1)
        index = np.minimum(position.astype(int), self.draws.shape[1] - 2)
        part = position - index
        return np.asarray((1.0 - part) * self._sorted[:, index]
                          + part * self._sorted[:, index + 1])


def can_be_sampled(
    processes: Sequence[AngleErrorProcess], trigger_cycles: int, orders: int,
) -> bool:
    """Return whether averages of all processes can be drawn, and in about a second."""
    pulsed = all(hasattr(process, 'draw_pulses') for process in processes)
    points = trigger_cycles * (1 if pulsed else _LINEAR_RULE[0].size)
    drawn = _MOST_POINTS if any(hasattr(item, 'draw_angle') or hasattr(item, 'draw_gain')
                                for item in processes) else math.inf
    return points <= min(drawn, LONGEST) and points * orders <= MOST_PHASORS and all(
        any(hasattr(process, f'draw_{what}') for what in ('pulses', 'angle', 'gain'))
        for process in processes)


def drawn_averages(
    orders: ArrayLike, processes: Sequence[Any], trigger_cycles: int, *,
    weights: PulseWeights = LINEAR, known: KnownErrors | None = None, each: Array | None = None,
) -> tuple[Array, Array]:
    """
    Return complex averages (order, draw) of `trigger_cycles` cycles, and noise (draw,), E|n|^2 1.

    Both are of single precision. `processes` `can_be_sampled`; `weights` are those of the angle
    law. ``known(count)`` returns pulse errors (count, n) in fundamental cycles that come on top of
    the random ones, of all N_t - 1 + weights.pulses pulses or of the average's own N_t + 1. The
    errors `each` (scenario, n) come on top of the same random ones each, so that draws are
    (order, scenario, draw).
    """
    g = np.asarray(orders, float)
    pulsed = [process for process in processes if hasattr(process, 'draw_pulses')]
    inside = [process for process in processes if process not in pulsed]
    bare = weights is LINEAR and not inside
    u, w = _LINEAR_RULE if weights is LINEAR else _BENT_RULE
    w = w.astype(np.float32)
    count = _IN_EACH if each is not None else _affordable(
        g.size * (trigger_cycles + 3) * (1 if bare else u.size), g.size)
    rng = np.random.default_rng(_SEED)
    shape = (trigger_cycles + weights.pulses - 1, count)
    errors: Array = np.zeros(shape)
    for process in pulsed:
        errors = errors + process.draw_pulses(rng, shape)
    noise = rng.normal(0.0, np.sqrt(0.5), (2, count)).astype(np.float32)
    if known is not None:
        errors = errors + weights.padded(known(count), trigger_cycles).T
    extra = [process.draw_angle(rng, trigger_cycles, u, count) for process in inside
             if hasattr(process, 'draw_angle')]
    gains = [process.draw_gain(rng, trigger_cycles, u, count) for process in inside
             if hasattr(process, 'draw_gain')]
    swell = np.prod(gains, axis=0) if gains else np.ones(1, np.float32)

    def averages(errors: Array) -> Array:
        angle = (2.0 * np.pi * (weights.path(errors.T, u, trigger_cycles).transpose(1, 2, 0)
                                + sum(extra))).astype(np.float32) if not bare else errors
        draws = np.empty((g.size, count), np.complex64)
        for row, order in zip(draws, g):
            if bare:
                real, imag = _linear_cycles((order * errors).astype(np.float32))
            else:
                turned = np.float32(order) * angle
                real, imag = w @ (swell * np.cos(turned)), w @ (swell * np.sin(turned))
            row[:] = real.mean(axis=0) + 1j * imag.mean(axis=0)
        return draws

    found = averages(errors) if each is None else np.stack(
        [averages(errors + row[:, None]) for row in weights.padded(each, trigger_cycles)], axis=1)
    return found, noise[0] + 1j * noise[1]


def _affordable(phasors: int, orders: int) -> int:
    """Return how many averages of so many phasors are worth their time and memory."""
    count = int(np.clip(_BUDGET // phasors, _FEWEST, _MOST))
    most = min(MOST_PHASORS, LONGEST * orders)
    return max(COARSEST, min(count, COARSEST * most // phasors))


def moments_of(draws: Array) -> AverageMoments:
    """Return the moments of complex draws (order, draw)."""
    mean = draws.mean(axis=1, dtype=complex)
    off = draws - mean[:, None]
    return AverageMoments(mean, np.mean(np.abs(off) ** 2, axis=1), np.mean(off**2, axis=1))


def _mean_size(draws: Array, moments: AverageMoments) -> Array:
    """
    Return E|X| (order,) by complex draws (order, draw) of exact moments.

    First and second moments of real and imaginary part are control variates, of which |X| is
    nearly a sum: the mean of some thousand draws scatters far more.
    """
    off = draws - moments.mean[:, None]
    power = np.abs(off) ** 2 - moments.variance[:, None]
    square = off**2 - moments.pseudo_variance[:, None]
    controls = np.stack([
        np.ones(off.shape), off.real, off.imag, power, square.real, square.imag])
    controls /= np.sqrt(np.mean(controls**2, axis=-1, keepdims=True)) + np.finfo(float).tiny
    normal = np.einsum('iod,jod->oij', controls, controls)
    right = np.einsum('iod,od->oi', controls, np.abs(draws.astype(complex)))
    return np.asarray(np.einsum('oi,oi->o', np.linalg.pinv(normal, hermitian=True)[:, 0], right))


def _linear_cycles(errors: Array) -> tuple[Array, Array]:
    """
    Return real and imaginary part of int_0^1 exp(j 2 pi e_k(u)) du, cycles on axis 0, linear law.

    `errors` are pulse errors in cycles of the order, pulses on axis 0; the precision is theirs.
    """
    middle = np.pi * (errors[1:] + errors[:-1])
    half = np.pi * np.diff(errors, axis=0)
    half[half == 0.0] = np.finfo(half.dtype).tiny
    gain = np.sin(half) / half
    return gain * np.cos(middle), gain * np.sin(middle)


def require_probabilities(probability: ArrayLike) -> Array:
    """Return probabilities of shape (k,); raise ParameterError for one outside (0, 1)."""
    try:
        p = np.atleast_1d(np.asarray(probability, float))
    except (TypeError, ValueError) as error:
        raise ParameterError(
            f'probabilities {probability!r} must be numbers between 0 and 1') from error
    if not np.all((p > 0.0) & (p < 1.0)):
        raise ParameterError(f'probabilities {p} must lie between 0 and 1, both excluded')
    return p
