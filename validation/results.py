# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""What a group of the paper's results comes to: numbers, findings, figures, and the effort."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from matplotlib.figure import Figure
import numpy as np
from numpy.typing import NDArray
from scipy.stats import ks_2samp

Array = NDArray[Any]
#: Called with the fraction done of a group.
Progress = Callable[[float], None]

SIGNIFICANCE = 0.01  # of a family of tests


@dataclass(frozen=True)
class Effort:
    """
    How much is computed.

    `iterations` of a numerical model, full `simulations` of each case, `acquisitions` of the bench
    and in each of them `realisations` of the pulse errors, `flights` of the whole fleet.
    """

    iterations: int
    simulations: int
    acquisitions: int
    realisations: int
    flights: int


FULL = Effort(iterations=100_000, simulations=300, acquisitions=36, realisations=50,
              flights=4546)
QUICK = Effort(iterations=3_000, simulations=2, acquisitions=3, realisations=2, flights=28)


@dataclass(frozen=True)
class Finding:
    """One statement of the paper, `item` says where, beside what the reproduction gives."""

    item: str
    paper: str
    ours: str
    agreement: str
    why: str = ''


@dataclass(frozen=True)
class Results:
    """
    A group of results.

    `numbers` hold what JSON can; `figures` are by file stem; `choices` name settings that differ
    from the paper or that it does not give.
    """

    title: str
    numbers: Mapping[str, Any]
    findings: tuple[Finding, ...]
    figures: Mapping[str, Figure]
    choices: tuple[str, ...] = ()


@dataclass(frozen=True)
class Comparison:
    """Two-sample Kolmogorov-Smirnov test: distance of the distributions, sample sizes, p value."""

    distance: float
    sizes: tuple[int, int]
    p_value: float


def compare(sample: Array, reference: Array) -> Comparison:
    """Test whether two samples have one distribution, by their own sizes; exact for small ones."""
    test = ks_2samp(sample, reference)
    return Comparison(float(test.statistic), (len(sample), len(reference)), float(test.pvalue))


def one_distribution(comparisons: list[Comparison]) -> bool:
    """Return whether no comparison of a family is significant (Bonferroni, 1 %)."""
    return min(item.p_value for item in comparisons) * len(comparisons) > SIGNIFICANCE


def agreement(*conditions: bool) -> str:
    """Return yes where all conditions hold, partly where some do, else no."""
    if all(conditions):
        return 'yes'
    return 'partly' if any(conditions) else 'no'


def chance(p_value: float) -> str:
    """Return a p value as text; the far tail of a distribution is beyond what a test can tell."""
    return 'p < 1e-12' if p_value < 1e-12 else f'p = {p_value:.2g}'


def summary(amplitudes: Array) -> dict[str, float]:
    """Return mean, standard deviation and three quantiles of a sample."""
    low, middle, high = np.quantile(amplitudes, [0.05, 0.5, 0.95])
    return {'mean': float(np.mean(amplitudes)), 'std': float(np.std(amplitudes)),
            'quantile_05': float(low), 'quantile_50': float(middle), 'quantile_95': float(high)}


def stage(progress: Progress, number: int, count: int) -> Progress:
    """Return the progress of one of several stages of equal length."""
    return lambda done: progress((number + done) / count)
