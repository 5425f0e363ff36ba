# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The train of a machine: how fast its shafts turn, their orders, parameters that follow."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from difflib import get_close_matches
from fractions import Fraction
from pathlib import Path
from typing import Any

from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.machine.parts import Bearing, Belt, GearPair, Limit, PlanetaryStage
from sa_jitter_ros.parameter_file import flattened, read_parameters
from sa_jitter_ros.parameters import require_shaft_names

#: What the names of all parameters of a machine begin with.
PREFIX = 'machine.'
_KINDS: dict[str, Any] = {'gears': GearPair, 'planetary': PlanetaryStage, 'belts': Belt,
                          'bearings': Bearing, 'limits': Limit}
_OTHERS = ('channels',)  # of a machine, read elsewhere
_FINEST = 10**6  # denominator of a ratio
_SAME = 1e-5  # by which an order may differ from that of a part, relative


@dataclass(frozen=True)
class Machine:
    """
    A machine by its parts, each by its name: gear pairs, planetary stages, belts, bearings.

    It has limits, too.

    A part is a mapping of its values or one of the classes of `machine.parts`, a limit a mapping
    or a `Limit`. `tach_shaft` carries the keyphasor; it may be left out where there is one shaft
    only. Raises ParameterError, in one line, for parts that contradict each other.

    >>> machine = Machine(tach_shaft='output', gears={'stage': {
    ...     'shaft': 'input', 'teeth': 19, 'mate_shaft': 'output', 'mate_teeth': 61}})
    >>> round(machine.ratio('input'), 4), machine.orders('input')['mesh input-output 2x']
    (3.2105, 38.0)
    """

    tach_shaft: str = ''
    gears: Mapping[str, Any] = field(default_factory=dict)
    planetary: Mapping[str, Any] = field(default_factory=dict)
    bearings: Mapping[str, Any] = field(default_factory=dict)
    limits: Mapping[str, Any] = field(default_factory=dict)
    belts: Mapping[str, Any] = field(default_factory=dict)
    _ratios: dict[str, Fraction] = field(init=False, repr=False, compare=False,
                                         default_factory=dict)

    def __post_init__(self) -> None:
        """Check the parts and find the speeds of the shafts."""
        for kind in _KINDS:
            parts = {name: _made(kind, name, part) for name, part in getattr(self, kind).items()}
            object.__setattr__(self, kind, parts)
        coupled = {end for part in self._couplings().values() for end in part.ends}
        others = {part.shaft for part in self.bearings.values()} - coupled
        if not self.tach_shaft:
            if coupled or len(others) > 1:
                raise ParameterError('machine.tach_shaft is not given: name the shaft that '
                                     f'carries the keyphasor, one of '
                                     f'{", ".join(sorted(coupled | others))}')
            object.__setattr__(self, 'tach_shaft', next(iter(others), ''))
        if self.tach_shaft:
            require_shaft_names('machine.tach_shaft', [self.tach_shaft])
            if coupled and self.tach_shaft not in coupled:
                raise ParameterError(f'machine.tach_shaft is {self.tach_shaft}, which nothing '
                                     f'turns: give one of {", ".join(sorted(coupled))}')
            self._find_ratios()
        for name, part in self.bearings.items():
            if part.shaft not in self._ratios:
                raise ParameterError(f'machine.bearings.{name}.shaft is {part.shaft}, which is '
                                     f'unknown: give one of {", ".join(self.shafts)}')
        self._check_limits()

    def _check_limits(self) -> None:
        names = dict.fromkeys(name for shaft in self.shafts for name in self.orders(shaft))
        for name, limit in self.limits.items():
            if limit.part is not None and limit.part not in names:
                near = get_close_matches(limit.part, names, 3, cutoff=0.0)
                raise ParameterError(
                    f'machine.limits.{name}.part is {limit.part!r}, which no gear, stage or '
                    f'bearing makes: give {" or ".join(near) if near else "an order"}')

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> 'Machine':
        """
        Return the machine of the mapping `machine` of a machine file, nested or joined by dots.

        Raises ParameterError, in one line.
        """
        found: dict[str, dict[str, dict[str, Any]]] = {kind: {} for kind in _KINDS}
        tach_shaft = ''
        for name, value in flattened(values):
            kind, _, rest = name.partition('.')
            part, _, key = rest.rpartition('.')
            if name == 'tach_shaft':
                tach_shaft = str(value)
            elif kind in _KINDS and part:
                found[kind].setdefault(part, {})[key] = value
            elif kind not in _OTHERS:
                raise ParameterError(f'machine.{name} is unknown: give tach_shaft, '
                                     f'{", ".join((*_KINDS, *_OTHERS))}')
        return cls(tach_shaft, **found)

    @classmethod
    def among(cls, given: Mapping[str, Any]) -> 'Machine':
        """
        Return the machine among parameters by their full names, without parts where there is none.

        Raises ParameterError, in one line.
        """
        return cls.of({name.removeprefix(PREFIX): value for name, value in given.items()
                       if name.startswith(PREFIX)})

    @classmethod
    def read(cls, path: str | Path) -> 'Machine':
        """Read the section `machine` of a machine file; raises ParameterError, in one line."""
        values = read_parameters(Path(path), 'machine')
        if not any(name.startswith(PREFIX) for name in values):
            raise ParameterError(f'{path}: no machine: give it under "/**:", "ros__parameters:", '
                                 '"machine:"')
        try:
            return cls.among(values)
        except ParameterError as error:
            raise ParameterError(f'{path}: {error}') from None

    def _couplings(self) -> dict[str, GearPair | PlanetaryStage | Belt]:
        """Return what couples two shafts, by its name in the file."""
        return {f'{kind}.{name}': part for kind in ('gears', 'planetary', 'belts')
                for name, part in getattr(self, kind).items()}

    def _find_ratios(self) -> None:
        """Find the speed of each shaft over that of the tach shaft, along the couplings."""
        self._ratios[self.tach_shaft] = Fraction(1)
        waiting = self._couplings()
        while waiting:
            name = next((name for name, part in waiting.items()
                         if self._ratios.keys() & set(part.ends)), '')
            if not name:
                part = next(iter(waiting.values()))
                raise ParameterError(f'shaft {part.ends[0]} is not coupled with the tach shaft '
                                     f'{self.tach_shaft}: declare the gears or belts between them')
            part = waiting.pop(name)
            first, second = part.ends
            ratio = Fraction(part.ratio).limit_denominator(_FINEST)  # 0.4 of a belt: 2/5
            if first not in self._ratios:
                self._ratios[first] = self._ratios[second] / ratio
            again = self._ratios[first] * ratio
            if self._ratios.setdefault(second, again) != again:
                raise ParameterError(
                    f'machine.{name} closes the train with another ratio: {second} turns '
                    f'{float(again):.6g} times as fast as {self.tach_shaft} by it, and '
                    f'{float(self._ratios[second]):.6g} times by the others; check the teeth')

    @property
    def shafts(self) -> tuple[str, ...]:
        """Return the names of the shafts, that of the tach first."""
        return tuple(self._ratios)

    def ratio(self, shaft: str) -> float:
        """Return the speed of a shaft over that of the tach shaft; raises ParameterError."""
        if shaft not in self._ratios:
            raise ParameterError(f'shaft {shaft} is unknown in the machine: give one of '
                                 f'{", ".join(self.shafts) or "none, it has no shafts"}')
        return float(self._ratios[shaft])

    def orders(self, shaft: str) -> dict[str, float]:
        """Return the orders of a shaft by the names of what makes them; raises ParameterError."""
        return {**self.gear_orders(shaft), **self.bearing_orders(shaft)}

    def places(self) -> dict[str, float]:
        """Return all orders of gears and planetary stages as multiples of the tach shaft's."""
        return {name: self.ratio(shaft) * order for shaft in self.shafts
                for name, order in self.gear_orders(shaft).items()}

    def meshes(self) -> dict[str, float]:
        """Return the meshes and their harmonics as multiples of the speed of the tach shaft."""
        return {name: place for name, place in self.places().items()
                if name.startswith('mesh ') and name.endswith('x')}

    def gear_orders(self, shaft: str) -> dict[str, float]:
        """Return the orders of gears and planetary stages by name; raises ParameterError."""
        self.ratio(shaft)
        pairs = Counter(frozenset(part.ends) for part in self.gears.values())
        found: dict[str, float] = {}
        for name, part in self._couplings().items():
            if shaft not in part.ends:
                continue
            shown = name.partition('.')[2]
            if isinstance(part, GearPair):
                several = pairs[frozenset(part.ends)] > 1
                shown = '-'.join(part.ends) + (f' ({shown})' if several else '')
            found |= part.orders(shown, shaft)
        return found

    def mesh_orders(self, shaft: str) -> tuple[float, ...]:
        """Return the mesh orders of a shaft that are whole: teeth of which an average consists."""
        return tuple(sorted({order for name, order in self.gear_orders(shaft).items()
                             if name.startswith('mesh ') and name.endswith(' 1x')
                             and order.is_integer()}))

    def average_orders(self, shaft: str) -> tuple[float, ...]:
        """Return the orders of an average: meshes, sidebands of this shaft, planets."""
        found = {order for name, order in self.gear_orders(shaft).items()
                 if name.startswith('planet pass') or (name.startswith('mesh ') and name.endswith(
                     ('x', f'1 {shaft}', '1 planet pass')))}
        return tuple(sorted(order for order in found if order > 0.0))

    def bearing_orders(self, shaft: str) -> dict[str, float]:
        """Return the orders of the bearings of a shaft by name; raises ParameterError."""
        self.ratio(shaft)
        return {key: order for name, part in self.bearings.items() if part.shaft == shaft
                for key, order in part.orders(name).items()}

    def strikes(self, shaft: str) -> tuple[float, ...]:
        """Return the bearing orders of a shaft, each once, in ascending order."""
        return tuple(sorted(set(self.bearing_orders(shaft).values())))

    def name_of(self, shaft: str, order: float, *, bearing: bool = False) -> str:
        """Return the name of what makes an order of a shaft, '' where nothing known does."""
        if shaft not in self._ratios:
            return ''
        orders = self.bearing_orders(shaft) if bearing else self.gear_orders(shaft)
        return next((name for name, value in orders.items()
                     if abs(value - order) <= _SAME * value), '')


def _made(kind: str, name: str, given: Any) -> Any:
    """Return a part of a machine, of its values by name; raises ParameterError."""
    part, place = _KINDS[kind], f'machine.{kind}.{name}'
    if isinstance(given, Mapping):
        unknown = [key for key in given if key not in part.KINDS]
        lacking = [item.name for item in fields(part)
                   if item.default is not None and item.name not in given]
        if unknown or lacking:
            what = f'has unknown {unknown[0]}' if unknown else f'lacks {", ".join(lacking)}'
            raise ParameterError(f'{place} {what}: give {", ".join(part.KINDS)}')
        given = part(**given)
    given.check(place)
    return given


#: A machine of which nothing is known.
UNKNOWN = Machine()


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
