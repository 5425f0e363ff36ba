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
Test whether recovered errors are pulse errors or a motion of the vibration relative to the pulses.

The recovery from the vibration cannot distinguish the two. But the measured pulse times are those
of a shaft that turns smoothly, plus the pulse errors: they contain recovered errors that are pulse
errors, and do not contain a motion of the source. Each frequency counts by how steady the shaft is
there. The pulse errors that earlier rounds explained are subtracted from both.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.effects.effect import Effect
from sa_jitter_ros.effects.evidence import Evidence
from scipy import stats
from scipy.linalg import toeplitz

Array = NDArray[Any]

_ROUNDS = 3
# Estimates at neighbouring frequencies through a Hann window are correlated by 2/3 and 1/6.
_REPEATS = 1.0 + 2.0 * (2.0 / 3.0) ** 2 + 2.0 * (1.0 / 6.0) ** 2
_NOTHING = 1e-12
_DECISIVE = 4.0  # standard errors between the two answers


@dataclass(frozen=True)
class SlopeTest:
    """
    Regression of the pulse times on the recovered errors.

    `share` of the errors beyond the declared ones is motion of the vibration: 0 if the pulse times
    contain all of them, 1 if they contain none. `p_value` is that of 0; `decided` says whether the
    shaft is steady enough to distinguish 0 from 1, `tach_side` that it is nearer to 0.
    """

    share: float
    standard_error: float
    p_value: float
    decided: bool
    tach_side: bool


def slope_test(evidence: Evidence) -> SlopeTest:
    """Regress the second differences of the pulse times on those of the recovered errors."""
    count = evidence.errors.shape[1]
    turns = np.outer(np.arange(1, count // 2), np.arange(count - 2)) / (count - 2)
    spectrum = np.exp(-2j * np.pi * turns) * np.hanning(count)[1:-1]
    errors = np.diff(evidence.errors, 2, axis=1) @ spectrum.T
    bends = np.diff(evidence.unexplained_times, 2, axis=1)
    if any(pulses.missing is not None and pulses.missing.any() for pulses in evidence.pulses):
        period = evidence.period
        bends = (bends + 0.5 * period) % period - 0.5 * period
    rows = spectrum @ np.diff(np.eye(count), 2, axis=0)

    def power(covariance: Array) -> Array:
        return np.asarray(np.sum((rows @ covariance) * rows.conj(), axis=1).real)

    observed = np.maximum(_smooth(np.mean(np.abs(errors) ** 2, axis=0)), 1e-300)
    lags = np.arange(count)
    moving = toeplitz(sum(
        (effect.pulse_autocovariance(evidence.model, lags) for effect in evidence.explained
         if isinstance(effect, Effect) and effect.pulse_times_correct), np.zeros(count)))
    declared = toeplitz(evidence.expected_autocovariance(lags)) - moving
    noise = np.diag(np.nan_to_num(np.mean(evidence.standard_errors**2, axis=0)))
    of_tach = np.clip(1.0 - power(moving + noise) / observed, 0.0, 1.0)
    of_vibration = np.minimum(power(declared) / observed, of_tach)
    return _share(bends @ spectrum.T - of_tach * errors, (of_vibration - of_tach) * errors,
                  observed * of_vibration**2)


def _share(remainder: Array, motion: Array, unsure: Array) -> SlopeTest:
    """
    Return the share of `motion` in `remainder` (acquisition, frequency).

    `unsure` (frequency,) is the uncertainty of the motion, as power.
    """
    share, information = 0.5, 0.0
    for _ in range(_ROUNDS):
        steadiness = np.maximum(_smooth(np.mean(np.abs(remainder - share * motion) ** 2, axis=0)
                                        ) + share**2 * unsure, 1e-300)
        information = float(np.sum(np.abs(motion) ** 2 / steadiness))
        share = float(np.sum((motion.conj() * remainder).real / steadiness)) / max(
            information, _NOTHING)
    error = float(np.sqrt(0.5 * _REPEATS / max(information, _NOTHING)))
    decided = 1.0 > _DECISIVE * error
    return SlopeTest(share, error, float(2.0 * stats.norm.sf(abs(share) / error)), decided,
                     decided and share < 0.5)


def _smooth(power: Array) -> Array:
    """Return the mean over three neighbouring frequencies."""
    wide = np.concatenate((power[:1], power, power[-1:]))
    return np.asarray((wide[:-2] + wide[1:-1] + wide[2:]) / 3.0)


def require_tach_side(evidence: Evidence) -> str:
    """Return the evidence that the vibration moves, '' if the errors are those of the pulses."""
    if evidence.against_reference:
        return ''
    test = slope_test(evidence.of_all)
    if test.decided and not test.tach_side:
        return ('the pulse times do not move with the recovered errors: the vibration makes '
                f'{test.share:.2f} +- {test.standard_error:.2f} of the motion')
    return ''
