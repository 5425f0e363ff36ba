# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""A machine whose averages are drawn from their laws, without any vibration."""

from dataclasses import replace

import numpy as np
from sa_jitter_ros.averaging.results import (
    AMPLITUDE_FIELDS, AverageHeader, AverageMessage, ENVELOPE_FIELDS)
from sa_jitter_ros.monitoring.monitor import Settings, ShaftMonitor
from sa_jitter_ros.monitoring.quantities import KINDS, monitored

ORDERS, LEVELS = (1.0, 19.0, 38.0), np.array([0.2, 1.0, 0.5])
NAMES, INDICATORS = ('rms', 'kurtosis', 'm8a'), np.array([0.8, 1.8, 100.0])
BEARINGS = np.array([4.9])
CHANNELS, SECONDS = 2, 60.0  # between averages
SETTINGS = Settings(learning_averages=200)


class DrawnMachine:
    """
    Draws averages of a machine from their laws: amplitudes with noise, indicators with scatter.

    `keyphasor` is the noise that the correction adds, times that of the vibration; `bias` what it
    leaves of the loss, relative, and says so in its standard error; `load` is a relative factor of
    all amplitudes that scatters, `gain` (channel, order) multiplies the amplitudes, `damage` the
    indicators, `strikes` (channel, bearing order) the depth of the modulation by a bearing.
    """

    def __init__(self, seed, *, noise=0.01, load=0.002, keyphasor=0.0, bias=0.0):
        self.rng, self.bearing_rng = np.random.default_rng(seed), np.random.default_rng([seed, 1])
        self.noise, self.load, self.keyphasor, self.bias = noise, load, keyphasor, bias
        self.gain = np.ones((CHANNELS, len(ORDERS)))
        self.damage = np.ones((CHANNELS, len(NAMES)))
        self.strikes = np.ones((CHANNELS, len(BEARINGS)))
        self.speed, self.sequence, self.corrected = 16.6, 0, True

    def messages(self):
        """Return order amplitudes, indicators, their errors and the envelope of an average."""
        rng, shape = self.rng, (CHANNELS, len(ORDERS))
        start = self.sequence * SECONDS
        header = AverageHeader(start, start + 2.0, self.sequence, 30, 72, self.speed)
        self.sequence += 1
        share = (self.speed / 16.6) ** 2 * (1.0 + self.load * rng.standard_normal())
        true = LEVELS * self.gain * share * (1.0 - self.bias)
        own = self.noise * np.sqrt(1.0 + self.keyphasor**2)
        found = np.abs(true + own * (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)))
        table = np.full((*shape, len(AMPLITUDE_FIELDS)), np.nan)
        table[..., 0] = ORDERS
        table[..., 1], table[..., 2] = found * (0.9 - self.bias), 0.1
        if self.corrected:
            table[..., 3], table[..., 4], table[..., 5] = found, 0.1, 0.9 - self.bias
            table[..., 7] = own
            table[..., 10] = np.hypot(own, self.bias * found)
        scatter = 0.01 * np.sqrt(1.0 + self.keyphasor**2)
        indicators = INDICATORS * self.damage * np.exp(
            scatter * rng.standard_normal((CHANNELS, len(NAMES))))
        return (AverageMessage(header, table, AMPLITUDE_FIELDS),
                AverageMessage(header, indicators, NAMES),
                AverageMessage(header, scatter * indicators, NAMES),
                AverageMessage(header, self._envelope(), ENVELOPE_FIELDS))

    def _envelope(self):
        """Return squared-envelope amplitudes, which a load of 30 % moves with their mean."""
        rng = self.bearing_rng
        mean = np.exp(0.3 * rng.standard_normal())
        depth = 0.1 * self.strikes * np.exp(0.05 * rng.standard_normal(self.strikes.shape))
        return np.stack(np.broadcast_arrays(BEARINGS, BEARINGS, mean * depth, mean * 0.005, mean),
                        axis=-1)

    def average(self):
        """Return what is monitored of the next average."""
        return monitored(dict(zip(KINDS, self.messages())))

    def monitor(self, **changes):
        """Return a new monitor."""
        return ShaftMonitor('input', self.average().layout, replace(SETTINGS, **changes))

    def run(self, monitor, count):
        """Give averages to a monitor; return the lines that it says."""
        return [line for _ in range(count) for line in monitor.update(self.average())]
