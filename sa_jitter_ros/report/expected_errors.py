# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Pulse errors that a model expects, to compare with the recovered ones."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.effects.effect import Effect
from sa_jitter_ros.effects.evidence import Evidence
from sa_jitter_ros.prediction.angle_error import joint_characteristic
from sa_jitter_ros.prediction.influence import (
    declared_jitter, Influence, known_errors, random_processes)
from sa_jitter_ros.report.plotting import AFTER, BEFORE, with_effects
from scipy.linalg import toeplitz

_MOST_LAGS = 25
_SMALL = 1e-5  # s; sets the step at which the characteristic function gives a variance
_DRAWS, _SEED = 20_000, 3
# Effects that are not in the recovered errors: they concern gaps and samples, not pulse times.
_NOT_IN_ERRORS = ('missing_pulses', 'interpolation_loss')


@dataclass(frozen=True)
class Version:
    """
    The pulse errors that one model expects; times in s.

    `effects` are those that are visible in pulse errors. `autocovariance` (lag,) and `std` are
    those of errors whose mean is 0 in each acquisition, `draws` are random errors, `profile` (u,)
    is the RMS angle error over the trigger cycle, and `patterns` (acquisition, N_t + 1) is the
    deterministic part of each error.
    """

    label: str
    colour: str
    effects: tuple[Effect, ...]
    autocovariance: Array
    std: float
    draws: Array
    profile: Array
    patterns: Array


def versions_of(evidence: Evidence, effects: Sequence[Effect]) -> list[Version]:
    """Return the expectation of the declared model and, if effects were added, of both."""
    declared = evidence.explained
    found = [_version('declared model', BEFORE, evidence, declared)]
    if effects:
        label = with_effects([effect.name for effect in effects])
        found.append(_version(label, AFTER, evidence, (*declared, *effects)))
    return found


def with_explained_errors(evidence: Evidence) -> Evidence:
    """Return the evidence with the errors that the declared effects explain."""
    return replace(evidence, errors=evidence.errors + _patterns(evidence, evidence.explained))


def _patterns(evidence: Evidence, effects: Sequence[Influence]) -> Array:
    """Return the deterministic part (acquisition, N_t + 1) of the errors in s."""
    patterns = np.zeros(evidence.errors.shape)
    for row, pulses in zip(patterns, evidence.pulses):
        known = known_errors(evidence.model, _timing(effects), pulses)
        if known is not None:
            row += known - known.mean()
    return patterns


def _timing(effects: Sequence[Influence]) -> tuple[Effect, ...]:
    return tuple(effect for effect in effects if isinstance(effect, Effect)
                 and not effect.scatters and effect.name not in _NOT_IN_ERRORS)


def _version(label: str, colour: str, evidence: Evidence, effects: tuple[Influence, ...]
             ) -> Version:
    model = evidence.model
    count = evidence.errors.shape[1]
    patterns = _patterns(evidence, effects)
    random = replace(evidence, explained=effects).expected_autocovariance(np.arange(count))
    noise = _noise(evidence)
    covariance = toeplitz(random) + noise**2 * np.eye(count)
    centred = covariance - covariance.mean(axis=0) - covariance.mean(axis=1)[:, None]
    centred += covariance.mean() + patterns.T @ patterns / len(patterns)
    total = np.array([np.trace(centred, lag) / (count - lag) for lag in range(lags_of(evidence))])
    rng = np.random.default_rng(_SEED)
    jitter = declared_jitter(model, effects)
    rest = max(random[0] - (0.0 if jitter is None else jitter.variance), 0.0) + noise**2
    draws = np.zeros(_DRAWS) if jitter is None else jitter.draw(rng, _DRAWS)
    draws += np.sqrt(rest) * rng.standard_normal(_DRAWS)
    draws += rng.choice(patterns.ravel(), _DRAWS)
    u = cycle_places()
    small = 1e-2 / (max(np.sqrt(random[0]), _SMALL) * model.fundamental_frequency)
    processes = random_processes(model, effects)
    first = np.abs(joint_characteristic(processes, [small], [u], [0]))
    variance = -2.0 * np.log(first) / (2.0 * np.pi * small * model.fundamental_frequency) ** 2
    path = model.weights.path(patterns, u, model.trigger_cycles)
    profile = np.sqrt(np.maximum(variance, 0.0) + np.mean(path**2, axis=(0, 1)))
    return Version(label, colour, _timing(effects), total, float(np.sqrt(total[0])), draws,
                   profile, patterns)


def _noise(evidence: Evidence) -> float:
    """Return the mean standard error of the pulse errors, 0 where it is unknown."""
    known = evidence.standard_errors[np.isfinite(evidence.standard_errors)]
    return float(np.sqrt(np.mean(known**2))) if known.size else 0.0


def lags_of(evidence: Evidence) -> int:
    """Return the number of lags of the autocovariance to show."""
    return min(_MOST_LAGS + 1, int(evidence.errors.shape[1]) // 2 + 1)


def cycle_places() -> Array:
    """Return the positions u in a trigger cycle that are shown."""
    return np.linspace(0.0, 1.0, 41)
