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
Command `reproduce`: every numerical result of the paper, beside what this package gives.

Writes validation.md, validation.json and figures/validation-*.png; progress goes to stderr.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
import shlex
import sys
import time

from sa_jitter_ros.commands.command_line import Parser
from sa_jitter_ros.errors import ParameterError, SaJitterError
from validation import (
    analytic_approximation, angle_laws, bench_spectrum, fleet, multi_harmonic, parametric_study,
    printed_equations, pulse_acceptance, residual_kurtosis, single_harmonic)
from validation.report import write
from validation.results import Effort, FULL, Progress, QUICK

GROUPS = (printed_equations, single_harmonic, pulse_acceptance, multi_harmonic,
          analytic_approximation, parametric_study, bench_spectrum, angle_laws, residual_kurtosis,
          fleet)
_FEWEST = {'iterations': 1000, 'simulations': 2}


def make_parser() -> Parser:
    """Return the parser of the command line."""
    parser = Parser('reproduce', __doc__)
    parser.add_argument('--output', type=Path, default=Path('validation'), metavar='DIR',
                        help='folder to write into, made if missing (validation)')
    parser.add_argument('--quick', action='store_true',
                        help='few draws: a try-out in seconds, not a validation')
    parser.add_argument('--iterations', type=int, metavar='N',
                        help=f'draws of a numerical model ({FULL.iterations}; paper 1000000)')
    parser.add_argument('--simulations', type=int, metavar='N',
                        help=f'full simulations of a case ({FULL.simulations}; paper 10000)')
    return parser


def chosen_effort(options: argparse.Namespace) -> Effort:
    """Return how much is to be computed; raises ParameterError."""
    effort = QUICK if options.quick else FULL
    for name, fewest in _FEWEST.items():
        value = getattr(options, name)
        if value is None:
            continue
        if value < fewest:
            raise ParameterError(f'--{name} is {value}: give at least {fewest}')
        effort = replace(effort, **{name: value})
    return effort


def show(number: int, title: str) -> Progress:
    """Return a function that shows the progress of a group on stderr, a line every tenth."""
    shown = -1

    def progress(done: float) -> None:
        nonlocal shown
        if int(10.0 * done) > shown:
            shown = int(10.0 * done)
            print(f'reproduce: {number}/{len(GROUPS)} {title}: {10 * shown} %', file=sys.stderr)

    return progress


def main(args: Sequence[str] | None = None) -> int:
    """Reproduce the paper; returns the exit status."""
    arguments = sys.argv[1:] if args is None else list(args)
    options = make_parser().parse_args(arguments)
    begin = time.monotonic()
    try:
        effort = chosen_effort(options)
        options.output.mkdir(parents=True, exist_ok=True)
        results = {}
        for number, group in enumerate(GROUPS, start=1):
            name = group.__name__.rpartition('.')[2]
            results[name] = group.run(effort, show(number, name.replace('_', ' ')))
        write(results, effort, shlex.join(['python', '-m', 'validation.reproduce',
                                           *arguments]), options.output)
    except (SaJitterError, OSError) as error:
        print(f'reproduce: {error}', file=sys.stderr)
        return 2
    for group in results.values():
        for finding in group.findings:
            print(f'{finding.agreement:7} {finding.item}: {finding.paper}')
    print(f'\n{options.output / "validation.md"}, made in {time.monotonic() - begin:.0f} s')
    return 0


if __name__ == '__main__':
    sys.exit(main())
