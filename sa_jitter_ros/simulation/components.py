# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Components of the vibration of a machine: orders of its shafts, and local faults."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from sa_jitter_ros.arrays import ComplexArray, FloatArray
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.simulation.random_streams import RandomStream

_MAX_WIDTH = 0.15  # revolutions; beyond it more than two neighbouring bursts overlap


@dataclass(frozen=True)
class Component:
    """
    A sinusoid locked to a shaft: amplitude x cos(2 pi order x angle + phase) on every channel.

    `order` in multiples of the shaft speed; peak `amplitudes` and `phases` (rad), one per channel.
    """

    shaft: str
    order: float
    amplitudes: tuple[float, ...]
    phases: tuple[float, ...]

    @property
    def phasor(self) -> ComplexArray:
        """Return the complex amplitude of each channel."""
        return np.asarray(np.array(self.amplitudes) * np.exp(1j * np.array(self.phases)))


@dataclass(frozen=True)
class ChippedTooth:
    """
    A burst once per revolution of a shaft, where the chipped tooth is in mesh.

    It is amplitude x exp(-x^2/2) x cos(2 pi order (angle - place)), x = (angle - place) / `width`,
    angles in revolutions. Added to a mesh it weakens or strengthens the mesh over about `width`
    revolutions around `place`. The order is a whole number, the width at most 0.15.

    >>> tooth = ChippedTooth('output', order=19, amplitudes=(0.5,), width=0.02, place=0.5)
    >>> tooth.burst(np.array([0.5, 0.53])).round(3)
    array([ 1.   , -0.294])
    >>> abs(tooth.phasor(19.0)).round(4)
    array([0.0251])
    """

    shaft: str
    order: int
    amplitudes: tuple[float, ...]
    width: float = 0.02
    place: float = 0.5

    def __post_init__(self) -> None:
        """Check the parameters."""
        if self.order != int(self.order) or self.order < 0:
            raise ParameterError(f'order {self.order} of a chipped tooth: give a whole number, '
                                 'at least 0')
        if not 0 < self.width <= _MAX_WIDTH:
            raise ParameterError(f'width {self.width} of a chipped tooth: must be positive and at '
                                 f'most {_MAX_WIDTH} revolutions')

    def burst(self, angle: FloatArray) -> FloatArray:
        """Return the burst of unit amplitude at some angles of the shaft, revolutions."""
        near = (angle - self.place + 0.5) % 1.0 - 0.5
        window = sum(np.exp(-0.5 * ((near + turn) / self.width) ** 2) for turn in (-1, 0, 1))
        return np.asarray(window * np.cos(2.0 * np.pi * self.order * near))

    def phasor(self, order: float) -> ComplexArray:
        """Return the complex amplitude of each channel at an order of the shaft."""
        if order != round(order):
            return np.zeros(len(self.amplitudes), dtype=np.complex128)
        lines = sum(np.exp(-2.0 * (np.pi * self.width * (order + sign * self.order)) ** 2)
                    for sign in (-1, 1)) * self.width * np.sqrt(2.0 * np.pi)
        twin = 0.5 if order == 0 else 1.0
        turn = np.exp(-2j * np.pi * order * self.place)
        return np.asarray(np.array(self.amplitudes) * twin * lines * turn)


def mesh(shaft: str, teeth: int, *, harmonics: Sequence[float] = (1.0, 0.5, 0.25),
         channel_gains: Sequence[float] = (1.0,), sidebands: Mapping[float, float] | None = None,
         seed: int = 0) -> tuple[Component, ...]:
    """
    Return the components of a gear mesh with random phases.

    Parameters
    ----------
    shaft
        Shaft of the gear.
    teeth
        Of the gear: the mesh order.
    harmonics
        Peak amplitudes of the mesh order and its multiples.
    channel_gains
        Factor on each channel.
    sidebands
        Distance from each harmonic in orders: amplitude relative to it, on either side.
    seed
        Of the phases.

    Examples
    --------
    >>> [(line.order, line.amplitudes) for line in mesh('output', 19, harmonics=(1.0, 0.5))]
    [(19.0, (1.0,)), (38.0, (0.5,))]

    """
    lines = [(teeth * (k + 1.0), amplitude) for k, amplitude in enumerate(harmonics)]
    lines += [(order + side * distance, relative * amplitude) for order, amplitude in list(lines)
              for distance, relative in (sidebands or {}).items() for side in (-1, 1)]
    stream = RandomStream(seed, f'mesh {shaft} {teeth}', rows=len(channel_gains))
    phases = 2.0 * np.pi * stream.uniform(0, len(lines))
    return tuple(
        Component(shaft, order, tuple(amplitude * gain for gain in channel_gains),
                  tuple(phases[:, k].tolist()))
        for k, (order, amplitude) in enumerate(lines))
