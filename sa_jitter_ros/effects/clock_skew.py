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
from sa_jitter_ros.effects.effect import Array, Effect, parameter
from sa_jitter_ros.effects.timing import Pattern, Setting
from sa_jitter_ros.prediction.influence import Pulses, trigger_periods
from sa_jitter_ros.prediction.model import DeclaredModel


_USUAL = 2e-3  # clocks seldom differ by more


def _growing(setting: Setting) -> Array:
    """
    Return the delay in trigger periods of pulses whose clock began with that of the vibration.

    The turn that is common to all pulses takes longer where the speed is low.
    """
    common = np.mean(setting.fitted - setting.begin) / np.mean(np.diff(setting.fitted))
    delay = setting.times - setting.begin - common * trigger_periods(setting.true_times)
    return np.asarray(delay)[None] / setting.model.trigger_period


@dataclass(frozen=True)
class ClockSkew(Effect):
    """Time t of the vibration is t (1 + skew) on the keyphasor's clock."""

    name: ClassVar[str] = 'clock_skew'
    summary: ClassVar[str] = 'speed of the keyphasor clock relative to the vibration clock'
    meaning: ClassVar[str] = (
        'the clock of the pulses runs at another speed than that of the vibration')
    remedy: ClassVar[str] = 'time pulses and vibration by one clock'
    timing: ClassVar[Pattern] = Pattern(
        _growing, show_in_times=False, usual=lambda setting: (
            _USUAL * setting.model.trigger_period / setting.unit))
    skew: float = parameter(0.0, 'relative speed of the keyphasor clock, less 1', '1',
                            minimum=-0.1, maximum=0.1)

    def scenarios(self, model: DeclaredModel) -> Array | None:
        """Return the delay that grows through an average."""
        if self.skew == 0.0:
            return None
        return (self.skew * model.trigger_period
                * np.arange(model.trigger_cycles + 1.0))[None, :]

    def pattern(self, model: DeclaredModel, pulses: Pulses) -> Array | None:
        """
        Return the delay that grows through the average at hand, beyond the turn of all pulses.

        What has grown before counts, too, as far as the speed changes (see `PathDelay.pattern`).
        """
        begin = int(np.argmax(np.isfinite(pulses.times)))
        before = model.trigger_period * pulses.index[begin]
        delay = self.skew * (before + pulses.times - pulses.times[begin])
        return np.asarray(delay * pulses.relative_speed - delay[begin])

    @classmethod
    def of_timing(cls, sizes: Array, errors: Array, setting: Setting
                  ) -> tuple['ClockSkew', Mapping[str, Any]]:
        """Return the skew that delays a pulse by some units more every trigger period."""
        skew = setting.unit / setting.model.trigger_period
        return cls(skew * float(sizes[0])), {'skew': skew * float(np.sqrt(errors[0, 0]))}

    def in_timing(self, setting: Setting) -> Array:
        """Return the units by which a pulse comes later every trigger period."""
        return np.array([self.skew * setting.model.trigger_period / setting.unit])
