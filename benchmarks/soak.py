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
Soak at the highest sustained rate: memory and latency of the nodes over half an hour.

    .venv/bin/python benchmarks/soak.py --minutes 30 --channels 192

Source, averager (on a core of its own) and predictor are processes of their own over DDS. The
source publishes vibration at 93.75 kHz in real time, as in `graph_speed.py`, through the shared
memory of `config/fastdds.xml`. Numbers go to `out/soak.json`, figure and table to
docs/reliability.md. The exit status is 1 if anything was dropped, lost or missing.
"""

import argparse
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import time
from typing import Any

import graph_speed
from graph_speed import (block_samples, free_domain, KEYS, ORDERS, RATE, resident, Sink, SPEED,
                         transport, TRIGGER_CYCLES, usage)
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter
import numpy as np
from page import fill, growth, MEMORY, table
import rclpy
from rclpy.executors import SingleThreadedExecutor
from sa_jitter_ros.nodes.base import RESULT_QOS

ROOT = Path(__file__).resolve().parents[1]
SPAN = 30.0  # s over which latencies are summed up
PERIOD = 5.0  # s between two looks at the memory
NODES = {
    'synchronous_averager': {'shaft.orders': list(ORDERS)},
    'jitter_predictor': {'follow_shaft_speed': True, 'trigger_cycles': TRIGGER_CYCLES,
                         'orders': list(ORDERS)}}


@contextmanager
def nodes(correct: bool, shafts: int, trigger_cycles: int
          ) -> Iterator[dict[str, subprocess.Popen[str]]]:
    """Start the nodes, the averager on the last core, and end them by SIGINT."""
    cores, running = sorted(os.sched_getaffinity(0)), {}
    try:
        for name, parameters in NODES.items():
            code = f'from sa_jitter_ros.nodes.{name} import main; raise SystemExit(main())'
            arguments = ['--ros-args', '--log-level', 'error']
            for key, value in parameters.items():
                arguments += ['-p', f'{key}:={str(value).lower()}']
            if name == 'synchronous_averager':
                arguments += ['-p', f'correct_jitter:={str(correct).lower()}', '-p',
                              f'trigger_cycles:={trigger_cycles}', '-p',
                              f'shafts:={["shaft", *(f"shaft{k}" for k in range(1, shafts))]}']
                for k in range(1, shafts):
                    arguments += ['-p', f'shaft{k}.ratio:={0.37 + 0.231 * k:.3f}']
            core = cores[-1] if name == 'synchronous_averager' else cores[0]
            running[name] = subprocess.Popen(
                [sys.executable, '-c', code, *arguments], text=True, env=transport(True),
                preexec_fn=partial(os.sched_setaffinity, 0, {core}))
        yield running
    finally:
        for process in running.values():
            process.send_signal(signal.SIGINT)
        for name, process in running.items():
            if process.wait(timeout=30.0):
                raise RuntimeError(f'{name} ended with status {process.returncode}')


def soak(channels: int, seconds: float, *, correct: bool, shafts: int, trigger_cycles: int,
         block_seconds: float, report: Callable[[str], None]) -> dict[str, Any]:
    """Run for so long; return latencies, memory and what the averager has counted."""
    os.environ.update(ROS_AUTOMATIC_DISCOVERY_RANGE='LOCALHOST', ROS_DOMAIN_ID=str(free_domain()))
    length = block_samples(channels, block_seconds)
    context = rclpy.Context()
    context.init(args=[])
    sink = Sink(context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(sink.node)

    def spin(until: Callable[[], Any], limit: float) -> bool:
        end = time.monotonic() + limit
        while not until() and time.monotonic() < end:
            executor.spin_once(timeout_sec=0.2)
        return bool(until())

    with nodes(correct, shafts, trigger_cycles) as running:
        if not spin(lambda: sink.status, 60.0):
            raise RuntimeError('the averager sent no status within 60 s')
        source = subprocess.Popen(
            [sys.executable, graph_speed.__file__, '--publish', str(channels), str(seconds),
             str(length)], stdout=subprocess.PIPE, text=True, env=transport(True))
        watched = {**{name: item.pid for name, item in running.items()}, 'source': source.pid}
        rss: dict[str, list[tuple[float, float]]] = {name: [] for name in watched}
        begin = time.monotonic()
        while source.poll() is None:
            for name, process in watched.items():
                if (held := resident(process)) is not None:  # else it ends in this moment
                    rss[name].append((time.monotonic() - begin, held))
            report(f'{time.monotonic() - begin:.0f} of {seconds:.0f} s, {len(sink.ends)} averages')
            spin(lambda: source.poll() is not None, PERIOD)
        sent = json.loads(source.communicate()[0])
        share = usage(running['synchronous_averager'].pid)[0] / (time.monotonic() - begin)
        spin(lambda: False, 3.0)
    context.try_shutdown()
    counts = sink.status[-1][3]
    return {
        'channels': channels, 'seconds': seconds, 'correct_jitter': correct, 'shafts': shafts,
        'trigger_cycles': trigger_cycles, 'cpu_share': share,
        'load': [f'{value:.1f}' for value in os.getloadavg()], 'source_late': sent['latest'],
        'end': sink.ends, 'sequence': sink.sequences, 'published': int(counts['averages']),
        'latency': [arrival - sent['start'] - end for arrival, end in zip(
            sink.arrivals, sink.ends)],
        'expected': int((seconds * SPEED - 1) / trigger_cycles), 'rss': rss,
        'counts': {key: int(counts[key]) for key in (*KEYS, 'samples_lost')},
        'messages': list(dict.fromkeys(item[2] for item in sink.status if item[1]))}


# --- the page ------------------------------------------------------------------------------------

def spans(found: Mapping[str, Any]) -> np.ndarray:
    """Return (span, 4): its middle (s), and the median, 99 % and largest latency (ms) in it."""
    end, latency = np.array(found['end']), 1e3 * np.array(found['latency'])
    width = min(SPAN, found['seconds'] / 4.0)
    number = np.minimum(end // width, found['seconds'] // width - 1.0)
    return np.array([(width * (k + 0.5), *np.percentile(latency[number == k], (50, 99, 100)))
                     for k in np.unique(number)])


def period(found: Mapping[str, Any]) -> float:
    """Return the time (s) from one average to the next."""
    return float(found.get('trigger_cycles', TRIGGER_CYCLES) / SPEED)


def overwritten(found: Mapping[str, Any]) -> tuple[int, float]:
    """
    Return how many averages of the first shaft did not arrive, and the least silence (s) around.

    A silence is the longest time between two arrivals of those that have part in the period in
    which an average should have come.
    """
    sequence, end = np.array(found['sequence']), np.array(found['end'])
    absent = np.setdiff1d(np.arange(found['published'] // found.get('shafts', 1)), sequence)
    arrival = np.concatenate(([-np.inf], end + np.array(found['latency']), [np.inf]))
    due = np.interp(absent, sequence, end)
    silences = [np.diff(arrival[after - 1:until + 1]).max() for after, until in zip(
        np.searchsorted(arrival, due), np.searchsorted(arrival, due + period(found)))]
    return len(absent), float(min(silences, default=np.inf))


def section(found: Mapping[str, Any]) -> str:
    """Return the text and tables of the page."""
    latency = 1e3 * np.array(found['latency'])
    counted = ', '.join(f'{key} {value}' for key, value in found['counts'].items())
    absent, silence = overwritten(found)
    silences = '' if not absent else (
        f': they were due while nothing came for {silence:.1f} s or more, and a topic keeps the '
        f'newest {RESULT_QOS.depth}, here of {RESULT_QOS.depth * period(found):g} s')
    jitter = 'with' if found['correct_jitter'] else 'without'
    shafts, share = found.get('shafts', 1), found.get('cpu_share')
    load = 'load ' if share is None else f'{100.0 * share:.0f} % of a core, load '
    text = (
        f'{found["seconds"] / 60.0:g} minutes at {found["channels"]} channels of {RATE / 1e3:g} '
        f'kHz ({8e-6 * found["channels"] * RATE:.0f} MB/s), {shafts} shaft{"s" * (shafts > 1)}, '
        f'{jitter} `correct_jitter`, {load}average {found["load"][1]}: '
        f'{found["published"]:,} averages were published, at least {shafts * found["expected"]:,} '
        f'were due; {absent:,} of the first shaft did not reach the watcher{silences}. Latency '
        f'from the last pulse to the arrival: median {np.median(latency):.0f} ms, 99 % '
        f'{np.percentile(latency, 99):.0f} ms, at most {latency.max():.0f} ms (the source itself '
        f'was late by up to {1e3 * found["source_late"]:.0f} ms). Counted: {counted}.')
    memory = [(name, *growth(rss)) for name, rss in found['rss'].items()]
    return f'{text}\n\n{table(("process", *MEMORY), memory)}'


def draw(found: Mapping[str, Any], file: Path) -> None:
    """Draw latency and memory over time."""
    figure = Figure(figsize=(9.0, 6.0), layout='constrained')
    above, below = figure.subplots(2, 1, sharex=True)
    every = spans(found)
    for column, name in ((3, 'largest'), (2, '99 %'), (1, 'median')):
        above.plot(every[:, 0] / 60.0, every[:, column], 'o-', markersize=3, label=name)
    above.set_ylabel('latency from the last pulse [ms]')
    above.set_yscale('log')
    above.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    above.yaxis.set_major_formatter(ScalarFormatter())
    above.yaxis.set_minor_formatter(NullFormatter())
    for name, rss in found['rss'].items():
        times, values = np.array(rss).T
        below.plot(times / 60.0, values, label=name)
    below.set_xlabel('time [min]')
    below.set_ylabel('resident memory [MB]')
    below.set_ylim(bottom=0.0)
    for axes in (above, below):
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8, ncols=3)
    above.set_title(f'{found["channels"]} channels at {RATE / 1e3:g} kHz, {len(found["end"]):,} '
                    f'averages of {found["published"] // found.get("shafts", 1):,}', fontsize=10)
    figure.savefig(file, dpi=110)


def main() -> int:
    """Run, keep the numbers, and write the page."""
    parser = argparse.ArgumentParser(description='Run the averager at full rate for long.')
    parser.add_argument('--minutes', type=float, default=30.0)
    parser.add_argument('--channels', type=int, default=128)
    parser.add_argument('--correct-jitter', action='store_true')
    parser.add_argument('--shafts', type=int, default=1)
    parser.add_argument('--trigger-cycles', type=int, default=TRIGGER_CYCLES)
    parser.add_argument('--block-seconds', type=float, default=0.05, help='of a message, at most')
    parser.add_argument('--numbers', type=Path, default=ROOT / 'out' / 'soak.json')
    parser.add_argument('--page', type=Path, default=ROOT / 'docs' / 'reliability.md')
    parser.add_argument('--figures', type=Path, default=ROOT / 'docs' / 'figures')
    parser.add_argument('--only-write', action='store_true', help='from the numbers of last time')
    options = parser.parse_args()
    if not options.only_write:
        found = soak(options.channels, 60.0 * options.minutes, correct=options.correct_jitter,
                     shafts=options.shafts, trigger_cycles=options.trigger_cycles,
                     block_seconds=options.block_seconds,
                     report=lambda text: print(text, file=sys.stderr, flush=True))
        options.numbers.parent.mkdir(parents=True, exist_ok=True)
        options.numbers.write_text(json.dumps(found) + '\n')
    found = json.loads(options.numbers.read_text())
    print(section(found))
    draw(found, options.figures / 'soak.png')
    options.page.write_text(fill(options.page.read_text(), {'soak': section(found)}))
    lost = any(found['counts'].values()) or len(found['end']) < found['expected']
    print('\n'.join(found['messages']))
    return int(lost)


if __name__ == '__main__':
    sys.exit(main())
