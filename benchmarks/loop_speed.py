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
Speed of prediction, recovery and the loop off line.

`python benchmarks/loop_speed.py` writes its figures as JSON to the standard output.
"""

import argparse
from collections.abc import Callable, Sequence
from functools import partial
import json
from operator import itemgetter
import os
from pathlib import Path
import resource
from statistics import median
import subprocess
import sys
import tempfile
import time
from typing import Any

import numpy as np
from sa_jitter_ros.averaging.grid_cycles import GridCycles
from sa_jitter_ros.averaging.recovery import PulseErrorRecovery, recover_pulse_errors
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.prediction.prediction import predict
from sa_jitter_ros.simulation import Gearbox, Keyphasor, make_effects, mesh
from sa_jitter_ros.simulation.effects import AdditiveNoise, DeclaredJitter
from timing import interleaved, machine

RATIO = 2.40789
SPEED = 16.6  # Hz
RATE = 10000.0  # Hz
KEYPHASOR_RATE = 5000.0  # Hz
#: Recordings for `close_loop`: s, Hz, gains of the channels, and gears. The first has 10 MB.
LOOPS = (31.25, 10000.0, (1.0, 0.8, 0.6, 0.4), 1), (100.0, 25600.0, (1.0, 0.8, 0.6), 1), (
    100.0, 25600.0, (1.0, 0.8, 0.6), 2)
_RUNS = 5  # of `close_loop`, of which the least counts
_SHORTEST = 5.5  # s, of a recording: four acquisitions of the model
MODEL = f"""\
jitter_predictor:
  ros__parameters:
    keyphasor_rate: {KEYPHASOR_RATE}
    trigger_speed: {SPEED}
    trigger_cycles: 20
    ratio: {RATIO}
    orders: [19.0, 38.0, 57.0]
"""


def prediction(orders: int, rounds: int) -> dict[str, float]:
    """Milliseconds for all moments and quantiles of orders 1, 2, ..."""
    def model(cycles: int, **options: Any) -> DeclaredModel:
        return DeclaredModel(keyphasor_rate=10000.0, trigger_speed=40.0, trigger_cycles=cycles,
                             orders=tuple(np.arange(1.0, orders + 1.0)), **options)

    table = tuple(np.random.default_rng(1).normal(scale=3e-5, size=50).tolist())
    models = {
        'uniform, 40 trigger cycles': model(40),
        'normal, 40 trigger cycles': model(40, jitter_distribution='normal'),
        'table of 50 errors, 40 trigger cycles': model(
            40, jitter_distribution='table', jitter_table=table),
        'uniform, 1000 trigger cycles': model(1000),
        'uniform, 5 trigger cycles (distribution is sampled)': model(5)}
    timings = interleaved({name: partial(predict, item) for name, item in models.items()},
                          rounds=rounds)
    return {name: 1e3 * timing.median for name, timing in timings.items()}


def trigger_cycles(count: int, channels: int, samples: int = 512) -> tuple[Any, Any, float]:
    """Return cycles (cycle, sample, channel) between jittered pulses, periods, the jitter (s)."""
    rng = np.random.default_rng(2)
    width = 0.2 / (19.0 * RATIO * SPEED)
    true = np.cumsum(1.0 + 2e-4 * rng.standard_normal(count + 1)) / SPEED
    pulses = true + rng.uniform(-0.5, 0.5, count + 1) * width
    times = pulses[:-1, None] + np.diff(pulses)[:, None] * np.arange(samples) / samples
    turns = RATIO * np.interp(times, true, np.arange(count + 1.0))[:, :, None]
    gains = 1.0 / (1.0 + np.arange(channels))
    cycles = gains * (np.cos(2.0 * np.pi * 19.0 * turns) + 0.5 * np.cos(2.0 * np.pi * 38.0 * turns)
                      + 0.25 * np.cos(2.0 * np.pi * 57.0 * turns))
    return (cycles + 0.3 * rng.standard_normal(cycles.shape), np.diff(pulses),
            width / np.sqrt(12.0))


def recovered(count: int, channels: int) -> Callable[[], PulseErrorRecovery]:
    """Return the recovery of the pulse errors of an average, ready to be called."""
    cycles, periods, jitter = trigger_cycles(count, channels)
    return lambda: recover_pulse_errors(GridCycles(cycles), periods=periods, cycle_length=RATIO,
                                        declared_standard_deviation=jitter)


def recovery(count: int, rounds: int) -> dict[str, float]:
    """Milliseconds for one recovery of the pulse errors of an average."""
    calls = {}
    for channels in (1, 8, 64):
        call = recovered(count, channels)
        assert call().accepted
        calls[f'{count} trigger cycles x {channels} channels'] = call
    return {name: 1e3 * timing.median
            for name, timing in interleaved(calls, rounds=rounds).items()}


def recovery_by_threads(count: int, rounds: int) -> dict[str, float]:
    """Milliseconds on the clock for one recovery, by the threads of linear algebra."""
    found = {}
    for threads in sorted({1, os.cpu_count() or 1}):
        done = subprocess.run(
            [sys.executable, __file__, '--clock', str(count), '--rounds', str(rounds)],
            env={**os.environ, 'OMP_NUM_THREADS': str(threads)}, stdout=subprocess.PIPE,
            check=True)
        found[str(threads)] = float(done.stdout)
    return found


def clock(count: int, rounds: int) -> float:
    """Return the median milliseconds on the clock for one recovery of 8 channels."""
    call, elapsed = recovered(count, 8), []
    for _ in range(rounds + 1):
        start = time.perf_counter()
        call()
        elapsed.append(1e3 * (time.perf_counter() - start))
    return median(elapsed[1:])


def close_loop(runs: int, seconds: float, rate: float, gains: Sequence[float], gears: int
               ) -> dict[str, Any]:
    """
    Seconds that the command takes, the least of some runs, with an effect that is not declared.

    The recording has a channel for each of the `gains`. A second one of `gears` is not declared.
    """
    samples, harmonics = round(seconds * rate), (1.0, 0.5, 0.25)
    sources = [*mesh('shaft', 19, harmonics=harmonics, channel_gains=gains, seed=1),
               *mesh('other', 41, harmonics=harmonics, channel_gains=gains, seed=2)]
    gearbox = Gearbox(
        sources[:gears * len(harmonics)], rate, shafts={'shaft': RATIO, 'other': 0.7123},
        speed=((0.0, SPEED),), keyphasor=Keyphasor(),
        effects=(AdditiveNoise(0.1, name='noise'),
                 DeclaredJitter('uniform', 1.0 / np.sqrt(12.0) / KEYPHASOR_RATE),
                 *make_effects({'excess_jitter': {'std': 1e-4}})), seed=1)
    with tempfile.TemporaryDirectory() as folder:
        recording, model = Path(folder, 'rig.npz'), Path(folder, 'model.yaml')
        np.savez(recording, vibration=gearbox.vibration(0, samples), sample_rate=rate,
                 pulse_times=gearbox.pulses(0.0, seconds).times, ratio=RATIO,
                 orders=[19.0, 38.0, 57.0])
        model.write_text(MODEL)
        # Python compiles the modules once, when a package is installed or used first.
        compiled = {name: value for name, value in os.environ.items()
                    if name != 'PYTHONDONTWRITEBYTECODE'}
        subprocess.run([sys.executable, '-c', 'import sa_jitter_ros.commands.loop_run, '
                        'sa_jitter_ros.report.html_report'], check=True, env=compiled)
        times = [_run([
            sys.executable, '-c', 'from sa_jitter_ros.commands.close_loop import main; '
            'raise SystemExit(main())', str(recording), '--declared', str(model), '--output',
            str(Path(folder, 'report')), '--quiet'], compiled)
            for _ in range(runs)]
        report = json.loads(Path(folder, 'report', 'report.json').read_text())
        wall, cpu = min(times, key=itemgetter(1))
        return {'megabytes': recording.stat().st_size / 1e6, 'wall': wall, 'cpu': cpu,
                'seconds': seconds, 'channels': len(gains), 'gears': gears,
                'verdict': report['verdict'],
                'missing': [effect['name'] for effect in report['missing_effects']]}


def _run(command: list[str], environment: dict[str, str]) -> tuple[float, float]:
    """Run a command; return its seconds and those of CPU."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env=environment)
    after, wall = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic() - start
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> int:
    """Measure and print JSON; progress goes to the standard error."""
    parser = argparse.ArgumentParser(description='Measure prediction, recovery and the loop.')
    parser.add_argument('--scale', type=float, default=1.0, help='of all sizes')
    parser.add_argument('--rounds', type=int, default=9, help='turns of every call')
    parser.add_argument('--loops', type=int, default=len(LOOPS), help='recordings of `close_loop`')
    parser.add_argument('--clock', type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    scale, rounds = options.scale, options.rounds
    if options.clock:
        print(clock(options.clock, rounds))
        return 0
    found: dict[str, Any] = {'machine': machine()}
    for name, measure in (
            ('prediction', partial(prediction, max(round(64 * scale), 2), rounds)),
            ('recovery', partial(recovery, max(round(100 * scale), 20), rounds)),
            ('threads', partial(recovery_by_threads, max(round(100 * scale), 20), rounds)),
            ('close_loop', lambda: [
                close_loop(min(rounds, _RUNS), max(scale * seconds, _SHORTEST), *other)
                for seconds, *other in LOOPS[:options.loops]])):
        print(f'loop: {name}', file=sys.stderr, flush=True)
        found[name] = measure()
    found['load'] = f'{os.getloadavg()[0]:.1f}'
    print(json.dumps(found))
    return 0


if __name__ == '__main__':
    sys.exit(main())
