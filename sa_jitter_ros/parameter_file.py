# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The parameters of one node in a ROS parameter file, read and written without ROS."""

from collections.abc import Collection, Iterator, Mapping
import json
from pathlib import Path
import re
import stat
from types import MappingProxyType
from typing import Any

from sa_jitter_ros.errors import ParameterError, quoted
import yaml

_LARGEST_FILE = 1 << 20
_DEEPEST = 20
_PLAIN = re.compile(r'[A-Za-z_][\w ./^-]*')  # needs no quotes, unless YAML reads it


class _Loader(getattr(yaml, 'CSafeLoader', yaml.SafeLoader)):  # type: ignore[misc]
    """Reads as rcl does: YAML 1.1 takes 5e-6 for a text."""


_Loader.add_implicit_resolver(
    'tag:yaml.org,2002:float', re.compile(r'[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$'),
    list('-+.0123456789'))


def read_parameters(path: Path, node: str) -> dict[str, Any]:
    """
    Read the parameters of a node, nested names joined by dots; the last section wins.

    The key of a section is the node's name, with or without slash and namespace, `*` or `**`. YAML
    tags create no objects; aliases are refused, as in rcl. Raises ParameterError, in one line, for
    a file that is missing, too large, nested too deep, or without parameters of the node.
    """
    sections = [section for name, section in _sections(_content(path), '')
                if name.rsplit('/', 1)[-1] in (node, '*', '**')]
    if not sections:
        raise ParameterError(f'{path}: no ros__parameters of {node}: start the file with '
                             f'"{node}:" or "/**:" and "ros__parameters:"')
    return {name: value for section in sections for name, value in flattened(section)}


def named_parameters(path: Path, nodes: Collection[str]) -> dict[str, Any]:
    """Read the parameters in sections of named nodes alone, in any namespace, as above."""
    return {name: value for key, section in _sections(_content(path), '')
            if key.rsplit('/', 1)[-1] in nodes for name, value in flattened(section)}


def _content(path: Path) -> Any:
    """Return the content of a parameter file; raises ParameterError."""
    try:
        require_regular_file(path)
        text = path.read_text(encoding='utf-8')
        _check_structure(text)
        return yaml.load(text, _Loader)
    except ParameterError as error:
        raise ParameterError(f'{path}: {error}') from error
    except OSError as error:
        raise ParameterError(f'{path}: {error.strerror or error}: give the path of a parameter '
                             'file that can be read') from error
    except Exception as error:  # malformed tags raise exceptions of many types
        raise ParameterError(f'{path}: cannot be read as YAML: {quoted(error)}') from error


def nested(values: Mapping[str, Any]) -> dict[str, Any]:
    """
    Return values by full names as nested mappings.

    >>> nested({'machine.gears.g.teeth': 19, 'machine.tach_shaft': 'input'})
    {'machine': {'gears': {'g': {'teeth': 19}}, 'tach_shaft': 'input'}}
    """
    found: dict[str, Any] = {}
    for name, value in values.items():
        *path, last = name.split('.')
        place = found
        for key in path:
            place = place.setdefault(key, {})
        place[last] = value
    return found


def section_text(node: str, parameters: Mapping[str, Any],
                 remarks: Mapping[str, str] = MappingProxyType({})) -> str:
    """
    Return the section of a node in any namespace as rcl reads it, of all without its name.

    Mappings are nested; `remarks` are by the full names of parameters.

    >>> print(section_text('jitter_predictor', {
    ...     'keyphasor_rate': 3e3, 'effects': {'excess_jitter': {'enabled': True, 'std': 8e-5}},
    ... }, {'effects.excess_jitter.std': 'new'}), end='')
    /**/jitter_predictor:
      ros__parameters:
        keyphasor_rate: 3000.0
        effects:
          excess_jitter:
            enabled: true
            std: 8.0e-05  # new
    """
    return '\n'.join((f'/**/{node}:' if node else '/**:', '  ros__parameters:',
                      *_lines(parameters, remarks, '', '    '), ''))


def value_of(text: str) -> Any:
    """Return the value of a text in YAML as rcl reads it; raises ParameterError."""
    try:
        return yaml.load(text, _Loader)
    except Exception as error:  # malformed tags raise exceptions of many types
        raise ParameterError(f'{text}: cannot be read as YAML: {quoted(error)}') from error


def shipped(name: str) -> Path:
    """
    Return the path of a file of `config/`, in a checkout or where the package is installed.

    Raises ParameterError where it is not installed.

    >>> shipped('machine.yaml').name
    'machine.yaml'
    """
    folder = Path(__file__).resolve().parent
    places = [folder.parent / 'config' / name, *(
        parent / 'share' / folder.name / 'config' / name for parent in folder.parents)]
    for place in places:
        if place.is_file():
            return place
    raise ParameterError(f'{name} is not installed with {folder}: give --params with its path')


def require_regular_file(path: Path) -> None:
    """Raise ParameterError for a file that is too large or may never end; OSError without it."""
    found = path.stat()
    if not (stat.S_ISREG(found.st_mode) or stat.S_ISDIR(found.st_mode)):  # which no one can read
        raise ParameterError('is no regular file: give a parameter file (.yaml)')
    if found.st_size > _LARGEST_FILE:
        raise ParameterError(f'{found.st_size} bytes are too many for a parameter file: give at '
                             f'most {_LARGEST_FILE}')


def _check_structure(text: str) -> None:
    """Raise ParameterError for a text that may need unlimited time or memory."""
    depth = 0
    for event in _events(text):
        line = event.start_mark.line + 1
        if isinstance(event, yaml.AliasEvent):
            raise ParameterError(f'line {line}: YAML aliases are not supported: write the value '
                                 'itself')
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        if depth > _DEEPEST:
            raise ParameterError(f'line {line}: nested deeper than {_DEEPEST} levels')


def _events(text: str) -> Iterator[yaml.Event]:
    """Iterate over a text; libyaml reads ahead and may be the first to find it too deep."""
    try:
        yield from yaml.parse(text, _Loader)
    except yaml.MarkedYAMLError as error:
        if error.problem_mark is None or 'nesting depth' not in str(error.problem):
            raise
        raise ParameterError(f'line {error.problem_mark.line + 1}: nested deeper than {_DEEPEST} '
                             'levels') from error


def _sections(content: Any, name: str) -> Iterator[tuple[str, Mapping[Any, Any]]]:
    """Iterate over the sections of parameters with the names of their nodes."""
    for key, value in content.items() if isinstance(content, Mapping) else ():
        if key == 'ros__parameters' and isinstance(value, Mapping):
            yield name, value
        else:
            yield from _sections(value, f'{name}/{str(key).strip("/")}')


def flattened(section: Mapping[Any, Any], prefix: str = '') -> Iterator[tuple[str, Any]]:
    """Iterate over the values of nested mappings, with their names joined by dots."""
    for key, value in section.items():
        name = f'{prefix}{" ".join(str(key).split())}'
        if isinstance(value, Mapping):
            yield from flattened(value, f'{name}.')
        else:
            yield name, value


def _lines(parameters: Mapping[str, Any], remarks: Mapping[str, str], prefix: str, indent: str
           ) -> Iterator[str]:
    for key, value in parameters.items():
        if isinstance(value, Mapping):
            yield f'{indent}{_written(key)}:'
            yield from _lines(value, remarks, f'{prefix}{key}.', f'{indent}  ')
        else:
            remark = remarks.get(f'{prefix}{key}', '')
            yield (f'{indent}{_written(key)}: {_written(value)}'
                   + (f'  # {remark}' if remark else ''))


def _written(value: Any) -> str:
    """Return a parameter as rcl reads it: a float has a point, also with an exponent."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (list, tuple)):
        return f'[{", ".join(map(_written, value))}]'
    if isinstance(value, float):
        text = f'{value:.10g}'
        if '.' not in text:
            mantissa, e, exponent = text.partition('e')
            text = f'{mantissa}.0{e}{exponent}'
        return text
    if isinstance(value, str) and not (_PLAIN.fullmatch(value) and value_of(value) == value):
        return json.dumps(value)
    return str(value)
