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
Condition indicators and gear signals of the averages of one shaft, for library, node and files.

They are those of the corrected average where there is one.
"""

from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from threading import Lock

import numpy as np
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.averaging.average import Average, Correction
from sa_jitter_ros.averaging.indicators import (
    ConditionIndicators, gear_lines, GearSettings, RunningIndicators, separate)
from sa_jitter_ros.errors import ParameterError, SignalError


def best_of(average: Average) -> Average | Correction:
    """Return the correction of an average, itself where none was asked for."""
    return average if average.correction is None else average.correction


class ShaftIndicators:
    """
    Indicators of one average after another; some of them depend on earlier ones.

    Jitter leaves other waveforms in averages whose correction was refused: these have a history of
    their own.
    """

    def __init__(self, gear: GearSettings | None = None) -> None:
        self.gear = gear or GearSettings()
        self._running: dict[bool, RunningIndicators] = {}  # by whether they are of corrected
        self.problem = ''  # why the latest average has no condition indicators
        self._waiting: deque[_Later] = deque()  # averages that nobody has asked yet
        self._lock = Lock()

    def use(self, gear: GearSettings) -> None:
        """Use other mesh orders; the indicators forget earlier averages."""
        if gear != self.gear:
            self.gear, self._running = gear, {}

    def indicators_of(self, average: Average) -> ConditionIndicators | None:
        """
        Return the indicators of the next average.

        None where the waveform of no channel is finite, or where it lacks a mesh order.
        """
        best = best_of(average)
        if not self._has(best):
            return None
        corrected = average.correction is not None and average.correction.accepted
        running = self._running.setdefault(corrected, RunningIndicators(self.gear))
        try:
            running.update(best.waveform, best.parts)
        except SignalError:  # the number of channels has changed
            self._running = {corrected: (running := RunningIndicators(self.gear))}
            running.update(best.waveform, best.parts)
        return running.get()

    def added(self, average: Average) -> Average:
        """Return the next average, which makes indicators and gear signals when asked for them."""
        best = best_of(average)
        self._waiting.append(later := _Later(self, average, self._has(best)))
        return replace(average, later=later, envelope=average.envelope or best.envelope)

    def catch_up(self, last: '_Later | None' = None) -> None:
        """Make the indicators of the averages that wait, up to the `last`, in their order."""
        with self._lock:
            while self._waiting and (last is None or last.waits):
                item = self._waiting.popleft()
                item.found, item.waits = self.indicators_of(item.average), False

    def _has(self, best: Average | Correction) -> bool:
        """Return whether an average has indicators; where not, `problem` may say why."""
        self.problem = ''
        if not np.isfinite(best.waveform).all(axis=1).any():
            return False
        try:
            gear_lines(self.gear, best.waveform.shape[-1])
        except ParameterError as error:
            self.problem = str(error)
        return not self.problem


class _Later:
    """What an average makes when it is asked: indicators need those of the averages before it."""

    def __init__(self, source: ShaftIndicators, average: Average, known: bool) -> None:
        self.average, self.waits = average, True
        self.found: ConditionIndicators | None = None
        self._source, self._known = source, known

    def indicators(self) -> Mapping[str, tuple[FloatArray, FloatArray]]:
        """Return the indicators by name, each with its standard error."""
        self._source.catch_up(self)
        found = self.found
        return {} if found is None else {
            name: (found[name], found.standard_errors[..., place])
            for place, name in enumerate(found.names)}

    def signals(self) -> tuple[FloatArray, FloatArray]:
        """Return residual and difference signal, NaN of channels that have none."""
        waveform = best_of(self.average).waveform
        signals = np.full((2, *waveform.shape), np.nan)
        if self._known:
            known = np.isfinite(waveform).all(axis=1)
            parts = separate(waveform[known], self._source.gear)
            signals[:, known] = parts.residual, parts.difference
        return signals[0], signals[1]
