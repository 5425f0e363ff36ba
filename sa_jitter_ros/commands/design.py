"""
Command `design`: what keyphasor rate and how many revolutions an average needs, or what it gets.

Settings that are given are assessed; those that are left out are chosen so that both limits hold.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
import math
from pathlib import Path
import sys

from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter
import numpy as np
from sa_jitter_ros.commands.parser import Parser
from sa_jitter_ros.errors import ParameterError, SaJitterError
from sa_jitter_ros.statistics.design import (
    assess, Assessment, design_grid, required_keyphasor_rate, required_trigger_cycles)
from sa_jitter_ros.statistics.prediction import DeclaredModel

DISTRIBUTIONS = ('uniform', 'normal', 'triangular')
EXAMPLES = """examples:
  rate and revolutions for the first two harmonics of a 19-tooth mesh, 3 % and 1 %:
    design --orders 19 38 --trigger-speed 41.5 --ratio 2.40789 --attenuation 0.03 --variation 0.01
  what a keyphasor sampled at 23438 Hz and 41 revolutions give:
    design --orders 19 38 --trigger-speed 41.5 --ratio 2.40789 --keyphasor-rate 23438
           --trigger-cycles 41
"""

_ANY_RATE = 1e12  # Hz; stands for the rate until it is chosen
_ANY_CYCLES = 100
_STEPS = np.array([1.0, 2.0, 5.0])
_KEPT = '#d9ead3'


def make_parser() -> Parser:
    """Return the parser of the command line."""
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
    machine.add_argument('--jitter-distribution', choices=DISTRIBUTIONS, default='uniform',
                         help='law of the pulse error, as wide as the keyphasor rate makes it '
                         '(uniform)')
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
    limits.add_argument('--attenuation', type=float, default=0.05, metavar='X',
                        help='largest loss of mean amplitude, a fraction (0.05)')
    limits.add_argument('--variation', type=float, default=0.05, metavar='X',
                        help='largest coefficient of variation of the amplitude, a fraction '
                        '(0.05)')
    parser.add_argument('--output', type=Path, default=Path('design.png'), metavar='FILE',
                        help='figure to write, png, pdf or svg (design.png)')
    return parser


def settle(options: argparse.Namespace) -> DeclaredModel:
    """Return the model with the settings given or chosen; raises SaJitterError."""
    for name in ('attenuation', 'variation'):
        if not 0.0 < getattr(options, name) < 1.0:
            raise ParameterError(f'--{name} is {getattr(options, name)}: give a fraction between '
                                 '0 and 1, both excluded')
    model = DeclaredModel(
        keyphasor_rate=_ANY_RATE if options.keyphasor_rate is None else options.keyphasor_rate,
        trigger_speed=options.trigger_speed,
        trigger_cycles=(_ANY_CYCLES if options.trigger_cycles is None
                        else options.trigger_cycles),
        orders=tuple(options.orders), ratio=options.ratio,
        pulses_per_revolution=options.pulses_per_revolution,
        pulses_per_trigger=options.pulses_per_trigger,
        jitter_distribution=options.jitter_distribution, noise_std=options.noise_std,
        sample_rate=options.sample_rate)
    if options.keyphasor_rate is None:
        rate = _round_up(required_keyphasor_rate(model, options.attenuation))
        model = replace(model, keyphasor_rate=rate)
    if options.trigger_cycles is None:
        model = replace(model, trigger_cycles=required_trigger_cycles(model, options.variation))
    return model


def table(model: DeclaredModel, result: Assessment, options: argparse.Namespace) -> str:
    """Return the settings and what they mean for each order, as lines."""
    def source(value: object, limit: str) -> str:
        return 'given' if value is not None else f'chosen for {limit}'

    revolutions = model.trigger_cycles * model.trigger_revolutions
    rate = source(options.keyphasor_rate, f'an attenuation of at most {options.attenuation:g}')
    cycles = source(options.trigger_cycles, f'a variation of at most {options.variation:g}')
    lines = [
        f'keyphasor rate   {model.keyphasor_rate:g} Hz ({rate})',
        f'trigger cycles   {model.trigger_cycles} ({cycles})',
        f'an average takes {revolutions:g} revolutions of the tach shaft, {model.duration:.4g} s',
        '',
        '   order  frequency Hz  attenuation  coefficient of variation  limits']
    for order, attenuation, variation in zip(
            result.order, result.attenuation, result.coefficient_of_variation):
        broken = [name for name, value in (('attenuation', attenuation), ('variation', variation))
                  if value > getattr(options, name)]
        lines.append(f'{order:8g}  {order * model.fundamental_frequency:12.6g}  '
                     f'{attenuation:11.5f}  {variation:24.5f}  '
                     f'{"kept" if not broken else " and ".join(broken) + " broken"}')
    return '\n'.join(lines)


def draw(model: DeclaredModel, options: argparse.Namespace) -> Figure:
    """Return iso-lines over keyphasor rate and trigger cycles for the highest order."""
    needed = required_keyphasor_rate(model, options.attenuation)
    rates = np.geomspace(min(needed, model.keyphasor_rate) / 3.0,
                         max(needed, model.keyphasor_rate) * 4.0, 20)
    cycles = np.unique(np.geomspace(max(model.trigger_cycles / 4.0, 1.0),
                                    max(model.trigger_cycles * 8.0, 80.0), 14).astype(int))
    grid = design_grid(model, rates, cycles)
    kilo = 1e-3 * rates
    figure = Figure(figsize=(8.0, 5.6), dpi=120, layout='constrained')
    axes = figure.add_subplot(
        xscale='log', yscale='log', xlabel='trigger cycles in an average',
        ylabel='keyphasor rate / kHz', xlim=(cycles[0], cycles[-1]), ylim=(kilo[0], kilo[-1]))
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter('{x:g}')
        axis.set_minor_formatter(LogFormatter(minor_thresholds=(2.0, 0.5)))
    worst = np.maximum(grid.attenuation / options.attenuation,
                       grid.coefficient_of_variation / options.variation)
    axes.contourf(cycles, kilo, worst, levels=[0.0, 1.0], colors=[_KEPT])
    for level in _levels(grid.attenuation, options.attenuation):
        last = np.flatnonzero(grid.attenuation[:, 0] > level)[-1]  # it depends on the rate alone
        around = slice(last, last + 2)
        rate = np.interp(-level, -grid.attenuation[around, 0], kilo[around])
        axes.axhline(rate, color='tab:red', linestyle='dashed',
                     linewidth=_width(level, options.attenuation))
        axes.text(1.01, rate, _percent(level), color='tab:red', fontsize=8, va='center',
                  transform=axes.get_yaxis_transform())
    levels = _levels(grid.coefficient_of_variation, options.variation)
    if levels:
        lines = axes.contour(cycles, kilo, grid.coefficient_of_variation, levels=levels,
                             colors='tab:blue',
                             linewidths=[_width(level, options.variation) for level in levels])
        axes.clabel(lines, fmt=_percent, fontsize=8)
    axes.plot([], [], color='tab:red', linestyle='dashed', label='attenuation')
    axes.plot([], [], color='tab:blue', label='coefficient of variation')
    axes.fill([], [], color=_KEPT, label='both limits (bold) kept')
    axes.plot(model.trigger_cycles, 1e-3 * model.keyphasor_rate, 'k*', markersize=13,
              linestyle='none', label='these settings')
    axes.legend(loc='upper center', bbox_to_anchor=(0.5, -0.12), ncols=4, fontsize=8)
    axes.set_title(f'order {max(model.orders):g} at '
                   f'{max(model.orders) * model.fundamental_frequency:.5g} Hz, '
                   f'{model.jitter_distribution} pulse errors')
    return figure


def main(args: Sequence[str] | None = None) -> int:
    """Choose or assess, print a table and write the figure; returns the exit status."""
    options = make_parser().parse_args(args)
    try:
        known = Figure().canvas.get_supported_filetypes()
        if options.output.suffix.lstrip('.').lower() not in known:
            raise ParameterError(f'--output {options.output}: end the name in .png, .pdf or .svg')
        model = settle(options)
        print(table(model, assess(model), options))
        draw(model, options).savefig(options.output)
    except (SaJitterError, OSError) as error:
        print(f'design: {error}', file=sys.stderr)
        return 2
    print(f'\nfigure: {options.output}')
    return 0


def _round_up(rate: float) -> float:
    """Round up to four digits, which never breaks a limit."""
    unit = 10.0 ** (math.floor(math.log10(rate)) - 3)
    return float(f'{math.ceil(rate / unit) * unit:.4g}')


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
