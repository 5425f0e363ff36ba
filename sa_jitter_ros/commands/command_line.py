# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Command lines: a parser with errors of one line, and the options of commands for recordings."""

import argparse
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
import gc
from io import UnsupportedOperation
import os
from pathlib import Path
import signal
import sys
import tempfile
from typing import Any, NoReturn, TypeVar
import warnings

from sa_jitter_ros.commands.progress import Progress
from sa_jitter_ros.errors import one_line, ParameterError, SaJitterError
from sa_jitter_ros.nodes.lifetime import in_main_thread
from sa_jitter_ros.nodes.linear_algebra import use_one_thread
from sa_jitter_ros.offline.settings import AVERAGER, section
from sa_jitter_ros.parameters import Parameter
from sa_jitter_ros.recordings.channel_units import channels_of
from sa_jitter_ros.recordings.fields import fields_of
from sa_jitter_ros.recordings.reading import READ_PARAMETERS
from sa_jitter_ros.tacholess.recording import Tacholess

Found = TypeVar('Found')

FORMATS = '.npz, .mat, .wav, .csv, .tdms, .mf4, .uff or rosbag2'
_METAVARS = {int: 'N', float: 'X', str: 'NAME'}
_OBJECTS = 1_000_000  # new ones after which Python looks for garbage, as a rule 700


class Parser(argparse.ArgumentParser):
    """An argument parser with a text of its own lines, whose errors are one line."""

    def __init__(self, prog: str | None = None, description: str | None = None, **others: Any
                 ) -> None:
        super().__init__(prog, description=description,
                         formatter_class=argparse.RawDescriptionHelpFormatter, **others)

    def error(self, message: str) -> NoReturn:
        """Print the error and exit with status 2."""
        self.exit(2, f'{self.prog}: {message}\n')


def show(program: str, *lines: object) -> int:
    """
    Print the result of a command and return its exit status: 2 after one line if that fails.

    A reader that has seen enough, as `head`, is no failure.
    """
    try:
        print(*lines, sep='\n', flush=True)
    except BrokenPipeError:
        discard_output()
    except OSError as error:
        discard_output()
        print(f'{program}: standard output: {error.strerror}', file=sys.stderr)
        return 2
    return 0


def run_to_end(run: Callable[[argparse.Namespace, Progress], Found],
               tell: Callable[[argparse.Namespace, Found], int],
               options: argparse.Namespace, progress: Progress, *,
               stopped: str = 'stopped') -> int:
    """
    Run what finds something and writes into `options.output`, and `tell` it; return the status.

    It is 2 after one line for what cannot be used or written, 130 for SIGINT and SIGTERM, which
    only the main thread handles.
    """
    use_one_thread()
    before = signal.getsignal(signal.SIGTERM)
    if in_main_thread():
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        require_writable(options.output)
        found = run(options, progress)
    except OSError as error:
        if error.filename is None:
            discard_output()  # it may be what cannot be written
        progress.say(f'{error.filename or options.output}: {error.strerror}: make room, or give '
                     'another folder; what was finished stays' if error.strerror else str(error))
        return 2
    except SaJitterError as error:
        progress.say(one_line(error))
        return 2
    except KeyboardInterrupt:
        progress.say(stopped)
        return 130
    finally:
        if in_main_thread():
            signal.signal(signal.SIGTERM, before)
    return tell(options, found)


def discard_output() -> None:
    """Discard what could not be printed, which Python would try to print once more at its end."""
    with suppress(UnsupportedOperation):  # a test has replaced it by a buffer
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@contextmanager
def few_collections() -> Iterator[None]:
    """
    Let Python look for garbage less often.

    Packages and figures are many objects that stay: to look at all of them again and again is a
    tenth of the time that a command takes.
    """
    before = gc.get_threshold()
    gc.set_threshold(_OBJECTS, *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)


@contextmanager
def plain_warnings(program: str) -> Iterator[None]:
    """Print warnings as lines of a program, without the place in its source."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter('always', UserWarning)
        try:
            yield
        finally:
            for item in caught:
                print(f'{program}: warning: {one_line(item.message)}', file=sys.stderr)


def require_writable(folder: Path) -> None:
    """Raise ParameterError for a folder that cannot be made or written, before the work begins."""
    place = folder.absolute()
    while not place.exists():
        place = place.parent
    if not place.is_dir():
        raise ParameterError(f'--output {folder}: {place} is a file: give a folder')
    try:
        with tempfile.TemporaryDirectory(dir=place):
            pass
    except OSError as error:
        raise ParameterError(f'--output {folder}: cannot write in {place} ({error.strerror}): '
                             'give another folder') from None


def option_of(name: str) -> str:
    """Return the option of a parameter."""
    return f'--{name.replace("_", "-")}'


def add_parameters(parser: Any, parameters: Iterable[Parameter]) -> None:
    """Add options that are parameters of nodes, too; None where they are not given."""
    for item in parameters:
        parser.add_argument(
            option_of(item.name), type=item.kind, nargs='+' if item.is_list else None,
            choices=item.choices or None, help=item.description.replace('%', '%%'),
            metavar=None if item.choices else item.unit.upper() or _METAVARS[item.kind])


def add_recording_options(parser: argparse.ArgumentParser) -> None:
    """Add the options for fields and channels."""
    parser.add_argument('--field', action='append', default=[], dest='fields',
                        metavar='NAME=KEY|VALUE',
                        help='field of the recording: the key that the file has for it '
                        '(pulse_times=tach), or its value (sample_rate=97656, orders=20,40); '
                        'may be repeated')
    group = parser.add_argument_group('what is read, if the file does not say it')
    add_parameters(group, READ_PARAMETERS)


def add_tacholess_options(parser: argparse.ArgumentParser) -> None:
    """Add the options for recordings without a tach, or whose tach was lost for a while."""
    group = parser.add_argument_group('without a tach')
    group.add_argument('--tacholess', type=float, nargs=2, metavar=('LOW', 'HIGH'),
                       help='find the pulses in the vibration: speed of the tach shaft between '
                       'LOW and HIGH, Hz')
    group.add_argument('--comb', type=float, nargs='+', default=(), metavar='ORDER',
                       help='orders of the tach shaft at which the machine has lines (default: '
                       'those of the machine, or of the recording)')
    group.add_argument('--bridge-tach', action='store_true',
                       help='keep the pulses of the tach, and find only those that it lost')


def add_work_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of all commands that work on recordings."""
    parser.add_argument('--quiet', action='store_true', help='show no progress')
    add_tacholess_options(parser)
    add_recording_options(parser)


def tacholess_options(options: argparse.Namespace) -> Tacholess | None:
    """Return how pulses are found, None where they are those of the tach."""
    if options.tacholess is None:
        if options.comb or options.bridge_tach:
            raise ParameterError('--comb and --bridge-tach belong to --tacholess LOW HIGH: give '
                                 'it')
        return None
    return Tacholess(tuple(options.tacholess), tuple(options.comb), options.bridge_tach)


def add_fleet_options(parser: argparse.ArgumentParser) -> None:
    """Add the options for many recordings: `jobs`, None if not given, and `scheduler`."""
    group = parser.add_argument_group('many recordings')
    group.add_argument('--jobs', type=whole_from(1), metavar='N',
                       help='recordings at a time, each in a process of its own (1)')
    group.add_argument('--scheduler', default='', metavar='tcp://HOST:PORT',
                       help='Dask cluster whose workers do it; they must see the same files')


def whole_from(least: int) -> Callable[[str], int]:
    """Return what reads a whole number from the least on; argparse says which option is wrong."""
    def read(text: str) -> int:
        if not (text.isdecimal() and int(text) >= least):
            raise argparse.ArgumentTypeError(f'{text!r}: give a whole number, {least} or more')
        return int(text)
    return read


def read_options(options: argparse.Namespace) -> dict[str, Any]:
    """Return the options that were given, as keywords of `read`; raises ParameterError."""
    params = getattr(options, 'params', None) or getattr(options, 'declared', None)
    channels = channels_of(section(params, AVERAGER))
    return {**_given(options), **fields_of(options.fields),
            **({'channels': channels} if channels else {})}


def player_options(options: argparse.Namespace) -> dict[str, Any]:
    """Return the options that were given, as parameters of the recording player."""
    return {**_given(options), **({'fields': options.fields} if options.fields else {})}


def _given(options: argparse.Namespace) -> dict[str, Any]:
    return {item.name: value for item in READ_PARAMETERS if (value := getattr(options, item.name))}
