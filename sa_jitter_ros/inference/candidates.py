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
Candidates: what the lines and the pulse times alone show, and why it is named or not.

The noise around the lines, their common gain, a tone and the beat of an interpolator are seen in
different parts of the data, so that the evidence for a set of them is the sum of their gains: each
belongs to the best set whose gain exceeds the odds against it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from sa_jitter_ros.effects import Effect, EFFECTS
from sa_jitter_ros.effects.effect import (
    absent, departs, DirectEffect, effects_of, Finding, ONE_SIDED)
from sa_jitter_ros.inference.residual import ACCURACY, ACCURACY_OF_CHANGE
from sa_jitter_ros.inference.scoring import Bench
from scipy import special


@dataclass(frozen=True)
class Candidate:
    """One effect: finding, score on held-out acquisitions, reason of rejection."""

    name: str
    stage: int
    finding: Finding
    held_out_score: float | None
    rejected_because: str


def candidates_of_lines(bench: Bench, chosen: Sequence[Finding]) -> list[Candidate]:
    """
    Fit every effect on the lines, and score it beside the `chosen` ones on the timing.

    A declared one is a candidate where its numbers are others than the declared.
    """
    effects = effects_of(chosen)
    declared = {item.name: item for item in bench.declared}
    shared, found = bench.gather(effects, bench.fit), []
    for name, kind in EFFECTS.items():
        if not issubclass(kind, DirectEffect):
            continue
        evidence = bench.without(name).gather(effects, bench.fit) if name in declared else shared
        unidentifiable = bench.unidentifiable.get(name) or kind.unmodelled(bench.observation.model)
        finding = absent(name, unidentifiable) if unidentifiable else kind.fit(evidence)
        if name in declared and finding.effect is None and not unidentifiable:
            finding = _without(declared[name], kind.limit(evidence))
        effect = finding.effect
        if name in declared and (effect is None or not departs(
                effect, finding.standard_errors, declared[name], evidence.cycles)):
            continue
        found.append(Candidate(name, 1, finding, None, finding.contradiction)
                     if effect is None else _scored(bench, effects, finding))
    return found


def _without(declared: Effect, largest: Effect | None) -> Finding:
    """Return a declared effect with a size of 0, known as well as the `largest` possible one."""
    if largest is None:
        return absent(declared.name, 'nothing tells how large it is')
    (name, size), *_ = declared.values.items()
    error = max(largest.values[name] / ONE_SIDED, np.finfo(np.float64).tiny)
    likelihood = 0.5 * (size / error) ** 2
    return Finding(
        declared.name, type(declared)(**{**declared.values, name: 0.0}), {name: error},
        float(special.chdtrc(1, 2.0 * likelihood)),
        f'{name} is declared as {size:.3g}, and nothing of it shows: at most '
        f'{largest.values[name]:.3g} could be there', gain=-likelihood)


def _scored(bench: Bench, others: Sequence[Effect], finding: Finding) -> Candidate:
    """Score an effect on held-out acquisitions, and reject it if it hardly changes an average."""
    effect = finding.effect
    assert effect is not None
    finding = replace(finding, largest_change=bench.change(others, effect))
    every = [*others, effect]
    score = bench.score(every, unsteadiness=bench.unsteadiness(every))
    matters = effect.visible_in_pulse_times or finding.largest_change >= least_change(effect)
    return Candidate(finding.name, 1, finding,
                     score.amplitude_score if effect.scatters else score.score,
                     '' if matters else too_small(finding))


def least_change(effect: Effect) -> float:
    """Return the change of mean or scatter of an average from which on an effect is named."""
    return ACCURACY if effect.random else ACCURACY_OF_CHANGE


def too_small(finding: Finding) -> str:
    """Say that an effect changes no line by much."""
    return (f'it is too small to matter: no line changes by more than '
            f'{finding.largest_change:.2g}')
