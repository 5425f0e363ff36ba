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
The parts of a machine, the orders at which each shows, and limits by the names of the parts.

Orders of a part are multiples of the speed of a shaft that it is on.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
import math
from typing import ClassVar

from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.parameters import Parameter, require_shaft_names

HARMONICS = 3  # of a mesh that have names
_FEWEST_TEETH = 5
_SHIFTED = 2  # teeth by which profile shift may part a ring from sun + 2 planet

_TEETH = Parameter('teeth', 0, 'number of teeth', minimum=_FEWEST_TEETH, maximum=100000)
_SHAFT = Parameter('shaft', '', 'name of a shaft')
_LENGTH = Parameter('length', 0.0, 'a length', unit='m', above=0.0)
_ORDER = Parameter('order', 0.0, 'a multiple of the speed of the shaft', above=0.0)
LEVELS = ('warn', 'alarm')
_OF = ('order', 'part', 'indicator')


class Part:
    """A part of a machine, whose values have the `KINDS` of parameters; None is not given."""

    KINDS: ClassVar[Mapping[str, Parameter]]

    def check(self, place: str) -> None:
        """Convert and check the values; raises ParameterError with the place in the file."""
        for name, kind in self.KINDS.items():
            value, named = getattr(self, name), replace(kind, name=f'{place}.{name}')
            if value is None:
                continue
            value = named.convert(value)
            if kind is _SHAFT:
                require_shaft_names(named.name, [value])
            object.__setattr__(self, name, value)


class Coupling(Part):
    """A part that couples two shafts, whose names are the values of `ENDS`."""

    ENDS: ClassVar[tuple[str, str]] = ('shaft', 'mate_shaft')

    @property
    def ends(self) -> tuple[str, str]:
        """Return the shafts that the part couples."""
        first, second = (getattr(self, name) for name in self.ENDS)
        return first, second

    def check(self, place: str) -> None:
        """Check the values; raises ParameterError, which names the place in the file."""
        super().check(place)
        if len({*self.ends}) < 2:
            raise ParameterError(f'{place}: {" and ".join(self.ENDS)} are both {self.ends[0]}: '
                                 'give two shafts')


@dataclass(frozen=True)
class GearPair(Coupling):
    """
    Two gears in mesh, with the numbers of their teeth.

    >>> pair = GearPair('input', 18, 'output', 60)
    >>> pair.ratio, pair.assembly_phases, pair.hunting_tooth
    (Fraction(3, 10), 6, Fraction(1, 10))
    """

    shaft: str
    teeth: int
    mate_shaft: str
    mate_teeth: int
    KINDS: ClassVar = {'shaft': _SHAFT, 'teeth': _TEETH, 'mate_shaft': _SHAFT,
                       'mate_teeth': _TEETH}

    @property
    def ratio(self) -> Fraction:
        """Return the speed of the mate's shaft over that of the shaft."""
        return Fraction(self.teeth, self.mate_teeth)

    @property
    def assembly_phases(self) -> int:
        """Return in how many ways the teeth can be assembled: their common divisor."""
        return math.gcd(self.teeth, self.mate_teeth)

    @property
    def hunting_tooth(self) -> Fraction:
        """Return the order, of the shaft, at which the same two teeth meet."""
        return Fraction(self.assembly_phases, self.mate_teeth)

    def orders(self, name: str, shaft: str) -> dict[str, float]:
        """Return the orders of one of the shafts by name, `name` being that of the mesh."""
        teeth, scale = (self.teeth, Fraction(1)) if shaft == self.shaft else (
            self.mate_teeth, 1 / self.ratio)
        found = {f'mesh {name} {k}x': Fraction(k * teeth) for k in range(1, HARMONICS + 1)}
        own = {self.shaft: scale, self.mate_shaft: scale * self.ratio}
        for mesh, order in list(found.items()):
            for beside, step in own.items():
                found |= {f'{mesh} -1 {beside}': order - step, f'{mesh} +1 {beside}': order + step}
        if self.assembly_phases > 1:
            found[f'assembly phase {name}'] = Fraction(teeth, self.assembly_phases)
        found[f'hunting tooth {name}'] = self.hunting_tooth * scale
        return {key: float(order) for key, order in found.items()}


@dataclass(frozen=True)
class Belt(Coupling):
    """A belt or chain between two shafts: `ratio` is the speed of the mate's over the shaft's."""

    shaft: str
    mate_shaft: str
    ratio: float
    KINDS: ClassVar = {'shaft': _SHAFT, 'mate_shaft': _SHAFT,
                       'ratio': Parameter('ratio', 1.0, 'ratio of speeds', above=0.0)}

    def orders(self, name: str, shaft: str) -> dict[str, float]:
        """Return no orders: a belt has no teeth in mesh."""
        return {}


@dataclass(frozen=True)
class PlanetaryStage(Coupling):
    """
    A planetary stage, of which one of sun, ring and carrier is fixed.

    `sun`, `ring` and `planet` are numbers of teeth, `planets` is the number of planets. `input` is
    the member on the input shaft: by default the sun, or the ring where the sun is fixed. Sources:
    Willis (1841); McFadden, Smith, "An explanation for the asymmetry of the modulation sidebands
    about the tooth meshing frequency in epicyclic gear vibration", Proc. IMechE C 199 (1985).

    >>> stage = PlanetaryStage(20, 100, 40, 4, 'ring', 'motor', 'drum')
    >>> stage.ratio, stage.orders('stage', 'drum')['mesh stage 1x']
    (Fraction(1, 6), 100.0)
    """

    sun: int
    ring: int
    planet: int
    planets: int
    fixed: str
    input_shaft: str
    output_shaft: str
    input: str | None = None  # noqa: A003 (the key of the machine file)
    ENDS: ClassVar = ('input_shaft', 'output_shaft')
    MEMBERS: ClassVar = ('sun', 'ring', 'carrier')
    KINDS: ClassVar = {
        **dict.fromkeys(('sun', 'ring', 'planet'), _TEETH),
        'planets': Parameter('planets', 0, 'number of planets', minimum=1, maximum=100),
        'fixed': Parameter('fixed', '', 'fixed member', choices=MEMBERS),
        'input_shaft': _SHAFT, 'output_shaft': _SHAFT,
        'input': Parameter('input', '', 'member on the input shaft', choices=MEMBERS)}

    def check(self, place: str) -> None:
        """Check the values, and that the teeth assemble; raises ParameterError."""
        super().check(place)
        if self.input == self.fixed:
            raise ParameterError(f'{place}.input is {self.input}, which is fixed: give another '
                                 'member')
        whose = (f'{place} does not assemble: sun {self.sun}, planet {self.planet}, ring '
                 f'{self.ring}')
        if abs(self.ring - self.sun - 2 * self.planet) > _SHIFTED:
            raise ParameterError(f'{whose}: the ring needs sun + 2 planet = '
                                 f'{self.sun + 2 * self.planet} teeth')
        if (self.sun + self.ring) % self.planets:
            raise ParameterError(f'{whose}: sun + ring = {self.sun + self.ring} teeth are no '
                                 f'multiple of {self.planets} evenly spaced planets')
        if self.planets > 1 and (self.sun + self.planet) * math.sin(
                math.pi / self.planets) <= self.planet + 2:
            raise ParameterError(f'{whose}: {self.planets} planets touch each other')

    @property
    def speeds(self) -> dict[str, Fraction]:
        """Return the speeds of the members, but for a common factor (Willis)."""
        about_carrier = {'sun': Fraction(1, self.sun), 'ring': -Fraction(1, self.ring),
                         'carrier': Fraction(0)}
        return {member: speed - about_carrier[self.fixed]
                for member, speed in about_carrier.items()}

    @property
    def on_shafts(self) -> tuple[str, str]:
        """Return the members on the input and on the output shaft."""
        free = [member for member in self.MEMBERS if member != self.fixed]
        first = self.input or free[0]
        return first, next(member for member in free if member != first)

    @property
    def ratio(self) -> Fraction:
        """Return the speed of the output shaft over that of the input shaft."""
        first, second = self.on_shafts
        return abs(self.speeds[second] / self.speeds[first])

    def orders(self, name: str, shaft: str) -> dict[str, float]:
        """Return the orders of one of the shafts by name; relative to the carrier."""
        speeds = self.speeds
        own = abs(speeds[self.on_shafts[self.ends.index(shaft)]])
        sun, ring, passing = (abs(item) / own for item in (
            speeds['sun'] - speeds['carrier'], speeds['ring'] - speeds['carrier'],
            speeds['carrier']))
        mesh = self.ring * ring
        found = {f'mesh {name} {k}x': k * mesh for k in range(1, HARMONICS + 1)}
        if passing:
            step = self.planets * passing
            for key, order in list(found.items()):
                found |= {f'{key} -1 planet pass': order - step,
                          f'{key} +1 planet pass': order + step}
            found[f'planet pass {name}'] = step
        found |= {f'sun fault {name}': self.planets * sun,
                  f'planet fault {name}': 2 * mesh / self.planet,
                  f'ring fault {name}': self.planets * ring}
        return {key: float(order) for key, order in found.items()}


@dataclass(frozen=True)
class Bearing(Part):
    """
    A rolling bearing, by its geometry or by the orders that its maker gives.

    Diameters in m, `contact_angle` in rad; `rotating` is the ring on the shaft, inner or outer;
    the other one is at rest. `cage`, `ball` (its spin), `inner` and `outer` are orders of the
    shaft. Source: Randall, Antoni, "Rolling element bearing diagnostics: a tutorial", Mechanical
    Systems and Signal Processing 25 (2011), equations 1 to 4.

    >>> bearing = Bearing('input', balls=8, pitch_diameter=0.04, ball_diameter=0.01)
    >>> bearing.orders('b1')['bearing b1 outer']
    3.0
    """

    shaft: str
    balls: int | None = None
    pitch_diameter: float | None = None
    ball_diameter: float | None = None
    contact_angle: float | None = None
    rotating: str | None = None
    cage: float | None = None
    ball: float | None = None
    inner: float | None = None
    outer: float | None = None
    GEOMETRY: ClassVar = ('balls', 'pitch_diameter', 'ball_diameter')
    GIVEN: ClassVar = ('cage', 'ball', 'inner', 'outer')
    KINDS: ClassVar = {
        'shaft': _SHAFT, 'balls': Parameter('balls', 0, 'number of balls', minimum=3,
                                            maximum=10000),
        'pitch_diameter': _LENGTH, 'ball_diameter': _LENGTH,
        'contact_angle': Parameter('contact_angle', 0.0, 'an angle', unit='rad', minimum=0.0,
                                   maximum=1.5),
        'rotating': Parameter('rotating', '', 'rotating ring', choices=('inner', 'outer')),
        **dict.fromkeys(GIVEN, _ORDER)}

    def check(self, place: str) -> None:
        """Check the values; raises ParameterError, which names the place in the file."""
        super().check(place)
        geometry, given = ([name for name in names if getattr(self, name) is not None]
                           for names in (self.GEOMETRY, self.GIVEN))
        if given and geometry:
            raise ParameterError(f'{place} has {geometry[0]} and {given[0]}: give its geometry or '
                                 'its orders')
        if not given and len(geometry) < len(self.GEOMETRY):
            lacking = next(name for name in self.GEOMETRY if name not in geometry)
            raise ParameterError(f'{place} lacks {lacking}: give {", ".join(self.GEOMETRY)}, or '
                                 f'the orders {", ".join(self.GIVEN)}')
        if self.balls and self.pitch_diameter and self.ball_diameter and (
                self.pitch_diameter * math.sin(math.pi / self.balls) <= self.ball_diameter):
            raise ParameterError(
                f'{place}: {self.balls} balls of {self.ball_diameter:g} m do not fit on a pitch '
                f'diameter of {self.pitch_diameter:g} m')
        if self.cage is not None and self.cage >= 1.0:
            raise ParameterError(f'{place}.cage is {self.cage:g}: a cage turns slower than the '
                                 'shaft; give orders of the shaft, not Hz')
        if self.inner and self.outer and self.inner <= self.outer:
            raise ParameterError(f'{place}: inner is {self.inner:g} and outer {self.outer:g}: a '
                                 'point of the inner ring is struck more often; are they swapped?')

    def orders(self, name: str) -> dict[str, float]:
        """Return the orders at which a damaged part of the bearing strikes, by name."""
        found = {key: getattr(self, key) for key in self.GIVEN}
        if self.balls and self.pitch_diameter and self.ball_diameter:
            share = self.ball_diameter / self.pitch_diameter * math.cos(self.contact_angle or 0.0)
            found = {'cage': 0.5 * (1.0 + share if self.rotating == 'outer' else 1.0 - share),
                     'ball': 0.5 * self.pitch_diameter / self.ball_diameter * (1.0 - share**2),
                     'inner': 0.5 * self.balls * (1.0 + share),
                     'outer': 0.5 * self.balls * (1.0 - share)}
        if found['ball'] is not None:
            found['2x ball'] = 2.0 * found['ball']
        return {f'bearing {name} {part}': order for part, order in found.items()
                if order is not None}


@dataclass(frozen=True)
class Limit(Part):
    """
    A limit of an order, of what a part of the machine makes, or of a condition indicator.

    `warn` and `alarm` are in the unit of the channel, `relative` ones times the baseline. Without
    `channel`, a name or a number, all are meant; without `shaft` the only one that has it.
    """

    order: float | None = None
    part: str | None = None
    indicator: str | None = None
    shaft: str | None = None
    channel: str | None = None
    warn: float | None = None
    alarm: float | None = None
    relative: bool | None = None
    KINDS: ClassVar = {
        'order': _ORDER,
        **{name: Parameter(name, '', f'name of a {name}')
           for name in ('part', 'indicator', 'shaft', 'channel')},
        **{name: Parameter(name, 0.0, 'a limit', above=0.0) for name in LEVELS},
        'relative': Parameter('relative', False, 'times the baseline')}

    def check(self, place: str) -> None:
        """Check the values; raises ParameterError, which names the place in the file."""
        super().check(place)
        given = [name for name in _OF if getattr(self, name) is not None]
        if len(given) != 1:
            raise ParameterError(f'{place} gives {" and ".join(given) or "no quantity"}: give one '
                                 f'of {", ".join(_OF)}')
        bounds = [*self.bounds.values()]
        if not bounds:
            raise ParameterError(f'{place} has neither warn nor alarm: give one, or both')
        if bounds[0] > bounds[-1]:
            raise ParameterError(f'{place}.warn is {self.warn:g}, above its alarm of '
                                 f'{self.alarm:g}: a warning comes first; are they swapped?')
        if self.relative and bounds[0] <= 1.0:
            raise ParameterError(f'{place} is relative and {bounds[0]:g}: give times the '
                                 'baseline, more than 1')

    @property
    def what(self) -> str:
        """Return in words what the limit is for."""
        return self.indicator or self.part or f'order {self.order:g}'

    @property
    def bounds(self) -> dict[str, float]:
        """Return the bounds that are given, by level."""
        return {level: value for level, value in zip(LEVELS, (self.warn, self.alarm))
                if value is not None}
