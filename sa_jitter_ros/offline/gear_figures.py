# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Figure of the gear signals: residual, difference, and the modulation of a mesh harmonic."""

from matplotlib.figure import Figure
import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.averaging.indicators import gear_lines, GearSettings, separate
from sa_jitter_ros.errors import SaJitterError
from sa_jitter_ros.offline.files import Signals
from sa_jitter_ros.offline.plotting import (
    CORRECTED, MARK, MEASURED, rows_of_channels, strongest_channels)
from sa_jitter_ros.offline.series import ShaftSeries


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
