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
The fields of recordings: their names and types, and from named arrays to a `Recording`.

A field is given as a value, or as a text. The text is the key under which a `.npz` or `.mat` has
the field, if it has one of that name, else numbers with commas between them, or a text.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from sa_jitter_ros.arrays import Array, FloatArray
from sa_jitter_ros.errors import ParameterError, RecordingError, SignalError
from sa_jitter_ros.pulses.sampled_angle import counter_pulses
from sa_jitter_ros.recordings.recording import ArraySource, MAX_PULSES, Recording

_MAX_SAMPLE_BYTES = 1 << 40
_MAX_PULSE_BYTES = 8 * MAX_PULSES
MAX_FIELD_BYTES = 1 << 20

#: Returns the array under a key of a file, of at most so many bytes.
Load = Callable[[str, int], Array]
#: The names of the arrays of a file, and what loads one.
Arrays = tuple[Collection[str], Load]
SAMPLE_FIELDS = ('vibration', 'tach', 'tach_count')
_PULSE_FIELDS = ('pulse_times', 'reference_pulse_times')
_TEXT_FIELDS = ('channel_names', 'units', 'description')
MOST_NAMED = 12  # keys of a file, or channels, in a message


def size_limit(name: str) -> int:
    """Return the largest size in bytes that the field `name` may have in a file."""
    if name in SAMPLE_FIELDS:
        return _MAX_SAMPLE_BYTES
    return _MAX_PULSE_BYTES if name in _PULSE_FIELDS else MAX_FIELD_BYTES


def fields_of(texts: Iterable[str]) -> dict[str, str]:
    """
    Return the fields that texts `NAME=KEY` or `NAME=VALUE` give; raises ParameterError.

    >>> fields_of(['pulse_times=tach', 'orders=20,40'])
    {'pulse_times': 'tach', 'orders': '20,40'}
    """
    found = {}
    for text in texts:
        name, equals, value = (part.strip() for part in text.partition('='))
        if not (name and equals and value):
            raise ParameterError(f'field {text!r}: give NAME=KEY or NAME=VALUE, as in '
                                 'pulse_times=tach or sample_rate=97656')
        found[name] = value
    require_fields(found)
    return found


def require_fields(fields: Mapping[str, Any]) -> None:
    """Raise ParameterError for names that no field has, and for samples given as values."""
    unknown = sorted(name for name, value in fields.items() if name not in FIELDS or (
        name in SAMPLE_FIELDS and value is not None and not isinstance(value, str)))
    if unknown:
        raise ParameterError(f'a recording has no field {", ".join(unknown)}: give some of '
                             f'{", ".join(CONVERTED)}; {", ".join(SAMPLE_FIELDS)} by the key that '
                             'the file has for them')


def given_fields(fields: Mapping[str, Any], keys: Collection[str] = ()
                 ) -> tuple[dict[str, Any], dict[str, tuple[str, ...]]]:
    """
    Return the values that `fields` give, in the types of `Recording`, and the keys that they name.

    `keys` are those of the file. Samples are given by key only: `vibration` by one, or by several
    with commas between them. Raises RecordingError for a text that is neither a key nor a value.

    >>> given_fields({'vibration': 'de,fe', 'ratio': '2.5'}, ('de', 'fe', 'rpm'))
    ({'ratio': 2.5}, {'vibration': ('de', 'fe')})
    """
    values: dict[str, Any] = {}
    sources: dict[str, tuple[str, ...]] = {}
    for name, value in fields.items():
        if isinstance(value, str) and value in keys:
            sources[name] = (value,)
        elif name in SAMPLE_FIELDS:
            named = _listed(value)
            if not named or not set(named) <= set(keys):
                raise RecordingError(f'{name}={value!s:.40}: the file has no such key; it has '
                                     f'{shown_keys(keys)}')
            sources[name] = tuple(named)
        elif isinstance(value, str) and name not in _TEXT_FIELDS:
            values[name] = _numbers(name, value, keys)
        elif isinstance(value, str) and name != 'description':
            values[name] = _listed(value)
        else:
            values[name] = value
    return converted_fields(values), sources


def shown_keys(keys: Collection[str]) -> str:
    """Return the keys of a file as a short text."""
    return some_of(sorted(keys)) or 'none'


def some_of(texts: Sequence[str]) -> str:
    """Return the first texts in one."""
    return ', '.join(texts[:MOST_NAMED]) + (', ...' if len(texts) > MOST_NAMED else '')


def recording_from_fields(arrays: Arrays, *, acquisition: int, given: Mapping[str, Any],
                          pulses_suffice: bool = False) -> Recording:
    """
    Build a recording from named arrays.

    If `tach` has several rows, one for every row of `vibration`, each row is a separate
    acquisition, and `acquisition` selects one. `tach_count` is a counter sampled at
    `tach_rate`, of `pulses_per_revolution` counts a turn; each count, up or down, is a pulse.

    Parameters
    ----------
    arrays
        The names of the fields of the file, of which unknown ones are ignored, and what returns
        the array under a name, of at most so many bytes.
    acquisition
        Number of the acquisition, from 0.
    given
        Values that replace those of the file, and texts that name other keys: `given_fields`.
    pulses_suffice
        A file without vibration is read as one whose vibration is a single NaN.

    Raises
    ------
    RecordingError
        If a needed field is missing or one has the wrong type, shape or value.

    Examples
    --------
    >>> arrays = {'vibration': np.zeros((2, 1000)), 'tach_count': np.arange(1000) // 40}
    >>> recording = recording_from_fields(
    ...     (arrays, lambda name, limit: arrays[name]), acquisition=0,
    ...     given={'sample_rate': 1e3, 'tach_rate': 1e3})
    >>> recording.channels, recording.pulse_times[:3]
    (2, array([0.04, 0.08, 0.12]))

    """
    names, load = arrays
    values, sources = given_fields(given, names)
    taken = {key for several in sources.values() for key in several}
    keys = {**{name: (name,) for name in FIELDS
               if name in names and name not in values and name not in taken}, **sources}
    remarks: list[str] = []
    if 'vibration' in keys:
        vibration = _stacked(keys['vibration'], load, remarks, mapped='vibration' in sources)
        if len(keys['vibration']) > 1 and 'channel_names' not in sources:
            values.setdefault('channel_names', keys['vibration'])
    elif pulses_suffice:
        vibration = np.full((1, 1), np.nan)
        values.setdefault('sample_rate', 1.0)
    else:
        raise RecordingError(
            f'no vibration among the fields {shown_keys(names)}: add vibration, channel x sample, '
            'or name its key: vibration=KEY')
    tach = (_stacked(keys['tach'], load, remarks, mapped='tach' in sources)
            if 'tach' in keys else None)
    values.update(converted_fields({
        name: load(keys[name][0], size_limit(name)) for name in CONVERTED
        if name in keys and name not in values}))
    if 'sample_rate' not in values:
        raise RecordingError('no sample_rate: add the sampling rate of the vibration in Hz to the '
                             'file, or give sample_rate')
    if ('tach' in sources and tach is not None and 'tach_rate' not in values
            and tach.shape[-1] == vibration.shape[-1]):
        values['tach_rate'] = values['sample_rate']
        remarks.append('the tach waveform has no tach_rate and as many samples as the vibration: '
                       'it is taken as sampled with it')
    acquisitions = 1 if tach is None else len(tach)
    if tach is not None and acquisitions > 1:
        if acquisitions != len(vibration):
            raise RecordingError(
                f'tach of {len(tach)} rows for {len(vibration)} rows of vibration: a recording '
                'has one row of tach, or one for every row of vibration if each is an acquisition')
        first = acquisition % acquisitions  # `read` refuses those that there are not
        row = slice(first, first + 1)
        vibration, tach = vibration[row], tach[row]
        for name in ('channel_names', 'units'):
            if len(values.get(name, ())) > 1:
                values[name] = values[name][row]
    if 'tach_count' in keys and tach is None and 'pulse_times' not in values:
        tach_rate = values.get('tach_rate')
        if tach_rate is None or not tach_rate > 0:
            raise RecordingError('tach_count without a positive tach_rate: add its rate in Hz')
        values['pulse_times'] = _counted_pulses(
            load(keys['tach_count'][0], size_limit('tach_count')),
            values.get('start_time', 0.0), tach_rate, values.get('pulses_per_revolution', 1),
            remarks)
    return Recording(ArraySource(vibration), tach=None if tach is None else ArraySource(tach),
                     acquisitions=acquisitions, remarks=tuple(remarks), **values)


def converted_fields(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return fields of `CONVERTED` in the types of `Recording`; raises RecordingError."""
    return {name: CONVERTED[name](name, np.asarray(value)) for name, value in values.items()}


def _real(name: str, array: Array) -> Array:
    if array.dtype.kind not in 'fiub':
        raise RecordingError(f'{name} of type {array.dtype}: give real numbers')
    return array


def _listed(text: str) -> list[str]:
    return [part.strip() for part in text.split(',') if part.strip()]


def _numbers(name: str, text: str, keys: Collection[str]) -> list[float]:
    try:
        return [float(part) for part in _listed(text)]
    except ValueError:
        known = f', which are {shown_keys(keys)}' if keys else ''
        raise RecordingError(f'{name}={text:.40}: neither a number nor a key of the file{known}'
                             ) from None


def _stacked(keys: Sequence[str], load: Load, remarks: list[str], *, mapped: bool) -> Array:
    """Return the samples under some keys; `mapped`: by the user, in either orientation."""
    parts = []
    for key in keys:
        array = load(key, _MAX_SAMPLE_BYTES)
        if mapped and array.ndim == 2 and array.shape[0] > array.shape[1] > 1:
            remarks.append(f'{key} of shape {array.shape} is taken as sample x channel')
            array = array.T
        parts.append(_samples(key, array))
    if len({part.shape[1] for part in parts}) > 1:
        raise RecordingError(
            'channels of different lengths: '
            + ', '.join(f'{key} {part.shape[1]}' for key, part in zip(keys, parts))
            + ' samples; choose those that were sampled together')
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def _samples(name: str, array: Array) -> Array:
    array = _real(name, array)
    if array.ndim == 1 or (array.ndim == 2 and array.shape[1] == 1):
        array = array.reshape(1, -1)
    if array.ndim != 2 or not array.size:
        raise RecordingError(f'{name} of shape {array.shape}: give samples, channel x sample')
    if array.shape[0] > array.shape[1]:
        raise RecordingError(
            f'{name} of shape {array.shape}: more channels than samples; store channel x sample '
            f'(transpose it), or give {name}={name}, which takes either')
    return array


def _vector(name: str, array: Array) -> FloatArray:
    if array.size != max(array.shape, default=1):
        raise RecordingError(f'{name} of shape {array.shape}: give one row of numbers')
    return np.array(_real(name, array), dtype=np.float64).reshape(-1)


def _number(name: str, array: Array) -> float:
    if array.size != 1:
        raise RecordingError(f'{name} of shape {array.shape}: give a single number')
    return float(_real(name, array).reshape(-1)[0])


def _count(name: str, array: Array, *, least: int = 1) -> int:
    value = _number(name, array)
    if not (value == np.floor(value) and least <= value < 2**31):
        raise RecordingError(f'{name} {value}: give a whole number, at least {least}')
    return int(value)


def _strings(name: str, array: Array) -> tuple[str, ...]:
    if array.dtype.kind == 'S':
        array = np.char.decode(array, 'utf-8', 'replace')
    if array.dtype.kind != 'U':
        raise RecordingError(f'{name} of type {array.dtype}: give text')
    return tuple(item.strip() for item in array.reshape(-1).tolist())


def _counted_pulses(counter: Array, start_time: float, rate: float, a_turn: int,
                    remarks: list[str]) -> FloatArray:
    """Return the pulse times (s) of a counter of `a_turn` pulses a revolution."""
    values = _samples('tach_count', counter)
    if len(values) != 1:
        raise RecordingError(f'tach_count of shape {counter.shape}: give one row')
    counts = values[0].astype(np.float64)
    if not np.all((counts == np.floor(counts)) & (abs(counts) < 2.0**53)):
        raise RecordingError('tach_count has fractions, NaN or values above 2^53: give counts')
    try:
        pulses, state = counter_pulses(counts.astype(np.int64), start_time=start_time,
                                       sample_rate=rate, pulses_per_revolution=a_turn)
    except SignalError as error:
        raise RecordingError(f'tach_count: {error}') from error
    if pulses.size > MAX_PULSES:
        raise RecordingError(f'tach_count counts {pulses.size} pulses: at most {MAX_PULSES} '
                             'are read; split the recording')
    if state.glitches:
        remarks.append(f'tach_count: {state.glitches} samples where the shaft cannot be are '
                       'left out')
    if state.restarts:
        remarks.append(f'tach_count: {state.restarts} jumps that are no overflow begin to count '
                       'anew')
    return pulses


# The fields that are not samples, each with its conversion from an array.
CONVERTED: Mapping[str, Callable[[str, Array], Any]] = {
    'sample_rate': _number, 'tach_rate': _number, 'start_time': _number, 'ratio': _number,
    'pulses_per_revolution': _count, 'pulses_per_trigger': _count,
    'missing_teeth': lambda name, array: _count(name, array, least=0),
    'pulse_times': _vector, 'reference_pulse_times': _vector,
    'orders': lambda name, array: tuple(_vector(name, array).tolist()),
    'channel_names': _strings, 'units': _strings,
    'description': lambda name, array: ' '.join(_strings(name, array))}
FIELDS = (*SAMPLE_FIELDS, *CONVERTED)
