# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Table 5 and Figure 21: jitter added to the pulses of a fleet in flight, on simulated flights."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
import math
from typing import Any

from matplotlib.figure import Figure
import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.averaging.average import AverageSettings
from sa_jitter_ros.simulation import AdditiveNoise, band_limited, Component, Gearbox, mesh
from validation.monte_carlo import AveragedSignal
from validation.order_tracking import fourier_lines, synchronous_average
from validation.plots import distribution, panel_titles, panels
from validation.results import (
    agreement, compare, Comparison, Effort, Finding, one_distribution, Progress, Results, summary)

Array = NDArray[Any]

#: Table 5: N_t, r, teeth, helicopters; the widths are in mesh cycles, the first that of Fig. 21.
TRIGGER_CYCLES, RATIO, TEETH, HELICOPTERS = 21, 5.8154, 23, 14
WIDTHS = (0.4, 0.2)
HARMONICS = (TEETH, 2 * TEETH)
#: Standard deviation of the noise of a sample, mesh amplitude 1, from helicopter to helicopter.
NOISE = np.geomspace(0.25, 4.0, HELICOPTERS)

_TRIGGER_SPEED, _REGIMES = 20.0, 0.02  # Hz; largest relative difference between regimes
_LOADS = (0.7, 1.3)
_SAMPLE_RATE = 20480.0  # Hz, of vibration and keyphasor
_SPEED_STD, _SPEED_BAND = 2e-3, (0.1, 1.0)  # relative; Hz, of a heavy rotor
_MARGIN = 3  # trigger cycles recorded beyond the average
_SEEDS = 21_000
_CLOSE = 0.005  # of a mean ratio of 1
_ORDINARY = 4.0  # standard errors


@dataclass(frozen=True)
class Flights:
    """
    Amplitude ratios of the acquisitions of one helicopter, (acquisition, width, harmonic).

    `ratios` are measured, `expected` those of the model under the same pulse errors.
    """

    noise: float
    ratios: Array
    expected: Array


def machine(*, seed: int, speed: float, load: float, noise_std: float) -> Gearbox:
    """Return a gearbox in one acquisition: trigger shaft at `speed` Hz, mesh amplitude `load`."""
    pinion = mesh('intermediate', TEETH, harmonics=(load, 0.6 * load, 0.2 * load),
                  sidebands={1.0: 0.08, 2.0: 0.04}, seed=2)
    others = tuple(Component('tail', order, (size * load,), (0.3 * order,))
                   for order, size in ((1.0, 0.1), (31.0, 0.4), (62.0, 0.2)))
    return Gearbox(
        components=(*pinion, *others), sample_rate=_SAMPLE_RATE,
        shafts={'intermediate': RATIO, 'tail': 1.0}, speed=((0.0, speed),),
        fluctuation=band_limited(std=_SPEED_STD, band=_SPEED_BAND, seed=seed, name='fleet speed'),
        effects=(AdditiveNoise(noise_std),), seed=seed)


def acquisition(seed: int, noise_std: float) -> tuple[Array, Array]:
    """Return the ratios (width, harmonic) of one acquisition, and those of the model."""
    rng = np.random.default_rng([_SEEDS, seed])
    speed = _TRIGGER_SPEED * (1.0 + rng.uniform(-_REGIMES, _REGIMES))
    gearbox = machine(seed=seed, speed=speed, load=rng.uniform(*_LOADS), noise_std=noise_std)
    seconds = (TRIGGER_CYCLES + _MARGIN) / speed
    vibration = gearbox.vibration(0, math.ceil(seconds * _SAMPLE_RATE)).T
    exact = gearbox.pulses(0.0, seconds - 1.0 / speed).times[:TRIGGER_CYCLES + 1]
    pulses = np.ceil(exact * _SAMPLE_RATE) / _SAMPLE_RATE
    added = rng.uniform(-0.5, 0.5, pulses.size) / (TEETH * RATIO * speed)
    every = [pulses, *(pulses + width * added for width in WIDTHS)]
    measured = np.array([_amplitudes(vibration, item) for item in every])
    late = RATIO * gearbox.shaft_speed(exact) * (np.array(every) - exact)
    modelled = np.stack([np.abs(signal.whole_fundamental_cycles(late))
                         for signal in _signals()], axis=1)
    return measured[1:] / measured[0], modelled[1:] / modelled[0]


def _signals() -> list[AveragedSignal]:
    return [AveragedSignal(TRIGGER_CYCLES, RATIO, float(order)) for order in HARMONICS]


def _amplitudes(vibration: Array, pulses: Array) -> Array:
    settings = AverageSettings(cycle_length=RATIO, trigger_cycles=TRIGGER_CYCLES,
                               orders=(float(TEETH),), samples_per_revolution=256)
    average = synchronous_average(vibration, _SAMPLE_RATE, pulses, settings)
    return np.asarray(np.abs(fourier_lines(average, list(HARMONICS))[0]))


def fly(acquisitions: int, progress: Progress) -> list[Flights]:
    """Return the flights of all helicopters, `acquisitions` in the whole fleet."""
    fleet = []
    for helicopter, seeds in enumerate(np.array_split(np.arange(acquisitions), HELICOPTERS)):
        found = [acquisition(int(seed), float(NOISE[helicopter])) for seed in seeds]
        fleet.append(Flights(float(NOISE[helicopter]), *(np.array(part) for part in zip(*found))))
        progress((helicopter + 1.0) / HELICOPTERS)
    return fleet


def predicted_ratios(iterations: int, noise_std: float, *, seed: int) -> Array:
    """
    Return draws of the ratios, shape (iterations, width, harmonic), at this noise of a sample.

    The keyphasor's own error is uniform over a tick. Both averages read the same noise: that of
    the jittered one follows the other as far as the component itself does.
    """
    rng = np.random.default_rng(seed)
    shape = (iterations, TRIGGER_CYCLES + 1)
    tick = rng.uniform(0.0, RATIO * _TRIGGER_SPEED / _SAMPLE_RATE, shape)
    added = rng.uniform(-0.5, 0.5, shape) / TEETH
    # E|n|^2 of one line in peak units, beside an amplitude of 1
    variance = 4.0 * noise_std**2 * _TRIGGER_SPEED / (_SAMPLE_RATE * TRIGGER_CYCLES)
    ratios = np.empty((iterations, len(WIDTHS), len(HARMONICS)))
    for h, (signal, size) in enumerate(zip(_signals(), (1.0, 0.6))):
        scale = math.sqrt(0.5 * variance) / (size * rng.uniform(*_LOADS, iterations))
        first, other = (scale * (rng.normal(size=(iterations, 2)) @ np.array([1.0, 1j]))
                        for _ in range(2))
        plain = signal.whole_fundamental_cycles(tick)
        for w, width in enumerate(WIDTHS):
            jittered = signal.whole_fundamental_cycles(tick + width * added)
            shared = signal.whole_fundamental_cycles(width * added)
            noise = shared * first + np.sqrt(1.0 - np.minimum(np.abs(shared), 1.0)**2) * other
            ratios[:, w, h] = np.abs(jittered + noise) / np.abs(plain + first)
    return ratios


def run(effort: Effort, progress: Progress) -> Results:
    """Reproduce Table 5 and Fig. 21."""
    fleet = fly(effort.flights, progress)
    iterations = effort.iterations // 4
    predicted = predicted_ratios(iterations, 0.0, seed=21)
    noisy = [predicted_ratios(iterations, item.noise, seed=2100 + k)
             for k, item in enumerate(fleet)]
    cases = [(w, h) for w in range(len(WIDTHS)) for h in range(len(HARMONICS))]
    numbers = {
        'acquisitions': [len(item.ratios) for item in fleet],
        'noise_std': [item.noise for item in fleet],
        'helicopters': {_name(w, h): [summary(item.ratios[:, w, h]) for item in fleet]
                        for w, h in cases},
        'predicted': {_name(w, h): summary(predicted[:, w, h]) for w, h in cases},
        'against_predicted': [asdict(compare(item.ratios[:, 0, 0], predicted[:, 0, 0]))
                              for item in fleet],
        'against_predicted_with_noise': {_name(w, h): [
            asdict(compare(item.ratios[:, w, h], draws[:, w, h]))
            for item, draws in zip(fleet, noisy)] for w, h in cases}}
    return Results(
        'A fleet in flight: Table 5, Fig. 21', numbers, _findings(fleet, predicted, noisy),
        {'fig21': _figure(fleet, predicted, noisy)},
        ('The flight recordings are not public. Flights are simulated with the numbers of Table 5 '
         f'(N_t = {TRIGGER_CYCLES}, r = {RATIO}, order {TEETH}, {effort.flights} acquisitions of '
         f'{HELICOPTERS} helicopters, uniform pulse errors of {WIDTHS[0]} mesh cycles added to '
         'the measured times), and processed by steps 1 to 5 of Section 5.2.2.',
         f'Not in the text (proprietary): a trigger shaft at {_TRIGGER_SPEED:g} Hz, so the mesh '
         f'at {TEETH * RATIO * _TRIGGER_SPEED:.0f} Hz, vibration and keyphasor sampled at '
         f'{_SAMPLE_RATE:g} Hz, whose ticks are the error of the measured times; 256 points a '
         'revolution (Table 5: 1024).',
         f'Also ours: regimes of {100.0 * _REGIMES:g} % in speed and of {_LOADS[0]} to '
         f'{_LOADS[1]} in load, drawn for each acquisition, a slow speed wander of '
         f'{100.0 * _SPEED_STD:g} %, mesh amplitudes 1 and 0.6, white noise of {NOISE[0]:g} to '
         f'{NOISE[-1]:g} a sample from helicopter to helicopter.'))


def _name(width: int, harmonic: int) -> str:
    return f'D={WIDTHS[width]} mesh cycles, order {HARMONICS[harmonic]}'


def _findings(fleet: list[Flights], predicted: Array, noisy: list[Array],
              ) -> tuple[Finding, ...]:
    first = [item.ratios[:, 0, 0] for item in fleet]
    plain = predicted[:, 0, 0]
    tests = [compare(item, plain) for item in first]
    pooled = np.concatenate(first)
    gap = float(pooled.mean() - plain.mean())
    spread = [float(np.std(item)) for item in first]
    explained = [compare(item, draws[:, 0, 0]) for item, draws in zip(first, noisy)]
    scatter = [float(np.std(draws[:, 0, 0])) for draws in noisy]
    same = [np.concatenate([item.ratios[:, 0, 0] - item.expected[:, 0, 0]
                            for item in part]) for part in (fleet[:1], fleet[-1:])]
    z = same[0].mean() / (same[0].std() / math.sqrt(same[0].size))
    others = _other_cases(fleet, noisy)
    return (
        Finding('Table 5, Fig. 21',
                'amplitude ratios of each helicopter are distributed as predicted',
                f'mean ratio {pooled.mean():.4f} (predicted {plain.mean():.4f}); KS of '
                f'{len(tests)} helicopters: smallest p '
                f'{min(item.p_value for item in tests):.2g}',
                agreement(abs(gap) < _CLOSE, one_distribution(tests))),
        Finding('Fig. 21', 'more dispersion than predicted, by noise',
                f'standard deviation predicted {np.std(plain):.4f}; least to most noise '
                f'{spread[0]:.4f} to {spread[-1]:.4f}, predicted with it {scatter[0]:.4f} to '
                f'{scatter[-1]:.4f}; KS: smallest p '
                f'{min(item.p_value for item in explained):.3f}',
                agreement(spread[-1] > float(np.std(plain)), one_distribution(explained))),
        Finding('Section 5.2.2', 'added pulse errors are properly described by the model',
                'same errors: measured minus modelled ratio '
                f'{same[0].mean():.5f} +- {same[0].std():.4f} with the least noise, '
                f'{same[1].mean():.5f} +- {same[1].std():.4f} with the most',
                agreement(abs(z) < _ORDINARY, float(same[0].std()) < 0.2 * spread[0]),
                'Speed changes within trigger cycles remain.'),
        Finding('Section 5.2.2', 'consistent for other uncertainties and harmonics',
                '; '.join(f'{name}: mean {mean:.4f} (predicted {expected:.4f})'
                          for name, (mean, expected, _) in others.items())
                + '; KS: smallest p '
                f'{min(item.p_value for *_, tests in others.values() for item in tests):.3f}',
                agreement(one_distribution(
                    [item for *_, tests in others.values() for item in tests]))))


def _other_cases(fleet: list[Flights], noisy: list[Array],
                 ) -> Mapping[str, tuple[float, float, list[Comparison]]]:
    """Return mean, predicted mean and tests of the cases that Fig. 21 does not show."""
    found = {}
    for w in range(len(WIDTHS)):
        for h in range(len(HARMONICS)):
            if w or h:
                found[_name(w, h)] = (
                    float(np.mean(np.concatenate([item.ratios[:, w, h] for item in fleet]))),
                    float(np.mean([draws[:, w, h].mean() for draws in noisy])),
                    [compare(item.ratios[:, w, h], draws[:, w, h])
                     for item, draws in zip(fleet, noisy)])
    return found


def _figure(fleet: list[Flights], predicted: Array, noisy: list[Array]) -> Figure:
    figure, axes = panels(2)
    for item in fleet:
        distribution(axes[0], item.ratios[:, 0, 0], color='tab:blue', linestyle='dotted')
    distribution(axes[0], predicted[:, 0, 0], color='black', label='predicted')
    axes[0].plot([], [], color='tab:blue', linestyle='dotted',
                 label=f'{len(fleet)} helicopters')
    for colour, k in (('tab:green', 0), ('tab:red', len(fleet) - 1)):
        distribution(axes[1], fleet[k].ratios[:, 0, 0], color=colour, linestyle='dotted')
        distribution(axes[1], noisy[k][:, 0, 0], color=colour,
                     label=f'predicted, noise {fleet[k].noise:g}')
    for one in axes:
        one.set_xlabel('amplitude ratio, jittered over measured pulses')
        one.set_ylabel('distribution function')
        one.legend(fontsize=8)
    panel_titles(axes, ['predicted without noise', 'least and most noise'])
    return figure
