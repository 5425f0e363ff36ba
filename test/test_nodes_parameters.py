# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Parameters: types, ranges, reasons of refusals, and changes in a running node."""

import math

import numpy as np
import pytest
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.nodes.parameters import as_ros_parameter, descriptor_of, ParameterSet
from sa_jitter_ros.parameters import Parameter

SPECIFICATIONS = (
    Parameter('rate', 1.0, 'a rate', unit='Hz', above=0.0, maximum=1e6),
    Parameter('count', 3, 'a number', minimum=1, maximum=9),
    Parameter('mode', 'fast', 'a mode', choices=('fast', 'slow')),
    Parameter('name', '', 'any text'),
    Parameter('flag', False, 'a flag'),
    Parameter('orders', [1.0, 2.0], 'orders', above=0.0),
    Parameter('teeth', [], 'teeth', minimum=1, element=int),
    Parameter('fixed', 5, 'a constant', read_only=True),
)


@pytest.fixture
def node_with(ros_graph):
    """Return a maker of nodes with these overrides; gives the node and its parameters."""
    made = []

    def make(**overrides):
        made.append(Node('n', context=ros_graph.context, parameter_overrides=[
            RosParameter(name, value=value) for name, value in overrides.items()]))
        return made[-1], ParameterSet(made[-1], SPECIFICATIONS)

    yield make
    for node in made:
        node.destroy_node()


@pytest.mark.parametrize(('index', 'given', 'stored'), [
    (0, 2, 2.0), (0, 2.5, 2.5), (0, np.float64(0.5), 0.5), (1, np.int64(2), 2),
    (1, 9, 9), (2, 'slow', 'slow'), (4, True, True),
    (5, [1, 2], [1.0, 2.0]), (5, (3.5,), [3.5]), (5, [], []), (6, [7], [7]),
])
def test_values_are_taken_as_the_kind_declared(index, given, stored):
    got = SPECIFICATIONS[index].convert(given)
    assert got == stored
    assert type(got) is type(stored)


@pytest.mark.parametrize(('index', 'given', 'says'), [
    (0, 0, r'rate is 0 Hz: give more than 0.0'), (0, -1.0, 'more than 0.0'),
    (0, 2e6, r'rate is 2000000.0 Hz: give at most 1000000.0'),
    (0, 10**400, 'give a finite number, at most 1e.15 in size'), (0, math.nan, 'finite'),
    (0, math.inf, 'finite'), (0, '1', "rate is '1': give a number"),
    (0, True, 'rate is True: give a number'), (0, None, 'rate is None: give a number'),
    (1, 0, 'at least 1'), (1, 10, 'at most 9'), (1, 2.0, '2.0: give a whole number'),
    (1, True, 'True: give a whole number'),
    (2, 'medium', "mode is 'medium': give one of fast, slow"), (4, 1, 'give true or false'),
    (5, 3.0, 'give a list of numbers'), (5, '12', 'give a list of numbers'),
    (5, [1.0, 0.0], r'orders\[1\] is 0.0: give more than 0.0'), (6, [1.5], 'give a whole number'),
    (6, [0], 'at least 1'),
])
def test_wrong_values_are_refused(index, given, says):
    with pytest.raises(ParameterError, match=says):
        SPECIFICATIONS[index].convert(given)


def test_descriptors_contain_unit_range_and_choices():
    rate, count, mode, *_, fixed = (descriptor_of(item) for item in SPECIFICATIONS)
    assert rate.description == 'a rate [Hz]'
    assert rate.additional_constraints == 'more than 0.0'
    assert rate.floating_point_range[0].to_value == 1e6
    assert (count.integer_range[0].from_value, count.integer_range[0].to_value) == (1, 9)
    assert mode.additional_constraints == 'one of fast, slow'
    assert fixed.read_only
    assert not rate.read_only


def test_an_empty_list_keeps_its_type():
    assert as_ros_parameter('a', [], int).type_ == RosParameter.Type.INTEGER_ARRAY
    assert as_ros_parameter('a', [], str).type_ == RosParameter.Type.STRING_ARRAY
    assert as_ros_parameter('a', []).type_ == RosParameter.Type.DOUBLE_ARRAY


def test_overrides_are_converted_and_checked(node_with):
    node, parameters = node_with(rate=7, orders=[1, 2, 3], count=4)
    values = parameters.values()
    assert (values['rate'], values['orders'], values['count']) == (7.0, [1.0, 2.0, 3.0], 4)
    assert type(node.get_parameter('rate').value) is float
    assert node.get_parameter('orders').type_ == RosParameter.Type.DOUBLE_ARRAY
    for name, value in (('rate', 'x'), ('count', 0), ('mode', 'none'), ('orders', [0.0])):
        with pytest.raises(ParameterError, match=name):
            node_with(**{name: value})


def test_a_change_is_checked_before_and_applied_after(node_with):
    node, parameters = node_with()
    checked, applied = [], []

    def check(values):
        checked.append(values)
        if values['rate'] > 100.0 and values['mode'] == 'slow':
            raise ParameterError('rate is above 100 Hz in mode slow: choose fast')

    parameters.watch(check=check, apply=applied.append)
    result, = node.set_parameters([RosParameter('rate', value=500)])
    assert result.successful
    assert applied[-1]['rate'] == 500.0 == node.get_parameter('rate').value
    result, = node.set_parameters([RosParameter('mode', value='slow')])
    assert not result.successful
    assert result.reason == 'rate is above 100 Hz in mode slow: choose fast'
    assert node.get_parameter('mode').value == 'fast'
    assert len(applied) == 1
    result = node.set_parameters_atomically([
        RosParameter('rate', value=50), RosParameter('mode', value='slow')])
    assert result.successful
    assert (applied[-1]['rate'], applied[-1]['mode']) == (50.0, 'slow')


@pytest.mark.parametrize(('name', 'value'), [
    ('rate', 'x'), ('rate', 0.0), ('count', 2.5), ('count', 10), ('mode', 'none'),
    ('orders', [1.0, -1.0]), ('orders', 1.0), ('teeth', [0]), ('fixed', 6), ('flag', 1),
])
def test_refused_change_changes_nothing(node_with, name, value):
    node, parameters = node_with()
    applied, before = [], parameters.values()
    parameters.watch(check=lambda values: None, apply=applied.append)
    result, = node.set_parameters([RosParameter(name, value=value)])
    assert not result.successful
    assert result.reason
    assert parameters.values() == before
    assert not applied


def test_lists_may_become_empty_and_full_again(node_with):
    node, parameters = node_with()
    parameters.watch(check=lambda values: None, apply=lambda values: None)
    for value in ([3], [], [4, 5]):
        result, = node.set_parameters([as_ros_parameter('teeth', value, int)])
        assert result.successful, result.reason
        assert parameters.values()['teeth'] == value


def test_override_without_parameter_is_named(node_with, capfd):
    _, parameters = node_with(**{'rat': 2.0, 'shaft': 1, 'use_sim_time': False,
                                 'qos_overrides./a.subscription.depth': 5})
    parameters.watch(check=lambda values: None, apply=lambda values: None)
    errors = capfd.readouterr().err
    assert ('parameter rat is ignored: this node has no parameter of that name, did you mean '
            'rate?\n') in errors
    assert 'parameter shaft is ignored: this node has no parameter of that name\n' in errors
    assert 'qos_overrides' not in errors
    assert 'use_sim_time' not in errors
