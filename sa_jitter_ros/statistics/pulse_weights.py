"""
Pulse weights: how an angle law passes the errors of its pulses on to the angle.

A law that reads pulses with the errors eps_k (fundamental cycles) reads cycle ``k`` at an angle
that is wrong by

    e_k(u) = sum_j h_j(u) eps_{k+j},    j = -before ... 1 + after,

``h_j`` being its cardinal functions: what it makes of one late pulse among even ones. The linear
law and the spline are linear in the pulse times, so for them this is exact; the quadratic law is
up to terms of the size eps/(trigger cycle) times eps. Eq. 16 of Camerini et al. 2019 for the
linear law.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.errors import ModelError
from scipy.interpolate import CubicSpline

Array = NDArray[Any]
#: ``covariance(u, v, lag)`` = Cov[e_k(u), e_{k+lag}(v)] in fundamental cycles squared.
Covariance = Callable[[Array, Array, int], Array]


@dataclass(frozen=True)
class PulseWeights:
    """
    The weights of an angle law, which reads `before` and `after` pulses beside a cycle's own two.

    ``at(u)`` returns the weights (before + 2 + after, *u.shape) of its pulses, first one first, at
    the positions `u` in the trigger cycle. `near` is a law much like it that reads few pulses.
    """

    before: int
    after: int
    at: Callable[[Array], Array]
    near: 'PulseWeights | None' = None

    @property
    def pulses(self) -> int:
        """Return how many pulses a cycle depends on."""
        return self.before + 2 + self.after

    def path(self, errors: Array, u: Array, cycles: int) -> Array:
        """
        Return the angle errors (..., cycles, u) of averages with known pulse errors.

        `errors` (..., n) are those of all pulses that the law reads, n = cycles - 1 + pulses, or
        of the average's own, n = cycles + 1: then those beside err as the first and the last one.
        """
        windows = np.lib.stride_tricks.sliding_window_view(
            self.padded(errors, cycles), self.pulses, axis=-1)
        return np.asarray(windows @ self.at(u))

    def padded(self, errors: Array, cycles: int) -> Array:
        """Return the errors (..., n) of all pulses that the law reads, see `path`."""
        if errors.shape[-1] != cycles + 1:
            return errors
        beside = [(0, 0)] * (errors.ndim - 1) + [(self.before, self.after)]
        return np.pad(errors, beside, mode='edge')

    def covariance(self, autocovariance: Callable[[Array], Array]) -> Covariance:
        """Return the covariance of the angle for pulses with Cov[eps_k, eps_{k+i}] at lag i."""
        index = np.arange(self.pulses)

        def covariance(u: Array, v: Array, lag: int) -> Array:
            of_pulses = autocovariance(lag + index - index[:, None])
            return np.asarray(np.einsum(
                'i...,i...->...', self.at(u), np.tensordot(of_pulses, self.at(v), 1)))

        return covariance


def _linear(u: Array) -> Array:
    return np.stack((1.0 - u, u))


def _quadratic(u: Array) -> Array:
    """Lagrange's polynomials: the law's inverse has the same slopes at even pulses."""
    return np.stack((0.5 * u * (u - 1.0), 1.0 - u * u, 0.5 * u * (u + 1.0)))


_SIDE = 8  # pulses that the spline reads on either side
_UNIT_SPLINES = CubicSpline(np.arange(2 * _SIDE + 2), np.eye(2 * _SIDE + 2))


def _spline(u: Array) -> Array:
    return np.moveaxis(_UNIT_SPLINES(_SIDE + u), -1, 0)


LINEAR = PulseWeights(0, 0, _linear)
_QUADRATIC = PulseWeights(1, 0, _quadratic)
_WEIGHTS = {'linear': LINEAR, 'quadratic': _QUADRATIC,
            'spline': PulseWeights(_SIDE, _SIDE, _spline, near=_QUADRATIC)}
ANGLE_LAWS = tuple(_WEIGHTS)


def pulse_weights(angle_law: str) -> PulseWeights:
    """Return the weights of a law by its name; raise ModelError for an unknown one."""
    if angle_law not in _WEIGHTS:
        raise ModelError(f'angle_law is {angle_law!r}: choose one of {", ".join(ANGLE_LAWS)}')
    return _WEIGHTS[angle_law]
