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
Missing pulses that nobody repairs: from each one on the angle lacks one trigger cycle.

In every cycle the counted angle falls behind by a geometric number of trigger cycles, so that the
phasors make a random walk, whose characteristic function is closed: moments are geometric sums.
Inside a cycle the angle falls behind evenly; those integrals are done by Legendre polynomials,
whose Fourier transforms are spherical Bessel functions, however far the angle turns.
"""

from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import ClassVar

import numpy as np
from numpy.polynomial import legendre
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.effects.band import INSIDE
from sa_jitter_ros.effects.effect import (
    absent, DirectEffect, Effect, Finding, most_scenarios, parameter, RARE)
from sa_jitter_ros.effects.evidence import Evidence
from sa_jitter_ros.prediction.angle_error import AngleErrorProcess, joint_characteristic
from sa_jitter_ros.prediction.influence import AveragePulses, mean_period
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.prediction.moments import AverageMoments, correlation_length
from scipy import special

_SEED = 4


@dataclass(frozen=True)
class MissingPulses(DirectEffect):
    """Every trigger pulse is lost with `probability`."""

    name: ClassVar[str] = 'missing_pulses'
    summary: ClassVar[str] = 'pulses that are lost and not repaired'
    meaning: ClassVar[str] = (
        'pulses are lost and nobody repairs it: behind each the angle lacks a trigger '
        'cycle')
    remedy: ClassVar[str] = (
        'lower the trigger level or the distance to the target until no pulse is lost')
    visible_in_pulse_times: ClassVar[bool] = True
    probability: float = parameter(0.0, 'probability that a pulse is lost', '1', minimum=0.0,
                                   maximum=0.9)

    @classmethod
    def unmodelled(cls, model: DeclaredModel) -> str:
        """Refuse laws that bend around a gap."""
        if model.angle_law == 'linear':
            return ''
        return (f'angle_law is {model.angle_law!r}: what it makes of a gap has no forward model; '
                'declare linear, or repair the pulses')

    def scenarios(self, model: DeclaredModel) -> Array | None:
        """Return how far the counted angle is behind, as a delay, for some draws of losses."""
        if self.probability == 0.0:
            return None
        return self.drawn_scenarios(model, most_scenarios(model))

    def drawn_scenarios(self, model: DeclaredModel, count: int) -> Array:
        """Return the delays for as many draws of losses."""
        rng = np.random.default_rng(_SEED)
        lost = rng.geometric(1.0 - self.probability, (count, model.trigger_cycles)) - 1
        return np.asarray(model.trigger_period * np.concatenate(
            (np.zeros((count, 1)), np.cumsum(lost, axis=1)), axis=1))

    def exact_moments(self, model: DeclaredModel, processes: Sequence[AngleErrorProcess]
                      ) -> AverageMoments:
        """Return the moments over all losses."""
        orders = np.asarray(model.orders)
        return loss_moments(orders, orders * model.cycle_length, self.probability, processes,
                            model.trigger_cycles)

    def pattern(self, model: DeclaredModel, pulses: AveragePulses) -> Array | None:
        """Return how far the counted angle is behind in the average at hand."""
        if pulses.missing is None:
            return None
        period = mean_period(pulses.times, pulses.missing)
        return np.asarray(period * np.concatenate(([0.0], np.cumsum(pulses.missing))))

    @classmethod
    def limit(cls, evidence: Evidence) -> Effect | None:
        """Return the probability of which as few losses are as rare as 5 % (Clopper, Pearson)."""
        missing = evidence.record_missing
        return cls(min(float(special.betaincinv(
            missing.sum() + 1.0, max(missing.size, 1), 1.0 - RARE)), 0.9))

    @classmethod
    def fit(cls, evidence: Evidence) -> Finding:
        """Count intervals that are whole multiples of the period."""
        missing = evidence.record_missing
        lost, seen = int(missing.sum()), missing.size
        if lost == 0:
            return absent(cls.name, f'none of {seen} pulse intervals is a multiple of the period')
        probability = lost / (lost + seen)
        error = float(np.sqrt(probability * (1.0 - probability) / (lost + seen)))
        return Finding(cls.name, cls(probability), {'probability': error}, 1e-12,
                       f'{np.count_nonzero(missing)} of {seen} pulse intervals are multiples of '
                       f'the period: {lost} pulses are missing', gain=math.inf)


def loss_moments(
    orders: Array, turns: Array, probability: float, processes: Sequence[AngleErrorProcess],
    trigger_cycles: int,
) -> AverageMoments:
    """
    Return the moments (order,) with random `processes` on top of the losses.

    `turns` (order,) are the cycles of each order in a trigger cycle; `probability` in (0, 1) is
    that of a pulse to be lost.
    """
    u = INSIDE[0]
    # what is left out is less than rounding
    most = max(1, int(np.ceil(np.log(np.finfo(np.float64).eps) / np.log(probability))))
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
    power = count * _mean_product(chance, weight, weight.conj(),
                                  _pair(processes, g, u, -1.0, 0)).real
    starts = np.cumsum(double[:, None] ** steps, axis=1)  # of n cycles at n - 1
    square = starts[:, -1] * _mean_product(chance, weight, weight, _pair(processes, g, u, 1.0, 0))
    lags = steps[1:]
    conjugate = np.sum(back * first, axis=1) * np.sum(inside * first, axis=1).conj()
    direct = np.sum(forward * first, axis=1) * np.sum(inside * first, axis=1)
    apart = np.repeat(conjugate[:, None], lags.size, axis=1)
    apart_square = np.repeat(direct[:, None], lags.size, axis=1)
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
    u, w = INSIDE
    degree = np.arange(u.size)
    polynomials = legendre.legvander(2.0 * u - 1.0, u.size - 1)  # (u, degree)
    bessel = special.spherical_jn(degree, 0.5 * omega[..., None])
    transforms = (2 * degree + 1) * 1j**degree * bessel * np.exp(0.5j * omega)[..., None]
    return np.asarray(transforms @ (polynomials * w[:, None]).T)


def _pair(processes: Sequence[AngleErrorProcess], g: Array, u: Array, sign: float, lag: int
          ) -> Array:
    """Return E of the product of two phasors (order, u, v), the second conjugate for sign -1."""
    plane = g[:, :, None]
    value = joint_characteristic(processes, [plane, sign * plane], [u[:, None], u], [0, lag])
    return np.asarray(value * np.ones((g.size, u.size, u.size)))


def _mean_product(chance: Array, early: Array, late: Array, pair: Array) -> Array:
    """Return the mean over losses of the product of two phasors of one cycle."""
    return np.asarray(np.einsum('l,olu,ouv,olv->o', chance, early, pair, late, optimize=True))
