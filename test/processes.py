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
