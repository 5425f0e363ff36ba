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
Command `chain`: averager, predictor and analyser in one process and one executor.

It needs a third of the memory of three processes. Arguments behind --ros-args are those of ROS 2;
the nodes keep their names where one is given to the chain, whose section in a file is for all.
"""

from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
import sys

from sa_jitter_ros.commands.command_line import Parser
from sa_jitter_ros.nodes.base import run_nodes
from sa_jitter_ros.nodes.parameters import common_name

NODES = ('synchronous_averager', 'jitter_predictor', 'residual_analyser')
OTHERS = ('change_monitor', 'live_view', 'tach_detector')


def make_parser() -> Parser:
    """Return the parser of the command line."""
    parser = Parser('chain', __doc__)
    parser.add_argument('--params', type=Path, metavar='MACHINE.yaml',
                        help='parameter file of all nodes')
    parser.add_argument('--with', dest='others', nargs='+', choices=OTHERS, default=(),
                        metavar='NODE', help=f'further nodes: {", ".join(OTHERS)}')
    return parser


def main(args: Sequence[str] | None = None) -> int:
    """Run the nodes until SIGINT or SIGTERM; return the exit status."""
    given = list(sys.argv[1:] if args is None else args)
    split = given.index('--ros-args') if '--ros-args' in given else len(given)
    options = make_parser().parse_args(given[:split])
    file = ['--params-file', str(options.params)] if options.params else []
    classes = [getattr(import_module(f'sa_jitter_ros.nodes.{name}'),
                       name.title().replace('_', ''))
               for name in dict.fromkeys((*NODES, *options.others))]
    ros, name = common_name(given[split + 1:])  # three nodes of one name are none
    return run_nodes(classes, ['--ros-args', *file, *ros], process=('chain', name or 'chain'))


if __name__ == '__main__':
    sys.exit(main())
