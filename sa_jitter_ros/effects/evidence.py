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
What effects are fitted to: pulse errors, ripple and amplitudes of the acquisitions of one record.

The loop gathers `Evidence` from the acquisitions that it fits effects to. The contributions of
effects that were added before (`explained`) are subtracted.
"""

from dataclasses import dataclass
import math

import numpy as np
from sa_jitter_ros.arrays import Array, IntArray
from sa_jitter_ros.effects.lattice import Clock

from sa_jitter_ros.prediction.influence import (
    AveragePulses, declared_jitter, Influence, mean_period)
from sa_jitter_ros.prediction.model import DeclaredModel


@dataclass(frozen=True)
class Tone:
    """
    The strongest tone: its `frequency` (Hz), its peak `amplitude`, and their errors.

    `likelihood` is the gain in log likelihood by the amplitudes on all `channels`, at the best of
    so many frequencies `tried`.
    """

    frequency: float
    amplitude: float
    frequency_error: float
    standard_error: float
    likelihood: float
    channels: int
    tried: float


@dataclass(frozen=True)
class Beat:
    """
    A common beat of the lines that an interpolator causes.

    `gain` is what it adds to the logarithm of the evidence, `p_value` the chance of as much
    without one. `method` is the interpolator, '' unless the beat is certain, and `kept` (line,)
    the share of the amplitude that it leaves; `frequency` is in Hz.
    """

    gain: float = 0.0
    p_value: float = 1.0
    method: str = ''
    kept: Array | float = 1.0
    frequency: float = 0.0


@dataclass(frozen=True)
class LineEvidence:
    """
    How the amplitudes of the lines (an order on a channel) scatter, pulse errors taken out.

    `order` and `channel` (line,); `level` (line,) mean peak amplitudes; `noise_density`
    (acquisition, line) the standard deviation per sample of white noise that makes the line's
    noise, in the units of the recording; `radial` (acquisition, cycle, line) each cycle's
    amplitude over `level`, less 1, and `radial_noise` (line,) its standard deviation by noise
    alone. `tone` is what stands out most between the synchronous lines, `hidden_tone` the largest
    amplitude that would not, with its standard error; `beat` is the beat of an interpolator, which
    `radial` is without. `with_sources` is as `radial`, with what undeclared sources beside the
    orders make of it: the fastest part of a modulation passes for them. `number` (acquisition,
    cycle) counts the cycles; some are left out where those of acquisitions do not follow.
    """

    order: Array
    channel: Array
    level: Array
    noise_density: Array
    radial: Array
    radial_noise: Array
    tone: Tone | None = None
    hidden_tone: tuple[float, float] = (0.0, math.inf)
    beat: Beat = Beat()
    with_sources: Array | None = None
    number: IntArray | None = None


@dataclass(frozen=True)
class Evidence:
    """
    Measurements of the acquisitions that a fit may use.

    `errors` and `standard_errors` (acquisition, N_t + 1) are pulse errors in s, of mean 0 in each
    acquisition, less the patterns of the effects in `explained`; they were measured against a
    better keyphasor, or else recovered from the vibration. `ripple`
    (acquisition, N_t) is the factor of u (1 - u) in the error inside each cycle, in s.
    `record_times` are all pulses of the record, `record_missing` (interval,) the number of pulses
    that are missing in each of its intervals; `clock` is the one on whose ticks all pulse times
    lie, if any.
    """

    model: DeclaredModel
    pulses: tuple[AveragePulses, ...]
    errors: Array
    standard_errors: Array
    ripple: Array
    record_times: Array
    record_missing: Array
    clock: Clock
    lines: LineEvidence
    explained: tuple[Influence, ...] = ()

    @property
    def period(self) -> float:
        """Return the mean trigger period in s."""
        return float(np.mean([mean_period(item.times, item.missing) for item in self.pulses]))

    @property
    def cycles(self) -> int:
        """Return the number of trigger cycles that the lines were measured in."""
        return int(np.prod(self.lines.radial.shape[:2]))

    def of_orders(self, radial: Array) -> tuple[Array, Array]:
        """
        Return `radial` (acquisition, cycle, group) and its noise (group,) of lines that differ.

        What is beside an order, be it a noise or the line of a bearing, reaches all channels, and
        the orders that a trigger cycle does not resolve from it: that it changes them together
        tells no more than one of them does.
        """
        lines = self.lines
        found, place = np.unique(lines.order, return_inverse=True)
        apart = (np.diff(found) * self.model.cycle_length).round(6) >= 1.0
        group = np.concatenate(([0], np.cumsum(apart)))[place]
        weight = (group[:, None] == np.unique(group)) / np.maximum(
            lines.radial_noise, 1e-9)[:, None] ** 2
        information = weight.sum(axis=0)
        return radial @ (weight / information), 1.0 / np.sqrt(information)

    @property
    def times(self) -> Array:
        """Return when the pulses were measured (acquisition, N_t + 1), in s."""
        return np.array([pulses.times for pulses in self.pulses])

    def expected_autocovariance(self, lags: Array) -> Array:
        """Return what declared jitter and added effects explain at `lags`, in s^2."""
        jitter = declared_jitter(self.model, self.explained)
        total = np.where(lags == 0, jitter.variance if jitter else 0.0, 0.0)
        for effect in self.explained:
            total = total + effect.pulse_autocovariance(self.model, lags)
        return np.asarray(total)


def root(variance: float, error: float) -> tuple[float, float]:
    """
    Return the standard deviation of an estimated variance and its standard error.

    A variance that is small beside its `error` has a root as uncertain as the root of that.
    """
    std = math.sqrt(max(variance, 0.0))
    return std, error / (std + math.sqrt(std**2 + error)) if error else 0.0
