# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""A machine at constant speed whose averages are known in closed form, and how to feed it."""

from dataclasses import dataclass, field

import numpy as np
from sa_jitter_ros.averaging.average import AverageSettings
from sa_jitter_ros.averaging.streaming import StreamingAverager
from sa_jitter_ros.averaging.timeline import VibrationTimeline
from sa_jitter_ros.pulses.validation import PulseValidator
from sa_jitter_ros.samples import SampleBlock


@dataclass(frozen=True)
class Machine:
    """
    Cosines of the tach shaft's angle, which is 0 at time 0.

    `components` are {order of the tach shaft: (amplitude, phase)}; channel c holds c + 1 times.
    """

    speed: float = 33.3
    rate: float = 12800.0
    components: dict = field(default_factory=lambda: {
        1.0: (1.0, 0.4), 7.0: (0.5, -1.1), 23.0: (0.2, 2.0)})
    channels: int = 2

    def at(self, times):
        """Return the vibration (channel, time)."""
        wave = sum(a * np.cos(2.0 * np.pi * order * self.speed * times + phase)
                   for order, (a, phase) in self.components.items())
        return np.arange(1, self.channels + 1)[:, None] * wave

    def pulses(self, seconds, start=0.0):
        """Return the true pulse times, one per revolution, from `start` to `start` + `seconds`."""
        first = np.ceil(start * self.speed - 1e-9)
        return np.arange(first, (start + seconds) * self.speed - 1e-9) / self.speed

    def block(self, index, count, *, start=0.0, offset=0.0):
        """Return samples from `index` on; sample 0 is at `start`, headers say `offset` more."""
        times = start + np.arange(index, index + count) / self.rate
        return SampleBlock(self.at(times), start + offset + index / self.rate, self.rate, index)

    def amplitudes(self, pulses, orders, *, cycles=1.0, angle=0.0):
        """
        Return the exact complex amplitudes of channel 0 over these trigger cycles.

        The piecewise-linear law reads the pulses as they are; `cycles` is r, `angle` that of the
        first pulse. The cosine's other half, and all other components, leak in as they must.
        """
        start, period = pulses[:-1], np.diff(pulses)
        orders = np.asarray(orders, dtype=float)[:, None]
        angles = angle + cycles * np.arange(len(period))
        total = np.zeros((len(orders), len(period)), dtype=complex)
        for order, (a, phase) in self.components.items():
            for sign in (1.0, -1.0):
                frequency = sign * order * self.speed
                turns = frequency * period - orders * cycles
                total += a * np.sinc(turns) * np.exp(1j * (
                    sign * phase + 2.0 * np.pi * frequency * start + np.pi * turns))
        return (total * np.exp(-2j * np.pi * orders * angles)).mean(axis=1)


def averager(*, validator=None, timeline=None, **shafts):
    """Return a streaming averager; a shaft is a dictionary of settings."""
    return StreamingAverager(
        {name: AverageSettings(**settings) for name, settings in shafts.items()},
        validator=validator or PulseValidator(), timeline=timeline or VibrationTimeline())


def feed(stream, machine, *, seconds, pulses=None, chunk=0.25):
    """Feed a stretch of a machine in step and return the averages."""
    pulses = machine.pulses(seconds) if pulses is None else pulses
    found, size = [], int(chunk * machine.rate)
    for index in range(0, int(seconds * machine.rate), size):
        end = (index + size) / machine.rate
        found += stream.add_samples(machine.block(index, size))
        found += stream.add_pulses(pulses[(pulses >= end - chunk) & (pulses < end)])
    return found
