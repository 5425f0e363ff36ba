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
Standard errors of order amplitudes and phases, and upper limits of orders that are not there.

The scatter of the single trigger cycles shows them. Along the radius of the complex mean it is
noise; across it noise and jitter. Neighbouring cycles have a pulse in common, so that jitter makes
half of the variance of one cycle the covariance with the next, and the variance of the mean of N_t
cycles is twice that of independent ones (the covariances of Camerini et al. 2019, Eq. 32). From
`_MANY` cycles on the spectrum of the scatter near frequency zero shows what the mean has,
whatever its correlation; fewer cycles determine the standard deviation of one independent error
for each pulse, with all channels and orders together. A correction knows the pulse errors and the
noise beside them.

A few cycles show their scatter only roughly. The standard errors are enlarged by so much
(`widened`) that 1 and 1.96 of them contain 68 % and 95 %, as those of a normal distribution do.
"""

from dataclasses import dataclass
from functools import lru_cache
import math
from math import pi

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray
from sa_jitter_ros.arrays import ComplexArray, FloatArray
from sa_jitter_ros.averaging.noise import row_medians, scatter_power
from scipy import fft
from scipy.special import chndtrix, erf

# Cycles from which on the spectrum near zero is used, at least so many lines of it, and their
# share of the cycles.
_MANY, _LINES, _SHARE = 32, 4, 0.1
# Spectral lines from which on outliers are told from noise, and where they begin, times the noise.
_ROBUST_FROM, _OUTLIER = 8, 10.0
# Power of the mean over its noise from which on an order shows jitter, and of one cycle from
# which on its phase is that of its mean phasor.
_SHOWS, _CLEAR = 10.0, 10.0
# The standard deviation of a phase of which nothing is known, and by how much one is larger than
# the error across over the amplitude, times the cube of this (Monte Carlo: intervals of 68 % and
# 95 % hold to 3 points for jitter up to 1.6 rad, and for orders at 0 dB and more above noise).
_UNKNOWN_PHASE, _TURNED = pi / np.sqrt(3.0), 0.6
# Kurtosis of uniform pulse errors, and its range.
_UNIFORM, _KURTOSES = 1.8, (1.2, 3.0)
# Leakage is at an unknown angle to the amplitude.
_ANY_ANGLE = 0.6
# What the model of the correction is off by, relative to the amplitude.
_MODEL = 2.5e-4
# The lowest upper limit in standard errors: an amplitude below the noise by chance proves less.
_LOWEST_LIMIT = 0.5
# Noise below this fraction of an amplitude is a rounding error.
_ROUNDING = 1e-9
# No limit is more than so many times the amplitude: jitter that leaves less leaves no information.
_LEAST_LEFT = 0.02
# Jitter that leaves less than this share leaves an order whose amplitude is not known.
_LEAST_SHARE = 0.3
# Jitter that cannot leak more than so much of the noise into a cycle does not matter.
_NO_LEAK = 0.01
# Phasors that are closer together than this turn alike.
_ALIKE = 1e-4
_U, _U_WEIGHT = (0.5 * (item + shift) for item, shift in zip(legendre.leggauss(8), (1.0, 0.0)))
# Noise of a weak order beside leakage that jitter explains: least share of its scatter, and rounds
# of its estimate.
_LEAST_NOISE, _ROUNDS = 0.03, 8
_TINY = float(np.finfo(np.float64).tiny)


@dataclass(frozen=True)
class AmplitudeErrors:
    """
    Standard errors (channel, order) of amplitudes and of phases (rad), and `upper_95`.

    The one-sided 95 % upper limit of the true amplitude holds for strong, weak and absent orders.
    All are NaN for one cycle.
    """

    amplitude: FloatArray
    phase: FloatArray
    upper_95: FloatArray

    @classmethod
    def of(cls, amplitudes: ComplexArray, along: FloatArray, across: FloatArray, *,
           largest: FloatArray | None = None, left: FloatArray | float = 1.0
           ) -> 'AmplitudeErrors':
        """
        Return those of `amplitudes` with errors `along` and `across` their radius.

        `largest` is the amplitude that the upper limit begins at, `left` what is left of the true
        one.
        """
        size = np.abs(amplitudes)
        limit = upper_limit(size if largest is None else largest, along) / left
        return cls(np.where(np.isnan(size), np.nan, along), _phase_error(size, across), limit)

    def over(self, gain: FloatArray) -> 'AmplitudeErrors':
        """Return those of the amplitudes over a `gain` (order,)."""
        return AmplitudeErrors(self.amplitude / gain, self.phase + 0.0 * gain,
                               self.upper_95 / gain)


def widened(error: FloatArray, freedom: FloatArray | float) -> FloatArray:
    """
    Return a standard error such that intervals of 1 and 1.96 of it hold.

    `error` was estimated with so many degrees of `freedom`. Of the t distribution with 4 (8)
    degrees, the intervals then contain 70.7 % and 92.4 % (70.1 % and 94.1 %).

    >>> widened(np.array([1.0]), 4.0)
    array([1.2125])
    """
    return np.asarray(error * (1.0 + 0.85 / np.maximum(freedom, 1.0)))


def waveform_error(waveform: FloatArray, error: FloatArray, count: int, jitter: float,
                   cycle_length: float) -> FloatArray:
    """
    Return the standard error (angle, channel) of the mean `waveform` of `count` cycles.

    `error` is their scatter over sqrt(count). An error of a pulse, whose standard deviation is
    `jitter` (fundamental cycles), moves what is less than a trigger cycle, `cycle_length`, away
    from it: neighbouring cycles move together.

    >>> waveform = np.cos(2.0 * np.pi * np.arange(64) / 64)[:, None]
    >>> error = waveform_error(waveform, np.full((64, 1), 1e-3), 100, 0.01, 1.0)
    >>> error[[0, 16], 0].round(4)
    array([0.001 , 0.0037])
    """
    if count < 2:
        return error
    lag = np.arange(1, min(math.ceil(2.0 * cycle_length), count))
    apart = lag / cycle_length
    # The mean of what two cycles so far apart have of a pulse in common is a cubic B-spline.
    common = np.where(apart < 1.0, 2.0 / 3.0 - apart**2 * (1.0 - 0.5 * apart),
                      (2.0 - apart) ** 3 / 6.0)
    shared = 2.0 / count * np.sum(common * (1.0 - lag / count))
    around = np.concatenate((waveform[-1:], waveform, waveform[:1]))
    moved = around[2:] - around[:-2]
    moved *= 0.5 * len(waveform) * math.sqrt(shared) * jitter
    moved *= moved
    moved += widened(error, count - 1.0) ** 2
    return np.sqrt(moved, out=moved)


def upper_limit(amplitude: FloatArray, error: FloatArray) -> FloatArray:
    """
    Return the one-sided 95 % upper limit of true amplitudes.

    `error` is the standard deviation of the real and of the imaginary part of the measured complex
    amplitude. Below its limit a true amplitude makes one as small as that measured in 5 % of all
    cases (Rice distribution). The limit is at least half an `error`.

    >>> upper_limit(np.array([0.0, 1.0, 10.0]), np.ones(3)).round(2)
    array([ 0.5 ,  2.29, 11.6 ])
    """
    measured, true = _rice_limits()
    ratio = amplitude / np.maximum(error, _TINY)
    limit = np.where(ratio < measured[-1], np.interp(ratio, measured, true),
                     ratio + true[-1] - measured[-1])
    return np.asarray(np.where(ratio < 1e6, limit * error, amplitude + 1.645 * error))


@lru_cache(maxsize=1)
def _rice_limits() -> tuple[FloatArray, FloatArray]:
    """Return amplitudes that true ones, in the second array, exceed in 95 % of all cases."""
    true = np.linspace(_LOWEST_LIMIT, 20.0, 400)
    return np.sqrt(chndtrix(0.05, 2.0, true**2)), true


def _phase_error(amplitude: FloatArray, across: FloatArray) -> FloatArray:
    """
    Return the standard error (rad) of the phase of amplitudes with an error `across` the radius.

    Where the phase is unknown it is that of any phase, pi / sqrt(3).
    """
    ratio = across / np.maximum(amplitude, _TINY)
    known = np.minimum(ratio, 1.0)
    return np.asarray(np.minimum(known / (1.0 - _TURNED * known**2), _UNKNOWN_PHASE))


@dataclass(frozen=True)
class Scatter:
    """
    Scatter of amplitudes of single cycles around their mean, each an array (channel, order).

    `noise` is the variance of one cycle along the radius, of a weak order in any direction, with
    its degrees of `freedom`, `leaked` the standard deviation that leakage of other orders adds to
    the mean; `radial` and `tangential` (cycle, channel, order) are the deviations of the cycles
    along and across the mean, without the leakage of known orders.
    """

    mean: ComplexArray
    noise: FloatArray
    freedom: FloatArray
    leaked: FloatArray
    radial: FloatArray
    tangential: FloatArray

    @classmethod
    def of(cls, cycles: ComplexArray, clean: ComplexArray) -> 'Scatter':
        """Return the scatter of `cycles` (cycle, channel, order), `clean` without leakage."""
        mean = clean.mean(axis=0)
        size = np.abs(mean)
        turned = clean * np.exp(-1j * np.angle(mean))
        radial, tangential = turned.real - size, turned.imag
        noises, freedoms, tones = _white(np.stack((radial, tangential), axis=1))
        both = noises.mean(axis=0)
        weak = len(cycles) * size**2 < _SHOWS * both
        noise = np.where(weak, both, noises[0])
        freedom = np.where(weak, 2.0, 1.0) * freedoms[0]
        noise = np.maximum(noise, (_ROUNDING * size) ** 2 + _TINY)
        leaked = np.hypot(_ANY_ANGLE * np.abs(cycles.mean(axis=0) - mean), np.sqrt(tones[0]))
        return cls(mean, noise, freedom, leaked, radial, tangential)

    @property
    def error_of_mean(self) -> FloatArray:
        """Return the standard error (channel, order) of the mean along the radius."""
        return np.hypot(widened(np.sqrt(self.noise / len(self.radial)), self.freedom), self.leaked)


def _white(series: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """
    Return the variance of white noise in `series` (cycle, ...), its freedom, and that of tones.

    The last is the variance that tones in the series, which are no noise, give to its mean.
    """
    count = len(series)
    lines = (count - 1) // 2
    if lines < _ROBUST_FROM:
        variance = np.sum(series**2, axis=0) / (count - 1)
        return variance, np.full(variance.shape, count - 1.0), np.zeros(variance.shape)
    power = scatter_power(series)
    floor = row_medians(power.reshape(lines, -1).T).reshape(power.shape[1:]) / np.log(2.0)
    for _ in range(3):
        noise = power <= _OUTLIER * floor
        floor = np.sum(power, axis=0, where=noise) / np.maximum(noise.sum(axis=0), 1)
    reach = count**3 * np.sin(pi * np.arange(1, lines + 1) / count) ** 2
    tones = np.where(noise, 0.0, power) / reach.reshape(-1, *(1,) * (series.ndim - 1))
    return floor, 2.0 * np.maximum(noise.sum(axis=0), 1), np.sum(tones, axis=0)


@dataclass(frozen=True)
class Repeatability:
    """
    How well the mean amplitudes of other cycles would repeat those of some cycles.

    Standard errors (channel, order) `along` and `across` their radius; `jitter` is the standard
    deviation of the pulse errors in fundamental cycles that `orders` show.
    """

    orders: FloatArray
    along: FloatArray
    across: FloatArray
    jitter: float

    @classmethod
    def of(cls, cycles: ComplexArray, clean: ComplexArray, orders: FloatArray, *,
           cycle_length: float = 1.0, jitter: float | None = None, kurtosis: float = _UNIFORM,
           corrected: Scatter | None = None) -> 'Repeatability':
        """
        Return that of amplitudes (cycle, channel, order) of trigger cycles.

        `clean` are the same without the leakage between the orders. `jitter` is known, or None:
        the cycles show it; `kurtosis` is that of the pulse errors, and `corrected` the scatter of
        the same cycles without them, if known. `cycle_length` is r. Errors are NaN for one cycle.
        """
        count = len(cycles)
        if count < 2:
            unknown = np.full(cycles.shape[1:], np.nan)
            return cls(orders, unknown, unknown, jitter or 0.0)
        scatter = Scatter.of(cycles, clean)
        size = np.maximum(np.abs(scatter.mean), math.sqrt(_TINY))
        turn = 2.0 * pi * orders * size
        shows = count * size**2 > _SHOWS * scatter.noise
        if jitter is not None:
            variance, known = jitter**2, np.inf
        elif count < _MANY:
            variance, known = _shown_variance(scatter, turn, shows), count - 1.0
        else:
            variance, known = _total_variance(scatter, turn, shows), np.inf
        noise, freedom = scatter.noise, scatter.freedom
        along = across = np.zeros(size.shape)
        if np.any(variance * np.sum(turn**2, where=shows) > _NO_LEAK * noise):
            mean = scatter.mean
            if corrected is not None:
                mean, noise, freedom = corrected.mean, corrected.noise, corrected.freedom
                shows = count * np.abs(mean) ** 2 > _SHOWS * noise
            jittered = _Jittered.of(np.where(shows, mean, 0.0), orders, variance, kurtosis,
                                    cycle_length, whole=corrected is not None)
            radius = np.exp(1j * np.angle(mean))
            # Many cycles show what errors of another shape than uniform ones shorten.
            beside = (shows & (count >= _MANY)) | (corrected is None and count > 2)
            if beside.any():
                noise, freedom = (np.where(beside, *pair) for pair in zip(
                    jittered.noise_beside(scatter, radius), (noise, freedom)))
            along, across = jittered.of_mean(radius, count)
        along = _together(noise / count, freedom, along, known)
        across = _together(noise / count, freedom, across, known)
        if count >= _MANY:
            lines = max(_LINES, round(_SHARE * count))
            near_zero = scatter_power(scatter.tangential)[:lines].mean(axis=0)
            across = np.where(shows, widened(np.sqrt(near_zero / count), 2.0 * lines), across)
        return cls(orders, np.hypot(along, scatter.leaked), np.hypot(across, scatter.leaked),
                   math.sqrt(variance))

    def errors(self, amplitudes: ComplexArray, least_jitter: float = 0.0) -> AmplitudeErrors:
        """
        Return the errors of mean `amplitudes` (channel, order).

        The upper limit is that of the true amplitude: without the loss by the jitter that the
        cycles show, or by `least_jitter` (fundamental cycles) if that is more.
        """
        turn = 2.0 * pi * self.orders * max(self.jitter, least_jitter)
        return AmplitudeErrors.of(amplitudes, self.along, self.across, left=_left(turn))


def _left(turn: FloatArray) -> FloatArray:
    """Return what normal or uniform jitter, whichever takes more, of `turn` (rad) leaves."""
    turn = np.clip(turn, 1e-6, 5.0)
    normal = np.exp(-0.25 * turn**2) * np.sqrt(pi) * erf(0.5 * turn) / turn
    width = np.sqrt(3.0) / pi * turn[:, None]  # of the uniform jitter in turns
    uniform = (np.sinc(width * (1.0 - _U)) * np.sinc(width * _U)) @ _U_WEIGHT
    return np.asarray(np.maximum(np.minimum(normal, uniform), _LEAST_LEFT))


def corrected_errors(scatter: Scatter, orders: FloatArray, *, amplitudes: ComplexArray,
                     unsure: FloatArray, largest: FloatArray, jitter: float) -> AmplitudeErrors:
    """
    Return the standard errors of corrected `amplitudes` (channel, order): how far from the truth.

    `scatter` is that of the cycles between corrected pulses, which shows the noise; `unsure`
    (channel, order) is the relative standard error of the correction, `largest` the amplitudes
    that it may have made smaller. The mean of the pulse errors, whose standard deviation is
    `jitter` (fundamental cycles), cannot be recovered: it turns all orders. NaN where the
    amplitude is.
    """
    size, noise = np.abs(amplitudes), scatter.error_of_mean
    common = 2.0 * pi * orders * jitter / np.sqrt(len(scatter.radial) + 1.0)
    along = np.sqrt(noise**2 + size**2 * (unsure**2 + _MODEL**2))
    return AmplitudeErrors.of(amplitudes, along, np.hypot(noise, size * common), largest=largest)


def _together(noise: FloatArray, freedom: FloatArray, jitter: FloatArray, known: float
              ) -> FloatArray:
    """
    Return the standard error of two variances that are known with so many degrees of freedom.

    Those of their sum are by Satterthwaite (1946).
    """
    both = noise + jitter
    return widened(np.sqrt(both), both**2 / np.maximum(
        noise**2 / freedom + jitter**2 / known, _TINY))


def kurtosis_of(errors: FloatArray) -> float:
    """
    Return the kurtosis of pulse errors (pulse,) of mean 0, as far as intervals need it.

    NaN are left out. It is at least 1.2, and at most that of normal errors.

    >>> round(kurtosis_of(np.linspace(-1.0, 1.0, 1001)), 3)
    1.8
    """
    squares = errors[np.isfinite(errors)] ** 2
    mean = float(squares.mean()) if squares.size else 0.0
    if not mean:
        return _UNIFORM
    return float(np.clip(np.mean((squares / mean) ** 2), *_KURTOSES))


def _nodes(kurtosis: float) -> tuple[FloatArray, FloatArray]:
    """
    Return nodes and weights of the mean over errors of a standard deviation of 1.

    It is exact up to the seventh power for a symmetric beta distribution of this `kurtosis`, which
    is uniform for 1.8, and normal for 3.

    >>> error, weight = _nodes(1.8)
    >>> [round(float(weight @ error**power), 3) for power in (2, 4, 6)]
    [1.0, 1.8, 3.857]
    """
    sixth = 5.0 * kurtosis**2 / (6.0 - kurtosis)
    total = (sixth - kurtosis) / (kurtosis - 1.0)
    apart = math.sqrt(0.25 * total**2 - total + kurtosis)
    squares = 0.5 * total + np.array([-apart, apart])
    weight = 0.25 + 0.5 * (1.0 - 0.5 * total) * np.array([-0.5, 0.5]) / apart
    error = np.sqrt(squares)
    return np.concatenate((-error, error)), np.concatenate((weight, weight))


@lru_cache(maxsize=16)
def _share_of_length(count: int, kurtosis: float) -> float:
    """
    Return which share of the variance along a mean of `count` cycles is that of its length.

    Errors of the pulses turn and shorten a phasor by a quadratic form of them; what turns all
    cycles together shortens nothing.
    """
    weight = np.ones(count + 1) / count
    weight[[0, -1]] *= 0.5
    own, beside = 2.0 / 3.0 * weight, 1.0 / (6.0 * count)
    squares = np.sum(own**2) + 2.0 * count * beside**2
    product = np.sum(own * weight**2) + 2.0 * beside * np.sum(weight[1:] * weight[:-1])
    length = 2.0 * (squares - 2.0 * product + np.sum(weight**2) ** 2) + (kurtosis - 3.0) * np.sum(
        (own - weight**2) ** 2)
    return float(length / (2.0 * squares + (kurtosis - 3.0) * np.sum(own**2)))


@dataclass(frozen=True)
class _Jittered:
    """
    What jitter of the pulses adds to amplitudes of single trigger cycles.

    `both` (2, channel, order) is the variance of the complex amplitude, and its covariance with
    the next cycle, `lean` the complex means of the products without a conjugate: what jitter adds
    lies along one direction more than across it. `own` are `both` of what an order does to itself
    along its radius, `shows` which orders do so.
    """

    shows: NDArray[np.bool_]
    both: FloatArray
    lean: ComplexArray
    own: FloatArray
    kurtosis: float

    @classmethod
    def of(cls, means: ComplexArray, orders: FloatArray, variance: float, kurtosis: float,
           cycle_length: float, *, whole: bool) -> '_Jittered':
        """
        Return what it does to `means` (channel, order), 0 of orders that do not show.

        It turns them, and makes them leak into all others. `whole` means are those without
        jitter. Pulse errors have this `variance`, which may be large, and `kurtosis`.
        """
        error, weight = _nodes(kurtosis)
        error = math.sqrt(variance) * error
        begin, end = error[:, None], error
        strong = np.flatnonzero(means.any(axis=0))
        signed = np.concatenate((orders[strong], -orders[strong]))[:, None, None, None]
        # The integral of exp(j 2 pi (signed begin + angle u)) over the cycle.
        angle = cycle_length * (signed - orders[:, None, None]) + signed * (end - begin)
        share = np.exp(1j * pi * (angle + 2.0 * signed * begin)) * np.sinc(angle)
        left = share @ weight @ weight
        share -= left[..., None, None]
        turned = np.arange(strong.size), strong
        size = means[:, strong]
        if not whole:
            size = size / np.maximum(np.abs(left[turned]), _LEAST_SHARE)
        own = np.zeros((2, *means.shape))
        alone = share[turned].real
        own[0][:, strong] = np.abs(size) ** 2 * (alone**2 @ weight @ weight)
        own[1][:, strong] = np.abs(size) ** 2 * ((weight @ alone) * (alone @ weight) @ weight)
        size = np.concatenate((size, np.conj(size)), axis=1)
        # Sources whose phases turn alike from cycle to cycle leak together.
        turns, alike = np.unique(np.mod(np.round(cycle_length * signed.ravel(), 6), 1.0),
                                 return_inverse=True)
        groups = np.where(alike == np.arange(turns.size)[:, None, None], size, 0.0)
        leaked = np.tensordot(groups, share, axes=1)  # (group, channel, order, begin, end)
        turn = np.exp(2j * np.pi * (cycle_length * orders - turns[:, None]))[:, None]
        steady = np.abs(turn - 1.0) < _ALIKE
        ended, begun = weight @ leaked, leaked @ weight  # what one and the same pulse does to both
        both = np.stack((np.abs(leaked) ** 2 @ weight @ weight,
                         (np.conj(ended) * begun @ weight * turn).real))
        lean = np.stack((leaked**2 @ weight @ weight * steady, ended * begun @ weight * steady))
        return cls(means != 0.0, both.sum(axis=1), lean.sum(axis=1), own, kurtosis)

    def seen(self, direction: ComplexArray) -> tuple[FloatArray, FloatArray]:
        """Return variance and covariance (2, channel, order) along and across unit phasors."""
        more = (self.lean * np.conj(direction) ** 2).real
        return 0.5 * (self.both + more), 0.5 * (self.both - more)

    def of_mean(self, radius: ComplexArray, count: int) -> tuple[FloatArray, FloatArray]:
        """Return the variances (channel, order) of the length of the mean, and across it."""
        def mean(pair: FloatArray) -> FloatArray:
            return np.asarray((count * pair[0] + 2.0 * (count - 1.0) * pair[1]) / count**2)

        along, across = self.seen(radius)
        turned = (1.0 - _share_of_length(count, self.kurtosis)) * mean(self.own)
        return np.maximum(mean(along) - turned, 0.0), np.maximum(mean(across), 0.0)

    def noise_beside(self, scatter: Scatter, radius: ComplexArray
                     ) -> tuple[FloatArray, FloatArray]:
        """
        Return the variance (channel, order) of noise in one cycle, and its freedom.

        Jitter of a pulse makes an order leak with opposite signs into the two cycles beside it,
        and always along one direction: the scatter of the cycles shows much of it, their mean
        little. What the spectrum of the scatter has beyond it is noise (maximum likelihood), along
        the radius of an order that shows, else along and across that direction.
        """
        count = len(scatter.radial)
        axis = np.where(self.shows, radius, np.exp(0.5j * np.angle(self.lean[0])))
        series = (scatter.radial + 1j * scatter.tangential) * np.where(
            self.shows, 1.0, radius * np.conj(axis))
        power = np.concatenate((scatter_power(series.real), scatter_power(series.imag)))
        lines = len(power) // 2
        cosine = 2.0 * np.cos(2.0 * pi * np.arange(1, lines + 1) / count)[:, None, None]
        expected = np.concatenate([
            variance + covariance * cosine for variance, covariance in self.seen(axis)])
        used = np.ones(power.shape, np.bool_)
        used[lines:] = ~self.shows
        noise = np.maximum(power.mean(axis=0, where=used), _TINY)
        least = _LEAST_NOISE * noise
        for _ in range(_ROUNDS):
            both = noise + expected
            weight = (noise / both) ** 2 * (used & (power < _OUTLIER * both))
            noise = np.maximum(np.sum(weight * (power - expected), axis=0)
                               / np.maximum(weight.sum(axis=0), _TINY), least)
        return noise, 2.0 * np.sum((noise / (noise + expected)) ** 2, axis=0, where=used)


def _total_variance(scatter: Scatter, turn: FloatArray, shows: NDArray[np.bool_]) -> float:
    """Return the variance of the pulse errors that turn many cycles as `_shown_variance` says."""
    noise, turn = scatter.noise[shows], turn[shows]
    turned = scatter.tangential[:, shows].var(axis=0, ddof=1) - noise
    return max(0.0, 2.0 * float(np.sum(turned / noise) / max(np.sum(turn**2 / noise), _TINY)))


def _shown_variance(scatter: Scatter, turn: FloatArray, shows: NDArray[np.bool_]) -> float:
    """
    Return the variance of the pulse errors that a few cycles show.

    Each pulse has an error of its own, the same for all orders: half of it turns the cycle before,
    half the one behind, by `turn` (channel, order) times the amplitude. The orders that stand
    above the noise count.
    """
    if not shows.any():
        return 0.0
    noise, turn = scatter.noise[shows], turn[shows]
    size = np.maximum(np.abs(scatter.mean)[shows], math.sqrt(_TINY))
    across = scatter.tangential[:, shows]
    angles = np.where(size**2 > _CLEAR * noise,
                      np.arctan2(across, size + scatter.radial[:, shows]), across / size)
    total = np.sum(turn**2 / noise)
    return _pulse_variance(angles @ (turn * size / noise) / total, 1.0 / total)


def _pulse_variance(series: FloatArray, noise: float) -> float:
    """
    Return the variance of pulse errors whose neighbours' means make `series`, with white noise.

    `noise` is its variance; the mean of the series is unknown.
    """
    count = len(series)
    transformed = fft.dst(np.stack((series, np.ones(count))), type=1, norm='ortho')
    shape = 0.5 * (1.0 + np.cos(pi * np.arange(1, count + 1) / (count + 1)))
    largest = 20.0 * max(float(np.var(series)), noise)
    sizes = np.append(0.0, largest * np.geomspace(1e-7, 1.0, 141))
    spectrum = noise + sizes[:, None] * shape
    ones = np.sum(transformed[1] ** 2 / spectrum, axis=1)
    both = np.sum(transformed[0] * transformed[1] / spectrum, axis=1)
    misfit = np.sum(transformed[0] ** 2 / spectrum, axis=1) - both**2 / ones
    deviance = np.log(spectrum).sum(axis=1) + np.log(ones) + misfit
    best = int(np.argmin(deviance))
    return float(sizes[best] * (1.0 - np.exp(0.5 * (deviance[best] - deviance[0]))))
