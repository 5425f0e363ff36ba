# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Figures of averages: waveform and gear signals of the latest one, orders, tracked orders."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.averaging.indicators import gear_lines, GearSettings, separate
from sa_jitter_ros.errors import SaJitterError
from sa_jitter_ros.monitoring.quantities import Layout
from sa_jitter_ros.number_text import order_words
from sa_jitter_ros.offline.files import Signals
from sa_jitter_ros.offline.plotting import (
    CORRECTED, draw_limits, heading, legend_under, MARK, MEASURED, RAW, rows_of_channels,
    speed_varies, strongest_channels)
from sa_jitter_ros.offline.series import ShaftSeries

_UNKNOWN = 0.3  # standard error of an attenuation that says nothing
_FEWEST_TRACKED = 2  # averages
_MOST_TRACKED = 6
_CLEAR = 3.0  # amplitude over its noise, from which on an order has a phase


def waveform_figure(signals: Signals, series: ShaftSeries) -> Figure:
    """Draw the latest synchronous average of the strongest channels over the angle."""
    channels = strongest_channels(series)
    angle, raw = 360.0 * series['angle'], series['waveform'][-1]
    shown = f'{len(channels)} strongest of {raw.shape[0]} channels, ' if (
        raw.shape[0] > len(channels)) else ''
    figure, panels = rows_of_channels(signals, series, channels, (
        f'{shown}last average, {series["fundamental_cycles"][-1]:.0f} revolutions, tach shaft at '
        f'{series["trigger_speed"][-1]:.4g} Hz'), 'angle of the shaft [degrees]')
    error = 2.0 * series['standard_error'][-1]
    for axes, channel in zip(panels[:, 0], channels):
        axes.fill_between(angle, raw[channel] - error[channel], raw[channel] + error[channel],
                          color=RAW, alpha=0.25, linewidth=0.0, label='raw, ± 2 standard errors')
        axes.plot(angle, raw[channel], color=RAW, linewidth=0.8, label='raw')
        if 'corrected_average' in series:
            axes.plot(angle, series['corrected_average'][-1, channel], color=CORRECTED,
                      linewidth=0.8, label='corrected')
        axes.margins(x=0.0)
    legend_under(panels[-1, 0])
    return figure


def strongest_lines(series: ShaftSeries) -> Array:
    """Return the channel (order,) on which each order is strongest."""
    amplitude = np.nan_to_num(series.field('raw_amplitude'))
    return np.asarray(np.argmax(amplitude.mean(axis=0), axis=0))


def on_strongest(series: ShaftSeries, name: str) -> Array:
    """Return a field (average, order), of each order on its strongest channel."""
    values = series.field(name)
    return np.asarray(values[:, strongest_lines(series), np.arange(values.shape[2])])


def orders_figure(signals: Signals, series: ShaftSeries, prediction: Array | None = None
                  ) -> Figure:
    """
    Draw the amplitudes of the orders and their attenuation, each on its strongest channel.

    `prediction` (order, 3) is mean attenuation and its 5 % and 95 % quantile, if it is known.
    """
    position = np.arange(series.orders.size)
    names = [signals.order(series.shaft, order) for order in series.orders.tolist()]
    upright = position.size > 20 or max(map(len, names)) > 8
    figure = Figure(figsize=(9.0, 6.2 + 0.05 * upright * max(map(len, names))),
                    layout='constrained')
    top, bottom = figure.subplots(2, 1, sharex=True)
    for shift, name, colour, label in ((-0.08, 'raw_amplitude', RAW, 'raw'),
                                       (0.08, 'corrected_amplitude', CORRECTED, 'corrected')):
        values = on_strongest(series, name)
        if np.isfinite(values).any():
            _stems(top, position + shift, values, colour, label)
    top.set_yscale('log')
    top.set_ylabel(f'amplitude [{signals.unit_of(strongest_lines(series))}]')
    top.legend(fontsize='small')
    figure.suptitle(heading(signals, series, (
        f'{len(series)} averages of {np.median(series["trigger_cycles"]):.0f} trigger cycles, '
        'each order on its strongest channel')), fontsize='medium')
    if prediction is not None:
        mean, low, high = prediction.T
        bottom.bar(position, high - low, bottom=low, width=0.6, color='tab:gray', alpha=0.35,
                   label='predicted, 5 % to 95 %')
        bottom.hlines(mean, position - 0.3, position + 0.3, color='tab:gray',
                      label='predicted mean')
    measured = np.where(on_strongest(series, 'attenuation_standard_error') < _UNKNOWN,
                        on_strongest(series, 'attenuation'), np.nan)
    if np.isfinite(measured).any():
        bottom.plot(np.broadcast_to(position, measured.shape).ravel(), measured.ravel(), 'o',
                    color=MEASURED, markersize=3.0, alpha=0.6,
                    label='measured, single averages')
    else:
        bottom.text(0.5, 0.5, 'no average was corrected, or no order is clear', ha='center',
                    va='center', transform=bottom.transAxes)
    bottom.use_sticky_edges = False
    bottom.margins(y=0.08)
    bottom.set_ylabel('attenuation\n(1: no loss)')
    bottom.set_xticks(position, names, rotation=90 if upright else 0)
    bottom.set_xlabel('order (multiple of the shaft speed)')
    if bottom.get_legend_handles_labels()[0]:
        bottom.legend(fontsize='small', loc='lower left')
    return figure


def _stems(axes: Axes, position: Array, values: Array, color: str, label: str) -> None:
    """Draw the mean of each order, and the scatter of the averages as its bar."""
    known = np.ma.masked_invalid(values)
    mean, spread = (np.ma.filled(item, np.nan) for item in (known.mean(axis=0), known.std(axis=0)))
    axes.errorbar(position, mean, yerr=np.minimum(spread, 0.9 * mean), fmt='o', color=color,
                  markersize=4.0, capsize=3.0, label=f'{label}: mean, scatter of the averages')


def tracked_orders_figure(signals: Signals, series: ShaftSeries) -> Figure | None:
    """Draw the strongest of the tracked orders, each on its strongest channel."""
    if len(series) < _FEWEST_TRACKED:
        return None
    kind = 'corrected' if np.isfinite(series.field('corrected_amplitude')).any() else 'raw'
    amplitude, phase = (on_strongest(series, f'{kind}_{name}') for name in ('amplitude', 'phase'))
    error = on_strongest(series, f'{kind}_standard_error')
    noise = on_strongest(series, 'noise_standard_deviation')
    error = np.where(np.isfinite(error), error, noise)
    size = np.sqrt(np.nan_to_num(np.square(amplitude)).mean(axis=0))
    chosen = np.sort(np.argsort(-size)[:_MOST_TRACKED])
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
    for (top, bottom), (label, place) in zip(panels.T, columns):
        for colour, order in enumerate(chosen.tolist()):
            style = {'color': f'C{colour}', 'marker': '.', 'markersize': 4.0, 'linewidth': 0.8,
                     'label': f'{names[order]}, {signals.channel_names[channels[order]]}'}
            top.errorbar(place, amplitude[:, order], yerr=error[:, order], elinewidth=0.8, **style)
            bottom.plot(place, _phase(
                phase[:, order], amplitude[:, order], noise[:, order]), **style)
            draw_limits(top, [
                (level, bound) for level, bound, relative in signals.limits.bounds(
                    series.shaft, layout, int(channels[order]), order) if not relative],
                names[order])
        bottom.set_xlabel(label)
    panels[0, 0].set_ylabel(f'{kind} amplitude [{signals.unit_of(channels[chosen])}]')
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


def demodulate(waveform: Array, order: int, *, reach: int) -> tuple[Array, Array]:
    """
    Return the modulation of an order of an average (angle,) by the orders up to `reach` beside it.

    It is amplitude over its mean, and phase (rad) about its mean, (angle,) each.
    McFadden, "Detecting fatigue cracks in gears by amplitude and phase demodulation of the meshing
    vibration", Journal of Vibration and Acoustics 108 (1986).

    >>> angle = 2.0 * np.pi * np.arange(512) / 512
    >>> mesh = np.cos(19.0 * angle + 0.1 * np.sin(angle))
    >>> amplitude, phase = demodulate((1.0 + 0.2 * np.cos(angle)) * mesh, 19, reach=9)
    >>> float(np.abs(amplitude - 1.0 - 0.2 * np.cos(angle)).max().round(3))
    0.0
    >>> float(np.abs(phase - 0.1 * np.sin(angle)).max().round(3))
    0.0
    """
    points = waveform.size
    spectrum = np.fft.rfft(waveform)
    envelope = np.zeros(points, complex)
    low, high = max(order - reach, 1), min(order + reach, (points - 1) // 2)
    envelope[np.arange(low, high + 1) - order] = 2.0 * spectrum[low:high + 1]
    signal = np.fft.ifft(envelope)
    mean = np.mean(signal)
    turned = signal * np.exp(-1j * np.angle(mean))
    size = np.abs(signal)
    return size / max(float(size.mean()), 1e-300), np.unwrap(np.angle(turned))


def strongest_mesh(amplitudes: Array, gear: GearSettings) -> tuple[int, int]:
    """Return the strongest harmonic of a mesh order, and how far its own sidebands reach."""
    best, reach = 0, 0
    for mesh in gear.mesh_orders:
        harmonics = np.arange(int(mesh), amplitudes.size - int(mesh) // 2, int(mesh))
        if harmonics.size:
            order = int(harmonics[np.argmax(amplitudes[harmonics])])
            if not best or amplitudes[order] > amplitudes[best]:
                best, reach = order, max((int(mesh) - 1) // 2, 1)
    return best, reach


def gear_figure(signals: Signals, series: ShaftSeries, gear: GearSettings) -> Figure | None:
    """Draw the gear signals of the latest average; None without mesh orders or a waveform."""
    channels = strongest_channels(series)
    waveform = series.best_waveform[-1]
    if not np.isfinite(waveform).all():
        waveform = series['waveform'][-1]
    if not gear.mesh_orders or not np.isfinite(waveform).all():
        return None
    try:
        gear_lines(gear, waveform.shape[1])
    except SaJitterError:  # no waveform of so few points has the mesh orders
        return None
    figure, panels = rows_of_channels(signals, series, channels, 'last average',
                                      *['angle of the shaft [degrees]'] * 2, height=2.8)
    figure.set_figwidth(11.0)
    angle = 360.0 * series['angle']
    for row, channel in zip(panels, channels):
        found = separate(waveform[channel], gear)
        row[0].plot(angle, found.residual, color=MARK, linewidth=0.8,
                    label='residual: without mesh harmonics')
        row[0].plot(angle, found.difference, color=MEASURED, linewidth=0.8,
                    label='difference: without their sidebands, too')
        order, reach = strongest_mesh(found.amplitudes, gear)
        if order:
            amplitude, phase = demodulate(waveform[channel], order, reach=reach)
            row[1].plot(angle, 100.0 * (amplitude - 1.0), color=CORRECTED,
                        linewidth=0.9, label='amplitude')
            beside = row[1].twinx()
            beside.plot(angle, np.degrees(phase), color='tab:purple', linewidth=0.9)
            row[1].plot([], [], color='tab:purple', linewidth=0.9, label='phase')
            name = signals.order(series.shaft, order)
            row[1].set_title(f'modulation of {name}, ± {reach} orders', fontsize='medium')
            row[1].set_ylabel('amplitude [%]', color=CORRECTED)
            beside.set_ylabel('phase [degrees]', color='tab:purple')
        for axes in row:
            axes.margins(x=0.0)
    for axes in panels[-1]:
        axes.legend(loc='upper center', bbox_to_anchor=(0.5, -0.18), fontsize='small',
                    frameon=False, ncols=2 if axes is panels[-1, 1] else 1)
    return figure
