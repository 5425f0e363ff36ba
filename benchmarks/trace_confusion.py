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
Confusion matrix of the trace: simulated machines with effects that are not declared.

Run `python benchmarks/trace_confusion.py --seeds 20 --null 200`; it prints what each effect was
traced to, how the held-out error fell, and how far parameters were off in standard errors.
"""

import argparse
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
import math
from typing import Any

import numpy as np
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.inference.observation import observe
from sa_jitter_ros.inference.trace import trace
from sa_jitter_ros.inference.trace_result import Trace
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.recordings.recording import ArraySource, Recording
from sa_jitter_ros.simulation.components import mesh
from sa_jitter_ros.simulation.effect import Effect, IndexArray, Setting
from sa_jitter_ros.simulation.effects import AdditiveNoise, DeclaredJitter, make_effects
from sa_jitter_ros.simulation.gearbox import Gearbox
from sa_jitter_ros.simulation.keyphasor import Keyphasor
from sa_jitter_ros.simulation.random_streams import RandomStream

SAMPLE_RATE = 6000.0
KEYPHASOR_RATE = 5000.0
SPEED = 25.0
ORDERS = (8.0, 16.0, 24.0, 32.0)
NOISE = 0.05

#: Sizes that the matrix in the docs is for.
EFFECTS: Mapping[str, Mapping[str, Any]] = {
    'excess_jitter': {'std': 60e-6},
    'keyphasor_quantisation': {'clock_rate': 2000.0, 'period_std': 4e-6},
    'correlated_jitter': {'std': 100e-6, 'correlation': 0.7},
    'target_geometry': {'pulse_angles': (0.0, 0.02, -0.01, 0.005)},
    'speed_fluctuation': {'acceleration_std': 90.0},
    'clock_skew': {'skew': 4e-4},
    'phase_wander': {'std': 0.02},
    'missing_pulses': {'probability': 0.01},
    'interpolation_loss': {'method': 'linear'},
    'additive_noise': {'std': 1.0},
    'amplitude_modulation': {'std': 0.3},
    'interfering_tone': {'frequency': 400.9, 'amplitude': 0.12},
}

PAIRS = (('keyphasor_quantisation', 'clock_skew'), ('target_geometry', 'excess_jitter'),
         ('excess_jitter', 'amplitude_modulation'), ('speed_fluctuation', 'additive_noise'),
         ('clock_skew', 'correlated_jitter'), ('missing_pulses', 'excess_jitter'))


class Hum(Effect):
    """Unknown to every module: the trigger level hums, 100 us at a frequency that is no order."""

    def pulse_delay(self, setting: Setting, index: IndexArray, times: FloatArray) -> FloatArray:
        """Return the delay of each pulse."""
        return 100e-6 * np.sin(2.0 * np.pi * 0.2871 * setting.trigger_rate * times + setting.seed)


class Bursts(Effect):
    """Unknown to every module: one pulse in eight is up to 400 us late."""

    def pulse_delay(self, setting: Setting, index: IndexArray, times: FloatArray) -> FloatArray:
        """Return the delay of each pulse."""
        late = RandomStream(setting.seed, 'bursts', rows=2).uniform(
            int(index[0]), int(index[-1]) + 1)
        return np.asarray(np.where(late[0] < 0.125, 400e-6 * late[1], 0.0))


class Switching(Effect):
    """Unknown to every module: jitter that switches on for stretches of the record."""

    def pulse_delay(self, setting: Setting, index: IndexArray, times: FloatArray) -> FloatArray:
        """Return the delay of each pulse."""
        noise = RandomStream(setting.seed, 'switching').normal(int(index[0]), int(index[-1]) + 1)
        return np.asarray(np.where(np.sin(2.0 * np.pi * times / 5.0 + setting.seed) > 0.6,
                                   160e-6 * noise[0], 0.0))


UNKNOWN: Mapping[str, type[Effect]] = {'hum': Hum, 'bursts': Bursts, 'switching': Switching}


def machine(effects: Sequence[Effect], *, seed: int, pulses: int = 1, ratio: float = 1.0,
            jitter: bool = True) -> Gearbox:
    """Return a gearbox with the declared jitter and noise, and more effects."""
    declared: list[Effect] = [AdditiveNoise(NOISE, name='declared_noise')]
    if jitter:
        declared.append(DeclaredJitter('uniform', 1.0 / math.sqrt(12.0) / KEYPHASOR_RATE))
    return Gearbox(
        mesh('shaft', 8, harmonics=(1.0, 0.8, 0.6, 0.5), channel_gains=(1.0, 0.7, 0.9), seed=seed),
        SAMPLE_RATE, shafts={'shaft': ratio}, speed=((0.0, SPEED / ratio),),
        keyphasor=Keyphasor(pulses_per_revolution=pulses, pulses_per_trigger=1),
        effects=(*declared, *effects), seed=seed)


def recording(gearbox: Gearbox, duration: float) -> Recording:
    """Return a recording of a machine, as a file would hold it."""
    samples = round(duration * gearbox.sample_rate)
    return Recording(
        ArraySource(gearbox.vibration(0, samples)), gearbox.sample_rate,
        pulse_times=gearbox.pulses(0.0, duration).times,
        pulses_per_revolution=gearbox.keyphasor.pulses_per_revolution,
        pulses_per_trigger=gearbox.keyphasor.pulses_per_trigger,
        ratio=gearbox.shafts['shaft'])


def model(*, trigger_cycles: int = 20, pulses: int = 1, ratio: float = 1.0) -> DeclaredModel:
    """Return what is declared of the machine."""
    return DeclaredModel(
        keyphasor_rate=KEYPHASOR_RATE, trigger_speed=SPEED / ratio, trigger_cycles=trigger_cycles,
        orders=ORDERS, ratio=ratio, pulses_per_revolution=pulses, pulses_per_trigger=1,
        noise_std=NOISE, sample_rate=SAMPLE_RATE)


def run(seed: int, names: Sequence[str], *, acquisitions: int = 24) -> Trace:
    """Trace one simulated machine with these effects."""
    geometry = 'target_geometry' in names
    pulses, ratio = (4, 4.0) if geometry else (1, 1.0)
    effects = (*make_effects({name: EFFECTS[name] for name in names if name in EFFECTS}),
               *(UNKNOWN[name]() for name in names if name in UNKNOWN))
    gearbox = machine(effects, seed=seed, pulses=pulses, ratio=ratio,
                      jitter='keyphasor_quantisation' not in names)
    declared = model(pulses=pulses, ratio=ratio)
    taken = recording(gearbox, (acquisitions * declared.trigger_cycles + 3) / SPEED)
    if 'keyphasor_quantisation' in names:
        declared = replace(
            declared, keyphasor_rate=EFFECTS['keyphasor_quantisation']['clock_rate'])
    return trace([observe(taken, declared)], [taken])


def fell(found: Trace, *, known: bool = False) -> bool:
    """
    Tell whether the held-out RMS, less its standard error, fell at least five-fold.

    The standard error is that of the mean residual: of the held-out mean and of the prediction,
    whose parameters come from half of the acquisitions; with `known` parameters the former only.
    """
    error = found.after.rms_standard_error**2 - known * found.after.rms_parameter_error**2
    remaining = math.sqrt(max(found.after.rms**2 - error, 0.0))
    return bool(found.findings) and remaining <= 0.2 * found.before.rms


def answer(found: Trace) -> str:
    """Return the effects that were found and the verdict."""
    names = '+'.join(item.name for item in found.findings)
    return f'{names or "-"} ({found.verdict})'


def one(seed: int, names: Sequence[str], acquisitions: int
        ) -> tuple[str, float, float, float, float, str, bool, bool]:
    """Return the verdict and the errors of one run."""
    found = run(seed, names, acquisitions=acquisitions)
    values = '; '.join(f'{item.effect.values} +- {dict(item.standard_errors)}'
                       for item in found.findings if item.effect is not None)
    return (answer(found), found.before.rms, found.after.rms, found.before.chi2_per_dof,
            found.after.chi2_per_dof, values, fell(found), fell(found, known=True))


def main() -> None:
    """Print the confusion matrix."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seeds', type=int, default=20)
    parser.add_argument('--null', type=int, default=200)
    parser.add_argument('--effects', nargs='*', default=list(EFFECTS))
    parser.add_argument('--unknown', type=int, default=20, help='runs of each unknown effect')
    parser.add_argument('--pairs', type=int, default=10, help='runs of each pair')
    parser.add_argument('--acquisitions', type=int, default=24, help='of each run')
    parser.add_argument('--workers', type=int, default=1)
    parser.add_argument('--verbose', action='store_true')
    options = parser.parse_args()
    with ProcessPoolExecutor(options.workers) as pool:
        for names, seeds in [*(((name,), options.seeds) for name in options.effects),
                             *(((name,), options.unknown) for name in UNKNOWN),
                             *((pair, options.pairs) for pair in PAIRS), ((), options.null)]:
            if not seeds:
                continue
            rows = list(pool.map(partial(one, names=names, acquisitions=options.acquisitions),
                                 range(seeds)))
            print(f'\n{"+".join(names) or "declared model"}: {seeds} runs')
            for verdict, count in Counter(row[0] for row in rows).most_common():
                print(f'  {count:4d}  {verdict}')
            errors = np.median([row[1:5] for row in rows], axis=0)
            print(f'  median RMS {errors[0]:.4f} -> {errors[1]:.4f}, chi2/dof '
                  f'{errors[2]:.3g} -> {errors[3]:.3g}; RMS fell five-fold in '
                  f'{sum(row[6] for row in rows)}, {sum(row[7] for row in rows)} if the '
                  'parameters counted as known', flush=True)
            if options.verbose:
                for row in rows:
                    print('     ', row[0], f'{row[1]:.4f} -> {row[2]:.4f}', row[5])


if __name__ == '__main__':
    main()
