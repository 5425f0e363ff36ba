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
Numerical models of the synchronous average under jitter, evaluated by Monte Carlo in chunks.

Angles and pulse errors are in fundamental cycles, orders in multiples of the fundamental. Three
ways to average a jittered component are kept apart, because they differ for a non-integer ratio:
`whole_trigger_cycles` (what `order_amplitude` publishes), `whole_fundamental_cycles` (Eq. 23 of
Camerini et al. 2019 with cycles split exactly at the pulses: what the folded waveform holds) and
`majority_assignment` (Eq. 26, the paper's approximate model, with its prefactor 1).
"""

from collections.abc import Callable
from dataclasses import dataclass
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.errors import ModelError, ParameterError
from sa_jitter_ros.prediction.distributions import PulseErrorDistribution
from sa_jitter_ros.prediction.moments import require_cycles, require_orders

Array = NDArray[Any]

_CHUNK = 500_000  # segments evaluated at once: the arrays stay in the cache


@dataclass(frozen=True)
class AveragedSignal:
    """
    A signal of components seen at one order of an average of `trigger_cycles` trigger cycles.

    A trigger cycle is `cycle_length` (r) fundamental cycles long; the signal is
    sum_s amplitudes[s] exp(j 2 pi source_orders[s] theta), by default the analysed `order` alone.
    The three methods map pulse errors of shape (n, trigger_cycles + 1) to n complex amplitudes.
    """

    trigger_cycles: int
    cycle_length: float
    order: float = 1.0
    source_orders: tuple[float, ...] = ()
    amplitudes: tuple[complex, ...] = (1.0,)

    def __post_init__(self) -> None:
        """Check the numbers; one amplitude serves all sources."""
        require_cycles(self.trigger_cycles)
        require_orders(self.order)
        if not (math.isfinite(self.cycle_length) and self.cycle_length > 0.0):
            raise ModelError(f'cycle_length is {self.cycle_length}: a trigger cycle lasts more '
                             'than 0 fundamental cycles')
        sources = tuple(require_orders(self.source_orders or (self.order,)).tolist())
        amplitudes = self.amplitudes * (len(sources) if len(self.amplitudes) == 1 else 1)
        if len(amplitudes) != len(sources):
            raise ModelError(f'{len(amplitudes)} amplitudes for {len(sources)} source_orders: '
                             'give as many, or one')
        object.__setattr__(self, 'source_orders', sources)
        object.__setattr__(self, 'amplitudes', amplitudes)

    def whole_trigger_cycles(self, errors: Array) -> Array:
        """Return the amplitudes integrated over all whole trigger cycles."""
        pulses = np.arange(self.trigger_cycles)
        return self._integrate(errors, pulses, self.cycle_length * pulses,
                               np.full(pulses.size, self.cycle_length), np.zeros(pulses.size))

    def whole_fundamental_cycles(self, errors: Array) -> Array:
        """
        Return the amplitudes of the mean of the floor(N_t r) whole fundamental cycles (Eq. 23).

        Cycles that straddle a pulse are split there. Raises ModelError where none is whole.
        """
        cycles = self._fundamental_cycles()
        edges = self.cycle_length * np.arange(self.trigger_cycles)
        edges = np.append(edges[edges < cycles], cycles)
        if float(self.order) != round(self.order):  # folding is not phase-neutral: split again
            edges = np.union1d(edges, np.arange(cycles + 1))
        middles = 0.5 * (edges[1:] + edges[:-1])
        return self._integrate(
            errors, np.floor(middles / self.cycle_length).astype(int), edges[:-1], np.diff(edges),
            np.floor(middles))

    def majority_assignment(self, errors: Array) -> Array:
        """
        Return the amplitudes with every fundamental cycle given to one trigger cycle (Eq. 26).

        Raises ModelError for r < 1, which the model does not cover.
        """
        if self.cycle_length < 1.0:
            raise ModelError(f'cycle_length is {self.cycle_length}: Eq. 26 needs at least 1; '
                             'use every n-th pulse, or the exact model')
        middles = np.arange(self._fundamental_cycles()) + 0.5
        owner = np.floor(middles / self.cycle_length).astype(int)
        counts = np.bincount(owner, minlength=self.trigger_cycles)
        total: Array = np.zeros(len(errors), complex)
        step = np.diff(errors, axis=1) / self.cycle_length
        for source, amplitude in zip(self.source_orders, self.amplitudes):
            turns = counts * (source - self.order + source * step)
            total += amplitude * np.mean(
                np.exp(1j * np.pi * (2.0 * source * errors[:, :-1] + turns)) * np.sinc(turns),
                axis=1)
        return total

    def _fundamental_cycles(self) -> int:
        cycles = math.floor(self.trigger_cycles * self.cycle_length * (1.0 + 1e-12))
        if cycles < 1:
            raise ModelError(
                f'{self.trigger_cycles} trigger cycles of {self.cycle_length} fundamental cycles '
                'hold no whole one: average over more')
        return cycles

    def _integrate(
        self, errors: Array, pulse: Array, start: Array, length: Array, folded: Array,
    ) -> Array:
        """Integrate over segments of linear phase and divide by their total length."""
        total: Array = np.zeros(len(errors), complex)
        step = np.diff(errors, axis=1)[:, pulse] / self.cycle_length
        middle = start + 0.5 * length
        error = errors[:, pulse] + step * (middle - self.cycle_length * pulse)
        for source, amplitude in zip(self.source_orders, self.amplitudes):
            turns = 2.0 * ((source - self.order) * middle + self.order * folded) % 2.0
            phase = np.pi * (2.0 * source * error + turns)
            weight = np.sinc((source * step + (source - self.order)) * length) * length
            total += (amplitude / length.sum()) * (
                np.sum(weight * np.cos(phase), axis=1)
                + 1j * np.sum(weight * np.sin(phase), axis=1))
        return total


def monte_carlo(
    amplitudes: Callable[[Array], Array], distribution: PulseErrorDistribution,
    trigger_cycles: int, iterations: int, *, seed: int, line_variance: float = 0.0,
    progress: Callable[[float], None] | None = None,
) -> Array:
    """
    Return `iterations` complex amplitudes of averages with independent pulse errors.

    `amplitudes` is a method of `AveragedSignal`; `distribution` is in fundamental cycles;
    `line_variance` is E|n|^2 of additive noise; `progress` is called with the fraction done.
    Raises ParameterError for fewer than 1 iteration.
    """
    if iterations < 1:
        raise ParameterError(f'iterations is {iterations}: at least 1 is needed')
    require_cycles(trigger_cycles)
    rng, noise_rng = (np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(2))
    chunk = max(1, _CHUNK // (trigger_cycles + 1))
    result = np.empty(iterations, complex)
    for first in range(0, iterations, chunk):
        part = result[first:first + chunk]
        part[:] = amplitudes(distribution.draw(rng, (part.size, trigger_cycles + 1)))
        if line_variance:
            part += np.sqrt(0.5 * line_variance) * (
                noise_rng.normal(size=(part.size, 2)) @ np.array([1.0, 1j]))
        if progress is not None:
            progress((first + part.size) / iterations)
    return result
