# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Figure of the squared envelope of the residual signal: its order spectrum."""

from matplotlib.figure import Figure
import numpy as np
from sa_jitter_ros.averaging.envelope import SLIP
from sa_jitter_ros.offline.files import Signals
from sa_jitter_ros.offline.plotting import (
    legend_under, MARK, MEASURED, rows_of_channels, squared, strongest_channels)
from sa_jitter_ros.offline.series import ShaftSeries


def envelope_figure(signals: Signals, series: ShaftSeries) -> Figure | None:
    """Draw the spectrum of the strongest channels, RMS of the averages; None without one."""
    if 'envelope_spectrum' not in series:
        return None
    orders, spectrum = np.moveaxis(series['envelope_spectrum'], -1, 0)
    found = np.nan_to_num(series['envelope_amplitude'])
    known = np.isfinite(spectrum).all(axis=(1, 2))
    if not known.any():
        return None
    channels = strongest_channels(series)
    figure, panels = rows_of_channels(signals, series, channels, (
        'squared-envelope order spectrum of the residual signal, RMS of '
        f'{np.count_nonzero(known)} averages'), 'order (multiple of the shaft speed)')
    rms = np.sqrt(np.mean(spectrum[known] ** 2, axis=0))
    for axes, channel in zip(panels[:, 0], channels):
        for number, order in enumerate(found[known][0, channel, :, 0].tolist()):
            axes.axvspan((1.0 - SLIP) * order, (1.0 + SLIP) * order, color=MARK, alpha=0.3,
                         linewidth=0.0, label=None if number else 'bearing orders, ± 2 %')
            name = signals.machine.name_of(series.shaft, order, bearing=True)
            axes.annotate(name.removeprefix('bearing '), (order, 1.0), rotation=90,
                          xycoords=('data', 'axes fraction'), textcoords='offset points',
                          xytext=(2, -3), va='top', fontsize='x-small')
        axes.plot(orders[0, channel], rms[channel], color=MEASURED, linewidth=0.7,
                  label='squared envelope')
        lines = found[known][:, channel]
        axes.plot(lines[..., 1].mean(axis=0), np.sqrt(np.mean(lines[..., 2] ** 2, axis=0)), 'v',
                  color='tab:blue', markersize=4.0, label='largest line, RMS')
        unit = squared(signals.units[channel])
        axes.set_ylabel(f'{signals.channel_names[channel]}\nsquared envelope [{unit}]')
        axes.set_ylim(bottom=0.0)
        axes.margins(x=0.0)
    legend_under(panels[-1, 0])
    return figure
