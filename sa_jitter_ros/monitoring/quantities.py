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
The numbers of an average that are monitored: orders, condition indicators and bearing orders.

Amplitudes of orders, corrected ones, are monitored by their squares less those that the noise
alone makes. These do not depend on the noise, also for weak and absent orders, where more noise
makes a larger amplitude. Indicators are monitored by their logarithms, because they are ratios and
moments, whose scatter is relative. So are bearing orders: by the depth of the modulation, the
amplitude of the squared envelope over its mean, because both follow load and speed alike.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
import math

import numpy as np
from sa_jitter_ros.arrays import BoolArray, FloatArray
from sa_jitter_ros.averaging.results import (
    AMPLITUDE_FIELDS, AverageHeader, AverageMessage, ENVELOPE_FIELDS)
from sa_jitter_ros.errors import MessageError
from sa_jitter_ros.machine import Machine

#: Topics of a shaft whose arrays make one average, by the names of their arrays.
KINDS = ('order_amplitude', 'condition_indicator', 'condition_indicator_error',
         'envelope_amplitude')
# Power of the amplitude in the numerator of each indicator: a relative error of all amplitudes
# changes the indicator by at most so many times as much.
_POWERS = {'kurtosis': 4.0, 'fm4': 4.0, 'm6a': 6.0, 'm8a': 8.0, 'na4': 4.0, 'na4_star': 4.0,
           'nb4': 4.0, 'm6a_star': 6.0, 'm8a_star': 8.0}
# A smaller share of an amplitude that jitter leaves is not known.
_LEAST_LEFT = 0.1
_FIELD = {name: place for place, name in enumerate(AMPLITUDE_FIELDS)}
_OF_BEARING = {name: place for place, name in enumerate(ENVELOPE_FIELDS)}
_NOUNS = {'order': 'order ', 'indicator': '', 'bearing': 'bearing order '}


@dataclass(frozen=True)
class Layout:
    """What is monitored of a shaft: number of channels, orders, indicators, bearing orders."""

    channels: int
    orders: tuple[float, ...]
    indicators: tuple[str, ...] = ()
    bearings: tuple[float, ...] = ()

    @property
    def quantities(self) -> tuple[tuple[str, str], ...]:
        """Return kind (`order`, `indicator` or `bearing`) and name of the quantities."""
        return (*(('order', f'{order:.6g}') for order in self.orders),
                *(('indicator', name) for name in self.indicators),
                *(('bearing', f'{order:.6g}') for order in self.bearings))

    @property
    def shape(self) -> tuple[int, int]:
        """Return the number of channels and of quantities of each."""
        return self.channels, len(self.orders) + len(self.indicators) + len(self.bearings)

    def __str__(self) -> str:
        """Return the layout in words."""
        orders, bearings = (', '.join(f'{order:.6g}' for order in some)
                            for some in (self.orders, self.bearings))
        return (f'{self.channels} channels, orders {orders or "none"} and '
                f'{len(self.indicators)} indicators'
                + (f', bearing orders {bearings}' if bearings else ''))


def in_words(kind: str, name: str) -> str:
    """
    Return a quantity in words.

    >>> in_words('bearing', '9.46')
    'bearing order 9.46'
    """
    return f'{_NOUNS[kind]}{name}'


def part_of(machine: Machine, shaft: str, kind: str, name: str) -> str:
    """Return the part of a machine that makes a quantity, '' where none is known to."""
    return '' if kind == 'indicator' else machine.name_of(
        shaft, float(name), bearing=kind == 'bearing')


@dataclass(frozen=True)
class MonitoredAverage:
    """
    The monitored quantities of one average, each array (..., channel, quantity), NaN if unknown.

    `values` are squares of amplitudes without noise, then logarithms of indicators and of the
    depths of modulation at the bearing orders; `noise` are the published variances of amplitudes
    and logarithms without, and `doubt` the published errors of the correction for the keyphasor
    alone. `readings` (4, channel, quantity) are what limits are for, also without a correction:
    amplitudes, indicators and depths themselves, their variances without and their errors by the
    correction, and 1 where they are of a corrected average, else 0; `state` is the operating one.
    """

    header: AverageHeader
    layout: Layout
    values: FloatArray
    noise: FloatArray
    doubt: FloatArray
    readings: FloatArray
    state: float = math.nan

    @property
    def is_corrected(self) -> bool:
        """Return whether the average has amplitudes that can be monitored."""
        return bool(np.isfinite(self.values[:, :len(self.layout.orders)]).any())

    def fitted(self, layout: Layout) -> 'MonitoredAverage | None':
        """
        Return the average with the quantities of a layout, NaN where it lacks them.

        None if channels or orders differ, or if the layout lacks one of the bearing orders.
        """
        own = self.layout
        if own == layout:
            return self
        if (own.channels, own.orders) != (layout.channels, layout.orders) or (
                not {*own.bearings} <= {*layout.bearings}):
            return None
        known = {quantity: place for place, quantity in enumerate(own.quantities)}
        places = np.array([known.get(item, len(known)) for item in layout.quantities], np.int64)

        def placed(array: FloatArray) -> FloatArray:
            none = np.full((*array.shape[:-1], 1), np.nan)
            return np.concatenate((array, none), axis=-1)[..., places]

        return replace(self, layout=layout, values=placed(self.values), noise=placed(self.noise),
                       doubt=placed(self.doubt), readings=placed(self.readings))


def monitored(arrays: Mapping[str, AverageMessage], *, allow_uncorrected: bool = False,
              left: FloatArray | None = None) -> MonitoredAverage:
    """
    Return what is monitored of the arrays of one average, by their topics in `KINDS`.

    Without corrected amplitudes, these and the indicators are unknown, because what is not
    corrected shows the keyphasor, too. With `allow_uncorrected` the raw ones, with their standard
    errors, take their place; what the keyphasor has taken from them is in doubt, if it is known
    what it has `left` (channel, order). Raises MessageError for arrays whose channels or
    indicators differ.
    """
    amplitudes, indicators, errors, envelope = arrays[KINDS[0]], *map(arrays.get, KINDS[1:])
    table = amplitudes.values
    channels, count, _ = table.shape
    names = indicators.names if indicators is not None else ()
    values = np.full((channels, len(names)), np.nan)
    variance = np.full(values.shape, np.nan)
    if indicators is not None:
        if indicators.values.shape != values.shape:
            raise MessageError(f'{indicators.values.shape[0]} channels of indicators and '
                               f'{channels} of orders: publish the same channels')
        values = np.where(indicators.values > 0.0, indicators.values, np.nan)
        if errors is not None and errors.names == names and errors.values.shape == values.shape:
            variance = (errors.values / values) ** 2
    amplitude, error, noise = (table[..., _FIELD[name]] for name in (
        'corrected_amplitude', 'corrected_standard_error', 'noise_standard_deviation'))
    lost = np.zeros(amplitude.shape)
    if allow_uncorrected and not np.isfinite(amplitude).any():
        amplitude, error = (table[..., _FIELD[name]]
                            for name in ('raw_amplitude', 'raw_standard_error'))
        if left is not None:
            lost = np.nan_to_num(amplitude * (1.0 / np.clip(left, _LEAST_LEFT, 1.0) - 1.0))
    noise = np.fmin(noise, error)
    doubt = np.sqrt(np.maximum(error**2 - noise**2, 0.0) + lost**2)
    power = np.array([_POWERS.get(name, 1.0) for name in names])
    total = np.nansum(amplitude**2, axis=1, keepdims=True)
    relative = np.sqrt(np.nansum(doubt**2, axis=1, keepdims=True)
                       / np.where(total > 0.0, total, np.nan))
    corrected = np.isfinite(amplitude).any(axis=1, keepdims=True) if count else np.zeros(
        (channels, 1), np.bool_)
    own = np.nan_to_num(noise) ** 2
    square = amplitude**2 - 2.0 * own
    lines = envelope.values if envelope is not None else np.empty((channels, 0, len(_OF_BEARING)))
    if len(lines) != channels:
        raise MessageError(f'{len(lines)} channels of the envelope and {channels} of orders: '
                           'publish the same channels')
    bearings = np.fmax.reduce(lines[..., _OF_BEARING['order']], initial=np.nan)
    lines = lines[:, np.isfinite(bearings)]
    amplitude, error, mean = (
        np.where(lines[..., _OF_BEARING[name]] > 0.0, lines[..., _OF_BEARING[name]], np.nan)
        for name in ('amplitude', 'standard_error', 'mean'))
    parts = ((square, np.log(values), np.log(amplitude / mean)),
             (own, variance, (error / amplitude) ** 2),
             (doubt, relative * power, np.zeros(amplitude.shape)))
    found: list[FloatArray] = [np.concatenate(part, axis=1) for part in parts]
    known = np.concatenate((np.broadcast_to(corrected, (channels, count + len(names))),
                            np.ones(amplitude.shape, np.bool_)), axis=1)
    for array in found:
        array[~(np.isfinite(array) & known)] = np.nan
    return MonitoredAverage(
        amplitudes.header, Layout(channels, tuple(table[0, :, 0].tolist()) if channels else (),
                                  names, tuple(bearings[np.isfinite(bearings)].tolist())),
        found[0], found[1], found[2],
        _readings(table, (values, variance), (amplitude / mean, (error / amplitude) ** 2)))


def best_amplitudes(table: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
    """
    Return amplitudes (..., order) of a table and their errors, the raw ones without a correction.

    Last comes which are corrected.
    """
    corrected = np.isfinite(table[..., _FIELD['corrected_amplitude']])
    amplitude, error = (np.where(corrected, table[..., _FIELD[f'corrected_{name}']],
                                 table[..., _FIELD[f'raw_{name}']])
                        for name in ('amplitude', 'standard_error'))
    return amplitude, error, corrected


def _readings(table: FloatArray, *others: tuple[FloatArray, FloatArray]) -> FloatArray:
    """Return the readings of a table, and of others: values and their relative variances."""
    amplitude, error, corrected = best_amplitudes(table)
    noise = np.fmin(table[..., _FIELD['noise_standard_deviation']], error)
    found = [np.stack((amplitude, noise**2, np.sqrt(np.maximum(error**2 - noise**2, 0.0)),
                       corrected))]
    is_corrected = [corrected.any(axis=1, keepdims=True), np.ones((len(table), 1), np.bool_)]
    for (values, variance), known in zip(others, is_corrected):
        found.append(np.stack((values, variance * values**2, np.zeros(values.shape),
                               np.broadcast_to(known, values.shape))))
    return np.concatenate(found, axis=2)


def mean_of(averages: Sequence[MonitoredAverage]) -> MonitoredAverage:
    """
    Return the mean of consecutive averages of one layout, NaN where most are missing.

    Its header is that of all of them, with the mean speed; its noise is that of the mean. Readings
    are those of the corrected averages where there are some.
    """
    means = _mean(np.array([(item.values, item.noise, item.doubt) for item in averages]),
                  0.5 * len(averages))
    readings = np.array([item.readings for item in averages])
    best = np.fmax.reduce(readings[:, 3])
    found = _mean(np.where(readings[:, 3:] >= best, readings, np.nan), 1.0)
    first, last = averages[0].header, averages[-1].header
    header = replace(
        first, end_time=last.end_time,
        trigger_cycles=sum(item.header.trigger_cycles for item in averages),
        fundamental_cycles=sum(item.header.fundamental_cycles for item in averages),
        mean_trigger_speed=float(np.mean([item.header.mean_trigger_speed for item in averages])),
        discarded_cycles=sum(item.header.discarded_cycles for item in averages))
    values, noise, doubt = means
    return MonitoredAverage(header, averages[0].layout, values, noise, doubt, found,
                            float(np.mean([item.state for item in averages])))


def _mean(rows: FloatArray, fewest: float) -> FloatArray:
    """Return the mean of rows (average, row, ...), of row 1 the variance of that of row 0."""
    known = np.isfinite(rows)
    number = known.sum(axis=0)
    means = np.where(number >= fewest, np.where(known, rows, 0.0).sum(axis=0)
                     / np.maximum(number, 1), np.nan)
    means[1] /= np.maximum(number[0], 1)
    return means
