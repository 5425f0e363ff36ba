# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Figures of all orders: spectrum, map over time and speed, envelope; all figures as files."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.averaging.envelope import SLIP
from sa_jitter_ros.averaging.indicators import gear_lines, GearSettings
from sa_jitter_ros.offline.average_figures import (
    gear_figure, orders_figure, tracked_orders_figure, waveform_figure)
from sa_jitter_ros.offline.files import Signals
from sa_jitter_ros.offline.plotting import (
    CORRECTED, legend_under, MARK, MEASURED, rows_of_channels, speed_varies, squared,
    strongest_channels)
from sa_jitter_ros.offline.series import ShaftSeries

_DPI = 110
_MOST_COLUMNS = 500  # of a map; more averages share one
_SPEEDS = 40  # bins of a map over speed
_APART = 4.0  # distances between the speeds of averages, above which a map over speed has a gap
_FEWEST = 3  # averages of a map
_DECIBELS = 60.0
_HARMONICS = 4  # mesh harmonics with a label
_ROOM = 1.15  # orders above the highest one of interest, in a map
_CLEAR = 4.0  # amplitude over noise of an order that a map has to show


@dataclass(frozen=True)
class Spectra:
    """
    Amplitudes of all whole orders: (group, channel, order), RMS of the averages of a group.

    `begin` and `end` (group,) are the times (s) of its averages, `speed` (group,) their mean speed
    (Hz, tach shaft). `channels` are the places of the channels. `noise` (channel,) is the RMS
    amplitude of an order that is only noise.
    """

    channels: list[int]
    amplitude: Array
    noise: Array
    begin: Array
    end: Array
    speed: Array

    @property
    def rms(self) -> Array:
        """Return the RMS of all groups, (channel, order)."""
        return np.asarray(np.sqrt(np.mean(self.amplitude**2, axis=0)))


def spectra(series: ShaftSeries) -> Spectra:
    """Return the amplitudes of all orders on the strongest channels, of the best waveforms."""
    channels, points = strongest_channels(series), series['angle'].size
    groups = np.array_split(np.arange(len(series)), min(len(series), _MOST_COLUMNS))
    weight = np.full(points // 2 + 1, 2.0 / points)
    weight[0] = 1.0 / points
    found = np.empty((len(groups), len(channels), points // 2 + 1))
    variance = np.zeros(len(channels))
    for place, group in enumerate(groups):
        waveform = series.best_waveform[group][:, channels]
        raw = series['waveform'][group][:, channels]
        waveform = np.where(np.isfinite(waveform), waveform, raw)
        power = (weight * np.abs(np.fft.rfft(waveform, axis=-1))) ** 2
        found[place] = np.sqrt(power.mean(axis=0))
        error = series['standard_error'][group][:, channels]
        variance += np.nan_to_num(np.square(error)).mean(axis=(0, 2)) / len(groups)
    return Spectra(
        channels, found, 2.0 * np.sqrt(variance / points),
        np.array([series['start_time'][group[0]] for group in groups]),
        np.array([series['end_time'][group[-1]] for group in groups]),
        np.array([series['trigger_speed'][group].mean() for group in groups]))


def spectrum_figure(signals: Signals, series: ShaftSeries, found: Spectra, gear: GearSettings
                    ) -> Figure:
    """Draw the full order spectrum, with mesh harmonics, sidebands and tracked orders."""
    figure, panels = rows_of_channels(
        signals, series, found.channels, f'full order spectrum, RMS of {len(series)} averages',
        'order (multiple of the shaft speed)', height=2.7)
    corrected = 'corrected' if 'corrected_average' in series else 'raw'
    for axes, amplitude, noise in zip(panels[:, 0], found.rms, found.noise):
        _draw_spectrum(axes, signals, series, amplitude, noise, gear, corrected)
    legend_under(panels[-1, 0], columns=5)
    return figure


def _draw_spectrum(axes: Axes, signals: Signals, series: ShaftSeries, amplitude: Array,
                   noise: float, gear: GearSettings, corrected: str) -> None:
    orders = np.arange(amplitude.size)
    floor = max(0.3 * noise, 1e-6 * float(amplitude[1:].max(initial=0.0)), 1e-300)
    axes.vlines(orders[1:], floor, np.maximum(amplitude[1:], floor), color='0.55', linewidth=0.7)
    if noise > 0.0:
        axes.axhline(noise, color='0.2', linewidth=0.8, linestyle=':',
                     label='noise, by the standard error')
    if gear.mesh_orders:
        lines = gear_lines(gear, series['angle'].size)
        for mask, colour, label in ((lines.sidebands, MARK, 'sidebands'),
                                    (lines.mesh, CORRECTED, 'mesh harmonics')):
            axes.vlines(orders[mask], floor, np.maximum(amplitude[mask], floor), color=colour,
                        linewidth=1.2, label=label)
        mesh = orders[lines.mesh][:_HARMONICS]
        for order in mesh.tolist():
            name = signals.order(series.shaft, order)
            axes.annotate(name, (order, amplitude[order]), textcoords='offset points',
                          xytext=(0, 3), ha='left' if len(name) > 8 else 'center',
                          rotation=20 if len(name) > 8 else 0, fontsize='x-small')
    tracked = series.orders
    whole = tracked[(tracked == np.round(tracked)) & (tracked < amplitude.size)].astype(int)
    axes.plot(whole, np.maximum(amplitude[whole], floor), 'v', color='tab:green', markersize=4.0,
              label=f'tracked orders, {corrected}', linestyle='none')
    axes.set_yscale('log')
    axes.margins(x=0.01, y=0.45)  # room for the names above the lines
    axes.set_ylim(bottom=floor)


def order_map_figure(signals: Signals, series: ShaftSeries, found: Spectra, gear: GearSettings
                     ) -> Figure | None:
    """Draw amplitude over order and time, and speed if it varies; None for few averages."""
    if len(found.begin) < _FEWEST:
        return None
    highest = _highest(series, found, gear)
    varies = speed_varies(series)
    figure, panels = rows_of_channels(
        signals, series, found.channels, 'order map', 'time [s]',
        *['speed of the tach shaft [Hz]'] * varies, height=2.9)
    for row, place in zip(panels, range(len(found.channels))):
        decibels = 20.0 * np.log10(np.maximum(found.amplitude[:, place, 1:highest + 1], 1e-300))
        top = float(decibels.max())
        image = _over_time(row[0], found, decibels, top)
        if varies:
            _over_speed(row[1], found, decibels, top)
        unit = signals.units[found.channels[place]] or 'unit'
        figure.colorbar(image, ax=row[-1], label=f'dB re 1 {unit}')
        row[0].set_ylabel(f'{signals.channel_names[found.channels[place]]}\norder')
    return figure


def _highest(series: ShaftSeries, found: Spectra, gear: GearSettings) -> int:
    """Return the highest order that a map shows."""
    clear = np.flatnonzero((found.rms > _CLEAR * found.noise[:, None]).any(axis=0))
    interesting = max([float(series.orders.max()), 3.0 * max(gear.mesh_orders, default=0), 10.0,
                       float(np.quantile(clear, 0.95)) if clear.size else 0.0])
    return int(min(_ROOM * interesting, found.amplitude.shape[2] - 1))


def _over_time(axes: Axes, found: Spectra, decibels: Array, top: float) -> Any:
    """Draw the groups at their times, with white gaps between those that do not touch."""
    edges, rows = [found.begin[0]], []
    for begin, end, row in zip(found.begin, found.end, decibels):
        if begin > edges[-1] + 0.02 * (end - begin):
            edges.append(begin)
            rows.append(np.full(row.shape, np.nan))
        edges.append(max(end, edges[-1]))
        rows.append(row)
    return _mesh(axes, np.array(edges), np.array(rows), top)


def _over_speed(axes: Axes, found: Spectra, decibels: Array, top: float) -> Any:
    edges = np.linspace(found.speed.min(), found.speed.max(), min(_SPEEDS, found.speed.size) + 1)
    place = np.clip(np.searchsorted(edges, found.speed, 'right') - 1, 0, edges.size - 2)
    rows = np.full((edges.size - 1, decibels.shape[1]), np.nan)
    for number in np.unique(place):
        rows[number] = 10.0 * np.log10(np.mean(10.0 ** (0.1 * decibels[place == number]), axis=0))
    # A bin between the speeds of two averages of a run-up shows the nearest.
    middle, speeds = 0.5 * (edges[1:] + edges[:-1]), np.sort(found.speed)
    reach = 0.5 * _APART * float(np.median(np.diff(speeds)))
    filled = np.unique(place)
    nearest = filled[np.argmin(np.abs(middle[:, None] - middle[filled]), axis=1)]
    distance = np.abs(middle[:, None] - speeds).min(axis=1)
    rows = np.where((distance <= reach)[:, None], rows[nearest], rows)
    return _mesh(axes, edges, rows, top)


def _mesh(axes: Axes, edges: Array, rows: Array, top: float) -> Any:
    return axes.pcolormesh(edges, np.arange(rows.shape[1] + 1) + 0.5, rows.T, vmax=top,
                           vmin=top - _DECIBELS, cmap='viridis', rasterized=True)


def envelope_figure(signals: Signals, series: ShaftSeries) -> Figure | None:
    """Draw the spectrum of the strongest channels, RMS of the averages; None without one."""
    if 'envelope_spectrum' not in series:
        return None
    orders, spectrum = np.moveaxis(series['envelope_spectrum'], -1, 0)
    found = series['envelope_amplitude']
    known = np.isfinite(spectrum).any(axis=(1, 2))
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


def write_figures(folder: Path, signals: Signals, series: Sequence[ShaftSeries],
                  gears: Mapping[str, GearSettings],
                  predictions: Mapping[str, Array] | None = None) -> None:
    """
    Write the figures of all shafts; raises OSError.

    `gears` and `predictions` are by shaft, as `gear_figure` and `orders_figure` take them. With
    several shafts the name of each file begins with that of the shaft.
    """
    for item in series:
        gear = gears[item.shaft]
        found = spectra(item)
        drawn: dict[str, Figure | None] = {
            'waveform': waveform_figure(signals, item),
            'orders': orders_figure(signals, item, (predictions or {}).get(item.shaft)),
            'spectrum': spectrum_figure(signals, item, found, gear),
            'order_map': order_map_figure(signals, item, found, gear),
            'tracked_orders': tracked_orders_figure(signals, item),
            'gear_signals': gear_figure(signals, item, gear),
            'envelope': envelope_figure(signals, item)}
        prefix = f'{item.shaft}_' if len(series) > 1 else ''
        for name, figure in drawn.items():
            if figure is not None:
                figure.savefig(folder / f'{prefix}{name}.png', dpi=_DPI)
