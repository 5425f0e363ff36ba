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
The complex amplitudes X that averages show of unit components, and the distribution of |X|.

Random effects multiply characteristic functions. Effects whose pulse errors are known up to one
number (the first mark of a target) make equally likely scenarios: moments are exact in each, the
distribution is curved in each, sampled for few cycles. Where no few scenarios hold all (lost
pulses, the grid of a clock under a varying speed) averages are drawn, each with its own scenario;
moments are then exact for lost pulses alone, and those of the draws elsewhere.

`predict` and the loop take their distributions from here: what is published is what is scored.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sa_jitter_ros.errors import ModelError
from sa_jitter_ros.prediction.amplitude_distribution import (
    AmplitudeDistribution, curved_distribution)
from sa_jitter_ros.prediction.angle_error import AngleErrorProcess, IndependentPulseJitter
from sa_jitter_ros.prediction.cumulants import average_cumulants
from sa_jitter_ros.prediction.influence import Influence, random_processes, require_modelled
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.prediction.moments import (
    AverageMoments, correlation_length, cycle_moments, CycleMoments, noise_line_variance)
from sa_jitter_ros.prediction.sampled_distribution import (
    can_be_sampled, drawn_averages, LONGEST, moments_of, MOST_PHASORS, SampledDistribution)
from sa_jitter_ros.prediction.scenario_moments import scenario_moments

Array = NDArray[Any]

# Up to here the distribution is sampled; with one more cycle the curved one is up to 0.015 off in
# its CDF, and 0.04 off for jitter as skewed as an exponential distribution.
_FEW_CYCLES, _FEW_LOPSIDED_CYCLES, _LOPSIDED = 9, 20, 1.2
# With scenarios: those of a pattern turn the cycles apart.
_FEW_CYCLES_OF_SCENARIOS = 20
# Independent cycles of effects: 10 of independent pulse errors count as 6.4 along, 5.3 across.
_FEW_ALONG, _FEW_ACROSS, _NOTHING = 12.0, 5.0, 1e-12
#: Scenarios of an influence, and of several together.
SCENARIOS = 256
_SEED = 11  # of which combinations
_DRAWS, _FEWEST = 8192, 64  # evenly spread values in all scenarios, in one
_SCENARIO_NODES = 32  # as `scenario_moments` takes at most
_WORK = 20_000_000_000  # multiplications of phasors, about a second


@dataclass(frozen=True)
class Amplitudes:
    """
    Complex amplitudes of unit components with the gain of the influences, without noise.

    `moments` (order,) are those over all scenarios, `each` (scenario, order) those in each, with
    the third cumulants `unmixed` k(X, X, X) and `mixed` k(X, X, conj X). Where they are too few
    numbers for the distribution, `draws` are equally likely values of X, (order, draw) of all
    scenarios or (order, scenario, draw) of each, and `noise` (draw,) is circular of variance 1.
    """

    moments: AverageMoments
    each: AverageMoments
    unmixed: Array
    mixed: Array
    draws: Array | None = field(default=None, repr=False)
    noise: Array | None = field(default=None, repr=False)

    def distribution(
        self, order: ArrayLike, *, shift: ArrayLike = 0.0, noise: ArrayLike = 0.0,
        most: int | None = None,
    ) -> AmplitudeDistribution | SampledDistribution:
        """
        Return the distribution of abs(X + shift + n) over all scenarios, one entry per row.

        `order` (row,) are indices of orders; `shift` is complex and `noise` is E|n|^2, one each or
        (row,). Of each row no more than `most` draws are used.
        """
        rows = np.asarray(order)
        shift, noise = np.asarray(shift), np.asarray(noise)
        moments = self.moments.of((rows,)).shifted(shift).with_noise(noise)
        if self.draws is not None:
            return self._sampled(self.draws[rows, :most], moments, shift, noise)
        count = len(self.each.mean)
        curved = self._curved((slice(None), rows), shift, noise)
        if count == 1:
            return curved
        values = curved.spread(max(_FEWEST, _DRAWS // count)).reshape(count, rows.size, -1)
        return SampledDistribution(np.moveaxis(values, 1, 0).reshape(rows.size, -1),
                                   moments.mean_square)

    def distribution_in(
        self, scenario: ArrayLike, order: ArrayLike, *, shift: ArrayLike = 0.0,
        noise: ArrayLike = 0.0,
    ) -> AmplitudeDistribution | SampledDistribution:
        """Return the same for rows that are in a scenario each; `scenario` (row,) are indices."""
        rows = np.asarray(scenario), np.asarray(order)
        shift, noise = np.asarray(shift), np.asarray(noise)
        if self.draws is None:
            return self._curved(rows, shift, noise)
        moments = self.each.of(rows).shifted(shift).with_noise(noise)
        return self._sampled(self.draws[rows[::-1]], moments, shift, noise)

    @property
    def skew(self) -> Array:
        """Return the skewness of the part along of each scenario and order."""
        return self._curved((slice(None), slice(None)), np.zeros(()), np.zeros(())).skew

    def _curved(self, rows: Any, shift: Array, noise: Array) -> AmplitudeDistribution:
        moments = self.each.of(rows).shifted(shift).with_noise(noise)
        return curved_distribution(AverageMoments(
            moments.mean.ravel(), moments.variance.ravel(), moments.pseudo_variance.ravel()),
            self.unmixed[rows].ravel(), self.mixed[rows].ravel())

    def _sampled(self, draws: Array, moments: AverageMoments, shift: Array, noise: Array
                 ) -> SampledDistribution:
        assert self.noise is not None
        size = np.sqrt(noise).astype(np.float32)
        values = (draws + shift.astype(np.complex64)[..., None]
                  + size[..., None] * self.noise[:draws.shape[1]])
        return SampledDistribution(np.abs(values), moments.mean_square, (values, moments))


def component_gain(model: DeclaredModel, influences: Sequence[Influence]) -> Array:
    """Return the factor (order,) of all influences; raise ModelError for one that is none."""
    total: Array = np.ones(len(model.orders))
    for item in influences:
        total = total * _of_orders('gain', item.gain(model), model, -np.inf)
    return total


def line_variance(model: DeclaredModel, influences: Sequence[Influence]) -> Array:
    """Return E|n|^2 (order,) of declared noise and all influences in a peak amplitude."""
    total: Array = np.zeros(len(model.orders))
    if model.noise_std:
        total = total + noise_line_variance(model.noise_std, model.sample_rate, model.duration)
    for item in influences:
        total = total + _of_orders('line_variance', item.line_variance(model), model, 0.0)
    return total


def unit_amplitudes(model: DeclaredModel, influences: Sequence[Influence] = ()) -> Amplitudes:
    """
    Return the amplitudes of averages of which no more is known than model and influences.

    Raises ModelError for an influence that has no forward model with the declared one, and where
    known pulse errors of that many cycles and orders are not worth their time.
    """
    require_modelled(model, influences)
    processes = random_processes(model, influences)
    gain = component_gain(model, influences)
    known = [(item, errors) for item, errors in (
        (item, item.scenarios(model)) for item in influences) if errors is not None]
    if any(item.drawn_scenarios(model, 1) is not None for item, _ in known):
        return _drawn(model, processes, gain, known)
    if known:
        errors = _affordable(model, processes, _combined([errors for _, errors in known]))
        return _pooled(model, processes, errors, gain)
    count, orders = model.trigger_cycles, np.asarray(model.orders)
    frequency = model.fundamental_frequency
    jitters = [process.distribution for process in processes
               if isinstance(process, IndependentPulseJitter)
               and (process.frequency, process.weights) == (frequency, model.weights)]
    alike = len(jitters) == len(processes) > 0
    spread = float(orders.max()) * frequency * math.sqrt(sum(item.variance for item in jitters))
    nodes = int(np.clip(16.0 + 16.0 * spread, 16 if alike else 32, 160))
    cycles = cycle_moments(orders, processes, nodes=nodes, lags=count)
    unmixed, mixed = average_cumulants(orders, processes, count, cycles)
    found = _of_scenarios(cycles.averaged(count).of(np.newaxis), unmixed, mixed, gain)
    if few_cycles(cycles, count, alike, found.skew) and can_be_sampled(
            processes, count, orders.size):
        return _with_draws(found, model, processes, gain)
    return found


def known_amplitudes(model: DeclaredModel, processes: Sequence[AngleErrorProcess], errors: Array,
                     *, gain: ArrayLike = 1.0) -> Amplitudes:
    """
    Return the amplitudes of averages whose pulse `errors` (scenario, n) in s are known.

    `processes` are what is random beside. Where these are independent errors, the distribution is
    curved for few cycles, too: the few hundred draws that one average is worth come no closer.
    """
    gain = np.asarray(gain) * np.ones(len(model.orders))
    found, cycles = _with_errors(model, processes, errors, gain)
    count = model.trigger_cycles
    independent = all(isinstance(process, IndependentPulseJitter) for process in processes)
    if not independent and few_cycles(cycles, count, False, found.skew) and can_be_sampled(
            processes, count, len(model.orders)):
        return _with_draws(found, model, processes, gain, errors, apart=True)
    return found


def few_cycles(cycles: CycleMoments, trigger_cycles: int, independent: bool, skew: Array) -> bool:
    """
    Return whether an average holds too few cycles for a limit theorem, so that it is sampled.

    Cycles that remember each other count as fewer: as the variance of one over that of the average
    says. `independent`: all errors are; `skew` is the skewness of the curved distribution.
    """
    average = cycles.averaged(trigger_cycles)
    power = np.abs(cycles.mean) ** 2
    if np.all(average.variance <= _NOTHING * power):
        return False
    lopsided = np.max(np.abs(skew)) > _LOPSIDED
    if trigger_cycles <= (_FEW_LOPSIDED_CYCLES if independent and lopsided else _FEW_CYCLES):
        return True
    if independent:
        return False
    turn = np.exp(-2j * np.angle(cycles.mean))
    pairs = [(m.variance, np.real(m.pseudo_variance * turn))
             for m in (cycles.lag(0), average)]
    for side, fewest in ((1.0, _FEW_ALONG), (-1.0, _FEW_ACROSS)):  # the mean phasor
        one, all_ = (variance + side * pseudo for variance, pseudo in pairs)
        if np.any((one < fewest * all_) & (all_ > _NOTHING * power)):
            return True
    return False


def _of_orders(name: str, value: ArrayLike, model: DeclaredModel, least: float) -> Array:
    """Return a gain or noise; raise ModelError for none, or not one for each order."""
    given = np.asarray(value)
    if given.shape not in ((), (1,), (len(model.orders),)):
        raise ModelError(f'{name} has the shape {given.shape}: give one value, or '
                         f'{len(model.orders)}, as many as orders')
    if not (np.all(np.isfinite(given)) and np.all(given.real >= least)):
        raise ModelError(f'{name} is {given}: it must be finite and at least {least:g}')
    return given


def _of_scenarios(each: AverageMoments, unmixed: Array, mixed: Array, gain: Array) -> Amplitudes:
    """Return amplitudes of scenarios of the same probability, without draws."""
    mean = each.mean.mean(axis=0)
    spread = each.mean - mean
    moments = AverageMoments(mean, np.mean(each.variance + np.abs(spread) ** 2, axis=0),
                             np.mean(each.pseudo_variance + spread**2, axis=0))
    # A scenario turns the cycles' phasors apart and shortens their sum, skewness included.
    return Amplitudes(moments.scaled(gain), each.scaled(gain),
                      np.broadcast_to(unmixed * gain**3, each.mean.shape),
                      np.broadcast_to(mixed * gain * np.abs(gain) ** 2, each.mean.shape))


def _with_errors(model: DeclaredModel, processes: Sequence[AngleErrorProcess], errors: Array,
                 gain: Array) -> tuple[Amplitudes, CycleMoments]:
    """Return curved amplitudes for known errors (scenario, n) in s, and moments without them."""
    count, orders = model.trigger_cycles, np.asarray(model.orders)
    each = scenario_moments(model, processes, errors)
    cycles = cycle_moments(orders, processes, nodes=_SCENARIO_NODES, lags=count)
    unmixed, mixed = average_cumulants(orders, processes, count, cycles)
    share = each.mean / np.where(np.abs(cycles.mean) > 0.0, cycles.mean, 1.0)
    found = _of_scenarios(each, unmixed * share**3, mixed * share * np.abs(share) ** 2, gain)
    return found, cycles


def _pooled(model: DeclaredModel, processes: Sequence[AngleErrorProcess], errors: Array,
            gain: Array) -> Amplitudes:
    """Return amplitudes that give each scenario the same probability."""
    count = model.trigger_cycles
    found, cycles = _with_errors(model, processes, errors, gain)
    independent = all(isinstance(process, IndependentPulseJitter) for process in processes)
    few = count <= _FEW_CYCLES_OF_SCENARIOS or few_cycles(cycles, count, independent, found.skew)
    if few and can_be_sampled(processes, count, len(model.orders)):
        return _with_draws(found, model, processes, gain, errors)
    return found


def _with_draws(found: Amplitudes, model: DeclaredModel, processes: Sequence[AngleErrorProcess],
                gain: Array, errors: Array | None = None, *, apart: bool = False) -> Amplitudes:
    """Return the amplitudes with draws, in each scenario as many where they are kept `apart`."""
    cycles = None if errors is None else errors * model.fundamental_frequency
    known = None if apart or cycles is None else lambda n: cycles[np.arange(n) % len(cycles)]
    draws, noise = drawn_averages(model.orders, processes, model.trigger_cycles, known=known,
                                  weights=model.weights, each=cycles if apart else None)
    return replace(found, draws=_grown(draws, gain), noise=noise)


def _drawn(model: DeclaredModel, processes: Sequence[AngleErrorProcess], gain: Array,
           influences: Sequence[tuple[Influence, Array]]) -> Amplitudes:
    """Return amplitudes of averages that are drawn, each with its scenario."""
    if not can_be_sampled(processes, model.trigger_cycles, len(model.orders)):
        names = ', '.join(item.name for item, _ in influences)
        raise ModelError(
            f'trigger_cycles is {model.trigger_cycles} with {len(model.orders)} orders: averages '
            f'under {names} are drawn one by one, of at most {LONGEST} cycles and {MOST_PHASORS} '
            'cycles times orders, less where slow motions come on top; predict fewer')

    def known(count: int) -> Array:
        total: Array = np.zeros(())
        for item, every in influences:
            rows = item.drawn_scenarios(model, count)
            if rows is None:
                rows = every[np.random.default_rng(_SEED).integers(len(every), size=count)]
            total = total + rows
        return total * model.fundamental_frequency

    draws, noise = drawn_averages(model.orders, processes, model.trigger_cycles,
                                  weights=model.weights, known=known)
    moments = influences[0][0].exact_moments(model, processes) if len(influences) == 1 else None
    if moments is None:
        moments = moments_of(draws)
    nothing = np.zeros(len(model.orders))
    found = _of_scenarios(moments.of(np.newaxis), nothing, nothing, gain)
    return replace(found, draws=_grown(draws, gain), noise=noise)


def _grown(draws: Array, gain: Array) -> Array:
    """Return draws (order, ...) of the component with its gain, in their precision."""
    return np.asarray((draws.T * gain.astype(np.complex64)).T)


def _combined(known: Sequence[Array]) -> Array:
    """Return the sums of independent scenarios, all of them or as many as are worth their time."""
    total = known[0]
    for more in known[1:]:
        total = (total[:, None, :] + more[None, :, :]).reshape(-1, total.shape[1])
        if len(total) > SCENARIOS:
            rows = np.random.default_rng(_SEED).permutation(len(total))[:SCENARIOS]
            total = total[np.sort(rows)]
    return total


def _affordable(model: DeclaredModel, processes: Sequence[AngleErrorProcess], errors: Array
                ) -> Array:
    """Return as many scenarios as take about a second, at least one; raise ModelError for none."""
    cycles = scenario_cycles(model, processes)
    if cycles < model.trigger_cycles:
        raise ModelError(
            f'trigger_cycles is {model.trigger_cycles} with {len(model.orders)} orders: with '
            f'known pulse errors at most {cycles} cycles are worth their time; predict '
            'fewer cycles or fewer orders')
    kept = min(len(errors), cycles // model.trigger_cycles)
    return errors[np.arange(kept) * len(errors) // kept]


def scenario_cycles(model: DeclaredModel, processes: Sequence[AngleErrorProcess] = ()) -> int:
    """Return how many cycles, of all scenarios of a model together, take about a second."""
    pairs = 2 * _SCENARIO_NODES * (correlation_length(processes) + 1)
    return _WORK // (len(model.orders) * _SCENARIO_NODES * (25 + pairs))
