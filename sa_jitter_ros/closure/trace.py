"""
The trace: which effect makes the residual, added one at a time while a significant one remains.

Effects are fitted on one half of the acquisitions (every other one) and judged on the other. An
effect is added when its own physical evidence speaks for it, nothing in its goodness of fit speaks
against it, and the held-out acquisitions are predicted better with it; the one with the most
specific evidence first. "None of these" is an answer.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.closure.expectation import expect, Expectation, Lines
from sa_jitter_ros.closure.gathering import (
    channel_groups, choose_lines, gather, gather_pulses, line_evidence)
from sa_jitter_ros.closure.observation import Observation, together
from sa_jitter_ros.closure.residual import ACCURACY, Residual, residual
from sa_jitter_ros.effects import Effect, EFFECTS
from sa_jitter_ros.effects.effect import Pulses
from sa_jitter_ros.effects.evidence import absent, Evidence, Finding, LineEvidence
from sa_jitter_ros.effects.lattice import Clock
from sa_jitter_ros.effects.pulse_covariance import log_likelihood
from sa_jitter_ros.errors import ModelError, SignalError
from sa_jitter_ros.recordings.recording import Recording

Array = NDArray[Any]
Progress = Callable[[str], None]

#: A residual with a smaller p value is no chance.
SIGNIFICANT = 0.02
_EVIDENCE = 1e-3
# Held-out pulse errors that are e^7 times likelier by chance are rarer than e^-7.
_TOLD, _MOVED = 7.0, 0.01
_DECISIVE, _MATERIAL = 1e-6, 2.0 * ACCURACY
#: Scatter from average to average that is the machine's own, in parts of an amplitude: what steady
#: machines were measured to have that no effect describes (docs/measured_cases.md).
STEADY = 0.02
_CHANCE = 3.0
_MOST_EFFECTS = 4
# Scores this close are the same: what is seen in the pulses may lie in none of the held-out ones.
_SAME = 0.01
_FEWEST = 4
# Most specific evidence first: what one sees in the pulse times themselves, then in the order of
# the pulse errors, then in their size, then in amplitudes.
_TIERS = (
    ('missing_pulses',), ('keyphasor_quantisation',), ('target_geometry', 'clock_skew'),
    ('speed_fluctuation', 'phase_wander'), ('correlated_jitter',), ('excess_jitter',),
    ('interpolation_loss',), ('amplitude_modulation', 'interfering_tone'), ('additive_noise',))


@dataclass(frozen=True)
class Candidate:
    """One effect in one round: its finding, its score on held-out acquisitions, its rejection."""

    name: str
    stage: int
    finding: Finding
    held_out_score: float | None
    rejected_because: str


@dataclass(frozen=True)
class Trace:
    """
    What the trace found; `before` and `after` are residuals of held-out acquisitions.

    `prediction_before` and `prediction_after` are those of all acquisitions (acquisition, line) of
    the `lines`; `attenuation` and `amplitude` what was observed. `evidence` is that of the first
    round, with nothing explained. `unsteadiness` is how much the amplitudes scatter by themselves,
    in parts of their level: part of the scale of both residuals.
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
    attenuation: Array
    amplitude: Array
    prediction_before: Expectation
    prediction_after: Expectation
    evidence: Evidence | None
    verdict: str
    unsteadiness: float


@dataclass(frozen=True)
class Bench:
    """Everything that scoring needs; `untold` says of effects why these data cannot tell them."""

    observation: Observation
    lines: Lines
    level: Array
    pulses: Sequence[Sequence[Pulses]]
    clock: Clock
    group: Array
    scatter: LineEvidence
    fit: tuple[int, ...]
    held_out: tuple[int, ...]
    declared: tuple[Effect, ...]
    untold: Mapping[str, str] = field(default_factory=dict)

    def gather(self, effects: Sequence[Effect], chosen: Sequence[int]) -> Evidence:
        """Return the evidence of some acquisitions, less what effects explain."""
        return gather(self.observation, self.lines, chosen, self.pulses, self.clock,
                      [*self.declared, *effects], self.scatter)

    def expect(self, effects: Sequence[Effect], chosen: Sequence[int], *,
               unsteadiness: float = 0.0) -> Expectation:
        """Predict some acquisitions."""
        return expect(self.observation, self.lines, self.level, [*self.declared, *effects],
                      self.pulses, self.group, chosen, unsteadiness=unsteadiness)

    def observed(self, chosen: Sequence[int]) -> tuple[Array, Array, Array]:
        """Return attenuation, its variance and amplitude over level (acquisition, line)."""
        items = [self.observation.acquisitions[a] for a in chosen]
        orders = self.observation.orders.size

        def of(name: str) -> Array:
            return self.lines.of(np.array([getattr(item, name)[:, :orders] for item in items]))

        kept = self.scatter.beat_gain  # raw and corrected amplitude have both lost the rest
        return (kept * of('attenuation'), of('attenuation_standard_error') ** 2,
                kept * np.abs(of('raw')) / self.level)

    def unsteadiness(self, effects: Sequence[Effect]) -> float:
        """
        Return what the corrected amplitudes scatter by beyond what noise and effects predict.

        It is the root mean square over acquisitions and lines, in parts of the level: 0 where it
        may be chance, and of no line more than a steady machine has.
        """
        orders = self.observation.orders.size
        amplitude = np.abs(self.observation.stacked('corrected')[..., :orders])
        power = np.mean((self.lines.of(amplitude) / self.level - 1.0) ** 2, axis=0)
        model = replace(self.observation.model, jitter_distribution='table', jitter_table=(0.0,))
        scattering = [effect for effect in (*self.declared, *effects) if effect.scatters]
        known = expect(replace(self.observation, model=model), self.lines, self.level, scattering,
                       self.pulses, self.group, [0]).amplitude_variance[0]
        chance = _CHANCE * np.sqrt(2.0 / len(amplitude))
        if np.mean(power / known) < 1.0 + chance:
            return 0.0
        return float(np.sqrt(max(np.mean(np.minimum(power - known, STEADY**2)), 0.0)))

    def score(self, effects: Sequence[Effect], findings: Sequence[Finding] = (), *,
              unsteadiness: float) -> Residual:
        """Return the residual of the held-out acquisitions."""
        attenuation, variance, amplitude = self.observed(self.held_out)
        expected = self.expect(effects, self.held_out, unsteadiness=unsteadiness)
        probability = expected.law.cdf(amplitude.reshape(-1, 1)).reshape(amplitude.shape)
        base = expected.attenuation.mean(axis=0)
        moved = []
        for i, finding in enumerate(findings):
            for shifted in _shifted(finding):
                others = [*effects[:i], shifted, *effects[i + 1:]]
                moved.append(self.expect(others, self.held_out).attenuation.mean(axis=0) - base)
        return residual(
            attenuation, expected.attenuation, expected.attenuation_variance + variance, amplitude,
            expected.amplitude, expected.amplitude_variance, probability, sensitivities=moved)


def trace(observations: Sequence[Observation], recordings: Sequence[Recording], *,
          declared: Sequence[Effect] = (), progress: Progress | None = None) -> Trace:
    """
    Trace the residual of the observations of some recordings of one machine.

    `declared` are effects that the declared model has already.

    Raises ModelError for fewer than 4 acquisitions and SignalError where nothing can be compared.
    """
    observation = together(observations)
    require_acquisitions(observation)
    return trace_bench(_bench(observation, observations, recordings, declared), progress=progress)


def require_acquisitions(observation: Observation) -> None:
    """Raise ModelError for fewer than 4 acquisitions."""
    count = len(observation.acquisitions)
    if count < _FEWEST:
        raise ModelError(f'{count} acquisitions of {observation.model.trigger_cycles} trigger '
                         f'cycles: fitting and scoring take at least {_FEWEST}; lower '
                         'trigger_cycles or record longer')


def trace_bench(bench: Bench, *, progress: Progress | None = None) -> Trace:
    """Trace the residual of what is on the bench."""
    observation, declared = bench.observation, bench.declared
    count = len(observation.acquisitions)
    say = progress or (lambda text: None)
    own = bench.unsteadiness(())
    after = bench.score((), unsteadiness=own)
    chosen: list[Finding] = []
    candidates: list[Candidate] = []
    first_evidence: Evidence | None = None
    reason = ''
    while len(chosen) < _MOST_EFFECTS:
        significant = after.p_value < SIGNIFICANT
        effects = [finding.effect for finding in chosen if finding.effect is not None]
        try:
            evidence = bench.gather(effects, bench.fit)
        except SignalError as error:
            reason = str(error)
            break
        first_evidence = first_evidence or evidence
        say(f'round {len(chosen) + 1}: p = {after.p_value:.2g}, RMS residual {after.rms:.4f}')
        round_ = _try_all(bench, evidence, chosen, after, own, significant)
        winner = _best(round_)
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
    if reason and after.p_value < SIGNIFICANT:
        candidates += [Candidate(name, 1, Finding(name, None, {}, 1.0, reason, reason), None,
                                 reason) for name in EFFECTS]
    effects = [finding.effect for finding in chosen if finding.effect is not None]
    everything = range(count)
    attenuation, _, amplitude = bench.observed(everything)
    verdict = ('unexplained' if after.p_value < SIGNIFICANT else 'traced' if chosen else 'none')
    before = bench.score((), unsteadiness=own) if chosen else after
    return Trace(
        observation, declared, bench.lines, bench.level, bench.fit, bench.held_out,
        tuple(chosen), tuple(candidates), before, after, attenuation, amplitude,
        bench.expect((), everything, unsteadiness=own),
        bench.expect(effects, everything, unsteadiness=own), first_evidence, verdict, own)


def _bench(observation: Observation, observations: Sequence[Observation],
           recordings: Sequence[Recording], declared: Sequence[Effect]) -> Bench:
    lines = choose_lines(observation)
    count = len(observation.acquisitions)
    fit, held_out = tuple(range(0, count, 2)), tuple(range(1, count, 2))
    group = channel_groups(observation)
    known = [gather_pulses(recording, item, group)
             for recording, item in zip(recordings, observations)]
    orders = observation.orders.size
    corrected = np.abs(observation.stacked('corrected')[..., :orders])
    level = lines.of(corrected[list(fit)].mean(axis=0))
    return Bench(observation, lines, level, [row for _, rows in known for row in rows],
                 known[0][0], group, line_evidence(observation, lines), fit, held_out,
                 tuple(declared))


def _try_all(bench: Bench, evidence: Evidence, chosen: Sequence[Finding], current: Residual,
             own: float, significant: bool) -> list[Candidate]:
    """Fit every effect that is not there yet and score it on the held-out acquisitions."""
    effects = [finding.effect for finding in chosen if finding.effect is not None]
    taken = {finding.name for finding in chosen} | {item.name for item in bench.declared}
    number = len(chosen) + 1
    unneeded = (f'not needed: nothing significant remains (p = {current.p_value:.2g})')
    found = []
    for name, kind in EFFECTS.items():
        if name in taken:
            continue
        untold = bench.untold.get(name) or kind.unmodelled(bench.observation.model)
        finding = absent(name, untold) if untold else kind.fit(evidence)
        if finding.effect is None:
            found.append(Candidate(name, number, finding, None,
                                   finding.against if significant else unneeded))
            continue
        left = bench.unsteadiness([*effects, finding.effect]) if kind.scatters else own
        score = bench.score([*effects, finding.effect], [*chosen, finding], unsteadiness=left)
        rejected = finding.against
        if not rejected and finding.p_value > _EVIDENCE:
            rejected = f'its evidence may be chance: {finding.evidence}'
        gained, new, old = ('amplitude', score.amplitude_score, current.amplitude_score) if (
            kind.scatters) else ('attenuation', score.score, current.score)
        p_value = 3.0 * current.p_amplitude if kind.scatters else current.p_attenuation
        decisive = own > ACCURACY and left**2 < 0.5 * own**2 if kind.scatters else (
            _decisive(finding, current, score))
        told = not kind.scatters and _told(bench, effects, finding, current, score)
        needed = p_value < SIGNIFICANT or kind.seen or decisive or told
        moves = kind.scatters or kind.seen or _moved(bench, effects, finding.effect) > ACCURACY
        if not rejected and not moves:
            rejected = (f'it is too small to matter: the attenuation of no line changes by more '
                        f'than {ACCURACY:g}')
        if not rejected and not needed:
            rejected = (f'not needed: the {gained} leaves nothing significant '
                        f'(p = {min(p_value, 1.0):.2g})')
        if not rejected and not (new > old or told or (kind.seen and new > old - _SAME)):
            rejected = (f'the {gained} of held-out acquisitions is predicted no better: log score '
                        f'{new:.3f} after {old:.3f}')
        found.append(Candidate(name, number, finding, new, rejected))
    return found


def _best(candidates: Sequence[Candidate]) -> Candidate | None:
    """Return the candidate of the first tier that has one, the best score within it."""
    for tier in _TIERS:
        left = [item for item in candidates if item.name in tier and not item.rejected_because]
        if left:
            return max(left, key=lambda item: item.held_out_score or 0.0)
    left = [item for item in candidates if not item.rejected_because]
    return max(left, key=lambda item: item.held_out_score or 0.0) if left else None


def _moved(bench: Bench, effects: Sequence[Effect], more: Effect) -> float:
    """Return the largest RMS, over the acquisitions, by which an effect moves a prediction."""
    without, with_it = (bench.expect(known, bench.held_out).attenuation
                        for known in (effects, [*effects, more]))
    return float(np.sqrt(np.mean((with_it - without) ** 2, axis=0).max()))


def _decisive(finding: Finding, before: Residual, after: Residual) -> bool:
    """Tell whether an effect predicts what the declared model takes for chance."""
    return (finding.p_value < _DECISIVE and before.rms > _MATERIAL
            and after.rms < 0.5 * before.rms)


def _told(bench: Bench, effects: Sequence[Effect], finding: Finding, before: Residual,
          after: Residual) -> bool:
    """
    Tell whether held-out pulse errors tell an effect that the attenuation is too rough to tell.

    Beside a large effect, the chance of few averages hides another; but it must explain them.
    """
    moved = float(np.sqrt(np.mean((after.mean - before.mean) ** 2)))
    if finding.effect is None or moved < _MOVED or after.p_attenuation < SIGNIFICANT:
        return False
    without, with_it = (log_likelihood(bench.gather(known, bench.held_out))
                        for known in (effects, [*effects, finding.effect]))
    return with_it - without > _TOLD


def _shifted(finding: Finding) -> list[Effect]:
    """Return the effect with each of its numbers one standard error larger."""
    found: list[Effect] = []
    if finding.effect is None or finding.effect.scatters:
        return found
    for name, error in finding.standard_errors.items():
        value = finding.effect.values[name]
        if isinstance(value, float) and isinstance(error, float) and np.isfinite(error):
            try:
                found.append(replace(finding.effect, **{name: value + error}))  # type: ignore
            except ValueError:
                continue
    return found
