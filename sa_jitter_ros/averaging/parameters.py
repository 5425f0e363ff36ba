"""What the parameters of the averager mean: one place for the library, the node and commands."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from sa_jitter_ros.averaging.average import AverageSettings
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.parameters import RATIO
from sa_jitter_ros.pulses.validation import MissingPulses, PulseValidator


@dataclass(frozen=True, kw_only=True)
class KeyphasorParameters:
    """
    What is known of the keyphasor, by the names of the node's parameters.

    `pulses_per_trigger` None or 0 makes all pulses of a revolution a trigger cycle; the others are
    those of `PulseValidator`. Raises `ParameterError` where a trigger cycle is more than a
    revolution.
    """

    pulses_per_revolution: int = 1
    pulses_per_trigger: int | None = None
    missing_teeth: int = 0
    missing_pulses: MissingPulses = 'break'
    maximum_missing: int = 3
    interval_tolerance: float = 0.25
    minimum_interval: float = 0.0
    time_tolerance: float = 0.01

    def __post_init__(self) -> None:
        """Check what a validator does not."""
        if (self.pulses_per_trigger or 0) > self.pulses_per_revolution:
            raise ParameterError(
                f'pulses_per_trigger is {self.pulses_per_trigger} of {self.pulses_per_revolution} '
                'pulses_per_revolution: give at most that many')

    @property
    def revolutions_per_trigger(self) -> float:
        """Revolutions of the tach shaft in a trigger cycle."""
        return float((self.pulses_per_trigger or self.pulses_per_revolution)
                     / self.pulses_per_revolution)

    def validator(self) -> PulseValidator:
        """Return a validator of this keyphasor's pulses; raises `ParameterError`."""
        options = {**asdict(self), 'pulses_per_trigger': self.pulses_per_trigger or None}
        return PulseValidator(**options)

    def average(self, *, ratio: float = 1.0, orders: Sequence[float] | None = None,
                **settings: Any) -> AverageSettings:
        """
        Return the settings of the average of a shaft; raises `ParameterError`.

        `ratio` is the speed of the shaft over that of the tach shaft, `orders` None are 1, 2, 3;
        other settings are those of `AverageSettings`.
        """
        if orders is not None:
            settings['orders'] = tuple(float(order) for order in orders)
        return AverageSettings(
            cycle_length=RATIO.convert(ratio) * self.revolutions_per_trigger,
            revolutions_per_trigger=self.revolutions_per_trigger, **settings)
