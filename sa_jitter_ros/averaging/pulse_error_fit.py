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

    x_k(u) = s(theta_k(u) + (1 - u) eps_k + u eps_{k+1}) + noise,

with `theta_k(u) = first_angle + r (k + u)` (Camerini et al. 2019, Eq. 16). Every order of `s` is
thus a carrier times a factor that varies slowly with `u`: a polynomial, given by its values at a
few Gauss nodes. Carriers times polynomials are the same in all cycles. One orthonormal basis of
them compresses every cycle to a short vector, in which white noise remains white and the phase
model exact. The leakage between orders is part of the model for every cycle length.

Amplitudes, noise, errors and their size are estimated in turn, with the covariance that the errors
have: amplitudes maximise the likelihood in which the errors are integrated out. Only neighbouring
pulses have a cycle in common, so that the normal matrix is tridiagonal: the time of a Gauss-Newton
step, of the standard errors, of the likelihood of a size and of a search on a grid is proportional
to the number of pulses.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import factorial, pi

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray
from sa_jitter_ros.arrays import ComplexArray, FloatArray
from sa_jitter_ros.averaging.grid_cycles import GridCycles
from sa_jitter_ros.averaging.neighbour_equations import shortest_path, Tridiagonal
from scipy.linalg import lapack, qr

_NODE_ERROR = 1e-4
_MOST_NODES = 20
_ITERATIONS = 25
# Iterations in which the size of the errors is estimated, and the change of an amplitude, over its
# value, at which the iterations end.
_SIZE_ITERATIONS, _CONVERGED = 6, 1e-4
# Sizes of the errors over the declared one, and their chances beforehand.
_SIZES = np.geomspace(0.05, 20.0, 41)
_DECLARED = 0.9
_CHANCES = (1.0 - _DECLARED) / _SIZES.size + _DECLARED * (np.arange(41) == 20)
# Information added where the vibration holds none, over the largest.
_SINGULAR = 1e-9
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

    `signal` are the orders, `late` the orders weighted with u, `expected` what uncertain errors
    leave of the orders in the mean.
    """

    signal: FloatArray
    late: FloatArray
    expected: FloatArray


@dataclass(frozen=True)
class CompressedCycles:
    """
    Trigger cycles as coefficients in an orthonormal basis around their orders.

    `coefficients` (cycle, dimension, channel); `blocks` (block,) is the first dimension of those
    with one level of noise, `block_of` (order,) the block of an order: each has its own unless
    the samples of a cycle are too few to keep them apart. The real part of `mixing[i]`
    (dimension, node) times the complex values of order i at its `nodes[i]` are coefficients;
    `start` (cycle, order) are the angles of the orders at the start of the cycles of `grid`, in
    turns.
    """

    coefficients: FloatArray
    orders: FloatArray
    blocks: NDArray[np.intp]
    block_of: NDArray[np.intp]
    nodes: tuple[FloatArray, ...]
    mixing: tuple[ComplexArray, ...]
    start: FloatArray
    grid: GridCycles

    @property
    def sizes(self) -> NDArray[np.intp]:
        """Return the number of dimensions of each block."""
        return np.diff(np.append(self.blocks, self.coefficients.shape[1]))

    def response(self, errors: FloatArray, chosen: Sequence[int] | NDArray[np.intp], *,
                 covariance: FloatArray | None = None) -> Response:
        """
        Return the response of `chosen` orders to `errors` (pulse,) in fundamental cycles.

        `covariance` (2, pulse) is that of the errors, with the next in the second row; None: they
        are known.
        """
        count, size, _ = self.coefficients.shape
        half, begins = len(chosen), self.grid.begins
        first, last = errors[begins], errors[begins + 1]
        out = np.zeros((3, count, size, 2 * half))
        for column, i in enumerate(chosen):
            u, mixing = self.nodes[i], self.mixing[i]
            turns = self.start[:, i, None] + self.orders[i] * (
                np.outer(first, 1.0 - u) + np.outer(last, u))
            values = np.exp(2j * pi * turns)
            left = 1.0 if covariance is None else np.exp(
                -2.0 * (pi * self.orders[i]) ** 2 * variance_within(covariance, u, begins))
            weighted = np.stack((values, values * u, values * left))
            mixed = (weighted.reshape(-1, len(u)) @ mixing.T).reshape(3, count, len(mixing))
            out[:, :, :len(mixing), column] = mixed.real
            out[:, :, :len(mixing), half + column] = -mixed.imag
        return Response(*out)

    def fitted(self, errors: FloatArray, chosen: Sequence[int] | NDArray[np.intp], *,
               covariance: FloatArray | None = None
               ) -> tuple[Response, ComplexArray, FloatArray]:
        """
        Return the `response` of `chosen` orders, fitted: it, amplitudes, and what is left.

        The amplitudes (order, channel) are the likeliest ones, the rest is one of coefficients.
        """
        response = self.response(errors, chosen, covariance=covariance)
        amplitudes = least_squares(response.signal, response.expected, self.coefficients)
        return response, amplitudes, self.coefficients - response.signal @ real_parts(amplitudes)


def compress(grid: GridCycles, *, cycle_length: float, first_angle: float, orders: FloatArray,
             spread: float) -> CompressedCycles:
    """
    Compress the trigger cycles of `grid`; sample i is at u = i / samples.

    `spread` is the largest difference between the errors of neighbouring pulses, in fundamental
    cycles, that the nodes must represent. The mean of every cycle, with offset and drift, is
    removed.
    """
    length, count, channels = grid.samples.shape
    u = np.arange(length) / length
    nodes, columns = [], [np.ones((len(u), 1))]
    for g in orders:
        x, through_nodes = _through_nodes(nodes_for(g * spread), u)
        wave = np.exp(2j * pi * g * cycle_length * u)[:, None] * through_nodes
        nodes.append(x)
        columns += [wave.real, -wave.imag]
    rows, flat = grid.compact(np.concatenate(columns, axis=1), cycle_length * float(orders.max()))
    basis, triangle = qr(rows, mode='economic', overwrite_a=True, check_finite=False)
    inside, triangle = basis[:, 1:].T @ flat, triangle[1:, 1:]  # orthogonal to a constant
    widths = np.array([len(x) for x in nodes])
    ends = 2 * np.cumsum(widths)
    mixing = tuple(triangle[:end, end - 2 * w:end - w] - 1j * triangle[:end, end - w:end]
                   for end, w in zip(ends, widths))
    coefficients = inside.reshape(-1, count, channels)
    start = np.multiply.outer(first_angle + cycle_length * grid.numbers, orders) % 1.0
    block_of = np.arange(len(orders))
    if ends[-1] > len(coefficients):
        block_of = np.zeros_like(block_of)
    return CompressedCycles(np.ascontiguousarray(coefficients.transpose(1, 0, 2)), orders,
                            (ends - 2 * widths)[:block_of[-1] + 1], block_of, tuple(nodes), mixing,
                            start, grid)


def _through_nodes(count: int, u: FloatArray) -> tuple[FloatArray, FloatArray]:
    """
    Return Gauss nodes in [0, 1] and the polynomials (u, node) that are 1 at one node each.

    They are sums of Legendre polynomials, for whose products Gauss quadrature is exact.
    """
    x, at_nodes = _at_nodes(count)
    sums = legendre.legvander(2.0 * u - 1.0, count - 1) * (np.arange(count) + 0.5)
    return 0.5 + 0.5 * x, sums @ at_nodes.T


@lru_cache(maxsize=_MOST_NODES)
def _at_nodes(count: int) -> tuple[FloatArray, FloatArray]:
    """Return Gauss nodes in [-1, 1], and Legendre polynomials (node, degree) there, weighted."""
    x, weight = legendre.leggauss(count)
    return x, legendre.legvander(x, count - 1) * weight[:, None]


def variance_within(covariance: FloatArray, u: FloatArray, begins: NDArray[np.int64]
                    ) -> FloatArray:
    """
    Return the variance (cycle, u) of the error between pulses of a `covariance` (2, pulse).

    The cycles begin at the pulses `begins` (cycle,).
    """
    (first, both), last = covariance[:, begins, None], covariance[0, begins + 1, None]
    return np.asarray((1.0 - u) ** 2 * first + 2.0 * u * (1.0 - u) * both + u**2 * last)


def least_squares(signal: FloatArray, expected: FloatArray, coefficients: FloatArray
                  ) -> ComplexArray:
    """
    Return the amplitudes (order, channel) that fit all cycles best (`Response.signal`).

    What uncertain errors leave of it, `expected`, enters the correlation with the cycles only: an
    error turns a phasor, whose power stays.
    """
    f = signal.reshape(-1, signal.shape[2])
    e = expected.reshape(f.shape)
    parts = np.linalg.lstsq(f.T @ f, e.T @ coefficients.reshape(len(f), -1), rcond=None)[0]
    half = len(parts) // 2
    return np.asarray(parts[:half] + 1j * parts[half:])


@dataclass(frozen=True)
class PulseErrorFit:
    """
    Result of a fit; times are in fundamental cycles.

    `expected` (pulse,) are the errors that vibration and jitter of the size `std` make likeliest,
    `covariance` (2, pulse) their variance and their covariance with the next one. `errors` and
    `standard_errors` (pulse,) are by the vibration alone. `evidence` is the logarithm of the
    likelihood of errors over that of none, `shown` the share of their variance that the vibration
    shows. `amplitudes` (order, channel) are those without the
    errors; those between the expected pulses are `aligned` times as large, because they align
    noise and leave errors; NaN where the order is not `significant`. `noise` (order, channel) is
    the standard deviation of the complex amplitude of one cycle. `weight` (dimension, channel) is
    one over the standard deviation of the noise in a dimension, `precision` the inverse of the
    covariance.
    """

    expected: FloatArray
    covariance: FloatArray
    errors: FloatArray
    standard_errors: FloatArray
    std: float
    evidence: float
    shown: float
    orders: FloatArray
    amplitudes: ComplexArray
    aligned: FloatArray
    noise: FloatArray
    weight: FloatArray
    precision: Tridiagonal

    @property
    def informative(self) -> NDArray[np.bool_]:
        """Return which orders (order,) the errors were fitted to."""
        return np.asarray(np.isfinite(self.aligned).any(axis=1))


@dataclass(frozen=True)
class PulseErrorProblem:
    """
    Fit of the `chosen` orders of `model`; all others count as noise.

    The errors are fitted to an order in the channels where it is `significant` (order, channel).
    """

    model: CompressedCycles
    chosen: NDArray[np.intp]
    significant: NDArray[np.bool_]

    def solve(self, errors: FloatArray, *, declared: float) -> PulseErrorFit:
        """
        Fit from `errors` on by expectation and maximisation.

        The expectation is a Gauss-Newton step for the errors: their mean and covariance, given
        amplitudes, noise and size. The maximisation fits the amplitudes to the vibration with the
        expected phasors of the errors, exp(j phase) times what their variance leaves of it, so
        that noise that moves the errors does not count as amplitude. `declared` is the likeliest
        standard deviation of the errors; their size is estimated with them (`estimated_size`).
        """
        model, orders = self.model, self.model.orders[self.chosen]
        channels, begins = model.coefficients.shape[2], model.grid.begins
        share = np.zeros((len(model.blocks), channels))
        covariance, std, shown = np.zeros((2, model.grid.pulses)), declared, 0.0
        amplitudes = np.zeros((len(orders), channels), np.complex128)
        for number in range(_ITERATIONS):
            before = amplitudes
            response, amplitudes, residual = model.fitted(
                errors, self.chosen, covariance=covariance)
            slope = real_parts(2j * pi * orders[:, None] * amplitudes * self.significant)
            last = response.late @ slope
            first = response.signal @ slope - last
            variance = self._variance(residual, share, shown)
            weight = 1.0 / np.sqrt(np.repeat(variance, model.sizes, axis=0))
            first *= weight
            last *= weight
            residual *= weight
            information = Tridiagonal(np.zeros(model.grid.pulses), np.zeros(model.grid.pulses - 1))
            information.diagonal[begins] += _dot(first, first)
            information.diagonal[begins + 1] += _dot(last, last)
            information.off_diagonal[begins] = _dot(first, last)
            pull = np.zeros(model.grid.pulses)
            pull[begins] += _dot(first, residual)
            pull[begins + 1] += _dot(last, residual)
            if number < _SIZE_ITERATIONS:
                std = estimated_size(information, information.times(errors) + pull, declared)
            shrunk = information.plus(std**-2)
            step = shrunk.solve(pull - errors * std**-2)
            step -= step.mean()
            errors = errors + step
            covariance = shrunk.covariance()
            shown = max(0.0, 1.0 - float(np.mean(covariance[0])) / std**2)
            of_order = np.add.reduceat((first**2 + last**2).sum(axis=0), model.blocks)
            share = of_order / of_order.sum()
            moved = np.abs(amplitudes - before)[self.significant]
            converged = np.all(moved < _CONVERGED * np.abs(amplitudes[self.significant]))
            if converged and np.max(np.abs(step)) < 0.02 * np.sqrt(np.min(covariance[0])):
                break
        evidence = log_likelihood(information, 0.0 * pull, np.array([std])).item() + 0.5 * (
            self._misfit_without_errors(weight) - np.sum(residual**2)
            - np.sum(errors**2) / std**2
            + np.log(information.times(np.ones(len(pull))).sum()))
        alone = information.plus(_SINGULAR * (float(information.diagonal.max()) + std**-2))
        unshrunk = errors - step + alone.solve(pull)
        unit = np.mean(np.sum(response.signal[:, :, :len(orders)] ** 2, axis=1), axis=0)
        noise = np.sqrt(2.0 * variance[model.block_of[self.chosen]] / unit[:, None])
        plain = np.abs(least_squares(response.signal, response.signal, model.coefficients))
        size = np.abs(amplitudes)
        aligned = np.divide(plain, size, out=np.full(plain.shape, np.nan),
                            where=self.significant & (size > 0.0))
        return PulseErrorFit(
            errors, covariance, unshrunk - unshrunk.mean(), np.sqrt(alone.covariance()[0]), std,
            evidence, shown, orders, amplitudes, aligned, noise, weight, shrunk)

    def _misfit_without_errors(self, weight: FloatArray) -> float:
        """Return the weighted square of what remains of the cycles without errors of pulses."""
        _, _, rest = self.model.fitted(np.zeros(self.model.grid.pulses), self.chosen)
        return float(np.sum((weight * rest) ** 2))

    def scan(self, width: float) -> FloatArray:
        """
        Return the errors on a grid that fit the cycles best, even over several turns of an order.

        Gauss-Newton then starts near the global optimum. `width` is that of the
        expected errors.
        """
        model, count = self.model, len(self.model.coefficients)
        _, amplitudes, rest = model.fitted(np.zeros(model.grid.pulses), self.chosen)
        variance = self._variance(rest, np.zeros(1), 0.0)
        weighted = model.coefficients / np.repeat(variance, model.sizes, axis=0)
        reach = _SCAN_REACH * width
        highest = model.orders[self.chosen][self.significant.any(axis=1)].max()
        steps = int(np.ceil(reach * highest * _SCAN_POINTS))
        levels = np.linspace(-0.5, 0.5, steps + 1) * reach
        start, end = (item.ravel() for item in np.meshgrid(levels, levels, indexing='ij'))
        score = np.zeros((len(start), count))
        for i, amplitude in zip(self.chosen, amplitudes * self.significant):
            turns = np.outer(start, 1.0 - model.nodes[i]) + np.outer(end, model.nodes[i])
            shape = np.exp(2j * pi * model.orders[i] * turns) @ model.mixing[i].T
            match = (weighted[:, :shape.shape[1]] @ amplitude).T
            score += (shape @ (match * np.exp(2j * pi * model.start[:, i]))).real
        misfit = np.zeros((model.grid.pulses - 1, len(levels), len(levels)))
        misfit[model.grid.begins] = -np.moveaxis(score.reshape(*misfit.shape[1:], count), 2, 0)
        path, _ = shortest_path([*np.zeros((model.grid.pulses, len(levels)))], [*misfit])
        return np.asarray(levels[path])

    def _variance(self, residual: FloatArray, share: FloatArray, shown: float) -> FloatArray:
        """
        Return the noise variance of one dimension (block, channel), from the median over cycles.

        `share` is the fraction of the information that a block and channel has; the fit of the
        errors removes this fraction of one dimension per cycle from its residual, or the share
        `shown` of it that the vibration shows of the errors.
        """
        count, size = len(residual), self.model.sizes[:, None]
        power = np.median(np.add.reduceat(residual**2, self.model.blocks, axis=1), axis=0)
        orders = np.bincount(self.model.block_of)[:, None]
        free = size - share * shown - 2.0 * orders / count
        variance = power / free / (1.0 - 2.0 / (9.0 * free)) ** 3  # median of chi-squared
        # Resampling and model are not exact.
        fitted = self.model.coefficients - residual
        floor = _FLOOR**2 * np.mean(np.sum(fitted**2, axis=1), axis=0) / size
        return np.asarray(np.maximum(np.maximum(variance, floor), np.finfo(float).tiny))


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the inner product in every cycle."""
    return np.asarray(np.einsum('kdc,kdc->k', a, b))


def log_likelihood(information: Tridiagonal, right: FloatArray, sizes: FloatArray) -> FloatArray:
    """
    Return the logarithm of the likelihood of standard deviations (size,) of pulse errors.

    Errors e have the likelihood exp(right' e - e' information e / 2) and are independent and
    normal but for a delay of all, which is unknown. All sizes make one chain, with no link
    between them.
    """
    precision = sizes[:, None] ** -2
    chain = Tridiagonal((information.diagonal + precision).ravel(), np.tile(
        np.append(information.off_diagonal, 0.0), sizes.size)[:-1])
    pivots, multipliers = chain.pivots()
    both = np.stack((np.tile(right, sizes.size), np.ones(pivots.size)), axis=1)
    through, common = lapack.dpttrs(pivots, multipliers, both)[0].T.reshape(2, sizes.size, -1)
    common = common * precision
    delay = common @ information.times(np.ones(len(right)))
    return np.asarray(0.5 * (
        through @ right - np.log(pivots.reshape(through.shape) / precision).sum(axis=1)
        + (common @ right) ** 2 / delay - np.log(delay)))


def estimated_size(information: Tridiagonal, right: FloatArray, declared: float
                   ) -> float:
    """
    Return the standard deviation of pulse errors (`log_likelihood`).

    The declared size is likely beforehand, and any other from a twentieth to twenty times as large
    has a chance; the geometric mean over all is returned. Where the vibration tells little, this
    is the declared size, else the one that maximises the restricted likelihood.
    """
    sizes = declared * _SIZES
    likelihood = log_likelihood(information, right, sizes)
    chance = np.exp(likelihood - likelihood.max()) * _CHANCES
    return float(np.exp(np.log(sizes) @ chance / chance.sum()))
