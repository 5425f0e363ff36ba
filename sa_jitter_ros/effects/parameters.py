# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The parameters `effects.<name>.<parameter>`, from the registry of effects."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

from sa_jitter_ros.effects import EFFECTS, parameter_ranges
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
            yield replace(limits, name=f'effects.{name}.{key}',
                          default=defaults.get(f'{name}.{key}', limits.default))
