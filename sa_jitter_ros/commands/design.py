"""
Command `design`: what keyphasor rate and how many revolutions an average needs, or what it gets.

Settings that are given are assessed; those that are left out are chosen so that both limits hold.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
import sys
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter, LogLocator, MaxNLocator, NullFormatter
import numpy as np
from sa_jitter_ros.commands.command_line import Parser
from sa_jitter_ros.errors import ParameterError, SaJitterError
from sa_jitter_ros.prediction.comb import Leakage
from sa_jitter_ros.prediction.design import (
    Design, design, design_grid, detection_probability, RATE_DISTRIBUTIONS,
    required_keyphasor_rate)

EXAMPLES = """examples:
  rate and revolutions for the first two harmonics of a 19-tooth mesh, 3 % and 1 %:
    design --orders 19 38 --trigger-speed 41.5 --ratio 2.40789 --loss 0.03 --variation 0.01
  what a keyphasor sampled at 23438 Hz and 41 revolutions give:
    design --orders 19 38 --trigger-speed 41.5 --ratio 2.40789 --keyphasor-rate 23438
           --trigger-cycles 41
  revolutions that keep a mesh order of the other shaft and mains hum out, and whether a change
  of 5 % shows at one false alarm in a hundred averages:
    design --orders 19 38 --trigger-speed 41.5 --ratio 2.40789 --others 18.6886 --tones 50
           --change 0.05 --false-alarm-rate 0.01
"""

_STEPS = (1.0, 2.0, 5.0)
_KEPT = '#d9ead3'
_BEST = 5  # numbers of trigger cycles to name
_CHANGES = 25  # points of a curve
_LEAST_SHARE = 1e-6  # shown of an exact notch


def make_parser() -> Parser:
    """Return the parser of the command line; its names are the keywords of `design`."""
    parser = Parser(prog='design', description=__doc__, epilog=EXAMPLES,
                    formatter_class=argparse.RawDescriptionHelpFormatter)
    machine = parser.add_argument_group('machine and average')
    machine.add_argument('--orders', type=float, nargs='+', required=True, metavar='ORDER',
                         help='orders to monitor, multiples of the shaft of interest')
    machine.add_argument('--trigger-speed', type=float, required=True, metavar='HZ',
                         help='speed of the shaft that carries the keyphasor, Hz')
    machine.add_argument('--ratio', type=float, default=1.0,
                         help='speed of the shaft of interest / speed of the tach shaft (1)')
    machine.add_argument('--pulses-per-revolution', type=int, default=1, metavar='N',
                         help='keyphasor pulses per revolution of the tach shaft (1)')
    machine.add_argument('--pulses-per-trigger', type=int, default=0, metavar='N',
                         help='pulses per trigger cycle (all of a revolution)')
    machine.add_argument('--jitter-distribution', choices=RATE_DISTRIBUTIONS, default='uniform',
                         help='distribution of the pulse error, as wide as the keyphasor rate '
                         'makes it (uniform)')
    machine.add_argument('--noise-std', type=float, default=0.0, metavar='X',
                         help='standard deviation of white noise per vibration sample, in units '
                         "of the component's amplitude (0)")
    machine.add_argument('--sample-rate', type=float, default=0.0, metavar='HZ',
                         help='sampling rate of the vibration, Hz; needed with --noise-std')
    settings = parser.add_argument_group('settings (left out: chosen)')
    settings.add_argument('--keyphasor-rate', type=float, metavar='HZ',
                          help='rate at which the keyphasor is sampled, Hz')
    settings.add_argument('--trigger-cycles', type=int, metavar='N',
                          help='trigger cycles in an average')
    limits = parser.add_argument_group('limits')
    limits.add_argument('--loss', '--attenuation', dest='maximum_loss', type=float, default=0.05,
                        metavar='X', help='largest loss of mean amplitude, a fraction (0.05)')
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
                           help='relative change of an order that one average must show: 0.05 is '
                           '5 %% up, -0.05 5 %% down')
    detection.add_argument('--false-alarm-rate', type=float, metavar='P',
                           help='share of averages without a change that may raise an alarm')
    parser.add_argument('--output', type=Path, default=Path('design.png'), metavar='FILE',
                        help='figure to write, png, pdf or svg (design.png)')
    return parser


def table(found: Design, options: argparse.Namespace) -> str:
    """Return the settings and what they mean for each order, as lines."""
    model = found.model
    revolutions = model.trigger_cycles * model.trigger_revolutions
    rate = ('given' if options.keyphasor_rate is not None
            else f'chosen for a loss of at most {options.maximum_loss:g}')
    cycles = ('given' if options.trigger_cycles is not None
              else f'chosen for a variation of at most {options.maximum_variation:g}'
              + (' and for what interferes' if found.leakage else ''))
    detection = '' if found.detection is None else f'  {_percent(options.change):>6} detected'
    lines = [
        f'keyphasor rate   {found.keyphasor_rate:g} Hz ({rate})',
        f'trigger cycles   {found.trigger_cycles} ({cycles})',
        f'an average takes {revolutions:g} revolutions of the tach shaft, {model.duration:.4g} s',
        '',
        f'   order  frequency Hz     loss  coefficient of variation{detection}  limits']
    for i, order in enumerate(found.orders):
        loss, variation = found.loss[i], found.variation[i]
        broken = [name for name, value, limit in (
            ('loss', loss, options.maximum_loss),
            ('variation', variation, options.maximum_variation)) if value > limit]
        detected = '' if found.detection is None else f'  {found.detection[i]:15.4f}'
        lines.append(f'{order:8g}  {order * model.fundamental_frequency:12.6g}  {loss:7.5f}  '
                     f'{variation:24.5f}{detected}  '
                     f'{"kept" if not broken else " and ".join(broken) + " broken"}')
    if found.leakage is not None:
        lines += ['', *leakage_table(found.leakage, found, options)]
    return '\n'.join(lines)


def leakage_table(left: Leakage, found: Design, options: argparse.Namespace) -> list[str]:
    """Return what is left of interfering components, and better numbers of cycles, as lines."""
    names = [*(f'order {order:g}' for order in options.others),
             *(f'{tone:g} Hz (order {order:.4g})' for tone, order in zip(
                 options.tones, left.orders[len(options.others):]))]
    width = max(len(name) for name in ('interfering', *names))
    lines = ['share of each interfering component that is left at most',
             f'{"interfering":{width}}' + ''.join(
                 f'  {f"at order {order:g}":>14}' for order in found.orders)
             + '  in the waveform']
    for name, shares, waveform in zip(names, left.share, left.waveform_share):
        lines.append(f'{name:{width}}' + ''.join(f'  {share:14.5f}' for share in shares)
                     + f'  {waveform:15.5f}')
    best = left.best(_BEST)
    lines += ['', f'numbers of trigger cycles from {left.candidates[0]} to {left.candidates[-1]} '
              'that leave least at the orders:',
              'trigger cycles ' + ''.join(f'{count:10d}' for count in best),
              'largest share  ' + ''.join(
                  f'{left.largest_share[count - left.candidates[0]]:10.5f}' for count in best)]
    return lines


def draw(found: Design, options: argparse.Namespace) -> Figure:
    """Return the figure: limits, and where asked for interfering components and detection."""
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
    """Draw iso-lines over keyphasor rate and trigger cycles for the highest order."""
    model = found.model
    needed = required_keyphasor_rate(model, options.maximum_loss)
    rates = np.geomspace(min(needed, model.keyphasor_rate) / 3.0,
                         max(needed, model.keyphasor_rate) * 4.0, 20)
    cycles = np.unique(np.geomspace(max(model.trigger_cycles / 4.0, 1.0),
                                    max(model.trigger_cycles * 8.0, 80.0), 14).astype(int))
    grid = design_grid(model, rates, cycles)
    kilo = 1e-3 * rates
    axes.set(xscale='log', yscale='log', xlabel='trigger cycles in an average',
             ylabel='keyphasor rate / kHz', xlim=(cycles[0], cycles[-1]),
             ylim=(kilo[0], kilo[-1]))
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter('{x:g}')
        axis.set_minor_formatter(LogFormatter(minor_thresholds=(2.0, 0.5)))
    worst = np.maximum(grid.loss / options.maximum_loss,
                       grid.variation / options.maximum_variation)
    axes.contourf(cycles, kilo, worst, levels=[0.0, 1.0], colors=[_KEPT])
    for level in _levels(grid.loss, options.maximum_loss):
        last = np.flatnonzero(grid.loss[:, 0] > level)[-1]  # it depends on the rate alone
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
        axes.clabel(lines, fmt=_percent, fontsize=8)
    axes.plot([], [], color='tab:red', linestyle='dashed', label='loss')
    axes.plot([], [], color='tab:blue', label='coefficient of variation')
    axes.fill([], [], color=_KEPT, label='both limits (bold) kept')
    axes.plot(model.trigger_cycles, 1e-3 * model.keyphasor_rate, 'k*', markersize=13,
              linestyle='none', label='these settings')
    axes.legend(loc='upper center', bbox_to_anchor=(0.5, -0.12), ncols=4, fontsize=8)
    axes.set_title(f'order {max(model.orders):g} at '
                   f'{max(model.orders) * model.fundamental_frequency:.5g} Hz, '
                   f'{model.jitter_distribution} pulse errors')


def draw_leakage(axes: Axes, left: Leakage) -> None:
    """Draw the largest share of an interfering component over the number of trigger cycles."""
    axes.semilogy(left.candidates, 1e2 * np.maximum(left.largest_share, _LEAST_SHARE), '.-',
                  color='tab:blue', linewidth=0.8)
    axes.plot(left.trigger_cycles, 1e2 * max(np.max(left.share), _LEAST_SHARE), 'k*',
              markersize=13, linestyle='none', label='these settings')
    axes.set(xlabel='trigger cycles in an average', ylabel='largest share left / %',
             title='interfering components in the amplitudes of the orders')
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.yaxis.set_major_locator(LogLocator(subs=_STEPS))
    axes.yaxis.set_major_formatter('{x:g}')
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)


def draw_detection(
    axes: Axes, found: Design, detection: np.ndarray, options: argparse.Namespace,
) -> None:
    """Draw the probability to detect a change over its size."""
    changes = np.linspace(0.0, 2.0 * options.change, _CHANGES)
    changes = changes[changes >= -1.0]
    curves = detection_probability(found.model, changes, options.false_alarm_rate)
    for order, curve in zip(found.orders, curves):
        axes.plot(1e2 * changes, curve, label=f'order {order:g}')
    axes.plot(np.full(detection.size, 1e2 * options.change), detection, 'k*',
              markersize=9, linestyle='none', label=f'change of {_percent(options.change)}')
    axes.axhline(options.false_alarm_rate, color='0.5', linestyle='dotted',
                 label=f'false-alarm rate {options.false_alarm_rate:g}')
    axes.set(xlabel='change of the component / %', ylabel='probability to detect it',
             ylim=(0.0, 1.02), title='detection by one average')
    axes.grid(alpha=0.3)
    axes.legend(loc='center right' if options.change > 0.0 else 'center left', fontsize=8)


def main(args: Sequence[str] | None = None) -> int:
    """Choose or assess, print a table and write the figure; returns the exit status."""
    options = make_parser().parse_args(args)
    keywords: dict[str, Any] = vars(options).copy()
    output = keywords.pop('output')
    try:
        known = Figure().canvas.get_supported_filetypes()
        if output.suffix.lstrip('.').lower() not in known:
            raise ParameterError(f'--output {output}: end the name in .png, .pdf or .svg')
        found = design(**keywords)
        print(table(found, options))
        draw(found, options).savefig(output)
    except (SaJitterError, OSError) as error:
        print(f'design: {error}', file=sys.stderr)
        return 2
    print(f'\nfigure: {output}')
    return 0


def _percent(level: float) -> str:
    return f'{100.0 * level:.3g} %'


def _width(level: float, limit: float) -> float:
    return 2.2 if level == limit else 1.0


def _levels(values: np.ndarray, limit: float) -> list[float]:
    """Return the limit and 1, 2, 5 steps within the values and not beside the limit."""
    decades = 10.0 ** np.arange(-6, 1)
    steps = np.multiply.outer(decades, _STEPS).ravel()
    low, high = np.nanmin(values), np.nanmax(values)
    steps = steps[(steps > low) & (steps < high) & (np.abs(np.log(steps / limit)) > 0.2)]
    return sorted([*steps.tolist(), *([limit] if low < limit < high else [])])


if __name__ == '__main__':
    sys.exit(main())
