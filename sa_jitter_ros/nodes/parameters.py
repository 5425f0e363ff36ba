"""
Declare, read and check parameters: described, ranged, kind to integers.

A node lists its parameters as `Parameter` specifications. `ParameterSet` declares them (a float
takes an integer, a float list an integer list, from `-p`, YAML and services), warns of overrides
that match nothing, and on a change hands the whole new configuration first to `check`, whose
`SaJitterError` refuses the change with its reason, and once it is set to `apply`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
import math
import re
from typing import Any

from rcl_interfaces.msg import (FloatingPointRange, IntegerRange, ParameterDescriptor,
                                SetParametersResult)
from rclpy.node import Node
import rclpy.parameter
from sa_jitter_ros.errors import ParameterError, SaJitterError

Values = dict[str, Any]


@dataclass(frozen=True)
class Parameter:
    """
    Specification of one parameter.

    The default's type is the parameter's type; `[0.0]`-like defaults make lists, and `element`
    gives the type of a list whose default is empty. `minimum` and `maximum` bound a number or
    every element of a list, `above` is an open lower bound, `choices` are the values a string may
    take.
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
        """Return the value as this parameter's type, or raise `ParameterError`."""
        if self.is_list:
            if isinstance(value, (str, bytes)) or not hasattr(value, '__len__'):
                raise ParameterError(f'{self.name} is {value!r}: give a list of '
                                     f'{self.kind.__name__}')
            return [self._convert_one(item) for item in value]
        return self._convert_one(value)

    def _convert_one(self, value: Any) -> Any:
        kind: Any = self.kind
        if kind is float and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        if kind is str and isinstance(value, int) and not isinstance(value, bool):
            value = str(value)  # `-p tach_channel:=2` means the name 2
        if type(value) is not kind:
            raise ParameterError(f'{self.name} is {value!r} ({type(value).__name__}): '
                                 f'give {kind.__name__}')
        if kind in (int, float):
            self._check_range(value)
        elif self.choices and value not in self.choices:
            raise ParameterError(f'{self.name} is {value!r}: give one of '
                                 f'{", ".join(self.choices)}')
        return value

    def _check_range(self, value: float) -> None:
        unit = f' {self.unit}' if self.unit else ''
        if not math.isfinite(value):
            raise ParameterError(f'{self.name} is {value}{unit}: give a finite number')
        if self.above is not None and not value > self.above:
            raise ParameterError(f'{self.name} is {value}{unit}: give more than {self.above}')
        if self.minimum is not None and value < self.minimum:
            raise ParameterError(f'{self.name} is {value}{unit}: give at least {self.minimum}')
        if self.maximum is not None and value > self.maximum:
            raise ParameterError(f'{self.name} is {value}{unit}: give at most {self.maximum}')

    def descriptor(self) -> ParameterDescriptor:
        """Descriptor for `ros2 param describe`."""
        text = self.description + (f' [{self.unit}]' if self.unit else '')
        limits = []
        if self.choices:
            limits.append(f'one of {", ".join(self.choices)}')
        if self.above is not None:
            limits.append(f'more than {self.above}')
        # Typing is dynamic so that an integer can reach a float and be converted.
        descriptor = ParameterDescriptor(
            description=text, read_only=self.read_only, dynamic_typing=True,
            additional_constraints='; '.join(limits))
        if self.minimum is not None or self.maximum is not None:
            low = -math.inf if self.minimum is None else self.minimum
            high = math.inf if self.maximum is None else self.maximum
            if self.kind is float:
                descriptor.floating_point_range = [FloatingPointRange(
                    from_value=max(low, -1.7e308), to_value=min(high, 1.7e308))]
            elif self.kind is int:
                descriptor.integer_range = [IntegerRange(
                    from_value=int(max(low, -2**63)), to_value=int(min(high, 2**63 - 1)))]
        return descriptor


def as_ros_parameter(name: str, value: Any, element: type = float) -> rclpy.parameter.Parameter:
    """ROS parameter of a value; an empty list becomes a list of `element`."""
    if isinstance(value, list) and not value:
        kinds = {float: rclpy.Parameter.Type.DOUBLE_ARRAY, int: rclpy.Parameter.Type.INTEGER_ARRAY,
                 str: rclpy.Parameter.Type.STRING_ARRAY}
        return rclpy.parameter.Parameter(name, kinds[element], value)
    return rclpy.parameter.Parameter(name, value=value)


def require_shaft_names(parameter: str, names: Sequence[str]) -> None:
    """Raise `ParameterError` unless there are names, different ones that topics can have."""
    wrong = [name for name in names if not re.fullmatch('[a-z][a-z0-9_]*', name)]
    if wrong or not names or len(set(names)) < len(names):
        raise ParameterError(f'{parameter} is {", ".join(map(repr, names))}: give different names '
                             'of small letters, digits and underscores')


def require_node_name(parameter: str, name: str) -> None:
    """Raise `ParameterError` unless a node can have the name, with or without namespace."""
    if not re.fullmatch(r'/?([A-Za-z_]\w*/)*[A-Za-z_]\w*', name, re.ASCII) or '__' in name:
        raise ParameterError(f'{parameter} is {name!r}: give the name of a node')


class ParameterSet:
    """The declared parameters of one node, as a dictionary of converted values."""

    def __init__(self, node: Node, specifications: Sequence[Parameter]) -> None:
        self._node = node
        self._specifications: dict[str, Parameter] = {}
        self._check: Callable[[Values], object] = lambda values: None
        self._apply: Callable[[Values], None] = lambda values: None
        self.declare(specifications)

    def declare(self, specifications: Sequence[Parameter]) -> None:
        """Declare; raises `ParameterError` for an override of wrong type or range."""
        for item in specifications:
            value = item.convert(self._node._parameter_overrides[item.name].value
                                 if self.given(item.name) else item.default)
            self._node.declare_parameter(
                item.name, value, item.descriptor(), ignore_override=True)
            if value == [] and not item.read_only:  # rclpy takes an empty list for bytes
                self._node.set_parameters([as_ros_parameter(item.name, value, item.kind)])
            self._specifications[item.name] = item

    def given(self, name: str) -> bool:
        """Whether the user gave a parameter at the start, even if it is the default."""
        override = self._node._parameter_overrides.get(name)
        return override is not None and override.value is not None

    def values(self) -> Values:
        """Every parameter's converted value."""
        return {name: item.convert(self._node.get_parameter(name).value)
                for name, item in self._specifications.items()}

    def watch(self, *, check: Callable[[Values], object],
              apply: Callable[[Values], None]) -> None:
        """
        Start handling changes; call once all parameters are declared.

        `check` gets all values with the change and may raise `SaJitterError`; `apply` gets them
        after the change.
        """
        self._check, self._apply = check, apply
        self._node.add_pre_set_parameters_callback(self._convert)
        self._node.add_on_set_parameters_callback(self._validate)
        self._node.add_post_set_parameters_callback(self._changed)
        for name in sorted(set(self._node._parameter_overrides) - set(self._specifications)):
            if not name.startswith(('qos_overrides.', 'use_sim_time', 'start_type_')):
                self._node.get_logger().warning(
                    f'parameter {name} matches nothing that this node declares: ignored')

    def _convert(self, parameters: list[rclpy.parameter.Parameter]
                 ) -> list[rclpy.parameter.Parameter]:
        """Turn integers into the floats they stand for; leave what is wrong to `_validate`."""
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
