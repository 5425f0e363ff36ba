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
What the interpolator leaves of order amplitudes, and the orders that are refused because of it.

The gain at the frequency of an order is known (`pulses/resampling.py`), and the amplitude of each
trigger cycle is divided by it, at the speed of that cycle. From half the sampling rate on there is
none; where less than half of an amplitude is left, most of the rest is at the image of its
frequency beyond half the sampling rate, and the samples decide more than the kernel.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.parameters import listed
from sa_jitter_ros.pulses.resampling import gain_below_nyquist

#: The least gain by which an amplitude is divided.
LEAST_GAIN = 0.5


def refused_orders(orders: Sequence[float], gains: FloatArray, *, method: str, rate: float,
                   speed: float) -> dict[float, str]:
    """
    Return which orders have no amplitude, and why.

    `gains` (cycle, order) are those of all cycles, interpolated by `method` between samples at
    `rate` (Hz); `speed` (Hz) is that of the shaft.
    """
    return {float(order): _reason(float(left), method, rate, speed)
            for order, left in zip(orders, gains.min(axis=0)) if not left >= LEAST_GAIN}


def _reason(left: float, method: str, rate: float, speed: float) -> str:
    """Return why an order has no amplitude of which the interpolator leaves so much."""
    share, why = 0.5, 'shows'
    if not np.isnan(left):
        frequency = np.linspace(0.0, 0.5, 1001)[:-1]  # over the rate, up to where half is left
        share = float(frequency[gain_below_nyquist(method, frequency) >= LEAST_GAIN].max())
        why = f'interpolated {method} keeps half of'
    return (f'the shaft turns at {speed:.5g} Hz, and vibration sampled at {rate:g} Hz {why} '
            f'orders below {share * rate / speed:.5g} only; drop such orders, or check ratio and '
            'sample_rate')


def mean_gain(gains: FloatArray, orders: ArrayLike, refused: Mapping[float, str]) -> FloatArray:
    """Return the mean (order,) of `gains` (cycle, order), NaN of orders that are refused."""
    mean = gains.mean(axis=0)
    return np.where(np.isin(orders, list(refused)), np.nan, mean) if refused else mean


def without_amplitude(refused: Mapping[float, str]) -> str:
    """
    Return which orders are refused, and why, '' if none is.

    >>> without_amplitude({20.0: 'too high', 30.0: 'too high'})
    'no amplitude of orders 20, 30: too high'
    """
    reasons: dict[str, list[float]] = {}
    for order, reason in refused.items():
        reasons.setdefault(reason, []).append(order)
    return '; '.join(f'no amplitude of orders {listed(orders)}: {reason}'
                     for reason, orders in reasons.items())
