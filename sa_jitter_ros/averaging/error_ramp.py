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
A ramp in the recovered pulse errors: two clocks of different speed, or a wrong ratio.

Pulses that are timed by a clock of their own come later and later, or earlier, than the vibration
has them. Every average then shows the same slope of the errors, whatever their jitter.
"""

from collections import deque
import math

import numpy as np
from sa_jitter_ros.averaging.average import Average

_AVERAGES, _FEWEST = 20, 4
_SIGNIFICANT = 6.0  # standard errors
_LEAST = 2e-6  # slope of clocks that are good enough
_FEWEST_ERRORS = 6


class ErrorRamp:
    """
    Mean slope of the recovered errors of the latest averages: `update` it, `doubt` is in words.

    >>> ErrorRamp().doubt
    ''
    """

    def __init__(self) -> None:
        self._slopes: deque[float] = deque(maxlen=_AVERAGES)
        self.doubt = ''

    def update(self, average: Average, *, ratio: float) -> None:
        """Take an average of a shaft of this ratio to the tach shaft."""
        correction = average.correction
        if correction is None or not correction.accepted or correction.refitted:
            return
        known = np.isfinite(correction.pulse_errors)
        if np.count_nonzero(known) < _FEWEST_ERRORS:
            return
        times = average.pulses[known] - average.start_time
        self._slopes.append(float(np.polyfit(times, correction.pulse_errors[known], 1)[0]))
        slopes = np.array(self._slopes)
        mean, count = float(slopes.mean()), slopes.size
        error = float(slopes.std(ddof=1)) / math.sqrt(count) if count > 1 else math.inf
        self.doubt = ''
        if count >= _FEWEST and abs(mean) > max(_SIGNIFICANT * error, _LEAST):
            other = ('' if ratio == 1.0 else f', or the ratio is {ratio / (1.0 - mean):.9g} '
                     f'instead of {ratio:.9g}')
            self.doubt = (
                f'{"late" if mean > 0.0 else "early"} by {1e6 * abs(mean):.3g} us more every '
                'second than the vibration has it: the clocks of pulses and vibration differ by '
                f'{1e6 * abs(mean):.3g} ppm{other}')
