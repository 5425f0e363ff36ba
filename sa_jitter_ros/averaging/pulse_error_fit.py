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
Fit of pulse errors to the resampled trigger cycles: model, least squares, uncertainty.

A trigger cycle that is resampled between two wrong pulses contains the vibration `s` at wrong
angles,

    x_k(u) = s(theta_k(u) + (1 - u) eps_k + u eps_{k+1} + u (1 - u) ripple_k) + noise,

with `theta_k(u) = first_angle + r (k + u)` (Camerini et al. 2019, Eq. 16; the last term, a speed
ripple faster than the trigger rate, is not in the paper). Every order of `s` is thus a carrier
times a factor that varies slowly with `u`: a polynomial, given by its values at a few Gauss nodes.
Carriers times polynomials are the same in all cycles. One orthonormal basis of them compresses
every cycle to a short vector, in which white noise remains white and the phase model exact. The
leakage between orders is part of the model for every cycle length.

Amplitudes, noise and errors are estimated in turn. Only neighbouring pulses have a cycle in
common, so that the normal matrix is tridiagonal: the time of a Gauss-Newton step, of the standard
errors and of a search on a grid is proportional to the number of pulses.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import factorial, pi

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray
from scipy.linalg import qr, solveh_banded

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

_NODE_ERROR = 1e-4
_MOST_NODES = 20
_ITERATIONS = 25
# Grid points in a turn of the highest order, and the reach of the grid in widths of the jitter.
_SCAN_POINTS, _SCAN_REACH = 16, 1.8
# Error of resampling and model, as a fraction of the cycle.
_FLOOR = 2e-4


def nodes_for(swing: float) -> int:
    """
    Return the number of nodes for a phase that changes by up to `swing` turns over a cycle.

    The error of interpolation of exp(j a x) on [-1, 1], a = pi swing, is 2 (a/2)^n / n!.
    """
    half = 0.5 * pi * swing
    count = 3
    while count < _MOST_NODES and 2.0 * half**count / factorial(count) > _NODE_ERROR:
        count += 1
    return count


def real_parts(values: ComplexArray) -> FloatArray:
    """Return amplitudes (order, channel) in the form of `Response`: real, then imaginary parts."""
    return np.concatenate((values.real, values.imag))


@dataclass(frozen=True)
class Response:
    """
    Compressed cycles of unit orders: matrices (cycle, dimension, 2 orders) for `real_parts`.

    `signal` are the orders, `late` the orders weighted with u, `middle` with u (1 - u).
    """

    signal: FloatArray
    late: FloatArray
    middle: FloatArray


@dataclass(frozen=True)
class CompressedCycles:
    """
    Trigger cycles as coefficients in an orthonormal basis around their orders.

    `coefficients` (cycle, dimension, channel); `blocks` (order,) is the first dimension that was
    added for an order. The real part of `mixing[i]` (dimension, node) times the complex values of
    order i at its `nodes[i]` are coefficients; `start` (cycle, order) are the angles of the orders
    at the start of the cycles, in turns.
    """

    coefficients: FloatArray
    orders: FloatArray
    blocks: NDArray[np.intp]
    nodes: tuple[FloatArray, ...]
    mixing: tuple[ComplexArray, ...]
    start: FloatArray

    @property
    def sizes(self) -> NDArray[np.intp]:
        """Return the number of dimensions of each order."""
        return np.diff(np.append(self.blocks, self.coefficients.shape[1]))

    def response(self, errors: FloatArray, ripple: FloatArray,
                 chosen: Sequence[int] | NDArray[np.intp]) -> Response:
        """Return the response of `chosen` orders to `errors`, `ripple` in fundamental cycles."""
        count, half = len(ripple), len(chosen)
        shape = (3, count, self.coefficients.shape[1], 2 * half)
        out = np.zeros(shape)
        for column, i in enumerate(chosen):
            u, mixing = self.nodes[i], self.mixing[i]
            turns = self.start[:, i, None] + self.orders[i] * (
                np.outer(errors[:-1], 1.0 - u) + np.outer(errors[1:], u)
                + np.outer(ripple, u * (1.0 - u)))
            values = np.exp(2j * pi * turns)
            weighted = np.stack((values, values * u, values * (u * (1.0 - u))))
            mixed = weighted.reshape(-1, len(u)) @ mixing.T
            mixed = mixed.reshape(3, count, len(mixing))
            out[:, :, :len(mixing), column] = mixed.real
            out[:, :, :len(mixing), half + column] = -mixed.imag
        return Response(*out)


def compress(samples: FloatArray, *, cycle_length: float, first_angle: float, orders: FloatArray,
             spread: float) -> CompressedCycles:
    """
    Compress `samples` (sample, cycle, channel) of trigger cycles; sample i is at u = i / samples.

    `spread` is the largest difference between the errors of neighbouring pulses, in fundamental
    cycles, that the nodes must represent. The mean of every cycle, with offset and drift, is
    removed.
    """
    _, count, channels = samples.shape
    u = np.arange(len(samples)) / len(samples)
    nodes, columns = [], [np.ones((len(u), 1))]
    for g in orders:
        x, through_nodes = _through_nodes(nodes_for(g * spread), u)
        wave = np.exp(2j * pi * g * cycle_length * u)[:, None] * through_nodes
        nodes.append(x)
        columns += [wave.real, -wave.imag]
    basis, triangle = qr(np.concatenate(columns, axis=1), mode='economic', overwrite_a=True,
                         check_finite=False)
    basis, triangle = basis[:, 1:], triangle[1:, 1:]  # the part orthogonal to a constant
    widths = np.array([len(x) for x in nodes])
    ends = 2 * np.cumsum(widths)
    mixing = tuple(triangle[:end, end - 2 * w:end - w] - 1j * triangle[:end, end - w:end]
                   for end, w in zip(ends, widths))
    coefficients = (basis.T @ samples.reshape(len(u), -1)).reshape(-1, count, channels)
    start = np.multiply.outer(first_angle + cycle_length * np.arange(count), orders) % 1.0
    return CompressedCycles(np.ascontiguousarray(coefficients.transpose(1, 0, 2)), orders,
                            ends - 2 * widths, tuple(nodes), mixing, start)


def _through_nodes(count: int, u: FloatArray) -> tuple[FloatArray, FloatArray]:
    """
    Return Gauss nodes in [0, 1] and the polynomials (u, node) that are 1 at one node each.

    They are sums of Legendre polynomials, for whose products Gauss quadrature is exact.
    """
    x, weight = legendre.leggauss(count)
    sizes = np.arange(count) + 0.5
    at_nodes = legendre.legvander(x, count - 1) * weight[:, None]
    return 0.5 + 0.5 * x, (legendre.legvander(2.0 * u - 1.0, count - 1) * sizes) @ at_nodes.T


def least_squares(signal: FloatArray, coefficients: FloatArray) -> ComplexArray:
    """Return the amplitudes (order, channel) that fit all cycles best (`Response.signal`)."""
    f = signal.reshape(-1, signal.shape[2])
    parts = np.linalg.lstsq(f.T @ f, f.T @ coefficients.reshape(len(f), -1), rcond=None)[0]
    half = len(parts) // 2
    return np.asarray(parts[:half] + 1j * parts[half:])


def deviations(signal: FloatArray, residual: FloatArray) -> ComplexArray:
    """Return the deviation of amplitudes (cycle, order, channel) that a residual means."""
    parts = np.matmul(signal.transpose(0, 2, 1), residual)
    parts /= np.sum(signal * signal, axis=1)[:, :, None]
    half = signal.shape[2] // 2
    return np.asarray(parts[:, :half] + 1j * parts[:, half:])


@dataclass(frozen=True)
class PulseErrorFit:
    """
    Result of a fit: `errors` (pulse,), their `standard_errors` and `ripple` (cycle,).

    These are in fundamental cycles. `amplitudes` (order, channel) are those without the errors,
    `noise` (order, channel) the standard deviation of the complex amplitude of one cycle.
    """

    errors: FloatArray
    standard_errors: FloatArray
    ripple: FloatArray
    orders: FloatArray
    amplitudes: ComplexArray
    noise: FloatArray


@dataclass(frozen=True)
class PulseErrorProblem:
    """
    Fit of the `chosen` orders of `model`; all others count as noise.

    An order is used only in the channels where it is `significant` (order, channel).
    """

    model: CompressedCycles
    chosen: NDArray[np.intp]
    significant: NDArray[np.bool_]
    with_ripple: bool

    def solve(self, errors: FloatArray, *, expected: float) -> PulseErrorFit:
        """Fit by Gauss-Newton from `errors` on, with a prior of standard deviation `expected`."""
        model, orders = self.model, self.model.orders[self.chosen]
        count, _, channels = model.coefficients.shape
        ripple = np.zeros(count)
        share = np.zeros((len(model.orders), channels))
        prior = expected**-2
        for _ in range(_ITERATIONS):
            response = model.response(errors, ripple, self.chosen)
            amplitudes = least_squares(response.signal, model.coefficients)
            fitted = response.signal @ real_parts(amplitudes)
            residual = model.coefficients - fitted
            slope = real_parts(2j * pi * orders[:, None] * amplitudes * self.significant)
            last = response.late @ slope
            first = response.signal @ slope - last
            variance = self._variance(residual, fitted, share)
            weight = 1.0 / np.sqrt(np.repeat(variance, model.sizes, axis=0))
            first *= weight
            last *= weight
            residual *= weight
            if self.with_ripple:  # eliminate the ripple from the equations of its cycle
                middle = response.middle @ slope * weight
                size = np.sqrt(_dot(middle, middle))
                middle /= size[:, None, None]
                parts = [_dot(middle, item) for item in (first, last, residual)]
                first, last, residual = (item - middle * part[:, None, None] for item, part
                                         in zip((first, last, residual), parts))
            diagonal = np.zeros(count + 1)
            diagonal[:-1] += _dot(first, first)
            diagonal[1:] += _dot(last, last)
            off_diagonal = _dot(first, last)
            pull = -prior * errors
            pull[:-1] += _dot(first, residual)
            pull[1:] += _dot(last, residual)
            step = _solve(diagonal + prior, off_diagonal, pull)
            if self.with_ripple:
                ripple = ripple + (parts[2] - parts[0] * step[:-1] - parts[1] * step[1:]) / size
            step -= step.mean()
            errors = errors + step
            standard_errors = _standard_errors(diagonal + prior, off_diagonal)
            information = np.add.reduceat((first**2 + last**2).sum(axis=0), model.blocks)
            share = information / information.sum()
            if np.max(np.abs(step)) < 0.02 * np.min(standard_errors):
                break
        unit = np.mean(np.sum(response.signal[:, :, :len(orders)] ** 2, axis=1), axis=0)
        noise = np.sqrt(2.0 * variance[self.chosen] / unit[:, None])
        return PulseErrorFit(errors, standard_errors, ripple, orders, amplitudes, noise)

    def scan(self, width: float) -> FloatArray:
        """
        Return the errors on a grid that fit the cycles best, even over several turns of an order.

        Only neighbouring pulses have a cycle in common, so that dynamic programming finds the best
        of all sequences. Gauss-Newton then starts near the global optimum. `width` is that of the
        expected errors.
        """
        model, count = self.model, len(self.model.coefficients)
        signal = model.response(np.zeros(count + 1), np.zeros(count), self.chosen).signal
        amplitudes = least_squares(signal, model.coefficients)
        fitted = signal @ real_parts(amplitudes)
        variance = self._variance(model.coefficients - fitted, fitted, np.zeros(1))
        weighted = model.coefficients / np.repeat(variance, model.sizes, axis=0)
        reach = _SCAN_REACH * width
        steps = int(np.ceil(reach * model.orders[self.chosen].max() * _SCAN_POINTS))
        levels = np.linspace(-0.5, 0.5, steps + 1) * reach
        start, end = (item.ravel() for item in np.meshgrid(levels, levels, indexing='ij'))
        score = np.zeros((len(start), count))
        for i, amplitude in zip(self.chosen, amplitudes * self.significant):
            turns = np.outer(start, 1.0 - model.nodes[i]) + np.outer(end, model.nodes[i])
            shape = np.exp(2j * pi * model.orders[i] * turns) @ model.mixing[i].T
            match = (weighted[:, :shape.shape[1]] @ amplitude).T
            score += (shape @ (match * np.exp(2j * pi * model.start[:, i]))).real
        table = score.reshape(len(levels), len(levels), count)
        total, before = np.zeros(len(levels)), np.empty((count, len(levels)), np.intp)
        for k in range(count):
            arriving = total[:, None] + table[:, :, k]
            before[k] = arriving.argmax(axis=0)
            total = arriving.max(axis=0)
        path = [int(total.argmax())]
        for k in reversed(range(count)):
            path.append(int(before[k, path[-1]]))
        return np.asarray(levels[path[::-1]])

    def _variance(self, residual: FloatArray, fitted: FloatArray, share: FloatArray
                  ) -> FloatArray:
        """
        Return the noise variance of one dimension (order, channel), from the median over cycles.

        `share` is the fraction of the information that an order and channel has; the fit of the
        errors removes this fraction of one dimension per cycle from its residual.
        """
        count, size = len(residual), self.model.sizes[:, None]
        power = np.median(np.add.reduceat(residual**2, self.model.blocks, axis=1), axis=0)
        free = size - share * (2.0 if self.with_ripple else 1.0) - 2.0 / count
        variance = power / free / (1.0 - 2.0 / (9.0 * free)) ** 3  # median of chi-squared
        # Resampling and model are not exact.
        floor = _FLOOR**2 * np.mean(np.sum(fitted**2, axis=1), axis=0) / size
        return np.asarray(np.maximum(np.maximum(variance, floor), np.finfo(float).tiny))


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the inner product in every cycle."""
    return np.asarray(np.einsum('kdc,kdc->k', a, b))


def _solve(diagonal: FloatArray, off_diagonal: FloatArray, right: FloatArray) -> FloatArray:
    return np.asarray(solveh_banded(np.stack((np.append(0.0, off_diagonal), diagonal)), right))


def _standard_errors(diagonal: FloatArray, off_diagonal: FloatArray) -> FloatArray:
    """Return standard errors from a tridiagonal normal matrix, for errors with mean 0."""
    count = len(diagonal)
    down, up = diagonal.copy(), diagonal.copy()  # pivots of elimination from either end
    square = off_diagonal**2
    for k in range(1, count):
        down[k] -= square[k - 1] / down[k - 1]
        up[-1 - k] -= square[-k] / up[-k]
    common = _solve(diagonal, off_diagonal, np.ones(count))
    variance = 1.0 / (down + up - diagonal) - 2.0 * common / count + common.sum() / count**2
    return np.asarray(np.sqrt(variance))
