"""
Expectation: what declared model and effects predict for every acquisition and line.

A line is one order on one channel. What effects know of an acquisition's own pulses (the grid of a
clock, the marks of a target, a gap) enters the prediction of that acquisition; orders leak into
each other with the amplitudes that the channel has.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.effects.correlated_jitter import CorrelatedJitter
from sa_jitter_ros.effects.effect import Effect
from sa_jitter_ros.inference.cycle_reader import kept_apart
from sa_jitter_ros.inference.observation import Acquisition, Observation
from sa_jitter_ros.prediction.amplitude_distribution import (
    AmplitudeDistribution, normal_distribution)
from sa_jitter_ros.prediction.amplitudes import component_gain, line_variance
from sa_jitter_ros.prediction.angle_error import (
    AngleErrorProcess, GaussianAngleError, IndependentPulseJitter, joint_characteristic,
    unit_nodes)
from sa_jitter_ros.prediction.distributions import Normal
from sa_jitter_ros.prediction.influence import known_errors, mean_period, Pulses, random_processes
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.prediction.moments import AverageMoments, cycle_moments
from sa_jitter_ros.prediction.scenario_moments import scenario_moments

Array = NDArray[Any]

#: What was predicted for effects and an acquisition: moments and noise (line,).
Memory = dict[tuple[tuple[Effect, ...], int], tuple[AverageMoments, Array]]

#: What resampling leaves of uncertainty in an amplitude, in parts of it.
RESOLUTION = 5e-4
_NODES, _MOST_NODES = 32, 800
_MOST_KEPT = 20_000  # acquisitions, of a few kB each
# Speeds closer than this are the same.
_SPEED_STEP = 1e-3
_SHARPEST = 2.0
_LEAST = 1e-300


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
class Expectation:
    """
    Predicted distributions of the lines, arrays (acquisition, line).

    `attenuation` and `attenuation_variance` are those of raw over corrected amplitude, without
    noise; `amplitude` and `amplitude_variance` those of the raw amplitude over its level, noise
    and unsteadiness included, of which `distribution` (flattened) is the distribution.
    """

    attenuation: Array
    attenuation_variance: Array
    amplitude: Array
    amplitude_variance: Array
    distribution: AmplitudeDistribution


def expect(observation: Observation, lines: Lines, level: Array, effects: Sequence[Effect],
           pulses: Sequence[Sequence[Pulses]], group: Array, chosen: Sequence[int], *,
           unsteadiness: float = 0.0, memory: Memory | None = None) -> Expectation:
    """
    Predict the `chosen` acquisitions, each at its own speed.

    `level` (line,) are mean amplitudes, which noise is compared with; `pulses[a][i]` is what is
    known of the pulses of acquisition a for the channels whose `group` (channel,) is i;
    `unsteadiness` is what the amplitudes scatter by themselves, in parts of the level. `memory`
    keeps what was computed, for calls that differ in `effects`, `chosen` and `unsteadiness` only.
    """
    memory = {} if memory is None else memory
    if len(memory) > _MOST_KEPT:
        memory.clear()
    key = tuple(effects)
    alike: dict[float, list[int]] = {}
    for a in chosen:
        if (key, a) not in memory:
            speed = _speed(observation.acquisitions[a], observation.model)
            alike.setdefault(speed, []).append(a)
    for speed, some in alike.items():
        setting = _setting(observation, speed, effects)
        found = iter(setting.moments([item for a in some for item in pulses[a]]))
        for a in some:
            each = _of_lines(observation.acquisitions[a], lines, [next(found) for _ in pulses[a]],
                             group)
            memory[key, a] = each.scaled(setting.gain[lines.order]), setting.noise[lines.order]
    rows = [memory[key, a] for a in chosen]
    moments = AverageMoments(*(np.concatenate([getattr(each, name) for each, _ in rows])
                               for name in ('mean', 'variance', 'pseudo_variance')))
    noise = np.array([noise for _, noise in rows]) / level**2
    own = 2.0 * (unsteadiness**2 + RESOLUTION**2)  # half of it along the radius
    bare = normal_distribution(moments)
    full = normal_distribution(moments.with_noise((noise + own).ravel()))
    shape = noise.shape
    return Expectation(bare.mean.reshape(shape), bare.variance.reshape(shape) + RESOLUTION**2,
                       full.mean.reshape(shape), full.variance.reshape(shape), full)


@dataclass(frozen=True)
class _Setting:
    """What is predicted at one speed; `gain` and `noise` (order,), E|n|^2 of peak amplitudes."""

    observation: Observation
    effects: Sequence[Effect]
    processes: tuple[AngleErrorProcess, ...]
    gain: Array
    noise: Array

    def moments(self, pulses: Sequence[Pulses]) -> list[tuple[AverageMoments, Array]]:
        """Return what unit components show of themselves and (order, source) of each other."""
        known = [known_errors(self.observation.model, self.effects, item) for item in pulses]
        found: dict[int, tuple[AverageMoments, Array]] = {}
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

    def _of_known_pulses(self, errors: Array, like: Pulses) -> list[tuple[AverageMoments, Array]]:
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
        each = _aligned(scenario_moments(model, unsure, errors), model, unsure)
        leakage = _leakage(self.observation, unsure, errors)
        mean = each.mean
        if blur:
            mean = mean * _sharpening(self.observation.orders, doubt)
            leakage = leakage * np.resize(_sharpening(self.observation.sources, doubt),
                                          leakage.shape[2])
        return [(AverageMoments(*row), leaks) for *row, leaks in zip(
            mean, each.variance, each.pseudo_variance, leakage)]

    @cached_property
    def _of_unknown_pulses(self) -> tuple[AverageMoments, Array]:
        """What is predicted where nothing is known of the pulses."""
        none = np.zeros((1, self.observation.model.trigger_cycles + 1))
        return (_unknown(self.observation, self.effects, self.processes),
                _leakage(self.observation, self.processes, none)[0])


def _setting(observation: Observation, speed: float, effects: Sequence[Effect]) -> _Setting:
    model = replace(observation.model, trigger_speed=speed)
    return _Setting(replace(observation, model=model), effects, random_processes(model, effects),
                    component_gain(model, effects), line_variance(model, effects))


def _speed(item: Acquisition, model: DeclaredModel) -> float:
    """
    Return the speed of an acquisition in Hz, that of the record unless it differs.

    It is exact where pulses lack: a gap turns the average by whole trigger cycles, and what the
    speed were off by would count as often as the order has periods in them.
    """
    ratio = model.trigger_period / mean_period(item.times, item.missing)
    if item.missing.any():
        return float(model.trigger_speed * ratio)
    return float(model.trigger_speed * (1.0 + _SPEED_STEP * np.rint((ratio - 1.0) / _SPEED_STEP)))


def _sharpening(orders: Array, doubt: IndependentPulseJitter) -> Array:
    """
    Return the factor on moments that allow for being unsure by the jitter `doubt`.

    Errors that are off scatter more than the true ones, so that they attenuate too much already;
    allowing for being unsure attenuates once more. Two-fold at most: beyond, nothing is known.
    """
    mean = np.abs(cycle_moments(orders, [doubt], nodes=_NODES, lags=0).mean)
    return np.asarray(np.minimum(mean**-2.0, _SHARPEST))


@lru_cache(maxsize=8)
def _nodes(count: int) -> tuple[Array, Array]:
    return unit_nodes(count)


def _unknown(observation: Observation, effects: Sequence[Effect],
             processes: Sequence[AngleErrorProcess]) -> AverageMoments:
    """Return the moments (order,) where nothing is known of the pulses of one acquisition."""
    model = observation.model
    known = [item for item in (effect.scenarios(model) for effect in effects) if item is not None]
    if known:
        each = scenario_moments(model, processes, known[0])
        mean = each.mean.mean(axis=0)
        spread = each.mean - mean
        size = np.mean(np.abs(each.mean), axis=0)  # the phase of an average does not count
        variance = np.mean(each.variance + np.abs(spread) ** 2, axis=0) + np.abs(mean)**2 - size**2
        return AverageMoments(size.astype(complex), np.maximum(variance, 0.0),
                              np.mean(each.pseudo_variance, axis=0))
    moments = cycle_moments(model.orders, processes, nodes=_NODES)
    return _aligned(moments.averaged(model.trigger_cycles), model, processes)


def _aligned(moments: AverageMoments, model: DeclaredModel,
             processes: Sequence[AngleErrorProcess]) -> AverageMoments:
    """
    Return the moments (..., order) of averages that are turned back by their mean angle error.

    The amplitude does not know that angle, which slow errors turn a whole average by; the
    distribution of the amplitude is near the normal one only without it. E|X|^2 stays as it is.
    """
    count, (u, w) = model.trigger_cycles, _nodes(_NODES)
    common = 0.0
    for process in processes:
        if isinstance(process, GaussianAngleError):
            within = [w @ process.covariance(u[:, None], u, lag) @ w
                      for lag in range(min(process.correlation_length, count - 1) + 1)]
            share = (1.0 - np.arange(len(within)) / count) * np.where(
                np.arange(len(within)) > 0, 2.0, 1.0)
            common += float(share @ within) / count
    turn = np.exp((2.0 * np.pi * np.asarray(model.orders)) ** 2 * common)
    square = (moments.pseudo_variance + moments.mean**2) * turn**2
    mean = moments.mean * np.minimum(np.sqrt(turn), np.sqrt(moments.mean_square) / np.maximum(
        np.abs(moments.mean), _LEAST))
    variance = np.maximum(moments.mean_square - np.abs(mean) ** 2, 0.0)
    pseudo = square - mean**2
    most = variance / np.maximum(np.abs(pseudo), _LEAST)
    return AverageMoments(mean, variance, pseudo * np.minimum(most, 1.0))


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
    u, w = _nodes(int(min(_NODES + 3.5 * turns, _MOST_NODES)))
    offset = model.weights.path(e, u, count)
    cycle = np.arange(count)[:, None]
    table = np.zeros((len(e), observation.orders.size, sources.size), complex)
    for s, source in enumerate(sources):
        first = joint_characteristic(processes, [np.array([source])], [u], [0]) * w
        shift = 2j * np.pi * r * (source - observation.orders)
        inside, between = np.exp(shift * u[:, None]) * first[:, None], np.exp(shift * cycle)
        for a, row in enumerate(offset):
            wave = np.exp(2j * np.pi * source * row)
            table[a, :, s] = np.mean((wave @ inside) * between, axis=0)
    return table


def _of_lines(item: Acquisition, lines: Lines, rows: Sequence[tuple[AverageMoments, Array]],
              group: Array) -> AverageMoments:
    """Return the moments (line,) of unit components, with leakage."""
    mean = np.zeros(lines.count, complex)
    variance = np.zeros(lines.count)
    pseudo = np.zeros(lines.count, complex)
    for i, (moments, leakage) in enumerate(rows):
        amplitude = item.corrected
        if leakage.shape[1] > amplitude.shape[1]:
            amplitude = np.concatenate((amplitude, amplitude.conj()), axis=1)
        own = leakage.shape[0]
        foreign = leakage - np.where(np.eye(*leakage.shape, dtype=np.bool_), leakage, 0.0)
        with np.errstate(divide='ignore', invalid='ignore'):
            extra = (amplitude @ foreign.T) / amplitude[:, :own]
        extra = np.where(np.isfinite(extra), extra, 0.0)
        here = np.flatnonzero(group[lines.channel] == i)
        channel, order = lines.channel[here], lines.order[here]
        mean[here] = moments.mean[order] + extra[channel, order]
        variance[here] = moments.variance[order]
        pseudo[here] = moments.pseudo_variance[order]
    return AverageMoments(mean, variance, pseudo)
