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
Residual: observed minus predicted, with the predicted standard deviation as its scale.

The mean residual is that of the attenuation; the distribution that of the raw amplitude over its
level, which noise and modulation change as well. Lines of an acquisition share its pulses, so
significance counts acquisitions, two neighbours as one block, and keeps the lines together.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from sa_jitter_ros.arrays import Array
from scipy import special

#: Accuracy of a predicted attenuation: smaller residuals do not change the verdict.
ACCURACY = 3e-3
#: Change of an average from which on it matters what else may be there.
NOTICEABLE = 1e-2
#: Accuracy of the difference of two predictions for the same lines at the same speed.
ACCURACY_OF_CHANGE = 1e-3
#: Chance of one kind of false alarm: that something is left where the model is right.
FALSE_ALARM = 0.005
#: Draws that stand for a distribution: 20 of them are beyond what `FALSE_ALARM` lets pass.
DRAWS = 4000
_SEED = 17
_NAN = float('nan')


@dataclass(frozen=True)
class Sensitivity:
    """
    Change of the prediction by one standard error of a fitted parameter.

    `mean` (line,) is that of the attenuation; `variance` (of the attenuation) and
    `amplitude_variance` are relative changes.
    """

    mean: Array
    variance: float
    amplitude_variance: float


@dataclass(frozen=True)
class Residual:
    """
    Summary of a residual; `mean` and `standard_error` are per line.

    `rms` is the root mean square over lines of the mean residual, `rms_standard_error` the part of
    it that standard errors contribute (in quadrature). Of this, `rms_parameter_error` comes from
    the uncertainty of fitted parameters, the rest from the scatter of the acquisitions.
    `chi2_per_dof`, `ks`,
    `cramer_von_mises` and `coverage` (of the 95 % band) describe the standardised amplitudes `z`.
    `score` and `amplitude_score` are mean normal log likelihoods of attenuation and amplitude.
    `p_value` is the chance of as large an `rms` if the prediction is right; `p_mean`, `p_scatter`
    and `p_amplitude_scatter` are those of the mean residual, of the scatter of the attenuation and
    of the scatter of the amplitude if it is right to `ACCURACY`.
    """

    mean: Array
    standard_error: Array
    rms: float
    rms_standard_error: float
    rms_parameter_error: float
    chi2_per_dof: float
    ks: float
    cramer_von_mises: float
    coverage: float
    p_value: float
    p_mean: float
    p_scatter: float
    p_amplitude_scatter: float
    score: float
    amplitude_score: float
    z: Array

    @property
    def p_amplitude(self) -> float:
        """Return the p value of the scatter of the amplitude, as one of three tests."""
        return _one_of_three(self.p_amplitude_scatter)

    @property
    def p_surest(self) -> float:
        """Return the p value of the surest of the three tests."""
        return _one_of_three(self.p_mean, self.p_scatter, self.p_amplitude_scatter)

    @property
    def significant(self) -> bool:
        """Return whether something is not as predicted."""
        return self.p_surest < FALSE_ALARM

    @property
    def of_amplitude(self) -> bool:
        """Return whether the scatter of the amplitude is the surest of what is not predicted."""
        return self.p_amplitude_scatter <= min(self.p_mean, self.p_scatter)

    @property
    def text(self) -> str:
        """Return the surest of what is not as predicted, in words."""
        _, text = min(
            (self.p_mean, 'the mean attenuation of the held-out acquisitions is not the '
             'predicted one'),
            (self.p_scatter, 'the attenuation scatters more among the held-out acquisitions than '
             'predicted'),
            (self.p_amplitude_scatter, 'the amplitudes scatter more among the held-out '
             'acquisitions than predicted'))
        return text


def _one_of_three(*p_values: float) -> float:
    """Return the smallest p value, corrected for there being three tests."""
    return float(np.minimum(1.0, 3.0 * min(p_values)))


#: The residual of no line.
UNDEFINED = Residual(np.zeros(0), np.zeros(0), *13 * (_NAN,), z=np.zeros((0, 0)))


def residual(attenuation: Array, expected: Array, variance: Array, amplitude: Array,
             amplitude_expected: Array, amplitude_variance: Array, probability: Array, *,
             level_variance: float | Array = 0.0, sensitivities: Sequence[Sensitivity] = ()
             ) -> Residual:
    """
    Compare observed with predicted values, all arrays (acquisition, line).

    The variances include those of the observations; `probability` is the predicted distribution
    function at the amplitudes; `level_variance` (line,) is the part of `amplitude_variance` that
    all acquisitions share; `sensitivities` are those to each fitted parameter.
    """
    difference = attenuation - expected
    count = len(difference)
    scale = np.sqrt(variance)
    mean = difference.mean(axis=0)
    unsure = np.zeros(mean.size) + sum(item.mean**2 for item in sensitivities)
    error = np.sqrt(np.mean(scale**2, axis=0) / count + unsure)
    shift = amplitude - amplitude_expected
    width = np.sqrt(amplitude_variance)
    z = shift / width
    inside = np.clip(probability.ravel(), 1e-12, 1.0 - 1e-12)
    ks, cramer_von_mises = _from_uniform(inside)
    return Residual(
        mean=mean, standard_error=error, rms=float(np.sqrt(np.mean(mean**2))),
        rms_standard_error=float(np.sqrt(np.mean(error**2))),
        rms_parameter_error=float(np.sqrt(np.mean(unsure))),
        chi2_per_dof=float(np.mean(z**2)),
        ks=ks, cramer_von_mises=cramer_von_mises if inside.size > 1 else _NAN,
        coverage=float(np.mean((inside > 0.025) & (inside < 0.975))),
        p_value=_rms_p_value(difference, scale, [item.mean for item in sensitivities]),
        p_mean=_mean_p_value(difference / scale, scale, [item.mean for item in sensitivities]),
        p_scatter=_scatter_p_value(difference - mean, scale,
                                   [item.variance for item in sensitivities]),
        p_amplitude_scatter=_scatter_p_value(
            shift - shift.mean(axis=0),
            np.sqrt(np.maximum(amplitude_variance - level_variance, 0.0)),
            [item.amplitude_variance for item in sensitivities]),
        score=_log_score(difference, scale),
        amplitude_score=float(-0.5 * np.mean(z**2 + 2.0 * np.log(width))), z=z)


def _from_uniform(probability: Array) -> tuple[float, float]:
    """
    Return how far probabilities are from a uniform distribution: Kolmogorov, Cramer-von Mises.

    >>> ks, cramer_von_mises = _from_uniform(np.array([0.1, 0.2, 0.9]))
    >>> round(ks, 4), round(cramer_von_mises, 4)
    (0.4667, 0.1267)
    """
    count, ordered = probability.size, np.sort(probability)
    below = np.arange(count) / count
    ks = np.max(np.maximum(ordered - below, below + 1.0 / count - ordered))
    middle = below + 0.5 / count
    return float(ks), float(1.0 / (12.0 * count) + np.sum((middle - ordered) ** 2))


def _log_score(difference: Array, scale: Array) -> float:
    """
    Return the mean normal log likelihood, with the additional scatter that maximises it.

    A prediction for the measured pulses of each acquisition has a small variance; without the
    additional scatter its score would be low because of another effect.
    """
    more = np.concatenate(([0.0], np.geomspace(1e-4, 1.0, 41)))[:, None, None]
    variance = scale**2 + more**2
    return float(np.max(np.mean(-0.5 * (difference**2 / variance + np.log(variance)),
                                axis=(1, 2))))


def _mean_p_value(z: Array, scale: Array, sensitivities: Sequence[Array]) -> float:
    """
    Test mean z = 0 over all lines together, by a multiplier bootstrap over blocks.

    The statistic is the sum over lines of the squared mean over its standard error, which holds
    what parameters and observation may be wrong by. Under the null hypothesis z has unit variance.
    """
    count = len(z)
    bias = [np.asarray(item) / np.sqrt(np.mean(scale**2, axis=0)) for item in sensitivities]
    bias.append(ACCURACY / np.sqrt(np.mean(scale**2, axis=0)))
    total = np.sqrt(1.0 / count + sum(item**2 for item in bias))
    return _chance(z.mean(axis=0) / total, _unit_rows(z) / total, [item / total for item in bias])


def _rms_p_value(difference: Array, scale: Array, sensitivities: Sequence[Array]) -> float:
    """
    Return the chance of a mean `difference` of as large an RMS over the lines, by draws.

    The mean scatters as the prediction says; how lines do so together is told by the acquisitions.
    It is NaN for a single one.
    """
    if len(difference) < 2:
        return _NAN
    rows = _unit_rows(difference / scale) * np.sqrt(np.mean(scale**2, axis=0))
    return _chance(difference.mean(axis=0), rows, sensitivities)


def _unit_rows(z: Array) -> Array:
    """Return rows whose sum, each times a normal variable, scatters as a mean of unit ones."""
    centred = z - z.mean(axis=0)
    size = np.sqrt(np.sum(centred**2, axis=0) * len(z))
    return np.asarray(centred / np.where(size > 0.0, size, 1.0))


def _chance(mean: Array, rows: Array, bias: Sequence[Array]) -> float:
    """Return the chance of squares as large as those of a `mean` (line,), by draws."""
    statistic = float(np.mean(mean**2))
    rng = np.random.default_rng(_SEED)
    draws = rng.standard_normal((DRAWS, len(rows))) @ rows
    for item in bias:
        draws = draws + rng.standard_normal((DRAWS, 1)) * item
    null = np.mean(draws**2, axis=1)
    below = float(np.mean(null >= statistic))
    if below > FALSE_ALARM:
        return below
    # The tail beyond the draws is that of a scaled chi-squared variable of the same moments.
    freedom = 2.0 * null.mean() ** 2 / null.var()
    return float(min(max(below, 1.0 / DRAWS),
                     special.chdtrc(freedom, statistic * freedom / null.mean())))


def _scatter_p_value(difference: Array, scale: Array, unsure: Sequence[float]) -> float:
    """
    Test whether the lines scatter more than predicted, block by block.

    `unsure` are relative errors of the predicted variance.
    """
    count = len(difference)
    if count < 3:
        return 1.0
    power = np.mean(difference**2 / (scale**2 + ACCURACY**2), axis=1) * count / (count - 1)
    mean = float(power.mean())
    if mean <= 1.0:
        return 1.0
    # The log of a mean of squares is nearly normal; its spread comes from the acquisitions and is
    # never less than that of as many squares of one normal variable.
    spread = max(float(power.std(ddof=1)) / mean / np.sqrt(count), np.sqrt(1.0 / count))
    total = np.sqrt(spread**2 + np.sum(np.square(unsure)))
    return float(special.stdtr(count - 1, -np.log(mean) / total))
