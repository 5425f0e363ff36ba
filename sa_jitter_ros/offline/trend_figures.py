# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Figure of the tracked orders: amplitude and phase over time, and over speed in a run-up."""

from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.monitoring.quantities import Layout
from sa_jitter_ros.number_text import order_words
from sa_jitter_ros.offline.average_figures import on_strongest, strongest_lines
from sa_jitter_ros.offline.files import Signals
from sa_jitter_ros.offline.plotting import draw_limits, heading, speed_varies
from sa_jitter_ros.offline.series import ShaftSeries

_FEWEST = 2  # averages
_MOST_ORDERS = 6
_CLEAR = 3.0  # amplitude over its noise, from which on an order has a phase


def tracked_orders_figure(signals: Signals, series: ShaftSeries) -> Figure | None:
    """Draw the strongest of the tracked orders, each on its strongest channel."""
    if len(series) < _FEWEST:
        return None
    kind = 'corrected' if np.isfinite(series.field('corrected_amplitude')).any() else 'raw'
    amplitude, phase = (on_strongest(series, f'{kind}_{name}') for name in ('amplitude', 'phase'))
    error = on_strongest(series, f'{kind}_standard_error')
    noise = on_strongest(series, 'noise_standard_deviation')
    error = np.where(np.isfinite(error), error, noise)
    size = np.sqrt(np.nan_to_num(np.square(amplitude)).mean(axis=0))
    chosen = np.sort(np.argsort(-size)[:_MOST_ORDERS])
    time = 0.5 * (series['start_time'] + series['end_time'])
    columns: list[tuple[str, Array]] = [('time [s]', time)]
    if speed_varies(series):
        columns.append(('speed of the tach shaft [Hz]', series['trigger_speed']))
    figure = Figure(figsize=(9.0, 6.4), layout='constrained')
    panels = figure.subplots(2, len(columns), sharex='col', sharey='row', squeeze=False)
    channels = strongest_lines(series)
    layout = Layout(len(signals.channels), tuple(series.orders.tolist()))
    names = [order_words(order, signals.machine.name_of(series.shaft, order))
             for order in series.orders.tolist()]
    for number, (label, place) in enumerate(columns):
        for colour, order in enumerate(chosen.tolist()):
            _draw(panels[0, number], panels[1, number], place, amplitude[:, order],
                  error[:, order], _phase(phase[:, order], amplitude[:, order], noise[:, order]),
                  color=f'C{colour}', label=f'{names[order]}, '
                  f'{signals.channel_names[channels[order]]}')
            draw_limits(panels[0, number], [
                (level, bound) for level, bound, relative in signals.limits.bounds(
                    series.shaft, layout, int(channels[order]), order) if not relative],
                names[order])
        panels[1, number].set_xlabel(label)
    units = {signals.units[channels[order]] for order in chosen.tolist()}
    panels[0, 0].set_ylabel(f'{kind} amplitude [{" / ".join(sorted(units)) or "unit unknown"}]')
    panels[1, 0].set_ylabel('phase [degrees]')
    panels[0, 0].set_ylim(bottom=0.0)
    figure.suptitle(heading(signals, series, 'tracked orders, ± 1 standard error'),
                    fontsize='medium')
    figure.legend(*panels[-1, 0].get_legend_handles_labels(), loc='outside lower center', ncols=2,
                  fontsize='small', frameon=False)
    return figure


def _phase(phase: Array, amplitude: Array, noise: Array) -> Array:
    """Return the phase in degrees, continued from average to average; NaN where noise hides it."""
    clear = np.isfinite(phase) & (amplitude > _CLEAR * noise)
    found = np.full(phase.shape, np.nan)
    found[clear] = np.degrees(np.unwrap(phase[clear]))
    return found


def _draw(top: Axes, bottom: Axes, place: Array, amplitude: Array, error: Array, phase: Array, *,
          color: str, label: str) -> None:
    style: dict[str, Any] = {'color': color, 'marker': '.', 'markersize': 4.0, 'linewidth': 0.8}
    top.errorbar(place, amplitude, yerr=error, elinewidth=0.8, label=label, **style)
    bottom.plot(place, phase, label=label, **style)
