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
from numpy.typing import ArrayLike
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.errors import ModelError
from sa_jitter_ros.prediction.amplitude_distribution import AmplitudeDistribution, curved_along
from sa_jitter_ros.prediction.angle_error import (
    angle_spread, AngleErrorProcess, IndependentPulseJitter, only_angles)
from sa_jitter_ros.prediction.cumulants import average_cumulants
from sa_jitter_ros.prediction.distributions import Empirical, PulseErrorDistribution
from sa_jitter_ros.prediction.influence import Influence, random_processes, require_modelled
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.prediction.moments import (
    AverageMoments, correlation_length, cycle_moments, CycleMoments, noise_line_variance)
from sa_jitter_ros.prediction.parts import Parts
from sa_jitter_ros.prediction.sampled_distribution import (
    affordable_draws, distribution_of, drawn_averages, moments_of, most_cycles, number_of_places,
    SampledDistribution)
from sa_jitter_ros.prediction.scenario_moments import scenario_moments
from sa_jitter_ros.pulses.angle_law import LINEAR_LAW

# Cycles up to which the distribution is sampled under effects. Of independent pulse errors, as
# many as leave the curved one 0.005 off in its CDF: more under a bent law, as many again for each
# unit of a table's squared skewness, and more where few values of a table make few of an average.
_FEW_CYCLES, _FEW_INDEPENDENT, _FEW_BENT, _FEW_OF_VALUES, _VALUES = 9, 20, 30, 100, 8
_FEW_LEFT = 7.0  # cycles over the share of its power that one keeps, all of it in a few of them
_MOST_FEW, _ENOUGH = 400, 4096  # draws, in which a median is uncertain by 0.005
# With scenarios: those of a pattern turn the cycles apart.
_FEW_CYCLES_OF_SCENARIOS = 20
# Radians of an order: there 1e-9 is left of the scatter along, 1e-14 of its third power. What is
# missing of the mean, and the scatter across, keep digits until errors are so many times less.
_SMALL, _PLAIN = 0.01, {'r': 1e3, 'ii': 1e4}
# Independent cycles of effects: 10 of independent pulse errors count as 6.4 along, 5.3 across.
_FEW_ALONG, _FEW_ACROSS, _NOTHING = 12.0, 5.0, 1e-12
#: Scenarios of an influence, and of several together.
SCENARIOS = 256
_SEED = 11  # of which combinations
_GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)  # steps of so much are even, and so is any part of them
_DRAWS, _FEWEST = 8192, 64  # evenly spread values in all scenarios, in one
_SCENARIO_NODES = 32  # as `scenario_moments` takes at most
_WORK = 20_000_000_000  # multiplications of phasors, about a second


@dataclass(frozen=True)
class Amplitudes:
    """
    Complex amplitudes of unit components with the gain of the influences, without noise.

    `moments` (order,) are those over all scenarios, `each` (scenario, order) those in each; so are
    `parts` and `parts_of_each` along and across the component, with third cumulants. Where these
    are too few numbers for the distribution, `draws` are values of R + j I of `parts`, (order,
    draw) of all scenarios or (order, scenario, draw) of each, and `noise` (draw,) is circular of
    variance 1.
    """

    moments: AverageMoments
    each: AverageMoments
    parts: Parts
    parts_of_each: Parts
    draws: Array | None = field(default=None, repr=False)
    noise: Array | None = field(default=None, repr=False)

    def distribution(self, order: ArrayLike, *, shift: ArrayLike = 0.0, noise: ArrayLike = 0.0,
                     most: int | None = None) -> AmplitudeDistribution | SampledDistribution:
        """
        Return the distribution of abs(X + shift + n) over all scenarios, one entry per row.

        `order` (row,) are indices of orders; `shift` is complex and `noise` is E|n|^2, one each or
        (row,). Of each row no more than `most` draws are used.
        """
        rows = np.asarray(order)
        shift, noise = np.asarray(shift), np.asarray(noise)
        if self.draws is not None:
            every = -(-self.draws.shape[1] // (most or self.draws.shape[1]))
            step = 1 << (every - 1).bit_length()  # of a lattice, such points are one, too
            return self._sampled(self.draws[rows, ::step], self.parts.of((rows,)), shift, noise)
        count = len(self.each.mean)
        curved = self._curved((slice(None), rows), shift, noise)
        if count == 1:
            return curved
        values = curved.center[:, None] + curved.spread(max(_FEWEST, _DRAWS // count))
        values = np.moveaxis(values.reshape(count, rows.size, -1), 1, 0).reshape(rows.size, -1)
        center = values.mean(axis=1)
        moments = self.moments.of((rows,)).shifted(shift).with_noise(noise)
        return SampledDistribution(center, values - center[:, None], moments.mean_square)

    def distribution_in(self, scenario: ArrayLike, order: ArrayLike, *, shift: ArrayLike = 0.0,
                        noise: ArrayLike = 0.0) -> AmplitudeDistribution | SampledDistribution:
        """Return the same for rows that are in a scenario each; `scenario` (row,) are indices."""
        rows = np.asarray(scenario), np.asarray(order)
        shift, noise = np.asarray(shift), np.asarray(noise)
        if self.draws is None:
            return self._curved(rows, shift, noise)
        return self._sampled(self.draws[rows[::-1]], self.parts_of_each.of(rows), shift, noise)

    def _curved(self, rows: Any, shift: Array, noise: Array) -> AmplitudeDistribution:
        parts = self.parts_of_each.of(rows).shifted(shift).with_noise(noise)
        return curved_along(parts.centred().raveled())

    def _sampled(self, draws: Array, parts: Parts, shift: Array, noise: Array
                 ) -> SampledDistribution:
        assert self.noise is not None
        whole = parts.shifted(shift).with_noise(noise)
        turn = parts.direction * whole.direction.conj()
        return distribution_of(
            draws * turn[..., None]
            + np.sqrt(noise)[..., None] * self.noise[::self.noise.size // draws.shape[-1]], whole)


def component_gain(model: DeclaredModel, influences: Sequence[Influence]) -> Array:
    """Return the factor (order,) of all influences; raise ModelError for one that is none."""
    total: Array = np.ones(len(model.orders))
    for item in influences:
        total = total * _of_orders('gain', item.gain(model), model, -np.inf)
    return total


def line_variance(model: DeclaredModel, influences: Sequence[Influence]) -> Array:
    """Return E|n|^2 (order,) of declared noise and all influences in a peak amplitude."""
    total: Array = np.zeros(len(model.orders))
    if model.noise:
        total = total + noise_line_variance(model.noise, model.sample_rate, model.duration)
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
        return known_amplitudes(model, processes, errors, gain=gain, apart=False)
    return _of_random(model, processes, gain)


def _of_random(model: DeclaredModel, processes: Sequence[AngleErrorProcess], gain: Array
               ) -> Amplitudes:
    """
    Return the amplitudes of random errors alone.

    Where errors are small, moments are differences of numbers that hardly differ. An order of
    which they are so small is taken for a higher one, of which they are `_SMALL`, and put back by
    the powers with which turning and shortening grow: to 1e-5 of what is missing from 1, and
    3e-4 where a table has values far out.
    Mean and mean square are exact to the last digits. Beside a gain, which does not grow with the
    order, standard deviations are good to 1e-8.
    """
    count, orders = model.trigger_cycles, np.asarray(model.orders)
    frequency = model.fundamental_frequency
    jitters = [process.distribution for process in processes
               if isinstance(process, IndependentPulseJitter)
               and (process.frequency, process.weights) == (frequency, model.weights)]
    alike = len(jitters) == len(processes) > 0
    angle = 2.0 * np.pi * orders * angle_spread(processes)
    grown = np.ones(orders.size)
    if only_angles(processes):
        np.divide(_SMALL, angle, out=grown, where=(angle > 0.0) & (angle < _SMALL))
    higher = grown * orders
    spread = float(np.max(angle * grown)) / (2.0 * np.pi)
    nodes = int(np.clip(16.0 + 16.0 * spread, 16 if alike else 32, 160))
    if any(isinstance(item, Empirical) for item in jitters):  # which smear nothing
        nodes = int(np.clip(4.0 * spread, nodes, 640))
    cycles = cycle_moments(higher, processes, nodes=nodes, lags=count)
    unmixed, mixed = average_cumulants(higher, processes, count, cycles)
    average = cycles.averaged(count)
    parts = Parts.about(1.0, average, unmixed, mixed).shrunk(1.0 / grown)
    for name, most in _PLAIN.items():
        plain = (grown > 1.0) & (grown < most)
        if plain.any():
            own = Parts.about(1.0, cycle_moments(
                orders[plain], processes, nodes=nodes, lags=count).averaged(count))
            getattr(parts, name)[plain] = getattr(own, name)
    found = _of_parts(parts.of(np.newaxis), gain)
    few = _few_independent(model, jitters, cycles, spread) if alike else None
    if few_cycles(cycles, count, few) and count <= most_cycles(processes, orders.size):
        return _with_draws(found, model, processes, gain)
    return found


def known_amplitudes(model: DeclaredModel, processes: Sequence[AngleErrorProcess], errors: Array,
                     *, gain: ArrayLike = 1.0, apart: bool = True) -> Amplitudes:
    """
    Return the amplitudes of averages whose pulse `errors` (scenario, n) in s are known.

    `processes` are what is random beside. Scenarios are equally likely; where they are kept
    `apart`, each has a distribution of its own. Under independent errors that is curved for few
    cycles, too: the few hundred draws that one average is worth come no closer.
    """
    gain = np.asarray(gain) * np.ones(len(model.orders))
    found, cycles = _with_errors(model, processes, errors, gain)
    count = model.trigger_cycles
    independent = all(isinstance(process, IndependentPulseJitter) for process in processes)
    if apart:
        few = not independent and few_cycles(cycles, count, None)
    else:
        few = count <= _FEW_CYCLES_OF_SCENARIOS or few_cycles(
            cycles, count, _FEW_CYCLES_OF_SCENARIOS if independent else None)
    if few and count <= most_cycles(processes, len(model.orders)):
        return _with_draws(found, model, processes, gain, errors, apart=apart)
    return found


def _few_independent(model: DeclaredModel, jitters: Sequence[PulseErrorDistribution],
                     cycles: CycleMoments, spread: float) -> int:
    """
    Return up to how many cycles the distribution of independent pulse errors is sampled.

    It is not where that few draws of as many orders are worth their time that the curved
    distribution is closer.
    """
    linear = model.angle_law == LINEAR_LAW.name
    if affordable_draws(len(model.orders), model.trigger_cycles,
                        1 if linear else number_of_places(spread)) < _ENOUGH:
        return _FEW_CYCLES
    few = float(_FEW_INDEPENDENT if linear else _FEW_BENT)
    for item in jitters:
        if isinstance(item, Empirical):
            few *= 1.0 + item.skewness**2
            if item.values <= _VALUES:
                few = max(few, _FEW_OF_VALUES)
    left = np.min(np.real(cycles.variance[0]) + np.abs(cycles.mean) ** 2)
    return int(min(max(few, _FEW_LEFT / max(left, 1e-9)), _MOST_FEW))


def few_cycles(cycles: CycleMoments, trigger_cycles: int, independent: int | None) -> bool:
    """
    Return whether an average holds too few cycles for a limit theorem, so that it is sampled.

    Cycles that remember each other count as fewer: as the variance of one over that of the average
    says. `independent` is how many are few if all errors are, None if they are not.
    """
    average = cycles.averaged(trigger_cycles)
    power = np.abs(cycles.mean) ** 2
    if np.all(average.variance <= _NOTHING * power):
        return False
    if trigger_cycles <= (independent or _FEW_CYCLES):
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


def _of_parts(each: Parts, gain: Array) -> Amplitudes:
    """Return amplitudes of scenarios of the same probability, without draws."""
    each = each.scaled(gain)
    moments = each.moments
    if len(moments.mean) == 1:
        whole = each.of(0)
        return Amplitudes(whole.moments, moments, whole, each)
    mean = moments.mean.mean(axis=0)
    spread = moments.mean - mean
    pooled = AverageMoments(mean, np.mean(moments.variance + np.abs(spread) ** 2, axis=0),
                            np.mean(moments.pseudo_variance + spread**2, axis=0))
    return Amplitudes(pooled, moments, Parts.about(gain, pooled), each)


def _with_errors(model: DeclaredModel, processes: Sequence[AngleErrorProcess], errors: Array,
                 gain: Array) -> tuple[Amplitudes, CycleMoments]:
    """Return curved amplitudes for known errors (scenario, n) in s, and moments without them."""
    count, orders = model.trigger_cycles, np.asarray(model.orders)
    each = scenario_moments(model, processes, errors)
    cycles = cycle_moments(orders, processes, nodes=_SCENARIO_NODES, lags=count)
    unmixed, mixed = average_cumulants(orders, processes, count, cycles)
    # A scenario turns the cycles' phasors apart: those of a triple are near each other.
    cubes = np.zeros((2, *each.mean.shape), complex)
    known = errors * model.fundamental_frequency
    for k, order in enumerate(orders):
        turn = np.exp(1j * np.pi * order * (known[:, 1:] + known[:, :-1])) * np.sinc(
            order * np.diff(known, axis=1))
        cubes[:, :, k] = np.mean(turn**3, axis=1), np.mean(turn * np.abs(turn) ** 2, axis=1)
    parts = Parts.about(1.0, each, unmixed * cubes[0], mixed * cubes[1])
    return _of_parts(parts, gain), cycles


def _with_draws(found: Amplitudes, model: DeclaredModel, processes: Sequence[AngleErrorProcess],
                gain: Array, errors: Array | None = None, *, apart: bool = False) -> Amplitudes:
    """Return the amplitudes with draws, in each scenario as many where they are kept `apart`."""
    cycles = None if errors is None else errors * model.fundamental_frequency
    known = None if apart or cycles is None else lambda n: cycles[
        (len(cycles) * (_GOLDEN * np.arange(n) % 1.0)).astype(int)]
    draws, noise = drawn_averages(model, processes, known=known, each=cycles if apart else None)
    return replace(found, draws=_grown(draws, gain), noise=noise)


def _drawn(model: DeclaredModel, processes: Sequence[AngleErrorProcess], gain: Array,
           influences: Sequence[tuple[Influence, Array]]) -> Amplitudes:
    """Return amplitudes of averages that are drawn, each with its scenario."""
    most = most_cycles(processes, len(model.orders))
    if model.trigger_cycles > most:
        names = ', '.join(item.name for item, _ in influences)
        raise ModelError(
            f'trigger_cycles is {model.trigger_cycles} with {len(model.orders)} orders: averages '
            f'under {names} are drawn one by one, of so many orders with at most {most} cycles; '
            'predict fewer cycles or fewer orders')

    def known(count: int) -> Array:
        total: Array = np.zeros(())
        rng = np.random.default_rng(_SEED)
        for item, every in influences:
            rows = item.drawn_scenarios(model, count)
            if rows is None:
                rows = every[rng.integers(len(every), size=count)]
            total = total + rows
        return total * model.fundamental_frequency

    draws, noise = drawn_averages(model, processes, known=known)
    moments = influences[0][0].exact_moments(model, processes) if len(influences) == 1 else None
    if moments is None:
        moments = moments_of(draws)
    found = _of_parts(Parts.about(1.0, moments.of(np.newaxis)), gain)
    return replace(found, draws=_grown(draws, gain), noise=noise)


def _grown(draws: Array, gain: Array) -> Array:
    """Return draws (order, ...) of R + j I of the component with its gain."""
    return np.asarray((draws.T * np.abs(gain)).T)


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
