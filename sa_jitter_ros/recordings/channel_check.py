# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Channels that hold no vibration: NaN, constant, or at the end of their range."""

from collections.abc import Collection, Mapping

import numpy as np
from sa_jitter_ros.arrays import BoolArray, FloatArray
from sa_jitter_ros.errors import RecordingError
from sa_jitter_ros.recordings.channel_map import with_channels
from sa_jitter_ros.recordings.limits import LEAST_RANGE
from sa_jitter_ros.recordings.recording import Recording

_MOST_LOST = 0.5  # of the samples
_AT_END = 0.02  # of the samples, at the very same largest or smallest value
_FEWEST = 16
_SYMMETRIC = 1e-3  # of a range: middle of one that is symmetric, but for a code of a converter
# Samples after a first one that repeat its value if a channel is stuck; of its smallest change,
# what its samples change by at least where a contact, and not a coarse converter, makes them.
_STUCK, _COARSE = 32, 8.0
_FIRST_VALUES = 4_000_000  # of a recording, in which its channels are judged


def bad_channels(samples: FloatArray, *, most_lost: float = _MOST_LOST) -> dict[int, str]:
    """
    Return the channels of samples (channel, sample) that hold no vibration, with the reason.

    A share of `most_lost` of their samples may be NaN or infinite.

    >>> time = np.arange(1000)
    >>> bad_channels(np.array([np.sin(0.1 * time), 0.0 * time, np.clip(np.sin(time), -0.5, 0.5)]))
    {1: 'is constant at 0', 2: 'is saturated in 66% of its samples'}
    """
    found: dict[int, str] = {}
    for channel, values in enumerate(samples):
        held = stuck(values)
        finite = values[np.isfinite(values) & ~held]
        if finite.size < (1.0 - most_lost) * values.size:
            share = 1.0 - finite.size / values.size
            none = 'NaN, infinite or stuck at one value' if held.any() else 'NaN or infinite'
            found[channel] = f'is {none} in {100.0 * share:.3g}% of its samples'
        elif finite.size < _FEWEST:
            continue
        elif np.ptp(finite) < LEAST_RANGE:
            found[channel] = f'is constant at {finite[0]:.6g}'
        else:
            low, high = finite.min(), finite.max()
            top, bottom = float(np.mean(finite == high)), float(np.mean(finite == low))
            # A switch has two values, a saturated signal has others between its ends, which are
            # reached alike, or are those of a symmetric range.
            alike = 0.25 * _AT_END if abs(low + high) > _SYMMETRIC * (high - low) else (
                1.0 / finite.size)
            if top + bottom > _AT_END and min(top, bottom) > alike and (
                    np.unique(finite[:4096]).size > 8):
                found[channel] = f'is saturated in {top + bottom:.0%} of its samples'
    return found


def stuck(values: FloatArray) -> BoolArray:
    """
    Return which samples (sample,) of a channel repeat one value, as a loose contact makes them.

    Those at the ends of the range are saturated, not stuck. A signal of few values, or one that is
    stuck for most of its time, has none.

    >>> values = np.sin(0.7 * np.arange(200.0))
    >>> values[50:90] = 0.0
    >>> np.flatnonzero(stuck(values))[[0, -1]]
    array([50, 89])
    """
    found = np.zeros(values.size, np.bool_)
    with np.errstate(invalid='ignore'):  # of infinities
        change = np.abs(np.diff(values))
    ends = np.flatnonzero(np.append(change, 1.0) != 0.0)  # last samples of runs; NaN is none
    long = np.flatnonzero(np.diff(ends, prepend=-1) > _STUCK)
    moves = change[change > 0.0] if long.size else np.zeros(0)
    if moves.size < _FEWEST or np.median(moves) < _COARSE * moves.min():
        return found
    low, high = np.nanmin(values), np.nanmax(values)
    for run in long.tolist():
        begin = int(ends[run - 1]) + 1 if run else 0
        if low < values[begin] < high:
            found[begin:int(ends[run]) + 1] = True
    return found if np.mean(found) < _MOST_LOST else np.zeros(values.size, np.bool_)


def channel_faults(recording: Recording, *, most_lost: float = _MOST_LOST, copies: bool = False
                   ) -> dict[int, str]:
    """
    Return the bad channels of a recording with the reason, from its first samples.

    `most_lost` is that of `bad_channels`. With `copies` those that repeat an earlier one sample by
    sample are bad, too.

    >>> from sa_jitter_ros.recordings.recording import ArraySource
    >>> row = np.sin(np.arange(99.0))
    >>> channel_faults(Recording(ArraySource(np.array([row, 2.0 * row, row])), 1e3), copies=True)
    {2: 'holds the samples of channel 0 again'}
    """
    samples, found = _first_samples(recording), {}
    for channel in range(1, len(samples) if copies else 0):
        for other in range(channel):
            if channel not in found and np.array_equal(
                    samples[channel], samples[other], equal_nan=True):
                found[channel] = f'holds the samples of {recording.channel_names[other]} again'
    return found | bad_channels(samples, most_lost=most_lost)


def is_copy(one: Recording, other: Recording) -> bool:
    """Return whether two recordings hold the same first samples and the same pulse times."""
    first, second = (np.zeros(0) if item.pulse_times is None else item.pulse_times
                     for item in (one, other))
    return np.array_equal(first, second) and np.array_equal(
        _first_samples(one), _first_samples(other), equal_nan=True)


def _first_samples(recording: Recording) -> FloatArray:
    """Return the samples (channel, sample) by which channels are judged, none up to a defect."""
    count = min(recording.samples, max(_FIRST_VALUES // recording.channels, 1))
    try:
        return next(recording.blocks(count))
    except RecordingError:  # it is told to who reads up to the defect
        return np.zeros((0, 0))


def without_channels(recording: Recording, bad: Collection[int]) -> Recording:
    """Return a recording without some channels, the recording itself if none would be left."""
    rows = [row for row in range(recording.channels) if row not in bad]
    return with_channels(recording, rows) if rows else recording


def is_lost(reason: str) -> bool:
    """Return whether a bad channel holds nothing at all; a saturated one still holds something."""
    return not reason.startswith('is saturated')


def usable_channels(recording: Recording) -> tuple[Recording, tuple[str, ...]]:
    """
    Return a recording without its channels that hold nothing, and a sentence for each bad one.

    >>> from sa_jitter_ros.recordings.recording import ArraySource
    >>> rng = np.random.default_rng(1)
    >>> rig = Recording(ArraySource(np.array([rng.normal(size=900), np.zeros(900)])), 1e3)
    >>> rig, remarks = usable_channels(rig)
    >>> rig.channel_names, remarks
    (('channel 0',), ('channel 1 is constant at 0 and is left out: check its sensor and cable',))
    """
    faults = channel_faults(recording)
    lost = {channel for channel, reason in faults.items() if is_lost(reason)}
    return without_channels(recording, lost), fault_texts(recording, faults)


def fault_texts(recording: Recording, faults: Mapping[int, str]) -> tuple[str, ...]:
    """Return a sentence for each bad channel of a recording, with what to do about it."""
    return tuple(f'{recording.channel_names[channel]} '
                 + with_advice(reason, lost=' and is left out')
                 for channel, reason in faults.items())


def with_advice(reason: str, *, lost: str = '') -> str:
    """Return why a channel is bad and what to do; `lost` is what becomes of one without any."""
    return reason + (f'{lost}: check its sensor and cable' if is_lost(reason) else
                     ': lower its gain, or choose a larger range')
