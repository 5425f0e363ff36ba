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
Keywords of `average` and `Averager`: the parameters of the node under the same names.

`AverageOptions` has their types, `KeyphasorParameters` and `AverageSettings` check them. Help and
documentation show them with their defaults by `with_keywords`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from inspect import Parameter, signature
import math
from typing import Any, Literal, TypedDict, TypeVar

from sa_jitter_ros.averaging.average import AverageSettings, KeyphasorParameters
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.machine import Machine
from sa_jitter_ros.parameters import did_you_mean, number, RATIO, SAME_RATIO
from sa_jitter_ros.pulses.validation import GeometryMode, MissingPulses

Averaging = Literal['block', 'sliding', 'exponential']
AngleLawName = Literal['linear', 'quadratic', 'spline']
Interpolation = Literal['band_limited', 'linear', 'cubic', 'spline']
FunctionT = TypeVar('FunctionT', bound=Callable[..., object])


class AverageOptions(TypedDict, total=False):
    """Keywords of `average`."""

    start_time: float
    ratio: float
    pulses_per_revolution: int
    pulses_per_trigger: int | None
    trigger_cycles: int | None
    orders: Sequence[float] | None
    correct_jitter: bool
    keyphasor_rate: float | None
    maximum_discarded: float
    averaging: Averaging
    angle_law: AngleLawName
    interpolation: Interpolation
    samples_per_revolution: int
    missing_teeth: int
    missing_pulses: MissingPulses
    maximum_missing: int
    interval_tolerance: float
    minimum_interval: float
    time_tolerance: float
    path_delay: float
    target_geometry: GeometryMode
    target_angles: Sequence[float]
    mesh_orders: Sequence[float]
    sidebands: int
    bearing_orders: Sequence[float]
    envelope_band: Sequence[float]
    machine: Machine | None
    shaft: str | None


class AveragerOptions(AverageOptions, total=False):
    """Keywords of `Averager`."""

    buffer_seconds: float


_DEFAULTS: dict[str, Any] = {
    item.name: item.default for item in (*fields(KeyphasorParameters), *fields(AverageSettings))
} | {
    'start_time': 0.0, 'ratio': RATIO.default, 'trigger_cycles': None, 'orders': None,
    'keyphasor_rate': None, 'mesh_orders': (), 'sidebands': 1, 'machine': None, 'shaft': None,
    'bearing_orders': (), 'envelope_band': (), 'buffer_seconds': math.inf}


def with_keywords(options: type) -> Callable[[FunctionT], FunctionT]:
    """Return a decorator that shows `options` with their defaults in a function's signature."""
    def decorate(function: FunctionT) -> FunctionT:
        plain = signature(function)
        shown = [Parameter(name, Parameter.KEYWORD_ONLY, default=_DEFAULTS[name], annotation=kind)
                 for name, kind in options.__annotations__.items()]
        own = [item for item in plain.parameters.values() if item.kind != Parameter.VAR_KEYWORD]
        function.__signature__ = plain.replace(  # type: ignore[attr-defined]
            parameters=[*own, *shown])
        return function
    return decorate


def completed(given: Mapping[str, Any], options: type) -> dict[str, Any]:
    """
    Return all `options` with the values that are given, or follow from the machine.

    Raises TypeError for other names, ParameterError for a shaft that the machine does not have.
    """
    known = list(options.__annotations__)
    for name in given:
        if name not in known:
            raise TypeError(f'unknown keyword {name!r}{did_you_mean(name, known)}')
    found = {name: given.get(name, _DEFAULTS[name]) for name in known}
    machine, shaft = found.pop('machine'), found.pop('shaft')
    return found if machine is None else found | {
        name: value for name, value in _of_machine(machine, shaft, found).items()
        if name not in given}


def _of_machine(machine: Machine, shaft: str | None, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of a shaft, by default that of the given ratio."""
    if not isinstance(machine, Machine):
        raise ParameterError(f'machine is of type {type(machine).__name__}: give a Machine, '
                             'Machine.read(path)')
    if shaft is None:
        ratio = number('ratio', given['ratio'])
        shaft = next((name for name in machine.shafts
                      if abs(machine.ratio(name) - ratio) < SAME_RATIO * ratio), '')
        if not shaft:
            turning = ', '.join(f'{name} {machine.ratio(name):.6g}' for name in machine.shafts)
            raise ParameterError(f'ratio is {ratio:.6g}, with which no shaft of the machine turns '
                                 f'({turning or "it has none"}): give shaft')
    orders = machine.average_orders(shaft)
    return {'ratio': machine.ratio(shaft), 'mesh_orders': machine.mesh_orders(shaft),
            'bearing_orders': machine.strikes(shaft) if given['averaging'] == 'block' else (),
            **({'orders': orders} if orders else {})}
