"""The declared model from a ROS parameter file of `jitter_predictor`, read without ROS."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
import re
from typing import Any

from sa_jitter_ros.commands.parameter_file import one_line, read_parameters
from sa_jitter_ros.effects import Effect, EFFECTS, enabled_effects, parameter_ranges
from sa_jitter_ros.errors import ModelError, ParameterError, SaJitterError
from sa_jitter_ros.statistics.prediction import DeclaredModel

_NODE = 'jitter_predictor'
_INTEGERS = {'pulses_per_revolution': 100_000, 'pulses_per_trigger': 100_000,
             'trigger_cycles': 1_000_000}  # and the largest that the node takes
_LISTS = ('orders', 'jitter_table')
_TEXTS = ('jitter_distribution', 'angle_law')
# Parameters of the node that say nothing about the model.
_OTHERS = ('follow_shaft_speed', 'speed_tolerance', 'use_sim_time')
_DEFAULTS: Mapping[str, Any] = {
    'keyphasor_rate': 10000.0, 'trigger_speed': 25.0, 'trigger_cycles': 40,
    'orders': (1.0, 2.0, 3.0)}
_RATIOS = (1e-3, 1e3)  # as the averager has them
_LARGEST = 1e15  # of any other number: squares and products stay finite
# What rcl takes for a number and YAML 1.1 for a text.
_FLOAT = re.compile(r'[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?')


@dataclass(frozen=True)
class Declaration:
    """What a parameter file declares; `unknown` names what matches no parameter."""

    model: DeclaredModel
    effects: tuple[Effect, ...]
    unknown: tuple[str, ...]


def read_declaration(path: Path, *, sample_rate: float = 0.0) -> Declaration:
    """
    Read a declared model; `sample_rate` (Hz) serves where the file has none.

    Raises ModelError, in one line, for a file that is missing, no parameter file of the node, or
    holds values that make no sense.
    """
    try:
        values = read_parameters(path, _NODE)
    except ParameterError as error:
        raise ModelError(str(error)) from error
    try:
        return _declaration(values, sample_rate)
    except SaJitterError as error:
        raise ModelError(f'{path}: {one_line(error)}') from error


def _declaration(values: Mapping[str, Any], sample_rate: float) -> Declaration:
    model_names = {item.name for item in fields(DeclaredModel)}
    effect_names = {f'effects.{name}.{key}' for name, kind in EFFECTS.items()
                    for key in ('enabled', *parameter_ranges(kind))}
    arguments = {**_DEFAULTS, **{name: _convert(name, value) for name, value in values.items()
                                 if name in model_names}}
    if not arguments.get('sample_rate'):
        arguments['sample_rate'] = sample_rate
    given = {name: value if name.endswith(('.enabled', '.method')) else
             tuple(_number(name, item) for item in value) if isinstance(value, list) else
             _number(name, value) for name, value in values.items() if name in effect_names}
    for name, value in given.items():
        if name.endswith('.enabled') and not isinstance(value, bool):
            raise ModelError(f'{name} is {value!r}: give true or false')
    unknown = tuple(sorted(
        name for name in values if name not in model_names | effect_names
        and name not in _OTHERS and not name.startswith('qos_overrides.')))
    return Declaration(DeclaredModel(**arguments), enabled_effects(given), unknown)


def _convert(name: str, value: Any) -> Any:
    if name in _TEXTS:
        if not isinstance(value, str):
            raise ModelError(f'{name} is {value!r}: give a text')
        return value
    if name in _LISTS:
        if not isinstance(value, list):
            raise ModelError(f'{name} is {value!r}: give a list of numbers')
        return tuple(_number(name, item) for item in value)
    if name in _INTEGERS:
        if isinstance(value, bool) or not isinstance(value, int):
            raise ModelError(f'{name} is {value!r}: give a whole number')
        if value > _INTEGERS[name]:
            raise ModelError(f'{name} is {value}: give at most {_INTEGERS[name]}')
        return value
    return _number(name, value)


def _number(name: str, value: Any) -> float:
    if isinstance(value, str) and _FLOAT.fullmatch(value):
        value = float(value)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ModelError(f'{name} is {value!r}: give a number')
    low, high = _RATIOS if name == 'ratio' else (-_LARGEST, _LARGEST)
    if value < low or value > high:
        raise ModelError(f'{name}: give {low:g} to {high:g}, not {value}')
    return float(value)
