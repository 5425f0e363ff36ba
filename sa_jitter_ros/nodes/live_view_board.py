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
The data of the live view: the latest message of each topic and short histories, as JSON.

The node puts messages on the board; clients get what is newer than the version that they have. The
JSON is made when a client asks for it. Numbers that are not finite become None.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass
import math
import secrets
from threading import Lock
import time
from typing import Any

import numpy as np
from sa_jitter_ros.arrays import Array, FloatArray
from sa_jitter_ros.averaging.results import AverageMessage, PULSE_ERROR_FIELDS
from sa_jitter_ros.json_values import json_values
from sa_jitter_ros.nodes.messages import PredictionMessage, ResidualMessage

Json = Any

# Largest numbers that are kept and shown:
CHANNELS, ORDERS, INDICATORS = 64, 256, 64
CURVE_POINTS, ALL_POINTS = 1200, 16000  # points of one waveform, and of all channels
HISTORY, HISTORY_NUMBERS = 30, 20000  # earlier averages, and attenuations in all of them
PULSES = 1000
SPEEDS = 200
SPECTRUM_ORDERS = 2000
TREND_NUMBERS, TREND_AVERAGES = 400_000, 2000  # numbers that are kept, and averages
MAP_NUMBERS, MAP_AVERAGES = 1_000_000, 300  # amplitudes that are kept, and averages
MAP_ROWS, MAP_COLUMNS = 100, 300  # of a map that is sent
MAP_PERIOD = 0.2  # s between the rows of a map: sliding averages come faster
MAP_SPAN = 80.0  # dB from the largest amplitude of a map down to the smallest that is told apart
MAP_LEVELS = 64  # steps of this span, each a character from '0' on
TREND_SENT = 12_000  # numbers of one trend that are sent: of every n-th average


@dataclass(frozen=True)
class _Item:
    version: int
    received: float
    content: Callable[..., Json]
    by_channel: bool

    def made(self, channel: int) -> dict[str, Json]:
        return {'received': self.received,
                'content': self.content(channel) if self.by_channel else self.content()}


class Board:
    """Contents by name, with versions; several threads may use it."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._items: dict[str, _Item] = {}
        self._version = 0
        self._last_data = -math.inf  # s, time of the last data
        self._run = secrets.token_hex(4)

    def put(self, name: str, content: Callable[..., Json], *, data: bool = True,
            by_channel: bool = False) -> None:
        """
        Replace a content; `data` is true for results of measurements.

        A content `by_channel` is called with the number of the channel that a client shows.
        """
        now = time.monotonic()
        with self._lock:
            self._version += 1
            self._items[name] = _Item(self._version, now, content, by_channel)
            self._last_data = now if data else self._last_data

    def silence(self) -> float | None:
        """Return the time in s since the last data, None before the first."""
        return time.monotonic() - self._last_data if math.isfinite(self._last_data) else None

    def since(self, version: int, channel: int = 0) -> dict[str, Json]:
        """
        Return the contents that are newer than a version, and the present version.

        Contents that are sent by channel are those of `channel`.

        `now` and `received` are times in s of one clock. `run` identifies the board: versions of
        different boards do not compare.
        """
        with self._lock:
            items = {name: item for name, item in self._items.items() if item.version > version}
            current = self._version
        return {'run': self._run, 'version': current, 'now': time.monotonic(),
                'silence': self.silence(),
                'parts': {name: item.made(channel) for name, item in items.items()}}


class PulseErrors:
    """The latest pulse errors (pulse, `PULSE_ERROR_FIELDS`) of one shaft."""

    def __init__(self) -> None:
        self.values: FloatArray = np.empty((0, len(PULSE_ERROR_FIELDS)))

    def add(self, values: FloatArray) -> FloatArray:
        """Add those of an average, which replace earlier ones of the same time; return all."""
        first = np.min(values[:, 0], initial=math.inf)
        kept = self.values[self.values[:, 0] < first]
        self.values = np.concatenate((kept, values))[-PULSES:]
        return self.values


class History:
    """
    Arrays of the latest averages of one shaft, `most`, fewer where they hold more `numbers`.

    Another `key`, and times that run back, start a new one.
    """

    def __init__(self, numbers: int, most: int) -> None:
        self._numbers, self._most, self._key = numbers, most, None
        self.rows: deque[tuple[Any, ...]] = deque()

    def add(self, time: float, key: Any, *arrays: Array) -> list[tuple[Any, ...]]:
        """Add the arrays of an average that ended at `time` (s); return all, with their times."""
        if key != self._key or (self.rows and time < self.rows[-1][0]):
            size = max(sum(array.size for array in arrays), 1)
            self._key = key
            self.rows = deque(maxlen=int(np.clip(self._numbers // size, 1, self._most)))
        self.rows.append((time, *arrays))
        return list(self.rows)


class Trend:
    """What the latest averages of one shaft found: rows (channel, name) with standard errors."""

    def __init__(self) -> None:
        self._history = History(TREND_NUMBERS, TREND_AVERAGES)
        self._names: tuple[str, ...] = ()

    def add(self, time: float, names: tuple[str, ...], values: FloatArray, errors: FloatArray
            ) -> Callable[[int], Json]:
        """
        Add values and errors (channel, name) of an average that ended at `time` (s).

        Returns the content by channel.
        """
        self._names = names
        rows = self._history.add(time, (names, values.shape), values, errors)
        return lambda channel: trend_content(names, rows, channel)

    def amend(self, time: float, errors: FloatArray) -> Callable[[int], Json] | None:
        """
        Give the last values, of an average that ended at `time` (s), errors that came later.

        Returns the content by channel, None where the errors are those of another average.
        """
        last, values, _ = self._history.rows[-1] if self._history.rows else (math.nan, errors, 0)
        if last != time or errors.shape != values.shape:
            return None
        self._history.rows.pop()
        return self.add(time, self._names, values, errors)


class OrderMap:
    """The order spectra of the latest averages of one shaft, for a picture."""

    def __init__(self) -> None:
        self._history = History(MAP_NUMBERS, MAP_AVERAGES)
        self._next = -math.inf  # s, when the next row may be added

    def add(self, end_time: float, waveforms: FloatArray) -> Callable[[int], Json] | None:
        """
        Add an average (channel, angle) that ended at a time (s).

        Returns the content by channel, None where the last row is too young for another.
        """
        now = time.monotonic()
        if now < self._next:
            return None
        self._next = now + MAP_PERIOD
        amplitudes = spectrum(waveforms)[0].astype(np.float32)
        rows = self._history.add(end_time, amplitudes.shape, amplitudes)
        return lambda channel: map_content(rows, channel)


def map_content(rows: list[tuple[Any, ...]], channel: int) -> Json:
    """
    Return the map of one channel: the latest average last, a character for each amplitude.

    A row stands for `step` averages, the last of which ended at its `time` (s), and a column for
    `pool` orders, of which it shows the largest amplitude.
    """
    step = -(-len(rows) // MAP_ROWS)
    chosen = [row for row in rows[::-1][::step][::-1] if channel < len(row[1])]
    shown = np.array([row[channel] for _, row in chosen]).reshape(-1, rows[0][1].shape[1])
    pool = -(-shown.shape[1] // MAP_COLUMNS)
    if not shown.size:
        return {'channel': channel, 'rows': [], 'step': step, 'pool': 1, 'peak': None}
    largest = np.fmax.reduceat(shown, np.arange(0, shown.shape[1], pool), axis=1)
    peak = float(np.max(largest, where=np.isfinite(largest), initial=0.0))
    with np.errstate(divide='ignore', invalid='ignore'):
        level = 1.0 + 20.0 * np.log10(largest / peak) / MAP_SPAN
    code = np.rint(np.clip(np.nan_to_num(level), 0.0, 1.0) * (MAP_LEVELS - 1)).astype(np.uint8)
    return {'channel': channel, 'rows': [bytes(row + ord('0')).decode() for row in code],
            'time': json_values(np.array([end_time for end_time, _ in chosen])),
            'step': step, 'pool': pool, 'peak': json_values(peak), 'span': MAP_SPAN}


def trend_content(names: tuple[str, ...], rows: list[tuple[Any, ...]], channel: int) -> Json:
    """Return a trend of one channel: names, times, values and errors (average, name)."""
    step = -(-2 * len(names) * len(rows) // TREND_SENT)
    shown = rows[::-1][::step][::-1] if channel < len(rows[0][1]) else []
    values = np.array([row[channel] for _, row, _ in shown]).reshape(-1, len(names))
    errors = np.array([row[channel] for _, _, row in shown]).reshape(-1, len(names))
    return {'channel': channel, 'names': names, 'averages': len(rows),
            'time': json_values(np.array([time for time, _, _ in shown])),
            'value': json_values(significant(values)),
            'error': json_values(significant(errors, 3))}


def significant(values: FloatArray, digits: int = 5) -> FloatArray:
    """
    Return each value rounded to significant digits, for short texts.

    >>> significant(np.array([123456.0, 0.00123456, 0.0, np.nan]), 3).tolist()
    [123000.0, 0.00123, 0.0, nan]
    """
    size = np.where(np.isfinite(values) & (np.abs(values) > 1e-300), np.abs(values), 1.0)
    scale = 10.0 ** (digits - 1 - np.floor(np.log10(size)))
    return np.asarray(np.round(values * scale) / scale)


def header_content(message: Any) -> dict[str, Json]:
    """Return the numbers of a dataclass by name."""
    return {name: json_values(value) for name, value in asdict(message).items()
            if isinstance(value, (int, float))}


def envelope(values: FloatArray, points: int) -> FloatArray:
    """
    Return curves (channel, n) with at most `points` points, an even number.

    Longer curves are divided into `points` / 2 sections: the lowest and the highest value of each
    remain, so that no peak is lost.
    """
    if values.shape[1] <= points:
        return values
    starts = np.arange(points // 2) * values.shape[1] // (points // 2)
    return np.stack([extreme.reduceat(values, starts, axis=1)
                     for extreme in (np.minimum, np.maximum)], axis=2).reshape(len(values), -1)


def rounded(values: FloatArray) -> FloatArray:
    """Round values to 1e-5 of the largest, for short texts; a screen shows less."""
    peak = np.max(np.abs(values), where=np.isfinite(values), initial=0.0)
    return np.round(values, min(5 - math.floor(math.log10(peak)), 300)) if peak > 0.0 else values


def waveform_content(average: AverageMessage) -> Json:
    """Return a waveform: header, points per revolution, number of channels, curves of most."""
    shown = average.values[:CHANNELS]
    points = int(np.clip(ALL_POINTS // max(len(shown), 1), 200, CURVE_POINTS))
    return {'header': header_content(average.header), 'points': average.values.shape[1],
            'count': len(average.values),
            'channels': json_values(rounded(envelope(shown, points)))}


def spectrum_content(average: AverageMessage, channel: int) -> Json:
    """Return the order spectrum of one channel: amplitudes and phases of orders 1, 2, ...."""
    amplitudes, phases = spectrum(average.values[channel:channel + 1])
    return {'channel': channel, 'amplitude': json_values(significant(amplitudes.ravel(), 4)),
            'phase': json_values(np.round(phases.ravel(), 3))}


def spectrum(waveforms: FloatArray) -> tuple[FloatArray, FloatArray]:
    """
    Return peak amplitudes and phases (rad) of orders 1, 2, ... of waveforms (channel, angle).

    A cosine of amplitude a has amplitude a and phase 0. The highest order is below half the number
    of angles.

    >>> angle = np.arange(16) / 16
    >>> amplitudes, phases = spectrum(3.0 * np.cos(2.0 * np.pi * (2.0 * angle + 0.125))[None])
    >>> amplitudes.round(6)[0, :3].tolist(), float(np.round(phases[0, 1] / np.pi, 6))
    ([0.0, 3.0, 0.0], 0.25)
    """
    points = waveforms.shape[1]
    most = min((points - 1) // 2, SPECTRUM_ORDERS)
    lines = 2.0 / max(points, 1) * np.fft.rfft(waveforms, axis=1)[:, 1:most + 1]
    return np.abs(lines), np.angle(lines)


def indicators_content(average: AverageMessage) -> Json:
    """Return condition indicators: header, names, values (channel, indicator)."""
    values = average.values[:CHANNELS, :INDICATORS]
    names = average.names or [f'indicator {i}' for i in range(average.values.shape[1])]
    return {'header': header_content(average.header), 'names': names[:values.shape[1]],
            'values': json_values(values)}


def orders_content(average: AverageMessage, history: list[tuple[Any, ...]]) -> Json:
    """Return order amplitudes: fields (channel, order), attenuations of earlier averages."""
    shown = average.values[:CHANNELS, :ORDERS]
    return {'header': header_content(average.header),
            'history': [json_values(item) for _, item in history],
            **{name: json_values(shown[..., i]) for i, name in enumerate(average.names)}}


def amplitude_rows(shown: FloatArray, names: tuple[str, ...], kind: str
                   ) -> tuple[FloatArray, FloatArray]:
    """Return `raw` or `corrected` amplitudes (channel, order) and the errors that are known."""
    fields = dict(zip(names, np.moveaxis(shown, -1, 0)))
    values = fields[f'{kind}_amplitude']
    noise = fields['noise_standard_deviation'] if kind == 'corrected' else values * np.nan
    return values, fields.get(f'{kind}_standard_error', noise)


def pulses_content(average: AverageMessage, values: FloatArray) -> Json:
    """Return pulse errors: header, fields (pulse,) of the latest pulses."""
    return {'header': header_content(average.header),
            **{name: json_values(values[:, i]) for i, name in enumerate(average.names)}}


def table_content(message: PredictionMessage | ResidualMessage, names: tuple[str, ...]) -> Json:
    """Return a prediction or residual: header, fields (order,)."""
    return {**header_content(message),
            **{name: json_values(message.values[:ORDERS, i]) for i, name in enumerate(names)}}
