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
Parameters: name, default, meaning, unit and range, the same for nodes, files and library.

A `Parameter` converts and checks values; `nodes/parameters.py` declares it to ROS. `number`,
`whole_number` and `numbers` check the arguments of library functions.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from functools import partial
import math
from numbers import Integral, Real
import re
from typing import Any

from sa_jitter_ros.errors import ParameterError

#: Converted values of parameters by their names.
Values = dict[str, Any]

_LARGEST = 1e15  # size of a float: squares and products stay finite
_WORDS = {float: ('a number', 'numbers'), int: ('a whole number', 'whole numbers'),
          str: ('a text', 'texts'), bool: ('true or false', 'true or false')}


@dataclass(frozen=True)
class Parameter:
    """
    Description of one parameter.

    The type of the default is the type of the parameter; `element` is the type of the elements
    where the default is an empty list. `minimum` and `maximum` limit a number or every element of
    a list; a value must be greater than `above`. `choices` are the values that a text may have. A
    `read_only` parameter is fixed when the node starts. A default of NaN means "not given", which
    a value may say, too.
    """

    name: str
    default: Any
    description: str
    unit: str = ''
    minimum: float | None = None
    maximum: float | None = None
    above: float | None = None
    choices: tuple[str, ...] = ()
    read_only: bool = False
    element: type = float

    @property
    def is_list(self) -> bool:
        """Whether the value is a list."""
        return isinstance(self.default, list)

    @property
    def kind(self) -> type:
        """Type of the value, or of a list's elements."""
        if self.is_list:
            return type(self.default[0]) if self.default else self.element
        return type(self.default)

    def convert(self, value: Any) -> Any:
        """Return the value as the type of this parameter; raises ParameterError."""
        value = unwrapped(value)
        if self.is_list:
            if isinstance(value, (str, bytes)) or not hasattr(value, '__len__'):
                raise ParameterError(f'{self.name} is {value!r}: give a list of '
                                     f'{_WORDS[self.kind][1]}')
            return [self._convert_one(item, f'{self.name}[{i}]') for i, item in enumerate(value)]
        return self._convert_one(value, self.name)

    def _convert_one(self, given: Any, name: str) -> Any:
        given = unwrapped(given)
        kind, value = self.kind, given
        if kind is float and _is_a(Real, value):
            value = math.inf if abs(value) > _LARGEST else float(value)
        elif kind is int and _is_a(Integral, value):
            value = int(value)
        elif kind is str and _is_a(Integral, value):
            value = str(value)  # `-p tach_channel:=2` means the name 2
        if type(value) is not kind:
            raise ParameterError(f'{name} is {value!r}: give {_WORDS[kind][0]}')
        if kind in (int, float):
            self._check_range(value, given, name)
        elif self.choices and value not in self.choices:
            raise ParameterError(f'{name} is {value!r}: give one of '
                                 f'{", ".join(self.choices)}')
        return value

    def _check_range(self, value: Any, given: Any, name: str) -> None:
        if isinstance(self.default, float) and math.isnan(value) and math.isnan(self.default):
            return
        limit = ''
        if isinstance(value, float) and not math.isfinite(value):
            limit = f'a finite number, at most {_LARGEST:g} in size'
        elif self.above is not None and not value > self.above:
            limit = f'more than {self.above}'
        elif self.minimum is not None and value < self.minimum:
            limit = f'at least {self.minimum}'
        elif self.maximum is not None and value > self.maximum:
            limit = f'at most {self.maximum}'
        if limit:
            unit = f' {self.unit}' if self.unit not in ('', '1') else ''
            raise ParameterError(f'{name} is {given}{unit}: give {limit}')


#: A parameter that is fixed when the node starts.
fixed = partial(Parameter, read_only=True)


def _is_a(kind: Any, value: Any) -> bool:
    """Return whether a value is a number of a kind; true and false are not."""
    return isinstance(value, kind) and not isinstance(value, bool)


def unwrapped(value: Any) -> Any:
    """
    Return the Python value in a NumPy scalar or 0-d array; any other value as it is.

    `numpy.load` returns each number of an `.npz` file as a 0-d array.
    """
    return value.item() if getattr(value, 'ndim', None) == 0 else value


def number(name: str, value: Any) -> float:
    """
    Return the argument `name` of a function as a float; raises ParameterError.

    >>> number('ratio', 2)
    2.0
    >>> number('ratio', '2')
    Traceback (most recent call last):
    ...
    sa_jitter_ros.errors.ParameterError: ratio is '2': give a number
    """
    value = unwrapped(value)
    if not _is_a(Real, value):
        raise ParameterError(f'{name} is {value!r}: give a number')
    return float(value)


def whole_number(name: str, value: Any) -> int:
    """Return the argument `name` of a function, 40 or 40.0, as an int; raises ParameterError."""
    value = unwrapped(value)
    if not (_is_a(Real, value) and math.isfinite(value) and value == int(value)):
        raise ParameterError(f'{name} is {value!r}: give a whole number')
    return int(value)


def numbers(name: str, value: Any) -> tuple[float, ...]:
    """Return the argument `name` of a function as a tuple of floats; raises ParameterError."""
    value = unwrapped(value)
    if _is_a(Real, value):
        raise ParameterError(f'{name} is {value!r}: give a list of numbers, [{value!r}]')
    if isinstance(value, (str, bytes)) or not isinstance(value, Iterable):
        raise ParameterError(f'{name} is {value!r}: give a list of numbers')
    return tuple(number(f'{name}[{i}]', item) for i, item in enumerate(value))


def listed(values: Iterable[float], digits: int = 4) -> str:
    """
    Return numbers as a short text, of many the first ones and the last one.

    >>> listed([19, 38]), listed(range(1, 200))
    ('19, 38', '1, 2, 3, 4, ..., 199')
    """
    texts = [f'{value:.{digits}g}' for value in values]
    return ', '.join(texts if len(texts) <= 6 else [*texts[:4], '...', texts[-1]])


#: Relative difference of ratios that are the same: users give six digits, which are as near to any
#: ratio. Gears of other teeth differ by more.
SAME_RATIO = 1e-5
#: Beyond this range one shaft hardly turns during an average of the other.
RATIO = Parameter('ratio', 1.0, 'speed of the shaft of interest over that of the tach shaft',
                  minimum=1e-3, maximum=1e3)
PULSES_PER_REVOLUTION = Parameter(
    'pulses_per_revolution', 1, 'pulses per revolution of the tach shaft, with those of missing '
    'teeth', minimum=1, maximum=100000)
PULSES_PER_TRIGGER = Parameter(
    'pulses_per_trigger', 0, 'pulses per trigger cycle; 0: all of a revolution', minimum=0,
    maximum=100000)
TRIGGER_CYCLES = Parameter('trigger_cycles', 40, 'trigger cycles in an average, N_t', minimum=1,
                           maximum=1000000)
TACH_TYPE = fixed('tach_type', 'sensor_msgs/TimeReference', 'message type of tach_pulse; '
                  'std_msgs/Float64MultiArray for more than some hundred pulses a second')
#: Of every node, and of every node that takes data.
HARDWARE_ID = Parameter('hardware_id', '', 'name of the machine in diagnostics; empty: that of '
                        'this computer')
STALE_AFTER = Parameter('stale_after', 5.0, 'silence of an input that is a warning, three times '
                        'as long an error; 0: never', unit='s', minimum=0.0, maximum=1e6)


#: Parameters of a node that say nothing of what it computes.
_OF_NODE = ('use_sim_time', HARDWARE_ID.name, STALE_AFTER.name)


def converted(values: Mapping[str, Any], known: Mapping[str, Parameter]) -> Values:
    """Return the converted values of `known` parameters; raises ParameterError."""
    return {name: known[name].convert(value) for name, value in values.items() if name in known}


def unknown_names(values: Mapping[str, Any], known: Mapping[str, Parameter]) -> tuple[str, ...]:
    """Return the names that are neither those of `known` parameters nor of any node."""
    return tuple(sorted(name for name in values if name not in (*known, *_OF_NODE)
                        and not name.startswith('qos_overrides.')))


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """
    Return a question for the names that an unknown one may stand for, '' if none is like it.

    >>> did_you_mean('trigger_cycle', ['trigger_cycles', 'ratio'])
    ', did you mean trigger_cycles?'
    """
    near = ' or '.join(get_close_matches(name, known, 2, cutoff=0.7))
    return f', did you mean {near}?' if near else ''


def sample_parameters(topic: str) -> tuple[Parameter, ...]:
    """Return the parameters of the node whose input of samples is `topic`."""
    return (
        fixed('vibration_type', 'std_msgs/Float64MultiArray', f'message type of {topic}'),
        fixed('sample_rate', 0.0, 'sampling rate, if not in the messages', unit='Hz', minimum=0.0,
              maximum=1e9),
        fixed('start_time', 0.0, 'time of the first sample, if not in the messages', unit='s'),
        fixed('time_tolerance', 0.01, 'deviation of a header time that starts a new run', unit='s',
              above=0.0),
    )


def require_shaft_names(parameter: str, names: Sequence[str]) -> None:
    """Raise ParameterError unless the names differ and can be part of a topic's name."""
    wrong = [name for name in names if not re.fullmatch('[a-z][a-z0-9_]*', name)]
    if wrong or not names or len(set(names)) < len(names):
        raise ParameterError(f'{parameter} is {", ".join(map(repr, names))}: give different names '
                             'of small letters, digits and underscores')
