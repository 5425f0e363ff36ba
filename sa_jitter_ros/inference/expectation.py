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
Expectation: what declared model and effects predict for every acquisition and line.

A line is one order on one channel. The prediction for an acquisition uses the errors of its pulses
that effects know (by the grid of a clock, the marks of a target, a gap). Orders leak into each
other with the amplitudes that the channel has.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from itertools import chain, product
import math

import numpy as np
from numpy.polynomial.legendre import legvander
from numpy.typing import NDArray
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.effects.correlated_jitter import CorrelatedJitter
from sa_jitter_ros.inference.cycle_reader import kept_apart
from sa_jitter_ros.inference.observation import Acquisition, Observation
from sa_jitter_ros.inference.order_band import BEYOND_LINES
from sa_jitter_ros.inference.residual import ACCURACY_OF_CHANGE
from sa_jitter_ros.prediction.amplitude_distribution import AmplitudeDistribution
from sa_jitter_ros.prediction.amplitudes import (
    Amplitudes, component_gain, known_amplitudes, line_variance, unit_amplitudes)
from sa_jitter_ros.prediction.angle_error import (
    AngleErrorProcess, IndependentPulseJitter, joint_characteristic, unit_nodes)
from sa_jitter_ros.prediction.distributions import Normal
from sa_jitter_ros.prediction.influence import (
    AveragePulses, Influence, known_errors, random_processes, without_gaps)
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.prediction.moments import correlation_length, cycle_moments
from sa_jitter_ros.prediction.sampled_distribution import COARSEST, SampledDistribution
from sa_jitter_ros.recordings.limits import IN_MEMORY_BYTES

Distribution = AmplitudeDistribution | SampledDistribution

#: Relative uncertainty of an amplitude that comes from resampling.
RESOLUTION = 5e-4
_NODES = 32  # of an integral over a cycle, and of each panel of a longer one
_PLACES = 12  # in a cycle, where errors turn hardly
# Draws of all lines of all acquisitions together: many, of each as many as tell a mean, at most.
_MANY_VALUES, _ENOUGH, _MOST_VALUES = 200_000, 4096, 1_000_000
_SHARPEST = 2.0


@dataclass(frozen=True)
class Lines:
    """The lines that are compared: rows of (channel, order index)."""

    channel: NDArray[np.intp]
    order: NDArray[np.intp]

    def of(self, values: Array) -> Array:
        """Return (..., line) of an array (..., channel, order)."""
        return np.asarray(values[..., self.channel, self.order])

    @property
    def count(self) -> int:
        """Return the number of lines."""
        return int(self.channel.size)


@dataclass(frozen=True)
class _Shown:
    """
    Predicted averages of unit components, one row for each line of an acquisition.

    `index` (row,) are places among all lines of all acquisitions, `order` indices of orders;
    `shift` is the mean of what leaks in and `scatter` its variance; `noise`, E|n|^2 in the unit of
    the vibration, is added to the sum. `scenario` (row,) is the acquisition's own where its pulses
    are known, None where they are not.
    """

    amplitudes: Amplitudes
    scenario: NDArray[np.intp] | None
    index: NDArray[np.intp]
    order: NDArray[np.intp]
    shift: Array
    scatter: Array
    noise: Array

    def distribution(self, rows: Array, noise: Array, most: int) -> Distribution:
        """Return the distribution of some rows with as much noise beside what leaks in."""
        order, shift = self.order[rows], self.shift[rows]
        noise = noise + self.scatter[rows]
        if self.scenario is None:
            return self.amplitudes.distribution(order, shift=shift, noise=noise, most=most)
        return self.amplitudes.distribution_in(self.scenario[rows], order, shift=shift,
                                               noise=noise)


class Memory:
    """Predictions by effects and acquisition, kept while they take little memory."""

    def __init__(self) -> None:
        """Begin with nothing."""
        self.shown: dict[tuple[tuple[Influence, ...], int], list[_Shown]] = {}
        #: Means and standard deviations of lines, by effects and acquisitions: they are small.
        self.predicted: dict[tuple[tuple[Influence, ...], tuple[int, ...]], tuple[Array, ...]] = {}
        self._bytes: dict[int, int] = {}  # of arrays, each counted once

    def make_room(self) -> None:
        """Drop all predictions if they take too much."""
        if sum(self._bytes.values()) > IN_MEMORY_BYTES:
            self.shown.clear()
            self._bytes.clear()

    def keep(self, key: tuple[tuple[Influence, ...], int], shown: list[_Shown]) -> None:
        """Keep what an acquisition shows."""
        self.shown[key] = shown
        self._bytes |= {id(value): value.nbytes for item in shown for value in (
            *vars(item).values(), item.amplitudes.draws) if isinstance(value, np.ndarray)}


@dataclass(frozen=True)
class Expectation:
    """
    Predicted distributions of the lines, arrays (acquisition, line).

    `attenuation` and `attenuation_variance` are those of raw over corrected amplitude, without
    noise, and without gains, which both have (`ungained`); `amplitude` and `amplitude_variance`
    those of the raw amplitude over its level, noise, gains and unsteadiness included, of which
    `cdf` is the distribution function.
    """

    shown: tuple[_Shown, ...] = field(repr=False)
    ungained: tuple[_Shown, ...] = field(repr=False)
    noise: Array

    @cached_property
    def attenuation(self) -> Array:
        """Return E|X|."""
        return self._gathered(self.ungained, self._bare, 'mean')

    @cached_property
    def attenuation_variance(self) -> Array:
        """Return Var|X| plus the variance that comes from resampling."""
        return self._gathered(self.ungained, self._bare, 'variance') + RESOLUTION**2

    @cached_property
    def amplitude(self) -> Array:
        """Return E|X + n|."""
        return self._gathered(self.shown, self._full, 'mean')

    @cached_property
    def amplitude_variance(self) -> Array:
        """Return Var|X + n|."""
        return self._gathered(self.shown, self._full, 'variance')

    def cdf(self, amplitude: Array) -> Array:
        """Return P(|X + n| <= amplitude) for an amplitude (acquisition, line) each."""
        values = np.empty(self.noise.size)
        for item, distribution in zip(self.shown, self._full):
            values[item.index] = distribution.cdf(amplitude.ravel()[item.index][:, None])[:, 0]
        return values.reshape(self.noise.shape)

    def mean_cdf(self, acquisitions: Sequence[int], line: int, amplitude: Array) -> Array:
        """Return the mean of P(|X + n| <= amplitude) (k,) over some acquisitions."""
        places = np.asarray(acquisitions) * self.noise.shape[1] + line
        total = np.zeros(len(amplitude))
        for item in self.shown:
            rows = np.flatnonzero(np.isin(item.index, places))
            if rows.size:
                noise = self.noise.ravel()[item.index[rows]]
                total += item.distribution(rows, noise, self._most).cdf(amplitude).sum(axis=0)
        return total / len(places)

    @cached_property
    def _bare(self) -> list[Distribution]:
        return self._distributions(self.ungained, np.zeros(self.noise.size))

    @cached_property
    def _full(self) -> list[Distribution]:
        return self._distributions(self.shown, self.noise.ravel())

    def _distributions(self, shown: Sequence[_Shown], noise: Array) -> list[Distribution]:
        return [item.distribution(np.arange(item.index.size), noise[item.index], self._most)
                for item in shown]

    @property
    def _most(self) -> int:
        size = self.noise.size
        return max(COARSEST, min(max(_ENOUGH, _MANY_VALUES // size), _MOST_VALUES // size))

    def _gathered(self, shown: Sequence[_Shown], distributions: Sequence[Distribution], name: str
                  ) -> Array:
        values = np.empty(self.noise.size)
        for item, distribution in zip(shown, distributions):
            values[item.index] = getattr(distribution, name)
        return values.reshape(self.noise.shape)


def expect(observation: Observation, lines: Lines, level: Array, effects: Sequence[Influence],
           pulses: Sequence[Sequence[AveragePulses]], group: Array, chosen: Sequence[int], *,
           unsteadiness: float | Array = 0.0, memory: Memory | None = None) -> Expectation:
    """
    Predict the `chosen` acquisitions, each at its own speed.

    `level` (line,) are mean amplitudes, to which noise is relative; `pulses[a][i]` are the pulses
    of acquisition a with their known errors, for the channels whose `group` (channel,) is i;
    `unsteadiness`, one or (line,), is the unexplained scatter relative to the level. `memory`
    keeps results for calls that differ in `effects`, `chosen` and `unsteadiness` only.
    """
    memory = Memory() if memory is None else memory
    memory.make_room()
    key = tuple(effects)
    alike: dict[float, list[int]] = {}
    for a in chosen:
        if (key, a) not in memory.shown:
            speed = _speed(observation.acquisitions[a], observation.model)
            alike.setdefault(speed, []).append(a)
    for speed, some in alike.items():
        model = replace(observation.model, trigger_speed=speed)
        setting = _Setting(replace(observation, model=model), effects,
                           random_processes(model, effects), component_gain(model, effects),
                           line_variance(model, effects))
        found = iter(setting.shown([item for a in some for item in pulses[a]]))
        for a in some:
            memory.keep((key, a), [
                _of_lines(observation.acquisitions[a], lines, next(found), group == i, setting)
                for i, _ in enumerate(pulses[a])])

    shown = _together([[replace(item, index=item.index + n * lines.count)
                        for item in memory.shown[key, a]] for n, a in enumerate(chosen)])
    noise = np.zeros(len(chosen) * lines.count)
    for item in shown:
        noise[item.index] = item.noise
    own = 2.0 * (unsteadiness**2 + RESOLUTION**2)  # half of it along the radius
    steady = [item for item in effects if not any(
        hasattr(process, 'draw_gain') for process in item.processes(observation.model))]
    ungained = shown if len(steady) == len(effects) else expect(
        observation, lines, level, steady, pulses, group, chosen, memory=memory).shown
    return Expectation(shown, ungained, noise.reshape(len(chosen), -1) / level**2 + own)


def _together(rows: Sequence[Sequence[_Shown]]) -> tuple[_Shown, ...]:
    """Return what is shown by the same amplitudes in one."""
    alike: dict[tuple[int, bool], list[_Shown]] = {}
    for item in chain.from_iterable(rows):
        alike.setdefault((id(item.amplitudes), item.scenario is None), []).append(item)
    found = []
    for items in alike.values():
        own = [item.scenario for item in items if item.scenario is not None]
        index, order, shift, scatter, noise = (
            np.concatenate([getattr(item, name) for item in items])
            for name in ('index', 'order', 'shift', 'scatter', 'noise'))
        found.append(_Shown(items[0].amplitudes, np.concatenate(own) if own else None, index,
                            order, shift, scatter, noise))
    return tuple(found)


@dataclass(frozen=True)
class _Source:
    """Amplitudes of unit components, their scenario, and what is added to each order."""

    amplitudes: Amplitudes
    scenario: int | None
    leakage: Array  # (order, source)
    shift: Array  # (order,)


@dataclass(frozen=True)
class _Setting:
    """What is predicted at one speed; `gain` and `noise` (order,), E|n|^2 of peak amplitudes."""

    observation: Observation
    effects: Sequence[Influence]
    processes: tuple[AngleErrorProcess, ...]
    gain: Array
    noise: Array

    def shown(self, pulses: Sequence[AveragePulses]) -> list[_Source]:
        """Return the predicted amplitudes and leakage of unit components, for all `pulses`."""
        known = [self._of_corrected(item) for item in pulses]
        found: dict[int, _Source] = {}
        alike: dict[tuple[float, ...], list[int]] = {}
        for i, (item, errors) in enumerate(zip(pulses, known)):
            if errors is None:
                found[i] = self._of_unknown_pulses
            else:
                alike.setdefault((len(errors), item.error_std, item.unknown_std,
                                  item.unknown_correlation), []).append(i)
        for some in alike.values():
            rows = self._of_known_pulses(np.array([known[i] for i in some]), pulses[some[0]])
            found.update(zip(some, rows))
        return [found[i] for i in range(len(pulses))]

    def _of_corrected(self, item: AveragePulses) -> Array | None:
        """
        Return the known errors of an acquisition, as if its corrected pulses were right.

        These are as late as the measured ones in the mean, apart from gaps: a delay turns an order
        against those that leak into it.
        """
        model = self.observation.model
        errors = known_errors(model, self.effects, item)
        if errors is None:
            return None
        own = slice(model.weights.before, len(errors) - model.weights.after)
        return np.asarray(errors - without_gaps(errors, item.missing, item.times)[own].mean())

    def _of_known_pulses(self, errors: Array, like: AveragePulses) -> list[_Source]:
        """Return what is predicted with known `errors` (acquisition, pulse), unsure alike."""
        model = self.observation.model
        blur, unsure = 0.0, self.processes
        if any(effect.replaces_jitter(model) for effect in self.effects):
            blur = like.error_std * model.fundamental_frequency
            if like.unknown_std:
                unsure = (*unsure, *CorrelatedJitter(
                    like.unknown_std, like.unknown_correlation).processes(model))
        doubt = IndependentPulseJitter(Normal(blur), weights=model.weights)
        unsure = (*unsure, doubt) if blur else unsure
        amplitudes = known_amplitudes(model, unsure, errors, gain=self.gain)
        leakage = _leakage(self.observation, unsure, errors)
        shift = np.zeros_like(amplitudes.each.mean)
        if blur:
            shift = amplitudes.each.mean * (_sharpening(self.observation.orders, doubt) - 1.0)
            leakage = leakage * np.resize(_sharpening(self.observation.sources, doubt),
                                          leakage.shape[2])
        return [_Source(amplitudes, i, *row) for i, row in enumerate(zip(leakage, shift))]

    @cached_property
    def scatter(self) -> Array:
        """Return the variance (order, source) of leakage from each unit source to each order."""
        return _scatter(self.observation, self.processes)

    @cached_property
    def _of_unknown_pulses(self) -> _Source:
        """Return what is predicted if nothing is known of the pulses: as `predict` does."""
        model = self.observation.model
        none = np.zeros((1, model.trigger_cycles + 1))
        return _Source(unit_amplitudes(model, self.effects), None, _leakage(
            self.observation, self.processes, none)[0], np.zeros(len(model.orders)))


def _speed(item: Acquisition, model: DeclaredModel) -> float:
    """
    Return the speed of an acquisition in Hz, that of the record unless it differs.

    It is exact if pulses are missing: a gap turns the average by whole trigger cycles, which
    multiplies an error of the speed.
    """
    ratio = model.trigger_period / item.period
    if item.missing.any():
        return float(model.trigger_speed * ratio)
    # no amplitude changes by more between speeds as near as that
    step = ACCURACY_OF_CHANGE
    return float(model.trigger_speed * (1.0 + step * np.rint((ratio - 1.0) / step)))


def _sharpening(orders: Array, doubt: IndependentPulseJitter) -> Array:
    """
    Return the factor that corrects moments for the uncertainty `doubt` of the known errors.

    Uncertain errors scatter more than the true ones, so that they attenuate too much; the
    uncertainty itself attenuates once more. The factor is at most two.
    """
    mean = np.abs(cycle_moments(orders, [doubt], nodes=_NODES, lags=0).mean)
    return np.asarray(1.0 / np.maximum(mean**2, 1.0 / _SHARPEST))


@lru_cache(maxsize=8)
def _nodes(count: int) -> tuple[Array, Array]:
    """Return at least so many nodes in [0, 1], and their weights."""
    panels = math.ceil(count / _NODES)
    u, w = unit_nodes(_NODES)
    return ((np.arange(panels)[:, None] + u).ravel() / panels, np.tile(w / panels, panels))


def _leakage(observation: Observation, processes: Sequence[AngleErrorProcess], errors: Array
             ) -> Array:
    """
    Return the mean amplitude (acquisition, order, source) of each unit source at each order.

    `errors` (acquisition, pulse) in s. Sources that are no lines of the trigger cycle have their
    mirror images after them.
    """
    model, sources = observation.model, observation.sources
    r, count = model.cycle_length, model.trigger_cycles
    if not kept_apart(r, sources):
        sources = np.concatenate((sources, -sources))
    e = errors * model.fundamental_frequency
    turns = r * np.ptp(np.append(sources, observation.orders)) + float(
        np.ptp(np.diff(e), axis=1).max()) * sources.max()
    u, w = _nodes(math.ceil(_NODES + 2.0 * np.pi * turns))  # a wave takes half as many
    # errors turn a wave by little within a cycle: a polynomial through few places is exact
    degree = min(model.weights.pulses - 1, 3)  # of what a law makes of the errors
    path = model.weights.path(e, np.linspace(0.0, 1.0, _PLACES), count)  # (acquisition, cycle, u)
    most = 2.0 * np.pi * sources.max() * np.abs(path - path[..., :1]).max(axis=2)
    few = _few(degree, most)
    tried, counts = np.unique(few, return_counts=True)
    served = np.cumsum(counts)
    least = int(tried[np.argmin(  # work of the waves, and of the matrix that gathers them
        sources.size * (tried * served + u.size * (few.size - served)) + tried * u.size)])
    calm = few <= least
    places, gathered = _few_places(u, least)
    turn = 2j * np.pi * r
    first = joint_characteristic(processes, [sources[:, None]], [u], [0]) * w
    first = first * np.exp(turn * sources[:, None] * u)
    back = np.exp(-turn * observation.orders * u[:, None])
    whole = first[..., None] * back  # (source, u, order)
    ways = (calm, places, gathered @ whole), (~calm, u, whole)
    between = np.exp(turn * (sources[:, None, None] - observation.orders)
                     * np.arange(count)[:, None])  # (source, cycle, order)
    table = np.zeros((len(e), observation.orders.size, sources.size), complex)
    for (a, row), (here, nodes, inside) in product(enumerate(e), ways):
        if here[a].any():
            offset = model.weights.path(row, nodes, count)[here[a]]
            for s, source in enumerate(sources):
                table[a, :, s] += np.sum(np.exp(2j * np.pi * source * offset) @ inside[s]
                                         * between[s, here[a]], axis=0)
    return table / count


def _few(degree: int, turn: Array) -> NDArray[np.int64]:
    """Return where the Legendre series of waves ends that a polynomial turns by up to `turn`."""
    return np.asarray(np.ceil(degree * (_PLACES + 2.0 * turn)), np.int64)


def _few_places(u: Array, count: int) -> tuple[Array, Array]:
    """Return `count` places in a cycle, and the matrix (place, u) of the polynomial there."""
    places, weights = unit_nodes(count)
    series = legvander(2.0 * places - 1.0, count - 1) * weights[:, None]
    series *= 2.0 * np.arange(count) + 1.0
    return places, np.asarray(series @ legvander(2.0 * u - 1.0, count - 1).T)


def _scatter(observation: Observation, processes: Sequence[AngleErrorProcess]) -> Array:
    """
    Return the variance (order, source) of what random errors leak from a unit source.

    Sources leak with phases of their own, so that their variances add. The order itself, and what
    is so many lines of the trigger cycle away that hardly anything leaks, has none.
    """
    model, sources = observation.model, observation.sources
    r, count = model.cycle_length, model.trigger_cycles
    if not kept_apart(r, sources):
        sources = np.concatenate((sources, -sources))
    turns = r * (sources[:, None] - observation.orders)
    u, w = unit_nodes(_NODES // 2)  # few turns within the cycle
    waves = np.exp(2j * np.pi * turns[..., None] * u) * w  # (source, order, u)
    each = sources[:, None, None]
    first = joint_characteristic(processes, [sources[:, None]], [u], [0])
    both = first[:, :, None] * first.conj()[:, None]
    found = np.zeros(turns.shape)
    for lag in range(min(correlation_length(processes) + 1, count)):
        joint = joint_characteristic(processes, [each, -each], [u[:, None], u], [0, lag]) - both
        pair = np.sum((waves @ joint) * waves.conj(), axis=-1) * np.exp(-2j * np.pi * turns * lag)
        found += (1.0 if lag == 0 else 2.0) * (count - lag) / count**2 * pair.real
    found[(np.abs(turns) >= BEYOND_LINES) | (sources[:, None] == observation.orders)] = 0.0
    return np.asarray(np.maximum(found.T, 0.0))


def _of_lines(item: Acquisition, lines: Lines, source: _Source, channels: Array,
              setting: _Setting) -> _Shown:
    """Return what an acquisition shows on the lines of some `channels` (channel,), a mask."""
    amplitude, leakage = item.corrected, source.leakage
    if leakage.shape[1] > amplitude.shape[1]:
        amplitude = np.concatenate((amplitude, amplitude.conj()), axis=1)
    foreign = leakage - np.where(np.eye(*leakage.shape, dtype=np.bool_), leakage, 0.0)
    with np.errstate(divide='ignore', invalid='ignore'):
        extra = (amplitude @ foreign.T) / amplitude[:, :len(leakage)]
    extra = np.where(np.isfinite(extra), extra, 0.0)
    here = np.flatnonzero(channels[lines.channel])
    order = lines.order[here]
    channel = lines.channel[here]
    shift = source.shift[order] + setting.gain[order] * extra[channel, order]
    with np.errstate(divide='ignore', invalid='ignore'):
        share = np.abs(amplitude[channel]) / np.abs(amplitude[channel, order])[:, None]
    share[~np.isfinite(share)] = 0.0
    scatter = np.sum(share**2 * setting.scatter[order], axis=1)
    scenario = None if source.scenario is None else np.full(here.size, source.scenario)
    return _Shown(source.amplitudes, scenario, here, order, shift, scatter, setting.noise[order])
