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
Samples that single channels lack: these have no average there, and the others lose nothing.

The samples are averaged as 0, and the channels are NaN in the averages that hold such cycles. A
channel without finite samples, or with the same value for ever, tells nothing of the pulse errors.
"""

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any, TypeVar

import numpy as np
from sa_jitter_ros.arrays import BoolArray, FloatArray
from sa_jitter_ros.averaging.average import Average
from sa_jitter_ros.averaging.cycle import CycleSamples

Result = TypeVar('Result')

_CONSTANT = 1e-9  # relative scatter of a constant that was resampled
_FORGOTTEN = 8  # trigger cycles of an exponential average over N_t, after which one counts 1e-7
_OF_SECOND_AXIS = ('cycle_amplitudes', 'waveforms')
_OF_FIRST_AXIS = (
    'waveform', 'standard_error', 'amplitudes', 'noise', 'attenuation',
    'attenuation_standard_error', 'amplitude', 'phase', 'upper_95', 'found', 'standard_errors',
    'mean', 'spectrum')
_NESTED = ('amplitude_errors', 'parts', 'envelope', 'correction')


class ChannelGaps:
    """Knows which channels lack samples in the cycles of a block, or of all averages so far."""

    def __init__(self) -> None:
        self._taken = 0
        self._latest: dict[int, int] = {}  # cycles taken, with the latest one that a channel lacks

    def take(self, cycles: CycleSamples) -> None:
        """Take the next cycles."""
        for number, channels in enumerate(cycles.lacking, self._taken + 1):
            self._latest.update(dict.fromkeys(channels, number))
        self._taken += cycles.count

    def blank(self, average: Average, *, averaging: str, trigger_cycles: int) -> Average:
        """Return an average of the latest cycles with NaN in the channels that lack samples."""
        reach = trigger_cycles * (_FORGOTTEN if averaging == 'exponential' else 1)
        lacking = sorted(channel for channel, at in self._latest.items()
                         if at > self._taken - reach)
        return _blanked(average, lacking) if lacking else average


def telling(grid: FloatArray, cycles: Sequence[CycleSamples]) -> BoolArray:
    """Return which channels of `grid` (cycle, sample, channel) tell of the pulse errors."""
    flat = grid.reshape(-1, grid.shape[2])
    low, high = flat.min(axis=0), flat.max(axis=0)
    found = high - low > _CONSTANT * np.maximum(np.abs(low), np.abs(high))
    found[[channel for cycle in cycles for of_one in cycle.lacking for channel in of_one]] = False
    return np.asarray(found)


def _blanked(result: Result, channels: list[int]) -> Result:
    """Return a dataclass of results with NaN in these channels."""
    changed: dict[str, Any] = {}
    for name in (item.name for item in fields(result)):  # type: ignore[arg-type]
        value = getattr(result, name)
        if value is None:
            continue
        if name in _NESTED:
            changed[name] = _blanked(value, channels)
        elif isinstance(value, np.ndarray) and name in _OF_FIRST_AXIS + _OF_SECOND_AXIS:
            changed[name] = value.copy()
            changed[name][(slice(None),) * (name in _OF_SECOND_AXIS) + (channels,)] = np.nan
    return replace(result, **changed)  # type: ignore[type-var]
