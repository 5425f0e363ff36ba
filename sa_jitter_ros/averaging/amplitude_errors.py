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
cycles is twice that of independent ones (Camerini et al. 2019, Eq. 32, leaves this out). From
`_MANY` cycles on the spectrum of the scatter near frequency zero shows what the mean has,
whatever its correlation; fewer cycles determine the standard deviation of one independent error
for each pulse, with all channels and orders together.

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
from scipy import fft
from scipy.special import chndtrix, erf

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# Cycles from which on the spectrum near zero is used, at least so many lines of it, and their
# share of the cycles.
_MANY, _LINES, _SHARE = 32, 4, 0.1
# Spectral lines from which on outliers are told from noise, and where they begin, times the noise.
_ROBUST_FROM, _OUTLIER = 8, 10.0
# Power of the mean over its noise from which on an order shows jitter, and of one cycle from
# which on its phase is that of its mean phasor.
_SHOWS, _CLEAR = 10.0, 10.0
# Uniform jitter shortens the mean phasor: so much of the square of its variance across is variance
# along the radius (exact moments up to 0.4 turns; Monte Carlo for the mean of a few cycles, whose
# own turn is no jitter to it), as a sum over all pairs of cycles, over that of a single cycle.
_ALONG, _OWN, _COMMON = 0.12, 1.6, 1.62
# The standard deviation of a phase of which nothing is known.
_UNKNOWN_PHASE = pi / np.sqrt(3.0)
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
# Uniform errors of a pulse by quadrature; jitter that leaves less than a share leaves an order
# whose amplitude is not known.
_NODES, _WEIGHTS = (item * scale for item, scale in zip(legendre.leggauss(4), (1.0, 0.5)))
_LEAST_SHARE = 0.3
# Jitter that cannot leak more than so much of the noise into a cycle does not matter.
_NO_LEAK = 0.01
_U, _U_WEIGHT = (0.5 * (item + shift) for item, shift in zip(legendre.leggauss(8), (1.0, 0.0)))
# Noise of a weak order beside leakage that jitter explains: least share of its scatter, and rounds
# of its estimate.
_LEAST_NOISE, _ROUNDS = 0.03, 8
# Degrees of freedom of what jitter shortens, the square of its variance, for each of the variance.
_GUESSED = 0.67
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

    @classmethod
    def unknown(cls, shape: tuple[int, ...]) -> 'AmplitudeErrors':
        """Return errors of which nothing is known."""
        return cls(*(np.full(shape, np.nan) for _ in range(3)))


def widened(error: FloatArray, freedom: FloatArray | float) -> FloatArray:
    """
    Return a standard error such that intervals of 1 and 1.96 of it hold.

    `error` was estimated with so many degrees of `freedom`. Of the t distribution with 4 (8)
    degrees, the intervals then contain 70.7 % and 92.4 % (70.1 % and 94.1 %).

    >>> widened(np.array([1.0]), 4.0)
    array([1.2125])
    """
    return np.asarray(error * (1.0 + 0.85 / np.maximum(freedom, 1.0)))


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
    # The sine of the error of the phase is the error across over the measured amplitude.
    return np.where(1.96 * ratio < 1.0, np.arcsin(np.minimum(ratio, 1.0)), np.where(
        np.isnan(ratio), np.nan, _UNKNOWN_PHASE))


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
        known = size > _TINY
        turned = clean * np.conj(np.where(known, mean, 1.0) / np.where(known, size, 1.0))
        radial, tangential = turned.real - size, turned.imag
        noise, freedom, tones = _white(radial)
        both = 0.5 * (noise + _white(tangential)[0])
        weak = len(cycles) * size**2 < _SHOWS * both
        noise, freedom = np.where(weak, both, noise), np.where(weak, 2.0, 1.0) * freedom
        noise = np.maximum(noise, (_ROUNDING * size) ** 2 + _TINY)
        leaked = np.hypot(_ANY_ANGLE * np.abs(cycles.mean(axis=0) - mean), np.sqrt(tones))
        return cls(mean, noise, freedom, leaked, radial, tangential)


def _spectrum(series: FloatArray) -> FloatArray:
    """Return the power of real series (cycle, ...) without frequency zero and Nyquist's."""
    count = len(series)
    lines = np.fft.rfft(series, axis=0)[1:(count - 1) // 2 + 1]
    return np.asarray((lines.real**2 + lines.imag**2) / count)


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
    power = _spectrum(series)
    floor = np.median(power, axis=0) / np.log(2.0)
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
    def of(cls, cycles: ComplexArray, clean: ComplexArray, orders: FloatArray,
           jitter: float | None = None, *, cycle_length: float = 1.0) -> 'Repeatability':
        """
        Return that of amplitudes (cycle, channel, order) of trigger cycles.

        `clean` are the same without the leakage between the orders; `jitter` is known, or None:
        the cycles show it. `cycle_length` is r. Errors are NaN for one cycle.
        """
        count = len(cycles)
        if count < 2:
            unknown = np.full(cycles.shape[1:], np.nan)
            return cls(orders, unknown, unknown, jitter or 0.0)
        scatter = Scatter.of(cycles, clean)
        size = np.maximum(np.abs(scatter.mean), math.sqrt(_TINY))
        turn = 2.0 * pi * orders * size
        shows = count * size**2 > _SHOWS * scatter.noise
        if count < _MANY:
            variance = _shown_variance(scatter, turn, shows) if jitter is None else jitter**2
            turned = turn**2 * variance * (1.0 - 0.5 / count)
            across = turned + scatter.noise
            guessed = turned**2 / (count - 1.0) if jitter is None else 0.0
            freedom = across**2 / np.maximum(
                guessed + scatter.noise**2 / scatter.freedom, _TINY)
        else:
            lines = max(_LINES, round(_SHARE * count))
            across = _spectrum(scatter.tangential)[:lines].mean(axis=0)
            freedom = np.full(across.shape, 2.0 * lines)
            turned = np.maximum(across - scatter.noise, 0.0)
            variance = _total_variance(scatter, turn, shows) if jitter is None else jitter**2
        # Jitter shortens a phasor in proportion to the square of its turn.
        shortened = _ALONG * (1.0 - _OWN / count) * turned**2 / size**2
        noise = np.maximum(scatter.noise - shortened / _COMMON, 0.0)
        guessed_from = np.inf if jitter is not None or count >= _MANY else (
            _GUESSED * (count - 1.0))
        along = np.sqrt(widened(np.sqrt(noise / count), scatter.freedom) ** 2
                        + widened(np.sqrt(shortened / count), guessed_from) ** 2
                        + scatter.leaked**2)
        across = np.hypot(widened(np.sqrt(across / count), freedom), scatter.leaked)
        if count > 2 and np.any(
                variance * np.sum(turn**2, where=shows) > _NO_LEAK * scatter.noise):
            beside = np.hypot(
                _own_noise(scatter, orders, shows, variance, cycle_length), scatter.leaked)
            short = np.where(shows, widened(np.sqrt(shortened / count), guessed_from), 0.0)
            along = np.minimum(along, np.hypot(beside, short))
            turned = widened(turn * math.sqrt(variance / count), guessed_from / _GUESSED)
            across = np.where(shows & (count >= _MANY), across,
                              np.minimum(across, np.hypot(beside, turned)))
        return cls(orders, along, across, float(np.sqrt(variance)))

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


def corrected_errors(cycles: ComplexArray, clean: ComplexArray, orders: FloatArray, *,
                     amplitudes: ComplexArray, unsure: FloatArray, largest: FloatArray,
                     jitter: float) -> AmplitudeErrors:
    """
    Return the standard errors of corrected `amplitudes` (channel, order): how far from the truth.

    `cycles` (cycle, channel, order) between corrected pulses show the noise, `clean` are the same
    without the leakage between the orders; `unsure` (channel, order) is the relative standard
    error of the correction, `largest` the amplitudes that it may have made smaller. The mean of
    the pulse errors, whose standard deviation is `jitter` (fundamental cycles), cannot be
    recovered: it turns all orders. NaN where the amplitude is.
    """
    scatter = Scatter.of(cycles, clean)
    size = np.abs(amplitudes)
    noise = np.hypot(widened(np.sqrt(scatter.noise / len(cycles)), scatter.freedom),
                     scatter.leaked)
    common = 2.0 * pi * orders * jitter / np.sqrt(len(cycles) + 1.0)
    along = np.sqrt(noise**2 + size**2 * (unsure**2 + _MODEL**2))
    return AmplitudeErrors.of(amplitudes, along, np.hypot(noise, size * common), largest=largest)


def _own_noise(scatter: Scatter, orders: FloatArray, shows: NDArray[np.bool_], variance: float,
               cycle_length: float) -> FloatArray:
    """
    Return the standard errors (channel, order) of means that noise and leaking orders give.

    Jitter of a pulse makes an order that `shows` leak into all others, with opposite signs in the
    two cycles beside it: the scatter of the cycles shows much of it, their mean little. What the
    spectrum of the scatter has beyond it is noise (maximum likelihood), along the radius of an
    order that shows, whose own jitter is across, else in both directions.
    """
    count = len(scatter.radial)
    power = _spectrum(scatter.radial)
    power = np.where(shows, power, 0.5 * (power + _spectrum(scatter.tangential)))
    alone, shared = _leaking(np.where(shows, scatter.mean, 0.0), orders, variance, cycle_length)
    omega = 2.0 * pi * np.arange(1, len(power) + 1)[:, None, None] / count
    expected = 0.5 * alone + shared * np.cos(omega)  # of a real part
    mean = 0.5 / count**2 * (count * alone + 2.0 * (count - 1.0) * shared)
    noise = np.maximum(power.mean(axis=0), _TINY)
    least = _LEAST_NOISE * noise
    for _ in range(_ROUNDS):
        weight = np.where(power < _OUTLIER * (noise + expected), 1.0, 0.0) * (
            noise / (noise + expected)) ** 2
        noise = np.maximum(np.sum(weight * (power - expected), axis=0)
                           / np.maximum(weight.sum(axis=0), _TINY), least)
    freedom = np.where(shows, 2.0, 4.0) * np.sum((noise / (noise + expected)) ** 2, axis=0)
    return np.hypot(widened(np.sqrt(noise / count), freedom), np.sqrt(np.maximum(mean, 0.0)))


def _leaking(sources: ComplexArray, orders: FloatArray, variance: float, cycle_length: float
             ) -> tuple[FloatArray, FloatArray]:
    """
    Return what jitter of the pulses makes `sources` (channel, order) leak into the other orders.

    The results are the variance (channel, order) of what leaks into a cycle, and its covariance
    with what leaks into the next one. Pulse errors are uniform with this `variance`, and may be
    large.
    """
    error = np.sqrt(3.0 * variance) * _NODES
    begin, end = error[:, None], error
    strong = np.flatnonzero(sources.any(axis=0))
    signed = np.concatenate((orders[strong], -orders[strong]))[:, None, None, None]
    # The integral of exp(j 2 pi (signed begin + angle u)) over the cycle.
    angle = cycle_length * (signed - orders[:, None, None]) + signed * (end - begin)
    share = np.exp(1j * pi * (angle + 2.0 * signed * begin)) * np.sinc(angle)
    own = np.arange(strong.size), strong
    left = np.abs(share[own] @ _WEIGHTS @ _WEIGHTS)
    share[own] = 0.0
    share -= (share @ _WEIGHTS @ _WEIGHTS)[..., None, None]
    size = sources[:, strong] / np.maximum(left, _LEAST_SHARE)
    size = np.concatenate((size, np.conj(size)), axis=1)
    # Sources whose phases turn alike from cycle to cycle leak together.
    turns, alike = np.unique(np.mod(np.round(cycle_length * signed.ravel(), 6), 1.0),
                             return_inverse=True)
    groups = np.where(alike == np.arange(turns.size)[:, None, None], size, 0.0)
    leaked = np.tensordot(groups, share, axes=1)  # (group, channel, order, begin, end)
    turn = np.exp(2j * pi * (cycle_length * orders - turns[:, None]))[:, None]
    shared = np.conj(_WEIGHTS @ leaked) * (leaked @ _WEIGHTS) @ _WEIGHTS * turn
    return (np.abs(leaked) ** 2 @ _WEIGHTS @ _WEIGHTS).sum(axis=0), shared.real.sum(axis=0)


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
