# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The path of the speed through the evidence of a comb, as a whole: dynamic programming."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

RULED_OUT = -20.0  # nats, more than a frame of any comb loses
# A step of the path up to this share of the largest one costs so many nats.
_COSTS = ((1.0 / 16.0, 0.0), (1.0 / 4.0, 0.5), (1.0, 2.0))


def best_path(evidence: NDArray[np.float32], largest: float) -> tuple[NDArray[np.intp], float]:
    """
    Return the cells (frame,) of the path with the most evidence (frame, cell), and its sum.

    From a frame to the next it moves by at most `largest` cells.
    """
    steps = [(max(round(share * largest), 1), cost) for share, cost in _COSTS]
    total = np.empty_like(evidence)
    total[0] = evidence[0]
    for k in range(1, len(evidence)):
        before = total[k - 1]
        total[k] = evidence[k] + np.maximum.reduce([
            maximum_filter1d(before, 2 * reach + 1, mode='nearest') - cost
            for reach, cost in steps])
    path = np.empty(len(evidence), np.intp)
    path[-1] = np.argmax(total[-1])
    for k in range(len(evidence) - 1, 0, -1):
        cell = path[k]
        best = -np.inf
        for reach, cost in steps:
            first = max(cell - reach, 0)
            part = total[k - 1, first:cell + reach + 1]
            near = first + int(np.argmax(part - 1e-4 * np.abs(np.arange(first, first + part.size)
                                                              - cell)))
            if total[k - 1, near] - cost > best:
                best, path[k - 1] = total[k - 1, near] - cost, near
    return path, float(total[-1].max())


def without(evidence: NDArray[np.float32], path: NDArray[np.intp], reach: NDArray[np.intp]
            ) -> NDArray[np.float32]:
    """Return the evidence with `reach` (frame,) cells on either side of a path ruled out."""
    cells = np.arange(evidence.shape[1])
    near = np.abs(cells - path[:, None]) <= reach[:, None]
    return np.where(near, np.float32(RULED_OUT), evidence)
