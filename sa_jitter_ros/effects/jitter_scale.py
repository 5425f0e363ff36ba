# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Jitter scale: the declared jitter has another size than declared, and the same distribution."""

from dataclasses import dataclass
from typing import ClassVar

from sa_jitter_ros.effects.effect import Effect, parameter, require_in_turn
from sa_jitter_ros.prediction.model import DeclaredModel


@dataclass(frozen=True)
class JitterScale(Effect):
    """
    Pulse errors are `scale` times the declared jitter, whatever its distribution.

    Where another effect takes the place of the declared jitter, it has none to scale.
    """

    name: ClassVar[str] = 'jitter_scale'
    summary: ClassVar[str] = 'declared jitter of another size'
    meaning: ClassVar[str] = 'the jitter is of the declared kind, but of another size'
    remedy: ClassVar[str] = 'declare this size'
    scale: float = parameter(1.0, 'true over declared size of the jitter', '1', minimum=0.0)

    def jitter_factor(self, model: DeclaredModel) -> float:
        """Return the scale; raise ModelError where pulses could swap."""
        require_in_turn('the spread of the jitter with jitter_scale.scale',
                        self.scale * model.distribution.width, model)
        return self.scale
