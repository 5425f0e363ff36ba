# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Trigger cycles of a recording, their average, and the pulse errors recovered from them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sa_jitter_ros.averaging.average import Average, AverageSettings
from sa_jitter_ros.averaging.cycle import cycle_grid, CycleSamples
from sa_jitter_ros.averaging.recovery import (
    LARGEST_ERROR, PulseErrorRecovery, recover_pulse_errors)
from sa_jitter_ros.averaging.shaft import average_cycles
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.pulses.angle_law import AngleLaw, LINEAR_LAW
from sa_jitter_ros.pulses.resampling import margin

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# Errors above this many declared standard deviations are recovered again with a wider prior, in
# declared standard deviations: an effect may be larger than the declared jitter.
_SUSPICIOUS, _WIDER = 1.3, 4.0
_LEAST = 1e-9  # s; smallest declared standard deviation for the recovery
_WHOLE = 1e-9  # deviation from a whole number of cycles that is rounding
_MARGIN = 40  # samples on either side of a cycle, for interpolation and corrected pulses
_COSINE = np.cos(np.pi * (np.arange(512) + 0.5) / 512)
#: Variance of a fitted ripple, for noise of unit power over a cycle.
RIPPLE_VARIANCE = float(np.mean(1.0 / (1.0 / 30.0 - (1.0 + _COSINE) / (24.0 * (2.0 + _COSINE)))))


@dataclass(frozen=True)
class CycleReader:
    """Reads trigger cycles of a recording: `samples` (sample, channel) from `start_time` (s)."""

    samples: FloatArray
    start_time: float
    rate: float
    method: str

    def inside(self, times: FloatArray) -> bool:
        """Whether the cycles between these pulses (s) are inside the samples."""
        reach = margin(self.method) + 1
        position = (times[[0, -1]] - self.start_time) * self.rate
        return bool(position[0] >= reach and position[1] <= len(self.samples) - 1 - reach)

    def cycles(self, pulses: FloatArray, *, law: AngleLaw = LINEAR_LAW,
               ripple: FloatArray | None = None) -> list[CycleSamples]:
        """
        Return the trigger cycles between pulses.

        `pulses` (s) are those of the cycles and the others that the `law` uses; `ripple` (s) is
        the speed ripple in each cycle.
        """
        return [
            CycleSamples.cut(
                self.samples, start_time=self.start_time, rate=self.rate, pulses=pulses,
                first=first, margin=_MARGIN, ripple=0.0 if ripple is None else float(ripple[k]))
            for k, first in enumerate(range(law.before, len(pulses) - 1 - law.after))]

    def average(self, cycles: Sequence[CycleSamples], model: DeclaredModel, orders: FloatArray,
                law: AngleLaw = LINEAR_LAW) -> Average:
        """Return the synchronous average of cycles, the first of which begins at angle 0."""
        return average_cycles(cycles, AverageSettings(
            cycle_length=model.cycle_length, trigger_cycles=len(cycles),
            orders=tuple(orders.tolist()), angle_law=law.name, interpolation=self.method,
            revolutions_per_trigger=model.trigger_revolutions))


def recover(reader: CycleReader, pulses: FloatArray, model: DeclaredModel, rows: tuple[int, ...],
            *, with_ripple: bool, additional_orders: ArrayLike = ()) -> PulseErrorRecovery:
    """
    Recover pulse errors from the channels `rows`, of the declared size or larger.

    The orders used are the declared, the integer and the `additional_orders`.
    """
    periods = np.diff(pulses)
    grid = cycle_grid(reader.cycles(pulses), method=reader.method)[:, :, list(rows)]
    declared = max(float(np.sqrt(model.distribution.variance)), _LEAST)

    def attempt(expected: float) -> PulseErrorRecovery:
        return recover_pulse_errors(
            grid, periods=periods, cycle_length=model.cycle_length,
            additional_orders=(*model.orders, *np.ravel(additional_orders)),
            declared_standard_deviation=expected * declared, with_ripple=with_ripple)

    found = attempt(1.0)
    if found.accepted and found.errors.std() < _SUSPICIOUS * declared:
        return found
    wider = attempt(_WIDER)
    if not found.accepted:
        return wider if _stands_out(wider) else found
    if wider.accepted and _strength(wider) > _strength(found):
        return wider
    return found


def _stands_out(recovery: PulseErrorRecovery) -> bool:
    """Whether the recovered errors, not only the expected ones, exceed their standard error."""
    power = float(np.mean(recovery.standard_errors**2))
    return recovery.accepted and power < LARGEST_ERROR**2 * (float(recovery.errors.var()) - power)


def _strength(recovery: PulseErrorRecovery) -> float:
    """Return the power of the recovered orders, weighted by the square of the order."""
    return float(np.sum((recovery.orders * np.abs(recovery.amplitudes)) ** 2))


def ripple_error(recovery: PulseErrorRecovery, model: DeclaredModel) -> float:
    """
    Return the standard error of the ripple (s) due to the noise of the recovered orders.

    Ripples and pulse errors of all cycles are fitted jointly. At the frequency w (per cycle) the
    mean square of u (1 - u) without its best fit by straight lines between the pulses is
    1/30 - (1 + cos w) / (24 (2 + cos w)).
    """
    with np.errstate(divide='ignore', invalid='ignore'):
        signal = (2.0 * np.pi * recovery.orders * np.abs(recovery.amplitudes)) ** 2
        information = np.nansum(2.0 * signal / recovery.noise**2) / RIPPLE_VARIANCE
    cycles = 1.0 / np.sqrt(information) if information > 0.0 else float('inf')
    return float(cycles / model.fundamental_frequency)


def kept_apart(cycle_length: float, orders: FloatArray) -> bool:
    """Whether all orders have whole cycles in a trigger cycle of this length."""
    return bool(np.all(np.abs(cycle_length * orders - np.rint(cycle_length * orders)) < _WHOLE))
