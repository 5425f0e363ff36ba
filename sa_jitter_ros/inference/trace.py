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
from dataclasses import dataclass, field, replace
from functools import partial
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.effects import Effect, EFFECTS, make_effect
from sa_jitter_ros.effects.additive_noise import less_noise, measured_noise
from sa_jitter_ros.effects.effect import absent, departs, DirectEffect, Finding, RARE
from sa_jitter_ros.effects.evidence import Evidence
from sa_jitter_ros.effects.keyphasor_quantisation import KeyphasorQuantisation
from sa_jitter_ros.effects.lattice import Clock, NO_CLOCK, SAME_RATE
from sa_jitter_ros.effects.target_geometry import TargetGeometry
from sa_jitter_ros.effects.timing import Pattern, PULSES
from sa_jitter_ros.errors import ModelError
from sa_jitter_ros.inference.candidates import (
    Candidate, candidates_of_lines, least_change, too_small)
from sa_jitter_ros.inference.clock_steps import steps_text
from sa_jitter_ros.inference.dependence import Dependence, dependences, moving
from sa_jitter_ros.inference.expectation import Expectation, Lines, Memory
from sa_jitter_ros.inference.fewer_cycles import with_fewer_cycles
from sa_jitter_ros.inference.gate import gain, Gain, HeldOut, NO_GAIN, passed
from sa_jitter_ros.inference.gathering import (
    channel_groups, choose_lines, gather_pulses, hidden_lines, line_evidence,
    pulse_evidence)
from sa_jitter_ros.inference.line_checks import check_channels, check_gain, check_lines
from sa_jitter_ros.inference.limits import Limit, limits
from sa_jitter_ros.inference.observation import CHANCE, Observation, together
from sa_jitter_ros.inference.residual import ACCURACY, FALSE_ALARM, Residual, UNDEFINED
from sa_jitter_ros.inference.scoring import Bench
from sa_jitter_ros.inference.timing import read_timing, refitted, stretches, Timing
from sa_jitter_ros.inference.timing_checks import Check
from sa_jitter_ros.inference.unsteady import unsteady_text, UnsteadyLine
from sa_jitter_ros.prediction.amplitudes import line_variance
from sa_jitter_ros.prediction.prediction import predict
from sa_jitter_ros.recordings.recording import Recording

Array = NDArray[Any]
Progress = Callable[[str], None]
#: The largest change that an effect beside others makes.
Change = Callable[[Sequence[Effect], Effect], float]

_SPEED = 'speed_fluctuation'
_GAIN = 'amplitude_modulation'
_UNDECIDED = 1e-2  # change of an average by what may be there
_SCATTER = 'the scatter of the amplitudes'
_WORSE = 'the attenuation of held-out acquisitions is predicted worse with it'
_REFINES = 'its clock is the declared one: it refines the declared model (declared_changes)'
_HARMS = 'held-out acquisitions are predicted worse with it than with the declared model'
_MOST_LEFT = 'most of the residual of held-out acquisitions remains with it'
_UNSEEN = 'nothing of it shows in this recording'
_TAKEN = 'it is declared, and nothing tells whether it is there: it is taken as declared'
_AS_DECLARED = 'it is declared, and shows no other numbers than these'
_FEWEST = 4
_HELD_OUT = 6


@dataclass(frozen=True)
class Trace:
    """
    Result of the trace; `before` and `after` are residuals of held-out acquisitions.

    The parameters of `findings` and `present` fit all acquisitions; residuals and predictions are
    those of parameters that fit the others.

    `dependences_before` and `dependences_after` are their changes with order, speed and cycles.
    `prediction_before` and `prediction_after` are predictions for all acquisitions
    (acquisition, line) of the `lines`, `attenuation` and `amplitude` the observed values.
    `evidence` is that of the first round, less declared effects only. `unsteadiness` is the
    unexplained scatter of the amplitudes relative to their level, part of the scale of both
    residuals. What only refines the declared model is part of all residuals and predictions but
    `as_declared`: `noise`, the noise per sample and its standard error where it was not declared
    or is less, and the ticks of the declared clock (`refinements`). `not_compared` says why there
    are no `lines`, '' where there are some. `gain` is what the findings gain over the declared
    model on held-out acquisitions: with findings that predict these worse there is no trace.
    `clock` is that on whose ticks the pulses lie; `remains` says what is left over, '' where
    nothing is; `unsteady` are the lines that vary by themselves, `not_testable` the effects that
    could not be looked for, and why.
    """

    observation: Observation
    declared: tuple[Effect, ...]
    lines: Lines
    level: Array
    fit: tuple[int, ...]
    held_out: tuple[int, ...]
    findings: tuple[Finding, ...]
    present: tuple[Finding, ...]
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
    timing: Timing | None
    left: Check | None
    limits: tuple[Limit, ...]
    undecided: tuple[str, ...]
    probabilities: Mapping[str, float]
    not_compared: str = ''
    noise: tuple[float, float] | None = None
    refinements: tuple[Finding, ...] = ()
    as_declared: Residual = UNDEFINED
    gain: Gain = NO_GAIN
    remains: str = ''
    unsteady: tuple[UnsteadyLine, ...] = ()
    not_testable: Mapping[str, str] = field(default_factory=dict)
    clock: Clock = NO_CLOCK

    def __post_init__(self) -> None:
        """Refuse effects with which held-out acquisitions are predicted worse."""
        if self.findings and self.gain.worse:
            names = ', '.join(item.name for item in self.findings)
            raise ValueError(f'{names}: {_HARMS}')


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
        return _nothing_compared(whole, declared, f'no line is compared: {error}')
    if len(whole.compared) < _FEWEST:
        known = np.isfinite(whole.stacked('errors')).all(axis=1)
        shows = np.count_nonzero(known) >= _FEWEST and choose_lines(whole).count
        bench = make_bench(whole, observations, recordings, declared) if shows else None
        return _nothing_compared(whole, declared, _unresolved(whole), bench)
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
    if len(observations) == 1:
        declared = [_counted_anew(item, observation) for item in declared]
    bench = make_bench(observation, observations, recordings, declared)
    timing = timing_of(bench)
    if timing is not None and (unsure := timing.hidden_by):
        observations = [item.uncorrected() for item in observations]
        whole = together(observations)
        return _nothing_compared(whole, declared, _too_unsure(unsure),
                                 make_bench(whole, observations, recordings, declared))
    return trace_bench(bench, timing, progress=progress)


def _counted_anew(effect: Effect, observation: Observation) -> Effect:
    """Return the effect, a target counted from the mark with which the recording begins."""
    if not isinstance(effect, TargetGeometry) or not effect.pulse_angles:
        return effect
    number = observation.pulses.number
    index = np.array([number[item.first] + item.number for item in observation.acquisitions])
    return effect.counted_anew(observation.model, index, observation.stacked('errors'))


def _unresolved(observation: Observation) -> str:
    """Return that and why the vibration does not show the pulse errors."""
    known = observation.stacked('standard_errors')
    known = known[np.isfinite(known)]
    if known.size:
        return _too_unsure(float(np.sqrt(np.mean(known**2))))
    return _no_line(next(item.reason for item in observation.acquisitions if item.reason))


def _too_unsure(size: float) -> str:
    return _no_line(f'the vibration shows an error of a single pulse to {size:.2g} s only; '
                    'smaller errors could not have been seen')


def _no_line(reason: str) -> str:
    return (f'no line is compared: {reason}; declare stronger orders, use a quieter channel or '
            'give reference_pulse_times')


def _nothing_compared(observation: Observation, declared: Sequence[Effect], reason: str,
                      bench: Bench | None = None) -> Trace:
    """
    Return the trace of a recording whose lines cannot be compared.

    What pulse times show by themselves is found, and with a `bench` what lines show whose pulse
    errors are too small to be seen: noise, modulation, tones. What of the timing the vibration
    excludes still has a limit; whatever that leaves is undecided.
    """
    count = len(observation.acquisitions)
    none, nothing = np.zeros(0, np.intp), Expectation((), np.zeros((count, 0)))
    fit, held_out = parted(count)
    parts = stretches(observation, range(count), NO_CLOCK) if observation.recoveries else []
    coherent = choose_lines(observation).count > 0  # else no line holds the angle to the pulses
    timing = read_timing([replace(item, held=item.held and coherent) for item in parts], declared,
                         names=frozenset())
    known = [item.name for item in declared]
    noise: tuple[float, float] | None = None
    gained, harmful, unsteady = NO_GAIN, list[Finding](), tuple[UnsteadyLine, ...]()
    tried: list[Candidate] = []
    most = ''

    def change(others: Sequence[Effect], effect: Effect) -> float:
        return _published_change(observation, others, [*others, effect])

    if bench is None:
        evidence, by_how_much = pulse_evidence(observation), change
        found = [replace(item, largest_change=change(declared, item.effect)) for item in (
            kind.fit(evidence) for kind in EFFECTS.values()
            if issubclass(kind, DirectEffect) and kind.visible_in_pulse_times
            and kind.name not in known and not kind.unmodelled(observation.model))
                 if item.effect is not None]
    else:
        bench, noise = _of_noise(bench)
        evidence = bench.gather((), range(count))
        by_how_much = partial(bench.change, chosen=_few(bench))
        tried = candidates_of_lines(bench, ())
        found = [item.finding for item in tried if not item.rejected_because]
        events = _events(bench, found)
        if events is not None:
            found, most = [item for item in found if item.name != _GAIN], events.text
        found, harmful, gained = passed(
            found, _predicting(bench, bench.unsteadiness(_effects(found))))
        unsteady = bench.unsteady_lines(_effects(found))
    present = [item.finding for item in tried
               if item.rejected_because and item.finding.effect is not None]
    rows = limits(timing, evidence, [*known, *(item.name for item in (*found, *present))])
    open_ = [row.name for row in rows if row.upper is None and row.lower is None]
    undecided = tuple(row.name for row in rows if row.name in {
        *open_, *_undecided(by_how_much, declared, rows)})
    tested = {*(item.name for item in found), *(item.name for item in tried)}
    left_over = _left_over(observation, most, harmful, unsteady)
    return Trace(
        observation, tuple(declared), Lines(none, none), np.zeros(0), fit, held_out, tuple(found),
        tuple(present), tuple(_without_harmful(tried, harmful)), UNDEFINED, UNDEFINED, (), (),
        np.zeros((count, 0)), np.zeros((count, 0)), nothing, nothing, None,
        'unexplained' if left_over else 'traced' if found else 'none', float('nan'),
        None, None, rows, undecided,
        {**{row.name: absent(row.name, _UNSEEN).probability for row in rows},
         **_probabilities(None, tried), **{item.name: item.probability for item in found}},
        reason, noise, gain=gained, remains=left_over, unsteady=unsteady,
        not_testable={name: reason for name in EFFECTS if name not in tested},
        clock=NO_CLOCK if bench is None else bench.clock)


def _events(bench: Bench, found: Sequence[Finding]) -> Check | None:
    """Return what shows that a modulation that was found is a change of single events, or None."""
    if _GAIN not in {item.name for item in found}:
        return None
    checks = [check_gain(bench.scatter), check_channels(bench.scatter)]
    surest = min(checks, key=lambda item: item.p_value)
    return surest if surest.p_value < FALSE_ALARM / len(checks) else None


def _published_change(observation: Observation, without: Sequence[Effect],
                      with_them: Sequence[Effect]) -> float:
    """Return the largest change by effects of what is published: mean and scatter of an order."""
    before, after = (predict(observation.model, known) for known in (without, with_them))
    return float(max(np.abs(getattr(after, name) - getattr(before, name)).max()
                     for name in ('mean_attenuation', 'standard_deviation')))


def require_acquisitions(observation: Observation) -> None:
    """Raise ModelError for fewer than 4 acquisitions."""
    count = len(observation.acquisitions)
    if count < _FEWEST:
        cycles = observation.model.trigger_cycles
        remedy = 'lower trigger_cycles or record longer' if cycles > CHANCE + 1 else (
            'record longer')  # fewer cycles tell no coherence
        raise ModelError(f'{count} acquisitions of {cycles} trigger cycles: fitting and scoring '
                         f'take at least {_FEWEST}; {remedy}')


def timing_of(bench: Bench) -> Timing | None:
    """Return what the acquisitions of a bench that fit parameters show of the timing."""
    return read_timing(stretches(bench.observation, bench.fit, bench.clock), bench.declared)


def trace_bench(bench: Bench, timing: Timing | None, *, progress: Progress | None = None
                ) -> Trace:
    """Trace the residual of the observations of a bench that have this `timing`."""
    observation, declared = bench.observation, bench.declared
    everything = range(len(observation.acquisitions))
    say = progress or (lambda text: None)
    known = {item.name for item in declared}

    def tell(found: Sequence[Finding]) -> None:
        for finding in found:
            what = 'other numbers of ' if finding.name in known else ''
            say(f'found {what}{finding.name}: {finding.evidence}')

    as_declared = bench.score((), unsteadiness=bench.unsteadiness(()))
    say(f'declared model: RMS residual {as_declared.rms:.4f}')
    bench, noise = _of_noise(bench)
    if noise is not None:
        say(f'noise of {noise[0]:.3g} per sample, '
            + ('less than declared' if observation.model.noise_is_declared else 'not declared'))
    whole = _refitted(bench, timing)
    chosen, present = _of_timing(bench, timing, whole)
    bench, refinements, chosen, present = _refined(bench, chosen, present)
    tell(chosen)
    candidates = [Candidate(finding.name, 0, finding, None, '') for finding in chosen]
    candidates += [Candidate(finding.name, 0, finding, None, too_small(finding))
                   for finding in present]
    candidates += [Candidate(finding.name, 0, finding, None, _REFINES) for finding in refinements]
    tried = candidates_of_lines(bench, chosen)
    candidates += tried
    added = [item.finding for item in tried if not item.rejected_because]
    tell(added)
    chosen += added
    present += [item.finding for item in tried
                if item.rejected_because and item.finding.effect is not None]
    evidence = bench.gather((), everything)
    scores = _scored(bench, chosen)
    left = _unexplained(scores.bench, whole, chosen)
    significant = left is not None or remains(scores.after, scores.moves_after)
    certain, candidates = _certain(scores, left, chosen, candidates)
    scores = scores if len(certain) == len(chosen) else _scored(bench, certain)
    chosen, harmful, gained = passed(certain, _predicting(scores.bench, scores.unsteadiness))
    candidates = _without_harmful(candidates, harmful)
    scores, effects = _scored(bench, chosen) if harmful else scores, _effects(chosen)
    unsteady = scores.bench.unsteady_lines(effects)
    left_over = _left_over(observation, _most_left(left, scores, unsteady) if significant else '',
                           harmful, unsteady)
    attenuation, _, amplitude = scores.bench.observed(everything)
    rows = limits(timing, evidence, [item.name for item in (*chosen, *present, *refinements)])
    assumed = [item.name for item in bench.assumed]
    candidates += _not_tried(bench, timing, candidates, known)
    final = tuple(_on_all(bench, whole, [*chosen, *present, *refinements]))
    few, own = partial(bench.change, chosen=_few(bench)), scores.unsteadiness
    return Trace(
        observation, declared, bench.lines, bench.level, bench.fit, bench.held_out,
        final[:len(chosen)], final[len(chosen):len(chosen) + len(present)], tuple(candidates),
        scores.before, scores.after, scores.moves_before, scores.moves_after, attenuation,
        amplitude, scores.bench.expect((), everything, unsteadiness=own),
        scores.bench.expect(effects, everything, unsteadiness=own), evidence,
        'unexplained' if left_over else 'traced' if chosen else 'none', own, timing, left,
        rows, (*_undecided(few, effects, rows), *assumed), _probabilities(timing, candidates),
        '', noise, final[len(chosen) + len(present):], as_declared, gained, left_over, unsteady,
        {**bench.untold, **_without_timing(timing)}, bench.clock)


@dataclass(frozen=True)
class _Scores:
    """What a bench says of the held-out acquisitions without and with the chosen effects."""

    bench: Bench
    unsteadiness: float
    before: Residual
    after: Residual
    moves_before: tuple[Dependence, ...]
    moves_after: tuple[Dependence, ...]


def _scored(bench: Bench, chosen: Sequence[Finding]) -> _Scores:
    """Score the chosen effects against the declared model."""
    effects = _effects(chosen)
    bench = bench.with_moving_source(effects)
    own = bench.unsteadiness(effects)
    before, moves = bench.score((), unsteadiness=own), dependences(bench, (), ())
    if not chosen:
        return _Scores(bench, own, before, before, moves, moves)
    return _Scores(bench, own, before, bench.score(effects, chosen, unsteadiness=own), moves,
                   dependences(bench, effects, chosen))


def _predicting(bench: Bench, own: float) -> Callable[[Sequence[Finding]], HeldOut]:
    """Return how the held-out acquisitions, so unsteady, are predicted with some findings."""
    return lambda findings: bench.held_out_prediction(_effects(findings), unsteadiness=own)


def _certain(scores: _Scores, left: Check | None, chosen: list[Finding],
             candidates: list[Candidate]) -> tuple[list[Finding], list[Candidate]]:
    """Return the effects that do not merely absorb a part of what is left, and the candidates."""
    of_timing = left.text if left is not None else ''
    if left is None and remains(scores.after, scores.moves_after):
        of_timing = _little_is_gained(chosen, scores.before, scores.after)
    of_lines = _SCATTER if left is None and scores.after.p_amplitude < FALSE_ALARM else ''
    if not (of_timing or of_lines):
        return chosen, candidates
    return _beyond_doubt(chosen, candidates, of_timing, of_lines)


def _most_left(left: Check | None, scores: _Scores, unsteady: Sequence[UnsteadyLine]) -> str:
    """Return the surest of what is left; lines that vary say it better than their scatter."""
    if left is not None:
        return left.text
    moves = moving(scores.moves_after)
    if moves is not None:
        return str(moves)
    said = scores.after.of_amplitude and any(item.large for item in unsteady)
    return '' if said else scores.after.text


def _left_over(observation: Observation, most: str, harmful: Sequence[Finding],
               unsteady: Sequence[UnsteadyLine]) -> str:
    """Return in words what no effect explains, '' where nothing is left."""
    worse = [f'{", ".join(item.name for item in harmful)}: {_HARMS}'] if harmful else []
    steps = [steps_text(observation.clock_steps)] if observation.clock_steps else []
    large = [item for item in unsteady if item.large]
    lines = [unsteady_text(large)] if large else []
    return '; '.join(filter(None, (*steps, most, *worse, *lines)))


def _without_harmful(candidates: Sequence[Candidate], harmful: Sequence[Finding]
                     ) -> list[Candidate]:
    """Return the candidates, of which those that predict worse are rejected."""
    names = {item.name for item in harmful}
    return [replace(item, rejected_because=_HARMS) if item.name in names
            and not item.rejected_because else item for item in candidates]


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
            reason = bench.untold.get(name, _UNSEEN)
        found.append(Candidate(name, 0, absent(name, reason), None, reason))
    return found


def _without_timing(timing: Timing | None) -> Mapping[str, str]:
    """Return the effects on the timing where nothing shows it, and why."""
    if timing is not None:
        return {}
    return {name: 'the recording holds too few consecutive trigger cycles'
            for name, kind in EFFECTS.items() if kind.timing is not None}


def _of_noise(bench: Bench) -> tuple[Bench, tuple[float, float] | None]:
    """
    Return the bench with the noise of the recording where that refines what was declared.

    That is where no noise was declared, or where averages scatter less than with the declared one.
    """
    evidence = bench.gather((), bench.fit)
    if not bench.observation.model.noise_is_declared:
        found = measured_noise(evidence)
        return (bench, None) if found is None else (bench.with_noise(found[0]), found)
    found = less_noise(evidence)
    if found is None:
        return bench, None
    quiet = bench.with_noise(found[0])
    declared, true = (np.sqrt(item.expect((), bench.fit).amplitude_variance.mean(axis=0))
                      for item in (bench, quiet))
    return (quiet, found) if np.max(declared - true) >= ACCURACY else (bench, None)


def _refined(bench: Bench, chosen: list[Finding], present: list[Finding]
             ) -> tuple[Bench, list[Finding], list[Finding], list[Finding]]:
    """
    Return the bench with the ticks of the declared clock, these, and the other findings.

    A keyphasor that is sampled at the declared rate has them: they are no effect that the declared
    model lacks. Where acquisitions are predicted worse with them, beside the effects that were
    chosen, they are left out.
    """
    ticks = [item for item in (*chosen, *present)
             if isinstance(item.effect, KeyphasorQuantisation)
             and item.effect.replaces_jitter(bench.observation.model)
             and item.name not in {effect.name for effect in bench.declared}]
    if not ticks:
        return bench, [], chosen, present
    refined = bench.declaring(_effects(ticks))
    chosen, present = ([item for item in items if item not in ticks]
                       for items in (chosen, present))
    own = refined.unsteadiness(_effects(chosen))
    worse = gain(*(_predicting(item, own)(chosen) for item in (bench, refined)),
                 of_mean=True).worse
    return (bench, [], chosen, present) if worse else (refined, ticks, chosen, present)


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
        others = [item.effect for item in findings if item is not finding
                  and item.effect is not None and item.name != _SPEED]
        effect = finding.effect
        assert effect is not None
        change = bench.change(others, effect)
        if known:  # measured pulses tell the ticks, which a prediction on line has to know
            certain = {name: effect.values[name]
                       for name, error in finding.standard_errors.items() if error is None}
            change = max(change, _published_change(
                bench.observation, [*others, known], [*others, make_effect(
                    known.name, **{**known.values, **certain})]))
        finding = replace(finding, largest_change=change)
        if finding.largest_change >= least_change(effect):
            chosen.append(finding)
        elif known or again is None or again.p_value < RARE:
            present.append(finding)
    chosen.sort(key=lambda item: -item.largest_change)
    return chosen, [item for item in present if item.name != _SPEED]


def _refitted(bench: Bench, timing: Timing | None) -> Timing | None:
    """Return the timing with parameters that fit all acquisitions; the effects are as chosen."""
    everything = range(len(bench.observation.acquisitions))
    return timing and refitted(
        timing, stretches(bench.observation, everything, bench.clock), bench.declared)


def _on_all(bench: Bench, timing: Timing | None, findings: Sequence[Finding]) -> list[Finding]:
    """Return findings with parameters that fit all acquisitions; `timing` is that of all."""
    everything = range(len(bench.observation.acquisitions))
    of_timing = {} if timing is None else {item.name: item for item in timing.findings}
    found: list[Finding] = []
    for finding in findings:
        kind = EFFECTS[finding.name]
        again = kind.fit(bench.without(finding.name).gather(
            _effects(found), everything)) if issubclass(kind, DirectEffect) else of_timing.get(
                finding.name)
        found.append(finding if again is None or again.effect is None else replace(
            finding, effect=again.effect, standard_errors=again.standard_errors,
            evidence=again.evidence))
    return found


def _little_is_gained(chosen: Sequence[Finding], before: Residual, after: Residual) -> str:
    """Return why effects explain little of the held-out acquisitions, '' if they do much."""
    if after.score < before.score:
        return _WORSE
    on_the_mean = any(not effect.scatters for effect in _effects(chosen))
    return _MOST_LEFT if on_the_mean and after.rms > 0.5 * before.rms else ''


def _beyond_doubt(chosen: Sequence[Finding], candidates: Sequence[Candidate], of_timing: str,
                  of_lines: str) -> tuple[list[Finding], list[Candidate]]:
    """Return the effects that do not merely absorb a part of what is left, and the candidates."""
    kept = [finding for finding in chosen if finding.effect is not None and not (
        (of_lines and finding.effect.scatters) or (of_timing and _absorbs(finding)))]
    names = {finding.name for finding in kept}
    return kept, [item if item.rejected_because or item.name in names else replace(
        item, rejected_because='it absorbs a part of what no effect explains: '
        + (of_timing or of_lines)) for item in candidates]


def _absorbs(finding: Finding) -> bool:
    """Return whether an effect may absorb a part of what is none of it."""
    effect = finding.effect
    return effect is not None and (effect.random or (
        isinstance(effect.timing, Pattern) and not effect.timing.show_in_times))


def _few(bench: Bench) -> list[int]:
    """Return the slowest, the median and the fastest of the acquisitions that fit parameters."""
    items = bench.observation.acquisitions
    slower = sorted(bench.fit, key=lambda a: float(np.ptp(items[a].times)), reverse=True)
    return sorted({slower[0], slower[len(slower) // 2], slower[-1]})


def _undecided(change: Change, effects: Sequence[Effect], rows: Sequence[Limit]
               ) -> tuple[str, ...]:
    """
    Return the effects that, as large as their limits, would still change an average.

    Random motions without a limit may be of any size.
    """
    found = []
    for row in rows:
        if row.effect is None:
            kind = EFFECTS[row.name]
            if row.lower is None and not issubclass(kind, DirectEffect) and not isinstance(
                    kind.timing, Pattern):
                found.append(row.name)
            continue
        try:
            size = change(effects, row.effect)
        except ModelError:  # so large that no average is left
            size = math.inf
        if size >= _UNDECIDED:
            found.append(row.name)
    return tuple(found)


def _probabilities(timing: Timing | None, candidates: Sequence[Candidate]) -> Mapping[str, float]:
    """Return the probability of every effect that was tried."""
    found = dict(timing.probabilities) if timing is not None else {}
    return {item.name: item.finding.probability for item in candidates} | found


def _effects(findings: Sequence[Finding]) -> list[Effect]:
    return [finding.effect for finding in findings if finding.effect is not None]


def _unexplained(bench: Bench, timing: Timing | None, chosen: Sequence[Finding]) -> Check | None:
    """
    Return what no effect explains and changes an average, the surest of it.

    Within a cycle the recovery follows the speed to a cubic: the rest looks like a moving source.
    """
    model = bench.observation.model
    rad = 2.0 * np.pi * model.fundamental_frequency * max(model.orders)
    effects = bench.with_declared(_effects(chosen))
    names = {effect.name for effect in effects}
    of_timing = timing.checks if timing is not None else ()
    speeds = model.trigger_revolutions / bench.observation.periods
    explained = np.mean([line_variance(replace(model, trigger_speed=speed), effects)
                         for speed in speeds.tolist()], axis=0)
    of_lines = check_lines(bench.observation, bench.lines, explained)
    if _GAIN in names:
        of_lines = (*of_lines, check_gain(bench.scatter), check_channels(bench.scatter))
    chance = FALSE_ALARM / max(len(of_timing) + len(of_lines), 1)
    left = [check for check in (*of_timing, *of_lines) if check.p_value < chance and (
        check in of_lines or (0.5 * (rad * check.size) ** 2 > ACCURACY
                              and not (check.direction != PULSES and _SPEED in names)))]
    return min(left, key=lambda check: check.p_value, default=None)


def remains(left: Residual, moves: Sequence[Dependence]) -> bool:
    """Return whether a residual or one of its dependences is significant."""
    return left.p_value < FALSE_ALARM or moving(moves) is not None


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
    bench = with_fewer_cycles(Bench(
        observation, lines, lines.of(corrected), [row for _, rows in known for row in rows], clock,
        group, line_evidence(observation, lines), fit, held_out, tuple(declared)))
    if hidden.count:
        bench = replace(bench, hidden=replace(
            bench, lines=hidden, level=hidden.of(corrected), memory=Memory(), fewer=None))
    return bench.with_moving_source(())


def parted(count: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return acquisitions that fit parameters, and those in the middle that are held out."""
    few = max(count // 3, min(count // 2, _HELD_OUT))
    start = (count - few) // 2
    held_out = tuple(range(start, start + few))
    return tuple(a for a in range(count) if a not in held_out), held_out


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
