"""Missing pulses that nobody repairs: from each one on the angle is short of a trigger cycle."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from sa_jitter_ros.effects.effect import (
    Array, Effect, mean_period, most_scenarios, parameter, Pulses)
from sa_jitter_ros.effects.evidence import absent, Evidence, Finding
from sa_jitter_ros.prediction.angle_error import AngleErrorProcess
from sa_jitter_ros.prediction.loss_moments import loss_moments
from sa_jitter_ros.prediction.moments import AverageMoments
from sa_jitter_ros.prediction.prediction import DeclaredModel

_SCENARIOS, _SEED = 256, 4


@dataclass(frozen=True)
class MissingPulses(Effect):
    """Every trigger pulse is lost with `probability`."""

    name: ClassVar[str] = 'missing_pulses'
    summary: ClassVar[str] = 'pulses that are lost and not repaired'
    seen: ClassVar[bool] = True
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
        return self.drawn_scenarios(model, most_scenarios(model, _SCENARIOS))

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

    def pattern(self, model: DeclaredModel, pulses: Pulses) -> Array | None:
        """Return how far the counted angle is behind in the average at hand."""
        if pulses.missing is None:
            return None
        period = mean_period(pulses.times, pulses.missing)
        return np.asarray(period * np.concatenate(([0.0], np.cumsum(pulses.missing))))

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
                       f'the period: {lost} pulses are missing')
