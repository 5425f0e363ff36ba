# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Figure of what has changed: the trends of the quantities over all recordings."""

from collections.abc import Mapping
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.averaging.indicators import IN_UNIT
from sa_jitter_ros.monitoring.monitor import ShaftMonitor
from sa_jitter_ros.offline.changes import Changes, FIGURE, Key, key_of
from sa_jitter_ros.offline.plotting import draw_limits, legend_under, MARK, MEASURED

_PANELS = 6
_MOST_TICKS = 12


def write_figure(changes: Changes, output: Path) -> None:
    """Write `changes.png`; raises OSError."""
    changes_figure(changes).savefig(output / FIGURE, dpi=110)


def changes_figure(changes: Changes) -> Figure:
    """Draw what has changed, the most certain first, then what is farthest from its baseline."""
    trends = {shaft: _trends(changes, monitor) for shaft, monitor in changes.monitors.items()}
    chosen = _chosen(changes, trends)
    figure = Figure(figsize=(9.0, 1.5 * len(chosen) + 1.2), layout='constrained')
    panels = figure.subplots(len(chosen), sharex=True, squeeze=False)[:, 0]
    for axes, key in zip(panels, chosen):
        _draw(axes, changes, key, trends)
    names = [item.name for item in changes.recordings]
    places = np.arange(0, len(names), -(-len(names) // _MOST_TICKS))
    panels[-1].set_xticks(places, [names[place] for place in places], rotation=30, ha='right',
                          fontsize='small')
    legend_under(panels[-1])
    panels[-1].get_legend().set_bbox_to_anchor((0.5, -0.65))
    figure.suptitle(changes.lines()[0].rstrip(':'), fontsize='medium')
    return figure


def _trends(changes: Changes, monitor: ShaftMonitor) -> Array:
    """
    Return the values of each recording, mean and scatter of the baseline in its bin.

    They are (3, recording, channel, quantity).
    """
    unknown = np.full((3, *monitor.layout.shape), np.nan)
    found = np.stack([unknown] * len(changes.recordings), axis=1)
    for place, item in enumerate(changes.recordings):
        known = monitor.baseline(1.0, item.state)
        mean = item.means.get(monitor.shaft)
        fitted = mean and mean.fitted(monitor.layout)
        if fitted is not None:
            found[0, place] = fitted.values
        if known is not None:
            found[1:, place] = known.mean, np.sqrt(known.variance)
    return found


def _chosen(changes: Changes, trends: Mapping[str, Array]) -> list[Key]:
    """Return the quantities that are drawn."""
    keys = [(item.shaft, item.channel, *item.quantity) for item in changes.limits.passed()]
    keys += [key_of(item) for item in changes.changes]
    far: list[tuple[float, Key]] = []
    for shaft, trend in trends.items():
        values, mean, scatter = trend[:, ~np.array(changes.baseline)]
        late = np.ma.masked_invalid(np.abs(values - mean) / scatter)
        middle = np.ma.filled(np.ma.median(late, axis=0), np.nan)  # type: ignore[no-untyped-call]
        far += [(float(size), (shaft, channel, *quantity))
                for channel, row in enumerate(middle)
                for size, quantity in zip(row, changes.monitors[shaft].layout.quantities)
                if np.isfinite(size)]
    return [*dict.fromkeys([*keys, *(key for _, key in sorted(far, reverse=True))])][:_PANELS]


def _draw(axes: Axes, changes: Changes, key: Key, trends: Mapping[str, Array]) -> None:
    shaft, channel, kind, name = key
    layout = changes.monitors[shaft].layout
    place = layout.quantities.index((kind, name))
    values, mean, scatter = trends[shaft][:, :, channel, place]

    def unit(value: Array) -> Array:
        return np.sqrt(np.maximum(value, 0.0)) if kind == 'order' else np.exp(value)

    low, middle, high = unit(np.array([mean - 2.0 * scatter, mean, mean + 2.0 * scatter]))
    number = np.arange(values.size)
    axes.bar(number[np.array(changes.baseline)], 1.0, 1.0, color='0.93', linewidth=0.0,
             transform=axes.get_xaxis_transform(), label='baseline')
    axes.fill_between(number, low, high, step='mid', color='tab:blue', alpha=0.15, linewidth=0.0,
                      label='its mean ± 2 standard deviations')
    axes.step(number, middle, where='mid', color='tab:blue', linewidth=0.8)
    axes.plot(number, unit(values), '.-', color=MEASURED, linewidth=0.6, markersize=4.0)
    draw_limits(axes, [(level, bound * middle if relative else bound) for level, bound, relative
                       in changes.limits.bounds(shaft, layout, channel, place)])
    title = f'{changes.monitors[shaft].words(kind, name)} of {shaft}, channel {channel}'
    change = next((item for item in changes.changes if key_of(item) == key), None)
    if change is not None:
        names = [item.name for item in changes.recordings]
        axes.axvline(change.since_sequence - 0.5, color=MARK, linestyle='--', linewidth=1.2,
                     label='changed since')
        axes.axvline(names.index(changes.found[key]), color=MARK, linewidth=1.2, label='found')
        title = change.words(changes.since(change)).partition(';')[0]
    axes.set_title(title, fontsize='small', loc='left')
    units = changes.recordings[0].units
    known = f'\n[{units[channel] or "unit unknown"}]' if channel < len(units) else ''
    quantity = {'order': f'amplitude{known}', 'bearing': 'depth of\nmodulation'}.get(
        kind, f'{name}{known}' if name in IN_UNIT else name.replace('_', ' '))
    axes.set_ylabel(quantity, fontsize='small')
    axes.margins(x=0.01)
