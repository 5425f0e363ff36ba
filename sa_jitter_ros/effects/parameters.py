"""The parameters `effects.<name>.<parameter>`, from the registry of effects."""

from collections.abc import Iterator, Mapping
import math
from types import MappingProxyType
from typing import Any

from sa_jitter_ros.effects import EFFECTS, parameter_defaults, parameter_ranges
from sa_jitter_ros.parameters import Parameter

_NONE: Mapping[str, Any] = MappingProxyType({})


def effect_parameters(defaults: Mapping[str, Any] = _NONE) -> Iterator[Parameter]:
    """
    Iterate over the parameters of every effect.

    `defaults`, by `<name>.<parameter>`, take the place of those of the registry.
    """
    for name, kind in EFFECTS.items():
        yield Parameter(f'effects.{name}.enabled', False, f'add the effect: {kind.summary}')
        for key, limits in parameter_ranges(kind).items():
            default = defaults.get(f'{name}.{key}', parameter_defaults(kind)[key])
            yield Parameter(
                f'effects.{name}.{key}', list(default) if isinstance(default, tuple) else default,
                limits.description, unit=limits.unit, choices=limits.choices,
                minimum=limits.minimum if math.isfinite(limits.minimum) else None,
                maximum=limits.maximum if math.isfinite(limits.maximum) else None,
                above=limits.above if math.isfinite(limits.above) else None)
