# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Channels that hold no vibration: NaN, constant, or at the end of their range."""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_MOST_LOST = 0.5  # of the samples
_AT_END = 0.02  # of the samples, at the very same largest or smallest value
_FEWEST = 16


def bad_channels(samples: FloatArray) -> dict[int, str]:
    """
    Return the channels of samples (channel, sample) that hold no vibration, with the reason.

    >>> time = np.arange(1000)
    >>> bad_channels(np.array([np.sin(0.1 * time), 0.0 * time, np.clip(np.sin(time), -0.5, 0.5)]))
    {1: 'is constant', 2: 'is saturated in 66% of its samples'}
    """
    found: dict[int, str] = {}
    for channel, values in enumerate(samples):
        finite = values[np.isfinite(values)]
        if finite.size < _MOST_LOST * values.size:
            share = 1.0 - finite.size / values.size
            found[channel] = f'is NaN or infinite in {share:.0%} of its samples'
        elif finite.size < _FEWEST:
            continue
        elif np.ptp(finite) == 0.0:
            found[channel] = 'is constant'
        else:
            low, high = finite.min(), finite.max()
            top, bottom = float(np.mean(finite == high)), float(np.mean(finite == low))
            # A switch has two values, a saturated signal has others between its ends.
            if top + bottom > _AT_END and min(top, bottom) > 0.25 * _AT_END and (
                    np.unique(finite[:4096]).size > 8):
                found[channel] = f'is saturated in {top + bottom:.0%} of its samples'
    return found
