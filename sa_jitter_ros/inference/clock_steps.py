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
Steps of a clock: samples or pulses that were lost unnoticed, as the phases of the lines show.

From such a place on all pulses are late, or early, by the same time, and all lines turn by it.
That is no effect on an average: the recording is in two parts there, each right by itself.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
import math

import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.averaging.spectral_lines import top_between
from sa_jitter_ros.inference.cycle_reader import CycleReader
from sa_jitter_ros.inference.record_pulses import RecordPulses
from sa_jitter_ros.number_text import measured_text
from sa_jitter_ros.prediction.model import DeclaredModel

# Cycles on either side whose mean phasors are compared, most and fewest.
_BESIDE, _FEWEST = 24, 8
# Standard deviations of the contrasts of a record from which on one is a step: drifts make 5.
_CLEAR = 8.0

_FINE = 10  # times that are tried, in a period of the highest order
_EVEN = 0.995  # likelihoods, over the best one, that are as good: then the smallest step counts
_CHUNK = 500  # cycles read at once


@dataclass(frozen=True)
class ClockStep:
    """
    Pulses are late by `step` (s) more from `time` (s) on, with its `standard_error`.

    `pulse` is the first of them among all trigger pulses, interpolated ones included. Lost samples
    of the vibration make pulses late, lost time of the keyphasor early. Steps that differ by a
    multiple of `period` (s), shorter than a trigger cycle, turn all lines alike; None where no
    other step does.
    """

    pulse: int
    time: float
    step: float
    standard_error: float
    period: float | None


def clock_steps(reader: CycleReader, pulses: RecordPulses, stretches: Sequence[slice],
                model: DeclaredModel) -> tuple[ClockStep, ...]:
    """
    Return the steps in unbroken `stretches` of the bridged pulses, in the order of time.

    A step is a delay of all lines, of some cycles after a place against those before, that is far
    beyond all such delays of the record and that one cycle makes. Delays are tried up to half a
    trigger cycle; of those that turn the lines alike, the shortest counts.
    """
    found: list[ClockStep] = []
    for part in stretches:
        phasors = _Phasors.read(reader, pulses.bridged[part], model)
        edges = [0, phasors.count]
        while (step := _clearest(phasors, edges)) is not None:
            at, size, error, period = step
            pulse = part.start + at + 1  # the step is inside cycle `at`
            found.append(ClockStep(pulse, float(np.mean(pulses.bridged[pulse - 1:pulse + 1])),
                                   size, error, period))
            edges = sorted([*edges, at])
    return tuple(sorted(found, key=lambda item: item.pulse))


def steps_text(steps: Sequence[ClockStep]) -> str:
    """Return in words where the clock steps, and by how much."""
    first = steps[0]
    size = measured_text(abs(first.step), first.standard_error, 's')
    way = 'late' if first.step > 0.0 else 'early'
    other = (f' (or that and any multiple of {first.period:.4g} s, which turns the declared '
             'orders alike)' if first.period else '')
    more = f', and at {len(steps) - 1} later times' if len(steps) > 1 else ''
    return (f'from {first.time:.6g} s on the pulses are {size} too {way} against the vibration'
            f'{other}{more}, as lost samples or a slipping shaft make them')


def broken_at_steps(pulses: RecordPulses, steps: Sequence[ClockStep]) -> RecordPulses:
    """Return the pulses with a new run behind every step."""
    later = np.searchsorted(pulses.number, [item.pulse for item in steps])
    starts = pulses.starts_run.copy()
    starts[later] = True
    return replace(pulses, starts_run=starts)


@dataclass(frozen=True)
class _Phasors:
    """
    Sums of the phasors of consecutive trigger cycles, over the root of their noise.

    `total` (cycle + 1, line) is that of all cycles before; `turns` (delay, line) are what the
    `delays` (delay,) in s turn the lines of `frequency` (line,) in Hz by.
    """

    total: Array
    frequency: Array
    delays: Array
    turns: Array

    @property
    def count(self) -> int:
        """Return the number of cycles."""
        return len(self.total) - 1

    @classmethod
    def read(cls, reader: CycleReader, times: Array, model: DeclaredModel) -> '_Phasors':
        """Return the phasors of the declared orders between pulses at `times` (s)."""
        orders = np.array(tuple(dict.fromkeys(model.orders)))
        rows = []
        for first in range(0, times.size - 1, _CHUNK):
            cycles = reader.amplitudes(
                reader.cycles(times[first:first + _CHUNK + 1]), model, orders)
            turned = np.exp(-2j * np.pi * model.cycle_length * first * orders)
            rows.append(np.nan_to_num(cycles) * turned)  # without those that a short cycle refuses
        phasors = np.concatenate(rows)
        noise = np.mean(np.abs(np.diff(phasors, axis=0)) ** 2, axis=0) if len(phasors) > 1 else 1.0
        scaled = phasors / np.sqrt(np.maximum(noise, np.finfo(float).tiny))
        lines = np.concatenate([np.zeros((1, scaled[0].size)),
                                np.cumsum(scaled.reshape(len(scaled), -1), axis=0)])
        frequency = np.tile(orders * model.fundamental_frequency, phasors.shape[1])
        step = 1.0 / (_FINE * float(frequency.max()))
        reach = math.floor(0.5 * model.trigger_period / step)
        delays = step * np.arange(-reach, reach + 1)
        turns = np.exp(-2j * np.pi * np.multiply.outer(delays, frequency))
        return cls(lines, frequency, delays, turns)

    def delay(self, before: tuple[int, int], after: tuple[int, int]) -> float:
        """Return by how much pulses of the cycles `after` are late against those `before`, s."""
        if self.delays.size < 3:  # of a cycle that is short beside the lines
            return 0.0
        both = self._both(before, after)
        likely = (self.turns @ both).real
        good = np.flatnonzero(likely > likely.max() - (1.0 - _EVEN) * np.abs(both).sum())
        best = min(max(int(good[np.argmin(np.abs(self.delays[good]))]), 1), likely.size - 2)
        near = likely[best - 1:best + 2]
        off = float(top_between(near)) if near[0] + near[2] < 2.0 * near[1] else 0.0
        return float(self.delays[best] + off * (self.delays[best] - self.delays[best - 1]))

    def period(self, before: tuple[int, int], after: tuple[int, int]) -> float | None:
        """Return the shortest step in s, below a trigger cycle, that turns no line."""
        weight = np.abs(self._both(before, after))
        step = 0.25 / (_FINE * float(self.frequency.max()))
        steps = step * np.arange(math.ceil(2.0 * float(self.delays.max()) / step))
        alike = np.cos(2.0 * np.pi * np.multiply.outer(steps, self.frequency)) @ weight
        edges = np.flatnonzero(np.diff(alike >= _EVEN * weight.sum())) + 1
        if edges.size < 3:  # the first falls from the steps of nearly no size
            return None
        return float(steps[edges[1] + int(np.argmax(alike[edges[1]:edges[2]]))])

    def likelihood(self, at: int, beside: int, delay: float) -> float:
        """Return how well a `delay` (s) in cycle `at` fits some cycles on either side."""
        likely = (self.turns @ self._both((at - beside, at), (at + 1, at + 1 + beside))).real
        return float(np.interp(delay, self.delays, likely))

    def _both(self, before: tuple[int, int], after: tuple[int, int]) -> Array:
        early, late = (self.total[stop] - self.total[start] for start, stop in (before, after))
        return np.asarray(early.conj() * late)


def _clearest(phasors: _Phasors,
              edges: Sequence[int]) -> tuple[int, float, float, float | None] | None:
    """Return in which cycle the clearest step is, its size, what that errs by, its period."""
    places, delays = [], []
    for low, high in pairwise(edges):
        beside = min(_BESIDE, (high - low) // 3)
        if beside >= _FEWEST:
            for at in range(low + beside, high - beside):
                places.append(at)
                delays.append(phasors.delay((at - beside, at), (at + 1, at + 1 + beside)))
    if len(places) < 2 * _BESIDE:
        return None
    usual = float(np.median(delays))
    apart = np.array(delays) - usual
    largest = int(np.argmax(np.abs(apart)))
    size = apart[largest]
    away = np.abs(np.array(places) - places[largest]) > _BESIDE
    error = float(np.sqrt(np.mean(apart[away] ** 2))) if away.any() else math.inf
    if not abs(size) > _CLEAR * error:
        return None
    at = max(np.array(places)[~away].tolist(),
             key=lambda place: phasors.likelihood(place, _FEWEST, size + usual))
    first, last = max(edge for edge in edges if edge <= at), min(
        edge for edge in edges if edge > at)
    sides = (max(first, at - 2 * _BESIDE), at), (at + 1, min(last, at + 1 + 2 * _BESIDE))
    size = phasors.delay(*sides) - usual
    sudden = all(phasors.likelihood(at, _FEWEST, size + usual) > phasors.likelihood(
        at, _FEWEST, part * size + usual) for part in (0.0, 0.5))
    clear = sudden and abs(size) > _CLEAR * error
    return (at, size, error, phasors.period(*sides)) if clear else None
