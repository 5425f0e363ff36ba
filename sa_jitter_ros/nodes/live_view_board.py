"""
What the live view shows: the latest of every topic and bounded histories, as JSON has it.

A subscriber puts messages on the board, clients take what is newer than the version they have.
Contents are made when they are taken. Numbers that are not finite become None.
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
from numpy.typing import NDArray
from sa_jitter_ros.nodes.messages import AverageMessage, PredictionMessage, ResidualMessage

FloatArray = NDArray[np.float64]
Json = Any

CHANNELS, ORDERS, INDICATORS = 64, 256, 64  # that are shown
CURVE_POINTS, ALL_POINTS = 1200, 16000  # of one waveform, of all channels
HISTORY, HISTORY_NUMBERS = 30, 20000  # averages whose attenuation is kept; numbers in them
PULSES = 1000  # whose errors are kept
SPEEDS = 200


@dataclass(frozen=True)
class _Item:
    version: int
    received: float
    content: Callable[[], Json]


class Board:
    """Contents by name with versions; safe to use from several threads."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._items: dict[str, _Item] = {}
        self._version = 0
        self._heard = -math.inf
        self._run = secrets.token_hex(4)

    def put(self, name: str, content: Callable[[], Json], *, data: bool = True) -> None:
        """Replace a content; `data` tells that it comes from the machine."""
        now = time.monotonic()
        with self._lock:
            self._version += 1
            self._items[name] = _Item(self._version, now, content)
            self._heard = now if data else self._heard

    def silence(self) -> float | None:
        """Seconds since the machine was heard, None if never."""
        return time.monotonic() - self._heard if math.isfinite(self._heard) else None

    def since(self, version: int) -> dict[str, Json]:
        """
        Return the contents that came after a version, and the version they make.

        `now` and `received` are seconds of one clock; `run` is another one when the board is a
        new one, whose versions say nothing about those of the old.
        """
        with self._lock:
            items = {name: item for name, item in self._items.items() if item.version > version}
            current = self._version
        return {'run': self._run, 'version': current, 'now': time.monotonic(),
                'silence': self.silence(),
                'parts': {name: {'received': item.received, 'content': item.content()}
                          for name, item in items.items()}}


class PulseErrors:
    """The last pulse errors (pulse, `PULSE_ERROR_FIELDS`) of one shaft."""

    def __init__(self) -> None:
        self.values: FloatArray = np.empty((0, 3))

    def add(self, values: FloatArray) -> FloatArray:
        """Append an average's; where averages overlap the newer counts. Returns all."""
        first = np.min(values[:, 0], initial=math.inf)
        kept = self.values[self.values[:, 0] < first]
        self.values = np.concatenate((kept, values))[-PULSES:]
        return self.values


class Attenuations:
    """The attenuations (channel, order) of the last averages of one shaft."""

    def __init__(self) -> None:
        self._orders: FloatArray = np.empty(0)
        self._values: deque[FloatArray] = deque()

    def add(self, orders: FloatArray, values: FloatArray) -> list[FloatArray]:
        """Append an average's; other orders or channels begin anew. Returns all."""
        if not np.array_equal(orders, self._orders, equal_nan=True):
            self._orders = orders
            self._values = deque(
                maxlen=int(np.clip(HISTORY_NUMBERS // max(values.size, 1), 1, HISTORY)))
        self._values.append(values)
        return list(self._values)


def listed(values: FloatArray) -> Json:
    """Nested lists of an array, None for what is not finite."""
    result = values.astype(object)
    result[~np.isfinite(values)] = None
    return result.tolist()


def number(value: float) -> float | None:
    """Return a number as JSON has it."""
    return value if math.isfinite(value) else None


def header_content(message: Any) -> dict[str, Json]:
    """Return the numbers of a dataclass as JSON has them."""
    return {name: number(value) for name, value in asdict(message).items()
            if isinstance(value, (int, float))}


def envelope(values: FloatArray, points: int) -> FloatArray:
    """
    Return curves (channel, n) with at most `points` points (even), for a screen.

    Of more points the lowest and the highest of every stretch remain: no peak is lost.
    """
    if values.shape[1] <= points:
        return values
    starts = np.arange(points // 2) * values.shape[1] // (points // 2)
    return np.stack([extreme.reduceat(values, starts, axis=1)
                     for extreme in (np.minimum, np.maximum)], axis=2).reshape(len(values), -1)


def rounded(values: FloatArray) -> FloatArray:
    """Values to a hundred-thousandth of the largest: short, and finer than any screen."""
    peak = np.max(np.abs(values), where=np.isfinite(values), initial=0.0)
    return np.round(values, min(5 - math.floor(math.log10(peak)), 300)) if peak > 0.0 else values


def waveform_content(average: AverageMessage) -> Json:
    """Content of a waveform: its header, points in a revolution, curves by channel."""
    shown = average.values[:CHANNELS]
    points = int(np.clip(ALL_POINTS // max(len(shown), 1), 200, CURVE_POINTS))
    return {'header': header_content(average.header), 'points': average.values.shape[1],
            'channels': listed(rounded(envelope(shown, points)))}


def indicators_content(average: AverageMessage) -> Json:
    """Content of condition indicators: their names, values (channel, indicator)."""
    values = average.values[:CHANNELS, :INDICATORS]
    names = average.names or [f'indicator {i}' for i in range(average.values.shape[1])]
    return {'header': header_content(average.header), 'names': names[:values.shape[1]],
            'values': listed(values)}


def orders_content(average: AverageMessage, history: list[FloatArray]) -> Json:
    """Content of order amplitudes: fields (channel, order), attenuations of earlier averages."""
    shown = average.values[:CHANNELS, :ORDERS]
    return {'header': header_content(average.header),
            'history': [listed(item) for item in history],
            **{name: listed(shown[..., i]) for i, name in enumerate(average.names)}}


def pulses_content(average: AverageMessage, values: FloatArray) -> Json:
    """Content of pulse errors: fields (pulse,) of the last pulses."""
    return {'header': header_content(average.header),
            **{name: listed(values[:, i]) for i, name in enumerate(average.names)}}


def table_content(message: PredictionMessage | ResidualMessage, names: tuple[str, ...]) -> Json:
    """Content of a prediction or residual: fields (order,) and header."""
    return {**header_content(message),
            **{name: listed(message.values[:ORDERS, i]) for i, name in enumerate(names)}}
