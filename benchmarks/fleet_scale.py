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
Amplitudes of recordings with different keyphasors on one scale.

    python benchmarks/fleet_scale.py --figures docs/figures --page docs/average.md

makes the fleet of Fig. 21 of the paper (Table 5: 21 revolutions of the tail drive shaft, ratio
5.8154, mesh order 23; the keyphasor errors are uniform), 200 acquisitions of 20 machines, each
with one of three keyphasors, and averages all of them by the command `average`. With `--data
FOLDER` it does the same with `gear0_gearbox.npz`, whose pulse times are rounded up to the ticks of
six clocks. It prints the tables, and draws the figures.
"""

import argparse
from collections.abc import Callable, Sequence
import csv
from dataclasses import dataclass, replace
from pathlib import Path
import tempfile

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
import numpy as np
from numpy.typing import NDArray
from page import fill, table
import sa_jitter_ros as sa
from sa_jitter_ros.commands import average
from sa_jitter_ros.recordings import read
from sa_jitter_ros.recordings.npz_format import write_npz
from sa_jitter_ros.recordings.recording import ArraySource, Recording
from worse_pulses import with_slower_clock

FloatArray = NDArray[np.float64]

#: Of the paper's Table 5; speed, rate and noise are ours.
CYCLES, RATIO, MESH, SPEED, RATE = 21, 5.8154, 23.0, 21.0, 25_000.0
ORDERS = (MESH, 2.0 * MESH)
#: Uncertainty of a pulse in periods of the mesh: a good keyphasor, that of Fig. 21, a slow one.
WIDTHS = (0.1, 0.4, 0.6)
COLOURS = ('tab:green', 'tab:blue', 'tab:red')
MACHINES, ACQUISITIONS = 20, 10
NOISE = 0.5  # standard deviation per sample, in units of the mesh harmonic of a usual machine
CLOCKS = (2560.0, 3300.0, 4700.0, 6000.0, 9100.0, 13_000.0)
SETTINGS = """
/**/synchronous_averager:
  ros__parameters:
    shafts: [pinion]
    trigger_cycles: {cycles}
    correct_jitter: true
"""


@dataclass(frozen=True)
class Amplitudes:
    """
    Amplitudes of one order and keyphasor over the true ones, an element for each average.

    `corrected` and `error` (its standard error) are NaN where the correction was refused; `raw`
    has that of its repeatability in `raw_error`. `machine` numbers the machines.
    """

    machine: NDArray[np.int64]
    true: FloatArray
    raw: FloatArray
    raw_error: FloatArray
    corrected: FloatArray
    error: FloatArray

    def row(self) -> list[str]:
        """Return cells of a table: means and scatter over the truth, and shares in intervals."""
        known = np.isfinite(self.corrected)
        distance = np.abs(self.corrected - self.true)[known] / self.error[known]
        return [f'{self.raw.size}', _spread(self.raw / self.true),
                _spread((self.corrected / self.true)[known]),
                f'{100.0 * np.median((self.error / self.true)[known]):.2g}',
                '/'.join(f'{100.0 * np.mean(distance < width):.0f}' for width in (1.0, 1.96)),
                f'{np.count_nonzero(~known)}']


HEADER = ('averages', 'raw / true', 'corrected / true', 'standard error, %',
          'truth in corrected ± 1/1.96 errors, %', 'refused')


def _spread(values: FloatArray) -> str:
    return f'{values.mean():.4f} ± {values.std(ddof=1):.4f}'


def averaged(recordings: Sequence[tuple[str, Recording]], folder: Path, cycles: int,
             jobs: int = 1) -> list[dict[str, str]]:
    """Return the rows of the table that the command `average` writes of all recordings."""
    data, output = folder / 'data', folder / 'averages'
    for name, recording in recordings:
        (data / name).parent.mkdir(parents=True, exist_ok=True)
        write_npz(data / f'{name}.npz', recording)
    (folder / 'machine.yaml').write_text(SETTINGS.format(cycles=cycles))
    if average.main([str(data), '--params', str(folder / 'machine.yaml'), '--output', str(output),
                     '--jobs', str(jobs), '--no-figures']):
        raise SystemExit('fleet_scale: average has failed')
    with (output / 'averages.csv').open(newline='') as file:
        rows = list(csv.DictReader(file))
    wrong = [f'{row["recording"]}: {row["error"]}' for row in rows if row['error']]
    if wrong:
        raise SystemExit(f'fleet_scale: {"; ".join(wrong)}')
    return rows


def of_rows(rows: Sequence[dict[str, str]], true: Callable[[dict[str, str]], float],
            machine: Callable[[dict[str, str]], int]) -> Amplitudes:
    """Return the amplitudes of rows, with the true ones and numbers of the machines."""
    columns = [np.array([float(row[name] or 'nan') for row in rows]) for name in (
        'raw_amplitude', 'raw_standard_error', 'corrected_amplitude', 'corrected_standard_error')]
    return Amplitudes(np.array([machine(row) for row in rows]),
                      np.array([true(row) for row in rows]), *columns)


# --- the fleet of the paper ----------------------------------------------------------------------


def machine_amplitude(machine: int) -> FloatArray:
    """Return the amplitudes of the mesh and its second harmonic: machines differ by 30 %."""
    return np.asarray(np.random.default_rng([21, machine]).lognormal(
        np.log([1.0, 0.4]), 0.3))


def acquisition(machine: int, number: int, width: float) -> Recording:
    """
    Return an acquisition of a machine, whose pulse errors are `width` mesh periods wide.

    Its speed is its own, and runs by 1 % within it.
    """
    rng = np.random.default_rng([5, machine, number])
    speed, run = SPEED * rng.uniform(0.95, 1.05), rng.uniform(-0.01, 0.01)
    seconds = (CYCLES + 6.0) / speed
    times = np.arange(round(seconds * RATE)) / RATE
    turns = speed * (times + 0.5 * run * times**2 / seconds)
    pulses = np.interp(np.arange(1.0, np.floor(turns[-1])), turns, times)
    clock = RATIO * MESH * speed / width
    pulses += rng.uniform(-0.5, 0.5, pulses.size) / clock
    sizes, phases = machine_amplitude(machine), rng.uniform(0.0, 2.0 * np.pi, 2)
    vibration = NOISE * rng.standard_normal(times.size) + sum(
        size * np.cos(2.0 * np.pi * order * RATIO * turns + phase)
        for order, size, phase in zip(ORDERS, sizes, phases))
    return Recording(ArraySource(np.asarray(vibration)[None]), RATE, units=('m/s^2',),
                     pulse_times=pulses, tach_rate=float(clock), ratio=RATIO, orders=ORDERS)


def fleet(machines: int, acquisitions: int, folder: Path, jobs: int = 1
          ) -> dict[tuple[float, float], Amplitudes]:
    """Return the amplitudes of a fleet, by width of the pulse errors and order."""
    width = {(machine, number): WIDTHS[(machine + number) % len(WIDTHS)]
             for machine in range(machines) for number in range(acquisitions)}
    rows = averaged([(f'machine_{machine:02}/acquisition_{number:02}',
                      acquisition(machine, number, width[machine, number]))
                     for machine, number in width], folder, CYCLES, jobs)

    def place(row: dict[str, str]) -> tuple[int, int]:
        machine, number = (int(part.rpartition('_')[2]) for part in row['recording'].split('/'))
        return machine, number

    def true(row: dict[str, str]) -> float:
        return float(machine_amplitude(place(row)[0])[ORDERS.index(float(row['order']))])

    return {(size, order): of_rows(
        [row for row in rows if width[place(row)] == size and float(row['order']) == order],
        true, lambda row: place(row)[0]) for order in ORDERS for size in WIDTHS}


def fleet_table(found: dict[tuple[float, float], Amplitudes]) -> str:
    """Return the table of a fleet."""
    return table(('order', 'uncertainty of a pulse', *HEADER), [
        [f'{order:g}', f'{width:g} mesh periods', *item.row()]
        for (width, order), item in found.items()])


def fleet_figure(found: dict[tuple[float, float], Amplitudes]) -> Figure:
    """Draw the distributions of the mesh amplitude over the true one, and all machines."""
    figure = Figure(figsize=(9.0, 7.0), layout='constrained')
    (left, right), (raw, corrected) = figure.subplots(
        2, 2, sharey='row', gridspec_kw={'height_ratios': (4, 5)})
    for width, colour in zip(WIDTHS, COLOURS):
        item, label = found[width, MESH], f'{width:g} mesh periods'
        _distribution(left, item.raw / item.true, colour, label)
        _distribution(right, (item.corrected / item.true)[np.isfinite(item.corrected)], colour,
                      label)
        predicted = sa.predict(
            keyphasor_rate=RATIO * MESH * SPEED / width, trigger_speed=SPEED,
            trigger_cycles=CYCLES, ratio=RATIO, orders=[MESH])
        level = np.linspace(0.005, 0.995, 199)
        left.plot(predicted.distribution.ppf(level)[0], level, 'k', linewidth=0.9)
        for axes, values, error in ((raw, item.raw, item.raw_error),
                                    (corrected, item.corrected, item.error)):
            axes.errorbar(item.machine + 0.2 * (WIDTHS.index(width) - 1), values, yerr=error,
                          fmt='.', color=colour, markersize=3.0, elinewidth=0.6, label=label)
    for axes, name in ((raw, 'raw'), (corrected, 'corrected')):
        item = found[WIDTHS[0], MESH]
        numbers = np.unique(item.machine)
        axes.hlines([machine_amplitude(number)[0] for number in numbers], numbers - 0.45,
                    numbers + 0.45, color='black', linewidth=0.8, label='true')
        axes.set_xlabel('machine')
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.set_title(f'{name}, ± 1 standard error', fontsize='medium')
        axes.set_ylim(bottom=0.0)
    left.plot([], [], 'k', linewidth=0.9, label='predicted')
    left.set_title(f'raw over true amplitude of order {MESH:g}', fontsize='medium')
    right.set_title(f'corrected over true amplitude of order {MESH:g}', fontsize='medium')
    left.set_ylabel('share of the acquisitions')
    raw.set_ylabel(f'amplitude of order {MESH:g} [m/s²]')
    left.legend(loc='upper left', fontsize='small', title='uncertainty of a pulse',
                title_fontsize='small')
    right.sharex(left)
    right.axvline(1.0, color='0.6', linewidth=0.8)
    return figure


def _distribution(axes: Axes, values: FloatArray, colour: str, label: str) -> None:
    ordered = np.sort(values)
    axes.step(ordered, (np.arange(ordered.size) + 1.0) / ordered.size, where='post', color=colour,
              label=label)


# --- the measured gearbox ------------------------------------------------------------------------


def gearbox(path: Path, clocks: Sequence[float], folder: Path, jobs: int = 1
            ) -> dict[tuple[str, float], Amplitudes]:
    """
    Return amplitudes of a recording at several clocks, by clock and order.

    The true ones are those of the same cycles with the pulse times as they are recorded.
    """
    orders = (23.0, 46.0, 115.0)
    recorded = replace(read(path), orders=orders)
    slower = {f'{clock:.0f} Hz': with_slower_clock(recorded, clock) for clock in clocks}
    original = replace(recorded, pulse_times=next(iter(slower.values())).reference_pulse_times)
    rows = averaged([('original', original), *slower.items()], folder, 40, jobs)

    def place(row: dict[str, str]) -> tuple[str, ...]:
        return row['sequence'], row['channel'], row['order']

    true = {place(row): float(row['raw_amplitude']) for row in rows
            if row['recording'] == 'original'}
    return {(name, order): of_rows(
        [row for row in rows if row['recording'] == name and float(row['order']) == order],
        lambda row: true[place(row)], lambda row: int(row['channel']))
        for order in orders for name in slower}


def gearbox_table(found: dict[tuple[str, float], Amplitudes]) -> str:
    """Return the table of a recording at several clocks."""
    return table(('order', 'clock', *HEADER), [
        [f'{order:g}', name, *item.row()] for (name, order), item in found.items()])


def gearbox_figure(found: dict[tuple[str, float], Amplitudes]) -> Figure:
    """Draw the amplitudes at all clocks over those of the recorded pulses."""
    orders = sorted({order for _, order in found})
    names = list(dict.fromkeys(name for name, _ in found))
    figure = Figure(figsize=(9.0, 3.6), layout='constrained')
    panels = figure.subplots(1, len(orders), sharey=True)
    for axes, order in zip(panels, orders):
        for shift, name, colour in ((-0.13, 'raw', 'tab:red'), (0.13, 'corrected', 'tab:blue')):
            for place, clock in enumerate(names):
                item = found[clock, order]
                ratio = getattr(item, name) / item.true
                at = place + shift + np.linspace(-0.1, 0.1, ratio.size)
                axes.plot(at, ratio, '.', color=colour, markersize=3.0,
                          label=name if not place else None)
        axes.axhline(1.0, color='0.5', linewidth=0.8)
        axes.set_xticks(range(len(names)), [item.partition(' ')[0] for item in names], rotation=45)
        axes.set_title(f'order {order:g}', fontsize='medium')
        axes.set_xlabel('clock of the keyphasor [Hz]')
    panels[0].set_ylabel('amplitude over that of\nthe recorded pulses')
    panels[0].legend(fontsize='small')
    return figure


def main() -> None:
    """Average both, print the tables, draw the figures, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--machines', type=int, default=MACHINES)
    parser.add_argument('--acquisitions', type=int, default=ACQUISITIONS)
    parser.add_argument('--data', type=Path, help='folder with gear0_gearbox.npz')
    parser.add_argument('--jobs', type=int, default=1, help='processes')
    parser.add_argument('--figures', type=Path, help='folder for the figures')
    parser.add_argument('--page', type=Path, help='page whose table of the fleet is replaced')
    options = parser.parse_args()
    tables, figures = {}, {}
    with tempfile.TemporaryDirectory() as folder:
        found = fleet(options.machines, options.acquisitions, Path(folder, 'fleet'), options.jobs)
        tables['fleet'], figures['fleet-scale'] = fleet_table(found), fleet_figure(found)
        if options.data:
            measured = gearbox(options.data / 'gear0_gearbox.npz', CLOCKS, Path(folder, 'gearbox'),
                               options.jobs)
            tables['gearbox'] = gearbox_table(measured)
            figures['fleet-gearbox'] = gearbox_figure(measured)
    print(*tables.values(), sep='\n\n')
    for name, figure in figures.items():
        if options.figures:
            figure.savefig(options.figures / f'{name}.png', dpi=110)
    if options.page:
        options.page.write_text(fill(options.page.read_text(), {'fleet': tables['fleet']}))


if __name__ == '__main__':
    main()
