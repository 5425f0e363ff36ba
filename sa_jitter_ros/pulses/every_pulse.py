# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Pulses of which nobody doubts any: all but doubles are true, whatever their intervals."""

import math

from sa_jitter_ros.pulses.pulse_follower import JudgeOptions
from sa_jitter_ros.pulses.trigger_counter import PulseSink
from sa_jitter_ros.pulses.verdicts import Verdicts


class EveryPulse:
    """
    Pass all pulses on to a trigger counter, in the place of a `PulseJudge`.

    It is for a clean encoder on a shaft whose speed changes from one pulse to the next by more
    than a shaft is expected to. A pulse within the smallest interval of the last one is a double.
    """

    def __init__(self, counter: PulseSink, options: JudgeOptions) -> None:
        self._counter, self._least = counter, options.minimum_interval
        self.verdicts = Verdicts()
        self.waiting, self.hides_missing = 0, True  # nothing is looked for
        self.forget()

    def forget(self) -> None:
        """Begin a new run with the next pulse."""
        self._counter.stop(known=False)
        self._running = False
        self.confirmed = self.last = -math.inf

    def take(self, pulses: list[float]) -> None:
        """Take the next pulses in s, in order of time, none before the last one."""
        kept = []
        for pulse in pulses:
            if pulse - self.last < self._least or pulse == self.last:
                self.verdicts.reject(pulse, 'doubles')
            else:
                kept.append(pulse)
                self.last = pulse
        if not kept:
            return
        self.verdicts.counts['accepted'] += len(kept)
        self.confirmed = self.last
        if not self._running:
            self._counter.begin(kept.pop(0), 0)
            self._running = True
        if kept:
            self._counter.extend(kept, [1] * len(kept))

    def flush(self) -> None:
        """Judge the pulses that wait: none does."""

    def fits(self, gap: float) -> bool:
        """Whether a pulse at this interval (s) from the last one would be regular: any is."""
        return gap > 0.0

    def drop_later(self, time: float, most: int) -> int:
        """Drop the waiting pulses after a time (s), of which there are none; return 0."""
        return 0
