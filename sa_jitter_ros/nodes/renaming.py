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
Renamed nodes: rules `__node:=NAME` of a command line, and parameters that rcl then misses.

rcl looks for the section of a file by the name that a node has after remapping, so that a renamed
node would start with its defaults. A process of several nodes has a name too, which would rename
all of them.
"""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
import re
from typing import Any

from rclpy.parameter import Parameter
from sa_jitter_ros.nodes.parameters import command_line_parameters
from sa_jitter_ros.parameter_file import named_parameters

_RULE = re.compile(r'(?:(.*):)?__(?:node|name):=(.*)')


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


def given_parameters(node: str, args: Sequence[str], process: Sequence[str] = ()
                     ) -> list[Parameter]:
    """
    Return the parameters on a command line that rcl does not give to a node by itself.

    rcl lets the section of a node in a file win over `-p` for all nodes, and knows neither the
    section of a renamed node nor those of the names of its `process`. Without files rcl does all.
    """
    files = [Path(path) for option, path in pairwise(args) if option == '--params-file']
    rules = [_RULE.fullmatch(rule) for option, rule in pairwise(args)
             if option in ('-r', '--remap')]
    name = next((rule[2] for rule in rules if rule and rule[1] in (None, node)), node)
    found: dict[str, Any] = {}
    for names in (*([(node,), (name,)] if name != node else []), *([process] if process else [])):
        for path in files:
            found |= named_parameters(path, names)
    return ([Parameter(key, value=value) for key, value in found.items()]
            + command_line_parameters(args, (node, name) if found else ())) if files else []
