# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""A recording: a description of the machine, and samples that are read block by block."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
import math
from pathlib import Path
import tempfile
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray
from sa_jitter_ros.arrays import Array, FloatArray
from sa_jitter_ros.errors import quoted, RecordingError
from sa_jitter_ros.parameters import unwrapped
from sa_jitter_ros.pulses.detection import KeyphasorDetector, pulses_in_blocks
from sa_jitter_ros.samples import (
    check_rate, check_samples, check_times, SampleBlock, unresolved_times)

_MAX_CHANNELS = 4096
_LONGEST = 500  # characters of an error that may quote a recording
_KILO = 500.0, 2000.0  # times as long: a rate in kHz instead of Hz
MAX_PULSES = 50_000_000


@dataclass(eq=False)
class SampleSource:
    """
    Samples of one or more `channels` that can be read again and again, block by block.

    `blocks` iterates over them, `channel` x `sample`: all blocks but the last have the number of
    samples that it is called with. `samples` is the number of all of a channel. To be sent to
    another process, `blocks` is a function of a module, or part of one.
    """

    channels: int
    samples: int
    blocks: Callable[[int], Iterator[FloatArray]]


class ArraySource(SampleSource):
    """Samples of an array or a memory map (`channel` x `sample`, any real dtype)."""

    def __init__(self, array: Array) -> None:
        self.array = array
        super().__init__(int(array.shape[0]), int(array.shape[1]), partial(_parts_of, array))


def _parts_of(array: Array, samples_per_block: int) -> Iterator[FloatArray]:
    for start in range(0, array.shape[1], samples_per_block):
        yield np.array(array[:, start:start + samples_per_block], dtype=np.float64)


def changed(source: SampleSource, channels: int, change: Callable[[FloatArray], FloatArray]
            ) -> SampleSource:
    """Return another source, each of whose blocks is changed: into one of so many `channels`."""
    return SampleSource(channels, source.samples, partial(_changed_parts, source, change))


def _changed_parts(source: SampleSource, change: Callable[[FloatArray], FloatArray],
                   samples_per_block: int) -> Iterator[FloatArray]:
    return map(change, source.blocks(samples_per_block))


def mapped(pieces: Iterable[bytes], dtype: DTypeLike) -> NDArray[Any]:
    """Return an array (n,) of the bytes of all pieces, mapped from an unnamed temporary file."""
    with tempfile.TemporaryFile() as spool:
        spool.writelines(pieces)
        spool.flush()
        return np.memmap(spool, dtype, 'r')


@dataclass(frozen=True, eq=False)
class Recording:
    """
    One recording of a machine: vibration, its keyphasor and what is known about both.

    Sample k of the vibration (and of the tach waveform) was taken at `start_time` + k/rate; pulse
    times are seconds on the same clock. NaN samples are a gap in the data.

    Parameters
    ----------
    vibration
        The samples, `channel` x `sample`, read with `blocks`.
    sample_rate
        Of the vibration, Hz.
    channel_names
        One per channel; `channel 0`, ... where the file has none.
    units
        One per channel, '' where unknown; a single unit counts for all channels.
    start_time
        Of the first sample, s.
    pulse_times
        Keyphasor pulses, s, in order of time.
    tach
        The sampled keyphasor waveform (one channel), read with `tach_blocks`.
    tach_rate
        Sampling rate of the keyphasor, Hz; with `pulse_times` the rate of the clock that timed
        them, if known.
    pulses_per_revolution
        Of the tach shaft.
    pulses_per_trigger
        Pulses of a trigger cycle; None where the file does not say.
    missing_teeth
        Of the target; `pulses_per_revolution` counts them, too.
    target_angles
        How late each mark of the target is, rad, those of missing teeth left out; empty for even
        marks.
    ratio
        Speed of the shaft of interest over the speed of the tach shaft.
    orders
        Orders of interest, multiples of the shaft of interest.
    reference_pulse_times
        Of a better keyphasor, s.
    description
        Free text.
    acquisitions
        Number of separate acquisitions in the file (this is one of them).
    remarks
        How the reader repaired the data, one sentence each.
    path
        File or folder that error messages name; '' for a recording without a file.

    Raises
    ------
    RecordingError
        If rates, counts or times contradict each other, or are beyond `limits`.

    Examples
    --------
    >>> import numpy as np
    >>> recording = Recording(ArraySource(np.zeros((2, 5000))), sample_rate=1e3,
    ...                       pulse_times=np.arange(0.0, 5.0, 0.04), ratio=2.5)
    >>> recording
    Recording(2 channels of 5000 samples at 1000 Hz (5 s), 125 pulse_times, ratio 2.5)
    >>> recording.channel_names, recording.duration
    (('channel 0', 'channel 1'), 5.0)
    >>> [block.shape for block in recording.blocks(2000)]
    [(2, 2000), (2, 2000), (2, 1000)]
    >>> recording.keyphasor_pulses(duration=0.1)
    array([0.  , 0.04, 0.08])

    """

    vibration: SampleSource
    sample_rate: float
    channel_names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    start_time: float = 0.0
    pulse_times: FloatArray | None = None
    tach: SampleSource | None = None
    tach_rate: float | None = None
    pulses_per_revolution: int = 1
    pulses_per_trigger: int | None = None
    missing_teeth: int = 0
    target_angles: tuple[float, ...] = ()
    ratio: float = 1.0
    orders: tuple[float, ...] = ()
    reference_pulse_times: FloatArray | None = None
    description: str = ''
    acquisitions: int = 1
    remarks: tuple[str, ...] = ()
    path: str = ''

    def __post_init__(self) -> None:
        """Check that the parts fit each other, and fill in names and units."""
        for name in ('sample_rate', 'start_time', 'tach_rate', 'pulses_per_revolution',
                     'pulses_per_trigger', 'missing_teeth', 'ratio'):
            object.__setattr__(self, name, unwrapped(getattr(self, name)))
        channels = self.vibration.channels
        if not 1 <= channels <= _MAX_CHANNELS or self.vibration.samples < 1:
            raise RecordingError(
                f'vibration of {channels} channels x {self.vibration.samples} samples: give 1 '
                f'to {_MAX_CHANNELS} channels and at least one sample')
        check_rate('sample_rate', self.sample_rate, RecordingError)
        _check_positive('ratio', self.ratio)
        if not math.isfinite(self.start_time):
            raise RecordingError(f'start_time {self.start_time}: must be a finite time in s')
        check_times('start_time', self.start_time, RecordingError)
        if why := unresolved_times(self.start_time, self.sample_rate):
            raise RecordingError(f'start_time: {why}')
        if self.tach is not None and self.tach_rate is None:
            raise RecordingError('a tach waveform without tach_rate: add its rate in Hz')
        if self.tach is not None and self.tach.channels != 1:
            raise RecordingError(f'tach of {self.tach.channels} channels: must be one waveform')
        if self.tach_rate is not None:
            check_rate('tach_rate', self.tach_rate, RecordingError)
        for name in ('pulses_per_revolution', 'pulses_per_trigger'):
            if (count := getattr(self, name)) is not None and count < 1:
                raise RecordingError(f'{name} {count}: must be at least 1')
        if not 0 <= self.missing_teeth < self.pulses_per_revolution:
            raise RecordingError(
                f'missing_teeth {self.missing_teeth}: must be from 0 to less than '
                f'pulses_per_revolution ({self.pulses_per_revolution}), which counts them, too')
        for order in self.orders:
            _check_positive('orders', order)
        for name in ('pulse_times', 'reference_pulse_times'):
            _check_pulse_times(name, getattr(self, name))
        names = self.channel_names or tuple(f'channel {k}' for k in range(channels))
        units = self.units if len(self.units) > 1 else (self.units or ('',)) * channels
        for name, labels in (('channel_names', names), ('units', units)):
            if len(labels) != channels:
                raise RecordingError(
                    f'{len(labels)} {name} for {channels} channels: give one per channel')
            object.__setattr__(self, name, labels)

    def __repr__(self) -> str:
        """Return one line: where it is from, what it holds."""
        parts = [repr(name) for name in (self.path or self.description,) if name]
        parts.append(f'{self.channels} channel{"s" * (self.channels > 1)} of {self.samples} '
                     f'samples at {self.sample_rate:g} Hz ({self.duration:.4g} s)')
        for name in ('pulse_times', 'reference_pulse_times'):
            if getattr(self, name) is not None:
                parts.append(f'{getattr(self, name).size} {name}')
        if self.tach is not None:
            parts.append(f'tach at {self.tach_rate:g} Hz')
        return f'Recording({", ".join([*parts, f"ratio {self.ratio:.6g}"])})'

    @property
    def channels(self) -> int:
        """Return the number of vibration channels."""
        return self.vibration.channels

    @property
    def samples(self) -> int:
        """Return the number of samples of each vibration channel."""
        return self.vibration.samples

    @property
    def duration(self) -> float:
        """Return the length of the vibration in s."""
        return self.samples / self.sample_rate

    @property
    def target(self) -> dict[str, Any]:
        """Return what is known of the target's marks, as options of `PulseValidator`."""
        return {'missing_teeth': self.missing_teeth, 'target_angles': self.target_angles,
                'target_geometry': 'given' if self.target_angles else 'none'}

    def blocks(self, samples_per_block: int = 65_536) -> Iterator[FloatArray]:
        """
        Iterate over the vibration with bounded memory.

        Each block is `channel` x `sample`; all but the last have `samples_per_block` samples.
        Raises RecordingError if the file is found to be broken.
        """
        return self._checked(self.vibration, samples_per_block)

    def tach_blocks(self, samples_per_block: int = 65_536) -> Iterator[FloatArray]:
        """Iterate over the tach waveform as `blocks` does (`1` x `sample`); empty without one."""
        return iter(()) if self.tach is None else self._checked(self.tach, samples_per_block)

    def read(self) -> FloatArray:
        """Read the whole vibration into memory, `channel` x `sample`."""
        return np.concatenate(list(self.blocks()), axis=1)

    def read_tach(self) -> FloatArray:
        """Read the whole tach waveform into memory, one-dimensional; empty without one."""
        blocks = [block[0] for block in self.tach_blocks()]
        return np.concatenate(blocks) if blocks else np.empty(0)

    def keyphasor_pulses(self, *, interpolate: bool = True, duration: float = math.inf,
                         detector: KeyphasorDetector | None = None) -> FloatArray:
        """
        Return the pulse times (s) of the keyphasor in the first `duration` seconds.

        They are `pulse_times`, else those found in the tach waveform (by a `detector`, or with
        `interpolate` as in `detect_pulses`), else `reference_pulse_times`. Raises RecordingError
        where there is none of these.
        """
        end = self.start_time + duration
        times = self.pulse_times
        if times is None and self.tach is None:
            times = self.reference_pulse_times
        if times is not None:
            return times if math.isinf(duration) else times[times <= end]
        if self.tach is None or self.tach_rate is None:
            raise RecordingError('no keyphasor: the recording has neither pulse_times nor a tach '
                                 'waveform; add one of them, or name the channel that is the '
                                 'waveform (tach_channel, --tach-channel)')
        if self.tach_in_khz:
            raise RecordingError(self.tach_in_khz)
        count = math.ceil(min(duration * self.tach_rate, self.tach.samples))
        return pulses_in_blocks(detector or KeyphasorDetector(interpolate=interpolate),
                                self._tach_samples(count, self.tach_rate))

    @property
    def tach_in_khz(self) -> str:
        """Say if the tach waveform is a thousand times as long as the vibration, '' if not."""
        if self.tach is None or not self.tach_rate:
            return ''
        length = self.tach.samples / self.tach_rate
        return '' if not _KILO[0] < length / self.duration < _KILO[1] else (
            f'the tach waveform spans {length:.6g} s, the vibration {self.duration:.6g} s: '
            f'tach_rate looks like kHz; give tach_rate={1e3 * self.tach_rate:.10g}')

    def _tach_samples(self, count: int, rate: float) -> Iterator[SampleBlock]:
        index = 0
        for block in self.tach_blocks():
            if index >= count:
                return
            start = self.start_time + index / rate
            yield SampleBlock(block[:, :count - index], start, rate, index)
            index += block.shape[1]

    def _checked(self, source: SampleSource, samples_per_block: int) -> Iterator[FloatArray]:
        if samples_per_block < 1:
            raise RecordingError(f'samples_per_block {samples_per_block}: must be at least 1')
        with recording_errors(self.path):
            for block in source.blocks(samples_per_block):
                check_samples(block, RecordingError)
                yield block


@contextmanager
def recording_errors(path: str | Path) -> Iterator[None]:
    """
    Turn any exception of a parser on a broken file into a RecordingError of one line.

    Parsers of zip, MATLAB, sqlite and MCAP files do not document which exceptions broken bytes
    cause, hence the broad clause.
    """
    place = f'{path}: ' if str(path) else ''
    try:
        yield
    except RecordingError as error:
        if str(error).startswith(place):
            raise
        raise RecordingError(f'{place}{quoted(error, _LONGEST)}') from error
    except Exception as error:
        reason = quoted(error, _LONGEST) or 'no reason given'
        raise RecordingError(
            f'{place}cannot be read ({type(error).__name__}: {reason})') from error


@contextmanager
def library(reads: str, name: str, extra: str, otherwise: str = '') -> Iterator[None]:
    """
    Raise RecordingError that says how to install a library if an import within it fails.

    `reads` is what it reads, `extra` the one of this package that installs it.

    >>> with library('bags are', 'rosbags', 'bags'):  # doctest: +ELLIPSIS
    ...     import no_such
    Traceback (most recent call last):
    ...
    sa_jitter_ros.errors.RecordingError: bags are read with rosbags, which is not installed: ...
    """
    try:
        yield
    except ImportError:
        raise RecordingError(f'{reads} read with {name}, which is not installed: pip install '
                             f"'sa_jitter_ros[{extra}]' or {name}{otherwise}") from None


def rechunk(pieces: Iterator[FloatArray], samples_per_block: int) -> Iterator[FloatArray]:
    """Cut `channel` x `sample` pieces of any length into blocks of one length."""
    held: list[FloatArray] = []
    count = 0
    for piece in pieces:
        held.append(piece)
        count += piece.shape[1]
        if count < samples_per_block:
            continue
        joined = np.concatenate(held, axis=1)
        whole = count - count % samples_per_block
        for start in range(0, whole, samples_per_block):
            yield joined[:, start:start + samples_per_block]
        held, count = [joined[:, whole:]], count - whole
    if count:
        yield np.concatenate(held, axis=1)


def _check_positive(name: str, value: float) -> None:
    if not (math.isfinite(value) and value > 0):
        raise RecordingError(f'{name} {value}: must be positive and finite')


def _check_pulse_times(name: str, times: FloatArray | None) -> None:
    if times is None:
        return
    if times.ndim != 1 or times.size > MAX_PULSES:
        raise RecordingError(
            f'{name} of shape {times.shape}: give one row of at most {MAX_PULSES} times')
    if not np.isfinite(times).all():
        raise RecordingError(f'{name}: contains NaN or infinity; remove those pulses')
    check_times(name, times, RecordingError)
    backwards = np.flatnonzero(np.diff(times) < 0)
    if backwards.size:
        k = int(backwards[0]) + 1
        raise RecordingError(
            f'{name}: time runs backwards at pulse {k} ({times[k - 1]} to {times[k]} s); sort '
            'them or split the recording')
