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
The parameters of a node: declared to ROS, read, and checked when they change.

A node lists its parameters as `Parameter`. `ParameterSet` declares them (a float accepts an
integer, a list of floats a list of integers, from `-p`, YAML and services) and warns of overrides
that match none. What is not given follows from the machine where it can (`following`). Before a
change it calls `check` with all new values, which raises a `SaJitterError` to refuse the change;
after the change it calls `apply`.

rcl looks for the section of a file by the name that a node has after remapping, so that a renamed
node would start with its defaults: `given_parameters` finds what rcl misses. A process of several
nodes has a name too, which would rename all of them.
"""

from collections.abc import Callable, Collection, Sequence
from itertools import pairwise
import math
from pathlib import Path
import re
from typing import Any

from rcl_interfaces.msg import (FloatingPointRange, IntegerRange, ParameterDescriptor,
                                SetParametersResult)
from rclpy.node import Node
import rclpy.parameter
from sa_jitter_ros.errors import ParameterError, SaJitterError
from sa_jitter_ros.machine import following, Machine, PREFIX
from sa_jitter_ros.parameter_file import named_parameters, value_of
from sa_jitter_ros.parameters import did_you_mean, Parameter, Values
from sa_jitter_ros.recordings.channel_units import channel_parameters, Channels, channels_of

_RULE = re.compile(r'(?:(.*):)?__(?:node|name):=(.*)')  # that renames a node, or all


def descriptor_of(item: Parameter) -> ParameterDescriptor:
    """Return the descriptor for `ros2 param describe`."""
    text = item.description + (f' [{item.unit}]' if item.unit else '')
    limits = []
    if item.choices:
        limits.append(f'one of {", ".join(item.choices)}')
    if item.above is not None:
        limits.append(f'more than {item.above}')
    may_be_nan = isinstance(item.default, float) and math.isnan(item.default)
    if may_be_nan:  # which ROS takes for out of every range
        limits.append('NaN' + ('' if item.minimum is None else f', or at least {item.minimum}'))
    # With dynamic typing ROS passes an integer on to `_convert`, which makes it a float.
    descriptor = ParameterDescriptor(
        description=text, read_only=item.read_only, dynamic_typing=True,
        additional_constraints='; '.join(limits))
    if (item.minimum is not None or item.maximum is not None) and not may_be_nan:
        low = -math.inf if item.minimum is None else item.minimum
        high = math.inf if item.maximum is None else item.maximum
        if item.kind is float:
            descriptor.floating_point_range = [FloatingPointRange(
                from_value=max(low, -1.7e308), to_value=min(high, 1.7e308))]
        elif item.kind is int:
            descriptor.integer_range = [IntegerRange(
                from_value=int(max(low, -2**63)), to_value=int(min(high, 2**63 - 1)))]
    return descriptor


def as_ros_parameter(name: str, value: Any, element: type = float) -> rclpy.parameter.Parameter:
    """Return the ROS parameter of a value; an empty list becomes a list of `element`."""
    if isinstance(value, list) and not value:
        kinds = {float: rclpy.Parameter.Type.DOUBLE_ARRAY, int: rclpy.Parameter.Type.INTEGER_ARRAY,
                 str: rclpy.Parameter.Type.STRING_ARRAY}
        return rclpy.parameter.Parameter(name, kinds[element], value)
    return rclpy.parameter.Parameter(name, value=value)


def command_line_parameters(args: Sequence[str], nodes: Collection[str] = ()
                            ) -> list[rclpy.parameter.Parameter]:
    """
    Return the parameters of all nodes on a command line, `-p NAME:=VALUE`, and of some by name.

    >>> [(item.name, item.value) for item in command_line_parameters(
    ...     ['--ros-args', '-p', 'rate:=5e-6', '--param', 'shafts:=[a, b]', '-p', 'node:x:=1'])]
    [('rate', 5e-06), ('shafts', ['a', 'b'])]
    """
    found = []
    for option, rule in pairwise(args):
        name, separator, text = rule.partition(':=')
        node, _, name = name.rpartition(':')
        if option in ('-p', '--param') and separator and node in ('', *nodes):
            try:
                found.append(rclpy.parameter.Parameter(name, value=value_of(text)))
            except (ParameterError, TypeError):
                continue  # rcl says what is wrong
    return found


def common_name(args: Sequence[str]) -> tuple[list[str], str]:
    """
    Return arguments without the rules that rename every node, and the name that they give or ''.

    >>> common_name(['--ros-args', '-r', '__node:=rig', '-r', '__ns:=/a', '-r', 'x:__node:=y'])
    (['--ros-args', '-r', '__ns:=/a', '-r', 'x:__node:=y'], 'rig')
    """
    kept, name = list(args), ''
    for place in range(len(args) - 2, -1, -1):
        rule = _RULE.fullmatch(args[place + 1])
        if args[place] in ('-r', '--remap') and rule and rule[1] is None:
            name = rule[2]
            del kept[place:place + 2]
    return kept, name


def parameter_files(args: Sequence[str]) -> list[Path]:
    """Return the parameter files of a command line."""
    return [Path(path) for option, path in pairwise(args) if option == '--params-file']


def given_parameters(node: str, args: Sequence[str], process: Sequence[str] = ()
                     ) -> list[rclpy.parameter.Parameter]:
    """
    Return the parameters on a command line that rcl does not give to a node by itself.

    rcl lets the section of a node in a file win over `-p` for all nodes, and knows neither the
    section of a renamed node nor those of the names of its `process`. Without files rcl does all.
    """
    files = parameter_files(args)
    rules = [_RULE.fullmatch(rule) for option, rule in pairwise(args)
             if option in ('-r', '--remap')]
    name = next((rule[2] for rule in rules if rule and rule[1] in (None, node)), node)
    found: dict[str, Any] = {}
    for names in (*([(node,), (name,)] if name != node else []), *([process] if process else [])):
        for path in files:
            found |= named_parameters(path, names)
    return ([rclpy.parameter.Parameter(key, value=value) for key, value in found.items()]
            + command_line_parameters(args, (node, name) if found else ())) if files else []


def require_node_name(parameter: str, name: str) -> None:
    """Raise `ParameterError` unless a node can have the name, with or without namespace."""
    if not re.fullmatch(r'/?([A-Za-z_]\w*/)*[A-Za-z_]\w*', name, re.ASCII) or '__' in name:
        raise ParameterError(f'{parameter} is {name!r}: give the name of a node, with or without '
                             'its namespace')


# Parameters of rclpy, and what only some nodes use of the machine.
_OF_OTHERS = ('qos_overrides.', 'use_sim_time', 'start_type_', PREFIX)


class ParameterSet:
    """The parameters of one node, with converted values."""

    def __init__(self, node: Node, specifications: Sequence[Parameter]) -> None:
        self._node = node
        self._specifications: dict[str, Parameter] = {}
        self._following = following(self.given_values)
        #: The machine by its parts, without any where none are given.
        self.machine = Machine.among(self.given_values)
        self.declare(specifications)

    def declare(self, specifications: Sequence[Parameter]) -> None:
        """Declare parameters; raises `ParameterError` for a value of wrong type or range."""
        given = self.given_values
        for item in specifications:
            value = item.convert(given[item.name] if item.name in given
                                 else self._following.get(item.name, item.default))
            self._node.declare_parameter(
                item.name, value, descriptor_of(item), ignore_override=True)
            if value == [] and not item.read_only:  # rclpy declares an empty list as bytes
                self._node.set_parameters([as_ros_parameter(item.name, value, item.kind)])
            self._specifications[item.name] = item

    def declare_channels(self) -> Channels:
        """Declare what the machine file says of the channels, and return it."""
        given = self.given_values
        self.declare(channel_parameters(given))
        return channels_of(given)

    @property
    def given_values(self) -> Values:
        """Values that the user gave at the start, also those that match no parameter."""
        return {name: override.value for name, override in self._node._parameter_overrides.items()
                if override.value is not None}

    def values(self) -> Values:
        """Return the converted values of all parameters by name."""
        return {name: item.convert(self._node.get_parameter(name).value)
                for name, item in self._specifications.items()}

    def watch(self, *, check: Callable[[Values], object],
              apply: Callable[[Values], None]) -> None:
        """
        Handle changes from now on; call it when all parameters are declared.

        Both functions get all values. `check` is called before a change and refuses it by a
        `SaJitterError`; `apply` is called after the change.
        """
        self._check, self._apply = check, apply
        self._node.add_pre_set_parameters_callback(self._convert)
        self._node.add_on_set_parameters_callback(self._validate)
        self._node.add_post_set_parameters_callback(self._changed)
        for name in sorted(set(self._node._parameter_overrides) - set(self._specifications)):
            if not name.startswith(_OF_OTHERS):
                self._node.get_logger().warning(
                    f'parameter {name} is ignored: this node has no parameter of that name'
                    + did_you_mean(name, self._specifications))

    def _convert(self, parameters: list[rclpy.parameter.Parameter]
                 ) -> list[rclpy.parameter.Parameter]:
        """Convert integers to floats; `_validate` refuses what cannot be converted."""
        converted = []
        for parameter in parameters:
            item = self._specifications.get(parameter.name)
            if item is not None:
                try:
                    parameter = as_ros_parameter(
                        parameter.name, item.convert(parameter.value), item.kind)
                except ParameterError:
                    pass
            converted.append(parameter)
        return converted

    def _validate(self, parameters: list[rclpy.parameter.Parameter]) -> SetParametersResult:
        try:
            values = self.values()
            for parameter in parameters:
                if parameter.name in self._specifications:
                    values[parameter.name] = self._specifications[parameter.name].convert(
                        parameter.value)
            self._check(values)
        except SaJitterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _changed(self, parameters: list[rclpy.parameter.Parameter]) -> None:
        if any(parameter.name in self._specifications for parameter in parameters):
            self._apply(self.values())
