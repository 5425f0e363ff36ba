# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""What the latest averages lack: one that lacks something counts until others have come."""

from collections import deque

_LATEST = 10  # averages that are looked at


class Shortfall:
    """
    How many of the latest averages lack something that the user asked for.

    >>> lack = Shortfall()
    >>> for lacks in True, False, False:
    ...     lack.add(lacks)
    >>> bool(lack), str(lack)
    (True, '1 of the latest 3 averages')
    """

    def __init__(self) -> None:
        self._latest: deque[bool] = deque(maxlen=_LATEST)

    def add(self, lacks: bool) -> None:
        """Take whether the next average lacks it."""
        self._latest.append(lacks)

    def __bool__(self) -> bool:
        """Return whether any of them lacks it."""
        return any(self._latest)

    def __str__(self) -> str:
        """Return how many of them lack it."""
        count = len(self._latest)
        return (f'{sum(self._latest)} of the latest {count} averages' if count > 1
                else 'the latest average')
