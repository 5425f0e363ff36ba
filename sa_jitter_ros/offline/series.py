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
All averages of a shaft as arrays (average, ...), collected in files so that memory stays small.

`ShaftCollector` takes the results of one average after the other, under the names of their topics;
`ShaftSeries` holds the arrays under the names that they have in `averages.npz`.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path

import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.averaging.results import AverageHeader, AverageMessage
from sa_jitter_ros.pulses.resampling import periodic

# Names of the arrays where they are not those of the topics.
_NAMES = {'synchronous_average': 'waveform'}
#: Names of the arrays of the header, in its order.
HEADER = tuple(item.name.removeprefix('mean_') for item in fields(AverageHeader))
_OVER_ANGLE = ('waveform', 'corrected_average', 'standard_error')
_PULSES = 'pulse_error'  # whose number differs from average to average
# Of other arrays, the names are those of indicators.
_FIELDS = ('order_amplitude', _PULSES, 'envelope_amplitude', 'envelope_spectrum')


@dataclass(frozen=True)
class ShaftSeries:
    """
    The averages of one shaft: `arrays` by the names that they have in `averages.npz`.

    `waveform`, `standard_error` and `corrected_average` are average x channel x angle, NaN where
    an average has none, `order_amplitude` is average x channel x order x field, `note` (average x
    order) says why an order has no amplitude, `start_time`, ... are (average,).
    """

    shaft: str
    arrays: Mapping[str, Array]

    def __len__(self) -> int:
        """Return the number of averages."""
        return len(self.arrays['sequence'])

    def __getitem__(self, name: str) -> Array:
        """Return an array by its name."""
        return self.arrays[name]

    def __contains__(self, name: object) -> bool:
        """Return whether there is such an array."""
        return name in self.arrays

    def field(self, name: str) -> Array:
        """Return one field: average x channel x order, NaN if the table lacks it."""
        table, names = self['order_amplitude'], self['order_amplitude_fields'].tolist()
        if name not in names:
            return np.full(table.shape[:-1], np.nan)
        return np.asarray(table[..., names.index(name)])

    @property
    def orders(self) -> Array:
        """Return the orders of all channels."""
        return np.asarray(self.field('order')[0, 0])

    def messages(self, kinds: Collection[str], channels: Sequence[int], orders: Array
                 ) -> list[dict[str, AverageMessage]]:
        """Return the results of each average by their topics, of some channels and orders."""
        headers = [AverageHeader(*row) for row in zip(*(self[name].tolist() for name in HEADER))]
        found: list[dict[str, AverageMessage]] = [{} for _ in headers]
        for kind in kinds:
            if kind in self:
                names = tuple(self[f'{kind}_{"fields" if kind in _FIELDS else "names"}'].tolist())
                tables = self[kind][:, channels]
                if kind == 'order_amplitude':
                    tables = tables[:, :, np.isin(self.orders, orders)]
                for parts, header, table in zip(found, headers, tables):
                    parts[kind] = AverageMessage(header, table, names)
        return found

    @property
    def best_waveform(self) -> Array:
        """Return the corrected waveforms if there are any, else the raw ones."""
        return self['corrected_average' if 'corrected_average' in self else 'waveform']


class _Spool:
    """Rows of one shape in a file; rows that were not given are NaN."""

    def __init__(self, path: Path, shape: tuple[int, ...]) -> None:
        self._file, self._path, self.shape = path.open('wb'), path, shape
        self._rows = 0

    def put(self, row: int, values: Array) -> None:
        self._pad(row)
        self._file.write(np.ascontiguousarray(values, np.float64).tobytes())
        self._rows += 1

    def rows(self, count: int) -> Array:
        self._pad(count)
        self._file.close()
        return np.memmap(self._path, np.float64, 'r', shape=(count, *self.shape))

    def _pad(self, row: int) -> None:
        for _ in range(self._rows, row):
            self._file.write(np.full(self.shape, np.nan).tobytes())
        self._rows = max(self._rows, row)


class ShaftCollector:
    """Collects the results of one shaft's averages in files in a `folder`."""

    def __init__(self, shaft: str, folder: Path) -> None:
        self.shaft = shaft
        self._folder = folder
        self._headers: list[tuple[float, ...]] = []
        self._spools: dict[str, _Spool] = {}
        self._names: dict[str, tuple[str, ...]] = {}
        self._pulses: list[Array] = []
        self._notes: list[list[str]] = []
        self._angles = 0

    def add(self, results: Mapping[str, AverageMessage],
            refused: Mapping[float, str] | None = None) -> None:
        """
        Take the arrays of the next average by the names of their topics.

        `refused` are its orders without amplitude, by their reason.
        """
        row = len(self._headers)
        self._notes.append([(refused or {}).get(order, '') for order in
                            results['order_amplitude'].values[0, :, 0].tolist()])
        self._headers.append(astuple(results['synchronous_average'].header))
        self._angles = self._angles or results['synchronous_average'].values.shape[1]
        for topic, result in results.items():
            name = _NAMES.get(topic, topic)
            if result.names:
                self._names[name] = result.names
            if name == _PULSES:
                self._pulses.append(np.column_stack(
                    (result.values, np.full(len(result.values), result.header.sequence))))
                continue
            values = _on_grid(name, result.values, self._angles)
            if name not in self._spools:
                self._spools[name] = _Spool(
                    self._folder / f'{self.shaft}.{name}.raw', values.shape)
            self._spools[name].put(row, values)

    def series(self) -> ShaftSeries:
        """Return all arrays; those that are large stay in their files."""
        arrays: dict[str, Array] = dict(zip(HEADER, map(np.array, zip(*self._headers))))
        arrays |= {name: spool.rows(len(self._headers)) for name, spool in self._spools.items()}
        arrays['note'] = np.array(self._notes, dtype=np.str_)
        arrays['angle'] = np.arange(self._angles) / max(self._angles, 1)
        if self._pulses:
            table = np.concatenate(self._pulses)
            arrays[_PULSES] = table[:, :-1]
            arrays[f'{_PULSES}_sequence'] = table[:, -1].astype(int)
        for name, names in self._names.items():
            arrays[f'{name}_{"fields" if name in _FIELDS else "names"}'] = np.array(names)
        return ShaftSeries(self.shaft, arrays)


def _on_grid(name: str, values: Array, angles: int) -> Array:
    """Return values over the angle at the angles of the first average."""
    if name not in _OVER_ANGLE or values.shape[-1] == angles:
        return values
    if name != 'standard_error':
        return periodic(values, angles)
    place, grid = np.arange(values.shape[-1] + 1) / values.shape[-1], np.arange(angles) / angles
    return np.stack([np.interp(grid, place, np.append(row, row[0])) for row in values])
