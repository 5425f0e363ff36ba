# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The latest rows of a series, as one array."""

import numpy as np
from sa_jitter_ros.arrays import Array


class LatestRows:
    """
    Keeps the latest `most` rows of what is added, in memory that is never used again.

    >>> rows = LatestRows(3)
    >>> for first in 0, 2:
    ...     rows.add(np.arange(first, first + 2.0)[:, None])
    >>> rows.get().T
    array([[1., 2., 3.]])
    """

    def __init__(self, most: int) -> None:
        self._most, self._count, self._end = most, 0, 0
        self._rows: Array = np.empty(0)

    def add(self, rows: Array) -> None:
        """Append rows."""
        count = len(rows)
        if self._end + count > len(self._rows):
            kept = min(self._count, self._most - 1)
            room = np.empty((max(2 * (kept + count), 16), *rows.shape[1:]), rows.dtype)
            if kept:
                room[:kept] = self._rows[self._end - kept:self._end]
            self._rows, self._end = room, kept
        self._rows[self._end:self._end + count] = rows
        self._end += count
        self._count += count

    def get(self) -> Array:
        """Return the latest rows, read-only."""
        count = min(self._count, self._most)
        latest = self._rows[self._end - count:self._end]
        latest.flags.writeable = False
        return latest
