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
Closed forms of Camerini et al. 2019, its analytic approximation with errata, and the exact values.

Eq. 38 is the mean amplitude under uniform jitter (`uniform_mean`), Fig. 7 the leakage between the
components of a signal (`multi_harmonic_moments`).

Eqs. 40-46 give the moments of one trigger cycle for uniform jitter (`approximate_cycle_moments`),
Eqs. 47-52 the cumulants of the squared amplitude of a normal X, and Eqs. 53-63 a Laguerre
expansion of its distribution (`LaguerreDistribution`). `inversion_cdf` is the same distribution
without approximation, by inverting the characteristic function of the quadratic form. The package
needs neither; these are here to reproduce the paper and to check each other.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sa_jitter_ros.errors import ModelError, ParameterError
from sa_jitter_ros.prediction.amplitude_distribution import AmplitudeDistribution
from sa_jitter_ros.prediction.angle_error import (
    AngleErrorProcess, joint_characteristic, unit_nodes)
from sa_jitter_ros.prediction.moments import (
    AverageMoments, correlation_length, CycleMoments, NODES, require_cycles, require_orders)
from scipy.optimize import brentq
from scipy.special import erf, gammainc, gammaln, sici

Array = NDArray[Any]

_FIRST_END, _LAST_END = 32, 16384  # of the inversion, in units of 1 / (2 std)
_PANEL_NODES = 8
_MOST_TURNS = 300.0  # of a source in a trigger cycle against an order: so far apart nothing leaks


def uniform_mean(spread: ArrayLike) -> Array:
    """
    Return the mean amplitude for uniform jitter, closed form (Eq. 38).

    `spread` is the width in cycles of the order, g D > 0.
    """
    x = np.pi * np.asarray(spread, float)
    si, ci = sici(2.0 * x)
    return np.asarray((np.cos(x) * (ci - np.euler_gamma - np.log(2.0 * x)) + np.sin(x) * si)
                      / x**2)


def normal_mean(spread: ArrayLike) -> Array:
    """Return the mean amplitude for normal jitter; `spread` = g sigma > 0 in cycles."""
    s = 2.0 * np.pi * np.asarray(spread, float)
    return np.asarray(np.exp(-0.25 * s**2) * np.sqrt(np.pi) * erf(0.5 * s) / s)


def multi_harmonic_moments(
    orders: ArrayLike, source_orders: ArrayLike, amplitudes: ArrayLike,
    processes: Sequence[AngleErrorProcess], trigger_cycles: int, cycle_length: float, *,
    nodes: int = NODES,
) -> AverageMoments:
    """
    Return the moments of analysed orders of a signal of several components, leakage included.

    The signal is sum_s a_s exp(j 2 pi g_s theta) with `source_orders` g_s and complex `amplitudes`
    a_s; a trigger cycle is `cycle_length` (r) fundamental cycles long. An integer r lets a source
    leak coherently into its neighbours, a bias that no number of cycles removes (Fig. 7). Raises
    ModelError for components that are more than 300 turns a trigger cycle away from an order.
    """
    g = require_orders(orders)
    sources = require_orders(source_orders)
    a = np.broadcast_to(np.asarray(amplitudes, complex), sources.shape)
    require_cycles(trigger_cycles)
    if not cycle_length > 0.0:
        raise ModelError(f'cycle_length is {cycle_length}: a trigger cycle lasts more than 0 '
                         'fundamental cycles')
    turns = cycle_length * (sources[:, None] - g)  # per trigger cycle, (source, order)
    most = float(np.max(np.abs(turns)))
    if most > _MOST_TURNS:
        raise ModelError(
            f'a source makes {most:.6g} turns a trigger cycle against an analysed order, more '
            f'than {_MOST_TURNS:g}: so far apart nothing leaks, leave it out')
    u, w = unit_nodes(max(nodes, math.ceil(np.pi * most) + 24))
    shift = 2.0 * np.pi * turns
    weight = a[:, None, None] * np.exp(1j * shift[:, :, None] * u) * w
    steps = np.exp(1j * shift[:, :, None] * np.arange(trigger_cycles))
    first = [joint_characteristic(processes, [s], [u], [0]) for s in sources]
    means = np.array([steps[s].mean(axis=-1) * (weight[s] @ first[s])
                      for s in range(sources.size)])
    variance = np.zeros(g.size)
    pseudo = np.zeros(g.size, complex)
    for lag in range(min(correlation_length(processes) + 1, trigger_cycles)):
        scale = (1.0 if lag == 0 else 2.0) / trigger_cycles**2
        points = ([u[:, None], u], [0, lag])
        for s, early in enumerate(sources):
            for t, late in enumerate(sources):
                joint = (joint_characteristic(processes, [early, -late], *points)
                         - np.multiply.outer(first[s], first[t].conj()))
                beat = np.sum(steps[s][:, :trigger_cycles - lag]
                              * steps[t][:, lag:].conj(), axis=-1)
                variance += scale * np.real(
                    beat * np.sum((weight[s] @ joint) * weight[t].conj(), axis=-1))
                joint = (joint_characteristic(processes, [early, late], *points)
                         - np.multiply.outer(first[s], first[t]))
                beat = np.sum(steps[s][:, :trigger_cycles - lag] * steps[t][:, lag:], axis=-1)
                pseudo += scale * beat * np.sum((weight[s] @ joint) * weight[t], axis=-1)
    return AverageMoments(means.sum(axis=0), variance, pseudo)


def approximate_cycle_moments(spread: ArrayLike) -> CycleMoments:
    """
    Return the approximate moments of one cycle for uniform jitter (Eqs. 40-46).

    `spread` is the width in cycles of the order, g D > 0. Within 0.2 % (mean) and 3 % (lag 1) of
    the exact values up to 0.4; below about 0.01 the differences of large terms lose all digits.
    """
    x = np.pi * np.atleast_1d(np.asarray(spread, float))
    cos, cos2, sin, sin2 = np.cos(x), np.cos(2.0 * x), np.sin(x), np.sin(2.0 * x)
    mean = (8.0 - x**2 - 8.0 * cos) / (3.0 * x**2)
    real = ((4.0 * x**6 - 90.0 * x**4 + 1710.0 * x**2 - 1305.0 * cos2 + 1305.0)
            / (4320.0 * x**2) - (x**2 + 8.0 * cos - 8.0) ** 2 / (9.0 * x**4))
    imag = ((4.0 * x**6 - 150.0 * x**4 + 2610.0 * x**2 + 1305.0 * cos2 - 1305.0)
            / (4320.0 * x**2))
    real_lag = (
        (-32.0 / 3.0 + 128.0 / 9.0 * cos - 32.0 / 9.0 * cos2) / x**4
        + 113.0 / 144.0 * (2.0 * sin - sin2) / x**3 + 241.0 / 72.0 * (1.0 - cos) / x**2
        - 47.0 / 72.0 * sin / x - 7.0 / 36.0 + cos / 6.0 + x * sin / 108.0
        + x**2 * (1.0 / 180.0 - cos / 1080.0))
    imag_lag = (
        3.0 * (4.0 * x**5 - 100.0 * x**3 + 1430.0 * x + 565.0 * sin2)
        + 10.0 * (2.0 * x**4 - 51.0 * x**2 - 339.0) * sin
        - 2.0 * x * (x**4 - 180.0 * x**2 + 2145.0) * cos) / (2160.0 * x**3)
    return CycleMoments(mean.astype(complex), np.array([real + imag, real_lag + imag_lag]),
                        np.array([real - imag, real_lag - imag_lag]))


def normal_distribution(moments: AverageMoments) -> AmplitudeDistribution:
    """Return the exact distribution of |X| for a normal X: the quadratic form of Eq. 34."""
    turn = np.exp(0.5j * np.angle(-moments.pseudo_variance))  # the axis of the smaller variance
    mean = moments.mean * turn.conj()
    gap = np.abs(moments.pseudo_variance)
    zero = np.zeros(mean.size)
    small = np.maximum(0.5 * (moments.variance - gap), 0.0)
    return AmplitudeDistribution(mean.real, mean.imag, np.sqrt(small),
                                 np.sqrt(0.5 * (moments.variance + gap)), zero, zero, zero, zero)


def squared_amplitude_cumulants(moments: AverageMoments, count: int) -> Array:
    """
    Return the first `count` cumulants of |X|^2 for a normal X, shape (count, orders).

    k(s) = 2^(s-1) (s-1)! [tr(S^s) + s m' S^(s-1) m] with S the covariance of the AVERAGE: Eq. 51
    with the trace of the power; Eqs. 47-50 are s = 1, 2.
    """
    eigenvalues, means = _principal(moments)
    orders = np.arange(1, count + 1)[:, None, None]
    factor = np.cumprod(np.concatenate([[1.0], 2.0 * np.arange(1.0, count)]))[:, None]
    terms = eigenvalues**orders + orders * means**2 * eigenvalues ** (orders - 1)
    return np.asarray(factor * terms.sum(axis=1))


@dataclass(frozen=True)
class LaguerreDistribution:
    """
    The Laguerre expansion of the distribution of |X|^2, one entry per order (Eqs. 53-63).

    A gamma density of shape `shape` and scale `scale` times 1 + sum_i `weights[i]` q_i(y), y
    standardised and q_i the Laguerre polynomials in it. In y nothing cancels; in x a shape of 2e5,
    which 100 cycles of small jitter have, costs all digits beyond degree 6.
    """

    shape: Array
    scale: Array
    weights: Array = field(repr=False)

    def pdf(self, squared: ArrayLike) -> Array:
        """Return the density of |X|^2 at values of shape (k,), shape (orders, k)."""
        t, y, density = self._gamma(squared)
        return np.asarray(density / (t * self.scale[:, None]) * np.sum(
            self.weights[:, :, None] * self._polynomials(y, len(self.weights), 0), axis=0))

    def cdf(self, squared: ArrayLike) -> Array:
        """Return P(|X|^2 <= value) for values of shape (k,), shape (orders, k)."""
        t, y, density = self._gamma(squared)
        root = np.sqrt(self.shape[:, None])
        terms = self.weights[1:, :, None] * self._polynomials(y, len(self.weights) - 1, 1)
        return np.asarray(gammainc(self.shape[:, None], t) - density / root * terms.sum(axis=0))

    def amplitude_cdf(self, amplitude: ArrayLike) -> Array:
        """Return P(|X| <= value) (Eq. 63)."""
        return self.cdf(np.asarray(amplitude, float) ** 2)

    def amplitude_ppf(self, probability: float) -> Array:
        """Return the quantile of |X| at one probability in (0, 1), shape (orders,)."""
        if not 0.0 < probability < 1.0:
            raise ParameterError(f'probability is {probability}: it must lie between 0 and 1')
        mean = self.shape * self.scale
        reach = 12.0 * np.sqrt(self.shape) * self.scale
        return np.sqrt([
            brentq(lambda x, i=i: self.cdf([x])[i, 0] - probability,
                   max(mean[i] - reach[i], 1e-12 * mean[i]), mean[i] + reach[i])
            for i in range(mean.size)])

    def _gamma(self, squared: ArrayLike) -> tuple[Array, Array, Array]:
        """Return x / scale, the standardised x and t times the unit gamma density."""
        t = np.atleast_1d(np.asarray(squared, float)) / self.scale[:, None]
        t = np.maximum(t, np.finfo(float).tiny)
        shape = self.shape[:, None]
        return t, (t - shape) / np.sqrt(shape), np.exp(shape * np.log(t) - t - gammaln(shape))

    def _polynomials(self, y: Array, count: int, shift: int) -> Array:
        """Return q_0 .. q_{count-1} of the gamma density of shape `shape + shift`, monic in y."""
        root = np.sqrt(self.shape[:, None])
        values = [np.ones_like(y), y - shift / root]
        for i in range(1, count - 1):
            values.append((y - (2 * i + shift) / root) * values[i]
                          - i * (1.0 + (i - 1 + shift) / root**2) * values[i - 1])
        return np.array(values[:count])


def laguerre_distribution(moments: AverageMoments, *, degree: int = 4) -> LaguerreDistribution:
    """
    Return the Laguerre expansion of the distribution of |X|^2 for a normal X with these moments.

    At 100 cycles every degree improves it (2e-4 off at degree 4, 2e-5 at 10). At 20 cycles of
    jitter below 0.4 cycles it diverges: degree 4 is the best, 0.005 off, degree 12 useless.
    Raises ParameterError for a degree below 2 (the gamma distribution itself).
    """
    if degree < 2:
        raise ParameterError(f'degree is {degree}: the gamma distribution alone has degree 2')
    cumulants = squared_amplitude_cumulants(moments, degree)
    mean, variance = cumulants[:2]
    standard = cumulants / variance ** (0.5 * np.arange(1, degree + 1)[:, None])
    standard[0] = 0.0
    raw = [np.ones_like(mean)]  # Eq. 52, of the standardised variable
    for h in range(1, degree + 1):
        binomial = 1.0
        total = np.zeros_like(mean)
        for i in range(h):
            total += binomial * standard[h - i - 1] * raw[i]
            binomial *= (h - 1 - i) / (i + 1)
        raw.append(total)
    shape = mean**2 / variance
    root = np.sqrt(shape)
    rows = [np.zeros((degree + 1, mean.size)) for _ in range(2)]  # coefficients of q_{i-1}, q_i
    rows[1][0] = 1.0
    norm = np.ones_like(mean)
    weights = [np.ones_like(mean)]
    for i in range(degree):
        shifted = np.roll(rows[1], 1, axis=0)
        rows = [rows[1], shifted - 2 * i / root * rows[1] - i * (1.0 + (i - 1) / shape) * rows[0]]
        norm = norm * (i + 1) * (1.0 + i / shape)
        weights.append(np.sum(rows[1] * np.array(raw), axis=0) / norm)
    weights[1] = weights[2] = np.zeros_like(mean)  # zero but for rounding: two moments are met
    return LaguerreDistribution(shape, variance / mean, np.array(weights))


def inversion_cdf(moments: AverageMoments, amplitude: ArrayLike) -> Array:
    """
    Return P(|X| <= amplitude) of a normal X by numerical inversion (Imhof 1961).

    Shape (orders, k) for amplitudes of shape (k,) or (orders, k); a reference, good to 1e-12
    as long as the mean is some standard deviations away from 0, to 1e-5 near 0.
    """
    y = np.atleast_2d(np.asarray(amplitude, float))
    y = np.broadcast_to(y, (moments.mean.size, y.shape[-1]))
    eigenvalues, means = _principal(moments)
    x, w = unit_nodes(_PANEL_NODES)
    result = np.empty(y.shape)
    for column, row in enumerate(y):
        lam, power = eigenvalues[:, column], means[:, column] ** 2
        scale = 2.0 * np.sqrt(np.sum(lam**2 + 2.0 * lam * power))  # 2 std of |X|^2
        lam, power = lam[:, None] / scale, power[:, None] / scale
        end = _FIRST_END
        while end < _LAST_END and _envelope(np.array([end]), lam, power)[0] > 1e-12:
            end *= 2
        u = np.add.outer(np.arange(end), x).ravel()
        weight = np.tile(w, end) * _envelope(u, lam, power)
        angle = 0.5 * np.sum(np.arctan(lam * u) + power * u / (1.0 + (lam * u) ** 2), axis=0)
        result[column] = [0.5 - np.sin(angle - 0.5 * q * u) @ weight / np.pi
                          for q in row**2 / scale]
    return result


def _envelope(u: Array, lam: Array, power: Array) -> Array:
    """Return the amplitude of Imhof's integrand."""
    damped = 1.0 + (lam * u) ** 2
    exponent = 0.5 * np.sum(power * lam * u**2 / damped, axis=0)
    return np.asarray(np.exp(-exponent) / (u * np.prod(damped, axis=0) ** 0.25))


def _principal(moments: AverageMoments) -> tuple[Array, Array]:
    """Return the eigenvalues of the covariance and the means on its axes, shape (2, orders)."""
    turn = np.exp(0.5j * np.angle(moments.pseudo_variance))
    gap = np.abs(moments.pseudo_variance)
    mean = moments.mean * turn.conj()
    variances = 0.5 * np.array([moments.variance + gap, np.maximum(moments.variance - gap, 0.0)])
    return variances, np.array([mean.real, mean.imag])
