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
Lines that vary from average to average beyond their errors, whatever the pulse errors show.

A load that changes, a channel that loses sensitivity and a path that fades do that. Predictions of
the attenuation hold beside it, those of amplitudes do not.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.inference.expectation import Lines
from sa_jitter_ros.inference.residual import FALSE_ALARM
from sa_jitter_ros.number_text import percent_text
from scipy import special

#: Relative scatter of an amplitude from average to average that steady machines were measured to
#: have and that no effect describes (docs/measured_cases.md).
SCATTER = 0.02
#: The same of ordinary machines (6 % on a bearing rig): beyond it, the machine is unexplained.
ORDINARY = 0.07


@dataclass(frozen=True)
class UnsteadyLine:
    """An order on a channel whose amplitude varies by `scatter` of it (RMS) from unknown cause."""

    order: float
    channel: str
    scatter: float

    @property
    def large(self) -> bool:
        """Return whether it varies by more than lines of ordinary machines do."""
        return self.scatter > ORDINARY


def unsteady_lines(amplitude: Array, known: Array, orders: Array, channels: Sequence[str],
                   lines: Lines) -> tuple[UnsteadyLine, ...]:
    """
    Return the lines whose amplitudes (acquisition, line) scatter more than is `known`, most first.

    `known` (line,) is the relative variance that noise, pulse errors and effects give them. A
    scatter that steady machines have, too, is none.
    """
    count = len(amplitude)
    if count < 3 or not lines.count:
        return ()
    relative = amplitude / amplitude.mean(axis=0) - 1.0
    power = np.var(relative, axis=0, ddof=1)
    chance = lines.count * special.chdtrc(count - 1, (count - 1) * power / (known + SCATTER**2))
    found = np.flatnonzero(chance < FALSE_ALARM)
    size = np.sqrt(np.maximum(power - known, 0.0))
    return tuple(UnsteadyLine(float(orders[lines.order[i]]), channels[lines.channel[i]],
                              float(size[i])) for i in found[np.argsort(-size[found])].tolist())


def unsteady_text(lines: Sequence[UnsteadyLine], words: Callable[[float], str]) -> str:
    """Return which lines vary, the worst first; `words` names an order in a sentence."""
    worst, *others = lines
    more = f' (and {len(others)} more: see unsteady_lines)' if others else ''
    return (f'the amplitude of {words(worst.order)} on {worst.channel} varies by '
            f'{percent_text(worst.scatter)} RMS from average to average{more}')
