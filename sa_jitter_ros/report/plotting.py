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
from matplotlib.layout_engine import ConstrainedLayoutEngine

BEFORE, AFTER, MEASURED = 'tab:red', 'tab:blue', 'black'
WIDTH, PANEL_HEIGHT = 5.2, 3.1  # inches: what stands in 10 points is 10 pixels on a phone


def with_effects(names: Sequence[str]) -> str:
    """Return a short label of a prediction with these effects."""
    return f'with {names[0]}' if len(names) == 1 else f'with {len(names)} effects'


def panels(count: int) -> tuple[Figure, list[Axes]]:
    """Return a figure with `count` panels one below the other, to be read on a phone, too."""
    figure = Figure(figsize=(WIDTH, PANEL_HEIGHT * count),
                    layout=ConstrainedLayoutEngine(h_pad=0.12))
    axes = list(figure.subplots(count, 1, squeeze=False).ravel())
    for one in axes:
        one.grid(alpha=0.3)
    return figure, axes


def legend_below(axes: Axes) -> None:
    """Add the legend below a panel, where it does not hide data."""
    axes.legend(fontsize='small', loc='upper center', bbox_to_anchor=(0.5, -0.2), ncols=2,
                frameon=False)


def legend_above(axes: Axes) -> None:
    """Add the legend above a panel that has no title."""
    axes.legend(fontsize='small', loc='lower left', bbox_to_anchor=(0.0, 1.0), frameon=False)
