# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Parameters of nodes and commands that follow from the machine where they are not given."""

from collections.abc import Mapping
from typing import Any

from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.machine.train import Machine


def following(given: Mapping[str, Any]) -> dict[str, Any]:
    """
    Return the parameters that follow from the machine among those given, which win over these.

    Names are those of all nodes and commands; each takes what it has. Raises ParameterError for a
    machine that contradicts itself, and for a shaft that it does not have and whose ratio is not
    given.

    >>> found = following({
    ...     'shafts': ['input'], 'machine.tach_shaft': 'output', 'machine.gears.g.shaft': 'input',
    ...     'machine.gears.g.teeth': 20, 'machine.gears.g.mate_shaft': 'output',
    ...     'machine.gears.g.mate_teeth': 50})
    >>> found['input.ratio'], found['input.mesh_orders']
    (2.5, [20.0])
    """
    machine = Machine.among(given)
    if not machine.shafts:
        return {}
    shafts = given.get('shafts') or list(machine.shafts)
    found: dict[str, Any] = {'shafts': shafts, 'shaft': shafts[0]}
    for shaft in shafts:
        plain = [f'{shaft}.ratio', f'{shaft}.ratio_teeth'] + ['ratio'] * (len(shafts) == 1)
        has_ratio = any(name in given for name in plain)
        if shaft not in machine.shafts:
            if has_ratio:
                continue
            raise ParameterError(f'shafts names {shaft}, which the machine does not have: give '
                                 f'some of {", ".join(machine.shafts)}, or {shaft}.ratio')
        orders, meshes = machine.average_orders(shaft), machine.mesh_orders(shaft)
        values: dict[str, Any] = {} if has_ratio else {'ratio': machine.ratio(shaft)}
        values |= {'orders': list(orders)} if orders else {}
        values |= {'mesh_orders': list(meshes), 'teeth': int(meshes[0])} if meshes else {}
        if given.get('averaging', 'block') == 'block':
            values['bearing_orders'] = list(machine.strikes(shaft))
        found |= {f'{shaft}.{name}': value for name, value in values.items()}
        if len(shafts) == 1:
            found |= {name: values[name] for name in ('ratio', 'orders') if name in values}
    return found
