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
Put effects into measured machines, and tell whether the loop finds them or gives a limit.

`python benchmarks/measured_injections.py --data FOLDER` moves the pulses, resamples the vibration
or adds to it, for every effect and for two that no module describes, so that the worst line
changes by 0.01, 0.03 and 0.1 (mean, or standard deviation of an average). What the loop finds in
the recordings themselves is declared before. It writes a line of JSON a run to the standard error
and prints a table at the end, whose letters docs/measured_cases.md explains.
"""

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
import json
from pathlib import Path
import re
import sys
import tempfile
import time
from typing import Any
import warnings

from measured_cases import Case, GEAR0, other_cases, stored
import numpy as np
import sa_jitter_ros as sa
from sa_jitter_ros.effects.band import ACCELERATION_BAND, slow_band
from sa_jitter_ros.errors import SaJitterError
from sa_jitter_ros.recordings import Recording
from sa_jitter_ros.recordings.recording import ArraySource
from scipy import interpolate, ndimage
import yaml

Array = np.ndarray[Any, Any]
Generator = np.random.Generator
SIZES = 0.01, 0.03, 0.1
_STEPS, _STEP = 400, 1.1
_CORRELATION, _BEAT, _OFF, _WANDER = 0.8, 0.2, 1.5, 0.2
_HUM = 59.8  # Hz
_HIT, _KEPT = 0.04, 0.75  # share of pulses at which a sensor drops out, and what stays of it
UNSURE = {'bandwidth'}  # parameters whose errors are not looked at
IN_UNITS = {'additive_noise': {'std'}, 'interfering_tone': {'amplitude'}}  # of the vibration
_WAVES, _POINTS = 300, 20  # of a slow process, and its points in a trigger cycle


@dataclass(frozen=True)
class Bench:
    """
    A recording in arrays (`samples` channel x sample, `times` of pulses), and its model.

    `true_times` are those without the declared jitter; `level` is the usual amplitude of a line.
    """

    samples: Array
    rate: float
    start: float
    times: Array
    true_times: Array
    model: Mapping[str, Any]
    recording: Recording
    level: float

    @property
    def period(self) -> float:
        """Return the duration of a trigger cycle in s."""
        return float(self.model.get('pulses_per_trigger', 0) or self.model.get(
            'pulses_per_revolution', 1)) * float(np.median(np.diff(self.times)))

    @property
    def clock(self) -> Array:
        """Return the times of the samples."""
        return self.start + np.arange(self.samples.shape[1]) / self.rate

    def slow(self, rng: Generator, band: tuple[float, float], power: int = 0
             ) -> Callable[[Array], Array]:
        """
        Return a motion whose derivative of some `power` is flat in a band and of unit variance.

        The band is in cycles a trigger cycle; the variance that of this recording.
        """
        edges = np.linspace(*band, _WAVES + 1) / self.period
        rates = 2.0 * np.pi * rng.uniform(edges[:-1], edges[1:])
        phases = rng.uniform(0.0, 2.0 * np.pi, _WAVES)
        grid = np.arange(self.start - self.period, self.clock[-1] + self.period,
                         self.period / _POINTS)
        waves = np.cos(np.multiply.outer(grid, rates) + phases)
        scale = float(np.std(waves.sum(axis=1)))
        spline = interpolate.CubicSpline(grid, waves @ rates**-power / scale)
        return lambda times: np.asarray(spline(times))

    def moved(self, lead: Array) -> Array:
        """Return the samples (channel, sample) that the machine makes `lead` (sample,) s later."""
        places = np.arange(self.samples.shape[1]) + self.rate * lead
        return np.stack([ndimage.map_coordinates(row, [places], order=5, mode='nearest')
                         for row in self.samples])

    def made(self) -> Recording:
        """Return the recording."""
        return replace(self.recording, vibration=ArraySource(self.samples), sample_rate=self.rate,
                       pulse_times=self.times, tach=None, tach_rate=None,
                       reference_pulse_times=None)


Make = Callable[[Bench, Generator, float], Bench]


def excess_jitter(bench: Bench, rng: Generator, size: float) -> Bench:
    """Add electrical noise."""
    return replace(bench, times=bench.times + size * rng.standard_normal(bench.times.size))


def correlated_jitter(bench: Bench, rng: Generator, size: float) -> Bench:
    """Add a trigger level that wanders."""
    noise = rng.standard_normal(bench.times.size)
    late = np.empty_like(noise)
    pole = _CORRELATION ** (np.median(np.diff(bench.times)) / bench.period)
    late[0] = noise[0]
    for k in range(1, noise.size):
        late[k] = pole * late[k - 1] + np.sqrt(1.0 - pole**2) * noise[k]
    return replace(bench, times=bench.times + size * late)


def clock_skew(bench: Bench, rng: Generator, size: float) -> Bench:
    """Let the clock of the keyphasor run fast."""
    return replace(bench, times=bench.times + size * (bench.times - bench.start))


def path_delay(bench: Bench, rng: Generator, size: float) -> Bench:
    """Let the keyphasor come late."""
    return replace(bench, times=bench.times + size)


def missing_pulses(bench: Bench, rng: Generator, size: float) -> Bench:
    """Lose pulses."""
    return replace(bench, times=bench.times[rng.random(bench.times.size) >= size])


def phase_wander(bench: Bench, rng: Generator, size: float) -> Bench:
    """Let the gears move against the tach shaft."""
    turn = 2.0 * np.pi * bench.model['trigger_speed'] * bench.model.get('ratio', 1.0)
    lead = size / turn * bench.slow(rng, slow_band(_WANDER))(bench.clock)
    return replace(bench, samples=bench.moved(lead))


def speed_fluctuation(bench: Bench, rng: Generator, size: float) -> Bench:
    """Let the whole machine turn unevenly."""
    motion = bench.slow(rng, ACCELERATION_BAND, 2)
    scale = size / (2.0 * np.pi * bench.model['trigger_speed'])
    times = bench.times
    for _ in range(20):  # t + motion(t) is when it happened before
        times = bench.times - scale * motion(times)
    return replace(bench, samples=bench.moved(scale * motion(bench.clock)), times=times)


def keyphasor_quantisation(bench: Bench, rng: Generator, size: float) -> Bench:
    """Time the pulses by a clock, whose rate is declared."""
    rate = 1.0 / size
    return replace(bench, times=np.ceil(bench.true_times * rate) / rate,
                   model={**bench.model, 'keyphasor_rate': rate})


def interpolation_loss(bench: Bench, rng: Generator, size: float) -> Bench:
    """Interpolate the samples linearly from those of another clock."""
    step = 1.0 + _BEAT / bench.period / bench.rate
    places = np.arange(0.0, bench.samples.shape[1] - 1, step)
    own = np.arange(bench.samples.shape[1])
    return replace(bench, rate=bench.rate / step, samples=np.stack(
        [np.interp(places, own, row) for row in bench.samples]))


def additive_noise(bench: Bench, rng: Generator, size: float) -> Bench:
    """Add white noise."""
    return replace(bench, samples=bench.samples + bench.level * size * rng.standard_normal(
        bench.samples.shape))


def _load(bench: Bench) -> float:
    """Return the bandwidth of a load that is nearly constant in an average."""
    return 0.5 / float(bench.model['trigger_cycles'])


def amplitude_modulation(bench: Bench, rng: Generator, size: float) -> Bench:
    """Let the load vary slowly."""
    return replace(bench, samples=bench.samples * (
        1.0 + size * bench.slow(rng, slow_band(_load(bench)))(bench.clock)))


def _tone(bench: Bench) -> float:
    """Return a frequency beside the middle order."""
    model = bench.model
    orders = model['orders']
    return float(orders[len(orders) // 2] * model.get('ratio', 1.0) * model['trigger_speed']
                 + _OFF / model['trigger_cycles'] / bench.period)


def interfering_tone(bench: Bench, rng: Generator, size: float) -> Bench:
    """Add a tone beside an order."""
    return replace(bench, samples=bench.samples + bench.level * size * np.cos(
        2.0 * np.pi * _tone(bench) * bench.clock + 1.0))


def hum(bench: Bench, rng: Generator, size: float) -> Bench:
    """Let the mains move the trigger level; no module describes it."""
    return replace(bench, times=bench.times + size * np.sqrt(2.0) * np.sin(
        2.0 * np.pi * _HUM * bench.times))


def late_recovery(bench: Bench, rng: Generator, size: float) -> Bench:
    """Let the sensor drop out now and then and come late until it has recovered; unknown, too."""
    late = np.zeros(bench.times.size)
    for k in range(1, late.size):
        hit = rng.uniform(0.5, 1.5) if rng.random() < _HIT else 0.0
        late[k] = _KEPT * late[k - 1] + hit
    return replace(bench, times=bench.times + size / late.std() * late)


def jitter_scale(bench: Bench, rng: Generator, size: float) -> Bench:
    """Let the declared errors be larger than declared."""
    return replace(bench, times=bench.times + size * (bench.times - bench.true_times))


def _angles(bench: Bench, size: float) -> Array:
    """Return by which angle each mark is late."""
    marks = int(bench.model.get('pulses_per_revolution', 1))
    angles = np.random.default_rng(marks).standard_normal(marks)
    return np.asarray(size * (angles - angles.mean()))


def target_geometry(bench: Bench, rng: Generator, size: float) -> Bench:
    """Put the marks off their even places."""
    angles = _angles(bench, size)
    late = angles[np.arange(bench.times.size) % angles.size]
    return replace(bench, times=bench.times + late / (2.0 * np.pi * bench.model['trigger_speed']))


#: Trigger cycles and what else is declared so that short recordings have enough acquisitions.
_SHORTER: Mapping[str, Mapping[str, Any]] = {
    'motor, 10 V': {'pulses_per_trigger': 4}, 'motor, 30 V': {'trigger_cycles': 5}}
#: Width (s) of the uniform pulse errors that are added, as declared.
JITTER: Mapping[str, float] = {'gearbox': 5e-5, 'motor, 30 V': 1e-5}
MACHINES: Mapping[str, Case] = {case.title: replace(
    case, model={**case.model, **_SHORTER.get(case.title, {})}) for case in (
        Case('gearbox', [stored('gear0_gearbox.npz')], {
            **GEAR0, 'keyphasor_rate': 2e4, 'trigger_cycles': 10}), *other_cases())}
#: Effects, how to put them in, and their parameters at a size, for the prediction.
KNOWN: Mapping[str, tuple[Make, Callable[[Bench, float], Mapping[str, Any]]]] = {
    'excess_jitter': (excess_jitter, lambda bench, size: {'std': size}),
    'correlated_jitter': (correlated_jitter, lambda bench, size: {
        'std': size, 'correlation': _CORRELATION}),
    'clock_skew': (clock_skew, lambda bench, size: {'skew': size}),
    'path_delay': (path_delay, lambda bench, size: {'delay': size}),
    'jitter_scale': (jitter_scale, lambda bench, size: {'scale': 1.0 + size}),
    'target_geometry': (target_geometry, lambda bench, size: {
        'pulse_angles': _angles(bench, size).tolist()}),
    'missing_pulses': (missing_pulses, lambda bench, size: {'probability': size}),
    'phase_wander': (phase_wander, lambda bench, size: {'std': size, 'bandwidth': _WANDER}),
    'speed_fluctuation': (speed_fluctuation, lambda bench, size: {'acceleration_std': size}),
    'keyphasor_quantisation': (keyphasor_quantisation, lambda bench, size: {
        'clock_rate': 1.0 / size}),
    'interpolation_loss': (interpolation_loss, lambda bench, size: {'method': 'linear'}),
    'additive_noise': (additive_noise, lambda bench, size: {'std': size}),
    'amplitude_modulation': (amplitude_modulation, lambda bench, size: {
        'std': size, 'bandwidth': _load(bench)}),
    'interfering_tone': (interfering_tone, lambda bench, size: {
        'frequency': _tone(bench), 'amplitude': size})}
# with as large a standard deviation as correlated jitter
UNKNOWN: Mapping[str, Make] = {'hum': hum, 'late_recovery': late_recovery}
_FIRST = {'excess_jitter': 1e-8, 'correlated_jitter': 1e-8, 'clock_skew': 1e-8,
          'path_delay': 1e-5, 'jitter_scale': 1e-2, 'target_geometry': 1e-6,
          'missing_pulses': 1e-4, 'phase_wander': 1e-5, 'speed_fluctuation': 1e-3,
          'keyphasor_quantisation': 1e-7, 'additive_noise': 1e-5, 'amplitude_modulation': 1e-4,
          'interfering_tone': 1e-5}


def size_of(name: str, bench: Bench, change: float) -> float | None:
    """Return the size with which an effect changes the worst line by so much, None if at none."""
    if name == 'interpolation_loss':
        return 1.0
    keywords = {**bench.model, 'sample_rate': bench.rate, 'effects': {}}
    if name == 'keyphasor_quantisation':  # it replaces the declared jitter
        keywords['keyphasor_rate'] = 1e9
    plain = sa.predict(**keywords)

    def moved(size: float) -> float:
        try:
            with_it = sa.predict(**{**keywords, 'effects': {name: KNOWN[name][1](bench, size)}})
        except SaJitterError:
            return np.inf
        return max(float(np.abs(getattr(with_it, key) - getattr(plain, key)).max())
                   for key in ('mean_attenuation', 'standard_deviation'))

    size, found = _FIRST[name], 0.0
    for step in _STEP**8, _STEP:  # coarse, then fine from the last coarse one that is too small
        size = max(size / step**8, _FIRST[name])
        for _ in range(_STEPS):
            if (found := moved(size)) >= change:
                break
            size *= step
    return size if change <= found < np.inf else None


def opened(title: str, data: Path) -> list[Bench]:
    """Return the recordings of a machine, with uniform errors of the pulses where wanted."""
    case, jitter = MACHINES[title], JITTER.get(title, 0.0)
    rng = np.random.default_rng(7)
    return [_bench(make(data), case.model, jitter, rng) for make in case.recordings]


def _bench(recording: Recording, model: Mapping[str, Any], jitter: float, rng: Generator
           ) -> Bench:
    times = recording.reference_pulse_times
    if times is None:
        times = recording.keyphasor_pulses()
    samples = np.concatenate(list(recording.blocks(1 << 20)), axis=1)
    bench = Bench(samples, recording.sample_rate, recording.start_time,
                  times + jitter * rng.uniform(-0.5, 0.5, times.size), times, model, recording,
                  1.0)
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        averages = sa.average(
            samples, bench.rate, bench.times, start_time=bench.start, orders=model['orders'],
            trigger_cycles=model['trigger_cycles'],
            pulses_per_revolution=model.get('pulses_per_revolution', 1))
    level = float(np.median([np.abs(item.amplitudes) for item in averages]))
    return replace(bench, level=level)


def close(parts: Sequence[Bench], declared: str) -> Mapping[str, Any]:
    """Return the report on recordings with their model, or that of a parameter file (text)."""
    sections = yaml.safe_load(declared) if declared else {}
    known = {key: value for section in sections.values()
             for key, value in section['ros__parameters'].items()}
    model = parts[0].model
    values = {**model, **known, 'keyphasor_rate': model['keyphasor_rate']}
    with warnings.catch_warnings(), tempfile.TemporaryDirectory() as name:
        warnings.simplefilter('ignore')
        path = Path(name, 'model.yaml')
        path.write_text(yaml.safe_dump({'jitter_predictor': {'ros__parameters': values}}),
                        encoding='utf-8')
        return sa.close_loop([part.made() for part in parts], path).report


def outcome(report: Mapping[str, Any], name: str, parameters: Mapping[str, Any]) -> str:
    """Return what became of an effect, as a letter and a number."""
    found = {item['name']: item for item in report['missing_effects']}
    text = ''
    changes = {item['parameter']: item for item in report['declared_changes']
               if item['name'] == name and name not in found}
    if 'std' in changes:  # what the machine has and was declared, and the effect adds its power
        std = changes['std']
        off = abs(std['value'] - np.hypot(std['declared'], parameters['std']))
        text = f'F{off / std["standard_error"]:.1f}'
    elif name in found:
        rest = [abs(item['value'] - parameters[key]) / item['standard_error']
                for key, item in found[name]['parameters'].items()
                if isinstance(parameters.get(key), float) and key not in UNSURE
                and item['standard_error']]
        text = 'F' + (f'{max(rest):.1f}' if rest else '')
    elif rivals := {key for key, item in found.items()
                    if name in item['indistinguishable_from']}:
        text, found = 'R', {key: item for key, item in found.items() if key not in rivals}
    elif name in {item['name'] for item in report['present']}:
        text = 'P'
    elif report['verdict'] == 'unexplained':
        return 'U' + '+' * bool(found)
    else:
        limits = {item['name']: item for item in report['limits']}
        text = _limit(limits.get(name), parameters, name in report['undecided'])
    unexplained = bool(report['verdict'] == 'unexplained')
    return text + '+' * bool(found.keys() - {name}) + '?' * unexplained


def _limit(limit: Mapping[str, Any] | None, parameters: Mapping[str, Any], undecided: bool) -> str:
    if limit is None:
        return 'M'
    size = parameters.get(limit['parameter'])
    if limit['upper_95'] is None or size is None:
        return 'O' if undecided or limit['lower_95'] is None else 'L'
    size = float(np.sqrt(np.mean(np.square(size))))
    ratio: float = limit['upper_95'] / size
    return f'{"L" if ratio >= 1.0 else "X"}{ratio:.1f}'


def run(title: str, parts: Sequence[Bench], name: str, change: float, declared: str
        ) -> Mapping[str, Any]:
    """Put an effect in, close the loop and return what came out."""
    bench = parts[0]
    like = 'correlated_jitter' if name in UNKNOWN else name
    size = size_of(like, bench, change)
    row = {'machine': title, 'effect': name, 'change': change, 'size': size}
    if size is None or (name == 'jitter_scale' and title not in JITTER):
        return {**row, 'outcome': '-'}
    rng = np.random.default_rng([round(1e3 * change), *name.encode()])
    make = UNKNOWN[name] if name in UNKNOWN else KNOWN[name][0]
    start = time.process_time()
    try:
        report = close([make(part, rng, size) for part in parts], declared)
    except SaJitterError as error:
        return {**row, 'outcome': 'refused', 'error': str(error)}
    parameters = {} if name in UNKNOWN else dict(KNOWN[name][1](bench, size))
    for key in parameters.keys() & IN_UNITS.get(name, set()):
        parameters[key] *= bench.level
    return {**row, 'outcome': outcome(report, name, parameters), 'verdict': report['verdict'],
            'found': {item['name']: {key: (value['value'], value['standard_error'])
                                     for key, value in item['parameters'].items()}
                      for item in report['missing_effects']},
            'remains': report['remains'], 'remarks': report['remarks'],
            'limit': [(item['upper_95'], item['lower_95']) for item in report['limits']
                      if item['name'] == name],
            'before': report['error_before']['rms'], 'after': report['error_after']['rms'],
            'gain': report['gain'], 'cpu': time.process_time() - start}


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the letters of the outcomes in Markdown: effects down, machines across."""
    machines = list(dict.fromkeys(row['machine'] for row in rows))
    lines = ['| put in | ' + ' | '.join(machines) + ' |', '|---|' + '---|' * len(machines)]
    for effect in dict.fromkeys(row['effect'] for row in rows):
        cells = [[re.sub(r'[\d.]', '', row['outcome']) for row in rows
                  if (row['machine'], row['effect']) == (machine, effect)]
                 for machine in machines]
        lines.append(f'| {effect} | ' + ' | '.join(
            '-' if set(cell) <= {'-'} else ''.join(cell) for cell in cells) + ' |')
    return '\n'.join(lines)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--data', type=Path, required=True, help='folder of the recordings')
    parser.add_argument('--sizes', type=float, nargs='+', default=SIZES)
    parser.add_argument('--machines', nargs='+', default=list(MACHINES), choices=list(MACHINES))
    parser.add_argument('--effects', nargs='+', default=[*KNOWN, *UNKNOWN],
                        choices=[*KNOWN, *UNKNOWN])
    options = parser.parse_args()
    rows = []
    for title in options.machines:
        parts = opened(title, options.data)
        first = close(parts, '')
        declared = first.get('parameter_file') or ''
        print(json.dumps({'machine': title, 'verdict': first['verdict'],
                          'declared': [item['name'] for item in first['missing_effects']],
                          'remarks': first['remarks'], 'undecided': first['undecided'],
                          'rms': first['error_after']['rms']}), file=sys.stderr, flush=True)
        for name in options.effects:
            for change in options.sizes:
                rows.append(run(title, parts, name, change, declared))
                print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    print(table(rows))


if __name__ == '__main__':
    main()
