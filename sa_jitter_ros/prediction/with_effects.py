"""
The prediction with effects: declared jitter, noise and any combination of effects at once.

Random effects multiply characteristic functions. Effects whose pulse errors are known up to one
number (the first mark of a target) are averaged over equally likely scenarios: their moments are
exact, the distribution of each is the curved one, sampled for few cycles. Where no few scenarios
hold all (lost pulses, the grid of a clock under a varying speed) averages are drawn, each with its
own scenario; moments are then exact for lost pulses alone, and those of the draws elsewhere.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.effects.effect import Effect, Pulses
from sa_jitter_ros.errors import ModelError
from sa_jitter_ros.prediction.amplitude_distribution import curved_distribution
from sa_jitter_ros.prediction.angle_error import (
    AngleErrorProcess, IndependentPulseJitter, joint_characteristic, unit_nodes)
from sa_jitter_ros.prediction.cumulants import average_cumulants
from sa_jitter_ros.prediction.moments import (
    AverageMoments, correlation_length, cycle_moments, noise_line_variance)
from sa_jitter_ros.prediction.prediction import (
    DeclaredModel, few_cycles, predict, Prediction, prediction_of)
from sa_jitter_ros.prediction.sampled_distribution import (
    can_be_sampled, drawn_averages, LONGEST, moments_of, MOST_PHASORS, sampled_distribution,
    SampledDistribution)

Array = NDArray[Any]

_COARSE, _FINE = unit_nodes(16), unit_nodes(32)
_CLEAR = 0.05  # mean phasor down to which the coarse rule is exact to 1e-6
_STEEP = 0.5  # fundamental cycles within a cycle: there a pulse is missing
_SCENARIOS = 256
_DRAWS, _FEWEST = 8192, 64  # values in all scenarios, in one
_SEED = 11
_FEW_CYCLES = 20  # with known errors: those of a pattern turn the cycles apart
_BLOCK = 1_000_000  # phasors held at once
_WORK = 20_000_000_000  # multiplications of phasors, about a second


@dataclass(frozen=True)
class _Setting:
    """What is predicted with scenarios; `gain` and `noise` (order,), E|n|^2."""

    model: DeclaredModel
    processes: tuple[AngleErrorProcess, ...]
    gain: Array
    noise: Array


def predict_with(model: DeclaredModel, effects: Sequence[Effect] = ()) -> Prediction:
    """
    Return the distribution of the amplitudes of unit components under declared model and effects.

    Raises ModelError for an effect that has no forward model with it.
    """
    require_modelled(model, effects)
    bare = model
    if any(effect.replaces_jitter(model) for effect in effects):
        bare = replace(model, jitter_distribution='table', jitter_table=(0.0,))
    processes = tuple(item for effect in effects for item in effect.processes(model))
    gain = np.prod([effect.gain(model) for effect in effects], axis=0) if effects else 1.0
    noise = sum((effect.line_variance(model) for effect in effects),
                start=np.zeros(len(model.orders)))
    known = [(effect, item) for effect, item in (
        (effect, effect.scenarios(model)) for effect in effects) if item is not None]
    if not known:
        prediction = predict(bare, processes=processes, gain=gain, line_variance=noise)
        return replace(prediction, model=model)
    if model.noise_std:
        noise = noise + noise_line_variance(model.noise_std, model.sample_rate, model.duration)
    setting = _Setting(model, jitter_processes(model, effects), np.asarray(gain), noise)
    if any(effect.drawn_scenarios(model, 1) is not None for effect, _ in known):
        return _drawn(setting, known)
    return _mixture(setting, _combined([scenarios for _, scenarios in known]))


def require_modelled(model: DeclaredModel, effects: Sequence[Effect]) -> None:
    """Raise ModelError where an effect has no forward model with the declared one."""
    for effect in effects:
        reason = effect.unmodelled(model)
        if reason:
            raise ModelError(f'{effect.name}: {reason}')


def jitter_processes(model: DeclaredModel, effects: Sequence[Effect]
                     ) -> tuple[AngleErrorProcess, ...]:
    """Return the random angle errors of declared jitter and effects; raise as `predict_with`."""
    require_modelled(model, effects)
    jitter: tuple[AngleErrorProcess, ...] = (
        IndependentPulseJitter(model.distribution, model.fundamental_frequency, model.weights),)
    if any(effect.replaces_jitter(model) for effect in effects):
        jitter = ()
    return (*jitter, *(item for effect in effects for item in effect.processes(model)))


def known_errors(model: DeclaredModel, effects: Sequence[Effect], pulses: Pulses
                 ) -> Array | None:
    """Return what effects know of the errors of `pulses` in s, None for nothing."""
    found = [item for item in (effect.pattern(model, pulses) for effect in effects)
             if item is not None]
    return np.asarray(np.sum(found, axis=0)) if found else None


def scenario_moments(
    model: DeclaredModel, processes: Sequence[AngleErrorProcess], errors: Array,
) -> AverageMoments:
    """
    Return the moments (scenario, order) of averages with known pulse `errors` (scenario, n).

    `errors` are in s, of the N_t + 1 pulses of the average or of all that its angle law reads (see
    `PulseWeights.path`); `processes` are random and independent of them. Exact but for cycles that
    hold a missing pulse, where the random errors count as if they did not vary inside the cycle.
    """
    g = np.asarray(model.orders)
    first = joint_characteristic(processes, [g[:, None]], [_FINE[0]], [0])
    cycles = model.weights.padded(np.asarray(errors) * model.fundamental_frequency,
                                  model.trigger_cycles)
    step = np.abs(np.diff(cycles, axis=1))
    turns = g.max() * np.max(step, initial=0.0, where=step < _STEEP)
    u, w = _COARSE if np.min(np.abs(first)) > _CLEAR and turns < 1.0 else _FINE
    first = joint_characteristic(processes, [g[:, None]], [u], [0]) * np.ones((g.size, 1))
    count = model.trigger_cycles
    reach = min(correlation_length(processes) + 1, count) if processes else 0
    joint = [_joint(processes, g, u, first, lag) for lag in range(reach)]
    shape = (len(cycles), g.size)
    mean, variance, pseudo = (np.zeros(shape, complex) for _ in range(3))
    rows = max(1, _BLOCK // (u.size * (min(count, _BLOCK // u.size) + reach)))
    length = max(1, _BLOCK // (u.size * rows))
    for row in range(0, len(cycles), rows):
        part = slice(row, row + rows)
        for begin in range(0, count, length):
            own = min(length, count - begin)
            held = min(own + max(reach - 1, 0), count - begin)
            pulses = cycles[part, begin:begin + held + model.weights.pulses - 1]
            path = model.weights.path(pulses, u, held)
            for i, order in enumerate(g):
                phasor = _phasors(model, order, pulses, path) * w
                mean[part, i] += (phasor[:, :own] @ first[i]).sum(axis=1) / count
                for lag, pairs in enumerate(joint):
                    here = min(own, held - lag)
                    scale = (1.0 if lag == 0 else 2.0) / count**2
                    early = phasor[:, :here].transpose(0, 2, 1)
                    late = phasor[:, lag:lag + here]
                    variance[part, i] += scale * np.einsum(
                        'suv,uv->s', early @ late.conj(), pairs[0][i])
                    pseudo[part, i] += scale * np.einsum('suv,uv->s', early @ late, pairs[1][i])
    return AverageMoments(mean, np.maximum(variance.real, 0.0), pseudo)


def _joint(processes: Sequence[AngleErrorProcess], g: Array, u: Array, first: Array, lag: int
           ) -> tuple[Array, Array]:
    """Return the covariances (order, u, v) of phasors `lag` apart, second conjugate or not."""
    plane, points = g[:, None, None], ([u[:, None], u], [0, lag])
    alone = first[:, :, None]
    return (joint_characteristic(processes, [plane, -plane], *points)
            - alone * first[:, None, :].conj(),
            joint_characteristic(processes, [plane, plane], *points) - alone * first[:, None, :])


def _phasors(model: DeclaredModel, order: float, pulses: Array, path: Array) -> Array:
    """Return exp(2 pi j g path), or its mean over a cycle of the linear law that turns far."""
    angle = 2.0 * np.pi * order * path
    phasor = np.empty(angle.shape, complex)
    np.cos(angle, out=phasor.real)
    np.sin(angle, out=phasor.imag)
    if model.angle_law == 'linear':
        step = np.diff(pulses, axis=1)
        steep = np.abs(step) > _STEEP
        if steep.any():
            turns = order * step[steep]
            closed = np.exp(2j * np.pi * order * pulses[:, :-1][steep] + 1j * np.pi * turns)
            phasor[steep] = (closed * np.sinc(turns))[:, None]
    return phasor


def _combined(known: Sequence[Array]) -> Array:
    """Return the sums of independent scenarios, all of them or as many as are worth their time."""
    total = known[0]
    for more in known[1:]:
        total = (total[:, None, :] + more[None, :, :]).reshape(-1, total.shape[1])
        if len(total) > _SCENARIOS:
            rows = np.random.default_rng(_SEED).permutation(len(total))[:_SCENARIOS]
            total = total[np.sort(rows)]
    return total


def _drawn(setting: _Setting, effects: Sequence[tuple[Effect, Array]]) -> Prediction:
    """Return the prediction from averages that are drawn, each with a scenario of its own."""
    model, processes = setting.model, setting.processes
    if not can_be_sampled(processes, model.trigger_cycles, len(model.orders)):
        names = ', '.join(effect.name for effect, _ in effects)
        raise ModelError(
            f'trigger_cycles is {model.trigger_cycles} with {len(model.orders)} orders: averages '
            f'under {names} are drawn one by one, of at most {LONGEST} cycles and {MOST_PHASORS} '
            'cycles times orders, less where slow motions come on top; predict fewer')

    def known(count: int) -> Array:
        total: Array = np.zeros(())
        for effect, every in effects:
            rows = effect.drawn_scenarios(model, count)
            if rows is None:
                rows = every[np.random.default_rng(_SEED).integers(len(every), size=count)]
            total = total + rows
        return total * model.fundamental_frequency

    draws = drawn_averages(model.orders, processes, model.trigger_cycles, gain=setting.gain,
                           line_variance=setting.noise, weights=model.weights, known=known)
    moments = effects[0][0].exact_moments(model, processes) if len(effects) == 1 else None
    moments = moments_of(draws) if moments is None else (
        moments.scaled(setting.gain).with_noise(setting.noise))
    return prediction_of(model, moments, SampledDistribution(
        np.sort(np.abs(draws), axis=1), moments.mean_square))


def _mixture(setting: _Setting, errors: Array) -> Prediction:
    """Return the prediction that gives each scenario the same probability."""
    model, processes, gain = setting.model, setting.processes, setting.gain
    count, orders = model.trigger_cycles, np.asarray(model.orders)
    errors = _affordable(model, processes, errors)
    each = scenario_moments(model, processes, errors).scaled(gain).with_noise(setting.noise)
    mean = each.mean.mean(axis=0)
    spread = each.mean - mean
    moments = AverageMoments(
        mean, np.mean(each.variance + np.abs(spread) ** 2, axis=0),
        np.mean(each.pseudo_variance + spread**2, axis=0))
    cycles = cycle_moments(orders, processes, nodes=_FINE[0].size, lags=count)
    equal, mixed = average_cumulants(orders, processes, count, cycles)
    # A scenario turns the cycles' phasors apart and shortens their sum, skewness included.
    left = each.mean / np.where(np.abs(cycles.mean) > 0.0, cycles.mean, 1.0)
    distribution = curved_distribution(_raveled(each), (equal * left**3).ravel(),
                                       (mixed * left * np.abs(left) ** 2).ravel())
    plain = all(isinstance(process, IndependentPulseJitter) for process in processes)
    few = count <= _FEW_CYCLES or few_cycles(cycles, count, plain, distribution.skew)
    if few and can_be_sampled(processes, count, orders.size):
        known = errors * model.fundamental_frequency
        return prediction_of(model, moments, sampled_distribution(
            orders, processes, count, moments, gain=gain, line_variance=setting.noise,
            weights=model.weights, known=lambda n: known[np.arange(n) % len(known)]))
    draws = distribution.spread(max(_FEWEST, _DRAWS // len(errors)))
    draws = np.moveaxis(draws.reshape(*each.mean.shape, -1), 1, 0).reshape(orders.size, -1)
    sampled = SampledDistribution(np.sort(draws, axis=1), moments.mean_square)
    amplitude = distribution.mean.reshape(each.mean.shape).mean(axis=0)
    variance = np.maximum(moments.mean_square - amplitude**2, 0.0)
    return replace(prediction_of(model, moments, sampled), mean_attenuation=amplitude,
                   variance=variance, standard_deviation=np.sqrt(variance))


def _affordable(model: DeclaredModel, processes: Sequence[AngleErrorProcess], errors: Array
                ) -> Array:
    """Return as many scenarios as take about a second, at least one; raise ModelError for none."""
    pairs = 2 * _FINE[0].size * (correlation_length(processes) + 1)
    each = len(model.orders) * _FINE[0].size * (25 + pairs)
    if each * model.trigger_cycles > _WORK:
        raise ModelError(
            f'trigger_cycles is {model.trigger_cycles} with {len(model.orders)} orders: with '
            f'known pulse errors at most {_WORK // each} cycles are worth their time; predict '
            'fewer cycles or fewer orders')
    kept = min(len(errors), max(1, _WORK // (each * model.trigger_cycles)))
    return errors[np.arange(kept) * len(errors) // kept]


def _raveled(each: AverageMoments) -> AverageMoments:
    return AverageMoments(each.mean.ravel(), each.variance.ravel(), each.pseudo_variance.ravel())
