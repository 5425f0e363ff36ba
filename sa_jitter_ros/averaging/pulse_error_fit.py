"""
The least-squares problem of the pulse errors: Gauss-Newton on a tridiagonal normal matrix.

Amplitudes, noise and errors are estimated in turn. Every pulse shares cycles with its two
neighbours only, so that a step, the standard errors and a search on a grid all take time in
proportion to the number of pulses.
"""

from dataclasses import dataclass
from math import pi

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.averaging.pulse_error_model import (ComplexArray, CompressedCycles, FloatArray,
                                                       real_parts)
from sa_jitter_ros.averaging.synchronous_orders import least_squares
from scipy.linalg import solveh_banded

_ITERATIONS = 25
# Grid points in a turn of the highest order, and the reach of the grid in widths of the jitter.
_SCAN_POINTS, _SCAN_REACH = 16, 1.8
# What resampling and the model get wrong of a cycle, as a share of it.
_FLOOR = 2e-4


@dataclass(frozen=True)
class PulseErrorFit:
    """
    What was fitted, in fundamental cycles.

    `errors` (pulse,) with their `standard_errors`, `ripple` (cycle,).

    `amplitudes` (order, channel) are those without the errors, `noise` (order, channel) the
    standard deviation of one cycle's complex amplitude.
    """

    errors: FloatArray
    standard_errors: FloatArray
    ripple: FloatArray
    orders: FloatArray
    amplitudes: ComplexArray
    noise: FloatArray
    iterations: int


@dataclass(frozen=True)
class PulseErrorProblem:
    """
    Fit of the `chosen` orders of `model`; all others are left to the noise.

    An order tells of the errors in those channels only where it is `significant` (order, channel).
    """

    model: CompressedCycles
    chosen: NDArray[np.intp]
    significant: NDArray[np.bool_]
    with_ripple: bool

    def solve(self, errors: FloatArray, *, expected: float) -> PulseErrorFit:
        """Gauss-Newton from `errors`, with a prior of standard deviation `expected`."""
        model, orders = self.model, self.model.orders[self.chosen]
        count, _, channels = model.coefficients.shape
        ripple = np.zeros(count)
        share = np.zeros((len(model.orders), channels))
        prior = expected**-2
        iterations, converged = 0, False
        while not converged and iterations < _ITERATIONS:
            iterations += 1
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
            if self.with_ripple:  # eliminated from the equations of its cycle
                middle = response.middle @ slope * weight
                size = np.sqrt(_dot(middle, middle))
                middle /= size[:, None, None]
                parts = [_dot(middle, item) for item in (first, last, residual)]
                first, last, residual = (item - middle * part[:, None, None] for item, part
                                         in zip((first, last, residual), parts))
            diagonal = np.zeros(count + 1)
            diagonal[:-1] += _dot(first, first)
            diagonal[1:] += _dot(last, last)
            beside = _dot(first, last)
            pull = -prior * errors
            pull[:-1] += _dot(first, residual)
            pull[1:] += _dot(last, residual)
            step = _solve(diagonal + prior, beside, pull)
            if self.with_ripple:
                ripple = ripple + (parts[2] - parts[0] * step[:-1] - parts[1] * step[1:]) / size
            step -= step.mean()
            errors = errors + step
            standard_errors = _standard_errors(diagonal + prior, beside)
            information = np.add.reduceat((first**2 + last**2).sum(axis=0), model.blocks)
            share = information / information.sum()
            converged = np.max(np.abs(step)) < 0.02 * np.min(standard_errors)
        unit = np.mean(np.sum(response.signal[:, :, :len(orders)] ** 2, axis=1), axis=0)
        noise = np.sqrt(2.0 * variance[self.chosen] / unit[:, None])
        return PulseErrorFit(errors, standard_errors, ripple, orders, amplitudes, noise,
                             iterations)

    def scan(self, width: float) -> FloatArray:
        """
        Errors on a grid that match the cycles best, however many turns of an order they make.

        Neighbouring pulses share a cycle and no others do, so that dynamic programming finds the
        best sequence of all; it starts Gauss-Newton in the right valley. `width` is that of the
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
        Noise variance of one dimension (order, channel): the median over the cycles.

        `share` is each one's part of the information; the fit of the errors has taken as much of
        one dimension a cycle from its residual.
        """
        count, size = len(residual), self.model.sizes[:, None]
        power = np.median(np.add.reduceat(residual**2, self.model.blocks, axis=1), axis=0)
        free = size - share * (2.0 if self.with_ripple else 1.0) - 2.0 / count
        variance = power / free / (1.0 - 2.0 / (9.0 * free)) ** 3  # median of chi-squared
        # Neither resampling nor the model is exact.
        floor = _FLOOR**2 * np.mean(np.sum(fitted**2, axis=1), axis=0) / size
        return np.asarray(np.maximum(np.maximum(variance, floor), np.finfo(float).tiny))


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """Inner product in every cycle."""
    return np.asarray(np.einsum('kdc,kdc->k', a, b))


def _solve(diagonal: FloatArray, beside: FloatArray, right: FloatArray) -> FloatArray:
    return np.asarray(solveh_banded(np.stack((np.append(0.0, beside), diagonal)), right))


def _standard_errors(diagonal: FloatArray, beside: FloatArray) -> FloatArray:
    """Return standard errors from a tridiagonal normal matrix, the errors' mean being 0."""
    count = len(diagonal)
    down, up = diagonal.copy(), diagonal.copy()  # pivots of elimination from either end
    square = beside**2
    for k in range(1, count):
        down[k] -= square[k - 1] / down[k - 1]
        up[-1 - k] -= square[-k] / up[-k]
    common = _solve(diagonal, beside, np.ones(count))
    variance = 1.0 / (down + up - diagonal) - 2.0 * common / count + common.sum() / count**2
    return np.asarray(np.sqrt(variance))
