# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
Command `design`: choose or assess the keyphasor rate and the number of trigger cycles.

Settings that are given are assessed. Settings that are not given are chosen so that loss and
variation keep their limits.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
import re
import sys
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter, LogLocator, MaxNLocator, NullFormatter
import numpy as np
from sa_jitter_ros.commands.command_line import add_parameters, option_of, Parser, show
from sa_jitter_ros.declaration import MODEL_PARAMETERS, read_declaration, SHAFT_PARAMETERS
from sa_jitter_ros.errors import ParameterError, SaJitterError
from sa_jitter_ros.parameters import Parameter
from sa_jitter_ros.prediction.comb import Leakage
from sa_jitter_ros.prediction.design import (
    Design, design, design_grid, detection_probability, RATE_DISTRIBUTIONS,
    required_keyphasor_rate)

EXAMPLES = """examples:
  choose for the first two mesh harmonics of a gear of 19 teeth, loss 3 % and variation 1 %:
    design --orders 19 38 --trigger-speed 41.5 --ratio 2.40789 --loss 0.03 --variation 0.01
  assess a keyphasor sampled at 23438 Hz and 41 trigger cycles:
    design --orders 19 38 --trigger-speed 41.5 --ratio 2.40789 --keyphasor-rate 23438
           --trigger-cycles 41
  choose trigger cycles that suppress a mesh order of the other shaft and mains hum at 50 Hz, and
  calculate whether a change of 5 % is detected with one false alarm in a hundred averages:
    design --orders 19 38 --trigger-speed 41.5 --ratio 2.40789 --others 18.6886 --tones 50
           --change 0.05 --false-alarm-rate 0.01
"""

_NEEDED = ('orders', 'trigger_speed')
_MACHINE = (*_NEEDED, 'ratio', 'pulses_per_revolution', 'pulses_per_trigger',
            'jitter_distribution', 'noise_std', 'sample_rate')
_KNOWN = {item.name: item for item in (*SHAFT_PARAMETERS, *MODEL_PARAMETERS)} | {
    'jitter_distribution': Parameter(
        'jitter_distribution', 'uniform', 'distribution of the pulse error, whose width follows '
        'from keyphasor_rate', choices=RATE_DISTRIBUTIONS)}
_STEPS = (1.0, 2.0, 5.0)
_KEPT = '#d9ead3'
_BEST = 5  # numbers of trigger cycles to recommend
_CHANGES = 81  # points of a curve
_LABEL_SPACE = 0.47  # farthest distance of a label from the middle, in heights and widths
_LEAST_SHARE = 1e-6  # drawn for an exact notch, whose share is 0


def make_parser() -> Parser:
    """Return the parser of the command line; its names are the keywords of `design`."""
    parser = Parser('design', __doc__, epilog=EXAMPLES)
    machine = parser.add_argument_group('machine and average')
    machine.add_argument('--params', type=Path, metavar='MACHINE.yaml',
                         help='ROS parameter file with a section of jitter_predictor: the '
                         'machine, where the options below do not say otherwise')
    machine.add_argument('--shaft', default='', metavar='NAME',
                         help='shaft of interest in that file (default: its first)')
    add_parameters(machine, [_KNOWN[name] for name in _MACHINE])
    settings = parser.add_argument_group(
        'settings (chosen if not given; those in MACHINE.yaml are not taken)')
    add_parameters(settings, [_KNOWN[name] for name in ('keyphasor_rate', 'trigger_cycles')])
    limits = parser.add_argument_group('limits')
    limits.add_argument('--loss', '--attenuation', dest='maximum_loss', type=float, default=0.05,
                        metavar='X', help='largest loss of the mean amplitude, a fraction (0.05)')
    limits.add_argument('--variation', dest='maximum_variation', type=float, default=0.05,
                        metavar='X', help='largest coefficient of variation of the amplitude, a '
                        'fraction (0.05)')
    interference = parser.add_argument_group('interfering components')
    interference.add_argument(
        '--others', type=float, nargs='+', default=(), metavar='ORDER',
        help='orders of other shafts, as multiples of the shaft of interest')
    interference.add_argument('--tones', type=float, nargs='+', default=(), metavar='HZ',
                              help='tones of fixed frequency, Hz')
    detection = parser.add_argument_group('detection of a change')
    detection.add_argument('--change', type=float, metavar='X',
                           help='relative change of an amplitude to be detected by one average: '
                           '0.05 for 5 %% more, -0.05 for 5 %% less')
    detection.add_argument('--false-alarm-rate', type=float, metavar='P',
                           help='share of averages without change that may raise an alarm')
    parser.add_argument('--output', type=Path, default=Path('design.png'), metavar='FILE',
                        help='file of the figure: png, pdf or svg (design.png)')
    return parser


def parse(args: Sequence[str] | None) -> argparse.Namespace:
    """Return the options, with the machine's from its file or their defaults; SaJitterError."""
    parser = make_parser()
    options = parser.parse_args(args)
    machine = {name: _KNOWN[name].default for name in _MACHINE if name not in _NEEDED}
    if options.params:
        declaration = read_declaration(options.params)
        shaft = options.shaft or next(iter(declaration.models))
        if shaft not in declaration.models:
            raise ParameterError(f'--shaft is {shaft!r}: {options.params} has '
                                 f'{", ".join(declaration.models)}')
        machine = {name: getattr(declaration.models[shaft], name)
                   for name in _MACHINE}
    for name, value in machine.items():
        if getattr(options, name) is None:
            setattr(options, name, value)
    missing = [option_of(name) for name in _NEEDED if getattr(options, name) is None]
    if missing:
        parser.error(f'the following arguments are required: {", ".join(missing)} (or --params)')
    del options.params, options.shaft
    return options


def table(found: Design, options: argparse.Namespace) -> str:
    """Return the settings, and loss and variation of each order, as lines."""
    model = found.model
    revolutions = model.trigger_cycles * model.revolutions_per_trigger
    rate = ('given' if options.keyphasor_rate is not None
            else f'chosen for a loss of at most {options.maximum_loss:g}')
    cycles = ('given' if options.trigger_cycles is not None
              else f'chosen for a variation of at most {options.maximum_variation:g}'
              + (' and for small interference' if found.leakage else ''))
    detection = '' if found.detection is None else f'  {_percent(options.change):>6} detected'
    lines = [
        f'keyphasor rate   {found.keyphasor_rate:g} Hz ({rate})',
        f'trigger cycles   {found.trigger_cycles} ({cycles})',
        f'an average takes {revolutions:g} revolutions of the tach shaft, {model.duration:.4g} s',
        '',
        f'   order  frequency Hz     loss  coefficient of variation{detection}  limits']
    for i, order in enumerate(found.orders):
        loss, variation = found.loss[i], found.variation[i]
        exceeded = [name for name, value, limit in (
            ('loss', loss, options.maximum_loss),
            ('variation', variation, options.maximum_variation)) if value > limit]
        detected = '' if found.detection is None else f'  {found.detection[i]:15.4f}'
        lines.append(f'{order:8g}  {order * model.fundamental_frequency:12.6g}  {loss:7.5f}  '
                     f'{variation:24.5f}{detected}  '
                     f'{"kept" if not exceeded else " and ".join(exceeded) + " exceeded"}')
    if found.leakage is not None:
        lines += ['', *leakage_table(found, found.leakage, options)]
    return '\n'.join(lines)


def leakage_table(found: Design, remaining: Leakage, options: argparse.Namespace) -> list[str]:
    """Return the shares of interfering components, and the best numbers of cycles, as lines."""
    names = [*(f'order {order:g}' for order in options.others),
             *(f'{tone:g} Hz (order {order:.4g})' for tone, order in zip(
                 options.tones, remaining.orders[len(options.others):]))]
    width = max(len(name) for name in ('interfering', *names))
    lines = ['largest share of each interfering component that remains',
             f'{"interfering":{width}}' + ''.join(
                 f'  {f"at order {order:g}":>14}' for order in found.orders)
             + '  in the waveform']
    for name, shares, waveform in zip(names, remaining.share, remaining.waveform_share):
        lines.append(f'{name:{width}}' + ''.join(f'  {share:14.5f}' for share in shares)
                     + f'  {waveform:15.5f}')
    best = remaining.best(_BEST)
    lines += ['', f'numbers of trigger cycles from {remaining.candidates[0]} to '
              f'{remaining.candidates[-1]} with the smallest shares at the orders:',
              'trigger cycles ' + ''.join(f'{count:10d}' for count in best),
              'largest share  ' + ''.join(
                  f'{remaining.largest_share[count - remaining.candidates[0]]:10.5f}'
                  for count in best)]
    return lines


def draw(found: Design, options: argparse.Namespace) -> Figure:
    """Return the figure: limits, and interfering components and detection if requested."""
    panels = 1 + (found.leakage is not None) + (found.detection is not None)
    figure = Figure(figsize=(8.0, 5.6 + 3.0 * (panels - 1)), dpi=120, layout='constrained')
    first, *rest = figure.subplots(panels, squeeze=False,
                                   height_ratios=(5.6, *[3.0] * (panels - 1)))[:, 0]
    draw_limits(first, found, options)
    if found.leakage is not None:
        draw_leakage(rest[0], found.leakage)
    if found.detection is not None:
        draw_detection(rest[-1], found, found.detection, options)
    return figure


def draw_limits(axes: Axes, found: Design, options: argparse.Namespace) -> None:
    """Draw loss and variation of the highest order over keyphasor rate and trigger cycles."""
    model = found.model
    needed = required_keyphasor_rate(model, options.maximum_loss)
    rates = np.geomspace(min(needed, model.keyphasor_rate) / 3.0,
                         max(needed, model.keyphasor_rate) * 4.0, 20)
    cycles = np.unique(np.geomspace(max(model.trigger_cycles / 4.0, 1.0),
                                    max(model.trigger_cycles * 8.0, 80.0), 14).astype(int))
    grid = design_grid(model, rates, cycles)
    kilo = 1e-3 * rates
    axes.set(xscale='log', yscale='log', xlabel='trigger cycles in an average',
             ylabel='keyphasor rate [kHz]', xlim=(cycles[0], cycles[-1]),
             ylim=(kilo[0], kilo[-1]))
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter('{x:g}')
        axis.set_minor_formatter(LogFormatter(minor_thresholds=(2.0, 0.5)))
    worst = np.maximum(grid.loss / options.maximum_loss,
                       grid.variation / options.maximum_variation)
    axes.contourf(cycles, kilo, worst, levels=[0.0, 1.0], colors=[_KEPT])
    for level in _levels(grid.loss, options.maximum_loss):
        last = np.flatnonzero(grid.loss[:, 0] > level)[-1]  # the loss depends on the rate only
        around = slice(last, last + 2)
        rate = np.interp(-level, -grid.loss[around, 0], kilo[around])
        axes.axhline(rate, color='tab:red', linestyle='dashed',
                     linewidth=_width(level, options.maximum_loss))
        axes.text(1.01, rate, _percent(level), color='tab:red', fontsize=8, va='center',
                  transform=axes.get_yaxis_transform())
    levels = _levels(grid.variation, options.maximum_variation)
    if levels:
        lines = axes.contour(cycles, kilo, grid.variation, levels=levels, colors='tab:blue',
                             linewidths=[_width(level, options.maximum_variation)
                                         for level in levels])
        for label in axes.clabel(lines, fmt=_percent, fontsize=8):
            at = axes.transAxes.inverted().transform(
                axes.transData.transform(label.get_position()))
            if np.abs(at - 0.5).max() > _LABEL_SPACE:  # the edge would cut it off
                label.set_visible(False)
    axes.plot([], [], color='tab:red', linestyle='dashed', label='loss')
    axes.plot([], [], color='tab:blue', label='coefficient of variation')
    axes.fill([], [], color=_KEPT, label='both limits (thick lines) kept')
    axes.plot(model.trigger_cycles, 1e-3 * model.keyphasor_rate, 'k*', markersize=13,
              linestyle='none', label='these settings')
    axes.legend(loc='upper center', bbox_to_anchor=(0.5, -0.12), ncols=4, fontsize=8)
    axes.set_title(f'order {max(model.orders):g} at '
                   f'{max(model.orders) * model.fundamental_frequency:.5g} Hz, '
                   f'{model.jitter_distribution} pulse errors')


def draw_leakage(axes: Axes, remaining: Leakage) -> None:
    """Draw the largest share of an interfering component over the number of trigger cycles."""
    axes.semilogy(
        remaining.candidates, 1e2 * np.maximum(remaining.largest_share, _LEAST_SHARE), '.-',
        color='tab:blue', linewidth=0.8)
    axes.plot(remaining.trigger_cycles, 1e2 * max(np.max(remaining.share), _LEAST_SHARE), 'k*',
              markersize=13, linestyle='none', label='these settings')
    axes.set(xlabel='trigger cycles in an average', ylabel='largest remaining share [%]',
             title='interfering components in the amplitudes of the orders')
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.yaxis.set_major_locator(LogLocator(subs=_STEPS))
    axes.yaxis.set_major_formatter('{x:g}')
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)


def draw_detection(axes: Axes, found: Design, detection: np.ndarray, options: argparse.Namespace
                   ) -> None:
    """Draw the probability of detection over the size of the change."""
    changes = np.linspace(0.0, 2.0 * options.change, _CHANGES)
    changes = changes[changes >= -1.0]
    curves = detection_probability(found.model, changes, options.false_alarm_rate)
    for order, curve in zip(found.orders, curves):
        axes.plot(1e2 * changes, curve, label=f'order {order:g}')
    axes.plot(np.full(detection.size, 1e2 * options.change), detection, 'k*',
              markersize=9, linestyle='none', label=f'change of {_percent(options.change)}')
    axes.axhline(options.false_alarm_rate, color='0.5', linestyle='dotted',
                 label=f'false-alarm rate {options.false_alarm_rate:g}')
    axes.set(xlabel='change of the amplitude [%]', ylabel='probability of detection',
             ylim=(0.0, 1.02), title='detection by one average')
    axes.grid(alpha=0.3)
    axes.legend(loc='center right' if options.change > 0.0 else 'center left', fontsize=8)


def main(args: Sequence[str] | None = None) -> int:
    """Choose or assess settings, print a table and write the figure; return the exit status."""
    try:
        options = parse(args)
        keywords: dict[str, Any] = vars(options).copy()
        output = keywords.pop('output')
        formats = Figure().canvas.get_supported_filetypes()
        if output.suffix.lstrip('.').lower() not in formats:
            raise ParameterError(f'--output {output}: give a file that ends in .png, .pdf or .svg')
        found = design(**keywords)
        if status := show('design', table(found, options)):
            return status
        draw(found, options).savefig(output)
    except (SaJitterError, OSError) as error:
        print(f'design: {with_options(str(error))}', file=sys.stderr)
        return 2
    return show('design', f'\nfigure: {output}')


def with_options(text: str) -> str:
    """Return a text with the command's options for the keywords that only code has."""
    options = {action.dest: action.option_strings[0] for action in make_parser()._actions}
    return re.sub(r'\b[a-z]+(_[a-z]+)+\b', lambda found: options.get(found[0], found[0]), text)


def _percent(level: float) -> str:
    return f'{100.0 * level:.3g} %'


def _width(level: float, limit: float) -> float:
    return 2.2 if level == limit else 1.0


def _levels(values: np.ndarray, limit: float) -> list[float]:
    """Return the limit, and steps of 1, 2 and 5 per decade that are not close to it."""
    low, high = max(np.nanmin(values), 0.9 * _LEAST_SHARE), np.nanmax(values)
    steps = np.array(LogLocator(subs=_STEPS, numticks=99).tick_values(low, high))
    steps = steps[(steps > low) & (steps < high) & (np.abs(np.log(steps / limit)) > 0.2)]
    return sorted([*steps.tolist(), *([limit] if low < limit < high else [])])


if __name__ == '__main__':
    sys.exit(main())
