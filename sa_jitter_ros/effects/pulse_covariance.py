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
Fits of the autocovariance of pulse errors, and tests of the errors that remain after a fit.

Errors have mean 0 in every acquisition, so they are compared through contrasts that a common delay
does not change. The likelihood is normal; for the uniform declared jitter that errs on the safe
side, because its variance scatters less than a normal one's.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.effects.evidence import Evidence, SAME_SPEED
from scipy import optimize, stats
from scipy.linalg import cho_factor, cho_solve, solve_triangular, toeplitz
from scipy.special import ndtr

Array = NDArray[Any]
#: Autocorrelation at integer lags for a shape parameter.
Correlation = Callable[[Array, float], Array]

_MOST_PULSES = 200
_GOOD = 1e-3
_DRAWS = 4000
_FEWEST = 20


def white(lags: Array, _: float) -> Array:
    """Return the autocorrelation of independent errors."""
    return np.where(lags == 0, 1.0, 0.0)


def autoregressive(lags: Array, correlation: float) -> Array:
    """Return the autocorrelation of first-order autoregressive errors."""
    return np.asarray(correlation ** np.abs(lags))


@dataclass(frozen=True)
class CovarianceFit:
    """
    A component `variance` (s^2) of the pulse errors beyond the expected ones, with its errors.

    `shape` is the parameter of its autocorrelation. `gain` is twice the log-likelihood gained;
    `p_value` that of no such component. `innovations` (acquisition, n) are the errors whitened by
    the whole covariance.
    """

    variance: float
    variance_error: float
    shape: float
    shape_error: float
    gain: float
    p_value: float
    observed_std: float
    expected_std: float
    innovations: Array

    def p_value_over(self, simpler: 'CovarianceFit') -> float:
        """Return the p value of this fit's one more parameter."""
        return float(stats.chi2.sf(max(self.gain - simpler.gain, 0.0), 1))


def fit_covariance(evidence: Evidence, correlation: Correlation, *,
                   bounds: tuple[float, float] = (0.0, 0.0)) -> CovarianceFit:
    """Fit the size, and within `bounds` the shape, of one more component of the pulse errors."""
    errors = evidence.errors[:, :_MOST_PULSES]
    count = errors.shape[1]
    lags = np.arange(count)
    known = _expected(evidence)
    contrast = np.diff(np.eye(count), axis=0)
    scale = float(np.mean(np.diff(errors, axis=1) ** 2)) or 1e-24
    data = np.diff(errors, axis=1) / np.sqrt(scale)
    base = contrast @ known @ contrast.T / scale + 1e-9 * np.eye(count - 1)

    def added(shape: float) -> Array:
        return np.asarray(contrast @ toeplitz(correlation(lags, shape)) @ contrast.T)

    def deviance(variance: float, part: Array) -> float:
        factor = cho_factor(base + variance * part, lower=True)
        return float(len(data) * 2.0 * np.sum(np.log(np.diag(factor[0])))
                     + np.sum(data * cho_solve(factor, data.T).T))

    def best(shape: float) -> tuple[float, float]:
        part = added(shape)
        top = 4.0 * float(np.mean(data**2)) / float(np.mean(np.diag(part)))
        found = optimize.minimize_scalar(
            lambda root: deviance(root**2, part), bounds=(0.0, np.sqrt(top)), method='bounded',
            options={'xatol': 1e-5})
        return float(found.x**2), float(found.fun)

    shape = 0.0
    low, high = bounds
    if high > low:
        grid = np.linspace(low, high, 15)
        start = grid[int(np.argmin([best(x)[1] for x in grid]))]
        step = (high - low) / 14.0
        shape = float(optimize.minimize_scalar(
            lambda x: best(x)[1], bounds=(max(low, start - step), min(high, start + step)),
            method='bounded', options={'xatol': 1e-4}).x)
    part = added(shape)
    variance, value = best(shape)
    gain = max(deviance(0.0, part) - value, 0.0)
    if gain < 1e-6:
        variance = 0.0
    factor = cho_factor(base + variance * part, lower=True)
    slopes = [part]
    if high > low and variance:
        step = 1e-3
        slopes.append(variance * (added(shape + step) - added(shape - step)) / (2.0 * step))
    variance_error, shape_error = (*_standard_errors(
        [cho_solve(factor, slope) for slope in slopes], contrast, cho_solve(factor, contrast),
        _fourth_cumulant(evidence) / scale**2, len(data)), 0.0)[:2]
    innovations = solve_triangular(factor[0], data.T, lower=True).T
    return CovarianceFit(
        variance * scale, variance_error * scale, shape, shape_error, gain,
        0.5 * float(stats.chi2.sf(gain, 1)), float(np.sqrt(np.mean(errors**2))),
        float(np.sqrt((np.trace(known) - known.sum() / count) / count)), innovations)


def fit_memory(evidence: Evidence) -> CovarianceFit:
    """Fit normal errors whose neighbours are correlated."""
    return fit_covariance(evidence, autoregressive, bounds=(-0.98, 0.98))


def memory_p_value(evidence: Evidence) -> float:
    """Return the p value of correlated errors where independent ones are there anyway."""
    return fit_memory(evidence).p_value_over(fit_covariance(evidence, white))


def log_likelihood(evidence: Evidence) -> float:
    """Return that of the pulse errors if they are what declared jitter and `explained` make."""
    errors = np.diff(evidence.errors[:, :_MOST_PULSES], axis=1)
    scale = float(np.mean(errors**2)) or 1e-24
    contrast = np.diff(np.eye(errors.shape[1] + 1), axis=0)
    known = contrast @ _expected(evidence) @ contrast.T / scale
    factor = cho_factor(known + 1e-9 * np.eye(len(known)), lower=True)
    whitened = solve_triangular(factor[0], errors.T / np.sqrt(scale), lower=True)
    return float(-0.5 * np.sum(whitened**2) - len(errors) * (
        np.sum(np.log(np.diag(factor[0]))) + 0.5 * len(known) * np.log(scale)))


def _expected(evidence: Evidence) -> Array:
    """Return the covariance in s^2 of the expected errors with the noise of their recovery."""
    noise = np.mean(evidence.standard_errors[:, :_MOST_PULSES] ** 2, axis=0)
    return np.asarray(toeplitz(evidence.expected_autocovariance(np.arange(noise.size)))
                      + np.diag(np.nan_to_num(noise)))


def _standard_errors(slopes: Sequence[Array], contrast: Array, whitened: Array, cumulant: float,
                     rows: int) -> list[float]:
    """
    Return the standard errors of parameters of a covariance V fitted as if all were normal.

    `slopes` are V^-1 dV / d parameter (n, n), `contrast` C (n, pulse), `whitened` V^-1 C, and
    `cumulant` is the fourth one of the independent errors, which adds to the variance of the score
    (White's sandwich): uniform errors tell more of their variance than normal ones.
    """
    information = 0.5 * rows * np.array([[np.sum(a * b.T) for b in slopes] for a in slopes])
    weight = np.array([np.sum(contrast * (slope @ whitened), axis=0) for slope in slopes])
    score = information + 0.25 * rows * cumulant * weight @ weight.T
    inverse = np.linalg.inv(information)
    return [float(error) for error in np.sqrt(np.diag(inverse @ score @ inverse))]


def _fourth_cumulant(evidence: Evidence) -> float:
    """Return the fourth cumulant in s^4 of the declared jitter, 0 where something replaces it."""
    jitter = evidence.jitter
    if jitter is None:
        return 0.0
    draws = jitter.draw(np.random.default_rng(1), 20000)
    return float(stats.kurtosis(draws)) * jitter.variance**2


def goodness_of_fit(evidence: Evidence, fit: CovarianceFit) -> str:
    """Return what in the remaining errors contradicts a fit, '' if nothing does."""
    white_left = fit.innovations[:, 1:]
    rows, count = white_left.shape
    total, used = 0.0, 0
    for lag in range(1, min(12, count // 2) + 1):
        product = white_left[:, lag:] * white_left[:, :-lag]
        total += product.sum() ** 2 / np.sum(white_left[:, lag:] ** 2 * white_left[:, :-lag] ** 2)
        used += 1
    p_memory = float(stats.chi2.sf(total, used))
    if p_memory < _GOOD:
        return f'the errors keep a memory that it does not have: p = {p_memory:.2g}'
    spectrum = np.mean(np.abs(np.fft.rfft(white_left, axis=1)[:, 1:]) ** 2, axis=0)
    peak = float(spectrum.max() / spectrum.mean())
    p_line = float(min(1.0, spectrum.size * stats.gamma.sf(peak * rows, rows)))
    if p_line < _GOOD:
        return f'the errors hold a line spectrum that it does not have: p = {p_line:.2g}'
    p_distribution = min(_distribution_p_value(evidence, fit), _moments_p_value(evidence),
                         _shocks_p_value(white_left[:, :-1].ravel()))
    if p_distribution < _GOOD:
        return f'the distribution of the errors is not the one it has: p = {p_distribution:.2g}'
    power = np.mean(white_left**2, axis=1)
    if rows >= 4:
        kurtosis = float(np.mean(white_left**4) / np.mean(white_left**2) ** 2)
        spread = float(power.std(ddof=1) / power.mean())
        expected = np.sqrt(max(kurtosis - 1.0, 0.2) / count)
        ratio = float((rows - 1) * (spread / expected) ** 2)
        p_steady = float(stats.chi2.sf(ratio, rows - 1))
        if p_steady < _GOOD:
            return f'the size of the errors is not steady over the record: p = {p_steady:.2g}'
        p_speed = _speed_p_value(evidence, power, float(expected))
        if p_speed < _GOOD:
            return f'the size of the errors changes with the speed: p = {p_speed:.2g}'
    return ''


def _speed_p_value(evidence: Evidence, power: Array, spread: float) -> float:
    """Test whether the power of the errors, of relative `spread`, changes with the speed."""
    speed = 1.0 / evidence.periods
    away = speed / speed.mean() - 1.0
    if np.std(away) < SAME_SPEED:
        return 1.0
    slope = float(np.sum(away * power) / power.mean() / np.sqrt(np.sum(away**2)))
    return float(2.0 * stats.norm.sf(abs(slope) / spread))


def _distribution_p_value(evidence: Evidence, fit: CovarianceFit) -> float:
    """Compare the errors with declared jitter plus normal jitter of the fitted variance."""
    errors = evidence.errors.ravel()
    declared, draws = 0.0, np.zeros(1)
    jitter = evidence.jitter
    if jitter is not None:
        declared = jitter.variance
        draws = np.sort(jitter.draw(np.random.default_rng(1), 20000))[::50]
    count = evidence.errors.shape[1]
    known = evidence.expected_autocovariance(np.zeros(1, int))[0] - declared
    noise = float(np.nanmean(evidence.standard_errors**2))
    normal = max(fit.variance + max(known, 0.0) + noise, 1e-30)
    shrink = np.sqrt(1.0 + declared / (count * normal))

    def cdf(x: Array) -> Array:
        return np.asarray(ndtr((x[:, None] - draws) / np.sqrt(normal)).mean(axis=1))

    memory = max(1.0, _effective_repeats(evidence.errors))
    distance = float(stats.kstest(errors * min(shrink, 1.02), cdf).statistic)
    return float(stats.kstwobign.sf(distance * np.sqrt(errors.size / memory)))


def _moments_p_value(evidence: Evidence) -> float:
    """Compare skewness and kurtosis of the errors with drawn ones, declared plus normal jitter."""
    errors = evidence.errors[:, 1:-1]  # those at the ends are rough
    jitter = evidence.jitter
    size = int(errors.size / _effective_repeats(errors))
    power = float(np.mean(errors**2))
    known = 0.0 if jitter is None else min(jitter.variance, power)
    rng = np.random.default_rng(1)
    draws = rng.normal(0.0, np.sqrt(power - known), (_DRAWS, size))
    if jitter is not None:
        draws += jitter.draw(rng, (_DRAWS, size))
    p_values = []
    for moment in (stats.skew, stats.kurtosis):
        drawn, seen = moment(draws, axis=1), moment(errors.ravel())
        tail = min(np.count_nonzero(drawn >= seen), np.count_nonzero(drawn <= seen))
        p_values.append(2.0 * (tail + 1.0) / (_DRAWS + 1.0))
    return float(min(1.0, *p_values))


def _shocks_p_value(innovations: Array) -> float:
    """Test for rare large shocks, which a memory spreads until the errors look normal."""
    if innovations.size < _FEWEST:
        return 1.0
    tailed = stats.kurtosistest(innovations, alternative='greater').pvalue
    return float(min(1.0, 2.0 * min(stats.skewtest(innovations).pvalue, tailed)))


def _effective_repeats(errors: Array) -> float:
    """Return how many neighbouring errors count as one."""
    power = float(np.mean(errors**2)) or 1.0
    total = 1.0
    for lag in range(1, min(20, errors.shape[1] // 2)):
        r = float(np.mean(errors[:, lag:] * errors[:, :-lag])) / power
        if abs(r) < 0.1:
            break
        total += 2.0 * abs(r)
    return total
