# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Pulses that were found without a tach: their errors, and what these do to an average."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
import math
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from sa_jitter_ros.arrays import BoolArray, ComplexArray, FloatArray
from sa_jitter_ros.averaging.average import Average
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.parameters import numbers
from sa_jitter_ros.tacholess.phase import Phase
from scipy.sparse import csr_matrix

_MOST_PULSES = 6000  # of which the covariance is given at once: 300 MB
_WINDOWS = 8  # averages of a recording for which their attenuation is found
_DRAWS = 400
_SAME = 1e-6  # relative


@dataclass(frozen=True)
class ExpectedAmplitudes:
    """
    What the errors of found pulses do to an average of some revolutions.

    `orders` are multiples of the tach shaft. `attenuation` (order,) is the mean, and
    `standard_deviation` (order,) that over averages, of the amplitude of a line that was not used
    to find the pulses, over the true one. `factor` (order,) is the mean of what is
    measured over what is true: a line that was `used` (order,) is too large, because its
    own noise is aligned with itself.
    """

    orders: FloatArray
    attenuation: FloatArray
    standard_deviation: FloatArray
    factor: FloatArray
    used: BoolArray


@dataclass(frozen=True)
class CorrectedAmplitudes:
    """
    Amplitudes of an average by found pulses, and how they were corrected.

    `amplitudes` (channel, order) are complex peaks with `standard_errors`; `expected` is what was
    undone; `how` (order,) says whether the noise of an order had a part in the pulses.
    """

    amplitudes: ComplexArray
    standard_errors: FloatArray
    expected: ExpectedAmplitudes
    how: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class FoundPulses:
    """
    Pulses of the tach shaft that were found without a tach, one a revolution.

    `times` (pulse,) in s, with `standard_errors` (pulse,) about an angle that is arbitrary but
    constant; `speed` (pulse,) in Hz with `speed_standard_errors`. `orders` are those of the comb;
    `used` are those of them whose phase was used. `reason` says why the pulses do
    not cover the recording, '' if they do. Errors of neighbouring pulses are alike: the jitter of
    single pulses says nothing of them, `covariance` does.

    >>> rng = np.random.default_rng(2)
    >>> time = np.arange(60_000) / 4e3
    >>> mesh = np.cos(2 * np.pi * 23 * (24 * time + 0.1 * np.sin(time)) * np.array([[1], [2]]))
    >>> from sa_jitter_ros.tacholess.find import find_pulses
    >>> found = find_pulses(mesh.sum(axis=0) + rng.normal(0, 0.5, time.size), 4e3,
    ...                     orders=[23, 46], speed_range=(20, 30))
    >>> found.used, found.times.size > 300, found.expected([23], 50).attenuation.round(2)
    ((23.0, 46.0), True, array([1.]))
    """

    times: FloatArray
    standard_errors: FloatArray
    speed: FloatArray
    speed_standard_errors: FloatArray
    orders: tuple[float, ...]
    used: tuple[float, ...]
    reason: str
    start_time: float
    _phase: Phase = field(repr=False)
    _rows: csr_matrix = field(repr=False)
    _expected: dict[tuple[bytes, int], ExpectedAmplitudes] = field(
        init=False, repr=False, default_factory=dict)

    @classmethod
    def between(cls, phase: Phase, first: int, last: int, start: float, orders: FloatArray,
                reason: str) -> 'FoundPulses':
        """Return the pulses between two nodes of a phase."""
        ends = phase.states[[first, last], 0]
        times = phase.times_of(np.arange(math.ceil(ends[0]), math.floor(ends[1]) + 1))
        rows, speed = phase.rows(times), phase.speed(times)
        # About the mean over all pulses: what they have in common is the arbitrary angle.
        mean = rows @ phase.posterior.solved(np.asarray(rows.mean(axis=0)).reshape(-1, 1))[:, 0]
        variance = phase.variance(rows) - 2.0 * mean + mean.mean()
        return cls(times + start, np.sqrt(np.maximum(variance, 0.0)) / speed, speed,
                   np.sqrt(phase.variance(phase.rows(times, speed=True))), tuple(orders.tolist()),
                   tuple(phase.cells.orders.tolist()), reason, start, phase, rows)

    def angle_covariance(self, first: int, count: int) -> FloatArray:
        """Return the covariance (pulse, pulse) in rad^2 of the angle at pulses in a row."""
        rows = self._rows[first:first + count]
        found = rows @ self._phase.posterior.solved(rows.T.toarray())
        return np.asarray((2.0 * math.pi) ** 2 * found)

    @cached_property
    def covariance(self) -> FloatArray:
        """
        Return covariances (pulse, pulse) of the times in s^2, about the arbitrary angle.

        Raises ParameterError for more than 6000 pulses: `angle_covariance` gives parts of it.
        """
        count = len(self.times)
        if count > _MOST_PULSES:
            raise ParameterError(f'covariance of {count} pulses: it is given for up to '
                                 f'{_MOST_PULSES}; angle_covariance(first, count) gives parts')
        found = self.angle_covariance(0, count)
        found = found - found.mean(axis=0)
        found = found - found.mean(axis=1, keepdims=True)
        scale = 2.0 * math.pi * self.speed
        return np.asarray(found / np.multiply.outer(scale, scale))

    def expected(self, orders: ArrayLike, revolutions: int) -> ExpectedAmplitudes:
        """
        Return what an average of so many revolutions loses, or gains, at orders of the tach shaft.

        Only errors within an average count: its own phase is as arbitrary as that of the shaft.
        Raises ParameterError for fewer than 2 revolutions, or more than there are.
        """
        wanted = np.asarray(numbers('orders', orders))
        if (wanted.tobytes(), revolutions) not in self._expected:
            self._expected[wanted.tobytes(), revolutions] = self._find_expected(
                wanted, revolutions)
        return self._expected[wanted.tobytes(), revolutions]

    def _find_expected(self, wanted: FloatArray, revolutions: int) -> ExpectedAmplitudes:
        whole = len(self.times) - 1
        if not 2 <= revolutions <= whole:
            raise ParameterError(f'revolutions is {revolutions}: give 2 to {whole}, those between '
                                 'the pulses')
        windows = min(_WINDOWS, whole // revolutions)
        mean, square, inside = np.zeros((3, len(wanted)))
        for begin in np.linspace(0, whole - revolutions, windows).astype(int):
            errors = self.angle_covariance(begin, revolutions + 1)
            size = _amplitudes(errors, wanted, begin)
            mean += size.mean(axis=0) / windows
            square += (size**2).mean(axis=0) / windows
            within = np.trace(errors) / len(errors) - errors.mean()
            inside += wanted**2 * within / windows
        used = among(wanted, self.used)
        return ExpectedAmplitudes(
            wanted, mean, np.sqrt(np.maximum(square - mean**2, 0.0)),
            np.where(used, mean * np.exp(inside), mean), used)

    def save(self, path: Path) -> None:
        """Write the pulses with their errors to a .npz file, with the names of a recording."""
        np.savez(path, pulse_times=self.times, pulses_per_revolution=1,
                 standard_errors=self.standard_errors, speed=self.speed,
                 speed_standard_errors=self.speed_standard_errors, used_orders=self.used)

    def bridged(self, pulse_times: ArrayLike, pulses_per_revolution: int = 1) -> FloatArray:
        """
        Return the pulses of a tach (pulse,) in s with those that it lost put in.

        They divide each gap evenly by the angle found. Gaps beyond the pulses found stay.
        """
        times = np.sort(np.asarray(pulse_times, dtype=np.float64))
        inside = (times >= self.times[0]) & (times <= self.times[-1])
        angle = self._phase.angle(times - self.start_time)
        count = np.rint(np.diff(angle) * pulses_per_revolution).astype(int)
        lost = [np.linspace(angle[k], angle[k + 1], count[k] + 1)[1:-1]
                for k in np.flatnonzero((count > 1) & inside[1:] & inside[:-1])]
        if not lost:
            return times
        return np.sort(np.concatenate([times, self.start_time + self._phase.times_of(
            np.concatenate(lost))]))

    def correct(self, average: Average, *, ratio: float = 1.0) -> CorrectedAmplitudes:
        """
        Return the amplitudes of an average by these pulses, without what their errors did.

        `ratio` is that of the average. Lines whose phase was used to find the pulses are freed of
        their bias, others of their attenuation; the intervals hold both.
        """
        expected = self.expected(np.asarray(average.orders) * ratio, average.trigger_cycles)
        amplitudes = average.amplitudes / expected.factor
        relative = expected.standard_deviation / expected.attenuation
        bias = np.where(expected.used, np.abs(expected.factor / expected.attenuation - 1.0), 0.0)
        errors = np.sqrt((average.noise / expected.factor) ** 2 + np.abs(amplitudes) ** 2 * (
            relative**2 + (0.5 * bias) ** 2))
        how = tuple('bias corrected: its own phase was used' if used else
                    'free of bias: other orders were used'
                    for used in expected.used)
        return CorrectedAmplitudes(amplitudes, errors, expected, how)


def among(orders: FloatArray, others: Sequence[float]) -> BoolArray:
    """Return which orders (order,) are among others."""
    return np.asarray(np.isclose(orders[:, None], others, rtol=_SAME, atol=0.0).any(axis=1))


def _amplitudes(errors: FloatArray, orders: FloatArray, seed: int) -> FloatArray:
    """Return drawn amplitudes (draw, order) of an average whose angles err with a covariance."""
    values, vectors = np.linalg.eigh(errors - errors.mean(axis=0) - errors.mean(
        axis=1, keepdims=True) + errors.mean())
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    drawn = np.random.default_rng(seed).standard_normal((_DRAWS, len(errors))) @ root.T
    # Between two pulses the error changes linearly, as the angle law has it.
    middle, change = 0.5 * (drawn[:, 1:] + drawn[:, :-1]), np.diff(drawn, axis=1) / (2.0 * np.pi)
    return np.stack([np.abs(np.mean(np.exp(1j * order * middle) * np.sinc(order * change), axis=1))
                     for order in orders], axis=1)
