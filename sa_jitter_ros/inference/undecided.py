# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Effects that may be there unseen, and are large enough to change an average."""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
import math

import numpy as np
from sa_jitter_ros.effects import Effect, EFFECTS
from sa_jitter_ros.effects.effect import DirectEffect
from sa_jitter_ros.effects.timing import Pattern
from sa_jitter_ros.errors import ModelError
from sa_jitter_ros.inference.candidates import Candidate
from sa_jitter_ros.inference.limits import EffectLimit
from sa_jitter_ros.inference.residual import NOTICEABLE
from sa_jitter_ros.inference.timing import Timing
from sa_jitter_ros.prediction.prediction import Prediction

#: The largest change that an effect beside others makes.
Change = Callable[[Sequence[Effect], Effect], float]
# Shares of effects that are there, in the open half of the table of decisions; as many of those
# that are named are not.
_NOT_NAMED, _NOWHERE = 0.02, 7e-4


def undecided_effects(change: Change, effects: Sequence[Effect], rows: Sequence[EffectLimit]
                      ) -> tuple[str, ...]:
    """
    Return the effects that, as large as their limits, would still change an average.

    Random motions without a limit may be of any size.
    """
    found = []
    for row in rows:
        if row.effect is None:
            kind = EFFECTS[row.name]
            if row.lower is None and not issubclass(kind, DirectEffect) and not isinstance(
                    kind.timing, Pattern):
                found.append(row.name)
            continue
        try:
            size = change(effects, row.effect)
        except ModelError:  # so large that no average is left
            size = math.inf
        if size >= NOTICEABLE:
            found.append(row.name)
    return tuple(found)


def published_change(before: Prediction, after: Prediction) -> float:
    """Return the largest change of what is published: mean and scatter of an order."""
    return float(max(np.abs(getattr(after, name) - getattr(before, name)).max()
                     for name in ('mean_attenuation', 'standard_deviation')))


def probabilities(candidates: Sequence[Candidate], timing: Timing | None, named: Iterable[str],
                  not_testable: Collection[str]) -> Mapping[str, float]:
    """
    Return the probability that the declared model lacks an effect, of all that could be seen.

    The odds among sets of effects hold if one of these sets is true. How often an effect is there
    that was named, or that has these odds and was not named, is counted.
    """
    odds = {item.name: item.finding.probability for item in candidates}
    odds |= timing.probabilities if timing is not None else {}
    found = {name: _NOWHERE + _NOT_NAMED * value for name, value in odds.items()}
    found |= dict.fromkeys(named, 1.0 - _NOT_NAMED)
    return {name: value for name, value in found.items() if name not in not_testable}
