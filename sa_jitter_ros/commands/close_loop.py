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
Command `close_loop`: find which effects the declared jitter model of a machine lacks.

It compares the attenuation that recordings show with the one that the declared model predicts. If
the residual is significant, it finds the effect that causes it. Errors are those of acquisitions
that were not used for fitting.

Several recordings are those of one machine and make one report. With a folder, --jobs or
--scheduler each recording makes a report of its own, in a folder, with a row in loops.csv;
recordings that were finished before are skipped.
"""

from collections.abc import Sequence
from pathlib import Path
import sys

from sa_jitter_ros.commands.command_line import (
    add_fleet_options, add_work_options, few_collections, FORMATS, Parser)
from sa_jitter_ros.commands.progress import Progress


def make_parser() -> Parser:
    """Return the parser of the command line."""
    parser = Parser('close_loop', __doc__)
    parser.add_argument('recordings', type=Path, nargs='+', metavar='RECORDING',
                        help=f'recordings of one machine: {FORMATS}; or folders of recordings')
    parser.add_argument('--declared', '--params', type=Path, required=True, metavar='MODEL.yaml',
                        help='ROS parameter file of jitter_predictor, or of the whole machine')
    parser.add_argument('--output', type=Path, required=True, metavar='DIR',
                        help='folder for report.json, report.html and the figures')
    add_fleet_options(parser)
    add_work_options(parser)
    return parser


@few_collections()
def main(args: Sequence[str] | None = None) -> int:
    """Close the loop off line; return the exit status."""
    options = make_parser().parse_args(args)
    progress = Progress('close_loop', quiet=options.quiet)
    with progress.ticking():  # what does the work takes a second to load
        from sa_jitter_ros.commands.loop_run import is_fleet, show_fleet, show_report
    return (show_fleet if is_fleet(options) else show_report)(options, progress)


if __name__ == '__main__':
    sys.exit(main())
