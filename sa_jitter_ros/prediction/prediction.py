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
The prediction: what a declared keyphasor does to the amplitudes of a synchronous average.

`predict` turns a `DeclaredModel` and what else is known to act on the average into mean, variance
and quantiles of the amplitude of a unit component for every order.
"""

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import ArrayLike
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.parameters import listed
from sa_jitter_ros.prediction.amplitude_distribution import AmplitudeDistribution
from sa_jitter_ros.prediction.amplitudes import line_variance, unit_amplitudes
from sa_jitter_ros.prediction.influence import Influence
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.prediction.moments import AverageMoments
from sa_jitter_ros.prediction.sampled_distribution import SampledDistribution

QUANTILES = (0.05, 0.50, 0.95)


@dataclass(frozen=True)
class Prediction:
    """
    The predicted distribution of the amplitude of a unit component, one entry per order.

    `mean_attenuation` = E|X| and `variance` = Var|X|, so mean^2 + variance = E|X|^2, which is
    exact. `moments` hold the complex amplitude itself, `distribution` its distribution function.

    >>> import numpy as np
    >>> import sa_jitter_ros as sa
    >>> result = sa.predict(keyphasor_rate=10e3, trigger_speed=25.0, trigger_cycles=40,
    ...                     orders=[23, 46])
    >>> result  # doctest: +NORMALIZE_WHITESPACE
    Prediction(40 trigger cycles at 25 Hz, keyphasor 10000 Hz, orders 23, 46,
    mean attenuation 0.997, 0.986)
    >>> np.round([result.mean_attenuation, result.standard_deviation, result.quantile_05], 3)
    array([[0.997, 0.986],
           [0.001, 0.002],
           [0.996, 0.982]])
    >>> result.cdf([0.985, 0.997]).round(2)  # P(|X| <= 0.985) and P(|X| <= 0.997), a row an order
    array([[0.  , 0.8 ],
           [0.31, 1.  ]])
    """

    model: DeclaredModel
    order: Array
    mean_attenuation: Array
    variance: Array
    standard_deviation: Array
    quantile_05: Array
    quantile_50: Array
    quantile_95: Array
    moments: AverageMoments
    distribution: AmplitudeDistribution | SampledDistribution

    def __repr__(self) -> str:
        """Return one line: the average, the keyphasor and what is left of each order."""
        return (f'Prediction({self.trigger_cycles} trigger cycles at {self.trigger_speed:.5g} Hz, '
                f'keyphasor {self.keyphasor_rate:.5g} Hz, orders {listed(self.order)}, '
                f'mean attenuation {listed(self.mean_attenuation, 3)})')

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
        return self.model.noise

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


def predict(model: DeclaredModel, effects: Sequence[Influence] = ()) -> Prediction:
    """
    Return the distribution of the amplitudes that an average shows of unit components.

    `effects` act beside the declared jitter and noise; one may take the place of the jitter. Mean
    square and complex moments are exact; where averages must be drawn (`amplitudes`), those of
    lost pulses alone are. The distribution is sampled (fixed seed) for few trigger cycles, curved
    otherwise, and mixed over scenarios. Of independent pulse errors, quantiles have their
    probabilities to 0.01, E|X| is good to 0.01 standard deviations of |X|, these to 1 %; errors of
    more than some hundred cycles of an order leave E|X|^2 alone that good.

    Raises ModelError for an effect that has no forward model with this declared model, and for a
    gain or noise that is no number for each order.

    >>> from sa_jitter_ros.effects import make_effect
    >>> model = DeclaredModel(keyphasor_rate=10e3, trigger_speed=25.0, trigger_cycles=40,
    ...                       orders=(23.0, 46.0))
    >>> predict(model).mean_attenuation.round(3)
    array([0.997, 0.986])
    >>> predict(model, [make_effect('excess_jitter', std=5e-5)]).mean_attenuation.round(3)
    array([0.986, 0.946])
    """
    amplitudes = unit_amplitudes(model, effects)
    noise = line_variance(model, effects)
    distribution = amplitudes.distribution(np.arange(len(model.orders)), noise=noise)
    quantiles = distribution.ppf(QUANTILES)
    variance = distribution.variance
    return Prediction(
        model=model, order=np.asarray(model.orders), mean_attenuation=distribution.mean,
        variance=variance, standard_deviation=np.sqrt(variance), quantile_05=quantiles[:, 0],
        quantile_50=quantiles[:, 1], quantile_95=quantiles[:, 2],
        moments=amplitudes.moments.with_noise(noise), distribution=distribution)
