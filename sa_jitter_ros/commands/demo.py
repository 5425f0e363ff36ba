"""
The demo: the whole chain as separate processes over DDS, live progress, a table and figures.

Plays a recording, or a simulated gearbox without one, through tach detector, averager and
predictor, and compares what comes out with what was predicted.
"""

from collections.abc import Sequence
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

import rclpy
from rclpy.executors import SingleThreadedExecutor
from sa_jitter_ros.commands.demo_plan import Plan, plan_recording, SIMULATED
from sa_jitter_ros.commands.demo_report import draw_orders, draw_waveform, text_table
from sa_jitter_ros.commands.demo_watcher import Watcher
from sa_jitter_ros.commands.parser import Parser
from sa_jitter_ros.commands.recording_options import add_recording_options, read_options
from sa_jitter_ros.errors import SaJitterError
from sa_jitter_ros.recordings import read

START_TIMEOUT = 30.0  # s for discovery
PULSE_BLOCKS = 'std_msgs/Float64MultiArray'  # a waveform may hold thousands of pulses a second
LIVE_ACQUISITIONS = 4  # averages in a residual
QUIET = 3.0  # s without a new average after the source has ended


def node_command(name: str, parameters: dict[str, object]) -> list[str]:
    """Command line of one of this package's nodes with parameters."""
    command = [sys.executable, '-c',
               f'from sa_jitter_ros.nodes.{name} import main; raise SystemExit(main())',
               '--ros-args', '--log-level', 'warn']
    for key, value in parameters.items():
        text = (f'[{", ".join(map(repr, value))}]' if isinstance(value, (list, tuple))
                else str(value))
        command += ['-p', f'{key}:={text.lower() if isinstance(value, bool) else text}']
    return command


def processes(plan: Plan, *, live: bool = False) -> dict[str, dict[str, object]]:
    """Nodes to start and their parameters; with `live` those that are only for eyes, too."""
    nodes: dict[str, dict[str, object]] = {
        'synchronous_averager': {
            'pulses_per_revolution': plan.pulses_per_revolution,
            'pulses_per_trigger': plan.pulses_per_trigger,
            'trigger_cycles': plan.trigger_cycles, 'shaft.ratio': plan.ratio,
            'shaft.orders': plan.orders, 'correct_jitter': True,
            'keyphasor_rate': plan.keyphasor_rate},
        'jitter_predictor': {
            'keyphasor_rate': plan.keyphasor_rate, 'trigger_speed': plan.speed,
            'pulses_per_revolution': plan.pulses_per_revolution,
            'pulses_per_trigger': plan.pulses_per_trigger,
            'trigger_cycles': plan.trigger_cycles, 'ratio': plan.ratio, 'orders': plan.orders,
            'follow_shaft_speed': True},
        plan.source: {**plan.source_parameters, 'playing': False}}
    if plan.waveform:
        # as the prediction declares it: the first sample past the threshold
        nodes['tach_detector'] = {'interpolate': False, 'tach_type': PULSE_BLOCKS}
        nodes['synchronous_averager']['tach_type'] = PULSE_BLOCKS
    if live:
        unit = '' if plan.unit == 'unknown' else plan.unit
        nodes['live_view'] = {'vibration_unit': repr(unit), 'channel_names': plan.channels}
        nodes['residual_analyser'] = {'acquisitions': LIVE_ACQUISITIONS}
    return nodes


def watch(plan: Plan, watcher: Watcher, executor: SingleThreadedExecutor,
          children: Sequence[subprocess.Popen[bytes]], *, live: bool = False) -> None:
    """Start the source, show progress, return when it has ended and the averages are in."""
    def spin(seconds: float) -> None:
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            executor.spin_once(timeout_sec=left)
            dead = [child for child in children if child.poll() not in (None, 0)]
            if dead:
                raise SaJitterError(f'a node ended with status {dead[0].returncode}')

    print('waiting for the nodes ...', flush=True)
    end = time.monotonic() + START_TIMEOUT
    listeners = ['vibration', 'tach_pulse', *(['tach_waveform'] if plan.waveform else [])]
    started, address = None, ''
    while started is None:
        spin(0.2)
        if time.monotonic() > end:
            raise SaJitterError(f'the nodes did not find each other within {START_TIMEOUT:g} s')
        if live and not address:
            address = watcher.status.get('live_view', {}).get('address', '')
            if address:
                print(f'open {address} in a web browser', flush=True)
        elif watcher.prediction is not None and all(
                watcher.count_subscribers(topic) and watcher.count_publishers(topic)
                for topic in listeners):
            spin(1.0)  # the graph knows of them before they know of each other
            started = watcher.set_parameter(plan.source, 'playing', True)
    end = time.monotonic() + plan.seconds + START_TIMEOUT
    last, count = time.monotonic(), 0
    while time.monotonic() < end:
        spin(1.0)
        print(watcher.progress(), flush=True)
        if len(watcher.amplitudes()) > count:
            last, count = time.monotonic(), len(watcher.amplitudes())
        ended = watcher.status.get(plan.source, {}).get('message', '').startswith('ended')
        if ended and time.monotonic() - last > QUIET:
            break


def report(plan: Plan, watcher: Watcher, output: Path) -> None:
    """Print the table and draw the figures."""
    amplitudes = watcher.amplitudes()
    if not amplitudes:
        raise SaJitterError('no average was completed: ' + '; '.join(
            f'{name}: {values["message"]}' for name, values in watcher.status.items()))
    print('\n' + text_table(plan, amplitudes, watcher.prediction))
    pulses = watcher.averages['pulse_error']
    if pulses:
        errors = [item.values[:, 1] for item in pulses]
        spread = (sum(float((e**2).sum()) for e in errors) / sum(map(len, errors))) ** 0.5
        print(f'\npulse errors recovered from the vibration: {spread * 1e6:.3g} us (standard '
              f'deviation), declared {1e6 / plan.keyphasor_rate / 12**0.5:.3g} us')
    averager = watcher.status.get('synchronous_averager', {})
    refused = averager.get('shaft.corrections_refused')
    if refused:
        print(f'note: the correction of {refused} averages was refused: '
              f'{averager["shaft.refusal"]}')
    end = watcher.status.get(plan.source, {}).get('message', '')
    for note in (plan.note, end if end.startswith('ended early') else ''):
        if note:
            print(f'note: {note}')
    last = {kind: items[-1] if items else None for kind, items in watcher.averages.items()}
    raw = last['synchronous_average']
    assert raw is not None
    draw_waveform(plan, raw, last['standard_error'], last['corrected_average'],
                  output / 'waveform.png')
    draw_orders(plan, amplitudes, watcher.prediction, output / 'orders.png')
    print(f'figures: {output / "waveform.png"} {output / "orders.png"}')


def main(args: Sequence[str] | None = None) -> int:
    """Run the demo; 0, or 2 with one line on unusable input or output."""
    parser = Parser(
        prog='demo', description='Average a recording, or a simulated gearbox, over ROS topics.')
    parser.add_argument('recording', nargs='?', type=Path,
                        help='.npz, .mat, .wav, .csv or rosbag2; a simulated gearbox without')
    parser.add_argument('--keyphasor-rate', type=float, default=0.0, metavar='HZ',
                        help='round pulse times up to this clock, as if the keyphasor had been '
                        'sampled so slowly')
    parser.add_argument('--live', action='store_true',
                        help='show everything live on a page for a web browser, until Ctrl-C')
    parser.add_argument('--output', type=Path, default=Path('out'), help='folder for the figures')
    add_recording_options(parser)
    options = parser.parse_args(args)
    children: list[subprocess.Popen[bytes]] = []
    context = rclpy.Context()
    for number in (signal.SIGINT, signal.SIGTERM):  # a shell's background job ignores SIGINT
        signal.signal(number, signal.default_int_handler)
    try:
        plan = SIMULATED
        if options.recording:
            plan = plan_recording(
                options.recording, read(options.recording, **read_options(options)),
                keyphasor_rate=options.keyphasor_rate, parameters=read_options(options))
        options.output.mkdir(parents=True, exist_ok=True)  # before the run, not after it
        print(f'{plan.title}: {plan.seconds:.3g} s, {len(plan.channels)} channels, '
              f'{plan.speed:.4g} Hz, {plan.trigger_cycles} trigger cycles an average')
        if not options.live:
            print('to watch it live in a web browser: ./run demo --live')
        os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
        rclpy.init(context=context)
        watcher = Watcher(context=context)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(watcher)
        children += [subprocess.Popen(node_command(name, parameters))
                     for name, parameters in processes(plan, live=options.live).items()]
        watch(plan, watcher, executor, children, live=options.live)
        report(plan, watcher, options.output)
        if options.live:
            print('the page stays until Ctrl-C', flush=True)
            executor.spin()
    except (SaJitterError, OSError) as error:
        print(f'demo: {error}', file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    finally:
        for child in children:
            child.terminate()
        for child in children:
            child.wait()
        context.try_shutdown()
    return 0
