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
The vibration's timeline: blocks in, segments of consecutive samples out.

The sample index decides continuity. Repeated, misplaced and malformed blocks are dropped; a gap
in the index ends a segment; a source that restarts opens a new epoch. All of this is counted.
`buffer_seconds` limits the memory: the oldest samples are dropped first.
"""

from bisect import bisect_right
from dataclasses import dataclass, field
import math

import numpy as np
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.averaging.rows import Rows
from sa_jitter_ros.errors import SignalError
from sa_jitter_ros.inner_loops import frames
from sa_jitter_ros.samples import finite_spans, SampleBlock, unresolved_times

_Span = tuple[int, int]  # first index, and the one behind the last

_SAME_RATE = 1e-4  # relative: a source may state the rate that it measures
_KEPT = 200  # spans that are remembered


@dataclass(frozen=True)
class SampleClock:
    """Sample times of a run: `time` (s) of sample `index`, and `rate` (Hz) from there on."""

    time: float
    index: int
    rate: float

    def time_of(self, index: float) -> float:
        """Time (s) of a sample index."""
        return self.time + (index - self.index) / self.rate


class Segment:
    """
    Consecutive samples on one clock, added at the end and removed at the start.

    NaN is what a single channel lacks (`lacks_channels`).

    `epoch` is how often time ran back before this segment; `closed` means that no sample follows.
    Every sample is counted once: `use` marks it as averaged, `trim` returns how many samples were
    removed without being averaged.
    """

    def __init__(self, clock: SampleClock, epoch: int, index: int, channels: int) -> None:
        self.clock, self.epoch, self.closed = clock, epoch, False
        self.lacks_channels = False
        self.index = index  # of the first sample held
        self._settled = index  # samples before it are counted
        self._rows = Rows(np.empty((0, channels)))
        self._begins_run = index == clock.index

    @property
    def end_index(self) -> int:
        """Index after the last sample."""
        return self.index + self.size

    @property
    def size(self) -> int:
        """Number of samples held."""
        return len(self._rows)

    @property
    def samples(self) -> FloatArray:
        """Return the samples as (sample, channel), without a copy."""
        return self._rows.items

    @property
    def start_time(self) -> float:
        """Time of the first sample held."""
        return self.clock.time_of(self.index)

    @property
    def end_time(self) -> float:
        """Time of the last sample."""
        return self.clock.time_of(self.end_index - 1)

    def position(self, time: float) -> float:
        """Position of a time (s) in samples from the first one."""
        return (time - self.clock.time) * self.clock.rate + (self.clock.index - self.index)

    def append(self, samples: FloatArray, *, gaps: bool = False) -> bool:
        """
        Add samples (channel, sample) behind the last one; return whether it was done.

        It is not where a number is not finite and no `gaps` are allowed.
        """
        count = samples.shape[1]
        finite = frames(np.asarray(samples, np.float64), self._rows.space(count))
        if not (finite or gaps):
            return False
        self._rows.add(count)
        return True

    def use(self, low: float, high: float) -> int:
        """
        Mark the samples between two positions as averaged; return how many before them were not.

        Samples before the first averaged cycle of a run are not counted, because there are no
        pulses before it.
        """
        first, end = (self.index + math.ceil(at - 1e-6) for at in (low, high))
        passed = 0 if self._begins_run else max(first - self._settled, 0)
        self._begins_run = False
        self._settled = max(self._settled, end)
        return passed

    def trim(self, index: int) -> int:
        """Remove the samples before `index`; return how many of them were not averaged."""
        end = min(max(index, self.index), self.end_index)
        unused = max(end - self._settled, 0)
        self._rows.drop(end - self.index)
        self.index, self._settled = end, max(self._settled, end)
        return unused


@dataclass
class SampleLedger:
    """
    Counts the samples of one run that are not used, each once, by their index.

    A sample in a gap of the index is lost, unless it was received earlier and dropped. A sample
    that arrives after it was counted as lost is not counted as dropped. Only the latest spans are
    kept.
    """

    _lost: list[_Span] = field(default_factory=list)
    _dropped: list[_Span] = field(default_factory=list)

    def lose(self, span: _Span) -> int:
        """Record a gap of the index; return how many samples are lost."""
        lost = [span]
        for dropped in self._dropped:
            lost = _without(lost, dropped)
        self._lost = (self._lost + lost)[-_KEPT:]
        return _size(lost)

    def drop(self, span: _Span) -> int:
        """Record samples that are not used; return how many of them were not counted as lost."""
        before, self._lost = _size(self._lost), _without(self._lost, span)
        self._dropped = [*self._dropped, span][-_KEPT:]
        return span[1] - span[0] - (before - _size(self._lost))


def _without(spans: list[_Span], removed: _Span) -> list[_Span]:
    """Return the spans without the indices in `removed`."""
    pieces = (piece for first, end in spans
              for piece in ((first, min(end, removed[0])), (max(first, removed[1]), end)))
    return [(first, end) for first, end in pieces if first < end]


def _size(spans: list[_Span]) -> int:
    return sum(end - first for first, end in spans)


@dataclass
class TimelineCounts:
    """
    Counts of samples and blocks so far.

    `samples_dropped` were received and are in no average. `samples_lost` are missing in the index
    (`gaps` counts the places) or arrived too late. No sample is counted as both.
    """

    samples_dropped: int = 0
    samples_lost: int = 0
    gaps: int = 0
    restarts: int = 0
    repeats: int = 0
    clock_deviation: int = 0
    blocks_rejected: int = 0
    non_finite: int = 0


def _alike(layout: tuple[int, float] | None, other: tuple[int, float]) -> bool:
    """Whether the number of channels is the same, and the rate (Hz) as far as it is measured."""
    return (layout is not None and layout[0] == other[0]
            and math.isclose(layout[1], other[1], rel_tol=_SAME_RATE))


@dataclass
class VibrationTimeline:
    """
    Takes blocks in any order of arrival and keeps `segments` of consecutive samples.

    A block time that differs from the clock of its run by more than half a sample is counted. A
    block waits for the next one if its time differs by more than `time_tolerance` (s), if it lies
    completely before the start of the last block, or if its samples contradict those of the last
    block. If the next block continues it, it begins a new run, otherwise it is dropped. A new run
    that begins before the end of the old one is a restart; `epoch` counts these.

    >>> timeline = VibrationTimeline()
    >>> timeline.add(SampleBlock(np.zeros((1, 100)), 0.0, 100.0, 0))
    >>> timeline.add(SampleBlock(np.zeros((1, 50)), 1.5, 100.0, 150))
    >>> [(segment.index, segment.end_index) for segment in timeline.segments]
    [(0, 100), (150, 200)]
    >>> timeline.counts.gaps, timeline.counts.samples_lost, timeline.messages
    (1, 50, ['samples 100 to 149 are missing'])
    """

    time_tolerance: float = 0.01
    buffer_seconds: float = 5.0
    counts: TimelineCounts = field(default_factory=TimelineCounts)
    segments: list[Segment] = field(default_factory=list)
    epoch: int = 0
    messages: list[str] = field(default_factory=list)
    _last: SampleBlock | None = None
    _suspect: SampleBlock | None = None
    _odd: tuple[int, float] | None = None
    _clock: SampleClock | None = None
    _gap: tuple[int, int] = (0, 0)  # first index that is missing, and the next received one
    _ledger: SampleLedger = field(default_factory=SampleLedger)
    _lacking: list[int] = field(default_factory=list)  # channels that lacked samples before

    @property
    def layout(self) -> tuple[int, float] | None:
        """Return channels and sampling rate (Hz) of the run, None before the first block."""
        if self._last is None or self._clock is None:
            return None
        return self._last.samples.shape[0], self._clock.rate

    @property
    def end_time(self) -> float:
        """Time of the newest sample, minus infinity before the first."""
        last = self._last
        return self._clock.time_of(last.end_index - 1) if last and self._clock else -np.inf

    def add(self, block: SampleBlock) -> None:
        """Take a block; raises `SignalError` for one that cannot be used, which is counted."""
        try:
            changed = self._check(block)
        except SignalError:
            self.counts.blocks_rejected += 1
            if block.samples.ndim == 2:
                self._count_unused(block)
            raise
        suspect, self._suspect = self._suspect, None
        if suspect is not None:
            if not changed and self._follows(suspect, block):
                self._new_run(suspect)
            else:
                self._drop(suspect, 'are repeated or out of order')
        if self._last is None or changed:
            self._new_run(block)
        elif self._doubtful(block):
            self._suspect = block
        else:
            self._continue(block)

    def close(self) -> None:
        """End the stream: no block follows."""
        suspect, self._suspect = self._suspect, None
        if suspect is not None:
            self._drop(suspect, 'are repeated or out of order')
        self._close()

    def release(self, epoch: int, before: float) -> None:
        """Drop the samples before the time `before` (s) of `epoch`; count those not averaged."""
        for segment in self.segments:
            if segment.epoch < epoch:
                self.counts.samples_dropped += segment.trim(segment.end_index)
            elif segment.epoch == epoch and math.isfinite(before):
                self.counts.samples_dropped += segment.trim(
                    segment.index + math.floor(segment.position(before)))
        self._tidy()

    def take(self) -> list[tuple[int, SampleBlock]]:
        """Remove and return all samples, segment by segment, each with its epoch."""
        taken = [(item.epoch, SampleBlock(item.samples.T, item.start_time, item.clock.rate,
                                          item.index))
                 for item in self.segments if item.size]
        for item in self.segments:
            item.trim(item.end_index)
        self._tidy()
        return taken

    def epoch_near(self, time: float, earliest: int) -> int:
        """
        Return the epoch, from `earliest` on, whose samples are nearest to a time (s).

        Of two overlapping epochs it is the earlier one. It counts as longer by the overlap,
        because the last samples before a restart may be lost.
        """
        found, away, following = max(earliest, self.epoch), np.inf, np.inf
        for epoch in sorted({item.epoch for item in self.segments}, reverse=True):
            segments = [item for item in self.segments if item.epoch == epoch]
            begin = min(item.start_time for item in segments)
            end = max(item.end_time for item in segments)
            distance = max(begin - time, time - end - max(end - following, 0.0), 0.0)
            if epoch >= earliest and distance <= away:
                found, away = epoch, distance
            following = begin
        return found

    def around(self, epoch: int, time: float) -> list[Segment]:
        """Return the few segments before and behind a time (s) of an epoch, in their order."""
        place = bisect_right(self.segments, (epoch, time),
                             key=lambda item: (item.epoch, item.start_time))
        return self.segments[max(place - 2, 0):place + 2]

    def bound(self) -> None:
        """Drop and count the oldest samples beyond `buffer_seconds`."""
        if math.isinf(self.buffer_seconds):
            return
        held = sum(item.size for item in self.segments)
        for segment in self.segments:
            excess = held - round(self.buffer_seconds * segment.clock.rate)
            if excess <= 0:
                break
            held -= min(excess, segment.size)
            self.counts.samples_dropped += segment.trim(segment.index + excess)
        self._tidy()

    def _tidy(self) -> None:
        self.segments = [item for item in self.segments if item.size or not item.closed]

    # --- continuity ---

    def _check(self, block: SampleBlock) -> bool:
        """Whether the source changed its layout for good; raises `SignalError` on a bad block."""
        samples = block.samples
        if samples.ndim != 2 or samples.size == 0:
            raise SignalError(f'block of shape {samples.shape}: send channel x sample, at least '
                              'one of each')
        if not (math.isfinite(block.start_time) and math.isfinite(block.sample_rate)
                and block.sample_rate > 0.0):
            raise SignalError(f'block at {block.start_time} s with {block.sample_rate} Hz: send a '
                              'finite time and a positive rate')
        if why := unresolved_times(block.start_time, block.sample_rate):
            raise SignalError(why)
        layout = samples.shape[0], block.sample_rate
        if self.layout is None or _alike(self.layout, layout):
            self._odd = None
            return False
        # One block of another layout is a fault; a second one means that the source changed.
        if _alike(self._odd, layout):
            self._odd = None
            return True
        self._odd = layout
        raise SignalError(
            f'block of {layout[0]} channels at {layout[1]:.10g} Hz in a stream of '
            f'{self.layout[0]} at {self.layout[1]:.10g} Hz: send one layout or restart the source')

    def _follows(self, block: SampleBlock, following: SampleBlock) -> bool:
        late = following.start_time - block.start_time - block.samples.shape[1] / block.sample_rate
        return following.index == block.end_index and abs(late) <= self.time_tolerance

    def _doubtful(self, block: SampleBlock) -> bool:
        """Whether only the next block can show if this one belongs to the run."""
        assert self._last is not None
        assert self._clock is not None
        last = self._last
        if block.index < last.index and block.start_time < last.start_time:
            return True
        deviation = block.start_time - self._clock.time_of(block.index)
        if abs(deviation) > self.time_tolerance:
            self.counts.clock_deviation += 1
            self.messages.append(
                f'time of sample {block.index} differs by {deviation:+.6g} s from the clock of '
                f'the run (limit {self.time_tolerance:g} s): ' + (
                    'a new run begins if the next block continues it' if block.start_time !=
                    last.start_time else 'stamps stand still, send the time of each block'))
            return True
        # Other samples with the same indices are those of a source that restarted.
        start, end = max(block.index, last.index), min(block.end_index, last.end_index)
        return start < end and not np.array_equal(
            block.samples[:, start - block.index:end - block.index],
            last.samples[:, start - last.index:end - last.index], equal_nan=True)

    def _drop(self, block: SampleBlock, why: str) -> None:
        self.counts.repeats += 1
        self._count_unused(block)
        self.messages.append(f'samples {block.index} to {block.end_index - 1} {why}: dropped')

    def _count_unused(self, block: SampleBlock) -> None:
        self.counts.samples_dropped += self._ledger.drop((block.index, block.end_index))

    def _new_run(self, block: SampleBlock) -> None:
        self._close()
        if block.start_time <= self.end_time:
            self._forget_jump_ahead(block)
            self.epoch += 1
            self.counts.restarts += 1
            self.messages.append(f'source restarted at {block.start_time:.6f} s, sample '
                                 f'{block.index}')
        elif self.layout and not _alike(self.layout, (len(block.samples), block.sample_rate)):
            self.counts.gaps += 1
            self.messages.append(f'source continues at {block.start_time:.6f} s with '
                                 f'{len(block.samples)} channels at {block.sample_rate:.10g} Hz')
        self._clock = SampleClock(block.start_time, block.index, block.sample_rate)
        self._gap, self._ledger = (0, 0), SampleLedger()
        self._store(block.samples, block.index)
        self._last = block

    def _forget_jump_ahead(self, block: SampleBlock) -> None:
        """Drop samples beyond a gap of the index that was wrong: a block in the gap shows it."""
        first, end = self._gap
        if self._clock is not None and first <= block.index < end and abs(
                block.start_time - self._clock.time_of(block.index)) <= self.time_tolerance:
            for item in self.segments:
                if item.clock is self._clock and item.index >= end:
                    self.counts.samples_dropped += item.trim(item.end_index)
            self._tidy()

    def _continue(self, block: SampleBlock) -> None:
        assert self._last is not None
        assert self._clock is not None
        expected = self._last.end_index
        deviation = block.start_time - self._clock.time_of(block.index)
        if abs(deviation) * block.sample_rate > 0.5:
            self.counts.clock_deviation += 1
        if block.end_index <= expected:
            self._drop(block, 'were received before')
            return
        if block.index > expected:
            self.counts.gaps += 1
            self._gap = expected, block.index
            self.counts.samples_lost += self._ledger.lose(self._gap)
            self.messages.append(f'samples {expected} to {block.index - 1} are missing')
            self._close()
        # Of a block that overlaps the samples before, only the new part is added.
        start = max(expected, block.index)
        self._store(block.samples[:, start - block.index:], start)
        self._last = block

    def _close(self) -> None:
        if self.segments:
            self.segments[-1].closed = True

    def _store(self, samples: FloatArray, index: int) -> None:
        """Keep the samples that at least one channel has; others are a gap."""
        assert self._clock is not None
        if self._open(index, len(samples)).append(samples):
            self._lacking = []
            return
        every = np.isfinite(samples)
        some = every.any(axis=0)
        self.counts.non_finite += int(np.count_nonzero(~every.all(axis=0)))
        bad = int(np.count_nonzero(~some))
        self.counts.samples_dropped += bad
        if bad:
            first = index + int(some.argmin())
            self.messages.append(f'{bad} samples from index {first} on are NaN or infinite in all '
                                 'channels: their cycles are discarded')
        lacking = some & ~every
        self._name_channels(np.flatnonzero(lacking.any(axis=1)).tolist(),
                            index + int(lacking.any(axis=0).argmax()))
        kept = np.where(every, samples, np.nan)
        spans = finite_spans(samples)
        if not spans or spans[0][0] > 0:
            self._close()
        for begin, end in spans:
            segment = self._open(index + begin, len(samples))
            segment.append(kept[:, begin:end], gaps=True)
            segment.lacks_channels |= bool(self._lacking)
            if end < samples.shape[1]:
                self._close()
        self._tidy()

    def _name_channels(self, channels: list[int], index: int) -> None:
        """Say which channels lack samples, when they begin to."""
        if set(channels) - set(self._lacking):
            self.messages.append(f'samples from index {index} on are NaN or infinite in channels '
                                 f'{channels}: they have no average there')
        self._lacking = channels

    def _open(self, index: int, channels: int) -> Segment:
        """Return the segment that a sample continues, a new one behind a gap."""
        assert self._clock is not None
        if not self.segments or self.segments[-1].closed:
            self.segments.append(Segment(self._clock, self.epoch, index, channels))
        return self.segments[-1]
