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
Blocks of consecutive samples, as recordings, messages and the averager exchange them.

Times, rates and samples beyond the limits do not occur on machines, and their squares, products
and periods would overflow.
"""

from dataclasses import dataclass
import math

import numpy as np
from sa_jitter_ros.arrays import Array, FloatArray
from sa_jitter_ros.errors import SaJitterError

_MIN_RATE, _MAX_RATE = 1e-12, 1e12  # Hz
_MAX_TIME = 1e15  # s, as 30 million years
_MAX_SAMPLE = 1e100  # sums of its squares are far below 1e308
_RESOLUTION = 1e-3  # of a sample: to what times must be known
_ABSOLUTE = 2.0**32  # s: the range of times since 1970, until 2106


def finite_spans(samples: FloatArray) -> list[tuple[int, int]]:
    """
    Return first and end index of each span of `samples` (channel, sample) that a channel has.

    >>> finite_spans(np.array([[0.0, np.nan, 2.0, 3.0], [0.0, np.nan, np.nan, 1.0]]))
    [(0, 1), (2, 4)]
    """
    every = np.isfinite(samples)
    if every.all():
        return [(0, samples.shape[1])] if samples.size else []
    finite = np.concatenate(([False], every.any(axis=0), [False])).astype(np.int8)
    return [(int(begin), int(end))
            for begin, end in np.flatnonzero(np.diff(finite)).reshape(-1, 2)]


def unresolved_times(time: float, sample_rate: float) -> str:
    """
    Say why a float64 cannot hold the times around `time` (s) of samples at a rate (Hz), or ''.

    It must resolve a thousandth of a sample. Times since 1970 are admitted at every rate: they are
    rounded to 0.24 us.

    >>> unresolved_times(1.8e9, 1e5)
    ''
    >>> unresolved_times(1e12, 1e4).partition(':')[0]
    'time 1e+12 s is so large that a float64 rounds it to 1.2 samples'
    """
    step = math.ulp(time) * sample_rate
    if abs(time) <= _ABSOLUTE or step <= _RESOLUTION:
        return ''
    return (f'time {time:.6g} s is so large that a float64 rounds it to {step:.2g} samples: give '
            'seconds since the start of the measurement')


def check_rate(name: str, rate: float, error: type[SaJitterError]) -> None:
    """Raise `error` for a rate (Hz) beyond the limits, and for NaN."""
    if not _MIN_RATE <= rate <= _MAX_RATE:
        raise error(f'{name} is {rate} Hz: must be from {_MIN_RATE:g} to {_MAX_RATE:g} Hz')


def check_times(name: str, times: float | FloatArray, error: type[SaJitterError]) -> None:
    """Raise `error` for finite times (s) beyond the limits."""
    values = np.atleast_1d(times)
    wrong = values[np.isfinite(values) & (np.abs(values) > _MAX_TIME)]
    if wrong.size:
        raise error(f'{name} is {wrong[0]} s: must be within {_MAX_TIME:g} s of 0; give seconds '
                    'since the start of the measurement or since 1970')


def check_samples(samples: Array, error: type[SaJitterError]) -> None:
    """Raise `error` for finite samples beyond the limit; NaN and infinity are a gap."""
    peak = max(float(samples.max(initial=0.0)), -float(samples.min(initial=0.0)))
    if peak <= _MAX_SAMPLE:
        return
    finite = samples[np.isfinite(samples)]  # NaN has no order
    largest = max(map(float, (finite.max(initial=0.0), finite.min(initial=0.0))), key=abs)
    if abs(largest) > _MAX_SAMPLE:
        raise error(f'sample of {largest}: must be within {_MAX_SAMPLE:g} of 0; check the '
                    'unit and the scale')


@dataclass(frozen=True)
class SampleBlock:
    """
    Consecutive samples of one source.

    `samples` (channel, sample); `start_time` of the first sample in s, `sample_rate` in Hz,
    `index` of the first sample, counted from block to block.

    >>> block = SampleBlock(np.array([[0.0, np.nan, 2.0, 3.0]]), 5.0, 100.0, 70)
    >>> [(part.index, part.start_time, part.samples.tolist()) for part in block.finite_parts()]
    [(70, 5.0, [[0.0]]), (72, 5.02, [[2.0, 3.0]])]
    """

    samples: FloatArray
    start_time: float
    sample_rate: float
    index: int

    @property
    def end_index(self) -> int:
        """Index of the sample after the last one."""
        return self.index + int(self.samples.shape[1])

    def finite_parts(self) -> 'tuple[SampleBlock, ...]':
        """
        Return the parts that at least one channel has; the index has a gap between them.

        The samples that other channels lack are NaN.
        """
        kept = np.where(np.isfinite(self.samples), self.samples, np.nan)
        return tuple(SampleBlock(
            kept[:, begin:end], self.start_time + begin / self.sample_rate,
            self.sample_rate, self.index + begin) for begin, end in finite_spans(kept))
