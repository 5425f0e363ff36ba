"""The simulated effects under the names of the predictor's parameters."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.simulation.effect import Effect
from sa_jitter_ros.simulation.pulse_effects import (
    ClockSkew, CorrelatedJitter, ExcessJitter, KeyphasorQuantisation, MissingPulses,
    TargetGeometry)
from sa_jitter_ros.simulation.vibration_effects import (
    AdditiveNoise, AmplitudeModulation, InterferingTone, InterpolationLoss, PhaseWander,
    SpeedFluctuation)

# A clock's skew comes before its quantisation: effects are applied in this order.
EFFECTS: Mapping[str, type[Effect]] = {
    'excess_jitter': ExcessJitter,
    'correlated_jitter': CorrelatedJitter,
    'target_geometry': TargetGeometry,
    'clock_skew': ClockSkew,
    'keyphasor_quantisation': KeyphasorQuantisation,
    'missing_pulses': MissingPulses,
    'speed_fluctuation': SpeedFluctuation,
    'phase_wander': PhaseWander,
    'amplitude_modulation': AmplitudeModulation,
    'interpolation_loss': InterpolationLoss,
    'additive_noise': AdditiveNoise,
    'interfering_tone': InterferingTone,
}


def make_effects(options: Mapping[str, Mapping[str, Any]]) -> tuple[Effect, ...]:
    """
    Return effects from their names and parameters, as `{'clock_skew': {'skew': 1e-5}}`.

    Raises ParameterError if there is no such effect or parameter, or a value is out of range.
    """
    for name, parameters in options.items():
        if name not in EFFECTS:
            raise ParameterError(f'no effect {name!r}: there are {", ".join(EFFECTS)}')
        known = [item.name for item in fields(EFFECTS[name])]  # type: ignore[arg-type]
        if set(parameters) - set(known):
            raise ParameterError(f'effect {name} has {", ".join(known)} and not '
                                 f'{", ".join(sorted(set(parameters) - set(known)))}')
    return tuple(EFFECTS[name](**options[name]) for name in EFFECTS if name in options)
