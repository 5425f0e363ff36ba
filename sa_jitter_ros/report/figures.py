# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The figures of a report: residual over orders, distributions, and the evidence of effects."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
import io
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.effects.effect import effects_of
from sa_jitter_ros.inference.expectation import Expectation
from sa_jitter_ros.inference.residual import Residual
from sa_jitter_ros.inference.trace_result import Trace
from sa_jitter_ros.number_text import HALF_95, order_text
from sa_jitter_ros.report import evidence_figures
from sa_jitter_ros.report.expected_errors import versions_of, with_explained_errors
from sa_jitter_ros.report.plotting import AFTER, arrange, BEFORE, MEASURED, panels, with_effects

_FEWEST_CYCLES = 3
_MOST_PANELS = 3
_POINTS = 200
_COMPRESSION = 1  # files are a tenth larger than by the default, 6, in half the time
_LONG = 8  # letters of an order that has a name
_SPREAD = 0.6  # share of the distance between orders over which the lines of one are spread


@dataclass(frozen=True)
class Illustration:
    """A figure with the stem of its file name, a title and what it shows."""

    name: str
    title: str
    caption: str
    figure: Figure

    def png(self) -> bytes:
        """Return the figure as PNG."""
        buffer = io.BytesIO()
        arrange(self.figure)
        # What `savefig` does, without drawing everything twice.
        self.figure.set_dpi(144)
        canvas: Any = FigureCanvasAgg(self.figure)
        canvas.print_png(buffer, pil_kwargs={'compress_level': _COMPRESSION})
        return buffer.getvalue()


def illustrate(trace: Trace) -> tuple[Illustration, ...]:
    """Draw the figures of a trace, none without lines; of the evidence where there is some."""
    if not trace.lines.count:
        return ()
    held_out = f'{len(trace.held_out)} held-out acquisitions'
    found = [
        Illustration(
            'residual', 'Residual over orders',
            f'Mean attenuation of the {held_out}, observed and predicted, and the difference of '
            'the two. Every mark is one line: an order on one channel. Bars are one standard '
            'error. If the prediction is right, 95 % of the lines are in the grey band.',
            _residual_figure(trace)),
        Illustration(
            'distribution', 'Distribution of the amplitudes',
            f'Distribution functions of the amplitudes of the {held_out}, relative to the mean '
            'level of their line, observed and predicted. Last panel: share of all amplitudes '
            'below each predicted probability; if the prediction is right, it is the diagonal.',
            _distribution_figure(trace))]
    if trace.evidence is None or trace.observation.model.trigger_cycles < _FEWEST_CYCLES:
        return tuple(found)
    words = trace.observation.words
    evidence = with_explained_errors(trace.evidence)
    versions = versions_of(trace.evidence, tuple(effects_of(trace.findings)))
    drawn: Sequence[tuple[str, str, str, Callable[..., Figure]]] = (
        ('pulse_errors', 'Pulse errors',
         'Recovered pulse errors (measured minus true time) of the fitted acquisitions, and those '
         'that the declared model expects, without and with the added effects.',
         evidence_figures.pulse_errors),
        ('trigger_cycle', 'Inside the trigger cycle, and over the number of cycles',
         'Angle error over the trigger cycle, attenuation over the number of averaged cycles, and '
         'mean pulse error over the pulse index.',
         partial(evidence_figures.trigger_cycle, words=words)),
        ('amplitudes', 'Amplitudes of the lines',
         'Amplitudes of the strongest lines from cycle to cycle, after correction of the pulse '
         'errors: these variations are not due to timing.',
         lambda evidence, _: evidence_figures.amplitudes(
             evidence, trace.observation.channel_names, words)))
    for name, title, caption, draw in drawn:
        found.append(Illustration(name, title, caption, draw(evidence, versions)))
    return tuple(found)


def _versions(trace: Trace) -> list[tuple[str, str, Expectation, Residual]]:
    """Return label, colour, prediction and residual, before and after effects were added."""
    before = ('declared model', BEFORE, trace.prediction_before, trace.before)
    if not trace.findings:
        return [before]
    label = with_effects([item.name for item in trace.findings])
    return [before, (label, AFTER, trace.prediction_after, trace.after)]


def _positions(trace: Trace) -> tuple[Array, Array]:
    """Return the position of each line, channels side by side at their order; and the orders."""
    orders, place = np.unique(trace.observation.orders[trace.lines.order], return_inverse=True)
    channels, shift = np.unique(trace.lines.channel, return_inverse=True)
    offset = _SPREAD * ((shift + 0.5) / channels.size - 0.5)
    return place + offset, orders


def _residual_figure(trace: Trace) -> Figure:
    position, orders = _positions(trace)
    versions = _versions(trace)
    held_out = list(trace.held_out)
    figure, axes = panels(1 + len(versions), one_axis=True)
    observed = trace.attenuation[held_out]
    axes[0].errorbar(position, observed.mean(axis=0), yerr=observed.std(axis=0), fmt='o',
                     color=MEASURED, markersize=4, capsize=2,
                     label='observed: mean, scatter of the acquisitions')
    for label, colour, expected, _ in versions:
        axes[0].plot(position, expected.attenuation[held_out].mean(axis=0), '_', color=colour,
                     markersize=12, markeredgewidth=2, label=f'predicted, {label}')
    axes[0].set_ylabel('attenuation\n(1: no loss)')
    for row, (label, colour, _, residual) in zip(axes[1:], versions):
        half = HALF_95 * residual.standard_error
        row.bar(position, 2.0 * half, bottom=-half, color='0.85', label='95 % band',
                width=_SPREAD / np.unique(trace.lines.channel).size)
        row.errorbar(position, residual.mean, yerr=residual.standard_error, fmt='o', color=colour,
                     markersize=4, capsize=2, label=f'{label}: RMS {residual.rms:.4f}')
        row.axhline(0.0, color='0.4', linewidth=0.8)
        row.use_sticky_edges = False
        row.margins(y=0.08)
        row.set_ylabel('observed minus predicted')
    step = max(1, orders.size // 30)
    names = [order_text(g, trace.observation.name_of(g)) for g in orders[::step]]
    axes[-1].set_xticks(np.arange(orders.size)[::step], names,
                        rotation=90 if orders.size > 20 or max(map(len, names)) > _LONG else 0)
    axes[-1].set_xlabel('order (channels side by side)')
    axes[-1].set_xlim(-0.6, orders.size - 0.4)
    return figure


def _distribution_figure(trace: Trace) -> Figure:
    chosen = _most_telling(trace)
    held_out = np.array(trace.held_out)
    figure, axes = panels(len(chosen) + 1)
    amplitude = trace.amplitude[held_out]
    for one, line in zip(axes, chosen):
        order = trace.observation.orders[trace.lines.order[line]]
        channel = trace.observation.channel_names[trace.lines.channel[line]]
        _observed_share(one, amplitude[:, line])
        low, high = amplitude[:, line].min(), amplitude[:, line].max()
        for label, colour, expected, _ in _versions(trace):
            mean = expected.amplitude[held_out, line]
            reach = 3.0 * np.sqrt(expected.amplitude_variance[held_out, line].mean())
            x = np.linspace(max(0.0, min(low, mean.min() - reach)), max(high, mean.max() + reach),
                            _POINTS)
            one.plot(x, expected.mean_cdf(trace.held_out, line, x), color=colour, label=label)
        one.set(title=f'{trace.observation.words(order)}, {channel}',
                xlabel='amplitude / mean level', ylabel='cumulative share')
    _probability_panel(trace, axes[-1])
    return figure


def _probability_panel(trace: Trace, axes: Axes) -> None:
    """Draw the share of all amplitudes below each predicted probability."""
    for label, colour, expected, residual in _versions(trace):
        probability = expected.cdf(trace.amplitude)[list(trace.held_out)].ravel()
        _observed_share(axes, probability, color=colour, label=f'{label}: KS {residual.ks:.3f}')
    axes.plot((0.0, 1.0), (0.0, 1.0), color='0.4', linewidth=0.8, linestyle='--', label='ideal')
    axes.set(title='all lines', xlabel='predicted probability',
             ylabel='cumulative share')


def _most_telling(trace: Trace) -> list[int]:
    """Return the line of the largest standardised residual of each of a few orders."""
    size = np.abs(trace.before.mean) / trace.before.standard_error
    best = [int(rows[np.argmax(size[rows])]) for order in np.unique(trace.lines.order)
            for rows in [np.flatnonzero(trace.lines.order == order)]]
    best = sorted(best, key=lambda line: -size[line])[:_MOST_PANELS]
    return sorted(best, key=lambda line: int(trace.lines.order[line]))


def _observed_share(axes: Axes, sample: Array, *, color: str = MEASURED,
                    label: str = 'observed') -> None:
    ordered = np.sort(sample)
    axes.step(ordered, (np.arange(ordered.size) + 0.5) / ordered.size, where='mid', color=color,
              label=label)
