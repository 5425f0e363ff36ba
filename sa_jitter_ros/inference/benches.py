# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""What scoring needs of the observations of some recordings of one machine."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from sa_jitter_ros.effects import Effect
from sa_jitter_ros.effects.lattice import Clock, SAME_RATE
from sa_jitter_ros.errors import ModelError
from sa_jitter_ros.inference.expectation import Memory
from sa_jitter_ros.inference.gathering import (
    channel_groups, choose_lines, gather_pulses, hidden_lines, line_evidence)
from sa_jitter_ros.inference.observation import Observation
from sa_jitter_ros.inference.scoring import Bench
from sa_jitter_ros.recordings.recording import Recording

_HELD_OUT = 6


def make_bench(observation: Observation, observations: Sequence[Observation],
               recordings: Sequence[Recording], declared: Sequence[Effect]) -> Bench:
    """Return what scoring needs of `observation`, the joined `observations` of `recordings`."""
    lines = choose_lines(observation)
    count = len(observation.acquisitions)
    fit, held_out = parted(count)
    group = channel_groups(observation)
    known = [gather_pulses(recording, item, group)
             for recording, item in zip(recordings, observations)]
    clock = _one_clock([found for found, _ in known])
    orders = observation.orders.size
    corrected = np.abs(observation.stacked('corrected')[list(fit), ..., :orders]).mean(axis=0)
    hidden = hidden_lines(observation, lines)
    bench = Bench(
        observation, lines, lines.of(corrected), [row for _, rows in known for row in rows], clock,
        group, line_evidence(observation, lines), fit, held_out, tuple(declared))
    if hidden.count:
        bench = replace(bench, hidden=replace(
            bench, lines=hidden, level=hidden.of(corrected), memory=Memory()))
    return bench.with_moving_source(())


def parted(count: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return acquisitions that fit parameters, and those in the middle that are held out."""
    few = max(count // 3, min(count // 2, _HELD_OUT))
    start = (count - few) // 2
    held_out = tuple(range(start, start + few))
    return tuple(a for a in range(count) if a not in held_out), held_out


def few_of(bench: Bench) -> list[int]:
    """Return the slowest, the median and the fastest of the acquisitions that fit parameters."""
    items = bench.observation.acquisitions
    slower = sorted(bench.fit, key=lambda a: float(np.ptp(items[a].times)), reverse=True)
    return sorted({slower[0], slower[len(slower) // 2], slower[-1]})


def _one_clock(clocks: Sequence[Clock]) -> Clock:
    """Return the clock of all recordings; raise ModelError where they have different ones."""
    first = clocks[0]
    for number, other in enumerate(clocks[1:], start=2):
        if abs(other.rate - first.rate) > SAME_RATE * first.rate:
            raise ModelError(f'pulse times of recording 1 lie on {_grid(first)}, those of '
                             f'recording {number} on {_grid(other)}: one declared model holds for '
                             'one clock; run the loop on each alone')
    return first


def _grid(clock: Clock) -> str:
    return f'a grid of {clock.rate:.6g} Hz' if clock.rate else 'no coarse grid'
