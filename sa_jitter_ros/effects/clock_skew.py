# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Clock skew: the keyphasor's clock runs faster or slower than that of the vibration."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.effects.effect import Effect, parameter
from sa_jitter_ros.effects.path_delay import STEADY
from sa_jitter_ros.effects.timing import Pattern, Setting
from sa_jitter_ros.prediction.influence import AveragePulses, trigger_periods
from sa_jitter_ros.prediction.model import DeclaredModel

#: Clocks, and ratios, are seldom wrong by more.
USUAL_SKEW = 5e-3


def _periods(setting: Setting) -> Array:
    """Return the trigger periods without jitter, by the clock of the pulses."""
    measured, true = (times[-1] - times[0] for times in (setting.times, setting.true_times))
    return np.asarray(measured / true * trigger_periods(setting.true_times))


def _growing(setting: Setting) -> Array:
    """
    Return the delay in trigger periods of pulses whose clock began with that of the vibration.

    The turn that is common to all pulses takes longer where the speed is low.
    """
    common = np.mean(setting.fitted - setting.begin) / setting.common_period
    delay = setting.times - setting.begin - common * _periods(setting)
    return np.asarray(delay)[None] / setting.model.trigger_period


def _growing_by_angle(setting: Setting) -> Array:
    """Return the delay that grows with the angle, less that of the skew; none if steady."""
    period = _periods(setting)
    if np.std(period) < STEADY * period.mean():
        return np.zeros((0, period.size))
    fitted = setting.fitted
    number = setting.index[0] + np.arange(fitted.size) - np.searchsorted(fitted, setting.times[0])
    middle = np.average(number[:-1] + 0.5, weights=np.diff(fitted))
    delay = (setting.index - middle) * period
    return np.asarray(delay / setting.model.trigger_period)[None] - _growing(setting)


#: What a wrong ratio makes of the pulses beside a clock skew of its size, in sizes as that.
WRONG_RATIO = Pattern(_growing_by_angle, show_in_times=False)


@dataclass(frozen=True)
class ClockSkew(Effect):
    """
    Time t of the vibration is t (1 + skew) on the keyphasor's clock.

    A wrong ratio makes the same at constant speed. Where the speed changes, its delay grows with
    the angle: `by_angle` is the share of the skew that does, 1 for a ratio alone.
    """

    name: ClassVar[str] = 'clock_skew'
    summary: ClassVar[str] = 'speed of the keyphasor clock relative to the vibration clock'
    meaning: ClassVar[str] = (
        'the clock of the pulses runs at another speed than that of the vibration')
    remedy: ClassVar[str] = 'time pulses and vibration by one clock'
    timing: ClassVar[Pattern] = Pattern(
        _growing, show_in_times=False, usual=lambda setting: (
            USUAL_SKEW * setting.model.trigger_period / setting.unit))
    skew: float = parameter(0.0, 'relative speed of the keyphasor clock, less 1', '1',
                            minimum=-0.1, maximum=0.1)
    by_angle: float = 0.0

    def ratio(self, model: DeclaredModel) -> float:
        """Return the ratio that shows as much at constant speed."""
        return model.ratio * (1.0 + self.skew)

    def remark(self, model: DeclaredModel) -> str:
        """Say which ratio shows as much."""
        ratios = f'a ratio of {self.ratio(model):.8g} instead of {model.ratio:.8g}'
        return (f' (as {ratios} makes it: it grows with the angle, not with the time)'
                if self.by_angle == 1.0 else
                f' ({ratios} makes the same at constant speed)' if self.by_angle == 0.0 else
                f' (of which {self.by_angle:.2g} grows with the angle, as by a wrong ratio)')

    def scenarios(self, model: DeclaredModel) -> Array | None:
        """Return the delay that grows through an average."""
        if self.skew == 0.0:
            return None
        return (self.skew * model.trigger_period
                * np.arange(model.trigger_cycles + 1.0))[None, :]

    def pattern(self, model: DeclaredModel, pulses: AveragePulses) -> Array | None:
        """
        Return the delay that grows through the average at hand, beyond the turn of all pulses.

        What has grown before counts, too, as far as the speed changes (see `PathDelay.pattern`).
        """
        known = np.flatnonzero(np.isfinite(pulses.times))
        begin, end = (known[0], known[-1]) if known.size else (0, 0)
        before = model.trigger_period * pulses.index[begin]
        delay = self._of_measured * (before + pulses.times - pulses.times[begin])
        by_time = delay * pulses.relative_speed - delay[begin]
        if begin == end:
            return np.asarray(by_time)
        number = pulses.index - pulses.index[begin]
        by_angle = (delay[end] - delay[begin]) * number / number[end]
        return np.asarray(by_time + self.by_angle * (by_angle - by_time))

    @property
    def _of_measured(self) -> float:
        """Return the delay in a second of the keyphasor's clock, in s."""
        return self.skew / (1.0 + self.skew)

    @classmethod
    def of_timing(cls, sizes: Array, errors: Array, setting: Setting
                  ) -> tuple['ClockSkew', Mapping[str, Any]]:
        """Return the skew that delays a pulse by some units more every measured period."""
        unit = setting.unit / setting.model.trigger_period
        rest = 1.0 - unit * float(sizes[0])
        return cls(1.0 / rest - 1.0), {'skew': unit * float(np.sqrt(errors[0, 0])) / rest**2}

    def in_timing(self, setting: Setting) -> Array:
        """Return the units by which a pulse comes later every measured period."""
        return np.array([self._of_measured * setting.model.trigger_period / setting.unit])
