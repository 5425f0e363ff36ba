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
A machine whose vibration is known, and the averages that follow from it.

A *run* is what one source sends on one clock: cosines at orders of the tach shaft, whose amplitude
changes slowly, so that no two intervals are alike; and teeth, some of them missing or displaced.
The expected average is the integral of the cosines between the pulses as they were sent.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.samples import SampleBlock

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

RATE = 6400.0  # Hz, of vibration and tach waveform
TEETH = 2  # pulses in a revolution
SWELL_RATE = 0.11  # Hz
EDGE = 4.0 / RATE  # s that an edge of the tach waveform takes
WIDTH = 10.0 / RATE  # s of a pulse at half its height
AROUND = 10  # teeth beside a fault that the validation may find doubtful
MESH = 30.0  # order of the tach shaft that shows the pulse errors
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(160)
NODES, WEIGHTS = 0.5 * (_NODES + 1.0), 0.5 * _WEIGHTS


@dataclass(frozen=True)
class Run:
    """
    One source on one clock; `tau` (s) is the time since its sample 0.

    Sample i has the header time `clock` + i / `RATE` and the index `index` + i, tooth j passes at
    `first_tooth` + j / (`TEETH` `speed`). `components` are (order of the tach shaft, amplitude,
    phase); channel c holds c + 1 times as much. `jitter` (s) and `displaced` (s) are errors of
    teeth, others are `missing`; of the `undelivered`, some come `behind` so many later ones.
    `strays` are pulses (tau) that no tooth made, `lost` spans (tau) without vibration.
    """

    number: int
    speed: float
    clock: float
    index: int
    first_tooth: float
    channels: int
    components: tuple[tuple[float, float, float], ...]
    begin: float = 0.0
    jitter: dict[int, float] = field(default_factory=dict)
    displaced: dict[int, float] = field(default_factory=dict)
    missing: set[int] = field(default_factory=set)
    undelivered: set[int] = field(default_factory=set)
    behind: dict[int, int] = field(default_factory=dict)
    strays: list[float] = field(default_factory=list)
    lost: list[tuple[float, float]] = field(default_factory=list)

    @cached_property
    def scale(self) -> float:
        """Return the largest value that channel 0 can have."""
        return 1.3 * sum(amplitude for _, amplitude, _ in self.components)

    @property
    def steepest(self) -> float:
        """Return the largest change of channel 0 in a second."""
        return 1.3 * 2.0 * np.pi * self.speed * sum(
            order * amplitude for order, amplitude, _ in self.components)

    def at(self, tau: FloatArray) -> FloatArray:
        """Return the vibration of channel 0."""
        swell = 1.0 + 0.3 * np.sin(2.0 * np.pi * SWELL_RATE * tau)
        return np.asarray(swell * sum(
            amplitude * np.cos(2.0 * np.pi * order * self.speed * tau + phase)
            for order, amplitude, phase in self.components))

    def block(self, first: int, count: int) -> SampleBlock:
        """Return samples `first` to `first` + `count` of all channels."""
        wave = self.at((first + np.arange(count)) / RATE)
        return SampleBlock(np.arange(1, self.channels + 1)[:, None] * wave,
                           self.clock + first / RATE, RATE, self.index + first)

    def waveform(self, first: int, count: int) -> SampleBlock:
        """Return samples of the tach waveform, whose rising edges are at the pulses."""
        tau = (first + np.arange(count)) / RATE
        reach = WIDTH + 2.0 * EDGE + 0.5 / (TEETH * self.speed)  # of a displaced tooth
        teeth = self.teeth(tau[0] - reach, tau[-1] + reach)
        pulses = np.concatenate([self.times(teeth), [
            item for item in self.strays if tau[0] - reach < item < tau[-1] + reach]])
        wave = np.zeros(count)
        for pulse in pulses:
            edge = 0.5 * (WIDTH + EDGE) - np.abs(tau - pulse - 0.5 * WIDTH)
            wave = np.maximum(wave, np.clip(edge / EDGE, 0.0, 1.0))
        return SampleBlock(wave[None], self.clock + first / RATE, RATE, self.index + first)

    def teeth(self, begin: float, end: float) -> NDArray[np.int64]:
        """Return the teeth, less the missing ones, whose true times are in a span (tau)."""
        pitch = 1.0 / (TEETH * self.speed)
        first, stop = (int(np.ceil((at - self.first_tooth) / pitch)) for at in (begin, end))
        return np.array([tooth for tooth in range(max(first, 0), stop)
                         if tooth not in self.missing], dtype=np.int64)

    def times(self, teeth: NDArray[np.int64]) -> FloatArray:
        """Return when (tau) the keyphasor shows these teeth."""
        return self.first_tooth + teeth / (TEETH * self.speed) + self.errors(teeth)

    def errors(self, teeth: NDArray[np.int64]) -> FloatArray:
        """Return how much later (s) than it passes the keyphasor shows each tooth."""
        return np.array([self.jitter.get(tooth, 0.0) + self.displaced.get(tooth, 0.0)
                         for tooth in teeth.tolist()])

    def tooth_at(self, time: float, *, bridged: bool) -> int | None:
        """
        Return the tooth whose pulse has this header time (s), or None.

        If missing pulses are `bridged`, that of one near a fault may be interpolated.
        """
        tau = time - self.clock
        tooth = round((tau - self.first_tooth) * TEETH * self.speed)
        if tooth < 0:
            return None
        shown = float(self.times(np.array([tooth]))[0])
        if bridged and self.faults(tooth - AROUND, tooth + AROUND) and abs(
                tau - self.first_tooth - tooth / (TEETH * self.speed)) <= self.most:
            return tooth
        # to the nanosecond in messages, and as absolute times round
        return tooth if abs(shown - tau) < 3e-9 + 2e-15 * abs(time) else None

    @property
    def most(self) -> float:
        """Return by how much (s) an interpolated pulse may be off the one that is shown."""
        return 2.0 * max(map(abs, self.jitter.values()), default=0.0) + 3e-9

    def faults(self, first: int, last: int) -> list[int]:
        """Return the teeth, from `first` to `last`, with a fault or a stray beside them."""
        beside = {round((stray - self.first_tooth) * TEETH * self.speed) for stray in self.strays}
        every = beside.union(self.missing, self.undelivered, self.displaced)
        return sorted(tooth for tooth in every if first <= tooth <= last)

    def sent(self, begin: float, end: float) -> bool:
        """Whether all vibration in a span (tau) was sent and could be used."""
        return begin >= self.begin - 1e-9 and all(
            end <= start or begin >= stop - 1.0 / RATE for start, stop in self.lost)


@dataclass(frozen=True)
class Window:
    """
    Consecutive trigger cycles of a run, of which the last `trigger_cycles` make an average.

    `pulses` (tau) bound them; r = `cycles` fundamental cycles lie between two.
    """

    run: Run
    pulses: FloatArray
    cycles: float
    trigger_cycles: int

    def latest(self, count: int) -> 'Window':
        """Return the window of the last `count` trigger cycles."""
        return replace(self, pulses=self.pulses[-count - 1:])

    def amplitudes(self, orders: FloatArray) -> ComplexArray:
        """Return complex amplitudes of cycles x orders, the average's own angle beginning at 0."""
        start, period = self.pulses[:-1], np.diff(self.pulses)
        wave = self.run.at(start[:, None] + period[:, None] * NODES)
        basis = WEIGHTS[:, None] * np.exp(-2j * np.pi * self.cycles * np.outer(NODES, orders))
        angle = self.cycles * (np.arange(len(period)) - (len(period) - self.trigger_cycles))
        return np.asarray(2.0 * (wave @ basis) * np.exp(-2j * np.pi * np.outer(angle, orders)))

    def uncertain(self, orders: FloatArray, numbers: Sequence[int]) -> list[ComplexArray]:
        """Return by how much the amplitudes can change for each of these pulses interpolated."""
        found, known = [], self.amplitudes(orders)
        for number in numbers:
            pulses = self.pulses.copy()
            pulses[number] += self.run.most
            found.append(replace(self, pulses=pulses).amplitudes(orders) - known)
        return found

    def waveforms(self, first: int, points: int) -> FloatArray:
        """
        Return the whole fundamental cycles (cycle, angle) of the window.

        `first` is how many trigger cycles after angle 0 it begins.
        """
        r, count = self.cycles, len(self.pulses) - 1
        whole = np.arange(np.ceil(first * r - 1e-9), np.floor((first + count) * r + 1e-9))
        angle = (whole[:, None] + np.arange(points) / points) / r - first
        return self.run.at(np.interp(angle, np.arange(count + 1), self.pulses))


def equal_weights(count: int) -> FloatArray:
    """Return equal weights."""
    return np.full(count, 1.0 / max(count, 1))


def exponential_weights(count: int, cycles: float) -> FloatArray:
    """Return the weights of a mean that forgets with 2 / (`cycles` + 1)."""
    weights = np.zeros(count)
    for number in range(count):
        weight = max(2.0 / (cycles + 1.0), 1.0 / (number + 1))
        weights *= 1.0 - weight
        weights[number] = weight
    return weights
