# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Intervals of a single mark that are longer and shorter in turns: they are those of two."""

from collections import deque
import math

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_BLOCK, _FEWEST, _MOST = 16, 12, 64  # intervals in a block, an even number; blocks
_SURE = 10.0  # standard errors
_LEAST = 2e-5  # of an interval
_SIGNS = np.resize([0.5, -0.5], _BLOCK)


class Alternation:
    """
    How much longer every other interval is: `update` it with levels, `size` is what they show.

    >>> rng = np.random.default_rng(1)
    >>> alternation = Alternation()
    >>> alternation.update(np.resize([0.001, -0.001], 400) + rng.normal(0.0, 1e-4, 400))
    >>> round(abs(alternation.size), 4)
    0.001
    """

    def __init__(self) -> None:
        self._levels: FloatArray = np.empty(0)
        self._found: deque[float] = deque(maxlen=_MOST)
        self.size = 0.0  # of the logarithm of an interval, 0 as long as it may be chance

    def update(self, levels: FloatArray) -> None:
        """Take the logarithms of the next intervals (n,)."""
        self._levels = np.concatenate((self._levels, levels))
        while self._levels.size >= _BLOCK + 2:
            part = self._levels[:_BLOCK + 2]
            bend = part[1:-1] - 0.5 * (part[:-2] + part[2:])
            self._found.append(float(np.mean(_SIGNS * bend)))
            self._levels = self._levels[_BLOCK:]
        count = len(self._found)
        if count < _FEWEST:
            return
        mean = float(np.mean(self._found))
        error = float(np.std(self._found, ddof=1)) / math.sqrt(count)
        self.size = mean if abs(mean) > max(_SURE * error, _LEAST) else 0.0
