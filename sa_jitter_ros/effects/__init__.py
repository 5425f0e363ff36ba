"""Effects that a declared model may lack: one module each, listed in `registry`."""

from sa_jitter_ros.effects.effect import Effect, parameter_defaults, parameter_ranges
from sa_jitter_ros.effects.registry import declared_effects, EFFECTS, enabled_effects, make_effect

__all__ = [
    'EFFECTS',
    'Effect',
    'declared_effects',
    'enabled_effects',
    'make_effect',
    'parameter_defaults',
    'parameter_ranges',
]
