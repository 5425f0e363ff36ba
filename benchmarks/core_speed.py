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
Speed and accuracy of the core beside other software, and how its cost grows.

`python benchmarks/core_speed.py` writes its figures as JSON to the standard output.
`performance.py` starts it in an environment of its own that holds the other packages. With
`--brief` it prints two tables within some minutes: the speed on line beside that of the spline
that is compared, and the shares of a core.
"""

import argparse
from collections import deque
from dataclasses import replace
from functools import partial
import json
import os
import sys
import tracemalloc
from typing import Any

import numpy as np
from page import table
from peers import (blocks, gains, make_record, METHODS, Package, PACKAGES, RATE, Record,
                   stream)
from sa_jitter_ros.averaging.average import AverageSettings, KeyphasorParameters
from sa_jitter_ros.averaging.streaming import StreamingAverager
from sa_jitter_ros.averaging.timeline import VibrationTimeline
from sa_jitter_ros.pulses.validation import PulseValidator
from timing import interleaved, machine, memory_bandwidth, multiply_adds, Timing

TAPS = 16  # of the band-limited kernel: multiply-adds in a resampled value
ON_LINE, REFERENCE = 'sa_jitter_ros, on line', 'quintic spline'
RECORDS = ((8, 1.0), (8, 2.40789), (1, 1.0), (64, 1.0))  # channels and ratio
CLOCK = 3000.0  # Hz, of the keyphasor of the gear train


def compare(channels: int, seconds: float, ratio: float, *, rounds: int, packages: bool
            ) -> dict[str, Any]:
    """Time all methods in turns on one record; values are seconds of CPU and gains in dB."""
    record = make_record(channels=channels, seconds=seconds, ratio=ratio)
    methods, records = dict(METHODS), dict.fromkeys(METHODS, record)
    skipped = {}
    for name, package in PACKAGES.items() if packages else ():
        try:
            methods[name] = package.make()
        except Exception as error:  # whatever keeps a package from working here
            skipped[name] = ' '.join(f'{type(error).__name__}: {error}'.split())
            continue
        records[name] = package.record(channels, seconds, ratio)
    decibels = {}
    for name, method in list(methods.items()):
        try:
            decibels[name] = gains(records[name], method(records[name])).tolist()
        except Exception as error:
            if name in METHODS:
                raise
            skipped[name] = ' '.join(f'{type(error).__name__}: {error}'.split())
            del methods[name]
    timings = interleaved({name: partial(method, records[name])
                           for name, method in methods.items()}, rounds=rounds)
    return {
        'channels': channels, 'seconds': seconds, 'ratio': ratio, 'skipped': skipped,
        'bands': [order * ratio * 40.0 / record.rate for order in record.orders],
        'rows': {name: _row(records[name], timing, seconds, decibels[name],
                            PACKAGES.get(name))
                 for name, timing in timings.items()}}


def _row(record: Record, timing: Timing, seconds: float, decibels: list[float],
         package: Package | None) -> dict[str, Any]:
    """Return what a table shows; times of a shorter record are scaled."""
    scale = seconds * record.rate / record.samples.shape[1]
    return {'best': timing.best * scale, 'median': timing.median * scale, 'runs': timing.runs,
            'nanoseconds': 1e9 * timing.best / record.samples.size,
            'gains': None if package and package.whole_period else decibels,
            'note': package.note if package else ''}


def _exhaust(record: Record, **options: Any) -> None:
    deque(stream(record, **options), maxlen=0)


def growth(scale: float, rounds: int) -> dict[str, dict[str, float]]:
    """Nanoseconds per vibration sample and channel on line, as one setting after another grows."""
    def nanoseconds(records: dict[str, Record], **options: dict[str, Any]) -> dict[str, float]:
        timings = interleaved({
            name: partial(_exhaust, record, **{'trigger_cycles': 40, **options.get(name, {})})
            for name, record in records.items()}, rounds=rounds)
        return {name: 1e9 * timing.best / records[name].samples.size
                for name, timing in timings.items()}

    usual = make_record(seconds=10.0 * scale)
    cycles = [str(count) for count in (2, 5, 10, 20, 40, 80, 160, 320)
              if count < len(usual.pulses) - 1]
    return {
        'channels': nanoseconds({str(count): make_record(channels=count, seconds=5.0 * scale)
                                 for count in (1, 2, 4, 8, 16, 32, 64)}),
        'trigger cycles in an average': nanoseconds(
            dict.fromkeys(cycles, usual), **{n: {'trigger_cycles': int(n)} for n in cycles}),
        'ratio': nanoseconds({str(ratio): make_record(seconds=5.0 * scale, ratio=ratio)
                              for ratio in (0.41, 1.0, 2.40789, 7.3)}),
        'record length in s': nanoseconds({
            f'{seconds:g}': make_record(seconds=seconds)
            for seconds in np.array([5.0, 10.0, 20.0, 40.0]) * scale}),
        'averaging': nanoseconds(
            dict.fromkeys(('block', 'sliding', 'exponential'), usual),
            **{name: {'averaging': name} for name in ('block', 'sliding', 'exponential')})}


def memory(scale: float) -> dict[str, float]:
    """Megabytes that the averager allocates at most, by the length of the record in s."""
    peaks = {}
    for seconds in np.array([5.0, 10.0, 20.0, 40.0]) * scale:
        record = make_record(seconds=seconds)
        tracemalloc.start()
        _exhaust(record, trigger_cycles=20)
        peaks[f'{seconds:g}'] = tracemalloc.get_traced_memory()[1] / 1e6
        tracemalloc.stop()
    return peaks


def beside_the_spline(scale: float, rounds: int) -> str:
    """Return a table of the speed on line beside that of the reference."""
    rows = []
    for channels, ratio in RECORDS:
        record = make_record(channels=channels, ratio=ratio,
                             seconds=scale * (10.0 if channels < 64 else 4.0))
        timings = interleaved({name: partial(METHODS[name], record)
                               for name in (ON_LINE, REFERENCE)}, rounds=rounds, budget=np.inf)
        ours, theirs = (1e9 * timings[name].best / record.samples.size
                        for name in (ON_LINE, REFERENCE))
        rows.append((f'{channels} channel{"s" * (channels > 1)}, ratio {ratio:g}',
                     f'{ours:.1f}', f'{theirs:.1f}', f'{theirs / ours:.1f}'))
    return table(('on line', 'ns per sample and channel', REFERENCE,
                  f'speed, {REFERENCE} = 1'), rows)


def gear_train(ratios: list[float], *, channels: int, seconds: float) -> Record:
    """Return the vibration of gears of 19 teeth on shafts of these ratios, in noise."""
    record = make_record(channels=1, seconds=seconds, speed=20.5)  # 41 cycles in 2 s
    time = np.arange(record.samples.shape[1]) / RATE
    angle = np.interp(time, record.pulses, np.arange(len(record.pulses)))
    wave = sum(np.cos(2.0 * np.pi * order * ratio * angle)
               for ratio in ratios for order in (19.0, 38.0))
    noise = np.random.default_rng(1).standard_normal((channels, time.size))
    return replace(record, samples=wave + 0.4 * noise,
                   pulses=np.ceil(record.pulses * CLOCK) / CLOCK)


def shares(scale: float, rounds: int) -> dict[str, float]:
    """Return the CPU time of settings that ask much, in seconds for a second of data."""
    seconds = max(4.0 * scale, 2.0)
    many, shafts, channels = (max(round(count * min(scale, 1.0)), 2) for count in (20, 12, 24))
    rate, speed, marks, short = 100e3, 50.0, 1024, max(4.0 * scale, 0.1)
    angle = speed * np.arange(round(short * rate)) / rate
    pulses = np.arange(1.0, np.floor(angle[-1] * marks)) / (speed * marks)
    encoder = Record((np.cos(40.0 * np.pi * angle))[None], np.empty((0, 1)), pulses,
                     np.empty(0), rate, 1.0, (20.0,))
    gearbox = make_record(seconds=seconds)
    ratios = [0.37 + 0.231 * k + 0.00013 * (k % 2) for k in range(many)]
    train = gear_train(ratios[:shafts], channels=channels, seconds=seconds)

    def of_encoder() -> None:
        keyphasor = KeyphasorParameters(pulses_per_revolution=marks, pulses_per_trigger=1)
        _exhaust_stream(encoder, keyphasor.validator(), {'shaft': keyphasor.average(
            orders=encoder.orders, trigger_cycles=marks)})

    def of_shafts() -> None:
        _exhaust_stream(gearbox, PulseValidator(), {
            f'shaft{k}': AverageSettings(cycle_length=ratio, trigger_cycles=10,
                                         orders=(1.0, 19.0, 38.0))
            for k, ratio in enumerate(ratios)})

    def of_train(correct: bool) -> None:
        _exhaust_stream(train, PulseValidator(), {
            f'shaft{k}': AverageSettings(
                cycle_length=ratio, trigger_cycles=40, orders=(1.0, 19.0, 38.0),
                correct_jitter=correct, keyphasor_rate=CLOCK)
            for k, ratio in enumerate(ratios[:shafts])})

    first = (f'encoder of {marks} pulses at {speed:g} Hz, each a trigger cycle; 1 channel at '
             f'{rate / 1e3:g} kHz')
    timings = interleaved({
        first: of_encoder,
        f'{many} shafts of different ratios; 8 channels at {gearbox.rate / 1e3:g} kHz':
            of_shafts,
        f'{shafts} shafts of different ratios; {channels} channels at {RATE / 1e3:g} kHz':
            partial(of_train, False),
        f'{shafts} shafts; {channels} channels, with correction every 40 trigger cycles':
            partial(of_train, True)}, rounds=rounds)
    return {name: timing.best / (short if name == first else seconds)
            for name, timing in timings.items()}


def _exhaust_stream(record: Record, validator: PulseValidator,
                    shafts: dict[str, AverageSettings]) -> None:
    """Average a record on line for some shafts."""
    averager = StreamingAverager(shafts, validator=validator, timeline=VibrationTimeline())
    averages = 0
    for block, pulses in blocks(record):
        averages += len(averager.add_samples(block)) + len(averager.add_pulses(pulses))
    assert averages


def limits() -> dict[str, float]:
    """Nanoseconds per sample and channel that this machine needs at the very least."""
    bandwidth, products = memory_bandwidth(), multiply_adds()
    return {'bandwidth': bandwidth, 'multiply_adds': products,
            'memory': 8e9 / bandwidth, 'arithmetic': 1e9 * TAPS / products}


def main() -> int:
    """Measure and print JSON; progress goes to the standard error."""
    parser = argparse.ArgumentParser(description='Measure the core beside its peers.')
    parser.add_argument('--scale', type=float, default=1.0, help='of all record lengths')
    parser.add_argument('--rounds', type=int, default=7, help='turns of every method')
    parser.add_argument('--brief', action='store_true', help='print two tables')
    options = parser.parse_args()
    if os.environ.get('OMP_NUM_THREADS') != '1':
        parser.error('set OMP_NUM_THREADS=1: CPU time is compared, threads that wait would count')
    seconds, rounds = 10.0 * options.scale, options.rounds
    if options.brief:
        print(beside_the_spline(options.scale, rounds), end='\n\n')
        print(table(('on line', 'CPU share of one core'), [
            (name, f'{share:.0%}') for name, share in shares(options.scale, rounds).items()]))
        print(f'\nload average {os.getloadavg()[0]:.1f}')
        return 0
    found: dict[str, Any] = {'machine': machine(), 'limits': limits(), 'comparisons': []}
    for channels, ratio in RECORDS:
        print(f'core: {channels} channels, ratio {ratio:g}', file=sys.stderr, flush=True)
        found['comparisons'].append(compare(channels, seconds, ratio, packages=channels == 8,
                                            rounds=rounds if channels == 8 else min(rounds, 3)))
    print('core: growth', file=sys.stderr, flush=True)
    found['growth'] = growth(options.scale, rounds)
    found['memory'] = memory(options.scale)
    found['shares'] = shares(options.scale, rounds)
    found['load'] = f'{os.getloadavg()[0]:.1f}'
    print(json.dumps(found))
    return 0


if __name__ == '__main__':
    sys.exit(main())
