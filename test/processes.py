# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Random processes that several tests share."""

import numpy as np
from sa_jitter_ros.prediction.angle_error import GaussianPulseJitter
from sa_jitter_ros.pulses.angle_law import LINEAR


def gaussian_pulse_jitter(autocovariance, weights=LINEAR):
    """
    Return correlated normal pulse errors seen through an angle law.

    `autocovariance[i]` = Cov[eps_k, eps_{k+i}] in fundamental cycles squared, 0 beyond the list.
    """
    table = np.append(autocovariance, 0.0)
    return GaussianPulseJitter.through(
        weights, lambda lags: table[np.minimum(np.abs(lags), len(autocovariance))],
        len(autocovariance) + weights.pulses - 2)
