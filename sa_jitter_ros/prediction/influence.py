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
What prediction asks of anything that changes an average beyond the declared jitter.

An `Influence` says what it gives: random angle errors, known pulse errors, a gain, noise. What it
does not override has no influence. Any number of them combine, because each only names its
independent contribution to the one angle error. The effects of the package are influences that
have parameters and can be found in measured data.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import ArrayLike
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.errors import ModelError
from sa_jitter_ros.prediction.angle_error import AngleErrorProcess, IndependentPulseJitter
from sa_jitter_ros.prediction.distributions import PulseErrorDistribution
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.prediction.moments import AverageMoments

_SMOOTH = 25  # pulses over which a speed is taken


@dataclass(frozen=True)
class AveragePulses:
    """
    The measured trigger pulses of one average, or with them those beside that its angle law reads.

    `times` (N_t + 1,) in s, NaN where nothing is known but the number of pulses; `first` counts
    the pulses before them in the recording, missing ones too; `errors` (N_t + 1,) in s holds what
    the grid of a clock says about each (`keyphasor_quantisation`), None where it says nothing;
    `missing` (N_t,) is how many pulses lack within each cycle; `error_std` in s is how uncertain
    `errors` are that were measured otherwise, `unknown_std` what they do not hold of the true
    ones, correlated from pulse to pulse by `unknown_correlation`.
    """

    times: Array
    first: int = 0
    errors: Array | None = None
    missing: Array | None = None
    error_std: float = 0.0
    unknown_std: float = 0.0
    unknown_correlation: float = 0.0

    @property
    def index(self) -> Array:
        """Return how many pulses went before each (N_t + 1,), missing ones too."""
        lost = 0 if self.missing is None else np.concatenate(([0], np.cumsum(self.missing)))
        return np.asarray(self.first + np.arange(len(self.times)) + lost)

    @property
    def relative_speed(self) -> Array:
        """Return the speed at each pulse over that of the average (N_t + 1,); 1 if unknown."""
        measured = np.isfinite(self.times)
        if np.count_nonzero(measured) < 3:
            return np.ones(len(self.times))
        index = self.index[measured]
        all_of_them = np.arange(index[0], index[-1] + 1)
        period = trigger_periods(np.interp(all_of_them, index, self.times[measured]))
        return np.asarray(np.interp(self.index, all_of_them, period.mean() / period))

    def without(self, before: int, after: int) -> 'AveragePulses':
        """Return all but some pulses at either end."""
        kept = slice(before, len(self.times) - after)
        cycles = slice(before, kept.stop - 1)
        return replace(
            self, times=self.times[kept], first=int(self.index[before]),
            errors=None if self.errors is None else self.errors[kept],
            missing=None if self.missing is None else self.missing[cycles])


class Influence(Protocol):
    """Something that changes an average; pulse errors are in s, measured minus true time."""

    name: ClassVar[str]

    @classmethod
    def unmodelled(cls, model: DeclaredModel) -> str:
        """Return why there is no forward model with this declared model, '' if there is one."""
        return ''

    def processes(self, model: DeclaredModel) -> Sequence[AngleErrorProcess]:
        """
        Return random angle errors, or random gains, that are stationary over the cycles.

        None of them where they have no size: the prediction is then the one without them.
        """
        return ()

    def scenarios(self, model: DeclaredModel) -> Array | None:
        """
        Return equally likely pulse errors (scenario, N_t + 1) in s of an average.

        They are what is known of the pulses up to a few numbers that nobody knows in advance. None
        where nothing is known, or all errors are 0.
        """
        return None

    def drawn_scenarios(self, model: DeclaredModel, count: int) -> Array | None:
        """Return random scenarios (count, N_t + 1) in s where no few hold all, None elsewhere."""
        return None

    def exact_moments(self, model: DeclaredModel, processes: Sequence[AngleErrorProcess]
                      ) -> AverageMoments | None:
        """Return the moments over all scenarios with random `processes`, where they are known."""
        return None

    def pattern(self, model: DeclaredModel, pulses: AveragePulses) -> Array | None:
        """Return the pulse errors (N_t + 1,) in s of one average whose pulses were measured."""
        return None

    def gain(self, model: DeclaredModel) -> ArrayLike:
        """Return the factor, one or (order,), complex or real, on the component alone."""
        return 1.0

    def line_variance(self, model: DeclaredModel) -> ArrayLike:
        """Return E|n|^2, one or (order,), of what is added to each complex peak amplitude."""
        return 0.0

    def replaces_jitter(self, model: DeclaredModel) -> bool:
        """Return whether this replaces the declared jitter."""
        return False

    def jitter_factor(self, model: DeclaredModel) -> float:
        """Return the factor on the errors of the declared jitter."""
        return 1.0

    def pulse_autocovariance(self, model: DeclaredModel, lags: Array) -> Array:
        """Return the autocovariance in s^2 that the random errors of the pulses show at `lags`."""
        return np.zeros(np.shape(lags))


@dataclass(frozen=True)
class KnownGain(Influence):
    """
    A known change of the components: `factor`, one or (order,), complex or real.

    >>> from sa_jitter_ros.prediction.prediction import predict
    >>> model = DeclaredModel(keyphasor_rate=10e3, trigger_speed=25.0, trigger_cycles=40,
    ...                       orders=(23.0, 46.0))
    >>> with_gain, without = predict(model, [KnownGain(1.1)]), predict(model)
    >>> (with_gain.mean_attenuation / without.mean_attenuation).round(3)
    array([1.1, 1.1])
    """

    name: ClassVar[str] = 'gain'
    factor: ArrayLike

    def gain(self, model: DeclaredModel) -> ArrayLike:
        """Return the factor."""
        return self.factor


def require_modelled(model: DeclaredModel, influences: Sequence[Influence]) -> None:
    """Raise ModelError where an influence has no forward model with the declared one."""
    for item in influences:
        reason = item.unmodelled(model)
        if reason:
            raise ModelError(f'{item.name}: {reason}')


def declared_jitter(model: DeclaredModel, influences: Sequence[Influence]
                    ) -> PulseErrorDistribution | None:
    """Return what influences make of the declared jitter, None where they leave nothing."""
    factor = math.prod(item.jitter_factor(model) for item in influences)
    if factor == 0.0 or any(item.replaces_jitter(model) for item in influences):
        return None
    return model.distribution if factor == 1.0 else model.distribution.scaled(factor)


def random_processes(model: DeclaredModel, influences: Sequence[Influence]
                     ) -> tuple[AngleErrorProcess, ...]:
    """Return the random angle errors of declared jitter and influences."""
    jitter = declared_jitter(model, influences)
    declared: tuple[AngleErrorProcess, ...] = () if jitter is None else (
        IndependentPulseJitter(jitter, model.fundamental_frequency, model.weights),)
    return (*declared, *(process for item in influences for process in item.processes(model)))


def known_errors(model: DeclaredModel, influences: Sequence[Influence], pulses: AveragePulses
                 ) -> Array | None:
    """Return what influences know of the errors of `pulses` in s, None for nothing."""
    found = [errors for errors in (item.pattern(model, pulses) for item in influences)
             if errors is not None]
    return np.asarray(np.sum(found, axis=0)) if found else None


def trigger_periods(times: Array) -> Array:
    """Return the trigger period at each pulse (s): the slope of a cubic through some pulses."""
    from scipy.signal import savgol_filter  # which loads long, for programs that predict nothing
    window = min(_SMOOTH, (times.size - 1) // 2 * 2 + 1)
    return np.asarray(savgol_filter(times, window, min(3, window - 1), deriv=1))


def common_turn(times: Array, counted: Array) -> Array:
    """
    Return how long a turn of all takes at each of the true `times` (s), 1 in the mean.

    It takes longer where the shaft is slow. The mean is that of the `counted` pulses; all is NaN
    where a time is unknown.
    """
    if not np.all(np.isfinite(times)):
        return np.full(times.size, np.nan)
    period = trigger_periods(times)
    return np.asarray(period / period[counted].mean())


def mean_period(times: Array, missing: Array | None) -> float:
    """Return the mean trigger period in s of pulses of which `missing` (interval,) lack."""
    lost = 0 if missing is None else missing.sum()
    return float((times[-1] - times[0]) / (len(times) - 1 + lost))


def without_gaps(errors: Array, missing: Array | None, times: Array) -> Array:
    """Return known errors less the periods of `missing` pulses, which corrected ones lack too."""
    if missing is None or not missing.any():
        return errors
    period = mean_period(times, missing)
    return np.asarray(errors - period * np.concatenate(([0.0], np.cumsum(missing))))
