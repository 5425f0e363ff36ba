"""
Command `close_loop`: find what the declared jitter model lacks in recordings of a machine.

Observes the attenuation of every acquisition, compares it with what the declared model predicts
and, where more than chance is left, names the effect that makes it. Errors are those of
acquisitions that the fit has not seen.
"""

import argparse
from collections.abc import Sequence
import json
import os
from pathlib import Path
import sys
import tempfile
from typing import NoReturn

from sa_jitter_ros.closure.observation import observe
from sa_jitter_ros.closure.report import report, summary
from sa_jitter_ros.closure.trace import Trace, trace
from sa_jitter_ros.commands.declaration import read_declaration
from sa_jitter_ros.errors import SaJitterError
from sa_jitter_ros.recordings import open_recording


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        """Print what is wrong and exit with status 2."""
        self.exit(2, f'{self.prog}: {message}\n')


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
    return parser


def run(options: argparse.Namespace) -> Trace:
    """Observe and trace; raises SaJitterError."""
    def say(text: str) -> None:
        if not options.quiet:
            print(f'close_loop: {text}', file=sys.stderr, flush=True)

    recordings = [open_recording(path) for path in options.recordings]
    declaration = read_declaration(options.declared, sample_rate=recordings[0].sample_rate)
    for name in declaration.unknown:
        print(f'close_loop: {options.declared}: {name} is no parameter of jitter_predictor, '
              'ignored', file=sys.stderr)
    observations = []
    for path, recording in zip(options.recordings, recordings):
        say(f'observing {path}')
        observations.append(observe(
            recording, declaration.model,
            sources=observations[0].sources.tolist() if observations else ()))
        say(f'{len(observations[-1].acquisitions)} acquisitions of '
            f'{declaration.model.trigger_cycles} trigger cycles')
    return trace(observations, recordings, declared=declaration.effects, progress=say)


def write(folder: Path, name: str, content: str) -> None:
    """Write a file wholly or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=folder, prefix=f'.{name}.')
    try:
        with os.fdopen(handle, 'w', encoding='utf-8') as file:
            file.write(content)
        os.chmod(temporary, 0o644)
        os.replace(temporary, folder / name)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def main(args: Sequence[str] | None = None) -> int:
    """Close the loop off line; returns the exit status."""
    options = make_parser().parse_args(args)
    try:
        found = run(options)
        content = report(found, recordings=[str(path) for path in options.recordings])
        write(options.output, 'report.json', json.dumps(content, indent=1, allow_nan=False) + '\n')
    except (SaJitterError, OSError) as error:
        print(f'close_loop: {" ".join(str(error).split())}', file=sys.stderr)
        return 2
    print(summary(content))
    print(f'report: {options.output / "report.json"}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
