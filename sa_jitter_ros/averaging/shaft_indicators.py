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

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.averaging.average import Average, Correction
from sa_jitter_ros.averaging.indicators import (
    ConditionIndicators, GearSettings, RunningIndicators, separate)
from sa_jitter_ros.errors import ParameterError, SignalError

FloatArray = NDArray[np.float64]


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

    def use(self, gear: GearSettings) -> None:
        """Use other mesh orders; the indicators forget earlier averages."""
        if gear != self.gear:
            self.gear, self._running = gear, {}

    def of(self, average: Average) -> ConditionIndicators | None:
        """
        Return the indicators of the next average.

        None where the waveform of no channel is finite, or where it lacks a mesh order.
        """
        best = best_of(average)
        self.problem = ''
        if not np.isfinite(best.waveform).all(axis=1).any():
            return None
        corrected = average.correction is not None and average.correction.accepted
        running = self._running.setdefault(corrected, RunningIndicators(self.gear))
        try:
            running.update(best.waveform, best.parts)
        except SignalError:  # the number of channels has changed
            self._running = {corrected: (running := RunningIndicators(self.gear))}
            running.update(best.waveform, best.parts)
        except ParameterError as error:
            self.problem = str(error)
            return None
        return running.get()

    def added(self, average: Average) -> Average:
        """Return the next average with its indicators, gear signals and envelope."""
        found, best = self.of(average), best_of(average)
        values = {} if found is None else {
            name: (found[name], found.standard_errors[..., place])
            for place, name in enumerate(found.names)}
        signals = [np.full(best.waveform.shape, np.nan) for _ in range(2)]
        if found is not None:
            known = np.isfinite(best.waveform).all(axis=1)
            parts = separate(best.waveform[known], self.gear)
            signals[0][known], signals[1][known] = parts.residual, parts.difference
        return replace(average, indicators=values, residual=signals[0], difference=signals[1],
                       envelope=average.envelope or best.envelope)
