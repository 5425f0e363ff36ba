# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Whether the listed orders hold any line of the vibration, as the averages show it."""

from collections.abc import Sequence

import numpy as np
from sa_jitter_ros.averaging.average import Average
from sa_jitter_ros.parameters import listed

_STANDS = 4.0  # standard deviations of the noise of an amplitude
_FEWEST_CYCLES = 5  # that tell the noise of an average


def without_lines(averages: Sequence[Average], *, fewest: int = 1) -> str:
    """
    Return that none of the orders of a shaft stands above its noise, '' if one of them does.

    An order stands where its amplitude is clear in one average of two, or in the mean of all. Of
    fewer than `fewest` averages of at least 5 trigger cycles nothing is said.

    >>> import sa_jitter_ros as sa
    >>> time = np.arange(60_000) / 5e3
    >>> noise = np.random.default_rng(1).normal(size=time.size)
    >>> vibration = np.cos(2.0 * np.pi * 23.0 * 20.0 * time) + noise
    >>> averager = sa.Averager(5e3, orders=[24.0], trigger_cycles=20)
    >>> averages = averager.update(vibration, np.arange(240) / 20.0) + averager.flush()
    >>> without_lines(averages)  # doctest: +ELLIPSIS
    'none of the orders 24 stands above its noise at 20 Hz: ...'
    """
    latest = averages[-1] if averages else None
    averages = [item for item in averages if latest is not None and item.orders.size
                and item.trigger_cycles >= _FEWEST_CYCLES
                and item.amplitudes.shape == latest.amplitudes.shape
                and np.array_equal(item.orders, latest.orders)]
    if len(averages) < max(fewest, 1):
        return ''
    amplitudes = np.array([item.amplitudes for item in averages])
    noise = np.array([item.noise for item in averages])
    corrected = np.array([
        item.correction.amplitudes if item.correction is not None and item.correction.accepted
        else item.amplitudes for item in averages])
    size = np.fmax(np.abs(amplitudes), np.abs(corrected))
    known = np.isfinite(size) & np.isfinite(noise)
    if not known.any() or not np.any(size[known] > 0.0):
        return ''  # refused, or a dead channel, which is told elsewhere
    clear = np.where(known, size > _STANDS * noise, False)
    mean = np.abs(np.where(known, amplitudes, 0.0).sum(axis=0))
    scatter = np.where(known, noise, 0.0).sum(axis=0) / np.sqrt(
        np.maximum(np.count_nonzero(known, axis=0), 1))
    if np.mean(clear.any(axis=(1, 2))) > 0.5 or np.any(mean > _STANDS * scatter):
        return ''
    speed = float(np.mean([item.trigger_speed for item in averages]))
    return (f'none of the orders {listed(averages[0].orders)} stands above its noise at '
            f'{speed:.4g} Hz: check orders, ratio, pulses_per_revolution and sample_rate, or '
            'average more trigger cycles')
