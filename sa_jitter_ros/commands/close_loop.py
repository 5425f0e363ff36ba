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
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
import sys

from sa_jitter_ros.commands.command_line import (
    add_recording_options, Parser, plain_warnings, read_options, require_writable, show)
from sa_jitter_ros.declaration import read_declaration
from sa_jitter_ros.errors import ParameterError, SaJitterError
from sa_jitter_ros.loop import close_loop, Loop
from sa_jitter_ros.parameter_file import read_parameters
from sa_jitter_ros.recordings import read, Recording


def make_parser() -> Parser:
    """Return the parser of the command line."""
    parser = Parser(prog='close_loop', description=__doc__,
                    formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('recordings', type=Path, nargs='+', metavar='RECORDING',
                        help='recordings of one machine: .npz, .mat, .wav, .csv or rosbag2')
    parser.add_argument('--declared', '--params', type=Path, required=True, metavar='MODEL.yaml',
                        help='ROS parameter file of jitter_predictor, or of the whole machine')
    parser.add_argument('--output', type=Path, required=True, metavar='DIR',
                        help='folder for report.json, report.html and the figures')
    parser.add_argument('--quiet', action='store_true', help='show no progress')
    add_recording_options(parser)
    return parser


def run(options: argparse.Namespace) -> Loop:
    """Close the loop on the recordings; raises SaJitterError."""
    def progress(text: str) -> None:
        if not options.quiet:
            print(f'close_loop: {text}', file=sys.stderr, flush=True)

    recordings = [_on_target(read(path, **read_options(options)), options.declared)
                  for path in options.recordings]
    declaration = read_declaration(options.declared, sample_rate=recordings[0].sample_rate)
    if declaration.unknown:
        print(f'close_loop: {options.declared}: ignored, because jitter_predictor has no such '
              f'parameters: {", ".join(declaration.unknown)}', file=sys.stderr)
    return close_loop(recordings, declaration, names=[str(path) for path in options.recordings],
                      progress=progress)


def _on_target(recording: Recording, params: Path) -> Recording:
    """Return a recording with the missing teeth that the machine file gives to the averager."""
    try:
        averager = read_parameters(params, 'synchronous_averager')
    except ParameterError:  # a file for jitter_predictor only
        return recording
    target = {name: averager[name] for name in ('pulses_per_revolution', 'missing_teeth')
              if name in averager}
    return recording if recording.missing_teeth or not target.get('missing_teeth') else replace(
        recording, **target)


def main(args: Sequence[str] | None = None) -> int:
    """Close the loop off line; return the exit status."""
    options = make_parser().parse_args(args)
    try:
        require_writable(options.output)
        with plain_warnings('close_loop'):
            found = run(options)
        found.write(options.output)
    except (SaJitterError, OSError) as error:
        print(f'close_loop: {" ".join(str(error).split())}', file=sys.stderr)
        return 2
    return show('close_loop', found, f'report: {options.output / "report.html"}')


if __name__ == '__main__':
    sys.exit(main())
