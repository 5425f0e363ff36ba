# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Figures 9 to 11: mean and variance of the squared amplitude over N_t, width and noise."""

from typing import Any

from matplotlib.figure import Figure
import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.prediction.angle_error import IndependentPulseJitter
from sa_jitter_ros.prediction.distributions import Uniform
from sa_jitter_ros.prediction.moments import cycle_moments
from validation.analytic import approximate_cycle_moments, squared_amplitude_cumulants
from validation.monte_carlo import AveragedSignal, monte_carlo
from validation.plots import panel_titles, panels
from validation.results import agreement, Effort, Finding, Progress, Results

Array = NDArray[Any]

CYCLES = np.unique(np.geomspace(10, 300, 24).astype(int))
WIDTHS = np.linspace(0.05, 0.5, 24)
NOISE = np.linspace(0.0, 0.5, 24)
WIDTH = 0.2  # of Fig. 10
FEW, MANY = 20, 100  # revolutions of Fig. 11

_LABELS = ('$E|X|^2$', r'$\log_{10} Var|X|^2$')

#: N_t, width and noise variance of the points that Monte Carlo checks.
CHECKS = ((20, 0.2, 0.0), (20, 0.4, 0.0), (100, 0.4, 0.0), (20, 0.2, 0.5), (100, 0.2, 0.5))


def cumulants(cycles: int, widths: Array, noise: float, *, exact: bool = False) -> Array:
    """
    Return mean and variance of the squared amplitude, shape (2, widths).

    Eqs. 40-50 with their errata; `noise` is the variance of one trigger cycle's line.
    """
    moments = (cycle_moments(widths, [IndependentPulseJitter(Uniform(1.0))]) if exact
               else approximate_cycle_moments(widths))
    return squared_amplitude_cumulants(moments.averaged(cycles).with_noise(noise / cycles), 2)


def printed_variance(cycles: int, width: float, noise: float) -> float:
    """Return Eq. 50 as it is printed: power of the trace, noise 1/N^2."""
    average = approximate_cycle_moments(width).averaged(cycles)
    real, total = float(average.real_variance[0]), float(average.variance[0])
    power, line = float(np.abs(average.mean[0]) ** 2), noise / cycles**2
    return 2.0 * ((total + line) ** 2 + 2.0 * power * (real + 0.5 * line))


def run(effort: Effort, progress: Progress) -> Results:
    """Reproduce Figs. 9 to 11."""
    ninth = np.stack([cumulants(int(n), WIDTHS, 0.0) for n in CYCLES], axis=1)
    exact = np.stack([cumulants(int(n), WIDTHS, 0.0, exact=True) for n in CYCLES], axis=1)
    single = np.array([WIDTH])
    tenth = np.array([[cumulants(int(n), single, s)[:, 0] for s in NOISE] for n in CYCLES])
    tenth = np.moveaxis(tenth, -1, 0)
    eleventh = {n: np.stack([cumulants(n, WIDTHS, s) for s in NOISE], axis=1)
                for n in (FEW, MANY)}
    checks = []
    for k, check in enumerate(CHECKS):
        checks.append(_check(*check, effort, seed=900 + k))
        progress((k + 1.0) / len(CHECKS))
    inside = WIDTHS <= 0.401
    difference = np.max(np.abs(ninth / exact - 1.0)[:, :, inside], axis=(1, 2))
    numbers = {'monte_carlo': checks,
               'largest_relative_error_of_the_approximation': {
                   'mean': float(difference[0]), 'variance': float(difference[1])},
               **_effects()}
    figures = {
        'fig09': _figure([ninth[0], ninth[1]], [WIDTHS, WIDTHS], [CYCLES, CYCLES],
                         'width D / cycles of the order', 'averages N_t', ['', '']),
        'fig10': _figure([tenth[0], tenth[1]], [NOISE, NOISE], [CYCLES, CYCLES],
                         'noise variance', 'averages N_t', [f', D = {WIDTH}'] * 2),
        'fig11': _figure([eleventh[n][k] for n in (FEW, MANY) for k in (0, 1)], [WIDTHS] * 4,
                         [NOISE] * 4, 'width D / cycles of the order', 'noise variance',
                         [f', N_t = {n}' for n in (FEW, FEW, MANY, MANY)])}
    return Results(
        'Parametric study: Figs. 9 to 11', numbers, _findings(numbers), figures,
        ('The axes of Figs. 9 to 11 are not in the text: N_t from 10 to 300, D from 0.05 to 0.5, '
         'noise variance up to 0.5.',
         'The noise variance is that of the line of ONE trigger cycle of a unit complex harmonic, '
         'so an average of N_t has 1/N_t of it, as the text above Eq. 47 says (Eqs. 49 and 50 '
         'print 1/N^2).'))


def _check(cycles: int, width: float, noise: float, effort: Effort, seed: int) -> dict[str, float]:
    """Compare the exact cumulants with a Monte Carlo run."""
    draws = np.abs(monte_carlo(
        AveragedSignal(cycles, 1.0).whole_trigger_cycles, Uniform(width), cycles,
        effort.iterations, seed=seed, line_variance=noise / cycles)) ** 2
    approximate = cumulants(cycles, np.array([width]), noise)[:, 0]
    exact = cumulants(cycles, np.array([width]), noise, exact=True)[:, 0]
    squares = (draws - draws.mean()) ** 2
    root = np.sqrt(draws.size)
    return {'trigger_cycles': cycles, 'width': width, 'noise_variance': noise,
            'mean': float(draws.mean()), 'mean_standard_error': float(draws.std() / root),
            'variance': float(squares.mean()),
            'variance_standard_error': float(squares.std() / root),
            'exact_mean': float(exact[0]), 'normal_variance': float(exact[1]),
            'approximate_mean': float(approximate[0]),
            'approximate_variance': float(approximate[1]),
            'printed_variance': printed_variance(cycles, width, noise)}


def _effects() -> dict[str, dict[str, float]]:
    """Return how much each parameter changes the cumulants."""
    def at(cycles: int, width: float, noise: float) -> Array:
        return cumulants(cycles, np.array([width]), noise)[:, 0]

    def effect(before: Array, after: Array) -> dict[str, float]:
        return {'mean_ratio': float(after[0] / before[0]),
                'variance_ratio': float(after[1] / before[1])}

    return {'N_t 20 to 200': effect(at(20, WIDTH, 0.0), at(200, WIDTH, 0.0)),
            'D 0.1 to 0.4': effect(at(100, 0.1, 0.0), at(100, 0.4, 0.0)),
            'noise 0 to 0.5 at N_t 20': effect(at(FEW, WIDTH, 0.0), at(FEW, WIDTH, 0.5)),
            'noise 0 to 0.5 at N_t 100': effect(at(MANY, WIDTH, 0.0), at(MANY, WIDTH, 0.5))}


def _findings(numbers: dict[str, Any]) -> tuple[Finding, ...]:
    def ratios(name: str) -> tuple[float, float]:
        return numbers[name]['mean_ratio'], numbers[name]['variance_ratio']

    def text(name: str) -> str:
        mean, variance = ratios(name)
        return f'mean x {mean:.4f}, variance x {variance:.3g}'

    few, many = 'noise 0 to 0.5 at N_t 20', 'noise 0 to 0.5 at N_t 100'
    checks = numbers['monte_carlo']
    z = [(item['mean'] - item['exact_mean']) / item['mean_standard_error'] for item in checks]
    off = [item['normal_variance'] / item['variance'] - 1.0 for item in checks]
    printed = [item['printed_variance'] / item['variance'] for item in checks]
    added = [item['exact_mean'] for item in checks]
    error = numbers['largest_relative_error_of_the_approximation']
    return (
        Finding('Figs. 9-11', 'cumulants of the squared amplitude (Eqs. 47 to 50)',
                f'{len(checks)} points: exact mean within {max(abs(value) for value in z):.1f} '
                f'standard errors, variance of a normal X off by {100.0 * min(off):.1f} to '
                f'{100.0 * max(off):.1f} %; Eqs. 40-45 add up to {100.0 * error["mean"]:.2f} % '
                f'(mean) and {100.0 * error["variance"]:.1f} % (variance)',
                agreement(max(abs(value) for value in z) < 4.0,
                          max(abs(value) for value in off) < 0.1),
                'With the errata. A normal X does not lie along an arc: at few averages without '
                'noise.'),
        Finding('Eqs. 48, 50', 'the variance as printed',
                'printed over simulated at these points: '
                + ', '.join(f'{value:.2f}' for value in printed),
                agreement(*(abs(value - 1.0) < 0.1 for value in printed)),
                'Errata: noise over N^2 for N, power of the trace for trace of the power.'),
        Finding('Fig. 9', 'N_t hardly changes the expected value, but reduces the variance',
                f'D = 0.2, N_t 20 to 200: {text("N_t 20 to 200")}',
                agreement(abs(ratios('N_t 20 to 200')[0] - 1.0) < 0.01,
                          ratios('N_t 20 to 200')[1] < 0.2)),
        Finding('Fig. 9', 'D lowers the expected value and raises the variance',
                f'N_t = 100, D 0.1 to 0.4: {text("D 0.1 to 0.4")}',
                agreement(ratios('D 0.1 to 0.4')[0] < 0.8, ratios('D 0.1 to 0.4')[1] > 2.0)),
        Finding('Fig. 10',
                'noise changes the variance more than the mean, less with more averages',
                f'D = 0.2, noise variance 0 to 0.5: {text(few)} at N_t = 20; {text(many)} at '
                'N_t = 100',
                agreement(ratios(few)[1] > ratios(few)[0], ratios(many)[1] > ratios(many)[0],
                          _added(numbers, MANY) < _added(numbers, FEW))),
        Finding('Fig. 11', 'noise hardly changes the expected value, and the variance '
                'most with few averages',
                f'D = 0.2: adds {added[3] - added[0]:.4f} to the expected value at N_t = 20, '
                f'{_added(numbers, FEW):.2e} to the variance, {_added(numbers, MANY):.2e} at '
                'N_t = 100',
                agreement(added[3] - added[0] < 0.05,
                          _added(numbers, FEW) > 3.0 * _added(numbers, MANY))),
    )


def _added(numbers: dict[str, Any], cycles: int) -> float:
    """Return the variance that noise of 0.5 adds at so many averages."""
    before = cumulants(cycles, np.array([WIDTH]), 0.0)[1, 0]
    return float(before * (numbers[f'noise 0 to 0.5 at N_t {cycles}']['variance_ratio'] - 1.0))


def _figure(values: list[Array], across: list[Array], up: list[Array], xlabel: str, ylabel: str,
            notes: list[str]) -> Figure:
    """Draw mean and variance side by side as labelled iso-lines."""
    figure, axes = panels(2, len(values) // 2)
    for k, one in enumerate(axes):
        shown = values[k] if k % 2 == 0 else np.log10(values[k])
        filled = one.contourf(across[k], up[k], shown, levels=14, cmap='viridis')
        figure.colorbar(filled, ax=one, label=_LABELS[k % 2])
        one.set_xlabel(xlabel)
        one.set_ylabel(ylabel)
        if ylabel.startswith('averages'):
            one.set_yscale('log')
            one.yaxis.set_major_formatter('{x:g}')
    panel_titles(axes, [('expected value', 'variance')[k % 2] + note
                        for k, note in enumerate(notes)])
    return figure
