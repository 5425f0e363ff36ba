# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The result of the demo: a table of the orders, and the files that `average` writes, too."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.averaging.indicators import GearSettings
from sa_jitter_ros.commands.demo_plan import Plan
from sa_jitter_ros.machine import Machine
from sa_jitter_ros.nodes.messages import AverageMessage, PredictionMessage
from sa_jitter_ros.offline.average_figures import on_strongest, strongest_lines
from sa_jitter_ros.offline.figures import write_figures
from sa_jitter_ros.offline.files import ARRAYS, Signals, write_averages
from sa_jitter_ros.offline.series import ShaftCollector, ShaftSeries
from sa_jitter_ros.offline.settings import MachineFile
from sa_jitter_ros.whole_files import finished_together

Results = Sequence[Mapping[str, AverageMessage]]
_FIELDS = ('raw_amplitude', 'corrected_amplitude', 'noise_standard_deviation', 'attenuation')
_PREDICTED = [1, 4, 6]  # mean, 5 % and 95 % quantile


def signals_of(plan: Plan, machine: Machine) -> Signals:
    """Return what the demo averages, of a machine whose parts name the orders."""
    unit = '' if plan.unit == 'unknown' else plan.unit
    return Signals(plan.title, tuple(range(len(plan.channels))), plan.channels,
                   (unit,) * len(plan.channels), machine)


def write_results(plan: Plan, results: Mapping[str, Results],
                  predictions: Mapping[str, PredictionMessage], output: Path) -> str:
    """Write arrays, table and figures of all shafts, and return a table; raises OSError."""
    file = MachineFile.read(plan.params)
    signals, machine = signals_of(plan, file.machine), file.averager
    with finished_together(output, last=ARRAYS) as folder:
        series = []
        for shaft, averages in results.items():
            collector = ShaftCollector(shaft, folder.parent)
            for average in averages:
                collector.add(average)
            if averages:
                series.append(collector.series())
        write_averages(folder, signals, series, {})
        write_figures(folder, signals, series, {
            shaft: GearSettings(machine.get(f'{shaft}.mesh_orders', ()),
                                machine.get(f'{shaft}.sidebands', 1)) for shaft in results}, {
            shaft: item.values[:, _PREDICTED] for shaft, item in predictions.items()})
        return '\n\n'.join((f'shaft {item.shaft}\n' if len(series) > 1 else '')
                           + text_table(signals, item, predictions.get(item.shaft))
                           for item in series)


def text_table(signals: Signals, series: ShaftSeries, prediction: PredictionMessage | None) -> str:
    """Return a table of the orders: amplitude, attenuation, predicted attenuation."""
    channels = strongest_lines(series).tolist()
    names = [signals.channel_names[channel] for channel in channels]
    unit = f' [{signals.units[0]}]' if signals.units[0] else ''
    width = max(12, *map(len, names))
    columns = [[_mean(values) for values in on_strongest(series, name).T] for name in _FIELDS]
    lines = [f'{"order":>8} {"channel":>{width}} {"amplitude" + unit:>16} {"corrected":>10} '
             f'{"noise":>9} {"attenuation":>12} {"predicted mean [5 % .. 95 %]":>30}']
    for i, (raw, corrected, noise, attenuation) in enumerate(zip(*columns)):
        mean, low, high = [float('nan')] * 3 if prediction is None else (
            prediction.values[i, _PREDICTED])
        lines.append(
            f'{series.orders[i]:8g} {names[i]:>{width}} {raw:16.5g} {corrected:10.5g} '
            f'{noise:9.2g} {attenuation:12.4f} {mean:14.4f} [{low:.4f} .. {high:.4f}]')
    return '\n'.join(lines)


def _mean(values: FloatArray) -> float:
    """Return the mean of all values except NaN, NaN if there is none."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else float('nan')
