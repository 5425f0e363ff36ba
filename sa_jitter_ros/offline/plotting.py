# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Colours, panels and labels that the figures of averages share."""

from collections.abc import Iterable
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np
from sa_jitter_ros.offline.files import Signals
from sa_jitter_ros.offline.series import ShaftSeries

RAW, CORRECTED, MEASURED, MARK = 'tab:red', 'tab:blue', 'black', 'tab:orange'
MOST_CHANNELS = 3
_LEVELS = {'warn': 'darkorange', 'alarm': 'red'}
VARIES = 0.02  # relative change of speed from which on results are shown over speed, too


def strongest_channels(series: ShaftSeries) -> list[int]:
    """Return the places of the channels with the largest waveforms of the latest average."""
    size = np.nan_to_num(np.std(series['waveform'][-1], axis=1))
    return sorted(np.argsort(-size)[:MOST_CHANNELS].tolist())


def speed_varies(series: ShaftSeries) -> bool:
    """Return whether the averages are at different speeds."""
    speed = series['trigger_speed']
    return bool(np.ptp(speed) > VARIES * np.mean(speed))


def heading(signals: Signals, series: ShaftSeries, text: str) -> str:
    """Return the title of a figure: recording, shaft, and what it shows."""
    return f'{signals.recording}, {series.shaft}: {text}'


def squared(unit: str) -> str:
    """
    Return the square of a unit.

    >>> squared('g'), squared('m/s^2'), squared('')
    ('g²', '(m/s^2)²', 'unit²')
    """
    return f'{unit or "unit"}²' if unit.isalpha() or not unit else f'({unit})²'


def rows_of_channels(signals: Signals, series: ShaftSeries, channels: list[int], text: str,
                     *labels: str, height: float = 2.4) -> tuple[Figure, Any]:
    """
    Return a figure with a row of panels for each channel, (channel, column), and its heading.

    `labels` are those of the axes below the columns.
    """
    figure = Figure(figsize=(9.0, height * len(channels) + 0.8), layout='constrained')
    panels = figure.subplots(len(channels), len(labels), sharex='col', squeeze=False)
    figure.suptitle(heading(signals, series, text), fontsize='medium')
    for row, channel in zip(panels, channels):
        row[0].set_ylabel(signals.label(channel))
    for axes, label in zip(panels[-1], labels):
        axes.set_xlabel(label)
    return figure, panels


def draw_limits(axes: Axes, bounds: Iterable[tuple[str, Any]], name: str = '') -> None:
    """
    Draw limits, level and bound, as lines with their level, and the name of the quantity.

    A bound is one number, or an array with one for each of the points 0, 1, ... of the axis.
    """
    for level, bound in bounds:
        if np.ndim(bound):
            axes.step(np.arange(bound.size), bound, where='mid', color=_LEVELS[level],
                      linestyle='--', linewidth=1.0)
        else:
            axes.axhline(bound, color=_LEVELS[level], linestyle='--', linewidth=1.0)
        last = float(np.ravel(bound)[-1])
        axes.annotate(f'{level} {name}'.rstrip(), (0.995, last), ha='right', va='bottom',
                      xycoords=('axes fraction', 'data'), fontsize='x-small',
                      color=_LEVELS[level])


def legend_under(axes: Axes, columns: int = 4) -> None:
    """Add the legend below the axis of a panel, where it hides no data."""
    axes.legend(loc='upper center', bbox_to_anchor=(0.5, -0.25), ncols=columns, fontsize='small',
                frameon=False)
