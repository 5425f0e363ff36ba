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

from sa_jitter_ros.arrays import Array
from sa_jitter_ros.inner_loops import room


class Rows:
    """
    Rows, added at the end and removed at the start, in memory that is never used again.

    `none` is an array of no rows, of which all others have shape and type.

    >>> import numpy as np
    >>> rows = Rows(np.empty((0, 1)))
    >>> for first in 0, 2:
    ...     rows.append(np.arange(first, first + 2.0)[:, None])
    >>> rows.drop(1)
    >>> len(rows), rows.items.T
    (3, array([[1., 2., 3.]]))
    """

    def __init__(self, none: Array) -> None:
        self._data = none
        self._begin = self._end = 0

    def __len__(self) -> int:
        """Return the number of rows."""
        return self._end - self._begin

    @property
    def items(self) -> Array:
        """Return the rows, without a copy."""
        return self._data[self._begin:self._end]

    def space(self, count: int) -> Array:
        """Return where the next `count` rows are to be written, before `add`."""
        if self._end + count > len(self._data):
            kept = self.items
            self._data = room((max(4 * (len(kept) + count), 64), *kept.shape[1:]), kept.dtype)
            self._data[:len(kept)] = kept
            self._begin, self._end = 0, len(kept)
        return self._data[self._end:self._end + count]

    def add(self, count: int) -> None:
        """Take what was written to the `space` of so many rows."""
        self._end += count

    def append(self, rows: Array) -> None:
        """Add rows behind the last one."""
        self.space(len(rows))[:] = rows
        self.add(len(rows))

    def drop(self, count: int) -> None:
        """Remove the first `count` rows."""
        self._begin += count
