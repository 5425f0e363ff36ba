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
A simulated gearbox: vibration and keyphasor pulses at its exact angle.

Samples and pulses depend on the seed and their index only, not on the blocks in which they are
read: they are computed in chunks at fixed indices, and the last chunk is kept.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, reduce
import math
from operator import add

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.arrays import ComplexArray, FloatArray
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.simulation.components import ChippedTooth, Component
from sa_jitter_ros.simulation.effect import Effect, require_number, Setting
from sa_jitter_ros.simulation.keyphasor import Keyphasor, Pulses
from sa_jitter_ros.simulation.motion import Motion, Torsion
from sa_jitter_ros.simulation.random_streams import in_chunks, RandomStream, SinusoidSum, ZERO

CHUNK = 4096
Chunk = Callable[[int], FloatArray]  # of this number
_PULSE_MARGIN = 3  # pulses beyond a window that may be in it because of their errors


@dataclass(frozen=True, eq=False)
class Gearbox:
    """
    A gearbox turned by its tach shaft.

    Sample k is taken at k / `sample_rate`; the tach shaft passes angle 0, which is pulse 0,
    shortly after time 0. The angle of a shaft is its ratio times that of the tach shaft.

    Parameters
    ----------
    components
        Orders of the vibration.
    sample_rate
        Sampling rate of the vibration, Hz.
    shafts
        Speed of each shaft over that of the tach shaft.
    speed
        Speed profile of the tach shaft: pairs of time (s) and speed (Hz), linear between them.
    fluctuation
        Relative speed fluctuation as a function of time, as `band_limited` makes it.
    torsion
        Torsional oscillations of the tach shaft.
    keyphasor
        The target and the waveform of its probe.
    faults
        Chipped teeth.
    effects
        Declared jitter and noise, then undeclared effects; they are applied in this order.
    seed
        Seed of all random numbers.

    Raises
    ------
    ParameterError
        If the parts do not fit each other.

    Examples
    --------
    A gear of 19 teeth whose keyphasor is sampled at 3 kHz:

    >>> from sa_jitter_ros.simulation import DeclaredJitter, mesh
    >>> gearbox = Gearbox(mesh('output', 19), 20e3, shafts={'output': 2.5}, speed=[(0.0, 16.6)],
    ...                   effects=[DeclaredJitter('uniform', 1 / 3e3 / np.sqrt(12))], seed=1)
    >>> gearbox.vibration(0, 20_000).shape, abs(gearbox.amplitude(38.0, 'output')).tolist()
    ((1, 20000), [0.5])
    >>> pulses = gearbox.pulses(0.0, 10.0)
    >>> pulses.times.size, bool(abs(pulses.errors).max() < 0.5 / 3e3)
    (166, True)

    """

    components: Sequence[Component]
    sample_rate: float
    shafts: Mapping[str, float] = field(default_factory=lambda: {'shaft': 1.0})
    speed: Sequence[tuple[float, float]] = ((0.0, 25.0),)
    fluctuation: SinusoidSum = ZERO
    torsion: Sequence[Torsion] = ()
    keyphasor: Keyphasor = field(default_factory=Keyphasor)
    faults: Sequence[ChippedTooth] = ()
    effects: Sequence[Effect] = ()
    seed: int = 0

    def __post_init__(self) -> None:
        """Check that the parts fit."""
        require_number('sample_rate', self.sample_rate, above=0)
        for name, ratio in self.shafts.items():
            require_number(f'ratio of shaft {name}', ratio, above=0)
        parts = self._parts
        for part in parts:
            if part.shaft not in self.shafts:
                raise ParameterError(f'no shaft {part.shaft!r}: choose from '
                                     f'{", ".join(self.shafts)}')
        sizes = {len(part.amplitudes) for part in parts} | {
            len(component.phases) for component in self.components}
        if len(sizes) != 1 or 0 in sizes:
            raise ParameterError(f'components of {sorted(sizes)} channels: give all the same '
                                 'number')
        self.setting  # noqa: B018 (raises the error of an impossible motion)

    @property
    def _parts(self) -> tuple[Component | ChippedTooth, ...]:
        return (*self.components, *self.faults)

    @property
    def channels(self) -> int:
        """Return the number of vibration channels."""
        return len(self._parts[0].amplitudes)

    @cached_property
    def setting(self) -> Setting:
        """Return the properties of this machine that effects may use."""
        keyphasor = self.keyphasor
        motion = Motion(self.speed, self.fluctuation, self.torsion,
                        -0.25 / keyphasor.pulses_per_revolution)
        rate = motion.nominal_speed * keyphasor.pulses_per_revolution / keyphasor.trigger_pulses
        setting = Setting(self.seed, self.sample_rate, self.channels,
                          keyphasor.pulses_per_revolution, rate, motion)
        terms = [effect.speed_fluctuation(setting) for effect in self.effects]
        fluctuation = reduce(add, terms, self.fluctuation)
        return replace(setting, motion=replace(motion, fluctuation=fluctuation),
                       jitter_factor=math.prod(item.jitter_factor() for item in self.effects))

    # --- truth ------------------------------------------------------------------------------

    def angle(self, times: FloatArray, shaft: str | None = None) -> FloatArray:
        """Return the true angle of a shaft (None: the tach shaft) at `times` (s), revolutions."""
        return (1.0 if shaft is None else self.shafts[shaft]) * self.setting.motion.angle(times)

    def shaft_speed(self, times: FloatArray, shaft: str | None = None) -> FloatArray:
        """Return the true speed of a shaft (None: the tach shaft) at `times` (s), Hz."""
        return (1.0 if shaft is None else self.shafts[shaft]) * self.setting.motion.speed(times)

    def amplitude(self, order: float, shaft: str) -> ComplexArray:
        """
        Return the true complex amplitude of an order of a shaft, one per channel.

        It is peak amplitude and phase of a cosine of the true angle of the shaft, without effects,
        summed over the components of all shafts at this order.
        """
        total = np.zeros(self.channels, dtype=np.complex128)
        for component in self.components:
            of_shaft = component.order * self.shafts[component.shaft] / self.shafts[shaft]
            if math.isclose(of_shaft, order, rel_tol=1e-9):
                total += component.phasor
        for fault in self.faults:
            of_fault = order * self.shafts[shaft] / self.shafts[fault.shaft]
            whole = round(of_fault)
            total += fault.phasor(
                whole if math.isclose(of_fault, whole, rel_tol=1e-9) else of_fault)
        return total

    # --- signals ----------------------------------------------------------------------------

    def vibration(self, start: int, stop: int) -> FloatArray:
        """Return samples `start` to `stop`, `channel` x `sample`."""
        return self._read(self._vibration, start, stop)

    def blocks(self, stop: int, samples_per_block: int = CHUNK) -> Iterator[FloatArray]:
        """Iterate over the first `stop` samples in `channel` x `sample` blocks."""
        for start in range(0, stop, samples_per_block):
            yield self.vibration(start, min(start + samples_per_block, stop))

    def tach_waveform(self, start: int, stop: int) -> FloatArray:
        """Return samples `start` to `stop` of the keyphasor waveform, at `keyphasor.rate`."""
        return np.asarray(self._read(self._waveform, start, stop)[0])

    def pulses(self, start: float, stop: float) -> Pulses:
        """Return the pulses measured from time `start` (s) on and before `stop`, in order."""
        pulses, kept = self._pulses_around(start, stop)
        found = np.flatnonzero(kept & (pulses.index >= 0) & (pulses.times >= start)
                               & (pulses.times < stop))
        found = found[np.argsort(pulses.times[found], kind='stable')]
        return Pulses(pulses.index[found], pulses.times[found], pulses.true_times[found])

    def _pulses_around(self, start: float, stop: float) -> tuple[Pulses, NDArray[np.bool_]]:
        """Return consecutive pulses in and around a window, and which of them are measured."""
        setting, count = self.setting, self.keyphasor.pulses_per_revolution
        edges = np.array([start, stop])
        slack = 2.0 * float(np.abs(self._observed(edges) - edges).max())
        low, high = count * setting.motion.angle(np.array([start - slack, stop + slack]))
        index = np.arange(math.floor(low) - _PULSE_MARGIN, math.ceil(high) + _PULSE_MARGIN + 1)
        true_times = setting.motion.time_at(index / count)
        delay = sum((effect.pulse_delay(setting, index, true_times) for effect in self.effects),
                    start=np.zeros(index.size))
        kept = np.ones(index.size, dtype=np.bool_)
        for effect in self.effects:
            kept &= effect.kept(setting, index)
        return Pulses(index, self._observed(true_times + delay), true_times), kept

    def _observed(self, times: FloatArray) -> FloatArray:
        for effect in self.effects:
            times = effect.observed(self.setting, times)
        return times

    @staticmethod
    def _read(chunk: Chunk, start: int, stop: int) -> FloatArray:
        if not 0 <= start <= stop:
            raise ParameterError(f'samples {start} to {stop}: must be 0 <= start <= stop')
        return in_chunks(chunk, start, stop, CHUNK)

    @cached_property
    def _vibration(self) -> Chunk:
        return lru_cache(maxsize=1)(self._vibration_chunk)

    @cached_property
    def _waveform(self) -> Chunk:
        return lru_cache(maxsize=1)(self._waveform_chunk)

    def _vibration_chunk(self, number: int) -> FloatArray:
        start, stop = number * CHUNK, (number + 1) * CHUNK
        samples = None
        for effect in self.effects:
            if samples is None:
                samples = effect.sampled(self.setting, self._signal, start, stop)
        if samples is None:
            samples = self._signal(np.arange(start, stop) / self.sample_rate)
        for effect in self.effects:
            samples = samples + effect.added(self.setting, start, stop)
        return samples

    def _signal(self, times: FloatArray) -> FloatArray:
        """Return the vibration at any times: the sum of all components at the true angle."""
        total = np.zeros((self.channels, times.size))
        tach_angle = self.setting.motion.angle(times)
        for shaft, ratio in self.shafts.items():
            components = [item for item in self.components if item.shaft == shaft]
            faults = [item for item in self.faults if item.shaft == shaft]
            if not components and not faults:
                continue
            wander = sum(effect.source_angle(self.setting, shaft, times)
                         for effect in self.effects)
            angle = ratio * tach_angle + wander / (2.0 * np.pi)
            part = np.zeros_like(total)
            if components:
                cycles = np.multiply.outer([item.order for item in components], angle)
                phasors = np.exp(2j * np.pi * (cycles % 1.0))
                part += (np.array([item.phasor for item in components]).T @ phasors).real
            for fault in faults:
                part += np.multiply.outer(fault.amplitudes, fault.burst(angle))
            for effect in self.effects:
                part *= effect.gain(self.setting, shaft, times)
            total += part
        return total

    def _waveform_chunk(self, number: int) -> FloatArray:
        start, stop = number * CHUNK, (number + 1) * CHUNK
        keyphasor, motion = self.keyphasor, self.setting.motion
        times = np.arange(start, stop) / keyphasor.rate
        pulses, kept = self._pulses_around(times[0], times[-1])
        # Between two pulses the delay of the waveform is interpolated between their errors.
        true_times = times - np.interp(times, pulses.times, pulses.errors)
        phase = keyphasor.pulses_per_revolution * motion.angle(true_times)
        pulse = np.floor(phase + 0.25)
        measured = kept[np.clip(pulse - pulses.index[0], 0, kept.size - 1).astype(np.int64)]
        # Without its pulse the waveform keeps the level from before: low, or in the middle.
        within = np.where(measured, phase - pulse, 0.0 if keyphasor.waveform == 'sine' else 0.74)
        rise: FloatArray | float = 0.0
        if keyphasor.rise_time > 0.0:
            pulse_rate = keyphasor.pulses_per_revolution * motion.speed(true_times)
            rise = keyphasor.rise_time * pulse_rate
        waveform = keyphasor.shape(within, rise)
        noise = RandomStream(self.seed, 'keyphasor noise').normal(start, stop)
        return waveform + keyphasor.noise_std * noise
