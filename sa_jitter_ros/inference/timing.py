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
What the timing of a recording shows: effects on pulse times and source, their sizes and limits.

The likelihood of pulse times and recovered errors chooses among sets of effects
(`timing_choice`). What it leaves is checked in ways that no effect has a part in: power in a
direction, sinusoids, and errors that are not normal.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
import math
from typing import Any

import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.effects import Effect, EFFECTS
from sa_jitter_ros.effects.band import (
    ACCELERATION_BAND, band_of_ripple, ripple_correlation, slow_band, WIDEST)
from sa_jitter_ros.effects.clock_skew import ClockSkew
from sa_jitter_ros.effects.effect import (
    beyond_chance, departs, Finding, ODDS, parameter_ranges, possible)
from sa_jitter_ros.effects.evidence import root
from sa_jitter_ros.effects.excess_jitter import ExcessJitter
from sa_jitter_ros.effects.jitter_scale import JitterScale
from sa_jitter_ros.effects.keyphasor_quantisation import KeyphasorQuantisation
from sa_jitter_ros.effects.lattice import (
    Clock, coarsest_clock, ROOM, SAME_RATE, smooth_on_grid)
from sa_jitter_ros.effects.speed_fluctuation import SpeedFluctuation
from sa_jitter_ros.effects.timing import FAINT, MOTION, Setting, SOURCE
from sa_jitter_ros.inference.line_search import APART, nearest_orders
from sa_jitter_ros.inference.observation import Acquisition, Observation
from sa_jitter_ros.inference.record_fit import RecordFit
from sa_jitter_ros.inference.record_recovery import jitter_unit, RecordRecovery, RESOLVED
from sa_jitter_ros.inference.timing_checks import Check, check_timing
from sa_jitter_ros.inference.timing_choice import (
    BAND, Choice, Chooser, DECIDED, NO_EFFECTS, RATIO, RIPPLE, SIDEBANDS)
from sa_jitter_ros.inference.timing_data import (
    ALIASES, FEWEST, Stretch)
from sa_jitter_ros.inference.timing_fit import JITTER, SHAFT, TimingFit
from sa_jitter_ros.inference.timing_shape import through
from sa_jitter_ros.number_text import measured_text
from sa_jitter_ros.prediction.model import DeclaredModel
from scipy import special

#: What distinguishes an effect from those that look like it.
_DECIDING = 'a longer recording, or one at other speeds'


@dataclass(frozen=True)
class Timing:
    """
    The effects that pulse times and recovered errors show, `findings`, whatever their size.

    `probabilities` are those of all effects that they could show.
    """

    findings: tuple[Finding, ...]
    probabilities: Mapping[str, float]
    chooser: Chooser = field(repr=False)
    choice: Choice = field(repr=False)

    @cached_property
    def checks(self) -> tuple[Check, ...]:
        """Return the tests of what is left."""
        return check_timing(self.chooser, self.choice)


def stretches(observation: Observation, chosen: Sequence[int], clock: Clock) -> list[Stretch]:
    """Return the unbroken stretches of pulses of some acquisitions; neighbours are in one."""
    model = observation.model
    unit = jitter_unit(model)
    found = []
    if not observation.recoveries:  # averages from topics, each with a mean error of 0
        grid = _grid(observation.pulses.times, clock)
        return [_of_average(observation, observation.acquisitions[a], unit, grid, clock.rate)
                for a in chosen]
    grids = [_grid(recovery.pulses.times, clock) for recovery in observation.recoveries]
    # where the vibration resolves the errors, it shows more than the reference keyphasor does
    resolved = np.median(np.concatenate([
        item.standard_errors for item in observation.recoveries]))
    reference = None if resolved < RESOLVED * unit else observation.pulses.reference
    for number, first, last in _runs(observation, chosen):
        recovery = observation.recoveries[number]
        numbers = recovery.pulses.number
        start, stop = numbers[first], numbers[last] + 1
        for part, fit in zip(recovery.stretches, recovery.fits):
            here = slice(max(part.start, start), min(part.stop, stop))
            if here.stop - here.start < 3:
                continue
            stretch = _stretch(model, recovery, part, here, grids[number], clock.rate, unit,
                               reference)
            found.append(replace(stretch, sidebands=_sidebands(fit, model),
                                 held=fit.held or observation.against_reference))
    return found


def _sidebands(fit: RecordFit, model: DeclaredModel) -> Array:
    """Return how far sidebands of several lines are from these, in cycles a trigger cycle."""
    declared, others = np.split(fit.orders, [fit.declared])
    turns = np.sort(np.abs(nearest_orders(others, declared)[1])) * model.cycle_length
    least = APART / fit.errors.size
    turns = turns[(turns > least) & (turns < ALIASES.max())]
    groups = np.split(turns, np.flatnonzero(np.diff(turns) > least) + 1)
    return np.array([group.mean() for group in groups if group.size > 1])


def _of_average(observation: Observation, item: Acquisition, unit: float, grid: Array | None,
                rate: float) -> Stretch:
    """Return the pulses of one average, without what happens inside its cycles."""
    count = item.times.size
    model = observation.model
    setting = Setting(model, unit, item.first + np.arange(count), item.times,
                      item.times - item.errors,
                      item.times[0] - item.first * model.trigger_period, item.times,
                      None if grid is None else grid[item.first:item.first + count], rate)
    return Stretch(setting, np.ones(count, np.bool_), item.errors,
                   float(np.sqrt(np.mean(item.standard_errors**2))), math.inf,
                   np.zeros(count - 1), math.inf, 1e-6 * unit)


def _runs(observation: Observation, chosen: Sequence[int]) -> list[tuple[int, int, int]]:
    """Return recording and first and last pulse of each run of neighbouring acquisitions."""
    runs: list[tuple[int, int, int]] = []
    recording, previous = observation.recording.tolist(), -2
    for a in sorted(set(chosen)):
        item, number = observation.acquisitions[a], recording[a]
        end = item.first + item.times.size - 1
        if runs and previous == a - 1 and runs[-1][0] == number:
            runs[-1] = (number, runs[-1][1], end)
        else:
            runs.append((number, item.first, end))
        previous = a
    return runs


def _stretch(model: DeclaredModel, recovery: RecordRecovery, part: slice, here: slice,
             imposed: Array | None, rate: float, unit: float, reference: Array | None) -> Stretch:
    """
    Return the pulses `here` of a `part` of a recording that is unbroken, missing ones too.

    `imposed` are the errors that a clock of some `rate` imposes on the measured pulses. With the
    times of a `reference` the errors are those against it.
    """
    pulses, errors = recovery.pulses, recovery.bridged_errors[here]
    bridged, measured = pulses.bridged[here], pulses.measured[here]
    expected = recovery.expected_std
    bends = np.nan_to_num(recovery.ripple[here.start:here.stop - 1])
    error_std = float(np.median(recovery.bridged_standard_errors[here][measured]))
    prior = expected[0]
    bend_std, bend_prior = recovery.ripple_standard_error, expected[1]
    if reference is not None:
        better = reference[here]
        known = np.isfinite(better)
        measured = measured & known
        errors = np.where(known, bridged - better, 0.0)
        errors = errors - errors[measured].mean()
        error_std, prior = 0.0, math.inf
        bend_std = math.inf  # what shows no errors shows no bends
    grid = None
    if imposed is not None:
        grid = np.zeros(pulses.bridged.size)
        grid[pulses.number] = imposed
        grid = grid[here]
    index = pulses.ahead + np.arange(here.start, here.stop)
    setting = Setting(model, unit, index, bridged, bridged - errors,
                      float(pulses.bridged[0]), pulses.bridged[part], grid, rate)
    return Stretch(setting, measured, errors, max(error_std, 1e-6 * unit), prior, bends,
                   bend_std, bend_prior, reference is not None)


def _grid(times: Array, clock: Clock) -> Array | None:
    """Return the errors that the grid of a clock imposes on pulses, None where it imposes none."""
    if clock.dithered or not clock.rate > 0.0:
        return None
    smooth = smooth_on_grid(times, clock.rate)
    return smooth if np.std(smooth) > ROOM / clock.rate else None


def read_timing(parts: Sequence[Stretch], declared: Sequence[Effect] = (), *,
                names: frozenset[str] | None = None) -> Timing | None:
    """
    Return what some stretches show; None where they are too short to show anything.

    With `names` these effects are fitted, and no set is chosen.
    """
    parts = [item for item in parts if item.errors.size > FEWEST + 2
             and math.isfinite(item.error_std) and np.all(np.isfinite(item.errors))]
    if not parts:
        return None
    chooser = Chooser(parts, declared)
    if names is None:
        choice = chooser.choose()
    else:
        chooser.fit(names)
        choice = chooser.choice(names)
    findings = _findings(chooser, choice, declared)
    return Timing(findings, _probabilities(choice, findings), chooser, choice)


def refitted(timing: Timing, parts: Sequence[Stretch], declared: Sequence[Effect]
             ) -> tuple[Timing, Timing]:
    """
    Return what was chosen, and that with parameters that fit other stretches.

    What `timing` left undecided, these decide. Both are the same where ticks of a clock make all
    errors, or where other effects result.
    """
    choice = timing.choice
    if choice.quantised:
        return timing, timing
    chooser, fits = Chooser(parts, declared), choice.fits
    # other stretches may have other sidebands
    again = {names: chooser.fit(names, {name: start for name, start in fits[names].starts.items()
                                        if name != SIDEBANDS}) for names in choice.undecided}
    best = max(again, key=lambda names: chooser.score(names, again[names]))
    if best != choice.best:
        choice = replace(choice, best=best)
        timing = replace(timing, choice=choice, findings=_findings(
            timing.chooser, choice, declared))
    choice = replace(choice, fits={**fits, best: again[best]}, setting=chooser.setting)
    findings = _findings(chooser, choice, declared)
    if _chosen(findings) != _chosen(timing.findings):
        return timing, timing
    return timing, Timing(findings, timing.probabilities, chooser, choice)


def _chosen(findings: Sequence[Finding]) -> Sequence[str]:
    """Return the names of effects; the bends of a speed are found whatever the others are."""
    return [item.name for item in findings if item.name != SpeedFluctuation.name]


def _probabilities(choice: Choice, findings: Sequence[Finding]) -> Mapping[str, float]:
    """Return the probability of each effect; power beyond the declared is of two names."""
    found = {name: value for name, value in choice.probabilities.items() if name in EFFECTS}
    scaled = found.pop(JITTER, choice.probabilities.get(JITTER, 0.0))
    named = {finding.name for finding in findings}
    shared = any(JITTER in finding.indistinguishable_from for finding in findings)
    excess = 0.5 if shared else float(ExcessJitter.name in named)
    found[JITTER], found[ExcessJitter.name] = (1.0 - excess) * scaled, excess * scaled
    return found


def _p_value(choice: Choice, name: str, chooser: Chooser) -> float:
    """Return the p value of the likelihood gained by an effect beside the others."""
    if choice.quantised and name == KeyphasorQuantisation.name:
        return 0.0  # the pulse times themselves show it
    without = chooser.fit(choice.best - {name}, choice.fit.starts)
    gain = max(choice.fit.value - without.value, 0.0)
    return float(special.chdtrc(max(choice.fit.count - without.count, 1), 2.0 * gain))


def _findings(chooser: Chooser, choice: Choice, declared: Sequence[Effect]
              ) -> tuple[Finding, ...]:
    found = []
    for name in sorted(choice.best):
        if name == JITTER:
            found.append(_of_jitter(chooser, choice, declared))
        elif name not in NO_EFFECTS and (other := _of_effect(chooser, choice, name)):
            found.append(other)
    if KeyphasorQuantisation.name in choice.fit.columns and JITTER not in choice.best:
        beside = _beside_the_clock(chooser, choice)
        found += [beside] if beside else []
    if other_clock := _other_clock(chooser):
        found.append(other_clock)
    if speed := _of_speed(choice, declared):
        found.append(speed)
    return tuple(replace(item, deciding_measurement=_DECIDING)
                 if item.indistinguishable_from else item for item in found)


def _of_effect(chooser: Chooser, choice: Choice, name: str) -> Finding | None:
    """Return a spectrum or pattern as effect, None where it is out of range."""
    fit, found = choice.fit, chooser.effect(name, choice.fit)
    if found is None:
        return None
    effect, errors = found
    if RATIO in fit.columns and isinstance(effect, ClockSkew):
        effect = _by_angle(effect, fit)
    rivals = tuple(ExcessJitter.name if other == JITTER else other for other in choice.rivals(name)
                   if other not in NO_EFFECTS)
    if {RIPPLE, BAND} & {*choice.rivals(name)}:
        rivals = (*rivals, SpeedFluctuation.name)
    text = (f'{effect.summary}: {_sizes(effect, errors)}{effect.remark(choice.setting.model)}, '
            'which pulse times and errors recovered from the vibration show')
    return Finding(name, effect, errors, _p_value(choice, name, chooser), text,
                   indistinguishable_from=rivals)


def _by_angle(effect: ClockSkew, fit: TimingFit) -> ClockSkew:
    """Return a skew that grows with the angle as a ratio makes it, or of which a part does."""
    place = [fit.columns[name].start for name in (effect.name, RATIO)]
    skew, by_angle = fit.sizes[place]
    known = fit.size_covariance[np.ix_(place, place)]
    apart = (by_angle - skew) ** 2 / (known[0, 0] - 2.0 * known[0, 1] + known[1, 1])
    both = beyond_chance(0.5 * apart, 1, fit.data.cycles) > ODDS
    return replace(effect, by_angle=by_angle / skew if both else 1.0)


def _sizes(effect: Effect, errors: Mapping[str, Any]) -> str:
    """Return the numbers of an effect with standard errors and units."""
    found = []
    for name, limits in parameter_ranges(type(effect)).items():
        value, error = effect.values[name], errors.get(name)
        if isinstance(value, tuple):
            size = float(np.sqrt(np.mean(np.square(value))))
            found.append(f'{name} of {measured_text(size, None, limits.unit)} RMS')
        else:
            found.append(f'{name} {measured_text(value, error, limits.unit)}')
    return ', '.join(found)


def _of_jitter(chooser: Chooser, choice: Choice, declared: Sequence[Effect]) -> Finding:
    """
    Return how large the declared jitter is, or the jitter beyond it.

    A scale that is declared is another size of it unless the distribution says otherwise.
    """
    known = [item.scale for item in declared if isinstance(item, JitterScale)]
    least = known[0] if known else 1.0
    fit, setting = choice.fit, choice.setting
    log_power, normal_error = float(fit.starts[JITTER][0]), float(fit.standard_errors(JITTER)[0])
    scale = math.exp(0.5 * log_power)
    seen = fit.more_than_held(JITTER, chooser.shapes.kurtosis if chooser.shapes else 0.0)[1]
    error = 1.0 / seen if seen > 0.0 else normal_error
    p_value = _p_value(choice, JITTER, chooser)
    same = math.sqrt(setting.model.distribution.variance)
    text = (f'independent pulse errors of {measured_text(scale * same, None, "s")}, '
            f'{measured_text(scale, 0.5 * scale * error)} times the declared ones')
    rivals = tuple(name for name in choice.rivals(JITTER) if name in EFFECTS)
    odds = math.inf
    if scale > least:  # the same power, but the distribution tells
        odds = chooser.of_shape(fit, scale**2) - chooser.of_shape(fit, least**2)
    if odds > (-DECIDED if known else DECIDED):
        if math.inf > odds > DECIDED:
            text += '; their distribution is the declared one, as wide'
        return Finding(JITTER, JitterScale(scale), {'scale': 0.5 * scale * error}, p_value, text,
                       indistinguishable_from=rivals)
    share = max(1.0 - (least / scale) ** 2, 1e-9)  # of all power
    effect, errors = EFFECTS[ExcessJitter.name].of_timing(
        np.array([log_power + math.log(share)]), np.array([normal_error / share]), setting)
    if odds > -DECIDED:
        rivals = (JITTER, *rivals)
    return Finding(ExcessJitter.name, effect, errors, p_value, text, indistinguishable_from=rivals)


def _beside_the_clock(chooser: Chooser, choice: Choice) -> Finding | None:
    """Return the jitter beside the errors of a clock's grid, None without."""
    fit = choice.fit
    bare = chooser.fit(choice.best, fit.starts, held={(JITTER, 0): FAINT})
    gain = fit.value - bare.value
    if gain < 0.5 * math.log(fit.data.cycles) + DECIDED:
        return None
    found = chooser.effect(JITTER, fit)
    if found is None:
        return None
    effect, errors = found
    return Finding(ExcessJitter.name, effect, errors, float(special.chdtrc(1, 2.0 * gain)),
                   f'{effect.summary} beside those of the grid: {_sizes(effect, errors)}')


def _other_clock(chooser: Chooser) -> Finding | None:
    """Return the coarsest clock there may be where a declared one cannot have made the pulses."""
    known = chooser.declared.get(KeyphasorQuantisation.name)
    if not isinstance(known, KeyphasorQuantisation) or known.name in chooser.patterns:
        return None
    coarsest = coarsest_clock(chooser.data.pulse_times)
    if coarsest is None or known.clock_rate > (1.0 - SAME_RATE) * coarsest:
        return None
    return Finding(
        KeyphasorQuantisation.name, replace(known, clock_rate=coarsest), {'clock_rate': None}, 0.0,
        f'the pulse times are on no grid of {known.clock_rate:.6g} Hz, as it is declared; no '
        f'clock slower than {coarsest:.3g} Hz could have made them', gain=-math.inf)


def _of_speed(choice: Choice, declared: Sequence[Effect]) -> Finding | None:
    """
    Return the acceleration of the shaft that bends the angle inside the cycles, if it shows.

    It is part of the `declared` model already where that one is as likely; where less or nothing
    of it shows, that is returned.
    """
    fit, setting = choice.fit, choice.setting
    data = fit.data
    if data.series < 3:  # nothing is known of what happens inside the cycles
        return None
    shaft, source = (sum(fit.contribution(name)[:, 2, 2].real for name in (SHAFT, *fit.spectra)
                         if fit.moves(name) == direction) for direction in (MOTION, SOURCE))
    # of each frequency by itself: the rest are bends of a source that moves
    share = shaft / (shaft + source + fit.declared_motion[:, 2, 2].real)
    kept, density = np.sqrt(share), data.size * data.noise[:, 2, 2].real
    passed = float(share @ density / density.sum())
    parts, next_, count = [], [], 0
    for item in data.stretches:
        if not np.isfinite(item.bend_std):
            continue
        bends = through(item.bends, kept, data) + kept[0] * item.bends.mean()
        # as long as the slowest wave, so that their powers scatter by themselves
        for part in np.array_split(bends, max(1, int(bends.size * ACCELERATION_BAND[0]))):
            parts.append(np.mean(part**2) - passed * item.bend_std**2)
            next_.append(np.mean(part[1:] * part[:-1]))
            count += part.size
    if len(parts) < 2:
        return None
    power, error = _mean(parts)
    noise = passed * float(np.mean([item.bend_std**2 for item in data.stretches]))
    certainty = power / (noise * math.sqrt(2.0 / count) + 1e-300)
    gain = beyond_chance(0.5 * certainty**2, 1, data.cycles)
    known = next((item for item in declared if isinstance(item, SpeedFluctuation)), None)
    size, size_error = root(power, error)
    if power <= 0.0 or gain < ODDS:
        if known is None:
            return None
        effect, wrong = (SpeedFluctuation.of_ripple(value, setting.model, known.bandwidth)
                         for value in (size, size_error))
        errors = {'acceleration_std': wrong.acceleration_std}
    else:
        together = float(np.mean(next_)) / power  # correlation of neighbours
        off = _mean(np.array(next_) - together * np.array(parts))[1] / power
        below = max(ripple_correlation(slow_band(WIDEST, ACCELERATION_BAND)) - together, 0.0)
        if beyond_chance(0.5 * (below / off) ** 2, 1, data.cycles) > ODDS:  # a line that comes by
            return None
        low, bandwidth, high = band_of_ripple(together + off * np.array([1.0, 0.0, -1.0])).tolist()
        effect = SpeedFluctuation.of_ripple(size, setting.model, bandwidth)
        if not possible(effect, setting.model):
            return None
        errors = {'acceleration_std': effect.acceleration_std * size_error / size}
        if low < high:  # not the widest band
            errors['bandwidth'] = max(high - bandwidth, bandwidth - low)  # one side may end
    if known is not None and not departs(effect, errors, known, data.cycles):
        return None
    return Finding(
        SpeedFluctuation.name, effect, errors, float(special.ndtr(-certainty)),
        'the speed changes within a trigger cycle: the angle between the pulses errs by '
        f'u (1 - u) times {size:.3g} s',
        gain=gain)


def _mean(values: Sequence[float] | Array) -> tuple[float, float]:
    """Return the mean of some values and its standard error."""
    return float(np.mean(values)), float(np.std(values, ddof=1) / math.sqrt(len(values)))
