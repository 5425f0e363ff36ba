# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Figure 16: the linear angle law attenuates least under jitter, as predicted, on a gearbox."""

from dataclasses import asdict
from typing import Any

from matplotlib.figure import Figure
import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.averaging.average import AverageSettings
from sa_jitter_ros.pulses.angle_law import angle_law, ANGLE_LAWS, cycle_times
from scipy.stats import binomtest
from validation.bench import (
    acquire, FAST, machine, PINION_SPEED, RATIO, SLOW, TEETH, TRIGGER_CYCLES)
from validation.monte_carlo import AveragedSignal
from validation.order_tracking import fourier_lines, synchronous_average
from validation.plots import COLOURS, distribution, panel_titles, panels
from validation.results import (
    agreement, chance, compare, Effort, Finding, one_distribution, Progress, Results, SIGNIFICANCE,
    summary)

Array = NDArray[Any]

SENSORS = ('near 1', 'near 2', 'far 1', 'far 2')
HARMONICS = (TEETH, 2 * TEETH)
_GAINS = (1.0, 0.7, 0.12, 0.08)
_NOISE = 0.15
_SAMPLE_RATE = 15625.0  # Hz; a sixth of the paper's
_NEAR = 2  # sensors whose noise is small beside the jitter
_REACH = 12  # pulses on either side that a law is probed with
_ORDINARY = 2.0  # standard errors


def run(effort: Effort, progress: Progress) -> Results:
    """Reproduce Fig. 16."""
    shape = effort.acquisitions, len(SENSORS), len(HARMONICS)
    ratios = {law: np.empty(shape) for law in ANGLE_LAWS}
    for k in range(effort.acquisitions):
        vibration, pulses = acquire(machine(
            sample_rate=_SAMPLE_RATE, seed=1600 + k, channel_gains=_GAINS, noise_std=_NOISE))
        for law, values in ratios.items():
            slow, fast = (amplitudes(vibration, np.ceil(pulses * clock) / clock, law)
                          for clock in (SLOW, FAST))
            values[k] = slow / fast
        progress((k + 1.0) / effort.acquisitions)
    predicted = predicted_ratios(effort.iterations // 4, seed=16)
    numbers = {
        'order_and_law': {f'order {order}, {law}': {
            sensor: summary(ratios[law][:, s, h]) for s, sensor in enumerate(SENSORS)}
            for h, order in enumerate(HARMONICS) for law in ANGLE_LAWS},
        'predicted': {f'order {order}': summary(predicted[:, h])
                      for h, order in enumerate(HARMONICS)},
        'linear_against_predicted': {f'order {order}, {sensor}': asdict(
            compare(ratios['linear'][:, s, h], predicted[:, h]))
            for h, order in enumerate(HARMONICS) for s, sensor in enumerate(SENSORS)},
        'mean_square_angle_error': {law: mean_square_error(law) for law in ANGLE_LAWS}}
    return Results(
        'Angle laws under jitter: Fig. 16', numbers, _findings(ratios, predicted, numbers),
        {'fig16': _figure(ratios, predicted)},
        ('The bench is simulated: Table 4 (N_t = 41, r = 2.40789, orders 19 and 38, keyphasors '
         f'sampled at {FAST:g} and {SLOW:g} Hz by clocks with common ticks), mesh at 1900 Hz.',
         'Not in the text: a slow speed wander of 0.2 %, mesh amplitudes 1 and 0.6, sensor gains '
         f'{_GAINS}, white noise of {_NOISE} a sample; vibration sampled at {_SAMPLE_RATE:g} Hz, '
         'where the band-limited interpolation still loses nothing at 3800 Hz; 256 points a '
         'revolution (Table 4: 1024).',
         f'{effort.acquisitions} acquisitions.'))


def amplitudes(vibration: Array, pulses: Array, law: str) -> Array:
    """Return the mesh amplitudes of the averaged waveform, shape (channel, harmonic)."""
    settings = AverageSettings(cycle_length=RATIO, trigger_cycles=TRIGGER_CYCLES,
                               orders=(float(TEETH),), samples_per_revolution=256, angle_law=law)
    average = synchronous_average(vibration, _SAMPLE_RATE, pulses, settings)
    return np.abs(fourier_lines(average, list(HARMONICS)))


def predicted_ratios(iterations: int, *, seed: int) -> Array:
    """
    Return draws of slow over fast amplitude for the linear law, shape (iterations, harmonics).

    The clocks have common ticks, so the error of the slow one is that of the fast one and 0 to 3
    of its ticks more.
    """
    rng = np.random.default_rng(seed)
    shape = (iterations, TRIGGER_CYCLES + 1)
    fast = rng.uniform(0.0, 1.0, shape)
    slow = fast + rng.integers(0, round(FAST / SLOW), shape)
    cycles = PINION_SPEED / FAST
    ratios = []
    for order in HARMONICS:
        signal = AveragedSignal(TRIGGER_CYCLES, RATIO, float(order))
        ratios.append(np.abs(signal.whole_fundamental_cycles(cycles * slow)
                             / signal.whole_fundamental_cycles(cycles * fast)))
    return np.stack(ratios, axis=1)


def mean_square_error(law: str) -> float:
    """
    Return the mean square angle error of a law for independent pulse errors of unit variance.

    The law is linearised about equally spaced pulses; 2/3 for the linear law (Eq. 16).
    """
    u = np.linspace(0.0, 1.0, 65)[:-1] + 1.0 / 128.0
    pulses = np.arange(2.0 * _REACH + 2.0)
    exact = cycle_times(angle_law(law), pulses, _REACH, u)
    step = 1e-5
    square = 0.0
    for k in range(pulses.size):
        moved = pulses.copy()
        moved[k] += step
        response = (cycle_times(angle_law(law), moved, _REACH, u) - exact) / step
        square += float(np.mean(response**2))
    return square


def excess_factor(ratios: Array, predicted: list[float]) -> tuple[float, float]:
    """
    Return by how much the first harmonic exceeds its predicted scatter more than the second does.

    `ratios` (acquisition, sensor, harmonic), `predicted` standard deviations of the harmonics. The
    result is the mean logarithm over the sensors, with its jackknife standard error.
    """
    def mean_logarithm(part: Array) -> float:
        first, second = np.log(np.std(part, axis=0) / predicted).T
        return float(np.mean(first - second))

    count = len(ratios)
    without = [mean_logarithm(np.delete(ratios, k, axis=0)) for k in range(count)]
    return mean_logarithm(ratios), float(np.sqrt((count - 1.0) * np.var(without)))


def _findings(ratios: dict[str, Array], predicted: Array, numbers: dict[str, Any],
              ) -> tuple[Finding, ...]:
    linear = ratios['linear']
    near = [compare(linear[:, s, h], predicted[:, h])
            for h in range(len(HARMONICS)) for s in range(_NEAR)]
    means = ', '.join(
        f'order {order}: {np.mean(linear[:, :_NEAR, h]):.4f} (predicted '
        f'{np.mean(predicted[:, h]):.4f})' for h, order in enumerate(HARMONICS))
    gap = max(abs(float(np.mean(linear[:, s, h]) - np.mean(predicted[:, h])))
              for h in range(len(HARMONICS)) for s in range(_NEAR))
    spread = {sensor: [float(np.std(linear[:, s, h])) for h in range(len(HARMONICS))]
              for s, sensor in enumerate(SENSORS)}
    stds = [float(np.std(predicted[:, h])) for h in range(len(HARMONICS))]
    losses = {law: [1.0 - float(np.mean(values[:, :_NEAR, h])) for h in range(len(HARMONICS))]
              for law, values in ratios.items()}
    tests = {law: binomtest(
        int(np.sum(linear[:, :_NEAR].mean(axis=1) > values[:, :_NEAR].mean(axis=1))),
        linear.shape[0] * len(HARMONICS), alternative='greater').pvalue
        for law, values in ratios.items() if law != 'linear'}
    advantage = {law: float(np.min(np.mean(linear - values, axis=0)))
                 for law, values in ratios.items() if law != 'linear'}
    excess = [[spread[sensor][h] / stds[h] for h in range(len(HARMONICS))] for sensor in SENSORS]
    nearer, error_of_nearer = excess_factor(linear, stds)

    def listed(values: list[float]) -> str:
        return ' and '.join(f'{value:.4f}' for value in values)

    return (
        Finding('Fig. 16a,b', 'the mean attenuation is predicted very well',
                f'mean ratio of the near sensors {means}; KS: smallest p '
                f'{min(item.p_value for item in near):.3f}',
                agreement(gap < 0.005, one_distribution(near))),
        Finding('Fig. 16a,b', 'more dispersion than predicted, by noise, least close to the mesh',
                'orders 19 and 38: predicted ' + listed(stds)
                + f'; near 1 {listed(spread["near 1"])}; far 2 {listed(spread["far 2"])}',
                agreement(*(spread['far 2'][h] > max(spread['near 1'][h], stds[h])
                            for h in range(len(HARMONICS))))),
        Finding('Fig. 16a,b', 'close to the mesh, the dispersion of the second harmonic '
                'is nearer to the prediction',
                'over predicted, orders 19 and 38: '
                + '; '.join(f'{sensor} {first:.2f} and {second:.2f}'
                            for sensor, (first, second) in zip(SENSORS[:_NEAR], excess))
                + f'; logarithm of first over second {nearer:.3f} +- {error_of_nearer:.3f}',
                agreement(*(second < first for first, second in excess[:_NEAR]),
                          nearer > _ORDINARY * error_of_nearer),
                f'Not significant with {len(linear)} acquisitions.'),
        Finding('Fig. 16c-f', 'the linear law loses less than quadratic law and spline',
                'loss of orders 19 and 38 (near sensors): '
                + '; '.join(f'{law} {listed(values)}' for law, values in losses.items())
                + '; sign tests '
                f'{chance(tests["quadratic"])} and {chance(tests["spline"])}',
                agreement(*(value < SIGNIFICANCE for value in tests.values()),
                          min(advantage.values()) > 0.0),
                'As the [angle errors](theory.md#angle-laws).'),
    )


def _figure(ratios: dict[str, Array], predicted: Array) -> Figure:
    figure, axes = panels(len(HARMONICS), len(ANGLE_LAWS), height=2.8)
    titles = []
    for row, law in enumerate(ANGLE_LAWS):
        for h, order in enumerate(HARMONICS):
            one = axes[row * len(HARMONICS) + h]
            distribution(one, predicted[:, h], color='black', label='predicted (linear law)')
            for s, sensor in enumerate(SENSORS):
                distribution(one, ratios[law][:, s, h], color=COLOURS[s], linestyle='dashed',
                             label=sensor)
            shown = [predicted[:, h], *(values[:, :, h] for values in ratios.values())]
            one.set_xlim(min(part.min() for part in shown), max(part.max() for part in shown))
            one.set_xlabel('amplitude ratio, slow over fast keyphasor')
            one.set_ylabel('distribution function')
            titles.append(f'{law} law, order {order}')
    axes[0].legend(fontsize=7)
    panel_titles(axes, titles)
    return figure
