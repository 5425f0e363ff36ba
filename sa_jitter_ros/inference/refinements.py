# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""What only refines the declared model: noise of the recording, ticks of its clock."""

import numpy as np
from sa_jitter_ros.effects.additive_noise import less_noise, measured_noise
from sa_jitter_ros.effects.effect import effects_of, Finding
from sa_jitter_ros.effects.keyphasor_quantisation import KeyphasorQuantisation
from sa_jitter_ros.inference.gate import score_gain
from sa_jitter_ros.inference.remainder import predicting
from sa_jitter_ros.inference.residual import ACCURACY
from sa_jitter_ros.inference.scoring import Bench


def with_its_noise(bench: Bench) -> tuple[Bench, tuple[float, float] | None]:
    """
    Return the bench with the noise of the recording where that refines what was declared.

    That is where no noise was declared, or where averages scatter less than with the declared one.
    """
    evidence = bench.gather((), bench.fit)
    if not bench.observation.model.noise_is_declared:
        found = measured_noise(evidence)
        return (bench, None) if found is None else (bench.with_noise(found[0]), found)
    found = less_noise(evidence)
    if found is None:
        return bench, None
    quiet = bench.with_noise(found[0])
    declared, true = (np.sqrt(item.expect((), bench.fit).amplitude_variance.mean(axis=0))
                      for item in (bench, quiet))
    return (quiet, found) if np.max(declared - true) >= ACCURACY else (bench, None)


def with_its_ticks(bench: Bench, chosen: list[Finding], present: list[Finding]
                   ) -> tuple[Bench, list[Finding], list[Finding], list[Finding]]:
    """
    Return the bench with the ticks of the declared clock, these, and the other findings.

    A keyphasor that is sampled at the declared rate has them: they are no effect that the declared
    model lacks. They are left out unless acquisitions are predicted better with them, beside the
    effects that were chosen: where the shaft moves by more than a tick from pulse to pulse, they
    tell too little of the errors.
    """
    ticks = [item for item in (*chosen, *present)
             if isinstance(item.effect, KeyphasorQuantisation)
             and item.effect.is_declared(bench.observation.model)
             and item.name not in {effect.name for effect in bench.declared}]
    if not ticks:
        return bench, [], chosen, present
    refined = bench.declaring(effects_of(ticks))
    chosen, present = ([item for item in items if item not in ticks]
                       for items in (chosen, present))
    own = refined.unsteadiness(effects_of(chosen))
    gain = score_gain(*(predicting(item, own)(chosen) for item in (bench, refined)), of_mean=True)
    better = gain.log_score > 0.0 and not gain.worse
    return (refined, ticks, chosen, present) if better else (bench, [], chosen, present)
