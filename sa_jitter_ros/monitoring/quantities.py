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
The numbers of an average that are monitored: corrected order amplitudes and condition indicators.

Amplitudes are monitored by their squares less those that the noise alone makes. These do not
depend on the noise, also for weak and absent orders, where more noise makes a larger amplitude.
Indicators are monitored by their logarithms, because they are ratios and moments, whose scatter is
relative.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.averaging.results import AMPLITUDE_FIELDS, AverageHeader, AverageMessage
from sa_jitter_ros.errors import MessageError

FloatArray = NDArray[np.float64]

# Power of the amplitude in the numerator of each indicator: a relative error of all amplitudes
# changes the indicator by at most so many times as much.
_POWERS = {'kurtosis': 4.0, 'fm4': 4.0, 'm6a': 6.0, 'm8a': 8.0, 'na4': 4.0, 'na4_star': 4.0,
           'nb4': 4.0, 'm6a_star': 6.0, 'm8a_star': 8.0}
_FIELD = {name: place for place, name in enumerate(AMPLITUDE_FIELDS)}


@dataclass(frozen=True)
class Layout:
    """What is monitored of a shaft: number of channels, orders, and names of the indicators."""

    channels: int
    orders: tuple[float, ...]
    indicators: tuple[str, ...] = ()

    @property
    def shape(self) -> tuple[int, int]:
        """Return the number of channels and of quantities of each."""
        return self.channels, len(self.orders) + len(self.indicators)

    def kind(self, quantity: int) -> str:
        """Return what a quantity is, `order` or `indicator`."""
        return 'order' if quantity < len(self.orders) else 'indicator'

    def name(self, quantity: int) -> str:
        """Return the order, or the name of the indicator."""
        count = len(self.orders)
        return (f'{self.orders[quantity]:.6g}' if quantity < count
                else self.indicators[quantity - count])

    def __str__(self) -> str:
        """Return the layout in words."""
        orders = ', '.join(self.name(place) for place in range(len(self.orders)))
        return (f'{self.channels} channels, orders {orders or "none"} and '
                f'{len(self.indicators)} indicators')


@dataclass(frozen=True)
class MonitoredAverage:
    """
    The monitored quantities of one average, each array (channel, quantity), NaN where unknown.

    `values` are squares of amplitudes without noise, then logarithms of indicators; `noise` are
    the published variances of amplitudes and logarithms without, and `doubt` the published errors
    of the correction for the keyphasor alone.
    """

    header: AverageHeader
    layout: Layout
    values: FloatArray
    noise: FloatArray
    doubt: FloatArray

    @property
    def is_known(self) -> bool:
        """Return whether the average has amplitudes that can be monitored."""
        return bool(np.isfinite(self.values[:, :len(self.layout.orders)]).any())

    def fitted(self, layout: Layout) -> 'MonitoredAverage | None':
        """
        Return the average with the indicators of a layout, NaN where it lacks them.

        None if channels or orders differ.
        """
        if self.layout == layout:
            return self
        if (self.layout.channels, self.layout.orders) != (layout.channels, layout.orders):
            return None
        count, names = len(layout.orders), self.layout.indicators
        found = []
        for array in (self.values, self.noise, self.doubt):
            rows = np.full(layout.shape, np.nan)
            rows[:, :count] = array[:, :count]
            for place, name in enumerate(layout.indicators):
                if name in names:
                    rows[:, count + place] = array[:, count + names.index(name)]
            found.append(rows)
        return MonitoredAverage(self.header, layout, *found)


def monitored(amplitudes: AverageMessage, indicators: AverageMessage | None = None,
              errors: AverageMessage | None = None, *, allow_uncorrected: bool = False
              ) -> MonitoredAverage:
    """
    Return what is monitored of the arrays of one average.

    Without corrected amplitudes all is unknown, because what is not corrected shows the keyphasor,
    too. With `allow_uncorrected` the raw ones, with their standard errors, take their place.
    Raises MessageError for arrays whose channels or indicators differ.
    """
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
    if allow_uncorrected and not np.isfinite(amplitude).any():
        amplitude, error = (table[..., _FIELD[name]]
                            for name in ('raw_amplitude', 'raw_standard_error'))
    noise = np.fmin(noise, error)
    doubt = np.sqrt(np.maximum(error**2 - noise**2, 0.0))
    power = np.array([_POWERS.get(name, 1.0) for name in names])
    total = np.nansum(amplitude**2, axis=1, keepdims=True)
    relative = np.sqrt(np.nansum(doubt**2, axis=1, keepdims=True)
                       / np.where(total > 0.0, total, np.nan))
    corrected = np.isfinite(amplitude).any(axis=1, keepdims=True) if count else np.zeros(
        (channels, 1), np.bool_)
    own = np.nan_to_num(noise) ** 2
    square = amplitude**2 - 2.0 * own
    found = MonitoredAverage(
        amplitudes.header, Layout(channels, tuple(table[0, :, 0].tolist()) if channels else (),
                                  names),
        np.concatenate((square, np.log(values)), axis=1),
        np.concatenate((own, variance), axis=1),
        np.concatenate((doubt, relative * power), axis=1))
    for array in (found.values, found.noise, found.doubt):
        array[~(np.isfinite(array) & corrected)] = np.nan
    return found
