"""
Command `close_loop`: find what the declared jitter model lacks in recordings of a machine.

Observes the attenuation of every acquisition, compares it with what the declared model predicts
and, where more than chance is left, names the effect that makes it. Errors are those of
acquisitions that the fit has not seen.
"""

import argparse
from collections.abc import Mapping, Sequence
import json
import os
from pathlib import Path
import sys
import tempfile

from sa_jitter_ros.closure.html_report import report_files
from sa_jitter_ros.closure.observation import Observation, observe
from sa_jitter_ros.closure.report import summary
from sa_jitter_ros.closure.trace import Trace, trace
from sa_jitter_ros.commands.declaration import read_declaration
from sa_jitter_ros.commands.parser import Parser
from sa_jitter_ros.commands.recording_options import add_recording_options, open_with
from sa_jitter_ros.errors import SaJitterError


def make_parser() -> Parser:
    """Return the parser of the command line."""
    parser = Parser(prog='close_loop', description=__doc__,
                    formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('recordings', type=Path, nargs='+', metavar='RECORDING',
                        help='recordings of one machine: .npz, .mat, .wav, .csv or rosbag2')
    parser.add_argument('--declared', type=Path, required=True, metavar='MODEL.yaml',
                        help='ROS parameter file of jitter_predictor')
    parser.add_argument('--output', type=Path, required=True, metavar='DIR',
                        help='folder for report.json, report.html and the figures')
    parser.add_argument('--quiet', action='store_true', help='show no progress')
    add_recording_options(parser)
    return parser


def run(options: argparse.Namespace) -> Trace:
    """Observe and trace; raises SaJitterError."""
    def say(text: str) -> None:
        if not options.quiet:
            print(f'close_loop: {text}', file=sys.stderr, flush=True)

    recordings = [open_with(options, path) for path in options.recordings]
    declaration = read_declaration(options.declared, sample_rate=recordings[0].sample_rate)
    for name in declaration.unknown:
        print(f'close_loop: {options.declared}: {name} is no parameter of jitter_predictor, '
              'ignored', file=sys.stderr)
    observations: list[Observation] = []
    for path, recording in zip(options.recordings, recordings):
        say(f'observing {path}')
        observations.append(observe(
            recording, declaration.model,
            sources=observations[0].sources.tolist() if observations else ()))
        say(f'{len(observations[-1].acquisitions)} acquisitions of '
            f'{declaration.model.trigger_cycles} trigger cycles')
    return trace(observations, recordings, declared=declaration.effects, progress=say)


def write(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write all files or none: they are complete before the first gets its name."""
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder, prefix='.close_loop.') as temporary:
        for name, content in files.items():
            (Path(temporary) / name).write_bytes(content)
        for name in files:
            os.replace(Path(temporary) / name, folder / name)


def main(args: Sequence[str] | None = None) -> int:
    """Close the loop off line; returns the exit status."""
    options = make_parser().parse_args(args)
    try:
        found = run(options)
        files = report_files(found, recordings=[str(path) for path in options.recordings])
        write(options.output, files)
    except (SaJitterError, OSError) as error:
        print(f'close_loop: {" ".join(str(error).split())}', file=sys.stderr)
        return 2
    print(summary(json.loads(files['report.json'])))
    print(f'report: {options.output / "report.html"}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
