# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""What no effect explains, and which effects only absorb a part of it."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from sa_jitter_ros.effects.amplitude_modulation import AmplitudeModulation
from sa_jitter_ros.effects.effect import Effect, effects_of, Finding
from sa_jitter_ros.effects.speed_fluctuation import SpeedFluctuation
from sa_jitter_ros.effects.timing import Pattern, PULSES
from sa_jitter_ros.inference.candidates import Candidate
from sa_jitter_ros.inference.clock_steps import steps_text
from sa_jitter_ros.inference.gate import HeldOut
from sa_jitter_ros.inference.line_checks import check_channels, check_gain, check_lines
from sa_jitter_ros.inference.observation import Observation
from sa_jitter_ros.inference.residual import ACCURACY, FALSE_ALARM, Residual
from sa_jitter_ros.inference.scoring import Bench
from sa_jitter_ros.inference.timing import Timing
from sa_jitter_ros.inference.timing_checks import Check
from sa_jitter_ros.inference.trace_result import HARMS
from sa_jitter_ros.inference.unsteady import unsteady_text, UnsteadyLine
from sa_jitter_ros.prediction.amplitudes import line_variance

_SCATTER = 'the scatter of the amplitudes'
_WORSE = 'the attenuation of held-out acquisitions is predicted worse with it'
_MOST_LEFT = 'most of the residual of held-out acquisitions remains with it'


@dataclass(frozen=True)
class Scores:
    """What a bench says of the held-out acquisitions without and with the chosen effects."""

    bench: Bench
    unsteadiness: float
    before: Residual
    after: Residual


def scored(bench: Bench, chosen: Sequence[Finding]) -> Scores:
    """Score the chosen effects against the declared model."""
    effects = effects_of(chosen)
    bench = bench.with_moving_source(effects)
    own = bench.unsteadiness(effects)
    before = bench.score((), unsteadiness=own)
    return Scores(bench, own, before, bench.score(
        effects, chosen, unsteadiness=own) if chosen else before)


def predicting(bench: Bench, own: float) -> Callable[[Sequence[Finding]], HeldOut]:
    """Return how the held-out acquisitions, so unsteady, are predicted with some findings."""
    return lambda findings: bench.held_out_prediction(effects_of(findings), unsteadiness=own)


def without_absorbing(scores: Scores, left: Check | None, chosen: list[Finding],
                      candidates: list[Candidate]
                      ) -> tuple[list[Finding], list[Candidate]]:
    """Return the effects that do not merely absorb a part of what is left, and the candidates."""
    of_timing = left.text if left is not None else ''
    if left is None and scores.after.significant:
        of_timing = _little_is_gained(chosen, scores.before, scores.after)
    of_lines = _SCATTER if left is None and scores.after.p_amplitude < FALSE_ALARM else ''
    if not (of_timing or of_lines):
        return chosen, candidates
    kept = [finding for finding in chosen if finding.effect is not None and not (
        (of_lines and finding.effect.scatters) or (of_timing and _absorbs(finding.effect)))]
    names = {finding.name for finding in kept}
    return kept, [item if item.rejected_because or item.name in names else replace(
        item, rejected_because='it absorbs a part of what no effect explains: '
        + (of_timing or of_lines)) for item in candidates]


def _little_is_gained(chosen: Sequence[Finding], before: Residual, after: Residual) -> str:
    """Return why effects explain little of the held-out acquisitions, '' if they do much."""
    if after.score < before.score:
        return _WORSE
    on_the_mean = any(not effect.scatters for effect in effects_of(chosen))
    return _MOST_LEFT if on_the_mean and after.rms > 0.5 * before.rms else ''


def _absorbs(effect: Effect) -> bool:
    """Return whether an effect may absorb a part of what is none of it."""
    return effect.random or (
        isinstance(effect.timing, Pattern) and not effect.timing.show_in_times)


def unexplained_check(bench: Bench, timing: Timing | None, chosen: Sequence[Finding]
                      ) -> Check | None:
    """
    Return what no effect explains and changes an average, the surest of it.

    Within a cycle the recovery follows the speed to a cubic: the rest looks like a moving source.
    """
    model = bench.observation.model
    rad = 2.0 * np.pi * model.fundamental_frequency * max(model.orders)
    effects = bench.with_declared(effects_of(chosen))
    names = {effect.name for effect in effects}
    of_timing = timing.checks if timing is not None else ()
    speeds = model.revolutions_per_trigger / bench.observation.periods
    explained = np.mean([line_variance(replace(model, trigger_speed=speed), effects)
                         for speed in speeds.tolist()], axis=0)
    of_lines = (*check_lines(bench.observation, bench.lines, explained), *_of_gain(bench, names))
    chance = FALSE_ALARM / max(len(of_timing) + len(of_lines), 1)
    left = [check for check in (*of_timing, *of_lines) if check.p_value < chance and (
        check in of_lines or (0.5 * (rad * check.size) ** 2 > ACCURACY
                              and (check.direction == PULSES
                                   or SpeedFluctuation.name not in names)))]
    return min(left, key=lambda check: check.p_value, default=None)


def surest_text(left: Check | None, scores: Scores, unsteady: Sequence[UnsteadyLine]) -> str:
    """Return the surest of what is left; lines that vary say it better than their scatter."""
    if left is not None:
        return left.text
    said = scores.after.of_amplitude and any(item.large for item in unsteady)
    return '' if said else scores.after.text


def single_events(bench: Bench, found: Sequence[Finding]) -> Check | None:
    """Return what shows that a modulation that was found is a change of single events, or None."""
    checks = _of_gain(bench, {item.name for item in found})
    return min((item for item in checks if item.p_value < FALSE_ALARM / len(checks)),
               key=lambda item: item.p_value, default=None)


def _of_gain(bench: Bench, names: Collection[str]) -> Sequence[Check]:
    """Return the checks of a modulation, if it is one of the `names`."""
    return () if AmplitudeModulation.name not in names else (
        check_gain(bench.scatter), check_channels(bench.scatter))


def unexplained_text(observation: Observation, most: str, harmful: Sequence[Finding],
                     unsteady: Sequence[UnsteadyLine]) -> str:
    """Return in words what no effect explains, '' where nothing is left."""
    worse = [f'{", ".join(item.name for item in harmful)}: {HARMS}'] if harmful else []
    steps = [steps_text(observation.clock_steps)] if observation.clock_steps else []
    large = [item for item in unsteady if item.large]
    lines = [unsteady_text(large, observation.words)] if large else []
    return '; '.join(filter(None, (*steps, most, *worse, *lines)))


def without_harmful(candidates: Sequence[Candidate], harmful: Sequence[Finding]
                    ) -> list[Candidate]:
    """Return the candidates, of which those that predict worse are rejected."""
    names = {item.name for item in harmful}
    return [replace(item, rejected_because=HARMS) if item.name in names
            and not item.rejected_because else item for item in candidates]
