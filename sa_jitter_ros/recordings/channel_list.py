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
Recordings in files that hold a list of channels, each with its own name, unit, rate and start.

Formats of measuring systems are such lists (`list_formats`).
"""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.errors import RecordingError
from sa_jitter_ros.recordings.channel_map import ChannelMap
from sa_jitter_ros.recordings.fields import MOST_NAMED, some_of
from sa_jitter_ros.recordings.recording import Recording, recording_errors, SampleSource

Opened = Callable[[], AbstractContextManager[Any]]

_SAME_START = 0.01  # of a sample
_ROUNDED = 1e-4  # relative, of a rate in a file
_UNEVEN = 0.5  # of a sample, by which times may be off a constant rate


@dataclass(frozen=True)
class Channel:
    """
    One channel of a file.

    `names` are what it may be called, the shortest first; `rate` is in Hz, None where the file
    does not say; `start` in s; `read` returns the samples of the open
    file from one index to another.
    """

    names: tuple[str, ...]
    unit: str
    rate: float | None
    start: float
    samples: int
    read: Callable[[Any, int, int], FloatArray]


#: Channels of a file, why others are none, one sentence each, and what opens it.
ChannelList = tuple[Sequence[Channel], Sequence[str], Opened]


def source_of(path: Path, parts: Sequence[Channel], opened: Opened) -> SampleSource:
    """Return the samples of channels that were sampled together; `opened` opens their file."""
    return SampleSource(len(parts), parts[0].samples, partial(_parts_of, path, parts, opened))


def _parts_of(path: Path, parts: Sequence[Channel], opened: Opened, samples_per_block: int
              ) -> Iterator[FloatArray]:
    """Iterate over `channel` x `sample` blocks, with the file open all the time."""
    samples = parts[0].samples
    with recording_errors(path), opened() as file:
        for start in range(0, samples, samples_per_block):
            stop = min(start + samples_per_block, samples)
            rows = [np.asarray(part.read(file, start, stop), np.float64) for part in parts]
            if any(row.shape != (stop - start,) for row in rows):
                raise RecordingError(f'samples {start} to {stop} cannot be read: the file is '
                                     'truncated or broken; copy it again')
            yield np.stack(rows)


def recording_of(path: Path, listed: ChannelList, *, channel_map: ChannelMap,
                 sample_rate: float | None) -> Recording:
    """
    Return the recording of some channels of a file, in the roles that the map gives them.

    Without names of vibration it is all channels of one rate, start and length, those that hold
    the most samples. The tach may have a rate of its own. `sample_rate` is used for channels
    without one, and in place of one that is rounded.

    >>> acc, key = (Channel((name,), 'g', rate, 0.0, int(rate), lambda file, start, stop:
    ...             np.zeros(stop - start)) for name, rate in (('acc', 100.0), ('key', 500.0)))
    >>> from contextlib import nullcontext
    >>> recording_of(Path(), ([acc, key], (), nullcontext), channel_map=ChannelMap(tach='key'),
    ...              sample_rate=None)
    Recording('.', 1 channel of 100 samples at 100 Hz (1 s), tach at 500 Hz, ratio 1)
    """
    every, left_out, opened = listed
    channels = [channel for channel in every if channel.samples]
    names = _unique([channel.names for channel in channels])
    if not channels:
        raise RecordingError('; '.join(['no channel with samples at a constant rate',
                                        *left_out[:MOST_NAMED]]))
    try:
        chosen, tach = channel_map.roles(names)
    except RecordingError as error:
        raise RecordingError('; '.join([str(error), *left_out[:MOST_NAMED]])) from None
    remarks = list(left_out)
    if not channel_map.vibration:
        together = Counter(_clock(channels[k]) for k in chosen)
        most = max(together, key=lambda clock: together[clock] * clock[2])
        others = [names[k] for k in chosen if _clock(channels[k]) != most]
        chosen = tuple(k for k in chosen if _clock(channels[k]) == most)
        if others:
            remarks.append('left out, because they were not sampled with '
                           f'{names[chosen[0]]}: {some_of(others)}')
    if len({_clock(channels[k]) for k in chosen}) > 1:
        raise RecordingError('channels of different rates, starts or lengths: ' + some_of([
            f'{names[k]} {channels[k].samples} samples at {channels[k].rate or 0.0:g} Hz'
            for k in chosen]) + '; choose those that were sampled together')
    first = channels[chosen[0]]
    rate = sample_rate or first.rate
    if first.rate and rate and abs(rate / first.rate - 1.0) > _ROUNDED:
        raise RecordingError(f'sample_rate {rate:.10g} Hz given, but the file says '
                             f'{first.rate:.10g} Hz: leave it out')
    if rate is None:
        raise RecordingError(f'{names[chosen[0]]} has no sampling rate in the file: give '
                             'sample_rate')
    tach_source, tach_rate = None, None
    if tach is not None:
        stated = channels[tach].rate
        tach_rate = rate if stated is None or stated == first.rate else stated
        if abs(channels[tach].start - first.start) * tach_rate > _SAME_START:
            raise RecordingError(
                f'{names[tach]} begins at {channels[tach].start:.9g} s and {names[chosen[0]]} at '
                f'{first.start:.9g} s: export channels that begin together')
        tach_source = source_of(path, [channels[tach]], opened)
    return Recording(
        source_of(path, [channels[k] for k in chosen], opened), rate,
        start_time=first.start, channel_names=tuple(names[k] for k in chosen),
        units=tuple(channels[k].unit for k in chosen), tach=tach_source, tach_rate=tach_rate,
        remarks=tuple(remarks), path=str(path))


def constant_rate(times: FloatArray) -> tuple[float, float] | None:
    """
    Return rate (Hz) and start (s) of sample times, None if they are at no constant rate.

    >>> constant_rate(np.array([1.0, 1.1, 1.2, 1.3]))
    (10.0, 1.0)
    >>> constant_rate(np.array([1.0, 1.1, 1.6, 1.7])) is None
    True
    """
    if times.size < 2 or not np.isfinite(times).all() or not times[-1] > times[0]:
        return None
    rate = (times.size - 1) / float(times[-1] - times[0])
    off = np.abs((times - times[0]) * rate - np.arange(times.size))
    return (float(f'{rate:.12g}'), float(times[0])) if float(off.max()) < _UNEVEN else None


def _clock(channel: Channel) -> tuple[float | None, float, int]:
    return channel.rate, channel.start, channel.samples


def _unique(names: Sequence[tuple[str, ...]]) -> list[str]:
    """Return for each channel the first of its names that no other one bears, else its number."""
    counts = Counter(name for several in names for name in dict.fromkeys(several))
    return [next((name for name in several if name and counts[name] == 1), str(number))
            for number, several in enumerate(names)]
