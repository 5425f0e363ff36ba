# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Colours, panels and legends that the figures of a report share."""

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

BEFORE, AFTER, MEASURED = 'tab:red', 'tab:blue', 'black'


def with_effects(names: Sequence[str]) -> str:
    """Return a short label of a prediction with these effects."""
    return f'with {names[0]}' if len(names) == 1 else f'with {len(names)} effects'


def panels(count: int, *, columns: int) -> tuple[Figure, list[Axes]]:
    """Return a figure with `count` panels in rows of `columns`."""
    rows = -(-count // columns)
    figure = Figure(figsize=(3.6 * columns, 3.1 * rows), layout='constrained')
    axes = list(figure.subplots(rows, columns, squeeze=False).ravel())
    for spare in axes[count:]:
        spare.remove()
    for one in axes[:count]:
        one.grid(alpha=0.3)
        one.tick_params(labelsize='small')
    return figure, axes[:count]


def legend_below(axes: Axes) -> None:
    """Add the legend below a panel, where it does not hide data."""
    axes.legend(fontsize='x-small', loc='upper center', bbox_to_anchor=(0.5, -0.2), ncols=2,
                frameon=False)
