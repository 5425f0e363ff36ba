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

from sa_jitter_ros.effects.effect import Effect
from sa_jitter_ros.inference.trace import Trace
from sa_jitter_ros.parameter_file import section_text
from sa_jitter_ros.prediction.model import DeclaredModel

_NODE = 'jitter_predictor'
ONLY_SHAFT = 'shaft'  # the name of a shaft that was given none
_OF_SHAFT = ('ratio', 'orders')
_DIGITS = 6


def new_section(trace: Trace, models: Mapping[str, DeclaredModel]) -> str:
    """
    Return the section of `jitter_predictor` with the effects that were found, '' without any.

    It declares the `models` of all shafts, by their names, as before, with the effects added; what
    is new has a remark.
    """
    found = {item.name: item.effect for item in trace.findings if item.effect is not None}
    if not found:
        return ''
    model, declared = trace.observation.model, {item.name: item for item in trace.declared}
    named = set(models) != {ONLY_SHAFT}
    values: dict[str, Any] = {'shafts': list(models)} if named else {}
    for item in fields(model):
        places = {f'{shaft}.{item.name}': each for shaft, each in models.items()} if (
            named and item.name in _OF_SHAFT) else {item.name: model}
        for place, each in places.items():
            value = trace.observation.declared_speed if item.name == 'trigger_speed' else getattr(
                each, item.name)
            if item.default is MISSING or value != item.default:
                values[place] = value
    remarks = {}
    values['effects'] = {}
    for name, effect in {**declared, **found}.items():
        values['effects'][name] = {'enabled': True, **_rounded(effect)}
        for key in values['effects'][name]:
            if name not in declared:
                remarks[f'effects.{name}.{key}'] = 'new'
            elif name in found and key != 'enabled':
                remarks[f'effects.{name}.{key}'] = f'was {declared[name].values[key]}'
    return section_text(_NODE, values, remarks)


def _rounded(effect: Effect) -> Mapping[str, Any]:
    """Return the parameters of an effect without digits that mean nothing."""
    def short(value: Any) -> Any:
        if isinstance(value, (tuple, list)):
            return [short(item) for item in value]
        return float(f'{value:.{_DIGITS}g}') if isinstance(value, float) else value

    return {name: short(value) for name, value in effect.values.items()}
