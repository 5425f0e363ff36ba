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
Command `check_keyphasor`: what the keyphasor of a recording is, and what is wrong with it.

Hardly anything need be declared. The command finds the unit of the pulse times, the clock that
timed them, the marks of the target, strays and lost pulses, the jitter, the speed, and the orders
of the vibration. It says what each finding costs, and writes a parameter file for all nodes.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
import sys
from typing import Any

import numpy as np
from sa_jitter_ros.commands.check_keyphasor_figure import check_figure
from sa_jitter_ros.commands.command_line import (
    add_work_options, FORMATS, Parser, read_options, run_to_end, show, tacholess_options)
from sa_jitter_ros.commands.progress import Progress
from sa_jitter_ros.declaration import NODE, read_declaration
from sa_jitter_ros.json_values import json_text
from sa_jitter_ros.keyphasor_check.check import check_keyphasor
from sa_jitter_ros.keyphasor_check.machine_file import machine_file
from sa_jitter_ros.keyphasor_check.result import KeyphasorCheck
from sa_jitter_ros.machine import Machine
from sa_jitter_ros.offline.repairs_figure import write_repairs
from sa_jitter_ros.parameter_file import read_parameters
from sa_jitter_ros.recordings import read


def make_parser() -> Parser:
    """Return the parser of the command line."""
    parser = Parser('check_keyphasor', __doc__)
    parser.add_argument('recording', type=Path, metavar='RECORDING',
                        help=f'{FORMATS}; a .npz or .mat with pulse times only is examined '
                        'without vibration')
    parser.add_argument('--output', type=Path, required=True, metavar='DIR',
                        help='folder for keyphasor.json, machine.yaml and the figures')
    parser.add_argument('--teeth', type=int, nargs='+', default=(), metavar='N',
                        help='numbers of teeth of gears in the machine, to find the ratio')
    parser.add_argument('--params', type=Path, metavar='MACHINE.yaml',
                        help='parameter file of the machine: ratio, orders and pulses per '
                        'revolution of its first shaft, and its parts, which are checked')
    add_work_options(parser)
    return parser


def _machine_fields(params: Path | None) -> dict[str, Any]:
    """Return what a machine file says of recordings, as keywords of `read`; raises ModelError."""
    if params is None:
        return {}
    declaration = read_declaration(params)
    shaft, model = next(iter(declaration.models.items()))
    names = {order: declaration.machine.name_of(shaft, order) for order in model.orders}
    fields = {'ratio': model.ratio, 'orders': tuple(  # a sideband need not stand above the noise
        order for order, name in names.items() if ' -1 ' not in name and ' +1 ' not in name),
              'pulses_per_revolution': model.pulses_per_revolution}
    return fields | ({'pulses_per_trigger': model.pulses_per_trigger}
                     if model.pulses_per_trigger else {})


def run(options: argparse.Namespace, progress: Progress) -> tuple[KeyphasorCheck, list[str]]:
    """Check the recording and write all files; return their names, too; raises SaJitterError."""
    declared = {} if options.params is None else read_parameters(options.params, NODE)
    recording = read(options.recording, pulses_suffice=True,
                     **{**_machine_fields(options.params), **read_options(options)})
    machine, output = Machine.among(declared), options.output
    if tacholess := tacholess_options(options):
        recording, _ = tacholess.pulses_of(recording, machine)
    for remark in recording.remarks:
        progress.step(remark)
    found = check_keyphasor(recording, teeth=options.teeth, machine=machine,
                            progress=progress.step)
    name, fitted = options.recording.name, found.fitted
    output.mkdir(parents=True, exist_ok=True)
    (output / 'keyphasor.json').write_text(json_text(found.report), encoding='utf-8')
    (output / 'machine.yaml').write_text(machine_file(found, name, declared), encoding='utf-8')
    check_figure(found, name).savefig(output / 'keyphasor.png', dpi=110)
    repaired = write_repairs(
        output, name, recording,
        np.union1d(fitted.true, fitted.strays),
        [*((time, 'early') for time in fitted.strays.tolist()),
         *((time, 'missing') for time in fitted.lost.tolist())])
    return found, ['keyphasor.json', 'machine.yaml', 'keyphasor.png', *['repairs.png'] * repaired]


def tell(options: argparse.Namespace, written: tuple[KeyphasorCheck, list[str]]) -> int:
    """Say what was found, and the names of the files."""
    found, names = written
    files = ', '.join(str(options.output / name) for name in names)
    return show('check_keyphasor', found, f'written: {files}')


def main(args: Sequence[str] | None = None) -> int:
    """Check a keyphasor; return 0, or 2 after one line on unusable input or output."""
    options = make_parser().parse_args(args)
    return run_to_end(run, tell, options, Progress('check_keyphasor', quiet=options.quiet))


if __name__ == '__main__':
    sys.exit(main())
