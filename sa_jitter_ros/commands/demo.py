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
Command `demo`: the whole chain as separate processes over DDS, with progress, table and figures.

It plays a recording, or a simulated gearbox, through tach detector, averager and predictor, and
compares the measured with the predicted attenuation.
"""

import argparse
from collections.abc import Mapping, Sequence
from functools import partial
import os
from pathlib import Path
import signal
import subprocess
import sys
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from sa_jitter_ros.averaging.indicators import GearSettings
from sa_jitter_ros.averaging.results import AverageMessage
from sa_jitter_ros.commands.command_line import (
    add_recording_options, FORMATS, Parser, player_options, read_options, run_to_end)
from sa_jitter_ros.commands.demo_plan import (
    Plan, plan_doubts, plan_recording, plan_simulation, with_machine)
from sa_jitter_ros.commands.progress import Progress
from sa_jitter_ros.errors import SaJitterError
from sa_jitter_ros.keyphasor_check.machine_file import on_target
from sa_jitter_ros.nodes.base import LATCHED_QOS, RESULT_QOS
from sa_jitter_ros.nodes.messages import decode_average, decode_prediction, PredictionMessage
from sa_jitter_ros.offline.average_figures import on_strongest, strongest_lines
from sa_jitter_ros.offline.figures import write_figures
from sa_jitter_ros.offline.files import ARRAYS, Signals, TABLE, write_averages
from sa_jitter_ros.offline.series import ShaftCollector, ShaftSeries
from sa_jitter_ros.offline.settings import MachineFile
from sa_jitter_ros.parameter_file import shipped
from sa_jitter_ros.recordings import read
from sa_jitter_ros.recordings.channel_check import usable_channels
from sa_jitter_ros.whole_files import finished_together
from std_msgs.msg import Float64, Float64MultiArray

# The timeouts end a demo that hangs; a busy computer needs tens of seconds to start the nodes.
START_TIMEOUT = 120.0  # s until the nodes have found each other
SILENCE_TIMEOUT = 60.0  # s without a status of the node that plays, or of the one that averages
STOP_TIMEOUT = 20.0  # s until a node has ended
LAST_AVERAGE = 3.0  # s after the last average in which the averager reports no other
PULSE_BLOCKS = 'std_msgs/Float64MultiArray'  # a waveform may contain thousands of pulses a second
# Topics of a shaft, and those without which an average is not complete.
RESULTS = ('synchronous_average', 'standard_error', 'order_amplitude', 'corrected_average',
           'pulse_error', 'condition_indicator')
NEEDED = {'synchronous_average', 'standard_error', 'order_amplitude'}
LIVE_ACQUISITIONS = 4  # averages in a residual
# Columns of the table, and mean, 5 % and 95 % quantile of a prediction.
_FIELDS = ('raw_amplitude', 'corrected_amplitude', 'noise_standard_deviation', 'attenuation')
_PREDICTED = [1, 4, 6]

Results = Sequence[Mapping[str, AverageMessage]]


class Watcher(Node):
    """Receives all results of one shaft and the diagnostics of all nodes."""

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__('demo', **node_kwargs)
        self.results: dict[str, dict[tuple[int, float], dict[str, AverageMessage]]] = {}
        self.predictions: dict[str, PredictionMessage] = {}
        self.speed = float('nan')
        self.status: dict[str, dict[str, str]] = {}
        self.status_time: dict[str, float] = {}
        self.create_subscription(Float64, 'shaft_speed', self._on_speed, RESULT_QOS)
        self.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)

    def subscribe(self, shafts: Sequence[str]) -> None:
        """Receive the results of the shafts."""
        for shaft in shafts:
            self.results[shaft] = {}
            for kind in RESULTS:
                self.create_subscription(Float64MultiArray, f'{shaft}/{kind}',
                                         partial(self._on_result, shaft, kind), RESULT_QOS)
        for shaft, topic in ((shafts[0], 'prediction'),  # of one shaft
                             *((shaft, f'{shaft}/prediction') for shaft in shafts)):
            self.create_subscription(Float64MultiArray, topic, partial(
                self._on_prediction, shaft), LATCHED_QOS)

    def _on_result(self, shaft: str, kind: str, message: Float64MultiArray) -> None:
        result = decode_average(kind, message)
        key = result.header.sequence, result.header.start_time
        self.results[shaft].setdefault(key, {})[kind] = result

    def _on_prediction(self, shaft: str, message: Float64MultiArray) -> None:
        self.predictions[shaft] = decode_prediction(message)

    def _on_speed(self, message: Float64) -> None:
        self.speed = message.data

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.status_time[status.name] = time.monotonic()
            self.status[status.name] = {
                'message': status.message, **{item.key: item.value for item in status.values}}

    def averages(self) -> dict[str, list[dict[str, AverageMessage]]]:
        """Return the averages of each shaft whose results have all come, in order."""
        return {shaft: [found[key] for key in sorted(found, key=lambda key: key[1])
                        if NEEDED <= found[key].keys()]
                for shaft, found in self.results.items()}

    def progress(self) -> str:
        """Return one line: speed, averages so far, dropped pulses and cycles, strongest orders."""
        dropped = {key: sum(int(values.get(key, 0)) for values in self.status.values())
                   for key in ('pulses_dropped', 'cycles_dropped')}
        averages = next(iter(self.averages().values()))
        parts = [f'speed {self.speed:8.3f} Hz', f'averages {len(averages):3d}',
                 *(f'{key.replace("_", " ")} {count}' for key, count in dropped.items())]
        if averages:
            table = averages[-1]['order_amplitude'].values
            channel = int(np.argmax(np.nansum(table[:, :, 1], axis=1)))
            strongest = np.argsort(-np.nan_to_num(table[channel, :, 1]))[:3]
            parts.append('strongest: ' + ', '.join(
                f'order {table[channel, i, 0]:g} {table[channel, i, 1]:.4g}' for i in strongest))
        return ' | '.join(parts)


def node_command(name: str, parameters: Mapping[str, object], params: Path | None = None
                 ) -> list[str]:
    """Return the command line of one of this package's nodes with parameters."""
    command = [sys.executable, '-c',
               f'from sa_jitter_ros.start import {name}; raise SystemExit({name}())',
               '--ros-args', '--log-level', 'warn',
               *(['--params-file', str(params)] if params else [])]
    for key, value in parameters.items():
        text = (f'[{", ".join(map(repr, value))}]' if isinstance(value, (list, tuple))
                else str(value))
        command += ['-p', f'{key}:={text.lower() if isinstance(value, bool) else text}']
    return command


def processes(plan: Plan, *, live: bool = False) -> dict[str, dict[str, object]]:
    """
    Return the nodes to start and their parameters beside those of the machine file.

    `live` adds the nodes of the web page, and lets the signals run without end.
    """
    nodes: dict[str, dict[str, object]] = {
        'synchronous_averager': {}, 'jitter_predictor': {},
        plan.source: {**plan.source_parameters, 'playing': False, 'wait_seconds': 60.0}}
    if plan.params is None:
        model = plan.model
        keyphasor = {name: getattr(model, name) for name in (
            'keyphasor_rate', 'trigger_cycles', 'pulses_per_revolution', 'pulses_per_trigger')}
        nodes['synchronous_averager'] = {
            **keyphasor, 'missing_teeth': plan.missing_teeth, 'maximum_discarded': 0.5,
            f'{plan.shaft}.ratio': model.ratio, f'{plan.shaft}.orders': model.orders,
            'correct_jitter': True}
        nodes['jitter_predictor'] = {
            **keyphasor, 'trigger_speed': model.trigger_speed, 'ratio': model.ratio,
            'orders': model.orders, 'follow_shaft_speed': True}
    if plan.source == 'machine_simulator':
        nodes[plan.source]['duration'] = 0.0 if live else plan.seconds
    elif live:
        nodes[plan.source]['loop'] = True
    if plan.waveform:
        # The declared jitter is that of a pulse time which is the first sample past the threshold.
        nodes['tach_detector'] = {'interpolate': False, 'tach_type': PULSE_BLOCKS}
        nodes['synchronous_averager']['tach_type'] = PULSE_BLOCKS
    if live:
        nodes['live_view'] = {'vibration_unit': repr(plan.unit), 'channel_names': plan.channels}
        nodes['residual_analyser'] = {'acquisitions': LIVE_ACQUISITIONS}
    for name in nodes.keys() - {plan.source}:
        # The nodes wait for each other first; unless live, the data end before the nodes.
        nodes[name]['stale_after'] = START_TIMEOUT if live else 0.0
    return nodes


def watch(plan: Plan, watcher: Watcher, executor: SingleThreadedExecutor,
          children: Sequence[subprocess.Popen[bytes]], *, live: bool = False) -> None:
    """
    Start the signals, print the progress, and return when the last average has come.

    Signals that are `live` do not end: return when all of the plan was played once.
    """
    def spin(seconds: float) -> None:
        end = time.monotonic() + seconds
        while (remaining := end - time.monotonic()) > 0.0:
            executor.spin_once(timeout_sec=remaining)
            ended = [child for child in children if child.poll() not in (None, 0)]
            if ended:
                raise SaJitterError(f'a node ended with status {ended[0].returncode}')

    watcher.subscribe(plan.shafts)
    print('waiting for the nodes ...', flush=True)
    end = time.monotonic() + START_TIMEOUT
    inputs = ['vibration', 'tach_pulse', *(['tach_waveform'] if plan.waveform else [])]
    source = AsyncParameterClient(watcher, plan.source)
    address = ''

    def ready() -> bool:
        # The source waits for its subscribers itself; the detector of its pulses cannot.
        heard = not plan.waveform or watcher.status.get('tach_detector', {}).get(
            'subscribers', '0') != '0'
        predicted = plan.shaft in watcher.predictions
        return (heard and predicted and source.services_are_ready() and all(
            watcher.count_subscribers(topic) and watcher.count_publishers(topic)
            for topic in inputs))

    while not ready() or (live and not address):
        spin(0.2)
        if time.monotonic() > end:
            raise SaJitterError(f'the nodes did not find each other within {START_TIMEOUT:g} s')
        if live and not address:
            address = watcher.status.get('live_view', {}).get('address', '')
            if address:
                print(f'open {address} in a web browser', flush=True)
    spin(1.0)  # the graph knows the nodes before they know each other
    source.set_parameters([Parameter('playing', value=True)])
    start = last = time.monotonic()
    count = 0
    while True:
        spin(1.0)
        print(watcher.progress(), flush=True)
        now = time.monotonic()
        received = sum(map(len, watcher.averages().values()))
        if received > count:
            last, count = now, received
        ended = watcher.status.get(plan.source, {}).get('message', '').startswith('ended')
        if live and now - start > plan.seconds + LAST_AVERAGE:
            break
        # an averager that is busy reports nothing
        played, heard = (watcher.status_time.get(name, start)
                         for name in (plan.source, 'synchronous_averager'))
        if (ended and heard - last > LAST_AVERAGE) or now - min(played, heard) > SILENCE_TIMEOUT:
            break


def stay(children: Sequence[subprocess.Popen[bytes]]) -> int:
    """Wait for Ctrl-C or SIGTERM, or the end of a node; return its status, 0 after a signal."""
    try:
        while not (ended := [child for child in children if child.poll() is not None]):
            time.sleep(0.5)
        return ended[0].returncode
    except KeyboardInterrupt:
        return 0


def stop(children: Sequence[subprocess.Popen[bytes]]) -> None:
    """
    Stop the nodes, one after the other.

    Fast DDS 2.14 may hang in the destruction of a participant while others disappear: a node that
    does not end is killed.
    """
    for child in children:
        child.terminate()
        try:
            child.wait(STOP_TIMEOUT)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()


def write_report(plan: Plan, watcher: Watcher, output: Path) -> None:
    """Print the table and write the files."""
    averages = watcher.averages()
    if not any(averages.values()):
        raise SaJitterError('no average was completed: ' + '; '.join(
            f'{name}: {values["message"]}' for name, values in watcher.status.items()))
    print('\n' + write_results(plan, averages, watcher.predictions, output))
    pulses = [item['pulse_error'].values[:, 1] for item in averages[plan.shaft]
              if 'pulse_error' in item]
    if pulses:
        std = np.sqrt(np.nanmean(np.concatenate(pulses) ** 2))
        declared = 1.0 / plan.model.keyphasor_rate / 12**0.5
        print(f'\nstandard deviation of the pulse errors: {1e6 * std:.3g} us recovered from the '
              f'vibration, {1e6 * declared:.3g} us declared')
    averager = watcher.status.get('synchronous_averager', {})
    refused = averager.get(f'{plan.shaft}.corrections_refused')
    if refused:
        print(f'note: the correction of {refused} averages was refused: '
              f'{averager[f"{plan.shaft}.refusal"]}')
    end = watcher.status.get(plan.source, {}).get('message', '')
    for note in (plan.note, end if end.startswith('ended early') else ''):
        if note:
            print(f'note: {note}')
    print(f'written: {ARRAYS}, {TABLE} and figures in {output}')


def write_results(plan: Plan, results: Mapping[str, Results],
                  predictions: Mapping[str, PredictionMessage], output: Path) -> str:
    """Write arrays, table and figures of all shafts, and return a table; raises OSError."""
    file = MachineFile.read(plan.params)
    machine = file.averager
    signals = Signals(plan.title, tuple(range(len(plan.channels))), plan.channels,
                      (plan.unit,) * len(plan.channels), file.machine)
    with finished_together(output, last=ARRAYS) as folder:
        series = []
        for shaft, averages in results.items():
            collector = ShaftCollector(shaft, folder.parent)
            for average in averages:
                collector.add(average)
            if averages:
                series.append(collector.series())
        write_averages(folder, signals, series, {})
        write_figures(folder, signals, series, {
            shaft: GearSettings(machine.get(f'{shaft}.mesh_orders', ()),
                                machine.get(f'{shaft}.sidebands', 1)) for shaft in results}, {
            shaft: item.values[:, _PREDICTED] for shaft, item in predictions.items()})
        return '\n\n'.join((f'shaft {item.shaft}\n' if len(series) > 1 else '')
                           + text_table(signals, item, predictions.get(item.shaft))
                           for item in series)


def text_table(signals: Signals, series: ShaftSeries, prediction: PredictionMessage | None) -> str:
    """Return a table of the orders: amplitude, attenuation, predicted attenuation."""
    channels = strongest_lines(series).tolist()
    names = [signals.channel_names[channel] for channel in channels]
    unit = f' [{signals.units[0]}]' if signals.units[0] else ''
    width = max(12, *map(len, names))
    columns = [np.ma.filled(np.ma.masked_invalid(on_strongest(series, name)).mean(axis=0), np.nan)
               for name in _FIELDS]
    lines = [f'{"order":>8} {"channel":>{width}} {"amplitude" + unit:>16} {"corrected":>10} '
             f'{"noise":>9} {"attenuation":>12} {"predicted mean [5 % .. 95 %]":>30}']
    for i, (raw, corrected, noise, attenuation) in enumerate(zip(*columns)):
        mean, low, high = [float('nan')] * 3 if prediction is None else (
            prediction.values[i, _PREDICTED])
        lines.append(
            f'{series.orders[i]:8g} {names[i]:>{width}} {raw:16.5g} {corrected:10.5g} '
            f'{noise:9.2g} {attenuation:12.4f} {mean:14.4f} [{low:.4f} .. {high:.4f}]')
    return '\n'.join(lines)


def _parser() -> Parser:
    """Return the parser of the options."""
    parser = Parser('demo', 'Average a recording, or a simulated gearbox, over ROS topics.')
    parser.add_argument('recording', nargs='?', type=Path,
                        help=f'{FORMATS}; without: a simulated gearbox')
    parser.add_argument('--keyphasor-rate', type=float, default=0.0, metavar='HZ',
                        help='round pulse times up to a clock of this rate, as if the keyphasor '
                        'had been sampled with it')
    parser.add_argument('--params', type=Path, metavar='MACHINE.yaml',
                        help='parameter file of the machine (for the simulated gearbox: '
                        'machine.yaml of this package)')
    parser.add_argument('--live', action='store_true',
                        help='show all results live on a web page, until Ctrl-C')
    parser.add_argument('--output', type=Path, default=Path('out'),
                        help='folder for arrays, table and figures (out)')
    add_recording_options(parser)
    return parser


def planned(options: argparse.Namespace) -> Plan:
    """Return the plan, and say what is doubtful; raises SaJitterError."""
    if not options.recording:
        return plan_simulation(options.params or shipped('machine.yaml'))
    recording, remarks = usable_channels(read(options.recording, **read_options(options)))
    if options.params:
        recording = on_target(recording, options.params)
    plan = plan_recording(options.recording, recording, keyphasor_rate=options.keyphasor_rate,
                          parameters=player_options(options))
    if options.params:
        plan = with_machine(plan, options.params)
    for remark in (*remarks, *plan_doubts(plan, recording)):
        print(f'warning: {remark}', flush=True)
    return plan


def run(options: argparse.Namespace, progress: Progress) -> int:
    """Play, average, predict and write the files; raises SaJitterError, OSError."""
    plan = planned(options)
    options.output.mkdir(parents=True, exist_ok=True)
    model = plan.model
    print(f'{plan.title}: {plan.seconds:.3g} s, {len(plan.channels)} channels, '
          f'{model.trigger_speed:.4g} Hz, {model.trigger_cycles} trigger cycles per average')
    if not options.live:
        print('to watch it live in a web browser: ./run demo --live')
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    children: list[subprocess.Popen[bytes]] = []
    context = rclpy.Context()
    try:
        rclpy.init(context=context)
        watcher = Watcher(context=context)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(watcher)
        children += [subprocess.Popen(node_command(name, parameters, plan.params))
                     for name, parameters in processes(plan, live=options.live).items()]
        watch(plan, watcher, executor, children, live=options.live)
        write_report(plan, watcher, options.output)
        if options.live:
            watcher.destroy_node()  # it would keep all results
            print('the machine runs on and the page stays until Ctrl-C', flush=True)
            if ended := stay(children):
                raise SaJitterError(f'a node ended with status {ended}')
    finally:
        stop(children)
        context.try_shutdown()
    return 0


def main(args: Sequence[str] | None = None) -> int:
    """Run the demo; return 0, or 2 after one line on unusable input or output."""
    options = _parser().parse_args(args)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job ignores it
    return run_to_end(run, lambda options, status: status, options, Progress('demo'))


if __name__ == '__main__':
    raise SystemExit(main())
