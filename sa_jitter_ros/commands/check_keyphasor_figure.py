# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The figure of a check: speed, place of every mark, lines of the vibration."""

import math

from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np
from sa_jitter_ros.keyphasor_check.result import KeyphasorCheck

_MARK, _STRAY, _LOST, _LINE = 'tab:blue', 'tab:red', 'tab:orange', 'tab:gray'
_MOST_POINTS = 20_000
_NAMED = 12


def check_figure(check: KeyphasorCheck, title: str) -> Figure:
    """Return the figure of a check."""
    drawn = [_draw_speed]
    drawn += [_draw_marks] * (check.fitted.pattern.teeth > 1)  # one mark has no pattern
    drawn += [_draw_lines] * (check.lines is not None)
    figure = Figure(figsize=(9.0, 2.7 * len(drawn) + 0.4), layout='constrained')
    panels = figure.subplots(len(drawn), 1, squeeze=False)[:, 0]
    for axes, draw in zip(panels, drawn):
        draw(axes, check)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(fontsize='small', loc='best')
    panels[0].set_title(title, fontsize='medium')
    return figure


def _draw_speed(axes: Axes, check: KeyphasorCheck) -> None:
    fitted = check.fitted
    step = max(1, min(fitted.pattern.present, fitted.true.size // 2))
    time = 0.5 * (fitted.true[step:] + fitted.true[:-step])
    speed = (fitted.revolutions[step:] - fitted.revolutions[:-step]) / (
        fitted.true[step:] - fitted.true[:-step])
    thin = max(1, time.size // _MOST_POINTS)
    axes.plot(time[::thin], speed[::thin], color=_MARK, linewidth=0.8, label='speed')
    low, high = np.quantile(speed, [0.0, 1.0])
    room = max(0.1 * (high - low), 1e-4 * abs(high))
    axes.set_ylim(low - 3.0 * room, high + room)
    for times, color, label, place in ((fitted.strays, _STRAY, 'stray pulses', 1.0),
                                       (fitted.lost, _LOST, 'lost pulses', 2.0)):
        if times.size:
            axes.plot(times, np.full(times.size, low - place * room), '|', color=color,
                      markersize=9.0, label=f'{times.size} {label}')
    axes.set(xlabel='time [s]', ylabel='tach shaft [Hz]')
    axes.margins(x=0.01)


def _draw_marks(axes: Axes, check: KeyphasorCheck) -> None:
    pattern = check.fitted.pattern
    degrees = 360.0 / pattern.teeth
    tooth = np.flatnonzero(~pattern.missing)
    axes.errorbar(tooth, pattern.marks * degrees, yerr=2.0 * np.nan_to_num(
        pattern.errors) * degrees, fmt='o', color=_MARK, markersize=4.0, capsize=3.0,
        label='late by, ± 2 standard errors')
    for number, gap in enumerate(np.flatnonzero(pattern.missing)):
        axes.axvspan(gap - 0.5, gap + 0.5, color=_LINE, alpha=0.3, linewidth=0.0,
                     label='missing tooth' if number == 0 else None)
    count = check.findings['pulses_per_revolution']
    others = ', '.join(f'{value} ({probability:.0%})' for value, probability
                       in count.alternatives[:3])
    axes.set_title(f'{pattern.teeth} marks a revolution, {pattern.teeth - pattern.present} missing'
                   + (f'; or {others}' if others else ''), fontsize='medium')
    axes.set(xlim=(-0.7, pattern.teeth - 0.3), xlabel='mark', ylabel='late [degrees]')
    if pattern.teeth <= _NAMED:
        axes.set_xticks(range(pattern.teeth))


def _draw_lines(axes: Axes, check: KeyphasorCheck) -> None:
    lines = check.lines
    assert lines is not None
    ratio = float(check.findings['ratio'].value or 1.0)
    orders = check.findings['orders'].value or []
    if not lines.places.size:
        axes.text(0.5, 0.5, 'no line stands above the noise', ha='center', va='center',
                  transform=axes.transAxes)
        axes.set_axis_off()
        return
    place = lines.places / ratio
    axes.vlines(place, 0.0, 20.0 * np.log10(lines.sizes), color=_LINE, linewidth=1.0,
                label='lines of the vibration')
    for number, order in enumerate(orders):
        nearest = int(np.argmin(np.abs(place - order)))
        height = 20.0 * math.log10(lines.sizes[nearest])
        axes.plot(order, height, 'o', color=_MARK, markersize=4.0,
                  label='orders of the shaft' if number == 0 else None)
        axes.annotate(f'{order:g}', (order, height), textcoords='offset points', xytext=(0, 4),
                      ha='center', fontsize='x-small')
    axes.margins(y=0.15)
    axes.set_ylim(bottom=0.0)
    shaft = '' if ratio == 1.0 else f' at ratio {ratio:.6g}'
    axes.set(xlim=(0.0, 1.05 * float(place.max())), xlabel=f'order of the shaft{shaft}',
             ylabel='above the noise [dB]')
