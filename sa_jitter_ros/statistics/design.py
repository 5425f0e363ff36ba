"""
Design of a monitoring system: what keyphasor rate and how many cycles an amplitude needs.

The keyphasor rate decides the attenuation, 1 - |E X|, which no number of cycles cures; rate, noise
and number of cycles decide the coefficient of variation, std|X| / E|X|. The functions answer both
ways: limits to settings (`required_*`, `trade_off`) and settings to limits (`assess`,
`highest_order`, `design_grid`). Amplitudes are those of unit components.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sa_jitter_ros.errors import ModelError, ParameterError
from sa_jitter_ros.statistics.angle_error import IndependentPulseJitter
from sa_jitter_ros.statistics.moments import cycle_moments, require_cycles
from sa_jitter_ros.statistics.prediction import DeclaredModel, predict
from scipy.optimize import brentq

Array = NDArray[Any]

_MOST_CYCLES = 1_000_000
_FEW = 8
_MAIN_LOBE, _WIDEST = 1.32, 100.0  # widths in cycles of the order
_RATE_SPAN = 1e9  # highest rate tried, over the lowest at which pulses keep their order


@dataclass(frozen=True)
class Assessment:
    """Attenuation 1 - |E X| and coefficient of variation std|X| / E|X| of each order."""

    order: Array
    attenuation: Array
    coefficient_of_variation: Array


@dataclass(frozen=True)
class DesignGrid:
    """
    The worst order's attenuation and coefficient of variation over rates and cycles.

    Both have shape (keyphasor rates, trigger cycles): iso-lines over them are the paper's Fig. 9.
    Rates at which pulses could swap hold NaN.
    """

    keyphasor_rate: Array
    trigger_cycles: Array
    attenuation: Array
    coefficient_of_variation: Array


def assess(model: DeclaredModel) -> Assessment:
    """Return what the settings of a model mean for each of its orders."""
    prediction = predict(model)
    return Assessment(prediction.order, 1.0 - np.abs(prediction.moments.mean),
                      prediction.standard_deviation / prediction.mean_attenuation)


def highest_order(model: DeclaredModel, attenuation: float, variation: float) -> float:
    """Return the highest of the model's orders that keeps both limits; NaN when none does."""
    _require_limit('attenuation', attenuation)
    _require_limit('variation', variation)
    result = assess(model)
    good = (result.attenuation <= attenuation) & (result.coefficient_of_variation <= variation)
    return float(np.max(result.order[good], initial=-math.inf)) if np.any(good) else math.nan


def required_keyphasor_rate(model: DeclaredModel, attenuation: float) -> float:
    """
    Return the lowest keyphasor rate in Hz that keeps the attenuation of every order below a limit.

    Every higher rate keeps it too. The model's own rate does not matter, its noise neither. Raises
    ModelError where the jitter does not come from the rate (`jitter_std` or a table).
    """
    _require_limit('attenuation', attenuation)
    if not _rate_matters(model):
        raise ModelError(
            f'jitter_std is {model.jitter_std} s and jitter_distribution '
            f'{model.jitter_distribution!r}, so that no keyphasor rate changes the jitter: leave '
            'jitter_std 0 and choose uniform, normal or triangular')
    unit = replace(model, orders=(max(model.orders),), sample_rate=0.0, noise_std=0.0)
    width = unit.distribution.width * model.keyphasor_rate  # s at a rate of 1 Hz
    lowest = 1.0001 * width / model.trigger_period

    def excess(log_rate: float) -> float:
        at_rate = replace(unit, keyphasor_rate=math.exp(log_rate))
        jitter = IndependentPulseJitter(
            at_rate.distribution, at_rate.fundamental_frequency, at_rate.weights)
        gain = abs(cycle_moments(at_rate.orders, [jitter]).mean[0])
        return float(1.0 - gain - attenuation)

    # Not on a side lobe of the uniform law: its mean is 0 at a width of 1.32 cycles of the order.
    widest = _MAIN_LOBE if model.jitter_distribution == 'uniform' else _WIDEST
    start = max(lowest, width * unit.fundamental_frequency * unit.orders[0] / widest)
    if excess(math.log(start)) <= 0.0:
        return start
    return math.exp(brentq(excess, math.log(start), math.log(start * _RATE_SPAN), xtol=1e-10))


def required_trigger_cycles(model: DeclaredModel, variation: float) -> int:
    """
    Return the fewest trigger cycles that keep the coefficient of variation of every order below.

    Every larger number keeps it too: averages of one or two cycles can scatter less than averages
    of four, because an error common to all their pulses costs no amplitude. The model's own
    `trigger_cycles` do not matter. Raises ModelError when a million do not do.
    """
    _require_limit('variation', variation)
    worst = replace(model, orders=(max(model.orders),))

    def good(cycles: int) -> bool:
        result = assess(replace(worst, trigger_cycles=cycles))
        return bool(result.coefficient_of_variation[0] <= variation)

    return _first(good, variation)


def trade_off(
    model: DeclaredModel, keyphasor_rates: ArrayLike, variation: float,
) -> Array:
    """
    Return the fewest trigger cycles for each keyphasor rate: one iso-line of the design.

    NaN where pulses could swap at that rate.
    """
    return np.array([
        math.nan if at_rate is None else required_trigger_cycles(at_rate, variation)
        for at_rate in _at_rates(model, keyphasor_rates)])


def design_grid(
    model: DeclaredModel, keyphasor_rates: ArrayLike, trigger_cycles: ArrayLike,
) -> DesignGrid:
    """Return the highest (worst) order's figures over rates (Hz) and numbers of trigger cycles."""
    worst = replace(model, orders=(max(model.orders),))
    cycles = np.atleast_1d(np.asarray(trigger_cycles))
    for count in cycles.tolist():
        require_cycles(count)
    rates = np.atleast_1d(np.asarray(keyphasor_rates, float))
    figures = np.full((2, rates.size, cycles.size), np.nan)
    for i, at_rate in enumerate(_at_rates(worst, rates)):
        if at_rate is None:
            continue
        for k, count in enumerate(cycles):
            result = assess(replace(at_rate, trigger_cycles=int(count)))
            figures[:, i, k] = result.attenuation[0], result.coefficient_of_variation[0]
    return DesignGrid(rates, cycles, figures[0], figures[1])


def _rate_matters(model: DeclaredModel) -> bool:
    """Return whether the declared jitter comes from the keyphasor rate."""
    return model.jitter_distribution == 'uniform' or (
        model.jitter_distribution != 'table' and model.jitter_std == 0.0)


def _at_rates(model: DeclaredModel, rates: ArrayLike) -> Sequence[DeclaredModel | None]:
    """Return the model at each rate, None where its pulses could swap."""
    models: list[DeclaredModel | None] = []
    for rate in np.atleast_1d(np.asarray(rates, float)):
        if not (math.isfinite(rate) and rate > 0.0):
            raise ModelError(f'keyphasor_rates hold {rate}: rates are finite and above 0 Hz')
        width = model.distribution.width * model.keyphasor_rate / rate
        swaps = _rate_matters(model) and width >= model.trigger_period
        models.append(None if swaps else replace(model, keyphasor_rate=float(rate)))
    return models


def _first(good: Callable[[int], bool], limit: float) -> int:
    """Return the smallest count from which on a property holds; monotone from `_FEW` on."""
    high = _FEW
    while not good(high):
        if high >= _MOST_CYCLES:
            raise ModelError(f'a coefficient of variation of {limit} needs more than '
                             f'{_MOST_CYCLES} trigger cycles: allow more, or lower the noise')
        high = min(4 * high, _MOST_CYCLES)
    if high == _FEW:
        return 1 + max((count for count in range(1, _FEW) if not good(count)), default=0)
    low = high // 4
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if good(middle) else (middle, high)
    return high


def _require_limit(name: str, value: float) -> None:
    if not 0.0 < value < 1.0:
        raise ParameterError(f'{name} is {value}: give a limit between 0 and 1, both excluded')
