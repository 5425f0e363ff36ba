# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Fewer cycles: the same acquisitions averaged over fewer trigger cycles each."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.inference.expectation import Memory
from sa_jitter_ros.inference.observation import Acquisition, Observation
from sa_jitter_ros.inference.scoring import Bench

_FEWEST = 4  # trigger cycles, and fundamental cycles, of an average
_FOLD = 8


def with_fewer_cycles(bench: Bench) -> Bench:
    """Return the bench with `fewer`: averages over an eighth of the cycles, or the fewest."""
    model = bench.observation.model
    count = int(max(_FEWEST, np.ceil(_FEWEST / model.cycle_length), model.trigger_cycles // _FOLD))
    if 2 * count > model.trigger_cycles:
        return bench
    return replace(bench, fewer=fewer_cycles(bench, count))


def fewer_cycles(bench: Bench, count: int) -> Bench:
    """
    Return a bench whose acquisitions are averages over `count` trigger cycles of each acquisition.

    Remaining cycles at the end of an acquisition are not used. The parts of a held-out acquisition
    are held out, too.
    """
    observation = bench.observation
    parts = observation.model.trigger_cycles // count
    model = replace(observation.model, trigger_cycles=count)
    starts = [part * count for part in range(parts)]

    def places(chosen: tuple[int, ...]) -> tuple[int, ...]:
        return tuple(a * parts + part for a in chosen for part in range(parts))

    acquisitions = tuple(_part(observation, item, start, count)
                         for item in observation.acquisitions for start in starts)
    reach = model.weights.before + count + model.weights.after
    pulses = [[row.without(start, row.times.size - 1 - start - reach) for row in rows]
              for rows in bench.pulses for start in starts]
    return replace(bench, observation=replace(observation, model=model, acquisitions=acquisitions),
                   pulses=pulses, fit=places(bench.fit), held_out=places(bench.held_out),
                   memory=Memory())


def _part(observation: Observation, item: Acquisition, start: int, count: int) -> Acquisition:
    """Return `count` cycles of an acquisition, which begin at angle 0."""
    stop = start + count
    pulses, cycles = slice(start, stop + 1), slice(start, stop)
    index = item.number
    ratio = observation.model.cycle_length
    longer = np.sqrt(item.missing.size / count)
    errors = item.errors[pulses]
    return replace(
        item, first=item.first + start, times=item.times[pulses], missing=item.missing[cycles],
        bridged=item.bridged[index[start]:index[stop] + 1], errors=errors - errors.mean(),
        standard_errors=item.standard_errors[pulses],
        raw_cycles=item.raw_cycles[cycles] * _turn(observation, ratio * start),
        cycles=item.cycles[index[start]:index[stop]] * _turn(observation, ratio * index[start]),
        noise=longer * item.noise, noise_floor=longer * item.noise_floor,
        ripple=item.ripple[cycles])


def _turn(observation: Observation, angle: float) -> NDArray[np.complex128]:
    """Return the factor (order,) for an angle 0 that is later by fundamental cycles."""
    return np.asarray(np.exp(2j * np.pi * angle * observation.sources))
