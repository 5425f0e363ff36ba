"""The declared model from a ROS parameter file of `jitter_predictor`, read without ROS."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
import re
from typing import Any

from sa_jitter_ros.effects import Effect, EFFECTS, enabled_effects, parameter_ranges
from sa_jitter_ros.errors import ModelError
from sa_jitter_ros.statistics.prediction import DeclaredModel
import yaml

_NODE = 'jitter_predictor'
_INTEGERS = ('pulses_per_revolution', 'pulses_per_trigger', 'trigger_cycles')
_LISTS = ('orders', 'jitter_table')
_TEXTS = ('jitter_distribution',)
# Parameters of the node that say nothing about the model.
_OTHERS = ('follow_shaft_speed', 'speed_tolerance', 'use_sim_time')
_DEFAULTS: Mapping[str, Any] = {
    'keyphasor_rate': 10000.0, 'trigger_speed': 25.0, 'trigger_cycles': 40,
    'orders': (1.0, 2.0, 3.0)}
_LARGEST_FILE = 1 << 20
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
        if path.stat().st_size > _LARGEST_FILE:
            raise ModelError(f'{path}: {path.stat().st_size} bytes is no parameter file')
        content = yaml.safe_load(path.read_text(encoding='utf-8'))
    except (OSError, UnicodeDecodeError, yaml.YAMLError, RecursionError) as error:
        reason = ' '.join(str(error).split())[:300]
        raise ModelError(f'{path}: cannot be read as YAML: {reason}') from error
    values: dict[str, Any] = {}
    sections = list(_sections(content, '')) if isinstance(content, Mapping) else []
    for name, section in sections:
        if _matches(name):
            values.update(_flattened(section, ''))
    if not any(_matches(name) for name, _ in sections):
        raise ModelError(f'{path}: no ros__parameters of {_NODE}: start the file with '
                         f'"{_NODE}:" or "/**:" and "ros__parameters:"')
    try:
        return _declaration(values, sample_rate)
    except (ModelError, ValueError, TypeError) as error:
        raise ModelError(f'{path}: {error}') from error


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


def _sections(content: Mapping[Any, Any], name: str) -> Iterator[tuple[str, Mapping[Any, Any]]]:
    """Iterate over all sections of parameters with the node names above them."""
    for key, value in content.items():
        if not isinstance(value, Mapping):
            continue
        if key == 'ros__parameters':
            yield name, value
        else:
            yield from _sections(value, f'{name}/{str(key).strip("/")}')


def _matches(name: str) -> bool:
    return name.rsplit('/', 1)[-1] in (_NODE, '*', '**')


def _flattened(section: Mapping[Any, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    for key, value in section.items():
        name = f'{prefix}{key}'
        if isinstance(value, Mapping):
            yield from _flattened(value, f'{name}.')
        else:
            yield name, value


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
        return value
    return _number(name, value)


def _number(name: str, value: Any) -> float:
    if isinstance(value, str) and _FLOAT.fullmatch(value):
        return float(value)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ModelError(f'{name} is {value!r}: give a number')
    return float(value)
