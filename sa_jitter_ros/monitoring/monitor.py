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
The change monitor of one shaft: averages in, changes of its orders and indicators out.

Means of `group` consecutive averages at about the same speed are tested, because they are nearer
to a normal distribution and depend less on each other than single averages.
"""

from dataclasses import asdict, dataclass
import math
from typing import Any

import numpy as np
from sa_jitter_ros.arrays import Array, BoolArray, FloatArray
from sa_jitter_ros.averaging.results import AverageHeader
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.machine import Machine, UNKNOWN
from sa_jitter_ros.monitoring.change_test import ChangeTest, LEAST_LEARNED
from sa_jitter_ros.monitoring.operating import OperatingBins
from sa_jitter_ros.monitoring.quantities import in_words, Layout, MonitoredAverage, part_of
from sa_jitter_ros.monitoring.speed_bin import Moments, SpeedBin
from sa_jitter_ros.parameters import fixed, Parameter, Values
from scipy import special

YEAR = 365.25 * 86400.0  # s
# Bins: the machine passes through more of them in a run-up than it stays in.
_MOST_BINS = 64
# Intervals between averages of which the median counts.
_INTERVALS = 256
# Difference in trigger cycles up to which an average follows another in one run.
_SAME_RUN = 0.1
# Deviations beyond so many standard deviations say nothing of the covariance.
_FARTHEST = 4.0

PARAMETERS = (
    Parameter('false_alarms_per_year', 1.0, 'false alarms in a year of operation, of all '
              'tests together', above=0.0, maximum=1e4),
    fixed('learning_averages', 200, 'averages that a bin learns before it tests, at least '
          f'{LEAST_LEARNED} groups', minimum=LEAST_LEARNED, maximum=10000000),
    fixed('group_averages', 5, 'consecutive averages whose mean is tested', minimum=1,
          maximum=10000),
    Parameter('allow_uncorrected', False, 'take raw values without a correction; another '
              'keyphasor is then a change'),
    fixed('speed_bin', 0.05, 'relative width of a bin of speed, each with its own baseline',
          minimum=1e-4, maximum=1.0),
    fixed('state_bin', 0.0, 'width of a bin of the operating state; 0: one for all', minimum=0.0),
    fixed('state_lowest', math.nan, 'averages at lower operating states are discarded; NaN: none'),
    fixed('state_highest', math.nan, 'averages at higher operating states are discarded; NaN: '
          'none'),
)


@dataclass(frozen=True)
class Settings:
    """Settings of a monitor, named as the parameters of the node; raises ParameterError."""

    false_alarms_per_year: float = 1.0
    learning_averages: int = 200
    group_averages: int = 5
    speed_bin: float = 0.05
    allow_uncorrected: bool = False
    state_bin: float = 0.0
    state_lowest: float = math.nan
    state_highest: float = math.nan

    def __post_init__(self) -> None:
        """Check that the baseline has enough groups."""
        for item in PARAMETERS:
            item.convert(getattr(self, item.name))
        if self.learning_groups < LEAST_LEARNED:
            raise ParameterError(
                f'learning_averages is {self.learning_averages} and group_averages '
                f'{self.group_averages}: learn at least {LEAST_LEARNED} groups, '
                f'{LEAST_LEARNED * self.group_averages} averages')
        if self.state_lowest >= self.state_highest:
            raise ParameterError(f'state_lowest is {self.state_lowest:g}, state_highest '
                                 f'{self.state_highest:g}: give a lower one first')

    @classmethod
    def of(cls, values: Values) -> 'Settings':
        """Return the settings among the values of parameters."""
        return cls(**{item.name: values[item.name] for item in PARAMETERS})

    @property
    def learning_groups(self) -> int:
        """Return the number of groups that are learnt."""
        return self.learning_averages // self.group_averages

    @property
    def uses_state(self) -> bool:
        """Return whether the operating state counts."""
        return bool(self.state_bin) or math.isfinite(self.state_lowest) or math.isfinite(
            self.state_highest)

    def refusal(self, state: float) -> str:
        """Return why an average at an operating state is discarded, '' where it is not."""
        if not self.uses_state:
            return ''
        if math.isnan(state):
            return 'no operating state is known'
        if state < self.state_lowest:
            return f'state {state:.4g} is below {self.state_lowest:g}'
        return f'state {state:.4g} is above {self.state_highest:g}' if (
            state > self.state_highest) else ''


@dataclass(frozen=True)
class Change:
    """
    One quantity that has changed.

    `change` is the relative change against the baseline of what came `since`, with its
    `standard_error`; `keyphasor_share` is how much of it the keyphasor may explain. `p_value` is
    that of the change at its time, for all independent quantities of the shaft; the search over
    time is in the rate of false alarms. `part` is the part of the machine that makes the order,
    '' where none is known to.
    """

    shaft: str
    channel: int
    kind: str
    name: str
    change: float
    standard_error: float
    since_sequence: int
    since_time: float
    keyphasor_share: float
    p_value: float
    part: str = ''

    def content(self) -> dict[str, Any]:
        """Return the object of the topic `change`: of a known part with its name, and `order`."""
        found = {**asdict(self), 'level': None, 'limit': None}
        part = found.pop('part')
        return {**found, 'name': part, 'order': float(self.name)} if part else found

    def __str__(self) -> str:
        """
        Return the change in words.

        >>> change = Change('input', 2, 'order', '38', 0.041, 0.006, 812, 9.5, 0.003, 1e-9)
        >>> str(change).partition('; ')[0]
        'order 38 of input, channel 2: +4.1 +- 0.6 %, since average 812'
        >>> str(change).partition('; ')[2]
        'the keyphasor explains 0.3 %'
        """
        return self.words(f'average {self.since_sequence}')

    def words(self, since: str) -> str:
        """Return the change in words, with what it is `since`."""
        error = 100.0 * self.standard_error
        known = math.isfinite(error) and error > 0.0
        digits = min(max(-math.floor(math.log10(error)), 0), 6) if known else 1
        what = self.part or in_words(self.kind, self.name)
        return (f'{what} of {self.shaft}, channel {self.channel}: '
                f'{100.0 * self.change:+.{digits}f} +- {error:.{digits}f} %, since {since}; '
                f'the keyphasor explains {100.0 * self.keyphasor_share:.1f} %')


def _of_amplitude(change: float, error: float, doubt: float, square: float, least: float
                  ) -> tuple[float, float, float]:
    """
    Return the relative change of an amplitude, its error and doubt, from those of its `square`.

    Of an order that is not there the change is relative to the amplitude of its noise, whose
    square is `least`.

    >>> [round(item, 4) for item in _of_amplitude(0.21, 0.022, 0.002, 1.0, 1e-6)]
    [0.1, 0.01, 0.001]
    """
    before, after = math.sqrt(max(square, 0.0)), math.sqrt(max(square + change, 0.0))
    unit = math.sqrt(max(square, least)) or math.nan
    return (after - before) / unit, error / (2.0 * max(after, 0.5 * unit) * unit), doubt / (
        2.0 * unit**2)


def _slides(before: AverageHeader, now: AverageHeader) -> bool:
    """
    Return whether an average is as many trigger cycles after another as it is numbers.

    So are averages that share cycles. Where the source began again, its times are others.
    """
    cycle = (now.end_time - now.start_time) / max(now.trigger_cycles + now.discarded_cycles, 1)
    return all(abs(later / cycle - (now.sequence - before.sequence)) < _SAME_RUN for later in (
        now.start_time - before.start_time, now.end_time - before.end_time))


class _Group:
    """Sums over consecutive averages in one bin."""

    def __init__(self, average: MonitoredAverage) -> None:
        self.first = average.header
        self.count = 0
        shape = (3, *average.values.shape)
        self.known: FloatArray = np.zeros(shape)
        self.sums: FloatArray = np.zeros(shape)

    def add(self, average: MonitoredAverage) -> None:
        rows = np.stack((average.values, average.noise, average.doubt))
        self.count += 1
        self.known += np.isfinite(rows)
        self.sums += np.nan_to_num(rows)

    def means(self) -> FloatArray:
        """Return mean values, noise, doubt; NaN where most are missing."""
        enough = 2.0 * self.known >= self.count
        return np.where(enough, self.sums / np.maximum(self.known, 1.0), np.nan)


class ShaftMonitor:
    """
    Learns the baseline of a shaft and tests new averages against it.

    `share` is the part of the false alarms that this shaft may cause, `memory` as in `ChangeTest`;
    `machine` names the orders.
    Averages with other channels or orders raise ParameterError; indicators may be missing.
    """

    def __init__(self, shaft: str, layout: Layout, settings: Settings, *, share: float = 1.0,
                 memory: float = 0.0, machine: Machine = UNKNOWN) -> None:
        self.machine = machine
        self.shaft, self.layout, self.settings, self._share = shaft, layout, settings, share
        channels, count = layout.shape
        self._test = ChangeTest((1, channels * count), learning=settings.learning_groups,
                                memory=memory)
        # Sums of products of scores of a channel, and their numbers.
        self._products: FloatArray = np.zeros((2, channels, count, count))
        self._groups: dict[int, _Group] = {}
        self._bins = OperatingBins(settings.speed_bin, settings.state_bin)
        self._bin = 0
        self._intervals: list[float] = []
        self._end = math.nan
        self._last: AverageHeader | None = None
        self._lacking: BoolArray = np.zeros(layout.shape, np.bool_)  # in the latest group
        #: Averages taken, at all speeds, and those left out.
        self.averages = self.overlapping = self.uncorrected = self.beyond = 0

    # --- averages ---

    def update(self, average: MonitoredAverage) -> list[str]:
        """Take the next average; return lines that say which changes began and ended."""
        header, fitted = average.header, average.fitted(self.layout)
        if fitted is None:
            raise ParameterError(
                f'{self.shaft} has {average.layout}, its baseline {self.layout}: is it that of '
                'another machine? give another baseline_file, or remove this one to learn again')
        average = fitted
        last, self._last = self._last, header
        if header.start_time < self._end - 1e-9 and header.end_time > self._end and (
                last is None or _slides(last, header)):
            self.overlapping += 1
            return []
        self.uncorrected += not average.is_corrected
        if not np.isfinite(average.values).any():
            return []
        key = self._bin_of(header.mean_trigger_speed, average.state)
        if key is None:
            self.beyond += 1
            return []
        interval = header.end_time - self._end
        if interval > 0.0:
            self._intervals = [*self._intervals, interval][-_INTERVALS:]
        self._end, self._bin = header.end_time, key
        self.averages += 1
        group = self._groups.setdefault(key, _Group(average))
        group.add(average)
        if group.count < self.settings.group_averages:
            return []
        del self._groups[key]
        return self._test_group(key, group)

    def _bin_of(self, speed: float, state: float) -> int | None:
        key = self._bins.key(speed, state)
        known = self._test.bins.keys() | self._groups.keys()
        return key if key is None or key in known or len(known) < _MOST_BINS else None

    def scores_per_alarm(self) -> float:
        """Return the number of tested groups of each quantity for one false alarm."""
        interval = float(np.median(self._intervals)) if self._intervals else math.nan
        groups = YEAR / (max(interval, 1e-6) * self.settings.group_averages)
        return groups / (self.settings.false_alarms_per_year * self._share)

    def _test_group(self, key: int, group: _Group) -> list[str]:
        means = group.means()
        self._lacking = np.isnan(means[0])
        values = means[0].reshape(1, -1)
        place, level = self._test.bins.get(key), values
        if place is not None:
            self._correlate(place, values)
            known = place.baseline().mean
            level = np.where(np.isnan(known), values, known)
        noise, doubt = (item.reshape(1, -1) for item in self._of_squares(
            level.reshape(self.layout.shape), *means[1:]))
        noise = noise / np.maximum(group.known[0], 1.0).reshape(1, -1)
        mark = (float(group.first.sequence), group.first.start_time)
        changed, ended = self._test.update(key, values, noise, doubt, mark,
                                           self.scores_per_alarm())
        lines = [str(item) for item in self.changes() if changed.reshape(self.layout.shape)[
            item.channel, self.layout.quantities.index((item.kind, item.name))]]
        return lines + [f'{self._words(place)} is back at its baseline'
                        for place in np.flatnonzero(ended[0]).tolist()]

    def _of_squares(self, level: FloatArray, noise: FloatArray, doubt: FloatArray
                    ) -> tuple[FloatArray, FloatArray]:
        """
        Return variance and doubt of the squares of amplitudes, from those of the amplitudes.

        `level` are the squares in the baseline. Those of the average itself would make an average
        that is large by chance count less. Those of indicators stay as they are.
        """
        count = len(self.layout.orders)
        own, square = noise[:, :count], np.maximum(level[:, :count], 0.0)
        return (np.concatenate((4.0 * own * (square + own), noise[:, count:]), axis=1),
                np.concatenate((2.0 * np.sqrt(square + own) * doubt[:, :count],
                                doubt[:, count:]), axis=1))

    def _words(self, place: int) -> str:
        channel, quantity = divmod(place, self.layout.shape[1])
        words = self.words(*self.layout.quantities[quantity])
        return f'{words} of {self.shaft}, channel {channel}'

    def words(self, kind: str, name: str) -> str:
        """Return a quantity in words: the part of the machine, if one is known."""
        return part_of(self.machine, self.shaft, kind, name) or in_words(kind, name)

    # --- the baseline ---

    @property
    def learned(self) -> int:
        """
        Return the number of averages in the baseline at the present speed.

        It is that of the channel with the fewest. Those with more noise than others count less.
        """
        group = self._groups.get(self._bin)
        return round(float(self._learnt().min()) * self.settings.group_averages) + (
            group.count if group else 0)

    @property
    def is_complete(self) -> bool:
        """Return whether the baseline of all channels at the present speed is learnt."""
        return bool(self._learnt().min() > self.settings.learning_groups - 0.5)

    def _learnt(self) -> FloatArray:
        """Return the number of groups that each channel has learnt at the present speed."""
        place = self._test.bins.get(self._bin)
        return np.zeros(self.layout.channels) if place is None else np.asarray(
            place.count.reshape(self.layout.shape).max(axis=1))

    def not_judged(self) -> tuple[list[int], list[str]]:
        """Return the channels, and the quantities of others, that the latest averages lack."""
        channels = np.asarray(self._lacking.all(axis=1))
        others = np.flatnonzero(self._lacking & ~channels[:, None]).tolist()
        return np.flatnonzero(channels).tolist(), [self._words(place) for place in others]

    @property
    def place(self) -> str:
        """Return trigger speed and operating state in the middle of the present bin in words."""
        return self._bins.words(self._bin)

    def _correlate(self, place: SpeedBin, values: FloatArray) -> None:
        """Add the products of the deviations of values from the baseline of their bin."""
        known = place.baseline()
        scores = (values - known.mean) / np.sqrt(known.variance)
        scores = np.where(self._test.active, np.nan, np.clip(scores, -_FARTHEST, _FARTHEST))
        scores = scores.reshape(self.layout.shape)
        here = np.isfinite(scores).astype(float)
        scores = np.nan_to_num(scores)
        self._products += np.stack((np.einsum('ci,cj->cij', scores, scores),
                                    np.einsum('ci,cj->cij', here, here)))

    def correlation(self) -> FloatArray:
        """Return how the quantities of a channel correlate: (channel, quantity, quantity)."""
        product, count = self._products
        covariance = product / np.maximum(count, 1.0)
        scatter = np.sqrt(np.einsum('cii->ci', covariance))
        scale = scatter[:, :, None] * scatter[:, None, :]
        found = np.where(scale > 0.0, covariance / np.where(scale > 0.0, scale, 1.0), 0.0)
        np.einsum('cii->ci', found)[:] = 1.0
        return np.clip(found, -1.0, 1.0)

    def baseline(self, speed: float, state: float = math.nan) -> Moments | None:
        """
        Return what is learnt at a trigger speed in Hz and a state, None where nothing is.

        It is of means of groups of averages: arrays (channel, quantity).
        """
        key = self._bins.key(speed, state)
        place = None if key is None else self._test.bins.get(key)
        return None if place is None else Moments.of(*(item.reshape(
            *item.shape[:-2], *self.layout.shape) for item in (place.learned, place.reference)))

    def usual(self) -> FloatArray:
        """
        Return what readings (channel, quantity) are at the present speed, NaN before it is learnt.

        Of orders it is the root mean square of the amplitudes with their noise.
        """
        if (place := self._test.bins.get(self._bin)) is None:
            return np.full(self.layout.shape, np.nan)
        known = place.baseline()
        count = len(self.layout.orders)
        mean, noise = (item.reshape(self.layout.shape) for item in (known.mean, known.noise))
        noise = noise * self.settings.group_averages
        usual = np.concatenate([
            (np.maximum(mean[:, :count], 0.0)**2 + noise[:, :count])**0.25,
            np.exp(mean[:, count:])], axis=1)
        return np.where(
            self._learnt()[:, None] > self.settings.learning_groups - 0.5, usual, np.nan)

    # --- changes ---

    def changes(self) -> list[Change]:
        """Return the quantities that have changed, the most certain first."""
        test, (_, count) = self._test, self.layout.shape
        if not test.active.any():
            return []
        found, estimate, independent = [], test.estimate(), self._independent()
        for place in np.flatnonzero(test.active[0]).tolist():
            channel, quantity = divmod(place, count)
            sequence, time = test.begun[:, test.size[0, place], 0, place].tolist()
            change, variance, mean, noise, freedom, doubt = (float(item[0, place]) for item in (
                estimate.change, estimate.variance, estimate.baseline, estimate.noise,
                estimate.freedom, estimate.doubt))
            error = math.sqrt(variance)
            chance = float(2.0 * special.stdtr(freedom, -abs(change) / error))
            if quantity < len(self.layout.orders):
                least = math.sqrt(noise * self.settings.group_averages)
                change, error, doubt = _of_amplitude(change, error, doubt, mean, least)
            else:
                change, error = math.expm1(change), error * math.exp(change)
            if not (math.isfinite(change) and math.isfinite(sequence)):
                continue
            found.append(Change(
                self.shaft, channel, *self.layout.quantities[quantity], change, error,
                int(sequence), time, doubt, min(chance * independent, 1.0),
                part_of(self.machine, self.shaft, *self.layout.quantities[quantity])))
        return sorted(found, key=lambda item: item.p_value)

    def _independent(self) -> float:
        """Return how many independent quantities scatter as much together as the monitored do."""
        correlation = self.correlation()
        return float(np.sum(correlation.shape[1] ** 2 / np.sum(correlation**2, axis=(1, 2))))

    # --- state ---

    def state(self) -> dict[str, Array]:
        """Return what `restore` needs: arrays by names. Groups that are not full are left out."""
        return {**self._test.state(), 'products': self._products,
                'intervals': np.array(self._intervals),
                'place': np.array([self._bins.speed, self._bin, self._end, self.averages,
                                   self._bins.state])}

    def restore(self, state: dict[str, Array]) -> None:
        """Go on from a state; raises KeyError and ValueError for one of something else."""
        self._test.restore(state)
        if state['products'].shape != self._products.shape or (
                self._test.active.shape != self._test.shape):
            raise ValueError('other shape')
        self._products = state['products'].copy()
        self._intervals = state['intervals'].tolist()
        speed, key, end, averages, *states = state['place'].tolist()
        self._bin, self._end, self.averages = int(key), end, int(averages)
        self._bins.speed, self._bins.state = speed, sum(states)  # older files have none
