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
Scoring: how well the declared model and some effects predict the held-out acquisitions.

The scale of the residual includes the unexplained scatter of the amplitudes (unsteadiness), beside
the scatter that noise, jitter and effects predict.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.effects import Effect
from sa_jitter_ros.effects.effect import Finding, possible
from sa_jitter_ros.effects.evidence import Evidence, LineEvidence
from sa_jitter_ros.effects.lattice import Clock, SAME_RATE
from sa_jitter_ros.errors import ModelError
from sa_jitter_ros.inference.expectation import expect, Expectation, Lines, Memory
from sa_jitter_ros.inference.gate import HeldOut
from sa_jitter_ros.inference.gathering import (
    channel_groups, choose_lines, gather, gather_pulses, hidden_lines, line_evidence)
from sa_jitter_ros.inference.observation import Observation
from sa_jitter_ros.inference.residual import (
    ACCURACY, FALSE_ALARM, Residual, residual, Sensitivity)
from sa_jitter_ros.inference.unsteady import SCATTER, unsteady_lines, UnsteadyLine
from sa_jitter_ros.prediction.amplitudes import component_gain
from sa_jitter_ros.prediction.influence import AveragePulses
from sa_jitter_ros.recordings.recording import Recording
from scipy import special

#: Acquisitions that fitting and scoring take: of so many, two fit and two are held out.
FEWEST_ACQUISITIONS = 4
_HELD_OUT = 6  # acquisitions: up to half of few ones, a third of many
_FREEDOM = 4.0  # with fewer degrees, a variance is hardly known


@dataclass(frozen=True)
class Bench:
    """
    What scoring needs; `unidentifiable` maps effects to why these data cannot show them.

    `hidden` is the bench of declared orders that the vibration holds and that are not worth
    comparing. `moving` are effects that take as much from the amplitude with a reference keyphasor
    as from the raw one.
    """

    observation: Observation
    lines: Lines
    level: Array
    pulses: Sequence[Sequence[AveragePulses]]
    clock: Clock
    group: Array
    scatter: LineEvidence
    fit: tuple[int, ...]
    held_out: tuple[int, ...]
    declared: tuple[Effect, ...]
    unidentifiable: Mapping[str, str] = field(default_factory=dict)
    memory: Memory = field(default_factory=Memory, repr=False)
    hidden: 'Bench | None' = None
    moving: tuple[Effect, ...] = ()

    def with_moving_source(self, effects: Sequence[Effect]) -> 'Bench':
        """Return the bench for a source that moves as effects say."""
        if not self.observation.against_reference:
            return self
        moving = tuple(item for item in self.with_declared(effects) if item.pulse_times_correct)
        return replace(self, moving=moving)

    @property
    def assumed(self) -> Sequence[Effect]:
        """Return declared effects that no data can show: a loss without a beat that tells it."""
        return [] if self.scatter.beat.method else [
            item for item in self.declared if item.timing is None
            and np.any(item.gain(self.observation.model) != 1.0)]

    @property
    def few(self) -> list[int]:
        """Return the slowest, median and fastest of the acquisitions that fit parameters."""
        items = self.observation.acquisitions
        slower = sorted(self.fit, key=lambda a: float(np.ptp(items[a].times)), reverse=True)
        return sorted({slower[0], slower[len(slower) // 2], slower[-1]})

    def gather(self, effects: Sequence[Effect], chosen: Sequence[int]) -> Evidence:
        """Return the evidence of some acquisitions, less what effects explain."""
        return gather(self.observation, chosen, self.pulses, self.clock,
                      self.with_declared(effects), self.scatter)

    def with_noise(self, std: float) -> 'Bench':
        """Return the bench of a model that declares this noise per sample."""
        if std == self.observation.model.noise_std:
            return self
        model = replace(self.observation.model, noise_std=std)
        return replace(self, observation=replace(self.observation, model=model), memory=Memory(),
                       hidden=self.hidden and self.hidden.with_noise(std))

    def declaring_only(self, effects: Iterable[Effect]) -> 'Bench':
        """Return the bench of a model that declares these effects."""
        declared = tuple(effects)
        return replace(self, declared=declared,
                       hidden=self.hidden and self.hidden.declaring_only(declared))

    def without(self, name: str) -> 'Bench':
        """Return the bench of a model that does not declare an effect."""
        return self.declaring_only(item for item in self.declared if item.name != name)

    def declaring(self, effects: Sequence[Effect]) -> 'Bench':
        """Return the bench of a model that declares some more effects."""
        return self.declaring_only((*self.declared, *effects))

    def with_declared(self, effects: Sequence[Effect]) -> list[Effect]:
        """Return the declared effects and others, which take the place of those of their name."""
        names = {item.name for item in effects}
        return [*(item for item in self.declared if item.name not in names), *effects]

    def change(self, others: Sequence[Effect], effect: Effect,
               chosen: Sequence[int] | None = None) -> float:
        """
        Return the largest change of a line that an effect makes beside others.

        It is that of the mean attenuation, or of the standard deviation of one average, of the
        acquisitions that fit parameters, or of the `chosen` ones. A line counts also if it is not
        compared: what disturbs it is why.
        """
        acquisitions = tuple(self.fit if chosen is None else chosen)
        changes = [np.abs(with_it - without).mean(axis=0) for without, with_it in zip(*(
            self._predicted(known, acquisitions) for known in (others, [*others, effect])))]
        of_hidden = self.hidden.change(others, effect, chosen) if self.hidden else 0.0
        return max(float(np.max(changes)), of_hidden)

    def _predicted(self, effects: Sequence[Effect], chosen: tuple[int, ...]) -> tuple[Array, ...]:
        """Return attenuations (acquisition, line), and two standard deviations (1, line)."""
        key, known = (tuple(self.with_declared(effects)), chosen), self.memory.predicted
        if key not in known:
            found = self.expect(effects, chosen)
            known[key] = found.attenuation, *(
                np.sqrt(item.mean(axis=0, keepdims=True)) for item in (
                    found.attenuation_variance, found.amplitude_variance))
        return known[key]

    def expect(self, effects: Sequence[Effect], chosen: Sequence[int], *,
               unsteadiness: float | Array = 0.0) -> Expectation:
        """Predict some acquisitions."""
        return expect(self.observation, self.lines, self.level, self.with_declared(effects),
                      self.pulses, self.group, chosen, unsteadiness=unsteadiness,
                      memory=self.memory)

    def observed(self, chosen: Sequence[int]) -> tuple[Array, Array, Array]:
        """Return attenuation, its variance and amplitude over level (acquisition, line)."""
        items = [self.observation.acquisitions[a] for a in chosen]

        def of(name: str) -> Array:
            return self.lines.of(np.array([getattr(item, name) for item in items]))

        # raw and corrected amplitude have both lost the rest
        kept = self.scatter.beat.kept * component_gain(
            self.observation.model, self.assumed)[self.lines.order]
        if self.moving:
            kept = kept * self._without_jitter(self.moving, chosen).attenuation
        return (kept * of('attenuation'), of('attenuation_standard_error') ** 2,
                kept * np.abs(of('raw')) / self.level)

    @cached_property
    def _levels(self) -> Array:
        """Return the corrected amplitudes (acquisition, line)."""
        return self.lines.of(np.abs(self.observation.stacked('corrected')))

    def unsteady_lines(self, effects: Sequence[Effect]) -> tuple[UnsteadyLine, ...]:
        """Return the lines that vary more than noise, pulse errors and effects let them."""
        known = self._corrected_variance(effects)
        if not all(item.recovered for item in self.observation.acquisitions) and not (
                self.observation.against_reference):  # then the pulse errors are in them
            every = range(len(self.observation.acquisitions))
            known = self.expect(effects, every).amplitude_variance.mean(axis=0)
        return unsteady_lines(self._levels, known, self.observation.orders,
                              self.observation.channel_names, self.lines)

    def unsteadiness(self, effects: Sequence[Effect]) -> float:
        """
        Return the scatter of the corrected amplitudes beyond what noise and effects predict.

        It is the root mean square over acquisitions and lines, relative to the level; 0 if it is
        not significant. No line counts with more than a steady machine has; lines count by how
        well they tell it, since white noise may be too much for weak lines of coloured noise.
        """
        power = np.mean((self._levels / self.level - 1.0) ** 2, axis=0)
        known = self._corrected_variance(effects)
        count = len(self._levels)
        if special.chdtrc(count, count * np.mean(power / known)) > FALSE_ALARM:
            return 0.0
        beyond = np.average(np.minimum(power - known, SCATTER**2),
                            weights=(known + SCATTER**2) ** -2.0)
        return float(np.sqrt(max(beyond, 0.0)))

    def _corrected_variance(self, effects: Sequence[Effect]) -> Array:
        """Return the variance (line,) that noise and effects give a corrected amplitude."""
        scattering = [effect for effect in self.with_declared(effects) if effect.scatters]
        return np.asarray(self._without_jitter(scattering, [0]).amplitude_variance[0])

    def _without_jitter(self, effects: Sequence[Effect], chosen: Sequence[int]) -> Expectation:
        """Predict some acquisitions with these effects alone."""
        model = replace(self.observation.model, jitter_distribution='table', jitter_table=(0.0,))
        return expect(replace(self.observation, model=model), self.lines, self.level, effects,
                      self.pulses, self.group, chosen)

    def score(self, effects: Sequence[Effect], findings: Sequence[Finding] = (), *,
              unsteadiness: float) -> Residual:
        """
        Return the residual of the held-out acquisitions.

        The others measured levels and parameters, whose errors the held-out ones share: amplitudes
        whose variance is estimated scatter as Student's variable does: of nu degrees of freedom,
        nu / (nu - 2) times the variance. `doubt` is 2 / nu, the squared relative error of the
        variance, so that doubt / (1 - doubt) of it is added; at most as much as it is, of nu = 4.
        """
        attenuation, variance, amplitude = self.observed(self.held_out)
        level = self._level_variance(effects, unsteadiness)
        unsure = np.sqrt(level + unsteadiness**2)
        expected = self.expect(effects, self.held_out, unsteadiness=unsure)
        moved, doubt = [], 0.0
        for others, scatters in self._moved(effects, findings):
            other = self.expect(others, self.held_out, unsteadiness=unsure)
            wider = other.amplitude_variance / expected.amplitude_variance - 1.0
            doubt += float(np.mean(wider)) ** 2
            if not scatters:
                moved.append(Sensitivity(
                    (other.attenuation - expected.attenuation).mean(axis=0),
                    float(np.mean((other.attenuation_variance - expected.attenuation_variance)
                                  / (expected.attenuation_variance + variance))),
                    float(np.mean(wider))))
        if findings:
            doubt = min(doubt, 2.0 / _FREEDOM)
            level = level + sum(item.mean**2 for item in moved) + (
                doubt / (1.0 - doubt) * expected.amplitude_variance.mean(axis=0))
            expected = self.expect(effects, self.held_out,
                                   unsteadiness=np.sqrt(level + unsteadiness**2))
        return residual(
            attenuation, expected.attenuation, expected.attenuation_variance + variance, amplitude,
            expected.amplitude, expected.amplitude_variance, expected.cdf(amplitude),
            level_variance=level, sensitivities=moved)

    def held_out_prediction(self, effects: Sequence[Effect], *, unsteadiness: float) -> HeldOut:
        """Return what declared model and effects say of the held-out acquisitions, one by one."""
        attenuation, variance, amplitude = self.observed(self.held_out)
        unsure = np.sqrt(self._level_variance(effects, unsteadiness) + unsteadiness**2)
        expected = self.expect(effects, self.held_out, unsteadiness=unsure)
        found = HeldOut(
            np.stack([attenuation, amplitude]),
            np.stack([expected.attenuation, expected.amplitude]),
            np.stack([expected.attenuation_variance + variance + ACCURACY**2,
                      expected.amplitude_variance]), self.lines.count)
        # orders that are not compared are predicted, too
        return found if self.hidden is None else found.beside(
            self.hidden.held_out_prediction(effects, unsteadiness=unsteadiness))

    def _level_variance(self, effects: Sequence[Effect], unsteadiness: float) -> Array:
        """Return by how much (line,) the levels err that were measured where parameters fit."""
        return np.asarray((self._corrected_variance(effects) + unsteadiness**2) / len(self.fit))

    def _moved(self, effects: Sequence[Effect], findings: Sequence[Finding]
               ) -> Iterator[tuple[list[Effect], bool]]:
        """Yield the effects with each number one standard error larger; whether that scatters."""
        for i, finding in enumerate(findings):
            for shifted in _shifted(finding):
                if possible(shifted, self.observation.model):
                    yield [*effects[:i], shifted, *effects[i + 1:]], shifted.scatters


def _shifted(finding: Finding) -> list[Effect]:
    """Return the effect with each of its numbers one standard error larger."""
    found: list[Effect] = []
    if finding.effect is None:
        return found
    for name, error in finding.standard_errors.items():
        if error is None:
            continue
        value = finding.effect.values[name]
        for step in np.diag(np.where(np.isfinite(error), error, 0.0).reshape(-1)):
            shifted = tuple((np.ravel(value) + step).tolist())
            try:
                found.append(replace(  # type: ignore[type-var]
                    finding.effect, **{name: shifted if np.ndim(value) else shifted[0]}))
            except ValueError:
                continue
    return found


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
