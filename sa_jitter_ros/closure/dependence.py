"""
Dependence: how the residual moves with order, speed, frequency and number of averaged cycles.

A prediction that is right on the average may be wrong in how it goes with these: another effect
has then been fitted to the size of the true one. All is of held-out acquisitions.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.closure.fewer_cycles import fewer_cycles
from sa_jitter_ros.closure.residual import ACCURACY
from sa_jitter_ros.closure.scoring import Bench, Comparison
from sa_jitter_ros.effects import Effect
from sa_jitter_ros.effects.evidence import Finding
from scipy import stats

Array = NDArray[Any]

#: A change of the residual with a smaller p value is no chance; there are up to four.
CERTAIN = 1e-3
_NEARLY_ALL = 0.8
_FEWEST = 4  # cycles of an average, and fundamental cycles
_FOLD = 8
_STEADY = 5e-3  # relative spread of speeds that are one
_FREEDOM = 3
# What predictions of the same lines at the same speed may be wrong by against each other.
_ALIKE = 1e-3


@dataclass(frozen=True)
class Dependence:
    """
    How much the residual of the attenuation changes `on` something from its `low` to `high` end.

    `change` in parts of an amplitude with its `standard_error`, which holds what the parameters of
    effects are uncertain by, and the chance `p_value` of as much.
    """

    on: str
    unit: str
    low: float
    high: float
    change: float
    standard_error: float
    p_value: float

    def __str__(self) -> str:
        """Return how much changes with what."""
        name = self.on.replace('_', ' ')
        unit = f' {self.unit}' if self.unit else ''
        return (f'what is left changes by {self.change:+.4f} from {name} {self.low:.4g} to '
                f'{self.high:.4g}{unit} (p = {self.p_value:.2g})')


def moving(found: Sequence[Dependence]) -> Dependence | None:
    """Return the clearest change that is no chance, None where there is none."""
    certain = [item for item in found if item.p_value < CERTAIN]
    return min(certain, key=lambda item: item.p_value) if certain else None


def still_moving(before: Sequence[Dependence], after: Sequence[Dependence]) -> Dependence | None:
    """Return the clearest change that an effect leaves nearly all of, None where there is none."""
    old = {item.on: abs(item.change) for item in before}
    return moving([item for item in after if abs(item.change) > _NEARLY_ALL * old[item.on]])


def dependences(bench: Bench, effects: Sequence[Effect], findings: Sequence[Finding]
                ) -> tuple[Dependence, ...]:
    """Return on what the residual with `effects` may depend: all that differs in the data."""
    whole = bench.compare(effects, findings)
    weights = 1.0 / (np.mean(whole.scale**2, axis=0) + ACCURACY**2)
    orders = bench.observation.orders[bench.lines.order]
    speeds = np.array([_speed(bench, a) for a in bench.held_out])
    found = [*_over_lines(whole, weights, orders)]
    if np.std(speeds) > _STEADY * np.mean(speeds):
        found += _over_acquisitions('speed', whole, weights, np.ones(orders.size), speeds)
        found += _over_acquisitions('frequency', whole, weights, orders, speeds)
    found += _over_cycles(bench, effects, findings, whole, weights)
    return tuple(found)


def _speed(bench: Bench, a: int) -> float:
    """Return the fundamental frequency of an acquisition in Hz."""
    item, model = bench.observation.acquisitions[a], bench.observation.model
    cycles = item.missing.size + item.missing.sum()
    return float(cycles * model.cycle_length / (item.times[-1] - item.times[0]))


def _over_lines(whole: Comparison, weights: Array, orders: Array) -> Iterator[Dependence]:
    """Yield the slope over orders, from line to line."""
    away = orders - np.average(orders, weights=weights)
    if np.ptp(orders) > 0.0:
        across = weights * away / np.sum(weights * away**2) * np.ptp(orders)
        yield _judged('order', '', orders, whole, across, np.ones(len(whole.scale)))


def _over_acquisitions(on: str, whole: Comparison, weights: Array, shape: Array, speeds: Array
                       ) -> Iterator[Dependence]:
    """Yield the slope over speeds; `shape` (line,) is how much of it each line has."""
    across = weights * shape / np.sum(weights * shape**2) * shape.max()
    away = speeds - speeds.mean()
    if len(speeds) > 1 + _FREEDOM:
        yield _judged(on, 'Hz', speeds * shape.max(), whole, across,
                      away / np.mean(away**2) * np.ptp(speeds), lost=2)


def _over_cycles(bench: Bench, effects: Sequence[Effect], findings: Sequence[Finding],
                 whole: Comparison, weights: Array) -> Iterator[Dependence]:
    """Yield the change from averages of few cycles to those of all."""
    model = bench.observation.model
    count = int(max(_FEWEST, np.ceil(_FEWEST / model.cycle_length), model.trigger_cycles // _FOLD))
    at_hand = min(len(item.raw_cycles) for item in bench.observation.acquisitions)
    if at_hand < model.trigger_cycles or 2 * count > model.trigger_cycles:
        return
    fewer = fewer_cycles(bench, count).compare(effects, findings)

    def less(one: Array, other: Array) -> Array:
        return np.asarray(one - other.reshape(len(one), -1, one.shape[1]).mean(axis=1))

    both = Comparison(less(whole.difference, fewer.difference), whole.scale, tuple(
        less(one, other) for one, other in zip(whole.moved, fewer.moved)))
    yield _judged('trigger_cycles', '', np.array([count, model.trigger_cycles]), both,
                  weights / weights.sum(), np.ones(len(whole.scale)), accuracy=_ALIKE)


def _judged(on: str, unit: str, values: Array, comparison: Comparison, across: Array,
            along: Array, *, lost: int = 1, accuracy: float = ACCURACY) -> Dependence:
    """Judge a sum over lines, weighted by `across`, and its mean over acquisitions by `along`."""
    each = comparison.difference @ across
    count = len(each)
    change = float(np.mean(along * each))
    away = each - each.mean()
    if lost > 1:
        away = away - np.mean(along * away) / np.mean(along**2) * along
    freedom = count - lost
    spread = np.sqrt(np.sum((along * away) ** 2) / max(freedom, 1) / count)
    moved = [np.mean(along * (item @ across)) for item in comparison.moved]
    error = float(np.sqrt(spread**2 + np.sum(np.square(moved))))
    total = np.hypot(error, accuracy)
    chance = 2.0 * stats.t.sf(abs(change) / total, freedom) if freedom >= _FREEDOM else 1.0
    return Dependence(on, unit, float(values.min()), float(values.max()), change, error,
                      float(chance))
