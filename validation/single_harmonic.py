# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Tables 1 to 3 and Figs. 4 to 6: the amplitude of one harmonic, three ways to compute it."""

from dataclasses import asdict, dataclass
import math
from typing import Any

from matplotlib.figure import Figure
import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.prediction.distributions import Uniform
from scipy.stats import kstest
from validation.monte_carlo import AveragedSignal, monte_carlo
from validation.order_tracking import as_in_table_1, HarmonicCase, simulate
from validation.plots import COLOURS, distribution, panel_titles, panels
from validation.results import (
    agreement, compare, Comparison, Effort, Finding, one_distribution, Progress, Results,
    SIGNIFICANCE, stage, summary)

Array = NDArray[Any]

#: Table 3: number of the simulation, N_t, r, width of the pulse error in fundamental cycles.
TABLE_3 = ((1, 40, 1.0, 0.2), (2, 60, 1.0, 0.2), (3, 80, 1.0, 0.2), (4, 100, 1.0, 0.2),
           (5, 40, 2.286, 0.2), (6, 60, 2.286, 0.2), (7, 80, 2.286, 0.2), (8, 100, 2.286, 0.2),
           (9, 100, 2.286, 0.1), (10, 100, 2.286, 0.3), (11, 100, 2.286, 0.4),
           (12, 100, 75.27, 0.2))

_CHECKED = 2  # simulations repeated with Table 1's sampling rate and interpolator
_SEEDS = 1_000_000  # of each case's simulations
_EXACT_ENOUGH = 1e-4  # of an amplitude of 1


@dataclass(frozen=True)
class Samples:
    """
    Amplitudes of one case: full simulation, exact and approximate model.

    `gap` is the largest difference between simulation and exact model under the same errors,
    `order_gap` that of the amplitudes over whole trigger cycles.
    """

    case: HarmonicCase
    simulated: Array
    exact: Array
    approximate: Array
    gap: float
    order_gap: float

    @property
    def simulation_test(self) -> Comparison:
        """Return the test of the simulation against the exact model."""
        return compare(self.simulated, self.exact)

    @property
    def approximation_test(self) -> Comparison:
        """Return the test of the approximate model against the exact one."""
        return compare(self.approximate, self.exact)


def harmonic_case(trigger_cycles: int, ratio: float, width: float) -> HarmonicCase:
    """Return a case of Table 3; a long trigger cycle is sampled more coarsely."""
    if ratio > 10.0:
        return HarmonicCase(trigger_cycles, ratio, width, sample_rate=256.0,
                            samples_per_revolution=32)
    return HarmonicCase(trigger_cycles, ratio, width)


def sample(case: HarmonicCase, effort: Effort, seed: int, progress: Progress) -> Samples:
    """Draw the amplitude of order 1 by simulation and by both numerical models."""
    simulated = simulate(case, effort.simulations, seed=_SEEDS * seed, progress=progress)
    orders, amplitudes = zip(*case.harmonics)
    signal = AveragedSignal(case.trigger_cycles, case.cycle_length, 1.0, orders, amplitudes)
    exact, approximate = (
        monte_carlo(model, Uniform(case.width), case.trigger_cycles, effort.iterations, seed=seed)
        for model in (signal.whole_fundamental_cycles, signal.majority_assignment))
    gaps = (simulated.amplitudes - signal.whole_fundamental_cycles(simulated.errors),
            simulated.order_amplitudes - signal.whole_trigger_cycles(simulated.errors))
    return Samples(case, np.abs(simulated.amplitudes), np.abs(exact), np.abs(approximate),
                   *(float(np.abs(gap).max()) for gap in gaps))


def report(samples: Samples) -> dict[str, Any]:
    """Return the numbers of one case."""
    return {
        'trigger_cycles': samples.case.trigger_cycles, 'ratio': samples.case.cycle_length,
        'width': samples.case.width, 'sample_rate': samples.case.sample_rate,
        'samples_per_revolution': samples.case.samples_per_revolution,
        'simulated': summary(samples.simulated), 'exact': summary(samples.exact),
        'approximate': summary(samples.approximate),
        'simulated_against_exact': asdict(samples.simulation_test),
        'approximate_against_exact': asdict(samples.approximation_test),
        'largest_difference_under_the_same_errors': samples.gap,
        'largest_difference_over_whole_trigger_cycles': samples.order_gap}


def draw(axes: Any, curves: list[tuple[str, Samples]]) -> None:
    """Draw the distribution functions of several cases as the paper does."""
    for colour, (label, item) in zip(COLOURS, curves):
        distribution(axes, item.exact, color=colour, label=label)
        distribution(axes, item.approximate, color=colour, linestyle='dashdot')
        distribution(axes, item.simulated, color=colour, linestyle='dashed', linewidth=1.0)
    for style, label in (('solid', 'exact model'), ('dashdot', 'approximate model'),
                         ('dashed', 'full simulation')):
        axes.plot([], [], color='black', linestyle=style, label=label)
    axes.set_xlabel('amplitude of the harmonic (1 without jitter)')
    axes.set_ylabel('distribution function')
    axes.legend(fontsize=7)


def run(effort: Effort, progress: Progress) -> Results:
    """Reproduce Tables 1 to 3 and Figs. 4 to 6."""
    cases: dict[int, Samples] = {}
    for k, (number, cycles, ratio, width) in enumerate(TABLE_3):
        cases[number] = sample(harmonic_case(cycles, ratio, width), effort, number,
                               stage(progress, k, len(TABLE_3)))
    check = cases[8].case
    coarse, fine = (
        simulate(item, _CHECKED, seed=_SEEDS * 8, progress=lambda done: None).amplitudes
        for item in (check, as_in_table_1(check)))
    sampling_gap = float(np.abs(coarse - fine).max())
    places = np.concatenate([np.searchsorted(np.sort(item.exact), item.simulated)
                             / item.exact.size for item in cases.values()])
    pooled = kstest(places, 'uniform', method='asymp')
    numbers = {
        'simulations': {str(number): report(item) for number, item in cases.items()},
        'pooled': {'distance': float(pooled.statistic), 'size': places.size,
                   'p_value': float(pooled.pvalue)},
        'largest_difference_to_the_sampling_of_table_1': sampling_gap}
    return Results(
        'Single harmonic: Tables 1 to 3, Figs. 4 to 6', numbers,
        _findings(cases, numbers), _figures(cases),
        (f'Full simulations are run {effort.simulations} times a case (Table 1: 1E4) and the '
         f'numerical models {effort.iterations} times (Table 2: 1E6); `--simulations` and '
         '`--iterations` raise both.',
         'Amplitudes are Fourier lines of the averaged waveform, so over whole fundamental '
         'cycles, as in the paper. `order_amplitude` integrates over whole trigger cycles, where '
         'r has no influence at all on a single harmonic.',
         'The vibration is sampled at 2048 Hz (simulation 12: 256 Hz and 32 angular samples) and '
         'interpolated band-limited, not at 16384 Hz with a spline. With the same pulse errors, '
         f'simulation 8 then differs from that of Table 1 by at most {sampling_gap:.1e}.'))


def _findings(cases: dict[int, Samples], numbers: dict[str, Any]) -> tuple[Finding, ...]:
    tests = [item.simulation_test for item in cases.values()]
    gap = max(item.gap for item in cases.values())
    order_gap = max(item.order_gap for item in cases.values())
    pooled = numbers['pooled']
    integer = [cases[k] for k in (1, 2, 3, 4)]
    coincidence = max(float(np.abs(item.exact - item.approximate).max()) for item in integer)
    spread = [float(np.std(cases[k].exact)) for k in (1, 4)]
    means = [float(np.mean(cases[k].exact)) for k in (1, 4)]
    widths = [cases[k] for k in (9, 8, 10, 11)]
    loss = [1.0 - float(np.mean(item.exact)) for item in widths]
    scatter = [float(np.std(item.exact)) for item in widths]
    bias = [float(np.mean(item.exact) - np.mean(item.approximate)) for item in widths]
    ratios = [cases[k] for k in (4, 8, 12)]
    ratio_means = [float(np.mean(item.exact)) for item in ratios]
    errors = [abs(float(np.mean(item.exact) - np.mean(item.approximate))) for item in ratios]
    expected = math.sqrt(100.0 / 40.0)

    def listed(values: list[float], form: str = '.4f') -> str:
        return ', '.join(format(value, form) for value in values)

    def range_of(values: list[float], form: str = '.4f') -> str:
        return f'{values[0]:{form}} to {values[-1]:{form}}'

    return (
        Finding('Figs. 4-6', 'simulations and the exact model agree very well',
                f'KS of {len(tests)} cases: smallest p {min(item.p_value for item in tests):.3f}, '
                f'pooled {pooled["p_value"]:.3f}; same errors: within {max(gap, order_gap):.1e}',
                agreement(one_distribution(tests), pooled['p_value'] > SIGNIFICANCE,
                          max(gap, order_gap) < _EXACT_ENOUGH)),
        Finding('Fig. 4a', 'for integer r the approximate model coincides with the exact one',
                f'same errors: within {coincidence:.1e}',
                agreement(coincidence < 1e-10)),
        Finding('Fig. 4', 'more revolutions mainly reduce the dispersion',
                f'N_t 40 to 100: standard deviation {spread[0]:.5f} to {spread[1]:.5f}, mean '
                f'{means[0]:.4f} to {means[1]:.4f}',
                agreement(abs(spread[0] / spread[1] / expected - 1.0) < 0.1,
                          abs(means[0] - means[1]) < spread[1])),
        Finding('Fig. 4b', 'for r = 2.286 the approximate model deviates slightly',
                'KS distance of the models, N_t 40 to 100: '
                + range_of([cases[k].approximation_test.distance for k in (5, 8)], '.3f'),
                agreement(*(item.approximation_test.p_value < 0.01
                            for item in (cases[5], cases[8])))),
        Finding('Fig. 5', 'larger D: more loss and dispersion, a worse approximate model',
                f'D 0.1 to 0.4: loss {range_of(loss)}; standard deviation {range_of(scatter)}; '
                f'means differ by {range_of(bias, ".5f")}',
                agreement(loss == sorted(loss), scatter == sorted(scatter),
                          bias == sorted(bias))),
        Finding('Fig. 6', 'r hardly changes a single harmonic',
                f'mean for r = 1, 2.286, 75.27: {listed(ratio_means, ".5f")}',
                agreement(max(ratio_means) - min(ratio_means) < 0.1 * scatter[1])),
        Finding('Fig. 6', 'the approximate model is better at a high r',
                'bias of the mean for r = 2.286 and 75.27: ' + listed(errors[1:], '.1e'),
                agreement(errors[2] < 0.2 * errors[1])),
    )


def _figures(cases: dict[int, Samples]) -> dict[str, Figure]:
    fourth, axes = panels(2)
    draw(axes[0], [(f'N_t = {cases[k].case.trigger_cycles}', cases[k]) for k in (1, 2, 3, 4)])
    draw(axes[1], [(f'N_t = {cases[k].case.trigger_cycles}', cases[k]) for k in (5, 6, 7, 8)])
    panel_titles(axes, ['r = 1, D = 0.2', 'r = 2.286, D = 0.2'])
    fifth, axes = panels(2)
    draw(axes[0], [(f'D = {cases[k].case.width}', cases[k]) for k in (9, 8, 10, 11)])
    draw(axes[1], [(f'r = {cases[k].case.cycle_length:g}', cases[k]) for k in (4, 8, 12)])
    panel_titles(axes, ['Fig. 5: r = 2.286, N_t = 100', 'Fig. 6: N_t = 100, D = 0.2'])
    return {'fig04': fourth, 'fig05-06': fifth}
