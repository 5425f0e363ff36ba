"""
Exact moments of the amplitude of one order in a synchronous average.

The average of a unit component of order ``g`` over ``N_t`` whole trigger cycles is

    X(g) = (1/N_t) sum_k G_k,    G_k = int_0^1 exp(j 2 pi g e_k(u)) du

for any ratio of the shafts. Its moments are integrals of joint characteristic functions of the
angle error, done here by a Gauss-Legendre rule for all orders at once. Neighbouring cycles share a
pulse, so lag 1 belongs in every variance.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sa_jitter_ros.errors import ModelError
from sa_jitter_ros.prediction.angle_error import (
    AngleErrorProcess,
    joint_characteristic,
    unit_nodes,
)
from sa_jitter_ros.prediction.distributions import is_number
from scipy.special import erf, sici

Array = NDArray[Any]
#: Deterministic angle errors d_k(u) in fundamental cycles: u of shape (m,) to (trigger cycles, m).
AngleOffset = Callable[[Array], Array]

NODES = 64
_NEAR, _FAR_NODES = 2, 8  # cycles further apart depend on each other smoothly
_MOST_TURNS = 300.0
_MOST_NOISE = 1e9


@dataclass(frozen=True)
class AverageMoments:
    """
    Mean and second central moments of a complex amplitude, one entry per order.

    `variance` = E|X - m|^2 and `pseudo_variance` = E(X - m)^2, which together hold the covariance
    of real and imaginary part.
    """

    mean: Array
    variance: Array
    pseudo_variance: Array

    @property
    def mean_square(self) -> Array:
        """Return E|X|^2."""
        return np.asarray(np.abs(self.mean) ** 2 + self.variance)

    @property
    def real_variance(self) -> Array:
        """Return Var Re X."""
        return np.asarray(0.5 * (self.variance + np.real(self.pseudo_variance)))

    @property
    def imag_variance(self) -> Array:
        """Return Var Im X."""
        return np.asarray(0.5 * (self.variance - np.real(self.pseudo_variance)))

    @property
    def covariance(self) -> Array:
        """Return Cov(Re X, Im X)."""
        return np.asarray(0.5 * np.imag(self.pseudo_variance))

    def scaled(self, gain: ArrayLike) -> 'AverageMoments':
        """Return the moments of gain * X."""
        g = np.asarray(gain)
        return AverageMoments(self.mean * g, self.variance * np.abs(g) ** 2,
                              self.pseudo_variance * g**2)

    def with_noise(self, variance: ArrayLike) -> 'AverageMoments':
        """Return the moments of X + n with circular noise of variance E|n|^2."""
        return AverageMoments(self.mean, self.variance + np.asarray(variance),
                              self.pseudo_variance)


@dataclass(frozen=True)
class CycleMoments:
    """
    Moments of the amplitude G_k of single trigger cycles.

    `mean` has shape (orders,); `variance[l]` = E G_k conj(G_{k+l}) - |m|^2 and
    `pseudo_variance[l]` = E G_k G_{k+l} - m^2 have shape (1 + correlation length, orders). Both
    are exact; lags beyond are 0.
    """

    mean: Array
    variance: Array
    pseudo_variance: Array

    def lag(self, lag: int) -> AverageMoments:
        """Return the moments at one lag, whose variances are covariances between two cycles."""
        return AverageMoments(self.mean, np.real(self.variance[lag]), self.pseudo_variance[lag])

    def averaged(self, trigger_cycles: int) -> AverageMoments:
        """Return the moments of the mean of `trigger_cycles` consecutive cycles."""
        require_cycles(trigger_cycles)
        lags = np.arange(min(len(self.variance), trigger_cycles))
        weight = (trigger_cycles - lags) * np.where(lags == 0, 1.0, 2.0) / trigger_cycles**2
        return AverageMoments(self.mean, weight @ np.real(self.variance[lags]),
                              weight @ self.pseudo_variance[lags])


def cycle_moments(
    orders: ArrayLike, processes: Sequence[AngleErrorProcess], *, nodes: int = NODES,
    lags: int | None = None,
) -> CycleMoments:
    """
    Return the exact moments of single trigger cycles for orders of shape (n,).

    `lags` is the largest lag wanted, by default the correlation length of the processes.
    With 64 nodes they are good to 1e-12 as long as the angle errors stay within a cycle of the
    order. Section 2 of the theory; Eqs. 30-37 of Camerini et al. 2019 as special cases.
    """
    g = require_orders(orders)
    u, w = unit_nodes(nodes)
    plane = g[:, None, None]
    first = joint_characteristic(processes, [g[:, None]], [u], [0])
    mean = first @ w
    variance, pseudo = [], []
    fine = (u, w, mean)
    rule = unit_nodes(min(nodes, max(_FAR_NODES, nodes // 4)))
    far = (*rule, joint_characteristic(processes, [g[:, None]], [rule[0]], [0]) @ rule[1])
    length = correlation_length(processes)
    for lag in range((length if lags is None else min(lags, length)) + 1):
        u, w, own = fine if lag <= _NEAR else far
        points = ([u[:, None], u], [0, lag])
        variance.append(joint_characteristic(processes, [plane, -plane], *points) @ w @ w
                        - np.abs(own) ** 2)
        pseudo.append(joint_characteristic(processes, [plane, plane], *points) @ w @ w - own**2)
    return CycleMoments(mean, np.array(variance), np.array(pseudo))


def offset_moments(
    orders: ArrayLike, processes: Sequence[AngleErrorProcess], trigger_cycles: int,
    offset: AngleOffset, *, nodes: int = NODES,
) -> AverageMoments:
    """
    Return the exact moments of the average with deterministic angle errors on top of random ones.

    `offset(u)` returns d_k(u) in fundamental cycles, shape (trigger_cycles, u.size): clock skew,
    target geometry, a known speed profile.
    """
    g = require_orders(orders)
    require_cycles(trigger_cycles)
    u, w = unit_nodes(nodes)
    phasor = np.exp(2j * np.pi * g[:, None, None] * offset(u)) * w
    plane = g[:, None, None]
    first = joint_characteristic(processes, [g[:, None]], [u], [0])
    mean = np.sum(phasor.mean(axis=1) * first, axis=1)
    variance = np.zeros(g.size)
    pseudo = np.zeros(g.size, complex)
    for lag in range(min(correlation_length(processes) + 1, trigger_cycles)):
        early = phasor[:, :trigger_cycles - lag].transpose(0, 2, 1)
        late = phasor[:, lag:]
        scale = (1.0 if lag == 0 else 2.0) / trigger_cycles**2
        points = ([u[:, None], u], [0, lag])
        joint = (joint_characteristic(processes, [plane, -plane], *points)
                 - first[:, :, None] * first[:, None, :].conj())
        variance += scale * np.real(np.sum((early @ late.conj()) * joint, axis=(1, 2)))
        joint = (joint_characteristic(processes, [plane, plane], *points)
                 - first[:, :, None] * first[:, None, :])
        pseudo += scale * np.sum((early @ late) * joint, axis=(1, 2))
    return AverageMoments(mean, variance, pseudo)


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


def noise_line_variance(noise_std: float, sample_rate: float, duration: float) -> float:
    """
    Return E|n|^2 of white noise in the PEAK amplitude of one order of an average of `duration` s.

    `noise_std` is per sample at `sample_rate` Hz: 4 noise_std^2 / (sample_rate duration), half of
    it on each of real and imaginary part (what Eqs. 49 and 50 become in sampled data). Raises
    ModelError for noise that buries every component.
    """
    size = 2.0 * noise_std / math.sqrt(sample_rate * duration)
    if not size < _MOST_NOISE:
        raise ModelError(f'noise of {noise_std:.6g} per sample leaves {size:.3g} in each line, '
                         f'not below {_MOST_NOISE:g} components: lower it, or average longer')
    return size**2


def correlation_length(processes: Sequence[AngleErrorProcess]) -> int:
    """Return the largest correlation length of the processes in cycles."""
    return max((process.correlation_length for process in processes), default=0)


def require_orders(orders: ArrayLike) -> Array:
    """Return the orders as floats of shape (n,); raise ModelError unless finite and positive."""
    try:
        g = np.atleast_1d(np.asarray(orders, float))
    except (TypeError, ValueError) as error:
        raise ModelError(f'orders hold a value that is no number ({error}): give a list of finite '
                         'orders above 0') from error
    bad = ~(np.isfinite(g) & (g > 0.0))
    if g.ndim != 1 or g.size == 0 or np.any(bad):
        what = f'orders hold {g[bad][0]}' if np.any(bad) else f'orders have the shape {g.shape}'
        raise ModelError(f'{what}: give a list of finite orders above 0')
    return g


def require_cycles(trigger_cycles: int) -> None:
    """Raise ModelError unless an average holds at least one trigger cycle."""
    if not (is_number(trigger_cycles) and trigger_cycles >= 1
            and float(trigger_cycles).is_integer()):
        raise ModelError(f'trigger_cycles is {trigger_cycles}: an average holds a whole number of '
                         'at least 1')
