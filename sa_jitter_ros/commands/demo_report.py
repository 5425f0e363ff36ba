# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The result of the demo: a table of the orders and two figures."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.commands.demo_plan import Plan
from sa_jitter_ros.nodes.messages import AverageMessage, PredictionMessage

FloatArray = NDArray[np.float64]

RAW, CORRECTED, MEASURED = 'tab:red', 'tab:blue', 'black'


def amplitude_rows(amplitudes: Sequence[AverageMessage]) -> tuple[FloatArray, NDArray[Any]]:
    """Return (average, order, field) of each order on its strongest channel; the channels."""
    table = np.stack([item.values for item in amplitudes])  # average, channel, order, field
    channels = np.argmax(np.nanmean(table[..., 1], axis=0), axis=0)
    return table[:, channels, np.arange(table.shape[2])], channels


def text_table(plan: Plan, amplitudes: Sequence[AverageMessage],
               prediction: PredictionMessage | None) -> str:
    """Return a table of the orders: amplitude, attenuation, predicted attenuation."""
    rows, channels = amplitude_rows(amplitudes)
    unit = f' {plan.unit_label}' if plan.unit_label else ''
    names = [plan.channels[int(channel)] for channel in channels]
    width = max(12, *map(len, names))
    lines = [f'{"order":>8} {"channel":>{width}} {"amplitude" + unit:>16} {"corrected":>10} '
             f'{"noise":>9} {"attenuation":>12} {"predicted mean [5 % .. 95 %]":>30}']
    for i in range(rows.shape[1]):
        order, raw, _, corrected, _, attenuation, _, noise = (
            _mean(rows[:, i, field]) for field in range(rows.shape[2]))
        row = prediction.values[i] if prediction is not None else np.full(7, np.nan)
        lines.append(
            f'{order:8g} {names[i]:>{width}} {raw:16.5g} {corrected:10.5g} {noise:9.2g} '
            f'{attenuation:12.4f} {row[1]:14.4f} [{row[4]:.4f} .. {row[6]:.4f}]')
    return '\n'.join(lines)


def _mean(values: FloatArray) -> float:
    """Return the mean of all values except NaN, NaN if there is none."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else float('nan')


def draw_waveform(plan: Plan, raw: AverageMessage, error: AverageMessage | None,
                  corrected: AverageMessage | None, path: Path) -> None:
    """Draw the last synchronous average of up to three channels over the angle."""
    strongest = np.argsort(-np.nanstd(raw.values, axis=1))[:3]
    figure = Figure(figsize=(9.0, 2.4 * len(strongest) + 0.8), layout='constrained')
    panels = figure.subplots(len(strongest), 1, sharex=True, squeeze=False)[:, 0]
    angle = np.arange(raw.values.shape[1]) / raw.values.shape[1] * 360.0
    for axes, channel in zip(panels, strongest):
        if error is not None:
            axes.fill_between(angle, raw.values[channel] - 2.0 * error.values[channel],
                              raw.values[channel] + 2.0 * error.values[channel], color=RAW,
                              alpha=0.25, linewidth=0.0, label='raw, ± 2 standard errors')
        axes.plot(angle, raw.values[channel], color=RAW, linewidth=0.8, label='raw')
        if corrected is not None:
            axes.plot(angle, corrected.values[channel], color=CORRECTED, linewidth=0.8,
                      label='corrected')
        axes.set_ylabel(f'{plan.channels[channel]}\n{plan.unit_label or "[unit unknown]"}')
        axes.margins(x=0.0)
    panels[0].set_title(f'{plan.title}: average of {raw.header.fundamental_cycles} revolutions, '
                        f'tach shaft at {raw.header.mean_trigger_speed:.4g} Hz', fontsize='medium')
    panels[-1].set_xlabel('angle of the shaft [degrees]')
    panels[-1].legend(loc='upper center', bbox_to_anchor=(0.5, -0.25), ncols=3, fontsize='small')
    _save(figure, path)


def draw_orders(plan: Plan, amplitudes: Sequence[AverageMessage],
                prediction: PredictionMessage | None, path: Path) -> None:
    """Draw the amplitudes of the orders, and their measured and predicted attenuation."""
    rows, _ = amplitude_rows(amplitudes)
    figure = Figure(figsize=(9.0, 6.2), layout='constrained')
    top, bottom = figure.subplots(2, 1, sharex=True)
    position = np.arange(rows.shape[1])
    _stems(top, position - 0.08, rows[..., 1], RAW, 'raw')
    if np.isfinite(rows[..., 3]).any():
        _stems(top, position + 0.08, rows[..., 3], CORRECTED, 'corrected')
    top.set_yscale('log')
    top.set_ylabel(f'amplitude {plan.unit_label or "[unit unknown]"}')
    top.legend(fontsize='small')
    top.set_title(f'{plan.title}: {len(amplitudes)} averages of {plan.trigger_cycles} trigger '
                  'cycles, each order on its strongest channel', fontsize='medium')
    if prediction is not None:
        low, high = prediction.values[:, 4], prediction.values[:, 6]
        bottom.bar(position, high - low, bottom=low, width=0.6, color='tab:gray', alpha=0.35,
                   label='predicted, 5 % to 95 %')
        bottom.hlines(prediction.values[:, 1], position - 0.3, position + 0.3, color='tab:gray',
                      label='predicted mean')
    measured = rows[..., 5]
    for i in position:
        bottom.plot(np.full(len(measured), i), measured[:, i], 'o', color=MEASURED,
                    markersize=3.0, alpha=0.6,
                    label='measured, single averages' if i == 0 else None)
    bottom.use_sticky_edges = False
    bottom.margins(y=0.08)
    bottom.set_ylabel('attenuation\n(1: no loss)')
    bottom.set_xticks(position, [f'{order:g}' for order in rows[0, :, 0]])
    bottom.set_xlabel('order (multiple of the shaft speed)')
    bottom.legend(fontsize='small', loc='lower left')
    _save(figure, path)


def _stems(axes: Axes, position: NDArray[Any], values: FloatArray, color: str, label: str) -> None:
    """Draw the mean of each order, and the scatter of the averages as its bar."""
    mean, spread = np.nanmean(values, axis=0), np.nanstd(values, axis=0)
    axes.errorbar(position, mean, yerr=np.minimum(spread, 0.9 * mean), fmt='o', color=color,
                  markersize=4.0, capsize=3.0, label=f'{label}: mean, scatter of the averages')


def _save(figure: Figure, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
