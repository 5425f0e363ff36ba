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
What the noise beside the lines makes of amplitudes between recovered pulses.

The error d of a recovered pulse error turns an order by 2 pi g d, which takes (2 pi g)^2 <d^2> / 2
of its mean; but the same noise turned the order before, and to turn it back adds
2 pi g <d Im n>, where n is the noise of the order over its amplitude. Of white noise the second is
twice the first. Of the lines of another shaft, or of a resonance, it is not: their noise differs
from order to order in shape, and goes on from cycle to cycle, so that neighbouring errors are
alike. A pulse error hides what the noise turns of a line, but noise is as strong in phase with it:
the part that is left in phase is taken for that across, and goes through the same equations.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.averaging.noise import long_run_variance
from sa_jitter_ros.averaging.pulse_error_fit import (PulseErrorFit, PulseErrorProblem,
                                                     real_parts)

# Relative step of a precision, in the derivative of a covariance.
_STEP = 1e-3
# The negative frequency of a line, farther from an order than the line, makes noise in phase with
# the order and across it differ by this share (a line a third of the order beside it).
_UNLIKE = 0.3
_LAGS = 8  # cycles over which the noise is taken to go on
# What noise leaves of an aligned amplitude at least: beyond, its square says nothing.
_LEAST = 0.5
_TINY = float(np.finfo(np.float64).tiny)


@dataclass(frozen=True)
class Alignment:
    """
    How much larger amplitudes between expected pulses are, as the noise beside the lines shows.

    `aligned` (order, channel) is that of orders that have told the errors, `aligned_error` its
    standard error; `excess` is the mean variance of the expected errors inside a cycle
    (fundamental cycles squared) beyond that of their covariance, `excess_error` its standard
    error. Each is the smaller, the less certain it is that the noise is not white.
    """

    aligned: FloatArray
    aligned_error: FloatArray
    excess: float
    excess_error: float


def alignment(problem: PulseErrorProblem, fit: PulseErrorFit) -> Alignment:
    """Return what the noise beside the lines of a `fit` of a `problem` makes of amplitudes."""
    turned, pull, unit = _in_phase(problem, fit)
    late, begins = fit.precision.solve(pull), problem.model.grid.begins
    late -= late.mean()
    begin, end = late[begins], late[begins + 1]
    power = np.maximum(np.abs(fit.amplitudes) ** 2 * unit[:, None], _TINY)
    gained = (begin[:, None, None] * turned[0] + end[:, None, None] * turned[1]) / power
    squares = (begin**2 + begin * end + end**2) / 3.0
    # What the errors are drawn to their mean by costs as much as they are uncertain by it.
    slower = fit.precision.plus(_STEP * fit.std**-2).covariance()
    expected = _mean_square(fit.covariance, begins)
    drawn = (expected - _mean_square(slower, begins)) / _STEP
    turn = (2.0 * np.pi * fit.orders[:, None]) ** 2
    larger, error = _shrunk(gained - 0.5 * turn * (squares[:, None, None] + drawn + expected))
    excess, excess_error = _shrunk(squares + drawn - expected)
    return Alignment(np.maximum(fit.aligned + larger, _LEAST), error, float(excess),
                     float(excess_error))


def _in_phase(problem: PulseErrorProblem, fit: PulseErrorFit
              ) -> tuple[FloatArray, FloatArray, FloatArray]:
    """
    Return the noise in phase with the lines, as it would turn them across.

    That are its products (pulse at begin or end, cycle, order, channel) with what an error of the
    pulse does, their weighted sums (pulse,), and the power (order,) of unit orders.
    """
    model, half = problem.model, len(fit.orders)
    response, _, residual = model.fitted(fit.expected, problem.chosen)
    size = 2.0 * np.pi * fit.orders[:, None] * fit.amplitudes * problem.significant
    slope, weighted = real_parts(size), residual * fit.weight**2
    pull = np.zeros(model.grid.pulses)
    turned = []
    for number, unit_orders in enumerate((response.signal - response.late, response.late)):
        both = np.matmul(unit_orders.transpose(0, 2, 1), residual) * slope
        turned.append(both[:, :half] + both[:, half:])
        pull[model.grid.begins + number] += np.einsum(
            'kdc,kdc->k', unit_orders @ slope, weighted)
    unit = np.mean(np.sum(response.signal[:, :, :half] ** 2, axis=1), axis=0)
    return np.array(turned), pull, unit


def _mean_square(covariance: FloatArray, begins: NDArray[np.int64]) -> float:
    """
    Return the mean variance inside a cycle of errors of a `covariance` (2, pulse).

    The cycles begin at the pulses `begins` (cycle,).
    """
    own, beside = covariance
    return float(np.mean(own[begins] + beside[begins] + own[begins + 1]) / 3.0)


def _shrunk(series: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the mean of a series (cycle, ...), smaller where it is uncertain, and its error."""
    mean = series.mean(axis=0)
    variance = long_run_variance(series - mean, _LAGS) / len(series)
    sure = np.maximum(1.0 - variance / np.maximum(mean**2, _TINY), 0.0)
    found = sure * mean
    return np.asarray(found), np.sqrt(variance + (_UNLIKE * found) ** 2)
