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
The pulse errors of a whole recording, recovered from its vibration.

The record fit takes every unbroken stretch of a recording at once: a run of trigger pulses that
are numbered without a doubt, inside the vibration. Undeclared lines are looked for in the longest
stretch. They help where they are steady, and disturb where they change from cycle to cycle: then
what they leave alternates from pulse to pulse. Whether the errors come from a fit with them or
from one with declared lines only is decided by the pulses: measured times less errors are those of
a shaft, which turns smoothly, plus what the errors are wrong by.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.effects.timing import ROUNDING
from sa_jitter_ros.inference.cycle_reader import MARGIN
from sa_jitter_ros.inference.line_search import APART
from sa_jitter_ros.inference.order_band import band_end
from sa_jitter_ros.inference.record_fit import OpenRecord, RecordFit
from sa_jitter_ros.inference.record_pulses import RecordPulses
from sa_jitter_ros.inference.residual import ACCURACY
from sa_jitter_ros.inference.timing_data import FEWEST
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.recordings.limits import LEAST_RANGE
from scipy import special

#: Largest standard error of resolved pulse errors, in parts of their size.
RESOLVED = 0.7
_WIDER = 16.0  # band in which lines are looked for where the declared ones show no errors
# Ratio of RMS second differences that counts: to what the errors are wrong by, and of two fits.
_SMOOTH = 1.5
# Lines of an average within which an order is one that the shafts are known to have, and the
# number of orders that leak.
_ON_LINE, _MOST = 0.1, 20


@dataclass(frozen=True)
class RecordRecovery:
    """
    Pulse errors of a recording, recovered from its vibration.

    `errors` and `standard_errors` (n,) in s are measured minus true, with
    mean 0 in each stretch, NaN outside of them; `bridged_errors` and `bridged_standard_errors`
    (m,) have those of the interpolated pulses, too. `ripple` (m - 1,) is the factor of u (1 - u)
    in the error inside a cycle (s), with its standard error, not seen beside a missing pulse.
    `roughness` (s) is the RMS of what second differences of
    `errors` are wrong by. `jitter_std` (s) is the size of the errors, `undeclared` the orders and
    tones (Hz) that were fitted beside the declared ones. `fits` are those of the `stretches` of
    the bridged `pulses`. `expected_std` (3,) in s is what the fits expected of errors and bends.
    """

    pulses: RecordPulses
    bridged_errors: FloatArray
    bridged_standard_errors: FloatArray
    ripple: FloatArray
    ripple_standard_error: float
    roughness: float
    jitter_std: float
    undeclared: tuple[FloatArray, FloatArray]
    fits: tuple[RecordFit, ...]
    stretches: tuple[slice, ...]
    expected_std: FloatArray

    @property
    def errors(self) -> FloatArray:
        """Return the errors of the measured pulses (n,)."""
        return self.bridged_errors[self.pulses.number]

    @property
    def standard_errors(self) -> FloatArray:
        """Return the standard errors of the errors of the measured pulses (n,)."""
        return self.bridged_standard_errors[self.pulses.number]

    @property
    def size(self) -> float:
        """Return the size of the errors (s): that of the fit, or what exceeds their noise."""
        errors, noise = self.errors, self.standard_errors
        known = np.isfinite(noise)
        if not known.any():
            return self.jitter_std
        power = float(np.var(errors[known]) - np.mean(noise[known] ** 2))
        return max(self.jitter_std, float(np.sqrt(max(power, 0.0))))

    @property
    def held(self) -> bool:
        """Tell whether declared lines of any stretch hold the angle to the pulses."""
        return any(fit.held for fit in self.fits)

    @property
    def resolved(self) -> bool:
        """Tell whether the vibration shows the errors of single pulses, beside slow ones."""
        known = self.standard_errors[np.isfinite(self.standard_errors)]
        return bool(known.size and np.median(known) < RESOLVED * self.jitter_std)

    @property
    def ripple_resolved(self) -> bool:
        """Tell whether the vibration shows the angle errors inside cycles, by all of them."""
        noise = self.ripple_standard_error**2
        known = self.ripple[np.isfinite(self.ripple)]
        return bool(known.size and noise < RESOLVED**2 * (np.mean(known**2) - noise))


def recover_record(samples: FloatArray, start_time: float, rate: float, pulses: RecordPulses,
                   model: DeclaredModel, *,
                   known: tuple[FloatArray, FloatArray] | None = None) -> RecordRecovery:
    """
    Recover the pulse errors of a recording.

    `samples` (sample, channel) begin at `start_time` (s). With the undeclared orders and tones
    (Hz) that are `known`, no other is looked for. Nothing is refused: where the vibration tells
    nothing, standard errors are as large as the errors expected, or NaN.
    """
    @lru_cache(maxsize=1)
    def opened(i: int, top: float, trend: float) -> OpenRecord | None:
        return _opened(samples, start_time, rate, pulses, stretches[i], model, top, trend)

    def ends(wider: float) -> list[float]:
        return [band_end(pulses.bridged[item], rate, model.cycle_length, model.orders, wider)
                for item in stretches]

    def fits(lines: tuple[FloatArray, FloatArray] | None, wider: float) -> list[RecordFit | None]:
        top, trend = ends(wider), 0.0
        found: list[RecordFit | None] = [None] * len(stretches)
        for i in sorted(range(len(stretches)), key=lambda i: stretches[i].start
                        - stretches[i].stop):
            found[i] = fit = _fitted(
                opened(i, top[i], trend), pulses.bridged[stretches[i]], model, lines)
            if fit is not None and fit.held:
                trend = trend or fit.trend
            if lines is None and fit is not None:
                lines = fit.orders[len(model.orders):], fit.tones
        return found

    stretches = _stretches(pulses, start_time, start_time + len(samples) / rate, MARGIN / rate)
    wider = 1.0
    recovery = _joined(pulses, stretches, fits(known, wider))
    # Without lines that hold the angle nothing tells that of other orders.
    if recovery.held and not recovery.resolved and ends(_WIDER) != ends(wider):
        found = _joined(pulses, stretches, fits(known, _WIDER))
        if found.resolved:  # orders that shafts must have tell how long the cycles are
            orders, tones = found.undeclared
            lines = np.array([_exact(order, model) for order in orders.tolist()]), tones
            wider, recovery = _WIDER, _joined(pulses, stretches, fits(lines, _WIDER))
    if known is None and any(item.size for item in recovery.undeclared):
        roughness = _roughness(recovery)
        if roughness < _SMOOTH * recovery.roughness:
            return recovery
        none = np.zeros(0), np.zeros(0)
        bare = _joined(pulses, stretches, fits(none, wider))
        # pulses that are hardly corrected stay as smooth as a source that moves leaves them
        if (bare.resolved or not recovery.resolved) and (
                _SMOOTH * _roughness(bare) < roughness):
            return replace(bare, fits=recovery.fits)
    return recovery


def jitter_unit(model: DeclaredModel) -> float:
    """Return the standard deviation of the declared pulse errors (s), not quite 0 for none."""
    return max(float(np.sqrt(model.distribution.variance)), ROUNDING * model.trigger_period)


def _stretches(pulses: RecordPulses, begin: float, end: float, edge: float) -> list[slice]:
    """Return the unbroken stretches of the bridged pulses inside the vibration."""
    times = pulses.bridged
    with np.errstate(invalid='ignore'):
        inside = (times > begin + edge) & (times < end - edge)  # false where NaN
    breaks = ~inside
    breaks[1:] |= ~inside[:-1]
    breaks[pulses.number[pulses.starts_run]] = True
    bounds = np.append(np.flatnonzero(breaks), times.size)
    starts = np.append(0, bounds[:-1])
    return [slice(a, b) for a, b in zip(starts.tolist(), bounds.tolist())
            if b - a > FEWEST and inside[a]]


def _opened(samples: FloatArray, start_time: float, rate: float, pulses: RecordPulses,
            stretch: slice, model: DeclaredModel, top: float, trend: float) -> OpenRecord | None:
    """
    Return a stretch of the live channels up to order `top`; None where none is alive.

    Its errors are expected to grow by `trend` s in a second.
    """
    times = pulses.bridged[stretch]
    measured = np.zeros(pulses.bridged.size, np.bool_)
    measured[pulses.number[~pulses.doubtful]] = True
    first = max(int((times[0] - start_time) * rate) - MARGIN, 0)
    last = int((times[-1] - start_time) * rate) + MARGIN
    part = samples[first:last + 1]
    part = part[:, np.ptp(part, axis=0) > np.maximum(
        ROUNDING * np.abs(part).max(axis=0), LEAST_RANGE)]
    if not part.size:
        return None
    return OpenRecord(
        part, rate, start_time + first / rate, times,
        measured=measured[stretch], cycle_length=model.cycle_length, orders=model.orders,
        jitter_std=jitter_unit(model), top=top, trend=trend)


def _fitted(record: OpenRecord | None, times: FloatArray, model: DeclaredModel,
            known: tuple[FloatArray, FloatArray] | None) -> RecordFit | None:
    """Return the fit of a stretch with pulses at `times`; None where nothing tells anything."""
    if record is None:
        return None
    if known is not None:
        span = model.cycle_length * (times.size - 1)
        known = (_apart(known[0], model.orders, APART / span),
                 _apart(known[1], (), APART / float(np.ptp(times))))
    try:
        return record.fit(known)
    except np.linalg.LinAlgError:
        return None


def _apart(lines: FloatArray, others: Sequence[float], least: float) -> FloatArray:
    """Return the lines that are at least so far from all before them and from others."""
    kept: list[float] = []
    for line in lines.tolist():
        if all(abs(line - other) > least for other in (*others, *kept)):
            kept.append(line)
    return np.array(kept)


def _joined(pulses: RecordPulses, stretches: Sequence[slice], fits: Sequence[RecordFit | None]
            ) -> RecordRecovery:
    """Return the recovery that the fits of some stretches make."""
    count = pulses.bridged.size
    errors, standard_errors = np.full(count, np.nan), np.full(count, np.nan)
    ripple = np.full(max(count - 1, 0), np.nan)
    good = [fit for fit in fits if fit is not None]
    for stretch, fit in zip(stretches, fits):
        if fit is not None:
            errors[stretch], standard_errors[stretch] = fit.errors, fit.standard_errors
            ripple[stretch.start:stretch.stop - 1] = fit.bends[:, 0]
    if not good:
        none = np.zeros(0)
        return RecordRecovery(pulses, errors, standard_errors, ripple, np.inf, 0.0, 0.0,
                              (none, none), (), (), np.zeros(3))
    ripple_error = float(np.sqrt(np.mean([fit.bend_standard_errors[0] ** 2 for fit in good])))
    if not np.isfinite(ripple_error):
        ripple[:] = np.nan
    weights = [fit.errors.size for fit in good]
    roughness, jitter_std, expected_std = (
        np.sqrt(np.average([np.square(getattr(fit, name)) for fit in good], 0, weights))
        for name in ('roughness', 'jitter_std', 'expected_std'))
    longest = _longest(good)
    return RecordRecovery(
        pulses, errors, standard_errors, ripple, ripple_error, float(roughness),
        float(jitter_std), (longest.orders[longest.declared:], longest.tones), tuple(good),
        tuple(part for part, fit in zip(stretches, fits) if fit is not None), expected_std)


def _longest(fits: Sequence[RecordFit]) -> RecordFit:
    return max(fits, key=lambda item: item.errors.size)


def _roughness(recovery: RecordRecovery) -> float:
    """Return the RMS of second differences of corrected pulse times, by their median."""
    corrected, missing = recovery.pulses.times - recovery.errors, recovery.pulses.missing
    whole = (missing[1:] == 0) & (missing[:-1] == 0)
    second = np.diff(corrected, 2)[whole]
    second = np.abs(second[np.isfinite(second)])
    if not second.size:
        return float('nan')
    return float(np.median(second) / special.ndtri(0.75))


def leaking_orders(recovery: RecordRecovery, model: DeclaredModel) -> list[float]:
    """
    Return the undeclared orders that leak into the declared ones, strongest first.

    These are orders that a shaft must have, and those that certainly turn with the shaft.
    Those that an average does not resolve from a line are none: they change it from average to
    average.
    """
    if not recovery.fits:
        return []
    fit = _longest(recovery.fits)
    declared = fit.declared
    height = np.abs(fit.amplitudes[:, :fit.orders.size])
    share = np.max(height / height[:, :declared].max(axis=1, keepdims=True), axis=0)
    # a trigger cycle that missing pulses make longer reads these as the declared ones
    longer = 1 + np.unique(recovery.pulses.missing[recovery.pulses.missing > 0])
    read = np.divide.outer(np.array(model.orders), longer)
    resolved = 1.0 / (model.trigger_cycles * model.cycle_length)
    near = np.abs(fit.orders[:, None] - read.ravel()).min(axis=1, initial=np.inf) < (
        _ON_LINE * resolved)
    found: list[float] = []
    for i in np.lexsort((-share, ~near)).tolist():
        if i < declared or share[i] < ACCURACY or len(found) == _MOST:
            continue
        order = _exact(float(fit.orders[i]), model)
        wanted = order == round(order) or fit.synchronous[i]
        if wanted and np.abs(np.subtract((*model.orders, *found), order)).min() > resolved:
            found.append(order)
    return found


def _exact(order: float, model: DeclaredModel) -> float:
    """Return the line of the trigger cycle, or the whole order, that an order is; else itself."""
    near = _ON_LINE / (model.trigger_cycles * model.cycle_length)
    for exact in (round(order * model.cycle_length) / model.cycle_length, float(round(order))):
        if abs(order - exact) < near:
            return exact
    return order
