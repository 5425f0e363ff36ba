# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The section of a machine file that declares what the loop has found."""

from collections.abc import Mapping
from dataclasses import fields, MISSING
from typing import Any

from sa_jitter_ros.effects.clock_skew import ClockSkew
from sa_jitter_ros.inference.trace_result import Trace
from sa_jitter_ros.parameter_file import section_text
from sa_jitter_ros.prediction.model import DeclaredModel

_NODE = 'jitter_predictor'
ONLY_SHAFT = 'shaft'  # the name of a shaft that was given none
_OF_SHAFT = ('ratio', 'orders')
_DIGITS, _DIGITS_OF_RATIO = 6, 10


def new_section(trace: Trace, models: Mapping[str, DeclaredModel], *,
                ratio_is_stated: bool = False) -> str:
    """
    Return the section of `jitter_predictor` with what was found, '' where nothing was.

    It declares the `models` of all shafts, by their names, as before, with the effects added; what
    is new has a remark. A wrong ratio that a recording states, too, is declared as a clock skew.
    """
    found = {item.name: item.effect for item in (*trace.findings, *trace.refinements)
             if item.effect is not None}
    model, declared = trace.observation.model, {item.name: item for item in trace.declared}
    if not found and trace.noise is None:
        return ''
    named = set(models) != {ONLY_SHAFT}
    values: dict[str, Any] = {'shafts': list(models)} if named else {}
    for item in fields(model):
        places = {f'{shaft}.{item.name}': each for shaft, each in models.items()} if (
            named and item.name in _OF_SHAFT) else {item.name: model}
        for place, each in places.items():
            value = trace.observation.declared_speed if item.name == 'trigger_speed' else getattr(
                each, item.name)
            undeclared = item.name == 'noise_std' and not each.noise_is_declared
            if not undeclared and (item.default is MISSING or value != item.default):
                values[place] = value
    remarks = {}
    skew = found.get(ClockSkew.name)
    if isinstance(skew, ClockSkew) and skew.by_angle == 1.0 and not ratio_is_stated:
        del found[ClockSkew.name]
        for place in (f'{shaft}.ratio' if named else 'ratio' for shaft, each in models.items()
                      if (each.ratio, each.orders) == (model.ratio, model.orders)):
            values[place] = float(f'{skew.ratio(model):.{_DIGITS_OF_RATIO}g}')
            remarks[place] = f'was {model.ratio:.{_DIGITS_OF_RATIO}g}'
    if trace.noise is not None:
        values['noise_std'] = _short(trace.noise[0])
        remarks['noise_std'] = (f'was {model.noise_std:g}' if model.noise_is_declared
                                else 'measured')
    if declared or found:
        values['effects'] = {}
    for name, effect in {**declared, **found}.items():
        values['effects'][name] = {'enabled': True, **{
            key: _short(value) for key, value in effect.values.items()}}
        for key in values['effects'][name]:
            if name not in declared:
                remarks[f'effects.{name}.{key}'] = 'new'
            elif name in found and key != 'enabled':
                remarks[f'effects.{name}.{key}'] = f'was {declared[name].values[key]}'
    return section_text(_NODE, values, remarks)


def _short(value: Any) -> Any:
    """Return a number, or each of a list, without digits that mean nothing."""
    if isinstance(value, (tuple, list)):
        return [_short(item) for item in value]
    return float(f'{value:.{_DIGITS}g}') if isinstance(value, float) else value
