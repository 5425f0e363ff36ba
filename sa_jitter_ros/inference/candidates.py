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
Candidates: what may scatter the amplitudes, fitted, scored and accepted or rejected.

An effect on the lines is accepted if its own evidence is significant and it changes an average:
where the evidence is beyond doubt, or the held-out acquisitions are predicted better with it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from sa_jitter_ros.effects import Effect, EFFECTS
from sa_jitter_ros.effects.effect import absent, DirectEffect, Finding
from sa_jitter_ros.effects.evidence import Evidence
from sa_jitter_ros.inference.residual import ACCURACY, Residual
from sa_jitter_ros.inference.scoring import Bench

#: A residual with a smaller p value is no chance.
SIGNIFICANT = 0.02
_EVIDENCE = 1e-3
# A p value of evidence that needs no help from held-out averages, which are few.
_DECISIVE = 1e-6
_KNOWN_CHANGE = 1e-3  # of an average by what is no chance, from which on its cause is named


@dataclass(frozen=True)
class Candidate:
    """One effect in one round: finding, score on held-out acquisitions, reason of rejection."""

    name: str
    stage: int
    finding: Finding
    held_out_score: float | None
    rejected_because: str


def try_all(bench: Bench, evidence: Evidence, chosen: Sequence[Finding], current: Residual,
            own: float, stage: int) -> list[Candidate]:
    """
    Fit every effect on the lines that is not in the model yet; score it on held-out acquisitions.

    `current` is the residual so far, `own` the unsteadiness.
    """
    taken = {finding.name for finding in chosen} | {item.name for item in bench.declared}
    found = []
    for name, kind in EFFECTS.items():
        if name in taken or not issubclass(kind, DirectEffect):
            continue
        untold = bench.untold.get(name) or kind.unmodelled(bench.observation.model)
        finding = absent(name, untold) if untold else kind.fit(evidence)
        if finding.effect is None:
            found.append(Candidate(name, stage, finding, None, finding.contradiction))
        else:
            found.append(_tried(bench, chosen, finding, current, own, stage))
    return found


def _tried(bench: Bench, chosen: Sequence[Finding], finding: Finding, current: Residual,
           own: float, stage: int) -> Candidate:
    """Score an effect and accept or reject it."""
    effects = [item.effect for item in chosen if item.effect is not None]
    effect = finding.effect
    assert effect is not None
    finding = replace(finding, largest_change=bench.change(effects, effect))
    left = bench.unsteadiness([*effects, effect]) if effect.scatters else own
    score = bench.score([*effects, effect], [*chosen, finding], unsteadiness=left)
    new = score.amplitude_score if effect.scatters else score.score
    rejected = finding.contradiction
    if not rejected and not effect.visible_in_pulse_times:
        rejected = _rejection(finding, current, score)
    return Candidate(finding.name, stage, finding, new, rejected)


def _rejection(finding: Finding, current: Residual, score: Residual) -> str:
    """Return why an effect is not needed or does not help, '' if it does."""
    effect = finding.effect
    assert effect is not None
    if finding.p_value > _EVIDENCE:
        return f'its evidence may be chance: {finding.evidence}'
    if finding.largest_change < least_change(effect):
        return too_small(finding)
    if effect.scatters:
        of, new, old = 'amplitude', score.amplitude_score, current.amplitude_score
        p_value = current.p_amplitude
    else:
        of, new, old, p_value = 'attenuation', score.score, current.score, current.p_attenuation
    if finding.p_value < _DECISIVE:  # held-out averages are few
        return ''
    if not p_value < SIGNIFICANT:
        return f'not needed: the residual of the {of} is not significant (p = {p_value:.2g})'
    if not new > old:
        return (f'the {of} of held-out acquisitions is predicted no better: log score '
                f'{new:.3f} after {old:.3f}')
    return ''


def least_change(effect: Effect) -> float:
    """Return the change of mean or scatter of an average from which on an effect is named."""
    return ACCURACY if effect.random else _KNOWN_CHANGE


def too_small(finding: Finding) -> str:
    """Say that an effect changes no line by much."""
    return (f'it is too small to matter: no line changes by more than '
            f'{finding.largest_change:.2g}')


def best_of(candidates: Sequence[Candidate]) -> Candidate | None:
    """Return the accepted candidate whose evidence is the most certain, None without any."""
    left = [item for item in candidates if not item.rejected_because]
    return min(left, key=_rank) if left else None


def _rank(item: Candidate) -> tuple[bool, bool, float]:
    """Rank: pulses first, then the mean of the amplitude, then its scatter, by their score."""
    kind = EFFECTS[item.name]
    return (not kind.visible_in_pulse_times, kind.scatters, -(item.held_out_score or 0.0))
