"""
The prediction with effects: declared jitter, noise and any combination of effects in one law.

Random effects multiply characteristic functions. Effects whose pulse errors are known up to a few
numbers (the phase of a clock's grid, the first mark of a target) are averaged over equally likely
scenarios, each of which is exact.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.effects.effect import Effect, Pulses
from sa_jitter_ros.errors import ModelError
from sa_jitter_ros.statistics.amplitude_law import normal_law
from sa_jitter_ros.statistics.angle_error import (
    AngleErrorProcess, IndependentPulseJitter, joint_characteristic, unit_nodes)
from sa_jitter_ros.statistics.moments import (
    AverageMoments, correlation_length, noise_line_variance)
from sa_jitter_ros.statistics.prediction import DeclaredModel, predict, Prediction, QUANTILES
from sa_jitter_ros.statistics.sampled_law import SampledLaw

Array = NDArray[Any]

_RULE = unit_nodes(32)
_SCENARIOS = 256
_DRAWS = 40_000
_SEED = 11


def predict_with(model: DeclaredModel, effects: Sequence[Effect] = ()) -> Prediction:
    """
    Return the law of the amplitudes of unit components with the declared model and effects.

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
    known = [item for item in (effect.scenarios(model) for effect in effects) if item is not None]
    if not known:
        prediction = predict(bare, processes=processes, gain=gain, line_variance=noise)
        return replace(prediction, model=model)
    if model.noise_std:
        noise = noise + noise_line_variance(model.noise_std, model.sample_rate, model.duration)
    return _mixture(model, jitter_processes(model, effects), _combined(known), np.asarray(gain),
                    noise)


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
    u, w = _RULE
    cycles = np.asarray(errors) * model.fundamental_frequency
    path = model.weights.path(cycles, u, model.trigger_cycles)
    start, step = cycles[:, :-1, None], np.diff(cycles, axis=1)[:, :, None]
    shape = (g.size, len(cycles))
    mean, variance, pseudo = (np.zeros(shape, complex) for _ in range(3))
    count = path.shape[1]
    first = joint_characteristic(processes, [g[:, None]], [u], [0]) * np.ones((g.size, 1))
    steep = np.abs(step[:, :, 0]) > 0.5
    reach = min(correlation_length(processes) + 1, count) if processes else 0
    for i, order in enumerate(g):
        phasor = np.exp(2j * np.pi * order * path) * w
        if model.angle_law == 'linear' and steep.any():
            turns = order * step[steep]
            closed = np.exp(2j * np.pi * order * start[steep] + 1j * np.pi * turns)
            phasor[steep] = closed * np.sinc(turns) * w
        mean[i] = (phasor @ first[i]).mean(axis=1)
        for lag in range(reach):
            scale = (1.0 if lag == 0 else 2.0) / count**2
            early, late = phasor[:, :count - lag].transpose(0, 2, 1), phasor[:, lag:]
            points = ([u[:, None], u], [0, lag])
            joint = (joint_characteristic(processes, [order, -order], *points)
                     - np.multiply.outer(first[i], first[i].conj()))
            variance[i] += scale * np.einsum('suv,uv->s', early @ late.conj(), joint)
            joint = (joint_characteristic(processes, [order, order], *points)
                     - np.multiply.outer(first[i], first[i]))
            pseudo[i] += scale * np.einsum('suv,uv->s', early @ late, joint)
    return AverageMoments(mean.T, np.maximum(variance.real, 0.0).T, pseudo.T)


def _combined(known: Sequence[Array]) -> Array:
    """Return the sums of independent scenarios, all of them or as many as are worth their time."""
    total = known[0]
    for more in known[1:]:
        total = (total[:, None, :] + more[None, :, :]).reshape(-1, total.shape[1])
        if len(total) > _SCENARIOS:
            rows = np.random.default_rng(_SEED).permutation(len(total))[:_SCENARIOS]
            total = total[np.sort(rows)]
    return total


def _mixture(
    model: DeclaredModel, processes: Sequence[AngleErrorProcess], errors: Array, gain: Array,
    noise: Array,
) -> Prediction:
    """Return the prediction that gives each scenario the same probability."""
    each = scenario_moments(model, processes, errors).scaled(gain).with_noise(noise)
    mean = each.mean.mean(axis=0)
    spread = each.mean - mean
    moments = AverageMoments(
        mean, np.mean(each.variance + np.abs(spread) ** 2, axis=0),
        np.mean(each.pseudo_variance + spread**2, axis=0))
    draws = np.sort(_draws(each, max(1, _DRAWS // len(errors))), axis=1)
    law = SampledLaw(draws, moments.mean_square)
    quantiles = law.ppf(QUANTILES)
    flat = normal_law(AverageMoments(each.mean.ravel(), each.variance.ravel(),
                                     each.pseudo_variance.ravel()))
    amplitude = flat.mean.reshape(each.mean.shape).mean(axis=0)
    variance = np.maximum(moments.mean_square - amplitude**2, 0.0)
    return Prediction(
        model=model, order=np.asarray(model.orders), mean_attenuation=amplitude,
        variance=variance, standard_deviation=np.sqrt(variance), quantile_05=quantiles[:, 0],
        quantile_50=quantiles[:, 1], quantile_95=quantiles[:, 2], moments=moments, law=law)


def _draws(each: AverageMoments, count: int) -> Array:
    """Return amplitudes (order, scenario * count) of normal variables with these moments."""
    rng = np.random.default_rng(_SEED)
    turn = np.exp(0.5j * np.angle(-each.pseudo_variance))
    gap = np.abs(each.pseudo_variance)
    along = np.sqrt(np.maximum(0.5 * (each.variance - gap), 0.0))
    across = np.sqrt(0.5 * (each.variance + gap))
    z = rng.standard_normal((2, count, *each.mean.shape))
    amplitude = np.abs(each.mean + turn * (along * z[0] + 1j * across * z[1]))
    return np.asarray(np.moveaxis(amplitude, -1, 0).reshape(each.mean.shape[1], -1))
