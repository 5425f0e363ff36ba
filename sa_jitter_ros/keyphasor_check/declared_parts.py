# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Whether the lines of the vibration are those of the declared gears, or of other teeth."""

from collections.abc import Iterator, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.keyphasor_check.lines import ToothLines
from sa_jitter_ros.keyphasor_check.result import Warn
from sa_jitter_ros.machine import Machine

_NEAR = 1.5  # bins from the place of a part at which a line is still its own
_MISCOUNTED = (-3, -2, -1, 1, 2, 3)  # teeth
# Lines, and sum of the logarithms of their sizes, by which other teeth must fit better.
_LINES, _CLEAR = 2, 3.0


def contradictions(lines: ToothLines | None, machine: Machine) -> list[Warn]:
    """
    Return what the lines of the vibration, in orders of the tach shaft, say against a machine.

    Each number of teeth is tried with up to three more or fewer: meshes, or their sidebands, then
    fall on lines that the declared numbers leave without a cause.
    """
    if lines is None or not lines.places.size or not (machine.gears or machine.planetary):
        return []
    declared = _fitting(lines, machine)
    best, found = _CLEAR, ''
    for name, value, other, variant in _variants(machine):
        fits = _fitting(lines, variant)
        gain = _weight(lines, fits) - _weight(lines, declared)
        if gain > best and np.count_nonzero(fits) >= np.count_nonzero(declared) + _LINES:
            best = gain
            turning = ', '.join(f'{shaft} {variant.ratio(shaft):.6g} instead of '
                                f'{machine.ratio(shaft):.6g}' for shaft in machine.shafts
                                if variant.ratio(shaft) != machine.ratio(shaft))
            found = (f'machine.{name} is {value}, but {np.count_nonzero(fits)} lines of the '
                     f'vibration fit {other}, and {np.count_nonzero(declared)} fit {value}'
                     + (f'; ratios would be: {turning}' if turning else '')
                     + ': count the teeth')
    if found:
        return [Warn('machine_contradicted', found)]
    if not meshes_seen(lines, machine):
        listed = ', '.join(f'{name} {place:.5g}' for name, place in machine.meshes().items()
                           if name.endswith(' 1x'))
        return [Warn('mesh_absent', f'no line of the vibration is at a mesh of the machine ('
                     f'{listed}, in orders of the tach shaft): check tach_shaft, the teeth and '
                     'pulses_per_revolution')]
    return []


def meshes_seen(lines: ToothLines, machine: Machine) -> int:
    """Return how many lines, in orders of the tach shaft, are at a mesh of the machine."""
    return int(np.count_nonzero(_near(lines, np.array([*machine.meshes().values()]))))


def orders_seen(lines: ToothLines, ratio: float, orders: Sequence[float]) -> float:
    """Return the share of stated orders of a shaft at `ratio` at which there is a line."""
    seen = _near(lines, ratio * np.array(orders))
    return min(1.0, float(np.count_nonzero(seen)) / len(orders))


def _variants(machine: Machine) -> Iterator[tuple[str, int, int, Machine]]:
    """Iterate over machines with another number of teeth: its name, value, other value."""
    for kind in ('gears', 'planetary'):
        parts: dict[str, Any] = getattr(machine, kind)
        for name, part in parts.items():
            for key in (item.name for item in fields(part)):
                value = getattr(part, key)
                if not isinstance(value, int) or key == 'planets':
                    continue
                for other in (value + more for more in _MISCOUNTED):
                    changed: dict[str, Any] = {
                        kind: {**parts, name: replace(part, **{key: other})}}
                    try:
                        variant = replace(machine, **changed)
                    except ParameterError:  # which is no machine
                        continue
                    yield f'{kind}.{name}.{key}', value, other, variant


def _fitting(lines: ToothLines, machine: Machine) -> NDArray[np.bool_]:
    """Return which lines (n,) are at a mesh or a sideband of a machine."""
    return _near(lines, np.array([place for name, place in machine.places().items()
                                  if name.startswith('mesh ')]))


def _near(lines: ToothLines, places: FloatArray) -> NDArray[np.bool_]:
    distance = np.abs(lines.places[:, None] - places).min(axis=1, initial=np.inf)
    return np.asarray(distance < _NEAR * lines.step)


def _weight(lines: ToothLines, chosen: NDArray[np.bool_]) -> float:
    return float(np.log(lines.sizes[chosen]).sum())
