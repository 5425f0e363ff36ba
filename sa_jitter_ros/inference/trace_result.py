# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The result of the trace: which effects the declared model lacks, and what remains."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from sa_jitter_ros.arrays import Array
from sa_jitter_ros.effects import Effect
from sa_jitter_ros.effects.effect import Finding
from sa_jitter_ros.effects.evidence import Evidence
from sa_jitter_ros.effects.lattice import Clock, NO_CLOCK
from sa_jitter_ros.inference.candidates import Candidate
from sa_jitter_ros.inference.expectation import Expectation, Lines
from sa_jitter_ros.inference.gate import NO_GAIN, ScoreGain
from sa_jitter_ros.inference.limits import EffectLimit
from sa_jitter_ros.inference.observation import Observation
from sa_jitter_ros.inference.residual import Residual, UNDEFINED
from sa_jitter_ros.inference.unsteady import UnsteadyLine

HARMS = 'held-out acquisitions are predicted worse with it than with the declared model'


@dataclass(frozen=True)
class Trace:
    """
    Result of the trace; `before` and `after` are residuals of held-out acquisitions.

    The parameters of `findings` and `present` fit all acquisitions; residuals and predictions are
    those of parameters that fit the others.

    `prediction_before` and `prediction_after` are predictions for all acquisitions
    (acquisition, line) of the `lines`, `attenuation` and `amplitude` the observed values.
    `evidence` is that of the first round, less declared effects only. `unsteadiness` is the
    unexplained scatter of the amplitudes relative to their level, part of the scale of both
    residuals. What only refines the declared model is part of all residuals and predictions but
    `as_declared`: `noise`, the noise per sample and its standard error where it was not declared
    or is less, and the ticks of the declared clock (`refinements`). `not_compared` says why there
    are no `lines`, '' where there are some. `gain` is what the findings gain over the declared
    model on held-out acquisitions: with findings that predict these worse there is no trace.
    `clock` is that on whose ticks the pulses lie; `remains` says what is left over, '' where
    nothing is; `unsteady` are the lines that vary by themselves, `not_testable` the effects that
    could not be looked for, and why.
    """

    observation: Observation
    declared: tuple[Effect, ...]
    lines: Lines
    level: Array
    fit: tuple[int, ...]
    held_out: tuple[int, ...]
    findings: tuple[Finding, ...]
    present: tuple[Finding, ...]
    candidates: tuple[Candidate, ...]
    before: Residual
    after: Residual
    attenuation: Array
    amplitude: Array
    prediction_before: Expectation
    prediction_after: Expectation
    evidence: Evidence | None
    unsteadiness: float
    limits: tuple[EffectLimit, ...]
    undecided: tuple[str, ...]
    probabilities: Mapping[str, float]
    not_compared: str = ''
    noise: tuple[float, float] | None = None
    refinements: tuple[Finding, ...] = ()
    as_declared: Residual = UNDEFINED
    gain: ScoreGain = NO_GAIN
    remains: str = ''
    unsteady: tuple[UnsteadyLine, ...] = ()
    not_testable: Mapping[str, str] = field(default_factory=dict)
    clock: Clock = NO_CLOCK

    @property
    def verdict(self) -> str:
        """Return `unexplained` where something remains, else `traced` or `none`."""
        return 'unexplained' if self.remains else 'traced' if self.findings else 'none'

    def __post_init__(self) -> None:
        """Refuse effects with which held-out acquisitions are predicted worse."""
        if self.findings and self.gain.worse:
            names = ', '.join(item.name for item in self.findings)
            raise ValueError(f'{names}: {HARMS}')
