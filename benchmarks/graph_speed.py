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
The averager over DDS, in a process of its own on one core: CPU share, latency, saturation.

A source process publishes vibration in real time, 40 pulses a second, on another core; this
process receives the averages. With `--bare MILLISECONDS...` a bare subscriber, which only looks at
the arrays, takes the same messages beside the averager: what the transport alone costs.
`python benchmarks/graph_speed.py` writes its figures as JSON to the standard output. Clocks:
CLOCK_MONOTONIC is one for all processes of a host.
"""

import argparse
from contextlib import suppress
from functools import partial
from itertools import product
import json
import os
from pathlib import Path
import random
import re
import signal
import socket
import subprocess
import sys
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from sa_jitter_ros.nodes.base import INPUT_QOS, RESULT_QOS
from sa_jitter_ros.nodes.messages import (
    encode_pulse_reference, encode_samples, encode_samples_float32)
from sa_jitter_ros.samples import SampleBlock
from sensor_msgs.msg import TimeReference
from std_msgs.msg import Float32MultiArray, Float64MultiArray

RATE = 93750.0  # Hz
SPEED = 40.0  # Hz
# Of the comparison with a bare subscriber.
BARE_RATE, BARE_CHANNELS, BARE_CYCLES = 1e5, 100, 40
REVOLUTIONS = 4  # after which the vibration repeats
ORDERS = (211.0, 401.0, 701.0)
TRIGGER_CYCLES = 10
MESSAGE_BYTES = 296_000  # at most
MARGIN = 10  # samples behind a cycle that its interpolation reads
PROFILE = Path(__file__).resolve().parents[1] / 'config' / 'fastdds.xml'
KEYS = ('samples_dropped', 'pulses_dropped', 'cycles_dropped', 'averages_dropped', 'gaps')
NODE = ('from sa_jitter_ros.nodes.synchronous_averager import main; raise SystemExit(main())')


TYPES = {'Float64': (Float64MultiArray, encode_samples),
         'Float32': (Float32MultiArray, encode_samples_float32)}


def block_samples(channels: int, seconds: float) -> int:
    """Return how many samples of a channel go into a message."""
    return min(round(seconds * RATE), MESSAGE_BYTES // (8 * channels))


# --- the source ----------------------------------------------------------------------------------

def publish(channels: int, seconds: float, length: int, rate: float = RATE,
            kind: str = 'Float64', readers: int = 1) -> None:
    """Publish in real time; print when sample 0 was due and how late messages were, as JSON."""
    context = rclpy.Context()
    context.init(args=[])
    node = rclpy.create_node('source', context=context)
    message_type, encode = TYPES[kind]
    vibration = node.create_publisher(message_type, 'vibration', INPUT_QOS)
    tach = node.create_publisher(TimeReference, 'tach_pulse', INPUT_QOS)
    while not (vibration.get_subscription_count() >= readers and tach.get_subscription_count()):
        time.sleep(0.05)
    time.sleep(0.5)
    pattern = round(REVOLUTIONS * rate / SPEED)
    angle = 2.0 * np.pi * SPEED / rate * np.arange(pattern)
    wave = sum(np.cos(order * angle + np.arange(channels)[:, None]) for order in ORDERS)
    wave = np.concatenate([wave, wave], axis=1)
    late, sent = [], 0
    start = time.monotonic()
    for first in range(0, round(seconds * rate), length):
        samples = np.concatenate(  # a block may be longer than the pattern
            [wave[:, at % pattern:at % pattern + min(pattern, first + length - at)]
             for at in range(first, first + length, pattern)], axis=1)
        block = SampleBlock(samples, first / rate, rate, first)
        due = start + (first + length) / rate
        time.sleep(max(due - time.monotonic(), 0.0))
        vibration.publish(encode(block))
        while sent / SPEED < (first + length) / rate:
            tach.publish(encode_pulse_reference(sent / SPEED, 'keyphasor'))
            sent += 1
        late.append(time.monotonic() - due)
    cpu = sum(os.times()[:2])
    print(json.dumps({'start': start, 'late': float(np.percentile(late, 99)), 'latest': max(late),
                      'cpu': cpu}), flush=True)
    time.sleep(3.0)  # reliable messages may be asked for again
    context.try_shutdown()


def subscribe(kind: str) -> None:
    """Take vibration and look at the arrays, until a signal."""
    rclpy.init(args=[])
    node = rclpy.create_node('bare')
    node.create_subscription(TYPES[kind][0], 'vibration', lambda message: np.asarray(message.data),
                             INPUT_QOS)
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)


# --- one measurement -----------------------------------------------------------------------------

def transport(large: bool) -> dict[str, str]:
    """Return the environment of a process, with the shared memory of `config/fastdds.xml`."""
    if not large:
        return dict(os.environ)
    return {**os.environ, 'FASTRTPS_DEFAULT_PROFILES_FILE': str(PROFILE)}


def free_domain() -> int:
    """Return a ROS domain whose discovery port is free on this host."""
    for domain in random.sample(range(1, 100), 99):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(('', 7410 + 250 * domain))
            except OSError:
                continue
            return domain
    raise RuntimeError('no free ROS domain on this host')


def resident(process: int) -> float | None:
    """Return the megabytes that a process holds, None when it has ended and nobody waited yet."""
    status = Path(f'/proc/{process}/status').read_text()
    found = re.search(r'VmRSS:\s+(\d+) kB', status)
    return None if found is None else int(found[1]) / 1e3


def usage(process: int) -> tuple[float, float]:
    """CPU seconds of a process, and the most megabytes that it held."""
    fields = Path(f'/proc/{process}/stat').read_text().rsplit(')', 1)[1].split()
    ticks = os.sysconf('SC_CLK_TCK')
    status = Path(f'/proc/{process}/status').read_text()
    peak = next(line for line in status.splitlines() if line.startswith('VmHWM'))
    return (int(fields[11]) + int(fields[12])) / ticks, int(peak.split()[1]) / 1e3


class Sink:
    """Takes averages and diagnostics, with their times of arrival."""

    def __init__(self, context: rclpy.Context) -> None:
        self.node = rclpy.create_node('sink', context=context)
        self.ends: list[float] = []
        self.sequences: list[int] = []
        self.arrivals: list[float] = []
        self.status: list[tuple[float, int, str, dict[str, str]]] = []
        self.node.create_subscription(Float64MultiArray, 'shaft/synchronous_average',
                                      self._on_average, RESULT_QOS)
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)

    def _on_average(self, message: Float64MultiArray) -> None:
        self.arrivals.append(time.monotonic())
        self.ends.append(message.data[1])
        self.sequences.append(int(message.data[2]))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.endswith('synchronous_averager'):
                self.status.append((
                    time.monotonic(), int.from_bytes(status.level, 'little'), status.message,
                    {item.key: item.value for item in status.values}))


def measure(channels: int, seconds: float, *, large: bool = False, block_seconds: float = 0.05,
            settle: float = 2.0) -> dict[str, Any]:
    """Run source and averager for `seconds`; the first 2 s do not count."""
    cores = sorted(os.sched_getaffinity(0))
    length = block_samples(channels, block_seconds)
    arguments = ['--ros-args', '--log-level', 'error', '-p', f'trigger_cycles:={TRIGGER_CYCLES}',
                 '-p', f'shaft.orders:={list(ORDERS)}']
    context = rclpy.Context()
    context.init(args=[])
    sink = Sink(context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(sink.node)
    averager = subprocess.Popen(
        [sys.executable, '-c', NODE, *arguments], env=transport(large),
        preexec_fn=partial(os.sched_setaffinity, 0, {cores[-1]}))
    children = [averager]

    def spin(until: Any, limit: float) -> None:
        end = time.monotonic() + limit
        while not until() and time.monotonic() < end:
            executor.spin_once(timeout_sec=0.2)

    try:
        spin(lambda: sink.status, 60.0)  # until the averager sends its status
        source = subprocess.Popen(
            [sys.executable, __file__, '--publish', str(channels), str(seconds), str(length)],
            stdout=subprocess.PIPE, text=True, env=transport(large),
            preexec_fn=partial(os.sched_setaffinity, 0, {cores[0]}))
        children.append(source)
        spin(lambda: sink.arrivals, 60.0)
        if not sink.arrivals:
            raise RuntimeError(f'no average of {channels} channels arrived within 60 s')
        begin = sink.arrivals[0] + 2.0
        spin(lambda: time.monotonic() > begin, 3.0)
        cpu, _ = usage(averager.pid)
        spin(lambda: time.monotonic() > begin + seconds - 3.0, seconds)
        elapsed = time.monotonic() - begin
        used, peak = usage(averager.pid)
        spin(lambda: source.poll() is not None, settle + 5.0)
        report = json.loads(source.communicate(timeout=60.0)[0])
        spin(lambda: False, settle)
    finally:
        for child in children:
            if child.poll() is None:
                child.send_signal(signal.SIGINT)
            child.wait(timeout=30.0)
        context.try_shutdown()
    return {'channels': channels, 'large': large, 'block_milliseconds': 1e3 * length / RATE,
            'megabytes_per_second': 8e-6 * channels * RATE, 'cpu_share': (used - cpu) / elapsed,
            'source_late': report['late'], 'source_cpu': report['cpu'] / seconds,
            'peak_megabytes': peak, **_latency(sink, report['start'], length, seconds),
            'diagnostics': _diagnostics(sink)}


def compare(milliseconds: float, kind: str, seconds: float, *, large: bool) -> dict[str, Any]:
    """Return the CPU shares of averager and bare subscriber, of the same messages."""
    length = round(1e-3 * milliseconds * BARE_RATE)
    averager = subprocess.Popen(
        [sys.executable, '-c', NODE, '--ros-args', '--log-level', 'error',
         '-p', f'trigger_cycles:={BARE_CYCLES}', '-p', f'shaft.orders:={list(ORDERS)}',
         '-p', f'sample_rate:={BARE_RATE}', '-p', f'vibration_type:=std_msgs/{kind}MultiArray'],
        env=transport(large))
    command = [sys.executable, __file__]
    bare = subprocess.Popen([*command, '--subscribe', kind], env=transport(large))
    context = rclpy.Context()
    context.init(args=[])
    sink, executor = Sink(context), SingleThreadedExecutor(context=context)
    executor.add_node(sink.node)
    source = subprocess.Popen(
        [*command, '--publish', str(BARE_CHANNELS), str(seconds), str(length), str(BARE_RATE),
         kind, '2'], stdout=subprocess.PIPE, env=transport(large))
    children, shares = (averager, bare), []
    try:
        end = time.monotonic() + 60.0
        while not sink.arrivals and time.monotonic() < end:
            executor.spin_once(timeout_sec=0.2)
        before = [usage(child.pid)[0] for child in children]
        begin = time.monotonic()
        while time.monotonic() < begin + seconds - 2.0:
            executor.spin_once(timeout_sec=0.2)
        shares = [(usage(child.pid)[0] - used) / (time.monotonic() - begin)
                  for child, used in zip(children, before)]
        peak = usage(averager.pid)[1]
    finally:
        source.kill()
        for child in children:
            child.send_signal(signal.SIGINT)
        for child in (*children, source):
            child.wait(timeout=30.0)
        context.try_shutdown()
    return {'milliseconds': milliseconds, 'type': kind, 'large': large, 'averager': shares[0],
            'bare': shares[1], 'ratio': shares[0] / shares[1], 'peak_megabytes': peak,
            'averages': len(sink.arrivals), 'diagnostics': _diagnostics(sink)}


def _latency(sink: Sink, start: float, length: int, seconds: float) -> dict[str, float]:
    """Milliseconds to the arrival from the last pulse, and from when all it needs was sent."""
    ends, arrivals = np.array(sink.ends), np.array(sink.arrivals)
    counts = arrivals > arrivals[0] + 2.0
    ends, arrivals = ends[counts], arrivals[counts]
    needed = np.ceil((ends * RATE + MARGIN) / length) * length / RATE
    quantiles = {}
    for name, origin in (('pulse', ends), ('data', needed)):
        delays = 1e3 * (arrivals - start - origin)
        for label, value in (('median', np.median(delays)), ('99', np.percentile(delays, 99))):
            quantiles[f'{name}_{label}'] = float(value)
    return {'averages': len(sink.ends), 'expected': int((seconds * SPEED - 1) / TRIGGER_CYCLES),
            **quantiles}


def _diagnostics(sink: Sink) -> dict[str, Any]:
    """Return the worst level, the last counts, and what the user read."""
    if not sink.status:
        return {'level': 0, 'counts': {}, 'messages': []}
    return {'level': max(status[1] for status in sink.status),
            'counts': {key: int(sink.status[-1][3].get(key, 0)) for key in KEYS},
            'messages': list(dict.fromkeys(status[2] for status in sink.status if status[1]))[:3]}


def sustained(run: dict[str, Any]) -> bool:
    """Whether nothing was lost and all averages came, most of them in time."""
    return (not any(run['diagnostics']['counts'].values()) and run['pulse_median'] < 500.0
            and run['averages'] >= run['expected'])


def main() -> int:
    """Measure and print JSON; progress goes to the standard error."""
    parser = argparse.ArgumentParser(description='Measure the averager over DDS.')
    parser.add_argument('--seconds', type=float, default=15.0, help='of each run')
    parser.add_argument('--channels', type=int, nargs='+', default=[1, 8, 32, 64, 128, 192, 256])
    parser.add_argument('--large', type=int, nargs='*', default=[64, 128, 192, 256, 320],
                        help='channels with the shared memory of config/fastdds.xml')
    parser.add_argument('--latency-seconds', type=float, default=60.0,
                        help='of the two runs at 8 channels from which latency is taken')
    parser.add_argument('--bare', type=float, nargs='+', metavar='MILLISECONDS',
                        help=f'compare with a bare subscriber, {BARE_CHANNELS} channels at '
                        f'{1e-3 * BARE_RATE:g} kHz in messages of so many ms, and nothing else')
    parser.add_argument('--publish', nargs='+', help=argparse.SUPPRESS)
    parser.add_argument('--subscribe', help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.publish:
        channels, seconds, length, *others = options.publish
        publish(int(channels), float(seconds), int(length),
                *([float(others[0]), others[1], int(others[2])] if others else ()))
        return 0
    if options.subscribe:
        subscribe(options.subscribe)
        return 0
    os.environ.update(ROS_AUTOMATIC_DISCOVERY_RANGE='LOCALHOST', ROS_DOMAIN_ID=str(free_domain()))
    if options.bare:
        for milliseconds, kind, large in product(options.bare, TYPES, (False, True)):
            print(json.dumps(compare(milliseconds, kind, options.seconds, large=large)),
                  flush=True)
        return 0
    found: dict[str, Any] = {'load': f'{os.getloadavg()[0]:.1f}', 'runs': [], 'latency': []}
    for channels, large in [*((count, False) for count in options.channels),
                            *((count, True) for count in options.large)]:
        print(f'graph: {channels} channels{", large" * large}', file=sys.stderr, flush=True)
        found['runs'].append(measure(channels, options.seconds, large=large))
        found['runs'][-1]['sustained'] = sustained(found['runs'][-1])
    for block_seconds in (0.05, 0.01) if options.latency_seconds else ():
        print(f'graph: latency, blocks of {block_seconds:g} s', file=sys.stderr, flush=True)
        found['latency'].append(measure(8, options.latency_seconds, block_seconds=block_seconds))
    print(json.dumps(found))
    return 0


if __name__ == '__main__':
    sys.exit(main())
