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
# Inches: what stands in 10 points is 10 pixels on a phone.
_WIDTH, _LEFT, _RIGHT, _HEIGHT = 5.2, 1.0, 0.12, 2.0  # of a figure, beside its panels, of a panel
_TITLE, _LABELS, _TURNED, _ROW, _GAP = 0.3, 0.5, 0.35, 0.18, 0.12
_LETTER = 0.075  # of a turned label
_LONG_TITLE = 44  # letters that fill a panel
_LONG = 28  # letters of a label beside which no second one has room


def with_effects(names: Sequence[str]) -> str:
    """Return a short label of a prediction with these effects."""
    return f'with {names[0]}' if len(names) == 1 else f'with {len(names)} effects'


def panels(count: int, *, one_axis: bool = False) -> tuple[Figure, list[Axes]]:
    """
    Return a figure with `count` panels one below the other, to be read on a phone, too.

    With one axis it is labelled at the last panel.
    """
    figure = Figure(figsize=(_WIDTH, _HEIGHT * count))
    axes = list(figure.subplots(count, 1, squeeze=False, sharex=one_axis).ravel())
    for one in axes:
        one.grid(alpha=0.3)
    return figure, axes


def _add_legend(panel: Axes) -> None:
    """Add the legend where it hides no data: below a panel, above one without a title."""
    below, labels = bool(panel.get_title()), panel.get_legend_handles_labels()[1]
    if labels:
        panel.legend(fontsize='small', ncols=_columns(labels),
                     loc='upper center' if below else 'lower left',
                     bbox_to_anchor=(0.5, -_LABELS / _HEIGHT) if below else (0.0, 1.0),
                     borderaxespad=0.0, frameon=False)


def arrange(figure: Figure) -> None:
    """
    Give all panels legends and the same size, and make room for what stands around them.

    The layouts of matplotlib measure all texts for that, which takes as long as to draw them.
    """
    for panel in figure.axes:
        _add_legend(panel)
    rooms = [_room(panel, panel is figure.axes[-1]) for panel in figure.axes]
    height = top = sum(above + _HEIGHT + below for above, below in rooms)
    figure.set_size_inches(_WIDTH, height)
    for panel, (above, below) in zip(figure.axes, rooms):
        if len(panel.get_title()) > _LONG_TITLE:
            panel.title.set_fontsize('small')
        top -= above + _HEIGHT
        panel.set_position((_LEFT / _WIDTH, top / height, 1.0 - (_LEFT + _RIGHT) / _WIDTH,
                            _HEIGHT / height))
        top -= below


def _room(panel: Axes, last: bool) -> tuple[float, float]:
    """Return the room above and below a panel in inches."""
    legend, title = panel.get_legend(), bool(panel.get_title())
    labels = [text.get_text() for text in legend.get_texts()] if legend else []
    rows = _ROW * -(-len(labels) // _columns(labels))
    below = _LABELS if last or panel.get_xlabel() else 0.0
    turned = [len(label.get_text()) for label in panel.get_xticklabels() if label.get_rotation()]
    below += max(_TURNED, _LETTER * max(turned)) if turned else 0.0
    return (_GAP + _TITLE, below + rows) if title else (_GAP + rows, below)


def _columns(labels: Sequence[str]) -> int:
    return 1 if max(map(len, labels), default=0) > _LONG else 2
