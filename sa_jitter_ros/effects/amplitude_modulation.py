# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Amplitude modulation: the vibration of the shaft grows and shrinks with the load."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
import math
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.effects.band import (
    memory, NARROWEST, SLOW_BAND, slow_band, slow_covariance, slow_memory, WIDEST)
from sa_jitter_ros.effects.common_gain import correlations, fit_common_gain
from sa_jitter_ros.effects.effect import (
    absent, DirectEffect, Effect, Finding, largest_power, parameter, weighed)
from sa_jitter_ros.effects.evidence import Evidence
from sa_jitter_ros.prediction.angle_error import drawn_normal
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.pulses.angle_law import Covariance
from sa_jitter_ros.pulses.resampling import FULL_BAND


@dataclass(frozen=True)
class SlowGain:
    """A slow normal gain of mean 1 and variance `variance`, as a factor of the component."""

    variance: float
    trigger_cycles: int
    band: tuple[float, float] = SLOW_BAND

    @property
    def correlation_length(self) -> int:
        """Return the memory in cycles."""
        return slow_memory(self.trigger_cycles, self.band)

    @property
    def covariance(self) -> Covariance:
        """Return Cov[a_k(u), a_{k+lag}(v)]."""
        return slow_covariance(self.variance, self.trigger_cycles, self.band)

    def characteristic(
        self, coefficients: Sequence[ArrayLike], positions: Sequence[ArrayLike],
        cycles: Sequence[int],
    ) -> Array:
        """Return E prod a, which is 1 + the sum of the covariances of all pairs (3 points)."""
        total: Array = np.ones(())
        for (u, k), (v, m) in combinations(zip(positions, cycles), 2):
            if abs(m - k) <= self.correlation_length:
                total = total + self.covariance(np.asarray(u), np.asarray(v), m - k)
        return np.asarray(total)

    def draw_gain(self, rng: np.random.Generator, cycles: int, u: Array, count: int) -> Array:
        """Return `count` gains (cycle, u, draw)."""
        drawn = drawn_normal(rng, self.covariance, min(self.correlation_length, cycles - 1),
                             cycles, u, count)
        return np.asarray(1.0 + drawn.astype(float))  # single precision loses a small one


@dataclass(frozen=True)
class AmplitudeModulation(DirectEffect):
    """
    A slow random gain of mean 1 and standard deviation `std`, common to a shaft's orders.

    Its spectrum is that of `PhaseWander`: flat, with frequencies up to `bandwidth` times the
    trigger rate. The narrower, the less of it an average takes out.
    """

    name: ClassVar[str] = 'amplitude_modulation'
    summary: ClassVar[str] = 'slow modulation of the amplitude'
    meaning: ClassVar[str] = 'all amplitudes grow and shrink together, as they do with the load'
    remedy: ClassVar[str] = 'compare averages of the same load'
    scatters: ClassVar[bool] = True
    std: float = parameter(0.0, 'standard deviation of the gain', '1', minimum=0.0, maximum=1.0)
    bandwidth: float = parameter(
        SLOW_BAND[1], 'highest frequency of the gain, cycles a trigger cycle', '1',
        minimum=NARROWEST, maximum=WIDEST)

    def processes(self, model: DeclaredModel) -> Sequence[Any]:
        """Return the gain, band-limited below half the trigger rate."""
        if self.std == 0.0:
            return ()
        return (SlowGain(self.std**2, model.trigger_cycles, slow_band(self.bandwidth)),)

    @classmethod
    def limit(cls, evidence: Evidence) -> Effect | None:
        """Return the modulation that the amplitudes of the orders together allow."""
        radial, noise = evidence.of_orders(evidence.lines.radial)
        if not noise.size:
            return None
        if noise.size == 1:  # all that it scatters may be a modulation
            product, known, square = radial**2, 0.0, 0.0
        else:
            weight = 1.0 / noise**2
            pairs = weight.sum() ** 2 - np.sum(weight**2)
            known, square = 1.0 / weight.sum(), 1.0 / pairs
            product = ((radial @ weight) ** 2 - radial**2 @ weight**2) / pairs  # of others
        power = largest_power(float(product.mean()), product.size, known, square,
                              memory(SLOW_BAND))
        of_cycle = float(correlations(np.array(SLOW_BAND[1:]), 1)[0, 0])
        return cls(min(math.sqrt(power / of_cycle), 1.0))

    @classmethod
    def fit(cls, evidence: Evidence) -> Finding:
        """Fit what is common to the amplitudes of all orders, cycle by cycle."""
        radial, noise = evidence.of_orders(evidence.lines.radial)
        if not noise.size:
            return absent(cls.name, 'no line is compared')
        beside = evidence.lines.order.max() + 0.5 / evidence.model.cycle_length
        end = FULL_BAND * evidence.model.sample_rate / evidence.model.fundamental_frequency
        if noise.size == 1 and 0.0 < end < beside:  # slow noise is larger than fast one, too
            return absent(cls.name, 'the one order that is compared has noise that ends beside it')
        found = fit_common_gain(radial, noise)
        if not found.powers.any():
            return absent(cls.name, 'the one order that is compared scatters as noise does')
        whole = evidence.lines.with_sources
        of_size = found if whole is None else fit_common_gain(*evidence.of_orders(whole))
        of_size = of_size if of_size.powers.any() else found
        (std, std_error), (bandwidth, bandwidth_error) = of_size.size_and_width()
        text = f'the amplitudes of all lines grow and shrink together by {std:.2%}'
        return weighed(Finding(
            cls.name, cls(min(std, 1.0), bandwidth),
            {'std': std_error, 'bandwidth': bandwidth_error}, 1.0, text),
            found.likelihood, found.powers.size, evidence)
