# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The function `predict` of the library: a prediction from the parameters of the predictor."""

from collections.abc import Mapping, Sequence
import math
from types import MappingProxyType
from typing import Any

from sa_jitter_ros.effects.registry import declared_effects
from sa_jitter_ros.parameters import numbers
from sa_jitter_ros.prediction import prediction
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.prediction.moments import require_orders

_NONE: Mapping[str, Mapping[str, Any]] = MappingProxyType({})


def predict(
    *, keyphasor_rate: float, trigger_speed: float, trigger_cycles: int,
    orders: Sequence[float], ratio: float = 1.0, pulses_per_revolution: int = 1,
    pulses_per_trigger: int = 0, jitter_distribution: str = 'uniform', jitter_std: float = 0.0,
    jitter_table: Sequence[float] = (), noise_std: float = math.nan, sample_rate: float = 0.0,
    angle_law: str = 'linear', effects: Mapping[str, Mapping[str, Any]] = _NONE,
) -> prediction.Prediction:
    """
    Predict what keyphasor jitter does to each order of a synchronous average.

    The keywords are the parameters of the node `jitter_predictor`: rates and speeds in Hz, times
    in s, `orders` in multiples of the shaft of interest. `keyphasor_rate` is the rate at which the
    keyphasor is sampled, `trigger_cycles` the number N_t of trigger cycles in an average, `ratio`
    the speed of the shaft of interest over that of the tach shaft, `pulses_per_trigger` 0 all
    pulses of a revolution, `noise_std` NaN no noise. `effects` maps the name of an effect to its
    parameters.

    The attributes of the result are the fields of the topic `prediction`, arrays with one entry
    per order, for a component of amplitude 1; `loss` is 1 - |E X|, and `cdf(amplitude)` and
    `ppf(probability)` are the distribution of the amplitude. Raises ModelError for values that
    make no machine and ParameterError for an unknown effect, parameter or value.

    A gear mesh of 23 teeth, its keyphasor sampled at 10 kHz, with a clock that runs 100 ppm fast:

    >>> import sa_jitter_ros as sa
    >>> result = sa.predict(keyphasor_rate=10e3, trigger_speed=25.0, trigger_cycles=40,
    ...                  orders=[23.0, 46.0], effects={'clock_skew': {'skew': 1e-4}})
    >>> result.mean_attenuation.round(3)
    array([0.983, 0.932])
    >>> result.loss.round(3)
    array([0.017, 0.068])
    >>> result.cdf(0.985).round(2)  # probability that an average shows less
    array([[0.8],
           [1. ]])
    """
    model = DeclaredModel(
        keyphasor_rate=keyphasor_rate, trigger_speed=trigger_speed, trigger_cycles=trigger_cycles,
        orders=tuple(require_orders(orders).tolist()), ratio=ratio,
        pulses_per_revolution=pulses_per_revolution, pulses_per_trigger=pulses_per_trigger,
        jitter_distribution=jitter_distribution, jitter_std=jitter_std,
        jitter_table=numbers('jitter_table', jitter_table), noise_std=noise_std,
        sample_rate=sample_rate, angle_law=angle_law)
    return prediction.predict(model, declared_effects(effects))
