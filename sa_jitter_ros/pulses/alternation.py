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
from collections.abc import Iterable
import math
from statistics import fmean

_BLOCK, _FEWEST, _MOST = 16, 12, 64  # intervals in a block, an even number; blocks
_SURE = 10.0  # standard errors
_LEAST = 2e-5  # of an interval


class Alternation:
    """
    How much longer every other interval is: `update` it with levels, `size` is what they show.

    >>> alternation = Alternation()
    >>> alternation.update([0.001, -0.00099, 0.00101, -0.001] * 100)
    >>> round(abs(alternation.size), 4)
    0.001
    """

    def __init__(self) -> None:
        self._levels: list[float] = []
        self._found: deque[float] = deque(maxlen=_MOST)
        self.size = 0.0  # of the logarithm of an interval, 0 as long as it may be chance

    def update(self, levels: Iterable[float]) -> None:
        """Take the logarithms of the next intervals."""
        self._levels += levels
        while len(self._levels) >= _BLOCK + 2:
            part = self._levels[:_BLOCK + 2]
            bends = (middle - 0.5 * (before + after)
                     for before, middle, after in zip(part, part[1:], part[2:]))
            self._found.append(0.5 * fmean(
                -bend if number % 2 else bend for number, bend in enumerate(bends)))
            del self._levels[:_BLOCK]
            self._look()

    def _look(self) -> None:
        count = len(self._found)
        if count < _FEWEST:
            return
        mean = fmean(self._found)
        error = math.sqrt(sum((item - mean)**2 for item in self._found) / (count - 1) / count)
        self.size = mean if abs(mean) > max(_SURE * error, _LEAST) else 0.0
