# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Figure 7: two harmonics that influence each other through the jitter."""

from typing import Any

from matplotlib.figure import Figure
import numpy as np
from sa_jitter_ros.prediction.angle_error import IndependentPulseJitter
from sa_jitter_ros.prediction.distributions import Uniform
from sa_jitter_ros.prediction.moments import cycle_moments
from validation.analytic import multi_harmonic_moments
from validation.order_tracking import HarmonicCase
from validation.plots import panel_titles, panels
from validation.results import (
    agreement, Effort, Finding, one_distribution, Progress, Results, stage)
from validation.single_harmonic import draw, report, sample, Samples

TRIGGER_CYCLES, WIDTH, AMPLITUDE_RATIO = 100, 0.2, 20.0
RATIOS = (2.286, 1.0)
FREQUENCY_RATIOS = (2, 3, 4)


def run(effort: Effort, progress: Progress) -> Results:
    """Reproduce Fig. 7."""
    count = len(RATIOS) * len(FREQUENCY_RATIOS)
    cases: dict[tuple[float, int], Samples] = {}
    for ratio in RATIOS:
        for second in FREQUENCY_RATIOS:
            case = HarmonicCase(TRIGGER_CYCLES, ratio, WIDTH,
                                ((1.0, 1.0), (float(second), AMPLITUDE_RATIO)))
            cases[ratio, second] = sample(case, effort, 100 + len(cases),
                                          stage(progress, len(cases), count))
    single = cycle_moments([1.0], [IndependentPulseJitter(Uniform(WIDTH))])
    alone = single.averaged(TRIGGER_CYCLES)
    numbers = {
        'single_harmonic': {'mean': float(np.abs(alone.mean[0])),
                            'radial_std': float(np.sqrt(alone.real_variance[0]))},
        'cases': {f'r={ratio:g}, r_hf={second}': {
            **report(item), 'frequency_ratio': second,
            'predicted_mean': _predicted_mean(ratio, second)}
            for (ratio, second), item in cases.items()}}
    return Results(
        'Two harmonics: Fig. 7', numbers, _findings(cases, numbers), _figures(cases),
        ('The text gives r_ha = 20, the amplitude of the second harmonic over that of the first. '
         'It is taken literally: only so large a value separates the curves as described.',
         'Both harmonics start in phase.'))


def _predicted_mean(ratio: float, second: int) -> float:
    """Return the exact |E X|, leakage included, over whole trigger cycles."""
    moments = multi_harmonic_moments(
        [1.0], [1.0, float(second)], [1.0, AMPLITUDE_RATIO],
        [IndependentPulseJitter(Uniform(WIDTH))], TRIGGER_CYCLES, ratio)
    return float(np.abs(moments.mean[0]))


def _findings(
    cases: dict[tuple[float, int], Samples], numbers: dict[str, Any],
) -> tuple[Finding, ...]:
    tests = [item.simulation_test for item in cases.values()]
    gap = max(item.gap for item in cases.values())
    alone = numbers['single_harmonic']

    def means(ratio: float) -> list[float]:
        return [float(np.mean(cases[ratio, second].exact)) for second in FREQUENCY_RATIOS]

    def spreads(ratio: float) -> list[float]:
        return [float(np.std(cases[ratio, second].exact)) for second in FREQUENCY_RATIOS]

    def listed(values: list[float]) -> str:
        return ', '.join(f'{value:.4f}' for value in values)

    split, whole = RATIOS
    rough = [cases[split, second].approximation_test.distance for second in FREQUENCY_RATIOS]
    smooth = max(float(np.abs(cases[whole, second].exact
                              - cases[whole, second].approximate).max())
                 for second in FREQUENCY_RATIOS)
    bias = [mean - alone['mean'] for mean in means(whole)]
    predicted = [numbers['cases'][f'r={whole:g}, r_hf={second}']['predicted_mean']
                 for second in FREQUENCY_RATIOS]
    return (
        Finding('Fig. 7', 'simulations and the exact model agree',
                f'KS of {len(tests)} cases: smallest p {min(item.p_value for item in tests):.3f}; '
                f'same errors: within {gap:.1e}',
                agreement(one_distribution(tests), gap < 1e-3)),
        Finding('Fig. 7a', 'r = 2.286: the approximate model is not suitable',
                f'KS distance of the models for r_hf = 2, 3, 4: {listed(rough)}',
                agreement(*(value > 0.1 for value in rough))),
        Finding('Fig. 7a', 'r = 2.286: mean as of a single harmonic, more dispersion, '
                'most of the closest order',
                f'mean {listed(means(split))} (single {alone["mean"]:.4f}); standard deviation '
                f'{listed(spreads(split))} (single {alone["radial_std"]:.4f})',
                agreement(max(abs(mean - alone['mean']) for mean in means(split)) < 0.01,
                          min(spreads(split)) > alone['radial_std'],
                          spreads(split) == sorted(spreads(split), reverse=True))),
        Finding('Fig. 7b', 'r = 1: the approximate model equals the exact one',
                f'same errors: within {smooth:.1e}', agreement(smooth < 1e-10)),
        Finding('Fig. 7b', 'r = 1: the average attenuation differs strongly, orders interact',
                f'mean {listed(means(whole))} (single {alone["mean"]:.4f}); leakage predicts '
                f'{listed(predicted)}',
                agreement(*(abs(value) > 0.05 for value in bias)),
                'If r is an integer, [leakage](theory.md#leakage) is a bias.'),
    )


def _figures(cases: dict[tuple[float, int], Samples]) -> dict[str, Figure]:
    figure, axes = panels(2)
    for one, ratio in zip(axes, RATIOS):
        draw(one, [(f'r_hf = {second}', cases[ratio, second]) for second in FREQUENCY_RATIOS])
    panel_titles(axes, [f'r = {ratio:g}' for ratio in RATIOS])
    return {'fig07': figure}
