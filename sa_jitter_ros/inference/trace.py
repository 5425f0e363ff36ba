# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

# The name is that of the concept; a module in a package hides no builtin one.
# flake8: noqa: A005

"""
The trace: effects are added one at a time while a significant residual remains.

Effects are fitted to one half of the acquisitions (every other one) and scored on the other half.
The result may be that no effect explains the residual.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.effects import Effect, EFFECTS
from sa_jitter_ros.effects.effect import Finding
from sa_jitter_ros.effects.evidence import Evidence
from sa_jitter_ros.effects.lattice import Clock
from sa_jitter_ros.errors import ModelError, SignalError
from sa_jitter_ros.inference.candidates import best_of, Candidate, SIGNIFICANT, try_all
from sa_jitter_ros.inference.dependence import Dependence, dependences, moving
from sa_jitter_ros.inference.expectation import Expectation, Lines
from sa_jitter_ros.inference.fewer_cycles import with_fewer_cycles
from sa_jitter_ros.inference.gathering import (
    channel_groups, choose_lines, gather_pulses, line_evidence)
from sa_jitter_ros.inference.observation import Observation, together
from sa_jitter_ros.inference.residual import Residual, UNDEFINED
from sa_jitter_ros.inference.scoring import Bench
from sa_jitter_ros.recordings.recording import Recording

Array = NDArray[Any]
Progress = Callable[[str], None]

_MOST_EFFECTS = 4
_FEWEST = 4
_SAME_CLOCK = 0.01


@dataclass(frozen=True)
class Trace:
    """
    Result of the trace; `before` and `after` are residuals of held-out acquisitions.

    `dependences_before` and `dependences_after` are their changes with order, speed and cycles.
    `prediction_before` and `prediction_after` are predictions for all acquisitions
    (acquisition, line) of the `lines`, `attenuation` and `amplitude` the observed values.
    `evidence` is that of the first round, less declared effects only. `unsteadiness` is the
    unexplained scatter of the amplitudes relative to their level, part of the scale of both
    residuals. `not_compared` says why there are no `lines`, '' where there are some.
    """

    observation: Observation
    declared: tuple[Effect, ...]
    lines: Lines
    level: Array
    fit: tuple[int, ...]
    held_out: tuple[int, ...]
    findings: tuple[Finding, ...]
    candidates: tuple[Candidate, ...]
    before: Residual
    after: Residual
    dependences_before: tuple[Dependence, ...]
    dependences_after: tuple[Dependence, ...]
    attenuation: Array
    amplitude: Array
    prediction_before: Expectation
    prediction_after: Expectation
    evidence: Evidence | None
    verdict: str
    unsteadiness: float
    not_compared: str = ''


def trace(observations: Sequence[Observation], recordings: Sequence[Recording], *,
          declared: Sequence[Effect] = (), progress: Progress | None = None) -> Trace:
    """
    Trace the residual of the observations of some recordings of one machine.

    `declared` are the effects of the declared model.

    Where no line can be compared, nothing is found, and the trace says why.
    """
    whole = together(observations)
    try:
        require_acquisitions(whole)
    except ModelError as error:
        return _nothing_compared(whole, declared, f'no line is compared: {error}')
    if len(whole.compared) < _FEWEST:
        return _nothing_compared(whole, declared, _unresolved(whole))
    used = [(replace(item, acquisitions=tuple(item.acquisitions[a] for a in item.compared)), source
             ) for item, source in zip(observations, recordings) if item.compared]
    observations, recordings = [item for item, _ in used], [source for _, source in used]
    observation = together(observations)
    if not choose_lines(observation).count:
        orders = ', '.join(f'{g:g}' for g in observation.orders)
        return _nothing_compared(observation, declared, (
            f'no line is compared: no declared order ({orders}) is coherent from cycle to cycle '
            'on any channel, so that no effect could have been seen; declare orders that the '
            'vibration holds'))
    return trace_bench(make_bench(observation, observations, recordings, declared),
                       progress=progress)


def _unresolved(observation: Observation) -> str:
    """Return that and why the vibration does not show the pulse errors."""
    known = observation.stacked('standard_errors')
    known = known[np.isfinite(known)]
    if known.size:
        size = float(np.sqrt(np.mean(known**2)))
        reason = (f'the vibration shows an error of a single pulse to {size:.2g} s only; smaller '
                  'errors could not have been seen')
    else:
        reason = next(item.reason for item in observation.acquisitions if item.reason)
    return (f'no line is compared: {reason}; declare stronger orders, use a quieter channel or '
            'give reference_pulse_times')


def _nothing_compared(observation: Observation, declared: Sequence[Effect], reason: str) -> Trace:
    """Return the trace of a recording whose lines cannot be compared."""
    count = len(observation.acquisitions)
    none, nothing = np.zeros(0, np.intp), Expectation((), np.zeros((count, 0)))
    return Trace(
        observation, tuple(declared), Lines(none, none), np.zeros(0), tuple(range(0, count, 2)),
        tuple(range(1, count, 2)), (), (), UNDEFINED, UNDEFINED, (), (), np.zeros((count, 0)),
        np.zeros((count, 0)), nothing, nothing, None, 'none', float('nan'), reason)


def require_acquisitions(observation: Observation) -> None:
    """Raise ModelError for fewer than 4 acquisitions."""
    count = len(observation.acquisitions)
    if count < _FEWEST:
        raise ModelError(f'{count} acquisitions of {observation.model.trigger_cycles} trigger '
                         f'cycles: fitting and scoring take at least {_FEWEST}; lower '
                         'trigger_cycles or record longer')


def trace_bench(bench: Bench, *, progress: Progress | None = None) -> Trace:
    """Trace the residual of the observations of a bench."""
    observation, declared = bench.observation, bench.declared
    count = len(observation.acquisitions)
    say = progress or (lambda text: None)
    own = bench.unsteadiness(())
    after = bench.score((), unsteadiness=own)
    at_first = moves = dependences(bench, (), ())
    chosen: list[Finding] = []
    candidates: list[Candidate] = []
    first_evidence: Evidence | None = None
    reason = ''
    while len(chosen) < _MOST_EFFECTS:
        significant = remains(after, moves)
        effects = [finding.effect for finding in chosen if finding.effect is not None]
        try:
            evidence = replace(bench.gather(effects, bench.fit),
                               whole=bench.gather(effects, range(count)))
        except SignalError as error:
            reason = str(error)
            break
        first_evidence = first_evidence or evidence
        say(f'round {len(chosen) + 1}: p = {after.p_value:.2g}, RMS residual {after.rms:.4f}')
        round_ = try_all(bench, evidence, chosen, after, moves, own, significant)
        winner = best_of(round_)
        if winner is None and not significant:
            candidates += round_
            break
        candidates += [item if winner is None or item is winner or item.rejected_because
                       else replace(item, rejected_because=f'{winner.name} has the more specific '
                                    'evidence') for item in round_]
        if winner is None:
            break
        chosen.append(winner.finding)
        say(f'added {winner.name}: {winner.finding.evidence}')
        effects = [finding.effect for finding in chosen if finding.effect is not None]
        own = bench.unsteadiness(effects)
        after = bench.score(effects, chosen, unsteadiness=own)
        moves = dependences(bench, effects, chosen)
    unexplained = remains(after, moves)
    if reason and unexplained:
        candidates += [Candidate(name, 1, Finding(name, None, {}, 1.0, reason, reason), None,
                                 reason) for name in EFFECTS]
    effects = [finding.effect for finding in chosen if finding.effect is not None]
    everything = range(count)
    attenuation, _, amplitude = bench.observed(everything)
    verdict = ('unexplained' if unexplained else 'traced' if chosen else 'none')
    before = bench.score((), unsteadiness=own) if chosen else after
    return Trace(
        observation, declared, bench.lines, bench.level, bench.fit, bench.held_out,
        tuple(chosen), tuple(candidates), before, after, at_first, moves,
        attenuation, amplitude,
        bench.expect((), everything, unsteadiness=own),
        bench.expect(effects, everything, unsteadiness=own), first_evidence, verdict, own)


def remains(left: Residual, moves: Sequence[Dependence]) -> bool:
    """Return whether a residual or one of its dependences is significant."""
    return left.p_value < SIGNIFICANT or moving(moves) is not None


def make_bench(observation: Observation, observations: Sequence[Observation],
               recordings: Sequence[Recording], declared: Sequence[Effect]) -> Bench:
    """Return what scoring needs of `observation`, the joined `observations` of `recordings`."""
    lines = choose_lines(observation)
    count = len(observation.acquisitions)
    fit, held_out = tuple(range(0, count, 2)), tuple(range(1, count, 2))
    group = channel_groups(observation)
    known = [gather_pulses(recording, item, group)
             for recording, item in zip(recordings, observations)]
    clock = _one_clock([found for found, _ in known])
    orders = observation.orders.size
    corrected = np.abs(observation.stacked('corrected')[..., :orders])
    level = lines.of(corrected[list(fit)].mean(axis=0))
    return with_fewer_cycles(Bench(
        observation, lines, level, [row for _, rows in known for row in rows], clock, group,
        line_evidence(observation, lines), fit, held_out, tuple(declared)))


def _one_clock(clocks: Sequence[Clock]) -> Clock:
    """Return the clock of all recordings; raise ModelError where they have different ones."""
    first = clocks[0]
    for number, other in enumerate(clocks[1:], start=2):
        if abs(other.rate - first.rate) > _SAME_CLOCK * first.rate:
            raise ModelError(f'pulse times of recording 1 lie on {_grid(first)}, those of '
                             f'recording {number} on {_grid(other)}: one declared model holds for '
                             'one clock; run the loop on each alone')
    return first


def _grid(clock: Clock) -> str:
    return f'a grid of {clock.rate:.6g} Hz' if clock.rate else 'no coarse grid'
