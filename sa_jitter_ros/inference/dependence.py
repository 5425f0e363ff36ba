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
Dependence: how the residual changes with order, speed, frequency and number of averaged cycles.

A prediction that is right on average may depend on these in a wrong way: then a wrong effect was
fitted to the size of the true one. Only held-out acquisitions are used.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.effects import Effect
from sa_jitter_ros.effects.effect import Finding
from sa_jitter_ros.effects.evidence import SAME_SPEED
from sa_jitter_ros.inference.residual import ACCURACY, ACCURACY_OF_CHANGE, FALSE_ALARM
from sa_jitter_ros.inference.scoring import Bench, Comparison
from scipy import special

Array = NDArray[Any]

_FREEDOM = 3


@dataclass(frozen=True)
class Dependence:
    """
    Change of the residual of the attenuation with the quantity `on`, from its `low` to `high` end.

    `change` is relative to an amplitude; its `standard_error` includes the uncertainty of the
    parameters of effects; `p_value` is that of no change.
    """

    on: str
    unit: str
    low: float
    high: float
    change: float
    standard_error: float
    p_value: float

    def __str__(self) -> str:
        """Return the change and its p value in words."""
        name = self.on.replace('_', ' ')
        unit = f' {self.unit}' if self.unit else ''
        return (f'what is left changes by {self.change:+.4f} from {name} {self.low:.4g} to '
                f'{self.high:.4g}{unit}')


def moving(found: Sequence[Dependence]) -> Dependence | None:
    """Return the most significant of all that are tested, None if none is significant."""
    most = min(found, key=lambda item: item.p_value, default=None)
    return most if most and len(found) * most.p_value < FALSE_ALARM else None


def dependences(bench: Bench, effects: Sequence[Effect], findings: Sequence[Finding]
                ) -> tuple[Dependence, ...]:
    """Return the dependences of the residual with `effects` on all that differs in the data."""
    whole = bench.compare(effects, findings)
    weights = 1.0 / (np.mean(whole.scale**2, axis=0) + ACCURACY**2)
    orders = bench.observation.orders[bench.lines.order]
    items = [bench.observation.acquisitions[a] for a in bench.held_out]
    speeds = bench.observation.model.cycle_length / np.array([item.period for item in items])
    found = []
    if np.ptp(orders) > 0.0:
        found.append(_over_lines(whole, weights, orders))
    if len(items) > 1 + _FREEDOM and np.std(speeds) > SAME_SPEED * np.mean(speeds):
        found += [_over_acquisitions(on, whole, weights, shape, speeds) for on, shape in (
            ('speed', np.ones(orders.size)), ('frequency', orders))]
    if bench.fewer is not None:
        counts = np.array([item.observation.model.trigger_cycles for item in (bench.fewer, bench)])
        found.append(_over_cycles(whole, bench.fewer.compare(effects, findings), weights, counts))
    return tuple(found)


def _over_lines(whole: Comparison, weights: Array, orders: Array) -> Dependence:
    """Return the slope over orders, from line to line."""
    away = orders - np.average(orders, weights=weights)
    across = weights * away / np.sum(weights * away**2) * np.ptp(orders)
    return _judged('order', '', orders, whole, across, np.ones(len(whole.scale)))


def _over_acquisitions(on: str, whole: Comparison, weights: Array, shape: Array, speeds: Array
                       ) -> Dependence:
    """Return the slope over speeds; `shape` (line,) is its relative size for each line."""
    across = weights * shape / np.sum(weights * shape**2) * shape.max()
    away = speeds - speeds.mean()
    return _judged(on, 'Hz', speeds * shape.max(), whole, across,
                   away / np.mean(away**2) * np.ptp(speeds))


def _over_cycles(whole: Comparison, fewer: Comparison, weights: Array, counts: Array
                 ) -> Dependence:
    """Return the change from averages of few cycles to those of all."""
    def less(one: Array, other: Array) -> Array:
        return np.asarray(one - other.reshape(len(one), -1, one.shape[1]).mean(axis=1))

    both = Comparison(less(whole.difference, fewer.difference), whole.scale, tuple(
        less(one, other) for one, other in zip(whole.moved, fewer.moved)))
    return _judged('trigger_cycles', '', counts, both, weights / weights.sum(),
                   np.ones(len(whole.scale)), accuracy=ACCURACY_OF_CHANGE)


def _judged(on: str, unit: str, values: Array, comparison: Comparison, across: Array,
            along: Array, *, accuracy: float = ACCURACY) -> Dependence:
    """Judge a sum over lines, weighted by `across`, and its mean over acquisitions by `along`."""
    each = comparison.difference @ across
    count = len(each)
    change = float(np.mean(along * each))
    away = each - each.mean()
    away = away - np.mean(along * away) / np.mean(along**2) * along
    freedom = count - 1 - bool(np.ptp(along))
    spread = np.sqrt(np.sum((along * away) ** 2) / max(freedom, 1) / count)
    moved = [np.mean(along * (item @ across)) for item in comparison.moved]
    error = float(np.sqrt(spread**2 + np.sum(np.square(moved))))
    total = np.hypot(error, accuracy)
    chance = 2.0 * special.stdtr(freedom, -abs(change) / total) if freedom >= _FREEDOM else 1.0
    return Dependence(on, unit, float(values.min()), float(values.max()), change, error,
                      float(chance))
