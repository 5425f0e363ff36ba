# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The fields of `.npz` and `.mat` recordings: from named arrays to a `Recording`."""

from collections.abc import Callable, Collection, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.errors import RecordingError
from sa_jitter_ros.pulses.detection import counter_pulses
from sa_jitter_ros.recordings.recording import ArraySource, FloatArray, MAX_PULSES, Recording

_MAX_SAMPLE_BYTES = 1 << 40
_MAX_PULSE_BYTES = 8 * MAX_PULSES
MAX_FIELD_BYTES = 1 << 20

RawArray = NDArray[Any]
SAMPLE_FIELDS = ('vibration', 'tach', 'tach_count')
_PULSE_FIELDS = ('pulse_times', 'reference_pulse_times')


def size_limit(name: str) -> int:
    """Return the largest size in bytes that the field `name` may have in a file."""
    if name in SAMPLE_FIELDS:
        return _MAX_SAMPLE_BYTES
    return _MAX_PULSE_BYTES if name in _PULSE_FIELDS else MAX_FIELD_BYTES


def recording_from_fields(names: Collection[str], load: Callable[[str], RawArray], *,
                          acquisition: int, given: Mapping[str, Any]) -> Recording:
    """
    Build a recording from named arrays.

    If `tach` has several rows, one for every row of `vibration`, each row is a separate
    acquisition, and `acquisition` selects one. `tach_count` is a revolution counter sampled at
    `tach_rate`; each increase by 1 is a pulse.

    Parameters
    ----------
    names
        The fields of the file; unknown ones are ignored.
    load
        Returns the array of a name.
    acquisition
        Number of the acquisition, from 0.
    given
        Values of `converted_fields` that replace those of the file.

    Raises
    ------
    RecordingError
        If a needed field is missing or one has the wrong type, shape or value.

    Examples
    --------
    >>> arrays = {'vibration': np.zeros((2, 1000)), 'tach_count': np.arange(1000) // 40}
    >>> recording = recording_from_fields(arrays, arrays.__getitem__, acquisition=0,
    ...                                   given={'sample_rate': 1e3, 'tach_rate': 1e3})
    >>> recording.channels, recording.pulse_times[:3]
    (2, array([0.04, 0.08, 0.12]))

    """
    if 'vibration' not in names:
        raise RecordingError(
            f'no vibration among the fields {sorted(names)}: add vibration, channel x sample')
    if 'sample_rate' not in {*names, *given}:
        raise RecordingError('no sample_rate: add the sampling rate of the vibration in Hz to the '
                             'file, or give sample_rate')
    vibration = _samples('vibration', load('vibration'))
    tach = _samples('tach', load('tach')) if 'tach' in names else None
    values = converted_fields({name: load(name) for name in CONVERTED
                               if name in names and name not in given})
    values.update(given)
    acquisitions = 1
    if tach is not None and len(tach) > 1:
        if len(tach) != len(vibration):
            raise RecordingError(
                f'tach of {len(tach)} rows for {len(vibration)} rows of vibration: a recording '
                'has one row of tach, or one for every row of vibration if each is an acquisition')
        acquisitions = len(tach)
    if not 0 <= acquisition < acquisitions:
        raise RecordingError(
            f'acquisition {acquisition}: the file has {acquisitions}, numbered from 0')
    if acquisitions > 1:
        row = slice(acquisition, acquisition + 1)
        vibration, tach = vibration[row], None if tach is None else tach[row]
        for name in ('channel_names', 'units'):
            if len(values.get(name, ())) > 1:
                values[name] = values[name][row]
    if 'tach_count' in names and tach is None and 'pulse_times' not in values:
        tach_rate = values.get('tach_rate')
        if tach_rate is None or not tach_rate > 0:
            raise RecordingError('tach_count without a positive tach_rate: add its rate in Hz')
        values['pulse_times'] = _counted_pulses(
            load('tach_count'), values.get('start_time', 0.0), tach_rate)
    return Recording(ArraySource(vibration), tach=None if tach is None else ArraySource(tach),
                     acquisitions=acquisitions, **values)


def converted_fields(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return fields of `CONVERTED` in the types of `Recording`; raises RecordingError."""
    return {name: CONVERTED[name](name, np.asarray(value)) for name, value in values.items()}


def _real(name: str, array: RawArray) -> RawArray:
    if array.dtype.kind not in 'fiub':
        raise RecordingError(f'{name} of type {array.dtype}: give real numbers')
    return array


def _samples(name: str, array: RawArray) -> RawArray:
    array = _real(name, array)
    if array.ndim == 1 or (array.ndim == 2 and array.shape[1] == 1):
        array = array.reshape(1, -1)
    if array.ndim != 2:
        raise RecordingError(f'{name} of shape {array.shape}: give channel x sample')
    if array.shape[0] > array.shape[1]:
        raise RecordingError(
            f'{name} of shape {array.shape}: more channels than samples; store channel x sample '
            '(transpose it)')
    return array


def _vector(name: str, array: RawArray) -> FloatArray:
    if array.size != max(array.shape, default=1):
        raise RecordingError(f'{name} of shape {array.shape}: give one row of numbers')
    return np.array(_real(name, array), dtype=np.float64).reshape(-1)


def _number(name: str, array: RawArray) -> float:
    if array.size != 1:
        raise RecordingError(f'{name} of shape {array.shape}: give a single number')
    return float(_real(name, array).reshape(-1)[0])


def _count(name: str, array: RawArray) -> int:
    value = _number(name, array)
    if not (value == np.floor(value) and 1 <= value < 2**31):
        raise RecordingError(f'{name} {value}: give a whole number, at least 1')
    return int(value)


def _strings(name: str, array: RawArray) -> tuple[str, ...]:
    if array.dtype.kind == 'S':
        array = np.char.decode(array, 'utf-8', 'replace')
    if array.dtype.kind != 'U':
        raise RecordingError(f'{name} of type {array.dtype}: give text')
    return tuple(item.strip() for item in array.reshape(-1).tolist())


def _counted_pulses(counter: RawArray, start_time: float, rate: float) -> FloatArray:
    """Return the pulse times (s) of a revolution counter; a decrease is a reset."""
    values = _samples('tach_count', counter)
    if len(values) != 1:
        raise RecordingError(f'tach_count of shape {counter.shape}: give one row')
    counts = values[0].astype(np.float64)
    if not np.all((counts == np.floor(counts)) & (abs(counts) < 2.0**53)):
        raise RecordingError('tach_count contains fractions, NaN or values above 2^53: give '
                             'counts')
    rises = np.maximum(np.diff(counts), 0.0)
    if rises.sum() > MAX_PULSES:
        raise RecordingError(f'tach_count counts {rises.sum():.0f} pulses: at most {MAX_PULSES} '
                             'are read; split the recording')
    return counter_pulses(np.append(0.0, np.cumsum(rises)).astype(np.int64),
                          start_time=start_time, sample_rate=rate)


# The fields that are not samples, each with its conversion from an array.
CONVERTED: Mapping[str, Callable[[str, RawArray], Any]] = {
    'sample_rate': _number, 'tach_rate': _number, 'start_time': _number, 'ratio': _number,
    'pulses_per_revolution': _count, 'pulses_per_trigger': _count,
    'pulse_times': _vector, 'reference_pulse_times': _vector,
    'orders': lambda name, array: tuple(_vector(name, array).tolist()),
    'channel_names': _strings, 'units': _strings,
    'description': lambda name, array: ' '.join(_strings(name, array))}
FIELDS = (*SAMPLE_FIELDS, *CONVERTED)
