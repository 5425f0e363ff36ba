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
Pulses without a tach: errors over stated ones, coverage, refusals, wrong ones, and others beside.

`python benchmarks/tacholess.py` prints the tables of docs/tacholess.md: machines drawn at random,
measured recordings with their tach hidden (`--data`), and the speed. Machines of another simulator
(`--simulator`, a file with `make(kind, effects, seed)` and `MACH`) are a set of their own. With
rota-order installed its speed stands beside; `comb and spline` is
the maximum of a comb in each spectrogram frame next to the one before, and a smoothing spline, as
MATLAB's rpmtrack has it. Wrong is a speed off by 2 % in the median, or an angle off by more than
half a turn of the highest order used.
"""

import argparse
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
import time
import warnings

import numpy as np
from numpy.typing import NDArray
from page import table
import sa_jitter_ros as sa
from scipy.interpolate import CubicSpline, make_smoothing_spline
from scipy.signal import lfilter, stft

FloatArray = NDArray[np.float64]
Angle = Callable[[FloatArray], FloatArray]

MOTIONS = ('steady', 'wander', 'torsion', 'run-up', 'coast-down')
ORDERS = ([1, 2, 3, 4], [1, 2, 3, 5], [20, 40, 60], [17, 23, 34, 46, 51])


@dataclass(frozen=True)
class Case:
    """A machine: vibration (channel, sample), true `angle` in revolutions, what is declared."""

    kind: str
    vibration: FloatArray
    rate: float
    angle: Angle
    orders: list[float]
    speed_range: tuple[float, float]
    first: float = 0.0
    last: float = np.inf


def drawn(seed: int) -> Case:
    """Return a machine drawn at random: lines of -10 to 20 dB over all noise, 30 s at 8 kHz."""
    rng = np.random.default_rng(seed)
    rate, seconds, step = 8192.0, 30.0, 0.01
    kind = str(rng.choice(MOTIONS))
    times = np.arange(0.0, seconds + step, step)

    def slow(corner: float) -> FloatArray:
        bins = np.fft.rfftfreq(times.size, step)
        shape = (rng.standard_normal(bins.size) + 1j * rng.standard_normal(bins.size)) / (
            1.0 + (bins / corner) ** 2)
        shape[0] = 0.0
        found = np.fft.irfft(shape, times.size)
        return found / found.std()

    speed = rng.uniform(8.0, 45.0) * np.ones(times.size)
    if kind == 'steady':
        speed *= 1.0 + 3e-4 * slow(0.2)
    elif kind == 'wander':
        speed *= 1.0 + rng.uniform(0.003, 0.015) * slow(rng.uniform(0.1, 0.5))
    elif kind == 'torsion':
        speed *= 1.0 + 0.004 * slow(0.5) + rng.uniform(0.001, 0.003) * np.sin(
            2.0 * np.pi * rng.uniform(1.0, 3.0) * times)
    else:
        low, share = rng.uniform(6.0, 15.0), times / seconds
        bend = share if rng.random() < 0.5 else (1.0 - np.exp(-2.5 * share)) / (1.0 - np.exp(-2.5))
        speed = low * (1.0 + rng.uniform(0.5, 3.0) * bend) * (1.0 + 0.002 * slow(0.4))
        if kind == 'coast-down':
            speed = speed[::-1]
    angle = CubicSpline(times, speed).antiderivative()
    samples = int(seconds * rate)
    turns = angle(np.arange(samples) / rate)
    orders = [g for g in ORDERS[rng.integers(len(ORDERS))] if g * speed.max() < 0.4 * rate]
    channels = int(rng.integers(1, 4))
    vibration = rng.standard_normal((channels, samples))
    if rng.random() < 0.5:  # resonances
        for _ in range(3):
            place, size = rng.uniform(50.0, 0.4 * rate), 0.06
            radius = np.exp(-np.pi * place * size / rate)
            colour = [1.0, -2.0 * radius * np.cos(2.0 * np.pi * place / rate), radius**2]
            vibration = lfilter([1.0], colour, vibration)
            vibration /= vibration.std(axis=1, keepdims=True)
        vibration += 0.3 * rng.standard_normal(vibration.shape)
        vibration /= vibration.std(axis=1, keepdims=True)
    others = rng.choice([1, 2, 3, 19, 38], 3, replace=False) * rng.uniform(0.3, 3.0) if (
        rng.random() < 0.4) else []
    for order in (*orders, *others):
        if order * speed.max() < 0.45 * rate:
            for channel in range(channels):
                size = np.sqrt(2.0 * 10.0 ** (rng.uniform(-10.0, 20.0) / 10.0))
                vibration[channel] += size * np.cos(
                    2.0 * np.pi * order * turns + rng.uniform(0.0, 2.0 * np.pi))
    return Case(kind + (', second shaft' if len(others) else ''), vibration, rate, angle,
                [float(g) for g in orders],
                (speed.min() * rng.uniform(0.5, 0.9), speed.max() * rng.uniform(1.1, 1.9)))


def foreign(path: Path) -> Callable[[int], Case]:
    """Return how a machine of another simulator is drawn: its pulses without errors are true."""
    spec = spec_from_file_location('foreign', path)
    if spec is None or spec.loader is None:
        raise SystemExit(f'{path}: cannot be loaded')
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    effects = ('', 'amplitude_modulation', 'speed_fluctuation', 'additive_noise',
               'interfering_tone')

    def machine(seed: int) -> Case:
        rng = np.random.default_rng(seed)
        kind, effect = str(rng.choice([*module.MACH])), str(rng.choice(effects))
        given = {'jitter_scale': {'scale': 0.0}}
        if effect:
            given[effect] = module.sized(kind, effect, rng)
        made = module.make(kind, given, seed)
        machine = made['m']
        true = made['pulses']
        speed = machine['f']
        return Case(f'{kind}, {effect or "plain"}', made['vib'].astype(float), made['fs'],
                    CubicSpline(true, np.arange(true.size) / machine['ppr']),
                    [g * machine['r'] for g in machine['orders']],
                    (speed * rng.uniform(0.5, 0.8), speed * rng.uniform(1.2, 1.8)),
                    true[0], true[-1])

    return machine


def measured(data: Path) -> Iterator[Case]:
    """Yield the measured recordings that have a tach, or a better keyphasor."""
    motor = [12.0, 16.0, 18.0, 36.0, 54.0, 72.0]
    for name, orders, speeds in (
            ('gear0_gearbox', [23.0, 46.0, 69.0, 92.0, 115.0], (20.0, 50.0)),
            ('motor_10V_100kHz', motor, (15.0, 25.0)), ('motor_30V_100kHz', motor, (60.0, 150.0)),
            ('motor_runup_20V_40kHz', [12.0, 36.0, 72.0], (20.0, 70.0)),
            *((f'turbine_2013{day}', [20.0, 40.0, 60.0], (24.0, 36.0))
              for day in ('0316', '0326', '0331', '0405', '0415'))):
        recording = sa.read(data / f'{name}.npz')
        pulses = np.sort(recording.keyphasor_pulses())
        marks = 2 if name.startswith('turbine') else recording.pulses_per_revolution
        yield Case(name, recording.read(), recording.sample_rate,
                   CubicSpline(pulses, np.arange(pulses.size) / marks), orders, speeds,
                   pulses[0], pulses[-1])


def angle_error(case: Case, times: FloatArray) -> FloatArray:
    """Return by how much the revolutions that begin at times are off, about their mean."""
    error = case.angle(times) - np.arange(times.size)
    return np.asarray(error - error.mean())


def by_speed(case: Case, times: FloatArray, speed: FloatArray) -> FloatArray:
    """Return the errors of pulses that follow from a speed (Hz) alone."""
    turns = CubicSpline(times, speed).antiderivative()
    fine = np.linspace(max(times[0], case.first), min(times[-1], case.last), 20 * times.size)
    level = turns(fine)
    marks = np.arange(np.ceil(level[0]), np.floor(level[-1]))
    return angle_error(case, np.interp(marks, level, fine))


def comb_and_spline(case: Case) -> FloatArray:
    """Return errors of a comb in each frame of a spectrogram, followed from the true speed."""
    low, high = case.speed_range
    size = int(12.0 * case.rate / np.sqrt(low * high))
    bins, times, values = stft(case.vibration, case.rate, nperseg=size, noverlap=3 * size // 4,
                               boundary=None, padded=False)
    level = np.log(np.sum(np.abs(values) ** 2, axis=0) + 1e-30)
    speeds = np.exp(np.arange(np.log(low), np.log(high), 0.3 * bins[1] / (
        max(case.orders) * high)))
    place = np.minimum(np.rint(np.outer(case.orders, speeds) / bins[1]).astype(int), bins.size - 1)
    score = level[place].sum(axis=0)
    begin = case.angle(np.array([max(times[0], case.first)]), 1)  # type: ignore[call-arg]
    path = [int(np.argmin(np.abs(speeds - begin)))]
    reach = max(int(0.03 / np.log(speeds[1] / speeds[0])), 2)
    for frame in score.T:
        first = max(path[-1] - reach, 0)
        path.append(first + int(np.argmax(frame[first:path[-1] + reach + 1])))
    return by_speed(case, times, make_smoothing_spline(times, speeds[path[1:]])(times))


def by_rota(case: Case) -> FloatArray | None:
    """Return errors of rota-order's speed, None without it."""
    try:
        from rota.speed import rpm_from_ridge
    except ImportError:
        return None
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        found = rpm_from_ridge(case.vibration.T, case.rate,
                               tuple(60.0 * np.array(case.speed_range)), orders=case.orders)
    return by_speed(case, found.t, found.rpm / 60.0)


@dataclass(frozen=True)
class Row:
    """What became of a case; errors are RMS, in revolutions."""

    kind: str
    orders: str = ''
    refused: str = ''
    reason: str = ''
    wrong: bool = False
    covered: float = np.nan
    covered_95: float = np.nan
    error: float = np.nan
    stated: float = np.nan
    share: float = 0.0
    comb: float = np.nan
    rota: float = np.nan
    seconds: float = np.nan


def judged(case: Case, *, others: bool) -> Row:
    """Find the pulses of a case and compare them with the truth."""
    beside = {}
    if others:
        for name, other in (('comb', comb_and_spline), ('rota', by_rota)):
            with suppress(ValueError):
                errors = other(case)
                beside[name] = np.nan if errors is None else float(np.std(errors))
    begin = time.process_time()
    try:
        found = sa.find_pulses(case.vibration, case.rate, orders=case.orders,
                               speed_range=case.speed_range)
    except sa.SignalError as error:
        return Row(case.kind, refused=str(error), **beside)
    seconds = time.process_time() - begin
    inside = (found.times >= case.first) & (found.times <= case.last)
    error = angle_error(case, found.times[inside])
    stated = (found.standard_errors * found.speed)[inside]
    speed = case.angle(found.times[inside], 1)  # type: ignore[call-arg]
    highest = max(found.used)
    wrong = abs(np.median(found.speed[inside] / speed) - 1.0) > 0.02 or (
        np.abs(error).max() > 0.5 / highest)
    total = np.diff(case.angle(np.array([max(case.first, 0.0), min(
        case.last, case.vibration.shape[1] / case.rate)])))[0]
    return Row(case.kind, ', '.join(f'{order:g}' for order in found.used),
               reason=found.reason, wrong=bool(wrong), covered=float(np.mean(
                   np.abs(error) < stated)), covered_95=float(np.mean(
                       np.abs(error) < 1.96 * stated)), error=float(error.std()),
               stated=float(np.sqrt(np.mean(stated**2))), share=inside.sum() / total,
               seconds=seconds, **beside)


def summary(name: str, rows: list[Row]) -> list[str]:
    """Return a line of the table of random machines."""
    good = [row for row in rows if not row.refused and not row.wrong]
    ratio = np.array([row.error / row.stated for row in good])

    def share(values: list[bool]) -> str:
        return f'{100.0 * np.mean(values):.0f} %'

    def other(values: list[float]) -> str:
        known = np.array([value for value in values if np.isfinite(value)])
        return f'{1e3 * np.median(known):.2g}' if known.size else '-'

    return [name, str(len(rows)), share([bool(row.refused) for row in rows]),
            share([row.wrong for row in rows]),
            f'{100 * np.mean([row.covered for row in good]):.0f} %',
            f'{100 * np.mean([row.covered_95 for row in good]):.0f} %',
            f'{np.median(ratio):.2f}', share([bool(row.reason) for row in good]),
            f'{100 * np.mean([row.share for row in good]):.0f} %',
            other([row.error for row in good]), other([row.comb for row in good]),
            other([row.rota for row in good])]


HEADER = ['machines', 'number', 'refused', 'wrong', 'within 68 %', 'within 95 %',
          'RMS error over stated', 'stop early', 'of the revolutions',
          'median error, 1/1000 turn', 'comb and spline', 'rota-order']


def speed_row() -> str:
    """Return how long 100 s of 3 channels at 25.6 kHz take."""
    rng, rate = np.random.default_rng(0), 25600.0
    times = np.arange(int(100 * rate)) / rate
    angle = 30.0 * times + 1.5 * np.sin(0.3 * times)
    vibration = sum(np.cos(2.0 * np.pi * order * angle) for order in (1, 2, 23, 46, 69)
                    ) + 3.0 * rng.standard_normal((3, times.size))
    begin = time.process_time()
    sa.find_pulses(vibration, rate, orders=[1, 2, 23, 46, 69], speed_range=(20.0, 45.0))
    return f'100 s of 3 channels at 25.6 kHz: {time.process_time() - begin:.1f} s of one core'


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--machines', type=int, default=200, help='of each set')
    parser.add_argument('--first', type=int, default=100_000, help='first seed')
    parser.add_argument('--simulator', type=Path, help='file of another simulator')
    parser.add_argument('--data', type=Path, help='folder of measured recordings')
    parser.add_argument('--no-others', action='store_true', help='without comb and rota-order')
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.machines)
    sets = {'drawn at random': drawn}
    if options.simulator:
        sets['of another simulator'] = foreign(options.simulator)
    lines = []
    for name, machine in sets.items():
        rows = [judged(machine(seed), others=not options.no_others) for seed in seeds]
        lines.append(summary(name, rows))
        for kind in sorted({row.kind.split(',')[0] for row in rows}):
            lines.append(summary(f'- {kind}', [row for row in rows if row.kind.split(
                ',')[0] == kind]))
        for seed, row in zip(seeds, rows):
            if row.refused or row.wrong:
                print(f'{name} {seed} {row.kind}: {row.refused or "WRONG"}')
    print(table(HEADER, lines))
    if options.data:
        print(table(['recording', 'orders used', 'error, 1/1000 turn', 'stated', 'comb and spline',
                     'rota-order', 'note'], [
            [row.kind, row.orders or '-', *('-' if not np.isfinite(value) else f'{1e3 * value:.2g}'
             for value in (row.error, row.stated, row.comb, row.rota)), row.refused or row.reason]
            for row in (judged(case, others=True) for case in measured(options.data))]))
    print(speed_row())


if __name__ == '__main__':
    main()
