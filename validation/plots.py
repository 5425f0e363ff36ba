# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""What the figures of the reproduction have in common."""

from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

COLOURS = ('tab:red', 'tab:green', 'tab:purple', 'tab:blue')
_POINTS = 400


def panels(columns: int, rows: int = 1, *, height: float = 4.0) -> tuple[Figure, list[Axes]]:
    """Return a figure and its axes, row by row, without the state of pyplot."""
    figure = Figure(figsize=(4.6 * columns, height * rows), dpi=110, layout='constrained')
    axes = figure.subplots(rows, columns, squeeze=False)
    return figure, list(axes.ravel())


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG: what `savefig` does, without laying everything out twice."""
    canvas: Any = FigureCanvasAgg(figure)
    canvas.print_png(path, metadata={'Software': None})


def distribution(axes: Axes, sample: Array, **style: Any) -> None:
    """Draw the distribution function of a sample."""
    ordered = np.sort(sample)
    share = np.arange(1, ordered.size + 1) / ordered.size
    if ordered.size > _POINTS:
        keep = np.unique(np.linspace(0, ordered.size - 1, _POINTS).astype(int))
        ordered, share = ordered[keep], share[keep]
    axes.step(ordered, share, where='post', **style)


def panel_titles(axes: list[Axes], titles: list[str]) -> None:
    """Letter the panels as the paper does."""
    for letter, one, title in zip('abcdef', axes, titles):
        one.set_title(f'({letter}) {title}', fontsize=10)
        one.grid(alpha=0.3)
