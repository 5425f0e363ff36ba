# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""All figures of the averages of a recording, as files."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.averaging.indicators import GearSettings
from sa_jitter_ros.offline.average_figures import (
    gear_figure, orders_figure, tracked_orders_figure, waveform_figure)
from sa_jitter_ros.offline.files import Signals
from sa_jitter_ros.offline.series import ShaftSeries
from sa_jitter_ros.offline.spectrum_figures import (
    envelope_figure, order_map_figure, spectra, spectrum_figure)

_DPI = 110


def write_figures(folder: Path, signals: Signals, series: Sequence[ShaftSeries],
                  gears: Mapping[str, GearSettings],
                  predictions: Mapping[str, Array] | None = None) -> None:
    """
    Write the figures of all shafts; raises OSError.

    `gears` and `predictions` are by shaft, as `gear_figure` and `orders_figure` take them. With
    several shafts the name of each file begins with that of the shaft.
    """
    for item in series:
        gear = gears[item.shaft]
        found = spectra(item)
        drawn: dict[str, Figure | None] = {
            'waveform': waveform_figure(signals, item),
            'orders': orders_figure(signals, item, (predictions or {}).get(item.shaft)),
            'spectrum': spectrum_figure(signals, item, found, gear),
            'order_map': order_map_figure(signals, item, found, gear),
            'tracked_orders': tracked_orders_figure(signals, item),
            'gear_signals': gear_figure(signals, item, gear),
            'envelope': envelope_figure(signals, item)}
        prefix = f'{item.shaft}_' if len(series) > 1 else ''
        for name, figure in drawn.items():
            if figure is not None:
                figure.savefig(folder / f'{prefix}{name}.png', dpi=_DPI)
