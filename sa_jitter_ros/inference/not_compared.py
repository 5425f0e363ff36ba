# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The trace of a recording whose lines cannot be compared."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache, partial

import numpy as np
from sa_jitter_ros.effects import Effect, EFFECTS
from sa_jitter_ros.effects.amplitude_modulation import AmplitudeModulation
from sa_jitter_ros.effects.effect import DirectEffect, effects_of, Finding
from sa_jitter_ros.effects.lattice import NO_CLOCK
from sa_jitter_ros.inference.candidates import Candidate, candidates_of_lines
from sa_jitter_ros.inference.expectation import Expectation, Lines
from sa_jitter_ros.inference.gate import NO_GAIN, passed
from sa_jitter_ros.inference.gathering import choose_lines, pulse_evidence
from sa_jitter_ros.inference.limits import (
    limits, probabilities, published_change, undecided_effects)
from sa_jitter_ros.inference.observation import Observation
from sa_jitter_ros.inference.refinements import with_its_noise
from sa_jitter_ros.inference.remainder import (
    predicting, single_events, unexplained_text, without_harmful)
from sa_jitter_ros.inference.residual import UNDEFINED
from sa_jitter_ros.inference.scoring import Bench, parted
from sa_jitter_ros.inference.timing import read_timing, stretches
from sa_jitter_ros.inference.trace_result import Trace
from sa_jitter_ros.inference.unsteady import UnsteadyLine
from sa_jitter_ros.prediction.prediction import predict, Prediction

UNSEEN = 'nothing of it shows in this recording'


def nothing_compared(observation: Observation, declared: Sequence[Effect], reason: str,
                     bench: Bench | None = None) -> Trace:
    """
    Return the trace of a recording whose lines cannot be compared.

    What pulse times show by themselves is found, and with a `bench` what lines show whose pulse
    errors are too small to be seen: noise, modulation, tones. What of the timing the vibration
    excludes still has a limit; whatever that leaves is undecided.
    """
    count = len(observation.acquisitions)
    none, nothing = np.zeros(0, np.intp), Expectation((), (), np.zeros((count, 0)))
    fit, held_out = parted(count)
    parts = stretches(observation, range(count), NO_CLOCK) if observation.recoveries else []
    coherent = choose_lines(observation).count > 0  # else no line holds the angle to the pulses
    timing = read_timing([replace(item, held=item.held and coherent) for item in parts], declared,
                         names=frozenset())
    known = [item.name for item in declared]
    noise: tuple[float, float] | None = None
    gained, harmful, most = NO_GAIN, list[Finding](), ''
    tried, unsteady = list[Candidate](), tuple[UnsteadyLine, ...]()

    @cache
    def predicted(effects: tuple[Effect, ...]) -> Prediction:
        return predict(observation.model, effects)

    def change(others: Sequence[Effect], effect: Effect) -> float:
        return published_change(predicted((*others,)), predicted((*others, effect)))

    if bench is None:
        evidence, by_how_much = pulse_evidence(observation), change
        found = [replace(item, largest_change=change(declared, item.effect)) for item in (
            kind.fit(evidence) for kind in EFFECTS.values()
            if issubclass(kind, DirectEffect) and kind.visible_in_pulse_times
            and kind.name not in known and not kind.unmodelled(observation.model))
                 if item.effect is not None]
    else:
        bench, noise = with_its_noise(bench)
        evidence = bench.gather((), range(count))
        by_how_much = partial(bench.change, chosen=bench.few)
        tried = candidates_of_lines(bench, ())
        found = [item.finding for item in tried if not item.rejected_because]
        events = single_events(bench, found)
        if events is not None:
            most = events.text
            found = [item for item in found if item.name != AmplitudeModulation.name]
        found, harmful, gained = passed(
            found, predicting(bench, bench.unsteadiness(effects_of(found))))
        unsteady = bench.unsteady_lines(effects_of(found))
    present = [item.finding for item in tried
               if item.rejected_because and item.finding.effect is not None]
    rows = limits(timing, evidence, [*known, *(item.name for item in (*found, *present))])
    open_ = [row.name for row in rows if row.upper is None and row.lower is None]
    undecided = {*open_, *undecided_effects(by_how_much, declared, rows)}
    names = [item.name for item in found]
    tested = {*names, *(item.name for item in tried)}
    not_testable = {name: reason for name in EFFECTS if name not in tested}
    return Trace(
        observation=observation, declared=tuple(declared), lines=Lines(none, none),
        level=np.zeros(0), fit=fit, held_out=held_out, findings=tuple(found),
        present=tuple(present), candidates=tuple(without_harmful(tried, harmful)),
        before=UNDEFINED, after=UNDEFINED, attenuation=np.zeros((count, 0)),
        amplitude=np.zeros((count, 0)), prediction_before=nothing, prediction_after=nothing,
        evidence=None, unsteadiness=float('nan'), noise=noise, gain=gained, limits=rows,
        undecided=tuple(row.name for row in rows if row.name in undecided),
        probabilities=probabilities(tried, None, names, not_testable), not_compared=reason,
        remains=unexplained_text(observation, most, harmful, unsteady), unsteady=unsteady,
        not_testable=not_testable, clock=NO_CLOCK if bench is None else bench.clock)


def unresolved(observation: Observation) -> str:
    """Return that and why the vibration does not show the pulse errors."""
    known = observation.stacked('standard_errors')
    known = known[np.isfinite(known)]
    recoveries = observation.recoveries
    if known.size and (not recoveries or any(item.held for item in recoveries)):
        size = float(np.sqrt(np.mean(known**2)))
        return _no_line(f'the vibration shows an error of a single pulse to {size:.2g} s only; '
                        'smaller errors could not have been seen')
    return _no_line(next(item.reason for item in observation.acquisitions if item.reason))


def _no_line(reason: str) -> str:
    return (f'no line is compared: {reason}; declare stronger orders, use a quieter channel or '
            'give reference_pulse_times')
