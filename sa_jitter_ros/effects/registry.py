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
The list of effects, and effects made from names and values.

To add an effect, write its module, import its class here and give it a place in `EFFECTS`:
library, predictor, simulator, loop and report find it.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from sa_jitter_ros.effects.additive_noise import AdditiveNoise
from sa_jitter_ros.effects.amplitude_modulation import AmplitudeModulation
from sa_jitter_ros.effects.clock_skew import ClockSkew
from sa_jitter_ros.effects.correlated_jitter import CorrelatedJitter
from sa_jitter_ros.effects.effect import Effect, parameter_ranges
from sa_jitter_ros.effects.excess_jitter import ExcessJitter
from sa_jitter_ros.effects.interfering_tone import InterferingTone
from sa_jitter_ros.effects.interpolation_loss import InterpolationLoss
from sa_jitter_ros.effects.jitter_scale import JitterScale
from sa_jitter_ros.effects.keyphasor_quantisation import KeyphasorQuantisation
from sa_jitter_ros.effects.missing_pulses import MissingPulses
from sa_jitter_ros.effects.path_delay import PathDelay
from sa_jitter_ros.effects.phase_wander import PhaseWander
from sa_jitter_ros.effects.speed_fluctuation import SpeedFluctuation
from sa_jitter_ros.effects.target_geometry import TargetGeometry
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.parameters import unwrapped

EFFECTS: Mapping[str, type[Effect]] = {kind.name: kind for kind in (
    ExcessJitter, KeyphasorQuantisation, CorrelatedJitter, TargetGeometry, SpeedFluctuation,
    ClockSkew, PhaseWander, MissingPulses, InterpolationLoss, AdditiveNoise, AmplitudeModulation,
    InterferingTone, JitterScale, PathDelay)}


def make_effect(name: str, **parameters: Any) -> Effect:
    """Return the effect `name`; raise ParameterError for an unknown name, parameter or value."""
    if name not in EFFECTS:
        raise ParameterError(f'no effect {name!r}: there are {", ".join(EFFECTS)}')
    known = parameter_ranges(EFFECTS[name])
    for key in parameters:
        if key not in known:
            raise ParameterError(f'effect {name} has no {key!r}: it has {", ".join(known)}')
    return EFFECTS[name](**{key: _value(value) for key, value in parameters.items()})


def declared_effects(effects: Mapping[str, Any]) -> tuple[Effect, ...]:
    """
    Return the effects of a mapping of their names to their parameters; raises ParameterError.

    >>> declared_effects({'excess_jitter': {'std': 2e-5}})
    (ExcessJitter(std=2e-05),)
    """
    if not isinstance(effects, Mapping):
        raise ParameterError(f'effects is {effects!r}: give a mapping of names of effects to '
                             "their parameters, {'excess_jitter': {'std': 2e-5}}")
    for name, parameters in effects.items():
        if name in EFFECTS and not isinstance(parameters, Mapping):
            first = next(iter(parameter_ranges(EFFECTS[name])))
            raise ParameterError(f'effect {name} is {parameters!r}: give its parameters by name, '
                                 f'{{{name!r}: {{{first!r}: ...}}}}')
    return tuple(make_effect(name, **(parameters if name in EFFECTS else {}))
                 for name, parameters in effects.items())


def _value(value: Any) -> Any:
    """Return the value of a parameter, a list as a tuple."""
    value = unwrapped(value)
    if isinstance(value, (list, np.ndarray)):
        return tuple(unwrapped(item) for item in value)
    return value


def enabled_effects(values: Mapping[str, Any]) -> tuple[Effect, ...]:
    """
    Return the effects that parameters named `effects.<name>.<parameter>` switch on.

    Other parameters in `values` are ignored; a parameter that is not in `values` has its default.
    """
    found = []
    for name, kind in EFFECTS.items():
        if values.get(f'effects.{name}.enabled', False):
            given = {key: values[f'effects.{name}.{key}'] for key in parameter_ranges(kind)
                     if f'effects.{name}.{key}' in values}
            found.append(make_effect(name, **given))
    return tuple(found)
