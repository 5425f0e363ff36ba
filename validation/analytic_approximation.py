# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Figures 3 and 8: the paper's closed forms beside exact moments and Monte Carlo."""

from typing import Any

from matplotlib.figure import Figure
import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.prediction.amplitude_distribution import curved_along
from sa_jitter_ros.prediction.angle_error import IndependentPulseJitter
from sa_jitter_ros.prediction.cumulants import third_cumulants
from sa_jitter_ros.prediction.distributions import Uniform
from sa_jitter_ros.prediction.moments import cycle_moments, CycleMoments
from sa_jitter_ros.prediction.parts import Parts
from scipy.stats import skew
from validation.analytic import approximate_cycle_moments, laguerre_distribution, uniform_mean
from validation.monte_carlo import AveragedSignal, monte_carlo
from validation.plots import COLOURS, distribution, panel_titles, panels
from validation.results import agreement, Effort, Finding, Progress, Results

Array = NDArray[Any]

WIDTHS = (0.1, 0.2, 0.3, 0.4)
CYCLES = (20, 100)
_UP_TO = 0.4  # width up to which the approximation is judged, the widest of Fig. 8
_TERMS = ('mean of g1', 'Var g1', 'Var g2', 'lag-1 Cov g1', 'lag-1 Cov g2')


def run(effort: Effort, progress: Progress) -> Results:
    """Reproduce Figs. 3 and 8."""
    spread = np.linspace(0.02, 0.5, 97)
    exact = _terms(cycle_moments(spread, [IndependentPulseJitter(Uniform(1.0))]))
    approximate = _terms(approximate_cycle_moments(spread))
    within = spread <= _UP_TO + 1e-9
    error = np.abs(approximate / exact - 1.0)[:, within]
    third = {name: {'largest_relative_error': float(np.max(row[spread[within] >= 0.1])),
                    'relative_error_at_0.4': float(row[-1])}
             for name, row in zip(_TERMS, error)}
    third['Eq. 38'] = {'largest_relative_error': float(np.max(np.abs(
        uniform_mean(spread) / exact[0] - 1.0)))}
    samples: dict[tuple[int, float], Array] = {}
    for cycles in CYCLES:
        for width in WIDTHS:
            signal = AveragedSignal(cycles, 1.0)
            samples[cycles, width] = np.abs(monte_carlo(
                signal.whole_fundamental_cycles, Uniform(width), cycles, effort.iterations,
                seed=800 + len(samples)))
            progress(len(samples) / (len(CYCLES) * len(WIDTHS)))
    eighth = {f'N_t={cycles}, D={width}': _eighth(cycles, width, sample)
              for (cycles, width), sample in samples.items()}
    numbers = {'figure_3': third, 'figure_8': eighth}
    return Results(
        'Analytic approximation: Figs. 3 and 8', numbers,
        _findings(spread, exact, third, eighth, effort),
        {'fig03': _third_figure(spread, exact, approximate), 'fig08': _eighth_figure(samples)},
        ('Fig. 8 takes the covariance of the average (Eq. 32 divided by N_t) and the Laguerre '
         'expansion with the corrections of `validation.analytic`, degree 6.',))


def _terms(cycles: CycleMoments) -> Array:
    """Return mean, variances and lag-1 covariances of the two parts, shape (5, widths)."""
    one, following = cycles.lag(0), cycles.lag(1)
    return np.array([np.real(cycles.mean), one.real_variance, one.imag_variance,
                     following.real_variance, following.imag_variance])


def _distance(sample: Array, cdf: Any) -> float:
    """Return the largest distance of a sample's distribution function from a given one."""
    ordered = np.sort(sample)
    steps = np.arange(ordered.size + 1) / ordered.size
    values = cdf(ordered)[0]
    return float(max(np.max(steps[1:] - values), np.max(values - steps[:-1])))


def _eighth(cycles: int, width: float, sample: Array) -> dict[str, float]:
    expansion = laguerre_distribution(approximate_cycle_moments(width).averaged(cycles))
    processes = [IndependentPulseJitter(Uniform(width))]
    moments = cycle_moments([1.0], processes)
    average = moments.averaged(cycles)
    curved = curved_along(Parts.about(
        average.mean, average, *third_cumulants([1.0], processes, cycles, moments)))
    return {'distance_of_the_approximation': _distance(sample, expansion.amplitude_cdf),
            'distance_with_exact_moments': _distance(
                sample, laguerre_distribution(average).amplitude_cdf),
            'distance_of_the_curved_distribution': _distance(sample, curved.cdf),
            'mean_square': float(np.mean(sample**2)),
            'mean_square_standard_error': float(np.std(sample**2) / np.sqrt(sample.size)),
            'approximate_mean_square': float((expansion.shape * expansion.scale)[0]),
            'skewness': float(skew(sample**2))}


def _findings(
    spread: Array, exact: Array, third: dict[str, Any], eighth: dict[str, Any], effort: Effort,
) -> tuple[Finding, ...]:
    at = int(np.argmin(np.abs(spread - _UP_TO)))
    mean_error = third['mean of g1']['largest_relative_error']
    terms = '; '.join(f'{name} {100.0 * third[name]["largest_relative_error"]:.2g} %'
                      for name in _TERMS)
    distances = [item['distance_of_the_approximation'] for item in eighth.values()]
    normal = [item['distance_with_exact_moments'] for item in eighth.values()]
    curved = [item['distance_of_the_curved_distribution'] for item in eighth.values()]
    skewness = [item['skewness'] for item in eighth.values()]
    most_skewed = max(eighth, key=lambda name: abs(eighth[name]['skewness']))
    resolution = 1.63 / np.sqrt(effort.iterations)
    widest = [eighth[f'N_t={cycles}, D=0.4'] for cycles in CYCLES]
    shortfall = [(item['mean_square'] - item['approximate_mean_square']) for item in widest]
    z = [gap / item['mean_square_standard_error'] for gap, item in zip(shortfall, widest)]
    twenty, hundred = distances[:len(WIDTHS)], distances[len(WIDTHS):]
    return (
        Finding('Fig. 3a', 'the mean of g1: the error of Eq. 40 grows with D but keeps very small',
                f'up to D = 0.4 {100.0 * mean_error:.2f} %; Eq. 38 agrees with quadrature to '
                f'{third["Eq. 38"]["largest_relative_error"]:.0e}',
                agreement(mean_error < 0.01,
                          third['Eq. 38']['largest_relative_error'] < 1e-9)),
        Finding('Fig. 3b', 'accurate approximations of the covariances (Eqs. 41 to 45)',
                f'relative errors up to D = 0.4: {terms}',
                agreement(*(third[name]['largest_relative_error'] < 0.05 for name in _TERMS))),
        Finding('Fig. 3', 'g2 dominates the variance, g1 the mean',
                f'D = 0.4: Var g1 = {exact[1, at]:.4f}, Var g2 = {exact[2, at]:.4f}, E g1 = '
                f'{exact[0, at]:.4f}, E g2 = 0',
                agreement(exact[2, at] > 5.0 * exact[1, at])),
        Finding('Fig. 8', 'approximate and simulated distributions agree well',
                f'KS distance up to {max(twenty):.3f} for N_t = 20, {max(hundred):.3f} for '
                f'N_t = 100; {effort.iterations} draws resolve {resolution:.4f}',
                agreement(max(distances) < 0.1, max(distances) < resolution),
                f'A normal X does not lie along an arc: with exact moments {max(normal):.3f} '
                f'remains. The curved distribution of the package is within {max(curved):.4f}.'),
        Finding('Fig. 8', 'the expected value is slightly underestimated at high D',
                'D = 0.4: E|X|^2 simulated minus approximate = '
                + ' and '.join(f'{gap:.5f}' for gap in shortfall)
                + f' for N_t = 20 and 100 ({z[0]:.0f} and {z[1]:.0f} standard errors)',
                agreement(*(value > 3.0 for value in z))),
        Finding('Fig. 8', 'no significant tails, no significant skewness',
                f'skewness of |X|^2: {min(skewness):.2f} to {max(skewness):.2f}, most for '
                f'{most_skewed}',
                agreement(max(np.abs(skewness)) < 0.1, max(np.abs(skewness)) < 0.5),
                'Losses are one-sided; skewness falls with the root of N_t.'),
    )


def _third_figure(spread: Array, exact: Array, approximate: Array) -> Figure:
    figure, axes = panels(2)
    axes[0].plot(spread, exact[0], color='black', label='exact (Eq. 38)')
    axes[0].plot(spread, approximate[0], color='tab:red', linestyle='dashed', label='Eq. 40')
    axes[0].set_ylabel('E g1')
    for colour, name, one, other in zip(COLOURS, _TERMS[1:], exact[1:], approximate[1:]):
        axes[1].plot(spread, one, color=colour, label=name)
        axes[1].plot(spread, other, color=colour, linestyle='dashed')
    axes[1].plot([], [], color='black', linestyle='dashed', label='Eqs. 41 to 45')
    axes[1].set_ylabel('covariance')
    for one in axes:
        one.set_xlabel('width D of the pulse error / cycles of the order')
        one.legend(fontsize=8)
    panel_titles(axes, ['expected value', 'covariances'])
    return figure


def _eighth_figure(samples: dict[tuple[int, float], Array]) -> Figure:
    figure, axes = panels(2)
    for one, cycles in zip(axes, CYCLES):
        for colour, width in zip(COLOURS, WIDTHS):
            expansion = laguerre_distribution(approximate_cycle_moments(width).averaged(cycles))
            squared = samples[cycles, width] ** 2
            places = np.linspace(squared.min(), squared.max(), 300)
            one.plot(places, expansion.cdf(places)[0], color=colour, label=f'D = {width}')
            distribution(one, squared, color=colour, linestyle='dashed')
        one.plot([], [], color='black', label='analytic approximation')
        one.plot([], [], color='black', linestyle='dashed', label='exact numerical model')
        one.set_xlabel('squared amplitude (1 without jitter)')
        one.set_ylabel('distribution function')
    axes[0].legend(fontsize=8, loc='upper left')
    panel_titles(axes, [f'N_t = {cycles}' for cycles in CYCLES])
    return figure
