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
The trace on line: which effect causes the residual of averages received from topics.

Such averages contain one amplitude per order and channel, not those of single trigger cycles, and
pulse errors without the ripple between pulses. Effects that show only there are found by the loop
off line.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.effects.effect import Effect
from sa_jitter_ros.effects.evidence import LineEvidence
from sa_jitter_ros.effects.lattice import Clock, ticks_leave_room
from sa_jitter_ros.errors import ModelError, SignalError
from sa_jitter_ros.inference.expectation import Lines
from sa_jitter_ros.inference.gathering import clock_of, of_acquisitions
from sa_jitter_ros.inference.observation import Acquisition, nameless, NameOf, Observation
from sa_jitter_ros.inference.online import good_lines, places, ReceivedAverage
from sa_jitter_ros.inference.record_pulses import RecordPulses
from sa_jitter_ros.inference.scoring import Bench
from sa_jitter_ros.inference.trace import (
    require_acquisitions, timing_of, trace_bench)
from sa_jitter_ros.inference.trace_result import Trace
from sa_jitter_ros.parameters import listed
from sa_jitter_ros.prediction.amplitudes import line_variance
from sa_jitter_ros.prediction.influence import AveragePulses
from sa_jitter_ros.prediction.model import DeclaredModel

_DECISIVE = 'close_loop on a recording, which contains the signals within trigger cycles,'
_REASON = 'the topics do not contain {}: run close_loop on a recording'
ONLY_OFF_LINE = {
    'speed_fluctuation': _REASON.format('the angle error inside the trigger cycles'),
    'interpolation_loss': _REASON.format('the samples'),
    'additive_noise': _REASON.format('the amplitudes of single trigger cycles'),
    'amplitude_modulation': _REASON.format('the amplitudes of single trigger cycles'),
    'interfering_tone': _REASON.format('the amplitudes of single trigger cycles')}


@dataclass(frozen=True)
class MeasuredNoise(Effect):
    """The noise that the averages report: `variance` (order,) of a peak amplitude."""

    name: ClassVar[str] = 'measured_noise'
    summary: ClassVar[str] = 'noise that the averages report'
    scatters: ClassVar[bool] = True
    variance: tuple[float, ...]

    def line_variance(self, model: DeclaredModel) -> Array:
        """Return the variance of each order."""
        return np.array(self.variance)


def trace_averages(averages: Sequence[ReceivedAverage], model: DeclaredModel, *,
                   declared: Sequence[Effect] = (), name_of: NameOf = nameless) -> Trace:
    """
    Trace the residual of averages, those of the longest stretch without a gap.

    `name_of` returns the name of what makes an order.
    Raises ModelError for fewer than 4 of them and SignalError where nothing can be compared.
    """
    stretch = _longest_stretch(averages)
    observation = replace(_observation(stretch, model), name_of=name_of)
    require_acquisitions(observation)
    lines = Lines(*np.nonzero(
        good_lines(stretch, places(observation.orders, stretch[0].orders))))
    every = range(len(stretch))
    fit, held_out = tuple(every[::2]), tuple(every[1::2])
    clock, pulses = _pulses(observation)
    level = lines.of(np.abs(observation.stacked('corrected'))[list(fit)].mean(axis=0))
    bench = Bench(
        observation, lines, level, pulses, clock, np.ones(len(stretch[0].raw), int),
        _scatter(observation, lines, level), fit, held_out,
        (*declared, _measured_noise(observation, lines)), ONLY_OFF_LINE)
    found = trace_bench(bench, timing_of(bench))
    return replace(found, declared=tuple(declared), findings=tuple(
        replace(item, deciding_measurement=_DECISIVE,
                indistinguishable_from=(*item.indistinguishable_from, 'speed_fluctuation'))
        if item.name == 'phase_wander' else item for item in found.findings))


def _longest_stretch(averages: Sequence[ReceivedAverage]) -> Sequence[ReceivedAverage]:
    """Return the longest run of averages with pulse errors, each beginning where one ended."""
    runs: list[list[ReceivedAverage]] = [[]]
    for item in averages:
        if runs[-1] and (item.pulses is None
                         or abs(item.start_time - runs[-1][-1].end_time) > 1e-6):
            runs.append([])
        runs[-1] += [item] if item.pulses is not None else []
    best = max(runs, key=len)
    if not best:
        raise SignalError('the averages have no pulse errors: set correct_jitter: true in the '
                          'averager')
    return best


def _observation(averages: Sequence[ReceivedAverage], model: DeclaredModel) -> Observation:
    """Return the averages as the observation of a record that begins with their first pulse."""
    measured = averages[0].orders
    kept = [int(np.argmin(np.abs(measured - order))) for order in dict.fromkeys(model.orders)
            if np.isclose(measured, order, rtol=1e-6).any()]
    if not kept:
        raise ModelError(f'averages have the orders {listed(measured, 6)}, none of which is '
                         'declared: declare orders of the averager in the predictor')
    count = averages[0].trigger_cycles
    found, times = [], []
    for number, item in enumerate(averages):
        assert item.pulses is not None
        when, errors, error = item.pulses.T
        times.append(when if number == 0 else when[1:])
        found.append(Acquisition(
            first=number * count, times=when, missing=np.zeros(count, np.int64),
            bridged=when, errors=errors - errors.mean(), standard_errors=error,
            raw=item.raw[:, kept], cycles=item.corrected[None][:, :, kept],
            noise=item.noise[:, kept], noise_floor=item.noise[:, kept],
            parts=np.zeros((0, *item.noise[:, kept].shape)),
            ripple=np.full(count, np.nan), recovered=True, reason=''))
    speed = float(np.mean([item.trigger_speed for item in averages]))
    orders = measured[kept]
    record = np.concatenate(times)
    return Observation(
        replace(model, trigger_speed=speed, orders=tuple(orders.tolist())), tuple(found), orders,
        orders, tuple(f'channel {k}' for k in range(len(averages[0].raw))),
        RecordPulses.unbroken(record), model.sample_rate, False,
        model.trigger_speed)


def _pulses(observation: Observation) -> tuple[Clock, list[list[AveragePulses]]]:
    """
    Return the clock of the pulse times and the pulses.

    For each acquisition, the first errors are those of the smoothest motion that the grid of the
    clock allows: they test the clock. The second errors predict: they are the recovered ones, if
    the ticks of the clock can make these.
    """
    items = observation.acquisitions
    clock, smooth = clock_of(observation)
    if smooth is None:
        return clock, [
            2 * [AveragePulses(item.times, item.first, None, item.missing)] for item in items]
    grid = of_acquisitions(smooth, items)
    recovered = np.asarray(observation.stacked('errors'))
    variance = float(np.mean(np.square(observation.stacked('standard_errors'))))
    better = recovered if ticks_leave_room(list(recovered), variance, clock.rate) else grid
    return clock, [
        [AveragePulses(item.times, item.first, errors, item.missing) for errors in pair]
        for item, pair in zip(items, zip(grid, better))]


def _measured_noise(observation: Observation, lines: Lines) -> MeasuredNoise:
    """Return the noise of each order beyond the declared one, the mean over its channels."""
    model = observation.model
    power = 2.0 * np.mean(np.asarray(observation.stacked('noise')) ** 2, axis=0)
    count = np.bincount(lines.order, minlength=observation.orders.size)
    total = np.bincount(lines.order, lines.of(power), observation.orders.size)
    return MeasuredNoise(tuple(
        np.maximum(total / np.maximum(count, 1) - line_variance(model, ()), 0.0).tolist()))


def _scatter(observation: Observation, lines: Lines, level: Array) -> LineEvidence:
    """Return how the amplitudes of whole averages scatter."""
    amplitude = lines.of(np.abs(observation.stacked('corrected')))
    noise = np.sqrt(np.mean(lines.of(np.asarray(observation.stacked('noise'))) ** 2, axis=0))
    return LineEvidence(
        order=observation.orders[lines.order], channel=lines.channel, level=level,
        noise_density=np.full(amplitude.shape, np.nan), radial=(amplitude / level - 1.0)[:, None],
        radial_noise=noise / level)
