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
The trace: which effects the declared model lacks, and what remains with them.

Effects on pulse times and source are chosen by the likelihood of the timing, those on the lines
by that of what the lines show. They are fitted to some of the acquisitions and scored on the
others. The result may be that no effect explains the residual.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from sa_jitter_ros.arrays import IntArray
from sa_jitter_ros.effects import Effect, EFFECTS, make_effect
from sa_jitter_ros.effects.clock_skew import ClockSkew
from sa_jitter_ros.effects.effect import absent, departs, DirectEffect, effects_of, Finding, RARE
from sa_jitter_ros.effects.speed_fluctuation import SpeedFluctuation
from sa_jitter_ros.effects.target_geometry import marks_ahead, TargetGeometry
from sa_jitter_ros.errors import ModelError
from sa_jitter_ros.inference.candidates import (
    Candidate, candidates_of_lines, least_change, too_small)
from sa_jitter_ros.inference.gate import passed, ScoreGain
from sa_jitter_ros.inference.gathering import choose_lines
from sa_jitter_ros.inference.limits import (
    limits, probabilities, published_change, undecided_effects)
from sa_jitter_ros.inference.not_compared import nothing_compared, unresolved, UNSEEN
from sa_jitter_ros.inference.observation import CHANCE, Observation, together
from sa_jitter_ros.inference.refinements import with_its_noise, with_its_ticks
from sa_jitter_ros.inference.remainder import (
    predicting, scored, Scores, surest_text, unexplained_check, unexplained_text,
    without_absorbing, without_harmful)
from sa_jitter_ros.inference.scoring import Bench, FEWEST_ACQUISITIONS, make_bench
from sa_jitter_ros.inference.timing import read_timing, refitted, stretches, Timing
from sa_jitter_ros.inference.timing_choice import RATIO
from sa_jitter_ros.inference.trace_result import Trace
from sa_jitter_ros.inference.unsteady import UnsteadyLine
from sa_jitter_ros.parameters import listed
from sa_jitter_ros.prediction.prediction import predict
from sa_jitter_ros.recordings.recording import Recording

Progress = Callable[[str], None]
_REFINES = 'its clock is the declared one: it refines the declared model (declared_changes)'
_TAKEN = 'declared; this recording cannot show it, so it is kept as declared'
_AS_DECLARED = 'declared, and the recording agrees with its declared numbers'


def trace(observations: Sequence[Observation], recordings: Sequence[Recording], *,
          declared: Sequence[Effect] = (), progress: Progress | None = None) -> Trace:
    """
    Trace the residual of the observations of some recordings of one machine.

    `declared` are the effects of the declared model.

    Where no line can be compared, only what needs no pulse errors is found, and the trace says
    why.
    """
    whole = together(observations)
    try:
        require_acquisitions(whole)
    except ModelError as error:
        return nothing_compared(whole, declared, f'no line is compared: {error}')
    if len(whole.compared) < FEWEST_ACQUISITIONS:
        known = np.isfinite(whole.stacked('errors')).all(axis=1)
        shows = np.count_nonzero(known) >= FEWEST_ACQUISITIONS and choose_lines(whole).count
        bench = make_bench(whole, observations, recordings, declared) if shows else None
        return nothing_compared(whole, declared, unresolved(whole), bench)
    used = [(replace(item, acquisitions=tuple(item.acquisitions[a] for a in item.compared)), source
             ) for item, source in zip(observations, recordings) if item.compared]
    observations, recordings = [item for item, _ in used], [source for _, source in used]
    observations = [observations[0], *(
        _counted_alike(item, observations[0]) for item in observations[1:])]
    observation = together(observations)
    if not choose_lines(observation).count:
        return nothing_compared(observation, declared, (
            f'no line is compared: no declared order ({listed(observation.orders, 6)}) is '
            'coherent from cycle to cycle on any channel, so that no effect could have been seen; '
            'declare orders that the vibration holds'))
    declared = [_counted_anew(item, observations) for item in declared]
    bench = make_bench(observation, observations, recordings, declared)
    timing = timing_of(bench)
    return trace_bench(bench, timing, progress=progress)


def _indices(observation: Observation) -> IntArray:
    """Return the index of each trigger pulse (acquisition, pulse)."""
    index = observation.pulses.index
    return np.array([index[item.first] + item.number for item in observation.acquisitions])


def _counted_alike(item: Observation, first: Observation) -> Observation:
    """Return an observation whose marks are counted as those of the first recording."""
    ahead = marks_ahead(item.model, *(
        (_indices(one), one.stacked('errors')) for one in (first, item)))
    return replace(
        item, pulses=replace(item.pulses, ahead=ahead),
        recoveries=tuple(replace(found, pulses=replace(found.pulses, ahead=ahead))
                         for found in item.recoveries))


def _counted_anew(effect: Effect, observations: Sequence[Observation]) -> Effect:
    """Return the effect, a target counted from the mark with which the recording begins."""
    if not isinstance(effect, TargetGeometry) or not effect.pulse_angles:
        return effect
    return effect.counted_anew(
        observations[0].model, np.concatenate([_indices(item) for item in observations]),
        np.concatenate([item.stacked('errors') for item in observations]))


def require_acquisitions(observation: Observation) -> None:
    """Raise ModelError for fewer than 4 acquisitions."""
    count = len(observation.acquisitions)
    if count < FEWEST_ACQUISITIONS:
        cycles = observation.model.trigger_cycles
        remedy = 'lower trigger_cycles or record longer' if cycles > CHANCE + 1 else (
            'record longer')  # fewer cycles tell no coherence
        raise ModelError(f'{count} acquisitions of {cycles} trigger cycles: fitting and scoring '
                         f'take at least {FEWEST_ACQUISITIONS}; {remedy}')


def timing_of(bench: Bench) -> Timing | None:
    """Return what the acquisitions of a bench that fit parameters show of the timing."""
    return read_timing(stretches(bench.observation, bench.fit, bench.clock), bench.declared)


@dataclass(frozen=True)
class _Found:
    """What the search found: effects that change an average, others, and what was tried."""

    bench: Bench
    chosen: list[Finding]
    present: Sequence[Finding]
    refinements: Sequence[Finding]
    candidates: list[Candidate]

    @property
    def every(self) -> list[Finding]:
        """Return all findings: the chosen ones, the present ones and refinements."""
        return [*self.chosen, *self.present, *self.refinements]


@dataclass(frozen=True)
class _Checked:
    """What held-out acquisitions leave of the search, their scores, and what remains."""

    found: _Found
    scores: Scores
    gain: ScoreGain
    remains: str
    unsteady: tuple[UnsteadyLine, ...]


def trace_bench(bench: Bench, timing: Timing | None, *, progress: Progress | None = None
                ) -> Trace:
    """Trace the residual of the observations of a bench that have this `timing`."""
    observation, everything = bench.observation, range(len(bench.observation.acquisitions))
    say = progress or (lambda text: None)
    as_declared = bench.score((), unsteadiness=bench.unsteadiness(()))
    say(f'declared model: RMS residual {as_declared.rms:.4f}')
    refined, noise = with_its_noise(_with_its_growth(bench, timing))
    if noise is not None:
        say(f'noise of {noise[0]:.3g} per sample, '
            + ('less than declared' if observation.model.noise_is_declared else 'not declared'))
    timing, whole = (timing, None) if timing is None else refitted(
        timing, stretches(observation, everything, refined.clock), refined.declared)
    checked = _check(_search(refined, timing, whole, say), whole)
    found, scores, own = checked.found, checked.scores, checked.scores.unsteadiness
    effects, few = effects_of(found.chosen), partial(found.bench.change, chosen=found.bench.few)
    evidence = found.bench.gather((), everything)
    rows = limits(timing, evidence, [item.name for item in found.every])
    not_testable = {**found.bench.unidentifiable, **_without_timing(timing)}
    candidates = (*found.candidates, *_not_tried(
        found.bench, timing, found.candidates, {item.name for item in bench.declared}))
    final, first = tuple(_on_all(found.bench, whole, found.every)), len(found.chosen)
    attenuation, _, amplitude = scores.bench.observed(everything)
    return Trace(
        observation=observation, declared=bench.declared, lines=found.bench.lines,
        level=found.bench.level, fit=found.bench.fit, held_out=found.bench.held_out,
        findings=final[:first], present=final[first:first + len(found.present)],
        refinements=final[first + len(found.present):], candidates=candidates,
        before=scores.before, after=scores.after, as_declared=as_declared,
        attenuation=attenuation, amplitude=amplitude,
        prediction_before=scores.bench.expect((), everything, unsteadiness=own),
        prediction_after=scores.bench.expect(effects, everything, unsteadiness=own),
        evidence=evidence, unsteadiness=own, noise=noise, gain=checked.gain, limits=rows,
        undecided=(*undecided_effects(few, effects, rows),
                   *(item.name for item in found.bench.assumed)),
        probabilities=probabilities(
            candidates, timing, [item.name for item in found.chosen], not_testable),
        remains=checked.remains, unsteady=checked.unsteady, not_testable=not_testable,
        clock=found.bench.clock)


def _search(bench: Bench, timing: Timing | None, whole: Timing | None, say: Progress) -> _Found:
    """Return what the timing, of a part and of the `whole` recording, and the lines show."""
    known = {item.name for item in bench.declared}

    def tell(found: Sequence[Finding]) -> None:
        for finding in found:
            what = 'other numbers of ' if finding.name in known else ''
            say(f'found {what}{finding.name}: {finding.evidence}')

    bench, refinements, chosen, present = with_its_ticks(bench, *_of_timing(bench, timing, whole))
    tell(chosen)
    tried = candidates_of_lines(bench, chosen)
    added = [item.finding for item in tried if not item.rejected_because]
    tell(added)
    small = [item.finding for item in tried
             if item.rejected_because and item.finding.effect is not None]
    return _Found(bench, [*chosen, *added], [*present, *small], refinements,
                  [*_of_findings(chosen, present, refinements), *tried])


def _check(found: _Found, whole: Timing | None) -> _Checked:
    """Drop what held-out acquisitions contradict, and return what remains without it."""
    scores = scored(found.bench, found.chosen)
    left = unexplained_check(scores.bench, whole, found.chosen)
    significant = left is not None or scores.after.significant
    certain, candidates = without_absorbing(scores, left, found.chosen, found.candidates)
    if len(certain) < len(found.chosen):
        scores = scored(found.bench, certain)
    chosen, harmful, gain = passed(certain, predicting(scores.bench, scores.unsteadiness))
    if harmful:
        scores = scored(found.bench, chosen)
    unsteady = scores.bench.unsteady_lines(effects_of(chosen))
    most = surest_text(left, scores, unsteady) if significant else ''
    return _Checked(
        replace(found, chosen=chosen, candidates=without_harmful(candidates, harmful)), scores,
        gain, unexplained_text(found.bench.observation, most, harmful, unsteady), unsteady)


def _with_its_growth(bench: Bench, timing: Timing | None) -> Bench:
    """Return the bench with a declared clock skew that grows with the angle where it does so."""
    if timing is None or ClockSkew.name in timing.choice.best:
        return bench
    share = timing.choice.fit.sizes[timing.choice.fit.columns.get(RATIO, slice(0))]
    return bench.declaring_only(
        replace(item, by_angle=float(share[0] / item.in_timing(timing.choice.setting)[0]))
        if isinstance(item, ClockSkew) and item.skew and share.size else item
        for item in bench.declared)


def _of_findings(chosen: Sequence[Finding], present: Sequence[Finding],
                 refinements: Sequence[Finding]) -> list[Candidate]:
    """Return findings on the timing as candidates: those that are chosen, and others."""
    return [*(_unscored(item, '') for item in chosen),
            *(_unscored(item, too_small(item)) for item in present),
            *(_unscored(item, _REFINES) for item in refinements)]


def _unscored(finding: Finding, reason: str) -> Candidate:
    """Return the candidate of a finding that the lines do not score, and why it is not named."""
    return Candidate(finding.name, stage=0, finding=finding, held_out_score=None,
                     rejected_because=reason)


def _not_tried(bench: Bench, timing: Timing | None, candidates: Sequence[Candidate],
               known: Collection[str]) -> list[Candidate]:
    """Return a candidate for every effect that is none yet, with the reason why."""
    named = {item.name for item in candidates}
    assumed = [item.name for item in bench.assumed]
    found = []
    for name in (name for name in EFFECTS if name not in named):
        if name in known:
            reason = _TAKEN if name in assumed else _AS_DECLARED
        elif timing is not None and name in timing.probabilities:
            reason = 'the likelihood of the timing gains too little by it'
        else:
            reason = bench.unidentifiable.get(name, UNSEEN)
        found.append(_unscored(absent(name, reason), reason))
    return found


def _without_timing(timing: Timing | None) -> Mapping[str, str]:
    """Return the effects on the timing where nothing shows it, and why."""
    if timing is not None:
        return {}
    return {name: 'the recording holds too few consecutive trigger cycles'
            for name, kind in EFFECTS.items() if kind.timing is not None}


def _of_timing(bench: Bench, timing: Timing | None, whole: Timing | None
               ) -> tuple[list[Finding], list[Finding]]:
    """
    Return the effects that change an average, the most important first, and others.

    One that is as declared on the `whole` recording is none, whatever a part of it shows, and one
    that is small in a part is none unless the whole shows it, too.
    """
    chosen: list[Finding] = []
    present: list[Finding] = []
    findings = timing.findings if timing is not None else ()
    of_all = {item.name: item for item in whole.findings} if whole is not None else {}
    declared = {item.name: item for item in bench.declared}
    for finding in findings:
        known, again = declared.get(finding.name), of_all.get(finding.name)
        if known and whole and again and again.effect and not departs(
                again.effect, again.standard_errors, known, whole.chooser.data.cycles):
            continue
        others = effects_of(item for item in findings
                            if item is not finding and item.name != SpeedFluctuation.name)
        effect = finding.effect
        assert effect is not None
        change = bench.change(others, effect)
        if known:  # measured pulses tell the ticks, which a prediction on line has to know
            certain = {name: effect.values[name]
                       for name, error in finding.standard_errors.items() if error is None}
            change = max(change, published_change(*(
                predict(bench.observation.model, [*others, one]) for one in (known, make_effect(
                    known.name, **{**known.values, **certain})))))
        finding = replace(finding, largest_change=change)
        if finding.largest_change >= least_change(effect):
            chosen.append(finding)
        elif known or again is None or again.p_value < RARE:
            present.append(finding)
    chosen.sort(key=lambda item: -item.largest_change)
    return chosen, [item for item in present if item.name != SpeedFluctuation.name]


def _on_all(bench: Bench, timing: Timing | None, findings: Sequence[Finding]) -> list[Finding]:
    """Return findings with parameters that fit all acquisitions; `timing` is that of all."""
    everything = range(len(bench.observation.acquisitions))
    of_timing = {} if timing is None else {item.name: item for item in timing.findings}
    found: list[Finding] = []
    for finding in findings:
        kind = EFFECTS[finding.name]
        again = kind.fit(bench.without(finding.name).gather(
            effects_of(found), everything)) if issubclass(kind, DirectEffect) else of_timing.get(
                finding.name)
        found.append(finding if again is None or again.effect is None else replace(
            finding, effect=again.effect, standard_errors=again.standard_errors,
            evidence=again.evidence))
    return found
