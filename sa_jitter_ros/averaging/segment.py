"""Runs of consecutive samples on one clock, and the account of those that are not averaged."""

from dataclasses import dataclass, field
import math

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Span = tuple[int, int]  # first index, and the one behind the last

_KEPT = 200  # spans that are remembered


@dataclass(frozen=True)
class SampleClock:
    """Times of a run of samples: that of the first one, and on from there by index over rate."""

    time: float
    index: int
    rate: float

    def time_of(self, index: float) -> float:
        """Time (s) of a sample index."""
        return self.time + (index - self.index) / self.rate


class Segment:
    """
    Consecutive finite samples on one clock; grows at the end, is trimmed at the start.

    `epoch` counts how often time ran back before it; `closed` tells that no sample will follow.
    Every sample is accounted for once: `use` tells that it was averaged, `trim` returns how many
    were not.
    """

    def __init__(self, clock: SampleClock, epoch: int, index: int, samples: FloatArray) -> None:
        self.clock, self.epoch, self.closed = clock, epoch, False
        self._data = np.ascontiguousarray(samples.T)
        self._begin, self._end = 0, len(self._data)
        self._index = self._settled = index  # samples before the latter are accounted for
        self._begins_run = index == clock.index

    @property
    def index(self) -> int:
        """Index of the first sample held."""
        return self._index + self._begin

    @property
    def end_index(self) -> int:
        """Index after the last sample held."""
        return self._index + self._end

    @property
    def samples(self) -> FloatArray:
        """Samples held (sample, channel), without a copy."""
        return self._data[self._begin:self._end]

    @property
    def start_time(self) -> float:
        """Time of the first sample held."""
        return self.clock.time_of(self.index)

    @property
    def end_time(self) -> float:
        """Time of the last sample held."""
        return self.clock.time_of(self.end_index - 1)

    def position(self, time: float) -> float:
        """Position of a time (s) in samples from the first one held."""
        return (time - self.clock.time) * self.clock.rate + (self.clock.index - self.index)

    def append(self, samples: FloatArray) -> None:
        """Add samples (channel, sample) behind the last one."""
        count = samples.shape[1]
        if self._end + count > len(self._data):
            held = self.samples
            size = max(2 * (len(held) + count), 1024)
            data = np.empty((size, held.shape[1]))
            data[:len(held)] = held
            self._index, self._data = self.index, data
            self._begin, self._end = 0, len(held)
        self._data[self._end:self._end + count] = samples.T
        self._end += count

    def use(self, low: float, high: float) -> int:
        """
        Take the samples between two positions as averaged; return how many before them were not.

        What comes before the first averaged cycle of a run is not counted: its pulses begin there.
        """
        first, end = (self.index + math.ceil(at - 1e-6) for at in (low, high))
        passed = 0 if self._begins_run else max(first - self._settled, 0)
        self._begins_run = False
        self._settled = max(self._settled, end)
        return passed

    def trim(self, index: int) -> int:
        """Forget the samples before `index`; return how many of them were not averaged."""
        end = min(max(index, self.index), self.end_index)
        unused = max(end - self._settled, 0)
        self._begin += end - self.index
        self._settled = max(self._settled, end)
        return unused


@dataclass
class SampleLedger:
    """
    Account of the samples of one run that are not used, by their index.

    A sample that the index leaves out is lost, unless it came before and was dropped. One that
    comes after it was counted as lost is not dropped, too. The latest spans only are remembered.
    """

    _lost: list[Span] = field(default_factory=list)
    _dropped: list[Span] = field(default_factory=list)

    def lose(self, span: Span) -> int:
        """Take that the index leaves out a span; return how many samples are lost."""
        left = [span]
        for dropped in self._dropped:
            left = _without(left, dropped)
        self._lost = (self._lost + left)[-_KEPT:]
        return _size(left)

    def drop(self, span: Span) -> int:
        """Take that samples came and are not used; return how many of them were not lost."""
        before, self._lost = _size(self._lost), _without(self._lost, span)
        self._dropped = [*self._dropped, span][-_KEPT:]
        return span[1] - span[0] - (before - _size(self._lost))


def _without(spans: list[Span], gone: Span) -> list[Span]:
    """Return what is left of spans."""
    pieces = (piece for first, end in spans
              for piece in ((first, min(end, gone[0])), (max(first, gone[1]), end)))
    return [(first, end) for first, end in pieces if first < end]


def _size(spans: list[Span]) -> int:
    return sum(end - first for first, end in spans)
