"""Jitter scale: the declared jitter has another size than declared, and the same distribution."""

from dataclasses import dataclass
from typing import ClassVar

from sa_jitter_ros.effects.effect import Effect, parameter, require_in_turn
from sa_jitter_ros.prediction.model import DeclaredModel


@dataclass(frozen=True)
class JitterScale(Effect):
    """
    Pulse errors are `scale` times the declared jitter, whatever its distribution.

    Where another effect takes the place of the declared jitter, it has none to scale.
    """

    name: ClassVar[str] = 'jitter_scale'
    summary: ClassVar[str] = 'declared jitter of another size'
    needs_pulse_errors: ClassVar[bool] = True
    scale: float = parameter(1.0, 'true over declared size of the jitter', '1', minimum=0.0)

    def jitter_factor(self, model: DeclaredModel) -> float:
        """Return the scale; raise ModelError where pulses could swap."""
        require_in_turn('the spread of the jitter with jitter_scale.scale',
                        self.scale * model.distribution.width, model)
        return self.scale
