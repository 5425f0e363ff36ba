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
Candidates: every effect that is not in the model yet is fitted, scored and accepted or rejected.

An effect is accepted if its physical evidence is significant, its goodness of fit does not
contradict it, and the held-out acquisitions are predicted better with it. Of several, the one with
the most specific evidence is added first.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from sa_jitter_ros.effects import Effect, EFFECTS
from sa_jitter_ros.effects.effect import absent, Finding
from sa_jitter_ros.effects.evidence import Evidence
from sa_jitter_ros.effects.pulse_covariance import log_likelihood
from sa_jitter_ros.inference.dependence import Dependence, dependences, moving, still_moving
from sa_jitter_ros.inference.residual import ACCURACY, Residual
from sa_jitter_ros.inference.scoring import Bench

#: A residual with a smaller p value is no chance.
SIGNIFICANT = 0.02
_EVIDENCE = 1e-3
# Held-out pulse errors that are e^7 times likelier by chance are rarer than e^-7.
_TOLD, _MOVED = 7.0, 0.01
_DECISIVE = 1e-6
# Relative scatter of an amplitude below which no cause is looked for.
_FAINT = 1e-3
_NEARLY_ALL = 0.8
# Largest chi2 per degree of freedom of amplitudes whose scatter an effect explains.
_NO_MORE = 1.5
_HIDDEN = 'the ticks of the clock leave room for the errors of all pulses'
# Scores this close are the same: what the pulses show may be in none of the held-out acquisitions.
_SAME = 0.01
# Most specific evidence first: that in the pulse times themselves, then in the sequence of the
# pulse errors, then in their size, then in amplitudes.
_TIERS = (
    ('missing_pulses',), ('keyphasor_quantisation',), ('target_geometry', 'clock_skew'),
    ('speed_fluctuation', 'phase_wander'), ('correlated_jitter',), ('excess_jitter',),
    ('interpolation_loss',), ('amplitude_modulation', 'interfering_tone'), ('additive_noise',))


@dataclass(frozen=True)
class Candidate:
    """One effect in one round: finding, score on held-out acquisitions, reason of rejection."""

    name: str
    stage: int
    finding: Finding
    held_out_score: float | None
    rejected_because: str


def try_all(bench: Bench, evidence: Evidence, chosen: Sequence[Finding], current: Residual,
            moves: Sequence[Dependence], own: float, significant: bool) -> list[Candidate]:
    """
    Fit every effect that is not in the model yet and score it on the held-out acquisitions.

    `current` is the residual so far, `moves` its dependences, `own` the unsteadiness and
    `significant` whether a significant residual remains.
    """
    effects = [finding.effect for finding in chosen if finding.effect is not None]
    taken = {finding.name for finding in chosen} | {item.name for item in bench.declared}
    number = len(chosen) + 1
    hidden = any(effect.name == 'keyphasor_quantisation' for effect in effects
                 ) and evidence.of_all.hidden_by_ticks
    unneeded = (f'not needed: nothing significant remains (p = {current.p_value:.2g})')
    found = []
    for name, kind in EFFECTS.items():
        if name in taken:
            continue
        untold = bench.untold.get(name) or kind.unmodelled(bench.observation.model) or (
            _HIDDEN if hidden and kind.needs_pulse_errors else '')
        finding = absent(name, untold) if untold else kind.fit(evidence)
        if finding.effect is None:
            found.append(Candidate(name, number, finding, None,
                                   finding.contradiction if significant else unneeded))
            continue
        left = bench.unsteadiness([*effects, finding.effect]) if kind.scatters else own
        score = bench.score([*effects, finding.effect], [*chosen, finding], unsteadiness=left)
        gain = (_gain_of_amplitude(finding, current, score, own, left) if kind.scatters
                else _gain_of_attenuation(bench, effects, finding, current, moves, score))
        rejected = finding.contradiction or _rejection(bench, effects, finding, gain)
        visible = kind.visible_in_pulse_times
        plain = visible or (not kind.scatters and (gain.told or finding.p_value < _DECISIVE))
        if not rejected and not plain:  # pulses that show an effect plainly may show two
            rejected = _leaves(kind.scatters, current, score)
        in_times = visible or finding.effect.replaces_jitter(bench.observation.model)
        if not rejected and not in_times and not kind.scatters:
            rejected = str(still_moving(moves, dependences(
                bench, [*effects, finding.effect], [*chosen, finding])) or '')
        found.append(Candidate(name, number, finding, gain.score, rejected))
    return found


@dataclass(frozen=True)
class _Gain:
    """
    What an effect improves on held-out acquisitions: its log `score` and the one `before` it.

    `p_value` is that of the residual `of` attenuation or amplitude so far. `decisive` (by the
    residual) and `told` (by the likelihood) say that the effect is accepted whatever that p value
    is, `better` that the prediction with it is not worse.
    """

    of: str
    score: float
    before: float
    p_value: float
    decisive: bool
    told: bool
    better: bool


def _gain_of_amplitude(finding: Finding, current: Residual, score: Residual, own: float,
                       left: float) -> _Gain:
    """Return the gain of an effect on the scatter, which lowers unsteadiness `own` to `left`."""
    new, old = score.amplitude_score, current.amplitude_score
    decisive = own > ACCURACY and left**2 < 0.5 * own**2
    told = own > ACCURACY and finding.p_value < _DECISIVE and (new - old) * score.z.size > _TOLD
    # unsteadiness was fitted to the held-out amplitudes, too: a cause need not beat it
    better = new > old or (decisive and score.chi2_per_dof < _NO_MORE)
    return _Gain('amplitude', new, old, current.p_amplitude, decisive, told, better)


def _gain_of_attenuation(bench: Bench, effects: Sequence[Effect], finding: Finding,
                         current: Residual, moves: Sequence[Dependence], score: Residual) -> _Gain:
    """Return the gain of an effect on the attenuation."""
    new, old = score.score, current.score
    told = _told(bench, effects, finding, current, score)
    visible = EFFECTS[finding.name].visible_in_pulse_times
    better = new > old or told or (visible and new > old - _SAME)
    change = moving(moves)
    p_value = min(current.p_attenuation, change.p_value if change else 1.0)
    return _Gain('attenuation', new, old, p_value, _decisive(finding, current, score), told,
                 better)


def _rejection(bench: Bench, effects: Sequence[Effect], finding: Finding, gain: _Gain) -> str:
    """Return why an effect is not needed or does not help, '' if it does."""
    if finding.p_value > _EVIDENCE:
        return f'its evidence may be chance: {finding.evidence}'
    assert finding.effect is not None
    visible = finding.effect.visible_in_pulse_times
    least = _FAINT if finding.effect.scatters else ACCURACY
    if not visible and _moved(bench, effects, finding.effect) < least:
        return f'it is too small to matter: the {gain.of} of no line changes by {least:g}'
    if not (gain.p_value < SIGNIFICANT or visible or gain.decisive or gain.told):
        return (f'not needed: the residual of the {gain.of} is not significant '
                f'(p = {gain.p_value:.2g})')
    if not gain.better:
        return (f'the {gain.of} of held-out acquisitions is predicted no better: log score '
                f'{gain.score:.3f} after {gain.before:.3f}')
    return ''


def best_of(candidates: Sequence[Candidate]) -> Candidate | None:
    """Return the best candidate of the first tier with an accepted one, None without any."""
    for tier in _TIERS:
        left = [item for item in candidates if item.name in tier and not item.rejected_because]
        if left:
            return max(left, key=lambda item: item.held_out_score or 0.0)
    left = [item for item in candidates if not item.rejected_because]
    return max(left, key=lambda item: item.held_out_score or 0.0) if left else None


def _moved(bench: Bench, effects: Sequence[Effect], more: Effect) -> float:
    """Return the largest RMS change, over the acquisitions, that an effect makes to a line."""
    without, with_it = (bench.expect(known, bench.held_out) for known in (
        effects, [*effects, more]))
    square = (np.maximum(with_it.amplitude_variance - without.amplitude_variance, 0.0)
              if more.scatters else (with_it.attenuation - without.attenuation) ** 2)
    return float(np.sqrt(np.mean(square, axis=0).max()))


def _leaves(scatters: bool, before: Residual, after: Residual) -> str:
    """Return that nearly all of a significant residual remains with an effect, '' otherwise."""
    if scatters:
        old, new = before.chi2_per_dof - 1.0, after.chi2_per_dof - 1.0
        if after.p_amplitude < SIGNIFICANT and new > _NEARLY_ALL * old:
            return (f'it leaves nearly all of the scatter: chi2 per degree of freedom '
                    f'{new + 1.0:.3g} after {old + 1.0:.3g}')
    elif after.p_attenuation < SIGNIFICANT and after.rms > _NEARLY_ALL * before.rms:
        return (f'it leaves nearly all of the residual: RMS {after.rms:.4f} after '
                f'{before.rms:.4f}')
    return ''


def _decisive(finding: Finding, before: Residual, after: Residual) -> bool:
    """Return whether an effect halves the residual and its evidence is beyond doubt."""
    return (finding.p_value < _DECISIVE and before.rms > ACCURACY
            and after.rms < 0.5 * before.rms)


def _told(bench: Bench, effects: Sequence[Effect], finding: Finding, before: Residual,
          after: Residual) -> bool:
    """
    Return whether held-out pulse errors show an effect that the attenuation is too noisy to show.

    Beside a large effect, the scatter of few averages can hide a second one in the attenuation.
    With the effect no significant residual of the attenuation may remain.
    """
    moved = float(np.sqrt(np.mean((after.mean - before.mean) ** 2)))
    if finding.effect is None or moved < _MOVED or after.p_attenuation < SIGNIFICANT:
        return False
    without, with_it = (log_likelihood(bench.gather(known, bench.held_out))
                        for known in (effects, [*effects, finding.effect]))
    return with_it - without > _TOLD
