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
Recovery of the keyphasor's pulse errors from the vibration, after which they can be corrected.

If the vibration contains synchronous orders above the noise, every trigger cycle shows the errors
of its two pulses: it differs from the average by the derivative of the average times hat functions
of the pulse errors (`pulse_error_fit`). All channels and orders make one least-squares problem
with a tridiagonal normal matrix, so that the time of a Gauss-Newton step is proportional to the
number of pulses.

Only orders above the noise are used, each channel and order with the weight of its noise. An order
whose phase the errors may turn by half a cycle is used only after lower orders have limited the
errors. An order of another shaft beside one that is used passes for errors unless it is known, and
fitted with it (`other_lines`). The size of the errors is estimated with them. Where the vibration
tells less of a pulse, its expected error is smaller, so that noise is not aligned to itself. A
delay common to all pulses cannot be recovered: the errors have mean zero.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.arrays import ComplexArray, FloatArray
from sa_jitter_ros.averaging.alignment import Alignment, alignment
from sa_jitter_ros.averaging.grid_cycles import GridCycles
from sa_jitter_ros.averaging.pulse_error_fit import (
    compress, nodes_for, PulseErrorFit, PulseErrorProblem)
from sa_jitter_ros.averaging.synchronous_orders import LineSearch, significant_orders
from sa_jitter_ros.errors import ParameterError, SignalError

# The width of a uniform distribution in its standard deviations.
_UNIFORM_WIDTH = float(np.sqrt(12.0))
# Turns of an order by errors across their whole width: for certain use, and the maximum.
_SAFE_TURNS, _MOST_TURNS = 0.5, 1.1
# Width of the interval that a fitted error is expected in, in its standard errors.
_CERTAIN = 5.0
# Least share of the variance of the errors that the vibration must show.
_LEAST_SHOWN = 0.05
# Errors that are so many times as large as declared, and turn an order across their width so far,
# may have been fitted a turn aside (those that were fill one turn), and errors with less evidence
# than this may be noise that has been aligned to itself: they are fitted again from so many times
# more, or less, than the declared jitter on. The result counts if it has that much more evidence,
# because the declared size is likely.
_SUSPICIOUS, _LARGE_TURNS, _CONVINCING, _WIDER, _UNLIKELY = 1.8, 0.7, 3.0, 4.0, 2.0
# Phase in rad beyond which the likelihood of a pulse has several maxima.
_AMBIGUOUS = 1.0
# Amplitudes below this fraction of the RMS of a channel are rounding errors.
_ROUNDING = 1e-9
_STAGES = 8
_STRONGEST = 12  # orders that are looked for
_MOST_COLUMNS = 400  # of the compression, which takes most of the time
# Fewer cycles than this do not separate an order from that of another shaft near it; then errors
# of this many declared standard deviations are refused.
_FEW_CYCLES, _FAR = 10, 6.0
# True pulse errors take power from the orders, and the correction returns it. The power may fall
# by this fraction only, which orders close to each other can cause.
_LOSS = 0.15


@dataclass(frozen=True)
class PulseErrorRecovery:
    """
    Errors of the pulses of one average, recovered from its vibration.

    `errors` (pulse,) are measured minus true times (s) with mean zero, by the vibration alone, and
    `standard_errors` (pulse,) are theirs (s, NaN if nothing could be fitted). `expected` (pulse,)
    are the likeliest errors (s) if jitter of the estimated standard deviation `std` (s) is taken
    into account: those to correct pulses by. If they are not `accepted`, both are all zero, and
    `reason` says why. `resolved` (pulse,) says where the vibration determines an error without
    ambiguity, `shown` is the share of the variance of all errors that it shows; `evidence` is the
    logarithm of the likelihood of errors over that of none.
    `covariance` (2, pulse) of the expected errors, with the next one in the second row, is in
    fundamental cycles squared. `orders` are those used; `amplitudes` (channel, order) their
    complex peak amplitudes without the errors, at angle 0; between the expected pulses they are
    `aligned` (channel, order) times as large, NaN where a channel does not show the order; `noise`
    (channel, order) is the standard deviation of the complex amplitude of one cycle.
    `aligned_error` (channel, order) is the standard error of `aligned`, `excess` the mean variance
    of the expected errors inside a cycle beyond that of their covariance, `excess_error` its own.
    """

    errors: FloatArray
    standard_errors: FloatArray
    accepted: bool
    reason: str
    expected: FloatArray
    covariance: FloatArray
    resolved: NDArray[np.bool_]
    std: float
    shown: float
    evidence: float
    orders: FloatArray
    amplitudes: ComplexArray
    aligned: FloatArray
    noise: FloatArray
    aligned_error: FloatArray
    excess: float
    excess_error: float


@dataclass(frozen=True)
class _Attempt:
    """
    A fit of a problem, or why there is none.

    `clear` are orders far above those around.
    """

    problem: PulseErrorProblem | None
    fit: PulseErrorFit | None
    clear: FloatArray
    reason: str = ''


def recover_pulse_errors(grid: GridCycles, *, periods: FloatArray, cycle_length: float,
                         declared_standard_deviation: float, first_angle: float = 0.0,
                         orders: Sequence[float] = (), additional_orders: Sequence[float] = ()
                         ) -> PulseErrorRecovery:
    """
    Recover the pulse errors of one average from its vibration.

    `grid` are its trigger cycles (cycle, sample, channel), sample i at the fraction u = i /
    samples of the time between two measured pulses (linear law), and `periods` (cycle,) these
    times (s). `cycle_length` is r, `first_angle` the angle of the first pulse, both in fundamental
    cycles. `declared_standard_deviation` (s) is that of the declared pulse error. `orders` are the
    orders to use; without it, the `additional_orders` and the strongest of the integer ones are.

    Raises `SignalError` for arrays that do not match or are not finite, `ParameterError` for a
    cycle_length or standard deviation that is not positive.

    Cycles of order 5 at 20 Hz, cut at pulses with normal errors of 0.5 ms:

    >>> rng = np.random.default_rng(1)
    >>> errors = rng.normal(0.0, 5e-4, 41)
    >>> pulses = np.arange(41) / 20.0 + errors
    >>> times = pulses[:-1, None] + np.diff(pulses)[:, None] * np.arange(100) / 100.0
    >>> cycles = np.cos(2.0 * np.pi * 5.0 * 20.0 * times) + rng.normal(0.0, 0.01, times.shape)
    >>> recovery = recover_pulse_errors(
    ...     GridCycles(cycles[:, :, None]), periods=np.diff(pulses), cycle_length=1.0,
    ...     declared_standard_deviation=5e-4)
    >>> recovery.accepted, recovery.orders.tolist()
    (True, [5.0])
    >>> bool(abs(recovery.errors - (errors - errors.mean())).max() < 2e-5)
    True
    """
    periods = _validated(grid.cycles, periods, cycle_length, declared_standard_deviation)
    declared = declared_standard_deviation * cycle_length / float(np.mean(periods))
    found = _likeliest(partial(
        _staged_fit, grid, cycle_length=cycle_length, first_angle=first_angle, orders=orders,
        additional_orders=additional_orders, declared=declared), declared)
    problem, fit, reason = found.problem, found.fit, found.reason
    if problem is None or fit is None:
        count, channels = grid.pulses, grid.cycles.shape[2]
        return PulseErrorRecovery(
            np.zeros(count), np.full(count, np.nan), False, reason, np.zeros(count),
            np.zeros((2, count)), np.zeros(count, np.bool_), 0.0, 0.0, 0.0, np.empty(0),
            np.empty((channels, 0), np.complex128), np.empty((channels, 0)),
            np.empty((channels, 0)), np.empty((channels, 0)), 0.0, 0.0)

    expected = fit.expected * float(np.mean(periods)) / cycle_length
    begins, ends = grid.begins, grid.begins + 1
    cycles = np.bincount(begins, minlength=grid.pulses) + np.bincount(ends)  # beside a pulse
    for _ in range(2):  # a fundamental cycle lasts as long as the corrected pulses say
        corrected = periods - (expected[ends] - expected[begins])
        seconds = (np.bincount(begins, corrected, grid.pulses)
                   + np.bincount(ends, corrected)) / cycles / cycle_length
        expected = fit.expected * seconds
    expected -= expected.mean()
    errors = fit.errors * seconds
    errors -= errors.mean()
    reason = _refusal(fit, expected, expected[ends] - expected[begins] >= periods,
                      declared_standard_deviation,
                      LineSearch.of(grid, cycle_length).gain(fit.expected, found.clear))
    if reason:
        errors, expected = np.zeros_like(errors), np.zeros_like(errors)
    beside_lines = (Alignment(fit.aligned, np.zeros(fit.aligned.shape), 0.0, 0.0) if reason
                    else alignment(problem, fit))
    # of the orders that determine the errors, each with its weight
    power = np.sum(np.abs(fit.amplitudes / fit.noise) ** 2, axis=1) * fit.informative
    order = np.sqrt(np.sum(fit.orders**4 * power) / np.sum(fit.orders**2 * power))
    return PulseErrorRecovery(
        errors, fit.standard_errors * seconds, not reason, reason, expected, fit.covariance,
        2.0 * np.pi * order * fit.standard_errors < _AMBIGUOUS, fit.std * float(seconds.mean()),
        fit.shown, fit.evidence, fit.orders, fit.amplitudes.T, beside_lines.aligned.T, fit.noise.T,
        beside_lines.aligned_error.T, beside_lines.excess,
        beside_lines.excess_error)


def _likeliest(attempt: Callable[..., _Attempt], declared: float) -> _Attempt:
    """Return the likelier of the fits from the declared jitter on and from another size on."""
    found = attempt(expected=declared)
    fit = found.fit
    if fit is not None and (_may_be_aside(fit, declared) or fit.evidence < _CONVINCING):
        other = attempt(expected=declared * (_WIDER if fit.std > declared else 1.0 / _WIDER))
        if other.fit is not None and other.fit.evidence > fit.evidence + _UNLIKELY:
            return other
    return found


def _may_be_aside(fit: PulseErrorFit, declared: float) -> bool:
    """Return whether errors are larger than declared and turn an order that was used too far."""
    turns = _UNIFORM_WIDTH * fit.std * float(fit.orders[fit.informative].max())
    return fit.std > _SUSPICIOUS * declared and turns > _LARGE_TURNS


def _validated(cycles: FloatArray, periods: FloatArray, cycle_length: float, declared: float
               ) -> FloatArray:
    periods = np.asarray(periods, np.float64)
    if cycles.ndim != 3 or len(cycles) < 2 or not cycles.size or periods.shape != cycles.shape[:1]:
        raise SignalError(f'cycles of shape {cycles.shape} with periods of shape {periods.shape}: '
                          'give (cycle, sample, channel) of at least 2 cycles, a period for each')
    if not (np.isfinite(cycles).all() and np.isfinite(periods).all() and np.all(periods > 0.0)):
        raise SignalError('cycles or periods are not finite, or a period is not positive: leave '
                          'those trigger cycles out')
    for name, value in (('cycle_length', cycle_length), ('declared_standard_deviation', declared)):
        if not (np.isfinite(value) and value > 0.0):
            raise ParameterError(f'{name} is {value}: give a positive number')
    return periods


def _refusal(fit: PulseErrorFit, errors: FloatArray, turned: NDArray[np.bool_], declared: float,
             gain: float) -> str:
    """
    Return why expected errors must not be used for a correction, '' if they can be used.

    They turn the pulses of some cycles (cycle,) around.
    """
    if not fit.shown > _LEAST_SHOWN:
        return (f'the vibration shows {fit.shown:.1%} of the variance of the pulse errors, not '
                f'more than {_LEAST_SHOWN:.0%}: use stronger orders or a quieter channel')
    largest = float(np.max(np.abs(errors)))
    if len(turned) < _FEW_CYCLES and largest > _FAR * declared:
        return (f'a recovered error of {largest:.3g} s is more than {_FAR:g} times the declared '
                f'jitter, {declared:.3g} s: in {len(turned)} trigger cycles an order of another '
                'shaft can look like that; average more trigger cycles, or check the pulses')
    if turned.any():
        return ('a recovered error is larger than a trigger cycle: check ratio, '
                'pulses_per_revolution and the pulses')
    if gain < 1.0 - _LOSS:
        return (f'the correction lowers the power of the orders, weighted by order^2, to '
                f'{gain:.2f} of the raw one, which true pulse errors cannot do: the errors follow '
                'an order of another shaft; average more trigger cycles, or check the pulses')
    return ''


def _staged_fit(grid: GridCycles, *, cycle_length: float, first_angle: float,
                orders: Sequence[float], additional_orders: Sequence[float], declared: float,
                expected: float) -> _Attempt:
    """
    Fit low orders first, then higher ones as the errors become better known.

    Where orders leak into each other in a trigger cycle, those that are listed or significant are
    fitted even if they tell nothing of the errors, which would follow what they leak. Orders that
    are neither listed nor clear are not worth more unknowns than half the samples of a cycle.

    `declared` is the standard deviation of the errors that is likeliest beforehand, `expected`
    the one whose turns of the orders decide which are safe to use.
    """
    listed = np.unique([g for g in (orders if len(orders) else additional_orders)
                        if 0.0 < g * cycle_length <= 0.5 * len(grid.samples)])
    search = None if len(orders) else LineSearch.of(grid, cycle_length, additional_orders)
    known = listed if search is None else search.orders
    width = _UNIFORM_WIDTH * expected  # of the interval that an error is still expected in
    spread = 1.5 * width  # the largest difference between neighbours
    errors, used, clear = np.zeros(grid.pulses), np.empty(0), np.empty(0)
    problem = None
    for _ in range(_STAGES):
        reach = _MOST_TURNS / width
        candidates = listed[listed <= reach]
        if search is not None:
            strongest, clearest = search.strongest(errors, _STRONGEST, below=reach)
            clear = np.union1d(clear, clearest)
            candidates = np.append(candidates, strongest[~np.isin(strongest, listed)])
            if clearest.size:
                candidates = candidates[search.plausible(
                    errors, candidates, cycles=len(grid.cycles))]
        if not len(candidates):
            break
        cycles = np.append(candidates, listed) * cycle_length
        leaking = bool(np.any(np.abs(cycles - np.rint(cycles)) > _ROUNDING))
        if leaking:
            candidates = np.append(candidates, np.setdiff1d(listed, candidates))
        room = np.where(np.isin(candidates, (*listed, *clear)), _MOST_COLUMNS,
                        len(grid.samples) // 2)
        columns = np.cumsum([2 * nodes_for(g * spread) for g in candidates])
        model = compress(grid, cycle_length=cycle_length, first_angle=first_angle, spread=spread,
                         orders=np.sort(candidates[columns <= room]))
        shown = significant_orders(model, errors, tests=len(known), least=_ROUNDING * grid.size)
        found = np.flatnonzero(shown.any(axis=1) & (model.orders <= reach))
        chosen = found[model.orders[found] * width <= _SAFE_TURNS]
        if np.array_equal(model.orders[chosen], used):  # no further order is safe: try the next
            chosen = found[:len(chosen) + 1]
        if not len(chosen) or np.array_equal(model.orders[chosen], used):
            break
        first, used = problem is None, model.orders[chosen]
        fitted = chosen if not leaking else np.flatnonzero(
            shown.any(axis=1) | np.isin(model.orders, listed))
        problem = PulseErrorProblem(
            model, fitted, np.isin(fitted, chosen)[:, None] & shown[fitted])
        if first and used[-1] * width > _SAFE_TURNS:
            errors = problem.scan(width)
        fit = problem.solve(errors, declared=declared)
        errors = fit.expected
        complete = search is not None and known[-1] * width <= _SAFE_TURNS
        width = min(width, _CERTAIN * float(np.sqrt(np.max(fit.covariance[0]))))
        spread = max(1.2 * float(np.max(np.abs(
            errors[grid.begins + 1] - errors[grid.begins]))), width)
        if complete:
            break
    if problem is None:
        return _Attempt(None, None, clear, (
            f'no synchronous order up to {_MOST_TURNS / width:.4g} stands above the noise, and '
            'above it the declared jitter makes phases ambiguous: declare the orders of a gear '
            'mesh, or use a quieter channel'))
    return _Attempt(problem, fit, clear)
