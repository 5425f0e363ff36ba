# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Gathering: the evidence that effects are fitted to, from the acquisitions that a fit may use."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

import numpy as np
from sa_jitter_ros.arrays import Array, IntArray
from sa_jitter_ros.averaging.noise import radial_noise
from sa_jitter_ros.effects.effect import Effect
from sa_jitter_ros.effects.evidence import Evidence, LineEvidence, Tone
from sa_jitter_ros.effects.lattice import (
    Clock, find_clock, NO_CLOCK, ROOM, sizes_within_ticks, SLOPE_OFF, smooth_on_grid,
    ticks_leave_room, within_half_tick)
from sa_jitter_ros.effects.target_geometry import own_marks
from sa_jitter_ros.inference.beat import find_beat, without_beat
from sa_jitter_ros.inference.expectation import Lines
from sa_jitter_ros.inference.line_search import least_seen
from sa_jitter_ros.inference.observation import (
    Acquisition, CHANCE, Observation, recovered_again, STRONG)
from sa_jitter_ros.inference.residual import FALSE_ALARM
from sa_jitter_ros.prediction.influence import AveragePulses, known_errors, without_gaps
from sa_jitter_ros.recordings.recording import Recording
from scipy import special

_COHERENT = 0.9  # of that of the best line, which noise and modulation lower, too
# Of channels, each predicted by the others: with two, half of the channels would have to show the
# errors; each more is one more recovery of all pulses.
_GROUPS = 3
_LAGS = 5  # at which errors on the ticks of a clock depend on each other, where they do


@dataclass(frozen=True)
class _Grid:
    """Ticks of a clock of `rate` Hz; `smooth` (pulse,) are the errors by the smoothest motion."""

    rate: float
    smooth: Array


def choose_lines(observation: Observation) -> Lines:
    """
    Return the lines worth comparing.

    They have at least 20 % of their order's strongest channel and a coherence from cycle to cycle
    of 0.9 times that of the best line, which noise and modulation lower too. There may be none.
    """
    orders, cycles = observation.orders.size, cycle_amplitudes(observation)
    level = np.abs(observation.stacked('corrected')[..., :orders]).mean(axis=0)
    with np.errstate(divide='ignore', invalid='ignore'):
        coherence = np.mean(np.abs(cycles.mean(axis=1)) ** 2, axis=0) / np.mean(
            np.abs(cycles) ** 2, axis=(0, 1))
    good = (level >= STRONG * np.nan_to_num(level).max(axis=0)) & (
        coherence > CHANCE / cycles.shape[1])
    if good.any():
        good &= coherence >= _COHERENT * coherence[good].max()
    channel, order = np.nonzero(good)
    return Lines(channel, order)


def hidden_lines(observation: Observation, lines: Lines) -> Lines:
    """Return declared orders without any of the `lines` where they are well above the noise."""
    orders = observation.orders.size
    level, floor = (np.abs(observation.stacked(name)[..., :orders]).mean(axis=0)
                    for name in ('corrected', 'noise_floor'))
    channel = level.argmax(axis=0)
    order = np.setdiff1d(np.flatnonzero((level > CHANCE * floor).any(axis=0)), lines.order)
    return Lines(channel[order], order)


def channel_groups(observation: Observation) -> Array:
    """
    Return the group of each channel (channel,); each group can be predicted by the others.

    The channels that show the pulse errors best are distributed evenly to the groups.
    """
    corrected = np.abs(observation.stacked('corrected'))
    with np.errstate(divide='ignore', invalid='ignore'):
        strength = observation.sources * corrected / observation.stacked('noise')
    information = np.sum(np.where(np.isfinite(strength), strength, 0.0).mean(axis=0) ** 2, axis=1)
    rank = np.argsort(np.argsort(-information))
    return np.asarray(rank % min(_GROUPS, rank.size))


def gather_pulses(recording: Recording, observation: Observation, group: Array
                  ) -> tuple[Clock, Sequence[Sequence[AveragePulses]]]:
    """
    Return the clock and the known errors of the pulses.

    On the grid of a clock, the errors are those of the smoothest motion that it allows; if other
    channels recover the motion better than a tick tells it, those of the recovered motion.
    Pulses beside an acquisition that its angle law uses are included.
    """
    model, pulses = observation.model, observation.pulses
    clock, imposed = clock_of(observation)
    grid = None if imposed is None else _Grid(clock.rate, imposed)
    groups, missed = int(group.max()) + 1, (0.0, 0.0)
    again: list[tuple[Array, float] | None] = [None] * groups
    if grid is not None:
        missed = _missed(observation, grid)
        if groups > 1:
            motions = [_unskewed(observation.acquisitions, recovered_again(
                recording, observation, np.flatnonzero(group != i).tolist()), grid)
                for i in range(groups)]
            again = [(motion, _uncertainty(observation, motion, motions, grid))
                     for motion in motions]
    known = []
    for a, item in enumerate(observation.acquisitions):
        start = item.first - model.weights.before
        read = slice(start, item.first + item.times.size + model.weights.after)
        own = slice(model.weights.before, model.weights.before + item.times.size)
        smooth = None if grid is None else grid.smooth[read]
        first = int(pulses.index[start])
        rows = []
        for better in again:
            errors, std, unknown = smooth, 0.0, missed
            if smooth is not None and better is not None and item.recovered and (
                    item.standard_errors.mean() < 1.0 / math.sqrt(12.0) / clock.rate
                    and np.all(np.isfinite(better[0][a]))):
                errors, std, unknown = smooth.copy(), better[1], (0.0, 0.0)
                errors[own] = within_half_tick(better[0][a], clock.rate)
            rows.append(AveragePulses(pulses.times[read], first, errors,
                                      pulses.missing[read.start:read.stop - 1], std, *unknown))
        known.append(rows)
    return clock, known


def clock_of(observation: Observation) -> tuple[Clock, Array | None]:
    """
    Return the clock of the pulses, and what its grid says of their errors (pulse,).

    That is the share of the errors of the smoothest motion on the grid that the vibration
    confirms. None where no clock shows, where jitter moves pulses over its ticks, or where the
    shaft moves so much from pulse to pulse that the smoothest motion is another one: the errors
    are then uniform within their ticks.
    """
    times = observation.pulses.times
    clock = find_clock(times)
    if not clock.visible(observation.model.keyphasor_rate):
        return NO_CLOCK, None
    smooth = smooth_on_grid(times, clock.rate)
    share = _confirmed(observation, smooth)
    unidentifiable = share < 1.0 - SLOPE_OFF and _independent(observation)
    if unidentifiable or dithered(observation, clock, smooth):
        return replace(clock, dithered=True), None
    return clock, min(max(share, 0.0), 1.0) * smooth


def _confirmed(observation: Observation, smooth: Array) -> float:
    """
    Return the slope of the errors of the pulses over those of the `smooth`est motion (pulse,).

    It is 1 where the vibration shows no errors.
    """
    shown = observation.shown
    if not shown:
        return 1.0
    imposed = _straightened(of_acquisitions(smooth, shown))
    errors = _straightened(np.array([item.errors for item in shown]))
    power = float(np.sum(imposed**2))
    return float(np.sum(imposed * errors) / power) if power else 1.0


def _independent(observation: Observation) -> bool:
    """Return whether recovered errors are independent from pulse to pulse, as far as they tell."""
    shown = observation.shown
    if not shown or shown[0].errors.size <= _LAGS + 1:
        return False
    errors = _straightened(np.array([item.errors for item in shown]))
    power = float(np.mean(errors**2))
    if not power > 0.0:
        return False
    together = np.array([np.mean(errors[:, lag:] * errors[:, :-lag]) for lag in range(
        1, _LAGS + 1)]) / power
    chance = special.ndtri(1.0 - 0.5 * FALSE_ALARM / _LAGS)
    return bool(np.all(np.abs(together) * math.sqrt(errors.size) < chance))


def _straightened(errors: Array) -> Array:
    """Return errors (acquisition, pulse) less a line each: a clock that is fast moves no tick."""
    place = np.linspace(-1.0, 1.0, errors.shape[1])
    slope = errors @ place / (place @ place)
    return np.asarray(errors - errors.mean(axis=1, keepdims=True) - np.outer(slope, place))


def dithered(observation: Observation, clock: Clock, smooth: Array) -> bool:
    """
    Tell whether jitter moves pulses over the ticks of a clock.

    Each tick is then an independent error (Widrow and Kollar 2008), and `smooth` (pulse,), the
    errors that the smoothest motion on the grid tells, are wrong: that motion is rougher than the
    recovered one, which the ticks do not allow. What repeats with the marks is left in both.
    """
    marks, _ = own_marks(observation.model)
    whole = [item for item in observation.shown if not np.any(item.missing)]
    if not whole:
        return False
    errors, times = (np.array([getattr(item, name) for item in whole])
                     for name in ('errors', 'times'))
    imposed = of_acquisitions(smooth, whole)
    place = (observation.pulses.number[[item.first for item in whole]][:, None]
             + np.arange(errors.shape[1])) % marks
    even = np.bincount(place.ravel(), errors.ravel(), marks) / np.maximum(
        np.bincount(place.ravel(), None, marks), 1)
    smoothest, recovered = (float(np.mean(np.diff(times - rows, 2) ** 2)) for rows in (
        imposed, errors - even[place]))
    noise = np.mean([item.roughness**2 for item in observation.recoveries] or [0.0])
    return smoothest - max(recovered - float(noise), 0.0) > 6.0 * (ROOM / clock.rate) ** 2


def gather(observation: Observation, chosen: Sequence[int],
           pulses: Sequence[Sequence[AveragePulses]], clock: Clock, effects: Sequence[Effect],
           scatter: LineEvidence) -> Evidence:
    """Return the evidence of the `chosen` acquisitions, less the contributions of `effects`."""
    model = observation.model
    usable = [a for a in chosen if np.all(np.isfinite(observation.acquisitions[a].errors))]
    items = [observation.acquisitions[a] for a in usable]
    errors, own = [], []
    for a, item in zip(usable, items):
        read = pulses[a][0]
        if len(read.times) > item.times.size:
            read = read.without(model.weights.before, model.weights.after)
        own.append(read)
        known = known_errors(model, effects, read)
        left = item.errors if known is None else item.errors - without_gaps(
            known, item.missing, item.times)
        errors.append(left - left.mean())
    standard_errors = np.array([item.standard_errors for item in items])
    if observation.against_reference:
        standard_errors = np.zeros_like(standard_errors)
    whole = scatter.with_sources
    return Evidence(
        model=model, pulses=tuple(own), errors=np.array(errors),
        standard_errors=standard_errors, ripple=np.array([item.ripple for item in items]),
        record_times=observation.pulses.times, record_missing=observation.pulses.lost,
        clock=clock, explained=tuple(effects), lines=replace(
            scatter, radial=scatter.radial[usable], noise_density=scatter.noise_density[usable],
            with_sources=None if whole is None else whole[usable]))


def pulse_evidence(observation: Observation) -> Evidence:
    """Return the evidence of the pulse times alone, without any acquisition."""
    none = np.zeros(0)
    return gather(observation, (), (), NO_CLOCK, (), LineEvidence(
        none, none, none, np.zeros((0, 0)), np.zeros((0, 0, 0)), none))


def line_evidence(observation: Observation, lines: Lines) -> LineEvidence:
    """Return the scatter of the amplitudes of the lines in all acquisitions."""
    model = observation.model
    cycles = lines.of(cycle_amplitudes(observation))
    shortest = cycles.shape[1]
    mean = cycles.mean(axis=1, keepdims=True)
    level = np.abs(mean).mean(axis=(0, 1))
    tone, items = _tone(observation, lines), observation.acquisitions
    along = (cycles * np.exp(-1j * np.angle(mean))).real / level - 1.0
    whole = lines.of(np.array([
        item.parts.reshape(len(item.cycles), -1, *item.parts.shape[1:]).mean(axis=1)[:shortest]
        for item in items])) / level - 1.0
    times = np.array([item.middles(len(item.cycles))[:shortest] for item in items])
    if tone is not None:  # what it makes is no modulation
        wave = _beside(observation, lines, tone, times)
        along, whole = (item - 2.0 * (np.mean(item * wave.conj(), axis=(0, 1)) * wave).real
                        for item in (along, whole))
    noises = np.array([radial_noise(row) for row in cycles])
    noise = np.sqrt(np.mean(noises**2, axis=0))
    floor = lines.of(observation.stacked('noise_floor'))
    density = floor * np.sqrt(0.5 * observation.sample_rate * shortest * model.trigger_period)
    order = observation.orders[lines.order]
    steady = lines.of(np.concatenate([item.parts for item in items]))  # what turns it is no beat
    beat = find_beat(
        steady / level, np.concatenate([item.middles(len(item.parts)) for item in items]), order,
        order * model.fundamental_frequency / observation.sample_rate)
    return LineEvidence(
        order=order, channel=lines.channel, level=level, noise_density=density,
        **{name: without_beat(item.reshape(-1, order.size), times.ravel(), beat
                              ).reshape(item.shape)
           for name, item in (('radial', along), ('with_sources', whole))},
        radial_noise=noise * np.sqrt(shortest) / level, tone=tone,
        hidden_tone=_hidden_tone(observation, density), beat=beat,
        number=_numbers(observation, shortest))


def _numbers(observation: Observation, cycles: int) -> IntArray:
    """Return numbers (acquisition, cycle) of so many cycles each; as many are left out at gaps."""
    begin = observation.first_numbers
    apart = np.cumsum(np.diff(begin, prepend=begin[0] - cycles) != cycles)
    return np.asarray(np.add.outer(cycles * (np.arange(begin.size) + apart), np.arange(cycles)))


def _beside(observation: Observation, lines: Lines, tone: Tone, times: Array) -> Array:
    """Return the wave (acquisition, cycle, line) of a tone beside lines at `times` in s."""
    places = np.arange(times.shape[1]) + 0.5  # middles of cycles
    angle = observation.model.cycle_length * np.add.outer(observation.first_numbers, places)
    turns = tone.frequency * times[..., None] - (
        angle[..., None] * observation.orders[lines.order])
    return np.asarray(np.exp(2j * np.pi * turns))


def _tone(observation: Observation, lines: Lines) -> Tone | None:
    """Return the line of no shaft that scatters an average most, None without one."""
    model = observation.model
    fit = max((fit for recovery in observation.recoveries for fit in recovery.fits),
              key=lambda item: item.errors.size, default=None)
    if fit is None:
        return None
    period = np.mean([np.ptp(item.true_times) / item.number[-1]
                      for item in observation.acquisitions])
    frequency = np.append(fit.orders * model.cycle_length / period, fit.tones)
    amplitudes = fit.amplitudes
    chosen = np.flatnonzero(~fit.synchronous)
    if not chosen.size:
        return None
    order = np.append(lines.order, hidden_lines(observation, lines).order)
    apart = frequency[chosen, None] - observation.orders[order] * model.fundamental_frequency
    level = np.abs(amplitudes[:, :fit.declared]).max(axis=1)
    size = np.max(np.abs(amplitudes[:, chosen]) / level[:, None], axis=0)
    # all, unless they stand on it, are taken to leak as the sides of a sinc do
    leak = 1.0 / np.maximum(np.pi * np.abs(apart) * model.duration, 1.0).min(axis=1)
    best = int(chosen[np.argmax(size * leak)])
    channel = int(np.argmax(np.abs(amplitudes[:, best]) / fit.amplitude_errors[:, best]))
    amplitude = float(np.abs(amplitudes[channel, best]))
    error = float(fit.amplitude_errors[channel, best])
    power = float(np.sum((np.abs(amplitudes[:, best]) / fit.amplitude_errors[:, best]) ** 2))
    duration = model.trigger_period * (fit.errors.size - 1)
    # of a line that begins and ends: sqrt(12) errors of its phase over its duration
    of_frequency = math.sqrt(12.0) * error / amplitude / (2.0 * np.pi * duration)
    return Tone(float(frequency[best]), amplitude, of_frequency, error, 0.5 * power,
                len(amplitudes), 0.5 * observation.sample_rate * duration)


def _hidden_tone(observation: Observation, density: Array) -> tuple[float, float]:
    """Return the largest amplitude of a tone that noise (acquisition, line) hides; its error."""
    if not observation.recoveries or not density.size:
        return 0.0, math.inf
    samples = observation.sample_rate * max(
        float(np.ptp(item.pulses.bridged[part])) for item in observation.recoveries
        for part in item.stretches)
    error = math.sqrt(2.0 / samples) * float(np.median(density))
    return least_seen(samples, len(observation.channel_names)) * error, error


def cycle_amplitudes(observation: Observation) -> Array:
    """Return corrected amplitudes (acquisition, cycle, channel, order), as many cycles of each."""
    shortest = min(len(item.cycles) for item in observation.acquisitions)
    return np.array([item.cycles[:shortest, :, :observation.orders.size]
                     for item in observation.acquisitions])


def _uncertainty(observation: Observation, motion: Array, others: Sequence[Array], grid: _Grid
                 ) -> float:
    """
    Return the standard error of recovered errors (acquisition, pulse) without skew, in s.

    With a reference keyphasor it is their difference from it, whose errors are included, also
    without the skew beside the `grid`. Otherwise it is that of the
    delete-a-group jackknife over recoveries that leave out one group of channels each.
    """
    if observation.against_reference:
        apart = motion - _unskewed(
            observation.acquisitions, observation.stacked('errors'), grid)
        variance = np.var(apart, axis=1, ddof=1)
    else:
        variance = (len(others) - 1) * np.var(others, axis=0, ddof=min(1, len(others) - 1))
    variance = variance[np.isfinite(variance)]
    return float(np.sqrt(variance.mean())) if variance.size else 0.0


def _missed(observation: Observation, grid: _Grid) -> tuple[float, float]:
    """
    Return the error of the smoothest motion on a grid: size in s and correlation of neighbours.

    It is 0 where there are other errors beside those of the ticks.
    """
    shown = observation.shown
    if not shown:
        return 0.0, 0.0
    errors = _unskewed(shown, np.array([item.errors for item in shown]), grid)
    error = 0.0 if observation.against_reference else float(np.sqrt(np.nanmean(
        [item.standard_errors**2 for item in shown])))
    if not ticks_leave_room(list(errors), float(np.nanmean(np.square(error))), grid.rate):
        return 0.0, 0.0
    missed = errors - of_acquisitions(grid.smooth, shown)
    missed -= missed.mean(axis=1, keepdims=True)
    variance = float(np.mean(missed**2)) - error**2
    if variance <= 0.0:
        return 0.0, 0.0
    together = float(np.mean(missed[:, 1:] * missed[:, :-1])) / variance
    return _of_centred(variance, together, missed.shape[1])


def _of_centred(variance: float, together: float, count: int) -> tuple[float, float]:
    """
    Return size and correlation of neighbours of errors, of which runs of `count` lost their means.

    A mean takes much of errors that hardly change in a run: `variance` is that of what is left,
    and `together` its covariance of neighbours over it. No memory is longer than a run.
    """
    k = np.arange(count)
    tried = np.exp(-1.0 / np.geomspace(0.1, count, 100))
    kept, shared = np.zeros((2, tried.size))
    for i, correlation in enumerate(tried):
        rows = correlation ** np.abs(k - k[:, None])
        rows -= rows.mean(axis=0)
        rows -= rows.mean(axis=1, keepdims=True)
        kept[i] = np.trace(rows) / count
        shared[i] = np.trace(rows, 1) / (count - 1) / kept[i]
    correlation = float(np.interp(together, shared, tried))
    return float(np.sqrt(variance / np.interp(correlation, tried, kept))), correlation


def of_acquisitions(values: Array, items: Sequence[Acquisition]) -> Array:
    """Return (acquisition, pulse) of values of all pulses of a record."""
    return np.array([values[item.first:item.first + item.times.size] for item in items])


def _unskewed(items: Sequence[Acquisition], motion: Array, grid: _Grid) -> Array:
    """
    Return recovered errors (acquisition, pulse) less a slope over time that no grid causes.

    The smoothest motion shows that there is one, but may drift itself by a part of a tick. The
    slopes that leave all errors within the ticks tell more.
    """
    times = np.array([item.times - item.times.mean() for item in items])
    left = motion - of_acquisitions(grid.smooth, items)
    slopes = np.sum(times * (left - left.mean(axis=1, keepdims=True)), axis=1) / np.sum(
        times**2, axis=1)
    slopes = slopes[np.isfinite(slopes)]
    if slopes.size < 4:
        return motion
    certainty = abs(slopes.mean()) / (slopes.std(ddof=1) / np.sqrt(slopes.size))
    if 2.0 * special.stdtr(slopes.size - 1, -certainty) > FALSE_ALARM:
        return motion
    runs, slope = _runs(items, motion), _slope(_runs(items, left))
    longest = max(float(np.ptp(time)) for time, _ in runs)
    possible, weight = sizes_within_ticks(
        lambda size: [error - size * time for time, error in runs],
        slope + np.linspace(-0.5, 0.5, 101) / (grid.rate * longest),
        float(np.nanmean([item.standard_errors**2 for item in items])), grid.rate)
    return np.asarray(motion - (possible @ weight if possible.size else slope) * times)


def _runs(items: Sequence[Acquisition], errors: Array) -> list[tuple[Array, Array]]:
    """
    Return times, less their mean, and errors (acquisition, pulse) of unbroken runs.

    Acquisitions have a mean each, but neighbours share a pulse, so that a run of them has one.
    """
    runs: list[tuple[list[Array], list[Array]]] = []
    end, last = -1, np.nan
    for item, row in zip(items, errors):
        if item.first == end and np.isfinite(last - row[0]):
            row = row + (last - row[0])
        else:
            runs.append(([], []))
        for values, new in zip(runs[-1], (item.times, row)):
            values.append(new[np.isfinite(row)])
        end, last = item.first + item.times.size - 1, row[-1]
    rows = [(np.concatenate(time), np.concatenate(error)) for time, error in runs]
    return [(time - time.mean(), error) for time, error in rows if time.size]


def _slope(runs: Sequence[tuple[Array, Array]]) -> float:
    """Return the slope over time of the errors of runs, each with a mean of its own."""
    return float(sum(time @ error for time, error in runs)
                 / sum(time @ time for time, _ in runs))
