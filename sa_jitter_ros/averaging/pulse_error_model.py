"""
What pulse errors do to the resampled trigger cycles, in a form that is cheap to fit.

A trigger cycle resampled between two wrong pulses reads the vibration `s` at a wrong angle,

    x_k(u) = s(theta_k(u) + (1 - u) eps_k + u eps_{k+1} + u (1 - u) ripple_k) + noise,

with `theta_k(u) = first_angle + r (k + u)` (Camerini et al. 2019, Eq. 16; the last term, a speed
that ripples faster than the trigger, is not in the paper). Every order of `s` is thus a carrier
times a factor that varies slowly with `u`: a polynomial, fixed by its values at a few Gauss nodes.
Carriers times polynomials are the same in all cycles, so that one orthonormal basis of them
compresses every cycle to a short vector in which white noise stays white, the phase model stays
exact, and the leakage between orders is part of the model, whatever the ratio.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import factorial, pi

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray
from scipy.linalg import qr

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

_NODE_ERROR = 1e-4
_MOST_NODES = 20


def nodes_for(swing: float) -> int:
    """
    Count the nodes that follow a phase which turns by up to `swing` turns over a cycle.

    The error of interpolation of exp(j a x) on [-1, 1], a = pi swing, is 2 (a/2)^n / n!.
    """
    half = 0.5 * pi * swing
    count = 3
    while count < _MOST_NODES and 2.0 * half**count / factorial(count) > _NODE_ERROR:
        count += 1
    return count


def real_parts(values: ComplexArray) -> FloatArray:
    """Stack amplitudes (order, channel) as `Response` takes them: real above imaginary parts."""
    return np.concatenate((values.real, values.imag))


@dataclass(frozen=True)
class Response:
    """
    Compressed cycles of unit orders: matrices (cycle, dimension, 2 orders) for `real_parts`.

    `signal` is the orders themselves, `late` the orders weighted with u, `middle` with u (1 - u).
    """

    signal: FloatArray
    late: FloatArray
    middle: FloatArray


@dataclass(frozen=True)
class CompressedCycles:
    """
    Trigger cycles as coefficients in an orthonormal basis around their orders.

    `coefficients` (cycle, dimension, channel); `blocks` (order,) is the first dimension that was
    added for an order; `mixing[i]` (dimension, node) takes the complex values of order i at its
    `nodes[i]` to coefficients (the real part); `start` (cycle, order) are the angles of the orders
    where the cycles start, in turns.
    """

    coefficients: FloatArray
    orders: FloatArray
    blocks: NDArray[np.intp]
    nodes: tuple[FloatArray, ...]
    mixing: tuple[ComplexArray, ...]
    start: FloatArray

    @property
    def sizes(self) -> NDArray[np.intp]:
        """Dimensions of every order's block."""
        return np.diff(np.append(self.blocks, self.coefficients.shape[1]))

    def response(self, errors: FloatArray, ripple: FloatArray,
                 chosen: Sequence[int] | NDArray[np.intp]) -> Response:
        """Response of the `chosen` orders to pulse `errors` and `ripple` in fundamental cycles."""
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


def compress(samples: FloatArray, *, ratio: float, first_angle: float, orders: FloatArray,
             spread: float) -> CompressedCycles:
    """
    Compress `samples` (sample, cycle, channel) of trigger cycles.

    Sample i is at u = i / len(samples).

    `spread` is the largest difference to follow between errors of neighbouring pulses, in
    fundamental cycles. The mean of every cycle is left out, and with it offset and drift.
    """
    _, count, channels = samples.shape
    u = np.arange(len(samples)) / len(samples)
    nodes, columns = [], [np.ones((len(u), 1))]
    for g in orders:
        x, through_nodes = _through_nodes(nodes_for(g * spread), u)
        wave = np.exp(2j * pi * g * ratio * u)[:, None] * through_nodes
        nodes.append(x)
        columns += [wave.real, -wave.imag]
    basis, triangle = qr(np.concatenate(columns, axis=1), mode='economic', overwrite_a=True,
                         check_finite=False)
    basis, triangle = basis[:, 1:], triangle[1:, 1:]  # what is orthogonal to a constant
    widths = np.array([len(x) for x in nodes])
    ends = 2 * np.cumsum(widths)
    mixing = tuple(triangle[:end, end - 2 * w:end - w] - 1j * triangle[:end, end - w:end]
                   for end, w in zip(ends, widths))
    coefficients = (basis.T @ samples.reshape(len(u), -1)).reshape(-1, count, channels)
    start = np.multiply.outer(first_angle + ratio * np.arange(count), orders) % 1.0
    return CompressedCycles(np.ascontiguousarray(coefficients.transpose(1, 0, 2)), orders,
                            ends - 2 * widths, tuple(nodes), mixing, start)


def _through_nodes(count: int, u: FloatArray) -> tuple[FloatArray, FloatArray]:
    """
    Return Gauss nodes in [0, 1] and the polynomials (u, node) that are 1 at one of them each.

    Gauss quadrature is exact for what these are made of: products of Legendre polynomials.
    """
    x, weight = legendre.leggauss(count)
    sizes = np.arange(count) + 0.5
    at_nodes = legendre.legvander(x, count - 1) * weight[:, None]
    return 0.5 + 0.5 * x, (legendre.legvander(2.0 * u - 1.0, count - 1) * sizes) @ at_nodes.T
