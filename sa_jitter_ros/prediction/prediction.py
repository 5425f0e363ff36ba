"""
The prediction: what a declared keyphasor does to the amplitudes of a synchronous average.

`predict` turns a `DeclaredModel` into mean, variance and quantiles of the amplitude of a unit
component for every order. Effects that the declared model lacks enter through the keyword
arguments of `predict` and know nothing of this module.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sa_jitter_ros.errors import ModelError
from sa_jitter_ros.prediction.amplitude_distribution import (
    AmplitudeDistribution, curved_distribution, normal_distribution)
from sa_jitter_ros.prediction.angle_error import AngleErrorProcess, IndependentPulseJitter
from sa_jitter_ros.prediction.cumulants import average_cumulants
from sa_jitter_ros.prediction.distributions import (
    Empirical,
    is_number,
    Normal,
    PulseErrorDistribution,
    Triangular,
    Uniform,
)
from sa_jitter_ros.prediction.moments import (
    AngleOffset,
    AverageMoments,
    cycle_moments,
    CycleMoments,
    noise_line_variance,
    offset_moments,
    require_cycles,
    require_orders,
)
from sa_jitter_ros.prediction.sampled_distribution import (
    can_be_sampled, sampled_distribution, SampledDistribution)
from sa_jitter_ros.pulses.angle_law import angle_law, ANGLE_LAWS, PulseWeights

Array = NDArray[Any]

QUANTILES = (0.05, 0.50, 0.95)
DISTRIBUTIONS = ('uniform', 'normal', 'triangular', 'table')

# Up to here the distribution is sampled; with one more cycle the curved one is up to 0.015 off in
# its CDF, and 0.04 off for jitter as skewed as an exponential distribution.
_FEW_CYCLES, _FEW_LOPSIDED_CYCLES, _LOPSIDED = 9, 20, 1.2
# Independent cycles of effects: 10 of independent pulse errors count as 6.4 along, 5.3 across.
_FEW_ALONG, _FEW_ACROSS, _NOTHING = 12.0, 5.0, 1e-12


@dataclass(frozen=True)
class DeclaredModel:
    """
    What is declared about keyphasor, machine and average; the parameters of `jitter_predictor`.

    Rates and speeds are in Hz, times in s, orders in multiples of the shaft of interest.
    `pulses_per_trigger` 0 means all pulses of a revolution, `jitter_std` 0 the standard deviation
    1/(sqrt(12) keyphasor_rate), `sample_rate` 0 unknown; `angle_law` is that of the average. What
    a distribution does not use (`jitter_std` of a uniform one, `jitter_table` of any but table)
    may stay set, so that the distribution can be switched. Raises ModelError for values that make
    no sense.
    """

    keyphasor_rate: float
    trigger_speed: float
    trigger_cycles: int
    orders: tuple[float, ...]
    ratio: float = 1.0
    pulses_per_revolution: int = 1
    pulses_per_trigger: int = 0
    jitter_distribution: str = 'uniform'
    jitter_std: float = 0.0
    jitter_table: tuple[float, ...] = ()
    noise_std: float = 0.0
    sample_rate: float = 0.0
    angle_law: str = 'linear'

    def __post_init__(self) -> None:
        """Check every value and every combination."""
        for name in ('keyphasor_rate', 'trigger_speed', 'ratio'):
            _require(name, getattr(self, name), lambda value: value > 0.0, 'above 0')
        for name in ('jitter_std', 'noise_std', 'sample_rate'):
            _require(name, getattr(self, name), lambda value: value >= 0.0, '0 (unset) or above')
        _require('pulses_per_revolution', self.pulses_per_revolution,
                 lambda value: value >= 1 and float(value).is_integer(), 'whole, at least 1')
        _require('pulses_per_trigger', self.pulses_per_trigger,
                 lambda value: value >= 0 and float(value).is_integer(),
                 'whole, 0 (all of a revolution) or above')
        require_cycles(self.trigger_cycles)
        object.__setattr__(self, 'trigger_cycles', int(self.trigger_cycles))
        object.__setattr__(self, 'orders', tuple(require_orders(self.orders).tolist()))
        if not isinstance(self.jitter_table, Iterable):
            raise ModelError(f'jitter_table is {self.jitter_table}: give a list of pulse errors '
                             'in s')
        object.__setattr__(self, 'jitter_table', tuple(self.jitter_table))
        if self.jitter_distribution not in DISTRIBUTIONS:
            raise ModelError(f'jitter_distribution is {self.jitter_distribution!r}: choose one of '
                             f'{", ".join(DISTRIBUTIONS)}')
        if self.angle_law not in ANGLE_LAWS:
            raise ModelError(f'angle_law is {self.angle_law!r}: choose one of '
                             f'{", ".join(ANGLE_LAWS)}')
        if self.noise_std > 0.0 and self.sample_rate == 0.0:
            raise ModelError(f'noise_std is {self.noise_std} without sample_rate: how much noise '
                             'one line of the average holds depends on it; set sample_rate (Hz)')
        highest = max(self.orders)
        if 0.0 < self.sample_rate < 2.0 * highest * self.fundamental_frequency:
            limit = 0.5 * self.sample_rate / self.fundamental_frequency
            raise ModelError(
                f'order {highest:g} is above the Nyquist order {limit:g} of vibration sampled at '
                f'{self.sample_rate:g} Hz: drop it, or raise sample_rate')
        width = self.distribution.width
        if not width < self.trigger_period:
            raise ModelError(
                f'pulse errors spread over {width:.3g} s but a trigger cycle lasts '
                f'{self.trigger_period:.3g} s, so pulses could swap: raise keyphasor_rate or '
                'pulses_per_trigger, or lower jitter_std or trigger_speed')

    @property
    def distribution(self) -> PulseErrorDistribution:
        """Return the distribution of one pulse error in s."""
        if self.jitter_distribution == 'uniform':
            return Uniform(1.0 / self.keyphasor_rate)
        if self.jitter_distribution == 'table':
            return Empirical(np.asarray(self.jitter_table))
        std = self.jitter_std or 1.0 / (math.sqrt(12.0) * self.keyphasor_rate)
        return Normal(std) if self.jitter_distribution == 'normal' else Triangular(std)

    @property
    def weights(self) -> PulseWeights:
        """Return how the angle law passes on pulse errors."""
        return angle_law(self.angle_law).weights

    @property
    def fundamental_frequency(self) -> float:
        """Return the speed of the shaft of interest in Hz."""
        return self.ratio * self.trigger_speed

    @property
    def trigger_revolutions(self) -> float:
        """Return the length of a trigger cycle in revolutions of the tach shaft."""
        pulses = self.pulses_per_trigger or self.pulses_per_revolution
        return pulses / self.pulses_per_revolution

    @property
    def trigger_period(self) -> float:
        """Return the length of a trigger cycle in s."""
        return self.trigger_revolutions / self.trigger_speed

    @property
    def cycle_length(self) -> float:
        """Return r, the length of a trigger cycle in fundamental cycles."""
        return self.ratio * self.trigger_revolutions

    @property
    def duration(self) -> float:
        """Return the length of an average in s."""
        return self.trigger_cycles * self.trigger_period


@dataclass(frozen=True)
class Prediction:
    """
    The predicted distribution of the amplitude of a unit component, one entry per order.

    `mean_attenuation` = E|X| and `variance` = Var|X|, so mean^2 + variance = E|X|^2, which is
    exact. `moments` hold the complex amplitude itself, `distribution` its distribution function.
    """

    model: DeclaredModel
    order: Array
    mean_attenuation: Array
    variance: Array
    standard_deviation: Array
    quantile_05: Array
    quantile_50: Array
    quantile_95: Array
    moments: AverageMoments = field(repr=False)
    distribution: AmplitudeDistribution | SampledDistribution = field(repr=False)

    @property
    def trigger_speed(self) -> float:
        """Return the speed of the tach shaft in Hz."""
        return self.model.trigger_speed

    @property
    def keyphasor_rate(self) -> float:
        """Return the rate in Hz at which the keyphasor is sampled."""
        return self.model.keyphasor_rate

    @property
    def trigger_cycles(self) -> int:
        """Return the number N_t of trigger cycles in an average."""
        return self.model.trigger_cycles

    @property
    def ratio(self) -> float:
        """Return the speed of the shaft of interest over that of the tach shaft."""
        return self.model.ratio

    @property
    def pulse_error_standard_deviation(self) -> float:
        """Return the standard deviation of the declared jitter in s."""
        return math.sqrt(self.model.distribution.variance)

    @property
    def noise_standard_deviation(self) -> float:
        """Return the standard deviation of the declared noise per vibration sample."""
        return self.model.noise_std

    @property
    def loss(self) -> Array:
        """Return the part 1 - |E X| of each order that no number of averages brings back."""
        return np.asarray(1.0 - np.abs(self.moments.mean))

    def cdf(self, amplitude: ArrayLike) -> Array:
        """Return P(|X| <= amplitude), (order, k) for amplitudes of shape (k,) or (order, k)."""
        return self.distribution.cdf(amplitude)

    def ppf(self, probability: ArrayLike) -> Array:
        """Return quantiles of |X|, (order, k) for k probabilities in (0, 1)."""
        return self.distribution.ppf(probability)

    @property
    def header(self) -> tuple[float, float, float, float, float, float]:
        """Return the header elements of the `prediction` topic."""
        return (self.trigger_speed, self.keyphasor_rate, float(self.trigger_cycles), self.ratio,
                self.pulse_error_standard_deviation, self.noise_standard_deviation)


def predict(
    model: DeclaredModel, *, processes: Sequence[AngleErrorProcess] = (),
    offset: AngleOffset | None = None, gain: ArrayLike = 1.0, line_variance: ArrayLike = 0.0,
    declared_jitter: bool = True,
) -> Prediction:
    """
    Return the distribution of the amplitudes that an average shows of unit components.

    Effects beyond the declared jitter: random `processes` and a deterministic `offset` of the
    angle (fundamental cycles), a `gain` per order (complex or real) that acts on the component
    alone, and `line_variance`, E|n|^2 of what is added incoherently to each peak amplitude.
    Without `declared_jitter` they take the place of the declared one.

    Mean square and complex moments are exact for any of them. The distribution itself is sampled
    (fixed seed) for few trigger cycles, normal under an offset, curved otherwise.
    """
    _require_effects(model, gain, line_variance)
    orders = np.asarray(model.orders)
    frequency = model.fundamental_frequency
    declared = (IndependentPulseJitter(model.distribution, frequency, model.weights),)
    everything = (*(declared if declared_jitter else ()), *processes)
    jitters = [process.distribution for process in everything
               if isinstance(process, IndependentPulseJitter)
               and (process.frequency, process.weights) == (frequency, model.weights)]
    plain = len(jitters) == len(everything) > 0
    spread = float(orders.max()) * frequency * math.sqrt(sum(item.variance for item in jitters))
    nodes = int(np.clip(16.0 + 16.0 * spread, 16 if plain else 32, 160))
    noise = np.asarray(line_variance) + (
        noise_line_variance(model.noise_std, model.sample_rate, model.duration)
        if model.noise_std else 0.0)
    count = model.trigger_cycles
    if offset is not None:
        moments = offset_moments(orders, everything, count, offset, nodes=nodes)
        moments = moments.scaled(gain).with_noise(noise)
        return prediction_of(model, moments, normal_distribution(moments))
    cycles = cycle_moments(orders, everything, nodes=nodes, lags=count)
    moments = cycles.averaged(count).scaled(gain).with_noise(noise)
    g = np.asarray(gain)
    equal, mixed = average_cumulants(orders, everything, count, cycles)
    curved = curved_distribution(moments, equal * g**3, mixed * g * np.abs(g) ** 2)
    if few_cycles(cycles, count, plain, curved.skew) and can_be_sampled(
            everything, count, orders.size):
        return prediction_of(model, moments, sampled_distribution(
            orders, everything, count, moments, gain=gain, line_variance=noise,
            weights=model.weights))
    return prediction_of(model, moments, curved)


def few_cycles(
    cycles: CycleMoments, trigger_cycles: int, plain: bool, skew: Array,
) -> bool:
    """
    Tell whether an average holds too few cycles for a limit theorem, so that it is sampled.

    Cycles that remember each other count as fewer: as the variance of one over that of the average
    says. `plain` are independent errors alone, `skew` the skewness of the curved distribution.
    """
    lopsided = np.max(np.abs(skew)) > _LOPSIDED
    if trigger_cycles <= (_FEW_LOPSIDED_CYCLES if plain and lopsided else _FEW_CYCLES):
        return True
    if plain:
        return False
    power = np.abs(cycles.mean) ** 2
    turn = np.exp(-2j * np.angle(cycles.mean))
    pairs = [(m.variance, np.real(m.pseudo_variance * turn))
             for m in (cycles.lag(0), cycles.averaged(trigger_cycles))]
    for side, fewest in ((1.0, _FEW_ALONG), (-1.0, _FEW_ACROSS)):  # the mean phasor
        single, average = (variance + side * pseudo for variance, pseudo in pairs)
        if np.any((single < fewest * average) & (average > _NOTHING * power)):
            return True
    return False


def prediction_of(
    model: DeclaredModel, moments: AverageMoments,
    distribution: AmplitudeDistribution | SampledDistribution,
) -> Prediction:
    """Return the figures of a distribution that was found for a model."""
    quantiles = distribution.ppf(QUANTILES)
    variance = distribution.variance
    return Prediction(
        model=model, order=np.asarray(model.orders), mean_attenuation=distribution.mean,
        variance=variance, standard_deviation=np.sqrt(variance), quantile_05=quantiles[:, 0],
        quantile_50=quantiles[:, 1], quantile_95=quantiles[:, 2], moments=moments,
        distribution=distribution)


def _require_effects(model: DeclaredModel, gain: ArrayLike, line_variance: ArrayLike) -> None:
    """Raise ModelError for a gain or noise that is none, or not one for each order."""
    for name, value, least in (('gain', gain, -np.inf), ('line_variance', line_variance, 0.0)):
        given = np.asarray(value)
        if given.shape not in ((), (1,), (len(model.orders),)):
            raise ModelError(f'{name} has the shape {given.shape}: give one value, or '
                             f'{len(model.orders)}, as many as orders')
        if not (np.all(np.isfinite(given)) and np.all(given.real >= least)):
            raise ModelError(f'{name} is {given}: it must be finite and at least {least:g}')


def _require(name: str, value: float, holds: Callable[[float], bool], limit: str) -> None:
    if not (is_number(value) and math.isfinite(value) and holds(value)):
        raise ModelError(f'{name} is {value}: it must be finite and {limit}')
