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
The choice among sets of effects on the timing, by the evidence for each set.

The evidence is the greatest likelihood less what parameters gain by chance (Schwarz), and the odds
against any effect. Effects are added, taken out and exchanged while that raises it. All sets that
were tried give each effect its probability.
"""

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import combinations, product
import math
from typing import Any

import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.effects import Effect, EFFECTS
from sa_jitter_ros.effects.clock_skew import WRONG_RATIO
from sa_jitter_ros.effects.effect import ODDS, possible, RARE
from sa_jitter_ros.effects.excess_jitter import ExcessJitter
from sa_jitter_ros.effects.lattice import ROOM, sizes_within_ticks, ticks_leave_room
from sa_jitter_ros.effects.phase_wander import PhaseWander
from sa_jitter_ros.effects.target_geometry import own_marks
from sa_jitter_ros.effects.timing import (
    FAINT, LARGE, MOTION, Pattern, PULSES, Setting, SOURCE, Spectrum)
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.inference.timing_data import of_measured, Stretch, TimingData
from sa_jitter_ros.inference.timing_fit import JITTER, SHAFT, TimingFit
from sa_jitter_ros.inference.timing_shape import Shapes

#: A pattern of the speed that repeats with the revolution: no effect, but marks may look like it.
RIPPLE = 'ripple'
#: Sidebands that turn all lines by one time: no effect, but a source that moves may look like it.
SIDEBANDS = 'sidebands'
#: A speed that varies up to some frequency: no effect, but a source that moves may look like it.
BAND = 'band'
#: What a wrong ratio makes beside a clock skew of its size: no effect, but a wrong number.
RATIO = 'ratio'
NO_EFFECTS = RIPPLE, SIDEBANDS, BAND, RATIO
#: Logarithm of the odds of two explanations from which on one of them is the answer.
DECIDED = -math.log(RARE)
# Logarithms of power and width, and of half the order, from which one of these is sought, beside
# the rest of the motion and beside one of so much less, in its logarithm.
_EDGES, _LESS = ((0.0, math.log(0.3), 1.4), (3.0, math.log(0.1), 1.4)), 6.0


@dataclass(frozen=True)
class Choice:
    """
    The best set of effects, and all sets that were tried with their evidence.

    `fits` maps sets of names to their fits, `scores` to their evidence.
    """

    best: frozenset[str]
    fits: Mapping[frozenset[str], TimingFit]
    scores: Mapping[frozenset[str], float]
    setting: Setting

    @property
    def fit(self) -> TimingFit:
        """Return the fit of the best set."""
        return self.fits[self.best]

    @property
    def quantised(self) -> bool:
        """Return whether the ticks of a clock make all errors, so that no others can be told."""
        return any(isinstance(timing := EFFECTS[name].timing, Pattern) and timing.replaces_jitter
                   for name in self.best - self.fit.columns.keys() & EFFECTS.keys())

    @cached_property
    def probabilities(self) -> Mapping[str, float]:
        """Return the probability of each name that was tried."""
        names = frozenset().union(*self.fits)
        if self.quantised:
            return {name: float(name in self.best) for name in names}
        top = max(self.scores.values())
        odds = {key: math.exp(value - top) for key, value in self.scores.items()}
        total = sum(odds.values())
        return {name: sum(value for key, value in odds.items() if name in key) / total
                for name in names}

    @property
    def undecided(self) -> Sequence[frozenset[str]]:
        """Return the best set, and those with one exchanged with odds that decide nothing."""
        least = self.scores[self.best] - DECIDED
        return [self.best, *(names for names, score in self.scores.items() if score > least and (
            len(names) == len(self.best) == len(names & self.best) + 1))]

    def rivals(self, name: str) -> tuple[str, ...]:
        """Return what explains the data in place of `name` with odds that decide nothing."""
        if self.quantised:
            return ()
        undecided, others = self.undecided, self.best - {name}
        return tuple(other for other in self.probabilities
                     if other not in self.best and others | {other} in undecided)


class Chooser:
    """Fits sets of effects to some stretches, each set once."""

    def __init__(self, stretches: Sequence[Stretch], declared: Sequence[Effect] = ()) -> None:
        self.data = TimingData(stretches)
        self.setting = self.data.stretches[0].setting
        self.declared = {item.name: item for item in declared if item.timing is not None}
        self.patterns: dict[str, tuple[Pattern, Array]] = {}
        held = any(item.held for item in stretches)
        for name, timing in {**{name: kind.timing for name, kind in EFFECTS.items()},
                             RATIO: WRONG_RATIO}.items():
            if isinstance(timing, Pattern) and (held or timing.show_in_times):
                columns = self._columns(timing)
                if columns is not None:
                    self.patterns[name] = timing, columns
        marks = self._ripple()
        if marks is not None:
            self.patterns[RIPPLE] = Pattern(lambda setting: np.zeros((0, 0))), marks
        self.spectra = {name: kind.timing for name, kind in EFFECTS.items()
                        if isinstance(kind.timing, Spectrum)}
        self.spectra[BAND] = replace(PhaseWander.timing, direction=MOTION, starts=_EDGES)
        lines = np.unique(np.concatenate([item.sidebands for item in stretches]))
        if lines.size:
            self.spectra[SIDEBANDS] = Spectrum(
                SOURCE, self._near(lines), ((-1.0,) * lines.size,), (FAINT,) * lines.size,
                (LARGE,) * lines.size)
        self.fits: dict[frozenset[str], TimingFit] = {}
        model = self.setting.model
        # normal errors stay normal whatever is beside them
        shown = model.jitter_distribution != 'normal' and model.distribution.variance > 0.0
        self.shapes = Shapes(model.distribution) if shown else None

    @property
    def pool(self) -> Sequence[str]:
        """Return the names of all that may be in a set."""
        names = self.patterns.keys() | self.spectra.keys()
        if ExcessJitter.name not in self.declared:  # jitter of another size
            names -= {ExcessJitter.name}
        return [JITTER, *(name for name in (*EFFECTS, *NO_EFFECTS) if name in names)]

    def _columns(self, pattern: Pattern) -> Array | None:
        """Return the ordinates (ordinate, 3, column) of a pattern, None where it has none."""
        rows = [pattern.columns(item.setting) for item in self.data.stretches]
        count = min(len(row) for row in rows)
        if not count or count > self.data.longest // 4:
            return None
        return np.stack([self.data.of_errors(some) for some in zip(*rows)], axis=-1)

    def _on_ticks(self, names: frozenset[str]) -> TimingFit | None:
        """
        Return the fit of patterns beside which ticks can make all errors, None where they cannot.

        Of a single pattern, the sizes that leave the errors within the ticks give its value.
        """
        fit, rate = self.fit(names), self.setting.clock_rate
        noise = float(np.mean([item.error_std**2 for item in self.data.stretches]))
        columns = [np.concatenate([np.zeros((0, item.errors.size)), *(
            self.patterns[name][0].columns(item.setting) for name in fit.columns)])
            for item in self.data.stretches]

        def left(sizes: Array) -> list[Array]:
            return [(item.errors - self.data.unit * (sizes @ some))[item.measured]
                    for item, some in zip(self.data.stretches, columns)]

        if fit.sizes.size != 1:
            return fit if ticks_leave_room(left(fit.sizes), noise, rate) else None
        step = ROOM / (rate * self.data.unit * float(np.ptp(np.concatenate(columns, axis=1))))
        tried = fit.sizes[0] + step * np.arange(-round(1.0 / ROOM), round(1.0 / ROOM) + 1)
        possible, weight = sizes_within_ticks(
            lambda size: left(np.array([size])), tried, noise, rate)
        if not possible.size:
            return None
        fit = copy(fit)
        fit.sizes = np.array([possible @ weight])
        fit.size_covariance = np.array([[(possible - fit.sizes) ** 2 @ weight + step**2 / 12.0]])
        return fit

    def score(self, names: frozenset[str], fit: TimingFit) -> float:
        """Return the logarithm of the evidence for a set of effects, its prior odds included."""
        prior = 0.0
        for name in names & fit.columns.keys():
            pattern, size = fit.patterns[name][0], fit.pattern(name)[0]
            if abs(size[0] - 1.0) > pattern.off_by:
                return -math.inf
            if pattern.usual is not None:
                prior += 0.5 * float(size[0] / pattern.usual(self.setting)) ** 2
        if not (math.isfinite(fit.value) and all(
                self.effect(name, fit, bare=True) for name in names & EFFECTS.keys())):
            return -math.inf
        shape = max(self.of_shape(fit, power) for power in self._powers(fit))
        return fit.value + shape - prior - self._gained_by_chance(fit) - ODDS * len(names)

    def effect(self, name: str, fit: TimingFit, *, bare: bool = False
               ) -> tuple[Effect, Mapping[str, Any]] | None:
        """
        Return an effect of a fit and its standard errors; None where no machine can have it.

        Where it is `bare`, random effects have no standard errors, which take long.
        """
        if name in fit.place:
            sizes = fit.starts[name]
            errors = np.zeros(sizes.size) if bare else fit.standard_errors(name)
        elif name in fit.columns:
            sizes, errors = fit.pattern(name)
        else:  # errors that are within the ticks of a clock
            sizes, errors = np.ones(1), np.zeros((1, 1))
        try:
            found = EFFECTS[ExcessJitter.name if name == JITTER else name].of_timing(
                sizes, errors, self.setting)
        except ParameterError:
            return None
        return found if possible(found[0], self.setting.model) else None

    def _gained_by_chance(self, fit: TimingFit) -> float:
        """
        Return what the free parameters gain in likelihood without being real (Schwarz).

        Each size of a pattern, as that of one mark, is seen in its share of the cycles only.
        """
        cycles, sizes = self.data.cycles, [place.stop - place.start
                                           for place in fit.columns.values()]
        others = fit.count - sum(sizes)
        return float(0.5 * others * math.log(cycles)
                     + 0.5 * sum(size * math.log1p(cycles / size) for size in sizes))

    def of_shape(self, fit: TimingFit, power: float) -> float:
        """Return what the distribution of single errors adds to the likelihood of a fit."""
        if self.shapes is None or self.on_ticks(fit):
            return 0.0
        return self.shapes.gain(fit, [self.left(fit, item) for item in self.data.stretches],
                                power)

    def on_ticks(self, fit: TimingFit) -> bool:
        """Return whether errors that a clock imposes are part of a fit, or declared."""
        return any(self.patterns[name][0].replaces_jitter for name in self.patterns
                   if name in fit.columns or name in self.declared)

    def _powers(self, fit: TimingFit) -> Sequence[float]:
        """Return the powers of declared errors, in unit^2: more may be of normal ones beside."""
        if JITTER not in fit.starts:
            return (1.0,)
        power = math.exp(fit.starts[JITTER][0])
        return (power, 1.0) if power > 1.0 else (power,)

    def left(self, fit: TimingFit, stretch: Stretch) -> Array:
        """Return the errors (pulse,) that patterns and a trend leave, in units."""
        place, known = np.arange(stretch.errors.size), np.zeros(stretch.errors.size)
        for name, (pattern, _) in self.patterns.items():
            if name == RIPPLE:
                continue
            if name in fit.columns:
                known += fit.pattern(name)[0] @ pattern.columns(stretch.setting)
            elif name in self.declared:
                known += self.declared[name].in_timing(self.setting) @ pattern.columns(
                    stretch.setting)
        errors = of_measured(stretch, stretch.errors / self.data.unit - known)
        return np.asarray(errors - np.polynomial.Polynomial.fit(place, errors, 1)(place))

    def _ripple(self) -> Array | None:
        """Return the ordinates of a motion that repeats with the revolution."""
        own, _ = own_marks(self.setting.model)
        if own == 1 or own > self.data.longest // 4:
            return None
        waves: list[Array] = []
        for harmonic in range(1, own // 2 + 1):
            both = self.data.of_wave(MOTION, harmonic / own)
            waves += both[:1] if 2 * harmonic == own else both
        return np.stack(waves, axis=-1)

    def _near(self, lines: Array) -> Callable[[Array, Array], Array]:
        """Return a density that sinusoids of some power and frequencies leave in a stretch."""
        width = max(1.0 / self.data.longest, 0.5 * float(np.diff(self.data.frequency).max()))

        def density(parameters: Array, frequency: Array) -> Array:
            return np.asarray(sum(
                np.exp(power) / (1.0 + (np.pi * (frequency - line) / width) ** 2)
                for power, line in zip(parameters, lines)))
        return density

    def fit(self, names: frozenset[str], start: Mapping[str, Array] | None = None, *,
            anew: bool = False, held: Mapping[tuple[str, int], float] | None = None) -> TimingFit:
        """
        Return the fit of a set, from where it may `start`, and also `anew`.

        `held` maps (name, number) to a parameter that stays.
        """
        if not held and names in self.fits:
            return self.fits[names]
        fixed: list[tuple[str, Callable[[Array], Array]]] = []
        known: Array | float = 0.0
        start = dict(start or {})
        for name, effect in self.declared.items():
            sizes = effect.in_timing(self.setting)
            if isinstance(effect.timing, Spectrum):
                if name in names:
                    anew |= name not in start
                    start.setdefault(name, sizes)
                else:
                    fixed.append((effect.timing.direction,
                                  partial(effect.timing.density, sizes)))
            elif name not in names and name in self.patterns:
                known = known + self.patterns[name][1] @ sizes
        spectra = {name: self.spectra[name] for name in sorted(names & self.spectra.keys())}
        for name, _ in held or ():
            if name in spectra and spectra[name].limited:
                spectra[name] = replace(spectra[name], lower=spectra[name].limited)
        patterns = {name: self.patterns[name] for name in sorted(names) if name in self.patterns}
        new = [[*([(name, start[name])] if name in start else []),
                *((name, np.array(first)) for first in item.starts)]
               for name, item in spectra.items() if anew or name not in start]
        if BAND in spectra and BAND not in start and SHAFT in start:
            less = start[SHAFT] - _LESS * (np.arange(start[SHAFT].size) < start[SHAFT].size - 1)
            new.append([(SHAFT, start[SHAFT]), (SHAFT, less)])
        found = max((TimingFit(
            self.data, spectra, patterns, scaled=JITTER in names, fixed=fixed,
            known=known, start={**start, **dict(some)}, held=held) for some in product(*new)),
            key=lambda fit: fit.value)
        if not held:
            self.fits[names] = found
        return found

    def choose(self) -> Choice:
        """
        Return the set of the greatest evidence that adding, dropping and exchanging reaches.

        Where the ticks of a clock can make all errors that few other patterns leave, they do.
        """
        best = self._of_ticks()
        if best:
            return self.choice(best)
        top = self.score(best, self.fit(best))
        pool = self.pool
        while True:
            moves = [best | {name} for name in pool if name not in best]
            moves += [best - {name} for name in best]
            moves += [(best - {name}) | {other} for name in best for other in pool
                      if other not in best]
            # what a pattern explains leaves random errors of another kind
            scores = {move: self.score(move, self.fit(
                move, self._start(best, move), anew=bool(move - best & self.patterns.keys())))
                for move in moves}
            better = max(scores, key=lambda move: scores[move])
            if scores[better] <= top:
                break
            best, top = better, scores[better]
        return self.choice(best)

    def _start(self, best: frozenset[str], move: frozenset[str]) -> Mapping[str, Array]:
        """Return where the fit of a set begins: jitter in place of other errors is as large."""
        start = self.fits[best].starts
        power = sum(math.exp(start[name][0]) for name in best - move & self.spectra.keys()
                    if self.spectra[name].direction == PULSES)
        return {JITTER: np.array([math.log1p(power)]), **start} if power else start

    def _of_ticks(self) -> frozenset[str]:
        """Return a clock and the fewest other patterns beside which its ticks make all errors."""
        clocks = {name for name, (item, _) in self.patterns.items() if item.replaces_jitter}
        others = sorted(self.patterns.keys() & EFFECTS.keys() - clocks)
        sets = (frozenset(some) for count in range(len(others) + 1)
                for some in combinations(others, count))
        for alone in sets if clocks else ():
            fit = self._on_ticks(alone)
            if fit is not None:
                self.fits[alone | clocks] = fit
                return alone | clocks
        return frozenset()

    def choice(self, best: frozenset[str]) -> Choice:
        """Return the choice of a set."""
        scores = {names: self.score(names, fit) for names, fit in self.fits.items()}
        possible = {names: fit for names, fit in self.fits.items()
                    if names == best or scores[names] > -math.inf}
        return Choice(best, possible, {names: scores[names] for names in possible}, self.setting)
